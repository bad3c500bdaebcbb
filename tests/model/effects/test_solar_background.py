"""Sunlight's share of the noise, by hand and against prepared shots."""

import numpy as np
import pytest
from effect_points import point_block

from sweep.model.chain import prepare
from sweep.model.effects.block import Block
from sweep.model.effects.catalogue import DEFAULTS
from sweep.model.effects.solar_background import SUN_RADIUS, bound
from sweep.model.effects.span import Span

OTHERS = 1.53715e-13
"""Current variance of Table 4.1 [A^2]."""


def test_the_share_of_sunlight_by_radiometry_of_the_patch_seen(table_4_1):
    """0.26 W/m^2/nm at 1.55 um on white ground, 1 km away, through 25 nm, 1 mrad and 25 mm.

    The patch is 0.785 m^2 and receives 5.105 W; Lambert's law sends P/pi per steradian, and the
    aperture is 4.909e-10 sr: 7.977e-10 W, 1.125e-19 A^2 of shot noise, 7.3e-7 of the whole.
    """
    light = 0.26 * 25 * (np.pi * 0.5**2) / np.pi * (np.pi * 0.0125**2 / 1000.0**2)
    assert light == pytest.approx(7.977e-10, rel=1e-3)
    scene = table_4_1(
        solar_irradiance=2.6e8, reflectance=1.0, range=1000.0, beam_divergence=1e-3, fft_size=1024
    )
    change = bound(point_block(scene))
    assert change.noise[0] == 1 and change.threshold_follows  # air may dim all of it
    assert change.noise[1] - 1 == pytest.approx(1.125e-19 / OTHERS, rel=1e-3)


def gained(parameters):
    """Noise with sunlight over that without."""
    ((_, shots),), ((_, dark),) = (
        prepare(parameters, ("solar_background",)),
        prepare(parameters, ()),
    )
    return shots.noise_variance / dark.noise_variance


def test_the_bound_is_what_prepared_shots_gain_in_noise(table_4_1):
    sun = np.array([0.0, 2.6e8, 2.6e11, 2.6e16])
    scene = table_4_1(
        solar_irradiance=sun, fft_size=1024, reflectance=0.7, apd_gain=4.0, excess_noise_factor=2.5
    )
    true = gained(scene)
    assert true[-1] > 1.01
    np.testing.assert_allclose(bound(point_block(scene)).noise[1], true, rtol=1e-12)
    assert bound(point_block(scene | {"target.solar_irradiance": 0.0})) is None


def test_no_sun_anywhere_in_a_tile_passes_the_bound(table_4_1):
    """Distances, elevations, wavelengths about the sun's brightest, fields of view or none."""
    rng = np.random.default_rng(5)
    spans = {
        "target.sun_distance": (0.1, 3.0), "target.sun_elevation": (0.0, np.pi / 2),
        "target.solar_irradiance": (0.0, 1e14), "instrument.laser.wavelength": (2e-7, 2e-6),
        "instrument.receiver.field_of_view": (0.0, 1.0),
    }  # fmt: skip
    scale = {"target.sun_distance": 1.5e9}
    tight = []
    for _ in range(60):
        ends = {
            path: np.sort(rng.uniform(*reach, 2)) * scale.get(path, 1.0)
            for path, reach in spans.items()
        }
        for path in ("instrument.receiver.field_of_view", "target.sun_distance"):
            ends[path][0] *= rng.random() < 0.7
        if rng.random() < 0.5:
            ends = {path: np.full(2, end[1]) for path, end in ends.items()}
        common = DEFAULTS | table_4_1(fft_size=1024)
        block = Block.of_plane(
            {p: v if isinstance(v, str) else Span.of(v) for p, v in common.items()}
            | {path: Span(*end) for path, end in ends.items()}
        )
        place = rng.random(20)
        inner = {path: end[0] + place * (end[1] - end[0]) for path, end in ends.items()}
        distance = inner["target.sun_distance"]
        inner["target.sun_distance"] = np.where(distance < SUN_RADIUS, 0.0, distance)
        true, most = gained(common | inner), bound(block).noise[1]
        assert (true <= most * (1 + 1e-12)).all()
        tight.append((most - 1) / (true.max() - 1))
    assert np.median(tight) < 5
