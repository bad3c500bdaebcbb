"""Format of stores and of their journal logs. Data that this program would not write is refused.

Zarr decodes whatever the metadata of arrays declare, including pickled objects and codecs of
plug-ins. The root document of a store contains the metadata of all its arrays. It is checked first,
and arrays are opened only through it.

A log consists of lines of JSON, each with its own digest at the end. On disk a log is a file to
which lines are appended. In an object store a log is a sequence of numbered objects. Each object is
written once, with the lines of about a second.
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
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from zarr.storage import StorePath

from sweep.messages import (
    SPEC_PLACEHOLDER,
    STORE_PLACEHOLDER,
    EscapedMessageError,
    escape_to_one_line,
    suggested_call,
)
from sweep.regular_files import (
    RefusedFileError,
    file_type,
    open_regular_file,
    stream_file_below_root,
)
from sweep.safe_json import parse_json
from sweep.storage.locations import (
    CONCURRENT_REQUESTS_MAX,
    JOURNAL_DIR,
    Location,
    ObjectPath,
    ObjectStoreError,
    atomic_write,
    map_concurrently,
    read_object,
    recover_interrupted_replace,
    store_stat_fingerprint,
)
from sweep.storage.size_checks import (
    ARRAY_FILE_BYTES_MAX,
    METADATA_BYTES_MAX,
    SizeCheckedLocalStore,
    SizeCheckedObjectStore,
    StoreFileSizeLimits,
)

#: Manifest: journal file with the digest of each object that a store has before any results.
MANIFEST_FILE = "template.jsonl"

#: Version of the layout of stores: of their groups, arrays, attributes and journal.
LAYOUT_VERSION = 5

#: Level of the zstd compression of every array chunk.
ZSTD_LEVEL = 1

#: Arguments of xarray's open functions, which make them read only the checked root document.
OPEN_ZARR_KWARGS: dict[str, Any] = {"consolidated": True, "zarr_format": 3}

#: Largest uncompressed size of an array file [bytes], and largest number of chunks of an array.
UNCOMPRESSED_FILE_BYTES_MAX = ARRAY_CHUNKS_MAX = 2**31

GRID_STORE_KIND, SCENE_STORE_KIND, EYEPOINTS_STORE_KIND, ACCURACY_STORE_KIND = (
    "grid", "scene", "eyepoints", "accuracy",
)  # fmt: skip
"""Kinds of stores: results of grids, of flights over scenes, of rays, and of `sweep accuracy`."""

_REQUIRED_ATTRIBUTES_BY_STORE_KIND = {
    GRID_STORE_KIND: ("title", "spec", "coordinates"),
    SCENE_STORE_KIND: ("title", "spec", "scanners", "surfaces"),
    EYEPOINTS_STORE_KIND: ("geometry", "shots_a_cycle"),
    ACCURACY_STORE_KIND: ("title", "spec", "coordinates"),
}
"""Names of the attributes that each kind of store must have, in addition to the common ones."""

_COMMON_REQUIRED_ATTRIBUTES = ("study_id", "model_version", "software")
"""Names of the attributes that every store must have."""

_STUDY_ID_PATTERN = re.compile(r"[0-9a-f]{32}")

_NON_STRING_ATTRIBUTE_TYPES = {"shots_a_cycle": int, "scanners": list, "surfaces": list}
"""Types of the store attributes that are not text, by name."""

_ALLOWED_ARRAY_ATTRIBUTE_TYPES = {
    "units": str, "long_name": str, "comment": str, "standard_name": str, "path": str,
    "flag_meanings": str, "flag_masks": list, "flag_values": list, "tolerance": float,
    "confidence": float,
}  # fmt: skip
"""Types of the attributes that an array may have, by the name of the attribute.

A store with any other is refused, as xarray would interpret for example `scale_factor`.
"""

_ALLOWED_FILL_VALUES_BY_TYPE: dict[str, tuple[Any, ...]] = {
    "float64": (0.0, "NaN"), "int64": (0, -1), "int32": (0, -1), "int16": (0, -1), "int8": (0, -1),
    "uint32": (0,), "uint8": (0,), "bool": (False,), "string": ("",),
}  # fmt: skip
"""Permitted data types of arrays, with the permitted fill values of each."""

TERRAIN_MAP_GROUP = "scene_map"
"""Name of the group with the terrain map of a flight."""

_VALID_NAME_PATTERN = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}")
"""Pattern of valid names of groups, arrays and dimensions."""

_CHECKSUM_CODEC = {"name": "crc32c"}
_COMPRESSION_CODECS = [
    {"name": "zstd", "configuration": {"level": ZSTD_LEVEL, "checksum": False}},
    _CHECKSUM_CODEC,
]
_STRING_CODEC = {"name": "vlen-utf8", "configuration": {}}
_SINGLE_BYTE_CODEC = {"name": "bytes"}
_LITTLE_ENDIAN_CODEC = {"name": "bytes", "configuration": {"endian": "little"}}
_SHARD_INDEX_CONFIGURATION = {
    "index_codecs": [_LITTLE_ENDIAN_CODEC, _CHECKSUM_CODEC],
    "index_location": "end",
}
"""Zarr configuration of shard indices. A shard's index lists the chunks in its file."""


class StoreError(EscapedMessageError):
    """Error of a store that can't be used as requested."""


class NotAStoreError(StoreError, ValueError):
    """Error of a path that has no store of a study, or a store that this program can't read."""


def read_attributes(path: Location) -> dict[str, Any]:
    """Return the root attributes of a store, after a check of its root document.

    NotAStoreError is raised if the document differs from what this program writes.
    """
    attributes: dict[str, Any] = read_root_metadata(path)["attributes"]
    return attributes


def read_root_metadata(path: Location) -> dict[str, Any]:
    """Return the checked root document of a store.

    Raise NotAStoreError if it differs from what this program writes.
    """
    root_metadata = _read_root_document(path)
    attributes = check_attributes(path, root_metadata["attributes"])
    try:
        consolidated = root_metadata["consolidated_metadata"]
        nodes = consolidated["metadata"]
        declared_format = (
            root_metadata["zarr_format"],
            root_metadata["node_type"],
            consolidated["kind"],
        )
        if declared_format != (3, "group", "inline"):
            raise ValueError("its root is another")
        for name, node in nodes.items():
            _check_zarr_node_metadata(name, node)
        _check_dimension_lengths(nodes)
        flags_arrays = [f"{name}/flags" for name in attributes.get("scanners", ())]
        required_arrays = ["effects"] if attributes["kind"] == GRID_STORE_KIND else flags_arrays
        if missing_arrays := [name for name in required_arrays if name not in nodes]:
            raise ValueError(f"it lacks {missing_arrays[0]}")
    except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        reason = error if type(error) is ValueError else "its metadata are incomplete"
        raise NotAStoreError(
            f"{path} is not as sweep writes stores: {reason}{repair_hint(path)}"
        ) from None
    _check_journal_files(path)
    return root_metadata


def check_attributes(path: Location, attributes: Any) -> dict[str, Any]:
    """Check the root attributes of a store, and return them unchanged.

    NotAStoreError is raised unless they are those of a store that this version writes.
    """
    checked_attributes = _require_sweep_attributes(path, attributes)
    if (layout := checked_attributes.get("layout")) != LAYOUT_VERSION:
        raise NotAStoreError(
            f"{path} is laid out as version {layout!r:.20}; this sweep writes {LAYOUT_VERSION}"
        )
    required = (
        *_COMMON_REQUIRED_ATTRIBUTES,
        *_REQUIRED_ATTRIBUTES_BY_STORE_KIND.get(
            str(checked_attributes.get("kind")), ("no known kind",)
        ),
    )
    attributes_as_text = checked_attributes | {
        "software": format_software_versions(checked_attributes.get("software"))
    }
    if any(
        type(attributes_as_text.get(name)) is not _NON_STRING_ATTRIBUTE_TYPES.get(name, str)
        for name in required
    ):
        raise NotAStoreError(f"{path} is a Zarr store, but not one that sweep made")
    if not _STUDY_ID_PATTERN.fullmatch(checked_attributes["study_id"]):
        why = f"its study_id is {checked_attributes['study_id'][:40]!r}, and no digest"
        raise NotAStoreError(f"{path} is not as sweep writes stores: {why}{repair_hint(path)}")
    return checked_attributes


def format_software_versions(software: Any) -> Any:
    """Return a mapping of software versions as text, such as ``numba 0.60, numpy 2.1``.

    Any other argument is returned unchanged: new stores have text, and stores of earlier versions
    have mappings. Text can be written to any file format.
    """
    if not isinstance(software, dict):
        return software
    return ", ".join(f"{name} {version}" for name, version in software.items())


def parse_software_versions(attributes: Mapping[Any, Any]) -> dict[str, str]:
    """Return the versions of the software that created a store, by name."""
    text = str(format_software_versions(attributes["software"]))
    return dict(part.rsplit(" ", 1) for part in text.split(", ") if " " in part)


def refuse_foreign_store(path: Location) -> None:
    """Raise NotAStoreError if there is no store at a path, or if sweep did not make it."""
    _require_sweep_attributes(path, _read_root_document(path)["attributes"])


def _require_sweep_attributes(path: Location, attributes: Any) -> dict[str, Any]:
    if not isinstance(attributes, dict) or "study_id" not in attributes:
        raise NotAStoreError(
            f"{path} is a Zarr store, but not one that sweep made{_nearby_stores_hint(path)}"
        )
    return attributes


def _read_root_document(path: Location) -> dict[str, Any]:
    """Return the parsed root document of a store, not yet checked.

    NotAStoreError, with the likely cause and the remedy, is raised if there is none.
    """
    recover_interrupted_replace(path)
    detail = ""
    try:
        root_metadata = _read_json(path, "zarr.json")
        if "attributes" in root_metadata:
            return dict(root_metadata)
    except ObjectStoreError:
        raise
    except RefusedFileError as error:
        detail = f" ({error.strerror})"
    except (OSError, ValueError, KeyError, TypeError):
        pass
    if not path.exists():
        raise NotAStoreError(f"there is no store at {path}{_nearby_stores_hint(path)}")
    if hint := repair_hint(path):
        raise NotAStoreError(f"{path / 'zarr.json'} is damaged{detail}{hint}")
    if detail:
        raise NotAStoreError(f"{path / 'zarr.json'} is damaged{detail}")
    if isinstance(path, Path) and path.is_file():
        run_suggestion = suggested_call("run", SPEC_PLACEHOLDER, store=STORE_PLACEHOLDER)
        description = (
            f"a file, and no Zarr store of sweep's: {run_suggestion} computes a spec into one"
        )
        raise NotAStoreError(f"{path} is {description}{_nearby_stores_hint(path)}")
    run_suggestion = suggested_call("run", SPEC_PLACEHOLDER, store=STORE_PLACEHOLDER)
    description = "is not a Zarr store of sweep's"
    if names := _first_file_names_text(path):
        raise NotAStoreError(
            f"{path} {description}, and has files in it ({names}): name another place, as "
            f"{run_suggestion} computes "
            f"a spec into a new or an empty folder{_nearby_stores_hint(path)}"
        )
    raise NotAStoreError(
        f"{path} {description}: {run_suggestion} computes a spec into "
        f"one{_nearby_stores_hint(path)}"
    )


_FILE_NAMES_IN_MESSAGE_MAX = 3
"""Largest number of file names in an error message."""


def _first_file_names_text(path: Location) -> str:
    """Return the names of the first files and folders in a folder, as text; '' if it has none."""
    if not isinstance(path, Path) or not path.is_dir():
        return ""
    with suppress(OSError), os.scandir(path) as entries:
        names = sorted(entry.name for entry in islice(entries, _FILE_NAMES_IN_MESSAGE_MAX + 1))
        names_text = ", ".join(
            escape_to_one_line(name) for name in names[:_FILE_NAMES_IN_MESSAGE_MAX]
        )
        return f"{names_text}, ..." if len(names) > _FILE_NAMES_IN_MESSAGE_MAX else names_text
    return ""


def _read_json(path: Location, name: str) -> Any:
    """Return a parsed JSON document of a store, given by its name.

    In an object store it is read again if it can't be parsed, as the response may be truncated.
    """
    try:
        return parse_json(read_object(path, name, METADATA_BYTES_MAX))
    except ValueError:
        if isinstance(path, Path):
            raise
        return parse_json(read_object(path, name, METADATA_BYTES_MAX))


def objects_match_digest(
    path: Location,
    object_names: list[str],
    expected_digest: str,
    bytes_max: Callable[[str], int] = lambda name: ARRAY_FILE_BYTES_MAX,
) -> bool:
    """Return True if stored objects, given by name, have the expected digest together.

    A mismatch in an object store is confirmed by a second read. ``bytes_max``, and the errors that
    are raised, are those of :func:`stored_objects_digest`.
    """
    matches = stored_objects_digest(path, object_names, bytes_max) == expected_digest
    return matches or (
        isinstance(path, ObjectPath)
        and stored_objects_digest(path, object_names, bytes_max) == expected_digest
    )


def read_manifest_attributes(path: Location) -> dict[str, Any]:
    """Return the attributes of a store from its manifest; empty if the manifest is damaged."""
    attributes: dict[str, Any] = next(iter_log_records(path / JOURNAL_DIR / MANIFEST_FILE), {}).get(
        "attributes", {}
    )
    return attributes


def read_study_id(path: Location) -> str:
    """Return the study id of a store of any version, damaged or not; '' if it has none."""
    try:
        return str(
            _require_sweep_attributes(path, _read_root_document(path)["attributes"])["study_id"]
        )
    except NotAStoreError:
        return str(read_manifest_attributes(path).get("study_id", ""))


def repair_hint(path: Location) -> str:
    """Return advice on how to restore a store's damaged objects; '' if it has no manifest."""
    if not (path / JOURNAL_DIR / MANIFEST_FILE).exists():
        return ""
    if read_manifest_attributes(path):
        return f": {suggested_call('verify', path, repair=True)} puts it back"
    command = suggested_call("verify", path, repair=True, spec=SPEC_PLACEHOLDER)
    return f": {command}, with the study's spec, puts it back"


def _nearby_stores_hint(path: Location) -> str:
    """Return a hint that lists stores in or next to a path; '' if there are none."""
    directory = path if path.is_dir() else path.parent
    metadata_files = directory.glob("*.zarr/zarr.json") if directory.is_dir() else ()
    names = sorted(str(metadata_file.parent) for metadata_file in metadata_files)
    listed_names = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
    return f"; stores near it: {listed_names}" if names else ""


def _check_zarr_node_metadata(node_name: str, node: dict[str, Any]) -> None:
    """Raise ValueError if a group or array has other metadata than this program writes."""
    if not all(map(_VALID_NAME_PATTERN.fullmatch, node_name.split("/"))):
        raise ValueError(f"an array has the name {node_name!r:.60}")
    if node["zarr_format"] != 3:
        raise ValueError(f"{node_name} is of the Zarr format {node['zarr_format']!r:.20}")
    if node["node_type"] == "group":
        attributes = node["attributes"]
        if node_name != TERRAIN_MAP_GROUP:
            # The id becomes part of a path, so it must not contain a slash.
            if not re.fullmatch("[0-9a-f]{32}", attributes["geometry_id"]):
                raise ValueError(f"the group {node_name} has no eyepoints")
            attributes["coordinates"].split()
        expected = {"node_type": "group", "zarr_format": 3, "attributes": attributes}
    else:
        expected = _expected_array_metadata(node_name, node)
    if differing_keys := sorted(
        key for key in node | expected if node.get(key) != expected.get(key)
    ):
        raise ValueError(f"the {differing_keys[0]} of {node_name} is another")


def _expected_array_metadata(node_name: str, node: dict[str, Any]) -> dict[str, Any]:
    """Return the metadata that sweep itself would write for an array of this shape and type.

    Parts that may differ between arrays are taken from ``node``. ValueError is raised if they are
    invalid.
    """
    data_type, attributes, fill_value = node["data_type"], node["attributes"], node["fill_value"]
    if not isinstance(data_type, str) or fill_value not in _ALLOWED_FILL_VALUES_BY_TYPE.get(
        data_type, ()
    ):
        raise ValueError(
            f"{node_name} has values of the type {data_type!r:.40}, {fill_value!r:.40} where "
            "missing"
        )
    for name, value in attributes.items():
        if type(value) is not _ALLOWED_ARRAY_ATTRIBUTE_TYPES.get(name):
            raise ValueError(f"{node_name} has the attribute {name!r:.40}")
    file_shape = node["chunk_grid"]["configuration"]["chunk_shape"]
    value_bytes = np.dtype("u1" if data_type == "string" else data_type).itemsize
    codecs: list[Any] = [
        _LITTLE_ENDIAN_CODEC if value_bytes > 1 else _SINGLE_BYTE_CODEC,
        *_COMPRESSION_CODECS,
    ]
    if data_type == "string":
        codecs[0] = _STRING_CODEC
    chunk_shape = file_shape
    if node["codecs"][0]["name"] == "sharding_indexed":
        chunk_shape = node["codecs"][0]["configuration"]["chunk_shape"]
        sharding = {"chunk_shape": chunk_shape, "codecs": codecs, **_SHARD_INDEX_CONFIGURATION}
        codecs = [{"name": "sharding_indexed", "configuration": sharding}]
    dims = node.get("dimension_names", [])
    _check_array_shape(node_name, node["shape"], file_shape, chunk_shape, dims, value_bytes)
    return {
        "shape": node["shape"],
        "data_type": data_type,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": file_shape}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": fill_value,
        "codecs": codecs,
        "attributes": attributes,
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
        **({"dimension_names": dims} if dims else {}),
    }


def _check_array_shape(
    node_name: str,
    shape: list[int],
    file_shape: list[int],
    chunk_shape: list[int],
    dims: list[str],
    value_bytes: int,
) -> None:
    """Raise ValueError unless an array is divided into files and chunks of valid size."""
    chunk_lengths = [*file_shape, *chunk_shape]
    if (
        not len(shape) == len(file_shape) == len(chunk_shape) == len(dims)
        or any(type(length) is not int for length in (*shape, *chunk_lengths))
        or any(length < 0 for length in shape)
        or any(length < 1 for length in chunk_lengths)
        or not all(map(_VALID_NAME_PATTERN.fullmatch, dims))
        or math.prod(file_shape) * value_bytes > UNCOMPRESSED_FILE_BYTES_MAX
        or math.prod(
            -(-array_length // chunk_length)
            for array_length, chunk_length in zip(shape, chunk_shape, strict=True)
        )
        > ARRAY_CHUNKS_MAX
    ):
        raise ValueError(f"the shape, chunks and dimensions of {node_name} don't go together")


def _check_dimension_lengths(nodes: Mapping[str, Any]) -> None:
    """Raise ValueError if the arrays of a group disagree on the length of a dimension."""
    lengths: dict[tuple[str, str], int] = {}
    for node_name, node in nodes.items():
        group = node_name.rpartition("/")[0]
        if group and nodes[group]["node_type"] != "group":
            raise ValueError(f"{node_name} lies in an array")
        for dim, length in zip(node.get("dimension_names", []), node.get("shape", []), strict=True):
            if lengths.setdefault((group, dim), length) != length:
                raise ValueError(f"its arrays don't agree on the length of {dim}")


def _check_journal_files(path: Location) -> None:
    """Raise NotAStoreError if a journal contains links or special files.

    A link may lead out of the store, and a pipe may never end.
    """
    for name, problem in find_irregular_journal_files(path).items():
        raise NotAStoreError(f"{path}/{name} {problem}: remove it")


def find_irregular_journal_files(path: Location) -> dict[str, str]:
    """Return a description of each link, pipe and device in a store's journal, by path.

    The result is empty if there are none.
    """
    if not isinstance(path, Path) or not (path / JOURNAL_DIR).is_dir():
        return {}
    modes = {JOURNAL_DIR: (path / JOURNAL_DIR).lstat().st_mode}
    with os.scandir(path / JOURNAL_DIR) as entries:
        for entry in entries:
            with suppress(FileNotFoundError):  # a lock that was released meanwhile
                mode = entry.stat(follow_symlinks=False).st_mode
                modes[f"{JOURNAL_DIR}/{entry.name}"] = mode
    return {
        name: f"is {file_type(mode)}, no plain file"
        for name, mode in modes.items()
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))
    }


class StoreReplacedError(EscapedMessageError, ValueError):
    """Error of reading a store that was extended, replaced or removed after it was opened."""


class StudyBoundLocalStore(SizeCheckedLocalStore):
    """Zarr store on disk whose reads raise an error once another study's store is at its path."""

    def __init__(self, root: Path, limits: StoreFileSizeLimits, study_id: str) -> None:
        super().__init__(root, limits)
        self._study_id = study_id
        self._last_fingerprint: tuple[int, ...] | None = None

    def read(self, key: str, byte_range: Any) -> bytes | None:
        """Return the bytes of a file, then check that the store is still that of the study."""
        try:
            return super().read(key, byte_range)
        finally:  # also after an error: a file of another study may have another size
            self._check_same_study()

    def _check_same_study(self) -> None:
        """Raise StoreReplacedError if the path no longer has the store of the same study."""
        fingerprint = store_stat_fingerprint(self.root)
        if fingerprint is None or fingerprint != self._last_fingerprint:  # repaired or replaced
            if read_study_id(self.root) != self._study_id:
                raise StoreReplacedError(
                    f"{self.root} was extended, replaced or removed since it was opened: "
                    "open it again"
                )
            self._last_fingerprint = fingerprint


def open_size_checked_store(location: Location, study_id: str = "") -> Any:
    """Return a read-only Zarr store that refuses files of a wrong size.

    If ``study_id`` is not empty, reads fail once the store is no longer that of this study.
    NotAStoreError is raised if the root document differs from what this program writes.
    """
    limits = StoreFileSizeLimits(read_root_metadata(location))
    if isinstance(location, ObjectPath):
        return StorePath(
            SizeCheckedObjectStore(location.client, location.key, limits), location.key
        )
    return (
        StudyBoundLocalStore(location, limits, study_id)
        if study_id
        else SizeCheckedLocalStore(location, limits)
    )


#: Journal file with a receipt for each committed block.
RECEIPTS_FILE = "receipts.jsonl"

#: Largest length of a log line [bytes]; the recipe of eyepoints has their spec in one line.
LOG_LINE_BYTES_MAX = 64 << 20

#: Time for which lines are collected before they are written as one object [s].
LOG_OBJECT_INTERVAL_SECONDS = 1.0

#: Number of objects of a log above which they are merged.
LOG_OBJECTS_MAX = 64

#: Size from which a merged object gets no further lines [bytes].
MERGED_LOG_OBJECT_TARGET_BYTES = 16 << 20

#: Errors of opening a path at which there is no log.
_MISSING_LOG_ERRNOS = {errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.EINVAL}

_DIGEST_FIELD_START = b',"sum":"'
_LOG_RECORD_END = b'"}\n'

_RECEIPT_HEAD_PATTERN = re.compile(
    rb'\{"block":(\d{1,18}),"(?:points":(\d{1,18})(?:,"bytes":(\d{1,18}))?|withdrawn")'
)
"""Pattern of the first fields of a receipt: the block, then points and bytes, or `withdrawn`."""

_RECEIPT_TIME_PATTERN = re.compile(rb'"time":(\d{1,10}(?:\.\d{1,20})?)$')
_RECEIPT_WORKER_PATTERN = re.compile(rb'"host":"([^"]*)","pid":(\d+)')
"""Pattern of the fields in a receipt that name the worker: host and process number."""


def encode_log_record(record: dict[str, Any]) -> bytes:
    """Encode a non-empty record as a line of JSON whose last field is a digest of the others."""
    return log_line_with_digest(json.dumps(record, separators=(",", ":")).encode()[:-1])


def log_line_with_digest(line_body: bytes) -> bytes:
    """Return a complete log line: encoded fields, and a digest of them as the last field.

    ``line_body`` is a JSON object without its closing brace.
    """
    return line_body + _DIGEST_FIELD_START + _line_digest(line_body) + _LOG_RECORD_END


def decode_log_record(line: bytes) -> dict[str, Any] | None:
    """Return the record of a log line, or None if any byte of the line has changed."""
    line_body = verified_line_body(line)
    if line_body is None:
        return None
    try:
        record = parse_json(line_body + b"}", allow_non_utf8=True)
    except ValueError:  # written by another program, but with a valid digest
        return None
    return record if isinstance(record, dict) else None


def verified_line_body(line: bytes) -> bytes | None:
    """Return a log line without its digest and closing brace, or None if the digest is wrong.

    The fields of the line are not parsed.
    """
    line_body, digest_field, line_end = line.rpartition(_DIGEST_FIELD_START)
    return (
        line_body
        if digest_field and line_end == _line_digest(line_body) + _LOG_RECORD_END
        else None
    )


def _line_digest(body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=8).hexdigest().encode()


class LogLine(NamedTuple):
    """Line of a log, as bytes and decoded."""

    raw_line: bytes
    """Bytes of the line, with the line end."""
    record: dict[str, Any] | None
    """Record in the line; None if the line is damaged or truncated."""


def iter_log_lines(path: Location) -> Iterator[LogLine]:
    """Yield each line of a log with its record. The record of a damaged line is None."""
    for line in iter_raw_lines(path):
        yield LogLine(line, decode_log_record(line))


def iter_log_records(path: Location) -> Iterator[dict[str, Any]]:
    """Yield the records of a log, in order. Damaged lines are skipped."""
    return (record for _, record in iter_log_lines(path) if record is not None)


def stored_objects_digest(
    path: Location,
    object_names: Iterable[str],
    bytes_max: Callable[[str], int] = lambda name: ARRAY_FILE_BYTES_MAX,
) -> str:
    """Return the blake2b-128 digest of names, sizes and bytes of stored objects, in hex.

    Raise OSError if an object can't be read. Raise RefusedFileError if it is no regular file, or
    larger than ``bytes_max`` returns for its name.
    """
    if isinstance(path, ObjectPath):
        object_names = list(object_names)
        contents = map_concurrently(
            path, lambda name: (path / name).read_bytes(bytes_max(name)), object_names
        )
        return contents_digest(zip(object_names, contents, strict=True))
    hasher = hashlib.blake2b(digest_size=16)
    for name in object_names:
        with stream_file_below_root(path, name, bytes_max(name)) as stream:
            hasher.update(f"{name}\0{stream.size_bytes}\0".encode())
            for piece in stream.content_pieces:
                hasher.update(piece)
    return hasher.hexdigest()


def contents_digest(contents: Iterable[tuple[str, bytes]]) -> str:
    """Return the digest of objects, given as pairs of name and bytes.

    It equals the result of :func:`stored_objects_digest` for the same objects in a store.
    """
    hasher = hashlib.blake2b(digest_size=16)
    for name, content in contents:
        hasher.update(f"{name}\0{len(content)}\0".encode())
        hasher.update(content)
    return hasher.hexdigest()


class FileLog:
    """Append-only log in a file, which is opened for each write.

    With ``durable``, each append returns only once the lines are on the disk.
    """

    def __init__(self, path: Path, *, durable: bool = False) -> None:
        self._path, self._durable = path, durable

    def append(self, lines: bytes) -> None:
        """Append complete lines, all or none. Raise OSError if they can't be written."""
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

    def flush(self, *, force: bool = False) -> bool:
        """Return True, as appended lines are written at once."""
        return True

    def remove_damaged_lines(self, is_sound: Callable[[bytes], bool]) -> None:
        """Remove the lines for which ``is_sound`` returns False, by writing the log again."""
        if self._path.is_dir() or not all(map(is_sound, iter_raw_lines(self._path))):
            lines = iter_raw_lines(self._path)
            atomic_write(self._path, b"".join(line for line in lines if is_sound(line)))


class ObjectStoreLog:
    """Append-only log in an object store: objects below one key, numbered in order of writing."""

    def __init__(self, path: ObjectPath) -> None:
        self._path = path
        self._last_number = max(
            (_log_object_number(name) for name in list_log_objects(path)), default=0
        )
        self._pending_lines: list[bytes] = []
        self._last_put_time = 0.0

    def append(self, lines: bytes) -> None:
        """Add complete lines to the pending lines, which `flush` writes."""
        self._pending_lines.append(lines)

    def flush(self, *, force: bool = False) -> bool:
        """Write the pending lines as one object. Return True if no line is pending any more.

        Without ``force``, nothing is written within `LOG_OBJECT_INTERVAL_SECONDS` of the last
        write.
        """
        if not self._pending_lines:
            return True
        if time.monotonic() - self._last_put_time < LOG_OBJECT_INTERVAL_SECONDS and not force:
            return False
        log_object = self._path / _new_log_object_name(self._last_number + 1)
        log_object.write_bytes(b"".join(self._pending_lines))
        self._last_number += 1
        self._pending_lines.clear()
        self._last_put_time = time.monotonic()
        return True

    def remove_damaged_lines(self, is_sound: Callable[[bytes], bool]) -> None:
        """Remove lines for which ``is_sound`` returns False. Merge the objects if they are many."""
        object_names = list_log_objects(self._path)
        is_merging = len(object_names) > LOG_OBJECTS_MAX
        names_in_group: list[str] = []
        lines: list[bytes] = []
        group_bytes = 0
        for object_name, content in _iter_log_objects(self._path, object_names):
            names_in_group.append(object_name)
            lines += content.splitlines(keepends=True)
            group_bytes += len(content)
            if (
                not is_merging
                or group_bytes > MERGED_LOG_OBJECT_TARGET_BYTES
                or object_name == object_names[-1]
            ):
                self._rewrite_objects(names_in_group, lines, is_sound)
                names_in_group, lines, group_bytes = [], [], 0

    def _rewrite_objects(
        self, object_names: list[str], lines: list[bytes], is_sound: Callable[[bytes], bool]
    ) -> None:
        """Write the sound lines of several log objects to a new object. Delete the old objects.

        ``lines`` are all lines of the objects. ``is_sound`` tells whether a line is undamaged. If
        this is interrupted, some lines are stored twice.
        """
        sound_lines = [line for line in lines if is_sound(line)]
        if len(object_names) == 1 and len(sound_lines) == len(lines):
            return
        (self._path / _new_log_object_name(_log_object_number(object_names[-1]))).write_bytes(
            b"".join(sound_lines)
        )
        map_concurrently(
            self._path, lambda object_name: (self._path / object_name).unlink(), object_names
        )


def open_log(path: Location, *, durable: bool = False) -> FileLog | ObjectStoreLog:
    """Return a log that is open for appending.

    The caller ensures that no other process appends to it.
    """
    if isinstance(path, ObjectPath):
        return ObjectStoreLog(path)
    path.parent.mkdir(exist_ok=True)
    return FileLog(path, durable=durable)


def list_log_objects(path: ObjectPath) -> list[str]:
    """Return the names of the objects of a log, in order of writing."""
    return sorted(
        object_name
        for object_name, _ in path.iter_objects_below()
        if _log_object_number(object_name) > 0
    )


def _new_log_object_name(number: int) -> str:
    """Return the name of a new log object, with its number and a random part.

    Names are unique even if two processes write despite the lock.
    """
    return f"{number:08d}-{uuid.uuid4().hex[:8]}"


def _log_object_number(object_name: str) -> int:
    number = object_name.partition("-")[0]
    return int(number) if number.isdigit() else 0


def _iter_log_objects(path: ObjectPath, object_names: list[str]) -> Iterator[tuple[str, bytes]]:
    """Yield the name and the content of each object of a log, given the names.

    Only one batch of objects is in memory at a time.
    """
    for batch_start in range(0, len(object_names), CONCURRENT_REQUESTS_MAX):
        batch = object_names[batch_start : batch_start + CONCURRENT_REQUESTS_MAX]
        yield from zip(
            batch,
            map_concurrently(path, lambda object_name: _read_log_object(path / object_name), batch),
            strict=True,
        )


def _read_log_object(log_object: ObjectPath) -> bytes:
    """Return the content of a log object. Read it again if its last line is incomplete.

    The response of the object store may have been truncated.
    """
    for _ in range(2):
        content = log_object.read_bytes()
        if content.endswith(b"\n"):
            return content
    log_object.refuse_truncated_content(content)  # else undamaged lines would count as damaged
    return content


def iter_raw_lines(path: Location) -> Iterator[bytes]:
    """Yield the lines of a log in order, with their line ends.

    In an object store a log consists of many objects. A file of lines that is a single object, such
    as the manifest, can be read as well.
    """
    if isinstance(path, ObjectPath):
        object_names = list_log_objects(path)
        if not object_names and path.size() > 0:
            yield from _read_log_object(path).splitlines(keepends=True)
        for _, content in _iter_log_objects(path, object_names):
            yield from content.splitlines(keepends=True)
    else:
        try:
            descriptor = open_regular_file(path, follow_links=False)
        except OSError as error:
            if error.errno in _MISSING_LOG_ERRNOS:
                return
            raise
        with open(descriptor, "rb") as log:
            yield from _iter_file_lines(log)


def _iter_file_lines(log: BinaryIO) -> Iterator[bytes]:
    """Yield the lines of a log file. Holes of the file are skipped.

    A line longer than `LOG_LINE_BYTES_MAX` is split.
    """
    while line := log.readline(LOG_LINE_BYTES_MAX):
        yield line
        if len(line) == LOG_LINE_BYTES_MAX:
            try:
                log.seek(os.lseek(log.fileno(), log.tell(), os.SEEK_DATA))
            except OSError:  # the rest of the file is a hole
                return


@dataclass
class ReceiptTotals:
    """Totals of the receipts in a store's log: committed blocks, computing times, recent points."""

    #: Number of points of each committed block, 0 for other blocks; (blocks,) int64.
    points_by_block: np.ndarray
    #: Stored size of each committed block [bytes], 0 if its receipt lacks it; (blocks,) int64.
    bytes_by_block: np.ndarray
    first_receipt_time: float = np.inf  # time of the first receipt [s since the epoch]
    last_receipt_time: float = -np.inf  # time of the last receipt [s since the epoch]
    n_recent_points: int = 0  # number of points committed at or after `since`
    recent_workers: set[bytes] = field(default_factory=set)  # host and process id of their workers

    @property
    def n_committed_blocks(self) -> int:
        """Number of committed blocks."""
        return int(np.count_nonzero(self.points_by_block))


def read_receipt_totals(store: Location, n_blocks: int, *, since: float = np.inf) -> ReceiptTotals:
    """Return the totals of the receipts in a store's log. Damaged lines are skipped.

    Points and workers count as recent if their receipt was written at or after ``since`` [s since
    the epoch].
    """
    totals = ReceiptTotals(np.zeros(n_blocks, np.int64), np.zeros(n_blocks, np.int64))
    for line in iter_raw_lines(store / JOURNAL_DIR / RECEIPTS_FILE):
        line_body = verified_line_body(line)
        head = line_body and _RECEIPT_HEAD_PATTERN.match(line_body)
        if not line_body or not head or (block := int(head[1])) >= n_blocks:
            continue
        totals.points_by_block[block], totals.bytes_by_block[block] = (
            int(head[2] or 0),
            int(head[3] or 0),
        )
        if head[2] and (time_match := _RECEIPT_TIME_PATTERN.search(line_body, len(line_body) - 40)):
            _add_receipt_to_totals(totals, line_body, int(head[2]), float(time_match[1]), since)
    return totals


def _add_receipt_to_totals(
    totals: ReceiptTotals, line_body: bytes, points: int, receipt_time: float, since: float
) -> None:
    """Add the time of one receipt to ``totals``, in place.

    If the time is at or after ``since``, the receipt's points and worker are added as recent.
    """
    totals.first_receipt_time, totals.last_receipt_time = (
        min(totals.first_receipt_time, receipt_time),
        max(totals.last_receipt_time, receipt_time),
    )
    if receipt_time >= since:
        totals.n_recent_points += points
        if worker := _RECEIPT_WORKER_PATTERN.search(line_body):
            totals.recent_workers.add(worker[0])
