import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from facet_areas import triangle_areas
from hypothesis import given
from hypothesis import strategies as st

from sweep.model.geometry.quaternion import from_axis_angle
from sweep.scenes import terrain as ground_
from sweep.scenes.meshes import Facets, clean_mesh, join_facets
from sweep.scenes.rasters import read_image_terrain, read_raster_terrain
from sweep.scenes.terrain import (
    Terrain,
    draw_fractal_relief,
    draw_hills,
    refine_terrain,
    smooth_terrain,
)

DATA = Path(__file__).parents[3] / "shared" / "data"
GALE = DATA / "gale_crater_hirise_1m.tif"
APOLLO = DATA / "apollo15_nac_2m.png"

FAR = np.array([8_142_406.3, -276_455.7, -4000.0])


def terrain(z, spacing=(2.0, -3.0), origin=(10.0, 20.0, 100.0)):
    return Terrain(np.asarray(z, float), spacing, np.array(origin))


def hilly(rows, columns, seed=1):
    return np.random.default_rng(seed).normal(size=(rows, columns))


def plan_area(vertices, faces):
    return triangle_areas(vertices * [1, 1, 0], faces).sum()


def heightfield(z, *, spacing):
    facets = Terrain(np.asarray(z, float), spacing, np.zeros(3)).to_facets()
    return facets.vertices, facets.faces


def normals(vertices, faces):
    a, b, c = vertices[faces.T]
    return np.cross(b - a, c - a)


@pytest.mark.parametrize("spacing", [(2.0, 3.0), (2.0, -3.0), (-2.0, 3.0), (-2.0, -3.0)])
def test_a_grid_becomes_upward_facets_that_tile_its_plan(spacing):
    vertices, faces = heightfield(hilly(5, 7), spacing=spacing)
    assert (normals(vertices, faces)[:, 2] > 0).all()
    assert len(faces) == 2 * 4 * 6
    assert plan_area(vertices, faces) == pytest.approx(4 * 6 * 6.0, rel=1e-12)


@pytest.mark.parametrize("corner", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_cell_without_one_corner_keeps_the_triangle_of_the_others(corner):
    z = np.zeros((2, 2))
    z[corner] = np.nan
    vertices, faces = heightfield(z, spacing=(1.0, 1.0))
    assert len(faces) == 1 and len(vertices) == 3
    assert normals(vertices, faces)[0, 2] == 1.0
    assert not any((vertices[:, :2] == corner[::-1]).all(axis=1))


@given(st.integers(0, 2**32), st.sampled_from([(2.0, 3.0), (2.0, -3.0), (-1.0, 0.5)]))
def test_the_height_at_a_place_is_that_of_the_facet_over_it(seed, spacing):
    """Against barycentric weights on the triangles themselves, holes included."""
    generator = np.random.default_rng(seed)
    z = generator.normal(size=(4, 5))
    z[generator.random(z.shape) < 0.15] = np.nan
    ground = terrain(z, spacing)
    west, south, east, north = ground.bounds
    x, y = generator.uniform(west, east, 40), generator.uniform(south, north, 40)
    facets = ground.to_facets()
    expected = np.full(40, np.nan)
    for a, b, c in (facets.vertices + facets.origin)[facets.faces]:
        matrix = np.array([[a[0], b[0], c[0]], [a[1], b[1], c[1]], [1, 1, 1]])
        weights = np.linalg.solve(matrix, [x, y, np.ones(40)])
        inside = (weights > 0).all(axis=0)
        expected[inside] = (weights.T @ [a[2], b[2], c[2]])[inside]
    np.testing.assert_allclose(ground.height_at(x, y), expected, atol=1e-10)


def test_there_is_no_height_next_to_the_grid():
    ground = terrain(np.zeros((3, 3)))
    west, south, east, north = ground.bounds
    outside = ground.height_at(np.array([west - 1, east + 1, west]), np.array([south, north, 99]))
    assert np.isnan(outside).all()
    assert ground.centre == pytest.approx([12, 17, 100])


def test_far_off_ground_has_the_same_facets_to_the_last_bit():
    z = hilly(6, 6)
    near, far = terrain(z).to_facets(), terrain(z, origin=FAR).to_facets()
    np.testing.assert_array_equal(near.vertices, far.vertices)
    np.testing.assert_array_equal(far.origin, FAR)


def test_joined_facets_keep_their_place_digits_and_surfaces():
    shift = np.array([3.0, -4.0, 5.0])
    one = terrain(hilly(3, 3), origin=FAR).to_facets()
    other = terrain(hilly(4, 4), origin=FAR + shift).to_facets()
    joined = join_facets([one, replace(other, surface=other.surface + 1)])
    # Taking the first origin from the second rounds to the spacing of floats at 8e6 m.
    expected = np.concatenate([one.vertices, other.vertices + shift])
    np.testing.assert_allclose(joined.vertices, expected, rtol=0, atol=2 * np.spacing(8.2e6))
    triangles = joined.vertices[joined.faces[len(one.faces) :]]
    np.testing.assert_allclose(triangles, (other.vertices + shift)[other.faces], atol=1e-8)
    assert list(np.unique(joined.surface, return_counts=True)[1]) == [8, 18]


def test_a_placed_object_is_scaled_and_turned_about_its_origin():
    corner = Facets.from_triangles(
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2]], origin=(10, 20, 30)
    )
    placed = corner.transform(rotation=from_axis_angle(2, math.pi / 2), scale=2.0)
    corners = [[10, 22, 30], [8, 20, 30], [10, 20, 32]]
    np.testing.assert_allclose(placed.vertices + placed.origin, corners, atol=1e-12)


def test_facets_become_a_mesh_at_the_same_place():
    facets = terrain(hilly(5, 5), origin=FAR).to_facets()
    mesh, report = replace(facets, surface=facets.surface + 3).to_cleaned_mesh()
    np.testing.assert_allclose(
        np.sort(mesh.vertices + mesh.origin, axis=0),
        np.sort(facets.vertices + facets.origin, axis=0),
        atol=1e-8,
    )
    assert (mesh.surface_index == 3).all() and report.n_faces_before == len(mesh.faces) == 32


def test_refining_keeps_the_given_heights_and_reproduces_cubics():
    rows, columns = np.mgrid[:6, :7].astype(float)
    coarse = terrain(0.1 * rows**3 - 0.2 * columns**2 * rows + columns)
    fine = refine_terrain(coarse, factor=4)
    assert fine.heights.shape == (21, 25) and fine.bounds == pytest.approx(coarse.bounds)
    np.testing.assert_allclose(fine.heights[::4, ::4], coarse.heights, atol=1e-11)
    rows, columns = np.mgrid[:21, :25] / 4
    expected = 0.1 * rows**3 - 0.2 * columns**2 * rows + columns
    np.testing.assert_allclose(fine.heights, expected, atol=1e-11)


def test_refining_keeps_holes_and_no_more_than_their_cells():
    z = hilly(8, 8)
    z[3, 4] = np.nan
    fine = refine_terrain(terrain(z), factor=3).heights
    missing = np.argwhere(np.isnan(fine))
    assert missing.min(axis=0) == pytest.approx([7, 10])  # the first node past row 2, column 3
    assert missing.max(axis=0) == pytest.approx([11, 14])
    np.testing.assert_allclose(fine[::3, ::3][~np.isnan(z)], z[~np.isnan(z)], atol=1e-12)


def test_smoothing_keeps_planes_and_holes_and_spreads_a_step_like_an_error_function():
    from scipy.special import erf

    z = np.where(np.arange(60) < 30, 0.0, 1.0) + np.zeros((40, 60))
    z[5, 5] = np.nan
    smoothed = smooth_terrain(terrain(z, spacing=(0.5, 0.5)), standard_deviation=2.0).heights
    assert np.isnan(smoothed[5, 5]) and np.isnan(smoothed).sum() == 1
    x = (np.arange(60) - 29.5) * 0.5
    expected = 0.5 * (1 + erf(x / (2.0 * math.sqrt(2))))
    np.testing.assert_allclose(smoothed[30], expected, atol=2e-3)  # a kernel of 4 sigma, sampled
    assert smooth_terrain(
        terrain(np.full((9, 9), 7.0)), standard_deviation=3.0
    ).heights == pytest.approx(7.0)


@pytest.mark.parametrize(
    ("z", "spacing"), [(np.zeros((1, 5)), (1, 1)), (np.zeros(5), (1, 1)), (np.eye(3), (0, 1))]
)
def test_a_grid_without_cells_is_refused(z, spacing):
    with pytest.raises(ValueError, match=r"row|steps"):
        heightfield(z, spacing=spacing)


@pytest.mark.skipif(not GALE.exists(), reason="the shared terrain is not here")
def test_real_martian_ground_has_the_heights_and_size_its_description_gives():
    ground = read_raster_terrain(GALE, metres_per_unit=(1.0, 1.0))  # a third of a per cent too wide
    assert "off by up to 0.333 %" in ground.warnings[0] and len(ground.warnings) == 1
    assert ground.heights.shape == (337, 348) and ground.spacing == (1.0, -1.0)
    assert ground.heights.min() == pytest.approx(-4472.67, abs=0.005)
    assert ground.heights.max() == pytest.approx(-4437.88, abs=0.005)
    facets = ground.to_facets()
    assert len(facets.faces) == 2 * 336 * 347
    assert plan_area(facets.vertices, facets.faces) == pytest.approx(336 * 347, rel=1e-9)
    assert facets.origin[0] == 8142406.5 and facets.origin[1] == -276455.5


@pytest.mark.skipif(not APOLLO.exists(), reason="the shared terrain is not here")
def test_real_lunar_ground_in_grey_levels_loses_its_terraces_when_smoothed():
    ground = read_image_terrain(APOLLO, pixel=2.0, white=49.0)
    step = 49.0 / 255
    assert ground.bounds == (0.0, -512.0, 512.0, 0.0)
    smoothed = smooth_terrain(ground, standard_deviation=4.0)
    flat = (np.diff(ground.heights, axis=1) == 0).mean()
    assert flat > 0.2  # a fifth of the steps lie on one grey level
    assert (np.diff(smoothed.heights, axis=1) == 0).mean() < 1e-3
    assert np.abs(smoothed.heights - ground.heights).mean() < step


FIVE_SIGMA = 5.0


def surfaces(number, **parameters):
    return np.stack(
        [draw_fractal_relief(np.random.default_rng(seed), **parameters) for seed in range(number)]
    )


@pytest.mark.parametrize("hurst", [0.2, 0.75, 0.95])
def test_differences_of_height_follow_the_power_law_at_every_distance_and_direction(hurst):
    """From one step to the grid's diagonal: single pairs of nodes over many surfaces.

    Each surface gives one normal number a pair, so that the mean square over n of them has a
    relative standard deviation of sqrt(2/n).
    """
    number, dx, dy = 600, 0.5, 2.0
    z = surfaces(number, shape=(24, 80), spacing=(dx, dy), hurst=hurst, rms_slope=0.2, baseline=3.0)
    ends = [(0, 0, 0, 1), (0, 0, 1, 0), (5, 70, 5, 30), (2, 3, 20, 9), (23, 0, 0, 79)]
    for i, j, k, m in ends:
        length = math.hypot((i - k) * dy, (j - m) * dx)
        expected = (0.2 * 3.0 * (length / 3.0) ** hurst) ** 2
        structure_function = ((z[:, i, j] - z[:, k, m]) ** 2).mean()
        assert structure_function == pytest.approx(expected, rel=FIVE_SIGMA * math.sqrt(2 / number))


@pytest.mark.parametrize("hurst", [0.05, 0.5, 0.74, 0.76, 0.95, 0.99])
@pytest.mark.parametrize("shape", [(40, 40), (16, 200)])
def test_the_embedding_is_a_covariance(hurst, shape):
    """The spectrum on the torus is not negative, so that nothing was cut off the surface."""
    period, _, covariance = ground_._stein_covariance(2 * hurst)
    step = 1 / math.hypot(*shape)
    size = ground_.fft.next_fast_len(math.ceil(period / step), real=True)
    along = np.minimum(np.arange(size), size - np.arange(size)) * step
    power = np.fft.fft2(covariance(np.hypot(along[:, None], along))).real
    assert -power[power < 0].sum() <= 1e-9 * power.sum()


def test_the_same_seed_gives_the_same_ground_and_another_seed_another():
    parameters = {
        "shape": (20, 30), "spacing": (1.0, -1.0), "hurst": 0.7, "rms_slope": 0.1, "baseline": 5.0,
    }  # fmt: skip
    once, second, other = (
        draw_fractal_relief(np.random.default_rng(seed), **parameters) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(once, second)
    assert once.shape == (20, 30) and np.abs(once - other).max() > 0.1


def test_hills_have_the_height_slope_and_correlation_they_were_asked_for():
    """Ensembles of two nodes far apart and of one step, against the Gaussian covariance."""
    number, rms, length = 800, 4.0, 10.0
    z = np.stack(
        [
            draw_hills(
                np.random.default_rng(seed),
                shape=(12, 40),
                spacing=(1.0, 1.0),
                rms_height=rms,
                correlation_length=length,
            )
            for seed in range(number)
        ]
    )
    relative = FIVE_SIGMA * math.sqrt(2 / number)
    assert (z[:, 5, 20] ** 2).mean() == pytest.approx(rms**2, rel=relative)
    slope = (z[:, 5, 21] - z[:, 5, 19]) / 2
    # The difference over two steps of 0.1 correlation lengths falls 1 % short of the slope.
    assert (slope**2).mean() == pytest.approx(2 * rms**2 / length**2, rel=relative + 0.02)
    covariance = (z[:, 5, 20] * z[:, 5, 30]).mean()
    spread = rms**2 * math.sqrt((1 + math.exp(-2)) / number)
    assert covariance == pytest.approx(rms**2 * math.exp(-1), abs=FIVE_SIGMA * spread)


@pytest.mark.parametrize("spacing", [(2.0, 3.0), (2.0, -3.0), (-0.1, 0.3)])
@pytest.mark.parametrize("holes", [0, 1, 40])
def test_a_grid_is_the_mesh_that_cleaning_its_triangles_would_make(spacing, holes):
    random = np.random.default_rng(holes)
    heights = random.standard_normal((13, 17))
    heights.ravel()[random.choice(heights.size, holes, replace=False)] = np.nan
    heights[0, 0] = -0.0
    facets = terrain(heights, spacing, (5e5, 4e6, 0.0)).to_facets()
    mesh, report = facets.to_cleaned_mesh()
    expected, mended = clean_mesh(facets.vertices, facets.faces, facets.surface)
    assert report == mended and report.summary().endswith("nothing to mend")
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    np.testing.assert_array_equal(mesh.faces, expected.faces)
    np.testing.assert_array_equal(mesh.origin, expected.origin + facets.origin)
    assert not np.signbit(mesh.vertices[mesh.vertices == 0]).any()
