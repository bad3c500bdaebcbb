"""Compiles what most tests need, once: `make test` lets two processes do that, half of it each.

As many as there are tests' processes would each compile the same kernels, since none finds on disk
what another is still at.
"""

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "tasks"))

from small_flights import small_scene_spec
from small_studies import run_serially, small_spec


def run_grids(directory: Path) -> None:
    """The engine, and all ways to draw."""
    for method in ("probabilities", "noise", "spectra"):
        run_serially(small_spec(axes={}, draws={"method": method, "number": 1}), directory / method)


def run_flights(directory: Path) -> None:
    """Meshes and points, and their returns."""
    draws = {"method": "noise", "number": 1, "returns": 2}
    run_serially(small_scene_spec(axes={}, draws=draws), directory / "flight")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        {"grids": run_grids, "flights": run_flights}[sys.argv[1]](Path(folder))
