"""What the width of a Gaussian line can change at most of the bin that detects it."""

import math
from functools import lru_cache

import numpy as np

from sweep.model.effects.change import Change
from sweep.model.effects.phase_bounds import DEVIATION_OF_FWHM, Peak, one_line, shape
from sweep.model.effects.span import Operand, Span
from sweep.model.window import Window


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
        As of :func:`sweep.model.effects.line_width.gaussian_shifts`.
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
