"""Charts of the detector: characteristic, noise by source, false alarms, maximum range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas
import xarray as xr

from sweep.analysis import charts, labels
from sweep.analysis.answers import probability
from sweep.analysis.charts import CHANCE, LINEAR, LOG, Axis, Chart, Line, Panel, Ruler
from sweep.analysis.figures import Study
from sweep.analysis.selection import (
    GRAZING_ANGLE,
    RANGE,
    Points,
    Side,
    coordinate_of,
    parameters_at,
    split,
    spread,
)
from sweep.model import noise_only
from sweep.model.effects.catalogue import EFFECTS, names_of
from sweep.model.looks import COMBINE, NUMBER, VOTES, Looks
from sweep.model.shot import prepare
from sweep.model.threshold import WAYS, tnr_of
from sweep.report.page import Table
from sweep.units import percent

MOST_PARTS = 6
"""Values that a chart offers to choose from, at the most."""

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
    name: str
    side: Side | None

    @property
    def ruler(self) -> Ruler:
        """The main coordinate along an axis."""
        return Ruler.of(self.part, self.name)

    def places(self, most: int) -> np.ndarray:
        """Return some of its places, spread over all."""
        if self.side is None:
            return np.zeros(1, int)
        size = self.side.values.size
        return np.unique(np.linspace(0, size - 1, min(most, size)).round().astype(int))

    def position(self, place: Any) -> dict[str, Any]:
        """Position along every axis of one of its places, or of several."""
        if self.side is None:
            return self.part.first()
        return self.part.first(self.side) | {self.side.dim: self.side.positions[place]}

    def values(self, variable: str, places: np.ndarray) -> np.ndarray:
        """Return a variable at some of its places."""
        return np.ravel(self.part.dataset[variable].isel(self.position(places)).values)


def tracks(study: Study) -> tuple[list[Track], int]:
    """Tracks along the main coordinate, and how many are left out.

    The main coordinate is range where it varies, else the longest one of numbers.
    """
    every = [member for axis in study.spec.axes for member in axis.members]
    numeric = [member for member in every if not isinstance(member.values, tuple)]
    longest = max(numeric, key=lambda m: np.unique(m.display).size, default=None)
    main = coordinate_of(study.spec, RANGE) or longest
    name = main.name if main else ""
    found, fewer = charts.facets_of(study.points, [name] if name else [], MOST_PARTS)
    return [Track(words, p, name, p.side(name) if name else None) for words, p in found], fewer


def roc(study: Study, found: Sequence[Track], fewer: int) -> Chart:
    """Probability of detection over that of a false alarm, as the threshold moves."""
    panels = [panel for track in found for panel in _characteristics(study, track)]
    told = [line.name for line in panels[0].lines if line.name]
    return Chart(
        heading="Receiver operating characteristic",
        alt=(
            "Lines of the probability of detection of a shot over the probability of a false "
            f"alarm, as the threshold moves, {'; '.join(told) or 'at the point'}."
        ),
        caption=[
            "From the stored signal-to-noise ratio; where that alone does not give the stored "
            "probability of detection, simulated for this page with the effects that the study "
            "simulates at the point" + (f", in {DRAWS} draws" if study.spec.draws.any else ""),
            "False alarms of noise alone, in all bins that are counted",
            "Dots: the study's own threshold",
            "Points: those whose probability of detection comes nearest to "
            + ", ".join(f"{chance:g}" for chance in CHANCES),
            charts.not_shown(fewer),
        ],
        panels=panels,
        facets={"part": "Shown for", "alarm": "False alarm"},
    )


_ALARM_OF = {
    "in a segment": noise_only.segment_probability,
    "in a bin": lambda bin_probability, bins: bin_probability,
    "in both chirps": lambda p, bins: noise_only.segment_probability(p, bins) ** 2,
}
"""Probability of a false alarm from that in a bin, and the number of bins that are counted."""


def _characteristics(study: Study, track: Track) -> list[Panel]:
    """Return a panel for each kind of false alarm: line and dot of some points."""
    layers: dict[str, list[Line]] = {alarm: [] for alarm in _ALARM_OF}
    for number, place in enumerate(_places_of_interest(track)):
        point = study.dataset.isel(track.position(place)).compute()
        curve = point.sweep.roc(IN_A_BIN, draws=DRAWS)
        parameters = parameters_at(study.spec, track.position(place))
        pfa, own = 10.0 ** point["log10_pfa_bin"].values, point["pd_shot"].values
        bins, own_bins = (noise_only.bins_counted(parameters, p) for p in (IN_A_BIN, pfa))
        told = [f"TNR {t:.3g}" for t in curve["curve_tnr"].values]
        for alarm, of in _ALARM_OF.items():
            x = np.asarray(of(IN_A_BIN, bins))
            line = Line(x, curve["pd"].values, _named(track, place), number, told=told)
            dot = Line(
                np.atleast_1d(of(pfa, own_bins)), np.atleast_1d(own), number=number, look="dots"
            )
            layers[alarm] += [line, dot]
    across = Axis("probability of a false alarm", LOG)
    up = Axis("probability of detection, shot", limits=CHANCE)
    return [Panel({"part": track.words, "alarm": alarm}, across, up, lines)
            for alarm, lines in layers.items()]  # fmt: skip


def _named(track: Track, place: int) -> str:
    if track.side is None:
        return ""
    value = track.ruler.shown(track.side.values[place : place + 1])[0]
    return labels.valued(track.name, value, track.ruler.units)


def _places_of_interest(track: Track) -> np.ndarray:
    """Places along a track whose probability of detection is near to those looked for."""
    chosen = track.places(4 * charts.STRETCHES)
    pd = track.values("pd_shot", chosen)
    if not np.isfinite(pd).any():
        return np.zeros(0, int)
    nearest = [int(chosen[np.nanargmin(np.abs(pd - chance))]) for chance in CHANCES]
    return np.unique(nearest)


def noise_budget(study: Study, found: Sequence[Track], fewer: int) -> Chart:
    """Share of each source in the noise at the ADC, along the main coordinate."""
    panels = []
    for track in found:
        places = track.places(PLACES)
        budgets = []
        for place, flags in zip(places, track.values("effects", places), strict=True):
            parameters = parameters_at(study.spec, track.position(place))
            effects = [name for name in names_of(int(flags)) if name not in _RANDOM]
            ((_, shots),) = prepare(parameters, effects)
            budgets.append(shots.noise_sources)
        if track.side is None:
            across, x = Axis(), places
        else:
            across, x = track.ruler.axis, track.ruler.shown(track.side.values[places])
        panels.append(budget_panel({"part": track.words}, across, x, budgets))
    return budget_chart(
        panels,
        ["Shares of the variance at the ADC, simulated for this page with the effects that the "
         "study simulates at each point; the standard deviation is shown on hovering",
         charts.not_shown(fewer)],
    )  # fmt: skip


def budget_panel(
    when: Mapping[str, str], across: Axis, x: np.ndarray, budgets: Sequence[Mapping[str, Any]]
) -> Panel:
    """Shares of sources of noise from their variances [V^2] at some places, the largest first."""
    every = [{n: float(np.ravel(v)[0]) for n, v in budget.items()} for budget in budgets]
    names = list(dict.fromkeys(n for own in every for n, v in own.items() if v > 0))
    names.sort(key=lambda name: -every[0].get(name, 0.0))
    total = np.array([sum(own.values()) for own in every])
    lines = []
    for number, name in enumerate(names):
        variance = np.array([own.get(name, 0.0) for own in every])
        lines.append(
            Line(
                x, 100 * variance / np.where(total > 0, total, 1.0), name.replace("_", " "), number,
                look="area", told=[f"{1e3 * np.sqrt(v):.3g} mV rms" for v in variance],
            )
        )  # fmt: skip
    return Panel(when, across, Axis("share of the noise variance (%)", limits=(0, 100)), lines)


def budget_chart(panels: Sequence[Panel], caption: Sequence[str]) -> Chart:
    """Shares of sources of noise, a panel at a time."""
    told = ", ".join(f"{line.name} {percent(line.y[0] / 100)} at first" for line in panels[0].lines)
    alt = f"Shares of noise sources in the noise variance at the ADC. {told}."
    return Chart("Noise by source", alt, caption, panels, {"part": "Shown for"})


def false_alarms(study: Study, found: Sequence[Track], fewer: int) -> Chart | None:
    """Return false alarms of noise and leakage along the main coordinate, if there is one."""
    if found[0].side is None:
        return None
    name = found[0].name
    whole = probability.of_a_shot(study.dataset, leakage=True)
    chances = study.dataset[[v for v in _SHORT if v != WITH_LEAKAGE]].assign({WITH_LEAKAGE: whole})
    named: list[charts.Named] = []
    drawn: list[Line] = []
    remarks: list[str] = []
    for variable, words in _SHORT.items():
        own = [(track.words, words, replace(track.part, dataset=chances)) for track in found]
        # a reading each: together their chunks would wait for each other in memory
        lines, remarks = charts.along([(points, variable) for _, _, points in own], name)
        drawn += lines
        named += own
    ruler = Ruler.of(study.points, name)
    panels = charts.panels_of(named, drawn, ruler, Axis("probability", LOG))
    # The same for all points where no axis moves it, and no number of bins.
    off_axes = study.spec.parameters_off_axes()
    one = set(WAYS[:3]) & off_axes.keys() and {NUMBER, COMBINE, VOTES} <= off_axes.keys()
    values = study.spec.parameters()
    closed = noise_only.bin_probability(float(tnr_of(values)), Looks.of(values))
    return Chart(
        "False alarms",
        charts.alternative(
            "probabilities of false alarms and leakage", ruler.axis.words, panels[0]
        ),
        [f"A bin of noise alone crosses with probability {closed:.3g} in closed form"
         if one else "",
         *remarks,
         "Leakage: extra groups raised by the signal's own sidelobes, over noise alone",
         "Either: by noise or by leakage; both: in the up- and in the down-chirp of a shot",
         charts.not_shown(fewer)],
        panels,
        {"part": "Shown for"},
    )  # fmt: skip


PD = 0.9

KEPT = "kept all the way"
ANSWERS = {KEPT: "unbroken", "reached at all": "farthest"}
"""Answers of :func:`.limits.limit` by what is chosen of them."""

ENDS = {"low": "lower end", "high": "upper end"}

MAXIMUM_RANGE = f"Maximum range at a pd of {PD:g}"

TOLD = [
    f"Kept all the way: up to here the probability of detection of a shot is {PD:g} or more at "
    "every range of the study; reached at all: the farthest range at which it is.",
    "Between ranges it is interpolated in its normal deviate.",
    f"There is none where it is below {PD:g} from the first range on, not below it at the last, or "
    "not computed.",
]


def maximum_range(study: Study) -> Chart | Table | None:
    """Maximum range along another coordinate; a table where there is none to go along.

    None where range does not vary.
    """
    member = coordinate_of(study.spec, RANGE)
    if member is None:
        return None
    found = study.points
    ruler = Ruler.of(found, member.name)
    beside = found.further_along(found.dim_of(member.name), [member.name])
    apart, _ = split(found, beside, found.size)
    several = [(words, own) for words, own in apart if len(own.distinct(member.name)) > 1]
    pieces, fewer = spread(several, MOST_PARTS)
    reaches = [(words, _reach(piece, member.name, ruler.factor)) for words, piece in pieces]
    if not reaches:
        return None
    words = labels.with_units("maximum range", ruler.units)
    x = _along(study, reaches[0][1])
    return _reach_chart(reaches, x, words, fewer) if x else _reach_table(reaches, words)


def is_empty(found: Chart | Table | None) -> bool:
    """Return whether a chart has no value, as where pd is above the level at every range."""
    if not isinstance(found, Chart):
        return False
    return not any(np.isfinite(line.y).any() for panel in found.panels for line in panel.lines)


def reached(found: Chart | Table | None) -> list[str]:
    """Maximum range in a sentence, as a chart or table of :func:`maximum_range` has it."""
    kept = next(iter(ANSWERS))
    if isinstance(found, Chart):
        words, own = found.panels[0].y.words, [p for p in found.panels if p.when["answer"] == kept]
        values = np.concatenate([line.y for panel in own for line in panel.lines])
    elif found is not None:
        words = next(name for name in found.frame if name.startswith("maximum range"))
        values = found.frame[words][found.frame[f"a pd of {PD:g}"] == kept].to_numpy(float)
    else:
        return []
    there = values[np.isfinite(values)]
    told = []
    if there.size:
        ends = " to ".join(dict.fromkeys(f"{end:.3g}" for end in (there.min(), there.max())))
        part = ", of the parts shown here" if any("not shown" in c for c in found.caption) else ""
        what, _, units = words.rstrip(")").partition(" (")
        told = [
            f"{what.capitalize()} with a probability of {PD:g} or more all the way{part}: "
            f"{ends} {units}."
        ]
    if lacking := values.size - there.size:
        told.append(
            f"No maximum range at {lacking:,} of {values.size:,} places: there the probability is "
            f"below {PD:g} from the first range on, or {PD:g} or more up to the last."
        )
    return told


def _reach(piece: Points, name: str, factor: float) -> Points:
    """Return the maximum range in the units shown, and its coordinates; lazy."""
    dim = piece.dim_of(name)
    positions = np.sort(piece.side(name).positions)
    dataset = piece.dataset
    if positions.size < dataset.sizes[dim]:
        dataset = dataset.isel({dim: positions})
    reach = dataset.sweep.maximum_range(PD)
    in_units = {
        str(own): (array * factor).assign_attrs(array.attrs)
        for own, array in reach.data_vars.items()
        if not str(own).endswith("reason")
    }
    return Points.of(reach.assign(in_units))


def _along(study: Study, found: Points) -> str:
    """Return the grazing angle if it varies, or the longest coordinate of numbers."""
    varying = found.varying()
    angle = coordinate_of(study.spec, GRAZING_ANGLE)
    if angle is not None and angle.name in varying:
        return angle.name
    numbers = [name for name in varying if not labels.is_words(found.values(name))]
    return max(numbers or varying, key=lambda name: len(found.distinct(name)), default="")


def _reach_chart(reaches: Sequence[tuple[str, Points]], x: str, words: str, fewer: int) -> Chart:
    """Both answers of every part, a line for each value of what has few."""
    first = reaches[0][1]
    by = [n for n in first.further([x]) if len(first.distinct(n)) <= charts.MOST_LINES][:1]
    parts: list[tuple[str, Points]] = []
    for name, reach in reaches:
        own, lacking = split(reach, reach.further([x, *by]), MOST_PARTS)
        parts += [(", ".join(filter(None, (name, told))), part) for told, part in own]
        fewer += lacking
    fewer += max(0, len(parts) - MOST_PARTS)
    named, _ = charts.lines_of(parts[:MOST_PARTS], by)
    pairs = [(own, answer) for answer in ANSWERS.values() for _, _, own in named]
    both, remarks = charts.along(pairs, x)
    ruler = Ruler.of(first, x)
    up = Axis(words, LINEAR, (0.0, None))
    panels = [
        panel
        for choice, drawn in zip(ANSWERS, (both[: len(named)], both[len(named) :]), strict=True)
        for panel in charts.panels_of(named, drawn, ruler, up, answer=choice)
    ]
    span = ruler.span(np.unique(first.values(x)))
    return Chart(
        MAXIMUM_RANGE,
        charts.alternative(f"{words} at a probability of detection of {PD:g}", span, panels[0]),
        [*TOLD, *remarks, charts.not_shown(fewer)],
        panels,
        {"part": "Shown for", "answer": f"A pd of {PD:g}"},
    )


def _reach_table(reaches: Sequence[tuple[str, Points]], words: str) -> Table:
    """Both answers of each part, with their intervals or why there are none."""
    rows = []
    for part, found in reaches:
        reach: xr.Dataset = found.dataset.isel(found.first()).compute()
        meanings = str(reach["unbroken_reason"].attrs["flag_meanings"]).split()
        for choice, answer in ANSWERS.items():
            ends = {f"{answer}_{end}": told for end, told in ENDS.items()}
            rows.append(
                {"for": part, f"a pd of {PD:g}": choice, words: reach[answer].item()}
                | {told: reach[name].item() for name, told in ends.items() if name in reach}
                | {"which is": meanings[int(reach[f"{answer}_reason"])].replace("_", " ")}
            )
    frame = pandas.DataFrame(rows)
    if not any(part for part, _ in reaches):
        frame = frame.drop(columns="for")
    return Table(MAXIMUM_RANGE, TOLD, frame, "maximum_range")
