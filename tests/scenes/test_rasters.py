import http.server
import io
import math
import os
import threading
import warnings
import zipfile

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio import Affine

from sweep.scenes.rasters import (
    degree_lengths,
    raster_digest,
    read_image_terrain,
    read_jacksboro_terrain,
    read_numpy_terrain,
    read_raster_terrain,
)
from sweep.scenes.scene_files import SceneError

HEIGHTS = np.arange(20, dtype=np.float32).reshape(4, 5)
SOUTHWARDS = Affine(2.0, 0.0, 500_000.0, 0.0, -3.0, 4_000_000.0)
UTM, DEGREES, TEXAN_FEET = "EPSG:32617", "EPSG:4326", "EPSG:2276"


@pytest.fixture
def tiff(tmp_path):
    """A GeoTIFF with given heights and profile."""

    def write(heights=HEIGHTS, *, name="dem.tif", units=None, scale=None, **profile):
        profile = {"crs": UTM, "transform": SOUTHWARDS} | profile
        path = tmp_path / name
        profile = {key: value for key, value in profile.items() if value is not None}
        bands = np.atleast_3d(heights.T).T
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(
                path, "w", driver="GTiff", width=bands.shape[2], height=bands.shape[1],
                count=len(bands), dtype=bands.dtype, **profile,
            ) as data:  # fmt: skip
                data.write(bands)
                if units:
                    data.units = (units,)
                if scale:
                    data.scales, data.offsets = (scale[0],), (scale[1],)
        return path

    return write


def test_nodes_lie_at_the_centres_of_pixels_with_the_first_row_in_the_north(tiff):
    ground = read_raster_terrain(tiff())
    np.testing.assert_array_equal(ground.heights, HEIGHTS)
    assert ground.spacing == (2.0, -3.0)
    np.testing.assert_array_equal(ground.origin, [500_001.0, 3_999_998.5, 0.0])
    assert ground.bounds == (500_001.0, 3_999_989.5, 500_009.0, 3_999_998.5)
    assert ground.height_at(np.array(500_003.0), np.array(3_999_995.5)) == HEIGHTS[1, 1]


def test_a_raster_that_runs_northwards_is_read_as_it_lies(tiff):
    ground = read_raster_terrain(tiff(crs=None, transform=Affine(2, 0, 0, 0, 3, 0)))
    assert ground.spacing == (2.0, 3.0)
    assert ground.height_at(np.array(1.0), np.array(1.5)) == HEIGHTS[0, 0]


def test_pixels_without_data_are_holes(tiff):
    heights = HEIGHTS.copy()
    heights[1, 2], heights[2, 3] = -9999, np.nan
    ground = read_raster_terrain(tiff(heights, nodata=-9999))
    assert np.isnan(ground.heights[[1, 2], [2, 3]]).all()
    assert np.isnan(ground.heights).sum() == 2


def test_whole_numbers_may_have_holes_too(tiff):
    heights = HEIGHTS.astype(np.int16)
    heights[0, 0] = -32768
    ground = read_raster_terrain(tiff(heights, nodata=-32768))
    assert np.isnan(ground.heights[0, 0]) and ground.heights[3, 4] == 19.0


def test_a_stated_scale_and_offset_of_the_heights_are_applied(tiff):
    ground = read_raster_terrain(tiff(scale=(0.5, 1000.0)))
    np.testing.assert_allclose(ground.heights, HEIGHTS * 0.5 + 1000)


def test_feet_become_metres_both_ways(tiff):
    texan = Affine(2.0, 0.0, 2_500_000.0, 0.0, -3.0, 7_000_000.0)
    ground = read_raster_terrain(tiff(crs=TEXAN_FEET, units="ft", transform=texan))
    survey_foot = 1200 / 3937
    np.testing.assert_allclose(ground.spacing, (2 * survey_foot, -3 * survey_foot), rtol=1e-9)
    np.testing.assert_allclose(ground.origin[0], 2_500_001 * survey_foot, rtol=1e-9)
    np.testing.assert_allclose(ground.heights, HEIGHTS * 0.3048, rtol=1e-7)


def test_a_window_cuts_out_its_part_where_it_lies(tiff):
    terrain = read_raster_terrain(tiff())
    part = read_raster_terrain(tiff(), window=(500_002.0, 3_999_991.0, 500_008.0, 3_999_997.0))
    np.testing.assert_array_equal(part.heights, HEIGHTS[1:3, 1:4])
    x, y = np.meshgrid([500_003.0, 500_006.5], [3_999_993.0, 3_999_995.0])
    np.testing.assert_allclose(part.height_at(x, y), terrain.height_at(x, y))


def test_another_band_can_be_read(tiff):
    bands = np.stack([HEIGHTS, 2 * HEIGHTS])
    np.testing.assert_array_equal(read_raster_terrain(tiff(bands), band=2).heights, 2 * HEIGHTS)


def test_degrees_become_metres_of_a_stated_size(tiff):
    arc = Affine(1 / 1200, 0.0, -84.0, 0.0, -1 / 1200, 36.5)
    path = tiff(crs=DEGREES, transform=arc)
    ground = read_raster_terrain(path, metres_per_degree=(90_000.0, 111_000.0))
    np.testing.assert_allclose(ground.spacing, (75.0, -92.5))
    with pytest.raises(SceneError, match="degrees") as refused:
        read_raster_terrain(path)
    # The remedy gives the size on the raster's own ellipsoid, to be copied.
    names = str(refused.value).split("[")[1].split("]")[0].split(",")
    assert [float(size) for size in names] == pytest.approx(degree_lengths(36.498333), abs=0.06)


def test_degrees_of_the_moon_are_measured_on_the_moon(tiff):
    moon = rasterio.crs.CRS.from_proj4("+proj=longlat +R=1737400 +no_defs")
    with pytest.raises(SceneError, match="30323") as refused:
        read_raster_terrain(tiff(crs=moon, transform=Affine(1e-3, 0, 0, 0, -1e-3, 0.01)))
    assert math.radians(1737400) == pytest.approx(30323.3, abs=0.1)
    assert "metres_per_degree" in refused.value.remedy


def test_a_raster_without_scale_needs_the_size_of_a_pixel(tiff):
    path = tiff(crs=None, transform=None)
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        ground = read_raster_terrain(path, pixel=4.0)
    assert ground.spacing == (4.0, -4.0) and ground.bounds == (2.0, 2.0, 18.0, 14.0)
    with (
        pytest.warns(rasterio.errors.NotGeoreferencedWarning),
        pytest.raises(SceneError, match="states no scale; state the size of a pixel"),
    ):
        read_raster_terrain(path)


@pytest.mark.parametrize(
    ("profile", "options", "message"),
    [
        ({"transform": Affine(2, 0.1, 0, 0.1, -3, 0)}, {}, "rotated.*gdalwarp"),
        ({}, {"band": 2}, "1 band"),
        ({}, {"band": 0}, "1 band"),
        ({}, {"window": (0.0, 0.0, 10.0, 10.0)}, "no ground within.*covers"),
        ({}, {"window": (500_008.0, 3_999_991.0, 500_002.0, 3_999_997.0)}, "no ground within"),
        ({}, {"metres_per_degree": (1.0, 1.0)}, "not in degrees"),
        ({}, {"pixel": 2.0}, "states its own scale"),
        ({"nodata": 7.0, "heights": np.full((3, 3), 7.0)}, {}, "too few heights"),
        ({"units": "furlonk"}, {}, "furlonk"),
        ({"crs": DEGREES}, {"metres_per_degree": (0.0, 1.0)}, "positive"),
    ],
)
def test_a_raster_that_can_not_be_used_is_refused_with_file_rule_and_remedy(
    tiff, profile, options, message
):
    path = tiff(**profile)
    with pytest.raises(SceneError, match=message) as refused:
        read_raster_terrain(path, **options)
    assert str(refused.value).startswith(str(path)) and refused.value.remedy


def test_files_that_are_no_raster_or_not_there_are_refused(tmp_path, tiff):
    nonsense = tmp_path / "nonsense.tif"
    nonsense.write_text("no raster")
    with pytest.raises(SceneError, match="no raster"):
        read_raster_terrain(nonsense)
    with pytest.raises(SceneError, match=r"does not exist.*there is: nonsense.tif"):
        read_raster_terrain(tmp_path / "dem2.tif")
    with pytest.raises(SceneError, match="is a folder"):
        read_raster_terrain(tmp_path)


def test_a_raster_too_large_to_read_asks_for_a_window(tiff, monkeypatch):
    monkeypatch.setattr("sweep.scenes.rasters.GRID_CELLS_MAX", 15)
    with pytest.raises(SceneError, match="give a window"):
        read_raster_terrain(tiff())
    assert read_raster_terrain(tiff(), window=(5e5, 3_999_988.0, 500_006.0, 4e6)).heights.size == 12


def test_a_degree_of_longitude_and_of_latitude_are_those_of_the_ellipsoid():
    """A degree of latitude is the meridian's length, by quadrature of its curve."""
    from scipy.integrate import quad

    a, flattening = 6_378_137.0, 1 / 298.257223563
    b = a * (1 - flattening)

    def point(latitude):
        # The geodetic latitude is that of the normal to the ellipse.
        phi = math.radians(latitude)
        scale = math.hypot(a * math.cos(phi), b * math.sin(phi))
        return a * a * math.cos(phi) / scale, b * b * math.sin(phi) / scale

    def speed(latitude, step=1e-4):
        (r0, z0), (r1, z1) = point(latitude - step), point(latitude + step)
        return math.hypot(r1 - r0, z1 - z0) / (2 * step)

    north, _ = quad(speed, 44.5, 45.5)
    east = math.radians(point(45.0)[0])
    assert degree_lengths(45.0) == pytest.approx((east, north), rel=1e-6)
    assert degree_lengths(60.0, radius=1e6, flattening=0.0) == pytest.approx(
        (math.radians(5e5), math.radians(1e6))
    )


def vrt(path, source):
    """A raster of the heights in another place."""
    path.write_text(
        '<VRTDataset rasterXSize="5" rasterYSize="4"><SRS>EPSG:32617</SRS>'
        "<GeoTransform>500000, 2, 0, 4000000, 0, -3</GeoTransform>"
        '<VRTRasterBand dataType="Float32" band="1"><SimpleSource>'
        f'<SourceFilename relativeToVRT="0">{source}</SourceFilename><SourceBand>1</SourceBand>'
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    return path


def test_the_digest_of_a_raster_follows_the_files_that_it_takes_its_heights_from(tiff, tmp_path):
    over = vrt(tmp_path / "over.vrt", tiff())
    second_path = vrt(tmp_path / "again.vrt", over)
    before = raster_digest(over), raster_digest(second_path)
    assert before[0] == before[1] == raster_digest(tiff())
    tiff(HEIGHTS + 500)
    after = raster_digest(over), raster_digest(second_path)
    assert after[0] == after[1] != before[0]


def test_the_digest_of_a_raster_follows_its_world_file_and_not_its_encoding(tiff, tmp_path):
    path, world = tiff(crs=None, transform=None), tmp_path / "dem.tfw"
    digests = []
    for step in (2, 3):
        world.write_text(f"{step}\n0\n0\n-{step}\n10\n10\n")
        digests.append(raster_digest(path))
    assert digests[0] != digests[1]
    assert raster_digest(tiff()) == raster_digest(tiff(name="b.tif", compress="deflate"))
    assert raster_digest(tiff()) != raster_digest(tiff(name="c.tif", nodata=3))
    assert raster_digest(tiff()) != raster_digest(tiff(name="d.tif", scale=(2.0, 0.0)))
    assert raster_digest(tiff()) != raster_digest(tiff(name="e.tif", units="ft"))


@pytest.mark.parametrize(
    "source",
    [
        "/vsicurl/URL",
        "/vsicurl_streaming/URL",
        "/vsicurl?url=URL",
        "URL",
        "/vsisubfile/0_99,/vsicurl/URL",
    ],
)
def test_a_raster_fetches_nothing_over_the_network(tiff, tmp_path, source):
    tiff()
    requests = []

    class RequestLog(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *arguments):
            super().__init__(*arguments, directory=tmp_path)

        def log_message(self, *words):
            requests.append(words)

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), RequestLog) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_address[1]}/dem.tif"
        over = vrt(tmp_path / "over.vrt", source.replace("URL", url))
        for read in (read_raster_terrain, raster_digest):
            with pytest.raises(SceneError, match=r"over\.vrt: is no raster.*over the network"):
                read(over)
        server.shutdown()
    assert not requests


def test_a_raster_over_one_that_is_lost_is_refused_every_time(tmp_path, tiff):
    over = vrt(tmp_path / "over.vrt", vrt(tmp_path / "within.vrt", tiff()))
    assert read_raster_terrain(over).heights.max() == 19
    tiff().unlink()
    for read in (read_raster_terrain, raster_digest, read_raster_terrain):
        with pytest.raises(SceneError, match=r"dem\.tif: does not exist"):
            read(over)


def test_what_is_no_plain_file_is_refused_unread(tmp_path):
    os.mkfifo(tmp_path / "dem.tif")
    for read in (read_raster_terrain, raster_digest):
        with pytest.raises(SceneError, match="pipe or a device; name a plain file"):
            read(tmp_path / "dem.tif")
        with pytest.raises(SceneError, match="no file of this machine; fetch it"):
            read("/vsicurl/http://127.0.0.1:9/dem.tif")


GRID = np.arange(12.0).reshape(3, 4)
STEPS = {"spacing": (2.0, -2.0)}


def saved(path, image):
    Image.fromarray(image).save(path)
    return path


def test_an_array_is_read_with_its_holes_steps_and_origin(tmp_path):
    heights = GRID.copy()
    heights[1, 1], heights[2, 2] = np.nan, -1e4
    np.save(tmp_path / "z.npy", heights)
    ground = read_numpy_terrain(tmp_path / "z.npy", no_data=-1e4, **STEPS)
    expected = np.where(np.isin(GRID, [5.0, 10.0]), np.nan, GRID)
    np.testing.assert_array_equal(ground.heights, expected)
    assert ground.spacing == (2.0, -2.0)


def test_the_grid_of_an_archive_is_found_or_named(tmp_path):
    path = tmp_path / "z.npz"
    np.savez(path, elevation=GRID, dx=np.array(3.0))
    np.testing.assert_array_equal(read_numpy_terrain(path, **STEPS).heights, GRID)
    np.savez(path, elevation=GRID, slope=2 * GRID)
    np.testing.assert_array_equal(read_numpy_terrain(path, name="slope", **STEPS).heights, 2 * GRID)
    with pytest.raises(SceneError, match="2 grids; name one of: elevation, slope"):
        read_numpy_terrain(path, **STEPS)
    with pytest.raises(SceneError, match="holds no 'z'"):
        read_numpy_terrain(path, name="z", **STEPS)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.arange(5.0), "two-dimensional"),
        (np.full((3, 3), np.nan), "too few heights"),
        (np.array([["a", "b"], ["c", "d"]]), "numbers"),
        (np.ones((3, 3), complex), "numbers"),
    ],
)
def test_arrays_that_are_no_ground_are_refused(tmp_path, array, message):
    np.save(tmp_path / "z.npy", array)
    with pytest.raises(SceneError, match=message):
        read_numpy_terrain(tmp_path / "z.npy", **STEPS)


def test_a_step_of_nothing_and_a_file_of_objects_are_refused(tmp_path):
    np.save(tmp_path / "z.npy", GRID)
    with pytest.raises(SceneError, match="steps"):
        read_numpy_terrain(tmp_path / "z.npy", spacing=(0.0, 1.0))
    np.save(tmp_path / "objects.npy", np.array([{}, {}], object), allow_pickle=True)
    with pytest.raises(SceneError, match="holds object of shape"):
        read_numpy_terrain(tmp_path / "objects.npy", **STEPS)


@pytest.mark.parametrize(("kind", "top"), [(np.uint8, 255), (np.uint16, 65535)])
def test_grey_levels_become_heights_between_black_and_white(tmp_path, kind, top):
    levels = np.array([[0, top, 0], [top // 5, 0, top]], kind)
    path = saved(tmp_path / "z.png", levels)
    ground = read_image_terrain(path, pixel=2.0, black=-10.0, white=40.0)
    np.testing.assert_allclose(ground.heights, [[-10, 40, -10], [0, -10, 40]])
    # The picture's top is north.
    assert ground.height_at(np.array(0.0), np.array(-2.0)) == pytest.approx(0.0)
    assert ground.height_at(np.array(2.0), np.array(0.0)) == pytest.approx(40.0)


def test_a_grey_picture_in_three_equal_bands_is_grey(tmp_path):
    levels = np.array([[0, 51], [102, 255]], np.uint8)
    path = saved(tmp_path / "z.png", np.stack([levels] * 3, axis=-1))
    ground = read_image_terrain(path, pixel=1.0, white=5.0)
    np.testing.assert_allclose(ground.heights, [[0, 1], [2, 5]])


def test_pictures_that_are_no_heights_are_refused(tmp_path):
    colours = saved(tmp_path / "c.png", np.arange(27, dtype=np.uint8).reshape(3, 3, 3))
    with pytest.raises(SceneError, match="RGB; save it in grey"):
        read_image_terrain(colours, pixel=1.0, white=5.0)
    palette = tmp_path / "p.png"
    Image.fromarray(np.zeros((3, 3), np.uint8)).convert("P").save(palette)
    with pytest.raises(SceneError, match="mode P"):
        read_image_terrain(palette, pixel=1.0, white=5.0)
    nonsense = tmp_path / "n.png"
    nonsense.write_text("no picture")
    with pytest.raises(SceneError, match="no image"):
        read_image_terrain(nonsense, pixel=1.0, white=5.0)
    with pytest.raises(SceneError, match="does not exist"):
        read_image_terrain(tmp_path / "x.png", pixel=1.0, white=5.0)


def test_the_default_terrain_has_the_size_and_heights_of_the_survey():
    """344 x 403 posts of 3 arc seconds, 236 to 1076 m; a minute of latitude is a nautical mile."""
    ground = read_jacksboro_terrain()
    assert ground.heights.shape == (344, 403)
    assert (ground.heights.min(), ground.heights.max()) == (236, 1076)
    assert -ground.spacing[1] == pytest.approx(1852 / 20, rel=2e-3)
    # On a sphere their ratio would be the cosine of the latitude; the flattening adds under 0.7 %.
    ratio = ground.spacing[0] / -ground.spacing[1] / np.cos(np.radians(36.59))
    assert 1 < ratio < 1.007
    west, south, east, north = ground.bounds
    assert (west, south) == pytest.approx((-east, -north))


class Hosts(http.server.BaseHTTPRequestHandler):
    """A host that counts what is asked of it."""

    requested_paths: list[str] = []  # noqa: RUF012

    def do_GET(self):
        self.requested_paths.append(self.path)
        self.send_error(404)

    do_HEAD = do_POST = do_GET

    def log_message(self, *words):
        pass


@pytest.fixture
def host(monkeypatch):
    """Address of a host on this machine, which proxies are told to pass by."""
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.setenv(name, "127.0.0.1,localhost,*")
    Hosts.requested_paths = []
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Hosts) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
    assert not Hosts.requested_paths


WMS = (
    '<GDAL_WMS><Service name="TMS"><ServerUrl>{}/${{z}}/${{x}}/${{y}}.png</ServerUrl></Service>'
    "<DataWindow><UpperLeftX>0</UpperLeftX><UpperLeftY>10</UpperLeftY><LowerRightX>10</LowerRightX>"
    "<LowerRightY>0</LowerRightY><SizeX>512</SizeX><SizeY>512</SizeY><TileLevel>1</TileLevel>"
    "</DataWindow><Projection>EPSG:32617</Projection><BandsCount>1</BandsCount></GDAL_WMS>"
)
STACIT = (
    '{{"type": "FeatureCollection", "stac_version": "1.0.0", "features": [{{"type": "Feature", '
    '"stac_version": "1.0.0", "stac_extensions": ["https://stac-extensions.github.io/projection/'
    'v1.0.0/schema.json"], "properties": {{"proj:epsg": 32617}}, "collection": "c", "assets": '
    '{{"B": {{"href": "{}/dem.tif", "proj:transform": [1,0,0,0,-1,0], "proj:shape": [9,9]}}}}}}]}}'
)


@pytest.mark.parametrize("content", [WMS, STACIT], ids=["wms", "stacit"])
@pytest.mark.parametrize("suffix", [".tif", ".xml", ".json"])
def test_files_that_stand_for_hosts_are_no_rasters(tmp_path, host, content, suffix):
    path = tmp_path / f"dem{suffix}"
    path.write_text(content.format(host))
    for read in (read_raster_terrain, raster_digest):
        with pytest.raises(SceneError, match="is no raster that can be read"):
            read(path)
    over = vrt(tmp_path / "over.vrt", path)
    for read in (read_raster_terrain, raster_digest):
        with pytest.raises(SceneError, match="is no raster that can be read"):
            read(over)


@pytest.mark.parametrize(
    "spell",
    [
        lambda text: text.replace("SourceFilename", "sourcefilename"),
        lambda text: text.replace("SourceFilename", "SOURCEFILENAME"),
        lambda text: text.replace("/vsicurl/", "/vsi&#99;url/"),
        lambda text: text.replace("/vsicurl/", "&#47;vsicurl&#x2f;"),
        lambda text: text.replace("/vsicurl/", "<![CDATA[/vsicurl/]]>"),
        lambda text: text.replace("/vsicurl/", "/vsicurl_streaming/"),
        lambda text: text.replace("/vsicurl/", "/vsizip/vsicurl/"),
        lambda text: text.replace("SimpleSource", "ComplexSource"),
        lambda text: f"<!-- a comment -->\n{text}",
        lambda text: '<!DOCTYPE x [<!ENTITY v "/vsicurl/">]>' + text.replace("/vsicurl/", "&v;"),
    ],
)
def test_a_virtual_raster_is_read_as_xml_and_its_sources_are_files_here(tmp_path, host, spell):
    over = vrt(tmp_path / "over.vrt", f"/vsicurl/{host}/dem.tif")
    over.write_text(spell(over.read_text()))
    for read in (read_raster_terrain, raster_digest):
        with pytest.raises(SceneError, match=r"over\.vrt: is no raster that can be read"):
            read(over)


def test_proxies_that_the_user_exempts_are_as_they_were_afterwards(tiff, monkeypatch):
    monkeypatch.setenv("NO_PROXY", "example.org")
    read_raster_terrain(tiff())
    assert os.environ["NO_PROXY"] == "example.org"


def test_a_virtual_raster_over_itself_or_a_pipe_is_refused(tmp_path):
    over = vrt(tmp_path / "over.vrt", tmp_path / "over.vrt")
    with pytest.raises(SceneError, match="virtual raster over itself"):
        read_raster_terrain(over)
    os.mkfifo(tmp_path / "pipe.tif")
    with pytest.raises(SceneError, match="pipe or a device"):
        read_raster_terrain(vrt(tmp_path / "b.vrt", tmp_path / "pipe.tif"))


@pytest.mark.parametrize("sidecar", ["dem.tfw", "dem.prj", "dem.tif.aux.xml", "dem.tif.ovr"])
def test_a_pipe_next_to_a_raster_is_not_opened(tiff, tmp_path, sidecar):
    path = tiff(crs=None, transform=None)
    os.mkfifo(tmp_path / sidecar)
    for read in (read_raster_terrain, raster_digest):
        with pytest.raises(SceneError, match="which is a pipe or a device"):
            read(path)


def test_a_sparse_raster_is_refused_by_its_size(tmp_path):
    path = tmp_path / "sparse.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=400_000, height=400_000, count=1, dtype="float32",
        crs=UTM, transform=SOUTHWARDS, sparse_ok=True, tiled=True, bigtiff=True,
        blockxsize=4096, blockysize=4096,
    ):  # fmt: skip
        pass
    with pytest.raises(SceneError, match=r"declares 400,000 x 400,000 heights.*gdal_translate"):
        raster_digest(path)
    with pytest.raises(SceneError, match=r"400,000 x 400,000 heights, more than.*give a window"):
        read_raster_terrain(path)


def test_grids_larger_than_the_memory_are_refused_before_they_are_read(tiff, tmp_path, monkeypatch):
    monkeypatch.setattr("psutil.virtual_memory", lambda: type("M", (), {"available": 1000}))
    np.save(tmp_path / "z.npy", GRID)
    image = saved(tmp_path / "z.png", np.zeros((5, 5), np.uint8))
    for read in (
        lambda: read_raster_terrain(tiff()),
        lambda: read_numpy_terrain(tmp_path / "z.npy", **STEPS),
        lambda: read_image_terrain(image, pixel=1.0, white=1.0),
    ):
        with pytest.raises(SceneError, match=r"GB of memory, of which.*or coarsen it"):
            read()


def header(shape, kind="<f8"):
    """Header of an array in NumPy's format, without the array."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": kind, "fortran_order": False, "shape": shape}
    )
    return file.getvalue()


def test_arrays_are_refused_by_their_headers(tmp_path):
    npy, npz = tmp_path / "z.npy", tmp_path / "z.npz"
    for shape, message in (((10**6, 10**6), "more than 5e"), ((3000, 3000), "bytes are too few")):
        npy.write_bytes(header(shape) + bytes(100))
        with pytest.raises(SceneError, match=message):
            read_numpy_terrain(npy, **STEPS)
        with zipfile.ZipFile(npz, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("z.npy", header(shape) + bytes(100))
        with pytest.raises(SceneError, match=message):
            read_numpy_terrain(npz, **STEPS)


def test_only_the_heights_of_an_archive_are_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "z.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("z.npy", "w") as file:
            np.lib.format.write_array(file, GRID)
        archive.writestr("bomb.npy", header((10**12,), "<u1") + bytes(10**6))
        archive.writestr("notes.txt", "of any kind")
    np.testing.assert_array_equal(read_numpy_terrain(tmp_path / "z.npz", **STEPS).heights, GRID)


def test_pictures_are_refused_by_their_headers_and_formats(tmp_path, monkeypatch):
    image = saved(tmp_path / "z.png", np.zeros((50, 50), np.uint8))
    monkeypatch.setattr("sweep.scenes.rasters.GRID_CELLS_MAX", 100)
    with pytest.raises(SceneError, match="50 x 50 heights, more than"):
        read_image_terrain(image, pixel=1.0, white=1.0)
    (tmp_path / "z.eps").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    with pytest.raises(SceneError, match="is no image"):
        read_image_terrain(tmp_path / "z.eps", pixel=1.0, white=1.0)


def test_archives_that_can_not_be_unpacked_are_refused(tmp_path):
    np.savez(tmp_path / "z.npz", z=GRID)
    content = bytearray((tmp_path / "z.npz").read_bytes())
    for offset in (6, content.rindex(b"PK\x01\x02") + 8):
        content[offset] |= 1  # encrypted
    (tmp_path / "z.npz").write_bytes(content)
    with pytest.raises(SceneError, match="no NumPy file"):
        read_numpy_terrain(tmp_path / "z.npz", **STEPS)
    (tmp_path / "z.npy").write_bytes(header((3, 3))[:40])
    with pytest.raises(SceneError, match="no NumPy file"):
        read_numpy_terrain(tmp_path / "z.npy", **STEPS)


def test_a_raster_of_one_huge_block_is_refused_before_that_is_unpacked(tiff, monkeypatch):
    path = tiff(np.zeros((512, 512), np.float32), tiled=True, blockxsize=512, blockysize=512)
    monkeypatch.setattr("psutil.virtual_memory", lambda: type("M", (), {"available": 1e6}))
    with pytest.raises(SceneError, match=r"GB of memory.*TILED=YES"):
        raster_digest(path)
