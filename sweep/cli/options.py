"""Options of the commands that compute: how, and what is told of it."""

from __future__ import annotations

from pathlib import Path

import click

WORKERS = click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Workers to start [all cores here; those of --cluster].",
)
SCHEDULER = click.option(
    "--scheduler", metavar="ADDRESS|none", help="A Dask scheduler, or none: a plain loop, no Dask."
)
CLUSTER = click.option(
    "--cluster",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="A file that describes a cluster: deploy/ has one of each kind.",
)
BLOCK_TIMEOUT = click.option(
    "--block-timeout",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="Give a block up that takes longer, twice [none].",
)
PERFORMANCE_REPORT = click.option(
    "--performance-report",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="FILE.html",
    help="Write Dask's own account of the run.",
)
DURABLE = click.option(
    "--durable", is_flag=True, help="Blocks count once they are on the disk: safe from power loss."
)
