"""Writes docs/variables.md from the tables of outputs that the model declares: `make fields`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from sweep.model import outputs
from sweep.model.outputs import OutputVariable

PAGE = Path(__file__).with_name("variables.md")

HEAD = """\
# Variables of every store

Written by `make fields` from the tables that name the variables (`sweep/model/outputs.py`). Floats
are nan where there is no value, signed integers -1, flags 0. "Axes" are the axes of the study.

`pd_up` stands for the up-chirp, `pd_down` for the down-chirp, `pd_doppler` for the Doppler segment
and `pd_shot` for the whole shot. Other names follow the same pattern.

Attributes follow the CF conventions: units, names in words, standard names where the CF table has
them, `flag_masks` or `flag_values` with `flag_meanings`. With `pint-xarray` and `cf-xarray`,

```sh
sweep run experiments/quickstart.yaml
```

```python
import cf_xarray.units  # before pint_xarray
import pint_xarray
import sweep

ds = sweep.open("results/quickstart.zarr")
ds.pint.quantify()  # units on every variable
ds.effects.cf.flags  # one boolean per effect
```
"""

SECTIONS: list[tuple[str, str, str, list[Mapping[str, OutputVariable]]]] = [
    (
        "Grids",
        "`sweep.open` opens a grid.",
        "axes",
        [outputs.GRID_OUTPUTS, outputs.EFFECT_VARIABLES],
    ),
    (
        "Grids that report the strongest peak alone",
        "Further variables of a study with `instrument.processing.peaks: strongest`.",
        "axes",
        [outputs.STRONGEST_PEAK_OUTPUTS],
    ),
    (
        "Grids with draws",
        "Further variables of a study with `draws`, whose pd is a mean or a share over draws.",
        "axes",
        [
            outputs.ACCURACY_OUTPUTS,
            outputs.STANDARD_ERROR_OUTPUTS,
            outputs.DRAW_COUNT_OUTPUTS,
            outputs.RUNNING_SUM_OUTPUTS,
        ],
    ),
    (
        "Grids with whole spectra",
        "Variables of a study with `draws: {method: spectra}`, which replace those of a grid.",
        "axes",
        [outputs.SPECTRA_STUDY_OUTPUTS],
    ),
    (
        "Flights: shots",
        "One group for each scanner; `sweep.open_scene` opens them. The geometry is the truth.",
        "",
        [outputs.SHOT_GEOMETRY_VARIABLES, outputs.CYCLE_VARIABLES],
    ),
    (
        "Flights: probabilities",
        "Probabilities of each shot, before any draw.",
        "axes",
        [outputs.SHOT_STATISTIC_VARIABLES, outputs.EFFECT_VARIABLES],
    ),
    ("Flights: points", "The point cloud.", "axes", [outputs.POINT_CLOUD_VARIABLES]),
    (
        "Flights: navigation",
        "Velocity and altitude from each measurement cycle of three shots or more.",
        "axes",
        [outputs.NAVIGATION_VARIABLES],
    ),
    (
        "Eyepoints",
        "The rays of each scanner, in a store of their own next to the flight's.",
        "",
        [outputs.BEAMLET_GEOMETRY_VARIABLES, {"weight": outputs.BEAMLET_WEIGHT_VARIABLE}],
    ),
]


def text() -> str:
    """Return the whole page."""
    return HEAD + "".join(_section(*section) for section in SECTIONS)


def _section(title: str, about: str, axes: str, tables: list[Mapping[str, OutputVariable]]) -> str:
    """Return a table of variables; those of grids have the study's axes and no shots."""
    rows = []
    for name, output in ((n, o) for table in tables for n, o in table.items()):
        own = [dim for dim in output.dims if title.startswith("Fl") or axes == "" or dim != "shot"]
        dims = ", ".join(filter(None, [axes, *(f"`{dim}`" for dim in own)]))
        words = f"{output.long_name}; {output.comment}" if output.comment else output.long_name
        units = "" if output.units == "1" else output.units
        rows.append(f"| `{name}` | {units} | {dims} | {output.dtype} | {_escaped(words)} |")
    head = ["| variable | units | dimensions | type | meaning |", "| --- | --- | --- | --- | --- |"]
    return f"\n## {title}\n\n{about}\n\n" + "\n".join([*head, *rows]) + "\n"


def _escaped(words: str) -> str:
    """Words that can stand in a table."""
    return words.replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
