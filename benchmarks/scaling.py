"""What more workers bring: the published range-angle study on one, two, ... workers, in turns.

Run with `make scaling`, five minutes on two cores, on a quiet machine. Workers are up and have
imported the model before the clock starts: a study long enough to need them has them up for most
of its time. Rounds take turns, as the machine drifts; ratios are within a round. What the machine
itself lets be had is told by plain loops over the same blocks in as many processes, nothing stored.
"""

import argparse
import multiprocessing
import statistics
import tempfile
import time
from pathlib import Path

import scale_page
from peers import our_client, processor_time
from rich.console import Console
from rich.table import Table

import sweep
from sweep.spec import Spec
from sweep.spec.reading import read_document
from sweep.tasks.cluster import cores
from sweep.tasks.grid_study import GridStudy

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


def study(points: int, block_points: int) -> Spec:
    """The published study over so many ranges a grazing angle."""
    mapping = read_document(EXPERIMENTS / "range_angle.yaml").value
    mapping["axes"]["target.range"] = {"linear": ["1 m", "10 km"], "number": points // 90}
    mapping["storage"] = {"block_points": block_points}
    mapping["figures"] = []
    return Spec.from_mapping(mapping, base=EXPERIMENTS)


def measure(spec: Spec, workers: int) -> tuple[float, float]:
    """Seconds of wall time, and of the processor's in all."""
    with tempfile.TemporaryDirectory() as name, our_client(workers) as client:
        folder = Path(name)
        options = {"client": client, "progress": False}
        sweep.run(study(90 * 2 * workers, 45), store=folder / "rehearsal.zarr", **options)
        begun, taken = time.perf_counter(), processor_time()
        outcome = sweep.run(spec, store=folder / "scaling.zarr", **options)
        wall, taken = time.perf_counter() - begun, processor_time() - taken
    assert outcome.complete
    return wall, taken


def loop(spec: Spec, first: int, step: int, ready) -> None:
    """Every so many-th block, in a plain loop."""
    held = GridStudy(spec)
    held.evaluate(first)
    ready.wait()
    for block in range(first, held.n_blocks, step):
        held.evaluate(block)


def plain(spec: Spec, number: int) -> float:
    """Seconds of plain loops over all blocks, in so many processes."""
    context = multiprocessing.get_context("spawn")
    ready = context.Barrier(number + 1)
    loops = [context.Process(target=loop, args=(spec, i, number, ready)) for i in range(number)]
    for each in loops:
        each.start()
    ready.wait()
    begun = time.perf_counter()
    for each in loops:
        each.join()
    return time.perf_counter() - begun


def main() -> None:
    """Measure in turns, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--most", type=int, default=cores())
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--points", type=int, default=2_700_000)
    parser.add_argument("--block-points", type=int, default=45_000)
    asked = parser.parse_args()
    numbers = [n for n in (2**i for i in range(20)) if n <= asked.most]
    spec = study(asked.points, asked.block_points)
    seen: dict[int, list[tuple[float, float]]] = {n: [] for n in numbers}
    loops: dict[int, list[float]] = {n: [] for n in numbers}
    for _ in range(asked.rounds):
        for number in numbers:
            seen[number].append(measure(spec, number))
            loops[number].append(plain(spec, number))
    head = [
        "workers", "seconds", "times as fast as one", "plain loops, times as fast as one",
        "processor's time, times one's",
    ]  # fmt: skip
    rows = []
    for number in numbers:
        pairs = list(zip(seen[number], seen[1], strict=True))
        faster = statistics.median(one[0] / own[0] for own, one in pairs)
        dearer = statistics.median(own[1] / one[1] for own, one in pairs)
        seconds = statistics.median(own[0] for own in seen[number])
        pairs = zip(loops[number], loops[1], strict=True)
        possible = statistics.median(one / own for own, one in pairs)
        rows.append(
            [f"{number}", f"{seconds:.1f}", f"{faster:.2f}", f"{possible:.2f}", f"{dearer:.3f}"]
        )
    table = Table(*head)
    for row in rows:
        table.add_row(*row)
    Console(width=100).print(table)
    scale_page.put("scaling", head, rows)


if __name__ == "__main__":
    main()
