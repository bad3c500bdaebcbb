import mpmath
import numpy as np
import pytest

from sweep.model.detection import noise_false_alarms


def shot_probability(tnr, bins):
    in_a_bin = np.asarray(noise_false_alarms.bin_pfa(tnr))
    return float(noise_false_alarms.segment_pfa(in_a_bin, bins)) ** 2


@pytest.mark.parametrize("tnr", [1.0, 5.0, 10.0, 15.0])
def test_a_bin_of_noise_crosses_as_often_as_a_rayleigh_magnitude_exceeds_its_deviations(tnr):
    # integral of the Rayleigh density beyond TNR standard deviations, sigma = 1
    with mpmath.workdps(40):
        deviation = mpmath.sqrt(2 - mpmath.pi / 2)
        ends = [tnr * deviation + step for step in (0, 1, 2, 4, 8, 16)]  # nothing beyond
        tail = mpmath.quad(lambda r: r * mpmath.exp(-r * r / 2), ends)
    assert noise_false_alarms.bin_pfa(tnr) == pytest.approx(float(tail), rel=1e-13)


@pytest.mark.parametrize("bins", [2**16, 2**17, 2**18])
def test_a_shot_is_the_complement_of_silence_in_both_segments(bins):
    with mpmath.workdps(50):
        p = mpmath.exp(-(4 - mpmath.pi) / 4 * 100)
        expected = float((1 - (1 - p) ** bins) ** 2)
    assert shot_probability(10.0, bins) == pytest.approx(expected, rel=1e-13)


def test_the_published_instrument_gives_3_93e_9_and_doubling_its_bins_quadruples_it():
    one = shot_probability(10.0, 2**17)
    assert one == pytest.approx(3.93e-9, rel=2e-3)
    # to first order in N p = 6e-5
    assert shot_probability(10.0, 2**18) / one == pytest.approx(4.0, rel=1e-4)


@pytest.mark.parametrize("excess", [-0.01, 0.0, 1e-6, 0.0018, 0.05])
@pytest.mark.parametrize("tnr", [5.0, 10.0])
def test_the_implied_excess_is_the_one_that_made_the_figure(excess, tnr):
    # noise of 1 + e times the variance against a threshold that was set without it
    with mpmath.workdps(50):
        p = mpmath.exp(-(4 - mpmath.pi) / 4 * mpmath.mpf(tnr) ** 2 / (1 + mpmath.mpf(excess)))
        of_bin, of_shot = float(p), float((1 - (1 - p) ** 131072) ** 2)
    # a relative error of 1e-16 in the figure moves e by (1 + e)^2 / x / 2 of that; where all
    # but certain (TNR 5), the figure itself holds no more digits
    assert noise_false_alarms.variance_excess_from_bin_pfa(of_bin, tnr) == pytest.approx(
        excess, abs=1e-14
    )
    if of_shot < 0.5:
        implied_excess = noise_false_alarms.variance_excess_from_shot_pfa(of_shot, tnr, 131072)
        assert implied_excess == pytest.approx(excess, abs=1e-14)


@pytest.mark.parametrize("figure", [0.0, 1.0, float("nan")])
def test_no_excess_makes_a_figure_of_nothing_or_of_certainty(figure):
    assert np.isnan(noise_false_alarms.variance_excess_from_shot_pfa(figure, 10.0, 131072))
    assert np.isnan(noise_false_alarms.variance_excess_from_bin_pfa(figure, 10.0))
