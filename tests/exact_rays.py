"""Rays at triangles in exact fractions: every float is one, so every hit has an exact distance."""

from fractions import Fraction

import numpy as np

Vector = list[Fraction]


def fractions(values: np.ndarray) -> Vector:
    return [v if isinstance(v, Fraction) else Fraction(float(v)) for v in values]


def less(a: Vector, b: Vector) -> Vector:
    return [x - y for x, y in zip(a, b, strict=True)]


def volume(a: Vector, b: Vector, c: Vector) -> Fraction:
    """Six times the signed volume that three vectors span."""
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


def met(corners: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[Fraction, bool] | None:
    """Distance to a triangle's plane in lengths of d, and whether the ray meets the triangle.

    By the volumes that the ray spans with the edges; rims are inside. None where it runs along the
    plane.
    """
    start, along = fractions(o), fractions(d)
    a, b, c = (less(fractions(v), start) for v in corners)
    parts = volume(along, b, c), volume(along, c, a), volume(along, a, b)
    if not sum(parts):
        return None
    t = volume(a, b, c) / sum(parts)
    return t, t > 0 and (min(parts) >= 0 or max(parts) <= 0)


def nearest(
    vertices: np.ndarray, faces: np.ndarray, o: np.ndarray, d: np.ndarray
) -> tuple[Fraction, int] | None:
    """Distance to the nearest triangle and its number; None where the ray meets none."""
    corners = vertices[faces]
    centre = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    away = centre - o
    aside = np.einsum("ij,ij->i", away, away) - (away @ d) ** 2
    close = aside <= (1.001 * radius + 1e-6 * np.linalg.norm(away, axis=1)) ** 2
    best = None
    for face in np.flatnonzero(close):
        found = met(corners[face], o, d)
        if found and found[1] and (best is None or found[0] < best[0]):
            best = found[0], int(face)
    return best


def last_places(value: float, exact: Fraction) -> float:
    """Error of a float in units of its last place."""
    return float(abs(Fraction(float(value)) - exact) / Fraction(float(np.spacing(abs(value)))))
