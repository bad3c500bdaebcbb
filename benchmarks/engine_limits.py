"""Measure limits of the engine: ``make scale`` writes a part of docs/scale.md.

Blocks: the time and memory to read the plan, the log and the folders of up to ten million blocks,
each number of blocks in a process of its own. Workers: the share of time in which a thousand worker
slots are busy, for tasks of several lengths that only wait, with the real scheduler.
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
from benchmark_helpers import experiment_spec, markdown_table, replace_page_part

BLOCK_NUMBERS = (10**4, 10**5, 10**6, 10**7)
FILES_MAX = 10**6
HARD_LINKS_MAX = 30_000
"""Maximum number of hard links to a file."""

N_SLOTS = 1000
TASK_SECONDS = (0.5, 1.0, 2.0, 4.0, 8.0)
MEASURED_SECONDS = 30.0
"""Duration of the measurement for each length of tasks [s]."""


class OneArrayStudy:
    """Stand-in for a study of many blocks along one axis, with one array."""

    points_noun, id = "points", "scale"

    def __init__(self, n_blocks):
        self.n_blocks = n_blocks

    def chunk_owner_blocks(self):
        return {"array": np.arange(self.n_blocks)}


def make_receipt(block, points=65_536):
    """Return the receipt of a block, as a worker would."""
    from sweep.tasks.engine import study_store
    from sweep.tasks.engine.journal import Receipt

    return Receipt(
        block=block, points=points, bytes=3_000_000, digest="0" * 32, seconds=1.234567,
        write_seconds=0.0123, host="node-0123", pid=12_345,
        versions=study_store.current_software_versions(),
    )  # fmt: skip


def make_full_store(directory, n_blocks):
    """Make the log and the chunks of a store whose blocks are all done; return its path.

    The chunks are hard links to a few files.
    """
    store = Path(directory) / "line.zarr"
    (store / ".sweep").mkdir(parents=True)
    with open(store / ".sweep" / "receipts.jsonl", "wb") as log:
        log.writelines(iter_receipt_lines(n_blocks))
    chunks = store / "array" / "c"
    chunks.mkdir(parents=True)
    for block in range(n_blocks if n_blocks <= FILES_MAX else 0):
        if block % HARD_LINKS_MAX == 0:
            chunk = chunks / str(block)
            chunk.write_bytes(b"chunk")
        else:
            os.link(chunk, chunks / str(block))
    return store


def iter_receipt_lines(n_blocks, points=65_536):
    """Yield the lines of the log of a store whose blocks are all done [bytes]."""
    from sweep.storage.store_format import log_line_with_digest

    record = {**vars(make_receipt(0, points)), "time": round(time.time(), 3)}
    other_fields = json.dumps(record, separators=(",", ":")).partition(",")[2][:-1]
    return (
        log_line_with_digest(f'{{"block":{block},{other_fields}'.encode())
        for block in range(n_blocks)
    )


def time_call(function):
    start, cpu_start = time.perf_counter(), time.process_time()
    result = function()
    return result, time.perf_counter() - start, time.process_time() - cpu_start


def measure_blocks(n_blocks, store):
    """Print processor times [s] and memory [MB] that a number of blocks takes, as JSON."""
    from sweep.storage.store_format import read_receipt_totals
    from sweep.tasks.engine.journal import Journal, find_complete_block_mask
    from sweep.tasks.engine.worker import BlockQueue
    from sweep.tasks.studies.parameter_grid import ParameterBlockGrid

    axes = {"target.range": {"linear": ["1 m", "10 km"], "number": n_blocks // 100},
            "target.grazing_angle": {"linear": ["1 deg", "90 deg"], "number": 100}}  # fmt: skip
    spec = experiment_spec("range_angle_coarse", axes=axes, storage={"block_points": 1})
    grid, _, planning_seconds = time_call(lambda: ParameterBlockGrid(spec))
    assert grid.n_blocks == n_blocks
    memory_before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    _, _, opening_seconds = time_call(lambda: Journal(store))
    receipts, _, reading_seconds = time_call(lambda: read_receipt_totals(store, n_blocks))
    assert receipts.n_committed_blocks == n_blocks
    listing_seconds = float("nan")
    if n_blocks <= FILES_MAX:
        is_listed, _, listing_seconds = time_call(
            lambda: find_complete_block_mask(
                store, OneArrayStudy(n_blocks), receipts.points_by_block > 0
            )
        )
        assert is_listed.all()

    def hand_out_blocks():
        queue = BlockQueue(np.zeros(n_blocks, bool))
        while queue.take_blocks(1000):
            pass

    _, _, handing_seconds = time_call(hand_out_blocks)
    memory_after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        json.dumps(
            [
                planning_seconds,
                opening_seconds,
                reading_seconds,
                listing_seconds,
                handing_seconds,
                (memory_after - memory_before) * 1024 / 1e6,
            ]
        )
    )


def iter_block_rows(directory):
    """Yield the rows of the table of blocks."""
    for n_blocks in BLOCK_NUMBERS:
        store = make_full_store(directory, n_blocks)
        command = [sys.executable, __file__, "--blocks", str(n_blocks), "--store", str(store)]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        *seconds, memory = json.loads(output.splitlines()[-1])
        cells = ["-" if s != s else f"{s:.2g} s" for s in seconds]
        yield [f"{n_blocks:,}", *cells, f"{memory:,.0f} MB"]
        shutil.rmtree(store)


def make_waiting_work(seconds):
    """Return a function that replaces the computing of a task: it waits `seconds`, then answers."""

    def wait_in_place_of_work(job, blocks):
        from sweep.tasks.engine.journal import Receipt
        from sweep.tasks.engine.worker import TaskResult

        time.sleep(seconds)
        return TaskResult(
            receipts=[
                Receipt(block=block, points=1, bytes=1, digest="0" * 32, seconds=10.0,
                        write_seconds=0.0, host="h", pid=1, versions={})
                for block in blocks
            ]
        )  # fmt: skip

    return wait_in_place_of_work


def iter_worker_rows(slots, task_seconds, measured_seconds):
    """Yield the rows of the table of workers."""
    import dask
    from distributed import Client, LocalCluster

    dask.config.set({"distributed.worker.profile.enabled": False})  # it looks at every thread
    threads_per_worker = 50
    with (
        LocalCluster(
            n_workers=slots // threads_per_worker,
            threads_per_worker=threads_per_worker,
            processes=False,
            dashboard_address=None,
            memory_limit=0,
        ) as cluster,
        Client(cluster) as client,
    ):
        client.wait_for_workers(slots // threads_per_worker)
        for seconds in task_seconds:
            rate, cpu_seconds_per_task = measure_throughput(client, seconds, measured_seconds)
            busy_share = min(1.0, rate * seconds / slots)
            yield [
                f"{seconds:g} s",
                f"{rate:,.0f}",
                f"{100 * busy_share:.0f} %",
                f"{1e3 * cpu_seconds_per_task:.2g} ms",
            ]


def measure_throughput(client, seconds, measured_seconds):
    """Measure tasks per second once all slots have work, and processor time per task [s]."""
    from sweep.tasks.engine import dispatcher
    from sweep.tasks.engine.worker import TaskSettings

    dispatcher.run_blocks = make_waiting_work(seconds)
    slots = sum(client.nthreads().values())
    queue, job = (
        dispatcher.BlockQueue(np.zeros(10**7, bool)),
        TaskSettings("x", f"waiting {seconds}", None),
    )
    task_scheduler = dispatcher.TaskDispatcher(
        client, 0, job, queue, verify_receipt=lambda *_: True, say=print
    )
    n_arrived, n_counted, stop = 0, 0, threading.Event()
    start = cpu_start = tasks_per_second = cpu_seconds_per_task = 0.0
    for answer in task_scheduler.iter_results(stop.is_set):
        n_arrived += bool(answer.receipts)
        if not start and n_arrived >= slots:
            start, cpu_start, n_counted = time.perf_counter(), time.process_time(), 0
        n_counted += bool(answer.receipts)
        if (
            start
            and not stop.is_set()
            and time.perf_counter() - start > max(measured_seconds, 4 * seconds)
        ):
            tasks_per_second = n_counted / (time.perf_counter() - start)
            cpu_seconds_per_task = (time.process_time() - cpu_start) / n_counted
            stop.set()
    return tasks_per_second, cpu_seconds_per_task


def page_section(block_table, worker_table):
    """Return the section of the page with both tables."""
    return f"""## Blocks

{platform.processor() or platform.machine()}, {os.cpu_count()} processors, Python
{platform.python_version()}. Seconds of processor time of a process of its own; memory beyond what
its libraries take. The log has a receipt for every block, some 330 bytes each. `sweep status` reads
the log, and so does `sweep resume` before it begins; that opens the log, too: it checks every line.
A check of folders runs in threads during the work, and takes its time for each array that blocks
write (a grid without draws has 27). From 10^9 points on blocks grow, so that a study has some
16,000 of them, half a million files, unless it asks for smaller ones.

{block_table}

## Workers

{N_SLOTS:,} worker slots in one process run tasks that only wait, sent and taken by the engine's own
window through the real scheduler. "Slots busy" is the share of time in which they work. The last
column is the processor time of scheduler, client and workers together. Its product with the tasks a
second is at most one: beyond, no more go through. Longer tasks are the remedy, and the engine makes
them so (above).

{worker_table}"""


def main():
    """Measure blocks and workers, print both tables and write them into docs/scale.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--blocks", type=int)
    parser.add_argument("--store", type=Path)
    parser.add_argument("--slots", type=int, default=N_SLOTS)
    parser.add_argument("--seconds", type=float, default=MEASURED_SECONDS)
    arguments = parser.parse_args()
    if arguments.blocks:
        measure_blocks(arguments.blocks, arguments.store)
        return
    with tempfile.TemporaryDirectory() as directory:
        head = ["blocks", "grid", "log opened", "log read", "folders of one array", "handing out",
                "memory"]  # fmt: skip
        block_table = markdown_table(head, iter_block_rows(directory))
    print(block_table)
    head = ["tasks of", "tasks/s", "slots busy", "scheduler and client, a task"]
    worker_table = markdown_table(
        head, iter_worker_rows(arguments.slots, TASK_SECONDS, arguments.seconds)
    )
    print(worker_table)
    replace_page_part("scale.md", "engine", page_section(block_table, worker_table))


if __name__ == "__main__":
    main()
