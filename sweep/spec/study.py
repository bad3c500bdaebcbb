"""A study of a flat target over a grid, or of a flight over a scene; and what both have."""

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

import sweep.spec.parts as of
import sweep.spec.scene as scenes
import sweep.spec.sections as sections
from sweep.documents import parse_json
from sweep.model import VERSION, accuracy, beam, looks, waveform
from sweep.model.effects import circulator_leak
from sweep.model.ground import pattern as pattern_of
from sweep.model.outputs import STRONGEST_OUTPUTS
from sweep.model.resolution import BEAMLETS, is_open, rays_needed
from sweep.model.threshold import WAYS
from sweep.model.waveform import ENDS
from sweep.spec.axes import (
    Axis,
    Member,
    axis_identity,
    in_units,
    paths_on_axes,
    read_axes,
    without_fields_on_axes,
)
from sweep.spec.figures import (
    LEAST_BEAMS,
    Figure,
    SceneFigure,
    figure_findings,
    scene_figure_findings,
)
from sweep.spec.flight import AnyScanner, Platform, shots_a_cycle
from sweep.spec.grid_rules import (
    Condition,
    Grid,
    grid_findings,
    is_method,
    not_in_flights,
    spectra_findings,
    without_draws,
)
from sweep.spec.grid_rules import at as written_at
from sweep.spec.grounds import OPTICAL
from sweep.spec.parts import (
    Files,
    Part,
    digest,
    fill,
    leaves,
    named_files,
    read_as,
    values_of,
)
from sweep.spec.reading import (
    Document,
    InstrumentFloor,
    findings_of,
    instrument_remedy,
    parsed,
    plain,
    read_document,
    resolve_instrument,
    without_extensions,
)
from sweep.spec.rules import (
    Finding,
    Location,
    Mistake,
    Numeric,
    Rule,
    SpecError,
    Special,
    dotted,
    shown,
)
from sweep.spec.scene_check import axis_findings, parameter_findings, scene_findings, why_not
from sweep.units import QuantityError

if TYPE_CHECKING:
    from sweep.model.geometry.mesh import Surface
    from sweep.model.geometry.platform import Flight
    from sweep.model.geometry.scanner import PointingJitter, Scanner


LARGEST_GRID = 10**15
DRIFT_MIN = 2.0
"""Drift of a speckled line within a record from which its stated errors are too small [bins]."""

_DRIFT_TIMES = 1000
"""Times of a flight at which its acceleration is looked at."""

FILES = "files"
"""Section of a stored study: the digest of each file by its path."""
_UNSTORED = ("question", "execution", "axes", "figures")
"""Sections of a study of which no default is written out."""
_READ_AXES = Special(about="What varies", reader=lambda axes: axes)
"""Rule of axes, which `read_axes` has read before pydantic sees them."""


class Study(Part):
    """A study as its user declared it, every value read and checked.

    Made by `load` from a file and by `from_mapping` from plain data; values are SI.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", ignored_types=(cached_property,))

    title: str = of.text("What the study is called")
    question: str = of.text("The question that the study answers", "")
    instrument: sections.Instrument
    atmosphere: sections.Atmosphere = sections.Atmosphere()
    footprint: sections.Footprint = sections.Footprint()
    effects: sections.Effects = sections.Effects()
    accuracy: sections.Accuracy = sections.Accuracy()
    seed: int = of.seed("Seed of all random draws")
    execution: sections.Execution = sections.Execution()
    axes: tuple[Axis, ...] = of.field(_READ_AXES, ())

    _written: dict[str, Any] = PrivateAttr(default_factory=dict)
    _base: Path = PrivateAttr(default=Path())
    _digests: dict[str, str] = PrivateAttr(default_factory=dict)
    _instrument_floor: InstrumentFloor | None = PrivateAttr(default=None)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any], *, base: Path | str = ".") -> Self:
        """Spec from plain data, written as in a file.

        Parameters
        ----------
        mapping : mapping
            Content of a spec file; it is not changed.
        base : path
            Folder that the files which it names are relative to.

        Raises
        ------
        SpecError
            With every mistake in it.
        """
        if not isinstance(mapping, Mapping):
            raise SpecError([Mistake("", "must be a mapping", shown(mapping))])
        document = Document.from_plain(without_extensions(plain(mapping)))
        return cls.from_document(document, Path(base))

    @classmethod
    def from_stored(cls, text: str, base: Path | str | None = None) -> Self:
        """Spec from the JSON that `to_json` gave, the same again but for its execution.

        Files, relative to `base`, are not looked at before they are needed.
        """
        written = plain(parse_json(text))
        if not isinstance(written, dict):
            raise SpecError([Mistake("", "must be a mapping", shown(written))])
        digests = written.pop(FILES, {})
        spec = cls.from_document(Document(written), None)
        spec._base, spec._digests = Path(base or "."), digests
        return spec

    @classmethod
    def from_document(cls, document: Document, base: Path | None) -> Self:
        """Spec from a document, which is changed.

        Without a base it is a store's own document, whose files are left alone, and in which a
        field and its axis may differ.
        """
        by_the_user = {} if base is None else _written_twice(document.value)
        has_floor = "error_floor" in cls.model_fields
        has_instrument = resolve_instrument(document, base or Path(), has_floor=has_floor)
        written = document.value
        lacks_instrument = "instrument" not in written
        filled = [
            path
            for path, first in paths_on_axes(written.get("axes")).items()
            if cls.may_vary(path) and fill(written, path.split("."), first)
        ]
        axes, findings = read_axes(written.get("axes", {}))
        axes_are_whole = not findings
        spec: Self | None = None
        try:
            spec = cls.model_validate({**written, "axes": axes})
        except ValidationError as error:
            findings += findings_of(error, cls)
        grid = Grid.of(written, axes)
        findings += grid_findings(grid)
        findings += [*_size_findings(axes), *_segment_findings(grid), *_strongest_findings(grid)]
        findings += cls.further_findings(written, grid, base, axes_are_whole)
        findings += _contradictions(by_the_user, axes)
        # What is wrong with an axis or an instrument's file is told there, and there alone.
        findings = [
            finding
            for finding in findings
            if dotted(finding.location) not in filled
            and (has_instrument or finding.location[0] != "instrument")
        ]
        if lacks_instrument and filled:  # an axis has filled in some of it
            findings = [f for f in findings if f.location[0] != "instrument"]
            findings.insert(0, Finding(("instrument",), "is missing", instrument_remedy()))
        findings = document.findings + findings
        if findings or spec is None:
            raise SpecError(document.mistakes(findings))
        spec._written = spec._completed(written)
        spec._instrument_floor = document.instrument_floor
        return spec

    @classmethod
    def may_vary(cls, path: str) -> bool:
        """Return true: an axis may set every parameter of this kind of study."""
        return True

    @classmethod
    def further_findings(
        cls, written: Mapping[str, Any], grid: Grid, base: Path | None, axes_are_whole: bool
    ) -> list[Finding]:
        """Mistakes in a spec as written beyond its single fields and its grid.

        Files are left alone without a base. Not all axes may have been read.
        """
        return []

    def parameters(self) -> dict[str, float | int | str]:
        """SI values of all parameters by dotted path; of those on axes, the value off the axis."""
        return {
            path: value
            for section in sections.SECTIONS
            if section in type(self).model_fields
            for path, value in values_of(getattr(self, section), (section,)).items()
        }

    def modes(self) -> dict[str, str]:
        """Mode of each effect by its name: `auto`, `on` or `off`."""
        return values_of(self.effects)

    def parameters_at(self, at: Mapping[str, object]) -> dict[str, float | int | str]:
        """Parameters with some set anew, written as in a spec.

        Parameters
        ----------
        at : mapping
            Values by dotted path or its last part: ``{"range": "2 km"}``.

        Raises
        ------
        SpecError
            With every mistake in it, the combination's included.
        """
        parameters = self.parameters()
        findings = []
        for name, written in at.items():
            path, rule = _parameter(name, parameters | dict.fromkeys((*WAYS, *ENDS)))
            if rule is None:
                suggestion = sections.parameter_suggestion(name, parameters)
                findings.append(Finding((name,), "is no parameter", suggestion))
                continue
            try:
                if path in WAYS:  # one takes another's place
                    parameters = {p: v for p, v in parameters.items() if p not in WAYS}
                parameters[path] = rule.read(written)
            except QuantityError as error:
                findings.append(Finding((name,), error.rule, error.suggestion, written))
            findings += self.unvaried(path, parameters[path], (name,))
        if not findings:
            grid = Grid(parameters, modes=self.modes())
            findings = [*grid_findings(grid), *_strongest_findings(grid)]
        if findings:
            raise SpecError(Document({}).mistake(finding) for finding in findings)
        return parameters

    def unvaried(self, path: str, value: object, location: Location) -> list[Finding]:
        """Mistakes in giving a parameter a value in this kind of study: none."""
        return []

    def member(self, name: str) -> Member:
        """Parameter on an axis, by its coordinate's name or dotted path; or a KeyError."""
        for axis in self.axes:
            for member in axis.members:
                if name in (member.name, member.path):
                    return member
        raise KeyError(name)

    def coordinate_value(self, name: str, written: object) -> float | int | str:
        """Written value of a coordinate, in the unit that the coordinate is displayed in.

        A KeyError where no axis has it, a `QuantityError` where the value cannot be read.
        """
        member = self.member(name)
        rule = sections.parameter_rules()[member.path]
        if not isinstance(rule, Numeric):
            return str(rule.read(written))
        return in_units(rule, written, member.units)

    def unstated_errors(self) -> list[str]:
        """Return sentences on errors whose size the spec does not state itself: none of a grid."""
        return []

    def identity(self) -> dict[str, Any]:
        """Content that makes the study this one, in SI values.

        Title, question, figures and execution are no part of it, nor are values that an axis
        overrides. The order of the axes is: it lays out the arrays.
        """
        others = ("draws", "error_floor", "navigation", "storage")
        return {
            "model": VERSION,
            "parameters": self.parameters_off_axes(),
            "axes": [axis_identity(axis) for axis in self.axes],
            "effects": self.modes(),
            "seed": self.seed,
        } | {
            name: values_of(getattr(self, name))
            for name in others
            if name in type(self).model_fields
        }

    def parameters_off_axes(self) -> dict[str, float | int | str]:
        """SI values of the parameters that no axis overrides, by dotted path."""
        on_axes = {member.path for axis in self.axes for member in axis.members}
        return {path: v for path, v in self.parameters().items() if path not in on_axes}

    @cached_property
    def id(self) -> str:
        """Hash of the identity, 32 hexadecimal digits."""
        return digest(self.identity())

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, type(self)):
            return False
        return (self._written, self._digests) == (other._written, other._digests)

    def __hash__(self) -> int:
        return hash(self.id)

    def to_yaml_mapping(self) -> dict[str, Any]:
        """Return the spec as a user would write it whole: no instrument file, no default left out.

        What an axis sets is in no section: what the study holds is the same whether or not its
        user wrote a value there too. Execution is left out, as it is no part of what a study is.
        """
        return copy.deepcopy(self._written)

    def _completed(self, written: dict[str, Any]) -> dict[str, Any]:
        """Return the spec with its defaults, without its execution and without what axes set."""
        mapping = copy.deepcopy({k: value for k, value in written.items() if k != "execution"})
        for path, rule, value in leaves(self):
            if path[0] not in _UNSTORED:
                fill(mapping, list(path), rule.written(value))
        return without_fields_on_axes(mapping)

    def to_json(self) -> str:
        """Return the spec as JSON text, for a store to hold, with the digests of its files."""
        mapping = self.to_yaml_mapping() | ({FILES: self._digests} if self._digests else {})
        return json.dumps(mapping, ensure_ascii=False, allow_nan=False)


def _parameter(name: str, known: Mapping[str, object]) -> tuple[str, Rule | None]:
    """Dotted path and rule of a parameter, by its path or its last part."""
    rules = sections.parameter_rules()
    paths = [path for path in known if name in (path, sections.short_name(path))]
    return (paths[0], rules[paths[0]]) if len(paths) == 1 else (name, None)


def _segment_findings(grid: Grid) -> Iterator[Finding]:
    """Report segments whose beats do not tell range and velocity apart, and rules without laws."""
    if grid.has_point({waveform.DOWN_SLOPE: lambda slope: slope == 1.0}):
        rule = "is the slope of the segment 'up': range and velocity need two slopes"
        yield grid.finding(waveform.DOWN_SLOPE, rule, "write another, or -1 for a triangle")
    any_two: dict[str, Condition] = {waveform.SHOT_DETECTION: lambda rule: rule == waveform.ANY_TWO}
    slopes = {1.0, *grid.span(waveform.DOWN_SLOPE)}
    if grid.has_point(any_two | {waveform.DOPPLER_SLOPE: lambda v: np.isin(v, [*slopes])}):
        rule = "is another segment's too, and these two tell neither range nor velocity: any_two"
        yield grid.finding(waveform.DOPPLER_SLOPE, rule, "write another, or take both_chirps")


STRONGEST_ALONE: dict[str, Condition] = {waveform.PEAKS: lambda peaks: peaks == waveform.STRONGEST}
"""Condition on points whose segments report their strongest peak alone."""


def _strongest_findings(grid: Grid) -> Iterator[Finding]:
    """Report the strongest peak alone where no law of it is known."""
    several: dict[str, Condition] = {
        looks.NUMBER: lambda number: number > 1,
        looks.COMBINE: lambda way: way != looks.COHERENT,
    }
    refused: tuple[tuple[dict[str, Condition], str, str], ...] = (
        (several, "is that of one record, and instrument.looks.number asks for several",
         "combine: coherent"),
        ({circulator_leak.PATH: lambda path: path > 0},
         "may be the line of instrument.telescope.leak_path, whose noise has no law",
         "leave the leak's path out"),
        ({waveform.SHOT_DETECTION: lambda rule: rule == waveform.ANY_TWO},
         "may be wrong in one of three segments, and shot_detection: any_two cannot tell in which",
         "shot_detection: both_chirps"),
    )  # fmt: skip
    for conditions, rule, remedy in refused:
        if grid.has_point(STRONGEST_ALONE | conditions):
            yield grid.finding(waveform.PEAKS, rule, f"take all, or {remedy}")


def _size_findings(axes: tuple[Axis, ...]) -> Iterator[Finding]:
    """Report a grid too large to count."""
    points = math.prod(axis.size for axis in axes)
    if points > LARGEST_GRID:
        rule = f"make {points:.3g} points, and a study has at most {LARGEST_GRID:.0e}"
        yield Finding(("axes",), rule, "take fewer values")


class Spec(Study):
    """A study of a flat target over a grid of parameters, every value read and checked.

    Made by `load` from a file and by `from_mapping` from plain data; values are SI.
    """

    target: sections.Target
    draws: sections.Draws = sections.Draws()
    storage: sections.Storage = sections.Storage()
    figures: tuple[Figure, ...] = Field(default=(), description="Figures and tables of the results")

    @classmethod
    def further_findings(
        cls, written: Mapping[str, Any], grid: Grid, base: Path | None, axes_are_whole: bool
    ) -> list[Finding]:
        """Figures of what the study lacks, random effects without draws, draws without an end."""
        further = STRONGEST_OUTPUTS if grid.has_point(STRONGEST_ALONE) else ()
        findings = list(figure_findings(written, grid.axes, further)) if axes_are_whole else []
        draws = read_as(sections.Draws, written.get("draws", {}))
        if draws is not None:
            findings += spectra_findings(draws, grid)
            if draws.any and grid.has_point(STRONGEST_ALONE):
                rule = "has chances in closed form alone, and the study has draws"
                findings.append(grid.finding(waveform.PEAKS, rule, "take all, or no draws"))
            findings += () if draws.any else without_draws(grid)
            if draws.number and draws.limit:
                rule = f"stands beside draws.number, {draws.number}: only one of them can say "
                remedy = "keep limit to draw until accuracy.tolerance is met, or number to draw "
                rule, remedy = f"{rule}how much to draw", f"{remedy}so many times"
                findings.append(Finding(("draws", "limit"), rule, remedy, draws.limit))
        return findings

    @cached_property
    def has_random_effects(self) -> bool:
        """True if anything but noise may be random at any point."""
        return any(without_draws(Grid(self.parameters(), self.axes, self.modes())))

    @property
    def reports_strongest(self) -> bool:
        """True if segments report their strongest peak alone at any point."""
        return Grid(self.parameters(), self.axes).has_point(STRONGEST_ALONE)

    def identity(self) -> dict[str, Any]:
        """Content that makes the study this one, in SI values.

        Settings of detectors and estimators for whole spectra count only if these are drawn.
        """
        identity = super().identity()
        if not self.draws.whole_spectra:
            counted = {p: v for p, v in identity["parameters"].items() if not is_method(p)}
            identity["parameters"] = counted
        return identity


class SceneSpec(Study):
    """A study of a flight over a scene, every value read and checked.

    Made by `load` from a file and by `from_mapping` from plain data; values are SI.
    """

    scene: scenes.Scene
    platform: Platform
    scanners: dict[str, AnyScanner] = Field(description="Scan patterns by name")
    draws: scenes.SceneDraws = scenes.SceneDraws()
    error_floor: scenes.ErrorFloor = scenes.ErrorFloor()
    navigation: scenes.Navigation = scenes.Navigation()
    interface: scenes.Interface = Field(default_factory=scenes.Interface)
    storage: scenes.SceneStorage = scenes.SceneStorage()
    figures: tuple[SceneFigure, ...] = Field(
        default=(), description="Figures and tables of the results"
    )

    @classmethod
    def from_document(cls, document: Document, base: Path | None) -> Self:
        """Spec from a document, which is changed, or all of its mistakes at once."""
        spec = super().from_document(document, base)
        if base is not None:
            files = Files(base)
            spec._base = base
            named = [(file, rule) for _, rule, file in named_files(spec)]
            spec._digests = {file: rule.digest(files.path(file)) for file, rule in named}
        return spec

    @classmethod
    def further_findings(
        cls, written: Mapping[str, Any], grid: Grid, base: Path | None, axes_are_whole: bool
    ) -> list[Finding]:
        """Mistakes in scene, flight, files, random effects and figures."""
        draws = read_as(scenes.SceneDraws, written.get("draws", {})) or scenes.SceneDraws()
        return [
            *scene_findings(written, base),
            *axis_findings(grid),
            *not_in_flights(grid, draws),
            *scene_figure_findings(written, grid.axes if axes_are_whole else None),
        ]

    @classmethod
    def may_vary(cls, path: str) -> bool:
        """Return true if an axis of this kind of study may set the parameter at a path."""
        return not why_not(path)[0]

    def unvaried(self, path: str, value: object, location: Location) -> list[Finding]:
        """Mistakes in a parameter taking a value without the geometry changing."""
        return parameter_findings(self.parameters(), path, [value], location)

    @property
    def base(self) -> Path:
        """Folder that the scene's files are relative to."""
        return self._base

    @property
    def files(self) -> Files:
        """The scene's files, with the time in them at which the flight begins."""
        files = Files(self._base, self._digests)
        return replace(files, time_origin=self.platform.time_origin(files))

    def parameters(self) -> dict[str, float | int | str]:
        """SI values of all parameters by dotted path; of those on axes, the value off the axis."""
        parameters = super().parameters()
        if not self.draws.whole_spectra:
            parameters = {p: v for p, v in parameters.items() if not is_method(p)}
        rays = rays_needed(parameters, accuracy.Accuracy.of(parameters))
        return parameters | {
            "target.solar_irradiance": self.scene.solar_irradiance,
            BEAMLETS: self.footprint.beamlets or rays,
        }

    @property
    def rays_by_tolerance(self) -> bool:
        """True if the tolerance says how many rays there are of each shot."""
        return self.footprint.beamlets == 0 and is_open(self.parameters())

    def surfaces(self) -> tuple[Surface, ...]:
        """Surfaces by their numbers; no file is looked at."""
        return scenes.surfaces_of(self.scene)

    def world(self) -> scenes.World:
        """Build the scene; a `SceneError` for an unfit file or object."""
        flight = self.flight()
        return scenes.build(self.scene, self.files, (flight.start, flight.stop))

    def flight(self) -> Flight:
        """Movement of the instrument in the scene's frame; a `SceneError` for an unfit table."""
        return self.platform.flight(self.files)

    def scan(self, name: str) -> Scanner:
        """Return the scan pattern of a scanner."""
        return self.scanners[name].pattern()

    def shots_a_cycle(self, name: str) -> int:
        """Shots of a measurement cycle of a scanner."""
        return shots_a_cycle(self.scan(name))

    @property
    def navigates(self) -> bool:
        """True if a scanner has the shots in a cycle that navigation takes."""
        return any(self.shots_a_cycle(name) >= LEAST_BEAMS for name in self.scanners)

    def unstated_errors(self) -> list[str]:
        """Return sentences on errors whose size the spec does not state itself.

        Those are the floor that its instrument brings, and errors that a navigation lacks.
        """
        sentences = []
        errors, rules = dict(self.error_floor), of.rules_of(scenes.ErrorFloor, "")
        floor = self._instrument_floor
        if floor and any(errors[name] for name in floor.fields):
            fields = {n: written for n, written in floor.fields.items() if errors[n]}
            brought = ", ".join(f"{name} {written}" for name, written in fields.items())
            off = ", ".join(f"{name}: {_smallest_quantity(rules[name])}" for name in fields)
            sentences.append(
                f"the instrument {floor.instrument} brings a floor of errors: {brought}. State "
                f"error_floor in the study to change it; 'error_floor: {{{off}}}' switches it off"
            )
        if drift := self._drift_in_bins():
            sentences.append(
                f"the platform's acceleration drifts lines by up to {drift:.2g} bins within a "
                "record: the standard errors of points on speckled ground, and of navigation, are "
                "too small there, by 1.2 at 2.5 bins and by 1.7 at 5; shorter records drift less"
            )
        if not self.navigates:
            return sentences
        if not any(value for _, value in self.error_floor):
            sentences.append(
                "no floor of errors is stated (error_floor): velocity, altitude and their "
                "covariances have the errors of noise and footprint alone, far below those of a "
                "real instrument"
            )
        rough = [name for name, thing in self.scene.objects.items() if scenes.has_relief(thing)]
        if rough and not self.navigation.relief:
            sentences.append(
                f"no relief is stated (navigation.relief), and {', '.join(rough)} is no plane: the "
                "altitude's variance knows of relief only by the residuals of the beams"
            )
        return sentences

    def _drift_in_bins(self) -> float:
        """Largest drift of a speckled line within a record by acceleration [bins].

        0 below `DRIFT_MIN`, and for ground whose echoes have no developed speckle.
        """
        p = self.parameters()
        if p["footprint.speckle"] != "developed":
            return 0.0
        rate, wavelength = (
            float(p[f"instrument.{name}"])
            for name in ("processing.sample_rate", "laser.wavelength")
        )
        record = float(np.max(waveform.record_length(p))) / rate
        flight = self.flight()
        state = flight.state(np.linspace(flight.start, flight.stop, _DRIFT_TIMES))
        largest = float(np.sqrt((state.acceleration**2).sum(axis=1)).max())
        drift = 2 * largest * record**2 / wavelength
        return drift if drift > DRIFT_MIN else 0.0

    def cycles(self, name: str) -> int:
        """Whole measurement cycles of a scanner, all of whose shots begin during the flight."""
        flight, scan = self.flight(), self.scan(name)
        return scan.number(flight.stop - flight.start) // shots_a_cycle(scan)

    @property
    def pattern(self) -> str:
        """Arrangement of the beamlets, `sweep.model.footprint.beamlets`'s word."""
        return pattern_of(self.parameters())

    def footprint_angles(self) -> Callable[[np.ndarray], beam.Angles] | None:
        """Angles of the beam's footprint by range; None where its divergence says all."""
        p = self.parameters()
        return None if beam.is_thesis(p) else partial(beam.angles, p)

    def interface_with(self, fields: Mapping[str, object]) -> scenes.Interface:
        """Return the unit's interface with some fields set anew, written as in a spec."""
        written = {path[-1]: rule.written(v) for path, rule, v in leaves(self.interface)}
        try:
            return scenes.Interface.model_validate({**written, **fields})
        except ValidationError as error:
            findings = findings_of(error, scenes.Interface)
        placed = [replace(each, location=("interface", *each.location)) for each in findings]
        raise SpecError(map(Document({}).mistake, placed))

    def pointing_jitter(self) -> PointingJitter | None:
        """Random turns of the beams; None where there are none."""
        from sweep.model.geometry.scanner import PointingJitter

        sigma = self.platform.jitter
        return PointingJitter(sigma, self.seed) if sigma else None

    @property
    def rotating(self) -> bool:
        """True if any body of the scene turns."""
        moving = (getattr(thing, "motion", None) for thing in self.scene.objects.values())
        return any(motion is not None and motion.attitude.kind != "fixed" for motion in moving)

    def geometry(self, name: str) -> dict[str, Any]:
        """Content of what is seen through one scanner: all that rays depend on, and no more.

        Names are no part of it, nor are reflectances, nor where files are: they count by content.
        Objects count by their place in the scene, which their surfaces' numbers come from.
        """
        p, digests = self.parameters(), self._digests
        places = {key: place for place, key in enumerate(self.scene.objects)}
        objects = []
        for thing in self.scene.objects.values():
            values = values_of(thing, digests=digests)
            values = {path: v for path, v in values.items() if path.split(".")[-1] not in OPTICAL}
            objects.append(values | ({"on": places[values["on"]]} if "on" in values else {}))
        return {
            "objects": objects,
            "origin": places.get(self.scene.origin, -1),
            "platform": values_of(self.platform, digests=digests),
            "scanner": values_of(self.scanners[name], digests=digests),
            "model": VERSION,
            "beamlets": p[BEAMLETS],
            "pattern": self.pattern,
            "beam": {beam.DIVERGENCE: p[beam.DIVERGENCE]} if beam.is_thesis(p) else beam.shape(p),
            "seed": self.seed if self.platform.jitter else 0,
            "rotation": self.modes()["rotation"] != "off",
        }

    def geometry_id(self, name: str) -> str:
        """Hash of the geometry, 32 hexadecimal digits."""
        return digest(self.geometry(name))

    def identity(self) -> dict[str, Any]:
        """Content that makes the study this one, in SI values.

        Files count by content, and not by where they are. The order of objects is part of it: it
        numbers the surfaces. A number of rays that follows from the tolerance counts as 0.
        """
        digests, counted = self._digests, {BEAMLETS: 0} if self.rays_by_tolerance else {}
        return super().identity() | {
            "parameters": self.parameters_off_axes() | counted,
            "objects": list(self.scene.objects),
            "scene": values_of(self.scene, digests=digests),
            "platform": values_of(self.platform, digests=digests),
            "scanners": {
                path: value
                for name, scanner in self.scanners.items()
                for path, value in values_of(scanner, (name,), digests).items()
            },
        }


# Studies from files and from what a store holds, whichever their kind


def load(path: str | Path) -> Spec | SceneSpec:
    """Study in a YAML file: one of a flat target, or of a scene where it has a ``scene``.

    Raises
    ------
    SpecError
        With every mistake in it, each with its path, its line and a remedy.
    """
    if not isinstance(path, str | os.PathLike):
        raise TypeError(
            f"a study is loaded from the path of a YAML file, not from a {type(path).__name__}; "
            "`sweep.spec.Spec.from_mapping(...)` makes one of plain data"
        )
    document = read_document(Path(path))
    return _kind(document.value).from_document(document, Path(path).parent)


def _written_twice(written: Any) -> dict[str, object]:
    """Return the fields that a user has in a section although an axis sets them, as written.

    An instrument's own file or the library may have them: an axis is there to change these.
    """
    if not isinstance(written, Mapping):
        return {}
    found = {path: written_at(written, path, None) for path in paths_on_axes(written.get("axes"))}
    return {path: copy.deepcopy(value) for path, value in found.items() if value is not None}


def _contradictions(written: Mapping[str, object], axes: Sequence[Axis]) -> Iterator[Finding]:
    """Report fields whose value, as written, is none of their axis."""
    members = {member.path: member for axis in axes for member in axis.members}
    for path, value in written.items():
        if (member := members.get(path)) is None:
            continue
        try:
            read = sections.parameter_rules()[path].read(value)
        except QuantityError:  # told as a mistake of the field's own
            continue
        values = np.asarray(member.values)
        is_number = values.dtype.kind in "fi" and not isinstance(read, str)
        if np.isclose(values, read, rtol=1e-9, atol=0).any() if is_number else read in values:
            continue
        told = f"is on the axis {member.name} too, which does not have this value"
        remedy = "leave it out here, or put it on the axis"
        yield Finding(tuple(path.split(".")), told, remedy, value)


def from_stored(text: str, base: Path | str | None = None) -> Spec | SceneSpec:
    """Study from the JSON that its `to_json` gave, as `Study.from_stored`."""
    return _kind(parse_json(text)).from_stored(text, base)


def _kind(written: Any) -> type[Spec] | type[SceneSpec]:
    return SceneSpec if isinstance(written, dict) and "scene" in written else Spec


def written(fields: Mapping[str, str]) -> dict[str, Any]:
    """Values as a file has them, from text by path: ``{"axes.target.range": "[1 km, 2 km]"}``."""
    text = "".join(f"{json.dumps(path)}: {value}\n" for path, value in fields.items())
    document = parsed(text, Path("--set"))
    if document.findings:
        raise SpecError(map(document.mistake, document.findings))
    return document.value


def _smallest_quantity(rule: Rule) -> str:
    """Return the smallest value of a field, as a user would write it."""
    return rule.bounds.get("at_least", "0") if isinstance(rule, Numeric) else "0"
