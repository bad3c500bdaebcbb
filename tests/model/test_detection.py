"""Threshold, groups, leakage and probabilities of detection: closed forms, brute force, noise."""

import math
from functools import partial

import mpmath
import numpy as np
import pytest
from scipy import stats
from shot_helpers import prepare_single_category

from sweep.model import evaluation, time_domain_truth
from sweep.model.detection.added_crossings import (
    SERIES_TERMS_MAX,
    echo_edge_crossing_probability,
    fill_crossing_series,
)
from sweep.model.detection.echo_detection import (
    RAYLEIGH_DEVIATION,
    mark_exempt_bins,
    negligible_signal_ratio,
    threshold_from_tnr,
)
from sweep.model.detection.marcum import marcum_q1, marcum_q1_excess
from sweep.model.detection.sub_bin_interpolation import sidelobe_neighbour_noise_correlation
from sweep.model.error_budget import SET_BY_TOLERANCE
from sweep.model.spectrum.bin_spectrum import SpanArrays
from sweep.model.spectrum.leakage import LeakageInputs, false_peak_probability_of_bins
from sweep.model.spectrum.segment_spectra import segment_spectrum as segment_spectrum
from sweep.model.window import window_samples

# Threshold


def test_the_threshold_counts_standard_deviations_of_a_bins_magnitude():
    """Not of its quadratures: the Rayleigh distribution's own deviation."""
    deviation = stats.rayleigh(scale=1.7).std()
    assert threshold_from_tnr(tnr=3.0, bin_deviation=1.7) == pytest.approx(3 * deviation, rel=1e-14)
    assert pytest.approx(stats.rayleigh.std(), rel=1e-14) == RAYLEIGH_DEVIATION


# Detection


@pytest.mark.parametrize("target_range", [1500.0, 3000.0, 4000.0, 6000.0])
def test_a_single_beamlet_on_a_bin_is_detected_as_its_closed_snr_says(target_range, table_4_1):
    """SNR = Re P / (q B) n / (2 ENBW) less detector and amplifier noise; pd = Q_1 by ncx2."""
    n, beat = 16384, 3000 * 600e6 / 16384
    scene = table_4_1(
        beamlets=1, fft_size=n, range=target_range, radial_velocity=beat * 1550e-9 / 2
    )
    echo = 0.1 * np.pi * 0.0125**2 / (2 * np.pi * target_range**2)
    current = 2 * 1.1 * np.sqrt(1e-3 * echo) / (1 + (beat / 400e6) ** 2)
    variance = 2 * 1.602176634e-19 * 1.1 * 1e-3 * 400e6 + (1.1 * 5e-12) ** 2 * 400e6 + (25e-9) ** 2
    enbw = (0.54**2 + 0.46**2 / 2) / 0.54**2
    snr = current**2 / 2 / variance * n / (2 * enbw)
    crossing = 100 * (2 - np.pi / 2)  # (Th / sigma)^2 at a TNR of 10
    results = evaluation.evaluate(scene)
    assert results["snr_doppler"][0] == pytest.approx(snr, rel=1e-6)
    # 1e-9 of signal shot noise and the rounding of ncx2 are far below this.
    expected = stats.ncx2.sf(crossing, 2, 2 * snr)
    assert results["pd_doppler"][0] == pytest.approx(expected, rel=1e-5)
    assert results["miss_doppler"][0] == pytest.approx(
        stats.ncx2.cdf(crossing, 2, 2 * snr), rel=1e-5
    )


# Groups, exemptions and leakage


def assess(magnitude, sigma, level, floor, correlation=0.0):
    """Peak, exempt bins and leakage of a run of bins, as the model has them one by one."""
    count = magnitude.size
    exempt, series = np.empty(count, np.bool_), np.empty(SERIES_TERMS_MAX)
    span = SpanArrays(np.array(magnitude), exempt, *np.empty((2, count + 16)))
    fill_crossing_series(level / sigma, series)
    peak, exempted = mark_exempt_bins(span.magnitude, count, level, exempt, 0)
    assert exempted == exempt.sum()
    marked = set(np.flatnonzero(exempt))
    limits = LeakageInputs(sigma, level, 0.0, correlation)
    probability = false_peak_probability_of_bins(count, limits, floor, span, series)
    least_bound = probability.leakage_probability * (1 - 1e-12)
    assert 1 >= probability.raised_bin_probability_max >= least_bound
    return peak, marked, probability.leakage_probability


def by_brute_force(magnitude, sigma, level, floor, correlation=0.0):
    """Peak, exempt bins and leakage, bin by bin in Python and many digits."""
    above = [m >= level for m in magnitude]
    peak = max(range(len(magnitude)), key=lambda i: (magnitude[i], -i))
    exempt = {
        j for i in range(len(magnitude)) if above[i] or i == peak for j in (i - 1, i, i + 1)
    } & set(range(len(magnitude)))
    with mpmath.workdps(130):  # of chances of 1e-90, thirty
        beta, probability = mpmath.mpf(level) / sigma, mpmath.mpf(0)
        # No further group yet: after a quiet bin, in an echo's group, in one that may join one.
        quiet, of_echo, waits = mpmath.mpf(1), mpmath.mpf(0), mpmath.mpf(0)
        for i, m in enumerate(magnitude):
            if i in exempt or m < floor * sigma:
                if waits:
                    joins = i in exempt and echo_edge_crossing_probability(
                        m / sigma, magnitude[i - 1] / sigma, level / sigma, correlation
                    )
                    quiet, probability = quiet + joins * waits, probability + (1 - joins) * waits
                quiet, of_echo, waits = quiet + of_echo, mpmath.mpf(0), mpmath.mpf(0)
                continue
            crosses = 1 - (1 - q1(mpmath.mpf(m) / sigma, beta)) / (1 - q1(0, beta))
            joins = mpmath.mpf(0)
            if i > 0 and i - 1 in exempt:
                joins = echo_edge_crossing_probability(
                    magnitude[i - 1] / sigma, m / sigma, level / sigma, correlation
                )
            probability += (1 - crosses) * waits
            waits, quiet, of_echo = (
                crosses * (waits + quiet * (1 - joins)),
                (1 - crosses) * (quiet + of_echo),
                crosses * (of_echo + quiet * joins),
            )
        return peak, exempt, float(probability + waits)


def q1(a, b):
    """Marcum's Q_1 from the Poisson mixture of chi-square tails."""
    x, y = mpmath.mpf(a) ** 2 / 2, mpmath.mpf(b) ** 2 / 2
    term, inner, total, weight = mpmath.mpf(1), mpmath.mpf(1), mpmath.mpf(0), mpmath.exp(-x)
    for k in range(400):
        total += weight * inner
        weight *= x / (k + 1)
        if k > x and weight * mpmath.exp(y) < 1e-35 * total:
            break
        term *= y / (k + 1)
        inner += term
    return mpmath.exp(-y) * total


@pytest.mark.parametrize("level", [0.5, 2.0, 4.0, 6.55, 20.0])
def test_groups_exemptions_and_leakage_are_those_of_brute_force(level):
    rng = np.random.default_rng((50, int(10 * level)))
    for count in (1, 2, 3, 12, 40):
        for scale, correlation in ((0.01, 0.0), (0.5, 0.0), (0.5, -0.62), (2.0, 0.0), (1.0, 0.4)):
            sigma = rng.uniform(0.5, 3)
            magnitude = sigma * scale * rng.exponential(level, count)
            for floor in (0.0, 0.1, 1.0):
                run = magnitude, sigma, level * sigma, floor, correlation
                (peak, exempt, leakage), (best, excluded, chance) = (
                    assess(*run),
                    by_brute_force(*run),
                )
                assert (peak, exempt) == (best, excluded)
                # Runs of bins that all cross with less than 1e-9 join nothing.
                assert leakage == pytest.approx(chance, rel=1e-8, abs=1e-300)


def test_the_first_of_equal_peaks_is_the_detection_and_a_threshold_met_is_crossed():
    assert assess(np.array([5.0, 0, 0, 5.0, 0, 0]), 1.0, 5.0, 0.0)[:2] == (0, {0, 1, 2, 3, 4})
    assert assess(np.array([5.0, 0, 0, 4.999, 0, 0]), 1.0, 5.0, 0.0)[:2] == (0, {0, 1})


@pytest.mark.parametrize(
    "window", ["hamming", "rectangular", pytest.param("flattop", marks=pytest.mark.slow)]
)
def test_evaluate_reports_what_brute_force_finds_in_the_truths_spectrum(window, table_4_1):
    scenes = (
        {"range": 30.0, "grazing_angle": 0.9}, {"range": 300.0, "grazing_angle": 0.1},
        {"range": 2500.0, "grazing_angle": 1.5}, {"range": 700.0, "architecture": "direct"},
    )  # fmt: skip
    for changes in scenes:
        scene = table_4_1(
            fft_size=1024, tnr=4.0, beamlets=19, leakage_floor=0.0, window=window,
            beam_divergence=1e-3, **changes,
        )  # fmt: skip
        shots, results = prepare_single_category(scene), evaluation.evaluate(scene)
        sigma, level = float(shots.bin_noise_sigma[0]), float(shots.threshold[0])
        pfa, alarms = np.exp(-0.5 * (level / sigma) ** 2), {}
        for segment, name in ((0, "up"), (2, "down")):
            exact = time_domain_truth.time_domain_spectrum(shots, 0, segment, with_range_walk=False)
            near = sidelobe_neighbour_noise_correlation(shots.window, shots.fft_size)
            peak, excluded, leakage = by_brute_force(exact, sigma, level, 0.0, near)
            assert results[f"snr_{name}"][0] == pytest.approx(
                exact[peak] ** 2 / (2 * sigma**2), rel=1e-8
            )
            assert results[f"p_leakage_{name}"][0] == pytest.approx(leakage, rel=1e-6, abs=1e-15)
            alarms[name] = 1 - (1 - pfa) ** max(512 - len(excluded), 0)
        assert results["pfa_segment"][0] == pytest.approx(alarms["up"], rel=1e-10)
        assert results["pfa_both_chirps"][0] == pytest.approx(
            alarms["up"] * alarms["down"], rel=1e-10
        )


@pytest.mark.parametrize("tnr", [1e-3, 0.1, 1.0, 5.0, 12.0, 60.0, 1e3])
@pytest.mark.parametrize("chance", [0.05, 5e-4, 5e-7, 1e-12])
def test_bins_below_the_floor_leak_no_more_together_than_is_allowed(tnr, chance):
    level, bins = threshold_from_tnr(tnr=tnr, bin_deviation=1.0), 2**15 + 1
    floor = negligible_signal_ratio(
        leakage_probability=np.array(chance), threshold_ratio=np.array(level), n_bins=bins
    )
    excess = marcum_q1_excess(float(floor), level) / -math.expm1(-0.5 * level * level)
    assert bins * excess <= chance * (1 + 1e-9)
    # and are no fewer than that asks for, but for those near the threshold
    assert bins * excess >= 0.8 * chance or floor == pytest.approx(1 / level)


@pytest.mark.parametrize("tolerance", [1e-1, 1e-3, 1e-5])
def test_bins_taken_one_by_one_leak_to_within_the_tolerance(table_4_1, tolerance):
    """Many faint bins near a low threshold: below 0.1 sigma they leak 0.1 in some of these."""
    scene = table_4_1(range=np.geomspace(200, 3000, 12), tnr=1.0, leakage_floor=SET_BY_TOLERANCE)
    scene |= {"accuracy.tolerance": tolerance, "accuracy.leakage_error": SET_BY_TOLERANCE}
    one_by_one = partial(evaluation.evaluate_segments, bin_by_bin=True)
    every = evaluation.evaluate(
        scene | {"accuracy.leakage_floor": 0.0}, segment_evaluator=one_by_one
    )
    statistics = evaluation.evaluate(scene, segment_evaluator=one_by_one)
    for name in ("p_leakage_up", "p_leakage_down"):
        assert statistics[name] == pytest.approx(every[name], abs=tolerance / 2), name
    fixed = evaluation.evaluate(
        scene | {"accuracy.leakage_floor": 0.1}, segment_evaluator=one_by_one
    )
    assert (every["p_leakage_up"] - fixed["p_leakage_up"]).max() > 0.05


# White Gaussian noise on the samples of the truth

DRAWS = 16_000
"""5 sigma of a proportion near 1/2 is 0.02: an error of 2 % in pd is caught."""


def within_five_sigma(rate, probability, draws):
    return abs(rate - probability) <= 5 * np.sqrt(probability * (1 - probability) / draws)


@pytest.mark.parametrize("window", ["rectangular", "hamming"])
def test_noise_on_the_samples_detects_and_alarms_as_often_as_said(window, table_4_1):
    scene = table_4_1(fft_size=256, beamlets=3, tnr=3.0, window=window, range=1800.0)
    shots, results = prepare_single_category(scene), evaluation.evaluate(scene)
    record = sum(
        time_domain_truth.beamlet_analytic_signal(shots, 0, 0, b, with_range_walk=False).real
        for b in range(3)
    )
    rng = np.random.default_rng(51)
    noise = rng.normal(scale=np.sqrt(shots.noise_variance[0]), size=(DRAWS, 256))
    signal = segment_spectrum(shots, 0, 0)[1]
    magnitude = np.abs(np.fft.rfft(window_samples(window, 256) * (record + noise), axis=1))
    peak, level, sigma = signal.argmax(), shots.threshold[0], shots.bin_noise_sigma[0]
    assert 0.2 < results["pd_up"][0] < 0.8
    detected = (magnitude[:, peak] >= level).mean()
    assert within_five_sigma(detected, results["pd_up"][0], DRAWS)
    # Every bin by its own signal; DC and Nyquist, real, are no Rice variables.
    for k in range(1, 128):
        rate = (magnitude[:, k] >= level).mean()
        assert within_five_sigma(rate, float(marcum_q1(signal[k] / sigma, level / sigma).q), DRAWS)
