"""Phase errors over the record: range walk, acceleration, and nonlinearity of the sweep.

Each effect has a phase psi(t) [cycles], added to the beat of every line
(:mod:`sweep.model.waveform`). It also has a phase-error bound, a polynomial in the position x in
the record, from which its error bound follows.

Range walk and acceleration are the beat's terms in t^2 and beyond, for a target of the delay tau(t)
= tau_0 - beta t - alpha t^2, beta = 2 v_r / c, alpha = a / c:

    psi(t) = s S beta (1 + beta / 2) t^2                                                range walk
    psi(t) = f_seg alpha t^2 + s S [ -tau_0 alpha t^2 + alpha (1 + beta) t^3 + alpha^2 t^4 / 2 ]

v_r is the radial velocity, a the acceleration, f_seg the segment's carrier, S the chirp rate, and s
the sign of the chirp, 1, 0 or -1.

Range walk is a frequency drift of 2 s S (2 v_r / c), of opposite sign in up- and down-chirp, and 0
in the Doppler segment. Half of it comes from the range, half from the chirp's rising Doppler shift.
Acceleration is mostly a drift of 2 a / lambda, positive when the radial velocity grows. If the beam
slides over sloping ground, the range along the beam falls at a speed u that differs from v_r. The
range's half then follows u, which adds s S (u - v_r) / c t^2. Time starts at the segment's start:
the line moves by the drift up to the middle of the record and spreads over the drift within it.

A sweep departs from a straight line by e(x) [Hz], a property of the laser's tuning. It is a
function of the position u along the sweep, -1 at the lowest and 1 at the highest frequency, so that
the down-chirp passes it backwards:

    e = q T_2(u) + k T_3(u) + p sin(pi m u),    u = s (2 t / T - 1)

T_2 = 2 u^2 - 1 and T_3 = 4 u^3 - 3 u are a square and a cube less their best straight lines, with
peak 1. The number m is the number of periods over the sweep. With E the integral of e over time,
the beat (delayed wave less local oscillator) gains exactly

    psi(t) = E(t - tau(t)) - E(t),    tau(t) = tau_0 - beta t

about -tau e(t): 0 at range 0, and growing with range. The Doppler segment has no sweep. A measured
error is a table of frequency errors over the time in the up-chirp. It is fitted once by a Chebyshev
series (:mod:`sweep.model.effects.sweep_error_table`), whose integral over the delay is exact.

Error bounds: the window w is real and even about the record's middle. A phase error has an odd and
an even part, phi = o(x) + e(x); a constant does not matter. A line's spectrum W(y) is real except
for the factor exp(-i pi y) and the unpaired first sample w_0. The phase error changes it by A + i
B, where relative to sum w

    |A| <= a = <|o| + e^2 / 2>      |B| <= b = <|e|>      < > the mean weighted with |w| / sum w

The largest bin has M >= c. For one line c is the scalloping loss. For several lines that add as
powers it is the root of the largest bin's fraction of all power, by the triangle inequality of
their bins. So

    1 - (a + b |w_0| / c) / c  <=  M' / M  <=  sqrt((1 + a/c)^2 + (2 b |w_0| + b^2) / c^2)

An even error, as a drift within the record, thus counts in second order. Lines that add as
amplitudes, or with their own images, change by <|phi|> of the sum of their amplitudes, whatever
their sum is.

References
----------
All phases are the exact beat phase of :mod:`sweep.model.waveform` for this delay, less its terms up
to t (docs/physics.md, *Range walk and its like*). Simulated records of the exact delay check them
(:mod:`sweep.model.time_domain_truth`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from sweep.model import shot_settings
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.looks import coherent_amplitude_factor
from sweep.model.effects.effect import Effect, EffectContext, Parameter
from sweep.model.effects.error_bounds import (
    NO_PHASE_ERROR,
    ArrayOrFloat,
    ErrorBound,
    PhaseErrorBound,
)
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.effects.sweep_error_table import SweepFrequencyError, fit_sweep_frequency_error
from sweep.model.preparation import Shots
from sweep.model.shot_records import PhaseError
from sweep.model.shot_settings import CHIRP_PREFIX
from sweep.model.waveform import round_trip_delay
from sweep.model.window import Window, window_samples

_N_WINDOW_NODES = 256
"""Number of positions in the record at which the window is sampled, for means under the window."""
_RADIANS_PER_CYCLE = 2 * math.pi
"""Factor 2 pi that converts a phase from cycles to radians."""
_REMAINING_AMPLITUDE_WITH_IMAGE_MIN = 0.9
"""Lower bound on the amplitude of a line to which sidelobes of its distant image add, as a fraction
of the amplitude without the image."""


class MomentsByExponent(NamedTuple):
    """Moments of the powers x^1 .. x^4 of the position x in the record, -1..1."""

    linear: float
    """Moment of x."""
    quadratic: float
    """Moment of x^2."""
    cubic: float
    """Moment of x^3."""
    quartic: float
    """Moment of x^4."""


class WindowMoments(NamedTuple):
    """Means under a window w of powers 1..4 of the position x in the record, -1..1.

    The mean < > is the sum weighted with |w| / sum w.
    """

    absolute_moments: MomentsByExponent
    """Means of |x^k| for k = 1, 3, and of |x^k - <x^k>| for k = 2, 4. x is the position in the
    record, -1..1, and < > the mean weighted by the window's |w|."""
    rms_moments: MomentsByExponent
    """Root mean squares of x^k about its mean for k = 2, 4, and 0 for k = 1, 3. x is the position
    in the record, -1..1; means are weighted by the window."""
    fitted_slopes: MomentsByExponent
    """Slopes of the best straight lines to x^k, k = 1 .. 4, over the position x in the record,
    -1..1. The slopes are 0 for even k."""
    fitted_slope_max: float
    """Largest slope of the best straight line to any function of x with values in -1..1."""
    magnitude_sum_ratio: float
    """Sum of the window's magnitudes |w| over the sum of its values w, >= 1."""
    first_sample_weight: float
    """Magnitude of the window's first value over the sum of its values."""
    position_variance: float
    """Variance of the position in the record under the window's |w|, over the square of the
    record's length."""


@lru_cache(maxsize=16)
def window_moments(window: Window) -> WindowMoments:
    """Return the means of powers of the position in the record, weighted by a window."""
    node = (2 * np.arange(_N_WINDOW_NODES) + 1) / _N_WINDOW_NODES - 1
    w = window_samples(window.name, window.length)
    sample_position = 2 * np.arange(window.length + 1) / window.length - 1
    window_at_nodes = np.interp(node, sample_position, np.append(w, w[:1]))
    weight = np.abs(window_at_nodes) / window_at_nodes.sum()
    magnitude_sum_ratio, second_moment = float(weight.sum()), float((node * node * weight).sum())
    absolute_moments, rms_moments, fitted_slopes = [], [], []
    for k in range(1, 5):
        power = node**k
        fitted_slopes.append(float((power * node * weight).sum()) / second_moment if k % 2 else 0.0)
        if k % 2 == 0:
            power = power - (power * weight).sum() / magnitude_sum_ratio
        absolute_moments.append(float((abs(power) * weight).sum()))
        rms_moments.append(float(np.sqrt((power**2 * weight).sum())) if k % 2 == 0 else 0.0)
    absolute_moments_by_exponent = MomentsByExponent(*absolute_moments)
    return WindowMoments(
        absolute_moments=absolute_moments_by_exponent,
        rms_moments=MomentsByExponent(*rms_moments),
        fitted_slopes=MomentsByExponent(*fitted_slopes),
        fitted_slope_max=absolute_moments_by_exponent.linear / second_moment,
        magnitude_sum_ratio=magnitude_sum_ratio,
        first_sample_weight=abs(window.first_value) / window.sum,
        position_variance=second_moment / 4 / magnitude_sum_ratio,
    )


def polynomial_phase_bound(
    points: PlannerInputs, coefficient_by_power: Mapping[int, np.ndarray]
) -> PhaseErrorBound:
    """Return a bound on the phase sum_j c_j t^j, as a polynomial in the position x in the record.

    Parameters
    ----------
    points : PlannerInputs
        Points that are planned together.
    coefficient_by_power : mapping
        Coefficients c_j [cycles/s^j] by power j of the time since the segment's start.

    Returns
    -------
    PhaseErrorBound
        Magnitudes of the coefficients of x^0..x^4, for x = -1..1.
    """
    half_duration = 0.5 * points.record.duration
    record_middle = points.record.acquisition_delay + half_duration
    polynomial: list[np.ndarray | float] = [0.0] * 5
    for j, coefficient in coefficient_by_power.items():
        for k in range(j + 1):
            polynomial[k] = (
                polynomial[k]
                + math.comb(j, k) * record_middle ** (j - k) * half_duration**k * coefficient
            )
    constant, *coefficients = (np.abs(coefficient) for coefficient in polynomial)
    return PhaseErrorBound(tuple(coefficients), mid_record_phase=constant)


def mean_phase_bound(phase_bound: PhaseErrorBound, window: Window) -> np.ndarray:
    """Return a bound on the change that a phase error causes in any bin of a line.

    The change is relative to the line's peak.

    Parameters
    ----------
    phase_bound : PhaseErrorBound
        Bound of the phase error phi.
    window : Window
        Window of the record.

    Returns
    -------
    ndarray
        Bound, the mean of |phi| over the record [rad], weighted with |w| / sum w for the window w.
    """
    moments = window_moments(window)
    total = phase_bound.non_polynomial_phase * moments.magnitude_sum_ratio
    for value, mean in zip(phase_bound.coefficients, moments.absolute_moments, strict=True):
        total = total + value * mean
    return np.minimum(_RADIANS_PER_CYCLE * total, 2 * moments.magnitude_sum_ratio)


def coherent_sum_change(points: PlannerInputs, phase_bound: PhaseErrorBound) -> np.ndarray:
    """Return a bound on the change by a phase error if amplitudes of lines and images add.

    The phase in the record's middle changes the sum of a line and its image, near or distant.

    Parameters
    ----------
    points : PlannerInputs
        Points that are planned together
        (:class:`sweep.model.effects.planner_inputs.PlannerInputs`).
    phase_bound : PhaseErrorBound
        Bound of the phase error phi (:class:`sweep.model.effects.error_bounds.PhaseErrorBound`).

    Returns
    -------
    ndarray (segments, n)
        Bound >= 0, relative to the sum of all amplitudes in phase
        (:attr:`sweep.model.effects.error_bounds.ErrorBound.coherent_sum_change`).

    Notes
    -----
    Let p = min(max |phi|, 2) [rad], and let g be the smallest |X| of a line between two bins,
    relative to that on a bin. For lines near their images, the bound is 2 p sum |w| / (g sum w),
    with the window w. Where the amplitudes of beamlets may nearly cancel, it is 2 <|phi|> / g, with
    the mean < > of :func:`mean_phase_bound`. Otherwise it is p times the largest |X| of images over
    that of all lines in phase.
    """
    moments = window_moments(points.window)
    phase_anywhere = np.minimum(
        _RADIANS_PER_CYCLE
        * (
            sum(phase_bound.coefficients)
            + phase_bound.non_polynomial_phase
            + phase_bound.mid_record_phase
        ),
        2.0,
    )
    phase_change = np.where(
        points.is_near_image,
        moments.magnitude_sum_ratio * phase_anywhere,
        mean_phase_bound(phase_bound, points.window),
    )
    near_change = 2 * phase_change / points.window_response.scalloping_gain_min
    return np.where(
        points.amplitudes_may_cancel, near_change, points.image_magnitude_bound * phase_anywhere
    )


def phase_omission_bound(points: PlannerInputs, name: str) -> ErrorBound | None:
    """Return a bound on the change of results if one of the phase errors is omitted.

    The bound holds whichever of the other phase errors are present.

    Parameters
    ----------
    points : PlannerInputs
        Points that are planned together, with their `phase_error_bounds`.
    name : str
        Name of the effect.

    Returns
    -------
    ErrorBound or None
        None if the effect is absent. The module's description has the equations.
    """
    own_bound = points.phase_error_bounds.get(name)
    if own_bound is None:
        return None
    moments, other_bounds = window_moments(points.window), NO_PHASE_ERROR
    for other_name, other_bound in points.phase_error_bounds.items():
        other_bounds = other_bounds if other_name == name else other_bounds.plus(other_bound)
    linear, quadratic, cubic, quartic = own_bound.coefficients
    non_polynomial = _RADIANS_PER_CYCLE * own_bound.non_polynomial_phase
    odd_phase = non_polynomial * moments.magnitude_sum_ratio
    odd_phase = odd_phase + _RADIANS_PER_CYCLE * (
        linear * moments.absolute_moments.linear + cubic * moments.absolute_moments.cubic
    )
    even_phase = non_polynomial * moments.magnitude_sum_ratio
    even_phase = even_phase + _RADIANS_PER_CYCLE * (
        quadratic * moments.absolute_moments.quadratic + quartic * moments.absolute_moments.quartic
    )
    even_root_mean_square = non_polynomial * math.sqrt(moments.magnitude_sum_ratio)
    even_root_mean_square = even_root_mean_square + _RADIANS_PER_CYCLE * (
        quadratic * moments.rms_moments.quadratic + quartic * moments.rms_moments.quartic
    )
    turned_by_others: np.ndarray | float = 0.0
    others_phase: np.ndarray | float = 0.0
    if len(points.phase_error_bounds) > 1:
        others_phase = mean_phase_bound(other_bounds, points.window)
        others_far = _RADIANS_PER_CYCLE * (
            sum(other_bounds.coefficients) + other_bounds.non_polynomial_phase
        )
        turned_by_others = mean_phase_bound(own_bound, points.window) * np.minimum(others_far, 2.0)
    missing = points.missing_sample_bounds
    # Missing samples have no phase error, and the centroid of the remaining samples moves.
    if missing is not None:
        others_phase = others_phase + missing.lost_fraction
        turned_by_others = turned_by_others + missing.lost_fraction * np.minimum(
            _RADIANS_PER_CYCLE * (sum(own_bound.coefficients) + own_bound.non_polynomial_phase), 2.0
        )
    a = (
        np.minimum(odd_phase, 2 * moments.magnitude_sum_ratio)
        + np.minimum(
            even_root_mean_square * even_root_mean_square / 2, 2 * moments.magnitude_sum_ratio
        )
        + turned_by_others
    )
    b = np.minimum(even_phase, moments.magnitude_sum_ratio) + turned_by_others
    power_min = (
        points.peak_power_bounds.power_min
        / np.where(points.is_near_image, 2.0, 1.01)
        / (1 + other_bounds.extra_shift_window_bins)
    )
    c = _REMAINING_AMPLITUDE_WITH_IMAGE_MIN * np.sqrt(power_min) - others_phase
    magnitude_change = np.where(
        c > 0, (a + b * moments.first_sample_weight / c) / c + 0.5 * (b / c) ** 2, np.inf
    )
    mean_slope = non_polynomial / _RADIANS_PER_CYCLE * moments.fitted_slope_max
    for coefficient, fitted_slope in zip(
        own_bound.coefficients, moments.fitted_slopes, strict=True
    ):
        mean_slope = mean_slope + coefficient * fitted_slope
    if missing is not None:
        mean_slope = mean_slope + missing.centroid_bound * (2 * quadratic + 3 * cubic + 4 * quartic)
    shift_bins = 2 * mean_slope * points.padding_factor
    if not points.amplitudes_may_add:
        return ErrorBound(magnitude_change=magnitude_change, shift_bins=shift_bins)
    lone_change = np.where(points.amplitudes_may_cancel, 0.0, magnitude_change)
    return ErrorBound(
        magnitude_change=lone_change,
        coherent_sum_change=coherent_sum_change(points, own_bound),
        shift_bins=shift_bins,
    )


def _add_phase_error(
    shots: Shots, phase_function: Callable[..., np.ndarray], **values: Any
) -> Shots:
    """Return shots whose records have an additional phase error.

    ``phase_function`` returns the phase [cycles] at positions in the record. ``values`` are the
    keyword arguments of ``phase_function``.
    """
    phase_error = PhaseError(phase_function, values | shots.echo_interval_in_record)
    return replace(
        shots,
        echo_record=shots.echo_record._replace(
            phase_errors=(*shots.echo_record.phase_errors, phase_error)
        ),
    )


def times_in_record(position: np.ndarray, *, start: np.ndarray, duration: np.ndarray) -> np.ndarray:
    """Return the times since the segment's start at positions of the record.

    Parameters
    ----------
    position : ndarray (m,)
        Positions x in the record, -1..1.
    start, duration : ndarray
        Time from the segment's start to the record's start, and duration of the record [s], (n,) or
        scalar.

    Returns
    -------
    ndarray (n, m)
        Times [s].
    """
    start, duration = np.atleast_1d(start), np.atleast_1d(duration)
    return start[:, None] + duration[:, None] * (np.asarray(position) + 1) / 2


def _as_column(value: np.ndarray) -> np.ndarray:
    """Return a scalar or an array (n,) as a column, (1, 1) or (n, 1)."""
    return np.atleast_1d(np.asarray(value, float))[:, None]


def range_walk_phase(
    position: np.ndarray,
    *,
    sign: int,
    chirp_rate: np.ndarray,
    radial_velocity: np.ndarray,
    start: np.ndarray,
    duration: np.ndarray,
    slide: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Return the phase that range walk adds to the beat of a line.

    Parameters
    ----------
    position : ndarray (m,)
        Positions x in the record, -1..1.
    sign : int
        Sign s of the chirp; 0 for the Doppler segment.
    chirp_rate : ndarray
        Chirp rate S [Hz/s].
    radial_velocity : ndarray (n,)
        Radial velocity v_r [m/s].
    start, duration : ndarray
        Time from the segment's start to the start of the echo's record, and duration of the record
        [s].
    slide : ndarray or float
        Speed u - v_r [m/s] by which the range along the beam falls faster than at the radial
        velocity at the segment's start.

    Returns
    -------
    ndarray (n, m)
        s S (beta (1 + beta / 2) + (u - v_r) / c) t^2 [cycles], with beta = 2 v_r / c and the time t
        since the segment's start.
    """
    doppler_ratio = 2 * np.asarray(radial_velocity, float) / SPEED_OF_LIGHT
    drift_rate = (
        sign * chirp_rate * (doppler_ratio * (1 + doppler_ratio / 2) + slide / SPEED_OF_LIGHT)
    )
    return (
        np.atleast_1d(drift_rate)[:, None]
        * times_in_record(position, start=start, duration=duration) ** 2
    )


def range_walk_phase_bound(points: PlannerInputs) -> PhaseErrorBound | None:
    """Return the bound of the phase that range walk adds over the record; None if it is absent.

    Range walk is the drift of the beat as the range changes.
    """
    doppler_ratio_growth = points.stack_segments(
        *(
            shot_settings.doppler_ratio(points.target.acceleration * segment.start_time)
            for segment in points.existing_segments
        )
    )
    slide_speed = points.target.approach_speed - points.target.radial_velocity
    doppler_ratio = points.target.doppler_ratio + doppler_ratio_growth
    drift_ratio = doppler_ratio * (1 + doppler_ratio / 2) + slide_speed / SPEED_OF_LIGHT
    if not drift_ratio.any():
        return None
    return polynomial_phase_bound(
        points, {2: points.existing_chirp_slopes * points.waveform.chirp_rate * drift_ratio}
    )


def apply_range_walk(shots: Shots, context: EffectContext) -> Shots:
    """Make the beats of the two chirps drift over the record, as the range falls.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Not used (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the phase error of :func:`range_walk_phase`, and with the time to which their
        measured range refers.

    Notes
    -----
    The phase is s S (beta (1 + beta / 2) + (u - v_r) / c) t^2 [cycles], as the module's description
    states. The beat at t is that of the range R - 2 v_r t: half of the drift comes from the range,
    half from the chirp's rising Doppler shift.
    """
    velocity, slide = (
        shots.range_and_velocity_by_segment["radial_velocity"],
        shots.target.approach_speed - shots.target.radial_velocity,
    )
    shots = _add_phase_error(
        shots,
        range_walk_phase,
        chirp_rate=shots.waveform.chirp_rate,
        radial_velocity=velocity,
        slide=slide,
    )
    walk_time = shots.motion.range_reference_time + slope_of_squared_time(shots)
    return replace(shots, motion=shots.motion._replace(range_reference_time=walk_time))


def slope_of_squared_time(shots: Shots) -> np.ndarray:
    """Return the mean slope of t^2 over the records of both chirps [s], (n,) or scalar.

    t is the time since the segment's start. The slope is that of the best straight line, weighted
    by the window, over the samples that hold the echo. If the echo fills the record, the slope is
    twice the time at the record's middle.
    """
    drift_time = 2 * shots.record.acquisition_delay + shots.record.duration
    if shots.echo_record.n_samples_before_echo is None:
        return np.asarray(drift_time)
    slope = _squared_position_slopes(shots.window)[
        shots.echo_record.n_samples_before_echo[::2]
    ].mean(axis=0)
    return np.asarray(drift_time + 0.5 * shots.record.duration * slope)


@lru_cache(maxsize=8)
def _squared_position_slopes(window: Window) -> np.ndarray:
    """Return slopes (L + 1,) of the best straight line to x^2 over the last samples of a record.

    x is the position in the record of L samples, -1..1. Element k = 0 .. L is the slope over the
    samples k .. L - 1, weighted by the window. Element 0, the slope over all samples, is 0.
    """
    position = 2 * np.arange(window.length) / window.length - 1
    powers = (window.samples() * position**exponent for exponent in range(4))
    moment_0, moment_1, moment_2, moment_3 = (
        np.cumsum(moment_terms[::-1])[::-1] for moment_terms in powers
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        moment_1, moment_2, moment_3 = moment_1 / moment_0, moment_2 / moment_0, moment_3 / moment_0
        slope = (moment_3 - moment_1 * moment_2) / (moment_2 - moment_1 * moment_1)
    slope = np.clip(
        np.where(np.isfinite(slope), slope, 2 * position), np.minimum(2 * position, 0.0), 2.0
    )
    slope[0] = 0.0
    return np.append(slope, 2.0)


RANGE_WALK = Effect(
    name="range_walk",
    description="drift of the beat as the target moves",
    stage="record",
    error_bound=partial(phase_omission_bound, name="range_walk"),
    phase_error_bound=range_walk_phase_bound,
    apply=apply_range_walk,
)
"""Effect that lets the beats of both chirps drift over the record, as the range changes."""


_ACCELERATION_PATH = "target.acceleration"


def acceleration_phase(
    position: np.ndarray,
    *,
    sign: int,
    carrier: np.ndarray,
    chirp_rate: np.ndarray,
    range: np.ndarray,
    radial_velocity: np.ndarray,
    acceleration: np.ndarray,
    start: np.ndarray,
    duration: np.ndarray,
) -> np.ndarray:
    """Return the phase that acceleration adds to the beat.

    Parameters
    ----------
    position : ndarray (m,)
        Positions x in the record, -1..1.
    sign : int
        Sign s of the chirp; 0 for the Doppler segment.
    carrier, chirp_rate : ndarray
        Carrier f_seg [Hz] and chirp rate S [Hz/s].
    range, radial_velocity, acceleration : ndarray (n,)
        Values at the segment's start [m, m/s, m/s^2].
    start, duration : ndarray
        Time from the segment's start to the start of the echo's record, and duration of the record
        [s].

    Returns
    -------
    ndarray (n, m)
        alpha t^2 (f_seg + s S (-tau_0 + (1 + beta) t + alpha t^2 / 2)) [cycles]. alpha is the
        acceleration over c, tau_0 the delay and beta the Doppler ratio at the segment's start, and
        t the time since then.
    """
    alpha = _as_column(np.asarray(acceleration) / SPEED_OF_LIGHT)
    beta = _as_column(2 * np.asarray(radial_velocity) / SPEED_OF_LIGHT)
    delay = _as_column(round_trip_delay(np.asarray(range)))
    t = times_in_record(position, start=start, duration=duration)
    chirp_term = -delay + (1 + beta) * t + alpha * t**2 / 2
    signed_chirp_rate = _as_column(sign * np.asarray(chirp_rate))
    return np.asarray(alpha * t**2 * (_as_column(carrier) + signed_chirp_rate * chirp_term))


def acceleration_phase_bound(points: PlannerInputs) -> PhaseErrorBound | None:
    """Return the bound of the phase over the record that acceleration adds; None if it is 0."""
    if not points.any_nonzero(_ACCELERATION_PATH):
        return None
    alpha = points[_ACCELERATION_PATH] / SPEED_OF_LIGHT
    signed_chirp_rate = points.existing_chirp_slopes * points.waveform.chirp_rate
    coefficient_by_power = {
        2: alpha * (points.carriers - signed_chirp_rate * points.target.delay),
        3: alpha * signed_chirp_rate * (1 + points.target.doppler_ratio),
        4: alpha**2 * signed_chirp_rate * 0.5,
    }
    return polynomial_phase_bound(points, coefficient_by_power)


def acceleration_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of the largest bin if acceleration is omitted.

    The target's acceleration makes lines drift within a record and from look to look (record of
    each segment). The loss of looks that are added in amplitude is exact.
    """
    bound = phase_omission_bound(points, "acceleration")
    if bound is None or points.looks.n_coherent == 1:
        return bound
    up_carrier, *_ = points.carriers
    gain = coherent_amplitude_factor(
        points.looks, acceleration=points.target.acceleration, carrier=up_carrier,
        look_period=points.waveform.look_period,
    )  # fmt: skip
    return bound._replace(magnitude_change=bound.magnitude_change + 1 - gain)


def apply_acceleration(shots: Shots, context: EffectContext) -> Shots:
    """Make the Doppler frequency drift over all records, as the target accelerates.

    Looks that are added in amplitude lose signal by the drift; this loss is included.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Not used (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the phase error of :func:`acceleration_phase`, and with the time to which their
        measured velocity refers.

    Notes
    -----
    The phase is alpha t^2 (f_seg + s S (-tau_0 + (1 + beta) t + alpha t^2 / 2)) [cycles], as the
    module's description states. The measured velocity refers to the middle of the record.
    """
    if shots.looks.n_coherent > 1:
        up_carrier, _, _ = shots.waveform.carriers
        gain = coherent_amplitude_factor(
            shots.looks, acceleration=shots.target.acceleration, carrier=up_carrier,
            look_period=shots.waveform.look_period,
        )  # fmt: skip
        shots = replace(
            shots, echo_scales=shots.echo_scales.with_scaled_echo(amplitude_factor=gain)
        )
    drift_time = shots.record.acquisition_delay + shots.record.duration / 2
    shots = replace(shots, motion=shots.motion._replace(velocity_drift_time=drift_time))
    return _add_phase_error(
        shots,
        acceleration_phase,
        carrier=shots.waveform.carriers,
        chirp_rate=shots.waveform.chirp_rate,
        acceleration=shots.target.acceleration,
        **shots.range_and_velocity_by_segment,
    )


ACCELERATION = Effect(
    name="acceleration",
    description="drift of the Doppler frequency",
    stage="record",
    error_bound=acceleration_error_bound,
    phase_error_bound=acceleration_phase_bound,
    apply=apply_acceleration,
    is_in_time_domain_truth=False,
    parameters=(
        Parameter(
            path=_ACCELERATION_PATH,
            description="Rate at which the radial velocity grows",
            example="10 m/s^2",
            limits=("-1e6 m/s^2", "1e6 m/s^2"),
        ),
    ),
)
"""Effect that lets the Doppler frequency drift over the record, as the target accelerates."""


_SWEEP_ERROR_SHAPES = ("quadratic", "cubic", "sinusoidal")
_SWEEP_ERROR_PEAK_PATHS = tuple(f"{CHIRP_PREFIX}{shape}_error" for shape in _SWEEP_ERROR_SHAPES)
_SWEEP_ERROR_PERIODS_PATH = CHIRP_PREFIX + "error_periods"
ERROR_TABLE_PATH, NO_TABLE = CHIRP_PREFIX + "error_table", "none"


def sweep_error_table_phase(
    position: np.ndarray,
    *,
    table: SweepFrequencyError,
    sign: int,
    chirp_duration: np.ndarray,
    range: np.ndarray,
    radial_velocity: np.ndarray,
    start: np.ndarray,
    duration: np.ndarray,
) -> np.ndarray:
    """Return the phase that a measured error of the sweep adds to the beat.

    Parameters
    ----------
    position : ndarray (m,)
        Positions x in the record, -1..1.
    table : SweepFrequencyError
        Measured frequency error of the sweep over the time in the up-chirp.
    sign : int
        Sign s of the chirp; 0 for the Doppler segment.
    chirp_duration : ndarray
        Duration of the chirp [s].
    range, radial_velocity : ndarray (n,)
        Values at the segment's start [m, m/s].
    start, duration : ndarray
        Time from the segment's start to the start of the echo's record, and duration of the record
        [s].

    Returns
    -------
    ndarray (n, m)
        E(t - tau(t)) - E(t) [cycles].

    Notes
    -----
    E is the integral of the frequency error over time, and tau(t) the echo's delay. The down-chirp
    passes the table backwards. Before the first row and after the last the error is constant.
    """
    if sign == 0:
        return np.zeros((np.size(range), np.size(position)))
    t = times_in_record(position, start=start, duration=duration)
    doppler_ratio = _as_column(2 * np.asarray(radial_velocity) / SPEED_OF_LIGHT)
    delay = _as_column(round_trip_delay(np.asarray(range))) - doppler_ratio * t
    sweep_time = t if sign > 0 else _as_column(chirp_duration) - t  # time in the up-chirp
    return -sign * table.integrate_error(sweep_time - sign * delay, sweep_time)


def chirp_nonlinearity_phase(
    position: np.ndarray,
    *,
    sign: int,
    chirp_duration: np.ndarray,
    range: np.ndarray,
    radial_velocity: np.ndarray,
    quadratic: np.ndarray,
    cubic: np.ndarray,
    sinusoidal: np.ndarray,
    periods: np.ndarray,
    start: np.ndarray,
    duration: np.ndarray,
) -> np.ndarray:
    """Return the phase that the sweep's analytic error adds to the beat.

    Parameters
    ----------
    position : ndarray (m,)
        Positions x in the record, -1..1.
    sign : int
        Sign s of the chirp; 0 for the Doppler segment.
    chirp_duration : ndarray
        Duration T of the chirp [s].
    range, radial_velocity : ndarray (n,)
        Values at the segment's start [m, m/s].
    quadratic, cubic, sinusoidal : ndarray
        Peaks q, k and p of the error [Hz], of either sign.
    periods : ndarray
        Number > 0 of periods of the sine over the sweep.
    start, duration : ndarray
        Time from the segment's start to the start of the echo's record, and duration of the record
        [s].

    Returns
    -------
    ndarray (n, m)
        E(t - tau(t)) - E(t) [cycles], with the integral E of the frequency error over time, and the
        echo's delay tau(t).
    """
    if sign == 0:
        return np.zeros((np.size(range), np.size(position)))
    t = times_in_record(position, start=start, duration=duration)
    doppler_ratio = _as_column(2 * np.asarray(radial_velocity) / SPEED_OF_LIGHT)
    delay = _as_column(round_trip_delay(np.asarray(range)))
    sweep_duration, periods = _as_column(chirp_duration), _as_column(periods)
    u = sign * (2 * t / sweep_duration - 1)
    h = -sign * 2 * (delay - doppler_ratio * t) / sweep_duration
    # The integral of e from u to u + h, in forms that do not cancel for small h: h times the mean
    # of T_2 and T_3 over the step about its middle; the mean of a sine is sinc times its middle
    # value.
    step_middle, squared_step = u + h / 2, h * h
    mean_error = _as_column(quadratic) * (2 * step_middle**2 - 1 + squared_step / 6)
    mean_error = mean_error + _as_column(cubic) * step_middle * (
        4 * step_middle**2 - 3 + squared_step
    )
    sine = np.sin(np.pi * periods * step_middle)
    mean_error = mean_error + _as_column(sinusoidal) * np.sinc(periods * h / 2) * sine
    return np.asarray(sign * sweep_duration / 2 * (h * mean_error))


def chirp_nonlinearity_phase_bound(points: PlannerInputs) -> PhaseErrorBound | None:
    """Return the bound of the phase that the sweep's frequency error adds over the record.

    Quadratic and cubic errors give polynomials in the position in the record. The phase of a sine
    is bounded by its largest value, as is that of a table's departure from the mean of its largest
    and smallest value. The result is None without a frequency error.
    """
    table_text = points.shared_option(ERROR_TABLE_PATH)
    if not points.any_nonzero(*_SWEEP_ERROR_PEAK_PATHS):
        return (
            None
            if table_text == NO_TABLE
            else _sweep_error_table_phase_bound(points, fit_sweep_frequency_error(table_text))
        )
    quadratic, cubic, sinusoidal = (points[path] for path in _SWEEP_ERROR_PEAK_PATHS)
    half_duration, chirp_rates = 0.5 * points.record.duration, points.existing_chirp_slopes
    record_middle, position_per_second = (
        points.record.acquisition_delay + half_duration,
        2 / points[CHIRP_PREFIX + "duration"],
    )
    # Polynomials in the position in the record, lowest power first: delay, the step by it along the
    # sweep, and the middle of this step.
    middle_delay, delay_slope = (
        points.target.delay - points.target.doppler_ratio * record_middle,
        -points.target.doppler_ratio * half_duration,
    )
    delay = [middle_delay, delay_slope]
    middle_step, step_slope = (-chirp_rates * position_per_second * part for part in delay)
    step = [middle_step, step_slope]
    sweep_position = [
        chirp_rates * (position_per_second * record_middle - 1) + 0.5 * middle_step,
        chirp_rates * position_per_second * half_duration + 0.5 * step_slope,
    ]
    squared_position, squared_step = (
        _polynomial_product(sweep_position, sweep_position),
        _polynomial_product(step, step),
    )
    constant_error, *quadratic_error = (
        quadratic * (2 * a + b / 6) for a, b in zip(squared_position, squared_step, strict=True)
    )
    constant_factor, *cubic_factor = (
        4 * a + b for a, b in zip(squared_position, squared_step, strict=True)
    )
    cubic_error = [
        cubic * part
        for part in _polynomial_product(sweep_position, [constant_factor - 3, *cubic_factor])
    ]
    mean_error = [
        a + b
        for a, b in zip(
            [constant_error - quadratic, *quadratic_error, np.zeros(())], cubic_error, strict=True
        )
    ]
    slope_magnitude = np.abs(chirp_rates)
    constant, *coefficients = (
        slope_magnitude * np.abs(part) for part in _polynomial_product(delay, mean_error)
    )
    sine_phase = slope_magnitude * (np.abs(middle_delay) + np.abs(delay_slope)) * np.abs(sinusoidal)
    sine_phase_slope = (
        2 * np.pi * points[_SWEEP_ERROR_PERIODS_PATH] * position_per_second * half_duration
    )
    phase_bound = PhaseErrorBound(
        tuple(coefficients), sine_phase, constant, sine_phase * sine_phase_slope
    )
    return (
        phase_bound
        if table_text == NO_TABLE
        else phase_bound.plus(
            _sweep_error_table_phase_bound(points, fit_sweep_frequency_error(table_text))
        )
    )


def _sweep_error_table_phase_bound(
    points: PlannerInputs, table: SweepFrequencyError
) -> PhaseErrorBound:
    """Return a bound on the phase that a measured error of the sweep adds over the record.

    The phase is about minus the echo's delay times the frequency error. The bound follows from the
    mean of the error's largest and smallest value, the largest departure from this mean, and the
    error's derivative.
    """
    position = np.cos(np.linspace(0, np.pi, 16 * table.chebyshev_coefficients.size + 1))
    errors, slope_coefficients = (
        table.frequency_error(position),
        np.polynomial.chebyshev.chebder(table.chebyshev_coefficients),
    )
    mid_error, half_span = (errors.max() + errors.min()) / 2, np.ptp(errors) / 2
    error_slope_max = np.abs(np.polynomial.chebyshev.chebval(position, slope_coefficients)).max()
    error_slope_max = error_slope_max * 2 / (table.last_time - table.first_time)
    record_duration, delay_rate, slope_magnitude = (
        points.record.duration,
        np.abs(points.target.doppler_ratio),
        np.abs(points.existing_chirp_slopes),
    )
    delay_max = points.target.delay + delay_rate * (
        points.record.acquisition_delay + record_duration
    )
    linear_phase = 0.5 * delay_rate * record_duration * abs(mid_error)
    extra_shift = (delay_max * error_slope_max + delay_rate * half_span) * record_duration
    coefficients = (slope_magnitude * linear_phase, 0.0, 0.0, 0.0)
    return PhaseErrorBound(
        coefficients,
        slope_magnitude * delay_max * half_span,
        slope_magnitude * delay_max * abs(mid_error),
        slope_magnitude * extra_shift,
    )


def _polynomial_product(
    first: Sequence[ArrayOrFloat], second: Sequence[ArrayOrFloat]
) -> list[ArrayOrFloat]:
    """Return the coefficients of a product of polynomials, lowest power first."""
    product: list[ArrayOrFloat] = [0.0] * (len(first) + len(second) - 1)
    for i, a in enumerate(first):
        for j, b in enumerate(second):
            product[i + j] = product[i + j] + a * b
    return product


def apply_chirp_nonlinearity(shots: Shots, context: EffectContext) -> Shots:
    """Add the phase of the sweep's frequency error to the records of the two chirps.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Peaks of the error [Hz], periods of its sine, and table of a measured error. The ground is
        not used (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the phase errors of :func:`chirp_nonlinearity_phase`, and of
        :func:`sweep_error_table_phase` if a table is given.

    Notes
    -----
    The phase is E(t - tau(t)) - E(t), with the integral E of the frequency error over time, and the
    echo's delay tau(t). The module's description has the equations.
    """
    parameters, phase_inputs = (
        context.parameters,
        {"chirp_duration": shots.waveform.chirp_duration, **shots.range_and_velocity_by_segment},
    )
    if (table_text := str(parameters[ERROR_TABLE_PATH])) != NO_TABLE:
        shots = _add_phase_error(
            shots,
            partial(sweep_error_table_phase, table=fit_sweep_frequency_error(table_text)),
            **phase_inputs,
        )
    return _add_phase_error(
        shots,
        chirp_nonlinearity_phase,
        **phase_inputs,
        **{
            error_shape: parameters[path]
            for error_shape, path in zip(_SWEEP_ERROR_SHAPES, _SWEEP_ERROR_PEAK_PATHS, strict=True)
        },
        periods=parameters[_SWEEP_ERROR_PERIODS_PATH],
    )


CHIRP_NONLINEARITY = Effect(
    name="chirp_nonlinearity",
    description="departure of the sweep from a straight line",
    stage="record",
    error_bound=partial(phase_omission_bound, name="chirp_nonlinearity"),
    phase_error_bound=chirp_nonlinearity_phase_bound,
    apply=apply_chirp_nonlinearity,
    is_in_time_domain_truth=False,
    parameters=(
        *(
            Parameter(
                path=path,
                description=f"Peak of the sweep's frequency error that goes as a {form}",
                example="100 kHz",
                limits=("-1e15 Hz", "1e15 Hz"),
            )
            for path, form in zip(_SWEEP_ERROR_PEAK_PATHS, ("square", "cube", "sine"), strict=True)
        ),
        Parameter(
            path=_SWEEP_ERROR_PERIODS_PATH,
            description="Periods of the sinusoidal error over the sweep",
            default=1.0,
            example="5",
            limits=("1e-6", "1000"),
        ),
        Parameter(
            path=ERROR_TABLE_PATH,
            description="Measured frequency error of the sweep over the up-chirp, which the "
            "down-chirp "
            "runs through backwards: a list of times and errors, [[0 us, 0 Hz], [10 us, 2 kHz], "
            "...], or a CSV file with the columns 'time [us], error [kHz]'; none for no table. It "
            "must cover the chirp from 0 to duration, and be smooth: a Chebyshev series of degree "
            "64 at the most stands for it, to 1e-3 of its span. Echoes that arrive after the "
            "record begins (acquisition_delay) see its ends held, and take longer to compute",
            default=NO_TABLE,
            is_table=True,
        ),
    ),
)
"""Effect that adds the phase of a sweep whose frequency is no straight line over time."""
