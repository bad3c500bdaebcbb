"""Coordinates of maps: scale on the ground, units of heights, one map, tiles of one grid."""

import math
import warnings

import numpy as np
import pyproj
import pytest
import rasterio
from rasterio import Affine

from sweep.scenes.map_frames import MapFrame, MetresPerUnit, degree_lengths, require_same_map
from sweep.scenes.rasters import raster_digest, read_raster_terrain
from sweep.scenes.scene_files import SceneError
from sweep.scenes.terrain import Terrain
from sweep.scenes.tiles import extend_tiles_to_neighbours

SLOPE = 0.2
"""Slope eastwards, on the ground, of the surveys written here."""

TEXT_LOCAL = 'LOCAL_CS["site",UNIT["{}",{}],AXIS["E",EAST],AXIS["N",NORTH]]'


@pytest.fixture
def survey(tmp_path):
    """A raster in a reference system about a place in it, as steep on the ground as stated."""

    def write(crs, middle, pixel, metres, *, name="dem.tif", side=5, unit=None):
        """`metres`: size of a unit of the coordinates on the ground, eastwards."""
        heights = 100 + SLOPE * metres * pixel * np.arange(side) * np.ones((side, 1))
        corner = middle[0] - side / 2 * pixel, middle[1] + side / 2 * pixel
        path = tmp_path / name
        with rasterio.open(
            path, "w", driver="GTiff", width=side, height=side, count=1, dtype="float64", crs=crs,
            transform=Affine(pixel, 0, corner[0], 0, -pixel, corner[1]),
        ) as data:  # fmt: skip
            data.write(heights, 1)
            if unit:
                data.units = (unit,)
        return path

    return write


def slope(terrain):
    return np.diff(terrain.heights, axis=1).mean() / terrain.spacing[0]


MERCATOR_60N = (1.2e6, 8_399_737.9)
MERCATOR_METRES = 0.50126
"""Metres to a unit there: cos(60 deg), and what the ellipsoid adds."""


def test_web_mercator_far_from_the_equator_is_refused_with_its_scale_or_read_with_it(survey):
    path = survey("EPSG:3857", MERCATOR_60N, 20.0, MERCATOR_METRES)
    with pytest.raises(SceneError, match=r"off by up to 99.* %.*metres_per_unit: \[0.50126,"):
        read_raster_terrain(path)
    with pytest.raises(SceneError, match=r"gdalwarp, e\.g\. -t_srs EPSG:32632"):
        read_raster_terrain(path)
    ground = read_raster_terrain(path, metres_per_unit=(0.50126, 0.500417))
    assert slope(ground) == pytest.approx(SLOPE, rel=1e-5) and not ground.warnings
    assert ground.spacing == pytest.approx((10.0252, -10.00834), rel=1e-4)


def test_a_scale_that_is_stated_wrongly_is_reported_or_refused(survey):
    path = survey("EPSG:3857", MERCATOR_60N, 20.0, MERCATOR_METRES)
    ground = read_raster_terrain(path, metres_per_unit=(0.51, 0.51))
    assert len(ground.warnings) == 1 and "off by up to 1.9" in ground.warnings[0]
    with pytest.raises(SceneError, match=r"off by up to 99\.\d %"):
        read_raster_terrain(path, metres_per_unit=(1.0, 1.0))


@pytest.mark.parametrize(
    ("crs", "middle"),
    [
        ("EPSG:32633", (500_000.0, 6_000_000.0)),
        ("EPSG:32633", (300_000.0, 200_000.0)),
        ("EPSG:27700", (400_000.0, 300_000.0)),  # British National Grid
        ("EPSG:3031", (100_000.0, 2_080_000.0)),  # Antarctic, near its standard parallel
        ("EPSG:32661", (2_000_000.0, 1_020_000.0)),  # north polar, near true scale
    ],
)
def test_maps_that_are_true_to_a_thousandth_are_taken_as_they_are(survey, crs, middle):
    ground = read_raster_terrain(survey(crs, middle, 10.0, 1.0))
    assert ground.spacing == (10.0, -10.0) and not ground.warnings
    assert slope(ground) == pytest.approx(SLOPE)


@pytest.mark.parametrize(
    ("crs", "middle", "message"),
    [
        ("EPSG:32633", (-100_000.0, 6_000_000.0), "off by up to 0.4"),  # far outside the zone
        ("EPSG:3035", (2_700_000.0, 1_700_000.0), "right angle|off by up to"),  # equal areas
        ("EPSG:4978", (0.0, 0.0), "centre of the planet"),
    ],
)
def test_other_maps_are_refused(survey, crs, middle, message):
    with pytest.raises(SceneError, match=message):
        read_raster_terrain(survey(crs, middle, 10.0, 1.0))


def test_a_large_raster_in_degrees_is_reported_how_far_its_edges_are_off(survey):
    metres = degree_lengths(45.0)
    near = survey("EPSG:4326", (10.0, 45.0), 1e-3, metres[0], name="near.tif")
    assert read_raster_terrain(near, metres_per_degree=metres).warnings == ()
    far = survey("EPSG:4326", (10.0, 45.0), 0.2, metres[0], name="far.tif")
    (warning,) = read_raster_terrain(far, metres_per_degree=metres).warnings
    # Half a degree off, the cosine of latitude differs by tan(45 deg) times that.
    relative_error = float(warning.split("off by up to ")[1].split(" %")[0]) / 100
    assert relative_error == pytest.approx(math.radians(0.5), rel=0.02)
    with pytest.raises(SceneError, match="off by up to"):
        read_raster_terrain(
            near, metres_per_degree=metres[::-1]
        )  # north and east in each other's place


FEET = "EPSG:2232"  # Colorado central, US survey feet
COLORADO = (3_000_000.0, 1_700_000.0)
SURVEY_FOOT = 1200 / 3937


def test_a_map_in_feet_asks_for_the_unit_of_its_heights(survey):
    path = survey(FEET, COLORADO, 100.0, 1.0)  # a rise of 0.2 feet to a foot
    with pytest.raises(SceneError, match=r"US survey foot.*height_unit, 'm' or 'sft'"):
        read_raster_terrain(path)
    assert slope(read_raster_terrain(path, height_unit="sft")) == pytest.approx(0.2, rel=1e-9)
    assert slope(read_raster_terrain(path, height_unit="ft")) == pytest.approx(0.2, rel=1e-5)
    assert slope(read_raster_terrain(path, height_unit="m")) == pytest.approx(0.656, rel=1e-3)
    undeclared = survey(FEET, COLORADO, 100.0, 1.0, name="told.tif", unit="US survey foot")
    assert slope(read_raster_terrain(undeclared)) == pytest.approx(0.2, rel=1e-9)
    assert (
        read_raster_terrain(path, has_height_scale=True).heights[0, 0] == 100
    )  # the spec's factor tells the unit


def test_a_vertical_reference_system_tells_the_unit_of_heights(survey):
    compound = pyproj.CRS("EPSG:2232+6360").to_wkt("WKT1_GDAL")  # NAVD88 height, US survey feet
    assert slope(read_raster_terrain(survey(compound, COLORADO, 100.0, 1.0))) == pytest.approx(0.2)
    metres = pyproj.CRS("EPSG:32633+5703").to_wkt("WKT1_GDAL")
    path = survey(metres, (500_000.0, 5_000_000.0), 10.0, 1.0, name="m.tif")
    assert slope(read_raster_terrain(path)) == pytest.approx(SLOPE)
    with pytest.raises(SceneError, match="states heights in metre, and the spec says ft"):
        read_raster_terrain(path, height_unit="ft")


def test_a_band_that_contradicts_its_vertical_reference_system_is_refused(survey):
    feet = pyproj.CRS("EPSG:32613+6360").to_wkt("WKT1_GDAL")  # NAVD88 height, US survey feet
    place = (500_000.0, 4_300_000.0), 10.0
    with pytest.raises(SceneError, match=r"contradicts itself.*'m'.*NAVD88.*US survey foot"):
        read_raster_terrain(survey(feet, *place, 1.0, unit="m"))
    # Either foot is written as 'ft'; the reference system tells which.
    ground = read_raster_terrain(survey(feet, *place, 1.0, name="ft.tif", unit="ft"))
    assert slope(ground) == pytest.approx(SLOPE * 1200 / 3937, rel=1e-9)


@pytest.mark.parametrize(
    ("one", "other", "message"),
    [
        ("EPSG:32613+5703", "EPSG:32613+5773", "'EGM96 height', and a above 'NAVD88 height'"),
        ("EPSG:32613+5703", "3d", "'ellipsoid WGS 84', and a above 'NAVD88 height'"),
        ("EPSG:32613+5703", "EPSG:32613+6360", ""),  # NAVD88 in feet
        ("EPSG:32613+5703", "EPSG:32613", ""),
        ("3d", "3d", ""),
    ],
)
def test_heights_above_two_surfaces_are_refused(survey, one, other, message):
    def map_frame(text, name):
        crs = pyproj.CRS("EPSG:32613").to_3d() if text == "3d" else pyproj.CRS(text)
        path = survey(crs.to_wkt(), (500_000.0, 4_300_000.0), 10.0, 1.0, name=f"{name}.tif")
        return name, read_raster_terrain(path).map_frame

    pair = [map_frame(one, "a"), map_frame(other, "b")]
    if not message:
        require_same_map(pair)
        return
    with pytest.raises(SceneError, match=message):
        require_same_map(pair)


def test_a_remedy_near_a_pole_names_no_zone_of_utm(survey):
    path = survey("EPSG:3413", (0.0, 0.0), 100.0, 1.03)
    with pytest.raises(SceneError, match=r"-t_srs '\+proj=stere \+lon_0=\S+ \+lat_0=(90|89\.99)"):
        read_raster_terrain(path)


def test_depths_are_no_heights(survey):
    depth = pyproj.CRS("EPSG:32633+5715").to_wkt("WKT1_GDAL")  # mean sea level depth
    with pytest.raises(SceneError, match=r"holds depths.*'MSL depth'"):
        read_raster_terrain(survey(depth, (500_000.0, 5e6), 10.0, 1.0))


def test_a_unit_and_a_factor_of_heights_are_too_much(survey):
    path = survey("EPSG:32633", (500_000.0, 5e6), 10.0, 1.0, unit="ft")
    with pytest.raises(SceneError, match=r"heights in ft.*leave the scale out"):
        read_raster_terrain(path, has_height_scale=True)


@pytest.mark.parametrize(("unit", "metres"), [("metre", 1.0), ("foot", 0.3048)])
def test_a_map_of_a_site_is_read_in_its_own_unit(survey, unit, metres):
    path = survey(TEXT_LOCAL.format(unit, metres), (50.0, 50.0), 2.0, 1.0)
    ground = read_raster_terrain(path, height_unit="m")
    assert ground.spacing == pytest.approx((2 * metres, -2 * metres))
    assert raster_digest(path)


def write_asc(path, *, west, south, cell):
    rows = "\n".join(" ".join(str(100 + 10 * k) for k in range(5)) for _ in range(5))
    path.write_text(
        f"ncols 5\nnrows 5\nxllcorner {west}\nyllcorner {south}\ncellsize {cell}\n{rows}\n"
    )
    return path


@pytest.mark.parametrize(
    ("west", "south", "cell"),
    [(10.0, 47.0, 1 / 1200), (-105.3, 39.9, 1 / 3600), (359.0, -45.0, 0.05), (0.0, 0.0, 0.01)],
)
def test_coordinates_that_could_be_degrees_are_asked_about(tmp_path, west, south, cell):
    path = write_asc(tmp_path / "dem.asc", west=west, south=south, cell=cell)
    with pytest.raises(SceneError, match=r"could be degrees.*state metres_per_degree.*.prj"):
        read_raster_terrain(path)
    ground = read_raster_terrain(path, metres_per_degree=degree_lengths(south))
    assert ground.spacing == pytest.approx(
        (cell * degree_lengths(south)[0], -cell * degree_lengths(south)[1])
    )
    ground = read_raster_terrain(path, metres_per_unit=(1.0, 1.0))
    assert ground.spacing == pytest.approx((cell, -cell))


def test_metres_without_a_reference_system_are_metres(tmp_path):
    for west, south, cell in ((0.0, 0.0, 1.0), (500_000.0, 4e6, 0.05), (-50.0, -50.0, 10.0)):
        path = write_asc(tmp_path / "dem.asc", west=west, south=south, cell=cell)
        assert read_raster_terrain(path).spacing == pytest.approx((cell, -cell))


def test_rasters_of_two_maps_are_refused(survey):
    def map_frame(zone, name, **crs):
        path = survey(f"EPSG:{zone}", (500_000.0, 5e6), 10.0, 1.0, name=name)
        return name, read_raster_terrain(path, **crs).map_frame

    one, same, other = (
        map_frame(32632, "a.tif"),
        map_frame(32632, "b.tif"),
        map_frame(32633, "c.tif"),
    )
    require_same_map([one, same])
    with pytest.raises(SceneError, match=r"c\.tif: lies on the map 'WGS 84 / UTM zone 33N', and a"):
        require_same_map([one, same, other])
    with pytest.raises(SceneError, match="state one size for both"):
        require_same_map([one, map_frame(32632, "d.tif", metres_per_unit=(1.0005, 1.0))])
    require_same_map([one, ("none", MapFrame(MetresPerUnit(1.0, 1.0)))])


HEIGHTS = np.random.default_rng(3).normal(size=(9, 12))


def tile(rows, columns, *, spacing=(2.0, -3.0), shift=(0.0, 0.0)):
    """A part of one survey, where it lies in it."""
    corner = columns.start * spacing[0] + shift[0], rows.start * spacing[1] + shift[1]
    origin = np.array([500_000.0 + corner[0], 4e6 + corner[1], 0.0])
    return Terrain(HEIGHTS[rows, columns], spacing, origin)


def covered(terrains, x, y):
    """Number of the terrains that have ground at each place, and its height."""
    heights = np.array([t.height_at(x, y) for t in terrains])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # no ground at all
        return np.isfinite(heights).sum(axis=0), np.nanmax(heights, axis=0)


@pytest.mark.parametrize("spacing", [(2.0, -3.0), (2.0, 3.0)])
def test_tiles_of_one_grid_have_no_seam_and_cover_all_once(spacing):
    parts = {
        f"{i}{j}": tile(rows, columns, spacing=spacing)
        for i, rows in enumerate((slice(0, 4), slice(4, 9)))
        for j, columns in enumerate((slice(0, 5), slice(5, 12)))
    }
    joined, messages = extend_tiles_to_neighbours(parts)
    assert not messages
    raster = tile(slice(0, 9), slice(0, 12), spacing=spacing)
    random = np.random.default_rng(5)
    x = 500_000 + spacing[0] * random.uniform(0, 11, 4000)
    y = 4e6 + spacing[1] * random.uniform(0, 8, 4000)
    number, height = covered(joined.values(), x, y)
    assert (number == 1).all()
    np.testing.assert_allclose(height, raster.height_at(x, y), atol=1e-9)
    heights, _ = covered(parts.values(), x, y)
    assert (heights == 0).mean() > 0.1  # the seams that there were


def test_tiles_that_overlap_or_lie_apart_stay_as_they_are():
    parts = {"a": tile(slice(0, 9), slice(0, 6)), "b": tile(slice(0, 9), slice(5, 12))}
    joined, messages = extend_tiles_to_neighbours(parts)
    assert joined["a"] is parts["a"] and joined["b"] is parts["b"] and not messages
    parts = {"a": tile(slice(0, 9), slice(0, 4)), "b": tile(slice(0, 9), slice(8, 12))}
    joined, messages = extend_tiles_to_neighbours(parts)
    assert joined["a"] is parts["a"] and not messages


def test_a_gap_between_grids_that_differ_is_reported():
    shifted = tile(slice(0, 9), slice(6, 12), shift=(0.7, 0.0))
    joined, messages = extend_tiles_to_neighbours(
        {"a": tile(slice(0, 9), slice(0, 6)), "b": shifted}
    )
    assert len(messages) == 1 and "between it and a lies a gap of 2.7 m" in messages[0]
    assert joined["b"] is shifted
