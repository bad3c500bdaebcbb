"""Sections of a spec that declare its figures and tables, of grids and of scenes.

The checks in this module compare a figure with its study: coordinates, stored quantities, scanners
and draws.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

import sweep.spec.fields as declare
from sweep.model import outputs
from sweep.spec.axes import Axis
from sweep.spec.fields import SpecSection, validate_or_none
from sweep.spec.flight_sections import AnyScanner, shots_per_cycle
from sweep.spec.rules import ChoiceRule, CustomRule, Finding, SpecLocation, suggest_similar_name
from sweep.spec.scene_sections import SceneDraws
from sweep.spec.sections import SPECTRA_METHOD, parameter_rules
from sweep.units import QuantityError, read_number

CoordinateSelection = str | int | float | tuple[str | int | float, ...]
"""Value of a coordinate as written in a spec, or several values in a tuple."""
PublishedNumbers = tuple[Any, ...]
"""Numbers from a publication as SI values, in nested tuples, for comparison with results."""
CropLimits = tuple[float, ...]
"""Least and greatest value of a coordinate [m], or of time [s], that a figure shows."""


def _read_coordinate_selection(raw_value: object) -> dict[str, CoordinateSelection]:
    """Check a dict of values, or lists of values, by coordinate; return a dict of the same values.

    Lists become tuples. Raise `QuantityError` if the dict is invalid.
    """
    if not isinstance(raw_value, dict):
        problem = "must be a mapping of coordinates to values"
        raise QuantityError(problem, "write e.g. {grazing_angle: 15 deg}")
    return {
        str(name): tuple(map(_read_selected_value, value))
        if value and isinstance(value, list | tuple)
        else _read_selected_value(value)
        for name, value in raw_value.items()
    }


def _read_selected_value(raw_value: object) -> str | int | float:
    """Return a coordinate's value as written; raise `QuantityError` if it is no text or number."""
    if isinstance(raw_value, bool) or not isinstance(raw_value, str | int | float):
        raise QuantityError("must hold a value, or a list of values, of each coordinate")
    return raw_value


def _read_published_numbers(raw_value: object) -> PublishedNumbers:
    """Convert nested lists of numbers as written to nested tuples of SI values."""
    if not isinstance(raw_value, list | tuple):
        raise QuantityError("must be a list of numbers or of rows of numbers")
    return tuple(
        _read_published_numbers(raw_element)
        if isinstance(raw_element, list | tuple)
        else _read_published_number(raw_element)
        for raw_element in raw_value
    )


def _read_published_number(raw_value: object) -> float:
    """Convert one number as written, such as ``5 %``, to a float."""
    return read_number(raw_value).to_si()


_COORDINATE_VALUE_SCHEMA = {"type": ["string", "number"]}
_COORDINATE_VALUES_SCHEMA = {"type": "array", "items": _COORDINATE_VALUE_SCHEMA, "minItems": 1}
_COORDINATE_SELECTION_RULE = CustomRule(
    description="Values of coordinates that the figure is confined to",
    reader=_read_coordinate_selection,
    value_schema={
        "type": "object",
        "additionalProperties": {"anyOf": [_COORDINATE_VALUE_SCHEMA, _COORDINATE_VALUES_SCHEMA]},
        "examples": [{"grazing_angle": "15 deg"}],
    },
)
_PUBLISHED_NUMBER_SCHEMA = {"type": ["number", "string"]}
_PUBLISHED_NUMBERS_RULE = CustomRule(
    description="Published numbers, row by row, for comparison",
    reader=_read_published_numbers,
    value_schema={
        "type": "array",
        "items": {
            "anyOf": [
                _PUBLISHED_NUMBER_SCHEMA,
                {"type": "array", "items": _PUBLISHED_NUMBER_SCHEMA},
            ]
        },
    },
)


def _store_array_name_field(description: str, example: str, default: Any = ...) -> Any:
    """Return the declaration of a field for the name of a coordinate or variable of a store."""
    pattern = r"[A-Za-z_][A-Za-z0-9_]{0,99}"
    return declare.text_field(
        f"Name of {description}", default, pattern=pattern, remedy=f"take {example}"
    )


def _coordinate_name_field(default: Any = ...) -> Any:
    """Return the declaration of a field for the name of a coordinate of a store."""
    example = "the last part of an axis's path, such as 'range'"
    return _store_array_name_field(
        "a coordinate: the last part of an axis's path", example, default
    )


_VARIABLE_NAME_FIELD = _store_array_name_field(
    "a stored quantity, such as pd_shot", "a stored quantity, such as 'pd_shot'"
)


class FigureBase(SpecSection):
    """Base of all figures and tables."""

    FILE_NAME_PARTS: ClassVar[tuple[str, ...]] = ()
    """Names of the fields whose values, joined by underscores, make up the figure's file name.

    A text in the tuple that names no field is itself a part of the file name.
    """

    name: str = declare.text_field(
        "Stem of the picture's file name",
        "",
        pattern=r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}",
        remedy="take letters, digits, '_', '-' and '.'",
    )
    title: str = declare.text_field("Title of the figure", "")

    @property
    def file_stem(self) -> str:
        """File name without suffix: `name`, or if it is empty, `FILE_NAME_PARTS` and ``kind``."""
        words = [
            getattr(self, name_part, name_part) for name_part in (*self.FILE_NAME_PARTS, "kind")
        ]
        return self.name or "_".join(str(name_part) for name_part in words if name_part is not None)


# Figures of grids


class GridFigureBase(FigureBase):
    """Base of all figures of grids."""


_CONTOUR_LEVEL_RULE = declare.quantity_rule(
    "Level, in the quantity's unit", "", "0.9", "-1e30", "1e30"
)


class SurfaceFigure(GridFigureBase):
    """Map of a quantity over two coordinates."""

    FILE_NAME_PARTS = ("variable",)
    kind: Literal["surface"]
    variable: str = _VARIABLE_NAME_FIELD
    x: str = _coordinate_name_field()
    y: str = _coordinate_name_field()
    where: dict[str, CoordinateSelection] = declare.field_with_rule(_COORDINATE_SELECTION_RULE, {})
    levels: tuple[float, ...] = declare.list_field(
        _CONTOUR_LEVEL_RULE,
        1,
        10,
        (),
        description="Levels at which contours are drawn",
        is_increasing=True,
    )


class SlicesFigure(GridFigureBase):
    """Curves of a quantity along one coordinate, one for each value of another coordinate."""

    FILE_NAME_PARTS = ("variable",)
    kind: Literal["slices"]
    variable: str = _VARIABLE_NAME_FIELD
    x: str = _coordinate_name_field()
    by: str = _coordinate_name_field("")
    where: dict[str, CoordinateSelection] = declare.field_with_rule(_COORDINATE_SELECTION_RULE, {})
    levels: tuple[float, ...] = declare.list_field(
        _CONTOUR_LEVEL_RULE,
        1,
        10,
        (),
        description="Levels at which lines are drawn across",
        is_increasing=True,
    )


class TableFigure(GridFigureBase):
    """Table of a quantity, averaged over all coordinates except those of rows and columns."""

    FILE_NAME_PARTS = ("variable",)
    kind: Literal["table"]
    variable: str = _VARIABLE_NAME_FIELD
    rows: str = _coordinate_name_field()
    columns: str = _coordinate_name_field("")
    where: dict[str, CoordinateSelection] = declare.field_with_rule(_COORDINATE_SELECTION_RULE, {})
    minimum_range: float = declare.length_field(
        "Nearer ranges are left out", "5 m", "0 m", "1e15 m", default=0.0
    )
    printed: PublishedNumbers = declare.field_with_rule(_PUBLISHED_NUMBERS_RULE, ())


class FalseAlarmTable(GridFigureBase):
    """Table of the false alarms of a shot over the three cuts of Tables 4.3 to 4.5.

    Rows are the values of one coordinate. Columns are the cuts at 15 deg, 85 deg and 3500 m; ranges
    up to 5 m are left out.
    """

    kind: Literal["false_alarm_table"]
    by: str = _coordinate_name_field()
    printed: PublishedNumbers = declare.field_with_rule(_PUBLISHED_NUMBERS_RULE, ())


class ThresholdTable(GridFigureBase):
    """Table of the false alarms of a bin by threshold, as in Table 4.2."""

    kind: Literal["threshold_table"]
    by: str = _coordinate_name_field("tnr")
    printed: PublishedNumbers = declare.field_with_rule(_PUBLISHED_NUMBERS_RULE, ())


GridFigure = Annotated[
    SurfaceFigure | SlicesFigure | TableFigure | FalseAlarmTable | ThresholdTable,
    Field(discriminator="kind"),
]

# Figures of scenes

_PLOTTABLE_OUTPUTS = (
    outputs.SHOT_GEOMETRY_VARIABLES
    | outputs.SHOT_STATISTIC_VARIABLES
    | outputs.POINT_CLOUD_VARIABLES
)
SCENE_FIGURE_QUANTITIES = (
    *(name for name, output in _PLOTTABLE_OUTPUTS.items() if outputs.XYZ_DIM not in output.dims),
    "altitude", "x", "y", "z", "shot",
)  # fmt: skip
"""Names of the quantities of shots and of points that a figure of a scene can show."""

SHOT_WITH_SEVERAL_SURFACES_KEYWORD = "several_surfaces"
"""Word for the field ``shot`` of a figure: the first shot whose footprint has several surfaces."""
_VIEW_DIRECTION_RULE = ChoiceRule(
    description="Direction from which the cloud is seen",
    options=("oblique", "above", "side", "front"),
)
_EYE_ANGLE_RULES = {
    "azimuth": declare.quantity_rule("Azimuth of the eye, from x towards y", "rad", "-60 deg"),
    "elevation": declare.quantity_rule(
        "Elevation of the eye above the horizon", "rad", "30 deg", "-90 deg", "90 deg"
    ),
}


def _read_view_direction(raw_value: object) -> str | dict[str, float]:
    """Return the direction of view: a word as written, or azimuth and elevation of the eye [rad].

    Raise `QuantityError` if the value as written is invalid.
    """
    if not isinstance(raw_value, dict):
        return _VIEW_DIRECTION_RULE.read(raw_value)
    if set(raw_value) != set(_EYE_ANGLE_RULES):
        problem = "must be a word or have an azimuth and an elevation"
        raise QuantityError(problem, "write e.g. {azimuth: -60 deg, elevation: 30 deg}")
    return {name: problem.read(raw_value[name]) for name, problem in _EYE_ANGLE_RULES.items()}


_VIEW_RULE = CustomRule(
    description=_VIEW_DIRECTION_RULE.description,
    reader=_read_view_direction,
    value_schema={
        "anyOf": [
            {"type": "string", "enum": list(_VIEW_DIRECTION_RULE.options)},
            {
                "type": "object",
                "properties": {name: rule.schema() for name, rule in _EYE_ANGLE_RULES.items()},
                "required": list(_EYE_ANGLE_RULES),
                "additionalProperties": False,
            },
        ]
    },
)


def _plotted_quantity_field(description: str, default: Any = ...) -> Any:
    """Return the declaration of a field for the name of a quantity of shots or points to plot."""
    remedy = "take range, radial_velocity, snr, pd, surface, beam, time or altitude"
    problem = "is no quantity of shots or points"
    return declare.field_with_rule(
        ChoiceRule(
            description=description, options=SCENE_FIGURE_QUANTITIES, problem=problem, remedy=remedy
        ),
        default,
    )


def _crop_limits_field(axis: str) -> Any:
    """Return the declaration of a field for the two limits of a coordinate that is shown [m]."""
    rule = declare.quantity_rule("Coordinate", "m", "100 m")
    return declare.list_field(
        rule, 2, 2, None, description=f"Part along {axis}", is_increasing=True
    )


_SCANNER_NAME_FIELD = declare.object_name_field("Scanner; the first by default", None)
_RANGE_INTERPOLATION_FIELD = declare.choice_field(
    "Range shown for each point: quantised to FFT bins, or interpolated between bins",
    ("quantised", "interpolated"),
)
_DRAW_NUMBER_FIELD = declare.integer_field("Number of the draw, from 0", "0", "0", "1e9", default=0)
_TIME_LIMITS_FIELD = declare.list_field(
    declare.quantity_rule("Time", "s", "10 s", "0 s", "1e8 s"), 2, 2, None,
    description="Part of the flight's time", is_increasing=True,
)  # fmt: skip


class SceneFigureBase(FigureBase):
    """Base of all figures of scenes."""

    where: dict[str, CoordinateSelection] = declare.field_with_rule(_COORDINATE_SELECTION_RULE, {})


class CloudFigure(SceneFigureBase):
    """Picture of a point cloud."""

    FILE_NAME_PARTS = ("scanner", "colour")
    kind: Literal["cloud"]
    scanner: str | None = _SCANNER_NAME_FIELD
    colour: str = _plotted_quantity_field("Quantity that colours the points", "range")
    ranges: str = _RANGE_INTERPOLATION_FIELD
    view: str | dict[str, float] = declare.field_with_rule(_VIEW_RULE, "oblique")
    x: CropLimits | None = _crop_limits_field("x")
    y: CropLimits | None = _crop_limits_field("y")
    z: CropLimits | None = _crop_limits_field("z")
    time: CropLimits | None = _TIME_LIMITS_FIELD
    terrain: bool = declare.flag_field("Whether to draw the ground", default=True)
    path: bool = declare.flag_field("Whether to draw the flight path", default=False)
    dropouts: bool = declare.flag_field("Whether to mark shots without a point", default=False)
    draw: int = _DRAW_NUMBER_FIELD


class ScatterFigure(SceneFigureBase):
    """Scatter plot of one quantity of shots or points over another."""

    FILE_NAME_PARTS = ("scanner", "y", "over", "x")
    kind: Literal["scatter"]
    scanner: str | None = _SCANNER_NAME_FIELD
    x: str = _plotted_quantity_field("Quantity along x", "time")
    y: str = _plotted_quantity_field("Quantity along y")
    colour: str = _plotted_quantity_field("Quantity that colours the points", "beam")
    ranges: str = _RANGE_INTERPOLATION_FIELD
    time: CropLimits | None = _TIME_LIMITS_FIELD
    draw: int = _DRAW_NUMBER_FIELD


class ShotSpectraFigure(SceneFigureBase):
    """Spectra of the three segments of a shot, with threshold, noise and detections."""

    FILE_NAME_PARTS = ("scanner", "shot")
    kind: Literal["shot_spectra"]
    scanner: str | None = _SCANNER_NAME_FIELD
    shot: int | str = declare.integer_field(
        "Number of the shot, from 0, or the first whose footprint has several surfaces",
        "0", "0", "1e15", keyword=SHOT_WITH_SEVERAL_SURFACES_KEYWORD,
        default=SHOT_WITH_SEVERAL_SURFACES_KEYWORD,
    )  # fmt: skip
    draw: int = _DRAW_NUMBER_FIELD


class _NavigationFigureBase(SceneFigureBase):
    """Base of the figure and the table of navigation."""

    FILE_NAME_PARTS = ("quantity", "show")
    scanners: tuple[str, ...] | None = declare.list_field(
        declare.object_name_rule("Scanner", "three"), 1, 10_000, None,
        description="Scanners; all by default", element_noun="names", is_distinct=True,
    )  # fmt: skip
    quantity: str = declare.choice_field("Velocity vector or altitude", ("velocity", "altitude"))
    show: str = declare.choice_field("Statistics to show", ("all", "availability", "bias", "rmse"))
    bins: int = declare.integer_field("Bins of altitude", "12", "1", "1000", default=12)


class NavigationFigure(_NavigationFigureBase):
    """Curves of the statistics of navigation over altitude, one for each scanner."""

    kind: Literal["navigation"]


class NavigationTable(_NavigationFigureBase):
    """Table of the statistics of navigation over altitude."""

    kind: Literal["navigation_table"]


SceneFigure = Annotated[
    CloudFigure | ScatterFigure | ShotSpectraFigure | NavigationFigure | NavigationTable,
    Field(discriminator="kind"),
]

# Checks of figures

_COORDINATE_FIELD_NAMES = ("x", "y", "by", "rows", "columns")
"""Names of the fields of a grid's figures that hold the name of a coordinate."""

NAVIGATION_SHOTS_PER_CYCLE_MIN = 3
"""Smallest number of shots in a measurement cycle from which a velocity vector can be computed."""


def grid_figure_findings(
    raw_spec: Mapping[str, Any], axes: tuple[Axis, ...], extra_variables: Collection[str] = ()
) -> Iterator[Finding]:
    """Yield a `Finding` for each mistake in the figures of a grid's spec.

    Parameters
    ----------
    raw_spec : Mapping
        Spec as parsed from YAML.
    axes : tuple of Axis
        Axes of the study.
    extra_variables : Collection of str
        Variables that the study stores in addition to `outputs.GRID_OUTPUTS`.

    Yields
    ------
    Finding
        One mistake. Figures that can't be read are skipped; their fields have findings already.
    """
    draws = raw_spec.get("draws")
    for location, figure in _iter_readable_figures(raw_spec, GridFigure):
        yield from _figure_coordinate_findings(figure, axes, location)
        if isinstance(draws, Mapping) and draws.get("method") == SPECTRA_METHOD:
            yield from _spectra_variable_findings(figure, location)
        else:
            yield from _figure_variable_findings(figure, draws, extra_variables, location)
    yield from _duplicate_file_name_findings(
        raw_spec, GridFigure, "makes the same picture file as another"
    )


def scene_figure_findings(
    raw_spec: Mapping[str, Any], axes: tuple[Axis, ...] | None
) -> Iterator[Finding]:
    """Yield a `Finding` for each mistake in the figures of a scene's spec.

    Parameters
    ----------
    raw_spec : Mapping
        Spec as parsed from YAML.
    axes : tuple of Axis or None
        Axes of the study; None if they can't be read, which skips the checks of coordinates.

    Yields
    ------
    Finding
        One mistake. Figures that can't be read are skipped; their fields have findings already.
    """
    scanners = raw_spec.get("scanners")
    scanners = scanners if isinstance(scanners, Mapping) else {}
    for location, figure in _iter_readable_figures(raw_spec, SceneFigure):
        yield from _figure_scanner_findings(figure, scanners, location)
        yield from () if axes is None else _figure_coordinate_findings(figure, axes, location)
        yield from _draw_number_findings(figure, raw_spec.get("draws"), location)
    yield from _duplicate_file_name_findings(
        raw_spec, SceneFigure, "makes the same file as another"
    )


def _iter_readable_figures(
    raw_spec: Mapping[str, Any], annotation: Any
) -> Iterator[tuple[SpecLocation, Any]]:
    """Yield a pair (location, model) for each figure of a spec that can be read."""
    figures = raw_spec.get("figures")
    for i, raw_figure in enumerate(figures if isinstance(figures, list | tuple) else ()):
        if (figure := validate_or_none(annotation, raw_figure)) is not None:
            yield ("figures", i), figure


def _duplicate_file_name_findings(
    raw_spec: Mapping[str, Any], annotation: Any, problem: str
) -> Iterator[Finding]:
    """Yield a `Finding` for each figure with the same file name as an earlier figure."""
    stems: set[str] = set()
    for location, figure in _iter_readable_figures(raw_spec, annotation):
        if figure.file_stem in stems:
            yield Finding(location, f"{problem}, {figure.file_stem}", "give it a name")
        stems.add(figure.file_stem)


def _figure_coordinate_findings(
    figure: Any, axes: tuple[Axis, ...], figure_location: SpecLocation
) -> Iterator[Finding]:
    """Yield a `Finding` for each unknown coordinate of a figure, and for each wrong value of one.

    A figure of a scene may select only one value of a coordinate.
    """
    is_grid_figure = isinstance(figure, GridFigureBase)
    coordinate_names = (
        {field: getattr(figure, field, "") for field in _COORDINATE_FIELD_NAMES}
        if is_grid_figure
        else {}
    )
    selection = getattr(figure, "where", {})
    paths = {
        parameter.coordinate_name: parameter.path for axis in axes for parameter in axis.parameters
    }
    known_names = list(dict.fromkeys([*paths, *(axis.name for axis in axes if is_grid_figure)]))
    for field, name in (coordinate_names | {f"where.{name}": name for name in selection}).items():
        location: SpecLocation = (*figure_location, *field.split("."))
        values = selection[name] if field.startswith("where.") else ()
        if name and name not in known_names:
            remedy = (
                f"the coordinates are {', '.join(known_names)}" if known_names else "it has no axes"
            )
            suggestion = suggest_similar_name(name, known_names, fallback=remedy)
            if field in coordinate_names and field not in figure.model_fields_set:
                problem = f"is '{name}' by default, which is no coordinate of this study"
                yield Finding(location, problem, suggestion)
            else:
                yield Finding(location, "is no coordinate of this study", suggestion, name)
        elif isinstance(values, tuple) and values and not is_grid_figure:
            yield Finding(location, "must be one value", "make a figure for each")
        elif name in paths:
            for value in values if isinstance(values, tuple) else (values,):
                try:
                    parameter_rules()[paths[name]].read(value)
                except QuantityError as error:
                    yield Finding(location, error.rule, error.suggestion, value)


def _figure_variable_findings(
    figure: Any, draws: object, extra_variables: Collection[str], location: SpecLocation
) -> Iterator[Finding]:
    """Yield a `Finding` if a figure of a grid shows a variable that the study does not store."""
    variable = getattr(figure, "variable", None)
    amount_fields = ("number", "limit") if isinstance(draws, Mapping) else ()
    has_draws = any(draws.get(name, 0) not in (0, "0") for name in amount_fields)  # type: ignore[attr-defined]
    draw_variables = (
        outputs.DRAW_COUNT_OUTPUTS | outputs.STANDARD_ERROR_OUTPUTS | outputs.ACCURACY_OUTPUTS
    )
    known_variables = {*outputs.GRID_OUTPUTS, *extra_variables}
    if (
        variable is None
        or variable in known_variables
        or (has_draws and variable in draw_variables)
    ):
        return
    remedy = suggest_similar_name(
        variable, [*known_variables, *draw_variables], fallback="write e.g. 'pd_shot' or 'snr_up'"
    )
    problem = "is no stored quantity"
    if variable in draw_variables:
        problem = "is found over draws, and this study has none"
        remedy = "set draws: {number: ...} or {limit: ...}"
    elif variable in outputs.STRONGEST_PEAK_OUTPUTS:
        problem = "is found where segments report their strongest peak alone"
        remedy = "set instrument.processing.peaks: strongest"
    yield Finding((*location, "variable"), problem, remedy, variable)


def _spectra_variable_findings(figure: Any, location: SpecLocation) -> Iterator[Finding]:
    """Yield a `Finding` if a figure shows what a study of whole spectra does not store."""
    stored_variables = (
        outputs.SPECTRA_STUDY_OUTPUTS | outputs.ACCURACY_OUTPUTS | outputs.DRAW_COUNT_OUTPUTS
    )
    variable = getattr(figure, "variable", None)
    if variable is None:
        problem = "shows closed forms, which a study of whole spectra does not store"
        yield Finding((*location, "kind"), problem, "take surface, slices or table", figure.kind)
    elif variable not in stored_variables:
        problem = "is nothing that a study of whole spectra stores"
        yield Finding(
            (*location, "variable"),
            problem,
            suggest_similar_name(variable, list(stored_variables)),
            variable,
        )


def _figure_scanner_findings(
    figure: Any, scanners: Mapping[str, Any], location: SpecLocation
) -> Iterator[Finding]:
    """Yield a `Finding` for each unknown scanner of a figure, and for too few shots per cycle.

    A figure of navigation needs a scanner with three or more shots per cycle.
    """
    single_scanner, listed_scanners = (
        getattr(figure, "scanner", None),
        getattr(figure, "scanners", None) or (),
    )
    names_by_location: dict[SpecLocation, str] = (
        {("scanner",): single_scanner} if single_scanner else {}
    )
    for relative_location, name in (
        names_by_location | {("scanners", i): name for i, name in enumerate(listed_scanners)}
    ).items():
        if name not in scanners:
            remedy = suggest_similar_name(name, scanners, fallback=f"it has {', '.join(scanners)}")
            yield Finding(
                (*location, *relative_location), "is no scanner of this study", remedy, name
            )
    if isinstance(figure, NavigationFigure | NavigationTable):
        has_navigation = {name: _allows_navigation(scanner) for name, scanner in scanners.items()}
        for i, name in enumerate(figure.scanners or ()):
            if has_navigation.get(name, True) is False:
                problem = (
                    f"has fewer than {NAVIGATION_SHOTS_PER_CYCLE_MIN} shots a cycle, and no "
                    "navigation"
                )
                yield Finding((*location, "scanners", i), problem, "leave it out", name)
        if not figure.scanners and has_navigation and not any(has_navigation.values()):
            problem = f"needs a scanner of {NAVIGATION_SHOTS_PER_CYCLE_MIN} shots a cycle or more"
            yield Finding(location, problem, "leave it out")


def _allows_navigation(raw_scanner: object) -> bool:
    """Return True if a scanner has enough shots per cycle for a velocity, or can't be read.

    `raw_scanner` is the scanner's section as parsed from YAML.
    """
    scanner = validate_or_none(AnyScanner, raw_scanner)
    try:
        return (
            scanner is None
            or shots_per_cycle(scanner.build_pattern()) >= NAVIGATION_SHOTS_PER_CYCLE_MIN
        )
    except ValueError:
        return True


def _draw_number_findings(
    figure: Any, raw_draws: object, location: SpecLocation
) -> Iterator[Finding]:
    """Yield a `Finding` if a figure shows a draw whose number is not below the number of draws.

    There is no finding if the section ``draws`` can't be read.
    """
    draw, draws = getattr(figure, "draw", 0), validate_or_none(SceneDraws, raw_draws or {})
    if draws is not None and draw >= draws.number:
        problem = f"is beyond the study's draws, 0 to {draws.number - 1}"
        yield Finding((*location, "draw"), problem, "take one of them", draw)
