"""Blocks that have all of their chunks, from listings of a store's folders: one look a folder.

A file's size is asked of the operating system one by one, some 3 us each: 27 arrays of a million
blocks take more than a minute. So the look goes on in threads, beside what else there is to do;
its memory is a few bytes a block.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path

import numpy as np

from sweep.storage.locations import REQUESTS, Location
from sweep.storage.objects import ObjectPath
from sweep.tasks.study import Study

#: Folders on disk that are listed at once: on a file server each is mostly waiting.
THREADS = 4


class Look:
    """A look at the chunks of some blocks, begun as it is made.

    Parameters
    ----------
    path, study
        The store and the study that it holds.
    among : ndarray of bool (blocks,)
        Which blocks to look at.
    """

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
        """Wait no longer than that, and tell whether the look is over."""
        return not wait(self._arrays, seconds).not_done

    def whole(self) -> np.ndarray:
        """Blocks that lack nothing as far as was looked, (blocks,) bool.

        Raises
        ------
        OSError
            Where a folder can't be read.
        """
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
    """Mark those of some blocks that have every object in the store, with bytes in it, (blocks,).

    The parameters are those of :class:`Look`.
    """
    look = Look(path, study, among)
    try:
        look.within()
        return look.whole()
    finally:
        look.stop()


def chunks_there(folder: Location, shape: tuple[int, ...]) -> np.ndarray:
    """Mark the chunks of an array that hold something, in the shape of its grid of them."""
    there = np.zeros(shape, bool)
    if isinstance(folder, ObjectPath):
        for position, size in _keys(folder, shape):
            there[position] = size > 0
    elif shape:
        _look(folder, there)
    else:
        with suppress(FileNotFoundError):
            there[()] = _is_chunk(folder.stat())
    return there


def _is_chunk(found: os.stat_result) -> bool:
    """True for a file with something in it; a directory in a chunk's place has a size, too."""
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
    """Note the chunks in a folder and those below it.

    Parameters
    ----------
    folder
        Its path, or its name in the folder `within`, which is open: a file's path is then short.
    there : ndarray of bool
        Where to note them.
    within
        Descriptor.
    """
    try:
        opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY, dir_fd=within)
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
                    there[at] = _is_chunk(entry.stat())
    finally:
        os.close(opened)
