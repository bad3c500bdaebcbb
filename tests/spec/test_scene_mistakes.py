"""Users' mistakes in scene studies: each told once, with its path, its rule and a remedy."""

import copy
import json
import math
import pickle

import pytest
import yaml
from base_scene_spec import (
    BOULDERS_OBJECT,
    BOX_OBJECT,
    HILLS_OBJECT,
    RELIEF_OBJECT,
    SPHERE_OBJECT,
    TREES_OBJECT,
    changed_scene,
    scene_with_object,
)
from base_spec import changed_spec as grid

from sweep.spec import GridSpec, SceneSpec, SpecError, load


def mistakes_of(mapping, base="."):
    with pytest.raises(SpecError) as error_info:
        SceneSpec.from_mapping(mapping, base=base)
    return error_info.value.mistakes


MOVING = {"path": {"kind": "still", "position": ["0 m", "0 m", "9 m"]}}
SHORT = {"path": {"kind": "acceleration", "position": ["0 m", "0 m", "9 m"],
                  "velocity": ["0 m/s", "0 m/s", "0 m/s"], "duration": "9 s"}}  # fmt: skip
GROUND, PATH, THREE = "scene.objects.ground", "platform.path", "scanners.three"

FIELDS = [
    ("scene", ..., "is missing; write 'scene:' with origin, objects"),
    ("target", {}, "is no field; a study has a scene or a target, not both"),
    ("scene.objects", {}, "holds nothing; name at least one"),
    ("scene.objects", [], "must be a mapping"),
    ("scene.objcts", {}, "did you mean 'objects'?"),
    ("scene.origin", "grond", "is no object of the scene (you wrote 'grond'); did you mean"),
    ("scene.origin", "elsewhere", "the grounds are ground, or 'world'"),
    (f"{GROUND}.size", 3000, "needs a unit (you wrote 3000); write e.g. '3 km'"),
    (f"{GROUND}.size", ..., "is missing; write e.g. 'size: 3 km'"),
    (f"{GROUND}.spacing", "1 cm", "a side of 2000 m has 200000 steps of 0.01 m"),
    (f"{GROUND}.position", ["0 m", "1 m", "0 m"], "places the scene's origin"),
    (f"{GROUND}.position", ["0 m", "0 m"], "must be a list of 3 values; write e.g. [10 m, 10 m"),
    (f"{GROUND}.position", ["0 m", "0 m", 0], "holds 0 as value 2, which needs a unit"),
    ("platform", ..., "is missing; write 'platform:' with path, attitude"),
    (PATH, ..., "is missing; write 'path:' with kind: and one of straight, acceleration"),
    (f"{PATH}.kind", ..., "lacks its kind; write kind: and one of straight"),
    (f"{PATH}.begin", ["0 m"] * 3, "is no field; the fields here are kind, from, to"),
    ("platform.attitude", {"kind": "nadir", "heading": "track"}, "has no heading to follow"),
    ("platform.attitude", {"kind": "along_track"}, "has no heading to follow"),
    ("platform.attitude", {"kind": "track"}, "needs a table"),
    ("platform.attitude", {"kind": "fixed", "heading": "1 deg", "quaternion": [1, 0, 0, 0]},
     "has both angles and a quaternion"),
    ("platform.attitude", {"kind": "fixed", "quaternion": [0, 0, 0, 0]}, "other than zero"),
    ("platform.mounting", {"quaternion": [0, 0, 0, 0]}, "other than zero"),
    (f"{THREE}.half_angle", "95 deg", "must be at most 89 deg"),
    (f"{THREE}.rate", "0.2 Hz", None),
    (f"{THREE}.interval", "0.3 s", "do not fit in"),
    (f"{THREE}.elements", ["1 deg"], "is no field; the fields here are kind, beams, half_angle"),
    ("scanners.scene_map", {"kind": "corners", "angle": "1 deg", "rate": "1 Hz"},
     "store has taken"),
    ("scanners.Wide", {"kind": "corners", "angle": "1 deg", "rate": "1 Hz"}, "is no name"),
    ("scanners.s", {"kind": "squares", "elements": ["5 deg", "5 deg"], "rate": "1 Hz"},
     "as many different angles"),
    ("scanners.s", {"kind": "corners", "angle": "1 deg", "rate": "10 s"}, "unit like Hz"),
    ("footprint.pattern", "line", "is only for a plane"),
    ("draws.batch", 3, "is no field; the fields here are number, method, returns"),
    ("instrument.processing.peaks", "strongest", "set draws.method: spectra, or take all"),
    ("interface.rate", "none", "write e.g. '20 Hz'"),
    ("interface", {"min_range": "9 m", "max_range": "9 m"}, "write a lower min_range"),
    ("interface", {"valid_shots": 2}, "add e.g. 'rate: 20 Hz'"),
    ("storage.block_points", 3, "did you mean 'block_shots'?"),
]  # fmt: skip


@pytest.mark.parametrize(("path", "value", "words"), FIELDS)
def test_a_wrong_field_is_reported_once_with_path_rule_and_remedy(path, value, words):
    if words is None:
        SceneSpec.from_mapping(changed_scene({path: value}))
        return
    (mistake,) = mistakes_of(changed_scene({path: value}))
    assert words in str(mistake)
    # A part that is wrong as a whole is blamed at its own place or at the field that spoils it.
    assert mistake.path.startswith(path) or path.startswith(mistake.path)


OBJECTS = [
    (
        TREES_OBJECT,
        {"on": "grund"},
        "on",
        "is no object of the scene (you wrote 'grund'); did you mean",
    ),
    (
        TREES_OBJECT,
        {"on": "thing"},
        "on",
        "is no ground (you wrote 'thing'); the grounds are ground",
    ),
    (TREES_OBJECT, {"trunk": ...}, "trunk", "is missing; write 'trunk:' with reflectance"),
    (
        TREES_OBJECT,
        {"tree": {"crown_base": "12 m"}},
        "tree.crown_base",
        "must lie below the top, 12 m",
    ),
    (
        TREES_OBJECT,
        {"tree": {"height": "2 m"}},
        "tree.crown_base",
        "is 3 m by default, and must lie below the top, 2 m; lower it",
    ),
    (BOULDERS_OBJECT, {"largest": "0.5 m"}, "largest", "must exceed the smallest diameter, 0.5 m"),
    (SPHERE_OBJECT, {"motion": MOVING}, "position", "is given in addition to a motion"),
    (
        BOX_OBJECT,
        {"motion": SHORT},
        "motion.path",
        "lasts from 0 to 9 s, and the flight from 0 to 10 s",
    ),
    (
        BOX_OBJECT,
        {"motion": MOVING | {"attitude": {"kind": "along_track"}}},
        "motion.attitude",
        "has no heading",
    ),
    (
        BOX_OBJECT,
        {"position": ["0 m"] * 3, "rotation": {"heading": "1 deg", "quaternion": [1, 0, 0, 0]}},
        "rotation",
        "leave one of them out",
    ),
    (HILLS_OBJECT, {"correlation_length": "6 m"}, "spacing", "over three grid steps"),
    (RELIEF_OBJECT, {"spacing": "1 km"}, None, None),
    (
        RELIEF_OBJECT,
        {"craters": {"smallest": "5 m", "largest": "9 m"}},
        "craters.smallest",
        "must be three grid steps of 2 m or more",
    ),
    (RELIEF_OBJECT, {"factor": 2, "craters": {"smallest": "5 m", "largest": "9 m"}}, None, None),
    (
        RELIEF_OBJECT,
        {"craters": {"smallest": "9 m", "largest": "8 m"}},
        "craters.largest",
        "must exceed the smallest diameter, 9 m",
    ),
    (
        {"kind": "jacksboro", "reflectance": 1},
        {"size": "1 km", "middle": ["90 km", "0 km"]},
        "middle",
        "there is no ground within 500 m of (90000, 0) m",
    ),
    (
        {"kind": "jacksboro", "reflectance": 1},
        {"craters": {"smallest": "50 m", "largest": "1 km"}},
        "craters.smallest",
        "three grid steps of 92.5 m",
    ),
    (
        {"kind": "mesh", "reflectance": 1, "file": "no.stl"},
        {},
        "file",
        "names a file that does not exist (you wrote 'no.stl'); check the path",
    ),
    (
        {"kind": "raster", "reflectance": 1, "file": "."},
        {},
        "file",
        "names a file that is a folder",
    ),
    (
        {"kind": "array", "reflectance": 1, "file": 3},
        {"spacing": ["1 m", "1 m"]},
        "file",
        "must be the path of a file",
    ),
]


@pytest.mark.parametrize(("thing", "changes", "path", "words"), OBJECTS)
def test_a_wrong_object_is_reported_once_with_path_rule_and_remedy(thing, changes, path, words):
    mapping = scene_with_object({k: v for k, v in (thing | changes).items() if v is not ...})
    if path is None:
        SceneSpec.from_mapping(mapping)
        return
    (mistake,) = mistakes_of(mapping)
    assert mistake.path == f"scene.objects.thing.{path}"
    assert words in str(mistake)


def test_names_of_objects_are_words_and_not_the_world():
    for name in ("Rock", "a.b", "1st", "x" * 61, ""):
        mapping = changed_scene()
        mapping["scene"]["objects"][name] = SPHERE_OBJECT
        (mistake,) = mistakes_of(mapping)
        assert "is no name; take small letters" in str(mistake)
    (mistake,) = mistakes_of(scene_with_object(SPHERE_OBJECT, "world"))
    assert "is a name that the scene has taken" in str(mistake)


def test_a_unit_of_a_mesh_is_one_of_length(tmp_path):
    (tmp_path / "a.stl").write_text("")
    mesh = {"kind": "mesh", "file": "a.stl", "reflectance": 1, "unit": "mn"}
    (mistake,) = mistakes_of(scene_with_object(mesh), tmp_path)
    assert mistake.path == "scene.objects.thing.unit" and "unknown unit 'mn'" in str(mistake)


TABLES = [
    ("time [s], x [m], y [m], z [m]\n1, 0, 0, 0\n", "holds fewer than two lines"),
    (
        "time [s], x [m], y [m], z [m]\n1, 0, 0, 0\n0, 0, 0, 0\n",
        "names a file that has a time on line 3, 0 s, that is earlier than the 1 s on line 2",
    ),
    (
        "time [s], x, y [m], z [m]\n1, 0, 0, 0\n2, 0, 0, 0\n",
        "names a file that has no unit for column 'x'",
    ),
]


@pytest.mark.parametrize(("table", "words"), TABLES)
def test_a_table_that_is_no_path_is_blamed_at_the_field_that_names_it(tmp_path, table, words):
    (tmp_path / "path.csv").write_text(table)
    path = {"kind": "waypoints", "file": "path.csv"}
    (mistake,) = mistakes_of(changed_scene({"platform.path": path}), tmp_path)
    assert mistake.path == "platform.path.file" and words in str(mistake)
    (mistake,) = mistakes_of(changed_scene({"platform.path": path | {"file": "pth.csv"}}), tmp_path)
    assert mistake.path == "platform.path.file" and "there is: path.csv" in str(mistake)


def test_a_table_without_attitude_can_not_be_tracked(tmp_path):
    (tmp_path / "path.csv").write_text("time [s], x [m], y [m], z [m]\n0, 0, 0, 9\n9, 0, 0, 5\n")
    changes = {"platform.path": {"kind": "waypoints", "file": "path.csv"},
               "platform.attitude": {"kind": "track"}}  # fmt: skip
    (mistake,) = mistakes_of(changed_scene(changes), tmp_path)
    assert mistake.path == "platform.attitude.file"
    assert "has no attitude to follow; add heading" in str(mistake)


def test_a_flight_too_short_for_a_cycle_is_reported():
    (mistake,) = mistakes_of(
        changed_scene(scanners={"one": {"kind": "corners", "angle": "1 deg", "rate": "0.05 Hz"}})
    )
    assert mistake.path == "scanners.one.rate"
    assert "makes no whole cycle of 4 shots in a flight of 10 s" in str(mistake)


AXES = [
    ({"instrument.laser.beam_divergence": ["50 urad"]}, "instrument.laser.beam_divergence",
     "moves the beamlets, and a study casts its rays once; make another study of it"),
    ({"instrument.laser.focus": ["30 m"]}, "instrument.laser.focus", "moves the beamlets"),
    ({"accuracy.leakage_floor": [0.1]}, "accuracy.leakage_floor", "make another study"),
    ({"target.range": ["1 m"]}, "target.range", "is given by the scene, shot by shot"),
    ({"instrument.receiver.architecture": ["homodyne", "direct"]},
     "instrument.receiver.architecture", "between direct detection and the others"),
    ({"cut": {"zip": {"instrument.laser.power": ["1 W"], "target.reflectance": 1}}}, "cut",
     "is given by the scene"),
    ({"snr": {"zip": {"instrument.laser.power": ["1 W", "2 W"]}}}, "snr",
     "has the name of an array or dimension"),
    ({"draw": {"zip": {"instrument.laser.power": ["1 W", "2 W"]}}}, "draw", "is no name for an"),
]  # fmt: skip


@pytest.mark.parametrize(("axes", "path", "words"), AXES)
def test_an_axis_that_would_move_rays_is_refused(axes, path, words):
    (mistake,) = mistakes_of(changed_scene(axes=axes))
    assert mistake.path == f"axes.{path}" and words in str(mistake)


def test_an_axis_of_radiometry_is_read_and_stands_in_for_its_field():
    architectures = {"instrument.receiver.architecture": ["homodyne", "heterodyne"]}
    spec = SceneSpec.from_mapping(
        changed_scene({"instrument.laser.power": ...}, axes=architectures
                | {"instrument.laser.power": ["1 W", "2 W"]})
    )  # fmt: skip
    assert [axis.size for axis in spec.axes] == [2, 2]
    coherent = changed_scene({"footprint.phases": "coherent"}, axes={
        "instrument.receiver.architecture": ["homodyne", "direct"]})  # fmt: skip
    assert SceneSpec.from_mapping(coherent).beamlet_pattern == "sunflower"


def test_no_parameter_that_may_vary_bears_the_name_of_an_array():
    from sweep.spec.scene_checks import store_array_and_dimension_names
    from sweep.spec.sections import parameter_rules

    free = {p.rsplit(".", 1)[-1] for p in parameter_rules() if SceneSpec.may_be_on_axis(p)}
    assert len(free) > 20 and not free & store_array_and_dimension_names()


PAIR = {"kind": "fixed", "beams": [["0 deg", "0 deg"], ["1 deg", "0 deg"]], "rate": "1 Hz"}
CLOUD, NAVIGATION = {"kind": "cloud"}, {"kind": "navigation"}
FIGURES = [
    ({}, "figures[0]", "lacks its kind; write kind: and one of cloud, scatter"),
    ({"kind": "surface"}, "figures[0].kind", "surface is for studies of a target"),
    (CLOUD | {"scanner": "thre"}, "figures[0].scanner", "did you mean 'three'?"),
    (CLOUD | {"colour": "platform_position"}, "figures[0].colour", "is no quantity of shots"),
    (CLOUD | {"view": {"azimuth": "3 deg"}}, "figures[0].view", "an azimuth and an elevation"),
    (CLOUD | {"view": {"azimuth": 3, "elevation": "3 deg"}}, "figures[0].view", "needs a unit"),
    (CLOUD | {"x": ["5 m", "5 m"]}, "figures[0].x", "must begin below its end"),
    (CLOUD | {"draw": 1}, "figures[0].draw", "is beyond the study's draws, 0 to 0"),
    (CLOUD | {"where": {"power": "1 m"}}, "figures[0].where.power", "unit like W"),
    (CLOUD | {"where": {"power": ["1 W", "2 W"]}}, "figures[0].where.power", "must be one value"),
    ({"kind": "scatter"}, "figures[0].y", "is missing"),
    ({"kind": "shot_spectra", "shot": "several"}, "figures[0].shot", "several_surfaces"),
    (NAVIGATION | {"scanners": "three"}, "figures[0].scanners", "must be a list of names"),
    (NAVIGATION | {"scanners": ["four"]}, "figures[0].scanners[0]", "is no scanner"),
    (NAVIGATION | {"scanners": ["three", "pair"]}, "figures[0].scanners[1]",
     "has fewer than 3 shots a cycle"),
]  # fmt: skip


@pytest.mark.parametrize(("figure", "path", "words"), FIGURES)
def test_a_wrong_figure_is_reported_with_path_rule_and_remedy(figure, path, words):
    mapping = changed_scene(
        {"scanners.pair": PAIR}, axes={"instrument.laser.power": ["1 W", "2 W"]}, figures=[figure]
    )
    (mistake,) = mistakes_of(mapping)
    assert mistake.path == path and words in str(mistake)


def test_navigation_needs_a_scanner_that_has_it():
    mapping = changed_scene(scanners={"pair": PAIR}, figures=[{"kind": "navigation_table"}])
    (mistake,) = mistakes_of(mapping)
    assert mistake.path == "figures[0]" and "needs a scanner of 3 shots a cycle" in str(mistake)


def test_figures_that_share_a_file_are_reported_and_others_have_names_of_their_own():
    several = [
        CLOUD, CLOUD | {"colour": "snr"}, CLOUD | {"scanner": "three"}, NAVIGATION,
        NAVIGATION | {"quantity": "altitude"}, {"kind": "navigation_table"},
        {"kind": "scatter", "y": "snr"}, {"kind": "scatter", "y": "snr", "x": "altitude"},
        {"kind": "shot_spectra"}, {"kind": "shot_spectra", "shot": 3},
    ]  # fmt: skip
    spec = SceneSpec.from_mapping(changed_scene(figures=several))
    assert len({figure.file_stem for figure in spec.figures}) == len(several)
    (mistake,) = mistakes_of(changed_scene(figures=[CLOUD, CLOUD]))
    assert mistake.path == "figures[1]" and "give it a name" in str(mistake)


def test_figures_hold_what_was_written_in_si():
    view = {"azimuth": "-90 deg", "elevation": "30 deg"}
    figure = CLOUD | {"view": view, "x": ["1 km", "2 km"], "time": ["0 s", "90 ms"]}
    shot = {"kind": "shot_spectra", "shot": 12}
    cloud, spectra = SceneSpec.from_mapping(changed_scene(figures=[figure, shot])).figures
    assert (cloud.x, cloud.time, cloud.y) == ((1000.0, 2000.0), (0.0, 0.09), None)
    assert cloud.view == pytest.approx({"azimuth": -math.pi / 2, "elevation": math.pi / 6})
    assert spectra.shot == 12


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("gone.bin", "names a file that needs {folder}/gone.bin, which does not exist"),
        ("folder", "names a file that needs {folder}/folder, which is a folder"),
        ("loop", "needs {folder}/loop, which is reached by a link that leads back to itself"),
        ("/dev/zero", "names a file that needs /dev/zero, which is a pipe or a device"),
        ("http://a.org/x.bin", "needs http://a.org/x.bin, and nothing is fetched over the network"),
    ],
)
def test_what_is_wrong_with_a_companion_of_a_mesh_is_reported_of_it(uri, message, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    buffers = [{"byteLength": 36, "uri": uri}]
    (tmp_path / "a.gltf").write_text(json.dumps({"asset": {"version": "2.0"}, "buffers": buffers}))
    thing = {"kind": "mesh", "file": "a.gltf", "reflectance": 0.1}
    with pytest.raises(SpecError) as refused:
        SceneSpec.from_mapping(changed_scene({"scene.objects.thing": thing}), base=tmp_path)
    assert message.format(folder=tmp_path) in str(refused.value)
    assert "scene.objects.thing.file" in str(refused.value)


MANY = """\
title: Many mistakes
instrument: nowhere.yaml
scene:
  origin: grond
  objects:
    ground: {kind: plane, size: 2, reflectanc: 0.1}
    forest: {kind: trees, on: groud, radius: 5 m, number: 2, leaf: {reflectance: 2}}
    thing: {kind: mesh, file: no.stl, reflectance: 1}
platform:
  path: {kind: straight, from: [0 m, 0 m, 5 m], to: [0 m, 0 m, 5 m], initial_speed: 1 m/s}
scanners:
  one: {kind: cone, beams: 3, half_angle: 2, rate: 1 Hz}
axes:
  footprint.beamlets: [1, 2]
figures:
  - {kind: cloud, scanner: on}
"""


def test_all_mistakes_of_a_file_are_reported_at_once_with_their_lines(tmp_path):
    path = tmp_path / "many.yaml"
    path.write_text(MANY)
    with pytest.raises(SpecError) as error_info:
        load(path)
    locations = {(mistake.line, mistake.path) for mistake in error_info.value.mistakes}
    assert locations == {
        (2, "instrument"),
        (4, "scene.origin"),
        (6, "scene.objects.ground.size"),
        (6, "scene.objects.ground.reflectance"),
        (6, "scene.objects.ground.reflectanc"),
        (7, "scene.objects.forest.on"),
        (7, "scene.objects.forest.leaf.reflectance"),
        (7, "scene.objects.forest.trunk"),
        (8, "scene.objects.thing.file"),
        (10, "platform.path"),
        (12, "scanners.one.half_angle"),
        (14, "axes.footprint.beamlets"),
        (16, "figures[0].scanner"),
    }
    assert str(pickle.loads(pickle.dumps(error_info.value))) == str(error_info.value)


def places(value, path=()):
    """Every place in a nested mapping."""
    yield path
    keys = range(len(value)) if isinstance(value, list) else value
    for key in keys if isinstance(value, dict | list) else ():
        yield from places(value[key], (*path, key))


EVERYTHING = changed_scene(
    {
        "scene.objects.forest": TREES_OBJECT,
        "scene.objects.rocks": BOULDERS_OBJECT,
        "scene.objects.hills": HILLS_OBJECT | {"craters": {"smallest": "9 m", "largest": "20 m"}},
        "scene.objects.crate": BOX_OBJECT | {"motion": MOVING},
        "scanners.pair": PAIR,
    },
    axes={"instrument.laser.power": ["1 W", "2 W"]},
    figures=[CLOUD | {"x": ["0 m", "1 m"], "where": {"power": "1 W"}}, NAVIGATION],
)


@pytest.mark.parametrize("junk", [None, "x", {}, [[]], 1e300])
def test_no_junk_anywhere_gets_past_as_a_traceback(junk):
    for path in places(EVERYTHING):
        if not path or path[0] == "instrument":
            continue
        mapping = copy.deepcopy(EVERYTHING)
        part = mapping
        for name in path[:-1]:
            part = part[name]
        part[path[-1]] = junk
        try:
            SceneSpec.from_mapping(mapping)
        except SpecError as error:
            for mistake in error.mistakes:
                for words in ("Input should", "pydantic", "type=", "Extra inputs", "cannot stand"):
                    assert words not in str(mistake), (path, str(mistake))


@pytest.mark.parametrize(
    ("kind", "mapping"),
    [
        (GridSpec, grid({"target.range": ...}, axes={"target.range": ["5 m", "6 m"]})),
        (SceneSpec, EVERYTHING),
    ],
)
def test_the_mapping_given_is_left_as_it_was(kind, mapping):
    before = yaml.safe_dump(mapping)
    kind.from_mapping(mapping)
    assert yaml.safe_dump(mapping) == before


def test_no_axis_over_wavelength_moves_the_rays_of_a_single_mode():
    mode = {"instrument.telescope.coupling": "single_mode"}
    mode |= {"instrument.laser.beam_divergence": "100 urad"}
    axes = {"instrument.laser.wavelength": ["1550 nm", "1551 nm"]}
    (mistake,) = mistakes_of(changed_scene(mode, axes=axes))
    assert "the beam's radius follows from it" in str(mistake)
