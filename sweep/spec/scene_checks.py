"""Checks of a scene's spec beyond its single fields.

They cover names and references, objects, files, the flight, and axes. A scene's rays are cast once,
so that no axis may change where beamlets hit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import sweep.spec.fields as declare
import sweep.spec.flight_sections as flight_sections
import sweep.spec.scene_sections as scene_sections
from sweep.model import beam
from sweep.model.beamlet_counts import PATTERN_PATH
from sweep.model.ground import beamlet_pattern as beamlet_pattern
from sweep.model.outputs import (
    CYCLE_VARIABLES,
    NAVIGATION_VARIABLES,
    POINT_CLOUD_VARIABLES,
    SHOT_GEOMETRY_VARIABLES,
    SHOT_STATISTIC_VARIABLES,
)
from sweep.scenes.map_frames import metres_per_height_unit
from sweep.scenes.scene_files import SceneError
from sweep.spec.axes import parameter_location
from sweep.spec.fields import SpecFiles, iter_file_fields, validate_or_none
from sweep.spec.grid_checks import GridValues, raw_value_at
from sweep.spec.ground_sections import Craters, Ground, JacksboroGround, RasterGround
from sweep.spec.rules import Finding, SpecLocation, suggest_similar_name
from sweep.spec.sections import default_value
from sweep.units import QuantityError, read_unit

SHOTS_PER_SCANNER_MAX = 10**9
"""Largest number of shots of a scanner in a flight; arrays of this length must fit into memory."""

RESERVED_SCANNER_NAMES = ("scene_map",)
"""Names that no scanner may have, because a store uses them for groups of other content."""
_SOLIDS_WITH_REQUIRED_POSITION = (scene_sections.Sphere, scene_sections.Box)
"""Models of solids that must have either a position or a motion."""
OBJECTS_SECTION_LOCATION: SpecLocation = ("scene", "objects")
"""Keys that lead to the section of objects in a scene's spec."""
_N_ATTITUDE_TRIAL_TIMES = 257
"""Number of times along a path at which an attitude is computed to find out whether it exists."""


def _raw_section(raw_spec: Mapping[str, Any], *path: str | int) -> dict[str, Any]:
    """Return the section at the given keys of a parsed spec; an empty dict if there is none."""
    raw_section = raw_value_at(raw_spec, ".".join(map(str, path)))
    return dict(raw_section) if isinstance(raw_section, Mapping) else {}


def _valid_sections_by_name(raw_sections: Mapping[str, Any], annotation: Any) -> dict[str, Any]:
    """Return the models of the sections that are valid as `annotation`, by the sections' names."""
    sections = {name: validate_or_none(annotation, value) for name, value in raw_sections.items()}
    return {name: section for name, section in sections.items() if section is not None}


def scene_findings(raw_spec: Mapping[str, Any], base: Path | None) -> list[Finding]:
    """Return a `Finding` for each mistake in scene, platform and scanners, beyond single fields.

    Parameters
    ----------
    raw_spec : Mapping
        Spec as parsed from YAML. Sections that can't be read are skipped.
    base : Path or None
        Folder that paths in the spec are relative to; None skips all checks that read files.
    """
    objects = _valid_sections_by_name(
        _raw_section(raw_spec, *OBJECTS_SECTION_LOCATION), scene_sections.AnySceneObject
    )
    scanners = _valid_sections_by_name(
        _raw_section(raw_spec, "scanners"), flight_sections.AnyScanner
    )
    platform = validate_or_none(flight_sections.Platform, raw_spec.get("platform"))
    findings = [
        *_name_findings(
            raw_spec,
            OBJECTS_SECTION_LOCATION,
            lambda name: name == scene_sections.WORLD_ORIGIN_KEYWORD,
            "scene",
        ),
        *_name_findings(
            raw_spec, ("scanners",), lambda name: name in RESERVED_SCANNER_NAMES, "store"
        ),
        *_reference_findings(raw_spec, objects),
    ]
    for name, scene_object in objects.items():
        findings += _object_findings(scene_object, (*OBJECTS_SECTION_LOCATION, name))
    file_findings = [] if base is None else list(_file_findings(objects, platform, base))
    known_locations = {finding.location for finding in file_findings}
    flight_findings = _flight_findings(platform, scanners, objects, base)
    return (
        findings
        + file_findings
        + [finding for finding in flight_findings if finding.location not in known_locations]
    )


# Names, references, files


def _name_findings(
    raw_spec: Mapping[str, Any],
    section_location: SpecLocation,
    is_taken: Callable[[str], bool],
    owner: str,
) -> Iterator[Finding]:
    """Yield a `Finding` for each invalid or reserved name in a section, and for an empty section.

    `is_taken` returns True for a reserved name. `owner`, a word for the message, has reserved the
    names: ``scene`` or ``store``.
    """
    raw_sections = _raw_section(raw_spec, *section_location)
    for name in raw_sections:
        try:
            declare.object_name_rule("Name").read(name)
        except QuantityError as error:
            yield Finding((*section_location, name), "is no name", error.suggestion)
        if is_taken(name):
            yield Finding((*section_location, name), f"is a name that the {owner} has taken")
    if not raw_sections and isinstance(
        raw_value_at(raw_spec, ".".join(map(str, section_location))), Mapping
    ):
        yield Finding(section_location, "holds nothing", "name at least one")


def _reference_findings(
    raw_spec: Mapping[str, Any], objects: Mapping[str, Any]
) -> Iterator[Finding]:
    """Yield a `Finding` for each reference to a missing ground, and for an origin with a position.

    The ground that ``scene.origin`` names lies at zero and may not state a position.
    """
    raw_objects = _raw_section(raw_spec, *OBJECTS_SECTION_LOCATION)
    if not raw_objects:
        return
    origin = _raw_section(raw_spec, "scene").get("origin", scene_sections.WORLD_ORIGIN_KEYWORD)
    if isinstance(origin, str) and origin != scene_sections.WORLD_ORIGIN_KEYWORD:
        yield from _ground_reference_findings(
            origin, ("scene", "origin"), raw_objects, objects, ", or 'world'"
        )
        if any(getattr(objects.get(origin), "position", None) or ()):
            problem, remedy = "places the scene's origin, which lies at zero", "leave it out, or "
            yield Finding(
                (*OBJECTS_SECTION_LOCATION, origin, "position"),
                problem,
                f"{remedy}take another origin",
            )
    for name, raw_object in raw_objects.items():
        ground_name = raw_object.get("on") if isinstance(raw_object, Mapping) else None
        if isinstance(ground_name, str):
            yield from _ground_reference_findings(
                ground_name, (*OBJECTS_SECTION_LOCATION, name, "on"), raw_objects, objects, ""
            )


def _ground_reference_findings(
    name: str,
    location: SpecLocation,
    raw_objects: Mapping[str, Any],
    objects: Mapping[str, Any],
    extra_remedy: str,
) -> Iterator[Finding]:
    """Yield a `Finding` if `name`, written at `location`, is not the name of a ground in the scene.

    `raw_objects` are the scene's objects as parsed from YAML, `objects` the models of valid ones.
    """
    grounds = [key for key, scene_object in objects.items() if isinstance(scene_object, Ground)]
    remedy = f"the grounds are {', '.join(grounds)}" if grounds else "add a ground"
    remedy += extra_remedy
    if name not in raw_objects:
        problem = "is no object of the scene"
        yield Finding(
            location, problem, suggest_similar_name(name, raw_objects, fallback=remedy), name
        )
    elif name in objects and name not in grounds:
        yield Finding(location, "is no ground", remedy, name)


def _file_findings(
    objects: Mapping[str, Any], platform: flight_sections.Platform | None, base: Path
) -> Iterator[Finding]:
    """Yield a `Finding` for each file of objects or platform that is missing or can't be read."""
    located_sections: list[tuple[SpecLocation, Any]] = [
        ((*OBJECTS_SECTION_LOCATION, name), section) for name, section in objects.items()
    ]
    located_sections += [] if platform is None else [(("platform",), platform)]
    for location, section in located_sections:
        for key_path, rule, file in iter_file_fields(section):
            path = SpecFiles(base).resolve(file)
            try:
                rule.compute_digest(path)
            except SceneError as error:
                is_companion = error.file != str(path)
                companion_text = f"needs {error.file}, which " if is_companion else ""
                problem = f"names a file that {companion_text}{error.problem}"
                yield Finding((*location, *key_path), problem, error.remedy, file)


# Objects


def _construction_findings(
    construct: Callable[[], object], location: SpecLocation
) -> list[Finding]:
    """Call `construct`; return a list with one `Finding` if it raises an error, else with none."""
    try:
        construct()
    except (ValueError, ArithmeticError) as error:
        return [Finding(location, f"can not be made: {error}")]
    return []


def _object_findings(scene_object: Any, location: SpecLocation) -> Iterator[Finding]:
    """Yield a `Finding` for each mistake in an object's fields, except references and files."""
    if isinstance(scene_object, Ground):
        yield from _ground_findings(scene_object, location)
    if isinstance(scene_object, RasterGround) and scene_object.height_unit is not None:
        try:
            metres_per_height_unit(scene_object.height_unit)
        except QuantityError as error:
            yield Finding((*location, "height_unit"), error.rule, "write m, ft or sft")
    if isinstance(scene_object, scene_sections.SolidObject):
        yield from _solid_findings(scene_object, location)
    if isinstance(scene_object, scene_sections.Boulders):
        yield from _diameter_findings(scene_object, location)
    if (
        isinstance(scene_object, scene_sections.Trees)
        and not scene_object.tree.crown_base < scene_object.tree.height
    ):
        base_text, top_text = (
            f"{scene_object.tree.crown_base:g} m",
            f"{scene_object.tree.height:g} m",
        )
        field_location = (*location, "tree", "crown_base")
        if "crown_base" in scene_object.tree.model_fields_set:
            yield Finding(
                field_location, f"must lie below the top, {top_text}", "lower it", base_text
            )
        else:
            yield Finding(
                field_location,
                f"is {base_text} by default, and must lie below the top, {top_text}",
                "lower it",
            )


def _diameter_findings(
    section: scene_sections.Boulders | Craters, location: SpecLocation
) -> Iterator[Finding]:
    """Yield a `Finding` if the largest diameter is not larger than the smallest."""
    if not section.smallest < section.largest:
        problem = f"must exceed the smallest diameter, {section.smallest:g} m"
        yield Finding((*location, "largest"), problem, "", f"{section.largest:g} m")


def _ground_findings(ground: Ground, location: SpecLocation) -> Iterator[Finding]:
    """Yield a `Finding` for an invalid grid, and for craters smaller than three grid steps."""
    field_name = "middle" if isinstance(ground, JacksboroGround) else "spacing"
    construction_findings = _construction_findings(ground.check_grid, (*location, field_name))
    yield from construction_findings
    if ground.craters is None:
        return
    yield from _diameter_findings(ground.craters, (*location, "craters"))
    step, smallest = None if construction_findings else ground.grid_step(), ground.craters.smallest
    if step is not None and smallest < 3 * step:
        problem, remedy = (
            f"must be three grid steps of {step:.3g} m or more",
            "raise it, or make the ",
        )
        field_location = (*location, "craters", "smallest")
        yield Finding(field_location, problem, f"{remedy}grid finer", f"{smallest:g} m")


def _solid_findings(
    scene_object: scene_sections.SolidObject, location: SpecLocation
) -> Iterator[Finding]:
    """Yield a `Finding` for each mistake in a solid's position, rotation or unit of length.

    A solid must not have both a position and a motion. A sphere or box must have one of them.
    """
    position_location = (*location, "position")
    if scene_object.motion is not None and scene_object.position is not None:
        problem = "is given in addition to a motion, whose path places the object"
        yield Finding(position_location, problem, "leave one of them out")
    if (
        isinstance(scene_object, _SOLIDS_WITH_REQUIRED_POSITION)
        and scene_object.motion is None
        and scene_object.position is None
    ):
        yield Finding(position_location, "is missing", "write e.g. 'position: [0 m, 0 m, 10 m]'")
    yield from _construction_findings(scene_object.rotation.to_quaternion, (*location, "rotation"))
    if isinstance(scene_object, scene_sections.MeshObject) and scene_object.unit is not None:
        try:
            read_unit(scene_object.unit, si_unit="m", example="mm")
        except QuantityError as error:
            yield Finding((*location, "unit"), error.rule, error.suggestion, scene_object.unit)


# The flight: paths, attitudes, scan patterns and moving targets


def _flight_findings(
    platform: flight_sections.Platform | None,
    scanners: Mapping[str, Any],
    objects: Mapping[str, Any],
    base: Path | None,
) -> list[Finding]:
    """Return a `Finding` for each mistake in platform, scanners and moving objects.

    `platform` is None if it can't be read, and is skipped. Tables are not read if `base`, the
    folder of files, is None.
    """
    span: flight_sections.TimeSpan | None = None
    findings: list[Finding] = []
    files = SpecFiles(base or Path())
    if platform is not None and (base is not None or not _reads_tables(platform)):
        with contextlib.suppress(SceneError):  # _motion_findings reports this error
            files = replace(files, time_origin=platform.read_time_origin(files))
        findings += _motion_findings(platform, ("platform",), files, None)
        if not findings:
            path = platform.path.build_trajectory(files)
            span = path.start_time, path.stop_time
    for name, scanner in scanners.items():
        findings += _scan_pattern_findings(scanner, ("scanners", name), span)
    for name, scene_object in objects.items():
        motion = getattr(scene_object, "motion", None)
        if motion is not None and span is not None and (base or not _reads_tables(motion)):
            findings += _motion_findings(
                motion, (*OBJECTS_SECTION_LOCATION, name, "motion"), files, span
            )
    return findings


def _reads_tables(motion: flight_sections.RigidMotion) -> bool:
    """Return True if the path or the attitude of a motion is read from a table in a file."""
    return motion.path.kind == "waypoints" or motion.attitude.kind == "track"


def _motion_findings(
    motion: flight_sections.RigidMotion,
    location: SpecLocation,
    files: SpecFiles,
    span: flight_sections.TimeSpan | None,
) -> Iterator[Finding]:
    """Yield a `Finding` for an invalid path or attitude, and for a path shorter than the flight.

    `span` is start and end of the flight [s]; None if `motion` is the platform's own motion.
    """
    field_name = "path"
    try:
        path = motion.path.build_trajectory(files, span)
        field_name = "attitude"
        motion.build_attitude(files, path)
        field_name = "mounting"
        flight = motion.build_moving_body(files, span)
        field_name = "attitude"
        flight.state(np.linspace(path.start_time, path.stop_time, _N_ATTITUDE_TRIAL_TIMES))
    except SceneError as error:
        yield Finding(
            (*location, field_name, "file"), f"names a file that {error.problem}", error.remedy
        )
        return
    except (ValueError, ArithmeticError) as error:
        yield Finding((*location, field_name), f"can not be made: {error}")
        return
    if span is not None and not (path.start_time <= span[0] and path.stop_time >= span[1]):
        problem = (
            f"lasts from {path.start_time:g} to {path.stop_time:g} s, and the flight "
            f"from {span[0]:g} to {span[1]:g} s"
        )
        yield Finding((*location, "path"), problem, "make it last throughout the flight")


def _scan_pattern_findings(
    scanner: Any, location: SpecLocation, span: flight_sections.TimeSpan | None
) -> Iterator[Finding]:
    """Yield a `Finding` if a scan pattern is invalid, or has less than a cycle or too many shots.

    `span` is start and end of the flight [s]; None skips the check of the number of shots.
    """
    construction_findings = _construction_findings(scanner.build_pattern, location)
    yield from construction_findings
    if construction_findings or span is None:
        return
    pattern = scanner.build_pattern()
    shots_per_cycle = flight_sections.shots_per_cycle(pattern)
    shots, flight = (
        pattern.count_shots(span[1] - span[0]),
        f"in a flight of {span[1] - span[0]:.6g} s",
    )
    if shots < shots_per_cycle:
        problem = f"makes no whole cycle of {shots_per_cycle} shots {flight}"
        yield Finding((*location, "rate"), problem, "raise it, or lengthen the flight")
    elif shots > SHOTS_PER_SCANNER_MAX:
        problem = (
            f"makes {shots:.3g} shots {flight}, and a scanner has at most "
            f"{SHOTS_PER_SCANNER_MAX:.0e}"
        )
        remedy = "lower the rate, or shorten the flight: mind times and speeds in platform.path"
        yield Finding((*location, "rate"), problem, remedy)


# Axes: parameters that may vary without moving a beamlet


def store_array_and_dimension_names() -> frozenset[str]:
    """Return the names of all arrays and dimensions that the store of a scene may have."""
    output_tables = (
        SHOT_GEOMETRY_VARIABLES,
        CYCLE_VARIABLES,
        SHOT_STATISTIC_VARIABLES,
        POINT_CLOUD_VARIABLES,
        NAVIGATION_VARIABLES,
    )
    dims = (output.dims for table in output_tables for output in table.values())
    return frozenset().union(*output_tables, *dims)


_OTHER_STUDY_REMEDY = "make another study of it"
_BEAM_WIDTH_PATHS = (
    beam.DIVERGENCE_PATH,
    beam.WAIST_PATH,
    beam.BEAM_QUALITY_PATH,
    beam.FOCUS_PATH,
    beam.OSCILLATOR_WAIST_PATH,
    beam.COUPLING_PATH,
)
"""Dotted paths of the parameters from which the beam's width follows."""
_BEAMLET_POSITION_PATHS = (
    PATTERN_PATH,
    "footprint.phases",
    beam.ARCHITECTURE_PATH,
    beam.COUPLING_PATH,
    beam.WAIST_PATH,
    beam.FOCUS_PATH,
)
"""Dotted paths of the parameters that determine where beamlets, the rays of a beam, hit."""


class AxisRefusal(NamedTuple):
    """Why no axis may set a parameter; both texts are empty if an axis may."""

    problem: str
    """Reason why no axis may set the parameter, as the end of a sentence; empty if one
    may."""
    remedy: str
    """Advice on what to do instead of an axis; empty if an axis may set the parameter."""


_NO_REFUSAL = AxisRefusal("", "")
"""Refusal with empty texts, for a parameter that an axis may set."""
_MOVES_BEAMLETS_REFUSAL = AxisRefusal(
    "moves the beamlets, and a study casts its rays once",
    _OTHER_STUDY_REMEDY,
)
"""Refusal of an axis over a parameter that moves beamlets, the rays of a beam."""
_AXIS_REFUSALS = {
    "footprint.speckle": _NO_REFUSAL,  # moves no beamlet, unlike other fields of footprint
    "target.": AxisRefusal("is given by the scene, shot by shot", "change the scene or the flight"),
    **dict.fromkeys((*_BEAM_WIDTH_PATHS, "footprint."), _MOVES_BEAMLETS_REFUSAL),
    "accuracy.": AxisRefusal(
        "says how closely to compute, the same for a whole study", _OTHER_STUDY_REMEDY
    ),
}
"""Refusal of an axis over a parameter, by prefix of the parameter's dotted path.

The first prefix with which a path begins applies.
"""


def axis_refusal(path: str) -> AxisRefusal:
    """Return why no axis may set a parameter of a scene, and advice; empty texts if one may.

    Parameters
    ----------
    path : str
        Dotted path of the parameter.

    Returns
    -------
    AxisRefusal
        Problem and remedy.
    """
    return next(
        (
            refusal
            for path_prefix, refusal in _AXIS_REFUSALS.items()
            if path.startswith(path_prefix)
        ),
        _NO_REFUSAL,
    )


def variation_findings(
    parameters: Mapping[str, Any], path: str, values: Iterable[Any], location: SpecLocation
) -> list[Finding]:
    """Return a `Finding` for each reason why one parameter of a scene may not take several values.

    Parameters
    ----------
    parameters : Mapping
        SI values of all parameters by dotted path.
    path : str
        Dotted path of the parameter that varies.
    values : Iterable
        SI values that it takes.
    location : SpecLocation
        Location of the values in the spec, for findings.
    """
    problem, remedy = axis_refusal(path)
    if problem:
        return [Finding(location, problem, remedy)]
    if path == beam.WAVELENGTH_PATH and not beam.has_constant_divergence(parameters):
        problem = "moves the beamlets, as the beam's radius follows from it, and rays are cast once"
        return [Finding(location, problem, f"{_OTHER_STUDY_REMEDY}, or take coupling: aperture")]
    if path != beam.ARCHITECTURE_PATH:
        return []
    variants = [parameters, *({**parameters, path: str(value)} for value in values)]
    is_direct = {variant[path] == "direct" for variant in variants}
    if len(set(map(beamlet_pattern, variants))) > 1 or (
        len(is_direct) > 1 and not all(map(beam.has_constant_divergence, variants))
    ):
        problem = "moves the beamlets between direct detection and the others"
        remedy = f"{_OTHER_STUDY_REMEDY}, or take coherent phases and coupling: aperture"
        return [Finding(location, problem, remedy)]
    return []


def scene_axis_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` for each axis invalid in a scene, and for an unsuitable beamlet pattern.

    An axis is invalid if it changes where rays hit, because rays are cast once, or if a store uses
    its name. A beamlet pattern is unsuitable if it only fits a plane.
    """
    parameters = {path: default_value(path) for path in _BEAMLET_POSITION_PATHS} | dict(
        grid.field_values
    )
    if parameters[PATTERN_PATH] in ("line", "square"):
        problem = "is only for a plane, and the ground of a scene is none"
        yield Finding(("footprint", "pattern"), problem, "take hexagonal", parameters[PATTERN_PATH])
    for axis in grid.axes:
        for parameter in axis.parameters:
            location = parameter_location(parameter.path, grid.axes)
            yield from variation_findings(parameters, parameter.path, parameter.values, location)
        if axis.is_zipped and axis.name in store_array_and_dimension_names():
            problem = "has the name of an array or dimension of the store"
            yield Finding(("axes", axis.name), problem, "take a word such as 'cut'")
