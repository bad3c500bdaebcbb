"""Whole blocks of flights: effects on demand against the same effects fixed at every shot.

Run with `make blocks`, some three minutes. `sweep accuracy` compares spectra alone, and fixed
settings without planning. A run plans them too, as its store tells what is left out, and its blocks
read what shots see, draw points and solve for velocities besides. Names of experiments as arguments
time those alone.
"""

import argparse
import tempfile
from pathlib import Path
from time import process_time

import numpy as np
from rich.progress import track
from shared import EXPERIMENTS, show

import sweep
from sweep.model.effects.catalogue import names_of
from sweep.tasks.accuracy.rungs import ADAPTIVE, FIXED, Rung, ladder
from sweep.tasks.effect_selection import Selected
from sweep.tasks.flight_study import FlightStudy

FLIGHTS = ("morpheus_three_beam", "oblique_descent", "gale_crater_descent", "square_low_descent",
           "square_high_descent", "forest_scan", "expanded_pattern")  # fmt: skip
TOLERANCES = (1e-1, 1e-3)
ROUNDS = 21


class Unplanned(FlightStudy):
    """A flight whose plans are there already."""

    def __init__(self, planned: FlightStudy) -> None:
        super().__init__(planned.spec, planned.path)
        self._planned, self._selected = planned, {}

    def select(self, part, eyepoints, numbers) -> Selected:
        """Effects simulated at shots, planned once."""
        if (part, numbers[0]) not in self._selected:
            self._selected[part, numbers[0]] = self._planned.select(part, eyepoints, numbers)
        return self._selected[part, numbers[0]]


def stored(rung: Rung, spec, path: Path) -> FlightStudy:
    """The study of a rung; it is run once, so that what its shots see is there."""
    declared = rung.of(spec)
    sweep.run(declared, store=path, scheduler="none", progress=False)
    return FlightStudy(declared, path)


def variants(spec, tolerance: float, folder: Path) -> list[FlightStudy]:
    """Adaptive, fixed, and fixed without planning."""
    adaptive = Rung(name="", kind=ADAPTIVE, overrides={"accuracy.tolerance": tolerance})
    first = stored(adaptive, spec, folder / "adaptive.zarr")
    flags = np.uint32(0)
    for block in range(first.n_blocks):
        flags |= np.bitwise_or.reduce(first.selected(block).flags)
    sets = {tolerance: frozenset(names_of(int(flags)))}
    (same,) = (rung for rung in ladder(spec).with_fixed(sets).rungs if rung.kind == FIXED)
    fixed = stored(same, spec, folder / "fixed.zarr")
    return [first, fixed, Unplanned(fixed)]


def timed(studies: list[FlightStudy]) -> np.ndarray:
    """Processor time of all blocks [s], (rounds, studies); each in turn."""
    spent = np.empty((ROUNDS + 1, len(studies)))
    for row in spent:  # the first warms up
        for k, study in enumerate(studies):
            begun = process_time()
            for block in range(study.n_blocks):
                study.evaluate(block)
            row[k] = process_time() - begun
    return spent[1:]


def main() -> None:
    """A row for each flight and tolerance."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*FLIGHTS, []])
    names = parser.parse_args().names or FLIGHTS
    rows = []
    for name in track(names, transient=True):
        spec = sweep.load(EXPERIMENTS / f"{name}.yaml")
        for tolerance in TOLERANCES:
            with tempfile.TemporaryDirectory() as folder:
                studies = variants(spec, tolerance, Path(folder))
                spent = timed(studies)
            faster = np.median(spent / spent[:, :1], axis=0)
            own = f"{1e3 * np.median(spent[:, 0]):.3g} ms"
            ratios = (f"{ratio:.3f}" for ratio in faster[1:])
            rows.append([name, f"{studies[0].points:,}", f"{tolerance:g}", own, *ratios])
    head = ["flight", "shots", "tolerance", "adaptive", "times as fast as fixed",
            "as fixed, unplanned"]  # fmt: skip
    show(head, rows)


if __name__ == "__main__":
    main()
