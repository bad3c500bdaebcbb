"""Journal of a store: logs of committed blocks, recipe, checkpoints and lock, in `.sweep`.

A block is done when its receipt, one JSON line, is in the log and its chunks are in the store. All
other blocks are computed again, to the same bytes. Only the driver that holds the store's lock
appends to the log. A further line withdraws a receipt whose chunks are found damaged. A line that
does not match its digest is ignored.

The recipe records what the store's other files do not contain: the folder of the study's files, and
the store that this one extends.

Blocks that take long are computed in pieces. A worker computes for some seconds and saves the
results so far as a checkpoint, a file with a digest. The next worker continues from it.

The lock names the driver that writes to the store. Its heartbeat shows that this driver still runs.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import io
import json
import logging
import math
import os
import socket
import stat
import threading
import time
import uuid
import warnings
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sweep.messages import SPEC_PLACEHOLDER, escape_to_one_line, suggested_call
from sweep.regular_files import RefusedFileError, open_regular_file
from sweep.safe_json import parse_json
from sweep.storage.locations import (
    CONCURRENT_REQUESTS_MAX,
    HIDDEN_PROCESS_START_ID,
    JOURNAL_DIR,
    Location,
    ObjectPath,
    ObjectStoreError,
    ObjectVersion,
    VersionedContent,
    atomic_write,
    os_error_reason,
    process_start_id,
    read_object,
)
from sweep.storage.size_checks import ARRAY_FILE_BYTES_MAX
from sweep.storage.store_format import (
    RECEIPTS_FILE,
    decode_log_record,
    encode_log_record,
    iter_log_lines,
    iter_log_records,
    open_log,
    read_receipt_totals,
    verified_line_body,
)
from sweep.tasks.engine.block_study import BlockStudy, EarlierResults, PartialResults
from sweep.tasks.engine.progress import StoreBusyError, StoreError, raise_as_store_error

#: Name of the log of blocks that failed permanently.
FAILURE_LOG_FILE = "failures.jsonl"

#: Name of the log of the beginnings and ends of runs.
SESSION_LOG_FILE = "sessions.jsonl"

LOG_FILE_NAMES = (RECEIPTS_FILE, FAILURE_LOG_FILE, SESSION_LOG_FILE)

#: Name of the recipe: the facts about how a store is made that its other files do not contain.
RECIPE_FILE = "recipe.json"

#: Key, in a store's recipe, of the path of the store that this one extends and takes results from.
EXTENDED_STORE_KEY = "extends"

#: Key, in a store's recipe, of the digests of the user's modules at the start of the first run.
USER_MODULE_DIGESTS_KEY = "code"

#: Key, in a store's recipe, of the id of the study whose store this one will replace; '' if none.
REPLACED_STUDY_ID_KEY = "replaces"

#: Largest number of folders on disk that are listed at once; listing is mostly waiting.
CONCURRENT_LISTINGS_MAX = 4

_log = logging.getLogger("sweep.journal")


@dataclass(frozen=True, kw_only=True)
class Receipt:
    """Record of a stored block: number, points, size, digest, times, and process that wrote it."""

    block: int  # number of the block
    points: int  # number of its points
    bytes: int  # size as stored [bytes]
    digest: str  # digest of the stored bytes, by `store_format.contents_digest`
    seconds: float  # time of evaluating and writing [s]
    write_seconds: float  # time of writing [s]
    host: str
    pid: int
    versions: dict[str, str]  # versions of software, by name
    reused_points: int = 0  # number of points taken from the store of a smaller study


@dataclass(frozen=True, kw_only=True)
class Failure:
    """Record of a block that raised an error: the error, and the process in which it occurred."""

    block: int  # number of the block
    error: str  # type and message of the error
    traceback: str
    host: str
    pid: int


class Journal:
    """Writer of a store's logs. Damaged and incomplete lines are removed when it is opened.

    The caller holds the store's lock. If `durable`, a committed receipt is on the disk, and not
    only in the cache of the operating system.
    """

    def __init__(self, store_path: Location, *, durable: bool = False) -> None:
        journal_path = store_path / JOURNAL_DIR
        self._logs = {
            name: open_log(journal_path / name, durable=durable) for name in LOG_FILE_NAMES
        }
        for log in self._logs.values():
            log.remove_damaged_lines(lambda line: verified_line_body(line) is not None)

    def commit(self, *receipts: Receipt) -> None:
        """Append receipts to the log of receipts. A written receipt marks its block as done.

        On disk, receipts are written at once. In an object store, the next `flush` that is due
        writes them.
        """
        commit_time = round(time.time(), 3)
        self._append(
            RECEIPTS_FILE, *({**asdict(receipt), "time": commit_time} for receipt in receipts)
        )

    def withdraw_receipt(self, block: int, reason: str) -> None:
        """Add a log line that cancels a block's receipt, so that the block is computed again.

        `reason` is recorded in the line.
        """
        self._append(
            RECEIPTS_FILE, {"block": block, "withdrawn": reason, "time": round(time.time(), 3)}
        )

    def flush(self, *, force: bool = False) -> bool:
        """Write the pending lines of all logs. Return True if no pending line is left.

        In an object store, lines that are not due yet are written only if `force`.
        """
        is_flushed = [log.flush(force=force) for log in self._logs.values()]
        return all(is_flushed)

    def record_failure(self, failure: Failure) -> None:
        """Append the error of a block that failed permanently to the log of failures.

        Later runs skip this block unless they are asked to retry.
        """
        self._append(FAILURE_LOG_FILE, asdict(failure))

    def record_run_event(self, event: str, **details: Any) -> None:
        """Append an event of the run, such as its start or end, and write all pending lines."""
        utc = datetime.now(UTC).isoformat(timespec="seconds")
        self._append(SESSION_LOG_FILE, {"event": event, "time": time.time(), "utc": utc, **details})
        self.flush(force=True)

    def _append(self, log_name: str, *records: dict[str, Any]) -> None:
        """Append lines to a log, all or none. OSError is raised if they can't be written."""
        if records:
            self._logs[log_name].append(b"".join(map(encode_log_record, records)))


def read_committed_digests(store_path: Location, n_blocks: int) -> np.ndarray:
    """Return the digest in each block's receipt, (blocks,) of bytes; b'' without a receipt."""
    digest_by_block = np.zeros(n_blocks, dtype="S32")
    for record in iter_log_records(store_path / JOURNAL_DIR / RECEIPTS_FILE):
        if 0 <= record["block"] < n_blocks:
            digest_by_block[record["block"]] = record.get(
                "digest", ""
            )  # a line that withdraws a receipt has no digest
    return digest_by_block


def receipted_block_mask(store_path: Location, study: BlockStudy) -> np.ndarray:
    """Return a mask (blocks,) of blocks with a receipt, whether their chunks exist or not."""
    return read_receipt_totals(store_path, study.n_blocks).points_by_block > 0


def committed_block_mask(store_path: Location, study: BlockStudy) -> np.ndarray:
    """Return a mask (blocks,) of the blocks that are done.

    A block is done if it has a receipt and all of its chunks are in the store.
    """
    return find_complete_block_mask(store_path, study, receipted_block_mask(store_path, study))


def read_permanent_failures(store_path: Location, n_blocks: int) -> dict[int, dict[str, Any]]:
    """Return records of blocks that failed permanently and are not done, by block number.

    If a block failed in several runs, the last record counts.
    """
    last_failures = {
        record["block"]: record
        for record in iter_log_records(store_path / JOURNAL_DIR / FAILURE_LOG_FILE)
    }
    if last_failures:
        for record in iter_log_records(store_path / JOURNAL_DIR / RECEIPTS_FILE):
            last_failures.pop(record["block"], None)
    return {block: failure for block, failure in last_failures.items() if block < n_blocks}


@dataclass(frozen=True, kw_only=True)
class LastRun:
    """Start time of the last run of a store, and number of threads that computed in it."""

    start_time: float  # [s since the epoch]; inf if there was no run
    n_threads: int  # number of threads of the command's process; 0 if workers computed, or unknown


def read_last_run(store_path: Location) -> LastRun:
    """Return the start time and the number of threads of the last run of a store.

    The start time is inf if there was no run.
    """
    runs = iter_log_records(store_path / JOURNAL_DIR / SESSION_LOG_FILE)
    starts = [run for run in runs if run.get("event") == "begun"]
    if not starts:
        return LastRun(start_time=np.inf, n_threads=0)
    n_threads = starts[-1].get("threads", 0)  # absent in the logs of older versions
    return LastRun(
        start_time=float(starts[-1]["time"]),
        n_threads=n_threads if isinstance(n_threads, int) else 0,
    )


def write_store_recipe(store_path: Location, **facts: Any) -> None:
    """Replace a store's recipe, the file of facts about how the store is made, in one step.

    ``facts`` are all entries of the new recipe, such as the folder of the study's files.
    """
    atomic_write(store_path / JOURNAL_DIR / RECIPE_FILE, encode_log_record(facts))


def read_store_recipe(store_path: Location) -> dict[str, Any]:
    """Return the entries of a store's recipe, by name; {} if the recipe is missing or damaged.

    The recipe is the file of facts about how the store is made.
    """
    records = [record for _, record in iter_log_lines(store_path / JOURNAL_DIR / RECIPE_FILE)]
    return records[0] or {} if len(records) == 1 else {}


def remove_predecessors_from_recipe(store_path: Path) -> None:
    """Remove, from a store's recipe, the entries that name the store it extends or replaces."""
    facts = read_store_recipe(store_path)
    for name in (EXTENDED_STORE_KEY, REPLACED_STUDY_ID_KEY):
        facts.pop(name, None)
    if facts:
        write_store_recipe(store_path, **facts)
    else:
        (store_path / JOURNAL_DIR / RECIPE_FILE).unlink(missing_ok=True)


def refuse_damaged_recipe(store_path: Location) -> None:
    """Raise a StoreError if a store's recipe (facts about how the store is made) is damaged."""
    recipe_path = store_path / JOURNAL_DIR / RECIPE_FILE
    if any(record is None for _, record in iter_log_lines(recipe_path)):
        raise StoreError(
            f"{recipe_path} is damaged, and with it where the files of the study are: "
            f"{suggested_call('resume', store_path, spec=SPEC_PLACEHOLDER)} puts it down anew"
        )


class ChunkScan:
    """Search for missing chunks of blocks, in threads that start on construction.

    `candidates` is a mask (blocks,) of bool of the blocks whose chunks are searched.
    """

    def __init__(self, store_path: Location, study: BlockStudy, candidates: np.ndarray) -> None:
        self._candidates, self._is_stopped = candidates.copy(), False
        n_threads = (
            CONCURRENT_REQUESTS_MAX
            if isinstance(store_path, ObjectPath)
            else CONCURRENT_LISTINGS_MAX
        )
        self._executor = ThreadPoolExecutor(n_threads, thread_name_prefix="chunk-scan")

        def blocks_lacking_chunk(array_name: str, owner_blocks: np.ndarray) -> np.ndarray:
            """Return the candidate blocks whose chunk of an array is missing."""
            if self._is_stopped:
                return np.empty(0, np.int64)
            is_present = find_existing_chunk_mask(store_path / array_name / "c", owner_blocks.shape)
            return owner_blocks[~is_present & self._candidates[owner_blocks]]

        owners_by_array = study.chunk_owner_blocks() if candidates.any() else {}
        self._array_scans = [
            self._executor.submit(blocks_lacking_chunk, *name_and_owners)
            for name_and_owners in owners_by_array.items()
        ]

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the search ends, for at most `timeout` [s]. Return True if it has ended."""
        return not wait(self._array_scans, timeout).not_done

    def complete_block_mask(self) -> np.ndarray:
        """Return a mask (blocks,) of the candidate blocks of which no chunk is known to be missing.

        Only arrays whose search has ended are considered. OSError is raised if the store can't be
        read.
        """
        is_complete = self._candidates.copy()
        for scan in self._array_scans:
            if scan.done():
                is_complete[scan.result()] = False
        return is_complete

    def stop(self) -> None:
        """End the search for missing chunks early."""
        self._is_stopped = True
        self._executor.shutdown(wait=False)


def find_complete_block_mask(
    store_path: Location, study: BlockStudy, candidates: np.ndarray
) -> np.ndarray:
    """Return a mask (blocks,) of the candidate blocks whose chunks all exist and are not empty."""
    scan = ChunkScan(store_path, study, candidates)
    try:
        scan.wait()
        return scan.complete_block_mask()
    finally:
        scan.stop()


def find_existing_chunk_mask(folder: Location, shape: tuple[int, ...]) -> np.ndarray:
    """Return a mask of the chunks of an array that exist and are not empty.

    `folder` contains the chunks. `shape` is the shape of the array's grid of chunks, and of the
    mask.
    """
    is_present = np.zeros(shape, bool)
    if isinstance(folder, ObjectPath):
        for position, size in _iter_chunk_sizes(folder, shape):
            is_present[position] = size > 0
    elif shape:
        _mark_existing_chunks(folder, is_present)
    else:
        with suppress(FileNotFoundError):
            is_present[()] = _is_nonempty_file(folder.lstat())
    return is_present


def _is_nonempty_file(status: os.stat_result) -> bool:
    """Return True for a regular file that is not empty."""
    return stat.S_ISREG(status.st_mode) and status.st_size > 0


def _iter_chunk_sizes(
    folder: ObjectPath, shape: tuple[int, ...]
) -> Iterator[tuple[tuple[int, ...], int]]:
    """Yield the position and the size [bytes] of each chunk of an array in an object store.

    `folder` contains the chunks. `shape` is the shape of the array's grid of chunks.
    """
    if not shape:
        yield (), max(0, folder.size())
        return
    for key, size in folder.iter_objects_below():
        parts = key.split("/")
        if len(parts) == len(shape) and all(map(str.isdecimal, parts)):
            position = tuple(map(int, parts))
            if all(index < count for index, count in zip(position, shape, strict=True)):
                yield position, size


def _mark_existing_chunks(
    folder_or_name: Path | str, is_present: np.ndarray, parent_descriptor: int | None = None
) -> None:
    """Set elements of `is_present` to True, in place, for the non-empty chunks below a folder.

    `is_present` has the shape of the array's grid of chunks. `parent_descriptor` is the descriptor
    of the folder's parent if `folder_or_name` is a name.
    """
    try:
        # links are not followed: their targets are no part of the store
        descriptor = os.open(
            folder_or_name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=parent_descriptor
        )
    except (FileNotFoundError, NotADirectoryError):
        return
    try:
        with os.scandir(descriptor) as entries:
            for entry in entries:
                name = entry.name
                if not name.isdecimal() or (index := int(name)) >= len(is_present):
                    continue
                if is_present.ndim > 1:
                    _mark_existing_chunks(name, is_present[index], descriptor)
                else:
                    is_present[index] = _is_nonempty_file(entry.stat(follow_symlinks=False))
    finally:
        os.close(descriptor)


#: Prefix of the file names of checkpoints (saved parts of blocks). The number of the block follows.
CHECKPOINT_FILE_PREFIX = "begun-"


class Checkpoint(NamedTuple):
    """Saved results of a block that is not complete, with the time and the points done so far."""

    results: EarlierResults = EarlierResults()
    n_points_done: float = 0.0  # number of points done; partly computed ones count in part
    seconds: float = 0.0  # time spent so far [s]


def write_checkpoint(
    store_path: Location, study_id: str, block: int, checkpoint: Checkpoint
) -> None:
    """Save a block's checkpoint, unless the stored one has at least as many points done.

    OSError is raised if the checkpoint can't be written.
    """
    if read_checkpoint(store_path, study_id, block).n_points_done >= checkpoint.n_points_done:
        return  # written by another worker, which was believed to be lost
    buffer = io.BytesIO()
    np.savez(buffer, **dict(_checkpoint_arrays(checkpoint.results)))
    content = buffer.getvalue()
    header = {
        "study": study_id,
        "block": block,
        "points": checkpoint.n_points_done,
        "seconds": checkpoint.seconds,
        "digest": _content_digest(content),
    }
    atomic_write(_block_checkpoint_path(store_path, block), encode_log_record(header) + content)


def read_checkpoint(store_path: Location, study_id: str, block: int) -> Checkpoint:
    """Return the checkpoint of a block of a study.

    The result is empty if no checkpoint is stored, or if the stored one is damaged or of another
    study.
    """
    try:
        file_content = read_object(
            store_path, f"{JOURNAL_DIR}/{CHECKPOINT_FILE_PREFIX}{block}", ARRAY_FILE_BYTES_MAX
        )
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError, RefusedFileError):
        return Checkpoint()
    line, _, content = file_content.partition(b"\n")
    header = decode_log_record(line + b"\n") or {}
    if (header.get("study"), header.get("block")) != (study_id, block):
        return Checkpoint()
    if header["digest"] != _content_digest(content):
        return Checkpoint()
    arrays_by_part: dict[str, dict[str, np.ndarray]] = {"finished": {}, "unfinished": {}}
    try:
        for key, values in _iter_npz_arrays(content):
            part, _, name = key.partition("/")
            arrays_by_part[part][name] = values
    except (ValueError, KeyError, zipfile.BadZipFile):  # not made by this program
        return Checkpoint()
    results = EarlierResults(
        **{
            part: PartialResults(arrays.pop("points"), arrays)
            for part, arrays in arrays_by_part.items()
        }
    )
    return Checkpoint(results, header["points"], header["seconds"])


def _iter_npz_arrays(content: bytes) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and the values of each array in a `numpy.savez` archive, given as bytes.

    ValueError is raised, before memory is allocated, if the archive declares a wrong size.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for member in archive.infolist():
            if member.compress_type != zipfile.ZIP_STORED or member.file_size > len(content):
                raise ValueError("packed otherwise than numpy.savez packs")
            member_file = io.BytesIO(archive.read(member))
            version = np.lib.format.read_magic(member_file)
            read_header = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }[version]
            shape, _, dtype = read_header(member_file)
            # checked before numpy allocates what the header declares
            if math.prod(shape) * dtype.itemsize != member.file_size - member_file.tell():
                raise ValueError("its header declares another size")
            member_file.seek(0)
            yield member.filename.removesuffix(".npy"), np.load(member_file, allow_pickle=False)


def read_checkpoint_point_counts(store_path: Location, study_id: str) -> dict[int, float]:
    """Return the number of points done in each checkpoint of a study, by block number."""
    block_names = [
        file.name.removeprefix(CHECKPOINT_FILE_PREFIX)
        for file in (store_path / JOURNAL_DIR).glob(f"{CHECKPOINT_FILE_PREFIX}*")
    ]
    checkpoints = {
        int(block_name): read_checkpoint(store_path, study_id, int(block_name))
        for block_name in block_names
        if block_name.isdecimal()
    }
    return {
        block: checkpoint.n_points_done
        for block, checkpoint in checkpoints.items()
        if checkpoint.n_points_done
    }


def delete_checkpoints(store_path: Location, block: int | str = "*") -> None:
    """Delete the checkpoint of one block, given by its number, or by default of all blocks."""
    for file in (store_path / JOURNAL_DIR).glob(f"{CHECKPOINT_FILE_PREFIX}{block}"):
        file.unlink(missing_ok=True)


def _block_checkpoint_path(store_path: Location, block: int) -> Location:
    """Return the path of a block's checkpoint."""
    return store_path / JOURNAL_DIR / f"{CHECKPOINT_FILE_PREFIX}{block}"


def _checkpoint_arrays(results: EarlierResults) -> dict[str, Any]:
    """Return the arrays of a block's results by their names in the archive of a checkpoint."""
    return {
        f"{part}/{name}": values
        for part, (points, arrays) in results._asdict().items()
        for name, values in {"points": points, **arrays}.items()
    }


def _content_digest(content: bytes) -> str:
    """Return the digest, in hex, of a checkpoint's content. Damage changes the digest."""
    return hashlib.blake2b(content, digest_size=16).hexdigest()


LOCK_FILE = "lock"

#: Largest number of attempts to acquire a lock in an object store against other processes.
LOCK_ATTEMPTS_MAX = 5

#: Time between the heartbeats by which a lock's holder shows that it runs [s].
HEARTBEAT_INTERVAL_SECONDS = 10.0

#: Age of the last heartbeat above which a lock's holder on another host may be dead [s].
HEARTBEAT_AGE_SECONDS_MAX = 120.0

#: Time for which an old heartbeat is watched before its holder counts as dead [s]. A clock that was
#: set can make a heartbeat seem old, but can't stop it from changing.
HEARTBEAT_WATCH_SECONDS = 35.0

#: Largest size of a lock file [bytes].
LOCK_BYTES_MAX = 1 << 16

#: Error numbers of file systems without flock (some Lustre and NFS).
FLOCK_UNSUPPORTED_ERRNOS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}

#: Error numbers of file systems without hard links (FUSE, SMB, exFAT). A file system of several
#: disks may report that the link leads to another file system.
HARD_LINK_UNSUPPORTED_ERRNOS = {
    errno.EPERM,
    errno.ENOSYS,
    errno.ENOTSUP,
    errno.EOPNOTSUPP,
    errno.EXDEV,
    errno.EMLINK,
}

_released_tokens: set[str] = set()
"""Tokens (unique texts) of the locks that this process has released.

A released lock may still be in its store, if the store could not be reached on release.
"""

_issued_warning_kinds: set[str] = set()
"""Kinds of lock warnings that this process has issued.

A study may have many locks, but each kind of warning is issued only once.
"""


@dataclass(frozen=True, kw_only=True)
class LockHolder:
    """Process that holds a store's lock: its host, process number, start time and token."""

    host: str = "unknown"
    pid: int = 0
    start: int = 0  # `process_start_id` of the process, as process numbers are reused
    token: str = ""  # unique text of the lock
    machine: str = ""  # boot id and namespace, as several hosts may have the same name

    @classmethod
    def of_this_process(cls) -> LockHolder:
        """Return this process as a lock holder, with a new token (a unique text)."""
        pid = os.getpid()
        return cls(
            host=socket.gethostname(),
            pid=pid,
            start=process_start_id(pid),
            token=uuid.uuid4().hex,
            machine=_boot_and_namespace_id(),
        )

    @property
    def is_on_this_machine(self) -> bool:
        """True if the holder is a process of this machine, running or not."""
        return self.host == socket.gethostname() and self.machine in ("", _boot_and_namespace_id())


@cache
def _boot_and_namespace_id() -> str:
    """Return a text that identifies the machine's boot and the process's namespace; '' if unknown.

    A process number is unique only among the processes with the same text.
    """
    try:
        boot_id = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot_id} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def read_lock_holder(store_path: Location) -> LockHolder | None:
    """Return the holder of a store's lock, alive or dead; None if the store is not locked."""
    holder_json = _lock_of_store(store_path).read_holder_json()
    return None if holder_json is None else _parse_lock_holder(holder_json)


def _parse_lock_holder(holder_json: str) -> LockHolder:
    """Return the process that a lock's JSON text describes.

    Fields that are missing or damaged have their default values.
    """
    try:
        record = parse_json(holder_json)
    except ValueError:
        return LockHolder()
    types = {field.name: type(field.default) for field in fields(LockHolder)}
    known_fields: dict[str, Any] = {}
    if isinstance(record, dict):
        known_fields = {
            name: value for name, value in record.items() if type(value) is types.get(name)
        }
    return LockHolder(**known_fields)


def is_holder_alive(store_path: Location, holder: LockHolder) -> bool:
    """Return True if the process that holds a lock still runs.

    A process on this machine is looked up. A process on another machine counts as alive if its last
    heartbeat is younger than `HEARTBEAT_AGE_SECONDS_MAX`.
    """
    if (is_running := _is_running_here(holder)) is not None:
        return is_running
    return heartbeat_age(store_path) < HEARTBEAT_AGE_SECONDS_MAX


def _is_running_here(holder: LockHolder) -> bool | None:
    """Return True if a lock's holder runs on this machine, and False if it has ended.

    The result is None if the holder is on another machine, or can't be seen by this process.
    """
    if not (holder.is_on_this_machine and holder.start):
        return None
    current_start = process_start_id(holder.pid)
    return None if current_start == HIDDEN_PROCESS_START_ID else current_start == holder.start


def heartbeat_age(store_path: Location) -> float:
    """Return the time since the last heartbeat of a store's lock [s]; inf if there is no lock.

    The present time is read from the clock of the store's file system, if this process can write to
    the store.
    """
    lock_path = store_path / JOURNAL_DIR / LOCK_FILE
    probe = lock_path.with_name(f"clock-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    file_system_time: float | None = None
    try:
        probe.write_bytes(b"clock")
        file_system_time = _modification_time(probe)
    except OSError:
        pass  # this process may only read the store
    finally:
        with suppress(OSError):
            probe.unlink()
    heartbeat_time = _modification_time(lock_path)
    return (
        float("inf")
        if heartbeat_time is None
        else (file_system_time or time.time()) - heartbeat_time
    )


def _modification_time(path: Location) -> float | None:
    """Return the time of the last write of a file [s since the epoch]; None if missing."""
    if isinstance(path, ObjectPath):
        return path.last_modified()
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return None


class _FileLock:
    """Lock of a store on disk: a file that names the process that holds it."""

    def __init__(self, lock_path: Path) -> None:
        self._lock_path = lock_path

    def read_holder_json(self) -> str | None:
        """Return the JSON text that describes the lock's holder; None if the lock is free."""
        return _read_lock_file(self._lock_path)

    def heartbeat_version(self) -> object:
        """Return a value that changes with every heartbeat; None if the lock is free."""
        try:
            descriptor = open_regular_file(
                self._lock_path, follow_links=False
            )  # opening makes a file server return the current status
        except FileNotFoundError:
            return None
        try:
            status = os.fstat(descriptor)
        finally:
            os.close(descriptor)
        return status.st_ino, status.st_mtime_ns

    def acquire(
        self, holder_json: str, check_holder: Callable[[], None], say: Callable[[str], None]
    ) -> None:
        """Acquire the lock for the holder that a JSON text describes.

        A dead holder's lock is removed first. `check_holder` must raise an error if the present
        holder lives. `say` gets warnings. On file systems with flock no other process can acquire
        the lock between check and acquisition. StoreBusyError is raised if another process was
        quicker.
        """
        self._lock_path.parent.mkdir(exist_ok=True)
        with self._acquisition_guard(say):  # one process at a time checks and acquires
            stale_json = self.read_holder_json()
            check_holder()
            self._remove_stale_lock(stale_json)
            new_lock_path = self._lock_path.with_name(f"lock.{uuid.uuid4().hex}")
            atomic_write(
                new_lock_path, holder_json.encode()
            )  # on the disk first: an empty lock after a power failure would count as alive
            try:
                self._create_lock_file(new_lock_path, holder_json, say)
            except FileExistsError:
                if (
                    self.read_holder_json() != holder_json
                ):  # a file server may have made the link, and lost its response
                    raise StoreBusyError(
                        f"another process was quicker to lock {self._lock_path}"
                    ) from None
            finally:
                new_lock_path.unlink(missing_ok=True)

    @contextmanager
    def _acquisition_guard(self, say: Callable[[str], None]) -> Iterator[None]:
        """Context manager in which no other process can acquire the lock. It needs flock.

        If the file system has no flock, `say` gets a warning, and other processes are not kept out.
        """
        guard_path = self._lock_path.with_name("lock.guard")
        open_flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        guard_descriptor = os.open(guard_path, open_flags, 0o666)
        try:
            if not stat.S_ISREG(os.fstat(guard_descriptor).st_mode):
                raise RefusedFileError(errno.EINVAL, "is no plain file", str(guard_path))
            try:
                _log.debug("waiting until no other process acquires %s", self._lock_path)
                fcntl.flock(guard_descriptor, fcntl.LOCK_EX)
            except OSError as error:
                if error.errno not in FLOCK_UNSUPPORTED_ERRNOS:
                    raise
                _warn_once(
                    say,
                    "flock",
                    f"the file system of {self._lock_path} has no flock ({error.strerror}): start "
                    "no two runs of one store within the same second",
                )
            yield
        finally:
            os.close(guard_descriptor)

    def _remove_stale_lock(self, stale_json: str | None) -> None:
        """Remove the lock file of a dead holder, whose JSON text is `stale_json`.

        The lock file is kept if another process has acquired the lock meanwhile. Nothing happens if
        `stale_json` is None.
        """
        if stale_json is None:
            return
        _log.debug("%s: taking over from %s", self._lock_path, escape_to_one_line(stale_json))
        aside_path = self._lock_path.with_name(f"lock.{uuid.uuid4().hex}")
        with suppress(FileNotFoundError):
            os.rename(self._lock_path, aside_path)
            if _read_lock_file(aside_path) != stale_json:  # another process was quicker
                _log.debug("%s: another process was quicker, and keeps it", self._lock_path)
                try:
                    os.link(aside_path, self._lock_path)
                except OSError:
                    if not self._lock_path.exists():
                        os.rename(aside_path, self._lock_path)
            aside_path.unlink()

    def _create_lock_file(
        self, new_lock_path: Path, holder_json: str, say: Callable[[str], None]
    ) -> None:
        """Create the lock file as a link to a complete file at `new_lock_path`.

        On a file system without hard links, `holder_json` is written to the lock file instead, and
        `say` gets a warning. FileExistsError is raised if another process has created the lock file
        meanwhile.
        """
        try:
            os.link(new_lock_path, self._lock_path)  # fails if the lock exists, on NFS too
            return
        except OSError as error:
            if error.errno not in HARD_LINK_UNSUPPORTED_ERRNOS:
                raise
            reason = error.strerror
        _warn_once(
            say,
            "links",
            f"the file system of {self._lock_path} has no hard links ({reason}): its lock is a "
            "file that is made if none is there, which not every file server does in one step",
        )
        descriptor = os.open(self._lock_path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            with open(descriptor, "wb") as file:
                file.write(holder_json.encode())
                file.flush()
                os.fsync(descriptor)
        except OSError:
            self._lock_path.unlink(missing_ok=True)  # an incomplete lock would count as alive
            raise

    def send_heartbeat(self) -> None:
        """Update the modification time of the lock file, to show that the holder still runs."""
        os.utime(self._lock_path)

    def release(self) -> None:
        """Release the lock: delete its file."""
        self._lock_path.unlink(missing_ok=True)


def _read_lock_file(lock_path: Path) -> str | None:
    """Return the text of a lock file; None if it is missing."""
    try:
        descriptor = open_regular_file(lock_path, follow_links=False)
    except FileNotFoundError:
        return None
    with open(descriptor, "rb") as file:
        return file.read(LOCK_BYTES_MAX).decode("utf-8", "replace")


def _warn_once(say: Callable[[str], None], kind: str, warning: str) -> None:
    """Pass a warning to `say`, unless this process has already issued one of the same kind."""
    if kind not in _issued_warning_kinds:
        _issued_warning_kinds.add(kind)
        say(f"warning: {warning}")


class _ObjectStoreLock:
    """Lock of a store in an object store: an object with its holder and a count of heartbeats.

    This process writes the object only if no other process has changed it.
    """

    def __init__(self, lock_path: ObjectPath) -> None:
        self._lock_path = lock_path
        self._holder_json, self._n_heartbeats = "", 0
        self._tag: ObjectVersion | None = None

    def read_holder_json(self) -> str | None:
        """Return the JSON text that describes the lock's holder; None if the lock is free."""
        lock_object = self._read_lock_object()
        return (
            _holder_json_of_content(lock_object.content)
            if lock_object and lock_object.content
            else None
        )

    def _read_lock_object(self) -> VersionedContent | None:
        """Return content and version of the lock's object; None if it does not exist.

        Incomplete content is read once more, as it would be mistaken for another process's lock.
        ObjectStoreError is raised if the content is incomplete twice.
        """
        for _ in range(2):
            lock_object = self._lock_path.read_with_version()
            if (
                lock_object is None
                or lock_object.content.count(b"\n") == 2
                or not lock_object.content
            ):
                return lock_object
        if lock_object:
            self._lock_path.refuse_truncated_content(lock_object.content)
        return lock_object

    def heartbeat_version(self) -> object:
        """Return a value that changes with every heartbeat; None if there is no lock."""
        lock_object = self._read_lock_object()
        return lock_object and lock_object.content

    def acquire(
        self, holder_json: str, check_holder: Callable[[], None], say: Callable[[str], None]
    ) -> None:
        """Acquire the lock for the holder that a JSON text describes.

        `check_holder` must raise an error if the present holder lives. ObjectStoreError is raised
        if other processes were quicker `LOCK_ATTEMPTS_MAX` times.
        """
        for _ in range(LOCK_ATTEMPTS_MAX):
            lock_object = self._read_lock_object()
            if (
                lock_object and _holder_json_of_content(lock_object.content) == holder_json
            ):  # put, but the response was lost
                self._holder_json, self._tag = holder_json, lock_object.version
                return
            check_holder()
            if lock_object and lock_object.content:
                stale_json = _holder_json_of_content(lock_object.content)
                _log.debug(
                    "%s: taking over from %s", self._lock_path, escape_to_one_line(stale_json)
                )
            tag = self._lock_path.put_if_unchanged(
                f"{holder_json}\n0\n".encode(),
                lock_object.version if lock_object else None,
            )
            if tag is not None:
                self._holder_json, self._tag = holder_json, tag
                return
            _log.debug("%s: another process was quicker, trying again", self._lock_path)
        raise ObjectStoreError(11, "others are quicker to lock it: try again", str(self._lock_path))

    def send_heartbeat(self) -> None:
        """Increase the count of heartbeats in the lock, to show that the holder still runs."""
        self._replace_content(f"{self._holder_json}\n{self._n_heartbeats + 1}\n")
        self._n_heartbeats += 1

    def release(self) -> None:
        """Release the lock: make its object empty, if this process still holds the lock."""
        self._replace_content("")

    def _replace_content(self, content: str) -> None:
        """Write new content to the lock's object, if this process still holds the lock."""
        tag = self._lock_path.put_if_unchanged(content.encode(), self._tag)
        if tag is None:
            lock_object = self._read_lock_object()
            if lock_object and _holder_json_of_content(lock_object.content) == self._holder_json:
                tag = self._lock_path.put_if_unchanged(content.encode(), lock_object.version)
        if tag is not None:
            self._tag = tag


def _holder_json_of_content(content: bytes) -> str:
    """Return the first line of a lock object's content: the JSON text of the holder."""
    return content.decode("utf-8", "replace").partition("\n")[0]


def _lock_of_store(store_path: Location) -> _FileLock | _ObjectStoreLock:
    """Return the lock of a store, on disk or in an object store."""
    lock_path = store_path / JOURNAL_DIR / LOCK_FILE
    return (
        _ObjectStoreLock(lock_path) if isinstance(lock_path, ObjectPath) else _FileLock(lock_path)
    )


def wait_for_stale_lock(store_path: Location, say: Callable[[str], None]) -> None:
    """Wait until a lock, held by a process on another machine, is stale.

    A lock is stale if its last heartbeat is older than `HEARTBEAT_AGE_SECONDS_MAX`. The wait ends
    early if a new heartbeat arrives. A job that was killed, and soon restarted on another node, is
    thus not refused. ``say`` gets a message about the wait.
    """
    other_holder, heartbeat_version = (
        read_lock_holder(store_path),
        _lock_of_store(store_path).heartbeat_version(),
    )
    if (
        other_holder is None
        or other_holder.token in _released_tokens
        or _is_running_here(other_holder) is not None
    ):
        return
    seconds_left = HEARTBEAT_AGE_SECONDS_MAX - heartbeat_age(store_path)
    if 0 < seconds_left <= HEARTBEAT_AGE_SECONDS_MAX:
        _has_heartbeat_stopped(store_path, other_holder, heartbeat_version, seconds_left, say)


def _has_heartbeat_stopped(
    store_path: Location,
    other_holder: LockHolder,
    heartbeat_version: object,
    watch_seconds: float,
    say: Callable[[str], None],
) -> bool:
    """Watch a lock for up to `watch_seconds` [s]. Return True if its holder sends no heartbeat.

    `heartbeat_version` is the state of the heartbeat at the start. The result is False as soon as
    that state or the holder changes. The time is measured by this process's clock.
    """
    holder_text = f"process {other_holder.pid} on {escape_to_one_line(other_holder.host)}"
    _log.debug("%s: watching the heartbeat of %s", store_path, holder_text)
    say(
        f"waiting up to {watch_seconds:.0f} s to see whether {holder_text}, "
        f"which has locked {store_path}, still lives"
    )
    end_time, lock = time.monotonic() + watch_seconds, _lock_of_store(store_path)
    while (seconds_left := end_time - time.monotonic()) > 0:
        time.sleep(min(1.0, seconds_left, watch_seconds / 10))
        if (read_lock_holder(store_path), lock.heartbeat_version()) != (
            other_holder,
            heartbeat_version,
        ):
            _log.debug("%s: %s sent a heartbeat, or another took the lock", store_path, holder_text)
            return False
    _log.debug("%s: no heartbeat of %s in %.0f s", store_path, holder_text, watch_seconds)
    return True


class StoreLock:
    """Lock of a store. It is acquired on construction and updated regularly until it is released.

    StoreBusyError is raised if a living process holds the lock, and StoreError if the store can't
    be written. ``say`` gets messages for the user; by default they are warnings.
    """

    def __init__(self, store_path: Location, say: Callable[[str], None] = warnings.warn) -> None:
        self._store_path, self._lock, self._say = store_path, _lock_of_store(store_path), say
        self._own_holder = LockHolder.of_this_process()
        self._is_released = threading.Event()
        with raise_as_store_error(f"{store_path} can't be locked"):
            self._silent_state = self._watch_other_holder(say)
            self._lock.acquire(
                json.dumps(asdict(self._own_holder)), self._refuse_living_holder, say
            )
        _log.debug("%s: locked by this process, %s", store_path, self._own_holder.pid)
        self._heartbeat_thread = threading.Thread(
            target=self._send_heartbeats, name="lock-heartbeat", daemon=True
        )
        self._heartbeat_thread.start()

    def _watch_other_holder(self, say: Callable[[str], None]) -> object:
        """Watch the heartbeat of the lock's holder, if the holder is on another machine.

        Return the holder and the state of its heartbeat if no new heartbeat arrives. Return None if
        no process of another machine holds the lock. StoreBusyError is raised if the holder lives.
        """
        other_holder, heartbeat_version = (
            read_lock_holder(self._store_path),
            self._lock.heartbeat_version(),
        )
        if (
            other_holder is None
            or other_holder.token in _released_tokens
            or _is_running_here(other_holder) is not None
        ):
            return None
        is_doubtful = not 0 <= heartbeat_age(self._store_path) < HEARTBEAT_AGE_SECONDS_MAX
        if is_doubtful and _has_heartbeat_stopped(
            self._store_path, other_holder, heartbeat_version, HEARTBEAT_WATCH_SECONDS, say
        ):
            return other_holder, heartbeat_version
        raise self._make_busy_error(other_holder)

    def _refuse_living_holder(self) -> None:
        """Raise a StoreBusyError if another process, not known to be dead, holds the lock."""
        other_holder = read_lock_holder(self._store_path)
        if (
            other_holder is None
            or other_holder.token in _released_tokens
            or _is_running_here(other_holder) is False
        ):
            return
        if self._silent_state is None or self._silent_state != (
            other_holder,
            self._lock.heartbeat_version(),
        ):
            raise self._make_busy_error(other_holder)

    def _make_busy_error(self, other_holder: LockHolder) -> StoreBusyError:
        """Return an error whose message names the process that holds the lock."""
        holder_text = (
            f"process {escape_to_one_line(other_holder.pid)} on "
            f"{escape_to_one_line(other_holder.host)}"
        )
        return StoreBusyError(
            f"{self._store_path} is being written by {holder_text}: "
            f"wait for it, or stop it; {suggested_call('status', self._store_path)} shows how far "
            "it is"
        )

    def _send_heartbeats(self) -> None:
        """Send heartbeats at intervals until the lock is released."""
        while not self._is_released.wait(HEARTBEAT_INTERVAL_SECONDS):
            try:
                if self.is_held_by_this_process():
                    self._lock.send_heartbeat()
            except FileNotFoundError:
                pass  # the store was removed
            except OSError as error:
                with suppress(Warning):  # even if warnings raise, the next heartbeat may succeed
                    _warn_once(
                        self._say,
                        "heartbeat",
                        f"the heartbeat of the lock of {self._store_path} can't be written "
                        f"({os_error_reason(error, self._store_path)}): to other hosts this run "
                        f"seems dead after {HEARTBEAT_AGE_SECONDS_MAX:g} s, so start none of this "
                        "store there",
                    )

    def is_held_by_this_process(self) -> bool:
        """Return True if the lock still names this process as its holder."""
        current_holder = read_lock_holder(self._store_path)
        return current_holder is not None and current_holder.token == self._own_holder.token

    def __enter__(self) -> StoreLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """End the heartbeats, and release the lock if this process still holds it."""
        self._is_released.set()
        self._heartbeat_thread.join()
        _released_tokens.add(self._own_holder.token)
        with suppress(OSError):
            if self.is_held_by_this_process():
                self._lock.release()
                _log.debug("%s: lock released", self._store_path)
