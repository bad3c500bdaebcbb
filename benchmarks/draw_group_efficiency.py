"""Compare draws in groups with independent draws: numbers of draws and time for one half-width.

Run with `make draw-groups`, some minutes on one core. The points of the experiment speckled_target
whose speckle is drawn are drawn until their half-width is within a tolerance, both ways in turn.
Their errors are differences from exact means. Writes the table in docs/accuracy.md.
"""

import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from benchmark_helpers import experiment_spec, markdown_table, replace_page_part
from tolerance_of_draws import exact_means

from sweep.model.error_budget import ErrorBudget
from sweep.model.outputs import PD_OUTPUT_NAMES
from sweep.model.sampling.samplers import (
    DetectionSampler,
    draw_until_accurate,
    simulate_draws,
    stopping_check_draws,
)
from sweep.tasks.studies.grid_study import (
    GridStudy,
    random_keys_of_points,
    select_parameters_of_points,
)

TOLERANCES = (0.03, 0.01, 0.003)
CONFIDENCE_LEVEL, BATCH_DRAWS, DRAWS_MAX = 0.95, 100, 10**7
ROUNDS = 3
"""Number of rounds in which both ways take turns."""

SECTION_HEAD = """## Draws in groups

Random effects are drawn in groups of 64 draws, over which their random numbers are spread evenly
([draws](draws.md#groups)). The table compares them with independent draws: the points of
`experiments/speckled_target.yaml` whose speckle is drawn, until their half-width is within the
tolerance. Both ways take turns in one run, and the ratio of processor times is the median over
rounds. `within` is the share of points whose four probabilities are all within the tolerance of
their exact means, which are integrals. `make draw-groups` measures and writes it.
"""


class IndependentDraws(DetectionSampler):
    """Sampler whose draws are independent of each other."""

    draws_are_grouped = False


class DrawnPoints(NamedTuple):
    """Points of the experiment with the same effects, and what is known of them."""

    indices: np.ndarray
    """(n,) int64: indices of the points in the grid."""
    parameters: dict
    """Parameters of the points by dotted path."""
    effects: tuple[str, ...]
    """Names of the effects that are simulated."""
    keys: np.ndarray
    """(n, 2) uint64: random keys of the points."""


class Measurement(NamedTuple):
    """Result of one way of drawing all points, with a tolerance."""

    seconds: float
    """Processor time [s]."""
    n_draws: np.ndarray
    """(points,): number of draws of each point."""
    errors: np.ndarray
    """(points,): largest difference from the exact means of a point's probabilities."""


def drawn_points(spec) -> list[DrawnPoints]:
    """Return the points of the study whose speckle is drawn, block by block, by their effects."""
    study, groups = GridStudy(spec), []
    for block in range(study.grid.n_blocks):
        parameters = study.grid.parameters_of_block(block)
        selected = study.effect_planner.select_for_block(block)
        slices = study.grid.block_slices(block)
        indices = np.arange(study.grid.n_points).reshape(study.grid.shape)[slices].ravel()
        for members, effects in selected.iter_groups_by_effects():
            if "speckle" in effects:
                subset = select_parameters_of_points(parameters, members)
                keys = random_keys_of_points(spec, subset, len(members))
                groups.append(DrawnPoints(indices[members], subset, tuple(effects), keys))
    return groups


def draw_in_groups(points: DrawnPoints, error_budget: ErrorBudget) -> dict[str, np.ndarray]:
    """Draw points in groups of draws until they are accurate; return their results by name."""
    return simulate_draws(
        points.parameters, points.effects, keys=points.keys, method="probabilities",
        batch=BATCH_DRAWS, limit=DRAWS_MAX, error_budget=error_budget,
    )  # fmt: skip


def draw_independently(points: DrawnPoints, error_budget: ErrorBudget) -> dict[str, np.ndarray]:
    """Draw points by independent draws until they are accurate; return their results by name."""
    sampler = IndependentDraws(
        points.parameters, points.effects, keys=points.keys, method="probabilities",
        batch_edges=np.array([0, DRAWS_MAX]),
    )  # fmt: skip
    checks = stopping_check_draws(BATCH_DRAWS, DRAWS_MAX)
    draw_until_accurate(sampler, np.arange(len(points.keys)), checks, error_budget)
    return sampler.results(error_budget)


def measure(draw, groups: list[DrawnPoints], means: np.ndarray, tolerance: float) -> Measurement:
    """Draw all points by a function, and compare them with the exact means (4, points)."""
    error_budget = ErrorBudget(tolerance, CONFIDENCE_LEVEL)
    start = time.process_time()
    results = [draw(points, error_budget) for points in groups]
    seconds = time.process_time() - start
    errors = [
        np.max([abs(result[name] - exact[points.indices])
                for name, exact in zip(PD_OUTPUT_NAMES, means, strict=True)], axis=0)
        for points, result in zip(groups, results, strict=True)
    ]  # fmt: skip
    n_draws = np.concatenate([result["n_draws"] for result in results])
    return Measurement(seconds, n_draws, np.concatenate(errors))


def table_rows() -> Iterator[list[str]]:
    """Yield the rows of the table."""
    spec = experiment_spec("speckled_target")
    groups, (means, _) = drawn_points(spec), exact_means(spec)
    draw_in_groups(groups[0], ErrorBudget(0.1))  # compile
    draw_independently(groups[0], ErrorBudget(0.1))
    for tolerance in TOLERANCES:
        ways = (draw_independently, draw_in_groups)
        rounds = [
            [measure(way, groups, means, tolerance) for way in ways]
            for _ in range(ROUNDS if tolerance > 0.005 else 1)
        ]
        before, after = rounds[-1]
        time_ratio = np.median([old.seconds / new.seconds for old, new in rounds])
        yield [
            f"{tolerance:g}",
            f"{before.n_draws.mean():,.0f}",
            f"{after.n_draws.mean():,.0f}",
            f"{before.n_draws.sum() / after.n_draws.sum():.1f}",
            f"{time_ratio:.1f}",
            f"{(before.errors <= tolerance).mean():.1%}",
            f"{(after.errors <= tolerance).mean():.1%}",
        ]


COLUMNS = (
    "tolerance", "draws, independent", "draws in groups", "ratio of draws", "ratio of times",
    "within, independent", "within, in groups",
)  # fmt: skip


def page_section() -> str:
    """Measure both ways of drawing, and return their section of docs/accuracy.md."""
    table = markdown_table(COLUMNS, table_rows())
    return f"{SECTION_HEAD}\n<!-- draw-groups: begin -->\n{table}\n<!-- draw-groups: end -->\n"


if __name__ == "__main__":
    replace_page_part("accuracy.md", "draw-groups", markdown_table(COLUMNS, table_rows()))
