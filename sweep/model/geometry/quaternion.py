"""Unit quaternions (w, x, y, z), which are rotations from the body's frame to the world's.

All functions broadcast over leading dimensions.
"""

from __future__ import annotations

import numpy as np

_SMALL_HALF_ANGLE = 1e-4
"""Half angle x [rad] below which sin(x) / x is computed by its power series. The series is then
accurate to 1e-18."""


def multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the Hamilton product p q of quaternions: the rotation by q first, then by p.

    Parameters
    ----------
    p, q : ndarray (..., 4)
        Quaternions (w, x, y, z).

    Returns
    -------
    ndarray (..., 4)
        With the scalar part w and the vector part v, p q has the scalar part p_w q_w - p_v . q_v
        and the vector part p_w q_v + q_w p_v + p_v x q_v.
    """
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
    """Return the conjugate of quaternions, (..., 4): the inverse rotation of a unit quaternion."""
    return np.asarray(q, float) * [1.0, -1.0, -1.0, -1.0]


def normalise(q: np.ndarray) -> np.ndarray:
    """Scale quaternions (..., 4) to length 1.

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
    """Rotate vectors from the body's frame to the world's.

    Parameters
    ----------
    q : ndarray (..., 4)
        Unit quaternions (w, x, y, z) from body to world; their length is not checked.
    vector : ndarray (..., 3)
        Vectors v in the body's frame, in any unit.

    Returns
    -------
    ndarray (..., 3)
        v + 2 w (u x v) + 2 u x (u x v) in the unit of `vector`, with the vector part u = (x, y, z)
        of the quaternion.
    """
    q, vector = np.asarray(q, float), np.asarray(vector, float)
    doubled_cross = 2 * np.cross(q[..., 1:], vector)
    return np.asarray(vector + q[..., :1] * doubled_cross + np.cross(q[..., 1:], doubled_cross))


def from_rotation_vector(vector: np.ndarray) -> np.ndarray:
    """Convert rotation vectors (..., 3) [rad] to unit quaternions (..., 4).

    A rotation vector points along the axis. Its length is the angle, right-handed.
    """
    vector = np.asarray(vector, float)
    half_angle = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    is_small = half_angle < _SMALL_HALF_ANGLE
    safe_half_angle = np.where(is_small, 1.0, half_angle)
    sinc = np.where(is_small, 1 - half_angle**2 / 6, np.sin(safe_half_angle) / safe_half_angle)
    return np.concatenate([np.cos(half_angle), 0.5 * sinc * vector], axis=-1)


def to_rotation_vector(q: np.ndarray) -> np.ndarray:
    """Convert unit quaternions (..., 4) to rotation vectors (..., 3) [rad] of length 0..pi.

    Both q and -q give the shorter of the two rotations.
    """
    q = np.asarray(q, float)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    half_angle = np.arctan2(sine, q[..., :1])
    is_small = half_angle < _SMALL_HALF_ANGLE
    safe_sine = np.where(is_small, 1.0, sine)
    return np.asarray(
        np.where(is_small, 2 + half_angle**2 / 3, 2 * half_angle / safe_sine) * q[..., 1:]
    )


def from_axis_angle(axis: int, angle: np.ndarray | float) -> np.ndarray:
    """Return the quaternions of right-handed rotations about a coordinate axis.

    Parameters
    ----------
    axis : int
        Axis of the rotation: 0, 1 or 2 for x, y or z.
    angle : ndarray or float
        Angle of the rotation [rad], of any shape.

    Returns
    -------
    ndarray (..., 4)
        Unit quaternions (w, x, y, z): w = cos(angle / 2), and sin(angle / 2) along the axis.
    """
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
    """Return the attitude of a body (x forward, y left, z up) from three angles.

    Parameters
    ----------
    heading : ndarray or float
        Angle of the forward axis from the world's x, counter-clockwise from above [rad].
    pitch : ndarray or float
        Angle by which the nose is raised after the rotation by the heading [rad], a right-handed
        rotation about -y.
    roll : ndarray or float
        Angle by which the left side is raised after both other rotations [rad], a right-handed
        rotation about x.

    Returns
    -------
    ndarray (..., 4)
        Unit quaternions (w, x, y, z) from body to world: R_z(heading) R_y(-pitch) R_x(roll).
    """
    heading_and_pitch = multiply(
        from_axis_angle(2, heading), from_axis_angle(1, -np.asarray(pitch, float))
    )
    return multiply(heading_and_pitch, from_axis_angle(0, roll))
