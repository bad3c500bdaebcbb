"""False alarms of noise alone, in closed form, and what a published figure says of the noise.

A bin of noise crosses the threshold of TNR standard deviations of its magnitude with probability
p = exp(-x), x = (4 - pi)/4 TNR^2. Both segments of a shot raise a false alarm in N bins each with
probability (1 - (1 - p)^N)^2: what Tables 4.3 to 4.5 of the thesis print.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.detection.echo_detection import RAYLEIGH_DEVIATION
from sweep.model.detection.looks import SINGLE_LOOK, Looks
from sweep.model.threshold import segment_alarm_bins


def bin_pfa_exponent(tnr: float) -> float:
    """X = (4 - pi)/4 TNR^2, minus the logarithm of a bin's false-alarm probability."""
    return (4 - math.pi) / 4 * tnr**2


def bin_pfa(tnr: float, looks: Looks = SINGLE_LOOK) -> float:
    """Probability that a bin of noise alone crosses the threshold [Table 4.2], 0..1."""
    if looks.is_noncoherent:
        return math.exp(looks.log_pfa(np.asarray(tnr * RAYLEIGH_DEVIATION)))
    return math.exp(-bin_pfa_exponent(tnr))


def alarm_equivalent_bins(
    parameters: Mapping[str, Any], pfa_in_bin: ArrayLike, segment: str = "up"
) -> np.ndarray:
    """Independent bins with the false alarms of a segment, by the probability of one in a bin."""
    threshold_ratio = Looks.from_parameters(parameters).threshold_ratio_from_log_pfa(
        np.log(np.maximum(pfa_in_bin, 1e-300))
    )
    return segment_alarm_bins(parameters, threshold_ratio, segment)


def segment_pfa(pfa_in_bin: np.ndarray, n_bins: ArrayLike) -> np.ndarray:
    """Probability of a false alarm in a segment of so many bins, 1 - (1 - p)^N, 0..1."""
    with np.errstate(divide="ignore"):
        return np.asarray(-np.expm1(np.asarray(n_bins) * np.log1p(-np.asarray(pfa_in_bin))))


def variance_excess_from_bin_pfa(probability: float, tnr: float) -> float:
    """Solve exp(-x / (1 + e)) = probability in a bin for the excess e of noise variance; or nan."""
    if not 0.0 < probability < 1.0:
        return math.nan
    return -bin_pfa_exponent(tnr) / math.log(probability) - 1


def variance_excess_from_shot_pfa(probability: float, tnr: float, n_bins: float) -> float:
    """Solve (1 - (1 - exp(-x / (1 + e)))^N)^2 = probability for the excess e; or nan."""
    if not 0.0 < probability < 1.0:
        return math.nan
    pfa_in_bin = -math.expm1(math.log1p(-math.sqrt(probability)) / n_bins)
    return variance_excess_from_bin_pfa(pfa_in_bin, tnr)
