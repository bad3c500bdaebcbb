"""What `sweep accuracy` prints."""

from __future__ import annotations

import sys

import click

from sweep.cli.telling import INCOMPLETE, print_table
from sweep.storage.locations import Location


def conclude_accuracy(store: Location, *, measured: bool) -> tuple[list[Location], bool]:
    """Print what settings came to, and draw it: the files, and whether it was not interrupted.

    Leaves with the exit code of what is incomplete where nothing was measured.
    """
    if not measured:
        click.echo("Interrupted before any point was through: nothing is kept.", err=True)
        sys.exit(INCOMPLETE)
    from sweep.analysis.accuracy import report, text

    dataset, settings = report.opened(store)
    print_table(
        "Time a point; errors of pd (at 90 %, largest), log10 pfa, peak magnitude; leakage",
        list(text.SHORT), text.short_rows(settings), "setting",
    )  # fmt: skip
    print_table(
        "Cheapest setting for each error", list(text.CHEAPEST), text.cheapest_rows(settings),
        "cheapest setting",
    )  # fmt: skip
    for sentence in text.sentences(dataset, settings):
        click.echo(sentence)
    return [store, *report.draw(store)], dataset.attrs["stopped"] != "interrupted"
