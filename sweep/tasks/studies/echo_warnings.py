"""Warnings about echoes that arrive late, are misread, or have a random walk of phase.

A record begins at the acquisition delay and ends `fft_size` samples later, or with the chirp. An
echo arrives at 2 R / c. Beats above half the sample rate are aliased, so that three peaks, or two
with an assumption, give a wrong range. Few parameters decide whether an echo is late or misread.
All points of a grid, and shots spread over a flight, are therefore checked before anything runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model import beam, waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.estimators import ESTIMATOR_PREFIX
from sweep.model.effects.catalogue import PARAMETER_DEFAULTS
from sweep.model.evaluation import MISREAD_TOLERANCE_BINS
from sweep.model.link_budget import (
    LASER_PREFIX,
    PROCESSING_PREFIX,
    RECEIVER_PREFIX,
    LinkBudget,
)
from sweep.model.preparation import split_by_category
from sweep.model.shot_settings import CHIRP_PREFIX, RECORD_TYPE_PATH
from sweep.model.window_response import missing_sample_bounds
from sweep.tasks.studies.flight_study import FlightStudy

if TYPE_CHECKING:
    from sweep.model.pointcloud.eyepoints import Eyepoints
    from sweep.tasks.studies.grid_study import GridStudy

ECHO_LOSS_WARNING_DB = 3.0
"""Loss of an echo's power above which a warning is given [dB].

Power is lost if the echo arrives after the record has begun.
"""

PHASE_WALK_DELAY_RATIO_MIN, PHASE_WALK_VARIANCE_MIN = 0.125, 0.3
"""Limits that are both exceeded if the laser's random walk of phase changes pd by more than 0.02.

The first is the echo's delay over the duration of the record. The second is the variance of the
laser's phase over the delay, or over the record if that is shorter [rad^2].
"""

ECHO_POINTS_SAMPLED_MAX = 200_000
"""Largest number of points of a grid study whose echoes are checked.

Only one of several points with equal `ECHO_PARAMETERS` is checked.
"""

SAMPLED_TILES_PER_SCANNER = 16
"""Number of tiles (runs of consecutive shots) of each scanner whose echoes are checked."""

SPECTRUM_EDGE_SPREAD_BINS_MIN, SPECTRUM_EDGE_DISTANCE_BINS, SPECTRUM_EDGE_DISTANCE_DEVIATIONS = (
    0.2,
    4.0,
    3.0,
)
"""Limits by which an echo is taken to spread across an edge of the spectrum: DC or Nyquist.

The first is the standard deviation of a footprint's line frequencies [bins] above which an echo is
not a single line. Such an echo spreads across an edge that is nearer than a number of bins (the
second limit) plus a number of these standard deviations (the third).
"""

ECHO_PARAMETERS = (
    "target.range",
    "target.radial_velocity",
    LASER_PREFIX + "wavelength",
    CHIRP_PREFIX + "bandwidth",
    CHIRP_PREFIX + "duration",
    CHIRP_PREFIX + "start_frequency",
    waveform.SEGMENT_ORDER_PATH,
    waveform.DOPPLER_CHIRP_RATE_RATIO_PATH,
    waveform.DOWN_CHIRP_RATE_RATIO_PATH,
    PROCESSING_PREFIX + "acquisition_delay",
    PROCESSING_PREFIX + "sample_rate",
    PROCESSING_PREFIX + "fft_size",
    PROCESSING_PREFIX + "window",
    waveform.TWO_BEAT_ASSUMPTION_PATH,
    RECORD_TYPE_PATH,
    RECEIVER_PREFIX + "architecture",
    LASER_PREFIX + "line_width",
    LASER_PREFIX + "line_shape",
    PROCESSING_PREFIX + "detection",
    "footprint.speckle",
    "footprint.phases",
    "target.grazing_angle",
    "target.transverse_velocity",
    beam.WAIST_PATH,
    beam.OSCILLATOR_WAIST_PATH,
    beam.DIVERGENCE_PATH,
    beam.BEAM_QUALITY_PATH,
    beam.FOCUS_PATH,
    beam.COUPLING_PATH,
)
"""Dotted paths of parameters that determine when an echo arrives and how its beats are read."""


PHASE_BASED_WINDOW_FRACTION_LOST_MAX = 0.03
"""Largest fraction of the window that an echo may miss if its frequency is found from phases.

The fraction is the sum of the window's samples before the echo begins, over the sum of all its
samples. At this fraction, errors of phase-based estimators are below some 0.02 bin. They reach 0.6
bin if the echo begins in the middle of the record.
"""

PHASE_BASED_FREQUENCY_ESTIMATORS = ("jacobsen", "candan")
"""Names of the frequency estimators that use phases of adjacent bins, as in complete records."""


class EchoDiagnosis(NamedTuple):
    """Arrival of the echoes of n points, and whether their beats give a false range or velocity."""

    range: np.ndarray
    """Range (n,) of the target at each point [m]."""
    window_fraction_lost: np.ndarray
    """Fraction (n,) of the window before the echo begins, 0..1; 1 if no echo arrives in the record.

    It is the sum of the window's samples before the echo begins, over the sum of all its samples.
    """
    is_misread: np.ndarray
    """True (n,) where the measured beats would be read as a false range or velocity."""
    has_large_phase_walk: np.ndarray
    """True (n,) where the laser's phase walks too far for the model of detection to be accurate."""
    is_range_velocity_exchanged: np.ndarray
    """True (n,) where the spec's assumption exchanges range and velocity.

    Up and down beat alone have two readings: one for a far and one for a fast target. The spec
    assumes one of them. A point is marked if this reading is wrong and the opposite one is right.
    """
    is_exchanged_by_other_assumption: np.ndarray
    """True (n,) where the assumption opposite to the spec's would exchange range and velocity.

    The spec assumes either a far or a fast target. A point is marked if the spec's assumption is
    right and the opposite one is wrong.
    """
    crosses_spectrum_edge: np.ndarray
    """True (n,) where an echo in developed speckle spreads across DC or Nyquist.

    Points are marked only if records are real and an echo may be detected in any bin.
    """


class FootprintSpreads(NamedTuple):
    """Standard deviations of range and radial velocity over the illuminated spots of n points."""

    range: np.ndarray
    """Standard deviation (n,) of the range over the footprint at each point [m]."""
    radial_velocity: np.ndarray
    """Standard deviation (n,) of the radial velocity over the footprint at each point [m/s]."""

    @classmethod
    def from_plane_footprint(cls, p: Mapping[str, Any], range_: np.ndarray) -> FootprintSpreads:
        """Return the standard deviations of range and radial velocity over footprints on a plane.

        `p` maps dotted paths to parameters; a text parameter has one value for all points. `range_`
        (n,) are the ranges of the targets [m].
        """
        with np.errstate(all="ignore"):
            places, directions = beam.footprint_full_angles(p, range_)
            range_deviation = range_ * places / 4 / np.tan(p["target.grazing_angle"])
        velocity_deviation = np.abs(p["target.transverse_velocity"]) * directions / 4
        return cls(*(np.nan_to_num(v + 0 * range_) for v in (range_deviation, velocity_deviation)))

    @classmethod
    def from_eyepoints(cls, eyepoints: Eyepoints) -> FootprintSpreads:
        """Return the standard deviations of range and radial velocity over ray-traced footprints.

        `eyepoints` is the ray-traced geometry of n shots. Both deviations are 0 for a footprint on
        several surfaces, because surfaces at different ranges are separate echoes.
        """
        weight = eyepoints.weight / eyepoints.weight.sum()
        deviations = []
        for values in (eyepoints.offset, eyepoints.velocity_offset):
            finite_values = np.where(np.isfinite(values), values, 0.0)
            mean = (weight * finite_values).sum(axis=1)[:, None]
            deviations.append(np.sqrt((weight * (finite_values - mean) ** 2).sum(axis=1)))
        has_one_surface = (eyepoints.surface == eyepoints.surface[:, :1]).all(axis=1)
        return cls(*(np.where(has_one_surface, v, 0.0) for v in deviations))

    def select(self, points: np.ndarray) -> FootprintSpreads:
        """Return a new record with the standard deviations at the points of an index array."""
        return FootprintSpreads(self.range[points], self.radial_velocity[points])


def diagnose_echoes(
    parameters: Mapping[str, Any], footprint: FootprintSpreads | None = None
) -> EchoDiagnosis:
    """Check when the echoes of n points arrive, and which range and velocity their beats give.

    ``parameters`` maps dotted paths to one value or an array (n,). ``footprint`` has the standard
    deviations of range and radial velocity over the footprints; by default, footprints on a plane
    are assumed.
    """
    relevant = {
        path: parameter for path, parameter in parameters.items() if path in ECHO_PARAMETERS
    }
    n_points = max((np.size(value) for value in relevant.values()), default=1)
    relevant["target.range"] = np.broadcast_to(relevant["target.range"], (n_points,))
    relevant |= {
        path: PARAMETER_DEFAULTS[path] for path in PARAMETER_DEFAULTS if path not in relevant
    }
    relevant |= {"footprint.beamlets": 1}
    diagnosis = EchoDiagnosis(*np.zeros((2, n_points)), *np.zeros((5, n_points), bool))
    for index, p in split_by_category(relevant):
        budget = LinkBudget(p)
        record, delay = budget.record, budget.target.delay
        record_window = record.window
        range_, velocity = (p[name] for name in ("target.range", "target.radial_velocity"))
        first_echo_sample = waveform.count_samples_before_echo(
            delay=delay, doppler_ratio=0.0, record_start=record.acquisition_delay,
            sample_rate=record.sample_rate, length=record_window.length,
        )  # fmt: skip
        diagnosis.range[index] = range_
        diagnosis.window_fraction_lost[index] = np.where(
            first_echo_sample >= record_window.length,
            1.0,
            np.minimum(missing_sample_bounds(record_window, first_echo_sample).lost_fraction, 1.0),
        )
        velocity = np.asarray(velocity)
        diagnosis.is_misread[index] = _is_misread(p, range_, velocity)
        if str(p[RECORD_TYPE_PATH]) != "complex":
            assumption = str(p[waveform.TWO_BEAT_ASSUMPTION_PATH])
            (other_assumption,) = {waveform.FAR_TARGET, waveform.FAST_TARGET} - {assumption}
            is_misread_by = {
                name: _is_misread(p, range_, velocity, name)
                for name in (assumption, other_assumption)
            }
            diagnosis.is_range_velocity_exchanged[index] = (
                is_misread_by[assumption] & ~is_misread_by[other_assumption]
            )
            diagnosis.is_exchanged_by_other_assumption[index] = (
                is_misread_by[other_assumption] & ~is_misread_by[assumption]
            )
        diagnosis.crosses_spectrum_edge[index] = _crosses_spectrum_edge(
            p,
            range_,
            velocity,
            None if footprint is None else footprint.select(index),
        )
        if str(p[LASER_PREFIX + "line_shape"]) == "lorentzian":
            duration = record.duration
            variance = 2 * np.pi * p[LASER_PREFIX + "line_width"] * np.minimum(delay, duration)
            diagnosis.has_large_phase_walk[index] = (
                delay > PHASE_WALK_DELAY_RATIO_MIN * duration
            ) & (variance > PHASE_WALK_VARIANCE_MIN)
    return diagnosis


def _crosses_spectrum_edge(
    p: Mapping[str, Any],
    range_: np.ndarray,
    velocity: np.ndarray,
    footprint: FootprintSpreads | None,
) -> np.ndarray:
    """Return a mask (n,) of the echoes in developed speckle that spread across DC or Nyquist.

    `p` maps dotted paths to parameters. `range_` [m] and `velocity` [m/s] are those of n targets.
    The result is :attr:`EchoDiagnosis.crosses_spectrum_edge`.
    """
    is_speckled = str(p["footprint.speckle"]) != "none" and str(p["footprint.phases"]) != "coherent"
    is_speckled &= str(p[RECEIVER_PREFIX + "architecture"]) != "direct"
    if (
        str(p[RECORD_TYPE_PATH]) == "complex"
        or str(p[PROCESSING_PREFIX + "detection"]) != "any_bin"
        or not is_speckled
    ):
        return np.zeros(range_.shape, bool)
    footprint = FootprintSpreads.from_plane_footprint(p, range_) if footprint is None else footprint
    budget = LinkBudget(p)
    settings, record = budget.waveform, budget.record
    chirp_rate, record_length = settings.chirp_rate, record.window.length
    bin_width = record.sample_rate / record_length
    crosses = np.zeros(range_.shape, bool)
    segments = zip(
        waveform.SEGMENT_NAMES, waveform.chirp_rate_ratios(p), settings.carriers, strict=True
    )
    for name, slope, carrier in segments:
        if name not in settings.segment_order:
            continue
        beat = waveform.beat_frequency(
            slope, carrier=carrier, chirp_rate=chirp_rate, range=range_, radial_velocity=velocity
        )
        beat_over_nyquist = 2 * beat / record.sample_rate
        distance_bins = np.abs(beat_over_nyquist - np.rint(beat_over_nyquist)) * record_length / 2
        spread_bins = 2 / SPEED_OF_LIGHT * carrier * footprint.radial_velocity
        spread_bins = (
            spread_bins + 2 / SPEED_OF_LIGHT * np.abs(slope) * chirp_rate * footprint.range
        ) / bin_width
        crosses |= (spread_bins > SPECTRUM_EDGE_SPREAD_BINS_MIN) & (
            distance_bins
            < SPECTRUM_EDGE_DISTANCE_BINS + SPECTRUM_EDGE_DISTANCE_DEVIATIONS * spread_bins
        )
    return crosses


def _is_misread(
    p: Mapping[str, Any], range_: np.ndarray, velocity: np.ndarray, assumption: str | None = None
) -> np.ndarray:
    """Return a mask (n,) of the targets whose beats give a false range or velocity.

    Beats are folded at Nyquist as in spectra. If ``assumption`` is ``far`` or ``fast``, only up and
    down beat are read, under this assumption. If it is None, all beats of the shot are read.
    """
    budget = LinkBudget(p)
    settings, record, slopes = budget.waveform, budget.record, waveform.chirp_rate_ratios(p)
    carriers, chirp_rate, segment_order = (
        settings.carriers,
        settings.chirp_rate,
        settings.segment_order,
    )
    sample_rate, bin_width, is_signed = record.sample_rate, record.bin_width, record.is_complex
    if assumption is not None:
        segment_order = tuple(name for name in segment_order if name != "doppler")
    peaks = []
    for slope, carrier in zip(slopes, carriers, strict=True):
        beat = waveform.beat_frequency(
            slope, carrier=carrier, chirp_rate=chirp_rate, range=range_, radial_velocity=velocity
        )
        folded_beat = beat - sample_rate * np.floor(beat / sample_rate + 0.5)
        peaks.append((folded_beat if is_signed else np.abs(folded_beat)) + 0 * range_)
    reading_assumption = assumption or str(p[waveform.TWO_BEAT_ASSUMPTION_PATH])
    if slopes == waveform.DEFAULT_CHIRP_RATE_RATIOS:
        reading = waveform.resolve_range_velocity(
            up=peaks[0],
            doppler=peaks[1] if "doppler" in segment_order else None,
            down=peaks[2],
            carrier=carriers[0],
            bandwidth=settings.chirp_bandwidth,
            duration=settings.chirp_duration,
            sample_rate=sample_rate,
            bin_width=bin_width,
            has_signs=is_signed,
            two_beat_assumption=reading_assumption,
        )
    else:
        table_shape = 3, range_.size
        weights = [float(name in segment_order) for name in waveform.SEGMENT_NAMES]
        columns = [np.broadcast_to(carrier, range_.shape) for carrier in carriers]
        rates = [np.broadcast_to(slope * chirp_rate, range_.shape) for slope in slopes]
        reading = waveform.fit_range_velocity(
            np.array(peaks),
            weights=np.broadcast_to(np.reshape(weights, (3, 1)), table_shape),
            carriers=np.array(columns),
            chirp_rates=np.array(rates),
            sample_rate=np.broadcast_to(sample_rate, range_.shape),
            bin_width=np.broadcast_to(bin_width, range_.shape),
            has_signs=is_signed,
            two_beat_assumption=reading_assumption,
        )
    range_tolerance = MISREAD_TOLERANCE_BINS * bin_width / (2 / SPEED_OF_LIGHT * chirp_rate)
    with np.errstate(divide="ignore"):  # direct detection has a carrier of 0 and no velocity
        velocity_tolerance = MISREAD_TOLERANCE_BINS * bin_width * SPEED_OF_LIGHT / carriers[0]
    is_off = np.abs(reading.range - range_) > range_tolerance
    return np.asarray(is_off | (np.abs(reading.radial_velocity - velocity) > velocity_tolerance))


def echo_warnings(study: GridStudy | FlightStudy) -> Iterator[str]:
    """Yield warnings about echoes that a study misses, records in part, or reads wrongly."""
    is_flight = isinstance(study, FlightStudy)
    diagnosis = (
        _diagnose_flight_echoes(study)
        if isinstance(study, FlightStudy)
        else _diagnose_grid_echoes(study)
    )
    if not diagnosis.range.size:
        return
    points_noun, has_overlap = (
        "shots" if is_flight else "points",
        study.spec.effect_modes()["overlap"] != "off",
    )
    is_absent = (
        (diagnosis.window_fraction_lost >= 1)
        if has_overlap
        else np.zeros(diagnosis.window_fraction_lost.shape, bool)
    )
    if is_absent.any():
        yield (
            f"no echo arrives before its record ends at {_fraction_text(is_absent)} of the "
            f"{points_noun}, "
            f"{_target_ranges_text(is_absent, diagnosis.range)}: nothing is detected there. "
            "A record lasts from "
            "processing.acquisition_delay for processing.fft_size samples, up to chirp.duration, "
            "and an echo arrives after 2R/c"
        )
    with np.errstate(divide="ignore"):
        is_weak = (
            has_overlap
            & ~is_absent
            & (
                20 * np.log10(1 - np.minimum(diagnosis.window_fraction_lost, 1.0))
                < -ECHO_LOSS_WARNING_DB
            )
        )
    if is_weak.any():
        yield (
            "echoes that arrive after their record has begun lose more than "
            f"{ECHO_LOSS_WARNING_DB:g} dB at "
            f"{_fraction_text(is_weak)} of the {points_noun}, "
            f"{_target_ranges_text(is_weak, diagnosis.range, is_absent)}: raise "
            "processing.acquisition_delay to the largest 2R/c, and chirp.duration with it"
        )
    is_shifted = (
        has_overlap
        & ~is_absent
        & (diagnosis.window_fraction_lost > PHASE_BASED_WINDOW_FRACTION_LOST_MAX)
    )
    if (kinds := _used_phase_based_estimators(study)) and is_shifted.any():
        yield (
            f"instrument.processing.estimator.kind {' and '.join(kinds)} takes echoes for whole "
            f"records, and echoes begin within theirs at {_fraction_text(is_shifted)} of the "
            f"{points_noun}, "
            f"{_target_ranges_text(is_shifted, diagnosis.range, is_absent)}: places there are off "
            "by up to half a bin. "
            "Take maximum_likelihood or chirp_z, or raise processing.acquisition_delay to the "
            "largest 2R/c, and chirp.duration with it"
        )
    is_wrong = diagnosis.is_misread & ~is_absent
    if _reads_two_beats(study):
        yield from _iter_exchange_warnings(study, diagnosis, is_absent, points_noun)
        is_wrong &= ~diagnosis.is_range_velocity_exchanged
    if is_wrong.any():
        yield (
            f"the peaks are read as another range or velocity at {_fraction_text(is_wrong)} of the "
            f"{points_noun}, "
            f"{_target_ranges_text(is_wrong, diagnosis.range, is_absent)} (misread): beats beyond "
            "half the sample rate "
            "fold, and two beats are read by processing.two_beats. What is detected there has a "
            "wrong range or velocity: raise processing.sample_rate, or lower chirp.bandwidth over "
            "chirp.duration"
        )
    has_large_phase_walk = (
        diagnosis.has_large_phase_walk
        & ~is_absent
        & (study.spec.effect_modes()["line_width"] != "off")
    )
    if has_large_phase_walk.any() and (
        study.spec.draws is None or study.spec.draws.method != "spectra"
    ):
        yield (
            "the laser's phase walks so far within the delay of the echo at "
            f"{_fraction_text(has_large_phase_walk)} of "
            f"the {points_noun}, "
            f"{_target_ranges_text(has_large_phase_walk, diagnosis.range, is_absent)}, that "
            "probabilities of detection "
            "may be off by up to 0.1: take draws.method: spectra, which draws the walk, or lower "
            "instrument.laser.line_width"
        )
    crosses_edge = (
        diagnosis.crosses_spectrum_edge
        & ~is_absent
        & (study.spec.effect_modes()["fading"] != "off")
    )
    if crosses_edge.any() and (
        study.spec.draws is None or study.spec.draws.method == "probabilities"
    ):
        yield (
            "the speckle of the footprint spreads an echo over bins on both sides of DC or half "
            f"the sample rate at {_fraction_text(crosses_edge)} of the {points_noun}, "
            f"{_target_ranges_text(crosses_edge, diagnosis.range, is_absent)}: its probability of "
            "detection by any_bin may "
            "be up to 0.06 too high. Take draws.method: noise or spectra, which draw the bins, or "
            "instrument.processing.detection: peak_bin"
        )


def _used_phase_based_estimators(study: GridStudy | FlightStudy) -> list[str]:
    """Return the names of the `PHASE_BASED_FREQUENCY_ESTIMATORS` that a study uses."""
    path = f"{ESTIMATOR_PREFIX}kind"
    values = [
        member.values
        for axis in study.spec.axes
        for member in axis.parameters
        if member.path == path
    ]
    kinds = values[0] if values else [study.spec.parameters().get(path)]
    return [
        kind for kind in PHASE_BASED_FREQUENCY_ESTIMATORS if kind in {str(name) for name in kinds}
    ]


def _reads_two_beats(study: GridStudy | FlightStudy) -> bool:
    """Return True if a study reads range and velocity of some or all shots from only two beats."""
    spec = study.spec
    p = PARAMETER_DEFAULTS | dict(spec.parameters())
    has_no_doppler = "doppler" not in waveform.existing_segments(
        str(p[RECEIVER_PREFIX + "architecture"]), str(p[waveform.SEGMENT_ORDER_PATH])
    )
    return (
        has_no_doppler
        or isinstance(study, FlightStudy)
        or p[waveform.SHOT_DETECTION_PATH] == waveform.ANY_TWO
    )


def _iter_exchange_warnings(
    study: GridStudy | FlightStudy,
    diagnosis: EchoDiagnosis,
    is_absent: np.ndarray,
    points_noun: str,
) -> Iterator[str]:
    """Yield a warning if range and velocity are exchanged at some points; yield nothing otherwise.

    An up and a down beat that no Doppler beat confirms have two readings: one for a far and one for
    a fast target. The wrong reading exchanges range and velocity. The setting processing.two_beats,
    ``far`` or ``fast``, chooses the reading. If it is ``fast``, and ``far`` would exchange range
    and velocity at some points, no warning is given. Points marked in ``is_absent`` (n,) are
    ignored.
    """
    is_range_velocity_exchanged, is_exchanged_by_other_assumption = (
        diagnosis.is_range_velocity_exchanged & ~is_absent,
        diagnosis.is_exchanged_by_other_assumption & ~is_absent,
    )
    assumes_far = (
        str((PARAMETER_DEFAULTS | dict(study.spec.parameters()))[waveform.TWO_BEAT_ASSUMPTION_PATH])
        == waveform.FAR_TARGET
    )
    if not is_range_velocity_exchanged.any() or (
        not assumes_far and is_exchanged_by_other_assumption.any()
    ):
        return
    relation, other_name = ("exceeds", "fast") if assumes_far else ("is below", "far")
    if np.count_nonzero(is_exchanged_by_other_assumption) < np.count_nonzero(
        is_range_velocity_exchanged
    ):
        remedy = f"write processing.two_beats: {other_name}"
        if is_exchanged_by_other_assumption.any():
            remedy += (
                f", which is wrong at {_fraction_text(is_exchanged_by_other_assumption)} of the "
                f"{points_noun}"
            )
    else:
        remedy = (
            f"{other_name} would be wrong at more of the {points_noun}. Leave unconfirmed points "
            "out there, "
            "or raise chirp.bandwidth over chirp.duration"
        )
    yield (
        f"the Doppler shift {relation} the beat of the range at "
        f"{_fraction_text(is_range_velocity_exchanged)} of the {points_noun}, "
        f"{_target_ranges_text(is_range_velocity_exchanged, diagnosis.range, is_absent)}, and "
        f"processing.two_beats is {'far' if assumes_far else 'fast'}: an up and a down "
        "beat that no Doppler beat confirms are read "
        f"there with range and velocity exchanged (misread): {remedy}"
    )


def _fraction_text(mask: np.ndarray) -> str:
    """Return the fraction of True elements of a mask as text in per cent."""
    return f"{100 * np.count_nonzero(mask) / mask.size:.3g} %"


def _target_ranges_text(
    mask: np.ndarray, ranges: np.ndarray, is_absent: np.ndarray | None = None
) -> str:
    """Return the ranges of the points in a mask as text, such as 'from 500 m on'.

    `ranges` (n,) are the ranges of all points [m]. Points marked in ``is_absent`` (n,) are ignored.
    """
    if is_absent is not None and is_absent.any():
        mask, ranges = mask[~is_absent], ranges[~is_absent]
    low, high = ranges[mask].min(), ranges[mask].max()
    if mask.all():
        return "at all ranges"
    if mask[ranges >= low].all():
        return f"from {low:,.6g} m on"
    if mask[ranges <= high].all():
        return f"up to {high:,.6g} m"
    return f"at ranges of {low:,.6g} to {high:,.6g} m"


def _diagnose_grid_echoes(study: GridStudy) -> EchoDiagnosis:
    """Return the diagnosis of the echoes of a grid study.

    Only one of several points with equal `ECHO_PARAMETERS` is checked, and at most
    `ECHO_POINTS_SAMPLED_MAX` points.
    """
    axes = study.spec.axes
    sizes = [axis.size for axis in axes]
    used_indices = [
        np.arange(
            axis.size if any(member.path in ECHO_PARAMETERS for member in axis.parameters) else 1
        )
        for axis in axes
    ]
    n_points = (
        int(np.prod([indices.size for indices in used_indices], dtype=np.int64))
        if used_indices
        else 1
    )
    grid_indices = np.arange(n_points)
    if n_points > ECHO_POINTS_SAMPLED_MAX:
        grid_indices = np.unique(
            np.linspace(0, n_points - 1, ECHO_POINTS_SAMPLED_MAX).astype(np.int64)
        )
    if sizes:
        grid_indices = np.ravel_multi_index(
            np.unravel_index(grid_indices, [indices.size for indices in used_indices]), sizes
        )
    return diagnose_echoes(study.grid.parameters_at(grid_indices))


def _diagnose_flight_echoes(study: FlightStudy) -> EchoDiagnosis:
    """Return the diagnosis of the echoes of sampled shots of a flight.

    Shots are diagnosed at the first and the last point of the flight's axes. The diagnosis has no
    points if no sampled shot hits anything.
    """
    from sweep.model.pointcloud.eyepoints import parameters_and_ground_of_eyepoints
    from sweep.scenes.eyepoint_arrays import eyepoints_from_arrays

    diagnoses = []
    axis_corners = {
        tuple(end_factor * (int(axis.size) - 1) for axis in study.spec.axes)
        for end_factor in (0, 1)
    }
    for eyepoints in study.eyepoint_studies():
        eyepoints_of_sample = eyepoints_from_arrays(
            eyepoints.cast_shots(
                eyepoints.shot_numbers_of_sampled_tiles(SAMPLED_TILES_PER_SCANNER)
            ),
            eyepoints.beamlet_weights,
        )
        hitting_shots = eyepoints_of_sample.has_target.nonzero()[0]
        if not hitting_shots.size:
            continue
        for corner in sorted(axis_corners):
            flight_block = study.scanner_grids[eyepoints.scanner].first_block_at_axes_point(corner)
            parameters = PARAMETER_DEFAULTS | dict(study.parameters_at(flight_block))
            hitting_eyepoints = eyepoints_of_sample.select(hitting_shots)
            shot_parameters, _ = parameters_and_ground_of_eyepoints(
                hitting_eyepoints, parameters, study.surface_materials
            )
            diagnoses.append(
                diagnose_echoes(shot_parameters, FootprintSpreads.from_eyepoints(hitting_eyepoints))
            )
    return (
        EchoDiagnosis(*map(np.concatenate, zip(*diagnoses, strict=True)))
        if diagnoses
        else EchoDiagnosis(*[np.empty(0)] * 7)
    )
