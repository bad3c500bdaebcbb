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

BENT = 1e-3
"""Departure from the mean plane, over the square root of the area, from which it is reported."""

BENT_MAX = 0.25
"""The same, above which the surface between the corners is anybody's guess."""

_ROUNDING = 1e-12
"""Area over the square of a polygon's extent below which rounding may have made it."""

_AREA_TOLERANCE = 1e-9
"""Relative difference of the triangles' areas from the polygon's that rounding may make."""


class PolygonError(ValueError):
    """A polygon that has no surface to be cut: its number in the file, from 1, and the rule."""

    def __init__(self, number: int, rule: str) -> None:
        super().__init__(f"face {number} {rule}")


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
    cut: int
    """Polygons of more than three corners."""
    concave: int
    """Of these, polygons that are not convex."""
    bent: int
    """Of these, polygons that depart from their mean plane by more than `BENT`."""
    bend: float
    """Largest departure of these, in the unit of the vertices."""

    def notes(self) -> tuple[str, ...]:
        """Sentences for people about what was cut; lengths in the file's unit."""
        if not self.cut:
            return ()
        concave = f", {self.concave:,} of them not convex" if self.concave else ""
        notes = [f"{_number(self.cut)} cut into triangles{concave}"]
        if self.bent:
            verb = "departs" if self.bent == 1 else "depart"
            notes.append(f"{_number(self.bent)} {verb} from a plane by up to {self.bend:.3g} units")
        return tuple(notes)


def _number(polygons: int) -> str:
    return f"{polygons:,} polygon{'s' * (polygons != 1)}"


def triangulate(polygons: Polygons) -> Triangulation:
    """Cut polygons into triangles.

    A polygon without area, or with a corner that is not finite, becomes triangles of the same
    kind, which :func:`sweep.scenes.meshes.clean` drops and counts. PolygonError for one that
    crosses itself, is bent by more than `BENT_MAX`, or names a vertex that does not exist.
    """
    vertices, corners, counts = polygons
    first = np.cumsum(counts) - counts
    wrong = np.flatnonzero((corners < 0) | (corners >= len(vertices)))
    if wrong.size:
        face = int(np.searchsorted(first, wrong[0], side="right")) - 1
        names = f"names the vertex {corners[wrong[0]] + 1} of {len(vertices):,}"
        raise PolygonError(face + 1, names)
    triangles: list[np.ndarray] = []
    owners: list[np.ndarray] = []
    cut = concave = bent = 0
    bend = 0.0
    for number in np.unique(counts):
        members = np.flatnonzero(counts == number)
        indices = corners[first[members, None] + np.arange(number)]
        if number <= 3:  # one or two corners have no area
            triangles.append(np.take(indices, [0, min(1, number - 1), number - 1], axis=1))
            owners.append(members)
            continue
        flat = _flatten(vertices[indices], members)
        cut += len(members)
        concave += int((~flat.convex & ~flat.empty).sum())
        is_bent = flat.bend > BENT
        bent += int(is_bent.sum())
        bend = max(bend, float((flat.bend * np.sqrt(flat.area))[is_bent].max(initial=0.0)))
        # Empty polygons are fanned too: triangles without area, which are dropped and counted.
        fanned = np.flatnonzero(flat.convex | flat.empty)
        fan = np.stack(
            [np.zeros(number - 2, int), np.arange(1, number - 1), np.arange(2, number)], axis=1
        )
        triangles.append(indices[fanned][:, fan].reshape(-1, 3))
        owners.append(np.repeat(members[fanned], number - 2))
        for k in np.flatnonzero(~(flat.convex | flat.empty)):
            part = _cut(flat.corners[k], vertices[indices[k]], int(members[k]) + 1)
            triangles.append(indices[k][part])
            owners.append(np.full(len(part), members[k]))
    if not triangles:
        return Triangulation(np.empty((0, 3), np.int64), 0, 0, 0, 0.0)
    order = np.argsort(np.concatenate(owners), kind="stable")
    return Triangulation(np.concatenate(triangles)[order], cut, concave, bent, bend)


class _Flat(NamedTuple):
    """Polygons of n corners each, in their mean planes."""

    corners: np.ndarray  # (m, n, 2), counter-clockwise
    area: np.ndarray  # (m,)
    bend: np.ndarray  # (m,): largest departure from the plane over the square root of the area
    convex: np.ndarray  # (m,) bool: strictly
    empty: np.ndarray  # (m,) bool: without area or without data


def _flatten(points: np.ndarray, members: np.ndarray) -> _Flat:
    """Project polygons (m, n, 3), whose indices in the file are `members`, to their mean planes."""
    has_data = np.isfinite(points).all(axis=(1, 2))
    points = np.where(has_data[:, None, None], points, 0.0)
    points = points - points[:, :1]
    following = np.roll(points, -1, axis=1)
    extent = np.sqrt((points * points).sum(axis=2)).max(axis=1)
    newell = 0.5 * np.cross(points, following).sum(axis=1)
    area = np.sqrt((newell * newell).sum(axis=1))
    has_area = area > _ROUNDING * extent * extent
    in_line = _in_line(points, extent)
    if (folded := ~has_area & ~in_line).any():
        raise PolygonError(int(members[folded.argmax()]) + 1, "crosses itself")
    empty = ~has_data | in_line
    normal = np.where(empty[:, None], [0.0, 0.0, 1.0], newell / np.where(empty, 1.0, area)[:, None])
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    across /= np.sqrt((across * across).sum(axis=1))[:, None]
    axes = np.stack([across, np.cross(normal, across), normal], axis=2)
    flat = points @ axes
    height = flat[..., 2] - flat[..., 2].mean(axis=1)[:, None]
    bend = np.abs(height).max(axis=1) / np.sqrt(np.where(empty, 1.0, area))
    bend[empty] = 0.0
    if (bend > BENT_MAX).any():
        k = int((bend > BENT_MAX).argmax())
        rule = f"is bent by {100 * bend[k]:.0f} % of its size, so its surface is not determined"
        raise PolygonError(int(members[k]) + 1, rule)
    corners = flat[..., :2]
    edge = np.roll(corners, -1, axis=1) - corners
    before = np.roll(edge, 1, axis=1)
    turn = before[..., 0] * edge[..., 1] - before[..., 1] * edge[..., 0]
    angle = np.arctan2(turn, (before * edge).sum(axis=2)).sum(axis=1)
    convex = (turn > _ROUNDING * (extent * extent)[:, None]).all(axis=1) & (angle < 3 * np.pi)
    return _Flat(corners, area, bend, convex & ~empty, empty)


def _in_line(points: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Mask of the polygons (m, n, 3), from their first corners, whose corners are all in line."""
    square = (points * points).sum(axis=2)
    far = points[np.arange(len(points)), square.argmax(axis=1)]
    beside = np.cross(points, far[:, None])
    distance = np.sqrt((beside * beside).sum(axis=2)).max(axis=1)
    return np.asarray(distance <= _ROUNDING * extent * extent)


def _cut(flat: np.ndarray, points: np.ndarray, number: int) -> np.ndarray:
    """Triangles (k, 3) of one polygon, by its corners in the plane (n, 2) and in space (n, 3)."""
    import mapbox_earcut

    # A corner that repeats the one before it adds nothing.
    kept = np.flatnonzero((points != np.roll(points, 1, axis=0)).any(axis=1))
    corners = np.ascontiguousarray(flat[kept])
    ends = np.array([len(corners)], np.uint32)
    part = mapbox_earcut.triangulate_float64(corners, ends).reshape(-1, 3).astype(np.int64)
    area = _areas(corners, part)
    part[area < 0] = part[area < 0][:, ::-1]
    x, y = corners.T
    whole = 0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    if not (len(part) and abs(np.abs(area).sum() - whole) <= _AREA_TOLERANCE * whole):
        raise PolygonError(number, f"of {len(flat)} corners crosses itself, seen along its normal")
    if not _winds_once(corners, part[np.abs(area) > _ROUNDING * whole]):
        rule = f"of {len(flat)} corners covers a part of its plane twice"
        raise PolygonError(number, f"{rule}: a hole has to be gone round against its outline")
    return kept[_with_corners_in_line(part, corners)]


_PAIRS = 1 << 22
"""Edges times points that windings are counted of at a time."""


def _winds_once(corners: np.ndarray, triangles: np.ndarray) -> bool:
    """Return true if a polygon (n, 2) winds once, counter-clockwise, about each triangle in it."""
    ends = np.roll(corners, -1, axis=0)
    centres = corners[triangles].mean(axis=1)
    rows = max(_PAIRS // len(corners), 1)
    for begin in range(0, len(centres), rows):
        x, y = centres[begin : begin + rows, None].transpose(2, 0, 1)
        # An edge that passes to the right of a point, upwards, is a turn about it.
        is_up = (corners[:, 1] <= y) & (ends[:, 1] > y)
        is_down = (corners[:, 1] > y) & (ends[:, 1] <= y)
        side = (ends[:, 0] - corners[:, 0]) * (y - corners[:, 1]) - (x - corners[:, 0]) * (
            ends[:, 1] - corners[:, 1]
        )
        turns = (is_up & (side > 0)).sum(axis=1) - (is_down & (side < 0)).sum(axis=1)
        if (turns != 1).any():
            return False
    return True


def _areas(corners: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Areas of triangles (k,), positive if they are counter-clockwise."""
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    b, c = b - a, c - a
    return np.asarray(0.5 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]))


def _with_corners_in_line(triangles: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Triangles with the corners that lie on a straight edge, which earcut leaves out.

    Without them a neighbour that has such a corner would not share the edge.
    """
    used = np.zeros(len(corners), bool)
    used[triangles] = True
    if used.all():
        return triangles
    result = [tuple(triangle) for triangle in triangles.tolist()]
    owner: dict[tuple[int, int], int] = {}
    for k, triangle in enumerate(result):
        owner |= _edges(triangle, k)
    places = np.flatnonzero(used).tolist()
    for start, stop in zip(places, places[1:] + places[:1], strict=True):
        between = [
            k % len(corners) for k in range(start + 1, stop + len(corners) * (stop <= start))
        ]
        along = corners[stop] - corners[start]
        share = [float((corners[k] - corners[start]) @ along / (along @ along)) for k in between]
        rising = [0.0, *share, 1.0]
        k = owner.get((start, stop), -1)
        if not between or k < 0 or not all(np.diff(rising) > 0):
            continue  # none, or a spike without area
        (opposite,) = set(result[k]) - {start, stop}
        for one, other in pairwise([start, *between, stop]):
            result.append((one, other, opposite))
            owner |= _edges(result[-1], len(result) - 1)
        result[k] = result.pop()  # the last part stands in the place of the whole
        owner |= _edges(result[k], k)
    return np.array(result)


def _edges(triangle: tuple[int, ...], number: int) -> dict[tuple[int, int], int]:
    """Directed edges of a triangle, each with the triangle's number."""
    a, b, c = triangle
    return {(a, b): number, (b, c): number, (c, a): number}
