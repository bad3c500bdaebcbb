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
import scale_page
import yaml
from rich.console import Console
from rich.table import Table
from scale import receipt_lines

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
SIDE = 1000
DONE = 900_000
FURTHER = 100
"""Blocks that are waited for."""

LINE = 330
"""Bytes of a receipt, some."""

WAIT = 300.0


def spec_at(folder: Path) -> Path:
    """A spec of a million points, a block each."""
    from sweep.spec.reading import read_document

    mapping = read_document(EXPERIMENTS / "quickstart.yaml").value | {
        "instrument": str(EXPERIMENTS / "instruments" / "table_4_1.yaml"),
        "axes": {
            "target.range": {"linear": ["10 m", "5 km"], "number": SIDE},
            "target.grazing_angle": {"linear": ["1 deg", "90 deg"], "number": SIDE},
        },
        "storage": {"block_points": 1},
        "figures": [],
    }
    path = folder / "million.yaml"
    path.write_text(yaml.safe_dump(mapping))
    return path


def log_of(store: Path) -> Path:
    """The log of receipts."""
    return store / ".sweep" / "receipts.jsonl"


def size_of(path: Path) -> int:
    """Bytes of a file, 0 where there is none."""
    return path.stat().st_size if path.exists() else 0


def command(*words: str) -> subprocess.Popen:
    """The command in a process of its own."""
    line = [sys.executable, "-c", "from sweep.cli import main; main()", *words]
    return subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def until_at_work(store: Path, *words: str) -> tuple[float, float]:
    """Seconds until a command's first blocks are committed, and its memory [MB]; then Ctrl-C."""
    before, begun = size_of(log_of(store)), time.perf_counter()
    child = command(*words, "--workers", "2")
    process, first, most = psutil.Process(child.pid), 0.0, 0
    while True:
        most = max(most, process.memory_info().rss)
        further = size_of(log_of(store)) - before
        first = first or (time.perf_counter() - begun if further > 0 else 0.0)
        if further > FURTHER * LINE:
            break
        if child.poll() is not None or time.perf_counter() - begun > WAIT:
            raise RuntimeError(child.communicate()[0])
        time.sleep(0.01)
    os.kill(child.pid, signal.SIGINT)
    told, _ = child.communicate(timeout=WAIT)
    if child.returncode == 0 or "Traceback" in told:
        raise RuntimeError(told)
    return first, most / 1e6


def status(store: Path) -> tuple[float, float, str]:
    """Seconds that `sweep status` takes, its memory [MB], and what it says."""
    begun = time.perf_counter()
    child = command("status", str(store))
    assert child.stdout is not None
    told = child.stdout.read()
    _, code, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(code)
    return time.perf_counter() - begun, usage.ru_maxrss * 1024 / 1e6, told


def main() -> None:
    """All of it."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        spec, store = spec_at(folder), folder / "million.zarr"
        seconds, memory = until_at_work(store, "run", str(spec), "--store", str(store))
        rows.append(["`run`, first block committed", "0", f"{seconds:.1f} s", f"{memory:.0f} MB"])
        for done in (f"{FURTHER:,}", f"{DONE:,}"):
            seconds, memory, told = status(store)
            rows.append(["`status`", done, f"{seconds:.1f} s", f"{memory:.0f} MB"])
            Console().print(told)
            seconds, memory = until_at_work(store, "resume", str(store))
            rows.append(["`resume`, first block committed", done, f"{seconds:.1f} s",
                         f"{memory:.0f} MB"])  # fmt: skip
            if done == f"{FURTHER:,}":
                with open(log_of(store), "ab") as log:
                    log.writelines(receipt_lines(DONE, points=1))
    head = ["command", "blocks done before", "time", "memory"]
    table = Table(*head)
    for row in rows:
        table.add_row(*row)
    Console().print(table)
    scale_page.put("million", head, rows)


if __name__ == "__main__":
    main()
