"""Compiled directions of a beam's beamlets."""

import math

import numpy as np
from numba import njit

from sweep.model.geometry.jitter import transverse_of
from sweep.model.geometry.quaternion import rotated


def beamlet_rays(
    attitude: np.ndarray, axis: np.ndarray, across: np.ndarray, along: np.ndarray, sigma: float
) -> np.ndarray:
    """Unit vectors of every beamlet in the world frame, (n, b, 3).

    Parameters
    ----------
    attitude : (n, 4) ndarray
        Unit quaternions, body to world.
    axis : (n, 3) ndarray
        Unit vectors along the beams, in the body frame.
    across, along : (b,) ndarray
        Tangents of the angles off the axis towards the two vectors of
        :func:`sweep.model.geometry.jitter.transverse_of`, in units of `sigma`.
    sigma : float
        Standard deviation of the beam on each axis [rad].
    """
    attitude, axis = np.ascontiguousarray(attitude, float), np.ascontiguousarray(axis, float)
    rays = np.empty((len(attitude), across.size, 3))
    _spread(attitude, axis, across * sigma, along * sigma, rays)
    return rays


@njit(cache=True, nogil=True, error_model="numpy")
def _spread(attitude, axes, across, along, rays):
    """Vectors axis + across first + along second, scaled to length 1."""
    x, y, z = np.empty(across.size), np.empty(across.size), np.empty(across.size)
    for i in range(rays.shape[0]):
        turn = attitude[i, 0], attitude[i, 1], attitude[i, 2], attitude[i, 3]
        axis = axes[i, 0], axes[i, 1], axes[i, 2]
        first, second = transverse_of(axis)
        first, second, axis = rotated(turn, first), rotated(turn, second), rotated(turn, axis)
        for b in range(across.size):
            vx = axis[0] + (across[b] * first[0] + along[b] * second[0])
            vy = axis[1] + (across[b] * first[1] + along[b] * second[1])
            vz = axis[2] + (across[b] * first[2] + along[b] * second[2])
            length = math.sqrt(vx * vx + vy * vy + vz * vz)
            x[b], y[b], z[b] = vx / length, vy / length, vz / length
        for b in range(across.size):  # by itself, as the machine's vectors divide
            rays[i, b, 0], rays[i, b, 1], rays[i, b, 2] = x[b], y[b], z[b]
