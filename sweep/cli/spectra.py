"""`sweep spectra`: spectra for code of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sweep.cli.options import LocalPath, StorePath
from sweep.storage.locations import Location

if TYPE_CHECKING:
    from sweep.spec import Spec


def declared(place: Location) -> Spec:
    """The study of a flat target in a spec's file or in a store.

    Raises
    ------
    UsageError
        Where it flies over a scene.
    """
    from sweep.spec import SceneSpec, Spec, load

    if isinstance(place, Path) and not place.is_dir():
        study: object = load(place)
    else:
        from sweep.tasks.studies import read

        study = read(place)[1].spec
    if isinstance(study, SceneSpec) or not isinstance(study, Spec):
        raise click.UsageError(f"{place} is a study of a scene: spectra are those of a flat target")
    return study


@click.command()
@click.argument("study", type=StorePath())
@click.option(
    "--at",
    "at",
    multiple=True,
    metavar="NAME=VALUE",
    help="A parameter's value; as often as needed. Axes that are not named take their first value.",
)
@click.option("--draws", type=click.IntRange(min=1), default=1, help="Number of draws [1].")
@click.option("--first", type=click.IntRange(min=0), default=0, help="Number of the first [0].")
@click.option(
    "-o",
    "--output",
    type=LocalPath(),
    required=True,
    help="File to write: .zarr (opens with xarray) or .npz (with numpy).",
)
@click.option("--overwrite", is_flag=True, help="Put the new file in the place of an old one.")
def spectra(
    study: Location, at: tuple[str, ...], draws: int, first: int, output: Path, overwrite: bool
) -> None:
    """Write spectra of a shot of STUDY, a spec or a store, with noise in every bin.

    For trying detectors and estimators of one's own: complex spectra, draw by draw, with
    frequencies, noise level, threshold, window, and what is true: lines, range and velocity.
    The draws are those that a study with draws.method: spectra looks at.

    \b
      sweep spectra experiments/cfar.yaml --at range=2km --draws 100 -o spectra.npz
      sweep spectra results/cfar.zarr --at range=2km --at window=hann -o spectra.zarr
      sweep spectra s3://bucket/cfar.zarr --at range=2km -o spectra.npz
    """  # noqa: D301
    from sweep.analysis.shot_figure import chosen
    from sweep.cli.options import assignments
    from sweep.tasks.progress import working
    from sweep.tasks.spectra_export import spectra as drawn
    from sweep.tasks.spectra_export import write

    spec = declared(study)
    _, parameters = chosen(spec, assignments(at))[0]
    with working("drawing spectra"):
        dataset = drawn(spec, parameters, draws=draws, first=first)
        write(dataset, output, overwrite=overwrite)
    sizes = ", ".join(f"{size:,} {name}" for name, size in dataset.spectrum.sizes.items())
    click.echo(f"{output}: {sizes}")
