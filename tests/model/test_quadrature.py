"""Few nodes for the mean over a Gaussian: moments, and power over bins against the continuum."""

from itertools import pairwise

import numpy as np
import pytest

from sweep.model.accuracy import Accuracy
from sweep.model.footprint import beamlets, gaussian_rule
from sweep.model.resolution import COUNTS, Spread, nodes_needed
from sweep.model.window import samples

MOST = Accuracy.most_beamlets

LENGTH = 128
WINDOWS = ("hamming", "hann", "rectangular", "blackman", "flattop", "kaiser(8.6)")


def needed(window, deviation, tolerance, curve=0.0):
    """Lines, nodes and error where all segments are alike."""
    s, tolerance = np.broadcast_arrays(deviation, np.asarray(tolerance, float))
    c = np.broadcast_to(curve, s.shape)
    return nodes_needed(window, Spread(s + 10 * c, s[None], c[None]), tolerance, Accuracy())


def power_of_bins(window, offset, deviation, rule):
    """Mean of |W|^2 over a spread of lines, by the window's autocorrelation; rule or continuum."""
    w = samples(window, LENGTH)
    lag = np.arange(-LENGTH + 1, LENGTH)
    r = np.correlate(w, w, "full")
    turn = 2 * np.pi * deviation * lag / LENGTH
    if rule is None:
        mean = np.exp(-(turn**2) / 2)
    else:
        nodes, weights = rule
        mean = (weights * np.exp(1j * turn[:, None] * nodes)).sum(axis=1).real
    bins = np.arange(-20, 21) + offset
    return (r * mean * np.cos(2 * np.pi * bins[:, None] * lag / LENGTH)).sum(axis=1) / w.sum() ** 2


@pytest.mark.parametrize("window", WINDOWS)
def test_power_is_within_the_tolerance_of_the_continuum_wherever_lines_lie(window):
    counts = []
    for deviation in np.geomspace(2e-3, 12.0, 25):
        for tolerance in (1e-1, 1e-3, 1e-6):
            lines, number, error = needed(window, np.array([deviation]), tolerance)
            assert error[0] <= tolerance and lines[0] == 1
            counts.append(number[0])
            for offset in (0.0, 0.3, 0.5):
                exact = power_of_bins(window, offset, deviation, None)
                found = power_of_bins(window, offset, deviation, gaussian_rule(int(number[0])))
                assert abs(found - exact).max() <= tolerance * exact.max() + 1e-13
    assert min(counts) == 2 and max(counts) > 100


def test_narrow_spreads_need_few_nodes_and_more_accuracy_costs_few_more():
    tolerance = np.array([1e-1, 1e-3, 1e-6])
    _, number, _ = needed("hamming", np.full(3, 0.25), tolerance)
    assert (number <= [3, 5, 7]).all()
    _, wide, _ = needed("hamming", np.full(3, 5.0), tolerance)
    assert wide[2] <= 1.5 * wide[0] + 1


@pytest.mark.parametrize("window", ["hamming", "rectangular", "flattop"])
def test_lines_across_the_slope_are_within_the_tolerance_of_the_continuum(window):
    """Of s y + c (x^2 + y^2), by its own transform: over x and y by Gaussian integrals."""
    rng, w = np.random.default_rng(17), samples(window, LENGTH)
    lag = np.arange(-LENGTH + 1, LENGTH)
    turn, r = 2 * np.pi * lag / LENGTH, np.correlate(w, w, "full")
    bins = np.exp(1j * np.arange(-40, 40.0, 0.5)[:, None] * turn) * r
    several = 0
    for _ in range(60):
        s, c = 10 ** rng.uniform(-2, 1), 10 ** rng.uniform(-5, 0)
        curved = 1 - 2j * turn * c
        exact = (bins * np.exp(-((turn * s) ** 2) / 2 / curved) / curved).sum(axis=1).real
        for tolerance in (1e-2, 1e-4, 1e-6, 0.0):
            (lines,), (number,), (error,) = needed(window, np.array([s]), tolerance, c)
            assert (error <= max(tolerance, 1e-7) or c > 0.03) and lines * number <= MOST
            (x, y), share = beamlets(lines * number, f"{lines} lines")
            mean = (share * np.exp(1j * turn[:, None] * (s * y + c * (x**2 + y**2)))).sum(axis=1)
            found = (bins * mean).sum(axis=1).real
            assert abs(found - exact).max() <= error * exact.max() + 1e-12
            several += lines > 1
    assert several > 60


@pytest.mark.parametrize("window", WINDOWS)
def test_a_tighter_tolerance_never_has_the_larger_error(window):
    rng = np.random.default_rng(18)
    s, c = 10 ** rng.uniform(-3, 3.5, 300), 10 ** rng.uniform(-7, 2, 300)
    found = [needed(window, s, tolerance, c) for tolerance in (1.0, 1e-2, 1e-5, 1e-8, 0.0)]
    for looser, tighter in pairwise(found):
        assert (tighter[2] <= looser[2]).all()


def test_spreads_beyond_what_is_provided_for_take_the_most_and_say_so():
    lines, number, error = needed("hamming", np.array([1e4, 1e6]), 1e-3)
    assert lines.tolist() == [1, 1]
    assert number.tolist() == [COUNTS[-1]] * 2 and error.tolist() == [1.0, 1.0]
