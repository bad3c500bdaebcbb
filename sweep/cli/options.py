"""Options that several commands have: how they compute, and the format of pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from sweep.cli.places import LocalPath

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
    type=LocalPath(exists=True, dir_okay=False),
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
    type=LocalPath(dir_okay=False),
    metavar="FILE.html",
    help="Write Dask's own account of the run.",
)
DURABLE = click.option(
    "--durable", is_flag=True, help="Blocks count once they are on the disk: safe from power loss."
)

FORMAT = click.option(
    "--format",
    "form",
    type=click.Choice(["png", "pdf", "svg"]),
    default="png",
    help="Format of the pictures [png]; pdf and svg for print.",
)


def _allow(context: click.Context, parameter: click.Parameter, modules: tuple[str, ...]) -> None:
    from sweep.tasks.user_code import allow

    allow(modules)


ALLOW_CODE = click.option(
    "--allow-code",
    multiple=True,
    metavar="MODULE",
    expose_value=False,
    callback=_allow,
    help="Let the study run detectors and estimators of this Python module; as often as needed.",
)


def computing(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of all that compute, which it hands on as they are."""
    options = (
        WORKERS, SCHEDULER, CLUSTER, ALLOW_CODE, BLOCK_TIMEOUT, DURABLE, PERFORMANCE_REPORT,
    )  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command
