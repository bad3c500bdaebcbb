"""Whether tolerances are kept: 1,000 points of every experiment, at six tolerances.

Run with `make promise`, some five minutes on one core; names of experiments as arguments look at
those alone. Writes docs/promise.md.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import Progress

from sweep.spec import SceneSpec, Spec, SpecError, load
from sweep.tasks.accuracy.bench import Bench, Seen, Trial
from sweep.tasks.accuracy.flight_bench import FlightBench
from sweep.tasks.accuracy.grid_bench import GridBench
from sweep.tasks.accuracy.measure import FIXED_AS_AT, apart
from sweep.tasks.accuracy.rungs import ADAPTIVE, ALL_ON, FIXED, REFERENCE, WRITTEN, Rung, ladder

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "promise.md"
POINTS, SEED, ROUNDS = 1000, 2017, 2
KEPT = 0.999
"""Share of the points that shall keep a tolerance; where draws decide, their confidence."""
DRAWN = {0.1: 96, 0.01: 48, 0.001: 4}
"""Points that are drawn until a tolerance is met."""
LONG_RUN = {0.1: 10_000, 0.01: 100_000, 0.001: 1_000_000}
"""Draws of the reference there."""
TOLERANCE, DRAWS, LIMIT = "accuracy.tolerance", "draws.number", "draws.limit"
WHAT = ("pd", "log10 pfa", "magnitude")
VARIANTS = {
    "range_angle_over_rough_ground": (
        "range_angle", {"footprint.phases": "incoherent", "footprint.beamlets": "auto"},
    ),
}  # fmt: skip
"""Experiments with some values put onto them."""
HEAD = """# Is the tolerance kept?

Written by `make promise`. Of each experiment 1,000 points, drawn by chance (of flights, some tiles
of shots), are computed as the study computes them at each `accuracy.tolerance`, and once more with
all effects on and, where their number follows from the tolerance, as many beamlets as at 1e-9. How
far off is pd (the largest of segments and shot), how far log10 of the probability of a false alarm,
and how far |X| of the largest bins, relative to itself or to sigma if that is larger? A cell has
the error of the worst point; before it, where not all points are within the tolerance, the share
of those that are. 99.9 % is what is asked for; of points that are drawn, the `accuracy.confidence`
of their intervals.

One bin more or fewer that a detection occupies, of the 65,536 that could raise a false alarm, is
6.6e-6 of log10 pfa: it is left out of account where effects are.

`us` is processor time a point, planning included. `fixed` is that of the cheapest setting with the
same effects at every point that keeps the tolerance: the front of the ladder of `sweep accuracy`.

"""
BEAMLETS = """
## Beamlets of flights

A flight has as many beamlets as it says, or 109, whatever the tolerance: each is a ray. Against all
effects on with 1009 of them, all effects on with its own number are off at the most by
"""


class Row(NamedTuple):
    """What an experiment came to at a tolerance."""

    tolerance: float
    errors: tuple[np.ndarray, ...]
    """(points,) each, by :data:`WHAT`; of drawn points pd alone."""
    seconds: float
    fixed: float = np.nan
    """Time of the cheapest fixed setting that is as accurate [s]; nan where there is none."""


def tried(bench: Bench, rungs: Sequence[Rung], rounds: int) -> list[Trial]:
    """Rungs on all points of a sample: what they see, and the best of their times."""
    parts = bench.parts(bench.size)
    for rung in rungs:  # compiles what there is to compile
        bench.try_on(rung, parts[0] if len(parts) > 1 else parts[0][:1], 1)
    found: list[list[Trial]] = [[] for _ in rungs]
    for part in parts:
        for trials, rung in zip(found, rungs, strict=True):
            times = 1 if rung.kind == REFERENCE else rounds
            several = [bench.try_on(rung, part, 1) for _ in range(times)]
            trials.append(min(several, key=lambda trial: trial.seconds))
        bench.forget()
    share = np.array([len(part) for part in parts]) / bench.size
    return [together(trials, share) for trials in found]


def together(trials: Sequence[Trial], share: np.ndarray) -> Trial:
    """Trials of the parts of a sample as one."""
    seen = Seen(*map(np.concatenate, zip(*(t.seen for t in trials), strict=True)))
    seconds = sum(t.seconds * s for t, s in zip(trials, share, strict=True))
    planning = sum(t.planning * s for t, s in zip(trials, share, strict=True))
    return Trial(seen, float(seconds), float(planning))


def known(spec: Spec | SceneSpec) -> tuple[list[Row], tuple[np.ndarray, ...] | None]:
    """Tolerances of a study without draws; of a flight, what its number of beamlets changes."""
    flight = isinstance(spec, SceneSpec)
    bench = FlightBench(spec, POINTS) if flight else GridBench(spec, POINTS, SEED)
    whole = ladder(spec)
    at = {float(r.overrides[TOLERANCE]): r for r in whole.rungs if r.kind == ADAPTIVE}
    whole = whole.with_fixed({t: bench.effects(at[t]) for t in FIXED_AS_AT})
    bench.forget()
    fixed = [rung for rung in whole.rungs if rung.kind in (FIXED, ALL_ON)]
    rungs = [*at.values(), *fixed, whole.reference]
    trials = tried(bench, rungs, ROUNDS)
    seen = {rung.name: trial for rung, trial in zip(rungs, trials, strict=True)}
    every = next(rung for rung in fixed if rung.kind == ALL_ON)
    finest = seen[whole.reference.name].seen
    true = seen[every.name].seen if flight else finest
    worst = {r.name: np.nanmax(np.concatenate(apart(seen[r.name].seen, true))) for r in fixed}
    rows = []
    for tolerance, rung in at.items():
        as_good = [seen[name].seconds for name, error in worst.items() if error <= tolerance]
        errors = apart(seen[rung.name].seen, true)
        rows.append(Row(tolerance, errors, seen[rung.name].seconds, min(as_good, default=np.nan)))
    return rows, apart(true, finest) if flight else None


def drawn(spec: Spec) -> list[Row]:
    """Tolerances of a study that draws, against a long run with other draws."""
    rows = []
    every = ladder(spec).reference.overrides
    for tolerance, points in DRAWN.items():
        until = {DRAWS: 0, LIMIT: 10**7, TOLERANCE: tolerance}
        other = {DRAWS: LONG_RUN[tolerance], LIMIT: 0, "seed": int(spec.seed) ^ 1}
        rungs = [
            Rung(name="until", kind=ADAPTIVE, overrides=until),
            Rung(name="reference", kind=REFERENCE, overrides=dict(every) | other, plans=False),
        ]
        trial, reference = tried(GridBench(spec, points, SEED), rungs, 1)
        rows.append(Row(tolerance, apart(trial.seen, reference.seen)[:1], trial.seconds))
    return rows


def cell(errors: np.ndarray, tolerance: float) -> str:
    """The worst error; before it, where not all are within the tolerance, how many are."""
    told = errors[np.isfinite(errors)]
    if not told.size:
        return "-"
    worst, share = float(told.max()), float((told <= tolerance).mean())
    text = "<1e-9" if worst < 1e-9 else f"{worst:.1e}"
    return text if share == 1 else f"**{100 * share:.2f} %**, {text}"


def lines_of(name: str, rows: Sequence[Row]) -> Iterator[str]:
    """Rows of the table."""
    for row in rows:
        cells = [cell(errors, row.tolerance) for errors in row.errors]
        cells += ["-"] * (len(WHAT) - len(cells))
        fixed = f"{1e6 * row.fixed:.3g}" if np.isfinite(row.fixed) else "-"
        shown = [name, f"{len(row.errors[0]):,}", f"{row.tolerance:g}", *cells]
        yield "| " + " | ".join([*shown, f"{1e6 * row.seconds:.3g}", fixed]) + " |"


def missed(name: str, rows: Sequence[Row], share: float) -> Iterator[str]:
    """What does not keep its tolerance, in words."""
    for row in rows:
        for what, errors in zip(WHAT, row.errors, strict=False):
            told = errors[np.isfinite(errors)]
            kept = float((told <= row.tolerance).mean()) if told.size else 1.0
            if kept < share:
                share_missed = f"{100 * (1 - kept):.2f} %"
                yield f"- {name} at {row.tolerance:g}: {what} of {share_missed} of the points"


def page(names: Sequence[str], bar: Progress) -> str:
    """The whole text."""
    table, beamlets, short = [], [], []
    for stem in bar.track(names, description="points of each experiment"):
        experiment, overrides = VARIANTS.get(stem, (stem, {}))
        name = stem.replace("_", " ")
        try:
            spec = load(ROOT / "experiments" / f"{experiment}.yaml")
        except SpecError as error:
            short.append(f"- {name}: not looked at: {str(error).splitlines()[0]}")
            continue
        spec = Rung(name="", kind=WRITTEN, overrides=overrides).of(spec)
        if spec.draws.method == "spectra":
            short.append(f"- {name}: not looked at: draws noise alone, and counts")
            continue
        draws = not isinstance(spec, SceneSpec) and (spec.draws.number or spec.draws.limit)
        rows, other = (drawn(spec), None) if draws else known(spec)
        table += lines_of(name, rows)
        print("\n".join(lines_of(name, rows)), flush=True)
        short += missed(name, rows, spec.accuracy.confidence if draws else KEPT)
        if other is not None:
            worst = [cell(errors, np.inf) for errors in other]
            beamlets.append(f"| {name} | " + " | ".join(worst) + " |")
    heads = ["experiment", "points", "tolerance", *WHAT, "us", "fixed"]
    parts = [
        HEAD.strip(),
        "\n".join(short) if short else "Every tolerance is kept.",
        "\n".join([header(heads), *table]),
        BEAMLETS.strip(),
        "\n".join([header(["experiment", *WHAT]), *beamlets]),
    ]
    return "\n\n".join(parts) + "\n"


def header(heads: Sequence[str]) -> str:
    """Two lines of Markdown."""
    return "| " + " | ".join(heads) + " |\n|" + " --- |" * len(heads)


def main() -> None:
    """The whole page, or some experiments' rows."""
    every = sorted([*VARIANTS, *(path.stem for path in (ROOT / "experiments").glob("*.yaml"))])
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*every, []])
    asked = parser.parse_args()
    with Progress(console=Console(stderr=True)) as bar:
        text = page(asked.names or every, bar)
    if asked.names:
        print(text.removeprefix(HEAD))
    else:
        PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
