"""Triangle meshes of scenes: read from files, made of solids, and cleaned for ray casting."""

from __future__ import annotations

import itertools
import json
import math
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.geometry.mesh import Mesh, facet_normals, require_consistent_mesh, rounded_centre
from sweep.model.geometry.quaternion import from_axis_angle, rotate
from sweep.scenes.polygon_files import POLYGON_FORMATS, read_polygon_file
from sweep.scenes.polygons import triangulate_polygons
from sweep.scenes.scene_files import SceneError, read_companion_file, require_file, require_memory
from sweep.units import QuantityError, read_unit

IDENTITY_QUATERNION = (1.0, 0.0, 0.0, 0.0)
"""Quaternion (w, x, y, z) that rotates nothing."""

_RELATIVE_NORMAL_ROUNDING_ERROR_MAX = 1e-12
"""Largest relative rounding error of the normal vector of a triangle without area.

The normal is the cross product of two edges. Its error is relative to the product of the lengths of
the edges.
"""

_Y_UP_FORMATS = {".glb", ".gltf"}
"""Suffixes of mesh formats whose specification has a vertical y axis.

All other formats are taken to have a vertical z axis.
"""

_TRIANGLES_ONLY_FORMATS = {".stl", *_Y_UP_FORMATS}
"""Suffixes of mesh formats that can only hold triangles."""

MESH_FORMATS = (".stl", ".obj", ".ply", ".off", ".gltf", ".glb")
"""Suffixes of the mesh formats that can be read.

Archives are excluded, because their content can be of any size.
"""

VERTEX_COORDINATE_MAX = 1e9
"""Largest magnitude of a vertex coordinate [m]."""

_MESH_READER_PACKAGES = {"mapbox_earcut", "plyfile", "trimesh"}
"""Names of packages needed to read a mesh; pip installs them with the extra `scenes`."""

MESH_FACES_MAX = 100_000_000
"""Largest number of triangles that a mesh file may have."""

_MEMORY_PER_FILE_BYTE_BY_SUFFIX = {
    ".obj": 40,
    ".off": 40,
    ".ply": 20,
    ".stl": 8,
    ".gltf": 20,
    ".glb": 20,
}
"""Memory needed to read a mesh, at most, in bytes per byte of its file, by the file's suffix."""


@dataclass(frozen=True, eq=False)
class Facets:
    """Triangles and their surface numbers, before :func:`clean_mesh`."""

    vertices: np.ndarray
    """Vertices (n, 3) relative to the origin [m].

    Terrain may lie millions of metres from the zero of its map: relative vertices keep their
    precision.
    """
    faces: np.ndarray
    """Vertex indices (m, 3) of the triangles, counter-clockwise seen from outside."""
    surface: np.ndarray
    """Surface number (m,) int16 of each triangle: an index into the scene's list of surfaces."""
    origin: np.ndarray
    """Origin (3,) of the vertices in world coordinates [m]."""
    reader_notes: tuple[str, ...] = ()
    """Sentences about changes that the reader of the mesh file made."""
    is_clean: bool = False
    """True if the triangles need no cleaning.

    Vertices and faces are distinct, all vertices are used, and all faces have an area.
    """

    @classmethod
    def from_triangles(
        cls,
        vertices: np.ndarray,
        faces: np.ndarray,
        *,
        surface: int = 0,
        origin: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    ) -> Facets:
        """Return facets that all belong to one surface.

        Parameters
        ----------
        vertices : ndarray, shape (..., 3)
            Vertices relative to the origin [m].
        faces : ndarray, shape (..., 3)
            Vertex indices of the triangles.
        surface : int
            Surface number.
        origin : sequence of float
            Origin (3,) of the vertices [m].
        """
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
        """Return scaled facets that are rotated about their origin after scaling.

        Parameters
        ----------
        rotation : sequence of float
            Quaternion (w, x, y, z).
        scale : float
            Factor on all vertices.
        """
        return replace(self, vertices=rotate(np.asarray(rotation, float), self.vertices * scale))

    def to_cleaned_mesh(self) -> CleanedMesh:
        """Clean the triangles. Return a mesh for ray casting, and a report of the cleaning.

        Raises
        ------
        ValueError
            If a vertex lies beyond `VERTEX_COORDINATE_MAX`, or no face is left.
        """
        with np.errstate(invalid="ignore"):
            is_too_far = np.abs(self.vertices) > VERTEX_COORDINATE_MAX
        if is_too_far.any():
            far_vertex = self.vertices[is_too_far][0]
            raise ValueError(
                f"a vertex lies at {far_vertex:.3g} m, farther than "
                f"{VERTEX_COORDINATE_MAX:.0e} m from zero"
            )
        if self.is_clean:
            _require_faces(len(self.faces), len(self.faces))
            centre = rounded_centre(self.vertices)
            mesh = Mesh(self.vertices - centre, self.faces, self.surface, centre + self.origin)
            report = MeshCleaningReport(
                len(self.vertices), len(self.faces), reader_notes=self.reader_notes
            )
            return CleanedMesh(mesh, report)
        mesh, report = clean_mesh(self.vertices, self.faces, self.surface)
        report = replace(report, reader_notes=self.reader_notes)
        return CleanedMesh(replace(mesh, origin=mesh.origin + self.origin), report)


def join_facets(facets_list: Sequence[Facets]) -> Facets:
    """Join one or more sets of facets into one, which has the origin of the first set."""
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
        tuple(note for facets in facets_list for note in facets.reader_notes),
    )


_REPAIR_TEXT_BY_REPORT_FIELD = {
    "n_non_finite_faces": "{} faces without data dropped",
    "n_degenerate_faces": "{} faces without area dropped",
    "n_duplicate_faces": "{} duplicate faces dropped",
    "n_merged_vertices": "{} coincident vertices merged",
    "n_unreferenced_vertices": "{} unused vertices dropped",
}
"""Templates of sentences about repairs, by the field of `MeshCleaningReport` with their number."""


@dataclass(frozen=True)
class MeshCleaningReport:
    """Numbers of vertices and faces of a mesh, and of the repairs by `clean_mesh`."""

    n_vertices_before: int
    """Number of vertices before cleaning."""
    n_faces_before: int
    """Number of faces before cleaning."""
    n_non_finite_faces: int = 0
    """Number of faces dropped because a vertex is not finite."""
    n_degenerate_faces: int = 0
    """Number of faces dropped because corners coincide or are collinear."""
    n_duplicate_faces: int = 0
    """Number of faces dropped because another face has the same corners, in any order."""
    n_merged_vertices: int = 0
    """Number of vertices merged with a coincident vertex."""
    n_unreferenced_vertices: int = 0
    """Number of vertices dropped because no face uses them."""
    reader_notes: tuple[str, ...] = ()
    """Sentences about changes that the reader of the mesh file made."""

    def summary(self) -> str:
        """Return a text with the numbers of faces and vertices before cleaning, and of repairs."""
        counts = [
            (template, getattr(self, name))
            for name, template in _REPAIR_TEXT_BY_REPORT_FIELD.items()
        ]
        repairs = [template.format(count) for template, count in counts if count]
        input_text = f"{self.n_faces_before:,} faces on {self.n_vertices_before:,} vertices"
        return "; ".join([input_text, *self.reader_notes, *(repairs or ["nothing to mend"])])


class CleanedMesh(NamedTuple):
    """Mesh that is ready for ray casting, and the report of its cleaning."""

    mesh: Mesh
    """Mesh with the faces that cleaning has left, in the order in which they were passed."""
    report: MeshCleaningReport
    """Numbers of vertices and faces before cleaning, and numbers of repairs."""


def clean_mesh(vertices: ArrayLike, faces: ArrayLike, surface: ArrayLike) -> CleanedMesh:
    """Clean triangles for ray casting.

    Faces that are not finite, have no area or occur twice are dropped. Coincident vertices are
    merged, unused vertices dropped and the rest centred. Holes and inverted normals remain: rays
    hit both sides of a face.

    Parameters
    ----------
    vertices : array_like, shape (n, 3)
        Vertices [m]; not finite where there is no data.
    faces : array_like, shape (m, 3)
        Vertex indices of the triangles.
    surface : array_like, shape (m,) or ()
        Surface numbers of the triangles.

    Returns
    -------
    CleanedMesh
        Mesh with faces in the given order, and counts of repairs.

    Raises
    ------
    ValueError
        If the arrays' shapes are inconsistent, a face has an invalid vertex index, or no face is
        left.
    """
    positions, face_corners = np.array(vertices, dtype=np.float64), np.asarray(faces)
    surfaces = np.full(len(face_corners), surface) if np.ndim(surface) == 0 else np.asarray(surface)
    require_consistent_mesh(positions, face_corners, surfaces)
    n_vertices_before, n_faces_before = len(positions), len(face_corners)
    has_data = np.isfinite(positions)[face_corners].all(axis=(1, 2))
    face_corners, surfaces = face_corners[has_data], surfaces[has_data]
    _require_faces(len(face_corners), len(has_data))
    used = np.unique(face_corners)
    positions = positions[used] + 0.0  # -0.0 and 0.0 are equal positions
    kept_vertices, index_in_kept = _find_unique_rows(positions)
    face_corners, n_merged_vertices = (
        index_in_kept[np.searchsorted(used, face_corners)],
        len(used) - len(kept_vertices),
    )
    positions = positions[kept_vertices]
    origin = rounded_centre(positions)
    positions -= origin
    has_area = np.flatnonzero(_nonzero_area_mask(positions, face_corners))
    kept_faces = has_area[_find_unique_rows(np.sort(face_corners[has_area], axis=1))[0]]
    _require_faces(len(kept_faces), len(has_data))
    kept_vertices = np.unique(face_corners[kept_faces])
    mesh = Mesh(
        positions[kept_vertices],
        np.searchsorted(kept_vertices, face_corners[kept_faces]),
        surfaces[kept_faces],
        origin,
    )
    report = MeshCleaningReport(
        n_vertices_before=n_vertices_before,
        n_faces_before=n_faces_before,
        n_non_finite_faces=int((~has_data).sum()),
        n_degenerate_faces=len(face_corners) - len(has_area),
        n_duplicate_faces=len(has_area) - len(kept_faces),
        n_merged_vertices=n_merged_vertices,
        n_unreferenced_vertices=n_vertices_before - n_merged_vertices - len(kept_vertices),
    )
    return CleanedMesh(mesh, report)


def _require_faces(n_left: int, n_given: int) -> None:
    """Raise `ValueError` if cleaning has left none of `n_given` faces."""
    if n_left == 0:
        raise ValueError(f"of {n_given} faces none is left that a ray could hit")


def _find_unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the distinct rows of an array (n, columns).

    Returns
    -------
    kept : ndarray
        Indices of the first occurrence of each distinct row, in rising order.
    index_in_kept : ndarray
        For each of the n rows, the position in `kept` of the equal row.
    """
    order = np.lexsort(rows.T)  # stable: the first of equal rows is kept
    is_new = np.ones(len(rows), dtype=bool)
    is_new[1:] = (np.diff(rows[order], axis=0) != 0).any(axis=1)
    kept = np.sort(order[is_new])
    index_in_kept = np.empty(len(rows), dtype=np.int64)
    index_in_kept[order] = np.searchsorted(kept, order[is_new])[np.cumsum(is_new) - 1]
    return kept, index_in_kept


def _nonzero_area_mask(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return a mask (m,) of the triangles with an area above 0.

    Areas close to rounding errors are computed exactly.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    b, c = b - a, c - a
    longest = np.abs(b).max(axis=1) * np.abs(c).max(axis=1)
    has_area = np.asarray(
        np.abs(np.cross(b, c)).max(axis=1) > _RELATIVE_NORMAL_ROUNDING_ERROR_MAX * longest
    )
    doubtful_faces = np.flatnonzero(~has_area)
    exact_normals, _ = facet_normals(vertices[faces[doubtful_faces]].transpose(1, 2, 0))
    has_area[doubtful_faces] = exact_normals.any(axis=0)
    return has_area


def read_mesh_facets(
    path: str | Path, *, unit: str | None = None, up: str | None = None, scale: float = 1.0
) -> Facets:
    """Read all parts of a mesh file as facets, which are not cleaned.

    Polygons are cut into triangles (:mod:`sweep.scenes.polygons`).

    Parameters
    ----------
    path : str or Path
        File of one of `MESH_FORMATS`.
    unit : str, optional
        Unit of lengths; by default that of the file, or else metres.
    up : str, optional
        Vertical axis, ``y`` or ``z``; by default y for glTF and z for other formats.
    scale : float
        Factor on all lengths.

    Returns
    -------
    Facets
        Triangles of one surface, in metres, with z up.

    Raises
    ------
    SceneError
        If the file is missing, can't be read or has no triangles, if a polygon does not define a
        surface, or if the unit is unknown.
    """
    path = require_file(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_FORMATS:
        formats = ", ".join(MESH_FORMATS)
        raise SceneError(path, f"is no mesh of a format that is read ({formats})", "export to one")
    bytes_needed = _MEMORY_PER_FILE_BYTE_BY_SUFFIX[suffix] * path.stat().st_size
    require_memory(path, bytes_needed, "reduce the mesh, or cut a part out of it")
    try:
        reader = _read_polygon_facets if suffix in POLYGON_FORMATS else _read_triangle_facets
        parts, file_unit = reader(path)
    except SceneError:
        raise
    except ImportError as error:
        if (error.name or "").partition(".")[0] in _MESH_READER_PACKAGES:
            raise
        remedy = "install what it asks for, or export to OBJ, PLY, STL or plain glTF"
        raise SceneError(path, f"needs another package ({error})", remedy) from None
    except Exception as error:  # parsers of several formats raise many types of errors
        problem, remedy = f"is no mesh that can be read ({error})", "check it, or export it again"
        raise SceneError(path, problem, remedy) from None
    if not parts:
        raise SceneError(path, "holds no triangles", "export a triangle mesh, not points or curves")
    is_y_up = suffix in _Y_UP_FORMATS if up is None else up == "y"
    rotation = from_axis_angle(0, math.pi / 2) if is_y_up else IDENTITY_QUATERNION
    return join_facets(parts).transform(
        rotation=rotation, scale=scale * _metres_per_unit(path, unit or file_unit)
    )


def _read_polygon_facets(path: Path) -> tuple[list[Facets], str | None]:
    """Read a file of polygons, and cut them into triangles.

    Returns
    -------
    facets : list of Facets
        The facets in the coordinates of the file; empty if there are none.
    unit : None
        Such files state no unit of length.
    """
    polygons = read_polygon_file(path)
    triangulation = triangulate_polygons(polygons)
    if not len(triangulation.faces):
        return [], None
    return [
        replace(
            Facets.from_triangles(polygons.vertices, triangulation.faces),
            reader_notes=triangulation.summary_sentences(),
        )
    ], None


def _read_triangle_facets(path: Path) -> tuple[list[Facets], str | None]:
    """Read the meshes of a glTF or STL file.

    Returns
    -------
    facets : list of Facets
        Facets of each mesh of the file's scene, in the coordinates of the file.
    unit : str or None
        Unit of length that the file states.
    """
    import trimesh

    if path.suffix.lower() in _Y_UP_FORMATS:
        _check_gltf(path)
    else:
        _check_stl(path)
    with path.open("rb") as file:
        scene: Any = trimesh.load_scene(
            file,
            file_type=path.suffix.lower()[1:],
            resolver=_make_companion_resolver(path),
            process=False,
            skip_materials=True,  # textures have no effect and can be of any size
        )
    nodes = sorted(scene.graph.nodes_geometry)
    faces = [len(getattr(scene.geometry[scene.graph[node][1]], "faces", ())) for node in nodes]
    if sum(faces) > MESH_FACES_MAX:
        problem = f"places its meshes so often that they make {sum(faces):,} triangles"
        raise SceneError(path, problem, f"keep it below {MESH_FACES_MAX:.0e}")
    return [part for node in nodes for part in _iter_node_facets(scene, node)], scene.units


def _make_companion_resolver(path: Path) -> Any:
    """Return an object through which trimesh reads the files that a mesh file refers to.

    The object reads plain files only. Their paths are relative to the mesh file.
    """
    from trimesh.resolvers import Resolver

    class CompanionResolver(Resolver):  # type: ignore[misc]
        """Reader of the plain files that a mesh file names."""

        def __init__(self) -> None:
            pass

        def get(self, key: str) -> bytes:
            """Return the content of the file with a name."""
            return read_companion_file(path, key)

        def write(self, name: str, data: bytes) -> None:
            """Raise `PermissionError`, because the files that a mesh names are only read."""
            raise PermissionError(f"{name}: a mesh's files are not written")

        def namespaced(self, namespace: str) -> CompanionResolver:
            """Return this object, because a glTF has no names below a folder."""
            return self

        def keys(self) -> list[str]:
            """Return an empty list, because the files are not known in advance."""
            return []

    return CompanionResolver()


_STL_HEADER_STRUCT = struct.Struct("<80sI")
"""Layout of the header of a binary STL: 80 bytes of text, and the number of triangles."""
_STL_TRIANGLE_BYTES = 50
"""Number of bytes of one triangle in a binary STL."""
_STL_PROBE_BYTES = 1000
"""Number of bytes at the start of an STL file from which text and binary files are told apart."""


def _check_stl(path: Path) -> None:
    """Raise `ValueError` if the size of a binary STL file does not match its number of triangles.

    A text STL is not checked. It is recognised by its keywords and by the absence of zero bytes.
    """
    with path.open("rb") as file:
        first_bytes = file.read(_STL_PROBE_BYTES)
    if b"\0" not in first_bytes and re.search(rb"^\W*solid|\bfacet\b", first_bytes, re.I):
        return
    header = first_bytes[: _STL_HEADER_STRUCT.size]
    if len(header) < _STL_HEADER_STRUCT.size:
        raise ValueError(f"it has {len(header)} bytes, and a binary STL has 84 or more")
    count, size = _STL_HEADER_STRUCT.unpack(header)[1], path.stat().st_size
    bytes_needed = _STL_HEADER_STRUCT.size + _STL_TRIANGLE_BYTES * count
    if size != bytes_needed:
        raise ValueError(
            f"its header counts {count:,} triangles, which take {bytes_needed:,} bytes, and it has "
            f"{size:,}{': it is cut off' if size < bytes_needed else ''}"
        )


_GLB_HEADER_STRUCT = struct.Struct("<4sIIII")
"""Layout of the header of a binary glTF, followed by the header of its first chunk."""
_GLTF_ACCESSOR_ELEMENT_BYTES_MAX = 64
"""Size of the largest possible element of a glTF array, a matrix of 16 floats [bytes]."""


def _check_gltf(path: Path) -> None:
    """Raise an error if a glTF file is invalid, or its arrays exceed its data or the memory."""
    content = path.read_bytes()
    if path.suffix.lower() == ".glb":
        if len(content) < _GLB_HEADER_STRUCT.size:
            raise ValueError("it is cut off")
        magic, version, _, length, _ = _GLB_HEADER_STRUCT.unpack_from(content)
        if magic != b"glTF" or version != 2:
            raise ValueError("it is no binary glTF of version 2")
        content = content[_GLB_HEADER_STRUCT.size : _GLB_HEADER_STRUCT.size + length]
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
    require_memory(path, n_elements * _GLTF_ACCESSOR_ELEMENT_BYTES_MAX + buffer_bytes, remedy)


def _iter_node_facets(scene: Any, node: str) -> Iterator[Facets]:
    """Yield the facets of a node of a mesh file's scene graph, in the coordinates of the file.

    A node of points or curves yields nothing.
    """
    matrix, name = scene.graph[node]
    mesh = scene.geometry[name]
    if not len(getattr(mesh, "faces", ())):
        return
    vertices = np.asarray(mesh.vertices, float) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(mesh.faces, np.int64)
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]  # a mirrored part has inverted normals
    yield Facets.from_triangles(vertices, faces)


def _metres_per_unit(path: Path, unit: str | None) -> float:
    """Return the length of a unit [m], given its name; 1 if `unit` is None."""
    if unit is None:
        return 1.0
    try:
        return read_unit(unit, si_unit="m", example="mm").to_si(1)  # type: ignore[arg-type]
    except QuantityError as error:
        raise SceneError(path, f"has lengths in '{unit}' ({error})", "state a unit") from None


def sphere_facets(*, radius: float, subdivisions: int) -> Facets:
    """Return a sphere as facets: a refined icosahedron whose vertices lie on the sphere.

    Parameters
    ----------
    radius : float
        Radius [m].
    subdivisions : int
        Number of times that each face is cut into four; there are 20 * 4^subdivisions faces.
    """
    import trimesh

    icosphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Facets.from_triangles(np.asarray(icosphere.vertices), np.asarray(icosphere.faces))


def box_facets(*, size: Sequence[float]) -> Facets:
    """Return a box as 12 outward-facing triangles, centred at its origin.

    Parameters
    ----------
    size : sequence of float
        Lengths along x, y and z [m].
    """
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * size
    faces = []
    for axis, side in itertools.product(range(3), (0, 1)):
        far, near = 4 >> ((axis + 1) % 3), 4 >> ((axis + 2) % 3)
        first = (4 >> axis) * side
        a, b, c, d = first, first + far, first + far + near, first + near
        faces += [(a, b, c), (a, c, d)] if side else [(a, c, b), (a, d, c)]
    return Facets.from_triangles(corners, np.array(faces))
