"""Foreign files: files that users and other programs have put into the folder of a store.

Foreign files are listed and never deleted. If another store replaces this one, they are moved into
the new store. The root document of a store and its manifest name the arrays of the store. The
metadata and chunks of these arrays, and the files of the journal, belong to sweep. Everything else
is foreign.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path

from sweep.regular_files import read_file_below_root
from sweep.safe_json import parse_json
from sweep.storage.size_checks import METADATA_BYTES_MAX

#: Patterns of files that operating systems and file managers leave in any folder.
IGNORABLE_FILE_PATTERNS = (
    ".DS_Store", "._*", ".snakemake_timestamp", ".nfs*", ".fuse_hidden*", ".directory",
    "Thumbs.db", "desktop.ini",
)  # fmt: skip

_JOURNAL_DIR = ".sweep"
_JOURNAL_FILE_NAME_PATTERN = re.compile(
    r"(receipts|failures|sessions|template)\.jsonl|recipe\.json|partial|begun-\d+|"
    r"lock(\.guard|\.[0-9a-f]{32})?|clock-\d+-[0-9a-f]{8}"
)
"""Pattern of the names of the files that sweep writes into a journal."""

_DRAFT_FILE_NAME_PATTERN = re.compile(r".+\.[0-9a-f]{32}\.partial")
"""Pattern of the names of drafts: files whose writing was interrupted or is under way."""


def is_ignorable_file(name: str) -> bool:
    """Return True if a file's name shows that an operating system or a file manager left it.

    >>> is_ignorable_file(".DS_Store"), is_ignorable_file("pd_up/.nfs000000000123")
    (True, True)
    >>> is_ignorable_file("notes.txt")
    False
    """
    base_name = name.rstrip("/").rpartition("/")[2]
    return any(fnmatch(base_name, pattern) for pattern in IGNORABLE_FILE_PATTERNS)


def is_draft_file(name: str) -> bool:
    """Return True if a file's name shows that sweep has not finished writing the file (a draft)."""
    return bool(_DRAFT_FILE_NAME_PATTERN.fullmatch(name))


def list_foreign_files(store: Path) -> list[str]:
    """Return relative paths, sorted, of a store's foreign files and folders (not made by sweep).

    The path of a folder ends in a slash, and stands for all of the folder's content.
    """
    node_names = _read_zarr_node_names(store)
    return sorted(
        _iter_foreign_files(store, "", node_names, {*node_names, *_iter_parent_groups(node_names)})
    )


def _read_zarr_node_names(store: Path) -> set[str]:
    """Return the names of a store's arrays and groups, from whatever metadata can be read."""
    node_names: set[str] = set()
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
        root_metadata = parse_json(read_file_below_root(store, "zarr.json", METADATA_BYTES_MAX))
        node_names |= set(root_metadata["consolidated_metadata"]["metadata"])
    with suppress(OSError):
        manifest = read_file_below_root(store, f"{_JOURNAL_DIR}/template.jsonl", METADATA_BYTES_MAX)
        for line in manifest.splitlines():
            with suppress(ValueError, TypeError, AttributeError):
                object_name = str(parse_json(line).get("object", ""))
                if object_name.endswith("/zarr.json"):
                    node_names.add(object_name.removesuffix("/zarr.json"))
    if not node_names:  # stores of spectra, and stores that have lost both documents
        node_names |= {path.parent.name for path in store.glob("*/zarr.json")}
    return node_names


def _iter_parent_groups(node_names: set[str]) -> Iterator[str]:
    """Yield, for each array or group, the names of all groups that contain it."""
    for node in node_names:
        while node := node.rpartition("/")[0]:
            yield node


def _iter_foreign_files(
    folder: Path, prefix: str, node_names: set[str], known_folders: set[str]
) -> Iterator[str]:
    """Yield relative paths of foreign files and folders (not made by sweep) below a folder.

    All paths are relative to the store. `prefix` is that of `folder`, with a slash at the end.
    `known_folders` are the names of arrays, and of groups that contain arrays.
    """
    with os.scandir(folder) as entries:
        for entry in entries:
            name, is_folder = prefix + entry.name, entry.is_dir(follow_symlinks=False)
            if name == _JOURNAL_DIR:
                yield from _iter_foreign_journal_files(entry.path) if is_folder else ()
            elif entry.name == "c" and prefix.rstrip("/") in node_names:
                yield from _iter_foreign_chunk_files(entry.path, f"{name}/") if is_folder else ()
            elif name in known_folders:  # a link instead of the folder is damage, not foreign
                nested_foreign_files = _iter_foreign_files(
                    Path(entry.path), f"{name}/", node_names, known_folders
                )
                yield from nested_foreign_files if is_folder else ()
            elif is_folder or not (entry.name == "zarr.json" or is_draft_file(entry.name)):
                yield f"{name}/" if is_folder else name


def _iter_foreign_journal_files(folder: str) -> Iterator[str]:
    with os.scandir(folder) as entries:
        for entry in entries:
            if not (_JOURNAL_FILE_NAME_PATTERN.fullmatch(entry.name) or is_draft_file(entry.name)):
                slash = "/" if entry.is_dir(follow_symlinks=False) else ""
                yield f"{_JOURNAL_DIR}/{entry.name}{slash}"


def _iter_foreign_chunk_files(folder: str, prefix: str) -> Iterator[str]:
    """Yield relative paths of foreign files (not made by sweep) among an array's chunk files.

    All paths are relative to the store. `prefix` is that of `folder`, with a slash at the end.
    """
    with os.scandir(folder) as entries:
        for entry in entries:
            is_folder = entry.is_dir(follow_symlinks=False)
            if not entry.name.isdecimal():
                if is_folder or not entry.name.endswith(".partial"):
                    yield f"{prefix}{entry.name}{'/' if is_folder else ''}"
            elif is_folder:
                yield from _iter_foreign_chunk_files(entry.path, f"{prefix}{entry.name}/")


def move_foreign_files(old_store: Path, new_store: Path) -> None:
    """Move foreign files (not made by sweep) from a store to the store that replaces it.

    If the new store already has a file of the same path, a number is appended to the name. OSError
    is raised if a file can't be moved.
    """
    if not old_store.is_dir() or old_store.is_symlink():
        return
    for name in list_foreign_files(old_store):
        if is_ignorable_file(name):
            continue
        target = new_store / name
        suffix_number = 1
        while os.path.lexists(target):
            target = (new_store / name).with_name(f"{Path(name).name}.{suffix_number}")
            suffix_number += 1
        target.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # another process has already moved it
            os.rename(old_store / name, target)
