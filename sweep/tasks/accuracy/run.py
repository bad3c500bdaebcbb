"""The measurement of what accuracy costs, from a spec to its store."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.storage import opening
from sweep.storage.atomic_replace import real
from sweep.storage.locations import Location
from sweep.tasks import identity, store, versions
from sweep.tasks.accuracy.bench import Bench, GridBench
from sweep.tasks.accuracy.flight_bench import FlightBench
from sweep.tasks.accuracy.measure import (
    POINTS,
    TIME_LIMIT,
    Measured,
    Measurement,
    Nothing,
    apart,
    differences,
)
from sweep.tasks.accuracy.rungs import REFERENCE, THESIS, Rung
from sweep.tasks.errors import StoreError, TaskError
from sweep.tasks.interrupt import Interrupts
from sweep.tasks.progress import Progress, chosen, working
from sweep.tasks.studies import ACCURACY, study_of
from sweep.tasks.study import ArrayLayout, Study

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec
    from sweep.tasks.accuracy.rungs import Declared

#: Of each part of storing; the first may import and open what the others find.
TRIALS = 3

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

    Parameters
    ----------
    spec, points
        The study; points of the sample.
    store_path
        Path of the store to make; it is there whole, or not at all.
    time_limit
        Time that trying may take [s], about.
    overwrite
        Whether to put the new store in the place of one that is there.
    progress
        As of :func:`sweep.tasks.driver.run`.

    Returns
    -------
    bool
        Whether any point was through before it was interrupted; without one there is no store.

    Raises
    ------
    StoreError, TaskError
        Where a store is in the way or can't be written; where the study draws whole spectra.
    SceneError
        Where a file of a scene is missing, changed or unfit.
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
            bench = _bench_of(spec, points)
        try:
            measurement = Measurement(
                bench, time_limit=time_limit, told=told, interrupts=interrupts
            )  # fmt: skip
            measured = measurement.run()
        except Nothing:
            return False
    stored = storing(study_of(spec, store_path))
    _refuse_in_the_way(store_path, overwrite)  # it may hold something else by now
    store.create(store_path, Content(spec, bench, measured, stored), replace=overwrite)
    return True


def _bench_of(spec: Spec | SceneSpec, points: int) -> Bench:
    from sweep.spec import SceneSpec

    return FlightBench(spec, points) if isinstance(spec, SceneSpec) else GridBench(spec, points)


def _refuse_in_the_way(path: Location, overwrite: bool) -> None:
    if not path.exists():
        return
    if opening.read_attributes(path)["kind"] != ACCURACY:
        raise StoreError(f"{path} holds a study's results: name another --store")
    if not overwrite:
        raise StoreError(f"{path} is there already: --overwrite measures anew")
    identity.refuse_to_replace(path)


def storing(study: Study) -> float:
    """Processor time that making a study's store and writing all of its blocks takes [s].

    Of blocks of zeros, which pack faster than results do: it is no more than what results take.
    """
    block = study.n_blocks // 2
    layouts = {layout.name: layout for layout in study.arrays()}
    results = {}
    for name, position in study.chunks(block).items():
        layout = layouts[name]
        sizes = zip(layout.shape, layout.chunks, position, strict=True)
        extent = [min(cut, n - cut * place) for n, cut, place in sizes]
        results[name] = np.zeros(extent, layout.dtype)
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


class Content:
    """Content of the store: errors by rung and point, seconds by rung and round."""

    def __init__(self, spec: Declared, bench: Bench, measured: Measured, stored: float) -> None:
        self._spec, self._bench, self._measured, self._stored = spec, bench, measured, stored

    @property
    def id(self) -> str:
        """That of the study."""
        return self._spec.id

    def attributes(self) -> dict[str, Any]:
        """The spec, what the errors are taken against, and what was measured on."""
        measured = self._measured
        return {
            "kind": ACCURACY,
            "title": self._spec.title,
            "question": "What does accuracy cost in time?",
            "spec": self._spec.to_json(),
            "reference": measured.ladder.about,
            "environment": {"processor": versions.processor(), **versions.software()},
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
        """How far the reference is from the time domain, at the most; at how many points."""
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
            "tolerance": (by_rung, np.array([_tolerance(rung) for rung in rungs]), "1",
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
        return [
            _array("rung", by_rung, np.array(names, object)),
            _array("kind", by_rung, np.array(kinds, object)),
            *(
                _array(name, dims, values, units=units, long_name=about)
                for name, (dims, values, units, about) in told.items()
            ),
            *(
                _array(name, ("point",), np.asarray(values)[measured.done], **attributes)
                for name, (values, attributes) in self._bench.coordinates().items()
            ),
        ]


def _tolerance(rung: Rung) -> float:
    value = rung.overrides.get("accuracy.tolerance", np.nan)
    return float(value) if rung.kind != REFERENCE else np.nan


def _array(name: str, dims: tuple[str, ...], values: np.ndarray, **attributes: Any) -> ArrayLayout:
    return ArrayLayout(
        name=name,
        shape=values.shape,
        chunks=tuple(max(1, n) for n in values.shape),
        dims=dims,
        dtype="string" if values.dtype == object else str(values.dtype),
        attributes=attributes,
        values=values,
    )
