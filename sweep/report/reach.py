"""How far a lidar detects: the maximum range over what else a study varies."""

from __future__ import annotations

import numpy as np
import pandas
import plotly.graph_objects as go

from sweep.analysis import along, labels
from sweep.analysis.cuts import GRAZING_ANGLE, RANGE, coordinate_of
from sweep.analysis.figures import Study
from sweep.analysis.selection import Points, split, spread
from sweep.analysis.slices import MOST_LINES
from sweep.report import lines, looks, wording
from sweep.report.choosing import MOST_PARTS
from sweep.report.page import Chart, Control, Table

PD = 0.9

KEPT = "kept all the way"
ANSWERS = {KEPT: "unbroken", "reached at all": "farthest"}
"""Answers of :func:`.limits.limit` by what is chosen of them."""

ENDS = {"low": "lower end", "high": "upper end"}

TOLD = [
    f"Kept all the way: up to here the probability of detection of a shot is {PD:g} or more at "
    "every range of the study; reached at all: the farthest range at which it is.",
    "Between ranges it is interpolated in its normal deviate.",
    f"There is none where it is below {PD:g} from the first range on, not below it at the last, or "
    "not computed.",
]


def chart(study: Study) -> Chart | Table | None:
    """Maximum range along another coordinate; a table where there is none to go along.

    None where range does not vary.
    """
    member = coordinate_of(study.spec, RANGE)
    if member is None:
        return None
    ruler = wording.Ruler.of(study, member.name, np.asarray(member.display))
    pieces, fewer = _pieces(study, member.name)
    reaches = [(words, _reach(piece, member.name, ruler.factor)) for words, piece in pieces]
    if not reaches:
        return None
    words = labels.with_units("maximum range", ruler.units)
    x = _along(study, reaches[0][1])
    if not x:
        return _table(reaches, words)
    parts, by, lacking = _parts(reaches, x)
    return _chart(study, parts, (x, by), words, wording.left_out(fewer + lacking))


def _pieces(study: Study, name: str) -> tuple[list[tuple[str, Points]], int]:
    """Points with several ranges, apart by what varies with range along a zipped axis."""
    found = study.points
    apart, _ = split(found, found.axes[found.axis_of(name)].further([name]), found.size)
    several = [(words, own) for words, own in apart if len(own.distinct(name)) > 1]
    return spread(several, MOST_PARTS)


def _reach(piece: Points, name: str, factor: float) -> Points:
    """The maximum range in the units shown, with what it varies over; not computed."""
    dim = piece.axis_of(name)
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
    """The grazing angle where it varies, else the longest coordinate of numbers; empty for none."""
    varying = found.varying()
    angle = coordinate_of(study.spec, GRAZING_ANGLE)
    if angle is not None and angle.name in varying:
        return angle.name
    numbers = [name for name in varying if not labels.is_words(found.column(name).values)]
    return max(numbers or varying, key=lambda name: len(found.distinct(name)), default="")


def _parts(
    reaches: list[tuple[str, Points]], x: str
) -> tuple[list[tuple[str, Points]], list[str], int]:
    """Parts of which one is shown at a time, what their lines are for, how many are left out."""
    first = reaches[0][1]
    by = [name for name in first.further([x]) if len(first.distinct(name)) <= MOST_LINES][:1]
    parts, fewer = [], 0
    for words, reach in reaches:
        own, lacking = split(reach, reach.further([x, *by]), MOST_PARTS)
        parts += [(", ".join(filter(None, (words, told))), part) for told, part in own]
        fewer += lacking
    return parts[:MOST_PARTS], by, fewer + max(0, len(parts) - MOST_PARTS)


def _chart(
    study: Study, parts: list[tuple[str, Points]], over: tuple[str, list[str]], words: str,
    left_out: str,
) -> Chart:  # fmt: skip
    x, by = over
    named, _ = lines.lines_of(parts, by)
    pairs = [(own.points, answer) for answer in ANSWERS.values() for own in named]
    both = along.lines(pairs, x)
    made = dict(zip(ANSWERS, (both[: len(named)], both[len(named) :]), strict=True))
    ruler = wording.Ruler.of(study, x, lines.longest(named, x))
    return Chart(
        heading=f"Maximum range at a pd of {PD:g}",
        alt=lines.alternative(
            f"{words} at a probability of detection of {PD:g}",
            ruler.span(lines.longest(named, x)), named, made[KEPT],
        ),
        caption=wording.sentences([*TOLD, *lines.remarks(made[KEPT]), left_out]),
        figure=go.Figure(
            [
                trace
                for choice, drawn in made.items()
                for own, line in zip(named, drawn, strict=True)
                for trace in lines.traces(own, line, ruler, answer=choice)
            ],
            looks.layout(xaxis=ruler.axis, yaxis=looks.upright(words, rangemode="tozero")),
        ),
        controls=[
            Control("part", "Shown for", [part for part, _ in parts]),
            Control("answer", f"A pd of {PD:g}", list(ANSWERS)),
        ],
    )  # fmt: skip


def _table(reaches: list[tuple[str, Points]], words: str) -> Table:
    """Both answers of each part, with their intervals or why there are none."""
    rows: list[tuple[str | float, ...]] = []
    columns: list[str] = []
    for part, found in reaches:
        reach = found.dataset.isel(found.first()).compute()
        meanings = str(reach["unbroken_reason"].attrs["flag_meanings"]).split()
        for choice, answer in ANSWERS.items():
            ends = {end: f"{answer}_{end}" for end in ENDS if f"{answer}_{end}" in reach}
            columns = ["for", f"a pd of {PD:g}", words, *(ENDS[end] for end in ends), "which is"]
            values = [reach[name].item() for name in (answer, *ends.values())]
            told = meanings[int(reach[f"{answer}_reason"])].replace("_", " ")
            rows.append((part, choice, *values, told))
    frame = pandas.DataFrame(rows, columns=columns)
    if not any(part for part, _ in reaches):
        frame = frame.drop(columns="for")
    return Table(f"Maximum range at a pd of {PD:g}", TOLD, frame, "maximum_range")
