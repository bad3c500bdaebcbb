"""Terminal interface of the commands: shared options, plans before a run, tables after a run."""

from __future__ import annotations

import math
import os
import re
import shutil
import sys
import textwrap
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from click.shell_completion import CompletionItem
from rich.filesize import decimal

from sweep.messages import (
    EXIT_INCOMPLETE,
    EXIT_MISTAKE,
    escape_to_one_line,
    escape_unprintable,
    number_with_noun,
    sweep_shell_command,
)
from sweep.storage.locations import Location, parse_location
from sweep.tasks.engine.text_streams import is_terminal
from sweep.units import number_text, percent_text

if TYPE_CHECKING:
    import numpy as np

    from sweep.spec import GridSpec, SceneSpec
    from sweep.tasks.driver import Outcome
    from sweep.tasks.studies.study_plan import EffectRow, EffectsTable, StudyPlan

ASK_ABOVE_POINTS, ASK_ABOVE_BYTES, ASK_ABOVE_CPU_SECONDS = 10**9, 10**12, 30 * 86400.0
"""Limits above which a run asks for confirmation before it starts.

They are the number of points, the size of the results [bytes], and the time on one core [s].
"""

WALL_TO_CPU_TIME_RATIO_NOTED_MIN = 1.3
"""Ratio of wall time to processor time above which `sweep plan` notes that processors are busy."""

MEASURE_TIME_ABOVE_POINT_DRAWS = 10**7
"""Number of points times draws of a study above which its time is measured before it starts."""

SENTENCE_COLUMN_WIDTH_MIN, COLUMN_GAP, UNBROKEN_CELL_WIDTH_MAX = 14, 3, 36
"""Widths in a printed table [characters].

The first is the least width of a column of sentences, the second the gap between columns. Cells
narrower than the third are never broken if a row is printed as a list.
"""


class LocalPathType(click.Path):
    """Click type of a local path; expands ~ to the user's home, also after `--output=`."""

    def __init__(self, **options: Any) -> None:
        super().__init__(path_type=Path, **options)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path after click's checks; an error for a missing path suggests another."""
        path = Path(os.path.expanduser(value))
        if self.exists and not path.exists():
            self.fail(
                f"{self.name.capitalize()} '{path}' does not exist{_missing_file_hint(path)}",
                param,
                ctx,
            )
        if self.exists and not self.dir_okay and (path / "zarr.json").is_file():
            hint = f"{sweep_shell_command('resume', value)} goes on with it"
            self.fail(f"'{path}' is a store, and a file is needed: {hint}", param, ctx)
        return super().convert(str(path), param, ctx)


def _missing_file_hint(path: Path) -> str:
    """Return a hint for a path without a file: a similar name, or the YAML files of its folder.

    If the path is a link to a missing target, the hint names the target instead.
    """
    from sweep.spec.yaml_document import suggest_similar_file

    if path.is_symlink():
        return f": it is a link to '{os.readlink(path)}', which leads nowhere"
    try:
        names = [
            sibling.name for sibling in path.parent.iterdir() if sibling.suffix in (".yaml", ".yml")
        ]
    except OSError:
        return f": there is no folder '{path.parent}'"
    siblings_text = f"there is: {', '.join(sorted(names)[:5])}" if names else ""
    suggestion_text = suggest_similar_file(path, fallback=siblings_text)
    return f"; {suggestion_text}" if suggestion_text else ""


class StoreLocationType(click.ParamType):
    """Click type of a store's location: a path, or an address in an object store."""

    name = "path"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> Location:
        """Convert a path or an address to the store's location."""
        return parse_location(str(value))

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Return completions that let the shell complete the typed text as a path."""
        return [CompletionItem(incomplete, type="file")]


def shorten_path(path: Location) -> Location:
    """Return a path relative to the current folder if it lies below; any other path unchanged."""
    try:
        current_dir = Path.cwd()
    except OSError:  # the current folder was removed
        return path
    if isinstance(path, Path) and path.is_relative_to(current_dir):
        return path.relative_to(current_dir)
    return path


def parse_assignments(
    assignment_texts: tuple[str, ...], option: str = "--at", example: str = "range=2km"
) -> dict[str, str]:
    """Parse texts of the form NAME=VALUE; return the values by name.

    Raise click's BadParameter, naming `option` and `example`, for a text of another form.
    """
    values = {}
    for text in assignment_texts:
        name, separator, value = text.partition("=")
        if not (name.strip() and separator and value.strip()):
            raise click.BadParameter(
                f"{text!r} is not NAME=VALUE, as in {example}", param_hint=option
            )
        if name.strip() in values:
            raise click.BadParameter(f"{name.strip()!r} is given twice", param_hint=option)
        values[name.strip()] = value.strip()
    return values


SPEC_ARGUMENT = click.argument("spec", type=LocalPathType(exists=True, dir_okay=False))
STORE_ARGUMENT = click.argument("store", type=StoreLocationType())

THREADS_OPTION = click.option(
    "--threads",
    type=click.IntRange(min=1),
    help="Threads of this command that compute [one per core].",
)
WORKERS_OPTION = click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Worker processes to start in the place of threads [none, or as --cluster says].",
)
SCHEDULER_OPTION = click.option(
    "--scheduler",
    metavar="ADDRESS|none",
    help="Address of a Dask scheduler; none: a plain loop without Dask.",
)
CLUSTER_OPTION = click.option(
    "--cluster",
    type=LocalPathType(exists=True, dir_okay=False),
    help="File that describes a cluster; deploy/ has examples.",
)
BLOCK_TIMEOUT_OPTION = click.option(
    "--block-timeout",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="Give up a block that takes longer than this twice [none].",
)
PERFORMANCE_REPORT_OPTION = click.option(
    "--performance-report",
    type=LocalPathType(dir_okay=False),
    metavar="FILE.html",
    help="Write Dask's own report of the run.",
)
DASHBOARD_OPTION = click.option(
    "--dashboard",
    is_flag=True,
    help="Serve Dask's dashboard to all users of this machine, on its loopback address.",
)
DURABLE_OPTION = click.option(
    "--durable",
    is_flag=True,
    help="Commit blocks only once they are on the disk, against power loss.",
)

OVERWRITE_OPTION = click.option("--overwrite", is_flag=True, help="Replace an existing result.")

FIGURE_FORMAT_OPTION = click.option(
    "--format",
    "form",
    type=click.Choice(["png", "pdf", "svg"]),
    default="png",
    help="Format of the figures [png]; pdf and svg for print.",
)


def at_option(help: str) -> Callable[..., Any]:
    """Return click's decorator for --at NAME=VALUE, which :func:`parse_assignments` parses."""
    return click.option("--at", "at", multiple=True, metavar="NAME=VALUE", help=help)


def output_dir_option(help: str) -> Callable[..., Any]:
    """Return click's decorator for the option --output, the folder for output files."""
    return click.option("--output", type=LocalPathType(file_okay=False), help=help)


def _allow_modules(
    context: click.Context, parameter: click.Parameter, modules: tuple[str, ...]
) -> None:
    """Click callback of --allow-code: allow studies to import the named modules of the user."""
    if modules:
        from sweep.tasks.engine.user_code import allow_modules

        allow_modules(modules)


ALLOW_CODE_OPTION = click.option(
    "--allow-code",
    multiple=True,
    metavar="MODULE",
    expose_value=False,
    callback=_allow_modules,
    help="Let the study run detectors and estimators of this Python module; can be repeated.",
)


def add_run_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of all computing commands to a command, and return the command.

    The command receives the options as keyword arguments.
    """
    options = (
        THREADS_OPTION,
        WORKERS_OPTION,
        SCHEDULER_OPTION,
        CLUSTER_OPTION,
        ALLOW_CODE_OPTION,
        BLOCK_TIMEOUT_OPTION,
        DURABLE_OPTION,
        PERFORMANCE_REPORT_OPTION,
        DASHBOARD_OPTION,
    )
    for option in reversed(options):
        command = option(command)
    return command


def wrap_text(text: str, hanging_indent: int = 2, *, err: bool = False, margin: int = 0) -> str:
    """Wrap text to the terminal's width less ``margin``; return it unchanged without a terminal.

    Lines break between words. Commands in backquotes stay on one line, so that users can copy them.
    """
    if not is_terminal(sys.stderr if err else sys.stdout):
        return text
    width = max(shutil.get_terminal_size().columns - margin, 1)
    protected_text = re.sub(r"`[^`]*`", lambda match: match[0].replace(" ", "\xa0"), text)
    lines = (
        textwrap.fill(
            line, width, subsequent_indent=" " * (hanging_indent + len(line) - len(line.lstrip())),
            break_long_words=False, break_on_hyphens=False,
        )
        for line in protected_text.splitlines()
    )  # fmt: skip
    return "\n".join(lines).replace("\xa0", " ")


def echo_wrapped(text: str, *, err: bool = False) -> None:
    """Print text, wrapped to the terminal's width."""
    click.echo(wrap_text(text, err=err), err=err)


def instrument_yaml_lines(instrument_file: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of a YAML file that describes an instrument and can be named in a spec.

    `instrument_file` is the content of an instrument's file, by section. Its descriptive text
    becomes comments.
    """
    import yaml

    comments = [
        instrument_file["title"],
        instrument_file["source"]
        + (f", https://doi.org/{instrument_file['doi']}" if instrument_file["doi"] else ""),
    ]
    for heading in ("published", "assumed"):
        comments += [
            "",
            f"{heading}:",
            *(f"- {item}" for item in instrument_file[heading] or ["nothing"]),
        ]
    comments += ["", "must reproduce (docs/instruments.md has what is simulated):"]
    for published_number in instrument_file["numbers"].values():
        is_text = isinstance(published_number["published"], str)  # texts include their unit
        unit = "" if is_text else f" {published_number['unit']}"
        comments.append(
            f"- {published_number['about']}: {published_number['published']}{unit}".rstrip()
        )
    for comment in comments:
        yield from (
            f"# {line}".rstrip() for line in (wrap_text(comment, margin=2) or " ").splitlines()
        )
    sections = {
        name: instrument_file[name]
        for name in ("error_floor", "instrument")
        if name in instrument_file
    }
    yield "\n" + yaml.safe_dump(sections, sort_keys=False).rstrip()


def print_outcome_and_exit(outcome: Outcome, store: Location) -> None:
    """Print the outcome of a run; exit with code 3 if the run is incomplete, else return.

    ``store`` is the path that the user named.
    """
    from sweep.tasks.engine.progress import duration_text

    if outcome.blocks_done and (outcome.store / "zarr.json").exists():
        try:
            _print_summary(outcome.store)
            print_accuracy(outcome.store)
            print_inconsistency_warnings(outcome.store)
        except Exception as error:  # without the tables the study is still computed
            echo_wrapped(f"no table of the results: {_error_text(error)}", err=True)
    for scanner, rays in outcome.rays_by_scanner.items():
        rays_text = (
            f"{number_with_noun(rays, 'ray')} cast" if rays else "eyepoints were there, no ray cast"
        )
        click.echo(f"{scanner}: {rays_text}")
    echo_wrapped(
        f"{store}: {outcome.points_done:,} of {outcome.points:,} {outcome.points_noun}, "
        f"computed {outcome.blocks_computed:,} of {number_with_noun(outcome.blocks, 'block')} "
        f"in {duration_text(outcome.seconds)}"
    )
    if outcome.complete:
        if not outcome.blocks_computed:
            echo_wrapped(f"{store} was complete already: nothing was left to compute.")
        click.echo(f"{sweep_shell_command('figures', store)}  draws it.")
        return
    for failure in outcome.failures[:5]:
        echo_wrapped(f"block {failure.block} failed: {failure.error}", err=True)
    blocks_left = outcome.blocks - outcome.blocks_done
    n_failed = len(outcome.failures) + outcome.blocks_skipped
    reason = (
        outcome.stop_reason
        or f"{n_failed:,} failed; {sweep_shell_command('status', store)}  tells why"
    )
    click.echo(
        f"Incomplete, {blocks_left:,} of {number_with_noun(outcome.blocks, 'block')} left: "
        f"{reason}.",
        err=True,
    )
    if blocks_left > n_failed:
        click.echo(f"{sweep_shell_command('resume', store)}  goes on.", err=True)
    if n_failed:
        retry_command = sweep_shell_command("resume", store, retry_failed=True)
        click.echo(f"{retry_command}  tries failed blocks again.", err=True)
    sys.exit(EXIT_INCOMPLETE)


def _error_text(error: Exception) -> str:
    """Return an error's message, preceded by its type unless it is an error of this program."""
    from sweep.storage.store_format import StoreError
    from sweep.storage.verified_store import DamagedChunkError

    is_own_error = isinstance(error, StoreError | DamagedChunkError)
    return str(error) if is_own_error else f"{type(error).__name__}: {error}"


def _print_summary(store: Location) -> None:
    """Print a store's table of results, and its probabilities of false alarms."""
    from sweep.tasks.studies import study_loading

    attributes, study = study_loading.read_study(store)
    (_print_scene_summary if attributes["kind"] == "scene" else _print_grid_summary)(store)
    if alarms := false_alarm_text(study.spec):
        echo_wrapped(f"False alarms of noise: {alarms}.")


def _print_grid_summary(store: Location) -> None:
    """Print a grid's detection probabilities in a table, with a row for each part of the grid."""
    from sweep.tasks.studies.store_summary import DETECTED_PD_MIN, detection_summary

    summary = detection_summary(store)
    print_table(
        "Probability of detection" + _sampled_share_text(summary.sampled_block_fraction),
        [
            summary.axis_heading,
            "points",
            f"pd_shot > {DETECTED_PD_MIN}",
            "median pd_shot",
            "median pd_doppler",
        ],
        [
            [
                row.label,
                f"{row.n_points:,}",
                percent_text(row.detected_fraction, ".1f"),
                number_text(row.median_pd_shot),
                f"{row.median_pd_doppler:.4g}"
                if row.median_pd_doppler == row.median_pd_doppler
                else "-",
            ]
            for row in summary.rows
        ],
    )


def _sampled_share_text(block_share: float) -> str:
    """Return a note that a table covers this fraction of a store's blocks; '' if it covers all."""
    return f", by {100 * block_share:.2g} % of the blocks" if block_share < 1 else ""


def _print_scene_summary(store: Location) -> None:
    """Print a table of a flight with the numbers of shots and points of each scanner."""
    from sweep.tasks.studies.store_summary import flight_summary

    print_table(
        "Shots and points by scanner",
        ["scanner", "shots", "mean pd", "true points", "false points", "velocity solved"],
        [
            [
                row.label,
                f"{row.n_drawn_shots:,}",
                number_text(row.mean_pd) if row.mean_pd == row.mean_pd else "no hit",
                percent_text(row.n_shots_with_true_return / row.n_drawn_shots, ".1f")
                if row.n_drawn_shots
                else "-",
                f"{row.n_false_points:,}",
                f"{100 * row.n_solved_cycles / row.n_drawn_cycles:.1f} %"
                if row.n_drawn_cycles
                else "-",
            ]
            for row in flight_summary(store)
        ],
    )


def unchecked_beamlets_reason(spec: GridSpec | SceneSpec) -> str:
    """Return, as text, why the error due to the number of beamlets is not estimated.

    The text is empty if that error is estimated, or if no footprint is simulated.
    """
    from sweep.model.beamlet_counts import BEAMLETS_PATH, beamlets_converge

    parameters = spec.parameters()
    is_given = spec.footprint.beamlets > 0
    is_varied = any(
        member.path == BEAMLETS_PATH for axis in spec.axes for member in axis.parameters
    )
    if spec.effect_modes()["footprint"] == "off":
        return ""
    if is_given or is_varied:
        given_text = "several numbers" if is_varied else f"{spec.footprint.beamlets:,}"
        return (
            f"whether footprint.beamlets, given as {given_text}, keeps accuracy.tolerance; leave "
            "it "
            "out to have beamlets counted by the tolerance"
        )
    if not beamlets_converge(parameters):
        return (
            "whether the number of beamlets keeps accuracy.tolerance, as their amplitudes add, or "
            "their pattern is given"
        )
    return ""


def print_inconsistency_warnings(store: Location, scanner: str | None = None) -> None:
    """Print warnings about quantities of a flight whose errors far exceed their standard errors.

    `scanner` limits the warnings to one scanner; by default all scanners are checked.
    """
    from sweep.tasks.studies import study_loading

    if study_loading.read_study(store).attributes["kind"] != "scene":
        return
    from sweep.analysis.scene_results.consistency import understated_error_messages

    for sentence in understated_error_messages(store, scanner):
        echo_wrapped(f"warning: {sentence}", err=True)


def print_accuracy(store: Location, done_block_numbers: np.ndarray | None = None) -> None:
    """Print the accuracy of a store's results, and the number of points without results.

    The accuracy is the uncertainty due to random draws, and the error due to the number of
    beamlets. `done_block_numbers` are the numbers of the computed blocks, if the caller knows them.
    """
    from sweep.tasks.studies import study_loading
    from sweep.tasks.studies.store_summary import (
        accuracy_rows_of_draws,
        accuracy_rows_of_rays,
        count_unsupported_points,
    )

    unsupported = count_unsupported_points(store, done_block_numbers)
    if unsupported.n_points:
        message = (
            f"points beyond the model, which have no results: {unsupported.n_points:,}; the first: "
            f"{unsupported.first_reason}"
        )
        echo_wrapped(f"warning: {message}", err=True)
    if rows := accuracy_rows_of_draws(store, done_block_numbers):
        print_table(
            "Half-widths of pd by its draws, and where accuracy.tolerance is met"
            + _sampled_share_text(rows[0].sampled_block_fraction),
            ["", "met", "worst", "missed by", "draws", "needed", "at"],
            [
                [
                    row.name,
                    f"{row.n_points_within_tolerance:,} of {row.n_points:,}",
                    f"{row.worst_error:.3g}",
                    f"{row.excess_over_tolerance:.2g}",
                    f"{row.n_samples_at_worst_point:,}",
                    f"{row.n_draws_needed:,.0f}" if row.n_draws_needed < float("inf") else "-",
                    row.worst_point_label,
                ]
                for row in rows
            ],
            "at",
        )
    if reason := unchecked_beamlets_reason(study_loading.read_study(store).study.spec):
        echo_wrapped(f"Not checked: {reason}.")
    if rays := accuracy_rows_of_rays(store, done_block_numbers):
        ray_noun, unit_noun = ("rays", "shot") if rays[0].name else ("beamlets", "point")
        print_table(
            f"What more {ray_noun} may change{_sampled_share_text(rays[0].sampled_block_fraction)}",
            ["", f"{ray_noun} a {unit_noun}", "met", "worst", "missed by", "at"],
            [
                [
                    row.name,
                    f"{row.mean_n_samples:,.0f}, at most {row.largest_n_samples:,}",
                    f"{row.n_points_within_tolerance:,} of {row.n_points:,}",
                    f"{row.worst_error:.3g}",
                    f"{row.excess_over_tolerance:.2g}",
                    row.worst_point_label,
                ]
                for row in rays
            ],
            "at",
        )


def print_table(
    title: str, headings: list[str], rows: list[list[str]], sentence_heading: str = ""
) -> None:
    """Print a table to the terminal's width, or at its natural width without a terminal.

    ``sentence_heading`` is the heading of the column whose cells are sentences. Numbers are never
    broken or truncated. If the terminal is too narrow for the table, each row is printed as a list.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    title = escape_unprintable(title)
    rows = [[escape_to_one_line(cell) for cell in row] for row in rows]
    table, console = Table(title=title, title_justify="left", box=SIMPLE_HEAD), Console()
    columns = [[heading, *cells] for heading, *cells in zip(headings, *rows, strict=True)]
    full_widths = [max(map(len, column)) for column in columns]
    min_widths = [
        _column_width_min(column, is_sentences=column[0] == sentence_heading) for column in columns
    ]
    spare_width = console.width - sum(min_widths) - COLUMN_GAP * len(columns) - 1
    if not console.is_terminal:
        spare_width = sum(full_widths)
    elif spare_width < 0:
        _print_rows_as_lists(title, headings, rows)
        return
    for heading, full_width, width in zip(
        headings, full_widths, min_widths, strict=True
    ):  # spare width goes to the first columns; sentences come last
        spare_width, width = (
            spare_width - min(full_width - width, spare_width),
            width + min(full_width - width, spare_width),
        )
        table.add_column(
            escape(heading), justify="left" if heading == sentence_heading else "right", width=width
        )
    for row in rows:
        table.add_row(*map(escape, row))
    console.width = max(console.width, sum(full_widths) + COLUMN_GAP * len(columns) + 1)
    console.print(table)


def _print_rows_as_lists(title: str, headings: list[str], rows: list[list[str]]) -> None:
    """Print each row of a table as a list of its cells, wrapped to the terminal's width."""
    echo_wrapped(title)
    for row in rows:
        labelled_cells = (
            f"{heading}: {cell}" for heading, cell in zip(headings[1:], row[1:], strict=True)
        )
        cells = (
            f"`{labelled_cell}`" if len(labelled_cell) < UNBROKEN_CELL_WIDTH_MAX else labelled_cell
            for labelled_cell in labelled_cells
        )
        click.echo(f"{row[0]}\n{wrap_text('  ' + '   '.join(cells), 0).replace('`', '')}")
    click.echo()


def _column_width_min(column: list[str], *, is_sentences: bool) -> int:
    """Return the least width [characters] of a table column at which no word is broken.

    `is_sentences` is True for a column of sentences. In other columns no number is broken either.
    """
    heading, *cells = column
    numbers = [] if is_sentences else [cell for cell in cells if any(map(str.isdigit, cell))]
    longest = max(map(len, [*heading.split(), *" ".join(cells).split(), *numbers]), default=0)
    return (
        max(longest, min(SENTENCE_COLUMN_WIDTH_MIN, max(map(len, column))))
        if is_sentences
        else longest
    )


def plan_rows(
    spec: GridSpec | SceneSpec, store: Location, workers: int | None
) -> Iterator[tuple[str, str]]:
    """Yield heading and text of each line that `sweep plan` prints about a study."""
    from sweep.spec import GridSpec, SceneSpec
    from sweep.tasks.engine.progress import duration_text
    from sweep.tasks.studies.flight_coverage import refuse_flight_without_hits
    from sweep.tasks.studies.study_plan import plan_study

    study_plan = plan_study(spec, store_path=store, n_workers=workers)
    if isinstance(spec, SceneSpec):
        refuse_flight_without_hits(spec)
    if isinstance(spec, GridSpec):
        block_shape_text = " x ".join(
            f"{count} {name}" for name, count in study_plan.block_shape.items()
        )
        yield "points", f"{study_plan.n_points:,}"
        yield "blocks", f"{study_plan.n_blocks:,} of at most {block_shape_text or 'the point'}"
    else:
        yield from _scene_plan_rows(spec, study_plan)
        yield "blocks", f"{study_plan.n_blocks:,}"
    yield "chunks", number_with_noun(study_plan.n_chunks, "file")
    yield "bytes", f"{decimal(study_plan.nbytes)} before compression"
    if reason := unchecked_beamlets_reason(spec):
        yield "not checked", reason
    if not study_plan.scanners:
        yield "time a point", f"{1e6 * study_plan.seconds_per_point:.3g} us on one core"
    bound_text = "at most about" if getattr(spec.draws, "is_adaptive", False) else "about"
    computing_unit = "worker" if study_plan.has_workers else "thread"
    yield (
        "time",
        f"{bound_text} {duration_text(study_plan.wall_seconds)} on "
        f"{number_with_noun(study_plan.n_workers, computing_unit)}"
        + (
            ", with the processors as busy as now"
            if study_plan.wall_to_cpu_time_ratio > WALL_TO_CPU_TIME_RATIO_NOTED_MIN
            else ""
        ),
    )
    yield "parts", _time_parts_text(study_plan)
    memory_share = " a worker" if study_plan.has_workers else ""
    yield "memory", f"about {decimal(study_plan.process_memory_bytes)}{memory_share}"
    if reason := _excessive_size_text(
        study_plan.n_points, study_plan.nbytes, study_plan.cpu_seconds
    ):
        yield "question", f"sweep run asks first, or takes --yes: {reason}"


def _time_parts_text(study_plan: StudyPlan) -> str:
    """Return the processor time of a planned run, and of its parts, as text.

    The text includes the time of compilation if kernels still have to be compiled.
    """
    from sweep.tasks.engine.progress import duration_text

    seconds_by_name: dict[str, float] = defaultdict(float)
    for part in study_plan.time_parts:
        seconds_by_name[part.name] += part.cpu_seconds
    parts_text = ", ".join(
        f"{name} {duration_text(seconds)}"
        for name, seconds in seconds_by_name.items()
        if seconds > 0
    )
    text = f"{duration_text(study_plan.cpu_seconds)} of one core: {parts_text}"
    if not study_plan.are_kernels_compiled:
        text += (
            "; the model is not compiled yet, which the first run does, so that the time of shots "
            "is a guess"
        )
    return text


def _scene_plan_rows(spec: SceneSpec, study_plan: StudyPlan) -> Iterator[tuple[str, str]]:
    """Yield heading and text of the lines that `sweep plan` prints only for flights."""
    from sweep.model.beamlet_counts import BEAMLETS_PATH
    from sweep.model.error_budget import ErrorBudget
    from sweep.tasks.studies.flight_coverage import sample_coverage

    for report in study_plan.mesh_reports:
        yield "scene", report
    if spec.is_ray_number_set_by_tolerance:
        parameters = spec.parameters()
        rays_min, rays_max = (
            int(parameters[BEAMLETS_PATH]),
            ErrorBudget.from_parameters(parameters).ray_counts[-1],
        )
        yield "beamlets", f"{rays_min:,} a shot, more where it needs them, at most {rays_max:,}"
    for scanner_plan in study_plan.scanners:
        yield (
            scanner_plan.name,
            f"{number_with_noun(scanner_plan.n_cycles, 'cycle')}, "
            f"{number_with_noun(scanner_plan.n_shots, 'shot')}, "
            + (
                "eyepoints are there already"
                if scanner_plan.has_eyepoints
                else f"{number_with_noun(scanner_plan.n_rays, 'ray')} at "
                f"{1e6 * scanner_plan.seconds_per_ray:.3g} us on one core"
            ),
        )
        timed_text = (
            f", by {number_with_noun(scanner_plan.n_timed_shots, 'shot')} spread over the flight"
            if scanner_plan.n_timed_shots
            else ", assumed"
        )
        yield (
            "",
            f"{1e6 * scanner_plan.seconds_per_draw:,.0f} us a shot and draw on one core"
            + timed_text,
        )
    scene_coverage = sample_coverage(spec)
    for scanner in scene_coverage.scanner_hits:
        yield "hits", f"{scanner.name}: {scanner.hits_text()}"
    yield "extents", scene_coverage.extents_text()
    n_axis_points = math.prod(int(axis.size) for axis in spec.axes)
    yield "draws", f"{spec.draws.number:,}, at {n_axis_points:,} place(s) along the axes"


def print_effects(table: EffectsTable) -> None:
    """Print where each effect is simulated, and its cost in time.

    Warn of disabled effects that change results by more than the tolerance.
    """
    active_rows = [row for row in table.rows if row.change_bound > 0 or row.simulated_fraction > 0]
    headings = ["effect", "points", "costs", "may change", "called for"]
    rows = [_effect_row_cells(row) for row in active_rows]
    if not any(row.time_fraction == row.time_fraction for row in active_rows):  # all are nan
        headings.remove("costs")
        rows = [cells[:2] + cells[3:] for cells in rows]
    print_table("Effects", headings, rows, "called for")
    absent_effects = [row.name for row in table.rows if row not in active_rows]
    if absent_effects:
        echo_wrapped(f"Not in this study: {', '.join(absent_effects).replace('_', ' ')}.")
    echo_wrapped(
        f"What is left out may change pd, log10 pfa or |X| by {table.error_bound:.2g} at the most; "
        f"the tolerance is {table.tolerance:g}."
    )
    print_effects_warnings(table)


def confirm_large_study(spec: GridSpec | SceneSpec, store: Location, *, yes: bool) -> None:
    """Ask the user for confirmation before a very large study starts; exit if the user declines.

    Nothing is asked if `yes` is True or the study is not very large.
    """
    if yes or not (excess := _excessive_size_text(*_study_size(spec, store))):
        return
    if not (is_terminal(sys.stdin) and is_terminal(sys.stderr)):
        click.echo(f"This study takes {excess}: say --yes to begin it.", err=True)
        sys.exit(EXIT_MISTAKE)
    click.confirm(f"This study takes {excess}. Begin it?", abort=True, err=True)


class _StudySize(NamedTuple):
    """Size of a study, by which the user is asked for confirmation before a large one begins."""

    n_points: int
    """Number of points."""
    size_bytes: int
    """Size of the results before compression [bytes]."""
    cpu_seconds: float
    """Time on one core [s]; 0 if it is not estimated."""


def _study_size(spec: GridSpec | SceneSpec, store: Location) -> _StudySize:
    """Return the size of a study in points, bytes and processor time.

    The time is 0 unless the study has many draws, and points and bytes below the limits above
    which the user is asked for confirmation.
    """
    from sweep.spec import GridSpec
    from sweep.tasks.studies.study_loading import make_study
    from sweep.tasks.studies.study_plan import plan_study

    computed_study = make_study(spec, store.absolute())
    n_points, size_bytes = computed_study.n_points, computed_study.nbytes
    n_draws = max(1, spec.draws.number, spec.draws.limit) if isinstance(spec, GridSpec) else 1
    if n_points * n_draws <= MEASURE_TIME_ABOVE_POINT_DRAWS or _excessive_size_text(
        n_points, size_bytes, 0.0
    ):
        return _StudySize(n_points, size_bytes, 0.0)
    return _StudySize(n_points, size_bytes, plan_study(spec, store_path=store).cpu_seconds)


def _excessive_size_text(n_points: int, size_bytes: int, cpu_seconds: float) -> str:
    """Return as text the sizes of a study that exceed the limits for confirmation; '' for none."""
    from sweep.tasks.engine.progress import duration_text

    excess_parts = [f"{n_points:,} points"] if n_points > ASK_ABOVE_POINTS else []
    excess_parts += [decimal(size_bytes)] if size_bytes > ASK_ABOVE_BYTES else []
    excess_parts += (
        [f"about {duration_text(cpu_seconds)} of one core"]
        if cpu_seconds > ASK_ABOVE_CPU_SECONDS
        else []
    )
    return ", ".join(excess_parts)


def false_alarm_text(spec: GridSpec | SceneSpec) -> str:
    """Return a text with the false-alarm probabilities of a shot; '' if they are not known."""
    from sweep.spec.noise_alarms import false_alarm_probabilities

    if not (alarms := false_alarm_probabilities(spec)):
        return ""
    either_text, both_text = (
        " to ".join(
            dict.fromkeys(
                f"{probability:.3g}" for probability in (min(probabilities), max(probabilities))
            )
        )
        for probabilities in zip(*alarms, strict=True)
    )
    return f"in either chirp with probability {either_text}, in both chirps {both_text}"


def print_spec_warnings(spec: GridSpec | SceneSpec) -> None:
    """Print warnings about a spec's beam, scene, path and false alarms.

    Raise SceneError for a flight whose beams never hit the scene.
    """
    from sweep.tasks.studies.study_warnings import iter_spec_warnings

    for warning in iter_spec_warnings(spec):
        echo_wrapped(f"warning: {warning}", err=True)
    for sentence in spec.unstated_error_sentences():
        echo_wrapped(f"note: {sentence}", err=True)


def print_echo_warnings(spec: GridSpec | SceneSpec, store: Location) -> None:
    """Print warnings about echoes that arrive after the end of their record, or are ambiguous."""
    from sweep.tasks.studies.echo_warnings import echo_warnings
    from sweep.tasks.studies.study_loading import make_study

    for warning in echo_warnings(make_study(spec, store.absolute())):
        echo_wrapped(f"warning: {warning}", err=True)


def study_effects_table(
    spec: GridSpec | SceneSpec, store: Location, *, costs: bool = True
) -> EffectsTable:
    """Return the table of a study's effects; ``costs`` adds their fractions of the time."""
    from sweep.tasks.studies.study_loading import make_study
    from sweep.tasks.studies.study_plan import effects_table

    return effects_table(make_study(spec, store.absolute()), costs=costs)


def print_effects_warnings(table: EffectsTable) -> None:
    """Print warnings about disabled effects that change results by more than the tolerance."""
    for warning in table.warnings():
        echo_wrapped(f"warning: {warning}", err=True)


def _effect_row_cells(row: EffectRow) -> list[str]:
    """Return the texts of the cells of one effect's row in the table of effects."""
    cost, mode_text = row.time_fraction, "" if row.mode == "auto" else f" ({row.mode})"
    return [
        row.name.replace("_", " ") + mode_text,
        percent_text(row.simulated_fraction),
        percent_text(cost, ".2g")
        if cost == cost
        else "not measured"
        if row.simulated_fraction
        else "-",
        f"{row.change_bound:.2g}",
        "nowhere, but forced on"
        if row.change_bound == 0 and row.mode == "on"
        else "everywhere"
        if row.simulated_fraction == 1
        else row.simulated_region or f"nowhere; most at {row.largest_change_region}",
    ]


class PrintedMeasurement(NamedTuple):
    """Files of a printed measurement of accuracy, and whether the measurement is complete."""

    files: list[Location]
    """Paths of the measurement's store, figure and tables."""
    is_complete: bool
    """True if the measurement ended by itself, False if the user interrupted it."""


def print_accuracy_measurement(store: Location, *, has_results: bool) -> PrintedMeasurement:
    """Print the settings that `sweep accuracy` has measured, and draw their figure.

    Return the files. If `has_results` is False, exit with the code for incomplete results.
    """
    if not has_results:
        click.echo("Interrupted before any point was through: nothing is kept.", err=True)
        sys.exit(EXIT_INCOMPLETE)
    from sweep.analysis import accuracy_results
    from sweep.tasks.accuracy.measurement import StopReason

    dataset, settings = accuracy_results.open_accuracy_store(store)
    print_table(
        "Time a point; errors of pd (at 90 %, largest), log10 pfa, peak magnitude; leakage",
        list(accuracy_results.SHORT_SETTING_TABLE_COLUMNS),
        accuracy_results.short_setting_table_rows(settings),
        "setting",
    )
    print_table(
        "Cheapest setting for each error",
        list(accuracy_results.FASTEST_SETTING_COLUMNS),
        accuracy_results.fastest_setting_rows(settings),
        "cheapest setting",
    )
    for sentence in accuracy_results.conclusion_sentences(dataset, settings):
        echo_wrapped(sentence)
    written_files = [store, *accuracy_results.write_figure_and_tables(store)]
    return PrintedMeasurement(written_files, dataset.attrs["stopped"] != StopReason.INTERRUPTED)
