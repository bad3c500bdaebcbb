"""Figure, table and sentences of a store that `sweep accuracy` made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
from matplotlib.ticker import FuncFormatter, LogLocator
from matplotlib.transforms import Bbox

from sweep.analysis import accuracy as of
from sweep.analysis import canvas, labels
from sweep.analysis.accuracy import Setting, settings_in
from sweep.analysis.opening import ACCURACY, read_attributes
from sweep.storage.locations import Location, beside, zarr_store
from sweep.storage.opening import CHECKED

FLOOR = of.EXACT
"""Error at which those that are smaller are drawn."""

BY_NUMBER = (of.BEAMLETS, of.IN_A_LINE, of.MEANS, of.COUNTED, of.IN_NOISE)
"""Kinds whose settings are told apart by the number that their names begin with."""

JOINED = (of.ADAPTIVE, *BY_NUMBER)
"""Kinds whose settings are one method, looked at more or less closely."""

MARKS = {
    of.ADAPTIVE: ("o", canvas.LINES[0], "adaptive, by tolerance"),
    "fixed effects": ("s", canvas.LINES[2], "the same effects everywhere"),
    of.BEAMLETS: ("^", canvas.LINES[1], "number of beamlets in a lattice"),
    of.IN_A_LINE: ("<", canvas.LINES[7], "number of beamlets in a line"),
    "all on": ("D", canvas.LINES[3], "all effects on"),
    of.MEANS: ("P", canvas.LINES[5], "mean over so many draws"),
    of.COUNTED: ("^", canvas.LINES[1], "detections in so many draws"),
    of.IN_NOISE: ("<", canvas.LINES[7], "the same, noise in every bin"),
    of.CLOSED_FORM: ("X", canvas.LINES[5], "in closed form what the thesis's way has"),
    of.THESIS: ("v", canvas.LINES[4], "the thesis's way"),
    of.IMPROVED: ("p", canvas.LINES[4], "the thesis's way, improved"),
    of.WRITTEN: ("*", canvas.LINES[6], "as written"),
}
"""Marker, colour and words of each kind."""

HALO = [withStroke(linewidth=2.5, foreground="white")]
"""Halo that keeps a name readable upon lines; marks are drawn upon it."""


PLACES = ((6, 5), (-6, -10), (6, -10), (-6, 5), (6, 15), (-6, -20), (6, -20), (-6, 15))
"""Places that a name may take: right of its mark and above it, or left and below [points]."""

MARK_SIZE = 7
"""Width of most marks [points]."""


def sheet(dataset: xr.Dataset, settings: Sequence[Setting]) -> Sheet:
    """Return the figure of a store that `sweep accuracy` made."""
    drawn = of.candidates(settings)
    sheet, (axes,) = canvas.panels(10.0, 6.2, 1, 1)
    axes.step(
        *zip(*map(_place, of.front(drawn)), strict=True), where="post", color="0.35", linewidth=1.2,
        linestyle="--", zorder=1, label="front of the best",
    )  # fmt: skip
    names: list[Annotation] = []
    for kind, (marker, colour, words) in MARKS.items():
        some = of.of_kinds(drawn, kind)
        for i, setting in enumerate(some):
            _mark(axes, setting, marker, colour, words if i == 0 else "")
        if kind in JOINED and some:
            line = zip(*map(_place, some), strict=True)
            axes.plot(*line, color=colour, linewidth=0.8, alpha=0.5, zorder=1)
        names += _names(axes, some, above=kind not in BY_NUMBER)
    _finish(axes, min(setting.quantile(0.5) for setting in drawn))
    canvas.title(sheet, f"{dataset.attrs['title']}: what accuracy costs")
    canvas.caption(sheet, _note(dataset, drawn))
    sheet.draw_without_rendering()
    _keep_apart(axes, names, drawn)
    return sheet


def _mark(axes: Axes, setting: Setting, marker: str, colour: str, words: str) -> None:
    """Draw a mark at the largest error, a line down to pd's of 90 %, a dot at its median."""
    time, worst = _place(setting)
    most, half = (max(setting.quantile(share), FLOOR) for share in (0.9, 0.5))
    if most > FLOOR:
        axes.plot([time, time], [most, worst], color=colour, linewidth=1.0, alpha=0.6, zorder=2)
        axes.plot([time], [most], marker="_", color=colour, markersize=7, zorder=2)
    if half > FLOOR:
        axes.plot([time], [half], marker=".", color=colour, markersize=4, zorder=2)
    size = 11 if marker == "*" else MARK_SIZE
    axes.plot(
        [time], [worst], marker=marker, color=colour, markersize=size, linestyle="",
        markeredgecolor="white", markeredgewidth=0.7, label=words or None, zorder=4,
    )  # fmt: skip


def _place(setting: Setting) -> tuple[float, float]:
    """Time [us] and error at which a setting is drawn."""
    return 1e6 * setting.seconds, max(setting.error, FLOOR)


def _names(axes: Axes, settings: Sequence[Setting], above: bool) -> list[Annotation]:
    """Short names beside marks; settings whose marks are all but one have one name."""
    found = []
    for together in _clusters(settings):
        ladder = [_short(setting) for setting in settings if setting in together]
        names = list(dict.fromkeys(filter(None, ladder)))
        if names:
            words = names[0] if len(names) == 1 else f"{names[0]} … {names[-1]}"
            beside = together[-1] if above else together[0]
            name = axes.annotate(
                words, _place(beside), xytext=PLACES[0], textcoords="offset points", fontsize=7.5,
                color=MARKS[beside.kind][1], path_effects=HALO, zorder=3,
            )  # fmt: skip
            _put(name, PLACES[0 if above else 1])
            found.append(name)
    return found


def _put(name: Annotation, place: tuple[float, float]) -> None:
    """Draw a name so far to the right of its mark, and above it [points]."""
    name.set_position(place)
    name.set_horizontalalignment("left" if place[0] > 0 else "right")


def _keep_apart(axes: Axes, names: Sequence[Annotation], settings: Sequence[Setting]) -> None:
    """Move names off marks and off each other, where another place beside their marks is free."""
    marks = [axes.transData.transform(_place(setting)) for setting in settings]
    half = MARK_SIZE / 2 * canvas.DPI / 72
    taken = [Bbox([mark - half, mark + half]) for mark in marks]
    for name in names:
        own = name.get_position()
        for place in (own, *PLACES):
            _put(name, place)
            if not name.get_window_extent().count_overlaps(taken):
                break
        else:
            _put(name, own)
        taken.append(name.get_window_extent())


def _clusters(settings: Sequence[Setting]) -> list[list[Setting]]:
    """Group settings by time, if their marks are too close for names of their own."""
    clusters: list[list[Setting]] = []
    for setting in sorted(settings, key=lambda each: each.seconds):
        near = (cluster for cluster in clusters if _alike(setting, cluster[-1]))
        if (cluster := next(near, None)) is not None:
            cluster.append(setting)
        else:
            clusters.append([setting])
    return clusters


def _alike(one: Setting, other: Setting) -> bool:
    """Tell whether two marks are too close for a name each."""
    apart = np.abs(np.log(_place(one)) - np.log(_place(other)))
    return bool((apart < (0.25, 1.2)).all())


def _short(setting: Setting) -> str:
    """Short name that tells a setting from others of its kind."""
    if setting.kind == of.ADAPTIVE:
        return f"{setting.tolerance:.0e}".replace("e-0", "e-")
    if setting.kind == of.THESIS:
        return setting.name.removeprefix("thesis ")
    if setting.kind in BY_NUMBER:
        return setting.name.split()[0]
    return ""


def _finish(axes: Axes, least: float) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(max(FLOOR, least) / 2, 2.5)
    axes.margins(x=0.16)
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(plain)
    axes.xaxis.set_minor_formatter(FuncFormatter(lambda value, _: ""))
    axes.set_xlabel("time a point on one core (µs)")
    axes.set_ylabel("largest error of pd, log10 pfa and magnitudes")
    axes.grid(True, which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _note(dataset: xr.Dataset, settings: Sequence[Setting]) -> str:
    """Return the notes that explain the figure."""
    attributes = dataset.attrs
    likely = settings[0].likely
    worst = "the largest" if likely == 1 else f"that of {100 * likely:.0f} %"
    parts = [
        f"mark: {worst} of {labels.counted(attributes['points'], attributes['unit'][:-1])}; "
        f"bar and dot: 90 % and half of them, in pd alone; {FLOOR:g} and less at the foot",
        f"best of {labels.counted(dataset.sizes['round'], 'round')}; "
        f"reference: {attributes['reference']}",
    ]
    if attributes["truth_points"]:
        difference = of.error(attributes["truth_pd_difference"])
        parts.append(
            f"time domain at {labels.counted(attributes['truth_points'], 'point')}: within "
            f"{difference} of it"
        )
    parts.append(f"study {attributes['study_id'][:8]}, model {attributes['model_version']}")
    return labels.joined(parts)


def opened(store: Location) -> tuple[xr.Dataset, list[Setting]]:
    """Return the store as a dataset, read whole, and its settings.

    Raises
    ------
    NotAStoreError
        Where there is no such store.
    """
    read_attributes(store, ACCURACY)
    with xr.open_zarr(zarr_store(store), **CHECKED) as dataset:
        whole = dataset.load()
    return whole, settings_in(whole)


def draw(store: Location, directory: Path | None = None, form: str = "png") -> list[Path]:
    """Write the figure as NAME.png (pdf, svg) and the tables as NAME.txt."""
    dataset, settings = opened(store)
    stem = store.name.removesuffix(".zarr")
    place = beside(store) if directory is None else directory
    file = place / f"{stem}.txt"
    drawn = canvas.save(sheet(dataset, settings), place / f"{stem}.{form}")
    file.write_text(of.page(dataset, settings).text(), encoding="utf-8")
    return [drawn, file]
