"""What a run says, and does, whose cluster has no worker."""

import os
import signal
import time

import pytest
from distributed import Client, LocalCluster
from small import small, tree

from sweep.tasks import session, window
from sweep.tasks.driver import run
from sweep.tasks.progress import Silent


class Told(Silent):
    """Progress that does something when a line is said, and once as the first points arrive."""

    def __init__(self, at_line, at_first=lambda: None) -> None:
        self.lines, self.work, self._at_line, self._at_first = [], [], at_line, at_first

    def advance(self, *, points, failed):
        if points:
            self._at_first()
            self._at_first = lambda: None

    def at_work(self, *, workers, stored):
        self.work.append((workers, stored))

    def say(self, text):
        self.lines.append(text)
        self._at_line()


@pytest.fixture
def without_workers(monkeypatch):
    """A cluster that has none, looked at often."""
    monkeypatch.setattr(session, "ABSENT", 0.2)
    monkeypatch.setattr(window, "SLOTS_AGE", 0.1)
    monkeypatch.setattr(window, "TICK", 0.1)
    with (
        LocalCluster(
            n_workers=0, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield cluster, client


def test_that_workers_do_not_come_or_went_away_is_said_and_the_run_goes_on_with_the_next(
    undisturbed, tmp_path, without_workers
):
    cluster, client = without_workers

    def slowly(study, block):
        time.sleep(0.05)
        return study.evaluate(block)

    told = Told(lambda: cluster.scale(1), lambda: cluster.scale(0))
    outcome = run(small(), store=tmp_path / "s.zarr", client=client, progress=told, evaluate=slowly)
    assert outcome.complete and tree(outcome.store) == tree(undisturbed)
    assert told.lines[0].startswith("no worker yet (")
    assert "Ctrl-C stops, nothing is lost" in told.lines[0]
    assert any(line.startswith("no worker is left (") for line in told.lines)
    assert {0, 1} <= {workers for workers, _ in told.work}
    assert told.work[-1][1] > 72 * 8


def test_one_ctrl_c_stops_a_run_that_no_worker_will_end(tmp_path, without_workers):
    _, client = without_workers
    told = Told(lambda: os.kill(os.getpid(), signal.SIGINT) if len(told.lines) == 1 else None)
    outcome = run(small(), store=tmp_path / "s.zarr", client=client, progress=told)
    assert outcome.stopped == "interrupted" and outcome.blocks_done == 0
    assert told.lines[0].startswith("no worker yet (")


def test_word_of_absent_workers_comes_ever_less_often(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(session.time, "monotonic", lambda: clock[0])
    absence, said = session.Absence(), []
    for clock[0] in range(1000):
        workers = 1 if 300 <= clock[0] < 310 else 0
        if absence.told(workers):
            said.append(clock[0])
    assert said == [20, 40, 80, 160, 329, 349, 389, 469, 629, 949]


def test_a_worker_that_went_before_it_was_counted_had_been_there_if_it_answered(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(session.time, "monotonic", lambda: clock[0])
    absence = session.Absence()
    assert absence.told(0) == absence.told(0, worked=True) == ""
    clock[0] = session.ABSENT + 1
    assert absence.told(0).startswith("no worker is left (")
