"""Unit quaternions (w, x, y, z) as rotations from the body to the world frame.

All functions broadcast over leading dimensions. `multiply(p, q)` rotates by q first, then by p.
"""

from __future__ import annotations

import numpy as np

_SMALL_HALF_ANGLE = 1e-4
"""Half angle [rad] below which sin(x)/x is computed by its series, accurate to 1e-18 there."""


def multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the Hamilton product p q, (..., 4)."""
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
    """Return the inverse of a unit quaternion, (..., 4)."""
    return np.asarray(q, float) * [1.0, -1.0, -1.0, -1.0]


def normalise(q: np.ndarray) -> np.ndarray:
    """Return the quaternion scaled to length 1, (..., 4).

    Raises
    ------
    ValueError
        If a quaternion has length 0 or is not finite.
    """
    q = np.asarray(q, float)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if not (np.isfinite(length) & (length > 0)).all():
        raise ValueError("a quaternion must be finite and other than zero")
    return q / length


def rotate(q: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotate vectors (..., 3) by unit quaternions, from body to world."""
    q, vector = np.asarray(q, float), np.asarray(vector, float)
    doubled_cross = 2 * np.cross(q[..., 1:], vector)
    return np.asarray(vector + q[..., :1] * doubled_cross + np.cross(q[..., 1:], doubled_cross))


def from_rotation_vector(vector: np.ndarray) -> np.ndarray:
    """Return the rotation about `vector` by its length [rad], (..., 4)."""
    vector = np.asarray(vector, float)
    half_angle = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    is_small = half_angle < _SMALL_HALF_ANGLE
    safe_half_angle = np.where(is_small, 1.0, half_angle)
    sinc = np.where(is_small, 1 - half_angle**2 / 6, np.sin(safe_half_angle) / safe_half_angle)
    return np.concatenate([np.cos(half_angle), 0.5 * sinc * vector], axis=-1)


def to_rotation_vector(q: np.ndarray) -> np.ndarray:
    """Return the rotation vector [rad] of the shorter rotation, of length 0..pi, (..., 3)."""
    q = np.asarray(q, float)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    half_angle = np.arctan2(sine, q[..., :1])
    is_small = half_angle < _SMALL_HALF_ANGLE
    safe_sine = np.where(is_small, 1.0, sine)
    return np.asarray(
        np.where(is_small, 2 + half_angle**2 / 3, 2 * half_angle / safe_sine) * q[..., 1:]
    )


def axis_angle(axis: int, angle: np.ndarray | float) -> np.ndarray:
    """Return the right-handed rotation by `angle` [rad] about axis 0, 1, 2 (x, y, z), (..., 4)."""
    half_angle = 0.5 * np.asarray(angle, float)
    q = np.zeros((*half_angle.shape, 4))
    q[..., 0] = np.cos(half_angle)
    q[..., 1 + axis] = np.sin(half_angle)
    return q


def from_heading(
    *,
    heading: np.ndarray | float,
    pitch: np.ndarray | float = 0.0,
    roll: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Return the attitude of a body (x forward, y left, z up) from angles, (..., 4).

    Parameters
    ----------
    heading : ndarray or float
        Angle of the forward axis from the world's x, counter-clockwise from above [rad].
    pitch : ndarray or float
        Angle by which the nose is then raised [rad], a right-handed rotation about -y.
    roll : ndarray or float
        Angle by which the left side is raised last [rad], a right-handed rotation about x.
    """
    heading_and_pitch = multiply(axis_angle(2, heading), axis_angle(1, -np.asarray(pitch, float)))
    return multiply(heading_and_pitch, axis_angle(0, roll))
