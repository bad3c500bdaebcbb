"""Dispatch of blocks to workers as Dask tasks. The number of unfinished tasks is limited.

A task writes its blocks itself and returns receipts, which the client fetches and releases at once.
No result stays on a worker, so none is lost if the worker dies.
"""

from __future__ import annotations

import hashlib
import logging
import queue
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass, field, replace
from itertools import chain, takewhile
from typing import TYPE_CHECKING, Any

from sweep.messages import number_with_noun, option_name
from sweep.storage.store_format import NotAStoreError
from sweep.tasks.engine.journal import Receipt
from sweep.tasks.engine.progress import SchedulerLostError, StoreError, duration_text
from sweep.tasks.engine.stalls import COMPILATION_SECONDS_MAX, MessagePrinter, StallMonitor
from sweep.tasks.engine.worker import (
    IDLE_POLL_SECONDS,
    RESULTS_NOT_VISIBLE_MESSAGE,
    BlockQueue,
    ReceiptVerifier,
    TaskResult,
    TaskSettings,
    make_failure,
    run_blocks,
)

if TYPE_CHECKING:
    from dask.typing import Key
    from distributed import Client, Future

#: Intended duration of a task [s]. It is long compared with a task's overhead of 3-9 ms, and short
#: compared with a study.
TARGET_TASK_SECONDS = 2.0

#: Largest number of blocks of a task.
BLOCKS_PER_TASK_MAX = 1000

#: Largest number of tasks per second, a third of what a scheduler can handle [1/s]. If there are
#: more than 200 worker threads, tasks are made longer to stay below it.
TASKS_PER_SECOND_MAX = 100.0

#: Interval at which the worker threads of a cluster are counted again [s].
WORKER_THREADS_REFRESH_SECONDS = 2.0

#: Time without a result after which a worker counts as silent [s]. Its tasks are sent to other
#: workers only later if they are expected to take long.
WORKER_SILENCE_SECONDS = 30.0

#: Largest time until files that a worker has written are visible to this process [s]: the time for
#: which NFS clients on Linux cache folders.
FILE_VISIBILITY_SECONDS_MAX = 60.0

#: Largest numbers of tasks and of workers that a summary of the state lists.
TASKS_IN_SUMMARY_MAX, WORKERS_IN_SUMMARY_MAX = 5, 10

SHARED_FOLDER_REMEDY = "workers have to see the store's folder, under the same path"

_log = logging.getLogger("sweep.dispatcher")


@dataclass
class ThroughputEstimator:
    """Estimator of a suitable number of blocks per task, from the times of blocks so far."""

    n_finished_blocks: int = 0  # number of blocks that tasks have finished
    work_seconds: float = 0.0  # computing time of these blocks, summed over workers [s]

    def add_task_result(self, task_result: TaskResult) -> None:
        """Add the number and the computing time of the blocks that a task has finished."""
        self.n_finished_blocks += len(task_result.receipts)
        self.work_seconds += sum(receipt.seconds for receipt in task_result.receipts)

    def blocks_per_task(self, n_blocks_left: int, n_worker_threads: int) -> int:
        """Return the number of blocks for the next task; 1 until any block is finished.

        A task is to last `TARGET_TASK_SECONDS`. Tasks become smaller as `n_blocks_left` falls, so
        that all workers end together.
        """
        if not self.n_finished_blocks:
            return 1
        task_seconds = max(TARGET_TASK_SECONDS, n_worker_threads / TASKS_PER_SECOND_MAX)
        n_fitting = int(task_seconds * self.n_finished_blocks / max(self.work_seconds, 1e-9))
        return max(1, min(n_fitting, BLOCKS_PER_TASK_MAX, n_blocks_left // (4 * n_worker_threads)))


@dataclass
class WorkerThreadCounter:
    """Counter of the worker threads of a cluster, updated every few seconds."""

    client: Client
    n_expected_worker_threads: int = 0  # number expected once all workers run; 0 if unknown
    n_worker_threads: int = 1  # larger of the last count and the expected number, at least 1
    n_threads_by_worker: dict[str, int] = field(default_factory=dict)  # by the worker's address
    last_counted_at: float = -1e9  # time of the last count, by `time.monotonic` [s]

    def current_count(self) -> int:
        """Return the larger of the connected and expected numbers of worker threads, at least 1.

        Connected threads are counted at most once per `WORKER_THREADS_REFRESH_SECONDS`.
        """
        if time.monotonic() - self.last_counted_at > WORKER_THREADS_REFRESH_SECONDS:
            self.n_threads_by_worker = dict(self.client.nthreads())
            self.n_worker_threads = max(
                1, self.n_expected_worker_threads, sum(self.n_threads_by_worker.values())
            )
            self.last_counted_at = time.monotonic()
        return self.n_worker_threads


@dataclass(eq=False)
class _InFlightTask:
    """Task that was sent to a worker and has not ended.

    It is sent to further workers if that one is silent.
    """

    blocks: list[int]
    futures_by_key: dict[Key, Future] = field(default_factory=dict)  # one for each time it was sent
    last_sent_at: float = 0.0  # by `time.monotonic` [s]


class TaskDispatcher:
    """Sender of a study's blocks to the workers of a cluster.

    A worker that can't open the store, can't write to it, or writes to another one is excluded, and
    its blocks go to other workers. Blocks of a silent worker are also sent to others once these are
    idle; the first result counts. ``verify_receipt`` tells whether the block of a receipt is in the
    store as this process sees it: by its size, or by its digest for the first block of each worker.
    """

    def __init__(
        self,
        client: Client,
        n_expected_worker_threads: int,
        settings: TaskSettings,
        block_queue: BlockQueue,
        *,
        verify_receipt: ReceiptVerifier,
        say: MessagePrinter,
    ) -> None:
        self._client, self._settings, self._block_queue = client, settings, block_queue
        self._verify_receipt, self._say = verify_receipt, say
        self._in_flight: dict[Key, _InFlightTask] = {}
        self._superseded: dict[Key, Future] = {}  # still running, but another worker has finished
        self._finished_futures: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._throughput, self._thread_counter = (
            ThroughputEstimator(),
            WorkerThreadCounter(client, n_expected_worker_threads),
        )
        self._resend_counts: Counter[int] = (
            Counter()
        )  # number of times that a task was sent again, by its first block
        self._failing_worker: dict[int, str] = {}  # address of the worker that failed, by block
        self._last_response: dict[str, float] = {}  # time of the last response by worker
        self._duplicated_at = self._rechecked_at = time.monotonic()
        self._unverified_receipts: list[
            tuple[Receipt, str, float]
        ] = []  # receipt, address of its worker, and time until which its chunks may appear
        self._verified_workers: set[str] = (
            set()
        )  # workers of which a block was found in the store, by its digest
        self._excluded_workers: dict[str, int] = {}  # number of threads by excluded worker
        self._stall_monitor = StallMonitor(say, self.state_summary)

    def iter_results(self, is_stopping: Callable[[], bool]) -> Iterator[TaskResult]:
        """Send all blocks of the queue in tasks. Yield the result of each task when the task ends.

        While no task ends, an empty result is yielded every `IDLE_POLL_SECONDS`. The iteration ends
        when no task is left. Once `is_stopping()` returns True, no more tasks are sent, and the
        iteration also ends if no usable worker is connected. SchedulerLostError is raised if the
        scheduler is gone. StoreError or OSError is raised if no worker can write to the store.
        """
        try:
            while True:
                try:
                    self._submit_tasks(may_submit=not is_stopping())
                except Exception as error:  # a closed client raises errors of any kind
                    self._check_connection()
                    if isinstance(error, OSError | CancelledError | RuntimeError):
                        raise SchedulerLostError(str(error)) from error
                    raise
                if is_stopping() and not (self._in_flight and self._usable_workers()):
                    return  # no task in flight will end
                if not (self._in_flight or self._unverified_receipts or self._all_workers_excluded):
                    return
                task_result = self._next_result()
                task_result.n_workers = len(self._usable_workers())
                yield task_result
        finally:
            self._in_flight.clear()  # a task without a future is cancelled
            self._superseded.clear()

    def state_summary(self) -> str:
        """Return the state of blocks, tasks and workers of the run as text of several lines."""
        now = time.monotonic()
        tasks = set(self._in_flight.values())
        lines = [
            f"{number_with_noun(self._block_queue.n_unassigned, 'block')} not yet sent, "
            f"{len(self._block_queue.failed_blocks):,} failed once, "
            f"{len(self._unverified_receipts):,} written but not yet found in the store",
            f"{number_with_noun(len(tasks), 'task')} in flight, "
            f"{len(self._superseded):,} superseded; "
            f"{number_with_noun(self._throughput.n_finished_blocks, 'block')} came back in "
            f"{duration_text(self._throughput.work_seconds)} of work",
        ]
        lines += [
            f"task of block {task.blocks[0]} and {len(task.blocks) - 1} more: sent "
            f"{duration_text(now - task.last_sent_at)} ago, "
            f"{number_with_noun(len(task.futures_by_key), 'time')}; Dask says "
            f"{', '.join(sorted({str(future.status) for future in task.futures_by_key.values()}))}"
            for task in sorted(tasks, key=lambda task: task.last_sent_at)[:TASKS_IN_SUMMARY_MAX]
        ]
        for worker, threads in sorted(self._thread_counter.n_threads_by_worker.items())[
            :WORKERS_IN_SUMMARY_MAX
        ]:
            answered_at = self._last_response.get(worker)
            last_response_text = (
                "never" if answered_at is None else f"{duration_text(now - answered_at)} ago"
            )
            excluded_text = ", left out" if worker in self._excluded_workers else ""
            lines.append(
                f"worker {worker}: {number_with_noun(threads, 'thread')}, last answer "
                f"{last_response_text}{excluded_text}"
            )
        return "\n".join(lines)

    def _report_if_stalled(self) -> None:
        """Print a message, and log the state of the run, if no task has ended for a long time."""
        if (
            not self._in_flight or not self._usable_workers()
        ):  # the session reports a lack of workers
            self._stall_monitor.restart_waiting()
        self._stall_monitor.report_if_stalled(
            explanation="workers load the model, or compile it once, which takes minutes where the "
            "machine is busy",
            explained_seconds=0.0 if self._last_response else COMPILATION_SECONDS_MAX,
        )

    def _usable_workers(self) -> list[str]:
        """Return the addresses of connected workers that are not excluded."""
        return [
            worker
            for worker in self._thread_counter.n_threads_by_worker
            if worker not in self._excluded_workers
        ]

    @property
    def _all_workers_excluded(self) -> bool:
        """True if at least one worker is excluded, and no connected worker is usable."""
        return bool(self._excluded_workers) and not self._usable_workers()

    def _submit_tasks(self, *, may_submit: bool) -> None:
        """Submit tasks until there are twice as many unfinished tasks as worker threads.

        Nothing new is submitted if the queue is empty, or if `may_submit` is False. Overdue tasks
        of silent workers are sent to idle workers in either case.
        """
        n_worker_threads = self._thread_counter.current_count()
        if time.monotonic() - self._duplicated_at > WORKER_THREADS_REFRESH_SECONDS:
            self._duplicated_at = time.monotonic()
            self._duplicate_stragglers()
        while (
            may_submit
            and not self._all_workers_excluded
            and len(self._in_flight) < 2 * n_worker_threads
        ):
            count = self._throughput.blocks_per_task(
                self._block_queue.n_unassigned, n_worker_threads
            )
            if not (
                blocks := self._block_queue.take_blocks(
                    count, include_failed=not self._is_failed_block_in_flight()
                )
            ):
                return
            self._submit_task(_InFlightTask(blocks), **self._placement_kwargs(blocks[0]))

    def _is_failed_block_in_flight(self) -> bool:
        """Return True if an unfinished task computes a block that has failed before.

        Blocks that have failed are computed one at a time, so that a worker's death is attributed
        to the block that caused it.
        """
        failed_blocks = self._block_queue.failed_blocks
        return bool(failed_blocks) and any(
            task.blocks[0] in failed_blocks for task in self._in_flight.values()
        )

    def _placement_kwargs(self, block: int) -> dict[str, Any]:
        """Return arguments of `Client.submit` that keep a block from the worker where it failed.

        Excluded workers are avoided as well. The result is empty if any worker may compute the
        block.
        """
        failing_worker = self._failing_worker.get(block)
        other_workers = [worker for worker in self._usable_workers() if worker != failing_worker]
        if failing_worker and other_workers:
            return {"workers": other_workers, "allow_other_workers": not self._excluded_workers}
        return {"workers": self._usable_workers()} if self._excluded_workers else {}

    def _submit_task(self, task: _InFlightTask, **placement: Any) -> None:
        """Submit a task to Dask, with arguments of `Client.submit` that select its workers."""
        first_block = task.blocks[0]
        key = task_key(
            self._settings,
            task.blocks,
            first_block in self._block_queue.failed_blocks,
            self._resend_counts[first_block],
        )
        future = self._client.submit(
            run_blocks, self._settings, task.blocks, key=key, retries=0, **placement
        )
        task.last_sent_at = time.monotonic()
        _log.debug("sent block %s and %s more as %s", first_block, len(task.blocks) - 1, key)
        task.futures_by_key[future.key] = future
        self._in_flight[future.key] = task
        future.add_done_callback(self._finished_futures.put)

    def _duplicate_stragglers(self) -> None:
        """Send overdue tasks also to idle workers, if the tasks' workers are silent or lost."""
        now = time.monotonic()
        overdue_tasks = [
            task
            for task in set(self._in_flight.values())
            if now - task.last_sent_at > self._seconds_until_resend(task)
            and not any(
                future.done() for future in task.futures_by_key.values()
            )  # yet to be collected
        ]
        if not overdue_tasks:
            return
        keys_by_worker = {worker: set(keys) for worker, keys in self._client.processing().items()}
        tasks_by_silent_worker = {
            worker: tasks
            for worker, keys in keys_by_worker.items()
            if now - self._last_response.get(worker, -1e9) > WORKER_SILENCE_SECONDS
            and (tasks := [task for task in overdue_tasks if keys & task.futures_by_key.keys()])
        }
        idle_workers = [
            worker
            for worker in self._usable_workers()
            if worker not in tasks_by_silent_worker
            and len(keys_by_worker.get(worker, ()))
            < self._thread_counter.n_threads_by_worker[worker]
        ]
        if not idle_workers:
            return
        for worker, tasks in tasks_by_silent_worker.items():
            n_blocks = sum(len(task.blocks) for task in tasks)
            silent_seconds = now - max(
                self._last_response.get(worker, -1e9), min(task.last_sent_at for task in tasks)
            )
            self._say(
                f"worker {worker} is silent ({duration_text(silent_seconds)}): {n_blocks} "
                f"block{'s' if n_blocks > 1 else ''} of its go to others as well"
            )
        unassigned_tasks = [
            task
            for task in overdue_tasks
            if not any(task.futures_by_key.keys() & k for k in keys_by_worker.values())
        ]
        for task in {*unassigned_tasks, *chain.from_iterable(tasks_by_silent_worker.values())}:
            self._resend_counts[task.blocks[0]] += 1
            self._submit_task(task, workers=idle_workers)

    def _seconds_until_resend(self, task: _InFlightTask) -> float:
        """Return the time after which a task counts as overdue, from its last sending on [s].

        The time doubles with each sending of the task.
        """
        return max(WORKER_SILENCE_SECONDS, 5 * self._expected_task_seconds(task)) * 2.0 ** (
            len(task.futures_by_key) - 1
        )

    def _expected_task_seconds(self, task: _InFlightTask) -> float:
        """Return the expected duration of a task, from the computing times of blocks so far [s]."""
        throughput = self._throughput
        return (
            len(task.blocks) * throughput.work_seconds / throughput.n_finished_blocks
            if throughput.n_finished_blocks
            else WORKER_SILENCE_SECONDS
        )

    def _next_result(self) -> TaskResult:
        """Wait up to `IDLE_POLL_SECONDS` for a task to end. Return its result, or an empty one.

        The result has only receipts of blocks that this process sees in the store.
        """
        task_result = TaskResult()
        try:
            future = self._finished_futures.get(timeout=IDLE_POLL_SECONDS)
        except queue.Empty:
            self._check_connection()
            self._report_if_stalled()
        else:
            if future.key in self._in_flight:
                task_result = self._finish_task(future)
            self._superseded.pop(future.key, None)
        self._verify_receipts(task_result)
        return task_result

    def _finish_task(self, future: Future) -> TaskResult:
        """Return the result of an ended task, given its future. Requeue its unfinished blocks.

        The worker is excluded if the result states that the worker can't compute any block.
        """
        task = self._in_flight[future.key]
        for key in task.futures_by_key:
            del self._in_flight[key]
        for key in takewhile(lambda key: key != future.key, task.futures_by_key):
            self._superseded[key] = task.futures_by_key[
                key
            ]  # kept, so that its worker counts as busy
        task_result = _collect_task_result(future, task.blocks)
        self._last_response[task_result.worker_address] = time.monotonic()
        self._throughput.add_task_result(task_result)
        self._stall_monitor.record_result(self._expected_task_seconds(task))
        _log.debug(
            "%s answered: %s blocks written, %s failed, %s begun",
            task_result.worker_address or "a lost worker",
            len(task_result.receipts),
            len(task_result.failures),
            len(task_result.checkpoint_points_by_block),
        )
        self._failing_worker.update(
            (failure.block, task_result.worker_address) for failure in task_result.failures
        )
        settled_blocks = {r.block for r in task_result.receipts} | {
            f.block for f in task_result.failures
        }
        self._requeue_blocks([block for block in task.blocks if block not in settled_blocks])
        if task_result.worker_error is not None:
            self._exclude_worker(
                task_result.worker_address, task_result.host, task_result.worker_error
            )
        return task_result

    def _requeue_blocks(self, blocks: list[int]) -> None:
        """Put blocks back into the queue that are unfinished, or whose task was lost."""
        self._block_queue.requeue(blocks)
        self._resend_counts.update(blocks)

    def _verify_receipts(self, task_result: TaskResult) -> None:
        """Remove receipts from a task's result, in place, if this process can't see their blocks.

        A removed receipt is checked again later. Once its block is visible in the store, the
        receipt is added to the result of that later call. If the block is not visible within
        `FILE_VISIBILITY_SECONDS_MAX`, it is queued again, and its worker is excluded.
        """
        now = time.monotonic()
        receipts_to_verify = [
            (receipt, task_result.worker_address, now + FILE_VISIBILITY_SECONDS_MAX)
            for receipt in task_result.receipts
        ]
        if now - self._rechecked_at > IDLE_POLL_SECONDS:
            self._rechecked_at = now
            receipts_to_verify = self._unverified_receipts + receipts_to_verify
            self._unverified_receipts = []
        task_result.receipts = []
        for receipt, worker, deadline in receipts_to_verify:
            if self._verify_receipt(receipt, worker not in self._verified_workers):
                self._verified_workers.add(worker)
                task_result.receipts.append(receipt)
            elif now < deadline and worker not in self._excluded_workers:
                self._unverified_receipts.append((receipt, worker, deadline))
            else:
                self._requeue_blocks([receipt.block])
                self._exclude_worker(worker, receipt.host, StoreError(RESULTS_NOT_VISIBLE_MESSAGE))

    def _exclude_worker(self, worker: str, host: str, error: Exception) -> None:
        """Send no more tasks to a worker, and print its error.

        The error is raised instead if no worker is usable and no more workers are expected to
        connect. `worker` is the worker's address.
        """
        if worker in self._excluded_workers:
            return
        self._excluded_workers[worker] = self._thread_counter.n_threads_by_worker.get(worker, 1)
        if (
            self._all_workers_excluded
            and sum(self._excluded_workers.values())
            >= self._thread_counter.n_expected_worker_threads
        ):
            if isinstance(error, NotAStoreError):  # the driver itself sees the store
                raise StoreError(
                    f"no worker is left: {worker} on {host}: {error}; {SHARED_FOLDER_REMEDY}"
                )
            raise error
        self._say(f"worker {worker} on {host} is left out: {error}")

    def _check_connection(self) -> None:
        """Raise a SchedulerLostError if the client is not connected to the scheduler."""
        if self._client.status != "running":
            raise SchedulerLostError(f"the client is {self._client.status}")


def _collect_task_result(future: Future, blocks: list[int]) -> TaskResult:
    """Return the result of an ended task, given its future and its blocks.

    The result is empty if it was lost with its worker. If the task raised an error, the result has
    a failure of every block. SchedulerLostError is raised if the scheduler is gone.
    """
    error: BaseException | None = None
    if future.status == "finished":
        try:
            return future.result(timeout=WORKER_SILENCE_SECONDS)
        except TimeoutError:
            pass  # the result is lost, as below, and was not computed again in that time
        except (CancelledError, OSError) as connection_error:
            raise SchedulerLostError(str(connection_error)) from connection_error
        except Exception as task_error:  # lost with its worker, computed again, and then failed
            error = task_error
    elif future.status == "error":
        error = future.exception()
    elif future.status == "cancelled":
        raise SchedulerLostError("its tasks were cancelled")
    return _failed_task_result(error, blocks) if error is not None else TaskResult()


def _failed_task_result(error: BaseException, blocks: list[int]) -> TaskResult:
    """Return a result with a failure of every block, for a task that raised an error.

    The error `KilledWorker` means that the workers of the task died.
    """
    from distributed.scheduler import KilledWorker

    failures = [make_failure(block, error) for block in blocks]
    if isinstance(error, KilledWorker):
        n_deaths = error.allowed_failures + 1
        message = (
            f"KilledWorker: {n_deaths} worker{'s' if n_deaths > 1 else ''} died at it: "
            f"out of memory, stuck beyond {option_name('block_timeout')}, or killed"
        )
        failures = [replace(failure, error=message) for failure in failures]
    return TaskResult(failures=failures)


def task_key(
    settings: TaskSettings, blocks: list[int], is_retry: bool, resend_count: int = 0
) -> str:
    """Return the text by which Dask identifies a task of these blocks.

    The key is equal in all processes. It depends on the store's path, the study's id, the numbers
    of the blocks, whether the first block has failed before (`is_retry`), and how often the task
    was sent again (`resend_count`).
    """
    identity = repr(
        (settings.store_path, settings.study_id, blocks, is_retry, resend_count)
    ).encode()
    digest = hashlib.blake2b(identity, digest_size=12).hexdigest()
    return f"blocks-{settings.study_id[:8]}-{blocks[0]}-{digest}"
