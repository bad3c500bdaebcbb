"""Blocks handed out, and on a worker: evaluated in the time they may take, written, receipted."""

from __future__ import annotations

import ctypes
import errno
import os
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

from sweep.storage.locations import located, stamp
from sweep.storage.opening import read_attributes
from sweep.tasks import journal, store, studies
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.journal import Begun, Failure, Receipt
from sweep.tasks.progress import CodeError, StoreError
from sweep.tasks.study import Evaluate, Results, Stop, Unfinished

T = TypeVar("T")

#: Errors of the place that results go to: every further block would meet them too.
STORAGE_ERRORS = {
    errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.ESTALE,
    errno.ECONNREFUSED, errno.ETIMEDOUT, errno.ENXIO,
}  # fmt: skip

#: Seconds after which draws are saved, and their block put back for another task: what is lost
#: where a worker dies, and waited for after Ctrl-C.
PIECE_SECONDS = 10.0

#: Seconds that a thread has, after its time, to come back from compiled code and be interrupted.
GRACE = 10.0

#: Seconds between looks at the scheduler, the lock and the clock while nothing arrives.
TICK = 0.5

#: Studies that a worker holds open at once.
STUDIES_OPEN = 4


NOT_HERE = "what was written is not in the store here: does the worker see the same file system?"

Seen = Callable[[Receipt, bool], bool]


@dataclass(frozen=True)
class Job:
    """Part that all tasks of a run have in common; small, for it travels with each."""

    path: str
    study_id: str
    evaluate: Evaluate | None = None  # in place of the study, with the same results
    seconds: float | None = None  # that one block may take
    durable: bool = False  # whether its chunks are on the disk before its receipt
    code: tuple[tuple[str, str], ...] = ()  # modules of the user's that may run, and their digests


@dataclass
class Answer:
    """Results of one task: what was written, what failed, what is begun."""

    receipts: list[Receipt] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    begun: dict[int, float] = field(default_factory=dict)  # points there are of unfinished blocks
    worker: str = ""  # address of the one that computed them, where there is one
    host: str = ""  # its machine
    unfit: Exception | None = None  # why that worker can't compute any
    workers: int = 1  # that there were as it arrived


_opening = threading.Lock()


def study(path: str, study_id: str) -> store.Arrays:
    """Return the study of a store, opened for writing once a process; StoreError for another."""
    with _opening:
        return _opened(path, study_id)


def _open(path: str, study_id: str) -> store.Arrays:
    attributes, held = studies.read(located(path))
    _refuse_another(path, study_id)
    store.refuse_other_versions(path, attributes, where=f"worker on {socket.gethostname()}")
    return store.Arrays(path, held)


_opened = lru_cache(maxsize=STUDIES_OPEN)(_open)


def _refuse_another(path: str, study_id: str) -> None:
    """Refuse a store that was put in the place of the one that a task was sent for."""
    found = stamp(located(path))
    held = _held(path, found) if found else _held.__wrapped__(path, found)
    if held != study_id:
        raise StoreError(f"{path} now holds study {held}, not {study_id}")


@lru_cache(maxsize=STUDIES_OPEN)
def _held(path: str, found: tuple[int, ...] | None) -> str:
    """Id of the study in a store, which has a stamp."""
    return str(read_attributes(located(path))["study_id"])


def work(job: Job, blocks: list[int]) -> Answer:
    """Evaluate and write blocks, each on its own: one that raises does not stop the next.

    Of one that takes long a piece is computed, and saved for the next task.
    """
    answer = Answer(worker=worker_address(), host=socket.gethostname())
    try:
        if answer.worker:
            _admit(job)
        _work(answer, study(job.path, job.study_id), blocks, job)
    except (CodeError, StoreError, OSError) as error:
        answer.unfit = error
    return answer


def _admit(job: Job) -> None:
    """Allow the code that the run's driver allows in this worker; CodeError if it has another."""
    if job.code:
        from sweep.tasks.user_code import admit

        for module, digest in job.code:
            admit(module, digest)


def _work(answer: Answer, arrays: store.Arrays, blocks: list[int], job: Job) -> None:
    written, stop_at = [], time.monotonic() + PIECE_SECONDS
    for block in blocks:
        try:
            found = _one(arrays, block, job, Stop(stop_at))
            if isinstance(found, Receipt):
                written.append(found)
            else:
                answer.begun[block] = found
        except StoreError:
            raise
        except Exception as error:
            if isinstance(error, OSError) and error.errno in STORAGE_ERRORS:
                raise
            answer.failures.append(failure(block, error))
    if job.durable and (written or answer.begun):
        store.sync(arrays.path)
    answer.receipts = written


def _one(arrays: store.Arrays, block: int, job: Job, stop: Stop) -> Receipt | float:
    """Receipt of a block, or the points that there are of it."""
    held, path, before = arrays.study, arrays.path, Begun()
    start = time.perf_counter()
    evaluate: Callable[[], Results]
    if job.evaluate:
        evaluate = partial(job.evaluate, held, block)
    elif isinstance(held, GridStudy) and held.spec.draws.any:
        before = journal.read_begun(path, held.id, block)
        evaluate = partial(held.evaluate, block, before.known, stop)
    else:
        evaluate = partial(held.evaluate, block)
    try:
        results = limited(evaluate, job.seconds, before.seconds)
    except Unfinished as unfinished:
        _refuse_another(str(path), held.id)
        spent = before.seconds + time.perf_counter() - start
        journal.write_begun(path, held.id, block, Begun(unfinished.known, unfinished.points, spent))
        return unfinished.points
    evaluated = time.perf_counter()
    _refuse_another(str(path), held.id)  # its driver may be long dead
    written = arrays.write(block, results)
    ended = time.perf_counter()
    earlier = getattr(held, "earlier", None)
    return Receipt(
        block=block,
        points=held.block_size(block),
        bytes=written.bytes,
        digest=written.digest,
        seconds=round(before.seconds + ended - start, 6),
        write_seconds=round(ended - evaluated, 6),
        host=socket.gethostname(),
        pid=os.getpid(),
        versions=store.software(),
        taken=earlier.taken.pop(block, 0) if earlier else 0,
    )


def failure(block: int, error: BaseException) -> Failure:
    """Record of a block's error, as met in this process."""
    lines = traceback.format_exception(type(error), error, error.__traceback__)
    return Failure(
        block=block,
        error=f"{type(error).__name__}: {error}",
        traceback="".join(lines)[-8000:],
        host=socket.gethostname(),
        pid=os.getpid(),
    )


class Overtime(Exception):
    """A block took longer than it may."""


class _Interruption(SystemExit):
    """Raised in a thread from outside; no `except Exception` on its way takes it for its own."""


def limited(work: Callable[[], T], seconds: float | None, spent: float = 0.0) -> T:
    """Do some work, for no longer than some seconds less those spent before; Overtime where it was.

    It is done in a thread, in which Python code is interrupted. A worker process whose thread is
    still in compiled code `GRACE` seconds later ends itself; any other waits for it to return.
    """
    if seconds is None:
        return work()
    found: list[T] = []
    raised: list[BaseException] = []
    over, left = threading.Event(), threading.Event()

    def do() -> None:
        try:
            found.append(work())
        except BaseException as error:
            raised.append(error)
        over.set()
        left.wait()  # until then no other thread has the number that is interrupted

    # which sees what is set here, such as Dask's worker
    thread = threading.Thread(target=copy_context().run, args=(do,), daemon=True)
    in_time = False
    thread.start()
    try:
        in_time = over.wait(max(seconds - spent, 0.0))
    finally:  # after Ctrl-C too
        if not in_time:
            number, error = ctypes.c_ulong(thread.ident or 0), ctypes.py_object(_Interruption)
            ctypes.pythonapi.PyThreadState_SetAsyncExc(number, error)
        left.set()
    if not in_time:
        # A worker in a process of its own may end without harm.
        deadly = worker_address().partition("://")[0] not in ("", "inproc")
        thread.join(GRACE if deadly else None)
        if thread.is_alive():
            os._exit(1)  # stuck in compiled code; a nanny starts another worker
        why = f"took longer than the {seconds:g} s that a block may take"
        raise Overtime(why) from (raised[0] if raised else None)
    if raised:
        raise raised[0]
    return found[0]


def worker_address() -> str:
    """Address of the Dask worker that this thread computes for; empty where there is none."""
    if "distributed" not in sys.modules:
        return ""
    from distributed import get_worker

    try:
        return str(get_worker().address)
    except ValueError:
        return ""


class BlockQueue:
    """Blocks that are not done, (blocks,) bool, handed out lazily; what fails comes back, alone."""

    def __init__(self, done: np.ndarray) -> None:
        self.left = int(done.size - np.count_nonzero(done))  # not yet handed out
        self._fresh = _numbers(done)
        self._suspects: deque[int] = deque()
        self._returned: deque[int] = deque()
        self.failed: set[int] = set()

    def take(self, count: int, *, suspects: bool = True) -> list[int]:
        """Up to `count` blocks for one task; one that failed before comes by itself, if at all."""
        if self._suspects and suspects:
            return [self._suspects.popleft()]
        if self._returned:
            return [self._returned.popleft()]
        blocks = list(islice(self._fresh, count))
        self.left -= len(blocks)
        return blocks

    def again(self, block: int) -> bool:
        """Put a failed block back; False where this was its second failure."""
        if block in self.failed:
            return False
        self.failed.add(block)
        self._suspects.append(block)
        return True

    def put_back(self, blocks: list[int]) -> None:
        """Put blocks back whose answer was lost, by no fault of theirs, or that are begun.

        One that failed before stays a suspect, and is never out together with another.
        """
        for block in blocks:
            (self._suspects if block in self.failed else self._returned).append(block)


def _numbers(done: np.ndarray, stretch: int = 1 << 16) -> Iterator[int]:
    for start in range(0, done.size, stretch):
        yield from (start + np.flatnonzero(~done[start : start + stretch])).tolist()


def plain(
    job: Job, blocks: BlockQueue, stopping: Callable[[], bool], seen: Seen
) -> Iterator[Answer]:
    """Answers of a study computed here, one block after the other: what defines its bytes."""
    while not stopping() and (some := blocks.take(1)):
        answer = work(job, some)
        if not all(seen(receipt, False) for receipt in answer.receipts):
            answer = Answer(failures=[failure(block, StoreError(NOT_HERE)) for block in some])
        blocks.put_back(list(answer.begun))
        yield answer
        if answer.unfit is not None:
            raise answer.unfit
