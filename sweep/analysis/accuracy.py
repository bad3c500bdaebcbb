"""Settings that `sweep accuracy` tried: who beats whom, in tables, words and a figure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet
from matplotlib.ticker import FuncFormatter, LogLocator

from sweep.analysis import canvas, labels
from sweep.analysis.opening import ACCURACY, read_attributes
from sweep.analysis.tables import Block, Page
from sweep.storage.locations import Location, beside
from sweep.storage.opening import CHECKED
from sweep.storage.sound import readable

TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)

EXACT = 1e-9
"""Error below which settings are alike: that of the reference itself."""

WRITTEN, ADAPTIVE, THESIS, REFERENCE = "as written", "adaptive", "thesis", "reference"
CLOSED_FORM, IMPROVED = "closed form", "thesis improved"
BEAMLETS, IN_A_LINE = "beamlets", "in a line"
MEANS, COUNTED, IN_NOISE = "means of draws", "draws counted", "draws in noise"
FIXED = ("fixed effects", BEAMLETS, IN_A_LINE, CLOSED_FORM, "all on", MEANS, COUNTED, IN_NOISE)
"""Kinds of settings that are the same at every point."""

AS_FAST, TIMES_FASTER = 1 / 1.1, 5.0
"""Goals of adaptive settings: against the best fixed one, against the thesis's way."""

OF_THESIS = 109
"""Beamlets of the thesis's way."""

FEW_ROUNDS = 3
"""Rounds of which fewer have no median that one slow trial would not move."""

LIKELY = 0.95
"""Share of the points whose error counts where errors are random; else all of them do."""


@dataclass(frozen=True)
class Setting:
    """A rung, in numbers."""

    name: str
    kind: str
    tolerance: float
    rounds: np.ndarray  # seconds a point by round
    planning: float  # seconds a point in the best round
    pd_error: np.ndarray  # by point
    log10_pfa_error: float  # largest over the points; nan where it has none, as the next two
    magnitude_error: float
    leakage_error: float  # no part of what is promised: it jumps where a bin comes to the threshold
    likely: float  # share of the points that :attr:`error` is of

    @property
    def seconds(self) -> float:
        """A point, in the best of the rounds."""
        return float(np.min(self.rounds))

    @property
    def error(self) -> float:
        """Return the largest error of all promised; if random, that of pd at most points."""
        if self.likely < 1.0:
            return self.quantile(self.likely)
        promised = self.quantile(1.0), self.log10_pfa_error, self.magnitude_error
        return float(np.fmax.reduce(promised))

    @property
    def is_whole(self) -> bool:
        """True where it simulates all that is asked for, or lacks what makes no larger an error."""
        return self.kind != CLOSED_FORM or self.leakage_error <= max(self.error, EXACT)

    def quantile(self, share: float) -> float:
        """Error of pd that this share of the points stays below."""
        return float(np.nanquantile(self.pd_error, share))

    def times_faster(self, other: Setting, besides: float = 0.0) -> float:
        """Time of another over that of this, round by round, in the median; of few rounds, at best.

        Both with what a point takes besides [s].
        """
        if self.rounds.size < FEW_ROUNDS:
            return (other.seconds + besides) / (self.seconds + besides)
        return float(np.median((other.rounds + besides) / (self.rounds + besides)))


def settings_in(dataset: xr.Dataset) -> list[Setting]:
    """Return the settings of a store that `sweep accuracy` made, in its order."""
    values = {name: array.values for name, array in dataset.variables.items()}
    likely = LIKELY if np.isfinite(values["standard_error"]).any() else 1.0
    return [
        Setting(
            name=str(name),
            kind=str(values["kind"][i]),
            tolerance=float(values["tolerance"][i]),
            rounds=values["seconds"][i],
            planning=float(values["planning"][i, np.argmin(values["seconds"][i])]),
            pd_error=values["pd_error"][i],
            log10_pfa_error=float(np.fmax.reduce(values["log10_pfa_error"][i])),
            magnitude_error=float(np.fmax.reduce(values["magnitude_error"][i])),
            leakage_error=float(np.fmax.reduce(values["leakage_error"][i])),
            likely=likely,
        )
        for i, name in enumerate(values["rung"])
    ]


def of_kinds(settings: Iterable[Setting], *kinds: str) -> list[Setting]:
    """Return settings of some kinds."""
    return [setting for setting in settings if setting.kind in kinds]


def candidates(settings: Iterable[Setting]) -> list[Setting]:
    """All but the reference, which has no error of its own."""
    return [setting for setting in settings if setting.kind != REFERENCE]


def front(settings: Sequence[Setting]) -> list[Setting]:
    """Return the settings that none is both as fast and as accurate as, the fastest first."""
    best: list[Setting] = []
    for setting in sorted(settings, key=lambda s: (s.seconds, s.error)):
        if not best or max(setting.error, EXACT) < max(best[-1].error, EXACT):
            best.append(setting)
    return best


def cheapest(settings: Sequence[Setting], error: float) -> Setting | None:
    """Return the fastest setting whose error is no larger."""
    allowed = max(error, EXACT)
    fitting = [setting for setting in settings if setting.error <= allowed]
    return min(fitting, key=lambda s: s.seconds, default=None)


class Duel(NamedTuple):
    """An adaptive setting against another, both with no more than an error; None where none is."""

    adaptive: Setting
    other: Setting | None

    def times_faster(self, besides: float = 0.0) -> float:
        """Time of the other over that of the adaptive one; inf against nothing.

        Both with what a point takes besides [s].
        """
        return self.adaptive.times_faster(self.other, besides) if self.other else math.inf


def against_fixed(settings: Sequence[Setting]) -> list[Duel]:
    """For each error that adaptive settings have: the fastest of them, the fastest fixed one."""
    adaptive = of_kinds(settings, ADAPTIVE)
    fixed = [setting for setting in of_kinds(settings, *FIXED) if setting.is_whole]
    errors = sorted({max(setting.error, EXACT) for setting in adaptive}, reverse=True)
    best = ((cheapest(adaptive, error), error) for error in errors)
    return [Duel(own, cheapest(fixed, error)) for own, error in best if own is not None]


def against_thesis(settings: Sequence[Setting], kind: str = THESIS) -> list[Duel]:
    """Return the fastest adaptive setting as accurate as each form of the thesis's way."""
    adaptive = of_kinds(settings, ADAPTIVE)
    best = ((cheapest(adaptive, each.error), each) for each in of_kinds(settings, kind))
    return [Duel(own, thesis) for own, thesis in best if own is not None]


COLUMNS = ("setting", "us a point", "planning", "median", "90 %", "largest", "log10 pfa",
           "magnitude", "leakage", "front")  # fmt: skip
"""Time, its share of planning, and errors: three quantiles of pd's, the largest of the others."""


SHORT = ("setting", "time", "90 %", "largest", "log pfa", "peak", "leakage")
"""The same in few columns."""

CHEAPEST = ("error allowed", "cheapest setting", "us a point", "its error")

STORING = "storing_seconds"
"""Attribute that stores of earlier versions lack."""


def rows(settings: Sequence[Setting]) -> list[list[str]]:
    """Return a row for each setting, by COLUMNS."""
    best = front(candidates(settings))
    return [
        [
            s.name,
            microseconds(s.seconds),
            microseconds(s.planning) if s.planning else "-",
            *(error(s.quantile(share)) for share in (0.5, 0.9, 1.0)),
            *map(error, (s.log10_pfa_error, s.magnitude_error, s.leakage_error)),
            "*" if s in best else "",
        ]
        for s in settings
    ]


def short_rows(settings: Sequence[Setting]) -> list[list[str]]:
    """Return the rows by SHORT: settings on the Pareto front have a star before their names."""
    return [
        [f"{star or ' '} {name}", f"{time} us", *errors]
        for name, time, _, _, *errors, star in rows(settings)
    ]


def cheapest_rows(settings: Sequence[Setting]) -> list[list[str]]:
    """Return the cheapest setting for each tolerance: tolerance, setting, its time, its error."""
    found = []
    for tolerance in TOLERANCES:
        best = cheapest(candidates(settings), tolerance)
        told = best and [best.name, microseconds(best.seconds), error(best.error)]
        found.append([f"{tolerance:g}", *(told or ["none", "", ""])])
    return found


def sentences(dataset: xr.Dataset, settings: Sequence[Setting]) -> list[str]:
    """Conclusions in words."""
    attributes = dataset.attrs
    found = [_written(dataset, settings)]
    found += _fixed(against_fixed(settings), attributes)
    found += _thesis(settings, attributes["thesis_beamlets"]) + _like_for_like(settings)
    found.append(_reference(attributes))
    notes = attributes["notes"]  # a list in stores of earlier versions
    notes = notes.splitlines() if isinstance(notes, str) else notes
    found += [note[0].upper() + note[1:] + "." for note in notes]
    if why := attributes["stopped"]:
        points = f"{attributes['points']} {attributes['unit']}"
        found.append(f"Not the whole sample ({why}): {points} of it.")
    return found


def page(dataset: xr.Dataset, settings: Sequence[Setting]) -> Page:
    """Tables and sentences under the study's title."""
    blocks = [
        Block("Settings", COLUMNS, rows(settings)),
        Block("Cheapest setting for each error", CHEAPEST, cheapest_rows(settings)),
    ]
    return Page(f"{dataset.attrs['title']}: accuracy", blocks, sentences(dataset, settings), [])


def _written(dataset: xr.Dataset, settings: Sequence[Setting]) -> str:
    (written,) = of_kinds(settings, WRITTEN)
    number, unit = dataset.attrs["study_points"], dataset.attrs["unit"]
    best = cheapest(candidates(settings), written.error)
    whole = f"All {number:,} {unit} take" if number > 1 else "The study takes"
    text = (
        f"As written: {microseconds(written.seconds)} us a point, error {error(written.error)}. "
        f"{whole} {_time(number * written.seconds)} on one core"
    )
    if (stored := dataset.attrs.get(STORING)) is not None:
        text += f"; storing them takes at least {_time(stored)} more with any setting"
    if best is None or best is written or best.times_faster(written) < 1.05:
        return text + ". No other setting is both faster and as accurate."
    times = f"{best.times_faster(written):.2g}"
    return text + f". The setting {best.name} is {times} times as fast and as accurate."


def _fixed(duels: Sequence[Duel], attributes: dict) -> list[str]:
    """Statement on adaptive against fixed settings."""
    if not duels:
        return []
    worst = min(duels, key=Duel.times_faster)
    if worst.other is None:
        return ["No fixed setting is as accurate as any adaptive one."]
    met = "met" if worst.times_faster() >= AS_FAST else _lost(worst, duels, attributes)
    several = [f"{duel.times_faster():.2g}" for duel in duels if duel.other]
    low, high = min(several, key=float), max(several, key=float)
    span = low if low == high else f"{low} to {high}"
    return [
        f"At equal error, adaptive settings are {span} times as fast as the best single "
        f"fixed setting. Least speed-up: {worst.adaptive.name} over {worst.other.name}. "
        f"Requirement, never slower by more than 10 %: {met}."
    ]


def _lost(worst: Duel, duels: Sequence[Duel], attributes: dict) -> str:
    """By how much an adaptive setting is slower, and what that is of all that the study takes."""
    points = attributes["study_points"]
    slower = worst.adaptive.seconds * (1 - worst.times_faster())
    lost, planning = (_time(points * each) for each in (slower, worst.adaptive.planning))
    told = f"NOT met, by {lost} in all; planning takes {planning}"
    if (stored := attributes.get(STORING)) is None:
        return told
    whole = min(duel.times_faster(stored / points) for duel in duels)
    return f"{told}; with the study's store it is {whole:.2g} times as fast"


def _thesis(settings: Sequence[Setting], beamlets: int) -> list[str]:
    """Statements on adaptive settings against the thesis's way, as described and improved."""
    duels = against_thesis(settings)
    if not duels:
        return []
    met = " and ".join(
        f"{'met' if duel.times_faster() >= TIMES_FASTER else 'NOT met'} over {duel.other.name}"
        for duel in duels
        if duel.other
    )
    least = f"Requirement, at least {TIMES_FASTER:g}: {met}."
    if beamlets != OF_THESIS:
        least = f"This scene has {beamlets} beamlets, the thesis {OF_THESIS}."
    told = [f"The thesis's way is compared at its own error. {_speed_ups(duels)} {least}"]
    if improved := against_thesis(settings, IMPROVED):
        told.append(f"Improved versions of it are compared likewise. {_speed_ups(improved)}")
    return told


def _speed_ups(duels: Sequence[Duel]) -> str:
    """One sentence for each adaptive setting and error."""
    groups: dict[str, list[str]] = {}
    for duel in duels:
        if duel.other:
            of = f"{duel.adaptive.name}, error {error(duel.other.error)}"
            groups.setdefault(of, []).append(f"{duel.times_faster():.2g} over {duel.other.name}")
    return " ".join(f"Speed-up of {of}: {'; '.join(each)}." for of, each in groups.items())


def _like_for_like(settings: Sequence[Setting]) -> list[str]:
    """Compare the closed form with the thesis's way: same beamlets, same effects."""
    described, improved = (
        "; ".join(
            f"{closed.times_faster(thesis):.2g} over {thesis.name}"
            for closed in of_kinds(settings, CLOSED_FORM)
            for thesis in of_kinds(settings, kind)
        )
        for kind in (THESIS, IMPROVED)
    )
    if not described:
        return []
    text = (
        "The closed form is compared with the thesis's way for the same beamlets and effects, "
        f"without leakage and changes within a record (range walk). Speed-up: {described}."
    )
    return [text + (f" Speed-up over improved versions: {improved}." if improved else "")]


def _reference(attributes: dict) -> str:
    text = f"Reference: {attributes['reference']}"
    if not attributes["truth_points"]:
        return text + ". It is not compared with the time domain."
    fewer = f", with {n} beamlets in both," if (n := attributes["truth_beamlets"]) else ""
    return text + (
        f". At {attributes['truth_points']} {attributes['unit']}{fewer} it differs from the time "
        f"domain by {error(attributes['truth_pd_difference'])} in pd and by "
        f"{error(attributes['truth_magnitude_difference'])} in magnitude."
    )


def _time(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:,.0f} min" if seconds < 6000 else f"{seconds / 3600:,.0f} h"


def microseconds(seconds: float) -> str:
    """Return a time in microseconds, in three digits."""
    value = 1e6 * seconds
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def error(value: float) -> str:
    """Return an error in two digits; 0 below what counts, nothing for nan."""
    if math.isnan(value):
        return "-"
    return f"{value:.1e}" if value >= EXACT else f"<{EXACT:.0e}".replace("e-0", "e-")


BY_NUMBER = (BEAMLETS, IN_A_LINE, MEANS, COUNTED, IN_NOISE)
"""Kinds whose settings are told apart by the number that their names begin with."""

JOINED = (ADAPTIVE, *BY_NUMBER)
"""Kinds whose settings are one method, looked at more or less closely."""

MARKS = {
    ADAPTIVE: ("o", canvas.LINES[0], "adaptive, by tolerance"),
    "fixed effects": ("s", canvas.LINES[2], "the same effects everywhere"),
    BEAMLETS: ("^", canvas.LINES[1], "number of beamlets in a lattice"),
    IN_A_LINE: ("<", canvas.LINES[7], "number of beamlets in a line"),
    "all on": ("D", canvas.LINES[3], "all effects on"),
    MEANS: ("P", canvas.LINES[5], "mean over so many draws"),
    COUNTED: ("^", canvas.LINES[1], "detections in so many draws"),
    IN_NOISE: ("<", canvas.LINES[7], "the same, noise in every bin"),
    CLOSED_FORM: ("X", canvas.LINES[5], "in closed form what the thesis's way has"),
    THESIS: ("v", canvas.LINES[4], "the thesis's way"),
    IMPROVED: ("p", canvas.LINES[4], "the thesis's way, improved"),
    WRITTEN: ("*", canvas.LINES[6], "as written"),
}
"""Marker, colour and words of each kind."""


def sheet(dataset: xr.Dataset, settings: Sequence[Setting]) -> Sheet:
    """Return the figure of a store that `sweep accuracy` made."""
    drawn = candidates(settings)
    sheet, (axes,) = canvas.panels(10.0, 6.2, 1, 1)
    axes.step(
        *zip(*map(_place, front(drawn)), strict=True), where="post", color="0.35", linewidth=1.2,
        linestyle="--", zorder=1, label="Pareto front of time and error",
    )  # fmt: skip
    for kind, (marker, colour, words) in MARKS.items():
        some = of_kinds(drawn, kind)
        for i, setting in enumerate(some):
            _mark(axes, setting, marker, colour, words if i == 0 else "")
        if kind in JOINED and some:
            line = zip(*map(_place, some), strict=True)
            axes.plot(*line, color=colour, linewidth=0.8, alpha=0.5, zorder=1)
            some = some[:1] + some[1:][-1:]
        for setting in some:
            axes.annotate(
                _short(setting), _place(setting), xytext=(6, 5), textcoords="offset points",
                fontsize=7.5, color=colour,
            )  # fmt: skip
    _finish(axes, min(setting.quantile(0.5) for setting in drawn), max(s.error for s in drawn))
    canvas.title(sheet, f"{dataset.attrs['title']}: what accuracy costs")
    canvas.caption(sheet, _note(dataset, drawn))
    return sheet


def _mark(axes: Axes, setting: Setting, marker: str, colour: str, words: str) -> None:
    """Draw a mark at the largest error, a line down to pd's of 90 %, a dot at its median."""
    time, worst = _place(setting)
    most, half = (max(setting.quantile(share), EXACT) for share in (0.9, 0.5))
    if most > EXACT:
        axes.plot([time, time], [most, worst], color=colour, linewidth=1.0, alpha=0.6, zorder=2)
        axes.plot([time], [most], marker="_", color=colour, markersize=7, zorder=2)
    if half > EXACT:
        axes.plot([time], [half], marker=".", color=colour, markersize=4, zorder=2)
    size = 11 if marker == "*" else 7
    axes.plot(
        [time], [worst], marker=marker, color=colour, markersize=size, linestyle="",
        markeredgecolor="white", markeredgewidth=0.7, label=words or None, zorder=4,
    )  # fmt: skip


def _place(setting: Setting) -> tuple[float, float]:
    """Time [us] and error at which a setting is drawn."""
    return 1e6 * setting.seconds, max(setting.error, EXACT)


def _short(setting: Setting) -> str:
    """Short name that tells a setting from others of its kind."""
    if setting.kind == ADAPTIVE:
        return f"{setting.tolerance:.0e}".replace("e-0", "e-")
    if setting.kind == THESIS:
        return setting.name.removeprefix("thesis ")
    if setting.kind in BY_NUMBER:
        return setting.name.split()[0]
    return ""


def _finish(axes: Axes, least: float, largest: float) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(max(EXACT, least) / 2, max(2.5, 2 * largest))
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
        f"bar and dot: 90 % and half of them, in pd alone; {EXACT:g} and less at the foot",
        f"best of {labels.counted(dataset.sizes['round'], 'round')}; "
        f"reference: {attributes['reference']}",
    ]
    if attributes["truth_points"]:
        difference = error(attributes["truth_pd_difference"])
        parts.append(
            f"time domain at {labels.counted(attributes['truth_points'], 'point')}: within "
            f"{difference} of it"
        )
    parts.append(f"study {attributes['study_id'][:8]}, model {attributes['model_version']}")
    return labels.joined(parts)


def opened(store: Location) -> tuple[xr.Dataset, list[Setting]]:
    """Return the store as a dataset, read whole, and its settings; NotAStoreError if it is none."""
    study_id = read_attributes(store, ACCURACY)["study_id"]
    with xr.open_zarr(readable(store, study_id), **CHECKED) as dataset:
        whole = dataset.load()
    return whole, settings_in(whole)


def draw(store: Location, directory: Path | None = None, form: str = "png") -> list[Path]:
    """Write the figure as NAME.png (pdf, svg) and the tables as NAME.txt."""
    dataset, settings = opened(store)
    stem = store.name.removesuffix(".zarr")
    place = beside(store) if directory is None else directory
    file = place / f"{stem}.txt"
    drawn = canvas.save(sheet(dataset, settings), place / f"{stem}.{form}")
    file.write_text(page(dataset, settings).text(), encoding="utf-8")
    return [drawn, file]
