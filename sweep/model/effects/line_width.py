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

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.footprint import by_power
from sweep.model.effects.gaussian_line import DEVIATION_OF_FWHM
from sweep.model.effects.phase_sizes import added, means
from sweep.model.effects.points import Points, Smear
from sweep.model.preparation import Shots
from sweep.model.window import Window, samples

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

_GONE = 40.0
"""Gamma T from where exp(-Gamma T) is nothing."""

_FEW_LAGS = 0.1
"""Gamma over the sample rate from where lags are taken one by one: 400 of them, then none."""

_SIGMAS = 6.0
"""Standard deviations of a Gaussian line beyond which there is no light to speak of."""

_MOST_NOISE = 1.7932821329
"""Gamma tau at which the pedestal's density under its line is largest: e^g = 1 + g + g^2."""


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
    is taken as it stands where few lags are left of it; else as the integral over the lag, by Gauss
    and Legendre's rule, and what its kinks at no lag and at the delay alias to, in closed form:
    within 2e-5 of the pedestal's largest for delays from 20 samples, 1 % for a delay of less than
    one sample.
    """
    y = np.atleast_2d(y)
    y = y - window.length * np.rint(y / window.length)
    gamma, lag = (np.broadcast_to(a, len(y)) for a in _lag(line_width, delay, duration))
    power, few = np.empty(y.shape), gamma > _FEW_LAGS * window.length
    for rows, taken in ((few, _by_lags), (~few, _by_integral)):
        if rows.any():
            power[rows] = taken(y[rows], gamma[rows], lag[rows], window)
    return power


def _by_lags(y: np.ndarray, gamma: np.ndarray, lag: np.ndarray, window: Window) -> np.ndarray:
    """The sum over the lags that are left, the first one by one."""
    j = np.arange(min(int(_GONE / _FEW_LAGS), window.length))
    gone = (gamma / window.length)[:, None] * j
    left = np.maximum((gamma * lag)[:, None] - gone, 0.0)
    value = np.exp(-gone) * -np.expm1(-left) * autocorrelation(window)(j)
    value[:, 1:] *= 2
    turns = 2 * np.pi / window.length * y[:, :, None] * j
    return np.asarray((value[:, None] * np.cos(turns)).sum(axis=-1))


def _by_integral(y: np.ndarray, gamma: np.ndarray, lag: np.ndarray, window: Window) -> np.ndarray:
    """The integral over the lag, and what its kinks alias to."""
    length = window.length
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
def autocorrelation(window: Window) -> "CubicSpline":
    """Sum_n w_n w_(n+j) as a function of the lag j, 0..L [samples]."""
    from scipy.interpolate import CubicSpline  # slow to import

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


_WIDTH, _SHAPE = "instrument.laser.line_width", "instrument.laser.line_shape"


def _deviation(points: Points) -> np.ndarray:
    """Standard deviation of a Gaussian line [bins of fs/L]."""
    return DEVIATION_OF_FWHM * points[_WIDTH] * points.record_duration


def smear(points: Points) -> Smear | None:
    """How far a Gaussian line puts light."""
    if not points.has(_WIDTH) or points.word(_SHAPE) != "gaussian":
        return None
    return Smear(reach=_SIGMAS * _deviation(points))


def size(points: Points) -> Size | None:
    """What leaving the width out changes of the detecting bins.

    The mean power under a Gaussian line departs from |X|^2 by at most (2 pi s)^2 var_w (sum |w|)^2,
    s the deviation and var_w the variance of the place in the record under |w|. A Lorentzian one's
    pure line keeps exp(-g) of its power, g = Gamma min(tau, T_w); the pedestal is in no bin above
    sum w^2 (fs S(0) + 1 - exp(-g)), and is noise that comes with the signal.
    """
    if not points.has(_WIDTH):
        return None
    if points.word(_SHAPE) == "lorentzian":
        return _lorentzian(points)
    known, deviation = means(points.window), _deviation(points)
    spread = np.minimum((2 * np.pi * deviation) ** 2 * known.variance, 1.0)
    smeared = 1 + 2 * points.smeared / points.margin
    least = points.powers[0] / np.where(points.near_image, 2.0, 1.01) / smeared
    magnitude = by_power(known.most**2 * spread / least)
    if not points.may_add:
        return Size(magnitude=magnitude)
    half = 0.5 * _SIGMAS * deviation
    away = added(points, Smear((half, 0.0, 0.0, 0.0), constant=half))
    return Size(magnitude=np.where(points.may_cancel, 0.0, magnitude), added=away)


def _lorentzian(points: Points) -> Size:
    width, delay = points[_WIDTH], np.minimum(points.delay, points.record_duration)
    share = coherent_share(line_width=width, delay=delay, duration=np.asarray(np.inf))
    most = np.minimum(width, _MOST_NOISE / (2 * np.pi * delay))
    density = pedestal_density(np.array(0.0), line_width=most, delay=delay)
    ratio = points.footprint.echo_ratio
    beat = points.beat * (ratio if points.architecture == "direct" else np.sqrt(ratio))
    cnr = beat**2 / points.noise_variance  # with its image
    return Size(
        magnitude=1 - np.sqrt(share),
        noise=cnr * (points.sample_rate * density + (1 - share)),
        threshold_follows=False,
    )


def act(shots: Shots, scene: Scene) -> Shots:
    """A Gaussian line of the beat; or a pure line, dimmed, over a pedestal of noise.

    The pedestal is taken at its height under the lines.
    """
    width = np.asarray(scene.parameters[_WIDTH], float)
    if str(scene.parameters[_SHAPE]) == "gaussian":
        return replace(shots, gaussian_width=width + np.zeros(shots.size))
    delay = 2 * shots.range / SPEED_OF_LIGHT
    timing = {
        "line_width": width + np.zeros(shots.size),
        "delay": delay,
        "duration": shots.record_duration,
    }
    below = pedestal_power(np.zeros((shots.size, 1)), window=shots.window, **timing)[:, 0]
    power = (shots.beat_scale / 2) ** 2 * shots.relative_echo
    return replace(
        shots,
        beat_scale=shots.beat_scale * np.sqrt(coherent_share(**timing)),
        pedestal=power * below / shots.window.energy,
    )


EFFECT = Effect(
    name="line_width",
    about="width of the laser's line",
    stage="record",
    size=size,
    smear=smear,
    act=act,
    parameters=(
        Parameter(
            path=_WIDTH,
            about="Full width at half maximum of the laser's line; Gaussian: of the beat's",
            si_unit="Hz",
            default=0.0,
            example="10 kHz",
            at_least="0 Hz",
            at_most="1e15 Hz",
        ),
        Parameter(
            path=_SHAPE,
            about="Gaussian, slow against the record; or the Lorentzian of a laser mixed with "
            "itself after the echo's delay",
            default="gaussian",
            options=("gaussian", "lorentzian"),
        ),
    ),
)
