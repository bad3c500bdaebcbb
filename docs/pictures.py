"""Draws the pictures of README and docs/ from the present model: `make pictures`.

Each picture carries the identity of its study, the model's version included, and a digest of the
figure's fields. `is_current` compares these with the experiment as it is now, without drawing.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from PIL import Image

import sweep
from sweep.analysis import study_figures
from sweep.analysis.canvas import PNG_SOURCE_FIELD

DOCS = Path(__file__).parent
EXPERIMENTS = DOCS.parent / "experiments"


class Picture(NamedTuple):
    """A figure of an experiment, and the file in docs/ that shows it."""

    file: str
    experiment: str
    figure: str


PICTURES = (
    Picture("detection.png", "quickstart", "detection"),
    Picture("reach.png", "quickstart", "reach"),
    Picture("descent.png", "descent", "descent"),
    Picture("scan_patterns.png", "scan_pattern_comparison", "velocity_dim"),
)


def source(picture: Picture) -> str:
    """Return what a picture says of its source if it is drawn now."""
    spec = sweep.load(EXPERIMENTS / f"{picture.experiment}.yaml")
    (figure,) = (figure for figure in spec.figures if figure.file_stem == picture.figure)
    return study_figures.picture_source_text(spec.id, figure)


def is_current(picture: Picture) -> bool:
    """Tell whether a file shows the experiment and its figure as they are now."""
    if not (DOCS / picture.file).exists():
        return False
    with Image.open(DOCS / picture.file) as image:
        return image.info.get(PNG_SOURCE_FIELD) == source(picture)


def draw(experiment: str) -> None:
    """Compute an experiment in a temporary folder, and put its pictures into docs/."""
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / f"{experiment}.zarr"
        spec = sweep.load(EXPERIMENTS / f"{experiment}.yaml")
        outcome = sweep.run(spec, store=store, scheduler="none")
        if not outcome.complete:
            sys.exit(f"{experiment} is not complete: {outcome.stop_reason}")
        drawn = {
            path.name: path for path in study_figures.draw_figures(store, Path(folder) / "figures")
        }
        for picture in PICTURES:
            if picture.experiment == experiment:
                content = drawn[f"{picture.figure}.png"].read_bytes()
                (DOCS / picture.file).write_bytes(content)
                print(f"docs/{picture.file}")


if __name__ == "__main__":
    for name in dict.fromkeys(picture.experiment for picture in PICTURES):
        draw(name)
