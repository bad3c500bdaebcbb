"""Numbers in a spec that would fill memory are refused in words, before any array is made."""

from pathlib import Path

import pytest
from small_flights import small_scene_spec
from small_studies import small_spec

from sweep.spec import SpecError
from sweep.tasks import driver
from sweep.tasks.engine import worker_memory
from sweep.tasks.engine.study_store import create_store
from sweep.tasks.studies import memory_limits
from sweep.tasks.studies.study_loading import make_study
from sweep.tasks.studies.study_plan import plan_study

HUGE = {"instrument.processing.fft_size": [2**16, 2**30]}


def set_machine_memory(monkeypatch, limit):
    """Let this machine have so many bytes, and be asked for any number of them."""
    monkeypatch.setattr("distributed.system.MEMORY_LIMIT", limit)
    monkeypatch.setattr(worker_memory, "ALWAYS_AVAILABLE_MEMORY_BYTES", 0)


def runs(spec, path):
    return driver.run(spec, store=path, scheduler="none", progress=False)


@pytest.mark.parametrize("use", [lambda spec, path: plan_study(spec), runs])
def test_an_fft_that_no_machine_holds_is_refused(use, tmp_path, monkeypatch):
    set_machine_memory(monkeypatch, 64 * 10**9)
    spec = small_spec(axes=HUGE)
    with pytest.raises(SpecError, match=r"fft_size: makes a point take about 268.4 GB.*64.0 GB"):
        use(spec, tmp_path / "huge.zarr")
    assert not (tmp_path / "huge.zarr").exists()


class ClientOf:
    """A client whose workers have so many bytes."""

    asynchronous, status = False, "running"

    def __init__(self, *limits):
        self.limits = limits

    def scheduler_info(self, n_workers=5):
        return {"workers": {str(k): {"memory_limit": v} for k, v in enumerate(self.limits)}}


def batch(memory):
    return {
        "kind": "slurm", "workers": 4, "worker": {"threads": 1, "memory": memory},
        "job": {"workers": 2, "walltime": "10 min"}, "scheduler": {"host": "node1"},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"client": ClientOf(64 * 10**9, 2 * 10**9)}, "a worker of the client has 2.0 GB"),
        ({"cluster": batch("2 GB")}, "each worker of the cluster has 2.0 GB"),
        ({"cluster": {"kind": "local", "workers": 2, "worker": {"memory": "3 GB"}}},
         "each worker has 3.0 GB"),
        ({"workers": 16}, r"each worker has 3.6 GB.*fewer points of the FFT, or workers=13$"),
    ],
)  # fmt: skip
def test_an_fft_is_held_against_the_memory_of_the_workers(options, message, tmp_path, monkeypatch):
    set_machine_memory(monkeypatch, 64 * 10**9)
    spec = small_spec(axes={"instrument.processing.fft_size": [2**16, 2**24]})  # 4.2 GB
    with pytest.raises(SpecError, match=rf"fft_size: makes a point take about 4.2 GB.*{message}"):
        driver.run(spec, store=tmp_path / "huge.zarr", progress=False, **options)
    assert not (tmp_path / "huge.zarr").exists()


@pytest.mark.parametrize("limits", [(), (0,), (None, 10**12)])
def test_workers_without_a_limit_take_any_study(limits):
    memory_limits.refuse_too_large_point(
        small_spec(axes=HUGE), worker_memory.available_worker_memory(ClientOf(*limits), None)
    )


def test_a_scene_is_held_against_the_memory_of_each_worker(tmp_path, monkeypatch):
    spec = small_scene_spec()
    needed = memory_limits.point_memory_bytes(spec) + memory_limits.scene_memory_bytes(spec)
    assert memory_limits.scene_memory_bytes(spec) > 1000
    set_machine_memory(monkeypatch, needed - 1)
    for use in (lambda: plan_study(spec), lambda: runs(spec, tmp_path / "s.zarr")):
        with pytest.raises(SpecError, match=r"scene\.objects: takes about .* in each process"):
            use()
    assert not (tmp_path / "s.zarr").exists()


def test_a_store_that_goes_on_is_held_against_memory_too(tmp_path, monkeypatch):
    spec, larger_spec = small_scene_spec(), small_scene_spec(draws={"number": 6, "returns": 3})
    runs(spec, tmp_path / "s.zarr")
    limit = memory_limits.point_memory_bytes(spec) + memory_limits.scene_memory_bytes(spec) - 1
    set_machine_memory(monkeypatch, limit)
    arguments = {"scheduler": "none", "progress": False}
    with pytest.raises(SpecError, match=r"scene\.objects: takes about .* in each process"):
        driver.extend(tmp_path / "s.zarr", larger_spec, to=tmp_path / "t.zarr", **arguments)
    assert not (tmp_path / "t.zarr").exists()
    assert driver.resume(tmp_path / "s.zarr", **arguments).complete  # nothing is left to compute
    incomplete_path = tmp_path / "begun" / "s.zarr"
    create_store(
        incomplete_path, make_study(spec, incomplete_path), recipe={"base": str(Path.cwd())}
    )
    with pytest.raises(SpecError, match=r"scene\.objects: takes about .* in each process"):
        driver.resume(incomplete_path, **arguments)


@pytest.mark.parametrize("kind", ["grid", "flight"])
def test_a_refusal_by_the_workers_of_a_scheduler_leaves_nothing(kind, tmp_path, monkeypatch):
    from distributed import LocalCluster

    spec = small_scene_spec() if kind == "flight" else small_spec(axes=HUGE)
    set_machine_memory(monkeypatch, 10**13)
    if kind == "flight":  # a point fits into a worker, and the scene with it does not
        monkeypatch.setattr(memory_limits, "scene_memory_bytes", lambda spec: 2 * 10**9)
    one = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with (
        LocalCluster(**one, memory_limit="1 GB", protocol="tcp") as cluster,
        pytest.raises(SpecError, match=r"a worker of the client has 1\.0 GB"),
    ):
        driver.run(
            spec, store=tmp_path / "s.zarr", scheduler=cluster.scheduler_address, progress=False
        )
    assert list(tmp_path.iterdir()) == []


def test_a_block_that_no_memory_holds_is_refused(tmp_path, monkeypatch):
    spec = small_scene_spec(draws={"number": 10**7}, storage={"block_draws": 10**6})
    set_machine_memory(monkeypatch, 10**8)
    monkeypatch.setattr(memory_limits, "point_memory_bytes", lambda spec: 0)
    for use in (lambda: plan_study(spec), lambda: runs(spec, tmp_path / "s.zarr")):
        with pytest.raises(SpecError, match=r"storage: makes a block take .* GB"):
            use()
    assert not (tmp_path / "s.zarr").exists()


def few_shots(**changes):
    """One cycle of three shots."""
    scanners = {"three": {"kind": "cone", "beams": 3, "half_angle": "22.5 deg", "rate": "0.1 Hz"}}
    return small_scene_spec(scanners=scanners, axes={}, **changes)


def test_very_many_draws_of_few_shots_allocate_nothing_and_are_refused_by_their_blocks():
    import tracemalloc

    make_study(few_shots(), Path("nowhere.zarr"))
    tracemalloc.start()
    make_study(few_shots(draws={"number": 10**9}, storage={}), Path("nowhere.zarr"))
    with pytest.raises(SpecError, match=r"storage.block_draws: cuts 1,000,000,000 draws of .*; ra"):
        make_study(few_shots(draws={"number": 10**9}, storage={"block_draws": 3}), Path("no.zarr"))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6


def test_a_grid_of_too_many_blocks_is_refused():
    axes = {
        "target.range": {"linear": ["10 m", "5 km"], "number": 10**5},
        "target.grazing_angle": {"linear": ["10 deg", "90 deg"], "number": 10**4},
    }
    with pytest.raises(SpecError, match=r"axes: makes 1e\+09 points in .* blocks"):
        make_study(small_spec(axes=axes, storage={"block_points": 1}), Path("nowhere.zarr"))


def test_a_grid_of_too_many_blocks_is_refused_before_any_point_is_looked_at(monkeypatch):
    monkeypatch.setattr(
        "sweep.tasks.studies.study_plan.measure_seconds_per_point",
        lambda study: pytest.fail("it was measured"),
    )
    many = {"linear": ["1 W", "3 W"], "number": 10**4}
    axes = {
        "instrument.laser.power": many,
        "target.range": {"linear": ["1 km", "3 km"], "number": 10**4},
        "target.grazing_angle": {"linear": ["1 deg", "80 deg"], "number": 10**4},
    }
    with pytest.raises(SpecError, match=r"axes: makes 1e\+12 points in 1e\+08 blocks"):
        plan_study(small_spec(axes=axes, storage={"block_points": 10**4}))


def test_the_memory_of_a_plan_counts_a_point():
    spec = small_spec()
    assert plan_study(spec).process_memory_bytes > memory_limits.point_memory_bytes(spec) > 1e6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"platform": {"path": {
            "kind": "straight", "from": ["0 m", "0 m", "100 m"], "to": ["10 m", "0 m", "100 m"],
            "initial_speed": "1e-12 m/s"}}}, r"scanners\.\w+\.rate: makes .* shots"),
        ({"platform": {"path": {
            "kind": "waypoints", "file": "path.csv"}}}, r"scanners\.\w+\.rate: makes .* shots"),
        ({"draws": {"number": 10**9}}, r"draws\.number: makes .* shots in all draws"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("use", [runs, make_study])
def test_a_flight_of_too_many_shots_is_refused(changes, message, use, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "path.csv").write_text(
        "time [s],x [m],y [m],z [m]\n1e300,0,0,100\n2e300,10,0,100\n"
    )
    with pytest.raises(SpecError, match=message):
        use(small_scene_spec(**changes), tmp_path / "huge.zarr")
    assert not (tmp_path / "huge.zarr").exists()
