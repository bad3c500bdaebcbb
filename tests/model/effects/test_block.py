"""Blocks: all that bare shots compute anywhere in a tile lies within its spans."""

import numpy as np
import pytest
from cast_blocks import block_of_cast
from effect_points import ACROSS, point_block, scene, tile_block
from hypothesis import given
from hypothesis import strategies as st

from sweep.model.chain import prepare, prepare_cast
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.catalogue import DEFAULTS
from sweep.model.effects.footprint_phase import phase_reach
from sweep.model.ground import Cast, Footprints
from sweep.model.shot import find

ROUNDING = 1e-9
ARCHITECTURES = ("homodyne", "heterodyne", "direct")
INSTRUMENT = (
    "laser.wavelength", "chirp.bandwidth", "telescope.aperture", "receiver.responsivity",
    "receiver.local_oscillator_power", "receiver.noise_equivalent_power", "receiver.temperature",
    "receiver.transimpedance", "receiver.load_resistance", "receiver.detector_bandwidth",
    "receiver.noise_figure", "receiver.apd_gain", "chirp.start_frequency",
)  # fmt: skip


def varied(parameters, seed):
    """With an instrument that differs from point to point."""
    rng = np.random.default_rng(seed)
    size = np.size(parameters["target.range"])
    paths = ["instrument." + name for name in INSTRUMENT]
    return parameters | {
        path: parameters[path] * 10 ** rng.uniform(-0.1, 0.1, size) for path in paths
    }


def bare(parameters):
    """Shots with nothing but Doppler, as the block's amplitude has it."""
    ((_, shots),) = prepare(parameters, ("doppler",))
    return shots


def known(block, shots):
    """(span, value) of what both know."""
    sigma = shots.bin_deviation
    pairs = {
        "range": (block.range, shots.range),
        "beta": (block.beta, shots.beta),
        "chirp rate": (block.chirp_rate, shots.chirp_rate),
        "bin width": (block.bin_width, shots.sample_rate / shots.fft_size),
        "record": (block.record_duration, shots.record_duration),
        "echo": (block.echo * block.echo_scale, shots.echo_power),
        "beat": (block.beat_scale, shots.beat_scale),
        "noise": (block.noise_variance, shots.noise_variance),
        "per ampere": (block.noise_scale, shots.noise_scale),
        "per watt": (block.shot_noise_scale, shots.shot_noise_scale),
        "sigma": (block.deviation, sigma),
        "threshold": (block.threshold, shots.threshold / sigma),
    }
    return pairs | {f"carrier {s}": (block.carrier(s), shots.carriers[s]) for s in range(3)}


@given(st.integers(0, 2**32), st.sampled_from(ARCHITECTURES))
def test_spans_hold_what_bare_shots_have_anywhere_within(table_4_1, seed, architecture):
    parameters = scene(table_4_1, 8, seed, fft_size=4096, architecture=architecture)
    block, inner = tile_block(varied(parameters, seed), seed)
    shots = bare(inner)
    for name, (span, value) in known(block, shots).items():
        assert span.holds(value, ROUNDING).all(), name
    position = np.stack(
        [
            shots.carriers[s] * shots.beta
            - sign * shots.chirp_rate * 2 * shots.range / SPEED_OF_LIGHT * (1 + shots.beta)
            for s, sign in enumerate((1, 0, -1))
        ]
    )
    place = position / (shots.sample_rate / shots.fft_size)
    line, off, half = block.lines, abs(place - np.rint(place)), shots.fft_size / 2
    poles = shots.detector_bandwidth, shots.amplifier_bandwidth
    transfer = 1 / np.prod([np.hypot(1, position / pole) for pole in poles], axis=0)
    rounding = 1e-9 * (1 + abs(place))
    assert (line.bin_offset_least - rounding <= off).all()
    assert (off <= line.bin_offset + rounding).all()
    assert (line.edge - rounding <= half * abs(place / half - np.rint(place / half))).all()
    assert (line.transfer_least * (1 - ROUNDING) <= transfer).all()
    assert (transfer <= line.transfer * (1 + ROUNDING)).all()


@given(st.integers(0, 2**32), st.sampled_from(ARCHITECTURES))
def test_the_amplitude_is_that_of_the_bare_line_s_largest_bin(table_4_1, seed, architecture):
    parameters = scene(table_4_1, 8, seed, fft_size=4096, architecture=architecture)
    for block, inner in ((point_block(parameters), parameters), tile_block(parameters, seed)):
        shots = bare(inner)
        found = find(shots)[:, 2] / shots.bin_deviation
        if architecture == "direct":
            found[1] = 0.0
        room = 3e-5 + 1e-3 * (shots.window.name == "flattop")  # least and most of a flat top
        assert (block.amplitude.low * (1 - room) <= found).all()
        assert (found <= block.amplitude.high * (1 + room)).all()


def test_a_tile_of_one_point_has_the_values_themselves(table_4_1):
    for seed, architecture in enumerate(ARCHITECTURES):
        # fast enough that the Doppler effect is not left out
        parameters = scene(
            table_4_1, 30, seed, fft_size=4096, architecture=architecture, radial_velocity=1e6
        )
        block, shots = point_block(parameters), bare(parameters)
        for name, (span, value) in known(block, shots).items():
            assert np.array_equal(span.low, span.high), name
            np.testing.assert_allclose(np.broadcast_to(span.low, 30), value, 1e-14, err_msg=name)
        assert np.array_equal(block.lines.bin_offset, block.lines.bin_offset_least)
        assert np.array_equal(block.amplitude.low, block.amplitude.high)


@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
@pytest.mark.parametrize("law", ["thesis", "lambert", "lommel_seeliger"])
def test_a_footprint_s_moments_echo_and_gain_lie_within(table_4_1, law, phases):
    tight = []
    for seed in range(20):
        parameters = scene(
            table_4_1, 60, seed, fft_size=4096, reflectance_law=law, phases=phases,
            beamlets=[1, 2, 3, 19, 109][seed % 5],
        )  # fmt: skip
        for block, inner in ((point_block(parameters), parameters), tile_block(parameters, seed)):
            ((_, shots),) = prepare(inner, ("footprint", "doppler_spread"))
            row, rounding = shots.row, 1 + 1e-9
            power = (shots.amplitude**2)[row]
            whole = power.sum(axis=1)
            ratio = whole / bare(inner).relative_echo
            assert block.echo_ratio.holds(ratio, 1e-12).all()
            gain = shots.amplitude.sum(axis=1)[row] / np.sqrt(whole)
            assert block.gain.holds(gain, 1e-12).all()
            share = power / whole[:, None]
            for moments, values in (
                (block.ranges, shots.offset[row]),
                (block.velocities, shots.doppler[row] * SPEED_OF_LIGHT / 2),
            ):
                mean = abs((share * values).sum(axis=1))
                rms = np.sqrt((share * values**2).sum(axis=1))
                assert (mean <= moments.mean * rounding + 1e-12).all()
                assert (rms <= moments.rms * rounding + 1e-12).all()
                assert (abs(values).max(axis=1) <= moments.extreme * rounding + 1e-12).all()
        excess = block.echo_ratio.high - 1
        tight.append((excess < 1e-6).mean())
    assert max(tight) > 0.1  # the echo differs in the second order only


def test_the_phase_reach_holds_the_phases_of_all_beamlets(table_4_1):
    for seed in range(6):
        parameters = scene(table_4_1, 40, seed, fft_size=4096, phases="coherent", beamlets=19)
        block, inner = tile_block(parameters, seed)
        ((_, shots),) = prepare(inner, ("footprint", "doppler_spread"))
        reach = phase_reach(block, block.ranges, block.spreads.velocities)
        away = abs(shots.offset[shots.row]).max(axis=1) * shots.range
        optical = 4 * np.pi * shots.carriers[0] / SPEED_OF_LIGHT * away
        assert (optical <= reach[1] * (1 + 1e-9)).all()


def test_shots_of_a_flight_are_tiled_by_stretches(table_4_1):
    rng = np.random.default_rng(4)
    shots, beamlets = 30, 7
    offset, doppler = rng.normal(0, [[[1e-3]], [[1e-8]]], (2, shots, beamlets))
    echo = rng.random((shots, beamlets)) / beamlets
    beside = rng.random((shots, beamlets)) < 0.2
    footprints = Footprints(np.arange(shots), offset, doppler, echo)
    parameters = DEFAULTS | table_4_1(
        range=rng.uniform(100, 200, shots), radial_velocity=rng.normal(0, 10, shots), beamlets=7
    )
    edges = np.array([0, 4, 5, 20, 30])
    block = block_of_cast(parameters, footprints, beside, edges, rotating=True)
    assert block.size == 4 and block.rotating
    tile = np.repeat(np.arange(4), np.diff(edges))
    power = echo / echo.sum(axis=1, keepdims=True)
    truth = prepare_cast(parameters, Cast(footprints, beside), ())
    assert block.range.some(tile).holds(truth.range).all()
    assert block.echo.some(tile).holds(truth.relative_echo, 1e-12).all()
    assert block.beside_share.some(tile).holds((power * beside).sum(axis=1)).all()
    away = np.where(beside, abs(offset), 0.0).max(axis=1)
    assert (away <= block.beside_apart[tile]).all() and block.beside_apart.max() == away.max()
    gain = np.sqrt(power).sum(axis=1)
    assert block.gain.some(tile).holds(gain, 1e-12).all()
    assert block.gain.high.max() == pytest.approx(gain.max(), rel=1e-12)
    own = np.where(beside, 0.0, power)
    own /= np.maximum(own.sum(axis=1, keepdims=True), 1e-300)
    for moments, values, weight in (
        (block.ranges, offset, power),
        (block.velocities, doppler * SPEED_OF_LIGHT / 2, power),
        (block.geometry.own_ranges, offset, own),
    ):
        for found, by_shot in zip(
            moments,
            (
                abs((weight * values).sum(axis=1)),
                np.sqrt((weight * values**2).sum(axis=1)),
                np.where(weight > 0, abs(values), 0.0).max(axis=1),
            ),
            strict=True,
        ):
            largest = np.maximum.reduceat(by_shot, edges[:-1])
            np.testing.assert_allclose(found, largest, rtol=1e-12, atol=1e-25)


@pytest.mark.parametrize("bright", [0.0, 5e-324, 1e-310])
def test_shots_that_send_back_next_to_nothing_have_moments(table_4_1, bright):
    offset = np.full((2, 7), 1e-3)
    footprints = Footprints(np.arange(2), offset, np.zeros_like(offset), np.full((2, 7), bright))
    parameters = DEFAULTS | table_4_1(range=np.full(2, 100.0), beamlets=7)
    beside = np.arange(7) < 3
    block = block_of_cast(parameters, footprints, np.stack([beside, beside]), np.array([0, 2]))
    there = bright > 0
    for moments in (block.ranges, block.geometry.own_ranges):
        np.testing.assert_allclose(list(moments), 1e-3 * there, rtol=1e-12)
    assert block.beside_share.high == pytest.approx(3 / 7 * there) and block.gain.low >= 1.0


def test_in_direct_detection_echoes_add_without_gain(table_4_1):
    echo = np.random.default_rng(1).random((3, 7))
    nothing = np.zeros_like(echo)
    footprints = Footprints(np.arange(3), nothing, nothing, echo)
    parameters = DEFAULTS | table_4_1(architecture="direct", range=np.full(3, 100.0), beamlets=7)
    block = block_of_cast(parameters, footprints, None, np.array([0, 3]))
    assert block.gain.low == block.gain.high == 1.0


def test_a_block_s_points_share_their_record_and_words_are_no_numbers(table_4_1):
    parameters = scene(table_4_1, 3, 0, fft_size=2**17, duration=np.array([500e-6, 1e-4, 1e-4]))
    block = point_block(parameters)
    with pytest.raises(ValueError, match="record"):
        _ = block.window
    with pytest.raises(TypeError, match="word"):
        block["target.reflectance_law"]
    law = "target.reflectance_law"
    assert block.word(law) == parameters[law] and block.has(ACROSS)
    with pytest.raises(ValueError, match=r"target\.range"):
        block.whole("target.range")
