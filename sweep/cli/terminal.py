"""Terminal of the commands: options that several share, plans before a run, tables after it."""

from __future__ import annotations

import math
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem
from rich.filesize import decimal

from sweep.messages import INCOMPLETE, MISTAKE, command_line, counted, one_line, printable
from sweep.storage.locations import Location, located
from sweep.tasks.streams import is_terminal
from sweep.units import number_text, percent

if TYPE_CHECKING:
    import numpy as np

    from sweep.spec import SceneSpec, Spec
    from sweep.tasks.plan import EffectRow, EffectsTable, Plan
    from sweep.tasks.session import Outcome

MOST_POINTS, MOST_BYTES, MOST_SECONDS = 10**9, 10**12, 30 * 86400.0
"""Size of a study, and its time on one core [s], beyond which a run asks before it begins."""

MEASURED = 10**7
"""Points times draws beyond which a run measures the time that it takes, before it begins."""

LEAST_WORDS, BETWEEN, MOST_WHOLE = 14, 3, 36
"""Characters of a table: least column of sentences, between columns, most of an unbroken cell."""


class LocalPath(click.Path):
    """A path here, in which ~ stands for the user's own folder, after `--output=` too."""

    def __init__(self, **rules: Any) -> None:
        super().__init__(path_type=Path, **rules)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path, as click checks it; for one that is not there, say what is near it."""
        path = Path(os.path.expanduser(value))
        if self.exists and not path.exists():
            self.fail(f"{self.name.capitalize()} '{path}' does not exist{_near(path)}", param, ctx)
        if self.exists and not self.dir_okay and (path / "zarr.json").is_file():
            hint = f"{command_line('resume', value)} goes on with it"
            self.fail(f"'{path}' is a store, and a file is needed: {hint}", param, ctx)
        return super().convert(str(path), param, ctx)


def _near(path: Path) -> str:
    """Remark on a file whose name is like that of a missing one, or on the YAML files beside it.

    A link that leads nowhere is there, and has no near one.
    """
    from sweep.spec.reading import similar_file

    if path.is_symlink():
        return f": it is a link to '{os.readlink(path)}', which leads nowhere"
    try:
        names = [other.name for other in path.parent.iterdir() if other.suffix in (".yaml", ".yml")]
    except OSError:
        return f": there is no folder '{path.parent}'"
    others = f"there is: {', '.join(sorted(names)[:5])}" if names else ""
    near = similar_file(path, otherwise=others)
    return f"; {near}" if near else ""


class StorePath(click.ParamType):
    """A path, or an address in an object store."""

    name = "path"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> Location:
        """Return the place that is meant."""
        return located(str(value))

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Paths, as the shell completes them."""
        return [CompletionItem(incomplete, type="file")]


def shown(path: Location) -> Location:
    """Return a place as short as it can be written from here."""
    try:
        here = Path.cwd()
    except OSError:  # removed meanwhile
        return path
    if isinstance(path, Path) and path.is_relative_to(here):
        return path.relative_to(here)
    return path


def assignments(
    texts: tuple[str, ...], option: str = "--at", example: str = "range=2km"
) -> dict[str, str]:
    """Values by name, as written after an option; refused where one is not NAME=VALUE."""
    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name.strip() and equals and value.strip()):
            raise click.BadParameter(
                f"{text!r} is not NAME=VALUE, as in {example}", param_hint=option
            )
        if name.strip() in found:
            raise click.BadParameter(f"{name.strip()!r} is given twice", param_hint=option)
        found[name.strip()] = value.strip()
    return found


SPEC = click.argument("spec", type=LocalPath(exists=True, dir_okay=False))
STORE = click.argument("store", type=StorePath())

WORKERS = click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Workers to start [all cores, none for little work, or as --cluster says].",
)
SCHEDULER = click.option(
    "--scheduler",
    metavar="ADDRESS|none",
    help="Address of a Dask scheduler; none: a plain loop without Dask.",
)
CLUSTER = click.option(
    "--cluster",
    type=LocalPath(exists=True, dir_okay=False),
    help="File that describes a cluster; deploy/ has examples.",
)
BLOCK_TIMEOUT = click.option(
    "--block-timeout",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="Give up a block that takes longer than this twice [none].",
)
PERFORMANCE_REPORT = click.option(
    "--performance-report",
    type=LocalPath(dir_okay=False),
    metavar="FILE.html",
    help="Write Dask's own report of the run.",
)
DASHBOARD = click.option(
    "--dashboard",
    is_flag=True,
    help="Serve Dask's dashboard to all users of this machine, on its loopback address.",
)
DURABLE = click.option(
    "--durable",
    is_flag=True,
    help="Commit blocks only once they are on the disk, against power loss.",
)

OVERWRITE = click.option("--overwrite", is_flag=True, help="Replace an existing result.")

FORMAT = click.option(
    "--format",
    "form",
    type=click.Choice(["png", "pdf", "svg"]),
    default="png",
    help="Format of the figures [png]; pdf and svg for print.",
)


def at(help: str) -> Callable[..., Any]:
    """Option of values by name; :func:`assignments` reads them."""
    return click.option("--at", "at", multiple=True, metavar="NAME=VALUE", help=help)


def folder(help: str) -> Callable[..., Any]:
    """Option of the folder that files are put into."""
    return click.option("--output", type=LocalPath(file_okay=False), help=help)


def _allow(context: click.Context, parameter: click.Parameter, modules: tuple[str, ...]) -> None:
    if modules:
        from sweep.tasks.user_code import allow

        allow(modules)


ALLOW_CODE = click.option(
    "--allow-code",
    multiple=True,
    metavar="MODULE",
    expose_value=False,
    callback=_allow,
    help="Let the study run detectors and estimators of this Python module; can be repeated.",
)


def computing(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of all that compute, which it hands on as they are."""
    options = (
        WORKERS, SCHEDULER, CLUSTER, ALLOW_CODE, BLOCK_TIMEOUT, DURABLE, PERFORMANCE_REPORT,
        DASHBOARD,
    )  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


def folded(text: str, hanging: int = 2, *, err: bool = False, narrower: int = 0) -> str:
    """Text in lines of the terminal's width, or so much narrower; unchanged for no terminal.

    Lines break between words, and commands in backquotes, which are copied, stay whole.
    """
    if not is_terminal(sys.stderr if err else sys.stdout):
        return text
    width = max(shutil.get_terminal_size().columns - narrower, 1)
    whole = re.sub(r"`[^`]*`", lambda found: found[0].replace(" ", "\xa0"), text)
    lines = (
        textwrap.fill(
            line, width, subsequent_indent=" " * (hanging + len(line) - len(line.lstrip())),
            break_long_words=False, break_on_hyphens=False,
        )
        for line in whole.splitlines()
    )  # fmt: skip
    return "\n".join(lines).replace("\xa0", " ")


def tell(text: str, *, err: bool = False) -> None:
    """Print sentences, folded to the terminal's width."""
    click.echo(folded(text, err=err), err=err)


def instrument_lines(own: Mapping[str, Any]) -> Iterator[str]:
    """Yield what the file of an instrument of the library says, as a file that a spec may name.

    Words are comments of its YAML.
    """
    import yaml

    words = [
        own["title"],
        own["source"] + (f", https://doi.org/{own['doi']}" if own["doi"] else ""),
    ]
    for what in ("published", "assumed"):
        words += ["", f"{what}:", *(f"- {each}" for each in own[what] or ["nothing"])]
    words += ["", "must reproduce (docs/instruments.md has what is simulated):"]
    for number in own["numbers"].values():
        in_words = isinstance(number["published"], str)  # which have their unit
        unit = "" if in_words else f" {number['unit']}"
        words.append(f"- {number['about']}: {number['published']}{unit}".rstrip())
    for text in words:
        yield from (f"# {line}".rstrip() for line in (folded(text, narrower=2) or " ").splitlines())
    sections = {name: own[name] for name in ("error_floor", "instrument") if name in own}
    yield "\n" + yaml.safe_dump(sections, sort_keys=False).rstrip()


def conclude(outcome: Outcome, store: Location) -> None:
    """Say what a run has come to, and leave with its exit code.

    The store is the one that the user named: one that is being extended lies next to it.
    """
    from sweep.tasks.progress import duration

    if outcome.blocks_done and (outcome.store / "zarr.json").exists():
        try:
            _print_summary(outcome.store)
            tell_accuracy(outcome.store)
            tell_inconsistencies(outcome.store)
        except Exception as error:  # the study is computed all the same
            tell(f"no table of the results: {_described(error)}", err=True)
    for scanner, rays in outcome.rays.items():
        told = f"{counted(rays, 'ray')} cast" if rays else "eyepoints were there, no ray cast"
        click.echo(f"{scanner}: {told}")
    tell(
        f"{store}: {outcome.points_done:,} of {outcome.points:,} {outcome.unit}, "
        f"computed {outcome.blocks_computed:,} of {counted(outcome.blocks, 'block')} "
        f"in {duration(outcome.seconds)}"
    )
    if outcome.complete:
        if not outcome.blocks_computed:
            tell(f"{store} was complete already: nothing was left to compute.")
        click.echo(f"{command_line('figures', store)}  draws it.")
        return
    for failure in outcome.failures[:5]:
        tell(f"block {failure.block} failed: {failure.error}", err=True)
    left = outcome.blocks - outcome.blocks_done
    failed = len(outcome.failures) + outcome.left_out
    why = outcome.stopped or f"{failed:,} failed; {command_line('status', store)}  tells why"
    click.echo(f"Incomplete, {left:,} of {counted(outcome.blocks, 'block')} left: {why}.", err=True)
    if left > failed:
        click.echo(f"{command_line('resume', store)}  goes on.", err=True)
    if failed:
        retry = command_line("resume", store, retry_failed=True)
        click.echo(f"{retry}  tries failed blocks again.", err=True)
    sys.exit(INCOMPLETE)


def _described(error: Exception) -> str:
    """Text of an error, with its kind where that is no error of this program's."""
    from sweep.storage.opening import StoreError
    from sweep.storage.sound import DamagedChunkError

    is_told = isinstance(error, StoreError | DamagedChunkError)
    return str(error) if is_told else f"{type(error).__name__}: {error}"


def _print_summary(store: Location) -> None:
    from sweep.tasks import studies

    attributes, study = studies.read(store)
    (_print_scene if attributes["kind"] == "scene" else _print_grid)(store)
    if alarms := alarms_told(study.spec):
        tell(f"False alarms of noise: {alarms}.")


def _print_grid(store: Location) -> None:
    from sweep.tasks.summary import DETECTED, summary

    part, rows, share = summary(store)
    print_table(
        "Probability of detection" + _looked_at(share),
        [part, "points", f"pd_shot > {DETECTED}", "median pd_shot", "median pd_doppler"],
        [
            [
                row.part,
                f"{row.points:,}",
                percent(row.detected, ".1f"),
                number_text(row.pd_shot),
                f"{row.pd_doppler:.4g}" if row.pd_doppler == row.pd_doppler else "-",
            ]
            for row in rows
        ],
    )


def _looked_at(share: float) -> str:
    return f", by {100 * share:.2g} % of the blocks" if share < 1 else ""


def _print_scene(store: Location) -> None:
    from sweep.tasks.summary import scene_summary

    print_table(
        "Shots and points by scanner",
        ["scanner", "shots", "mean pd", "true points", "false points", "velocity solved"],
        [
            [
                row.part,
                f"{row.shots:,}",
                number_text(row.pd) if row.pd == row.pd else "no hit",
                percent(row.true / row.shots, ".1f") if row.shots else "-",
                f"{row.false:,}",
                f"{100 * row.solved / row.cycles:.1f} %" if row.cycles else "-",
            ]
            for row in scene_summary(store)
        ],
    )


def unchecked_beamlets(study: Spec | SceneSpec) -> str:
    """Return what is not checked of the number of beamlets, and why; '' where it is estimated."""
    from sweep.model.resolution import BEAMLETS, is_open

    parameters = study.parameters()
    given = study.footprint.beamlets > 0
    varied = any(member.path == BEAMLETS for axis in study.axes for member in axis.members)
    if study.modes()["footprint"] == "off":
        return ""
    if given or varied:
        number = "several numbers" if varied else f"{study.footprint.beamlets:,}"
        return (
            f"whether footprint.beamlets, given as {number}, keeps accuracy.tolerance; leave it "
            "out to have beamlets counted by the tolerance"
        )
    if not is_open(parameters):
        return (
            "whether the number of beamlets keeps accuracy.tolerance, as their amplitudes add, or "
            "their pattern is given"
        )
    return ""


def tell_inconsistencies(store: Location, scanner: str | None = None) -> None:
    """Print which quantities of a flight are off by far more than their standard errors."""
    from sweep.tasks import studies

    if studies.read(store)[0]["kind"] != "scene":
        return
    from sweep.analysis.consistency import inconsistencies

    for sentence in inconsistencies(store, scanner):
        tell(f"warning: {sentence}", err=True)


def tell_accuracy(store: Location, done: np.ndarray | None = None) -> None:
    """Print how well what is drawn is known, what beamlets leave, and what is not known at all."""
    from sweep.tasks import studies
    from sweep.tasks.summary import accuracy_table, beyond_model, rays_table

    number, why = beyond_model(store, done)
    if number:
        told = f"points beyond the model, which have no results: {number:,}; the first: {why}"
        tell(f"warning: {told}", err=True)
    if rows := accuracy_table(store, done):
        print_table(
            "Half-widths of pd by its draws, and where accuracy.tolerance is met"
            + _looked_at(rows[0].looked_at),
            ["", "met", "worst", "missed by", "draws", "needed", "at"],
            [
                [
                    row.name,
                    f"{row.met:,} of {row.points:,}",
                    f"{row.error:.3g}",
                    f"{row.missed:.2g}",
                    f"{row.number:,}",
                    f"{row.needed:,.0f}" if row.needed < float("inf") else "-",
                    row.where,
                ]
                for row in rows
            ],
            "at",
        )
    if why := unchecked_beamlets(studies.read(store)[1].spec):
        tell(f"Not checked: {why}.")
    if rays := rays_table(store, done):
        kind, each = ("rays", "shot") if rays[0].name else ("beamlets", "point")
        print_table(
            f"What more {kind} may change{_looked_at(rays[0].looked_at)}",
            ["", f"{kind} a {each}", "met", "worst", "missed by", "at"],
            [
                [
                    row.name,
                    f"{row.mean:,.0f}, at most {row.most:,}",
                    f"{row.met:,} of {row.points:,}",
                    f"{row.error:.3g}",
                    f"{row.missed:.2g}",
                    row.where,
                ]
                for row in rays
            ],
            "at",
        )


def print_table(title: str, headings: list[str], rows: list[list[str]], words: str = "") -> None:
    """Print a table, folded to the terminal's width; nothing is folded where there is none.

    `words` names a column of sentences. No number is ever broken or cut: where a terminal is too
    narrow for a table, a row is a list.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    title = printable(title)
    rows = [[one_line(cell) for cell in row] for row in rows]
    table, console = Table(title=title, title_justify="left", box=SIMPLE_HEAD), Console()
    columns = [[heading, *cells] for heading, *cells in zip(headings, *rows, strict=True)]
    whole = [max(map(len, column)) for column in columns]
    least = [_least(column, is_words=column[0] == words) for column in columns]
    spare = console.width - sum(least) - BETWEEN * len(columns) - 1
    if not console.is_terminal:
        spare = sum(whole)
    elif spare < 0:
        _print_lists(title, headings, rows)
        return
    for heading, most, width in zip(headings, whole, least, strict=True):  # words come last
        spare, width = spare - min(most - width, spare), width + min(most - width, spare)
        table.add_column(
            escape(heading), justify="left" if heading == words else "right", width=width
        )
    for row in rows:
        table.add_row(*map(escape, row))
    console.width = max(console.width, sum(whole) + BETWEEN * len(columns) + 1)
    console.print(table)


def _print_lists(title: str, headings: list[str], rows: list[list[str]]) -> None:
    """Print each row of a table as a list of its cells, as many to a line as it has room for."""
    tell(title)
    for row in rows:
        told = (f"{head}: {cell}" for head, cell in zip(headings[1:], row[1:], strict=True))
        cells = (f"`{each}`" if len(each) < MOST_WHOLE else each for each in told)
        click.echo(f"{row[0]}\n{folded('  ' + '   '.join(cells), 0).replace('`', '')}")
    click.echo()


def _least(column: list[str], *, is_words: bool) -> int:
    """Width of a column whose words, and where they are no sentences whose numbers, stay whole."""
    heading, *cells = column
    numbers = [] if is_words else [c for c in cells if any(map(str.isdigit, c))]
    longest = max(map(len, [*heading.split(), *" ".join(cells).split(), *numbers]), default=0)
    return max(longest, min(LEAST_WORDS, max(map(len, column)))) if is_words else longest


def plan_lines(
    study: Spec | SceneSpec, store: Location, workers: int | None
) -> Iterator[tuple[str, str]]:
    """Lines, with their headings, of what a study will take."""
    from sweep.spec import SceneSpec, Spec
    from sweep.tasks.coverage import refuse_blind
    from sweep.tasks.plan import plan
    from sweep.tasks.progress import duration
    from sweep.tasks.session import RunOptions

    if isinstance(study, SceneSpec):
        refuse_blind(study)
    p = plan(study, store=store, workers=workers)
    if isinstance(study, Spec):
        shape = " x ".join(f"{count} {name}" for name, count in p.block_shape.items())
        yield "points", f"{p.points:,}"
        yield "blocks", f"{p.blocks:,} of at most {shape or 'the point'}"
    else:
        yield from _scene_lines(study, p)
        yield "blocks", f"{p.blocks:,}"
    yield "chunks", counted(p.chunks, "file")
    yield "bytes", f"{decimal(p.bytes)} before compression"
    if why := unchecked_beamlets(study):
        yield "not checked", why
    if not p.scanners:
        yield "time a point", f"{1e6 * p.seconds_a_point:.3g} us on one core"
    bound = "at most about" if getattr(study.draws, "adaptive", False) else "about"
    if RunOptions(workers=workers).place(study) is None:
        yield "time", f"{bound} {duration(p.work)}, at once, without workers"
    else:
        yield "time", f"{bound} {duration(p.seconds)} on {counted(p.workers, 'worker')}"
    yield "memory", f"about {decimal(p.worker_memory)} a worker"
    if why := _excess(p.points, p.bytes, p.work):
        yield "question", f"sweep run asks first, or takes --yes: {why}"


def _scene_lines(study: SceneSpec, plan: Plan) -> Iterator[tuple[str, str]]:
    from sweep.model.accuracy import Accuracy
    from sweep.model.resolution import BEAMLETS
    from sweep.tasks.coverage import coverage

    for report in plan.reports:
        yield "scene", report
    if study.rays_by_tolerance:
        parameters = study.parameters()
        rays, most = int(parameters[BEAMLETS]), Accuracy.of(parameters).rays[-1]
        yield "beamlets", f"{rays:,} a shot, more where it needs them, at most {most:,}"
    for s in plan.scanners:
        yield s.name, f"{counted(s.cycles, 'cycle')}, {counted(s.shots, 'shot')}, " + (
            "eyepoints are there already" if s.is_cast
            else f"{counted(s.rays, 'ray')} at {1e6 * s.seconds_a_ray:.3g} us on one core"
        )  # fmt: skip
        yield "", f"{1e6 * s.seconds_a_draw:,.0f} us a shot and draw on one core"
    seen = coverage(study)
    for scanner in seen.scanners:
        yield "hits", f"{scanner.name}: {scanner.text()}"
    yield "extents", seen.extents()
    places = math.prod(int(axis.size) for axis in study.axes)
    yield "draws", f"{study.draws.number:,}, at {places:,} place(s) along the axes"


def tell_effects(table: EffectsTable) -> None:
    """Print the effects that a study simulates, where, and their costs; warn of what is off."""
    there = [row for row in table.rows if row.bound > 0 or row.share > 0]
    headings = ["effect", "points", "costs", "may change", "called for"]
    print_table("Effects", headings, [_effect_cells(row) for row in there], "called for")
    absent = [row.name for row in table.rows if row not in there]
    if absent:
        tell(f"Not in this study: {', '.join(absent).replace('_', ' ')}.")
    tell(
        f"What is left out may change pd, log10 pfa or |X| by {table.error:.2g} at the most; "
        f"the tolerance is {table.tolerance:g}."
    )
    warn(table)


def ask_before(study: Spec | SceneSpec, store: Location, *, yes: bool) -> None:
    """Ask before a study begins that is larger than most; leave where that is declined."""
    if yes or not (why := _excess(*_size(study, store))):
        return
    if not (is_terminal(sys.stdin) and is_terminal(sys.stderr)):
        click.echo(f"This study takes {why}: say --yes to begin it.", err=True)
        sys.exit(MISTAKE)
    click.confirm(f"This study takes {why}. Begin it?", abort=True, err=True)


def _size(study: Spec | SceneSpec, store: Location) -> tuple[int, int, float]:
    """Points and bytes of a study, and its seconds on one core where it has many draws."""
    from sweep.spec import Spec
    from sweep.tasks.plan import plan
    from sweep.tasks.studies import study_of

    sized = study_of(study, store.absolute())
    points, size = sized.points, sized.bytes
    draws = max(1, study.draws.number, study.draws.limit) if isinstance(study, Spec) else 1
    if points * draws <= MEASURED or _excess(points, size, 0.0):
        return points, size, 0.0
    return points, size, plan(study, store=store).work


def _excess(points: int, size: int, seconds: float) -> str:
    """Sizes of a study beyond the usual, in words."""
    from sweep.tasks.progress import duration

    told = [f"{points:,} points"] if points > MOST_POINTS else []
    told += [decimal(size)] if size > MOST_BYTES else []
    told += [f"about {duration(seconds)} of one core"] if seconds > MOST_SECONDS else []
    return ", ".join(told)


def alarms_told(study: Spec | SceneSpec) -> str:
    """Probability of a false alarm in a shot, in words; empty where it is not known."""
    from sweep.spec.noise_alarms import alarms_of_study

    if not (found := alarms_of_study(study)):
        return ""
    any_, both = (
        " to ".join(dict.fromkeys(f"{chance:.3g}" for chance in (min(each), max(each))))
        for each in zip(*found, strict=True)
    )
    return f"in either chirp with probability {any_}, in both chirps {both}"


def warn_of(study: Spec | SceneSpec) -> None:
    """Warn of a beam too narrow for its aperture, of a scene and a path, of many false alarms.

    SceneError for a flight that sees nothing.
    """
    from sweep.tasks.doubts import doubts_of_spec

    for doubt in doubts_of_spec(study):
        tell(f"warning: {doubt}", err=True)
    for sentence in study.unstated_errors():
        tell(f"note: {sentence}", err=True)


def warn_of_echoes(study: Spec | SceneSpec, store: Location) -> None:
    """Warn of echoes that arrive after their record, and of those that are read as others."""
    from sweep.tasks.echoes import warnings_of
    from sweep.tasks.studies import study_of

    for warning in warnings_of(study_of(study, store.absolute())):
        tell(f"warning: {warning}", err=True)


def effects_of(study: Spec | SceneSpec, store: Location, *, costs: bool = True) -> EffectsTable:
    """Table of the effects that a study simulates, where, and their costs if asked for."""
    from sweep.tasks.plan import effects_table
    from sweep.tasks.studies import study_of

    return effects_table(study_of(study, store.absolute()), costs=costs)


def warn(table: EffectsTable) -> None:
    """Say which effects are forced off though they matter."""
    for warning in table.warnings():
        tell(f"warning: {warning}", err=True)


def _effect_cells(row: EffectRow) -> list[str]:
    cost, forced = row.cost, "" if row.mode == "auto" else f" ({row.mode})"
    return [
        row.name.replace("_", " ") + forced,
        percent(row.share),
        percent(cost, ".2g") if cost == cost else "too short to measure" if row.share else "-",
        f"{row.bound:.2g}",
        "nowhere, but forced on"
        if row.bound == 0 and row.mode == "on"
        else "everywhere"
        if row.share == 1
        else row.where or f"nowhere; most at {row.at}",
    ]


def conclude_accuracy(store: Location, *, measured: bool) -> tuple[list[Location], bool]:
    """Print what settings came to, and draw it: the files, and whether it was not interrupted.

    Leaves with the exit code of what is incomplete where nothing was measured.
    """
    if not measured:
        click.echo("Interrupted before any point was through: nothing is kept.", err=True)
        sys.exit(INCOMPLETE)
    from sweep.analysis import accuracy

    dataset, settings = accuracy.opened(store)
    print_table(
        "Time a point; errors of pd (at 90 %, largest), log10 pfa, peak magnitude; leakage",
        list(accuracy.SHORT), accuracy.short_rows(settings), "setting",
    )  # fmt: skip
    print_table(
        "Cheapest setting for each error",
        list(accuracy.CHEAPEST),
        accuracy.cheapest_rows(settings),
        "cheapest setting",
    )
    for sentence in accuracy.sentences(dataset, settings):
        tell(sentence)
    return [store, *accuracy.draw(store)], dataset.attrs["stopped"] != "interrupted"
