"""Places and values as the command line takes them, and options that several commands share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from sweep.storage.locations import Location, located


class LocalPath(click.Path):
    """A path here, in which ~ stands for the user's own folder, after `--output=` too."""

    def __init__(self, **rules: Any) -> None:
        super().__init__(path_type=Path, **rules)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path, as click checks it."""
        return super().convert(os.path.expanduser(value), param, ctx)


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
    here = Path.cwd()
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
    )  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command
