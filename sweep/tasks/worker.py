"""What runs on a worker: blocks evaluated, written, and answered for with receipts."""

from __future__ import annotations

import errno
import os
import socket
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from sweep.storage.atomic_replace import stamp
from sweep.storage.locations import located
from sweep.tasks import begun, store, versions
from sweep.tasks.begun import Begun
from sweep.tasks.errors import StoreError
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.journal import Failure, Receipt
from sweep.tasks.study import Evaluate, Results, Stop, Study, Unfinished
from sweep.tasks.time_limit import limited, worker_address

#: Errors of the place that results go to: every further block would meet them too.
STORAGE_ERRORS = {
    errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.ESTALE,
    errno.ECONNREFUSED, errno.ETIMEDOUT, errno.ENXIO,
}  # fmt: skip

#: Seconds after which draws are saved, and their block put back for another task: what is lost
#: where a worker dies, and waited for after Ctrl-C.
PIECE_SECONDS = 10.0

#: Studies that a worker holds open at once.
STUDIES_OPEN = 4


@dataclass
class Answer:
    """What became of the blocks of one task."""

    receipts: list[Receipt] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    begun: dict[int, float] = field(default_factory=dict)  # points there are of unfinished blocks
    worker: str = ""  # address of the one that computed them, where there is one
    host: str = ""  # its machine
    unfit: Exception | None = None  # why that worker can't compute any
    workers: int = 1  # that there were as it arrived


@dataclass(frozen=True)
class Opened:
    """A study opened for computing its blocks."""

    study: Study
    arrays: store.Arrays


_studies: dict[tuple[str, str], Opened] = {}
_stamps: dict[str, tuple[tuple[int, ...], str]] = {}
_opening = threading.Lock()


def study(path: str, study_id: str) -> Opened:
    """The study of a store, opened once a process.

    Raises
    ------
    StoreError
        Where the store holds another study, or was begun with other software than is here.
    """
    with _opening:
        if (path, study_id) not in _studies:
            if len(_studies) >= STUDIES_OPEN:
                _studies.clear()
                _stamps.clear()
            _studies[path, study_id] = _open(path, study_id)
        return _studies[path, study_id]


def _open(path: str, study_id: str) -> Opened:
    from sweep.tasks.identity import refuse_other_versions
    from sweep.tasks.studies import read

    attributes, held = read(located(path))
    _refuse_another(path, study_id)
    refuse_other_versions(path, attributes, where=f"worker on {socket.gethostname()}")
    return Opened(held, store.Arrays(path, held))


def _refuse_another(path: str, study_id: str) -> None:
    """Refuse a store that was put in the place of the one that a task was sent for."""
    held = _held(path, stamp(located(path)))
    if held != study_id:
        raise StoreError(f"{path} now holds study {held}, not {study_id}")


def _held(path: str, found: tuple[int, ...] | None) -> str:
    """Id of the study in a store; read again where its stamp is another."""
    from sweep.storage.opening import read_attributes

    known = _stamps.get(path)
    if known and found and known[0] == found:
        return known[1]
    held = str(read_attributes(located(path))["study_id"])
    if found:
        _stamps[path] = found, held
    return held


@dataclass(frozen=True)
class Terms:
    """How blocks are computed; nothing of it shows in the results."""

    evaluate: Evaluate | None = None  # in place of the study, with the same results
    seconds: float | None = None  # that one block may take
    durable: bool = False  # whether its chunks are on the disk before its receipt


def work(path: str, study_id: str, blocks: list[int], terms: Terms) -> Answer:
    """Evaluate and write blocks, each on its own: one that raises does not stop the next.

    Of one that takes long a piece is computed, and saved for the next task.

    Parameters
    ----------
    path, study_id
        The store and the study that it must hold.
    blocks
        Numbers of the blocks.
    terms
        How.

    Returns
    -------
    Answer
        Of what was done before the store could not be read or written here, where that is so.
    """
    answer = Answer(worker=worker_address(), host=socket.gethostname())
    try:
        _work(answer, study(path, study_id), blocks, terms)
    except (StoreError, OSError) as error:
        answer.unfit = error
    return answer


def _work(answer: Answer, opened: Opened, blocks: list[int], terms: Terms) -> None:
    written, stop_at = [], time.monotonic() + PIECE_SECONDS
    for block in blocks:
        try:
            found = _one(opened, block, terms, Stop(stop_at))
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
    if terms.durable and (written or answer.begun):
        store.sync(opened.arrays.path)
    answer.receipts = written


def _one(opened: Opened, block: int, terms: Terms, stop: Stop) -> Receipt | float:
    """Receipt of a block, or the points that there are of it."""
    held, path, before = opened.study, opened.arrays.path, Begun()
    start = time.perf_counter()
    evaluate: Callable[[], Results]
    if terms.evaluate:
        evaluate = partial(terms.evaluate, held, block)
    elif isinstance(held, GridStudy) and held.spec.draws.any:
        before = begun.read(path, held.id, block)
        evaluate = partial(held.evaluate, block, before.known, stop)
    else:
        evaluate = partial(held.evaluate, block)
    try:
        results = limited(evaluate, terms.seconds, before.seconds)
    except Unfinished as unfinished:
        _refuse_another(str(path), held.id)
        spent = before.seconds + time.perf_counter() - start
        begun.write(path, held.id, block, Begun(unfinished.known, unfinished.points, spent))
        return unfinished.points
    evaluated = time.perf_counter()
    _refuse_another(str(path), held.id)  # its driver may be long dead
    written = opened.arrays.write(block, results)
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
        versions=versions.software(),
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
