"""Commands that write a file each: certificates for a cluster, the schema of specs."""

from __future__ import annotations

from pathlib import Path

import click

from sweep.cli.places import LocalPath


@click.command()
@click.argument("directory", type=LocalPath(file_okay=False))
@click.option("--days", type=click.IntRange(min=1), default=365, help="How long they hold [365].")
def certificates(directory: Path, days: int) -> None:
    """Make certificates for a cluster in DIRECTORY: ca.pem, certificate.pem and key.pem.

    What is printed goes into the cluster's file: scheduler, workers and client then talk TLS, and
    refuse whoever has no such certificate. Keep the directory to yourself, where all machines of
    the cluster see it.
    """
    from sweep.tasks.clusters.certificates import make

    files = make(directory.absolute(), days)
    click.echo("security:")
    for name, file in files._asdict().items():
        click.echo(f"  {name}: {file}")


@click.command()
def schema() -> None:
    """Print the JSON Schema of specs, for editors that check while one types."""
    import json

    from sweep.spec import json_schema

    click.echo(json.dumps(json_schema(), indent=2))
