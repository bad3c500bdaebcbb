"""Whoever listens may go away: a study is computed all the same, and its exit code says how far."""

import fcntl
import io
import json
import os
import pty
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner
from small_studies import small_mapping, small_spec

import sweep
from sweep.cli import main
from sweep.storage.locations import JOURNAL_DIR
from sweep.tasks.engine import progress
from sweep.tasks.engine.interrupts import InterruptHandler
from sweep.tasks.engine.text_streams import ForgivingStream, StallTolerantStream, is_terminal
from sweep.tasks.studies import store_summary

SWEEP = [sys.executable, "-c", "from sweep.cli import main; main()"]


class Failing(io.StringIO):
    """A stream whose every write fails."""

    def __init__(self, error):
        super().__init__()
        self.raised, self.calls = error, 0

    def write(self, text):
        self.calls += 1
        raise self.raised


@pytest.mark.parametrize(
    "error", [OSError(28, "full"), BrokenPipeError(32, "gone"), OSError(5, "EIO"), ValueError()]
)
def test_a_stream_that_fails_goes_silent(error):
    inside = Failing(error)
    stream = ForgivingStream(inside)
    print("one", file=stream, flush=True)
    print("two", file=stream, flush=True)
    assert inside.calls == 1 and stream.failure is error


def test_a_stream_that_is_missing_closed_or_no_stream_takes_everything():
    closed = io.StringIO()
    closed.close()
    for inside in (None, closed, object()):
        stream = ForgivingStream(inside)
        print("text", file=stream, flush=True)
        stream.finish_writing()
        assert not stream.isatty() and not is_terminal(inside) and stream.encoding
        with pytest.raises(io.UnsupportedOperation):
            stream.fileno()


def test_letters_that_an_encoding_lacks_are_written_by_their_numbers():
    inside = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    stream = ForgivingStream(inside)
    print("5 µm", file=stream, flush=True)
    assert inside.buffer.getvalue() == b"5 \\xb5m\n" and stream.failure is None


def test_a_reader_that_is_late_misses_words_and_hears_later_ones():
    class Late(io.StringIO):
        is_late = True

        def write(self, text):
            if self.is_late:
                raise BlockingIOError(11, "try again")
            return super().write(text)

    inside = Late()
    stream = ForgivingStream(inside)
    stream.write("one")
    inside.is_late = False
    stream.write("two")
    assert inside.getvalue() == "two"


@pytest.fixture
def spec(tmp_path):
    file = tmp_path / "study.yaml"
    file.write_text(yaml.safe_dump(small_mapping()))
    return file


@pytest.mark.parametrize("lost", ["full", "gone", "closed"])
def test_the_exit_code_is_that_of_the_study_where_nobody_hears_what_is_said(tmp_path, spec, lost):
    store = tmp_path / "store.zarr"
    command = [*SWEEP, "run", str(spec), "--store", str(store), "--scheduler", "none"]
    if lost == "closed":
        process = subprocess.run(
            ["sh", "-c", 'exec "$@" >&- 2>&- <&-', "sh", *command], check=False
        )
    elif lost == "full":
        with open("/dev/full", "w") as full:
            process = subprocess.run(command, stdout=full, stderr=full, check=False)
    else:
        reading, writing = os.pipe()
        os.close(reading)
        process = subprocess.run(command, stdout=writing, stderr=writing, check=False)
        os.close(writing)
    assert process.returncode == 0
    assert sweep.open(store).blocks_committed == 9


def test_lost_output_is_reported_where_errors_are_seen(tmp_path, spec):
    with open("/dev/full", "w") as full:
        process = subprocess.run([*SWEEP, "schema"], stdout=full, stderr=subprocess.PIPE, text=True)
    assert (
        process.stderr == "standard output can't be written: [Errno 28] No space left on device\n"
    )


RUN = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from small_studies import small_spec
import sweep

def evaluate(study, block):
    time.sleep(0.3)
    return study.evaluate(block)

if __name__ == "__main__":
    where = {"workers": 2} if sys.argv[4] == "workers" else {"scheduler": "none"}
    outcome = sweep.run(small_spec(), store=sys.argv[1], evaluate=evaluate, **where)
    Path(sys.argv[2]).write_text(f"{outcome.blocks_done} {outcome.stop_reason}")
"""


def in_a_terminal(command):
    """Process in a terminal of its own, and that terminal."""
    master, slave = pty.openpty()
    # setsid makes it the leader of a session, whose terminal is the first that it opens
    started = subprocess.Popen(
        [sys.executable, "-c", "import os, sys; os.setsid(); os.close(os.open(os.ttyname(0), 2)); "
         "os.execv(sys.argv[1], sys.argv[1:])", *command],
        stdin=slave, stdout=slave, stderr=slave,
    )  # fmt: skip
    os.close(slave)
    return started, master


@pytest.mark.parametrize("lost_stream", ["none", "workers"])
def test_a_run_whose_terminal_is_closed_stops_and_can_be_resumed(tmp_path, lost_stream):
    store, output_path = tmp_path / "store.zarr", tmp_path / "said"
    script = tmp_path / "script.py"
    script.write_text(RUN)
    tests = str(Path(__file__).parent / "tasks")
    command = [sys.executable, str(script), str(store), str(output_path), tests, lost_stream]
    started, terminal = in_a_terminal(command)
    log = store / JOURNAL_DIR / "receipts.jsonl"
    end = time.monotonic() + 120
    while not log.exists() or log.read_bytes().count(b"\n") < 2:
        assert started.poll() is None and time.monotonic() < end
        time.sleep(0.05)
    os.close(terminal)  # SIGHUP, and EIO for whatever is written
    assert started.wait(120) == 0
    blocks, _, stopped = output_path.read_text().partition(" ")
    assert stopped == "interrupted" and 2 <= int(blocks) < 12
    events = [json.loads(line) for line in (store / JOURNAL_DIR / "sessions.jsonl").open()]
    assert events[-1]["event"] == "ended" and events[-1]["stopped"] == "interrupted"
    assert sweep.resume(store, progress=False, scheduler="none").complete


@pytest.mark.parametrize("lost_stream", ["none", "workers"])
def test_a_run_whose_terminal_is_stopped_goes_on_to_its_end(tmp_path, lost_stream):
    """Run on a terminal that Ctrl-S has stopped from the start."""
    store, output_path, script = (tmp_path / name for name in ("store.zarr", "said", "script.py"))
    script.write_text(RUN)
    tests = str(Path(__file__).parent / "tasks")
    master, slave = pty.openpty()
    termios.tcflow(slave, termios.TCOOFF)
    # Warnings are Python's to print, which waits for the terminal.
    options = [sys.executable, "-W", "ignore", str(script)]
    command = [*options, str(store), str(output_path), tests, lost_stream]
    started = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave)
    assert started.wait(120) == 0
    assert output_path.read_text() == "12 "
    os.close(slave)
    os.close(master)


LOGGING_CLUSTER = """
import logging, sys
from pathlib import Path
from sweep.spec.cluster_config import LocalClusterConfig
from sweep.tasks.engine.cluster_connection import connect_cluster

def log_and_print():
    for name in ("distributed.core", "distributed.client", "tornado.application"):
        logging.getLogger(name).warning("the event loop was unresponsive " * 100)
    print("text " * 100, flush=True)
    return 1

if __name__ == "__main__":
    cluster = LocalClusterConfig(kind="local")
    with connect_cluster(cluster, max_workers=1, processes=True, say=lambda text: None) as reached:
        client = reached.client
        number = sum(client.submit(log_and_print, pure=False).result() for _ in range(5))
        sys.stdout = open("/dev/null", "w")  # what a program prints is its own to wait for
        number += sum(client.run_on_scheduler(log_and_print) for _ in range(5)) + log_and_print()
    Path(sys.argv[1]).write_text(str(number))
"""


def test_nothing_that_dask_logs_waits_for_a_terminal_that_is_stopped(tmp_path):
    """Log and print in workers, log in the scheduler's loop and in the main thread."""
    output_path, script = tmp_path / "said", tmp_path / "script.py"
    script.write_text(LOGGING_CLUSTER)
    master, slave = pty.openpty()
    termios.tcflow(slave, termios.TCOOFF)
    command = [sys.executable, "-W", "ignore", str(script), str(output_path)]
    started = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave)
    try:
        assert started.wait(120) == 0
    finally:
        started.kill()
    assert output_path.read_text() == "11"
    os.close(slave)
    os.close(master)


def test_a_stream_whose_reader_stops_takes_no_time_and_goes_on_with_it():
    reading, writing = os.pipe()
    pipe_bytes = fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, 4096)
    with open(writing, "w") as inside, open(reading, "rb") as reader:
        stream = StallTolerantStream(inside)
        print("first", file=stream, flush=True)
        assert os.read(reading, 100) == b"first\n"
        start_time = time.monotonic()
        for number in range(200):
            print(f"{number} " + pipe_bytes // 8 * ".", file=stream, flush=True)
        assert time.monotonic() - start_time < 3.0
        received = b""
        while b"199 " not in received:
            received += reader.read1()
        assert received.startswith(b"0 ...")


def test_a_process_that_ignores_hangups_goes_on_ignoring_them():
    """As nohup has it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with InterruptHandler() as interrupts:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not interrupts.is_stopping
    finally:
        signal.signal(signal.SIGHUP, before)


def test_hangups_stop_a_run_and_never_at_once():
    """A shell, and the system, send one each."""
    with InterruptHandler() as interrupts:
        os.kill(os.getpid(), signal.SIGHUP)
        os.kill(os.getpid(), signal.SIGHUP)
        assert interrupts.is_stopping


class NoTerminal:
    """A stream of a service's, with the least of methods."""

    def write(self, text):
        raise OSError(28, "No space left on device")


@pytest.mark.parametrize("stream", [None, NoTerminal(), Failing(BrokenPipeError())])
def test_a_program_without_standard_error_computes(tmp_path, monkeypatch, stream):
    monkeypatch.setattr(sys, "stderr", stream)
    assert sweep.run(small_spec(), store=tmp_path / "s.zarr", scheduler="none").complete


def test_a_bar_whose_terminal_is_gone_goes_on(monkeypatch):
    stream = Failing(OSError(5, "Input/output error"))
    stream.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", stream)
    bar = progress.make_progress(True)
    assert isinstance(bar, progress.ProgressBar)
    bar.begin(points=2, done=0, unit="points")
    bar.say("something")
    bar.advance(points=2, failed=0)
    bar.end()


class SilentProgress(progress.Progress):
    """A listener with a mistake in it."""

    def __init__(self):
        self.called = 0

    def advance(self, *, points, failed):
        self.called += 1
        raise RuntimeError("the window was closed")


def test_a_listener_that_fails_gets_no_more_calls(tmp_path, caplog):
    deaf = SilentProgress()
    assert sweep.run(
        small_spec(), store=tmp_path / "s.zarr", scheduler="none", progress=deaf
    ).complete  # fmt: skip
    assert deaf.called == 1
    assert [record.getMessage() for record in caplog.records] == [
        "the listener to the progress failed in advance (RuntimeError: the window was closed): "
        "the run goes on without it"
    ]


def test_a_table_that_can_not_be_made_is_no_failure_of_the_study(tmp_path, spec, monkeypatch):
    def fail(store):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(store_summary, "detection_summary", fail)
    arguments = ["run", str(spec), "--store", str(tmp_path / "s.zarr"), "--scheduler", "none"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    assert "no table of the results: OSError: [Errno 24] Too many open files" in result.output
    assert "computed 9 of 9 blocks" in result.output
