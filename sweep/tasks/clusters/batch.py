"""Workers in jobs of SLURM or PBS, by dask-jobqueue.

The scheduler is part of the driver; jobs come and go. A worker leaves before its job's time is up,
each at a moment of its own, after handing back what it was at; another job takes its place.
"""

from __future__ import annotations

import asyncio
import shlex
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from distributed.core import Status

from sweep.spec.clusters import Batch, Bounds, Slurm
from sweep.tasks.clusters import machines


@contextmanager
def _signals_kept() -> Iterator[None]:
    """Have this thread set no handlers of signals.

    dask_jobqueue sets one as it is imported, by which Ctrl-C ends the program at once. In any
    thread but the main one that is an error.
    """
    set_handler, thread = signal.signal, threading.get_ident()

    def set_by_others(number: Any, handler: Any) -> Any:
        if threading.get_ident() == thread:
            return signal.getsignal(number)
        return set_handler(number, handler)

    signal.signal = set_by_others  # type: ignore[assignment]
    try:
        yield
    finally:
        signal.signal = set_handler


with _signals_kept():
    from dask_jobqueue import PBSCluster, SLURMCluster
    from dask_jobqueue.pbs import PBSJob
    from dask_jobqueue.slurm import SLURMJob

#: Seconds until a running cluster submits again what was not taken.
PAUSE = 15.0


class _Told:
    """A job that says so where it was not taken."""

    status: Status

    async def start(self) -> None:
        """Submit the job."""
        try:
            await super().start()  # type: ignore[misc]
        except BaseException:
            self.status = Status.failed
            raise


class _TriedAgain:
    """A cluster that lets go of jobs which were not taken, so that others are submitted later."""

    worker_spec: dict[str, Any]
    workers: dict[str, Any]

    async def _correct_state_internal(self) -> None:
        try:
            await super()._correct_state_internal()  # type: ignore[misc]
        except BaseException:
            for name, job in list(self.workers.items()):
                if job.status == Status.failed:
                    del self.workers[name]
                    self.worker_spec.pop(name, None)
            if self.workers:
                await asyncio.sleep(PAUSE)
            raise


class _SlurmJob(_Told, SLURMJob):  # type: ignore[misc]
    pass


class _PBSJob(_Told, PBSJob):  # type: ignore[misc]
    pass


class _SlurmCluster(_TriedAgain, SLURMCluster):  # type: ignore[misc]
    job_cls = _SlurmJob


class _PBSCluster(_TriedAgain, PBSCluster):  # type: ignore[misc]
    job_cls = _PBSJob


def start(cluster: Batch, bounds: Bounds) -> Any:
    """Return the cluster, its least number of workers submitted; RuntimeError if refused."""
    kind = _SlurmCluster if isinstance(cluster, Slurm) else _PBSCluster
    started = kind(**options(cluster))
    try:
        started.sync(_submit, started, jobs(cluster, bounds.least))
    except BaseException:
        started.close()
        raise
    return started


def keep(started: Any, cluster: Batch, bounds: Bounds) -> None:
    """Submit jobs in the place of those that end, and more or fewer with the work, in bounds."""
    least, most = (jobs(cluster, number) for number in bounds)
    started.adapt(minimum_jobs=least, maximum_jobs=most, target_duration=machines.WORK_AHEAD)


async def _submit(cluster: Any, number: int) -> None:
    """Submit jobs, and wait for the batch system to take them."""
    while len(cluster.worker_spec) < number:
        cluster.worker_spec.update(cluster.new_worker_spec())
    await cluster


def jobs(cluster: Batch, workers: int) -> int:
    """Jobs that hold so many workers."""
    return -(-workers // cluster.job.workers)


def options(cluster: Batch) -> dict[str, Any]:
    """Arguments of dask-jobqueue's clusters."""
    worker, job = cluster.worker, cluster.job
    lifetime, stagger = lifetime_of(job.walltime)
    given: dict[str, Any] = {
        "n_workers": 0,
        "cores": job.workers * worker.threads,
        "processes": job.workers,
        "memory": f"{int(job.workers * worker.memory)}B",
        "walltime": clock(job.walltime),
        "job_name": "sweep",
        "log_directory": job.logs or None,
        "job_extra_directives": list(job.directives),
        "job_script_prologue": [
            *job.prologue,
            *(
                f"export {name}={shlex.quote(value)}"
                for name, value in machines.environment(cluster.environment).items()
            ),
        ],
        "worker_extra_args": [
            *("--preload", machines.PRELOAD, "--no-dashboard"),
            *("--lifetime", f"{lifetime:.0f}s", "--lifetime-stagger", f"{stagger:.0f}s"),
        ],
        "security": machines.security_of(cluster),
        "scheduler_options": machines.scheduler_options(cluster.scheduler),
    }
    named = {"queue": job.queue, "account": job.account, "python": cluster.python}
    return given | {name: value for name, value in named.items() if value}


def lifetime_of(walltime: float) -> tuple[float, float]:
    """Mean time [s] after which a worker leaves its job, and how far that is spread each way.

    The last leaves with 5 % of the walltime in hand: a minute at least, a quarter of very short
    ones.
    """
    in_hand = max(0.05 * walltime, min(60.0, walltime / 4))
    return walltime - 1.5 * in_hand, in_hand / 2


def clock(seconds: float) -> str:
    """Hours, minutes and seconds as batch systems write them."""
    whole = int(seconds)
    return f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}"
