"""Thresholds by ratios and by false alarms: closed forms, there and back, and drawn noise."""

import numpy as np
import pytest
from scipy.integrate import quad

from sweep.model import evaluation
from sweep.model.threshold import (
    DESIGN_PFA_BIN_PATH,
    DESIGN_PFA_SEGMENT_PATH,
    DESIGN_PFA_SHOT_PATH,
    THRESHOLD_PATHS,
    THRESHOLD_TO_MEAN_PATH,
    TNR_PATH,
    tnr_from_parameters,
)

CHANCES = np.array([0.9, 0.1, 1e-3, 1e-9, 1e-100])


def by(parameters, way, value):
    """Parameters with the threshold set in one way, and nothing to be seen."""
    other_parameters = {path: v for path, v in parameters.items() if path not in THRESHOLD_PATHS}
    return other_parameters | {way: value, "target.reflectance": 0.0}


def test_ratios_are_of_the_mean_and_the_deviation_of_a_rayleigh_magnitude():
    mean, square = (
        quad(lambda x, n=n: x ** (n + 1) * np.exp(-(x**2) / 2), 0, 40)[0] for n in (1, 2)
    )
    for ratio in (0.5, 4.0):
        expected = ratio * mean / np.sqrt(square - mean**2)
        assert tnr_from_parameters({THRESHOLD_TO_MEAN_PATH: ratio}) == pytest.approx(
            expected, rel=1e-9
        )
    assert tnr_from_parameters({THRESHOLD_TO_MEAN_PATH: 4.0}) == pytest.approx(7.65, abs=0.005)


@pytest.mark.parametrize(
    "architecture, noise",
    [("homodyne", "independent"), ("homodyne", "correlated"), ("direct", "correlated")],
)
@pytest.mark.parametrize(
    "way, output",
    [
        (DESIGN_PFA_BIN_PATH, "bin"),
        (DESIGN_PFA_SEGMENT_PATH, "segment"),
        (DESIGN_PFA_SHOT_PATH, "shot"),
    ],
)
def test_noise_alone_alarms_as_often_as_designed(table_4_1, way, output, architecture, noise):
    scene = table_4_1(
        bins_counted="all", fft_size=2**12, architecture=architecture, noise_bins=noise
    )
    outputs = evaluation.evaluate(by(scene, way, CHANCES))
    assert outputs[f"log10_pfa_{output}"] == pytest.approx(np.log10(CHANCES), rel=1e-12)
    none = 1 - outputs["pfa_segment"]
    segments = 2 if architecture == "direct" else 3
    assert outputs["pfa_shot"] == pytest.approx(1 - none**segments, rel=1e-9, abs=1e-12)
    assert outputs["pfa_both_chirps"] == pytest.approx(outputs["pfa_segment"] ** 2, rel=1e-9)
    segment_outputs = evaluation.evaluate(
        by(scene, way, CHANCES[2])
    )  # one value and one of many are the same
    assert segment_outputs["pfa_bin"][0] == outputs["pfa_bin"][2]


def test_the_threshold_is_set_in_exactly_one_way(table_4_1):
    scene = table_4_1()
    for wrong in ({}, {TNR_PATH: 10.0, DESIGN_PFA_BIN_PATH: 1e-6}):
        with pytest.raises(ValueError, match="exactly one of"):
            tnr_from_parameters(
                {path: v for path, v in scene.items() if path not in THRESHOLD_PATHS} | wrong
            )
