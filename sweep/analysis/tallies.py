"""Means, extremes and medians of any number of values, which are read piece by piece.

All are exact, rounded once, and do not depend on the pieces: a mean comes from integer sums, a
median from its digits, the leading ones first, each in a reading of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import pairwise, product

import dask
import numpy as np

from sweep.analysis.selection import Points, known

DIGIT = 13
"""Bits of a value that a reading finds."""

_WORD = 64
_LEAST_EXPONENT = -1073
"""Of the smallest float, as `numpy.frexp` gives it."""

_MANTISSA, _LOW = 53, 26


def pieces(
    groups: Sequence[Points], variables: Sequence[str]
) -> Iterator[tuple[int, Points, dict[str, np.ndarray]]]:
    """Points of some groups of one dataset, each piece of it read once for all groups.

    Yields
    ------
    number, part, values
        Which group; those of its points that lie in a piece; the variables there, (n,) each.
    """
    dataset = groups[0].dataset
    array = dataset[variables[0]]
    chunks = array.chunks or [(size,) for size in array.shape]
    edges = [pairwise(np.cumsum((0, *lengths)).tolist()) for lengths in chunks]
    for place in product(*edges):
        block = dict(zip(map(str, array.dims), place, strict=True))
        inside = [(n, own) for n, own in enumerate(g.within(block) for g in groups) if own.size]
        if not inside:
            continue
        at = {dim: slice(*ends) for dim, ends in block.items()}
        read = dask.compute(*(known(dataset[v].transpose(*block).isel(at)).data for v in variables))
        for number, part in inside:
            local = np.ix_(*(part.positions[dim] - first for dim, (first, _) in block.items()))
            values = zip(variables, (np.asarray(own)[local].ravel() for own in read), strict=True)
            yield number, part, dict(values)


class Tally:
    """Number, exact mean and extremes of the finite values that were added."""

    def __init__(self) -> None:
        self.number = 0
        self.least, self.largest = math.inf, -math.inf
        self._sum = 0  # in units of 2^(_LEAST_EXPONENT - _MANTISSA)

    def add(self, values: np.ndarray) -> None:
        """Add values (n,), which numbers of nan and infinity are none of."""
        values = values[np.isfinite(values)]
        if not values.size:
            return
        self.number += values.size
        self.least = min(self.least, float(values.min()))
        self.largest = max(self.largest, float(values.max()))
        mantissa, exponent = np.frexp(values)
        high = np.floor(np.ldexp(mantissa, _MANTISSA - _LOW))
        low = np.ldexp(mantissa, _MANTISSA) - np.ldexp(high, _LOW)
        bins = exponent - _LEAST_EXPONENT
        # of 2^26 values or fewer these are integers below 2^53, exact as floats
        sums = np.bincount(bins, weights=high), np.bincount(bins, weights=low)
        for shift in np.flatnonzero(np.bincount(bins)).tolist():
            whole = (int(sums[0][shift]) << _LOW) + int(sums[1][shift])
            self._sum += whole << shift

    @property
    def total(self) -> Fraction:
        """Their sum."""
        return Fraction(self._sum, 1 << (_MANTISSA - _LEAST_EXPONENT))

    @property
    def mean(self) -> float:
        """Their mean; nan where there is none."""
        return float(self.total / self.number) if self.number else math.nan


def tallied(groups: Sequence[Points], variable: str) -> list[Tally]:
    """Tally of a variable over the points of each group."""
    tallies = [Tally() for _ in groups]
    for number, _, values in pieces(groups, [variable]):
        tallies[number].add(values[variable])
    return tallies


class Search:
    """The values at which those up to them come to some cumulated weights.

    Floats are in the order of their bits (with a sign's bit turned over, with all of them where
    it is set). A reading adds up the weights of those values that begin with the bits that are
    known, by their next bits.
    """

    def __init__(self, weights: Sequence[float]) -> None:
        self._found = [(0, float(weight)) for weight in weights]
        self._left = _WORD
        self._sums: dict[int, np.ndarray] = {}

    @property
    def ended(self) -> bool:
        """Tell whether all bits are known."""
        return not self._left or not self._found

    def add(self, values: np.ndarray, weights: np.ndarray | None = None) -> None:
        """Add values (n,) of a reading, each of weight one where none are given."""
        keys = _ordered(values)
        step = min(DIGIT, self._left)
        for prefix in {prefix for prefix, _ in self._found}:
            begin = slice(None) if self._left == _WORD else keys >> self._left == prefix
            digits = (keys[begin] >> (self._left - step)) & ((1 << step) - 1)
            own = None if weights is None else weights[begin]
            sums = np.bincount(digits.astype(np.int64), own, minlength=1 << step)
            self._sums[prefix] = self._sums.get(prefix, 0) + sums

    def end_reading(self) -> None:
        """All values have been added: know the next bits."""
        step = min(DIGIT, self._left)
        found = []
        for prefix, weight in self._found:
            sums = self._sums[prefix]
            cumulated = np.cumsum(sums)
            # the last bin with any weight where rounding leaves the sum a little short
            digit = min(int(np.searchsorted(cumulated, weight)), int(np.flatnonzero(sums)[-1]))
            found.append(((prefix << step) + digit, weight - float(cumulated[digit] - sums[digit])))
        self._found, self._sums, self._left = found, {}, self._left - step

    @property
    def values(self) -> list[float]:
        """The values."""
        return [_value(key) for key, _ in self._found]


def _ordered(values: np.ndarray) -> np.ndarray:
    """Unsigned integers in the order of floats; -0 as 0."""
    bits = (np.asarray(values, float) + 0.0).view(np.uint64)
    negative = bits >> np.uint64(_WORD - 1) == 1
    return np.where(negative, ~bits, bits | np.uint64(1 << (_WORD - 1)))


def _value(key: int) -> float:
    """Return the float of a key."""
    top = 1 << (_WORD - 1)
    bits = key ^ top if key & top else ~key & ((1 << _WORD) - 1)
    return float(np.uint64(bits).view(np.float64))


def search(
    searches: Sequence[Search],
    read: Callable[[], Iterable[tuple[Search, np.ndarray, np.ndarray | None]]],
) -> None:
    """Go through all values as often as it takes; `read` tells of each piece whose it is."""
    while not all(one.ended for one in searches):
        for one, values, weights in read():
            if not one.ended:
                one.add(values, weights)
        for one in searches:
            if not one.ended:
                one.end_reading()


def for_median(number: int) -> Search:
    """Return the search for the median of so many values."""
    return Search([(number + 1) // 2, number // 2 + 1] if number else [])


def median(found: Search) -> float:
    """Return the median that a search for it has found; nan where there are no values."""
    low, high = found.values or (math.nan, math.nan)
    return (low + high) / 2


def medians(groups: Sequence[Points], variable: str, numbers: Sequence[int]) -> list[float]:
    """Median of a variable over the points of each group, of which so many are finite."""
    searches = [for_median(number) for number in numbers]

    def read() -> Iterator[tuple[Search, np.ndarray, None]]:
        for number, _, values in pieces(groups, [variable]):
            own = values[variable]
            yield searches[number], own[np.isfinite(own)], None

    search(searches, read)
    return [median(found) for found in searches]
