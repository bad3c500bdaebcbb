"""A study of a million blocks, command by command: how soon each is at work, and its memory.

Run with `make million`, a minute or two. A study of a million points, one to a block, is begun,
stopped by Ctrl-C after some hundred blocks, shown and resumed until more are done. Then its log is
given receipts of 900,000 blocks, as a study that far on has (their 24 million files are not made:
`status` does not look at them, and `resume` does so beside its work), and it is shown and resumed
again. Memory is the largest of the command's own process, without its workers'.
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
from scale import receipt_lines
from shared import EXPERIMENTS, plain, put, show, table

SIDE, DONE = 1000, 900_000
FURTHER, LINE = 100, 330
"""Blocks that are waited for; bytes of a receipt, some."""
WAIT = 300.0


def spec_at(folder: Path) -> Path:
    """A spec of a million points, a block each."""
    axes = {
        "target.range": {"linear": ["10 m", "5 km"], "number": SIDE},
        "target.grazing_angle": {"linear": ["1 deg", "90 deg"], "number": SIDE},
    }
    written = plain(EXPERIMENTS, "range_angle_coarse") | {
        "axes": axes,
        "storage": {"block_points": 1},
    }
    path = folder / "million.yaml"
    path.write_text(yaml.safe_dump(written))
    return path


def log_of(store: Path) -> Path:
    """The log of receipts."""
    return store / ".sweep" / "receipts.jsonl"


def command(*words: str) -> subprocess.Popen:
    """The command in a process of its own."""
    line = [sys.executable, "-c", "from sweep.cli import main; main()", *words]
    return subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def until_at_work(store: Path, *words: str) -> list[str]:
    """Time until a command's first blocks are committed, and its memory; then Ctrl-C."""

    def size() -> int:
        return log_of(store).stat().st_size if log_of(store).exists() else 0

    before, begun = size(), time.perf_counter()
    child = command(*words, "--workers", "2")
    process, first, most = psutil.Process(child.pid), 0.0, 0
    while (further := size() - before) <= FURTHER * LINE:
        most = max(most, process.memory_info().rss)
        first = first or (time.perf_counter() - begun if further > 0 else 0.0)
        if child.poll() is not None or time.perf_counter() - begun > WAIT:
            raise RuntimeError(child.communicate()[0])
        time.sleep(0.01)
    os.kill(child.pid, signal.SIGINT)
    told, _ = child.communicate(timeout=WAIT)
    if child.returncode == 0 or "Traceback" in told:
        raise RuntimeError(told)
    return cells(first or time.perf_counter() - begun, most)


def status(store: Path) -> list[str]:
    """Time that `sweep status` takes, and its memory; what it says is printed."""
    begun = time.perf_counter()
    child = command("status", str(store))
    assert child.stdout is not None
    print(child.stdout.read())
    _, code, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(code)
    return cells(time.perf_counter() - begun, usage.ru_maxrss * 1024)


def cells(seconds: float, memory: float) -> list[str]:
    """Time [s] and memory [B] as the table has them."""
    return [f"{seconds:.1f} s", f"{memory / 1e6:.0f} MB"]


def main() -> None:
    """All of it."""
    with tempfile.TemporaryDirectory() as name:
        spec, store = spec_at(Path(name)), Path(name) / "million.zarr"
        run = until_at_work(store, "run", str(spec), "--store", str(store))
        rows = [["`run`, first block committed", "0", *run]]
        for done in (FURTHER, DONE):
            rows.append(["`status`", f"{done:,}", *status(store)])
            again = until_at_work(store, "resume", str(store))
            rows.append(["`resume`, first block committed", f"{done:,}", *again])
            if done == FURTHER:
                with open(log_of(store), "ab") as log:
                    log.writelines(receipt_lines(DONE, points=1))
    head = ["command", "blocks done before", "time", "memory"]
    show(head, rows)
    put("scale.md", "million", table(head, rows))


if __name__ == "__main__":
    main()
