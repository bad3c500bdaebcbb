"""Signals that arrive while compiled code runs are seen in seconds, not after it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_studies import receipt_blocks, run_serially, small_spec

import sweep
from sweep.messages import EXIT_INCOMPLETE
from sweep.tasks.engine import interrupts
from sweep.tasks.engine.interrupts import InterruptHandler
from sweep.tasks.engine.progress import Progress
from sweep.tasks.engine.session import ComputeBackend

RUN = """
import os, sys, time
from contextlib import nullcontext
from pathlib import Path

store, as_what, sys.path[:0] = sys.argv[1], sys.argv[2], sys.argv[3:]
from small_studies import small_spec
import numpy as np
import sweep
from sweep.kernel_cache import njit
from sweep.messages import suggest_shell_commands

@njit()
def spin(n):
    total = 0.0
    for i in range(n):
        total += np.sqrt(i + total)
    return total

start = time.monotonic()
spin(10**6)
start = time.monotonic()
spin(10**8)
per_second = int(1e8 / (time.monotonic() - start))

def long(study, block):
    results = study.evaluate(block)
    if block == 2:
        Path(store).with_suffix(".spins").touch()
        spin(SECONDS * per_second)
    return results

with suggest_shell_commands() if as_what == "command" else nullcontext():
    outcome = sweep.run(small_spec(), store=store, scheduler="none", evaluate=long)
print(outcome.blocks_done, outcome.stop_reason, flush=True)
sys.exit(0 if outcome.complete else 3)
"""

LONG = 60
"""Seconds that the call of compiled code takes."""


class Run:
    """A process that is in a call of compiled code, in the third block of its study."""

    def __init__(self, folder, as_what, seconds=LONG):
        self.store = folder / "store.zarr"
        paths = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
        self.errors = folder / "errors"
        command = [sys.executable, "-c", RUN.replace("SECONDS", str(seconds))]
        with self.errors.open("w") as errors:
            self.process = subprocess.Popen(
                [*command, str(self.store), as_what, *paths],
                stdout=subprocess.PIPE, stderr=errors, text=True,
            )  # fmt: skip
        end = time.monotonic() + 200
        while not (folder / "store.spins").exists():
            assert self.process.poll() is None, self.errors.read_text()
            assert time.monotonic() < end
            time.sleep(0.05)
        time.sleep(0.3)

    def send(self, number):
        """Send a signal; return the time."""
        self.process.send_signal(number)
        return time.monotonic()

    def hear(self, text, since):
        """Wait for words; return the time since then [s]."""
        while text not in self.errors.read_text() and time.monotonic() < since + LONG:
            time.sleep(0.02)
        assert text in self.errors.read_text()
        return time.monotonic() - since


@pytest.fixture
def run(tmp_path):
    started = []

    def start(*options):
        started.append(Run(tmp_path, *options))
        return started[-1]

    yield start
    for driver_process in started:
        driver_process.process.kill()
        driver_process.process.communicate()


def assert_goes_on(store):
    assert len(receipt_blocks(store)) == 2
    outcome = sweep.resume(store, scheduler="none", progress=False)
    assert outcome.complete and outcome.blocks_computed == outcome.blocks - 2


@pytest.mark.parametrize(
    ("as_what", "code"), [("command", EXIT_INCOMPLETE), ("program", 128 + signal.SIGTERM)]
)
def test_sigterm_ends_a_run_in_compiled_code_within_seconds(run, as_what, code):
    """A batch system kills what is left after 30 s."""
    long = run(as_what)
    since = long.send(signal.SIGTERM)
    assert long.process.wait(10) == code and time.monotonic() - since < 5
    assert "resume" in long.errors.read_text()
    assert_goes_on(long.store)


def test_one_ctrl_c_in_compiled_code_is_answered_and_the_second_ends_the_command(run):
    long = run("command")
    since = long.send(signal.SIGINT)
    assert long.hear("again to stop at once", since) < 4
    time.sleep(1.0)
    assert long.process.poll() is None
    since = long.send(signal.SIGINT)
    assert long.process.wait(10) == EXIT_INCOMPLETE and time.monotonic() - since < 5
    assert_goes_on(long.store)


def test_ctrl_c_twice_never_ends_a_program_of_the_users(run):
    """A notebook would lose all that it holds."""
    long = run("program", 12)
    since = long.send(signal.SIGINT)
    long.hear("again to stop at once", since)
    since = long.send(signal.SIGINT)
    assert long.hear("as soon as it returns", since) < 4
    assert long.process.wait(60) == 3
    assert long.process.stdout.read().split(maxsplit=1)[1].strip() in (
        "interrupted", "stopped at once",
    )  # fmt: skip


def test_a_closed_terminal_lets_compiled_code_end(run):
    long = run("command", 8)
    long.send(signal.SIGHUP)
    assert long.process.wait(60) == EXIT_INCOMPLETE
    assert long.process.stdout.read().strip() == "3 interrupted"


class Listener(Progress):
    def __init__(self):
        self.lines = []

    def say(self, text):
        self.lines.append(text)


def test_after_sigterm_a_block_that_does_not_end_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(interrupts, "SIGTERM_GRACE_SECONDS", 1.0)
    interruptions = []

    def long(study, block):
        if block == 2:
            interruptions.append(time.monotonic())
            os.kill(os.getpid(), signal.SIGTERM)
            while time.monotonic() < interruptions[0] + LONG:
                time.sleep(0.01)
        return study.evaluate(block)

    outcome = run_serially(small_spec(), tmp_path / "store.zarr", scheduler="none", evaluate=long)
    assert time.monotonic() - interruptions[0] < 5
    assert outcome.stop_reason == "stopped at once" and outcome.blocks_done == 2
    assert_goes_on(tmp_path / "store.zarr")


def test_what_ends_soon_after_sigterm_is_committed(tmp_path):
    def soon(study, block):
        if block == 1:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.5)
        return study.evaluate(block)

    outcome = run_serially(small_spec(), tmp_path / "store.zarr", scheduler="none", evaluate=soon)
    assert outcome.stop_reason == "interrupted" and outcome.blocks_done == 2
    assert_goes_on(tmp_path / "store.zarr")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_announced_at_once_where_python_runs(number):
    listener = Listener()
    with InterruptHandler(listener) as handler:
        os.kill(os.getpid(), number)
        end = time.monotonic() + 5
        while not listener.lines and time.monotonic() < end:
            time.sleep(0.01)
        assert handler.is_stopping and len(listener.lines) == 1
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
            time.sleep(5)
    assert signal.set_wakeup_fd(-1) == -1


def test_signals_of_others_leave_a_run_alone(tmp_path):
    signals = []
    before = signal.signal(signal.SIGUSR1, lambda *_: signals.append(True))
    try:
        with InterruptHandler() as handler:
            for _ in range(3):
                os.kill(os.getpid(), signal.SIGUSR1)
                time.sleep(0.05)
            assert run_serially(small_spec(), tmp_path / "s.zarr", scheduler="none").complete
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert len(signals) == 3 and not handler.is_stopping


def test_sigterm_while_workers_start_has_a_deadline_too(tmp_path, monkeypatch):
    """As of a worker whose imports hang, which its nanny starts again and again."""
    monkeypatch.setattr(interrupts, "SIGTERM_GRACE_SECONDS", 0.5)

    def hang(backend, *_):
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(200):
            time.sleep(0.05)
        raise AssertionError("not stopped")

    monkeypatch.setattr(ComputeBackend, "iter_results", hang)
    outcome = run_serially(small_spec(), tmp_path / "s.zarr")
    assert outcome.stop_reason == "stopped at once" and not outcome.complete
    assert outcome.seconds < 8
    monkeypatch.undo()
    assert sweep.resume(outcome.store, scheduler="none", progress=False).complete
