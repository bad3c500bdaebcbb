"""The measurement of what accuracy costs: rungs tried round after round, from a spec to a store."""

from __future__ import annotations

import math
import tempfile
import time
import timeit
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from sweep.messages import option, option_name
from sweep.spec import SceneSpec, Spec
from sweep.storage import opening
from sweep.storage.locations import Location, is_free, real
from sweep.tasks import store
from sweep.tasks.accuracy.bench import Bench, FlightBench, GridBench, Seen, Trial, spread, together
from sweep.tasks.accuracy.rungs import (
    ADAPTIVE,
    ALL_ON,
    REFERENCE,
    THESIS,
    Ladder,
    Rung,
    ladder,
    with_fixed,
)
from sweep.tasks.interrupts import Interrupts
from sweep.tasks.progress import Progress, StoreError, TaskError, chosen, working
from sweep.tasks.studies import ACCURACY, study_of
from sweep.tasks.study import ArrayLayout, Study, described

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

LEAST_IN_TRUTH, TRUTH_POINTS = 3, 500
"""Points in the time domain, however long they take, and at the most."""

TRUTH_BEAMLETS = 109
"""Beamlets in the time domain where accuracy decides on their number: each is a record."""

LONG = 1.0
"""Seconds from which on a trial is made once: it is timed well enough by that."""

FIXED_AS_AT = (1e-1, 1e-3, 1e-6)
"""Tolerances whose effects are tried at every point alike."""

TRIALS = 3
"""Of each part of storing; the first may import and open what the others find."""


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
    if spec.draws.whole_spectra:
        raise TaskError(
            "this study draws whole spectra, which have no settings to try: "
            "leave out draws.method, detector and estimator"
        )
    store_path = real(store_path)
    _refuse_in_the_way(store_path, overwrite)
    told = chosen(progress)
    with Interrupts(told) as interrupts:
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
    measured.stored = storing(study_of(spec, store_path))
    _refuse_in_the_way(store_path, overwrite)  # it may hold something else by now
    store.create(store_path, measured, replace=overwrite)
    return True


def _refuse_in_the_way(path: Location, overwrite: bool) -> None:
    if is_free(path):
        return
    if opening.read_attributes(path)["kind"] != ACCURACY:
        raise StoreError(f"{path} holds a study's results: name another {option_name('store')}")
    if not overwrite:
        raise StoreError(f"{path} is there already: {option('overwrite')} measures anew")
    store.refuse_to_replace(path)
    store.refuse_foreign_files(path)


def storing(study: Study) -> float:
    """Processor time that making a study's store takes [s], and writing its blocks, of zeros."""
    block = study.n_blocks // 2
    results = {
        name: np.zeros([s.stop - s.start for s in region], study.layouts[name].dtype)
        for name, region in study.regions(block).items()
    }
    trials = partial(timeit.repeat, timer=process_time, repeat=TRIALS, number=1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.zarr"

        def make() -> None:
            if path.exists():
                store.remove(path)
            store.create(path, study)

        made = min(trials(make))
        arrays = store.Arrays(path, study)
        return made + study.n_blocks * min(trials(partial(arrays.write, block, results)))


class Nothing(Exception):
    """Broken off before any point was through."""


class Measurement:
    """Rungs tried on a sample in turn, so that what drifts falls on all of them alike.

    Each round takes them in an order of its own: a short trial takes longer after a long one.
    All may take a time limit [s], about.
    """

    def __init__(
        self, bench: Bench, *, time_limit: float, told: Progress, interrupts: Interrupts
    ) -> None:
        self._bench, self._limit = bench, time_limit
        self._told, self._interrupts = told, interrupts
        self._ladder = completed(ladder(bench.spec), bench)
        self._rungs = self._ladder.rungs
        self._times = np.ones(len(self._rungs), np.int64)
        self._once = np.zeros(len(self._rungs), bool)
        self._orders = np.random.default_rng(0)

    def run(self) -> Measured:
        """All rounds that the time allows; Nothing where no point was through before the end."""
        number = len(self._rungs)
        self._told.say(f"trying {number} settings on {self._bench.size:,} {self._bench.unit}")
        with working("looking how long settings take", self._told):
            parts = self._bench.parts(self._part_points())
            rounds = self._planned_rounds(parts)
        self._told.begin(points=number * len(parts) * rounds, done=0, unit="trials")
        try:
            return self._rounds(parts, rounds)
        finally:
            self._told.end()

    def _rounds(self, parts: list[np.ndarray], rounds: int) -> Measured:
        first, stopped = self._round(parts, until=FIRST_ROUND), ""
        if not first:
            raise Nothing
        if len(first) < len(parts):
            stopped = "interrupted" if self._interrupts.stopping else "time limit"
        parts = parts[: len(first)]
        places = np.concatenate(parts)
        truth, beamlets = self._truth(places)
        found = [first]
        while len(found) < rounds and len(found[-1]) == len(parts):
            found.append(self._round(parts, until=1.0, first=first))
        whole = [each for each in found if len(each) == len(parts)]
        trials = [[together(each) for each in zip(*parts, strict=True)] for parts in whole]
        return Measured(
            self._bench, self._ladder, places, trials, self._times, truth, beamlets, stopped
        )

    def _part_points(self) -> int:
        """Points of a part: a few parts, and more where a point takes its time."""
        every, first = range(len(self._rungs)), self._bench.parts(1)[0]
        for rung in every:  # compiles what it compiles, which is not counted
            self._timed(rung, first)
        self._begun = time.monotonic()
        spent = sum(self._timed(rung, first) for rung in every)
        fitting = (FIRST_ROUND * self._limit - self._elapsed) * len(first) / spent
        # Whole parts are kept where it is broken off. On one more all are tried before.
        least = max(2, len(self._bench.parts(self._bench.size)))
        return max(1, min(self._bench.size // least, int(fitting / (least + 1))))

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
        self._times[:] = np.exp2(np.floor(np.log2(fitting))).clip(1, times)
        spent = took * self._times / shorter
        self._once = spent > LONG
        left = 0.75 * (self._limit - self._elapsed) / len(parts)
        after_truth = (1 - UNTIL_TRUTH) * self._limit / len(parts)
        again = max(float(spent[~self._once].sum()), 1e-9)
        further = max(left - float(spent.sum()), after_truth) / again
        return 1 + max(0, min(MOST_ROUNDS - 1, int(further)))

    @property
    def _elapsed(self) -> float:
        return time.monotonic() - self._begun

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
            if done and self._elapsed > until * self._limit:
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

    def _truth(self, places: np.ndarray) -> tuple[dict[int, np.ndarray], int]:
        """Hold the reference at some points against the time domain, as time allows.

        Their differences, as of :func:`apart`, and the beamlets of both.
        """
        rung, number = self._ladder.reference, "footprint.beamlets"
        found: dict[int, np.ndarray] = {}
        beamlets = TRUTH_BEAMLETS if number in rung.overrides else 0
        if beamlets:
            overrides = {**rung.overrides, number: beamlets}
            rung = replace(rung, name="in time", overrides=overrides, rays_error=0.0)
        for place in places[spread(places.shape, TRUTH_POINTS)].tolist():
            late = self._elapsed > UNTIL_TRUTH * self._limit
            if self._interrupts.stopping or (late and len(found) >= LEAST_IN_TRUTH):
                break
            in_time, reference = self._bench.truth(rung, place)
            if np.isfinite(in_time.pd).any():
                found[place] = np.concatenate(apart(in_time, reference))
        self._bench.forget()
        return found, beamlets


def completed(rungs: Ladder, bench: Bench, tolerances: Iterable[float] = ()) -> Ladder:
    """Return the ladder, with the effects of each tolerance fixed at every point."""
    if not any(rung.kind == ALL_ON for rung in rungs.rungs):
        return rungs  # of draws
    at = {tolerance_of(rung): rung for rung in rungs.rungs if rung.kind == ADAPTIVE}
    sets = {t: bench.effects(at[t]) for t in FIXED_AS_AT if t in at}
    bench.forget()
    return with_fixed(rungs, bench.spec, sets, tolerances)


ERRORS = {
    "pd_error": "largest error of a probability of detection, of segments and shot",
    "log10_pfa_error": "error of log10 of a probability of false alarm",
    "magnitude_error": "error of the magnitude of the peak bins, over it or sigma if larger",
    "leakage_error": "error of a probability of leakage, of the two chirps",
    "standard_error": "standard error that the setting itself tells, where it draws",
}
"""Arrays by rung and point, and what they are; the first four are in the order of :func:`apart`."""

PROMISED = 3
"""The first of these, which a tolerance promises to bound."""


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


@dataclass
class Measured:
    """Content of the store: errors by rung and point, seconds by rung and round."""

    bench: Bench
    ladder: Ladder
    done: np.ndarray  # places in the sample of the points that every rung was tried on
    rounds: list[list[Trial]]  # of all these points, by rung
    times: np.ndarray  # (rungs,): points of a stretch that is timed
    truth: dict[int, np.ndarray]
    """By place in the sample: differences of the reference from the time domain."""
    truth_beamlets: int  # of both, where their number is not the reference's; else 0
    stopped: str  # why the sample is not whole; empty where it is
    stored: float = math.nan  # time that storing takes [s]

    @property
    def id(self) -> str:
        """The spec of the study."""
        return self.bench.spec.id

    def attributes(self) -> dict[str, Any]:
        """Return the spec, the reference of the errors, and the machine."""
        spec, trials = self.bench.spec, zip(self.ladder.rungs, self.rounds[0], strict=True)
        beamlets = [trial.seen.beamlets for rung, trial in trials if rung.kind == THESIS]
        found: dict[str, Any] = {
            "kind": ACCURACY,
            "title": spec.title,
            "question": "What does accuracy cost in time?",
            "spec": spec.to_json(),
            "reference": self.ladder.about,
            "unit": self.bench.unit,
            "points": len(self.done),
            "study_points": self.bench.whole,
            "storing_seconds": self.stored,
            "notes": "\n".join(self.ladder.notes),
            # 0 where the thesis's way was not tried, or nothing is seen
            "thesis_beamlets": int(np.nan_to_num(np.fmax.reduce(beamlets, axis=None, initial=0))),
            "stopped": self.stopped,
            "coordinates": " ".join(["kind", *self.bench.coordinates()]),
            "truth_points": len(self.truth),
        }
        if not self.truth:
            return found
        pd, _, _, magnitude = np.fmax.reduce(list(self.truth.values()))
        return found | {
            "truth_beamlets": self.truth_beamlets,
            "truth_pd_difference": float(pd),
            "truth_magnitude_difference": float(magnitude),
        }

    def groups(self) -> dict[str, dict[str, Any]]:
        """None."""
        return {}

    def arrays(self) -> list[ArrayLayout]:
        """Coordinates, errors, seconds."""
        rungs, seen = self.ladder.rungs, [trial.seen for trial in self.rounds[0]]
        errors = [*zip(*(apart(each, seen[-1]) for each in seen), strict=True)]
        errors.append(tuple(each.standard_error for each in seen))
        seconds = np.transpose([[trial.seconds for trial in each] for each in self.rounds])
        planning = np.transpose([[trial.planning for trial in each] for each in self.rounds])
        truth = [self.truth[k][0] if k in self.truth else np.nan for k in self.done.tolist()]

        def of(
            name: str, dims: tuple[str, ...], values: Any, about: str, units: str = "1"
        ) -> ArrayLayout:
            return ArrayLayout.known(name, dims, np.asarray(values), described(units, about))

        return [
            ArrayLayout.known("rung", ("rung",), np.array([r.name for r in rungs], object), {}),
            ArrayLayout.known("kind", ("rung",), np.array([r.kind for r in rungs], object), {}),
            of("tolerance", ("rung",), [tolerance_of(r) for r in rungs],
               "tolerance of an adaptive setting"),
            of("times", ("rung",), self.times, "points of each stretch that is timed"),
            of("seconds", ("rung", "round"), seconds,
               "time a point on one core, planning included", "s"),
            of("planning", ("rung", "round"), planning, "planning's share of it", "s"),
            *(of(name, ("rung", "point"), values, about)
              for (name, about), values in zip(ERRORS.items(), errors, strict=True)),
            of("truth_pd_difference", ("point",), truth,
               "difference of a probability of detection from the time domain's"),
            *(ArrayLayout.known(name, ("point",), np.asarray(values)[self.done], attributes)
              for name, (values, attributes) in self.bench.coordinates().items()),
        ]  # fmt: skip


def tolerance_of(rung: Rung) -> float:
    """Tolerance of an adaptive setting; nan of others."""
    value = rung.overrides.get("accuracy.tolerance", np.nan)
    return float(value) if rung.kind != REFERENCE else np.nan
