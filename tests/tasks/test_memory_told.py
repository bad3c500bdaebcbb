"""Numbers in a spec that would fill memory are refused in words, before any array is made."""

import pytest
from small import small
from small_flights import small_scene

from sweep.spec import SpecError
from sweep.tasks import driver, memory
from sweep.tasks.plan import plan
from sweep.tasks.studies import study_of

HUGE = {"instrument.processing.fft_size": [2**16, 2**30]}


def runs(spec, path):
    return driver.run(spec, store=path, scheduler="none", progress=False)


@pytest.mark.parametrize("use", [lambda spec, path: plan(spec), runs])
def test_an_fft_that_no_machine_holds_is_refused(use, tmp_path, monkeypatch):
    monkeypatch.setattr("distributed.system.MEMORY_LIMIT", 64 * 10**9)
    spec = small(axes=HUGE)
    with pytest.raises(SpecError, match=r"fft_size: makes a point take about 268.4 GB.*64.0 GB"):
        use(spec, tmp_path / "huge.zarr")
    assert not (tmp_path / "huge.zarr").exists()


def test_the_memory_of_a_plan_counts_a_point():
    spec = small()
    assert plan(spec).worker_memory > memory.point_bytes(spec) > 1e6


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"platform": {"path": {
            "kind": "straight", "from": ["0 m", "0 m", "100 m"], "to": ["10 m", "0 m", "100 m"],
            "initial_speed": "1e-12 m/s"}}}, r"scanners\.\w+\.rate: makes .* shots"),
        ({"draws": {"number": 10**9}}, r"draws\.number: makes .* shots in all draws"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("use", [runs, study_of])
def test_a_flight_of_too_many_shots_is_refused(changes, told, use, tmp_path):
    spec = small_scene(**changes)
    with pytest.raises(SpecError, match=told):
        use(spec, tmp_path / "huge.zarr")
    assert not (tmp_path / "huge.zarr").exists()
