import numpy as np
import pytest

from sweep.scenes.defaults import jacksboro


def test_the_default_terrain_has_the_size_and_heights_of_the_survey():
    """344 x 403 posts of 3 arc seconds, 236 to 1076 m; a minute of latitude is a nautical mile."""
    ground = jacksboro()
    assert ground.heights.shape == (344, 403)
    assert (ground.heights.min(), ground.heights.max()) == (236, 1076)
    assert -ground.spacing[1] == pytest.approx(1852 / 20, rel=2e-3)
    # On a sphere their ratio would be the cosine of the latitude; the flattening adds under 0.7 %.
    ratio = ground.spacing[0] / -ground.spacing[1] / np.cos(np.radians(36.59))
    assert 1 < ratio < 1.007
    west, south, east, north = ground.bounds
    assert (west, south) == pytest.approx((-east, -north))


def test_a_piece_is_cut_from_the_middle_and_refined_through_the_survey():
    whole, piece = jacksboro(), jacksboro(size=3000.0, factor=5)
    west, south, east, north = piece.bounds
    assert 3000 <= east - west < 3100 and 3000 <= north - south < 3100
    coarse = piece.heights[::5, ::5]
    rows, columns = coarse.shape
    row, column = (344 - rows) // 2, (403 - columns) // 2
    expected = whole.heights[row : row + rows, column : column + columns]
    np.testing.assert_allclose(coarse, expected, atol=1e-9)
    assert abs(whole.centre[2] - piece.centre[2]) < 30  # at most half a post apart


def test_a_piece_too_small_for_the_survey_is_refused():
    with pytest.raises(ValueError, match="1 km"):
        jacksboro(size=100.0)
