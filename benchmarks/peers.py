"""Cost of the engine beside others': 10,000 points of a millisecond, stored, side by side.

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
from shared import experiment, put, show, table

SIDE = 100
POINTS = SIDE * SIDE
MILLISECOND = 1e-3
BATCH = 1000
ROUNDS = 3
FAR_BEHIND = 0.8
"""Share of the best contender's throughput."""

SECOND = 1.0
BLOCKS_OF_A_SECOND = 100
NAMES = ("a", "b", "c")


def burn(seconds: float) -> None:
    """Take so much of the processor's time."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def processor_time() -> float:
    """Seconds of the processor's that this process and all below it have taken."""
    own = psutil.Process()
    taken = 0.0
    for process in (own, *own.children(recursive=True)):
        with suppress(psutil.NoSuchProcess):
            times = process.cpu_times()
            taken += times.user + times.system
    return taken


def point(x: float, y: float) -> tuple[float, float, float]:
    """Three numbers, a millisecond later."""
    burn(MILLISECOND)
    return x + y, x * y, x - y


def grid() -> tuple[np.ndarray, np.ndarray]:
    """Both coordinates of every point."""
    x, y = np.meshgrid(np.arange(SIDE, dtype=float), np.arange(SIDE, dtype=float), indexing="ij")
    return x.ravel(), y.ravel()


def dataset(results) -> xr.Dataset:
    """Results of every point, in order, as a Dataset."""
    columns = np.asarray(results).reshape(SIDE, SIDE, len(NAMES))
    return xr.Dataset({name: (("x", "y"), columns[..., i]) for i, name in enumerate(NAMES)})


def share(number: int) -> None:
    """A plain loop over so many points."""
    for i in range(number):
        point(float(i), 1.0)


def ideal(workers: int) -> float:
    """Seconds of plain loops over all points, on as many processes, nothing stored."""
    context = multiprocessing.get_context("fork")
    begun = time.perf_counter()
    children = [context.Process(target=share, args=(POINTS // workers,)) for _ in range(workers)]
    for child in children:
        child.start()
    for child in children:
        child.join()
    return time.perf_counter() - begun


def study(block_points: int = BATCH):
    """A grid of 100 x 100 points."""
    axes = {
        "target.range": {"linear": ["10 m", "5 km"], "number": SIDE},
        "target.grazing_angle": {"linear": ["1 deg", "90 deg"], "number": SIDE},
    }
    return experiment("range_angle_coarse", axes=axes, storage={"block_points": block_points})


@contextmanager
def ours(workers: int, folder: Path):
    """`sweep.run` on a client whose workers are up."""
    import sweep

    spec = study()
    with our_client(workers) as client:
        rehearse(client, folder)
        yield lambda: sweep.run(
            spec, store=folder / "ours.zarr", client=client, progress=False, evaluate=blocks_of_ms
        )


def blocks_of_ms(held, block):
    """A block's arrays a millisecond a point later; their values are those of no model."""
    burn(MILLISECOND * held.block_size(block))
    return filled(held, block)


def blocks_of_seconds(held, block):
    """A block's arrays a second later."""
    burn(SECOND)
    return filled(held, block)


def filled(held, block: int) -> dict[str, np.ndarray]:
    """Arrays of the shapes and types that a block has, with numbers that don't compress away."""
    values = np.arange(held.block_size(block), dtype=float)
    return {
        name: np.resize(values, [s.stop - s.start for s in region]).astype(held.layouts[name].dtype)
        for name, region in held.regions(block).items()
    }


def rehearse(client, folder: Path) -> None:
    """Have every worker import what it will need, as any long study has after seconds."""
    import sweep

    store = folder / "rehearsal.zarr"
    sweep.run(study(2500), store=store, client=client, progress=False, evaluate=filled)


@contextmanager
def our_client(workers: int):
    """A client of workers that are started as `sweep run` does."""
    from sweep.tasks.cluster import connected
    from sweep.tasks.session import RunOptions

    here = RunOptions(workers=workers).place(study(2500))
    assert here is not None
    with connected(here, most=workers, processes=True, say=lambda text: None) as reached:
        reached.client.wait_for_workers(workers)
        yield reached.client


@contextmanager
def client_of(workers: int):
    """A Dask client of as many processes, none of them idle for want of imports."""
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
def joblib_batches(workers: int, folder: Path):
    """joblib (loky), its processes up, results gathered here and stored at the end: no resume."""
    import joblib

    parallel = joblib.Parallel(n_jobs=workers, batch_size=BATCH)
    parallel(joblib.delayed(point)(0.0, 0.0) for _ in range(2 * workers))

    def run() -> None:
        x, y = grid()
        results = parallel(joblib.delayed(point)(a, b) for a, b in zip(x, y, strict=True))
        dataset(results).to_zarr(folder / "joblib.zarr", consolidated=False)

    yield run


@contextmanager
def xyzpy_crop(workers: int, folder: Path):
    """xyzpy: a Crop of batches on disk, grown by loky's processes, reaped into one file."""
    import xyzpy
    from joblib.externals.loky import get_reusable_executor

    pool = get_reusable_executor(workers)
    list(pool.map(point, [0.0] * 2 * workers, [0.0] * 2 * workers))
    combos = {"x": np.arange(SIDE, dtype=float), "y": np.arange(SIDE, dtype=float)}

    def run() -> None:
        runner = xyzpy.Runner(point, var_names=list(NAMES))
        crop = runner.Crop(name="peers", parent_dir=str(folder), batchsize=BATCH)
        with redirect_stderr(StringIO()):
            crop.sow_combos(combos, verbosity=0)
            crop.grow_missing(executor=pool, verbosity=0)
            found = crop.reap()
        found.to_zarr(folder / "crop.zarr", consolidated=False)

    yield run


@contextmanager
def xyzpy_dask(workers: int, folder: Path):
    """xyzpy on Dask: a task a point."""
    import xyzpy

    with client_of(workers) as client:
        combos = {"x": np.arange(SIDE, dtype=float), "y": np.arange(SIDE, dtype=float)}
        client.submit(point, 0.0, 0.0).result()

        def run() -> None:
            runner = xyzpy.Runner(point, var_names=list(NAMES))
            found = runner.run_combos(combos, executor=client, verbosity=0)
            found.to_zarr(folder / "xyzpy.zarr", consolidated=False)

        yield run


@contextmanager
def dask_delayed(workers: int, folder: Path):
    """dask.delayed, a task a point as its users write it, and xarray."""
    import dask

    with client_of(workers) as client:
        client.submit(point, 0.0, 0.0).result()

        def run() -> None:
            x, y = grid()
            tasks = [dask.delayed(point)(a, b) for a, b in zip(x, y, strict=True)]
            dataset(dask.compute(*tasks)).to_zarr(folder / "delayed.zarr", consolidated=False)

        yield run


CONTENDERS = {
    "sweep": ours,
    "joblib": joblib_batches,
    "xyzpy Crop": xyzpy_crop,
    "xyzpy on Dask": xyzpy_dask,
    "dask.delayed + xarray": dask_delayed,
}


class Shares(NamedTuple):
    """Shares of the ideal that a contender reaches."""

    wall: float  # of plain loops right before and after it
    processor: float  # seconds of all points over those that the processor spent in all


def measure(name: str, workers: int) -> Shares:
    """Shares of the ideal that a contender reaches."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        run = stack.enter_context(CONTENDERS[name](workers, Path(folder)))
        before = ideal(workers)
        begun, taken = time.perf_counter(), processor_time()
        run()
        seconds, taken = time.perf_counter() - begun, processor_time() - taken
        return Shares((before + ideal(workers)) / 2 / seconds, POINTS * MILLISECOND / taken)


def blocks_of_a_second(workers: int) -> float:
    """Share of the wall time that is not the blocks' own, for blocks of a second."""
    import sweep

    with tempfile.TemporaryDirectory() as name, our_client(workers) as client:
        folder = Path(name)
        rehearse(client, folder)
        begun = time.perf_counter()
        outcome = sweep.run(
            study(POINTS // BLOCKS_OF_A_SECOND), store=folder / "second.zarr", client=client,
            progress=False, evaluate=blocks_of_seconds,
        )  # fmt: skip
        wall = time.perf_counter() - begun
    assert outcome.blocks == BLOCKS_OF_A_SECOND
    return 1 - (outcome.work_seconds - outcome.write_seconds) / workers / wall


def middle(shares: list[Shares]) -> float:
    """Median of the shares of the ideal."""
    return statistics.median(share.wall for share in shares)


def apart(*words: str) -> list[float]:
    """Numbers that this program prints in a process of its own: contenders share nothing."""
    command = [sys.executable, __file__, *words]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def rows(shares: dict[str, list[Shares]], workers: int) -> list[list[str]]:
    """Lines of the table, the fastest first."""
    lines = []
    for name, each in sorted(shares.items(), key=lambda item: -middle(item[1])):
        rate, best = middle(each) * workers / MILLISECOND, max(share.wall for share in each)
        processor = statistics.median(share.processor for share in each)
        told = (f"{middle(each):.1%}", f"{best:.1%}", f"{processor:.1%}")
        lines.append([name, f"{rate:,.0f}", *told])
    return lines


def main() -> None:
    """Measure in turns, print, and put the table into the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*CONTENDERS, []])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--one", choices=[*CONTENDERS, "second"], help=argparse.SUPPRESS)
    asked = parser.parse_args()
    workers = ["--workers", str(asked.workers)]
    if asked.one == "second":
        print(json.dumps([blocks_of_a_second(asked.workers)]))
        return
    if asked.one:
        print(json.dumps(measure(asked.one, asked.workers)))
        return
    names = asked.names or list(CONTENDERS)
    shares: dict[str, list[Shares]] = {name: [] for name in names}
    for _ in range(asked.rounds):
        best = max((middle(each) for each in shares.values() if each), default=0.0)
        for name in names:
            if not best or middle(shares[name]) > FAR_BEHIND * best:
                shares[name].append(Shares(*apart("--one", name, *workers)))
    lost = apart("--one", "second", *workers)[0]
    head = ["contender", "points a second", "of the ideal", "best round", "of the processor's time"]
    lines = rows(shares, asked.workers)
    said = (
        f"For {BLOCKS_OF_A_SECOND} blocks of a second {lost:.1%} of the wall time of "
        f"{asked.workers} workers was not the blocks' own."
    )
    show(head, lines)
    print(said)
    if not asked.names:
        put("scale.md", "peers", f"{table(head, lines)}\n\n{said}")


if __name__ == "__main__":
    main()
