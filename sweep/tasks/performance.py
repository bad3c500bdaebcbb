"""Dask's own account of a run: tasks over time, transfers, profiles, as one page for a browser."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from distributed import Client


@contextmanager
def reported(client: Client, file: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Write a performance report of what a cluster does meanwhile.

    Parameters
    ----------
    client
        Of the cluster.
    file
        The page. That it can't be written is said, and no reason to fail.
    say
        Takes what became of it.
    """
    from distributed import performance_report

    report = performance_report(filename=str(file))
    with client.as_current():
        report.__enter__()
    try:
        yield
    finally:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            with client.as_current():
                report.__exit__(None, None, None)
            say(f"performance report: {file}")
        except Exception as error:  # the scheduler may be gone, and with it what it knew
            say(f"no performance report: {error}")
