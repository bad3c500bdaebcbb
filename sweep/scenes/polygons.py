"""Division of the polygons of mesh files into triangles.

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

NON_PLANARITY_REPORTED_MIN = 1e-3
"""Relative distance of a corner from a polygon's mean plane above which it is reported.

The distance is relative to the square root of the polygon's area.
"""

NON_PLANARITY_MAX = 0.25
"""Relative distance of a corner from a polygon's mean plane above which the polygon is refused.

The distance is relative to the square root of the polygon's area. Corners farther from the plane do
not determine a surface.
"""

_RELATIVE_AREA_ROUNDING_ERROR_MAX = 1e-12
"""Largest relative rounding error of the area of a polygon whose true area is 0.

The error is relative to the square of the polygon's extent.
"""

_AREA_SUM_TOLERANCE = 1e-9
"""Largest relative difference between a polygon's area and the sum of its triangles' areas.

A larger difference does not come from rounding: the polygon is refused.
"""


class PolygonError(ValueError):
    """Error about a polygon that can't be cut into triangles, with its number from 1."""

    def __init__(self, number: int, problem: str) -> None:
        super().__init__(f"face {number} {problem}")


class Polygons(NamedTuple):
    """Polygons with common vertices."""

    vertices: np.ndarray
    """Vertices (n, 3), float64."""
    corner_vertices: np.ndarray
    """Vertex indices (int64) of the corners of all polygons, polygon after polygon."""
    corner_counts: np.ndarray
    """Number of corners (m,) int64 of each polygon."""


class Triangulation(NamedTuple):
    """Triangles into which polygons were cut, with the order and winding of the polygons."""

    faces: np.ndarray
    """Vertex indices (k, 3) int64 of the corners of the triangles."""
    n_triangulated_polygons: int
    """Number of polygons with more than three corners, which were cut into triangles."""
    n_concave_polygons: int
    """Number of polygons with more than three corners that are not convex."""
    n_non_planar_polygons: int
    """Number of polygons with a corner farther from their mean plane than is reported.

    The limit is `NON_PLANARITY_REPORTED_MIN`.
    """
    largest_plane_departure: float
    """Largest distance of a corner from the mean plane of its polygon [unit of the vertices].

    Only the polygons counted by `n_non_planar_polygons` are considered.
    """

    def summary_sentences(self) -> tuple[str, ...]:
        """Return sentences about the polygons that were cut into triangles, for the user.

        Lengths in them are in the unit of the file.
        """
        if not self.n_triangulated_polygons:
            return ()
        concave_text = (
            f", {self.n_concave_polygons:,} of them not convex" if self.n_concave_polygons else ""
        )
        sentences = [
            f"{_polygon_count_text(self.n_triangulated_polygons)} cut into triangles{concave_text}"
        ]
        if self.n_non_planar_polygons:
            verb = "departs" if self.n_non_planar_polygons == 1 else "depart"
            sentences.append(
                f"{_polygon_count_text(self.n_non_planar_polygons)} {verb} from a plane by up to "
                f"{self.largest_plane_departure:.3g} units"
            )
        return tuple(sentences)


def _polygon_count_text(polygons: int) -> str:
    """Return a number of polygons as text, such as '1 polygon' or '2 polygons'."""
    return f"{polygons:,} polygon{'s' * (polygons != 1)}"


def triangulate_polygons(polygons: Polygons) -> Triangulation:
    """Cut polygons into triangles.

    A polygon without area becomes triangles without area. A polygon with a vertex that is not
    finite becomes triangles with such a vertex. :func:`sweep.scenes.meshes.clean_mesh` drops and
    counts them.

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
        If a polygon crosses itself, departs from a plane by more than `NON_PLANARITY_MAX`, or has
        an invalid vertex index.
    """
    vertices, all_corner_vertices, corner_counts = polygons
    first_corner = np.cumsum(corner_counts) - corner_counts
    wrong_corners = np.flatnonzero(
        (all_corner_vertices < 0) | (all_corner_vertices >= len(vertices))
    )
    if wrong_corners.size:
        face = int(np.searchsorted(first_corner, wrong_corners[0], side="right")) - 1
        wrong_vertex = all_corner_vertices[wrong_corners[0]]
        problem = f"names the vertex {wrong_vertex + 1} of {len(vertices):,}"
        raise PolygonError(face + 1, problem)
    triangles: list[np.ndarray] = []
    polygon_of_triangle: list[np.ndarray] = []
    n_triangulated_polygons = n_concave_polygons = n_non_planar_polygons = 0
    largest_plane_departure = 0.0
    for n_corners in np.unique(corner_counts):
        polygon_numbers = np.flatnonzero(corner_counts == n_corners)
        corner_vertices = all_corner_vertices[
            first_corner[polygon_numbers, None] + np.arange(n_corners)
        ]
        if n_corners <= 3:  # one or two corners have no area
            triangles.append(
                np.take(corner_vertices, [0, min(1, n_corners - 1), n_corners - 1], axis=1)
            )
            polygon_of_triangle.append(polygon_numbers)
            continue
        flat_polygons = _project_to_mean_planes(vertices[corner_vertices], polygon_numbers)
        n_triangulated_polygons += len(polygon_numbers)
        n_concave_polygons += int((~flat_polygons.is_convex & ~flat_polygons.is_degenerate).sum())
        is_bent = flat_polygons.non_planarity > NON_PLANARITY_REPORTED_MIN
        n_non_planar_polygons += int(is_bent.sum())
        largest_plane_departure = max(
            largest_plane_departure,
            float(
                (flat_polygons.non_planarity * np.sqrt(flat_polygons.area))[is_bent].max(
                    initial=0.0
                )
            ),
        )
        # Degenerate polygons become fans too. Their triangles have no area: clean_mesh drops and
        # counts them.
        fanned = np.flatnonzero(flat_polygons.is_convex | flat_polygons.is_degenerate)
        fan = np.stack(
            [np.zeros(n_corners - 2, int), np.arange(1, n_corners - 1), np.arange(2, n_corners)],
            axis=1,
        )
        triangles.append(corner_vertices[fanned][:, fan].reshape(-1, 3))
        polygon_of_triangle.append(np.repeat(polygon_numbers[fanned], n_corners - 2))
        for k in np.flatnonzero(~(flat_polygons.is_convex | flat_polygons.is_degenerate)):
            part_triangles = _triangulate_by_earcut(
                flat_polygons.corners[k], vertices[corner_vertices[k]], int(polygon_numbers[k]) + 1
            )
            triangles.append(corner_vertices[k][part_triangles])
            polygon_of_triangle.append(np.full(len(part_triangles), polygon_numbers[k]))
    if not triangles:
        return Triangulation(np.empty((0, 3), np.int64), 0, 0, 0, 0.0)
    order = np.argsort(np.concatenate(polygon_of_triangle), kind="stable")
    return Triangulation(
        np.concatenate(triangles)[order],
        n_triangulated_polygons,
        n_concave_polygons,
        n_non_planar_polygons,
        largest_plane_departure,
    )


class _FlatPolygons(NamedTuple):
    """Polygons with n corners each, projected to their mean planes."""

    corners: np.ndarray
    """Corners (m, n, 2) in the mean planes, counter-clockwise."""
    area: np.ndarray
    """Areas (m,) of the polygons."""
    non_planarity: np.ndarray
    """Largest distance (m,) of a corner from the mean plane, over the square root of the area."""
    is_convex: np.ndarray
    """Mask (m,) of the strictly convex polygons."""
    is_degenerate: np.ndarray
    """Mask (m,) of the polygons without area or with vertices that are not finite."""


def _project_to_mean_planes(points: np.ndarray, polygon_numbers: np.ndarray) -> _FlatPolygons:
    """Project m polygons with n corners each to their mean planes. Return the flat polygons.

    `points` (m, n, 3) are the corners. `polygon_numbers` (m,) are the indices of the polygons in
    the file, for errors.
    """
    has_data = np.isfinite(points).all(axis=(1, 2))
    points = np.where(has_data[:, None, None], points, 0.0)
    points = points - points[:, :1]
    next_points = np.roll(points, -1, axis=1)
    extent = np.sqrt((points * points).sum(axis=2)).max(axis=1)
    area_vector = 0.5 * np.cross(points, next_points).sum(axis=1)
    area = np.sqrt((area_vector * area_vector).sum(axis=1))
    has_area = area > _RELATIVE_AREA_ROUNDING_ERROR_MAX * extent * extent
    is_collinear = _collinear_polygon_mask(points, extent)
    if (is_folded := ~has_area & ~is_collinear).any():
        raise PolygonError(int(polygon_numbers[is_folded.argmax()]) + 1, "crosses itself")
    is_degenerate = ~has_data | is_collinear
    normal = np.where(
        is_degenerate[:, None],
        [0.0, 0.0, 1.0],
        area_vector / np.where(is_degenerate, 1.0, area)[:, None],
    )
    in_plane_axis = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    in_plane_axis /= np.sqrt((in_plane_axis * in_plane_axis).sum(axis=1))[:, None]
    axes = np.stack([in_plane_axis, np.cross(normal, in_plane_axis), normal], axis=2)
    flat = points @ axes
    height = flat[..., 2] - flat[..., 2].mean(axis=1)[:, None]
    non_planarity = np.abs(height).max(axis=1) / np.sqrt(np.where(is_degenerate, 1.0, area))
    non_planarity[is_degenerate] = 0.0
    if (non_planarity > NON_PLANARITY_MAX).any():
        k = int((non_planarity > NON_PLANARITY_MAX).argmax())
        problem = (
            f"is bent by {100 * non_planarity[k]:.0f} % of its size, "
            "so its surface is not determined"
        )
        raise PolygonError(int(polygon_numbers[k]) + 1, problem)
    corners = flat[..., :2]
    edge = np.roll(corners, -1, axis=1) - corners
    previous_edge = np.roll(edge, 1, axis=1)
    edge_cross = previous_edge[..., 0] * edge[..., 1] - previous_edge[..., 1] * edge[..., 0]
    total_angle = np.arctan2(edge_cross, (previous_edge * edge).sum(axis=2)).sum(axis=1)
    is_convex = (edge_cross > _RELATIVE_AREA_ROUNDING_ERROR_MAX * (extent * extent)[:, None]).all(
        axis=1
    ) & (total_angle < 3 * np.pi)
    return _FlatPolygons(corners, area, non_planarity, is_convex & ~is_degenerate, is_degenerate)


def _collinear_polygon_mask(points: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Return a mask (m,) of the polygons whose corners all lie on a straight line.

    `points` (m, n, 3) are the corners relative to the polygon's first corner. `extent` (m,) is the
    largest distance of a corner from the first corner.
    """
    squared_distance = (points * points).sum(axis=2)
    farthest = points[np.arange(len(points)), squared_distance.argmax(axis=1)]
    cross_product = np.cross(points, farthest[:, None])
    distance = np.sqrt((cross_product * cross_product).sum(axis=2)).max(axis=1)
    return np.asarray(distance <= _RELATIVE_AREA_ROUNDING_ERROR_MAX * extent * extent)


def _triangulate_by_earcut(
    plane_corners: np.ndarray, points: np.ndarray, number: int
) -> np.ndarray:
    """Cut a polygon of n corners into triangles by Mapbox's earcut, and check the result.

    Parameters
    ----------
    plane_corners : ndarray, shape (n, 2)
        Corners in the polygon's mean plane.
    points : ndarray, shape (n, 3)
        The same corners in space.
    number : int
        Number of the polygon in the file, for errors.

    Returns
    -------
    ndarray, shape (k, 3)
        Indices of the corners of the triangles.
    """
    import mapbox_earcut

    # Drop corners that repeat the previous corner.
    kept = np.flatnonzero((points != np.roll(points, 1, axis=0)).any(axis=1))
    corners = np.ascontiguousarray(plane_corners[kept])
    ring_ends = np.array([len(corners)], np.uint32)
    triangles = (
        mapbox_earcut.triangulate_float64(corners, ring_ends).reshape(-1, 3).astype(np.int64)
    )
    area = _signed_triangle_areas(corners, triangles)
    triangles[area < 0] = triangles[area < 0][:, ::-1]
    x, y = corners.T
    polygon_area = 0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    if not (
        len(triangles)
        and abs(np.abs(area).sum() - polygon_area) <= _AREA_SUM_TOLERANCE * polygon_area
    ):
        raise PolygonError(
            number, f"of {len(plane_corners)} corners crosses itself, seen along its normal"
        )
    if not _polygon_winds_once(
        corners, triangles[np.abs(area) > _RELATIVE_AREA_ROUNDING_ERROR_MAX * polygon_area]
    ):
        rule = f"of {len(plane_corners)} corners covers a part of its plane twice"
        raise PolygonError(number, f"{rule}: a hole has to be gone round against its outline")
    return kept[_split_triangles_at_collinear_corners(triangles, corners)]


_EDGE_POINT_PAIRS_PER_BATCH_MAX = 1 << 22
"""Largest number of pairs of edge and point for which winding numbers are computed at once."""


def _polygon_winds_once(corners: np.ndarray, triangles: np.ndarray) -> bool:
    """Return True if a polygon winds once and counter-clockwise about each of its triangles.

    `corners` (n, 2) are the corners of the polygon. `triangles` (k, 3) are indices into `corners`.
    """
    edge_ends = np.roll(corners, -1, axis=0)
    centres = corners[triangles].mean(axis=1)
    rows = max(_EDGE_POINT_PAIRS_PER_BATCH_MAX // len(corners), 1)
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


def _signed_triangle_areas(corners: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the areas (k,) of triangles in a plane; positive if counter-clockwise, else negative.

    `triangles` (k, 3) are indices into `corners` (n, 2).
    """
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    b, c = b - a, c - a
    return np.asarray(0.5 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]))


def _split_triangles_at_collinear_corners(triangles: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return triangles that are split at those corners of a polygon that lie on straight edges.

    Earcut leaves these corners out. The polygon would then lack edges in common with a neighbour
    that has the same corner. `triangles` (k, 3) are indices into `corners` (n, 2).
    """
    used = np.zeros(len(corners), bool)
    used[triangles] = True
    if used.all():
        return triangles
    result = [tuple(triangle) for triangle in triangles.tolist()]
    triangle_of_edge: dict[tuple[int, int], int] = {}
    for k, triangle in enumerate(result):
        triangle_of_edge |= _triangle_by_directed_edge(triangle, k)
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
            triangle_of_edge |= _triangle_by_directed_edge(result[-1], len(result) - 1)
        result[k] = result.pop()  # the last part replaces the original triangle
        triangle_of_edge |= _triangle_by_directed_edge(result[k], k)
    return np.array(result)


def _triangle_by_directed_edge(
    triangle: tuple[int, ...], number: int
) -> dict[tuple[int, int], int]:
    """Return a dict that maps each of the three edges of a triangle to the triangle's number.

    An edge is a pair of corner indices, in the order of the winding.
    """
    a, b, c = triangle
    return {(a, b): number, (b, c): number, (c, a): number}
