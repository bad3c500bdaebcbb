"""The bound of one phase error in a block, held against the parts that it is compiled from."""

import numpy as np
import pytest
from effect_points import point_block, scene

from sweep.model.effects.line_spread import sizes_of
from sweep.model.effects.phase_bounds import (
    added,
    error_change,
    errors_of,
    may_cancel,
    peak_of,
    phase_change,
)
from sweep.model.effects.phase_formulas import put_peaks
from sweep.model.effects.range_walk import error as own_error

NUMBER = 200


def a_block(table, **fixed):
    """Lines from DC up to some hundred bins, whose records hold errors of one bin and many."""
    rng = np.random.default_rng(8)
    parameters = scene(
        table, NUMBER, 3, fft_size=2**12, range=10 ** rng.uniform(-1, 2, NUMBER), across=0.0,
        beam_divergence=2e-5, grazing_angle=1.2, **fixed,
    )  # fmt: skip
    return point_block(
        parameters
        | {
            "instrument.chirp.quadratic_error": 10 ** rng.uniform(6, 10, NUMBER),
            "instrument.laser.line_width": 10 ** rng.uniform(2, 5, NUMBER),
        }
    )


@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
@pytest.mark.parametrize("beamlets", [1, 7])
def test_one_of_several_errors_is_seen_beside_the_images_that_all_bring(
    table_4_1, phases, beamlets
):
    block = a_block(table_4_1, phases=phases, beamlets=beamlets)
    error, others = own_error(block), errors_of(block, own_error)
    peak, images = peak_of(block, errors_of(block))
    alone = phase_change(error, window=block.window, peak=peak, others=others)
    low, high = np.broadcast_arrays(*alone.signal)
    more, cancelling = added(block, error, images), may_cancel(block, images)
    told = error_change(block, own_error)
    np.testing.assert_array_equal(told.signal[0], np.where(cancelling, 1.0, low))
    np.testing.assert_array_equal(told.signal[1], np.where(cancelling, 1.0, high))
    np.testing.assert_array_equal(told.added, np.where(cancelling, more, 0.0))
    # That the others bring images, with which factors are others, is what is looked at.
    assert (images > peak_of(block, error)[1]).sum() > 20


def test_a_gaussian_line_reaches_towards_its_image_as_beamlets_six_widths_away_do(table_4_1):
    block = a_block(table_4_1, phases="incoherent", beamlets=7)
    axis = block.axis[:, :NUMBER].copy()
    width = 10 ** np.random.default_rng(9).uniform(-1, 2, NUMBER)

    def peaks(axis, width):
        table, out = np.zeros((5, NUMBER)), np.empty((3, NUMBER))
        table[0] = width
        record = (block.fft_size, block.window.length, 1.0)
        put_peaks(axis, table, block.number, sizes_of(block.lines.lobe), record, out)
        return out

    spread = axis.copy()
    spread[7], spread[8] = np.hypot(axis[7], width), axis[8] + 6 * width
    np.testing.assert_array_equal(peaks(axis, width), peaks(spread, 0.0))
    assert (peaks(axis, width)[2] > peaks(axis, 0.0)[2]).sum() > 20
