"""Places to compute blocks: a plain loop, a given cluster, or workers started when needed."""

from __future__ import annotations

import gc
import math
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sweep.extras import remedy
from sweep.spec import Spec
from sweep.spec.clusters import (
    SSH,
    Address,
    AnyCluster,
    Batch,
    Bounds,
    Cluster,
    Kubernetes,
    Local,
    LocalWorker,
    cluster_of,
    load_cluster,
)
from sweep.spec.sections import Execution
from sweep.tasks import user_code
from sweep.tasks.clusters import kubernetes, machines
from sweep.tasks.grid import seconds_a_point
from sweep.tasks.progress import ClusterError, Interrupts, Progress, chosen
from sweep.tasks.scheduler import BlockQueue, Scheduler, Seen, plain
from sweep.tasks.study import Evaluate
from sweep.tasks.worker import Answer, Job

if TYPE_CHECKING:
    from distributed import Client

    from sweep.spec import SceneSpec

#: Scheduler "address" of the plain loop.
NONE = "none"

CONNECT_TIMEOUT = 15.0

#: Work that is done here and at once, where nobody says otherwise [s of one core]: workers take
#: some seconds to start.
LITTLE = 10.0

#: Seconds of a core that a ray, and a draw of a shot, take at the most, about.
RAY, SHOT = 5e-6, 4e-4


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
    evaluate: Evaluate | None = None

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
            return of_workers(given, self.workers)
        scheduler, execution = self.scheduler, spec.execution
        if scheduler is None and self.workers is None:
            scheduler = execution.scheduler or None
        if scheduler == NONE or (scheduler is None and self._leaves_it_open(spec)):
            return None
        if scheduler is not None:
            return Address.model_construct(kind="scheduler", address=scheduler, security=None)
        here = Local(kind="local", worker=LocalWorker(threads=execution.threads))
        return of_workers(here, self.workers or execution.workers or None)

    def _leaves_it_open(self, spec: Spec | SceneSpec) -> bool:
        """Tell whether nothing is said that takes workers, and the work takes none."""
        said = self.workers or self.block_timeout or self.performance_report or self.evaluate
        if said or not self.processes or spec.execution != Execution():
            return False
        return not user_code.names_any(spec) and about_seconds(spec) <= LITTLE


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
        self.options, self.interrupts = options, Interrupts()
        self.told = chosen(options.progress)
        self._cluster = options.place(spec)
        self.most = 1  # blocks of the study: more workers than that have nothing to do
        self._reached: Reached | None = None

    @property
    def is_plain(self) -> bool:
        """Tell whether blocks are computed in a plain loop, without workers."""
        return self.options.client is None and self._cluster is None

    def connect(self) -> Reached:
        """Reach the workers, no more than `most`; ClusterError where there are none to be had."""
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
            elif client.asynchronous:
                raise ClusterError("the client is asynchronous: give one of another kind, Client()")
            else:
                self._reached = Reached(client, 0)
            if file := self.options.performance_report:
                report = _reported(self._reached.client, Path(file), self.told.say)
                self.enter_context(report)
        return self._reached

    def answers(self, path: str, study_id: str, queue: BlockQueue, seen: Seen) -> Iterator[Answer]:
        """Answers of a study's blocks as they arrive; `seen` tells what is in the store here."""
        options = self.options
        job = Job(path, study_id, options.evaluate, options.block_timeout, options.durable)
        if self.is_plain:
            if options.performance_report is not None:
                self.told.say("no performance report: a plain loop has no scheduler to tell of it")
            return plain(job, queue, self._stopping, seen)
        client, slots, _ = self.connect()
        scheduler = Scheduler(client, slots, job, queue, seen=seen, say=self.told.say)
        return scheduler.answers(self._stopping)

    def _stopping(self) -> bool:
        return self.interrupts.stopping

    def revive(self) -> None:
        """Start workers of this machine again that are gone."""
        if self._reached is not None:
            self._reached.revive()


class Reached(NamedTuple):
    """A cluster in use."""

    client: Client
    slots: int  # worker threads that it may come to have; 0 where that is unknown
    revive: Callable[[], object] = lambda: None  # starts workers in the place of lost ones


def cores() -> int:
    """Cores that this process may use."""
    from dask.system import CPU_COUNT

    return int(CPU_COUNT)


def of_workers(cluster: AnyCluster, workers: int | None) -> AnyCluster:
    """Fix the number of workers of a cluster, if one is given and they are ours."""
    if workers is None:
        return cluster
    if isinstance(cluster, Address):
        raise ClusterError(
            f"the workers of {cluster.address} are there already: leave out their number"
        )
    return cluster.model_copy(update={"workers": Bounds(workers, workers)})


@contextmanager
def connected(
    cluster: AnyCluster, *, most: int, processes: bool, say: Callable[[str], None]
) -> Iterator[Reached]:
    """Connect a client to a cluster; one that is started here ends with it.

    No more workers are started than there can be tasks at once (`most`). ClusterError where no
    scheduler answers or no worker starts.
    """
    from distributed import Client

    if isinstance(cluster, Address):
        with _reached(cluster.address, cluster) as client:
            say(f"scheduler {cluster.address}: dashboard {client.dashboard_link}")
            yield Reached(client, 0)
        return
    bounds = _bounds(cluster, most)
    if isinstance(cluster, Kubernetes):
        with kubernetes.deployed(cluster, bounds) as address, _reached(address, cluster) as client:
            say(f"{_described(cluster, bounds)}: scheduler {address}")
            yield Reached(client, bounds.most * cluster.worker.threads)
        return
    with (
        machines.spawning(),
        _started(cluster, bounds, processes) as started,
        Client(started, set_as_default=False) as client,
    ):
        _keep(started, cluster, bounds)
        say(f"{_described(cluster, bounds)}: dashboard {started.dashboard_link}")
        slots = bounds.most * cluster.worker.threads
        if isinstance(cluster, Local):
            yield Reached(client, slots, lambda: started.scale(bounds.least))
        else:  # what is lost comes again by itself, or not at all
            yield Reached(client, slots)


def _bounds(cluster: Any, most: int) -> Bounds:
    """Bounds of the number of workers, none of which shall have nothing to do."""
    wanted = cluster.workers or Bounds(cores(), cores())
    return Bounds(*(min(number, max(1, most)) for number in wanted))


def _reached(address: str, cluster: AnyCluster) -> Client:
    """Make a client that is not Dask's default: one that fails to connect would stay it."""
    from distributed import Client

    try:
        return Client(
            address,
            timeout=CONNECT_TIMEOUT,
            security=machines.security_of(cluster),
            set_as_default=False,
        )
    except (OSError, ValueError) as error:
        # Collected here, as one that goes while another is made waits for ever for that one's lock.
        traceback.clear_frames(error.__traceback__)
        gc.collect()
        raise ClusterError(f"no Dask scheduler answers at {address}: {error}") from error


def _started(cluster: Local | Batch | SSH, bounds: Bounds, processes: bool) -> Any:
    import dask

    try:
        with dask.config.set(machines.CALM):
            if isinstance(cluster, Local):
                return machines.start_here(cluster, bounds, processes=processes)
            if isinstance(cluster, Batch):
                from sweep.tasks.clusters import batch

                return batch.start(cluster, bounds)
            return machines.start_by_ssh(cluster, bounds)
    except (OSError, RuntimeError, ImportError) as error:
        raise ClusterError(f"no workers could be started: {remedy(error) or error}") from error


def _keep(started: Any, cluster: AnyCluster, bounds: Bounds) -> None:
    """Keep the number of workers within bounds; that of jobs, which end, even if it is fixed."""
    if isinstance(cluster, Batch):
        from sweep.tasks.clusters import batch

        batch.keep(started, cluster, bounds)
    elif bounds.least < bounds.most:
        least, most = bounds
        started.adapt(minimum=least, maximum=most, target_duration=machines.WORK_AHEAD)


def _described(cluster: AnyCluster, bounds: Bounds) -> str:
    count = f"{bounds.least} to {bounds.most}" if bounds.least < bounds.most else f"{bounds.most}"
    workers = f"{count} worker{'s' if bounds.most > 1 else ''}"
    if isinstance(cluster, Batch):
        held = cluster.job.workers
        each = f" of {held}" if held > 1 else ""
        return f"{workers} in {cluster.kind.upper()} jobs{each}"
    if isinstance(cluster, SSH):
        return f"{workers} on {', '.join(cluster.hosts)}"
    if isinstance(cluster, Kubernetes):
        return f"{workers} in pods of {cluster.namespace}"
    return f"{workers} on this machine"


@contextmanager
def _reported(client: Client, file: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Write Dask's report of what a cluster does meanwhile; that it can't is no reason to fail."""
    from distributed import performance_report

    report = performance_report(filename=str(file))
    with client.as_current():
        report.__enter__()
    try:
        yield
    finally:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            with client.as_current():
                report.__exit__(None, None, None)
            say(f"performance report: {file}")
        except Exception as error:  # the scheduler may be gone, and with it what it knew
            say(f"no performance report: {error}")
