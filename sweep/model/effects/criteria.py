"""What sizes of effects make of pd, of log10 pfa and of |X|, in one place.

With x = ln a, a and the threshold b over sigma, dQ_1/dx = a b I_1(a b) e^{-(a^2 + b^2)/2} is at
most sqrt(a b / (2 pi)) e^{-(a - b)^2 / 2}, which has one maximum, at a (a - b) = 1/2. It is taken
at its largest between the least and the largest a that all effects together may leave. What is
added to a magnitude counts by dQ_1/da <= 1/2 e^{-(a - b)^2 / 2}, noise that the threshold does not
follow by -dQ_1/d ln b <= b^2 e^{-(a - b)^2 / 2} / sqrt(1 + 2 a b), and

    |d log10 P^2| <= |d b^2| / ln 10

for the chance P^2 of a false alarm in a shot. Where pd is 1 whatever happens bins still have
magnitudes: |X| counts by its change over itself, or over sigma where it is below that.
"""

import math
from collections.abc import Mapping

import numpy as np

from sweep.model.effects.effect import Size
from sweep.model.effects.points import Points

_LN_10 = math.log(10.0)
_HUGE = 1e12


def changes(
    sizes: Mapping[str, Size], points: Points, leaking: Mapping[str, bool] | None = None
) -> dict[str, np.ndarray]:
    """Change of pd, log10 pfa or |X| by each effect, whichever is most, 0..1, over the points.

    Of pd it is the sum of the changes in all segments, which bounds that of their product.

    Parameters
    ----------
    sizes : mapping
        Of the effects that there are, by name.
    points : Points
        Those.
    leaking : mapping, optional
        Where leakage is asked for, of each effect whether it moves light from bins to others. Bins
        that leak are then taken to be off by as many sigmas as the largest; that counts up to the
        leakage's own size.
    """
    low, high = plausible(sizes, points)
    b = points.threshold
    steepest = 0.5 * (b + np.sqrt(b * b + 2))
    at = np.minimum(np.maximum(steepest, low), high)
    near = np.exp(-0.5 * (at - b) ** 2)
    slope, small = np.sqrt(at * b / (2 * math.pi)) * near, np.minimum(high, 1.0)
    found = {}
    for name, size in sizes.items():
        total, most = 0.0, np.maximum(size.shift, size.alarms)
        if _is_there(size.magnitude):
            share = np.minimum(size.magnitude, _HUGE)
            total, most = total + share * slope, np.maximum(most, share * small)
        if _is_there(size.added):
            more = size.added * high
            total = total + 0.5 * near * more
            most = np.maximum(most, more / np.maximum(low, 1.0))
        if _is_there(size.noise):
            louder = np.abs(size.noise)
            total = total + 0.5 * louder * slope
            most = np.maximum(most, 0.5 * louder * small)
            if not size.threshold_follows:
                total = total + 0.5 * louder * b * b * near / np.sqrt(1 + 2 * at * b)
                most = np.maximum(most, b * b * louder / _LN_10)
        if leaking and leaking[name]:
            moved = (np.minimum(size.magnitude, _HUGE) + size.added) * high
            most = np.maximum(most, np.minimum(moved, sizes["leakage"].chance))
        change = np.maximum(_sum(total, points), _most(most, points))
        found[name] = np.fmin(np.maximum(change, size.chance), 1.0)
    return found


def plausible(sizes: Mapping[str, Size], points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest magnitude of the largest bin over sigma that all effects may leave."""
    low = high = points.amplitude
    added: np.ndarray | float = 0.0
    for size in sizes.values():
        if _is_there(size.magnitude):
            share = np.minimum(size.magnitude, _HUGE)
            low, high = low * np.maximum(1 - share, 0.0), high * (1 + share)
        if _is_there(size.noise):
            factor = np.sqrt(1 + np.maximum(size.noise, -1 + 1e-9))
            low, high = low / np.maximum(factor, 1.0), high / np.minimum(factor, 1.0)
        added = added + size.added
    high = np.minimum(high, _HUGE)
    return np.maximum(low - high * added, 0.0), high * (1 + added)


def _is_there(value: np.ndarray | float) -> bool:
    return isinstance(value, np.ndarray) or value != 0.0


def _sum(value: np.ndarray | float, points: Points) -> np.ndarray | float:
    """Over the segments."""
    if np.ndim(value) <= points.ndim:
        return value * (len(points.signs) if np.ndim(value) else 1)
    return np.asarray(value).sum(axis=0)


def _most(value: np.ndarray | float, points: Points) -> np.ndarray | float:
    """In any segment."""
    return np.asarray(value).max(axis=0) if np.ndim(value) > points.ndim else value
