"""Surfaces, meshes that rays can be cast at, and the planes of their facets.

A micrometre of wavelength at kilometres of range asks for the last bits of float64, and grazing
incidence divides them away. So a facet's normal, the ray's origin relative to a corner and their
products are carried as two float64 each (high + low, Dekker's and Knuth's exact sums and products).
The error that remains is the rounding of the range itself, half a unit in its last place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Surface:
    """Optical properties of one kind of surface."""

    name: str
    reflectance: float
    """Reflectance as its law takes it, one of :data:`sweep.model.ground.LAWS`; 0..1."""
    law: str = "lambert"


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles around an origin of their own, so that far-off coordinates keep their digits.

    A ValueError for shapes that do not fit, no triangle, or a vertex that is not finite or missing.
    """

    vertices: np.ndarray
    """(n, 3) float64 [m], relative to `origin`."""
    faces: np.ndarray
    """(m, 3) int32: vertices of each triangle; either winding, since both sides are seen."""
    surface: np.ndarray
    """(m,) int16: which of the scene's surfaces each triangle belongs to."""
    origin: np.ndarray
    """(3,) float64 [m]: where the vertices' zero lies in the frame of the scene or the body."""

    def __post_init__(self):
        require_shapes(self.vertices, self.faces, self.surface)
        if len(self.faces) == 0:
            raise ValueError("a mesh needs at least one triangle")
        if not np.isfinite(self.vertices).all():
            raise ValueError("a mesh's vertices are finite")
        if np.shape(self.origin) != (3,) or not np.isfinite(self.origin).all():
            raise ValueError("a mesh's origin is three finite coordinates")
        kinds = {"vertices": np.float64, "faces": np.int32, "surface": np.int16}
        for name, kind in (kinds | {"origin": np.float64}).items():
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype=kind))


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """All triangles of several meshes of one frame as one mesh, in the order given."""
    corners = [m.origin + f(m.vertices, axis=0) for m in meshes for f in (np.min, np.max)]
    origin = round_centre(np.array(corners))
    if len(meshes) == 1 and np.array_equal(meshes[0].origin, origin):
        return meshes[0]
    vertices = np.empty((sum(len(m.vertices) for m in meshes), 3))
    faces = np.empty((sum(len(m.faces) for m in meshes), 3), np.int32)
    n_vertices = n_faces = 0
    for m in meshes:  # copies of all, one after the other, would take twice the memory
        part = slice(n_faces, n_faces + len(m.faces))
        np.add(m.faces, n_vertices, out=faces[part])
        part = slice(n_vertices, n_vertices + len(m.vertices))
        np.add(m.vertices, m.origin - origin, out=vertices[part])
        n_vertices, n_faces = n_vertices + len(m.vertices), n_faces + len(m.faces)
    return Mesh(vertices, faces, np.concatenate([m.surface for m in meshes]), origin)


def require_shapes(vertices: np.ndarray, faces: np.ndarray, surface: np.ndarray) -> None:
    """Refuse arrays of a mesh that do not fit each other, and faces without their vertices."""
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices are of shape (n, 3), not {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"faces are integers of shape (m, 3), not {faces.dtype} {faces.shape}")
    if surface.shape != faces.shape[:1]:
        raise ValueError(f"{len(faces)} faces need as many surfaces, not {surface.shape}")
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError(f"a face names a vertex outside 0..{len(vertices) - 1}")


def round_centre(vertices: np.ndarray) -> np.ndarray:
    """Middle of the bounding box, chosen so that subtracting it from any vertex is exact.

    Zero along an axis where zero is no farther off than the mesh is large, since small numbers
    would lose their last digits there. Else rounded to a power of two not below 1/1024 of the
    extent. A coordinate and the centre are then both multiples of the coordinate's last place, and
    their difference is no larger than the coordinate.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent = float((high - low).max())
    if extent == 0.0:
        return np.array(low)
    step = 2.0 ** np.ceil(np.log2(extent / 1024.0))
    middle = np.round((0.5 * low + 0.5 * high) / step) * step
    return np.where(np.abs(middle) > extent, middle, 0.0)


Pair = tuple[np.ndarray, np.ndarray]
"""Numbers as sums of two float64, high and low; of vectors, components along the first axis."""

_HALVES = 2.0**27 + 1
"""Factor that parts a float64 into two of half as many digits."""

_FLAT = 1e-6
"""Sine of the angle to a facet under which its plane may run through it within rounding."""


def exact(values: np.ndarray) -> Pair:
    """Pair of numbers that float64 holds."""
    return values, np.zeros_like(values)


def _two_sum(a: np.ndarray, b: np.ndarray) -> Pair:
    """Sum and what its rounding left."""
    s = a + b
    part = s - a
    return s, (a - (s - part)) + (b - part)


def _quick_two_sum(a: np.ndarray, b: np.ndarray) -> Pair:
    """Sum and what its rounding left, for abs(a) >= abs(b)."""
    s = a + b
    return s, b - (s - a)


def _halves(a: np.ndarray) -> Pair:
    wide = a * _HALVES
    high = wide - (wide - a)
    return high, a - high


def product(a: Pair, b: Pair) -> Pair:
    """Product of two pairs."""
    p = a[0] * b[0]
    (ah, al), (bh, bl) = _halves(a[0]), _halves(b[0])
    rest = ((ah * bh - p) + ah * bl + al * bh) + al * bl
    return _quick_two_sum(p, rest + (a[0] * b[1] + a[1] * b[0]))


def add(a: Pair, b: Pair) -> Pair:
    """Sum of two pairs, accurate also where the high parts cancel."""
    s, e = _two_sum(a[0], b[0])
    t, f = _two_sum(a[1], b[1])
    s, e = _quick_two_sum(s, e + t)
    return _quick_two_sum(s, e + f)


def less(a: Pair, b: Pair) -> Pair:
    """Difference of two pairs."""
    return add(a, (-b[0], -b[1]))


def dot(a: Pair, b: Pair) -> Pair:
    """Scalar product of two vectors; of a vector (3, 1, n) and a matrix (3, 3, n), a vector."""
    x, y, z = zip(*product(a, b), strict=True)
    return add(add(x, y), z)


def _cross(a: Pair, b: Pair) -> Pair:
    """Vector product."""
    (ay, az), (by, bz) = (
        [(v[0][turn], v[1][turn]) for turn in ([1, 2, 0], [2, 0, 1])] for v in (a, b)
    )
    return less(product(ay, bz), product(az, by))


def normals(corners: np.ndarray) -> Pair:
    """Compute normals (3, n) of facets by their winding, twice their areas long.

    `corners` (3, 3, n) are first, second and third corner; their x, y, z.
    """
    a, b, c = (exact(corner) for corner in corners)
    return _cross(less(b, a), less(c, a))


def distances(corners: np.ndarray, normal: Pair, height: Pair, o: Pair, d: Pair) -> Pair:
    """Distances of facets' planes along rays from `o` along `d` (3, n), in lengths of `d`.

    `height` (n,) is the product of the normals with a corner less the origin. A plane seen so
    flatly that it runs through the facet within rounding is met somewhere on the facet: the
    distance stays between those of its corners.
    """
    along = dot(normal, d)
    with np.errstate(all="ignore"):  # parallel to a plane
        high = height[0] / along[0]
        rest, low = less(height, product(exact(high), along))
        high, low = _quick_two_sum(high, (rest + low) / along[0])
    x, y, z = np.abs(normal[0])
    flat = np.flatnonzero(~(np.abs(along[0]) > _FLAT * (x + y + z)))
    if flat.size:
        origin, ray = (o[0][:, flat], o[1][:, flat]), d[0][:, flat]
        length = ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2
        reach = []
        for corner in corners[:, :, flat]:
            x, y, z = less(exact(corner), origin)[0] * ray
            reach.append((x + y + z) / length)
        nearest, farthest = np.min(reach, axis=0), np.max(reach, axis=0)
        outside = ~((high[flat] >= nearest) & (high[flat] <= farthest))
        low[flat[outside]] = 0.0
        high[flat] = np.where(
            outside, np.where(high[flat] < nearest, nearest, farthest), high[flat]
        )
    return high, low
