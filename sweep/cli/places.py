"""How places of stores are written on the command line."""

from __future__ import annotations

import os
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
        """The path, as click checks it."""
        return super().convert(os.path.expanduser(value), param, ctx)


class StorePath(click.ParamType):
    """A path, or an address in an object store."""

    name = "path"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> Location:
        """The place that is meant."""
        return located(str(value))

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Paths, as the shell completes them."""
        return [CompletionItem(incomplete, type="file")]


def shown(path: Location) -> Location:
    """A place as short as it can be written from here."""
    here = Path.cwd()
    if isinstance(path, Path) and path.is_relative_to(here):
        return path.relative_to(here)
    return path
