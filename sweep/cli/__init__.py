"""The `sweep` command."""

from sweep.cli.commands import main
from sweep.cli.store_commands import compare, finalize, report, status, verify

for command in (status, verify, finalize, report, compare):
    main.add_command(command)

__all__ = ["main"]
