"""Compare effects on demand with all effects on: change of results, and time saved.

Run with `make effects`, some minutes. Every experiment in the repository is computed with all
effects forced on, and with effects on demand at three tolerances. Draws of noise in flights are
left out. One process computes all variants in turn, so that ratios of times are more reliable than
times. Writes docs/effects_table.md.
"""

import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
from benchmark_helpers import DOCS, EXPERIMENTS, markdown_row
from rich.progress import Progress

from sweep.model.effects.catalogue import EFFECTS
from sweep.spec import GridSpec, SceneSpec, SpecError, load
from sweep.spec.yaml_document import read_document
from sweep.tasks import driver
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.study_loading import make_study

TOLERANCES = (1e-1, 1e-2, 1e-3)
N_DRAWS = 1000
PROBABILITY_OUTPUTS = ("pd_up", "pd_doppler", "pd_down", "pd_shot")
PAGE_HEAD = """# Effects on demand, and all of them on

Written by `make effects`. For each experiment the table has the time with every effect forced on,
each computed with the scene's own parameters. The next columns have effects on demand at three
tolerances: how many times faster that is, planning included, and the largest change of any
probability of detection anywhere, which has to stay below the tolerance. `planning` is its share of
the time at the tightest tolerance. It takes some milliseconds a block at least, which shows where
all blocks together take less than a second. Studies with draws take 1000 a point here.

"""


class VariantResult(NamedTuple):
    """Times [s] and probabilities of a variant of an experiment."""

    seconds: float
    planning: float
    probabilities: dict[str, np.ndarray]


def variant_spec(path: Path, tolerance: float | None) -> GridSpec | SceneSpec:
    """Return an experiment's spec with effects on demand at a tolerance, or all on for None."""
    mapping = read_document(path).content
    spec_class = SceneSpec if "scene" in mapping else GridSpec
    has_draws = spec_class is GridSpec and "draws" in mapping
    if has_draws:  # a tolerance also says how often; here all variants share their draws
        mapping["draws"] = {"number": N_DRAWS}
    elif spec_class is SceneSpec:  # noise of further flights, which changes no probability
        mapping.pop("draws", None)
    effects_on = {effect.name: "on" for effect in EFFECTS if has_draws or not effect.is_random}
    mapping["effects"] = effects_on if tolerance is None else {}
    mapping["accuracy"] = dict(mapping.get("accuracy", {}), tolerance=tolerance or 0.0)
    return spec_class.from_mapping(mapping, base=path.parent)


def evaluate_variant(
    spec: GridSpec | SceneSpec, folder: Path, progress: Progress, title: str
) -> VariantResult:
    """Compute the probabilities of detection at every point, and measure the time."""
    store_path, is_flight = folder / "study.zarr", isinstance(spec, SceneSpec)
    if is_flight and not (folder / "eyepoints").exists():
        driver.run(spec, store=store_path, progress=False)  # casts the rays
    study = make_study(spec, store_path)
    study.compile_kernels()
    values_by_name: dict[str, list[np.ndarray]] = {}
    progress_task = progress.add_task(title, total=study.n_points)
    total = planning = 0.0
    original_select = FlightStudy.select_effects

    def timed_select(*arguments: Any) -> Any:
        nonlocal planning
        start = time.perf_counter()
        selected = original_select(*arguments)
        planning += time.perf_counter() - start
        return selected

    for block in range(study.n_blocks):
        start = time.perf_counter()
        if not isinstance(study, FlightStudy):  # of a grid a plan is kept
            study.effect_planner.select_for_block(block)
            planning += time.perf_counter() - start
        with mock.patch.object(FlightStudy, "select_effects", timed_select):
            results = study.evaluate(block)
        total += time.perf_counter() - start
        for name, values in results.items():
            if name.rsplit("/", 1)[-1] in PROBABILITY_OUTPUTS:
                values_by_name.setdefault(name, []).append(values.ravel())
        progress.update(progress_task, advance=study.count_block_points(block))
    progress.remove_task(progress_task)
    return VariantResult(
        total, planning, {name: np.concatenate(parts) for name, parts in values_by_name.items()}
    )


def largest_change(first: VariantResult, second: VariantResult) -> float:
    """Return the largest difference of any probability at any point.

    Both results must be nan at the same points.
    """
    worst = 0.0
    for name, values in first.probabilities.items():
        change = np.abs(values - second.probabilities[name])
        assert np.array_equal(np.isnan(values), np.isnan(second.probabilities[name])), name
        worst = max(worst, float(np.nanmax(change, initial=0.0)))
    return worst


def experiment_row(path: Path, progress: Progress) -> str:
    """Return an experiment's row of the table."""
    cells = []
    with tempfile.TemporaryDirectory() as temporary:
        folder, name = Path(temporary), path.stem
        all_on = evaluate_variant(variant_spec(path, None), folder, progress, f"{name}, all on")
        points = sum(values.size for values in all_on.probabilities.values()) // 4
        for tolerance in TOLERANCES:
            on_demand = evaluate_variant(
                variant_spec(path, tolerance), folder, progress, f"{name}, {tolerance:g}"
            )
            change = largest_change(all_on, on_demand)
            cells.append(f"{all_on.seconds / on_demand.seconds:.1f}x, {change:.1e}")
            if change > tolerance:
                print(f"{name}: {change:.2e} exceeds {tolerance:g}", file=sys.stderr)
    share = f"{100 * on_demand.planning / on_demand.seconds:.1f} %" if on_demand.planning else "-"
    return markdown_row(
        [name.replace("_", " "), f"{points:,}", f"{all_on.seconds:.1f} s", *cells, share]
    )


def main() -> None:
    """Write the table, or print the rows of the experiments named as arguments."""
    names = sys.argv[1:]
    head = [
        "experiment",
        "points",
        "all on",
        *(f"at {tolerance:g}" for tolerance in TOLERANCES),
        "planning",
    ]
    lines = [markdown_row(head), markdown_row(["---"] * len(head))]
    with Progress() as progress:
        for path in sorted(EXPERIMENTS.glob("*.yaml")):
            if names and path.stem not in names:
                continue
            if reason := reason_left_out(path):
                print(f"{path.stem}: {reason}", file=sys.stderr)
                continue
            lines.append(experiment_row(path, progress))
            print(lines[-1], flush=True)
    if not names:
        (DOCS / "effects_table.md").write_text(
            PAGE_HEAD + "\n".join(lines) + "\n", encoding="utf-8"
        )


def reason_left_out(path: Path) -> str:
    """Return why an experiment is left out: no file, or no probabilities; '' if it is not."""
    try:
        spec = load(path)
    except SpecError as error:
        return f"needs {str(error).splitlines()[0]}"
    counts_detections = isinstance(spec, GridSpec) and spec.draws.method == "spectra"
    return "counts detections in whole spectra" if counts_detections else ""


if __name__ == "__main__":
    main()
