"""What the detector trades: receiver operating characteristic, noise by source, false alarms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import plotly.graph_objects as go
import xarray as xr

from sweep.analysis import along, labels, noise_only
from sweep.analysis.answers import alarms
from sweep.analysis.answers.physical import parameter
from sweep.analysis.cells import Side
from sweep.analysis.cuts import RANGE, coordinate_of
from sweep.analysis.figures import Study
from sweep.analysis.selection import Points
from sweep.model.effects.catalogue import EFFECTS, names_of
from sweep.model.shot import prepare
from sweep.model.threshold import WAYS, tnr_of
from sweep.report import lines, looks, wording
from sweep.report.choosing import parts
from sweep.report.page import Chart, Control, when
from sweep.spec import Spec

PLACES = 24
"""Places along a coordinate at which the noise is told by source."""

CHANCES = (0.999, 0.9, 0.5, 0.1, 0.01)
"""Probabilities of detection near which points are taken whose characteristic is drawn."""

IN_A_BIN = np.logspace(-0.05, -16, 90)
"""Probabilities of a false alarm in a bin, over which characteristics are drawn."""

DRAWS = 400
"""Draws of each point whose characteristic is random."""

WITH_LEAKAGE = "pfa_both_chirps_with_leakage"

_SHORT = {
    "pfa_bin": "noise, one bin",
    "pfa_segment": "noise, a segment",
    "pfa_both_chirps": "noise, both",
    "pfa_shot": "noise, any",
    "p_leakage_up": "leakage, up",
    "p_leakage_down": "leakage, down",
    WITH_LEAKAGE: "either, both",
}
"""Variables in as few words as a legend has room for."""

_RANDOM = {effect.name for effect in EFFECTS if effect.is_random}


@dataclass(frozen=True)
class Track:
    """Points of one part of a study along its main coordinate, or its only point."""

    words: str
    part: Points
    side: Side | None

    def places(self, most: int) -> np.ndarray:
        """Some of its places, spread over all."""
        if self.side is None:
            return np.zeros(1, int)
        size = self.side.values.size
        return np.unique(np.linspace(0, size - 1, min(most, size)).round().astype(int))

    def position(self, place: int) -> dict[str, int]:
        """Position along every axis of one of its places."""
        if self.side is None:
            return self.part.first()
        return self.part.first(self.side) | {self.side.dim: int(self.side.positions[place])}


def main_coordinate(spec: Spec) -> str:
    """Range where it varies, else the longest of the numeric coordinates; empty where none is."""
    if member := coordinate_of(spec, RANGE):
        return member.name
    numeric = [m for axis in spec.axes for m in axis.members if not isinstance(m.values, tuple)]
    longest = max(numeric, key=lambda m: np.unique(m.display).size, default=None)
    return longest.name if longest else ""


def tracks(study: Study) -> tuple[list[Track], int]:
    """Tracks along the main coordinate, and how many are left out."""
    name = main_coordinate(study.spec)
    found, fewer = parts(study, [name] if name else [], {})
    return [Track(words, p, p.side(name) if name else None) for words, p in found], fewer


def parameters_at(spec: Spec, position: Mapping[str, int]) -> dict[str, Any]:
    """SI values of all parameters at a position along the axes."""
    return spec.parameters() | {
        member.path: np.asarray(member.values)[position[axis.name]].item()
        for axis in spec.axes
        for member in axis.members
    }


def effects_at(study: Study, track: Track, places: np.ndarray) -> list[list[str]]:
    """Effects that were simulated at places along a track, but for random ones."""
    flags = np.ravel(_values_at(study, "effects", track, places))
    return [[n for n in names_of(int(flag)) if n not in _RANDOM] for flag in flags]


def _values_at(study: Study, variable: str, track: Track, places: np.ndarray) -> np.ndarray:
    """A variable at places along a track."""
    if track.side is None:
        return np.asarray(study.dataset[variable].isel(track.part.first()).values)
    array = study.dataset[variable].isel(track.part.first(track.side))
    return np.asarray(array.isel({track.side.dim: track.side.positions[places]}).values)


def roc(study: Study, found: list[Track], fewer: int) -> Chart | None:
    """Probability of detection over that of a false alarm, as the threshold moves.

    None where detectors look at whole spectra, which have no one threshold.
    """
    if study.spec.draws.whole_spectra:
        return None
    traces: list[go.Scatter] = []
    told: list[str] = []
    for track in found:
        for number, place in enumerate(_places_of_interest(study, track)):
            name = _named(study, track, place)
            point = study.dataset.isel(track.position(place))
            traces += _roc_traces(track, name, number, point.compute())
            if track is found[0]:
                told.append(name)
    return Chart(
        heading="Receiver operating characteristic",
        alt=(
            "Lines of the probability of detection of a shot over the probability of a false "
            f"alarm, as the threshold moves, {'; '.join(told) or 'at the point'}."
        ),
        caption=wording.sentences(
            ["From the stored signal-to-noise ratio; where that alone does not give the stored "
             "probability of detection, simulated for this page with the effects that the study "
             "simulates at the point" + (f", in {DRAWS} draws" if study.spec.draws.any else ""),
             "False alarms of noise alone, in all bins that are counted",
             "Dots: the study's own threshold",
             "Points: those whose probability of detection comes nearest to "
             + ", ".join(f"{chance:g}" for chance in CHANCES),
             wording.left_out(fewer)]
        ),
        figure=go.Figure(
            traces,
            looks.layout(
                xaxis=looks.axis("probability of a false alarm", type="log"),
                yaxis=looks.upright("probability of detection, shot", range=[-0.03, 1.03]),
            ),
        ),
        controls=[
            Control("part", "Shown for", [track.words for track in found]),
            Control("alarm", "False alarm", list(_ALARM_OF)),
        ],
    )  # fmt: skip


_ALARM_OF = {
    "in a segment": noise_only.segment_probability,
    "in a bin": lambda bin_probability, bins: bin_probability,
    "in both chirps": lambda p, bins: noise_only.segment_probability(p, bins) ** 2,
}
"""Probability of a false alarm from that in a bin, and the number of bins that are counted."""


def _named(study: Study, track: Track, place: int) -> str:
    if track.side is None:
        return ""
    name = main_coordinate(study.spec)
    ruler = wording.Ruler.of(study, name, track.side.values)
    value = ruler.shown(track.side.values[place : place + 1])[0]
    return f"{labels.coordinate(name)} {labels.quantity(value, ruler.units)}"


def _places_of_interest(study: Study, track: Track) -> np.ndarray:
    """Places along a track whose probability of detection is near to those looked for."""
    chosen = track.places(4 * along.STRETCHES)
    pd = np.ravel(_values_at(study, "pd_shot", track, chosen))
    if not np.isfinite(pd).any():
        return np.zeros(0, int)
    nearest = [int(chosen[np.nanargmin(np.abs(pd - chance))]) for chance in CHANCES]
    return np.unique(nearest)


def _roc_traces(track: Track, name: str, number: int, point: xr.Dataset) -> list[go.Scatter]:
    """Line and dot of one point, for each kind of false alarm."""
    curve = point.sweep.roc(IN_A_BIN, draws=DRAWS)
    spec = point.sweep.spec
    parameters = spec.parameters() | {
        str(c.attrs["path"]): parameter(point, str(c.attrs["path"]), spec).values.item()
        for c in point.coords.values()
        if "path" in c.attrs
    }
    pfa = 10.0 ** point["log10_pfa_bin"].values
    bins, own_bins = (noise_only.bins_counted(parameters, p) for p in (IN_A_BIN, pfa))
    traces = []
    for alarm, of in _ALARM_OF.items():
        meta = when(number, part=track.words, alarm=alarm)
        line = {"dash": looks.DASHES[number % len(looks.DASHES)], "width": 2}
        own = of(pfa, own_bins)
        traces += [
            go.Scatter(
                x=of(IN_A_BIN, bins).astype(np.float32), y=curve["pd"].values.astype(np.float32),
                text=[f"TNR {t:.3g}" for t in curve["curve_tnr"].values],
                name=name, legendgroup=name, showlegend=bool(name), meta=meta, line=line,
                mode="lines",
            ),
            go.Scatter(
                x=[own], y=[point["pd_shot"].values], name=f"{name}, as studied", legendgroup=name,
                showlegend=False, meta=meta, mode="markers", marker={"size": 9},
            ),
        ]  # fmt: skip
    return traces


def noise_budget(study: Study, found: list[Track], fewer: int) -> Chart:
    """Share of each source in the noise at the ADC, along the main coordinate."""
    traces: list[go.Bar | go.Scatter] = []
    told = ""
    for track in found:
        places = track.places(PLACES)
        budgets = [
            _sources(study, track.position(place), own)
            for place, own in zip(places, effects_at(study, track, places), strict=True)
        ]
        names = sorted({n for b in budgets for n in b}, key=lambda n: -budgets[0].get(n, 0.0))
        total = np.array([sum(budget.values()) for budget in budgets])
        told = told or _budget_words(budgets[0])
        for number, name in enumerate(names):
            variance = np.array([budget.get(name, 0.0) for budget in budgets])
            traces.append(_source_trace(study, track, places, number, name, variance, total))
    name = main_coordinate(study.spec)
    across = looks.axis("") if not name else wording.Ruler.of(study, name, _values(found)).axis
    return Chart(
        heading="Noise by source",
        alt=f"Shares of noise sources in the noise variance at the ADC. {told}.",
        caption=wording.sentences(
            ["Shares of the variance at the ADC, simulated for this page with the effects that the "
             "study simulates at each point; the standard deviation is shown on hovering",
             wording.left_out(fewer)]
        ),
        figure=go.Figure(
            traces,
            looks.layout(
                xaxis=across,
                yaxis=looks.upright("share of the noise variance (%)", range=[0, 100]),
                barmode="stack", hovermode="x unified" if name else "closest",
            ),
        ),
        controls=[Control("part", "Shown for", [track.words for track in found])],
    )  # fmt: skip


def _values(found: list[Track]) -> np.ndarray:
    return max((t.side.values for t in found if t.side), key=np.size)


def _sources(study: Study, position: Mapping[str, int], effects: list[str]) -> dict[str, float]:
    """Variance of each source of noise at the ADC [V^2], those that make any."""
    parameters = parameters_at(study.spec, position)
    ((_, shots),) = prepare(parameters, effects)
    found = {name: float(np.ravel(v)[0]) for name, v in shots.noise_sources.items()}
    return {name.replace("_", " "): value for name, value in found.items() if value > 0}


def _budget_words(budget: Mapping[str, float]) -> str:
    total = sum(budget.values())
    largest = sorted(budget.items(), key=lambda item: -item[1])
    return ", ".join(f"{name} {100 * value / total:.3g} %" for name, value in largest)


def _source_trace(
    study: Study, track: Track, places: np.ndarray, number: int, name: str,
    variance: np.ndarray, total: np.ndarray,
) -> go.Bar | go.Scatter:  # fmt: skip
    """One source: an area along a coordinate, a bar where there is a single point or words."""
    share = 100 * variance / np.where(total > 0, total, 1.0)
    told = [f"{1e3 * np.sqrt(v):.3g} mV rms" for v in variance]
    common: dict[str, Any] = {
        "y": share, "name": name, "text": told, "meta": when(number, part=track.words),
        "hovertemplate": "%{y:.3g} %, %{text}",
    }  # fmt: skip
    if track.side is None:
        return go.Bar(x=["the point"], textposition="none", **common)
    coordinate = main_coordinate(study.spec)
    ruler = wording.Ruler.of(study, coordinate, track.side.values)
    return go.Scatter(
        x=ruler.shown(track.side.values[places]), stackgroup=track.words or "all", mode="lines",
        **common,
    )  # fmt: skip


def false_alarms(study: Study, found: list[Track], fewer: int) -> Chart | None:
    """False alarms of noise and of leakage along the main coordinate; none without one."""
    if found[0].side is None:
        return None
    name = main_coordinate(study.spec)
    whole = alarms.of_a_shot(study.dataset, leakage=True)
    chances = study.dataset[[v for v in _SHORT if v != WITH_LEAKAGE]].assign({WITH_LEAKAGE: whole})
    named: list[lines.Named] = []
    made: list[along.Line] = []
    for number, (variable, words) in enumerate(_SHORT.items()):
        own = [lines.Named(t.words, words, number, replace(t.part, dataset=chances)) for t in found]
        # a reading each: together their chunks would wait for each other in memory
        made += along.lines([(line.points, variable) for line in own], name)
        named += own
    ruler = wording.Ruler.of(study, name, _values(found))
    # The same for all points where no axis moves it, and no number of bins.
    one = set(WAYS[:3]) & study.spec.parameters_off_axes().keys()
    closed = noise_only.bin_probability(float(tnr_of(study.spec.parameters())))
    return Chart(
        heading="False alarms",
        alt=lines.alternative(
            "probabilities of false alarms and leakage", ruler.words, named, made
        ),
        caption=wording.sentences(
            [f"A bin of noise alone crosses with probability {closed:.3g} in closed form"
             if one else "",
             *lines.remarks(made),
             "Leakage: extra groups raised by the signal's own sidelobes, over noise alone",
             "Either: by noise or by leakage; both: in the up- and in the down-chirp of a shot",
             wording.left_out(fewer)]
        ),
        figure=go.Figure(
            [t for own, line in zip(named, made, strict=True)
             for t in lines.traces(own, _above_zero(line), ruler)],
            looks.layout(xaxis=ruler.axis, yaxis=looks.upright("probability", type="log")),
        ),
        controls=[Control("part", "Shown for", [track.words for track in found])],
    )  # fmt: skip


def _above_zero(line: along.Line) -> along.Line:
    """The line where it is above zero, which an axis of decades has no place for."""

    def above(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else np.where(values > 0, values, np.nan)

    mean = np.where(line.mean > 0, line.mean, np.nan)
    return replace(line, mean=mean, low=above(line.low), high=above(line.high))
