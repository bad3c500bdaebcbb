"""A study from its first block to its last, and its rays before: run, resume, extend."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from sweep.messages import counted, option, suggestion
from sweep.spec import SceneSpec, Spec
from sweep.storage.locations import (
    PACKED,
    Location,
    eyepoints_path,
    is_free,
    located,
    real,
    replaced_by,
    settle,
    successor,
    take_place,
)
from sweep.storage.opening import read_attributes, study_id
from sweep.tasks import studies
from sweep.tasks.coverage import refuse_blind
from sweep.tasks.eyepoint_study import EyepointStudy, world_of
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.journal import (
    CODE,
    EXTENDS,
    REPLACES,
    Lock,
    committed,
    forget_older,
    read_recipe,
    receipted,
    refuse_damaged_recipe,
    wait_for_silence,
    write_recipe,
)
from sweep.tasks.memory import refuse_too_large_blocks, refuse_too_large_study
from sweep.tasks.progress import BusyError, ClusterError, StoreError, chosen, told, working
from sweep.tasks.session import Outcome, Pool, RunOptions, Session
from sweep.tasks.store import (
    create,
    refuse_damaged,
    refuse_foreign_files,
    refuse_other_study,
    refuse_other_versions,
    refuse_to_replace,
    remove,
    sync,
    under_way,
)
from sweep.tasks.studies import Declared, changed, refuse_unlike, what_is_there
from sweep.tasks.study import own_functions

#: Seconds between looks at rays that another run casts.
WAITING = 0.5


def run(
    spec: Declared,
    *,
    store: str | Location,
    overwrite: bool = False,
    resume: bool = False,
    **options: Any,
) -> Outcome:
    """Compute a study into a new store.

    Parameters
    ----------
    spec, store
        The study, and the path of the store to make: on disk, or `s3://bucket/key.zarr` (gs, az).
    overwrite
        Whether to put the new store in the place of one that is there, once it is complete.
    resume
        Whether to go on where the store is there already, and holds this study; complete, it stays
        as it is. So the same call serves a job each time that it is started.
    **options
        Where and how to compute, by the names of :class:`sweep.tasks.session.RunOptions`:
        ``workers=4``, ``client=...``, ``progress=False`` and so on.

    Returns
    -------
    Outcome
        Complete, or why not; `resume` goes on from there.

    Warns
    -----
    StudyWarning
        Of what can be computed, but is hardly meant: a beam that its aperture can't make, a flight
        that partly sees nothing, echoes after their record, effects switched off that matter.

    Raises
    ------
    StoreError, ClusterError, CodeError
        Where a store, or one of another study, is in the way or can't be written; where no
        scheduler or worker is to be had; where the study names a function that may not run
        (:mod:`sweep.tasks.user_code`).
    """
    path, how = real(located(store)), RunOptions.of(options)
    if overwrite and resume:
        raise ValueError("overwrite begins anew, and resume goes on: give one of them")
    _refuse_no_study(spec)
    _check_code(spec)
    if resume and (not is_free(path) or under_way(path)):
        wait_for_silence(under_way(path) or path, chosen(how.progress).say)
        return _resume(path, spec, how)
    pool, study = Pool(how, spec), studies.study_of(spec, path)
    if not overwrite:
        _refuse_in_the_way(path, study)
    _hold_against_memory(study, pool)
    from sweep.tasks.doubts import tell_doubts  # the model's kernels

    tell_doubts(study, pool.told.say)
    return _into(path, spec, pool, replace=overwrite, anew=True)


def resume(store: str | Location, *, spec: Declared | None = None, **options: Any) -> Outcome:
    """Compute what a store lacks; where it is being extended or replaced, what the new one lacks.

    Parameters
    ----------
    store
        Where a store is that `run` made.
    spec
        The study that the store is expected to hold; without it, whatever it holds.
    **options
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
    named, how = real(located(store)), RunOptions.of(options)
    if spec is not None:
        _refuse_no_study(spec)
    return _resume(named, spec, how)


def _resume(named: Location, spec: Declared | None, how: RunOptions) -> Outcome:
    """As :func:`resume`, of a place that no link leads to."""
    named = replaced_by(named) if isinstance(named, Path) else named
    path = under_way(named) or named
    attributes, study = _held(path)
    if spec is not None:
        refuse_other_study(path, attributes, study.spec, spec)
    _refuse_unsound(path, attributes, study)
    _check_code(study.spec)
    if spec is None:
        refuse_damaged_recipe(path)
    else:
        study = studies.study_of(spec, path)  # it knows where its files are
    pool = Pool(how, study.spec)
    if path == named:
        return _go_on(path, study, pool)
    extends = read_recipe(path).get(EXTENDS)
    return _into(
        named, study.spec, pool, replace=True, anew=False, extends=extends and located(extends)
    )


def extend(
    store: str | Location,
    spec: Declared | None = None,
    *,
    changes: Mapping[str, Any] | None = None,
    to: str | Location | None = None,
    overwrite: bool = False,
    **options: Any,
) -> Outcome:
    """Turn a store into that of a larger study, and compute only what is new.

    The larger study has further values on its axes, further axes, more draws or a tighter
    tolerance. It is computed in the same folder and replaces the store when it is complete; its
    bytes are those of the larger study run at once.

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
    **options
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
    path, how = real(located(store)), RunOptions.of(options)
    if spec is not None:
        _refuse_no_study(spec)
    attributes, older = _held(path)
    asked = changed(older.spec if spec is None else spec, changes or {})
    _check_code(asked)
    pool = Pool(how, asked)
    _refuse_unsound(path, attributes, older)
    if asked.id == attributes["study_id"]:
        pool.told.say(f"nothing to extend: {path} holds this very study")
        return _go_on(path, older, pool)
    refuse_unlike(path, older.spec, asked)
    goal = path if to is None else real(located(to))
    if not overwrite:
        under_way(goal)
    study = studies.study_of(asked, goal)
    _hold_against_memory(study, pool)
    from sweep.tasks.doubts import tell_doubts  # the model's kernels

    tell_doubts(study, pool.told.say)
    return _into(goal, asked, pool, replace=overwrite or goal == path, anew=overwrite, extends=path)


def _hold_against_memory(study: GridStudy | FlightStudy, pool: Pool) -> None:
    """Refuse a study that is too large for what computes it, here or once that is reached."""
    pool.study = study
    with working("building the scene", pool.told):
        refuse_too_large_study(study, pool.memory)


def _refuse_no_study(spec: object) -> None:
    """Refuse what is no study, such as the path of its file."""
    if isinstance(spec, Spec | SceneSpec):
        return
    if isinstance(spec, str | os.PathLike):
        how = f"give `sweep.load({str(spec)!r})`"
    else:
        how = "`sweep.load(...)` reads one, `sweep.spec.Spec.from_mapping(...)` makes one"
    raise TypeError(f"a study is needed, not a {type(spec).__name__}: {how}")


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
    refuse_other_versions(path, attributes, where="this machine")
    if study.id != attributes["study_id"]:
        raise StoreError(
            f"{path} holds a spec with id {study.id} but says {attributes['study_id']}: "
            "its attributes were changed after it was made"
        )
    refuse_damaged(path)


def _refuse_in_the_way(path: Location, study: GridStudy | FlightStudy) -> None:
    """Refuse a place in which there is something, or for which something is under way."""
    new, what_next = under_way(path), f"{suggestion('resume', path)} goes on with it"
    if not is_free(path):
        attributes, held = _held(path)
        refuse_other_study(path, attributes, held.spec, study.spec)
        done = int(np.count_nonzero(receipted(path, study)))
        said = f"{path} holds this study already, {done} of {counted(study.n_blocks, 'block')} done"
        if done == study.n_blocks:
            what_next = f"{suggestion('status', path)} tells about it"
    elif new:
        said = f"a study is under way in {new}"
    else:
        return
    raise StoreError(f"{said}: {what_next}, {option('overwrite')} begins anew")


def _into(
    path: Location,
    asked: Declared,
    pool: Pool,
    *,
    replace: bool,
    anew: bool,
    extends: Location | None = None,
) -> Outcome:
    """Compute a study into its place, or beside a store whose place it takes when complete."""
    settle(path)
    new, facts, durable = path, _facts(asked), pool.options.durable
    with ExitStack() as stack:
        if replace and not is_free(path):
            refuse_to_replace(path)
            if anew and path != extends:
                refuse_foreign_files(path)
            stack.callback(Lock(path, pool.told.say).release)
        if replace and isinstance(path, Path) and (not is_free(path) or successor(path).exists()):
            new = successor(path)
            facts[REPLACES] = study_id(path)
        if extends is not None:
            facts[EXTENDS] = str(extends)
        there = not is_free(new)
        study = studies.study_of(asked, new, extends)
        if there and anew:
            Lock(new, pool.told.say).release()  # refuses where someone writes to it
        elif there:
            begun, held = _held(new)
            refuse_other_study(new, begun, held.spec, asked)
            _refuse_unsound(new, begun, held)
            write_recipe(new, **read_recipe(new) | facts)
        if isinstance(asked, SceneSpec) and (anew or not there):
            with working("building the scene", pool.told):
                reports = world_of(asked).reports
                if not _has_eyepoints(new, study):
                    refuse_blind(asked)
            for line in reports:
                pool.told.say(line)

        def prepare() -> None:
            is_created = anew or not there
            if is_created and pool.is_reached_by_address:
                pool.connect()  # its workers' memory may be too small for the study
            elif there and anew and not pool.is_plain:
                pool.connect()  # what was begun goes when there are workers for what replaces it
            if is_created:
                create(new, study, replace=there, recipe=facts, durable=durable)
            if extends is not None:
                pool.told.say(what_is_there(new, study))
            if new != path:
                pool.told.say(f"{path} stays as it is until {new} is complete and takes its place")

        try:
            outcome = _go_on(new, study, pool, prepare)
        except ClusterError:
            if not there:
                remove(new)  # nothing was computed, and the next try should not meet it
            raise
        if outcome.complete and isinstance(path, Path) and new == successor(path):
            _succeed(path, durable=durable)
            return dataclasses.replace(outcome, store=path)
        return outcome


def _succeed(path: Path, *, durable: bool) -> None:
    """Put the complete store beside a place, which the caller has locked, into it."""
    new = successor(path)
    with told(f"{new} can't take the place of {path}"):
        if durable:
            sync(new)
        take_place(new, path)
        forget_older(path)  # where it stands now it extends and replaces nothing


def _has_eyepoints(path: Location, study: GridStudy | FlightStudy) -> bool:
    """Tell whether all eyepoints of a study stored at a path were cast before, or are being so."""
    return isinstance(study, FlightStudy) and all(
        eyepoints_path(path, eyepoints.id).exists() for eyepoints in study.eyepoint_studies()
    )


def _facts(spec: Declared) -> dict[str, str]:
    """Places of a study's files, for the recipe of its store."""
    return {"base": str(spec.base.absolute())} if isinstance(spec, SceneSpec) else {}


def _check_code(spec: Declared) -> None:
    """Import and try the functions that a study names, if any; CodeError where one fails."""
    if any(own_functions(spec)):
        from sweep.tasks.user_code import check

        check(spec)


def _tell_changed_code(path: Location, spec: Declared, say: Callable[[str], None]) -> None:
    """Say which of the user's modules a store, or the one that it extends, was not begun with."""
    if not any(own_functions(spec)):
        return
    from sweep.tasks.user_code import digests

    here = digests(spec)
    recipe = read_recipe(path)
    older = read_recipe(located(recipe[EXTENDS])) if EXTENDS in recipe else {}
    begun = here | older.get(CODE, {}) | recipe.get(CODE, {})
    write_recipe(path, **recipe | {CODE: begun})
    for module in here:
        if begun[module] != here[module]:
            say(
                f"the module {module} has changed since {path} was begun: what was computed before "
                "has the results of the old code. Put it back, or run the study anew"
            )


def _go_on(
    path: Location,
    study: GridStudy | FlightStudy,
    pool: Pool,
    prepare: Callable[[], None] = lambda: None,
) -> Outcome:
    pool.most, pool.study = study.n_blocks, study
    refuse_too_large_blocks(study, pool.memory)
    with pool.interrupts, ExitStack() as stack, pool:  # the lock goes when the workers are gone
        prepare()
        lock = Lock(path, pool.told.say)
        stack.callback(lock.release)
        _tell_changed_code(path, study.spec, pool.told.say)
        session = Session(path, study, pool, lock)
        if isinstance(study, GridStudy):
            return session.run()
        write_recipe(path, **read_recipe(path) | _facts(study.spec))
        if _is_done(path, study):
            return session.run()
        rays, why = _cast(study, pool)
        if any(rays.values()) and not why:  # progress begins anew, at none of the same shots
            pool.told.say("all rays are cast; simulating shots")
        return session.run(before=why, rays=rays)


def _is_done(path: Location, study: FlightStudy) -> bool:
    """Tell whether no block is missing, nor any of those eyepoints that are there."""
    return bool(receipted(path, study).all() and committed(path, study).all()) and all(
        _is_whole(place, eyepoints)
        for eyepoints in study.eyepoint_studies()
        if (place := eyepoints_path(path, eyepoints.id)).exists()
    )


def _cast(study: FlightStudy, pool: Pool) -> tuple[dict[str, int], str]:
    """Cast what is missing of a study's eyepoints; rays by scanner, and why any is missing."""
    rays: dict[str, int] = {}
    for eyepoints in study.eyepoint_studies():
        path, scanner = eyepoints_path(study.path, eyepoints.id), eyepoints.scanner
        rays[scanner] = 0
        if _is_whole(path, eyepoints):
            continue
        _hold_against_memory(study, pool)  # a scene's mistakes are the user's, not a block's
        with ExitStack() as stack:
            if not (lock := _locked(path, eyepoints, pool)):
                del rays[scanner]
                return rays, f"eyepoints of '{scanner}': interrupted"
            stack.callback(lock.release)
            if _is_whole(path, eyepoints):  # another run has cast them meanwhile
                continue
            pool.told.say(f"casting {eyepoints.rays:,} rays through the scanner '{scanner}'")
            spec = eyepoints.spec
            write_recipe(path, spec=spec.to_json(), scanner=scanner, **_facts(spec))
            outcome = Session(path, eyepoints, pool, lock).run()
        rays[scanner] = eyepoints.rays_in(outcome.points_computed)
        if not outcome.complete:
            return rays, f"eyepoints of '{scanner}': {outcome.why}"
    return rays, ""


def _is_whole(path: Location, eyepoints: EyepointStudy) -> bool:
    """Tell whether an eyepoint store is there with all of its blocks."""
    if is_free(path):
        return False
    attributes = read_attributes(path)
    if attributes["study_id"] != eyepoints.id:
        raise StoreError(f"{path} holds other eyepoints than its name says: remove it")
    refuse_other_versions(path, attributes, where="this machine")
    refuse_damaged(path)
    return bool(read_recipe(path)) and bool(committed(path, eyepoints).all())


def _locked(path: Location, eyepoints: EyepointStudy, pool: Pool) -> Lock | None:
    """Lock an eyepoint store, made if need be, once no other run casts; None if interrupted."""
    waiting = False
    while not pool.interrupts.stopping:
        try:
            if is_free(path):
                create(path, eyepoints, durable=pool.options.durable)
            return Lock(path, pool.told.say)
        except BusyError as error:
            if not waiting:
                pool.told.say(f"waiting for rays that another run casts: {error}")
                waiting = True
            time.sleep(WAITING)
    return None
