"""Developed speckle on slopes, compared with a Monte Carlo simulation of scatterers.

The simulation shares the mean echo power, the noise and the threshold with the model, and nothing
of lines, spectra or detection.
"""

import numpy as np
import pytest
from scatterer_shots import (
    LANDER_PARAMETERS,
    draw_segment_detections,
    prepare_single_category,
    with_signal_over_threshold,
)

from sweep.model import beam
from sweep.model.effects.catalogue import PARAMETER_DEFAULTS
from sweep.model.evaluation import shot_statistics

DRAWS = 20_000

CASES = {
    "steep chirp, short record": {
        "target.range": 150.0, "target.grazing_angle": np.radians(30),
        "instrument.chirp.bandwidth": 4e9, "instrument.chirp.duration": 100e-6,
    },
    "a third of a bin": {
        "target.range": 300.0, "target.grazing_angle": np.radians(10),
        "instrument.chirp.segments": "up down",
    },
    "two thirds of a bin": {
        "target.range": 600.0, "target.grazing_angle": np.radians(10),
        "instrument.chirp.segments": "up down",
    },
    "one and a half bins": {
        "target.range": 407.0, "target.grazing_angle": np.radians(3),
        "instrument.chirp.segments": "down up", "instrument.processing.window": "hann",
    },
    "sliding down a slope": {
        "target.range": 300.0, "target.grazing_angle": np.radians(25),
        "target.transverse_velocity": 25.0, "target.radial_velocity": 12.0,
    },
    "sliding up a slope": {
        "target.range": 300.0, "target.grazing_angle": np.radians(25),
        "target.transverse_velocity": -25.0, "target.radial_velocity": 12.0,
    },
    "four bins": {
        "target.range": 450.0, "target.grazing_angle": np.radians(1.0),
        "instrument.processing.window": "hann",
    },
    "samples missing": {
        "target.range": 1500.0, "target.grazing_angle": np.radians(20),
        "instrument.processing.window": "hann", "instrument.chirp.segments": "up down",
        "target.transverse_velocity": -21.0,
    },
    "straight down": {"target.range": 300.0, "target.grazing_angle": np.pi / 2},
}  # fmt: skip


RATIOS = {"four bins": 0.6}
"""Ratio of |X| to the threshold; any of many bins detects more often than one."""


@pytest.mark.parametrize(
    ("rule", "tolerance"),
    [
        ("peak_bin", 0.0),
        # There is no closed form of both chirps, each detected in any of several bins. Drawn
        # records differ by up to 0.01 beyond 4 deviations.
        ("any_bin", 0.01),
    ],
)
@pytest.mark.parametrize("case", CASES)
def test_both_chirps_are_detected_as_often_as_in_drawn_records(case, rule, tolerance, table_4_1):
    p = (
        PARAMETER_DEFAULTS
        | table_4_1()
        | LANDER_PARAMETERS
        | CASES[case]
        | {"instrument.processing.detection": rule}
    )
    p = with_signal_over_threshold(p, RATIOS.get(case, 1.3))
    shots = prepare_single_category(p)
    outputs = shot_statistics(shots)
    detections = draw_segment_detections(p, shots, draws=DRAWS, seed=len(case))
    joint_share = (detections["up"] & detections["down"]).mean()
    expected = float(outputs["pd_shot"][0])
    error = np.sqrt(expected * (1 - expected) / DRAWS)
    assert abs(joint_share - expected) < 4 * error + tolerance


def test_carriers_that_differ_share_less_speckle_than_equal_ones(table_4_1):
    """The correlation is exp(-t^2 / 2), t = 4 pi df sigma_R / c, where the footprint is narrow."""
    p = PARAMETER_DEFAULTS | table_4_1() | LANDER_PARAMETERS | CASES["steep chirp, short record"]
    shots = prepare_single_category(p)
    delay, length = 2 * 150.0 / 299792458.0, 8192 / 200e6
    frequencies_apart = 2 * (4e9 / 100e-6) * (5e-6 + length / 2 - delay - 50e-6)
    deviation = (
        float(beam.transmitted_and_oscillator_beams(p)[0].radius(150.0))
        / np.sqrt(8)
        / np.tan(np.radians(30))
    )
    turn = 4 * np.pi * frequencies_apart * deviation / 299792458.0
    assert abs(turn) > 0.5
    # The strongest bin sees a little less of the footprint, a tenth of a bin wide, than all of it.
    assert abs(shots.speckle.segment_correlations.up_down[0]) == pytest.approx(
        np.exp(-0.5 * turn**2), rel=0.03
    )
