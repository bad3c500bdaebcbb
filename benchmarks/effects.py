"""All effects on against those that are called for: what it changes, what it saves.

Run with `make effects`, some minutes: every experiment in the repository, whole but for draws of a
flight's noise, with each effect forced on, and with effects on demand at three tolerances.
All in one process, one variant of an experiment after the other; quote the ratios. Writes
docs/effects_table.md.
"""

import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
from rich.progress import Progress
from shared import DOCS, EXPERIMENTS, line

from sweep.model.effects.catalogue import EFFECTS
from sweep.spec import SceneSpec, Spec, SpecError, load
from sweep.spec.reading import read_document
from sweep.tasks import driver
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.studies import study_of

TOLERANCES = (1e-1, 1e-2, 1e-3)
DRAWS = 1000
PROBABILITIES = ("pd_up", "pd_doppler", "pd_down", "pd_shot")
HEAD = """# Effects on demand, and all of them on

Written by `make effects`. For each experiment the table has the time with every effect forced on,
each computed with the scene's own parameters. The next columns have effects on demand at three
tolerances: how many times faster that is, planning included, and the largest change of any
probability of detection anywhere, which has to stay below the tolerance. `planning` is its share of
the time at the tightest tolerance. It takes some milliseconds a block at least, which shows where
all blocks together take less than a second. Studies with draws take 1000 a point here.

"""


class Variant(NamedTuple):
    """Result of a variant of an experiment."""

    seconds: float
    planning: float
    probabilities: dict[str, np.ndarray]


def variant(path: Path, tolerance: float | None) -> Spec | SceneSpec:
    """An experiment with all effects on, for None, or on demand at a tolerance."""
    written = read_document(path).value
    kind = SceneSpec if "scene" in written else Spec
    drawn = kind is Spec and "draws" in written
    if drawn:  # a tolerance also says how often; here all variants share their draws
        written["draws"] = {"number": DRAWS}
    elif kind is SceneSpec:  # noise of further flights, which changes no probability
        written.pop("draws", None)
    every = {e.name: "on" for e in EFFECTS if drawn or not e.is_random}
    written["effects"] = every if tolerance is None else {}
    written["accuracy"] = dict(written.get("accuracy", {}), tolerance=tolerance or 0.0)
    return kind.from_mapping(written, base=path.parent)


def evaluated(spec: Spec | SceneSpec, folder: Path, told: Progress, title: str) -> Variant:
    """Probabilities of detection at every point, and the time that they took."""
    store, flight = folder / "study.zarr", isinstance(spec, SceneSpec)
    if flight and not (folder / "eyepoints").exists():
        driver.run(spec, store=store, progress=False)  # casts the rays
    study = study_of(spec, store)
    study.compile()
    found: dict[str, list[np.ndarray]] = {}
    bar = told.add_task(title, total=study.points)
    total = planning = 0.0
    of_flights = FlightStudy.select

    def select(*given: Any) -> Any:
        nonlocal planning
        begun = time.perf_counter()
        selected = of_flights(*given)
        planning += time.perf_counter() - begun
        return selected

    for block in range(study.n_blocks):
        begun = time.perf_counter()
        if not isinstance(study, FlightStudy):  # of a grid a plan is kept
            study.selection.of_block(block)
            planning += time.perf_counter() - begun
        with mock.patch.object(FlightStudy, "select", select):
            results = study.evaluate(block)
        total += time.perf_counter() - begun
        for name, values in results.items():
            if name.rsplit("/", 1)[-1] in PROBABILITIES:
                found.setdefault(name, []).append(values.ravel())
        told.update(bar, advance=study.block_size(block))
    told.remove_task(bar)
    return Variant(total, planning, {name: np.concatenate(parts) for name, parts in found.items()})


def largest_change(one: Variant, other: Variant) -> float:
    """Largest difference of any probability at any point; where one is nan, so is the other."""
    worst = 0.0
    for name, values in one.probabilities.items():
        apart = np.abs(values - other.probabilities[name])
        assert np.array_equal(np.isnan(values), np.isnan(other.probabilities[name])), name
        worst = max(worst, float(np.nanmax(apart, initial=0.0)))
    return worst


def row(path: Path, told: Progress) -> str:
    """An experiment's row of the table."""
    cells = []
    with tempfile.TemporaryDirectory() as temporary:
        folder, name = Path(temporary), path.stem
        every = evaluated(variant(path, None), folder, told, f"{name}, all on")
        points = sum(v.size for v in every.probabilities.values()) // 4
        for tolerance in TOLERANCES:
            called = evaluated(variant(path, tolerance), folder, told, f"{name}, {tolerance:g}")
            change = largest_change(every, called)
            cells.append(f"{every.seconds / called.seconds:.1f}x, {change:.1e}")
            if change > tolerance:
                print(f"{name}: {change:.2e} exceeds {tolerance:g}", file=sys.stderr)
    share = f"{100 * called.planning / called.seconds:.1f} %" if called.planning else "-"
    return line([name.replace("_", " "), f"{points:,}", f"{every.seconds:.1f} s", *cells, share])


def main() -> None:
    """The whole table."""
    names = sys.argv[1:]
    head = ["experiment", "points", "all on", *(f"at {t:g}" for t in TOLERANCES), "planning"]
    lines = [line(head), line(["---"] * len(head))]
    with Progress() as told:
        for path in sorted(EXPERIMENTS.glob("*.yaml")):
            if names and path.stem not in names:
                continue
            if why := left_out(path):
                print(f"{path.stem}: {why}", file=sys.stderr)
                continue
            lines.append(row(path, told))
            print(lines[-1], flush=True)
    if not names:
        (DOCS / "effects_table.md").write_text(HEAD + "\n".join(lines) + "\n", encoding="utf-8")


def left_out(path: Path) -> str:
    """Why an experiment is not looked at: a file is not here, or it has no probabilities."""
    try:
        spec = load(path)
    except SpecError as error:
        return f"needs {str(error).splitlines()[0]}"
    counts = isinstance(spec, Spec) and spec.draws.method == "spectra"
    return "counts detections in whole spectra" if counts else ""


if __name__ == "__main__":
    main()
