"""Specs of studies: `GridSpec` for a grid over a flat target, `SceneSpec` for a flight.

`load` reads a spec from a YAML file and reports every mistake in it at once.
"""

from __future__ import annotations

import copy
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from pydantic import ConfigDict, Field, PrivateAttr, ValidationError

import sweep.spec.fields as declare
import sweep.spec.scene_sections as scene_sections
import sweep.spec.sections as sections
from sweep.model import MODEL_VERSION, beam, error_budget, waveform
from sweep.model.beamlet_counts import BEAMLETS_PATH, beamlets_converge, initial_ray_count
from sweep.model.detection import looks
from sweep.model.effects import circulator_leak
from sweep.model.ground import beamlet_pattern as beamlet_pattern
from sweep.model.outputs import STRONGEST_PEAK_OUTPUTS
from sweep.model.threshold import THRESHOLD_PATHS
from sweep.model.waveform import SEARCH_BAND_PATHS
from sweep.safe_json import parse_json
from sweep.spec.axes import (
    Axis,
    AxisParameter,
    axis_identity,
    first_values_on_axes,
    read_axes,
    read_in_unit,
    remove_fields_on_axes,
)
from sweep.spec.fields import (
    SpecFiles,
    SpecSection,
    identity_digest,
    iter_file_fields,
    iter_section_values,
    set_if_absent,
    validate_or_none,
    values_by_path,
)
from sweep.spec.figure_sections import (
    NAVIGATION_SHOTS_PER_CYCLE_MIN,
    GridFigure,
    SceneFigure,
    grid_figure_findings,
    scene_figure_findings,
)
from sweep.spec.flight_sections import AnyScanner, Platform, shots_per_cycle
from sweep.spec.grid_checks import (
    GridValues,
    ValueCondition,
    flight_effect_findings,
    grid_findings,
    is_detector_or_estimator_parameter,
    raw_value_at,
    spectrum_method_findings,
    undrawn_effect_findings,
)
from sweep.spec.ground_sections import OPTICAL_FIELDS
from sweep.spec.rules import (
    CustomRule,
    Finding,
    Mistake,
    NumericRule,
    Rule,
    SpecError,
    SpecLocation,
    dotted_path,
    format_raw_value,
)
from sweep.spec.scene_checks import (
    axis_refusal,
    scene_axis_findings,
    scene_findings,
    variation_findings,
)
from sweep.spec.yaml_document import (
    Document,
    InstrumentErrorFloor,
    drop_anchor_sections,
    missing_instrument_remedy,
    parse_document,
    read_document,
    resolve_instrument,
    to_plain_data,
    validation_findings,
)
from sweep.units import QuantityError

if TYPE_CHECKING:
    from sweep.model.geometry.body_motion import MovingBody
    from sweep.model.geometry.mesh import SurfaceMaterial
    from sweep.model.geometry.scanner import PointingJitter, ScanPattern


GRID_POINTS_MAX = 10**15
"""Largest number of points of a study's grid."""
LINE_DRIFT_WARNING_BINS = 2.0
"""Drift of a spectral line within a record, due to acceleration, above which users are warned
[bins].

The line is that of an echo in developed speckle. With more drift, the stated standard errors are
too small.
"""

_N_ACCELERATION_SAMPLES = 1000
"""Number of times in a flight at which the platform's acceleration is computed."""

FILE_DIGESTS_KEY = "files"
"""Key in the JSON of a stored spec that holds the digests of files, by path."""
_SECTIONS_WITHOUT_DEFAULTS = ("question", "execution", "axes", "figures")
"""Sections in which `to_yaml_mapping` has only the fields that the user stated, and no defaults."""
_AXES_RULE = CustomRule(description="What varies", reader=lambda axes: axes)
"""Rule of the field `axes` that accepts any value: `read_axes` checks the axes beforehand."""


class BaseSpec(SpecSection):
    """Base of specs: a study as the user declared it, with every value read and checked.

    `load` makes a spec from a file, `from_mapping` from plain data. Values are in SI units.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", ignored_types=(cached_property,))

    title: str = declare.text_field("Title of the study")
    question: str = declare.text_field("The question that the study answers", "")
    instrument: sections.Instrument
    atmosphere: sections.Atmosphere = sections.Atmosphere()
    footprint: sections.Footprint = sections.Footprint()
    effects: sections.Effects = sections.Effects()
    accuracy: sections.Accuracy = sections.Accuracy()
    seed: int = declare.seed_field("Seed of all random draws")
    execution: sections.Execution = sections.Execution()
    axes: tuple[Axis, ...] = declare.field_with_rule(_AXES_RULE, ())

    _yaml_mapping: dict[str, Any] = PrivateAttr(default_factory=dict)
    """The spec with all its defaults as nested dicts, with values as a user would write them."""
    _base_folder: Path = PrivateAttr(default=Path())
    """Folder that relative paths in the spec refer to."""
    _file_digests: dict[str, str] = PrivateAttr(default_factory=dict)
    """Digest of each file's content, by the file's path as written in the spec."""
    _instrument_error_floor: InstrumentErrorFloor | None = PrivateAttr(default=None)
    """Fields of the section error_floor that come from the instrument; None if there are none."""

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any], *, base: Path | str = ".") -> Self:
        """Make a spec from nested dicts whose values are written as in a YAML file.

        Parameters
        ----------
        mapping : Mapping
            Content of a spec file; not changed.
        base : Path or str
            Folder that paths in `mapping` are relative to.

        Returns
        -------
        GridSpec or SceneSpec
            Spec of the class on which this method is called.

        Raises
        ------
        SpecError
            The error holds every mistake in the data.
        """
        if not isinstance(mapping, Mapping):
            raise SpecError([Mistake("", "must be a mapping", format_raw_value(mapping))])
        document = Document.from_plain_data(drop_anchor_sections(to_plain_data(mapping)))
        return cls.from_document(document, Path(base))

    @classmethod
    def from_stored(cls, json_text: str, base: Path | str | None = None) -> Self:
        """Make a spec from JSON text that `to_json` returned.

        The spec equals the original, except for ``execution``, which is not stored. Files that the
        spec names are not read.

        Parameters
        ----------
        json_text : str
            Text from `to_json`.
        base : Path or str, optional
            Folder that paths in the spec are relative to; the current folder by default.

        Raises
        ------
        SpecError
            If the text is no valid spec.
        """
        raw_spec = to_plain_data(parse_json(json_text))
        if not isinstance(raw_spec, dict):
            raise SpecError([Mistake("", "must be a mapping", format_raw_value(raw_spec))])
        digests = raw_spec.pop(FILE_DIGESTS_KEY, {})
        spec = cls.from_document(Document(raw_spec), None)
        spec._base_folder, spec._file_digests = Path(base or "."), digests
        return spec

    @classmethod
    def from_document(cls, document: Document, base: Path | None) -> Self:
        """Make a spec from a `Document`, a spec as read with the lines of its values.

        Parameters
        ----------
        document : Document
            Spec as read from YAML or plain data; changed by this method.
        base : Path or None
            Folder that paths in the spec are relative to. None for the document of a store: its
            files are not read, and a field's value need not be among the values of its axis.

        Raises
        ------
        SpecError
            The error holds every mistake in the document.
        """
        user_values = {} if base is None else _user_values_on_axes(document.content)
        takes_floor = "error_floor" in cls.model_fields
        is_instrument_resolved = resolve_instrument(
            document, base or Path(), takes_floor=takes_floor
        )
        raw_spec = document.content
        lacks_instrument = "instrument" not in raw_spec
        filled_paths = [
            path
            for path, first_value in first_values_on_axes(raw_spec.get("axes")).items()
            if cls.may_be_on_axis(path) and set_if_absent(raw_spec, path.split("."), first_value)
        ]
        axes, findings = read_axes(raw_spec.get("axes", {}))
        all_axes_read = not findings
        spec: Self | None = None
        try:
            spec = cls.model_validate({**raw_spec, "axes": axes})
        except ValidationError as error:
            findings += validation_findings(error, cls)
        grid = GridValues.from_raw_spec(raw_spec, axes)
        findings += grid_findings(grid)
        findings += [
            *_grid_size_findings(axes),
            *_equal_chirp_rate_findings(grid),
            *_strongest_peak_findings(grid),
        ]
        findings += cls.class_specific_findings(raw_spec, grid, base, all_axes_read)
        findings += _field_axis_contradiction_findings(user_values, axes)
        # Mistakes in an axis or in an instrument's file have findings of their own: drop findings
        # for the fields that were filled in from these.
        findings = [
            finding
            for finding in findings
            if dotted_path(finding.location) not in filled_paths
            and (is_instrument_resolved or finding.location[0] != "instrument")
        ]
        if lacks_instrument and filled_paths:  # an axis has filled in part of the instrument
            findings = [finding for finding in findings if finding.location[0] != "instrument"]
            findings.insert(0, Finding(("instrument",), "is missing", missing_instrument_remedy()))
        findings = document.findings + findings
        if findings or spec is None:
            raise SpecError(document.mistakes_from_findings(findings))
        spec._yaml_mapping = spec._fill_defaults(raw_spec)
        spec._instrument_error_floor = document.instrument_error_floor
        return spec

    @classmethod
    def may_be_on_axis(cls, path: str) -> bool:
        """Return True if an axis may set the parameter at the dotted path `path`; here always."""
        return True

    @classmethod
    def class_specific_findings(
        cls, raw_spec: Mapping[str, Any], grid: GridValues, base: Path | None, all_axes_read: bool
    ) -> list[Finding]:
        """Return a `Finding` for each mistake that only this class of spec can have; here none.

        Parameters
        ----------
        raw_spec : Mapping
            Spec as parsed from YAML.
        grid : GridValues
            Parameter values over the grid.
        base : Path or None
            Folder that paths in the spec are relative to; None skips checks that read files.
        all_axes_read : bool
            False if some axes can't be read, and are missing in `grid`.
        """
        return []

    def parameters(self) -> dict[str, float | int | str]:
        """Return the SI values of all parameters (fields that axes may set) by dotted path.

        The value of a parameter on an axis is that of its field. If the spec does not state the
        field, the value is the first one on the axis.
        """
        return {
            path: value
            for section in sections.MODEL_BY_SECTION
            if section in type(self).model_fields
            for path, value in values_by_path(getattr(self, section), (section,)).items()
        }

    def effect_modes(self) -> dict[str, str]:
        """Return the mode of each effect (`auto`, `on` or `off`), by the effect's name."""
        return values_by_path(self.effects)

    def parameters_with_overrides(
        self, overrides: Mapping[str, object]
    ) -> dict[str, float | int | str]:
        """Return the SI values of all parameters, with new values for some of them.

        Parameters
        ----------
        overrides : Mapping
            Values as written in a spec, by dotted path or its last part: ``{"range": "2 km"}``.

        Returns
        -------
        dict
            SI values of all parameters by dotted path.

        Raises
        ------
        SpecError
            The error holds every mistake in the values and in their combination.
        """
        parameters = self.parameters()
        findings = []
        for name, raw_value in overrides.items():
            path, rule = _find_parameter(
                name, parameters | dict.fromkeys((*THRESHOLD_PATHS, *SEARCH_BAND_PATHS))
            )
            if rule is None:
                suggestion = sections.suggest_parameter(name, parameters)
                findings.append(Finding((name,), "is no parameter", suggestion))
                continue
            try:
                if path in THRESHOLD_PATHS:  # a spec has one field for the threshold
                    parameters = {
                        other_path: other_value
                        for other_path, other_value in parameters.items()
                        if other_path not in THRESHOLD_PATHS
                    }
                parameters[path] = rule.read(raw_value)
            except QuantityError as error:
                findings.append(Finding((name,), error.rule, error.suggestion, raw_value))
            findings += self.override_findings(path, parameters[path], (name,))
        if not findings:
            grid = GridValues(parameters, effect_modes=self.effect_modes())
            findings = [*grid_findings(grid), *_strongest_peak_findings(grid)]
        if findings:
            raise SpecError(Document({}).mistake_from_finding(finding) for finding in findings)
        return parameters

    def override_findings(self, path: str, value: object, location: SpecLocation) -> list[Finding]:
        """Return a `Finding` for each reason why a parameter may not have an SI value; here none.

        `path` is the parameter's dotted path. `location` holds the keys that lead to the value in
        the spec.
        """
        return []

    def axis_parameter(self, name: str) -> AxisParameter:
        """Return the `AxisParameter` with the coordinate name or dotted path `name`.

        Raises
        ------
        KeyError
            If no axis has the parameter.
        """
        for axis in self.axes:
            for parameter in axis.parameters:
                if name in (parameter.coordinate_name, parameter.path):
                    return parameter
        raise KeyError(name)

    def read_coordinate_value(self, name: str, raw_value: object) -> float | int | str:
        """Convert a coordinate's value as written to the unit in which the axis was written.

        Parameters
        ----------
        name : str
            Coordinate's name or dotted path.
        raw_value : object
            Value as a user writes it.

        Returns
        -------
        float, int or str
            Value in the unit of `AxisParameter.units`, or a word.

        Raises
        ------
        KeyError
            If no axis has the coordinate.
        QuantityError
            If the value can't be read.
        """
        parameter = self.axis_parameter(name)
        rule = sections.parameter_rules()[parameter.path]
        if not isinstance(rule, NumericRule):
            return str(rule.read(raw_value))
        return read_in_unit(rule, raw_value, parameter.units)

    def unstated_error_sentences(self) -> list[str]:
        """Return sentences for the user on errors whose size the spec does not state; here none."""
        return []

    def identity(self) -> dict[str, Any]:
        """Return plain data in SI units that is equal for two specs of the same study.

        Title, question, figures and execution are left out, and fields that an axis overrides. The
        order of the axes matters, because it determines the layout of the arrays.
        """
        section_names = ("draws", "error_floor", "navigation", "storage")
        return {
            "model": MODEL_VERSION,
            "parameters": self.parameters_off_axes(),
            "axes": [axis_identity(axis) for axis in self.axes],
            "effects": self.effect_modes(),
            "seed": self.seed,
        } | {
            name: values_by_path(getattr(self, name))
            for name in section_names
            if name in type(self).model_fields
        }

    def parameters_off_axes(self) -> dict[str, float | int | str]:
        """Return the SI values of the parameters that no axis sets, by dotted path."""
        paths_on_axes = {parameter.path for axis in self.axes for parameter in axis.parameters}
        return {
            path: value for path, value in self.parameters().items() if path not in paths_on_axes
        }

    @cached_property
    def id(self) -> str:
        """Hash of the study's identity, 32 hexadecimal digits."""
        return identity_digest(self.identity())

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, type(self)):
            return False
        return (self._yaml_mapping, self._file_digests) == (
            other._yaml_mapping,
            other._file_digests,
        )

    def __hash__(self) -> int:
        return hash(self.id)

    def to_yaml_mapping(self) -> dict[str, Any]:
        """Return the spec as nested dicts as a user would write it, with instrument and defaults.

        Fields that an axis sets are left out, so that the result does not depend on a value that a
        user also wrote for the field. ``execution`` is left out because it changes no result.
        """
        return copy.deepcopy(self._yaml_mapping)

    def _fill_defaults(self, raw_spec: dict[str, Any]) -> dict[str, Any]:
        """Return a copy of a spec as written, with the defaults of fields that it does not state.

        The copy lacks ``execution`` and the fields that axes set.
        """
        mapping = copy.deepcopy(
            {name: value for name, value in raw_spec.items() if name != "execution"}
        )
        for path, rule, value in iter_section_values(self):
            if path[0] not in _SECTIONS_WITHOUT_DEFAULTS:
                set_if_absent(mapping, list(path), rule.format(value))
        return remove_fields_on_axes(mapping)

    def to_json(self) -> str:
        """Return the spec as JSON text for a store, with the digests of files that it names."""
        mapping = self.to_yaml_mapping() | (
            {FILE_DIGESTS_KEY: self._file_digests} if self._file_digests else {}
        )
        return json.dumps(mapping, ensure_ascii=False, allow_nan=False)


def _find_parameter(name: str, known_paths: Mapping[str, object]) -> tuple[str, Rule | None]:
    """Return dotted path and rule of the parameter that is meant by `name`.

    `name` is a dotted path or the last part of one. If it matches no path in `known_paths`, or
    several, the result is `name` itself and None.
    """
    rules = sections.parameter_rules()
    paths = [path for path in known_paths if name in (path, sections.parameter_short_name(path))]
    return (paths[0], rules[paths[0]]) if len(paths) == 1 else (name, None)


def _equal_chirp_rate_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` if the chirp rates of two segments are equal.

    Range and velocity can be separated only by segments of different chirp rates.
    """
    if grid.any_point_meets({waveform.DOWN_CHIRP_RATE_RATIO_PATH: lambda slope: slope == 1.0}):
        problem = "is the slope of the segment 'up': range and velocity need two slopes"
        yield grid.make_finding(
            waveform.DOWN_CHIRP_RATE_RATIO_PATH, problem, "write another, or -1 for a triangle"
        )
    any_two_condition: dict[str, ValueCondition] = {
        waveform.SHOT_DETECTION_PATH: lambda rule: rule == waveform.ANY_TWO
    }
    slopes = {1.0, *grid.parameter_values(waveform.DOWN_CHIRP_RATE_RATIO_PATH)}
    if grid.any_point_meets(
        any_two_condition
        | {
            waveform.DOPPLER_CHIRP_RATE_RATIO_PATH: lambda doppler_slopes: np.isin(
                doppler_slopes, [*slopes]
            )
        }
    ):
        problem = "is another segment's too, and these two give neither range nor velocity: any_two"
        yield grid.make_finding(
            waveform.DOPPLER_CHIRP_RATE_RATIO_PATH, problem, "write another, or take both_chirps"
        )


STRONGEST_PEAK_CONDITION: dict[str, ValueCondition] = {
    waveform.REPORTED_PEAKS_PATH: lambda peaks: peaks == waveform.STRONGEST_PEAK
}
"""Condition on parameters, by dotted path: each segment reports only its strongest peak."""


def _strongest_peak_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` if only strongest peaks are reported and their probability is unknown."""
    several_looks: dict[str, ValueCondition] = {
        looks.LOOKS_NUMBER_PATH: lambda number: number > 1,
        looks.LOOKS_COMBINE_PATH: lambda combination: combination != looks.COMBINE_COHERENT,
    }
    refused_combinations: tuple[tuple[dict[str, ValueCondition], str, str], ...] = (
        (several_looks, "is that of one record, and instrument.looks.number asks for several",
         "combine: coherent"),
        ({circulator_leak.LEAK_LENGTH_PATH: lambda path: path > 0},
         "may be the line of instrument.telescope.leak_path, whose noise has no law",
         "leave the leak's path out"),
        ({waveform.SHOT_DETECTION_PATH: lambda rule: rule == waveform.ANY_TWO},
         "may be wrong in one of three segments, and shot_detection: any_two cannot show in which",
         "shot_detection: both_chirps"),
    )  # fmt: skip
    for conditions, problem, remedy in refused_combinations:
        if grid.any_point_meets(STRONGEST_PEAK_CONDITION | conditions):
            yield grid.make_finding(waveform.REPORTED_PEAKS_PATH, problem, f"take all, or {remedy}")


def _grid_size_findings(axes: tuple[Axis, ...]) -> Iterator[Finding]:
    """Yield a `Finding` if the grid of the axes has more than `GRID_POINTS_MAX` points."""
    n_points = math.prod(axis.size for axis in axes)
    if n_points > GRID_POINTS_MAX:
        problem = f"make {n_points:.3g} points, and a study has at most {GRID_POINTS_MAX:.0e}"
        yield Finding(("axes",), problem, "take fewer values")


class GridSpec(BaseSpec):
    """Spec of a study of a flat target over a grid of parameters, with all values checked.

    `load` makes a spec from a file, `from_mapping` from plain data. Values are in SI units.
    """

    target: sections.Target
    draws: sections.Draws = sections.Draws()
    storage: sections.Storage = sections.Storage()
    figures: tuple[GridFigure, ...] = Field(
        default=(), description="Figures and tables of the results"
    )

    @classmethod
    def class_specific_findings(
        cls, raw_spec: Mapping[str, Any], grid: GridValues, base: Path | None, all_axes_read: bool
    ) -> list[Finding]:
        """Return a `Finding` for each mistake in figures and draws.

        A random effect in a study without draws is a mistake.
        """
        extra_variables = (
            STRONGEST_PEAK_OUTPUTS if grid.any_point_meets(STRONGEST_PEAK_CONDITION) else ()
        )
        findings = (
            list(grid_figure_findings(raw_spec, grid.axes, extra_variables))
            if all_axes_read
            else []
        )
        draws = validate_or_none(sections.Draws, raw_spec.get("draws", {}))
        if draws is not None:
            findings += spectrum_method_findings(draws, grid)
            if draws.has_draws and grid.any_point_meets(STRONGEST_PEAK_CONDITION):
                problem = "has chances in closed form alone, and the study has draws"
                findings.append(
                    grid.make_finding(
                        waveform.REPORTED_PEAKS_PATH, problem, "take all, or no draws"
                    )
                )
            findings += () if draws.has_draws else undrawn_effect_findings(grid)
            if draws.number and draws.limit:
                problem = (
                    f"is given in addition to draws.number, {draws.number}: only one of them can "
                    "set how much to draw"
                )
                remedy = (
                    "keep limit to draw until accuracy.tolerance is met, or number to draw so many "
                    "times"
                )
                findings.append(Finding(("draws", "limit"), problem, remedy, draws.limit))
        return findings

    @cached_property
    def has_random_effects(self) -> bool:
        """True if some point of the grid may have a random effect other than noise."""
        return any(
            undrawn_effect_findings(GridValues(self.parameters(), self.axes, self.effect_modes()))
        )

    @property
    def reports_strongest_peak(self) -> bool:
        """True if segments report only their strongest peak at one point of the grid or more."""
        return GridValues(self.parameters(), self.axes).any_point_meets(STRONGEST_PEAK_CONDITION)

    def identity(self) -> dict[str, Any]:
        """Return plain data in SI units that is equal for two specs of the same study.

        Parameters of detectors and estimators are left out unless whole spectra are drawn.
        """
        identity = super().identity()
        if not self.draws.draws_whole_spectra:
            counted_parameters = {
                p: v
                for p, v in identity["parameters"].items()
                if not is_detector_or_estimator_parameter(p)
            }
            identity["parameters"] = counted_parameters
        return identity


class SceneSpec(BaseSpec):
    """Spec of a study of a flight over a scene, with all values checked.

    `load` makes a spec from a file, `from_mapping` from plain data. Values are in SI units.
    """

    scene: scene_sections.Scene
    platform: Platform
    scanners: dict[str, AnyScanner] = Field(description="Scan patterns by name")
    draws: scene_sections.SceneDraws = scene_sections.SceneDraws()
    error_floor: scene_sections.ErrorFloorSection = scene_sections.ErrorFloorSection()
    navigation: scene_sections.Navigation = scene_sections.Navigation()
    interface: scene_sections.Interface = Field(default_factory=scene_sections.Interface)
    storage: scene_sections.SceneStorage = scene_sections.SceneStorage()
    figures: tuple[SceneFigure, ...] = Field(
        default=(), description="Figures and tables of the results"
    )

    @classmethod
    def from_document(cls, document: Document, base: Path | None) -> Self:
        """Make a spec from a `Document`, and compute the digests of the files that the spec names.

        Parameters
        ----------
        document : Document
            Spec as read from YAML or plain data; changed by this method.
        base : Path or None
            Folder that paths in the spec are relative to. None for the document of a store, whose
            files are not read.

        Raises
        ------
        SpecError
            The error holds every mistake in the document.
        """
        spec = super().from_document(document, base)
        if base is not None:
            files = SpecFiles(base)
            spec._base_folder = base
            spec._file_digests = {
                field.raw_path: field.rule.compute_digest(files.resolve(field.raw_path))
                for field in iter_file_fields(spec)
            }
        return spec

    @classmethod
    def class_specific_findings(
        cls, raw_spec: Mapping[str, Any], grid: GridValues, base: Path | None, all_axes_read: bool
    ) -> list[Finding]:
        """Return a `Finding` for each mistake in scene, flight, files, effects and figures."""
        draws = (
            validate_or_none(scene_sections.SceneDraws, raw_spec.get("draws", {}))
            or scene_sections.SceneDraws()
        )
        return [
            *scene_findings(raw_spec, base),
            *scene_axis_findings(grid),
            *flight_effect_findings(grid, draws),
            *scene_figure_findings(raw_spec, grid.axes if all_axes_read else None),
        ]

    @classmethod
    def may_be_on_axis(cls, path: str) -> bool:
        """Return True if an axis may set the parameter at the dotted path `path`.

        A parameter that changes where rays hit may not be on an axis.
        """
        return not axis_refusal(path).problem

    def override_findings(self, path: str, value: object, location: SpecLocation) -> list[Finding]:
        """Return a `Finding` if an SI value of the parameter at `path` would move where rays hit.

        `location` holds the keys that lead to the value in the spec.
        """
        return variation_findings(self.parameters(), path, [value], location)

    @property
    def base_folder(self) -> Path:
        """Folder that relative paths in the spec refer to."""
        return self._base_folder

    @property
    def files(self) -> SpecFiles:
        """Files that the spec names, with the time in their tables at which the flight begins."""
        files = SpecFiles(self._base_folder, self._file_digests)
        return replace(files, time_origin=self.platform.read_time_origin(files))

    def parameters(self) -> dict[str, float | int | str]:
        """Return the SI values of all parameters (fields that axes may set) by dotted path.

        A parameter on an axis has the value of its field. The number of beamlets is the number of
        rays cast per shot. Parameters of detector and estimator are left out unless whole spectra
        are drawn.
        """
        parameters = super().parameters()
        if not self.draws.draws_whole_spectra:
            parameters = {
                p: v for p, v in parameters.items() if not is_detector_or_estimator_parameter(p)
            }
        n_rays = initial_ray_count(parameters, error_budget.ErrorBudget.from_parameters(parameters))
        return parameters | {
            "target.solar_irradiance": self.scene.solar_irradiance,
            BEAMLETS_PATH: self.footprint.beamlets or n_rays,
        }

    @property
    def is_ray_number_set_by_tolerance(self) -> bool:
        """True if the number of rays per shot follows from the tolerance and is not stated."""
        return self.footprint.beamlets == 0 and beamlets_converge(self.parameters())

    def surface_materials(self) -> tuple[SurfaceMaterial, ...]:
        """Return the materials of all surfaces of the scene; the index is the surface's number.

        Files that the spec names are not read.
        """
        return scene_sections.scene_surface_materials(self.scene)

    def build_scene(self) -> scene_sections.BuiltScene:
        """Return the scene as bodies at which rays can be cast, with surfaces and motions.

        Raises
        ------
        SceneError
            If a file or an object is unsuitable.
        """
        flight = self.build_flight()
        return scene_sections.build_scene(
            self.scene, self.files, (flight.start_time, flight.stop_time)
        )

    def build_flight(self) -> MovingBody:
        """Return the motion of the instrument in the scene's frame, as a function of time.

        Raises
        ------
        SceneError
            If the table of waypoints is unsuitable.
        """
        return self.platform.build_moving_body(self.files)

    def scan_pattern(self, name: str) -> ScanPattern:
        """Return the scan pattern of the scanner called `name`."""
        return self.scanners[name].build_pattern()

    def shots_per_cycle(self, name: str) -> int:
        """Return the number of shots in a measurement cycle of the scanner called `name`."""
        return shots_per_cycle(self.scan_pattern(name))

    @property
    def can_solve_navigation(self) -> bool:
        """True if one scanner or more has enough shots per cycle to estimate a velocity vector."""
        return any(
            self.shots_per_cycle(name) >= NAVIGATION_SHOTS_PER_CYCLE_MIN for name in self.scanners
        )

    def unstated_error_sentences(self) -> list[str]:
        """Return sentences for the user on errors whose size the spec does not state.

        The errors are a missing error floor, or one that comes from the instrument; the drift of
        spectral lines within a record, due to acceleration; and relief of the ground, if the
        navigation has no standard deviation for it.
        """
        sentences = []
        floor_values, rules = (
            dict(self.error_floor),
            declare.rules_by_path(scene_sections.ErrorFloorSection, ""),
        )
        instrument_floor = self._instrument_error_floor
        if instrument_floor and any(floor_values[name] for name in instrument_floor.fields):
            fields = {
                name: raw_value
                for name, raw_value in instrument_floor.fields.items()
                if floor_values[name]
            }
            brought_text = ", ".join(f"{name} {raw_value}" for name, raw_value in fields.items())
            zero_text = ", ".join(f"{name}: {_smallest_value_text(rules[name])}" for name in fields)
            sentences.append(
                f"the instrument {instrument_floor.instrument_reference} brings a floor of errors: "
                f"{brought_text}. State "
                f"error_floor in the study to change it; 'error_floor: {{{zero_text}}}' switches "
                "it off"
            )
        if drift := self._line_drift_bins():
            sentences.append(
                f"the platform's acceleration drifts lines by up to {drift:.2g} bins within a "
                "record: the standard errors of points on speckled ground, and of navigation, are "
                "too small there, by 1.2 at 2.5 bins and by 1.7 at 5; shorter records drift less"
            )
        if not self.can_solve_navigation:
            return sentences
        if not any(value for _, value in self.error_floor):
            sentences.append(
                "no floor of errors is stated (error_floor): velocity, altitude and their "
                "covariances have the errors of noise and footprint alone, far below those of a "
                "real instrument"
            )
        rough_objects = [
            name
            for name, scene_object in self.scene.objects.items()
            if scene_sections.has_relief(scene_object)
        ]
        if rough_objects and not self.navigation.relief:
            sentences.append(
                f"no relief is stated (navigation.relief), and {', '.join(rough_objects)} is no "
                "plane: the "
                "altitude's variance knows of relief only by the residuals of the beams"
            )
        return sentences

    def _line_drift_bins(self) -> float:
        """Return the largest drift of a spectral line within a record, due to acceleration [bins].

        Notes
        -----
        At the radial velocity v and wavelength lambda the Doppler frequency is 2 v / lambda. An
        acceleration a changes it by 2 a T / lambda within a record of duration T. A bin is 1 / T
        wide, so that the drift is 2 a T^2 / lambda bins. The result is 0 up to
        `LINE_DRIFT_WARNING_BINS`, and for ground without developed speckle.
        """
        p = self.parameters()
        if p["footprint.speckle"] != "developed":
            return 0.0
        sample_rate, wavelength = (
            float(p[f"instrument.{name}"])
            for name in ("processing.sample_rate", "laser.wavelength")
        )
        record_duration = float(np.max(waveform.n_record_samples(p))) / sample_rate
        flight = self.build_flight()
        state = flight.state(
            np.linspace(flight.start_time, flight.stop_time, _N_ACCELERATION_SAMPLES)
        )
        acceleration_max = float(np.sqrt((state.acceleration**2).sum(axis=1)).max())
        drift = 2 * acceleration_max * record_duration**2 / wavelength
        return drift if drift > LINE_DRIFT_WARNING_BINS else 0.0

    def number_of_cycles(self, name: str) -> int:
        """Return the number of complete measurement cycles of a scanner in the flight."""
        flight, pattern = self.build_flight(), self.scan_pattern(name)
        return pattern.count_shots(flight.stop_time - flight.start_time) // shots_per_cycle(pattern)

    @property
    def beamlet_pattern(self) -> str:
        """Name of the arrangement of beamlets, for `sweep.model.beamlets.place_beamlets`."""
        return beamlet_pattern(self.parameters())

    def footprint_angles_function(self) -> Callable[[np.ndarray], beam.FootprintAngles] | None:
        """Return a function from ranges [m] to the `FootprintAngles` of the beam.

        The result is None if the beam's divergence does not depend on range.
        """
        parameters = self.parameters()
        return (
            None
            if beam.has_constant_divergence(parameters)
            else partial(beam.footprint_full_angles, parameters)
        )

    def interface_with_overrides(self, overrides: Mapping[str, object]) -> scene_sections.Interface:
        """Return the section ``interface`` with new values for some of its fields.

        `overrides` has the new values, written as in a spec, by field.

        Raises
        ------
        SpecError
            The error holds every mistake in the new values.
        """
        raw_fields = {
            path[-1]: rule.format(value)
            for path, rule, value in iter_section_values(self.interface)
        }
        try:
            return scene_sections.Interface.model_validate({**raw_fields, **overrides})
        except ValidationError as error:
            findings = validation_findings(error, scene_sections.Interface)
        located_findings = [
            replace(finding, location=("interface", *finding.location)) for finding in findings
        ]
        raise SpecError(map(Document({}).mistake_from_finding, located_findings))

    def pointing_jitter(self) -> PointingJitter | None:
        """Return the model of the beams' random pointing errors; None if their sigma is 0."""
        from sweep.model.geometry.scanner import PointingJitter

        sigma = self.platform.jitter
        return PointingJitter(sigma, self.seed) if sigma else None

    @property
    def has_rotating_bodies(self) -> bool:
        """True if one object of the scene or more may rotate during the flight."""
        motions = (
            getattr(scene_object, "motion", None) for scene_object in self.scene.objects.values()
        )
        return any(motion is not None and motion.attitude.kind != "fixed" for motion in motions)

    def geometry_identity(self, name: str) -> dict[str, Any]:
        """Return plain data that is equal for two scanners whose rays hit the same points.

        `name` is the scanner's name. Names, reflectances and the paths of files are left out. Files
        are represented by digests of their content. The order of objects matters, because it
        numbers their surfaces.
        """
        parameters, digests = self.parameters(), self._file_digests
        index_by_name = {key: index for index, key in enumerate(self.scene.objects)}
        objects = []
        for scene_object in self.scene.objects.values():
            values = values_by_path(scene_object, digests=digests)
            values = {
                path: value
                for path, value in values.items()
                if path.split(".")[-1] not in OPTICAL_FIELDS
            }
            objects.append(values | ({"on": index_by_name[values["on"]]} if "on" in values else {}))
        return {
            "objects": objects,
            "origin": index_by_name.get(self.scene.origin, -1),
            "platform": values_by_path(self.platform, digests=digests),
            "scanner": values_by_path(self.scanners[name], digests=digests),
            "model": MODEL_VERSION,
            "beamlets": parameters[BEAMLETS_PATH],
            "pattern": self.beamlet_pattern,
            "beam": {beam.DIVERGENCE_PATH: parameters[beam.DIVERGENCE_PATH]}
            if beam.has_constant_divergence(parameters)
            else beam.beam_shape_parameters(parameters),
            "seed": self.seed if self.platform.jitter else 0,
            "rotation": self.effect_modes()["rotation"] != "off",
        }

    def geometry_id(self, name: str) -> str:
        """Return the hash of a scanner's `geometry_identity`, 32 hexadecimal digits."""
        return identity_digest(self.geometry_identity(name))

    def identity(self) -> dict[str, Any]:
        """Return plain data in SI units that is equal for two specs of the same study.

        Files are represented by digests of their content, not by their paths. The order of objects
        matters, because it numbers the surfaces. A number of rays that follows from the tolerance
        is represented by 0.
        """
        digests, automatic_beamlets = (
            self._file_digests,
            {BEAMLETS_PATH: 0} if self.is_ray_number_set_by_tolerance else {},
        )
        return super().identity() | {
            "parameters": self.parameters_off_axes() | automatic_beamlets,
            "objects": list(self.scene.objects),
            "scene": values_by_path(self.scene, digests=digests),
            "platform": values_by_path(self.platform, digests=digests),
            "scanners": {
                path: value
                for name, scanner in self.scanners.items()
                for path, value in values_by_path(scanner, (name,), digests).items()
            },
        }


# Reading of specs of either class, from files and stores


def load(path: str | Path) -> GridSpec | SceneSpec:
    """Load a spec from a YAML file.

    Parameters
    ----------
    path : str or Path
        YAML file. Paths in it are relative to its folder.

    Returns
    -------
    GridSpec or SceneSpec
        `SceneSpec` if the file has a section ``scene``, else `GridSpec`.

    Raises
    ------
    SpecError
        The error holds every mistake in the file, each with its path, its line and a remedy.
    TypeError
        If `path` is no path.

    Examples
    --------
    >>> import sweep
    >>> spec = sweep.load("study.yaml")
    >>> spec.title
    'Small'
    """
    if not isinstance(path, str | os.PathLike):
        raise TypeError(
            f"a study is loaded from the path of a YAML file, not from a {type(path).__name__}; "
            "`sweep.spec.GridSpec.from_mapping(...)` makes one of plain data"
        )
    document = read_document(Path(path))
    return _spec_class(document.content).from_document(document, Path(path).parent)


def _user_values_on_axes(raw_spec: Any) -> dict[str, object]:
    """Return the values, as written, of fields that the user states and an axis sets too, by path.

    Fields of the instrument's file or library are left out: an axis may override them.
    """
    if not isinstance(raw_spec, Mapping):
        return {}
    raw_values = {
        path: raw_value_at(raw_spec, path, None)
        for path in first_values_on_axes(raw_spec.get("axes"))
    }
    return {path: copy.deepcopy(value) for path, value in raw_values.items() if value is not None}


def _field_axis_contradiction_findings(
    user_values: Mapping[str, object], axes: Sequence[Axis]
) -> Iterator[Finding]:
    """Yield a `Finding` for each field whose value is not among the values on the field's axis.

    `user_values` has the values as written, by dotted path.
    """
    parameters_by_path = {
        parameter.path: parameter for axis in axes for parameter in axis.parameters
    }
    for path, value in user_values.items():
        if (parameter := parameters_by_path.get(path)) is None:
            continue
        try:
            si_value = sections.parameter_rules()[path].read(value)
        except QuantityError:  # the field has a finding already
            continue
        values = np.asarray(parameter.values)
        is_number = values.dtype.kind in "fi" and not isinstance(si_value, str)
        if (
            np.isclose(values, si_value, rtol=1e-9, atol=0).any()
            if is_number
            else si_value in values
        ):
            continue
        problem = f"is on the axis {parameter.coordinate_name} too, which does not have this value"
        remedy = "leave it out here, or put it on the axis"
        yield Finding(tuple(path.split(".")), problem, remedy, value)


def from_stored(json_text: str, base: Path | str | None = None) -> GridSpec | SceneSpec:
    """Make a spec from the JSON text in a store, which the method `to_json` of a spec wrote.

    Parameters
    ----------
    json_text : str
        Text that a store holds.
    base : Path or str, optional
        Folder that paths in the spec are relative to; the current folder by default.

    Returns
    -------
    GridSpec or SceneSpec
        `SceneSpec` if the text has a section ``scene``, else `GridSpec`.
    """
    return _spec_class(parse_json(json_text)).from_stored(json_text, base)


def _spec_class(raw_spec: Any) -> type[GridSpec] | type[SceneSpec]:
    """Return `SceneSpec` if a spec as parsed from YAML has a section ``scene``, else `GridSpec`."""
    return SceneSpec if isinstance(raw_spec, dict) and "scene" in raw_spec else GridSpec


def parse_field_values(text_by_path: Mapping[str, str]) -> dict[str, Any]:
    """Convert YAML texts by dotted path to plain data by dotted path.

    Parameters
    ----------
    text_by_path : Mapping of str to str
        For example ``{"axes.target.range": "[1 km, 2 km]"}``.

    Returns
    -------
    dict
        Values as parsed from YAML, by dotted path.

    Raises
    ------
    SpecError
        If a text is no valid YAML.
    """
    yaml_text = "".join(f"{json.dumps(path)}: {value}\n" for path, value in text_by_path.items())
    document = parse_document(yaml_text, Path("--set"))
    if document.findings:
        raise SpecError(map(document.mistake_from_finding, document.findings))
    return document.content


def _smallest_value_text(rule: Rule) -> str:
    """Return the least value that a field takes, as a user would write it.

    For a rule without a lower bound the result is ``0``.
    """
    return rule.bound_texts.get("at_least", "0") if isinstance(rule, NumericRule) else "0"
