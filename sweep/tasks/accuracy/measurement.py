"""Measurement of the cost of accuracy: error and computing time of each setting on sampled points.

The results are stored in a store of their own.
"""

from __future__ import annotations

import math
import tempfile
import time
import timeit
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from sweep.messages import option_name, option_text
from sweep.model import MODEL_VERSION
from sweep.spec import GridSpec, SceneSpec
from sweep.storage import store_format
from sweep.storage.accuracy_setting_kinds import (
    ADAPTIVE_KIND,
    ALL_EFFECTS_KIND,
    REFERENCE_KIND,
    THESIS_METHOD_KIND,
)
from sweep.storage.locations import Location, can_create_store, resolve_links
from sweep.tasks.accuracy.settings import (
    AccuracySetting,
    SettingLadder,
    add_settings_for_effect_sets,
    build_setting_ladder,
)
from sweep.tasks.accuracy.study_sample import (
    FlightSample,
    GridSample,
    SampleResults,
    StudySample,
    Trial,
    halton_sample,
    merge_trials,
)
from sweep.tasks.engine import study_store
from sweep.tasks.engine.block_study import BlockStudy
from sweep.tasks.engine.blocks import ArrayLayout
from sweep.tasks.engine.interrupts import InterruptHandler
from sweep.tasks.engine.progress import (
    Progress,
    RunRequestError,
    StoreError,
    make_progress,
    show_activity,
)
from sweep.tasks.studies.output_layouts import cf_attributes
from sweep.tasks.studies.study_loading import make_study

DEFAULT_SAMPLE_POINTS, DEFAULT_TIME_LIMIT_SECONDS = 200, 60.0
"""Defaults of `measure_accuracy`: number of sampled points, and time limit of the measurement [s].
"""

ROUNDS_MAX = 27
"""Largest number of rounds.

In each round every setting is timed once on every part of the sample.
"""

TRIAL_TIME_FRACTION = 0.003
"""Target duration of one trial of a setting, as a fraction of the measurement's time limit."""

TIMED_SEQUENCE_TIME_FACTOR = 2
"""Target duration of computing the sequence of points on which a setting is timed.

The unit is the target duration of a trial.
"""

FIRST_TIMED_SEQUENCE_SHORTENING_FACTOR = 8
"""Factor by which the first timed sequence of points is shorter than the longest one.

The first sequences only show which settings are slow.
"""

FIRST_ROUND_TIME_FRACTION, TIME_DOMAIN_TIME_FRACTION = 0.6, 0.8
"""Fractions of the time limit within which two stages are to end.

The first is for the first round of trials, the second for the comparison with the time domain.
"""

TIME_DOMAIN_POINTS_MIN, TIME_DOMAIN_POINTS_MAX = 3, 500
"""Least and largest number of points that are also simulated in the time domain.

The least number of points is simulated even if the time limit is exceeded.
"""

TIME_DOMAIN_BEAMLET_COUNT = 109
"""Number of beamlets (rays of a beam) in the time-domain simulation.

It replaces the number that the reference setting states, if any. The number is small because each
beamlet needs a separate time-domain record.
"""

REPEATED_TRIAL_SECONDS_MAX = 1.0
"""Duration of a setting's trial [s] above which the setting is tried in the first round only."""

FIXED_EFFECTS_TOLERANCES = (1e-1, 1e-3, 1e-6)
"""Tolerances from which settings with fixed effects are made.

A setting with fixed effects simulates, at every point, all effects that the tolerance requires at
any point of the sample.
"""

STORING_TIME_REPEATS = 3
"""Number of times that each step of storing is timed.

The first time may be longer, because modules are imported and files opened.
"""


def measure_accuracy(
    spec: GridSpec | SceneSpec,
    *,
    store_path: Location,
    n_points: int = DEFAULT_SAMPLE_POINTS,
    time_limit: float = DEFAULT_TIME_LIMIT_SECONDS,
    overwrite: bool = False,
    progress: bool | Progress = True,
) -> bool:
    """Try a ladder of settings on a sample of a study's points, and store errors and times.

    Parameters
    ----------
    spec
        Study without whole spectra.
    store_path
        Path of the store of the results, which is written completely, or not at all.
    n_points
        Number of points of the sample.
    time_limit
        Approximate time of the trials [s].
    overwrite
        Whether to replace earlier results at the path.
    progress
        True for a bar or lines on standard error, False for none, or a `Progress`.

    Returns
    -------
    bool
        False, without a store, if the measurement is interrupted before any point is complete.

    Raises
    ------
    StoreError
        If a store is in the way or can't be written.
    RunRequestError
        If the study draws whole spectra.
    SceneError
        If a file of a scene is missing, changed or invalid.
    """
    if spec.draws.draws_whole_spectra:
        raise RunRequestError(
            "this study draws whole spectra, which have no settings to try: "
            "leave out draws.method, detector and estimator"
        )
    store_path = resolve_links(store_path)
    _refuse_occupied_path(store_path, overwrite)
    listener = make_progress(progress)
    with InterruptHandler(listener) as interrupts:
        with show_activity("choosing points", listener):
            sample = (
                FlightSample(spec, n_points)
                if isinstance(spec, SceneSpec)
                else GridSample(spec, n_points)
            )
        try:
            measured_template = AccuracyMeasurement(
                sample, time_limit=time_limit, progress=listener, interrupts=interrupts
            ).run()
        except NoMeasurementError:
            return False
    measured_template.storing_seconds = measure_storing_seconds(make_study(spec, store_path))
    _refuse_occupied_path(store_path, overwrite)  # another process may have written to it
    study_store.create_store(store_path, measured_template, replace_existing=overwrite)
    return True


def _refuse_occupied_path(store_path: Location, overwrite: bool) -> None:
    """Raise a StoreError unless the path is free or holds an accuracy store to overwrite."""
    if can_create_store(store_path):
        return
    if store_format.read_attributes(store_path)["kind"] != store_format.ACCURACY_STORE_KIND:
        raise StoreError(
            f"{store_path} holds a study's results: name another {option_name('store')}"
        )
    if not overwrite:
        raise StoreError(f"{store_path} is there already: {option_text('overwrite')} measures anew")
    study_store.refuse_irreplaceable_store(store_path)
    study_store.refuse_foreign_files(store_path)


def measure_storing_seconds(study: BlockStudy) -> float:
    """Return the processor time [s] that creating a study's store and writing its blocks takes."""
    block = study.n_blocks // 2
    results = {
        name: np.zeros(
            [region_slice.stop - region_slice.start for region_slice in region],
            study.output_layout_by_name[name].dtype,
        )
        for name, region in study.chunk_regions_of_block(block).items()
    }
    time_trials = partial(timeit.repeat, timer=process_time, repeat=STORING_TIME_REPEATS, number=1)
    with tempfile.TemporaryDirectory() as folder:
        store_path = Path(folder) / "study.zarr"

        def create_store() -> None:
            if store_path.exists():
                study_store.remove_store(store_path)
            study_store.create_store(store_path, study)

        creation_seconds = min(time_trials(create_store))
        writer = study_store.BlockWriter(store_path, study)
        return creation_seconds + study.n_blocks * min(
            time_trials(partial(writer.write, block, results))
        )


class NoMeasurementError(Exception):
    """Exception raised if the measurement is interrupted before any point has all its results."""


class AccuracyMeasurement:
    """Measurement of the error and computing time of accuracy settings on a sample of points.

    All settings are tried in turn, so that drifts of the machine's speed affect all alike. Each
    round has a different order of settings, because a short trial takes longer after a long one.
    All rounds together take about `time_limit` [s].
    """

    def __init__(
        self,
        sample: StudySample,
        *,
        time_limit: float,
        progress: Progress,
        interrupts: InterruptHandler,
    ) -> None:
        self._sample, self._time_limit = sample, time_limit
        self._progress, self._interrupts = progress, interrupts
        self._setting_ladder = add_settings_with_fixed_effects(
            build_setting_ladder(sample.spec), sample
        )
        self._settings = self._setting_ladder.settings
        self._n_timed_points = np.ones(len(self._settings), np.int64)
        self._is_tried_once = np.zeros(len(self._settings), bool)
        self._order_generator = np.random.default_rng(0)

    def run(self) -> AccuracyStoreTemplate:
        """Run as many rounds as the time limit allows. Return the content of the store.

        NoMeasurementError is raised if the run is interrupted before any point is complete.
        """
        n_settings = len(self._settings)
        self._progress.say(
            f"trying {n_settings} settings on {self._sample.size:,} {self._sample.points_noun}"
        )
        with show_activity("looking how long settings take", self._progress):
            parts = self._sample.split_into_parts(self._points_per_part())
            n_rounds = self._plan_rounds(parts)
        self._progress.begin(points=n_settings * len(parts) * n_rounds, done=0, unit="trials")
        try:
            return self._run_rounds(parts, n_rounds)
        finally:
            self._progress.end()

    def _run_rounds(self, parts: list[np.ndarray], n_rounds: int) -> AccuracyStoreTemplate:
        """Run all rounds of trials, with the time-domain comparison after the first one.

        Return the content of the store.
        """
        first_round = self._run_round(parts, time_fraction=FIRST_ROUND_TIME_FRACTION)
        stop_reason = StopReason.NONE
        if not first_round:
            raise NoMeasurementError
        if len(first_round) < len(parts):
            stop_reason = (
                StopReason.INTERRUPTED if self._interrupts.is_stopping else StopReason.TIME_LIMIT
            )
        parts = parts[: len(first_round)]
        sample_rows = np.concatenate(parts)
        time_domain_differences, n_beamlets = self._compare_with_time_domain(sample_rows)
        finished_rounds = [first_round]
        while len(finished_rounds) < n_rounds and len(finished_rounds[-1]) == len(parts):
            finished_rounds.append(
                self._run_round(parts, time_fraction=1.0, first_round=first_round)
            )
        complete_rounds = [
            trials_of_round
            for trials_of_round in finished_rounds
            if len(trials_of_round) == len(parts)
        ]
        trials = [
            [merge_trials(trials_of_round) for trials_of_round in zip(*parts, strict=True)]
            for parts in complete_rounds
        ]
        return AccuracyStoreTemplate(
            self._sample,
            self._setting_ladder,
            sample_rows,
            trials,
            self._n_timed_points,
            time_domain_differences,
            n_beamlets,
            stop_reason,
        )

    def _points_per_part(self) -> int:
        """Return the number of points in each part of the sample.

        All settings are tried on one part before the next part begins. Parts are so small that the
        time limit suffices for at least two.
        """
        setting_numbers, first_part = (
            range(len(self._settings)),
            self._sample.split_into_parts(1)[0],
        )
        for setting_number in setting_numbers:  # compiles kernels, which does not count
            self._measure_trial_seconds(setting_number, first_part)
        self._start = time.monotonic()
        seconds_per_round = sum(
            self._measure_trial_seconds(setting_number, first_part)
            for setting_number in setting_numbers
        )
        points_that_fit = (
            (FIRST_ROUND_TIME_FRACTION * self._time_limit - self._elapsed_seconds)
            * len(first_part)
            / seconds_per_round
        )
        # After an interruption complete parts are kept. One more part is tried before the rounds.
        parts_min = max(2, len(self._sample.split_into_parts(self._sample.size)))
        return max(1, min(self._sample.size // parts_min, int(points_that_fit / (parts_min + 1))))

    def _plan_rounds(self, parts: list[np.ndarray]) -> int:
        """Return the number of rounds that the time limit allows.

        Also set, for each setting, how many points are timed per trial.
        """
        n_points, trial_seconds = 1, TRIAL_TIME_FRACTION * self._time_limit
        while (
            self._measure_trial_seconds(0, parts[0]) < trial_seconds / 2
            and n_points < self._sample.timed_points_max
        ):
            n_points = min(2 * n_points, self._sample.timed_points_max)
            self._n_timed_points[0] = n_points
        n_points_first = max(1, n_points // FIRST_TIMED_SEQUENCE_SHORTENING_FACTOR)
        self._n_timed_points[:] = n_points_first
        first_seconds = np.array(
            [
                self._measure_trial_seconds(setting_number, parts[0])
                for setting_number in range(len(self._settings))
            ]
        )
        points_that_fit = (
            TIMED_SEQUENCE_TIME_FACTOR * trial_seconds * n_points_first / first_seconds
        )
        self._n_timed_points[:] = np.exp2(np.floor(np.log2(points_that_fit))).clip(1, n_points)
        seconds_per_setting = first_seconds * self._n_timed_points / n_points_first
        self._is_tried_once = seconds_per_setting > REPEATED_TRIAL_SECONDS_MAX
        seconds_left = 0.75 * (self._time_limit - self._elapsed_seconds) / len(parts)
        seconds_after_truth = (1 - TIME_DOMAIN_TIME_FRACTION) * self._time_limit / len(parts)
        repeated_seconds = max(float(seconds_per_setting[~self._is_tried_once].sum()), 1e-9)
        extra_rounds = (
            max(seconds_left - float(seconds_per_setting.sum()), seconds_after_truth)
            / repeated_seconds
        )
        return 1 + max(0, min(ROUNDS_MAX - 1, int(extra_rounds)))

    @property
    def _elapsed_seconds(self) -> float:
        """Wall time since the start of the trials [s]."""
        return time.monotonic() - self._start

    def _measure_trial_seconds(self, setting_number: int, part: np.ndarray) -> float:
        """Compute a part of the sample with one setting. Return the wall time that it took [s]."""
        start = time.monotonic()
        if self._interrupts.is_stopping:
            raise NoMeasurementError
        self._try_setting(setting_number, part)
        self._sample.clear_caches()
        return time.monotonic() - start

    def _try_setting(self, setting_number: int, part: np.ndarray) -> Trial:
        """Compute a part of the sample with one setting. Return the trial with results and times.

        The processor time is measured on the number of points planned for this setting.
        """
        return self._sample.try_setting(
            self._settings[setting_number], part, int(self._n_timed_points[setting_number])
        )

    def _run_round(
        self,
        parts: list[np.ndarray],
        *,
        time_fraction: float,
        first_round: list[list[Trial]] | None = None,
    ) -> list[list[Trial]]:
        """Try every setting on each part of the sample, as far as the time allows.

        Slow settings are tried in the first round only. Return the trials by part and setting.
        """
        trials_by_part: list[list[Trial]] = []
        for part in parts:
            if trials_by_part and self._elapsed_seconds > time_fraction * self._time_limit:
                break
            trials = {}
            for setting_number in self._order_generator.permutation(len(self._settings)).tolist():
                if self._interrupts.is_stopping:
                    return trials_by_part
                if first_round is not None and self._is_tried_once[setting_number]:
                    trials[setting_number] = first_round[len(trials_by_part)][setting_number]
                else:
                    trials[setting_number] = self._try_setting(setting_number, part)
                self._progress.advance(points=1, failed=0)
            self._sample.clear_caches()
            trials_by_part.append(
                [trials[setting_number] for setting_number in range(len(self._settings))]
            )
        return trials_by_part

    def _compare_with_time_domain(
        self, sample_rows: np.ndarray
    ) -> tuple[dict[int, np.ndarray], int]:
        """Compare the most accurate setting, the reference, with time-domain records.

        The records are made at some of the points, as time allows. Return a mapping from the
        point's row in the sample to its differences, by :func:`result_differences`, and the number
        of beamlets used for both; 0 stands for the number that the reference setting states.
        """
        reference_setting, beamlets_field = self._setting_ladder.reference, "footprint.beamlets"
        differences: dict[int, np.ndarray] = {}
        n_beamlets = (
            TIME_DOMAIN_BEAMLET_COUNT if beamlets_field in reference_setting.overrides else 0
        )
        if n_beamlets:
            overrides = {**reference_setting.overrides, beamlets_field: n_beamlets}
            reference_setting = replace(
                reference_setting, name="in time", overrides=overrides, rays_error_max=0.0
            )
        for sample_row in sample_rows[
            halton_sample(sample_rows.shape, TIME_DOMAIN_POINTS_MAX)
        ].tolist():
            is_late = self._elapsed_seconds > TIME_DOMAIN_TIME_FRACTION * self._time_limit
            if self._interrupts.is_stopping or (
                is_late and len(differences) >= TIME_DOMAIN_POINTS_MIN
            ):
                break
            comparison = self._sample.compare_with_time_domain(reference_setting, sample_row)
            if np.isfinite(comparison.time_domain_results.pd).any():
                differences[sample_row] = np.concatenate(result_differences(*comparison))
        self._sample.clear_caches()
        return differences, n_beamlets


def add_settings_with_fixed_effects(
    setting_ladder: SettingLadder, sample: StudySample, tolerances: Iterable[float] = ()
) -> SettingLadder:
    """Return the ladder with added settings that simulate the same effects at every point.

    One set of effects is added for each tolerance in `FIXED_EFFECTS_TOLERANCES`.
    """
    if not any(setting.kind == ALL_EFFECTS_KIND for setting in setting_ladder.settings):
        return setting_ladder  # settings of draws have no such variants
    setting_by_tolerance = {
        tolerance_of_setting(setting): setting
        for setting in setting_ladder.settings
        if setting.kind == ADAPTIVE_KIND
    }
    effects_by_tolerance = {
        tolerance: sample.simulated_effects(setting_by_tolerance[tolerance])
        for tolerance in FIXED_EFFECTS_TOLERANCES
        if tolerance in setting_by_tolerance
    }
    sample.clear_caches()
    return add_settings_for_effect_sets(
        setting_ladder, sample.spec, effects_by_tolerance, tolerances
    )


ERROR_ARRAY_LONG_NAMES = {
    "pd_error": "largest error of a probability of detection, of segments and shot",
    "log10_pfa_error": "error of log10 of a probability of false alarm",
    "magnitude_error": "error of the magnitude of the peak bins, over it or sigma if larger",
    "leakage_error": "error of a probability of leakage, of the two chirps",
    "standard_error": "standard error that the setting itself tells, where it draws",
}
"""Long names of the arrays of errors in the store, which have one value per setting and point.

The first four are in the order of :func:`result_differences`.
"""

N_ERRORS_BOUNDED_BY_TOLERANCE = 3
"""Number of error arrays that the tolerance bounds, the first ones of `ERROR_ARRAY_LONG_NAMES`."""


def result_differences(results: SampleResults, reference: SampleResults) -> tuple[np.ndarray, ...]:
    """Return the largest differences, (n,) each, between two results at n points.

    The four arrays are for pd, log10 pfa, magnitudes of bins, and the probability of leakage peaks.
    Differences of magnitudes are relative to the reference's magnitude, or to the noise's standard
    deviation if that is larger.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        log10_pfa_difference = np.abs(results.log10_pfa - reference.log10_pfa)
        magnitude_scale = np.maximum(reference.magnitude, reference.noise_sigma[:, None])
        magnitude_difference = np.abs(results.magnitude - reference.magnitude) / magnitude_scale
    log10_pfa_difference = np.where(
        results.log10_pfa == reference.log10_pfa, 0.0, log10_pfa_difference
    )
    pd_difference = _probability_differences(results.pd, reference.pd)
    leakage_difference = _probability_differences(results.leakage, reference.leakage)
    return tuple(
        np.fmax.reduce(values, axis=1)
        for values in (
            pd_difference,
            log10_pfa_difference,
            magnitude_difference,
            leakage_difference,
        )
    )


def _probability_differences(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the absolute differences of two arrays of probabilities, as an array of their shape.

    A single nan counts as a probability of 0. The difference is nan where both are nan.
    """
    is_known = np.isfinite(first) | np.isfinite(second)
    return np.where(is_known, np.abs(np.nan_to_num(first) - np.nan_to_num(second)), np.nan)


class StopReason(StrEnum):
    """Reason why an accuracy measurement covers only a part of its sample."""

    NONE = ""
    """The sample is complete."""
    INTERRUPTED = "interrupted"
    """The user has interrupted the measurement."""
    TIME_LIMIT = "time limit"
    """The time for the measurement did not suffice."""


@dataclass
class AccuracyStoreTemplate:
    """Content of a store of `sweep accuracy`: errors and times of all settings.

    Errors are stored by setting and point, times by setting and round.
    """

    sample: StudySample
    """Sample of the study's points."""
    setting_ladder: SettingLadder
    """All settings that are compared; the reference, the most accurate one, is last."""
    sample_rows: np.ndarray
    """Indices, in the sample, of the points on which all settings were tried."""
    trials_by_round: list[list[Trial]]
    """Trials of the settings on the points of ``sample_rows``, by round and setting."""
    n_timed_points: np.ndarray
    """(settings,): number of points on which each setting is timed in one trial."""
    time_domain_differences: dict[int, np.ndarray]
    """Differences between the reference and the time domain, by :func:`result_differences`, at
    points given by their indices in the sample."""
    n_time_domain_beamlets: int
    """Number of beamlets in the comparison with the time domain; 0 stands for the number of the
    reference setting."""
    stop_reason: StopReason
    """Reason why not all points of the sample are complete; NONE if all are."""
    storing_seconds: float = math.nan
    """Processor time of creating the study's store and writing its blocks [s]."""

    @property
    def model_version(self) -> str:
        """Version of the simulation model with which the accuracy was measured."""
        return MODEL_VERSION

    @property
    def id(self) -> str:
        """Identifier (hash) of the study whose accuracy was measured."""
        return self.sample.spec.id

    def store_attributes(self) -> dict[str, Any]:
        """Return the root attributes: spec, reference setting, and totals of the measurement."""
        spec, settings_and_trials = (
            self.sample.spec,
            zip(self.setting_ladder.settings, self.trials_by_round[0], strict=True),
        )
        thesis_beamlets = [
            trial.results.n_beamlets
            for setting, trial in settings_and_trials
            if setting.kind == THESIS_METHOD_KIND
        ]
        attributes: dict[str, Any] = {
            "kind": store_format.ACCURACY_STORE_KIND,
            "title": spec.title,
            "question": "What does accuracy cost in time?",
            "spec": spec.to_json(),
            "reference": self.setting_ladder.reference_text,
            "unit": self.sample.points_noun,
            "points": len(self.sample_rows),
            "study_points": self.sample.n_study_points,
            "storing_seconds": self.storing_seconds,
            "notes": "\n".join(self.setting_ladder.notes),
            # 0 if the thesis's method was not tried, or nothing is hit
            "thesis_beamlets": int(
                np.nan_to_num(np.fmax.reduce(thesis_beamlets, axis=None, initial=0))
            ),
            "stopped": self.stop_reason.value,
            "coordinates": " ".join(["kind", *self.sample.point_coordinates()]),
            "truth_points": len(self.time_domain_differences),
        }
        if not self.time_domain_differences:
            return attributes
        pd, _, _, magnitude = np.fmax.reduce(list(self.time_domain_differences.values()))
        return attributes | {
            "truth_beamlets": self.n_time_domain_beamlets,
            "truth_pd_difference": float(pd),
            "truth_magnitude_difference": float(magnitude),
        }

    def group_attributes(self) -> dict[str, dict[str, Any]]:
        """Return an empty mapping, as the store has no groups of arrays below its root."""
        return {}

    def array_layouts(self) -> list[ArrayLayout]:
        """Return the layouts of all arrays of the store: coordinates, errors and times."""
        settings, results = (
            self.setting_ladder.settings,
            [trial.results for trial in self.trials_by_round[0]],
        )
        errors = [
            *zip(
                *(
                    result_differences(results_of_setting, results[-1])
                    for results_of_setting in results
                ),
                strict=True,
            )
        ]
        errors.append(tuple(results_of_setting.standard_error for results_of_setting in results))
        seconds = np.transpose(
            [
                [trial.seconds_per_point for trial in results_of_setting]
                for results_of_setting in self.trials_by_round
            ]
        )
        planning = np.transpose(
            [
                [trial.planning_seconds_per_point for trial in results_of_setting]
                for results_of_setting in self.trials_by_round
            ]
        )
        time_domain_pd = [
            self.time_domain_differences[row][0] if row in self.time_domain_differences else np.nan
            for row in self.sample_rows.tolist()
        ]

        def make_layout(
            name: str, dims: tuple[str, ...], values: Any, long_name: str, units: str = "1"
        ) -> ArrayLayout:
            return ArrayLayout.from_values(
                name, dims, np.asarray(values), cf_attributes(units, long_name)
            )

        return [
            ArrayLayout.from_values(
                "setting",
                ("setting",),
                np.array([setting.name for setting in settings], object),
                {},
            ),
            ArrayLayout.from_values(
                "kind", ("setting",), np.array([setting.kind for setting in settings], object), {}
            ),
            make_layout(
                "tolerance",
                ("setting",),
                [tolerance_of_setting(setting) for setting in settings],
                "tolerance of an adaptive setting",
            ),
            make_layout(
                "times", ("setting",), self.n_timed_points, "points of each stretch that is timed"
            ),
            make_layout(
                "seconds",
                ("setting", "round"),
                seconds,
                "time a point on one core, planning included",
                "s",
            ),
            make_layout("planning", ("setting", "round"), planning, "planning's share of it", "s"),
            *(
                make_layout(name, ("setting", "point"), values, about)
                for (name, about), values in zip(
                    ERROR_ARRAY_LONG_NAMES.items(), errors, strict=True
                )
            ),
            make_layout(
                "truth_pd_difference",
                ("point",),
                time_domain_pd,
                "difference of a probability of detection from the time domain's",
            ),
            *(
                ArrayLayout.from_values(
                    name, ("point",), np.asarray(values)[self.sample_rows], attributes
                )
                for name, (values, attributes) in self.sample.point_coordinates().items()
            ),
        ]


def tolerance_of_setting(setting: AccuracySetting) -> float:
    """Return the tolerance that a setting states.

    The result is nan for the reference and for settings without a tolerance.
    """
    value = setting.overrides.get("accuracy.tolerance", np.nan)
    return float(value) if setting.kind != REFERENCE_KIND else np.nan
