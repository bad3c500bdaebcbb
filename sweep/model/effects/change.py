"""What an effect can change, and what that can make of the probability of detection."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.span import Span
from sweep.model.marcum import marcum_q1

Interval = tuple[ArrayLike, ArrayLike]

NONE: Interval = (1.0, 1.0)
NOTHING = 0.0


class Change(NamedTuple):
    """Factors, least and largest, by which an effect can change what is computed without it.

    Each is of one shape, (tiles,) or (3, tiles) by segment, or a scalar.
    """

    signal: Interval = NONE
    """On the magnitude of the bin that detects."""
    noise: Interval = NONE
    """On the noise variance of a bin."""
    threshold_follows: bool = True
    """Whether the threshold is set on the changed noise, as for noise that is always there; else
    it stays where it was, as for noise that comes with the signal."""
    added: ArrayLike = NOTHING
    """What is besides added to that magnitude, or taken from it, at the most: as a share of the
    block's amplitude times what the other effects make of it. For sums of amplitudes, which may
    cancel: a share of what they leave cannot be told."""
    shift: ArrayLike = NOTHING
    """Bins by which it moves what is measured; they count as a change of a probability does."""
    alarms: ArrayLike = NOTHING
    """Change of log10 of a shot's probability of a false alarm as it lifts bins over the threshold
    or lets them fall below, (tiles,) or a scalar; 0 where it hardly ever does."""


class Mean(NamedTuple):
    """What an effect can change of (mean) probabilities, from whatever the others make."""

    change: Callable[[Span, Span], np.ndarray]
    """Bound on it, (3, tiles), from spans of magnitude (3, tiles) and threshold over sigma."""


Bound = Change | Mean | np.ndarray
"""Factors; or what can be told of a probability itself, (tiles,) or (3, tiles)."""


def pd_change(change: Change, *, amplitude: ArrayLike, threshold: ArrayLike) -> np.ndarray:
    """Largest change of the probability of detection that a change of bins can make, 0..1.

    Q_1(a, b) rises with a and falls with b, so its extremes lie at the ends of the intervals.

    Parameters
    ----------
    change : Change
        What the effect can change.
    amplitude, threshold : array_like
        Magnitude of the detecting bin and the threshold, computed without the effect, over the
        noise's standard deviation in a quadrature, >= 0.
    """
    a, b = np.asarray(amplitude, float), np.asarray(threshold, float)
    quiet, loud = (1 / np.sqrt(np.asarray(v, float)) for v in change.noise)
    weak, strong = (np.asarray(v, float) for v in change.signal)
    high, low = (b, b) if change.threshold_follows else (b * quiet, b * loud)
    without = marcum_q1(a, b).q
    most = marcum_q1(_scaled(a, strong * quiet), low).q
    least = marcum_q1(_scaled(a, weak * loud), high).q
    return np.asarray(np.maximum(most - without, without - least))


def _scaled(amplitude: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Amplitude times a factor that may be inf; nothing stays nothing."""
    a, factor = np.broadcast_arrays(amplitude, factor)
    return np.multiply(a, factor, where=a > 0, out=np.zeros(a.shape))
