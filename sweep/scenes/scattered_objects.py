"""Craters, boulders and trees: their size-frequency laws, random positions and shapes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import exp1

from sweep.scenes.meshes import Facets, join_facets
from sweep.scenes.terrain import AreaBounds, Terrain


@dataclass(frozen=True)
class MinimumOfPowerLaws:
    """Size-frequency law that is the minimum of power laws ``N(>D) = coefficient * D**-exponent``.

    N(>D) is the number of objects per area with a diameter above D.
    """

    coefficients_and_exponents: tuple[tuple[float, float], ...]
    """Coefficient c and exponent p of each power law N(>D) = c D**-p, for N in 1/m^2 and D in m."""

    def cumulative_number_density(self, diameter: np.ndarray) -> np.ndarray:
        """Return the number per area of objects with a diameter above each of `diameter`.

        Parameters
        ----------
        diameter : ndarray, shape (n,)
            Diameters [m].

        Returns
        -------
        ndarray, shape (n,)
            Numbers per area [1/m^2].
        """
        d = np.asarray(diameter, float)
        return np.min([c * d**-b for c, b in self.coefficients_and_exponents], axis=0)

    def diameter_at_number_density(self, density: np.ndarray) -> np.ndarray:
        """Return the diameters (n,) [m] above which the law gives `density` (n,) objects per m^2.

        This is the inverse of `cumulative_number_density`.
        """
        n = np.asarray(density, float)
        return np.min([(c / n) ** (1 / b) for c, b in self.coefficients_and_exponents], axis=0)


LUNAR_CRATER_EQUILIBRIUM_LAW = (10**-1.1, 2.0)
"""Coefficient c and exponent p of the number c D**-p of old lunar craters above diameter D.

The number is per m^2, and D is in m. Old craters are in equilibrium: each new crater destroys an
old one. Trask gives the number per 10^6 km^2 as ``10**10.9 D**-2``: Ranger VIII and IX, part II,
JPL Technical Report 32-800 (1966).
"""

CRATER_PRODUCTION_EXPONENT = 2.8
"""Exponent p of the number D**-p of young lunar craters above diameter D, for D of 1 to 100 m.

Young craters have not yet worn each other down. Moore, Boyce and Hahn, The Moon and the Planets 23,
231 (1980): "near 2.8".
"""


def lunar_crater_law(*, equilibrium_diameter: float = math.inf) -> MinimumOfPowerLaws:
    """Return the size-frequency law of lunar craters.

    Parameters
    ----------
    equilibrium_diameter : float
        Diameter up to which craters are in equilibrium [m]; larger craters follow the production
        law. It grows with the age of the ground.

    Returns
    -------
    MinimumOfPowerLaws
        The equilibrium law below the diameter, and the production law above it. Both are equal at
        the diameter.
    """
    if math.isinf(equilibrium_diameter):
        return MinimumOfPowerLaws((LUNAR_CRATER_EQUILIBRIUM_LAW,))
    coefficient = LUNAR_CRATER_EQUILIBRIUM_LAW[0] * equilibrium_diameter ** (
        CRATER_PRODUCTION_EXPONENT - LUNAR_CRATER_EQUILIBRIUM_LAW[1]
    )
    return MinimumOfPowerLaws(
        (LUNAR_CRATER_EQUILIBRIUM_LAW, (coefficient, CRATER_PRODUCTION_EXPONENT))
    )


@dataclass(frozen=True)
class MartianRockLaw:
    """Size-frequency law of rocks on the Martian plains, from their cumulative fractional area.

    Notes
    -----
    The fraction of the ground under rocks of at least diameter D (in metres) is
    ``F(D) = k exp(-q D)`` with ``q = 1.79 + 0.152/k`` [1]_. A rock covers ``pi D^2 / 4``, so that
    the number per area is ``N(>D) = (4 k q / pi) (exp(-q D)/D - q E1(q D))``, with the exponential
    integral E1. The fraction k under rocks of any size is 0.02 to 0.2 at the landing sites.

    References
    ----------
    .. [1] Golombek and Rapp, J. Geophys. Res. 102, 4117 (1997).
    """

    area_fraction: float
    """Fraction of the ground that rocks of all sizes together cover."""

    @property
    def area_fraction_decay_rate(self) -> float:
        """Rate q [1/m] at which the fraction of ground under rocks falls with their diameter.

        The fraction under rocks of at least diameter D is proportional to ``exp(-q D)``.
        """
        return 1.79 + 0.152 / self.area_fraction

    def cumulative_number_density(self, diameter: np.ndarray) -> np.ndarray:
        """Return the number per area of rocks with a diameter above each of `diameter`.

        Parameters
        ----------
        diameter : ndarray, shape (n,)
            Diameters [m].

        Returns
        -------
        ndarray, shape (n,)
            Numbers per area [1/m^2].
        """
        d = np.asarray(diameter, float)
        q = self.area_fraction_decay_rate
        return np.asarray(
            4 * self.area_fraction * q / math.pi * (np.exp(-q * d) / d - q * exp1(q * d))
        )

    def diameter_at_number_density(self, density: np.ndarray) -> np.ndarray:
        """Return the diameters (n,) [m] above which the law gives `density` (n,) rocks per m^2.

        This is the inverse of `cumulative_number_density`, by Newton's method on its logarithm.
        """
        n = np.asarray(density, float)
        scale = 4 * self.area_fraction * self.area_fraction_decay_rate / math.pi
        log_density = np.log(n)
        # N(>D) > scale exp(-q D) / (D (q D + 2)) puts this start below the root. log N is convex in
        # D, so that Newton's method approaches the root from below without overshoot.
        d = np.minimum(scale / (3 * math.e * n), 1 / self.area_fraction_decay_rate)
        for _ in range(100):
            value = self.cumulative_number_density(d)
            step = (
                (np.log(value) - log_density)
                * value
                * d**2
                / (scale * np.exp(-self.area_fraction_decay_rate * d))
            )
            d = d + step
            if (np.abs(step) <= 1e-13 * d).all():
                break
        return np.asarray(d)


SizeFrequencyLaw = MinimumOfPowerLaws | MartianRockLaw
"""Size-frequency law: relates a diameter to the number per area of objects above the diameter."""


def draw_positions_and_diameters(
    generator: np.random.Generator,
    law: SizeFrequencyLaw,
    *,
    bounds: AreaBounds,
    smallest: float,
    largest: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw independent positions and diameters of objects on a rectangle.

    The number of objects is Poisson with the mean of the law between the two diameters. Positions
    are uniform.

    Parameters
    ----------
    generator : numpy.random.Generator
        Source of random numbers.
    law : SizeFrequencyLaw
        Number per area by diameter.
    bounds : AreaBounds
        Bounds of the rectangle [m].
    smallest, largest : float
        Smallest and largest diameter [m].

    Returns
    -------
    x, y, diameter : ndarray, shape (n,)
        Positions and diameters [m], in descending order of diameter.

    Raises
    ------
    ValueError
        If the rectangle or the range of diameters is empty, or more than 5 million objects are
        expected.
    """
    west, south, east, north = bounds
    if not (0 < smallest < largest and west < east and south < north):
        raise ValueError("a size-frequency law needs 0 < smallest < largest and an area")
    density_of_smallest, density_of_largest = law.cumulative_number_density(
        np.array([smallest, largest])
    )
    expected_number = (density_of_smallest - density_of_largest) * (east - west) * (north - south)
    if expected_number > 5e6:
        raise ValueError(f"{expected_number:.2g} objects are too many: raise the smallest diameter")
    number = generator.poisson(expected_number)
    x = generator.uniform(west, east, number)
    y = generator.uniform(south, north, number)
    diameter = law.diameter_at_number_density(
        generator.uniform(density_of_largest, density_of_smallest, number)
    )
    order = np.argsort(-diameter, kind="stable")
    return x[order], y[order], diameter[order]


EJECTA_CUTOFF_CRATER_RADII = 4.0
"""Distance from a crater's centre beyond which the crater has no ejecta [crater radii].

At this distance a cubic law would give ejecta 1/64 as high as at the rim.
"""


class CraterArrays(NamedTuple):
    """Positions, diameters and freshness of n craters."""

    x: np.ndarray
    """World x (n,) of the centres [m]."""
    y: np.ndarray
    """World y (n,) of the centres [m]."""
    diameter: np.ndarray
    """Diameter (n,) from rim crest to rim crest [m]."""
    freshness: np.ndarray
    """Depth and rim height (n,), relative to those of a fresh crater of equal diameter, 0..1."""


def fresh_crater_depth(diameter: np.ndarray) -> np.ndarray:
    """Return the depth of a fresh simple crater below its rim crest [m].

    Parameters
    ----------
    diameter : ndarray
        Diameters from rim crest to rim crest [m].

    Notes
    -----
    The depth is ``0.196 D^1.010`` in km, about a fifth of the diameter, for lunar craters up to 15
    km [1]_.

    References
    ----------
    .. [1] Pike, in Impact and Explosion Cratering, 489 (1977).
    """
    return np.asarray(1e3 * 0.196 * (np.asarray(diameter, float) / 1e3) ** 1.010)


def fresh_crater_rim_height(diameter: np.ndarray) -> np.ndarray:
    """Return the height of a fresh simple crater's rim crest above the original ground [m].

    Parameters
    ----------
    diameter : ndarray
        Diameters from rim crest to rim crest [m].

    Notes
    -----
    The height is ``0.036 D^1.014`` in km [1]_.

    References
    ----------
    .. [1] Pike, in Impact and Explosion Cratering, 489 (1977).
    """
    return np.asarray(1e3 * 0.036 * (np.asarray(diameter, float) / 1e3) ** 1.014)


def crater_profile(
    radius: np.ndarray, *, diameter: np.ndarray, freshness: np.ndarray
) -> np.ndarray:
    """Return the height of a crater above the original ground.

    Parameters
    ----------
    radius : ndarray
        Distances from the centre [m].
    diameter : ndarray
        Diameters from rim crest to rim crest [m].
    freshness : ndarray
        Depth and rim height as a fraction of those of a fresh crater, 0..1.

    Returns
    -------
    ndarray
        Heights [m], of the shape that the parameters broadcast to.

    Notes
    -----
    The bowl is a paraboloid from floor to rim crest. Outside, the thickness of ejecta falls with
    the third power of the distance [1]_; it is lowered so that it ends without a step at
    `EJECTA_CUTOFF_CRATER_RADII`.

    References
    ----------
    .. [1] McGetchin, Settle and Head, Earth Planet. Sci. Lett. 20, 226 (1973).
    """
    depth, rim_height = fresh_crater_depth(diameter), fresh_crater_rim_height(diameter)
    relative_radius = 2 * np.asarray(radius, float) / diameter
    bowl = rim_height - depth * (1 - relative_radius**2)
    ejecta = (
        rim_height
        * (np.maximum(relative_radius, 1.0) ** -3 - EJECTA_CUTOFF_CRATER_RADII**-3)
        / (1 - EJECTA_CUTOFF_CRATER_RADII**-3)
    )
    return np.asarray(freshness * np.where(relative_radius < 1, bowl, np.maximum(ejecta, 0.0)))


def draw_craters(
    generator: np.random.Generator,
    law: SizeFrequencyLaw,
    *,
    bounds: AreaBounds,
    smallest: float,
    largest: float,
    least_fresh: float = 0.1,
) -> CraterArrays:
    """Draw the craters that reach into a rectangle.

    Parameters
    ----------
    generator, law, smallest, largest
        As in `draw_positions_and_diameters`.
    bounds : AreaBounds
        Bounds of the rectangle [m]; craters with their centre outside may reach into it.
    least_fresh : float
        Smallest freshness, 0..1.

    Returns
    -------
    CraterArrays
        Craters whose ejecta or bowl reach into the rectangle, in descending order of diameter.

    Notes
    -----
    Ground in equilibrium has craters of every state from fresh to almost gone. Freshness is uniform
    from `least_fresh` to 1: a simplification, because wear by diffusion leaves more shallow
    craters.
    """
    margin = EJECTA_CUTOFF_CRATER_RADII * largest / 2
    wider_bounds = bounds[0] - margin, bounds[1] - margin, bounds[2] + margin, bounds[3] + margin
    x, y, diameter = draw_positions_and_diameters(
        generator, law, bounds=wider_bounds, smallest=smallest, largest=largest
    )
    freshness = generator.uniform(least_fresh, 1.0, len(x))
    reach = EJECTA_CUTOFF_CRATER_RADII * diameter / 2
    west, south, east, north = bounds
    is_near = (x > west - reach) & (x < east + reach) & (y > south - reach) & (y < north + reach)
    return CraterArrays(x[is_near], y[is_near], diameter[is_near], freshness[is_near])


def carve_craters(terrain: Terrain, craters: CraterArrays) -> Terrain:
    """Return a terrain with craters added to its heights.

    Raises
    ------
    ValueError
        If the diameter of a crater is below three grid steps.
    """
    step = max(abs(d) for d in terrain.spacing)
    if len(craters.x) and craters.diameter.min() < 3 * step:
        raise ValueError(
            f"a crater of {craters.diameter.min():g} m is under three grid steps of {step:g} m; "
            "make the grid finer or the smallest crater larger"
        )
    heights = terrain.heights.copy()
    for x, y, diameter, freshness in zip(*craters, strict=True):
        reach = EJECTA_CUTOFF_CRATER_RADII * diameter / 2
        rows, row_y = _nodes_within_reach(
            y - terrain.origin[1], reach, terrain.spacing[1], heights.shape[0]
        )
        cols, col_x = _nodes_within_reach(
            x - terrain.origin[0], reach, terrain.spacing[0], heights.shape[1]
        )
        radius = np.hypot(row_y[:, None], col_x)
        heights[rows, cols] += crater_profile(radius, diameter=diameter, freshness=freshness)
    return replace(terrain, heights=heights)


def _nodes_within_reach(
    centre: float, reach: float, step: float, number: int
) -> tuple[slice, np.ndarray]:
    """Return the nodes of a grid axis that lie within a distance of a centre.

    Parameters
    ----------
    centre : float
        Coordinate of the centre, from the first node [m].
    reach : float
        Largest distance [m].
    step : float
        Grid step [m].
    number : int
        Number of nodes of the axis.

    Returns
    -------
    nodes : slice
        Indices of the nodes.
    distances : ndarray
        Signed distances of the nodes from the centre [m].
    """
    first, last = sorted(((centre - reach) / step, (centre + reach) / step))
    start = min(max(int(np.ceil(first)), 0), number)
    stop = max(min(int(np.floor(last)) + 1, number), start)
    return slice(start, stop), np.arange(start, stop) * step - centre


def draw_boulders(
    generator: np.random.Generator,
    law: SizeFrequencyLaw,
    terrain: Terrain,
    *,
    smallest: float,
    largest: float,
    bounds: AreaBounds | None = None,
    height_ratio: float = 0.5,
    elongation: float = 1.5,
    subdivisions: int = 2,
) -> Facets:
    """Draw boulders on a terrain: half-ellipsoids with random diameter, elongation and heading.

    Seen from above, a boulder has exactly the area of a circle of its diameter. Boulders at a hole
    of the terrain are left out.

    Parameters
    ----------
    generator, law, smallest, largest
        As in `draw_positions_and_diameters`.
    terrain : Terrain
        Ground on which the boulders lie.
    bounds : AreaBounds, optional
        Bounds of the area with boulders [m]; the whole terrain by default.
    height_ratio : float
        Height of a boulder over its diameter.
    elongation : float
        Largest ratio of the long to the short axis; the ratio is uniform from 1 to this value.
    subdivisions : int
        Refinement of the shape, as in `unit_dome`.

    Returns
    -------
    Facets
        Triangles of all boulders.
    """
    x, y, diameter = draw_positions_and_diameters(
        generator, law, bounds=bounds or terrain.bounds, smallest=smallest, largest=largest
    )
    axis_ratio = generator.uniform(1.0, elongation, len(x))
    heading = generator.uniform(0.0, math.pi, len(x))
    z = terrain.height_at(x, y)
    is_on_ground = np.isfinite(z)
    centre = np.column_stack([x, y, z])[is_on_ground] - terrain.origin
    diameter, axis_ratio = diameter[is_on_ground, None], np.sqrt(axis_ratio[is_on_ground, None])
    dome, faces = unit_dome(subdivisions)
    along_long_axis, along_short_axis = (
        dome[:, 0] * (diameter / 2 * axis_ratio),
        dome[:, 1] * (diameter / 2 / axis_ratio),
    )
    c, s = np.cos(heading[is_on_ground, None]), np.sin(heading[is_on_ground, None])
    # The skirt reaches half a diameter below ground: no gap under a boulder on slopes up to 45 deg.
    height_above_ground = np.where(dome[:, 2] > 0, height_ratio, 0.5) * dome[:, 2] * diameter
    vertices = np.stack(
        [
            c * along_long_axis - s * along_short_axis,
            s * along_long_axis + c * along_short_axis,
            height_above_ground,
        ],
        axis=-1,
    )
    vertices += centre[:, None, :]
    index_shift = np.arange(len(centre)) * len(dome)
    faces = faces + index_shift[:, None, None]
    return Facets.from_triangles(vertices, faces, origin=terrain.origin)


def unit_dome(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a triangulated dome of unit radius above z = 0, with a skirt down to z = -1.

    Parameters
    ----------
    subdivisions : int
        Each subdivision cuts every facet of the half-octahedron into four.

    Returns
    -------
    vertices : ndarray, shape (n, 3)
        Vertices. Seen from above, the dome has exactly the area pi.
    faces : ndarray, shape (m, 3)
        Indices of the corners of each triangle.
    """
    n_rows = 2**subdivisions
    points: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    first_of_row = {}
    # Rows of nodes on the four upper faces of the octahedron: row k has 4 k nodes at equal azimuth
    # steps.
    for k in range(n_rows + 1):
        first_of_row[k] = len(points)
        angle = 2 * math.pi * np.arange(max(4 * k, 1)) / max(4 * k, 1)
        tilt = math.pi / 2 * k / n_rows
        ring = math.sin(tilt) * np.cos(angle), math.sin(tilt) * np.sin(angle)
        points += list(np.column_stack([*ring, np.full(len(angle), math.cos(tilt))]))
    for k in range(n_rows):  # triangles between rows k and k + 1
        quarter, i = np.divmod(np.arange(4 * k + 4), k + 1)
        inner_number, outer_number = k * quarter + i, np.arange(4 * k + 4)
        a, b = (first_of_row[k] + n % max(4 * k, 1) for n in (inner_number, inner_number + 1))
        c, d = (first_of_row[k + 1] + n % (4 * k + 4) for n in (outer_number, outer_number + 1))
        cell_faces = np.stack([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)], axis=1)
        faces.append(cell_faces[np.stack([i <= k, i < k], axis=1)])
    first_rim_node, n_rim_nodes = first_of_row[n_rows], 4 * n_rows
    vertices = np.array(points)
    vertices[first_rim_node:, 2] = 0.0
    skirt = vertices[first_rim_node:] - [0.0, 0.0, 1.0]
    nodes = np.arange(n_rim_nodes)
    a, b = first_rim_node + nodes, first_rim_node + (nodes + 1) % n_rim_nodes
    lower_a, lower_b = a + n_rim_nodes, b + n_rim_nodes
    skirt_faces = [np.column_stack([lower_a, lower_b, b]), np.column_stack([lower_a, b, a])]
    vertices = np.concatenate([vertices, skirt])
    polygon_area = n_rim_nodes / 2 * math.sin(2 * math.pi / n_rim_nodes)
    vertices[:, :2] *= math.sqrt(math.pi / polygon_area)
    return vertices, np.concatenate([*faces, *skirt_faces])


@dataclass(frozen=True)
class MeanTreeDimensions:
    """Mean dimensions of the trees of a group.

    Notes
    -----
    Leaves have random positions and the spherical distribution of leaf angles: every direction of a
    leaf's normal is equally likely. The probability of a gap along a ray is therefore Beer's law
    ``exp(-G * density * path)``. The density is that of leaf area per volume. ``G = 1/2`` is the
    mean ratio of a leaf's area, projected along the ray, to its own area [1]_ [2]_.

    References
    ----------
    .. [1] de Wit, Photosynthesis of Leaf Canopies (1965).
    .. [2] Ross, The Radiation Regime and Architecture of Plant Stands (1981).
    """

    height: float = 12.0
    """Height from the ground to the top of the crown [m]."""
    crown_diameter: float = 7.0
    """Diameter of the crown [m]."""
    crown_base: float = 3.0
    """Height of the crown's lower end above the ground [m]."""
    trunk_diameter: float = 0.4
    """Diameter of the trunk at the ground [m]; at the top it is a third of this value."""
    leaf_length: float = 0.30
    """Long diagonal of a leaf, which is a rhombus [m]."""
    leaf_width: float = 0.20
    """Short diagonal of a leaf, which is a rhombus [m]."""
    leaf_area_index: float = 2.0
    """Area of one side of all leaves of a tree, over the area of its crown seen from above."""
    variation: float = 0.25
    """Largest relative deviation of a tree's size from the mean size.

    Sizes are uniform between the mean less this deviation and the mean plus this deviation.
    """

    def __post_init__(self) -> None:
        if not 0 <= self.crown_base < self.height:
            raise ValueError("a tree's crown must begin above the ground and below its height")

    @property
    def leaf_area(self) -> float:
        """Area of one side of a leaf [m^2]."""
        return self.leaf_length * self.leaf_width / 2

    @property
    def n_leaves(self) -> int:
        """Number of leaves of a tree of mean size."""
        crown_area = math.pi * self.crown_diameter**2 / 4
        return round(self.leaf_area_index * crown_area / self.leaf_area)


LEAF_SURFACE, TRUNK_SURFACE = 0, 1
"""Numbers of the surfaces of trees: of leaves and of trunks."""


def draw_tree_clump(
    generator: np.random.Generator,
    terrain: Terrain,
    *,
    centre: tuple[float, float],
    radius: float,
    number: int,
    tree: MeanTreeDimensions,
) -> Facets:
    """Draw a group of trees on a terrain, with trunks at least half a crown diameter apart.

    Parameters
    ----------
    generator : numpy.random.Generator
        Source of random numbers.
    terrain : Terrain
        Ground on which the trees stand.
    centre : (float, float)
        World x and y of the group's centre [m].
    radius : float
        Largest distance of a trunk from the centre [m].
    number : int
        Number of trees, >= 1.
    tree : MeanTreeDimensions
        Mean dimensions of the trees.

    Returns
    -------
    Facets
        Triangles with the surfaces `LEAF_SURFACE` and `TRUNK_SURFACE`.

    Raises
    ------
    ValueError
        If the trees do not fit within the radius, or a tree would stand off the ground.
    """
    parts = []
    for x, y in _draw_trunk_positions(generator, centre, radius, number, tree.crown_diameter / 2):
        z = float(terrain.height_at(np.array(x), np.array(y)))
        if not math.isfinite(z):
            raise ValueError(f"a tree at ({x:.1f}, {y:.1f}) m would stand beside the ground")
        foot_position = np.array([x, y, z]) - terrain.origin
        size_factor = 1 + tree.variation * generator.uniform(-1.0, 1.0)
        for facets in (
            trunk_facets(tree, size_factor),
            draw_crown_leaves(generator, tree, size_factor),
        ):
            parts.append(
                Facets(
                    facets.vertices + foot_position, facets.faces, facets.surface, terrain.origin
                )
            )
    return join_facets(parts)


def _draw_trunk_positions(
    generator: np.random.Generator,
    centre: tuple[float, float],
    radius: float,
    number: int,
    distance_min: float,
) -> list[tuple[float, float]]:
    """Draw random positions (x, y) in a disc, at least `distance_min` apart. Return them as a list.

    Positions too close to earlier ones are drawn again (rejection sampling).

    Parameters
    ----------
    generator : numpy.random.Generator
        Source of random numbers.
    centre : (float, float)
        World x and y of the disc's centre [m].
    radius : float
        Radius of the disc [m].
    number : int
        Number of positions.
    distance_min : float
        Smallest distance between two positions [m].
    """
    positions: list[tuple[float, float]] = []
    for _ in range(1000 * number):
        if len(positions) == number:
            break
        distance, azimuth = radius * math.sqrt(generator.random()), 2 * math.pi * generator.random()
        x, y = centre[0] + distance * math.cos(azimuth), centre[1] + distance * math.sin(azimuth)
        if all(math.hypot(x - px, y - py) >= distance_min for px, py in positions):
            positions.append((x, y))
    if number < 1 or len(positions) < number:
        raise ValueError(
            f"{number} trees {distance_min:g} m apart do not fit in a clump of radius {radius:g} m"
        )
    return positions


def trunk_facets(tree: MeanTreeDimensions, size_factor: float = 1.0) -> Facets:
    """Return the trunk of a tree whose foot is at the origin, as a tapered prism.

    The prism reaches from half a metre below the foot to the middle of the crown. `size_factor` is
    the size of this tree over the mean size.
    """
    sides = 8
    top_height = (tree.crown_base + tree.height) / 2
    angle = 2 * math.pi * np.arange(sides) / sides
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])
    lower = ring * tree.trunk_diameter / 2 - [0.0, 0.0, 0.5]
    upper = ring * tree.trunk_diameter / 6 + [0.0, 0.0, top_height]
    a, b = np.arange(sides), np.roll(np.arange(sides), -1)
    faces = np.concatenate(
        [np.column_stack([a, b, b + sides]), np.column_stack([a, b + sides, a + sides])]
    )
    return Facets.from_triangles(
        size_factor * np.concatenate([lower, upper]), faces, surface=TRUNK_SURFACE
    )


def draw_crown_leaves(
    generator: np.random.Generator, tree: MeanTreeDimensions, size_factor: float = 1.0
) -> Facets:
    """Draw the leaves of a tree whose foot is at the origin.

    The centres of the leaves are uniform in an ellipsoid. A larger tree has more leaves of equal
    size, so that the leaf area index does not change.

    Parameters
    ----------
    generator : numpy.random.Generator
        Source of random numbers.
    tree : MeanTreeDimensions
        Mean dimensions.
    size_factor : float
        Size of this tree over the mean size.
    """
    n_leaves = round(tree.n_leaves * size_factor**2)
    directions = _draw_unit_vectors(generator, n_leaves)
    unit_ball_points = directions * np.cbrt(generator.random(n_leaves))[:, None]
    semi_axes = (
        np.array([tree.crown_diameter, tree.crown_diameter, tree.height - tree.crown_base]) / 2
    )
    middle = np.array([0.0, 0.0, (tree.height + tree.crown_base) / 2])
    centres = size_factor * (unit_ball_points * semi_axes + middle)
    along = _draw_unit_vectors(generator, n_leaves)
    across = np.cross(along, _draw_unit_vectors(generator, n_leaves))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along, across = along * tree.leaf_length / 2, across * tree.leaf_width / 2
    corners = [centres + along, centres + across, centres - along, centres - across]
    leaf_triangles = np.array([[0, 1, 2], [0, 2, 3]])
    faces = 4 * np.arange(n_leaves)[:, None, None] + leaf_triangles
    return Facets.from_triangles(np.stack(corners, axis=1), faces, surface=LEAF_SURFACE)


def _draw_unit_vectors(generator: np.random.Generator, number: int) -> np.ndarray:
    """Draw `number` unit vectors, uniform over the sphere, as an array (number, 3)."""
    vectors = generator.standard_normal((number, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
