"""Beamlets: moments of the beam for any number, and where each of them meets the plane."""

import numpy as np
import pytest

from sweep.model.beamlets import place_beamlets, plane_footprint


@pytest.mark.parametrize("pattern", ["hexagonal", "sunflower"])
def test_any_number_of_beamlets_keeps_power_and_pointing_and_size(pattern):
    """Mean 0, covariance the identity (from three on), weights that sum to 1."""
    for number in range(1, 401):
        offsets, weights = place_beamlets(number, pattern)
        assert offsets.shape == (2, number) and weights.shape == (number,)
        assert (weights > 0).all()
        assert weights.sum() == pytest.approx(1.0, abs=4e-16 * number)
        assert np.abs(offsets @ weights).max() < 1e-14
        if number > 2:
            covariance = (offsets * weights) @ offsets.T
            assert np.abs(covariance - np.eye(2)).max() < 1e-13, number


def test_one_beamlet_is_the_beams_axis_and_two_lie_along_the_slope():
    offsets, weights = place_beamlets(1)
    assert np.array_equal(offsets, [[0.0], [0.0]]) and np.array_equal(weights, [1.0])
    offsets, weights = place_beamlets(2)
    assert (offsets[1] ** 2 @ weights, offsets[0] ** 2 @ weights) == (1.0, 0.0)


def test_a_sunflower_has_no_rows_for_the_phases_of_a_smooth_plane_to_step_along():
    """Sum of sqrt(w) e^{i K y} over a steep ramp of phase: random-like, where a lattice is nothing.

    Independent phases would give a mean square of 1 (the weights' sum).
    """
    steepness = np.linspace(20.0, 400.0, 4000)[:, None]
    median = {}
    for pattern in ("hexagonal", "sunflower"):
        offsets, weights = place_beamlets(109, pattern)
        power = np.abs(np.exp(1j * steepness * offsets[1]) @ np.sqrt(weights)) ** 2
        median[pattern] = np.median(power)
    # An exponential's median is ln 2 = 0.69 of its mean.
    assert median["sunflower"] == pytest.approx(np.log(2), rel=0.15)
    assert median["hexagonal"] < 0.7 * median["sunflower"]


def test_a_full_lattice_of_109_is_the_thesiss_hexagon_about_its_centre():
    """[T 3.3.1]: its 109 points are whole shells, hence the pattern equals its own mirror image."""
    offsets, weights = place_beamlets(109)
    points = {(round(x, 9) + 0.0, round(y, 9) + 0.0) for x, y in offsets.T}
    assert points == {(-x + 0.0, -y + 0.0) for x, y in points}
    assert weights.argmax() == np.hypot(*offsets).argmin()
    assert np.hypot(*offsets).min() < 1e-14


@pytest.mark.parametrize("pattern", ["hexagonal", "sunflower"])
def test_many_beamlets_have_the_beams_gaussian_profile(pattern):
    """The beam of 2 exp(-2 r^2 / w^2), w = 2 standard deviations, cut at a radius r.

    The cut takes r^2/2 e^{-r^2/2} / (1 - e^{-r^2/2}) of the variance, 5.06 % for r = 3, which
    the mapping puts back, so the profile is wider by the square root of that; 1/e^2 radii hold
    86.5 % of the power.
    """
    cut = {"hexagonal": np.sqrt(9 + 2.9 * np.log(4001 / 19)), "sunflower": 3.0}[pattern]
    lost = cut**2 / 2 / np.expm1(cut**2 / 2)
    offsets, weights = place_beamlets(4001, pattern)
    radius = np.hypot(*offsets)
    slope = np.polyfit(radius**2, np.log(weights), 1)[0]
    assert slope == pytest.approx(-0.5 * (1 - lost), rel=0.003)
    assert weights[radius < 2].sum() == pytest.approx(0.865, abs=0.012)
    assert radius.max() == pytest.approx(cut / np.sqrt(1 - lost), rel=0.02)


def footprint(grazing_angle, divergence, number):
    offset, cos_incidence, weights, _ = plane_footprint(
        grazing_angle=np.atleast_1d(grazing_angle), beam_divergence=np.atleast_1d(divergence),
        n_beamlets=number,
    )  # fmt: skip
    return offset[0], cos_incidence[0], weights[0]


def test_a_beam_wider_than_its_grazing_angle_loses_what_passes_over_the_horizon():
    """Axis one standard deviation below the horizon: the Gaussian keeps Phi(1) = 84 % of it."""
    _, cos_incidence, weights = footprint(1e-3, 4e-3, 4001)
    lost = weights == 0.0
    assert np.array_equal(lost, cos_incidence == 0.0)
    assert weights.sum() == pytest.approx(0.8413, abs=0.012)


@pytest.mark.parametrize("degrees", [1.0, 15.0, 45.0, 85.0])
@pytest.mark.parametrize("number", [7, 19, 109])
def test_the_range_spread_is_the_beams_projected_on_the_slope(degrees, number):
    """Gaussian continuum on a plane: standard deviation (div/4) cot(grazing) per unit of range."""
    divergence = 1e-6
    offset, _, weights = footprint(np.radians(degrees), divergence, number)
    mean = offset @ weights
    spread = np.sqrt((offset - mean) ** 2 @ weights)
    slope = divergence / 4 / np.tan(np.radians(degrees))
    # Next come terms of the slope times the pattern's skewness, which whole shells do not have.
    assert spread == pytest.approx(slope, rel=3 * slope + 1e-9)
    # Rays off the axis are longer, and far ones are longer by more than near ones are shorter.
    assert mean == pytest.approx((divergence / 4) ** 2 + slope**2, rel=3 * slope + 1e-6, abs=1e-20)
