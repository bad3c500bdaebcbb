"""Threshold on |X| from its ratio to the noise, or from a design probability of false alarm.

In a bin of noise alone |X| is Rayleigh distributed, with mean sigma sqrt(pi/2) and standard
deviation sigma sqrt(2 - pi/2). One of five parameters sets the threshold of b sigma:

    tnr                  b / sqrt(2 - pi/2), as in the thesis
    threshold_to_mean    b / sqrt(pi/2)
    design_pfa_bin       exp(-b^2 / 2)
    design_pfa_segment   probability that any counted bin of the up-chirp segment crosses
    design_pfa_shot      probability that any counted bin of any segment of a shot crosses

Design probabilities are those of noise alone, with no bins exempt for an echo. With several looks
(:mod:`sweep.model.detection.looks`) b sigma is the threshold on each record, or on the root of
their mean power, with sigma of one record. The probabilities then refer to all looks together.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, reduce
from typing import Any, NamedTuple

import numpy as np

from sweep.model.detection import bin_noise
from sweep.model.detection.looks import Looks, solve_threshold_ratio
from sweep.model.spectrum.search_band import n_alarm_bins, search_band_start_and_size
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
"""Parameter paths of five ways to set the detection threshold; exactly one of them is given."""

RAYLEIGH_MEAN = math.sqrt(math.pi / 2)
"""Mean magnitude of a bin with noise alone, over the noise standard deviation per quadrature."""


def tnr_from_parameters(parameters: Mapping[str, Any]) -> np.ndarray:
    """Return the threshold-to-noise ratio from the parameter that sets the threshold.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path, of points that share strings and sizes.

    Returns
    -------
    ndarray
        Threshold over the standard deviation of |X| in a bin of noise.

    Raises
    ------
    ValueError
        If not exactly one of :data:`THRESHOLD_PATHS` is given.

    Examples
    --------
    >>> four_times_the_mean = tnr_from_parameters({"instrument.processing.threshold_to_mean": 4.0})
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
    (given_path,) = given_paths
    value = np.asarray(parameters[given_path], float)
    if given_path == TNR_PATH:
        return value
    if given_path == THRESHOLD_TO_MEAN_PATH:
        return value * (RAYLEIGH_MEAN / RAYLEIGH_DEVIATION)
    log_pfa, looks = np.log(value), Looks.from_parameters(parameters)
    if given_path == DESIGN_PFA_BIN_PATH:
        return looks.threshold_ratio_from_log_pfa(log_pfa) / RAYLEIGH_DEVIATION
    band_bins, segments = search_band_start_and_size(parameters), ["up"]
    if given_path == DESIGN_PFA_SHOT_PATH:  # segments are independent
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
    noise_bins = tuple(_noise_bins(parameters, segment) for segment in segments)
    if band_bins is None and log_pfa.ndim == 0:
        return _common_threshold_ratio(float(log_pfa), looks, noise_bins) / RAYLEIGH_DEVIATION
    return solve_threshold_ratio(log_pfa, _log_pfa_function(looks, noise_bins)) / RAYLEIGH_DEVIATION


class NoiseBins(NamedTuple):
    """Number of a segment's bins in which noise may raise false alarms, and their correlation."""

    n_bins: float | np.ndarray
    """Number of bins. It is (n,) if a search band is set, otherwise one number for all points."""
    neighbour_correlation: float
    """Correlation coefficient of the noise of adjacent bins; 0 if bins count as independent."""

    def alarm_equivalent_bins(self, threshold_ratio: np.ndarray, looks: Looks) -> np.ndarray:
        """Return the number of independent bins with these bins' false-alarm probability."""
        return bin_noise.alarm_equivalent_bins(
            self.n_bins,
            threshold_ratio=threshold_ratio,
            correlation=self.neighbour_correlation,
            looks=looks,
        )


@lru_cache(maxsize=64)
def _common_threshold_ratio(
    log_pfa: float, looks: Looks, noise_bins: tuple[NoiseBins, ...]
) -> np.ndarray:
    """Return the threshold over the noise sigma for a given probability of false alarm (cached).

    ``log_pfa`` is the natural logarithm of the probability that noise raises an alarm in any
    segment.
    """
    return solve_threshold_ratio(np.asarray(log_pfa), _log_pfa_function(looks, noise_bins))


def _log_pfa_function(
    looks: Looks, noise_bins: Sequence[NoiseBins]
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that gives the log probability of a false alarm in any segment.

    Its argument is the threshold over the noise sigma. ``noise_bins`` are the bins of the segments.
    """
    from sweep.model.detection.marcum import log_at_least_one_probability, log_either_probability

    return lambda threshold_ratio: reduce(
        log_either_probability,
        (
            log_at_least_one_probability(
                looks.log_pfa(threshold_ratio),
                segment_bins.alarm_equivalent_bins(threshold_ratio, looks),
            )
            for segment_bins in noise_bins
        ),
    )


def segment_alarm_bins(
    parameters: Mapping[str, Any], threshold_ratio: np.ndarray, segment: str = "up"
) -> np.ndarray:
    """Return the number of independent bins with the false-alarm probability of a segment.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path, of points that share strings and sizes.
    threshold_ratio : ndarray
        Threshold b over sigma.
    segment : str
        Name of the segment. Segments differ if a search band is set.

    See Also
    --------
    sweep.model.preparation.Shots.alarm_equivalent_bins : The number less the bins of a detection.
    """
    looks = Looks.from_parameters(parameters)
    n_bins = _noise_bins(parameters, segment).alarm_equivalent_bins(threshold_ratio, looks)
    return n_bins + np.zeros(np.shape(threshold_ratio))


def _noise_bins(parameters: Mapping[str, Any], segment: str) -> NoiseBins:
    """Return the number and noise correlation of a segment's bins that may raise false alarms."""
    fft_size = int(np.max(parameters[PROCESSING_PREFIX + "fft_size"]))
    is_complex_record = str(parameters.get("instrument.receiver.record", "real")) == "complex"
    counts_all_bins = is_complex_record or (
        str(parameters[PROCESSING_PREFIX + "bins_counted"]) == "all"
    )
    band_bins, segment_index = search_band_start_and_size(parameters), SEGMENT_NAMES.index(segment)
    if str(parameters[PROCESSING_PREFIX + "noise_bins"]) == "independent":
        if band_bins is None:
            return NoiseBins(float(fft_size if counts_all_bins else fft_size // 2), 0.0)
        n_searched = n_alarm_bins(band_bins, fft_size, 1, is_signed=is_complex_record)
        return NoiseBins(n_searched[segment_index], 0.0)
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
    return NoiseBins(n_bins, bin_noise.neighbour_noise_correlation(record_window, fft_size))
