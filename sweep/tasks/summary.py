"""The table at the end of a run: how probable detection is over the grid."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from sweep.storage.locations import Location, located
from sweep.tasks import studies
from sweep.tasks.errors import StoreError
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.pieces import done_blocks, pieces

if TYPE_CHECKING:
    from sweep.spec import Axis

#: Probability of detection above which a point counts as detected.
DETECTED = 0.9

#: Rows of the table beside the one for the whole grid.
MOST_ROWS = 10

#: Points and blocks that are looked at; of larger studies, blocks drawn by chance.
MOST_POINTS = 1 << 23
MOST_BLOCKS = 1000


@dataclass(frozen=True)
class Row:
    """Detection over one part of the grid; NaN points, not computed, are left out."""

    part: str
    points: int
    detected: float  # fraction of points with pd_shot above `DETECTED`
    pd_shot: float  # medians
    pd_doppler: float


def summary(store: str | Location) -> tuple[str, list[Row], float]:
    """Heading and rows of the table.

    Returns
    -------
    heading : str
        Name and unit of the slowest axis; empty without axes.
    rows : list of Row
        One for each part of that axis, and a last one for the whole grid.
    share : float
        Of the blocks that are done, what was looked at.

    Raises
    ------
    StoreError
        Where there is no store of sweep's.
    """
    path = located(store)
    _, study = studies.read(path)
    if not isinstance(study, GridStudy):
        raise StoreError(f"{path} holds no study over a grid")
    spec, grid = study.spec, study.grid
    done = done_blocks(path, study)
    blocks = _some(done, int(np.prod(grid.block_shape)))
    parts = list(_parts(spec.axes[0])) if grid.shape else [("all", slice(None))]
    found: list[list[np.ndarray]] = [[np.empty((2, 0))] for _ in parts]
    for place, values in pieces(path, study, ("pd_shot", "pd_doppler"), blocks):
        both = np.stack(values)
        for into, (_, part) in zip(found, parts, strict=True):
            into.append(_within(both, place, part))
    of_parts = [np.concatenate(each, axis=1) for each in found]
    rows = [_row("all", *np.concatenate(of_parts, axis=1))]
    share = len(blocks) / max(len(done), 1)
    if not grid.shape:
        return "", rows, share
    told = [_row(name, *values) for (name, _), values in zip(parts, of_parts, strict=True)]
    return _heading(spec.axes[0]), [*told, *rows], share


def _within(values: np.ndarray, place: tuple[slice, ...], part: slice) -> np.ndarray:
    """Of two arrays of a block, what lies in a part of the first axis, (2, points)."""
    if place:
        start = place[0].start
        values = values[:, max(part.start - start, 0) : max(part.stop - start, 0)]
    return values.reshape(2, -1)


def _some(done: np.ndarray, block_points: int) -> np.ndarray:
    """Blocks to look at, rising: all, or as many as may be, drawn by chance but always the same."""
    most = min(MOST_BLOCKS, max(MOST_POINTS // block_points, 1))
    if len(done) <= most:
        return done
    return np.sort(np.random.default_rng(0).choice(done, most, replace=False))


def _heading(axis: Axis) -> str:
    """Name of an axis, with the unit of its values."""
    if len(axis.members) > 1 or not axis.members[0].units:
        return axis.name
    return f"{axis.name} [{axis.members[0].units}]"


def _parts(axis: Axis) -> Iterator[tuple[str, slice]]:
    """Parts of an axis: its values, or stretches of them where there are many."""
    edges = np.linspace(0, axis.size, min(axis.size, MOST_ROWS) + 1).astype(int)
    for start, stop in pairwise(edges):
        yield _name(axis, start, stop), slice(start, stop)


def _name(axis: Axis, start: int, stop: int) -> str:
    """Values of a part of an axis; numbers of its points where it has several parameters."""
    values = range(axis.size) if len(axis.members) > 1 else axis.members[0].display
    ends = dict.fromkeys([_shown(values[start]), _shown(values[stop - 1])])
    return "..".join(ends)


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _row(part: str, shot: np.ndarray, doppler: np.ndarray) -> Row:
    known = ~np.isnan(shot)
    shot, doppler = shot[known], doppler[known]
    if not shot.size:
        return Row(part, 0, float("nan"), float("nan"), float("nan"))
    return Row(
        part,
        int(shot.size),
        float(np.mean(shot > DETECTED)),
        _median(shot),
        _median(doppler),
    )


def _median(values: np.ndarray) -> float:
    """Median of what there is; nan where there is nothing (no Doppler segment)."""
    there = values[np.isfinite(values)]
    return float(np.median(there)) if there.size else float("nan")
