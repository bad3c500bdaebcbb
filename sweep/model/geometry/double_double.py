"""Double-double arithmetic: numbers as unevaluated sums of two float64, with twice the digits.

Sums and products of two float64 have rounding errors that are float64 numbers themselves. The
algorithms of Dekker [1]_ and Knuth [2]_ compute these errors exactly, so they can be carried along.
All functions broadcast. The components of a vector are along the first axis.

References
----------
.. [1] Dekker, Numer. Math. 18, 1971, 224.
.. [2] Knuth, The Art of Computer Programming, vol. 2, sec. 4.2.2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_SPLIT_FACTOR = 2.0**27 + 1
"""Factor in Veltkamp's method, which splits a float64 into two numbers of half as many digits each.
"""


class DoubleDouble(NamedTuple):
    """Numbers with twice the digits of float64, each stored as the sum of two float64."""

    high: np.ndarray
    """The numbers, each rounded to the nearest float64."""
    low: np.ndarray
    """The numbers minus their rounded values ``high``, as float64."""

    @classmethod
    def from_float64(cls, values: np.ndarray) -> DoubleDouble:
        """Return float64 numbers as double-doubles, whose low part is 0."""
        return cls(values, np.zeros_like(values))


def _two_sum(a: np.ndarray, b: np.ndarray) -> DoubleDouble:
    """Return the rounded sum of two float64 numbers, and its exact rounding error."""
    total = a + b
    virtual_b = total - a
    return DoubleDouble(total, (a - (total - virtual_b)) + (b - virtual_b))


def quick_two_sum(a: np.ndarray, b: np.ndarray) -> DoubleDouble:
    """Return the rounded sum of float64 numbers and its exact rounding error.

    The result is valid only if abs(a) >= abs(b).
    """
    total = a + b
    return DoubleDouble(total, b - (total - a))


def _split_digits(a: np.ndarray) -> DoubleDouble:
    """Split float64 numbers into sums of two float64, each of half as many digits."""
    scaled = a * _SPLIT_FACTOR
    high = scaled - (scaled - a)
    return DoubleDouble(high, a - high)


def multiply(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the product of two double-doubles."""
    high_product = a.high * b.high
    a_half, b_half = _split_digits(a.high), _split_digits(b.high)
    low_product = (
        (a_half.high * b_half.high - high_product)
        + a_half.high * b_half.low
        + a_half.low * b_half.high
    ) + a_half.low * b_half.low
    return quick_two_sum(high_product, low_product + (a.high * b.low + a.low * b.high))


def add(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the sum of two double-doubles, accurate even if the high parts cancel."""
    high_sum, low_sum = _two_sum(a.high, b.high), _two_sum(a.low, b.low)
    total = quick_two_sum(high_sum.high, high_sum.low + low_sum.high)
    return quick_two_sum(total.high, total.low + low_sum.low)


def subtract(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the difference a - b of two double-doubles."""
    return add(a, DoubleDouble(-b.high, -b.low))


def dot(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the scalar product of two vectors (3, n).

    A vector (3, 1, n) times a matrix (3, 3, n) gives a vector (3, n).
    """
    product = multiply(a, b)
    x, y, z = (DoubleDouble(high, low) for high, low in zip(product.high, product.low, strict=True))
    return add(add(x, y), z)


def cross(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the vector product of two vectors (3, n)."""

    def permute(vector: DoubleDouble, axes: list[int]) -> DoubleDouble:
        """Return the vector with its components in the order of ``axes``."""
        return DoubleDouble(vector.high[axes], vector.low[axes])

    yzx, zxy = [1, 2, 0], [2, 0, 1]
    return subtract(
        multiply(permute(a, yzx), permute(b, zxy)), multiply(permute(a, zxy), permute(b, yzx))
    )
