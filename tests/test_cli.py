import errno
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from click.testing import CliRunner
from dask.system import CPU_COUNT
from figure_files import has_content

from sweep.cli import main
from sweep.spec import GridSpec, load
from sweep.tasks import driver
from sweep.tasks.engine import progress
from sweep.tasks.engine.journal import StoreLock
from sweep.tasks.engine.progress import ClusterError
from sweep.tasks.engine.session import RunOptions
from sweep.tasks.studies.workload import SpecWorkload

STUDY = """\
title: A small study
instrument:
  laser: {wavelength: 1550 nm, power: 1 W, beam_divergence: 50 urad}
  chirp: {bandwidth: 1 GHz, start_frequency: 5.5 GHz, duration: 500 us}
  telescope: {aperture: 25 mm, coupling: aperture}
  receiver:
    responsivity: 1.1 A/W
    detector_bandwidth: 400 MHz
    optical_passband: 25 nm
    noise_equivalent_power: 5 pW/Hz^0.5
    transimpedance: 7 kohm
    amplifier_bandwidth: 400 MHz
    amplifier_noise_current: 25 nA
  processing:
    {sample_rate: 600 MHz, fft_size: 2^14, noise_bins: independent, detection: peak_bin, tnr: 8}
target: {grazing_angle: 60 deg, radial_velocity: 20 m/s, reflectance: 0.01}
footprint: {beamlets: 9, speckle: none}
axes:
  target.range: {linear: [10 m, 5 km], number: 40}
  instrument.laser.power: [1 W, 3 W]
seed: 3
storage: {block_points: 8}
"""


@pytest.fixture
def working_directory(tmp_path, monkeypatch):
    """A directory of one's own with a spec, small.yaml, in it."""
    (tmp_path / "small.yaml").write_text(STUDY)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def small_store(tmp_path_factory):
    """The small study's store; not to be changed."""
    spec = GridSpec.from_mapping(yaml.safe_load(STUDY))
    store = tmp_path_factory.mktemp("made") / "small.zarr"
    return driver.run(spec, store=store, scheduler="none", progress=False).store


@pytest.fixture
def ran(working_directory, small_store):
    """The directory with the store of the small study in it."""
    shutil.copytree(small_store, working_directory / "results" / "small.zarr")
    return working_directory


def sweep(*arguments: str):
    """The command in this process; an error that is not a user's mistake is raised."""
    return CliRunner().invoke(main, [*map(str, arguments)], catch_exceptions=False)


def refused(result, *message: str) -> None:
    """A user's mistake: exit code 2, plain words on standard error, nothing on standard output."""
    assert result.exit_code == 2
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    for text in message:
        assert text in result.stderr


def test_run_makes_a_store_named_after_the_spec_and_prints_a_table(working_directory):
    result = sweep("run", "small.yaml", "--scheduler", "none")
    assert result.exit_code == 0
    assert (working_directory / "results" / "small.zarr" / "zarr.json").exists()
    assert "pd_shot > 0.9" in result.stdout and "median pd_doppler" in result.stdout
    assert "range [m]" in result.stdout and "10..393.8" in result.stdout
    assert "results/small.zarr: 80 of 80 points, computed 10 of 10 blocks" in result.stdout
    assert "80 of 80 points" in result.stderr
    stdout = sweep("status", "results/small.zarr").stdout  # a study without draws tells of none
    assert "Half-widths" not in result.stdout + stdout


def test_the_summary_counts_what_the_store_holds(ran):
    import numpy as np
    import xarray as xr

    from sweep.tasks.studies.store_summary import detection_summary

    heading, rows, share = detection_summary(ran / "results" / "small.zarr")
    assert heading == "range [m]" and share == 1
    shot = xr.open_zarr(ran / "results" / "small.zarr").pd_shot
    assert [row.n_points for row in rows] == [8] * 10 + [80]
    first = shot.isel(range=slice(0, 4)).values
    assert rows[0].detected_fraction == np.count_nonzero(first > 0.9) / 8
    assert rows[-1].median_pd_shot == np.median(shot.values)
    assert 0 < rows[-1].detected_fraction < 1


def test_the_table_of_a_large_study_is_by_some_of_its_blocks_and_says_so(ran, monkeypatch):
    from sweep.tasks.studies import store_summary

    _, all_rows, _ = store_summary.detection_summary(ran / "results" / "small.zarr")
    monkeypatch.setattr(store_summary, "SAMPLED_BLOCKS_MAX", 4)
    _, rows, share = store_summary.detection_summary(ran / "results" / "small.zarr")
    assert share == 4 / 10
    assert rows[-1].n_points == 4 * 8 and all_rows[-1].n_points == 10 * 8
    row_by_label = {row.label: row for row in all_rows}
    assert sum(row.n_points > 0 for row in rows[:-1]) == 4  # a block is a part of this study
    assert all(row == row_by_label[row.label] for row in rows[:-1] if row.n_points)
    assert "by 40 % of the blocks" in sweep("resume", "results/small.zarr").stdout


def test_a_second_run_is_refused_and_says_how_to_go_on_or_begin_again(ran):
    refused(sweep("run", "small.yaml", "--scheduler", "none"), "sweep status", "--overwrite")
    assert sweep("run", "small.yaml", "--scheduler", "none", "--overwrite").exit_code == 0


def test_a_changed_spec_is_refused_with_what_changed(ran):
    (ran / "other.yaml").write_text(STUDY.replace("seed: 3", "seed: 4"))
    store = "results/small.zarr"
    refused(sweep("run", "other.yaml", "--store", store), "seed: 3 -> 4")
    refused(sweep("resume", store, "--spec", "other.yaml"), "seed: 3 -> 4")
    assert sweep("resume", store, "--spec", "small.yaml", "--scheduler", "none").exit_code == 0


def test_a_link_that_leads_nowhere_is_reported_as_such(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "turning.yaml").symlink_to("turning.yaml")
    (tmp_path / "lost.yaml").symlink_to("gone.yaml")
    for name, target in (("turning.yaml", "turning.yaml"), ("lost.yaml", "gone.yaml")):
        result = CliRunner().invoke(main, ["plan", name])
        assert result.exit_code == 2
        assert f"'{name}' does not exist: it is a link to '{target}', which" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "absent.yaml"], "does not exist"),
        (["run", "wrong.yaml"], "telescope"),
        (["plan", "wrong.yaml"], "telescope"),
        (["run", "small.yaml", "--workers", "0"], "--workers"),
        (["run", "small.yaml", "--scheduler", "nonsense"], "is no address of a Dask scheduler"),
        (["resume", "absent.zarr"], "there is no store at"),
        (["status", "notes"], "is not a Zarr store"),
        (["figures", "notes"], "is not a Zarr store"),
        (["run", "small.yaml", "--store", "notes"], "is not a Zarr store"),
        (["run", "small.yaml", "--store", "notes", "--overwrite"], "is not a Zarr store"),
        (["run", "small.yaml", "--store", "notes/text/small.zarr"], "can't be made"),
        (["run", "small.yaml", "--store", "ftp://x/y.zarr"], "ftp://x/y.zarr: is no place for a"),
        (["status", "S3://x/y.zarr"], "write a path, or s3://, gs://, az://"),
        (["runn", "small.yaml"], "runn"),
    ],
)
def test_a_mistake_ends_in_plain_words_and_exit_code_2(working_directory, arguments, message):
    (working_directory / "notes").mkdir()
    (working_directory / "notes" / "text").write_text("mine")
    (working_directory / "wrong.yaml").write_text(STUDY.replace("25 mm", "25"))
    refused(sweep(*arguments), message)
    assert sorted(path.name for path in working_directory.iterdir() if path.name != "results") == [
        "notes",
        "small.yaml",
        "wrong.yaml",
    ]
    assert (working_directory / "notes" / "text").read_text() == "mine"


@pytest.mark.parametrize(
    "arguments",
    [
        ("figures", "a.zarr", "--output", "no/figures"),
        ("report", "a.zarr", "--output", "no/page.html"),
        ("shot", "small.yaml", "--output", "no/shot"),
        ("spectra", "small.yaml", "--output", "no/spectra.npz"),
        ("spectra", "small.yaml", "--output", "no/spectra.zarr"),
    ],
)
def test_a_folder_that_can_not_be_written_is_reported_in_a_line(
    working_directory, monkeypatch, arguments
):
    one = STUDY[: STUDY.index("axes:")].replace("target: {", "target: {range: 2 km, ")
    (working_directory / "small.yaml").write_text(one)
    driver.run(GridSpec.from_mapping(yaml.safe_load(one)), store="a.zarr", scheduler="none",
               progress=False)  # fmt: skip
    (working_directory / "no").write_text("a file in the folder's place")
    refused(sweep(*arguments), "no", ": mend that, or name another place\n")
    (working_directory / "no").unlink()
    make = os.mkdir

    def locked(path, *mode, **directory):
        if "no" in Path(path).parts:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        make(path, *mode, **directory)

    monkeypatch.setattr(os, "mkdir", locked)
    refused(sweep(*arguments), ": Permission denied: mend that, or name another place\n")


def test_a_study_left_incomplete_exits_3_lists_why_and_resumes(working_directory, monkeypatch):
    def poisoned(study, block):
        if block == 4:
            raise ValueError("no good")
        return study.evaluate(block)

    driver_run = driver.run

    def run(*arguments, **keywords):
        return driver_run(*arguments, **keywords, evaluate=poisoned)

    monkeypatch.setattr(driver, "run", run)
    result = sweep("run", "small.yaml", "--scheduler", "none")
    assert result.exit_code == 3
    assert "block 4 failed: ValueError: no good" in result.stderr
    assert "1 of 10 blocks left" in result.stderr
    assert "sweep resume results/small.zarr" in result.stderr
    stdout = sweep("status", "results/small.zarr").stdout
    assert "72 of 80 points, 9 of 10 blocks" in stdout
    assert "block 4 failed on" in stdout and "sweep resume" in stdout
    resume_arguments = "resume", "results/small.zarr", "--scheduler", "none"
    assert sweep(*resume_arguments).exit_code == 3  # what failed is left out until it is asked for
    assert sweep(*resume_arguments, "--retry-failed").exit_code == 0
    assert "complete" in sweep("status", "results/small.zarr").stdout


def test_a_path_after_an_equals_sign_may_begin_at_home(working_directory, monkeypatch):
    monkeypatch.setenv("HOME", str(working_directory / "home"))
    store = "--store=~/small.zarr"
    assert sweep("run", "small.yaml", store, "--scheduler", "none").exit_code == 0
    assert (working_directory / "home" / "small.zarr").is_dir() and not (
        working_directory / "~"
    ).exists()
    drawn = sweep("shot", "small.yaml", "--output=~/drawn")
    assert drawn.exit_code == 0 and (working_directory / "home" / "drawn").is_dir()


def test_status_tells_who_is_at_work(ran):
    log = ran / "results" / "small.zarr" / ".sweep" / "receipts.jsonl"
    log.write_bytes(b"".join(log.read_bytes().splitlines(keepends=True)[:-1]))
    held = StoreLock(ran / "results" / "small.zarr")
    stdout = sweep("status", "results/small.zarr").stdout
    held.release()
    assert "72 of 80 points, 9 of 10 blocks" in stdout
    assert f"running: process {os.getpid()} on" in stdout


@pytest.mark.parametrize(
    ("options", "steps", "tasks"),
    [([], False, False), (["-v"], True, False), (["-v", "-v"], True, True)],
)
def test_the_log_of_a_command_is_shown_where_it_is_asked_for(
    working_directory, options, steps, tasks
):
    result = sweep("run", "small.yaml", "--scheduler", "none", *options)
    assert result.exit_code == 0
    assert bool(re.search(r"sweep\.session: .* blocks computed in ", result.stderr)) == steps
    assert ("sweep.session: committed " in result.stderr) == tasks
    log = logging.getLogger("sweep")
    assert not log.handlers and log.level == logging.NOTSET and log.propagate


def test_an_error_that_is_not_the_users_exits_1(working_directory, monkeypatch):
    def broken(*arguments, **keywords):
        raise RuntimeError("a bug")

    monkeypatch.setattr(driver, "run", broken)
    result = CliRunner().invoke(main, ["run", "small.yaml"])
    assert result.exit_code == 1
    assert isinstance(result.exception, RuntimeError)


def test_plan_counts_points_blocks_and_bytes_and_writes_nothing(working_directory):
    from sweep.model.effects.catalogue import EFFECT_NAMES
    from sweep.model.outputs import GRID_OUTPUTS

    result = sweep("plan", "small.yaml", "--workers", "2")
    assert result.exit_code == 0
    counts_text, _, table = result.stdout.partition("Effects")
    lines = dict(line.strip().split("  ", 1) for line in counts_text.splitlines())
    arrays = len(GRID_OUTPUTS) + 2  # what was simulated, and what that leaves out
    assert lines["points"] == "80"
    assert lines["blocks"] == "10 of at most 4 range x 2 power"
    assert lines["chunks"] == f"{10 * arrays} files"
    size = 80 * (8 * arrays - 4)  # flags of effects take four bytes
    assert lines["bytes"] == f"{size / 1000:.3g} kB before compression"
    assert lines["time"].partition(",")[0].endswith("on 2 workers")
    assert all(name.replace("_", " ") in " ".join(table.split()) for name in EFFECT_NAMES)
    assert [path.name for path in working_directory.iterdir()] == ["small.yaml"]


HILLS = (
    STUDY.split("target:")[0]
    + """\
scene:
  origin: ground
  objects:
    ground: {kind: hills, size: 1 km, spacing: 20 m, rms_height: 5 m, correlation_length: 100 m,
             seed: 1, reflectance: 0.1}
platform:
  path: {kind: straight, from: [0 m, 0 m, 300 m], to: [0 m, 0 m, 100 m],
         initial_speed: 80 m/s, final_speed: 20 m/s}
scanners:
  corners: {kind: corners, angle: 22.5 deg, rate: 5 Hz}
  ahead: {kind: cone, beams: 3, half_angle: 10 deg, rate: 5 Hz}
"""
)


def words_of(text):
    """Words that were printed, without colours."""
    return re.sub(r"\x1b\[[0-9;]*m", "", text).split()


@pytest.mark.parametrize("columns", [40, 60, 80, 120])
def test_no_number_is_cut_however_narrow_the_terminal_and_nothing_is_folded_without_one(
    working_directory, monkeypatch, columns
):
    from sweep.cli.terminal import print_table

    cells = ["12,345 of 678,901", "0.000123", "1.2e+03 us", "123,456,789"]
    axes_text = "range 10..5000 m, grazing_angle 20..90 deg, laser power 1..3 W"
    monkeypatch.setenv("COLUMNS", str(columns))

    def printed():
        with CliRunner().isolation() as (out, _, _):
            headings = ["", "points met", "worst", "costs", "draws needed", "called for"]
            print_table("Half-widths", headings, [["pd_doppler", *cells, axes_text]], "called for")
            return out.getvalue().decode()

    lines = printed().splitlines()
    assert any(all(cell in line for cell in (*cells, axes_text)) for line in lines)
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    words = words_of(printed())
    assert "…" not in "".join(words)
    assert not {*" ".join([*cells, axes_text, "pd_doppler"]).split()} - {*words}
    assert all(cell in " ".join(words) for cell in cells)


@pytest.mark.parametrize("columns", [40, 60, 80])
def test_sentences_are_folded_to_a_terminal_and_commands_in_them_stay_whole(monkeypatch, columns):
    from sweep.cli.terminal import wrap_text

    command = "`sweep resume results/a_study.zarr`"
    text = f"  one.yaml:7: is no field, and {command} goes on with what there is by now"
    assert wrap_text(text) == text
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    lines = wrap_text(f"2 mistakes:\n{text}").splitlines()
    assert max(map(len, lines)) <= columns and len(lines) > 2
    assert sum(command in line for line in lines) == 1
    assert " ".join(" ".join(lines).split()) == " ".join(f"2 mistakes:\n{text}".split())


@pytest.mark.parametrize(
    "processing, alarms, warned",
    [
        ("tnr: 7", "in either chirp with probability 0.359, in both chirps 0.0397", "0.359"),
        ("tnr: 9", "in either chirp with probability 0.000462, in both chirps 5.35e-08", ""),
        ("bins_counted: all, tnr: 7", "probability 0.589, in both chirps 0.129", "0.589"),
    ],
)
def test_a_plan_and_a_run_tell_how_often_noise_raises_an_alarm(
    working_directory, processing, alarms, warned
):
    (working_directory / "small.yaml").write_text(STUDY.replace("tnr: 8", processing))
    for result in (sweep("plan", "small.yaml"), sweep("run", "small.yaml", "--scheduler", "none")):
        assert alarms in result.stdout
        warning = (
            f"warning: noise alone raises a false alarm in either chirp with probability {warned}"
        )
        assert (warning in result.stderr) == bool(warned)


@pytest.mark.parametrize(
    ("processing", "remedy"),
    [
        ("tnr: 7", "raise instrument.processing.tnr"),
        ("threshold_to_mean: 4", "raise instrument.processing.threshold_to_mean"),
        ("design_pfa_shot: 0.3", "lower instrument.processing.design_pfa_shot"),
        ("tnr: 8, detector: {kind: ca_cfar}", "lower instrument.processing.detector.pfa"),
    ],
)
def test_the_remedy_for_many_false_alarms_names_a_field_that_the_study_has(processing, remedy):
    from sweep.spec.noise_alarms import false_alarm_remedy

    draws_section = "draws: {method: spectra, number: 2}" if "detector" in processing else ""
    spec = GridSpec.from_mapping(
        yaml.safe_load(STUDY.replace("tnr: 8", processing) + draws_section)
    )
    assert false_alarm_remedy(spec) == remedy


def test_alarms_of_an_axis_of_thresholds_and_of_cfar_are_by_design(working_directory):
    from sweep.spec.noise_alarms import false_alarm_probabilities

    text = STUDY.replace("instrument.laser.power: [1 W, 3 W]", "instrument.processing.tnr: [7, 9]")
    text = text.replace("tnr: 8", "tnr: 7")
    (any_, pfa_both), last = false_alarm_probabilities(GridSpec.from_mapping(yaml.safe_load(text)))
    p = 2.7183 ** (-(4 - 3.14159) / 4 * 49)
    assert any_ == pytest.approx(1 - (1 - p) ** 2**14, rel=1e-3)
    assert pfa_both == pytest.approx((1 - (1 - p) ** 2**13) ** 2, rel=1e-3) and last < (
        any_,
        pfa_both,
    )
    cfar = STUDY.replace("tnr: 8", "tnr: 8, detector: {kind: ca_cfar, pfa: 1e-9}")
    mapping = yaml.safe_load(cfar + "draws: {method: spectra, number: 2}")
    ((any_, _),) = false_alarm_probabilities(GridSpec.from_mapping(mapping))
    assert any_ == pytest.approx(2**14 * 1e-9, rel=1e-4)


def test_a_very_large_study_begins_only_after_a_question(working_directory, monkeypatch):
    """By its points, its bytes, and the time that it takes; a plan says so, too."""
    from sweep.cli import terminal

    text = STUDY.replace("number: 40", "number: 100000").replace(
        "[1 W, 3 W]", "{linear: [1 W, 5 W], number: 100000}"
    )
    (working_directory / "huge.yaml").write_text(text.replace("storage: {block_points: 8}", ""))
    result = sweep("run", "huge.yaml")
    refused(result, "10,000,000,000 points", "TB", "--yes")
    assert result.stderr.count("\n") == 1 and not (working_directory / "results").exists()
    requests = []
    monkeypatch.setattr(
        driver, "run", lambda study, **execution: requests.append(study) or sys.exit(0)
    )
    assert sweep("run", "huge.yaml", "--yes").exit_code == 0 and len(requests) == 1
    monkeypatch.setattr(terminal, "MEASURE_TIME_ABOVE_POINT_DRAWS", 10)
    assert sweep("run", "small.yaml").exit_code == 0 and len(requests) == 2
    with monkeypatch.context() as fewer:
        fewer.setattr(terminal, "ASK_ABOVE_POINTS", 79)
        assert "takes --yes: 80 points" in sweep("plan", "small.yaml").stdout
    monkeypatch.setattr(terminal, "ASK_ABOVE_CPU_SECONDS", 1e-9)
    refused(sweep("run", "small.yaml"), "of one core: say --yes to begin it")


@pytest.mark.parametrize("study", ["small.yaml", "hills.yaml"])
def test_a_cost_is_shown_for_what_is_simulated_and_is_no_more_than_that_of_its_points(
    working_directory, study
):
    from sweep.tasks.studies.study_loading import make_study
    from sweep.tasks.studies.study_plan import effects_table

    (working_directory / "hills.yaml").write_text(HILLS)
    rows = effects_table(
        make_study(load(working_directory / study), working_directory / "none.zarr")
    ).rows
    assert [
        row.name
        for row in rows
        if row.time_fraction == row.time_fraction and not 0 < row.time_fraction <= 1
    ] == []
    assert [
        row.name
        for row in rows
        if row.time_fraction == row.time_fraction and row.simulated_fraction == 0
    ] == []


def test_a_plan_prints_nothing_where_the_last_that_it_looks_at_is_beyond_the_model(
    working_directory, monkeypatch
):
    from sweep.model.unsupported_shot import UnsupportedShotError
    from sweep.tasks.studies import study_plan

    def raise_beyond_model(spec, **message):
        raise UnsupportedShotError("full scale is exceeded: raise it")

    monkeypatch.setattr(study_plan, "effects_table", raise_beyond_model)
    refused(sweep("plan", "small.yaml"), "full scale is exceeded: raise it")


DRAWN = """\
draws: {limit: 60, batch: 20, method: noise}
accuracy: {tolerance: 0.1}
"""


def test_a_run_that_draws_and_its_status_tell_where_the_tolerance_is_missed(working_directory):
    import numpy as np
    import xarray as xr

    from sweep.tasks.studies.store_summary import accuracy_rows_of_draws

    (working_directory / "drawn.yaml").write_text(STUDY + DRAWN)
    run = sweep("run", "drawn.yaml", "--scheduler", "none")
    status_result = sweep("status", "results/drawn.zarr")
    store = xr.open_zarr(working_directory / "results" / "drawn.zarr")
    rows = {
        row.name: row
        for row in accuracy_rows_of_draws(working_directory / "results" / "drawn.zarr")
    }
    assert list(rows) == ["pd_up", "pd_doppler", "pd_down", "pd_shot"]
    for name, row in rows.items():
        widths = store[f"{name}_half_width"]
        assert (row.n_points, row.n_points_within_tolerance) == (80, int((widths <= 0.1).sum()))
        assert (
            row.worst_error == widths.max() and row.excess_over_tolerance == row.worst_error - 0.1
        )
        assert row.n_samples_at_worst_point == 60 and row.n_draws_needed == -(
            -60 * (row.worst_error / 0.1) ** 2 // 1
        )
        worst = np.argwhere(widths.values == float(widths.max()))[0]
        assert row.worst_point_label.startswith(
            f"range {float(store.range[worst[0]]):.4g} m, power "
        )
        for result in (run, status_result):
            assert (
                f"{row.n_points_within_tolerance} of 80" in result.stdout
                and f"{row.n_draws_needed:,.0f}" in result.stdout
            )
    assert 0 < rows["pd_shot"].n_points_within_tolerance < 80
    assert store.accuracy_missed.max() == max(row.excess_over_tolerance for row in rows.values())
    promised = store.pd_shot_half_width.attrs
    assert (promised["tolerance"], promised["confidence"]) == (0.1, 0.95)


def test_a_plan_of_very_many_draws_takes_seconds_and_counts_them_all(working_directory):
    many = STUDY.replace("reflectance: 0.01}", "reflectance: 0.01, roughness: 1 um}")
    start_time = time.monotonic()
    (working_directory / "many.yaml").write_text(
        many + "draws: {limit: 1e9}\naccuracy: {tolerance: 1e-6}\n"
    )
    result = sweep("plan", "many.yaml", "--workers", "1")
    assert time.monotonic() - start_time < 60
    lines = dict(line.strip().split("  ", 1) for line in result.stdout.splitlines()[:7])
    # A draw takes 0.1 us at the least.
    assert float(lines["time a point"].split()[0]) > 1e9 * 0.1
    assert lines["time"].startswith("at most about")


def test_plan_of_ten_million_points_takes_seconds(working_directory):
    text = STUDY.replace("number: 40", "number: 100000").replace(
        "[1 W, 3 W]", "{linear: [1 W, 5 W], number: 100}"
    )
    (working_directory / "large.yaml").write_text(
        text.replace("block_points: 8", "block_points: 1")
    )
    start_time = time.monotonic()
    result = sweep("plan", "large.yaml")
    assert "10,000,000 of at most 1 range x 1 power" in result.stdout
    assert time.monotonic() - start_time < 20


def test_shot_prints_its_report_and_draws_the_shot_that_was_asked_for(working_directory):
    result = sweep(
        "shot", "small.yaml", "--at", "range=2km", "--at", "grazing_angle = 45 deg", "--no-noise"
    )
    assert result.exit_code == 0, result.stderr
    assert "2000.0000" in result.stdout and "45" in result.stdout
    files = [Path(line) for line in result.stdout.split("\n") if line.startswith("results/")]
    assert {file.suffix for file in files} == {".png", ".txt"}
    assert all(has_content(working_directory / file) for file in files)
    refused(sweep("shot", "small.yaml", "--at", "range"), "is not NAME=VALUE")
    refused(sweep("shot", "small.yaml", "--at", "rnge=2km"), "rnge: is no parameter")


def test_figures_go_next_to_the_store_or_where_asked(ran):
    paths = sweep("figures", "results/small.zarr").stdout.split()
    assert paths and all(name.startswith("results/small-figures/") for name in paths)
    requested_paths = sweep("figures", "results/small.zarr", "--output", "elsewhere").stdout.split()
    assert [Path(name).name for name in requested_paths] == [Path(name).name for name in paths]
    assert all(has_content(ran / name) for name in paths)
    assert [(ran / name).read_bytes() for name in requested_paths] == [
        (ran / name).read_bytes() for name in paths
    ]


def test_schema_prints_a_json_schema_that_names_the_sections():
    schema = json.loads(sweep("schema").stdout)
    grid, scene = (schema["$defs"][name]["properties"] for name in ("GridSpec", "SceneSpec"))
    assert {"instrument", "target", "axes"} <= grid.keys()
    assert {"instrument", "scene", "platform", "scanners"} <= scene.keys()


#: What has been imported by and by: asking for help, reading a study, and commands.
IMPORTS = """
import sys
import sweep, sweep.cli
from click.testing import CliRunner

sweep.__version__
print([m for m in ('numpy', 'dask', 'zarr', 'numba', 'pydantic') if m in sys.modules])
for command in ('status s.zarr', 'run wrong.yaml', 'run scene.yaml'):
    done = CliRunner().invoke(sweep.cli.main, command.split())
    print(done.exit_code, 'pydantic' in sys.modules, 'numba' in sys.modules)
slow = ('distributed', 'netCDF4', 'pyproj', 'rasterio', 'trimesh')
print([m for m in slow if m in sys.modules])
import sweep.tasks.driver, sweep.model.window
sweep.model.window.window_samples('hann', 8)
slow = ('stats', 'signal', 'optimize', 'interpolate', 'ndimage')
print([m for m in slow if f'scipy.{m}' in sys.modules])
"""


def test_what_takes_long_to_import_is_imported_only_where_it_is_needed(working_directory):
    """Nothing by help, no compiler by what computes nothing, and of scipy what specs need.

    scipy.signal brings scipy.stats with it, which takes longer to import than all the rest.
    """
    study = STUDY + "draws: {limit: 3}\n"  # whose status has a table of accuracy
    Path("small.yaml").write_text(study)
    Path("wrong.yaml").write_text(study.replace("reflectance", "reflektance"))
    Path("scene.yaml").write_text(study.replace("target: {", "scene: {"))
    assert sweep("run", "small.yaml", "--store", "s.zarr", "--scheduler", "none").exit_code == 0
    process = subprocess.run(
        [sys.executable, "-c", IMPORTS], capture_output=True, text=True, check=True
    )
    assert process.stdout.splitlines() == [
        "[]", "0 True False", "2 True False", "2 True False", "[]", "[]",
    ]  # fmt: skip


def test_the_package_offers_load_run_and_resume(working_directory):
    import sweep as package

    spec = package.load("small.yaml")
    outcome = package.run(spec, store="s.zarr", scheduler="none", progress=False)
    assert outcome.complete and outcome.points == 80
    assert package.resume("s.zarr", scheduler="none", progress=False).blocks_computed == 0
    assert {"load", "run", "open"} <= set(dir(package))
    with pytest.raises(AttributeError, match="nothing"):
        _ = package.nothing


def test_the_installed_command_runs_on_workers_and_can_be_interrupted(working_directory):
    (working_directory / "long.yaml").write_text(STUDY.replace("number: 40", "number: 4000"))
    command = [sys.executable, "-c", "from sweep.cli import main; main()"]
    long = subprocess.Popen(
        [*command, "run", "long.yaml", "--workers", "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    receipts = working_directory / "results" / "long.zarr" / ".sweep" / "receipts.jsonl"
    deadline = time.monotonic() + 120
    while not (receipts.exists() and receipts.read_text()) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(long.pid, signal.SIGINT)
    output, errors = long.communicate(timeout=40)
    assert long.returncode == 3
    assert "sweep resume results/long.zarr" in errors
    assert "/sweep/" not in errors  # no traceback of ours
    assert "1 worker on this machine" in errors and "dashboard" not in errors
    assert "Probability of detection" in output


def test_lines_of_progress_come_at_the_start_now_and_then_and_at_the_end(capsys, monkeypatch):
    with monkeypatch.context() as often:
        often.setattr(progress, "PROGRESS_LINE_INTERVAL_SECONDS", 0.0)
        _lines_of_progress(capsys)
    patient = progress.ProgressLines()
    patient.begin(points=100, done=0, unit="points")
    for _ in range(50):
        patient.advance(points=1, failed=0)
    assert len(capsys.readouterr().err.splitlines()) == 1


def _lines_of_progress(capsys):
    lines = progress.ProgressLines()
    lines.begin(points=100, done=20, unit="points")
    lines.advance(points=30, failed=0)
    lines.advance(points=0, failed=2)
    lines.end()
    stderr_lines = capsys.readouterr().err.splitlines()
    assert stderr_lines[0] == "20 of 100 points"
    assert stderr_lines[1].startswith("50 of 100 points, ")
    assert stderr_lines[-1].endswith("2 blocks failed")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (0.042, "0.04 s"),
        (0.96, "1 s"),
        (59.6, "1 min 00 s"),
        (200, "3 min 20 s"),
        (7320, "2 h 02 min"),
    ],
)
def test_durations_are_said_in_words(seconds, text):
    assert progress.duration_text(seconds) == text


def test_a_run_without_a_place_uses_the_specs_execution_and_options_come_first(working_directory):
    spec = GridSpec.from_mapping(
        {**yaml.safe_load(STUDY), "execution": {"workers": 3, "scheduler": "none"}},
        base=working_directory,
    )
    assert RunOptions().resolve_cluster(SpecWorkload(spec)) is None
    assert RunOptions(workers=2).resolve_cluster(SpecWorkload(spec)).workers == (2, 2)
    spec = GridSpec.from_mapping(
        {**yaml.safe_load(STUDY), "execution": {"workers": 3}}, base=working_directory
    )
    assert RunOptions().resolve_cluster(SpecWorkload(spec)).workers == (3, 3)


def test_threads_compute_unless_something_needs_workers(working_directory):
    small, large = yaml.safe_load(STUDY), yaml.safe_load(STUDY)
    large["axes"]["target.range"]["number"] = 10**6
    small, large = (
        SpecWorkload(GridSpec.from_mapping(mapping, base=working_directory))
        for mapping in (small, large)
    )
    for workload in (small, large):
        assert RunOptions().resolve_cluster(workload) is None
        assert RunOptions().n_threads(workload) == CPU_COUNT
        assert RunOptions(threads=3).n_threads(workload) == 3
        assert RunOptions(scheduler="none").resolve_cluster(workload) is None
        assert RunOptions(scheduler="none").n_threads(workload) == 1
    for options in ({"workers": 1}, {"processes": False}, {"block_timeout": 9.0},
                    {"performance_report": "r.html"}, {"evaluate": print}):  # fmt: skip
        assert RunOptions(**options).resolve_cluster(small).kind == "local"
    address = RunOptions(scheduler="tcp://10.0.0.5:8786")
    assert address.resolve_cluster(small).kind == "scheduler"
    with_code = SimpleNamespace(execution=small.execution, user_module_names=("mine",))
    assert RunOptions().resolve_cluster(with_code).kind == "local"


@pytest.mark.parametrize(
    "options", [{"workers": 2}, {"scheduler": "none"}, {"processes": False}, {"dashboard": True}]
)
def test_threads_and_an_option_of_workers_exclude_each_other(options):
    with pytest.raises(ClusterError, match=rf"threads.* and {next(iter(options))}.*leave out one"):
        RunOptions(threads=2, **options)


def test_a_study_is_extended_by_the_file_of_a_larger_one(ran):
    (ran / "larger.yaml").write_text(STUDY.replace("[1 W, 3 W]", "[1 W, 3 W, 5 W]"))
    result = sweep("extend", "results/small.zarr", "larger.yaml", "--scheduler", "none")
    assert result.exit_code == 0 and "results/small.zarr: 120 of 120 points" in result.stdout


@pytest.mark.parametrize("command", ["status x.zarr", "plan x.yaml", "figures x.zarr"])
def test_a_folder_that_was_removed_ends_in_a_line(tmp_path, monkeypatch, command):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    result = CliRunner().invoke(main, command.split(), catch_exceptions=False)
    assert result.exit_code == 2
    assert result.output == "the current folder was removed: go to another\n"


def test_beamlets_that_are_given_are_said_not_to_be_checked(working_directory):
    """37 beamlets of a spec that never asked whether they are enough."""
    message = "whether footprint.beamlets, given as 9, keeps accuracy.tolerance"
    assert message in " ".join(sweep("plan", "small.yaml").stdout.split())
    ran = sweep("run", "small.yaml", "--scheduler", "none")
    assert message in " ".join(ran.stdout.split())
    assert message in " ".join(sweep("status", "results/small.zarr").stdout.split())
    counted = STUDY.replace("{beamlets: 9, speckle: none}", "{speckle: none}")
    (working_directory / "counted.yaml").write_text(counted)
    assert "footprint.beamlets" not in sweep("plan", "counted.yaml").stdout
