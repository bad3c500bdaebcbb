import math

import numpy as np
import pytest
from facet_areas import areas
from scipy import integrate

from sweep.model.geometry import boulders, frequency
from sweep.model.geometry.terrain import Terrain


def flat(size=200.0, z=0.0, origin=(0.0, 0.0, 0.0)):
    return Terrain(np.full((2, 2), z), (size, size), np.array(origin))


def field(law, ground, seed=1, shape=boulders.ROUND, smallest=0.2, largest=5.0):
    facets = boulders.draw_boulders(
        np.random.default_rng(seed), law, ground, smallest=smallest, largest=largest, shape=shape
    )
    each = len(boulders.half_ball(shape.subdivisions)[0])
    return facets, facets.vertices.reshape(-1, each, 3)


def test_numbers_of_rocks_are_the_integral_of_their_area_law():
    """Each rock covers pi D^2/4, so that dN = dF / (pi D^2/4): by quadrature."""
    law = frequency.MartianRocks(cover=0.1)
    for diameter in (0.01, 0.3, 2.0, 6.0):
        number, error = integrate.quad(
            lambda d: law.decay * law.area_fraction(d) * 4 / (math.pi * d**2), diameter, np.inf,
            epsabs=0, epsrel=1e-10,
        )  # fmt: skip
        assert law.cumulative(diameter) == pytest.approx(number, rel=1e-8, abs=2 * error)


@pytest.mark.parametrize("cover", [0.02, 0.1, 0.4])
def test_diameters_invert_the_cumulative_numbers(cover):
    law = frequency.MartianRocks(cover=cover)
    diameter = np.geomspace(1e-3, 30 / law.decay, 200)
    np.testing.assert_allclose(law.diameter(law.cumulative(diameter)), diameter, rtol=1e-9)


def test_a_tenth_of_cover_has_the_published_decay():
    assert frequency.MartianRocks(cover=0.1).decay == pytest.approx(3.31)


@pytest.mark.parametrize("smallest", [0.2, 0.5, 1.0])
def test_counts_and_cover_of_a_field_follow_the_law(smallest):
    """Poisson numbers, and the area of a compound Poisson sum, within 5 sigma."""
    law, side = frequency.MartianRocks(cover=0.1), 200.0
    _, vertices = field(law, flat(side))
    # Each outline has the area of a circle of its diameter: the shoelace formula gives it back.
    x, y = (vertices[:, -16:, axis] for axis in (0, 1))
    area = 0.5 * (x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(axis=1)
    diameter = 2 * np.sqrt(area / math.pi)
    expected = side**2 * (law.cumulative(smallest) - law.cumulative(5.0))
    assert abs((diameter >= smallest).sum() - expected) < 5 * math.sqrt(expected)
    cover = side**2 * (law.area_fraction(smallest) - law.area_fraction(5.0))
    squares, _ = integrate.quad(
        lambda d: law.decay * law.area_fraction(d) * math.pi * d**2 / 4, smallest, 5.0
    )
    assert abs(area[diameter >= smallest].sum() - cover) < 5 * math.sqrt(side**2 * squares)


def test_the_dome_faces_outwards_and_fills_half_a_ball():
    vertices, faces = boulders.half_ball(4)
    dome = faces[vertices[faces][:, :, 2].min(axis=1) >= 0]
    a, b, c = vertices[dome.T]
    # With the origin as apex, each face spans a positive volume; the sum nears 2 pi / 3.
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    assert (volumes > 0).all()
    assert volumes.sum() == pytest.approx(2 * math.pi / 3, rel=0.01)
    assert vertices[:, 2].max() == 1.0 and vertices[:, 2].min() == -1.0
    skirt = faces[vertices[faces][:, :, 2].min(axis=1) < 0]
    a, b, c = vertices[skirt.T]
    outwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), (a + b + c) * [1, 1, 0])
    assert (outwards > 0).all()


@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_the_dome_is_closed_but_for_the_bottom_of_its_skirt(level):
    vertices, faces = boulders.half_ball(level)
    assert len(faces) == 4 ** (level + 1) + 8 * 2**level
    edges: dict[tuple[int, int], int] = {}
    for face in faces:
        for pair in zip(face, np.roll(face, -1), strict=True):
            edges[tuple(pair)] = edges.get(tuple(pair), 0) + 1
    assert set(edges.values()) == {1}  # no edge is run twice the same way
    open_ = [pair for pair in edges if pair[::-1] not in edges]
    assert len(open_) == 4 * 2**level
    assert (vertices[np.array(open_).ravel(), 2] == -1).all()


def test_boulders_stand_on_the_ground_as_high_as_their_shape_says():
    origin = (3e6, 4e6, -2000.0)
    columns = np.array([[0, 1], [0, 1]])
    slope = Terrain(100.0 * 0.2 * columns, (100.0, 100.0), np.array(origin))
    shape = boulders.Shape(height_ratio=0.3, elongation=1.0, subdivisions=2)
    facets, vertices = field(frequency.MartianRocks(cover=0.2), slope, shape=shape)
    np.testing.assert_array_equal(facets.origin, origin)
    top = vertices[:, 0]
    ground = slope.height_at(top[:, 0] + 3e6, top[:, 1] + 4e6) - origin[2]
    outline = vertices[:, -16:, :2]
    across = np.linalg.norm(outline - outline.mean(axis=1, keepdims=True), axis=2).mean(axis=1)
    diameter = 2 * across / math.sqrt(math.pi / (8 * math.sin(math.pi / 8)))
    np.testing.assert_allclose(top[:, 2] - ground, 0.3 * diameter, rtol=1e-6)
    assert len(top) > 1000


def test_long_boulders_point_everywhere():
    """Mean resultant of the doubled headings: sqrt(n) of a random walk."""
    shape = boulders.Shape(elongation=2.0)
    _, vertices = field(frequency.MartianRocks(cover=0.1), flat(), shape=shape)
    rim = vertices[:, -16:, :2] - vertices[:, -16:, :2].mean(axis=1, keepdims=True)
    tensor = np.einsum("nij,nik->njk", rim, rim)
    twice = np.arctan2(2 * tensor[:, 0, 1], tensor[:, 0, 0] - tensor[:, 1, 1])
    assert abs(np.exp(1j * twice).sum()) < 5 * math.sqrt(len(twice))


def test_no_boulder_stands_over_a_hole():
    z = np.zeros((21, 21))
    z[:, 10:] = np.nan
    ground = Terrain(z, (2.0, 2.0), np.zeros(3))
    facets, vertices = field(frequency.MartianRocks(cover=0.2), ground)
    assert len(facets.faces) and vertices[:, 0, 0].max() <= 18.0
    assert (areas(facets.vertices, facets.faces) > 0).all()


@pytest.mark.parametrize("wrong", [{"smallest": 0.0}, {"smallest": 6.0}, {"smallest": 1e-4}])
def test_a_range_of_sizes_that_can_not_be_drawn_is_refused(wrong):
    with pytest.raises(ValueError, match=r"needs|too many"):
        field(frequency.MartianRocks(cover=0.1), flat(), **wrong)
