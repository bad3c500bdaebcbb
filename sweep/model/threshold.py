"""The threshold: by its ratio to the noise, or by the false alarms that it lets pass.

In a bin of noise alone |X| is Rayleigh distributed, of mean sigma sqrt(pi/2) and standard deviation
sigma sqrt(2 - pi/2). A threshold of b sigma is written in one of five ways:

    tnr                  b / sqrt(2 - pi/2), as the thesis has it
    threshold_to_mean    b / sqrt(pi/2)
    design_pfa_bin       exp(-b^2 / 2)
    design_pfa_segment   probability that any bin counted in a segment, the up-chirp's, crosses
    design_pfa_shot      the same of a shot: of any of its segments, one after the other

Design probabilities are those of noise alone, before a detection takes bins away. In several looks
(:mod:`sweep.model.detection.looks`) b is that of each record, or of the root of their mean power,
over sigma of one record, and the probabilities are those of all of them together.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np

from sweep.model.detection import bin_noise
from sweep.model.detection.looks import Looks, solve_threshold_ratio
from sweep.model.spectrum.search_band import n_alarm_bins, search_band_bins
from sweep.model.waveform import (
    SEGMENT_NAMES,
    SEGMENT_ORDER_PATH,
    WAVEFORM_DEFAULTS,
    existing_segments,
    record_length,
)
from sweep.model.window import canonical_window_name, get_window

PROCESSING_PREFIX = "instrument.processing."
(
    TNR_PATH,
    THRESHOLD_TO_MEAN_PATH,
    DESIGN_PFA_BIN_PATH,
    DESIGN_PFA_SEGMENT_PATH,
    DESIGN_PFA_SHOT_PATH,
) = THRESHOLD_PATHS = tuple(
    PROCESSING_PREFIX + name
    for name in (
        "tnr",
        "threshold_to_mean",
        "design_pfa_bin",
        "design_pfa_segment",
        "design_pfa_shot",
    )
)
"""Parameters of which exactly one is given."""

RAYLEIGH_MEAN = math.sqrt(math.pi / 2)
"""Mean of |X| in a noise-only bin, in units of sigma (per quadrature)."""


def tnr_from_parameters(parameters: Mapping[str, Any]) -> np.ndarray:
    """Threshold-to-noise ratio of points that share their words and sizes, however it is written.

    A ValueError where none of the parameters :data:`THRESHOLD_PATHS` is there, or several.

    >>> four_times_the_mean = tnr_of({"instrument.processing.threshold_to_mean": 4.0})
    >>> round(float(four_times_the_mean), 2)
    7.65
    """
    from sweep.model.detection.echo_detection import RAYLEIGH_DEVIATION
    from sweep.model.detection.marcum import log_at_least_one_probability

    given_paths = [path for path in THRESHOLD_PATHS if path in parameters]
    if len(given_paths) != 1:
        raise ValueError(
            f"give exactly one of {', '.join(THRESHOLD_PATHS)}, not {len(given_paths)}"
        )
    value = np.asarray(parameters[given_paths[0]], float)
    if given_paths[0] == TNR_PATH:
        return value
    if given_paths[0] == THRESHOLD_TO_MEAN_PATH:
        return value * (RAYLEIGH_MEAN / RAYLEIGH_DEVIATION)
    log_pfa, looks = np.log(value), Looks.from_parameters(parameters)
    if given_paths[0] == DESIGN_PFA_BIN_PATH:
        return looks.threshold_ratio_from_log_pfa(log_pfa) / RAYLEIGH_DEVIATION
    band_bins, segments = search_band_bins(parameters), ["up"]
    if given_paths[0] == DESIGN_PFA_SHOT_PATH:  # segments are independent
        segment_order = existing_segments(
            str(parameters["instrument.receiver.architecture"]),
            str(parameters.get(SEGMENT_ORDER_PATH, WAVEFORM_DEFAULTS[SEGMENT_ORDER_PATH])),
        )
        if band_bins is None:
            log_pfa = log_at_least_one_probability(log_pfa, 1 / len(segment_order))
        else:
            segments = list(segment_order)
    if band_bins is not None:
        log_pfa = log_pfa + np.zeros(band_bins.shape[2:])
    return solve_threshold_ratio(log_pfa, _log_pfa_law(parameters, segments)) / RAYLEIGH_DEVIATION


def _log_pfa_law(
    parameters: Mapping[str, Any], segments: Sequence[str]
) -> Callable[[np.ndarray], np.ndarray]:
    """Logarithm of the probability that noise alone raises an alarm in segments, by the level."""
    from sweep.model.detection.marcum import log_at_least_one_probability, log_either_probability

    bin_log_pfa = Looks.from_parameters(parameters).log_pfa
    return lambda threshold_ratio: reduce(
        log_either_probability,
        (
            log_at_least_one_probability(
                bin_log_pfa(threshold_ratio), segment_alarm_bins(parameters, threshold_ratio, s)
            )
            for s in segments
        ),
    )


def segment_alarm_bins(
    parameters: Mapping[str, Any], threshold_ratio: np.ndarray, segment: str = "up"
) -> np.ndarray:
    """Independent bins that alarm as often as those of a segment that a detection takes none of.

    As :meth:`sweep.model.preparation.Shots.alarm_equivalent_bins`. Segments differ where a band is
    searched.
    """
    fft_size = int(np.max(parameters[PROCESSING_PREFIX + "fft_size"]))
    counts_all_bins = str(parameters[PROCESSING_PREFIX + "bins_counted"]) == "all"
    is_complex_record = str(parameters.get("instrument.receiver.record", "real")) == "complex"
    counts_all_bins |= is_complex_record
    band_bins, segment_index = search_band_bins(parameters), SEGMENT_NAMES.index(segment)
    if str(parameters[PROCESSING_PREFIX + "noise_bins"]) == "independent":
        if band_bins is not None:
            n_searched = n_alarm_bins(band_bins, fft_size, 1, is_signed=is_complex_record)[
                segment_index
            ]
            return n_searched + np.zeros(np.shape(threshold_ratio))
        return np.full(
            np.shape(threshold_ratio), float(fft_size if counts_all_bins else fft_size // 2)
        )
    record_window = get_window(
        canonical_window_name(str(parameters[PROCESSING_PREFIX + "window"])),
        int(np.max(record_length(parameters))),
    )
    first_alarm_bin = (
        1 if is_complex_record else bin_noise.first_circular_bin(record_window, fft_size)
    )
    n_bins = fft_size if counts_all_bins else max(fft_size // 2 + 1 - 2 * first_alarm_bin, 0)
    if band_bins is not None:
        n_bins = n_alarm_bins(band_bins, fft_size, first_alarm_bin, is_signed=is_complex_record)[
            segment_index
        ]
    correlation = bin_noise.neighbour_noise_correlation(record_window, fft_size)
    return bin_noise.alarm_equivalent_bins(
        n_bins,
        threshold_ratio=threshold_ratio,
        correlation=correlation,
        looks=Looks.from_parameters(parameters),
    )
