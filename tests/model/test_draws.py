"""Random draws: both ways against the closed probabilities, and independence of batching."""

import numpy as np
import pytest
from shot_helpers import make_point_keys

from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.evaluation import evaluate, shot_statistics
from sweep.model.outputs import DRAW_COUNT_OUTPUTS, GRID_OUTPUTS, STANDARD_ERROR_OUTPUTS
from sweep.model.sampling.realisations import iter_realisations
from sweep.model.sampling.samplers import simulate_draws

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


def _within_5_sigma(counts, probability):
    sigma = np.sqrt(DRAWS * probability * (1 - probability))
    return np.abs(counts - DRAWS * probability) <= 5 * sigma + 1e-9 * DRAWS


@pytest.mark.parametrize("method", ["probabilities", "noise"])
def test_detections_and_false_alarms_have_their_probabilities(table_4_1, method):
    parameters = _points(table_4_1, tnr=7.0)
    outputs = evaluate(parameters)
    assert ((outputs["pd_up"] > 0.02) & (outputs["pd_up"] < 0.98)).sum() >= 2
    counts = simulate_draws(
        parameters, DEFAULT_EFFECTS, keys=make_point_keys(6), batch_sizes=[DRAWS], method=method
    )
    for segment in ("up", "down", "doppler", "shot"):
        share = counts[f"n_detected_{segment}"][:, 0]
        assert _within_5_sigma(share, outputs[f"pd_{segment}"]).all(), segment
    alarm = 1 - (1 - outputs["pfa_segment"]) * (1 - outputs["p_leakage_up"])
    assert ((alarm > 0.02) & (alarm < 0.98)).all()
    assert _within_5_sigma(counts["n_false_alarm_up"][:, 0], alarm).all()


def test_direct_detection_draws_no_doppler_detection(table_4_1):
    parameters = table_4_1() | {
        "instrument.receiver.architecture": "direct",
        "target.range": np.array([20.0]),
    }
    for method in ("probabilities", "noise"):
        counts = simulate_draws(
            parameters, DEFAULT_EFFECTS, keys=make_point_keys(1), batch_sizes=[50], method=method
        )
        assert counts["n_detected_doppler"].sum() == 0
        assert counts["n_detected_up"].sum() == 50


RANDOM = ("speckle", "scintillation", "pointing_jitter")
UNSTEADY = {
    "target.roughness": 1e-5,
    "target.pointing_jitter": 1e-5,
    "atmosphere.turbulence": "uniform",
    "atmosphere.structure_constant": 3e-15,
    "instrument.laser.line_width": 20e3,
    "instrument.laser.line_shape": "lorentzian",
}


@pytest.mark.parametrize(
    "method, effects", [("probabilities", RANDOM), ("noise", (*RANDOM, "line_width"))]
)
def test_counts_over_random_effects_have_the_means_over_their_draws(effects, method, table_4_1):
    """A draw's Bernoulli variance is p (1 - p) of its own p: 5 sigma of their sum.

    Three more where hardly one is due, as a Poisson number of mean 0.01 exceeds 2 in 2e-7.
    """
    parameters = _points(table_4_1, tnr=6.0) | UNSTEADY
    parameters |= {
        "instrument.processing.fft_size": 8192,
        "instrument.laser.power": 1.5,
        "instrument.processing.window": "rectangular",
        "footprint.phases": "incoherent",
        "footprint.beamlets": 7,
    }
    chosen, draws = (*DEFAULT_EFFECTS, *effects), 1500
    results = simulate_draws(
        parameters, chosen, keys=make_point_keys(6), batch_sizes=[1000, 500], method=method
    )
    names = ("pd_up", "pd_doppler", "pd_down", "pd_shot", "alarm")
    table = {name: np.empty((6, draws)) for name in names}
    for point, number, shots in iter_realisations(
        parameters, chosen, keys=make_point_keys(6), draws=draws
    ):
        outputs = shot_statistics(shots)
        quiet = (1 - outputs["pfa_segment"]) * (1 - outputs["p_leakage_up"])
        for name, values in (outputs | {"alarm": 1 - quiet}).items():
            if name in table:
                table[name][point, number] = values
    counted = {f"pd_{s}": f"n_detected_{s}" for s in ("up", "doppler", "down", "shot")}
    for name, count in (counted | {"alarm": "n_false_alarm_up"}).items():
        p = table[name]
        sigma = np.sqrt((p * (1 - p)).sum(axis=1))
        assert (abs(results[count].sum(axis=1) - p.sum(axis=1)) <= 5 * sigma + 3).all(), name
        assert ((p.mean(axis=1) > 0.02) & (p.mean(axis=1) < 0.98)).sum() >= 2, name
        if name in GRID_OUTPUTS:
            np.testing.assert_allclose(results[name], p.mean(axis=1), rtol=1e-10)


@pytest.mark.parametrize("method", ["probabilities", "noise"])
@pytest.mark.parametrize("random", [(), RANDOM])
def test_batches_split_the_same_draws(method, random, table_4_1):
    parameters = _points(table_4_1, tnr=6.0) | UNSTEADY
    parameters |= {"instrument.processing.fft_size": 4096, "instrument.laser.power": 1.5}
    parameters |= {"footprint.beamlets": 7, "target.grazing_angle": np.linspace(0.3, 1.5, 6)}
    arguments = {"keys": make_point_keys(6), "method": method}
    effects = (*DEFAULT_EFFECTS, *random)
    results = simulate_draws(parameters, effects, batch_sizes=[300], **arguments)
    parts = simulate_draws(parameters, effects, batch_sizes=[100, 150, 50], **arguments)
    later = simulate_draws(parameters, effects, first_draw=100, batch_sizes=[150], **arguments)
    for name in DRAW_COUNT_OUTPUTS:
        np.testing.assert_array_equal(parts[name].sum(axis=1), results[name][:, 0])
        np.testing.assert_array_equal(parts[name][:, 1], later[name][:, 0])
    for name in (*GRID_OUTPUTS, *STANDARD_ERROR_OUTPUTS):
        np.testing.assert_array_equal(parts[name], results[name])
