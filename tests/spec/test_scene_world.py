"""Scenes built: what rays hit, and where, against closed forms."""

import math

import numpy as np
import pytest
import rasterio
import trimesh
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

from sweep.model.geometry.ray_casting import Pose
from sweep.model.pointcloud.eyepoints import compute_eyepoints
from sweep.scenes.scene_files import SceneError
from sweep.spec import SceneSpec

FAR = np.array([500_123.375, 4_777_000.25])
"""Map coordinates of a raster's middle [m]."""


def built(mapping, base="."):
    spec = SceneSpec.from_mapping(mapping, base=base)
    return spec, spec.build_scene()


def flight_eyepoints(spec, world, name="three"):
    """Eyepoints of a whole flight."""
    return compute_eyepoints(
        np.arange(spec.number_of_cycles(name) * spec.shots_per_cycle(name)),
        flight=spec.build_flight(),
        scanner=spec.scan_pattern(name),
        caster=world.caster,
        body_motions=world.body_motions,
        beam_divergence=spec.instrument.laser.beam_divergence,
        n_beamlets=spec.footprint.beamlets,
        pattern=spec.beamlet_pattern,
    )


def straight_down(world, x, y, height=1000.0, time=0.0):
    """Heights [m] and surfaces straight below places (n,)."""
    places = np.column_stack(np.broadcast_arrays(np.asarray(x, float), y, height))
    down = np.broadcast_to([0.0, 0.0, -1.0], places.shape)
    poses = [None if b is None else b.state(np.array([time])) for b in world.body_motions]
    poses = [None if p is None else Pose(p.position[0], p.attitude[0]) for p in poses]
    hits = world.caster.cast_bundles(places, down[:, None], poses=poses)
    return height - hits.range, hits.surface_index[:, 0]


def test_a_plane_is_seen_at_its_distance_and_closing_speed():
    spec, world = built(changed_scene())
    eyes = flight_eyepoints(spec, world)
    slant = math.cos(math.radians(20))
    np.testing.assert_allclose(eyes.range, eyes.position[:, 2] / slant, rtol=1e-9)
    np.testing.assert_allclose(eyes.radial_velocity, -eyes.velocity[:, 2] * slant, rtol=1e-9)
    np.testing.assert_allclose(np.arccos(eyes.cos_incidence[:, 0]), math.radians(20), rtol=1e-9)
    assert (eyes.surface == 0).all() and world.body_motions == (None,)
    assert (
        world.surface_materials == spec.surface_materials()
        and world.surface_materials[0].reflectance == 0.1
    )


def test_a_plane_slopes_and_rises_where_it_says():
    plane = {"slope": "10 deg", "uphill": "90 deg", "height": "7 m", "spacing": "500 m"}
    changes = {f"scene.objects.ground.{name}": value for name, value in plane.items()}
    _, world = built(changed_scene(changes | {"scene.origin": "world"}))
    height, _ = straight_down(world, [0, 300, 0], [0, 0, 300])
    np.testing.assert_allclose(height, [7, 7, 7 + 300 * math.tan(math.radians(10))], atol=1e-9)


def write_raster(path, heights, middle=FAR, pixel=2.0, crs="EPSG:32633"):
    rows, columns = heights.shape
    west, north = middle[0] - columns * pixel / 2, middle[1] + rows * pixel / 2
    transform = rasterio.Affine(pixel, 0, west, 0, -pixel, north)
    with rasterio.open(
        path, "w", driver="GTiff", width=columns, height=rows, count=1, dtype="float32",
        transform=transform, crs=crs,
    ) as data:  # fmt: skip
        data.write(heights.astype("float32"), 1)


def ramp(rows=41, columns=61, pixel=2.0, base=-4400.0):
    """Heights that rise by 1 in 8 eastwards and 1 in 16 southwards."""
    return base + np.arange(columns) * pixel / 8 + np.arange(rows)[:, None] * pixel / 16


def raster_study(tmp_path, **changes):
    write_raster(tmp_path / "ground.tif", 2 * ramp())  # in half metres
    ground = {"kind": "raster", "file": "ground.tif", "reflectance": 0.1, "scale": 0.5}
    return changed_scene({"scene.objects.ground": ground} | changes)


def test_a_far_raster_is_brought_to_its_middle_exactly(tmp_path):
    _, world = built(raster_study(tmp_path), tmp_path)
    middle = -4400 + 30 * 2 / 8 + 20 * 2 / 16
    np.testing.assert_array_equal(world.origin, [*FAR, middle])
    height, _ = straight_down(world, [0, 0.5, -3.25], [0, -0.25, 11.125])
    # Slopes and places are sums of powers of two: not a digit may be lost to 4e6 m.
    np.testing.assert_array_equal(height, [0, 0.5 / 8 + 0.25 / 16, -3.25 / 8 - 11.125 / 16])


def test_coordinates_stay_as_they_are_about_the_world(tmp_path):
    mapping = raster_study(tmp_path, **{"scene.origin": "world"})
    place = [f"{c!r} m" for c in (*FAR.tolist(), -4000.0)]
    path = {"kind": "still", "position": place, "duration": "3 s"}
    _, world = built(mapping | {"platform": {"path": path}}, tmp_path)
    np.testing.assert_array_equal(world.origin, 0)
    height, _ = straight_down(world, FAR[0], FAR[1], height=-4000.0)
    np.testing.assert_allclose(height, -4400 + 7.5 + 2.5, atol=1e-8)


def test_a_hole_in_the_middle_is_no_origin(tmp_path):
    heights = ramp()
    heights[18:23, 28:33] = np.nan
    mapping = raster_study(tmp_path)
    write_raster(tmp_path / "ground.tif", heights)
    with pytest.raises(SceneError, match="has a hole in its middle"):
        built(mapping, tmp_path)


def test_arrays_and_images_lie_about_their_position(tmp_path, monkeypatch):
    from PIL import Image

    monkeypatch.setenv("HOME", str(tmp_path))

    np.save(tmp_path / "grid.npy", 2 * ramp(base=0.0))  # in half metres
    levels = np.zeros((5, 5), np.uint8)
    levels[0] = 255  # the northern row
    Image.fromarray(levels).save(tmp_path / "grid.png")
    array = {"kind": "array", "file": "grid.npy", "spacing": ["2 m", "-2 m"], "reflectance": 1}
    array["scale"] = 0.5
    image = {
        "kind": "image",
        "file": "~/grid.png",
        "pixel": "1 m",
        "white": "8 m",
        "reflectance": 1,
    }
    _, world = built(
        changed_scene(
            {
                "scene.origin": "world",
                "scene.objects.ground.position": ["0 m", "0 m", "-100 m"],
                "scene.objects.array": array | {"position": ["200 m", "0 m", "5 m"]},
                "scene.objects.image": image | {"position": ["-300 m", "100 m", "0 m"]},
            }
        ),
        tmp_path,
    )
    x, y = [200, 201, -300, -300, -300], [0, -1, 98.5, 101, 101.75]
    height, surface = straight_down(world, x, y)
    np.testing.assert_allclose(height, [15, 15 + 1 / 8 + 1 / 16, 0, 0, 6], atol=1e-9)
    np.testing.assert_array_equal(surface, [1, 1, 2, 2, 2])


def test_jacksboro_is_cut_about_its_middle_and_refined_through_its_posts():
    from sweep.scenes.rasters import read_jacksboro_terrain

    survey = read_jacksboro_terrain()
    row, column = 150, 250
    spot = survey.origin[:2] + np.multiply([column, row], survey.spacing)
    ground = {
        "kind": "jacksboro", "size": "1.1 km", "factor": 4, "reflectance": 0.1,
        "middle": [f"{c!r} m" for c in spot.tolist()],
    }  # fmt: skip
    _, world = built(changed_scene({"scene.objects.ground": ground, "scene.origin": "world"}))
    node = [[0, 0], [3, 0], [-2, 5]]
    x, y = (np.array(node) * survey.spacing).T
    height, _ = straight_down(world, x + 1e-6, y + 1e-6, height=2000.0)
    expected = [survey.heights[row + j, column + i] for i, j in node]
    np.testing.assert_allclose(height, expected, atol=1e-5)


def test_relief_is_added_and_follows_its_seed():
    def heights(**relief):
        fractal = {"hurst": 0.3, "rms_slope": 0.2, "baseline": "10 m"} | relief
        changes = {"scene.objects.ground.spacing": "20 m", "scene.objects.ground.relief": fractal}
        _, world = built(changed_scene(changes | {"scene.origin": "world"}))
        x, y = (v.ravel() for v in np.meshgrid(*[np.arange(-900, 900, 20.0)] * 2))
        return straight_down(world, x + 0.1, y + 0.1, height=5000.0)[0].reshape(90, 90)

    first, second_heights, other, twice = (
        heights(), heights(), heights(seed=1), heights(rms_slope=0.4)
    )  # fmt: skip
    np.testing.assert_array_equal(first, second_heights)
    np.testing.assert_allclose(twice, 2 * first, rtol=1e-9, atol=1e-9)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.9
    steps = np.diff(first, axis=1)
    # 20 m apart: 0.2 * 10 m * 2^0.3. The 8010 steps are all but independent: 5 sigma are 4 %.
    assert np.sqrt((steps**2).mean()) == pytest.approx(2 * 2**0.3, rel=0.05)


def test_craters_dig_into_their_ground():
    craters = {"smallest": "200 m", "largest": "600 m", "least_fresh": 1, "seed": 5}
    ground = {"scene.objects.ground.spacing": "20 m", "scene.objects.ground.craters": craters}
    _, world = built(changed_scene(ground | {"scene.origin": "world"}))
    x, y = (v.ravel() for v in np.meshgrid(*[np.arange(-990, 990, 15.0)] * 2))
    height, _ = straight_down(world, x, y)
    assert height.min() < -0.15 * 200 and height.max() > 0.03 * 200
    fewer = craters | {"equilibrium_diameter": "100 m"}
    _, world = built(changed_scene(ground | {"scene.objects.ground.craters": fewer}))
    assert np.abs(straight_down(world, x, y)[0]).mean() < np.abs(height).mean()


@pytest.mark.parametrize("ground", [HILLS_OBJECT, RELIEF_OBJECT], ids=lambda g: g["kind"])
def test_drawn_ground_is_the_same_for_a_seed_and_another_for_another(ground):
    def heights(**changes):
        things = {"scene.objects.ground": ground | changes, "scene.origin": "world"}
        _, world = built(changed_scene(things))
        return straight_down(world, np.linspace(-45, 45, 30), 3.0)[0]

    np.testing.assert_array_equal(heights(), heights())
    assert (heights() != heights(seed=1)).all()
    raised = heights(position=["0 m", "0 m", "10 m"])
    np.testing.assert_allclose(raised, heights() + 10, atol=1e-9)


def test_trees_have_leaves_and_trunks_of_their_own_on_the_ground():
    mapping = scene_with_object(TREES_OBJECT, "forest", radius="8 m", number=3)
    spec, world = built(mapping)
    assert [surface.name for surface in spec.surface_materials()] == [
        "ground",
        "forest.leaf",
        "forest.trunk",
    ]
    assert [surface.reflectance for surface in world.surface_materials] == [0.1, 0.4, 0.2]
    mesh = world.caster.meshes[0]
    heights = {
        k: (mesh.vertices + mesh.origin)[mesh.faces[mesh.surface_index == k]] for k in (1, 2)
    }
    assert heights[1][..., 2].min() > 2 and heights[1][..., 2].max() > 9
    assert -1 < heights[2][..., 2].min() < 0  # trunks reach below the ground
    trunks = heights[2][..., :2].reshape(-1, 2)
    assert np.hypot(*trunks.T).max() < 8.5


def test_boulders_lie_in_their_square_only():
    centre = ["30 m", "-20 m"]
    mapping = scene_with_object(BOULDERS_OBJECT, centre=centre)
    mapping["scene"]["objects"]["ground"]["spacing"] = "5 m"
    _, world = built(mapping)
    mesh = world.caster.meshes[0]
    corners = (mesh.vertices + mesh.origin)[mesh.faces[mesh.surface_index == 1]].reshape(-1, 3)
    distance = np.abs(corners[:, :2] - [30, -20]).max(axis=0)
    assert (distance < 30 + 2).all() and (distance > 20).all()  # widened to whole steps of 5 m


def test_a_power_law_strews_as_many_boulders_as_it_says():
    law = {"kind": "power", "density": "0.02 m^-2", "exponent": 3}
    _, world = built(
        scene_with_object(
            BOULDERS_OBJECT, law=law, smallest="1 m", largest="5 m", within="1 km", subdivisions=0
        )
    )
    faces = (world.caster.meshes[0].surface_index == 1).sum()
    expected = 0.02 * (1 - 5**-3) * 1000**2
    assert faces / 12 == pytest.approx(expected, abs=5 * math.sqrt(expected))


def test_a_mesh_is_scaled_turned_and_placed(tmp_path):
    trimesh.creation.box(extents=[1000.0, 2000, 3000]).export(tmp_path / "box.stl")
    mesh = {
        "kind": "mesh", "file": "box.stl", "unit": "mm", "scale": 2, "reflectance": 0.3,
        "position": ["50 m", "0 m", "10 m"], "rotation": {"heading": "90 deg"},
    }  # fmt: skip
    _, world = built(scene_with_object(mesh), tmp_path)
    x = np.array([50, 51.9, 52.1, 50, 50])
    y = np.array([0, 0, 0, 0.9, 1.1])
    height, surface = straight_down(world, x, y)
    np.testing.assert_allclose(height, [13, 13, 0, 13, 0], atol=1e-9)
    np.testing.assert_array_equal(surface, [1, 1, 0, 1, 0])


def test_a_mesh_without_a_position_shares_the_coordinates_of_the_ground(tmp_path):
    ball = trimesh.creation.box(extents=[4.0, 4, 4])
    ball.apply_translation([FAR[0] + 10, FAR[1], -4390 + 8])
    ball.export(tmp_path / "ball.ply")
    mapping = raster_study(tmp_path)
    mapping["scene"]["objects"]["ball"] = {"kind": "mesh", "file": "ball.ply", "reflectance": 1}
    _, world = built(mapping, tmp_path)
    height, surface = straight_down(world, [10.0, 14.0], 0.0)
    # STL and PLY hold single precision, which at 4e6 m is worth half a metre.
    np.testing.assert_allclose(height, [10, 14 / 8], atol=0.6)
    np.testing.assert_array_equal(surface, [1, 0])


def test_solids_are_what_they_are_called():
    mapping = scene_with_object(SPHERE_OBJECT, "ball", subdivisions=5)
    mapping["scene"]["objects"]["crate"] = BOX_OBJECT | {"position": ["20 m", "0 m", "3 m"]}
    _, world = built(mapping)
    x, y = np.array([0, 0, 0.6, 20.9, 21.1, 20]), np.array([9, 9.6, 9, 0, 0, 1.9])
    height, surface = straight_down(world, x, y)
    # Facets of an icosahedron cut five times lie within 3e-4 of its radius.
    np.testing.assert_allclose(height[:3], 3 + np.array([1, 0.8, 0.8]), atol=4e-4)
    np.testing.assert_allclose(height[3:], [6, 0, 6], atol=1e-9)
    np.testing.assert_array_equal(surface, [1, 1, 1, 2, 0, 2])


@pytest.mark.parametrize("subdivisions", [1, 3])
def test_facets_of_a_sphere_lie_as_near_as_promised(subdivisions):
    from sweep.scenes.meshes import box_facets, sphere_facets

    ball = sphere_facets(radius=2.0, subdivisions=subdivisions)
    middles = np.linalg.norm(ball.vertices[ball.faces].mean(axis=1), axis=1)
    assert len(ball.faces) == 20 * 4**subdivisions
    np.testing.assert_allclose(np.linalg.norm(ball.vertices, axis=1), 2)
    assert 0.2 * 2 / 4**subdivisions < 2 - middles.min() < 0.3 * 2 / 4**subdivisions
    for shape, volume in ((ball, None), (box_facets(size=(1, 2, 3)), 6.0)):
        a, b, c = np.moveaxis(shape.vertices[shape.faces], 1, 0)
        enclosed = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
        assert 0 < enclosed < 4 / 3 * math.pi * 8 if volume is None else enclosed == volume


def test_a_moving_box_is_met_where_it_is_and_closes_at_its_own_speed():
    rising = {
        "path": {
            "kind": "acceleration", "position": ["0 m", "0 m", "50 m"],
            "velocity": ["0 m/s", "0 m/s", "5 m/s"], "duration": "10 s",
        }
    }  # fmt: skip
    nadir = {"down": {"kind": "fixed", "beams": [[0, 0, -1]], "rate": "1 Hz"}}
    spec, world = built(scene_with_object(BOX_OBJECT, motion=rising) | {"scanners": nadir})
    assert [body is None for body in world.body_motions] == [True, False]
    eyes = flight_eyepoints(spec, world, "down")
    top = 50 + 5 * eyes.time + 3
    aloft = eyes.position[:, 2] > top
    assert aloft.sum() > 5
    np.testing.assert_allclose(eyes.range[aloft], (eyes.position[:, 2] - top)[aloft], rtol=1e-12)
    np.testing.assert_allclose(eyes.radial_velocity[aloft], (5 - eyes.velocity[:, 2])[aloft])
    assert (eyes.surface[aloft] == 1).all()


def test_a_spinning_box_stays_throughout_a_flight_that_begins_late(tmp_path):
    (tmp_path / "path.csv").write_text(
        "time [s], x [m], y [m], z [m]\n100, 0, 0.5, 50\n104, 0, 0.5, 50\n"
    )
    spin = {
        "path": {"kind": "still", "position": ["0 m", "0 m", "10 m"]},
        "attitude": {"kind": "spin", "angular_velocity": ["3 rad/s", "0 rad/s", "0 rad/s"]},
    }
    mapping = scene_with_object(BOX_OBJECT | {"size": ["9 m", "9 m", "2 m"]}, motion=spin)
    mapping["platform"]["path"] = {"kind": "waypoints", "file": "path.csv"}
    mapping["scanners"] = {"down": {"kind": "fixed", "beams": [[0, 0, -1]], "rate": "1 Hz"}}
    spec, world = built(mapping, tmp_path)
    eyes = flight_eyepoints(spec, world, "down")
    assert eyes.time[0] == 0 and eyes.range[0] == pytest.approx(39)
    # The point that is hit lies at (0, 0.5, 1) from the axis and rises at 3 x 0.5 m/s.
    assert eyes.radial_velocity[0] == pytest.approx(1.5, rel=1e-12)


def test_nothing_at_rest_makes_a_world_of_moving_bodies_alone():
    motion = {"path": {"kind": "still", "position": ["0 m", "0 m", "10 m"]}}
    mapping = changed_scene(
        {"scene.objects": {"crate": BOX_OBJECT | {"motion": motion}}, "scene.origin": "world"}
    )
    _, world = built(mapping)
    assert len(world.body_motions) == 1 and world.body_motions[0] is not None


def test_a_report_tells_of_each_object_what_was_mended(tmp_path):
    (tmp_path / "bad.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nf 1 2 3\nf 1 2 3\nf 1 2 4\n"
    )
    mesh = {"kind": "mesh", "file": "bad.obj", "reflectance": 1}
    mapping = scene_with_object(mesh, "scrap", position=["0 m", "0 m", "5 m"])
    _, world = built(mapping, tmp_path)
    assert world.mesh_reports[0].startswith("ground: 2 faces on 4 vertices")
    assert "scrap: 3 faces" in world.mesh_reports[1]
    assert "1 faces without area dropped; 1 duplicate faces dropped" in world.mesh_reports[1]


def test_an_object_that_can_not_be_made_is_named_in_plain_words():
    with pytest.raises(
        SceneError, match=r"scene.objects.forest: can not be made: 500 trees .* fit"
    ):
        built(scene_with_object(TREES_OBJECT, "forest", radius="5 m", number=500))
    with pytest.raises(SceneError, match="thing: can not be made: there is no ground within"):
        built(scene_with_object(BOULDERS_OBJECT, centre=["5 km", "0 m"]))


@pytest.mark.parametrize(
    "changes",
    [
        {"scene.objects.ground.spacing": "1 m"},
        {"scene.objects.ground.spacing": "30 m", "scene.objects.ground.factor": 30},
    ],
)
def test_a_ground_larger_than_the_memory_is_refused_before_it_is_made(changes, monkeypatch):
    """9e6 nodes take 220 bytes each while their tree is built."""
    monkeypatch.setattr("psutil.virtual_memory", lambda: type("M", (), {"available": 1.5e9}))
    with pytest.raises(SceneError, match=r"of 9,.* (2|1\.9\d*|2\.\d+) GB of memory, of which 1\.5"):
        built(changed_scene(changes | {"scene.objects.ground.size": "3 km"}))


def test_tiles_of_a_survey_make_ground_without_a_seam(tmp_path):
    """Two halves of a ramp: 41 rows of 31 and 30 columns, at 2 m."""
    heights = ramp()
    write_raster(tmp_path / "ground.tif", heights[:, :31], np.subtract(FAR, [30.0, 0.0]))
    write_raster(tmp_path / "east.tif", heights[:, 31:], np.add(FAR, [31.0, 0.0]))
    ground = {"kind": "raster", "reflectance": 0.1}
    _, world = built(
        changed_scene(
            {
                "scene.objects.ground": ground | {"file": "ground.tif"},
                "scene.objects.east": ground | {"file": "east.tif", "reflectance": 0.2},
                "scene.origin": "ground",
            }
        ),
        tmp_path,
    )
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(25, 40, 61) + 0.01, [-30.3, 0.2, 29.9]))
    height, surface = straight_down(world, x, y)
    np.testing.assert_allclose(height, x / 8 - y / 16, atol=1e-5)
    assert set(surface.tolist()) == {0, 1} and not world.warnings


def test_rasters_of_two_maps_or_of_none_are_refused_or_reported(tmp_path):
    write_raster(tmp_path / "ground.tif", ramp())
    write_raster(tmp_path / "east.tif", ramp(), np.add(FAR, [500.0, 0.0]), crs="EPSG:32632")
    ground = {"kind": "raster", "reflectance": 0.1}
    mapping = changed_scene(
        {
            "scene.objects.ground": ground | {"file": "ground.tif"},
            "scene.objects.east": ground | {"file": "east.tif"},
        }
    )
    with pytest.raises(SceneError, match="east: lies on the map 'WGS 84 / UTM zone 32N', and"):
        built(mapping, tmp_path)
    write_raster(tmp_path / "east.tif", ramp(), np.add(FAR, [500.0, 0.0]), crs=None)
    _, world = built(mapping, tmp_path)
    assert "scene.objects.east: names no coordinate reference system" in world.warnings[0]
