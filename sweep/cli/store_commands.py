"""Commands that read stores: status, verify, finalize, report and compare."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.filesize import decimal

from sweep.cli.terminal import (
    EXIT_INCOMPLETE,
    STORE_ARGUMENT,
    LocalPathType,
    StoreLocationType,
    echo_wrapped,
    print_accuracy,
    print_table,
    shorten_path,
)
from sweep.messages import escape_to_one_line, number_with_noun, sweep_shell_command
from sweep.storage.locations import Location, derived_files_dir, file_sizes_below

if TYPE_CHECKING:
    from sweep.analysis.answers.comparison import OpenedStore
    from sweep.tasks.studies.store_verification import VerificationReport

EXIT_DAMAGED, EXIT_DIFFERENT = 1, 4
"""Exit codes of verify for a damaged store, and of compare for different results."""

#: Largest number of damaged objects of a store that the output of verify lists.
LISTED_DAMAGED_OBJECTS_MAX = 20


@click.command()
@STORE_ARGUMENT
def status(store: Location) -> None:
    """Show the progress of STORE, also while another process computes it.

    For a study with draws, a table has the number of points within accuracy.tolerance.
    """
    from sweep.tasks.engine.progress import duration_text, point_count_text
    from sweep.tasks.studies.store_summary import status as read_status

    store_status = read_status(store)
    time_left = (
        duration_text(store_status.seconds_left) if store_status.points_per_second else "unknown"
    )
    click.echo(
        f"{escape_to_one_line(store_status.title or store)}\nstudy "
        f"{escape_to_one_line(store_status.study_id)}"
    )
    points_begun_text = (
        f", {point_count_text(store_status.points_in_unfinished_blocks)} more begun"
        if store_status.points_in_unfinished_blocks
        else ""
    )
    draws_text = (
        f", {number_with_noun(store_status.draws_done, 'draw')}" if store_status.draws_done else ""
    )
    echo_wrapped(
        f"{store_status.points_done:,} of {store_status.points:,} {store_status.points_noun}, "
        f"{store_status.blocks_done:,} of {number_with_noun(store_status.blocks, 'block')}"
        f"{points_begun_text}{draws_text}, {decimal(store_status.bytes_stored)} stored"
    )
    if store_status.points_per_second:
        rate_text = (
            f"{float(f'{store_status.points_per_second:.3g}'):,.12g} {store_status.points_noun}/s"
        )
        workers_text = (
            number_with_noun(store_status.threads_in_last_run, "thread")
            if store_status.threads_in_last_run
            else number_with_noun(store_status.workers_in_last_run, "worker")
        )
        click.echo(f"{rate_text} in the last run, by {workers_text}")
    if store_status.is_lock_holder_alive and store_status.lock_holder:
        echo_wrapped(
            f"running: process {escape_to_one_line(store_status.lock_holder.pid)} on "
            f"{escape_to_one_line(store_status.lock_holder.host)}, {time_left} left, "
            f"last heartbeat {duration_text(store_status.heartbeat_age)} ago"
        )
    elif store_status.complete:
        click.echo("complete")
    elif store_status.blocks - store_status.blocks_done == len(store_status.failures):
        click.echo("not running; all that is left has failed")
    else:
        click.echo(f"not running; {sweep_shell_command('resume', store)}  goes on.")
    _print_pending_replacement(store)
    for block, failure in sorted(store_status.failures.items()):
        echo_wrapped(
            f"block {block} failed on {escape_to_one_line(failure['host'])}: {failure['error']}"
        )
    if store_status.failures:
        retry_command = sweep_shell_command("resume", store, retry_failed=True)
        click.echo(f"{retry_command}  tries failed blocks again.")
    if store_status.blocks_done:
        print_accuracy(store, store_status.done_block_numbers)


def _print_pending_replacement(store: Location) -> None:
    """Print that a store is being extended or replaced; print nothing if it is not."""
    from sweep.storage.locations import resolve_links
    from sweep.tasks.engine.journal import EXTENDED_STORE_KEY, read_store_recipe
    from sweep.tasks.engine.progress import StoreError
    from sweep.tasks.engine.study_store import find_pending_replacement

    try:
        if staging_store := find_pending_replacement(resolve_links(store)):
            action = (
                "extended" if EXTENDED_STORE_KEY in read_store_recipe(staging_store) else "replaced"
            )
            status_command = sweep_shell_command("status", staging_store)
            click.echo(f"being {action}: {status_command}  says how far that is.")
    except StoreError as error:
        click.echo(str(error))


@click.command()
@STORE_ARGUMENT
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
    and arrays that do not belong to the store. With or without --repair, it marks damaged
    blocks, so that sweep resume computes only these, with the same bytes as before. --repair also
    restores metadata, coordinates and spec.

    \b
      sweep verify results/range_angle.zarr
      sweep verify results/range_angle.zarr --repair
      sweep verify results/range_angle.zarr --repair --spec range_angle.yaml

    Exit codes: 0 complete and undamaged, 1 damaged, 2 a mistake in the command or no store of sweep
    there, 3 undamaged but incomplete (sweep resume continues).
    """  # noqa: D301
    from sweep.spec import load
    from sweep.tasks.studies.store_verification import verify as verify_stores

    if spec_file and not repair:
        raise click.UsageError("--spec is for --repair: an undamaged store holds its own spec")
    reports = verify_stores(store, repair=repair, spec=load(spec_file) if spec_file else None)
    for report in reports:
        _print_verify_report(report)
    if not all(report.is_undamaged for report in reports):
        _print_verify_remedies(store, reports)
        sys.exit(EXIT_DAMAGED)
    if not all(report.complete for report in reports):
        click.echo(f"{sweep_shell_command('resume', store)}  goes on.", err=True)
        sys.exit(EXIT_INCOMPLETE)


@click.command()
@STORE_ARGUMENT
@click.argument("output", type=StoreLocationType(), required=False)
def finalize(store: Location, output: Location | None) -> None:
    """Copy the complete STORE into OUTPUT as few large files [NAME_final.zarr next to NAME.zarr].

    A store has a file for every array and block, so that any number of processes can write to it.
    The copy has the same values, attributes and names in files (shards) of up to 64 MB, which are
    quick to move, to list, and to open over a network. Every copied value is read back and compared
    with the original. All commands that read stores, including sweep verify, accept the copy. The
    copy cannot be resumed.

    \b
      sweep finalize results/range_angle.zarr
      sweep finalize results/range_angle.zarr s3://bucket/range_angle.zarr
    """  # noqa: D301
    from sweep.tasks.studies.store_verification import pack_store

    packed_store = pack_store(
        store, output or store.with_name(f"{store.name.removesuffix('.zarr')}_final.zarr")
    )
    file_sizes = file_sizes_below(packed_store)
    click.echo(
        f"{shorten_path(packed_store)}: {number_with_noun(len(file_sizes), 'file')}, "
        f"{decimal(sum(file_sizes.values()))}"
    )


def _print_verify_report(report: VerificationReport) -> None:
    """Print what `sweep verify` has found in a store: restored, damaged and foreign objects.

    Foreign objects are files and arrays that do not belong to the store. The number of undamaged
    blocks is printed as well.
    """
    store = shorten_path(report.store)
    for name in report.restored_objects:
        click.echo(f"{store}: {name} put back")
    for damage in report.damages[:LISTED_DAMAGED_OBJECTS_MAX]:
        block = f"block {damage.block}: " if damage.block >= 0 else ""
        echo_wrapped(f"{store}: {block}{damage.object_name} {damage.description}", err=True)
    if len(report.damages) > LISTED_DAMAGED_OBJECTS_MAX:
        click.echo(f"and {len(report.damages) - LISTED_DAMAGED_OBJECTS_MAX:,} more", err=True)
    if report.foreign_objects:
        listed_names = ", ".join(report.foreign_objects[:LISTED_DAMAGED_OBJECTS_MAX])
        omitted_text = f" and {len(report.foreign_objects) - LISTED_DAMAGED_OBJECTS_MAX:,} more"
        echo_wrapped(
            f"{store}: not sweep's, and left alone: {listed_names}"
            f"{omitted_text if len(report.foreign_objects) > LISTED_DAMAGED_OBJECTS_MAX else ''}"
        )
    if report.blocks:
        echo_wrapped(
            f"{store}: {report.undamaged_blocks:,} of {number_with_noun(report.blocks, 'block')} "
            "committed and undamaged"
        )


def _print_verify_remedies(store: Location, reports: list[VerificationReport]) -> None:
    """Print the commands that repair the reported damage."""
    for report in reports:
        if report.withdrawal_error:
            echo_wrapped(
                f"Damaged blocks are not marked for resume: {report.withdrawal_error}. "
                "Verify again when that is settled.",
                err=True,
            )
    remedies = {damage.repaired_by for report in reports for damage in report.damages}
    if "repair" in remedies:
        repair_command = sweep_shell_command("verify", store, repair=True)
        click.echo(f"{repair_command}  puts back what is not results.", err=True)
    if "resume" in remedies:
        resume_command = sweep_shell_command("resume", store)
        click.echo(f"{resume_command}  computes what is lost and mends the journal.", err=True)
    if "hand" in remedies:
        click.echo("What is no part of a store is not sweep's to remove: remove it.", err=True)


@click.command()
@STORE_ARGUMENT
@click.option(
    "--output",
    "-o",
    type=LocalPathType(dir_okay=False),
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
    from sweep.report.study_report import write_report
    from sweep.tasks.engine.progress import show_activity
    from sweep.tasks.studies.study_loading import read_study

    read_study(store)
    file = output or derived_files_dir(store) / f"{store.name.removesuffix('.zarr')}-report.html"
    with show_activity("making the page"):
        write_report(store, file)
    click.echo(f"{shorten_path(file)}: {file.stat().st_size / 1e6:.1f} MB")


@click.command()
@click.argument("a", type=StoreLocationType())
@click.argument("b", type=StoreLocationType())
@click.option(
    "--figure",
    type=LocalPathType(dir_okay=False),
    help="Draw the differences of pd into this file: .png, .pdf or .svg.",
)
def compare(a: Location, b: Location, figure: Path | None) -> None:
    """Show the differences between the studies in two stores: B less A.

    Points of two grids are matched by the values of their parameters. Shots of two flights are
    matched by scanner, time, beam, position and direction. Probabilities of detection agree if
    their difference is within the uncertainty of both studies: the half-widths over draws, and the
    errors due to skipped effects and the number of beamlets.

    Exit codes: 0 both agree wherever both are computed, 2 a mistake in the command, 3 nothing to
    compare is computed yet, 4 they differ.

    \b
      sweep compare results/range_angle.zarr results/other.zarr
      sweep compare results/a.zarr results/b.zarr --figure difference.pdf
    """  # noqa: D301
    from sweep.analysis.canvas import PICTURE_FORMATS

    if figure is not None and figure.suffix.removeprefix(".") not in PICTURE_FORMATS:
        raise click.BadParameter(
            f"{figure} ends in none of {', '.join(PICTURE_FORMATS)}", param_hint="--figure"
        )
    from sweep.tasks.engine.progress import show_activity

    with show_activity("comparing"):
        from sweep.analysis.answers import comparison
        from sweep.spec import describe_differences

        left, right = _open_store(a), _open_store(b)
        try:
            comparisons = comparison.compute_tabulated_differences(left, right)
        except ValueError as error:
            raise click.UsageError(str(error)) from None
    for line in describe_differences(left.sweep.spec, right.sweep.spec) or ["the same study"]:
        echo_wrapped(line)
    for scanner, scanner_comparison in comparisons.items():
        if scanner:
            echo_wrapped(f"{scanner}: {comparison.describe_common_shots(scanner_comparison)}")
        print_table(
            f"{b.name} less {a.name}{scanner and ', '}{scanner}",
            list(comparison.DIFFERENCE_TABLE_COLUMNS),
            comparison.difference_table_rows(scanner_comparison),
            "largest at",
        )
    if figure is not None:
        click.echo(comparison.save_difference_figure(comparisons, figure))
    agreement = comparison.agreement_verdict(comparisons.values())
    echo_wrapped(agreement.sentence)
    if code := {"different": EXIT_DIFFERENT, "nothing": EXIT_INCOMPLETE}.get(agreement.verdict, 0):
        sys.exit(code)


def _open_store(path: Location) -> OpenedStore:
    """Open the results of a store: an xarray Dataset for a grid, a DataTree for a flight."""
    from sweep.analysis.datasets import open as open_grid
    from sweep.analysis.datasets import open_scene, read_attributes_of_kind
    from sweep.storage.store_format import SCENE_STORE_KIND

    return (
        open_scene(path)
        if read_attributes_of_kind(path)["kind"] == SCENE_STORE_KIND
        else open_grid(path)
    )
