"""Files that users and other programs have put into the folder of a store.

They are listed, and never removed: where another store takes the place of this one, they move
into it. A store's document and its list of objects name its arrays. Their metadata and chunks, and
the files of the journal, are sweep's; all else is foreign.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path

from sweep.documents import parse_json
from sweep.plain_files import read_below
from sweep.storage.chunks import DOCUMENT_BYTES_MAX

#: Files that programs leave in any folder; nobody misses them.
LITTER = (
    ".DS_Store", "._*", ".snakemake_timestamp", ".nfs*", ".fuse_hidden*", ".directory",
    "Thumbs.db", "desktop.ini",
)  # fmt: skip

_JOURNAL = ".sweep"
_JOURNAL_FILES = re.compile(
    r"(receipts|failures|sessions|template)\.jsonl|recipe\.json|partial|begun-\d+|"
    r"lock(\.guard|\.[0-9a-f]{32})?|clock-\d+-[0-9a-f]{8}"
)
_DRAFT = re.compile(r".+\.[0-9a-f]{32}\.partial")


def is_litter(name: str) -> bool:
    """Tell whether a file is one that programs leave everywhere.

    >>> is_litter(".DS_Store"), is_litter("pd_up/.nfs000000000123"), is_litter("notes.txt")
    (True, True, False)
    """
    last = name.rstrip("/").rpartition("/")[2]
    return any(fnmatch(last, pattern) for pattern in LITTER)


def is_draft(name: str) -> bool:
    """Tell whether a file is one that sweep had not finished writing."""
    return bool(_DRAFT.fullmatch(name))


def foreign_names(store: Path) -> list[str]:
    """Names of what is in the folder of a store and not sweep's; of folders with a slash behind."""
    nodes = _nodes(store)
    return sorted(_foreign(store, "", nodes, {*nodes, *_groups(nodes)}))


def _nodes(store: Path) -> set[str]:
    """Arrays and groups that a store was made with, as far as it still says so."""
    nodes: set[str] = set()
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
        document = parse_json(read_below(store, "zarr.json", DOCUMENT_BYTES_MAX))
        nodes |= set(document["consolidated_metadata"]["metadata"])
    with suppress(OSError):
        listed = read_below(store, f"{_JOURNAL}/template.jsonl", DOCUMENT_BYTES_MAX)
        for line in listed.splitlines():
            with suppress(ValueError, TypeError, AttributeError):
                name = str(parse_json(line).get("object", ""))
                if name.endswith("/zarr.json"):
                    nodes.add(name.removesuffix("/zarr.json"))
    if not nodes:  # spectra, and what has lost both
        nodes |= {path.parent.name for path in store.glob("*/zarr.json")}
    return nodes


def _groups(nodes: set[str]) -> Iterator[str]:
    """Return the groups that nodes lie in."""
    for node in nodes:
        while node := node.rpartition("/")[0]:
            yield node


def _foreign(folder: Path, inside: str, nodes: set[str], folders: set[str]) -> Iterator[str]:
    with os.scandir(folder) as entries:
        for entry in entries:
            name, is_folder = inside + entry.name, entry.is_dir(follow_symlinks=False)
            if name == _JOURNAL:
                yield from _foreign_in_journal(entry.path) if is_folder else ()
            elif entry.name == "c" and inside.rstrip("/") in nodes:
                yield from _foreign_among_chunks(entry.path, f"{name}/") if is_folder else ()
            elif name in folders:  # a link in its place is damage, and no file of the user's
                within = _foreign(Path(entry.path), f"{name}/", nodes, folders)
                yield from within if is_folder else ()
            elif is_folder or not (entry.name == "zarr.json" or is_draft(entry.name)):
                yield f"{name}/" if is_folder else name


def _foreign_in_journal(folder: str) -> Iterator[str]:
    with os.scandir(folder) as entries:
        for entry in entries:
            if not (_JOURNAL_FILES.fullmatch(entry.name) or is_draft(entry.name)):
                slash = "/" if entry.is_dir(follow_symlinks=False) else ""
                yield f"{_JOURNAL}/{entry.name}{slash}"


def _foreign_among_chunks(folder: str, inside: str) -> Iterator[str]:
    with os.scandir(folder) as entries:
        for entry in entries:
            is_folder = entry.is_dir(follow_symlinks=False)
            if not entry.name.isdecimal():
                if is_folder or not entry.name.endswith(".partial"):
                    yield f"{inside}{entry.name}{'/' if is_folder else ''}"
            elif is_folder:
                yield from _foreign_among_chunks(entry.path, f"{inside}{entry.name}/")


def carry_over(old: Path, new: Path) -> None:
    """Move what is foreign in a folder to the one that takes its place; OSError where it can't.

    A file whose name is taken there gets a number behind its name.
    """
    if not old.is_dir() or old.is_symlink():
        return
    for name in foreign_names(old):
        if is_litter(name):
            continue
        target = new / name
        number = 1
        while os.path.lexists(target):
            target = (new / name).with_name(f"{Path(name).name}.{number}")
            number += 1
        target.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # another process has moved it
            os.rename(old / name, target)
