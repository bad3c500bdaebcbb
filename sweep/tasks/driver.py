"""A study from its first block to its last: run, resume, commit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.storage.atomic_replace import beside, put, real, replaced_by, settle
from sweep.storage.locations import PACKED, Location, located
from sweep.storage.opening import study_id
from sweep.tasks import identity, studies, user_code
from sweep.tasks.casting import cast, eyepoints_are_sound
from sweep.tasks.cluster import declared
from sweep.tasks.errors import ClusterError, StoreError
from sweep.tasks.eyepoint_study import EyepointStudy
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.interrupt import Interrupts
from sweep.tasks.journal import Journal, committed, receipted
from sweep.tasks.lock import Lock
from sweep.tasks.pool import Place, Pool
from sweep.tasks.progress import Progress, chosen, working
from sweep.tasks.recipe import (
    CODE,
    EXTENDS,
    REPLACES,
    forget_older,
    read_recipe,
    refuse_damaged_recipe,
    write_recipe,
)
from sweep.tasks.reuse import changed, refuse_unlike, what_is_there
from sweep.tasks.session import Outcome, Session, unwritable
from sweep.tasks.store import create, remove, sync
from sweep.tasks.study import Evaluate
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
        Whether to put the new store in the place of one that is there, once it is complete.
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
    path, told = real(located(store)), chosen(progress)
    user_code.check(spec)
    place = Place(
        client=client, workers=workers, scheduler=scheduler, cluster=_declared(cluster),
        processes=processes, terms=Terms(evaluate, block_timeout, durable),
        performance_report=None if performance_report is None else Path(performance_report),
    ).for_spec(spec)  # fmt: skip
    if not overwrite:
        _refuse_in_the_way(path, studies.study_of(spec, path))
    return _into(path, spec, place, told, replace=overwrite, anew=True)


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
    """Compute what a store lacks; where it is being extended or replaced, what the new one lacks.

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
    named = real(located(store))
    named = replaced_by(named) if isinstance(named, Path) else named
    path = identity.under_way(named) or named
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
        extends = read_recipe(path).get(EXTENDS)
        return _into(
            named, spec or study.spec, place, chosen(progress), replace=True, anew=False,
            extends=extends and located(extends), retry_failed=retry_failed,
        )  # fmt: skip
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
    path, told = real(located(store)), chosen(progress)
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
    goal = path if to is None else real(located(to))
    if not overwrite:
        identity.under_way(goal)
    return _into(
        goal, asked, place, told, replace=overwrite or goal == path, anew=overwrite, extends=path
    )


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


def _refuse_in_the_way(path: Location, study: GridStudy | FlightStudy) -> None:
    """Refuse a place in which there is something, or for which something is under way."""
    new = identity.under_way(path)
    if path.exists():
        attributes, held = _held(path)
        identity.refuse_other_study(path, attributes, held.spec, study.spec)
        done = int(np.count_nonzero(receipted(path, study)))
        said = f"{path} holds this study already, {done} of {study.n_blocks} blocks done"
    elif new:
        said = f"a study is under way in {new}"
    else:
        return
    raise StoreError(f"{said}: `sweep resume {path}` goes on with it, --overwrite begins anew")


def _into(
    path: Location,
    asked: Declared,
    place: Place,
    told: Progress,
    *,
    replace: bool,
    anew: bool,
    extends: Location | None = None,
    retry_failed: bool = False,
) -> Outcome:
    """Compute a study into its place, or beside a store whose place it takes once it is complete.

    Parameters
    ----------
    path, asked
        The place, and the study.
    replace
        Whether a store that is there is to be replaced.
    anew
        Whether to begin anew where the study was begun.
    extends
        The store of a smaller study, whose results are taken.
    """
    settle(path)
    new, facts = path, _facts(asked)
    with ExitStack() as stack:
        if replace and path.exists():
            identity.refuse_to_replace(path)
            stack.callback(Lock(path).release)
        if replace and isinstance(path, Path) and (path.exists() or beside(path).exists()):
            new = beside(path)
            facts[REPLACES] = study_id(path)
        if extends is not None:
            facts[EXTENDS] = str(extends)
        there = new.exists()
        study = studies.study_of(asked, new, extends)
        if there and anew:
            Lock(new).release()  # refuses where someone writes to it
        elif there:
            begun, held = _held(new)
            identity.refuse_other_study(new, begun, held.spec, asked)
            _refuse_unsound(new, begun, held)
            write_recipe(new, **read_recipe(new) | facts)
        if isinstance(study, FlightStudy) and (anew or not there):
            with working("building the scene", told):
                reports = study.reports
            for line in reports:
                told.say(line)

        def prepare(pool: Pool) -> None:
            if there and anew:
                pool.connect()  # what was begun goes when there are workers for what replaces it
            if anew or not there:
                durable = place.terms.durable
                create(new, study, replace=there, recipe=facts, durable=durable)
            if extends is not None:
                told.say(what_is_there(new, study))
            if new != path:
                told.say(f"{path} stays as it is until {new} is complete and takes its place")

        try:
            outcome = _go_on(new, study, place, told, prepare=prepare, retry_failed=retry_failed)
        except ClusterError:
            if not there:
                remove(new)  # nothing was computed, and the next try should not meet it
            raise
        if outcome.complete and isinstance(path, Path) and new == beside(path):
            _succeed(path, durable=place.terms.durable)
            return dataclasses.replace(outcome, store=path)
        return outcome


def _succeed(path: Path, *, durable: bool) -> None:
    """Put the complete store beside a place, which the caller has locked, into it."""
    new = beside(path)
    try:
        if durable:
            sync(new)
        put(new, path)
        forget_older(path)  # where it stands now it extends and replaces nothing
    except OSError as error:
        raise StoreError(
            f"{new} can't take the place of {path}: {error.strerror or error}"
        ) from error


def _facts(spec: Declared) -> dict[str, str]:
    """Places of a study's files, for the recipe of its store."""
    base = getattr(spec, "base", None)
    return {} if base is None else {"base": str(base.absolute())}


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
    prepare: Callable[[Pool], None] = lambda pool: None,
) -> Outcome:
    with (
        Interrupts() as interrupts,
        ExitStack() as stack,  # the lock goes when the workers are gone
        Pool(place, most=study.n_blocks, say=told.say) as pool,
    ):
        prepare(pool)
        lock = Lock(path)
        stack.callback(lock.release)
        _tell_changed_code(path, study.spec, told)
        session = Session(
            path, study, pool=pool, progress=told, interrupts=interrupts,
            journal=_journal(path, place.terms.durable), lock=lock, retry_failed=retry_failed,
        )  # fmt: skip
        if isinstance(study, GridStudy):
            return session.to_its_end()
        write_recipe(path, **read_recipe(path) | _facts(study.spec))
        if _is_done(path, study) and eyepoints_are_sound(study):
            return session.to_its_end()
        rays, why = cast(
            study, pool=pool, told=told, interrupts=interrupts, retry_failed=retry_failed
        )
        return session.to_its_end(before=why, rays=rays)


def _is_done(path: Location, study: FlightStudy) -> bool:
    """Whether no block is missing; the folders are looked at only where the log says so."""
    return bool(receipted(path, study).all() and committed(path, study).all())


def _journal(path: Location, durable: bool) -> Journal:
    try:
        return Journal(path, durable=durable)
    except OSError as error:
        raise StoreError(unwritable(path, error)) from error
