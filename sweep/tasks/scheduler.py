"""A rolling window of Dask tasks: never more in flight than keeps every worker busy.

A task writes its blocks itself and returns receipts, which the client takes and lets go at once: no
result stays on a worker that its death could lose.
"""

from __future__ import annotations

import hashlib
import logging
import queue
import textwrap
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass, field, replace
from itertools import chain, takewhile
from typing import TYPE_CHECKING, Any

from sweep.messages import counted, option_name
from sweep.storage.opening import NotAStoreError
from sweep.tasks.journal import Receipt
from sweep.tasks.progress import SchedulerLost, StoreError, duration
from sweep.tasks.worker import NOT_HERE, TICK, Answer, BlockQueue, Job, Seen, failure, work

if TYPE_CHECKING:
    from dask.typing import Key
    from distributed import Client, Future

#: Seconds that a task should take: long beside the 3-9 ms that one costs, short beside a study.
TASK_SECONDS = 2.0
MOST_BLOCKS = 1000

#: Tasks that a scheduler is given in a second: a third of what it can take. On more than 200
#: worker threads tasks are longer for it.
TASKS_A_SECOND = 100.0

#: Seconds between looks at the workers that there are.
SLOTS_AGE = 2.0

#: Seconds after which a worker that does not answer is silent; longer where its blocks are.
LEASE = 30.0

#: Seconds in which a file server shows here what a worker has written: Linux's NFS keeps what it
#: knows of a folder for as long.
LATENCY = 60.0

#: Time without an answer after which a run is told to stall [s]; longer where tasks take longer.
STALL_SECONDS = 60.0

#: Time in which the first answer of a run may be that late, as workers compile the model [s].
COMPILATION_SECONDS_MAX = 600.0

#: Times that a task should take after which a run is told to stall.
STALL_TASKS = 5.0

#: Largest number of tasks, and of workers, that a summary of the state lists.
TASKS_SHOWN, WORKERS_SHOWN = 5, 10

SAME_PLACE = "workers have to see the store's folder, under the same path"

Say = Callable[[str], None]

_log = logging.getLogger("sweep.scheduler")


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
    """Worker threads of a cluster, or those that may come, asked for anew every few seconds."""

    client: Client
    hoped: int = 0
    count: int = 1
    threads: dict[str, int] = field(default_factory=dict)  # by address of the worker
    asked: float = -1e9

    def now(self) -> int:
        """Worker threads, at least 1."""
        if time.monotonic() - self.asked > SLOTS_AGE:
            self.threads = dict(self.client.nthreads())
            self.count = max(1, self.hoped, sum(self.threads.values()))
            self.asked = time.monotonic()
        return self.count


@dataclass(eq=False)
class _Task:
    """Blocks that are out: at one worker, and again at others where that one is silent."""

    blocks: list[int]
    futures: dict[Key, Future] = field(default_factory=dict)
    sent: float = 0.0  # last


class Scheduler:
    """Tasks in flight on a cluster.

    A worker that can't open the store, can't write to it, or writes to another one is left out,
    and its blocks go to the others. Blocks of a silent worker are computed by others too, once
    these have nothing else to do; the first answer counts. ``seen`` tells whether what a
    receipt is for is in the store here: by its size, or read and held to its digest, as the
    first block of each worker is.
    """

    def __init__(
        self, client: Client, hoped: int, job: Job, blocks: BlockQueue, *, seen: Seen, say: Say
    ) -> None:
        self._client, self._job, self._blocks = client, job, blocks
        self._seen, self._say = seen, say
        self._flying: dict[Key, _Task] = {}
        self._outrun: dict[Key, Future] = {}  # out still, though another worker has answered
        self._arrived: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._pace, self._slots = Pace(), Slots(client, hoped)
        self._copies: Counter[int] = Counter()  # how often a task's first block was sent again
        self._failed_at: dict[int, str] = {}  # address of the worker by block
        self._heard: dict[str, float] = {}  # when a worker last answered
        self._relieved = self._looked = time.monotonic()
        self._unseen: list[tuple[Receipt, str, float]] = []  # of which worker, looked for till when
        self._trusted: set[str] = set()  # workers that have written to the store that is here
        self._unfit: dict[str, int] = {}  # workers that are left out, and their threads
        self._stall_clock = time.monotonic()  # when an answer last arrived
        self._stall_patience = STALL_SECONDS  # time from then until the next word of it
        self._stall_told = False  # since then

    def answers(self, stopping: Callable[[], bool]) -> Iterator[Answer]:
        """Answers as they arrive; an empty one every `TICK` while none does.

        Once `stopping` says so nothing more is sent, and the iteration ends with what is
        out, or at once where there is no worker to do it. SchedulerLost where the scheduler
        is gone; StoreError, OSError where no worker can write to the store.
        """
        try:
            while True:
                try:
                    self._fill(sending=not stopping())
                except Exception as error:  # of a client that is closed, of any kind
                    self._check()
                    if isinstance(error, OSError | CancelledError | RuntimeError):
                        raise SchedulerLost(str(error)) from error
                    raise
                if stopping() and not (self._flying and self._fit()):
                    return  # nothing that is out will ever come
                if not (self._flying or self._unseen or self._waits):
                    return
                answer = self._next()
                answer.workers = len(self._fit())
                yield answer
        finally:
            self._flying.clear()  # a task without a future is cancelled
            self._outrun.clear()

    def state_summary(self) -> str:
        """Describe the blocks, tasks and workers of the run, one to a line."""
        now = time.monotonic()
        tasks = set(self._flying.values())
        lines = [
            f"{counted(self._blocks.left, 'block')} not yet sent, "
            f"{len(self._blocks.failed):,} failed once, "
            f"{len(self._unseen):,} written but not yet found in the store",
            f"{counted(len(tasks), 'task')} in flight, {len(self._outrun):,} superseded; "
            f"{counted(self._pace.blocks, 'block')} came back in "
            f"{duration(self._pace.seconds)} of work",
        ]
        lines += [
            f"task of block {task.blocks[0]} and {len(task.blocks) - 1} more: sent "
            f"{duration(now - task.sent)} ago, {counted(len(task.futures), 'time')}; Dask says "
            f"{', '.join(sorted({str(future.status) for future in task.futures.values()}))}"
            for task in sorted(tasks, key=lambda task: task.sent)[:TASKS_SHOWN]
        ]
        for worker, threads in sorted(self._slots.threads.items())[:WORKERS_SHOWN]:
            answered = self._heard.get(worker)
            heard = "never" if answered is None else f"{duration(now - answered)} ago"
            excluded = ", left out" if worker in self._unfit else ""
            lines.append(
                f"worker {worker}: {counted(threads, 'thread')}, last answer {heard}{excluded}"
            )
        return "\n".join(lines)

    def _watch_for_stall(self) -> None:
        """Tell that nothing comes back, after ever longer times, and log what is out where."""
        if not self._flying or not self._fit():  # that no worker is there is told by others
            self._stall_clock = time.monotonic()
        waited = time.monotonic() - self._stall_clock
        if waited < self._stall_patience:
            return
        summary = self.state_summary()
        _log.info("nothing came back for %s:\n%s", duration(waited), summary)
        told = f"no block has come back for {duration(waited)}"
        if not self._heard and waited < COMPILATION_SECONDS_MAX:
            self._stall_patience = min(2 * waited, COMPILATION_SECONDS_MAX)
            self._say(
                f"{told}: workers load the model, or compile it once, which takes minutes where "
                "the machine is busy"
            )
            return
        is_first = not self._stall_told
        self._stall_patience, self._stall_told = 2 * waited, True
        self._say(f"{told}:\n{textwrap.indent(summary, '  ')}" if is_first else told)

    def _fit(self) -> list[str]:
        """Workers that there are, but for those that are left out."""
        return [worker for worker in self._slots.threads if worker not in self._unfit]

    @property
    def _waits(self) -> bool:
        """Tell whether all workers so far are left out, and others are still to come."""
        return bool(self._unfit) and not self._fit()

    def _fill(self, *, sending: bool) -> None:
        slots = self._slots.now()
        if time.monotonic() - self._relieved > SLOTS_AGE:
            self._relieved = time.monotonic()
            self._relieve()
        while sending and not self._waits and len(self._flying) < 2 * slots:
            count = self._pace.blocks_a_task(self._blocks.left, slots)
            if not (blocks := self._blocks.take(count, suspects=not self._suspect_flies())):
                return
            self._send(_Task(blocks), **self._elsewhere(blocks[0]))

    def _suspect_flies(self) -> bool:
        """Tell whether a block that failed before is out: two could blame each other's deed."""
        failed = self._blocks.failed
        return bool(failed) and any(task.blocks[0] in failed for task in self._flying.values())

    def _elsewhere(self, block: int) -> dict[str, Any]:
        """Workers to send a block to: not where it failed before, if there is anywhere else."""
        before = self._failed_at.get(block)
        others = [worker for worker in self._fit() if worker != before]
        if before and others:
            return {"workers": others, "allow_other_workers": not self._unfit}
        return {"workers": self._fit()} if self._unfit else {}

    def _send(self, task: _Task, **where: Any) -> None:
        first = task.blocks[0]
        key = task_key(self._job, task.blocks, first in self._blocks.failed, self._copies[first])
        future = self._client.submit(work, self._job, task.blocks, key=key, retries=0, **where)
        task.sent = time.monotonic()
        _log.debug("sent block %s and %s more as %s", first, len(task.blocks) - 1, key)
        task.futures[future.key] = future
        self._flying[future.key] = task
        future.add_done_callback(self._arrived.put)

    def _relieve(self) -> None:
        """Send what silent workers hold to others as well, where these have nothing to do."""
        now = time.monotonic()
        late = [
            task
            for task in set(self._flying.values())
            if now - task.sent > self._lease(task)
            and not any(future.done() for future in task.futures.values())  # yet to be looked at
        ]
        if not late:
            return
        held = {worker: set(keys) for worker, keys in self._client.processing().items()}
        silent = {
            worker: tasks
            for worker, keys in held.items()
            if now - self._heard.get(worker, -1e9) > LEASE
            and (tasks := [task for task in late if keys & task.futures.keys()])
        }
        free = [
            worker
            for worker in self._fit()
            if worker not in silent and len(held.get(worker, ())) < self._slots.threads[worker]
        ]
        if not free:
            return
        for worker, tasks in silent.items():
            number = sum(len(task.blocks) for task in tasks)
            since = now - max(self._heard.get(worker, -1e9), min(task.sent for task in tasks))
            self._say(
                f"worker {worker} is silent ({duration(since)}): {number} "
                f"block{'s' if number > 1 else ''} of its go to others as well"
            )
        waiting = [task for task in late if not any(task.futures.keys() & k for k in held.values())]
        for task in {*waiting, *chain.from_iterable(silent.values())}:
            self._copies[task.blocks[0]] += 1
            self._send(task, workers=free)

    def _lease(self, task: _Task) -> float:
        """Seconds after which a task may be sent again; longer each time."""
        return max(LEASE, 5 * self._task_seconds(task)) * 2.0 ** (len(task.futures) - 1)

    def _task_seconds(self, task: _Task) -> float:
        """Time that a task should take by the pace of those before [s]."""
        pace = self._pace
        return len(task.blocks) * pace.seconds / pace.blocks if pace.blocks else LEASE

    def _next(self) -> Answer:
        answer = Answer()
        try:
            future = self._arrived.get(timeout=TICK)
        except queue.Empty:
            self._check()
            self._watch_for_stall()
        else:
            if future.key in self._flying:
                answer = self._arrival(future)
            self._outrun.pop(future.key, None)
        self._verify(answer)
        return answer

    def _arrival(self, future: Future) -> Answer:
        task = self._flying[future.key]
        for key in task.futures:
            del self._flying[key]
        for key in takewhile(lambda key: key != future.key, task.futures):
            self._outrun[key] = task.futures[key]  # so that its worker does not look idle
        answer = _answer(future, task.blocks)
        self._heard[answer.worker] = self._stall_clock = time.monotonic()
        self._pace.learn(answer)
        self._stall_patience = max(STALL_SECONDS, STALL_TASKS * self._task_seconds(task))
        self._stall_told = False
        _log.debug(
            "%s answered: %s blocks written, %s failed, %s begun", answer.worker or "a lost worker",
            len(answer.receipts), len(answer.failures), len(answer.begun),
        )  # fmt: skip
        self._failed_at.update((failure.block, answer.worker) for failure in answer.failures)
        done = {r.block for r in answer.receipts} | {f.block for f in answer.failures}
        self._put_back([block for block in task.blocks if block not in done])
        if answer.unfit is not None:
            self._leave_out(answer.worker, answer.host, answer.unfit)
        return answer

    def _put_back(self, blocks: list[int]) -> None:
        """Put blocks back that are begun, or to be sent again by no fault of theirs."""
        self._blocks.put_back(blocks)
        self._copies.update(blocks)

    def _verify(self, answer: Answer) -> None:
        """Leave the receipts of what is in the store here, which may show some seconds late."""
        now = time.monotonic()
        looked_for = [(receipt, answer.worker, now + LATENCY) for receipt in answer.receipts]
        if now - self._looked > TICK:
            self._looked = now
            looked_for, self._unseen = self._unseen + looked_for, []
        answer.receipts = []
        for receipt, worker, until in looked_for:
            if self._seen(receipt, worker not in self._trusted):
                self._trusted.add(worker)
                answer.receipts.append(receipt)
            elif now < until and worker not in self._unfit:
                self._unseen.append((receipt, worker, until))
            else:
                self._put_back([receipt.block])
                self._leave_out(worker, receipt.host, StoreError(NOT_HERE))

    def _leave_out(self, worker: str, host: str, why: Exception) -> None:
        """Send nothing more to a worker; raise why where no other is left, or may come."""
        if worker in self._unfit:
            return
        self._unfit[worker] = self._slots.threads.get(worker, 1)
        if self._waits and sum(self._unfit.values()) >= self._slots.hoped:
            if isinstance(why, NotAStoreError):  # the driver has it
                raise StoreError(f"no worker is left: {worker} on {host}: {why}; {SAME_PLACE}")
            raise why
        self._say(f"worker {worker} on {host} is left out: {why}")

    def _check(self) -> None:
        if self._client.status != "running":
            raise SchedulerLost(f"the client is {self._client.status}")


def _answer(future: Future, blocks: list[int]) -> Answer:
    """Answer of a task that is over; an empty one where its worker died with it."""
    error: BaseException | None = None
    if future.status == "finished":
        try:
            return future.result(timeout=LEASE)
        except TimeoutError:
            pass  # lost, as below, and not computed again in that time
        except (CancelledError, OSError) as lost:
            raise SchedulerLost(str(lost)) from lost
        except Exception as failed:  # gone with its worker, computed again, and that failed
            error = failed
    elif future.status == "error":
        error = future.exception()
    elif future.status == "cancelled":
        raise SchedulerLost("its tasks were cancelled")
    return _failed(error, blocks) if error is not None else Answer()


def _failed(error: BaseException, blocks: list[int]) -> Answer:
    """Answer of a task that raised or killed its workers: any of its blocks may be to blame."""
    from distributed.scheduler import KilledWorker

    failures = [failure(block, error) for block in blocks]
    if isinstance(error, KilledWorker):
        number = error.allowed_failures + 1
        why = (
            f"KilledWorker: {number} worker{'s' if number > 1 else ''} died at it: "
            f"out of memory, stuck beyond {option_name('block_timeout')}, or killed"
        )
        failures = [replace(each, error=why) for each in failures]
    return Answer(failures=failures)


def task_key(job: Job, blocks: list[int], failed: bool, copy: int = 0) -> str:
    """Key of a task: the same work for the same store is the same task, whoever asks."""
    said = repr((job.path, job.study_id, blocks, failed, copy)).encode()
    digest = hashlib.blake2b(said, digest_size=12).hexdigest()
    return f"blocks-{job.study_id[:8]}-{blocks[0]}-{digest}"
