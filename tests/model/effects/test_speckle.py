"""Speckle's closed forms and bounds: sums of scatterers, integrals, and draws within bounds."""

import numpy as np
import pytest
from effect_points import magnitudes, point_block, scene, small, tile_block
from pd_changes import pd_change
from scipy.integrate import quad
from speckle_pairs import joint_detection

from sweep.model import philox, truth
from sweep.model.chain import prepare
from sweep.model.effects import speckle
from sweep.model.effects.catalogue import CORE
from sweep.model.marcum import marcum_q1
from sweep.model.realisations import realise
from sweep.model.shot import evaluate, find


def prepared(parameters):
    ((_, shots),) = prepare(parameters)
    return shots


def keys(n, seed=5):
    return philox.point_keys(np.arange(float(n))[:, None], domain="tests", seed=seed)


def test_both_cross_as_an_integral_over_one_of_the_two_says():
    """Given the first, the second is a Rice variable: integrated over the first's power."""
    for correlation in (0.0, 0.3, 0.9, 0.999):
        for powers in ((30.0, 30.0), (5.0, 80.0)):
            covariance = correlation * np.sqrt(powers[0] * powers[1])
            first, second = powers[0] + 2.0, powers[1] + 2.0
            rest = second - covariance**2 / first

            def rice(t, first=first, rest=rest, covariance=covariance):
                mean = covariance / first * np.sqrt(first * t)
                return np.exp(-t) * marcum_q1(mean / np.sqrt(rest / 2), 6 / np.sqrt(rest / 2)).q

            exact, _ = quad(rice, 36.0 / first, 60.0, epsabs=1e-13, limit=200)
            found = joint_detection(
                powers=powers, covariance=covariance, bin_deviation=1.0, threshold=6.0
            )
            assert found == pytest.approx(exact, rel=1e-8)


def test_the_coherent_share_is_that_of_a_sum_over_random_heights():
    rng = np.random.default_rng(3)
    wavelength, number = 1550e-9, 400_000
    for roughness in (0.02, 0.08, 0.15):
        heights = rng.normal(scale=roughness * wavelength, size=number)
        mean = np.exp(4j * np.pi * heights / wavelength).mean()
        share = speckle.coherent_share(roughness=roughness * wavelength, wavelength=wavelength)
        assert abs(abs(mean) - np.sqrt(share)) < 5 / np.sqrt(number)
    assert speckle.coherent_share(roughness=np.inf, wavelength=wavelength) == 0
    assert speckle.coherent_share(roughness=0.0, wavelength=wavelength) == 1


def drawn_scene(number, table_4_1):
    rng = np.random.default_rng((21, number))
    return table_4_1(
        fft_size=4096,
        beamlets=int(rng.choice([1, 7, 19])),
        phases=str(rng.choice(["coherent", "incoherent"])),
        window=str(rng.choice(["rectangular", "hann", "hamming"])),
        range=rng.uniform(100, 5000),
        grazing_angle=rng.uniform(0.1, np.pi / 2),
        beam_divergence=10 ** rng.uniform(-6, -3),
        power=10 ** rng.uniform(-3, 0),
    )


def bins_of(parameters):
    """Bins within a fifth of the strongest in amplitude, the beamlets' powers added."""
    shots = prepared(parameters | {"footprint.phases": "incoherent"})
    spectrum = truth.spectrum(shots, 0, 0, range_walk=False)
    return (spectrum > 0.2 * spectrum.max()).sum()


def test_no_draw_leaves_the_bound_and_the_bound_is_not_idle(table_4_1):
    """A draw in a million may: of 40 scenes x 400 draws, 0.016 are expected to."""
    ratios = []
    for number in range(40):
        parameters = drawn_scene(number, table_4_1)
        shots = prepared(parameters)
        roughness = 10 ** np.random.default_rng(number).uniform(-3, 0) * 1550e-9
        share = speckle.coherent_share(roughness=roughness, wavelength=1550e-9)
        plain, powers = (
            evaluate(parameters | {"footprint.phases": phases})["snr_up"][0]
            for phases in (parameters["footprint.phases"], "incoherent")
        )
        random = shots.incoherent and shots.offset.shape[1] > 1
        change = speckle.drawn_change(
            coherent_share=0.0 if random else share,
            diffuse_over_found=powers / plain,
            bins=bins_of(parameters),
        )
        (drawn,) = realise(
            parameters | {"target.roughness": roughness}, (*CORE, "speckle"),
            keys=keys(1, number), draws=400,
        )  # fmt: skip
        factor = find(drawn.shots)[0, 2] / find(shots)[0, 2]
        low, high = change.signal
        assert (low <= factor).all() and (factor <= high).all(), number
        reach = np.log(high) if low == 0 else 0.5 * np.log(high / low)
        ratios.append(reach / np.median(abs(np.log(factor))))
    assert 1 < np.median(ratios) < 15


def test_the_bound_holds_for_the_mean_detection(table_4_1):
    """One beamlet, a Rice variable of noise and speckle."""
    beta = prepared(table_4_1()).tnr * np.sqrt(2 - np.pi / 2)
    plain = np.sqrt(2 * np.array([40.0, 80.0]))
    for roughness in (1e-9, 1e-8, 3e-8, 1e-6):
        share = speckle.coherent_share(roughness=roughness, wavelength=1550e-9)
        change = speckle.drawn_change(coherent_share=share, diffuse_over_found=1.0, bins=3)
        most = pd_change(change, amplitude=plain, threshold=beta)
        mean = speckle.fixed_bin_detection(
            steady=np.sqrt(share) * plain, diffuse_power=(1 - share) * plain**2,
            bin_deviation=1.0, threshold=beta,
        )  # fmt: skip
        moved = abs(mean - marcum_q1(plain, beta).q)
        assert (moved <= most + speckle.RARE).all()
        assert (moved > 0).all()


@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
@pytest.mark.parametrize("beamlets", [1, 7])
def test_no_draw_of_a_tile_s_points_leaves_its_bound(table_4_1, phases, beamlets):
    """Also beside images: 6 x 20 points x 100 draws. What is added counts of sums in phase."""
    for seed in range(6):
        rng = np.random.default_rng((79, seed))
        parameters = scene(
            table_4_1, 20, seed, fft_size=small(seed), beamlets=beamlets, phases=phases,
            radial_velocity=10 ** rng.uniform(-2, 2, 20),
        ) | {"target.roughness": 10 ** rng.uniform(-9.5, -7)}  # fmt: skip
        block, points = tile_block(parameters, seed)
        change, without = speckle.bound(block), magnitudes(points, CORE)
        in_phase = np.sqrt(2 * block.echo_ratio.high) * block.gain.high
        added = change.added * block.amplitude.high * block.deviation.high * in_phase
        low, high = change.signal[0] * without - added, change.signal[1] * without + added
        for stretch in realise(points, (*CORE, "speckle"), keys=keys(20, seed), draws=100):
            drawn = find(stretch.shots)[:, 2]
            assert (drawn >= low[:, stretch.point] * (1 - 1e-6)).all()
            assert (drawn <= high[:, stretch.point] * (1 + 1e-6)).all()


def test_a_smooth_surface_has_nothing_of_it(table_4_1):
    assert speckle.bound(point_block(scene(table_4_1, 5, 1))) is None
