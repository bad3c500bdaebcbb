"""What a footprint adds up to, against the lines that the model itself makes of it."""

import numpy as np
import pytest
from effect_points import point_block, scene, shots_of, tile_block

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.footprint_sum import footprint_sum, put_at_points
from sweep.model.footprint import beamlets, plane_footprint
from sweep.model.lines import segment_lines
from sweep.model.segments import SIGNS

LINES = {"doppler", "image"}
WHOLE = LINES | {"footprint", "footprint_phase"}


def sums_of(parameters, effects):
    """|sum_b C_b| of the lines that the model makes, (3, n)."""
    shots = shots_of(parameters, effects)
    table, (fft_size, length) = shots.point_table(), shots.kernel()[0]
    delta, re, im = np.empty((3, shots.offset.shape[1]))
    found = np.empty((3, shots.size))
    for i, row in enumerate(shots.row):
        p = table[:, i]
        record = p[6], fft_size, length, p[7]
        for s, sign in enumerate(SIGNS):
            segment_lines(
                (sign, p[9] if s == 2 else p[8]), (p[2], p[0], p[1], p[3]), (p[4], p[5]), record,
                shots.offset[row], shots.doppler[row], shots.amplitude[row], np.empty(0),
                delta, re, im,
            )  # fmt: skip
            found[s, i] = np.hypot(re.sum(), im.sum())
    return found


@pytest.mark.parametrize("across", [0.0, 30.0])
def test_at_a_point_it_is_the_sum_of_the_model_s_lines(table_4_1, across):
    told = 0
    for seed in range(12):
        parameters = scene(
            table_4_1, 20, seed, phases="coherent", across=across, fft_size=2**13,
            acquisition_delay=[0.0, 1e-6][seed % 2],
        )  # fmt: skip
        block = point_block(parameters)
        found = footprint_sum(block)
        alone = sums_of(parameters, LINES)
        with_spread, without = (
            sums_of(parameters, WHOLE | spread) / alone for spread in ({"doppler_spread"}, set())
        )
        true = np.maximum(with_spread, without)
        assert (true <= found.most * (1 + 1e-12)).all()
        assert (found.most <= found.in_phase).all()
        above = (true > 1.1) & (true < 0.9 * found.in_phase)  # not as if powers added
        receiver = 3 * block.lines.tilt * found.lean  # its poles see lines far apart differently
        assert (found.most - true <= receiver + 1e-6 * true)[above].all()
        told += above.sum()
    assert told > 50


def test_over_a_tile_it_may_be_all_in_phase(table_4_1):
    parameters = scene(table_4_1, 20, 3, phases="coherent", across=0.0)
    points, tiles = (
        footprint_sum(block) for block in (point_block(parameters), tile_block(parameters, 3)[0])
    )
    assert (tiles.most >= points.most * (1 - 1e-12)).all()
    wide = tiles.most[0] > 1.5 * points.most[0]
    assert wide.any() and (tiles.most == tiles.in_phase)[0, wide].all()


@pytest.mark.parametrize("jittered", [{}, {"pointing_jitter": 1e-6}, {"roughness": 1e-6}])
def test_phases_that_are_drawn_may_make_it_all_in_phase(table_4_1, jittered):
    parameters = scene(table_4_1, 5, 1, phases="coherent", across=0.0)
    parameters |= {f"target.{name}": value for name, value in jittered.items()}
    found = footprint_sum(point_block(parameters))
    assert (found.most == found.in_phase).all() == bool(jittered)


def test_powers_add_up_whatever_their_phases(table_4_1):
    found = footprint_sum(point_block(scene(table_4_1, 5, 1)))
    assert (found.most == found.in_phase).all() and not found.lean.any()


def test_the_phase_by_which_doppler_stretches_a_range_s_beat_counts_in_full():
    (across, along), share = beamlets(19)
    angle, divergence, far, rate, middle, beta = 0.4, 1e-3, 3000.0, 2e12, 3e-4, 2e-4
    point = [angle, divergence, 0.0, 0.0, far, rate, middle, 1e4, beta, *[2e14] * 3, *[0.0] * 3]
    moving, still = np.empty((2, 2, 3, 1))
    for found, ratio in (moving, beta), (still, 0.0):
        table = np.array(point)[:, None]
        table[8] = ratio
        put_at_points(table, (across, along, share), 0, found)
    offset, _, weight = (
        values[0]
        for values in plane_footprint(
            grazing_angle=np.array([angle]), beam_divergence=np.array([divergence]), number=19
        )
    )
    amplitude = np.sqrt(weight) / (1 + offset)
    beat = rate * 2 * far / SPEED_OF_LIGHT * abs(offset)
    turned = 2 * np.pi * beta * middle * (amplitude * beat).sum()
    assert turned > 0.01
    np.testing.assert_allclose((moving - still)[0, :, 0], turned * np.array([1, 0, 1]), 1e-9)
    lean = (amplitude * beat).sum() / 1e4
    np.testing.assert_allclose(moving[1, :, 0], lean * (1 + beta) * np.array([1, 0, 1]), 1e-12)
