"""Every knob of accuracy: what it does, its default, and what turning it costs.

The first six are a study's (``accuracy`` and ``draws.interval`` in a spec); the rest share the
tolerance out among what may err, or bound what it may call for, and are the same for every study.

    tolerance ─┬─ 0.80 or 0.55   effects that are left out (0.55 where beamlets are counted by it)
               ├─ 0.25           number of beamlets
               ├─ 1.0            few lines in place of many   } bounds with lines and bins at their
               └─ 0.5            leakage not looked for       } worst, so that they hardly add

Try ``tolerance`` first: everything else follows from it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

AUTOMATIC = -1.0
"""Stands for an error that follows from the tolerance."""


@dataclass(frozen=True)
class Accuracy:
    """How exactly points are computed; the first five are scalars or one a point."""

    tolerance: ArrayLike = 1e-3
    """Largest error of a probability of detection, of log10 of one of false alarm, or of a relative
    magnitude. Where a point is drawn until it is known, the half-width of its interval. 0 leaves
    nothing out. A tenth of it rarely doubles the time of a point; where draws decide, it takes a
    hundred times as many."""

    confidence: ArrayLike = 0.95
    """Confidence of the intervals of what is drawn. Draws grow with the square of the normal
    quantile: 0.99 takes 1.7 times those of 0.95."""

    line_error: ArrayLike = AUTOMATIC
    """Error of a bin, in noise sigmas, by few lines in place of many beamlets. By default
    `lines_share` of the tolerance. A smaller one takes more lines a segment, slowly."""

    leakage_error: ArrayLike = AUTOMATIC
    """Chance of leakage, of all bins far from the lines, that is not looked for. By default
    `leakage_share` of the tolerance. A smaller one looks at more bins."""

    leakage_floor: ArrayLike = AUTOMATIC
    """Bins with less leaked signal than so many sigmas count as noise alone, where bins are looked
    at one by one. By default as `leakage_error` allows. A lower one looks at more bins."""

    interval: str = "clopper_pearson"
    """Interval of a counted share, one of :data:`sweep.model.intervals.COUNTED`. Clopper and
    Pearson's covers at least as often as it says; Wilson's takes fewer draws and covers about as
    often."""

    growth: float = 1.25
    """Draws at which half-widths are looked at, over those at the look before. Nearer 1 wastes
    fewer draws past the last look, and looks more often, which costs coverage."""

    effects_share: float = 0.8
    """Share of the tolerance for effects that are left out, number of beamlets included. More of it
    leaves more effects out, and nothing for the lines."""

    beamlets_share: float = 0.25
    """Share of the tolerance for the number of beamlets, where that is left to the tolerance; it is
    taken from that of effects. Half of it is one more step of `COUNTS` at most points."""

    lines_share: float = 1.0
    """Share of the tolerance for `line_error`: all, as its bounds have lines and bins at their
    worst."""

    leakage_share: float = 0.5
    """Share of the tolerance for `leakage_error`."""

    one_line_share: float = 0.1
    """Share of the beamlets' tolerance that one line of nodes may miss across the slope before
    several lines are tried. A smaller one tries them at more points, to the same end."""

    most_beamlets: int = 4096
    """Beamlets of a plane's footprint at the most. Points that need more are computed with those
    that err least, and their ``beamlets_error`` says by how much."""

    thesis_beamlets: int = 109
    """Beamlets of [T 3.3.1], taken where no number is enough: amplitudes that add over a smooth
    plane all but cancel."""

    fewest_rays: tuple[tuple[float, int], ...] = ((1e-2, 19), (1e-5, 37), (0.0, 109))
    """Rays that every shot of a flight has, from a tolerance on. What none of them hits no estimate
    knows of: fewer miss small objects unseen."""

    rays: tuple[int, ...] = (19, 37, 109, 439, 2029, 8017, 31987, 127999)
    """Rays that may be cast for a shot: whole shells of the lattice, as only these are alike on
    opposite sides, which makes smooth ground a hundred times more exact. The fewest are those whose
    error can be told from themselves; each costs some 80 ns."""

    least_rays_tolerance: float = 1e-6
    """Tighter tolerances call for no more rays than this one."""

    @classmethod
    def of(cls, parameters: Mapping[str, Any], **further: Any) -> "Accuracy":
        """Accuracy that parameters by dotted path ask for."""
        paths = ("tolerance", "confidence", "line_error", "leakage_error", "leakage_floor")
        asked = {name: parameters[f"accuracy.{name}"] for name in paths
                 if f"accuracy.{name}" in parameters}  # fmt: skip
        return cls(**asked, **further)

    def at(self, points: np.ndarray, size: int) -> "Accuracy":
        """Tolerance and confidence of some of `size` points."""
        tolerance, confidence = (
            np.broadcast_to(values, (size,))[points] for values in (self.tolerance, self.confidence)
        )
        return replace(self, tolerance=tolerance, confidence=confidence)

    @property
    def for_lines(self) -> np.ndarray:
        """Error of a bin over sigma by few lines for many."""
        return self._or_share(self.line_error, self.lines_share)

    @property
    def for_leakage(self) -> np.ndarray:
        """Chance of leakage that need not be looked for."""
        return self._or_share(self.leakage_error, self.leakage_share)

    @property
    def for_beamlets(self) -> np.ndarray:
        """Error of pd by the number of beamlets."""
        return self.beamlets_share * np.asarray(self.tolerance, float)

    def for_effects(self, *, counts_beamlets: bool) -> np.ndarray:
        """Change of a probability by all effects that are left out."""
        taken = self.beamlets_share if counts_beamlets else 0.0
        return (self.effects_share - taken) * np.asarray(self.tolerance, float)

    @property
    def for_rays(self) -> float:
        """Error of pd by the number of rays of a flight's shot."""
        return max(float(np.asarray(self.tolerance)), self.least_rays_tolerance)

    @property
    def follows_tolerance(self) -> np.ndarray:
        """Where errors of lines or leakage follow from the tolerance."""
        errors = (np.asarray(self.line_error), np.asarray(self.leakage_error))
        return np.logical_or(*(error == AUTOMATIC for error in errors))

    def _or_share(self, given: ArrayLike, share: float) -> np.ndarray:
        allowed = share * np.asarray(self.tolerance, float)
        return np.where(np.asarray(given, float) == AUTOMATIC, allowed, given)
