"""A study from its first block to its last: run, resume, commit."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.storage.locations import PACKED, Location, located
from sweep.tasks import identity, studies, user_code
from sweep.tasks.casting import cast, eyepoints_are_sound
from sweep.tasks.cluster import declared
from sweep.tasks.errors import ClusterError, StoreError
from sweep.tasks.extension import changed, refuse_unlike, what_is_there
from sweep.tasks.eyepoint_study import EyepointStudy
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.interrupt import Interrupts
from sweep.tasks.journal import Journal, committed, receipted
from sweep.tasks.lock import Lock
from sweep.tasks.pool import Place, Pool
from sweep.tasks.progress import Progress, chosen, working
from sweep.tasks.recipe import CODE, EXTENDS, read_recipe, refuse_damaged_recipe, write_recipe
from sweep.tasks.session import Outcome, Session, unwritable
from sweep.tasks.store import create, remove, sync
from sweep.tasks.study import Evaluate
from sweep.tasks.succession import beside, succeed, under_way
from sweep.tasks.template import refuse_damaged
from sweep.tasks.worker import Terms

if TYPE_CHECKING:
    from distributed import Client

    from sweep.spec import AnyCluster, SceneSpec, Spec

    Declared = Spec | SceneSpec
    Declaration = str | Path | Mapping[str, Any] | AnyCluster


def run(
    spec: Declared,
    *,
    store: str | Location,
    client: Client | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    cluster: Declaration | None = None,
    processes: bool = True,
    overwrite: bool = False,
    progress: bool | Progress = True,
    block_timeout: float | None = None,
    durable: bool = False,
    performance_report: str | Path | None = None,
    evaluate: Evaluate | None = None,
) -> Outcome:
    """Compute a study into a new store.

    Parameters
    ----------
    spec, store
        The study, and the path of the store to make: on disk, or `s3://bucket/key.zarr` (gs, az).
    client
        Dask client to compute with; without one, `scheduler` and `workers` say what to use.
    workers, processes
        Workers to start on this machine, default all cores, as processes or as threads.
    scheduler
        Address of a Dask scheduler, or "none" for a plain loop in this process.
    cluster
        The file that describes a cluster, or what such a file holds; `workers` fixes how many.
    overwrite
        Whether to put the new store in the place of one that is there.
    progress
        True for a bar or lines on standard error, False for none, or a `Progress`.
    block_timeout
        Seconds that a block may take; beyond, it is tried once more and then given up.
    durable
        Whether blocks are on the disk, and not only with the operating system, once committed: a
        power failure then loses none of them.
    performance_report
        HTML file to put Dask's own account of the run into.
    evaluate
        What computes a block in place of the model, with the same results; for instrumenting.

    Returns
    -------
    Outcome
        Complete, or why not; `resume` goes on from there.

    Raises
    ------
    StoreError, ClusterError, CodeError
        Where a store is in the way or can't be written; where no scheduler or worker is to be had;
        where the study names a function that may not run (:mod:`sweep.tasks.user_code`).
    """
    path, told = located(store).absolute(), chosen(progress)
    user_code.check(spec)
    study = studies.study_of(spec, path)
    place = Place(
        client=client, workers=workers, scheduler=scheduler, cluster=_declared(cluster),
        processes=processes, terms=Terms(evaluate, block_timeout, durable),
        performance_report=None if performance_report is None else Path(performance_report),
    ).for_spec(spec)  # fmt: skip
    _make(path, study, overwrite, told)
    if durable:
        sync(path)
    try:
        return _go_on(path, study, place, told)
    except ClusterError:
        remove(path)  # nothing was computed, and the next try should not meet it
        raise


def resume(
    store: str | Location,
    *,
    spec: Declared | None = None,
    client: Client | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    cluster: Declaration | None = None,
    processes: bool = True,
    retry_failed: bool = False,
    progress: bool | Progress = True,
    block_timeout: float | None = None,
    durable: bool = False,
    performance_report: str | Path | None = None,
    evaluate: Evaluate | None = None,
) -> Outcome:
    """Compute what a store lacks; where it is being extended, what the larger one lacks.

    Parameters
    ----------
    store
        Where a store is that `run` made.
    spec
        The study that the store is expected to hold; without it, whatever it holds.
    retry_failed
        Whether to try blocks again that were given up, for their errors, in an earlier run.
    client, workers, scheduler, cluster, processes, progress, block_timeout, durable,
    performance_report, evaluate
        As in `run`.

    Raises
    ------
    StoreError
        Where the store is not sweep's, holds another study, was begun with other versions, is
        damaged in what it held before there were results, or is being written by someone else.
        Nothing is touched.
    ClusterError
        Where there is no scheduler or worker to be had.
    """
    named = located(store).absolute()
    path = under_way(named) or named
    attributes, study = _held(path)
    if spec is not None:
        identity.refuse_other_study(path, attributes, study.spec, spec)
    _refuse_unsound(path, attributes, study)
    user_code.check(study.spec)
    asked = study if spec is None else studies.study_of(spec, path)  # it knows where its files are
    if spec is None:
        refuse_damaged_recipe(path)
    place = Place(
        client=client, workers=workers, scheduler=scheduler, cluster=_declared(cluster),
        processes=processes, terms=Terms(evaluate, block_timeout, durable),
        performance_report=None if performance_report is None else Path(performance_report),
    ).for_spec(spec or study.spec)  # fmt: skip
    if path != named:
        told = chosen(progress)
        return _grow(named, path, spec or study.spec, place, told, retry_failed=retry_failed)
    return _go_on(path, asked, place, chosen(progress), retry_failed=retry_failed)


def extend(
    store: str | Location,
    spec: Declared | None = None,
    *,
    changes: Mapping[str, Any] | None = None,
    to: str | Location | None = None,
    client: Client | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    cluster: Declaration | None = None,
    processes: bool = True,
    overwrite: bool = False,
    progress: bool | Progress = True,
    block_timeout: float | None = None,
    durable: bool = False,
    performance_report: str | Path | None = None,
    evaluate: Evaluate | None = None,
) -> Outcome:
    """Turn a store into that of a larger study, and compute only what is new.

    The larger study has further values on its axes, further axes, more draws or a tighter
    tolerance. It is computed beside the store and takes its place when it is complete; its bytes
    are those of the larger study run at once.

    Parameters
    ----------
    store
        Where a store is that `run` made, complete or not. It is only read.
    spec
        The larger study; by default what the store holds.
    changes
        What is different in it, by dotted path: ``{"axes.target.range": ["1 km", "2 km"]}``.
    to
        Another place for the larger store: the old one then stays. Needed in an object store.
    overwrite
        Whether to begin anew where an extension was begun, or another store is in the place `to`.
    client, workers, scheduler, cluster, processes, progress, block_timeout, durable,
    performance_report, evaluate
        As in `run`.

    Returns
    -------
    Outcome
        Complete, or why not; `extend` or `resume` goes on from there.

    Raises
    ------
    StoreError, ClusterError
        As in `run` and `resume`; where the study asked for is not a larger one.
    """
    path, told = located(store).absolute(), chosen(progress)
    under_way(path)
    attributes, older = _held(path)
    asked = changed(older.spec if spec is None else spec, changes or {})
    user_code.check(asked)
    place = Place(
        client=client, workers=workers, scheduler=scheduler, cluster=_declared(cluster),
        processes=processes, terms=Terms(evaluate, block_timeout, durable),
        performance_report=None if performance_report is None else Path(performance_report),
    ).for_spec(asked)  # fmt: skip
    _refuse_unsound(path, attributes, older)
    if asked.id == attributes["study_id"]:
        told.say(f"nothing to extend: {path} holds this very study")
        return _go_on(path, older, place, told)
    refuse_unlike(path, older.spec, asked)
    new = _successor(path, to)
    if overwrite or not new.exists():
        _make(new, studies.study_of(asked, new), overwrite, told)
    begun, held = _held(new)
    identity.refuse_other_study(new, begun, held.spec, asked)
    _refuse_unsound(new, begun, held)
    return _grow(path, new, asked, place, told)


def _declared(cluster: Declaration | None) -> AnyCluster | None:
    return None if cluster is None else declared(cluster)


def _held(path: Location) -> tuple[dict[str, object], GridStudy | FlightStudy]:
    attributes, study = studies.read(path)
    if isinstance(study, EyepointStudy):
        raise StoreError(
            f"{path} holds eyepoints, which the studies that use them cast: run or resume one"
        )
    if PACKED in attributes:
        raise StoreError(
            f"{path} is a packed copy of a complete store: there is nothing to resume, "
            "and what can be extended is the store that it was made of"
        )
    return attributes, study


def _refuse_unsound(
    path: Location, attributes: dict[str, Any], study: GridStudy | FlightStudy
) -> None:
    """Refuse a store of other versions, or one that is not as it was made."""
    identity.refuse_other_versions(path, attributes, where="this machine")
    identity.refuse_altered(path, attributes, study.spec)
    refuse_damaged(path)


def _successor(path: Location, to: str | Location | None) -> Location:
    """Where a larger store is made."""
    if to is not None and located(to).absolute() != path:
        return located(to).absolute()
    if not isinstance(path, Path):
        raise StoreError(
            f"{path} can't be extended in its place, as an object store has no renaming: "
            "name another place for the larger store with --store; this one then stays"
        )
    return beside(path)


def _grow(
    path: Location,
    new: Location,
    asked: Declared,
    place: Place,
    told: Progress,
    *,
    retry_failed: bool = False,
) -> Outcome:
    """Compute what a larger store lacks, and have it succeed the one that it extends."""
    with ExitStack() as stack:
        in_place = isinstance(path, Path) and isinstance(new, Path) and new == beside(path)
        if in_place:
            stack.callback(Lock(path).release)
        _note(new, asked, **{EXTENDS: str(path)})
        study = _held(new)[1]
        told.say(what_is_there(new, study))
        outcome = _go_on(new, study, place, told, retry_failed=retry_failed)
        if outcome.complete and isinstance(path, Path) and in_place:
            succeed(path, durable=place.terms.durable)
            return replace(outcome, store=path)
        return outcome


def _make(path: Location, study: GridStudy | FlightStudy, overwrite: bool, told: Progress) -> None:
    if path.exists() and overwrite:
        identity.refuse_foreign(path)  # what is not a store of ours is not ours to remove
        lock = Lock(path)  # refuses where someone writes to it
        remove(path)
        lock.release()
    elif path.exists():
        attributes, held = _held(path)
        identity.refuse_other_study(path, attributes, held.spec, study.spec)
        done = int(np.count_nonzero(receipted(path, study)))
        raise StoreError(
            f"{path} holds this study already, {done} of {study.n_blocks} blocks done: "
            f"`sweep resume {path}` goes on with it, --overwrite begins anew"
        )
    if isinstance(study, FlightStudy):
        with working("building the scene", told):
            reports = study.reports
        for line in reports:
            told.say(line)
    create(path, study)
    _note(path, study.spec)


def _note(path: Location, spec: Declared, **facts: str) -> None:
    """Put down where the files of a store's study are, and what else is to be known of it."""
    if (base := getattr(spec, "base", None)) is not None:
        facts["base"] = str(base.absolute())
    if facts:
        write_recipe(path, **read_recipe(path) | facts)


def _tell_changed_code(path: Location, spec: Declared, told: Progress) -> None:
    """Say which of the user's modules a store, or the one that it extends, was not begun with."""
    if not (here := user_code.digests(spec)):
        return
    recipe = read_recipe(path)
    older = read_recipe(located(recipe[EXTENDS])) if EXTENDS in recipe else {}
    begun = here | older.get(CODE, {}) | recipe.get(CODE, {})
    write_recipe(path, **recipe | {CODE: begun})
    for module in here:
        if begun[module] != here[module]:
            told.say(
                f"the module {module} has changed since {path} was begun: what was computed before "
                "has the results of the old code. Put it back, or run the study anew"
            )


def _go_on(
    path: Location,
    study: GridStudy | FlightStudy,
    place: Place,
    told: Progress,
    *,
    retry_failed: bool = False,
) -> Outcome:
    lock, most = Lock(path), study.n_blocks
    try:
        journal = _journal(path, place.terms.durable)
        _tell_changed_code(path, study.spec, told)
        with Interrupts() as interrupts, Pool(place, most=most, say=told.say) as pool:
            session = Session(
                path, study, pool=pool, progress=told, interrupts=interrupts,
                journal=journal, lock=lock, retry_failed=retry_failed,
            )  # fmt: skip
            if isinstance(study, GridStudy):
                return session.to_its_end()
            _note(path, study.spec)
            if _is_done(path, study) and eyepoints_are_sound(study):
                return session.to_its_end()
            rays, why = cast(
                study, pool=pool, told=told, interrupts=interrupts, retry_failed=retry_failed
            )
            return session.to_its_end(before=why, rays=rays)
    finally:
        lock.release()


def _is_done(path: Location, study: FlightStudy) -> bool:
    """Whether no block is missing; the folders are looked at only where the log says so."""
    return bool(receipted(path, study).all() and committed(path, study).all())


def _journal(path: Location, durable: bool) -> Journal:
    try:
        return Journal(path, durable=durable)
    except OSError as error:
        raise StoreError(unwritable(path, error)) from error
