"""A larger store in the place of the one that it was extended from.

It is made beside it, under a hidden name. Once it is complete the old one is renamed aside, the new
one is renamed into its place, and the old one is removed. Whoever is killed between any two of
these leaves a whole store under one of three names, and `finish` does the rest.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from sweep.storage.locations import Location
from sweep.tasks.errors import StoreError
from sweep.tasks.recipe import forget_older
from sweep.tasks.store import sync


def beside(path: Path) -> Path:
    """Where a store is made that is to take the place of another."""
    return path.with_name(f".{path.name}.extending")


def under_way(path: Location) -> Path | None:
    """The store that is to take the place of the one at a path, where one was begun.

    A succession that was cut short is brought to its end first.
    """
    if not isinstance(path, Path):
        return None
    finish(path)
    return beside(path) if beside(path).exists() else None


def _aside(path: Path) -> Path:
    """Where the old one is until it is removed."""
    return path.with_name(f".{path.name}.extended")


def succeed(path: Path, *, durable: bool) -> None:
    """Put the complete store beside a path in its place.

    Parameters
    ----------
    path
        The place, whose lock the caller holds.
    durable
        Whether all of the new store is to be on the disk before the old one goes.

    Raises
    ------
    StoreError
        Where it can't be renamed. `finish` tries again.
    """
    try:
        forget_older(beside(path))  # from where it stands then it extends nothing
        if durable:
            sync(beside(path))
        os.rename(path, _aside(path))
        finish(path)
    except OSError as error:
        raise StoreError(
            f"{beside(path)} can't take the place of {path}: {error.strerror or error}"
        ) from error


def finish(path: Path) -> None:
    """Do what is left of a succession that was cut short; nothing where none was."""
    if not path.exists() and _aside(path).exists():
        new = beside(path) if beside(path).exists() else _aside(path)
        os.rename(new, path)
    shutil.rmtree(_aside(path), ignore_errors=True)
