"""Mesh files whose faces may have any number of corners: OBJ, PLY and OFF."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sweep.scenes.polygons import Polygons

_INDICES = ("vertex_indices", "vertex_index")
"""Names that writers of PLY give to the corners of a face."""


def read_polygons(path: Path) -> Polygons:
    """Vertices and faces of an OBJ, PLY or OFF file, as they are written; a ValueError for none."""
    return _READERS[path.suffix.lower()](path)


def _polygons(vertices: Any, faces: list[list[int]]) -> Polygons:
    counts = np.array([len(face) for face in faces], np.int64)
    corners = np.array([corner for face in faces for corner in face], np.int64)
    return Polygons(np.asarray(vertices, float).reshape(-1, 3), corners, counts)


def _read_obj(path: Path) -> Polygons:
    """Polygons of a Wavefront OBJ. Materials and textures are not looked for."""
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for number, words in _lines(path, continued="\\"):
        try:
            if words[0] == "v":
                x, y, z = words[1:4]
                vertices.append([float(x), float(y), float(z)])
            elif words[0] == "f":
                at = [int(word.partition("/")[0]) for word in words[1:]]
                if not at or 0 in at:
                    raise ValueError("a face names vertices from 1")
                # Below 0 an index counts back from the last vertex so far.
                faces.append([k - 1 if k > 0 else len(vertices) + k for k in at])
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None
    return _polygons(vertices, faces)


def _read_off(path: Path) -> Polygons:
    """Polygons of an OFF file; colours, normals and texture coordinates are passed over."""
    lines = _lines(path)
    number, words = next(lines, (1, [""]))
    heading = words[0].upper()
    if not heading.endswith("OFF") or heading.startswith(("4", "N4")) or "BINARY" in words:
        raise ValueError("it does not begin with OFF, or is of a kind that is not read")
    counts = words[1:] or next(lines, (number, []))[1]
    try:
        n_vertices, n_faces = int(counts[0]), int(counts[1])
        if min(n_vertices, n_faces) < 0:
            raise ValueError(f"it declares {n_vertices:,} vertices and {n_faces:,} faces")
        # Normals and colours follow the position; texture coordinates too, in most files.
        vertices = [
            [float(word) for word in line[:3]] for _, line in _next(lines, n_vertices, "vertices")
        ]
        faces = []
        for _, line in _next(lines, n_faces, "faces"):
            count = int(line[0])
            corners = [int(word) for word in line[1 : 1 + count]]
            if count < 1 or len(corners) < count:
                raise ValueError(f"a face of {count} corners lists {len(corners)}")
            faces.append(corners)
        if any(len(vertex) < 3 for vertex in vertices):
            raise ValueError("a vertex has fewer than three coordinates")
    except IndexError:
        raise ValueError("its numbers of vertices and faces are missing") from None
    return _polygons(vertices, faces)


def _next(
    lines: Iterator[tuple[int, list[str]]], number: int, kind: str
) -> Iterator[tuple[int, list[str]]]:
    """So many further lines."""
    for k in range(number):
        line = next(lines, None)
        if line is None:
            raise ValueError(f"it ends after {k:,} of {number:,} {kind}")
        yield line


def _lines(path: Path, continued: str = "") -> Iterator[tuple[int, list[str]]]:
    """Words of the lines that say something, with their numbers; '#' begins a comment."""
    whole = ""
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            text = whole + line.partition("#")[0].rstrip()
            if continued and text.endswith(continued):
                whole = text[:-1] + " "
                continue
            whole = ""
            if words := text.split():
                yield number, words


def _read_ply(path: Path) -> Polygons:
    """Polygons of a PLY file, ASCII or binary of either byte order."""
    from plyfile import PlyData, PlyElementParseError

    _require_rows(path)
    data: Any
    try:  # faces that are all of three corners are read many times faster
        triangles = {"face": dict.fromkeys(_INDICES, 3)}
        data = PlyData.read(str(path), mmap="c", known_list_len=triangles)
    except PlyElementParseError:
        data = PlyData.read(str(path), mmap="c")
    names = {element.name for element in data.elements}
    if "vertex" not in names:
        raise ValueError("it has no element 'vertex'")
    if "face" not in names:
        return _polygons([], [])
    lists = [p.name for p in data["face"].properties if p.name in _INDICES]
    if not lists:
        raise ValueError(f"its faces have none of the properties {', '.join(_INDICES)}")
    vertex, indices = data["vertex"], data["face"].data[lists[0]]
    vertices = np.stack([np.asarray(vertex[axis], float) for axis in "xyz"], axis=1)
    if indices.dtype != object:
        corners = np.array(indices, np.int64)
        return Polygons(vertices, corners.ravel(), np.full(len(corners), corners.shape[1]))
    counts = np.array([len(face) for face in indices], np.int64)
    corners = np.concatenate([*indices, np.empty(0, np.int64)]).astype(np.int64)
    return Polygons(vertices, corners, counts)


_HEADER_BYTES_MAX = 1 << 20
_WHOLE = re.compile(rb"[-+]?\d{1,4000}")


def _require_rows(path: Path) -> None:
    """Refuse a header that declares fewer rows than none, or more than the file has bytes."""
    size = path.stat().st_size
    with path.open("rb") as file:
        header, found, _ = file.read(_HEADER_BYTES_MAX).partition(b"end_header")
    if not found:
        raise ValueError("its header does not end")
    words = [line.split() for line in header.splitlines() if line.startswith(b"element")]
    counts = [(w[1], int(w[2])) for w in words if len(w) == 3 and _WHOLE.fullmatch(w[2])]
    for name, count in counts:
        if count < 0:
            raise ValueError(
                f"it declares {count:,} of the element '{name.decode(errors='replace')}'"
            )
    rows = sum(count for _, count in counts)
    if rows > size:
        raise ValueError(f"it declares {rows:,} vertices and faces in {size:,} bytes")


_READERS = {".obj": _read_obj, ".ply": _read_ply, ".off": _read_off}
POLYGON_FORMATS = frozenset(_READERS)
"""Suffixes of the formats that are read here."""
