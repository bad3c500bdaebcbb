"""Directions of beams in the body frame: x forward, y left, z up, so that nadir is -z."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np


def cone(number: int, *, half_angle: float, azimuth: float = 0.0) -> np.ndarray:
    """Directions evenly round nadir, (number, 3).

    Parameters
    ----------
    number : int
        Beams, at least 1.
    half_angle : float
        Angle from nadir [rad].
    azimuth : float
        Of the first beam, from forward towards the left [rad].
    """
    turn = azimuth + 2 * math.pi * np.arange(number) / number
    across = math.sin(half_angle)
    down = np.full(number, -math.cos(half_angle))
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), down])


def steered(angle_x: np.ndarray, angle_y: np.ndarray) -> np.ndarray:
    """Directions of a two-axis steerer, (..., 3).

    The angle of an axis is that of the beam's projection on the plane of that axis and nadir, so
    that a grid of angles draws straight lines on level ground: ``tan = x / -z``. Both axes at
    22.5 deg make 30.4 deg from nadir.

    Parameters
    ----------
    angle_x, angle_y : array_like
        Angles from nadir towards forward and towards the left [rad], under 90 deg.
    """
    x, y = np.broadcast_arrays(np.tan(angle_x), np.tan(angle_y))
    vector = np.stack([x, y, np.full(x.shape, -1.0)], axis=-1)
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def corners(angle: float) -> np.ndarray:
    """Four directions at both axes' angles of +-`angle` [rad], counter-clockwise, (4, 3)."""
    return steered(angle * np.array([1, -1, -1, 1]), angle * np.array([1, 1, -1, -1]))


def stacked_angles(elements: Sequence[float]) -> np.ndarray:
    """Angles of an axis of stacked steering elements [rad], rising, (2^n,).

    Each element throws the beam to one side or the other by its angle, and the angles add: 15 and
    7.5 deg make -22.5, -7.5, 7.5 and 22.5 deg.

    Parameters
    ----------
    elements : sequence of float
        Angle of each element of the axis [rad].
    """
    sides = np.array([0.0])
    for element in elements:
        sides = np.concatenate([sides - element, sides + element])
    return np.sort(sides)


def squares(elements: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """All angles of a steerer with like axes, sorted into squares.

    A square is what a quarter turn about nadir makes of one pair of angles. The widest comes
    first and the narrowest last, each counter-clockwise: for the two elements of [T Fig. 5.2] the
    corners at 22.5 deg, the two squares that are askew, and the corners at 7.5 deg.

    Parameters
    ----------
    elements : sequence of float
        Angle of each element of an axis [rad].

    Returns
    -------
    directions : (4^n, 3) ndarray
        Unit vectors, square by square.
    patterns : (4^n / 4, 4) int64 ndarray
        Beams of each square.
    """
    angles = stacked_angles(elements)
    if angles.min() >= 0 or len(np.unique(np.round(angles, 12))) < len(angles) or 0 in angles:
        raise ValueError("the elements must reach as many different angles, and not nadir")
    positive = angles[angles > 0]
    pairs = [(x, y) for x in positive for y in positive]
    pairs.sort(key=lambda pair: (-round(math.hypot(*np.tan(pair)), 12), -pair[0]))
    turned = [((x, y), (-y, x), (-x, -y), (y, -x)) for x, y in pairs]
    grid = np.array(turned).reshape(-1, 2)
    return steered(grid[:, 0], grid[:, 1]), np.arange(len(grid)).reshape(-1, 4)
