"""Charts along a flight: shots over time, navigation, noise on the way; and what came back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas

from sweep.analysis import canvas, labels
from sweep.analysis.charts import CHANCE, Axis, Chart, Line, Panel
from sweep.analysis.opening import NotAStoreError
from sweep.analysis.scenes.figures import SceneStudy
from sweep.analysis.scenes.navigation import curves, navigation_chart
from sweep.analysis.scenes.recording import (
    KINDS,
    eyepoints_of,
    kinds,
    label,
    read_eyepoints,
    shown,
)
from sweep.model.effects.catalogue import names_of
from sweep.model.eyepoints import prepare_eyepoints
from sweep.report.clouds import Seen
from sweep.report.detector import PLACES, budget_chart, budget_panel
from sweep.report.page import Table

SHOTS = ("pd_shot", "snr_up", "beam_range", "beam_radial_velocity", "pfa_up")
"""Quantities of shots that are shown over time."""

MOST_SHOTS = 12_000
"""Shots of all charts over time of a page together."""

BINS = 20
"""Bins of altitude that errors are told in."""


def along(found: Sequence[Seen]) -> Chart | None:
    """Quantities of shots over time; none where none is computed."""
    panels = []
    every = 1
    quantities = [name for name in SHOTS if name in found[0].recording.dataset]
    for seen in found:
        rows = seen.recording.rows([*quantities, "beam"], MOST_SHOTS // len(found))
        every = max(every, rows.every)
        table = rows.rows()
        for name in quantities if table else ():
            up = Axis(label(name), limits=CHANCE if name == "pd_shot" else None)
            when = {"cloud": seen.words, "quantity": label(name)}
            panels.append(Panel(when, Axis("time (s)"), up, _by_beam(table, name)))
    if not panels:
        return None
    told = [
        f"{panel.y.words}: {labels.extent(np.concatenate([line.y for line in panel.layers]))}"
        for panel in panels[: len(quantities)]
    ]
    return Chart(
        "Shots over time",
        f"Marks of a quantity of each shot over time. {'; '.join(told)}.",
        [f"One shot in {every} shown: reduced for this page" if every > 1 else ""],
        panels,
        {"cloud": "Shown for", "quantity": "Quantity"},
    )


def _by_beam(table: dict[str, np.ndarray], name: str) -> list[Line]:
    """Marks of each beam; of all together where there are more than colours."""
    values = shown(name, table[name])
    beams = np.unique(table["beam"])
    if beams.size > len(canvas.LINES):
        return [Line(table["time"], values, "all beams", look="dots")]
    return [
        Line(table["time"][own], values[own], f"beam {int(beam)}", number, look="dots")
        for number, beam in enumerate(beams)
        for own in [table["beam"] == beam]
    ]


def returns(found: Sequence[Seen]) -> Table:
    """What came back to each scanner: shots, and points by kind, over all draws."""
    rows = []
    for seen in found:
        counts, shots = np.zeros(len(KINDS), int), 0
        for part in seen.recording.stretches():
            flags = np.asarray(seen.recording.dataset["flags"].isel(shot=part).values)
            shots += flags.shape[0] * flags.shape[1]
            counts += np.bincount(kinds(flags).ravel() + 1, minlength=len(KINDS) + 1)[1:]
        named = dict(zip(map(labels.coordinate, KINDS), counts.tolist(), strict=True))
        rows.append({"what": seen.words or "all", "shots": shots} | named)
    caption = ["Shots times draws, and points by kind."]
    return Table("What came back", caption, pandas.DataFrame(rows), "returns")


def navigation(found: Sequence[Seen]) -> Chart | None:
    """Errors of velocity and altitude over altitude; none where no scanner navigates."""
    named = [(seen.words, seen.recording) for seen in found]
    every = [
        curve
        for quantity in ("velocity", "altitude")
        for curve in curves(named, quantity=quantity, bins=BINS)
    ]
    return navigation_chart(every, "all") if every else None


def noise_budget(study: SceneStudy, found: Sequence[Seen]) -> Chart | None:
    """Share of each source in the noise along the flight; none where eyepoints are gone."""
    try:
        panels = [panel for seen in found if (panel := _budget(study, seen)).layers]
    except NotAStoreError:
        return None
    if not panels:
        return None
    return budget_chart(
        panels,
        ["Shares of the variance at the ADC in shots spread over the flight, simulated for "
         "this page with the effects that the study simulates; the standard deviation is shown "
         "on hovering"],
    )  # fmt: skip


def _budget(study: SceneStudy, seen: Seen) -> Panel:
    """Sources of noise of some of the shots that see something."""
    recording = seen.recording
    number = recording.shots
    shots = np.unique(np.linspace(0, number - 1, min(PLACES, number)).round().astype(int))
    eyepoints = read_eyepoints(eyepoints_of(study.path, recording.dataset), shots)
    place = np.flatnonzero(eyepoints.seen)
    flags = np.asarray(recording.dataset["effects"].isel(shot=shots[place]).values)
    parameters, surfaces = seen.at.parameters(study.spec), study.spec.surfaces()
    budgets = [
        prepare_eyepoints(
            eyepoints.some(np.array([i])), parameters, surfaces, names_of(int(flag))
        ).noise_sources
        for i, flag in zip(place, flags, strict=True)
    ]
    when = {"part": seen.words}
    return budget_panel(when, Axis("time (s)"), eyepoints.time[place], budgets)
