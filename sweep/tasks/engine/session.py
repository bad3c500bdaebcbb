"""One session of a run: options, compute backend, committing of blocks, and outcome.

A session computes the missing blocks of one store.
"""

from __future__ import annotations

import gc
import logging
import os
import re
import socket
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, fields
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.messages import option_name, option_text
from sweep.spec.cluster_config import (
    DASHBOARD_PORT,
    NO_DASHBOARD,
    AnyClusterConfig,
    ClusterConfig,
    ExistingSchedulerConfig,
    KubernetesClusterConfig,
    LocalClusterConfig,
    LocalWorkerConfig,
    WorkerBounds,
    cluster_config_from_mapping,
    load_cluster_config,
)
from sweep.spec.rules import suggest_similar_name
from sweep.spec.sections import Execution
from sweep.storage.locations import (
    Location,
    ObjectStoreError,
    os_error_reason,
    remedy_for_write_error,
)
from sweep.storage.store_format import read_receipt_totals
from sweep.tasks.engine import journal, study_store, user_code
from sweep.tasks.engine.block_study import BlockEvaluator, BlockStudy, Workload
from sweep.tasks.engine.interrupts import InterruptHandler
from sweep.tasks.engine.journal import (
    ChunkScan,
    Failure,
    Journal,
    Receipt,
    StoreLock,
    read_permanent_failures,
)
from sweep.tasks.engine.progress import (
    ClusterError,
    Progress,
    RunRequestError,
    SchedulerLostError,
    StoreError,
    duration_text,
    make_progress,
    show_activity,
)
from sweep.tasks.engine.worker import (
    IDLE_POLL_SECONDS,
    BlockQueue,
    ReceiptVerifier,
    TaskResult,
    TaskSettings,
    run_in_threads,
    run_serial,
)
from sweep.tasks.engine.worker_memory import (
    WorkerMemory,
    available_process_memory,
    available_worker_memory,
)

if TYPE_CHECKING:
    from distributed import Client

    from sweep.tasks.engine.cluster_connection import ClusterConnection

#: Value of the option `scheduler` that selects serial computation in this process.
SERIAL_SCHEDULER_OPTION = "none"

#: Number of failed blocks at which a run stops if no block has succeeded.
MAX_INITIAL_FAILURES = 20

#: Longest wait of a run for the search for missing chunks [s]. The run then relies on the log of
#: receipts, and the search continues during the run.
CHUNK_SCAN_TIMEOUT_SECONDS = 2.0

#: Time without any connected worker after which a warning is given [s].
NO_WORKER_WARNING_SECONDS = 20.0

#: Fields of the receipts of blocks that a session sums.
SUMMED_RECEIPT_FIELDS = ("points", "reused_points", "bytes", "seconds", "write_seconds")

_log = logging.getLogger("sweep.session")

#: Message about a checkpoint that the next worker does not see.
CHECKPOINT_LOST_MESSAGE = (
    "block {} is computed in pieces, and what one worker saved was not found by the next: "
    "do all of them see the same store?"
)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of where and how to compute a study; they do not change the results.

    Parameters
    ----------
    client
        Dask client to compute with. Without one, `threads`, `workers`, `scheduler` and `cluster`
        select the backend. By default threads of this process compute on all cores. Worker
        processes are used for studies that call the user's Python functions, and for options that
        need a scheduler.
    threads
        Number of threads of this process that compute blocks; one per core by default.
    workers, processes
        Number of Dask workers to start on this machine, and whether they are processes or threads.
    scheduler
        Address of a Dask scheduler, or "none" for serial computation in this process.
    cluster
        File that describes a cluster, or its content; `workers` sets the number of workers.
    progress
        True for a bar or lines on standard error, False for none, or a `Progress`.
    block_timeout
        Time limit of a block [s]; a block that exceeds it twice counts as failed.
    durable
        Whether blocks are on the disk once committed, and not only in the cache of the operating
        system. A power failure then loses none of them.
    retry_failed
        Whether to compute blocks again that failed in an earlier run.
    performance_report
        HTML file for Dask's report of the run.
    dashboard
        Whether the workers that are started have Dask's dashboard, on a port of this machine alone.
        It has no password: all users of this machine can see it.
    allow_code
        Python modules whose detectors and estimators the study may call, here and on its workers.
    evaluate
        Function that replaces the model in computing a block, with the same results; for tests.
    """

    client: Client | None = None
    threads: int | None = None
    workers: int | None = None
    processes: bool = True
    scheduler: str | None = None
    cluster: str | Path | Mapping[str, Any] | AnyClusterConfig | None = None
    progress: bool | Progress = True
    block_timeout: float | None = None
    durable: bool = False
    retry_failed: bool = False
    performance_report: str | Path | None = None
    dashboard: bool = False
    allow_code: Sequence[str] = ()
    evaluate: BlockEvaluator | None = None

    def __post_init__(self) -> None:
        for name, number in (("workers", self.workers), ("threads", self.threads)):
            is_integer = isinstance(number, Integral) and not isinstance(number, bool)
            if number is not None and not (is_integer and number > 0):
                raise ClusterError(f"{name} must be a whole number above 0, not {number!r}")
        if self.threads is not None and (named := self._first_option_needing_workers()):
            raise ClusterError(
                f"{option_name('threads')} computes in this process, and {option_name(named)} with "
                "workers: leave out one"
            )
        if self.scheduler not in (None, SERIAL_SCHEDULER_OPTION) and not _is_scheduler_address(
            self.scheduler
        ):
            raise ClusterError(
                f"{self.scheduler!r} is no address of a Dask scheduler: write e.g. "
                f"'tcp://10.0.0.5:8786', or '{SERIAL_SCHEDULER_OPTION}' for a plain loop here"
            )
        timeout = self.block_timeout
        if timeout is not None and not (isinstance(timeout, int | float) and timeout > 0):
            raise RunRequestError(
                f"block_timeout must be a number of seconds above 0, not {timeout!r}"
            )
        if self.allow_code:
            user_code.allow_modules(
                [self.allow_code] if isinstance(self.allow_code, str) else self.allow_code
            )

    @classmethod
    def from_mapping(cls, options: Mapping[str, Any]) -> RunOptions:
        """Return run options, given a mapping of option names to values.

        TypeError is raised for an unknown name. The message suggests the most similar name.
        """
        names = [field.name for field in fields(cls)]
        for name in options.keys() - set(names):
            raise TypeError(
                f"there is no option {name!r}; {suggest_similar_name(name, names)}".rstrip("; ")
            )
        return cls(**options)

    def resolve_cluster(self, workload: Workload) -> AnyClusterConfig | None:
        """Return the configuration of the cluster whose workers compute the blocks.

        The options name the cluster, or else the spec's section `execution` does. The result is
        None if blocks are computed in this process. ClusterError is raised if both a scheduler and
        a cluster are named, or a number of workers for a scheduler that runs already.
        """
        if self.cluster is not None:
            if self.scheduler is not None:
                raise ClusterError("a scheduler and a cluster are both named: leave out one")
            cluster = self.cluster
            if not isinstance(cluster, ClusterConfig):
                cluster = (
                    cluster_config_from_mapping(cluster)
                    if isinstance(cluster, Mapping)
                    else load_cluster_config(cluster)
                )
            return self._enable_dashboard_if_asked(_with_worker_count(cluster, self.workers))
        scheduler, execution = self.scheduler, workload.execution
        if scheduler is None and self.workers is None:
            scheduler = execution.scheduler or None
        if scheduler == SERIAL_SCHEDULER_OPTION and self.dashboard:
            raise ClusterError(
                f"a plain loop has no dashboard: leave out {option_text('dashboard')}"
            )
        if scheduler == SERIAL_SCHEDULER_OPTION or (
            scheduler is None and self._prefers_threads(workload)
        ):
            return None
        if scheduler is not None:
            if self.dashboard:
                raise ClusterError(
                    f"the scheduler {scheduler} runs already: leave out {option_text('dashboard')}"
                )
            return ExistingSchedulerConfig.model_construct(
                kind="scheduler", address=scheduler, security=None
            )
        local_cluster = LocalClusterConfig(
            kind="local", worker=LocalWorkerConfig(threads=execution.threads)
        )
        return self._enable_dashboard_if_asked(
            _with_worker_count(local_cluster, self.workers or execution.workers or None)
        )

    def _enable_dashboard_if_asked(self, cluster: AnyClusterConfig) -> AnyClusterConfig:
        """Return a cluster's configuration, with Dask's dashboard if the options ask for it."""
        if not self.dashboard:
            return cluster
        if isinstance(cluster, ExistingSchedulerConfig | KubernetesClusterConfig):
            raise ClusterError(
                "the scheduler is not started on this machine: leave out "
                f"{option_text('dashboard')}"
            )
        if cluster.scheduler.dashboard != NO_DASHBOARD:
            return cluster
        scheduler = cluster.scheduler.model_copy(update={"dashboard": str(DASHBOARD_PORT)})
        return cluster.model_copy(update={"scheduler": scheduler})

    def _prefers_threads(self, workload: Workload) -> bool:
        """Return True if threads of this process are to compute the blocks, and not Dask workers.

        That is so if `threads` is set, or if neither options nor spec ask for workers and no Python
        code of the user's is called. Python code would hold Python's global lock, so that threads
        would compute in turns.
        """
        if self.threads is not None:
            return True
        execution = workload.execution
        needs_workers = (
            self._first_option_needing_workers() or self.evaluate or workload.user_module_names
        )
        return not needs_workers and execution == Execution()

    def _first_option_needing_workers(self) -> str:
        """Return the name of the first option in use that needs Dask workers; '' if none does."""
        is_set = {
            "workers": self.workers is not None,
            "client": self.client is not None,
            "cluster": self.cluster is not None,
            "scheduler": self.scheduler is not None,
            "block_timeout": self.block_timeout is not None,
            "performance_report": self.performance_report is not None,
            "dashboard": self.dashboard,
            "processes": not self.processes,
        }
        return next((name for name, value in is_set.items() if value), "")

    def n_threads(self, workload: Workload) -> int:
        """Return the number of threads of this process that are to compute blocks.

        The result is 1 if the scheduler is "none", which stands for serial computation.
        """
        scheduler = self.scheduler or (self.workers is None and workload.execution.scheduler)
        if scheduler == SERIAL_SCHEDULER_OPTION:
            return 1
        if self.threads is not None:
            return int(self.threads)
        from dask.system import CPU_COUNT  # respects the limits of containers

        return int(CPU_COUNT)


def _is_scheduler_address(address: object) -> bool:
    """Return True if a text is an address of a Dask scheduler, with or without a protocol."""
    return isinstance(address, str) and bool(
        re.fullmatch(r"(\w+://)?[^\s/:]\S*:\d+|inproc://.+", address)
    )


def _with_worker_count(cluster: AnyClusterConfig, n_workers: int | None) -> AnyClusterConfig:
    """Return a cluster's configuration with `n_workers` workers; unchanged if that is None.

    ClusterError is raised if the workers belong to a scheduler that runs already.
    """
    if n_workers is None:
        return cluster
    if isinstance(cluster, ExistingSchedulerConfig):
        raise ClusterError(
            f"the workers of {cluster.address} are there already: leave out their number"
        )
    return cluster.model_copy(update={"workers": WorkerBounds(n_workers, n_workers)})


class ComputeBackend(ExitStack):
    """Context manager of the workers, or the threads of this process, that compute studies.

    Several studies are computed one after the other.
    """

    def __init__(self, options: RunOptions, workload: Workload) -> None:
        super().__init__()
        self.options, self.progress = options, make_progress(options.progress)
        self.interrupts = InterruptHandler(self.progress)
        self._cluster, self._workload = options.resolve_cluster(workload), workload
        self.memory = (
            available_process_memory()
            if self.is_in_process
            else available_worker_memory(options.client, self._cluster)
        )
        self.bytes_per_thread = 0.0
        """Memory that a thread of this process needs to compute a block [bytes].

        The caller sets it.
        """
        self.check_memory: Callable[[WorkerMemory], None] = lambda memory: None
        """Function that raises a SpecError if a study needs more memory than a worker has.

        The caller sets it.
        """
        self.max_workers = 1  # number of blocks of the study, as further workers would be idle
        self._connection: ClusterConnection | None = None

    @property
    def is_in_process(self) -> bool:
        """True if blocks are computed in this process, by threads or one after the other."""
        return self.options.client is None and self._cluster is None

    @property
    def n_threads(self) -> int:
        """Number of threads of this process that compute; 0 if workers do.

        It is limited by memory, and by the number of blocks.
        """
        if not self.is_in_process:
            return 0
        n_threads = self._n_requested_threads
        if n_threads == 1 or self.memory.suffices_for(n_threads * self.bytes_per_thread):
            return n_threads
        return max(int(self.memory.bytes_max / self.bytes_per_thread), 1)

    @property
    def _n_requested_threads(self) -> int:
        """Number of threads that the options ask for, at most one per block."""
        return max(min(self.options.n_threads(self._workload), self.max_workers), 1)

    @property
    def uses_running_scheduler(self) -> bool:
        """True if the workers belong to a scheduler that was started before this run."""
        return self.options.client is None and isinstance(self._cluster, ExistingSchedulerConfig)

    def connect(self) -> ClusterConnection:
        """Return the connection to the workers, after connecting at the first call.

        At most `max_workers` workers are started, if they do not run yet. ClusterError is raised if
        no worker is available.
        """
        from sweep.tasks.engine.cluster_connection import (
            ClusterConnection,
            connect_cluster,
            write_performance_report,
        )

        if self._connection is None:
            client = self.options.client
            if client is None:
                assert self._cluster is not None
                self._connection = self.enter_context(
                    connect_cluster(
                        self._cluster,
                        max_workers=self.max_workers,
                        processes=self.options.processes,
                        say=self.progress.say,
                    )
                )
                if self.uses_running_scheduler:  # the memory of its workers is known from here on
                    self.check_memory(available_worker_memory(self._connection.client, None))
            elif client.asynchronous:
                raise ClusterError("the client is asynchronous: give one of another kind, Client()")
            else:
                self._connection = ClusterConnection(client, 0)
            if report_path := self.options.performance_report:
                report_context = write_performance_report(
                    self._connection.client, Path(report_path), self.progress.say
                )
                self.enter_context(report_context)
        return self._connection

    def iter_results(
        self,
        store_path: str,
        study_id: str,
        block_queue: BlockQueue,
        verify_receipt: ReceiptVerifier,
    ) -> Iterator[TaskResult]:
        """Compute the blocks of a queue. Return an iterator over `TaskResult` objects.

        A receipt is the record of a committed block. `verify_receipt` returns True if that block is
        in the store as this process sees it.
        """
        options = self.options
        settings = TaskSettings(
            store_path,
            study_id,
            self._workload.read_study,
            options.evaluate,
            options.block_timeout,
            options.durable,
            tuple(user_code.module_digests(self._workload.user_module_names).items()),
        )
        if self.is_in_process:
            if options.performance_report is not None:
                self.progress.say(
                    "no performance report: a plain loop has no scheduler to tell of it"
                )
            n_threads, n_without_limit = self.n_threads, self._n_requested_threads
            if n_threads < n_without_limit:
                self.progress.say(
                    f"memory suffices for {n_threads} of {n_without_limit} threads: a block takes "
                    f"up to {self.bytes_per_thread / 1e9:,.1f} GB"
                )
            in_process = (
                settings,
                block_queue,
                lambda: self.interrupts.is_stopping,
                verify_receipt,
                self.progress.say,
            )
            if n_threads == 1:
                _log.info("blocks are computed in this process, one after the other")
                return run_serial(*in_process)
            _log.info("blocks are computed by %s threads of this process", n_threads)
            return run_in_threads(*in_process, n_threads)
        from sweep.tasks.engine.dispatcher import TaskDispatcher

        client, n_expected_worker_threads, _ = self.connect()
        _log.info("blocks are computed by the workers of %s", client)
        dispatcher = TaskDispatcher(
            client,
            n_expected_worker_threads,
            settings,
            block_queue,
            verify_receipt=verify_receipt,
            say=self.progress.say,
        )
        return dispatcher.iter_results(lambda: self.interrupts.is_stopping)

    def restart_workers(self) -> None:
        """Replace lost workers that were started on this machine by new ones."""
        if self._connection is not None:
            self._connection.restart_workers()


@dataclass(frozen=True, kw_only=True)
class SessionOutcome:
    """Result of one session: numbers of blocks and points, times, and why it stopped."""

    store: Location
    points_noun: str  # name of the points, in the plural
    points: int  # number of points of the study
    blocks: int  # number of blocks of the study
    points_done: int  # number of points of committed blocks, in this run or before
    blocks_done: int  # number of committed blocks, in this run or before
    points_computed: int  # number in this run, without points taken from a smaller study's store
    blocks_computed: int  # number in this run
    failures: tuple[Failure, ...]  # permanent failures of this run
    blocks_skipped: int  # number of blocks that failed in an earlier run and were not tried again
    stop_reason: str  # reason for stopping early, or ''
    seconds: float  # wall time of this run [s]
    work_seconds: float  # time of evaluating and writing, summed over workers [s]
    write_seconds: float  # part of it for writing [s]

    @property
    def complete(self) -> bool:
        """True if every block of the study is committed."""
        return self.blocks_done == self.blocks

    @property
    def incomplete_reason(self) -> str:
        """Reason why blocks are missing; '' if the study is complete."""
        if self.complete:
            return ""
        if self.stop_reason:
            return self.stop_reason
        if not self.failures:
            retry = option_text("retry_failed")
            return (
                f"{_block_count_text(self.blocks_skipped)} failed before; {retry} tries them again"
            )
        return (
            f"{_block_count_text(len(self.failures))} failed, "
            f"the first with {self.failures[0].error}"
        )


def _block_count_text(count: int) -> str:
    """Return a number of blocks as text, such as `1 block`."""
    return f"{count:,} block{'' if count == 1 else 's'}"


class NoWorkerMonitor:
    """Monitor that warns if a cluster has no workers for long, at increasing intervals."""

    def __init__(self) -> None:
        self._last_seen, self._has_had_workers, self._warn_after = (
            time.monotonic(),
            False,
            NO_WORKER_WARNING_SECONDS,
        )

    def warning_text(self, n_workers: int, *, has_receipts: bool = False) -> str:
        """Return a warning if the cluster has had no worker for a long time, else ''.

        `n_workers` is the present number of workers. `has_receipts` is True if a worker has
        returned a result since the last call.
        """
        if n_workers or has_receipts:
            self._last_seen, self._has_had_workers, self._warn_after = (
                time.monotonic(),
                True,
                NO_WORKER_WARNING_SECONDS,
            )
        seconds_without_worker = time.monotonic() - self._last_seen
        if seconds_without_worker < self._warn_after:
            return ""
        self._warn_after *= 2
        situation = "no worker is left" if self._has_had_workers else "no worker yet"
        return (
            f"{situation} ({duration_text(seconds_without_worker)}): the cluster has none ready; "
            "Ctrl-C stops, nothing is lost"
        )


class Session:
    """Computation of the missing blocks of a store, whose lock this process holds."""

    def __init__(
        self, store_path: Location, study: BlockStudy, backend: ComputeBackend, lock: StoreLock
    ) -> None:
        self._store_path, self._study, self._backend, self._lock = store_path, study, backend, lock
        self._progress, self._interrupts = backend.progress, backend.interrupts
        try:
            self._journal = Journal(store_path, durable=backend.options.durable)
        except OSError as error:
            raise StoreError(store_write_error_text(store_path, error)) from error
        self._receipt_totals: dict[str, float] = defaultdict(
            float
        )  # sums over the receipts of this run
        self._permanent_failures: list[Failure] = []
        self._unflushed_receipts: list[
            Receipt
        ] = []  # receipts that the journal has not written yet
        self._bytes_before = 0  # size of the blocks committed before this run [bytes]
        self._checkpoint_points: dict[int, float] = {}  # points done, by unfinished block

    def run(self, *, prior_stop_reason: str = "") -> SessionOutcome:
        """Compute all missing blocks, and return the outcome.

        `prior_stop_reason` is the reason why an earlier stage of the study is incomplete. If it is
        not empty, no block is computed.
        """
        start_time = time.monotonic()
        self._checkpoint_points = journal.read_checkpoint_point_counts(
            self._store_path, self._study.id
        )
        receipts = read_receipt_totals(self._store_path, self._study.n_blocks)
        self._bytes_before = int(receipts.bytes_by_block.sum())
        chunk_scan = ChunkScan(self._store_path, self._study, receipts.points_by_block > 0)
        try:
            chunk_scan.wait(CHUNK_SCAN_TIMEOUT_SECONDS)
            is_done = chunk_scan.complete_block_mask()
            is_settled = is_done.copy()
            if not self._backend.options.retry_failed:
                is_settled[list(read_permanent_failures(self._store_path, is_done.size))] = True
            n_blocks_skipped = int(np.count_nonzero(is_settled & ~is_done))
            _log.info(
                "%s: study %s of %s blocks, %s done before, %s left out for their errors",
                self._store_path,
                self._study.id,
                is_done.size,
                np.count_nonzero(is_done),
                n_blocks_skipped,
            )
            stop_reason = (
                self._record_run_event(
                    "begun",
                    host=socket.gethostname(),
                    pid=os.getpid(),
                    threads=0 if is_settled.all() else self._backend.n_threads,
                )
                or prior_stop_reason
            )
            stop_reason = (
                stop_reason
                or self._compute_blocks(is_settled, is_done)
                or self._compute_blocks_lacking_chunks(chunk_scan, is_done)
            )
            is_done &= chunk_scan.complete_block_mask()
        finally:
            chunk_scan.stop()
        study, totals = self._study, self._receipt_totals
        outcome = SessionOutcome(
            store=self._store_path,
            points_noun=study.points_noun,
            points=study.n_points,
            blocks=study.n_blocks,
            points_done=study.count_points_in_blocks(is_done) + int(totals["points"]),
            blocks_done=int(np.count_nonzero(is_done)) + int(totals["blocks"]),
            points_computed=int(totals["points"] - totals["reused_points"]),
            blocks_computed=int(totals["blocks"]),
            failures=tuple(self._permanent_failures),
            blocks_skipped=n_blocks_skipped,
            stop_reason=stop_reason,
            seconds=time.monotonic() - start_time,
            work_seconds=totals["seconds"],
            write_seconds=totals["write_seconds"],
        )
        _log.info(
            "%s: %s blocks computed in %s, %s failed%s",
            self._store_path,
            outcome.blocks_computed,
            duration_text(outcome.seconds),
            len(outcome.failures),
            f"; stopped: {stop_reason}" if stop_reason else "",
        )
        if outcome.complete:
            study_store.remove_draft_files(self._store_path)
            journal.delete_checkpoints(self._store_path)
        self._record_run_event(
            "ended",
            blocks=outcome.blocks_computed,
            failed=len(outcome.failures),
            stopped=stop_reason,
        )
        return outcome

    def _record_run_event(self, event: str, **details: Any) -> str:
        """Append an event to the log of runs. Return an error message if that fails, else ''."""
        try:
            self._journal.record_run_event(event, **details)
        except OSError as error:
            return store_write_error_text(self._store_path, error)
        return ""

    def _compute_blocks_lacking_chunks(self, chunk_scan: ChunkScan, is_done: np.ndarray) -> str:
        """Wait for the end of the search for missing chunks. Compute the blocks that lack a chunk.

        `is_done` is the mask (blocks,) of the blocks that counted as done before the search ended.
        Return the reason for stopping early, or ''.
        """
        if not chunk_scan.wait(CHUNK_SCAN_TIMEOUT_SECONDS):
            self._progress.say("looking whether the chunks of what was done before are there")
        while not chunk_scan.wait(CHUNK_SCAN_TIMEOUT_SECONDS):
            if self._interrupts.is_stopping:
                return "interrupted"
        is_settled = chunk_scan.complete_block_mask() | ~is_done
        return self._compute_blocks(is_settled, is_settled & is_done)

    def _compute_blocks(self, is_settled: np.ndarray, is_done: np.ndarray) -> str:
        """Compute all blocks that are not settled. Return the reason for stopping early, or ''.

        `is_settled` and `is_done` are masks (blocks,). A block is settled if it is done or has
        failed permanently.
        """
        if is_settled.all():
            return ""
        block_queue = BlockQueue(is_settled)
        points_before = self._study.count_points_in_blocks(is_done) + self._receipt_totals["points"]
        with ExitStack() as stack:
            try:
                self._interrupts.is_computing = True  # a stop while workers start loses nothing
                compile_thread = threading.Thread(target=self._compile_kernels, daemon=True)
                activity = "loading the model" + (
                    "" if self._backend.is_in_process else ", reaching workers"
                )
                with show_activity(activity, self._progress):
                    compile_thread.start()  # while workers start, which is mostly waiting
                    verify_receipt = partial(
                        study_store.is_block_visible, self._store_path, self._study
                    )
                    task_results = self._backend.iter_results(
                        str(self._store_path), self._study.id, block_queue, verify_receipt
                    )
                    while compile_thread.is_alive() and not self._interrupts.is_stopping:
                        compile_thread.join(IDLE_POLL_SECONDS)
                self._progress.begin(
                    points=self._study.n_points,
                    done=points_before + sum(self._checkpoint_points.values()),
                    unit=self._study.points_noun,
                )
                stack.callback(self._progress.end)
                return self._consume_results(task_results, block_queue)
            except SchedulerLostError as error:
                return f"the scheduler is gone ({error})"
            except KeyboardInterrupt:
                return "stopped at once"
            except OSError as error:
                return store_write_error_text(self._store_path, error)
            except StoreError:
                if _store_exists(self._store_path):
                    raise
                return store_write_error_text(self._store_path, FileNotFoundError())
            finally:
                self._interrupts.is_computing = False

    def _compile_kernels(self) -> None:
        """Compile the kernels of the study. Workers load them from the cache on disk.

        Errors are ignored: they occur again when a block is computed, and are recorded as its
        failure.
        """
        if self._backend.options.evaluate:  # the model is not used
            return
        gc_threshold = gc.get_threshold()
        gc.set_threshold(100_000)  # a compiler's objects persist: collecting them takes 10 %
        with suppress(Exception):  # the same error makes a block fail, and is recorded there
            self._study.compile_kernels()
        gc.set_threshold(*gc_threshold)

    def _consume_results(self, task_results: Iterator[TaskResult], block_queue: BlockQueue) -> str:
        """Commit each `TaskResult` as it arrives. Return the reason for stopping early, or ''."""
        no_worker_monitor = NoWorkerMonitor()
        for task_result in task_results:
            if not self._lock.is_held_by_this_process():
                if not _store_exists(self._store_path):
                    raise FileNotFoundError(self._store_path)
                return "another process took the store's lock"
            if warning := no_worker_monitor.warning_text(
                task_result.n_workers, has_receipts=bool(task_result.receipts)
            ):
                self._progress.say(warning)
                self._backend.restart_workers()
            self._commit_task_result(task_result, block_queue)
            if self._interrupts.is_stopping:
                self._interrupts.announce_stop()
            if (
                not self._receipt_totals["blocks"]
                and len(self._permanent_failures) >= MAX_INITIAL_FAILURES
            ):
                return f"the first {MAX_INITIAL_FAILURES} blocks all failed"
        points_before = self._n_points_so_far()
        self._flush_receipts(force=True)
        self._progress.advance(points=self._n_points_so_far() - points_before, failed=0)
        return "interrupted" if self._interrupts.is_stopping else ""

    def _commit_task_result(self, task_result: TaskResult, block_queue: BlockQueue) -> None:
        """Append a task's receipts and failures to the journal, and report the progress.

        A block that failed for the first time is put back into `block_queue`.
        """
        points_before, failures_before = self._n_points_so_far(), len(self._permanent_failures)
        self._journal.commit(*task_result.receipts)
        self._unflushed_receipts += task_result.receipts
        for failure in task_result.failures:
            if not block_queue.requeue_failed(failure.block):
                self._journal.record_failure(failure)
                self._permanent_failures.append(failure)
            _log.info("block %s failed on %s: %s", failure.block, failure.host, failure.error)
        for block, saved_points in task_result.checkpoint_points_by_block.items():
            if saved_points <= self._checkpoint_points.get(block, 0.0):
                raise StoreError(CHECKPOINT_LOST_MESSAGE.format(block))
            self._checkpoint_points[block] = saved_points
        self._flush_receipts()
        bytes_stored = self._bytes_before + int(self._receipt_totals["bytes"])
        if self._backend.is_in_process:
            self._progress.update_threads(threads=task_result.n_workers, stored=bytes_stored)
        else:
            self._progress.update_workers(workers=task_result.n_workers, stored=bytes_stored)
        self._progress.advance(
            points=self._n_points_so_far() - points_before,
            failed=len(self._permanent_failures) - failures_before,
        )

    def _flush_receipts(self, *, force: bool = False) -> None:
        """Write pending receipts. Once all are written, add them to the totals of the session.

        In an object store, receipts that are not due yet are written only if `force`.
        """
        if not self._journal.flush(force=force):
            return
        if self._unflushed_receipts:
            _log.debug("committed %s blocks", len(self._unflushed_receipts))
        for receipt in self._unflushed_receipts:
            self._receipt_totals["blocks"] += 1
            for quantity in SUMMED_RECEIPT_FIELDS:
                self._receipt_totals[quantity] += getattr(receipt, quantity)
            if self._checkpoint_points.pop(receipt.block, None) is not None:
                journal.delete_checkpoints(self._store_path, receipt.block)
        self._unflushed_receipts.clear()

    def _n_points_so_far(self) -> float:
        """Return the number of points committed in this run, plus those in checkpoints."""
        return self._receipt_totals["points"] + sum(self._checkpoint_points.values())


def store_write_error_text(store_path: Location, error: OSError) -> str:
    """Return the reason why a store can't be written, and the remedy, as text for a message."""
    if isinstance(error, ObjectStoreError):
        return f"the store can't be written: {error.strerror}"
    if not _store_exists(store_path):
        return f"{store_path} is no longer there: have its disk back, or its folder"
    remedy = remedy_for_write_error(error, store_path, "see to its disk")
    return f"the store can't be written ({os_error_reason(error, store_path)}): {remedy}"


def _store_exists(store_path: Location) -> bool:
    """Return True if the store's root metadata, zarr.json, exists."""
    return (store_path / "zarr.json").exists()
