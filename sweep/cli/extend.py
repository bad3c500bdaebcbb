"""`sweep extend`: a store turned into that of a larger study."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sweep.cli.options import LocalPath, StorePath, assignments, computing, shown
from sweep.cli.telling import conclude
from sweep.storage.locations import Location


@click.command()
@click.argument("store", type=StorePath())
@click.argument("spec", type=LocalPath(exists=True, dir_okay=False), required=False)
@click.option(
    "--set",
    "fields",
    multiple=True,
    metavar="FIELD=VALUE",
    help="A field of the larger study, as it would stand in a file; as often as needed.",
)
@click.option(
    "--store",
    "to",
    type=StorePath(),
    help="Where the larger store goes; the old one then stays [in its place].",
)
@click.option(
    "--overwrite",
    is_flag=True,
    help="Begin anew where one was begun; with --store, replace what is there.",
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
    """Extend STORE to a larger study, and compute only what is new.

    The larger study is the one in the file SPEC, or the one in STORE with fields --set anew: more
    values on an axis, a new axis, more draws, a tighter tolerance, more scanners of a flight. What
    STORE has of it is taken from there; what comes out is, byte for byte, the larger study run at
    once.

    The larger store is made beside STORE and takes its place once it is complete. Until then
    nothing in STORE changes; sweep extend, or sweep resume STORE, goes on after an interruption.

    \b
      sweep extend results/range_angle.zarr experiments/range_angle.yaml
      sweep extend results/range_angle.zarr --set 'axes.target.reflectance=[0.05, 0.1, 0.2]'
      sweep extend results/speckled_target.zarr --set draws.limit=1e7 --workers 8
      sweep extend results/gale_crater_descent.zarr --set draws.number=200 --workers 8
      sweep extend s3://bucket/a.zarr larger.yaml --store s3://bucket/b.zarr
    """  # noqa: D301
    from sweep.spec import load
    from sweep.spec.loading import written
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
