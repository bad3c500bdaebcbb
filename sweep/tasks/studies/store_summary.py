"""Summaries of stores: stored blocks, detection, hits of a flight, errors against the tolerance.

StoreError is raised if there is no store of sweep at a path, or one of another kind.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model.error_budget import ErrorBudget
from sweep.model.outputs import PD_OUTPUT_NAMES
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.storage.locations import PACKED_ATTRIBUTE, Location, file_sizes_below, parse_location
from sweep.storage.store_format import read_receipt_totals
from sweep.storage.verified_store import open_verified_group
from sweep.tasks.engine import journal
from sweep.tasks.engine.block_study import BlockStudy
from sweep.tasks.engine.journal import read_checkpoint_point_counts, receipted_block_mask
from sweep.tasks.engine.progress import StoreError
from sweep.tasks.studies import study_loading
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.grid_study import (
    GridStudy,
    evaluate_points,
    limit_draws,
    select_parameters_of_points,
)
from sweep.tasks.studies.parameter_grid import TOLERANCE_PARAMETER

if TYPE_CHECKING:
    from sweep.spec import Axis

DETECTED_PD_MIN = 0.9
"""Probability of detection (pd) above which a point counts as detected."""

SUMMARY_ROWS_MAX = 10
"""Largest number of rows of the detection table, not counting the row for all points."""

SAMPLED_POINTS_MAX = 1 << 23
"""Largest number of a store's points that a summary reads; more points are sampled at random."""
SAMPLED_BLOCKS_MAX = 1000
"""Largest number of a store's blocks that a summary reads; more blocks are sampled at random."""

AXIS_POINTS_LISTED_MAX = 12
"""Largest number of points of a flight's axes for which a summary has a row per point."""


@dataclass(frozen=True)
class DetectionRow:
    """Detection in one part of a grid.

    Points that are not computed (NaN) do not count.
    """

    label: str
    """Values of the slowest axis in this part of the grid, as text."""
    n_points: int
    """Number of points that are computed in this part of the grid."""
    detected_fraction: float
    """Fraction of the row's points with pd_shot above `DETECTED_PD_MIN`."""
    median_pd_shot: float
    """Median of pd_shot, the probability of detection in both chirps, over the row's points."""
    median_pd_doppler: float
    """Median of pd_doppler over the row's points; nan without a Doppler segment."""

    @classmethod
    def from_points(cls, label: str, pd_shot: np.ndarray, pd_doppler: np.ndarray) -> DetectionRow:
        """Return the row that summarises `pd_shot` (n,) and `pd_doppler` (n,) of n points.

        ``pd_doppler`` is nan without a Doppler segment. Points that are not computed (nan) do not
        count.
        """
        is_computed = ~np.isnan(pd_shot)
        pd_shot, pd_doppler = (
            pd_shot[is_computed],
            pd_doppler[is_computed & np.isfinite(pd_doppler)],
        )
        if not pd_shot.size:
            return cls(label, 0, float("nan"), float("nan"), float("nan"))
        median_doppler = float(np.median(pd_doppler)) if pd_doppler.size else float("nan")
        detected_fraction = float(np.mean(pd_shot > DETECTED_PD_MIN))
        return cls(
            label, pd_shot.size, detected_fraction, float(np.median(pd_shot)), median_doppler
        )


class DetectionSummary(NamedTuple):
    """Detection along the slowest axis of a grid, and in the whole grid."""

    axis_heading: str
    """Name and units of the slowest axis; '' for a grid without axes."""
    rows: list[DetectionRow]
    """Rows for the parts of the slowest axis, and a last row for the entire grid."""
    sampled_block_fraction: float
    """Fraction of the stored blocks that were read for the summary."""


def detection_summary(store: str | Location) -> DetectionSummary:
    """Return a summary of detection in the stored blocks of a grid study.

    If there are many blocks, a random sample of them is summarised.
    """
    store_path = parse_location(store)
    study = study_loading.read_study_and_check_blocks(store_path).study
    if not isinstance(study, GridStudy):
        raise StoreError(f"{store_path} holds no study over a grid")
    sample = _sample_blocks(store_path, study, None)
    axis = study.spec.axes[0] if study.spec.axes else None
    n_values = (
        axis.size if axis else 1
    )  # one part per value, or per several values if there are many
    part_edges = np.linspace(0, n_values, min(n_values, SUMMARY_ROWS_MAX) + 1).astype(int)
    values_by_part: list[list[np.ndarray]] = [[np.empty((2, 0))] for _ in part_edges[1:]]
    for region, values in iter_block_values(
        store_path, study, ("pd_shot", "pd_doppler"), sample.block_numbers
    ):
        pd_pair = np.stack(values).reshape(2, -1, *values[0].shape[1:])
        axis_indices = np.arange(pd_pair.shape[1]) + (region[0].start if region else 0)
        for part_values, (first, stop) in zip(values_by_part, pairwise(part_edges), strict=True):
            part_values.append(
                pd_pair[:, (first <= axis_indices) & (axis_indices < stop)].reshape(2, -1)
            )
    pd_by_part = [np.concatenate(values_of_part, axis=1) for values_of_part in values_by_part]
    total_row = DetectionRow.from_points("all", *np.concatenate(pd_by_part, axis=1))
    if axis is None:
        return DetectionSummary("", [total_row], sample.sampled_block_fraction)
    labels = [_axis_range_label(axis, first, stop) for first, stop in pairwise(part_edges)]
    rows = [
        DetectionRow.from_points(label, *values)
        for label, values in zip(labels, pd_by_part, strict=True)
    ]
    units = axis.parameters[0].units if len(axis.parameters) == 1 else ""
    heading = f"{axis.name} [{units}]" if units else axis.name
    return DetectionSummary(heading, [*rows, total_row], sample.sampled_block_fraction)


class UnsupportedPoints(NamedTuple):
    """Points in a sample of a store that the model does not support."""

    n_points: int
    """Number of points in the sample that the model does not support."""
    first_reason: str
    """Reason why the model does not support the first of the unsupported points; '' without any."""


def count_unsupported_points(
    store: str | Location, done_block_numbers: np.ndarray | None = None
) -> UnsupportedPoints:
    """Count the points in a sample of a store's blocks that the model does not support.

    Return the number, and the reason for the first of these points. A flight has no such points.
    """
    store_path = parse_location(store)
    study = study_loading.read_study_and_check_blocks(store_path).study
    if not isinstance(study, GridStudy):
        return UnsupportedPoints(0, "")
    blocks = _sample_blocks(store_path, study, done_block_numbers).block_numbers
    n_unsupported, first_reason = 0, ""
    for block, (_, (pd_shot,)) in zip(
        blocks, iter_block_values(store_path, study, ("pd_shot",), blocks), strict=True
    ):
        points = np.flatnonzero(np.isnan(pd_shot))
        if points.size and not n_unsupported:
            first_reason = unsupported_reason(study, int(block), points[:1])
        n_unsupported += points.size
    return UnsupportedPoints(n_unsupported, first_reason)


def unsupported_reason(study: GridStudy, block: int, local_index: np.ndarray) -> str:
    """Return the reason why the model does not support one point of a block, as text.

    `local_index` (1,) is the index of the point in the block.
    """
    ((_, effects),) = (
        study.effect_planner.select_for_block(block).subset(local_index).iter_groups_by_effects()
    )
    try:
        parameters = select_parameters_of_points(study.grid.parameters_of_block(block), local_index)
        evaluate_points(limit_draws(study.spec, 1), parameters, 1, effects)
    except UnsupportedShotError as error:
        return str(error)
    return "it is not any more"


class _BlockSample(NamedTuple):
    """Random sample of the stored blocks."""

    block_numbers: np.ndarray
    """Numbers (m,) of the sampled blocks, in rising order."""
    sampled_block_fraction: float
    """Fraction of the stored blocks that are in the sample."""


def _sample_blocks(
    store: Location, study: BlockStudy, done_block_numbers: np.ndarray | None
) -> _BlockSample:
    """Return a random sample of the stored blocks, and the fraction that the sample has of them.

    Equal calls give equal samples. `done_block_numbers` are the stored blocks; by default those
    with a receipt.
    """
    done_block_numbers = (
        np.flatnonzero(receipted_block_mask(store, study))
        if done_block_numbers is None
        else done_block_numbers
    )
    n_sampled = min(
        SAMPLED_BLOCKS_MAX, max(SAMPLED_POINTS_MAX * study.n_blocks // study.n_points, 1)
    )
    if len(done_block_numbers) <= n_sampled:
        return _BlockSample(done_block_numbers, 1.0)
    blocks = np.random.default_rng(0).choice(done_block_numbers, n_sampled, replace=False)
    return _BlockSample(np.sort(blocks), n_sampled / len(done_block_numbers))


def _axis_range_label(axis: Axis, start: int, end: int) -> str:
    """Return the values of an axis from index `start` to index `end` - 1 as text.

    Indices take the place of values if the axis sets several parameters.
    """
    values = range(axis.size) if len(axis.parameters) > 1 else axis.parameters[0].display_values
    return "..".join(dict.fromkeys([_format_value(values[start]), _format_value(values[end - 1])]))


def _format_value(value: object) -> str:
    """Return a value of an axis as text, numbers with four digits or more."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e6 else f"{value:.4g}"


class BlockValues(NamedTuple):
    """Values that a block wrote in some arrays with equal chunks."""

    region: tuple[slice, ...]
    """Slices of the arrays that the block covers, one slice per dimension."""
    values: list[np.ndarray]
    """Values in these slices, one array for each array name."""


def iter_block_values(
    store: Location, study: BlockStudy, array_names: Sequence[str], blocks: np.ndarray
) -> Iterator[BlockValues]:
    """Yield, for each of `blocks`, the slices that the block covers in arrays, and its values.

    `array_names` are arrays with equal chunks. A block without a chunk in them is left out.
    """
    group = open_verified_group(store)
    arrays: list[Any] = [group[array_name] for array_name in array_names]
    for block in blocks:
        if (region := study.chunk_regions_of_block(int(block)).get(array_names[0])) is not None:
            yield BlockValues(region, [np.asarray(array[region or ...]) for array in arrays])


@dataclass
class ScannerRow:
    """Numbers of true and false points of one scanner, at one point of the axes or at all of them.

    Only stored blocks count.
    """

    label: str
    """Name of the scanner, and values of the axes at the row's point, as text."""
    n_drawn_shots: int = 0
    """Number of shots times number of draws."""
    n_shots_with_true_return: int = 0
    """Number of shots with at least one true return, summed over draws."""
    n_false_points: int = 0
    """Number of points of the point clouds that are no true returns, summed over draws."""
    n_drawn_cycles: int = 0
    """Number of measurement cycles times number of draws; 0 if a cycle has too few shots.

    A cycle needs enough shots to compute a velocity vector.
    """
    n_solved_cycles: int = 0
    """Number of measurement cycles with a velocity vector, summed over draws."""
    pd_of_shots_by_block: list[np.ndarray] = field(default_factory=list, repr=False)
    """Probabilities of detection of the shots that hit something: one array for each block."""

    @property
    def mean_pd(self) -> float:
        """Mean probability of detection of the shots that hit something; nan if none does."""
        all_pd = np.concatenate([*self.pd_of_shots_by_block, np.empty(0)])
        return float(all_pd.mean()) if all_pd.size else float("nan")

    def add_block(self, block_arrays: Mapping[str, np.ndarray]) -> None:
        """Add the counts of a block to this row, in place.

        `block_arrays` are the block's values by array name.
        """
        from sweep.model.pointcloud.navigation import STATUS_EXCLUDED
        from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG

        point_flags = block_arrays["flags"]
        self.n_drawn_shots += point_flags[..., 0].size
        self.n_shots_with_true_return += int(
            ((point_flags & TRUE_RETURN_FLAG) > 0).any(axis=-1).sum()
        )
        self.n_false_points += int(
            ((point_flags > 0) & ((point_flags & TRUE_RETURN_FLAG) == 0)).sum()
        )
        if "pd_shot" in block_arrays:  # only blocks of the first draws have it
            self.pd_of_shots_by_block.append(
                block_arrays["pd_shot"][np.isfinite(block_arrays["pd_shot"])]
            )
        if "velocity_status" in block_arrays:
            status = block_arrays["velocity_status"]
            self.n_drawn_cycles += status.size
            self.n_solved_cycles += int((status <= STATUS_EXCLUDED).sum())


def flight_summary(store: str | Location) -> list[ScannerRow]:
    """Return a row of counts for each scanner and each point of a flight's axes.

    If there are more than `AXIS_POINTS_LISTED_MAX` points, each scanner has one row for all of
    them.
    """
    store_path = parse_location(store)
    study = study_loading.read_study_and_check_blocks(store_path).study
    if not isinstance(study, FlightStudy):
        raise StoreError(f"{store_path} holds no study of a scene")
    axis_points = list(np.ndindex(tuple(int(axis.size) for axis in study.spec.axes)))
    is_listed_by_axis_point = len(axis_points) <= AXIS_POINTS_LISTED_MAX
    rows = {
        (scanner, axis_point): ScannerRow(
            ", ".join([scanner, *axis_value_labels(study.spec.axes, axis_point)])
        )
        for scanner in study.scanner_grids
        for axis_point in (axis_points if is_listed_by_axis_point else [()])
    }
    group: Any = open_verified_group(store_path)
    for block in np.flatnonzero(receipted_block_mask(store_path, study)).tolist():
        flight_block = study.locate_flight_block(block).flight_block
        regions = study.chunk_regions_of_block(block)
        names = (
            f"{flight_block.scanner}/{name}" for name in ("flags", "pd_shot", "velocity_status")
        )
        block_arrays = {
            name.rpartition("/")[2]: np.asarray(group[name][regions[name]])
            for name in names
            if name in regions
        }
        rows[
            flight_block.scanner, flight_block.axis_indices if is_listed_by_axis_point else ()
        ].add_block(block_arrays)
    return list(rows.values())


def axis_value_labels(axes: Sequence[Axis], axis_point: tuple[int, ...]) -> list[str]:
    """Return the values at a point of the axes as texts, such as 'range 500 m'.

    `axis_point` are the indices of the point. The last axes are left out if it has fewer indices
    than there are axes.
    """
    return [
        f"{member.coordinate_name} "
        f"{_format_value(member.display_values[index])}{' ' * bool(member.units)}{member.units}"
        for axis, index in zip(axes, axis_point, strict=False)
        for member in axis.parameters
    ]


@dataclass
class AccuracyRow:
    """Summary of the errors at many points, compared with the tolerance at each point.

    The errors are statistical errors of a probability of detection, or errors by the finite number
    of rays.
    """

    name: str
    """Name of the probability, or of the scanner; empty for the beamlets of a grid."""
    n_points: int = 0
    """Number of points with a known error; in a flight, shots count at each point of the axes."""
    n_points_within_tolerance: int = 0
    """Number of points whose error is within the tolerance."""
    worst_error: float = math.nan
    """Half-width of the error at the worst point, at which error less tolerance is largest."""
    tolerance_at_worst_point: float = math.nan
    """Tolerance of the error at the worst point."""
    worst_point_label: str = ""
    """Values of the axes at the worst point, as text."""
    n_samples_at_worst_point: int = 0
    """Number of draws, or of rays, at the worst point."""
    n_total_samples: int = 0
    """Number of draws, or of rays, at all points together."""
    largest_n_samples: int = 0
    """Largest number of draws, or of rays, of any point."""
    worst_point_index: tuple[int, ...] = ()
    """Indices of the worst point in the stored array of errors, one per dimension."""
    sampled_block_fraction: float = 1.0
    """Fraction of the stored blocks that were read for this row."""
    _worst_excess: float = -math.inf

    @property
    def excess_over_tolerance(self) -> float:
        """Error less tolerance at the worst point; 0 if the error is within the tolerance."""
        return max(0.0, self.worst_error - self.tolerance_at_worst_point)

    @property
    def mean_n_samples(self) -> float:
        """Mean number of draws or rays per point."""
        return self.n_total_samples / max(self.n_points, 1)

    @property
    def n_draws_needed(self) -> float:
        """Approximate number of draws that would meet the tolerance at the worst point.

        It is nan if the tolerance is met already, and inf if the tolerance is 0.
        """
        if not self.excess_over_tolerance:
            return math.nan
        if not self.tolerance_at_worst_point:
            return math.inf
        return math.ceil(
            self.n_samples_at_worst_point * (self.worst_error / self.tolerance_at_worst_point) ** 2
        )

    def add_points(
        self,
        errors: np.ndarray,
        tolerances: np.ndarray,
        samples: np.ndarray,
        start_index: tuple[int, ...],
    ) -> None:
        """Add points to the counts of this row in place, and keep the worst point.

        Points of unknown (nan) error are not counted. ``start_index`` is the index of the first
        point in the stored array of errors. ``samples`` are numbers of draws or rays.
        """
        is_known = np.isfinite(errors)
        samples = np.where(is_known, np.nan_to_num(samples), 0)
        excess = np.where(is_known, errors - tolerances, -np.inf)
        self.n_points += int(is_known.sum())
        self.n_points_within_tolerance += int((excess <= 0).sum() - (~is_known).sum())
        self.n_total_samples += int(samples.sum())
        self.largest_n_samples = max(self.largest_n_samples, int(samples.max(initial=0)))
        worst = np.unravel_index(np.argmax(excess), excess.shape)
        if excess[worst] > self._worst_excess:
            self._worst_excess, self.worst_error = float(excess[worst]), float(errors[worst])
            self.tolerance_at_worst_point, self.n_samples_at_worst_point = (
                float(tolerances[worst]),
                int(samples[worst]),
            )
            self.worst_point_index = tuple(
                offset + int(i) for offset, i in zip(start_index, worst, strict=True)
            )


def accuracy_rows_of_draws(
    store: str | Location, done_block_numbers: np.ndarray | None = None
) -> list[AccuracyRow]:
    """Return a row for each probability of detection with its statistical errors.

    The list is empty for a study without draws or results.
    """
    store_path = parse_location(store)
    study = study_loading.read_study_and_check_blocks(store_path).study
    if not isinstance(study, GridStudy) or not study.spec.draws.has_draws:
        return []
    error_arrays = {name: f"{name}_half_width" for name in PD_OUTPUT_NAMES}
    return [
        row
        for row in _accuracy_rows(
            store_path,
            study,
            done_block_numbers,
            error_arrays,
            "n_draws",
            _tolerance_over_grid(study),
        )
        if row.n_points
    ]


def accuracy_rows_of_rays(
    store: str | Location, done_block_numbers: np.ndarray | None = None
) -> list[AccuracyRow]:
    """Return a row for each scanner with the errors by its finite number of rays.

    For a grid, the list has one row if the largest number of beamlets does not suffice, and is
    empty otherwise.
    """
    store_path = parse_location(store)
    study = study_loading.read_study_and_check_blocks(store_path).study
    if isinstance(study, GridStudy):
        tolerance_limit = np.maximum(
            ErrorBudget(_tolerance_over_grid(study)).allowed_beamlets_error,
            ErrorBudget.rays_tolerance_min,
        )
        rows = _accuracy_rows(
            store_path,
            study,
            done_block_numbers,
            {"": "beamlets_error"},
            "beamlets",
            tolerance_limit,
        )
        return [row for row in rows if row.excess_over_tolerance]
    if not isinstance(study, FlightStudy) or not study.spec.is_ray_number_set_by_tolerance:
        return []
    reported_rows, group = [], open_verified_group(store_path)
    for name in study.scanner_grids:
        error_arrays, tolerance = {name: f"{name}/beamlets_error"}, study.spec.accuracy.tolerance
        for row in _accuracy_rows(
            store_path,
            study,
            done_block_numbers,
            error_arrays,
            f"{name}/beamlets",
            np.asarray(tolerance),
        ):
            if row.n_points:
                shot_times: Any = group[f"{name}/time"]
                time_label = (
                    f"time {float(np.asarray(shot_times[row.worst_point_index[-1]])):.4g} s"
                )
                row.worst_point_label = (
                    f"{row.worst_point_label}, {time_label}" if study.spec.axes else time_label
                )
                reported_rows.append(row)
    return reported_rows


def _accuracy_rows(
    store_path: Location,
    study: GridStudy | FlightStudy,
    done_block_numbers: np.ndarray | None,
    error_arrays: Mapping[str, str],
    samples_array: str,
    tolerance: np.ndarray,
) -> list[AccuracyRow]:
    """Return a row for each array of errors in a store.

    ``error_arrays`` maps names of rows to names of these arrays. ``samples_array`` is the name of
    the array with the numbers of draws or rays.
    """
    sample, axes = _sample_blocks(store_path, study, done_block_numbers), study.spec.axes
    rows = [
        AccuracyRow(name, sampled_block_fraction=sample.sampled_block_fraction)
        for name in error_arrays
    ]
    tolerance = np.broadcast_to(tolerance, study.output_layout_by_name[samples_array].shape)
    for region, (samples, *error_values) in iter_block_values(
        store_path, study, [samples_array, *error_arrays.values()], sample.block_numbers
    ):
        for row, errors in zip(rows, error_values, strict=True):
            row.add_points(errors, tolerance[region], samples, tuple(part.start for part in region))
    for row in rows:
        if row.n_points:
            row.worst_point_label = (
                ", ".join(axis_value_labels(axes, row.worst_point_index[: len(axes)]))
                or "the point"
            )
    return rows


def _tolerance_over_grid(study: GridStudy) -> np.ndarray:
    """Return the tolerance at each point of a grid, in a shape that broadcasts over the grid."""
    for n_trailing_axes, values in enumerate(reversed(study.grid.values_by_axis)):
        if TOLERANCE_PARAMETER in values:
            return values[TOLERANCE_PARAMETER].reshape(-1, *(1,) * n_trailing_axes)
    return np.asarray(study.spec.accuracy.tolerance)


@dataclass(frozen=True, kw_only=True)
class Status:
    """State of a store: points and blocks done, failures, lock, and speed of the last run."""

    store: Location
    title: str
    study_id: str
    points_noun: str  # name of the points, in the plural
    points: int
    points_done: int
    blocks: int
    blocks_done: int
    done_block_numbers: np.ndarray  # int: block numbers of the blocks that are done, rising
    points_in_unfinished_blocks: float  # number of points done in unfinished blocks
    failures: dict[int, dict[str, Any]]  # last failure by block that is not done
    lock_holder: journal.LockHolder | None  # process that holds the lock
    is_lock_holder_alive: bool
    draws_done: int  # number of draws done, of all points; 0 if the number varies by point
    bytes_stored: int  # size of all results as stored, or of all files of a packed copy
    points_per_second: float  # points per second in the last run; 0 if it committed nothing
    workers_in_last_run: int  # number of processes that computed in the last run
    threads_in_last_run: int  # number of threads of the command that computed; 0 if workers did
    heartbeat_age: float  # age of the last heartbeat of the lock [s]; inf without one

    @property
    def complete(self) -> bool:
        """True if every block of the study is committed."""
        return self.blocks_done == self.blocks

    @property
    def seconds_left(self) -> float:
        """Estimated time to compute the missing points [s], at the speed of the last run.

        It is inf if the last run committed nothing.
        """
        return (
            (self.points - self.points_done) / self.points_per_second
            if self.points_per_second
            else float("inf")
        )


def status(store: str | Location) -> Status:
    """Return the state of a store from its logs, without checking that its chunks exist.

    Parameters
    ----------
    store
        Path of a store: on disk, or `s3://bucket/key.zarr` (gs, az).

    Returns
    -------
    Status
        Points and blocks done, failures, the holder of the lock, and the rate of the last run.

    Raises
    ------
    StoreError
        If there is no store of sweep, or if its study can't be read.

    Examples
    --------
    >>> import sweep
    >>> outcome = sweep.run(sweep.load("study.yaml"), store="asked.zarr", progress=False)
    >>> status = sweep.status("asked.zarr")
    >>> status.points_done, status.points
    (4, 4)
    """
    store_path = parse_location(store)
    attributes, study = study_loading.read_study_and_check_blocks(store_path)
    last_run = journal.read_last_run(store_path)
    receipts = read_receipt_totals(store_path, study.n_blocks, since=last_run.start_time)
    packed_bytes = (
        sum(file_sizes_below(store_path).values()) if PACKED_ATTRIBUTE in attributes else 0
    )
    holder = journal.read_lock_holder(store_path)
    points_done = study.count_points_in_blocks(receipts.points_by_block > 0)
    run_seconds = receipts.last_receipt_time - last_run.start_time
    return Status(
        store=store_path,
        title=attributes.get("title", ""),
        study_id=attributes["study_id"],
        points_noun=study.points_noun,
        points=study.n_points,
        points_done=points_done,
        blocks=study.n_blocks,
        blocks_done=receipts.n_committed_blocks,
        done_block_numbers=np.flatnonzero(receipts.points_by_block),
        points_in_unfinished_blocks=sum(
            read_checkpoint_point_counts(store_path, study.id).values()
        ),
        failures=journal.read_permanent_failures(store_path, study.n_blocks),
        lock_holder=holder,
        is_lock_holder_alive=holder is not None and journal.is_holder_alive(store_path, holder),
        draws_done=points_done * int(study.spec.draws.number)
        if isinstance(study, GridStudy)
        else 0,
        bytes_stored=packed_bytes or int(receipts.bytes_by_block.sum()),
        points_per_second=receipts.n_recent_points / run_seconds
        if receipts.n_recent_points and run_seconds > 0
        else 0.0,
        workers_in_last_run=len(receipts.recent_workers),
        threads_in_last_run=last_run.n_threads,
        heartbeat_age=journal.heartbeat_age(store_path) if holder else float("inf"),
    )
