"""What must hold of every flight, however odd: point clouds of sane numbers, or words."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from study_checks import Verdict, check_mistake, mistake_kind, warnings_as_errors

from sweep.model.detection.detectors import FIXED_THRESHOLD_KIND
from sweep.model.detection.estimators import DETECTOR_PREFIX
from sweep.model.outputs import (
    CYCLE_VARIABLES,
    NAVIGATION_VARIABLES,
    POINT_CLOUD_VARIABLES,
    SHOT_GEOMETRY_VARIABLES,
    SHOT_STATISTIC_VARIABLES,
)
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.model.waveform import REPORTED_PEAKS_PATH, STRONGEST_PEAK, existing_segments
from sweep.scenes.eyepoint_arrays import eyepoints_from_arrays
from sweep.scenes.scene_files import SceneError
from sweep.spec import SceneSpec, SpecError, from_stored, load
from sweep.tasks.engine.blocks import Results
from sweep.tasks.studies.eyepoint_study import EyepointStudy
from sweep.tasks.studies.flight_study import FlightBlock, FlightStudy
from sweep.tasks.studies.study_plan import plan_study

UNIT_LENGTH_TOLERANCE = 1e-9
"""What a unit vector's length may be off."""


def check_flight(file: Path) -> Verdict:
    """A spec of a flight read from its file, planned, cast, looked at in a plain loop."""
    with warnings_as_errors():
        try:
            spec = load(file)
        except SpecError as error:
            for mistake in error.mistakes:
                check_mistake(mistake)
            return Verdict(tuple(mistake_kind(each_mistake) for each_mistake in error.mistakes))
        assert isinstance(spec, SceneSpec)
        assert from_stored(spec.to_json(), file.parent).id == spec.id, "a stored spec is another"
        try:
            study = FlightStudy(spec, file.with_suffix(".zarr"))
            for eyepoints in study.eyepoint_studies():
                _check_scanner(study, eyepoints)
            plan_study(spec, store_path=file.with_suffix(".zarr"))
        except SceneError as error:
            # Of a field of the spec, or of a file that the scene names.
            assert error.problem and error.remedy, f"no remedy: {error}"
            return Verdict((error.problem[:50],))
        except UnsupportedShotError as error:
            assert "instrument." in str(error), f"no field named: {error}"
            return Verdict((str(error)[:50],))
    return Verdict()


def _check_scanner(study: FlightStudy, eyepoints: EyepointStudy) -> None:
    """All shots of a scanner: what they see, and every place along axes and draws."""
    shot_numbers = np.arange(eyepoints.n_points)
    eyepoint_results = eyepoints.cast_cycles(shot_numbers)
    check_shots(eyepoint_results)
    shots = eyepoints_from_arrays(eyepoint_results, eyepoints.beamlet_weights)
    tiling = study.scanner_grids[eyepoints.scanner]
    for *axes, draws in np.ndindex(*tiling.blocks_per_dim[:-1]):
        tile = tiling.flight_block(tiling.block_at((*axes, draws, 0)))
        selected = study.select_effects(tile, shots, np.arange(len(shots.time)))
        assert np.isfinite(selected.error_bound).all() and (selected.error_bound >= 0).all(), (
            "effects_error"
        )
        cloud = study.simulate_shots(tile, eyepoint_results, shots, selected, shot_numbers)
        check_point_cloud(
            eyepoint_results,
            cloud,
            navigates=tiling.can_solve_navigation,
            undefined=_undefined_statistics(study, tile),
        )


def _undefined_statistics(study: FlightStudy, tile: FlightBlock) -> set[str]:
    """Names of statistics that no shot of a block has."""
    parameters, undefined = study.parameters_at(tile), set()
    architecture, order = (
        str(parameters[f"instrument.{name}"])
        for name in ("receiver.architecture", "chirp.segments")
    )
    if "doppler" not in existing_segments(architecture, order):
        undefined.add("pd_doppler")
    if study.ray_error_budget is None:
        undefined.add("beamlets_error")
    is_threshold = (
        parameters.get(DETECTOR_PREFIX + "kind", FIXED_THRESHOLD_KIND) == FIXED_THRESHOLD_KIND
    )
    has_probabilities = is_threshold and parameters.get(REPORTED_PEAKS_PATH) != STRONGEST_PEAK
    if study.spec.draws.draws_whole_spectra and not has_probabilities:
        undefined |= {name for name in SHOT_STATISTIC_VARIABLES if name.startswith(("pd_", "pfa_"))}
    return undefined


HIT_ONLY_OUTPUTS = ("beam_radial_velocity", "beam_acceleration", "beam_approach", "beam_turn_rate")
"""Quantities of a beam that a beam which hits nothing has not."""


def check_shots(eyepoint_results: Results) -> None:
    """Where the instrument is and what its beams hit: numbers throughout, but for misses."""
    for name in (*SHOT_GEOMETRY_VARIABLES, *CYCLE_VARIABLES):
        is_missing = (
            np.isinf(eyepoint_results[name]) if name in ("beam_range", "true_altitude") else False
        )
        if name in HIT_ONLY_OUTPUTS:
            is_missing = np.isnan(eyepoint_results[name]) & np.isinf(eyepoint_results["beam_range"])
        assert (np.isfinite(eyepoint_results[name]) | is_missing).all(), f"{name} is not finite"
    length = np.linalg.norm(eyepoint_results["beam_direction"], axis=-1)
    assert (np.abs(length - 1) < UNIT_LENGTH_TOLERANCE).all(), "beam_direction is no unit vector"
    assert (eyepoint_results["beam_range"] > 0).all(), "beam_range"
    has_hit = eyepoint_results["surface"] >= 0
    cosine = eyepoint_results["cos_incidence"][has_hit]
    assert ((cosine >= 0) & (cosine <= 1 + UNIT_LENGTH_TOLERANCE)).all(), "cos_incidence"
    assert np.isfinite(eyepoint_results["offset"][has_hit]).all(), "offset"


def check_point_cloud(
    eyepoint_results: Results, cloud: Results, *, navigates: bool, undefined: Collection[str]
) -> None:
    """Statistics, points and navigation: nan where there is nothing, and nowhere else."""
    expected_outputs = {
        *SHOT_STATISTIC_VARIABLES,
        *POINT_CLOUD_VARIABLES,
        *(NAVIGATION_VARIABLES if navigates else ()),
    }
    assert set(cloud) == expected_outputs, "outputs are missing, or too many"
    sees_surface = (eyepoint_results["surface"] >= 0).any(axis=1)
    for name in SHOT_STATISTIC_VARIABLES:
        values = cloud[name]
        if values.dtype.kind != "f":
            continue
        is_defined = sees_surface | name.startswith("pfa_")
        if name in undefined:
            is_defined = np.zeros_like(sees_surface)
        assert np.isfinite(values[is_defined]).all(), f"{name} is nan for no reason"
        assert np.isnan(values[~is_defined]).all(), f"{name} of nothing"
        if name.startswith(("pd_", "pfa_")):
            assert ((values[is_defined] >= 0) & (values[is_defined] <= 1)).all(), (
                f"{name}: {values[is_defined]}"
            )
    _check_points(cloud, sees_surface)
    if navigates:
        _check_navigation(cloud)


def _check_points(cloud: Results, sees_surface: np.ndarray) -> None:
    """Points where flags say so."""
    flags = cloud["flags"]
    is_point, is_true_point = flags > 0, (flags & 1) > 0
    for name, output in POINT_CLOUD_VARIABLES.items():
        values = cloud[name]
        if output.dtype != "float64":
            continue
        is_defined = is_point if values.ndim == is_point.ndim else is_point[..., None]
        assert not (~np.isnan(values) & ~is_defined).any(), f"{name} where there is no point"
        if name in ("range", "range_interpolated", "position", "snr"):
            assert np.isfinite(values[is_point]).all(), f"{name} is not finite"
        if name.endswith("standard_error"):
            assert not (values[is_point] < 0).any(), name
    pd = cloud["pd"][is_true_point]
    assert ((pd >= 0) & (pd <= 1)).all(), "pd of a point"
    assert np.isfinite(cloud["true_range"][is_true_point]).all(), "true_range of a true point"


def _check_navigation(cloud: Results) -> None:
    """Solutions with variances that can be, and none without a status."""
    velocity, covariance = cloud["velocity"], cloud["velocity_covariance"]
    is_solved = cloud["velocity_beams"] > 0
    assert np.isnan(velocity[~is_solved]).all(), "a velocity of no beams"
    assert np.isfinite(velocity[is_solved]).all(), "velocity"
    variances = np.diagonal(covariance[is_solved], axis1=-2, axis2=-1)
    assert (variances >= 0).all(), "velocity_covariance"
    has_altitude = cloud["altitude_beams"] > 0
    assert np.isfinite(cloud["altitude"][has_altitude]).all(), "altitude"
    assert (cloud["altitude_variance"][has_altitude] >= 0).all(), "altitude_variance"
