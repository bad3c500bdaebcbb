"""Gain by more workers: the published range-angle study on one, two, ... workers, in turns.

Run with `make scaling`, five minutes on two cores, on a quiet machine. Workers are up and have
imported the model before the clock starts: a study long enough to need them has them up for most
of its time. Rounds take turns, as the machine drifts; ratios are within a round. Plain
loops over the same blocks in as many processes, with nothing stored, show what the machine allows.
"""

import argparse
import multiprocessing
import tempfile
import time
from pathlib import Path

import numpy as np
from benchmark_helpers import experiment_spec, markdown_table, print_table, replace_page_part
from engine_comparison import cpu_seconds_of_process_tree, sweep_cluster_client

import sweep
from sweep.spec import GridSpec
from sweep.tasks.engine.cluster_connection import cpu_count
from sweep.tasks.studies.grid_study import GridStudy


def range_angle_spec(points: int, block_points: int) -> GridSpec:
    """Return the published study with `points` / 90 ranges for each grazing angle."""
    axes = experiment_spec("range_angle").to_yaml_mapping()["axes"]
    axes |= {"target.range": {"linear": ["1 m", "10 km"], "number": points // 90}}
    return experiment_spec("range_angle", axes=axes, storage={"block_points": block_points})


def measure_run(spec: GridSpec, workers: int) -> tuple[float, float]:
    """Run a study on workers; return wall time and processor time in all [s]."""
    with tempfile.TemporaryDirectory() as name, sweep_cluster_client(workers) as client:
        options = {"client": client, "progress": False}
        sweep.run(
            range_angle_spec(90 * 2 * workers, 45), store=Path(name) / "rehearsal.zarr", **options
        )
        start, cpu_seconds = time.perf_counter(), cpu_seconds_of_process_tree()
        outcome = sweep.run(spec, store=Path(name) / "scaling.zarr", **options)
        wall_seconds, cpu_seconds = (
            time.perf_counter() - start,
            cpu_seconds_of_process_tree() - cpu_seconds,
        )
    assert outcome.complete
    return wall_seconds, cpu_seconds


def run_plain_loop(spec: GridSpec, first_block: int, block_step: int, barrier) -> None:
    """Compute every `block_step`-th block in a plain loop, once all processes are ready."""
    study = GridStudy(spec)
    study.evaluate(first_block)
    barrier.wait()
    for block in range(first_block, study.n_blocks, block_step):
        study.evaluate(block)


def measure_plain_loops(spec: GridSpec, n_processes: int) -> float:
    """Return the wall time of plain loops over all blocks, in parallel processes [s]."""
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(n_processes + 1)
    processes = [
        context.Process(target=run_plain_loop, args=(spec, i, n_processes, barrier))
        for i in range(n_processes)
    ]
    for process in processes:
        process.start()
    barrier.wait()
    start = time.perf_counter()
    for process in processes:
        process.join()
    return time.perf_counter() - start


def main() -> None:
    """Measure the numbers of workers in turns, and write the table into docs/scale.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--most", type=int, default=cpu_count())
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--points", type=int, default=2_700_000)
    parser.add_argument("--block-points", type=int, default=45_000)
    arguments = parser.parse_args()
    worker_numbers = [n for n in (2**i for i in range(20)) if n <= arguments.most]
    spec = range_angle_spec(arguments.points, arguments.block_points)
    # (rounds, numbers of workers, 3): wall time, the processor's time, time of plain loops
    times = np.array(
        [
            [
                [*measure_run(spec, number), measure_plain_loops(spec, number)]
                for number in worker_numbers
            ]
            for _ in range(arguments.rounds)
        ]
    )
    seconds = np.median(times[..., 0], axis=0)
    speed_up, _, plain_speed_up = np.median(times[:, :1] / times, axis=0).T
    cpu_ratio = np.median(times[..., 1] / times[:, :1, 1], axis=0)
    head = ["workers", "seconds", "times as fast as one", "plain loops, times as fast as one",
            "processor's time, times one's"]  # fmt: skip
    rows = [
        [f"{number}", f"{s:.1f}", f"{f:.2f}", f"{p:.2f}", f"{d:.3f}"]
        for number, s, f, p, d in zip(
            worker_numbers, seconds, speed_up, plain_speed_up, cpu_ratio, strict=True
        )
    ]
    print_table(head, rows)
    replace_page_part("scale.md", "scaling", markdown_table(head, rows))


if __name__ == "__main__":
    main()
