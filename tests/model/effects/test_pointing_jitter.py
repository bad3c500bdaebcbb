"""Jitter over a plane: vectors that meet it, small angles, draws within bounds."""

import numpy as np
import pytest
from effect_points import magnitudes, point_block, scene, shots_of, small, tile_block
from pd_changes import pd_change
from scipy import stats

from sweep.model import philox
from sweep.model.effects import pointing_jitter
from sweep.model.effects.catalogue import CORE
from sweep.model.effects.effect import Realisation
from sweep.model.effects.pointing_jitter import angles, turned
from sweep.model.realisations import realise
from sweep.model.shot import evaluate, find, statistics

DRAWS = 20_000


def keys(n, seed=5):
    return philox.point_keys(np.arange(float(n))[:, None], domain="tests", seed=seed)


def angles_of(draws, sigma):
    """Angles of one point's draws."""
    realisation = Realisation(np.repeat(keys(1), draws, axis=0), np.arange(draws))
    return angles(realisation, np.full(draws, sigma))


def draws_of(parameters, sigma, draws, points=1):
    """Outputs draw by draw, (points, draws), for points that are shaken."""
    values = {}
    shaken = parameters | {"target.pointing_jitter": sigma}
    for stretch in realise(shaken, (*CORE, "pointing_jitter"), keys=keys(points), draws=draws):
        for name, value in statistics(stretch.shots).items():
            row = values.setdefault(name, np.full((points, draws), np.nan))
            row[stretch.point, stretch.draw] = value
    return values


def by_vectors(distance, grazing, off):
    """Range and grazing angle of jittered rays that are followed down to the plane z = 0."""
    start = np.array([0.0, 0.0, distance * np.sin(grazing)])
    aim = np.array([np.cos(grazing), 0.0, -np.sin(grazing)])
    up, aside = np.array([np.sin(grazing), 0.0, np.cos(grazing)]), np.array([0.0, 1.0, 0.0])
    angle = np.hypot(*off.T)[:, None]
    across = off[:, :1] * up + off[:, 1:] * aside
    direction = aim * np.cos(angle) + across * np.sinc(angle / np.pi)
    far = -start[2] / direction[:, 2]
    return far, np.arcsin(-direction[:, 2]), direction


@pytest.mark.parametrize("grazing", [0.05, 0.4, 1.2, np.pi / 2])
def test_turned_beams_meet_the_plane_where_rays_do(grazing):
    off = angles_of(2000, 3e-3)
    seen = turned(
        range=1500.0, grazing_angle=grazing, radial_velocity=80.0, angles=off,
        velocity_across=(30.0, -20.0),
    )  # fmt: skip
    far, angle, direction = by_vectors(1500.0, grazing, off)
    np.testing.assert_allclose(seen.range, far, rtol=1e-12)
    np.testing.assert_allclose(np.sin(seen.grazing_angle), np.sin(angle), rtol=1e-12)
    aim = np.array([np.cos(grazing), 0.0, -np.sin(grazing)])
    up = np.array([np.sin(grazing), 0.0, np.cos(grazing)])
    velocity = 80.0 * aim + 30.0 * up - 20.0 * np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(seen.radial_velocity, direction @ velocity, rtol=1e-12)


def test_a_beam_off_the_normal_meets_the_ground_over_the_cosine_of_its_angle():
    off = 2e-3 * np.random.default_rng(1).normal(size=(500, 2))
    seen = turned(range=100.0, grazing_angle=np.pi / 2, radial_velocity=0.0, angles=off)
    np.testing.assert_allclose(seen.range, 100.0 / np.cos(np.linalg.norm(off, axis=1)), rtol=1e-12)


def test_ranges_are_normal_off_the_normal_and_exponential_along_it():
    """R'/R - 1 is a cot(grazing) to first order, t^2/2 with mean sigma^2 at 90 deg."""
    sigma = 1e-5
    off = angles_of(DRAWS, sigma)
    slant = turned(range=1.0, grazing_angle=0.5, radial_velocity=0.0, angles=off).range - 1
    assert stats.kstest(slant, stats.norm(scale=sigma / np.tan(0.5)).cdf).pvalue > 1e-6
    along = turned(range=1.0, grazing_angle=np.pi / 2, radial_velocity=0.0, angles=1e3 * off)
    law = stats.expon(scale=(1e3 * sigma) ** 2)
    assert stats.kstest(along.range - 1, law.cdf).pvalue > 1e-6


def test_small_jitter_moves_the_mean_detection_by_its_curvature(table_4_1):
    """R' = R [1 + a c + a^2 (c^2 + 1/2) + b^2/2], c = cot(grazing), so E pd - pd is

    sigma^2/2 [2 (1 + c^2) R pd' + (c R)^2 pd''], and pd scatters by s |pd'| and, in quadrature,
    s^2 |pd''| / sqrt(2), s = sigma c R. Of one beamlet, whose pd depends on the range alone, within
    a third of a bin of its bin's middle: half-way between two the strongest bin changes, and pd
    has an edge.
    """
    parameters = table_4_1(grazing_angle=0.6, beamlets=1, tnr=8.0, power=0.15)
    c, sigma, step = 1 / np.tan(0.6), 1e-6, 0.003

    def pd(at):
        return evaluate(parameters | {"target.range": at})["pd_up"]

    scan = 6000.0 + np.linspace(0.0, 0.343, 200)
    r = scan[np.argmax(pd(scan))] + np.array([-0.07, 0.0, 0.07])
    first = (pd(r + step) - pd(r - step)) / (2 * step)
    second = (pd(r + step) - 2 * pd(r) + pd(r - step)) / step**2
    shift = sigma**2 / 2 * (2 * (1 + c**2) * r * first + (c * r) ** 2 * second)
    drawn = draws_of(parameters | {"target.range": r}, sigma, 2 * DRAWS, 3)["pd_up"]
    error = drawn.std(axis=1) / np.sqrt(2 * DRAWS)
    # What is left out is of fourth order: some (sigma c R / bin)^2 = 0.1 % of the shift.
    assert (abs(drawn.mean(axis=1) - pd(r) - shift) <= 5 * error + 0.02 * abs(shift)).all()
    assert (abs(shift) > 20 * error)[1]
    moved = sigma * c * r
    scatter = np.sqrt((moved * first) ** 2 + 0.5 * (moved**2 * second) ** 2)
    assert (abs(drawn.std(axis=1) / scatter - 1)[[0, 2]] < 0.02).all()


def drawn_scene(number, table_4_1):
    rng = np.random.default_rng((22, number))
    return table_4_1(
        beamlets=int(rng.choice([1, 7, 19])),
        phases="incoherent",
        window=str(rng.choice(["rectangular", "hann", "hamming"])),
        reflectance_law=str(rng.choice(["thesis", "lambert", "lommel_seeliger"])),
        architecture=str(rng.choice(["homodyne", "heterodyne"])),
        fft_size=int(rng.choice([2048, 16384, 131072])),
        range=rng.uniform(100, 5000),
        grazing_angle=rng.uniform(0.05, np.pi / 2) if rng.random() < 0.8 else np.pi / 2,
        beam_divergence=10 ** rng.uniform(-6, -3.5),
        radial_velocity=rng.uniform(60, 150),
    ), 10 ** rng.uniform(-6.5, -3)


def bounded(parameters, sigma):
    """The bound at a point: least and largest factor in each segment."""
    block = point_block(parameters | {"target.pointing_jitter": sigma})
    return pointing_jitter.bound(block)


def factors_of(parameters, sigma, draws):
    """Factors on the detecting bin's magnitude, (3, draws)."""
    names = ("snr_up", "snr_doppler", "snr_down")
    drawn, plain = draws_of(parameters, sigma, draws), evaluate(parameters)
    return np.array([np.sqrt(drawn[name][0] / plain[name]) for name in names])


def test_no_draw_leaves_the_bound_and_the_bound_is_not_idle(table_4_1):
    """A draw in a million may: of 60 scenes x 300 draws, 0.02 are expected to."""
    ratios = []
    for number in range(60):
        parameters, sigma = drawn_scene(number, table_4_1)
        low, high = bounded(parameters, sigma).signal
        factor = factors_of(parameters, sigma, 300)
        assert (low * (1 - 1e-6) <= factor).all(), number
        assert (factor <= high * (1 + 1e-6)).all(), number
        reach = np.where(low == 0, np.log(high), 0.5 * np.log(high / np.maximum(low, 1e-300)))
        ratios.append(reach[0, 0] / abs(np.log(factor[0])).max())
    assert np.isfinite(ratios).all()
    assert 1 < np.median(ratios) < 30


@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
def test_no_draw_of_a_tile_s_points_leaves_its_bound(table_4_1, phases):
    """One beamlet, also of amplitudes and beside its image: 8 x 20 points x 100 draws."""
    for seed in range(8):
        parameters = scene(
            table_4_1,
            20,
            seed,
            fft_size=small(seed),
            beamlets=1,
            phases=phases,
            radial_velocity=0.1,
        )
        sigma = 10 ** np.random.default_rng((76, seed)).uniform(-6.5, -4)
        block, points = tile_block(parameters | {"target.pointing_jitter": sigma}, seed)
        change = pointing_jitter.bound(block)
        shots, without = shots_of(points, CORE), magnitudes(points, CORE)
        low, high = (end * without for end in change.signal)
        effects = (*CORE, "pointing_jitter")
        for stretch in realise(points, effects, keys=keys(20, seed), draws=100):
            found = find(stretch.shots)[:, 2]
            there = stretch.shots.echo_power > 0
            at = stretch.point[there]
            assert (found[:, there] >= low[:, at] * (1 - 1e-6)).all()
            assert (found[:, there] <= high[:, at] * (1 + 1e-6)).all()
            louder = stretch.shots.noise_variance / shots.noise_variance[stretch.point]
            least, most = (np.broadcast_to(end, (3, 20))[0] for end in change.noise)
            assert (louder[there] >= least[at] * (1 - 1e-9)).all()
            assert (louder[there] <= most[at] * (1 + 1e-9)).all()


def test_the_bound_knows_what_the_echo_loses_where_nothing_else_changes(table_4_1):
    """Near by, in bins of 350 m: powers go with the cube of the sine, by Lambert's law."""
    parameters = table_4_1(
        beamlets=1,
        range=10.0,
        grazing_angle=0.3,
        fft_size=128,
        reflectance_law="lambert",
        phases="incoherent",
    )
    low, high = (end[0, 0] for end in bounded(parameters, 1e-4).signal)
    factor = factors_of(parameters, 1e-4, 2000)[0]
    off = angles_of(2000, 1e-4)
    far = turned(range=10.0, grazing_angle=0.3, radial_velocity=0.0, angles=off).range
    np.testing.assert_allclose(factor, (10.0 / far) ** 1.5, rtol=2e-4)
    assert (low <= factor).all() and (factor <= high).all()


def test_the_bound_holds_for_detection_and_direct_receivers(table_4_1):
    parameters = table_4_1(
        architecture="direct", beamlets=1, range=60.0, grazing_angle=0.3, fft_size=16384
    )
    change = bounded(parameters, 1e-4)
    low, high = (end[0] for end in change.signal)
    factor = factors_of(parameters, 1e-4, 300)[0]
    assert (low <= factor).all() and (factor <= high).all()
    plain, drawn = evaluate(parameters), draws_of(parameters, 1e-4, 300)
    up = change._replace(signal=(low, high), noise=tuple(np.ravel(end)[0] for end in change.noise))
    most = pd_change(
        up,
        amplitude=float(np.sqrt(2 * plain["snr_up"][0])),
        threshold=10.0 * np.sqrt(2 - np.pi / 2),
    )
    assert (abs(drawn["pd_up"] - plain["pd_up"]) <= most).all()


def test_nothing_is_promised_of_what_fades_or_may_pass_the_horizon(table_4_1):
    for parameters in (
        table_4_1(phases="coherent", grazing_angle=0.5),
        table_4_1(phases="incoherent", grazing_angle=1e-4),
    ):
        low, high = bounded(parameters, 1e-4).signal
        assert (low == 0).all() and (high == np.inf).all()
    assert bounded(table_4_1(phases="incoherent", grazing_angle=0.5), 0.0) is None
