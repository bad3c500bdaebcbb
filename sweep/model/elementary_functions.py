"""Compiled elementary functions that kernels share: exact products, and phases in cycles.

Phases are counted in cycles and reduced to a fraction of a cycle before any sine is taken. An
optical phase of 1e10 cycles keeps its fraction only if the product that makes the phase is carried
in two doubles.
"""

import math

from sweep.kernel_cache import njit

_TWO_PI = 2.0 * math.pi
# Taylor coefficients of sin(2 pi r) / r, and of cos(2 pi r), in powers of r^2. For |r| <= 1/8 the
# truncation error is 5e-17.
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7 = (
    (-1) ** i * _TWO_PI ** (2 * i + 1) / math.factorial(2 * i + 1) for i in range(8)
)
_C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8 = (
    (-1) ** i * _TWO_PI ** (2 * i) / math.factorial(2 * i) for i in range(1, 9)
)


@njit(inline="always")
def exact_product(a, b):
    """Return the exact product a * b as the sum of two doubles.

    Parameters
    ----------
    a, b : float
        Factors, |a|, |b| < 1e300.

    Returns
    -------
    high, low : float
        Rounded product, and its rounding error.

    Notes
    -----
    Each factor is split into halves by 2^27 + 1 (Veltkamp), and the products of halves are exact
    (Dekker).
    """
    high = a * b
    scaled = 134217729.0 * a  # 2^27 + 1, Veltkamp's constant
    a_high = scaled - (scaled - a)
    a_low = a - a_high
    scaled = 134217729.0 * b
    b_high = scaled - (scaled - b)
    b_low = b - b_high
    return high, ((a_high * b_high - high) + a_high * b_low + a_low * b_high) + a_low * b_low


@njit(inline="always")
def fraction_of_cycle(x):
    """Return the phase ``x`` [cycles] minus its nearest integer, in [-1/2, 1/2]."""
    return x - math.floor(x + 0.5)


@njit(inline="always")
def product_cycle_fraction(high, low, x):
    """Return the product (high + low) * x [cycles] minus its nearest integer, in [-1/2, 1/2].

    Parameters
    ----------
    high, low : float
        First factor as the sum of two doubles, such as the result of :func:`exact_product`.
    x : float
        Second factor.

    Returns
    -------
    float
        Fraction of a cycle, with an error of about 1e-16 for products up to 1e15 cycles.

    Notes
    -----
    The rounding error of high * x is recovered exactly. Only the product low * x is rounded, which
    is 1e-32 of the number of cycles.
    """
    product, remainder = exact_product(high, x)
    remainder += low * x
    return fraction_of_cycle(fraction_of_cycle(product) + remainder)


@njit(inline="always")
def double_double_quotient(numerator, denominator):
    """Return the quotient of two doubles as the sum of two doubles.

    Parameters
    ----------
    numerator, denominator : float
        Dividend and divisor; the divisor is not 0. The divisor and the quotient are below 1e300 in
        modulus.

    Returns
    -------
    high, low : float
        Quotient rounded to a double, and the rounding error, itself a double.
    """
    high = numerator / denominator
    product, remainder = exact_product(high, denominator)
    return high, ((numerator - product) - remainder) / denominator


@njit(inline="always")
def sincos_cycles(x):
    """Return sin(2 pi x) and cos(2 pi x). The code has no branches, so that loops vectorise.

    Parameters
    ----------
    x : float
        Phase [cycles], |x| up to about 1e8.

    Returns
    -------
    sine, cosine : float
        Values with an absolute error below 3e-16, for the given `x`.
    """
    r = x - math.floor(x + 0.5)
    quadrant = math.floor(4.0 * r + 0.5)
    r -= 0.25 * quadrant
    z = r * r
    s = r * (_S0 + z * (_S1 + z * (_S2 + z * (_S3 + z * (_S4 + z * (_S5 + z * (_S6 + z * _S7)))))))
    c = 1.0 + z * (
        _C1 + z * (_C2 + z * (_C3 + z * (_C4 + z * (_C5 + z * (_C6 + z * (_C7 + z * _C8))))))
    )
    odd = (quadrant == 1.0) or (quadrant == -1.0)
    sine = c if odd else s
    cosine = s if odd else c
    sine = -sine if (quadrant == -1.0 or quadrant == 2.0 or quadrant == -2.0) else sine
    cosine = -cosine if (quadrant == 1.0 or quadrant == 2.0 or quadrant == -2.0) else cosine
    return sine, cosine
