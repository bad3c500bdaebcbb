"""Cost of accuracy in time: docs/accuracy.md and its figures, from `sweep accuracy` itself.

Run with `make accuracy`, some quarter of an hour. Names of studies below as arguments measure
those alone and print their sections; --time-limit SECONDS is that of each (180).
"""

import argparse
import tempfile
from pathlib import Path
from typing import NamedTuple

from shared import DOCS, EXPERIMENTS, table

from sweep.analysis import accuracy, accuracy_figure, canvas
from sweep.spec import load
from sweep.tasks.accuracy.measure import measure
from sweep.tasks.accuracy.rungs import WRITTEN, Rung


class Study(NamedTuple):
    """A study to measure: an experiment, what is put onto it, and why it is looked at."""

    experiment: str
    heading: str
    about: str
    overrides: dict = {}  # noqa: RUF012


STUDIES = {
    "published": Study(
        "range_angle",
        "The published study",
        "The thesis's range-angle study, 900,000 points, with the coherent footprint of 109 "
        "beamlets that it has. Their number is part of that scene, so what can be chosen is "
        "which effects are simulated, and where.",
    ),
    "rough_ground": Study(
        "range_angle",
        "The same over rough ground",
        "The same grid as a user would ask for it today: the footprint's powers add, which is the "
        "mean over rough ground, and `auto` takes as many beamlets as the tolerance needs, point "
        "by point. Against it stand fixed numbers of them, in the thesis's lattice or in a line "
        "along the slope.",
        {"title": "Detection over range and grazing angle, rough ground",
         "footprint.phases": "incoherent", "footprint.beamlets": "auto"},
    ),
    "landing": Study(
        "scan_pattern_comparison",
        "A landing",
        "Three, four and sixteen beams in a descent from 2 km, with all of the light and with "
        "little of it. A point is a shot with its rays: casting them, planning, spectra and "
        "probabilities.",
    ),
    "speckle": Study(
        "speckled_target",
        "A speckled target",
        "A rough plane whose speckle is drawn. Draws are what accuracy costs here: the mean of "
        "each draw's probabilities, detections counted against them, or noise in every bin.",
    ),
}  # fmt: skip

HEAD = """# What accuracy costs

How accurate is a probability of detection, and what does each digit cost? `sweep accuracy`
answers that for any spec, on a sample of its own points, in a minute:

```sh
sweep accuracy experiments/range_angle.yaml
```

This page is what it says of four studies; `make accuracy` measures and writes it anew. No number
on it is written by hand.

## How it is measured

A ladder of settings is put onto the spec. Each is computed by the machinery that computes the
study, in one process, on one core: the spec as it is written; effects on demand (`auto`) at
tolerances from 0.1 to 1e-6; all effects on; the same effects at every point, those that a tolerance
calls for anywhere, with lines and leakage to three tolerances; fixed numbers of beamlets, where
they add as powers; numbers of draws, where the study draws; and the way that the thesis describes.
All take turns on parts of the sample, each round in an order of its own, so that whatever slows the
machine slows them alike; a study that takes next to nothing has up to 27 rounds. What a point costs
depends on those that are computed beside it, as they share what is worked out for them: so times
are taken on stretches of the blocks that the study computes, some thousands of points each, around
points of the sample. They are those that the processor spends on the work. The best round counts
for them, and ratios are medians of those within each round, or of the best where there are but two.
Planning is counted with what it plans. Storing is not counted, as all settings share it, but told
beside: the processor's time for making the store and writing its blocks.

The **error** of a setting is what a tolerance promises to bound: the largest, over the points, of
the differences from the reference in a probability of detection, of the segments and the shot, in
log10 of a probability of false alarm, and in the magnitude of a peak's bin over itself or sigma.
What a probability of leakage is off by stands beside it: it jumps where a bin comes to the
threshold and counts as detected, so that no error of the spectrum bounds it. A setting that leaves
leakage out where there is some does less than is asked for, and is none of the fixed ones that are
compared. The reference has all effects on, lines and leakage to 1e-9 and the finest footprint of
all. The figures show as well what 90 % and half of the points stay below in pd. Where draws make
errors random, the error is that of pd at 95 % of the points. The reference itself is held against
the time domain, sample by sample, at some of the same points.

**The thesis's way** ([T] 3.3.1) puts each beamlet's line into the nearest cell of a grid with 16
cells a bin, convolves it with the window's transform by a complex FFT of 2^11 or 2^12, and samples
that at the bins. Three things would improve it, and stand beside it: half the transform where
powers add, which are real (`real`; [T] adds amplitudes, which are not), a way back to the bins
alone, by an FFT of a sixteenth of the size (`folded`, which is `real` too), and lines shared out
among ten cells, by which they are where they belong (`degree 9`). All are compiled and transform
many spectra at once (`sweep/tasks/accuracy/bench.py`), have no leakage and no range walk to
compute, and share preparation and detection with the rest. The same beamlets with the same effects
in closed form stand beside them too.

Two things are asked of the adaptive settings, and the answers below are computed: at equal error
they shall never be slower by more than 10 % than the best single fixed setting; and at least 5
times as fast as the thesis's way at the error that this has.

Planning counts for adaptive settings alone. A block takes some 1 ms to be planned, which is next to
nothing of what a thousand points take, and most of the time of a study of one or two points. Where
adaptive settings are slower by more than 10 %, `sweep accuracy` says what is lost, and what it
comes to with the making of the study's store. A run plans fixed settings too, as its store tells
what they leave out, and its blocks draw points and solve for velocities besides.
"""

TAIL = """
## On your own study

```sh
sweep accuracy my_study.yaml --points 500 --time-limit 300
```

prints the tables, draws the figure and leaves a store that opens with xarray:

```python
import xarray as xr

ds = xr.open_zarr("results/my_study_accuracy.zarr")
ds.pd_error.max("point")  # by setting
ds.seconds.min("round")  # a point
```

Take the cheapest setting that meets the error you can live with: for most studies that is
`accuracy: {tolerance: ...}` and nothing else.
"""


def section(name: str, study: Study, time_limit: float) -> str:
    """A study's part of the page; its figure is drawn."""
    spec = Rung(name="", kind=WRITTEN, overrides=study.overrides).of(
        load(EXPERIMENTS / f"{study.experiment}.yaml")
    )
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / f"{name}.zarr"
        measure(spec, store_path=store, time_limit=time_limit)
        dataset, settings = accuracy_figure.opened(store)
    picture = canvas.save(accuracy_figure.sheet(dataset, settings), DOCS / f"accuracy_{name}.png")
    put = ", ".join(f"`{k}: {v}`" for k, v in study.overrides.items() if k != "title")
    source = f"`experiments/{study.experiment}.yaml`" + (f" with {put}" if put else "")
    parts = [
        f"## {study.heading}",
        f"{study.about} ({source})",
        f"![Error over time of each setting]({picture.name})",
        "\n".join(f"- {sentence}" for sentence in accuracy.sentences(dataset, settings)),
        table(accuracy.CHEAPEST, accuracy.cheapest_rows(settings)),
        "All settings; `front`: none is both as fast and as accurate.",
        table(accuracy.COLUMNS, accuracy.rows(settings)),
    ]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """The whole page, or some of its sections."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*STUDIES, []])
    parser.add_argument("--time-limit", type=float, default=180.0)
    asked = parser.parse_args()
    sections = [
        section(name, study, asked.time_limit)
        for name, study in STUDIES.items()
        if not asked.names or name in asked.names
    ]
    if asked.names:
        print("\n".join(sections))
    else:
        page = "\n".join([HEAD, *sections]) + TAIL
        (DOCS / "accuracy.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
