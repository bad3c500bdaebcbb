"""Surfaces, soups of triangles, meshes that rays can be cast at, and the planes of their facets.

A micrometre of wavelength at kilometres of range asks for the last bits of float64, and grazing
incidence divides them away. So a facet's normal, the ray's origin relative to a corner and their
products are carried as two float64 each (high + low, Dekker's and Knuth's exact sums and
products); what remains is the rounding of the range itself, half a unit in its last place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.geometry.quaternion import rotate
from sweep.model.reflectance import LAWS


@dataclass(frozen=True)
class Surface:
    """Optical properties of one kind of surface.

    Parameters
    ----------
    name : str
        What it is called in a study.
    reflectance : float
        What its law takes as such, 0..1.
    law : str
        Reflectance law, one of :data:`sweep.model.reflectance.LAWS`.
    roughness : float
        Standard deviation of the height within a beamlet's spot [m], >= 0: against the
        wavelength it decides on speckle.
    """

    name: str
    reflectance: float
    law: str = "lambert"
    roughness: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.reflectance <= 1:
            raise ValueError(f"{self.name}: the reflectance must lie within 0 and 1")
        if self.law not in LAWS:
            laws = ", ".join(LAWS)
            raise ValueError(f"{self.name}: no reflectance law {self.law!r}: choose from {laws}")
        if not self.roughness >= 0:
            raise ValueError(f"{self.name}: the roughness must be at least 0 m")


_CLEAR = 1e-12
"""Normal over the product of two edges above which no rounding can have made it."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles around an origin of their own, so that far-off coordinates keep their digits.

    Raises
    ------
    ValueError
        The arrays' shapes do not fit, there is no triangle, a vertex is not finite or does not
        exist.
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
        _require_shapes(self.vertices, self.faces, self.surface)
        if len(self.faces) == 0:
            raise ValueError("a mesh needs at least one triangle")
        if not np.isfinite(self.vertices).all():
            raise ValueError("a mesh's vertices are finite")
        if np.shape(self.origin) != (3,) or not np.isfinite(self.origin).all():
            raise ValueError("a mesh's origin is three finite coordinates")
        kinds = {"vertices": np.float64, "faces": np.int32, "surface": np.int16}
        for name, kind in (kinds | {"origin": np.float64}).items():
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype=kind))


@dataclass(frozen=True)
class Report:
    """What `clean` was given, found and did, in counts that `_WORDS` tells the meaning of."""

    vertices: int
    faces: int
    non_finite: int = 0
    degenerate: int = 0
    duplicate: int = 0
    merged: int = 0
    unreferenced: int = 0
    open_edges: int = 0
    crowded_edges: int = 0
    opposed_edges: int = 0
    inside_out: int = 0

    def text(self) -> str:
        """One line for people: what was given, and of the rest what is not zero."""
        counts = {words: getattr(self, name) for name, words in _WORDS.items()}
        said = [words.format(count) for words, count in counts.items() if count]
        given = f"{self.faces} faces on {self.vertices} vertices"
        return "; ".join([given, *(said or ["nothing to mend"])])


_WORDS = {
    "non_finite": "{} faces without data dropped",
    "degenerate": "{} faces without area dropped",  # a repeated vertex, or three in one line
    "duplicate": "{} duplicate faces dropped",  # in whatever winding
    "merged": "{} coincident vertices merged",
    "unreferenced": "{} unused vertices dropped",
    "open_edges": "{} open edges (not watertight)",  # a face on one side only
    "crowded_edges": "{} edges of more than two faces",
    "opposed_edges": "{} edges with one side's normal inverted",
    "inside_out": "closed, with normals pointing inwards",  # 1 where it is so
}


def clean(vertices: ArrayLike, faces: ArrayLike, surface: ArrayLike) -> tuple[Mesh, Report]:
    """Mesh fit to be cast at, and what was done to make it so.

    Faces without data, without area or given twice are dropped, coincident vertices merged,
    unused ones dropped, and the rest centred. Holes, crowded edges and inverted normals change
    nothing for rays, which see both sides of a face; they are counted. Faces keep their order.

    Parameters
    ----------
    vertices : (n, 3) array_like of float
        Coordinates [m]; not finite where there is no data.
    faces : (m, 3) array_like of int
        Vertices of each face, 0..n-1.
    surface : (m,) array_like of int, or int
        Surface of each face, or of all.

    Raises
    ------
    ValueError
        The arrays' shapes do not fit, a face names a vertex that does not exist, or no face is
        left.
    """
    points, corners = np.array(vertices, dtype=np.float64), np.asarray(faces)
    kinds = np.full(len(corners), surface) if np.ndim(surface) == 0 else np.asarray(surface)
    _require_shapes(points, corners, kinds)
    given = {"vertices": len(points), "faces": len(corners)}
    has_data = np.isfinite(points)[corners].all(axis=(1, 2))
    corners, kinds = corners[has_data], kinds[has_data]
    _require_faces(len(corners), len(has_data))
    used = np.unique(corners)
    points = points[used] + 0.0  # -0 and 0 are one place
    kept, place = _distinct(points)
    corners, merged = place[np.searchsorted(used, corners)], len(used) - len(kept)
    points = points[kept]
    origin = _round_centre(points)
    points -= origin
    has_area = np.flatnonzero(_have_area(points, corners))
    first = has_area[_distinct(np.sort(corners[has_area], axis=1))[0]]
    _require_faces(len(first), len(has_data))
    kept = np.unique(corners[first])
    mesh = Mesh(points[kept], np.searchsorted(kept, corners[first]), kinds[first], origin)
    counts = {
        "non_finite": int((~has_data).sum()),
        "degenerate": len(corners) - len(has_area),
        "duplicate": len(has_area) - len(first),
        "merged": merged,
        "unreferenced": given["vertices"] - merged - len(kept),
    }
    return mesh, Report(**given, **counts, **_edge_counts(mesh))


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """All triangles of several meshes of one frame as one mesh, in the order given.

    Raises
    ------
    ValueError
        There is no mesh.
    """
    if not meshes:
        raise ValueError("there is no mesh to merge")
    corners = [m.origin + f(m.vertices, axis=0) for m in meshes for f in (np.min, np.max)]
    origin = _round_centre(np.array(corners))
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return Mesh(
        vertices=np.concatenate([m.vertices + (m.origin - origin) for m in meshes]),
        faces=np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=False)]),
        surface=np.concatenate([m.surface for m in meshes]),
        origin=origin,
    )


def _require_shapes(vertices: np.ndarray, faces: np.ndarray, surface: np.ndarray) -> None:
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices are of shape (n, 3), not {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"faces are integers of shape (m, 3), not {faces.dtype} {faces.shape}")
    if surface.shape != faces.shape[:1]:
        raise ValueError(f"{len(faces)} faces need as many surfaces, not {surface.shape}")
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError(f"a face names a vertex outside 0..{len(vertices) - 1}")


def _require_faces(left: int, given: int) -> None:
    if left == 0:
        raise ValueError(f"of {given} faces none is left that a ray could hit")


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows that repeat no earlier one, by index, rising; and the place of every row among them."""
    order = np.lexsort(rows.T)  # stable: the first of those alike is the first given
    is_new = np.ones(len(rows), dtype=bool)
    is_new[1:] = (np.diff(rows[order], axis=0) != 0).any(axis=1)
    kept = np.sort(order[is_new])
    place = np.empty(len(rows), dtype=np.int64)
    place[order] = np.searchsorted(kept, order[is_new])[np.cumsum(is_new) - 1]
    return kept, place


def _round_centre(vertices: np.ndarray) -> np.ndarray:
    """Middle of the bounding box, chosen so that subtracting it from any vertex is exact.

    Zero along an axis where zero is no farther off than the mesh is large, since small numbers
    would lose their last digits there. Else rounded to a power of two not below 1/1024 of the
    extent: a coordinate and the centre are then both multiples of the coordinate's last place,
    and their difference is no larger than the coordinate.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent = float((high - low).max())
    if extent == 0.0:
        return np.array(low)
    step = 2.0 ** np.ceil(np.log2(extent / 1024.0))
    middle = np.round((0.5 * low + 0.5 * high) / step) * step
    return np.where(np.abs(middle) > extent, middle, 0.0)


def _have_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mask of the faces (m, 3) whose corners are apart and not in one line, exactly."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    b, c = b - a, c - a
    longest = np.abs(b).max(axis=1) * np.abs(c).max(axis=1)
    has_area = np.asarray(np.abs(np.cross(b, c)).max(axis=1) > _CLEAR * longest)
    doubtful = np.flatnonzero(~has_area)
    exact, _ = normals(vertices[faces[doubtful]].transpose(1, 2, 0))
    has_area[doubtful] = exact.any(axis=0)
    return has_area


def _edge_counts(mesh: Mesh) -> dict[str, int]:
    """Counts of `Report` that are about edges and winding."""
    start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    low, high = np.minimum(start, end).astype(np.int64), np.maximum(start, end)
    key = low * len(mesh.vertices) + high
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    number = np.diff(first, append=len(key))
    sense = np.add.reduceat(np.where(start < end, 1, -1)[order], first)
    counts = {
        "open_edges": int((number == 1).sum()),
        "crowded_edges": int((number > 2).sum()),
        "opposed_edges": int(((number == 2) & (sense != 0)).sum()),
    }
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    inwards = np.einsum("ij,ij->", a, np.cross(b, c)) < 0.0  # six times the volume enclosed
    return counts | {"inside_out": int(inwards and not any(counts.values()))}


@dataclass(frozen=True, eq=False)
class Facets:
    """A soup of triangles.

    Parameters
    ----------
    vertices : (n, 3) float64 ndarray
        Positions relative to `origin` [m].
    faces : (m, 3) int64 ndarray
        Rows of `vertices`, counter-clockwise as seen from outside (or above).
    surface : (m,) int16 ndarray
        Index of each face's surface in the scene's list.
    origin : (3,) float64 ndarray
        World position of the zero of `vertices` [m]. Terrain lies millions of metres from the
        zero of its map; a vertex that is kept apart from that offset loses no digits to it.
    """

    vertices: np.ndarray
    faces: np.ndarray
    surface: np.ndarray
    origin: np.ndarray

    @classmethod
    def of(
        cls,
        vertices: np.ndarray,
        faces: np.ndarray,
        *,
        surface: int = 0,
        origin: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    ) -> Facets:
        """Facets that share one surface."""
        faces = np.asarray(faces, np.int64).reshape(-1, 3)
        return cls(
            np.asarray(vertices, float).reshape(-1, 3),
            faces,
            np.full(len(faces), surface, np.int16),
            np.asarray(origin, float),
        )

    def placed(
        self,
        *,
        translation: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
        rotation: Sequence[float] | np.ndarray = (1.0, 0.0, 0.0, 0.0),
        scale: float = 1.0,
    ) -> Facets:
        """Facets scaled and turned about their origin, which is then moved [m].

        The rotation is a unit quaternion (w, x, y, z).
        """
        turned = rotate(np.asarray(rotation, float), self.vertices * scale)
        return replace(self, vertices=turned, origin=self.origin + np.asarray(translation, float))

    def mesh(self) -> tuple[Mesh, Report]:
        """Mesh fit to be cast at, in the world frame, and what was done to make it so."""
        mesh, report = clean(self.vertices, self.faces, self.surface)
        return replace(mesh, origin=mesh.origin + self.origin), report


def join(parts: Sequence[Facets]) -> Facets:
    """All parts as one, relative to the first one's origin.

    Raises
    ------
    ValueError
        Where there are no parts.
    """
    if not parts:
        raise ValueError("no facets to join")
    origin = parts[0].origin
    shifts = np.cumsum([0, *(len(part.vertices) for part in parts)])[:-1]
    return Facets(
        np.concatenate([part.vertices + (part.origin - origin) for part in parts]),
        np.concatenate([part.faces + shift for part, shift in zip(parts, shifts, strict=True)]),
        np.concatenate([part.surface for part in parts]),
        origin,
    )


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
    """Normals (3, n) of facets, of twice their areas' lengths, by their winding.

    Parameters
    ----------
    corners : (3, 3, n) float64
        First, second and third corner; their x, y, z.
    """
    a, b, c = (exact(corner) for corner in corners)
    return _cross(less(b, a), less(c, a))


def distances(corners: np.ndarray, normal: Pair, height: Pair, o: Pair, d: Pair) -> Pair:
    """Distances of facets' planes along rays, in lengths of `d`.

    A plane seen so flatly that it runs through the facet within rounding is met somewhere
    on the facet: the distance stays between those of its corners.

    Parameters
    ----------
    corners, normal
        As of :func:`normals`.
    height : Pair
        Products (n,) of the normals with a corner less the origin.
    o, d : Pair
        Origins and directions (3, n) of the rays.
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
