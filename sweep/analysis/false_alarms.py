"""False alarms of a shot as in Tables 4.3 to 4.5 of the thesis: ours, and beside what it prints.

Noise alone in closed form and by the model; the study's mean, in which the echo's own shot noise
raises the noise a little; the printed figure and the noise variance that it implies; and leakage,
which those tables leave out: extra groups raised by the signal's own sidelobes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.analysis import noise_only
from sweep.analysis.cuts import NEAREST, beyond, cuts, si_value
from sweep.analysis.leakage import Leakage, leakage
from sweep.analysis.selection import Points, split
from sweep.analysis.tallies import tallied
from sweep.model.shot import evaluate

if TYPE_CHECKING:
    from sweep.spec import Spec

MOST_ROWS = 100


@dataclass(frozen=True)
class Reference:
    """Noise alone at one setting of the instrument."""

    tnr: float
    bins: int
    closed_form: float
    model: float
    model_bin: float


@dataclass(frozen=True)
class Entry:
    """One row of one column: a setting of the instrument in one cut."""

    row: str
    column: str
    along: str
    units: str
    points: int
    reference: Reference
    mean: float
    printed: float
    leakage: Leakage

    def excess(self, probability: float) -> float:
        """Noise variance above the threshold's that a false-alarm probability implies."""
        return noise_only.variance_excess_of_shot(
            probability, self.reference.tnr, self.reference.bins
        )


def reference(spec: Spec, setting: dict[str, Any]) -> Reference:
    """Noise alone, in closed form and by the model with a target that reflects nothing.

    Parameters
    ----------
    spec
        The study.
    setting
        SI values by dotted path that differ from the study's own.
    """
    first = {m.path: np.asarray(m.values)[0].item() for axis in spec.axes for m in axis.members}
    parameters = spec.parameters() | first | setting | {"target.reflectance": 0.0}
    tnr = float(parameters["instrument.processing.tnr"])
    bins = noise_only.bins_counted(parameters)
    found = evaluate(parameters)
    return Reference(
        tnr=tnr,
        bins=bins,
        closed_form=noise_only.shot_probability(tnr, bins),
        model=float(found["pfa_shot"].item()),
        model_bin=float(found["pfa_bin"].item()),
    )


def settings(found: Points, spec: Spec, by: str) -> list[tuple[str, dict[str, Any], Points]]:
    """Points apart by `by` and what else varies but range and angle: name, SI values, points."""
    cut_names = {cut.along for cut in cuts(spec)} | {cut.held for cut in cuts(spec)}
    names = [by, *(n for n in found.varying() if n != by and n not in cut_names)]
    members = [spec.member(name) for name in names]
    return [
        (
            name,
            {m.path: si_value(m, part.column(m.name).values[0]) for m in members},
            part,
        )
        for name, part in split(found, names, MOST_ROWS)[0]
    ]


def entries(
    found: Points, spec: Spec, *, by: str, printed: Sequence[Sequence[float]] = ()
) -> list[Entry]:
    """Every row and column of a table of false alarms.

    Parameters
    ----------
    found, spec
        Points of a study, and the study.
    by
        Coordinate of the rows.
    printed
        Published figures, a row for each row and a column for each cut.
    """
    settled = settings(found, spec, by)
    alone = [reference(spec, setting) for _, setting, _ in settled]
    places = [(i, j) for i in range(len(settled)) for j in range(len(cuts(spec)))]
    groups = [
        (beyond(cut.of(part), spec, NEAREST), cut) for _, _, part in settled for cut in cuts(spec)
    ]
    means = [tally.mean for tally in tallied([points for points, _ in groups], "pfa_shot")]
    leaked = leakage([(points, cut.along) for points, cut in groups], spec)
    return [
        Entry(
            settled[i][0], cut.name, cut.along,
            points.column(cut.along).units if cut.along else "", points.size, alone[i], mean,
            float(printed[i][j]) if i < len(printed) and j < len(printed[i]) else math.nan, leak,
        )
        for (i, j), (points, cut), mean, leak in zip(places, groups, means, leaked, strict=True)
    ]  # fmt: skip
