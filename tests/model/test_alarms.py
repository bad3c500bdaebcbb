"""Alarms of a segment's bins against noise drawn in records, window by window."""

import numpy as np
import pytest
from scipy import integrate, stats

from sweep.model import evaluation, time_domain_truth
from sweep.model.detection.bin_noise import (
    first_circular_bin,
    n_alarm_equivalent_bins,
    neighbour_noise_correlation,
)
from sweep.model.detection.echo_detection import RAYLEIGH_DEVIATION, bin_crossing_tails
from sweep.model.detection.marcum import log_at_least_one_probability, marcum_q1
from sweep.model.sampling import philox
from sweep.model.sampling.samplers import simulate_draws
from sweep.model.window import get_window, window_samples

NOISE_BINS = "instrument.processing.noise_bins"


def log_segment_pfa(bins, level, correlation):
    """Natural logarithm of the probability that noise alone crosses in any of n adjacent bins."""
    number = n_alarm_equivalent_bins(bins, threshold_ratio=level, correlation=correlation)
    return log_at_least_one_probability(-0.5 * np.square(level), number)


def noise(name, length, fft_size, draws, seed):
    """|X| over sigma of the bins of records of white noise, 1,000 records at a time."""
    rng, taper = np.random.default_rng(seed), window_samples(name, length)
    sigma = np.sqrt((taper**2).sum() / 2)
    for _ in range(draws // 1000):
        record = taper * rng.normal(size=(1000, length))
        yield np.abs(np.fft.rfft(record, fft_size, axis=1)) / sigma


@pytest.mark.parametrize(
    "name, length",
    [
        *((w, 1024) for w in ("rectangular", "hamming", "hann", "flattop")),
        ("hann", 256),
    ],
)
def test_a_segment_alarms_as_often_as_drawn_noise_does(table_4_1, name, length):
    """Within 2 or 3 %; as independent bins they would be off by up to 2.2."""
    rate, n = 600e6, 1024
    scene = table_4_1(
        reflectance=0.0, beamlets=1, fft_size=n, tnr=6.0, window=name, noise_bins="correlated",
        acquisition_delay=500e-6 - length / rate,
    )  # fmt: skip
    results, level = evaluation.evaluate(scene), 6 * RAYLEIGH_DEVIATION
    low, high = first_circular_bin(get_window(name, length), n), n // 2 + 1
    low += 3  # evaluate has three bins occupied by the detection of no echo
    crossed = [
        (m[:, low : high - low + 3] >= level).any(axis=1) for m in noise(name, length, n, 20_000, 7)
    ]
    share = np.mean(crossed)
    spread = 5 * np.sqrt(share / np.size(crossed))
    limit = 0.03 * share + spread if name == "flattop" or length < n else 0.02 * share + spread
    assert results["pfa_segment"][0] == pytest.approx(share, abs=limit)


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.625, 0.976])
@pytest.mark.parametrize("level", [0.3, 2.0, 4.0, 6.55])
def test_two_bins_are_two_rayleigh_magnitudes(level, correlation):
    """P(neither) by integrating one bin's conditional Rice tail over the other's magnitude."""
    scale = np.sqrt(1 - correlation**2)
    neither, _ = integrate.quad(
        lambda r: r * np.exp(-(r**2) / 2) * marcum_q1(correlation * r / scale, level / scale).p,
        0, level, epsabs=1e-14, epsrel=1e-12,
    )  # fmt: skip
    either = np.exp(log_segment_pfa(2, level=level, correlation=correlation))
    assert either == pytest.approx(1 - neither, rel=1e-9, abs=2.3e-16)  # of a difference from 1


def test_the_tail_keeps_its_digits_beyond_float64():
    """At TNR 60 (p = 1e-336) a further bin counts for what 1 - p11 / p leaves."""
    level, rho = 60 * RAYLEIGH_DEVIATION, 0.999
    scale = np.sqrt(1 - rho**2)
    joint_probability, _ = integrate.quad(
        lambda u: np.exp(-u) * marcum_q1(rho * np.sqrt(level**2 + 2 * u) / scale, level / scale).q,
        0, 40, epsabs=1e-14,
    )  # fmt: skip
    log_pfa = log_segment_pfa(1000, level=level, correlation=rho)
    assert log_pfa < np.log(1e-308) and 0.1 < joint_probability < 0.9
    assert log_pfa == pytest.approx(
        np.log(1 + 999 * (1 - joint_probability)) - level**2 / 2, rel=1e-13
    )


def test_correlations_of_neighbours_are_those_of_the_windows_squares():
    """Hamming by its cosines: W2(1) / W2(0) = 0.54 0.46 / (0.54^2 + 0.46^2 / 2)."""
    known = 0.54 * 0.46 / (0.54**2 + 0.46**2 / 2)
    assert neighbour_noise_correlation(get_window("hamming", 1024), 1024) == pytest.approx(
        known, rel=1e-12
    )
    assert neighbour_noise_correlation(get_window("rectangular", 1000), 1000) == 0.0
    padded = neighbour_noise_correlation(get_window("rectangular", 1024), 2048)
    assert padded == pytest.approx(2 / np.pi, rel=1e-5)
    assert n_alarm_equivalent_bins(0, threshold_ratio=5.0, correlation=known) == 0.0


@pytest.mark.parametrize("level", [1e-3, 1.0, 6.55, 40.0])
def test_noise_at_dc_and_nyquist_is_that_of_a_real_bin(level):
    """|a + n|, n of variance 2: both tails by the normal distribution."""
    for a in (0.0, 0.5, 6.4, 8.0, 39.0):
        pd, missed = bin_crossing_tails(a, level, True)
        normal = stats.norm(scale=np.sqrt(2))
        assert pd == pytest.approx(normal.sf(level - a) + normal.cdf(-level - a), rel=1e-12)
        assert missed == pytest.approx(normal.cdf(level - a) - normal.cdf(-level - a), abs=1e-15)


@pytest.mark.parametrize("name", ["hamming", "rectangular"])
def test_an_echo_on_dc_is_detected_as_often_as_in_drawn_records(table_4_1, name):
    """The up beat of a target whose Doppler shift is its range beat; by Q_1 0.82, and 0.71 so."""
    carrier, rate = 299792458 / 1550e-9, 1e9 / 500e-6
    ranges = 100.0 + np.arange(6) * 1550e-9 / 16
    delay = 2 * ranges / 299792458
    scene = table_4_1(
        beamlets=1, fft_size=256, tnr=5.0, window=name, noise_bins="correlated", power=2e-3,
        range=ranges, radial_velocity=299792458 / 2 * rate * delay / (carrier - rate * delay),
    )  # fmt: skip
    pd, q1 = (evaluation.evaluate(s)["pd_up"] for s in (scene, scene | {NOISE_BINS: "independent"}))
    ((_, shots),) = evaluation.prepare_shots(scene)
    drawn = []
    for i in range(6):
        record = time_domain_truth.beamlet_analytic_signal(
            shots, i, 0, 0, with_range_walk=False
        ).real
        rng = np.random.default_rng(3)
        noisy = record + rng.normal(size=(10_000, 256)) * np.sqrt(shots.noise_variance[i])
        dc = np.abs(noisy @ window_samples(name, 256))
        drawn.append((dc >= shots.threshold[i]).mean())
    assert (np.abs(pd - drawn) < 5 * np.sqrt(0.25 / 10_000)).all()
    assert np.abs(pd - q1).max() > 0.08
    keys = philox.point_keys(np.arange(6.0)[:, None], domain="tests", seed=7)
    counts = simulate_draws(
        scene, evaluation.DEFAULT_EFFECTS, keys=keys, batch_sizes=[10_000], method="noise"
    )
    assert (np.abs(pd - counts["n_detected_up"][:, 0] / 10_000) < 5 * np.sqrt(0.25 / 10_000)).all()
