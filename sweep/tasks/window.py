"""A rolling window of Dask tasks: never more in flight than keeps every worker busy.

The client holds twice as many tasks as there are worker slots, whatever the size of the study. A
task writes its blocks itself and returns receipts, which the client takes and lets go at once: no
result stays on a worker that its death could lose.
"""

from __future__ import annotations

import hashlib
import queue
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from sweep.tasks.errors import SchedulerLost, StoreError
from sweep.tasks.todo import Todo
from sweep.tasks.worker import STORAGE_ERRORS, Answer, Terms, failure, work

if TYPE_CHECKING:
    from dask.typing import Key
    from distributed import Client, Future
    from distributed.scheduler import KilledWorker

#: Seconds that a task should take: long beside the 3-9 ms that one costs, short beside a study.
TASK_SECONDS = 2.0
MOST_BLOCKS = 1000

#: Tasks that a scheduler is given in a second: a third of what it can take. On more than 200
#: worker threads tasks are longer for it.
TASKS_A_SECOND = 100.0

#: Seconds between looks at the scheduler, the lock and the clock while nothing arrives.
TICK = 0.5
SLOTS_AGE = 2.0
GATHER_TIMEOUT = 60.0


@dataclass(frozen=True)
class Job:
    """What every task of a run has in common; small, for it travels with each."""

    path: str
    study_id: str
    code_version: str
    terms: Terms = field(default_factory=Terms)


def plain(job: Job, todo: Todo, stopping: Callable[[], bool]) -> Iterator[Answer]:
    """Answers of a study computed here, one block after the other: what defines its bytes."""
    while not stopping() and (blocks := todo.take(1)):
        yield work(job.path, job.study_id, blocks, job.terms)


@dataclass
class Pace:
    """Blocks that make a task of a sensible length, from the time of those that came back."""

    blocks: int = 0
    seconds: float = 0.0

    def learn(self, answer: Answer) -> None:
        """Take in the measured times of an answer."""
        self.blocks += len(answer.receipts)
        self.seconds += sum(receipt.seconds for receipt in answer.receipts)

    def blocks_a_task(self, left: int, slots: int) -> int:
        """Blocks for the next task; fewer near the end, so that all workers end together."""
        if not self.blocks:
            return 1
        wanted = max(TASK_SECONDS, slots / TASKS_A_SECOND)
        fitting = int(wanted * self.blocks / max(self.seconds, 1e-9))
        return max(1, min(fitting, MOST_BLOCKS, left // (4 * slots)))


@dataclass
class Slots:
    """Worker threads of a cluster, asked for anew every few seconds: workers come and go.

    Those that may come count as well: a cluster between bounds grows with the work it sees.
    """

    client: Client
    hoped: int = 0
    count: int = 1
    addresses: tuple[str, ...] = ()  # of the workers
    asked: float = field(default=-1e9)

    def now(self) -> int:
        """Worker threads, at least 1."""
        if time.monotonic() - self.asked > SLOTS_AGE:
            threads = self.client.nthreads()
            self.count = max(1, self.hoped, sum(threads.values()))
            self.addresses = tuple(threads)
            self.asked = time.monotonic()
        return self.count


class Window:
    """Tasks in flight on a cluster.

    Parameters
    ----------
    client
        The cluster.
    hoped
        Worker threads that it may come to have.
    job
        The study.
    todo
        Its blocks.
    """

    def __init__(self, client: Client, hoped: int, job: Job, todo: Todo) -> None:
        self._client, self._job, self._todo = client, job, todo
        self._flying: dict[Key, tuple[Future, list[int]]] = {}
        self._arrived: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._pace, self._slots = Pace(), Slots(client, hoped)
        self._failed_at: dict[int, str] = {}  # address of the worker by block

    def answers(self, stopping: Callable[[], bool]) -> Iterator[Answer]:
        """Answers as they arrive; an empty one every `TICK` while none does.

        Once `stopping` says so nothing more is sent, and the iteration ends with what is out, or
        at once where there is no worker to do it.

        Raises
        ------
        SchedulerLost
            Where the scheduler, and with it what was out, is gone.
        StoreError, OSError
            Where a worker can't write to the store.
        """
        try:
            while True:
                if not stopping():
                    self._fill()
                elif not self._workers():
                    return  # nothing that is out will ever come
                if not self._flying:
                    return
                answer = self._next()
                answer.workers = len(self._slots.addresses)
                yield answer
        finally:
            self._flying.clear()  # a task without a future is cancelled

    def _fill(self) -> None:
        with self._connected():
            slots = self._slots.now()
            while len(self._flying) < 2 * slots:
                count = self._pace.blocks_a_task(self._todo.left, slots)
                if not (blocks := self._todo.take(count, suspects=not self._suspect_flies())):
                    return
                self._send(blocks)

    def _workers(self) -> int:
        """Workers that there are."""
        with self._connected():
            self._slots.now()
        return len(self._slots.addresses)

    @contextmanager
    def _connected(self) -> Iterator[None]:
        """What asks the scheduler for something, which may be gone."""
        try:
            yield
        except (OSError, CancelledError, RuntimeError) as error:
            self._check()
            raise SchedulerLost(str(error)) from error

    def _suspect_flies(self) -> bool:
        """Whether a block that failed before is out: two at once could blame each other's deed.

        Tasks on a worker that one of them kills all count as failed; a second failure is final.
        """
        return self._todo.any_failed and any(
            self._todo.attempt(blocks[0]) for _, blocks in self._flying.values()
        )

    def _send(self, blocks: list[int]) -> None:
        job = self._job
        future = self._client.submit(
            work,
            job.path,
            job.study_id,
            blocks,
            job.terms,
            key=task_key(job, blocks, self._todo.attempt(blocks[0])),
            retries=0,
            **self._elsewhere(blocks[0]),
        )
        self._flying[future.key] = (future, blocks)
        future.add_done_callback(self._arrived.put)

    def _elsewhere(self, block: int) -> dict[str, Any]:
        """Where to send a block: not where it failed before, if there is anywhere else."""
        before = self._failed_at.get(block)
        others = [address for address in self._slots.addresses if address != before]
        return {"workers": others, "allow_other_workers": True} if before and others else {}

    def _next(self) -> Answer:
        try:
            future = self._arrived.get(timeout=TICK)
        except queue.Empty:
            self._check()
            return Answer()
        _, blocks = self._flying.pop(future.key)
        answer = self._answer(future, blocks)
        self._pace.learn(answer)
        self._failed_at.update((failure.block, answer.worker) for failure in answer.failures)
        return answer

    def _answer(self, future: Future, blocks: list[int]) -> Answer:
        if future.status == "finished":
            try:
                return future.result(timeout=GATHER_TIMEOUT)
            except TimeoutError:
                pass  # lost, as below, and not computed again in that time
            except (CancelledError, OSError) as error:
                raise SchedulerLost(str(error)) from error
            except Exception as error:  # gone with its worker, computed again, and that failed
                return _failed(error, blocks)
        if future.status == "error":
            return _failed(future.exception(), blocks)
        if future.status == "cancelled":
            raise SchedulerLost("its tasks were cancelled")
        self._todo.put_back(blocks)  # the worker died between its answer and our asking for it
        return Answer()

    def _check(self) -> None:
        if self._client.status != "running":
            raise SchedulerLost(f"the client is {self._client.status}")


def _failed(error: BaseException, blocks: list[int]) -> Answer:
    """Answer of a task that raised or killed its workers: any of its blocks may be to blame."""
    from distributed.scheduler import KilledWorker

    if isinstance(error, StoreError):
        raise error
    if isinstance(error, OSError) and error.errno in STORAGE_ERRORS:
        raise error
    failures = [failure(block, error) for block in blocks]
    if isinstance(error, KilledWorker):
        failures = [replace(each, error=_killed(error)) for each in failures]
    return Answer(failures=failures)


def _killed(error: KilledWorker) -> str:
    died = f"{error.allowed_failures + 1} worker{'s' if error.allowed_failures else ''} died at it"
    return f"KilledWorker: {died}: out of memory, stuck beyond --block-timeout, or killed"


def task_key(job: Job, blocks: list[int], attempt: int) -> str:
    """Key of a task: the same work for the same store is the same task, whoever asks."""
    said = repr((job.path, job.study_id, job.code_version, blocks, attempt)).encode()
    digest = hashlib.blake2b(said, digest_size=12).hexdigest()
    return f"blocks-{job.study_id[:8]}-{blocks[0]}-{digest}"
