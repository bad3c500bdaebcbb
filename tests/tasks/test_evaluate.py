"""Points with random effects: alone or together, and refused where nothing is drawn."""

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from small_studies import run_serially, small_spec

from sweep.cli import main
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.outputs import (
    ACCURACY_OUTPUTS,
    DRAW_COUNT_OUTPUTS,
    GRID_OUTPUTS,
    RUNNING_SUMS_NAME,
    RUNNING_SUMS_ROW_LENGTH,
    STANDARD_ERROR_OUTPUTS,
)
from sweep.tasks.studies.grid_study import evaluate_points, select_parameters_of_points
from sweep.tasks.studies.parameter_grid import ParameterBlockGrid
from sweep.tasks.studies.store_summary import count_unsupported_points

RANDOM = (*DEFAULT_EFFECTS, "speckle", "pointing_jitter")


def points(**draws):
    spec = small_spec(draws=draws, axes={"target.range": {"linear": ["1 km", "9 km"], "number": 5}})
    grid = ParameterBlockGrid(spec)
    rough = {"target.roughness": 1e-5, "target.pointing_jitter": 1e-5}
    return spec, grid.parameters_of_block(0) | rough, grid.count_block_points(0)


@pytest.mark.parametrize("method", ["probabilities", "noise"])
@pytest.mark.parametrize("effects", [DEFAULT_EFFECTS, RANDOM])
@pytest.mark.parametrize("much", [{"number": 40, "batch": 25}, {"limit": 40, "batch": 15}])
def test_points_are_evaluated_alone_as_they_are_together(much, effects, method):
    spec, parameters, count = points(**much, method=method)
    together = evaluate_points(spec, parameters, count, effects)
    sums = {RUNNING_SUMS_NAME: (RUNNING_SUMS_ROW_LENGTH,)} if effects == RANDOM else {}
    assert set(together) == {
        *GRID_OUTPUTS,
        *STANDARD_ERROR_OUTPUTS,
        *ACCURACY_OUTPUTS,
        *DRAW_COUNT_OUTPUTS,
        *sums,
    }
    random = together["pd_up_error"] > 0
    assert random.any() if effects == RANDOM else not random.any()
    for i in range(count):
        single = evaluate_points(
            spec, select_parameters_of_points(parameters, np.array([i])), 1, effects
        )
        for name, values in single.items():
            in_batches = name in DRAW_COUNT_OUTPUTS and "number" in much
            assert values.shape == (1, *((2,) if in_batches else sums.get(name, ())))
            np.testing.assert_array_equal(values[0], together[name][i], err_msg=name)


def test_random_effects_are_refused_in_a_study_without_draws():
    spec, parameters, count = points(number=0)
    with pytest.raises(ValueError, match="speckle: simulated by draws"):
        evaluate_points(spec, parameters, count, (*DEFAULT_EFFECTS, "speckle"))
    assert set(evaluate_points(spec, parameters, count, DEFAULT_EFFECTS)) == set(GRID_OUTPUTS)


@pytest.mark.parametrize(
    "draws", [{}, {"number": 3}, {"limit": 20, "batch": 10}, {"number": 2, "method": "spectra"}]
)
def test_a_point_beyond_the_model_costs_itself_alone(tmp_path, draws):
    widths = ["0 Hz", "1 kHz", "1 THz", "2 kHz", "2 THz"]
    every = ("line_width", "range_walk", "image", "leakage", "footprint", "doppler_spread")
    modes = dict.fromkeys(every, "on")  # whatever is beside a point
    sections = {"draws": draws, "effects": modes, "axes": {"instrument.laser.line_width": widths}}
    outcome = run_serially(small_spec(**sections), tmp_path / "some.zarr")
    assert outcome.complete and not outcome.failures
    reduced_sections = sections | {
        "axes": {"instrument.laser.line_width": [widths[k] for k in (0, 1, 3)]}
    }
    part = xr.open_zarr(run_serially(small_spec(**reduced_sections), tmp_path / "part.zarr").store)
    dataset = xr.open_zarr(outcome.store)
    for name in part.data_vars:
        all_values, part_values = dataset[name].values, part[name].values
        if name != "effects_error":
            np.testing.assert_array_equal(all_values[[0, 1, 3]], part_values, name)
        if not name.startswith("effects"):
            lost = all_values[[2, 4]]
            assert (np.isnan(lost) if lost.dtype.kind == "f" else lost == -1).all(), name
    number, reason = count_unsupported_points(outcome.store)
    assert number == 2 and "instrument.laser.line_width" in reason and "can be simulated" in reason
    assert count_unsupported_points(tmp_path / "part.zarr") == (0, "")
    result = CliRunner().invoke(main, ["status", str(outcome.store)])
    assert result.exit_code == 0 and reason in result.stderr


def test_a_block_beyond_the_model_is_committed_without_results(tmp_path):
    spec = small_spec(axes={"instrument.laser.line_width": ["1 THz", "2 THz"]})
    outcome = run_serially(spec, tmp_path / "none.zarr")
    assert outcome.complete
    assert np.isnan(xr.open_zarr(outcome.store).pd_shot.values).all()
