"""The figures and tables that a study makes of its results."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from sweep.spec.instrument import Part
from sweep.spec.rules import Numeric, Rule, Text
from sweep.units import QuantityError, read_number

Selection = str | int | float | tuple[str | int | float, ...]
Printed = tuple[Any, ...]

STEM = Text(
    about="Stem of the picture's file name",
    pattern=r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}",
    remedy="take letters, digits, '_', '-' and '.'",
)
_COORDINATE = Text(
    about="Name of a coordinate: the last part of an axis's path",
    pattern=r"[A-Za-z_][A-Za-z0-9_]{0,99}",
    remedy="take the last part of an axis's path, such as 'range'",
)
_VARIABLE = Text(
    about="Name of a stored quantity, such as pd_shot",
    pattern=r"[A-Za-z_][A-Za-z0-9_]{0,99}",
    remedy="take a stored quantity, such as 'pd_shot'",
)
TITLE = Text(about="Title of the figure")


class _Where(Rule):
    """Values of coordinates that a figure is confined to."""

    def read(self, written: object) -> dict[str, Selection]:
        """Coordinates with one value or several each, as written."""
        if not isinstance(written, dict):
            raise QuantityError(
                "must be a mapping of coordinates to values", "write e.g. {grazing_angle: 15 deg}"
            )
        return {str(name): _selection(value) for name, value in written.items()}

    def schema(self) -> dict[str, Any]:
        """JSON Schema: coordinates, each with a value or a list of values."""
        value = {"type": ["string", "number"]}
        several = {"type": "array", "items": value, "minItems": 1}
        return {
            "description": self.about,
            "type": "object",
            "additionalProperties": {"anyOf": [value, several]},
            "examples": [{"grazing_angle": "15 deg"}],
        }


def _selection(written: object) -> Selection:
    """One value or several, as written."""
    if isinstance(written, list | tuple) and written:
        return tuple(_single(value) for value in written)
    return _single(written)


def _single(written: object) -> str | int | float:
    """One value, as written."""
    if isinstance(written, bool) or not isinstance(written, str | int | float):
        raise QuantityError("must hold a value, or a list of values, of each coordinate")
    return written


class _PrintedNumbers(Rule):
    """Numbers that a publication prints, in rows."""

    def read(self, written: object) -> Printed:
        """Numbers, nested as written."""
        if not isinstance(written, list | tuple):
            raise QuantityError("must be a list of numbers or of rows of numbers")
        return tuple(self.read(v) if isinstance(v, list | tuple) else _number(v) for v in written)

    def schema(self) -> dict[str, Any]:
        """JSON Schema: numbers, or rows of them."""
        number = {"type": ["number", "string"]}
        row = {"type": "array", "items": number}
        return {"description": self.about, "type": "array", "items": {"anyOf": [number, row]}}


def _number(written: object) -> float:
    value, unit = read_number(written)
    return unit.to_si(value)


WHERE = _Where(about="Values of coordinates that the figure is confined to")
_PRINTED = _PrintedNumbers(about="The numbers as published, row by row, to stand beside ours")


class _Drawing(Part):
    """What all figures have."""

    name: Annotated[str, STEM] = ""
    title: Annotated[str, TITLE] = ""

    @property
    def stem(self) -> str:
        """Stem of the picture's file name."""
        return self.name or f"{getattr(self, 'variable', self.kind)}_{self.kind}"  # type: ignore[attr-defined]

    @property
    def coordinates(self) -> dict[str, str]:
        """Coordinates named, by the field that names them."""
        named = {key: getattr(self, key, "") for key in ("x", "y", "by", "rows")}
        where = {f"where.{name}": name for name in getattr(self, "where", {})}
        columns = getattr(self, "columns", "")
        named["columns"] = columns if isinstance(columns, str) else ""
        return {key: name for key, name in (named | where).items() if name}


class Surface(_Drawing):
    """A quantity over two coordinates, seen from above."""

    kind: Literal["surface"]
    variable: Annotated[str, _VARIABLE]
    x: Annotated[str, _COORDINATE]
    y: Annotated[str, _COORDINATE]
    where: Annotated[dict[str, Selection], WHERE] = Field(default_factory=dict)


class Slices(_Drawing):
    """A quantity along one coordinate, a line for each value of another."""

    kind: Literal["slices"]
    variable: Annotated[str, _VARIABLE]
    x: Annotated[str, _COORDINATE]
    by: Annotated[str, _COORDINATE] = ""
    where: Annotated[dict[str, Selection], WHERE] = Field(default_factory=dict)


class Table(_Drawing):
    """A quantity averaged over all but rows and columns."""

    kind: Literal["table"]
    variable: Annotated[str, _VARIABLE]
    rows: Annotated[str, _COORDINATE]
    columns: Annotated[str, _COORDINATE] = ""
    where: Annotated[dict[str, Selection], WHERE] = Field(default_factory=dict)
    minimum_range: Annotated[
        float,
        Numeric(
            about="Nearer ranges are left out",
            si_unit="m",
            example="5 m",
            at_least="0 m",
            at_most="1e15 m",
        ),
    ] = 0.0
    printed: Annotated[Printed, _PRINTED] = ()


class FalseAlarmTable(_Drawing):
    """False alarms of a shot over the three cuts of Tables 4.3 to 4.5, a row for each value.

    Columns are 15 deg, 85 deg and 3500 m; ranges up to 5 m are left out.
    """

    kind: Literal["false_alarm_table"]
    by: Annotated[str, _COORDINATE]
    printed: Annotated[Printed, _PRINTED] = ()


class ThresholdTable(_Drawing):
    """False alarms of a bin for each threshold, as in Table 4.2."""

    kind: Literal["threshold_table"]
    by: Annotated[str, _COORDINATE] = "tnr"
    printed: Annotated[Printed, _PRINTED] = ()


Figure = Annotated[
    Surface | Slices | Table | FalseAlarmTable | ThresholdTable, Field(discriminator="kind")
]
FIGURE_KINDS = ("surface", "slices", "table", "false_alarm_table", "threshold_table")
