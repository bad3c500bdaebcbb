"""Studies of scenes from spec to store: same bytes anywhere, rays cast once, nothing lost."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr
from small import evaluated, logged, quiet, receipts, tree
from small_flights import SCENE, small_scene
from test_driver import StopAfter

from sweep.model.geometry.rays import Caster
from sweep.model.outputs import CYCLES, NAVIGATION, POINTS, SHOTS, SIMULATED, STATISTICS
from sweep.storage.locations import eyepoints_path
from sweep.tasks import eyepoint_study
from sweep.tasks.driver import resume, run
from sweep.tasks.eyepoint_study import EyepointStudy
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.journal import Lock
from sweep.tasks.plan import plan
from sweep.tasks.progress import Progress, StoreError
from sweep.tasks.store import create
from sweep.tasks.summary import scene_summary, status


@pytest.fixture(autouse=True)
def small_eyepoint_blocks(monkeypatch):
    """Several blocks of eyepoints a scanner, where the study itself is small."""
    monkeypatch.setattr(eyepoint_study, "BLOCK_SHOTS", 96)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(eyepoint_study, "BLOCK_SHOTS", 96)
        outcome = quiet(small_scene(), tmp_path_factory.mktemp("undisturbed") / "scene.zarr")
    assert outcome.complete
    return outcome


def opened(path):
    return xr.open_datatree(path, engine="zarr")


@pytest.fixture
def no_rays(monkeypatch):
    """A caster that can't be used."""

    def refuse(self, *_, **__):
        raise AssertionError("a ray was cast")

    monkeypatch.setattr(Caster, "cast", refuse)
    monkeypatch.setattr(Caster, "bundle", refuse)


def test_a_study_holds_every_array_that_the_model_names(undisturbed):
    found = opened(undisturbed.store)
    assert set(found.children) == {"three", "line", "scene_map"}
    assert set(found["scene_map"].data_vars) == {"height"}
    assert set(found["three"].data_vars) == {
            *SHOTS, *CYCLES, *STATISTICS, *SIMULATED, *POINTS, *NAVIGATION,
        }  # fmt: skip
    assert set(found["line"].data_vars) == {*SHOTS, *CYCLES, *STATISTICS, *SIMULATED, *POINTS}
    three = found["three"]
    assert three.range.dims == ("power", "shot", "draw", "return_number")
    assert three.range.shape == (2, 222, 5, 3) and three.velocity.shape == (2, 74, 5, 3)
    assert three.power.values.tolist() == [0.01, 1.0] and three.power.units == "W"
    assert found.attrs["surfaces"] == ["ground", "stone"]
    assert not np.isnan(three.pd_shot).any() and (three.velocity_status >= 0).all()
    assert set(np.unique(three.beam_surface)) == {0, 1}  # the stone is seen, and the ground


def test_rays_are_counted_as_they_are_cast(undisturbed):
    assert undisturbed.rays == {"three": 222 * 7 + 74, "line": 148 * 7 + 148}
    plain = FlightStudy(small_scene(), undisturbed.store)
    for eyepoints in plain.eyepoint_studies():
        store = eyepoints_path(undisturbed.store, eyepoints.id)
        assert sorted(receipts(store)) == list(range(eyepoints.n_blocks))
        assert eyepoints.n_blocks > 1


@pytest.mark.parametrize(
    "place",
    [{"workers": 2, "processes": False}, pytest.param({"workers": 2}, marks=pytest.mark.slow)],
)
def test_workers_make_the_same_bytes_as_a_plain_loop(undisturbed, tmp_path, monkeypatch, place):
    if place.get("processes", True):  # worker processes cut eyepoints as they are installed
        monkeypatch.undo()
    outcome = quiet(small_scene(), tmp_path / "scene.zarr", **place)
    assert outcome.complete and tree(outcome.store) == tree(undisturbed.store)
    if not place.get("processes", True):
        there, here = (path.parent / "eyepoints" for path in (undisturbed.store, outcome.store))
        assert tree(here) == tree(there)


@pytest.mark.slow
def test_bits_do_not_depend_on_the_number_of_threads_of_the_libraries(undisturbed, tmp_path):
    script = (
        "from small_flights import small_scene; from sweep.tasks.driver import run;"
        f"run(small_scene(), store={str(tmp_path / 'one.zarr')!r}, scheduler='none',"
        " progress=False)"
    )
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {**os.environ, "PYTHONPATH": os.path.dirname(__file__)}
    subprocess.run(
        [sys.executable, "-c", script], check=True, env=environment | dict.fromkeys(names, "1")
    )
    assert tree(tmp_path / "one.zarr") == tree(undisturbed.store)


def test_another_radiometry_of_the_same_geometry_casts_no_ray(undisturbed, tmp_path, monkeypatch):
    shutil.copytree(undisturbed.store.parent / "eyepoints", tmp_path / "eyepoints")
    objects = {
        name: thing | {"reflectance": 0.02, "reflectance_law": "lommel_seeliger"}
        for name, thing in SCENE["scene"]["objects"].items()
    }
    other = small_scene(
        scene=SCENE["scene"] | {"objects": objects},
        draws={"number": 2},
        instrument=SCENE["instrument"]
        | {"telescope": {"aperture": "20 mm", "coupling": "aperture"}},
        title="Darker",
    )
    looks = []
    # Warnings are of a few rays, before the geometry is looked for.
    monkeypatch.setattr("sweep.tasks.doubts.tell_doubts", lambda study, say: None)
    monkeypatch.setattr("sweep.model.eyepoints.observe", lambda *a, **k: looks.append(a))
    outcome = quiet(other, tmp_path / "darker.zarr")
    assert outcome.complete and outcome.rays == {"three": 0, "line": 0} and not looks
    dark, bright = opened(outcome.store)["three"], opened(undisturbed.store)["three"]
    assert (dark.snr_up.isel(power=1) < bright.snr_up.isel(power=1)).all()
    assert dark.beam_range.equals(bright.beam_range)


def test_another_geometry_is_cast_anew(undisturbed, tmp_path):
    first = small_scene()
    for changes in (
        {"footprint": {"beamlets": 8, "speckle": "none"}},
        {"platform": SCENE["platform"] | {"jitter": "10 urad"}},
        {"platform": SCENE["platform"] | {"lever_arm": ["0 m", "0 m", "1 m"]}},
    ):
        assert small_scene(**changes).geometry_id("three") != first.geometry_id("three")
    assert small_scene(seed=9).geometry_id("three") == first.geometry_id("three")
    renamed = {"tripod": SCENE["scanners"]["three"]}
    assert small_scene(scanners=renamed).geometry_id("tripod") == first.geometry_id("three")


@pytest.mark.parametrize("points", [60, 500])
def test_an_interrupted_study_resumes_to_the_same_bytes(undisturbed, tmp_path, points):
    """After 60 shots rays are still being cast; after 500 the cloud is being made."""
    path, log = tmp_path / "scene.zarr", tmp_path / "log"
    outcome = run(
        small_scene(), store=path, scheduler="none", progress=StopUnder(points),
        evaluate=logged(log),
    )  # fmt: skip
    assert not outcome.complete and outcome.stopped
    assert ("eyepoints" in outcome.stopped) == (points == 60)
    assert status(path).blocks_done == outcome.blocks_done
    assert resume(path, progress=False, scheduler="none", evaluate=logged(log)).complete
    eyepoints = [EyepointStudy(small_scene(), name) for name in ("three", "line")]
    blocks = sum(study.n_blocks for study in eyepoints) + outcome.blocks
    assert len(evaluated(log)) == blocks  # none was computed twice
    assert tree(path) == tree(undisturbed.store)


class StopUnder(StopAfter):
    """Progress that asks to stop once, as the points fall under zero."""

    def advance(self, *, points, failed):
        under, self.points = self.points <= 0, self.points - points
        if points and not under and self.points <= 0:
            os.kill(os.getpid(), 2)


def test_lost_chunks_of_either_store_are_computed_again(undisturbed, tmp_path):
    shutil.copytree(undisturbed.store.parent, tmp_path / "copy")
    path = tmp_path / "copy" / "scene.zarr"
    (path / "three" / "flags" / "c" / "1" / "1" / "0" / "0").unlink()
    eyepoints = eyepoints_path(path, small_scene().geometry_id("three"))
    (eyepoints / "offset" / "c" / "1" / "0").unlink()
    outcome = resume(path, progress=False, scheduler="none")
    assert outcome.complete and outcome.blocks_computed == 1
    assert outcome.rays == {"three": 96 * 7 + 32, "line": 0}
    assert tree(tmp_path / "copy") == tree(undisturbed.store.parent)


def test_eyepoints_under_a_wrong_name_or_of_other_software_are_refused(undisturbed, tmp_path):
    shutil.copytree(undisturbed.store.parent / "eyepoints", tmp_path / "eyepoints")
    spec = small_scene()
    one, other = (eyepoints_path(tmp_path / "x.zarr", spec.geometry_id(n)) for n in spec.scanners)
    shutil.rmtree(one)
    os.rename(other, one)
    with pytest.raises(StoreError, match="holds other eyepoints than its name says"):
        quiet(spec, tmp_path / "x.zarr")
    with pytest.raises(StoreError, match="holds eyepoints"):
        resume(one, progress=False, scheduler="none")


@pytest.mark.parametrize(
    "whole",
    [False, pytest.param(True, marks=pytest.mark.slow)],
    ids=["in part", "to their end"],
)
def test_rays_that_another_run_casts_are_waited_for_and_used(undisturbed, tmp_path, whole):
    path = tmp_path / "scene.zarr"
    study = EyepointStudy(small_scene(), "three")
    theirs = eyepoints_path(path, study.id)
    lock = Lock(create(theirs, study))

    class Other(Progress):
        """The other run, which goes on when this one waits."""

        def say(self, text):
            if "waiting for rays" in text:
                if whole:
                    cast = eyepoints_path(undisturbed.store, study.id)
                    shutil.copytree(cast, theirs, dirs_exist_ok=True)
                lock.release()

    outcome = run(small_scene(), store=path, scheduler="none", progress=Other())
    assert outcome.complete
    assert outcome.rays == undisturbed.rays | ({"three": 0} if whole else {})
    assert tree(tmp_path) == tree(undisturbed.store.parent)


def test_a_plan_counts_what_the_run_makes(undisturbed, tmp_path):
    found = plan(small_scene(), store=tmp_path / "none.zarr", workers=2)
    assert {s.name: s.rays for s in found.scanners} == undisturbed.rays
    assert found.blocks == undisturbed.blocks and not found.scanners[0].is_cast
    chunks = [p for p in undisturbed.store.rglob("c/**/*") if p.is_file()]
    known = [p for p in chunks if "scene_map" in str(p) or "power" in str(p)]
    assert found.chunks == len(chunks) - len(known)
    assert found.bytes == sum(
        array.nbytes for group, child in opened(undisturbed.store).children.items()
        for array in child.data_vars.values() if group != "scene_map"
    )  # fmt: skip
    assert plan(small_scene(), store=undisturbed.store).scanners[0].is_cast


def test_the_summary_counts_what_the_arrays_hold(undisturbed):
    found = opened(undisturbed.store)
    rows = {row.part: row for row in scene_summary(undisturbed.store)}
    assert len(rows) == 4
    weak = rows["three, power 0.01 W"]
    flags = found["three"].flags.values[0]
    assert weak.shots == 222 * 5 and weak.true == ((flags & 1) > 0).any(axis=-1).sum()
    assert weak.false == ((flags > 0) & (flags & 1 == 0)).sum()
    assert weak.pd == pytest.approx(float(found["three"].pd_shot[0].mean()), rel=1e-12)
    assert weak.cycles == 74 * 5
    assert weak.solved == (found["three"].velocity_status.values[0] <= 1).sum()
    strong = rows["three, power 1 W"]
    assert strong.true == ((found["three"].flags.values[1] & 1) > 0).any(axis=-1).sum()
    # In one draw of a hundred a leaked peak pairs with the echo; whole spectra have it too.
    assert weak.true < strong.true and 0.98 * 222 * 5 < strong.true <= strong.shots == 222 * 5
    assert rows["line, power 1 W"].cycles == 0


def test_the_summary_of_an_incomplete_flight_counts_committed_blocks_only(undisturbed, tmp_path):
    """One block is committed; another has its points written, and no velocity yet."""
    store = shutil.copytree(undisturbed.store, tmp_path / "copy.zarr")
    log = store / ".sweep" / "receipts.jsonl"
    first = next(line for line in log.read_text().splitlines(True) if '"block":0,' in line)
    log.write_text(first)
    for chunk in (store / "three" / "velocity_status" / "c").rglob("*"):
        if chunk.is_file() and chunk.parts[-3:] != ("0", "0", "0"):
            chunk.unlink()
    rows = {row.part: row for row in scene_summary(store)}
    weak, strong = rows["three, power 0.01 W"], rows["three, power 1 W"]
    assert (weak.shots, weak.cycles) == (120 * 3, 40 * 3)
    status = opened(undisturbed.store)["three"].velocity_status.values[0, :40, :3]
    assert weak.solved == (status <= 1).sum()
    assert strong.shots == strong.cycles == strong.solved == rows["line, power 1 W"].shots == 0


def test_a_beam_that_sees_nothing_has_no_chance_and_its_study_runs(tmp_path):
    """A plane of 300 m under beams at 22.5 deg, which see it from below 360 m alone."""
    objects = {"ground": {"kind": "plane", "size": "300 m", "reflectance": 0.1}}
    spec = small_scene(
        scene={"origin": "ground", "objects": objects},
        scanners={"three": SCENE["scanners"]["three"]},
        axes={},
    )
    found = opened(quiet(spec, tmp_path / "scene.zarr").store)["three"]
    unseen = ~np.isfinite(found.beam_range.values)
    assert 0.5 < unseen.mean() < 1 and np.isfinite(found.true_altitude.values).all()
    assert np.isnan(found.pd_shot.values[unseen]).all()
    assert not (found.flags.values[unseen] & 1).any()
