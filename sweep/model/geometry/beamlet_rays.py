"""Compiled directions of a beam's beamlets."""

import math

import numpy as np
from numba import njit

from sweep.model.geometry.jitter import transverse
from sweep.model.geometry.quaternion import rotate


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
        :func:`sweep.model.geometry.jitter.transverse`, in units of `sigma`.
    sigma : float
        Standard deviation of the beam on each axis [rad].
    """
    frame = np.stack([*transverse(axis), np.asarray(axis, float)], axis=1)
    turned = rotate(np.asarray(attitude, float)[:, None], frame)
    rays = np.empty((len(turned), across.size, 3))
    _spread(turned, across * sigma, along * sigma, rays)
    return rays


@njit(cache=True, nogil=True, error_model="numpy")
def _spread(frame, across, along, rays):
    """Vectors axis + across first + along second, scaled to length 1."""
    for i in range(frame.shape[0]):
        for b in range(across.size):
            x = frame[i, 2, 0] + (across[b] * frame[i, 0, 0] + along[b] * frame[i, 1, 0])
            y = frame[i, 2, 1] + (across[b] * frame[i, 0, 1] + along[b] * frame[i, 1, 1])
            z = frame[i, 2, 2] + (across[b] * frame[i, 0, 2] + along[b] * frame[i, 1, 2])
            length = math.sqrt(x * x + y * y + z * z)
            rays[i, b, 0], rays[i, b, 1], rays[i, b, 2] = x / length, y / length, z / length
