"""Boulders: half-ellipsoids of facets, set on the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sweep.model.geometry.facets import Facets
from sweep.model.geometry.frequency import Law, scatter
from sweep.model.geometry.terrain import Terrain


@dataclass(frozen=True)
class Shape:
    """Form of the boulders.

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


ROUND = Shape()


def draw_boulders(
    generator: np.random.Generator,
    law: Law,
    terrain: Terrain,
    *,
    smallest: float,
    largest: float,
    surface: int = 0,
    shape: Shape = ROUND,
    bounds: tuple[float, float, float, float] | None = None,
) -> Facets:
    """Boulders on a terrain, from a size-frequency law.

    The outline of each covers the area of a circle of its diameter exactly. Those that would stand
    in a hole of the terrain are left out.

    Parameters
    ----------
    generator : numpy.random.Generator
        Source of randomness.
    law : Law
        Size-frequency law, such as `frequency.MartianRocks`.
    terrain : Terrain
        Ground that they stand on.
    smallest, largest : float
        Diameters within which the law is drawn [m].
    surface : int
        Surface index of the facets.
    shape : Shape
        Their form.
    bounds : (x least, y least, x largest, y largest) of float, optional
        World rectangle that they stand in [m]; that of the terrain by default.

    Raises
    ------
    ValueError
        As `frequency.scatter`.
    """
    x, y, diameter = scatter(
        generator, law, bounds=bounds or terrain.bounds, smallest=smallest, largest=largest
    )
    elongation = generator.uniform(1.0, shape.elongation, len(x))
    heading = generator.uniform(0.0, math.pi, len(x))
    z = terrain.height_at(x, y)
    stands = np.isfinite(z)
    centre = np.column_stack([x, y, z])[stands] - terrain.origin
    vertices, faces = _set_up(centre, diameter[stands], elongation[stands], heading[stands], shape)
    return Facets.of(vertices, faces, surface=surface, origin=terrain.origin)


def _set_up(
    centre: np.ndarray,
    diameter: np.ndarray,
    elongation: np.ndarray,
    heading: np.ndarray,
    shape: Shape,
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of all boulders from the unit dome."""
    dome, faces = half_ball(shape.subdivisions)
    stretch = np.sqrt(elongation)
    long, across = (
        dome[:, 0] * (diameter / 2 * stretch)[:, None],
        dome[:, 1] * (diameter / 2 / stretch)[:, None],
    )
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
    # The skirt goes as deep as half a diameter: no gap under a boulder on a slope up to 45 deg.
    up = np.where(dome[:, 2] > 0, shape.height_ratio, 0.5) * dome[:, 2] * diameter[:, None]
    vertices = np.stack([c * long - s * across, s * long + c * across, up], axis=-1)
    vertices += centre[:, None, :]
    shift = np.arange(len(centre)) * len(dome)
    return vertices.reshape(-1, 3), (faces + shift[:, None, None]).reshape(-1, 3)


def half_ball(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit dome above z = 0 with a skirt down to z = -1, facing outwards.

    The outline's area is pi exactly, its corners lying a little outside the unit circle.

    Parameters
    ----------
    subdivisions : int
        Times that each facet of the half-octahedron is cut into four.

    Returns
    -------
    vertices : (n, 3) ndarray
        The top at (0, 0, 1).
    faces : (m, 3) ndarray
        Counter-clockwise from outside.
    """
    side = 2**subdivisions
    points: list[np.ndarray] = []
    faces: list[tuple[int, int, int]] = []
    first = {}
    # Rows of the octahedron's four upper faces: row k has 4 k nodes, evenly round at k / side.
    for k in range(side + 1):
        first[k] = len(points)
        angle = 2 * math.pi * np.arange(max(4 * k, 1)) / max(4 * k, 1)
        tilt = math.pi / 2 * k / side
        ring = math.sin(tilt) * np.cos(angle), math.sin(tilt) * np.sin(angle)
        points += list(np.column_stack([*ring, np.full(len(angle), math.cos(tilt))]))
    for k in range(side):
        faces += _ring(first[k], max(4 * k, 1), first[k + 1], k)
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
    return vertices, np.concatenate([np.array(faces, np.int64), *walls])


def _ring(inner: int, inside: int, outer: int, k: int) -> list[tuple[int, int, int]]:
    """Faces between row k (from node `inner`) and row k+1 (from node `outer`)."""
    faces = []
    outside = 4 * (k + 1)
    for quarter in range(4):
        for i in range(k + 1):
            out = quarter * (k + 1) + i
            here = quarter * k + i
            a = inner + here % inside
            faces.append((a, outer + out, outer + (out + 1) % outside))
            if i < k:
                b = inner + (here + 1) % inside
                faces.append((a, outer + (out + 1) % outside, b))
    return faces
