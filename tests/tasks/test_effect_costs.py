"""Costs of effects in a plan: told where measuring again gives the same."""

import math
from itertools import count, cycle

import pytest

from sweep.cli.terminal import _effect_row_cells
from sweep.tasks.studies import study_plan
from sweep.tasks.studies.study_plan import EffectRow, reproducible_time_fraction


def _clocks(with_it, without):
    """Clocks that read these times by turns."""
    one, other = cycle(with_it), cycle(without)
    return lambda: next(one), lambda: next(other)


def test_times_that_repeat_give_the_share_of_the_effect():
    share = reproducible_time_fraction([_clocks([0.2], [0.15])])
    assert share == pytest.approx(0.25)
    assert reproducible_time_fraction([_clocks([0.01], [0.005]), _clocks([0.03], [0.025])]) == (
        pytest.approx(0.25)
    )
    assert reproducible_time_fraction([_clocks([0.2, 0.201, 0.199], [0.15])]) == pytest.approx(
        0.25, 0.05
    )


@pytest.mark.parametrize(
    ("with_it", "without"),
    [
        ([0.10, 0.11, 0.09], [0.09]),  # 0 to 18 %
        ([0.1], [0.1, 0.1001, 0.0999]),  # nothing, within what is measured
        ([0.2], [0.15, 0.16]),  # 20 and 25 %
        ([0.0], [0.0]),
    ],
)
def test_times_that_disagree_give_no_share(with_it, without):
    assert math.isnan(reproducible_time_fraction([_clocks(with_it, without)]))
    assert math.isnan(reproducible_time_fraction([]))


def test_long_work_is_measured_a_few_times_only(monkeypatch):
    """Of the first piece of work, if that takes long enough by itself."""
    readings, time = count(), iter(range(10**6))
    monkeypatch.setattr(study_plan.time, "process_time", lambda: float(next(time)))

    def clock(seconds):
        return lambda: next(readings) * 0 + seconds

    share = reproducible_time_fraction(
        [(clock(2.0), clock(1.0)), (clock(math.nan), clock(math.nan))]
    )
    assert share == 0.5
    assert next(readings) == 2 + 2 * study_plan.EFFECT_COST_ROUNDS_MIN


@pytest.mark.parametrize(
    ("share", "cost", "text"),
    [
        (0.5, 0.26, "26 %"),
        (0.5, math.nan, "not measured"),
        (0.0, math.nan, "-"),
    ],
)
def test_a_plan_says_what_is_known_of_a_cost(share, cost, text):
    row = EffectRow(
        name="image",
        mode="auto",
        simulated_fraction=share,
        simulated_region="",
        change_bound=0.1,
        largest_change_region="the point",
        time_fraction=cost,
    )
    assert _effect_row_cells(row)[2] == text
    assert not any("nan" in cell for cell in _effect_row_cells(row))
