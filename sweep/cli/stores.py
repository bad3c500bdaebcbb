"""Commands that look at stores: how far one is, whether every byte is as it was, a page of it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.filesize import decimal

from sweep.cli.terminal import (
    INCOMPLETE,
    STORE,
    LocalPath,
    StorePath,
    print_table,
    shown,
    tell,
    tell_accuracy,
)
from sweep.messages import command_line, counted, one_line
from sweep.storage.locations import Location, beside, files_below

if TYPE_CHECKING:
    from sweep.analysis.answers.comparison import Store
    from sweep.tasks.verify import Report

DAMAGED, DIFFERENT = 1, 4

#: Damaged objects of one store that are listed.
MOST_LISTED = 20


@click.command()
@STORE
def status(store: Location) -> None:
    """Show the progress of STORE, also while another process computes it.

    For a study with draws, a table has the number of points within accuracy.tolerance.
    """
    from sweep.tasks.progress import amount, duration
    from sweep.tasks.summary import status as read

    s = read(store)
    left = duration(s.left) if s.rate else "unknown"
    click.echo(f"{one_line(s.title or store)}\nstudy {one_line(s.study_id)}")
    drawn = f", {counted(s.draws_done, 'draw')}" if s.draws_done else ""
    tell(
        f"{s.points_done:,} of {s.points:,} {s.unit}, {s.blocks_done:,} of "
        f"{counted(s.blocks, 'block')}"
        f"{f', {amount(s.points_begun)} more begun' if s.points_begun else ''}"
        f"{drawn}, {decimal(s.bytes)} stored"
    )
    if s.rate:
        rate = f"{float(f'{s.rate:.3g}'):,.12g} {s.unit}/s"
        click.echo(f"{rate} in the last run, by {counted(s.workers, 'worker')}")
    if s.holder_lives and s.holder:
        tell(
            f"running: process {one_line(s.holder.pid)} on {one_line(s.holder.host)}, {left} left, "
            f"last heartbeat {duration(s.heartbeat)} ago"
        )
    elif s.complete:
        click.echo("complete")
    elif s.blocks - s.blocks_done == len(s.failures):
        click.echo("not running; all that is left has failed")
    else:
        click.echo(f"not running; {command_line('resume', store)}  goes on.")
    _tell_what_is_under_way(store)
    for block, failure in sorted(s.failures.items()):
        tell(f"block {block} failed on {one_line(failure['host'])}: {failure['error']}")
    if s.failures:
        retry = command_line("resume", store, retry_failed=True)
        click.echo(f"{retry}  tries failed blocks again.")
    if s.blocks_done:
        tell_accuracy(store, s.done)


def _tell_what_is_under_way(store: Location) -> None:
    from sweep.storage.locations import real
    from sweep.tasks.journal import EXTENDS, read_recipe
    from sweep.tasks.progress import StoreError
    from sweep.tasks.store import under_way

    try:
        if new := under_way(real(store)):
            what = "extended" if EXTENDS in read_recipe(new) else "replaced"
            click.echo(f"being {what}: {command_line('status', new)}  says how far that is.")
    except StoreError as error:
        click.echo(str(error))


@click.command()
@STORE
@click.option(
    "--repair",
    is_flag=True,
    help="Restore metadata, coordinates and spec; sweep resume computes blocks.",
)
@click.option(
    "--spec",
    "spec_file",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="With --repair: the study's spec, if the store's own spec is damaged.",
)
def verify(store: Location, repair: bool, spec_file: Path | None) -> None:
    """Check every byte of STORE against the digests stored with it.

    The command names every object with a flipped, missing or surplus byte: results block by block,
    metadata, coordinates, the spec, the journal, and the eyepoints of a flight. It also names files
    and arrays that do not belong to the store. It marks damaged blocks, so that sweep resume
    computes only these, with the same bytes as before.

    \b
      sweep verify results/range_angle.zarr
      sweep verify results/range_angle.zarr --repair
      sweep verify results/range_angle.zarr --repair --spec range_angle.yaml

    Exit codes: 0 complete and undamaged, 1 damaged, 2 a mistake in the command or no store of sweep
    there, 3 undamaged but incomplete (sweep resume continues).
    """  # noqa: D301
    from sweep.spec import load
    from sweep.tasks.verify import verify as check

    if spec_file and not repair:
        raise click.UsageError("--spec is for --repair: what is whole says itself what it holds")
    reports = check(store, repair=repair, spec=load(spec_file) if spec_file else None)
    for report in reports:
        _tell(report)
    if not all(report.sound for report in reports):
        _say_what_to_do(store, reports)
        sys.exit(DAMAGED)
    if not all(report.complete for report in reports):
        click.echo(f"{command_line('resume', store)}  goes on.", err=True)
        sys.exit(INCOMPLETE)


@click.command()
@STORE
@click.argument("output", type=StorePath(), required=False)
def finalize(store: Location, output: Location | None) -> None:
    """Copy the complete STORE into OUTPUT as few large files [NAME_final.zarr next to NAME.zarr].

    A store has a file for every array and block, so that any number of processes can write it. The
    copy has the same values, attributes and names in files (shards) of up to 64 MB. These are quick
    to move, to list, and to open over a network. Every value is read back and compared. All
    commands that read stores, and sweep verify, accept the copy. It cannot be resumed.

    \b
      sweep finalize results/range_angle.zarr
      sweep finalize results/range_angle.zarr s3://bucket/range_angle.zarr
    """  # noqa: D301
    from sweep.tasks.verify import pack

    made = pack(store, output or store.with_name(f"{store.name.removesuffix('.zarr')}_final.zarr"))
    files = files_below(made)
    click.echo(f"{shown(made)}: {counted(len(files), 'file')}, {decimal(sum(files.values()))}")


def _tell(report: Report) -> None:
    store = shown(report.store)
    for name in report.restored:
        click.echo(f"{store}: {name} put back")
    for damage in report.damages[:MOST_LISTED]:
        block = f"block {damage.block}: " if damage.block >= 0 else ""
        tell(f"{store}: {block}{damage.object} {damage.what}", err=True)
    if len(report.damages) > MOST_LISTED:
        click.echo(f"and {len(report.damages) - MOST_LISTED:,} more", err=True)
    if report.foreign:
        named = ", ".join(report.foreign[:MOST_LISTED])
        more = f" and {len(report.foreign) - MOST_LISTED:,} more"
        tell(
            f"{store}: not sweep's, and left alone: {named}"
            f"{more if len(report.foreign) > MOST_LISTED else ''}"
        )
    if report.blocks:
        tell(
            f"{store}: {report.whole:,} of {counted(report.blocks, 'block')} committed "
            "and undamaged"
        )


def _say_what_to_do(store: Location, reports: list[Report]) -> None:
    """Print what mends what was found."""
    for report in reports:
        if report.unmarked:
            tell(
                f"Damaged blocks are not marked for resume: {report.unmarked}. "
                "Verify again when that is settled.",
                err=True,
            )
    found = {damage.mended_by for report in reports for damage in report.damages}
    if "repair" in found:
        repair = command_line("verify", store, repair=True)
        click.echo(f"{repair}  puts back what is not results.", err=True)
    if "resume" in found:
        resume = command_line("resume", store)
        click.echo(f"{resume}  computes what is lost and mends the journal.", err=True)
    if "hand" in found:
        click.echo("What is no part of a store is not sweep's to remove: remove it.", err=True)


@click.command()
@STORE
@click.option(
    "--output",
    "-o",
    type=LocalPath(dir_okay=False),
    help="The page [NAME-report.html next to NAME.zarr, here for an object store].",
)
def report(store: Location, output: Path | None) -> None:
    """Write the study in STORE as one page that opens without a network.

    The page states the question, the simulation and how to cite and repeat it. It has figures to
    turn, cut and save, and tables to sort and download. Any current browser opens the page, from a
    disk or an e-mail. Large studies are reduced first, and the page says by how much.

    \b
      sweep report results/range_angle.zarr
      sweep report results/forest_scan.zarr -o forest.html
    """  # noqa: D301
    from sweep.report.writing import write
    from sweep.tasks.progress import working
    from sweep.tasks.studies import read

    read(store)
    file = output or beside(store) / f"{store.name.removesuffix('.zarr')}-report.html"
    with working("making the page"):
        write(store, file)
    click.echo(f"{shown(file)}: {file.stat().st_size / 1e6:.1f} MB")


@click.command()
@click.argument("a", type=StorePath())
@click.argument("b", type=StorePath())
@click.option(
    "--figure",
    type=LocalPath(dir_okay=False),
    help="Draw the differences of pd into this file: .png, .pdf or .svg.",
)
def compare(a: Location, b: Location, figure: Path | None) -> None:
    """Show the differences between the studies in two stores: B less A.

    Points of grids are matched by the values of their parameters, shots of flights by scanner,
    time, beam, position and direction. Probabilities of detection agree if their difference is
    within the uncertainty of both: the half-widths of draws, and the errors of skipped effects and
    few beamlets.

    Exit codes: 0 both agree wherever both are computed, 2 a mistake in the command, 3 nothing to
    compare is computed yet, 4 they differ.

    \b
      sweep compare results/range_angle.zarr results/other.zarr
      sweep compare results/a.zarr results/b.zarr --figure difference.pdf
    """  # noqa: D301
    from sweep.analysis.canvas import FORMATS

    if figure is not None and figure.suffix.removeprefix(".") not in FORMATS:
        raise click.BadParameter(
            f"{figure} ends in none of {', '.join(FORMATS)}", param_hint="--figure"
        )
    from sweep.tasks.progress import working

    with working("comparing"):
        from sweep.analysis.answers import comparison
        from sweep.spec import difference

        left, right = _opened(a), _opened(b)
        try:
            compared = comparison.compared(left, right)
        except ValueError as error:
            raise click.UsageError(str(error)) from None
    for line in difference(left.sweep.spec, right.sweep.spec) or ["the same study"]:
        tell(line)
    for scanner, found in compared.items():
        if scanner:
            tell(f"{scanner}: {comparison.met(found)}")
        print_table(
            f"{b.name} less {a.name}{scanner and ', '}{scanner}",
            list(comparison.COLUMNS),
            comparison.rows(found),
            "largest at",
        )
    if figure is not None:
        click.echo(comparison.save_figure(compared, figure))
    verdict, words = comparison.verdict(compared.values())
    tell(words)
    if code := {"different": DIFFERENT, "nothing": INCOMPLETE}.get(verdict, 0):
        sys.exit(code)


def _opened(path: Location) -> Store:
    """Return a store of a grid as a dataset, of a flight as a tree."""
    from sweep.analysis.opening import SCENE, open_scene, read_attributes
    from sweep.analysis.opening import open as open_grid

    return open_scene(path) if read_attributes(path)["kind"] == SCENE else open_grid(path)
