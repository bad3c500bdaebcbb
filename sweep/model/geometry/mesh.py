"""Surfaces, meshes for ray casting, and the planes of their facets in double-double arithmetic.

A wavelength of a micrometre at kilometres of range needs the last bits of float64, and grazing
incidence amplifies rounding. So a facet's normal, the ray's origin relative to a corner, and their
products are carried as two float64 each (high + low, by the exact sums and products of Dekker and
Knuth). The remaining error is the rounding of the range itself, half a unit in its last place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SurfaceMaterial:
    """Optical properties of one kind of surface."""

    name: str
    """Name."""
    reflectance: float
    """Reflectance by the definition of its law, 0..1."""
    reflectance_law: str = "lambert"
    """Reflectance law, one of :data:`sweep.model.ground.REFLECTANCE_LAWS`."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles relative to an origin, so that large coordinates keep their digits.

    Raises
    ------
    ValueError
        For shapes that do not fit, no triangle, or a vertex that is not finite or missing.
    """

    vertices: np.ndarray
    """(n, 3) float64 [m], relative to `origin`."""
    faces: np.ndarray
    """(m, 3) int32: vertices of each triangle, in either winding, since both sides are visible."""
    surface_index: np.ndarray
    """(m,) int16: index of each triangle's surface in the scene."""
    origin: np.ndarray
    """(3,) float64 [m]: position of the vertices' zero in the frame of the scene or the body."""

    def __post_init__(self):
        require_shapes(self.vertices, self.faces, self.surface_index)
        if len(self.faces) == 0:
            raise ValueError("a mesh needs at least one triangle")
        if not np.isfinite(self.vertices).all():
            raise ValueError("a mesh's vertices are finite")
        if np.shape(self.origin) != (3,) or not np.isfinite(self.origin).all():
            raise ValueError("a mesh's origin is three finite coordinates")
        dtype_by_name = {"vertices": np.float64, "faces": np.int32, "surface_index": np.int16}
        for name, dtype in (dtype_by_name | {"origin": np.float64}).items():
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype=dtype))


def merge_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Merge several meshes of one frame into one mesh, in the order given."""
    corners = [
        mesh.origin + corner_function(mesh.vertices, axis=0)
        for mesh in meshes
        for corner_function in (np.min, np.max)
    ]
    origin = exact_centre(np.array(corners))
    if len(meshes) == 1 and np.array_equal(meshes[0].origin, origin):
        return meshes[0]
    vertices = np.empty((sum(len(mesh.vertices) for mesh in meshes), 3))
    faces = np.empty((sum(len(mesh.faces) for mesh in meshes), 3), np.int32)
    n_vertices = n_faces = 0
    for mesh in meshes:  # in place: copies of all would take twice the memory
        rows = slice(n_faces, n_faces + len(mesh.faces))
        np.add(mesh.faces, n_vertices, out=faces[rows])
        rows = slice(n_vertices, n_vertices + len(mesh.vertices))
        np.add(mesh.vertices, mesh.origin - origin, out=vertices[rows])
        n_vertices, n_faces = n_vertices + len(mesh.vertices), n_faces + len(mesh.faces)
    return Mesh(vertices, faces, np.concatenate([mesh.surface_index for mesh in meshes]), origin)


def require_shapes(vertices: np.ndarray, faces: np.ndarray, surface_index: np.ndarray) -> None:
    """Check that the arrays of a mesh fit together and that faces refer to existing vertices.

    Parameters
    ----------
    vertices : ndarray (n, 3)
        Vertices.
    faces : ndarray (m, 3) of int
        Vertices of each triangle.
    surface_index : ndarray (m,)
        Surface of each triangle.

    Raises
    ------
    ValueError
        If they do not.
    """
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices are of shape (n, 3), not {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"faces are integers of shape (m, 3), not {faces.dtype} {faces.shape}")
    if surface_index.shape != faces.shape[:1]:
        raise ValueError(f"{len(faces)} faces need as many surfaces, not {surface_index.shape}")
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError(f"a face names a vertex outside 0..{len(vertices) - 1}")


def exact_centre(vertices: np.ndarray) -> np.ndarray:
    """Return the centre of the bounding box, rounded so that subtracting it is exact.

    Along an axis it is zero if zero is no farther from the mesh than the mesh is large, since small
    coordinates would lose their last digits otherwise. Else it is rounded to a power of two not
    below 1/1024 of the extent. Coordinate and centre are then multiples of the coordinate's last
    place, and their difference is no larger than the coordinate.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent = float((high - low).max())
    if extent == 0.0:
        return np.array(low)
    step = 2.0 ** np.ceil(np.log2(extent / 1024.0))
    middle = np.round((0.5 * low + 0.5 * high) / step) * step
    return np.where(np.abs(middle) > extent, middle, 0.0)


DoubleDouble = tuple[np.ndarray, np.ndarray]
"""Numbers as sums of two float64, high and low; for vectors the components are along the first
axis."""

_SPLIT_FACTOR = 2.0**27 + 1
"""Factor that splits a float64 into two of half as many digits."""

_GRAZING_SINE_MAX = 1e-6
"""Sine of the angle to a facet below which its plane may lie along the ray within rounding."""


def to_double_double(values: np.ndarray) -> DoubleDouble:
    """Return float64 numbers as double-doubles."""
    return values, np.zeros_like(values)


def _two_sum(a: np.ndarray, b: np.ndarray) -> DoubleDouble:
    """Return a sum and its rounding error."""
    total = a + b
    virtual_b = total - a
    return total, (a - (total - virtual_b)) + (b - virtual_b)


def _quick_two_sum(a: np.ndarray, b: np.ndarray) -> DoubleDouble:
    """Return a sum and its rounding error, for abs(a) >= abs(b)."""
    total = a + b
    return total, b - (total - a)


def _split(a: np.ndarray) -> DoubleDouble:
    """Split numbers into two of half as many digits."""
    scaled = a * _SPLIT_FACTOR
    high = scaled - (scaled - a)
    return high, a - high


def multiply(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the product of two double-doubles."""
    high_product = a[0] * b[0]
    (ah, al), (bh, bl) = _split(a[0]), _split(b[0])
    low_product = ((ah * bh - high_product) + ah * bl + al * bh) + al * bl
    return _quick_two_sum(high_product, low_product + (a[0] * b[1] + a[1] * b[0]))


def add(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the sum of two double-doubles, accurate even if the high parts cancel."""
    high_sum, high_error = _two_sum(a[0], b[0])
    low_sum, low_error = _two_sum(a[1], b[1])
    high_sum, high_error = _quick_two_sum(high_sum, high_error + low_sum)
    return _quick_two_sum(high_sum, high_error + low_error)


def subtract(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the difference of two double-doubles."""
    return add(a, (-b[0], -b[1]))


def dot(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the scalar product of two vectors.

    For a vector (3, 1, n) and a matrix (3, 3, n) it is their product, a vector (3, n).
    """
    x, y, z = zip(*multiply(a, b), strict=True)
    return add(add(x, y), z)


def _cross(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the vector product of two vectors."""
    (ay, az), (by, bz) = (
        [(v[0][axes], v[1][axes]) for axes in ([1, 2, 0], [2, 0, 1])] for v in (a, b)
    )
    return subtract(multiply(ay, bz), multiply(az, by))


def facet_normals(corners: np.ndarray) -> DoubleDouble:
    """Compute normals (3, n) of facets, oriented by their winding, with lengths of twice the areas.

    `corners` (3, 3, n) are x, y, z of the first, second and third corner.
    """
    a, b, c = (to_double_double(corner) for corner in corners)
    return _cross(subtract(b, a), subtract(c, a))


def plane_distances(
    corners: np.ndarray,
    facet_normal: DoubleDouble,
    plane_height: DoubleDouble,
    ray_origin: DoubleDouble,
    ray_direction: DoubleDouble,
) -> DoubleDouble:
    """Compute the distances of facets' planes along rays.

    Parameters
    ----------
    corners : ndarray (3, 3, n)
        x, y, z of the facets' first, second and third corner [m].
    facet_normal : DoubleDouble (3, n)
        Normals of the facets.
    plane_height : DoubleDouble (n,)
        Product of the normals with a corner minus the origin.
    ray_origin, ray_direction : DoubleDouble (3, n)
        Origins [m] and directions of the rays.

    Returns
    -------
    DoubleDouble (n,)
        Distance in lengths of `ray_direction`.

    Notes
    -----
    If a plane is so oblique that it lies along the ray within rounding, the hit may be anywhere on
    the facet. The distance is then limited to those of its corners.
    """
    normal_speed = dot(facet_normal, ray_direction)
    with np.errstate(all="ignore"):  # rays parallel to a plane
        distance_high = plane_height[0] / normal_speed[0]
        remainder, distance_low = subtract(
            plane_height, multiply(to_double_double(distance_high), normal_speed)
        )
        distance_high, distance_low = _quick_two_sum(
            distance_high, (remainder + distance_low) / normal_speed[0]
        )
    x, y, z = np.abs(facet_normal[0])
    grazing_facets = np.flatnonzero(~(np.abs(normal_speed[0]) > _GRAZING_SINE_MAX * (x + y + z)))
    if grazing_facets.size:
        grazing_origin, grazing_direction = (
            (ray_origin[0][:, grazing_facets], ray_origin[1][:, grazing_facets]),
            ray_direction[0][:, grazing_facets],
        )
        length = grazing_direction[0] ** 2 + grazing_direction[1] ** 2 + grazing_direction[2] ** 2
        corner_distances = []
        for corner in corners[:, :, grazing_facets]:
            x, y, z = subtract(to_double_double(corner), grazing_origin)[0] * grazing_direction
            corner_distances.append((x + y + z) / length)
        nearest, farthest = np.min(corner_distances, axis=0), np.max(corner_distances, axis=0)
        outside = ~(
            (distance_high[grazing_facets] >= nearest) & (distance_high[grazing_facets] <= farthest)
        )
        distance_low[grazing_facets[outside]] = 0.0
        distance_high[grazing_facets] = np.where(
            outside,
            np.where(distance_high[grazing_facets] < nearest, nearest, farthest),
            distance_high[grazing_facets],
        )
    return distance_high, distance_low
