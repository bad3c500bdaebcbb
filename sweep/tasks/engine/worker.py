"""Evaluation of blocks on a worker or in this process, and the queue of blocks that are not done.

A worker evaluates each block within its time limit, writes it, and returns a receipt.
"""

from __future__ import annotations

import ctypes
import errno
import os
import queue
import socket
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextvars import copy_context
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import islice
from typing import TypeVar

import numpy as np

from sweep.storage.locations import parse_location, store_stat_fingerprint
from sweep.storage.store_format import read_attributes
from sweep.tasks.engine import journal, study_store, user_code
from sweep.tasks.engine.block_study import (
    BlockEvaluator,
    Deadline,
    StudyReader,
    UnfinishedBlockException,
)
from sweep.tasks.engine.blocks import Results
from sweep.tasks.engine.journal import Checkpoint, Failure, Receipt
from sweep.tasks.engine.progress import CodeError, StoreError
from sweep.tasks.engine.stalls import InProcessMonitor, MessagePrinter

ReturnValueT = TypeVar("ReturnValueT")
"""Type that the function of `run_with_timeout` returns."""

#: Error numbers of the storage that stop a run, as every further block would raise them too.
FATAL_STORAGE_ERRNOS = {
    errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.ESTALE,
    errno.ECONNREFUSED, errno.ETIMEDOUT, errno.ENXIO,
}  # fmt: skip

#: Time after which an unfinished block is saved and left to another task [s]. This is the longest
#: work that is lost if a worker dies, and the longest wait after Ctrl-C.
CHECKPOINT_INTERVAL_SECONDS = 10.0

#: Time in which a block's thread must return from compiled code after the block's time limit [s].
INTERRUPT_GRACE_SECONDS = 10.0

#: Interval at which scheduler, lock and clock are checked while no result arrives [s].
IDLE_POLL_SECONDS = 0.5

#: Largest number of studies whose stores a worker keeps open.
OPEN_STUDIES_MAX = 4


#: Message about a worker whose results this process does not see in the store.
RESULTS_NOT_VISIBLE_MESSAGE = (
    "what was written is not in the store here: does the worker see the same file system?"
)

ReceiptVerifier = Callable[[Receipt, bool], bool]
"""Function that returns True if a receipt's block is in the store as this process sees it.

The first argument is the receipt. If the second is True, digests are compared, otherwise sizes.
"""


@dataclass(frozen=True)
class TaskSettings:
    """Settings that all tasks of a run share.

    They are sent with each task and are therefore small.
    """

    store_path: str
    study_id: str
    read_study: StudyReader  # reads the study of the store
    evaluate: BlockEvaluator | None = None  # replaces the study's `evaluate`, with its results
    block_timeout: float | None = None  # time limit of a block [s]
    durable: bool = False  # whether chunks are on the disk before the receipt
    user_module_digests: tuple[
        tuple[str, str], ...
    ] = ()  # the user's modules that may be imported, and their digests


@dataclass
class TaskResult:
    """Result of one task: receipts of stored blocks, failures, and points of unfinished blocks."""

    receipts: list[Receipt] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    checkpoint_points_by_block: dict[int, float] = field(
        default_factory=dict
    )  # number of points done so far, by unfinished block
    worker_address: str = ""  # address of the worker; '' for serial computation
    host: str = ""  # host name of the worker
    worker_error: Exception | None = None  # why the worker can't compute any block
    n_workers: int = 1  # number of usable workers when the result arrived, or of threads


_block_writer_cache_lock = threading.Lock()
"""Lock under which block writers are looked up and opened, so that none is opened twice."""


def get_block_writer(
    store_path: str, study_id: str, read_study: StudyReader
) -> study_store.BlockWriter:
    """Return a writer of blocks into a study's store.

    The writer is cached, so that each process opens a store only once. StoreError is raised if the
    store holds another study.
    """
    with _block_writer_cache_lock:
        return _cached_block_writer(store_path, study_id, read_study)


def _open_block_writer(
    store_path: str, study_id: str, read_study: StudyReader
) -> study_store.BlockWriter:
    """Open the store of a study, and return a new writer of its blocks.

    StoreError is raised if the store holds another study, or was begun with other versions of the
    software.
    """
    attributes, stored_study = read_study(parse_location(store_path))
    _refuse_replaced_store(store_path, study_id)
    study_store.refuse_other_versions(
        store_path,
        attributes,
        stored_study.model_version,
        reader=f"worker on {socket.gethostname()}",
    )
    return study_store.BlockWriter(store_path, stored_study)


_cached_block_writer = lru_cache(maxsize=OPEN_STUDIES_MAX)(_open_block_writer)


def _refuse_replaced_store(store_path: str, study_id: str) -> None:
    """Raise a StoreError if the store at a path now holds another study than `study_id`."""
    stat_fingerprint = store_stat_fingerprint(parse_location(store_path))
    stored_id = (
        _stored_study_id(store_path, stat_fingerprint)
        if stat_fingerprint
        else _stored_study_id.__wrapped__(store_path, stat_fingerprint)
    )
    if stored_id != study_id:
        raise StoreError(f"{store_path} now holds study {stored_id}, not {study_id}")


@lru_cache(maxsize=OPEN_STUDIES_MAX)
def _stored_study_id(store_path: str, stat_fingerprint: tuple[int, ...] | None) -> str:
    """Return the id of the study whose store is at a path.

    The result is cached. `stat_fingerprint` is part of the cache's key, and changes if the store is
    replaced.
    """
    return str(read_attributes(parse_location(store_path))["study_id"])


def run_blocks(settings: TaskSettings, blocks: list[int]) -> TaskResult:
    """Compute and write blocks, given by number. Return their receipts and failures.

    An error of one block does not stop the others. A block that takes long is computed in part and
    saved as a checkpoint, from which a later task continues.
    """
    task_result = TaskResult(worker_address=worker_address(), host=socket.gethostname())
    try:
        if task_result.worker_address:
            _allow_user_code(settings)
        _run_blocks(
            task_result,
            get_block_writer(settings.store_path, settings.study_id, settings.read_study),
            blocks,
            settings,
        )
    except (CodeError, StoreError, OSError) as error:
        task_result.worker_error = error
    return task_result


def _allow_user_code(settings: TaskSettings) -> None:
    """Allow this worker to import the user's modules that `settings` lists.

    CodeError is raised if a module's file on this machine differs from that of the process that
    started the run.
    """
    for module, digest in settings.user_module_digests:
        user_code.allow_identical_module(module, digest)


def _run_blocks(
    task_result: TaskResult,
    writer: study_store.BlockWriter,
    blocks: list[int],
    settings: TaskSettings,
) -> None:
    """Compute and write blocks. Add receipts, failures and unfinished blocks to `task_result`."""
    receipts, checkpoint_time = [], time.monotonic() + CHECKPOINT_INTERVAL_SECONDS
    for block in blocks:
        try:
            receipt_or_points = _compute_block(writer, block, settings, Deadline(checkpoint_time))
            if isinstance(receipt_or_points, Receipt):
                receipts.append(receipt_or_points)
            else:
                task_result.checkpoint_points_by_block[block] = receipt_or_points
        except StoreError:
            raise
        except Exception as error:
            if isinstance(error, OSError) and error.errno in FATAL_STORAGE_ERRNOS:
                raise
            task_result.failures.append(make_failure(block, error))
    if settings.durable and (receipts or task_result.checkpoint_points_by_block):
        study_store.sync_file_system(writer.store_path)
    task_result.receipts = receipts


def _compute_block(
    writer: study_store.BlockWriter, block: int, settings: TaskSettings, deadline: Deadline
) -> Receipt | float:
    """Compute and write one block, or a part of it until a deadline.

    Return the receipt of a complete block. At the deadline save a checkpoint, and return the number
    of points done.
    """
    stored_study, store_path, checkpoint = writer.study, writer.store_path, Checkpoint()
    started_at = time.perf_counter()
    evaluate: Callable[[], Results]
    if settings.evaluate:
        evaluate = partial(settings.evaluate, stored_study, block)
    elif stored_study.supports_checkpoints:
        checkpoint = journal.read_checkpoint(store_path, stored_study.id, block)
        evaluate = partial(stored_study.evaluate_until, block, checkpoint.results, deadline)
    else:
        evaluate = partial(stored_study.evaluate, block)
    try:
        results = run_with_timeout(evaluate, settings.block_timeout, checkpoint.seconds)
    except UnfinishedBlockException as unfinished:
        _refuse_replaced_store(str(store_path), stored_study.id)
        seconds_spent = checkpoint.seconds + time.perf_counter() - started_at
        journal.write_checkpoint(
            store_path,
            stored_study.id,
            block,
            Checkpoint(unfinished.results, unfinished.n_points, seconds_spent),
        )
        return unfinished.n_points
    evaluated_at = time.perf_counter()
    _refuse_replaced_store(str(store_path), stored_study.id)  # the driver may have died long ago
    stored_block = writer.write(block, results)
    ended_at = time.perf_counter()
    return Receipt(
        block=block,
        points=stored_study.count_block_points(block),
        bytes=stored_block.n_bytes,
        digest=stored_block.digest,
        seconds=round(checkpoint.seconds + ended_at - started_at, 6),
        write_seconds=round(ended_at - evaluated_at, 6),
        host=socket.gethostname(),
        pid=os.getpid(),
        versions=study_store.current_software_versions(),
        reused_points=stored_study.pop_reused_point_count(block),
    )


def make_failure(block: int, error: BaseException) -> Failure:
    """Return a record of an error that a block raised in this process."""
    traceback_lines = traceback.format_exception(type(error), error, error.__traceback__)
    return Failure(
        block=block,
        error=f"{type(error).__name__}: {error}",
        traceback="".join(traceback_lines)[-8000:],
        host=socket.gethostname(),
        pid=os.getpid(),
    )


class BlockTimeoutError(Exception):
    """Error of a block that exceeds its time limit."""


class _TimeoutInterruption(SystemExit):
    """Exception raised in another thread to end it. `except Exception` does not catch it."""


def run_with_timeout(
    function: Callable[[], ReturnValueT], timeout: float | None, seconds_spent: float = 0.0
) -> ReturnValueT:
    """Call a function, without arguments, in a thread, and return its result.

    BlockTimeoutError is raised if the call takes longer than `timeout` less `seconds_spent` [s].
    Python code is interrupted at that time. If the thread is still in compiled code
    `INTERRUPT_GRACE_SECONDS` later, a worker process ends itself; any other process waits. If
    `timeout` is None, the function is called in this thread without a limit.
    """
    if timeout is None:
        return function()
    return_values: list[ReturnValueT] = []
    errors: list[BaseException] = []
    is_finished, may_exit = threading.Event(), threading.Event()

    def call_function() -> None:
        try:
            return_values.append(function())
        except BaseException as error:
            errors.append(error)
        is_finished.set()
        may_exit.wait()  # until then no other thread can get the id that is interrupted

    # the thread inherits context variables, such as Dask's worker
    thread = threading.Thread(target=copy_context().run, args=(call_function,), daemon=True)
    in_time = False
    thread.start()
    try:
        in_time = is_finished.wait(max(timeout - seconds_spent, 0.0))
    finally:  # also after Ctrl-C
        if not in_time:
            thread_id, error = (
                ctypes.c_ulong(thread.ident or 0),
                ctypes.py_object(_TimeoutInterruption),
            )
            ctypes.pythonapi.PyThreadState_SetAsyncExc(thread_id, error)
        may_exit.set()
    if not in_time:
        # A worker with a process of its own may end without harm.
        is_own_process = worker_address().partition("://")[0] not in ("", "inproc")
        thread.join(INTERRUPT_GRACE_SECONDS if is_own_process else None)
        if thread.is_alive():
            os._exit(1)  # stuck in compiled code; a nanny starts another worker
        message = f"took longer than the {timeout:g} s that a block may take"
        raise BlockTimeoutError(message) from (errors[0] if errors else None)
    if errors:
        raise errors[0]
    return return_values[0]


def worker_address() -> str:
    """Return the address of the Dask worker that runs this thread; '' without one."""
    if "distributed" not in sys.modules:
        return ""
    from distributed import get_worker

    try:
        return str(get_worker().address)
    except ValueError:
        return ""


class BlockQueue:
    """Queue of the blocks that remain to be computed.

    `is_done` is a mask (blocks,) of bool. A block that failed is tried once more, in a task with no
    other blocks.
    """

    def __init__(self, is_done: np.ndarray) -> None:
        self.n_unassigned = int(is_done.size - np.count_nonzero(is_done))  # not yet taken
        self._untried = _iter_false_indices(is_done)
        self._failed_once: deque[int] = deque()
        self._requeued: deque[int] = deque()
        self.failed_blocks: set[int] = set()

    def take_blocks(self, count: int, *, include_failed: bool = True) -> list[int]:
        """Remove up to `count` blocks from the queue, and return their numbers; [] if none is left.

        A block that failed, or was put back, is returned alone. If not `include_failed`, blocks
        that failed stay in the queue.
        """
        if self._failed_once and include_failed:
            return [self._failed_once.popleft()]
        if self._requeued:
            return [self._requeued.popleft()]
        blocks = list(islice(self._untried, count))
        self.n_unassigned -= len(blocks)
        return blocks

    def requeue_failed(self, block: int) -> bool:
        """Put a block back into the queue after its first failure, and return True.

        After a second failure the block is not put back, and the result is False.
        """
        if block in self.failed_blocks:
            return False
        self.failed_blocks.add(block)
        self._failed_once.append(block)
        return True

    def requeue(self, blocks: list[int]) -> None:
        """Put blocks back into the queue that are unfinished, or whose task was lost.

        A block that has failed before is queued as failed again, and will be alone in its task.
        """
        for block in blocks:
            (self._failed_once if block in self.failed_blocks else self._requeued).append(block)


def _iter_false_indices(mask: np.ndarray, step: int = 1 << 16) -> Iterator[int]:
    """Yield the indices of False elements of a mask, searched in steps of `step` elements."""
    for start in range(0, mask.size, step):
        yield from (start + np.flatnonzero(~mask[start : start + step])).tolist()


def run_serial(
    settings: TaskSettings,
    block_queue: BlockQueue,
    is_stopping: Callable[[], bool],
    verify_receipt: ReceiptVerifier,
    say: MessagePrinter,
) -> Iterator[TaskResult]:
    """Compute blocks in this process one after the other. Yield a TaskResult for each block.

    Every other way to compute must write the same bytes as this reference. ``is_stopping`` returns
    True once no more blocks are to begin. ``say`` gets messages for the user about a block that
    takes long.
    """
    monitor = InProcessMonitor(say, lambda: block_queue.n_unassigned)
    with monitor.watch_in_thread(IDLE_POLL_SECONDS):
        while not is_stopping() and (task_blocks := block_queue.take_blocks(1)):
            with monitor.mark_in_progress(task_blocks[0]):
                task_result = run_blocks(settings, task_blocks)
            _record_result(monitor, task_result)
            yield _accept_result(task_result, task_blocks, block_queue, verify_receipt)


def run_in_threads(
    settings: TaskSettings,
    block_queue: BlockQueue,
    is_stopping: Callable[[], bool],
    verify_receipt: ReceiptVerifier,
    say: MessagePrinter,
    n_threads: int,
) -> Iterator[TaskResult]:
    """Compute blocks in threads of this process. Yield their results as they arrive.

    Compiled kernels release Python's global lock, so that the threads keep all cores busy. Each
    thread takes one block at a time. While no result arrives, an empty one is yielded every
    `IDLE_POLL_SECONDS`.

    Parameters
    ----------
    settings
        Settings of the run.
    block_queue
        Queue of the blocks that are not done.
    is_stopping
        Returns True once the run is to stop. Running blocks are then finished; no other begins.
    verify_receipt
        Tells whether the block of a receipt is in the store.
    say
        Gets messages for the user, if no block is finished for long.
    n_threads
        Number of threads.

    Raises
    ------
    StoreError, OSError, CodeError
        If no block can be computed, or written to the store.
    """
    assigned_blocks: queue.SimpleQueue[list[int] | None] = queue.SimpleQueue()
    finished_tasks: queue.SimpleQueue[tuple[list[int], TaskResult]] = queue.SimpleQueue()
    monitor = InProcessMonitor(say, lambda: block_queue.n_unassigned)

    def compute_assigned_blocks() -> None:
        while (task_blocks := assigned_blocks.get()) is not None:
            try:
                with monitor.mark_in_progress(task_blocks[0]):
                    task_result = run_blocks(settings, task_blocks)
            except BaseException as error:  # else the run would wait for this thread for good
                task_result = TaskResult(
                    failures=[make_failure(block, error) for block in task_blocks]
                )
            finished_tasks.put((task_blocks, task_result))

    # After a second Ctrl-C the command ends without waiting for them, hence daemon threads.
    for number in range(n_threads):
        threading.Thread(
            target=compute_assigned_blocks, name=f"compute-{number}", daemon=True
        ).start()
    n_in_flight = 0
    try:
        while True:
            while n_in_flight < n_threads and not is_stopping():
                if not (task_blocks := block_queue.take_blocks(1)):
                    break
                assigned_blocks.put(task_blocks)
                n_in_flight += 1
            if not n_in_flight:
                return
            try:
                task_blocks, task_result = finished_tasks.get(timeout=IDLE_POLL_SECONDS)
            except queue.Empty:
                monitor.report_if_stalled()
                yield TaskResult(n_workers=n_threads)
                continue
            n_in_flight -= 1
            _record_result(monitor, task_result)
            accepted_result = _accept_result(task_result, task_blocks, block_queue, verify_receipt)
            accepted_result.n_workers = n_threads
            yield accepted_result
    finally:
        for _ in range(n_threads):
            assigned_blocks.put(None)


def _record_result(monitor: InProcessMonitor, task_result: TaskResult) -> None:
    """Report the number and the computing time of a task's finished blocks to a stall monitor."""
    work_seconds = sum(receipt.seconds for receipt in task_result.receipts)
    monitor.record_result(len(task_result.receipts), work_seconds)


def _accept_result(
    task_result: TaskResult,
    task_blocks: list[int],
    block_queue: BlockQueue,
    verify_receipt: ReceiptVerifier,
) -> TaskResult:
    """Return a task's result, after checking that the blocks of its receipts are in the store.

    If a block is missing from the store, all blocks of the task count as failed. Unfinished blocks
    are put back into the queue. An error that would prevent every block from being computed is
    raised.
    """
    if task_result.worker_error is not None:
        raise task_result.worker_error
    if not all(verify_receipt(receipt, False) for receipt in task_result.receipts):
        task_result = TaskResult(
            failures=[
                make_failure(block, StoreError(RESULTS_NOT_VISIBLE_MESSAGE))
                for block in task_blocks
            ]
        )
    block_queue.requeue(list(task_result.checkpoint_points_by_block))
    return task_result
