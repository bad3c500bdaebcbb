"""Functions of the user's: run when allowed, held to their word, never by reading."""

import base64
import copy
import gzip
import os
import pickle
import re
import sys
import textwrap
from types import SimpleNamespace

import numpy as np
import pytest
from small_flights import SCENE_MAPPING, small_scene_spec
from small_studies import RecordingProgress, run_serially, small_spec

import sweep
from sweep.spec.axes import remove_fields_on_axes
from sweep.tasks.engine import user_code
from sweep.tasks.engine.progress import CodeError, RunRequestError
from sweep.tasks.studies import study_plan as planned
from sweep.tasks.studies import user_functions
from sweep.tasks.studies.study_plan import plan_study
from sweep.tasks.studies.user_function_names import user_module_names

CODE = """
    import numpy as np
    from pathlib import Path

    with Path(__file__).with_suffix(".runs").open("a") as file:
        file.write("x")

    def detect(power, setting):
        return power > setting.threshold**2

    def written(power, setting):
        power[:] = 0
        return power > 1

    def counts(power, setting):
        return (power > 1).astype(int)

    def short(power, setting):
        return power[:, 1:] > 1

    def lists(power, setting):
        return [True]

    def fails(power, setting):
        raise KeyError("no level")

    def estimate(spectrum, peak, setting):
        return peak + 0.0

    def endless(spectrum, peak, setting):
        return peak + np.inf

    number = 3
"""


@pytest.fixture
def user_module(tmp_path, monkeypatch):
    """A module of the user's in the working directory, not allowed yet."""
    name = f"mine_{tmp_path.name}".replace("-", "_")
    (tmp_path / f"{name}.py").write_text(textwrap.dedent(CODE))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(user_code.ALLOWED_MODULES_VARIABLE, "")
    monkeypatch.setattr(sys, "path", [*sys.path])
    user_functions.load_checked_function.cache_clear()
    yield name
    sys.modules.pop(name, None)
    user_functions.load_checked_function.cache_clear()


SHORT = {"fft_size": "2^9", "acquisition_delay": "34 us"}
"""Records of 0.85 us, of which the echo of 5 km, there from 33.4 us on, still has all samples."""


def study(detector="fixed", estimator="peak_bin", **changes):
    processing = {"sample_rate": "600 MHz", "tnr": 4} | SHORT
    processing |= {"detector": {"kind": detector}, "estimator": {"kind": estimator}}
    sections = small_spec(draws={"method": "spectra", "number": 3}, axes={})
    mapping = sections.to_yaml_mapping()
    mapping["instrument"]["processing"] |= processing
    mapping["axes"] = {"target.range": {"linear": ["500 m", "4 km"], "number": 3}} | changes
    return type(sections).from_mapping(
        remove_fields_on_axes(mapping | {"storage": {"block_points": 2}})
    )


def runs(name, tmp_path):
    file = tmp_path / f"{name}.runs"
    return file.read_text() if file.exists() else ""


def test_code_runs_only_where_its_module_is_allowed(user_module, tmp_path):
    spec = study(f"{user_module}:detect", f"{user_module}:estimate")
    for ask in (lambda: run_serially(spec, tmp_path / "a.zarr"), lambda: plan_study(spec)):
        with pytest.raises(CodeError, match=rf"allow_code=\['{user_module}'\]"):
            ask()
    assert not (tmp_path / "a.zarr").exists() and not runs(user_module, tmp_path)
    user_code.allow_modules([user_module])
    assert run_serially(spec, tmp_path / "a.zarr").complete
    assert run_serially(study(), tmp_path / "b.zarr").complete
    user_results, built_in = (sweep.open(tmp_path / f"{n}.zarr") for n in "ab")
    np.testing.assert_array_equal(user_results.pd_shot, built_in.pd_shot)
    np.testing.assert_array_equal(user_results.range_rmse, built_in.range_rmse)


def test_a_flight_runs_allowed_functions_and_finds_what_built_in_ones_find(user_module, tmp_path):
    def flown(detector, estimator):
        processing = {"detector": {"kind": detector}, "estimator": {"kind": estimator}}
        instrument = copy.deepcopy(SCENE_MAPPING["instrument"])
        instrument["processing"] |= SHORT | processing
        draws = {"method": "spectra", "number": 2, "returns": 2}
        scanners = {"three": SCENE_MAPPING["scanners"]["three"] | {"rate": "0.5 Hz"}}
        return small_scene_spec(instrument=instrument, draws=draws, scanners=scanners, axes={})

    spec = flown(f"{user_module}:detect", f"{user_module}:estimate")
    with pytest.raises(CodeError, match=rf"allow_code=\['{user_module}'\]"):
        run_serially(spec, tmp_path / "a.zarr")
    user_code.allow_modules([user_module])
    assert run_serially(spec, tmp_path / "a.zarr").complete
    assert run_serially(flown("fixed", "peak_bin"), tmp_path / "b.zarr").complete
    user_results, built_in = (sweep.open_scene(tmp_path / f"{n}.zarr")["three"] for n in "ab")
    assert (built_in.flags > 0).any()
    np.testing.assert_array_equal(user_results.range_interpolated, built_in.range_interpolated)
    np.testing.assert_array_equal(user_results.flags, built_in.flags)
    assert built_in.pd_shot.notnull().any() and not user_results.pd_shot.notnull().any()


def test_opening_a_store_runs_nothing(user_module, tmp_path):
    user_code.allow_modules([user_module])
    assert run_serially(study(f"{user_module}:detect"), tmp_path / "a.zarr").complete
    del os.environ[user_code.ALLOWED_MODULES_VARIABLE], sys.modules[user_module]
    ran = runs(user_module, tmp_path)
    sweep.open(tmp_path / "a.zarr")
    from sweep.tasks.studies.store_summary import status
    from sweep.tasks.studies.study_loading import read_study

    assert status(tmp_path / "a.zarr").complete
    assert read_study(tmp_path / "a.zarr")[1].spec.id == study(f"{user_module}:detect").id
    assert runs(user_module, tmp_path) == ran and user_module not in sys.modules
    user_functions.load_checked_function.cache_clear()
    with pytest.raises(CodeError, match="not allowed"):
        sweep.resume(tmp_path / "a.zarr", progress=False)


@pytest.mark.parametrize("extended", [False, True])
def test_a_module_that_changed_since_a_store_was_created_is_reported_each_time(
    user_module, tmp_path, extended
):
    user_code.allow_modules([user_module])
    store, larger = tmp_path / "a.zarr", {"target.range": ["500 m", "2250 m", "4 km", "5 km"]}
    assert run_serially(study(f"{user_module}:detect"), store).complete

    def warnings_given():
        sys.modules.pop(user_module, None)
        progress, place = RecordingProgress(), {"scheduler": "none", "overwrite": True}
        if extended:
            spec = study(f"{user_module}:detect", **larger)
            sweep.extend(store, spec, to=tmp_path / "b.zarr", progress=progress, **place)
        else:
            sweep.resume(store, scheduler="none", progress=progress)
        return [line for line in progress if f"the module {user_module} has changed" in line]

    assert warnings_given() == []
    with (tmp_path / f"{user_module}.py").open("a") as file:
        file.write("changed = True\n")
    assert len(warnings_given()) == len(warnings_given()) == 1


@pytest.mark.parametrize(
    ("role", "function", "words"),
    [
        ("detector", "written", "read-only"),
        ("detector", "counts", r"\(.*/mine_\w+\.py:15\) gives int64 of shape"),
        ("detector", "short", "must give bool of"),
        ("detector", "lists", "must give a numpy array"),
        ("detector", "fails", r"on a small known spectrum, \w+:fails fails with KeyError: 'no lev"
         r"el' \(.*/mine_\w+\.py:25, in fails\)"),
        ("detector", "number", "is a int, and no function"),
        ("detector", "missing", "the module has nothing called missing"),
        ("estimator", "endless", "not finite"),
        ("estimator", "detect", "fails with TypeError"),
    ],
)  # fmt: skip
def test_a_function_is_held_to_its_word_before_anything_runs(
    user_module, tmp_path, role, function, words
):
    user_code.allow_modules([user_module])
    with pytest.raises(CodeError, match=words):
        run_serially(study(**{role: f"{user_module}:{function}"}), tmp_path / "a.zarr")
    assert not (tmp_path / "a.zarr").exists()


def test_a_module_that_is_not_there_is_named(user_module, tmp_path):
    user_code.allow_modules(["no_such_module"])
    with pytest.raises(CodeError, match=r"no module no_such_module on .*put no_such_module\.py"):
        user_functions.check_user_functions(study("no_such_module:f"))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("def f(:\n", r"SyntaxError: .* \(.*bad_\d+\.py:1\)"),
        ("x = 1\n1 / 0\n", r"ZeroDivisionError: division by zero \(.*bad_\d+\.py:2\)"),
        ("\nimport no_such_thing\n", r"No module named 'no_such_thing' \(.*bad_\d+\.py:2\)"),
        ("raise SystemExit(3)\n", r"SystemExit: 3 \(.*bad_\d+\.py:1\)"),
    ],
)
def test_a_module_that_can_not_be_imported_is_reported_with_its_line(
    user_module, tmp_path, content, words
):
    name = f"bad_{len(content)}"
    (tmp_path / f"{name}.py").write_text(content)
    with pytest.raises(CodeError, match=f"the module {name} can't be imported on .*{words}"):
        run_serially(study(f"{name}:f"), tmp_path / "a.zarr", scheduler="none", allow_code=[name])


FAILS_LATER = """
    calls = []

    def detect(power, setting):
        calls.append(1)
        if len(calls) > 1:
            raise OSError(28, "of the user's own")
        return power > setting.threshold**2
"""


def test_code_that_fails_in_a_block_is_reported_with_its_file_line_and_name(user_module, tmp_path):
    (tmp_path / f"{user_module}.py").write_text(textwrap.dedent(FAILS_LATER))
    spec = study(f"{user_module}:detect")
    outcome = run_serially(spec, tmp_path / "a.zarr", scheduler="none", allow_code=[user_module])
    assert not outcome.stop_reason and outcome.failures  # the disk has room
    for failure in outcome.failures:
        assert f"{user_module}:detect fails with OSError: [Errno 28]" in failure.error
        assert f"{user_module}.py:7, in detect" in failure.error


def run_elsewhere(function, *arguments):
    """Answer of a function in another process, whose environment allows no code."""
    import subprocess

    call = "import pickle, sys; f, a = pickle.load(sys.stdin.buffer); print(f(*a))"
    return subprocess.run(
        [sys.executable, "-c", call],
        input=pickle.dumps((function, arguments)),
        capture_output=True,
        check=False,
        env=os.environ | {user_code.ALLOWED_MODULES_VARIABLE: ""},
    )


def test_what_a_run_allows_its_workers_allow_too_if_they_have_the_same_file(user_module, tmp_path):
    spec = study(f"{user_module}:detect")
    user_code.allow_modules([user_module])
    ((module, digest),) = user_code.module_digests(user_module_names(spec)).items()
    assert module == user_module and len(digest) == 32
    refused = run_elsewhere(user_functions.check_user_functions, spec)
    assert refused.returncode and b"its module is not allowed" in refused.stderr
    assert run_elsewhere(user_code.allow_identical_module, module, digest).returncode == 0
    (tmp_path / f"{user_module}.py").write_text("detect = 3")
    other = run_elsewhere(user_code.allow_identical_module, module, digest)
    assert other.returncode and b"is not the same file on" in other.stderr
    (tmp_path / f"{user_module}.py").unlink()
    lost = run_elsewhere(user_code.allow_identical_module, module, digest)
    assert lost.returncode and f"put {user_module}.py into the folder".encode() in lost.stderr


def test_workers_that_are_there_already_run_what_the_run_allows(user_module, tmp_path):
    """A scheduler and a worker were started before: in their environment nothing is allowed."""
    from distributed import LocalCluster

    spec = study(f"{user_module}:detect")
    with LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        outcome = run_serially(
            spec, tmp_path / "a.zarr", scheduler=cluster.scheduler_address, allow_code=[user_module]
        )
    assert outcome.complete
    assert run_serially(spec, tmp_path / "b.zarr", scheduler="none").complete
    user_results, same = (sweep.open(tmp_path / f"{n}.zarr") for n in "ab")
    np.testing.assert_array_equal(user_results.pd_shot, same.pd_shot)


def test_stores_of_whole_spectra_hold_the_same_whatever_the_blocks(tmp_path):
    """And whatever looks at them, the same noise: common draws of all detectors."""
    axes = {
        "instrument.processing.detector.kind": ["fixed", "goca_cfar"],
        "instrument.processing.estimator.kind": ["peak_bin", "candan"],
    }
    mapping = study(**axes).to_yaml_mapping()
    stores = []
    for points in (3, 64):
        spec = small_spec().from_mapping(mapping | {"storage": {"block_points": points}})
        run_serially(spec, tmp_path / f"{points}.zarr")
        stores.append(sweep.open(tmp_path / f"{points}.zarr").load())
    for name, values in stores[0].data_vars.items():
        np.testing.assert_array_equal(values, stores[1][name], err_msg=name)
    pd = stores[0].pd_shot
    np.testing.assert_array_equal(pd.sel(estimator="peak_bin"), pd.sel(estimator="candan"))


def test_what_accuracy_costs_is_not_asked_of_whole_spectra(tmp_path):
    from sweep.tasks.accuracy.measurement import measure_accuracy

    with pytest.raises(RunRequestError, match="draws whole spectra"):
        measure_accuracy(study(), store_path=tmp_path / "a.zarr")


def test_a_page_of_whole_spectra_shows_what_is_stored(tmp_path):
    from sweep.report.study_report import write_report

    run_serially(study(), tmp_path / "a.zarr")
    text = write_report(tmp_path / "a.zarr", tmp_path / "page.html").read_text(encoding="utf-8")
    for packed in re.findall(r'type="application/gzip"[^>]*>([^<]*)<', text):
        text += gzip.decompress(base64.b64decode(packed)).decode()
    assert "false_alarms" in text and "Noise by source" in text and "pfa_segment" not in text


def test_a_plan_measures_what_draws_take(monkeypatch):
    """By a clock that ticks ten times for a point and once for each of its draws.

    A point is looked at once before, with one draw, and once after, where draws are left out.
    """
    ticks = [0.0]

    def evaluated(spec, parameters, count, effects):
        ticks[0] += count * (10 + spec.draws.number)
        return {}

    clock = SimpleNamespace(perf_counter=lambda: ticks[0], process_time=lambda: ticks[0])
    monkeypatch.setattr(planned, "evaluate_points", evaluated)
    monkeypatch.setattr(planned, "time", clock)
    few, many = (study() for _ in range(2))
    many = many.model_copy(update={"draws": many.draws.model_copy(update={"number": 10_000})})
    assert few.draws.number == 3
    assert plan_study(few).seconds_per_point == 11 + 13
    assert plan_study(many).seconds_per_point == 11 + (10 + 10_000) + 11
