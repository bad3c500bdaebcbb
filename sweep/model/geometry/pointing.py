"""Rays of a beam's beamlets, and pointing errors by the shot's number."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sweep.model.geometry.quaternion import from_rotation_vector, multiply, rotate
from sweep.model.philox import STREAM_POINTING_JITTER, normals, point_keys, uniforms

DOMAIN = "sweep.jitter"
"""Domain of the random key, so that no other use of the same seed meets its numbers."""


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
        Tangents of the angles off the axis towards the two vectors of :func:`transverse_of`, in
        units of `sigma`.
    sigma : float
        Standard deviation of the beam on each axis [rad].
    """
    vectors = rotate(attitude[:, None], np.stack([*transverse_of(axis), axis], axis=1))
    first, second, centre = np.moveaxis(vectors, 0, 2)[..., None]
    rays = np.empty((len(axis), len(across), 3))
    for k in range(3):
        np.multiply(first[k], across * sigma, out=rays[..., k])
        rays[..., k] += second[k] * (along * sigma)
        rays[..., k] += centre[k]
    length = rays[..., 0] * rays[..., 0]
    for k in (1, 2):
        length += rays[..., k] * rays[..., k]
    np.sqrt(length, out=length)
    for k in range(3):
        rays[..., k] /= length
    return rays


def transverse_of(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across directions (n, 3): (first, second, direction) is right-handed.

    For a beam near -z the first lies near x. A smooth function of the direction but along -x
    and x, where no beam of a downward-looking instrument points.
    """
    second = np.cross(u, [1.0, 0.0, 0.0])
    length = _length(second)
    second = np.where(length < 1e-6, [0.0, 1.0, 0.0], second / np.maximum(length, 1e-6))
    first = np.cross(second, u)
    first /= _length(first)
    return first, np.cross(u, first)


def _length(v: np.ndarray) -> np.ndarray:
    x, y, z = v[..., :1], v[..., 1:2], v[..., 2:]
    return np.asarray(np.sqrt(x * x + y * y + z * z))


class PointingJitter(NamedTuple):
    """Random turns of the beams, shot by shot: three independent normal angles about body axes.

    A beam in any direction is thrown off by two angles across it, each of that standard
    deviation; the third angle turns its footprint about it.
    """

    sigma: float
    """Standard deviation of each angle [rad]."""
    seed: int
    """Seed of the study, >= 0."""

    def turned(self, attitude: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Attitudes (n, 4) of shots by number (n,), turned; any stretch is the same bit for bit."""
        key = point_keys(np.empty((1, 0)), domain=DOMAIN, seed=self.seed)
        keys = np.broadcast_to(key, (len(index), 2))  # a shot's number stands for that of a draw
        draws = normals(uniforms(keys, np.asarray(index), STREAM_POINTING_JITTER, 4))[:, :3]
        return multiply(attitude, from_rotation_vector(draws * self.sigma))
