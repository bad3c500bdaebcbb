"""The `sweep` command."""

from sweep.cli.commands import main
from sweep.cli.compare import compare
from sweep.cli.extend import extend
from sweep.cli.spectra import spectra
from sweep.cli.stores import finalize, report, status, verify

for command in (extend, status, verify, finalize, report, compare, spectra):
    main.add_command(command)

__all__ = ["main"]
