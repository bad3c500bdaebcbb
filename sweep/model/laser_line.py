"""Line of a laser: the mean power of bins under a line that is not a pure tone.

There are two models. Both give the mean of |X|^2 over records, with the window's actual transform.

**Gaussian** [T, section 3.2]: the power spectrum is convolved with a Gaussian of the given FWHM, at
any delay. This is exactly the mean over records that each have one random normal frequency, common
to all beamlets: jitter slow against the record. The mean over the frequency is a sum over equally
spaced shifts, to a stated error. The spectrum |X|^2 of a record of L samples has only lags below L,
so the trapezium rule errs only by a Gaussian's aliases.

**Lorentzian**: a laser whose phase is a random walk (FWHM dnu, Gamma = 2 pi dnu), mixed with itself
after a delay tau [1]_ [2]_. The beat's factor exp(i (theta(t - tau) - theta(t))) has the
autocorrelation

    exp(-Gamma min(|T|, tau)) = exp(-Gamma tau) + [exp(-Gamma |T|) - exp(-Gamma tau)]_{|T| < tau}

which is a pure line with exp(-Gamma tau) of the power, and a pedestal with the rest. The pedestal
is taken at its height under the line. A record shorter than the delay has only lags below its own
length; there the record's length replaces the delay.

|X| does not depend on a phase common to the full record, and little on the part of the pedestal in
quadrature to the line. With the phase less its mean under the window, the mean of exp(i phi) is the
line that |X| shows. Only the part of the pedestal in phase with it changes |X|
(:func:`apparent_line_and_pedestal_power`). Full spectra are drawn with both parts
(:func:`beat_phase_noise`). An echo that arrives within the record has the line and the pedestal of
its own samples, in steps of 1/32 of the record.

References
----------
.. [1] Gallion and Debarge, 1984.
.. [2] Richter et al., IEEE J. Quantum Electron. 22, 2070, 1986.
"""

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.model.window import Window, window_samples

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

DEVIATION_PER_FWHM = 1 / math.sqrt(8 * math.log(2))
"""Ratio of a Gaussian's standard deviation to its full width at half maximum (FWHM)."""

MEAN_POWER_TOLERANCE = 1e-12
"""Tolerated error of a mean power that is computed as a sum over frequency shifts, relative to the
power at the line's peak."""

LINE_DEVIATION_MAX_WINDOW_BINS = 500
"""Largest standard deviation of a Gaussian laser line that can be simulated [bins of fs/L]. fs is
the sample rate, L the number of samples."""


_gauss_legendre = lru_cache(maxsize=1)(np.polynomial.legendre.leggauss)

_DECAY_EXPONENT_MAX = 40.0
"""Exponent x above which the decay exp(-x) of the laser's coherence counts as 0."""

_DECAY_PER_SAMPLE_MIN = 0.1
"""Decay exponent of the laser's coherence per sample above which the pedestal's power is a sum over
single lags. After 400 lags the remaining terms are negligible."""

_N_PHASE_NODES = 256
"""Number of positions in the record at which the covariance of the phase is evaluated by
:func:`apparent_line_and_pedestal_power`."""

_LINE_POWER_FRACTION_MIN = 1e-100
"""Lower limit of the fraction of power in the pure line, so that divisions by the fraction stay
finite."""


class LaserLine(NamedTuple):
    """Width of the laser's line, and power of its phase-noise pedestal; a pure tone by default."""

    gaussian_fwhm: np.ndarray | None = None
    """(n,): full width at half maximum of the beat's Gaussian line [Hz]; None if the line is not
    Gaussian."""
    lorentzian_fwhm: np.ndarray | float = 0.0
    """(n,): full width at half maximum of the laser's Lorentzian line [Hz], whose cause is a random
    walk of the phase; 0 without one."""
    pedestal_variance_beside_line: np.ndarray | float = 0.0
    """(n,): variance of noise at the ADC [V^2] that equals the phase-noise pedestal in bins next to
    the lines."""
    pedestal_variance_under_line: np.ndarray | float = 0.0
    """(n,): variance of noise at the ADC [V^2] that equals the phase-noise pedestal in bins that
    contain lines."""

    def with_scaled_pedestal(self, power_factor: np.ndarray) -> "LaserLine":
        """Return a copy whose pedestal variances are multiplied by ``power_factor``.

        The factor is that on the echo's power.
        """
        return self._replace(
            pedestal_variance_beside_line=self.pedestal_variance_beside_line * power_factor,
            pedestal_variance_under_line=self.pedestal_variance_under_line * power_factor,
        )


class FrequencyShifts(NamedTuple):
    """Shifts of a footprint's lines, with weights, over which the power spectrum is averaged."""

    shift_window_bins: np.ndarray
    """(n, k): frequency shift, common to all lines of a point [bins of fs/L, sample rate over
    number of samples]."""
    weight: np.ndarray
    """(n, k): weight, >= 0, of the power spectrum at each shift; weights of a point sum to 1."""


def gaussian_frequency_shifts(*, fwhm: np.ndarray, duration: np.ndarray) -> FrequencyShifts:
    """Return frequency shifts that replace a Gaussian laser line in a mean of power spectra.

    The weighted mean of the power spectrum over the shifts equals that over the Gaussian line.

    Parameters
    ----------
    fwhm : ndarray (n,)
        FWHM of the beat's line [Hz].
    duration : ndarray (n,)
        Length of the record [s].

    Returns
    -------
    FrequencyShifts
        One shift for a width of 0, 19 for lines narrow against a bin, and 15 more per bin of
        standard deviation. Weights of 0 fill rows with fewer than k shifts.

    Raises
    ------
    UnsupportedShotError
        If the standard deviation exceeds :data:`LINE_DEVIATION_MAX_WINDOW_BINS` bins.

    Notes
    -----
    With the step h and the standard deviation s of the line, in bins, the error at the record's
    longest lag is exp(-2 pi^2 s^2 (1/h - 1)^2), by Poisson's summation formula. The Gaussian is cut
    where its tails hold the same fraction.
    """
    deviation = np.atleast_1d(DEVIATION_PER_FWHM * np.asarray(fwhm, float) * duration)
    if deviation.max(initial=0.0) > LINE_DEVIATION_MAX_WINDOW_BINS:
        raise UnsupportedShotError(
            f"instrument.laser.line_width makes a line of {deviation.max():.3g} bins standard "
            f"deviation, and {LINE_DEVIATION_MAX_WINDOW_BINS} can be simulated: lower it, or "
            "shorten the record by "
            "instrument.processing.fft_size"
        )
    step_margin = math.sqrt(math.log(2 / MEAN_POWER_TOLERANCE) / 2) / math.pi
    steps_per_deviation = deviation + step_margin  # s / h
    reach_deviations = math.sqrt(2 * math.log(1 / MEAN_POWER_TOLERANCE))
    n_steps = int(np.ceil(reach_deviations * steps_per_deviation.max(initial=0.0)))
    position = np.arange(-n_steps, n_steps + 1) / steps_per_deviation[:, None]
    weight = np.where(
        np.abs(position) <= reach_deviations + 1 / steps_per_deviation[:, None],
        np.exp(-(position**2) / 2),
        0.0,
    )
    weight[deviation == 0] = np.arange(-n_steps, n_steps + 1) == 0
    # A cumulative sum, so that padding with zeros, and thus other rows, changes no bit.
    weight /= np.cumsum(weight, axis=1)[:, -1:]
    return FrequencyShifts(deviation[:, None] * position, weight)


def pure_line_power_fraction(
    *, line_width: np.ndarray, delay: np.ndarray, duration: np.ndarray
) -> np.ndarray:
    """Return the fraction, 0..1, of the beat's power in the pure line of a Lorentzian laser.

    The rest of the power is in the phase-noise pedestal.

    Parameters
    ----------
    line_width : ndarray (n,)
        FWHM dnu of the laser's Lorentzian line [Hz].
    delay : ndarray (n,)
        Delay tau of the echo [s].
    duration : ndarray (n,)
        Length of the record [s], which replaces a longer delay.

    Notes
    -----
    exp(-2 pi dnu tau) [1]_.

    References
    ----------
    .. [1] Gallion and Debarge, 1984.
    """
    return np.exp(-2 * np.pi * np.asarray(line_width) * np.minimum(delay, duration))


def pedestal_density_under_line(*, line_width: np.ndarray, delay: np.ndarray) -> np.ndarray:
    """Return the power density [1/Hz] of the phase-noise pedestal under a line.

    The total power of line and pedestal is 1.

    Parameters
    ----------
    line_width : ndarray
        FWHM dnu [Hz]; 0 gives 0.
    delay : ndarray
        Delay tau of the echo [s].

    Notes
    -----
    2 (1 - e^-g (1 + g)) / Gamma with Gamma = 2 pi dnu and g = Gamma tau.
    """
    gamma = 2 * np.pi * np.asarray(line_width, float)
    g = gamma * delay
    bracket = -np.expm1(-g) - g * np.exp(-g)
    # A series in place of the bracket, which cancels for small g.
    bracket = np.where(g < 0.02, g * g * (1 / 2 - g * (1 / 3 - g * (1 / 8 - g / 30))), bracket)
    return np.where(gamma > 0, 2 * gamma * bracket / np.where(gamma > 0, gamma**2, 1.0), 0.0)


def pedestal_power_under_line(
    *, line_width: np.ndarray, delay: np.ndarray, duration: np.ndarray, window: Window
) -> np.ndarray:
    """Return the mean power of the phase-noise pedestal in the bin of its line, relative to |C|^2.

    |C| is half the amplitude of the beat, the weight of its line.

    Parameters
    ----------
    line_width, delay, duration : ndarray (n,)
        As in :func:`pure_line_power_fraction`.
    window : Window
        Window of the record.

    Returns
    -------
    ndarray (n,)
        Pedestal power p >= 0. The mean power of the bin is |C|^2 (F |W(0)|^2 + p), with the
        fraction F of :func:`pure_line_power_fraction` and the window's sum W(0). The pedestal adds
        as noise does: circular, and independent in every record.

    Notes
    -----
    sum_j r_j [e^{-Gamma T_j} - e^{-Gamma tau}] runs over the lags T_j [s], with the window's
    autocorrelation r, Gamma = 2 pi FWHM and the delay tau. It is summed directly if few lags count.
    Otherwise it is an integral over the lag by Gauss-Legendre quadrature, plus a closed-form
    correction for aliasing of the integrand's kinks at lag 0 and at the delay. The result is
    accurate to 2e-5 for delays of 20 samples or more, and to 1 % for a delay below one sample.
    """
    duration = np.asarray(duration, float)
    gamma = 2 * np.pi * np.asarray(line_width, float) * duration
    lag = np.minimum(np.asarray(delay, float) / duration, 1.0)
    gamma, lag = np.broadcast_arrays(np.atleast_1d(gamma), np.atleast_1d(lag))
    power, has_few_lags = np.empty(gamma.shape), gamma > _DECAY_PER_SAMPLE_MIN * window.length
    for rows, method in (
        (has_few_lags, _pedestal_power_by_lags),
        (~has_few_lags, _pedestal_power_by_integral),
    ):
        if rows.any():
            power[rows] = method(gamma[rows], lag[rows], window)
    return power


def _pedestal_power_by_lags(gamma: np.ndarray, lag: np.ndarray, window: Window) -> np.ndarray:
    """Return the power of :func:`pedestal_power_under_line`, (n,), as a sum over lags.

    The sum ends where its terms have decayed. ``gamma`` is the decay exponent of the laser's
    coherence over a record, ``lag`` the largest lag [record lengths].
    """
    j = np.arange(min(int(_DECAY_EXPONENT_MAX / _DECAY_PER_SAMPLE_MIN), window.length))
    decay = (gamma / window.length)[:, None] * j
    decay_left = np.maximum((gamma * lag)[:, None] - decay, 0.0)
    terms = np.exp(-decay) * -np.expm1(-decay_left) * window_autocorrelation(window)(j)
    terms[:, 1:] *= 2
    return np.asarray(terms.sum(axis=-1))


def _pedestal_power_by_integral(gamma: np.ndarray, lag: np.ndarray, window: Window) -> np.ndarray:
    """Return the power of :func:`pedestal_power_under_line`, (n,), as an integral over the lag.

    ``gamma`` is the decay exponent of the laser's coherence over a record, ``lag`` the largest lag
    [record lengths]. A correction makes the integral equal the sum over sampled lags. It follows
    from the kinks of the integrand, where the sum over m != 0 of cos(2 pi m x) / (2 pi m)^2 is
    B_2(x - floor(x)) / 2, with the Bernoulli polynomial B_2(x) = x^2 - x + 1/6.
    """
    length = window.length
    lag_max = np.minimum(lag, _DECAY_EXPONENT_MAX / np.maximum(gamma, 1e-300))
    node, weight = _gauss_legendre(128)
    lag_at_nodes = lag_max[:, None] * (node + 1) / 2
    integrand = np.exp(-gamma[:, None] * lag_at_nodes) * -np.expm1(
        -gamma[:, None] * (lag[:, None] - lag_at_nodes)
    )
    correlation = window_autocorrelation(window)
    integrand *= correlation(lag_at_nodes * length) * length * lag_max[:, None] * weight
    # Jumps of the slope: r'(0) is that of the window's edge, the others are those of the bracket.
    decay_per_sample, decay_at_delay = gamma / length, np.exp(-gamma * lag)
    kink_at_zero = 2 * (
        correlation(0.0, 1) * (1 - decay_at_delay) - decay_per_sample * correlation(0.0)
    )
    kink_at_delay = decay_per_sample * decay_at_delay * correlation(lag * length)
    fractional_lag = lag * length - np.floor(lag * length)
    power = integrand.sum(axis=1) - kink_at_zero * (1 / 6 / 2)
    return np.asarray(
        power - 2 * kink_at_delay * ((fractional_lag * fractional_lag - fractional_lag + 1 / 6) / 2)
    )


def apparent_line_and_pedestal_power(
    *,
    line_width: np.ndarray,
    delay: np.ndarray,
    duration: np.ndarray,
    window: Window,
    looks: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the powers of line and phase-noise pedestal that appear in a bin's magnitude.

    Both are powers in the line's bin, relative to the line's weight C, half the beat's amplitude. A
    phase common to the full record does not change the magnitude and is excluded.

    Parameters
    ----------
    line_width, delay, duration : ndarray (n,)
        As in :func:`pure_line_power_fraction`.
    window : Window
        Window of the record.
    looks : int
        Number of looks whose amplitudes are added. With several, the phase of each record is
        included.

    Returns
    -------
    line_fraction : ndarray (n,)
        Fraction of the power |C W(0)|^2 in the line; larger than :func:`pure_line_power_fraction`.
    in_phase_pedestal : ndarray (n,)
        Mean square of the pedestal in phase with the line, relative to |C|^2. Its noise variance
        per quadrature is half of this.

    Notes
    -----
    Let phi(t) be the phase less its mean under the window w, K(t, s) its covariance, and E_t =
    exp(-K(t, t) / 2). The line is m = sum_t w_t E_t, the pedestal sum_t,s w_t E_t w_s E_s cosh K(t,
    s) - m^2. K(t, s) is c(t - s) - q(t) - q(s), with the triangle c(t) = Gamma (tau - |t|). So each
    exponential is a product of functions of the lag t - s, of t and of s, and the sums are
    autocorrelations of w and of w exp(2 q), at 256 positions.
    """
    power = pedestal_power_under_line(
        line_width=line_width, delay=delay, duration=duration, window=window
    )
    gamma = np.broadcast_to(2 * np.pi * np.asarray(line_width) * duration, power.shape)
    lag = np.broadcast_to(np.minimum(np.asarray(delay) / duration, 1.0), power.shape)
    w, double_integral = _window_samples_and_double_integral(window)
    position, phase_variance, coherent_fraction = (
        np.arange(w.size) / w.size,
        gamma * lag,
        np.exp(-gamma * lag),
    )

    def double_integral_at(t: np.ndarray) -> np.ndarray:
        """Return the window's double integral at t [record lengths].

        Outside the record it is extended linearly.
        """
        return np.where(
            t > 1,
            double_integral(1.0) + (t - 1) * double_integral(1.0, 1),
            double_integral(np.clip(t, 0, 1)),
        )

    lag_column, integral_at_position = lag[:, None], double_integral_at(position)
    mean_exponent = gamma[:, None] * (
        double_integral_at(position + lag_column)
        - 2 * integral_at_position
        + double_integral_at(position - lag_column)
    )
    mean_exponent -= 0.5 * (w * mean_exponent).sum(axis=1)[:, None]
    # A line with no power left needs no correction.
    mean_exponent = np.where(
        (phase_variance[:, None] < _DECAY_EXPONENT_MAX) & (looks == 1), mean_exponent, 0.0
    )
    single_factor, double_factor = np.exp(mean_exponent), w * np.exp(2 * mean_exponent)
    single_sum, double_sum = (w * single_factor).sum(axis=1), double_factor.sum(axis=1)
    nodes, weight = _gauss_legendre(128)
    lag_at_nodes = 0.5 * (nodes + 1) * lag[:, None]
    # One transform at a time, so that bits do not depend on the number of rows.
    spectra = [np.abs(np.fft.rfft(row, 2 * w.size)) ** 2 for row in double_factor]
    correlation = np.array(
        [
            np.interp(
                row_lags * w.size, np.arange(w.size + 1), np.fft.irfft(row_spectrum)[: w.size + 1]
            )
            for row_lags, row_spectrum in zip(lag_at_nodes, spectra, strict=True)
        ]
    ).reshape(lag_at_nodes.shape)
    decorrelated = -np.expm1(-gamma[:, None] * (lag[:, None] - lag_at_nodes)) * correlation * weight
    decorrelated_sum = decorrelated.sum(axis=1) * lag * w.size
    squared_window_sum = window.sum**2
    pedestal = 0.5 * (1 + double_sum**2 - decorrelated_sum) - single_sum**2
    line_fraction = np.maximum(coherent_fraction * single_sum**2, _LINE_POWER_FRACTION_MIN)
    return line_fraction, np.maximum(
        0.5 * power + coherent_fraction * pedestal * squared_window_sum, 0.0
    )


@lru_cache(maxsize=16)
def _window_samples_and_double_integral(window: Window) -> "tuple[np.ndarray, CubicSpline]":
    """Return samples of the window, and its double integral over the position in the record.

    The samples, (:data:`_N_PHASE_NODES`,), are at evenly spaced positions and have the sum 1. The
    double integral is a spline of the position in record lengths, 0..1. Its slope at 1 is 1.
    """
    from scipy.interpolate import CubicSpline  # slow to import

    w, position = (
        window_samples(window.name, _N_PHASE_NODES),
        np.arange(_N_PHASE_NODES + 1) / _N_PHASE_NODES,
    )
    end_value = w[0]
    if window.n_missing:
        w = np.where(position[:-1] < window.n_missing / window.length, 0.0, w)
    double_integral = CubicSpline(position, np.append(w, end_value) / w.mean()).antiderivative(2)
    return w / w.sum(), double_integral


def n_beat_phase_noise_steps(*, delay: float, length: int) -> int:
    """Return the number of random steps, an even number, that :func:`beat_phase_noise` needs.

    Parameters
    ----------
    delay : float
        Delay tau [samples]. A delay beyond the record counts as its length: the delayed record then
        shares nothing with it.
    length : int
        Length of the record [samples].
    """
    return 2 * (length + min(math.floor(delay), length))


def beat_phase_noise(
    steps: np.ndarray, *, variance_per_sample: float, delay: float, from_first_sample: bool = False
) -> np.ndarray:
    """Return a simulated laser's phase, minus its phase one delay earlier [rad], for each sample.

    The laser's phase theta(t) is a random walk. The result is theta(t) - theta(t - tau).

    Parameters
    ----------
    steps : ndarray (n_steps,)
        Standard normal numbers, as many as :func:`n_beat_phase_noise_steps` returns.
    variance_per_sample : float
        Variance of theta's change from sample to sample, Gamma / fs [rad^2].
    delay : float
        Delay tau [samples].
    from_first_sample : bool
        True to include the phase of the first sample, for a delay shorter than the record. False
        for phases relative to that of the first sample.

    Returns
    -------
    ndarray (L,)
        Phase [rad] at each of the record's L samples.

    Notes
    -----
    Each step between samples is taken in two parts, before and after the time of the delayed
    sample. So delays need not be integers.
    """
    step_before, step_after = steps.reshape(2, -1)
    fraction = delay - math.floor(delay)
    step_before = step_before * math.sqrt(variance_per_sample * (1 - fraction))
    step_after = step_after * math.sqrt(variance_per_sample * fraction)
    length = max(step_before.size - math.floor(delay), step_before.size // 2)
    undelayed_step = (step_before + step_after)[step_before.size - length + 1 :]
    delayed_step = step_before[1:length] + step_after[: length - 1]
    phase = np.concatenate([[0.0], np.cumsum(undelayed_step - delayed_step)])
    if from_first_sample:
        first_steps = (step_before + step_after)[1 : math.floor(delay) + 1]
        phase += step_after[0] + first_steps.sum()
    return phase


@lru_cache(maxsize=16)
def window_autocorrelation(window: Window) -> "CubicSpline":
    """Return the autocorrelation of a window as a spline over the lag j, 0..L [samples].

    It is the sum over n of w_n w_(n+j), with the L samples w of the window.
    """
    from scipy.interpolate import CubicSpline  # slow to import

    spectrum = np.abs(np.fft.rfft(window.samples(), 2 * window.length)) ** 2
    correlation = np.fft.irfft(spectrum, 2 * window.length)[: window.length + 1]
    return CubicSpline(np.arange(window.length + 1), correlation)
