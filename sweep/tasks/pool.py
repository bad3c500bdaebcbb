"""Where blocks are computed: a plain loop, a given cluster, or workers started when needed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from sweep.spec.clusters import Address, AnyCluster, Local, LocalWorker
from sweep.tasks import cluster
from sweep.tasks.cluster import Reached
from sweep.tasks.errors import ClusterError
from sweep.tasks.performance import reported
from sweep.tasks.todo import Todo
from sweep.tasks.window import Job, Seen, Window, plain
from sweep.tasks.worker import Answer, Terms

if TYPE_CHECKING:
    from distributed import Client

    from sweep.spec import SceneSpec, Spec


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where and how blocks are computed; nothing of it shows in the results."""

    client: Client | None = None
    workers: int | None = None
    scheduler: str | None = None
    cluster: AnyCluster | None = None
    processes: bool = True
    terms: Terms = field(default_factory=Terms)
    performance_report: Path | None = None

    def for_spec(self, spec: Spec | SceneSpec) -> Place:
        """The same place, with what it leaves open taken from the spec's `execution`.

        Raises
        ------
        ClusterError
            Where both a scheduler and a cluster are named, or workers that are not ours to start.
        """
        if self.cluster is not None:
            if self.scheduler is not None:
                raise ClusterError("a scheduler and a cluster are both named: leave out one")
            return replace(self, cluster=cluster.of_workers(self.cluster, self.workers))
        scheduler, execution = self.scheduler, spec.execution
        if scheduler is None and self.workers is None:
            scheduler = execution.scheduler or None
        if scheduler is not None:
            address = Address.model_construct(kind="scheduler", address=scheduler, security=None)
            return replace(self, scheduler=scheduler, cluster=address)
        here = Local(kind="local", worker=LocalWorker(threads=execution.threads))
        workers = self.workers or execution.workers or None
        return replace(self, cluster=cluster.of_workers(here, workers))


class Pool:
    """A place in use: its workers serve one study after another, and end with it.

    Parameters
    ----------
    place
        Where to compute.
    most
        Blocks of the largest study: more workers than that are not started.
    say
        Takes the dashboard's address.
    """

    def __init__(self, place: Place, *, most: int, say: Callable[[str], None]) -> None:
        self._place, self._most, self._say = place, most, say
        self._stack = ExitStack()
        self._reached: Reached | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    @property
    def terms(self) -> Terms:
        """How blocks are computed."""
        return self._place.terms

    @property
    def is_plain(self) -> bool:
        """Tell whether blocks are computed in a plain loop, without workers."""
        return self._place.client is None and self._place.scheduler == cluster.NONE

    def connect(self) -> None:
        """Reach the workers now, not with the first study.

        Raises
        ------
        ClusterError
            Where there is no scheduler or worker to be had.
        """
        if not self.is_plain:
            self._connected()

    def answers(
        self, job: Job, todo: Todo, stopping: Callable[[], bool], seen: Seen
    ) -> Iterator[Answer]:
        """Answers of a study's blocks as they arrive; `seen` tells what is in the store here.

        Raises
        ------
        ClusterError
            Where there is no scheduler or worker to be had.
        """
        if self.is_plain:
            if self._place.performance_report is not None:
                self._say("no performance report: a plain loop has no scheduler to tell of it")
            return plain(job, todo, stopping, seen)
        client, slots, _ = self._connected()
        return Window(client, slots, job, todo, seen=seen, say=self._say).answers(stopping)

    def revive(self) -> None:
        """Start workers of this machine again that are gone."""
        if self._reached is not None:
            self._reached.revive()

    def _connected(self) -> Reached:
        if self._reached is None:
            self._reached = self._reach()
            if (file := self._place.performance_report) is not None:
                self._stack.enter_context(reported(self._reached.client, file, self._say))
        return self._reached

    def _reach(self) -> Reached:
        place = self._place
        if place.client is not None:
            if place.client.asynchronous:
                raise ClusterError("the client is asynchronous: give one of another kind, Client()")
            return Reached(place.client, 0)
        assert place.cluster is not None  # for_spec saw to it
        return self._stack.enter_context(
            cluster.connected(
                place.cluster, most=self._most, processes=place.processes, say=self._say
            )
        )
