"""Spans: the least and the largest value of a quantity over the points of each tile of a grid.

Interval arithmetic on arrays. Where both ends are the same, the arithmetic is that of plain
numbers to the last bit; no end is rounded outwards. A quantity that enters a formula twice is
taken for two: the result holds all values, and may be wider than it need be.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Union

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

Operand = Union["Span", float, int, np.ndarray]


@dataclass(slots=True, eq=False)  # not frozen: that takes three times as long to make
class Span:
    """Least and largest value, scalars or arrays that broadcast against each other's shapes."""

    low: np.ndarray | float
    high: np.ndarray | float

    __array_ufunc__ = None  # an array times a span is a span, not an array of spans

    @staticmethod
    def of(value: Operand) -> "Span":
        """A span that is one value; a span as it is."""
        return value if isinstance(value, Span) else Span(value, value)

    @staticmethod
    def hull(*values: Operand) -> "Span":
        """The least span that holds all of some."""
        spans = [Span.of(value) for value in values]
        low, high = spans[0].low, spans[0].high
        for span in spans[1:]:
            low, high = np.minimum(low, span.low), np.maximum(high, span.high)
        return Span(low, high)

    @property
    def is_one(self) -> bool:
        """Whether all tiles have one and the same value."""
        if isinstance(self.low, float) and isinstance(self.high, float):
            return bool(self.low == self.high)
        low, high = np.asarray(self.low), np.asarray(self.high)
        if not low.size:
            return False
        first = low.flat[0]
        return all_hold(low == first) and all_hold(high == first)

    @property
    def magnitude(self) -> np.ndarray:
        """Largest magnitude."""
        if self.low is self.high:
            return np.asarray(np.abs(self.low))
        return np.asarray(np.maximum(np.abs(self.low), np.abs(self.high)))

    def some(self, index: np.ndarray | slice | int) -> "Span":
        """The spans of some tiles, or of one; one for all stays it."""
        ends = (np.asarray(end)[index] if np.ndim(end) else end for end in (self.low, self.high))
        return Span(*ends)

    def holds(self, value: ArrayLike, rounding: float = 0.0) -> np.ndarray:
        """Whether a value lies within, by tile; ``rounding`` is relative room."""
        v = np.asarray(value, float)
        room = rounding * np.abs(v) if rounding else 0.0
        return np.asarray((v >= self.low - room) & (v <= self.high + room))

    def __add__(self, other: Operand) -> "Span":
        o = Span.of(other)
        return Span(self.low + o.low, self.high + o.high)

    __radd__ = __add__

    def __neg__(self) -> "Span":
        return Span(-self.high, -self.low)

    def __sub__(self, other: Operand) -> "Span":
        o = Span.of(other)
        return Span(self.low - o.high, self.high - o.low)

    def __rsub__(self, other: Operand) -> "Span":
        o = Span.of(other)
        return Span(o.low - self.high, o.high - self.low)

    def __mul__(self, other: Operand) -> "Span":
        if isinstance(other, float | int):  # checked once, and not over all tiles
            low, high = self.low * other, self.high * other
            return Span(low, high) if other >= 0 else Span(high, low)
        o = Span.of(other)
        if _never_negative(self.low) and _never_negative(o.low):
            return Span(self.low * o.low, self.high * o.high)
        return _extremes(self.low * o.low, self.low * o.high, self.high * o.low, self.high * o.high)

    __rmul__ = __mul__

    def times(self, *others: Operand) -> "Span":
        """Product with others, all of which are known never to be negative."""
        low, high = self.low, self.high
        for other in others:
            o = Span.of(other)
            low, high = low * o.low, high * o.high
        return Span(low, high)

    def __truediv__(self, other: Operand) -> "Span":
        """Infinite to both sides where the divisor's span holds 0 and is not 0 itself."""
        if isinstance(other, float | int) and 1 <= other < np.inf:
            return Span(self.low / other, self.high / other)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # as by denormals
            return self._over(other)

    def _over(self, other: Operand) -> "Span":
        if isinstance(other, float | int) and other > 0:
            return Span(self.low / other, self.high / other)
        o = Span.of(other)
        if _positive(o.low):
            if _never_negative(self.low):
                return Span(self.low / o.high, self.high / o.low)
            return _extremes(
                self.low / o.low, self.low / o.high, self.high / o.low, self.high / o.high
            )
        found = _extremes(
            *(np.divide(a, b) for a in (self.low, self.high) for b in (o.low, o.high))
        )
        through = np.less_equal(o.low, 0) & np.greater_equal(o.high, 0)
        return Span(np.where(through, -np.inf, found.low), np.where(through, np.inf, found.high))

    def __rtruediv__(self, other: Operand) -> "Span":
        return Span.of(other) / self

    def __pow__(self, power: float) -> "Span":
        """A number's power; a span that may be negative has whole ones only."""
        if power < 0:
            return 1.0 / self ** (-power)
        if _never_negative(self.low):
            return Span(self.low**power, self.high**power)
        found = _extremes(self.low**power, self.high**power)
        if power % 2:
            return found
        through = np.less_equal(self.low, 0) & np.greater_equal(self.high, 0)
        return Span(np.where(through, 0.0, found.low), found.high)

    def __abs__(self) -> "Span":
        ends = _extremes(np.abs(self.low), np.abs(self.high))
        through = np.less_equal(self.low, 0) & np.greater_equal(self.high, 0)
        return Span(np.where(through, 0.0, ends.low), ends.high)

    @property
    def is_zero(self) -> bool:
        """Whether it is 0 in all tiles."""
        if isinstance(self.low, float) and isinstance(self.high, float):
            return bool(self.low == 0 and self.high == 0)
        return not (any_holds(self.low != 0) or any_holds(self.high != 0))

    def sqrt(self) -> "Span":
        """Square root of what is not negative."""
        return Span(np.sqrt(self.low), np.sqrt(self.high))

    def minimum(self, other: Operand) -> "Span":
        """The smaller of two."""
        o = Span.of(other)
        return Span(np.minimum(self.low, o.low), np.minimum(self.high, o.high))

    def maximum(self, other: Operand) -> "Span":
        """The larger of two."""
        o = Span.of(other)
        return Span(np.maximum(self.low, o.low), np.maximum(self.high, o.high))


def monotone(
    function: Callable[..., np.ndarray],
    *,
    falling: Any = (),
    **values: Operand,
) -> Span:
    """What a function takes on that rises with all of its arguments, but falls with some.

    Parameters
    ----------
    function : callable
        Of numbers or arrays by keyword.
    falling : tuple of str
        Arguments with which it falls.
    **values
        The arguments.
    """
    low, high, is_one = {}, {}, True
    for name, value in values.items():
        span = Span.of(value)
        is_one &= span.low is span.high
        ends = (span.high, span.low) if name in falling else (span.low, span.high)
        low[name], high[name] = ends
    if is_one:
        one = function(**low)
        return Span(one, one)
    return Span(function(**low), function(**high))


def _never_negative(value: np.ndarray | float) -> bool:
    return value >= 0 if isinstance(value, float) else _all_from_zero(np.ravel(value))


def _positive(value: np.ndarray | float) -> bool:
    return value > 0 if isinstance(value, float) else _all_above_zero(np.ravel(value))


@njit(cache=True)
def _all_from_zero(values):
    found = True
    for value in values:
        found &= value >= 0
    return found


@njit(cache=True)
def _all_above_zero(values):
    found = True
    for value in values:
        found &= value > 0
    return found


def all_hold(conditions: np.ndarray | bool) -> bool:
    """Whether all of some conditions hold; of few, ten times as fast as ``np.all``."""
    return bool(np.count_nonzero(conditions) == np.size(conditions))


def any_holds(conditions: np.ndarray | bool) -> bool:
    """Whether any of some conditions holds; of few, ten times as fast as ``np.any``."""
    return bool(np.count_nonzero(conditions))


def _extremes(*values: np.ndarray | float) -> Span:
    low = high = values[0]
    for value in values[1:]:
        low, high = np.minimum(low, value), np.maximum(high, value)
    return Span(low, high)
