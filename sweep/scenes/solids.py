"""Simple solids, as facets about their middle."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from sweep.scenes.facets import Facets


def sphere(*, radius: float, subdivisions: int) -> Facets:
    """An icosahedron, refined; its corners lie on the sphere and its faces within.

    Parameters
    ----------
    radius : float
        Radius of the sphere [m], > 0.
    subdivisions : int
        Times that every face is cut in four: n of them make 20 * 4^n faces, which lie within
        ``0.3 radius / 4^n`` of the sphere.
    """
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Facets.of(np.asarray(ball.vertices), np.asarray(ball.faces))


def box(*, size: Sequence[float]) -> Facets:
    """A box of 12 facets, facing outwards.

    Parameters
    ----------
    size : (3,) sequence of float
        Lengths along x, y and z [m], > 0.
    """
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * size
    faces = []
    for axis, side in itertools.product(range(3), (0, 1)):
        far, near = 4 >> ((axis + 1) % 3), 4 >> ((axis + 2) % 3)
        first = (4 >> axis) * side
        a, b, c, d = first, first + far, first + far + near, first + near
        faces += [(a, b, c), (a, c, d)] if side else [(a, c, b), (a, d, c)]
    return Facets.of(corners, np.array(faces))
