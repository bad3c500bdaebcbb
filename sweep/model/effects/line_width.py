"""Laser line width: the mean power of bins under a line that is not a pure tone.

Two models, both as the mean of |X|^2 over records, with the window's actual kernel.

**Gaussian** [T, section 3.2]: the power spectrum convolved with a Gaussian of the given FWHM, at
any delay. That is exactly the mean over records that each have one random normal frequency,
common to all beamlets: jitter slow against the record. The mean over the frequency is a sum over
equally spaced shifts, to a stated error: |X|^2 of a record of L samples has lags below L only,
and the trapezium rule misses a Gaussian's aliases alone.

**Lorentzian**: a laser whose phase is a random walk (FWHM dnu, Gamma = 2 pi dnu), mixed with
itself after a delay tau [Gallion and Debarge 1984; Richter et al. 1986]. The beat's factor
exp(i (theta(t - tau) - theta(t))) has the autocorrelation

    exp(-Gamma min(|T|, tau)) = exp(-Gamma tau) + [exp(-Gamma |T|) - exp(-Gamma tau)]_{|T| < tau}

a pure line with exp(-Gamma tau) of the power, and a pedestal with the rest, whose spectrum is

    S(f) = 2 Gamma / (Gamma^2 + w^2) [1 - e^{-Gamma tau} (cos w tau + Gamma / w sin w tau)]

w = 2 pi f, per Hz, two-sided about the line. A record shorter than the delay sees lags below its
own length only: there the record's length takes the delay's place in the split.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from sweep.model.effects.change import Change
from sweep.model.effects.phase_bounds import shape
from sweep.model.window import Window, samples

TOLERANCE = 1e-12
"""Error of a mean power from a sum over shifts, relative to the power at the line's peak."""

DEVIATION_OF_FWHM = 1 / math.sqrt(8 * math.log(2))
"""Standard deviation of a Gaussian over its full width at half maximum."""

_GONE = 40.0
"""Gamma T from where exp(-Gamma T) is nothing."""


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

    Notes
    -----
    19 shifts for lines narrow against a bin, 15 more for each bin of standard deviation. With
    step h the error is exp(-2 pi^2 s^2 (1/h - 1)^2) at the record's longest lag, by Poisson's
    summation formula; the Gaussian's tails are cut where they hold as much.
    """
    deviation = np.atleast_1d(DEVIATION_OF_FWHM * np.asarray(fwhm, float) * duration)
    room = math.sqrt(math.log(2 / TOLERANCE) / 2) / math.pi
    per_deviation = deviation + room  # s / h
    reach = math.sqrt(2 * math.log(1 / TOLERANCE))
    most = int(np.ceil(reach * per_deviation.max(initial=0.0)))
    place = np.arange(-most, most + 1) / per_deviation[:, None]
    weight = np.where(
        np.abs(place) <= reach + 1 / per_deviation[:, None], np.exp(-(place**2) / 2), 0.0
    )
    weight /= weight.sum(axis=1, keepdims=True)
    return Shifts(deviation[:, None] * place, weight)


def coherent_share(
    *, line_width: np.ndarray, delay: np.ndarray, duration: np.ndarray
) -> np.ndarray:
    """Share of the beat's power in the pure line, exp(-2 pi dnu tau), (n,), 0..1.

    Parameters
    ----------
    line_width : (n,) ndarray
        FWHM dnu of the laser's Lorentzian line [Hz].
    delay, duration : (n,) ndarray
        Echo delay tau [s]; length of the record [s], which counts where it is shorter.
    """
    return np.exp(-2 * np.pi * np.asarray(line_width) * np.minimum(delay, duration))


def pedestal_density(
    frequency: np.ndarray, *, line_width: np.ndarray, delay: np.ndarray
) -> np.ndarray:
    """S(f): power density of the pedestal [1/Hz] about a line of power 1, two-sided, >= 0.

    Parameters
    ----------
    frequency, line_width, delay : ndarray
        Distance from the line [Hz], dnu [Hz], tau [s]; they broadcast.
    """
    # The bracket is summed from small differences: written out, it would cancel.
    gamma = 2 * np.pi * np.asarray(line_width, float)
    omega = 2 * np.pi * np.asarray(frequency, float)
    g, angle = gamma * delay, omega * delay
    grown = -np.expm1(-g) - g * np.exp(-g)  # 1 - e^{-g} (1 + g)
    grown = np.where(g < 0.02, g * g * (1 / 2 - g * (1 / 3 - g * (1 / 8 - g / 30))), grown)
    cosine = 2 * np.sin(angle / 2) ** 2  # 1 - cos
    sine = np.where(np.abs(angle) < 1e-4, angle**2 / 6, 1 - np.sinc(angle / np.pi))
    bracket = grown + np.exp(-g) * (cosine + g * sine)
    square = gamma**2 + omega**2
    safe = np.where(square > 0, square, 1.0)
    return np.where(square > 0, 2 * gamma * bracket / safe, 0.0)


def pedestal_power(
    y: np.ndarray,
    *,
    line_width: np.ndarray,
    delay: np.ndarray,
    duration: np.ndarray,
    window: Window,
) -> np.ndarray:
    """Mean |X|^2 that the pedestal leaves in bins, over |C|^2 of its line, (n, m), >= 0.

    A line of weight C (|C| = a/2) has mean bin power |C|^2 times (coherent share x |W(y)|^2 +
    this). It adds as noise does: circular, and new in every record.

    Parameters
    ----------
    y : (n, m) ndarray
        Bins from their line [bins of fs/L].
    line_width, delay, duration : (n,) ndarray
        As of :func:`coherent_share`.
    window : Window
        The record's window.

    Notes
    -----
    sum_j r_j [e^{-Gamma T_j} - e^{-Gamma tau}] cos(2 pi y j / L), r the window's autocorrelation,
    is taken as the integral over the lag, by Gauss and Legendre's rule, and what its kinks at no
    lag and at the delay alias to, in closed form: within 2e-5 of the pedestal's largest for delays
    from 20 samples, 1 % for a delay of less than one sample.
    """
    length = window.length
    y = np.atleast_2d(y)
    y = y - length * np.rint(y / length)
    gamma, lag = _lag(line_width, delay, duration)
    reach = np.minimum(lag, _GONE / np.maximum(gamma, 1e-300))
    nodes = 96 + int(4 * np.abs(y).max(initial=0.0) * reach.max(initial=0.0))
    x, weight = _gauss_legendre(64 * (nodes // 64 + 1))
    time = reach[:, None] * (x + 1) / 2
    value = np.exp(-gamma[:, None] * time) * -np.expm1(-gamma[:, None] * (lag[:, None] - time))
    r = autocorrelation(window)
    value *= r(time * length) * length * reach[:, None] * weight
    # Jumps of the slope: r'(0) is the window's edge, the rest the bracket's.
    per_sample, left = gamma / length, np.exp(-gamma * lag)
    at_none = 2 * (r(0.0, 1) * (1 - left) - per_sample * r(0.0))
    at_delay = per_sample * left * r(lag * length)
    power = np.empty(y.shape)
    for i in range(y.shape[1]):
        turn = 2 * np.pi * y[:, i]
        power[:, i] = (value * np.cos(turn[:, None] * time)).sum(axis=1)
        power[:, i] -= at_none * _aliases(turn / length, np.zeros_like(lag))
        power[:, i] -= 2 * at_delay * _aliases(turn / length, lag * length)
    return power


@lru_cache(maxsize=32)
def _gauss_legendre(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    return np.polynomial.legendre.leggauss(nodes)


def _aliases(turn: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Sum over m != 0 of cos((k + 2 pi m) x) / (k + 2 pi m)^2, k rad a sample, x samples.

    With m = 0 the sum is the straight line between its values at whole x, for its second
    derivative is a comb; at no k it is B_2(x - floor(x)) / 2, B_2(x) = x^2 - x + 1/6.
    """
    below = np.floor(place)
    x = place - below
    plain = np.abs(turn) < 1e-4
    k = np.where(plain, 1.0, turn)
    line = (1 - x) * np.cos(k * below) + x * np.cos(k * (below + 1))
    found = line / (4 * np.sin(k / 2) ** 2) - np.cos(k * place) / k**2
    return np.where(plain, np.cos(turn * place) * (x * x - x + 1 / 6) / 2, found)


@lru_cache(maxsize=16)
def autocorrelation(window: Window) -> CubicSpline:
    """Sum_n w_n w_(n+j) as a function of the lag j, 0..L [samples]."""
    w = samples(window.name, window.length)
    spectrum = np.abs(np.fft.rfft(w, 2 * window.length)) ** 2
    r = np.fft.irfft(spectrum, 2 * window.length)[: window.length + 1]
    return CubicSpline(np.arange(window.length + 1), r)


def _lag(
    line_width: np.ndarray, delay: np.ndarray, duration: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gamma times the record's length, and the delay over that length, 1 at the most."""
    duration = np.asarray(duration, float)
    gamma = 2 * np.pi * np.asarray(line_width, float) * duration
    lag = np.minimum(np.asarray(delay, float) / duration, 1.0)
    gamma, lag = np.broadcast_arrays(np.atleast_1d(gamma), np.atleast_1d(lag))
    return gamma, lag


def gaussian_bound(
    *,
    fwhm: np.ndarray,
    duration: np.ndarray,
    window: Window,
    concentration: np.ndarray | None = None,
) -> Change:
    """What leaving a Gaussian line's width out can change of the largest bin's rms magnitude.

    The mean power under the line departs from |X|^2 by at most

        (2 pi s)^2 var_w (sum |w|)^2,   s the deviation and var_w the variance of the place in
        the record under |w|, in bins of fs/L and in records,

    and lies below the peak's; wide lines keep at least the Gaussian's density times the main
    lobe's area, and at most its peak density times the whole area (ENBW).

    Parameters
    ----------
    fwhm, duration : (n,) ndarray
        As of :func:`gaussian_shifts`.
    window, concentration
        As of :func:`sweep.model.effects.phase_bounds.phase_change`.
    """
    form = shape(window)
    deviation = np.atleast_1d(DEVIATION_OF_FWHM * np.asarray(fwhm, float) * duration)
    variance = float((form.x**2 * form.weight).sum()) / 4 / form.absolute
    missed = form.absolute**2 * np.minimum(1.0, (2 * np.pi * deviation) ** 2 * variance)
    if concentration is not None:
        share = missed / np.asarray(concentration) ** 2
        return Change(signal=(np.sqrt(np.maximum(1 - share, 0.0)), np.sqrt(1 + share)))
    floor = form.scalloped**2
    least, most = 1 - missed / floor, np.minimum(1 + missed / floor, form.top**2 / floor)
    safe = np.maximum(deviation, 1e-3)
    peak = 1 / (math.sqrt(2 * math.pi) * safe)
    for half in (0.5, 1.0):
        area = _lobe_area(window, half) / form.top**2
        least = np.maximum(least, peak * np.exp(-(((half + 0.5) / safe) ** 2) / 2) * area)
    whole = window.equivalent_noise_bandwidth * (1 + 1e-6)
    most = np.minimum(most, np.where(deviation > 1e-3, peak * whole / floor, np.inf))
    return Change(signal=(np.sqrt(np.minimum(least, 1.0)), np.sqrt(most)))


@lru_cache(maxsize=64)
def _lobe_area(window: Window, half: float) -> float:
    """Integral of |W|^2 over +-half bins, relative to (sum w)^2 [bins], rounded down."""
    y, weight = np.polynomial.legendre.leggauss(16)
    form = shape(window)
    values = np.cos(np.pi * np.outer(half * y, form.x)) @ form.signed
    return float((values**2 * weight).sum() * half) * (1 - 1e-3)


def lorentzian_bound(
    *,
    line_width: np.ndarray,
    delay: np.ndarray,
    duration: np.ndarray,
    window: Window,
    sample_rate: np.ndarray,
    cnr: np.ndarray | float = 0.0,
    concentration: np.ndarray | None = None,
) -> Change:
    """What leaving a Lorentzian laser's line width out can change: peak, and noise in the bins.

    The pure line keeps exp(-g) of its power, g = Gamma min(tau, T_w). The pedestal is nowhere
    negative, nowhere above what is missing from the line put onto a bin's centre, and in no bin
    above sum w^2 fs S(0): noise that comes with the signal, from line and image.

    Parameters
    ----------
    line_width, delay, duration : (n,) ndarray
        As of :func:`coherent_share`.
    window, concentration
        As of :func:`sweep.model.effects.phase_bounds.phase_change`.
    sample_rate : (n,) ndarray
        Sample rate [Hz].
    cnr : (n,) ndarray
        The beats' power sum a^2 / 2 over the noise variance, in the record; 0 leaves the
        pedestal's part as noise out.

    Returns
    -------
    Change
        ``signal`` holds for the pure line's magnitude and for the root of the mean bin power.
    """
    form = shape(window)
    gamma, lag = _lag(line_width, delay, duration)
    share = np.exp(-gamma * lag)
    least_bin = form.scalloped if concentration is None else np.asarray(concentration)
    most = share + (1 - share) * (form.top / least_bin) ** 2
    density = pedestal_density(
        np.array(0.0), line_width=line_width, delay=np.minimum(delay, duration)
    )
    return Change(
        signal=(np.sqrt(share), np.sqrt(most)),
        noise=(1.0, 1 + np.asarray(cnr) * sample_rate * density),
        threshold_follows=False,
    )
