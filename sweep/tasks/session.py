"""One run over what a store lacks: where to compute, answers committed, an outcome at its end."""

from __future__ import annotations

import gc
import logging
import math
import os
import re
import socket
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, fields
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.messages import option
from sweep.spec import Spec
from sweep.spec.clusters import (
    DASHBOARD_PORT,
    NO_DASHBOARD,
    Address,
    AnyCluster,
    Bounds,
    Cluster,
    Kubernetes,
    Local,
    LocalWorker,
    cluster_of,
    load_cluster,
)
from sweep.spec.rules import near_miss
from sweep.spec.sections import Execution
from sweep.storage.locations import Location, ObjectStoreError, reason, write_remedy
from sweep.storage.opening import read_receipts
from sweep.tasks import journal, store
from sweep.tasks.interrupts import Interrupts
from sweep.tasks.journal import Failure, Journal, Lock, Look, Receipt, given_up
from sweep.tasks.memory import (
    refuse_too_large,
    refuse_too_large_study,
    this_machine,
    worker_memory,
)
from sweep.tasks.progress import (
    ClusterError,
    Progress,
    SchedulerLost,
    StoreError,
    TaskError,
    chosen,
    duration,
    working,
)
from sweep.tasks.study import Evaluate, Study, own_functions, seconds_a_point
from sweep.tasks.worker import TICK, Answer, BlockQueue, Job, Seen, plain

if TYPE_CHECKING:
    from distributed import Client

    from sweep.spec import SceneSpec
    from sweep.tasks.cluster import Reached
    from sweep.tasks.flight_study import FlightStudy
    from sweep.tasks.grid_study import GridStudy

#: Scheduler "address" of the plain loop.
NONE = "none"

#: Work that is done here and at once, where nobody says otherwise [s of one core]: workers take
#: some seconds to start.
LITTLE = 10.0

#: Seconds of a core that a ray, and a draw of a shot, take at the most, about.
RAY, SHOT = 5e-6, 4e-4

#: Blocks that may fail before any succeeds: beyond, the fault is not in the blocks.
HOPELESS = 20

#: Seconds for which a run waits to see that what is committed is there; of more files it begins
#: with what the log says, and looks on meanwhile.
LOOKING = 2.0

#: Seconds without any worker after which that is said.
ABSENT = 20.0

#: Figures of receipts that a run adds up.
COUNTED = ("points", "taken", "bytes", "seconds", "write_seconds")

_log = logging.getLogger("sweep.session")

NOT_FOUND = (
    "block {} is computed in pieces, and what one worker saved was not found by the next: "
    "do all of them see the same store?"
)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Ways to compute a study; nothing of them shows in the results.

    Parameters
    ----------
    client
        Dask client to compute with; without one, `scheduler` and `workers` say what to use. By
        default little work is done here, in a plain loop, and more of it by workers on all cores of
        this machine.
    workers, processes
        Workers to start on this machine, as processes or as threads.
    scheduler
        Address of a Dask scheduler, or "none" for a plain loop in this process.
    cluster
        The file that describes a cluster, or what such a file holds; `workers` fixes how many.
    progress
        True for a bar or lines on standard error, False for none, or a `Progress`.
    block_timeout
        Seconds that a block may take; beyond, it is tried once more and then given up.
    durable
        Whether blocks are on the disk, and not only with the operating system, once committed: a
        power failure then loses none of them.
    retry_failed
        Whether to try blocks again that were given up, for their errors, in an earlier run.
    performance_report
        HTML file to put Dask's own account of the run into.
    dashboard
        Whether the workers that are started have Dask's dashboard, on a port of this machine alone.
        It has no password: all users of this machine can see it.
    allow_code
        Python modules whose detectors and estimators the study may run, here and on its workers.
    evaluate
        What computes a block in place of the model, with the same results; for instrumenting.
    """

    client: Client | None = None
    workers: int | None = None
    processes: bool = True
    scheduler: str | None = None
    cluster: str | Path | Mapping[str, Any] | AnyCluster | None = None
    progress: bool | Progress = True
    block_timeout: float | None = None
    durable: bool = False
    retry_failed: bool = False
    performance_report: str | Path | None = None
    dashboard: bool = False
    allow_code: Sequence[str] = ()
    evaluate: Evaluate | None = None

    def __post_init__(self) -> None:
        whole = isinstance(self.workers, Integral) and not isinstance(self.workers, bool)
        if self.workers is not None and not (whole and self.workers > 0):
            raise ClusterError(f"workers must be a whole number above 0, not {self.workers!r}")
        if self.scheduler not in (None, NONE) and not _is_address(self.scheduler):
            raise ClusterError(
                f"{self.scheduler!r} is no address of a Dask scheduler: write e.g. "
                f"'tcp://10.0.0.5:8786', or '{NONE}' for a plain loop here"
            )
        timeout = self.block_timeout
        if timeout is not None and not (isinstance(timeout, int | float) and timeout > 0):
            raise TaskError(f"block_timeout must be a number of seconds above 0, not {timeout!r}")
        if self.allow_code:
            from sweep.tasks.user_code import allow

            allow([self.allow_code] if isinstance(self.allow_code, str) else self.allow_code)

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> RunOptions:
        """Options by name; a TypeError with the nearest name for one that there isn't."""
        names = [field.name for field in fields(cls)]
        for name in options.keys() - set(names):
            raise TypeError(f"there is no option {name!r}; {near_miss(name, names)}".rstrip("; "))
        return cls(**options)

    def place(self, spec: Spec | SceneSpec) -> AnyCluster | None:
        """Return the cluster given here or by the spec's `execution`; None for a plain loop.

        ClusterError where both a scheduler and a cluster are named, or workers that are not
        ours to start.
        """
        if self.cluster is not None:
            if self.scheduler is not None:
                raise ClusterError("a scheduler and a cluster are both named: leave out one")
            given = self.cluster
            if not isinstance(given, Cluster):
                given = cluster_of(given) if isinstance(given, Mapping) else load_cluster(given)
            return self._with_dashboard(_of_workers(given, self.workers))
        scheduler, execution = self.scheduler, spec.execution
        if scheduler is None and self.workers is None:
            scheduler = execution.scheduler or None
        if scheduler == NONE and self.dashboard:
            raise ClusterError(f"a plain loop has no dashboard: leave out {option('dashboard')}")
        if scheduler == NONE or (scheduler is None and self._leaves_it_open(spec)):
            return None
        if scheduler is not None:
            if self.dashboard:
                raise ClusterError(
                    f"the scheduler {scheduler} runs already: leave out {option('dashboard')}"
                )
            return Address.model_construct(kind="scheduler", address=scheduler, security=None)
        here = Local(kind="local", worker=LocalWorker(threads=execution.threads))
        return self._with_dashboard(_of_workers(here, self.workers or execution.workers or None))

    def _with_dashboard(self, cluster: AnyCluster) -> AnyCluster:
        """Give a cluster that is started here a dashboard, if one is asked for."""
        if not self.dashboard:
            return cluster
        if isinstance(cluster, Address | Kubernetes):
            raise ClusterError(
                f"the scheduler is not started on this machine: leave out {option('dashboard')}"
            )
        if cluster.scheduler.dashboard != NO_DASHBOARD:
            return cluster
        scheduler = cluster.scheduler.model_copy(update={"dashboard": str(DASHBOARD_PORT)})
        return cluster.model_copy(update={"scheduler": scheduler})

    def _leaves_it_open(self, spec: Spec | SceneSpec) -> bool:
        """Tell whether nothing is said that takes workers, and the work takes none."""
        said = self.workers or self.block_timeout or self.performance_report or self.evaluate
        if said or self.dashboard or not self.processes or spec.execution != Execution():
            return False
        return not any(own_functions(spec)) and about_seconds(spec) <= LITTLE


def _is_address(text: object) -> bool:
    """Tell whether a text is an address of a Dask scheduler, with or without a protocol."""
    return isinstance(text, str) and bool(
        re.fullmatch(r"(\w+://)?[^\s/:]\S*:\d+|inproc://.+", text)
    )


def _of_workers(cluster: AnyCluster, workers: int | None) -> AnyCluster:
    """Fix the number of workers of a cluster, if one is given and they are ours."""
    if workers is None:
        return cluster
    if isinstance(cluster, Address):
        raise ClusterError(
            f"the workers of {cluster.address} are there already: leave out their number"
        )
    return cluster.model_copy(update={"workers": Bounds(workers, workers)})


def about_seconds(spec: Spec | SceneSpec) -> float:
    """Time of one core that a study takes, about [s]; infinite if rays follow a tolerance."""
    places = math.prod(int(axis.size) for axis in spec.axes)
    if isinstance(spec, Spec):
        return places * seconds_a_point(spec)
    if spec.rays_by_tolerance:
        return math.inf
    shots = sum(spec.cycles(name) * spec.shots_a_cycle(name) for name in spec.scanners)
    rays = float(spec.parameters()["footprint.beamlets"])
    return shots * (rays * RAY + places * int(spec.draws.number) * SHOT)


class Pool(ExitStack):
    """A place in use: its workers serve one study after another, and end with it."""

    def __init__(self, options: RunOptions, spec: Spec | SceneSpec) -> None:
        super().__init__()
        self.options, self.told = options, chosen(options.progress)
        self.interrupts = Interrupts(self.told)
        self._cluster, self._spec = options.place(spec), spec
        self.memory = (
            this_machine() if self.is_plain else worker_memory(options.client, self._cluster)
        )
        refuse_too_large(spec, self.memory)
        self.study: GridStudy | FlightStudy | None = None  # once it is known
        self.most = 1  # blocks of the study: more workers than that have nothing to do
        self._reached: Reached | None = None

    @property
    def is_plain(self) -> bool:
        """Tell whether blocks are computed in a plain loop, without workers."""
        return self.options.client is None and self._cluster is None

    @property
    def is_reached_by_address(self) -> bool:
        """Tell whether the workers are those of a scheduler that runs already."""
        return self.options.client is None and isinstance(self._cluster, Address)

    def connect(self) -> Reached:
        """Reach the workers, no more than `most`; ClusterError where there are none to be had."""
        from sweep.tasks.cluster import Reached, connected, reported

        if self._reached is None:
            client = self.options.client
            if client is None:
                assert self._cluster is not None
                self._reached = self.enter_context(
                    connected(
                        self._cluster,
                        most=self.most,
                        processes=self.options.processes,
                        say=self.told.say,
                    )
                )
                if self.is_reached_by_address and self.study is not None:
                    # Its workers are known from here on.
                    refuse_too_large_study(self.study, worker_memory(self._reached.client, None))
            elif client.asynchronous:
                raise ClusterError("the client is asynchronous: give one of another kind, Client()")
            else:
                self._reached = Reached(client, 0)
            if file := self.options.performance_report:
                report = reported(self._reached.client, Path(file), self.told.say)
                self.enter_context(report)
        return self._reached

    def answers(self, path: str, study_id: str, queue: BlockQueue, seen: Seen) -> Iterator[Answer]:
        """Answers of a study's blocks as they arrive; `seen` tells what is in the store here."""
        options = self.options
        job = Job(
            path, study_id, options.evaluate, options.block_timeout, options.durable, self._code()
        )
        if self.is_plain:
            _log.info("blocks are computed in this process, one after the other")
            if options.performance_report is not None:
                self.told.say("no performance report: a plain loop has no scheduler to tell of it")
            return plain(job, queue, lambda: self.interrupts.stopping, seen)
        from sweep.tasks.scheduler import Scheduler

        client, slots, _ = self.connect()
        _log.info("blocks are computed by the workers of %s", client)
        scheduler = Scheduler(client, slots, job, queue, seen=seen, say=self.told.say)
        return scheduler.answers(lambda: self.interrupts.stopping)

    def _code(self) -> tuple[tuple[str, str], ...]:
        """Modules of the user's whose functions the study names, and their digests."""
        if not any(own_functions(self._spec)):
            return ()
        from sweep.tasks.user_code import allowed_code

        return tuple(allowed_code(self._spec).items())

    def revive(self) -> None:
        """Start workers of this machine again that are gone."""
        if self._reached is not None:
            self._reached.revive()


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of a run."""

    store: Location
    unit: str  # what the points are called
    points: int  # of the whole study
    blocks: int
    points_done: int  # committed, in this run or before
    blocks_done: int
    points_computed: int  # in this run; not those that a smaller study's store had
    blocks_computed: int
    failures: tuple[Failure, ...]
    left_out: int  # blocks that were given up before and not tried again
    stopped: str  # why the run ended before its blocks did; empty where it didn't
    seconds: float  # wall time of this run
    work_seconds: float  # evaluating and writing, summed over workers
    write_seconds: float  # the writing in it
    rays: Mapping[str, int] = field(default_factory=dict)  # cast in this run, by scanner

    @property
    def complete(self) -> bool:
        """Tell whether every block of the study is committed."""
        return self.blocks_done == self.blocks

    @property
    def why(self) -> str:
        """Why blocks are missing, in words; empty if the study is complete."""
        if self.complete:
            return ""
        if self.stopped:
            return self.stopped
        if not self.failures:
            retry = option("retry_failed")
            return f"{_blocks(self.left_out)} failed before; {retry} tries them again"
        return f"{_blocks(len(self.failures))} failed, the first with {self.failures[0].error}"


def _blocks(number: int) -> str:
    """Put a number of blocks into words."""
    return f"{number:,} block{'' if number == 1 else 's'}"


class Absence:
    """Says when a cluster has had no worker for long, again after twice as long, and so on."""

    def __init__(self) -> None:
        self._since, self._ever, self._patience = time.monotonic(), False, ABSENT

    def told(self, workers: int, *, worked: bool = False) -> str:
        """Words for so many workers now, mostly none; ``worked``: one has answered since."""
        if workers or worked:
            self._since, self._ever, self._patience = time.monotonic(), True, ABSENT
        waited = time.monotonic() - self._since
        if waited < self._patience:
            return ""
        self._patience *= 2
        what = "no worker is left" if self._ever else "no worker yet"
        return (
            f"{what} ({duration(waited)}): the cluster has none ready; "
            "Ctrl-C stops, nothing is lost"
        )


class Session:
    """One run over what a store lacks, whose lock this process holds."""

    def __init__(self, path: Location, study: Study, pool: Pool, lock: Lock) -> None:
        self._path, self._study, self._pool, self._lock = path, study, pool, lock
        self._told, self._interrupts = pool.told, pool.interrupts
        try:
            self._journal = Journal(path, durable=pool.options.durable)
        except OSError as error:
            raise StoreError(unwritable(path, error)) from error
        self._committed: dict[str, float] = defaultdict(float)  # what receipts of this run come to
        self._failures: list[Failure] = []
        self._gathered: list[Receipt] = []  # committed as soon as the journal has written them
        self._stored = 0  # bytes that there were before
        self._begun: dict[int, float] = {}  # points there are of unfinished blocks

    def run(self, *, before: str = "", rays: Mapping[str, int] | None = None) -> Outcome:
        """Compute all that is left; ``before``: why what comes before is not there."""
        start = time.monotonic()
        self._begun = journal.begun_points(self._path, self._study.id)
        receipts = read_receipts(self._path, self._study.n_blocks)
        self._stored = int(receipts.sizes.sum())
        look = Look(self._path, self._study, receipts.points > 0)
        try:
            look.within(LOOKING)
            done = look.whole()
            settled = done.copy()
            if not self._pool.options.retry_failed:
                settled[list(given_up(self._path, done.size))] = True
            left_out = int(np.count_nonzero(settled & ~done))
            _log.info(
                "%s: study %s of %s blocks, %s done before, %s left out for their errors",
                self._path, self._study.id, done.size, np.count_nonzero(done), left_out,
            )  # fmt: skip
            stopped = self._record("begun", host=socket.gethostname(), pid=os.getpid()) or before
            stopped = stopped or self._compute(settled, done) or self._look_on(look, done)
            done &= look.whole()
        finally:
            look.stop()
        study, committed = self._study, self._committed
        outcome = Outcome(
            store=self._path,
            unit=study.unit,
            points=study.points,
            blocks=study.n_blocks,
            points_done=study.points_in(done) + int(committed["points"]),
            blocks_done=int(np.count_nonzero(done)) + int(committed["blocks"]),
            points_computed=int(committed["points"] - committed["taken"]),
            blocks_computed=int(committed["blocks"]),
            failures=tuple(self._failures),
            left_out=left_out,
            stopped=stopped,
            seconds=time.monotonic() - start,
            work_seconds=committed["seconds"],
            write_seconds=committed["write_seconds"],
            rays=rays or {},
        )
        _log.info(
            "%s: %s blocks computed in %s, %s failed%s",
            self._path, outcome.blocks_computed, duration(outcome.seconds), len(outcome.failures),
            f"; stopped: {stopped}" if stopped else "",
        )  # fmt: skip
        if outcome.complete:
            store.remove_partials(self._path)
            journal.discard_begun(self._path)
        self._record(
            "ended", blocks=outcome.blocks_computed, failed=len(outcome.failures), stopped=stopped
        )
        return outcome

    def _record(self, event: str, **facts: Any) -> str:
        """Put down what happened to the run; why that can't be, where it can't."""
        try:
            self._journal.record_session(event, **facts)
        except OSError as error:
            return unwritable(self._path, error)
        return ""

    def _look_on(self, look: Look, done: np.ndarray) -> str:
        """See the look at what was done to its end, and compute what of it is not there."""
        if not look.within(LOOKING):
            self._told.say("looking whether the chunks of what was done before are there")
        while not look.within(LOOKING):
            if self._interrupts.stopping:
                return "interrupted"
        settled = look.whole() | ~done
        return self._compute(settled, settled & done)

    def _compute(self, settled: np.ndarray, done: np.ndarray) -> str:
        """Compute all blocks but those that are settled; why it ended before, where it did."""
        if settled.all():
            return ""
        blocks = BlockQueue(settled)
        before = self._study.points_in(done) + self._committed["points"]
        with ExitStack() as stack:
            try:
                self._interrupts.is_computing = True  # a start loses nothing either
                compiling = threading.Thread(target=self._compile, daemon=True)
                what = "loading the model" + ("" if self._pool.is_plain else ", reaching workers")
                with working(what, self._told):
                    compiling.start()  # beside the workers' start, which is mostly waiting
                    seen = partial(store.is_seen, self._path, self._study)
                    answers = self._pool.answers(str(self._path), self._study.id, blocks, seen)
                    while compiling.is_alive() and not self._interrupts.stopping:
                        compiling.join(TICK)
                self._told.begin(
                    points=self._study.points,
                    done=before + sum(self._begun.values()),
                    unit=self._study.unit,
                )
                stack.callback(self._told.end)
                return self._take(answers, blocks)
            except SchedulerLost as error:
                return f"the scheduler is gone ({error})"
            except KeyboardInterrupt:
                return "stopped at once"
            except OSError as error:
                return unwritable(self._path, error)
            except StoreError:
                if _is_there(self._path):
                    raise
                return unwritable(self._path, FileNotFoundError())
            finally:
                self._interrupts.is_computing = False

    def _compile(self) -> None:
        if self._pool.options.evaluate:  # in place of the model
            return
        threshold = gc.get_threshold()
        gc.set_threshold(100_000)  # a compiler's objects live on: looking at them takes a tenth
        with suppress(Exception):  # what raises here is a block's failure, recorded as one
            self._study.compile()
        gc.set_threshold(*threshold)

    def _take(self, answers: Iterator[Answer], blocks: BlockQueue) -> str:
        absence = Absence()
        for answer in answers:
            if not self._lock.is_mine():
                if not _is_there(self._path):
                    raise FileNotFoundError(self._path)
                return "another process took the store's lock"
            if missing := absence.told(answer.workers, worked=bool(answer.receipts)):
                self._told.say(missing)
                self._pool.revive()
            self._commit(answer, blocks)
            if self._interrupts.stopping:
                self._interrupts.announce()
            if not self._committed["blocks"] and len(self._failures) >= HOPELESS:
                return f"the first {HOPELESS} blocks all failed"
        before = self._points()
        self._count(now=True)
        self._told.advance(points=self._points() - before, failed=0)
        return "interrupted" if self._interrupts.stopping else ""

    def _commit(self, answer: Answer, blocks: BlockQueue) -> None:
        points, failed = self._points(), len(self._failures)
        self._journal.commit(*answer.receipts)
        self._gathered += answer.receipts
        for failure in answer.failures:
            if not blocks.again(failure.block):
                self._journal.record_failure(failure)
                self._failures.append(failure)
            _log.info("block %s failed on %s: %s", failure.block, failure.host, failure.error)
        for block, there in answer.begun.items():
            if there <= self._begun.get(block, 0.0):
                raise StoreError(NOT_FOUND.format(block))
            self._begun[block] = there
        self._count()
        stored = self._stored + int(self._committed["bytes"])
        self._told.at_work(workers=answer.workers, stored=stored)
        self._told.advance(points=self._points() - points, failed=len(self._failures) - failed)

    def _count(self, *, now: bool = False) -> None:
        """Count the blocks whose receipts are written."""
        if not self._journal.flush(now=now):
            return
        if self._gathered:
            _log.debug("committed %s blocks", len(self._gathered))
        for receipt in self._gathered:
            self._committed["blocks"] += 1
            for name in COUNTED:
                self._committed[name] += getattr(receipt, name)
            if self._begun.pop(receipt.block, None) is not None:
                journal.discard_begun(self._path, receipt.block)
        self._gathered.clear()

    def _points(self) -> float:
        """Points that there are so far of this run's blocks."""
        return self._committed["points"] + sum(self._begun.values())


def unwritable(path: Location, error: OSError) -> str:
    """Why a run stops that can't write, and what to do about it."""
    if isinstance(error, ObjectStoreError):
        return f"the store can't be written: {error.strerror}"
    if not _is_there(path):
        return f"{path} is no longer there: have its disk back, or its folder"
    remedy = write_remedy(error, path, "see to its disk")
    return f"the store can't be written ({reason(error, path)}): {remedy}"


def _is_there(path: Location) -> bool:
    """Tell whether a store is there: of one that went away, writers may leave folders anew."""
    return (path / "zarr.json").exists()
