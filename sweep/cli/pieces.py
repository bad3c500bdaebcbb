"""A bar for what Dask reads and reduces, step by step, with the time that is left of a step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from dask.callbacks import Callback
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn


@contextmanager
def bar(begin: str) -> Iterator[Callable[[str], None]]:
    """A bar on standard error while its block runs; gone at its end.

    Parameters
    ----------
    begin
        What is being done at first.

    Yields
    ------
    callable
        Is told what is being done next.
    """
    columns = SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        step = progress.add_task(begin, total=None)

        def say(text: str) -> None:
            nonlocal step
            progress.remove_task(step)  # a task that has a total cannot lose it
            step = progress.add_task(f"making: {text}", total=None)

        def started(graph: Mapping[Any, Any], state: Mapping[str, Any]) -> None:
            progress.reset(step, total=len(state["waiting"]) + len(state["ready"]))

        def done(*of_task: Any) -> None:
            progress.advance(step)

        with Callback(start_state=started, posttask=done):
            yield say
