"""Every kind of figure, on sheets and on pages: axes, limits, words and series as they were.

`SWEEP_GOLDEN=write pytest tests/analysis/test_every_figure.py` writes them anew.
"""

import json
import os
import re
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest
from matplotlib.figure import Figure
from stored_scenes import run_flight_into_store
from stored_studies import POWER_AND_CUT_AXES, SURFACE_AXES, TARGET, run_into_store, spec_over_axes

import sweep
from sweep.analysis import canvas, shot_spectra
from sweep.analysis.answers import comparison
from sweep.analysis.canvas import draw_chart
from sweep.analysis.study_figures import draw_figures
from sweep.report import study_report
from sweep.report.html_page import InteractivePlot

GOLDEN = Path(__file__).with_name("every_figure.json")
WRITES = os.environ.get("SWEEP_GOLDEN") == "write"

GRID = [
    {"kind": "surface", "variable": "pd_shot", "x": "range", "y": "grazing_angle"},
    {"kind": "surface", "variable": "p_leakage_up", "x": "range", "y": "grazing_angle",
     "name": "decades"},
    {"kind": "slices", "variable": "snr_up", "x": "range", "by": "grazing_angle",
     "where": {"grazing_angle": ["10 deg", "90 deg"]}},
    {"kind": "slices", "variable": "pd_shot", "x": "range", "by": "grazing_angle",
     "name": "apart"},
]  # fmt: skip
SCENE = [
    {"kind": "cloud", "path": True, "dropouts": True},
    {"kind": "cloud", "colour": "surface", "view": "above", "scanner": "pair", "name": "plan"},
    {"kind": "cloud", "colour": "flags", "view": "side", "scanner": "pair", "path": True,
     "where": {"power": "1 W"}},
    {"kind": "cloud", "x": ["-30 m", "30 m"], "time": ["3 s", "7.5 s"], "dropouts": True,
     "view": {"azimuth": "-30 deg", "elevation": "20 deg"}, "ranges": "interpolated",
     "name": "close"},
    {"kind": "cloud", "z": ["5 km", "6 km"], "name": "nothing"},
    {"kind": "scatter", "scanner": "pair", "y": "radial_velocity", "where": {"power": "1 W"}},
    {"kind": "scatter", "x": "altitude", "y": "pfa_up", "colour": "snr_up", "title": "By shots"},
    {"kind": "shot_spectra", "scanner": "pair", "where": {"power": "1 W"}},
    {"kind": "shot_spectra", "shot": 5000, "name": "beyond"},
    {"kind": "navigation", "where": {"power": "1 W"}, "bins": 4},
    {"kind": "navigation", "quantity": "altitude", "bins": 4},
    {"kind": "navigation_table", "quantity": "altitude", "show": "rmse", "bins": 3},
]  # fmt: skip
SPECKLED = {"target": TARGET | {"roughness": "10 um"}, "draws": {"number": 40}}

SHEETS = (
    "pd_shot_surface", "decades", "snr_up_slices", "apart", "drawn", "range_cloud", "plan",
    "pair_flags_cloud", "close", "nothing", "pair_radial_velocity_over_time_scatter",
    "pfa_up_over_altitude_scatter", "pair_several_surfaces_shot_spectra", "beyond",
    "velocity_all_navigation", "altitude_all_navigation", "shot", "comparison",
)  # fmt: skip
PLOTS = {
    "grid": ("probability of detection, shot", "signal-to-noise ratio, up-chirp",
             "Maximum range at a pd of 0.9", "Receiver operating characteristic", "False alarms",
             "Noise by source"),
    "scene": ("Points, flight path and terrain", "Shots over time", "Navigation",
              "Noise by source"),
}  # fmt: skip
KINDS = (*SHEETS, *(f"{page}: {heading}" for page, every in PLOTS.items() for heading in every))


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Sheets and plotly's figures by kind."""
    directory, sheets = tmp_path_factory.mktemp("every"), {}
    stores = {"grid": run_into_store(directory, SURFACE_AXES, figures=GRID)}
    stores["scene"] = run_flight_into_store(directory, figures=SCENE)
    for name, axes, sections in (
        ("powers", POWER_AND_CUT_AXES, {}),
        ("drawn", SURFACE_AXES, SPECKLED),
    ):
        (directory / name).mkdir()
        axes = {"target.range": ["1 km", "4 km", "9 km"]} if name == "drawn" else axes
        stores[name] = run_into_store(directory / name, axes, **sections)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            canvas, "save_sheet", lambda sheet, file, source="": sheets.setdefault(file.stem, sheet)
        )
        for name in ("grid", "scene"):
            draw_figures(stores[name])
        patch.setattr(
            canvas, "save_sheet", lambda sheet, file, source="": sheets.setdefault("drawn", sheet)
        )
        draw_figures(stores["drawn"])
        patch.setattr(
            canvas, "save_sheet", lambda sheet, file, source="": sheets.setdefault("shot", sheet)
        )
        shot_spectra.write_shot_report(spec_over_axes({}), {}, directory, draws_noise=True, seed=3)
    with canvas.uniform_style():
        opened = sweep.open(stores["powers"])
        dimmed = opened.assign(pd_up=opened.pd_up * 0.999, pd_shot=opened.pd_shot * 0.99)
        chart = comparison.pd_difference_chart(
            comparison.compute_tabulated_differences(opened, dimmed)
        )
        sheets["comparison"] = draw_chart(chart, "T", "")
    for name, page in (("grid", study_report._grid_report), ("scene", study_report._scene_report)):
        items = (i for s in page(stores[name]).sections for i in s.items)
        plots = [item for item in items if isinstance(item, InteractivePlot)]
        sheets |= {f"{name}: {plot.heading}": plot.figure for plot in reversed(plots)}
    return sheets


def short(values):
    """Number of values, the lowest and highest to three digits."""
    values = np.asarray(values)
    if values.dtype.kind not in "fiu":
        return [f"{v:.3g}" if isinstance(v, float) else str(v) for v in values.ravel()[:3]]
    known = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    ends = [f"{known.min():.3g}", f"{known.max():.3g}"] if known.size else []
    return [int(values.size), *ends]


def of_axes(axes):
    """Words, limits and series of axes of a sheet."""
    description = {
        "title": axes.get_title() or axes.get_title(loc="left"),
        "x": [axes.get_xlabel(), axes.get_xscale(), *(f"{v:.3g}" for v in axes.get_xlim())],
        "y": [axes.get_ylabel(), axes.get_yscale(), *(f"{v:.3g}" for v in axes.get_ylim())],
        "lines": [[line.get_label().split("child")[0], short(line.get_xdata()),
                   short(line.get_ydata())] for line in axes.lines],
        "collections": [
            [type(c).__name__, short(c.get_array() if c.get_array() is not None
                                     else np.ma.filled(c.get_offsets(), np.nan))]
            for c in axes.collections
        ],
        "images": [list(image.get_array().shape) for image in axes.images],
        "texts": [text.get_text() for text in axes.texts],
    }  # fmt: skip
    return {name: value for name, value in description.items() if value}


def of_trace(trace):
    """Kind, choices and values of a trace of a page."""
    coordinates = {name: getattr(trace, name, None) for name in ("x", "y", "z")}
    values = {name: short(column) for name, column in coordinates.items() if column is not None}
    slider_values = ", ".join((trace.meta or {}).get("when", {}).values())
    return [trace.type, trace.name, slider_values, values]


def structure(picture):
    """All that a picture shows."""
    if isinstance(picture, go.Figure):
        axes = {name: [picture.layout[name].title.text, picture.layout[name].type,
                       picture.layout[name].range]
                for name in ("xaxis", "yaxis")}  # fmt: skip
        return {"axes": axes, "traces": [of_trace(trace) for trace in picture.data]}
    return {
        "title": picture.get_suptitle(),
        "foot": picture.get_supxlabel(),
        "side": picture.get_supylabel(),
        "texts": [t.get_text() for t in picture.texts],
        "legends": [[t.get_text() for t in legend.get_texts()] for legend in picture.legends],
        "axes": [of_axes(axes) for axes in picture.axes if axes.get_visible()],
    }


def written(picture):
    """The structure as JSON, without the numbers of study and model."""
    text = json.dumps(structure(picture), ensure_ascii=False)
    gap = r"(?: |\\n)"
    return re.sub(f",{gap}[0-9a-f]{{8}},{gap}model{gap}[0-9]+", "", text)


def blanked(picture):
    """The picture without what it shows."""
    if isinstance(picture, go.Figure):
        return go.Figure([], picture.layout)
    for text in picture.texts:
        text.set_text("")
    for axes in picture.axes:
        for artist in [*axes.lines, *axes.collections, *axes.images]:
            artist.remove()
    return picture


@pytest.fixture(scope="module")
def golden(pictures):
    if WRITES:
        lines = [f'"{kind}": {written(pictures[kind])}' for kind in KINDS]
        GOLDEN.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    return json.loads(GOLDEN.read_text())


@pytest.mark.parametrize("kind", KINDS)
def test_a_figure_shows_what_it_showed_and_a_blank_one_does_not(kind, pictures, golden):
    picture = pictures[kind]
    assert isinstance(picture, Figure | go.Figure)
    assert json.loads(written(picture)) == golden[kind]
    assert json.loads(written(blanked(picture))) != golden[kind]
