"""Polygons of mesh files cut into triangles that cover just them.

A polygon is looked at in its mean plane (Newell's normal). A convex one becomes a fan about its
first corner. Any other is cut by Mapbox's earcut, and the result is checked: the triangles' areas
sum to the polygon's, and the polygon winds about each of them once. One that crosses itself, or
goes round a hole in the sense of its outline, does not pass and is refused with its number.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

BEND_REPORTED_MIN = 1e-3
"""Departure from the mean plane, over the square root of the area, from which it is reported."""

BEND_MAX = 0.25
"""The same, above which the surface between the corners is anybody's guess."""

_AREA_ROUNDING = 1e-12
"""Area over the square of a polygon's extent below which rounding may have made it."""

_AREA_TOLERANCE = 1e-9
"""Relative difference of the triangles' areas from the polygon's that rounding may make."""


class PolygonError(ValueError):
    """A polygon that has no surface to be cut: its number in the file, from 1, and the rule."""

    def __init__(self, number: int, problem: str) -> None:
        super().__init__(f"face {number} {problem}")


class Polygons(NamedTuple):
    """Polygons on common vertices."""

    vertices: np.ndarray
    """(n, 3) float64."""
    corners: np.ndarray
    """(sum of counts,) int64: vertices of all polygons, one polygon after the other."""
    counts: np.ndarray
    """(m,) int64: number of corners of each polygon."""


class Triangulation(NamedTuple):
    """Triangles of polygons, in the polygons' order and winding."""

    faces: np.ndarray
    """(k, 3) int64."""
    n_cut: int
    """Polygons of more than three corners."""
    n_concave: int
    """Of these, polygons that are not convex."""
    n_bent: int
    """Of these, polygons that depart from their mean plane by more than `BEND_REPORTED_MIN`."""
    largest_bend: float
    """Largest departure of these, in the unit of the vertices."""

    def notes(self) -> tuple[str, ...]:
        """Sentences for people about what was cut; lengths in the file's unit."""
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
    return f"{polygons:,} polygon{'s' * (polygons != 1)}"


def triangulate(polygons: Polygons) -> Triangulation:
    """Cut polygons into triangles.

    A polygon without area, or with a corner that is not finite, becomes triangles of the same
    kind, which :func:`sweep.scenes.meshes.clean_mesh` drops and counts. PolygonError for one that
    crosses itself, is bent by more than `BEND_MAX`, or names a vertex that does not exist.
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
        # Empty polygons are fanned too: triangles without area, which are dropped and counted.
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
    """Polygons of n corners each, in their mean planes."""

    corners: np.ndarray  # (m, n, 2), counter-clockwise
    area: np.ndarray  # (m,)
    bend: np.ndarray  # (m,): largest departure from the plane over the square root of the area
    is_convex: np.ndarray  # (m,) bool: strictly
    is_empty: np.ndarray  # (m,) bool: without area or without data


def _flatten(points: np.ndarray, polygon_numbers: np.ndarray) -> _FlatPolygons:
    """Project polygons (m, n, 3), whose indices in the file are `members`, to their mean planes."""
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
    """Mask of the polygons (m, n, 3), from their first corners, whose corners are all in line."""
    squared_distance = (points * points).sum(axis=2)
    farthest = points[np.arange(len(points)), squared_distance.argmax(axis=1)]
    cross_product = np.cross(points, farthest[:, None])
    distance = np.sqrt((cross_product * cross_product).sum(axis=2)).max(axis=1)
    return np.asarray(distance <= _AREA_ROUNDING * extent * extent)


def _triangulate_polygon(plane_corners: np.ndarray, points: np.ndarray, number: int) -> np.ndarray:
    """Triangles (k, 3) of one polygon, by its corners in the plane (n, 2) and in space (n, 3)."""
    import mapbox_earcut

    # A corner that repeats the one before it adds nothing.
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
"""Edges times points that windings are counted of at a time."""


def _winds_once(corners: np.ndarray, triangles: np.ndarray) -> bool:
    """Return true if a polygon (n, 2) winds once, counter-clockwise, about each triangle in it."""
    edge_ends = np.roll(corners, -1, axis=0)
    centres = corners[triangles].mean(axis=1)
    rows = max(_EDGE_POINT_PAIRS_MAX // len(corners), 1)
    for begin in range(0, len(centres), rows):
        x, y = centres[begin : begin + rows, None].transpose(2, 0, 1)
        # An edge that passes to the right of a point, upwards, is a turn about it.
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
    """Areas of triangles (k,), positive if they are counter-clockwise."""
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    b, c = b - a, c - a
    return np.asarray(0.5 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]))


def _insert_collinear_corners(triangles: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Triangles with the corners that lie on a straight edge, which earcut leaves out.

    Without them a neighbour that has such a corner would not share the edge.
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
            continue  # none, or a spike without area
        (opposite,) = set(result[k]) - {start, stop}
        for first, second in pairwise([start, *between, stop]):
            result.append((first, second, opposite))
            triangle_of_edge |= _directed_edges(result[-1], len(result) - 1)
        result[k] = result.pop()  # the last part stands in the place of the whole
        triangle_of_edge |= _directed_edges(result[k], k)
    return np.array(result)


def _directed_edges(triangle: tuple[int, ...], number: int) -> dict[tuple[int, int], int]:
    """Directed edges of a triangle, each with the triangle's number."""
    a, b, c = triangle
    return {(a, b): number, (b, c): number, (c, a): number}
