"""Leakage over a cut: how likely it raises an extra group, and where in range it comes from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sweep.analysis.cuts import bands
from sweep.analysis.selection import Points

if TYPE_CHECKING:
    from sweep.spec import Spec

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


def leakage(found: Points, spec: Spec, along: str) -> Leakage:
    """Mean, median and origin of the leakage of points along a coordinate.

    A shot's figure is the probability that noise or leakage raises an extra group in the
    up-chirp and in the down-chirp segment.
    """
    up, down = found.variables["p_leakage_up"], found.variables["p_leakage_down"]
    known = np.isfinite(up) & np.isfinite(down)
    found, up, down = found.at(known), up[known], down[known]
    if not found.size:
        nothing = (math.nan, math.nan)
        return Leakage(nothing, nothing, math.nan, math.nan, 0, math.nan, math.nan, {})
    noise_up = found.variables["pfa_segment"]
    noise_down = found.variables["pfa_shot"] / np.where(noise_up > 0, noise_up, 1.0)
    shot = (up + noise_up * (1 - up)) * (down + noise_down * (1 - down))
    total = up + down
    where = found.coordinates[along].values if along else np.zeros(total.size)
    held = _holders(total, HELD)
    span = (where[held].min(), where[held].max()) if held.size else (math.nan, math.nan)
    parts = bands(spec, along, where) if along and total.sum() > 0 else []
    return Leakage(
        mean=(float(up.mean()), float(down.mean())),
        median=(float(np.median(up)), float(np.median(down))),
        shot_mean=float(shot.mean()),
        shot_median=float(np.median(shot)),
        holders=held.size,
        holders_from=float(span[0]),
        holders_to=float(span[1]),
        shares={name: float(total[mask].sum() / total.sum()) for name, mask in parts},
    )


def _holders(values: np.ndarray, share: float) -> np.ndarray:
    """Indices of the fewest values that hold a share of the sum."""
    if not values.sum() > 0:
        return np.empty(0, int)
    order = np.argsort(-values, kind="stable")
    cumulated = np.cumsum(values[order])
    return order[: int(np.searchsorted(cumulated, share * cumulated[-1])) + 1]
