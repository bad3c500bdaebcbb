"""`sweep report`: a study as one page for a browser."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from sweep.cli.options import LocalPath, StorePath, shown
from sweep.storage.locations import Location, beside


@click.command()
@click.argument("store", type=StorePath())
@click.option(
    "--output",
    "-o",
    type=LocalPath(dir_okay=False),
    help="The page [NAME-report.html beside NAME.zarr, here for a store in an object store].",
)
def report(store: Location, output: Path | None) -> None:
    """Write the study in STORE as one page that needs no network.

    It says what was asked and simulated, has the figures to turn, cut and save, tables to sort and
    download, and how to cite and repeat the study. Any current browser opens it, from a disk or an
    e-mail. Large studies are reduced first, and the page says by how much.

    \b
      sweep report results/range_angle.zarr
      sweep report results/forest_scan.zarr -o forest.html
    """  # noqa: D301
    from sweep.report.writing import write
    from sweep.tasks.studies import read

    read(store)
    file = output or beside(store) / f"{store.name.removesuffix('.zarr')}-report.html"
    with bar("opening the store") as say:
        write(store, file, say)
    click.echo(f"{shown(file)}: {file.stat().st_size / 1e6:.1f} MB")


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
    from dask.callbacks import Callback
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

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
