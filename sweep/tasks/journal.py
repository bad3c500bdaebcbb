"""The journal of what is committed: one JSON line a block, written after its chunks.

A block is done when its receipt is in the log and its objects are in the store; what is not done is
computed again, to the same bytes. The log is only appended to, by the one driver that holds the
store's lock. A receipt whose chunks were later found damaged is withdrawn by a further line; a line
that does not match its own digest counts for nothing.

The recipe is what a store's own bytes do not say: where its study's files are, and which store it
extends.

Blocks that take long are computed in pieces. A worker draws for some seconds and saves what it has
in a file of the journal, with a digest; whoever takes up the block next goes on from there.

The lock says which driver writes to the store, and whether it still lives.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import io
import json
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

from sweep.documents import parse_json
from sweep.messages import SPEC, one_line, suggestion
from sweep.plain_files import UnfitFileError, open_plain
from sweep.storage.chunks import FILE_BYTES_MAX
from sweep.storage.locations import (
    HIDDEN,
    JOURNAL,
    REQUESTS,
    Location,
    ObjectPath,
    ObjectStoreError,
    Tag,
    process_start,
    put_whole,
    read_object,
    reason,
)
from sweep.storage.opening import (
    RECEIPTS,
    body_of,
    open_log,
    read_lines,
    read_receipts,
    read_sealed,
    sealed,
    unsealed,
)
from sweep.tasks.progress import BusyError, StoreError, told
from sweep.tasks.study import Found, Known, Study

FAILURES = "failures.jsonl"
SESSIONS = "sessions.jsonl"
LOGS = (RECEIPTS, FAILURES, SESSIONS)

RECIPE = "recipe.json"

#: The place of the store that points are taken from, while this one is extended from it.
EXTENDS = "extends"

#: Digests of the modules of the user's that it was begun with.
CODE = "code"

#: Id of the study whose store this one is to take the place of; empty where there is none.
REPLACES = "replaces"

#: Folders on disk that are listed at once: on a file server each is mostly waiting.
THREADS = 4


@dataclass(frozen=True, kw_only=True)
class Receipt:
    """Note of a worker on a block that it has written."""

    block: int
    points: int
    bytes: int  # as stored
    digest: str  # of the bytes stored, `opening.digest`
    seconds: float  # evaluating and writing
    write_seconds: float
    host: str
    pid: int
    versions: dict[str, str]
    taken: int = 0  # of its points, those that a smaller study's store had


@dataclass(frozen=True, kw_only=True)
class Failure:
    """Error of a block, and where it was met."""

    block: int
    error: str
    traceback: str
    host: str
    pid: int


class Journal:
    """Logs of a store, to append to; on opening, lines that are damaged or cut short are dropped.

    The caller holds the store's lock. A receipt of a `durable` one is on the disk once
    committed.
    """

    def __init__(self, store_path: Location, *, durable: bool = False) -> None:
        directory = store_path / JOURNAL
        self._logs = {name: open_log(directory / name, durable=durable) for name in LOGS}
        for log in self._logs.values():
            log.keep(lambda line: body_of(line) is not None)

    def commit(self, *receipts: Receipt) -> None:
        """Append receipts: their blocks are done; in an object store from the next `flush` on."""
        now = round(time.time(), 3)
        self._append(RECEIPTS, *({**asdict(receipt), "time": now} for receipt in receipts))

    def withdraw(self, block: int, why: str) -> None:
        """Take back the receipt of a block: from here on it is to be computed again."""
        self._append(RECEIPTS, {"block": block, "withdrawn": why, "time": round(time.time(), 3)})

    def flush(self, *, now: bool = False) -> bool:
        """Write what was gathered, if it is time to; True where nothing is left to write."""
        written = [log.flush(now=now) for log in self._logs.values()]
        return all(written)

    def record_failure(self, failure: Failure) -> None:
        """Append the error of a block that was given up."""
        self._append(FAILURES, asdict(failure))

    def record_session(self, event: str, **facts: Any) -> None:
        """Append what happened to a run: begun, ended, by whom and when; all else is written."""
        utc = datetime.now(UTC).isoformat(timespec="seconds")
        self._append(SESSIONS, {"event": event, "time": time.time(), "utc": utc, **facts})
        self.flush(now=True)

    def _append(self, name: str, *records: dict[str, Any]) -> None:
        """Append lines, whole or not at all; OSError where they can't be written."""
        if records:
            self._logs[name].append(b"".join(map(sealed, records)))


def digests(store_path: Location, n_blocks: int) -> np.ndarray:
    """Digests of the blocks that were committed, (blocks,) of bytes, empty where there is none."""
    found = np.zeros(n_blocks, dtype="S32")
    for record in read_lines(store_path / JOURNAL / RECEIPTS):
        if 0 <= record["block"] < n_blocks:
            found[record["block"]] = record.get("digest", "")  # none in a line that withdraws
    return found


def receipted(store_path: Location, study: Study) -> np.ndarray:
    """Blocks with a receipt, (blocks,) bool, whose chunks need not be there."""
    return read_receipts(store_path, study.n_blocks).points > 0


def committed(store_path: Location, study: Study) -> np.ndarray:
    """Blocks that are done, (blocks,) bool: with a receipt, and every object in the store."""
    return listed(store_path, study, receipted(store_path, study))


def given_up(store_path: Location, n_blocks: int) -> dict[int, dict[str, Any]]:
    """Last failure of each block that was given up and never done since."""
    found = {record["block"]: record for record in read_lines(store_path / JOURNAL / FAILURES)}
    if found:
        for record in read_lines(store_path / JOURNAL / RECEIPTS):
            found.pop(record["block"], None)
    return {block: failure for block, failure in found.items() if block < n_blocks}


def last_begun(store_path: Location) -> float:
    """Time at which the last run began [s since the epoch]; infinite where there was none."""
    runs = read_lines(store_path / JOURNAL / SESSIONS)
    times = [run["time"] for run in runs if run.get("event") == "begun"]
    return float(times[-1]) if times else np.inf


def write_recipe(store_path: Location, **facts: Any) -> None:
    """Put down where a study's files are, in one step."""
    put_whole(store_path / JOURNAL / RECIPE, sealed(facts))


def read_recipe(store_path: Location) -> dict[str, Any]:
    """Facts that were put down; empty where nothing was, or where it is damaged."""
    records = [record for _, record in read_sealed(store_path / JOURNAL / RECIPE)]
    return records[0] or {} if len(records) == 1 else {}


def forget_older(store_path: Path) -> None:
    """Take away which store a study's extends and replaces."""
    facts = read_recipe(store_path)
    for name in (EXTENDS, REPLACES):
        facts.pop(name, None)
    if facts:
        write_recipe(store_path, **facts)
    else:
        (store_path / JOURNAL / RECIPE).unlink(missing_ok=True)


def refuse_damaged_recipe(store_path: Location) -> None:
    """Refuse a store that no longer says where the files of its study are."""
    path = store_path / JOURNAL / RECIPE
    if any(record is None for _, record in read_sealed(path)):
        raise StoreError(
            f"{path} is damaged, and with it where the files of the study are: "
            f"{suggestion('resume', store_path, spec=SPEC)} puts it down anew"
        )


class Look:
    """A look at the chunks of blocks that are marked, (blocks,) bool, begun as it is made."""

    def __init__(self, path: Location, study: Study, among: np.ndarray) -> None:
        self._among, self._stopped = among.copy(), False
        threads = REQUESTS if isinstance(path, ObjectPath) else THREADS
        self._threads = ThreadPoolExecutor(threads, thread_name_prefix="look")

        def lacking(name: str, owner: np.ndarray) -> np.ndarray:
            """Blocks that lack their chunk of an array."""
            if self._stopped:
                return np.empty(0, np.int64)
            there = chunks_there(path / name / "c", owner.shape)
            return owner[~there & self._among[owner]]

        owners = study.owners() if among.any() else {}
        self._arrays = [self._threads.submit(lacking, *array) for array in owners.items()]

    def within(self, seconds: float | None = None) -> bool:
        """Tell whether the look is over, waited for no longer than that."""
        return not wait(self._arrays, seconds).not_done

    def whole(self) -> np.ndarray:
        """Blocks that lack nothing as far as was looked, (blocks,) bool; OSError if unreadable."""
        found = self._among.copy()
        for array in self._arrays:
            if array.done():
                found[array.result()] = False
        return found

    def stop(self) -> None:
        """Look no further."""
        self._stopped = True
        self._threads.shutdown(wait=False)


def listed(path: Location, study: Study, among: np.ndarray) -> np.ndarray:
    """Blocks, among some, that have every object in the store, and bytes in it, (blocks,) bool."""
    look = Look(path, study, among)
    try:
        look.within()
        return look.whole()
    finally:
        look.stop()


def chunks_there(folder: Location, shape: tuple[int, ...]) -> np.ndarray:
    """Chunks of an array that are there and hold something, bool in the shape of its grid."""
    there = np.zeros(shape, bool)
    if isinstance(folder, ObjectPath):
        for position, size in _keys(folder, shape):
            there[position] = size > 0
    elif shape:
        _look(folder, there)
    else:
        with suppress(FileNotFoundError):
            there[()] = _is_chunk(folder.lstat())
    return there


def _is_chunk(found: os.stat_result) -> bool:
    """Tell whether a path is a file with something in it, and no directory."""
    return stat.S_ISREG(found.st_mode) and found.st_size > 0


def _keys(folder: ObjectPath, shape: tuple[int, ...]) -> Iterator[tuple[tuple[int, ...], int]]:
    if not shape:
        yield (), max(0, folder.size())
        return
    for key, size in folder.below():
        words = key.split("/")
        if len(words) == len(shape) and all(map(str.isdecimal, words)):
            position = tuple(map(int, words))
            if all(at < n for at, n in zip(position, shape, strict=True)):
                yield position, size


def _look(folder: Path | str, there: np.ndarray, within: int | None = None) -> None:
    """Note the chunks in a folder and below, (positions,) bool; it is in an open one."""
    try:
        # no links: what they lead to is no part of the store
        opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=within)
    except (FileNotFoundError, NotADirectoryError):
        return
    try:
        with os.scandir(opened) as entries:
            for entry in entries:
                name = entry.name
                if not name.isdecimal() or (at := int(name)) >= len(there):
                    continue
                if there.ndim > 1:
                    _look(name, there[at], opened)
                else:
                    there[at] = _is_chunk(entry.stat(follow_symlinks=False))
    finally:
        os.close(opened)


#: Beginning of the names of files in the journal, each of one block.
BEGUN = "begun-"


class Begun(NamedTuple):
    """The saved part of a block."""

    known: Known = Known()
    points: float = 0.0  # that this comes to; a point that is drawn in part counts in part
    seconds: float = 0.0  # spent on it


def write_begun(path: Location, study_id: str, block: int, begun: Begun) -> None:
    """Save what there is of a block, in the place of less; OSError where it can't be written."""
    if read_begun(path, study_id, block).points >= begun.points:
        return  # another worker, that was thought to be lost, was quicker
    buffer = io.BytesIO()
    np.savez(buffer, **dict(_arrays(begun.known)))
    content = buffer.getvalue()
    head = {
        "study": study_id, "block": block, "points": begun.points, "seconds": begun.seconds,
        "digest": _digest(content),
    }  # fmt: skip
    put_whole(_begun_file(path, block), sealed(head) + content)


def read_begun(path: Location, study_id: str, block: int) -> Begun:
    """Return the saved part of a block of a study."""
    try:
        saved = read_object(path, f"{JOURNAL}/{BEGUN}{block}", FILE_BYTES_MAX)
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError, UnfitFileError):
        return Begun()
    line, _, content = saved.partition(b"\n")
    head = unsealed(line + b"\n") or {}
    if (head.get("study"), head.get("block")) != (study_id, block):
        return Begun()
    if head["digest"] != _digest(content):
        return Begun()
    found: dict[str, dict[str, np.ndarray]] = {"done": {}, "begun": {}}
    try:
        for key, values in _unpacked(content):
            part, _, name = key.partition("/")
            found[part][name] = values
    except (ValueError, KeyError, zipfile.BadZipFile):  # a stranger's, with a digest of its own
        return Begun()
    known = Known(**{part: Found(each.pop("points"), each) for part, each in found.items()})
    return Begun(known, head["points"], head["seconds"])


def _unpacked(content: bytes) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays that `numpy.savez` packed, by name; ValueError where they are of other sizes."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for member in archive.infolist():
            if member.compress_type != zipfile.ZIP_STORED or member.file_size > len(content):
                raise ValueError("packed otherwise than numpy.savez packs")
            packed = io.BytesIO(archive.read(member))
            version = np.lib.format.read_magic(packed)
            read_header = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }[version]
            shape, _, dtype = read_header(packed)
            # before numpy makes room for what the header declares
            if math.prod(shape) * dtype.itemsize != member.file_size - packed.tell():
                raise ValueError("its header declares another size")
            packed.seek(0)
            yield member.filename.removesuffix(".npy"), np.load(packed, allow_pickle=False)


def begun_points(path: Location, study_id: str) -> dict[int, float]:
    """Points that there are, in part, of blocks that are begun."""
    numbers = [file.name.removeprefix(BEGUN) for file in (path / JOURNAL).glob(f"{BEGUN}*")]
    found = {
        int(each): read_begun(path, study_id, int(each)) for each in numbers if each.isdecimal()
    }
    return {block: begun.points for block, begun in found.items() if begun.points}


def discard_begun(path: Location, block: int | str = "*") -> None:
    """Remove what there is of a block, or of all."""
    for file in (path / JOURNAL).glob(f"{BEGUN}{block}"):
        file.unlink(missing_ok=True)


def _begun_file(path: Location, block: int) -> Location:
    return path / JOURNAL / f"{BEGUN}{block}"


def _arrays(known: Known) -> dict[str, Any]:
    return {
        f"{part}/{name}": values
        for part, (points, results) in known._asdict().items()
        for name, values in {"points": points, **results}.items()
    }


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=16).hexdigest()


LOCK = "lock"

#: Tries at a lock in an object store that others try for, too.
TRIES = 5

#: Seconds between heartbeats, and how old one may be before a holder on another host is doubted.
HEARTBEAT = 10.0
EXPIRY = 120.0

#: Seconds for which the heartbeat of such a holder is watched before it is held for dead. Its age
#: alone may come from a clock that was set; that it does not change can't.
WATCH = 35.0

#: Bytes of a lock at most.
LOCK_BYTES_MAX = 1 << 16

#: Errors of file systems that have no flock (Lustre without it, some NFS), or no hard links (FUSE,
#: SMB, exFAT; a file system of several disks may say that the link leads to another one).
NO_FLOCK = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
NO_LINK = {errno.EPERM, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EXDEV, errno.EMLINK}

_left: set[str] = set()
"""Tokens of locks that this process has given up, which a store out of reach may not know."""

_warned: set[str] = set()
"""Kinds of warnings about locks that this process has given: a study may have many locks."""


@dataclass(frozen=True, kw_only=True)
class Holder:
    """Holder of a lock."""

    host: str = "unknown"
    pid: int = 0
    start: int = 0  # of the process, as `process_start` has it: a number is used again
    token: str = ""
    machine: str = ""  # hosts of one name may be many, where a store is seen from everywhere

    @classmethod
    def myself(cls) -> Holder:
        """Return the running process, with a token of its own."""
        pid = os.getpid()
        return cls(
            host=socket.gethostname(),
            pid=pid,
            start=process_start(pid),
            token=uuid.uuid4().hex,
            machine=_machine(),
        )

    @property
    def is_here(self) -> bool:
        """Tell whether its process is one of this machine, if it still runs."""
        return self.host == socket.gethostname() and self.machine in ("", _machine())


@cache
def _machine() -> str:
    """Boot and namespace in which a process number has a meaning."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def holder(store_path: Location) -> Holder | None:
    """Holder of the lock of a store, living or dead; None where nobody does."""
    text = _claim(store_path).read()
    return None if text is None else _parsed(text)


def _parsed(text: str) -> Holder:
    """Holder that a lock names; one that is damaged, or of another version, as far as it does."""
    try:
        record = parse_json(text)
    except ValueError:
        return Holder()
    types = {field.name: type(field.default) for field in fields(Holder)}
    facts: dict[str, Any] = {}
    if isinstance(record, dict):
        facts = {name: v for name, v in record.items() if type(v) is types.get(name)}
    return Holder(**facts)


def is_live(store_path: Location, who: Holder) -> bool:
    """Tell whether the holder of a lock runs: its process here, its heartbeat elsewhere."""
    if (runs := _runs_here(who)) is not None:
        return runs
    return heartbeat_age(store_path) < EXPIRY


def _runs_here(who: Holder) -> bool | None:
    """Tell whether a holder of this machine runs; None of others, and where it can't be seen."""
    if not (who.is_here and who.start):
        return None
    start = process_start(who.pid)
    return None if start == HIDDEN else start == who.start


def heartbeat_age(store_path: Location) -> float:
    """Age of a lock's last heartbeat [s], by the file system's clock; infinite without one."""
    path = store_path / JOURNAL / LOCK
    probe = path.with_name(f"clock-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    now: float | None = None
    try:
        probe.write_bytes(b"clock")
        now = _modified(probe)
    except OSError:
        pass  # a reader of a store that it can't write to
    finally:
        with suppress(OSError):
            probe.unlink()
    beaten = _modified(path)
    return float("inf") if beaten is None else (now or time.time()) - beaten


def _modified(path: Location) -> float | None:
    if isinstance(path, ObjectPath):
        return path.modified()
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return None


class _FileClaim:
    """A lock as a file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> str | None:
        """Text of its holder; None where nobody holds it."""
        return _text_of(self._path)

    def mark(self) -> object:
        """Mark of the last heartbeat, another one after each."""
        try:
            opened = open_plain(self._path, follow=False)  # opened: a file server is asked anew
        except FileNotFoundError:
            return None
        try:
            status = os.fstat(opened)
        finally:
            os.close(opened)
        return status.st_ino, status.st_mtime_ns

    def take(self, text: str, judge: Callable[[], None], say: Callable[[str], None]) -> None:
        """Take it, unless `judge`, asked while no other process judges, raises."""
        self._path.parent.mkdir(exist_ok=True)
        with self._guard(say):  # one process at a time judges and takes
            before = self.read()
            judge()
            self._put_aside(before)
            mine = self._path.with_name(f"lock.{uuid.uuid4().hex}")
            put_whole(mine, text.encode())  # an empty lock, after a power cut, would look alive
            try:
                self._put(mine, text, say)
            except FileExistsError:
                if self.read() != text:  # a file server may have done it, and lost its answer
                    raise BusyError(f"another process was quicker to lock {self._path}") from None
            finally:
                mine.unlink(missing_ok=True)

    @contextmanager
    def _guard(self, say: Callable[[str], None]) -> Iterator[None]:
        """Keep others from judging, where the file system has such locks."""
        file = self._path.with_name("lock.guard")
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        guard = os.open(file, flags, 0o666)
        try:
            if not stat.S_ISREG(os.fstat(guard).st_mode):
                raise UnfitFileError(errno.EINVAL, "is no plain file", str(file))
            try:
                fcntl.flock(guard, fcntl.LOCK_EX)
            except OSError as error:
                if error.errno not in NO_FLOCK:
                    raise
                _say_once(
                    say,
                    "flock",
                    f"the file system of {self._path} has no flock ({error.strerror}): start no "
                    "two runs of one store within the same second",
                )
            yield
        finally:
            os.close(guard)

    def _put_aside(self, before: str | None) -> None:
        """Take the lock of a dead holder away, and no other, where nothing keeps others out."""
        if before is None:
            return
        aside = self._path.with_name(f"lock.{uuid.uuid4().hex}")
        with suppress(FileNotFoundError):
            os.rename(self._path, aside)
            if _text_of(aside) != before:  # somebody was quicker
                try:
                    os.link(aside, self._path)
                except OSError:
                    if not self._path.exists():
                        os.rename(aside, self._path)
            aside.unlink()

    def _put(self, mine: Path, text: str, say: Callable[[str], None]) -> None:
        """Put the lock in its place; FileExistsError where somebody was quicker."""
        try:
            os.link(mine, self._path)  # fails where somebody was quicker, on NFS too
            return
        except OSError as error:
            if error.errno not in NO_LINK:
                raise
            why = error.strerror
        _say_once(
            say,
            "links",
            f"the file system of {self._path} has no hard links ({why}): its lock is a file that "
            "is made if none is there, which not every file server does in one step",
        )
        opened = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            with open(opened, "wb") as file:
                file.write(text.encode())
                file.flush()
                os.fsync(opened)
        except OSError:
            self._path.unlink(missing_ok=True)  # part of a lock would look alive
            raise

    def beat(self) -> None:
        """Say that the holder lives."""
        os.utime(self._path)

    def leave(self) -> None:
        """Give it up."""
        self._path.unlink(missing_ok=True)


def _text_of(path: Path) -> str | None:
    try:
        opened = open_plain(path, follow=False)
    except FileNotFoundError:
        return None
    with open(opened, "rb") as file:
        return file.read(LOCK_BYTES_MAX).decode("utf-8", "replace")


def _say_once(say: Callable[[str], None], kind: str, warning: str) -> None:
    """Give the first warning of a kind in this process."""
    if kind not in _warned:
        _warned.add(kind)
        say(f"warning: {warning}")


class _ObjectClaim:
    """A lock as an object, changed by conditional puts: its holder, and a count of heartbeats."""

    def __init__(self, path: ObjectPath) -> None:
        self._path = path
        self._text, self._beats = "", 0
        self._tag: Tag | None = None

    def read(self) -> str | None:
        """Text of its holder; None where nobody holds it."""
        found = self._read_tagged()
        return _first_line(found[0]) if found and found[0] else None

    def _read_tagged(self) -> tuple[bytes, Tag] | None:
        """Return the lock and its tag, read once more if cut; ObjectStoreError if cut twice.

        Part of a lock would look like a stranger's.
        """
        for _ in range(2):
            tagged = self._path.read_tagged()
            if tagged is None or tagged[0].count(b"\n") == 2 or not tagged[0]:
                return tagged
        if tagged:
            self._path.refuse_cut(tagged[0])
        return tagged

    def mark(self) -> object:
        """Mark of the last heartbeat, another one after each."""
        tagged = self._read_tagged()
        return tagged and tagged[0]

    def take(self, text: str, judge: Callable[[], None], say: Callable[[str], None]) -> None:
        """Take it, unless `judge` raises."""
        for _ in range(TRIES):
            found = self._read_tagged()
            if found and _first_line(found[0]) == text:  # put, though its answer was lost
                self._text, self._tag = text, found[1]
                return
            judge()
            tag = self._path.put_if(f"{text}\n0\n".encode(), found[1] if found else None)
            if tag is not None:
                self._text, self._tag = text, tag
                return
        raise ObjectStoreError(11, "others are quicker to lock it: try again", str(self._path))

    def beat(self) -> None:
        """Say that the holder lives."""
        self._change(f"{self._text}\n{self._beats + 1}\n")
        self._beats += 1

    def leave(self) -> None:
        """Give it up."""
        self._change("")

    def _change(self, text: str) -> None:
        """Put something in the place of what was last put; of what is there, where that is ours."""
        tag = self._path.put_if(text.encode(), self._tag)
        if tag is None:
            found = self._read_tagged()
            if found and _first_line(found[0]) == self._text:
                tag = self._path.put_if(text.encode(), found[1])
        if tag is not None:
            self._tag = tag


def _first_line(content: bytes) -> str:
    return content.decode("utf-8", "replace").partition("\n")[0]


def _claim(store_path: Location) -> _FileClaim | _ObjectClaim:
    path = store_path / JOURNAL / LOCK
    return _ObjectClaim(path) if isinstance(path, ObjectPath) else _FileClaim(path)


def wait_for_silence(store_path: Location, say: Callable[[str], None]) -> None:
    """Wait until the last heartbeat of a holder elsewhere is old, or another one comes.

    So a job that is started again on another node, soon after it was killed, need not be refused.
    """
    other, mark = holder(store_path), _claim(store_path).mark()
    if other is None or other.token in _left or _runs_here(other) is not None:
        return
    left = EXPIRY - heartbeat_age(store_path)
    if 0 < left <= EXPIRY:
        _is_silent(store_path, other, mark, left, say)


def _is_silent(
    store_path: Location, other: Holder, mark: object, seconds: float, say: Callable[[str], None]
) -> bool:
    """Watch a lock for some time by this process's own clock; tell whether it stayed as it was."""
    who = f"process {other.pid} on {one_line(other.host)}"
    say(
        f"waiting up to {seconds:.0f} s to see whether {who}, "
        f"which has locked {store_path}, still lives"
    )
    end, claim = time.monotonic() + seconds, _claim(store_path)
    while (left := end - time.monotonic()) > 0:
        time.sleep(min(1.0, left, seconds / 10))
        if (holder(store_path), claim.mark()) != (other, mark):
            return False
    return True


class Lock:
    """A store's lock, held and kept alive until released.

    BusyError where a living driver holds it, StoreError where the store can't be written. ``say``
    is told what a user should know: by default it warns.
    """

    def __init__(self, store_path: Location, say: Callable[[str], None] = warnings.warn) -> None:
        self._store, self._claim, self._say = store_path, _claim(store_path), say
        self._me = Holder.myself()
        self._released = threading.Event()
        with told(f"{store_path} can't be locked"):
            self._silent = self._watch(say)
            self._claim.take(json.dumps(asdict(self._me)), self._refuse_a_living_one, say)
        self._beating = threading.Thread(target=self._beat, name="lock-heartbeat", daemon=True)
        self._beating.start()

    def _watch(self, say: Callable[[str], None]) -> object:
        """Watch the heartbeat of a holder elsewhere; return what its lock was, if it is silent."""
        other, mark = holder(self._store), self._claim.mark()
        if other is None or other.token in _left or _runs_here(other) is not None:
            return None
        is_doubtful = not 0 <= heartbeat_age(self._store) < EXPIRY
        if is_doubtful and _is_silent(self._store, other, mark, WATCH, say):
            return other, mark
        raise self._busy(other)

    def _refuse_a_living_one(self) -> None:
        other = holder(self._store)
        if other is None or other.token in _left or _runs_here(other) is False:
            return
        if self._silent is None or self._silent != (other, self._claim.mark()):
            raise self._busy(other)

    def _busy(self, other: Holder) -> BusyError:
        who = f"process {one_line(other.pid)} on {one_line(other.host)}"
        return BusyError(
            f"{self._store} is being written by {who}: "
            f"wait for it, or stop it; {suggestion('status', self._store)} shows how far it is"
        )

    def _beat(self) -> None:
        while not self._released.wait(HEARTBEAT):
            try:
                if self.is_mine():
                    self._claim.beat()
            except FileNotFoundError:
                pass  # the store was taken away
            except OSError as error:
                with suppress(Warning):  # that is to be an error: the next heartbeat may succeed
                    _say_once(
                        self._say,
                        "heartbeat",
                        f"the heartbeat of the lock of {self._store} can't be written "
                        f"({reason(error, self._store)}): to other hosts this run looks dead after "
                        f"{EXPIRY:g} s, so start none of this store there",
                    )

    def is_mine(self) -> bool:
        """Tell whether the lock is still this driver's."""
        who = holder(self._store)
        return who is not None and who.token == self._me.token

    def __enter__(self) -> Lock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Give the lock up, if it is still ours."""
        self._released.set()
        self._beating.join()
        _left.add(self._me.token)
        with suppress(OSError):
            if self.is_mine():
                self._claim.leave()
