"""Hundreds of seeded kills: `make chaos`, or `make chaos KILLS=1000 SEED=7`.

Processes of small studies are killed with SIGKILL, before, in and after the write of a block and
its commit; the studies are resumed, killed again, and in the end held against one that nobody
disturbed. Every process is forked from this one, so that a kill costs little more than itself.
"""

from __future__ import annotations

import argparse
import asyncio
import ctypes
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tasks"))

import dask
from distributed import Nanny, Scheduler
from rich.console import Console
from rich.progress import track
from rich.table import Table
from small import receipts, small, tree

from sweep.storage import locations
from sweep.tasks import journal, store, window
from sweep.tasks.driver import resume, run
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.verify import verify

BLOCKS = 12
PATIENCE = 120.0
"""Seconds that a leg of a study may take; beyond, it hangs."""

BEFORE_WRITE, BETWEEN_CHUNKS, IN_A_FILE, AFTER_WRITE = (
    "before a write", "between chunks", "in a file", "after a write",
)  # fmt: skip
BEFORE_COMMIT, IN_COMMIT, AFTER_COMMIT = "before a commit", "in a commit", "after a commit"
WRITES = (BEFORE_WRITE, BETWEEN_CHUNKS, IN_A_FILE, AFTER_WRITE)
COMMITS = (BEFORE_COMMIT, IN_COMMIT, AFTER_COMMIT)


@dataclass(frozen=True)
class Kill:
    """Who dies, or stands still, when: as a block reaches a moment."""

    victim: str
    moment: str
    block: int
    signal: signal.Signals = signal.SIGKILL


@dataclass(frozen=True)
class Kind:
    """A way to be killed."""

    name: str
    victim: str
    moments: tuple[str, ...]
    cluster: str  # "" plain loop, "own" of the client, "other" processes
    share: int  # of a hundred kills
    a_leg: int = 1  # kills that one leg of a study can take
    signal: signal.Signals = signal.SIGKILL


KINDS = (
    Kind("client, plain loop", "here", WRITES + COMMITS, "", 41),
    Kind("client with its cluster", "client", COMMITS, "own", 12),
    Kind("client, its cluster lives on", "client", COMMITS, "lasting", 10),
    Kind("worker", "here", WRITES, "own", 20, a_leg=4),
    Kind("worker, frozen", "here", WRITES, "other", 6, a_leg=2, signal=signal.SIGSTOP),
    Kind("nanny", "nanny", WRITES, "other", 9, a_leg=2),
    Kind("scheduler", "scheduler", WRITES, "other", 8),
)


class Arena:
    """One study, its store and notes of what was done to it.

    Parameters
    ----------
    directory
        A place of its own.
    """

    def __init__(self, directory: Path) -> None:
        self.directory, self.store = directory, directory / "stores" / "small.zarr"
        self.store.parent.mkdir(parents=True)
        self.log = directory / "log"
        self.kills: list[Kill] = []
        self.pids: dict[str, int] = {}

    def note(self, line: str) -> None:
        """Add a line to the log; whole lines, whoever writes."""
        with open(self.log, "ab", buffering=0) as log:
            log.write(f"{line}\n".encode())

    def reached(self, moment: str, block: int) -> None:
        """Kill whom the plan says, once."""
        for kill in self.kills:
            if (kill.moment, kill.block) != (moment, block):
                continue
            try:
                os.close(os.open(self.mark(kill), os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                continue
            os.kill(self._pid(kill.victim), kill.signal)

    def mark(self, kill: Kill) -> Path:
        """File that stands for a kill that happened."""
        return self.directory / f"{kill.victim}-{kill.moment}-{kill.block}".replace(" ", "_")

    def done(self) -> list[Kill]:
        """Kills that happened in this leg."""
        return [kill for kill in self.kills if self.mark(kill).exists()]

    def _pid(self, victim: str) -> int:
        if victim == "nanny":
            return os.getppid()
        return os.getpid() if victim == "here" else self.pids[victim]


def evaluate(study, block):
    """The model, with a note of what is computed."""
    ARENA[0].note(f"{block} evaluated")
    return study.evaluate(block)


_libc = ctypes.CDLL(None)
PR_SET_PDEATHSIG = 1

ARENA: list[Arena] = []
"""The one of this process; those that are forked from it inherit it."""


def set_traps(arena: Arena) -> None:
    """Have all that is written and committed from here on pass by the arena, here and in forks."""
    ARENA[:] = [arena]
    write, commit, put, append = (
        store.Arrays.write, journal.Journal.commit, locations.put, os.write,
    )  # fmt: skip
    writing: list[int] = []  # the block, and how many of its files are written

    def trapped_write(self, block, results):
        arena.reached(BEFORE_WRITE, block)
        writing[:] = [block, 0]
        digest = write(self, block, results)
        arena.reached(AFTER_WRITE, block)
        return digest

    def trapped_put(file, content, **options):
        path = Path(file)
        if writing and "c" in path.parts:
            writing[1] += 1
            if writing[1] == 5:
                arena.reached(BETWEEN_CHUNKS, writing[0])
            if writing[1] == 9 and any(k.moment == IN_A_FILE for k in arena.kills):
                half = path.with_suffix(f".{os.getpid()}.partial")
                half.parent.mkdir(parents=True, exist_ok=True)
                half.write_bytes(content[: len(content) // 2])
                arena.reached(IN_A_FILE, writing[0])
                half.unlink()
        return put(file, content, **options)

    def trapped_commit(self, *committed):
        blocks = [receipt.block for receipt in committed]
        reached_by_all(BEFORE_COMMIT, blocks)
        os.write = partial(half_written, blocks)
        try:
            commit(self, *committed)
        finally:
            os.write = append
        for block in blocks:
            arena.note(f"{block} committed")
        reached_by_all(AFTER_COMMIT, blocks)

    def half_written(blocks, log, lines):
        half = append(log, lines[: len(lines) // 2])
        reached_by_all(IN_COMMIT, blocks)
        return half + append(log, lines[half:])

    def reached_by_all(moment, blocks):
        for block in blocks:
            arena.reached(moment, block)

    store.Arrays.write, journal.Journal.commit = trapped_write, trapped_commit
    locations.put = trapped_put


def forked(work: Callable[[], object]) -> int:
    """Do something in a process of its own, in a group of its own; its pid."""
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        os.setsid()
        _libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        if not os.environ.get("CHAOS_LOUD"):
            os.dup2(silence, 2)
        work()
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def ended(pid: int) -> bool:
    """Wait for a process: whether it ended in time."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        if os.waitpid(pid, os.WNOHANG)[0]:
            return True
        time.sleep(0.01)
    return False


def end(pid: int) -> None:
    """End a process and all of its group."""
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)
    with suppress(ChildProcessError):
        os.waitpid(pid, 0)


def serve_scheduler(file: Path) -> None:
    """A scheduler, as long as this process lives."""

    async def forever() -> None:
        async with Scheduler(host="127.0.0.1", dashboard=False) as scheduler:
            file.with_suffix(".draft").write_text(scheduler.address)
            file.with_suffix(".draft").rename(file)
            await scheduler.finished()

    asyncio.run(forever())


def serve_nanny(arena: Arena, address: str) -> None:
    """A nanny and its worker, in the arena, as long as this process lives."""
    set_traps(arena)

    async def forever() -> None:
        async with Nanny(address, nthreads=1, memory_limit=0, dashboard=False) as nanny:
            await nanny.finished()

    asyncio.run(forever())


@contextmanager
def cluster(arena: Arena, workers: int) -> Iterator[str]:
    """A scheduler and nannies, each a process of its own; the scheduler's address."""
    file = arena.directory / f"scheduler-{random.random()}"
    pids = [forked(lambda: serve_scheduler(file))]
    try:
        arena.pids["scheduler"] = pids[0]
        deadline = time.monotonic() + PATIENCE
        while not file.exists():
            assert time.monotonic() < deadline, "no scheduler"
            time.sleep(0.01)
        address = file.read_text()
        pids += [forked(lambda: serve_nanny(arena, address)) for _ in range(workers)]
        yield address
    finally:
        for pid in pids:
            end(pid)


@dataclass
class Count:
    """What came of the kills of one kind."""

    kills: Counter[str] = field(default_factory=Counter)  # by moment
    studies: int = 0
    lost: int = 0  # blocks that were committed and had to be computed again, or never came
    twice: int = 0  # blocks with more than one receipt
    different: int = 0  # stores that are not the undisturbed one, byte by byte
    hanging: int = 0


def leg(arena: Arena, scheduler: str | None) -> Callable[[], object]:
    """A run or resumption of the study, in a process that may be killed."""

    def go_on() -> None:
        arena.pids["client"] = os.getpid()
        set_traps(arena)
        place = {"scheduler": scheduler} if scheduler else {"workers": 2}
        again = arena.store.exists()
        start = resume if again else run
        spec = {} if again else {"spec": small()}
        start(**spec, store=arena.store, evaluate=evaluate, progress=False, **place)

    return go_on


def plan(arena: Arena, kind: Kind, dice: random.Random, most: int) -> list[Kill]:
    """Kills of the next leg, at blocks that are still to be done."""
    left = [block for block in range(BLOCKS) if block not in receipts(arena.store)]
    ahead = left[: max(4, kind.a_leg * 2)]
    blocks = dice.sample(ahead, min(kind.a_leg, most, len(ahead)))
    return [Kill(kind.victim, dice.choice(kind.moments), block, kind.signal) for block in blocks]


def torment(kind: Kind, dice: random.Random, most: int, directory: Path) -> tuple[Arena, Count]:
    """One study, killed and resumed until it is done or was killed as often as it may be."""
    arena, count = Arena(directory), Count(studies=1)
    with cluster(arena, 2) if kind.cluster == "lasting" else nullcontext() as lasting:
        for _ in range(2 * most):
            arena.kills = plan(arena, kind, dice, most - sum(count.kills.values()))
            if not arena.kills:
                break
            _one_leg(arena, kind, count, lasting)
            count.kills.update(kill.moment for kill in arena.done())
    arena.kills = []
    _one_leg(arena, KINDS[0], count, None)
    return arena, count


def _one_leg(arena: Arena, kind: Kind, count: Count, lasting: str | None) -> None:
    for kill in arena.kills:
        arena.mark(kill).unlink(missing_ok=True)
    with cluster(arena, 3) if kind.cluster == "other" else nullcontext() as other:
        scheduler = {"": "none", "own": None, "lasting": lasting, "other": other}[kind.cluster]
        pid = forked(leg(arena, scheduler))
        count.hanging += not ended(pid)
        end(pid)


def judge(arena: Arena, kind: Kind, count: Count, undisturbed: dict[str, str]) -> None:
    """Hold a study that was tormented against the undisturbed one."""
    may_race = kind.signal == signal.SIGSTOP  # two are at the same block, and one commits it
    committed: set[str] = set()
    for line in arena.log.read_text().splitlines():
        block, what = line.split()
        if what == "committed":
            committed.add(block)
        else:
            count.lost += block in committed and not may_race
    written = Counter(receipts(arena.store))
    count.lost += BLOCKS - len(written)
    count.twice += sum(number > 1 for number in written.values())
    (report,) = verify(arena.store, progress=False)
    alone = [child.name for child in arena.store.parent.iterdir()] == [arena.store.name]
    same = tree(arena.store) == undisturbed
    count.different += not (same and alone and report.sound and report.complete)


def prepare() -> None:
    """Load all that the study computes with, so that no fork has to."""
    study = GridStudy(small())
    study.compile()
    study.evaluate(0)
    window.LEASE = 3.0
    dask.config.set({
        "distributed.worker.multiprocessing-method": "fork",
        "distributed.comm.timeouts.connect": "5s",
        "distributed.admin.tick.limit": "60s",
    })  # fmt: skip


def campaign(
    kills: int, seed: int, *, kinds: tuple[Kind, ...] = KINDS, a_study: int = 4, show: bool = False
) -> dict[str, Count]:
    """Kill so often, and judge every study.

    Parameters
    ----------
    kills, seed
        How many, and the seed of when and whom.
    kinds, a_study
        Ways to be killed; most kills of one study.
    show
        Whether to show a bar.
    """
    prepare()
    dice, counts = random.Random(seed), {kind.name: Count() for kind in kinds}
    directory = Path(tempfile.mkdtemp(prefix="chaos-"))
    whole = sum(kind.share for kind in kinds)
    try:
        undisturbed = directory / "undisturbed.zarr"
        ended(forked(lambda: run(small(), store=undisturbed, scheduler="none", progress=False)))
        expected = tree(undisturbed)
        for kind in track(kinds, "killing", disable=not show):
            count, wanted = counts[kind.name], -(-kills * kind.share // whole)
            while (so_far := sum(count.kills.values())) < wanted:
                place = directory / f"{kind.name}-{count.studies}".replace(" ", "_")
                most = min(a_study, wanted - so_far)
                arena, one = torment(kind, dice, most, place)
                judge(arena, kind, one, expected)
                _add(count, one)
                if not (one.lost or one.twice or one.different or one.hanging):
                    shutil.rmtree(place)
                if one.hanging or count.studies > 3 * wanted:
                    break
    finally:
        if not any(c.lost or c.twice or c.different or c.hanging for c in counts.values()):
            shutil.rmtree(directory)
        elif show:
            print(f"what went wrong is in {directory}", file=sys.stderr)
    return counts


def _add(count: Count, one: Count) -> None:
    count.kills += one.kills
    for name in ("studies", "lost", "twice", "different", "hanging"):
        setattr(count, name, getattr(count, name) + getattr(one, name))


def told(counts: dict[str, Count]) -> Table:
    """The table of a campaign."""
    headings = ["killed", *WRITES, *COMMITS, "kills", "studies", "lost", "twice", "not identical"]
    table = Table(*headings, box=None)
    for name, count in counts.items():
        numbers = [count.kills[moment] for moment in (*WRITES, *COMMITS)]
        ends = [sum(numbers), count.studies, count.lost, count.twice, count.different]
        table.add_row(name, *[str(n) if n else "-" for n in numbers], *map(str, ends))
    return table


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=210)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    begun = time.monotonic()
    counts = campaign(arguments.kills, arguments.seed, show=True)
    Console(width=200).print(told(counts))
    kills = sum(sum(count.kills.values()) for count in counts.values())
    wrong = sum(c.lost + c.twice + c.different + c.hanging for c in counts.values())
    print(f"{kills} kills, seed {arguments.seed}, {time.monotonic() - begun:.0f} s: ", end="")
    print("nothing lost, nothing twice, every store identical" if not wrong else "NOT ALL IS WELL")
    sys.exit(bool(wrong) or kills < arguments.kills)


if __name__ == "__main__":
    main()
