"""The `sweep` command."""

from sweep.cli.commands import main

__all__ = ["main"]
