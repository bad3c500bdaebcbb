"""Random draws: both ways against the closed probabilities, and independence of batching."""

import numpy as np
import pytest

from sweep.model import philox
from sweep.model.draws import draw
from sweep.model.shot import evaluate

DRAWS = 40_000
"""5 sigma of a proportion is at most 5 * sqrt(1/4 / 40,000) = 0.0125: a 2 % error shows."""


def _points(table_4_1, tnr):
    """Six ranges at 15 deg where pd is neither 0 nor 1 at the low thresholds used here."""
    return table_4_1() | {
        "instrument.laser.power": 0.05,
        "instrument.processing.tnr": tnr,
        "target.range": np.linspace(2500.0, 9500.0, 6),
        "target.grazing_angle": np.radians(15.0),
        "target.radial_velocity": 150.0,
        "footprint.phases": "coherent",
    }


def _keys(n, seed=7):
    return philox.point_keys(np.arange(float(n))[:, None], domain="tests", seed=seed)


def _within_5_sigma(counts, probability):
    sigma = np.sqrt(DRAWS * probability * (1 - probability))
    return np.abs(counts - DRAWS * probability) <= 5 * sigma + 1e-9 * DRAWS


@pytest.mark.parametrize("method", ["probabilities", "noise"])
def test_detections_and_false_alarms_have_their_probabilities(table_4_1, method):
    parameters = _points(table_4_1, tnr=7.0)
    outputs = evaluate(parameters)
    assert ((outputs["pd_up"] > 0.02) & (outputs["pd_up"] < 0.98)).sum() >= 2
    counts = draw(
        parameters, outputs, keys=_keys(6), first_draw=0, batch_sizes=[DRAWS], method=method
    )
    for segment in ("up", "down", "doppler", "shot"):
        found = counts[f"n_detected_{segment}"][:, 0]
        assert _within_5_sigma(found, outputs[f"pd_{segment}"]).all(), segment
    alarm = 1 - (1 - outputs["pfa_segment"]) * (1 - outputs["p_leakage_up"])
    assert ((alarm > 0.02) & (alarm < 0.98)).all()
    assert _within_5_sigma(counts["n_false_alarm_up"][:, 0], alarm).all()


@pytest.mark.parametrize("method", ["probabilities", "noise"])
def test_batches_split_the_same_draws(table_4_1, method):
    parameters = _points(table_4_1, tnr=7.0)
    outputs = evaluate(parameters)
    whole = draw(parameters, outputs, keys=_keys(6), first_draw=0, batch_sizes=[300], method=method)
    parts = draw(
        parameters, outputs, keys=_keys(6), first_draw=0, batch_sizes=[100, 150, 50], method=method
    )
    later = draw(
        parameters, outputs, keys=_keys(6), first_draw=100, batch_sizes=[150], method=method
    )
    for name, counts in parts.items():
        assert np.array_equal(counts.sum(axis=1), whole[name][:, 0]), name
        assert np.array_equal(counts[:, 1], later[name][:, 0]), name


def test_a_points_draws_do_not_depend_on_its_neighbours(table_4_1):
    parameters = _points(table_4_1, tnr=7.0)
    outputs, keys = evaluate(parameters), _keys(6)
    together = draw(parameters, outputs, keys=keys, first_draw=0, batch_sizes=[200], method="noise")
    alone = parameters | {"target.range": parameters["target.range"][4:5]}
    single = draw(
        alone, evaluate(alone), keys=keys[4:5], first_draw=0, batch_sizes=[200], method="noise"
    )
    for name, counts in single.items():
        assert counts[0, 0] == together[name][4, 0], name


def test_direct_detection_draws_no_doppler_detection(table_4_1):
    parameters = table_4_1() | {
        "instrument.receiver.architecture": "direct",
        "target.range": np.array([20.0]),
    }
    for method in ("probabilities", "noise"):
        counts = draw(
            parameters, evaluate(parameters), keys=_keys(1), first_draw=0, batch_sizes=[50],
            method=method,
        )  # fmt: skip
        assert counts["n_detected_doppler"].sum() == 0
        assert counts["n_detected_up"].sum() == 50


def test_an_unknown_method_is_refused(table_4_1):
    with pytest.raises(ValueError, match="probabilities, noise"):
        draw(table_4_1(), {}, keys=_keys(1), first_draw=0, batch_sizes=[1], method="guess")
