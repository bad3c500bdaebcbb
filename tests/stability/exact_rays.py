"""Rays at triangles in exact fractions: every float is one, so every hit has an exact distance."""

from fractions import Fraction

import numpy as np

Vector = tuple[Fraction, Fraction, Fraction]


def fractions(values: np.ndarray) -> Vector:
    x, y, z = (Fraction(float(v)) for v in values)
    return x, y, z


def less(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def volume(a: Vector, b: Vector, c: Vector) -> Fraction:
    """Six times the signed volume that three vectors span."""
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


def plane_distance(corners: np.ndarray, o: np.ndarray, d: np.ndarray) -> Fraction | None:
    """Where a triangle's plane is met, in lengths of d; None if the ray lies along it."""
    start, along = fractions(o), fractions(d)
    a, b, c = (less(fractions(v), start) for v in corners)
    total = volume(along, b, c) + volume(along, c, a) + volume(along, a, b)
    return volume(a, b, c) / total if total else None


def nearest(
    vertices: np.ndarray, faces: np.ndarray, o: np.ndarray, d: np.ndarray
) -> Fraction | None:
    """Distance to the nearest triangle, rims included; None where the ray meets none."""
    corners = vertices[faces]
    centre = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    away = centre - o
    aside = np.einsum("ij,ij->i", away, away) - (away @ d) ** 2
    close = aside <= (1.001 * radius + 1e-6 * np.linalg.norm(away, axis=1)) ** 2
    start, along, best = fractions(o), fractions(d), None
    for triangle in corners[close]:
        a, b, c = (less(fractions(v), start) for v in triangle)
        parts = volume(along, b, c), volume(along, c, a), volume(along, a, b)
        if sum(parts) and (min(parts) >= 0 or max(parts) <= 0):
            t = volume(a, b, c) / sum(parts)
            best = t if t > 0 and (best is None or t < best) else best
    return best


def last_places(value: float, exact: Fraction) -> float:
    """Error of a float in units of its last place."""
    return float(abs(Fraction(float(value)) - exact) / Fraction(float(np.spacing(abs(value)))))
