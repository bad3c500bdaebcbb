"""The figures and tables that a study makes of its results, over a grid or of a scene.

They are held against the study that they draw: its coordinates, stored quantities, scanners, draws.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

import sweep.spec.parts as of
from sweep.model import outputs
from sweep.spec.axes import Axis
from sweep.spec.flight import AnyScanner, shots_a_cycle
from sweep.spec.parts import Part, read_as
from sweep.spec.rules import Choice, Finding, Location, Special, near_miss
from sweep.spec.scene import SceneDraws
from sweep.spec.sections import SPECTRA, parameter_rules
from sweep.units import QuantityError, read_number

Selection = str | int | float | tuple[str | int | float, ...]
Printed = tuple[Any, ...]
Crop = tuple[float, ...]


def _read_where(written: object) -> dict[str, Selection]:
    """Coordinates with one value or several each, as written."""
    if not isinstance(written, dict):
        rule = "must be a mapping of coordinates to values"
        raise QuantityError(rule, "write e.g. {grazing_angle: 15 deg}")
    return {
        str(name): tuple(map(_single, value)) if value and isinstance(value, list | tuple)
        else _single(value)
        for name, value in written.items()
    }  # fmt: skip


def _single(written: object) -> str | int | float:
    """One value, as written."""
    if isinstance(written, bool) or not isinstance(written, str | int | float):
        raise QuantityError("must hold a value, or a list of values, of each coordinate")
    return written


def _read_printed(written: object) -> Printed:
    """Numbers, nested as written."""
    if not isinstance(written, list | tuple):
        raise QuantityError("must be a list of numbers or of rows of numbers")
    return tuple(_read_printed(v) if isinstance(v, list | tuple) else _number(v) for v in written)


def _number(written: object) -> float:
    value, unit = read_number(written)
    return unit.to_si(value)


_VALUE = {"type": ["string", "number"]}
_VALUES = {"type": "array", "items": _VALUE, "minItems": 1}
_WHERE = Special(
    about="Values of coordinates that the figure is confined to",
    reader=_read_where,
    json={
        "type": "object",
        "additionalProperties": {"anyOf": [_VALUE, _VALUES]},
        "examples": [{"grazing_angle": "15 deg"}],
    },
)
_NUMBER = {"type": ["number", "string"]}
_PRINTED = Special(
    about="The numbers as published, row by row, to stand beside ours",
    reader=_read_printed,
    json={"type": "array", "items": {"anyOf": [_NUMBER, {"type": "array", "items": _NUMBER}]}},
)


def _word(about: str, example: str, default: Any = ...) -> Any:
    """Name of something in a store."""
    pattern = r"[A-Za-z_][A-Za-z0-9_]{0,99}"
    return of.text(f"Name of {about}", default, pattern=pattern, remedy=f"take {example}")


def _coordinate(default: Any = ...) -> Any:
    example = "the last part of an axis's path, such as 'range'"
    return _word("a coordinate: the last part of an axis's path", example, default)


_VARIABLE = _word("a stored quantity, such as pd_shot", "a stored quantity, such as 'pd_shot'")


class Drawing(Part):
    """Base of all figures."""

    SHOWN: ClassVar[tuple[str, ...]] = ("kind",)
    """Fields whose values make the file's name, and words between them."""

    name: str = of.text(
        "Stem of the picture's file name",
        "",
        pattern=r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}",
        remedy="take letters, digits, '_', '-' and '.'",
    )
    title: str = of.text("Title of the figure", "")

    @property
    def stem(self) -> str:
        """Stem of the picture's file name."""
        named = [getattr(self, part, part) for part in (*self.SHOWN, "kind")]
        return self.name or "_".join(str(part) for part in named if part is not None)


# Figures of grids


class GridDrawing(Drawing):
    """Base of figures of grids."""


_LEVELS = of.measure("Level, in the quantity's unit", "", "0.9", "-1e30", "1e30")


class Surface(GridDrawing):
    """A quantity over two coordinates, seen from above."""

    SHOWN = ("variable",)
    kind: Literal["surface"]
    variable: str = _VARIABLE
    x: str = _coordinate()
    y: str = _coordinate()
    where: dict[str, Selection] = of.field(_WHERE, {})
    levels: tuple[float, ...] = of.several(
        _LEVELS, 1, 10, (), about="Levels at which contours are drawn", rising=True
    )


class Slices(GridDrawing):
    """A quantity along one coordinate, a line for each value of another."""

    SHOWN = ("variable",)
    kind: Literal["slices"]
    variable: str = _VARIABLE
    x: str = _coordinate()
    by: str = _coordinate("")
    where: dict[str, Selection] = of.field(_WHERE, {})
    levels: tuple[float, ...] = of.several(
        _LEVELS, 1, 10, (), about="Levels at which lines are drawn across", rising=True
    )


class Table(GridDrawing):
    """A quantity averaged over all but rows and columns."""

    SHOWN = ("variable",)
    kind: Literal["table"]
    variable: str = _VARIABLE
    rows: str = _coordinate()
    columns: str = _coordinate("")
    where: dict[str, Selection] = of.field(_WHERE, {})
    minimum_range: float = of.length(
        "Nearer ranges are left out", "5 m", "0 m", "1e15 m", default=0.0
    )
    printed: Printed = of.field(_PRINTED, ())


class FalseAlarmTable(GridDrawing):
    """False alarms of a shot over the three cuts of Tables 4.3 to 4.5, a row for each value.

    Columns are 15 deg, 85 deg and 3500 m; ranges up to 5 m are left out.
    """

    kind: Literal["false_alarm_table"]
    by: str = _coordinate()
    printed: Printed = of.field(_PRINTED, ())


class ThresholdTable(GridDrawing):
    """False alarms of a bin for each threshold, as in Table 4.2."""

    kind: Literal["threshold_table"]
    by: str = _coordinate("tnr")
    printed: Printed = of.field(_PRINTED, ())


Figure = Annotated[
    Surface | Slices | Table | FalseAlarmTable | ThresholdTable, Field(discriminator="kind")
]

# Figures of scenes

_SHOWN = outputs.SHOTS | outputs.STATISTICS | outputs.POINTS
QUANTITIES = (
    *(name for name, output in _SHOWN.items() if outputs.XYZ not in output.dims),
    "altitude", "x", "y", "z", "shot",
)  # fmt: skip
"""Quantities of shots and of points that a figure can show."""

SEVERAL_SURFACES = "several_surfaces"
_VIEW = Choice(about="Where from", options=("oblique", "above", "side", "front"))
_EYE = {
    "azimuth": of.measure("Of the eye, from x towards y", "rad", "-60 deg"),
    "elevation": of.measure("Above the horizon", "rad", "30 deg", "-90 deg", "90 deg"),
}


def _read_view(written: object) -> str | dict[str, float]:
    """Read a word, or azimuth and elevation of the eye [rad]."""
    if not isinstance(written, dict):
        return _VIEW.read(written)
    if set(written) != set(_EYE):
        rule = "must be a word or have an azimuth and an elevation"
        raise QuantityError(rule, "write e.g. {azimuth: -60 deg, elevation: 30 deg}")
    return {name: rule.read(written[name]) for name, rule in _EYE.items()}


_FROM = Special(
    about=_VIEW.about,
    reader=_read_view,
    json={
        "anyOf": [
            {"type": "string", "enum": list(_VIEW.options)},
            {
                "type": "object",
                "properties": {name: rule.schema() for name, rule in _EYE.items()},
                "required": list(_EYE),
                "additionalProperties": False,
            },
        ]
    },
)


def _quantity(about: str, default: Any = ...) -> Any:
    """Declare a quantity of shots or points."""
    usual = "take range, radial_velocity, snr, pd, surface, beam, time or altitude"
    rule = "is no quantity of shots or points"
    return of.field(Choice(about=about, options=QUANTITIES, rule=rule, remedy=usual), default)


def _part(along: str) -> Any:
    """Part of the scene along an axis."""
    rule = of.measure("Coordinate", "m", "100 m")
    return of.several(rule, 2, 2, None, about=f"Part along {along}", rising=True)


_SCANNER = of.name("Scanner; the first by default", None)
_RANGES = of.choice("By whole bins, or interpolated between them", ("quantised", "interpolated"))
_DRAW = of.count("Number of the draw, from 0", "0", "0", "1e9", default=0)
_TIME = of.several(
    of.measure("Time", "s", "10 s", "0 s", "1e8 s"), 2, 2, None,
    about="Part of the flight's time", rising=True,
)  # fmt: skip


class SceneDrawing(Drawing):
    """Base of figures of scenes."""

    where: dict[str, Selection] = of.field(_WHERE, {})


class CloudFigure(SceneDrawing):
    """A point cloud."""

    SHOWN = ("scanner", "colour")
    kind: Literal["cloud"]
    scanner: str | None = _SCANNER
    colour: str = _quantity("What colours the points", "range")
    ranges: str = _RANGES
    view: str | dict[str, float] = of.field(_FROM, "oblique")
    x: Crop | None = _part("x")
    y: Crop | None = _part("y")
    z: Crop | None = _part("z")
    time: Crop | None = _TIME
    terrain: bool = of.flag("Whether to draw the ground", default=True)
    path: bool = of.flag("Whether to draw the flight path", default=False)
    dropouts: bool = of.flag("Whether to mark shots without a point", default=False)
    draw: int = _DRAW


class Scatter(SceneDrawing):
    """A quantity of shots or points over another."""

    SHOWN = ("scanner", "y", "over", "x")
    kind: Literal["scatter"]
    scanner: str | None = _SCANNER
    x: str = _quantity("Quantity along x", "time")
    y: str = _quantity("Quantity along y")
    colour: str = _quantity("What colours the points", "beam")
    ranges: str = _RANGES
    time: Crop | None = _TIME
    draw: int = _DRAW


class ShotSpectra(SceneDrawing):
    """The three spectra of one shot, with threshold, noise and detections."""

    SHOWN = ("scanner", "shot")
    kind: Literal["shot_spectra"]
    scanner: str | None = _SCANNER
    shot: int | str = of.count(
        "Number of the shot, from 0, or the first whose footprint has several surfaces",
        "0", "0", "1e15", word=SEVERAL_SURFACES, default=SEVERAL_SURFACES,
    )  # fmt: skip
    draw: int = _DRAW


class _OfNavigation(SceneDrawing):
    """Base of figures and tables of navigation."""

    SHOWN = ("quantity", "show")
    scanners: tuple[str, ...] | None = of.several(
        of.named("Scanner", "three"), 1, 10_000, None,
        about="Scanners; all by default", noun="names", distinct=True,
    )  # fmt: skip
    quantity: str = of.choice("Velocity vector or altitude", ("velocity", "altitude"))
    show: str = of.choice("Which statistics", ("all", "availability", "bias", "rmse"))
    bins: int = of.count("Bins of altitude", "12", "1", "1000", default=12)


class NavigationFigure(_OfNavigation):
    """Statistics of navigation over altitude, a line a scanner."""

    kind: Literal["navigation"]


class NavigationTable(_OfNavigation):
    """Statistics of navigation over altitude, as a table."""

    kind: Literal["navigation_table"]


SceneFigure = Annotated[
    CloudFigure | Scatter | ShotSpectra | NavigationFigure | NavigationTable,
    Field(discriminator="kind"),
]

# What is wrong with figures

_SIDES = ("x", "y", "by", "rows", "columns")
"""Fields of a grid's figure that name a coordinate."""

LEAST_BEAMS = 3
"""Shots of a cycle from which on there is navigation."""


def figure_findings(
    written: Mapping[str, Any], axes: tuple[Axis, ...], further: Collection[str] = ()
) -> Iterator[Finding]:
    """Mistakes in the figures of a grid's study, as written; ``further`` names it stores too."""
    draws = written.get("draws")
    for at, figure in _readable(written, Figure):
        yield from _coordinate_findings(figure, axes, at)
        if isinstance(draws, Mapping) and draws.get("method") == SPECTRA:
            yield from _spectra_findings(figure, at)
        else:
            yield from _variable_findings(figure, draws, further, at)
    yield from _name_findings(written, Figure, "makes the same picture file as another")


def scene_figure_findings(
    written: Mapping[str, Any], axes: tuple[Axis, ...] | None
) -> Iterator[Finding]:
    """Mistakes in the figures of a scene's study, as written; axes None where unreadable."""
    scanners = written.get("scanners")
    scanners = scanners if isinstance(scanners, Mapping) else {}
    for at, figure in _readable(written, SceneFigure):
        yield from _scanner_findings(figure, scanners, at)
        yield from () if axes is None else _coordinate_findings(figure, axes, at)
        yield from _draw_findings(figure, written.get("draws"), at)
    yield from _name_findings(written, SceneFigure, "makes the same file as another")


def _readable(written: Mapping[str, Any], kind: Any) -> Iterator[tuple[Location, Any]]:
    """Figures that can be read, each with its location."""
    figures = written.get("figures")
    for i, figure in enumerate(figures if isinstance(figures, list | tuple) else ()):
        if (read := read_as(kind, figure)) is not None:
            yield ("figures", i), read


def _name_findings(written: Mapping[str, Any], kind: Any, rule: str) -> Iterator[Finding]:
    """Figures that share a file."""
    stems: set[str] = set()
    for at, figure in _readable(written, kind):
        if figure.stem in stems:
            yield Finding(at, f"{rule}, {figure.stem}", "give it a name")
        stems.add(figure.stem)


def _coordinate_findings(figure: Any, axes: tuple[Axis, ...], at: Location) -> Iterator[Finding]:
    """Coordinates that no axis has, and values that are none, or in a scene not one, of them."""
    of_grid = isinstance(figure, GridDrawing)
    named = {field: getattr(figure, field, "") for field in _SIDES} if of_grid else {}
    where = getattr(figure, "where", {})
    paths = {member.name: member.path for axis in axes for member in axis.members}
    known = list(dict.fromkeys([*paths, *(axis.name for axis in axes if of_grid)]))
    for field, name in (named | {f"where.{name}": name for name in where}).items():
        location: Location = (*at, *field.split("."))
        values = where[name] if field.startswith("where.") else ()
        if name and name not in known:
            remedy = f"the coordinates are {', '.join(known)}" if known else "it has no axes"
            suggestion = near_miss(name, known, otherwise=remedy)
            if field in named and field not in figure.model_fields_set:
                rule = f"is '{name}' by default, which is no coordinate of this study"
                yield Finding(location, rule, suggestion)
            else:
                yield Finding(location, "is no coordinate of this study", suggestion, name)
        elif isinstance(values, tuple) and values and not of_grid:
            yield Finding(location, "must be one value", "make a figure for each")
        elif name in paths:
            for value in values if isinstance(values, tuple) else (values,):
                try:
                    parameter_rules()[paths[name]].read(value)
                except QuantityError as error:
                    yield Finding(location, error.rule, error.suggestion, value)


def _variable_findings(
    figure: Any, draws: object, further: Collection[str], at: Location
) -> Iterator[Finding]:
    """Report a variable that the study does not store."""
    variable = getattr(figure, "variable", None)
    asked = ("number", "limit") if isinstance(draws, Mapping) else ()
    with_draws = any(draws.get(name, 0) not in (0, "0") for name in asked)  # type: ignore[attr-defined]
    drawn = outputs.DRAW_OUTPUTS | outputs.ERROR_OUTPUTS | outputs.ACCURACY_OUTPUTS
    known = {*outputs.OUTPUTS, *further}
    if variable is None or variable in known or (with_draws and variable in drawn):
        return
    remedy = near_miss(variable, [*known, *drawn], otherwise="write e.g. 'pd_shot' or 'snr_up'")
    rule = "is no stored quantity"
    if variable in drawn:
        rule = "is found over draws, and this study has none"
        remedy = "set draws: {number: ...} or {limit: ...}"
    elif variable in outputs.STRONGEST_OUTPUTS:
        rule = "is found where segments report their strongest peak alone"
        remedy = "set instrument.processing.peaks: strongest"
    yield Finding((*at, "variable"), rule, remedy, variable)


def _spectra_findings(figure: Any, at: Location) -> Iterator[Finding]:
    """Report closed forms that a study of whole spectra does not store."""
    stored = outputs.SPECTRA_OUTPUTS | outputs.ACCURACY_OUTPUTS | outputs.DRAW_OUTPUTS
    variable = getattr(figure, "variable", None)
    if variable is None:
        rule = "shows closed forms, which a study of whole spectra does not store"
        yield Finding((*at, "kind"), rule, "take surface, slices or table", figure.kind)
    elif variable not in stored:
        rule = "is nothing that a study of whole spectra stores"
        yield Finding((*at, "variable"), rule, near_miss(variable, list(stored)), variable)


def _scanner_findings(figure: Any, scanners: Mapping[str, Any], at: Location) -> Iterator[Finding]:
    """Scanners that the study lacks, or of too few beams for navigation."""
    one, several = getattr(figure, "scanner", None), getattr(figure, "scanners", None) or ()
    named: dict[Location, str] = {("scanner",): one} if one else {}
    for place, name in (named | {("scanners", i): name for i, name in enumerate(several)}).items():
        if name not in scanners:
            remedy = near_miss(name, scanners, otherwise=f"it has {', '.join(scanners)}")
            yield Finding((*at, *place), "is no scanner of this study", remedy, name)
    if isinstance(figure, NavigationFigure | NavigationTable):
        able = {name: _navigates(scanner) for name, scanner in scanners.items()}
        for i, name in enumerate(figure.scanners or ()):
            if able.get(name, True) is False:
                rule = f"has fewer than {LEAST_BEAMS} shots a cycle, and no navigation"
                yield Finding((*at, "scanners", i), rule, "leave it out", name)
        if not figure.scanners and able and not any(able.values()):
            rule = f"needs a scanner of {LEAST_BEAMS} shots a cycle or more"
            yield Finding(at, rule, "leave it out")


def _navigates(written: object) -> bool:
    """Return true if a scanner has enough shots a cycle for navigation, or can't be read."""
    scanner = read_as(AnyScanner, written)
    try:
        return scanner is None or shots_a_cycle(scanner.pattern()) >= LEAST_BEAMS
    except ValueError:
        return True


def _draw_findings(figure: Any, written: object, at: Location) -> Iterator[Finding]:
    """Report a draw that the study does not make; none where its draws can't be read."""
    draw, draws = getattr(figure, "draw", 0), read_as(SceneDraws, written or {})
    if draws is not None and draw >= draws.number:
        rule = f"is beyond the study's draws, 0 to {draws.number - 1}"
        yield Finding((*at, "draw"), rule, "take one of them", draw)
