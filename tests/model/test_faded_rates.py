"""Leakage in developed speckle: rates from a table, against direct sums over bins and powers."""

import numpy as np
import pytest

from sweep.model.detection import echo_detection
from sweep.model.detection.added_crossings import (
    SERIES_TERMS_MAX,
    any_crossing_probability,
    exclude_crossings_joining_echo,
    fill_crossing_series,
)
from sweep.model.detection.marcum import marcum_q1, marcum_q1_excess
from sweep.model.detection.speckle_crossing_rates import (
    N_SPECKLE_OCTAVES,
    N_SPECKLE_POWERS,
    POWERS_PER_OCTAVE_MAX,
    SPECKLE_POWER_MAX,
    TABULATED_SPECKLE_POWERS,
    add_entry_weights_of_bin,
    add_rates_by_speckle_power,
    add_rates_from_entry_weights,
    n_entry_weights,
    tabulate_crossing_rates,
)
from sweep.model.spectrum import leakage
from sweep.model.spectrum.bin_spectrum import SpanArrays

CERTAIN = 25.0
"""Rate from which on only it matters that bins cross."""


def table_of(level):
    series = np.empty(SERIES_TERMS_MAX)
    fill_crossing_series(level, series)
    return tabulate_crossing_rates(level, series)


def direct_rates(amplitude, level):
    """Rates -ln(1 - c) of amplitudes, with the digits of the smaller of c and 1 - c."""
    quiet = -np.expm1(-(level**2) / 2)
    c = np.array([marcum_q1_excess(a, level) for a in amplitude]) / quiet
    stays = np.maximum(marcum_q1(amplitude, np.array(level)).p / quiet, 1e-300)
    return np.where(c < 0.5, -np.log1p(-np.minimum(c, 0.9)), -np.log(stays))


@pytest.mark.parametrize("level", [1.5, 4.0, 6.55, 9.0, 14.0, 35.0])
def test_tabulated_rates_are_those_of_a_bin_at_each_speckle_power(level):
    table = table_of(level)
    for amplitude in np.exp(np.linspace(np.log(1e-4), np.log(level + 20), 300)):
        sums = np.zeros(N_SPECKLE_POWERS)
        add_rates_by_speckle_power(amplitude**2, 1.0, table, sums)
        rates_per_power = sums * TABULATED_SPECKLE_POWERS
        faded = amplitude * np.sqrt(TABULATED_SPECKLE_POWERS)
        expected = direct_rates(faded, level)
        sound = expected < CERTAIN
        np.testing.assert_allclose(rates_per_power[sound], expected[sound], rtol=2e-5, atol=1e-14)
        assert (rates_per_power[~sound] > 0.9 * CERTAIN).all()


@pytest.mark.parametrize("level", [1.5, 6.55, 35.0])
def test_sums_by_table_entry_are_the_sums_bin_by_bin(level):
    table, rng = table_of(level), np.random.default_rng(11)
    amplitudes = np.exp(rng.uniform(np.log(1e-7), np.log(level + 60), 500))
    one_by_one, by_entry = np.zeros(N_SPECKLE_POWERS), np.zeros(N_SPECKLE_POWERS)
    entry_weights = np.zeros(n_entry_weights(table))
    for amplitude in amplitudes:
        add_rates_by_speckle_power(amplitude**2, 1.0, table, one_by_one)
        add_entry_weights_of_bin(amplitude**2, table, entry_weights)
    add_rates_from_entry_weights(entry_weights, table, by_entry)
    np.testing.assert_allclose(by_entry, one_by_one, rtol=1e-12)
    # Polynomials reproduce constants: the weights of a bin sum to its squared amplitude.
    np.testing.assert_allclose(entry_weights.sum(), (amplitudes**2).sum(), rtol=1e-12)


def run_at_random(seed, level):
    """|X| / sigma of a run of bins with one or two echoes, and the bins exempt from alarms."""
    rng = np.random.default_rng(seed)
    k, peak = np.arange(70), np.exp(rng.uniform(np.log(level), np.log(400 * level)))
    place, other = rng.uniform(15, 50), rng.uniform(15, 50)
    signal = peak * np.exp(-(((k - place) / 1.1) ** 2))
    signal += 0.5 * peak * np.exp(-(((k - other) / 1.1) ** 2)) * rng.integers(0, 2)
    sidelobes = peak * 10 ** rng.uniform(-3.5, -1.5) / (1 + 0.2 * np.abs(k - place))
    magnitude = np.hypot(signal, np.minimum(sidelobes, 0.9 * level) * rng.uniform(0.5, 1, k.size))
    exempt = np.zeros(k.size, bool)
    for i in np.flatnonzero(magnitude >= level):
        exempt[max(i - 1, 0) : i + 2] = True
    exempt[magnitude.argmax()] = True
    return magnitude, exempt


@pytest.mark.parametrize("seed", range(24))
def test_mean_leakage_is_that_of_direct_sums_at_each_speckle_power(seed):
    level, correlation = float([4.5, 6.55, 9.0][seed % 3]), [-0.5, 0.0, 0.6][seed % 2]
    magnitude, exempt = run_at_random(seed, level)
    span = SpanArrays(magnitude.copy(), exempt, *np.zeros((2, magnitude.size + 8)))
    limits = leakage.LeakageInputs(1.0, level, 0.0, correlation)
    mean_by_table = leakage.false_peak_probability_of_bins_in_speckle(
        np.int64(magnitude.size), limits, 0.0, span, table_of(level)
    )

    def log_rates(per_octave):
        mean_leakage = []
        for k in range(per_octave * N_SPECKLE_OCTAVES + 1):
            root = np.sqrt(SPECKLE_POWER_MAX * 2.0 ** (-k / per_octave))
            chances = np.where(exempt, 0.0, -np.expm1(-direct_rates(root * magnitude, level)))
            brightest = any_crossing_probability(chances, 0, chances.size)
            exclude_crossings_joining_echo(
                chances, 0, chances.size, magnitude, exempt, 1.0 / root, level / root, correlation
            )
            rate = -np.log1p(-min(any_crossing_probability(chances, 0, chances.size), 1 - 1e-15))
            mean_leakage.append((np.log(max(rate, leakage.LEAKAGE_RATE_MIN)), brightest))
        return np.array([f[0] for f in mean_leakage]), mean_leakage[0][1]

    of_octaves, brightest = log_rates(1)
    per_octave = 1
    if brightest > leakage.OCTAVE_STEP_LEAKAGE_MAX:
        per_octave, (of_octaves, _) = POWERS_PER_OCTAVE_MAX, log_rates(POWERS_PER_OCTAVE_MAX)
    expected = leakage.mean_leakage_from_log_rates(of_octaves, per_octave)
    assert mean_by_table == pytest.approx(expected, rel=5e-5, abs=1e-13)


@pytest.mark.parametrize("seed", range(12))
def test_bins_that_are_left_out_of_an_echo_change_nothing(seed):
    """The mean over the strongest mode, against its quadrature with all bins at all nodes."""
    rng = np.random.default_rng(seed)
    bins, echo = 9, np.ones(9, bool)
    steady = np.zeros((4, bins))
    peak = np.exp(rng.uniform(np.log(0.5), np.log(300.0)))
    steady[0] = peak * np.exp(-(((np.arange(bins) - rng.uniform(3, 5)) / rng.uniform(0.7, 3)) ** 2))
    steady[1] = rng.uniform(3.0, 9.0) * rng.uniform(0.7, 1.0, bins)
    steady[2, 1:] = rng.uniform(-0.6, 0.6, bins - 1)
    bins_given_mode = echo_detection.BinsGivenMode(*steady, np.zeros(bins))
    run = echo_detection.EchoBins(steady[0], echo, 100)
    expected = echo_detection._mean_pd_and_miss_over_mode_power(bins_given_mode, run, False, 1024)

    ratio = steady[1] / steady[0]
    first = np.min(np.maximum(steady[1] - echo_detection._IMPOSSIBLE_BELOW_SIGMA, 0.0) / steady[0])
    last = min(
        np.min((steady[1] + echo_detection._CERTAIN_ABOVE_SIGMA) / steady[0]),
        echo_detection._SPECKLE_MODE_MAGNITUDE_MAX,
    )
    first, last = (min(v, echo_detection._SPECKLE_MODE_MAGNITUDE_MAX) for v in (first, last))
    last = min(
        last, np.sqrt(min(ratio.min(), echo_detection._SPECKLE_MODE_MAGNITUDE_MAX) ** 2 + 10.0)
    )
    z = first + (last - first) * 0.5 * (echo_detection._GAUSS_NODES + 1)
    weight = 0.5 * (last - first) * echo_detection._GAUSS_WEIGHTS * 2 * z * np.exp(-z * z)
    z, weight = np.append(0.6 * first, z), np.append(-np.expm1(-first * first), weight)
    of_nodes = [
        echo_detection._pd_and_miss_given_mode(bins_given_mode, one, run, False, 1024, np.inf, 0.0)
        for one in z
    ]
    pd, missed = (weight * np.array(of_nodes).T).sum(axis=1)
    pd += np.exp(-last * last)
    total = pd + missed
    # 7 nodes leave out up to 8 bins each: 56, if each were as large as may be neglected.
    relative = 30 * echo_detection._NEGLIGIBLE_FRACTION
    assert expected[0] == pytest.approx(pd / total, rel=relative, abs=0)
    assert expected[1] == pytest.approx(missed / total, rel=relative, abs=0)
    assert expected[0] == pytest.approx(pd / total, abs=30 * echo_detection._NEGLIGIBLE_PROBABILITY)
