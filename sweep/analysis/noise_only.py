"""False alarms of noise alone, in closed form, and what a published figure says of the noise.

A bin of noise crosses the threshold of TNR standard deviations of its magnitude with probability
p = exp(-x), x = (4 - pi)/4 TNR^2. Both segments of a shot raise a false alarm in N bins each with
probability (1 - (1 - p)^N)^2: what Tables 4.3 to 4.5 of the thesis print.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.detection import RAYLEIGH_DEVIATION
from sweep.model.detectors import DETECTORS, FIXED
from sweep.model.looks import ONE, Looks
from sweep.model.threshold import segment_bins, tnr_of

if TYPE_CHECKING:
    import xarray as xr

    from sweep.spec import SceneSpec, Spec

#: Thresholds and detectors of a study that are looked at, about.
MOST_LOOKED_AT = 400

Chances = TypeVar("Chances", np.ndarray, "xr.DataArray")


def bin_exponent(tnr: float) -> float:
    """X = (4 - pi)/4 TNR^2, minus the logarithm of a bin's false-alarm probability."""
    return (4 - math.pi) / 4 * tnr**2


def bin_probability(tnr: float, looks: Looks = ONE) -> float:
    """Probability that a bin of noise alone crosses the threshold [Table 4.2], 0..1."""
    if looks.several:
        return math.exp(looks.log_alarm(np.asarray(tnr * RAYLEIGH_DEVIATION)))
    return math.exp(-bin_exponent(tnr))


def bins_counted(
    parameters: Mapping[str, Any], bin_probability: ArrayLike, segment: str = "up"
) -> np.ndarray:
    """Independent bins with the false alarms of a segment, by the probability of one in a bin."""
    level = Looks.of(parameters).level(np.log(np.maximum(bin_probability, 1e-300)))
    return segment_bins(parameters, level, segment)


def segment_probability(bin_probability: np.ndarray, bins: ArrayLike) -> np.ndarray:
    """Probability of a false alarm in a segment of so many bins, 1 - (1 - p)^N, 0..1."""
    with np.errstate(divide="ignore"):
        return np.asarray(-np.expm1(np.asarray(bins) * np.log1p(-np.asarray(bin_probability))))


def alarms_of_study(study: Spec | SceneSpec) -> list[tuple[float, float]]:
    """Probabilities that noise raises an alarm in any chirp of a shot, and in both, 0..1.

    One pair for each of the thresholds, FFT sizes and detectors of a study, of which some
    hundreds are looked at; none for detectors of the user's own.
    """
    axes = [
        axis for axis in study.axes
        if any(member.path.startswith("instrument.processing.") for member in axis.members)
    ]  # fmt: skip
    most = max(2, int(MOST_LOOKED_AT ** (1 / max(len(axes), 1))))
    found = []
    along = (np.linspace(0, axis.size - 1, min(axis.size, most)).astype(int) for axis in axes)
    for place in product(*along):
        parameters = study.parameters()
        for axis, index in zip(axes, place, strict=True):
            parameters |= {member.path: member.values[index] for member in axis.members}
        kind = parameters.get("instrument.processing.detector.kind", FIXED)
        if kind == FIXED:
            in_a_bin = bin_probability(float(tnr_of(parameters)), Looks.of(parameters))
        elif kind in DETECTORS:
            in_a_bin = float(parameters["instrument.processing.detector.pfa"])
        else:
            continue
        up, down = (float(bins_counted(parameters, in_a_bin, s)) for s in ("up", "down"))
        one, other, any_ = (
            float(segment_probability(np.asarray(in_a_bin), bins)) for bins in (up, down, up + down)
        )
        found.append((any_, one * other))
    return found


def shot_with_leakage(
    pfa_segment: Chances, pfa_both_chirps: Chances, p_leakage_up: Chances, p_leakage_down: Chances
) -> Chances:
    """Probability that noise or leakage raises an extra group in both chirp segments, 0..1.

    Of noise alone in the up-chirp, and in both, a product, as the segments' numbers of bins
    differ; of leakage in each.
    """
    down = pfa_both_chirps / (pfa_segment + (pfa_segment == 0))  # both are 0 where one is
    up = pfa_segment + p_leakage_up * (1 - pfa_segment)
    return up * (down + p_leakage_down * (1 - down))


def variance_excess_of_bin(probability: float, tnr: float) -> float:
    """Solve exp(-x / (1 + e)) = probability in a bin for the excess e of noise variance; or nan."""
    if not 0.0 < probability < 1.0:
        return math.nan
    return -bin_exponent(tnr) / math.log(probability) - 1


def variance_excess_of_shot(probability: float, tnr: float, bins: float) -> float:
    """Solve (1 - (1 - exp(-x / (1 + e)))^N)^2 = probability for the excess e; or nan."""
    if not 0.0 < probability < 1.0:
        return math.nan
    of_bin = -math.expm1(math.log1p(-math.sqrt(probability)) / bins)
    return variance_excess_of_bin(of_bin, tnr)
