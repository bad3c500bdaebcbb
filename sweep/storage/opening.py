"""Stores, and the logs of their journals, read only as this program writes them.

Zarr decodes whatever the metadata of arrays declare, objects to unpickle and codecs of plug-ins
too. The document of a store's root has the metadata of all its arrays: it is checked first, and
arrays are opened by it alone.

A log has lines of JSON with their own digests at the end. It is a file that is appended to; in an
object store it is a row of numbered objects, each written whole, with the lines of some seconds.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import re
import stat
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from zarr.storage import StorePath

from sweep.documents import parse_json
from sweep.messages import SPEC, STORE, PrintableError, one_line, suggestion
from sweep.plain_files import UnfitFileError, kind_of, open_plain, pieces_below
from sweep.storage.chunks import (
    DOCUMENT_BYTES_MAX,
    FILE_BYTES_MAX,
    CheckedFiles,
    CheckedObjects,
    StoreFiles,
)
from sweep.storage.locations import (
    JOURNAL,
    REQUESTS,
    Location,
    ObjectPath,
    ObjectStoreError,
    each,
    put_whole,
    read_object,
    settle,
    stamp,
)

#: What a store is made of before there are results, and the digest of each object, in the journal.
MANIFEST = "template.jsonl"

#: Version of the layout of stores.
LAYOUT = 5

#: How chunks of every array are compressed.
ZSTD_LEVEL = 1

#: For xarray's functions: so they read the document that was checked, and no other.
CHECKED: dict[str, Any] = {"consolidated": True, "zarr_format": 3}

#: Bytes of a file of an array at most, before compression, and chunks of an array.
MOST_BYTES = MOST_CHUNKS = 2**31

_KINDS = {
    "grid": ("title", "spec", "coordinates"),
    "scene": ("title", "spec", "scanners", "surfaces"),
    "eyepoints": ("geometry", "shots_a_cycle"),
    "accuracy": ("title", "spec", "coordinates"),
}
"""Attributes of each kind of store, besides those of all."""

_REQUIRED = ("study_id", "model_version", "software")

_STUDY_ID = re.compile(r"[0-9a-f]{32}")

_NOT_TEXT = {"shots_a_cycle": int, "scanners": list, "surfaces": list}

_ARRAY_ATTRIBUTES = {
    "units": str, "long_name": str, "comment": str, "standard_name": str, "path": str,
    "flag_meanings": str, "flag_masks": list, "flag_values": list, "tolerance": float,
    "confidence": float,
}  # fmt: skip
"""Attributes of arrays. xarray acts on others, such as `scale_factor`."""

_FILLS: dict[str, tuple[Any, ...]] = {
    "float64": (0.0, "NaN"), "int64": (0, -1), "int32": (0, -1), "int16": (0, -1), "int8": (0, -1),
    "uint32": (0,), "uint8": (0,), "bool": (False,), "string": ("",),
}  # fmt: skip
"""Types of arrays, and what stands where nothing is written."""

MAP = "scene_map"
"""Group of the map of a flight's ground."""

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}")

_CHECKSUM = {"name": "crc32c"}
_PACKED = [{"name": "zstd", "configuration": {"level": ZSTD_LEVEL, "checksum": False}}, _CHECKSUM]
_TEXT = {"name": "vlen-utf8", "configuration": {}}
_BYTES = {"name": "bytes"}
_WORDS = {"name": "bytes", "configuration": {"endian": "little"}}
_SHARDS = {"index_codecs": [_WORDS, _CHECKSUM], "index_location": "end"}


class StoreError(PrintableError):
    """A store that can't be used as asked."""


class NotAStoreError(StoreError, ValueError):
    """A path at which there is no store of a study, or none that this program can read."""


def read_attributes(path: Location) -> dict[str, Any]:
    """Attributes of a store; raises as :func:`read_document`."""
    attributes: dict[str, Any] = read_document(path)["attributes"]
    return attributes


def read_document(path: Location) -> dict[str, Any]:
    """Read the document of a store's root, checked; NotAStoreError for what is not as ours."""
    document = _document(path)
    attributes = recognised(path, document["attributes"])
    try:
        consolidated = document["consolidated_metadata"]
        nodes = consolidated["metadata"]
        kinds = document["zarr_format"], document["node_type"], consolidated["kind"]
        if kinds != (3, "group", "inline"):
            raise ValueError("its root is another")
        for name, node in nodes.items():
            _check_node(name, node)
        _check_dimensions(nodes)
        of_scanners = [f"{name}/flags" for name in attributes.get("scanners", ())]
        needed = ["effects"] if attributes["kind"] == "grid" else of_scanners
        if lost := [name for name in needed if name not in nodes]:
            raise ValueError(f"it lacks {lost[0]}")
    except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        why = error if type(error) is ValueError else "its metadata are incomplete"
        raise NotAStoreError(f"{path} is not as sweep writes stores: {why}{remedy(path)}") from None
    _check_files(path)
    return document


def recognised(path: Location, attributes: Any) -> dict[str, Any]:
    """Attributes of a store, where this version of the program writes such; or NotAStoreError."""
    ours = _ours(path, attributes)
    if (layout := ours.get("layout")) != LAYOUT:
        raise NotAStoreError(
            f"{path} is laid out as version {layout!r:.20}; this sweep writes {LAYOUT}"
        )
    needed = (*_REQUIRED, *_KINDS.get(str(ours.get("kind")), ("no known kind",)))
    text = ours | {"software": versions_text(ours.get("software"))}
    if any(type(text.get(name)) is not _NOT_TEXT.get(name, str) for name in needed):
        raise NotAStoreError(f"{path} is a Zarr store, but not one that sweep made")
    if not _STUDY_ID.fullmatch(ours["study_id"]):
        why = f"its study_id is {ours['study_id'][:40]!r}, and no digest"
        raise NotAStoreError(f"{path} is not as sweep writes stores: {why}{remedy(path)}")
    return ours


def versions_text(software: Any) -> Any:
    """Return versions by name as text, ``numba 0.60, numpy 2.1``; anything but a mapping as it is.

    Attributes that are text, numbers or lists of these go into any file format. Stores of earlier
    versions have mappings.
    """
    if not isinstance(software, dict):
        return software
    return ", ".join(f"{name} {version}" for name, version in software.items())


def software_versions(attributes: Mapping[Any, Any]) -> dict[str, str]:
    """Return the versions of the software that a store was begun with, by name."""
    text = str(versions_text(attributes["software"]))
    return dict(part.rsplit(" ", 1) for part in text.split(", ") if " " in part)


def refuse_foreign(path: Location) -> None:
    """Refuse what no version of this program has made."""
    _ours(path, _document(path)["attributes"])


def _ours(path: Location, attributes: Any) -> dict[str, Any]:
    if not isinstance(attributes, dict) or "study_id" not in attributes:
        raise NotAStoreError(f"{path} is a Zarr store, but not one that sweep made{_near(path)}")
    return attributes


def _document(path: Location) -> dict[str, Any]:
    """Read the document of a store's root, a group."""
    settle(path)
    why = ""
    try:
        document = _parsed(path, "zarr.json")
        if "attributes" in document:
            return dict(document)
    except ObjectStoreError:
        raise
    except UnfitFileError as error:
        why = f" ({error.strerror})"
    except (OSError, ValueError, KeyError, TypeError):
        pass
    if not path.exists():
        raise NotAStoreError(f"there is no store at {path}{_near(path)}")
    if how := remedy(path):
        raise NotAStoreError(f"{path / 'zarr.json'} is damaged{why}{how}")
    if why:
        raise NotAStoreError(f"{path / 'zarr.json'} is damaged{why}")
    if isinstance(path, Path) and path.is_file():
        run = suggestion("run", SPEC, store=STORE)
        what = f"a file, and no Zarr store of sweep's: {run} computes a spec into one"
        raise NotAStoreError(f"{path} is {what}{_near(path)}")
    run = suggestion("run", SPEC, store=STORE)
    what = "is not a Zarr store of sweep's"
    if names := _first_names(path):
        raise NotAStoreError(
            f"{path} {what}, and has files in it ({names}): name another place, as {run} computes "
            f"a spec into a new or an empty folder{_near(path)}"
        )
    raise NotAStoreError(f"{path} {what}: {run} computes a spec into one{_near(path)}")


_NAMES_SHOWN = 3


def _first_names(path: Location) -> str:
    """Names of the first files and folders in a folder; '' for none."""
    if not isinstance(path, Path) or not path.is_dir():
        return ""
    with suppress(OSError), os.scandir(path) as entries:
        names = sorted(entry.name for entry in islice(entries, _NAMES_SHOWN + 1))
        shown = ", ".join(one_line(name) for name in names[:_NAMES_SHOWN])
        return f"{shown}, ..." if len(names) > _NAMES_SHOWN else shown
    return ""


def _parsed(path: Location, name: str) -> Any:
    """Parse a document; once more from an object store, whose answer may have been cut."""
    try:
        return parse_json(read_object(path, name, DOCUMENT_BYTES_MAX))
    except ValueError:
        if isinstance(path, Path):
            raise
        return parse_json(read_object(path, name, DOCUMENT_BYTES_MAX))


def has_digest(
    path: Location,
    objects: list[str],
    known: str,
    bytes_max: Callable[[str], int] = lambda name: FILE_BYTES_MAX,
) -> bool:
    """Tell whether stored objects have a digest; read once more from an object store if not.

    Errors, and ``bytes_max``, are as of :func:`digest`.
    """
    is_same = digest(path, objects, bytes_max) == known
    return is_same or (isinstance(path, ObjectPath) and digest(path, objects, bytes_max) == known)


def listed_attributes(path: Location) -> dict[str, Any]:
    """Attributes of a store by the list of what it was made of; empty where that is damaged."""
    found: dict[str, Any] = next(read_lines(path / JOURNAL / MANIFEST), {}).get("attributes", {})
    return found


def study_id(path: Location) -> str:
    """Id of the study in a store of any version, damaged or not; empty where there is none."""
    try:
        return str(_ours(path, _document(path)["attributes"])["study_id"])
    except NotAStoreError:
        return str(listed_attributes(path).get("study_id", ""))


def remedy(path: Location) -> str:
    """Remark on how to put back what a store was made of, where it says what that was."""
    if not (path / JOURNAL / MANIFEST).exists():
        return ""
    if listed_attributes(path):
        return f": {suggestion('verify', path, repair=True)} puts it back"
    how = suggestion("verify", path, repair=True, spec=SPEC)
    return f": {how}, with the study's spec, puts it back"


def _near(path: Location) -> str:
    """Remark on the stores in a directory or beside a path; empty where there are none."""
    directory = path if path.is_dir() else path.parent
    found = directory.glob("*.zarr/zarr.json") if directory.is_dir() else ()
    names = sorted(str(document.parent) for document in found)
    shown = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
    return f"; stores near it: {shown}" if names else ""


def _check_node(path: str, node: dict[str, Any]) -> None:
    """Refuse a group or an array that is declared otherwise than this program declares them."""
    if not all(map(_NAME.fullmatch, path.split("/"))):
        raise ValueError(f"an array has the name {path!r:.60}")
    if node["zarr_format"] != 3:
        raise ValueError(f"{path} is of the Zarr format {node['zarr_format']!r:.20}")
    if node["node_type"] == "group":
        own = node["attributes"]
        if path != MAP:
            if not re.fullmatch("[0-9a-f]{32}", own["geometry_id"]):  # part of a path
                raise ValueError(f"the group {path} has no eyepoints")
            own["coordinates"].split()
        expected = {"node_type": "group", "zarr_format": 3, "attributes": own}
    else:
        expected = _expected(path, node)
    if odd := sorted(key for key in node | expected if node.get(key) != expected.get(key)):
        raise ValueError(f"the {odd[0]} of {path} is another")


def _expected(path: str, node: dict[str, Any]) -> dict[str, Any]:
    """Metadata of an array as this program writes them, with what may differ, once checked."""
    kind, attributes, fill = node["data_type"], node["attributes"], node["fill_value"]
    if not isinstance(kind, str) or fill not in _FILLS.get(kind, ()):
        raise ValueError(f"{path} has values of the type {kind!r:.40}, {fill!r:.40} where missing")
    for name, value in attributes.items():
        if type(value) is not _ARRAY_ATTRIBUTES.get(name):
            raise ValueError(f"{path} has the attribute {name!r:.40}")
    file = node["chunk_grid"]["configuration"]["chunk_shape"]
    size = np.dtype("u1" if kind == "string" else kind).itemsize
    codecs: list[Any] = [_WORDS if size > 1 else _BYTES, *_PACKED]
    if kind == "string":
        codecs[0] = _TEXT
    chunk = file
    if node["codecs"][0]["name"] == "sharding_indexed":
        chunk = node["codecs"][0]["configuration"]["chunk_shape"]
        shards = {"chunk_shape": chunk, "codecs": codecs, **_SHARDS}
        codecs = [{"name": "sharding_indexed", "configuration": shards}]
    dims = node.get("dimension_names", [])
    _check_shape(path, node["shape"], file, chunk, dims, size)
    return {
        "shape": node["shape"],
        "data_type": kind,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": file}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": fill,
        "codecs": codecs,
        "attributes": attributes,
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
        **({"dimension_names": dims} if dims else {}),
    }


def _check_shape(
    path: str, shape: list[int], file: list[int], chunk: list[int], dims: list[str], size: int
) -> None:
    """Refuse an array that is cut in no way into files, and these into chunks, of bearable size."""
    cuts = [*file, *chunk]
    if (
        not len(shape) == len(file) == len(chunk) == len(dims)
        or any(type(number) is not int for number in (*shape, *cuts))
        or any(number < 0 for number in shape)
        or any(number < 1 for number in cuts)
        or not all(map(_NAME.fullmatch, dims))
        or math.prod(file) * size > MOST_BYTES
        or math.prod(-(-n // cut) for n, cut in zip(shape, chunk, strict=True)) > MOST_CHUNKS
    ):
        raise ValueError(f"the shape, chunks and dimensions of {path} don't go together")


def _check_dimensions(nodes: Mapping[str, Any]) -> None:
    """Refuse arrays of a group that don't agree on the length of a dimension."""
    lengths: dict[tuple[str, str], int] = {}
    for path, node in nodes.items():
        group = path.rpartition("/")[0]
        if group and nodes[group]["node_type"] != "group":
            raise ValueError(f"{path} lies in an array")
        for dim, length in zip(node.get("dimension_names", []), node.get("shape", []), strict=True):
            if lengths.setdefault((group, dim), length) != length:
                raise ValueError(f"its arrays don't agree on the length of {dim}")


def _check_files(path: Location) -> None:
    """Refuse a journal with links, which lead out, or pipes, which never end."""
    for name, what in unfit_in_journal(path).items():
        raise NotAStoreError(f"{path}/{name} {what}: remove it")


def unfit_in_journal(path: Location) -> dict[str, str]:
    """Links, pipes and devices in the journal of a store, and which of these they are, by name."""
    if not isinstance(path, Path) or not (path / JOURNAL).is_dir():
        return {}
    modes = {JOURNAL: (path / JOURNAL).lstat().st_mode}
    with os.scandir(path / JOURNAL) as entries:
        for entry in entries:
            with suppress(FileNotFoundError):  # a lock that is given up meanwhile
                mode = entry.stat(follow_symlinks=False).st_mode
                modes[f"{JOURNAL}/{entry.name}"] = mode
    return {
        name: f"is {kind_of(mode)}, no plain file"
        for name, mode in modes.items()
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))
    }


class ReplacedError(PrintableError, ValueError):
    """A store that was extended or replaced since it was opened."""


class Unreplaced(CheckedFiles):
    """A store on disk whose every read fails once another study's store is in its place."""

    def __init__(self, root: Path, files: StoreFiles, held: str) -> None:
        super().__init__(root, files)
        self._study_id = held
        self._seen: tuple[int, ...] | None = None

    def read(self, key: str, byte_range: Any) -> bytes | None:
        """Return the bytes of a file; the identity of the store is checked afterwards."""
        try:
            return super().read(key, byte_range)
        finally:  # another study's file may also be of another size
            self._refuse_another()

    def _refuse_another(self) -> None:
        now = stamp(self.root)
        if now is None or now != self._seen:  # repaired, or another's
            if study_id(self.root) != self._study_id:
                raise ReplacedError(
                    f"{self.root} was extended, replaced or removed since it was opened: "
                    "open it again"
                )
            self._seen = now


def readable(location: Location, held: str = "") -> Any:
    """Open a store for Zarr or xarray, to read it lazily; raises as :func:`read_document`.

    Reading fails once it is no longer the store of the study ``held``, where one is given.
    """
    files = StoreFiles(read_document(location))
    if isinstance(location, ObjectPath):
        return StorePath(CheckedObjects(location.client, location.key, files), location.key)
    return Unreplaced(location, files, held) if held else CheckedFiles(location, files)


RECEIPTS = "receipts.jsonl"

#: Bytes of a line of a log at most; the recipe of eyepoints has their spec in one.
LINE_BYTES_MAX = 64 << 20

#: Seconds for which lines are gathered before they are put as one object.
WAVE = 1.0

#: Objects of a log beyond which they are put into few, and bytes of one of those.
MOST_SEGMENTS = 64
SEGMENT_BYTES = 16 << 20

#: Errors of opening what is no log.
_NO_LOG = {errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.EINVAL}

_SUM = b',"sum":"'
_END = b'"}\n'

_HEAD = re.compile(
    rb'\{"block":(\d{1,18}),"(?:points":(\d{1,18})(?:,"bytes":(\d{1,18}))?|withdrawn")'
)
_TIME = re.compile(rb'"time":(\d{1,10}(?:\.\d{1,20})?)$')
_WORKER = re.compile(rb'"host":"([^"]*)","pid":(\d+)')


def sealed(record: dict[str, Any]) -> bytes:
    """Write a record, not empty, as a line of JSON that ends with a digest of the others."""
    return closed(json.dumps(record, separators=(",", ":")).encode()[:-1])


def closed(body: bytes) -> bytes:
    """Return a line of the fields of a record, written without the last brace."""
    return body + _SUM + _digest(body) + _END


def unsealed(line: bytes) -> dict[str, Any] | None:
    """Return the record of a line, or None if any byte of it has changed."""
    body = body_of(line)
    if body is None:
        return None
    try:
        record = parse_json(body + b"}", has_paths=True)
    except ValueError:  # a stranger's, with a digest of its own
        return None
    return record if isinstance(record, dict) else None


def body_of(line: bytes) -> bytes | None:
    """Return the fields of a line, unread, without the last brace; None as of :func:`unsealed`."""
    body, found, end = line.rpartition(_SUM)
    return body if found and end == _digest(body) + _END else None


def _digest(body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=8).hexdigest().encode()


def read_sealed(path: Location) -> Iterator[tuple[bytes, dict[str, Any] | None]]:
    """Lines of a log, and their records: None where damaged or cut short."""
    for line in raw_lines(path):
        yield line, unsealed(line)


def read_lines(path: Location) -> Iterator[dict[str, Any]]:
    """Read the records of a log, in order; damaged or truncated lines are skipped."""
    return (record for _, record in read_sealed(path) if record is not None)


def digest(
    path: Location,
    objects: Iterable[str],
    bytes_max: Callable[[str], int] = lambda name: FILE_BYTES_MAX,
) -> str:
    """blake2b-128 of names and bytes of stored objects, in hex.

    OSError where one can't be read; UnfitFileError where it is no plain file, or larger than
    ``bytes_max`` of its name.
    """
    if isinstance(path, ObjectPath):
        objects = list(objects)
        contents = each(path, lambda name: (path / name).read_bytes(bytes_max(name)), objects)
        return digest_of(zip(objects, contents, strict=True))
    sum_ = hashlib.blake2b(digest_size=16)
    for name in objects:
        with pieces_below(path, name, bytes_max(name)) as (size, pieces):
            sum_.update(f"{name}\0{size}\0".encode())
            for piece in pieces:
                sum_.update(piece)
    return sum_.hexdigest()


def digest_of(contents: Iterable[tuple[str, bytes]]) -> str:
    """As :func:`digest`, of names and bytes at hand."""
    sum_ = hashlib.blake2b(digest_size=16)
    for name, content in contents:
        sum_.update(f"{name}\0{len(content)}\0".encode())
        sum_.update(content)
    return sum_.hexdigest()


class FileLog:
    """A file that is appended to, and not kept open; on the disk at once where it is `durable`."""

    def __init__(self, path: Path, *, durable: bool = False) -> None:
        self._path, self._durable = path, durable

    def append(self, lines: bytes) -> None:
        """Append whole lines, all or none; OSError where they can't be written."""
        log = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        try:
            size = os.fstat(log).st_size
            if os.write(log, lines) < len(lines):  # the disk is full
                os.ftruncate(log, size)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))
            if self._durable:
                os.fsync(log)
        finally:
            os.close(log)

    def flush(self, *, now: bool = False) -> bool:
        """Tell whether all is written: what is appended is."""
        return True

    def keep(self, is_sound: Callable[[bytes], bool]) -> None:
        """Drop the lines that are not sound."""
        if self._path.is_dir() or not all(map(is_sound, raw_lines(self._path))):
            lines = raw_lines(self._path)
            put_whole(self._path, b"".join(line for line in lines if is_sound(line)))


class ObjectLog:
    """A row of objects under a key, numbered in the order of writing."""

    def __init__(self, path: ObjectPath) -> None:
        self._path = path
        self._number = max((_number(name) for name in segments(path)), default=0)
        self._lines: list[bytes] = []
        self._put = 0.0

    def append(self, lines: bytes) -> None:
        """Append whole lines; they are there after the next `flush` that writes."""
        self._lines.append(lines)

    def flush(self, *, now: bool = False) -> bool:
        """Put what was appended as an object, now or `WAVE` s after the last; True if none left."""
        if not self._lines:
            return True
        if time.monotonic() - self._put < WAVE and not now:
            return False
        segment = self._path / _segment(self._number + 1)
        segment.write_bytes(b"".join(self._lines))
        self._number += 1
        self._lines.clear()
        self._put = time.monotonic()
        return True

    def keep(self, is_sound: Callable[[bytes], bool]) -> None:
        """Drop the lines that are not sound; where objects are many, put their lines in few."""
        names = segments(self._path)
        merging = len(names) > MOST_SEGMENTS
        group: list[str] = []
        lines: list[bytes] = []
        size = 0
        for name, content in _contents(self._path, names):
            group.append(name)
            lines += content.splitlines(keepends=True)
            size += len(content)
            if not merging or size > SEGMENT_BYTES or name == names[-1]:
                self._rewrite(group, lines, is_sound)
                group, lines, size = [], [], 0

    def _rewrite(
        self, names: list[str], lines: list[bytes], is_sound: Callable[[bytes], bool]
    ) -> None:
        """Put sound lines of objects in the last one's place; cut short, they are there twice."""
        sound = [line for line in lines if is_sound(line)]
        if len(names) == 1 and len(sound) == len(lines):
            return
        (self._path / _segment(_number(names[-1]))).write_bytes(b"".join(sound))
        each(self._path, lambda name: (self._path / name).unlink(), names)


def open_log(path: Location, *, durable: bool = False) -> FileLog | ObjectLog:
    """Open a log to append to; the caller ensures that nobody else does."""
    if isinstance(path, ObjectPath):
        return ObjectLog(path)
    path.parent.mkdir(exist_ok=True)
    return FileLog(path, durable=durable)


def segments(path: ObjectPath) -> list[str]:
    """Names of the objects of a log, in order."""
    return sorted(name for name, _ in path.below() if _number(name) > 0)


def _segment(number: int) -> str:
    """Name of an object; nobody else's, should two write against all precautions."""
    return f"{number:08d}-{uuid.uuid4().hex[:8]}"


def _number(segment: str) -> int:
    number = segment.partition("-")[0]
    return int(number) if number.isdigit() else 0


def _contents(path: ObjectPath, names: list[str]) -> Iterator[tuple[str, bytes]]:
    """Objects of a log with their names, some of them in memory at a time."""
    for start in range(0, len(names), REQUESTS):
        some = names[start : start + REQUESTS]
        yield from zip(some, each(path, lambda name: _whole_lines(path / name), some), strict=True)


def _whole_lines(segment: ObjectPath) -> bytes:
    """Read an object of a log; once more where its last line is cut, as an answer may have been."""
    for _ in range(2):
        content = segment.read_bytes()
        if content.endswith(b"\n"):
            return content
    segment.refuse_cut(content)  # else lines would count as damaged that are not
    return content


def raw_lines(path: Location) -> Iterator[bytes]:
    """Lines of a log in order, with their ends; of a small file too, in an object store."""
    if isinstance(path, ObjectPath):
        names = segments(path)
        if not names and path.size() > 0:
            yield from _whole_lines(path).splitlines(keepends=True)
        for _, content in _contents(path, names):
            yield from content.splitlines(keepends=True)
    else:
        try:
            opened = open_plain(path, follow=False)
        except OSError as error:
            if error.errno in _NO_LOG:
                return
            raise
        with open(opened, "rb") as log:
            yield from _lines_of(log)


def _lines_of(log: BinaryIO) -> Iterator[bytes]:
    """Lines of a log; one that is longer than any of ours in parts, without a file's holes."""
    while line := log.readline(LINE_BYTES_MAX):
        yield line
        if len(line) == LINE_BYTES_MAX:
            try:
                log.seek(os.lseek(log.fileno(), log.tell(), os.SEEK_DATA))
            except OSError:  # nothing but a hole is left
                return


@dataclass
class Receipts:
    """Sums of a log of receipts: which blocks are done, when, how fast."""

    points: np.ndarray  # (blocks,) int64: points of every block that is committed, 0 of the others
    sizes: np.ndarray  # (blocks,) int64: bytes of these as they are stored, where the receipt says
    first: float = np.inf
    last: float = -np.inf  # times of the first and last receipt [s since the epoch]
    recent: int = 0  # points committed since the time asked for
    workers: set[bytes] = field(default_factory=set)  # hosts and processes that computed them

    @property
    def blocks(self) -> int:
        """Number of blocks that are committed."""
        return int(np.count_nonzero(self.points))


def read_receipts(store: Location, n_blocks: int, *, since: float = np.inf) -> Receipts:
    """Sum the log of a store, points and workers `since` a time; damaged lines do not count."""
    found = Receipts(np.zeros(n_blocks, np.int64), np.zeros(n_blocks, np.int64))
    for line in raw_lines(store / JOURNAL / RECEIPTS):
        body = body_of(line)
        head = body and _HEAD.match(body)
        if not body or not head or (block := int(head[1])) >= n_blocks:
            continue
        found.points[block], found.sizes[block] = int(head[2] or 0), int(head[3] or 0)
        if head[2] and (said := _TIME.search(body, len(body) - 40)):
            _date(found, body, int(head[2]), float(said[1]), since)
    return found


def _date(found: Receipts, body: bytes, points: int, time: float, since: float) -> None:
    found.first, found.last = min(found.first, time), max(found.last, time)
    if time >= since:
        found.recent += points
        if worker := _WORKER.search(body):
            found.workers.add(worker[0])
