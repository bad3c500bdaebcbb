"""Few lines for many, to the accuracy asked for: bins against those of the strictest tolerance."""

from dataclasses import replace

import numpy as np
import pytest

from sweep.model.effects.catalogue import DEFAULT_EFFECTS, PARAMETER_DEFAULTS
from sweep.model.evaluation import evaluate_segments, prepare_shots

POINTS = 200


def some_shots(table_4_1, phases, effects, seed):
    """From the target on the doorstep to the far one, where phases cancel and where they do not."""
    rng = np.random.default_rng((81, seed))
    parameters = PARAMETER_DEFAULTS | table_4_1(
        phases=phases, fft_size=2**13, window=str(rng.choice(["hamming", "flattop"])),
        range=10 ** rng.uniform(0.5, 4, POINTS), power=10 ** rng.uniform(-3, 1, POINTS),
        grazing_angle=np.radians(rng.uniform(2, 90, POINTS)),
        radial_velocity=rng.choice([5.0, 150.0], POINTS), beam_divergence=1e-4,
    )  # fmt: skip
    ((_, shots),) = prepare_shots(parameters, effects)
    return shots


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
@pytest.mark.parametrize(
    "effects", [DEFAULT_EFFECTS, (*DEFAULT_EFFECTS, "range_walk")], ids=["plain", "range walk"]
)
def test_bins_are_within_what_is_allowed_and_pd_within_half_of_it(table_4_1, phases, effects):
    n_changed = 0
    for seed in range(3):
        shots = some_shots(table_4_1, phases, effects, seed)
        exact = evaluate_segments(shots)
        for tolerance in (1e-1, 1e-3, 1e-6):
            spectra = evaluate_segments(
                replace(
                    shots, tolerances=shots.tolerances._replace(line_error=np.asarray(tolerance))
                )
            )
            errors = abs(spectra.magnitude - exact.magnitude) / shots.bin_noise_sigma
            rounding = 1e-11 * exact.magnitude / shots.bin_noise_sigma
            assert (errors <= tolerance + rounding).all()
            assert abs(spectra.pd - exact.pd).max() <= 0.5 * tolerance + 1e-9
            n_changed += (errors > 10 * rounding).sum()
    assert n_changed > 100


def test_parts_of_the_tolerance_can_be_set_by_hand(table_4_1):
    parameters = PARAMETER_DEFAULTS | table_4_1(phases="coherent", fft_size=2**12)
    errors_by_path = {"accuracy.line_error": 1e-4, "accuracy.leakage_error": 2e-5}
    ((_, by_hand),) = prepare_shots(parameters | errors_by_path | {"accuracy.tolerance": 0.1})
    assert (by_hand.tolerances.line_error, by_hand.tolerances.leakage_probability) == (1e-4, 2e-5)
    ((_, auto),) = prepare_shots(parameters | {"accuracy.tolerance": 0.1})
    assert auto.tolerances.line_error == pytest.approx(0.1)
    assert auto.tolerances.leakage_probability == pytest.approx(0.05)
