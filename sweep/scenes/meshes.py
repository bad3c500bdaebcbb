"""Triangles that scenes are made of: from files, of simple solids, and cleaned into meshes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.geometry.mesh import Mesh, normals, require_shapes, round_centre
from sweep.model.geometry.quaternion import about, rotate
from sweep.scenes.files import SceneError, existing
from sweep.units import QuantityError, read_unit

UPRIGHT = (1.0, 0.0, 0.0, 0.0)

_CLEAR = 1e-12
"""Normal over the product of two edges above which no rounding can have made it."""

_Y_UP_FORMATS = {".glb", ".gltf"}
"""Formats whose specification makes y the vertical; for the others z is taken to be it."""


@dataclass(frozen=True, eq=False)
class Facets:
    """A soup of triangles.

    Vertices (n, 3) relative to an origin (3,) [m]: terrain lies millions of metres from the
    zero of its map, and a vertex kept apart from that loses no digits to it. Faces (m, 3) are
    counter-clockwise as seen from outside; surface (m,) int16 is the index of each face's in
    the scene's list.
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
        self, *, rotation: Sequence[float] | np.ndarray = UPRIGHT, scale: float = 1.0
    ) -> Facets:
        """Facets scaled, then turned about their origin by a unit quaternion (w, x, y, z)."""
        return replace(self, vertices=rotate(np.asarray(rotation, float), self.vertices * scale))

    def mesh(self) -> tuple[Mesh, Report]:
        """Mesh fit to be cast at, in the world frame, and what was done to make it so."""
        mesh, report = clean(self.vertices, self.faces, self.surface)
        return replace(mesh, origin=mesh.origin + self.origin), report


def join(parts: Sequence[Facets]) -> Facets:
    """All parts, one at least, as one, relative to the first one's origin."""
    origin = parts[0].origin
    shifts = np.cumsum([0, *(len(part.vertices) for part in parts)])[:-1]
    return Facets(
        np.concatenate([part.vertices + (part.origin - origin) for part in parts]),
        np.concatenate([part.faces + shift for part, shift in zip(parts, shifts, strict=True)]),
        np.concatenate([part.surface for part in parts]),
        origin,
    )


_MENDED = {
    "non_finite": "{} faces without data dropped",
    "degenerate": "{} faces without area dropped",
    "duplicate": "{} duplicate faces dropped",
    "merged": "{} coincident vertices merged",
    "unreferenced": "{} unused vertices dropped",
}
"""Counts of `Report` in words for people."""


@dataclass(frozen=True)
class Report:
    """Counts of facets that `clean` was given, found and mended."""

    vertices: int
    faces: int
    non_finite: int = 0
    degenerate: int = 0  # corners that are one, or in line
    duplicate: int = 0  # in whatever winding
    merged: int = 0
    unreferenced: int = 0

    def text(self) -> str:
        """One line for people: what was given, and of the rest what is not zero."""
        counts = [(words, getattr(self, name)) for name, words in _MENDED.items()]
        said = [words.format(count) for words, count in counts if count]
        given = f"{self.faces:,} faces on {self.vertices:,} vertices"
        return "; ".join([given, *(said or ["nothing to mend"])])


def clean(vertices: ArrayLike, faces: ArrayLike, surface: ArrayLike) -> tuple[Mesh, Report]:
    """Mesh fit to be cast at, and what was done to make it so.

    Faces without data, without area or given twice are dropped, coincident vertices merged,
    unused ones dropped, and the rest centred. Holes and inverted normals stay: rays see both sides
    of a face. Faces (m, 3) keep their order; vertices (n, 3) [m] are not finite where there is no
    data.

    ValueError where the arrays' shapes do not fit, a face names a vertex that does not exist,
    or no face is left.
    """
    points, corners = np.array(vertices, dtype=np.float64), np.asarray(faces)
    kinds = np.full(len(corners), surface) if np.ndim(surface) == 0 else np.asarray(surface)
    require_shapes(points, corners, kinds)
    given = {"vertices": len(points), "faces": len(corners)}
    has_data = np.isfinite(points)[corners].all(axis=(1, 2))
    corners, kinds = corners[has_data], kinds[has_data]
    _require_faces(len(corners), len(has_data))
    used = np.unique(corners)
    points = points[used] + 0.0  # -0 and 0 are one place
    kept, place = _distinct(points)
    corners, merged = place[np.searchsorted(used, corners)], len(used) - len(kept)
    points = points[kept]
    origin = round_centre(points)
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
    return mesh, Report(**given, **counts)


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


def read_mesh(
    path: str | Path, *, unit: str | None = None, up: str | None = None, scale: float = 1.0
) -> Facets:
    """Facets of a mesh file (STL, OBJ, PLY, glTF ...), all its parts; nothing is mended here.

    The unit of lengths is by default the one that the file states, or else metres; up is by
    default y for glTF, z for others. SceneError for a file that is missing, can not be loaded
    or holds no triangles, or an unknown unit.
    """
    import trimesh

    path = existing(path)
    try:
        scene: Any = trimesh.load_scene(str(path), process=False)
    except ImportError as error:
        remedy = "install what it asks for, or export to OBJ, PLY, STL or glTF"
        raise SceneError(path, f"needs another package ({error})", remedy) from None
    except Exception as error:  # parsers of dozens of formats fail in as many ways
        known = ", ".join(sorted(trimesh.available_formats()))
        raise SceneError(path, f"is no mesh that can be read ({error})", f"use {known}") from None
    parts = [part for node in sorted(scene.graph.nodes_geometry) for part in _parts(scene, node)]
    if not parts:
        raise SceneError(path, "holds no triangles", "export a triangle mesh, not points or curves")
    y_up = path.suffix.lower() in _Y_UP_FORMATS if up is None else up == "y"
    rotation = about(0, math.pi / 2) if y_up else UPRIGHT
    return join(parts).placed(rotation=rotation, scale=scale * _metres(path, unit or scene.units))


def _parts(scene: Any, node: str) -> Iterator[Facets]:
    """Facets of one mesh of a file, in the file's frame; none of points and curves."""
    matrix, name = scene.graph[node]
    mesh = scene.geometry[name]
    if not len(getattr(mesh, "faces", ())):
        return
    vertices = np.asarray(mesh.vertices, float) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(mesh.faces, np.int64)
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]  # a mirrored part is inside out
    yield Facets.of(vertices, faces)


def _metres(path: Path, unit: str | None) -> float:
    """Metres of a unit of length; 1 where none is stated."""
    if unit is None:
        return 1.0
    try:
        return read_unit(unit, si_unit="m", example="mm").to_si(1)  # type: ignore[arg-type]
    except QuantityError as error:
        raise SceneError(path, f"has lengths in '{unit}' ({error})", "state a unit") from None


def sphere(*, radius: float, subdivisions: int) -> Facets:
    """Return a refined icosahedron of 20 * 4^subdivisions faces, with its corners on the sphere."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Facets.of(np.asarray(ball.vertices), np.asarray(ball.faces))


def box(*, size: Sequence[float]) -> Facets:
    """Return a box of 12 facets, facing outwards, of these lengths along x, y and z [m]."""
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * size
    faces = []
    for axis, side in itertools.product(range(3), (0, 1)):
        far, near = 4 >> ((axis + 1) % 3), 4 >> ((axis + 2) % 3)
        first = (4 >> axis) * side
        a, b, c, d = first, first + far, first + far + near, first + near
        faces += [(a, b, c), (a, c, d)] if side else [(a, c, b), (a, d, c)]
    return Facets.of(corners, np.array(faces))
