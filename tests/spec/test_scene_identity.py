"""What makes a scene study that one, and its geometry: content, never names or places."""

import copy
import json
import math
import pickle
import shutil
from fractions import Fraction

import numpy as np
import pytest
import trimesh
from base_scene_spec import (
    BOULDERS_OBJECT,
    RELIEF_OBJECT,
    SCENE_WITH_EVERYTHING,
    changed_scene,
    scene_with_object,
)
from hypothesis import given
from hypothesis import strategies as st

from sweep.scenes.scene_files import SceneError
from sweep.spec import SceneSpec, describe_differences, differences, from_stored
from sweep.spec.axes import remove_fields_on_axes
from sweep.spec.differences import SCENE_SECTION_MODELS, rules_by_field_name
from sweep.spec.fields import fields_by_name, iter_section_values, reachable_models, rule_of_field
from sweep.spec.ground_sections import OPTICAL_FIELDS
from sweep.spec.rules import NumericRule
from sweep.spec.sections import MODEL_BY_SECTION
from sweep.units import read_unit


def spec_of(mapping, base="."):
    return SceneSpec.from_mapping(mapping, base=base)


def changed_spec(path, value):
    mapping = json.loads(json.dumps(SCENE_WITH_EVERYTHING))
    *parents, name = path.split(".")
    part = mapping
    for parent in parents:
        part = part.setdefault(parent, {})
    part[name] = value
    mapping["instrument"]["laser"].setdefault("power", "0.1 W")  # where it is on no axis any more
    return spec_of(remove_fields_on_axes(mapping))


OTHER_GEOMETRY = {
    "scene.origin": "world",
    "scene.objects.ground.size": "120 m",
    "scene.objects.ground.spacing": "1 m",
    "scene.objects.ground.hurst": 0.7,
    "scene.objects.ground.seed": 9,
    "scene.objects.ground.smoothing": "4 m",
    "scene.objects.ground.factor": 1,
    "scene.objects.ground.relief.rms_slope": 0.2,
    "scene.objects.ground.craters.seed": 1,
    "scene.objects.ground.craters.equilibrium_diameter": "15 m",
    "scene.objects.forest.radius": "11 m",
    "scene.objects.forest.tree": {"leaf_area_index": 3},
    "scene.objects.forest.on": "other",
    "scene.objects.rocks.law": {"kind": "power", "density": "0.1 m^-2", "exponent": 2},
    "scene.objects.rocks.law.abundance": "6 %",
    "scene.objects.rocks.elongation": 2,
    "scene.objects.ball.radius": "2 m",
    "scene.objects.ball.rotation": {"heading": "5 deg"},
    "scene.objects.crate.motion.attitude.angular_velocity": ["1 deg/s", "0 deg/s", "1 deg/s"],
    "scene.objects.crate.motion.path.position": ["0 m", "1 m", "9 m"],
    "platform.path.final_speed": "21 m/s",
    "platform.attitude": {"kind": "nadir", "heading": "1 deg"},
    "platform.lever_arm": ["1 m", "1 m", "0 m"],
    "platform.mounting.pitch": "2 deg",
    "platform.jitter": "11 urad",
    "scanners.three.rate": "3 Hz",
    "scanners.three.interval": "1 ms",
    "footprint.beamlets": 19,
    "footprint.phases": "coherent",
    "instrument.laser.beam_divergence": "60 urad",
    "instrument.laser.focus": "30 m",
    "seed": 2,
}
SAME_GEOMETRY = {
    "title": "Another",
    "question": "Why?",
    "scene.objects.ground.reflectance": 0.2,
    "scene.objects.forest.leaf.reflectance": 0.1,
    "scene.objects.rocks.reflectance_law": "thesis",
    "scene.solar_irradiance": "0.1 W/m^2/nm",
    "instrument.telescope.aperture": "50 mm",
    "instrument.chirp.duration": "400 us",
    "accuracy.leakage_floor": 0.2,
    "accuracy.line_error": 0.2,
    "accuracy.leakage_error": 0.2,
    "draws": {"number": 5},
    "error_floor": {"clock_error": 1e-6},
    "navigation": {"test_level": 0.01},
    "storage": {"block_shots": 64},
    "axes": {},
    "execution": {"workers": 3},
    "figures": [{"kind": "cloud"}],
    "interface": {"range_quantum": "2 mm", "rate": "20 Hz"},
}
SAME_STUDY = ("title", "question", "execution", "figures", "interface")


def objects_with_another_ground():
    mapping = json.loads(json.dumps(SCENE_WITH_EVERYTHING))
    mapping["scene"]["objects"]["other"] = RELIEF_OBJECT
    return mapping


@pytest.mark.parametrize("path", OTHER_GEOMETRY)
def test_whatever_moves_a_ray_makes_another_geometry_and_another_study(path):
    if path.endswith(".on"):
        expected_spec = spec_of(objects_with_another_ground())
        mapping = objects_with_another_ground()
        mapping["scene"]["objects"]["forest"]["on"] = "other"
        other_spec = spec_of(mapping)
    else:
        expected_spec, other_spec = (
            spec_of(SCENE_WITH_EVERYTHING),
            changed_spec(path, OTHER_GEOMETRY[path]),
        )
    assert expected_spec.geometry_id("three") != other_spec.geometry_id("three")
    assert expected_spec.id != other_spec.id


@pytest.mark.parametrize("path", SAME_GEOMETRY)
def test_radiometry_leaves_the_geometry_alone(path):
    expected_spec, other_spec = (
        spec_of(SCENE_WITH_EVERYTHING),
        changed_spec(path, SAME_GEOMETRY[path]),
    )
    assert expected_spec.geometry_id("three") == other_spec.geometry_id("three")
    assert (expected_spec.id == other_spec.id) is (path in SAME_STUDY)


def test_every_field_of_a_scene_is_in_its_geometry_unless_it_is_optical():
    spec = spec_of(SCENE_WITH_EVERYTHING)
    text = json.dumps(spec.geometry_identity("three"))
    for part in (*spec.scene.objects.values(), spec.platform, spec.scanners["three"]):
        for path, _, _ in iter_section_values(part):
            is_listed = f'"{".".join(path)}"' in text
            assert is_listed is (path[-1] not in OPTICAL_FIELDS), path


def test_a_geometry_knows_no_names():
    text = json.dumps(SCENE_WITH_EVERYTHING)
    for old, new in (("ground", "soil"), ("forest", "wood"), ("three", "trio")):
        text = text.replace(f'"{old}"', f'"{new}"')
    expected_spec, other_spec = spec_of(SCENE_WITH_EVERYTHING), spec_of(json.loads(text))
    assert expected_spec.geometry_id("three") == other_spec.geometry_id("trio")
    assert expected_spec.id != other_spec.id


def test_the_order_of_objects_numbers_their_surfaces():
    mapping = json.loads(json.dumps(SCENE_WITH_EVERYTHING))
    objects = mapping["scene"]["objects"]
    mapping["scene"]["objects"] = {"ball": objects.pop("ball")} | objects
    expected_spec, other_spec = spec_of(SCENE_WITH_EVERYTHING), spec_of(mapping)
    assert (
        expected_spec.geometry_id("three") != other_spec.geometry_id("three")
        and expected_spec.id != other_spec.id
    )
    assert (
        other_spec.surface_materials()[0].name == "ball"
        and expected_spec.surface_materials()[0].name == "ground"
    )


def test_a_geometry_is_seen_through_one_scanner():
    mapping = json.loads(json.dumps(SCENE_WITH_EVERYTHING))
    mapping["scanners"]["again"] = mapping["scanners"]["three"]
    mapping["scanners"]["wide"] = mapping["scanners"]["three"] | {"half_angle": "30 deg"}
    spec = spec_of(mapping)
    assert spec.geometry_id("again") == spec.geometry_id("three") != spec.geometry_id("wide")
    assert spec_of(SCENE_WITH_EVERYTHING).geometry_id("three") == spec.geometry_id("three")


def test_a_seed_is_part_of_a_geometry_only_where_it_moves_the_beams():
    steady = [changed_spec("platform.jitter", "0 rad")]
    mapping = json.loads(json.dumps(SCENE_WITH_EVERYTHING)) | {"seed": 2}
    mapping["platform"]["jitter"] = "0 urad"
    steady.append(spec_of(mapping))
    assert steady[0].geometry_id("three") == steady[1].geometry_id("three")
    assert steady[0].id != steady[1].id


def test_equal_quantities_make_equal_studies_however_they_are_spelt():
    spelt = changed_spec("scene.objects.ball.radius", "100 cm")
    assert spelt.id == spec_of(SCENE_WITH_EVERYTHING).id
    turned = changed_spec("platform.mounting", {"pitch": "0.017453292519943295 rad"})
    assert turned.id == spec_of(SCENE_WITH_EVERYTHING).id


@pytest.mark.parametrize(
    "mapping", [changed_scene(), SCENE_WITH_EVERYTHING, scene_with_object(BOULDERS_OBJECT)]
)
def test_a_stored_study_is_the_same_again(mapping):
    spec = spec_of(mapping)
    restored = from_stored(spec.to_json())
    assert restored == spec and restored.id == spec.id
    assert restored.geometry_identity("three") == spec.geometry_identity("three")
    assert restored.to_json() == spec.to_json() and hash(restored) == hash(spec)
    assert pickle.loads(pickle.dumps(spec)) == spec


def test_every_default_is_written_out_so_that_a_store_keeps_it():
    spec = spec_of(SCENE_WITH_EVERYTHING)
    mapping = spec.to_yaml_mapping()
    for path, rule, value in iter_section_values(spec):
        if path[0] in ("title", "question", "execution", "axes", "figures"):
            continue
        if ".".join(path) in spec.to_yaml_mapping()["axes"]:
            continue
        at = mapping
        for name in path:
            at = at[name]
        assert rule.read(at) == value, path
    assert "execution" not in mapping


@pytest.fixture
def study_with_files(tmp_path):
    """A folder with a study of a mesh and a path of files."""
    folder = tmp_path / "here"
    folder.mkdir()
    trimesh.creation.box(extents=[2.0, 2, 2]).export(folder / "box.stl")
    (folder / "path.csv").write_text("time [s], x [m], y [m], z [m]\n0, 0, 0, 500\n10, 0, 0, 100\n")
    mesh = {"kind": "mesh", "file": "box.stl", "reflectance": 1, "position": ["0 m", "0 m", "1 m"]}
    mapping = scene_with_object(mesh)
    mapping["platform"]["path"] = {"kind": "waypoints", "file": "path.csv"}
    return folder, mapping


def test_files_count_by_content_and_not_by_place(study_with_files):
    folder, mapping = study_with_files
    first_spec = spec_of(mapping, folder)
    shutil.copytree(folder, folder / "deep")
    (folder / "deep/box.stl").rename(folder / "deep/crate.stl")
    mapping["scene"]["objects"]["thing"]["file"] = "deep/crate.stl"
    mapping["platform"]["path"]["file"] = str(folder / "deep/path.csv")
    second_spec = spec_of(mapping, folder)
    assert (second_spec.id, second_spec.geometry_id("three")) == (
        first_spec.id,
        first_spec.geometry_id("three"),
    )
    (folder / "deep/path.csv").write_text("time [s], x [m], y [m], z [m]\n0,0,0,500\n10,0,0,99\n")
    other = spec_of(mapping, folder)
    assert other.id != first_spec.id and other.geometry_id("three") != first_spec.geometry_id(
        "three"
    )


def test_a_stored_study_needs_its_files_only_where_rays_do(study_with_files):
    folder, mapping = study_with_files
    spec = spec_of(mapping, folder)
    text = spec.to_json()
    assert str(folder) not in text
    moved = folder.rename(folder.parent / "there")
    lost = from_stored(text)
    assert lost.id == spec.id and lost.geometry_id("three") == spec.geometry_id("three")
    assert [surface.name for surface in lost.surface_materials()] == ["ground", "thing"]
    for look in (lost.build_flight, lost.build_scene):
        with pytest.raises(SceneError, match="does not exist"):
            look()
    stored_spec = from_stored(text, base=moved)
    assert stored_spec.number_of_cycles("three") == 21 and stored_spec.build_scene().mesh_reports
    assert stored_spec.files.base_folder == moved and stored_spec == lost


def test_a_file_that_has_changed_since_is_refused(study_with_files):
    folder, mapping = study_with_files
    spec = spec_of(mapping, folder)
    stored = from_stored(spec.to_json(), base=folder)
    trimesh.creation.box(extents=[2.0, 2, 3]).export(folder / "box.stl")
    assert spec.build_flight().stop_time == 10
    for one in (spec, stored):
        with pytest.raises(SceneError, match=r"box\.stl: has changed since .* bring the old"):
            one.build_scene()


def test_a_raster_counts_by_what_is_read_of_it(tmp_path):
    """Old eyepoints would be used without a word where it counted by its own bytes."""
    import rasterio

    def fill(height):
        with rasterio.open(
            tmp_path / "dem.tif", "w", driver="GTiff", width=50, height=50, count=1,
            dtype="float32", crs="EPSG:32617", transform=rasterio.Affine(4, 0, 5e5, 0, -4, 200),
        ) as data:  # fmt: skip
            data.write(np.full((1, 50, 50), height, np.float32))

    fill(0)
    (tmp_path / "dem.vrt").write_text(
        '<VRTDataset rasterXSize="50" rasterYSize="50"><SRS>EPSG:32617</SRS>'
        "<GeoTransform>500000, 4, 0, 200, 0, -4</GeoTransform>"
        '<VRTRasterBand dataType="Float32" band="1"><SimpleSource>'
        '<SourceFilename relativeToVRT="1">dem.tif</SourceFilename><SourceBand>1</SourceBand>'
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    mapping = copy.deepcopy(SCENE_WITH_EVERYTHING)
    mapping["scene"]["objects"]["ground"] = {
        "kind": "raster", "file": "dem.vrt", "reflectance": 0.1
    }  # fmt: skip
    flat = spec_of(mapping, tmp_path)
    fill(500)
    raised = spec_of(mapping, tmp_path)
    name = next(iter(flat.scanners))
    assert flat.id != raised.id and flat.geometry_id(name) != raised.geometry_id(name)
    with pytest.raises(SceneError, match=r"dem\.vrt: has changed since"):
        from_stored(flat.to_json(), base=tmp_path).build_scene()
    assert from_stored(raised.to_json(), base=tmp_path).build_scene().mesh_reports


def test_a_gltf_counts_with_the_buffers_that_it_names(tmp_path):
    from sweep.scenes.scene_files import file_digest

    for name, side in (("a", 1.0), ("b", 2.0)):
        (tmp_path / name).mkdir()
        box = trimesh.creation.box(extents=[side, 1, 1])
        for file, content in trimesh.Scene(box).export(file_type="gltf").items():
            (tmp_path / name / file).write_bytes(content)
    shutil.copy(tmp_path / "a/model.gltf", tmp_path / "b/model.gltf")
    assert file_digest(tmp_path / "a/model.gltf") != file_digest(tmp_path / "b/model.gltf")
    for buffer in (tmp_path / "b").glob("*.bin"):
        buffer.unlink()
    with pytest.raises(SceneError, match="does not exist"):
        file_digest(tmp_path / "b/model.gltf")


@given(st.sampled_from(["deg", "mrad", "urad"]), st.floats(1e-7, 6.0))
def test_an_angle_in_a_difference_reads_back_as_the_same_value(unit_name, value):
    example = f"1 {unit_name}"
    unit = read_unit(unit_name, si_unit="rad", example=example)
    rule = NumericRule(description="Angle", si_unit="rad", example=example)
    text = differences._format_number(rule, value)
    assert unit.to_si(Fraction(text)) == value


def test_differences_show_units():
    other_spec = changed_spec("scene.objects.ground.size", "120 m")
    assert describe_differences(spec_of(SCENE_WITH_EVERYTHING), other_spec) == [
        "scene.objects.ground.size: 100 m -> 120 m"
    ]
    other_spec = changed_spec("platform.lever_arm", ["1 m", "0 m", "2 m"])
    assert describe_differences(spec_of(SCENE_WITH_EVERYTHING), other_spec) == [
        "platform.lever_arm: [1, 0, 0] m -> [1, 0, 2] m"
    ]
    other_spec = changed_spec("scanners.three.half_angle", "7.3 deg")
    assert describe_differences(spec_of(SCENE_WITH_EVERYTHING), other_spec) == [
        "scanners.three.half_angle: 20 deg -> 7.3 deg"
    ]
    pointed = {"scanners": {"two.beams": [[math.radians(22.5), 0.0], [0.0, 0.6, -0.8]]}}
    assert describe_differences({}, pointed) == [
        "scanners.two.beams: (none) -> [[22.5, 0] deg, [0, 0.6, -0.8]]"
    ]
    lines = describe_differences(spec_of(SCENE_WITH_EVERYTHING), spec_of(changed_scene()))
    assert "objects: ground, forest, rocks, ball, crate -> ground" in lines
    assert "scene.objects.ball.radius: 1 m -> (none)" in lines
    assert "axes: power -> (none)" in lines


def test_a_name_has_one_unit_wherever_it_stands():
    for model in reachable_models(*MODEL_BY_SECTION.values(), *SCENE_SECTION_MODELS):
        for name, field in fields_by_name(model).items():
            rule = rule_of_field(field)
            assert rule is None or rules_by_field_name()[name].value_unit == rule.value_unit, name
    assert (
        rules_by_field_name()["half_angle"].value_unit == "rad"
        and len(reachable_models(*SCENE_SECTION_MODELS)) > 30
    )


def test_random_things_of_one_seed_share_no_numbers():
    from sweep.spec.ground_sections import random_generator

    first = {
        use: random_generator(use, 7).random(4) for use in ("relief", "hills", "craters", "trees")
    }
    values = np.array(list(first.values()))
    assert len(np.unique(values)) == values.size
    assert (random_generator("hills", 7).random(4) == first["hills"]).all()
