"""Line width: mean bin powers against simulated records, and lags."""

import numpy as np
import pytest

from sweep.model import laser_line
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.evaluation import evaluate, prepare_shots
from sweep.model.time_domain_truth import beamlet_analytic_signal
from sweep.model.window import direct_transform, get_window, window_samples

WINDOWS = ("rectangular", "hann", "hamming", "flattop", "kaiser(8.6)")
LENGTH = 256
BINS = np.arange(60, 91)
PLACE = 75.3
RATE = 1e6
DURATION = LENGTH / RATE


def by_lags(name, y, correlation):
    """Mean |W|^2-like power at y bins from the line, from the beat's autocorrelation at lags."""
    w = window_samples(name, LENGTH)
    r = np.correlate(w, w, "full")[LENGTH - 1 :]
    j = np.arange(1, LENGTH)
    turns = np.cos(2 * np.pi * np.outer(y, j) / LENGTH)
    return r[0] * correlation[0] + 2 * turns @ (r[1:] * correlation[1:])


def gaussian_power(name, y, fwhm):
    """The module's mean power of a single line, from its shifts."""
    shifts = laser_line.gaussian_frequency_shifts(
        fwhm=np.array([fwhm]), duration=np.array([DURATION])
    )
    form = get_window(name, LENGTH)
    powers = np.abs(direct_transform(form, (y[:, None] - shifts.shift_window_bins[0]).ravel())) ** 2
    return powers.reshape(y.size, -1) @ shifts.weight[0]


@pytest.mark.parametrize("name", ["rectangular", "hamming"])
@pytest.mark.parametrize("bins_fwhm", [0.3, 1.5, 6.0])
def test_records_of_normal_frequencies_have_the_gaussian_lines_mean_power(name, bins_fwhm):
    rng = np.random.default_rng(41)
    # FWHM is where the density has fallen to a half.
    deviation = bins_fwhm / 2 / np.sqrt(2 * np.log(2))
    shift = PLACE + deviation * rng.standard_normal((20000, 1))
    records = np.exp(2j * np.pi * shift * np.arange(LENGTH) / LENGTH)
    # Further out the mean is made by lines so rare that their spread can not be estimated.
    bins = BINS[np.abs(BINS - PLACE) < 2.5 * deviation + 2]
    expected = gaussian_power(name, bins - PLACE, bins_fwhm / DURATION)
    w = window_samples(name, LENGTH)
    power = np.abs(np.fft.fft(records * w, axis=1)[:, bins]) ** 2
    error = power.std(axis=0, ddof=1) / np.sqrt(len(power))
    assert (np.abs(power.mean(axis=0) - expected) < 5 * error + 1e-12 * w.sum() ** 2).all()
    assert (error / expected)[
        np.argmax(expected)
    ] < 0.03  # sharp enough to tell an FWHM from a deviation


@pytest.mark.parametrize("name", WINDOWS)
@pytest.mark.parametrize("bins_fwhm", [0.0, 1e-4, 0.1, 1.0, 7.0, 40.0])
def test_shifts_are_the_gaussian_convolution_to_their_tolerance(name, bins_fwhm):
    """By lags the convolution is a product: exp(-2 pi^2 s^2 T^2)."""
    y = np.linspace(-60, 60, 61) + 0.2
    deviation = bins_fwhm / np.sqrt(8 * np.log(2))
    lag = np.arange(LENGTH) / LENGTH
    expected = by_lags(name, y, np.exp(-2 * (np.pi * deviation * lag) ** 2))
    power = gaussian_power(name, y, bins_fwhm / DURATION)
    top = window_samples(name, LENGTH).sum() ** 2
    assert np.abs(power - expected).max() < 10 * laser_line.MEAN_POWER_TOLERANCE * top


def lorentzian_power(name, laser_width, delay):
    """The module's mean power of a single line in its bin: pure line and pedestal."""
    laser = {"line_width": np.array([laser_width]), "delay": np.array([delay]),
             "duration": np.array([DURATION])}  # fmt: skip
    pedestal = laser_line.pedestal_power_under_line(window=get_window(name, LENGTH), **laser)
    pure = laser_line.pure_line_power_fraction(**laser) * window_samples(name, LENGTH).sum() ** 2
    return pure + pedestal, pedestal


@pytest.mark.parametrize("name", WINDOWS)
@pytest.mark.parametrize("laser_width", [1.0, 3e4])
@pytest.mark.parametrize("delay", [0.6, 20, 100.3, 1000])
def test_pure_line_and_pedestal_are_the_autocorrelation_at_every_lag(name, laser_width, delay):
    gamma = 2 * np.pi * laser_width / RATE
    lags = np.arange(LENGTH)
    expected = by_lags(name, np.zeros(1), np.exp(-gamma * np.minimum(lags, delay)))
    pure_power, pedestal = lorentzian_power(name, laser_width, delay / RATE)
    assert pedestal > 0
    # What the integral leaves out: kinks of the third derivative at no lag and at the delay.
    share = 2e-5 + (gamma + 1 / LENGTH) / (10 * delay**2)
    assert np.abs(pure_power - expected) < share * pedestal + 1e-13 * pure_power


@pytest.mark.parametrize("name", ["rectangular", "hamming", "hann"])
@pytest.mark.parametrize("delays", [64, 4, 0.5])
@pytest.mark.parametrize("g", [0.4, 3.8])
def test_the_line_is_seen_without_the_phase_of_all_the_record(name, delays, g):
    """Sums over all pairs of samples, of phases less their mean under the window."""
    length = 1024
    n, w, delay = np.arange(length), window_samples(name, length), length / delays
    covariance = g * np.maximum(1 - np.abs(n[:, None] - n) / delay, 0.0)
    shared = covariance @ w / w.sum()
    rest = covariance - shared[:, None] - shared + w @ shared / w.sum()
    line = w * np.exp(-np.diag(rest) / 2)
    expected = line @ (np.cosh(rest) - 1) @ line
    laser = {"line_width": np.array([g / (2 * np.pi * delay)]), "delay": np.array([delay])}
    form = get_window(name, length)
    share, in_phase = laser_line.apparent_line_and_pedestal_power(
        duration=np.array([float(length)]), window=form, **laser
    )
    np.testing.assert_allclose(share * form.sum**2, line.sum() ** 2, rtol=1e-4)
    np.testing.assert_allclose(in_phase, expected, rtol=2e-3)


@pytest.mark.parametrize("delay", [3.0, 20.3, 700.5])
def test_the_walk_of_a_phase_has_the_lag_and_the_growth_of_a_wiener_process(delay):
    """Of what differs by u samples the variance is 2 Gamma min(u, tau), to 5 sigma."""
    rng, per_sample, number = np.random.default_rng(5), 1e-3, 2000
    steps = laser_line.n_beat_phase_noise_steps(delay=delay, length=LENGTH)
    phases = np.array(
        [
            laser_line.beat_phase_noise(
                rng.standard_normal(steps), variance_per_sample=per_sample, delay=delay
            )
            for _ in range(number)
        ]
    )
    assert phases.shape == (number, LENGTH)
    for u in (1, 10, 19, 21, 200):
        expected = 2 * per_sample * min(u, delay)
        for start in (0, LENGTH - 1 - u):
            phase_variance = (phases[:, start + u] - phases[:, start]).var()
            assert phase_variance == pytest.approx(expected, rel=5 * np.sqrt(2 / number))


@pytest.mark.parametrize(
    ("g", "architecture"),
    [
        (0.4, "homodyne"),
        pytest.param(1.3, "homodyne", marks=pytest.mark.slow),
        (3.8, "homodyne"),
        (0.4, "direct"),
    ],
)
def test_a_walking_phase_is_detected_as_records_of_the_time_domain_are(table_4_1, g, architecture):
    """A delay of a sixteenth of the record, at thresholds below and above the line."""
    length, rate, number, rng = 4096, 600e6, 3000, np.random.default_rng(6)
    delay = length // 16
    target_range, power = SPEED_OF_LIGHT * delay / rate / 2, 1e-4
    amplitude_exponent = 1.0 if architecture == "direct" else 0.5  # of the beat, by power
    point = table_4_1(
        range=target_range, fft_size=length, power=power, architecture=architecture
    ) | {
        "target.radial_velocity": 0.0,
        "footprint.beamlets": 1,
    }
    ((_, shots),) = prepare_shots(point, ("doppler",))
    record = window_samples("hamming", length) * beamlet_analytic_signal(shots, 0, 0, 0) / 2
    peak = np.abs(np.fft.fft(record)).argmax()
    record *= np.exp(-2j * np.pi * peak * np.arange(length) / length)
    walk = rng.standard_normal((number, length + delay)).cumsum(axis=1) * np.sqrt(g / delay)
    signal = np.exp(1j * (walk[:, delay:] - walk[:, :length])) @ record
    noise = rng.standard_normal(number) + 1j * rng.standard_normal(number)
    for line in (0.7, 1.0, 1.3):  # over the threshold, by the pure line's power
        factor = line * shots.threshold[0] * np.exp(g / 2) / abs(record.sum())
        changes = {
            "instrument.laser.power": power * factor ** (1 / amplitude_exponent),
            "instrument.laser.line_width": g * rate / (2 * np.pi * delay),
            "instrument.laser.line_shape": "lorentzian",
        }
        ((_, lit),) = prepare_shots(point | changes, ("doppler",))  # with the echo's shot noise
        is_detected = np.abs(factor * signal + lit.line_noise_sigma[0] * noise) >= lit.threshold[0]
        pd = float(evaluate(point | changes, ("doppler", "line_width"))["pd_up"][0])
        assert is_detected.mean() == pytest.approx(pd, abs=5 * np.sqrt(pd * (1 - pd) / number))
