"""Light far from its line: images at negative frequencies, and leakage into other bins.

**Images**: a real record has the line also at -f, which reaches the bins of f near DC and Nyquist.

W is the window's transform and nu the position of a line [bins]. Bin X[k] contains W(k - nu) and,
conjugated, W(k + nu). Past Nyquist the visible line is itself an image. Without the effect only the
transform of the folded line is summed, where it is visible. The effect acts on the spectrum. Its
error bound follows from the envelope E of the window's sidelobes. Let all light of a line, wherever
footprint and record put it, be at least e bins from the edge (DC or Nyquist). Then bins within e/2
of the light have images of at most E(3/2 e). All other bins have at most E(e/2) from the lines and
E(e) from the images.

A bin at the threshold, far down the lines' sidelobes, is much smaller than the largest bin. An
image too small to change the largest bin may still move it across the threshold. It then joins the
bins of the detection or leaves them, and the number of bins that may raise a false alarm changes by
one. If lines are d bins away, such a bin has images at 2 e - d. If these move it by a fraction x of
the threshold, it must lie that near to the threshold. Bins whose sidelobes fall no slower than 1/d
lie there with a probability of x d.

**Leakage**: further groups of bins that cross the threshold because of signal in sidelobes. A group
is a run of adjacent bins above the threshold.

Leakage changes ``p_leakage``, but no detecting bin, and so no detection probability. It acts on the
detection: without the effect only bins of the echo's groups are evaluated. By the union bound, with
Marcum's Q_1,

    p_leakage <= sum_k (Q_1(a_k, b) - Q_1(0, b)) / (1 - Q_1(0, b)),   a_k <= min(A E_k, b),

over the bins that may leak. A is the magnitude of all lines together and b the threshold, both over
the noise per quadrature. E_k is the largest relative |W| at the distances that light may have from
bin k. The detecting bin and its neighbours are excluded. By Parseval's theorem the bins together
have at most ENBW (the window's equivalent noise bandwidth in bins) times the power A^2, and the
probability rises faster than a^2. So the sum is at most ENBW times the probability of one bin with
all of A; or, if A is above b, ENBW A^2 / b^2 times that of one bin at the threshold.

References
----------
The sum of line and image is PHYSICS section 5 (:mod:`sweep.model.spectrum.bin_spectrum`). The
probability of leakage is derived in :mod:`sweep.model.spectrum.leakage`.
"""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from sweep.model.detection.looks import SINGLE_LOOK, Looks
from sweep.model.effects.effect import Effect, EffectContext
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.link_budget import PROCESSING_PREFIX
from sweep.model.preparation import Shots
from sweep.model.shot_settings import RECORD_TYPE_PATH
from sweep.model.window import get_window
from sweep.model.window_response import window_response

_LN_10 = math.log(10)
_SIGNAL_RATIO_MAX = 1e12
"""Value to which ratios of signal to noise per quadrature are limited to avoid overflow."""
_EXPECTED_MOVED_BINS_MIN = 1e-4
"""Expected number of a shot's bins that images may move across the threshold, below which such bins
are neglected."""


def image_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of the largest bin if images are omitted.

    Complex records have no images.

    Notes
    -----
    Let all light be at least e bins from DC and Nyquist. If powers add, the bound follows from the
    window's largest sidelobes at e/2, e and 3 e/2 bins, as the module's description states. If
    amplitudes add, they may cancel. In this case images add to any bin at most the largest sidelobe
    at e bins, relative to the sum of all lines in phase.
    """
    if points.shared_option(RECORD_TYPE_PATH) == "complex":
        return None
    log10_pfa_change, bins_from_light_to_edge = (
        _image_log10_pfa_change(points),
        points.bins_from_light_to_edge,
    )
    leaking_bin_change = _image_leaking_bin_change(points)
    if points.adds_amplitudes:
        return ErrorBound(
            coherent_sum_change=points.image_magnitude_bound,
            log10_pfa_change=log10_pfa_change,
            leaking_bin_change_sigma=leaking_bin_change,
        )
    power_min = points.peak_power_min_with_missing_samples(
        points.peak_power_bounds.power_min
        / (1 + 2 * points.phase_error_shift_bins / points.padding_factor)
    )
    response_outside = points.magnitude_max_beyond(bins_from_light_to_edge)
    response_inside, response_beyond = (
        points.magnitude_max_beyond(1.5 * bins_from_light_to_edge),
        points.magnitude_max_beyond(0.5 * bins_from_light_to_edge),
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


def _image_leaking_bin_change(points: PlannerInputs) -> np.ndarray:
    """Return a bound on the change of |X| due to images in bins with leaked signal [noise sigma].

    The bound is for lines that add as powers, and is the larger of two. The first is the change of
    a single bin at the threshold. The second is a change of a single bin that has the effect of the
    changes of all bins. Let a be the image's magnitude in a bin, and b the threshold, both over the
    noise per quadrature, and y = b^2 / 2. A small a raises the probability that the bin crosses the
    threshold by y e^-y a^2 / 2. Let d be ``bins_from_light_to_edge``. At distances beyond d the
    magnitude a falls at least as the inverse distance. The sum of a^2 over all bins is therefore at
    most d times the largest a^2.
    """
    image_ratio = (
        points.line_magnitude_over_sigma
        * points.footprint_extent.amplitude_gain_max
        * points.magnitude_max_beyond(points.bins_from_light_to_edge)
    )
    squared_ratio, threshold_ratio = (
        np.minimum(image_ratio, _SIGNAL_RATIO_MAX) ** 2,
        points.threshold_ratio,
    )
    y = 0.5 * threshold_ratio * threshold_ratio
    single_bin_change = np.minimum(squared_ratio / threshold_ratio, np.sqrt(squared_ratio))
    return np.maximum(
        single_bin_change,
        0.5 * squared_ratio * points.bins_from_light_to_edge * np.minimum(y / np.expm1(y), 1.0),
    )


def _image_log10_pfa_change(points: PlannerInputs) -> np.ndarray | float:
    """Return a bound on the change of log10 of a shot's false-alarm probability due to images.

    Images move bins across the threshold, so that the bins begin or cease to count as an echo. The
    bound counts the expected number of such bins, but at least one bin. It is 0 if fewer than
    ``_EXPECTED_MOVED_BINS_MIN`` bins are expected.
    """
    if points.shared_option(PROCESSING_PREFIX + "bins_counted") == "all":
        return 0.0
    response, nyquist_bin = points.window_response, points.fft_size / 2
    chirp_slice = slice(None, None, 2) if len(points.existing_chirp_slopes) == 3 else slice(None)
    extent_bins = np.minimum(
        points.line_spread.largest_magnitude + points.phase_error_shift_bins, nyquist_bin
    )
    total_ratio = np.maximum(
        points.line_magnitude_over_sigma * points.footprint_extent.amplitude_gain_max, 1e-300
    )
    threshold_distance = np.minimum(
        response.reach_of_magnitude(points.threshold_ratio / total_ratio), nyquist_bin
    )
    if (
        points.missing_sample_bounds is not None
    ):  # sidelobes of an echo that begins within the record
        step_ratio = np.maximum(
            total_ratio * points.missing_sample_bounds.step_sidelobe_factor, 1e-300
        )
        rectangular_response = window_response("rectangular", points.window.length, points.fft_size)
        threshold_distance = np.minimum(
            np.maximum(
                response.reach_of_magnitude(0.5 * points.threshold_ratio / total_ratio),
                rectangular_response.reach_of_magnitude(0.5 * points.threshold_ratio / step_ratio)
                + points.padding_factor,
            ),
            nyquist_bin,
        )
    moved_fraction: np.ndarray | float = 0.0
    for distance in (
        np.maximum(
            2 * points.bins_from_light_to_edge - threshold_distance, points.bins_from_light_to_edge
        ),
        2 * points.bins_from_light_to_edge + threshold_distance,
    ):
        threshold_fraction = np.minimum(
            total_ratio * points.magnitude_max_beyond(distance) / points.threshold_ratio, 1.0
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
        expected_bins > _EXPECTED_MOVED_BINS_MIN,
        np.maximum(expected_bins, 1.0) / (_LN_10 * bins_left),
        0.0,
    )


def apply_image(shots: Shots, context: EffectContext) -> Shots:
    """Sum images with the lines, if the record is real.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Not used (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots whose images are summed with the lines if their record is real.

    Notes
    -----
    Bin k is X[k] = W(k - nu) a / 2 + (W(k + nu) a / 2)^*, for a line of amplitude a at the position
    nu [bins] (PHYSICS section 5). W is the window's transform, and ^* the complex conjugate.
    """
    return replace(
        shots, line_images=shots.line_images._replace(are_summed=not shots.complex_record)
    )


IMAGE = Effect(
    name="image",
    description="lines at negative frequencies, near DC and Nyquist",
    stage="spectrum",
    error_bound=image_error_bound,
    apply=apply_image,
)
"""Effect that adds the images of lines, at negative frequencies, in bins of real records."""


_TABULATED_LIGHT_SHIFTS_BINS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 16.0)
"""Largest shifts of light from its line [bins]. Each shift has a table of leakage bounds."""
_ROWS_PER_OCTAVE, _OCTAVE_MIN, _OCTAVE_MAX = 2, -8, 30
"""Rows of tables of leakage bounds: number per octave, and first and last octave, of the magnitude
of all lines over the threshold."""
_RATIO_OF_TABULATED_THRESHOLDS = 1.04
"""Ratio of the thresholds of successive tables of leakage bounds. Each threshold uses the table of
the next lower tabulated one."""
_SINGLE_BINS, _FAR_STRETCHES = 48, 24
"""Number of bins near the line that count singly in the bound of leakage, and number of intervals
that hold all bins farther away."""
_DISTANT_IMAGE_FACTOR = 1.1
"""Factor on the magnitude of sidelobes that allows for images adding to them, far from DC and
Nyquist. Near DC and Nyquist the factor is 2."""


def leakage_error_bound(points: PlannerInputs) -> ErrorBound:
    """Return a bound on the probability that leaked signal raises a false peak in any segment.

    A false peak is a group of adjacent bins above the threshold, apart from the echo. Leaked signal
    is the signal in bins that stay below the threshold without noise.
    """
    threshold_ratio, is_near_image = points.threshold_ratio, points.is_near_image
    ratio_to_threshold = (
        points.line_magnitude_over_sigma
        * points.footprint_extent.amplitude_gain_max
        * np.where(is_near_image, 2.0, _DISTANT_IMAGE_FACTOR)
        / threshold_ratio
    )
    ratio_to_threshold = np.where(np.isnan(ratio_to_threshold), np.inf, ratio_to_threshold)
    reach_bins = np.where(
        is_near_image, np.inf, points.line_spread.largest_magnitude + points.phase_error_shift_bins
    )
    if points.missing_sample_bounds is None:
        return ErrorBound(
            probability_change=_leakage_probability_bound(
                points, points.window.name, ratio_to_threshold, reach_bins
            )
        )
    # Sidelobes of the window and of the step; in each bin one of the two is the larger.
    step_ratio = 2 * ratio_to_threshold * points.missing_sample_bounds.step_sidelobe_factor
    probability = _leakage_probability_bound(
        points, points.window.name, 2 * ratio_to_threshold, reach_bins
    )
    return ErrorBound(
        probability_change=probability
        + _leakage_probability_bound(
            points, "rectangular", step_ratio, reach_bins + points.padding_factor
        )
    )


def _leakage_probability_bound(
    points: PlannerInputs, window_name: str, ratio_to_threshold: np.ndarray, reach_bins: np.ndarray
) -> np.ndarray:
    """Return a bound on the probability of leakage in all segments, by one window's sidelobes.

    Parameters
    ----------
    points : PlannerInputs
        Points that are planned together.
    window_name : str
        Window whose sidelobes count.
    ratio_to_threshold : ndarray
        Magnitude of all lines together over the threshold.
    reach_bins : ndarray
        Distance by which light may be shifted [bins].

    Returns
    -------
    ndarray
        Sum of the bounds of all segments, by point, >= 0.
    """
    threshold_ratio, row = (
        points.threshold_ratio,
        np.searchsorted(_TABULATED_LIGHT_SHIFTS_BINS, reach_bins),
    )
    octave = np.clip(np.log2(ratio_to_threshold), _OCTAVE_MIN, _OCTAVE_MAX)
    column = np.minimum(
        (octave - _OCTAVE_MIN) * _ROWS_PER_OCTAVE + 1,
        (_OCTAVE_MAX - _OCTAVE_MIN) * _ROWS_PER_OCTAVE,
    )
    column = column.astype(np.int64)
    threshold_step = np.floor(
        np.log(np.clip(threshold_ratio, 1e-3, 1e4)) / math.log(_RATIO_OF_TABULATED_THRESHOLDS)
    )
    distinct_steps, step_index = np.unique(threshold_step, return_inverse=True)
    length = points.window.length
    tables = np.array(
        [
            leakage_bound_table(
                window_name,
                length,
                points.fft_size,
                _RATIO_OF_TABULATED_THRESHOLDS ** float(distinct_step),
                points.looks,
            )
            for distinct_step in distinct_steps
        ]
    )
    probability = tables[step_index.reshape(np.shape(threshold_ratio)), row, column]
    faint_factor = np.minimum(ratio_to_threshold / 2.0**_OCTAVE_MIN, 1.0) ** 2
    return np.asarray((probability * faint_factor).sum(axis=0))


@lru_cache(maxsize=256)
def leakage_bound_table(
    window_name: str, length: int, fft_size: int, threshold_ratio: float, looks: Looks = SINGLE_LOOK
) -> np.ndarray:
    """Tabulate bounds of the probability that leaked signal makes bins cross the threshold.

    Parameters
    ----------
    window_name : str
        Name of the window.
    length, fft_size : int
        Length of the record and FFT size.
    threshold_ratio : float
        Threshold over the noise per quadrature.
    looks : Looks
        Number and combination of records.

    Returns
    -------
    ndarray (reaches + 1, rows)
        Bounds, 0..1. Rows of the first axis are shifts of light from its line
        (``_TABULATED_LIGHT_SHIFTS_BINS``); the last row is Parseval's bound, for any shift. The
        second axis is the magnitude of all lines together over the threshold, in logarithmic steps.
    """
    response, n_rows = (
        window_response(window_name, length, fft_size),
        (_OCTAVE_MAX - _OCTAVE_MIN) * _ROWS_PER_OCTAVE + 1,
    )
    total_ratio = threshold_ratio * 2.0 ** (np.arange(n_rows) / _ROWS_PER_OCTAVE + _OCTAVE_MIN)
    noise_crossing = looks.pd_and_miss_steady(np.zeros(1), np.array([threshold_ratio])).pd[0]
    crossing_of_total = _crossing_probability_added_by_signal(
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
            _crossing_probability_added_by_signal(
                np.minimum(
                    total_ratio[:, None]
                    * response.magnitude_max_beyond(distance - 0.5 - reach_bins),
                    threshold_ratio,
                ),
                threshold_ratio,
                noise_crossing,
                looks,
            )
            * bins_in_stretch
        ).sum(axis=1)
        for reach_bins in _TABULATED_LIGHT_SHIFTS_BINS
    ]
    return np.minimum(np.minimum([*bound_by_reach, parseval_bound], parseval_bound), 1.0)


def _crossing_probability_added_by_signal(
    signal: np.ndarray, threshold_ratio: float, noise_crossing: float, looks: Looks
) -> np.ndarray:
    """Return the probability that signal makes a bin cross the threshold where noise does not.

    ``signal`` (...) and ``threshold_ratio`` are magnitudes over the noise per quadrature;
    ``noise_crossing`` is the probability that the bin crosses by noise alone.
    """
    crossing = looks.pd_and_miss_steady(signal, np.full(signal.shape, threshold_ratio)).pd
    return np.maximum(crossing - noise_crossing, 0.0) / max(1 - noise_crossing, 1e-12)


def apply_leakage(shots: Shots, context: EffectContext) -> Shots:
    """Evaluate the leaked signal in bins on either side of the detection.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Not used (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots whose detection includes leakage.

    Notes
    -----
    p_leakage = 1 - prod_k (1 - p_k) over the bins k that leaked signal may raise, where p_k is the
    probability that a bin crosses the threshold by signal and noise where noise alone does not
    (:mod:`sweep.model.spectrum.leakage`).
    """
    return replace(
        shots,
        detection_settings=shots.detection_settings._replace(leakage_raises_false_alarms=True),
    )


LEAKAGE = Effect(
    name="leakage",
    description="further groups raised by sidelobes below the threshold",
    stage="detection",
    error_bound=leakage_error_bound,
    apply=apply_leakage,
    is_in_time_domain_truth=False,
)
"""Effect that evaluates false peaks: bins that cross the threshold because of sidelobes."""
