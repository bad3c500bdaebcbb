"""One run over what a store lacks: blocks handed out, answers committed, an outcome at its end."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sweep.tasks import cluster, store, versions
from sweep.tasks.errors import SchedulerLost
from sweep.tasks.evaluate import Evaluate, compile_kernels
from sweep.tasks.grid import Grid
from sweep.tasks.interrupt import Interrupts
from sweep.tasks.journal import Failure, Journal, Receipt, committed
from sweep.tasks.lock import Lock
from sweep.tasks.progress import Progress
from sweep.tasks.todo import Todo
from sweep.tasks.window import Job, Window, plain
from sweep.tasks.worker import Answer

if TYPE_CHECKING:
    from distributed import Client

    from sweep.spec import Spec

#: Blocks that may fail before any succeeds: beyond, the fault is not in the blocks.
HOPELESS = 20

#: Seconds after which the kernels are being compiled and not read.
COMPILING = 2.0


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a run has come to."""

    store: Path
    points: int  # of the whole study
    blocks: int
    points_done: int  # committed, in this run or before
    blocks_done: int
    blocks_computed: int  # in this run
    failures: tuple[Failure, ...]
    stopped: str  # why the run ended before its blocks did; empty where it didn't
    seconds: float  # wall time of this run
    work_seconds: float  # evaluating and writing, summed over workers
    write_seconds: float  # the writing in it

    @property
    def complete(self) -> bool:
        """Whether every block of the study is committed."""
        return self.blocks_done == self.blocks


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where and how blocks are computed; nothing of it shows in the results."""

    client: Client | None = None
    workers: int | None = None
    scheduler: str | None = None
    threads: int = 1
    processes: bool = True
    evaluate: Evaluate | None = None

    def for_spec(self, spec: Spec) -> Place:
        """The same place, with what it leaves open taken from the spec's `execution`."""
        workers, scheduler = self.workers, self.scheduler
        if scheduler is None and workers is None:
            scheduler = spec.execution.scheduler or None
        return replace(
            self,
            workers=workers or spec.execution.workers or None,
            threads=spec.execution.threads,
            scheduler=scheduler,
        )


@dataclass
class Tally:
    """What one run has done so far."""

    points: int = 0
    blocks: int = 0
    seconds: float = 0.0
    write_seconds: float = 0.0
    failures: list[Failure] = field(default_factory=list)

    def add(self, receipt: Receipt) -> None:
        """Count a committed block."""
        self.points += receipt.points
        self.blocks += 1
        self.seconds += receipt.seconds
        self.write_seconds += receipt.write_seconds


class Session:
    """One run over what a store lacks.

    Parameters
    ----------
    path, grid
        The store and its grid.
    place
        Where to compute.
    progress
        Whom to tell.
    journal, lock
        The store's, held by this process.
    """

    def __init__(
        self, path: Path, grid: Grid, place: Place, progress: Progress, journal: Journal, lock: Lock
    ) -> None:
        self._path, self._grid, self._place = path, grid, place
        self._progress, self._journal, self._lock = progress, journal, lock
        self._names = store.output_names(grid.spec)
        self._tally = Tally()

    def to_its_end(self) -> Outcome:
        """Compute all that is left, or as much as can be."""
        begun = time.monotonic()
        done = committed(self._path, self._grid)
        before = int(np.count_nonzero(done)), self._grid.points_in(done)
        self._journal.record_session("begun", host=socket.gethostname(), pid=os.getpid())
        stopped = self._compute(Todo(done), before[1]) if before[0] < done.size else ""
        outcome = self._outcome(before, stopped, time.monotonic() - begun)
        self._journal.record_session(
            "ended", blocks=outcome.blocks_computed, failed=len(outcome.failures), stopped=stopped
        )
        return outcome

    def _outcome(self, before: tuple[int, int], stopped: str, seconds: float) -> Outcome:
        tally = self._tally
        return Outcome(
            store=self._path,
            points=self._grid.points,
            blocks=self._grid.n_blocks,
            points_done=before[1] + tally.points,
            blocks_done=before[0] + tally.blocks,
            blocks_computed=tally.blocks,
            failures=tuple(tally.failures),
            stopped=stopped,
            seconds=seconds,
            work_seconds=tally.seconds,
            write_seconds=tally.write_seconds,
        )

    def _compute(self, todo: Todo, points_before: int) -> str:
        """Compute blocks until none is left; why it ended, where it was not that."""
        with Interrupts() as interrupts, ExitStack() as stack:
            try:
                compiling = threading.Thread(target=compile_kernels, args=[self._grid], daemon=True)
                compiling.start()  # beside the workers' start, which is mostly waiting
                answers = stack.enter_context(self._answers(todo, lambda: interrupts.stopping))
                self._await(compiling)
                self._progress.begin(points=self._grid.points, done=points_before)
                stack.callback(self._progress.end)
                return self._take(answers, todo, interrupts)
            except SchedulerLost as error:
                return f"the scheduler is gone ({error})"
            except KeyboardInterrupt:
                return "stopped at once"
            except OSError as error:
                return f"the store can't be written: {error}"

    def _await(self, compiling: threading.Thread) -> None:
        """Wait for the kernels, and say so where that is not a matter of reading them from disk."""
        compiling.join(COMPILING)
        if compiling.is_alive():
            self._progress.say("compiling the model's kernels, once: some 20 s")
            compiling.join()

    @contextmanager
    def _answers(self, todo: Todo, stopping: Callable[[], bool]) -> Iterator[Iterator[Answer]]:
        place = self._place
        job = Job(str(self._path), self._grid.spec.id, versions.model(), place.evaluate)
        if place.client is not None:
            yield Window(place.client, job, todo).answers(stopping)
        elif place.scheduler == cluster.NONE:
            yield plain(job, todo, stopping)
        else:
            workers = min(place.workers or cluster.cores(), max(1, todo.left))
            with cluster.connected(
                scheduler=place.scheduler,
                workers=workers,
                threads=place.threads,
                processes=place.processes,
                say=self._progress.say,
            ) as client:
                yield Window(client, job, todo).answers(stopping)

    def _take(self, answers: Iterator[Answer], todo: Todo, interrupts: Interrupts) -> str:
        told = False
        for answer in answers:
            if not self._lock.is_mine():
                return "another process took the store's lock"
            self._commit(answer, todo)
            if interrupts.stopping and not told:
                self._progress.say("stopping when what runs is written; again to stop at once")
                told = True
            if not self._tally.blocks and len(self._tally.failures) >= HOPELESS:
                return f"the first {HOPELESS} blocks all failed"
        return "interrupted" if interrupts.stopping else ""

    def _commit(self, answer: Answer, todo: Todo) -> None:
        before = self._tally.points, len(self._tally.failures)
        for receipt in answer.receipts:
            objects = store.block_objects(self._grid, receipt.block, self._names)
            if store.is_whole(self._path, objects):
                self._journal.commit(receipt)
                self._tally.add(receipt)
            else:
                self._fail(_unseen(receipt), todo)
        for failure in answer.failures:
            self._fail(failure, todo)
        self._progress.advance(
            points=self._tally.points - before[0], failed=len(self._tally.failures) - before[1]
        )

    def _fail(self, failure: Failure, todo: Todo) -> None:
        if not todo.again(failure.block):
            self._journal.record_failure(failure)
            self._tally.failures.append(failure)


def _unseen(receipt: Receipt) -> Failure:
    return Failure(
        block=receipt.block,
        error="its chunks were written on the worker but are not in the store here: "
        "does the worker see the same file system?",
        traceback="",
        host=receipt.host,
        pid=receipt.pid,
    )
