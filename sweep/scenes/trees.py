"""Broad-leaved trees: a tapered trunk, and leaves as loose facets in an ellipsoid.

Leaves lie at random, with the spherical distribution of leaf angles (every direction of the leaf's
normal is as likely as any other), so that the chance of a gap along a ray is Beer's law,
``exp(-G * density * path)`` with ``G = 1/2``: de Wit, Photosynthesis of Leaf Canopies (1965);
Ross, The Radiation Regime and Architecture of Plant Stands (1981).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sweep.scenes.facets import Facets, join
from sweep.scenes.terrain import Terrain


@dataclass(frozen=True)
class Tree:
    """Mean measures of the trees of a clump.

    Parameters
    ----------
    height : float
        From the ground to the top of the crown [m].
    crown_diameter : float
        Across [m].
    crown_base : float
        Height of the crown's lower end [m], below `height`.
    trunk_diameter : float
        At the ground [m]; a third of it at the top.
    leaf_length, leaf_width : float
        Diagonals of a leaf, which is a rhombus [m].
    leaf_area_index : float
        One-sided leaf area over the area of the crown's outline, >= 0; 2 to 6 in forests.
    variation : float
        Sizes of trees are drawn evenly within this share of the mean, 0 <= . < 1.
    """

    height: float = 12.0
    crown_diameter: float = 7.0
    crown_base: float = 3.0
    trunk_diameter: float = 0.4
    leaf_length: float = 0.30
    leaf_width: float = 0.20
    leaf_area_index: float = 2.0
    variation: float = 0.25

    def __post_init__(self) -> None:
        sizes = (self.crown_diameter, self.trunk_diameter, self.leaf_length, self.leaf_width)
        if not (min(sizes) > 0 and self.leaf_area_index >= 0 and 0 <= self.variation < 1):
            raise ValueError("a tree needs sizes > 0, leaf area >= 0 and 0 <= variation < 1")
        if not 0 <= self.crown_base < self.height:
            raise ValueError("a tree's crown must begin above the ground and below its height")

    @property
    def leaf_area(self) -> float:
        """One-sided area of a leaf [m^2]."""
        return self.leaf_length * self.leaf_width / 2

    @property
    def leaves(self) -> int:
        """Number of leaves of a tree of mean size."""
        crown = math.pi * self.crown_diameter**2 / 4
        return round(self.leaf_area_index * crown / self.leaf_area)


LEAVES, TRUNKS = 0, 1
"""Surface indices."""


def clump(
    generator: np.random.Generator,
    terrain: Terrain,
    *,
    centre: tuple[float, float],
    radius: float,
    number: int,
    tree: Tree,
) -> Facets:
    """A clump of trees on a terrain, their trunks at least half a crown apart.

    Parameters
    ----------
    generator, terrain
        Source of randomness; ground that they grow on.
    centre, radius
        World position (x, y) of the clump's middle, and how far from it trunks stand [m].
    number, tree
        Number of trees, at least 1, and their mean measures.

    Raises
    ------
    ValueError
        Where the trees do not find room, or one would stand where there is no ground.
    """
    parts = []
    for x, y in _places(generator, centre, radius, number, tree.crown_diameter / 2):
        z = float(terrain.height_at(np.array(x), np.array(y)))
        if not math.isfinite(z):
            raise ValueError(f"a tree at ({x:.1f}, {y:.1f}) m would stand beside the ground")
        foot = np.array([x, y, z]) - terrain.origin
        size = 1 + tree.variation * generator.uniform(-1.0, 1.0)
        for facets in (trunk(tree, size), crown(generator, tree, size)):
            parts.append(
                Facets(facets.vertices + foot, facets.faces, facets.surface, terrain.origin)
            )
    return join(parts)


def _places(
    generator: np.random.Generator,
    centre: tuple[float, float],
    radius: float,
    number: int,
    apart: float,
) -> list[tuple[float, float]]:
    """Places in a disc, no two nearer than `apart` [m], by throwing darts."""
    places: list[tuple[float, float]] = []
    for _ in range(1000 * number):
        if len(places) == number:
            break
        far, round_ = radius * math.sqrt(generator.random()), 2 * math.pi * generator.random()
        x, y = centre[0] + far * math.cos(round_), centre[1] + far * math.sin(round_)
        if all(math.hypot(x - px, y - py) >= apart for px, py in places):
            places.append((x, y))
    if number < 1 or len(places) < number:
        raise ValueError(
            f"{number} trees {apart:g} m apart do not fit in a clump of radius {radius:g} m"
        )
    return places


def trunk(tree: Tree, size: float = 1.0) -> Facets:
    """Tapered prism from half a metre below the foot to the middle of the crown."""
    sides = 8
    top = (tree.crown_base + tree.height) / 2
    angle = 2 * math.pi * np.arange(sides) / sides
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])
    lower = ring * tree.trunk_diameter / 2 - [0.0, 0.0, 0.5]
    upper = ring * tree.trunk_diameter / 6 + [0.0, 0.0, top]
    a, b = np.arange(sides), np.roll(np.arange(sides), -1)
    faces = np.concatenate(
        [np.column_stack([a, b, b + sides]), np.column_stack([a, b + sides, a + sides])]
    )
    return Facets.of(size * np.concatenate([lower, upper]), faces, surface=TRUNKS)


def crown(generator: np.random.Generator, tree: Tree, size: float = 1.0) -> Facets:
    """Leaves with their centres spread evenly over an ellipsoid, the tree's foot at the origin.

    A larger tree has more leaves, not larger ones: the leaf area index stays.
    """
    number = round(tree.leaves * size**2)
    axes = _directions(generator, number)
    ball = axes * np.cbrt(generator.random(number))[:, None]
    half = np.array([tree.crown_diameter, tree.crown_diameter, tree.height - tree.crown_base]) / 2
    middle = np.array([0.0, 0.0, (tree.height + tree.crown_base) / 2])
    centres = size * (ball * half + middle)
    along = _directions(generator, number)
    across = np.cross(along, _directions(generator, number))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along, across = along * tree.leaf_length / 2, across * tree.leaf_width / 2
    corners = [centres + along, centres + across, centres - along, centres - across]
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    faces = 4 * np.arange(number)[:, None, None] + halves
    return Facets.of(np.stack(corners, axis=1), faces, surface=LEAVES)


def _directions(generator: np.random.Generator, number: int) -> np.ndarray:
    """Unit vectors, evenly over the sphere, (number, 3)."""
    vectors = generator.standard_normal((number, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
