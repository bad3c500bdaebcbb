"""Evaluation of shots: from parameters to statistics of detection and false alarms.

Shots are prepared with one line on the beam's axis. Then the effects that are needed are applied
one by one.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace

import numpy as np

from sweep.model import waveform
from sweep.model.beamlet_counts import split_with_beamlet_counts
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.echo_detection import at_least_two_of_three
from sweep.model.detection.looks import DetectionArrays, pd_and_miss_any_two_in_speckle
from sweep.model.detection.marcum import log_at_least_one_probability, log_either_probability
from sweep.model.detection.pseudo_variance import mean_over_phases
from sweep.model.effects.catalogue import (
    DEFAULT_EFFECTS,
    EFFECT_CATEGORY_PATHS,
    EFFECT_NAMES,
    EFFECTS,
    PARAMETER_DEFAULTS,
)
from sweep.model.effects.effect import Effect, EffectContext
from sweep.model.ground import FlatGround, Ground, RayTracedGround
from sweep.model.outputs import NAN_WITHOUT_ECHO_OUTPUTS
from sweep.model.preparation import (
    Parameters,
    Shots,
    parameters_as_arrays,
    prepare_axis_line,
    require_finite,
)
from sweep.model.spectrum.segment_spectra import evaluate_segments
from sweep.model.spectrum.strongest_peak import strongest_peak_probabilities

__all__ = [
    "Parameters",
    "Shots",
    "evaluate",
    "evaluate_segments",
    "measure_range_velocity",
    "prepare_shots",
    "shot_statistics",
]


def select_effects(names: Collection[str]) -> tuple[Effect, ...]:
    """Return the named effects in the order of their application.

    Raises
    ------
    ValueError
        If a name belongs to no effect.
    """
    if unknown_names := sorted(set(names) - set(EFFECT_NAMES)):
        raise ValueError(
            f"no effect {', '.join(unknown_names)}: choose from {', '.join(EFFECT_NAMES)}"
        )
    return tuple(effect for effect in EFFECTS if effect.name in names)


def use_beamlet_velocities(names: Collection[str]) -> bool:
    """Return True if any of the named effects reads the radial velocities of single beamlets."""
    return any(effect.uses_beamlet_velocities for effect in EFFECTS if effect.name in names)


def prepare_shots(
    parameters: Parameters, effects: Collection[str] = DEFAULT_EFFECTS
) -> Iterator[tuple[np.ndarray, Shots]]:
    """Prepare shots on a flat plane, split by category.

    Parameters
    ----------
    parameters : mapping
        SI scalars, strings or (n,) arrays by dotted path: all of instrument, target, footprint and
        accuracy, and those of effects that differ from their defaults.
    effects : collection of str
        Names of the effects to simulate.

    Yields
    ------
    point_indices : ndarray (m,)
        Points of a category.
    shots : Shots
        Prepared shots of these points.
    """
    for point_indices, category_parameters in split_with_beamlet_counts(
        PARAMETER_DEFAULTS | dict(parameters), effects, EFFECT_CATEGORY_PATHS
    ):
        ground = FlatGround(
            category_parameters,
            point_indices.size,
            has_velocities=use_beamlet_velocities(effects),
        )
        shots = apply_effects(category_parameters, point_indices.size, ground, effects)
        yield (
            point_indices,
            replace(shots, echo_record=shots.echo_record._replace(shares_phase_errors=True)),
        )


def prepare_ray_traced_shots(
    parameters: Parameters,
    ground: RayTracedGround,
    effects: Collection[str] = DEFAULT_EFFECTS,
    effect_flags: np.ndarray | None = None,
) -> Shots:
    """Prepare shots of one category whose footprints are given by ray tracing.

    Parameters
    ----------
    parameters : mapping
        As of :func:`prepare_shots`. Ranges and radial velocities are those of the beam's centre;
        grazing angle and reflectance law are not used.
    ground : RayTracedGround
        Footprints of the shots.
    effects : collection of str
        Names of the effects to simulate.
    effect_flags : ndarray (n,) uint32, optional
        Bit mask of each shot's enabled effects, if shots differ. They may differ in effects that do
        not need separate batches, as :class:`~sweep.model.effects.effect.Effect` states.
    """
    parameter_arrays = parameters_as_arrays(PARAMETER_DEFAULTS | dict(parameters))
    return apply_effects(
        parameter_arrays, ground.beamlets.row_of_point.size, ground, effects, effect_flags
    )


def apply_effects(
    parameters: Mapping[str, np.ndarray],
    n_points: int,
    ground: Ground,
    effects: Collection[str],
    effect_flags: np.ndarray | None = None,
) -> Shots:
    """Prepare shots with one line each, then apply all effects that are not random.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path, as arrays.
    n_points : int
        Number of shots n.
    ground : Ground
        Ground that the beams meet.
    effects : collection of str
        Names of the effects to simulate.
    effect_flags : ndarray (n,) uint32, optional
        Bit mask of each shot's enabled effects, if shots differ.
    """
    context = EffectContext(
        parameters, ground, {} if effect_flags is None else _effect_masks(effects, effect_flags)
    )
    shots = prepare_axis_line(parameters, n_points, ground)
    for effect in select_effects(effects):
        if effect.apply is not None:
            shots = effect.apply(shots, context)
    require_finite(shots)
    return shots


def _effect_masks(effects: Collection[str], effect_flags: np.ndarray) -> dict[str, np.ndarray]:
    """Return masks (n,) of the effects that not all points have: 1.0 where enabled, else 0.0."""
    missing_bits = int(np.bitwise_or.reduce(~effect_flags)) if effect_flags.size else 0
    return {
        effect.name: (effect_flags >> k & 1).astype(float)
        for k, effect in enumerate(EFFECTS)
        if effect.name in effects and not effect.needs_separate_batches and missing_bits >> k & 1
    }


def evaluate(
    parameters: Parameters,
    effects: Collection[str] = DEFAULT_EFFECTS,
    *,
    segment_evaluator: Callable[[Shots], np.ndarray] = evaluate_segments,
) -> dict[str, np.ndarray]:
    """Compute the statistics of n shots on a flat plane.

    Parameters
    ----------
    parameters : mapping
        As of :func:`prepare_shots`.
    effects : collection of str
        Names of the effects to simulate.
    segment_evaluator : callable
        Function that finds the peaks in the spectra; :func:`evaluate_segments` or an equivalent.

    Returns
    -------
    dict of str to ndarray (n,)
        Outputs by name: :data:`sweep.model.outputs.GRID_OUTPUTS`.
    """
    categories = list(prepare_shots(parameters, effects))
    if len(categories) == 1:
        return shot_statistics(categories[0][1], segment_evaluator(categories[0][1]))
    n_points = sum(point_indices.size for point_indices, _ in categories)
    results: dict[str, np.ndarray] = {}
    for point_indices, shots in categories:
        for name, values in shot_statistics(shots, segment_evaluator(shots)).items():
            results.setdefault(name, np.full(n_points, np.nan))[point_indices] = values
    return results


def shot_statistics(
    shots: Shots, segment_results: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Compute the outputs of prepared shots.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    segment_results : ndarray (3, fields, n), optional
        Result of :func:`evaluate_segments`, if it is known.

    Returns
    -------
    dict of str to ndarray (n,)
        Outputs by name; nan for those that are undefined without an echo.
    """
    segment_results = evaluate_segments(shots) if segment_results is None else segment_results
    pd, miss, magnitude, _, n_exempt, leakage = np.moveaxis(segment_results, 1, 0)
    snr = shots.snr(magnitude)
    false_alarms = _false_alarm_probabilities(shots, n_exempt)
    measured = measure_range_velocity(shots, segment_results)
    is_range_misread, is_velocity_misread = find_misread(shots, measured)
    pd_shot, miss_shot = shot_pd_and_miss(shots, pd, miss, magnitude)
    results = {
        f"{name}_{segment}": values[s]
        for name, values in {"pd": pd, "miss": miss, "snr": snr}.items()
        for s, segment in enumerate(waveform.SEGMENT_NAMES)
    } | {
        "pd_shot": pd_shot,
        "miss_shot": miss_shot,
        **false_alarms,
        "p_leakage_up": leakage[0],
        "p_leakage_down": leakage[2],
        "beamlets": np.full(shots.size, float(shots.footprint.n_beamlets)),
        "beamlets_error": shots.footprint.beamlets_error + np.zeros(shots.size),
        "noise_variance": shots.noise_variance,
        "range_error": measured.range - shots.range,
        "radial_velocity_error": measured.radial_velocity - shots.target.radial_velocity,
        "misread": (is_range_misread | is_velocity_misread).astype(float),
    }
    if shots.any_two:
        results["pd_both_chirps"] = shots.joint_detection_probability(
            pd[0], pd[2], (magnitude[0], magnitude[2])
        )
    if shots.detection_settings.reported_peaks == waveform.STRONGEST_PEAK:
        results |= strongest_peak_probabilities(shots, pd, miss, magnitude)
        # Both peaks are the echo's, but they are resolved to another range.
        pd_misread = np.where(is_range_misread, results["pd_shot"], 0.0)
        results["p_wrong_range_shot"] = results["p_wrong_range_shot"] + pd_misread
    has_no_echo = (shots.echo_power == 0) | np.isnan(segment_results[shots.has_segment, 3]).any(
        axis=0
    )
    return results | {
        name: np.where(has_no_echo, np.nan, results[name]) for name in NAN_WITHOUT_ECHO_OUTPUTS
    }


def shot_pd_and_miss(
    shots: Shots, pd: np.ndarray, miss: np.ndarray, magnitudes: np.ndarray
) -> DetectionArrays:
    """Return the probabilities that a shot is detected, and that it is missed.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    pd, miss : ndarray (3, n)
        Probabilities of detection and of a miss of each segment.
    magnitudes : ndarray (3, n)
        |X| of the segments' strongest bins [V].

    Returns
    -------
    DetectionArrays
        pd and miss of the shots, (n,). A miss is not computed as 1 - pd, so that both keep their
        precision.
    """
    if shots.any_two:
        if shots.speckle.segment_correlations is None:
            return DetectionArrays(at_least_two_of_three(pd, miss), at_least_two_of_three(miss, pd))
        threshold_ratio = shots.threshold / shots.line_noise_sigma
        if shots.looks.is_noncoherent:
            look_speckle = shots.speckle.look_speckle
            correlations = (
                np.abs(np.array(shots.speckle.segment_correlations))
                if look_speckle is None
                else look_speckle.segment_correlation
            )
            signal_ratios = magnitudes / shots.line_noise_sigma
            return shots.looks.pd_and_miss_any_two(
                signal_ratios, threshold_ratio, correlations, pd, look_speckle
            )
        correlations = np.abs(np.array(shots.speckle.segment_correlations))
        pd_shot, miss_shot = pd_and_miss_any_two_in_speckle(pd, miss, threshold_ratio, correlations)
        speckle_table = shots.speckle_table
        near_ends = np.flatnonzero(speckle_table.ratio_row.any(axis=0))
        if near_ends.size:
            threshold_ratio = np.broadcast_to(threshold_ratio, shots.size)[near_ends]
            correlations = correlations[:, near_ends]
            pd_shot[near_ends], miss_shot[near_ends] = mean_over_phases(
                speckle_table.phase_factors[speckle_table.ratio_row[:, near_ends]],
                tuple(pd[:, near_ends]),
                lambda *pd: pd_and_miss_any_two_in_speckle(
                    np.array(pd), 1 - np.array(pd), threshold_ratio, correlations
                ),
            )
        return DetectionArrays(pd_shot, miss_shot)
    pd_both = shots.joint_detection_probability(pd[0], pd[2], (magnitudes[0], magnitudes[2]))
    miss_shot = miss[0] + pd[0] * miss[2]
    if shots.speckle.segment_correlations is not None:
        miss_shot = miss[0] + np.maximum(pd[0] - pd_both, 0.0)
    return DetectionArrays(pd_both, np.minimum(miss_shot, 1.0))  # rounding may exceed 1


def measure_range_velocity(shots: Shots, segment_results: np.ndarray) -> waveform.RangeVelocity:
    """Return the range and radial velocity that the peaks of the segments report."""
    peak_frequencies, weights = segment_results[:, 3], segment_results[:, 2] ** 2
    if shots.waveform.chirp_slopes != waveform.DEFAULT_CHIRP_SLOPES:
        return fit_peaks(
            shots, peak_frequencies, np.where(shots.has_segment[:, None], weights, 0.0)
        )
    return waveform.resolve_range_velocity(
        up=peak_frequencies[0],
        doppler=peak_frequencies[1] if shots.has_segment[1] else None,
        down=peak_frequencies[2],
        carrier=shots.waveform.carriers[0],
        bandwidth=shots.waveform.chirp_bandwidth,
        duration=shots.waveform.chirp_duration,
        sample_rate=shots.sample_rate,
        bin_width=shots.sample_rate / shots.fft_size,
        has_signs=shots.complex_record,
        two_beat_assumption=shots.detection_settings.two_beat_assumption,
    )


MISREAD_TOLERANCE_BINS = 4
"""Tolerated error of a measured range or velocity [bins]: rounding of three peaks, and motion
between and within records."""


def find_misread(shots: Shots, measured: waveform.RangeVelocity) -> np.ndarray:
    """Find shots whose noiseless peaks give another range or velocity than the echo's.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    measured : RangeVelocity
        Range and radial velocity of the peaks.

    Returns
    -------
    ndarray (2, n) bool
        Misread range, misread velocity.

    Notes
    -----
    Beats beyond half the sample rate fold, and the assumption that resolves them may be wrong. The
    extent of the footprint, and motion between and within records, are tolerated.
    """
    frequency_tolerance = MISREAD_TOLERANCE_BINS * shots.sample_rate / shots.fft_size
    footprint_rows, last_start = (
        shots.footprint.row_of_point,
        max(float(np.max(start)) for start in shots.waveform.segment_starts),
    )
    shot_time = (
        last_start
        + np.asarray(shots.waveform.chirp_duration)
        + np.abs(shots.motion.range_walk_time)
    )
    range_change = (
        np.abs(shots.target.approach_speed) + np.abs(shots.target.radial_velocity)
    ) * shot_time
    range_change = range_change + np.abs(shots.target.acceleration) * shot_time * shot_time
    # An acceleration shifts beats between segments, which changes both measured range and velocity.
    velocity_change = np.abs(shots.target.acceleration) * shot_time
    carrier = np.asarray(shots.waveform.carriers[0])
    beat_per_metre = shots.waveform.chirp_rate * 2 / SPEED_OF_LIGHT
    range_tolerance = (
        frequency_tolerance + 2 * carrier / SPEED_OF_LIGHT * velocity_change
    ) / beat_per_metre + range_change
    range_tolerance = (
        range_tolerance
        + np.abs(shots.footprint.relative_range_offset).max(axis=1)[footprint_rows] * shots.range
    )
    footprint_velocity = (
        SPEED_OF_LIGHT
        / 2
        * np.abs(shots.footprint.doppler_ratio_offset).max(axis=1)[footprint_rows]
    )
    range_tolerance = (
        range_tolerance + 2 * carrier / SPEED_OF_LIGHT * footprint_velocity / beat_per_metre
    )
    with np.errstate(divide="ignore"):  # direct detection: carrier 0, no velocity
        velocity_per_hertz = SPEED_OF_LIGHT / (2 * carrier)
    velocity_tolerance = (
        (frequency_tolerance + beat_per_metre * range_tolerance) * velocity_per_hertz
        + velocity_change
        + footprint_velocity
    )
    return np.array([
        np.abs(measured.range - shots.range) > range_tolerance,
        np.abs(measured.radial_velocity - shots.target.radial_velocity) > velocity_tolerance,
    ])  # fmt: skip


def fit_peaks(
    shots: Shots,
    peak_frequencies: np.ndarray,
    weights: np.ndarray,
    point_indices: np.ndarray | slice = slice(None),
) -> waveform.RangeVelocity:
    """Measure range and radial velocity at the shot's start by fitting the beats.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    peak_frequencies : ndarray (3, m)
        Frequencies of peaks by segment [Hz].
    weights : ndarray (3, m)
        Inverse variances in any unit; 0 where a segment is not detected.
    point_indices : ndarray (m,) or slice
        Points to which the columns belong.
    """
    carriers, chirp_rates = shots.beat_coefficients
    sample_rate = np.broadcast_to(shots.sample_rate, (shots.size,))[point_indices]
    return waveform.fit_range_velocity(
        peak_frequencies,
        weights=weights,
        carriers=carriers[:, point_indices],
        chirp_rates=chirp_rates[:, point_indices],
        sample_rate=sample_rate,
        bin_width=sample_rate / shots.fft_size,
        has_signs=shots.complex_record,
        two_beat_assumption=shots.detection_settings.two_beat_assumption,
    )


def _false_alarm_probabilities(shots: Shots, n_exempt: np.ndarray) -> dict[str, np.ndarray]:
    """Compute noise's Pfa in a bin, the up-chirp, both chirps and any segment, with log10."""
    log_pfa_bin = shots.looks.log_pfa(shots.threshold / shots.bin_noise_sigma)
    has_segment = shots.has_segment[:, None]
    n_equivalent_bins = np.where(
        has_segment, shots.alarm_equivalent_bins(np.where(has_segment, n_exempt, 0.0)), 0.0
    )
    log_pfa_up, log_pfa_doppler, log_pfa_down = log_at_least_one_probability(
        log_pfa_bin, n_equivalent_bins
    )
    log_pfa = {"bin": log_pfa_bin, "segment": log_pfa_up, "both_chirps": log_pfa_up + log_pfa_down}
    log_pfa["shot"] = log_either_probability(
        log_either_probability(log_pfa_up, log_pfa_doppler), log_pfa_down
    )
    return {f"pfa_{name}": np.exp(value) for name, value in log_pfa.items()} | {
        f"log10_pfa_{name}": value / np.log(10) for name, value in log_pfa.items()
    }
