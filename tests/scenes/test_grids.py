import numpy as np
import pytest
from PIL import Image

from sweep.scenes.errors import SceneError
from sweep.scenes.grids import read_array, read_image

HEIGHTS = np.arange(12.0).reshape(3, 4)
STEPS = {"spacing": (2.0, -2.0)}


def saved(path, image):
    Image.fromarray(image).save(path)
    return path


def test_an_array_is_read_with_its_holes_steps_and_origin(tmp_path):
    heights = HEIGHTS.copy()
    heights[1, 1], heights[2, 2] = np.nan, -1e4
    np.save(tmp_path / "z.npy", heights)
    ground = read_array(tmp_path / "z.npy", origin=(1e6, 2e6, 5.0), no_data=-1e4, **STEPS)
    expected = np.where(np.isin(HEIGHTS, [5.0, 10.0]), np.nan, HEIGHTS)
    np.testing.assert_array_equal(ground.heights, expected)
    assert ground.spacing == (2.0, -2.0)
    assert ground.height_at(np.array(1e6), np.array(2e6)) == 5.0


def test_the_grid_of_an_archive_is_found_or_named(tmp_path):
    path = tmp_path / "z.npz"
    np.savez(path, elevation=HEIGHTS, dx=np.array(3.0))
    np.testing.assert_array_equal(read_array(path, **STEPS).heights, HEIGHTS)
    np.savez(path, elevation=HEIGHTS, slope=2 * HEIGHTS)
    np.testing.assert_array_equal(read_array(path, name="slope", **STEPS).heights, 2 * HEIGHTS)
    with pytest.raises(SceneError, match="2 grids; name one of: elevation, slope"):
        read_array(path, **STEPS)
    with pytest.raises(SceneError, match="holds no 'z'"):
        read_array(path, name="z", **STEPS)


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (np.arange(5.0), "two-dimensional"),
        (np.full((3, 3), np.nan), "too few heights"),
        (np.array([["a", "b"], ["c", "d"]]), "numbers"),
        (np.ones((3, 3), complex), "numbers"),
    ],
)
def test_arrays_that_are_no_ground_are_refused(tmp_path, array, said):
    np.save(tmp_path / "z.npy", array)
    with pytest.raises(SceneError, match=said):
        read_array(tmp_path / "z.npy", **STEPS)


def test_a_step_of_nothing_and_a_file_of_objects_are_refused(tmp_path):
    np.save(tmp_path / "z.npy", HEIGHTS)
    with pytest.raises(SceneError, match="steps"):
        read_array(tmp_path / "z.npy", spacing=(0.0, 1.0))
    np.save(tmp_path / "objects.npy", np.array([{}, {}], object), allow_pickle=True)
    with pytest.raises(SceneError, match="no NumPy file"):
        read_array(tmp_path / "objects.npy", **STEPS)


@pytest.mark.parametrize(("kind", "top"), [(np.uint8, 255), (np.uint16, 65535)])
def test_grey_levels_become_heights_between_black_and_white(tmp_path, kind, top):
    levels = np.array([[0, top, 0], [top // 5, 0, top]], kind)
    path = saved(tmp_path / "z.png", levels)
    ground = read_image(path, pixel=2.0, black=-10.0, white=40.0, origin=(100.0, 200.0, 0.0))
    np.testing.assert_allclose(ground.heights, [[-10, 40, -10], [0, -10, 40]])
    # The lower left pixel stands at the origin; the picture's top is north.
    assert ground.height_at(np.array(100.0), np.array(200.0)) == pytest.approx(0.0)
    assert ground.height_at(np.array(102.0), np.array(202.0)) == pytest.approx(40.0)


def test_a_grey_picture_in_three_equal_bands_is_grey(tmp_path):
    levels = np.array([[0, 51], [102, 255]], np.uint8)
    path = saved(tmp_path / "z.png", np.stack([levels] * 3, axis=-1))
    ground = read_image(path, pixel=1.0, white=5.0)
    np.testing.assert_allclose(ground.heights, [[0, 1], [2, 5]])


def test_pictures_that_are_no_heights_are_refused(tmp_path):
    colours = saved(tmp_path / "c.png", np.arange(27, dtype=np.uint8).reshape(3, 3, 3))
    with pytest.raises(SceneError, match="RGB; save it in grey"):
        read_image(colours, pixel=1.0, white=5.0)
    palette = tmp_path / "p.png"
    Image.fromarray(np.zeros((3, 3), np.uint8)).convert("P").save(palette)
    with pytest.raises(SceneError, match="mode P"):
        read_image(palette, pixel=1.0, white=5.0)
    nonsense = tmp_path / "n.png"
    nonsense.write_text("no picture")
    with pytest.raises(SceneError, match="no image"):
        read_image(nonsense, pixel=1.0, white=5.0)
    with pytest.raises(SceneError, match="positive size"):
        read_image(colours, pixel=0.0, white=5.0)
    with pytest.raises(SceneError, match="does not exist"):
        read_image(tmp_path / "x.png", pixel=1.0, white=5.0)
