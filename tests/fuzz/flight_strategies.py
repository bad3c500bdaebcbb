"""Random flights: every kind of object, path, attitude and scanner; few rays and shots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from section_strategies import DECADES_OF_SPREAD, SectionStrategies
from study_strategies import (
    STUDY_BOUNDS,
    TIMING_PATHS,
    axes_strategy,
    axis_rules,
    paths_on_axes,
    remove_field,
)

from sweep.spec import SceneSpec, SpecError
from sweep.spec.fields import SpecFiles, kind_of_model, models_of_annotation
from sweep.spec.flight_sections import Platform
from sweep.spec.ground_sections import Ground
from sweep.spec.scene_sections import AnySceneObject
from sweep.spec.sections import Instrument

GROUND_KINDS = frozenset(
    kind_of_model(m) for m in models_of_annotation(AnySceneObject) if issubclass(m, Ground)
)
FILE_BY_FIELD = {
    "RasterGround.file": "ground.tif",
    "ArrayGround.file": "ground.npy",
    "ImageGround.file": "ground.png",
    "MeshObject.file": "box.stl",
    "WaypointPath.file": "path.csv",
    "TabulatedAttitude.file": "path.csv",
}


def write_files(folder: Path) -> None:
    """The small files that random scenes name."""
    import rasterio
    import trimesh
    from PIL import Image

    heights = np.hypot(*np.meshgrid(np.linspace(-3, 3, 12), np.linspace(-2, 4, 9)))
    np.save(folder / "ground.npy", heights)
    Image.fromarray((heights * 40).astype(np.uint8)).save(folder / "ground.png")
    profile = {"driver": "GTiff", "height": 9, "width": 12, "count": 1, "dtype": "float64"}
    transform = rasterio.transform.from_origin(-600, 450, 100, 100)  # of a map of its own
    with rasterio.open(folder / "ground.tif", "w", transform=transform, **profile) as file:
        file.write(heights, 1)
    trimesh.creation.box(extents=(20.0, 30.0, 10.0)).export(folder / "box.stl")
    times = np.linspace(0, 8, 5)
    rows = [f"{t},{10 * t},{-5 * t},{900 - 40 * t},{3 * t},{t},0" for t in times]
    header = "time [s],x [m],y [m],z [m],heading [deg],pitch [deg],roll [deg]"
    (folder / "path.csv").write_text("\n".join([header, *rows]) + "\n")


def _position_strategy(low: int, high: int) -> st.SearchStrategy[list[str]]:
    """Places over the middle of the scene, so many metres up."""
    across = st.integers(-200, 200).map(lambda value: f"{value} m")
    up = st.integers(low, high).map(lambda value: f"{value} m")
    return st.tuples(across, across, up).map(list)


FLIGHT_BOUNDS: dict[str, Any] = {
    "SceneDraws.number": {"at_most": "4", "example": "2"},
    "SceneDraws.returns": {"at_most": "4", "example": "2"},
    "SceneStorage.block_shots": {"at_most": "40", "example": "8"},
    "SceneStorage.block_draws": {"at_most": "3", "example": "2"},
    "Ground.factor": {"at_most": "3", "example": "2"},
    "SquareGround.size": {"at_least": "500 m", "at_most": "5 km", "example": "2 km"},
    "PlaneGround.spacing": {"at_least": "100 m", "at_most": "10 km", "example": "200 m"},
    "ReliefGround.spacing": {"at_least": "100 m", "at_most": "10 km", "example": "200 m"},
    "HillsGround.spacing": {"at_least": "100 m", "at_most": "10 km", "example": "200 m"},
    "HillsGround.correlation_length": {"example": "900 m"},
    "Craters.smallest": {"at_least": "200 m", "example": "650 m"},
    "Craters.largest": {"example": "900 m"},
    "JacksboroGround.size": {"at_most": "6 km"},
    "Trees.number": {"at_most": "3", "example": "2"},
    "TreeDimensions.crown_diameter": {"at_most": "8 m", "example": "6 m"},
    "TreeDimensions.leaf_length": {"at_least": "60 cm", "example": "80 cm"},
    "TreeDimensions.leaf_width": {"at_least": "50 cm", "example": "60 cm"},
    "TreeDimensions.leaf_area_index": {"at_most": "1.5", "example": "1"},
    "Boulders.smallest": {"at_least": "1 m", "example": "2 m"},
    "Boulders.within": {"at_most": "60 m", "example": "50 m"},
    "Boulders.subdivisions": {"at_most": "1", "example": "1"},
    "PowerLaw.density": {"at_most": "0.01 m^-2", "example": "0.01 m^-2"},
    "Sphere.subdivisions": {"at_most": "2", "example": "2"},
    "ConeScanner.beams": {"at_most": "5"},
    "RasterScanner.columns": {"at_most": "4", "example": "3"},
    "RasterScanner.rows": {"at_most": "4", "example": "2"},
    "StraightPath.begin": _position_strategy(200, 2000),
    "StraightPath.to": _position_strategy(50, 1500),
    "StationaryPath.position": _position_strategy(20, 2000),
    "AccelerationPath.position": _position_strategy(200, 2000),
}
"""Tighter bounds of what decides how many triangles, rays and shots there are; and flights that
mostly see something."""

COSTLY_DEFAULTS = {
    "Footprint.beamlets", "JacksboroGround.size", "Boulders.within", "Sphere.subdivisions",
    "Trees.tree",
    "TreeDimensions.leaf_length", "TreeDimensions.leaf_width", "StationaryPath.duration",
    "SceneDraws.number",
}  # fmt: skip
SECTION_STRATEGIES = SectionStrategies(STUDY_BOUNDS | FLIGHT_BOUNDS, FILE_BY_FIELD, COSTLY_DEFAULTS)
SECTION_NAMES = tuple(
    name for name in SceneSpec.model_fields if name not in ("axes", "figures", "scene")
)
RULE_BY_VARIABLE_PATH = {
    path: rule for path, rule in axis_rules().items() if SceneSpec.may_be_on_axis(path)
}


@st.composite
def flights(draw: st.DrawFn, folder: Path) -> dict[str, Any]:
    """A flight over a scene, each of whose fields is valid by itself, as written in a file."""
    decades = draw(st.sampled_from(DECADES_OF_SPREAD))
    mapping: dict[str, Any] = {}
    for name in SECTION_NAMES:
        field = SceneSpec.model_fields[name]
        if field.is_required() or name == "footprint" or draw(st.booleans()):
            mapping[name] = draw(SECTION_STRATEGIES.field_value(SceneSpec, name, decades))
    mapping["scene"] = draw(scenes(decades))
    if draw(st.booleans()):
        mapping["axes"] = draw(axes_strategy(RULE_BY_VARIABLE_PATH, decades))
        for path in paths_on_axes(mapping["axes"]):
            remove_field(mapping, path)
    _limit_cycles(mapping, folder, draw(st.integers(1, 4)))
    return without_rejected_parts(mapping, folder) if draw(st.integers(0, 4)) else mapping


PLAIN_GROUND = {"kind": "plane", "size": "4 km", "reflectance": 0.3}


@st.composite
def scenes(draw: st.DrawFn, decades: float) -> dict[str, Any]:
    """A scene whose references are to its own grounds, if it has any."""
    scene = draw(SECTION_STRATEGIES.section(SceneSpec.model_fields["scene"].annotation, decades))
    grounds = [
        object_name
        for object_name, scene_object in scene["objects"].items()
        if scene_object["kind"] in GROUND_KINDS
    ]
    if not grounds or draw(st.booleans()):
        scene["objects"] = {"plain": PLAIN_GROUND, **scene["objects"]}
        grounds.append("plain")
    scene["origin"] = draw(st.sampled_from([*grounds, "world"]))
    for scene_object in scene["objects"].values():
        if "on" in scene_object:
            scene_object["on"] = draw(st.sampled_from(grounds))
    return scene


def _limit_cycles(mapping: dict[str, Any], folder: Path, cycles: int) -> None:
    """Set the scanners' rates so that the flight has but a few cycles."""
    try:
        path = Platform.model_validate(mapping["platform"]).path.build_trajectory(SpecFiles(folder))
    except ValueError:
        return
    for scanner in mapping["scanners"].values():
        rate = (cycles + 0.01) / (path.stop_time - path.start_time)
        scanner["rate"] = f"{rate:.6g} Hz"
        if scanner["kind"] == "line":
            scanner["line_rate"] = f"{rate * 0.7:.6g} Hz"


def without_rejected_parts(mapping: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The flight without what it is refused for, as far as that can be left out."""
    for _ in range(5):
        try:
            SceneSpec.from_mapping(mapping, base=folder)
        except SpecError as error:
            for mistake in error.mistakes:
                _remove_rejected(mapping, mistake.path)
        else:
            break
    return mapping


def _remove_rejected(mapping: dict[str, Any], path: str) -> None:
    """Take out what is to blame: an axis, an object, a field of the instrument, a placed origin."""
    top, *inner = path.split(".")
    if top == "axes":
        mapping.pop("axes", None)
        for parameter_path in (*TIMING_PATHS, *paths_on_axes({})):
            remove_field(mapping, parameter_path)
        _fill_instrument_examples(mapping)
    elif top == "scene" and len(inner) > 1 and inner[1] != "plain":
        mapping["scene"]["objects"].pop(inner[1], None)
        if len(inner) == 3 and inner[2] == "position":
            mapping["scene"]["origin"] = "world"
    elif top == "platform" and inner and inner[0] != "path":
        mapping["platform"].pop(inner[0], None)
    else:
        remove_field(mapping, path)
        _fill_instrument_examples(mapping)
    objects = mapping["scene"].setdefault("objects", {}) or {"plain": PLAIN_GROUND}
    mapping["scene"]["objects"] = objects
    if mapping["scene"].get("origin") not in objects:
        mapping["scene"]["origin"] = "world"


def _fill_instrument_examples(mapping: dict[str, Any]) -> None:
    """Put examples where the instrument lacks something."""
    for name, section in Instrument.model_fields.items():
        section_fields = mapping["instrument"].setdefault(name, {})
        for key, field in section.annotation.model_fields.items():
            if field.is_required() and key not in section_fields:
                section_fields[key] = EXAMPLE_BY_PATH[f"instrument.{name}.{key}"]


EXAMPLE_BY_PATH = {path: getattr(rule, "example", "") for path, rule in axis_rules().items()}
