"""Overlap: within its segment, the echo exists from its delay until the chirp ends.

A record of L samples begins at the acquisition delay t_0. The laser's chirp, transmitted from 0 to
T, returns from tau = 2 R / c on, and beats with the chirp being transmitted until this ends. So the
sample at t holds an echo if

    tau(t) = tau_0 - beta t <= t <= T.

Records end by T, so only first samples can be missing, up to all of them: those before t = tau_0 /
(1 + beta). They hold only noise. The window and its sum, the noise of bins and the threshold are
those of the full record. Before tau the ground still returns the preceding segment. Its beat sweeps
through the receiver's band in nanoseconds and is neglected.

The line shape is that of the samples that hold the echo, with the window's values there:

    G(y) = sum_{n >= n_0} w_n exp(-2 pi i y n / N),    n_0 = ceil((tau_0 / (1 + beta) - t_0) f_s).

For a cosine sum this is a sum of partial Dirichlet kernels. :mod:`sweep.model.spectrum.line_shape`
evaluates it with all phase errors. The peak falls by the window's fraction before n_0: for a
rectangular window to 1 - n_0 / L of its amplitude. The line becomes wider, and its sidelobes fall
as 1/y, because the echo begins with a step. [T] assumes chirps far longer than delays, and records
that begin at 0 and are complete (``overlap: off``).

One n_0, that of the beam's axis, serves all lines of a footprint's segment. A beamlet that is d
farther away has 2 d f_s / c samples fewer. One n_0, that of the middle look, serves all looks of a
shot, between which the range changes. Both differences are neglected. The error counts in
``effects_error``, and :func:`residual_magnitude_bound` bounds it. Positions between bins are
corrected for n_0 (:func:`sweep.model.detection.sub_bin_interpolation.late_echo_correction`).

Error bound: let c be the largest bin's magnitude over that of all lines on a bin, and b the
fraction of sum |w| in the missing samples. No bin changes by more than b, so the largest changes by
at most b / c of itself. The planner bounds sidelobes of leakage and images by those of the window
plus those of a rectangular window times the step at n_0. If no sample holds an echo, nothing is
detected, while a bin without signal crosses as noise does. The effect is then always kept.

Check: :mod:`sweep.model.time_domain_truth` gates each sample of each beamlet by its own delay.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, EffectContext
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.phase_errors import mean_phase_bound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.preparation import Shots
from sweep.model.window_response import window_max_near

_REMAINING_AMPLITUDE_WITH_IMAGE_MIN = 0.9
"""Lower bound on the amplitude of a line to which sidelobes of its distant image add, as a fraction
of the amplitude without the image."""


def error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of results if late echoes are taken to fill their records.

    A late echo arrives after its record has begun. The result is None if no samples lack the echo.
    """
    missing = points.missing_sample_bounds
    if missing is None:
        return None
    phase_bound = (
        mean_phase_bound(points.total_phase_error_bound, points.window)
        if points.phase_error_bounds
        else 0.0
    )
    power_min = (
        points.peak_power_bounds.power_min
        / np.where(points.is_near_image, 2.0, 1.01)
        / (1 + points.total_phase_error_bound.extra_shift_window_bins)
    )
    line_amplitude_min = _REMAINING_AMPLITUDE_WITH_IMAGE_MIN * np.sqrt(power_min) - phase_bound
    magnitude_change = np.where(
        missing.lost_fraction > 0,
        np.where(line_amplitude_min > 0, missing.lost_fraction / line_amplitude_min, np.inf),
        0.0,
    )
    bound, all_missing = (
        residual_magnitude_bound(points),
        missing.all_missing.any(axis=0).astype(float),
    )
    residual: dict[str, Any] = {
        "residual_magnitude_change": bound,
        "residual_coherent_sum_change": bound * points.footprint_extent.amplitude_gain_max,
    }
    if not points.amplitudes_may_add:
        line_share = (
            points.window_response.scalloping_gain(points.bin_offset) - missing.lost_fraction
        )  # each line loses its own share of power
        lone_bound = np.where(
            line_share > 0, np.minimum(bound / np.maximum(line_share, 1e-300), 1.0), 1.0
        )
        residual["residual_magnitude_change"] = np.where(bound > 0, lone_bound, 0.0)
        return ErrorBound(
            magnitude_change=magnitude_change, probability_change=all_missing, **residual
        )
    lone_change = np.where(points.amplitudes_may_cancel, 0.0, magnitude_change)
    summed_change = np.where(
        points.amplitudes_may_cancel,
        2 * missing.lost_fraction / points.window_response.scalloping_gain_min,
        points.image_magnitude_bound,
    )
    coherent_change = np.where(missing.lost_fraction > 0, summed_change, 0.0)
    return ErrorBound(
        magnitude_change=lone_change,
        coherent_sum_change=coherent_change,
        probability_change=all_missing,
        **residual,
    )


def residual_magnitude_bound(points: PlannerInputs) -> np.ndarray:
    """Return a bound on the error of using one number of missing samples for all echoes.

    The echoes are those of all beamlets and looks. The number used is that of the samples before
    the echo on the beam's axis, in the middle look.

    Returns
    -------
    ndarray (segments, n)
        Error relative to the magnitude that all lines together have on a bin.
    """
    missing = points.missing_sample_bounds
    assert missing is not None
    range_moments = points.footprint_extent.range_offset_moments
    mean_range = np.minimum(
        np.abs(range_moments.mean) + range_moments.rms, range_moments.largest_magnitude
    )
    look_drift_samples = (
        points.sample_rate
        * 2
        / SPEED_OF_LIGHT
        * np.abs(points.target.approach_speed)
        * points.middle_look_delay
    )
    extra_samples_max = (
        points.sample_rate * points.target.delay * np.minimum(range_moments.largest_magnitude, 1e3)
        + look_drift_samples
    )
    extra_samples_mean = (
        points.sample_rate * points.target.delay * np.minimum(mean_range, 1e3) + look_drift_samples
    )
    # Numbers of samples are integers: those of two delays differ by up to one more.
    whole_samples = np.where(extra_samples_max > 0, extra_samples_mean + 1, 0.0)
    # If no samples or all samples are missing, the same are missing at nearby delays.
    samples_to_echo = points.sample_rate * (points.target.delay - points.record.acquisition_delay)
    record_starts_inside = (samples_to_echo + extra_samples_max > -1) & (
        samples_to_echo - extra_samples_max < points.window.length + 1
    )
    # A few samples change all bins equally; the factor 2 includes the image at negative frequency.
    bound = (
        2 * window_max_near(points.window, missing.n_missing, extra_samples_max + 1) * whole_samples
    )
    bound = np.minimum(bound, 1.0)
    return np.asarray(np.where(record_starts_inside, bound, 0.0))


def apply(shots: Shots, context: EffectContext) -> Shots:
    """Leave out the echo in the first samples of each record, before the echo arrives.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Not used (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the number of samples before the echo, (3, n) by segment, or unchanged if all
        echoes fill their records.

    Notes
    -----
    Of L samples, the first n_0 = ceil((tau_0 / (1 + beta) - t_0) f_s) lack the echo, limited to
    0..L. tau_0 is the delay of the echo, beta its Doppler ratio, t_0 the start of the record and
    f_s the sample rate. The first n_0 samples are counted by
    :meth:`sweep.model.shot_settings.RecordSettings.count_samples_before_echo`.
    """
    n_samples_before_echo = np.zeros((len(shots.waveform_segments), shots.size), np.int64)
    for segment_index in np.flatnonzero(shots.has_segment):
        segment = shots.waveform_segments[segment_index]
        n_samples_before_echo[segment_index] = shots.record.count_samples_before_echo(
            segment, shots.range
        )
    return (
        replace(
            shots,
            echo_record=shots.echo_record._replace(n_samples_before_echo=n_samples_before_echo),
        )
        if n_samples_before_echo.any()
        else shots
    )


OVERLAP = Effect(
    name="overlap",
    description="echoes that arrive after the record has begun",
    stage="record",
    error_bound=error_bound,
    apply=apply,
)
"""Effect that leaves out the samples at the start of a record before the echo arrives."""
