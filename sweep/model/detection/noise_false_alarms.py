"""False alarms of noise alone in closed form, and the noise variance that explains published ones.

The threshold-to-noise ratio TNR is the threshold over the standard deviation of |X| in a bin of
noise. The bin crosses it with the probability p = exp(-x), x = (4 - pi)/4 TNR^2. Both segments of a
shot, of N bins each, raise a false alarm with the probability (1 - (1 - p)^N)^2. These
probabilities are printed in Tables 4.3 to 4.5 of the thesis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.detection.echo_detection import RAYLEIGH_DEVIATION
from sweep.model.detection.looks import SINGLE_LOOK, Looks
from sweep.model.threshold import n_segment_alarm_bins


def bin_pfa_exponent(tnr: float) -> float:
    """Return -ln of a bin's false-alarm probability, (4 - pi)/4 ``tnr``^2.

    ``tnr`` is the threshold over the standard deviation of |X| in a bin of noise alone.
    """
    return (4 - math.pi) / 4 * tnr**2


def bin_pfa(tnr: float, looks: Looks = SINGLE_LOOK) -> float:
    """Return the probability that a bin of noise alone crosses the threshold [T 3.4].

    Parameters
    ----------
    tnr : float
        Threshold over the standard deviation of |X| in a bin of noise alone. The noise is that of
        one record, or that of the mean of records that are averaged in amplitude (``coherent``).
    looks : Looks
        Number of records of each segment, and how they are combined
        (:class:`sweep.model.detection.looks.Looks`).

    Returns
    -------
    float
        Probability, 0..1.

    Notes
    -----
    For one record, and for records averaged in amplitude, the probability is

        exp(-(4 - pi)/4 tnr^2).

    For other combinations it is that of :meth:`sweep.model.detection.looks.Looks.log_pfa`. At a
    ``tnr`` of 1, 5, 10 and 15 the formula gives 0.807, 4.68e-3, 4.79e-10 and 1.07e-21.
    [T Table 4.2] prints 0.8, 0.047 (a slip for 0.0047), 5.06e-10 and 1.17e-21.
    """
    if looks.is_noncoherent:
        return math.exp(looks.log_pfa(np.asarray(tnr * RAYLEIGH_DEVIATION)))
    return math.exp(-bin_pfa_exponent(tnr))


def n_alarm_equivalent_bins(
    parameters: Mapping[str, Any], pfa_in_bin: ArrayLike, segment: str = "up"
) -> np.ndarray:
    """Return the number of independent noise bins that raise alarms as often as a segment's bins.

    Parameters
    ----------
    parameters
        Parameters of the instrument by dotted path.
    pfa_in_bin
        Probability of a false alarm in one bin. The threshold follows from it.
    segment
        Name of the segment, such as ``up``.
    """
    threshold_ratio = Looks.from_parameters(parameters).threshold_ratio_from_log_pfa(
        np.log(np.maximum(pfa_in_bin, 1e-300))
    )
    return n_segment_alarm_bins(parameters, threshold_ratio, segment)


def segment_pfa(pfa_in_bin: np.ndarray, n_bins: ArrayLike) -> np.ndarray:
    """Return the probability of a false alarm in any of n independent bins of noise [T 3.7].

    Parameters
    ----------
    pfa_in_bin : ndarray
        Probability p of a false alarm in one bin, 0..1.
    n_bins : array_like
        Number n of independent bins, not necessarily an integer.

    Returns
    -------
    ndarray
        1 - (1 - p)^n, of the broadcast shape.
    """
    with np.errstate(divide="ignore"):
        return np.asarray(-np.expm1(np.asarray(n_bins) * np.log1p(-np.asarray(pfa_in_bin))))


def variance_excess_from_bin_pfa(probability: float, tnr: float) -> float:
    """Return the relative excess e of the noise variance that explains false alarms in a bin.

    Parameters
    ----------
    probability : float
        Probability of a false alarm in a bin.
    tnr : float
        Threshold over the standard deviation of |X| in a bin of noise alone.

    Returns
    -------
    float
        Excess e; nan unless 0 < ``probability`` < 1.

    Notes
    -----
    e solves exp(-x / (1 + e)) = ``probability``, with x = (4 - pi)/4 ``tnr``^2.
    """
    if not 0.0 < probability < 1.0:
        return math.nan
    return -bin_pfa_exponent(tnr) / math.log(probability) - 1


def variance_excess_from_shot_pfa(probability: float, tnr: float, n_bins: float) -> float:
    """Return the relative excess e of the noise variance that explains a shot's false alarms.

    Parameters
    ----------
    probability : float
        Probability of a false alarm in both chirps of a shot.
    tnr : float
        Threshold over the standard deviation of |X| in a bin of noise alone.
    n_bins : float
        Number N of independent bins in each of the two segments.

    Returns
    -------
    float
        Excess e; nan unless 0 < ``probability`` < 1.

    Notes
    -----
    e solves (1 - (1 - exp(-x / (1 + e)))^N)^2 = ``probability``, with x = (4 - pi)/4 ``tnr``^2.
    """
    if not 0.0 < probability < 1.0:
        return math.nan
    pfa_in_bin = -math.expm1(math.log1p(-math.sqrt(probability)) / n_bins)
    return variance_excess_from_bin_pfa(pfa_in_bin, tnr)
