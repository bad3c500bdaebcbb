"""Test whether each of six tolerances is kept, at 1,000 points of every experiment.

As many random instruments are tested too. Run with `make promise`, some twenty minutes. Names of
experiments, or `instruments`, as arguments restrict the test to these. Writes docs/promise.md.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import tolerance_of_draws
import tolerance_of_random_instruments
from benchmark_helpers import DOCS, EXPERIMENTS, markdown_table, wrap_page
from rich.console import Console
from rich.progress import Progress

from sweep.model.error_budget import ErrorBudget
from sweep.spec import GridSpec, SceneSpec, SpecError, load
from sweep.storage.accuracy_setting_kinds import (
    ADAPTIVE_KIND,
    ALL_EFFECTS_KIND,
    AS_WRITTEN_KIND,
    FIXED_EFFECTS_KIND,
    REFERENCE_KIND,
)
from sweep.tasks.accuracy.measurement import (
    N_ERRORS_BOUNDED_BY_TOLERANCE,
    add_settings_with_fixed_effects,
    result_differences,
    tolerance_of_setting,
)
from sweep.tasks.accuracy.settings import (
    REFERENCE_RAYS_PER_SHOT,
    REFERENCE_RAYS_TOLERANCE,
    TRIED_TOLERANCES,
    AccuracySetting,
    SettingLadder,
    build_setting_ladder,
)
from sweep.tasks.accuracy.study_sample import (
    FlightSample,
    GridSample,
    StudySample,
    Trial,
    merge_trials,
)
from sweep.tasks.studies.parameter_grid import ParameterBlockGrid

POINTS, SEED, ROUNDS = 1000, 2017, 5
POINTS_TIMED_TOGETHER = 4096
"""Number of points timed together, because the cost of a point depends on its block."""
SHARE_WITHIN_MIN = 0.999
"""Share of the points that must keep a tolerance."""
REPEATED_TRIAL_SECONDS_MAX = 0.5
"""Longest trial that is repeated [s]; longer ones are timed accurately enough by one run."""
BEAMLETS = "footprint.beamlets"
CHECK_RAYS = 31_987
"""Number of rays with which the reference of flights is compared."""
COHERENT_CHECK_RAYS = 4_009
"""Number of rays with which coherent flights are compared."""
COST_RATIO_MAX = 1.1
"""Largest ratio of timings that counts as equal."""
SAME_ERROR_RATIO, ZERO_ERROR = 1.1, 1e-9
"""Largest ratio of errors that count as equal, and largest error that counts as zero."""
ERROR_QUANTITIES = ("pd", "log10 pfa", "magnitude", "leakage")
INSTRUMENTS_SECTION = "instruments"
EXPERIMENT_VARIANTS = {
    "range_angle_over_rough_ground": (
        "range_angle", {"footprint.phases": "incoherent", "footprint.beamlets": "auto"},
    ),
}  # fmt: skip
"""Experiments with overrides, by the name of the variant."""
PAGE_HEAD = """# Is the tolerance kept?

Written by `make promise`. It computes 1,000 random points of each experiment (of flights, some
tiles of shots) at each `accuracy.tolerance`. `footprint.beamlets` is `auto` where the experiment
leaves the number free. The reference has all effects on. It has as many beamlets as at 1e-9, or in
flights more rays than any tolerance needs.

The columns are the errors of pd (the largest of segments and shot), of log10 of the probability of
a false alarm, and of |X| of the largest bins. The error of |X| is relative to itself, or to sigma
if that is larger. A cell has the error of the worst point. If not all points are within the
tolerance, it begins with the share of those that are; 99.9 % are required. Studies with draws have
a table of their own.

The last error is that of the probability of leakage in the up- or the down-chirp. Skipping leakage
itself keeps the tolerance. The tolerance does not cover the change of leakage by other skipped
effects and by few beamlets ([effects](effects.md)). This column shows that change. It does not
count in comparisons of settings.

A detection occupies some of the 65,536 bins that could raise a false alarm. One bin more or fewer
changes log10 pfa by 6.6e-6.

`us` is processor time a point, planning included. Two columns have the time of other settings, with
the same effects at every point, and with lines and leakage to one of the six tolerances. `fixed` is
the cheapest of these that keeps the tolerance. `front` is the cheapest whose worst error is no
larger than this row's, as on the front of error against time of `sweep accuracy`.

"""
RAYS_SECTION = f"""
## Flights against many more rays

Each beamlet of a flight is a ray. If powers add, `footprint.beamlets: auto` casts few rays for
every shot, and more for shots that need them. The rows show the number of rays of a shot, and
the error against a reference. The reference has all effects on and \
{REFERENCE_RAYS_PER_SHOT:,} rays of every
shot, or more until the estimated error is below {REFERENCE_RAYS_TOLERANCE:g},
{ErrorBudget.ray_counts[-1]:,} at
the most. A number given by an experiment has a row too, with all effects on. The last row of each
flight compares the reference with {CHECK_RAYS:,} rays and more, at a part of the flight. A cell has
the share of shots within the tolerance, the largest error of the best 90 % of the shots, and the
worst error. `us` is processor time a shot, rays included.

If phases are coherent, the number of beamlets is part of the scene, as in the thesis. No number is
enough: a smooth slope sends almost nothing back, and the small sum that remains depends on the
number. These flights have one row, their own number against {COHERENT_CHECK_RAYS:,}.
"""
COSTS_SECTION = """
## Cost and tolerance

The test asks whether cost rises with accuracy no faster than on the front of error against time.
The first table has the ratio of `us` to `front` at each tolerance. The answer is yes if no ratio is
higher by more than {margin:.0%} than the first, or than 1 if the first is lower.

{front}

A stricter test compares with the cheapest setting that keeps the tolerance (`fixed`). Its accuracy
is known only afterwards, and most settings are far more accurate than their tolerance. So the
setting for a loose tolerance often serves for tighter ones too, at the same cost.

{fixed}
"""


class ToleranceRow(NamedTuple):
    """Errors and times of an experiment at a tolerance."""

    tolerance: float
    errors: tuple[np.ndarray, ...]
    """Errors (points,) of each quantity, in the order of `ERROR_QUANTITIES`."""
    seconds: float
    fixed_seconds: float = np.nan
    """Time per point of the cheapest fixed setting that keeps the tolerance [s], or nan."""
    front_seconds: float = np.nan
    """Time per point of the cheapest fixed setting whose worst error is no larger [s]; nan without
    one."""
    label: str = ""
    """Text that a table shows in place of the tolerance."""


def run_trials(bench: StudySample, settings: Sequence[AccuracySetting], rounds: int) -> list[Trial]:
    """Run each setting on all points of a sample; return results and the best times.

    `settings` are those compared.
    """
    parts = bench.split_into_parts(bench.size)
    for setting in settings:  # compiles what there is to compile
        bench.try_setting(setting, parts[0] if len(parts) > 1 else parts[0][:1], 1)
    bench.clear_caches()
    trials_by_part: list[list[Trial]] = []
    for part in parts:
        best_by_setting: dict[int, Trial] = {}
        for round_number in range(rounds):  # in turn, so that whatever slows the machine slows all
            for setting_number, setting in enumerate(settings):
                if round_number > 0 and (
                    setting.kind == REFERENCE_KIND
                    or best_by_setting[setting_number].seconds_per_point * len(part)
                    > REPEATED_TRIAL_SECONDS_MAX
                ):
                    continue
                points_together = (
                    1
                    if setting.kind == REFERENCE_KIND
                    else min(POINTS_TIMED_TOGETHER, bench.timed_points_max)
                )
                trial = bench.try_setting(setting, part, points_together)
                best_by_setting[setting_number] = min(
                    best_by_setting.get(setting_number, trial),
                    trial,
                    key=lambda trial: trial.seconds_per_point,
                )
        trials_by_part.append(
            [best_by_setting[setting_number] for setting_number in sorted(best_by_setting)]
        )
        bench.clear_caches()
    return [merge_trials(trials) for trials in zip(*trials_by_part, strict=True)]


class ExperimentResult(NamedTuple):
    """Rows of the tables for an experiment."""

    rows: list[ToleranceRow]
    ray_rows: list[ToleranceRow]
    """Rows for the number of rays of a flight.

    They compare its own numbers with many more rays; the last row compares these with even more.
    """


def measure_experiment(spec: GridSpec | SceneSpec) -> ExperimentResult:
    """Measure errors and times of a study without draws at each tolerance."""
    is_flight = isinstance(spec, SceneSpec)
    bench = (
        FlightSample(spec, POINTS) if is_flight else GridSample(spec, POINTS, random_points(spec))
    )
    full_ladder = build_setting_ladder(spec)
    setting_by_tolerance = {
        tolerance_of_setting(setting): setting
        for setting in full_ladder.settings
        if setting.kind == ADAPTIVE_KIND
    }
    full_ladder = add_settings_with_fixed_effects(full_ladder, bench, TRIED_TOLERANCES)
    fixed_settings = [
        setting
        for setting in full_ladder.settings
        if setting.kind in (FIXED_EFFECTS_KIND, ALL_EFFECTS_KIND)
    ]
    settings = [*setting_by_tolerance.values(), *fixed_settings, full_ladder.reference]
    trials = run_trials(bench, settings, ROUNDS)
    trial_by_name = {setting.name: trial for setting, trial in zip(settings, trials, strict=True)}
    all_effects_setting = next(
        setting for setting in fixed_settings if setting.kind == ALL_EFFECTS_KIND
    )
    reference_seen = trial_by_name[full_ladder.reference.name].results
    worst_by_name = {
        setting.name: worst_error(
            result_differences(trial_by_name[setting.name].results, reference_seen)
        )
        for setting in fixed_settings
    }
    rows, ray_rows = [], []
    for tolerance, setting in setting_by_tolerance.items():
        trial = trial_by_name[setting.name]
        errors = result_differences(trial.results, reference_seen)
        worst_of_row = worst_error(errors)
        fixed_seconds, front_seconds = (
            min(
                (
                    trial_by_name[name].seconds_per_point
                    for name, error in worst_by_name.items()
                    if error <= error_max
                ),
                default=np.nan,
            )
            for error_max in (tolerance, max(SAME_ERROR_RATIO * worst_of_row, ZERO_ERROR))
        )
        rows.append(
            ToleranceRow(tolerance, errors, trial.seconds_per_point, fixed_seconds, front_seconds)
        )
        label = f"{tolerance:g}: {rays_text(trial.results.n_beamlets)}" if is_flight else ""
        ray_rows.append(rows[-1]._replace(label=label))
    if not is_flight:
        return ExperimentResult(rows, [])
    if BEAMLETS not in full_ladder.reference.overrides:
        return ExperimentResult(
            rows,
            [
                reference_check_row(
                    bench,
                    full_ladder,
                    trial_by_name[all_effects_setting.name],
                    "own, coherent",
                    COHERENT_CHECK_RAYS,
                )
            ],
        )
    if spec.footprint.beamlets:
        given_number_trial, label = (
            trial_by_name[all_effects_setting.name],
            f"{spec.footprint.beamlets:,} by hand",
        )
        ray_rows.append(
            ToleranceRow(
                np.inf,
                result_differences(given_number_trial.results, reference_seen),
                given_number_trial.seconds_per_point,
                label=label,
            )
        )
    trial, label = (
        trial_by_name[full_ladder.reference.name],
        f"{REFERENCE_RAYS_PER_SHOT:,} rays and more",
    )
    check_row = reference_check_row(bench, full_ladder, trial, label, CHECK_RAYS)
    return ExperimentResult(rows, [*ray_rows, check_row])


def random_points(spec: GridSpec) -> np.ndarray:
    """Draw the numbers of points of a study, uniformly and without repetition; sorted."""
    points = ParameterBlockGrid(spec).n_points
    chosen = np.random.default_rng(SEED).choice(points, min(POINTS, points), replace=False)
    return np.sort(chosen)


def worst_error(errors: Sequence[np.ndarray]) -> float:
    """Return the largest of the errors that the tolerance covers."""
    return float(np.nanmax(np.concatenate(errors[:N_ERRORS_BOUNDED_BY_TOLERANCE])))


def rays_text(rays_by_shot: np.ndarray) -> str:
    """Return mean and maximum number of rays of the shots that have any, as text."""
    if not np.isfinite(rays_by_shot).any():
        return "nothing seen"
    return f"{np.nanmean(rays_by_shot):,.0f} rays, at most {np.nanmax(rays_by_shot):,.0f}"


def reference_check_row(
    bench: StudySample, full_ladder: SettingLadder, timed_trial: Trial, label: str, more_rays: int
) -> ToleranceRow:
    """Compare the reference with more rays at a part of the sample; return the row."""
    reference, part = full_ladder.reference, bench.split_into_parts(bench.size)[0]
    finer = replace(
        reference, name=f"{more_rays} rays", overrides={**reference.overrides, BEAMLETS: more_rays}
    )
    reference_trial, finer_trial = (
        bench.try_setting(setting, part, 1) for setting in (reference, finer)
    )
    bench.clear_caches()
    return ToleranceRow(
        np.inf,
        result_differences(reference_trial.results, finer_trial.results),
        timed_trial.seconds_per_point,
        label=label,
    )


def error_cell(errors: np.ndarray, tolerance: float) -> str:
    """Return a cell with the worst error, after the share of points within the tolerance.

    The share is left out if all points are within.
    """
    known_errors = errors[np.isfinite(errors)]
    if not known_errors.size:
        return "-"
    worst, share_within = float(known_errors.max()), float((known_errors <= tolerance).mean())
    return (
        error_text(worst)
        if share_within == 1
        else f"**{100 * share_within:.2f} %**, {error_text(worst)}"
    )


def error_text(error: float) -> str:
    """Return an error as text for a cell."""
    return "<1e-9" if error < 1e-9 else f"{error:.1e}"


def error_spread_cell(errors: np.ndarray, tolerance: float) -> str:
    """Return a cell with the share of points within the tolerance, 90 % quantile and maximum."""
    known_errors = errors[np.isfinite(errors)]
    if not known_errors.size:
        return "-"
    share_within_text = (
        f"{100 * (known_errors <= tolerance).mean():.4g} %, " if np.isfinite(tolerance) else ""
    )
    return (
        f"{share_within_text}{error_text(np.quantile(known_errors, 0.9))}, "
        f"{error_text(known_errors.max())}"
    )


def error_table_rows(name: str, rows: Sequence[ToleranceRow]) -> Iterator[list[str]]:
    """Yield an experiment's rows of the table of errors."""
    for row in rows:
        cells = [error_cell(errors, row.tolerance) for errors in row.errors]
        times = [
            f"{1e6 * seconds:.3g}" if np.isfinite(seconds) else "-"
            for seconds in (row.seconds, row.fixed_seconds, row.front_seconds)
        ]
        yield [name, f"{len(row.errors[0]):,}", f"{row.tolerance:g}", *cells, *times]


def ray_table_rows(name: str, rows: Sequence[ToleranceRow]) -> Iterator[list[str]]:
    """Yield an experiment's rows of the table of rays."""
    for row in rows:
        cells = [error_spread_cell(errors, row.tolerance) for errors in row.errors]
        yield [name, row.label or f"{row.tolerance:g}", *cells, f"{1e6 * row.seconds:.3g}"]


def cost_row(name: str, ratios: Sequence[float]) -> list[str]:
    """Return a row of a table of costs: ratios by tolerance, and whether they rise."""
    known_ratios = [ratio for ratio in ratios if np.isfinite(ratio)]
    cost_rise = max(known_ratios) / max(known_ratios[0], 1.0) if known_ratios else np.nan
    verdict = "kept" if cost_rise <= COST_RATIO_MAX else f"NOT kept: {cost_rise:.2f} times"
    cells = [f"{ratio:.2f}" if np.isfinite(ratio) else "-" for ratio in ratios]
    return [name, *cells, verdict if known_ratios else "no front"]


def missed_tolerances(name: str, rows: Sequence[ToleranceRow]) -> Iterator[str]:
    """Yield a line of text for each quantity that does not keep its tolerance."""
    for row in rows:
        for quantity, errors in zip(ERROR_QUANTITIES, row.errors, strict=True):
            known_errors = errors[np.isfinite(errors)]
            share_within = (
                float((known_errors <= row.tolerance).mean()) if known_errors.size else 1.0
            )
            if share_within < SHARE_WITHIN_MIN:
                share_missed = f"{100 * (1 - share_within):.2f} %"
                message = (
                    f"- {name} at {row.tolerance:g}: {quantity} of {share_missed} of the points"
                )
                yield message + (", which is not promised" if quantity == "leakage" else "")


class TolerancePage:
    """The page docs/promise.md, to which experiments are added one by one."""

    def __init__(self) -> None:
        self._missed: list[str] = []
        self._error_rows: list[list[str]] = []
        self._ray_rows: list[list[str]] = []
        self._front_rows: list[list[str]] = []
        self._cost_rows: list[list[str]] = []
        self._sections: dict[str, list[str]] = {"drawn": [], "instruments": []}

    def add_random_instruments(self) -> None:
        """Test random instruments and add their section."""
        missed_messages, section_text = tolerance_of_random_instruments.instruments_section(
            POINTS, np.random.default_rng()
        )
        self._missed += missed_messages
        self._sections["instruments"].append(section_text)

    def add_experiment(self, stem: str) -> None:
        """Test an experiment, given by the stem of its file, and add its rows."""
        experiment, overrides = EXPERIMENT_VARIANTS.get(stem, (stem, {}))
        name, path = stem.replace("_", " "), EXPERIMENTS / f"{experiment}.yaml"
        try:
            spec = load(path)
        except SpecError as error:
            self._missed.append(f"- {name}: not looked at: {str(error).splitlines()[0]}")
            return
        spec = AccuracySetting(name="", kind=AS_WRITTEN_KIND, overrides=overrides).apply_to(spec)
        if spec.draws.method == "spectra":
            self._missed.append(f"- {name}: not looked at: draws noise alone, and counts")
        elif not isinstance(spec, SceneSpec) and spec.draws.has_draws:
            rows, integral_error = tolerance_of_draws.draw_at_tolerances(path, spec)
            self._missed += tolerance_of_draws.missed_tolerances(
                name, rows, float(spec.accuracy.confidence)
            )
            self._sections["drawn"].append(
                tolerance_of_draws.study_section(name, rows, integral_error, spec)
            )
        else:
            self._add_result(name, measure_experiment(spec))

    def _add_result(self, name: str, result: ExperimentResult) -> None:
        self._error_rows += error_table_rows(name, result.rows)
        self._ray_rows += ray_table_rows(name, result.ray_rows)
        self._front_rows.append(
            cost_row(name, [row.seconds / row.front_seconds for row in result.rows])
        )
        self._cost_rows.append(
            cost_row(name, [row.seconds / row.fixed_seconds for row in result.rows])
        )
        self._missed += missed_tolerances(name, result.rows)

    def page_text(self) -> str:
        """Return the text of the page."""
        columns = ["experiment", "points", "tolerance", *ERROR_QUANTITIES, "us", "fixed", "front"]
        by_tolerance = [
            "experiment",
            *(f"{tolerance:g}" for tolerance in TRIED_TOLERANCES),
            "no faster",
        ]
        front, fixed = (
            markdown_table(by_tolerance, rows) for rows in (self._front_rows, self._cost_rows)
        )
        parts = [
            PAGE_HEAD.strip(),
            "\n".join(self._missed) if self._missed else "Every tolerance is kept.",
            markdown_table(columns, self._error_rows),
            *self._sections["drawn"],
            *self._sections["instruments"],
            RAYS_SECTION.strip(),
            markdown_table(["experiment", "tolerance", *ERROR_QUANTITIES, "us"], self._ray_rows),
            COSTS_SECTION.strip().format(margin=COST_RATIO_MAX - 1, front=front, fixed=fixed),
        ]
        return wrap_page("\n\n".join(parts)) + "\n"


def main() -> None:
    """Write the page, or print the rows of the experiments named as arguments."""
    all_names = sorted([*EXPERIMENT_VARIANTS, *(path.stem for path in EXPERIMENTS.glob("*.yaml"))])
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*all_names, INSTRUMENTS_SECTION, []])
    arguments = parser.parse_args()
    page = TolerancePage()
    with Progress(console=Console(stderr=True)) as bar:
        names = arguments.names or [*all_names, INSTRUMENTS_SECTION]
        for experiment_name in bar.track(names, description="points of each experiment"):
            if experiment_name == INSTRUMENTS_SECTION:
                page.add_random_instruments()
            else:
                page.add_experiment(experiment_name)
    text = page.page_text()
    if arguments.names:
        print(text.removeprefix(PAGE_HEAD))
    else:
        (DOCS / "promise.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
