"""Exported points, read back by other programs' libraries, against the arrays of the store."""

import csv

import laspy
import numpy as np
import pytest
import rasterio
import trimesh
import xarray as xr
from stored_scenes import GROUND_CENTRE, copy_without_last_cycles, run_flight_into_store

from sweep.analysis.datasets import NotAStoreError, open_scene_tree
from sweep.analysis.scene_results.point_export import POINT_COLUMNS, PointTable, export, write_las
from sweep.analysis.scene_results.recordings import Recording
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG
from sweep.scenes.map_projection import metric_projection_wkt
from sweep.spec import SpecError


def expected(store, *, scanner="pair", power=1, draw=1, ranges="interpolated"):
    """Columns that a file must hold, straight from the arrays."""
    arrays = xr.open_zarr(store, group=scanner, chunks=None).isel(power=power, draw=draw).load()
    is_point = arrays.flags.values > 0
    shot, place = np.nonzero(is_point)
    suffix = "_interpolated" if ranges == "interpolated" else ""
    reach = arrays[f"range{suffix}"].values[is_point]
    position = arrays.platform_position.values[shot] + np.array(GROUND_CENTRE)
    position = position + reach[:, None] * arrays.beam_direction.values[shot]
    columns = dict(zip("xyz", position.T, strict=True))
    columns |= {"range": reach, "shot": shot, "return_number": place + 1}
    columns["number_of_returns"] = is_point.sum(axis=1)[shot]
    for name in ("radial_velocity", "range_standard_error", "radial_velocity_standard_error"):
        stored = name
        if suffix:
            stored = (
                name.replace("_standard", "_interpolated_standard") if "_error" in name
                else name + suffix
            )  # fmt: skip
        columns[name] = arrays[stored].values[is_point]
    for name in ("snr", "pd", "surface", "flags", "true_range", "true_radial_velocity"):
        columns[name] = arrays[name].values[is_point]
    for name in ("time", "beam"):
        columns[name] = arrays[name].values[shot]
    ahead, beam = arrays.platform_velocity.values[shot], arrays.beam_direction.values[shot]
    side = np.cross(beam, ahead)[:, 2]  # over 0 on the right
    columns["scan_angle"] = np.degrees(np.arccos(-beam[:, 2])) * np.where(side < 0, -1, 1)
    return columns


CLOSE = {"scan_angle"}
"""Columns that are worked out another way here than there."""


def same(actual, expected, name):
    """Tell whether a column is as stored, or close to what it should be where it is worked out."""
    if name in CLOSE:
        return actual == pytest.approx(expected, abs=1e-6)
    return np.array_equal(actual, expected, equal_nan=True)


def test_the_columns_of_files_are_those_expected(scene_store):
    assert set(expected(scene_store)) == set(POINT_COLUMNS)


@pytest.mark.parametrize("ranges", ["interpolated", "quantised"])
def test_a_ply_file_holds_every_point_with_all_fields_as_stored(scene_store, tmp_path, ranges):
    file = tmp_path / "deep" / "cloud.ply"
    number = export(
        scene_store, file, scanner="pair", draw=1, ranges=ranges, where={"power": "1 W"}
    )
    expected_points = expected(scene_store, ranges=ranges)
    cloud = trimesh.load(file)
    vertices = cloud.metadata["_ply_raw"]["vertex"]["data"]
    assert number == len(vertices) == len(expected_points["x"]) > 50
    np.testing.assert_allclose(cloud.vertices, np.column_stack([expected_points[a] for a in "xyz"]),
                               rtol=0, atol=1e-8)  # fmt: skip
    for name in expected_points.keys() - set("xyz"):
        assert same(vertices[name], expected_points[name], name), name
    header = file.read_bytes().split(b"end_header")[0].decode()
    for text in ("comment surface 1: block", "comment flag 2: false alarm", "power 1000 mW",
                 "comment radial_velocity: positive when closing",
                 "radial_velocity_standard_error true_radial_velocity in m s-1"):  # fmt: skip
        assert text in header
    assert list(tmp_path.iterdir()) == [file.parent] and list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize("suffix", [".las", ".laz", ".LAS"])
def test_a_las_file_keeps_a_tenth_of_a_millimetre_and_all_other_fields(
    scene_store, tmp_path, suffix
):
    file = tmp_path / f"cloud{suffix}"
    export(scene_store, file, scanner="pair", draw=1, where={"power": "1 W"})
    expected_points, las = expected(scene_store), laspy.read(file)
    assert (str(las.header.version), las.header.point_format.id) == ("1.4", 6)
    assert las.header.global_encoding.wkt
    (projection,) = las.header.vlrs.get("WktCoordinateSystemVlr")
    assert rasterio.crs.CRS.from_wkt(projection.string) == rasterio.crs.CRS.from_epsg(32633)
    for axis in "xyz":
        assert np.abs(np.asarray(las[axis]) - expected_points[axis]).max() <= 0.5e-4 + 1e-9
    assert np.array_equal(las.gps_time, expected_points["time"])
    numbers = {"return_number", "number_of_returns", "scan_angle"}
    for name in expected_points.keys() - {*"xyz", "time", *numbers}:
        assert np.array_equal(np.asarray(las[name]), expected_points[name], equal_nan=True), name
    assert np.array_equal(las.stored_return, expected_points["return_number"])
    assert np.array_equal(las.user_data, expected_points["beam"]) and len(set(las.user_data)) == 2
    assert 0.006 * np.asarray(las.scan_angle) == pytest.approx(
        expected_points["scan_angle"], abs=0.0031
    )
    assert np.asarray(las.scan_angle).min() < -500 and np.asarray(las.scan_angle).max() > 500
    true = (expected_points["flags"] & TRUE_RETURN_FLAG) > 0
    assert np.array_equal(np.asarray(las.classification) == 7, ~true) and not true.all()
    decibels = 10 * np.log10(expected_points["snr"])
    assert np.asarray(las.intensity) == pytest.approx(100 * decibels, abs=0.51)
    units = {extra.name: extra.description for extra in las.point_format.extra_dimensions}
    assert units["radial_velocity"] == "m s-1; positive when closing" and units["snr"] == ""
    assert (file.read_bytes()[104] >= 128) == (suffix == ".laz")  # the format's compression bit


def test_a_csv_file_has_units_in_its_header_and_digits_that_give_the_same_numbers(
    scene_store, tmp_path
):
    file = tmp_path / "cloud.csv"
    number = export(scene_store, file, scanner="pair", draw=1, where={"power": "1 W"})
    expected_points = expected(scene_store)
    with file.open(newline="") as text:
        header, *rows = csv.reader(text)
    assert header[:6] == ["x [m]", "y [m]", "z [m]", "time [s]", "range [m]",
                          "radial_velocity [m s-1; positive when closing]"]  # fmt: skip
    assert len(rows) == number == len(expected_points["x"])
    columns = np.array(rows, float).T
    for title, column in zip(header, columns, strict=True):
        name = title.split(" ")[0]
        if name in "xyz":
            assert column == pytest.approx(expected_points[name], abs=1e-8)
        else:
            assert same(column, expected_points[name], name), name


def test_what_is_not_computed_yet_is_left_out(scene_store, tmp_path):
    short = copy_without_last_cycles(scene_store, tmp_path)
    file = tmp_path / "short.ply"
    number = export(short, file, scanner="pair", draw=1, where={"power": "1 W"})
    assert number == (expected(scene_store)["shot"] < 256).sum()
    assert len(trimesh.load(file).vertices) == number


def test_a_single_scanner_and_place_need_not_be_named(tmp_path, scene_store):
    from stored_scenes import SCENE_MAPPING

    path = SCENE_MAPPING["platform"]["path"] | {"from": ["30 m", "5 m", "170 m"]}
    store = run_flight_into_store(
        tmp_path,
        scanners={"one": SCENE_MAPPING["scanners"]["square"]},
        axes={},
        draws={"number": 1},
        platform={"path": path, "attitude": {"kind": "nadir"}},
    )
    assert export(store, tmp_path / "one.ply") > 10


def test_all_mistakes_are_reported_at_once_with_what_to_take_instead(scene_store, tmp_path):
    with pytest.raises(SpecError) as error_info:
        export(
            scene_store, tmp_path / "cloud.xyz", scanner="sqare", draw=3, ranges="quantized"
        )  # fmt: skip
    text = str(error_info.value)
    for part in (
        "file: must have a suffix that says its format", "take one of .ply, .las, .laz, .csv",
        "scanner: is no scanner of this study (you wrote sqare); did you mean 'square'?",
        "draw: is no draw of this study (you wrote 3); they are numbered 0 to 2",
        "did you mean 'quantised'?",
        "where.power: has 2 values, and a file holds the points of one; choose power from 0.3 mW",
    ):  # fmt: skip
        assert part in text
    with pytest.raises(SpecError, match="scanner: must be named where there are several"):
        export(scene_store, tmp_path / "cloud.ply", where={"power": "1 W"})
    with pytest.raises(NotAStoreError):
        export(tmp_path / "none.zarr", tmp_path / "cloud.ply")
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_can_not_be_finished_leaves_the_old_one(scene_store, tmp_path, monkeypatch):
    file = tmp_path / "cloud.ply"
    file.write_text("old")
    monkeypatch.setattr(PointTable, "iter_rows", lambda self: iter([1 / 0]))
    with pytest.raises(ZeroDivisionError):
        export(scene_store, file, scanner="pair", where={"power": "1 W"})
    assert file.read_text() == "old" and list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(("half", "step"), [(100.0, 1e-4), (214_000.0, 1e-4), (215_000.0, 1e-3)])
def test_las_steps_grow_only_where_points_lie_farther_apart_than_its_integers_reach(
    scene_store, tmp_path, half, step
):
    """2^31 steps of 0.1 mm to either side of the offset are 214.7 km."""
    group = (
        open_scene_tree(scene_store)
        .children["square"]
        .to_dataset(inherit=False)
        .isel(power=1)
        .load()
    )
    is_point = group.flags.values[:, 0] > 0
    position = np.full(group.position.shape, np.nan)
    position[:, 0][is_point] = np.linspace(-half, half, is_point.sum())[:, None] * [1.0, 0.1, 0.0]
    wide = group.assign(position=(group.position.dims, position))
    table = PointTable(Recording("square", wide), 0, "interpolated", np.array([4e6, 0.0, 0.0]))
    file = tmp_path / "wide.las"
    write_las(table, file, [])
    las = laspy.read(file)
    assert las.header.scales.tolist() == [step] * 3
    x = position[:, 0][is_point][:, 0] + 4e6
    assert np.abs(np.asarray(las.x) - x).max() <= 0.5 * step + 1e-8


def test_returns_of_a_las_file_are_numbered_by_range_and_false_points_apart(scene_store, tmp_path):
    for draw in range(3):
        file = tmp_path / f"{draw}.las"
        export(scene_store, file, scanner="pair", draw=draw, where={"power": "1 W"})
        las = laspy.read(file)
        kinds = np.column_stack([las.shot, np.asarray(las.classification) == 7])
        for kind in np.unique(kinds, axis=0):
            is_kind = (kinds == kind).all(axis=1)
            order = np.argsort(np.asarray(las.range)[is_kind], kind="stable")
            number = np.asarray(las.return_number)[is_kind][order]
            assert number.tolist() == list(range(1, is_kind.sum() + 1))
            assert (np.asarray(las.number_of_returns)[is_kind] == is_kind.sum()).all()
        several = np.asarray(las.number_of_returns) > 1
        assert several.any()
        strongest_is_not_nearest = np.asarray(las.stored_return) != np.asarray(las.return_number)
        assert strongest_is_not_nearest.any()


def test_times_and_projections_of_a_scenes_files(tmp_path):
    """Times of the platform's table come back, and a scene without a map states no projection."""
    first = "1350000000.25"
    rows = "".join(f"{first[:-4]}{i}.25, {4 * i}, 0, {300 - i}\n" for i in range(4))
    (tmp_path / "path.csv").write_text(f"time [s], x [m], y [m], z [m]\n{rows}")
    ground = {"kind": "plane", "size": "3 km", "reflectance": 0.1}
    store = run_flight_into_store(
        tmp_path, axes={}, draws={"number": 1},
        scanners={"one": {"kind": "corners", "angle": "7.5 deg", "rate": "2 Hz"}},
        scene={"origin": "ground", "objects": {"ground": ground}},
        platform={"path": {"kind": "waypoints", "file": "path.csv"}},
    )  # fmt: skip
    tree = open_scene_tree(store)
    assert tree.attrs["time_origin"] == first and tree.attrs["projection"] == ""
    assert tree["one"].time.values[0] == 0
    export(store, tmp_path / "cloud.las")
    las = laspy.read(tmp_path / "cloud.las")
    assert las.gps_time.min() == float(first)
    assert not las.header.global_encoding.wkt and not las.header.vlrs.get("WktCoordinateSystemVlr")


@pytest.mark.parametrize(("crs", "metres_per_unit", "is_metric"), [
    ("EPSG:32633", None, True), ("EPSG:2232", None, False), ("EPSG:4326", None, False),
    ("EPSG:3857", (0.5, 0.5), False), ("EPSG:3413", (1.03, 1.03), False),
])  # fmt: skip
def test_only_projections_in_metres_are_those_of_a_scene(tmp_path, crs, metres_per_unit, is_metric):
    shape = {"height": 3, "width": 3, "count": 1, "dtype": "float64"}
    corner = rasterio.Affine(1, 0, 5, 0, -1, 5)
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", crs=crs, transform=corner, **shape):
        pass
    assert bool(metric_projection_wkt(tmp_path / "a.tif", metres_per_unit)) == is_metric


def test_a_projection_is_that_of_coordinates_as_they_are_exported(tmp_path):
    """Stated sizes scale a scene's coordinates, and feet of height are turned into metres."""
    shape = {"height": 3, "width": 3, "count": 1, "dtype": "float64"}
    corner = rasterio.Affine(1, 0, 5e5, 0, -1, 4e6)
    path = tmp_path / "a.tif"
    with rasterio.open(path, "w", driver="GTiff", crs="EPSG:32613+6360", transform=corner, **shape):
        pass
    assert metric_projection_wkt(path, (1.001, 1.0)) == ""
    projection = metric_projection_wkt(path, (1.0, 1.0))
    assert rasterio.crs.CRS.from_wkt(projection) == rasterio.crs.CRS.from_epsg(32613)
    assert "foot" not in projection and metric_projection_wkt(path) == projection
