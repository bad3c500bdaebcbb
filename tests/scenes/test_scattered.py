import math

import numpy as np
import pytest
from facet_areas import triangle_areas
from scipy import integrate

from sweep.scenes import scattered_objects
from sweep.scenes.terrain import Terrain


def flat(size=200.0, z=0.0, origin=(0.0, 0.0, 0.0)):
    return Terrain(np.full((2, 2), z), (size, size), np.array(origin))


def field(law, ground, smallest=0.2, largest=5.0, **shape):
    facets = scattered_objects.draw_boulders(
        np.random.default_rng(1), law, ground, smallest=smallest, largest=largest, **shape
    )
    return facets, facets.vertices.reshape(-1, len(scattered_objects.unit_dome(2)[0]), 3)


def area_fraction(law, diameter):
    """Fraction of the ground under rocks of this diameter or larger."""
    return law.area_fraction * np.exp(-law.area_fraction_decay_rate * diameter)


def test_numbers_of_rocks_are_the_integral_of_their_area_law():
    """Each rock covers pi D^2/4, so that dN = dF / (pi D^2/4): by quadrature."""
    law = scattered_objects.MartianRockLaw(area_fraction=0.1)
    for diameter in (0.01, 0.3, 2.0, 6.0):
        number, error = integrate.quad(
            lambda d: law.area_fraction_decay_rate * area_fraction(law, d) * 4 / (math.pi * d**2),
            diameter,
            np.inf,
            epsabs=0,
            epsrel=1e-10,
        )
        assert law.cumulative_number_density(diameter) == pytest.approx(
            number, rel=1e-8, abs=2 * error
        )


@pytest.mark.parametrize("cover", [0.02, 0.1, 0.4])
def test_diameters_invert_the_cumulative_numbers(cover):
    law = scattered_objects.MartianRockLaw(area_fraction=cover)
    diameter = np.geomspace(1e-3, 30 / law.area_fraction_decay_rate, 200)
    np.testing.assert_allclose(
        law.diameter_at_number_density(law.cumulative_number_density(diameter)), diameter, rtol=1e-9
    )


def test_a_tenth_of_cover_has_the_published_decay():
    assert scattered_objects.MartianRockLaw(
        area_fraction=0.1
    ).area_fraction_decay_rate == pytest.approx(3.31)


@pytest.mark.parametrize("smallest", [0.2, 0.5, 1.0])
def test_counts_and_cover_of_a_field_follow_the_law(smallest):
    """Poisson numbers, and the area of a compound Poisson sum, within 5 sigma."""
    law, side = scattered_objects.MartianRockLaw(area_fraction=0.1), 200.0
    _, vertices = field(law, flat(side))
    # Each outline has the area of a circle of its diameter: the shoelace formula gives it back.
    x, y = (vertices[:, -16:, axis] for axis in (0, 1))
    area = 0.5 * (x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(axis=1)
    diameter = 2 * np.sqrt(area / math.pi)
    expected = side**2 * (
        law.cumulative_number_density(smallest) - law.cumulative_number_density(5.0)
    )
    assert abs((diameter >= smallest).sum() - expected) < 5 * math.sqrt(expected)
    cover = side**2 * (area_fraction(law, smallest) - area_fraction(law, 5.0))
    squares, _ = integrate.quad(
        lambda d: law.area_fraction_decay_rate * area_fraction(law, d) * math.pi * d**2 / 4,
        smallest,
        5.0,
    )
    assert abs(area[diameter >= smallest].sum() - cover) < 5 * math.sqrt(side**2 * squares)


def test_the_dome_faces_outwards_and_fills_half_a_ball():
    vertices, faces = scattered_objects.unit_dome(4)
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
    vertices, faces = scattered_objects.unit_dome(level)
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
    law = scattered_objects.MartianRockLaw(area_fraction=0.2)
    facets, vertices = field(law, slope, height_ratio=0.3, elongation=1.0)
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
    _, vertices = field(scattered_objects.MartianRockLaw(area_fraction=0.1), flat(), elongation=2.0)
    rim = vertices[:, -16:, :2] - vertices[:, -16:, :2].mean(axis=1, keepdims=True)
    tensor = np.einsum("nij,nik->njk", rim, rim)
    twice = np.arctan2(2 * tensor[:, 0, 1], tensor[:, 0, 0] - tensor[:, 1, 1])
    assert abs(np.exp(1j * twice).sum()) < 5 * math.sqrt(len(twice))


def test_no_boulder_stands_over_a_hole():
    z = np.zeros((21, 21))
    z[:, 10:] = np.nan
    ground = Terrain(z, (2.0, 2.0), np.zeros(3))
    facets, vertices = field(scattered_objects.MartianRockLaw(area_fraction=0.2), ground)
    assert len(facets.faces) and vertices[:, 0, 0].max() <= 18.0
    assert (triangle_areas(facets.vertices, facets.faces) > 0).all()


@pytest.mark.parametrize("wrong", [{"smallest": 0.0}, {"smallest": 6.0}, {"smallest": 1e-4}])
def test_a_range_of_sizes_that_can_not_be_drawn_is_refused(wrong):
    with pytest.raises(ValueError, match=r"needs|too many"):
        field(scattered_objects.MartianRockLaw(area_fraction=0.1), flat(), **wrong)


def grid(size=201, step=1.0, origin=(0.0, 0.0, 0.0), dy=1.0):
    return Terrain(np.zeros((size, size)), (step, dy * step), np.array(origin))


def one(x, y, diameter, freshness=1.0):
    return scattered_objects.CraterArrays(
        *(np.array([value]) for value in (x, y, diameter, freshness))
    )


@pytest.mark.parametrize("smallest", [5.0, 20.0, 60.0])
def test_counts_of_craters_follow_trasks_equilibrium(smallest):
    """10^10.9 D^-2 per 10^6 km^2, D in metres, within 5 sigma of a Poisson number."""
    x, y, diameter = scattered_objects.draw_positions_and_diameters(
        np.random.default_rng(1),
        scattered_objects.lunar_crater_law(),
        bounds=(0.0, 0.0, 1000.0, 1000.0),
        smallest=5.0,
        largest=400.0,
    )
    expected = 10**10.9 / 1e6 * (smallest**-2 - 400.0**-2)
    assert abs((diameter >= smallest).sum() - expected) < 5 * math.sqrt(expected)
    assert (np.diff(diameter) <= 0).all()
    assert min(x.min(), y.min()) >= 0 and max(x.max(), y.max()) <= 1000


def test_beyond_equilibrium_counts_fall_as_craters_are_produced():
    law = scattered_objects.lunar_crater_law(equilibrium_diameter=50.0)
    assert law.cumulative_number_density(20.0) == pytest.approx(10**-1.1 / 400)
    assert law.cumulative_number_density(50.0) == pytest.approx(
        scattered_objects.lunar_crater_law().cumulative_number_density(50.0)
    )
    slope = math.log(
        law.cumulative_number_density(400.0) / law.cumulative_number_density(100.0)
    ) / math.log(4)
    assert slope == pytest.approx(-2.8)
    diameter = np.geomspace(1, 1000, 50)
    np.testing.assert_allclose(
        law.diameter_at_number_density(law.cumulative_number_density(diameter)),
        diameter,
        rtol=1e-12,
    )


def test_a_fresh_crater_is_a_fifth_as_deep_as_it_is_wide():
    """Pike's earlier, rounder statement of 1974: depth about 0.2 of the diameter."""
    diameter = np.array([10.0, 100.0, 1000.0, 10_000.0])
    np.testing.assert_allclose(
        scattered_objects.fresh_crater_depth(diameter) / diameter, 0.2, atol=0.015
    )
    assert scattered_objects.fresh_crater_depth(1000.0) == pytest.approx(196.0)
    assert scattered_objects.fresh_crater_rim_height(1000.0) == pytest.approx(36.0)


def test_a_carved_crater_has_its_rim_its_floor_and_its_ejecta_where_they_belong():
    ground = scattered_objects.carve_craters(
        grid(origin=(1e6, 2e6, -50.0)), one(1e6 + 100, 2e6 + 90, 60.0)
    )
    z = ground.heights
    depth, rim = (
        scattered_objects.fresh_crater_depth(60.0),
        scattered_objects.fresh_crater_rim_height(60.0),
    )
    assert np.unravel_index(z.argmin(), z.shape) == (90, 100)  # row along y, column along x
    assert z[90, 100] == pytest.approx(rim - depth)
    for place in ((90, 130), (90, 70), (120, 100), (60, 100)):
        assert z[place] == pytest.approx(rim)
    assert z.max() == pytest.approx(rim)
    assert z[90, 160] == pytest.approx(rim * (2**-3 - 4**-3) / (1 - 4**-3))
    assert z[0, 0] == 0.0 and ground.origin[2] == -50.0


def test_a_crater_lies_where_it_should_on_a_grid_that_runs_southwards():
    z = scattered_objects.carve_craters(
        grid(origin=(0.0, 200.0, 0.0), dy=-1.0), one(50.0, 170.0, 30.0)
    ).heights
    assert np.unravel_index(z.argmin(), z.shape) == (30, 50)


def test_the_volume_dug_is_that_of_a_paraboloid():
    depth, rim = (
        scattered_objects.fresh_crater_depth(60.0),
        scattered_objects.fresh_crater_rim_height(60.0),
    )

    def dug(r):
        return (
            (rim - scattered_objects.crater_profile(np.array(r), diameter=60.0, freshness=1.0))
            * 2
            * math.pi
            * r
        )

    volume, _ = integrate.quad(dug, 0, 30)
    assert volume == pytest.approx(math.pi * 30**2 * depth / 2, rel=1e-9)


def test_craters_add_up_and_worn_ones_are_shallower_in_proportion():
    craters = scattered_objects.CraterArrays(
        *(np.array(v) for v in ([60, 90], [70, 95], [40, 30], [1.0, 0.3]))
    )
    first, second = (
        scattered_objects.CraterArrays(*(v[i : i + 1] for v in craters)) for i in (0, 1)
    )
    expected = (
        scattered_objects.carve_craters(grid(), first).heights
        + scattered_objects.carve_craters(grid(), second).heights
    )
    np.testing.assert_allclose(
        scattered_objects.carve_craters(grid(), craters).heights, expected, atol=1e-12
    )
    fresh = scattered_objects.carve_craters(grid(), one(90, 95, 30)).heights
    np.testing.assert_allclose(
        scattered_objects.carve_craters(grid(), second).heights, 0.3 * fresh, atol=1e-12
    )


def test_no_edge_of_the_ground_is_free_of_craters_from_next_to_it():
    """A crater centred outside throws its ejecta in: the drawn ones reach over every edge."""
    craters = scattered_objects.draw_craters(
        np.random.default_rng(4),
        scattered_objects.lunar_crater_law(),
        bounds=(0.0, 0.0, 300.0, 300.0),
        smallest=5.0,
        largest=100.0,
    )
    assert (craters.x < 0).any() and (craters.x > 300).any()
    assert (craters.y < 0).any() and (craters.y > 300).any()
    assert ((craters.x > -2 * craters.diameter) & (craters.y > -2 * craters.diameter)).all()
    assert craters.freshness.min() >= 0.1 and craters.freshness.max() <= 1
    inside = (craters.x > 0) & (craters.x < 300) & (craters.y > 0) & (craters.y < 300)
    expected = 10**-1.1 * (5.0**-2 - 100.0**-2) * 300**2
    assert abs(inside.sum() - expected) < 5 * math.sqrt(expected)


def test_a_crater_that_the_grid_can_not_hold_is_refused():
    with pytest.raises(ValueError, match="under three grid steps"):
        scattered_objects.carve_craters(grid(), one(50, 50, 2.5))


def test_a_crater_next_to_the_ground_changes_nothing():
    assert not scattered_objects.carve_craters(grid(), one(-500.0, 900.0, 50.0)).heights.any()


TREE = scattered_objects.MeanTreeDimensions(variation=0.0)


def lawn(slope=0.0, origin=(0.0, 0.0, 0.0)):
    columns = np.arange(3) * 50.0 * slope + np.zeros((3, 1))
    return Terrain(columns, (50.0, 50.0), np.array(origin))


def covered(facets, x, y):
    """Mask of vertical lines through (x, y) that meet a triangle, by the signs of three areas."""
    a, b, c = (corner[:, :2] for corner in facets.vertices[facets.faces.T])
    hit = np.zeros(len(x), bool)
    for i in range(len(x)):
        p = np.array([x[i], y[i]])
        sides = [
            (v - u)[:, 0] * (p - u)[:, 1] - (v - u)[:, 1] * (p - u)[:, 0]
            for u, v in ((a, b), (b, c), (c, a))
        ]
        signs = np.sign(sides)
        hit[i] = (np.abs(signs.sum(axis=0)) == 3).any()
    return hit


def test_a_crown_has_the_leaf_area_of_its_index():
    leaves = scattered_objects.draw_crown_leaves(np.random.default_rng(1), TREE)
    outline = math.pi * TREE.crown_diameter**2 / 4
    leaf_area = triangle_areas(leaves.vertices, leaves.faces).sum()
    assert leaf_area == pytest.approx(TREE.leaf_area_index * outline, rel=1e-3)  # whole leaves
    assert len(leaves.faces) == 2 * TREE.n_leaves


def test_leaves_face_every_way():
    """The mean projection of a unit leaf area is 1/2 along every axis (G of a sphere)."""
    leaves = scattered_objects.draw_crown_leaves(np.random.default_rng(2), TREE)
    a, b, c = leaves.vertices[leaves.faces[::2].T]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # |cos| is uniform on 0..1: standard deviation 1/sqrt(12).
    spread = 5 / math.sqrt(12 * len(normal))
    np.testing.assert_allclose(np.abs(normal).mean(axis=0), 0.5, atol=spread)


def test_gaps_in_a_crown_follow_beers_law():
    """Vertical rays through the middle third, several trees: exp(-G x leaf area x path)."""
    generator = np.random.default_rng(3)
    tree = scattered_objects.MeanTreeDimensions(variation=0.0, leaf_length=0.2, leaf_width=0.15)
    a, depth = tree.crown_diameter / 2, tree.height - tree.crown_base
    density = tree.n_leaves * tree.leaf_area / (4 / 3 * math.pi * a**2 * depth / 2)
    rays, crowns, gaps, expected = 60, 8, 0, 0.0
    for _ in range(crowns):
        leaves = scattered_objects.draw_crown_leaves(generator, tree)
        r, turn = a / 3 * np.sqrt(generator.random(rays)), 2 * math.pi * generator.random(rays)
        gaps += (~covered(leaves, r * np.cos(turn), r * np.sin(turn))).sum()
        expected += np.exp(-0.5 * density * depth * np.sqrt(1 - (r / a) ** 2)).sum()
    # Independent leaves: the number of gaps is nearly binomial; rays of one tree share leaves only
    # where they are closer than a leaf.
    chance = expected / (rays * crowns)
    assert abs(gaps - expected) < 5 * math.sqrt(rays * crowns * chance * (1 - chance))
    assert 0.1 < chance < 0.5


def test_leaf_centres_fill_the_crowns_ellipsoid_evenly():
    leaves = scattered_objects.draw_crown_leaves(np.random.default_rng(4), TREE)
    centres = leaves.vertices.reshape(-1, 4, 3).mean(axis=1)
    half = np.array([TREE.crown_diameter, TREE.crown_diameter, TREE.height - TREE.crown_base]) / 2
    ball = (centres - [0, 0, (TREE.height + TREE.crown_base) / 2]) / half
    radius = np.linalg.norm(ball, axis=1)
    assert radius.max() <= 1
    number = len(radius)
    # The radius cubed is uniform, and each axis has the variance 1/5 of a full ball.
    assert (radius**3).mean() == pytest.approx(0.5, abs=5 / math.sqrt(12 * number))
    assert (ball**2).mean(axis=0) == pytest.approx([0.2] * 3, abs=5 * 0.2 / math.sqrt(number))


def test_the_trunk_tapers_faces_outwards_and_reaches_into_crown_and_ground():
    trunk = scattered_objects.trunk_facets(TREE)
    z = trunk.vertices[:, 2]
    assert z.min() == -0.5 and TREE.crown_base < z.max() < TREE.height
    assert np.hypot(*trunk.vertices[:, :2].T).max() == pytest.approx(TREE.trunk_diameter / 2)
    a, b, c = trunk.vertices[trunk.faces.T]
    outwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), (a + b + c) * [1, 1, 0])
    assert (outwards > 0).all()


def test_a_clump_stands_on_its_hill_apart_and_within_its_radius():
    origin = (5e5, 4e6, 200.0)
    hill = lawn(0.2, origin)
    centre = (origin[0] + 50.0, origin[1] + 50.0)
    clump = scattered_objects.draw_tree_clump(
        np.random.default_rng(5), hill, centre=centre, radius=15.0, number=9, tree=TREE
    )  # fmt: skip
    np.testing.assert_array_equal(clump.origin, origin)
    trunks = clump.vertices[
        np.unique(clump.faces[clump.surface == scattered_objects.TRUNK_SURFACE])
    ].reshape(9, -1, 3)
    feet = trunks[:, :8].mean(axis=1)
    feet[:, 2] += 0.5  # the trunk begins below the ground
    distances = np.linalg.norm(feet[:, None, :2] - feet[None, :, :2], axis=2)[
        ~np.eye(9, dtype=bool)
    ]
    assert distances.min() >= TREE.crown_diameter / 2
    assert np.hypot(*(feet[:, :2] - 50.0).T).max() <= 15.0
    np.testing.assert_allclose(feet[:, 2], 0.2 * feet[:, 0], atol=1e-9)
    assert (clump.surface == scattered_objects.LEAF_SURFACE).sum() == 9 * 2 * TREE.n_leaves


def _clump(seed, **places):
    return scattered_objects.draw_tree_clump(
        np.random.default_rng(seed), lawn(), tree=scattered_objects.MeanTreeDimensions(), **places
    )


def test_the_same_seed_plants_the_same_trees():
    grown = [_clump(seed, centre=(50.0, 50.0), radius=10.0, number=3) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(grown[0].vertices, grown[1].vertices)
    assert grown[0].vertices.shape != grown[2].vertices.shape


def test_trees_without_room_or_ground_are_refused():
    with pytest.raises(ValueError, match="do not fit"):
        _clump(1, centre=(50, 50), radius=3.0, number=20)
    with pytest.raises(ValueError, match="beside the ground"):
        _clump(1, centre=(500, 50), radius=3.0, number=1)
    with pytest.raises(ValueError, match="crown"):
        scattered_objects.MeanTreeDimensions(height=5.0, crown_base=6.0)
