"""Motion between segments: range and velocity of the target change from segment to segment.

A segment that starts at t finds the target at R - u t - a t^2 / 2 and v_r + a t, where u is the
speed at which the range along the beam falls. At 150 m/s this is 7.5 cm after 500 us. [T] has all
segments begin at one range (``segment_motion: off``).

There are two speeds (docs/physics.md, *The beam slides*). Doppler shifts are those of the
scatterers in the beam, v_r = V.d for the velocity V and the direction d. The range falls by u = (V
+ R d').n / d.n on a plane of normal n, as the beam, which turns by d', slides over it. Likewise a =
d(V.d)/dt is that of the beam, V'.d + V.d'.

Beamlets keep their scatterers: their ranges change by their own velocities.

Up and down beat are those of the range at the middle t_m of their starts, except for coupling of
range and velocity. Let t_d be the time from up to down segment, negative if the down-chirp comes
first. The half sum of the beats is below 2 v_r / lambda by the fraction S t_d / 2 of the optical
frequency at mid-chirp. The acceleration changes the range by a t_d f / (2 S): 0.55 m at 11 m/s^2
for Table 4.1. Interpolated range and velocity are corrected with the measured velocity (as for
range walk), by v_r t_m and by that fraction. The beats contain no information on the acceleration,
or on a beam that slides over sloping ground.

With several looks (:mod:`sweep.model.detection.looks`) segments start as those of the middle look,
to whose time interpolated ranges are corrected. Lines move by the same number of bins from look to
look. Averaged powers are smeared by this drift. The drift is not modelled for looks that are
counted, added in amplitude, or fade independently; it must then be within
:data:`LOOK_DRIFT_MAX_WINDOW_BINS`.
"""

import math
from dataclasses import replace

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.looks import LOOKS_NUMBER_PATH, N_DRIFT_POSITIONS_MAX
from sweep.model.effects.doppler import line_shift_error_bound
from sweep.model.effects.effect import Effect, EffectContext
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.preparation import Shots
from sweep.model.shot_settings import doppler_ratio
from sweep.model.unsupported_shot import UnsupportedShotError

LOOK_DRIFT_MAX_WINDOW_BINS = 0.25
"""Largest drift of a line from the first look to the last that may be ignored. The unit is the
sample rate over the number of samples in the record. The error is 1 % of the power."""


def range_drift_max(points: PlannerInputs) -> np.ndarray:
    """Return an upper bound [m], by segment, of the change of range since the shot's start."""
    end_time = points.segment_starts + points.middle_look_delay
    target = points.target
    return np.asarray(
        (np.abs(target.approach_speed) + np.abs(target.acceleration) * end_time / 2) * end_time
    )


def line_drift_max_bins(points: PlannerInputs) -> np.ndarray:
    """Return an upper bound [bins], by segment, of the shift of the line since the shot's start.

    The line shifts because range and velocity of the target change until the segment starts.
    """
    target = points.target
    velocity_change = np.abs(target.acceleration) * (
        points.segment_starts + points.middle_look_delay
    )
    bins_per_metre = (
        np.abs(points.existing_chirp_slopes)
        * points.waveform.chirp_rate
        * (2 / SPEED_OF_LIGHT)
        / points.record.bin_width
    )
    bins_by_range = bins_per_metre * (1 + np.abs(target.doppler_ratio)) * range_drift_max(points)
    return np.asarray(bins_by_range + points.bins_per_velocity * velocity_change)


def error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of the largest bin if all segments start with the shot.

    All segments then have the range and velocity at the shot's start. The bound includes changes of
    phase if amplitudes add. The phase between a line and its image changes with the line's
    position. The phase between beamlets of different velocities changes with time.
    """
    if not any(
        np.any(speed)
        for speed in (
            points.target.radial_velocity,
            points.target.approach_speed,
            points.target.acceleration,
        )
    ):
        return None
    shift_bins = line_drift_max_bins(points)
    bound = line_shift_error_bound(points, shift_bins)
    if not points.adds_amplitudes:
        return bound
    spread_cycles = (
        points.line_spread_by_velocity.largest_magnitude
        * points.record.bin_width
        * points.segment_starts
    )
    spread_change = (
        np.minimum(2 * np.pi * spread_cycles, 2.0) / points.window_response.scalloping_gain_min
    )
    cycles = 2 / SPEED_OF_LIGHT * points.carriers * range_drift_max(points)
    image_change = points.image_magnitude_bound * np.minimum(4 * np.pi * cycles, 2.0)
    coherent_change = bound.coherent_sum_change + 2 * spread_change + image_change
    return bound._replace(coherent_sum_change=coherent_change)


def apply(shots: Shots, context: EffectContext) -> Shots:
    """Return shots whose segments start one after another, while the target moves.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Not used (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with times, velocity bias and drift of lines in their record ``motion``.

    Raises
    ------
    UnsupportedShotError
        If lines drift from look to look too far to be modelled (:func:`line_drift_per_look`).

    Notes
    -----
    The effect sets the start of each segment, in the middle look if there are several. The mean
    start t_m of up- and down-chirp is added to the range walk's time. The effect also sets the
    fraction S t_d / 2 of the optical frequency at mid-chirp by which the beats underestimate the
    radial velocity, and the drift of lines per look. S is the chirp rate, and t_d the time from up-
    to down-chirp.
    """
    waveform, motion, looks = shots.waveform, shots.motion, shots.looks
    starts = waveform.segment_starts
    middle_time, half_interval = (starts[2] + starts[0]) / 2, (starts[2] - starts[0]) / 2
    motion = motion._replace(
        segment_starts=waveform.middle_look_starts(looks),
        range_reference_time=motion.range_reference_time
        + (middle_time + waveform.middle_look_delay(looks)),
        velocity_bias_fraction=waveform.chirp_rate
        * half_interval
        / (waveform.carriers[0] + waveform.chirp_bandwidth / 2),
    )
    shots = replace(shots, motion=motion)
    if looks.number == 1:
        return shots
    return replace(shots, motion=motion._replace(line_drift_per_look=line_drift_per_look(shots)))


def line_drift_per_look(shots: Shots) -> np.ndarray:
    """Compute the bins by which lines of each segment move from look to look.

    Returns
    -------
    ndarray (segments, n)
        Drift [bins of fs/N], signed as the beat.

    Raises
    ------
    UnsupportedShotError
        If looks drift too far to be modelled.
    """
    doppler_ratio_rate = doppler_ratio(shots.target.acceleration)
    drift_bins = np.zeros((len(shots.waveform_segments), shots.size))
    for segment_index in np.flatnonzero(shots.has_segment):
        segment = shots.waveform_segments[segment_index]
        closing_speed = shots.target.approach_speed + shots.target.acceleration * segment.start_time
        beat_rate = segment.carrier * doppler_ratio_rate + segment.chirp_rate * (
            2 / SPEED_OF_LIGHT
        ) * (
            closing_speed * (1 + segment.doppler_ratio)
            - (shots.range - segment.range_decrease_since_shot_start) * doppler_ratio_rate
        )
        drift_bins[segment_index] = (
            beat_rate * shots.waveform.look_period * shots.fft_size / shots.sample_rate
        )
    looks, last_look = shots.looks, shots.looks.number - 1
    drift_max_window_bins = (
        float(np.abs(drift_bins).max(initial=0.0))
        * last_look
        * shots.window.length
        / shots.fft_size
    )
    fade_independently = (
        looks.has_independent_speckle
        and shots.waveform.architecture != "direct"
        and shots.footprint.adds_powers
    )
    drift_limit = (
        LOOK_DRIFT_MAX_WINDOW_BINS
        if looks.n_power_averaged == 1 or fade_independently
        else math.inf
    )
    if last_look >= N_DRIFT_POSITIONS_MAX:  # few positions represent all looks
        drift_limit = min(drift_limit, N_DRIFT_POSITIONS_MAX / 2)
    turned_cycles = np.abs(shots.footprint.doppler_ratio_offset).max(initial=0.0) * np.max(
        shots.waveform.carriers[0] * shots.waveform.look_period
    )
    if (
        not shots.footprint.adds_powers
        and shots.waveform.architecture != "direct"
        and turned_cycles * last_look > LOOK_DRIFT_MAX_WINDOW_BINS
    ):
        raise UnsupportedShotError(
            f"{LOOKS_NUMBER_PATH} takes {last_look + 1} looks in which beamlets of coherent phases "
            "turn against "
            f"each other by {turned_cycles * last_look:.3g} cycles, and "
            f"{LOOK_DRIFT_MAX_WINDOW_BINS} leave them alike: take "
            "fewer, or footprint.phases: incoherent"
        )
    if drift_max_window_bins > drift_limit:
        raise UnsupportedShotError(
            f"{LOOKS_NUMBER_PATH} takes {last_look + 1} looks from the first to the last of which "
            "the target moves "
            f"the echo by {drift_max_window_bins:.3g} bins, and {drift_limit:.3g} is the most that "
            "looks of this kind are "
            "followed by: take fewer, shorten instrument.chirp.duration, or take combine: power "
            "with speckle: common"
        )
    return drift_bins


SEGMENT_MOTION = Effect(
    name="segment_motion",
    description="range and velocity that change from segment to segment",
    stage="lines",
    error_bound=error_bound,
    apply=apply,
    defines_scene_if_off=True,
)
"""Effect that starts the segments one after another, while range and velocity change."""
