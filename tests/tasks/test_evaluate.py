"""Points with random effects: alone or together, and refused where nothing is drawn."""

import numpy as np
import pytest
from small import small

from sweep.model.effects.catalogue import CORE
from sweep.model.outputs import ACCURACY_OUTPUTS, DRAW_OUTPUTS, ERROR_OUTPUTS, OUTPUTS, RUNNING
from sweep.model.realisations import RUNNING_COLUMNS
from sweep.tasks.evaluate import evaluate_points, select
from sweep.tasks.grid import Grid

RANDOM = (*CORE, "speckle", "pointing_jitter")


def points(**draws):
    spec = small(draws=draws, axes={"target.range": {"linear": ["1 km", "9 km"], "number": 5}})
    grid = Grid(spec)
    rough = {"target.roughness": 1e-5, "target.pointing_jitter": 1e-5}
    return spec, grid.parameters(0) | rough, grid.block_size(0)


@pytest.mark.parametrize("method", ["probabilities", "noise"])
@pytest.mark.parametrize("effects", [CORE, RANDOM])
@pytest.mark.parametrize("much", [{"number": 40, "batch": 25}, {"limit": 40, "batch": 15}])
def test_points_are_evaluated_alone_as_they_are_together(much, effects, method):
    spec, parameters, count = points(**much, method=method)
    together = evaluate_points(spec, parameters, count, effects)
    sums = {RUNNING: (RUNNING_COLUMNS,)} if effects == RANDOM else {}
    assert set(together) == {*OUTPUTS, *ERROR_OUTPUTS, *ACCURACY_OUTPUTS, *DRAW_OUTPUTS, *sums}
    random = together["pd_up_error"] > 0
    assert random.any() if effects == RANDOM else not random.any()
    for i in range(count):
        alone = evaluate_points(spec, select(parameters, np.array([i])), 1, effects)
        for name, values in alone.items():
            in_batches = name in DRAW_OUTPUTS and "number" in much
            assert values.shape == (1, *((2,) if in_batches else sums.get(name, ())))
            np.testing.assert_array_equal(values[0], together[name][i], err_msg=name)


def test_random_effects_are_refused_in_a_study_without_draws():
    spec, parameters, count = points(number=0)
    with pytest.raises(ValueError, match="speckle: simulated by draws"):
        evaluate_points(spec, parameters, count, (*CORE, "speckle"))
    assert set(evaluate_points(spec, parameters, count, CORE)) == set(OUTPUTS)
