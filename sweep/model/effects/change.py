"""What an effect can change, and what that can make of the probability of detection."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.span import Operand, Span

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


def added_noise(
    *,
    least: ArrayLike,
    largest: ArrayLike,
    noise_variance: Operand,
    threshold_follows: bool = True,
) -> Change:
    """Change by a further source whose variance lies between two values.

    Parameters
    ----------
    least, largest : array_like
        Variance that the source adds, (tiles,) or scalar, >= 0.
    noise_variance : Span or array_like
        Variance of all others, > 0, in the same unit and at the same place in the chain: the
        ratio is the same for currents, and for volts at the ADC if it holds no ADC noise.
    threshold_follows : bool
        Whether the source is there without an echo, so that the threshold is set on it.
    """
    others = Span.of(noise_variance)
    low, high = np.asarray(least) / others.high, np.asarray(largest) / others.low
    return Change(noise=(1 + low, 1 + high), threshold_follows=threshold_follows)
