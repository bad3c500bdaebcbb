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
from small_studies import copy_store, file_digests, receipt_blocks, small_spec

from sweep.storage import locations
from sweep.tasks.driver import extend, resume, run
from sweep.tasks.engine import dispatcher, journal, study_store
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.studies.store_verification import pack_store, verify

N_BLOCKS = 12
LEG_TIMEOUT = 120.0
"""Seconds that a leg of a study may take; beyond, it hangs."""

BEFORE_WRITE, BETWEEN_CHUNKS, IN_A_FILE, AFTER_WRITE = (
    "before a write", "between chunks", "in a file", "after a write",
)  # fmt: skip
BEFORE_COMMIT, IN_COMMIT, AFTER_COMMIT = "before a commit", "in a commit", "after a commit"
WRITE_MOMENTS = (BEFORE_WRITE, BETWEEN_CHUNKS, IN_A_FILE, AFTER_WRITE)
COMMIT_MOMENTS = (BEFORE_COMMIT, IN_COMMIT, AFTER_COMMIT)
AT_ANY_CHANGE, WHILE_REPLACING = "at any change", "as it is replaced"
CHANGE_MOMENTS = (AT_ANY_CHANGE, WHILE_REPLACING, WHILE_REPLACING)
"""Of a command's changes to the disk, by number; the first ones from a renaming of the store on."""

BY_SIGKILL, BY_POWER_CUT = ("SIGKILL",), ("power",)
BY_ANY_SIGNAL = ("SIGKILL", "SIGTERM", "SIGHUP")
DURABLE_OPTIONS = {"durable": True}

DISK_CHANGES_BY_COMMAND = {"extend": 2600, "overwrite": 2600, "repair": 85, "finalize": 400}
"""Changes of a command to the disk, about."""

EXTENSION_CHANGES = {"axes.instrument.laser.power": ["1 W", "3 W", "4 W"]}
"""What the study is extended by."""


@dataclass(frozen=True)
class Kill:
    """A victim and its moment: a block, or a change by its number."""

    victim: str
    moment: str
    block: int
    cause: str = "SIGKILL"


@dataclass(frozen=True)
class KillScenario:
    """A way to be killed."""

    name: str
    victim: str
    moments: tuple[str, ...]
    cluster: str  # "" plain loop, "own" of the client, "other" processes
    weight: int  # of the kills
    kills_per_leg: int = 1  # kills that one leg of a study can take
    causes: tuple[str, ...] = BY_SIGKILL
    command: str = "run"


KILL_SCENARIOS = (
    KillScenario("client, plain loop", "here", WRITE_MOMENTS + COMMIT_MOMENTS, "", 41),
    KillScenario("client with its cluster", "client", COMMIT_MOMENTS, "own", 12),
    KillScenario("client, its cluster lives on", "client", COMMIT_MOMENTS, "lasting", 10),
    KillScenario("worker", "here", WRITE_MOMENTS, "own", 20, kills_per_leg=4),
    KillScenario(
        "worker, frozen", "here", WRITE_MOMENTS, "other", 6, kills_per_leg=2, causes=("SIGSTOP",)
    ),
    KillScenario("nanny", "nanny", WRITE_MOMENTS, "other", 9, kills_per_leg=2),
    KillScenario("scheduler", "scheduler", WRITE_MOMENTS, "other", 8),
    KillScenario(
        "client, by SIGTERM or SIGHUP",
        "here",
        WRITE_MOMENTS + COMMIT_MOMENTS,
        "",
        10,
        causes=BY_ANY_SIGNAL[1:],
    ),
    KillScenario("extend", "here", CHANGE_MOMENTS, "", 25, causes=BY_ANY_SIGNAL, command="extend"),
    KillScenario(
        "run --overwrite", "here", CHANGE_MOMENTS, "", 25, causes=BY_ANY_SIGNAL, command="overwrite"
    ),
    KillScenario(
        "verify --repair", "here", (AT_ANY_CHANGE,), "", 25, causes=BY_ANY_SIGNAL, command="repair"
    ),
    KillScenario(
        "finalize", "here", CHANGE_MOMENTS, "", 15, causes=BY_ANY_SIGNAL, command="finalize"
    ),
    KillScenario(
        "power, run --durable", "here", WRITE_MOMENTS + COMMIT_MOMENTS, "", 15, causes=BY_POWER_CUT
    ),
    KillScenario(
        "power, extend --durable",
        "here",
        CHANGE_MOMENTS,
        "",
        15,
        causes=BY_POWER_CUT,
        command="extend",
    ),
    KillScenario(
        "power, verify --repair",
        "here",
        (AT_ANY_CHANGE,),
        "",
        10,
        causes=BY_POWER_CUT,
        command="repair",
    ),
    KillScenario(
        "power, finalize", "here", CHANGE_MOMENTS, "", 10, causes=BY_POWER_CUT, command="finalize"
    ),
)


class LoopDisk:
    """A disk of its own in a file in a directory, whose power can be cut."""

    def __init__(self, directory: Path) -> None:
        self._image_file, self.mount_point = directory / "disk.img", directory / "disk"
        self.mount_point.mkdir(parents=True)
        with open(self._image_file, "wb") as image:
            image.truncate(48 << 20)
        _run_command("mkfs.ext4", "-q", str(self._image_file))
        self.mount()

    def mount(self) -> None:
        """Mount it: what its journal holds is put in its place."""
        _run_command("mount", "-o", "loop", str(self._image_file), str(self.mount_point))

    def cut_power(self) -> None:
        """Cut its power: nothing that is not on it will be, and no process can use it."""
        shutdown_ioctl, no_log_flush = 0x8004587D, struct.pack("I", 2)  # EXT4_IOC_SHUTDOWN
        descriptor = os.open(self.mount_point, os.O_RDONLY)
        fcntl.ioctl(descriptor, shutdown_ioctl, no_log_flush)
        os.close(descriptor)

    def unmount(self) -> None:
        """Unmount it."""
        _run_command("umount", str(self.mount_point))


def _run_command(*words: str) -> None:
    subprocess.run(words, check=True, capture_output=True)


def can_cut_power(directory: Path) -> bool:
    """True where this machine allows disks of one's own whose power can be cut."""
    try:
        disk = LoopDisk(directory / "trial")
        disk.cut_power()
        disk.unmount()
    except (OSError, subprocess.CalledProcessError):
        return False
    return True


class ChaosStudy:
    """One study, its store, on a disk of its own if there is one, and notes of what was done."""

    def __init__(self, directory: Path, disk: LoopDisk | None = None) -> None:
        self.directory, self.disk = directory, disk
        self.store = (disk.mount_point if disk else directory) / "stores" / "small.zarr"
        self.store.parent.mkdir(parents=True)
        self.output = self.store.with_name("small_final.zarr")
        self.log_file = directory / "log"
        self.log_file.touch()
        self.kills: list[Kill] = []
        self.pids: dict[str, int] = {}

    def append_log(self, line: str) -> None:
        """Add a line to the log; whole lines, whoever writes."""
        with open(self.log_file, "ab", buffering=0) as log:
            log.write(f"{line}\n".encode())

    def kill_if_planned(self, moment: str, block: int) -> None:
        """Kill whom the plan says, once."""
        for kill in self.kills:
            if (kill.moment, kill.block) != (moment, block):
                continue
            try:
                os.close(os.open(self.kill_marker(kill), os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                continue
            if kill.cause == "power":
                self.disk.cut_power()
            signal_number = signal.SIGKILL if kill.cause == "power" else signal.Signals[kill.cause]
            os.kill(self._pid(kill.victim), signal_number)

    def kill_marker(self, kill: Kill) -> Path:
        """File that stands for a kill that happened."""
        return self.directory / f"{kill.victim}-{kill.moment}-{kill.block}".replace(" ", "_")

    def kills_done(self) -> list[Kill]:
        """Kills that happened in this leg."""
        return [kill for kill in self.kills if self.kill_marker(kill).exists()]

    def _pid(self, victim: str) -> int:
        if victim == "nanny":
            return os.getppid()
        return os.getpid() if victim == "here" else self.pids[victim]


def evaluate_and_log(study, block):
    """The model, with a note of what is computed."""
    CURRENT_STUDY[0].append_log(f"{block} evaluated")
    return study.evaluate(block)


_libc = ctypes.CDLL(None)
PR_SET_PDEATHSIG = 1

CURRENT_STUDY: list[ChaosStudy] = []
"""The one of this process; those that are forked from it inherit it."""


def trap_disk_changes(arena: ChaosStudy) -> None:
    """Have every change to a disk pass by the arena first."""
    change_count_by_moment = {
        AT_ANY_CHANGE: 0,
        WHILE_REPLACING: -1,
    }  # of the change; from a renaming of the store on
    stores = {arena.store, arena.output}

    def trapped_change(change, *arguments, **options):
        first_argument = arguments[0]
        changed_path = Path(
            os.readlink(f"/proc/self/fd/{first_argument}")
            if isinstance(first_argument, int)
            else first_argument
        )
        if changed_path.is_absolute() and arena.store.parent not in changed_path.parents:
            return change(*arguments, **options)
        if change is rename and stores & {changed_path, Path(arguments[1])}:
            change_count_by_moment[WHILE_REPLACING] = max(
                change_count_by_moment[WHILE_REPLACING], 0
            )
        for moment in change_count_by_moment:
            if change_count_by_moment[moment] >= 0:
                arena.kill_if_planned(moment, change_count_by_moment[moment])
                change_count_by_moment[moment] += 1
        return change(*arguments, **options)

    rename = os.rename
    for name in ("write", "fsync", "rename", "replace", "link", "unlink", "rmdir", "mkdir"):
        setattr(os, name, partial(trapped_change, getattr(os, name)))


def trap_writes_and_commits(arena: ChaosStudy) -> None:
    """Have all that is written and committed from here on pass by the arena, here and in forks."""
    CURRENT_STUDY[:] = [arena]
    if any(kill.moment in CHANGE_MOMENTS for kill in arena.kills):
        trap_disk_changes(arena)
    write_block, commit_blocks, put_file, os_write = (
        study_store.BlockWriter.write,
        journal.Journal.commit,
        locations.atomic_write_file,
        os.write,
    )
    block_and_files_written: list[int] = []  # the block, and how many of its files are written

    def trapped_write(self, block, results):
        arena.kill_if_planned(BEFORE_WRITE, block)
        block_and_files_written[:] = [block, 0]
        digest = write_block(self, block, results)
        arena.kill_if_planned(AFTER_WRITE, block)
        return digest

    def trapped_put(file, content, **options):
        path = Path(file)
        if block_and_files_written and "c" in path.parts:
            block_and_files_written[1] += 1
            if block_and_files_written[1] == 5:
                arena.kill_if_planned(BETWEEN_CHUNKS, block_and_files_written[0])
            if block_and_files_written[1] == 9 and any(k.moment == IN_A_FILE for k in arena.kills):
                half_file = path.with_suffix(f".{os.getpid()}.partial")
                half_file.parent.mkdir(parents=True, exist_ok=True)
                half_file.write_bytes(content[: len(content) // 2])
                arena.kill_if_planned(IN_A_FILE, block_and_files_written[0])
                half_file.unlink()
        return put_file(file, content, **options)

    def trapped_commit(self, *commit_receipts):
        blocks = [receipt.block for receipt in commit_receipts]
        kill_at_blocks(BEFORE_COMMIT, blocks)
        os.write = partial(write_half_and_trap, blocks)
        try:
            commit_blocks(self, *commit_receipts)
        finally:
            os.write = os_write
        for block in blocks:
            arena.append_log(f"{block} committed")
        kill_at_blocks(AFTER_COMMIT, blocks)

    def write_half_and_trap(blocks, log, lines):
        bytes_written = os_write(log, lines[: len(lines) // 2])
        kill_at_blocks(IN_COMMIT, blocks)
        return bytes_written + os_write(log, lines[bytes_written:])

    def kill_at_blocks(moment, blocks):
        for block in blocks:
            arena.kill_if_planned(moment, block)

    study_store.BlockWriter.write, journal.Journal.commit = trapped_write, trapped_commit
    locations.atomic_write_file = trapped_put


def fork_process(function: Callable[[], object]) -> int:
    """Do something in a process of its own, in a group of its own; its pid."""
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return pid
    exit_code = 1
    try:
        os.setsid()
        _libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        null_device = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null_device, 1)
        if not os.environ.get("CHAOS_LOUD"):
            os.dup2(null_device, 2)
        function()
        exit_code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(exit_code)


def wait_for_exit(pid: int) -> bool:
    """Wait for a process: whether it ended in time."""
    deadline = time.monotonic() + LEG_TIMEOUT
    while time.monotonic() < deadline:
        if os.waitpid(pid, os.WNOHANG)[0]:
            return True
        time.sleep(0.01)
    return False


def kill_process_group(pid: int) -> None:
    """End a process and all of its group."""
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)
    with suppress(ChildProcessError):
        os.waitpid(pid, 0)


def run_scheduler(file: Path) -> None:
    """A scheduler, as long as this process lives."""

    async def forever() -> None:
        async with Scheduler(host="127.0.0.1", dashboard=False) as scheduler:
            file.with_suffix(".draft").write_text(scheduler.address)
            file.with_suffix(".draft").rename(file)
            await scheduler.finished()

    asyncio.run(forever())


def run_nanny(arena: ChaosStudy, address: str) -> None:
    """A nanny and its worker, in the arena, as long as this process lives."""
    trap_writes_and_commits(arena)

    async def forever() -> None:
        async with Nanny(address, nthreads=1, memory_limit=0, dashboard=False) as nanny:
            await nanny.finished()

    asyncio.run(forever())


@contextmanager
def run_cluster(arena: ChaosStudy, workers: int) -> Iterator[str]:
    """A scheduler and nannies, each a process of its own; the scheduler's address."""
    file = arena.directory / f"scheduler-{random.random()}"
    pids = [fork_process(lambda: run_scheduler(file))]
    try:
        arena.pids["scheduler"] = pids[0]
        deadline = time.monotonic() + LEG_TIMEOUT
        while not file.exists():
            assert time.monotonic() < deadline, "no scheduler"
            time.sleep(0.01)
        address = file.read_text()
        pids += [fork_process(lambda: run_nanny(arena, address)) for _ in range(workers)]
        yield address
    finally:
        for pid in pids:
            kill_process_group(pid)


@dataclass
class KillOutcomes:
    """What came of the kills of one kind."""

    kills: Counter[str] = field(default_factory=Counter)  # by moment
    studies: int = 0
    lost: int = 0  # blocks that were committed and had to be computed again, or never came
    twice: int = 0  # blocks with more than one receipt
    different: int = 0  # stores that are not the undisturbed one, byte by byte
    hanging: int = 0


def make_leg(
    arena: ChaosStudy, scheduler: str | None, command: str = "run"
) -> Callable[[], object]:
    """A command on the study, in a process that may be killed."""

    def run_command() -> None:
        arena.pids["client"] = os.getpid()
        tempfile.tempdir = str(arena.directory)
        trap_writes_and_commits(arena)
        cluster_options = {"scheduler": scheduler} if scheduler else {"workers": 2}
        options = {
            "evaluate": evaluate_and_log,
            "progress": False,
            "durable": bool(arena.disk),
            **cluster_options,
        }
        path = arena.store
        if command == "extend":
            extend(path, changes=EXTENSION_CHANGES, **options)
        elif command == "overwrite":
            run(replacing_study(), store=path, overwrite=True, **options)
        elif command == "repair":
            verify(path, repair=True, progress=False)
        elif command == "finalize" and not arena.output.exists():
            pack_store(path, arena.output, progress=False)
        elif command == "run" and path.exists():
            resume(path, **options)
        elif command == "run":
            run(small_spec(), store=path, **options)

    return run_command


def replacing_study():
    """The study that takes the place of the small one by --overwrite."""
    return small_spec(footprint={"beamlets": 7, "speckle": "none"})


def set_up_store(
    arena: ChaosStudy, command: str, reference_store: Path, rng: random.Random
) -> None:
    """Put what a command needs in its place: a complete store, for repair a damaged one."""
    if command == "run":
        return
    copy_store(reference_store, arena.store.parent).rename(arena.store)
    if command == "repair":
        manifest = ".sweep/template.jsonl"
        names = rng.sample(["pd_up/zarr.json", "range/c/0", "grazing_angle/zarr.json", manifest], 3)
        for name in ("zarr.json", *names):
            content = bytearray((arena.store / name).read_bytes())
            content[len(content) * 2 // 3] ^= 4
            (arena.store / name).write_bytes(content)
    if arena.disk:
        study_store.sync_file_system(arena.store)


def plan_kills(
    arena: ChaosStudy, scenario: KillScenario, rng: random.Random, kills_max: int
) -> list[Kill]:
    """Kills of the next leg, at blocks that are still to be done."""
    moment = rng.choice(scenario.moments)
    if moment in CHANGE_MOMENTS:
        change_number = rng.randrange(
            DISK_CHANGES_BY_COMMAND[scenario.command] if moment == AT_ANY_CHANGE else 12
        )
        return (
            [Kill(scenario.victim, moment, change_number, rng.choice(scenario.causes))]
            if kills_max
            else []
        )
    blocks_left = [block for block in range(N_BLOCKS) if block not in receipt_blocks(arena.store)]
    next_blocks = blocks_left[: max(4, scenario.kills_per_leg * 2)]
    blocks = rng.sample(next_blocks, min(scenario.kills_per_leg, kills_max, len(next_blocks)))
    return [
        Kill(scenario.victim, rng.choice(scenario.moments), block, rng.choice(scenario.causes))
        for block in blocks
    ]


def kill_and_resume(
    scenario: KillScenario,
    rng: random.Random,
    kills_max: int,
    directory: Path,
    reference_store: Path,
) -> tuple[ChaosStudy, KillOutcomes]:
    """One study, killed and resumed until it is done or was killed as often as it may be."""
    disk = LoopDisk(directory) if scenario.causes == BY_POWER_CUT else None
    study, outcomes = ChaosStudy(directory, disk), KillOutcomes(studies=1)
    set_up_store(study, scenario.command, reference_store, rng)
    with (
        run_cluster(study, 2)
        if scenario.cluster == "lasting"
        else nullcontext() as lasting_scheduler
    ):
        for _ in range(2 * kills_max):
            study.kills = plan_kills(study, scenario, rng, kills_max - sum(outcomes.kills.values()))
            if not study.kills:
                break
            _run_leg(study, scenario, outcomes, lasting_scheduler)
            outcomes.kills.update(kill.moment for kill in study.kills_done())
            if scenario.command in ("extend", "overwrite"):  # there is the old one, or the new one
                (report,) = verify(study.store, progress=False)
                outcomes.lost += not (report.is_undamaged and report.complete)
    study.kills = []
    _run_leg(study, replace(scenario, cluster=""), outcomes, None)
    if scenario.command == "repair":
        _run_leg(study, KILL_SCENARIOS[0], outcomes, None)
    return study, outcomes


def _run_leg(
    arena: ChaosStudy, scenario: KillScenario, outcomes: KillOutcomes, lasting_scheduler: str | None
) -> None:
    for kill in arena.kills:
        arena.kill_marker(kill).unlink(missing_ok=True)
    with run_cluster(arena, 3) if scenario.cluster == "other" else nullcontext() as other_scheduler:
        scheduler = {
            "": "none",
            "own": None,
            "lasting": lasting_scheduler,
            "other": other_scheduler,
        }[scenario.cluster]
        pid = fork_process(make_leg(arena, scheduler, scenario.command))
        outcomes.hanging += not wait_for_exit(pid)
        kill_process_group(pid)
    if arena.disk:
        arena.disk.unmount()
        arena.disk.mount()


def check_store(
    arena: ChaosStudy, scenario: KillScenario, outcomes: KillOutcomes, reference_store: Path
) -> None:
    """Hold a study that was tormented against the undisturbed one."""
    committed: set[str] = set()
    resulting_store = arena.output if scenario.command == "finalize" else arena.store
    recomputes_all = scenario.command == "overwrite"
    may_compute_twice = (
        "SIGSTOP" in scenario.causes
    )  # two are at the same block, and one commits it
    for line in arena.log_file.read_text().splitlines():
        block, event = line.split()
        if event == "committed":
            committed.add(block)
        else:
            outcomes.lost += block in committed and not (recomputes_all or may_compute_twice)
    receipts_by_block = Counter(receipt_blocks(resulting_store))
    outcomes.lost += len(receipt_blocks(reference_store)) - len(receipts_by_block)
    outcomes.twice += sum(n_receipts > 1 for n_receipts in receipts_by_block.values())
    reports = [
        report for path in {arena.store, resulting_store} for report in verify(path, progress=False)
    ]
    has_no_leftovers = set(arena.store.parent.iterdir()) == {arena.store, resulting_store}
    is_intact = all(report.is_undamaged and report.complete for report in reports)
    outcomes.different += not (
        file_digests(resulting_store) == file_digests(reference_store)
        and has_no_leftovers
        and is_intact
    )
    if arena.disk:
        arena.disk.unmount()


def prepare_parent_process() -> None:
    """Load all that the study computes with, so that no fork has to."""
    study = GridStudy(small_spec())
    study.compile_kernels()
    study.evaluate(0)
    dispatcher.WORKER_SILENCE_SECONDS = 3.0
    dask.config.set({
        "distributed.worker.multiprocessing-method": "fork",
        "distributed.comm.timeouts.connect": "5s",
        "distributed.admin.tick.limit": "60s",
    })  # fmt: skip


def make_reference_stores(directory: Path) -> dict[str, Path]:
    """Stores that commands make undisturbed."""

    def make_stores() -> None:
        run(small_spec(), store=stores["run"], scheduler="none", progress=False)
        extend(
            stores["run"],
            changes=EXTENSION_CHANGES,
            to=stores["extend"],
            scheduler="none",
            progress=False,
        )
        run(replacing_study(), store=stores["overwrite"], scheduler="none", progress=False)
        pack_store(stores["run"], stores["finalize"], progress=False)

    stores = {
        name: directory / f"{name}.zarr" for name in ("run", "extend", "overwrite", "finalize")
    }
    assert wait_for_exit(fork_process(make_stores))
    return stores | {"repair": stores["run"]}


def run_campaign(
    kills: int,
    seed: int,
    *,
    scenarios: tuple[KillScenario, ...] = KILL_SCENARIOS,
    kills_per_study: int = 4,
    shows_progress: bool = False,
) -> dict[str, KillOutcomes]:
    """Kill so often, each study some times at the most, and judge every study."""
    prepare_parent_process()
    rng, outcomes_by_scenario = (
        random.Random(seed),
        {scenario.name: KillOutcomes() for scenario in scenarios},
    )
    directory = Path(tempfile.mkdtemp(prefix="chaos-"))
    total_weight = sum(scenario.weight for scenario in scenarios)
    try:
        expected = make_reference_stores(directory / "undisturbed")
        if not can_cut_power(directory):
            scenarios = tuple(scenario for scenario in scenarios if scenario.causes != BY_POWER_CUT)
            print("this machine allows no power cuts", file=sys.stderr)
        for scenario in track(scenarios, "killing", disable=not shows_progress):
            outcomes, kills_wanted = (
                outcomes_by_scenario[scenario.name],
                -(-kills * scenario.weight // total_weight),
            )
            while (kills_so_far := sum(outcomes.kills.values())) < kills_wanted:
                study_directory = directory / f"{scenario.name}-{outcomes.studies}".replace(
                    " ", "_"
                )
                kills_max = min(kills_per_study, kills_wanted - kills_so_far)
                study, study_outcomes = kill_and_resume(
                    scenario, rng, kills_max, study_directory, expected["run"]
                )
                check_store(study, scenario, study_outcomes, expected[scenario.command])
                _add_outcomes(outcomes, study_outcomes)
                if not (
                    study_outcomes.lost
                    or study_outcomes.twice
                    or study_outcomes.different
                    or study_outcomes.hanging
                ):
                    shutil.rmtree(study_directory)
                if study_outcomes.hanging or outcomes.studies > 3 * kills_wanted:
                    break
    finally:
        if not any(
            result.lost or result.twice or result.different or result.hanging
            for result in outcomes_by_scenario.values()
        ):
            shutil.rmtree(directory)
        elif shows_progress:
            print(f"what went wrong is in {directory}", file=sys.stderr)
    return outcomes_by_scenario


def _add_outcomes(total: KillOutcomes, added: KillOutcomes) -> None:
    total.kills += added.kills
    for name in ("studies", "lost", "twice", "different", "hanging"):
        setattr(total, name, getattr(total, name) + getattr(added, name))


def outcomes_table(outcomes_by_scenario: dict[str, KillOutcomes]) -> Table:
    """The table of a campaign."""
    moments = (*WRITE_MOMENTS, *COMMIT_MOMENTS, AT_ANY_CHANGE, WHILE_REPLACING)
    headings = ["killed", *moments, "kills", "studies", "lost", "twice", "not identical"]
    table = Table(*headings, box=None)
    for name, outcomes in outcomes_by_scenario.items():
        kills_by_moment = [outcomes.kills[moment] for moment in moments]
        totals = [
            sum(kills_by_moment),
            outcomes.studies,
            outcomes.lost,
            outcomes.twice,
            outcomes.different,
        ]
        table.add_row(
            name, *[str(number) if number else "-" for number in kills_by_moment], *map(str, totals)
        )
    return table


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=210)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="Parts of the names of kinds of kills, a|b.")
    arguments = parser.parse_args()
    start_time = time.monotonic()
    name_parts = arguments.only.split("|")
    scenarios = tuple(
        scenario
        for scenario in KILL_SCENARIOS
        if any(name_part in scenario.name for name_part in name_parts)
    )
    outcomes_by_scenario = run_campaign(
        arguments.kills, arguments.seed, scenarios=scenarios, shows_progress=True
    )
    Console(width=200).print(outcomes_table(outcomes_by_scenario))
    kills = sum(sum(count.kills.values()) for count in outcomes_by_scenario.values())
    n_faults = sum(
        result.lost + result.twice + result.different + result.hanging
        for result in outcomes_by_scenario.values()
    )
    print(f"{kills} kills, seed {arguments.seed}, {time.monotonic() - start_time:.0f} s: ", end="")
    print(
        "nothing lost, nothing twice, every store identical" if not n_faults else "NOT ALL IS WELL"
    )
    sys.exit(bool(n_faults) or kills < arguments.kills)


if __name__ == "__main__":
    main()
