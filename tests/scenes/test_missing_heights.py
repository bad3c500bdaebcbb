"""Heights that are none: values that stand for missing ones, and cliffs that no ground has."""

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio import Affine

from sweep.scenes.height_checks import PLAUSIBLE_HEIGHT_MAX
from sweep.scenes.rasters import read_image_terrain, read_numpy_terrain, read_raster_terrain
from sweep.scenes.scene_files import SceneError

HILLS = 300 + 80 * np.sin(np.arange(30)[:, None] / 5) * np.cos(np.arange(40) / 7)
"""Heights of 220 to 380 m, at steps of 30 m."""


@pytest.fixture
def dem(tmp_path):
    """A GeoTIFF of heights, of which some are replaced by a value."""

    def write(value=None, region=np.s_[:4, :5], heights=HILLS, kind="float32", **profile):
        heights = heights.astype(kind)
        if value is not None:
            heights[region] = value
        path = tmp_path / "dem.tif"
        with rasterio.open(
            path, "w", driver="GTiff", width=40, height=30, count=1, dtype=kind,
            crs="EPSG:32633", transform=Affine(30, 0, 5e5, 0, -30, 5e6), **profile,
        ) as data:  # fmt: skip
            data.write(heights, 1)
        return path

    return write


def test_ground_raises_no_warnings(dem):
    ground = read_raster_terrain(dem())
    assert ground.warnings == () and np.isfinite(ground.heights).all()


@pytest.mark.parametrize(
    ("value", "kind"),
    [(-9999, "float32"), (-32768, "int16"), (-99999, "float64"), (9999, "int16"), (0, "int16"),
     (65535, "uint16"), (-1234.5, "float32"), (1e5, "float32")],
)  # fmt: skip
def test_an_undeclared_value_is_reported_and_can_be_declared_in_the_spec(dem, value, kind):
    path = dem(value, kind=kind)
    ground = read_raster_terrain(path)
    shared, *cliffs = ground.warnings
    assert f"the value {value:g} stands in 20 cells" in shared and "state 'no_data:" in shared
    assert len(cliffs) == (value != 0) and all(
        "neighbouring cells" in terrain_warning for terrain_warning in cliffs
    )
    ground = read_raster_terrain(path, no_data=value)
    assert ground.warnings == () and np.isnan(ground.heights).sum() == 20


def test_a_value_that_the_file_declares_needs_no_word(dem):
    ground = read_raster_terrain(dem(-9999, nodata=-9999))
    assert ground.warnings == () and np.isnan(ground.heights).sum() == 20


def test_two_values_are_both_reported(dem):
    heights = HILLS.copy()
    heights[10:12, :6] = -32768
    warnings = read_raster_terrain(dem(-9999, heights=heights)).warnings
    assert (
        len(warnings) == 3
        and "value -32768 stands in 12" in warnings[0]
        and "value -9999" in warnings[1]
    )


@pytest.mark.parametrize("value", [-3.4028234663852886e38, 3.4e38, -1e20, 2 * PLAUSIBLE_HEIGHT_MAX])
def test_heights_that_no_planet_has_are_refused_until_they_are_declared(dem, value):
    path = dem(value)
    with pytest.raises(SceneError, match="at 20 cells, farther than 1e") as refused:
        read_raster_terrain(path)
    no_data = float(refused.value.remedy.split("no_data: ")[1].rstrip("'"))
    assert np.isnan(read_raster_terrain(path, no_data=no_data).heights).sum() == 20
    assert np.isnan(read_raster_terrain(path, no_data=value).heights).sum() == 20


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_no_numbers_are_holes(dem, value):
    ground = read_raster_terrain(dem(value))
    assert np.isnan(ground.heights).sum() == 20 and ground.warnings == ()


def test_missing_heights_that_were_blended_as_the_grid_was_resampled_show_as_cliffs(dem):
    heights = HILLS.copy()
    heights[:, 10:15] = np.linspace(-9000, 200, 5)
    (warning,) = read_raster_terrain(dem(heights=heights)).warnings
    assert "neighbouring cells differ by up to" in warning and "state it as no_data" in warning


def test_buildings_and_steep_ground_are_no_cliffs(dem):
    heights = HILLS.copy()
    heights[5:8, 5:8] += 90  # a tower
    heights[:, 20:] += 550  # a wall as steep as any
    assert read_raster_terrain(dem(heights=heights)).warnings == ()


def test_arrays_and_images_are_looked_at_too(tmp_path):
    heights = HILLS.copy()
    heights[:2] = -9999
    np.save(tmp_path / "z.npy", heights)
    ground = read_numpy_terrain(tmp_path / "z.npy", spacing=(30.0, 30.0))
    assert "the value -9999 stands in 80 cells" in ground.warnings[0]
    assert (
        read_numpy_terrain(tmp_path / "z.npy", spacing=(30.0, 30.0), no_data=-9999).warnings == ()
    )
    levels = (HILLS / 2).astype(np.uint8)
    levels[:2] = 0
    Image.fromarray(levels).save(tmp_path / "z.png")
    ground = read_image_terrain(tmp_path / "z.png", pixel=30.0, white=500.0)
    assert "the value 0 stands in 80 cells" in ground.warnings[0]
