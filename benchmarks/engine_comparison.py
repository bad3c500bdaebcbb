"""Compare the cost of the engine with that of others: 10,000 points of a millisecond, stored.

Run with `make peers`, some six minutes on a quiet machine. Every contender computes the same three
numbers at each point of a 100 x 100 grid, taking a millisecond of the processor's time over it,
with as many workers, and leaves them on disk. Ours stores with them all that a study of a flat
target has, 26 arrays with receipts and digests, and could be killed and resumed at any instant; so
could xyzpy's Crop, batch by batch. Workers are started before the clock is, where a contender lets
that be; ours as `sweep run` starts them. Contenders take turns, round after round, as the machine
drifts; those that are far behind in the first round are left out of the next. The ideal is what
plain loops over the same points took on as many processes at once, right before and after. The
share of the processor's time says the same where others are at work on the machine.

Names of contenders as arguments measure those alone.
"""

import argparse
import json
import logging
import multiprocessing
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager, redirect_stderr, suppress
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
import xarray as xr
from benchmark_helpers import experiment_spec, markdown_table, print_table, replace_page_part

POINTS_PER_AXIS = 100
POINTS = POINTS_PER_AXIS * POINTS_PER_AXIS
POINT_SECONDS = 1e-3
BATCH_POINTS = 1000
N_ROUNDS = 3
THROUGHPUT_SHARE_MIN = 0.8
"""Contenders with less than this share of the best throughput are left out of later rounds."""

BLOCK_SECONDS = 1.0
N_ONE_SECOND_BLOCKS = 100
VARIABLE_NAMES = ("a", "b", "c")


def burn_cpu(seconds: float) -> None:
    """Spend a given processor time [s]."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def cpu_seconds_of_process_tree() -> float:
    """Return the processor time of this process and all its descendants [s]."""
    this_process = psutil.Process()
    cpu_seconds = 0.0
    for process in (this_process, *this_process.children(recursive=True)):
        with suppress(psutil.NoSuchProcess):
            times = process.cpu_times()
            cpu_seconds += times.user + times.system
    return cpu_seconds


def compute_point(x: float, y: float) -> tuple[float, float, float]:
    """Return the three numbers of a point after a millisecond of processor time."""
    burn_cpu(POINT_SECONDS)
    return x + y, x * y, x - y


def point_coordinates() -> tuple[np.ndarray, np.ndarray]:
    """Return the two coordinates of every point, (points,) each."""
    x, y = np.meshgrid(
        np.arange(POINTS_PER_AXIS, dtype=float),
        np.arange(POINTS_PER_AXIS, dtype=float),
        indexing="ij",
    )
    return x.ravel(), y.ravel()


def results_to_dataset(results) -> xr.Dataset:
    """Return the results of all points, in order, as a Dataset."""
    columns = np.asarray(results).reshape(POINTS_PER_AXIS, POINTS_PER_AXIS, len(VARIABLE_NAMES))
    return xr.Dataset(
        {name: (("x", "y"), columns[..., column]) for column, name in enumerate(VARIABLE_NAMES)}
    )


def run_plain_loop(n_points: int) -> None:
    """Compute points in a plain loop."""
    for i in range(n_points):
        compute_point(float(i), 1.0)


def ideal_seconds(workers: int) -> float:
    """Return the wall time of plain loops over all points in parallel processes [s].

    Nothing is stored.
    """
    context = multiprocessing.get_context("fork")
    start = time.perf_counter()
    children = [
        context.Process(target=run_plain_loop, args=(POINTS // workers,)) for _ in range(workers)
    ]
    for child in children:
        child.start()
    for child in children:
        child.join()
    return time.perf_counter() - start


def grid_spec(block_points: int = BATCH_POINTS):
    """Return the spec of a grid of 100 x 100 points."""
    axes = {
        "target.range": {"linear": ["10 m", "5 km"], "number": POINTS_PER_AXIS},
        "target.grazing_angle": {"linear": ["1 deg", "90 deg"], "number": POINTS_PER_AXIS},
    }
    return experiment_spec("range_angle_coarse", axes=axes, storage={"block_points": block_points})


@contextmanager
def sweep_contender(workers: int, folder: Path):
    """Context manager: yield a function that runs `sweep.run` on workers already started."""
    import sweep

    spec = grid_spec()
    with sweep_cluster_client(workers) as client:
        import_on_workers(client, folder)
        yield lambda: sweep.run(
            spec,
            store=folder / "ours.zarr",
            client=client,
            progress=False,
            evaluate=evaluate_millisecond_points,
        )


def evaluate_millisecond_points(study, block):
    """Return invented arrays of a block after a millisecond of processor time per point."""
    burn_cpu(POINT_SECONDS * study.count_block_points(block))
    return filled_block_arrays(study, block)


def evaluate_one_second_block(study, block):
    """Return invented arrays of a block after a second of processor time."""
    burn_cpu(BLOCK_SECONDS)
    return filled_block_arrays(study, block)


def filled_block_arrays(study, block: int) -> dict[str, np.ndarray]:
    """Return arrays with a block's shapes and types, whose numbers do not compress away."""
    values = np.arange(study.count_block_points(block), dtype=float)
    return {
        name: np.resize(
            values, [region_slice.stop - region_slice.start for region_slice in region]
        ).astype(study.output_layout_by_name[name].dtype)
        for name, region in study.chunk_regions_of_block(block).items()
    }


def import_on_workers(client, folder: Path) -> None:
    """Let every worker import all modules that a study needs, by running a small study."""
    import sweep

    store = folder / "rehearsal.zarr"
    sweep.run(
        grid_spec(2500), store=store, client=client, progress=False, evaluate=filled_block_arrays
    )


@contextmanager
def sweep_cluster_client(workers: int):
    """Context manager: yield a client whose workers are started as by `sweep run`."""
    from sweep.tasks.engine.cluster_connection import connect_cluster
    from sweep.tasks.engine.session import RunOptions
    from sweep.tasks.studies.workload import SpecWorkload

    cluster_request = RunOptions(workers=workers).resolve_cluster(SpecWorkload(grid_spec(2500)))
    assert cluster_request is not None
    with connect_cluster(
        cluster_request, max_workers=workers, processes=True, say=lambda text: None
    ) as connection:
        connection.client.wait_for_workers(workers)
        yield connection.client


@contextmanager
def dask_client(workers: int):
    """Context manager: yield a client of `workers` Dask worker processes that are ready."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address=None, host="127.0.0.1",
            silence_logs=logging.ERROR,
        ) as cluster,
        Client(cluster) as client,
    ):  # fmt: skip
        client.wait_for_workers(workers)
        yield client


@contextmanager
def joblib_contender(workers: int, folder: Path):
    """Context manager: yield a function that computes with joblib (loky) and stores at the end.

    The processes are already started. A stopped run can't be resumed.
    """
    import joblib

    parallel = joblib.Parallel(n_jobs=workers, batch_size=BATCH_POINTS)
    parallel(joblib.delayed(compute_point)(0.0, 0.0) for _ in range(2 * workers))

    def run_contender() -> None:
        x, y = point_coordinates()
        results = parallel(joblib.delayed(compute_point)(a, b) for a, b in zip(x, y, strict=True))
        results_to_dataset(results).to_zarr(folder / "joblib.zarr", consolidated=False)

    yield run_contender


@contextmanager
def xyzpy_crop_contender(workers: int, folder: Path):
    """Context manager: yield a function that computes an xyzpy Crop with loky's processes.

    Batches are kept on disk and then joined in one file.
    """
    import xyzpy
    from joblib.externals.loky import get_reusable_executor

    executor = get_reusable_executor(workers)
    list(executor.map(compute_point, [0.0] * 2 * workers, [0.0] * 2 * workers))
    coordinates = {
        "x": np.arange(POINTS_PER_AXIS, dtype=float),
        "y": np.arange(POINTS_PER_AXIS, dtype=float),
    }

    def run_contender() -> None:
        runner = xyzpy.Runner(compute_point, var_names=list(VARIABLE_NAMES))
        crop = runner.Crop(name="peers", parent_dir=str(folder), batchsize=BATCH_POINTS)
        with redirect_stderr(StringIO()):
            crop.sow_combos(coordinates, verbosity=0)
            crop.grow_missing(executor=executor, verbosity=0)
            results = crop.reap()
        results.to_zarr(folder / "crop.zarr", consolidated=False)

    yield run_contender


@contextmanager
def xyzpy_dask_contender(workers: int, folder: Path):
    """Context manager: yield a function that computes with xyzpy on Dask, one task per point."""
    import xyzpy

    with dask_client(workers) as client:
        coordinates = {
            "x": np.arange(POINTS_PER_AXIS, dtype=float),
            "y": np.arange(POINTS_PER_AXIS, dtype=float),
        }
        client.submit(compute_point, 0.0, 0.0).result()

        def run_contender() -> None:
            runner = xyzpy.Runner(compute_point, var_names=list(VARIABLE_NAMES))
            results = runner.run_combos(coordinates, executor=client, verbosity=0)
            results.to_zarr(folder / "xyzpy.zarr", consolidated=False)

        yield run_contender


@contextmanager
def dask_delayed_contender(workers: int, folder: Path):
    """Context manager: yield a function that computes with dask.delayed, one task per point."""
    import dask

    with dask_client(workers) as client:
        client.submit(compute_point, 0.0, 0.0).result()

        def run_contender() -> None:
            x, y = point_coordinates()
            tasks = [dask.delayed(compute_point)(a, b) for a, b in zip(x, y, strict=True)]
            results_to_dataset(dask.compute(*tasks)).to_zarr(
                folder / "delayed.zarr", consolidated=False
            )

        yield run_contender


CONTENDERS = {
    "sweep": sweep_contender,
    "joblib": joblib_contender,
    "xyzpy Crop": xyzpy_crop_contender,
    "xyzpy on Dask": xyzpy_dask_contender,
    "dask.delayed + xarray": dask_delayed_contender,
}


class IdealShares(NamedTuple):
    """Speed of a contender, as shares of the ideal."""

    wall: float
    """Wall time of plain loops right before and after the contender, over its own."""
    cpu: float
    """Processor time of the points alone, over that of the contender in all."""


def measure_contender(name: str, workers: int) -> IdealShares:
    """Run a contender once; return its speed as shares of the ideal."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        run_contender = stack.enter_context(CONTENDERS[name](workers, Path(folder)))
        ideal_before = ideal_seconds(workers)
        start, cpu_seconds = time.perf_counter(), cpu_seconds_of_process_tree()
        run_contender()
        seconds, cpu_seconds = (
            time.perf_counter() - start,
            cpu_seconds_of_process_tree() - cpu_seconds,
        )
        return IdealShares(
            (ideal_before + ideal_seconds(workers)) / 2 / seconds,
            POINTS * POINT_SECONDS / cpu_seconds,
        )


def overhead_of_one_second_blocks(workers: int) -> float:
    """Return the share of the wall time that blocks of a second do not take themselves."""
    import sweep

    with tempfile.TemporaryDirectory() as name, sweep_cluster_client(workers) as client:
        folder = Path(name)
        import_on_workers(client, folder)
        start = time.perf_counter()
        outcome = sweep.run(
            grid_spec(POINTS // N_ONE_SECOND_BLOCKS), store=folder / "second.zarr", client=client,
            progress=False, evaluate=evaluate_one_second_block,
        )  # fmt: skip
        wall = time.perf_counter() - start
    assert outcome.blocks == N_ONE_SECOND_BLOCKS
    return 1 - (outcome.work_seconds - outcome.write_seconds) / workers / wall


def median_share(shares: list[IdealShares]) -> float:
    """Return the median of the wall-time shares of the ideal."""
    return statistics.median(share.wall for share in shares)


def numbers_from_subprocess(*arguments: str) -> list[float]:
    """Run this script in a new process, so that contenders share nothing; return its numbers."""
    command = [sys.executable, __file__, *arguments]
    process = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(process.stdout.splitlines()[-1])


def table_rows(shares: dict[str, list[IdealShares]], workers: int) -> list[list[str]]:
    """Return the rows of the table, the fastest contender first."""
    table_lines = []
    for name, contender_shares in sorted(shares.items(), key=lambda item: -median_share(item[1])):
        rate, best = (
            median_share(contender_shares) * workers / POINT_SECONDS,
            max(share.wall for share in contender_shares),
        )
        cpu_share = statistics.median(share.cpu for share in contender_shares)
        share_cells = (f"{median_share(contender_shares):.1%}", f"{best:.1%}", f"{cpu_share:.1%}")
        table_lines.append([name, f"{rate:,.0f}", *share_cells])
    return table_lines


def main() -> None:
    """Measure the contenders in turns, print the table and write it into docs/scale.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*CONTENDERS, []])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=N_ROUNDS)
    parser.add_argument("--one", choices=[*CONTENDERS, "second"], help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    workers = ["--workers", str(arguments.workers)]
    if arguments.one == "second":
        print(json.dumps([overhead_of_one_second_blocks(arguments.workers)]))
        return
    if arguments.one:
        print(json.dumps(measure_contender(arguments.one, arguments.workers)))
        return
    names = arguments.names or list(CONTENDERS)
    shares: dict[str, list[IdealShares]] = {name: [] for name in names}
    for _ in range(arguments.rounds):
        best = max(
            (
                median_share(contender_shares)
                for contender_shares in shares.values()
                if contender_shares
            ),
            default=0.0,
        )
        for name in names:
            if not best or median_share(shares[name]) > THROUGHPUT_SHARE_MIN * best:
                shares[name].append(IdealShares(*numbers_from_subprocess("--one", name, *workers)))
    overhead = numbers_from_subprocess("--one", "second", *workers)[0]
    head = ["contender", "points a second", "of the ideal", "best round", "of the processor's time"]
    lines = table_rows(shares, arguments.workers)
    overhead_text = (
        f"For {N_ONE_SECOND_BLOCKS} blocks of a second {overhead:.1%} of the wall time of "
        f"{arguments.workers} workers was not the blocks' own."
    )
    print_table(head, lines)
    print(overhead_text)
    if not arguments.names:
        replace_page_part("scale.md", "peers", f"{markdown_table(head, lines)}\n\n{overhead_text}")


if __name__ == "__main__":
    main()
