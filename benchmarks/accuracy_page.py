"""Write docs/accuracy.md and its figures: the cost of accuracy in time, by `sweep accuracy`.

Run with `make accuracy`, some quarter of an hour. Names of studies below as arguments measure
those alone and print their sections; --time-limit SECONDS is that of each (180). The section of
beamlets over rough terrain is that of `make accuracy-terrain` and stays as it is.
"""

import argparse
import tempfile
from pathlib import Path
from typing import NamedTuple

import draw_group_efficiency
from benchmark_helpers import DOCS, EXPERIMENTS, markdown_table

from sweep.analysis import accuracy_results, canvas
from sweep.spec import load
from sweep.storage.accuracy_setting_kinds import AS_WRITTEN_KIND
from sweep.tasks.accuracy.measurement import measure_accuracy
from sweep.tasks.accuracy.settings import AccuracySetting


class MeasuredStudy(NamedTuple):
    """A study to measure: an experiment with overrides, and a description for the page."""

    experiment: str
    heading: str
    description: str
    overrides: dict = {}  # noqa: RUF012


STUDIES = {
    "published": MeasuredStudy(
        "range_angle",
        "The published study",
        "The thesis's range-angle study, 900,000 points, with its coherent footprint of 109 "
        "beamlets. Their number is part of that scene. The only choice is which effects are "
        "simulated, and where.",
    ),
    "rough_ground": MeasuredStudy(
        "range_angle",
        "The same over rough ground",
        "The same grid as a user would write it today. The powers of beamlets add, which is the "
        "mean over rough ground. At each point `auto` takes as many beamlets as the tolerance "
        "needs. It is compared with fixed numbers of them, in the thesis's lattice or in a line "
        "along the slope.",
        {"title": "Detection over range and grazing angle, rough ground",
         "footprint.phases": "incoherent", "footprint.beamlets": "auto"},
    ),
    "landing": MeasuredStudy(
        "scan_pattern_comparison",
        "A landing",
        "Three, four and sixteen beams in a descent from 2 km, with all of the light and with "
        "little of it. A point is a shot with its rays. Its time covers casting the rays, "
        "planning, spectra and probabilities.",
    ),
    "speckle": MeasuredStudy(
        "speckled_target",
        "A speckled target",
        "A rough plane whose speckle is drawn. Here accuracy costs draws: the mean of each draw's"
        " probabilities, detections counted against them, or noise in every bin.",
    ),
}  # fmt: skip

PAGE_HEAD = """# What accuracy costs

How accurate is a probability of detection, and how much time does each digit take? `sweep
accuracy` answers that for any spec, on a sample of its own points, in a minute:

```sh
sweep accuracy experiments/range_angle.yaml
```

This page has its results for four studies. `make accuracy` measures and writes it; no number is
written by hand.

## How it is measured

The same code that computes the study computes a ladder of settings, in one process, on one core:

- the spec as written;
- effects on demand (`auto`) at tolerances from 0.1 to 1e-6, and all effects on;
- the same effects at every point, those that a tolerance needs anywhere, with lines and leakage to
  three tolerances;
- fixed numbers of beamlets, where they add as powers, and of draws, in studies with draws;
- the thesis's way.

Settings take turns on parts of the sample, in a new order each round, so a slow machine slows all
of them alike. A very short study has up to 27 rounds. The cost of a point depends on its
neighbours, because they share intermediate results. Times are therefore measured on some thousands
of points of a block, around points of the sample. They are processor times of the best round. A
ratio is the median of the ratios within each round, or the ratio of the best of two rounds. The
time for planning is divided among the points planned. Storing is left out, because all settings
share it. The page gives the processor time for making the store and writing its blocks separately.

The **error** of a setting is the quantity that a tolerance bounds: the largest difference from the
reference over all points. It covers the probabilities of detection of the segments and the shot,
log10 of a probability of false alarm, and the magnitude of a peak's bin over itself or sigma. If
draws make errors random, the error is that of pd at 95 % of the points.

The error of the leakage probability has a column of its own. This probability jumps where a bin
reaches the threshold and counts as detected, so no error of the spectrum bounds it. A setting that
skips leakage where there is some does less than the others. It is left out of the comparison.

The reference has all effects on, lines and leakage to 1e-9, and the finest footprint. It is
compared with the time domain, sample by sample, at some of the same points. The figures also show
the error in pd at the median and at 90 % of the points.

**The thesis's way** ([T] 3.3.1) puts each beamlet's line into the nearest cell of a grid with 16
cells a bin. It convolves the grid with the window's transform by a complex FFT of 2^11 or 2^12,
and samples the result at the bins. Three improvements are measured too:

- `real`: half the transform, where powers add and the grid is real ([T] adds amplitudes, which are
  complex);
- `folded`: a way back to the bins alone, by an FFT of a sixteenth of the size, also with `real`;
- `degree 9`: lines shared out among ten cells, which puts them at their exact place.

All are compiled and transform many spectra at once (`sweep/model/spectrum/oversampled_grid.py`).
They compute neither leakage nor range walk. They share preparation and detection with the other
settings. The closed form with the same beamlets and effects is measured too.

Adaptive settings have to meet two requirements, which the numbers below test:

- at equal error (neither setting exceeds it) they are never slower by more than 10 % than the best
  single fixed setting;
- they are at least 5 times as fast as the thesis's way at its error.

Planning is counted for adaptive settings alone. It takes some 1 ms a block. This is negligible for
a thousand points, and most of the time of a study of one or two points. If adaptive settings are
slower by more than 10 %, `sweep accuracy` prints the loss, with and without the making of the
store. A real run plans fixed settings too, because its store holds the error of skipped effects.
Its blocks also draw points and solve for velocities.
"""

PAGE_TAIL = """
## On your own study

```sh
sweep accuracy experiments/quickstart.yaml --points 500 --time-limit 30
```

prints the tables, draws the figure and leaves a store that opens with xarray:

```python
import xarray as xr

ds = xr.open_zarr("results/quickstart_accuracy.zarr")
ds.pd_error.max("point")  # by setting
ds.seconds.min("round")  # a point
```

Take the cheapest setting that meets the error you can live with: for most studies that is
`accuracy: {tolerance: ...}` and nothing else.
"""


def study_section(name: str, study: MeasuredStudy, time_limit: float) -> str:
    """Return a study's section of the page, and draw the study's figure."""
    spec = AccuracySetting(name="", kind=AS_WRITTEN_KIND, overrides=study.overrides).apply_to(
        load(EXPERIMENTS / f"{study.experiment}.yaml")
    )
    with tempfile.TemporaryDirectory() as folder:
        store_path = Path(folder) / f"{name}.zarr"
        measure_accuracy(spec, store_path=store_path, time_limit=time_limit)
        dataset, settings = accuracy_results.open_accuracy_store(store_path)
    figure_path = canvas.save_sheet(
        accuracy_results.draw_accuracy_sheet(dataset, settings), DOCS / f"accuracy_{name}.png"
    )
    overrides_text = ", ".join(
        f"`{path}: {value}`" for path, value in study.overrides.items() if path != "title"
    )
    source = f"`experiments/{study.experiment}.yaml`" + (
        f" with {overrides_text}" if overrides_text else ""
    )
    parts = [
        f"## {study.heading}",
        f"{study.description} ({source})",
        f"![Error over time of each setting]({figure_path.name})",
        "\n".join(
            f"- {sentence}" for sentence in accuracy_results.conclusion_sentences(dataset, settings)
        ),
        markdown_table(
            accuracy_results.FASTEST_SETTING_COLUMNS,
            accuracy_results.fastest_setting_rows(settings),
        ),
        "All settings; `front`: none is both as fast and as accurate.",
        markdown_table(
            accuracy_results.SETTING_TABLE_COLUMNS, accuracy_results.setting_table_rows(settings)
        ),
    ]
    return "\n\n".join(parts) + "\n"


def read_page_part(path: Path, name: str) -> str:
    """Return a part of a page that another script writes, with its marks."""
    begin_mark, end_mark = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    part = path.read_text(encoding="utf-8").partition(begin_mark)[2].partition(end_mark)[0]
    return f"{begin_mark}{part}{end_mark}\n"


def main() -> None:
    """Write the page, or print the sections of the studies named as arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*STUDIES, []])
    parser.add_argument("--time-limit", type=float, default=180.0)
    arguments = parser.parse_args()
    sections = [
        study_section(name, study, arguments.time_limit)
        for name, study in STUDIES.items()
        if not arguments.names or name in arguments.names
    ]
    if arguments.names:
        print("\n".join(sections))
    else:
        path = DOCS / "accuracy.md"
        terrain_section = read_page_part(path, "rough_terrain_section")
        parts = [PAGE_HEAD, *sections, draw_group_efficiency.page_section(), terrain_section]
        path.write_text("\n".join(parts) + PAGE_TAIL, encoding="utf-8")


if __name__ == "__main__":
    main()
