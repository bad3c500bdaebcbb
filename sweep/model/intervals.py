"""Intervals of a probability of which draws tell: counted, or averaged over conditional ones.

What is promised is how far the estimate may be off: :func:`half_width` is the distance from it to
the farther end of its interval, so that estimate +- half-width holds the interval. Near 0 and 1,
where intervals lie to one side of the estimate, that is up to twice half their length.

Of counts: Wilson's score interval [J. Am. Stat. Assoc. 22, 209, 1927], right on the average over
probabilities, and Clopper and Pearson's [Biometrika 26, 404, 1934], at least right at every one.

Of a mean m of n values within 0..1 with the variance s^2 of their own: nothing limits from below
what rare values might add that no draw has shown yet, and s^2 = 0 after n equal values proves
nothing. But a mean that lies d above m by rare values between m and 1 has a variance that is larger
as well, by at most (1 - m) d; one that lies d below, by values down to 0, by at most m d. The
interval holds all means that such a variance makes likely, as the score interval does:

    n d^2 = z^2 (s^2 + q d),    q = 1 - m above, m below,
    d = (q z^2 / 2 + sqrt(n s^2 z^2 + q^2 z^4 / 4)) / n.

With s^2 = 0 it is q z^2 / n (3.8 q / n for 95 %), as wide as what n draws can miss; with many
draws it is z s / sqrt(n). Values of only 0 and 1 make it the score interval, but for terms of
z^2 / n of its width.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betaincinv, ndtri


class Interval(NamedTuple):
    """Ends, within 0..1, of the broadcast shape of what they are intervals of."""

    low: np.ndarray
    high: np.ndarray


def wilson(*, successes: ArrayLike, trials: ArrayLike, confidence: ArrayLike) -> Interval:
    """Score interval of the probability of a success.

    Parameters
    ----------
    successes, trials : array_like
        Counts, 0..`trials`; >= 1.
    confidence : array_like
        Of both sides together, 0..1.
    """
    k, n = np.asarray(successes, float), np.asarray(trials, float)
    z = _deviations(confidence)
    mean, square = k / n, z * z
    centre = (k + square / 2) / (n + square)
    reach = z * np.sqrt(k * (1 - mean) + square / 4) / (n + square)
    # At 0 and n the two terms cancel exactly only on paper.
    return _within(np.where(k > 0, centre - reach, 0.0), np.where(k < n, centre + reach, 1.0))


def clopper_pearson(*, successes: ArrayLike, trials: ArrayLike, confidence: ArrayLike) -> Interval:
    """Interval beyond whose ends the counts, or more extreme ones, have (1 - confidence) / 2 each.

    Parameters
    ----------
    successes, trials, confidence : array_like
        As of :func:`wilson`.
    """
    k, n, c = np.broadcast_arrays(
        np.asarray(successes, float), np.asarray(trials, float), np.asarray(confidence, float)
    )
    below, missed = (1 - c) / 2, n - k
    low = np.where(k > 0, betaincinv(np.maximum(k, 1.0), missed + 1, below), 0.0)
    high = np.where(missed > 0, betaincinv(k + 1, np.maximum(missed, 1.0), 1 - below), 1.0)
    return _within(low, high)


COUNTED: dict[str, Callable[..., Interval]] = {
    "clopper_pearson": clopper_pearson,
    "wilson": wilson,
}
"""Intervals of counted shares."""


def bounded_mean(
    *, mean: ArrayLike, variance: ArrayLike, number: ArrayLike, confidence: ArrayLike
) -> Interval:
    """Interval of the expectation of values within 0..1, from the mean of independent ones.

    Parameters
    ----------
    mean : array_like
        0..1.
    variance : array_like
        Of a single value, unbiased (over n - 1); anything, where there is one value only.
    number : array_like
        Values, >= 1.
    confidence : array_like
        As of :func:`wilson`.
    """
    m, n = np.asarray(mean, float), np.asarray(number, float)
    z = _deviations(confidence)
    spread = z * z * n * np.where(n > 1, variance, 0.0)

    def reach(room: np.ndarray) -> np.ndarray:
        lean = room * z * z / 2
        return (lean + np.sqrt(spread + lean * lean)) / n

    return _within(m - reach(m), m + reach(1 - m))


def half_width(estimate: ArrayLike, interval: Interval) -> np.ndarray:
    """Distance from estimates to the farther end of their intervals."""
    estimate = np.asarray(estimate, float)
    return np.maximum(interval.high - estimate, estimate - interval.low)


def _deviations(confidence: ArrayLike) -> np.ndarray:
    """Standard deviations z to either side of a normal mean that hold `confidence`."""
    return np.asarray(ndtri(0.5 + np.asarray(confidence, float) / 2))


def _within(low: np.ndarray, high: np.ndarray) -> Interval:
    return Interval(np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0))
