"""What a change of bins can make of the probability of detection, in NumPy."""

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.change import Change
from sweep.model.marcum import marcum_q1


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
