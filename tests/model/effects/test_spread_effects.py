"""Footprint, Doppler, Doppler spread, several returns: true changes within and near bounds."""

import numpy as np
import pytest
from cast_blocks import block_of_cast
from effect_points import (
    ACROSS,
    CLOSED,
    ROUNDING,
    found,
    held,
    magnitudes,
    point_block,
    scene,
    shots_of,
    small,
    tile_block,
)
from pd_changes import pd_change

from sweep.model.chain import prepare_cast
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects import (
    doppler,
    doppler_spread,
    footprint,
    line_spread,
    several_returns,
)
from sweep.model.effects.change import Change
from sweep.model.footprint import beamlets as pattern_of
from sweep.model.ground import Cast, Footprints
from sweep.model.shot import find

SEEDS = 12
STILL = ("footprint", "doppler_spread", "image")
SPREAD = {
    "footprint": (footprint, ("doppler", "image"), ("footprint",)),
    "doppler spread": (doppler_spread, ("doppler", "footprint", "image"), ("doppler_spread",)),
}
"""Module, what there is without it, and what comes with it."""


def pd_held(change, on, off, shots):
    """Whether the change of pd is within what the bound makes of it, (3, n)."""
    sigma = shots.bin_deviation
    most = pd_change(change, amplitude=off[:, 2] / sigma, threshold=shots.threshold / sigma)
    return abs(on[:, 0] - off[:, 0]) <= most + 1e-9


@pytest.mark.parametrize("name", SPREAD)
@pytest.mark.parametrize("tiles", [False, True], ids=["points", "tiles"])
def test_spreads_change_no_more_than_their_bounds_and_near_them(table_4_1, name, tiles):
    module, before, more = SPREAD[name]
    ratios = []
    for seed in range(SEEDS):
        parameters = scene(table_4_1, 30, seed, fft_size=small(seed))
        block, inner = tile_block(parameters, seed) if tiles else (point_block(parameters),) * 2
        inner = inner if tiles else parameters
        on, off = found(inner, before + more), found(inner, before)
        change = module.bound(block)
        inside, ratio = held(change, on[:, 2], off[:, 2])
        assert inside.all() and pd_held(change, on, off, shots_of(inner, before)).all()
        ratios.append(ratio)
    if not tiles:
        assert 1 <= np.median(np.concatenate(ratios)) <= 30


@pytest.mark.parametrize("tiles", [False, True], ids=["points", "tiles"])
def test_doppler_changes_no_more_than_its_bound(table_4_1, tiles):
    ratios = []
    for seed in range(SEEDS):
        slow = 10 ** np.random.default_rng(seed).uniform(-6, -1.5, 30)
        parameters = scene(
            table_4_1, 30, seed, fft_size=small(seed), window=CLOSED[seed % 4],
            radial_velocity=slow,
        )  # fmt: skip
        block, inner = tile_block(parameters, seed) if tiles else (point_block(parameters),) * 2
        inner = inner if tiles else parameters
        on, off = magnitudes(inner, (*STILL, "doppler")), magnitudes(inner, STILL)
        # the bound speaks from the moving line, whose amplitude is the block's
        change = doppler.bound(block)
        inside, ratio = held(change, off, on)
        away = change.shift == 1
        assert away.any() and (inside | away).all()
        ratios.append(ratio)
    if not tiles:
        assert np.median(np.concatenate(ratios)) <= 30


def test_velocity_is_kept_wherever_its_shift_shows(table_4_1):
    velocity = np.array([0.0, 1e-7, 1e-4, 3e-4, 1e-2, 10.0])
    block = point_block(table_4_1(radial_velocity=velocity))
    bins = 2 * velocity / 1550e-9 / (600e6 / 2**17)
    shift = doppler.bound(block).shift
    expected = np.where(bins > 0.1, 1.0, bins)
    assert shift[1] == pytest.approx(expected, rel=1e-3) and (shift[2] >= shift[1]).all()
    assert doppler.bound(point_block(table_4_1(radial_velocity=0.0))) is None


def test_the_axis_amplitude_is_the_model_s_with_one_beamlet(table_4_1):
    for seed in range(6):
        parameters = scene(table_4_1, 40, seed, fft_size=small(seed), beamlets=1)
        shots = shots_of(parameters, ("footprint", "doppler", "image"))
        measured = find(shots)[:, 2] / shots.bin_deviation
        block = point_block(parameters)
        line = block.lines
        settled = line.bin_offset == line.bin_offset_least  # not with and without a slow Doppler
        alone = settled & (line.edge > 200 * line.lobe.margin)
        expected = block.amplitude.low
        room = 3e-5 + 1e-3 * (shots.window.name == "flattop")  # least and most of a flat top
        assert measured[alone] == pytest.approx(expected[alone], rel=room)


@pytest.mark.parametrize("law", ["thesis", "lambert", "lommel_seeliger"])
def test_moments_are_near_those_of_the_beamlets(table_4_1, law):
    for seed in range(20):
        parameters = scene(table_4_1, 60, seed, fft_size=4096, reflectance_law=law)
        shots, block = shots_of(parameters, ("footprint", "doppler_spread")), None
        block = point_block(parameters)
        power = shots.amplitude**2 / (shots.amplitude**2).sum(axis=1, keepdims=True)
        for moments, values in (
            (block.ranges, shots.offset),
            (block.velocities, shots.doppler * SPEED_OF_LIGHT / 2),
        ):
            rms = np.sqrt((power * values**2).sum(axis=1))[shots.row]
            assert np.median(moments.rms / rms) < 1.5


def test_bins_of_a_spread_are_those_of_the_lines(table_4_1):
    # the slope of the beat over range and velocity, taken from the lines themselves
    parameters = scene(table_4_1, 50, 3, fft_size=2**13)
    block, step = point_block(parameters), 1e-6
    one = point_block(parameters | {"target.range": parameters["target.range"] * (1 + step)})
    faster = parameters | {"target.radial_velocity": parameters["target.radial_velocity"] + 1e-3}
    two = point_block(faster)
    slopes = block.of_ranges(line_spread.Moments(1.0, 1.0, 1.0)).mean, [
        line_spread.velocity_to_bins(
            range=block.range.high, carrier=block.carrier(s).high,
            chirp_rate=block.chirp_rate.high, bin_width=block.bin_width.low,
        )
        for s in range(3)
    ]  # fmt: skip
    for moved, size, slope in ((one, step, slopes[0]), (two, 1e-3, slopes[1])):
        for s in range(3):
            change = abs(frequencies(moved, s) - frequencies(block, s)) / block.bin_width.low
            assert (change <= size * slope[s] * (1 + 1e-3) + 1e-9).all()
            assert (change >= size * slope[s] * (1 - 1e-2) - 1e-9).all()


def frequencies(block, segment):
    """Beats of the axis's lines [Hz], to leading orders."""
    sign = (1, 0, -1)[segment]
    beat = block.chirp_rate.low * 2 * block.range.low / SPEED_OF_LIGHT * (1 + block.beta.low)
    return block.carrier(segment).low * block.beta.low - sign * beat


def test_a_level_single_beamlet_has_no_footprint(table_4_1):
    single = point_block(scene(table_4_1, 5, 1, beamlets=1))
    assert footprint.bound(single) is None and not np.any(single.spread.extreme)
    block = point_block(scene(table_4_1, 5, 1, across=0.0, radial_velocity=0.0))
    assert doppler_spread.bound(block) is None and several_returns.bound(block) is None


def test_a_whole_footprint_on_a_slope_echoes_more(table_4_1):
    """Lambert's law, wide beam: (1 + u)^3 of mean 1 + 3 q^2, q = div/4 cot(grazing)."""
    parameters = scene(
        table_4_1, 20, 1, fft_size=2**13, beamlets=109, reflectance_law="lambert",
        grazing_angle=np.radians(10.0), beam_divergence=np.linspace(1e-3, 0.1, 20),
        range=0.5, window="flattop", across=0.0,
    )  # fmt: skip
    q = parameters["instrument.laser.beam_divergence"] / 4 / np.tan(np.radians(10.0))
    span = point_block(parameters).echo_ratio
    low, high = (np.broadcast_to(end, 20) for end in (span.low, span.high))
    shots = shots_of(parameters, ("footprint",))
    alone = shots_of(parameters, ())
    ratio = shots.relative_echo / alone.relative_echo
    assert (low <= ratio).all() and (ratio <= high).all()
    assert ratio == pytest.approx(1 + 3 * q**2, rel=3e-3) and ratio[-1] > 1.05
    assert (high - low <= 2 * q**3 * 3 + 0.01).all()
    # the Doppler segment, whose lines ranges do not spread, shows nothing else
    on, off = (magnitudes(parameters, e) for e in (("footprint", "doppler"), ("doppler",)))
    change = footprint.bound(point_block(parameters))
    assert held(change, on, off)[0].all() and (on[1, -1] / off[1, -1]) ** 2 > 1.05
    assert change.signal[1][1] / change.signal[0][1] == pytest.approx(np.sqrt(high / low), 1e-6)


def test_rotation_is_a_velocity_of_the_instrument():
    # a ball of radius 3 that turns about a point off its centre, seen by beamlets all over it
    rng = np.random.default_rng(9)
    centre, pivot, rate = np.array([100.0, 5.0, -2.0]), rng.normal(size=3), rng.normal(size=3)
    rays = centre + rng.uniform(-1.5, 1.5, (200, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    along = rays @ centre
    far = along - np.sqrt(along**2 - centre @ centre + 9.0)
    surface = np.cross(rate, far[:, None] * rays - pivot)
    closing = -(surface * rays).sum(axis=1)
    velocity = -np.cross(rate, np.zeros(3) - pivot)  # that of an instrument at the origin
    assert closing == pytest.approx((velocity * rays).sum(axis=1), rel=1e-11)


def stepped(table, seed, phases="incoherent"):
    """Shots over a step: what prepare_cast and a block of points take."""
    parameters = scene(
        table, 30, seed, fft_size=small(seed), beamlets=37, beam_divergence=200e-6, phases=phases
    )
    shots, rng = shots_of(parameters, ("footprint",)), np.random.default_rng(seed)
    offset, echo = shots.offset[shots.row], shots.amplitude[shots.row] ** 2
    others = pattern_of(37)[0][0][None] > rng.uniform(0.0, 3.0, 30)[:, None]
    step = 10 ** rng.uniform(-1, 1.5, 30) * rng.choice([-0.3, 1], 30)
    offset = offset + np.where(others, (step / shots.range).clip(-0.5)[:, None], 0.0)
    footprints = Footprints(np.arange(30), offset, np.zeros_like(offset), echo)
    return parameters, footprints, others


def test_several_returns_change_no_more_than_their_bound(table_4_1):
    ratios = []
    for seed in range(SEEDS):
        parameters, footprints, others = stepped(table_4_1, seed)
        before = ("doppler", "footprint", "image")
        ground = Cast(footprints, others)
        on, off = (
            find(prepare_cast(parameters, ground, e))
            for e in ((*before, "several_returns"), before)
        )
        block = block_of_cast(parameters, footprints, others, np.arange(31))
        change = several_returns.bound(block)
        inside, ratio = held(change, on[:, 2], off[:, 2])
        assert inside.all()
        assert pd_held(change, on, off, prepare_cast(parameters, ground, before)).all()
        ratios.append(ratio)
    assert 1 <= np.median(np.concatenate(ratios)) <= 30


def test_direct_beats_of_a_footprint_add_in_phase_where_it_is_small(table_4_1):
    parameters = scene(
        table_4_1, 30, 2, beamlets=19, architecture="direct", fft_size=2**13, across=0.0,
        range=np.geomspace(10, 2000, 30), grazing_angle=np.pi / 2, beam_divergence=2e-5,
        radial_velocity=0.0,
    )  # fmt: skip
    change = footprint.bound(point_block(parameters))
    on, off = (magnitudes(parameters, e)[[0, 2]] for e in (("footprint",), ()))
    low, high = (np.asarray(end)[[0, 2]] for end in change.signal)
    factor = on / off
    assert (low <= factor * (1 + ROUNDING)).all() and (factor <= high * (1 + ROUNDING)).all()
    assert (low > 0.99).mean() > 0.5
    assert isinstance(change, Change) and ACROSS in parameters
