"""Compiles what most tests need, once: `make test` lets two processes do that, half of it each.

As many as there are tests' processes would each compile the same kernels, since none finds on disk
what another is still at.
"""

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "tasks"))

from small import quiet, small
from small_flights import small_scene


def grids(place: Path) -> None:
    """The engine, and all ways to draw."""
    for method in ("probabilities", "noise", "spectra"):
        quiet(small(axes={}, draws={"method": method, "number": 1}), place / method)


def flights(place: Path) -> None:
    """Meshes and points, and their returns."""
    draws = {"method": "noise", "number": 1, "returns": 2}
    quiet(small_scene(axes={}, draws=draws), place / "flight")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        {"grids": grids, "flights": flights}[sys.argv[1]](Path(folder))
