"""Leakage over a cut: how likely it raises an extra group, and where in range it comes from."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from sweep.analysis import noise_only
from sweep.analysis.cuts import bands
from sweep.analysis.selection import Points
from sweep.analysis.tallies import Search, Tally, for_median, median, pieces, search

if TYPE_CHECKING:
    from sweep.spec import Spec

VARIABLES = ["pfa_segment", "pfa_shot", "p_leakage_up", "p_leakage_down"]

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
        shot = noise_only.shot_with_leakage(values["pfa_segment"], values["pfa_shot"], up, down)
        known = np.isfinite(up) & np.isfinite(down)
        yield number, _Piece(up[known], down[known], shot[known], where[known])
