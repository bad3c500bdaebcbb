"""Extinction along slant paths: closed forms, integrals by another rule, published visibilities."""

import numpy as np
import pytest
from effect_points import point_block, scene, shots_of, small, tile_block
from hypothesis import given
from hypothesis import strategies as st
from pd_changes import pd_change
from scipy.integrate import quad

from sweep.model.effects.atmosphere import (
    PROFILES,
    Path,
    Profile,
    depth_over,
    exponential,
    layer,
    optical_depth,
    transmission,
    visibility_extinction,
)
from sweep.model.effects.catalogue import CORE
from sweep.model.effects.extinction import bound, dimming
from sweep.model.effects.span import Span
from sweep.model.marcum import marcum_q1

HEIGHT = st.floats(0, 20e3)


@given(HEIGHT, HEIGHT, st.floats(1, 3), st.floats(200, 20e3))
def test_slant_paths_through_an_exponential_atmosphere(start, end, stretch, scale):
    """alpha_0 H (e^(-h0/H) - e^(-h1/H)) R / (h1 - h0); a level path has alpha(h) R."""
    profile = exponential(surface_extinction=3e-4, scale_height=scale)
    length = stretch * max(abs(end - start), 1.0)
    found = optical_depth(profile, start_height=start, end_height=end, range=length)
    x = (end - start) / scale
    mean = 3e-4 * np.exp(-start / scale) * (-np.expm1(-x) / x if x else 1.0)
    # Heights are known to 2e-12 m; 40 scale heights are kept, e^-40 of 3e-4/m.
    assert found == pytest.approx(mean * length, rel=1e-10, abs=1e-20 * length)


def test_a_table_with_a_step_a_gap_and_an_end_is_integrated_row_by_row():
    profile = Profile((0.0, 100.0, 100.0, 400.0, 600.0, 900.0), (2e-4, 1e-4, 5e-5, 0.0, 0.0, 3e-5))

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
        found = optical_depth(profile, start_height=start, end_height=end, range=length)
        assert found == pytest.approx(mean * length, rel=1e-9, abs=1e-18)
        back = optical_depth(profile, start_height=end, end_height=start, range=length)
        assert back == found


@given(HEIGHT, HEIGHT, st.floats(0, 1))
def test_two_pieces_of_a_path_multiply_to_the_whole(start, end, share):
    middle = start + share * (end - start)
    length = 2 * abs(end - start) + 500
    for profile in PROFILES.values():
        whole = transmission(profile, start_height=start, end_height=end, range=length)
        first = transmission(profile, start_height=start, end_height=middle, range=share * length)
        last = transmission(
            profile, start_height=middle, end_height=end, range=length - share * length
        )
        assert first * last == pytest.approx(whole, rel=1e-6)


@pytest.mark.parametrize(
    "visibility, decibels", [(50, 340), (200, 85), (500, 34), (1e3, 10), (2e3, 4), (4e3, 2),
                             (10e3, 0.4), (23e3, 0.2)],
)  # fmt: skip
def test_attenuation_at_1550_nm_is_that_published_for_the_visibility(visibility, decibels):
    """dB/km of Kim, McArthur and Korevaar's table (2001), which prints one or two digits."""
    extinction = visibility_extinction(visibility=visibility, wavelength=1550e-9)
    found = 10 * np.log10(np.e) * extinction * 1e3
    digit = 10.0 if decibels > 50 else 10 ** np.floor(np.log10(decibels))
    assert abs(found - decibels) <= max(0.5 * digit, 0.005 * decibels)


def test_visibility_is_where_green_contrast_falls_to_two_percent():
    seen = visibility_extinction(visibility=7e3, wavelength=0.55e-6)
    assert np.exp(-seen * 7e3) == pytest.approx(0.02, rel=1e-12)


def test_the_tables_have_their_optical_depths():
    """Seen from straight above; the Mars of usual seasons lets 61 % of sunlight through."""
    for name, depth in (("mars_clear", 0.5), ("mars_dusty", 1.0), ("mars_storm", 5.0),
                        ("earth_clear", 0.0530), ("earth_haze", 0.289)):  # fmt: skip
        found = optical_depth(PROFILES[name], start_height=0.0, end_height=4e5, range=4e5)
        assert found == pytest.approx(depth, rel=5e-3), name
    dust = layer(optical_depth=1.2, depth=30.0)
    seen = [(1000.0, 0.0, 1000.0), (15.0, 0.0, 15.0), (10.0, 10.0, 50.0), (1000.0, 40.0, 2000.0)]
    depths = [optical_depth(dust, start_height=a, end_height=b, range=r) for a, b, r in seen]
    assert depths == pytest.approx([1.2, 0.6, 2.0, 0.0], rel=1e-12)


def test_paths_are_worked_out_together_as_one_by_one():
    start = np.linspace(0, 9e3, 7)[:, None]
    end = np.linspace(0, 2e3, 5)
    profile = PROFILES["earth_haze"]
    table = optical_depth(profile, start_height=start, end_height=end, range=1e4)
    for i, j in np.ndindex(table.shape):
        one = optical_depth(profile, start_height=start[i, 0], end_height=end[j], range=1e4)
        assert table[i, j] == one


@pytest.mark.parametrize("exponent", [1, 2])
def test_no_dimmed_shot_changes_beyond_the_bound(exponent):
    """Echo and sun dimmed by hand; the threshold is set on noise with the sun's light."""
    rng = np.random.default_rng(4)
    n = 500
    depth = 10 ** rng.uniform(-3, 0.5, n)
    profile = exponential(surface_extinction=1e-4, scale_height=1e3)
    share = -np.expm1(-1.0)  # of the 1e-4 * 1e3 of the column, from 1 km down
    length = depth / (1e-4 * share)
    echo, sun = rng.uniform(0, 0.5, (2, n)) * rng.integers(0, 2, (2, n))
    a, tnr = rng.uniform(2, 20, n), rng.uniform(4, 10, n)
    t = np.exp(-depth)
    quiet = (1 - echo - sun) + sun  # shares of the undimmed noise, without the echo
    thresholds = tnr * np.sqrt([quiet, quiet - sun * (1 - t)])
    spread = np.sqrt(1 - echo * (1 - t**2) - sun * (1 - t))
    without = marcum_q1(a, thresholds[0]).q
    true = marcum_q1(a * t**exponent / spread, thresholds[1] / spread).q
    found = optical_depth(profile, start_height=1e3, end_height=0.0, range=length)
    change = dimming(depth=Span.of(found), amplitude_exponent=exponent, dimmed_share=echo + sun)
    np.testing.assert_allclose(change.signal[0], t**exponent, rtol=1e-11)
    assert np.all(change.noise[0] <= spread**2 + 1e-15) and np.all(spread**2 <= change.noise[1])
    found = pd_change(change, amplitude=a, threshold=thresholds[0])
    assert np.all(abs(true - without) <= found + 1e-14)
    still = (echo == 0) & (sun == 0)
    np.testing.assert_allclose(abs(true - without)[still], found[still], atol=1e-13)


AIR = ("earth_clear", "earth_haze", "mars_dusty", "exponential", "layer")


def aired(table, seed, number=40):
    """Scenes of all architectures and profiles, slanted and level, some in sunlight."""
    rng = np.random.default_rng((74, seed))
    architecture = ("homodyne", "heterodyne", "direct")[seed % 3]
    return scene(table, number, seed, fft_size=small(seed), architecture=architecture) | {
        "atmosphere.profile": AIR[seed % 5],
        "atmosphere.extinction": 10 ** rng.uniform(-6, -3),
        "atmosphere.depth": 10 ** rng.uniform(1, 4),
        "atmosphere.target_height": rng.uniform(-10, 2000, number),
        "atmosphere.path": ("slant", "level")[seed // 5 % 2],
        "target.solar_irradiance": 10 ** rng.uniform(6, 9, number) * (seed % 2),
    }


@pytest.mark.parametrize("seed", range(15))
def test_blocks_hold_what_the_air_takes_and_points_to_the_last_digit(table_4_1, seed):
    core, parameters = (*CORE, "backscatter"), aired(table_4_1, seed)
    for block, points in ((point_block(parameters), parameters), tile_block(parameters, seed)):
        change = bound(block)
        clear, dim = (shots_of(points, names) for names in (core, (*core, "extinction")))
        factor, quieter = (
            getattr(dim, name) / getattr(clear, name) for name in ("beat_scale", "noise_variance")
        )
        low, high = change.signal
        assert np.all(low * (1 - 1e-12) <= factor) and np.all(factor <= high * (1 + 1e-12))
        assert np.all(change.noise[0] <= quieter * (1 + 1e-12)) and np.all(quieter <= 1)
        if points is parameters:
            np.testing.assert_allclose(low, factor, rtol=1e-12)


def test_depths_of_beams_up_and_down_lie_within_their_ends():
    """Elevations by the shot, here level or up to a target overhead, spanned by hand."""
    rng = np.random.default_rng(8)
    n = 200
    path = {
        "range": rng.uniform(100, 900, n), "target": rng.uniform(900, 2000, n),
        "sine": rng.uniform(-1, 0.3, n),
    }  # fmt: skip
    low, high = ({k: f(v) for k, v in path.items()} for f in (np.min, np.max))
    over = depth_over(PROFILES["earth_haze"], Path(**{k: Span(low[k], high[k]) for k in low}))
    each = optical_depth(
        PROFILES["earth_haze"], start_height=path["target"] + path["range"] * path["sine"],
        end_height=path["target"], range=path["range"],
    )  # fmt: skip
    assert np.all(over.low <= each) and np.all(each <= over.high)


def test_clear_air_has_nothing_of_it(table_4_1):
    assert bound(point_block(scene(table_4_1, 5, 1))) is None
