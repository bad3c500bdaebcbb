import math

import numpy as np
import pytest

from sweep.scenes import terrain as relief

FIVE_SIGMA = 5.0


def surfaces(number, **parameters):
    return np.stack(
        [relief.fractal(np.random.default_rng(seed), **parameters) for seed in range(number)]
    )


@pytest.mark.parametrize("hurst", [0.2, 0.5, 0.75, 0.8, 0.95])
def test_differences_of_height_follow_the_power_law_at_every_distance_and_direction(hurst):
    """From one step to the grid's diagonal: single pairs of nodes over many surfaces.

    Each surface gives one normal number a pair, so that the mean square over n of them has a
    relative standard deviation of sqrt(2/n).
    """
    number, dx, dy = 600, 0.5, 2.0
    z = surfaces(number, shape=(24, 80), spacing=(dx, dy), hurst=hurst, rms_slope=0.2, baseline=3.0)
    ends = [(0, 0, 0, 1), (0, 0, 1, 0), (5, 70, 5, 30), (2, 3, 20, 9), (23, 0, 0, 79)]
    for i, j, k, m in ends:
        length = math.hypot((i - k) * dy, (j - m) * dx)
        expected = (0.2 * 3.0 * (length / 3.0) ** hurst) ** 2
        found = ((z[:, i, j] - z[:, k, m]) ** 2).mean()
        assert found == pytest.approx(expected, rel=FIVE_SIGMA * math.sqrt(2 / number))


@pytest.mark.parametrize("hurst", [0.05, 0.5, 0.74, 0.76, 0.95, 0.99])
@pytest.mark.parametrize("shape", [(40, 40), (16, 200)])
def test_the_embedding_is_a_covariance(hurst, shape):
    """The spectrum on the torus is not negative, so that nothing was cut off the surface."""
    period, _, covariance = relief._stein(2 * hurst)
    step = 1 / math.hypot(*shape)
    size = relief.fft.next_fast_len(math.ceil(period / step), real=True)
    along = np.minimum(np.arange(size), size - np.arange(size)) * step
    power = np.fft.fft2(covariance(np.hypot(along[:, None], along))).real
    assert -power[power < 0].sum() <= 1e-9 * power.sum()


def test_opposite_edges_have_nothing_to_do_with_each_other():
    """On a torus the first and last column would be neighbours."""
    z = surfaces(300, shape=(8, 64), spacing=(1, 1), hurst=0.8, rms_slope=1.0, baseline=1.0)
    across = ((z[:, 0, -1] - z[:, 0, 0]) ** 2).mean()
    assert across > 0.5 * 63**1.6


def test_the_same_seed_gives_the_same_ground_and_another_seed_another():
    parameters = {
        "shape": (20, 30), "spacing": (1.0, -1.0), "hurst": 0.7, "rms_slope": 0.1, "baseline": 5.0,
    }  # fmt: skip
    once, again, other = (
        relief.fractal(np.random.default_rng(seed), **parameters) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(once, again)
    assert once.shape == (20, 30) and np.abs(once - other).max() > 0.1


def test_the_ground_scales_with_its_slope():
    parameters = {"shape": (9, 9), "spacing": (1.0, 1.0), "hurst": 0.6, "baseline": 2.0}
    gentle = relief.fractal(np.random.default_rng(3), rms_slope=0.1, **parameters)
    steep = relief.fractal(np.random.default_rng(3), rms_slope=0.3, **parameters)
    np.testing.assert_allclose(steep, 3 * gentle, rtol=1e-12)


def test_hills_have_the_height_slope_and_correlation_they_were_asked_for():
    """Ensembles of two nodes far apart and of one step, against the Gaussian covariance."""
    number, rms, length = 800, 4.0, 10.0
    z = np.stack(
        [
            relief.hills(
                np.random.default_rng(seed),
                shape=(12, 40),
                spacing=(1.0, 1.0),
                rms_height=rms,
                correlation_length=length,
            )
            for seed in range(number)
        ]
    )
    relative = FIVE_SIGMA * math.sqrt(2 / number)
    assert (z[:, 5, 20] ** 2).mean() == pytest.approx(rms**2, rel=relative)
    slope = (z[:, 5, 21] - z[:, 5, 19]) / 2
    # The difference over two steps of 0.1 correlation lengths falls 1 % short of the slope.
    assert (slope**2).mean() == pytest.approx(2 * rms**2 / length**2, rel=relative + 0.02)
    covariance = (z[:, 5, 20] * z[:, 5, 30]).mean()
    spread = rms**2 * math.sqrt((1 + math.exp(-2)) / number)
    assert covariance == pytest.approx(rms**2 * math.exp(-1), abs=FIVE_SIGMA * spread)


@pytest.mark.parametrize("wrong", [{"hurst": 1.0}, {"hurst": 0.0}, {"rms_slope": -1}])
def test_relief_that_can_not_be_is_refused(wrong):
    good = {"shape": (5, 5), "spacing": (1, 1), "hurst": 0.5, "rms_slope": 0.1, "baseline": 1.0}
    with pytest.raises(ValueError, match="relief needs"):
        relief.fractal(np.random.default_rng(1), **good | wrong)


def test_hills_finer_than_the_grid_are_refused():
    with pytest.raises(ValueError, match="three grid steps"):
        relief.hills(
            np.random.default_rng(1),
            shape=(5, 5),
            spacing=(1.0, 1.0),
            rms_height=1.0,
            correlation_length=2.0,
        )
