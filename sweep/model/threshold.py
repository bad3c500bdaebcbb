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
from typing import Any

import numpy as np

from sweep.model.detection.bin_noise import SearchedBins
from sweep.model.detection.looks import Looks, solve_threshold_ratio
from sweep.model.shot_settings import PROCESSING_PREFIX, RecordSettings, WaveformSettings
from sweep.model.spectrum.search_band import search_band_of_points
from sweep.model.waveform import SEGMENT_NAMES

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
"""Parameter paths of five ways to set the detection threshold; a spec must state exactly one."""

RAYLEIGH_MEAN = math.sqrt(math.pi / 2)
"""Mean magnitude of a noise-only bin, divided by the noise standard deviation per quadrature."""


def tnr_from_parameters(parameters: Mapping[str, Any]) -> np.ndarray:
    """Return the threshold-to-noise ratio from the one parameter that sets the threshold.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path, of points that share strings and sizes.

    Returns
    -------
    ndarray
        Threshold divided by the standard deviation of |X| in a noise-only bin.

    Raises
    ------
    ValueError
        If the number of parameters of :data:`THRESHOLD_PATHS` is not one.

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
    searched_bins, segments = _searched_bins(parameters), ["up"]
    differ_by_segment = np.ndim(searched_bins.n_bins) > 0
    if given_path == DESIGN_PFA_SHOT_PATH:  # segments are independent
        segment_order = WaveformSettings.from_parameters(parameters).segment_order
        if differ_by_segment:
            segments = list(segment_order)
        else:
            log_pfa = log_at_least_one_probability(log_pfa, 1 / len(segment_order))
    if differ_by_segment:
        log_pfa = log_pfa + np.zeros(np.shape(searched_bins.n_bins)[1:])
    bins_by_segment = tuple(
        searched_bins.select_segment(SEGMENT_NAMES.index(segment)) for segment in segments
    )
    if not differ_by_segment and log_pfa.ndim == 0:
        return _common_threshold_ratio(float(log_pfa), looks, bins_by_segment) / RAYLEIGH_DEVIATION
    log_pfa_function = _log_pfa_function(looks, bins_by_segment)
    return solve_threshold_ratio(log_pfa, log_pfa_function) / RAYLEIGH_DEVIATION


@lru_cache(maxsize=64)
def _common_threshold_ratio(
    log_pfa: float, looks: Looks, bins_by_segment: tuple[SearchedBins, ...]
) -> np.ndarray:
    """Return the threshold over the noise sigma that a probability of false alarm needs (cached).

    ``log_pfa`` is the natural logarithm of the probability that noise raises an alarm in at least
    one segment. ``bins_by_segment`` are the bins in which noise can raise alarms.
    """
    return solve_threshold_ratio(np.asarray(log_pfa), _log_pfa_function(looks, bins_by_segment))


def _log_pfa_function(
    looks: Looks, bins_by_segment: Sequence[SearchedBins]
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of the ratio of threshold to noise sigma per quadrature.

    Its values are the natural logarithm of the probability that noise raises a false alarm in at
    least one segment. ``bins_by_segment`` are the bins in which noise can raise alarms.
    """
    from sweep.model.detection.marcum import log_at_least_one_probability, log_either_probability

    return lambda threshold_ratio: reduce(
        log_either_probability,
        (
            log_at_least_one_probability(
                looks.log_pfa(threshold_ratio),
                segment_bins.n_alarm_equivalent_bins(threshold_ratio, looks),
            )
            for segment_bins in bins_by_segment
        ),
    )


def n_segment_alarm_bins(
    parameters: Mapping[str, Any], threshold_ratio: np.ndarray, segment: str = "up"
) -> np.ndarray:
    """Return the number of independent noise bins with the false-alarm probability of a segment.

    At least one of these bins crosses the threshold as probably as one of the segment's.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path, of points that share strings and sizes.
    threshold_ratio : ndarray
        Ratio b of threshold to noise sigma.
    segment : str
        Name of the segment. Segments differ if a search band is set.

    See Also
    --------
    sweep.model.preparation.Shots.n_alarm_equivalent_bins : The number without the echo's bins.
    """
    looks = Looks.from_parameters(parameters)
    segment_bins = _searched_bins(parameters).select_segment(SEGMENT_NAMES.index(segment))
    n_bins = segment_bins.n_alarm_equivalent_bins(threshold_ratio, looks)
    return n_bins + np.zeros(np.shape(threshold_ratio))


def _searched_bins(parameters: Mapping[str, Any]) -> SearchedBins:
    """Return the bins in which noise can raise false alarms, from parameters by dotted path."""
    record = RecordSettings.from_parameters(parameters)
    waveform = WaveformSettings.from_parameters(parameters)
    return SearchedBins.from_record(
        record,
        noise_bins=str(parameters[PROCESSING_PREFIX + "noise_bins"]),
        bins_counted=str(parameters[PROCESSING_PREFIX + "bins_counted"]),
        search_band=search_band_of_points(parameters, waveform, record),
    )
