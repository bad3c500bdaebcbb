"""`sweep report`: a study as one page for a browser."""

from __future__ import annotations

from pathlib import Path

import click

from sweep.cli.places import LocalPath, StorePath, shown
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
    from sweep.cli.pieces import bar
    from sweep.report.writing import write
    from sweep.tasks.studies import read

    read(store)
    file = output or beside(store) / f"{store.name.removesuffix('.zarr')}-report.html"
    with bar("opening the store") as say:
        write(store, file, say)
    click.echo(f"{shown(file)}: {file.stat().st_size / 1e6:.1f} MB")
