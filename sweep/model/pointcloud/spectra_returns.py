"""Returns (measured points) of a flight's shots from full spectra, draw by draw.

A detector flags bins of the spectra, and an estimator computes positions of peaks.

Spectra are those of :mod:`sweep.model.sampling.noisy_spectra`, as for grids. A shot is a point,
with the echoes of all surfaces in its footprint. Adjacent flagged bins make a peak, and the
estimator gives its position. The strongest peaks are paired, compared with the truth and measured
as all peaks of flights are (:mod:`sweep.model.pointcloud.returns`).

A peak belongs to an echo if it shares a bin with the echo. An echo extends from the first to the
last bin with half its largest magnitude, plus half a main lobe on either side. With ``peak_bin``
only the strongest bin counts. An echo has one peak, the strongest. All other peaks are
false, however many there are. A false peak is omitted if it contains a bin in which the signal
alone reaches a fixed threshold, or a neighbour of such a bin. Closed forms exempt such bins from
false alarms, too.

Each draw is processed alone, so that a user's function returns the same values however draws are
grouped.

Standard errors by noise are those of interpolation by three bins. In developed speckle they are
those of the estimator where its law is known
(:func:`sweep.model.detection.estimators.position_error_at_unit_signal`). Those of
``peak_bin`` include its rounding.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sweep.model.detection.detectors import main_lobe_half_width
from sweep.model.detection.estimators import (
    ESTIMATOR_PREFIX,
    PEAK_BIN,
    SPECTRUM_METHOD_DEFAULTS,
    position_error_at_unit_signal,
)
from sweep.model.detection.sub_bin_interpolation import interpolator, sub_bin_standard_error
from sweep.model.pointcloud.bin_groups import BinGroups
from sweep.model.pointcloud.ego_motion import EgoMotion
from sweep.model.pointcloud.pairing import FALSE_PEAK_GROUP, PeakPairs
from sweep.model.pointcloud.returns import (
    BIN_ROUNDING_VARIANCE,
    DrawConfig,
    DrawnPeaks,
    DrawWorkspace,
    PeakLists,
    Returns,
    fold_peak,
    make_draw_inputs,
    measure_returns,
    pair_into_returns,
    store_peak,
)
from sweep.model.preparation import Parameters, Shots
from sweep.model.sampling.noisy_spectra import (
    PointSpectra,
    SegmentSignal,
    SpectrumMethods,
    centring_shift,
    estimate_positions,
    flag_detected_bins,
    iter_look_spectra,
    prepare_point_spectra,
    rotate_to_centre,
    zero_frequency_index,
)
from sweep.model.waveform import STRONGEST_PEAK


def draw_spectra_returns(
    shots: Shots,
    bin_groups: BinGroups,
    *,
    keys: np.ndarray,
    parameters: Parameters,
    methods: SpectrumMethods,
    first_draw: int = 0,
    draws: int = 1,
    motion: EgoMotion | None = None,
) -> Returns:
    """Draw returns (measured points) from full noisy spectra by a detector and an estimator.

    Parameters
    ----------
    shots
        Prepared shots.
    bin_groups
        Groups (runs of adjacent bins above the threshold) in the noiseless spectra of the shots.
    keys
        (n, 2) uint64: random key of each shot.
    parameters
        Scalars by dotted path, among them the names of the detector and of the estimator. Missing
        ones have the values of :data:`sweep.model.detection.estimators.SPECTRUM_METHOD_DEFAULTS`.
    methods
        Detectors and estimators by name.
    first_draw, draws
        Number of the first draw, and count of draws.
    motion
        Known motion of the instrument; with None, range and velocity are not corrected for motion.
    """
    method_parameters = {**SPECTRUM_METHOD_DEFAULTS, **parameters}
    _, _, groups_max = bin_groups.strongest_bin.shape
    inputs, drawn_peaks = (
        make_draw_inputs(shots, bin_groups, motion),
        DrawnPeaks.empty(bin_groups, draws),
    )
    config, interpolation = (
        DrawConfig.from_shots(shots, first_draw, True),
        interpolator(shots.window, shots.fft_size),
    )
    peak_lists, pairs = PeakLists.allocate(groups_max + 1), PeakPairs.allocate(groups_max + 1)
    root_n_looks = math.sqrt(shots.looks.number)
    workspace = DrawWorkspace.allocate(0, groups_max)
    zero_index, peaks_max = (
        zero_frequency_index(shots),
        1 if shots.detection_settings.reported_peaks_option == STRONGEST_PEAK else groups_max + 1,
    )
    estimator = str(method_parameters[ESTIMATOR_PREFIX + "kind"])
    rounding_error = math.sqrt(BIN_ROUNDING_VARIANCE) if estimator == PEAK_BIN else 0.0
    error_law = interpolation
    if shots.speckle.line_gradients is not None:
        error_at_unit_signal = position_error_at_unit_signal(
            estimator, shots.window, shots.fft_size
        )
        if error_at_unit_signal is not None:
            error_law = interpolation._replace(error_at_unit_signal=error_at_unit_signal)
    for point in range(shots.size):
        point_spectra = prepare_point_spectra(
            shots,
            point,
            method_parameters,
            keys[point],
            methods,
            bin_groups.strongest_bin[point],
            inputs.line_grid,
        )
        noise_sigma, line_noise_ratio = inputs.noise_sigma[point], inputs.line_noise_ratio[point]
        echo_bounds = [
            _echo_bin_bounds(point_spectra, s, signal)
            for s, signal in enumerate(point_spectra.signals)
        ]
        for d in range(draws):
            peak_lists.n_peaks[:] = 0
            for s, signal in enumerate(point_spectra.signals):
                if signal is None:
                    continue
                spectra = list(iter_look_spectra(point_spectra, s, np.array([first_draw + d])))
                power, bins, echo_of_peak = list_flagged_peaks(
                    spectra, signal, echo_bounds[s], point_spectra, peaks_max
                )
                repeated_spectra = [np.repeat(spectrum, bins.size, axis=0) for spectrum in spectra]
                positions = (
                    estimate_positions(repeated_spectra, bins, point_spectra)
                    if bins.size
                    else np.empty(0)
                )
                for k, (bin_, position) in enumerate(
                    zip(bins.tolist(), positions.tolist(), strict=True)
                ):
                    ratio = math.sqrt(power[bin_]) / noise_sigma
                    offset = min(max(position - bin_, -0.5), 0.5)
                    error = (
                        sub_bin_standard_error(offset, ratio / line_noise_ratio, error_law)
                        / root_n_looks
                    )
                    line_deviation = (
                        inputs.line_deviation_bins[point, s, echo_of_peak[k]]
                        if echo_of_peak[k] >= 0
                        else 0.0
                    )
                    error = math.hypot(error, rounding_error)
                    peak = fold_peak(
                        bin_ - zero_index,
                        position - zero_index,
                        error,
                        ratio,
                        line_deviation,
                        config,
                        interpolation,
                    )
                    store_peak(peak, echo_of_peak[k], s, k, peak_lists)
                peak_lists.n_peaks[s] = bins.size
            pair_into_returns(
                point, point, d, config, inputs, peak_lists, pairs, workspace, drawn_peaks
            )
    return measure_returns(shots, inputs, drawn_peaks, motion, from_three_bins=False)


class EchoBinBounds(NamedTuple):
    """First and last bin of each of k echoes in a segment.

    Bins have the indices that :func:`rotate_to_centre` gives them.
    """

    first_bin: np.ndarray
    """(k,) int64: index of the first bin of each of k echoes. The spectrum of a complex record is
    rotated by :func:`sweep.model.sampling.noisy_spectra.rotate_to_centre`."""
    last_bin: np.ndarray
    """(k,) int64: index of the last bin of each of k echoes, in the same spectrum as ``first_bin``.
    """


class FlaggedPeaks(NamedTuple):
    """Peaks in one draw of a segment, strongest first.

    A peak is a run of adjacent bins that the detector flags.
    """

    spectrum_power: np.ndarray
    """(bins,): |X|^2 of all bins of the spectrum of a segment in a draw [V^2]."""
    strongest_bin: np.ndarray
    """(peaks,) int64: index of the strongest bin of each peak."""
    echo_number: list[int]
    """(peaks,) int64: number of the echo to which each peak belongs; FALSE_PEAK_GROUP for a peak of
    no echo."""


def _echo_bin_bounds(
    point_spectra: PointSpectra, segment: int, signal: SegmentSignal | None
) -> EchoBinBounds:
    """Return the first and last bin of each echo of a point in a segment.

    A segment without a signal has no echoes.
    """
    echo_indices = point_spectra.echo_indices(segment)
    if signal is None or not echo_indices.size:
        return EchoBinBounds(np.empty(0, np.int64), np.empty(0, np.int64))
    shots, settings = point_spectra.shots, point_spectra.settings
    shift = centring_shift(shots, signal.strongest_bin)
    if shots.complex_record:
        echo_indices = (echo_indices + shift - 1) % shots.fft_size + 1
    if shots.detection_settings.echo_bin_rule != "any_bin":
        return EchoBinBounds(echo_indices, echo_indices)
    if echo_indices.size == 1:
        return EchoBinBounds(
            np.array([signal.first_bin + shift]), np.array([signal.last_bin + shift])
        )
    magnitude = rotate_to_centre(shots, np.abs(signal.spectrum), signal.strongest_bin)
    lobe_half_width = math.ceil(
        main_lobe_half_width(settings.window) * settings.fft_size / settings.window.length
    )
    first_bins, last_bins = [], []
    for echo_index in echo_indices:
        low_bins = np.flatnonzero(magnitude < 0.5 * magnitude[echo_index])
        next_low = int(np.searchsorted(low_bins, echo_index))
        first = low_bins[next_low - 1] + 1 if next_low else 0
        last = low_bins[next_low] - 1 if next_low < low_bins.size else magnitude.size - 1
        first_bins.append(first - lobe_half_width)
        last_bins.append(last + lobe_half_width)
    return EchoBinBounds(np.array(first_bins), np.array(last_bins))


def list_flagged_peaks(
    spectra: Sequence[np.ndarray],
    signal: SegmentSignal,
    echo_bounds: EchoBinBounds,
    point_spectra: PointSpectra,
    peaks_max: int,
) -> FlaggedPeaks:
    """Return the peaks in one draw of a segment, strongest first, as :class:`FlaggedPeaks`.

    A peak is a run of adjacent bins that the detector flags.

    Parameters
    ----------
    spectra
        Complex spectra (1, bins) of each look (record of the segment) [V].
    signal
        Signal of the segment without noise.
    echo_bounds
        Bins of the echoes.
    point_spectra
        Spectra of the shot.
    peaks_max
        Largest number of peaks.
    """
    (all_power,), (flags,) = flag_detected_bins(spectra, point_spectra, signal.segment)
    shots, shift = point_spectra.shots, centring_shift(point_spectra.shots, signal.strongest_bin)
    power, flags = (
        rotate_to_centre(shots, values, signal.strongest_bin) for values in (all_power, flags)
    )
    end_index = power.size - 1
    if shots.fft_size_if_end_bins_real and signal.last_bin >= signal.first_bin:
        # Groups exclude DC and Nyquist: flag the inner neighbour of an echo's bin flagged there.
        for end, inner_bin in ((0, 1), (end_index, end_index - 1)):
            if flags[end] and end in (signal.first_bin, signal.last_bin):
                flags[inner_bin] = True
                echo_bounds = EchoBinBounds(
                    *(np.where(bins == end, inner_bin, bins) for bins in echo_bounds)
                )
    flags[[0, -1]] = False
    assert signal.is_exempt is not None
    is_exempt = rotate_to_centre(shots, signal.is_exempt, signal.strongest_bin)
    edges = np.diff(flags.astype(np.int8))
    starts, ends = np.flatnonzero(edges > 0) + 1, np.flatnonzero(edges < 0) + 1
    strongest_bins: list[int] = []
    echo_of_peak: list[int] = []
    first_searched = point_spectra.shots.first_searched_bin
    group_power = [power[start:end].max() for start, end in zip(starts, ends, strict=True)]
    for group_index in np.argsort(-np.array(group_power), kind="stable"):
        start, end = int(starts[group_index]), int(ends[group_index])
        touches_echo = (echo_bounds.first_bin < end) & (start <= echo_bounds.last_bin)
        echo_number = int(touches_echo.argmax()) if touches_echo.any() else int(FALSE_PEAK_GROUP)
        if echo_number == FALSE_PEAK_GROUP and (
            start > end_index - first_searched or end <= first_searched
        ):
            continue
        if echo_number == FALSE_PEAK_GROUP and is_exempt[start:end].any():
            continue
        if echo_number != FALSE_PEAK_GROUP and echo_number in echo_of_peak:
            continue
        strongest_bins.append((start + int(power[start:end].argmax()) - shift) % all_power.size)
        echo_of_peak.append(echo_number)
        if len(strongest_bins) == peaks_max:
            break
    return FlaggedPeaks(all_power, np.array(strongest_bins, np.int64), echo_of_peak)
