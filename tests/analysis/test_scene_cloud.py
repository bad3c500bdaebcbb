"""Clouds as gathered and drawn, held against the arrays of the store."""

import numpy as np
import pytest
import xarray as xr
from mpl_toolkits.mplot3d import proj3d
from stored_scenes import GROUND_SLOPE, copy_without_last_cycles

from sweep.analysis import canvas
from sweep.analysis.datasets import open_scene_tree
from sweep.analysis.scene_results import cloud_figures, point_styles, recordings
from sweep.analysis.scene_results.cloud_figures import HeightMap
from sweep.analysis.scene_results.recordings import (
    WORLD_AXES,
    PointCloud,
    ThinnedRows,
    find_axis_position,
    gather_point_cloud,
)
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG


@pytest.fixture(scope="module")
def tree(scene_store):
    return open_scene_tree(scene_store)


@pytest.fixture(scope="module")
def weak(tree, spec):
    return find_axis_position(spec, {"power": "0.3 mW"}).open_recording(tree, "pair")


@pytest.fixture(scope="module")
def arrays(scene_store):
    return xr.open_zarr(scene_store, group="pair", chunks=None).isel(power=0, draw=1).load()


def draw_cloud(cloud, tree, **options):
    arguments = {
        "quantity": "range", "surfaces": ["ground", "block"], "view": "above", "height_map": None,
        "title": "A cloud", "remarks": [],
    }  # fmt: skip
    sheet = cloud_figures.draw_cloud_sheet(cloud, **(arguments | options))
    sheet.canvas.draw()
    return sheet


def small_cloud(points, **changes):
    """A cloud of points given as columns x, y, z, all true."""
    table = dict(zip(WORLD_AXES, np.asarray(points, float), strict=True))
    number = table["x"].size
    table |= {
        "range": np.arange(number, dtype=float),
        "flags": np.full(number, TRUE_RETURN_FLAG, np.uint8),
    }
    box = {
        axis: (float(table[axis].min()) - 1, float(table[axis].max()) + 1) for axis in WORLD_AXES
    }
    parts = {
        "points": table,
        "flight_path": {},
        "thinned_points": ThinnedRows(number),
        "thinned_dropouts": ThinnedRows(0),
        "n_false_points_outside": 0,
        "box": box,
    }
    parts["thinned_points"].append(table)
    return PointCloud(**(parts | changes))


def test_dropouts_are_the_computed_shots_without_a_point_in_the_draw(weak, arrays):
    cloud_points = gather_point_cloud(
        weak, ["range"], ranges="quantised", draw=1, with_dropouts=True
    )
    none = (arrays.flags.values == 0).all(axis=-1)
    assert 20 < none.sum() < none.size - 20
    assert cloud_points.thinned_dropouts.n_total == none.sum()
    assert cloud_points.thinned_points.n_total == (arrays.flags.values > 0).sum()
    aimed = (
        arrays.platform_position.values
        + arrays.beam_range.values[:, None] * arrays.beam_direction.values
    )[none]
    for k, axis in enumerate(WORLD_AXES):
        assert np.array_equal(cloud_points.dropouts[axis], aimed[:, k])


@pytest.mark.parametrize("geometry", [True, False])
def test_shots_that_are_not_computed_are_no_dropouts(scene_store, spec, tmp_path, arrays, geometry):
    short = open_scene_tree(copy_without_last_cycles(scene_store, tmp_path, with_geometry=geometry))
    weak = find_axis_position(spec, {"power": "0.3 mW"}).open_recording(short, "pair")
    cloud = gather_point_cloud(weak, ["range"], ranges="quantised", draw=1, with_dropouts=True)
    none = (arrays.flags.values == 0).all(axis=-1)
    assert cloud.thinned_dropouts.n_total == none[:256].sum() > 0


@pytest.mark.parametrize(("power", "draw"), [("0.3 mW", 0), ("1 W", 1)])
def test_the_box_holds_true_points_dropouts_and_path_and_counts_false_points_beyond(
    scene_store, tree, spec, power, draw
):
    at = find_axis_position(spec, {"power": power})
    cloud = gather_point_cloud(
        at.open_recording(tree, "pair"), ["snr"], ranges="interpolated", draw=draw,
        with_dropouts=True, with_path=True,
    )  # fmt: skip
    arrays = xr.open_zarr(scene_store, group="pair", chunks=None).isel(**at.axis_indices, draw=draw)
    true = (arrays.flags.values & TRUE_RETURN_FLAG) > 0
    position = arrays.position.values
    for k, axis in enumerate(WORLD_AXES):
        low, high = cloud.box[axis]
        for inside in (position[true][:, k], cloud.dropouts[axis], cloud.flight_path[axis]):
            assert ((low < inside) & (inside < high)).all()
    box = np.array([cloud.box[axis] for axis in WORLD_AXES])
    false_points = position[(arrays.flags.values > 0) & ~true]
    n_beyond = ((false_points < box[:, 0]) | (false_points > box[:, 1])).any(axis=1).sum()
    assert cloud.n_false_points_outside == n_beyond > 0
    assert cloud.points["x"].size == cloud.thinned_points.n_total - n_beyond
    assert np.array_equal(cloud.flight_path["z"], arrays.platform_position.values[:, 2])


def test_crops_cut_points_and_dropouts_and_the_picture(weak):
    crops = {"x": (-30.0, 25.0), "time": (1.0, 5.0)}
    cloud = gather_point_cloud(weak, ["range"], ranges="quantised", crops=crops, with_dropouts=True)
    every = gather_point_cloud(weak, ["range"], ranges="quantised", with_dropouts=True)
    assert (
        0 < cloud.thinned_points.n_total < every.thinned_points.n_total
        and 0 < cloud.thinned_dropouts.n_total < every.thinned_dropouts.n_total
    )
    for table in (cloud.points, cloud.dropouts):
        assert table["x"].min() >= -30 and table["x"].max() <= 25
    margin = max(high - low for low, high in cloud.box.values()) * recordings.BOX_MARGIN_FRACTION
    assert cloud.box["x"][0] >= -30 - margin and cloud.box["x"][1] <= 25 + margin
    assert (
        gather_point_cloud(weak, ["range"], ranges="quantised", crops={"x": (1e5, np.inf)}) is None
    )


def test_many_points_are_thinned_and_the_foot_says_so(weak, tree):
    dense = gather_point_cloud(weak, ["shot"], ranges="quantised")
    cloud = gather_point_cloud(weak, ["shot"], ranges="quantised", points_max=50)
    assert cloud.thinned_points.step == 2 ** int(
        np.ceil(np.log2(dense.thinned_points.n_total / 50))
    )
    caption = draw_cloud(cloud, tree, quantity="shot").get_supxlabel()
    assert (
        f"{dense.thinned_points.n_total:,} points, one in {cloud.thinned_points.step} of them shown"
        in caption
    )


@pytest.mark.parametrize(
    ("view", "axes"), [("above", ("x", "y")), ("side", ("x", "z")), ("front", ("y", "z"))]
)
def test_views_along_an_axis_show_the_other_two_to_one_scale(weak, tree, view, axes):
    cloud = gather_point_cloud(
        weak, ["range"], ranges="quantised", with_dropouts=True, with_path=True
    )
    sheet = draw_cloud(cloud, tree, view=view, height_map=HeightMap.from_tree(tree))
    picture = sheet.axes[0]
    true = (cloud.points["flags"] & TRUE_RETURN_FLAG) > 0
    (offsets,) = (c.get_offsets() for c in picture.collections if c.zorder == 3)
    expected = np.column_stack([cloud.points[axis][true] for axis in axes])
    assert np.array_equal(np.sort(offsets, axis=0), np.sort(expected, axis=0))
    pixels = picture.transData.transform([[0, 0], [1, 0], [0, 1]])
    assert pixels[1, 0] - pixels[0, 0] == pytest.approx(pixels[2, 1] - pixels[0, 1], rel=1e-6)
    assert picture.get_xlabel() == f"{axes[0]} (m)" and picture.get_ylabel() == f"{axes[1]} (m)"


def test_the_nearest_points_lie_on_top():
    cloud = small_cloud([[0, 0, 0], [0, 0, 0], [5.0, 9.0, 1.0]])
    scale = point_styles.choose_colours(
        "range", cloud.points["range"], is_trusted=np.ones(3, bool), surfaces=[]
    )
    colour = draw_cloud(cloud, None).axes[0].collections[0].get_facecolors()
    assert np.allclose(colour, scale.to_rgba_colours(np.array([2.0, 0.0, 1.0])))


@pytest.mark.parametrize("view", ["oblique", (20.0, 60.0), (-130.0, 5.0)])
def test_a_view_at_an_angle_has_one_scale_fits_the_sheet_and_fills_it(view):
    cloud = small_cloud([[0, 300.0, 150.0], [0, 40.0, 90.0], [0, 10.0, 25.0]])
    sheet = draw_cloud(cloud, None, view=view)
    axes = sheet.axes[0]
    places = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    x, y, _ = proj3d.proj_transform(*places, axes.get_proj())
    units = axes.transData.transform(np.column_stack([x, y])) - axes.transData.transform(
        (x[0], y[0])
    )
    # an orthographic image of a right-angled frame of equal units: the squares sum to 2
    frame = units[1:]
    scale = np.sqrt((frame**2).sum() / 2)
    assert frame.T @ frame == pytest.approx(scale**2 * np.eye(2), abs=1e-6 * scale**2)
    corners = np.array(np.meshgrid(*(cloud.box[axis] for axis in WORLD_AXES))).reshape(3, -1)
    x, y, _ = proj3d.proj_transform(*corners, axes.get_proj())
    pixels = axes.transData.transform(np.column_stack([x, y]))
    size = sheet.get_size_inches() * sheet.dpi
    assert (pixels > 0).all() and (pixels < size).all()
    reach = np.ptp(pixels, axis=0) / sheet.dpi
    assert reach[0] == pytest.approx(7.6, rel=0.02) or reach[1] == pytest.approx(6.4, rel=0.02)


def test_velocities_of_both_signs_have_a_scale_centred_on_zero_and_of_one_sign_do_not():
    true = np.ones(3, bool)
    two_sided = point_styles.choose_colours(
        "radial_velocity", np.array([-1, 0, 4.0]), is_trusted=true, surfaces=[]
    )
    one = point_styles.choose_colours(
        "radial_velocity", np.array([1, 2, 4.0]), is_trusted=true, surfaces=[]
    )
    assert (two_sided.norm.vmin, two_sided.norm.vmax) == (-4, 4)
    assert two_sided.cmap is point_styles.DIVERGING_COLOUR_MAP
    assert (one.norm.vmin, one.norm.vmax) == (1, 4)
    assert two_sided.label == "radial velocity (m/s)"
    middle = two_sided.to_rgba_colours(np.array([0.0]))[0, :3]
    assert all(
        middle.sum() < two_sided.to_rgba_colours(np.array([v]))[0, :3].sum() for v in (-4.0, 4.0)
    )


def test_false_and_lonely_values_do_not_stretch_a_scale_but_are_counted():
    values = np.concatenate([np.linspace(100, 200, 1000), [5000.0, -7.0]])
    trusted = np.arange(values.size) < 1000
    scale = point_styles.choose_colours("range", values, is_trusted=trusted, surfaces=[])
    assert (scale.norm.vmin, scale.norm.vmax, scale.colour_bar_extend) == (100, 200, "both")
    lonely = point_styles.choose_colours(
        "range", values, is_trusted=np.ones(1002, bool), surfaces=[]
    )
    assert lonely.norm.vmin > 99 and lonely.norm.vmax < 201
    assert point_styles.choose_colours(
        "range", values[:1000], is_trusted=trusted[:1000], surfaces=[]
    ).colour_bar_extend == ("neither")


def test_surfaces_and_kinds_of_points_have_names_and_colours_of_their_own():
    values = np.array([0, 1, -1, 1.0])
    names = point_styles.choose_colours(
        "surface", values, is_trusted=np.ones(4, bool), surfaces=["ground", "block"]
    )
    assert names.label_by_number == {-1: "none", 0: "ground", 1: "block"}
    paint = names.to_rgba_colours(values)
    assert len(np.unique(paint, axis=0)) == 3 and np.array_equal(paint[1], paint[3])
    assert len(set(canvas.LINE_COLOURS)) == len(canvas.LINE_COLOURS)
    kinds = point_styles.choose_colours(
        "flags", np.array([0, 4.0]), is_trusted=np.ones(2, bool), surfaces=[]
    )
    assert list(kinds.label_by_number.values()) == ["true", "sidelobe"]


def test_far_off_coordinates_are_read_against_a_round_number():
    points = np.array([[4_000_000.0, 4_000_300.0], [10.0, 90.0], [0, 10.0]])
    sheet = draw_cloud(small_cloud(points), None)
    picture = sheet.axes[0]
    assert picture.get_xlabel() == "x - 4000000 (m)" and picture.get_ylabel() == "y (m)"
    words = [tick.get_text() for tick in picture.get_xticklabels()]
    assert "200" in words and not any("e" in word for word in words)


def test_the_ground_of_the_store_is_the_slope_with_the_block(tree):
    for x, y, height in (
        (-60.0, 20.0, -60 * GROUND_SLOPE),
        (-20.0, -20.0, -20 * GROUND_SLOPE),
        (20.0, 0.0, 20.0),
    ):
        part = HeightMap.from_tree(tree).crop((x - 0.5, x + 0.5), (y - 0.5, y + 0.5), nodes_max=3)
        assert part.height[1, 1] == pytest.approx(height, abs=1e-6)


def test_cropped_ground_of_even_slope_is_that_slope_at_every_node():
    x, y = np.linspace(0, 100, 11), np.linspace(-50, 50, 6)
    ground = HeightMap(x, y, 3 + 0.2 * x - 0.1 * y[:, None])
    part = ground.crop((13.0, 57.0), (-500.0, 11.0), nodes_max=23)
    assert (part.x[0], part.x[-1], part.y[0], part.y[-1]) == (13, 57, -50, 11)
    assert part.x.size <= 23 and part.y.size == 23
    np.testing.assert_allclose(part.height, 3 + 0.2 * part.x - 0.1 * part.y[:, None], rtol=1e-12)
    assert ground.crop((200.0, 300.0), (0.0, 10.0)) is None


def test_slopes_towards_the_light_are_brighter_and_walls_are_left_open():
    x = y = np.linspace(0, 10, 21)
    towards = HeightMap(
        x, y, 0.3 * (x - y[:, None])
    ).hillshade()  # rises to the south-east, faces the sun
    facing_away = HeightMap(x, y, 0.3 * (y[:, None] - x)).hillshade()
    level = HeightMap(x, y, np.zeros((21, 21))).hillshade()
    assert (towards > level).all() and (level > facing_away).all()
    step = np.where(x > 5, 10.0, 0.0) + 0 * y[:, None]
    is_kept = np.isfinite(HeightMap(x, y, step).mask_steep_ground().height)
    assert not is_kept[:, 10].any() and is_kept[:, :9].all() and is_kept[:, 13:].all()
