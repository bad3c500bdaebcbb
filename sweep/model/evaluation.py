"""Evaluation of shots: from parameters to statistics of detection and false alarms.

Shots are prepared with one line on the beam's axis. Then the effects that are needed are applied
one by one.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace

import numpy as np

from sweep.model import waveform
from sweep.model.beamlet_counts import split_by_category_and_beamlet_count
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.detection_probability import (
    joint_detection_probability,
    shot_pd_and_miss,
)
from sweep.model.detection.marcum import log_at_least_one_probability, log_either_probability
from sweep.model.effects.catalogue import (
    DEFAULT_EFFECTS,
    EFFECT_CATEGORY_KEY_PATHS,
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
from sweep.model.spectrum.segment_spectra import SegmentResults, evaluate_segments
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
    """Return the named effects in the order in which they are applied to shots.

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


def effects_use_beamlet_velocities(names: Collection[str]) -> bool:
    """Return True if at least one named effect uses a separate radial velocity for each beamlet."""
    return any(effect.uses_beamlet_velocities for effect in EFFECTS if effect.name in names)


def prepare_shots(
    parameters: Parameters, effects: Collection[str] = DEFAULT_EFFECTS
) -> Iterator[tuple[np.ndarray, Shots]]:
    """Yield prepared shots on a flat plane, for one category of points at a time.

    Points of a category share all text parameters and array sizes.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path: SI scalars, strings or (n,) arrays. All parameters of instrument,
        target, footprint and accuracy are needed, those of effects if they differ from the
        defaults.
    effects : collection of str
        Names of the effects to simulate.

    Yields
    ------
    point_indices : ndarray (m,)
        Indices of the points of a category.
    shots : Shots
        Prepared shots of these points.
    """
    for point_indices, category_parameters in split_by_category_and_beamlet_count(
        PARAMETER_DEFAULTS | dict(parameters), effects, EFFECT_CATEGORY_KEY_PATHS
    ):
        ground = FlatGround(
            category_parameters,
            point_indices.size,
            has_velocities=effects_use_beamlet_velocities(effects),
        )
        shots = apply_effects(category_parameters, point_indices.size, ground, effects)
        yield (
            point_indices,
            replace(shots, echo_record=shots.echo_record._replace(shots_share_phase_errors=True)),
        )


def prepare_ray_traced_shots(
    parameters: Parameters,
    ground: RayTracedGround,
    effects: Collection[str] = DEFAULT_EFFECTS,
    effect_flags: np.ndarray | None = None,
) -> Shots:
    """Return prepared shots with ray-traced footprints.

    All points share text parameters and array sizes.

    Parameters
    ----------
    parameters : mapping
        As in :func:`prepare_shots`. Ranges and radial velocities are those of the beam's centre;
        grazing angle and reflectance law are not used.
    ground : RayTracedGround
        Footprints of the shots.
    effects : collection of str
        Names of the effects to simulate.
    effect_flags : ndarray (n,) uint32, optional
        Bit mask of each shot's enabled effects, if shots differ. Shots may differ only in effects
        with `Effect.needs_separate_batches` False (:class:`~sweep.model.effects.effect.Effect`).
    """
    parameter_arrays = parameters_as_arrays(PARAMETER_DEFAULTS | dict(parameters))
    return apply_effects(
        parameter_arrays, ground.beamlet_table.row_of_point.size, ground, effects, effect_flags
    )


def apply_effects(
    parameters: Mapping[str, np.ndarray],
    n_points: int,
    ground: Ground,
    effects: Collection[str],
    effect_flags: np.ndarray | None = None,
) -> Shots:
    """Return prepared shots with all effects that are not random.

    Shots first get a single line, on the beam's axis. Effects are then applied one by one.

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
    """Return masks of effects, (n,) by effect name: 1.0 for shots with the effect, else 0.0.

    Effects that all shots have are left out. ``effect_flags`` (n,) is the bit mask of each shot's
    enabled effects.
    """
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
    segment_evaluator: Callable[[Shots], SegmentResults] = evaluate_segments,
) -> dict[str, np.ndarray]:
    """Compute statistics of detection and false alarms, and other outputs, of n shots on a plane.

    Parameters
    ----------
    parameters : mapping
        As in :func:`prepare_shots`.
    effects : collection of str
        Names of the effects to simulate.
    segment_evaluator : callable
        Function that evaluates the segments' spectra; :func:`evaluate_segments` or an equivalent.

    Returns
    -------
    dict of str to ndarray (n,)
        Outputs by name: :data:`sweep.model.outputs.GRID_OUTPUTS`.
    """
    categories = list(prepare_shots(parameters, effects))
    if len(categories) == 1:
        ((_, shots),) = categories
        return shot_statistics(shots, segment_evaluator(shots))
    n_points = sum(point_indices.size for point_indices, _ in categories)
    results: dict[str, np.ndarray] = {}
    for point_indices, shots in categories:
        for name, values in shot_statistics(shots, segment_evaluator(shots)).items():
            results.setdefault(name, np.full(n_points, np.nan))[point_indices] = values
    return results


def shot_statistics(
    shots: Shots, segment_results: SegmentResults | None = None
) -> dict[str, np.ndarray]:
    """Compute the output variables of prepared shots.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    segment_results : SegmentResults, optional
        Result of :func:`evaluate_segments`; computed if it is not given.

    Returns
    -------
    dict of str to ndarray (n,)
        Outputs by name; nan for those that are undefined without an echo.
    """
    segment_results = evaluate_segments(shots) if segment_results is None else segment_results
    pd, miss, magnitude, frequency, n_exempt, leakage = segment_results
    leakage_up, _, leakage_down = leakage
    n_beamlets = shots.footprint.n_beamlets
    snr = shots.snr(magnitude)
    false_alarms = _false_alarm_probabilities(shots, n_exempt)
    measured = measure_range_velocity(shots, segment_results)
    is_range_misread, is_velocity_misread = find_misread_values(shots, measured)
    if shots.detection_settings.reported_peaks_option == waveform.STRONGEST_PEAK:
        strongest_peaks = strongest_peak_probabilities(shots, pd, miss, magnitude, is_range_misread)
        by_segment, of_shot = (result._asdict() for result in strongest_peaks)
    else:
        by_segment = {"pd": pd, "miss": miss}
        of_shot = shot_pd_and_miss(shots, pd, miss, magnitude)._asdict()
    results = {
        f"{name}_{segment}": values[s]
        for name, values in (by_segment | {"snr": snr}).items()
        for s, segment in enumerate(waveform.SEGMENT_NAMES)
    } | {
        **{f"{name}_shot": values for name, values in of_shot.items()},
        **false_alarms,
        "p_leakage_up": leakage_up,
        "p_leakage_down": leakage_down,
        "beamlets": np.full(shots.size, float(n_beamlets)),
        "beamlets_error": shots.footprint.beamlets_error + np.zeros(shots.size),
        "noise_variance": shots.noise_variance,
        "range_error": measured.range - shots.range,
        "radial_velocity_error": measured.radial_velocity - shots.target.radial_velocity,
        "misread": (is_range_misread | is_velocity_misread).astype(float),
    }
    if shots.detects_by_any_two_segments:
        pd_up, _, pd_down = pd
        magnitude_up, _, magnitude_down = magnitude
        results["pd_both_chirps"] = joint_detection_probability(
            shots, pd_up, pd_down, (magnitude_up, magnitude_down)
        )
    has_no_echo = (shots.echo_power == 0) | np.isnan(frequency[shots.has_segment]).any(axis=0)
    return results | {
        name: np.where(has_no_echo, np.nan, results[name]) for name in NAN_WITHOUT_ECHO_OUTPUTS
    }


def measure_range_velocity(shots: Shots, segment_results: SegmentResults) -> waveform.RangeVelocity:
    """Return the range and radial velocity that follow from the segments' strongest bins.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    segment_results : SegmentResults
        Result of :func:`evaluate_segments`.

    Returns
    -------
    RangeVelocity
        Range [m] and radial velocity [m/s], (n,) each.
    """
    peak_frequencies, weights = segment_results.frequency, segment_results.magnitude**2
    if shots.waveform.chirp_rate_ratios != waveform.DEFAULT_CHIRP_RATE_RATIOS:
        return fit_range_velocity_to_peaks(
            shots, peak_frequencies, np.where(shots.has_segment[:, None], weights, 0.0)
        )
    frequency_up, frequency_doppler, frequency_down = peak_frequencies
    _, has_doppler_segment, _ = shots.has_segment
    carrier_up, _, _ = shots.waveform.carriers
    return waveform.resolve_range_velocity(
        up=frequency_up,
        doppler=frequency_doppler if has_doppler_segment else None,
        down=frequency_down,
        carrier=carrier_up,
        bandwidth=shots.waveform.chirp_bandwidth,
        duration=shots.waveform.chirp_duration,
        sample_rate=shots.sample_rate,
        bin_width=shots.sample_rate / shots.fft_size,
        has_signs=shots.complex_record,
        two_beat_assumption=shots.detection_settings.two_beat_assumption,
    )


MISREAD_TOLERANCE_BINS = 4
"""Error of a measured range or velocity [FFT bins] above which it counts as misread. Smaller errors
may be due to rounding of three peaks to bins, and to motion between and within records."""


def find_misread_values(shots: Shots, measured: waveform.RangeVelocity) -> np.ndarray:
    """Return masks of points at which noiseless spectra give a wrong range or radial velocity.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    measured : RangeVelocity
        Range and radial velocity that follow from the spectra's peaks.

    Returns
    -------
    ndarray (2, n) bool
        First row: True where the range is wrong. Second row: True where the radial velocity is
        wrong.

    Notes
    -----
    Beats beyond half the sample rate fold, and the assumption that resolves them may be wrong.
    Errors due to the extent of the footprint, and to motion between and within records, are
    tolerated.
    """
    frequency_tolerance = MISREAD_TOLERANCE_BINS * shots.sample_rate / shots.fft_size
    footprint_rows = shots.footprint.row_of_point
    last_start = max(float(np.max(start)) for start in shots.waveform.segment_starts)
    shot_time = (
        last_start
        + np.asarray(shots.waveform.chirp_duration)
        + np.abs(shots.motion.range_reference_time)
    )
    range_change = (
        np.abs(shots.target.approach_speed) + np.abs(shots.target.radial_velocity)
    ) * shot_time
    range_change = range_change + np.abs(shots.target.acceleration) * shot_time * shot_time
    # An acceleration shifts beats between segments, which changes both measured range and velocity.
    velocity_change = np.abs(shots.target.acceleration) * shot_time
    carrier_up, _, _ = shots.waveform.carriers
    carrier = np.asarray(carrier_up)
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


def fit_range_velocity_to_peaks(
    shots: Shots,
    peak_frequencies: np.ndarray,
    weights: np.ndarray,
    point_indices: np.ndarray | slice = slice(None),
) -> waveform.RangeVelocity:
    """Return the range and radial velocity at the shot's start that fit the peak frequencies best.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    peak_frequencies : ndarray (3, m)
        Peak frequency of each segment [Hz].
    weights : ndarray (3, m)
        Inverse variances of the frequencies up to a common factor; 0 where a segment is not
        detected.
    point_indices : ndarray (m,) or slice
        Points of `shots` to which the columns of the arrays belong.
    """
    coefficients = shots.beat_coefficients.select_points(point_indices)
    sample_rate = np.broadcast_to(shots.sample_rate, (shots.size,))[point_indices]
    return waveform.fit_range_velocity(
        peak_frequencies,
        weights=weights,
        carriers=coefficients.carrier,
        chirp_rates=coefficients.chirp_rate,
        sample_rate=sample_rate,
        bin_width=sample_rate / shots.fft_size,
        has_signs=shots.complex_record,
        two_beat_assumption=shots.detection_settings.two_beat_assumption,
    )


def _false_alarm_probabilities(shots: Shots, n_exempt: np.ndarray) -> dict[str, np.ndarray]:
    """Return the probabilities that noise raises a false alarm, and their log10, by output name.

    The probabilities, (n,) each, are those of one bin, the up-chirp, both chirps, and any segment
    of the shot.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    n_exempt : ndarray (3, n)
        Number of bins of each segment that belong to an echo.
    """
    log_pfa_bin = shots.looks.log_pfa(shots.threshold / shots.bin_noise_sigma)
    has_segment = shots.has_segment[:, None]
    n_equivalent_bins = np.where(
        has_segment, shots.n_alarm_equivalent_bins(np.where(has_segment, n_exempt, 0.0)), 0.0
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
