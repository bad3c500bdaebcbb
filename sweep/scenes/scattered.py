"""Craters and boulders: how many of a size lie on an area, and what they look like.

Simple impact craters are carved into a grid of heights; boulders are half-ellipsoids of facets,
set on the ground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import exp1

from sweep.scenes.facets import Facets
from sweep.scenes.terrain import Terrain


@dataclass(frozen=True)
class PowerLaws:
    """The least of several power laws ``N(>D) = coefficient * D**-exponent``.

    Parameters
    ----------
    laws : tuple of (coefficient, exponent)
        Coefficient in SI (number per m^2 at 1 m) and exponent, both > 0.
    """

    laws: tuple[tuple[float, float], ...]

    def cumulative(self, diameter: np.ndarray) -> np.ndarray:
        """Number per area of this diameter or larger [1/m^2]."""
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
    """Craters in equilibrium up to a diameter, and as they were produced beyond it.

    Parameters
    ----------
    equilibrium_diameter : float
        Diameter [m] at which the two laws cross, > 0; it grows with the age of the ground.
    """
    if math.isinf(equilibrium_diameter):
        return PowerLaws((TRASK,))
    coefficient = TRASK[0] * equilibrium_diameter ** (PRODUCTION_EXPONENT - TRASK[1])
    return PowerLaws((TRASK, (coefficient, PRODUCTION_EXPONENT)))


@dataclass(frozen=True)
class MartianRocks:
    """Rocks of the Martian plains, by their cumulative fractional area.

    ``F(D) = k exp(-q D)``, ``q = 1.79 + 0.152/k`` with D in metres (Golombek and Rapp, J. Geophys.
    Res. 102, 4117, 1997); each rock covers ``pi D^2 / 4``, so that the number per area is
    ``N(>D) = (4 k q / pi) (exp(-q D)/D - q E1(q D))``.

    Parameters
    ----------
    cover : float
        k: fraction of the ground covered by rocks of any size, 0 < k < 1; 0.02 to 0.2 at the
        landing sites.
    """

    cover: float

    def __post_init__(self) -> None:
        if not 0 < self.cover < 1:
            raise ValueError(f"the rocks' cover must lie between 0 and 1, not {self.cover}")

    @property
    def decay(self) -> float:
        """Decay of the area with the diameter, q [1/m]."""
        return 1.79 + 0.152 / self.cover

    def cumulative(self, diameter: np.ndarray) -> np.ndarray:
        """Number per area of this diameter or larger [1/m^2]."""
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
    bounds: tuple[float, float, float, float],
    smallest: float,
    largest: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Independent places (x, y) and diameters [m] on a rectangle, in falling order of diameter.

    The number is Poisson with the law's mean; places are uniform.

    Parameters
    ----------
    generator, law
        Source of randomness; size-frequency law.
    bounds : (x least, y least, x largest, y largest) of float
        The rectangle [m].
    smallest, largest : float
        Diameters within which the law is drawn [m], 0 < smallest < largest.

    Raises
    ------
    ValueError
        For an empty rectangle or range of diameters, or more than 5 million of them.
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
    bounds: tuple[float, float, float, float],
    smallest: float,
    largest: float,
    least_fresh: float = 0.1,
) -> Craters:
    """Craters that reach into a rectangle, largest first.

    Ground in equilibrium holds craters of every state from fresh to all but gone. Their freshness
    is drawn evenly: a simplification, as wear by diffusion leaves more of the shallow ones.

    Parameters
    ----------
    generator, law
        Source of randomness; size-frequency law, such as `lunar_craters`.
    bounds : (x least, y least, x largest, y largest) of float
        The rectangle [m]; craters centred outside whose ejecta reach in are drawn too.
    smallest, largest : float
        Diameters within which the law is drawn [m].
    least_fresh : float
        Freshness is uniform from here to 1; 1 makes all fresh.

    Raises
    ------
    ValueError
        For a freshness outside 0..1, and as `scatter`.
    """
    if not 0 <= least_fresh <= 1:
        raise ValueError(f"the least freshness must lie within 0 and 1, not {least_fresh}")
    margin = REACH * largest / 2
    wider = bounds[0] - margin, bounds[1] - margin, bounds[2] + margin, bounds[3] + margin
    x, y, diameter = scatter(generator, law, bounds=wider, smallest=smallest, largest=largest)
    freshness = generator.uniform(least_fresh, 1.0, len(x))
    reach = REACH * diameter / 2
    west, south, east, north = bounds
    near = (x > west - reach) & (x < east + reach) & (y > south - reach) & (y < north + reach)
    return Craters(x[near], y[near], diameter[near], freshness[near])


def carve(terrain: Terrain, craters: Craters) -> Terrain:
    """Terrain with craters added to it, one on top of the other.

    Raises
    ------
    ValueError
        Where a crater is under three grid steps across: the grid can not hold it.
    """
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
    return Terrain(heights, terrain.spacing, terrain.origin)


def _window(centre: float, reach: float, step: float, number: int) -> tuple[slice, np.ndarray]:
    """Nodes of one axis within reach of a centre, and their distances from it [m]."""
    first, last = sorted(((centre - reach) / step, (centre + reach) / step))
    start = min(max(int(np.ceil(first)), 0), number)
    stop = max(min(int(np.floor(last)) + 1, number), start)
    return slice(start, stop), np.arange(start, stop) * step - centre


@dataclass(frozen=True)
class Shape:
    """Form of boulders.

    Parameters
    ----------
    height_ratio : float
        Height above the ground over diameter, > 0; 0.5 is a hemisphere.
    elongation : float
        Long over short axis of the outline, drawn evenly from 1 to this; >= 1.
    subdivisions : int
        Refinement of the half-octahedron under the dome, 0..4: a boulder has
        4^(n+1) facets and 8 2^n of a skirt below the ground.
    """

    height_ratio: float = 0.5
    elongation: float = 1.5
    subdivisions: int = 2

    def __post_init__(self) -> None:
        if not (self.height_ratio > 0 and self.elongation >= 1 and 0 <= self.subdivisions <= 4):
            raise ValueError("boulders need a height ratio > 0, an elongation >= 1 and 0..4 levels")


def draw_boulders(
    generator: np.random.Generator,
    law: Law,
    terrain: Terrain,
    *,
    smallest: float,
    largest: float,
    shape: Shape,
    bounds: tuple[float, float, float, float] | None = None,
) -> Facets:
    """Boulders on a terrain, from a size-frequency law.

    The outline of each covers the area of a circle of its diameter exactly. Those that would stand
    in a hole of the terrain are left out.

    Parameters
    ----------
    generator, law
        Source of randomness; size-frequency law, such as `MartianRocks`.
    terrain : Terrain
        Ground that they stand on.
    smallest, largest, bounds
        As of `scatter`; by default within the terrain's bounds.
    shape : Shape
        Their form.

    Raises
    ------
    ValueError
        As `scatter`.
    """
    x, y, diameter = scatter(
        generator, law, bounds=bounds or terrain.bounds, smallest=smallest, largest=largest
    )
    elongation = generator.uniform(1.0, shape.elongation, len(x))
    heading = generator.uniform(0.0, math.pi, len(x))
    z = terrain.height_at(x, y)
    stands = np.isfinite(z)
    centre = np.column_stack([x, y, z])[stands] - terrain.origin
    diameter, stretch = diameter[stands, None], np.sqrt(elongation[stands, None])
    dome, faces = half_ball(shape.subdivisions)
    long, across = dome[:, 0] * (diameter / 2 * stretch), dome[:, 1] * (diameter / 2 / stretch)
    c, s = np.cos(heading[stands, None]), np.sin(heading[stands, None])
    # The skirt goes as deep as half a diameter: no gap under a boulder on a slope up to 45 deg.
    up = np.where(dome[:, 2] > 0, shape.height_ratio, 0.5) * dome[:, 2] * diameter
    vertices = np.stack([c * long - s * across, s * long + c * across, up], axis=-1)
    vertices += centre[:, None, :]
    shift = np.arange(len(centre)) * len(dome)
    faces = faces + shift[:, None, None]
    return Facets.of(vertices, faces, origin=terrain.origin)


def half_ball(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit dome above z = 0 with a skirt down to z = -1, facing outwards.

    The outline's area is pi exactly, its corners lying a little outside the unit circle.

    Parameters
    ----------
    subdivisions : int
        Times that each facet of the half-octahedron is cut into four.

    Returns
    -------
    (n, 3) ndarray, (m, 3) ndarray
        Vertices, the top first, and faces, counter-clockwise from outside.
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
