"""What must hold of every flight, however odd: point clouds of sane numbers, or words."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from judging import Verdict, kind_of, look_at_mistake, strictly

from sweep.model.detectors import FIXED
from sweep.model.estimators import DETECTOR
from sweep.model.outputs import CYCLES, NAVIGATION, POINTS, SHOTS, STATISTICS
from sweep.model.unsupported import UnsupportedShot
from sweep.model.waveform import PEAKS, STRONGEST, order_of
from sweep.scenes.eyepoint_arrays import from_arrays
from sweep.scenes.files import SceneError
from sweep.spec import SceneSpec, SpecError, from_stored, load
from sweep.tasks.eyepoint_study import EyepointStudy
from sweep.tasks.flight_study import FlightStudy, Part
from sweep.tasks.plan import plan
from sweep.tasks.study import Results

UNIT = 1e-9
"""What a unit vector's length may be off."""


def judge_flight(file: Path) -> Verdict:
    """A spec of a flight read from its file, planned, cast, looked at in a plain loop."""
    with strictly():
        try:
            spec = load(file)
        except SpecError as error:
            for mistake in error.mistakes:
                look_at_mistake(mistake)
            return Verdict(tuple(kind_of(m) for m in error.mistakes))
        assert isinstance(spec, SceneSpec)
        assert from_stored(spec.to_json(), file.parent).id == spec.id, "a stored spec is another"
        try:
            study = FlightStudy(spec, file.with_suffix(".zarr"))
            for eyepoints in study.eyepoint_studies():
                _look_through(study, eyepoints)
            plan(spec, store=file.with_suffix(".zarr"))
        except SceneError as error:
            # Of a field of the spec, or of a file that the scene names.
            assert error.rule and error.remedy, f"no remedy: {error}"
            return Verdict((error.rule[:50],))
        except UnsupportedShot as error:
            assert "instrument." in str(error), f"no field named: {error}"
            return Verdict((str(error)[:50],))
    return Verdict()


def _look_through(study: FlightStudy, eyepoints: EyepointStudy) -> None:
    """All shots of a scanner: what they see, and every place along axes and draws."""
    numbers = np.arange(eyepoints.points)
    seen = eyepoints.see(numbers)
    look_at_shots(seen)
    shots = from_arrays(seen, eyepoints.weight)
    stretches = study.scanners[eyepoints.scanner]
    for *axes, draws in np.ndindex(*stretches.along[:-1]):
        part = stretches.part(stretches.number((*axes, draws, 0)))
        selected = study.select(part, shots, np.arange(len(shots.time)))
        assert np.isfinite(selected.error).all() and (selected.error >= 0).all(), "effects_error"
        found = study.look(part, seen, shots, selected, numbers)
        look_at_cloud(
            seen, found, navigates=stretches.navigates, missing=_without_values(study, part)
        )


def _without_values(study: FlightStudy, part: Part) -> set[str]:
    """Names of statistics that no shot of a part has."""
    parameters, missing = study.parameters_at(part), set()
    architecture, order = (
        str(parameters[f"instrument.{name}"])
        for name in ("receiver.architecture", "chirp.segments")
    )
    if "doppler" not in order_of(architecture, order):
        missing.add("pd_doppler")
    if study.rays_accuracy is None:
        missing.add("beamlets_error")
    of_threshold = parameters.get(DETECTOR + "kind", FIXED) == FIXED
    if study.spec.draws.whole_spectra and not (of_threshold and parameters.get(PEAKS) != STRONGEST):
        missing |= {name for name in STATISTICS if name.startswith(("pd_", "pfa_"))}
    return missing


OF_HITS = ("beam_radial_velocity", "beam_acceleration", "beam_approach", "beam_turn_rate")
"""Quantities of a beam that a beam which hits nothing has not."""


def look_at_shots(seen: Results) -> None:
    """Where the instrument is and what its beams hit: numbers throughout, but for misses."""
    for name in (*SHOTS, *CYCLES):
        missing = np.isinf(seen[name]) if name in ("beam_range", "true_altitude") else False
        if name in OF_HITS:
            missing = np.isnan(seen[name]) & np.isinf(seen["beam_range"])
        assert (np.isfinite(seen[name]) | missing).all(), f"{name} is not finite"
    length = np.linalg.norm(seen["beam_direction"], axis=-1)
    assert (np.abs(length - 1) < UNIT).all(), "beam_direction is no unit vector"
    assert (seen["beam_range"] > 0).all(), "beam_range"
    hit = seen["surface"] >= 0
    cosine = seen["cos_incidence"][hit]
    assert ((cosine >= 0) & (cosine <= 1 + UNIT)).all(), "cos_incidence"
    assert np.isfinite(seen["offset"][hit]).all(), "offset"


def look_at_cloud(
    seen: Results, found: Results, *, navigates: bool, missing: Collection[str]
) -> None:
    """Statistics, points and navigation: nan where there is nothing, and nowhere else."""
    wanted = {*STATISTICS, *POINTS, *(NAVIGATION if navigates else ())}
    assert set(found) == wanted, "outputs are missing, or too many"
    sees = (seen["surface"] >= 0).any(axis=1)
    for name in STATISTICS:
        values = found[name]
        if values.dtype.kind != "f":
            continue
        there = sees | name.startswith("pfa_")
        if name in missing:
            there = np.zeros_like(sees)
        assert np.isfinite(values[there]).all(), f"{name} is nan for no reason"
        assert np.isnan(values[~there]).all(), f"{name} of nothing"
        if name.startswith(("pd_", "pfa_")):
            assert ((values[there] >= 0) & (values[there] <= 1)).all(), f"{name}: {values[there]}"
    _points(found, sees)
    if navigates:
        _navigation(found)


def _points(found: Results, sees: np.ndarray) -> None:
    """Points where flags say so."""
    flags = found["flags"]
    point, true = flags > 0, (flags & 1) > 0
    for name, output in POINTS.items():
        values = found[name]
        if output.dtype != "float64":
            continue
        there = point if values.ndim == point.ndim else point[..., None]
        assert not (~np.isnan(values) & ~there).any(), f"{name} where there is no point"
        if name in ("range", "range_interpolated", "position", "snr"):
            assert np.isfinite(values[point]).all(), f"{name} is not finite"
        if name.endswith("standard_error"):
            assert not (values[point] < 0).any(), name
    pd = found["pd"][true]
    assert ((pd >= 0) & (pd <= 1)).all(), "pd of a point"
    assert np.isfinite(found["true_range"][true]).all(), "true_range of a true point"


def _navigation(found: Results) -> None:
    """Solutions with variances that can be, and none without a status."""
    velocity, covariance = found["velocity"], found["velocity_covariance"]
    solved = found["velocity_beams"] > 0
    assert np.isnan(velocity[~solved]).all(), "a velocity of no beams"
    assert np.isfinite(velocity[solved]).all(), "velocity"
    variances = np.diagonal(covariance[solved], axis1=-2, axis2=-1)
    assert (variances >= 0).all(), "velocity_covariance"
    level = found["altitude_beams"] > 0
    assert np.isfinite(found["altitude"][level]).all(), "altitude"
    assert (found["altitude_variance"][level] >= 0).all(), "altitude_variance"
