"""Mistakes in a study of a scene beyond its single fields.

Names and references, objects, files, the flight, and axes that would move the rays.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import sweep.spec.flight as flights
import sweep.spec.parts as of
import sweep.spec.scene as scenes
from sweep.model import beam
from sweep.model.ground import pattern as pattern_of
from sweep.model.outputs import CYCLES, NAVIGATION, POINTS, SHOTS, STATISTICS
from sweep.model.resolution import PATTERN
from sweep.scenes.files import SceneError
from sweep.scenes.maps import height_metres
from sweep.spec.axes import place_on_grid
from sweep.spec.grid_rules import Grid
from sweep.spec.grid_rules import at as written_at
from sweep.spec.grounds import Craters, Ground, Jacksboro, RasterGround
from sweep.spec.parts import Files, named_files, read_as
from sweep.spec.rules import Finding, Location, near_miss
from sweep.spec.sections import default_of
from sweep.units import QuantityError, read_unit

SHOTS_MAX = 10**9
"""Shots of a scanner at most, as arrays of them are made."""

RESERVED = ("scene_map",)
"""Names that a store has for other groups than its scanners."""
_PLACED = (scenes.Sphere, scenes.Box)
OBJECTS: Location = ("scene", "objects")
_LOOKS = 257
"""Times at which an attitude is tried."""


def _section(written: Mapping[str, Any], *path: str | int) -> dict[str, Any]:
    """Return a mapping in a spec; empty where there is none."""
    found = written_at(written, ".".join(map(str, path)))
    return dict(found) if isinstance(found, Mapping) else {}


def _readable(section: Mapping[str, Any], kind: Any) -> dict[str, Any]:
    """Parts of a kind in a section that can be read, by name."""
    read = {name: read_as(kind, value) for name, value in section.items()}
    return {name: part for name, part in read.items() if part is not None}


def scene_findings(written: Mapping[str, Any], base: Path | None) -> list[Finding]:
    """Mistakes in scene, platform and scanners beyond their single fields.

    Sections that cannot be read are passed over; files are left alone without a base.
    """
    objects = _readable(_section(written, *OBJECTS), scenes.AnyObject)
    scanners = _readable(_section(written, "scanners"), flights.AnyScanner)
    platform = read_as(flights.Platform, written.get("platform"))
    findings = [
        *_name_findings(written, OBJECTS, lambda name: name == scenes.WORLD, "scene"),
        *_name_findings(written, ("scanners",), lambda name: name in RESERVED, "store"),
        *_reference_findings(written, objects),
    ]
    for name, thing in objects.items():
        findings += _object_findings(thing, (*OBJECTS, name))
    files = [] if base is None else list(_file_findings(objects, platform, base))
    known = {finding.location for finding in files}
    others = _flight_findings(platform, scanners, objects, base)
    return findings + files + [f for f in others if f.location not in known]


# Names, references, files


def _name_findings(
    written: Mapping[str, Any], section: Location, taken: Callable[[str], bool], by: str
) -> Iterator[Finding]:
    """Names of objects or scanners that can't be, and a section without any."""
    named = _section(written, *section)
    for name in named:
        try:
            of.named("Name").read(name)
        except QuantityError as error:
            yield Finding((*section, name), "is no name", error.suggestion)
        if taken(name):
            yield Finding((*section, name), f"is a name that the {by} has taken")
    if not named and isinstance(written_at(written, ".".join(map(str, section))), Mapping):
        yield Finding(section, "holds nothing", "name at least one")


def _reference_findings(
    written: Mapping[str, Any], objects: Mapping[str, Any]
) -> Iterator[Finding]:
    """Report references to objects that are missing or no ground, and a position of the origin."""
    named = _section(written, *OBJECTS)
    if not named:
        return
    origin = _section(written, "scene").get("origin", scenes.WORLD)
    if isinstance(origin, str) and origin != scenes.WORLD:
        yield from _reference(origin, ("scene", "origin"), named, objects, ", or 'world'")
        if any(getattr(objects.get(origin), "position", None) or ()):
            rule, remedy = "places the scene's origin, which lies at zero", "leave it out, or "
            yield Finding((*OBJECTS, origin, "position"), rule, f"{remedy}take another origin")
    for name, thing in named.items():
        on = thing.get("on") if isinstance(thing, Mapping) else None
        if isinstance(on, str):
            yield from _reference(on, (*OBJECTS, name, "on"), named, objects, "")


def _reference(
    name: str, at: Location, named: Mapping[str, Any], objects: Mapping[str, Any], otherwise: str
) -> Iterator[Finding]:
    """One reference to a ground."""
    grounds = [key for key, thing in objects.items() if isinstance(thing, Ground)]
    remedy = f"the grounds are {', '.join(grounds)}" if grounds else "add a ground"
    remedy += otherwise
    if name not in named:
        rule = "is no object of the scene"
        yield Finding(at, rule, near_miss(name, named, otherwise=remedy), name)
    elif name in objects and name not in grounds:
        yield Finding(at, "is no ground", remedy, name)


def _file_findings(
    objects: Mapping[str, Any], platform: flights.Platform | None, base: Path
) -> Iterator[Finding]:
    """Files that are missing or can not be read."""
    things: list[tuple[Location, Any]] = [((*OBJECTS, n), thing) for n, thing in objects.items()]
    things += [] if platform is None else [(("platform",), platform)]
    for location, thing in things:
        for key, rule, file in named_files(thing):
            path = Files(base).path(file)
            try:
                rule.digest(path)
            except SceneError as error:
                is_companion = error.file != str(path)
                needs = f"needs {error.file}, which " if is_companion else ""
                broken = f"names a file that {needs}{error.rule}"
                yield Finding((*location, *key), broken, error.remedy, file)


# Objects


def _refused(make: Callable[[], object], location: Location) -> list[Finding]:
    """Refusal of the model to make a part."""
    try:
        make()
    except (ValueError, ArithmeticError) as error:
        return [Finding(location, f"can not be made: {error}")]
    return []


def _object_findings(thing: Any, location: Location) -> Iterator[Finding]:
    """Mistakes in an object at a location, its references and files apart."""
    if isinstance(thing, Ground):
        yield from _ground_findings(thing, location)
    if isinstance(thing, RasterGround) and thing.height_unit is not None:
        try:
            height_metres(thing.height_unit)
        except QuantityError as error:
            yield Finding((*location, "height_unit"), error.rule, "write m, ft or sft")
    if isinstance(thing, scenes.Solid):
        yield from _solid_findings(thing, location)
    if isinstance(thing, scenes.Boulders):
        yield from _size_findings(thing, location)
    if isinstance(thing, scenes.Trees) and not thing.tree.crown_base < thing.tree.height:
        base, top = f"{thing.tree.crown_base:g} m", f"{thing.tree.height:g} m"
        at = (*location, "tree", "crown_base")
        if "crown_base" in thing.tree.model_fields_set:
            yield Finding(at, f"must lie below the top, {top}", "lower it", base)
        else:
            yield Finding(
                at, f"is {base} by default, and must lie below the top, {top}", "lower it"
            )


def _size_findings(thing: scenes.Boulders | Craters, location: Location) -> Iterator[Finding]:
    """Diameters without a range."""
    if not thing.smallest < thing.largest:
        rule = f"must exceed the smallest diameter, {thing.smallest:g} m"
        yield Finding((*location, "largest"), rule, "", f"{thing.largest:g} m")


def _ground_findings(ground: Ground, location: Location) -> Iterator[Finding]:
    """Report a grid that can not be made, or that can not hold its craters."""
    section = "middle" if isinstance(ground, Jacksboro) else "spacing"
    unfit = _refused(ground.check, (*location, section))
    yield from unfit
    if ground.craters is None:
        return
    yield from _size_findings(ground.craters, (*location, "craters"))
    step, smallest = None if unfit else ground.step(), ground.craters.smallest
    if step is not None and smallest < 3 * step:
        rule, remedy = f"must be three grid steps of {step:.3g} m or more", "raise it, or make the "
        at = (*location, "craters", "smallest")
        yield Finding(at, rule, f"{remedy}grid finer", f"{smallest:g} m")


def _solid_findings(thing: scenes.Solid, location: Location) -> Iterator[Finding]:
    """Report a solid that is placed twice or nowhere, or whose lengths have no unit."""
    place = (*location, "position")
    if thing.motion is not None and thing.position is not None:
        rule = "stands beside a motion, whose path places the object"
        yield Finding(place, rule, "leave one of them out")
    if isinstance(thing, _PLACED) and thing.motion is None and thing.position is None:
        yield Finding(place, "is missing", "write e.g. 'position: [0 m, 0 m, 10 m]'")
    yield from _refused(thing.rotation.turn, (*location, "rotation"))
    if isinstance(thing, scenes.MeshObject) and thing.unit is not None:
        try:
            read_unit(thing.unit, si_unit="m", example="mm")
        except QuantityError as error:
            yield Finding((*location, "unit"), error.rule, error.suggestion, thing.unit)


# The flight: paths, attitudes, scan patterns, and targets that move


def _flight_findings(
    platform: flights.Platform | None,
    scanners: Mapping[str, Any],
    objects: Mapping[str, Any],
    base: Path | None,
) -> list[Finding]:
    """Mistakes in platform, scanners and moving objects, of those that can be read."""
    span: flights.Span | None = None
    findings: list[Finding] = []
    files = Files(base or Path())
    if platform is not None and (base is not None or not _on_files(platform)):
        with contextlib.suppress(SceneError):  # which is found where the path is made
            files = replace(files, time_origin=platform.time_origin(files))
        findings += _motion_findings(platform, ("platform",), files, None)
        if not findings:
            path = platform.path.path(files)
            span = path.start, path.stop
    for name, scanner in scanners.items():
        findings += _pattern_findings(scanner, ("scanners", name), span)
    for name, thing in objects.items():
        motion = getattr(thing, "motion", None)
        if motion is not None and span is not None and (base or not _on_files(motion)):
            findings += _motion_findings(motion, (*OBJECTS, name, "motion"), files, span)
    return findings


def _on_files(motion: flights.Motion) -> bool:
    """Return true if a path or an attitude is read from a table."""
    return motion.path.kind == "waypoints" or motion.attitude.kind == "track"


def _motion_findings(
    motion: flights.Motion, location: Location, files: Files, span: flights.Span | None
) -> Iterator[Finding]:
    """Report a path or attitude that can not be flown, or a path shorter than the flight."""
    section = "path"
    try:
        path = motion.path.path(files, span)
        section = "attitude"
        motion.law(files, path)
        section = "mounting"
        flight = motion.flight(files, span)
        section = "attitude"
        flight.state(np.linspace(path.start, path.stop, _LOOKS))
    except SceneError as error:
        yield Finding((*location, section, "file"), f"names a file that {error.rule}", error.remedy)
        return
    except (ValueError, ArithmeticError) as error:
        yield Finding((*location, section), f"can not be made: {error}")
        return
    if span is not None and not (path.start <= span[0] and path.stop >= span[1]):
        rule = (
            f"lasts from {path.start:g} to {path.stop:g} s, and the flight from {span[0]:g} to "
            f"{span[1]:g} s"
        )
        yield Finding((*location, "path"), rule, "make it last throughout the flight")


def _pattern_findings(
    scanner: Any, location: Location, span: flights.Span | None
) -> Iterator[Finding]:
    """Report a scan pattern that can not be made, or makes no whole cycle or too many shots."""
    unfit = _refused(scanner.pattern, location)
    yield from unfit
    if unfit or span is None:
        return
    pattern = scanner.pattern()
    each = flights.shots_a_cycle(pattern)
    shots, flight = pattern.number(span[1] - span[0]), f"in a flight of {span[1] - span[0]:.6g} s"
    if shots < each:
        rule = f"makes no whole cycle of {each} shots {flight}"
        yield Finding((*location, "rate"), rule, "raise it, or lengthen the flight")
    elif shots > SHOTS_MAX:
        rule = f"makes {shots:.3g} shots {flight}, and a scanner has at most {SHOTS_MAX:.0e}"
        remedy = "lower the rate, or shorten the flight: mind times and speeds in platform.path"
        yield Finding((*location, "rate"), rule, remedy)


# Axes: what may vary while the light falls where it fell


def stored_names() -> frozenset[str]:
    """Names of a store's arrays and dimensions."""
    tables = (SHOTS, CYCLES, STATISTICS, POINTS, NAVIGATION)
    dims = (output.dims for table in tables for output in table.values())
    return frozenset().union(*tables, *dims)


_OTHER = "make another study of it"
_BEAMS = (beam.DIVERGENCE, beam.WAIST, beam.QUALITY, beam.FOCUS, beam.RECEIVED_WAIST, beam.COUPLING)
_ARRANGED = (
    PATTERN, "footprint.phases", beam.ARCHITECTURE, beam.COUPLING, beam.WAIST, beam.FOCUS
)  # fmt: skip
"""Parameters that say where beamlets go."""
_MOVES = ("moves the beamlets, and a study casts its rays once", _OTHER)
_REASONS = {
    "footprint.speckle": ("", ""),  # which moves no beamlet
    "target.": ("is given by the scene, shot by shot", "change the scene or the flight"),
    **dict.fromkeys((*_BEAMS, "footprint."), _MOVES),
    "accuracy.": ("says how closely to compute, the same for a whole study", _OTHER),
}


def why_not(path: str) -> tuple[str, str]:
    """Why an axis can't set a parameter, and a remedy; empty where it can."""
    return next((why for start, why in _REASONS.items() if path.startswith(start)), ("", ""))


def parameter_findings(
    p: Mapping[str, Any], path: str, values: Iterable[Any], location: Location
) -> list[Finding]:
    """Mistakes in one of the parameters taking several values, which stand at a location."""
    rule, remedy = why_not(path)
    if rule:
        return [Finding(location, rule, remedy)]
    if path == beam.WAVELENGTH and not beam.is_thesis(p):
        rule = "moves the beamlets, as the beam's radius follows from it, and rays are cast once"
        return [Finding(location, rule, f"{_OTHER}, or take coupling: aperture")]
    if path != beam.ARCHITECTURE:
        return []
    each = [p, *({**p, path: str(value)} for value in values)]
    modes = {one[path] == "direct" for one in each}
    if len(set(map(pattern_of, each))) > 1 or (
        len(modes) > 1 and not all(map(beam.is_thesis, each))
    ):
        rule = "moves the beamlets between direct detection and the others"
        remedy = f"{_OTHER}, or take coherent phases and coupling: aperture"
        return [Finding(location, rule, remedy)]
    return []


def axis_findings(grid: Grid) -> Iterator[Finding]:
    """Axes of what can not vary on one geometry."""
    p = {path: default_of(path) for path in _ARRANGED} | dict(grid.values)
    if p[PATTERN] in ("line", "square"):
        rule = "stands for a plane alone, and the ground of a scene is none"
        yield Finding(("footprint", "pattern"), rule, "take hexagonal", p[PATTERN])
    for axis in grid.axes:
        for member in axis.members:
            at = place_on_grid(member.path, grid.axes)
            yield from parameter_findings(p, member.path, member.values, at)
        if axis.zipped and axis.name in stored_names():
            rule = "bears the name of something stored"
            yield Finding(("axes", axis.name), rule, "take a word such as 'cut'")
