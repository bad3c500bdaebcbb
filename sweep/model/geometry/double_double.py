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

    Parameters
    ----------
    a, b : ndarray
        Float64 numbers with abs(a) >= abs(b). The error is not exact otherwise.

    Returns
    -------
    DoubleDouble
        The rounded sum s = fl(a + b), and its error b - (s - a), after Dekker (module's
        References).
    """
    total = a + b
    return DoubleDouble(total, b - (total - a))


def _split_digits(a: np.ndarray) -> DoubleDouble:
    """Split float64 numbers into sums of two float64, each of half as many digits."""
    scaled = a * _SPLIT_FACTOR
    high = scaled - (scaled - a)
    return DoubleDouble(high, a - high)


def multiply(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the product of two double-doubles.

    Parameters
    ----------
    a, b : DoubleDouble
        Factors, which broadcast against each other.

    Returns
    -------
    DoubleDouble
        Product a b. The exact product of the high parts is that of Dekker (module's References).
        The product of the low parts is neglected.
    """
    high_product = a.high * b.high
    a_half, b_half = _split_digits(a.high), _split_digits(b.high)
    low_product = (
        (a_half.high * b_half.high - high_product)
        + a_half.high * b_half.low
        + a_half.low * b_half.high
    ) + a_half.low * b_half.low
    return quick_two_sum(high_product, low_product + (a.high * b.low + a.low * b.high))


def add(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the sum of two double-doubles, accurate even if the high parts cancel.

    Parameters
    ----------
    a, b : DoubleDouble
        Summands, which broadcast against each other.

    Returns
    -------
    DoubleDouble
        Sum a + b. High and low parts are each added without an error, after Knuth (module's
        References).
    """
    high_sum, low_sum = _two_sum(a.high, b.high), _two_sum(a.low, b.low)
    total = quick_two_sum(high_sum.high, high_sum.low + low_sum.high)
    return quick_two_sum(total.high, total.low + low_sum.low)


def subtract(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the difference of two double-doubles.

    Parameters
    ----------
    a, b : DoubleDouble
        Numbers, which broadcast against each other.

    Returns
    -------
    DoubleDouble
        Difference a - b, computed by :func:`add`.
    """
    return add(a, DoubleDouble(-b.high, -b.low))


def dot(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the scalar product of two vectors, or the product of a vector and a matrix.

    Parameters
    ----------
    a, b : DoubleDouble
        n vectors, (3, n) each. The product of a vector and a matrix takes a vector (3, 1, n) and a
        matrix (3, 3, n).

    Returns
    -------
    DoubleDouble
        sum_i a_i b_i over the first axis, (n,); or sum_i a_i b_ij of a matrix b, (3, n).
    """
    product = multiply(a, b)
    x, y, z = (DoubleDouble(high, low) for high, low in zip(product.high, product.low, strict=True))
    return add(add(x, y), z)


def cross(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the vector product of two vectors.

    Parameters
    ----------
    a, b : DoubleDouble (3, n)
        Components x, y, z of n vectors.

    Returns
    -------
    DoubleDouble (3, n)
        a x b = (a_y b_z - a_z b_y, a_z b_x - a_x b_z, a_x b_y - a_y b_x).
    """

    def permute(vector: DoubleDouble, axes: list[int]) -> DoubleDouble:
        """Return a vector with its components in another order.

        Parameters
        ----------
        vector : DoubleDouble (3, n)
            Components x, y, z of n vectors.
        axes : list of int
            Index of the component, 0..2 for x, y, z, that comes first, second and third.

        Returns
        -------
        DoubleDouble (3, n)
        """
        return DoubleDouble(vector.high[axes], vector.low[axes])

    yzx, zxy = [1, 2, 0], [2, 0, 1]
    return subtract(
        multiply(permute(a, yzx), permute(b, zxy)), multiply(permute(a, zxy), permute(b, yzx))
    )
