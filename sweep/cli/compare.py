"""`sweep compare`: what differs between two studies, and whether that is more than is known."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sweep.cli.options import LocalPath, StorePath
from sweep.cli.telling import INCOMPLETE, print_table
from sweep.storage.locations import Location

if TYPE_CHECKING:
    from sweep.analysis.answers.comparison_table import Store

DIFFERENT = 4


@click.command()
@click.argument("a", type=StorePath())
@click.argument("b", type=StorePath())
@click.option(
    "--figure",
    type=LocalPath(dir_okay=False),
    help="Draw the differences of pd into this file: .png, .pdf or .svg.",
)
def compare(a: Location, b: Location, figure: Path | None) -> None:
    """Say what differs between the studies in two stores A and B, and by how much: B less A.

    Points of grids are matched by the values of their parameters, shots of flights by scanner,
    time, beam, position and direction. Probabilities of detection agree where they differ by no
    more than is known of both: half-widths of what is drawn, and what effects and beamlets that
    were left out may change.

    Exit codes: 0 they agree wherever both are computed, 2 a mistake in what was asked, 3 nothing
    to compare is computed yet, 4 they differ.

    \b
      sweep compare results/range_angle.zarr results/other.zarr
      sweep compare results/a.zarr results/b.zarr --figure difference.pdf
    """  # noqa: D301
    from sweep.analysis.canvas import FORMATS

    if figure is not None and figure.suffix.removeprefix(".") not in FORMATS:
        raise click.BadParameter(
            f"{figure} ends in none of {', '.join(FORMATS)}", param_hint="--figure"
        )
    from sweep.analysis.answers import comparison_table
    from sweep.spec import difference
    from sweep.tasks.progress import working

    left, right = _opened(a), _opened(b)
    try:
        with working("comparing"):
            compared = comparison_table.compared(left, right)
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    for line in difference(left.sweep.spec, right.sweep.spec) or ["the same study"]:
        click.echo(line)
    for scanner, found in compared.items():
        if scanner:
            click.echo(f"{scanner}: {comparison_table.met(found)}")
        print_table(
            f"{b.name} less {a.name}{scanner and ', '}{scanner}",
            list(comparison_table.COLUMNS),
            comparison_table.rows(found),
            "largest at",
        )
    if figure is not None:
        from sweep.analysis.answers import comparison_figure

        click.echo(comparison_figure.save(compared, figure))
    verdict, words = comparison_table.verdict(compared.values())
    click.echo(words)
    if code := {"different": DIFFERENT, "nothing": INCOMPLETE}.get(verdict, 0):
        sys.exit(code)


def _opened(path: Location) -> Store:
    """A store of a grid as a dataset, of a flight as a tree."""
    from sweep.analysis.opening import SCENE, read_attributes
    from sweep.analysis.opening import open as open_grid
    from sweep.analysis.scenes.opening import open_scene

    return open_scene(path) if read_attributes(path)["kind"] == SCENE else open_grid(path)
