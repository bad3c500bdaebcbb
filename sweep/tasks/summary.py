"""Stores in numbers: blocks done, detection, what came back in a flight, errors and tolerance.

StoreError where there is no store of sweep's, or one of another kind.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.accuracy import Accuracy
from sweep.model.outputs import PROMISED
from sweep.model.unsupported import UnsupportedShot
from sweep.storage.locations import PACKED, Location, files_below, located
from sweep.storage.opening import read_receipts
from sweep.storage.sound import open_arrays
from sweep.tasks import journal, studies
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid_study import GridStudy, evaluate_points, select, with_few_draws
from sweep.tasks.journal import begun_points, receipted
from sweep.tasks.progress import StoreError
from sweep.tasks.study import TOLERANCE, Study

if TYPE_CHECKING:
    from sweep.spec import Axis

#: Probability of detection above which a point counts as detected.
DETECTED = 0.9

#: Rows of the table beside the one for the whole grid.
MOST_ROWS = 10

#: Points and blocks that are looked at; of larger studies, blocks drawn by chance.
MOST_POINTS = 1 << 23
MOST_BLOCKS = 1000

#: Places along the axes that are told one by one, of a flight.
MOST_PLACES = 12


@dataclass(frozen=True)
class Row:
    """Detection over one part of the grid; NaN points, not computed, are left out."""

    part: str
    points: int
    detected: float  # fraction of points with pd_shot above `DETECTED`
    pd_shot: float  # medians
    pd_doppler: float

    @classmethod
    def of(cls, part: str, shot: np.ndarray, doppler: np.ndarray) -> Row:
        """Return the row of some points, (n,) each; there may be no Doppler segment."""
        known = ~np.isnan(shot)
        shot, doppler = shot[known], doppler[known & np.isfinite(doppler)]
        if not shot.size:
            return cls(part, 0, float("nan"), float("nan"), float("nan"))
        median = float(np.median(doppler)) if doppler.size else float("nan")
        detected = float(np.mean(shot > DETECTED))
        return cls(part, shot.size, detected, float(np.median(shot)), median)


def summary(store: str | Location) -> tuple[str, list[Row], float]:
    """Heading of the slowest axis; a row for each part of it and one for all.

    The share of the blocks that are done, of which some are looked at, comes last.
    """
    path = located(store)
    _, study = studies.read(path)
    if not isinstance(study, GridStudy):
        raise StoreError(f"{path} holds no study over a grid")
    blocks, share = _some(path, study, None)
    axis = study.spec.axes[0] if study.spec.axes else None
    size = axis.size if axis else 1  # in parts of a value each, or of several where there are many
    edges = np.linspace(0, size, min(size, MOST_ROWS) + 1).astype(int)
    found: list[list[np.ndarray]] = [[np.empty((2, 0))] for _ in edges[1:]]
    for place, values in pieces(path, study, ("pd_shot", "pd_doppler"), blocks):
        both = np.stack(values).reshape(2, -1, *values[0].shape[1:])
        numbers = np.arange(both.shape[1]) + (place[0].start if place else 0)
        for into, (first, stop) in zip(found, pairwise(edges), strict=True):
            into.append(both[:, (first <= numbers) & (numbers < stop)].reshape(2, -1))
    of_parts = [np.concatenate(each, axis=1) for each in found]
    whole = Row.of("all", *np.concatenate(of_parts, axis=1))
    if axis is None:
        return "", [whole], share
    names = [_name(axis, first, stop) for first, stop in pairwise(edges)]
    rows = [Row.of(name, *values) for name, values in zip(names, of_parts, strict=True)]
    units = axis.members[0].units if len(axis.members) == 1 else ""
    return f"{axis.name} [{units}]" if units else axis.name, [*rows, whole], share


def beyond_model(store: str | Location, done: np.ndarray | None = None) -> tuple[int, str]:
    """Count points beyond the model, of a sample; return the reason for the first."""
    path = located(store)
    _, study = studies.read(path)
    if not isinstance(study, GridStudy):
        return 0, ""
    (blocks, _), number, why = _some(path, study, done), 0, ""
    for block, (_, (shot,)) in zip(blocks, pieces(path, study, ("pd_shot",), blocks), strict=True):
        points = np.flatnonzero(np.isnan(shot))
        if points.size and not number:
            why = why_beyond(study, int(block), points[:1])
        number += points.size
    return number, why


def why_beyond(study: GridStudy, block: int, point: np.ndarray) -> str:
    """Reason that the model does not hold for a point of a block."""
    ((_, names),) = study.selection.of_block(block).some(point).groups()
    try:
        parameters = select(study.grid.parameters(block), point)
        evaluate_points(with_few_draws(study.spec, 1), parameters, 1, names)
    except UnsupportedShot as error:
        return str(error)
    return "it is not any more"


def _some(store: Location, study: Study, done: np.ndarray | None) -> tuple[np.ndarray, float]:
    """Blocks to look at, of those done: all, or some by chance but always the same; their share."""
    done = np.flatnonzero(receipted(store, study)) if done is None else done
    most = min(MOST_BLOCKS, max(MOST_POINTS * study.n_blocks // study.points, 1))
    if len(done) <= most:
        return done, 1.0
    return np.sort(np.random.default_rng(0).choice(done, most, replace=False)), most / len(done)


def _name(axis: Axis, start: int, stop: int) -> str:
    """Values of a part of an axis; numbers of its points where it has several parameters."""
    values = range(axis.size) if len(axis.members) > 1 else axis.members[0].display
    return "..".join(dict.fromkeys([_shown(values[start]), _shown(values[stop - 1])]))


def _shown(value: object) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e6 else f"{value:.4g}"


def pieces(
    store: Location, study: Study, names: Sequence[str], blocks: np.ndarray
) -> Iterator[tuple[tuple[slice, ...], list[np.ndarray]]]:
    """Slices of some arrays, all cut alike, that each block has written, and their values."""
    group = open_arrays(store)
    arrays: list[Any] = [group[name] for name in names]
    for block in blocks:
        if (place := study.regions(int(block)).get(names[0])) is not None:
            yield place, [np.asarray(array[place or ...]) for array in arrays]


@dataclass
class SceneRow:
    """Echoes of a scanner at one place along the axes, in the blocks that are committed."""

    part: str
    shots: int = 0  # times draws
    true: int = 0  # of these, with at least one true return
    false: int = 0  # points that are no true return
    cycles: int = 0  # times draws; 0 where a cycle has too few shots
    solved: int = 0  # of these, with a velocity vector
    chances: list[np.ndarray] = field(default_factory=list, repr=False)

    @property
    def pd(self) -> float:
        """Mean probability of detection of shots that see something; nan where none does."""
        seen = np.concatenate([*self.chances, np.empty(0)])
        return float(seen.mean()) if seen.size else float("nan")

    def add(self, found: Mapping[str, np.ndarray]) -> None:
        """Count a block, by its part of each array."""
        from sweep.model.navigation import EXCLUDED
        from sweep.model.pairing import TRUE

        flags = found["flags"]
        self.shots += flags[..., 0].size
        self.true += int(((flags & TRUE) > 0).any(axis=-1).sum())
        self.false += int(((flags > 0) & ((flags & TRUE) == 0)).sum())
        if "pd_shot" in found:  # with the first draws alone
            self.chances.append(found["pd_shot"][np.isfinite(found["pd_shot"])])
        if "velocity_status" in found:
            status = found["velocity_status"]
            self.cycles += status.size
            self.solved += int((status <= EXCLUDED).sum())


def scene_summary(store: str | Location) -> list[SceneRow]:
    """Return a row for each scanner and place along the axes, or scanner if many."""
    path = located(store)
    _, study = studies.read(path)
    if not isinstance(study, FlightStudy):
        raise StoreError(f"{path} holds no study of a scene")
    places = list(np.ndindex(tuple(int(axis.size) for axis in study.spec.axes)))
    apart = len(places) <= MOST_PLACES
    rows = {
        (scanner, place): SceneRow(", ".join([scanner, *place_words(study.spec.axes, place)]))
        for scanner in study.scanners
        for place in (places if apart else [()])
    }
    group: Any = open_arrays(path)
    for block in np.flatnonzero(receipted(path, study)).tolist():
        _, part = study.part(block)
        regions = study.regions(block)
        names = (f"{part.scanner}/{name}" for name in ("flags", "pd_shot", "velocity_status"))
        found = {
            name.rpartition("/")[2]: np.asarray(group[name][regions[name]])
            for name in names
            if name in regions
        }
        rows[part.scanner, part.axes if apart else ()].add(found)
    return list(rows.values())


def place_words(axes: Sequence[Axis], place: tuple[int, ...]) -> list[str]:
    """Values at a place along axes; of its first axes, where there are more."""
    return [
        f"{member.name} {_shown(member.display[index])}{' ' * bool(member.units)}{member.units}"
        for axis, index in zip(axes, place, strict=False)
        for member in axis.members
    ]


@dataclass
class ErrorRow:
    """Error of a probability of detection, or of all that depends on a scanner's rays."""

    name: str
    """Of the probability or the scanner; none for a grid's beamlets, which are counted as rays."""
    points: int = 0  # computed, with a known error; of a flight shots, times places along the axes
    met: int = 0  # of these, within the tolerance
    error: float = math.nan  # of the point that is furthest above its tolerance: its half-width
    tolerance: float = math.nan  # there
    where: str = ""
    number: int = 0  # of draws, or of rays, that it has had there
    total: int = 0  # the same of all points
    most: int = 0
    index: tuple[int, ...] = ()  # place of that point in the array
    looked_at: float = 1.0  # share of the blocks, of large studies
    _over: float = -math.inf

    @property
    def missed(self) -> float:
        """By how much the tolerance is missed at the worst point; 0 where it is met."""
        return max(0.0, self.error - self.tolerance)

    @property
    def mean(self) -> float:
        """Draws or rays of a point."""
        return self.total / max(self.points, 1)

    @property
    def needed(self) -> float:
        """Draws that would do there, about; nan where these did, inf where none would."""
        if not self.missed:
            return math.nan
        if not self.tolerance:
            return math.inf
        return math.ceil(self.number * (self.error / self.tolerance) ** 2)

    def add(
        self, error: np.ndarray, tolerance: np.ndarray, number: np.ndarray, start: tuple[int, ...]
    ) -> None:
        """Take in some points, the first of which is at ``start``."""
        known = np.isfinite(error)
        number = np.where(known, np.nan_to_num(number), 0)
        over = np.where(known, error - tolerance, -np.inf)
        self.points += int(known.sum())
        self.met += int((over <= 0).sum() - (~known).sum())
        self.total += int(number.sum())
        self.most = max(self.most, int(number.max(initial=0)))
        at = np.unravel_index(np.argmax(over), over.shape)
        if over[at] > self._over:
            self._over, self.error = float(over[at]), float(error[at])
            self.tolerance, self.number = float(tolerance[at]), int(number[at])
            self.index = tuple(first + int(i) for first, i in zip(start, at, strict=True))


def accuracy_table(store: str | Location, done: np.ndarray | None = None) -> list[ErrorRow]:
    """Return a row for each promised probability; none if nothing is drawn or computed."""
    path = located(store)
    _, study = studies.read(path)
    if not isinstance(study, GridStudy) or not study.spec.draws.any:
        return []
    errors = {name: f"{name}_half_width" for name in PROMISED}
    return [r for r in _rows(path, study, done, errors, "n_draws", _tolerance(study)) if r.points]


def rays_table(store: str | Location, done: np.ndarray | None = None) -> list[ErrorRow]:
    """Return a row for each scanner; of a grid one where even the most beamlets are too few."""
    path = located(store)
    _, study = studies.read(path)
    if isinstance(study, GridStudy):
        limit = np.maximum(Accuracy(_tolerance(study)).for_beamlets, Accuracy.least_rays_tolerance)
        rows = _rows(path, study, done, {"": "beamlets_error"}, "beamlets", limit)
        return [row for row in rows if row.missed]
    if not isinstance(study, FlightStudy) or not study.spec.rays_by_tolerance:
        return []
    found, group = [], open_arrays(path)
    for name in study.scanners:
        errors, tolerance = {name: f"{name}/beamlets_error"}, study.spec.accuracy.tolerance
        for row in _rows(path, study, done, errors, f"{name}/beamlets", np.asarray(tolerance)):
            if row.points:
                times: Any = group[f"{name}/time"]
                time = f"time {float(np.asarray(times[row.index[-1]])):.4g} s"
                row.where = f"{row.where}, {time}" if study.spec.axes else time
                found.append(row)
    return found


def _rows(
    path: Location,
    study: GridStudy | FlightStudy,
    done: np.ndarray | None,
    errors: Mapping[str, str],
    number: str,
    tolerance: np.ndarray,
) -> list[ErrorRow]:
    """Rows by the names of arrays of errors, and of draws or rays."""
    (blocks, share), axes = _some(path, study, done), study.spec.axes
    found = [ErrorRow(name, looked_at=share) for name in errors]
    tolerance = np.broadcast_to(tolerance, study.layouts[number].shape)
    for place, (numbers, *widths) in pieces(path, study, [number, *errors.values()], blocks):
        for row, error in zip(found, widths, strict=True):
            row.add(error, tolerance[place], numbers, tuple(part.start for part in place))
    for row in found:
        if row.points:
            row.where = ", ".join(place_words(axes, row.index[: len(axes)])) or "the point"
    return found


def _tolerance(study: GridStudy) -> np.ndarray:
    """Tolerances that broadcast over the grid."""
    for further, values in enumerate(reversed(study.grid.values)):
        if TOLERANCE in values:
            return values[TOLERANCE].reshape(-1, *(1,) * further)
    return np.asarray(study.spec.accuracy.tolerance)


@dataclass(frozen=True, kw_only=True)
class Status:
    """State of a store."""

    store: Location
    title: str
    study_id: str
    unit: str  # what the points are called
    points: int
    points_done: int
    blocks: int
    blocks_done: int
    done: np.ndarray  # their numbers
    points_begun: float  # drawn in part, in blocks that take long
    failures: dict[int, dict[str, Any]]  # of blocks that are not done, by block
    holder: journal.Holder | None  # who writes to it
    holder_lives: bool
    draws_done: int  # where each point has a fixed number; else 0
    bytes: int  # of all results, as they were stored; of a packed copy all its files
    rate: float  # points a second in the last run, 0 where none committed anything
    workers: int  # processes that computed in the last run
    heartbeat: float  # age of its holder's last sign of life [s]; infinite without one

    @property
    def complete(self) -> bool:
        """Tell whether every block is committed."""
        return self.blocks_done == self.blocks

    @property
    def left(self) -> float:
        """Seconds that are left at the rate of the last run; infinite where there is none."""
        return (self.points - self.points_done) / self.rate if self.rate else float("inf")


def status(store: str | Location) -> Status:
    """State of a store, by its log of receipts; whether all chunks are there is not looked at."""
    path = located(store)
    attributes, study = studies.read(path)
    begun = journal.last_begun(path)
    receipts = read_receipts(path, study.n_blocks, since=begun)
    packed = sum(files_below(path).values()) if PACKED in attributes else 0
    holder = journal.holder(path)
    points = study.points_in(receipts.points > 0)
    spent = receipts.last - begun
    return Status(
        store=path,
        title=attributes.get("title", ""),
        study_id=attributes["study_id"],
        unit=study.unit,
        points=study.points,
        points_done=points,
        blocks=study.n_blocks,
        blocks_done=receipts.blocks,
        done=np.flatnonzero(receipts.points),
        points_begun=sum(begun_points(path, study.id).values()),
        failures=journal.given_up(path, study.n_blocks),
        holder=holder,
        holder_lives=holder is not None and journal.is_live(path, holder),
        draws_done=points * int(study.spec.draws.number) if isinstance(study, GridStudy) else 0,
        bytes=packed or int(receipts.sizes.sum()),
        rate=receipts.recent / spent if receipts.recent and spent > 0 else 0.0,
        workers=len(receipts.workers),
        heartbeat=journal.heartbeat_age(path) if holder else float("inf"),
    )
