"""Measure commands on a study of a million blocks: time to the first block, and memory.

Run with `make million`, a minute or two. A study of a million points, one to a block, is started,
stopped by Ctrl-C after some hundred blocks, shown and resumed until more are done. Then its log
gets receipts of 900,000 blocks, and it is shown and resumed again. The 24 million files of these
blocks are not made: `status` does not read them, and `resume` does so while it computes. Memory is
the largest of the command's own process, without that of its workers.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
import yaml
from benchmark_helpers import (
    EXPERIMENTS,
    experiment_mapping,
    markdown_table,
    print_table,
    replace_page_part,
)
from engine_limits import iter_receipt_lines

POINTS_PER_AXIS, BLOCKS_DONE = 1000, 900_000
BLOCKS_TO_WAIT_FOR, RECEIPT_BYTES = 100, 330
"""Number of blocks to wait for, and approximate size of a receipt [bytes]."""
COMMAND_TIMEOUT = 300.0


def write_spec(folder: Path) -> Path:
    """Write a spec of a million points, each a block; return its path."""
    axes = {
        "target.range": {"linear": ["10 m", "5 km"], "number": POINTS_PER_AXIS},
        "target.grazing_angle": {"linear": ["1 deg", "90 deg"], "number": POINTS_PER_AXIS},
    }
    mapping = experiment_mapping(EXPERIMENTS, "range_angle_coarse") | {
        "axes": axes,
        "storage": {"block_points": 1},
    }
    path = folder / "million.yaml"
    path.write_text(yaml.safe_dump(mapping))
    return path


def receipt_log(store: Path) -> Path:
    """Return the path of a store's log of receipts."""
    return store / ".sweep" / "receipts.jsonl"


def start_command(*words: str) -> subprocess.Popen:
    """Start a command of `sweep` in a new process."""
    arguments = [sys.executable, "-c", "from sweep.cli import main; main()", *words]
    return subprocess.Popen(
        arguments,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def time_to_first_blocks(store: Path, *arguments: str) -> list[str]:
    """Run a command until its first blocks are committed, then stop it by Ctrl-C.

    Return cells with the time and the memory.
    """

    def log_bytes() -> int:
        return receipt_log(store).stat().st_size if receipt_log(store).exists() else 0

    bytes_before, start = log_bytes(), time.perf_counter()
    child = start_command(*arguments, "--workers", "2")
    process, first_seconds, memory_max = psutil.Process(child.pid), 0.0, 0
    while (bytes_added := log_bytes() - bytes_before) <= BLOCKS_TO_WAIT_FOR * RECEIPT_BYTES:
        memory_max = max(memory_max, process.memory_info().rss)
        first_seconds = first_seconds or (time.perf_counter() - start if bytes_added > 0 else 0.0)
        if child.poll() is not None or time.perf_counter() - start > COMMAND_TIMEOUT:
            raise RuntimeError(child.communicate()[0])
        time.sleep(0.01)
    os.kill(child.pid, signal.SIGINT)
    output, _ = child.communicate(timeout=COMMAND_TIMEOUT)
    if child.returncode == 0 or "Traceback" in output:
        raise RuntimeError(output)
    return table_cells(first_seconds or time.perf_counter() - start, memory_max)


def measure_status(store: Path) -> list[str]:
    """Run `sweep status` and print its output; return cells with the time and the memory."""
    start = time.perf_counter()
    child = start_command("status", str(store))
    assert child.stdout is not None
    print(child.stdout.read())
    _, code, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(code)
    return table_cells(time.perf_counter() - start, usage.ru_maxrss * 1024)


def table_cells(seconds: float, memory: float) -> list[str]:
    """Format a time [s] and a memory size [bytes] as cells of the table."""
    return [f"{seconds:.1f} s", f"{memory / 1e6:.0f} MB"]


def main() -> None:
    """Measure all commands, and write the table into docs/scale.md."""
    with tempfile.TemporaryDirectory() as name:
        spec, store = write_spec(Path(name)), Path(name) / "million.zarr"
        run_cells = time_to_first_blocks(store, "run", str(spec), "--store", str(store))
        rows = [["`run`, first block committed", "0", *run_cells]]
        for blocks_done in (BLOCKS_TO_WAIT_FOR, BLOCKS_DONE):
            rows.append(["`status`", f"{blocks_done:,}", *measure_status(store)])
            resume_cells = time_to_first_blocks(store, "resume", str(store))
            rows.append(["`resume`, first block committed", f"{blocks_done:,}", *resume_cells])
            if blocks_done == BLOCKS_TO_WAIT_FOR:
                with open(receipt_log(store), "ab") as log:
                    log.writelines(iter_receipt_lines(BLOCKS_DONE, points=1))
    head = ["command", "blocks done before", "time", "memory"]
    print_table(head, rows)
    replace_page_part("scale.md", "million", markdown_table(head, rows))


if __name__ == "__main__":
    main()
