"""Errors of stores and clusters, worded for who runs studies."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sweep.storage.opening import StoreError as StoreError


class TaskError(Exception):
    """A study that can't be run as asked: the text says why and what to do."""


class BusyError(StoreError):
    """A store that another process writes to."""


class ClusterError(TaskError):
    """A scheduler or workers that can't be had."""


class CodeError(TaskError):
    """A function of the user's that may not run, can't be imported, or answers wrongly."""


class SchedulerLost(Exception):
    """A scheduler that went away with work still out; what was committed stays."""


@contextmanager
def told(what: str) -> Iterator[None]:
    """Say what can't be done where the disk, or an object store, raises."""
    try:
        yield
    except OSError as error:
        raise StoreError(f"{what}: {error.strerror or error}") from error
