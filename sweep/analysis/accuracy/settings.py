"""Settings with their errors and times: the front of the best, the cheapest, who beats whom."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

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
"""What adaptive settings are held to: against the best fixed one, against the thesis's way."""

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
    rounds: np.ndarray
    """Seconds a point by round."""
    planning: float
    """Seconds a point in the best round."""
    pd_error: np.ndarray
    """By point."""
    log10_pfa_error: float
    """Largest over the points; nan where it has none, as the next two."""
    magnitude_error: float
    leakage_error: float
    """No part of what is promised: it jumps where a bin comes to the threshold."""
    likely: float
    """Share of the points that :attr:`error` is of."""

    @property
    def seconds(self) -> float:
        """A point, in the best of the rounds."""
        return float(np.min(self.rounds))

    @property
    def error(self) -> float:
        """That which counts: the largest over the points, of all that a tolerance promises.

        Where it is random, that of pd at most of the points.
        """
        if self.likely < 1.0:
            return self.quantile(self.likely)
        promised = self.quantile(1.0), self.log10_pfa_error, self.magnitude_error
        return float(np.fmax.reduce(promised))

    @property
    def is_whole(self) -> bool:
        """Whether it simulates all that the study asks for: the thesis's effects have no leakage.

        They do where leaving it out is no larger an error than those promised.
        """
        return self.kind != CLOSED_FORM or self.leakage_error <= max(self.error, EXACT)

    def quantile(self, share: float) -> float:
        """Error of pd that this share of the points stays below."""
        return float(np.nanquantile(self.pd_error, share))

    def times_faster(self, other: Setting, besides: float = 0.0) -> float:
        """Time of another over that of this, round by round, in the median; of few, at best.

        Both with what a point takes besides [s].
        """
        if self.rounds.size < FEW_ROUNDS:
            return (other.seconds + besides) / (self.seconds + besides)
        return float(np.median((other.rounds + besides) / (self.rounds + besides)))


def settings_in(dataset: xr.Dataset) -> list[Setting]:
    """The settings of a store that `sweep accuracy` made, in its order."""
    found = []
    likely = LIKELY if np.isfinite(dataset.standard_error.values).any() else 1.0
    for i in range(dataset.sizes["rung"]):
        rung = dataset.isel(rung=i)
        rounds = rung.seconds.values
        found.append(
            Setting(
                name=str(rung.rung.values),
                kind=str(rung.kind.values),
                tolerance=float(rung.tolerance),
                rounds=rounds,
                planning=float(rung.planning.values[np.argmin(rounds)]),
                pd_error=rung.pd_error.values,
                log10_pfa_error=_largest(rung.log10_pfa_error.values),
                magnitude_error=_largest(rung.magnitude_error.values),
                leakage_error=_largest(rung.leakage_error.values),
                likely=likely,
            )
        )
    return found


def _largest(values: np.ndarray) -> float:
    return float(np.fmax.reduce(values))


def of_kinds(settings: Iterable[Setting], *kinds: str) -> list[Setting]:
    """Settings of some kinds."""
    return [setting for setting in settings if setting.kind in kinds]


def candidates(settings: Iterable[Setting]) -> list[Setting]:
    """All but the reference, which has no error of its own."""
    return [setting for setting in settings if setting.kind != REFERENCE]


def front(settings: Sequence[Setting]) -> list[Setting]:
    """Settings that no other is both as fast and as accurate as, the fastest first."""
    best: list[Setting] = []
    for setting in sorted(settings, key=lambda s: (s.seconds, s.error)):
        if not best or max(setting.error, EXACT) < max(best[-1].error, EXACT):
            best.append(setting)
    return best


def cheapest(settings: Sequence[Setting], error: float) -> Setting | None:
    """The fastest setting whose error is no larger."""
    allowed = max(error, EXACT)
    fitting = [setting for setting in settings if setting.error <= allowed]
    return min(fitting, key=lambda s: s.seconds, default=None)


@dataclass(frozen=True)
class Duel:
    """An adaptive setting against another, both with no more than an error; None where none is."""

    adaptive: Setting
    other: Setting | None

    @property
    def times_faster(self) -> float:
        """How many times faster the adaptive one is; inf against nothing."""
        return self.with_besides(0.0)

    def with_besides(self, seconds: float) -> float:
        """The same, with what both take besides [s], a point."""
        return self.adaptive.times_faster(self.other, seconds) if self.other else float("inf")


def against_fixed(settings: Sequence[Setting]) -> list[Duel]:
    """For each error that adaptive settings have: the fastest of them, the fastest fixed one.

    What leaves leakage out, where there is some, does less than they do, and is none of these.
    """
    adaptive = of_kinds(settings, ADAPTIVE)
    fixed = [setting for setting in of_kinds(settings, *FIXED) if setting.is_whole]
    found = []
    for error in sorted({max(setting.error, EXACT) for setting in adaptive}, reverse=True):
        best = cheapest(adaptive, error)
        if best is not None:
            found.append(Duel(best, cheapest(fixed, error)))
    return found


def against_thesis(settings: Sequence[Setting], kind: str = THESIS) -> list[Duel]:
    """The fastest adaptive setting that is as accurate as the thesis's way, for each form of it.

    `kind`: as it is described, or improved.
    """
    found = []
    for thesis in of_kinds(settings, kind):
        best = cheapest(of_kinds(settings, ADAPTIVE), thesis.error)
        if best is not None:
            found.append(Duel(best, thesis))
    return found
