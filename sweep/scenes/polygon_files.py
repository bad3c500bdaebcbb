"""Readers of mesh files whose faces may have any number of corners: OBJ, PLY and OFF."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sweep.scenes.polygons import Polygons

_PLY_INDEX_PROPERTIES = ("vertex_indices", "vertex_index")
"""Names that PLY files use for the list of vertex indices of a face."""


def read_polygon_file(path: Path) -> Polygons:
    """Return the vertices and polygons of an OBJ, PLY or OFF file.

    Raises
    ------
    ValueError
        If the file is invalid.
    """
    return _READER_BY_SUFFIX[path.suffix.lower()](path)


def _make_polygons(vertices: Any, faces: list[list[int]]) -> Polygons:
    """Return a `Polygons` record of vertices and faces, which are lists of vertex indices."""
    counts = np.array([len(face) for face in faces], np.int64)
    corners = np.array([corner for face in faces for corner in face], np.int64)
    return Polygons(np.asarray(vertices, float).reshape(-1, 3), corners, counts)


def _read_obj(path: Path) -> Polygons:
    """Return the polygons of a Wavefront OBJ file; materials and textures are ignored."""
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for number, words in _iter_line_words(path, continuation_mark="\\"):
        try:
            if words[0] == "v":
                x, y, z = words[1:4]
                vertices.append([float(x), float(y), float(z)])
            elif words[0] == "f":
                indices = [int(word.partition("/")[0]) for word in words[1:]]
                if not indices or 0 in indices:
                    raise ValueError("a face names vertices from 1")
                # A negative index counts back from the last vertex read.
                faces.append([k - 1 if k > 0 else len(vertices) + k for k in indices])
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None
    return _make_polygons(vertices, faces)


def _read_off(path: Path) -> Polygons:
    """Return the polygons of an OFF file; colours, normals and texture coordinates are ignored."""
    lines = _iter_line_words(path)
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
            [float(word) for word in line[:3]]
            for _, line in _iter_next_lines(lines, n_vertices, "vertices")
        ]
        faces = []
        for _, line in _iter_next_lines(lines, n_faces, "faces"):
            count = int(line[0])
            corners = [int(word) for word in line[1 : 1 + count]]
            if count < 1 or len(corners) < count:
                raise ValueError(f"a face of {count} corners lists {len(corners)}")
            faces.append(corners)
        if any(len(vertex) < 3 for vertex in vertices):
            raise ValueError("a vertex has fewer than three coordinates")
    except IndexError:
        raise ValueError("its numbers of vertices and faces are missing") from None
    return _make_polygons(vertices, faces)


def _iter_next_lines(
    lines: Iterator[tuple[int, list[str]]], number: int, element_name: str
) -> Iterator[tuple[int, list[str]]]:
    """Yield the next `number` of a file's `lines`; raise `ValueError` if the file has fewer.

    `element_name` is what the lines describe, for the error.
    """
    for k in range(number):
        line = next(lines, None)
        if line is None:
            raise ValueError(f"it ends after {k:,} of {number:,} {element_name}")
        yield line


def _iter_line_words(path: Path, continuation_mark: str = "") -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the words of each line of a text file that is not empty.

    A comment begins with '#'. A line that ends with `continuation_mark` is joined to the next one.
    """
    continued_text = ""
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            text = continued_text + line.partition("#")[0].rstrip()
            if continuation_mark and text.endswith(continuation_mark):
                continued_text = text[:-1] + " "
                continue
            continued_text = ""
            if words := text.split():
                yield number, words


def _read_ply(path: Path) -> Polygons:
    """Return the polygons of a PLY file, ASCII or binary of either byte order."""
    from plyfile import PlyData, PlyElementParseError

    _check_ply_row_counts(path)
    data: Any
    try:  # files with triangles only are read many times faster this way
        triangles = {"face": dict.fromkeys(_PLY_INDEX_PROPERTIES, 3)}
        data = PlyData.read(str(path), mmap="c", known_list_len=triangles)
    except PlyElementParseError:
        data = PlyData.read(str(path), mmap="c")
    names = {element.name for element in data.elements}
    if "vertex" not in names:
        raise ValueError("it has no element 'vertex'")
    if "face" not in names:
        return _make_polygons([], [])
    index_properties = [p.name for p in data["face"].properties if p.name in _PLY_INDEX_PROPERTIES]
    if not index_properties:
        raise ValueError(
            f"its faces have none of the properties {', '.join(_PLY_INDEX_PROPERTIES)}"
        )
    vertex, indices = data["vertex"], data["face"].data[index_properties[0]]
    vertices = np.stack([np.asarray(vertex[axis], float) for axis in "xyz"], axis=1)
    if indices.dtype != object:
        corners = np.array(indices, np.int64)
        return Polygons(vertices, corners.ravel(), np.full(len(corners), corners.shape[1]))
    counts = np.array([len(face) for face in indices], np.int64)
    corners = np.concatenate([*indices, np.empty(0, np.int64)]).astype(np.int64)
    return Polygons(vertices, corners, counts)


_PLY_HEADER_BYTES_MAX = 1 << 20
"""Largest permitted size of a PLY header [bytes]."""
_INTEGER_PATTERN = re.compile(rb"[-+]?\d{1,4000}")
"""Regular expression for an integer in a PLY header."""


def _check_ply_row_counts(path: Path) -> None:
    """Raise `ValueError` if the header of a PLY file declares an impossible number of rows.

    A number is impossible if it is negative, or exceeds the size of the file in bytes.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header, end_mark, _ = file.read(_PLY_HEADER_BYTES_MAX).partition(b"end_header")
    if not end_mark:
        raise ValueError("its header does not end")
    words = [line.split() for line in header.splitlines() if line.startswith(b"element")]
    counts = [
        (element_words[1], int(element_words[2]))
        for element_words in words
        if len(element_words) == 3 and _INTEGER_PATTERN.fullmatch(element_words[2])
    ]
    for name, count in counts:
        if count < 0:
            raise ValueError(
                f"it declares {count:,} of the element '{name.decode(errors='replace')}'"
            )
    rows = sum(count for _, count in counts)
    if rows > size:
        raise ValueError(f"it declares {rows:,} vertices and faces in {size:,} bytes")


_READER_BY_SUFFIX = {".obj": _read_obj, ".ply": _read_ply, ".off": _read_off}
"""Functions that read polygons from a file, by the file's suffix."""
POLYGON_FORMATS = frozenset(_READER_BY_SUFFIX)
"""Suffixes of the polygon file formats that can be read."""
