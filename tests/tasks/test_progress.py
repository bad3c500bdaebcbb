"""Messages while nothing else is to be seen: truthful, and never late."""

import time

import pytest
from click.testing import CliRunner
from numba.core.event import trigger_event
from small_studies import small_mapping, small_spec

from sweep.cli import main
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.tasks.driver import run
from sweep.tasks.engine import progress
from sweep.tasks.studies.grid_study import GridStudy


class LinesProgress(progress.Progress):
    """Progress that keeps what is said."""

    def __init__(self):
        self.lines = []

    def say(self, text):
        self.lines.append(text)

    def until(self, words):
        """Wait until a line begins with these words."""
        end = time.monotonic() + 60
        while not any(line.startswith(words) for line in self.lines):
            assert time.monotonic() < end, self.lines
            time.sleep(0.01)


@pytest.fixture
def at_once(monkeypatch):
    """No time that passes before something is said, and little between lines."""
    monkeypatch.setattr(progress, "ACTIVITY_MESSAGE_DELAY_SECONDS", 0.01)
    monkeypatch.setattr(progress, "PROGRESS_LINE_INTERVAL_SECONDS", 0.01)


def compiling():
    """As numba tells of a function that it compiles."""
    return trigger_event("numba:compile", data={})


@pytest.mark.usefixtures("at_once")
def test_functions_are_counted_only_while_they_are_compiled():
    recording = LinesProgress()
    with progress.show_activity("planning", recording):
        recording.until("planning, 0.0")
        assert not any("compiling" in line for line in recording.lines)
        with compiling():
            recording.until("compiling the model, once; functions so far: 0")
            with compiling():
                pass
            recording.until("compiling the model, once; functions so far: 1")
        recording.lines.clear()
        recording.until("planning")
    after = len(recording.lines)
    time.sleep(0.05)
    assert len(recording.lines) == after and "compiling" not in recording.lines[-1]


def test_short_compilations_are_not_reported():
    recording = LinesProgress()
    with progress.show_activity("planning", recording), compiling():
        pass
    assert recording.lines == []


@pytest.mark.parametrize("number, words", [(1, "1 thread, 5.0 kB"), (4, "4 threads, 5.0 kB")])
def test_threads_of_the_command_are_counted_as_threads(capsys, number, words):
    lines = progress.ProgressLines()
    lines.update_threads(threads=number, stored=5_000)
    lines.end()
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("base", [progress.Progress, object])
def test_a_listener_that_knows_workers_alone_is_informed_of_threads(base):
    class WorkerCounts(base):
        counts = ()

        def update_workers(self, *, workers, stored):
            self.counts = (*self.counts, (workers, stored))

    listener = WorkerCounts()
    progress.make_progress(listener).update_threads(threads=3, stored=7)
    assert listener.counts == ((3, 7),)


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_bar_cuts_no_number(monkeypatch, capsys, width):
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    bar = progress.ProgressBar()
    bar.begin(points=12_345_678, done=1_234_567, unit="points")
    bar.update_workers(workers=12, stored=3_100_000)
    bar.advance(points=1_000, failed=3)
    bar.end()
    stderr = capsys.readouterr().err
    for number in ("1,235,567", "12,345,678", "3"):
        assert number in stderr
    assert "…" not in stderr and ("12 workers, 3.1 MB" in stderr) == (width == 120)


@pytest.mark.usefixtures("at_once")
def test_a_run_that_compiles_nothing_does_not_say_that_it_compiles(tmp_path, monkeypatch):
    progress = LinesProgress()
    monkeypatch.setattr(
        GridStudy, "compile_kernels", lambda study: progress.until("loading the model")
    )
    run(small_spec(axes={}), store=tmp_path / "small.zarr", scheduler="none", progress=progress)
    assert not any("compiling" in line for line in progress.lines)


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize(
    "arguments, inner",
    [
        (("plan", "small.yaml"), "sweep.tasks.studies.study_plan.effects_table"),
        (("shot", "small.yaml"), "sweep.analysis.shot_spectra.write_shot_report"),
        (
            ("spectra", "small.yaml", "-o", "s.npz"),
            "sweep.tasks.studies.spectra_export.draw_point_spectra",
        ),
        (("figures", "small.zarr"), "sweep.analysis.study_figures.draw_figures"),
        (("export", "small.zarr", "s.csv"), "sweep.analysis.scene_results.point_export.export"),
        (
            ("compare", "small.zarr", "small.zarr"),
            "sweep.analysis.answers.comparison.compute_tabulated_differences",
        ),
    ],
)
def test_commands_say_that_they_compile(serial_store, tmp_path, monkeypatch, arguments, inner):
    import yaml

    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(small_mapping()))
    (tmp_path / "small.zarr").symlink_to(serial_store)
    recording = LinesProgress()
    monkeypatch.setattr(progress.ProgressLines, "say", lambda self, text: recording.say(text))

    def compiled(*_, **__):
        with compiling():
            recording.until("compiling the model, once; functions so far: 0")
        raise UnsupportedShotError("enough")

    monkeypatch.setattr(inner, compiled)
    result = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert result.exit_code == 2 and "enough" in result.stderr
