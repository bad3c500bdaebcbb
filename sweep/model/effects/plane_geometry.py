"""What a beam meets on a flat plane, over the points of a tile: bounds in compiled formulas.

With u the angle of a beamlet along the slope times cot(grazing), (1 + d)/(1 + u) is R_b/R_0 and
((1 + u)/|d|)^m its echo over that on the axis, d its direction, whose length on the axis is 1, and
m = 2 for laws that are even in all directions, 3 for Lambert's. The pattern has exactly the beam's
covariance, so that u has the mean 0 and the rms q = (divergence/4) cot(grazing). Where a beamlet
may pass over the horizon moments are infinite, and only the beamlets' own echoes bound their sum.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from sweep.model.effects.columns import columns
from sweep.model.effects.line_spread import NO_SPREAD, Moments, reach_of
from sweep.model.footprint import beamlets
from sweep.model.reflectance import LAWS, backscatter_of

ECHO, RATIO, GAIN, RANGES, VELOCITIES, FIELDS = 0, 2, 4, 6, 9, 12
"""Rows of what is found of planes: ends of the bare line's echo, of all echo over it and of the
gain, moments of ranges and of velocities."""

Beam = tuple[int, float, float, bool]
"""Beamlets, their reach in standard deviations, the sum of the roots of their weights; whether
amplitudes are the roots of echoes."""

_LAMBERT = LAWS.index("lambert")
_ROUNDING = 1e-12


def beam_of(number: int, pattern: str, architecture: str) -> Beam:
    """What the formulas take of a beam."""
    level = float(np.sqrt(beamlets(number, pattern)[1]).sum())
    return number, reach_of(number, pattern) if number > 1 else 0.0, level, architecture != "direct"


def plane_range_moments(
    *, grazing_angle: ArrayLike, beam_divergence: ArrayLike, number: int, pattern: str
) -> Moments:
    """Bounds on (R_b - R_0)/R_0 of a beam on a plane, weighted by echo power.

    u has the rms q; the rest bounds Taylor's remainders.
    """
    if number == 1:
        return NO_SPREAD
    table, shape = columns(grazing_angle, beam_divergence)
    found = np.empty((3, *shape))
    _put_range_moments(table, reach_of(number, pattern), found.reshape(3, -1))
    return Moments(*(np.asarray(value) for value in found))


def plane_velocity_moments(
    *,
    across: ArrayLike,
    along: ArrayLike,
    grazing_angle: ArrayLike,
    beam_divergence: ArrayLike,
    number: int,
    pattern: str,
) -> Moments:
    """Bounds on the beamlets' radial velocities less the axis's [m/s], at a velocity off the beam.

    A beamlet x off the axis sees v_across x / |d| + v_along (1/|d| - 1), |d|^2 = 1 + x^2; its
    weight is that of :func:`plane_range_moments`.
    """
    if number == 1:
        return NO_SPREAD
    table, shape = columns(across, along, grazing_angle, beam_divergence)
    found = np.empty((3, *shape))
    _put_velocity_moments(table, reach_of(number, pattern), found.reshape(3, -1))
    return Moments(*(np.asarray(value) for value in found))


@njit(cache=True, error_model="numpy")
def _put_range_moments(table, radius, out):
    for i in range(table.shape[1]):
        out[0, i], out[1, i], out[2, i] = _range_moments(table[0, i], table[1, i], radius)


@njit(cache=True, error_model="numpy")
def _put_velocity_moments(table, radius, out):
    for i in range(table.shape[1]):
        across, along, angle, divergence = table[:, i]
        out[0, i], out[1, i], out[2, i] = _velocity_moments(
            (across, along), angle, divergence, radius
        )


@njit(cache=True, error_model="numpy")
def _range_moments(angle, divergence, radius):
    """Mean, rms and extreme of (R_b - R_0)/R_0."""
    sigma = divergence / 4
    rms = sigma / np.tan(angle)
    widest, bulge = radius * rms, (radius * sigma) * (radius * sigma) / 2
    if not widest < 1:
        return np.inf, np.inf, np.inf
    inside, side = 1 - widest, 1 + widest
    heavier = side * side * side * np.exp(6 * bulge)
    lean = 3 * rms * rms * side * side * np.exp(6 * bulge) + 6 * rms * bulge
    mean = lean + (rms * rms + sigma * sigma) * heavier / inside
    far = (rms + sigma * np.sqrt(bulge)) * np.sqrt(heavier) / inside
    return mean, far, (widest + bulge) / inside


@njit(cache=True, error_model="numpy")
def _velocity_moments(velocities, angle, divergence, radius):
    """Mean, rms and extreme of radial velocities less the axis's."""
    across, along = abs(velocities[0]), abs(velocities[1])
    sigma = divergence / 4
    slope = sigma / np.tan(angle)
    side, bulge = 1 + np.minimum(radius * slope, 1.0), (radius * sigma) * (radius * sigma) / 2
    heavier = side * side * side * np.exp(6 * bulge)
    lean = sigma * (3 * slope * heavier + 8 * radius * bulge)
    return (
        across * lean + along * (sigma * sigma) * heavier,
        (across * sigma + along * sigma * np.sqrt(bulge)) * np.sqrt(heavier),
        across * radius * sigma + along * bulge,
    )


@njit(cache=True, error_model="numpy")
def put_planes(table, law, beam, out):
    """What beams meet in tiles of points, (fields, tiles).

    Parameters
    ----------
    table : (8, tiles) float64
        Ends of grazing angle and divergence [rad], radial and transverse velocity [m/s].
    law : int
        Place of the reflectance law in :data:`sweep.model.reflectance.LAWS`.
    beam : Beam
        Of :func:`beam_of`.
    """
    number, reach, _, _ = beam
    for t in range(table.shape[1]):
        angle, divergence = (table[0, t], table[1, t]), (table[2, t], table[3, t])
        one, other = backscatter_of(law, np.sin(angle[0])), backscatter_of(law, np.sin(angle[1]))
        out[ECHO, t], out[ECHO + 1, t] = one, other
        each, whole = _echoes(law, angle, divergence, reach)
        out[RATIO, t], out[RATIO + 1, t] = whole
        out[GAIN, t], out[GAIN + 1, t] = _gain(each, whole, beam)
        if number == 1:
            out[RANGES:, t] = 0.0
            continue
        along = max(abs(table[4, t]), abs(table[5, t]))
        across = max(abs(table[6, t]), abs(table[7, t]))
        ranges = _range_moments(angle[0], divergence[1], reach)
        moved = _velocity_moments((across, along), angle[0], divergence[1], reach)
        for m in range(3):
            out[RANGES + m, t], out[VELOCITIES + m, t] = ranges[m], moved[m]


@njit(cache=True, error_model="numpy")
def _echoes(law, angle, divergence, reach):
    """Ends of the echo of any beamlet, and of all of them, over what they would have on the axis.

    As u has the mean 0, their sum differs from 1 in the second order.
    """
    power = 3 if law == _LAMBERT else 2
    least, most = divergence[0] / 4 / np.tan(angle[1]), divergence[1] / 4 / np.tan(angle[0])
    rim, widest = reach * divergence[1] / 4, reach * most
    longest = np.sqrt(1 + rim * rim)
    near = np.minimum(1 + widest, 1 / np.sin(angle[0])) ** power
    far = (np.maximum(1 - widest, 0.0) / longest) ** power
    less, more = 0.0, np.inf
    if widest < 1:
        lean = 0.0 if power == 2 else widest
        bend = power * (power - 1) / 2
        square = (least * least, most * most) if reach > 0 else (0.0, 0.0)
        more = 1 + (bend + lean) * square[1]
        less = (1 + (bend - lean) * square[0]) / longest**power
    whole = (
        np.maximum(less, far) * (1 - _ROUNDING),
        np.minimum(more, near) * (1 + _ROUNDING),
    )
    return (far, near), whole


@njit(cache=True, error_model="numpy")
def _gain(each, whole, beam):
    """Ends of the gain of beamlets whose echoes are the pattern's weights but for the plane's."""
    number, _, level, by_roots = beam
    if not by_roots:
        return 1.0, 1.0
    low, high = 1.0, math.sqrt(number)
    if whole[0] > 0:
        low = np.minimum(level * np.sqrt(each[0]) / np.sqrt(whole[1]), high)
        high = np.minimum(level * np.sqrt(each[1]) / np.sqrt(whole[0]), high)
    return np.maximum(low * (1 - _ROUNDING), 1.0), np.maximum(high * (1 + _ROUNDING), 1.0)
