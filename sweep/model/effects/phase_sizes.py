"""What a phase error over the record changes of the bin that detects a line.

With w real and even about the record's middle, a phase error phi = o(x) + e(x), odd and even part
(a constant does not matter), changes a line's spectrum W(y), real but for the factor
exp(-i pi y) and the unpaired first sample w_0, by A + i B, all relative to sum w:

    |A| <= a = <|o| + e^2 / 2>      |B| <= b = <|e|>      < > the mean weighted with |w| / sum w

The largest bin has M >= c: the scalloping loss for one line; for several that add as powers the
root of the largest bin's share of all power, by the triangle inequality of their bins. So

    1 - (a + b |w_0| / c) / c  <=  M' / M  <=  sqrt((1 + a/c)^2 + (2 b |w_0| + b^2) / c^2)

An even error, as a drift has within the record, thus counts in the second order. Lines that add as
amplitudes, or with their own images, change by <|phi|> of the sum of their amplitudes, whatever
they make together.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.model.effects.effect import Size
from sweep.model.effects.points import NO_SMEAR, Points, Smear
from sweep.model.window import Window, samples

_NODES = 256
_TURN = 2 * math.pi
_IMAGE = 0.9
"""What an image far away leaves at least of a line whose amplitude it adds to."""


class Means(NamedTuple):
    """Means of powers of x over a window's |w| / sum w, by power 1..4, and what else is needed."""

    absolute: tuple[float, ...]
    """<|x^k|> of odd powers, <|x^k - <x^k>|> of even ones."""
    square: tuple[float, ...]
    """Root of <(x^k - <x^k>)^2> of even powers, 0 of odd ones."""
    steady: tuple[float, ...]
    """Slope of the best straight line of odd powers, 0 of even ones; last, of what is within 1."""
    most: float
    """Sum |w| over sum w, >= 1."""
    edge: float
    """|w_0| over sum w."""
    variance: float
    """Of the place in the record, in records, under |w|."""


@lru_cache(maxsize=16)
def means(window: Window) -> Means:
    """What sizes of phase errors need of a window."""
    x = (2 * np.arange(_NODES) + 1) / _NODES - 1
    w = samples(window.name, window.length)
    place = 2 * np.arange(window.length + 1) / window.length - 1
    at_nodes = np.interp(x, place, np.append(w, w[0]))
    weight = np.abs(at_nodes) / at_nodes.sum()
    most, straight = float(weight.sum()), float((x * x * weight).sum())
    absolute, square, steady = [], [], []
    for k in range(1, 5):
        power = x**k
        steady.append(float((power * x * weight).sum()) / straight if k % 2 else 0.0)
        if k % 2 == 0:
            power = power - (power * weight).sum() / most
        absolute.append(float((abs(power) * weight).sum()))
        square.append(float(np.sqrt((power**2 * weight).sum())) if k % 2 == 0 else 0.0)
    steady.append(absolute[0] / straight)
    edge = abs(window.edge) / window.sum
    return Means(
        tuple(absolute), tuple(square), tuple(steady), most, edge, straight / 4 / most
    )  # fmt: skip


def over_record(points: Points, terms: Mapping[int, np.ndarray]) -> Smear:
    """A sum of powers of the time over the record.

    Parameters
    ----------
    points : Points
        Those.
    terms : mapping
        Coefficients [cycles/s^j] by power j, 2..4, of the time since the segment's start.
    """
    half = 0.5 * points.record_duration
    middle = points.start + half
    found: list[np.ndarray | float] = [0.0] * 5
    for j, coefficient in terms.items():
        for k in range(j + 1):
            found[k] = found[k] + math.comb(j, k) * middle ** (j - k) * half**k * coefficient
    return Smear(tuple(np.abs(c) for c in found[1:]), constant=np.abs(found[0]))


def missed(smear: Smear, window: Window) -> np.ndarray:
    """<|phi|>, by which any bin of a line changes at most, relative to its peak."""
    known = means(window)
    total = smear.rest * known.most
    for value, mean in zip(smear.powers, known.absolute, strict=True):
        total = total + value * mean
    return np.minimum(_TURN * total, 2 * known.most)


def added(points: Points, smear: Smear) -> np.ndarray:
    """What a phase error adds to sums of amplitudes, lines and images, as of :class:`Size`.

    Lines beside their images change by the phase in the record's middle too, and so does a line by
    what an image far away adds to it.
    """
    known = means(points.window)
    anywhere = np.minimum(_TURN * (sum(smear.powers) + smear.rest + smear.constant), 2.0)
    each = np.where(points.near_image, known.most * anywhere, missed(smear, points.window))
    whole = 2 * each / points.lobe.worst
    return np.where(points.may_cancel, whole, points.image * anywhere)


def phase_size(points: Points, name: str) -> Size | None:
    """Size of one of the phase errors, whichever of the others are there."""
    own = points.smears.get(name)
    if own is None:
        return None
    known, others = means(points.window), NO_SMEAR
    for other, smear in points.smears.items():
        others = others if other == name else others.plus(smear)
    one, two, three, four = own.powers
    rest = _TURN * own.rest
    odd = rest * known.most
    odd = odd + _TURN * (one * known.absolute[0] + three * known.absolute[2])
    even = rest * known.most
    even = even + _TURN * (two * known.absolute[1] + four * known.absolute[3])
    root = rest * math.sqrt(known.most)
    root = root + _TURN * (two * known.square[1] + four * known.square[3])
    turned: np.ndarray | float = 0.0
    besides: np.ndarray | float = 0.0
    if len(points.smears) > 1:
        besides = missed(others, points.window)
        far = _TURN * (sum(others.powers) + others.rest)
        turned = missed(own, points.window) * np.minimum(far, 2.0)
    a = np.minimum(odd, 2 * known.most) + np.minimum(root * root / 2, 2 * known.most) + turned
    b = np.minimum(even, known.most) + turned
    least = points.powers[0] / np.where(points.near_image, 2.0, 1.01) / (1 + others.reach)
    c = _IMAGE * np.sqrt(least) - besides
    magnitude = np.where(c > 0, (a + b * known.edge / c) / c + 0.5 * (b / c) ** 2, np.inf)
    moved = rest / _TURN * known.steady[4]
    for value, steady in zip(own.powers, known.steady, strict=False):
        moved = moved + value * steady
    shift = 2 * moved * points.margin
    if not points.may_add:
        return Size(magnitude=magnitude, shift=shift)
    alone = np.where(points.may_cancel, 0.0, magnitude)
    return Size(magnitude=alone, added=added(points, own), shift=shift)
