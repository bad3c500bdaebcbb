"""The `sweep` command."""

from sweep.cli.commands import main
from sweep.cli.stores import status, verify

main.add_command(status)
main.add_command(verify)

__all__ = ["main"]
