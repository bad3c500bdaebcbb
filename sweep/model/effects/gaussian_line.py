"""A Gaussian line: the shifts that stand for its width, and what that can change at most."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.model.effects.change import Change
from sweep.model.effects.phase_bounds import DEVIATION_OF_FWHM, Peak, one_line, shape
from sweep.model.effects.span import Operand, Span
from sweep.model.unsupported import UnsupportedShot
from sweep.model.window import Window

TOLERANCE = 1e-12
"""Error of a mean power from a sum over shifts, relative to the power at the line's peak."""

MOST_BINS = 500
"""Standard deviation of a Gaussian line [bins of fs/L] that shifts stand for."""


class Shifts(NamedTuple):
    """Frequencies over which |X|^2 is to be averaged."""

    offset: np.ndarray
    """(n, k): shifts of all lines [bins of fs/L]."""
    weight: np.ndarray
    """(n, k): weights of the powers, >= 0, sum 1."""


def gaussian_shifts(*, fwhm: np.ndarray, duration: np.ndarray) -> Shifts:
    """Shifts and weights whose weighted mean of |X|^2 is that under a Gaussian line.

    Parameters
    ----------
    fwhm : (n,) ndarray
        Full width at half maximum of the beat's line [Hz], >= 0.
    duration : (n,) ndarray
        Length of the record L/fs [s].

    Raises
    ------
    UnsupportedShot
        For a line of more than :data:`MOST_BINS` bins standard deviation.

    Notes
    -----
    One shift for no width, 19 for lines narrow against a bin, 15 more for each bin of standard
    deviation; weights of 0 fill rows with fewer than k. With
    step h the error is exp(-2 pi^2 s^2 (1/h - 1)^2) at the record's longest lag, by Poisson's
    summation formula; the Gaussian's tails are cut where they hold as much.
    """
    deviation = np.atleast_1d(DEVIATION_OF_FWHM * np.asarray(fwhm, float) * duration)
    if deviation.max(initial=0.0) > MOST_BINS:
        raise UnsupportedShot(
            f"instrument.laser.line_width makes a line of {deviation.max():.3g} bins standard "
            f"deviation, and {MOST_BINS} can be simulated: lower it, or shorten the record by "
            "instrument.processing.fft_size"
        )
    room = math.sqrt(math.log(2 / TOLERANCE) / 2) / math.pi
    per_deviation = deviation + room  # s / h
    reach = math.sqrt(2 * math.log(1 / TOLERANCE))
    most = int(np.ceil(reach * per_deviation.max(initial=0.0)))
    place = np.arange(-most, most + 1) / per_deviation[:, None]
    weight = np.where(
        np.abs(place) <= reach + 1 / per_deviation[:, None], np.exp(-(place**2) / 2), 0.0
    )
    weight[deviation == 0] = np.arange(-most, most + 1) == 0
    # One after the other, so that zeros beside them, and thus other rows, change no bit.
    weight /= np.cumsum(weight, axis=1)[:, -1:]
    return Shifts(deviation[:, None] * place, weight)


def gaussian_bound(
    *, fwhm: Operand, duration: Operand, window: Window, peak: Peak | None = None
) -> Change:
    """What leaving a Gaussian line's width out can change of the largest bin's rms magnitude.

    The mean power under the line departs from |X|^2 by at most

        (2 pi s)^2 var_w (sum |w|)^2,   s the deviation and var_w the variance of the place in
        the record under |w|, in bins of fs/L and in records,

    and lies below the peak's; wide single lines keep at least the Gaussian's density times the
    main lobe's area, and at most its peak density times the whole area (ENBW).

    Parameters
    ----------
    fwhm, duration : Span or array_like
        As of :func:`gaussian_shifts`.
    window, peak
        As of :func:`sweep.model.effects.phase_bounds.phase_change`.
    """
    form, peak = shape(window), peak or one_line(window)
    deviation = DEVIATION_OF_FWHM * Span.of(fwhm) * duration
    variance = float((form.x**2 * form.weight).sum()) / 4 / form.absolute
    spread = (2 * np.pi * np.asarray(deviation.high)) ** 2 * variance
    missed = form.absolute**2 * np.minimum(1.0, spread)
    floor, ceiling = np.asarray(peak.least) ** 2, np.asarray(peak.most) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        least, most = 1 - missed / floor, np.minimum(1 + missed / floor, ceiling / floor)
        if peak.single:
            narrow, wide = (
                _density(np.asarray(v), window) for v in (deviation.low, deviation.high)
            )
            least = np.fmax(least, np.minimum(narrow, wide) / ceiling)
            whole = window.equivalent_noise_bandwidth * (1 + 1e-6) / math.sqrt(2 * math.pi)
            most = np.fmin(most, whole / np.asarray(deviation.low) / floor)
    least, most = np.where(np.isnan(least), 0.0, least), np.where(np.isnan(most), np.inf, most)
    return Change(signal=(np.sqrt(np.clip(least, 0.0, 1.0)), np.sqrt(np.maximum(most, 1.0))))


def _density(deviation: np.ndarray, window: Window) -> np.ndarray:
    """Least mean power of the largest bin of a wide line: it rises with the deviation and falls."""
    safe = np.maximum(deviation, 1e-3)
    peak, least = 1 / (math.sqrt(2 * math.pi) * safe), np.zeros_like(safe)
    for half in (0.5, 1.0):
        tail = np.exp(-(((half + 0.5) / safe) ** 2) / 2)
        least = np.maximum(least, peak * tail * _lobe_area(window, half))
    return least


@lru_cache(maxsize=64)
def _lobe_area(window: Window, half: float) -> float:
    """Integral of |W|^2 over +-half bins, relative to (sum w)^2 [bins], rounded down."""
    y, weight = np.polynomial.legendre.leggauss(16)
    form = shape(window)
    values = (np.cos(np.pi * np.outer(half * y, form.x)) * form.signed).sum(axis=1)
    return float((values**2 * weight).sum() * half) * (1 - 1e-3)
