"""Pointing errors, from standard normal draws that are given, or drawn by the shot's number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model.geometry.quaternion import cross, from_rotation_vector, multiply
from sweep.model.philox import STREAM_POINTING_JITTER, normal_pair, point_keys

DOMAIN = "sweep.jitter"
"""Domain of the random key, so that no other use of the same seed meets its numbers."""


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
        ((a, b),) = point_keys(np.empty((1, 0)), domain=DOMAIN, seed=self.seed)
        draws = np.empty((len(index), 3))
        _draw(a, b, np.asarray(index, np.int64), STREAM_POINTING_JITTER, draws)
        return jitter_attitude(attitude, sigma=self.sigma, draws=draws)


@njit(cache=True, nogil=True)
def _draw(key0, key1, index, stream, draws):
    """Three standard normal numbers for each shot, whose number stands for that of a draw."""
    for i in range(index.size):
        draws[i, 0], draws[i, 1] = normal_pair(key0, key1, index[i], stream, 0)
        draws[i, 2], _ = normal_pair(key0, key1, index[i], stream, 1)


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


@njit(cache=True, nogil=True, error_model="numpy")
def transverse_of(u):
    """Two unit vectors across a direction, so that (first, second, direction) is right-handed.

    For a beam near -z the first lies near x. A smooth function of the direction but along -x
    and x, where no beam of a downward-looking instrument points.
    """
    second = cross(u, (1.0, 0.0, 0.0))
    second = (0.0, 1.0, 0.0) if _length(second) < 1e-6 else _unit(second)
    first = _unit(cross(second, u))
    return first, cross(u, first)


@njit(cache=True, nogil=True, error_model="numpy")
def _length(v):
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@njit(cache=True, nogil=True, error_model="numpy")
def _unit(v):
    length = _length(v)
    return v[0] / length, v[1] / length, v[2] / length
