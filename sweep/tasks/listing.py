"""Which blocks are whole, from listings of a store's folders: one look a folder, not one a file.

Memory is a few bytes a block, however many there are.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from sweep.storage.locations import Location, each
from sweep.storage.objects import ObjectPath
from sweep.tasks.study import Study


class Listed(NamedTuple):
    """What folders show of a store."""

    whole: np.ndarray
    """(blocks,) bool: blocks that have every object in the store, and bytes in it."""
    bytes: int
    """Of all chunks, as they are stored."""


def listed(path: Location, study: Study, among: np.ndarray) -> Listed:
    """What is there of a study's chunks.

    Parameters
    ----------
    path, study
        The store and the study that it holds.
    among : ndarray of bool (blocks,)
        Which blocks to look at.
    """
    found, total = among.copy(), 0
    if not found.any():
        return Listed(found, total)
    owners = study.owners()

    def sizes(name: str) -> np.ndarray:
        return chunk_sizes(path / name / "c", owners[name].shape)

    names = list(owners)
    step = len(names) if isinstance(path, ObjectPath) else 1  # one array's listing at a time
    for start in range(0, len(names), step):
        some = names[start : start + step]
        for name, size in zip(some, each(path, sizes, some), strict=True):
            found[owners[name][size == 0]] = False
            total += int(size.sum())
    return Listed(found, total)


def chunk_sizes(folder: Location, shape: tuple[int, ...]) -> np.ndarray:
    """Bytes of the chunks of an array, in the shape of its grid of chunks; 0 of those not there."""
    sizes = np.zeros(shape, np.int64)
    if isinstance(folder, ObjectPath):
        for position, size in _keys(folder, shape):
            sizes[position] = size
    elif shape:
        _look(str(folder), sizes)
    else:
        with suppress(FileNotFoundError):
            sizes[()] = folder.stat().st_size
    return sizes


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


def _look(folder: str, sizes: np.ndarray) -> None:
    """Note the sizes of the chunks in a folder and those below it."""
    with suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder) as entries:
        for entry in entries:
            name = entry.name
            if not name.isdecimal() or (at := int(name)) >= len(sizes):
                continue
            if sizes.ndim > 1:
                _look(entry.path, sizes[at])
            else:
                sizes[at] = entry.stat().st_size
