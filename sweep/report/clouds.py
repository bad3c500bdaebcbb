"""Point clouds over their terrain, to turn and to colour."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import plotly.graph_objects as go

from sweep.analysis import labels
from sweep.analysis.scenes.cloud import AXES
from sweep.analysis.scenes.figures import SceneStudy
from sweep.analysis.scenes.places import Place, place
from sweep.analysis.scenes.quantities import INTERPOLATED, label, shown
from sweep.analysis.scenes.recording import Recording, Table, Thinned
from sweep.analysis.scenes.terrain import Ground
from sweep.model.pairing import TRUE
from sweep.report import looks, wording
from sweep.report.page import Chart, Control, when

COLOURS = ("range", "radial_velocity", "snr")
"""Quantities that points can be coloured by."""

MOST_POINTS, MOST_PATH = 36_000, 1500
"""Points of all clouds of a page together, and of a flight path."""

MOST_CLOUDS = 8
"""Scanners times places along the study's axes."""

NODES = 90
"""Nodes of the terrain along a side."""

SUNK = 0.012
"""How far the terrain is drawn below itself, of the picture's size: points lie on it, not in it."""

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
"""Where the eye is, in the lengths that the library counts in."""


@dataclass(frozen=True)
class Seen:
    """What one scanner recorded at one place along the study's axes."""

    words: str
    recording: Recording
    at: Place


@dataclass(frozen=True)
class _Cloud:
    """Points of a picture, thinned, with the flight path."""

    seen: Seen
    points: Table
    path: Table
    total: int
    every: int
    outside: int

    @property
    def true(self) -> np.ndarray:
        """Which points are true."""
        return np.asarray((self.points["flags"] & TRUE) > 0)

    @property
    def true_points(self) -> Table:
        """The true points; all where none is true."""
        true = self.true
        return {n: v[true] if true.any() else v for n, v in self.points.items()}


def recordings(study: SceneStudy) -> tuple[list[Seen], int]:
    """Scanners at places along the axes, as many as a page shows, and how many are left out."""
    places = product(*(range(axis.size) for axis in study.spec.axes))
    every = list(product(study.scanners, places))
    chosen = np.unique(np.linspace(0, len(every) - 1, min(MOST_CLOUDS, len(every))).round())
    made = []
    for scanner, index in (every[int(i)] for i in chosen):
        at = _place(study, index)
        named = labels.coordinate(scanner) if len(study.scanners) > 1 else ""
        words = ", ".join(filter(None, [named, at.words]))
        made.append(Seen(words, at.recording(study.tree, scanner), at))
    return made, len(every) - len(made)


def _place(study: SceneStudy, index: tuple[int, ...]) -> Place:
    """A place along the axes by its numbers."""
    where: dict[str, object] = {}
    for axis, number in zip(study.spec.axes, index, strict=True):
        member = axis.members[0]
        units = f" {member.units}" if member.units else ""
        written = f"{member.display[number]}{units}"
        where |= {axis.name: number} if axis.zipped else {member.name: written}
    return place(study.spec, where)


def chart(study: SceneStudy, found: list[Seen], fewer: int) -> Chart | None:
    """All clouds, one at a time; none where there is no point at all."""
    clouds = [
        cloud for seen in found if (cloud := _gathered(seen, MOST_POINTS // len(found))) is not None
    ]
    if not clouds:
        return None
    ground = Ground.of(study.tree)
    traces = [trace for cloud in clouds for trace in _traces(cloud, ground)]
    points = clouds[0].points
    heights = wording.spread(points["z"])
    return Chart(
        heading="Points, flight path and terrain",
        alt=(
            f"Point cloud in three dimensions of {clouds[0].total:,} points, heights in metres: "
            f"{heights}; ranges: {wording.spread(points['range'])}; with the flight path"
            f"{' over the terrain' if ground else ''}."
        ),
        caption=wording.sentences(
            [*(_counted(cloud) for cloud in clouds), _meaning(clouds), wording.left_out(fewer)]
        ),
        figure=go.Figure(traces, _layout()),
        controls=[
            Control("cloud", "Shown for", [cloud.seen.words for cloud in clouds]),
            Control("colour", "Colour", [_option(name) for name in COLOURS],
                    {_option(name): {"title": looks.title(label(name))} for name in COLOURS}),
            Control("view", "View", list(VIEWS),
                    {name: {"scene.camera": _camera(name)} | _hidden(name) for name in VIEWS}),
            Control("frame", "Frame", ["whole flight", "ground"],
                    {"whole flight": _frame(clouds, path=True), "ground": _frame(clouds)}),
            Control("ground", "Terrain", ["shown", "hidden"] if ground else ["none"]),
        ],
        tall=True,
    )  # fmt: skip


def _option(name: str) -> str:
    return {"snr": "signal-to-noise ratio"}.get(name, labels.coordinate(name))


def _gathered(seen: Seen, most: int) -> _Cloud | None:
    """Points of the first draw, and the path, read stretch by stretch."""
    found, track = Thinned(most), Thinned(MOST_PATH)
    names = [*AXES, "flags", *COLOURS, "pd"]
    for part in seen.recording.stretches():
        found.add(seen.recording.points(names, part, ranges=INTERPOLATED))
        position = seen.recording.read("platform_position", part)
        track.add(dict(zip(AXES, position[np.isfinite(position[:, 0])].T, strict=True)))
    if not found.total:
        return None
    rows, path = found.rows(), track.rows()
    true = (rows["flags"] & TRUE) > 0
    inside = np.ones(true.size, bool)
    for axis in AXES if true.any() else ():
        known = np.concatenate([rows[axis][true], path[axis]])
        room = 0.05 * (np.ptp(known) + 1.0)
        inside &= (rows[axis] >= known.min() - room) & (rows[axis] <= known.max() + room)
    kept = {name: values[inside] for name, values in rows.items()}
    return _Cloud(seen, kept, path, found.total, found.every, int((~inside).sum()) * found.every)


def _traces(cloud: _Cloud, ground: Ground | None) -> Iterator[go.Scatter3d | go.Surface]:
    """Terrain, path, and points in each colour."""
    if ground is not None:
        yield from _terrain(cloud, ground)
    yield go.Scatter3d(
        **{axis: cloud.path[axis].astype(np.float32) for axis in AXES}, mode="lines",
        line={"width": 5}, name="flight path", meta=when(0, cloud=cloud.seen.words),
        hoverinfo="name",
    )  # fmt: skip
    true = cloud.true
    for name in COLOURS:
        values = shown(name, cloud.points[name])
        low, high = _ends(values[true] if true.any() else values)
        for kind, chosen in (("true points", true), ("false points", ~true)):
            if chosen.any():
                yield go.Scatter3d(
                    **{a: cloud.points[a][chosen].astype(np.float32) for a in AXES},
                    mode="markers", name=kind, text=None,
                    meta=when(cloud=cloud.seen.words, colour=_option(name)) | {"scaled": True},
                    customdata=values[chosen].astype(np.float32),
                    hovertemplate=f"{label(name)}: %{{customdata:.5g}}<extra>{kind}</extra>",
                    marker={
                        "size": 3 if kind == "true points" else 4,
                        "symbol": "circle" if kind == "true points" else "diamond-open",
                        "color": values[chosen].astype(np.float32), "cmin": low, "cmax": high,
                        "showscale": kind == "true points" or not true.any(),
                        "colorbar": looks.COLOUR_BAR,
                    },
                )  # fmt: skip


def _ends(values: np.ndarray) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)


def _terrain(cloud: _Cloud, ground: Ground) -> Iterator[go.Surface]:
    """The ground around what is seen of it, shaded, just below itself."""
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
        name="terrain", meta=when(cloud=cloud.seen.words, ground="shown") | {"ground": True},
    )  # fmt: skip


CENTRE = {"x": 0.0, "y": 0.0, "z": -0.1}
"""Where the eye looks."""


def _camera(view: str) -> dict[str, dict[str, float]]:
    return {"eye": VIEWS[view], "up": {"x": 0.0, "y": 0.0, "z": 1.0}, "center": CENTRE}


def _hidden(view: str) -> dict[str, bool]:
    """The axis that a view looks along, whose labels would lie over each other, is not drawn."""
    low, _, high = sorted(AXES, key=lambda axis: abs(VIEWS[view][axis]))
    return {f"scene.{high}axis.visible": False} if VIEWS[view][low] == 0 else {}


def _longest(sides: np.ndarray) -> float:
    """Longest side at which all of a box is seen from every view, in the library's lengths.

    Parameters
    ----------
    sides : (3,) ndarray
        Of the box, in its longest.
    """
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * sides
    eyes = [np.array([view[axis] for axis in AXES]) for view in VIEWS.values()]
    sizes = np.linspace(2.0, 0.1, 191)
    fits = np.all([[_seen(size * corners, eye) for eye in eyes] for size in sizes], axis=1)
    return float(sizes[np.argmax(fits)])


def _seen(corners: np.ndarray, eye: np.ndarray) -> bool:
    """Whether an eye has (n, 3) corners within its field of view."""
    ahead = np.array([CENTRE[axis] for axis in AXES]) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    away = corners - eye
    depth = away @ ahead
    off = np.maximum(np.abs(away @ right) / WIDER, np.abs(away @ np.cross(right, ahead)))
    return bool((off <= ROOM * math.tan(FIELD_OF_VIEW / 2) * depth).all())


def _frame(clouds: list[_Cloud], *, path: bool = False) -> dict[str, object]:
    """Limits around the true points of all clouds, and their paths, to one scale."""
    sides: dict[str, object] = {}
    lengths = {}
    for axis in AXES:
        parts = [cloud.true_points[axis] for cloud in clouds]
        parts += [cloud.path[axis] for cloud in clouds if path]
        values = np.concatenate(parts)
        room = 0.06 * np.ptp(values) + 2.0
        sides[f"scene.{axis}axis.range"] = [values.min() - room, values.max() + room]
        lengths[axis] = np.ptp(values) + 2 * room
    shares = np.array([lengths[axis] for axis in AXES]) / max(lengths.values())
    shown = _longest(shares) * shares
    return sides | {"scene.aspectratio": dict(zip(AXES, shown.tolist(), strict=True))}


def _layout() -> dict[str, object]:
    plain = {"showbackground": False, "showspikes": False, "nticks": 5}
    return looks.layout(
        scene={
            "aspectmode": "manual",
            **{f"{axis}axis": {"title": {"text": f"{axis} (m)"}} | plain for axis in AXES},
        },
        legend={"orientation": "h", "x": 0, "y": 0, "yanchor": "top", "itemsizing": "constant"},
        margin={"l": 0, "r": 0, "t": 88, "b": 40},
    )


def _counted(cloud: _Cloud) -> str:
    """How many points there are, and how many of them the page shows."""
    said = f"{cloud.seen.words}: " if cloud.seen.words else ""
    said += labels.counted(cloud.total, "point")
    if cloud.every > 1:
        said += f", one in {cloud.every} of them shown: reduced for this page"
    if cloud.outside:
        said += f"; {labels.counted(cloud.outside, 'false point')} outside of the picture"
    return said


def _meaning(clouds: list[_Cloud]) -> str:
    draws = clouds[0].seen.recording.dataset.sizes["draw"]
    first = f"Draw 0 of {draws}, r" if draws > 1 else "R"
    return (
        f"{first}anges interpolated between bins; terrain shaded, and drawn a little below itself "
        "so that points show"
    )
