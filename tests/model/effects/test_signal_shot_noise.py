"""The echo's own shot noise: its rise at short range, and its bound on planes."""

import numpy as np
import pytest
from effect_points import point_block, tile_block

from sweep.model import shot
from sweep.model.chain import prepare
from sweep.model.effects.signal_shot_noise import bound

OTHERS = 1.53715e-13
"""Current variance of Table 4.1 [A^2]: 1.40992e-13 of it shot noise of 1 mW."""


def test_false_alarms_rise_below_five_metres_as_the_thesis_reports(table_4_1):
    """Threshold without the echo, noise with it: Pfa = exp(-Th^2/2s^2 / (1 + share)), [T 4.2].

    At 2 km the echo is 1.953125e-12 W beside 1 mW: 17 % more false alarms at 1 m, 0.6 % at 5 m.
    """
    distance = np.array([1.0, 2.0, 5.0, 20.0])
    parameters = table_4_1(range=distance, fft_size=1024, radial_velocity=10.0)
    change = bound(point_block(parameters))
    share = 1.40992e-13 / OTHERS * 1.953125e-12 * (2000.0 / distance) ** 2 / 1e-3
    np.testing.assert_allclose(change.noise, [1 + share] * 2, rtol=1e-7)
    assert not change.threshold_follows
    predicted = np.exp(-(4 - np.pi) / 4 * 100 / change.noise[0])
    np.testing.assert_allclose(shot.evaluate(parameters)["pfa_bin"], predicted, rtol=1e-5)
    rise = predicted / np.exp(-(4 - np.pi) / 4 * 100) - 1
    assert rise == pytest.approx([0.166, 0.0392, 0.00617, 3.8e-4], rel=0.02)


@pytest.mark.parametrize("law", ["thesis", "lambert", "lommel_seeliger"])
@pytest.mark.parametrize("number, phases", [(1, "coherent"), (3, "incoherent"), (7, "incoherent"),
                                            (19, "coherent"), (109, "incoherent")])  # fmt: skip
def test_no_footprint_on_a_plane_changes_the_noise_beyond_the_bound(law, number, phases, table_4_1):
    rng = np.random.default_rng(number)
    parameters = table_4_1(
        range=10 ** rng.uniform(-0.5, 1.5, 200), beam_divergence=10 ** rng.uniform(-5, -1.5, 200),
        grazing_angle=np.arcsin(10 ** rng.uniform(-2.5, 0, 200)), reflectance_law=law,
        beamlets=number, phases=phases, fft_size=1024,
    )  # fmt: skip
    for block, inner in ((point_block(parameters), parameters), tile_block(parameters, number)):
        change = bound(block)
        for footprint in ((), ("footprint",)):
            ((_, quiet),) = prepare(inner, footprint)
            ((_, shots),) = prepare(inner, (*footprint, "signal_shot_noise"))
            true = shots.noise_variance / quiet.noise_variance - 1
            least, largest = (factor - 1 for factor in change.noise)
            slack = 1e-15 + 1e-9 * true  # the digits of 1 + share
            assert np.all(least <= true + slack) and np.all(true <= largest + slack)
        if inner is parameters:
            assert np.median(largest / true) < (30 if number == 3 else 2)
