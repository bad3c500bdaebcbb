"""The exact means that docs/promise.md holds drawn points against."""

from pathlib import Path

import numpy as np
import pytest
import tolerance_of_draws

from sweep.model.outputs import PD_OUTPUTS
from sweep.spec import load
from sweep.storage.accuracy_setting_kinds import AS_WRITTEN_KIND
from sweep.tasks.accuracy.settings import AccuracySetting
from sweep.tasks.studies.grid_study import GridStudy

ROOT = Path(__file__).parents[2]
DRAWS = 4000
FEW = {
    "axes": {
        "target.range": ["4 km", "6 km"], "target.roughness": ["0 um", "0.07 um", "1 um"],
    },
    "draws": {"number": DRAWS, "batch": DRAWS},
}  # fmt: skip


@pytest.fixture(scope="module")
def few():
    shipped = load(ROOT / "experiments" / "speckled_target.yaml")
    return AccuracySetting(name="", kind=AS_WRITTEN_KIND, overrides=FEW | {"figures": []}).apply_to(
        shipped
    )


def test_exact_means_are_those_of_many_draws(few):
    means, off = tolerance_of_draws.exact_means(few)
    study = GridStudy(few)
    found = study.evaluate(0)
    assert study.grid.n_blocks == 1 and off < 1e-12
    for name, mean in zip(PD_OUTPUTS, means, strict=True):
        error = found[f"{name}_error"].ravel()
        assert (abs(found[name].ravel() - mean) <= 5 * error + 1e-9).all(), name
        assert ((error > 1e-4) & (error < 0.01)).sum() >= 4


def test_coverage_is_that_of_the_points_where_draws_decide():
    error = np.tile([0.0, 0.02, 0.04, 0.2], (4, 25))
    decided = np.tile([False, True, True, True], (4, 25))
    row = tolerance_of_draws.DrawnResults(
        0.1, error, np.full_like(error, 0.1), decided, np.ones(100), 1.0
    )
    share, sigmas = tolerance_of_draws.coverage(row, 0.95)
    assert share == pytest.approx(2 / 3)
    assert sigmas == pytest.approx((2 / 3 - 0.95) / np.sqrt(0.95 * 0.05 / 75))
    told = list(tolerance_of_draws.missed_tolerances("it", [row], 0.95))
    assert len(told) == 5 and "75.0%" in told[0]
    (cells,) = tolerance_of_draws.table_rows([row], 0.95)
    assert cells[2:6] == ["75.00%", "75", "66.67%", "66.7% (-11.3)"]
