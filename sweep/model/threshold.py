"""The threshold: by its ratio to the noise, or by the false alarms that it lets pass.

In a bin of noise alone |X| is Rayleigh distributed, of mean sigma sqrt(pi/2) and standard deviation
sigma sqrt(2 - pi/2). A threshold of b sigma is written in one of five ways:

    tnr                  b / sqrt(2 - pi/2), as the thesis has it
    threshold_to_mean    b / sqrt(pi/2)
    design_pfa_bin       exp(-b^2 / 2)
    design_pfa_segment   probability that any bin counted in a segment, the up-chirp's, crosses
    design_pfa_shot      the same of a shot: of any of its segments, one after the other

Design probabilities are those of noise alone, before a detection takes bins away. In several looks
(:mod:`sweep.model.looks`) b is that of each record, or of the root of their mean power, over sigma
of one record, and the probabilities are those of all of them together.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np

from sweep.model import alarms
from sweep.model.band import band_of, number_of
from sweep.model.looks import Looks, level_of
from sweep.model.waveform import DEFAULTS, ORDER, SEGMENTS, order_of, record_length
from sweep.model.window import canonical_name, window

PROCESSING = "instrument.processing."
TNR, TO_MEAN, PFA_BIN, PFA_SEGMENT, PFA_SHOT = WAYS = tuple(
    PROCESSING + name
    for name in (
        "tnr", "threshold_to_mean", "design_pfa_bin", "design_pfa_segment", "design_pfa_shot",
    )
)  # fmt: skip
"""Parameters of which exactly one is given."""

RAYLEIGH_MEAN = math.sqrt(math.pi / 2)
"""Mean of |X| in a noise-only bin, in units of sigma (per quadrature)."""


def tnr_of(p: Mapping[str, Any]) -> np.ndarray:
    """Threshold-to-noise ratio of points that share their words and sizes, however it is written.

    A ValueError where none of the parameters :data:`WAYS` is there, or several.

    >>> four_times_the_mean = tnr_of({"instrument.processing.threshold_to_mean": 4.0})
    >>> round(float(four_times_the_mean), 2)
    7.65
    """
    from sweep.model.detection import RAYLEIGH_DEVIATION
    from sweep.model.marcum import log_at_least_one

    given = [way for way in WAYS if way in p]
    if len(given) != 1:
        raise ValueError(f"give exactly one of {', '.join(WAYS)}, not {len(given)}")
    value = np.asarray(p[given[0]], float)
    if given[0] == TNR:
        return value
    if given[0] == TO_MEAN:
        return value * (RAYLEIGH_MEAN / RAYLEIGH_DEVIATION)
    log_pfa, looks = np.log(value), Looks.of(p)
    if given[0] == PFA_BIN:
        return looks.level(log_pfa) / RAYLEIGH_DEVIATION
    band, segments = band_of(p), ["up"]
    if given[0] == PFA_SHOT:  # segments are independent
        order = order_of(
            str(p["instrument.receiver.architecture"]), str(p.get(ORDER, DEFAULTS[ORDER]))
        )
        if band is None:
            log_pfa = log_at_least_one(log_pfa, 1 / len(order))
        else:
            segments = list(order)
    if band is not None:
        log_pfa = log_pfa + np.zeros(band.shape[2:])
    return level_of(log_pfa, _law(p, segments)) / RAYLEIGH_DEVIATION


def _law(p: Mapping[str, Any], segments: Sequence[str]) -> Callable[[np.ndarray], np.ndarray]:
    """Logarithm of the probability that noise alone raises an alarm in segments, by the level."""
    from sweep.model.marcum import log_any, log_at_least_one

    alarm = Looks.of(p).log_alarm
    return lambda level: reduce(
        log_any, (log_at_least_one(alarm(level), segment_bins(p, level, s)) for s in segments)
    )


def segment_bins(p: Mapping[str, Any], level: np.ndarray, segment: str = "up") -> np.ndarray:
    """Independent bins that alarm as often as those of a segment that a detection takes none of.

    As :meth:`sweep.model.preparation.Shots.counted_bins`. Segments differ where a band is searched.
    """
    size = int(np.max(p[PROCESSING + "fft_size"]))
    is_all = str(p[PROCESSING + "bins_counted"]) == "all"
    in_quadrature = str(p.get("instrument.receiver.record", "real")) == "complex"
    is_all |= in_quadrature
    band, row = band_of(p), SEGMENTS.index(segment)
    if str(p[PROCESSING + "noise_bins"]) == "independent":
        if band is not None:
            number = number_of(band, size, 1, is_signed=in_quadrature)[row]
            return number + np.zeros(np.shape(level))
        return np.full(np.shape(level), float(size if is_all else size // 2))
    taper = window(canonical_name(str(p[PROCESSING + "window"])), int(np.max(record_length(p))))
    first = 1 if in_quadrature else alarms.first_circular(taper, size)
    bins = size if is_all else max(size // 2 + 1 - 2 * first, 0)
    if band is not None:
        bins = number_of(band, size, first, is_signed=in_quadrature)[row]
    correlation = alarms.neighbour_correlation(taper, size)
    return alarms.independent_bins(bins, level=level, correlation=correlation, looks=Looks.of(p))
