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
look. Averaged powers are smeared by this drift. Looks that are counted, added in amplitude, or that
fade independently do not model the drift, and must lie within :data:`LOOK_DRIFT_MAX_WINDOW_BINS`.
"""

import math
from dataclasses import replace

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.looks import DRIFT_POSITIONS_MAX, LOOKS_NUMBER_PATH
from sweep.model.effects.doppler import line_shift_bound
from sweep.model.effects.effect import Effect, EffectContext, ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.link_budget import doppler_ratio
from sweep.model.preparation import Shots
from sweep.model.unsupported_shot import UnsupportedShotError

LOOK_DRIFT_MAX_WINDOW_BINS = 0.25
"""Largest drift from the first look to the last [bins of fs/L] that counts as none: 1 % of the
power."""


def error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Bound the change of the largest bin as its line moves, including phases of lines that add.

    A line meets its image at the phase of its new position. Beamlets with velocities of their own
    turn against each other. If the effect is off, segments begin at one range, by the law of [T]:
    that is not an error of the simulation.
    """
    if points.ignores_segment_motion or not any(
        np.any(speed)
        for speed in (points.radial_velocity, points.approach_speed, points.acceleration)
    ):
        return None
    shift_bins = points.line_drift_max_bins
    bound = line_shift_bound(points, shift_bins)
    if not points.adds_amplitudes:
        return bound
    spread_cycles = points.velocity_spread.extreme * points.bin_width * points.segment_starts
    spread_change = (
        np.minimum(2 * np.pi * spread_cycles, 2.0) / points.window_response.scalloping_gain_min
    )
    cycles = 2 / SPEED_OF_LIGHT * points.carriers * points.range_drift_max
    image_change = points.image_bound * np.minimum(4 * np.pi * cycles, 2.0)
    coherent_change = bound.coherent_sum_change + 2 * spread_change + image_change
    return bound._replace(coherent_sum_change=coherent_change)


def apply(shots: Shots, context: EffectContext) -> Shots:
    """Let the segments start one after the other, while the target moves.

    Notes
    -----
    Sets the start of each segment, that of the middle look with several looks. Adds the mean start
    t_m of up- and down-chirp to the range walk's time. Sets the fraction S t_d / 2 of the optical
    frequency at mid-chirp by which the beats underestimate the radial velocity, and the drift of
    lines per look.
    """
    starts, looks = shots.scheduled_segment_starts, shots.looks
    middle_time, half_interval = (starts[2] + starts[0]) / 2, (starts[2] - starts[0]) / 2
    shots = replace(
        shots,
        segment_starts=shots.waveform_settings.middle_look_starts(looks),
        range_walk_time=shots.range_walk_time
        + (middle_time + shots.waveform_settings.middle_look_delay(looks)),
        velocity_bias_fraction=shots.chirp_rate
        * half_interval
        / (shots.carriers[0] + shots.chirp_bandwidth / 2),
    )
    if looks.number == 1:
        return shots
    return replace(shots, line_drift_per_look=line_drift_per_look(shots))


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
    doppler_ratio_rate = doppler_ratio(shots.acceleration)
    drift_bins = np.zeros((len(shots.waveform_segments), shots.size))
    for segment_index in np.flatnonzero(shots.has_segment):
        segment = shots.waveform_segments[segment_index]
        closing_speed = shots.approach_speed + shots.acceleration * segment.start_time
        beat_rate = segment.carrier * doppler_ratio_rate + segment.chirp_rate * (
            2 / SPEED_OF_LIGHT
        ) * (
            closing_speed * (1 + segment.doppler_ratio)
            - (shots.range - segment.range_decrease) * doppler_ratio_rate
        )
        drift_bins[segment_index] = (
            beat_rate * shots.look_period * shots.fft_size / shots.sample_rate
        )
    looks, last_look = shots.looks, shots.looks.number - 1
    drift_max_window_bins = (
        float(np.abs(drift_bins).max(initial=0.0))
        * last_look
        * shots.window.length
        / shots.fft_size
    )
    fade_independently = (
        looks.has_independent_speckle and shots.architecture != "direct" and shots.adds_powers
    )
    drift_limit = (
        LOOK_DRIFT_MAX_WINDOW_BINS
        if looks.n_power_averaged == 1 or fade_independently
        else math.inf
    )
    if last_look >= DRIFT_POSITIONS_MAX:  # few positions represent all looks
        drift_limit = min(drift_limit, DRIFT_POSITIONS_MAX / 2)
    turned_cycles = np.abs(shots.doppler_ratio_offset).max(initial=0.0) * np.max(
        shots.carriers[0] * shots.look_period
    )
    if (
        not shots.adds_powers
        and shots.architecture != "direct"
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


def split_looks(shots: Shots) -> list[Shots]:
    """Return the shots as each look sees them; copies of the same shots if looks do not differ."""
    if not np.any(shots.line_drift_per_look):
        return [shots] * shots.looks.number
    looks_from_middle = np.arange(shots.looks.number) - (shots.looks.number - 1) / 2
    return [
        replace(
            shots,
            line_drift_per_look=0.0,
            segment_starts=tuple(
                start + look_offset * shots.look_period for start in shots.segment_starts
            ),
        )
        for look_offset in looks_from_middle
    ]


SEGMENT_MOTION = Effect(
    name="segment_motion",
    description="range and velocity that change from segment to segment",
    stage="lines",
    error_bound=error_bound,
    apply=apply,
)
"""Effect of range and velocity that change from segment to segment."""
