"""Tables of false alarms as the thesis prints them, ours beside its: Tables 4.2 to 4.5."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.analysis import labels, noise_only
from sweep.analysis.cuts import NEAREST, bands, beyond, cuts, si_value
from sweep.analysis.selection import Points, split
from sweep.analysis.tabular import Block, Cell, Page, percent
from sweep.analysis.tallies import Search, Tally, for_median, median, pieces, search, tallied
from sweep.model.shot import evaluate
from sweep.model.threshold import tnr_of

if TYPE_CHECKING:
    from sweep.spec import Spec

VARIABLES = ["pfa_segment", "pfa_both_chirps", "p_leakage_up", "p_leakage_down"]

HELD = 0.9
"""Share of all leakage whose points are told."""


@dataclass(frozen=True)
class Leakage:
    """Where leakage comes from in a cut."""

    mean: tuple[float, float]
    median: tuple[float, float]
    shot_mean: float
    shot_median: float
    holders: int
    holders_from: float
    holders_to: float
    shares: dict[str, float]


@dataclass(frozen=True)
class _Piece:
    """Points of a group whose leakage is known, (n,) each."""

    up: np.ndarray
    down: np.ndarray
    shot: np.ndarray
    along: np.ndarray

    @property
    def total(self) -> np.ndarray:
        return self.up + self.down


class _Account:
    """What is found out of a group, reading by reading."""

    def __init__(self) -> None:
        self.up, self.down, self.shot, self.total = Tally(), Tally(), Tally(), Tally()
        self.bands: dict[str, Tally] = {}
        self.above, self.span = Tally(), Tally()

    def add(self, piece: _Piece, spec: Spec, along: str) -> None:
        """Tally a piece, in all and by bands of the coordinate."""
        total = piece.total
        for tally, values in ((self.up, piece.up), (self.down, piece.down),
                              (self.shot, piece.shot), (self.total, total)):  # fmt: skip
            tally.add(values)
        for name, mask in bands(spec, along, piece.along) if along else []:
            self.bands.setdefault(name, Tally()).add(total[mask])

    def begin_search(self) -> None:
        """Look for medians, and for the least of the values that hold most of the sum."""
        number = self.total.number
        self.medians = [for_median(number) for _ in range(3)]
        sum_of_all = float(self.total.total)
        self.least = Search([HELD * sum_of_all] if sum_of_all > 0 else [])

    def searched(self, piece: _Piece) -> Iterator[tuple[Search, np.ndarray, np.ndarray | None]]:
        """What the searches look through."""
        for one, values in zip(self.medians, (piece.up, piece.down, piece.shot), strict=True):
            yield one, values, None
        yield self.least, -piece.total, piece.total  # the largest first

    def hold(self, piece: _Piece) -> None:
        """Tally the points that hold most."""
        for least in self.least.values:
            self.above.add(piece.total[piece.total > -least])
            self.span.add(piece.along[piece.total >= -least])

    def told(self, names: Sequence[str]) -> Leakage:
        """All of it; bands in the order of their names."""
        up, down, shot = (median(found) for found in self.medians)
        holders = self.above.number
        for least in self.least.values:
            lacking = Fraction(HELD).limit_denominator(100) * self.total.total - self.above.total
            holders += max(1, math.ceil(lacking / -Fraction(least)))
        known = self.span.number > 0
        return Leakage(
            mean=(self.up.mean, self.down.mean),
            median=(up, down),
            shot_mean=self.shot.mean,
            shot_median=shot,
            holders=holders,
            holders_from=self.span.least if known else math.nan,
            holders_to=self.span.largest if known else math.nan,
            shares={
                name: float(self.bands[name].total / self.total.total)
                for name in names
                if name in self.bands and self.total.total > 0
            },
        )


def leakage(groups: Sequence[tuple[Points, str]], spec: Spec) -> list[Leakage]:
    """Mean, median and origin of the leakage of points.

    A shot's figure is the probability that noise or leakage raises an extra group in the
    up-chirp and in the down-chirp segment.

    Parameters
    ----------
    groups
        Points, and the coordinate along which the origin is told; empty for none.
    spec
        The study.
    """
    accounts = [_Account() for _ in groups]
    for number, piece in _pieces(groups):
        accounts[number].add(piece, spec, groups[number][1])
    for account in accounts:
        account.begin_search()
    search(
        [one for account in accounts for one in (*account.medians, account.least)],
        lambda: (
            own for number, piece in _pieces(groups) for own in accounts[number].searched(piece)
        ),
    )
    for number, piece in _pieces(groups):
        accounts[number].hold(piece)
    names = [
        [name for name, _ in bands(spec, along, found.column(along).values)] if along else []
        for found, along in groups
    ]
    return [account.told(own) for account, own in zip(accounts, names, strict=True)]


def _pieces(groups: Sequence[tuple[Points, str]]) -> Iterator[tuple[int, _Piece]]:
    """Points of each group whose leakage is known."""
    for number, part, values in pieces([found for found, _ in groups], VARIABLES):
        along = groups[number][1]
        where = part.spread(along) if along else np.zeros(part.size)
        up, down = values["p_leakage_up"], values["p_leakage_down"]
        shot = noise_only.shot_with_leakage(
            values["pfa_segment"], values["pfa_both_chirps"], up, down
        )
        known = np.isfinite(up) & np.isfinite(down)
        yield number, _Piece(up[known], down[known], shot[known], where[known])


MOST_ROWS = 100


@dataclass(frozen=True)
class Reference:
    """Noise alone at one setting of the instrument."""

    tnr: float
    bins: float
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
    tnr = float(tnr_of(parameters))
    bins = float(noise_only.bins_counted(parameters, noise_only.bin_probability(tnr)))
    found = evaluate(parameters)
    return Reference(
        tnr=tnr,
        bins=bins,
        closed_form=noise_only.shot_probability(tnr, bins),
        model=float(found["pfa_both_chirps"].item()),
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
    means = [tally.mean for tally in tallied([points for points, _ in groups], "pfa_both_chirps")]
    leaked = leakage([(points, cut.along) for points, cut in groups], spec)
    return [
        Entry(
            settled[i][0], cut.name, cut.along,
            points.column(cut.along).units if cut.along else "", points.size, alone[i], mean,
            float(printed[i][j]) if i < len(printed) and j < len(printed[i]) else math.nan, leak,
        )
        for (i, j), (points, cut), mean, leak in zip(places, groups, means, leaked, strict=True)
    ]  # fmt: skip


def false_alarm_page(found: Points, spec: Spec, *, by: str, printed: Any = (), title: str) -> Page:
    """Tables 4.3 to 4.5: false alarms of a shot, a row for each value of a coordinate.

    Parameters
    ----------
    found, spec
        Points, and the study.
    by
        Coordinate of the rows.
    printed
        Published figures, a row for each row and a column for each cut.
    title
        What stands over the page.
    """
    all_entries = entries(found, spec, by=by, printed=printed)
    blocks = [
        _false_alarm_block(all_entries),
        _leakage_block(all_entries),
        *_origin_blocks(all_entries),
    ]
    return Page(title, blocks, _notes(all_entries), [_record(e) for e in all_entries])


def _false_alarm_block(found: list[Entry]) -> Block:
    published = any(e.printed == e.printed for e in found)
    columns = [
        "setting", "cut", "points", "closed form", "noise only", "study's mean", "excess of mean",
    ]  # fmt: skip
    columns += ["printed", "printed/closed", "excess of printed"] if published else []
    rows = [_false_alarm_row(e)[: len(columns)] for e in found]
    return Block("Probability of a false alarm in both chirp segments, from noise", columns, rows)


def _false_alarm_row(e: Entry) -> list[Cell]:
    return [
        e.row,
        e.column,
        e.points,
        f"{e.reference.closed_form:.6e}",
        f"{e.reference.model:.6e}",
        f"{e.mean:.6e}",
        percent(e.excess(e.mean), ".1e"),
        _or_dash(e.printed, ".3e"),
        _or_dash(e.printed / e.reference.closed_form, ".3f"),
        percent(e.excess(e.printed), ".4f"),
    ]


def _leakage_block(found: list[Entry]) -> Block:
    columns = (
        "setting", "cut", "up: mean", "up: median", "down: mean", "down: median", "shot: mean",
        "shot: median",
    )  # fmt: skip
    rows = [
        (
            e.row, e.column, *(f"{x:.3e}" for pair in zip(e.leakage.mean, e.leakage.median,
            strict=True) for x in pair), f"{e.leakage.shot_mean:.3e}",
            f"{e.leakage.shot_median:.3e}",
        )
        for e in found
    ]  # fmt: skip
    return Block("Leakage: extra groups raised by the signal's own sidelobes", columns, rows)


def _origin_blocks(found: list[Entry]) -> list[Block]:
    """Where leakage comes from: a table for each set of bands."""
    blocks = []
    for names in dict.fromkeys(tuple(e.leakage.shares) for e in found if e.leakage.shares):
        own = [e for e in found if tuple(e.leakage.shares) == names]
        rows = [
            (
                e.row, e.column, f"{e.leakage.holders:,} of {e.points:,}",
                f"{e.leakage.holders_from:g}..{e.leakage.holders_to:g} {e.units}",
                *(percent(share, ".1f") for share in e.leakage.shares.values()),
            )
            for e in own
        ]  # fmt: skip
        heading = (
            f"Where leakage comes from: points that hold {HELD:.0%} of it, and its share in bands "
            f"of {labels.coordinate(own[0].along)}"
        )
        columns = ("setting", "cut", "points", "between", *names)
        blocks.append(Block(heading, columns, rows))
    return blocks


def _notes(found: list[Entry]) -> list[str]:
    bins = ", ".join(labels.number(n) for n in sorted({e.reference.bins for e in found}))
    return [
        f"closed form: (1 - (1 - p)^N)^2, p = exp(-(4 - pi)/4 TNR^2), N = {bins}.",
        *_common_notes(),
        "With bins_counted 'half' the model leaves out the bins of the detection, the closed form",
        "  none. Shot (leakage): noise or leakage raises an extra group in both chirp segments.",
    ]


def _record(e: Entry) -> dict[str, Cell]:
    """One line of the CSV file."""
    return {
        "setting": e.row,
        "cut": e.column,
        "points": e.points,
        "tnr": e.reference.tnr,
        "bins": e.reference.bins,
        "closed_form": e.reference.closed_form,
        "noise_only": e.reference.model,
        "study_mean": e.mean,
        "study_variance_excess": e.excess(e.mean),
        "printed": e.printed,
        "printed_over_closed_form": e.printed / e.reference.closed_form,
        "printed_variance_excess": e.excess(e.printed),
        "p_leakage_up_mean": e.leakage.mean[0],
        "p_leakage_up_median": e.leakage.median[0],
        "p_leakage_down_mean": e.leakage.mean[1],
        "p_leakage_down_median": e.leakage.median[1],
        "shot_with_leakage_mean": e.leakage.shot_mean,
        "shot_with_leakage_median": e.leakage.shot_median,
        "leakage_holders": e.leakage.holders,
        "leakage_along": e.along,
        "leakage_from": e.leakage.holders_from,
        "leakage_to": e.leakage.holders_to,
        "leakage_shares": "; ".join(f"{k}: {v:.4f}" for k, v in e.leakage.shares.items()),
    }


def threshold_page(found: Points, spec: Spec, *, by: str, printed: Any = (), title: str) -> Page:
    """Table 4.2: false alarms of a bin, a row for each threshold.

    Parameters
    ----------
    found, spec
        Points, and the study.
    by, printed, title
        Coordinate of the rows; published figures, one for each; what stands over the page.
    """
    records: list[dict[str, Cell]] = []
    settled = settings(found, spec, by)
    means = tallied([beyond(part, spec, NEAREST) for _, _, part in settled], "pfa_bin")
    for i, (name, setting, _) in enumerate(settled):
        alone = reference(spec, setting)
        closed = noise_only.bin_probability(alone.tnr)
        published = float(printed[i]) if i < len(printed) else math.nan
        records.append(
            {
                "setting": name,
                "tnr": alone.tnr,
                "closed_form": closed,
                "noise_only": alone.model_bin,
                "study_mean": means[i].mean,
                "printed": published,
                "printed_over_closed_form": published / closed,
                "printed_variance_excess": noise_only.variance_excess_of_bin(published, alone.tnr),
            }
        )
    columns = ("setting", "closed form", "noise only", "study's mean", "printed", "printed/closed",
               "excess of printed")  # fmt: skip
    rows = [
        (
            r["setting"], *(f"{r[key]:.6e}" for key in ("closed_form", "noise_only", "study_mean")),
            _or_dash(r["printed"], ".3g"), _or_dash(r["printed_over_closed_form"], ".3f"),
            percent(float(r["printed_variance_excess"])),
        )
        for r in records
    ]  # fmt: skip
    heading = "Probability that a bin of noise crosses the threshold"
    notes = ["closed form: exp(-(4 - pi)/4 TNR^2)", *_common_notes()]
    return Page(title, [Block(heading, columns, rows)], notes, records)


def _or_dash(value: Cell, form: str) -> str:
    return format(float(value), form) if value == value else "-"


def _common_notes() -> list[str]:
    return [
        "noise only: the model with a reflectance of 0.",
        f"study's mean: over points beyond {NEAREST} of range, the echo's own shot noise included.",
        "excess: noise variance above the one that sets the threshold, as a figure implies.",
        "  Nothing is tuned to the printed figures.",
    ]
