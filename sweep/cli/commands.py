"""The commands of `sweep`: each parses its arguments, calls the package and prints the result."""

from __future__ import annotations

import errno
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from sweep.cli.terminal import (
    ALLOW_CODE_OPTION,
    EXIT_INCOMPLETE,
    EXIT_MISTAKE,
    FIGURE_FORMAT_OPTION,
    OVERWRITE_OPTION,
    SPEC_ARGUMENT,
    STORE_ARGUMENT,
    WORKERS_OPTION,
    LocalPathType,
    StoreLocationType,
    add_run_options,
    at_option,
    confirm_large_study,
    echo_wrapped,
    false_alarm_text,
    output_dir_option,
    parse_assignments,
    plan_rows,
    print_accuracy_measurement,
    print_echo_warnings,
    print_effects,
    print_inconsistency_warnings,
    print_outcome_and_exit,
    print_spec_warnings,
    shorten_path,
    study_effects_table,
    wrap_text,
)
from sweep.messages import EscapingStream, suggest_shell_commands
from sweep.storage.locations import Location
from sweep.tasks.engine.text_streams import silence_failing_output

#: Errors of a path that can't be used: no permission, no space, or an obstacle at the path.
UNUSABLE_PATH_ERRNOS = {
    errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.ENOTDIR, errno.EEXIST,
    errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP,
}  # fmt: skip


#: Errors of a disk that can't take any more data.
DISK_FULL_ERRNOS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def _escape_output_streams() -> None:
    """Wrap standard output and standard error so that unprintable characters are escaped."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and not isinstance(stream, EscapingStream):
            setattr(sys, name, EscapingStream(stream))


class _StderrLogHandler(logging.StreamHandler[Any]):
    """Log handler that writes to the current standard error, above a progress bar if any.

    Python's handler of last resort also looks up the stream at each write.
    """

    @property
    def stream(self) -> Any:
        """Current standard error stream; None if it is closed."""
        return sys.stderr

    @stream.setter
    def stream(self, value: Any) -> None:
        """Ignore the stream that the base class assigns; the getter looks up standard error."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a log record to standard error; do nothing if standard error is closed."""
        if self.stream is not None:
            super().emit(record)


def _enable_logging(ctx: click.Context, _: click.Parameter, verbosity: int) -> None:
    """Click callback of --verbose: write the package's log to standard error.

    `verbosity` 1 (-v) writes the steps, 2 (-vv) each task as well, 0 nothing.
    """
    if not verbosity:
        return
    log, handler = logging.getLogger("sweep"), _StderrLogHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s", "%H:%M:%S"))
    level, propagates = log.level, log.propagate
    log.addHandler(handler)
    log.setLevel(logging.INFO if verbosity == 1 else logging.DEBUG)
    log.propagate = False

    def restore() -> None:
        log.removeHandler(handler)
        log.setLevel(level)  # this also clears the cached levels of child loggers
        log.propagate = propagates

    ctx.call_on_close(restore)


class CommandGroup(click.Group):
    """Click group of commands that reports a user's mistake in plain words, with exit code 2."""

    def add_command(self, cmd: click.Command, name: str | None = None) -> None:
        """Add a command to the group, with the option --verbose.

        The group's help lists the command with the first paragraph of its help.
        """
        cmd.short_help = " ".join((cmd.help or "").split("\n\n")[0].split())
        cmd.params.append(
            click.Option(
                ["-v", "--verbose"],
                count=True,
                expose_value=False,
                callback=_enable_logging,
                help="Log the steps of the command to standard error; -vv logs each task too.",
            )
        )
        super().add_command(cmd, name)

    def main(self, *args: Any, **options: Any) -> Any:
        """Run the command line, with unprintable characters escaped in all output and tracebacks.

        Closed output streams do not change the exit code. Standard output and error stay wrapped
        after this function, because Python prints an error's traceback later.
        """
        try:
            with silence_failing_output():
                _escape_output_streams()
                with suggest_shell_commands():
                    return super().main(*args, **options)
        finally:
            _escape_output_streams()

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; print a user's mistake as a message, and let all other errors pass."""
        try:
            Path.cwd()
        except FileNotFoundError:
            click.echo("the current folder was removed: go to another", err=True)
            ctx.exit(EXIT_MISTAKE)
        try:
            return super().invoke(ctx)
        except (click.exceptions.Exit, click.ClickException, click.Abort):
            raise
        except Exception as error:
            from sweep.extras import install_hint
            from sweep.model.unsupported_shot import UnsupportedShotError
            from sweep.regular_files import RefusedFileError
            from sweep.scenes.scene_files import SceneError
            from sweep.spec import SpecError
            from sweep.storage.locations import ObjectStoreError, to_object_store_error
            from sweep.storage.store_format import StoreReplacedError
            from sweep.storage.verified_store import DamagedChunkError
            from sweep.tasks.engine.progress import RunRequestError, StoreError

            user_error_types = (
                DamagedChunkError, ObjectStoreError, StoreReplacedError, SceneError, SpecError,
                StoreError, RunRequestError, RefusedFileError, UnsupportedShotError,
            )  # fmt: skip
            readable_error = to_object_store_error(error)
            if message := install_hint(readable_error):
                echo_wrapped(message, err=True)
            elif isinstance(readable_error, user_error_types):
                echo_wrapped(str(readable_error), err=True)
            elif isinstance(readable_error, OSError) and (
                message := _unusable_path_message(readable_error)
            ):
                echo_wrapped(message, err=True)
            else:
                raise
            ctx.exit(EXIT_MISTAKE)


def _unusable_path_message(error: OSError) -> str:
    """Return the message for an error of a file, folder or disk that can't be used; else ''."""
    from sweep.storage.locations import os_error_reason

    if error.errno in (errno.EMFILE, errno.ENFILE):
        return f"{error.strerror}: raise their limit, `ulimit -n`, and try again"
    if error.filename and error.errno in UNUSABLE_PATH_ERRNOS:
        cause = os_error_reason(error, Path(os.fsdecode(error.filename)))
        return f"{os.fsdecode(error.filename)}: {cause}: mend that, or name another place"
    if error.errno in DISK_FULL_ERRNOS:  # an error of a write has no file name
        return f"{error.strerror}: make room where the output goes, or name another place"
    return ""


@click.group(cls=CommandGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="sweep")
def main() -> None:
    """Sweep an FMCW Doppler lidar's parameters and store how well it detects.

    A study is a short YAML file. Its results are a Zarr store. A typical session:

    \b
      sweep plan experiments/quickstart.yaml      how much work is it?
      sweep run experiments/quickstart.yaml       compute it on all cores
      sweep status results/quickstart.zarr        show its progress (any time)
      sweep resume results/quickstart.zarr        continue after an interruption
      sweep extend results/quickstart.zarr ...    add values, axes, draws
      sweep verify results/quickstart.zarr        check every byte
      sweep figures results/quickstart.zarr       draw its figures
      sweep report results/quickstart.zarr        write one page for a browser
      sweep compare results/a.zarr results/b.zarr what differs between two studies?
      sweep accuracy experiments/quickstart.yaml  what does accuracy cost in time?
      sweep instruments                           which instruments can a spec name?

    A spec with a scene flies the lidar over terrain and makes point clouds. sweep export writes
    them as PLY, LAS or CSV, or as reports of the unit's interface.

    One Ctrl-C finishes the running blocks and stops. Results already written are kept.

    Exit codes: 0 done, 1 failed, 2 a mistake in the spec or the command, 3 incomplete (sweep resume
    continues).
    """  # noqa: D301


@main.command()
@SPEC_ARGUMENT
@click.option(
    "--store",
    type=StoreLocationType(),
    help="Store to write, on disk or s3://bucket/name.zarr [results/<name of the spec>.zarr].",
)
@click.option(
    "--overwrite",
    is_flag=True,
    help="Replace an existing store once the new one is complete; on disk only.",
)
@click.option(
    "--resume",
    "resuming",
    is_flag=True,
    help="Continue if the store is there and holds this study; the same command serves a job "
    "however often it is started.",
)
@click.option("--yes", is_flag=True, help="Start a very large study without asking.")
@add_run_options
def run(
    spec: Path, store: Location | None, overwrite: bool, resuming: bool, yes: bool, **options: Any
) -> None:
    """Compute the study SPEC into a Zarr store.

    The command asks for confirmation before a study of more than 1e9 points, 1 TB of results or 30
    days of one core.

    At the end a table shows the probability of detection. For a study with draws, a second table
    shows the number of points within accuracy.tolerance, and the draws that the worst point needs.

    \b
      sweep run experiments/quickstart.yaml
      sweep run experiments/range_angle.yaml --store /data/range_angle.zarr --workers 8
      sweep run experiments/range_angle.yaml --scheduler tcp://10.0.0.5:8786
      sweep run experiments/range_angle.yaml --cluster deploy/slurm.yaml --workers 200
      sweep run experiments/quickstart.yaml --scheduler none --overwrite
      sweep run experiments/range_angle.yaml --resume --cluster deploy/slurm.yaml
    """  # noqa: D301
    from sweep.spec import load
    from sweep.storage.locations import can_create_store
    from sweep.tasks import driver

    if overwrite and resuming:
        raise click.UsageError("--overwrite starts again, and --resume continues: give one of them")
    study_spec, path = load(spec), store or _default_store_path(spec)
    if can_create_store(path) or not resuming:  # else the user confirmed when the study began
        confirm_large_study(study_spec, path, yes=yes)
    outcome = driver.run(study_spec, store=path, overwrite=overwrite, resume=resuming, **options)
    print_outcome_and_exit(outcome, shorten_path(path))


def _default_store_path(spec: Path) -> Path:
    """Return the path of the store for a spec file, for a command without the option --store."""
    return Path("results") / f"{spec.stem}.zarr"


@main.command()
@STORE_ARGUMENT
@click.option(
    "--spec",
    type=LocalPathType(exists=True, dir_okay=False),
    help="Resume only if the store holds this study.",
)
@click.option("--retry-failed", is_flag=True, help="Compute again the blocks that failed before.")
@add_run_options
def resume(store: Location, spec: Path | None, retry_failed: bool, **options: Any) -> None:
    """Compute the missing and damaged blocks of STORE.

    Blocks that failed twice are skipped unless --retry-failed is given, because they might kill a
    worker in every later run. sweep status lists them with their errors.

    \b
      sweep resume results/range_angle.zarr
      sweep resume results/range_angle.zarr --spec experiments/range_angle.yaml --workers 4
    """  # noqa: D301
    from sweep.spec import load
    from sweep.tasks import driver

    expected_spec = load(spec) if spec else None
    print_outcome_and_exit(
        driver.resume(store, spec=expected_spec, retry_failed=retry_failed, **options), store
    )


@main.command()
@SPEC_ARGUMENT
@WORKERS_OPTION
@ALLOW_CODE_OPTION
def plan(spec: Path, workers: int | None) -> None:
    """Print the size and time of SPEC, and the effects it simulates. No store is written.

    The time, with its parts, is estimated from some points of the study, which takes about a
    second. For a flight, all shots are counted, and a few that are spread over it are timed. A
    table lists the effects: the points at which an effect is simulated, and a bound on its change
    of pd, log10 pfa or magnitude. For grids the table also has the effect's share of a point's
    time, if repeated measurements of it agree to 10 %.
    """
    from sweep.tasks.engine.progress import show_activity

    with show_activity("planning"):
        from sweep.spec import load

        study_spec = load(spec)
        rows = list(plan_rows(study_spec, _default_store_path(spec), workers))
        effects = study_effects_table(study_spec, _default_store_path(spec))
    if alarms := false_alarm_text(study_spec):
        rows.append(("false alarms", alarms))
    # All rows are computed before printing: each may find a point that can't be simulated.
    for name, value in rows:
        click.echo(wrap_text(f"{name:>12}  {value}", 2 + len(name)))
    print_effects(effects)
    print_spec_warnings(study_spec)
    print_echo_warnings(study_spec, _default_store_path(spec))


@main.command()
@SPEC_ARGUMENT
@at_option("Value of a parameter; can be repeated.")
@click.option(
    "--noise/--no-noise", default=True, help="Add the noise of one draw [default], or not."
)
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the noise [the spec's].")
@output_dir_option("Directory of the figure [results/<name of the spec>].")
@FIGURE_FORMAT_OPTION
def shot(
    spec: Path, at: tuple[str, ...], noise: bool, seed: int | None, output: Path | None, form: str
) -> None:
    """Simulate one shot of SPEC: spectra, threshold, detections, noise budget.

    \b
      sweep shot experiments/single_shot_2000m.yaml
      sweep shot experiments/range_angle.yaml --at range=2km --at grazing_angle=45deg
    """  # noqa: D301
    from sweep.analysis.shot_spectra import write_shot_report
    from sweep.spec import SceneSpec, load
    from sweep.tasks.engine.progress import show_activity

    study_spec = load(spec)
    if isinstance(study_spec, SceneSpec):
        raise click.UsageError(
            f"{spec} is a study of a scene: run it, and ask for a figure of the kind shot_spectra"
        )
    with show_activity("simulating and drawing"):
        report_text, files = write_shot_report(
            study_spec,
            coordinate_values=parse_assignments(at),
            directory=output or Path("results") / spec.stem,
            draws_noise=noise,
            seed=study_spec.seed if seed is None else seed,
            picture_format=form,
        )
    click.echo(report_text)
    _print_paths(files)


def _print_paths(files: Sequence[Location]) -> None:
    """Print the path of each file on its own line; relative for files below the current folder."""
    for file in files:
        click.echo(shorten_path(file))


@main.command()
@SPEC_ARGUMENT
@click.option(
    "--store",
    type=StoreLocationType(),
    help="Store to write [results/<name of the spec>_accuracy.zarr].",
)
@click.option(
    "--points", type=click.IntRange(min=1), default=200, help="Points of the sample [200]."
)
@click.option(
    "--time-limit",
    type=click.FloatRange(min=0, min_open=True),
    default=60.0,
    metavar="SECONDS",
    help="Approximate limit of the time [60].",
)
@OVERWRITE_OPTION
def accuracy(
    spec: Path, store: Location | None, points: int, time_limit: float, overwrite: bool
) -> None:
    """Measure the time and the error of SPEC with several settings of accuracy.

    The command computes a fixed sample of the study's points with each of these settings: the spec
    as written; effects left out by tolerances from 0.1 to 1e-6; all effects everywhere; fixed
    numbers of beamlets or draws; and the algorithm of the thesis, which transforms whole records.

    The error of a setting is its difference from the finest setting, which is itself compared with
    the time domain. Every setting is timed in several rounds, and its fastest round is reported.
    Settings take turns within a round, so that a slow machine slows all of them. The time includes
    planning, but not storing.

    The table has each setting's time for one point on one core, and its errors. A star marks
    settings that no other setting beats in both time and error. The store holds errors by setting
    and point, and opens with xarray. The figure is next to the store, and `sweep figures` draws it
    again. Ctrl-C keeps the results so far.

    \b
      sweep accuracy experiments/quickstart.yaml
      sweep accuracy experiments/range_angle.yaml --points 1000 --time-limit 600
      sweep accuracy experiments/square_high_descent.yaml --overwrite
    """  # noqa: D301
    from sweep.spec import load
    from sweep.tasks.accuracy.measurement import measure_accuracy

    path = store or Path("results") / f"{spec.stem}_accuracy.zarr"
    has_results = measure_accuracy(
        load(spec), store_path=path, n_points=points, time_limit=time_limit, overwrite=overwrite
    )
    printed = print_accuracy_measurement(path, has_results=has_results)
    _print_paths(printed.files)
    if not printed.is_complete:
        sys.exit(EXIT_INCOMPLETE)


@main.command()
@STORE_ARGUMENT
@output_dir_option("Directory of the figures [NAME-figures next to NAME.zarr].")
@FIGURE_FORMAT_OPTION
def figures(store: Location, output: Path | None, form: str) -> None:
    """Draw the figures and tables of the study in STORE."""
    from sweep.tasks.engine.progress import show_activity

    with show_activity("drawing"):
        from sweep.analysis.study_figures import draw_figures

        files = draw_figures(store, output, form)
    _print_paths(files)


@main.command()
@STORE_ARGUMENT
@click.argument("file", type=LocalPathType(dir_okay=False))
@click.option("--scanner", help="Scanner of the points, if the study has several.")
@click.option("--draw", type=click.IntRange(min=0), default=0, help="Number of the draw [0].")
@click.option(
    "--ranges",
    default="interpolated",
    help="Ranges and velocities: interpolated between bins [default], or quantised to bins.",
)
@at_option("Value of a coordinate, if the study has axes; can be repeated.")
@click.option(
    "--as",
    "form",
    type=click.Choice(["points", "reports"]),
    default="points",
    help="Points as computed [default], or reports of the unit's interface, as .csv.",
)
@click.option(
    "--interface",
    multiple=True,
    metavar="NAME=VALUE",
    help="New value of a field of the spec's interface, for reports; can be repeated.",
)
def export(
    store: Location, file: Path, at: tuple[str, ...], form: str, interface: tuple[str, ...],
    **options: Any,
) -> None:  # fmt: skip
    """Write the point cloud in STORE to FILE: .ply, .las, .laz or .csv.

    With --as reports the file has what the lidar's interface would report of the points.
    Reported values are clipped to limits and rounded to multiples of a quantum. Reports come at the
    interface's rate and latency, and each has a flag of validity. The spec's section `interface`
    states rate, latency, quanta and limits. No point is computed again, so one store serves to try
    any interface.

    \b
      sweep export results/forest_scan.zarr forest.las
      sweep export results/scan_pattern_comparison.zarr four.ply \\
          --scanner four --at optical_efficiency=1
      sweep export results/descent.zarr reports.csv --as reports \\
          --interface rate=10Hz --interface "range_quantum=2 mm"
    """  # noqa: D301
    from sweep.tasks.engine.progress import show_activity

    options["where"] = parse_assignments(at)
    if interface and form != "reports":
        raise click.UsageError("--interface is of reports: add --as reports, or leave it out")
    with show_activity(f"writing {form}"):
        if form == "reports":
            from sweep.analysis.scene_results.interface_reports import reports

            interface_changes = parse_assignments(interface, "--interface", "rate=10Hz")
            count = reports(store, file, interface=interface_changes, **options).sizes["report"]
        else:
            from sweep.analysis.scene_results.point_export import export as write_point_cloud

            count = write_point_cloud(store, file, **options)
    click.echo(f"{shorten_path(file.absolute())}: {count:,} {form}")
    print_inconsistency_warnings(store, options["scanner"])


@main.command()
@click.argument("directory", type=LocalPathType(file_okay=False))
def certificates(directory: Path) -> None:
    """Make certificates for a cluster in DIRECTORY: ca.pem, certificate.pem and key.pem.

    The command prints lines for the cluster's file, the one that --cluster names. With these lines
    scheduler, workers and client use TLS, and refuse connections without such a certificate. All
    machines of the cluster must see the directory, and nobody else may read it. The certificates
    are valid for a year.
    """
    from sweep.tasks.engine.deploy.local_ssh import make_certificates

    files = make_certificates(directory.absolute())
    click.echo("security:")
    for name, file in files._asdict().items():
        click.echo(f"  {name}: {file}")


@main.command()
@click.argument("name", required=False)
def instruments(name: str | None) -> None:
    """List the instruments that a spec may name, or describe NAME.

    A spec takes a whole instrument, `instrument: settembrini_2026`, or changes some fields:

    \b
      instrument:
        like: settembrini_2026
        laser: {power: 1 mW}

    A store holds all fields of the instrument. The study is the same as with all fields in the
    spec. The description of NAME is YAML: saved as own.yaml and changed, it is an instrument of
    your own, `instrument: {file: own.yaml}`.

    \b
      sweep instruments
      sweep instruments settembrini_2026
      sweep instruments lander_ndl > own.yaml
    """  # noqa: D301
    from sweep.cli.terminal import instrument_yaml_lines
    from sweep.spec.rules import suggest_similar_name
    from sweep.spec.yaml_document import library_instrument_files, read_document

    library_files = library_instrument_files()
    if name is not None and name not in library_files:
        hint = suggest_similar_name(
            name, library_files, fallback=f"the library has {', '.join(library_files)}"
        )
        raise click.UsageError(f"{name!r} is no instrument of the library; {hint}")
    for instrument_name in [name] if name else library_files:
        instrument_file = read_document(library_files[instrument_name]).content
        lines = (
            instrument_yaml_lines(instrument_file)
            if name
            else [wrap_text(f"{instrument_name:<24} {instrument_file['title']}", 25)]
        )
        click.echo("\n".join(lines))


@main.command()
def schema() -> None:
    """Print the JSON Schema of specs, for editors that check a spec as you type."""
    import json

    from sweep.spec import json_schema

    click.echo(json.dumps(json_schema(), indent=2))


@main.command()
@click.argument("store", type=StoreLocationType())
@click.argument("spec", type=LocalPathType(exists=True, dir_okay=False), required=False)
@click.option(
    "--set",
    "fields",
    multiple=True,
    metavar="FIELD=VALUE",
    help="A field of the larger study, written as in a spec file; can be repeated.",
)
@click.option(
    "--store",
    "to",
    type=StoreLocationType(),
    help="Path of the larger store; the old store is then kept [replace STORE].",
)
@click.option(
    "--overwrite",
    is_flag=True,
    help="Discard an unfinished extension; with --store, replace an existing store.",
)
@add_run_options
def extend(
    store: Location,
    spec: Path | None,
    fields: tuple[str, ...],
    to: Location | None,
    overwrite: bool,
    **options: Any,
) -> None:
    """Extend STORE to a larger study, and compute only the new points and draws.

    The larger study is the one in the file SPEC, or the one in STORE with fields changed by --set.
    It may have more values on an axis, a new axis, more draws, a tighter tolerance, or more
    scanners of a flight. Points in STORE are reused. The result has the same bytes as the larger
    study run at once.

    The larger store is made in the same folder and replaces STORE once it is complete. Until then
    STORE does not change. After an interruption sweep extend, or sweep resume STORE, continues.

    \b
      sweep extend results/range_angle.zarr experiments/range_angle.yaml
      sweep extend results/range_angle.zarr --set 'axes.target.reflectance=[0.05, 0.1, 0.2]'
      sweep extend results/speckled_target.zarr --set draws.limit=1e7 --workers 8
      sweep extend results/gale_crater_descent.zarr --set draws.number=200 --workers 8
      sweep extend s3://bucket/a.zarr larger.yaml --store s3://bucket/b.zarr
    """  # noqa: D301
    from sweep.spec import load
    from sweep.spec.specs import parse_field_values
    from sweep.tasks import driver

    if spec is None and not fields:
        raise click.UsageError("name the larger study, or what is to change in it with --set")
    outcome = driver.extend(
        store,
        load(spec) if spec else None,
        changes=parse_field_values(parse_assignments(fields, "--set", "draws.limit=1e6"))
        if fields
        else None,
        to=to,
        overwrite=overwrite,
        **options,
    )
    print_outcome_and_exit(outcome, shorten_path(to or store))


@main.command()
@click.argument("study", type=StoreLocationType())
@at_option("Value of a parameter; can be repeated. Other axes take their first value.")
@click.option("--draws", type=click.IntRange(min=1), default=1, help="Number of draws [1].")
@click.option("--first", type=click.IntRange(min=0), default=0, help="First draw [0].")
@click.option(
    "-o",
    "--output",
    type=LocalPathType(),
    required=True,
    help="File to write: .zarr (opens with xarray) or .npz (with numpy).",
)
@OVERWRITE_OPTION
def spectra(
    study: Location, at: tuple[str, ...], draws: int, first: int, output: Path, overwrite: bool
) -> None:
    """Write spectra of a shot of STUDY, a spec or a store, with noise in every bin.

    Use the spectra to try your own detectors and estimators. The file holds a complex spectrum for
    each draw and segment, the frequencies, the noise level, the threshold and the window. It also
    holds the true lines, range and velocity. A study with draws.method: spectra has the same draws.

    \b
      sweep spectra experiments/cfar.yaml --at range=2km --draws 100 -o spectra.npz
      sweep spectra results/cfar.zarr --at range=2km --at window=hann -o spectra.zarr
      sweep spectra s3://bucket/cfar.zarr --at range=2km -o spectra.npz
    """  # noqa: D301
    from sweep.analysis.shot_spectra import select_shot_parameters
    from sweep.spec import GridSpec, load
    from sweep.tasks.engine.progress import show_activity
    from sweep.tasks.studies.spectra_export import draw_point_spectra as draw_spectra
    from sweep.tasks.studies.spectra_export import write_spectra
    from sweep.tasks.studies.study_loading import read_study

    is_file = isinstance(study, Path) and not study.is_dir()
    spec = load(str(study)) if is_file else read_study(study).study.spec
    if not isinstance(spec, GridSpec):
        raise click.UsageError(f"{study} is a study of a scene: spectra are those of a flat target")
    parameters = select_shot_parameters(spec, parse_assignments(at))[0].parameters
    with show_activity("drawing spectra"):
        dataset = draw_spectra(spec, parameters, n_draws=draws, first_draw=first)
        write_spectra(dataset, output, overwrite=overwrite)
    sizes = ", ".join(f"{size:,} {name}" for name, size in dataset.spectrum.sizes.items())
    click.echo(f"{output}: {sizes}")
