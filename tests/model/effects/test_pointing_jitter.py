"""Jitter over a plane: vectors that meet it, small angles, draws within bounds."""

import numpy as np
import pytest
from scipy import stats

from sweep.model import philox
from sweep.model.effects.catalogue import CORE
from sweep.model.effects.effect import Realisation
from sweep.model.effects.pointing_jitter import angles, turned
from sweep.model.realisations import realise
from sweep.model.shot import evaluate, statistics

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
