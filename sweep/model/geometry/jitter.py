"""Pointing errors, from standard normal draws that are given."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sweep.model.geometry.quaternion import from_rotation_vector, multiply


def jitter_attitude(
    attitude: np.ndarray, *, sigma: float | Sequence[float] | np.ndarray, draws: np.ndarray
) -> np.ndarray:
    """Attitudes with a small random turn in the body frame, (n, 4).

    Parameters
    ----------
    attitude : (n, 4) ndarray
        Unit quaternions, body to world.
    sigma : float or (3,) array_like
        Standard deviation of the turn about body x, y and z [rad].
    draws : (n, 3) ndarray
        Independent standard normal numbers.
    """
    turn = np.asarray(draws, float) * np.asarray(sigma, float)
    return multiply(attitude, from_rotation_vector(turn))


def jitter_directions(directions: np.ndarray, *, sigma: float, draws: np.ndarray) -> np.ndarray:
    """Unit vectors, each thrown off by two independent angles across it, (n, 3).

    Parameters
    ----------
    directions : (n, 3) ndarray
        Unit vectors.
    sigma : float
        Standard deviation of each angle [rad]; the angle off has a mean square of 2 sigma^2.
    draws : (n, 2) ndarray
        Independent standard normal numbers.
    """
    u = np.asarray(directions, float)
    first, second = transverse(u)
    angles = np.asarray(draws, float) * sigma
    off = angles[:, :1] * first + angles[:, 1:] * second
    angle = np.linalg.norm(off, axis=1, keepdims=True)
    return np.asarray(u * np.cos(angle) + off * np.sinc(angle / np.pi))


def transverse(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across each direction, so that (first, second, direction) is right-handed.

    For a beam near -z the first lies near x. A smooth function of the direction but along -x
    and x, where no beam of a downward-looking instrument points.

    Parameters
    ----------
    directions : (..., 3) ndarray
        Unit vectors.
    """
    u = np.asarray(directions, float)
    second = np.cross(u, [1.0, 0.0, 0.0])
    length = np.linalg.norm(second, axis=-1, keepdims=True)
    along_x = length < 1e-6
    second = np.where(along_x, [0.0, 1.0, 0.0], second / np.where(along_x, 1.0, length))
    first = np.cross(second, u)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return first, np.asarray(np.cross(u, first))
