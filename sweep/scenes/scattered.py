"""Craters, boulders and trees: how many lie on an area, and what they look like."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import exp1

from sweep.scenes.meshes import Facets, join
from sweep.scenes.terrain import Bounds, Terrain


@dataclass(frozen=True)
class PowerLaws:
    """The least of several power laws ``N(>D) = coefficient * D**-exponent`` [1/m^2, D in m]."""

    laws: tuple[tuple[float, float], ...]

    def cumulative(self, diameter: np.ndarray) -> np.ndarray:
        """Return the number per area of this diameter or larger [1/m^2]."""
        d = np.asarray(diameter, float)
        return np.min([c * d**-b for c, b in self.laws], axis=0)

    def diameter(self, number: np.ndarray) -> np.ndarray:
        """Diameter [m] which `number` per area [1/m^2] reach or exceed."""
        n = np.asarray(number, float)
        return np.min([(c / n) ** (1 / b) for c, b in self.laws], axis=0)


TRASK = (10**-1.1, 2.0)
"""Lunar craters in equilibrium: ``N = 10**10.9 D**-2`` per 10^6 km^2, D in metres.

Trask, in Ranger VIII and IX, part II, JPL Technical Report 32-800 (1966), restated per m^2.
"""

PRODUCTION_EXPONENT = 2.8
"""Exponent of young craters of 1 to 100 m, which have not yet worn each other down.

Moore, Boyce and Hahn, The Moon and the Planets 23, 231 (1980): "near 2.8".
"""


def lunar_craters(*, equilibrium_diameter: float = math.inf) -> PowerLaws:
    """Craters in equilibrium up to a diameter [m], and as they were produced beyond it.

    The diameter at which the two laws cross grows with the age of the ground.
    """
    if math.isinf(equilibrium_diameter):
        return PowerLaws((TRASK,))
    coefficient = TRASK[0] * equilibrium_diameter ** (PRODUCTION_EXPONENT - TRASK[1])
    return PowerLaws((TRASK, (coefficient, PRODUCTION_EXPONENT)))


@dataclass(frozen=True)
class MartianRocks:
    """Rocks of the Martian plains, by their cumulative fractional area.

    ``F(D) = k exp(-q D)``, ``q = 1.79 + 0.152/k`` with D in metres (Golombek and Rapp, J.
    Geophys. Res. 102, 4117, 1997); each rock covers ``pi D^2 / 4``, so that the number per area
    is ``N(>D) = (4 k q / pi) (exp(-q D)/D - q E1(q D))``. The cover k is that of rocks of any
    size, 0.02 to 0.2 at the landing sites.
    """

    cover: float

    @property
    def decay(self) -> float:
        """Decay of the area with the diameter, q [1/m]."""
        return 1.79 + 0.152 / self.cover

    def cumulative(self, diameter: np.ndarray) -> np.ndarray:
        """Return the number per area of this diameter or larger [1/m^2]."""
        d = np.asarray(diameter, float)
        q = self.decay
        return np.asarray(4 * self.cover * q / math.pi * (np.exp(-q * d) / d - q * exp1(q * d)))

    def diameter(self, number: np.ndarray) -> np.ndarray:
        """Diameter [m] which `number` per area [1/m^2] reach or exceed."""
        n = np.asarray(number, float)
        scale = 4 * self.cover * self.decay / math.pi
        wanted = np.log(n)
        # N(>D) > scale exp(-q D) / (D (q D + 2)), which puts this start below the root; and log N
        # is convex in D, so that Newton's steps approach the root from there without passing it.
        d = np.minimum(scale / (3 * math.e * n), 1 / self.decay)
        for _ in range(100):
            value = self.cumulative(d)
            step = (np.log(value) - wanted) * value * d**2 / (scale * np.exp(-self.decay * d))
            d = d + step
            if (np.abs(step) <= 1e-13 * d).all():
                break
        return np.asarray(d)


Law = PowerLaws | MartianRocks
"""Numbers per area by diameter, and diameters by number per area."""


def scatter(
    generator: np.random.Generator,
    law: Law,
    *,
    bounds: Bounds,
    smallest: float,
    largest: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Independent places (x, y) and diameters [m] on a rectangle, in falling order of diameter.

    The number is Poisson with the law's mean between the two diameters; places are uniform.
    ValueError for an empty rectangle or range of diameters, or more than 5 million of them.
    """
    west, south, east, north = bounds
    if not (0 < smallest < largest and west < east and south < north):
        raise ValueError("a size-frequency law needs 0 < smallest < largest and an area")
    most, least = law.cumulative(np.array([smallest, largest]))
    mean = (most - least) * (east - west) * (north - south)
    if mean > 5e6:
        raise ValueError(f"{mean:.2g} objects are too many: raise the smallest diameter")
    number = generator.poisson(mean)
    x = generator.uniform(west, east, number)
    y = generator.uniform(south, north, number)
    diameter = law.diameter(generator.uniform(least, most, number))
    order = np.argsort(-diameter, kind="stable")
    return x[order], y[order], diameter[order]


REACH = 4.0
"""Radius, in crater radii, at which the ejecta are cut off: 1/64 of their height at the rim."""


class Craters(NamedTuple):
    """Craters of a piece of ground, (n,) each.

    World position of the centres, diameter from rim crest to rim crest [m], and freshness: depth
    and rim height as a share of a fresh crater's, 0..1.
    """

    x: np.ndarray
    y: np.ndarray
    diameter: np.ndarray
    freshness: np.ndarray


def fresh_depth(diameter: np.ndarray) -> np.ndarray:
    """Depth of a fresh simple crater below its rim crest [m].

    ``0.196 D^1.010`` in km (Pike, in Impact and Explosion Cratering, 489, 1977): lunar craters
    up to 15 km; about a fifth of the diameter.
    """
    return np.asarray(1e3 * 0.196 * (np.asarray(diameter, float) / 1e3) ** 1.010)


def fresh_rim_height(diameter: np.ndarray) -> np.ndarray:
    """Height of a fresh simple crater's rim crest above the ground before it [m].

    ``0.036 D^1.014`` in km (Pike, 1977, as for `fresh_depth`).
    """
    return np.asarray(1e3 * 0.036 * (np.asarray(diameter, float) / 1e3) ** 1.014)


def profile(radius: np.ndarray, *, diameter: np.ndarray, freshness: np.ndarray) -> np.ndarray:
    """Height above the ground before the crater, at a distance from its centre [m].

    A paraboloid from floor to rim crest; outside, ejecta that thin with the third power of the
    distance (McGetchin, Settle and Head, Earth Planet. Sci. Lett. 20, 226, 1973), lowered so that
    they end, without a step, at `REACH` radii. Diameter and freshness are as in `Craters`.
    """
    depth, rim = fresh_depth(diameter), fresh_rim_height(diameter)
    s = 2 * np.asarray(radius, float) / diameter
    bowl = rim - depth * (1 - s**2)
    ejecta = rim * (np.maximum(s, 1.0) ** -3 - REACH**-3) / (1 - REACH**-3)
    return np.asarray(freshness * np.where(s < 1, bowl, np.maximum(ejecta, 0.0)))


def draw_craters(
    generator: np.random.Generator,
    law: Law,
    *,
    bounds: Bounds,
    smallest: float,
    largest: float,
    least_fresh: float = 0.1,
) -> Craters:
    """Craters that reach into a rectangle, largest first; `scatter` has the parameters.

    Ground in equilibrium holds craters of every state from fresh to all but gone. Their
    freshness is drawn evenly: a simplification, as wear by diffusion leaves more of the shallow
    ones.
    """
    margin = REACH * largest / 2
    wider = bounds[0] - margin, bounds[1] - margin, bounds[2] + margin, bounds[3] + margin
    x, y, diameter = scatter(generator, law, bounds=wider, smallest=smallest, largest=largest)
    freshness = generator.uniform(least_fresh, 1.0, len(x))
    reach = REACH * diameter / 2
    west, south, east, north = bounds
    near = (x > west - reach) & (x < east + reach) & (y > south - reach) & (y < north + reach)
    return Craters(x[near], y[near], diameter[near], freshness[near])


def carve(terrain: Terrain, craters: Craters) -> Terrain:
    """Terrain with craters added to it; ValueError where one is under three grid steps across."""
    step = max(abs(d) for d in terrain.spacing)
    if len(craters.x) and craters.diameter.min() < 3 * step:
        raise ValueError(
            f"a crater of {craters.diameter.min():g} m is under three grid steps of {step:g} m; "
            "make the grid finer or the smallest crater larger"
        )
    heights = terrain.heights.copy()
    for x, y, diameter, freshness in zip(*craters, strict=True):
        reach = REACH * diameter / 2
        rows, row_y = _window(y - terrain.origin[1], reach, terrain.spacing[1], heights.shape[0])
        cols, col_x = _window(x - terrain.origin[0], reach, terrain.spacing[0], heights.shape[1])
        radius = np.hypot(row_y[:, None], col_x)
        heights[rows, cols] += profile(radius, diameter=diameter, freshness=freshness)
    return replace(terrain, heights=heights)


def _window(centre: float, reach: float, step: float, number: int) -> tuple[slice, np.ndarray]:
    """Nodes of one axis within reach of a centre, and their distances from it [m]."""
    first, last = sorted(((centre - reach) / step, (centre + reach) / step))
    start = min(max(int(np.ceil(first)), 0), number)
    stop = max(min(int(np.floor(last)) + 1, number), start)
    return slice(start, stop), np.arange(start, stop) * step - centre


def draw_boulders(
    generator: np.random.Generator,
    law: Law,
    terrain: Terrain,
    *,
    smallest: float,
    largest: float,
    bounds: Bounds | None = None,
    height_ratio: float = 0.5,
    elongation: float = 1.5,
    subdivisions: int = 2,
) -> Facets:
    """Boulders on a terrain, from a size-frequency law; `scatter` has the other parameters.

    The outline of each covers the area of a circle of its diameter exactly. Its long axis over
    the short one is drawn evenly from 1 to the elongation. Those that would stand in a hole of
    the terrain are left out.
    """
    x, y, diameter = scatter(
        generator, law, bounds=bounds or terrain.bounds, smallest=smallest, largest=largest
    )
    stretch = generator.uniform(1.0, elongation, len(x))
    heading = generator.uniform(0.0, math.pi, len(x))
    z = terrain.height_at(x, y)
    stands = np.isfinite(z)
    centre = np.column_stack([x, y, z])[stands] - terrain.origin
    diameter, stretch = diameter[stands, None], np.sqrt(stretch[stands, None])
    dome, faces = half_ball(subdivisions)
    long, across = dome[:, 0] * (diameter / 2 * stretch), dome[:, 1] * (diameter / 2 / stretch)
    c, s = np.cos(heading[stands, None]), np.sin(heading[stands, None])
    # The skirt goes as deep as half a diameter: no gap under a boulder on a slope up to 45 deg.
    up = np.where(dome[:, 2] > 0, height_ratio, 0.5) * dome[:, 2] * diameter
    vertices = np.stack([c * long - s * across, s * long + c * across, up], axis=-1)
    vertices += centre[:, None, :]
    shift = np.arange(len(centre)) * len(dome)
    faces = faces + shift[:, None, None]
    return Facets.of(vertices, faces, origin=terrain.origin)


def half_ball(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a unit dome above z = 0 with a skirt down to z = -1: vertices, faces.

    The outline's area is pi exactly. Each subdivision cuts every facet of the half-octahedron
    into four.
    """
    side = 2**subdivisions
    points: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    first = {}
    # Rows of the octahedron's four upper faces: row k has 4 k nodes, evenly round at k / side.
    for k in range(side + 1):
        first[k] = len(points)
        angle = 2 * math.pi * np.arange(max(4 * k, 1)) / max(4 * k, 1)
        tilt = math.pi / 2 * k / side
        ring = math.sin(tilt) * np.cos(angle), math.sin(tilt) * np.sin(angle)
        points += list(np.column_stack([*ring, np.full(len(angle), math.cos(tilt))]))
    for k in range(side):  # between row k and the next
        quarter, i = np.divmod(np.arange(4 * k + 4), k + 1)
        here, out = k * quarter + i, np.arange(4 * k + 4)
        a, b = (first[k] + n % max(4 * k, 1) for n in (here, here + 1))
        c, d = (first[k + 1] + n % (4 * k + 4) for n in (out, out + 1))
        both = np.stack([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)], axis=1)
        faces.append(both[np.stack([i <= k, i < k], axis=1)])
    rim, around = first[side], 4 * side
    vertices = np.array(points)
    vertices[rim:, 2] = 0.0
    skirt = vertices[rim:] - [0.0, 0.0, 1.0]
    nodes = np.arange(around)
    a, b = rim + nodes, rim + (nodes + 1) % around
    lower_a, lower_b = a + around, b + around
    walls = [np.column_stack([lower_a, lower_b, b]), np.column_stack([lower_a, b, a])]
    vertices = np.concatenate([vertices, skirt])
    polygon = around / 2 * math.sin(2 * math.pi / around)
    vertices[:, :2] *= math.sqrt(math.pi / polygon)
    return vertices, np.concatenate([*faces, *walls])


@dataclass(frozen=True)
class Tree:
    """Mean measures of the trees of a clump.

    Leaves lie at random, with the spherical distribution of leaf angles: every direction of a
    leaf's normal is as likely as any other. So the probability of a gap along a ray is Beer's law,
    ``exp(-G * density * path)`` with ``G = 1/2``. Sources: de Wit, Photosynthesis of Leaf Canopies
    (1965); Ross, The Radiation Regime and Architecture of Plant Stands (1981).
    """

    height: float = 12.0  # from the ground to the top of the crown [m]
    crown_diameter: float = 7.0  # [m]
    crown_base: float = 3.0  # height of the crown's lower end [m]
    trunk_diameter: float = 0.4  # at the ground [m]; a third of it at the top
    leaf_length: float = 0.30  # diagonals of a leaf, which is a rhombus [m]
    leaf_width: float = 0.20
    leaf_area_index: float = 2.0  # one-sided leaf area over that of the crown's outline
    variation: float = 0.25  # sizes of trees are drawn evenly within this share of the mean

    def __post_init__(self) -> None:
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
    """Plant a clump of trees on a terrain, their trunks at least half a crown apart.

    ValueError where they find no room within the radius [m], or no ground.
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
    """Return unit vectors, evenly over the sphere, (number, 3)."""
    vectors = generator.standard_normal((number, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
