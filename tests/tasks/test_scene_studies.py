"""Studies of scenes from spec to store: same bytes anywhere, rays cast once, nothing lost."""

import math
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr
from small_flights import SCENE_MAPPING, small_scene_spec
from small_studies import (
    file_digests,
    logged_blocks,
    make_logging_evaluate,
    receipt_blocks,
    run_serially,
)
from test_driver import StopAfter

from sweep.model.geometry.ray_casting import RayCaster
from sweep.model.outputs import (
    CYCLE_VARIABLES,
    EFFECT_VARIABLES,
    NAVIGATION_VARIABLES,
    POINT_CLOUD_VARIABLES,
    SHOT_GEOMETRY_VARIABLES,
    SHOT_STATISTIC_VARIABLES,
)
from sweep.storage.locations import eyepoint_store_location
from sweep.tasks.driver import resume, run
from sweep.tasks.engine.journal import StoreLock
from sweep.tasks.engine.progress import Progress, StoreError
from sweep.tasks.engine.study_store import create_store
from sweep.tasks.studies import eyepoint_study
from sweep.tasks.studies.eyepoint_study import EyepointStudy
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.parameter_grid import (
    DEFAULT_BLOCK_DRAWS_MAX,
    SHOTS_PER_TILE,
    flight_block_size_max,
    worst_cpu_seconds_per_draw,
)
from sweep.tasks.studies.store_summary import flight_summary, status
from sweep.tasks.studies.study_plan import plan_study


@pytest.fixture(autouse=True)
def small_eyepoint_blocks(monkeypatch):
    """Several blocks of eyepoints a scanner, where the study itself is small."""
    monkeypatch.setattr(eyepoint_study, "SHOTS_PER_BLOCK_MAX", 96)


@pytest.fixture(scope="module")
def serial_outcome(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(eyepoint_study, "SHOTS_PER_BLOCK_MAX", 96)
        outcome = run_serially(
            small_scene_spec(), tmp_path_factory.mktemp("undisturbed") / "scene.zarr"
        )
    assert outcome.complete
    return outcome


def opened(path):
    return xr.open_datatree(path, engine="zarr")


@pytest.fixture
def no_rays(monkeypatch):
    """A caster that can't be used."""

    def refuse(self, *_, **__):
        raise AssertionError("a ray was cast")

    monkeypatch.setattr(RayCaster, "cast_bundles", refuse)


def test_a_study_holds_every_array_that_the_model_names(serial_outcome):
    dataset = opened(serial_outcome.store)
    assert set(dataset.children) == {"three", "line", "scene_map"}
    assert set(dataset["scene_map"].data_vars) == {"height"}
    assert set(dataset["three"].data_vars) == {
        *SHOT_GEOMETRY_VARIABLES,
        *CYCLE_VARIABLES,
        *SHOT_STATISTIC_VARIABLES,
        *EFFECT_VARIABLES,
        *POINT_CLOUD_VARIABLES,
        *NAVIGATION_VARIABLES,
    }
    assert set(dataset["line"].data_vars) == {
        *SHOT_GEOMETRY_VARIABLES,
        *CYCLE_VARIABLES,
        *SHOT_STATISTIC_VARIABLES,
        *EFFECT_VARIABLES,
        *POINT_CLOUD_VARIABLES,
    }
    three = dataset["three"]
    assert three.range.dims == ("power", "shot", "draw", "return_number")
    assert three.range.shape == (2, 222, 5, 3) and three.velocity.shape == (2, 74, 5, 3)
    assert three.power.values.tolist() == [0.01, 1.0] and three.power.units == "W"
    assert dataset.attrs["surfaces"] == ["ground", "stone"]
    assert not np.isnan(three.pd_shot).any() and (three.velocity_status >= 0).all()
    assert set(np.unique(three.beam_surface)) == {0, 1}  # the stone is seen, and the ground


def test_rays_are_counted_as_they_are_cast(serial_outcome):
    assert serial_outcome.rays_by_scanner == {"three": 222 * 7 + 74, "line": 148 * 7 + 148}
    study = FlightStudy(small_scene_spec(), serial_outcome.store)
    for eyepoints in study.eyepoint_studies():
        store = eyepoint_store_location(serial_outcome.store, eyepoints.id)
        assert sorted(receipt_blocks(store)) == list(range(eyepoints.n_blocks))
        assert eyepoints.n_blocks > 1


@pytest.mark.parametrize(
    "place",
    [{"workers": 2, "processes": False}, pytest.param({"workers": 2}, marks=pytest.mark.slow)],
)
def test_workers_make_the_same_bytes_as_a_plain_loop(serial_outcome, tmp_path, monkeypatch, place):
    if place.get("processes", True):  # worker processes cut eyepoints as they are installed
        monkeypatch.undo()
    outcome = run_serially(small_scene_spec(), tmp_path / "scene.zarr", **place)
    assert outcome.complete and file_digests(outcome.store) == file_digests(serial_outcome.store)
    if not place.get("processes", True):
        serial_eyepoints, local_eyepoints = (
            path.parent / "eyepoints" for path in (serial_outcome.store, outcome.store)
        )
        assert file_digests(local_eyepoints) == file_digests(serial_eyepoints)


@pytest.mark.slow
def test_bits_do_not_depend_on_the_number_of_threads_of_the_libraries(serial_outcome, tmp_path):
    script = (
        "from small_flights import small_scene_spec; from sweep.tasks.driver import run;"
        f"run(small_scene_spec(), store={str(tmp_path / 'one.zarr')!r}, scheduler='none',"
        " progress=False)"
    )
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {**os.environ, "PYTHONPATH": os.path.dirname(__file__)}
    subprocess.run(
        [sys.executable, "-c", script], check=True, env=environment | dict.fromkeys(names, "1")
    )
    assert file_digests(tmp_path / "one.zarr") == file_digests(serial_outcome.store)


def test_another_radiometry_of_the_same_geometry_casts_no_ray(
    serial_outcome, tmp_path, monkeypatch
):
    shutil.copytree(serial_outcome.store.parent / "eyepoints", tmp_path / "eyepoints")
    objects = {
        name: thing | {"reflectance": 0.02, "reflectance_law": "lommel_seeliger"}
        for name, thing in SCENE_MAPPING["scene"]["objects"].items()
    }
    other = small_scene_spec(
        scene=SCENE_MAPPING["scene"] | {"objects": objects},
        draws={"number": 2},
        instrument=SCENE_MAPPING["instrument"]
        | {"telescope": {"aperture": "20 mm", "coupling": "aperture"}},
        title="Darker",
    )
    looks = []
    # Warnings are of a few rays, before the geometry is looked for.
    monkeypatch.setattr(
        "sweep.tasks.studies.study_warnings.issue_study_warnings", lambda study, say: None
    )
    monkeypatch.setattr(
        "sweep.model.pointcloud.eyepoints.compute_eyepoints", lambda *a, **k: looks.append(a)
    )
    outcome = run_serially(other, tmp_path / "darker.zarr")
    assert outcome.complete and outcome.rays_by_scanner == {"three": 0, "line": 0} and not looks
    dark, bright = opened(outcome.store)["three"], opened(serial_outcome.store)["three"]
    assert (dark.snr_up.isel(power=1) < bright.snr_up.isel(power=1)).all()
    assert dark.beam_range.equals(bright.beam_range)


def test_another_geometry_is_cast_again(serial_outcome, tmp_path):
    first = small_scene_spec()
    for changes in (
        {"footprint": {"beamlets": 8, "speckle": "none"}},
        {"platform": SCENE_MAPPING["platform"] | {"jitter": "10 urad"}},
        {"platform": SCENE_MAPPING["platform"] | {"lever_arm": ["0 m", "0 m", "1 m"]}},
    ):
        assert small_scene_spec(**changes).geometry_id("three") != first.geometry_id("three")
    assert small_scene_spec(seed=9).geometry_id("three") == first.geometry_id("three")
    renamed = {"tripod": SCENE_MAPPING["scanners"]["three"]}
    assert small_scene_spec(scanners=renamed).geometry_id("tripod") == first.geometry_id("three")


@pytest.mark.parametrize("points", [60, 500])
def test_an_interrupted_study_resumes_to_the_same_bytes(serial_outcome, tmp_path, points):
    """After 60 shots rays are still being cast; after 500 the cloud is being made."""
    path, log = tmp_path / "scene.zarr", tmp_path / "log"
    outcome = run(
        small_scene_spec(), store=path, scheduler="none", progress=StopUnder(points),
        evaluate=make_logging_evaluate(log),
    )  # fmt: skip
    assert not outcome.complete and outcome.stop_reason
    assert ("eyepoints" in outcome.stop_reason) == (points == 60)
    assert status(path).blocks_done == outcome.blocks_done
    assert resume(
        path, progress=False, scheduler="none", evaluate=make_logging_evaluate(log)
    ).complete
    eyepoints = [EyepointStudy(small_scene_spec(), name) for name in ("three", "line")]
    blocks = sum(study.n_blocks for study in eyepoints) + outcome.blocks
    assert len(logged_blocks(log)) == blocks  # none was computed twice
    assert file_digests(path) == file_digests(serial_outcome.store)


class StopUnder(StopAfter):
    """Progress that asks to stop once, as the points fall under zero."""

    def advance(self, *, points, failed):
        under, self.points = self.points <= 0, self.points - points
        if points and not under and self.points <= 0:
            os.kill(os.getpid(), 2)


def test_lost_chunks_of_either_store_are_computed_again(serial_outcome, tmp_path):
    shutil.copytree(serial_outcome.store.parent, tmp_path / "copy")
    path = tmp_path / "copy" / "scene.zarr"
    (path / "three" / "flags" / "c" / "1" / "1" / "0" / "0").unlink()
    eyepoints = eyepoint_store_location(path, small_scene_spec().geometry_id("three"))
    (eyepoints / "offset" / "c" / "1" / "0").unlink()
    outcome = resume(path, progress=False, scheduler="none")
    assert outcome.complete and outcome.blocks_computed == 1
    assert outcome.rays_by_scanner == {"three": 96 * 7 + 32, "line": 0}
    assert file_digests(tmp_path / "copy") == file_digests(serial_outcome.store.parent)


def test_eyepoints_under_a_wrong_name_or_of_other_software_are_refused(serial_outcome, tmp_path):
    shutil.copytree(serial_outcome.store.parent / "eyepoints", tmp_path / "eyepoints")
    spec = small_scene_spec()
    one, other = (
        eyepoint_store_location(tmp_path / "x.zarr", spec.geometry_id(n)) for n in spec.scanners
    )
    shutil.rmtree(one)
    os.rename(other, one)
    with pytest.raises(StoreError, match="holds other eyepoints than its name says"):
        run_serially(spec, tmp_path / "x.zarr")
    with pytest.raises(StoreError, match="holds eyepoints"):
        resume(one, progress=False, scheduler="none")


@pytest.mark.parametrize(
    "is_complete",
    [False, pytest.param(True, marks=pytest.mark.slow)],
    ids=["in part", "to their end"],
)
def test_rays_that_another_run_casts_are_waited_for_and_used(serial_outcome, tmp_path, is_complete):
    path = tmp_path / "scene.zarr"
    study = EyepointStudy(small_scene_spec(), "three")
    eyepoint_store = eyepoint_store_location(path, study.id)
    lock = StoreLock(create_store(eyepoint_store, study))

    class Other(Progress):
        """The other run, which goes on when this one waits."""

        def say(self, text):
            if "waiting for rays" in text:
                if is_complete:
                    cast = eyepoint_store_location(serial_outcome.store, study.id)
                    shutil.copytree(cast, eyepoint_store, dirs_exist_ok=True)
                lock.release()

    outcome = run(small_scene_spec(), store=path, scheduler="none", progress=Other())
    assert outcome.complete
    assert outcome.rays_by_scanner == serial_outcome.rays_by_scanner | (
        {"three": 0} if is_complete else {}
    )
    assert file_digests(tmp_path) == file_digests(serial_outcome.store.parent)


def test_a_plan_counts_what_the_run_makes(serial_outcome, tmp_path):
    plan = plan_study(small_scene_spec(), store_path=tmp_path / "none.zarr", n_workers=2)
    assert {s.name: s.n_rays for s in plan.scanners} == serial_outcome.rays_by_scanner
    assert plan.n_blocks == serial_outcome.blocks and not plan.scanners[0].has_eyepoints
    chunks = [p for p in serial_outcome.store.rglob("c/**/*") if p.is_file()]
    known = [p for p in chunks if "scene_map" in str(p) or "power" in str(p)]
    assert plan.n_chunks == len(chunks) - len(known)
    assert plan.nbytes == sum(
        array.nbytes for group, child in opened(serial_outcome.store).children.items()
        for array in child.data_vars.values() if group != "scene_map"
    )  # fmt: skip
    assert plan_study(small_scene_spec(), store_path=serial_outcome.store).scanners[0].has_eyepoints


def test_the_summary_counts_what_the_arrays_hold(serial_outcome):
    dataset = opened(serial_outcome.store)
    rows = {row.label: row for row in flight_summary(serial_outcome.store)}
    assert len(rows) == 4
    weak = rows["three, power 0.01 W"]
    flags = dataset["three"].flags.values[0]
    assert (
        weak.n_drawn_shots == 222 * 5
        and weak.n_shots_with_true_return == ((flags & 1) > 0).any(axis=-1).sum()
    )
    assert weak.n_false_points == ((flags > 0) & (flags & 1 == 0)).sum()
    assert weak.mean_pd == pytest.approx(float(dataset["three"].pd_shot[0].mean()), rel=1e-12)
    assert weak.n_drawn_cycles == 74 * 5
    assert weak.n_solved_cycles == (dataset["three"].velocity_status.values[0] <= 1).sum()
    strong = rows["three, power 1 W"]
    assert (
        strong.n_shots_with_true_return
        == ((dataset["three"].flags.values[1] & 1) > 0).any(axis=-1).sum()
    )
    # In one draw of a hundred a leaked peak pairs with the echo; whole spectra have it too.
    assert (
        weak.n_shots_with_true_return < strong.n_shots_with_true_return
        and 0.98 * 222 * 5 < strong.n_shots_with_true_return <= strong.n_drawn_shots == 222 * 5
    )
    assert rows["line, power 1 W"].n_drawn_cycles == 0


def test_the_summary_of_an_incomplete_flight_counts_committed_blocks_only(serial_outcome, tmp_path):
    """One block is committed; another has its points written, and no velocity yet."""
    store = shutil.copytree(serial_outcome.store, tmp_path / "copy.zarr")
    log = store / ".sweep" / "receipts.jsonl"
    first = next(line for line in log.read_text().splitlines(True) if '"block":0,' in line)
    log.write_text(first)
    for chunk in (store / "three" / "velocity_status" / "c").rglob("*"):
        if chunk.is_file() and chunk.parts[-3:] != ("0", "0", "0"):
            chunk.unlink()
    rows = {row.label: row for row in flight_summary(store)}
    weak, strong = rows["three, power 0.01 W"], rows["three, power 1 W"]
    assert (weak.n_drawn_shots, weak.n_drawn_cycles) == (120 * 3, 40 * 3)
    status = opened(serial_outcome.store)["three"].velocity_status.values[0, :40, :3]
    assert weak.n_solved_cycles == (status <= 1).sum()
    assert (
        strong.n_drawn_shots
        == strong.n_drawn_cycles
        == strong.n_solved_cycles
        == rows["line, power 1 W"].n_drawn_shots
        == 0
    )


def test_a_beam_that_sees_nothing_has_no_chance_and_its_study_runs(tmp_path):
    """A plane of 300 m under beams at 22.5 deg, which see it from below 360 m alone."""
    objects = {"ground": {"kind": "plane", "size": "300 m", "reflectance": 0.1}}
    spec = small_scene_spec(
        scene={"origin": "ground", "objects": objects},
        scanners={"three": SCENE_MAPPING["scanners"]["three"]},
        axes={},
    )
    dataset = opened(run_serially(spec, tmp_path / "scene.zarr").store)["three"]
    unseen = ~np.isfinite(dataset.beam_range.values)
    assert 0.5 < unseen.mean() < 1 and np.isfinite(dataset.true_altitude.values).all()
    assert np.isnan(dataset.pd_shot.values[unseen]).all()
    assert not (dataset.flags.values[unseen] & 1).any()


@pytest.mark.parametrize("n_draws", [1, 10, 64, 65, 100, 1000])
@pytest.mark.parametrize("n_shots", [40, 300, 3008])
def test_default_blocks_hold_about_equal_numbers_of_draws(n_draws: int, n_shots: int) -> None:
    spec = small_scene_spec(draws={"number": n_draws}, storage={})
    block_shots, block_draws = flight_block_size_max(spec, 1, n_shots, n_draws)
    n_blocks = math.ceil(n_draws / block_draws)
    assert block_draws <= DEFAULT_BLOCK_DRAWS_MAX
    assert n_blocks * block_draws - n_draws < n_blocks
    assert block_shots % SHOTS_PER_TILE == 0
    if block_shots < min(n_shots, 4096):  # there are shots for a longer block
        assert block_shots * block_draws * worst_cpu_seconds_per_draw(spec) >= 0.5
