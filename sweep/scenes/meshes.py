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

from sweep.model.geometry.mesh import Mesh, exact_centre, facet_normals, require_shapes
from sweep.model.geometry.quaternion import axis_angle, rotate
from sweep.scenes.polygon_files import POLYGON_FORMATS, read_polygons
from sweep.scenes.polygons import triangulate
from sweep.scenes.scene_files import SceneError, read_companion, require_file, require_memory
from sweep.units import QuantityError, read_unit

IDENTITY_QUATERNION = (1.0, 0.0, 0.0, 0.0)

_AREA_ROUNDING = 1e-12
"""Normal over the product of two edges above which no rounding can have made it."""

_Y_UP_FORMATS = {".glb", ".gltf"}
"""Formats whose specification makes y the vertical; for the others z is taken to be it."""

_TRIANGLE_FORMATS = {".stl", *_Y_UP_FORMATS}
"""Formats that hold triangles alone."""

MESH_FORMATS = (".stl", ".obj", ".ply", ".off", ".gltf", ".glb")
"""Formats that are read. No archive is among them: what it holds can be of any size."""

COORDINATE_MAX = 1e9
"""Largest distance of a vertex from zero along any axis [m]; beyond, squares overflow."""

_MESH_PACKAGES = {"mapbox_earcut", "plyfile", "trimesh"}
"""Packages of the extra `scenes` that reading a mesh takes."""

FACES_MAX = 100_000_000
"""Most triangles of one mesh file."""

_MEMORY_PER_FILE_BYTE = {".obj": 40, ".off": 40, ".ply": 20, ".stl": 8, ".gltf": 20, ".glb": 20}
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
    def on_one_surface(
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

    def transform(
        self, *, rotation: Sequence[float] | np.ndarray = IDENTITY_QUATERNION, scale: float = 1.0
    ) -> Facets:
        """Facets scaled, then turned about their origin by a unit quaternion (w, x, y, z)."""
        return replace(self, vertices=rotate(np.asarray(rotation, float), self.vertices * scale))

    def to_mesh(self) -> tuple[Mesh, MeshReport]:
        """Mesh fit to be cast at, in the world frame, and what was done to make it so."""
        with np.errstate(invalid="ignore"):
            is_too_far = np.abs(self.vertices) > COORDINATE_MAX
        if is_too_far.any():
            far_vertex = self.vertices[is_too_far][0]
            raise ValueError(
                f"a vertex lies at {far_vertex:.3g} m, farther than {COORDINATE_MAX:.0e} m from "
                "zero"
            )
        if self.is_grid:
            _require_faces(len(self.faces), len(self.faces))
            centre = exact_centre(self.vertices)
            mesh = Mesh(self.vertices - centre, self.faces, self.surface, centre + self.origin)
            return mesh, MeshReport(len(self.vertices), len(self.faces), notes=self.notes)
        mesh, report = clean_mesh(self.vertices, self.faces, self.surface)
        report = replace(report, notes=self.notes)
        return replace(mesh, origin=mesh.origin + self.origin), report


def join_facets(facets_list: Sequence[Facets]) -> Facets:
    """All parts, one at least, as one, relative to the first one's origin."""
    origin = facets_list[0].origin
    index_shifts = np.cumsum([0, *(len(facets.vertices) for facets in facets_list)])[:-1]
    return Facets(
        np.concatenate([facets.vertices + (facets.origin - origin) for facets in facets_list]),
        np.concatenate(
            [
                facets.faces + index_shift
                for facets, index_shift in zip(facets_list, index_shifts, strict=True)
            ]
        ),
        np.concatenate([facets.surface for facets in facets_list]),
        origin,
        tuple(note for facets in facets_list for note in facets.notes),
    )


_REPAIR_TEXTS = {
    "non_finite": "{} faces without data dropped",
    "degenerate": "{} faces without area dropped",
    "duplicate": "{} duplicate faces dropped",
    "merged": "{} coincident vertices merged",
    "unreferenced": "{} unused vertices dropped",
}
"""Counts of `Report` in words for people."""


@dataclass(frozen=True)
class MeshReport:
    """Counts of facets that `clean` was given, found and mended."""

    n_vertices: int
    n_faces: int
    non_finite: int = 0
    degenerate: int = 0  # corners that are one, or in line
    duplicate: int = 0  # in whatever winding
    merged: int = 0
    unreferenced: int = 0
    notes: tuple[str, ...] = ()  # what was done as they were read

    def summary(self) -> str:
        """One line for people: what was given, and of the rest what is not zero."""
        counts = [(template, getattr(self, name)) for name, template in _REPAIR_TEXTS.items()]
        repairs = [template.format(count) for template, count in counts if count]
        input_text = f"{self.n_faces:,} faces on {self.n_vertices:,} vertices"
        return "; ".join([input_text, *self.notes, *(repairs or ["nothing to mend"])])


def clean_mesh(
    vertices: ArrayLike, faces: ArrayLike, surface: ArrayLike
) -> tuple[Mesh, MeshReport]:
    """Mesh fit to be cast at, and what was done to make it so.

    Faces without data, without area or given twice are dropped, coincident vertices merged,
    unused ones dropped, and the rest centred. Holes and inverted normals stay: rays see both sides
    of a face. Faces (m, 3) keep their order; vertices (n, 3) [m] are not finite where there is no
    data.

    ValueError where the arrays' shapes do not fit, a face names a vertex that does not exist,
    or no face is left.
    """
    positions, face_corners = np.array(vertices, dtype=np.float64), np.asarray(faces)
    surfaces = np.full(len(face_corners), surface) if np.ndim(surface) == 0 else np.asarray(surface)
    require_shapes(positions, face_corners, surfaces)
    n_vertices, n_faces = len(positions), len(face_corners)
    has_data = np.isfinite(positions)[face_corners].all(axis=(1, 2))
    face_corners, surfaces = face_corners[has_data], surfaces[has_data]
    _require_faces(len(face_corners), len(has_data))
    used = np.unique(face_corners)
    positions = positions[used] + 0.0  # -0 and 0 are one place
    kept_vertices, index_in_kept = _distinct_rows(positions)
    face_corners, merged = (
        index_in_kept[np.searchsorted(used, face_corners)],
        len(used) - len(kept_vertices),
    )
    positions = positions[kept_vertices]
    origin = exact_centre(positions)
    positions -= origin
    has_area = np.flatnonzero(_have_area(positions, face_corners))
    kept_faces = has_area[_distinct_rows(np.sort(face_corners[has_area], axis=1))[0]]
    _require_faces(len(kept_faces), len(has_data))
    kept_vertices = np.unique(face_corners[kept_faces])
    mesh = Mesh(
        positions[kept_vertices],
        np.searchsorted(kept_vertices, face_corners[kept_faces]),
        surfaces[kept_faces],
        origin,
    )
    return mesh, MeshReport(
        n_vertices=n_vertices,
        n_faces=n_faces,
        non_finite=int((~has_data).sum()),
        degenerate=len(face_corners) - len(has_area),
        duplicate=len(has_area) - len(kept_faces),
        merged=merged,
        unreferenced=n_vertices - merged - len(kept_vertices),
    )


def _require_faces(n_left: int, n_given: int) -> None:
    if n_left == 0:
        raise ValueError(f"of {n_given} faces none is left that a ray could hit")


def _distinct_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows that repeat no earlier one, by index, rising; and the place of every row among them."""
    order = np.lexsort(rows.T)  # stable: the first of those alike is the first given
    is_new = np.ones(len(rows), dtype=bool)
    is_new[1:] = (np.diff(rows[order], axis=0) != 0).any(axis=1)
    kept = np.sort(order[is_new])
    index_in_kept = np.empty(len(rows), dtype=np.int64)
    index_in_kept[order] = np.searchsorted(kept, order[is_new])[np.cumsum(is_new) - 1]
    return kept, index_in_kept


def _have_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mask of the faces (m, 3) whose corners are apart and not in one line, exactly."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    b, c = b - a, c - a
    longest = np.abs(b).max(axis=1) * np.abs(c).max(axis=1)
    has_area = np.asarray(np.abs(np.cross(b, c)).max(axis=1) > _AREA_ROUNDING * longest)
    doubtful_faces = np.flatnonzero(~has_area)
    exact_normals, _ = facet_normals(vertices[faces[doubtful_faces]].transpose(1, 2, 0))
    has_area[doubtful_faces] = exact_normals.any(axis=0)
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
    path = require_file(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_FORMATS:
        formats = ", ".join(MESH_FORMATS)
        raise SceneError(path, f"is no mesh of a format that is read ({formats})", "export to one")
    bytes_needed = _MEMORY_PER_FILE_BYTE[suffix] * path.stat().st_size
    require_memory(path, bytes_needed, "reduce the mesh, or cut a part out of it")
    try:
        reader = _read_polygon_file if suffix in POLYGON_FORMATS else _read_triangle_file
        parts, file_unit = reader(path)
    except SceneError:
        raise
    except ImportError as error:
        if (error.name or "").partition(".")[0] in _MESH_PACKAGES:
            raise
        remedy = "install what it asks for, or export to OBJ, PLY, STL or plain glTF"
        raise SceneError(path, f"needs another package ({error})", remedy) from None
    except Exception as error:  # parsers of several formats fail in as many ways
        problem, remedy = f"is no mesh that can be read ({error})", "check it, or export it again"
        raise SceneError(path, problem, remedy) from None
    if not parts:
        raise SceneError(path, "holds no triangles", "export a triangle mesh, not points or curves")
    is_y_up = suffix in _Y_UP_FORMATS if up is None else up == "y"
    rotation = axis_angle(0, math.pi / 2) if is_y_up else IDENTITY_QUATERNION
    return join_facets(parts).transform(
        rotation=rotation, scale=scale * _metres_per_unit(path, unit or file_unit)
    )


def _read_polygon_file(path: Path) -> tuple[list[Facets], str | None]:
    """Facets of a file of polygons, in the file's frame and unit, which it does not state."""
    polygons = read_polygons(path)
    triangulation = triangulate(polygons)
    if not len(triangulation.faces):
        return [], None
    return [
        replace(
            Facets.on_one_surface(polygons.vertices, triangulation.faces),
            notes=triangulation.notes(),
        )
    ], None


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
            resolver=_companion_resolver(path),
            process=False,
            skip_materials=True,  # nothing is seen of textures, which can be of any size
        )
    nodes = sorted(scene.graph.nodes_geometry)
    faces = [len(getattr(scene.geometry[scene.graph[node][1]], "faces", ())) for node in nodes]
    if sum(faces) > FACES_MAX:
        problem = f"places its meshes so often that they make {sum(faces):,} triangles"
        raise SceneError(path, problem, f"keep it below {FACES_MAX:.0e}")
    return [part for node in nodes for part in _iter_node_facets(scene, node)], scene.units


def _companion_resolver(path: Path) -> Any:
    """Trimesh's resolver of the names in a file, which serves plain files beside it alone."""
    from trimesh.resolvers import Resolver

    class CompanionResolver(Resolver):  # type: ignore[misc]
        """Files that a mesh names."""

        def __init__(self) -> None:
            pass

        def get(self, key: str) -> bytes:
            """Content of a file."""
            return read_companion(path, key)

        def write(self, name: str, data: bytes) -> None:
            """Refuse to write: the files that a mesh names are read alone."""
            raise PermissionError(f"{name}: a mesh's files are not written")

        def namespaced(self, namespace: str) -> CompanionResolver:
            """Return the same resolver, for names below a folder are none of a glTF's."""
            return self

        def keys(self) -> list[str]:
            """Names that are listed: none."""
            return []

    return CompanionResolver()


_STL_HEADER = struct.Struct("<80sI")
_STL_TRIANGLE_BYTES = 50
_STL_PROBE_BYTES = 1000
"""Bytes at the beginning of an STL that tell text from numbers."""


def _check_stl(path: Path) -> None:
    """Refuse a binary STL whose size is not that of its triangles; text has no zero bytes."""
    with path.open("rb") as file:
        first_bytes = file.read(_STL_PROBE_BYTES)
    if b"\0" not in first_bytes and re.search(rb"^\W*solid|\bfacet\b", first_bytes, re.I):
        return
    header = first_bytes[: _STL_HEADER.size]
    if len(header) < _STL_HEADER.size:
        raise ValueError(f"it has {len(header)} bytes, and a binary STL has 84 or more")
    count, size = _STL_HEADER.unpack(header)[1], path.stat().st_size
    bytes_needed = _STL_HEADER.size + _STL_TRIANGLE_BYTES * count
    if size != bytes_needed:
        raise ValueError(
            f"its header counts {count:,} triangles, which take {bytes_needed:,} bytes, and it has "
            f"{size:,}{': it is cut off' if size < bytes_needed else ''}"
        )


_GLB_HEADER = struct.Struct("<4sIIII")
_ACCESSOR_ELEMENT_BYTES_MAX = 64
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
    buffer_bytes = sum(int(buffer["byteLength"]) for buffer in document.get("buffers", []))
    counts = [int(accessor["count"]) for accessor in accessors]
    if min(counts, default=0) < 0:
        raise ValueError(f"it declares an array of {min(counts):,} elements")
    n_elements = sum(counts)
    if n_elements > max(buffer_bytes, 1):
        raise ValueError(f"its arrays have {n_elements:,} elements in {buffer_bytes:,} bytes")
    remedy = "reduce the mesh, or cut a part out of it"
    require_memory(path, n_elements * _ACCESSOR_ELEMENT_BYTES_MAX + buffer_bytes, remedy)


def _iter_node_facets(scene: Any, node: str) -> Iterator[Facets]:
    """Facets of one mesh of a file, in the file's frame; none of points and curves."""
    matrix, name = scene.graph[node]
    mesh = scene.geometry[name]
    if not len(getattr(mesh, "faces", ())):
        return
    vertices = np.asarray(mesh.vertices, float) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(mesh.faces, np.int64)
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]  # a mirrored part is inside out
    yield Facets.on_one_surface(vertices, faces)


def _metres_per_unit(path: Path, unit: str | None) -> float:
    """Metres of a unit of length; 1 where none is stated."""
    if unit is None:
        return 1.0
    try:
        return read_unit(unit, si_unit="m", example="mm").to_si(1)  # type: ignore[arg-type]
    except QuantityError as error:
        raise SceneError(path, f"has lengths in '{unit}' ({error})", "state a unit") from None


def sphere_facets(*, radius: float, subdivisions: int) -> Facets:
    """Return a refined icosahedron of 20 * 4^subdivisions faces, with its corners on the sphere."""
    import trimesh

    icosphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Facets.on_one_surface(np.asarray(icosphere.vertices), np.asarray(icosphere.faces))


def box_facets(*, size: Sequence[float]) -> Facets:
    """Return a box of 12 facets, facing outwards, of these lengths along x, y and z [m]."""
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * size
    faces = []
    for axis, side in itertools.product(range(3), (0, 1)):
        far, near = 4 >> ((axis + 1) % 3), 4 >> ((axis + 2) % 3)
        first = (4 >> axis) * side
        a, b, c, d = first, first + far, first + far + near, first + near
        faces += [(a, b, c), (a, c, d)] if side else [(a, c, b), (a, d, c)]
    return Facets.on_one_surface(corners, np.array(faces))
