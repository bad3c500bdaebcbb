"""Jitter over a plane: vectors that meet it, small angles, quadrature over both angles."""

import numpy as np
import pytest
from scipy import stats

from sweep.model import philox
from sweep.model.effects import pointing_jitter
from sweep.model.effects.change import pd_change
from sweep.model.effects.pointing_jitter import angles, conditional_detection, turned
from sweep.model.geometry.jitter import jitter_directions
from sweep.model.shot import evaluate

DRAWS = 20_000
POLES = (400e6, 400e6)


def keys(n, seed=5):
    return philox.point_keys(np.arange(float(n))[:, None], domain="tests", seed=seed)


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
    off = angles(keys=keys(1), first_draw=0, draws=2000, sigma=3e-3)[0]
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


def test_beams_off_by_two_angles_are_those_of_scanned_scenes():
    """The same law as of the jitter of directions: the angle off, and how far, draw by draw."""
    off = np.random.default_rng(1).normal(size=(500, 2))
    down = np.tile([0.0, 0.0, -1.0], (500, 1))
    direction = jitter_directions(down, sigma=2e-3, draws=off)
    seen = turned(range=100.0, grazing_angle=np.pi / 2, radial_velocity=0.0, angles=2e-3 * off)
    np.testing.assert_allclose(seen.range, 100.0 / -direction[:, 2], rtol=1e-12)


def test_ranges_are_normal_off_the_normal_and_exponential_along_it():
    """R'/R - 1 is a cot(grazing) to first order, t^2/2 with mean sigma^2 at 90 deg."""
    sigma = 1e-5
    off = angles(keys=keys(1), first_draw=0, draws=DRAWS, sigma=sigma)[0]
    slant = turned(range=1.0, grazing_angle=0.5, radial_velocity=0.0, angles=off).range - 1
    assert stats.kstest(slant, stats.norm(scale=sigma / np.tan(0.5)).cdf).pvalue > 1e-6
    along = turned(range=1.0, grazing_angle=np.pi / 2, radial_velocity=0.0, angles=1e3 * off)
    law = stats.expon(scale=(1e3 * sigma) ** 2)
    assert stats.kstest(along.range - 1, law.cdf).pvalue > 1e-6


def test_a_beam_over_the_horizon_sees_nothing(table_4_1):
    parameters = table_4_1(grazing_angle=0.02, beamlets=1, range=50.0)
    drawn = conditional_detection(
        parameters, keys=keys(1), draws=200, sigma=0.02, names=("pd_shot", "snr_up")
    )
    missed = np.isnan(drawn["range"])
    assert 0.05 < missed.mean() < 0.35  # a > 0.02: 16 %
    assert (drawn["pd_shot"][missed] == 0).all() and (drawn["pd_shot"][~missed] > 0).any()
    np.testing.assert_array_equal(np.isnan(drawn["snr_up"]), missed)


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
    drawn = conditional_detection(
        parameters | {"target.range": r}, keys=keys(3), draws=2 * DRAWS, sigma=sigma
    )["pd_up"]
    error = drawn.std(axis=1) / np.sqrt(2 * DRAWS)
    # What is left out is of fourth order: some (sigma c R / bin)^2 = 0.1 % of the shift.
    assert (abs(drawn.mean(axis=1) - pd(r) - shift) <= 5 * error + 0.02 * abs(shift)).all()
    assert (abs(shift) > 20 * error)[1]
    moved = sigma * c * r
    scatter = np.sqrt((moved * first) ** 2 + 0.5 * (moved**2 * second) ** 2)
    assert (abs(drawn.std(axis=1) / scatter - 1)[[0, 2]] < 0.02).all()


@pytest.mark.parametrize(
    "changes, sigma",
    [
        ({"grazing_angle": 0.6, "phases": "incoherent", "beamlets": 7}, 4e-6),
        ({"grazing_angle": 0.2, "reflectance_law": "lambert", "beamlets": 1, "power": 0.3}, 2e-6),
        ({"grazing_angle": np.pi / 2, "beamlets": 1}, 3e-3),
    ],
)
def test_the_mean_over_draws_is_a_quadrature_over_both_angles(changes, sigma, table_4_1):
    parameters = table_4_1(**{"range": 5000.0, "tnr": 8.0, "power": 0.15} | changes)
    a, b = (v.ravel() for v in np.mgrid[-6:6.05:0.1, -6:6.05:0.1])
    share = np.exp(-(a**2 + b**2) / 2) * 0.1**2 / (2 * np.pi)
    off = sigma * np.stack([a, b], axis=1)
    far, grazing, direction = by_vectors(5000.0, parameters["target.grazing_angle"], off)
    aimed = np.array(
        [np.cos(parameters["target.grazing_angle"]), 0, -np.sin(parameters["target.grazing_angle"])]
    )
    outputs = evaluate(
        parameters
        | {"target.range": far, "target.grazing_angle": grazing}
        | {"target.radial_velocity": 150.0 * (direction @ aimed)}
    )
    drawn = conditional_detection(parameters, keys=keys(1), draws=DRAWS, sigma=sigma)
    for name in ("pd_up", "pd_down", "pd_shot"):
        exact = (share * outputs[name]).sum()
        assert 0.01 < exact < 0.99
        error = drawn[name].std() / np.sqrt(DRAWS)
        assert error > 1e-5
        assert abs(drawn[name].mean() - exact) <= 5 * error


def test_no_jitter_is_the_shot_and_draws_stand_alone(table_4_1):
    parameters = table_4_1(range=np.array([2000.0, 4000.0]), grazing_angle=0.5, beamlets=7)
    still = conditional_detection(parameters, keys=keys(2), draws=3, sigma=0.0)
    plain = evaluate(parameters)
    for name in ("pd_up", "pd_doppler", "pd_shot"):
        np.testing.assert_allclose(still[name], plain[name][:, None] * np.ones(3), rtol=1e-6)
    whole = conditional_detection(parameters, keys=keys(2), draws=2500, sigma=1e-5)
    late = conditional_detection(parameters, keys=keys(2), first_draw=2400, draws=50, sigma=1e-5)
    one = parameters | {"target.range": np.array([4000.0])}
    alone = conditional_detection(one, keys=keys(2)[1:], first_draw=2400, draws=50, sigma=1e-5)
    for name, values in whole.items():
        np.testing.assert_array_equal(values[:, 2400:2450], late[name])
        np.testing.assert_array_equal(late[name][1:], alone[name])


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


def bounded(parameters, sigma, **further):
    p = {path.rsplit(".", 1)[1]: value for path, value in parameters.items()}
    same = (
        "range", "grazing_angle", "radial_velocity", "wavelength", "beam_divergence",
        "sample_rate", "fft_size", "beamlets",
    )  # fmt: skip
    return pointing_jitter.bound(
        sigma=sigma, chirp_rate=p["bandwidth"] / p["duration"], bandwidths=POLES,
        signal_shot_share=0.0, coherent=p["phases"] == "coherent",
        direct=p["architecture"] == "direct", **{name: p[name] for name in same}, **further,
    )  # fmt: skip


def test_no_draw_leaves_the_bound_and_the_bound_is_not_idle(table_4_1):
    """A draw in a million may: of 60 scenes x 300 draws, 0.02 are expected to."""
    ratios = []
    for number in range(60):
        parameters, sigma = drawn_scene(number, table_4_1)
        low, high = bounded(parameters, sigma).signal
        names = ("snr_up", "snr_down", "snr_doppler")
        drawn = conditional_detection(
            parameters, keys=keys(1, number), draws=300, sigma=sigma, names=names
        )
        plain = evaluate(parameters)
        largest = 0.0
        for name in names:
            factor = np.sqrt(drawn[name][0] / plain[name])
            assert (low * (1 - 1e-6) <= factor).all(), (number, name)
            assert (factor <= high * (1 + 1e-6)).all(), (number, name)
            largest = max(largest, abs(np.log(factor)).max())
        reach = np.log(high) if low == 0 else 0.5 * np.log(high / low)
        ratios.append(reach / largest)
    assert np.isfinite(ratios).all()
    assert 1 < np.median(ratios) < 30


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
    low, high = bounded(parameters, 1e-4).signal
    drawn = conditional_detection(
        parameters, keys=keys(1), draws=2000, sigma=1e-4, names=("snr_up",)
    )
    factor = np.sqrt(drawn["snr_up"][0] / evaluate(parameters)["snr_up"])
    cube = (10.0 / drawn["range"][0]) ** 1.5
    np.testing.assert_allclose(factor, cube, rtol=2e-4)
    assert (low <= factor).all() and (factor <= high).all()
    assert np.log(high / low) < 4 * np.log(factor.max() / factor.min())


def test_the_bound_holds_for_detection_and_direct_receivers(table_4_1):
    parameters = table_4_1(
        architecture="direct", beamlets=1, range=60.0, grazing_angle=0.3, fft_size=16384
    )
    change = bounded(parameters, 1e-4)
    drawn = conditional_detection(
        parameters, keys=keys(1), draws=300, sigma=1e-4, names=("snr_up", "pd_up")
    )
    plain = evaluate(parameters)
    factor = np.sqrt(drawn["snr_up"][0] / plain["snr_up"])
    assert (change.signal[0] <= factor).all() and (factor <= change.signal[1]).all()
    most = pd_change(
        change,
        amplitude=float(np.sqrt(2 * plain["snr_up"][0])),
        threshold=10.0 * np.sqrt(2 - np.pi / 2),
    )
    assert (abs(drawn["pd_up"] - plain["pd_up"]) <= most).all()


def test_nothing_is_promised_of_what_fades_or_may_pass_the_horizon(table_4_1):
    for parameters in (
        table_4_1(phases="coherent", grazing_angle=0.5),
        table_4_1(phases="incoherent", grazing_angle=1e-4),
    ):
        assert bounded(parameters, 1e-4).signal == (0.0, np.inf)
    still = bounded(table_4_1(phases="incoherent", grazing_angle=0.5), 0.0)
    assert still.signal == pytest.approx((1.0, 1.0), abs=1e-12)
