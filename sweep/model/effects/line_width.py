"""Laser line width: the mean power of bins under a line that is not a pure tone.

Two models, both as the mean of |X|^2 over records, with the window's actual kernel.

**Gaussian** [T, section 3.2]: the power spectrum convolved with a Gaussian of the given FWHM, at
any delay. This is exactly the mean over records that each have one random normal frequency, common
to all beamlets: jitter slow against the record. The mean over the frequency is a sum over equally
spaced shifts, to a stated error. |X|^2 of a record of L samples has lags below L only. The
trapezium rule misses a Gaussian's aliases alone.

**Lorentzian**: a laser whose phase is a random walk (FWHM dnu, Gamma = 2 pi dnu), mixed with
itself after a delay tau [Gallion and Debarge 1984; Richter et al. 1986]. The beat's factor
exp(i (theta(t - tau) - theta(t))) has the autocorrelation

    exp(-Gamma min(|T|, tau)) = exp(-Gamma tau) + [exp(-Gamma |T|) - exp(-Gamma tau)]_{|T| < tau}

a pure line with exp(-Gamma tau) of the power, and a pedestal with the rest, which is taken at its
height under the line. A record shorter than the delay sees lags below its
own length only: there the record's length takes the delay's place in the split.

|X| does not tell a phase that the whole record has, and of what turns with it little at all: of the
phase, less its mean under the window, the mean of exp(i phi) is the line that |X| sees, and only
the part of the pedestal in phase with that changes |X| (:func:`seen_line`). Both are drawn as they
are where whole spectra are (:func:`walked_phase`). An echo that arrives within the record has the
line and the pedestal of the samples that it has, told to a 32nd of the record.
"""

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.phase_errors import added, means
from sweep.model.effects.points import Points, Smear, by_power
from sweep.model.preparation import LASER, Shots, energy_left
from sweep.model.unsupported import UnsupportedShot
from sweep.model.window import Window, last_part, samples

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

DEVIATION_OF_FWHM = 1 / math.sqrt(8 * math.log(2))
"""Standard deviation of a Gaussian over its full width at half maximum."""

TOLERANCE = 1e-12
"""Error of a mean power from a sum over shifts, relative to the power at the line's peak."""

MOST_BINS = 500
"""Standard deviation of a Gaussian line [bins of fs/L] that shifts stand for."""


_gauss_legendre = lru_cache(maxsize=1)(np.polynomial.legendre.leggauss)

_GONE = 40.0
"""Gamma T from where exp(-Gamma T) is nothing."""

_FEW_LAGS = 0.1
"""Gamma over the sample rate from where lags are taken one by one: 400 of them, then none."""

_SIGMAS = 6.0
"""Standard deviations of a Gaussian line beyond which there is no light to speak of."""

_PLACES = 256
"""Places of the record at which the mean phase is taken off."""

_LEAST = 1e-100
"""Share of a line's power that is none, and by which it can be divided."""

_MOST_NOISE = 1.7932821329
"""Gamma tau at which the pedestal's density under its line is largest: e^g = 1 + g + g^2."""


class Shifts(NamedTuple):
    """Frequencies over which |X|^2 is averaged."""

    offset: np.ndarray
    """(n, k): shifts of all lines [bins of fs/L]."""
    weight: np.ndarray
    """(n, k): weights of the powers, >= 0, sum 1."""


def gaussian_shifts(*, fwhm: np.ndarray, duration: np.ndarray) -> Shifts:
    """Shifts and weights whose weighted mean of |X|^2 is that under a Gaussian line.

    The FWHM is that of the beat's line [Hz], the duration that of the record [s], (n,) each. One
    shift for no width, 19 for lines narrow against a bin, 15 more for each bin of standard
    deviation; weights of 0 fill rows with fewer than k. With step h the error is exp(-2 pi^2 s^2
    (1/h - 1)^2) at the record's longest lag, by Poisson's summation formula; the Gaussian's tails
    are cut where they hold as much. An UnsupportedShot for more than :data:`MOST_BINS` bins of
    standard deviation.
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


def coherent_share(
    *, line_width: np.ndarray, delay: np.ndarray, duration: np.ndarray
) -> np.ndarray:
    """Share of the beat's power in the pure line, exp(-2 pi dnu tau), (n,), 0..1.

    By the FWHM dnu of the laser's Lorentzian line [Hz], the echo's delay tau [s], and the length of
    the record [s], which counts where it is shorter.
    """
    return np.exp(-2 * np.pi * np.asarray(line_width) * np.minimum(delay, duration))


def density_under_line(*, line_width: np.ndarray, delay: np.ndarray) -> np.ndarray:
    """Power density of the pedestal under a line of power 1, 2 (1 - e^-g (1 + g)) / Gamma [1/Hz].

    dnu [Hz], > 0, and tau [s]; g = Gamma tau.
    """
    gamma = 2 * np.pi * np.asarray(line_width, float)
    g = gamma * delay
    grown = -np.expm1(-g) - g * np.exp(-g)
    # the bracket would cancel for small g
    grown = np.where(g < 0.02, g * g * (1 / 2 - g * (1 / 3 - g * (1 / 8 - g / 30))), grown)
    return np.where(gamma > 0, 2 * gamma * grown / np.where(gamma > 0, gamma**2, 1.0), 0.0)


def power_under_line(
    *, line_width: np.ndarray, delay: np.ndarray, duration: np.ndarray, window: Window
) -> np.ndarray:
    """Mean |X|^2 that the pedestal leaves in its line's bin, over |C|^2 of the line, (n,), >= 0.

    A line of weight C (|C| = a/2) has mean bin power |C|^2 times (coherent share x |W(0)|^2 +
    this). It adds as noise does: circular, and new in every record. Arguments as of
    :func:`coherent_share`.

    sum_j r_j [e^{-Gamma T_j} - e^{-Gamma tau}], r the window's autocorrelation, is taken as it
    stands where few lags are left of it. Else it is the integral over the lag, by Gauss and
    Legendre's rule, and what its kinks at no lag and at the delay alias to, in closed form. This is
    within 2e-5 for delays from 20 samples, 1 % for a delay of less than one sample.
    """
    duration = np.asarray(duration, float)
    gamma = 2 * np.pi * np.asarray(line_width, float) * duration
    lag = np.minimum(np.asarray(delay, float) / duration, 1.0)
    gamma, lag = np.broadcast_arrays(np.atleast_1d(gamma), np.atleast_1d(lag))
    power, few = np.empty(gamma.shape), gamma > _FEW_LAGS * window.length
    for rows, taken in ((few, _by_lags), (~few, _by_integral)):
        if rows.any():
            power[rows] = taken(gamma[rows], lag[rows], window)
    return power


def _by_lags(gamma: np.ndarray, lag: np.ndarray, window: Window) -> np.ndarray:
    """Sum over the lags directly, up to where the terms have decayed."""
    j = np.arange(min(int(_GONE / _FEW_LAGS), window.length))
    gone = (gamma / window.length)[:, None] * j
    left = np.maximum((gamma * lag)[:, None] - gone, 0.0)
    value = np.exp(-gone) * -np.expm1(-left) * autocorrelation(window)(j)
    value[:, 1:] *= 2
    return np.asarray(value.sum(axis=-1))


def _by_integral(gamma: np.ndarray, lag: np.ndarray, window: Window) -> np.ndarray:
    """Integrate over the lag, and correct for what the integrand's kinks alias to.

    The sum over m != 0 of cos(2 pi m x) / (2 pi m)^2 is B_2(x - floor(x)) / 2, with
    B_2(x) = x^2 - x + 1/6.
    """
    length = window.length
    reach = np.minimum(lag, _GONE / np.maximum(gamma, 1e-300))
    x, weight = _gauss_legendre(128)
    time = reach[:, None] * (x + 1) / 2
    value = np.exp(-gamma[:, None] * time) * -np.expm1(-gamma[:, None] * (lag[:, None] - time))
    r = autocorrelation(window)
    value *= r(time * length) * length * reach[:, None] * weight
    # Jumps of the slope: r'(0) is the window's edge, the rest the bracket's.
    per_sample, left = gamma / length, np.exp(-gamma * lag)
    at_none = 2 * (r(0.0, 1) * (1 - left) - per_sample * r(0.0))
    at_delay = per_sample * left * r(lag * length)
    past = lag * length - np.floor(lag * length)
    power = value.sum(axis=1) - at_none * (1 / 6 / 2)
    return np.asarray(power - 2 * at_delay * ((past * past - past + 1 / 6) / 2))


def seen_line(
    *,
    line_width: np.ndarray,
    delay: np.ndarray,
    duration: np.ndarray,
    window: Window,
    looks: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Line and pedestal in the line's bin as |X| sees them, but for the phase of all the record.

    Returns two values, (n,) each. The first is the share of the power |C W(0)|^2 in the line, more
    than :func:`coherent_share`. The second is the mean square of what is in phase with it, over
    |C|^2 of the line. As noise, half of this is the pedestal's share. If looks are added in
    amplitude the phase of a record counts too: each has its own.

    C(t, s) is the covariance of phi and E_t = exp(-C(t, t) / 2), both less the mean under the
    window w. The line is m = sum w E, and its fellow sum w E w E cosh C - m^2. C(t, s) is
    c(t - s) - q(t) - q(s), with the triangle c of Gamma (tau - |t|). So each exponential is one of
    a lag times one of t and one of s: autocorrelations of w and of w exp(2 q), on 256 places.
    """
    power = power_under_line(line_width=line_width, delay=delay, duration=duration, window=window)
    gamma = np.broadcast_to(2 * np.pi * np.asarray(line_width) * duration, power.shape)
    lag = np.broadcast_to(np.minimum(np.asarray(delay) / duration, 1.0), power.shape)
    w, twice = _places(window)
    x, variance, less = np.arange(w.size) / w.size, gamma * lag, np.exp(-gamma * lag)

    def integral(t: np.ndarray) -> np.ndarray:
        return np.where(t > 1, twice(1.0) + (t - 1) * twice(1.0, 1), twice(np.clip(t, 0, 1)))

    apart, at = lag[:, None], integral(x)
    mean = gamma[:, None] * (integral(x + apart) - 2 * at + integral(x - apart))
    mean -= 0.5 * (w * mean).sum(axis=1)[:, None]
    # a line that is gone needs no care
    mean = np.where((variance[:, None] < _GONE) & (looks == 1), mean, 0.0)
    once, double = np.exp(mean), w * np.exp(2 * mean)
    sums = (w * once).sum(axis=1), double.sum(axis=1)
    nodes, weight = _gauss_legendre(128)
    time = 0.5 * (nodes + 1) * lag[:, None]
    # A transform at a time: bits do not depend on how many there are.
    spectra = [np.abs(np.fft.rfft(each, 2 * w.size)) ** 2 for each in double]
    r = np.array([
        np.interp(u * w.size, np.arange(w.size + 1), np.fft.irfft(s)[: w.size + 1])
        for u, s in zip(time, spectra, strict=True)
    ]).reshape(time.shape)  # fmt: skip
    lost = -np.expm1(-gamma[:, None] * (lag[:, None] - time)) * r * weight
    crossed = lost.sum(axis=1) * lag * w.size
    total = window.sum**2
    pedestal = 0.5 * (1 + sums[1] ** 2 - crossed) - sums[0] ** 2
    share = np.maximum(less * sums[0] ** 2, _LEAST)
    return share, np.maximum(0.5 * power + less * pedestal * total, 0.0)


@lru_cache(maxsize=16)
def _places(window: Window) -> "tuple[np.ndarray, CubicSpline]":
    """Return the window over the record, of sum 1, and its double integral, of end slope 1."""
    from scipy.interpolate import CubicSpline  # slow to import

    w, x = samples(window.name, _PLACES), np.arange(_PLACES + 1) / _PLACES
    end = w[0]
    if window.missing:
        w = np.where(x[:-1] < window.missing / window.length, 0.0, w)
    twice = CubicSpline(x, np.append(w, end) / w.mean()).antiderivative(2)
    return w / w.sum(), twice


def walk_steps(*, delay: float, length: int) -> int:
    """Return the steps that :func:`walked_phase` takes for a delay [samples], an even number.

    A delay beyond the record counts as its length: the delayed record then shares none of it.
    """
    return 2 * (length + min(math.floor(delay), length))


def walked_phase(
    steps: np.ndarray, *, per_sample: float, delay: float, whole: bool = False
) -> np.ndarray:
    """Phase theta(t) - theta(t - tau) [rad] of a laser over a record, but for its first sample's.

    `steps` (walk_steps,) are standard normal numbers, `per_sample` the variance of theta's change
    from sample to sample, Gamma / fs. `delay` is tau [samples]. With `whole` the result has the
    first sample's as well, for a delay shorter than the record. Each step between samples is taken
    in two, before and after the place in it at which delayed samples lie. So delays need not be
    whole.
    """
    before, after = steps.reshape(2, -1)
    part = delay - math.floor(delay)
    before = before * math.sqrt(per_sample * (1 - part))
    after = after * math.sqrt(per_sample * part)
    length = max(before.size - math.floor(delay), before.size // 2)
    now = (before + after)[before.size - length + 1 :]
    then = before[1:length] + after[: length - 1]
    phase = np.concatenate([[0.0], np.cumsum(now - then)])
    if whole:
        both = (before + after)[1 : math.floor(delay) + 1]
        phase += after[0] + both.sum()
    return phase


@lru_cache(maxsize=16)
def autocorrelation(window: Window) -> "CubicSpline":
    """Sum_n w_n w_(n+j) as a function of the lag j, 0..L [samples]."""
    from scipy.interpolate import CubicSpline  # slow to import

    spectrum = np.abs(np.fft.rfft(window.samples(), 2 * window.length)) ** 2
    r = np.fft.irfft(spectrum, 2 * window.length)[: window.length + 1]
    return CubicSpline(np.arange(window.length + 1), r)


_WIDTH, _SHAPE = LASER + "line_width", LASER + "line_shape"


def _deviation(points: Points) -> np.ndarray:
    """Return the standard deviation of a Gaussian line [bins of fs/L]."""
    return DEVIATION_OF_FWHM * points[_WIDTH] * points.record_duration


def smear(points: Points) -> Smear | None:
    """Reach of a Gaussian line."""
    if not points.has(_WIDTH) or points.word(_SHAPE) != "gaussian":
        return None
    return Smear(reach=_SIGMAS * _deviation(points))


def size(points: Points) -> Size | None:
    """Change of the detecting bins by leaving the width out.

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
    least = points.left_of(points.powers[0] / np.where(points.near_image, 2.0, 1.01) / smeared)
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
    density = density_under_line(line_width=most, delay=delay)
    ratio = points.footprint.echo_ratio
    beat = points.beat * (ratio if points.architecture == "direct" else np.sqrt(ratio))
    cnr = beat**2 / points.noise_variance  # with its image
    return Size(
        magnitude=1 - np.sqrt(share),
        noise=cnr * (points.sample_rate * density + (1 - share)),
        threshold_follows=False,
    )


def _seen_lines(shots: Shots, timing: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return :func:`seen_line` of points by the part of the record that the up-chirp's echo has."""
    looks = shots.looks.added
    if shots.first_sample is None:
        return seen_line(window=shots.window, looks=looks, **timing)
    first = shots.first_sample[0]
    windows = [last_part(shots.window, number) for number in first.tolist()]
    share, in_phase = np.empty((2, shots.size))
    timing = {name: np.broadcast_to(values, shots.size) for name, values in timing.items()}
    for window in dict.fromkeys(windows):
        here = np.array([window is other for other in windows])
        part = {name: values[here] for name, values in timing.items()}
        share[here], in_phase[here] = seen_line(window=window, looks=looks, **part)
        in_phase[here] *= energy_left(shots.window)[first[here]] / window.energy
    return share, in_phase


def act(shots: Shots, scene: Scene) -> Shots:
    """Give the beat a Gaussian line; or dim the pure line and add a pedestal of noise."""
    width = np.asarray(scene.parameters[_WIDTH], float)
    if str(scene.parameters[_SHAPE]) == "gaussian":
        return replace(shots, gaussian_width=width + np.zeros(shots.size))
    delay = 2 * shots.range / SPEED_OF_LIGHT
    width = width + np.zeros(shots.size)
    timing = {"line_width": width, "delay": delay, "duration": shots.record_duration}
    if shots.looks.added > 1 and np.any(delay > shots.record_duration):
        raise UnsupportedShot(
            f"{_WIDTH} leaves of looks that are added what their phases have in common, which is "
            f"known for echoes that come back within a record, of "
            f"{np.min(shots.record_duration):.3g} s, and this one takes {np.max(delay):.3g} s: "
            "raise instrument.processing.fft_size, or take instrument.looks.combine: power"
        )
    share, in_phase = _seen_lines(shots, timing)
    power = (shots.beat_scale / 2) ** 2 * shots.relative_echo
    beside = power_under_line(window=shots.window, **timing)
    if shots.first_sample is not None:
        beside = beside * energy_left(shots.window)[shots.first_sample[0]] / shots.window.energy
    return replace(
        shots,
        beat_scale=shots.beat_scale * np.sqrt(share),
        laser_width=width,
        pedestal=power * 2 * in_phase / shots.window.energy,
        pedestal_beside=power * beside / shots.window.energy,
    )


LINE_WIDTH = Effect(
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
            example="10 kHz",
            limits=("0 Hz", "1e15 Hz"),
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
