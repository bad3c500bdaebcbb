"""Triangles that scenes are made of: from files, of simple solids, and cleaned into meshes."""

from __future__ import annotations

import itertools
import json
import math
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.geometry.mesh import Mesh, normals, require_shapes, round_centre
from sweep.model.geometry.quaternion import about, rotate
from sweep.scenes.files import SceneError, existing, read_companion, require_memory
from sweep.scenes.polygon_files import POLYGON_FORMATS, read_polygons
from sweep.scenes.polygons import triangulate
from sweep.units import QuantityError, read_unit

UPRIGHT = (1.0, 0.0, 0.0, 0.0)

_CLEAR = 1e-12
"""Normal over the product of two edges above which no rounding can have made it."""

_Y_UP_FORMATS = {".glb", ".gltf"}
"""Formats whose specification makes y the vertical; for the others z is taken to be it."""

_TRIANGLE_FORMATS = {".stl", *_Y_UP_FORMATS}
"""Formats that hold triangles alone."""

MESH_FORMATS = (".stl", ".obj", ".ply", ".off", ".gltf", ".glb")
"""Formats that are read. No archive is among them: what it holds can be of any size."""

COORDINATE_MAX = 1e9
"""Largest distance of a vertex from zero along any axis [m]; beyond, squares overflow."""

_PACKAGES = {"mapbox_earcut", "plyfile", "trimesh"}
"""Packages of the extra `scenes` that reading a mesh takes."""

FACES_MAX = 100_000_000
"""Most triangles of one mesh file."""

_MEMORY_FACTOR = {".obj": 40, ".off": 40, ".ply": 20, ".stl": 8, ".gltf": 20, ".glb": 20}
"""Memory that reading and preparing a mesh takes at most, over the size of its file."""


@dataclass(frozen=True, eq=False)
class Facets:
    """A soup of triangles.

    Vertices (n, 3) relative to an origin (3,) [m]: terrain lies millions of metres from the
    zero of its map, and a vertex kept apart from that loses no digits to it. Faces (m, 3) are
    counter-clockwise as seen from outside; surface (m,) int16 is the index of each face's in
    the scene's list. Notes say what was done as they were read. Those of a grid need no mending:
    their vertices are distinct and used, their faces too, and each has an area.
    """

    vertices: np.ndarray
    faces: np.ndarray
    surface: np.ndarray
    origin: np.ndarray
    notes: tuple[str, ...] = ()
    is_grid: bool = False

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
        with np.errstate(invalid="ignore"):
            far = np.abs(self.vertices) > COORDINATE_MAX
        if far.any():
            place = self.vertices[far][0]
            raise ValueError(
                f"a vertex lies at {place:.3g} m, farther than {COORDINATE_MAX:.0e} m from zero"
            )
        if self.is_grid:
            _require_faces(len(self.faces), len(self.faces))
            centre = round_centre(self.vertices)
            mesh = Mesh(self.vertices - centre, self.faces, self.surface, centre + self.origin)
            return mesh, Report(len(self.vertices), len(self.faces), notes=self.notes)
        mesh, report = clean(self.vertices, self.faces, self.surface)
        report = replace(report, notes=self.notes)
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
        tuple(note for part in parts for note in part.notes),
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
    notes: tuple[str, ...] = ()  # what was done as they were read

    def text(self) -> str:
        """One line for people: what was given, and of the rest what is not zero."""
        counts = [(words, getattr(self, name)) for name, words in _MENDED.items()]
        said = [words.format(count) for words, count in counts if count]
        given = f"{self.faces:,} faces on {self.vertices:,} vertices"
        return "; ".join([given, *self.notes, *(said or ["nothing to mend"])])


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
    n_vertices, n_faces = len(points), len(corners)
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
    return mesh, Report(
        vertices=n_vertices,
        faces=n_faces,
        non_finite=int((~has_data).sum()),
        degenerate=len(corners) - len(has_area),
        duplicate=len(has_area) - len(first),
        merged=merged,
        unreferenced=n_vertices - merged - len(kept),
    )


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
    """Facets of a mesh file (`MESH_FORMATS`), all its parts; nothing is mended here.

    Polygons are cut into triangles (:mod:`sweep.scenes.polygons`). The unit of lengths is by
    default the one that the file states, or else metres; up is by default y for glTF, z for
    others. SceneError for a file that is missing, can not be loaded or holds no triangles, a
    polygon without a surface of its own, or an unknown unit.
    """
    path = existing(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_FORMATS:
        formats = ", ".join(MESH_FORMATS)
        raise SceneError(path, f"is no mesh of a format that is read ({formats})", "export to one")
    needed = _MEMORY_FACTOR[suffix] * path.stat().st_size
    require_memory(path, needed, "reduce the mesh, or cut a part out of it")
    try:
        reader = _read_polygon_file if suffix in POLYGON_FORMATS else _read_triangle_file
        parts, stated = reader(path)
    except SceneError:
        raise
    except ImportError as error:
        if (error.name or "").partition(".")[0] in _PACKAGES:
            raise
        remedy = "install what it asks for, or export to OBJ, PLY, STL or plain glTF"
        raise SceneError(path, f"needs another package ({error})", remedy) from None
    except Exception as error:  # parsers of several formats fail in as many ways
        rule, remedy = f"is no mesh that can be read ({error})", "check it, or export it again"
        raise SceneError(path, rule, remedy) from None
    if not parts:
        raise SceneError(path, "holds no triangles", "export a triangle mesh, not points or curves")
    y_up = suffix in _Y_UP_FORMATS if up is None else up == "y"
    rotation = about(0, math.pi / 2) if y_up else UPRIGHT
    return join(parts).placed(rotation=rotation, scale=scale * _metres(path, unit or stated))


def _read_polygon_file(path: Path) -> tuple[list[Facets], str | None]:
    """Facets of a file of polygons, in the file's frame and unit, which it does not state."""
    polygons = read_polygons(path)
    cut = triangulate(polygons)
    if not len(cut.faces):
        return [], None
    return [replace(Facets.of(polygons.vertices, cut.faces), notes=cut.notes())], None


def _read_triangle_file(path: Path) -> tuple[list[Facets], str | None]:
    """Facets of a file of triangles, part by part, in the file's frame; its unit of length."""
    import trimesh

    if path.suffix.lower() in _Y_UP_FORMATS:
        _check_gltf(path)
    else:
        _check_stl(path)
    with path.open("rb") as file:
        scene: Any = trimesh.load_scene(
            file,
            file_type=path.suffix.lower()[1:],
            resolver=_companions_of(path),
            process=False,
            skip_materials=True,  # nothing is seen of textures, which can be of any size
        )
    nodes = sorted(scene.graph.nodes_geometry)
    faces = [len(getattr(scene.geometry[scene.graph[node][1]], "faces", ())) for node in nodes]
    if sum(faces) > FACES_MAX:
        rule = f"places its meshes so often that they make {sum(faces):,} triangles"
        raise SceneError(path, rule, f"keep it below {FACES_MAX:.0e}")
    return [part for node in nodes for part in _parts(scene, node)], scene.units


def _companions_of(path: Path) -> Any:
    """Trimesh's resolver of the names in a file, which serves plain files beside it alone."""
    from trimesh.resolvers import Resolver

    class PlainFiles(Resolver):  # type: ignore[misc]
        """Files that a mesh names."""

        def __init__(self) -> None:
            pass

        def get(self, key: str) -> bytes:
            """Content of a file."""
            return read_companion(path, key)

        def write(self, name: str, data: bytes) -> None:
            """Refuse to write: the files that a mesh names are read alone."""
            raise PermissionError(f"{name}: a mesh's files are not written")

        def namespaced(self, namespace: str) -> PlainFiles:
            """Return the same resolver, for names below a folder are none of a glTF's."""
            return self

        def keys(self) -> list[str]:
            """Names that are listed: none."""
            return []

    return PlainFiles()


_STL_HEADER = struct.Struct("<80sI")
_STL_TRIANGLE_BYTES = 50
_TEXT_BYTES = 1000
"""Bytes at the beginning of an STL that tell text from numbers."""


def _check_stl(path: Path) -> None:
    """Refuse a binary STL whose size is not that of its triangles; text has no zero bytes."""
    with path.open("rb") as file:
        start = file.read(_TEXT_BYTES)
    if b"\0" not in start and re.search(rb"^\W*solid|\bfacet\b", start, re.I):
        return
    head = start[: _STL_HEADER.size]
    if len(head) < _STL_HEADER.size:
        raise ValueError(f"it has {len(head)} bytes, and a binary STL has 84 or more")
    count, size = _STL_HEADER.unpack(head)[1], path.stat().st_size
    needed = _STL_HEADER.size + _STL_TRIANGLE_BYTES * count
    if size != needed:
        raise ValueError(
            f"its header counts {count:,} triangles, which take {needed:,} bytes, and it has "
            f"{size:,}{': it is cut off' if size < needed else ''}"
        )


_GLB_HEADER = struct.Struct("<4sIIII")
_ACCESSOR_BYTES = 64
"""Most bytes of an element of an accessor: a matrix of 16 floats."""


def _check_gltf(path: Path) -> None:
    """Refuse a glTF whose arrays are larger than its buffers, or whose document is none."""
    content = path.read_bytes()
    if path.suffix.lower() == ".glb":
        if len(content) < _GLB_HEADER.size:
            raise ValueError("it is cut off")
        magic, version, _, length, _ = _GLB_HEADER.unpack_from(content)
        if magic != b"glTF" or version != 2:
            raise ValueError("it is no binary glTF of version 2")
        content = content[_GLB_HEADER.size : _GLB_HEADER.size + length]
    document = json.loads(content)
    accessors = document.get("accessors", []) if isinstance(document, dict) else None
    if accessors is None:
        raise ValueError("it is no JSON object")
    buffers = sum(int(buffer["byteLength"]) for buffer in document.get("buffers", []))
    counts = [int(accessor["count"]) for accessor in accessors]
    if min(counts, default=0) < 0:
        raise ValueError(f"it declares an array of {min(counts):,} elements")
    elements = sum(counts)
    if elements > max(buffers, 1):
        raise ValueError(f"its arrays have {elements:,} elements in {buffers:,} bytes")
    remedy = "reduce the mesh, or cut a part out of it"
    require_memory(path, elements * _ACCESSOR_BYTES + buffers, remedy)


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
