"""A study from its first block to its last: run, resume, commit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sweep.tasks import identity
from sweep.tasks.errors import ClusterError, StoreError
from sweep.tasks.evaluate import Evaluate
from sweep.tasks.grid import Grid
from sweep.tasks.journal import Journal, committed
from sweep.tasks.lock import Lock
from sweep.tasks.progress import Progress, chosen
from sweep.tasks.session import Outcome, Place, Session
from sweep.tasks.store import create, remove

if TYPE_CHECKING:
    from distributed import Client

    from sweep.spec import Spec


def run(
    spec: Spec,
    *,
    store: str | Path,
    client: Client | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    processes: bool = True,
    overwrite: bool = False,
    progress: bool | Progress = True,
    evaluate: Evaluate | None = None,
) -> Outcome:
    """Compute a study into a new store.

    Parameters
    ----------
    spec, store
        The study, and the path of the store to make.
    client
        Dask client to compute with; without one, `scheduler` and `workers` say what to use.
    workers, processes
        Workers to start on this machine, default all cores, as processes or as threads.
    scheduler
        Address of a Dask scheduler, or "none" for a plain loop in this process.
    overwrite
        Whether to put the new store in the place of one that is there.
    progress
        True for a bar or lines on standard error, False for none, or a `Progress`.
    evaluate
        What computes a block in place of the model, with the same results; for instrumenting.

    Returns
    -------
    Outcome
        Complete, or why not; `resume` goes on from there.

    Raises
    ------
    StoreError, ClusterError
        Where a store is in the way or can't be written; where no scheduler or worker is to be had.
    """
    path, grid = Path(store).absolute(), Grid(spec)
    place = Place(
        client=client, workers=workers, scheduler=scheduler, processes=processes, evaluate=evaluate
    )
    _make(path, spec, grid, overwrite)
    try:
        return _go_on(path, grid, place.for_spec(spec), chosen(progress))
    except ClusterError:
        remove(path)  # nothing was computed, and the next try should not meet it
        raise


def resume(
    store: str | Path,
    *,
    spec: Spec | None = None,
    client: Client | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    processes: bool = True,
    progress: bool | Progress = True,
    evaluate: Evaluate | None = None,
) -> Outcome:
    """Compute what a store lacks.

    Parameters
    ----------
    store
        Path of a store that `run` made.
    spec
        The study that the store is expected to hold; without it, whatever it holds.
    client, workers, scheduler, processes, progress, evaluate
        As in `run`.

    Raises
    ------
    StoreError
        Where the store is not sweep's, holds another study, was begun with other versions, or is
        being written by someone else. Nothing is touched.
    ClusterError
        Where there is no scheduler or worker to be had.
    """
    path = Path(store).absolute()
    attributes, held = identity.read(path)
    if spec is not None:
        identity.refuse_other_study(path, attributes, held, spec)
    identity.refuse_other_versions(path, attributes, where="this machine")
    identity.refuse_altered(path, attributes, held)
    place = Place(
        client=client, workers=workers, scheduler=scheduler, processes=processes, evaluate=evaluate
    )
    return _go_on(path, Grid(held), place.for_spec(spec or held), chosen(progress))


def _make(path: Path, spec: Spec, grid: Grid, overwrite: bool) -> None:
    if path.exists() and overwrite:
        identity.read_attributes(path)  # what is not a store of ours is not ours to remove
        lock = Lock(path)  # refuses where someone writes to it
        remove(path)
        lock.release()
    elif path.exists():
        attributes, held = identity.read(path)
        identity.refuse_other_study(path, attributes, held, spec)
        done = int(np.count_nonzero(committed(path, grid)))
        raise StoreError(
            f"{path} holds this study already, {done} of {grid.n_blocks} blocks done: "
            f"`sweep resume {path}` goes on with it, --overwrite begins anew"
        )
    create(path, spec, grid)


def _go_on(path: Path, grid: Grid, place: Place, progress: Progress) -> Outcome:
    lock = Lock(path)
    try:
        journal = Journal(path)
        try:
            return Session(path, grid, place, progress, journal, lock).to_its_end()
        finally:
            journal.close()
    finally:
        lock.release()
