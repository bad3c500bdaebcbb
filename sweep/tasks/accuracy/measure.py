"""The measurement of what accuracy costs: rungs tried round after round, from a spec to a store."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from sweep.spec import SceneSpec, Spec
from sweep.storage import opening
from sweep.storage.locations import Location, real
from sweep.tasks import store
from sweep.tasks.accuracy.bench import GridBench, Seen, Trial, spread
from sweep.tasks.accuracy.flight_bench import FlightBench
from sweep.tasks.accuracy.rungs import (
    ADAPTIVE,
    ALL_ON,
    DRAWN,
    REFERENCE,
    THESIS,
    Declared,
    Ladder,
    Rung,
    ladder,
)
from sweep.tasks.progress import Interrupts, Progress, StoreError, TaskError, chosen, working
from sweep.tasks.studies import ACCURACY, study_of
from sweep.tasks.study import ArrayLayout, Study, described

AnyBench = GridBench | FlightBench

POINTS, TIME_LIMIT = 200, 60.0
"""Points of a sample; time that trying may take [s]."""

MOST_ROUNDS = 27
"""Rounds at the most, which a study that takes next to nothing has: chance tells most there."""

LONG_ENOUGH = 0.003
"""Share of the time limit that a trial takes: its calls then cost little beside its points."""

TOO_LONG = 2
"""Of these, in which stretches are cut: calls cost the dearest settings nothing to speak of."""

FIRST_TRIED = 8
"""Factor by which the stretches are shorter in which settings are known to be dear."""

FIRST_ROUND, UNTIL_TRUTH = 0.6, 0.8
"""Shares of the time limit by which the first round, and then the truth, ends."""

LEAST_IN_TRUTH = 3
"""Points in the time domain, however long they take."""

TRUTH_POINTS = 500
"""Points in the time domain, at the most."""

TRUTH_BEAMLETS = 109
"""Beamlets in the time domain where accuracy decides on their number: each is a record."""

LONG = 1.0
"""Seconds from which on a trial is made once: it is timed well enough by that."""

FIXED_AS_AT = (1e-1, 1e-3, 1e-6)
"""Tolerances whose effects are tried at every point alike."""


TRIALS = 3
"""Of each part of storing; the first may import and open what the others find."""

_ABOUT = {
    "pd_error": "largest error of a probability of detection, of segments and shot",
    "log10_pfa_error": "error of log10 of a probability of false alarm",
    "leakage_error": "error of a probability of leakage, of the two chirps",
    "magnitude_error": "error of the magnitude of the peak bins, over it or sigma if larger",
    "standard_error": "standard error that the setting itself tells, where it draws",
}


def measure(
    spec: Spec | SceneSpec,
    *,
    store_path: Location,
    points: int = POINTS,
    time_limit: float = TIME_LIMIT,
    overwrite: bool = False,
    progress: bool | Progress = True,
) -> bool:
    """Try a ladder of settings on a sample of a study's points, and store what they came to.

    The store is there whole, or not at all. Trying takes about a ``time_limit`` [s];
    ``progress`` is as of :func:`sweep.tasks.driver.run`. False where it was interrupted before
    any point was through: there is no store then.

    StoreError where a store is in the way or can't be written, TaskError where the study draws
    whole spectra, SceneError where a file of a scene is missing, changed or unfit.
    """
    if getattr(spec.draws, "whole_spectra", False):
        raise TaskError(
            "this study draws whole spectra, which have no settings to try: "
            "leave out draws.method, detector and estimator"
        )
    store_path = real(store_path)
    _refuse_in_the_way(store_path, overwrite)
    told = chosen(progress)
    with Interrupts() as interrupts:
        with working("choosing points", told):
            bench = (
                FlightBench(spec, points)
                if isinstance(spec, SceneSpec)
                else GridBench(spec, points)
            )
        try:
            measured = Measurement(
                bench, time_limit=time_limit, told=told, interrupts=interrupts
            ).run()
        except Nothing:
            return False
    stored = storing(study_of(spec, store_path))
    _refuse_in_the_way(store_path, overwrite)  # it may hold something else by now
    store.create(store_path, Content(spec, bench, measured, stored), replace=overwrite)
    return True


def _refuse_in_the_way(path: Location, overwrite: bool) -> None:
    if not path.exists():
        return
    if opening.read_attributes(path)["kind"] != ACCURACY:
        raise StoreError(f"{path} holds a study's results: name another --store")
    if not overwrite:
        raise StoreError(f"{path} is there already: --overwrite measures anew")
    store.refuse_to_replace(path)


def storing(study: Study) -> float:
    """Processor time that making a study's store takes [s], and writing its blocks, of zeros."""
    block = study.n_blocks // 2
    results = {
        name: np.zeros([s.stop - s.start for s in region], study.layouts[name].dtype)
        for name, region in study.regions(block).items()
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.zarr"

        def make() -> None:
            if path.exists():
                store.remove(path)
            store.create(path, study)

        made = _least(make)
        arrays = store.Arrays(path, study)
        return made + study.n_blocks * _least(lambda: arrays.write(block, results))


def _least(work: Callable[[], object]) -> float:
    """Least processor time of a work in some trials [s]."""
    spent = []
    for _ in range(TRIALS):
        begun = process_time()
        work()
        spent.append(process_time() - begun)
    return min(spent)


@dataclass
class Measured:
    """Results of the trials, by rung and point of the sample."""

    ladder: Ladder
    seen: list[Seen]  # one a rung, (points, ...) each
    done: np.ndarray  # places in the sample of the points that every rung was tried on
    seconds: np.ndarray  # (rungs, rounds): a point, planning included
    planning: np.ndarray  # (rungs, rounds): a point
    times: np.ndarray  # (rungs,): points of a stretch that is timed
    truth: dict[int, tuple[Seen, Seen]]
    """By place in the sample: in the time domain, and as the reference has it."""
    truth_beamlets: int  # of both, where their number is not the reference's; else 0
    stopped: str  # Why the sample is not whole; empty where it is


class Nothing(Exception):
    """Broken off before any point was through."""


class Measurement:
    """Rungs tried on a sample in turn, so that what drifts falls on all of them alike.

    Each round takes them in an order of its own: a short trial takes longer after a long one.
    All may take a time limit [s], about.
    """

    def __init__(
        self, bench: AnyBench, *, time_limit: float, told: Progress, interrupts: Interrupts
    ) -> None:
        self._bench, self._limit = bench, time_limit
        self._told, self._interrupts = told, interrupts
        self._begun = time.monotonic()
        self._ladder = completed(ladder(bench.spec), bench)
        self._rungs = self._ladder.rungs
        self._times = np.ones(len(self._rungs), np.int64)
        self._once = np.zeros(len(self._rungs), bool)
        self._orders = np.random.default_rng(0)

    def run(self) -> Measured:
        """All rounds that the time allows; Nothing where no point was through before the end."""
        self._told.say(
            f"trying {len(self._rungs)} settings on {self._bench.size:,} {self._bench.unit}"
        )
        with working("looking how long settings take", self._told):
            self._compile()
            parts = self._bench.parts(self._part_points())
            rounds = self._planned_rounds(parts)
        self._told.begin(points=len(self._rungs) * len(parts) * rounds, done=0, unit="trials")
        try:
            return self._rounds(parts, rounds)
        finally:
            self._told.end()

    def _rounds(self, parts: list[np.ndarray], rounds: int) -> Measured:
        first = self._round(parts, until=FIRST_ROUND)
        if not first:
            raise Nothing
        stopped = "interrupted" if self._interrupts.stopping else "time limit"
        stopped = stopped if len(first) < len(parts) else ""
        parts = parts[: len(first)]
        places = np.concatenate(parts)
        truth, beamlets = self._truth(places)
        done = [together(parts, first)]
        for _ in range(rounds - 1):
            again = self._round(parts, until=1.0, first=first)
            if len(again) < len(parts):
                break
            done.append(together(parts, again))
        seconds, planning = (
            np.array([[getattr(trial, name) for trial in trials] for trials in done]).T
            for name in ("seconds", "planning")
        )
        return Measured(
            ladder=self._ladder, seen=[trial.seen for trial in done[0]], done=places,
            seconds=seconds, planning=planning, times=self._times, truth=truth,
            truth_beamlets=beamlets, stopped=stopped,
        )  # fmt: skip

    def _part_points(self) -> int:
        """Points of a part: a few parts, and more where a point takes its time."""
        first, least = self._bench.parts(1)[0], self._bench.least_parts
        spent = sum(self._timed(i, first) for i in range(len(self._rungs)))
        left = FIRST_ROUND * self._limit - (time.monotonic() - self._begun)
        fitting = left * len(first) / spent
        # One part more, on which all are tried before the first round.
        return max(1, min(self._bench.size // least, int(fitting / (least + 1))))

    def _compile(self) -> None:
        """Compile what rungs compile, on those that are not long runs; it is not counted."""
        first, numbers = self._bench.parts(1)[0], [r.overrides.get(DRAWN) for r in self._rungs]
        few = min((number for number in numbers if number is not None), default=None)
        for i, number in enumerate(numbers):
            if number == few:
                self._timed(i, first)
        self._begun = time.monotonic()

    def _planned_rounds(self, parts: list[np.ndarray]) -> int:
        """Return the rounds that fit in; set the points of a stretch that times each rung well."""
        times, enough = 1, LONG_ENOUGH * self._limit
        while self._timed(0, parts[0]) < enough / 2 and times < self._bench.most_times:
            times = min(2 * times, self._bench.most_times)
            self._times[0] = times
        shorter = max(1, times // FIRST_TRIED)
        self._times[:] = shorter
        took = np.array([self._timed(i, parts[0]) for i in range(len(self._rungs))])
        fitting = TOO_LONG * enough * shorter / took
        cut = np.exp2(np.floor(np.log2(fitting))).clip(1, times)
        self._times[:] = cut
        spent = took * cut / shorter
        self._once = spent > LONG
        left = 0.75 * (self._limit - (time.monotonic() - self._begun)) / len(parts)
        after_truth = (1 - UNTIL_TRUTH) * self._limit / len(parts)
        again = max(float(spent[~self._once].sum()), 1e-9)
        further = max(left - float(spent.sum()), after_truth) / again
        return 1 + max(0, min(MOST_ROUNDS - 1, int(further)))

    def _timed(self, rung: int, part: np.ndarray) -> float:
        begun = time.monotonic()
        if self._interrupts.stopping:
            raise Nothing
        self._try(rung, part)
        self._bench.forget()
        return time.monotonic() - begun

    def _try(self, rung: int, part: np.ndarray) -> Trial:
        return self._bench.try_on(self._rungs[rung], part, int(self._times[rung]))

    def _round(
        self, parts: list[np.ndarray], *, until: float, first: list[list[Trial]] | None = None
    ) -> list[list[Trial]]:
        """Every rung on every part that there is time for; long ones only in the first round."""
        done: list[list[Trial]] = []
        for part in parts:
            if done and time.monotonic() - self._begun > until * self._limit:
                break
            trials = {}
            for rung in self._orders.permutation(len(self._rungs)).tolist():
                if self._interrupts.stopping:
                    return done
                if first is not None and self._once[rung]:
                    trials[rung] = first[len(done)][rung]
                else:
                    trials[rung] = self._try(rung, part)
                self._told.advance(points=1, failed=0)
            self._bench.forget()
            done.append([trials[rung] for rung in range(len(self._rungs))])
        return done

    def _truth(self, places: np.ndarray) -> tuple[dict[int, tuple[Seen, Seen]], int]:
        """Compute some of these points in the time domain, as time allows; their beamlets."""
        rung, number = self._ladder.reference, "footprint.beamlets"
        found: dict[int, tuple[Seen, Seen]] = {}
        beamlets = TRUTH_BEAMLETS if number in rung.overrides else 0
        if beamlets:
            overrides = {**rung.overrides, number: beamlets}
            rung = replace(rung, name="in time", overrides=overrides, rays_error=0.0)
        for place in places[spread(places.shape, TRUTH_POINTS)].tolist():
            late = time.monotonic() - self._begun > UNTIL_TRUTH * self._limit
            if self._interrupts.stopping or (late and len(found) >= LEAST_IN_TRUTH):
                break
            in_time, reference = self._bench.truth(rung, place)
            if np.isfinite(in_time.pd).any():
                found[place] = in_time, reference
        self._bench.forget()
        return found, beamlets


def completed(rungs: Ladder, bench: AnyBench, tolerances: Iterable[float] = ()) -> Ladder:
    """Return the ladder, with the effects of each tolerance fixed at every point."""
    if not any(rung.kind == ALL_ON for rung in rungs.rungs):
        return rungs  # of draws
    at = {tolerance_of(rung): rung for rung in rungs.rungs if rung.kind == ADAPTIVE}
    sets = {t: bench.effects(at[t]) for t in FIXED_AS_AT if t in at}
    bench.forget()
    return rungs.with_fixed(sets, tolerances)


def together(parts: list[np.ndarray], trials: list[list[Trial]]) -> list[Trial]:
    """Trials of rungs on the parts of a sample, each as one."""
    share = np.array([len(part) for part in parts]) / sum(map(len, parts))
    return [
        Trial(
            Seen(*map(np.concatenate, zip(*(t.seen for t in each), strict=True))),
            float(share @ [t.seconds for t in each]),
            float(share @ [t.planning for t in each]),
        )
        for each in zip(*trials, strict=True)
    ]


ERRORS = ("pd_error", "log10_pfa_error", "magnitude_error", "leakage_error")
PROMISED = 3
"""The first of these, which a tolerance promises to bound."""


def differences(measured: Measured) -> dict[str, np.ndarray]:
    """Errors of all rungs against the reference, (rungs, points) each, by name."""
    found = [apart(seen, measured.seen[-1]) for seen in measured.seen]
    return {name: np.array(v) for name, v in zip(ERRORS, zip(*found, strict=True), strict=True)}


def apart(seen: Seen, other: Seen) -> tuple[np.ndarray, ...]:
    """Largest differences from others, (n,) each: of pd, log10 pfa, magnitudes, leakage.

    Magnitudes in relation to the other, or to sigma where it is below that.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        pfa = np.abs(seen.log10_pfa - other.log10_pfa)
        least = np.maximum(other.magnitude, other.sigma[:, None])
        magnitude = np.abs(seen.magnitude - other.magnitude) / least
    pfa = np.where(seen.log10_pfa == other.log10_pfa, 0.0, pfa)
    pd = _chances_apart(seen.pd, other.pd)
    leakage = _chances_apart(seen.leakage, other.leakage)
    return tuple(np.fmax.reduce(values, axis=1) for values in (pd, pfa, magnitude, leakage))


def _chances_apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Differences of probabilities: what sees nothing detects nothing, and leaks nothing."""
    either = np.isfinite(one) | np.isfinite(other)
    return np.where(either, np.abs(np.nan_to_num(one) - np.nan_to_num(other)), np.nan)


class Content:
    """Content of the store: errors by rung and point, seconds by rung and round."""

    def __init__(self, spec: Declared, bench: AnyBench, measured: Measured, stored: float) -> None:
        self._spec, self._bench, self._measured, self._stored = spec, bench, measured, stored

    @property
    def id(self) -> str:
        """The spec of the study."""
        return self._spec.id

    def attributes(self) -> dict[str, Any]:
        """Return the spec, the reference of the errors, and the machine."""
        measured = self._measured
        return {
            "kind": ACCURACY,
            "title": self._spec.title,
            "question": "What does accuracy cost in time?",
            "spec": self._spec.to_json(),
            "reference": measured.ladder.about,
            "environment": {"processor": store.processor(), **store.software()},
            "unit": self._bench.unit,
            "points": len(measured.done),
            "study_points": self._bench.whole,
            "storing_seconds": self._stored,
            "notes": list(measured.ladder.notes),
            "thesis_beamlets": self._thesis_beamlets(),
            "stopped": measured.stopped,
            "coordinates": " ".join(["kind", *self._bench.coordinates()]),
            **self._truth(),
        }

    def _truth(self) -> dict[str, Any]:
        """Largest difference between reference and time domain, and the number of points."""
        found = [apart(*pair) for pair in self._measured.truth.values()]
        if not found:
            return {"truth_points": 0}
        pd, _, _, magnitude = np.fmax.reduce(np.array(found), axis=(0, 2))
        return {
            "truth_points": len(found),
            "truth_beamlets": self._measured.truth_beamlets,
            "truth_pd_difference": float(pd),
            "truth_magnitude_difference": float(magnitude),
        }

    def _thesis_beamlets(self) -> int:
        """Beamlets of a point in the thesis's way; 0 where it was not tried, or nothing is seen."""
        tried = zip(self._measured.ladder.rungs, self._measured.seen, strict=True)
        numbers = [seen.beamlets for rung, seen in tried if rung.kind == THESIS]
        return int(np.nan_to_num(np.fmax.reduce(numbers, axis=None))) if numbers else 0

    def groups(self) -> dict[str, dict[str, Any]]:
        """None."""
        return {}

    def arrays(self) -> list[ArrayLayout]:
        """Coordinates, errors, seconds."""
        measured, rungs = self._measured, self._measured.ladder.rungs
        truth = np.full(len(measured.done), np.nan)
        for place, (in_time, reference) in measured.truth.items():
            truth[np.flatnonzero(measured.done == place)] = apart(in_time, reference)[0]
        errors = differences(measured)
        errors["standard_error"] = np.array([seen.standard_error for seen in measured.seen])
        by_rung, by_round, by_point = ("rung",), ("rung", "round"), ("rung", "point")
        told = {
            "tolerance": (by_rung, np.array([tolerance_of(rung) for rung in rungs]), "1",
                          "tolerance of an adaptive setting"),
            "times": (by_rung, measured.times, "1", "points of each stretch that is timed"),
            "seconds": (by_round, measured.seconds, "s",
                        "time a point on one core, planning included"),
            "planning": (by_round, measured.planning, "s", "planning's share of it"),
            **{name: (by_point, values, "1", _ABOUT[name]) for name, values in errors.items()},
            "truth_pd_difference": (
                ("point",), truth, "1",
                "difference of a probability of detection from the time domain's",
            ),
        }  # fmt: skip
        names, kinds = ([getattr(rung, each) for rung in rungs] for each in ("name", "kind"))
        known = ArrayLayout.known
        return [
            known("rung", by_rung, np.array(names, object), {}),
            known("kind", by_rung, np.array(kinds, object), {}),
            *(
                known(name, dims, values, described(units, about))
                for name, (dims, values, units, about) in told.items()
            ),
            *(
                known(name, ("point",), np.asarray(values)[measured.done], attributes)
                for name, (values, attributes) in self._bench.coordinates().items()
            ),
        ]


def tolerance_of(rung: Rung) -> float:
    """Tolerance of an adaptive setting; nan of others."""
    value = rung.overrides.get("accuracy.tolerance", np.nan)
    return float(value) if rung.kind != REFERENCE else np.nan
