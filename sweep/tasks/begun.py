"""Blocks that are computed in pieces: what there is of each, kept in the journal till it is done.

A worker draws for some seconds, saves what it has, and whoever takes up the block next goes on from
there, to the same bytes. What is saved carries a digest: a file that is damaged, cut short or of
another block counts as absent, and its draws are taken again.
"""

from __future__ import annotations

import hashlib
import io
from typing import Any, NamedTuple

import numpy as np

from sweep.storage.locations import JOURNAL, Location, put_whole
from sweep.storage.logs import sealed, unsealed
from sweep.tasks.study import Found, Known

#: Beginning of the names of files in the journal, each of one block.
PREFIX = "begun-"


class Begun(NamedTuple):
    """The saved part of a block."""

    known: Known = Known()
    points: float = 0.0
    """That this comes to; a point that is drawn in part counts in part."""
    seconds: float = 0.0
    """Spent on it."""


def write(path: Location, study_id: str, block: int, begun: Begun) -> None:
    """Save what there is of a block, in the place of less.

    Raises
    ------
    OSError
        Where it can't be written.
    """
    if read(path, study_id, block).points >= begun.points:
        return  # another worker, that was thought to be lost, was quicker
    buffer = io.BytesIO()
    np.savez(buffer, **dict(_arrays(begun.known)))
    content = buffer.getvalue()
    head = {
        "study": study_id, "block": block, "points": begun.points, "seconds": begun.seconds,
        "digest": _digest(content),
    }  # fmt: skip
    put_whole(_file(path, block), sealed(head) + content)


def read(path: Location, study_id: str, block: int) -> Begun:
    """The saved part of a block of a study."""
    try:
        line, _, content = _file(path, block).read_bytes().partition(b"\n")
    except (FileNotFoundError, NotADirectoryError):
        return Begun()
    head = unsealed(line + b"\n") or {}
    if (head.get("study"), head.get("block")) != (study_id, block):
        return Begun()
    if head["digest"] != _digest(content):
        return Begun()
    found: dict[str, dict[str, np.ndarray]] = {"done": {}, "begun": {}}
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        for key, values in arrays.items():
            part, _, name = key.partition("/")
            found[part][name] = values
    known = Known(**{part: Found(each.pop("points"), each) for part, each in found.items()})
    return Begun(known, head["points"], head["seconds"])


def begun_points(path: Location, study_id: str) -> dict[int, float]:
    """Points that there are, in part, of blocks that are begun."""
    numbers = [file.name.removeprefix(PREFIX) for file in (path / JOURNAL).glob(f"{PREFIX}*")]
    found = {int(each): read(path, study_id, int(each)) for each in numbers if each.isdecimal()}
    return {block: begun.points for block, begun in found.items() if begun.points}


def discard(path: Location, block: int | str = "*") -> None:
    """Remove what there is of a block, or of all."""
    for file in (path / JOURNAL).glob(f"{PREFIX}{block}"):
        file.unlink(missing_ok=True)


def _file(path: Location, block: int) -> Location:
    return path / JOURNAL / f"{PREFIX}{block}"


def _arrays(known: Known) -> dict[str, Any]:
    return {
        f"{part}/{name}": values
        for part, (points, results) in known._asdict().items()
        for name, values in {"points": points, **results}.items()
    }


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=16).hexdigest()
