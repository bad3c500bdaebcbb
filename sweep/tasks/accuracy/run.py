"""The measurement of what accuracy costs, from a spec to its store."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.storage import opening
from sweep.storage.atomic_replace import real
from sweep.storage.locations import Location
from sweep.tasks import identity, store, versions
from sweep.tasks.accuracy.bench import Bench
from sweep.tasks.accuracy.measure import (
    POINTS,
    TIME_LIMIT,
    Measured,
    Measurement,
    apart,
    bench_of,
    differences,
)
from sweep.tasks.accuracy.rungs import REFERENCE, THESIS, Rung
from sweep.tasks.accuracy.storing import storing
from sweep.tasks.errors import StoreError, TaskError
from sweep.tasks.interrupt import Interrupts
from sweep.tasks.progress import Progress, chosen, working
from sweep.tasks.studies import ACCURACY, study_of
from sweep.tasks.study import ArrayLayout

if TYPE_CHECKING:
    from sweep.tasks.accuracy.rungs import Declared

_ABOUT = {
    "pd_error": ("1", "largest error of a probability of detection, of segments and shot"),
    "log10_pfa_error": ("1", "error of log10 of a probability of false alarm"),
    "leakage_error": ("1", "error of a probability of leakage, of the two chirps"),
    "magnitude_error": ("1", "error of the magnitude of the peak bins, over it or sigma if larger"),
    "standard_error": ("1", "standard error that the setting itself tells, where it draws"),
}


def measure(
    spec: Declared,
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
    spec
        The study.
    store_path
        Path of the store to make; it is there whole, or not at all.
    points
        Points of the sample.
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
    from sweep.tasks.accuracy.measure import Nothing

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
            bench = bench_of(spec, points)
        try:
            measured = Measurement(
                bench, time_limit=time_limit, told=told, interrupts=interrupts
            ).run()
        except Nothing:
            return False
    stored = storing(study_of(spec, store_path))  # type: ignore[arg-type]
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
    identity.refuse_to_replace(path)


class Content:
    """What the store holds: errors by rung and point, seconds by rung and round.

    Parameters
    ----------
    spec, bench, measured
        The study, the sample of its points, and what rungs came to on it.
    stored
        Time that storing all of it takes [s].
    """

    def __init__(self, spec: Declared, bench: Bench, measured: Measured, stored: float) -> None:
        self._spec, self._bench, self._measured, self._stored = spec, bench, measured, stored

    @property
    def id(self) -> str:
        """That of the study."""
        return self._spec.id

    def attributes(self) -> dict[str, Any]:
        """The spec, what the errors are taken against, and what was measured on."""
        measured = self._measured
        found = {
            "kind": ACCURACY,
            "title": self._spec.title,
            "question": "What does accuracy cost in time?",
            "spec": self._spec.to_json(),
            "reference": measured.ladder.about,
            "environment": {"processor": versions.processor(), **versions.software()},
            "unit": self._bench.unit,
            "points": len(self._measured.done),
            "study_points": self._bench.whole,
            "storing_seconds": self._stored,
            "notes": list(measured.ladder.notes),
            "thesis_beamlets": self._thesis_beamlets(),
            "stopped": measured.stopped,
            "coordinates": " ".join(["kind", *self._bench.coordinates()]),
        }
        return found | self._truth()

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
        found = [
            _array("rung", ("rung",), _texts(rung.name for rung in rungs)),
            _array("kind", ("rung",), _texts(rung.kind for rung in rungs)),
            _array("tolerance", ("rung",), np.array([_tolerance(r) for r in rungs]), "1",
                   "tolerance of an adaptive setting"),
            _array("times", ("rung",), measured.times, "1", "points of each stretch that is timed"),
            _array("seconds", ("rung", "round"), measured.seconds, "s",
                   "time a point on one core, planning included"),
            _array("planning", ("rung", "round"), measured.planning, "s",
                   "planning's share of it"),
        ]  # fmt: skip
        errors = dict(differences(measured))
        errors["standard_error"] = np.array([seen.standard_error for seen in measured.seen])
        for name, values in errors.items():
            found.append(_array(name, ("rung", "point"), values, *_ABOUT[name]))
        found.append(self._truth_array())
        for name, (values, attributes) in self._bench.coordinates().items():
            chosen_ = np.asarray(values)[measured.done]
            layout = _array(
                name, ("point",), _texts(chosen_) if chosen_.dtype == object else chosen_
            )
            layout.attributes.update(attributes)  # type: ignore[attr-defined]
            found.append(layout)
        return found

    def _truth_array(self) -> ArrayLayout:
        """Differences of pd between reference and time domain; nan where it was not looked at."""
        measured = self._measured
        values = np.full(len(measured.done), np.nan)
        for place, (in_time, reference) in measured.truth.items():
            values[np.flatnonzero(measured.done == place)] = apart(in_time, reference)[0]
        long_name = "difference of a probability of detection from the time domain's"
        return _array("truth_pd_difference", ("point",), values, "1", long_name)


def _tolerance(rung: Rung) -> float:
    value = rung.overrides.get("accuracy.tolerance", np.nan)
    return float(value) if rung.kind != REFERENCE else np.nan


def _texts(values: Any) -> np.ndarray:
    return np.array(list(values), object)


def _array(
    name: str, dims: tuple[str, ...], values: np.ndarray, units: str = "", long_name: str = ""
) -> ArrayLayout:
    attributes = {"units": units, "long_name": long_name} if long_name else {}
    text = values.dtype == object
    return ArrayLayout(
        name=name,
        shape=values.shape,
        chunks=tuple(max(1, n) for n in values.shape),
        dims=dims,
        dtype="string" if text else str(values.dtype),
        attributes=attributes,
        values=values,
    )
