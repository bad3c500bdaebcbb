"""Rays at triangles in exact fractions: every float is one, so every hit has an exact distance."""

from fractions import Fraction

import numpy as np

Vector = list[Fraction]


def to_fractions(values: np.ndarray) -> Vector:
    return [v if isinstance(v, Fraction) else Fraction(float(v)) for v in values]


def subtract(a: Vector, b: Vector) -> Vector:
    return [x - y for x, y in zip(a, b, strict=True)]


def six_times_volume(a: Vector, b: Vector, c: Vector) -> Fraction:
    """Six times the signed volume that three vectors span."""
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


def intersect_triangle(
    corners: np.ndarray, origin: np.ndarray, direction: np.ndarray
) -> tuple[Fraction, bool] | None:
    """Distance to a triangle's plane in lengths of d, and whether the ray meets the triangle.

    By the volumes that the ray spans with the edges; rims are inside. None where it runs along the
    plane.
    """
    start, along = to_fractions(origin), to_fractions(direction)
    a, b, c = (subtract(to_fractions(v), start) for v in corners)
    edge_volumes = (
        six_times_volume(along, b, c),
        six_times_volume(along, c, a),
        six_times_volume(along, a, b),
    )
    if not sum(edge_volumes):
        return None
    distance = six_times_volume(a, b, c) / sum(edge_volumes)
    return distance, distance > 0 and (min(edge_volumes) >= 0 or max(edge_volumes) <= 0)


def nearest_triangle(
    vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, direction: np.ndarray
) -> tuple[Fraction, int] | None:
    """Distance to the nearest triangle and its number; None where the ray meets none."""
    corners = vertices[faces]
    centre = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    centre_offset = centre - origin
    squared_distance_from_ray = (
        np.einsum("ij,ij->i", centre_offset, centre_offset) - (centre_offset @ direction) ** 2
    )
    is_close = (
        squared_distance_from_ray
        <= (1.001 * radius + 1e-6 * np.linalg.norm(centre_offset, axis=1)) ** 2
    )
    nearest_hit = None
    for face in np.flatnonzero(is_close):
        hit = intersect_triangle(corners[face], origin, direction)
        if hit and hit[1] and (nearest_hit is None or hit[0] < nearest_hit[0]):
            nearest_hit = hit[0], int(face)
    return nearest_hit


def error_in_ulps(value: float, exact: Fraction) -> float:
    """Error of a float in units of its last place."""
    return float(abs(Fraction(float(value)) - exact) / Fraction(float(np.spacing(abs(value)))))
