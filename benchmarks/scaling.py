"""Gain by more workers: the published range-angle study on one, two, ... workers, in turns.

Run with `make scaling`, five minutes on two cores, on a quiet machine. Workers are up and have
imported the model before the clock starts: a study long enough to need them has them up for most
of its time. Rounds take turns, as the machine drifts; ratios are within a round. What the machine
itself lets be had is told by plain loops over the same blocks in as many processes, nothing stored.
"""

import argparse
import multiprocessing
import tempfile
import time
from pathlib import Path

import numpy as np
from peers import our_client, processor_time
from shared import experiment, put, show, table

import sweep
from sweep.spec import Spec
from sweep.tasks.cluster import cores
from sweep.tasks.grid_study import GridStudy


def study(points: int, block_points: int) -> Spec:
    """The published study over so many ranges a grazing angle."""
    axes = experiment("range_angle").to_yaml_mapping()["axes"]
    axes |= {"target.range": {"linear": ["1 m", "10 km"], "number": points // 90}}
    return experiment("range_angle", axes=axes, storage={"block_points": block_points})


def measure(spec: Spec, workers: int) -> tuple[float, float]:
    """Seconds of wall time, and of the processor's in all."""
    with tempfile.TemporaryDirectory() as name, our_client(workers) as client:
        options = {"client": client, "progress": False}
        sweep.run(study(90 * 2 * workers, 45), store=Path(name) / "rehearsal.zarr", **options)
        begun, taken = time.perf_counter(), processor_time()
        outcome = sweep.run(spec, store=Path(name) / "scaling.zarr", **options)
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
    # (rounds, numbers of workers, 3): wall time, the processor's time, time of plain loops
    times = np.array([
        [[*measure(spec, number), plain(spec, number)] for number in numbers]
        for _ in range(asked.rounds)
    ])  # fmt: skip
    seconds = np.median(times[..., 0], axis=0)
    faster, _, possible = np.median(times[:, :1] / times, axis=0).T
    dearer = np.median(times[..., 1] / times[:, :1, 1], axis=0)
    head = ["workers", "seconds", "times as fast as one", "plain loops, times as fast as one",
            "processor's time, times one's"]  # fmt: skip
    rows = [
        [f"{number}", f"{s:.1f}", f"{f:.2f}", f"{p:.2f}", f"{d:.3f}"]
        for number, s, f, p, d in zip(numbers, seconds, faster, possible, dearer, strict=True)
    ]
    show(head, rows)
    put("scale.md", "scaling", table(head, rows))


if __name__ == "__main__":
    main()
