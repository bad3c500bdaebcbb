import math

import numpy as np
import pytest
from facet_areas import areas

from sweep.scenes import trees
from sweep.scenes.terrain import Terrain

TREE = trees.Tree(variation=0.0)


def ground(slope=0.0, origin=(0.0, 0.0, 0.0)):
    columns = np.arange(3) * 50.0 * slope + np.zeros((3, 1))
    return Terrain(columns, (50.0, 50.0), np.array(origin))


def covered(facets, x, y):
    """Whether vertical lines through (x, y) meet a triangle, by the signs of three areas."""
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
    leaves = trees.crown(np.random.default_rng(1), TREE)
    outline = math.pi * TREE.crown_diameter**2 / 4
    leaf_area = areas(leaves.vertices, leaves.faces).sum()
    assert leaf_area == pytest.approx(TREE.leaf_area_index * outline, rel=1e-3)  # whole leaves
    assert len(leaves.faces) == 2 * TREE.leaves


def test_leaves_face_every_way():
    """The mean projection of a unit leaf area is 1/2 along every axis (G of a sphere)."""
    leaves = trees.crown(np.random.default_rng(2), TREE)
    a, b, c = leaves.vertices[leaves.faces[::2].T]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # |cos| is uniform on 0..1: standard deviation 1/sqrt(12).
    spread = 5 / math.sqrt(12 * len(normal))
    np.testing.assert_allclose(np.abs(normal).mean(axis=0), 0.5, atol=spread)


def test_gaps_in_a_crown_follow_beers_law():
    """Vertical rays through the middle third, several trees: exp(-G x leaf area x path)."""
    generator = np.random.default_rng(3)
    tree = trees.Tree(variation=0.0, leaf_length=0.2, leaf_width=0.15)
    a, depth = tree.crown_diameter / 2, tree.height - tree.crown_base
    density = tree.leaves * tree.leaf_area / (4 / 3 * math.pi * a**2 * depth / 2)
    rays, crowns, gaps, expected = 60, 8, 0, 0.0
    for _ in range(crowns):
        leaves = trees.crown(generator, tree)
        r, turn = a / 3 * np.sqrt(generator.random(rays)), 2 * math.pi * generator.random(rays)
        gaps += (~covered(leaves, r * np.cos(turn), r * np.sin(turn))).sum()
        expected += np.exp(-0.5 * density * depth * np.sqrt(1 - (r / a) ** 2)).sum()
    # Independent leaves: the number of gaps is nearly binomial; rays of one tree share leaves only
    # where they are closer than a leaf.
    chance = expected / (rays * crowns)
    assert abs(gaps - expected) < 5 * math.sqrt(rays * crowns * chance * (1 - chance))
    assert 0.1 < chance < 0.5


def test_leaf_centres_fill_the_crowns_ellipsoid_evenly():
    leaves = trees.crown(np.random.default_rng(4), TREE)
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
    trunk = trees.trunk(TREE)
    z = trunk.vertices[:, 2]
    assert z.min() == -0.5 and TREE.crown_base < z.max() < TREE.height
    assert np.hypot(*trunk.vertices[:, :2].T).max() == pytest.approx(TREE.trunk_diameter / 2)
    a, b, c = trunk.vertices[trunk.faces.T]
    outwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), (a + b + c) * [1, 1, 0])
    assert (outwards > 0).all()


def test_a_clump_stands_on_its_hill_apart_and_within_its_radius():
    origin = (5e5, 4e6, 200.0)
    hill = ground(0.2, origin)
    centre = (origin[0] + 50.0, origin[1] + 50.0)
    clump = trees.clump(
        np.random.default_rng(5), hill, centre=centre, radius=15.0, number=9, tree=TREE
    )  # fmt: skip
    np.testing.assert_array_equal(clump.origin, origin)
    trunks = clump.vertices[np.unique(clump.faces[clump.surface == trees.TRUNKS])].reshape(9, -1, 3)
    feet = trunks[:, :8].mean(axis=1)
    feet[:, 2] += 0.5  # the trunk begins below the ground
    apart = np.linalg.norm(feet[:, None, :2] - feet[None, :, :2], axis=2)[~np.eye(9, dtype=bool)]
    assert apart.min() >= TREE.crown_diameter / 2
    assert np.hypot(*(feet[:, :2] - 50.0).T).max() <= 15.0
    np.testing.assert_allclose(feet[:, 2], 0.2 * feet[:, 0], atol=1e-9)
    assert (clump.surface == trees.LEAVES).sum() == 9 * 2 * TREE.leaves


def _clump(seed, **places):
    return trees.clump(np.random.default_rng(seed), ground(), tree=trees.Tree(), **places)


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
        trees.Tree(height=5.0, crown_base=6.0)
