"""Twinkling: published turbulence, limits of theory, draws against their laws, the mean of Pd."""

import numpy as np
import pytest
from scipy import special, stats
from scipy.integrate import quad
from shot_helpers import make_point_keys

from sweep.model.effects.catalogue import PARAMETER_DEFAULTS
from sweep.model.effects.effect import DrawAddresses
from sweep.model.effects.scintillation import (
    HUFNAGEL_VALLEY,
    LogIrradianceVariances,
    TurbulenceProfile,
    draw_scintillation_factors,
    log_irradiance_variances,
    rytov_variance,
    structure_constant,
    two_way_log_variances,
)

WAVENUMBER = 2 * np.pi / 1.55e-6


def index(legs):
    """Variance of the whole factor of unit mean, exp(sum of log variances) - 1, for either law."""
    return np.expm1(sum(leg.large_eddies + leg.small_eddies for leg in legs))


def leg(large, small=0.0):
    return LogIrradianceVariances(np.asarray(large, float), np.asarray(small, float))


def test_hufnagel_and_valley_have_five_centimetres_and_seven_microradians():
    """Straight up at 0.5 um: r_0 = 5 cm and theta_0 = 7 urad, hence 5/7."""
    k = 2 * np.pi / 0.5e-6

    def column(power):
        parts = ((0, 1e3), (1e3, 3e4))
        return sum(
            quad(lambda h: h**power * structure_constant(HUFNAGEL_VALLEY, h), *part, limit=200)[0]
            for part in parts
        )

    assert (0.423 * k**2 * column(0)) ** -0.6 == pytest.approx(5e-2, rel=0.02)
    assert (2.914 * k**2 * column(5 / 3)) ** -0.6 == pytest.approx(7e-6, rel=0.03)


@pytest.mark.parametrize("wave", ["plane", "spherical"])
@pytest.mark.parametrize("start, end", [(0.0, 100.0), (3000.0, 0.0), (0.0, 10e3), (20e3, 0.0)])
def test_slant_paths_through_a_profile_agree_with_adaptive_quadrature(wave, start, end):
    length = 1.5 * abs(end - start)

    def integrand(u):
        weight = (1 - u) ** (5 / 6) * (u ** (5 / 6) if wave == "spherical" else 1.0)
        return weight * structure_constant(HUFNAGEL_VALLEY, start + (end - start) * u)

    cuts = [0.001, 0.003, 0.01, 0.03, 0.1, 0.9, 0.97, 0.99, 0.997, 0.999]
    mean, _ = quad(integrand, 0, 1, points=cuts, limit=1000, epsrel=1e-11, epsabs=0)
    expected = 2.25 * WAVENUMBER ** (7 / 6) * length ** (11 / 6) * mean
    rytov = rytov_variance(
        wave, HUFNAGEL_VALLEY, wavelength=1.55e-6, range=length, start_height=start,
        end_height=end,
    )  # fmt: skip
    assert rytov == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("wave", ["plane", "spherical"])
@pytest.mark.parametrize("aperture, excess", [(0.0, 1.001), (0.01, 1.11), (0.03, 1.3), (0.1, 2.0)])
def test_weak_twinkling_through_an_aperture_is_the_integral_over_kolmogorovs_spectrum(
    wave, aperture, excess
):
    """8 pi^2 k^2 int 0.033 C k^(-8/3) (1 - cos) (2 J1(x)/x)^2, first order in C_n^2.

    In even turbulence over L the phase of an eddy of wavenumber q at z from the source is
    q^2 z (L - z) / (k L) for a spherical wave, which shrinks apertures by z/L, and q^2 (L - z) / k
    for a plane one. The fit that serves any strength averages too little, as its docstring says.
    """
    length, k = 1000.0, WAVENUMBER
    u, weight = np.polynomial.legendre.leggauss(200)
    z, weight = (u + 1) / 2, weight / 2
    q = np.geomspace(1e-2, 1e5, 6000)[:, None] * np.sqrt(k / length) / 10
    scale = z if wave == "spherical" else np.ones_like(z)
    phase = q**2 * length * (1 - z) * scale / k
    x = np.maximum(q * aperture * scale / 2, 1e-9)
    aperture_filter = 1.0 if aperture == 0 else (2 * special.j1(x) / x) ** 2
    inner = (weight * 2 * np.sin(phase / 2) ** 2 * aperture_filter).sum(axis=1)
    total = np.trapezoid(q[:, 0] ** (-8 / 3) * inner * q[:, 0], np.log(q[:, 0]))
    exact = 8 * np.pi**2 * k**2 * 0.033e-17 * length * total
    rytov = rytov_variance(
        wave, TurbulenceProfile(uniform_strength=1e-17), wavelength=1.55e-6, range=length,
        start_height=0.0, end_height=0.0,
    )  # fmt: skip
    scintillation_index = index(
        [log_irradiance_variances(wave, rytov_variance=rytov, wavelength=1.55e-6, range=length,
                       aperture=aperture)]
    )  # fmt: skip
    assert 0.995 < scintillation_index / exact < excess


def test_strong_twinkling_saturates_as_theory_has_it():
    """Plane 1 + 0.86 s^(-4/5), spherical 1 + 2.73 s^(-4/5), s^2 the plane wave's Rytov variance.

    The law and its limit were fitted apart; they agree to 3 %.
    """
    for wave, share, factor in (("plane", 1.0, 0.86), ("spherical", 0.4065, 2.73)):
        strong = np.array([1e4, 1e9])
        scintillation_index = index(
            [
                log_irradiance_variances(
                    wave, rytov_variance=strong * share, wavelength=1.55e-6, range=1e3, aperture=0.0
                )
            ]
        )
        assert scintillation_index[1] == pytest.approx(1, abs=0.005)
        slope = (scintillation_index[0] - scintillation_index[1]) / (
            strong[0] ** -0.4 - strong[1] ** -0.4
        )
        assert slope == pytest.approx(factor, rel=0.035)


def draws_of(law, legs, points, draws, first=0):
    """Factors (points, draws)."""
    number = np.tile(np.arange(first, first + draws), points)
    spread = [
        LogIrradianceVariances(*(np.repeat(np.broadcast_to(v, points), draws) for v in one))
        for one in legs
    ]
    return draw_scintillation_factors(
        law, spread, DrawAddresses(np.repeat(make_point_keys(points), draws, axis=0), number)
    ).reshape(points, draws)


LEGS = (leg(0.2, 0.3), leg(0.05, 0.1))


SURE = np.sqrt(-0.5 * np.log(5.7e-7 / 2))
"""Kolmogorov and Smirnov's distance times sqrt(n) that chance exceeds as rarely as 5 sigma."""


def test_log_normal_draws_follow_their_law():
    factors = draws_of("log_normal", LEGS, 2, 50_000, 5).ravel()
    law = stats.norm(loc=-0.65 / 2, scale=np.sqrt(0.65))
    assert stats.kstest(np.log(factors), law.cdf).statistic < SURE / np.sqrt(factors.size)


def test_gamma_gamma_draws_follow_the_law_with_the_bessel_function():
    """2 (ab)^((a+b)/2) / (G(a) G(b)) I^((a+b)/2 - 1) K_(a-b)(2 sqrt(ab I)), Al-Habash et al."""
    one = (leg(0.35, 0.6),)
    a, b = 1 / np.expm1(0.35), 1 / np.expm1(0.6)
    factors = draws_of("gamma_gamma", one, 2, 50_000, 0).ravel()
    value = np.geomspace(1e-6, 60, 40_000)
    half = (a + b) / 2
    log_scale = np.log(2) + half * np.log(a * b) - special.gammaln(a) - special.gammaln(b)
    density = np.exp(log_scale + (half - 1) * np.log(value))
    density *= special.kv(a - b, 2 * np.sqrt(a * b * value))
    steps = np.diff(value) * (density[1:] + density[:-1]) / 2
    cumulative = np.concatenate([[0.0], np.cumsum(steps)])
    assert cumulative[-1] == pytest.approx(1, abs=1e-5)
    distance = stats.kstest(factors, lambda x: np.interp(x, value, cumulative)).statistic
    assert distance < SURE / np.sqrt(factors.size)


def test_still_air_is_exactly_one_and_faint_turbulence_the_same_by_either_law():
    factors = (leg(0.0), leg(0.0))
    for law in ("log_normal", "gamma_gamma"):
        assert np.all(draws_of(law, factors, 3, 4, 0) == 1.0)
    faint = (leg(4e-6, 9e-6), leg(2e-5, 0.0))
    a, b = (draws_of(law, faint, 3, 1000, 0) for law in ("log_normal", "gamma_gamma"))
    np.testing.assert_allclose(a, b, atol=0.01 * np.sqrt(3.3e-5) * 5)


def test_two_ways_take_the_footprint_out_and_the_aperture_back():
    def ways(aperture, divergence):
        beam = {"laser.wavelength": 1.55e-6, "laser.beam_divergence": divergence,
                "telescope.aperture": aperture}  # fmt: skip
        place = {"atmosphere.target_height": 0.0, "atmosphere.path": "slant",
                 "target.grazing_angle": np.arcsin(0.75)}  # fmt: skip
        parameters = {f"instrument.{name}": value for name, value in beam.items()}
        parameters = PARAMETER_DEFAULTS | parameters | place
        return two_way_log_variances(HUFNAGEL_VALLEY, parameters, np.array(2000.0))

    (out, back), (wide_out, wide_back) = ways(25e-3, 50e-6), ways(25e-3, 5e-3)
    assert wide_out.large_eddies < out.large_eddies and wide_out.small_eddies < out.small_eddies
    assert wide_back == back
    _, large_back = ways(0.2, 50e-6)
    assert large_back.small_eddies < 0.2 * back.small_eddies
