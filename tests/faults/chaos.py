"""Hundreds of seeded kills: `make chaos`, or `make chaos KILLS=1000 SEED=7`.

Processes of small studies are killed before, in and after the write of a block and its commit, and
commands that replace, repair or copy a store between any two of their changes to the disk. The
studies are resumed, killed again, and in the end held against one that nobody disturbed. Most die
by SIGKILL, some by SIGTERM or SIGHUP, and some with the power of a disk of their own, which then
holds what was on it and nothing that the operating system still had in memory. Every process is
forked from this one, so that a kill costs little more than itself.
"""

from __future__ import annotations

import argparse
import asyncio
import ctypes
import fcntl
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tasks"))

import dask
from distributed import Nanny, Scheduler
from rich.console import Console
from rich.progress import track
from rich.table import Table
from small import copied, receipts, small, tree

from sweep.storage import locations
from sweep.tasks import journal, scheduler, store
from sweep.tasks.driver import extend, resume, run
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.verify import pack, verify

BLOCKS = 12
PATIENCE = 120.0
"""Seconds that a leg of a study may take; beyond, it hangs."""

BEFORE_WRITE, BETWEEN_CHUNKS, IN_A_FILE, AFTER_WRITE = (
    "before a write", "between chunks", "in a file", "after a write",
)  # fmt: skip
BEFORE_COMMIT, IN_COMMIT, AFTER_COMMIT = "before a commit", "in a commit", "after a commit"
WRITES = (BEFORE_WRITE, BETWEEN_CHUNKS, IN_A_FILE, AFTER_WRITE)
COMMITS = (BEFORE_COMMIT, IN_COMMIT, AFTER_COMMIT)
ANYWHERE, REPLACING = "at any change", "as it is replaced"
CHANGES = (ANYWHERE, REPLACING, REPLACING)
"""Of a command's changes to the disk, by number; the first ones from a renaming of the store on."""

KILL, POWER = ("SIGKILL",), ("power",)
ANY_SIGNAL = ("SIGKILL", "SIGTERM", "SIGHUP")
DURABLE = {"durable": True}

MOST_CHANGES = {"extend": 2600, "overwrite": 2600, "repair": 85, "finalize": 400}
"""Changes of a command to the disk, about."""

LARGER = {"axes.instrument.laser.power": ["1 W", "3 W", "4 W"]}
"""What the study is extended by."""


@dataclass(frozen=True)
class Kill:
    """A victim and its moment: a block, or a change by its number."""

    victim: str
    moment: str
    block: int
    by: str = "SIGKILL"


@dataclass(frozen=True)
class Kind:
    """A way to be killed."""

    name: str
    victim: str
    moments: tuple[str, ...]
    cluster: str  # "" plain loop, "own" of the client, "other" processes
    share: int  # of the kills
    a_leg: int = 1  # kills that one leg of a study can take
    by: tuple[str, ...] = KILL
    command: str = "run"


KINDS = (
    Kind("client, plain loop", "here", WRITES + COMMITS, "", 41),
    Kind("client with its cluster", "client", COMMITS, "own", 12),
    Kind("client, its cluster lives on", "client", COMMITS, "lasting", 10),
    Kind("worker", "here", WRITES, "own", 20, a_leg=4),
    Kind("worker, frozen", "here", WRITES, "other", 6, a_leg=2, by=("SIGSTOP",)),
    Kind("nanny", "nanny", WRITES, "other", 9, a_leg=2),
    Kind("scheduler", "scheduler", WRITES, "other", 8),
    Kind("client, by SIGTERM or SIGHUP", "here", WRITES + COMMITS, "", 10, by=ANY_SIGNAL[1:]),
    Kind("extend", "here", CHANGES, "", 25, by=ANY_SIGNAL, command="extend"),
    Kind("run --overwrite", "here", CHANGES, "", 25, by=ANY_SIGNAL, command="overwrite"),
    Kind("verify --repair", "here", (ANYWHERE,), "", 25, by=ANY_SIGNAL, command="repair"),
    Kind("finalize", "here", CHANGES, "", 15, by=ANY_SIGNAL, command="finalize"),
    Kind("power, run --durable", "here", WRITES + COMMITS, "", 15, by=POWER),
    Kind("power, extend --durable", "here", CHANGES, "", 15, by=POWER, command="extend"),
    Kind("power, verify --repair", "here", (ANYWHERE,), "", 10, by=POWER, command="repair"),
    Kind("power, finalize", "here", CHANGES, "", 10, by=POWER, command="finalize"),
)


class Disk:
    """A disk of its own in a file in a directory, whose power can be cut."""

    def __init__(self, directory: Path) -> None:
        self._image, self.place = directory / "disk.img", directory / "disk"
        self.place.mkdir(parents=True)
        with open(self._image, "wb") as image:
            image.truncate(48 << 20)
        _command("mkfs.ext4", "-q", str(self._image))
        self.switch_on()

    def switch_on(self) -> None:
        """Mount it: what its journal holds is put in its place."""
        _command("mount", "-o", "loop", str(self._image), str(self.place))

    def cut(self) -> None:
        """Cut its power: nothing that is not on it will be, and no process can use it."""
        shut_down, without_the_log = 0x8004587D, struct.pack("I", 2)  # EXT4_IOC_SHUTDOWN
        place = os.open(self.place, os.O_RDONLY)
        fcntl.ioctl(place, shut_down, without_the_log)
        os.close(place)

    def switch_off(self) -> None:
        """Unmount it."""
        _command("umount", str(self.place))


def _command(*words: str) -> None:
    subprocess.run(words, check=True, capture_output=True)


def has_disks(directory: Path) -> bool:
    """True where this machine allows disks of one's own whose power can be cut."""
    try:
        disk = Disk(directory / "trial")
        disk.cut()
        disk.switch_off()
    except (OSError, subprocess.CalledProcessError):
        return False
    return True


class Arena:
    """One study, its store, on a disk of its own if there is one, and notes of what was done."""

    def __init__(self, directory: Path, disk: Disk | None = None) -> None:
        self.directory, self.disk = directory, disk
        self.store = (disk.place if disk else directory) / "stores" / "small.zarr"
        self.store.parent.mkdir(parents=True)
        self.output = self.store.with_name("small_final.zarr")
        self.log = directory / "log"
        self.log.touch()
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
            if kill.by == "power":
                self.disk.cut()
            cause = signal.SIGKILL if kill.by == "power" else signal.Signals[kill.by]
            os.kill(self._pid(kill.victim), cause)

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


def set_changes(arena: Arena) -> None:
    """Have every change to a disk pass by the arena first."""
    number = {ANYWHERE: 0, REPLACING: -1}  # of the change; from a renaming of the store on
    stores = {arena.store, arena.output}

    def trapped(change, *arguments, **options):
        first = arguments[0]
        place = Path(os.readlink(f"/proc/self/fd/{first}") if isinstance(first, int) else first)
        if place.is_absolute() and arena.store.parent not in place.parents:
            return change(*arguments, **options)
        if change is rename and stores & {place, Path(arguments[1])}:
            number[REPLACING] = max(number[REPLACING], 0)
        for moment in number:
            if number[moment] >= 0:
                arena.reached(moment, number[moment])
                number[moment] += 1
        return change(*arguments, **options)

    rename = os.rename
    for name in ("write", "fsync", "rename", "replace", "link", "unlink", "rmdir", "mkdir"):
        setattr(os, name, partial(trapped, getattr(os, name)))


def set_traps(arena: Arena) -> None:
    """Have all that is written and committed from here on pass by the arena, here and in forks."""
    ARENA[:] = [arena]
    if any(kill.moment in CHANGES for kill in arena.kills):
        set_changes(arena)
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


def leg(arena: Arena, scheduler: str | None, command: str = "run") -> Callable[[], object]:
    """A command on the study, in a process that may be killed."""

    def go_on() -> None:
        arena.pids["client"] = os.getpid()
        tempfile.tempdir = str(arena.directory)
        set_traps(arena)
        place = {"scheduler": scheduler} if scheduler else {"workers": 2}
        how = {"evaluate": evaluate, "progress": False, "durable": bool(arena.disk), **place}
        path = arena.store
        if command == "extend":
            extend(path, changes=LARGER, **how)
        elif command == "overwrite":
            run(other(), store=path, overwrite=True, **how)
        elif command == "repair":
            verify(path, repair=True, progress=False)
        elif command == "finalize" and not arena.output.exists():
            pack(path, arena.output, progress=False)
        elif command == "run" and path.exists():
            resume(path, **how)
        elif command == "run":
            run(small(), store=path, **how)

    return go_on


def other():
    """The study that takes the place of the small one by --overwrite."""
    return small(footprint={"beamlets": 7, "speckle": "none"})


def set_up(arena: Arena, command: str, undisturbed: Path, dice: random.Random) -> None:
    """Put what a command needs in its place: a complete store, for repair a damaged one."""
    if command == "run":
        return
    copied(undisturbed, arena.store.parent).rename(arena.store)
    if command == "repair":
        listed = ".sweep/template.jsonl"
        names = dice.sample(["pd_up/zarr.json", "range/c/0", "grazing_angle/zarr.json", listed], 3)
        for name in ("zarr.json", *names):
            content = bytearray((arena.store / name).read_bytes())
            content[len(content) * 2 // 3] ^= 4
            (arena.store / name).write_bytes(content)
    if arena.disk:
        store.sync(arena.store)


def plan(arena: Arena, kind: Kind, dice: random.Random, most: int) -> list[Kill]:
    """Kills of the next leg, at blocks that are still to be done."""
    moment = dice.choice(kind.moments)
    if moment in CHANGES:
        number = dice.randrange(MOST_CHANGES[kind.command] if moment == ANYWHERE else 12)
        return [Kill(kind.victim, moment, number, dice.choice(kind.by))] if most else []
    left = [block for block in range(BLOCKS) if block not in receipts(arena.store)]
    ahead = left[: max(4, kind.a_leg * 2)]
    blocks = dice.sample(ahead, min(kind.a_leg, most, len(ahead)))
    return [
        Kill(kind.victim, dice.choice(kind.moments), block, dice.choice(kind.by))
        for block in blocks
    ]


def torment(
    kind: Kind, dice: random.Random, most: int, directory: Path, undisturbed: Path
) -> tuple[Arena, Count]:
    """One study, killed and resumed until it is done or was killed as often as it may be."""
    disk = Disk(directory) if kind.by == POWER else None
    arena, count = Arena(directory, disk), Count(studies=1)
    set_up(arena, kind.command, undisturbed, dice)
    with cluster(arena, 2) if kind.cluster == "lasting" else nullcontext() as lasting:
        for _ in range(2 * most):
            arena.kills = plan(arena, kind, dice, most - sum(count.kills.values()))
            if not arena.kills:
                break
            _one_leg(arena, kind, count, lasting)
            count.kills.update(kill.moment for kill in arena.done())
            if kind.command in ("extend", "overwrite"):  # there is the old one, or the new one
                (report,) = verify(arena.store, progress=False)
                count.lost += not (report.sound and report.complete)
    arena.kills = []
    _one_leg(arena, replace(kind, cluster=""), count, None)
    if kind.command == "repair":
        _one_leg(arena, KINDS[0], count, None)
    return arena, count


def _one_leg(arena: Arena, kind: Kind, count: Count, lasting: str | None) -> None:
    for kill in arena.kills:
        arena.mark(kill).unlink(missing_ok=True)
    with cluster(arena, 3) if kind.cluster == "other" else nullcontext() as other:
        scheduler = {"": "none", "own": None, "lasting": lasting, "other": other}[kind.cluster]
        pid = forked(leg(arena, scheduler, kind.command))
        count.hanging += not ended(pid)
        end(pid)
    if arena.disk:
        arena.disk.switch_off()
        arena.disk.switch_on()


def judge(arena: Arena, kind: Kind, count: Count, undisturbed: Path) -> None:
    """Hold a study that was tormented against the undisturbed one."""
    committed: set[str] = set()
    made = arena.output if kind.command == "finalize" else arena.store
    anew = kind.command == "overwrite"
    may_race = "SIGSTOP" in kind.by  # two are at the same block, and one commits it
    for line in arena.log.read_text().splitlines():
        block, what = line.split()
        if what == "committed":
            committed.add(block)
        else:
            count.lost += block in committed and not (anew or may_race)
    written = Counter(receipts(made))
    count.lost += len(receipts(undisturbed)) - len(written)
    count.twice += sum(number > 1 for number in written.values())
    reports = [report for path in {arena.store, made} for report in verify(path, progress=False)]
    alone = set(arena.store.parent.iterdir()) == {arena.store, made}
    whole = all(report.sound and report.complete for report in reports)
    count.different += not (tree(made) == tree(undisturbed) and alone and whole)
    if arena.disk:
        arena.disk.switch_off()


def prepare() -> None:
    """Load all that the study computes with, so that no fork has to."""
    study = GridStudy(small())
    study.compile()
    study.evaluate(0)
    scheduler.LEASE = 3.0
    dask.config.set({
        "distributed.worker.multiprocessing-method": "fork",
        "distributed.comm.timeouts.connect": "5s",
        "distributed.admin.tick.limit": "60s",
    })  # fmt: skip


def undisturbed_stores(directory: Path) -> dict[str, Path]:
    """Stores that commands make undisturbed."""

    def make() -> None:
        run(small(), store=made["run"], scheduler="none", progress=False)
        extend(made["run"], changes=LARGER, to=made["extend"], scheduler="none", progress=False)
        run(other(), store=made["overwrite"], scheduler="none", progress=False)
        pack(made["run"], made["finalize"], progress=False)

    made = {name: directory / f"{name}.zarr" for name in ("run", "extend", "overwrite", "finalize")}
    assert ended(forked(make))
    return made | {"repair": made["run"]}


def campaign(
    kills: int, seed: int, *, kinds: tuple[Kind, ...] = KINDS, a_study: int = 4, show: bool = False
) -> dict[str, Count]:
    """Kill so often, each study some times at the most, and judge every study."""
    prepare()
    dice, counts = random.Random(seed), {kind.name: Count() for kind in kinds}
    directory = Path(tempfile.mkdtemp(prefix="chaos-"))
    whole = sum(kind.share for kind in kinds)
    try:
        expected = undisturbed_stores(directory / "undisturbed")
        if not has_disks(directory):
            kinds = tuple(kind for kind in kinds if kind.by != POWER)
            print("this machine allows no power cuts", file=sys.stderr)
        for kind in track(kinds, "killing", disable=not show):
            count, wanted = counts[kind.name], -(-kills * kind.share // whole)
            while (so_far := sum(count.kills.values())) < wanted:
                place = directory / f"{kind.name}-{count.studies}".replace(" ", "_")
                most = min(a_study, wanted - so_far)
                arena, one = torment(kind, dice, most, place, expected["run"])
                judge(arena, kind, one, expected[kind.command])
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
    moments = (*WRITES, *COMMITS, ANYWHERE, REPLACING)
    headings = ["killed", *moments, "kills", "studies", "lost", "twice", "not identical"]
    table = Table(*headings, box=None)
    for name, count in counts.items():
        numbers = [count.kills[moment] for moment in moments]
        ends = [sum(numbers), count.studies, count.lost, count.twice, count.different]
        table.add_row(name, *[str(n) if n else "-" for n in numbers], *map(str, ends))
    return table


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=210)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="Parts of the names of kinds of kills, a|b.")
    arguments = parser.parse_args()
    begun = time.monotonic()
    parts = arguments.only.split("|")
    kinds = tuple(kind for kind in KINDS if any(part in kind.name for part in parts))
    counts = campaign(arguments.kills, arguments.seed, kinds=kinds, show=True)
    Console(width=200).print(told(counts))
    kills = sum(sum(count.kills.values()) for count in counts.values())
    wrong = sum(c.lost + c.twice + c.different + c.hanging for c in counts.values())
    print(f"{kills} kills, seed {arguments.seed}, {time.monotonic() - begun:.0f} s: ", end="")
    print("nothing lost, nothing twice, every store identical" if not wrong else "NOT ALL IS WELL")
    sys.exit(bool(wrong) or kills < arguments.kills)


if __name__ == "__main__":
    main()
