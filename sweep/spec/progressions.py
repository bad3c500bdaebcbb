"""Regular values along an axis, exact until the one rounding of each.

A value that a generator makes so is the float that the same value written out gives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from sweep.units import Unit


@dataclass(frozen=True)
class Progression:
    """The regular values ``start + increment * i`` for ``i = 0 .. number - 1``, exactly."""

    start: Fraction
    increment: Fraction = Fraction(0)
    number: int = 1

    def mapped(self, factor: Fraction, offset: Fraction) -> Progression:
        """The progression of ``factor * value + offset``."""
        return Progression(self.start * factor + offset, self.increment * factor, self.number)

    def values(self) -> np.ndarray:
        """Floats (number,), each the nearest to its exact value.

        Both terms are whole multiples of their greatest common divisor, so that the values are
        whole numbers times one exact ratio, which a two-part product rounds once.
        """
        common = _common_divisor(self.start, self.increment)
        first, step = int(self.start / common), int(self.increment / common)
        if max(abs(first), abs(first + step * (self.number - 1))) < 2**53:
            multiples = np.arange(self.number, dtype=np.int64) * step + first
            return times(multiples.astype(np.float64), common)
        start, increment = float(self.start), float(self.increment)
        return start + increment * np.arange(self.number, dtype=np.float64)


def _common_divisor(a: Fraction, b: Fraction) -> Fraction:
    """Largest fraction of which both are whole multiples; 1 for two zeros."""
    divisor = math.gcd(a.numerator * b.denominator, b.numerator * a.denominator)
    return Fraction(divisor, a.denominator * b.denominator) if divisor else Fraction(1)


def times(values: np.ndarray, ratio: Fraction) -> np.ndarray:
    """Product of floats (n,) with an exact ratio, rounded once (Dekker's two-part product)."""
    if ratio.numerator == 1 and ratio.denominator < 2**53:
        return values / ratio.denominator
    high = float(ratio)
    low = float(ratio - Fraction(high))
    product = values * high
    if low == 0.0 or abs(high) > 1e200 or not np.all(np.abs(values) < 1e100):
        return product
    splitter = 134217729.0  # 2**27 + 1 halves a 53-bit significand
    a = values * splitter
    a_high = a - (a - values)
    a_low = values - a_high
    b_high = high * splitter - (high * splitter - high)
    b_low = high - b_high
    error = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
    return product + (error + values * low)


def rounded(values: np.ndarray) -> np.ndarray:
    """Values (n,) to 15 significant digits.

    Powers and logarithms may differ in the last bit from one machine to the next; 15 digits are
    the same everywhere.
    """
    magnitude = np.abs(values)
    np.floor(np.log10(magnitude, where=magnitude > 0, out=np.zeros(values.shape)), out=magnitude)
    exponent = 14 - magnitude.astype(np.int64)
    inside = np.abs(exponent) <= 22  # powers of ten that are exact floats
    scale = 10.0 ** np.where(inside, np.abs(exponent), 0)
    up, down = np.rint(values * scale) / scale, np.rint(values / scale) * scale
    return np.where(inside, np.where(exponent >= 0, up, down), values)


def si_values(progression: Progression, unit: Unit) -> np.ndarray:
    """SI values (n,) of a progression in the given unit."""
    if unit.decibel:
        return np.array([unit.to_si(Fraction(x)) for x in progression.values().tolist()])
    return progression.mapped(unit.factor, unit.offset).values()


def values_in(unit: Unit, si: np.ndarray) -> np.ndarray:
    """SI values (n,) in the given unit, to 15 significant digits."""
    if unit.decibel:
        return rounded(10.0 * np.log10(si))
    return rounded(times(si - float(unit.offset) if unit.offset else si, 1 / unit.factor))
