"""Workers in jobs of SLURM or PBS, by dask-jobqueue.

The scheduler runs in the process of the driver. Before a job reaches its time limit, its workers
finish their tasks and leave, each at a different time. Another job then replaces it.
"""

from __future__ import annotations

import asyncio
import shlex
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from distributed.core import Status

from sweep.spec.cluster_config import BatchClusterConfig, SlurmClusterConfig, WorkerBounds
from sweep.tasks.engine.deploy import local_ssh


@contextmanager
def _keep_signal_handlers() -> Iterator[None]:
    """Context manager that keeps this thread's signal handlers while dask_jobqueue is imported.

    dask_jobqueue sets a handler on import, so that Ctrl-C would end the program at once. Setting it
    raises an error in any thread but the main one.
    """
    set_handler, protected_thread = signal.signal, threading.get_ident()

    def set_by_others(signal_number: Any, handler: Any) -> Any:
        if threading.get_ident() == protected_thread:
            return signal.getsignal(signal_number)
        return set_handler(signal_number, handler)

    signal.signal = set_by_others  # type: ignore[assignment]
    try:
        yield
    finally:
        signal.signal = set_handler


with _keep_signal_handlers():
    from dask_jobqueue import PBSCluster, SLURMCluster
    from dask_jobqueue.pbs import PBSJob
    from dask_jobqueue.slurm import SLURMJob

#: Time after which a running cluster submits a rejected job again [s].
RESUBMIT_PAUSE_SECONDS = 15.0


class _RejectableJob:
    """Batch job whose status becomes `failed` if the batch system rejects it."""

    status: Status

    async def start(self) -> None:
        """Submit the job to the batch system, and record whether it is rejected."""
        try:
            await super().start()  # type: ignore[misc]
        except BaseException:
            self.status = Status.failed
            raise


class _ResubmittingCluster:
    """Cluster that forgets rejected batch jobs, so that other jobs are submitted later."""

    worker_spec: dict[str, Any]
    workers: dict[str, Any]

    async def _correct_state_internal(self) -> None:
        """Start and end jobs as Dask does. After an error, forget rejected jobs, and wait.

        The error is raised at the end of the wait.
        """
        try:
            await super()._correct_state_internal()  # type: ignore[misc]
        except BaseException:
            for name, job in list(self.workers.items()):
                if job.status == Status.failed:
                    del self.workers[name]
                    self.worker_spec.pop(name, None)
            if self.workers:
                await asyncio.sleep(RESUBMIT_PAUSE_SECONDS)
            raise


class _SlurmJob(_RejectableJob, SLURMJob):  # type: ignore[misc]
    pass


class _PBSJob(_RejectableJob, PBSJob):  # type: ignore[misc]
    pass


class _SlurmCluster(_ResubmittingCluster, SLURMCluster):  # type: ignore[misc]
    job_cls = _SlurmJob


class _PBSCluster(_ResubmittingCluster, PBSCluster):  # type: ignore[misc]
    job_cls = _PBSJob


def start_batch_cluster(cluster: BatchClusterConfig, bounds: WorkerBounds) -> Any:
    """Start a Dask cluster on a batch system, and return it.

    Jobs are submitted for the least number of workers in `bounds`. RuntimeError is raised if the
    batch system rejects the jobs.
    """
    cluster_class = _SlurmCluster if isinstance(cluster, SlurmClusterConfig) else _PBSCluster
    dask_cluster = cluster_class(**jobqueue_options(cluster))
    try:
        dask_cluster.sync(_submit_jobs, dask_cluster, jobs_needed(cluster, bounds.least))
    except BaseException:
        dask_cluster.close()
        raise
    return dask_cluster


def keep_workers_in_bounds(
    dask_cluster: Any, cluster: BatchClusterConfig, bounds: WorkerBounds
) -> None:
    """Have Dask replace jobs that end, and adapt the number of jobs to the work within bounds."""
    jobs_min, jobs_max = (jobs_needed(cluster, n_workers) for n_workers in bounds)
    dask_cluster.adapt(
        minimum_jobs=jobs_min,
        maximum_jobs=jobs_max,
        target_duration=local_ssh.ADAPTIVE_TARGET_DURATION,
    )


async def _submit_jobs(dask_cluster: Any, n_jobs: int) -> None:
    """Submit jobs until there are `n_jobs`, and wait for the batch system to accept them."""
    while len(dask_cluster.worker_spec) < n_jobs:
        dask_cluster.worker_spec.update(dask_cluster.new_worker_spec())
    await dask_cluster


def jobs_needed(cluster: BatchClusterConfig, n_workers: int) -> int:
    """Return the number of batch jobs that are needed for `n_workers` workers."""
    return -(-n_workers // cluster.job.workers)


def jobqueue_options(cluster: BatchClusterConfig) -> dict[str, Any]:
    """Return the keyword arguments for the cluster classes of dask-jobqueue."""
    worker, job = cluster.worker, cluster.job
    lifetime = worker_lifetime(job.walltime)
    required_options: dict[str, Any] = {
        "n_workers": 0,
        "cores": job.workers * worker.threads,
        "processes": job.workers,
        "memory": f"{int(job.workers * worker.memory)}B",
        "walltime": walltime_text(job.walltime),
        "job_name": "sweep",
        "log_directory": job.logs or None,
        "job_extra_directives": list(job.directives),
        "job_script_prologue": [
            *job.prologue,
            *(
                f"export {name}={shlex.quote(value)}"
                for name, value in local_ssh.worker_environment(cluster.environment).items()
            ),
        ],
        "worker_extra_args": [
            *("--preload", local_ssh.PRELOAD_MODULE, "--no-dashboard"),
            *("--lifetime", f"{lifetime.mean:.0f}s"),
            *("--lifetime-stagger", f"{lifetime.deviation_max:.0f}s"),
        ],
        "security": local_ssh.make_security(cluster),
        "scheduler_options": local_ssh.scheduler_options(cluster.scheduler),
    }
    optional = {"queue": job.queue, "account": job.account, "python": cluster.python}
    return required_options | {name: value for name, value in optional.items() if value}


class WorkerLifetime(NamedTuple):
    """Time after which a worker leaves its job."""

    mean: float
    """Mean time after which a worker leaves its job [s]."""
    deviation_max: float
    """Largest random deviation from the mean time [s]; it makes workers leave one by one."""


def worker_lifetime(walltime: float) -> WorkerLifetime:
    """Return mean and largest deviation of the time after which a worker leaves its job.

    `walltime` is the job's time limit [s]. The last worker leaves 5 % of the limit before the
    limit, but at least 60 s before. For limits below 240 s it leaves a quarter of the limit before.
    """
    reserve = max(0.05 * walltime, min(60.0, walltime / 4))
    return WorkerLifetime(mean=walltime - 1.5 * reserve, deviation_max=reserve / 2)


def walltime_text(seconds: float) -> str:
    """Return a duration [s] as text `HH:MM:SS`, which batch systems read."""
    whole_seconds = int(seconds)
    return f"{whole_seconds // 3600:02d}:{whole_seconds // 60 % 60:02d}:{whole_seconds % 60:02d}"
