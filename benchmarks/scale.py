"""Limits of the engine: ``make scale`` writes its part of docs/scale.md.

Blocks: what a plan, a log and the folders of up to ten million blocks cost to read, each in a
process of its own. Workers: the engine's window over the real scheduler with a thousand worker
slots whose tasks only wait, for tasks of several lengths: where it keeps them busy, and where not.
"""

import argparse
import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from shared import experiment, put, table

BLOCKS = (10**4, 10**5, 10**6, 10**7)
MOST_FILES = 10**6
LINKS = 30_000
"""Names of a file that a file system bears."""

SLOTS = 1000
TASK_SECONDS = (0.5, 1.0, 2.0, 4.0, 8.0)
MEASURED = 30.0
"""Seconds that each length is measured for."""


class Line:
    """A study of many blocks along one axis, of one array."""

    unit, id = "points", "scale"

    def __init__(self, n_blocks):
        self.n_blocks = n_blocks

    def owners(self):
        return {"array": np.arange(self.n_blocks)}


def receipt(block, points=65_536):
    """A receipt as workers give it."""
    from sweep.tasks import store
    from sweep.tasks.journal import Receipt

    return Receipt(
        block=block, points=points, bytes=3_000_000, digest="0" * 32, seconds=1.234567,
        write_seconds=0.0123, host="node-0123", pid=12_345, versions=store.software(),
    )  # fmt: skip


def filled(directory, n_blocks):
    """A store's log, and its chunks as names of a few files, of so many blocks all done."""
    store = Path(directory) / "line.zarr"
    (store / ".sweep").mkdir(parents=True)
    with open(store / ".sweep" / "receipts.jsonl", "wb") as log:
        log.writelines(receipt_lines(n_blocks))
    chunks = store / "array" / "c"
    chunks.mkdir(parents=True)
    for block in range(n_blocks if n_blocks <= MOST_FILES else 0):
        if block % LINKS == 0:
            chunk = chunks / str(block)
            chunk.write_bytes(b"chunk")
        else:
            os.link(chunk, chunks / str(block))
    return store


def receipt_lines(n_blocks, points=65_536):
    """Lines of a log, of so many blocks all done."""
    from sweep.storage.opening import closed

    record = {**vars(receipt(0, points)), "time": round(time.time(), 3)}
    rest = json.dumps(record, separators=(",", ":")).partition(",")[2][:-1]
    return (closed(f'{{"block":{block},{rest}'.encode()) for block in range(n_blocks))


def timed(what):
    begun, cpu = time.perf_counter(), time.process_time()
    found = what()
    return found, time.perf_counter() - begun, time.process_time() - cpu


def blocks(n_blocks, store):
    """Seconds of processor time, and memory, that so many blocks take; printed for the parent."""
    from sweep.storage.opening import read_receipts
    from sweep.tasks.journal import Journal, listed
    from sweep.tasks.study import Grid
    from sweep.tasks.worker import BlockQueue

    axes = {"target.range": {"linear": ["1 m", "10 km"], "number": n_blocks // 100},
            "target.grazing_angle": {"linear": ["1 deg", "90 deg"], "number": 100}}  # fmt: skip
    spec = experiment("range_angle_coarse", axes=axes, storage={"block_points": 1})
    grid, _, planned = timed(lambda: Grid(spec))
    assert grid.n_blocks == n_blocks
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    _, _, opening = timed(lambda: Journal(store))
    receipts, _, reading = timed(lambda: read_receipts(store, n_blocks))
    assert receipts.blocks == n_blocks
    listing = float("nan")
    if n_blocks <= MOST_FILES:
        found, _, listing = timed(lambda: listed(store, Line(n_blocks), receipts.points > 0))
        assert found.all()

    def hand_out():
        queue = BlockQueue(np.zeros(n_blocks, bool))
        while queue.take(1000):
            pass

    _, _, handing = timed(hand_out)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(json.dumps([planned, opening, reading, listing, handing, (after - before) * 1024 / 1e6]))


def block_rows(directory):
    """Rows of the table of blocks."""
    for n_blocks in BLOCKS:
        store = filled(directory, n_blocks)
        command = [sys.executable, __file__, "--blocks", str(n_blocks), "--store", str(store)]
        told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        *seconds, memory = json.loads(told.splitlines()[-1])
        cells = ["-" if s != s else f"{s:.2g} s" for s in seconds]
        yield [f"{n_blocks:,}", *cells, f"{memory:,.0f} MB"]
        shutil.rmtree(store)


def nap_for(seconds):
    """Work in place of computing: wait, and answer as for one long block a task."""

    def nap(job, blocks):
        from sweep.tasks.journal import Receipt
        from sweep.tasks.worker import Answer

        time.sleep(seconds)
        return Answer(
            receipts=[
                Receipt(block=block, points=1, bytes=1, digest="0" * 32, seconds=10.0,
                        write_seconds=0.0, host="h", pid=1, versions={})
                for block in blocks
            ]
        )  # fmt: skip

    return nap


def worker_rows(slots, lengths, measured):
    """Rows of the table of workers."""
    import dask
    from distributed import Client, LocalCluster

    dask.config.set({"distributed.worker.profile.enabled": False})  # it looks at every thread
    threads = 50
    with (
        LocalCluster(
            n_workers=slots // threads, threads_per_worker=threads, processes=False,
            dashboard_address=None, memory_limit=0,
        ) as cluster,
        Client(cluster) as client,
    ):  # fmt: skip
        client.wait_for_workers(slots // threads)
        for seconds in lengths:
            rate, cpu = through(client, seconds, measured)
            busy = min(1.0, rate * seconds / slots)
            yield [f"{seconds:g} s", f"{rate:,.0f}", f"{100 * busy:.0f} %", f"{1e3 * cpu:.2g} ms"]


def through(client, seconds, measured):
    """Tasks a second that go through, once all slots have work, and processor time of each."""
    from sweep.tasks import scheduler
    from sweep.tasks.worker import Job

    scheduler.work = nap_for(seconds)
    slots = sum(client.nthreads().values())
    queue, job = scheduler.BlockQueue(np.zeros(10**7, bool)), Job("x", f"waiting {seconds}")
    tasks = scheduler.Scheduler(client, 0, job, queue, seen=lambda *_: True, say=print)
    arrived, counted, stop = 0, 0, threading.Event()
    begun = cpu = rate = spent = 0.0
    for answer in tasks.answers(stop.is_set):
        arrived += bool(answer.receipts)
        if not begun and arrived >= slots:
            begun, cpu, counted = time.perf_counter(), time.process_time(), 0
        counted += bool(answer.receipts)
        if begun and not stop.is_set() and time.perf_counter() - begun > max(measured, 4 * seconds):
            rate = counted / (time.perf_counter() - begun)
            spent = (time.process_time() - cpu) / counted
            stop.set()
    return rate, spent


def text(of_blocks, of_workers):
    """Their part of the page."""
    return f"""## Blocks

{platform.processor() or platform.machine()}, {os.cpu_count()} processors, Python
{platform.python_version()}. Seconds of processor time of a process of its own; memory beyond what
its libraries take. The log has a receipt for every block, some 330 bytes each. `sweep status` reads
the log, and so does `sweep resume` before it begins; that opens the log, too: it checks every line.
A check of folders runs in threads during the work, and takes its time for each array that blocks
write (a grid without draws has 27). From 10^9 points on blocks grow, so that a study has some
16,000 of them, half a million files, unless it asks for smaller ones.

{of_blocks}

## Workers

{SLOTS:,} worker slots in one process run tasks that only wait, sent and taken by the engine's own
window through the real scheduler. "Slots busy" is the share of time in which they work. The last
column is the processor time of scheduler, client and workers together. Its product with the tasks a
second is at most one: beyond, no more go through. Longer tasks are the remedy, and the engine makes
them so (above).

{of_workers}"""


def main():
    """All of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--blocks", type=int)
    parser.add_argument("--store", type=Path)
    parser.add_argument("--slots", type=int, default=SLOTS)
    parser.add_argument("--seconds", type=float, default=MEASURED)
    given = parser.parse_args()
    if given.blocks:
        blocks(given.blocks, given.store)
        return
    with tempfile.TemporaryDirectory() as directory:
        head = ["blocks", "grid", "log opened", "log read", "folders of one array", "handing out",
                "memory"]  # fmt: skip
        of_blocks = table(head, block_rows(directory))
    print(of_blocks)
    head = ["tasks of", "tasks/s", "slots busy", "scheduler and client, a task"]
    of_workers = table(head, worker_rows(given.slots, TASK_SECONDS, given.seconds))
    print(of_workers)
    put("scale.md", "engine", text(of_blocks, of_workers))


if __name__ == "__main__":
    main()
