"""Test of every tolerance: 1,000 points of every experiment, at six tolerances.

And of as many instruments drawn at random. Run with `make promise`, some twenty minutes; names of
experiments, or `instruments`, as arguments look at those alone.
Writes docs/promise.md.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import promise_drawn
import promise_instruments
from rich.console import Console
from rich.progress import Progress
from shared import DOCS, EXPERIMENTS, table, wrapped

from sweep.model.accuracy import Accuracy
from sweep.spec import SceneSpec, Spec, SpecError, load
from sweep.tasks.accuracy.bench import Bench, FlightBench, GridBench, Trial, together
from sweep.tasks.accuracy.measure import PROMISED, apart, completed, tolerance_of
from sweep.tasks.accuracy.rungs import (
    ADAPTIVE,
    ALL_ON,
    FINEST_RAYS,
    FINEST_RAYS_TOLERANCE,
    FIXED,
    REFERENCE,
    TOLERANCES,
    WRITTEN,
    Ladder,
    Rung,
    ladder,
)
from sweep.tasks.study import Grid

POINTS, SEED, ROUNDS = 1000, 2017, 5
STRETCH = 4096
"""Points that are timed together: what one costs depends on those beside it in its block."""
KEPT = 0.999
"""Share of the points that shall keep a tolerance."""
LONG = 0.5
"""Seconds that a trial may take to be repeated: longer ones are timed well enough as it is."""
BEAMLETS = "footprint.beamlets"
MORE_RAYS = 31_987
"""What the reference of flights is held against."""
MANY = 4_009
"""Rays that coherent flights are held against."""
DEARER = 1.1
"""What timings may be off."""
ALIKE, NOTHING = 1.1, 1e-9
"""Errors that count as the same, relative to each other, and as none."""
WHAT = ("pd", "log10 pfa", "magnitude", "leakage")
INSTRUMENTS = "instruments"
VARIANTS = {
    "range_angle_over_rough_ground": (
        "range_angle", {"footprint.phases": "incoherent", "footprint.beamlets": "auto"},
    ),
}  # fmt: skip
"""Experiments with some values put onto them."""
HEAD = """# Is the tolerance kept?

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
RAYS = f"""
## Flights against many more rays

Each beamlet of a flight is a ray. If powers add, `footprint.beamlets: auto` casts few rays for
every shot, and more for shots that need them. The rows show the number of rays of a shot, and
the error against a reference. The reference has all effects on and {FINEST_RAYS:,} rays of every
shot, or more until the estimated error is below {FINEST_RAYS_TOLERANCE:g}, {Accuracy.rays[-1]:,} at
the most. A number given by an experiment has a row too, with all effects on. The last row of each
flight compares the reference with {MORE_RAYS:,} rays and more, at a part of the flight. A cell has
the share of shots within the tolerance, the largest error of the best 90 % of the shots, and the
worst error. `us` is processor time a shot, rays included.

If phases are coherent, the number of beamlets is part of the scene, as in the thesis. No number is
enough: a smooth slope sends almost nothing back, and the small sum that remains depends on the
number. These flights have one row, their own number against {MANY:,}.
"""
COSTS = """
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


class Row(NamedTuple):
    """Result of an experiment at a tolerance."""

    tolerance: float
    errors: tuple[np.ndarray, ...]
    """(points,) each, by :data:`WHAT`."""
    seconds: float
    fixed: float = np.nan
    """Time of the cheapest fixed setting that keeps the tolerance [s]; nan where there is none."""
    front: float = np.nan
    """The same of the cheapest whose worst error is no larger."""
    label: str = ""
    """What stands in the place of a tolerance."""


def tried(bench: Bench, rungs: Sequence[Rung], rounds: int) -> list[Trial]:
    """Rungs on all points of a sample: what they see, and the best of their times."""
    parts = bench.parts(bench.size)
    for rung in rungs:  # compiles what there is to compile
        bench.try_on(rung, parts[0] if len(parts) > 1 else parts[0][:1], 1)
    bench.forget()
    found: list[list[Trial]] = []
    for part in parts:
        best: dict[int, Trial] = {}
        for turn in range(rounds):  # in turn, so that whatever slows the machine slows all
            for k, rung in enumerate(rungs):
                if turn > 0 and (rung.kind == REFERENCE or best[k].seconds * len(part) > LONG):
                    continue
                stretch = 1 if rung.kind == REFERENCE else min(STRETCH, bench.most_times)
                trial = bench.try_on(rung, part, stretch)
                best[k] = min(best.get(k, trial), trial, key=lambda trial: trial.seconds)
        found.append([best[k] for k in sorted(best)])
        bench.forget()
    return [together(trials) for trials in zip(*found, strict=True)]


class Found(NamedTuple):
    """Results of an experiment."""

    rows: list[Row]
    rays: list[Row]
    """Of a flight: its own number against many more; last, these against yet more."""


def known(spec: Spec | SceneSpec) -> Found:
    """Tolerances of a study without draws."""
    flight = isinstance(spec, SceneSpec)
    bench = FlightBench(spec, POINTS) if flight else GridBench(spec, POINTS, drawn_points(spec))
    whole = ladder(spec)
    at = {tolerance_of(rung): rung for rung in whole.rungs if rung.kind == ADAPTIVE}
    whole = completed(whole, bench, TOLERANCES)
    fixed = [rung for rung in whole.rungs if rung.kind in (FIXED, ALL_ON)]
    rungs = [*at.values(), *fixed, whole.reference]
    trials = tried(bench, rungs, ROUNDS)
    seen = {rung.name: trial for rung, trial in zip(rungs, trials, strict=True)}
    every = next(rung for rung in fixed if rung.kind == ALL_ON)
    finest = seen[whole.reference.name].seen
    worst = {rung.name: worst_of(apart(seen[rung.name].seen, finest)) for rung in fixed}
    rows, rays = [], []
    for tolerance, rung in at.items():
        trial = seen[rung.name]
        errors = apart(trial.seen, finest)
        least = worst_of(errors)
        kept, front = (
            min((seen[name].seconds for name, error in worst.items() if error <= most),
                default=np.nan)
            for most in (tolerance, max(ALIKE * least, NOTHING))
        )  # fmt: skip
        rows.append(Row(tolerance, errors, trial.seconds, kept, front))
        label = f"{tolerance:g}: {of_rays(trial.seen.beamlets)}" if flight else ""
        rays.append(rows[-1]._replace(label=label))
    if not flight:
        return Found(rows, [])
    if BEAMLETS not in whole.reference.overrides:
        return Found(rows, [with_more_rays(bench, whole, seen[every.name], "own, coherent", MANY)])
    if spec.footprint.beamlets:
        own, label = seen[every.name], f"{spec.footprint.beamlets:,} by hand"
        rays.append(Row(np.inf, apart(own.seen, finest), own.seconds, label=label))
    trial, label = seen[whole.reference.name], f"{FINEST_RAYS:,} rays and more"
    last = with_more_rays(bench, whole, trial, label, MORE_RAYS)
    return Found(rows, [*rays, last])


def drawn_points(spec: Spec) -> np.ndarray:
    """Numbers of points, each as likely, without repetition."""
    points = Grid(spec).points
    chosen = np.random.default_rng(SEED).choice(points, min(POINTS, points), replace=False)
    return np.sort(chosen)


def worst_of(errors: Sequence[np.ndarray]) -> float:
    """The largest error of all that is promised."""
    return float(np.nanmax(np.concatenate(errors[:PROMISED])))


def of_rays(number: np.ndarray) -> str:
    """Numbers of rays of shots, where they have any: the mean, and the most."""
    if not np.isfinite(number).any():
        return "nothing seen"
    return f"{np.nanmean(number):,.0f} rays, at most {np.nanmax(number):,.0f}"


def with_more_rays(bench: Bench, whole: Ladder, own: Trial, label: str, more: int) -> Row:
    """The reference's number of rays against more of them, at a part of the sample."""
    reference, part = whole.reference, bench.parts(bench.size)[0]
    finer = replace(
        reference, name=f"{more} rays", overrides={**reference.overrides, BEAMLETS: more}
    )
    seen, other = (bench.try_on(rung, part, 1) for rung in (reference, finer))
    bench.forget()
    return Row(np.inf, apart(seen.seen, other.seen), own.seconds, label=label)


def cell(errors: np.ndarray, tolerance: float) -> str:
    """The worst error; before it, where not all are within the tolerance, how many are."""
    told = errors[np.isfinite(errors)]
    if not told.size:
        return "-"
    worst, share = float(told.max()), float((told <= tolerance).mean())
    return small(worst) if share == 1 else f"**{100 * share:.2f} %**, {small(worst)}"


def small(error: float) -> str:
    """An error as cells have it."""
    return "<1e-9" if error < 1e-9 else f"{error:.1e}"


def spread_cell(errors: np.ndarray, tolerance: float) -> str:
    """Share of the points within the tolerance, the error that 90 % keep, and the worst."""
    told = errors[np.isfinite(errors)]
    if not told.size:
        return "-"
    share = f"{100 * (told <= tolerance).mean():.4g} %, " if np.isfinite(tolerance) else ""
    return f"{share}{small(np.quantile(told, 0.9))}, {small(told.max())}"


def lines_of(name: str, rows: Sequence[Row]) -> Iterator[list[str]]:
    """Rows of the table."""
    for row in rows:
        cells = [cell(errors, row.tolerance) for errors in row.errors]
        times = [
            f"{1e6 * seconds:.3g}" if np.isfinite(seconds) else "-"
            for seconds in (row.seconds, row.fixed, row.front)
        ]
        yield [name, f"{len(row.errors[0]):,}", f"{row.tolerance:g}", *cells, *times]


def rays_of(name: str, rows: Sequence[Row]) -> Iterator[list[str]]:
    """Rows of the table of rays."""
    for row in rows:
        cells = [spread_cell(errors, row.tolerance) for errors in row.errors]
        yield [name, row.label or f"{row.tolerance:g}", *cells, f"{1e6 * row.seconds:.3g}"]


def costs_of(name: str, ratios: Sequence[float]) -> list[str]:
    """A row of a table of costs: ratios by tolerance, and whether they rise."""
    there = [ratio for ratio in ratios if np.isfinite(ratio)]
    rise = max(there) / max(there[0], 1.0) if there else np.nan
    told = "kept" if rise <= DEARER else f"NOT kept: {rise:.2f} times"
    cells = [f"{ratio:.2f}" if np.isfinite(ratio) else "-" for ratio in ratios]
    return [name, *cells, told if there else "no front"]


def missed(name: str, rows: Sequence[Row]) -> Iterator[str]:
    """Quantities that do not keep their tolerance, in words."""
    for row in rows:
        for what, errors in zip(WHAT, row.errors, strict=True):
            there = errors[np.isfinite(errors)]
            kept = float((there <= row.tolerance).mean()) if there.size else 1.0
            if kept < KEPT:
                share_missed = f"{100 * (1 - kept):.2f} %"
                told = f"- {name} at {row.tolerance:g}: {what} of {share_missed} of the points"
                yield told + (", which is not promised" if what == "leakage" else "")


class Page:
    """The page, experiment by experiment."""

    def __init__(self) -> None:
        self._short: list[str] = []
        self._table: list[list[str]] = []
        self._rays: list[list[str]] = []
        self._fronts: list[list[str]] = []
        self._costs: list[list[str]] = []
        self._further: dict[str, list[str]] = {"drawn": [], "instruments": []}

    def draw(self) -> None:
        """Look at instruments drawn at random."""
        missed, text = promise_instruments.section(POINTS, np.random.default_rng())
        self._short += missed
        self._further["instruments"].append(text)

    def add(self, stem: str) -> None:
        """Look at an experiment."""
        experiment, overrides = VARIANTS.get(stem, (stem, {}))
        name, path = stem.replace("_", " "), EXPERIMENTS / f"{experiment}.yaml"
        try:
            spec = load(path)
        except SpecError as error:
            self._short.append(f"- {name}: not looked at: {str(error).splitlines()[0]}")
            return
        spec = Rung(name="", kind=WRITTEN, overrides=overrides).of(spec)
        if spec.draws.method == "spectra":
            self._short.append(f"- {name}: not looked at: draws noise alone, and counts")
        elif not isinstance(spec, SceneSpec) and spec.draws.any:
            rows, off = promise_drawn.drawn(path, spec)
            self._short += promise_drawn.verdicts(name, rows, float(spec.accuracy.confidence))
            self._further["drawn"].append(promise_drawn.section(name, rows, off, spec))
        else:
            self._know(name, known(spec))

    def _know(self, name: str, found: Found) -> None:
        self._table += lines_of(name, found.rows)
        self._rays += rays_of(name, found.rays)
        self._fronts.append(costs_of(name, [row.seconds / row.front for row in found.rows]))
        self._costs.append(costs_of(name, [row.seconds / row.fixed for row in found.rows]))
        self._short += missed(name, found.rows)

    def text(self) -> str:
        """The whole text."""
        heads = ["experiment", "points", "tolerance", *WHAT, "us", "fixed", "front"]
        by_tolerance = ["experiment", *(f"{t:g}" for t in TOLERANCES), "no faster"]
        front, fixed = (table(by_tolerance, rows) for rows in (self._fronts, self._costs))
        parts = [
            HEAD.strip(),
            "\n".join(self._short) if self._short else "Every tolerance is kept.",
            table(heads, self._table),
            *self._further["drawn"],
            *self._further["instruments"],
            RAYS.strip(),
            table(["experiment", "tolerance", *WHAT, "us"], self._rays),
            COSTS.strip().format(margin=DEARER - 1, front=front, fixed=fixed),
        ]
        return wrapped("\n\n".join(parts)) + "\n"


def main() -> None:
    """The whole page, or some experiments' rows."""
    every = sorted([*VARIANTS, *(path.stem for path in EXPERIMENTS.glob("*.yaml"))])
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*every, INSTRUMENTS, []])
    asked = parser.parse_args()
    page = Page()
    with Progress(console=Console(stderr=True)) as bar:
        names = asked.names or [*every, INSTRUMENTS]
        for stem in bar.track(names, description="points of each experiment"):
            if stem == INSTRUMENTS:
                page.draw()
            else:
                page.add(stem)
    text = page.text()
    if asked.names:
        print(text.removeprefix(HEAD))
    else:
        (DOCS / "promise.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
