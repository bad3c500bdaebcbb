"""Extinction along slant paths: closed forms, integrals by another rule, published visibilities."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from sweep.model.effects.atmosphere import (
    EXTINCTION_PROFILES,
    ExtinctionProfile,
    exponential_profile,
    extinction_from_visibility,
    layer_profile,
    optical_depth,
)

HEIGHT = st.floats(0, 20e3)


@given(HEIGHT, HEIGHT, st.floats(1, 3), st.floats(200, 20e3))
def test_slant_paths_through_an_exponential_atmosphere(start, end, stretch, scale):
    """alpha_0 H (e^(-h0/H) - e^(-h1/H)) R / (h1 - h0); a level path has alpha(h) R."""
    profile = exponential_profile(surface_extinction=3e-4, scale_height=scale)
    length = stretch * max(abs(end - start), 1.0)
    depth = optical_depth(profile, start_height=start, end_height=end, range=length)
    x = (end - start) / scale
    mean = 3e-4 * np.exp(-start / scale) * (-np.expm1(-x) / x if x else 1.0)
    # Heights are known to 2e-12 m; 40 scale heights are kept, e^-40 of 3e-4/m.
    assert depth == pytest.approx(mean * length, rel=1e-10, abs=1e-20 * length)


def test_a_table_with_a_step_a_gap_and_an_end_is_integrated_row_by_row():
    profile = ExtinctionProfile(
        (0.0, 100.0, 100.0, 400.0, 600.0, 900.0), (2e-4, 1e-4, 5e-5, 0.0, 0.0, 3e-5)
    )

    def local(h):
        if h >= 900:
            return 0.0
        if h >= 600:
            return 3e-5 * (h - 600) / 300
        if h >= 400:
            return 0.0
        if h >= 100:
            return 5e-5 * (400 - h) / 300
        return 2e-4 * 0.5 ** (max(h, 0.0) / 100)

    rng = np.random.default_rng(2)
    for start, end in rng.uniform(-50, 1200, (40, 2)):
        length = 1.7 * abs(end - start)
        mean, _ = quad(
            lambda u, a=start, b=end: local(a + (b - a) * u), 0, 1, limit=500,
            points=np.clip([(h - start) / (end - start) for h in (0, 100, 400, 600, 900)], 0, 1),
        )  # fmt: skip
        depth = optical_depth(profile, start_height=start, end_height=end, range=length)
        assert depth == pytest.approx(mean * length, rel=1e-9, abs=1e-18)
        back = optical_depth(profile, start_height=end, end_height=start, range=length)
        assert back == depth


@pytest.mark.parametrize(
    "visibility, decibels", [(50, 340), (200, 85), (500, 34), (1e3, 10), (2e3, 4), (4e3, 2),
                             (10e3, 0.4), (23e3, 0.2)],
)  # fmt: skip
def test_attenuation_at_1550_nm_is_that_published_for_the_visibility(visibility, decibels):
    """dB/km of Kim, McArthur and Korevaar's table (2001), which prints one or two digits."""
    extinction = extinction_from_visibility(visibility=visibility, wavelength=1550e-9)
    attenuation = 10 * np.log10(np.e) * extinction * 1e3
    digit = 10.0 if decibels > 50 else 10 ** np.floor(np.log10(decibels))
    assert abs(attenuation - decibels) <= max(0.5 * digit, 0.005 * decibels)


def test_visibility_is_where_green_contrast_falls_to_two_percent():
    coefficient = extinction_from_visibility(visibility=7e3, wavelength=0.55e-6)
    assert np.exp(-coefficient * 7e3) == pytest.approx(0.02, rel=1e-12)


def test_the_tables_have_their_optical_depths():
    """Seen from straight above; the Mars of usual seasons lets 61 % of sunlight through."""
    for name, depth in (("mars_clear", 0.5), ("mars_dusty", 1.0), ("mars_storm", 5.0),
                        ("earth_clear", 0.0530), ("earth_haze", 0.289)):  # fmt: skip
        optical_depths = optical_depth(
            EXTINCTION_PROFILES[name], start_height=0.0, end_height=4e5, range=4e5
        )
        assert optical_depths == pytest.approx(depth, rel=5e-3), name
    dust = layer_profile(optical_depth=1.2, depth=30.0)
    sight_lines = [
        (1000.0, 0.0, 1000.0),
        (15.0, 0.0, 15.0),
        (10.0, 10.0, 50.0),
        (1000.0, 40.0, 2000.0),
    ]
    depths = [optical_depth(dust, start_height=a, end_height=b, range=r) for a, b, r in sight_lines]
    assert depths == pytest.approx([1.2, 0.6, 2.0, 0.0], rel=1e-12)


def test_paths_are_worked_out_together_as_one_by_one():
    start = np.linspace(0, 9e3, 7)[:, None]
    end = np.linspace(0, 2e3, 5)
    profile = EXTINCTION_PROFILES["earth_haze"]
    table = optical_depth(profile, start_height=start, end_height=end, range=1e4)
    for i, j in np.ndindex(table.shape):
        one = optical_depth(profile, start_height=start[i, 0], end_height=end[j], range=1e4)
        assert table[i, j] == one


@pytest.mark.parametrize("height", [1e15, -1e15, 1e25])
def test_paths_so_high_that_float64_knows_no_difference_have_a_depth(height):
    depth = optical_depth(
        EXTINCTION_PROFILES["earth_haze"], start_height=height, end_height=height + 1e-3, range=10.0
    )
    assert depth == pytest.approx(
        0.0 if height > 0 else EXTINCTION_PROFILES["earth_haze"].extinction[0] * 10
    )
