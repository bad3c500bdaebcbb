"""The `sweep` command: reads what is asked for, hands it on, prints what comes back."""

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
    ALLOW_CODE,
    FORMAT,
    INCOMPLETE,
    MISTAKE,
    OVERWRITE,
    SPEC,
    STORE,
    WORKERS,
    LocalPath,
    StorePath,
    alarms_told,
    ask_before,
    assignments,
    at,
    computing,
    conclude,
    conclude_accuracy,
    effects_of,
    folded,
    folder,
    plan_lines,
    shown,
    tell,
    tell_effects,
    tell_inconsistencies,
    warn_of,
    warn_of_echoes,
)
from sweep.messages import PrintableStream, as_command
from sweep.storage.locations import Location
from sweep.tasks.streams import forgiving_output

#: Errors of a file or folder that is not to be used: no permission, no room, something in the way.
UNUSABLE = {
    errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.ENOTDIR, errno.EEXIST,
    errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP,
}  # fmt: skip


#: Errors of a disk that takes no more.
FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def _make_output_printable() -> None:
    """Filter what is written to standard output and error from here on."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and not isinstance(stream, PrintableStream):
            setattr(sys, name, PrintableStream(stream))


class _StandardError(logging.StreamHandler[Any]):
    """Log handler that writes to what is standard error at that time, above a bar if there is one.

    Parallel to Python's handler of last resort.
    """

    @property
    def stream(self) -> Any:
        """Standard error; None if it is closed."""
        return sys.stderr

    @stream.setter
    def stream(self, value: Any) -> None:
        """Ignore the stream that the base class keeps."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, if anything can be written."""
        if self.stream is not None:
            super().emit(record)


def _show_log(ctx: click.Context, _: click.Parameter, verbosity: int) -> None:
    """Write the log of the package to standard error: its steps, and each task if asked twice."""
    if not verbosity:
        return
    log, handler = logging.getLogger("sweep"), _StandardError()
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s", "%H:%M:%S"))
    before = log.level, log.propagate
    log.addHandler(handler)
    log.setLevel(logging.INFO if verbosity == 1 else logging.DEBUG)
    log.propagate = False

    def restore() -> None:
        log.removeHandler(handler)
        log.level, log.propagate = before

    ctx.call_on_close(restore)


class Commands(click.Group):
    """Commands whose users' mistakes end in plain words and exit code 2."""

    def add_command(self, cmd: click.Command, name: str | None = None) -> None:
        """Add a command, listed with the whole first paragraph of its help, that can be verbose."""
        cmd.short_help = " ".join((cmd.help or "").split("\n\n")[0].split())
        cmd.params.append(
            click.Option(
                ["-v", "--verbose"],
                count=True,
                expose_value=False,
                callback=_show_log,
                help="Log the steps of the command to standard error; -vv logs each task too.",
            )
        )
        super().add_command(cmd, name)

    def main(self, *args: Any, **options: Any) -> Any:
        """Run the command line; whatever it prints, a traceback too, is printable.

        The exit code does not depend on anybody hearing what it says. Streams stay wrapped, as
        Python prints the traceback of an error after this function.
        """
        try:
            with forgiving_output():
                _make_output_printable()
                with as_command():
                    return super().main(*args, **options)
        finally:
            _make_output_printable()

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; what is not a mistake of the user's keeps its traceback."""
        try:
            Path.cwd()
        except FileNotFoundError:
            click.echo("the current folder was removed: go to another", err=True)
            ctx.exit(MISTAKE)
        try:
            return super().invoke(ctx)
        except (click.exceptions.Exit, click.ClickException, click.Abort):
            raise
        except Exception as error:
            from sweep.extras import remedy
            from sweep.model.unsupported import UnsupportedShot
            from sweep.plain_files import UnfitFileError
            from sweep.scenes.files import SceneError
            from sweep.spec import SpecError
            from sweep.storage.locations import ObjectStoreError, worded
            from sweep.storage.opening import ReplacedError
            from sweep.storage.sound import DamagedChunkError
            from sweep.tasks.progress import StoreError, TaskError

            told = (
                DamagedChunkError, ObjectStoreError, ReplacedError, SceneError, SpecError,
                StoreError, TaskError, UnfitFileError, UnsupportedShot,
            )  # fmt: skip
            said = worded(error)
            if line := remedy(said):
                tell(line, err=True)
            elif isinstance(said, told):
                tell(str(said), err=True)
            elif isinstance(said, OSError) and (line := _unusable(said)):
                tell(line, err=True)
            else:
                raise
            ctx.exit(MISTAKE)


def _unusable(error: OSError) -> str:
    """Words for a file, folder or disk that is not to be used; empty for any other error."""
    from sweep.storage.locations import reason

    if error.errno in (errno.EMFILE, errno.ENFILE):
        return f"{error.strerror}: raise their limit, `ulimit -n`, and try again"
    if error.filename and error.errno in UNUSABLE:
        why = reason(error, Path(os.fsdecode(error.filename)))
        return f"{os.fsdecode(error.filename)}: {why}: mend that, or name another place"
    if error.errno in FULL:  # writing, which names no file
        return f"{error.strerror}: make room where the output goes, or name another place"
    return ""


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
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
@SPEC
@click.option(
    "--store",
    type=StorePath(),
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
@computing
def run(
    spec: Path, store: Location | None, overwrite: bool, resuming: bool, yes: bool, **how: Any
) -> None:
    """Compute the study SPEC into a Zarr store.

    Studies of more than 1e9 points, 1 TB of results or 30 days of one core ask before they start.

    A table at the end has the probability of detection. For a study with draws, a second table has
    the number of points within accuracy.tolerance, and the draws that the worst point needs.

    \b
      sweep run experiments/quickstart.yaml
      sweep run experiments/range_angle.yaml --store /data/range_angle.zarr --workers 8
      sweep run experiments/range_angle.yaml --scheduler tcp://10.0.0.5:8786
      sweep run experiments/range_angle.yaml --cluster deploy/slurm.yaml --workers 200
      sweep run experiments/quickstart.yaml --scheduler none --overwrite
      sweep run experiments/range_angle.yaml --resume --cluster deploy/slurm.yaml
    """  # noqa: D301
    from sweep.spec import load
    from sweep.storage.locations import is_free
    from sweep.tasks import driver

    if overwrite and resuming:
        raise click.UsageError("--overwrite begins anew, and --resume goes on: give one of them")
    study, path = load(spec), store or _default_store(spec)
    if is_free(path) or not resuming:  # else it was asked as it was begun
        ask_before(study, path, yes=yes)
    outcome = driver.run(study, store=path, overwrite=overwrite, resume=resuming, **how)
    conclude(outcome, shown(path))


def _default_store(spec: Path) -> Path:
    return Path("results") / f"{spec.stem}.zarr"


@main.command()
@STORE
@click.option(
    "--spec",
    type=LocalPath(exists=True, dir_okay=False),
    help="Resume only if the store holds this study.",
)
@click.option("--retry-failed", is_flag=True, help="Compute again the blocks that failed before.")
@computing
def resume(store: Location, spec: Path | None, retry_failed: bool, **how: Any) -> None:
    """Compute the missing and damaged blocks of STORE.

    Blocks that failed twice are skipped unless --retry-failed is given, because they might kill a
    worker in every later run. sweep status lists them with their errors.

    \b
      sweep resume results/range_angle.zarr
      sweep resume results/range_angle.zarr --spec experiments/range_angle.yaml --workers 4
    """  # noqa: D301
    from sweep.spec import load
    from sweep.tasks import driver

    asked = load(spec) if spec else None
    conclude(driver.resume(store, spec=asked, retry_failed=retry_failed, **how), store)


@main.command()
@SPEC
@WORKERS
@ALLOW_CODE
def plan(spec: Path, workers: int | None) -> None:
    """Print the size and time of SPEC, and the effects it simulates. Nothing is written.

    The time is measured on points of the study, in about a second. For each effect a table gives
    the points at which it is simulated, a bound on its change of pd, log10 pfa or magnitude, and
    its share of a point's time.
    """
    from sweep.tasks.progress import working

    with working("planning"):
        from sweep.spec import load

        study = load(spec)
        lines = list(plan_lines(study, _default_store(spec), workers))
        effects = effects_of(study, _default_store(spec))
    if alarms := alarms_told(study):
        lines.append(("false alarms", alarms))
    # Nothing is printed before all is known: any of it may find a point that can't be simulated.
    for name, text in lines:
        click.echo(folded(f"{name:>12}  {text}", 2 + len(name)))
    tell_effects(effects)
    warn_of(study)
    warn_of_echoes(study, _default_store(spec))


@main.command()
@SPEC
@at("Value of a parameter; can be repeated.")
@click.option(
    "--noise/--no-noise", default=True, help="Add the noise of one draw [default], or not."
)
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the noise [the spec's].")
@folder("Directory of the figure [results/<name of the spec>].")
@FORMAT
def shot(
    spec: Path, at: tuple[str, ...], noise: bool, seed: int | None, output: Path | None, form: str
) -> None:
    """Simulate one shot of SPEC: spectra, threshold, detections, noise budget.

    \b
      sweep shot experiments/single_shot_2000m.yaml
      sweep shot experiments/range_angle.yaml --at range=2km --at grazing_angle=45deg
    """  # noqa: D301
    from sweep.analysis.shot_figure import report
    from sweep.spec import SceneSpec, load
    from sweep.tasks.progress import working

    study = load(spec)
    if isinstance(study, SceneSpec):
        raise click.UsageError(
            f"{spec} is a study of a scene: run it, and ask for a figure of the kind shot_spectra"
        )
    with working("simulating and drawing"):
        text, files = report(
            study,
            at=assignments(at),
            directory=output or Path("results") / spec.stem,
            noise=noise,
            seed=study.seed if seed is None else seed,
            form=form,
        )
    click.echo(text)
    _list(files)


def _list(files: Sequence[Location]) -> None:
    for file in files:
        click.echo(shown(file))


@main.command()
@SPEC
@click.option(
    "--store",
    type=StorePath(),
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
@OVERWRITE
def accuracy(
    spec: Path, store: Location | None, points: int, time_limit: float, overwrite: bool
) -> None:
    """Measure what accuracy costs in SPEC: error against time of a ladder of settings.

    The command computes a sample of the study's own points, the same every time, with many
    settings. These are the spec as written, effects on demand at tolerances from 0.1 to 1e-6, all
    effects on, and the same effects everywhere. Fixed numbers of beamlets or draws and the thesis's
    way are measured too.
    Errors are differences from the finest setting, which is compared with the time domain. All
    settings take turns on parts of the sample, round after round, so that a slow machine slows
    them alike; the best round counts. Planning is counted, storing is not.

    The table has the time a point on one core and the errors. A star marks settings that no other
    setting beats in both time and error. The store holds errors by setting and point, and opens
    with xarray. The figure is next to the store, and `sweep figures` draws it again. Ctrl-C keeps
    the results so far.

    \b
      sweep accuracy experiments/quickstart.yaml
      sweep accuracy experiments/range_angle.yaml --points 1000 --time-limit 600
      sweep accuracy experiments/square_high_descent.yaml --overwrite
    """  # noqa: D301
    from sweep.spec import load
    from sweep.tasks.accuracy.measure import measure

    path = store or Path("results") / f"{spec.stem}_accuracy.zarr"
    measured = measure(
        load(spec), store_path=path, points=points, time_limit=time_limit, overwrite=overwrite
    )
    files, whole = conclude_accuracy(path, measured=measured)
    _list(files)
    if not whole:
        sys.exit(INCOMPLETE)


@main.command()
@STORE
@folder("Directory of the figures [NAME-figures next to NAME.zarr].")
@FORMAT
def figures(store: Location, output: Path | None, form: str) -> None:
    """Draw the figures and tables of the study in STORE."""
    from sweep.tasks.progress import working

    with working("drawing"):
        from sweep.analysis.figures import draw

        files = draw(store, output, form)
    _list(files)


@main.command()
@STORE
@click.argument("file", type=LocalPath(dir_okay=False))
@click.option("--scanner", help="Scanner of the points, if the study has several.")
@click.option("--draw", type=click.IntRange(min=0), default=0, help="Number of the draw [0].")
@click.option(
    "--ranges",
    default="interpolated",
    help="Ranges and velocities: interpolated between bins [default], or quantised to bins.",
)
@at("Value of a coordinate, if the study has axes; can be repeated.")
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
    **how: Any,
) -> None:  # fmt: skip
    """Write the point cloud in STORE to FILE: .ply, .las, .laz or .csv.

    Reports are the points as a unit's interface passes them on: values in whole quanta and within
    limits, at its own rate, with a flag of validity and a latency. The spec's section `interface`
    states these. No point is computed again, so one store serves to try any interface.

    \b
      sweep export results/forest_scan.zarr forest.las
      sweep export results/scan_pattern_comparison.zarr four.ply \\
          --scanner four --at optical_efficiency=1
      sweep export results/descent.zarr reports.csv --as reports \\
          --interface rate=10Hz --interface "range_quantum=2 mm"
    """  # noqa: D301
    from sweep.tasks.progress import working

    how["where"] = assignments(at)
    if interface and form != "reports":
        raise click.UsageError("--interface is of reports: add --as reports, or leave it out")
    with working(f"writing {form}"):
        if form == "reports":
            from sweep.analysis.reports import reports

            set_anew = assignments(interface, "--interface", "rate=10Hz")
            number = reports(store, file, interface=set_anew, **how).sizes["report"]
        else:
            from sweep.analysis.export import export as write

            number = write(store, file, **how)
    click.echo(f"{shown(file.absolute())}: {number:,} {form}")
    tell_inconsistencies(store, how["scanner"])


@main.command()
@click.argument("directory", type=LocalPath(file_okay=False))
def certificates(directory: Path) -> None:
    """Make certificates for a cluster in DIRECTORY: ca.pem, certificate.pem and key.pem.

    Put the output into the cluster's file. Scheduler, workers and client then use TLS, and refuse
    connections without such a certificate. All machines of the cluster must see the directory, and
    nobody else may read it. The certificates are valid for a year.
    """
    from sweep.tasks.clusters.machines import make_certificates

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
    spec. The description of NAME is a file to begin one's own with, `instrument: {file: own.yaml}`.

    \b
      sweep instruments
      sweep instruments settembrini_2026
      sweep instruments lander_ndl > own.yaml
    """  # noqa: D301
    from sweep.cli.terminal import instrument_lines
    from sweep.spec.reading import library, read_document
    from sweep.spec.rules import near_miss

    known = library()
    if name is not None and name not in known:
        close = near_miss(name, known, otherwise=f"the library has {', '.join(known)}")
        raise click.UsageError(f"{name!r} is no instrument of the library; {close}")
    for each in [name] if name else known:
        own = read_document(known[each]).value
        lines = instrument_lines(own) if name else [folded(f"{each:<24} {own['title']}", 25)]
        click.echo("\n".join(lines))


@main.command()
def schema() -> None:
    """Print the JSON Schema of specs, for editors that check a spec as you type."""
    import json

    from sweep.spec import json_schema

    click.echo(json.dumps(json_schema(), indent=2))


@main.command()
@click.argument("store", type=StorePath())
@click.argument("spec", type=LocalPath(exists=True, dir_okay=False), required=False)
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
    type=StorePath(),
    help="Path of the larger store; the old store is then kept [replace STORE].",
)
@click.option(
    "--overwrite",
    is_flag=True,
    help="Discard an unfinished extension; with --store, replace an existing store.",
)
@computing
def extend(
    store: Location,
    spec: Path | None,
    fields: tuple[str, ...],
    to: Location | None,
    overwrite: bool,
    **how: Any,
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
    from sweep.spec.study import written
    from sweep.tasks import driver

    if spec is None and not fields:
        raise click.UsageError("name the larger study, or what is to change in it with --set")
    outcome = driver.extend(
        store,
        load(spec) if spec else None,
        changes=written(assignments(fields, "--set", "draws.limit=1e6")) if fields else None,
        to=to,
        overwrite=overwrite,
        **how,
    )
    conclude(outcome, shown(to or store))


@main.command()
@click.argument("study", type=StorePath())
@at("Value of a parameter; can be repeated. Other axes take their first value.")
@click.option("--draws", type=click.IntRange(min=1), default=1, help="Number of draws [1].")
@click.option("--first", type=click.IntRange(min=0), default=0, help="First draw [0].")
@click.option(
    "-o",
    "--output",
    type=LocalPath(),
    required=True,
    help="File to write: .zarr (opens with xarray) or .npz (with numpy).",
)
@OVERWRITE
def spectra(
    study: Location, at: tuple[str, ...], draws: int, first: int, output: Path, overwrite: bool
) -> None:
    """Write spectra of a shot of STUDY, a spec or a store, with noise in every bin.

    Use the spectra to try your own detectors and estimators. They are complex, draw by draw, with
    frequencies, noise level, threshold and window. The true lines, range and velocity are there
    too. A study with draws.method: spectra has the same draws.

    \b
      sweep spectra experiments/cfar.yaml --at range=2km --draws 100 -o spectra.npz
      sweep spectra results/cfar.zarr --at range=2km --at window=hann -o spectra.zarr
      sweep spectra s3://bucket/cfar.zarr --at range=2km -o spectra.npz
    """  # noqa: D301
    from sweep.analysis.shot_figure import chosen
    from sweep.spec import Spec, load
    from sweep.tasks.progress import working
    from sweep.tasks.spectra_export import spectra as drawn
    from sweep.tasks.spectra_export import write
    from sweep.tasks.studies import read

    is_file = isinstance(study, Path) and not study.is_dir()
    spec = load(str(study)) if is_file else read(study)[1].spec
    if not isinstance(spec, Spec):
        raise click.UsageError(f"{study} is a study of a scene: spectra are those of a flat target")
    _, parameters = chosen(spec, assignments(at))[0]
    with working("drawing spectra"):
        dataset = drawn(spec, parameters, draws=draws, first=first)
        write(dataset, output, overwrite=overwrite)
    sizes = ", ".join(f"{size:,} {name}" for name, size in dataset.spectrum.sizes.items())
    click.echo(f"{output}: {sizes}")
