"""Random ground: fractal relief and smooth hills, exact in their statistics.

Both are Gaussian fields on a grid, drawn by circulant embedding: the covariance is laid on a torus
at least twice as large, where the FFT diagonalises it, and only a corner of the torus is kept, so
that opposite edges of the ground have nothing to do with each other.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import fft

_NEGLIGIBLE = 1e-6
"""Share of the variance that may be missing where rounding makes a spectrum negative."""

_AT_ONCE = 1 << 20
"""Nodes whose covariance is worked out at a time."""


def fractal(
    generator: np.random.Generator,
    *,
    shape: tuple[int, int],
    spacing: tuple[float, float],
    hurst: float,
    rms_slope: float,
    baseline: float,
) -> np.ndarray:
    """Self-affine relief: a fractional Brownian surface, (rows, columns) [m].

    The difference of height of any two nodes, a distance L apart in any direction, is normal with
    the standard deviation ``rms_slope * baseline * (L / baseline)**hurst``: the deviogram by which
    planetary roughness is measured (Shepard et al., J. Geophys. Res. 106, 32777, 2001). It has no
    smallest and no largest scale within the grid. Drawn by Stein's exact method (J. Comput. Graph.
    Stat. 11, 587, 2002): a stationary field whose covariance differs from the fractal's by a
    paraboloid only, plus the random plane that makes up for it.

    Parameters
    ----------
    generator : numpy.random.Generator
        Source of randomness; the same state gives the same ground.
    shape : (rows, columns) of int
        Nodes.
    spacing : (dx, dy) of float
        Grid steps [m]; signs are ignored.
    hurst : float
        Hurst exponent, 0 < . < 1: 0.5 is a random walk, towards 1 is smooth. Lunar ground has a
        median near 0.95 in the highlands and 0.76 in the maria over 57 m to 2.7 km
        (Rosenburg et al., J. Geophys. Res. 116, E02001, 2011).
    rms_slope : float
        Standard deviation of height differences over `baseline`, divided by it; >= 0.
    baseline : float
        Distance at which that slope is stated [m], > 0.

    Returns
    -------
    ndarray
        Heights, 0 at the first node.

    Raises
    ------
    ValueError
        For parameters outside their ranges.
    """
    if not (0 < hurst < 1 and rms_slope >= 0 and baseline > 0):
        raise ValueError("relief needs 0 < Hurst exponent < 1, a slope >= 0 and a baseline > 0")
    steps = abs(spacing[1]), abs(spacing[0])
    span = math.hypot(*((n - 1) * step for n, step in zip(shape, steps, strict=True)))
    # In units of the grid's diagonal, the longest distance that must be right is 1.
    period, parabola, covariance = _stein(2 * hurst)
    unit = [step / span for step in steps]
    stationary = _field(generator, shape, unit, covariance, period)
    tilt = generator.standard_normal(2) * math.sqrt(2 * parabola)
    rows, columns = (np.arange(n) * step for n, step in zip(shape, unit, strict=True))
    z = stationary + (tilt[0] * rows)[:, None] + tilt[1] * columns
    # The field's differences have the variance 2 r^(2H); the wanted one is per baseline.
    scale = rms_slope * baseline * (span / baseline) ** hurst / math.sqrt(2)
    return np.asarray((z - z[0, 0]) * scale)


def _stein(alpha: float):  # type: ignore[no-untyped-def]  # returns a function with the constants
    """Torus period, coefficient of the paraboloid and the covariance on the torus."""
    if alpha <= 1.5:
        reach, far, parabola = 1.0, 0.0, alpha / 2
        constant = 1 - alpha / 2
    else:
        reach = 2.0
        far = alpha * (2 - alpha) / (3 * reach * (reach**2 - 1))
        parabola = (alpha - far * (reach - 1) ** 2 * (reach + 2)) / 2
        constant = far * (reach - 1) ** 3 + 1 - parabola

    def covariance(r: np.ndarray) -> np.ndarray:
        near = constant - r**alpha + parabola * r**2
        beyond = far * np.maximum(reach - r, 0.0) ** 3 / np.maximum(r, 1.0)
        return np.where(r <= 1, near, beyond)

    return 2 * reach, parabola, covariance


def hills(
    generator: np.random.Generator,
    *,
    shape: tuple[int, int],
    spacing: tuple[float, float],
    rms_height: float,
    correlation_length: float,
) -> np.ndarray:
    """Smooth rolling ground with a Gaussian covariance, (rows, columns) [m].

    The covariance of two nodes L apart is ``rms_height**2 * exp(-(L / correlation_length)**2)``,
    and the slope along each axis has the standard deviation
    ``sqrt(2) * rms_height / correlation_length``.

    Parameters
    ----------
    generator, shape, spacing
        As of `fractal`; steps finer than a third of the correlation length.
    rms_height : float
        Standard deviation of the height [m], >= 0.
    correlation_length : float
        Distance at which the correlation has fallen to 1/e [m], > 0.

    Raises
    ------
    ValueError
        For parameters outside their ranges.
    """
    steps = abs(spacing[1]), abs(spacing[0])
    if not (rms_height >= 0 and correlation_length > 3 * max(steps)):
        raise ValueError("hills need a height >= 0 and a correlation length over three grid steps")
    unit = [step / correlation_length for step in steps]
    # Beyond 6 correlation lengths the covariance is 2e-16: the two ends of the torus are apart.
    longest = max((n - 1) * step for n, step in zip(shape, unit, strict=True))
    field = _field(generator, shape, unit, lambda r: np.exp(-(r**2)), longest + 6.0)
    return np.asarray(field * rms_height)


def _field(generator, shape, steps, covariance, period):  # type: ignore[no-untyped-def]
    """Stationary Gaussian field of an isotropic covariance, a function of distance.

    `shape` and `steps` have rows first; the torus is at least `period` a side, in their unit.
    """
    size = [fft.next_fast_len(math.ceil(period / step), real=True) for step in steps]
    if math.prod(size) > 2e8:
        raise ValueError(f"relief on {shape} nodes needs a torus of {size}; use a coarser grid")
    squares = [
        (np.minimum(np.arange(n), n - np.arange(n)) * step) ** 2
        for n, step in zip(size, steps, strict=True)
    ]
    covariances = np.empty(size)  # a torus may be large; what makes it need not be
    rows = max(_AT_ONCE // size[1], 1)
    for part in (slice(first, first + rows) for first in range(0, size[0], rows)):
        covariances[part] = covariance(np.sqrt(squares[0][part, None] + squares[1]))
    power = fft.rfft2(covariances, overwrite_x=True).real.copy()
    del covariances
    negative = -power[power < 0].sum() / power[power > 0].sum()
    if negative > _NEGLIGIBLE:
        raise ArithmeticError(f"{negative:.1e} of the relief's variance is negative on this grid")
    noise = fft.rfft2(generator.standard_normal(size), overwrite_x=True)
    noise *= np.sqrt(np.maximum(power, 0.0, out=power), out=power)
    return fft.irfft2(noise, s=size, overwrite_x=True)[: shape[0], : shape[1]]
