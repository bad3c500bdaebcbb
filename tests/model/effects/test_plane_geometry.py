"""Compiled bounds on what beams meet on planes, against the same formulas of whole arrays."""

import numpy as np
import pytest

from sweep.model.effects.line_spread import reach_of
from sweep.model.effects.plane_geometry import (
    FIELDS,
    beam_of,
    plane_range_moments,
    plane_velocity_moments,
    put_planes,
)
from sweep.model.footprint import beamlets
from sweep.model.reflectance import LAWS

N = 400


def slopes(rng):
    """Angles from grazing to normal and divergences, some past the horizon."""
    return rng.choice([1e-4, 0.01, 0.3, 1.0, np.pi / 2], N), 10 ** rng.uniform(-6, -1.5, N)


def moments(angle, divergence, reach):
    """Of ranges, and of velocities for 1 m/s across and for 1 m/s along, by their definitions."""
    sigma = divergence / 4
    q = sigma / np.tan(angle)
    u, bulge = reach * q, (reach * sigma) ** 2 / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        heavy = (1 + u) ** 3 * np.exp(6 * bulge)
        lean = 3 * q**2 * (1 + u) ** 2 * np.exp(6 * bulge) + 6 * q * bulge
        ranges = np.array([
            lean + (q**2 + sigma**2) * heavy / (1 - u),
            (q + sigma * np.sqrt(bulge)) * np.sqrt(heavy) / (1 - u),
            (u + bulge) / (1 - u),
        ])  # fmt: skip
    heavy = (1 + np.minimum(u, 1)) ** 3 * np.exp(6 * bulge)
    across = [sigma * (3 * q * heavy + 8 * reach * bulge), sigma * np.sqrt(heavy), reach * sigma]
    along = [sigma**2 * heavy, sigma * np.sqrt(bulge * heavy), bulge]
    return np.where(u < 1, ranges, np.inf), np.array(across), np.array(along)


@pytest.mark.parametrize("number", [7, 109])
def test_moments_are_those_of_their_formulas(number):
    rng = np.random.default_rng(number)
    angle, divergence = slopes(rng)
    speed = rng.choice([-300.0, 0.0, 2.0], (2, N))
    shape = {"grazing_angle": angle, "beam_divergence": divergence}
    shape |= {"number": number, "pattern": "hexagonal"}
    ranges, across, along = moments(angle, divergence, reach_of(number, "hexagonal"))
    assert 20 < np.isinf(ranges[0]).sum() < N - 20
    np.testing.assert_allclose(plane_range_moments(**shape), ranges, 1e-12)
    found = plane_velocity_moments(across=speed[0], along=speed[1], **shape)
    np.testing.assert_allclose(found, abs(speed[0]) * across + abs(speed[1]) * along, 1e-12)


@pytest.mark.parametrize("law", LAWS)
def test_over_tiles_they_are_those_of_the_ends(law):
    rng, number = np.random.default_rng(3), 19
    angle, divergence = slopes(rng)
    ends = [np.minimum(angle * 1.01, np.pi / 2), divergence * 1.1]
    speeds = np.sort(rng.choice([-300.0, 0.0, 2.0], (2, 2, N)), axis=1)
    table = np.array([angle, ends[0], divergence, ends[1], *speeds[0], *speeds[1]])
    found, reach = np.empty((FIELDS, N)), reach_of(number, "hexagonal")
    put_planes(table, LAWS.index(law), beam_of(number, "hexagonal", "homodyne"), found)
    ranges, across, along = moments(angle, ends[1], reach)
    sideways, closing = abs(speeds[1]).max(axis=0), abs(speeds[0]).max(axis=0)
    np.testing.assert_allclose(found[6:9], ranges, 1e-12)
    moved = sideways * across + closing * along
    np.testing.assert_allclose(found[9:], moved, 1e-12)
    power = 3 if law == "lambert" else 2
    q = [divergence / 4 / np.tan(ends[0]), ends[1] / 4 / np.tan(angle)]
    u, longest = reach * q[1], np.hypot(1, reach * ends[1] / 4)
    near = np.minimum(1 + u, 1 / np.sin(angle)) ** power
    far = (np.maximum(1 - u, 0) / longest) ** power
    bend, lean = power * (power - 1) / 2, u * (power == 3)
    more = np.where(u < 1, 1 + (bend + lean) * q[1] ** 2, np.inf)
    less = np.where(u < 1, (1 + (bend - lean) * q[0] ** 2) / longest**power, 0)
    whole = np.maximum(less, far), np.minimum(more, near)
    np.testing.assert_allclose(found[2:4], whole, 3e-12)
    level = np.sqrt(beamlets(number, "hexagonal")[1]).sum()
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = level * np.sqrt([far / whole[1], near / whole[0]])
    gain = np.where(whole[0] > 0, np.clip(gain, 1, np.sqrt(number)), [[1], [np.sqrt(number)]])
    np.testing.assert_allclose(found[4:6], gain, 3e-12)
