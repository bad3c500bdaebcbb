"""Charts of a flight: its point clouds to turn, shots over time, navigation and noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import pandas
import plotly.graph_objects as go
import xarray as xr

from sweep.analysis import canvas, labels
from sweep.analysis.charts import CHANCE, Axis, Chart, Line, Panel, not_shown
from sweep.analysis.figures import SceneStudy
from sweep.analysis.opening import NotAStoreError
from sweep.analysis.scenes.navigation import curves, navigation_chart
from sweep.analysis.scenes.pictures import Ground
from sweep.analysis.scenes.recording import (
    AXES,
    INTERPOLATED,
    KINDS,
    Cloud,
    Place,
    Recording,
    gathered,
    kinds,
    label,
    place_at,
    read_eyepoints,
    shown,
)
from sweep.analysis.selection import parameters_at
from sweep.model.effects.catalogue import names_of
from sweep.model.eyepoints import prepare_eyepoints
from sweep.model.navigation import EXCLUDED
from sweep.model.pairing import TRUE
from sweep.report.detector import PLACES, budget_chart, budget_panel
from sweep.report.page import COLOUR_BAR, Control, Plot, Table, layout, sentences, title, when
from sweep.spec import SceneSpec

COLOURS = ("range", "radial_velocity", "snr")
"""Quantities that points can be coloured by."""

MOST_POINTS = 36_000
"""Points of all clouds of a page together."""

MOST_CLOUDS = 8
"""Scanners times places along the study's axes."""

NODES = 90
"""Nodes of the terrain along a side."""

SUNK = 0.012
"""Depth at which terrain is drawn below itself, of the picture's size: points lie on it."""

FIELD_OF_VIEW = math.radians(45)
"""Angle from the lower to the upper edge of what the library shows of a scene."""

ROOM, WIDER = 0.88, 1.2
"""Share of the field of view that the picture takes, so that its labels have room; width of the
narrowest sheets, a phone's, over their height."""

VIEWS = {
    "at an angle": {"x": 1.1, "y": -1.3, "z": 0.6},
    "from above": {"x": 0.0, "y": -0.01, "z": 1.8},
    "from the south": {"x": 0.0, "y": -1.8, "z": 0.1},
    "from the east": {"x": 1.8, "y": 0.0, "z": 0.1},
}
"""Places of the eye, in the lengths that the library counts in."""

CENTRE = {"x": 0.0, "y": 0.0, "z": -0.1}
"""Point that the eye looks at."""


@dataclass(frozen=True)
class Seen:
    """Recording of a scanner at one place along the study's axes."""

    words: str
    recording: Recording
    at: Place


def recordings(study: SceneStudy) -> tuple[list[Seen], int]:
    """Scanners at places along the axes, as many as a page shows, and how many are left out."""
    places = product(*(range(axis.size) for axis in study.spec.axes))
    every = list(product(study.scanners, places))
    chosen = np.unique(np.linspace(0, len(every) - 1, min(MOST_CLOUDS, len(every))).round())
    made = []
    for scanner, index in (every[int(i)] for i in chosen):
        at = place_at(study.spec, index)
        named = labels.coordinate(scanner) if len(study.scanners) > 1 else ""
        words = ", ".join(filter(None, [named, at.words]))
        made.append(Seen(words, at.recording(study.tree, scanner), at))
    return made, len(every) - len(made)


def solid(study: SceneStudy, found: Sequence[Seen], fewer: int) -> Plot | None:
    """All clouds, one at a time; none where there is no point at all."""
    most = MOST_POINTS // len(found)
    every = {
        seen.words: gathered(
            seen.recording, [*COLOURS, "pd"], ranges=INTERPOLATED, path=True, most=most
        )
        for seen in found
    }
    clouds = {words: cloud for words, cloud in every.items() if cloud is not None}
    if not clouds:
        return None
    ground = Ground.of(study.tree)
    traces = [trace for words, cloud in clouds.items() for trace in _traces(words, cloud, ground)]
    first = next(iter(clouds.values()))
    draws = found[0].recording.dataset.sizes["draw"]
    counted = [f"{words}: {', '.join(cloud.remarks)}" if words else ", ".join(cloud.remarks)
               for words, cloud in clouds.items()]  # fmt: skip
    return Plot(
        heading="Points, flight path and terrain",
        alt=(
            f"Point cloud in three dimensions of {first.rows.total:,} points, heights in metres: "
            f"{labels.extent(first.points['z'])}; ranges: {labels.extent(first.points['range'])}; "
            f"with the flight path{' over the terrain' if ground else ''}."
        ),
        caption=sentences(
            [*counted,
             f"Draw 0 of {draws}" if draws > 1 else "",
             "Ranges interpolated between bins; terrain shaded, and drawn a little below itself "
             "so that points show",
             not_shown(fewer)]
        ),
        figure=go.Figure(traces, _layout()),
        controls=[
            Control("cloud", "Shown for", list(clouds)),
            Control("colour", "Colour", [_option(name) for name in COLOURS],
                    {_option(name): {"title": title(label(name))} for name in COLOURS}),
            Control("view", "View", list(VIEWS),
                    {name: {"scene.camera": _camera(name)} | _hidden(name) for name in VIEWS}),
            Control("frame", "Frame", ["whole flight", "ground"],
                    {"whole flight": _frame(list(clouds.values()), path=True),
                     "ground": _frame(list(clouds.values()))}),
            Control("ground", "Terrain", ["shown", "hidden"] if ground else ["none"]),
        ],
        tall=True,
    )  # fmt: skip


def _option(name: str) -> str:
    return {"snr": "signal-to-noise ratio"}.get(name, labels.coordinate(name))


def _columns(table: dict[str, np.ndarray], chosen: np.ndarray | slice) -> dict[str, np.ndarray]:
    return {axis: table[axis][chosen].astype(np.float32) for axis in AXES}


def _traces(words: str, cloud: Cloud, ground: Ground | None) -> Iterator[go.Scatter3d | go.Surface]:
    """Terrain, path, and points in each colour."""
    if ground is not None:
        yield from _terrain(words, cloud, ground)
    yield go.Scatter3d(
        **_columns(cloud.path, slice(None)), mode="lines", line={"width": 5}, name="flight path",
        meta=when(0, cloud=words), hoverinfo="name",
    )  # fmt: skip
    true = cloud.true
    for name in COLOURS:
        values = shown(name, cloud.points[name])
        known = values[true] if true.any() else values
        known = known[np.isfinite(known)]
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
        for kind, chosen in (("true points", true), ("false points", ~true)):
            if chosen.any():
                colour = values[chosen].astype(np.float32)
                of_true = kind == "true points"
                yield go.Scatter3d(
                    **_columns(cloud.points, chosen), mode="markers", name=kind, customdata=colour,
                    meta=when(cloud=words, colour=_option(name)) | {"scaled": True},
                    hovertemplate=f"{label(name)}: %{{customdata:.5g}}<extra>{kind}</extra>",
                    marker={
                        "size": 3 if of_true else 5,
                        "symbol": "circle" if of_true else "diamond",
                        "color": colour, "cmin": low, "cmax": high,
                        "showscale": of_true or not true.any(), "colorbar": COLOUR_BAR,
                    },
                )  # fmt: skip


def _terrain(words: str, cloud: Cloud, ground: Ground) -> Iterator[go.Surface]:
    """Draw the ground around the points seen, shaded, just below itself."""
    around = {}
    for axis in ("x", "y"):
        values = np.concatenate([cloud.points[axis], cloud.path[axis]])
        room = 0.1 * (np.ptp(values) + 1.0)
        around[axis] = float(values.min() - room), float(values.max() + room)
    part = ground.cropped(around["x"], around["y"], NODES)
    if part is None:
        return
    size = max(high - low for low, high in around.values())
    yield go.Surface(
        x=part.x.astype(np.float32), y=part.y.astype(np.float32),
        z=(part.height - SUNK * size).astype(np.float32),
        surfacecolor=part.shade().astype(np.float32), cmin=0, cmax=1, showscale=False,
        lighting={"ambient": 1, "diffuse": 0, "specular": 0, "fresnel": 0}, hoverinfo="skip",
        name="terrain", meta=when(cloud=words, ground="shown") | {"ground": True},
    )  # fmt: skip


def _camera(view: str) -> dict[str, dict[str, float]]:
    return {"eye": VIEWS[view], "up": {"x": 0.0, "y": 0.0, "z": 1.0}, "center": CENTRE}


def _hidden(view: str) -> dict[str, bool]:
    """Hide the axis that a view looks along, whose labels would overlap."""
    low, _, high = sorted(AXES, key=lambda axis: abs(VIEWS[view][axis]))
    return {f"scene.{high}axis.visible": False} if VIEWS[view][low] == 0 else {}


def _longest(sides: np.ndarray) -> float:
    """Longest side at which all of a box is seen from every view, in the library's lengths."""
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * sides
    eyes = [np.array([view[axis] for axis in AXES]) for view in VIEWS.values()]
    sizes = np.linspace(2.0, 0.1, 191).tolist()
    fitting = (size for size in sizes if all(_seen(size * corners, eye) for eye in eyes))
    return next(fitting, sizes[0])


def _seen(corners: np.ndarray, eye: np.ndarray) -> bool:
    """Tell whether an eye has (n, 3) corners within its field of view."""
    ahead = np.array([CENTRE[axis] for axis in AXES]) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    away = corners - eye
    depth = away @ ahead
    off = np.maximum(np.abs(away @ right) / WIDER, np.abs(away @ np.cross(right, ahead)))
    return bool((off <= ROOM * math.tan(FIELD_OF_VIEW / 2) * depth).all())


def _frame(clouds: Sequence[Cloud], *, path: bool = False) -> dict[str, Any]:
    """Limits around the true points of all clouds, and their paths, to one scale."""
    sides: dict[str, Any] = {}
    lengths = {}
    for axis in AXES:
        parts = [c.points[axis][c.true if c.true.any() else slice(None)] for c in clouds]
        values = np.concatenate([*parts, *(cloud.path[axis] for cloud in clouds if path)])
        room = 0.06 * np.ptp(values) + 2.0
        sides[f"scene.{axis}axis.range"] = [values.min() - room, values.max() + room]
        lengths[axis] = np.ptp(values) + 2 * room
    shares = np.array([lengths[axis] for axis in AXES]) / max(lengths.values())
    shown = _longest(shares) * shares
    return sides | {"scene.aspectratio": dict(zip(AXES, shown.tolist(), strict=True))}


def _layout() -> dict[str, Any]:
    plain = {"showbackground": False, "showspikes": False, "nticks": 5}
    return layout(
        scene={
            "aspectmode": "manual",
            **{f"{axis}axis": {"title": {"text": f"{axis} (m)"}} | plain for axis in AXES},
        },
        legend={"orientation": "h", "x": 0, "y": 0, "yanchor": "top", "itemsizing": "constant"},
        margin={"l": 0, "r": 0, "t": 88, "b": 40},
    )


SHOTS = ("pd_shot", "snr_up", "beam_range", "beam_radial_velocity", "pfa_up")
"""Quantities of shots that are shown over time."""

MEASURED = ("range", "radial_velocity")
"""Quantities of a point that have a truth."""

MOST_SHOTS = 12_000
"""Shots of all charts over time of a page together."""

BINS = 20
"""Bins of altitude that errors are told in."""


def along(found: Sequence[Seen]) -> Chart | None:
    """Quantities of shots over time; none where none is computed."""
    quantities = [name for name in SHOTS if name in found[0].recording.dataset]

    def drawn(table: dict[str, np.ndarray]) -> Iterator[Drawn]:
        for name in quantities:
            up = Axis(label(name), limits=CHANCE if name == "pd_shot" else None)
            yield label(name), up, _by_beam(table, name)

    panels, reduced = _over_time(found, "shot", [*quantities, "beam"], drawn)
    told = [
        f"{panel.y.words}: {labels.extent(np.concatenate([line.y for line in panel.lines]))}"
        for panel in panels[: len(quantities)]
    ]
    alt = f"Marks of a quantity of each shot over time. {'; '.join(told)}."
    return _times("Shots over time", alt, [reduced], panels)


def errors(found: Sequence[Seen]) -> Chart | None:
    """Errors of range and velocity of true points against truth; none where there are none."""

    def drawn(table: dict[str, np.ndarray]) -> Iterator[Drawn]:
        true = (table["flags"].astype(int) & TRUE) > 0
        for name in MEASURED if true.any() else ():
            error = {"error": table[name] - table[f"true_{name}"]}
            own = {key: values[true] for key, values in (table | error).items()}
            words = label(name).replace(" (", " error (")
            spread = labels.number(float(f"{np.sqrt(np.mean(own['error'] ** 2)):.3g}"))
            yield f"{words}, rms {spread}", Axis(words), _by_beam(own, "error")

    names = ["time", "beam", "flags", *MEASURED, *(f"true_{name}" for name in MEASURED)]
    panels, reduced = _over_time(found, "point", names, drawn)
    told = "; ".join(panel.when["quantity"] for panel in panels[: len(MEASURED)])
    alt = f"Marks of the error of each true point over time. {told}."
    how = "Measured less true, of true points, interpolated between bins"
    return _times("Errors against truth", alt, [how, reduced], panels)


Drawn = tuple[str, Axis, list[Line]]
"""Words for a quantity, its axis, and its lines over time."""


def _over_time(
    found: Sequence[Seen], thing: str, names: Sequence[str],
    drawn: Callable[[dict[str, np.ndarray]], Iterator[Drawn]],
) -> tuple[list[Panel], str]:  # fmt: skip
    """Panels of what is drawn of shots or points, and a remark where some are left out."""
    panels: list[Panel] = []
    every = 1
    for seen in found:
        rows = seen.recording.rows(names, MOST_SHOTS // len(found), ranges=INTERPOLATED)
        every = max(every, rows.every)
        table = rows.rows()
        for words, up, lines in drawn(table) if table and table["time"].size else ():
            choice = {"cloud": seen.words, "quantity": words}
            panels.append(Panel(choice, Axis("time (s)"), up, lines))
    return panels, f"One {thing} in {every} shown: reduced for this page" * (every > 1)


def _times(heading: str, alt: str, caption: list[str], panels: list[Panel]) -> Chart | None:
    """Return a chart of quantities over time; none without panels."""
    facets = {"cloud": "Shown for", "quantity": "Quantity"}
    return Chart(heading, alt, caption, panels, facets) if panels else None


def _by_beam(table: dict[str, np.ndarray], name: str) -> list[Line]:
    """Return marks of each beam; of all together where there are more than colours."""
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
    """Shots and points by kind of each scanner, over all draws."""
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
    return Table("Shots and points", caption, pandas.DataFrame(rows), "returns")


def came_back(
    returned: pandas.DataFrame, groups: Sequence[xr.Dataset], fewer: int = 0
) -> list[str]:
    """Points and solved velocities in sentences; `returned` as :func:`returns` has it.

    `fewer` is the number of parts of the study that the page leaves out, and `returned` with it.
    """
    shots, true = (int(returned[name].sum()) for name in ("shots", "true"))
    false = int(returned.iloc[:, 2:].sum(axis=None)) - true
    number = len(returned)
    parts = f"In the {number} of {number + fewer} parts of the study shown here, " if fewer else ""
    told = [
        f"{parts}{shots:,} shots brought back {true:,} true points and {false:,} false ones; "
        "a shot counts once a draw."
    ]
    status = [group["velocity_status"] for group in groups if "velocity_status" in group]
    if known := sum(int((own >= 0).sum()) for own in status):
        solved = sum(int(((own >= 0) & (own <= EXCLUDED)).sum()) for own in status)
        told.append(f"Velocity was solved in {solved:,} of {known:,} cycles.")
    return told


def navigation(spec: SceneSpec, found: Sequence[Seen]) -> Chart | None:
    """Errors of velocity and altitude over altitude; none where no scanner navigates."""
    named = [(seen.words, seen.recording) for seen in found]
    every = [
        curve
        for quantity in ("velocity", "altitude")
        for curve in curves(named, quantity=quantity, bins=BINS)
    ]
    if not every:
        return None
    chart = navigation_chart(every, "all")
    return replace(chart, caption=[*chart.caption, *_floor(spec)])


def _floor(spec: SceneSpec) -> list[str]:
    """Errors that no echo lowers, and errors that are not stated."""
    own = spec.to_yaml_mapping()["error_floor"]
    named = [
        f"{labels.coordinate(name)} {own[name]}" for name, value in spec.error_floor if value > 0
    ]
    stated = [f"errors that no echo lowers: {', '.join(named)}"] if named else []
    return stated + spec.unstated_errors()


def noise_budget(study: SceneStudy, found: Sequence[Seen]) -> Chart | None:
    """Share of each source in the noise along the flight; none where eyepoints are gone."""
    try:
        panels = [panel for seen in found if (panel := _budget(study, seen)).lines]
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
    """Return sources of noise of some of the shots that see something."""
    recording = seen.recording
    number = recording.shots
    shots = np.unique(np.linspace(0, number - 1, min(PLACES, number)).round().astype(int))
    eyepoints = read_eyepoints(study.path, recording.dataset, shots)
    place = np.flatnonzero(eyepoints.seen)
    flags = np.asarray(recording.dataset["effects"].isel(shot=shots[place]).values)
    parameters, surfaces = parameters_at(study.spec, seen.at.index), study.spec.surfaces()
    budgets = [
        prepare_eyepoints(
            eyepoints.some(np.array([i])), parameters, surfaces, names_of(int(flag))
        ).noise_sources
        for i, flag in zip(place, flags, strict=True)
    ]
    when = {"part": seen.words}
    return budget_panel(when, Axis("time (s)"), eyepoints.time[place], budgets)
