"""Plans of flights: shots are counted, few are timed, and the parts of the time are its sum."""

import numpy as np
import pytest
from small_flights import small_scene_spec

from sweep.cli import terminal
from sweep.tasks.studies import study_plan
from sweep.tasks.studies.eyepoint_study import EyepointStudy
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.study_plan import plan_study


@pytest.fixture(autouse=True)
def kernels_count_as_compiled(monkeypatch):
    """Plans of a fresh kernel cache would time no shot."""
    monkeypatch.setattr(study_plan, "are_flight_kernels_compiled", lambda spec: True)


def test_the_parts_of_the_time_are_its_sum(tmp_path):
    plan = plan_study(small_scene_spec(), store_path=tmp_path / "a.zarr", n_workers=2)
    names = {part.name for part in plan.time_parts}
    assert names >= {"start", "scene", "checks", "compiling", "model", "rays", "shots", "writing"}
    assert plan.cpu_seconds == sum(part.cpu_seconds for part in plan.time_parts)
    assert all(part.cpu_seconds >= 0 and 1 <= part.n_parallel <= 2 for part in plan.time_parts)
    assert plan.wall_to_cpu_time_ratio >= 1
    wall_seconds = plan.wall_to_cpu_time_ratio * sum(
        p.cpu_seconds / p.n_parallel for p in plan.time_parts
    )
    assert plan.wall_seconds == study_plan.WORKER_START_SECONDS + wall_seconds
    text = terminal._time_parts_text(plan)
    assert "shots" in text and "compil" not in text


def test_a_plan_times_a_bounded_number_of_shots_and_rays(tmp_path, monkeypatch):
    """The limit does not depend on the length of the flight."""
    cast = []
    cast_eyepoints = EyepointStudy.cast_eyepoints

    def counted(study, shot_numbers):
        cast.append(len(shot_numbers) * study.n_beamlets)
        return cast_eyepoints(study, shot_numbers)

    monkeypatch.setattr(EyepointStudy, "cast_eyepoints", counted)
    monkeypatch.setattr(study_plan, "FLIGHT_TIMING_SECONDS", 1e-3)
    scanner = {"kind": "cone", "beams": 3, "half_angle": "20 deg", "rate": "2 kHz"}
    spec = small_scene_spec(scanners={"three": scanner}, axes={}, draws={"number": 1})
    plan = plan_study(spec, store_path=tmp_path / "a.zarr")
    assert plan.scanners[0].n_rays > 2 * sum(cast)
    assert plan.scanners[0].n_timed_shots <= study_plan.TIMED_SHOT_DRAWS_MAX


def test_a_plan_times_a_bounded_number_of_draws(tmp_path, monkeypatch):
    timed, simulate_shots = [], FlightStudy.simulate_shots

    def counted(study, flight_block, *arguments, **keywords):
        timed.append(len(flight_block.draws))
        return simulate_shots(study, flight_block, *arguments, **keywords)

    monkeypatch.setattr(FlightStudy, "simulate_shots", counted)
    monkeypatch.setattr(study_plan, "TIMED_DRAWS_MAX", 2)
    plan = plan_study(small_scene_spec(axes={}, draws={"number": 40}), store_path=tmp_path / "a")
    assert timed and set(timed) == {2}
    assert plan.scanners[0].seconds_per_draw > 0


@pytest.mark.parametrize("n_cycles", [1, 2, 7, 1000])
def test_sampled_cycles_are_spread_over_the_flight(n_cycles):
    study = EyepointStudy(small_scene_spec(), "three")
    shots = study.shot_numbers_of_evenly_spaced_cycles(n_cycles)
    cycles = np.unique(shots // study.shots_per_cycle)
    assert len(cycles) == min(n_cycles, study.n_cycles)
    assert len(shots) == len(cycles) * study.shots_per_cycle
    assert abs(cycles.mean() - (study.n_cycles - 1) / 2) <= 1
    assert np.ptp(np.diff(cycles)) <= 1 if n_cycles > 2 else True


def test_a_part_of_a_long_cycle_is_timed(tmp_path):
    scanner = {"kind": "raster", "columns": 200, "rows": 200, "half_angles": ["9 deg", "9 deg"]}
    spec = small_scene_spec(scanners={"wide": scanner | {"rate": "0.1 Hz"}}, axes={})
    (scanner_plan,) = plan_study(spec, store_path=tmp_path / "a.zarr").scanners
    assert 0 < scanner_plan.n_timed_shots <= study_plan.TIMED_SHOT_DRAWS_MAX
    assert scanner_plan.n_shots >= 40_000 > scanner_plan.n_timed_shots


def test_without_kernels_no_shot_is_simulated_and_the_plan_says_so(tmp_path, monkeypatch):
    def refuse(*arguments):
        raise AssertionError("a shot is simulated")

    monkeypatch.setattr(study_plan, "are_flight_kernels_compiled", lambda spec: False)
    monkeypatch.setattr(study_plan.FlightStudy, "simulate_shots", refuse)
    plan = plan_study(small_scene_spec(), store_path=tmp_path / "a.zarr")
    seconds = {part.name: part.cpu_seconds for part in plan.time_parts}
    assert seconds["compiling"] == study_plan.FLIGHT_COMPILE_CPU_SECONDS
    assert not plan.are_kernels_compiled and "not compiled" in terminal._time_parts_text(plan)
    assert plan.cpu_seconds > study_plan.FLIGHT_COMPILE_CPU_SECONDS
