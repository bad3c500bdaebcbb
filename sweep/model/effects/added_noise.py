"""What noise of one more source changes: the common part of the effects that only add noise."""

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.change import Change
from sweep.model.effects.span import Operand, Span


def change(
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
