"""Unit quaternions (w, x, y, z) as rotations from the body to the world frame.

All functions broadcast over leading dimensions. `multiply(p, q)` turns by q first, then by p.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_SMALL = 1e-4
"""Half angle [rad] under which sin(x)/x is its series, good to 1e-18 there."""


def multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton product p q, (..., 4)."""
    pw, px, py, pz = np.moveaxis(np.asarray(p, float), -1, 0)
    qw, qx, qy, qz = np.moveaxis(np.asarray(q, float), -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def conjugate(q: np.ndarray) -> np.ndarray:
    """Inverse of a unit quaternion, (..., 4)."""
    return np.asarray(q, float) * [1.0, -1.0, -1.0, -1.0]


def normalise(q: np.ndarray) -> np.ndarray:
    """Quaternion of length 1, (..., 4).

    Raises
    ------
    ValueError
        Where one has no length, or is not finite.
    """
    q = np.asarray(q, float)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if not (np.isfinite(length) & (length > 0)).all():
        raise ValueError("a quaternion must be finite and other than zero")
    return q / length


def rotate(q: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors turned by unit quaternions: body to world, (..., 3)."""
    q, vector = np.asarray(q, float), np.asarray(vector, float)
    shape = np.broadcast_shapes(q.shape[:-1], vector.shape[:-1])
    result = np.empty((*shape, 3))
    turns, vectors = (
        np.ascontiguousarray(np.broadcast_to(a, (*shape, k))).reshape(-1, k)
        for a, k in ((q, 4), (vector, 3))
    )
    _rotate_rows(turns, vectors, result.reshape(-1, 3))
    return result


@njit(cache=True, nogil=True)
def _rotate_rows(q, vector, result):
    for i in range(q.shape[0]):
        turn = q[i, 0], q[i, 1], q[i, 2], q[i, 3]
        v = rotated(turn, (vector[i, 0], vector[i, 1], vector[i, 2]))
        result[i, 0], result[i, 1], result[i, 2] = v


@njit(cache=True, nogil=True)
def rotated(q, v):
    """:func:`rotate` of one vector, compiled: v + w t + axis x t, t = 2 axis x v."""
    w, axis = q[0], (q[1], q[2], q[3])
    x, y, z = cross(axis, v)
    twice = 2 * x, 2 * y, 2 * z
    further = cross(axis, twice)
    return (
        v[0] + w * twice[0] + further[0],
        v[1] + w * twice[1] + further[1],
        v[2] + w * twice[2] + further[2],
    )


@njit(cache=True, nogil=True)
def cross(a, b):
    """Vector product of two vectors of three numbers, compiled."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def from_rotation_vector(vector: np.ndarray) -> np.ndarray:
    """Rotation about `vector` by its length [rad], (..., 4)."""
    vector = np.asarray(vector, float)
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    small = half < _SMALL
    safe = np.where(small, 1.0, half)
    sinc = np.where(small, 1 - half**2 / 6, np.sin(safe) / safe)
    return np.concatenate([np.cos(half), 0.5 * sinc * vector], axis=-1)


def to_rotation_vector(q: np.ndarray) -> np.ndarray:
    """Rotation vector [rad] of the shorter way round, length 0..pi, (..., 3)."""
    q = np.asarray(q, float)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(sine, q[..., :1])
    small = half < _SMALL
    safe = np.where(small, 1.0, sine)
    return np.asarray(np.where(small, 2 + half**2 / 3, 2 * half / safe) * q[..., 1:])


def about(axis: int, angle: np.ndarray | float) -> np.ndarray:
    """Right-handed rotation by `angle` [rad] about axis 0 (x), 1 (y) or 2 (z), (..., 4)."""
    half = 0.5 * np.asarray(angle, float)
    q = np.zeros((*half.shape, 4))
    q[..., 0] = np.cos(half)
    q[..., 1 + axis] = np.sin(half)
    return q


def from_heading(
    *,
    heading: np.ndarray | float,
    pitch: np.ndarray | float = 0.0,
    roll: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Attitude of a body (x forward, y left, z up), (..., 4).

    Parameters
    ----------
    heading : array_like
        Angle of the forward axis from the world's x, counter-clockwise from above [rad].
    pitch : array_like
        Nose up [rad]: a right-handed turn about -y, after the heading.
    roll : array_like
        Left side up [rad]: a right-handed turn about x, last.
    """
    turned = multiply(about(2, heading), about(1, -np.asarray(pitch, float)))
    return multiply(turned, about(0, roll))
