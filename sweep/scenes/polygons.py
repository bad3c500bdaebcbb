"""Triangulation of the polygons of mesh files.

A polygon is projected to its mean plane (Newell's normal). A convex polygon becomes a fan about its
first corner. Any other polygon is cut by Mapbox's earcut, and the result is checked: the areas of
the triangles must sum to the polygon's area, and the polygon must wind about each triangle once. A
polygon that crosses itself, or has a hole with the winding of its outline, fails the check and is
refused with its number.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

BEND_REPORTED_MIN = 1e-3
"""Departure from the mean plane, relative to the square root of the area, that is reported."""

BEND_MAX = 0.25
"""Departure from the mean plane, relative to the square root of the area, above which a polygon is
refused: its surface is undetermined.
"""

_AREA_ROUNDING = 1e-12
"""Ratio of area to squared extent below which an area may be due to rounding."""

_AREA_TOLERANCE = 1e-9
"""Relative difference between the areas of triangles and polygon that may be due to rounding."""


class PolygonError(ValueError):
    """Error of a polygon that can't be triangulated, with its number in the file, from 1."""

    def __init__(self, number: int, problem: str) -> None:
        super().__init__(f"face {number} {problem}")


class Polygons(NamedTuple):
    """Polygons with common vertices."""

    vertices: np.ndarray
    """Vertices (n, 3), float64."""
    corners: np.ndarray
    """Vertex indices (sum of counts,) int64 of all polygons, one polygon after the other."""
    counts: np.ndarray
    """Number of corners (m,) int64 of each polygon."""


class Triangulation(NamedTuple):
    """Triangles of polygons, in the polygons' order and winding."""

    faces: np.ndarray
    """Vertex indices (k, 3) int64 of the triangles."""
    n_cut: int
    """Number of polygons with more than three corners."""
    n_concave: int
    """Number of polygons with more than three corners that are not convex."""
    n_bent: int
    """Number of polygons that depart from their mean plane by more than `BEND_REPORTED_MIN`."""
    largest_bend: float
    """Largest departure of a bent polygon from its mean plane [unit of the vertices]."""

    def notes(self) -> tuple[str, ...]:
        """Return sentences about the polygons that were cut, with lengths in the file's unit."""
        if not self.n_cut:
            return ()
        concave_text = f", {self.n_concave:,} of them not convex" if self.n_concave else ""
        notes = [f"{_polygon_count_text(self.n_cut)} cut into triangles{concave_text}"]
        if self.n_bent:
            verb = "departs" if self.n_bent == 1 else "depart"
            notes.append(
                f"{_polygon_count_text(self.n_bent)} {verb} from a plane by up to "
                f"{self.largest_bend:.3g} units"
            )
        return tuple(notes)


def _polygon_count_text(polygons: int) -> str:
    """Return a number of polygons as text."""
    return f"{polygons:,} polygon{'s' * (polygons != 1)}"


def triangulate(polygons: Polygons) -> Triangulation:
    """Cut polygons into triangles.

    A polygon without area, or with a vertex that is not finite, becomes triangles of the same kind,
    which :func:`sweep.scenes.meshes.clean_mesh` drops and counts.

    Parameters
    ----------
    polygons : Polygons
        Polygons as read from a file.

    Returns
    -------
    Triangulation
        Triangles and counts.

    Raises
    ------
    PolygonError
        If a polygon crosses itself, is bent by more than `BEND_MAX`, or has an invalid vertex
        index.
    """
    vertices, corners, counts = polygons
    first_corner = np.cumsum(counts) - counts
    wrong_corners = np.flatnonzero((corners < 0) | (corners >= len(vertices)))
    if wrong_corners.size:
        face = int(np.searchsorted(first_corner, wrong_corners[0], side="right")) - 1
        problem = f"names the vertex {corners[wrong_corners[0]] + 1} of {len(vertices):,}"
        raise PolygonError(face + 1, problem)
    triangles: list[np.ndarray] = []
    polygon_of_triangle: list[np.ndarray] = []
    n_cut = n_concave = n_bent = 0
    largest_bend = 0.0
    for n_corners in np.unique(counts):
        polygon_numbers = np.flatnonzero(counts == n_corners)
        corner_vertices = corners[first_corner[polygon_numbers, None] + np.arange(n_corners)]
        if n_corners <= 3:  # one or two corners have no area
            triangles.append(
                np.take(corner_vertices, [0, min(1, n_corners - 1), n_corners - 1], axis=1)
            )
            polygon_of_triangle.append(polygon_numbers)
            continue
        flat_polygons = _flatten(vertices[corner_vertices], polygon_numbers)
        n_cut += len(polygon_numbers)
        n_concave += int((~flat_polygons.is_convex & ~flat_polygons.is_empty).sum())
        is_bent = flat_polygons.bend > BEND_REPORTED_MIN
        n_bent += int(is_bent.sum())
        largest_bend = max(
            largest_bend,
            float((flat_polygons.bend * np.sqrt(flat_polygons.area))[is_bent].max(initial=0.0)),
        )
        # Empty polygons become fans too: clean_mesh drops and counts their triangles without area.
        fanned = np.flatnonzero(flat_polygons.is_convex | flat_polygons.is_empty)
        fan = np.stack(
            [np.zeros(n_corners - 2, int), np.arange(1, n_corners - 1), np.arange(2, n_corners)],
            axis=1,
        )
        triangles.append(corner_vertices[fanned][:, fan].reshape(-1, 3))
        polygon_of_triangle.append(np.repeat(polygon_numbers[fanned], n_corners - 2))
        for k in np.flatnonzero(~(flat_polygons.is_convex | flat_polygons.is_empty)):
            part_triangles = _triangulate_polygon(
                flat_polygons.corners[k], vertices[corner_vertices[k]], int(polygon_numbers[k]) + 1
            )
            triangles.append(corner_vertices[k][part_triangles])
            polygon_of_triangle.append(np.full(len(part_triangles), polygon_numbers[k]))
    if not triangles:
        return Triangulation(np.empty((0, 3), np.int64), 0, 0, 0, 0.0)
    order = np.argsort(np.concatenate(polygon_of_triangle), kind="stable")
    return Triangulation(np.concatenate(triangles)[order], n_cut, n_concave, n_bent, largest_bend)


class _FlatPolygons(NamedTuple):
    """Polygons of n corners each, projected to their mean planes."""

    corners: np.ndarray
    """Corners (m, n, 2) in the plane, counter-clockwise."""
    area: np.ndarray
    """Areas (m,)."""
    bend: np.ndarray
    """Largest departures (m,) from the plane, relative to the square root of the area."""
    is_convex: np.ndarray
    """Mask (m,) of the strictly convex polygons."""
    is_empty: np.ndarray
    """Mask (m,) of the polygons without area or with vertices that are not finite."""


def _flatten(points: np.ndarray, polygon_numbers: np.ndarray) -> _FlatPolygons:
    """Project polygons (m, n, 3) to their mean planes.

    `polygon_numbers` (m,) are their indices in the file, for errors.
    """
    has_data = np.isfinite(points).all(axis=(1, 2))
    points = np.where(has_data[:, None, None], points, 0.0)
    points = points - points[:, :1]
    next_points = np.roll(points, -1, axis=1)
    extent = np.sqrt((points * points).sum(axis=2)).max(axis=1)
    area_vector = 0.5 * np.cross(points, next_points).sum(axis=1)
    area = np.sqrt((area_vector * area_vector).sum(axis=1))
    has_area = area > _AREA_ROUNDING * extent * extent
    is_collinear = _are_collinear(points, extent)
    if (is_folded := ~has_area & ~is_collinear).any():
        raise PolygonError(int(polygon_numbers[is_folded.argmax()]) + 1, "crosses itself")
    is_empty = ~has_data | is_collinear
    normal = np.where(
        is_empty[:, None], [0.0, 0.0, 1.0], area_vector / np.where(is_empty, 1.0, area)[:, None]
    )
    in_plane_axis = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    in_plane_axis /= np.sqrt((in_plane_axis * in_plane_axis).sum(axis=1))[:, None]
    axes = np.stack([in_plane_axis, np.cross(normal, in_plane_axis), normal], axis=2)
    flat = points @ axes
    height = flat[..., 2] - flat[..., 2].mean(axis=1)[:, None]
    bend = np.abs(height).max(axis=1) / np.sqrt(np.where(is_empty, 1.0, area))
    bend[is_empty] = 0.0
    if (bend > BEND_MAX).any():
        k = int((bend > BEND_MAX).argmax())
        problem = f"is bent by {100 * bend[k]:.0f} % of its size, so its surface is not determined"
        raise PolygonError(int(polygon_numbers[k]) + 1, problem)
    corners = flat[..., :2]
    edge = np.roll(corners, -1, axis=1) - corners
    previous_edge = np.roll(edge, 1, axis=1)
    edge_cross = previous_edge[..., 0] * edge[..., 1] - previous_edge[..., 1] * edge[..., 0]
    total_angle = np.arctan2(edge_cross, (previous_edge * edge).sum(axis=2)).sum(axis=1)
    is_convex = (edge_cross > _AREA_ROUNDING * (extent * extent)[:, None]).all(axis=1) & (
        total_angle < 3 * np.pi
    )
    return _FlatPolygons(corners, area, bend, is_convex & ~is_empty, is_empty)


def _are_collinear(points: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Return a mask (m,) of the polygons (m, n, 3), relative to a corner, that are collinear."""
    squared_distance = (points * points).sum(axis=2)
    farthest = points[np.arange(len(points)), squared_distance.argmax(axis=1)]
    cross_product = np.cross(points, farthest[:, None])
    distance = np.sqrt((cross_product * cross_product).sum(axis=2)).max(axis=1)
    return np.asarray(distance <= _AREA_ROUNDING * extent * extent)


def _triangulate_polygon(plane_corners: np.ndarray, points: np.ndarray, number: int) -> np.ndarray:
    """Return the triangles (k, 3) of a polygon, given by corners (n, 2) and points (n, 3).

    `plane_corners` are the corners in the polygon's plane, `points` the corners in space.
    """
    import mapbox_earcut

    # Drop corners that repeat the previous corner.
    kept = np.flatnonzero((points != np.roll(points, 1, axis=0)).any(axis=1))
    corners = np.ascontiguousarray(plane_corners[kept])
    ring_ends = np.array([len(corners)], np.uint32)
    triangles = (
        mapbox_earcut.triangulate_float64(corners, ring_ends).reshape(-1, 3).astype(np.int64)
    )
    area = _triangle_areas(corners, triangles)
    triangles[area < 0] = triangles[area < 0][:, ::-1]
    x, y = corners.T
    polygon_area = 0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    if not (
        len(triangles) and abs(np.abs(area).sum() - polygon_area) <= _AREA_TOLERANCE * polygon_area
    ):
        raise PolygonError(
            number, f"of {len(plane_corners)} corners crosses itself, seen along its normal"
        )
    if not _winds_once(corners, triangles[np.abs(area) > _AREA_ROUNDING * polygon_area]):
        rule = f"of {len(plane_corners)} corners covers a part of its plane twice"
        raise PolygonError(number, f"{rule}: a hole has to be gone round against its outline")
    return kept[_insert_collinear_corners(triangles, corners)]


_EDGE_POINT_PAIRS_MAX = 1 << 22
"""Number of pairs of edge and point whose winding numbers are computed at a time."""


def _winds_once(corners: np.ndarray, triangles: np.ndarray) -> bool:
    """Return True if a polygon (n, 2) winds once and counter-clockwise about its triangles."""
    edge_ends = np.roll(corners, -1, axis=0)
    centres = corners[triangles].mean(axis=1)
    rows = max(_EDGE_POINT_PAIRS_MAX // len(corners), 1)
    for begin in range(0, len(centres), rows):
        x, y = centres[begin : begin + rows, None].transpose(2, 0, 1)
        # An upward edge to the right of a point adds one to the winding number.
        is_up = (corners[:, 1] <= y) & (edge_ends[:, 1] > y)
        is_down = (corners[:, 1] > y) & (edge_ends[:, 1] <= y)
        side = (edge_ends[:, 0] - corners[:, 0]) * (y - corners[:, 1]) - (x - corners[:, 0]) * (
            edge_ends[:, 1] - corners[:, 1]
        )
        winding_numbers = (is_up & (side > 0)).sum(axis=1) - (is_down & (side < 0)).sum(axis=1)
        if (winding_numbers != 1).any():
            return False
    return True


def _triangle_areas(corners: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the areas (k,) of triangles, positive if they are counter-clockwise."""
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    b, c = b - a, c - a
    return np.asarray(0.5 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]))


def _insert_collinear_corners(triangles: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return triangles that include the corners on straight edges, which earcut leaves out.

    Otherwise neighbouring polygons with such a corner would not share the edge.
    """
    used = np.zeros(len(corners), bool)
    used[triangles] = True
    if used.all():
        return triangles
    result = [tuple(triangle) for triangle in triangles.tolist()]
    triangle_of_edge: dict[tuple[int, int], int] = {}
    for k, triangle in enumerate(result):
        triangle_of_edge |= _directed_edges(triangle, k)
    used_corners = np.flatnonzero(used).tolist()
    for start, stop in zip(used_corners, used_corners[1:] + used_corners[:1], strict=True):
        between = [
            k % len(corners) for k in range(start + 1, stop + len(corners) * (stop <= start))
        ]
        along = corners[stop] - corners[start]
        fractions = [
            float((corners[k] - corners[start]) @ along / (along @ along)) for k in between
        ]
        fractions_with_ends = [0.0, *fractions, 1.0]
        k = triangle_of_edge.get((start, stop), -1)
        if not between or k < 0 or not all(np.diff(fractions_with_ends) > 0):
            continue  # no corner between, or a spike without area
        (opposite,) = set(result[k]) - {start, stop}
        for first, second in pairwise([start, *between, stop]):
            result.append((first, second, opposite))
            triangle_of_edge |= _directed_edges(result[-1], len(result) - 1)
        result[k] = result.pop()  # the last part replaces the original triangle
        triangle_of_edge |= _directed_edges(result[k], k)
    return np.array(result)


def _directed_edges(triangle: tuple[int, ...], number: int) -> dict[tuple[int, int], int]:
    """Return the directed edges of a triangle, each with the triangle's number."""
    a, b, c = triangle
    return {(a, b): number, (b, c): number, (c, a): number}
