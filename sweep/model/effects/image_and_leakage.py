"""Light far from its line: images at negative frequencies, and leakage into further bins.

**Images**: the real record's line at -f, which reaches the bins of f near DC and Nyquist.

X[k] has W(k - nu) and, conjugated, W(k + nu); past Nyquist the line that is seen is the image of
one that is not. Without the effect only the kernel of the folded line itself is summed, where it is
seen. It acts on the spectrum. Its size follows from the envelope E of the window's sidelobes. Let
all light of a line, wherever footprint and record put it, be e bins from the edge (DC or Nyquist)
or further. Then bins within e/2 have images at most E(3/2 e) high, and all others at most E(e/2) +
E(e) altogether.

A bin at the threshold, far down the lines' sidelobes, is smaller than the largest by far, and moved
by an image that the largest does not feel. It then belongs to the detection, or does no more, and
of the bins that may raise a false alarm there is one fewer or more. With lines d bins away such a
bin has images at 2 e - d; if these move it by a share x of the threshold, it must lie that near.
Bins whose sidelobes fall no slower than 1/d lie there with a probability of x d.

**Leakage**: extra groups raised by the signal's own bins below the threshold.

It changes no detecting bin, and so no detection probability; it is what ``p_leakage`` holds. It
acts on the detection: without it only bins of the groups are evaluated. By the union bound

    p_leakage <= sum_k (Q_1(a_k, b) - Q_1(0, b)) / (1 - Q_1(0, b)),   a_k <= min(A E_k, b),

over the bins that may leak, with A the magnitude of all lines together, E_k the largest |W| at
the distances that light may have from bin k, and b the threshold, all over sigma. Not among them
are the detecting bin and its neighbours. By Parseval's theorem the bins have no more power together
than ENBW times A^2, and the probability rises faster than a^2. So the sum is at most ENBW times
that of one bin of A, or A^2 / b^2 times that of one at the threshold.
"""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from sweep.model.detection.looks import SINGLE_LOOK, Looks
from sweep.model.effects.effect import Effect, EffectContext, ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.effects.window_response import window_response
from sweep.model.preparation import PROCESSING_PREFIX, RECORD_PATH, Shots
from sweep.model.window import get_window

_LN_10 = math.log(10)
_RATIO_MAX = 1e12
_EXPECTED_BINS_MIN = 1e-4
"""Expected bins at the threshold of a shot that are not reckoned with."""


def image_bound(points: PlannerInputs) -> ErrorBound | None:
    """Change of the largest bin by images; complex records have none.

    If amplitudes add, the sum may be anything, and what images add to any bin of 0..N/2 is at
    most E(e) of all lines in phase.
    """
    if points.option(RECORD_PATH) == "complex":
        return None
    log10_pfa_change, bins_to_image = _log10_pfa_change(points), points.bins_to_image
    leaking_bin_change = _leaking_bin_change(points)
    if points.adds_amplitudes:
        return ErrorBound(
            coherent_sum_change=points.image_bound,
            log10_pfa_change=log10_pfa_change,
            leaking_bin_change_sigma=leaking_bin_change,
        )
    power_min = points.power_without_missing(
        points.peak_power_bounds[0]
        / (1 + 2 * points.phase_error_shift_bins / points.padding_factor)
    )
    response_outside = points.sidelobe_max(bins_to_image)
    response_inside, response_beyond = (
        points.sidelobe_max(1.5 * bins_to_image),
        points.sidelobe_max(0.5 * bins_to_image),
    )
    power_elsewhere = response_beyond * response_beyond + response_outside * response_outside
    image_power = (
        np.maximum(response_inside * response_inside, np.maximum(power_elsewhere - power_min, 0.0))
        / power_min
    )
    return ErrorBound(
        magnitude_change=np.sqrt(1 + image_power) - 1,
        log10_pfa_change=log10_pfa_change,
        leaking_bin_change_sigma=leaking_bin_change,
    )


def _leaking_bin_change(points: PlannerInputs) -> np.ndarray:
    """Change of leakage by images that add as powers: of a bin at the threshold, or of all bins.

    These cross with probabilities of y e^-y a^2 / 2 where a is small, y = b^2 / 2. Images fall no
    slower than 1 / k from ``apart`` on, so all bins have ``apart`` times the nearest's a^2.
    """
    image_ratio = (
        points.line_signal_ratio
        * points.footprint_extent.amplitude_gain_max
        * points.sidelobe_max(points.bins_to_image)
    )
    squared_ratio, threshold_ratio = (
        np.minimum(image_ratio, _RATIO_MAX) ** 2,
        points.threshold_ratio,
    )
    y = 0.5 * threshold_ratio * threshold_ratio
    single_bin_change = np.minimum(squared_ratio / threshold_ratio, np.sqrt(squared_ratio))
    return np.maximum(
        single_bin_change,
        0.5 * squared_ratio * points.bins_to_image * np.minimum(y / np.expm1(y), 1.0),
    )


def _log10_pfa_change(points: PlannerInputs) -> np.ndarray | float:
    """Change of log10 pfa of a shot by the bins that images move across the threshold.

    That of one bin, or of as many as are to be expected were lines anywhere between two bins; 0
    where fewer than ``_EXPECTED_BINS_MIN`` are.
    """
    if points.option(PROCESSING_PREFIX + "bins_counted") == "all":
        return 0.0
    response, nyquist_bin = points.window_response, points.fft_size / 2
    chirp_slice = slice(None, None, 2) if len(points.existing_chirp_rates) == 3 else slice(None)
    extent_bins = np.minimum(
        points.line_spread.extreme + points.phase_error_shift_bins, nyquist_bin
    )
    total_ratio = np.maximum(
        points.line_signal_ratio * points.footprint_extent.amplitude_gain_max, 1e-300
    )
    threshold_distance = np.minimum(
        response.distance_below(points.threshold_ratio / total_ratio), nyquist_bin
    )
    if points.missing_samples is not None:  # sidelobes of an echo that begins with a step
        step_ratio = np.maximum(total_ratio * points.missing_samples.step_sidelobe_factor, 1e-300)
        rectangular_response = window_response("rectangular", points.window.length, points.fft_size)
        threshold_distance = np.minimum(
            np.maximum(
                response.distance_below(0.5 * points.threshold_ratio / total_ratio),
                rectangular_response.distance_below(0.5 * points.threshold_ratio / step_ratio)
                + points.padding_factor,
            ),
            nyquist_bin,
        )
    moved_fraction: np.ndarray | float = 0.0
    for distance in (
        np.maximum(2 * points.bins_to_image - threshold_distance, points.bins_to_image),
        2 * points.bins_to_image + threshold_distance,
    ):
        threshold_fraction = np.minimum(
            total_ratio * points.sidelobe_max(distance) / points.threshold_ratio, 1.0
        )
        moved_fraction = moved_fraction + (
            threshold_fraction
            if points.adds_amplitudes
            else threshold_fraction * threshold_fraction / 2
        )
    reach_bins = threshold_distance + extent_bins
    expected_bins = (moved_fraction * reach_bins)[chirp_slice].sum(axis=0)
    bins_left = np.maximum(nyquist_bin - 2 * reach_bins[chirp_slice].max(axis=0) - 4, 1.0)
    return np.where(
        expected_bins > _EXPECTED_BINS_MIN,
        np.maximum(expected_bins, 1.0) / (_LN_10 * bins_left),
        0.0,
    )


def apply_image(shots: Shots, context: EffectContext) -> Shots:
    """Images summed with the lines, where the record is real."""
    return replace(shots, sums_images=not shots.complex_record)


IMAGE = Effect(
    name="image",
    description="lines at negative frequencies, near DC and Nyquist",
    stage="spectrum",
    error_bound=image_bound,
    apply=apply_image,
)


_TABULATED_REACH_BINS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 16.0)
"""Bins that light may be moved by, up to which there is a table each."""
_ROWS_PER_OCTAVE, _OCTAVE_MIN, _OCTAVE_MAX = 2, -8, 30
"""Rows an octave of A over the threshold, and where they begin and end."""
_THRESHOLD_STEP = 1.04
"""Thresholds have the table of the next lower of some, so far apart."""
_SINGLE_BINS, _FAR_STRETCHES = 48, 24
"""Bins that are looked at one by one, and stretches beyond."""
_IMAGE_FACTOR = 1.1
"""Factor that images may put to sidelobes far from the edge; near it twice as much."""


def leakage_bound(points: PlannerInputs) -> ErrorBound:
    """Probability that leaked signal raises an extra group, in all segments together."""
    threshold_ratio, is_near_image = points.threshold_ratio, points.is_near_image
    ratio_to_threshold = (
        points.line_signal_ratio
        * points.footprint_extent.amplitude_gain_max
        * np.where(is_near_image, 2.0, _IMAGE_FACTOR)
        / threshold_ratio
    )
    ratio_to_threshold = np.where(np.isnan(ratio_to_threshold), np.inf, ratio_to_threshold)
    reach_bins = np.where(
        is_near_image, np.inf, points.line_spread.extreme + points.phase_error_shift_bins
    )
    if points.missing_samples is None:
        return ErrorBound(
            probability_change=_leakage_probability(
                points, points.window.name, ratio_to_threshold, reach_bins
            )
        )
    # Sidelobes of two kinds, of which one is the larger in any bin.
    step_ratio = 2 * ratio_to_threshold * points.missing_samples.step_sidelobe_factor
    probability = _leakage_probability(
        points, points.window.name, 2 * ratio_to_threshold, reach_bins
    )
    return ErrorBound(
        probability_change=probability
        + _leakage_probability(
            points, "rectangular", step_ratio, reach_bins + points.padding_factor
        )
    )


def _leakage_probability(
    points: PlannerInputs, window_name: str, ratio_to_threshold: np.ndarray, reach_bins: np.ndarray
) -> np.ndarray:
    """Probability in all segments together, of sidelobes of a window.

    By their lines' magnitude over the threshold, and the bins that light may be moved by.
    """
    threshold_ratio, row = (
        points.threshold_ratio,
        np.searchsorted(_TABULATED_REACH_BINS, reach_bins),
    )
    octave = np.clip(np.log2(ratio_to_threshold), _OCTAVE_MIN, _OCTAVE_MAX)
    column = np.minimum(
        (octave - _OCTAVE_MIN) * _ROWS_PER_OCTAVE + 1,
        (_OCTAVE_MAX - _OCTAVE_MIN) * _ROWS_PER_OCTAVE,
    )
    column = column.astype(np.int64)
    threshold_step = np.floor(
        np.log(np.clip(threshold_ratio, 1e-3, 1e4)) / math.log(_THRESHOLD_STEP)
    )
    distinct_steps, step_index = np.unique(threshold_step, return_inverse=True)
    length = points.window.length
    tables = np.array(
        [
            leakage_table(
                window_name,
                length,
                points.fft_size,
                _THRESHOLD_STEP ** float(distinct_step),
                points.looks,
            )
            for distinct_step in distinct_steps
        ]
    )
    probability = tables[step_index.reshape(np.shape(threshold_ratio)), row, column]
    faint_factor = np.minimum(ratio_to_threshold / 2.0**_OCTAVE_MIN, 1.0) ** 2
    return np.asarray((probability * faint_factor).sum(axis=0))


@lru_cache(maxsize=256)
def leakage_table(
    window_name: str, length: int, fft_size: int, threshold_ratio: float, looks: Looks = SINGLE_LOOK
) -> np.ndarray:
    """Probabilities by reach and octaves of A over the threshold, the last row by Parseval."""
    response, n_rows = (
        window_response(window_name, length, fft_size),
        (_OCTAVE_MAX - _OCTAVE_MIN) * _ROWS_PER_OCTAVE + 1,
    )
    total_ratio = threshold_ratio * 2.0 ** (np.arange(n_rows) / _ROWS_PER_OCTAVE + _OCTAVE_MIN)
    noise_crossing = looks.pd_and_miss_steady(np.zeros(1), np.array([threshold_ratio]))[0][0]
    crossing_of_total = _added_crossing_probability(
        np.minimum(total_ratio, threshold_ratio), threshold_ratio, noise_crossing, looks
    )
    energy_bins = (
        get_window(window_name, length).equivalent_noise_bandwidth * response.padding_factor
    )
    parseval_bound = (
        crossing_of_total * np.maximum(total_ratio / threshold_ratio, 1.0) ** 2 * energy_bins
    )
    nyquist_bin = fft_size / 2
    stretch_edges = np.unique(
        np.round(np.geomspace(_SINGLE_BINS, max(nyquist_bin, _SINGLE_BINS + 1), _FAR_STRETCHES))
    )
    distance = np.concatenate([np.arange(2.0, _SINGLE_BINS), stretch_edges[:-1]])
    bins_in_stretch = np.concatenate([np.ones(_SINGLE_BINS - 2), np.diff(stretch_edges)])
    bound_by_reach = [
        2
        * (
            _added_crossing_probability(
                np.minimum(
                    total_ratio[:, None] * response.sidelobe_max(distance - 0.5 - reach_bins),
                    threshold_ratio,
                ),
                threshold_ratio,
                noise_crossing,
                looks,
            )
            * bins_in_stretch
        ).sum(axis=1)
        for reach_bins in _TABULATED_REACH_BINS
    ]
    return np.minimum(np.minimum([*bound_by_reach, parseval_bound], parseval_bound), 1.0)


def _added_crossing_probability(
    signal: np.ndarray, threshold_ratio: float, noise_crossing: float, looks: Looks
) -> np.ndarray:
    """Probability to cross the threshold that a bin of some signal has more than one without."""
    crossing = looks.pd_and_miss_steady(signal, np.full(signal.shape, threshold_ratio))[0]
    return np.maximum(crossing - noise_crossing, 0.0) / max(1 - noise_crossing, 1e-12)


def apply_leakage(shots: Shots, context: EffectContext) -> Shots:
    """Bins evaluated on either side of the detection."""
    return replace(shots, includes_leakage=True)


LEAKAGE = Effect(
    name="leakage",
    description="further groups raised by sidelobes below the threshold",
    stage="detection",
    error_bound=leakage_bound,
    apply=apply_leakage,
)
