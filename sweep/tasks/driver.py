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

from sweep.messages import counted, option_text, suggestion
from sweep.spec import GridSpec, SceneSpec
from sweep.storage.locations import (
    PACKED_ATTRIBUTE,
    Location,
    eyepoints_path,
    final_path_for,
    is_free,
    parse_location,
    recover_interrupted_replace,
    replace_path,
    resolve_links,
    staging_path_for,
)
from sweep.storage.store_format import read_attributes, read_study_id
from sweep.tasks.engine.blocks import user_functions
from sweep.tasks.engine.journal import (
    EXTENDS_KEY,
    REPLACES_KEY,
    USER_CODE_KEY,
    StoreLock,
    blocks_with_receipt,
    committed_blocks,
    read_recipe,
    refuse_damaged_recipe,
    remove_recipe_predecessors,
    wait_for_stale_lock,
    write_recipe,
)
from sweep.tasks.engine.progress import (
    BusyError,
    ClusterError,
    StoreError,
    make_progress,
    raise_as_store_error,
    show_activity,
)
from sweep.tasks.engine.session import ComputeBackend, Outcome, RunOptions, Session
from sweep.tasks.engine.study_store import (
    create_store,
    pending_replacement,
    refuse_damaged_template,
    refuse_foreign_files,
    refuse_other_study,
    refuse_other_versions,
    refuse_to_replace,
    remove_store,
    sync_to_disk,
)
from sweep.tasks.studies import study_loading
from sweep.tasks.studies.eyepoint_study import EyepointStudy, build_world
from sweep.tasks.studies.flight_coverage import refuse_flight_without_hits
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.studies.memory_limits import refuse_too_large_blocks, refuse_too_large_study
from sweep.tasks.studies.study_loading import (
    AnySpec,
    apply_changes,
    refuse_not_larger_study,
    reusable_points_text,
)

#: Seconds between looks at rays that another run casts.
EYEPOINT_LOCK_POLL_SECONDS = 0.5


def run(
    spec: AnySpec,
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
        Where and how to compute, by the names of :class:`sweep.tasks.engine.session.RunOptions`:
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
        (:mod:`sweep.tasks.studies.user_functions`).
    """
    final_path, run_options = resolve_links(parse_location(store)), RunOptions.from_mapping(options)
    if overwrite and resume:
        raise ValueError("overwrite begins anew, and resume goes on: give one of them")
    _check_spec_type(spec)
    _check_user_functions(spec)
    if resume and (not is_free(final_path) or pending_replacement(final_path)):
        wait_for_stale_lock(
            pending_replacement(final_path) or final_path, make_progress(run_options.progress).say
        )
        return _resume(final_path, spec, run_options)
    backend, study = ComputeBackend(run_options, spec), study_loading.make_study(spec, final_path)
    if not overwrite:
        _refuse_existing_store(final_path, study)
    _check_memory(study, backend)
    from sweep.tasks.studies.study_warnings import issue_study_warnings  # the model's kernels

    issue_study_warnings(study, backend.progress.say)
    return _run_into(final_path, spec, backend, replace_existing=overwrite, from_scratch=True)


def resume(store: str | Location, *, spec: AnySpec | None = None, **options: Any) -> Outcome:
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
    final_path, run_options = resolve_links(parse_location(store)), RunOptions.from_mapping(options)
    if spec is not None:
        _check_spec_type(spec)
    return _resume(final_path, spec, run_options)


def _resume(final_path: Location, spec: AnySpec | None, run_options: RunOptions) -> Outcome:
    """As :func:`resume`, of a place that no link leads to."""
    final_path = final_path_for(final_path) if isinstance(final_path, Path) else final_path
    working_path = pending_replacement(final_path) or final_path
    attributes, study = _read_resumable_study(working_path)
    if spec is not None:
        refuse_other_study(working_path, attributes, study.spec, spec)
    _refuse_altered_store(working_path, attributes, study)
    _check_user_functions(study.spec)
    if spec is None:
        refuse_damaged_recipe(working_path)
    else:
        study = study_loading.make_study(spec, working_path)  # it knows where its files are
    backend = ComputeBackend(run_options, study.spec)
    if working_path == final_path:
        return _compute_missing(working_path, study, backend)
    source = read_recipe(working_path).get(EXTENDS_KEY)
    return _run_into(
        final_path,
        study.spec,
        backend,
        replace_existing=True,
        from_scratch=False,
        source_path=source and parse_location(source),
    )


def extend(
    store: str | Location,
    spec: AnySpec | None = None,
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
    source_path, run_options = (
        resolve_links(parse_location(store)),
        RunOptions.from_mapping(options),
    )
    if spec is not None:
        _check_spec_type(spec)
    attributes, source_study = _read_resumable_study(source_path)
    target_spec = apply_changes(source_study.spec if spec is None else spec, changes or {})
    _check_user_functions(target_spec)
    backend = ComputeBackend(run_options, target_spec)
    _refuse_altered_store(source_path, attributes, source_study)
    if target_spec.id == attributes["study_id"]:
        backend.progress.say(f"nothing to extend: {source_path} holds this very study")
        return _compute_missing(source_path, source_study, backend)
    refuse_not_larger_study(source_path, source_study.spec, target_spec)
    final_path = source_path if to is None else resolve_links(parse_location(to))
    if not overwrite:
        pending_replacement(final_path)
    target_study = study_loading.make_study(target_spec, final_path)
    _check_memory(target_study, backend)
    from sweep.tasks.studies.study_warnings import issue_study_warnings  # the model's kernels

    issue_study_warnings(target_study, backend.progress.say)
    return _run_into(
        final_path,
        target_spec,
        backend,
        replace_existing=overwrite or final_path == source_path,
        from_scratch=overwrite,
        source_path=source_path,
    )


def _check_memory(study: GridStudy | FlightStudy, backend: ComputeBackend) -> None:
    """Refuse a study that is too large for what computes it, here or once that is reached."""
    backend.study = study
    with show_activity("building the scene", backend.progress):
        refuse_too_large_study(study, backend.memory)


def _check_spec_type(spec: object) -> None:
    """Refuse what is no study, such as the path of its file."""
    if isinstance(spec, GridSpec | SceneSpec):
        return
    if isinstance(spec, str | os.PathLike):
        remedy = f"give `sweep.load({str(spec)!r})`"
    else:
        remedy = "`sweep.load(...)` reads one, `sweep.spec.GridSpec.from_mapping(...)` makes one"
    raise TypeError(f"a study is needed, not a {type(spec).__name__}: {remedy}")


def _read_resumable_study(
    store_path: Location,
) -> tuple[dict[str, object], GridStudy | FlightStudy]:
    attributes, study = study_loading.read_study(store_path)
    if isinstance(study, EyepointStudy):
        raise StoreError(
            f"{store_path} holds eyepoints, which the studies that use them cast: run or resume one"
        )
    if PACKED_ATTRIBUTE in attributes:
        raise StoreError(
            f"{store_path} is a packed copy of a complete store: there is nothing to resume, "
            "and what can be extended is the store that it was made of"
        )
    return attributes, study


def _refuse_altered_store(
    store_path: Location, attributes: dict[str, Any], study: GridStudy | FlightStudy
) -> None:
    """Refuse a store of other versions, or one that is not as it was made."""
    refuse_other_versions(store_path, attributes, reader="this machine")
    if study.id != attributes["study_id"]:
        raise StoreError(
            f"{store_path} holds a spec with id {study.id} but says {attributes['study_id']}: "
            "its attributes were changed after it was made"
        )
    refuse_damaged_template(store_path)


def _refuse_existing_store(store_path: Location, study: GridStudy | FlightStudy) -> None:
    """Refuse a place in which there is something, or for which something is under way."""
    staging_path, remedy = (
        pending_replacement(store_path),
        f"{suggestion('resume', store_path)} goes on with it",
    )
    if not is_free(store_path):
        attributes, stored_study = _read_resumable_study(store_path)
        refuse_other_study(store_path, attributes, stored_study.spec, study.spec)
        n_blocks_done = int(np.count_nonzero(blocks_with_receipt(store_path, study)))
        problem = (
            f"{store_path} holds this study already, {n_blocks_done} of "
            f"{counted(study.n_blocks, 'block')} done"
        )
        if n_blocks_done == study.n_blocks:
            remedy = f"{suggestion('status', store_path)} tells about it"
    elif staging_path:
        problem = f"a study is under way in {staging_path}"
    else:
        return
    raise StoreError(f"{problem}: {remedy}, {option_text('overwrite')} begins anew")


def _run_into(
    final_path: Location,
    spec: AnySpec,
    backend: ComputeBackend,
    *,
    replace_existing: bool,
    from_scratch: bool,
    source_path: Location | None = None,
) -> Outcome:
    """Compute a study into its place, or beside a store whose place it takes when complete."""
    recover_interrupted_replace(final_path)
    working_path, recipe, durable = final_path, _recipe_facts(spec), backend.options.durable
    with ExitStack() as stack:
        if replace_existing and not is_free(final_path):
            refuse_to_replace(final_path)
            if from_scratch and final_path != source_path:
                refuse_foreign_files(final_path)
            stack.callback(StoreLock(final_path, backend.progress.say).release)
        if (
            replace_existing
            and isinstance(final_path, Path)
            and (not is_free(final_path) or staging_path_for(final_path).exists())
        ):
            working_path = staging_path_for(final_path)
            recipe[REPLACES_KEY] = read_study_id(final_path)
        if source_path is not None:
            recipe[EXTENDS_KEY] = str(source_path)
        already_exists = not is_free(working_path)
        study = study_loading.make_study(spec, working_path, source_path)
        if already_exists and from_scratch:
            StoreLock(
                working_path, backend.progress.say
            ).release()  # refuses where someone writes to it
        elif already_exists:
            stored_attributes, stored_study = _read_resumable_study(working_path)
            refuse_other_study(working_path, stored_attributes, stored_study.spec, spec)
            _refuse_altered_store(working_path, stored_attributes, stored_study)
            write_recipe(working_path, **read_recipe(working_path) | recipe)
        if isinstance(spec, SceneSpec) and (from_scratch or not already_exists):
            with show_activity("building the scene", backend.progress):
                scene_reports = build_world(spec).mesh_reports
                if not _eyepoint_stores_exist(working_path, study):
                    refuse_flight_without_hits(spec)
            for report in scene_reports:
                backend.progress.say(report)

        def prepare() -> None:
            creates_store = from_scratch or not already_exists
            if creates_store and backend.uses_running_scheduler:
                backend.connect()  # its workers' memory may be too small for the study
            elif already_exists and from_scratch and not backend.is_serial:
                backend.connect()  # what was begun goes when there are workers for what replaces it
            if creates_store:
                create_store(
                    working_path,
                    study,
                    replace_existing=already_exists,
                    recipe=recipe,
                    durable=durable,
                )
            if source_path is not None:
                backend.progress.say(reusable_points_text(working_path, study))
            if working_path != final_path:
                backend.progress.say(
                    f"{final_path} stays as it is until {working_path} is complete and takes its "
                    "place"
                )

        try:
            outcome = _compute_missing(working_path, study, backend, prepare)
        except ClusterError:
            if not already_exists:
                remove_store(
                    working_path
                )  # nothing was computed, and the next try should not meet it
            raise
        if (
            outcome.complete
            and isinstance(final_path, Path)
            and working_path == staging_path_for(final_path)
        ):
            _replace_with_staged_store(final_path, durable=durable)
            return dataclasses.replace(outcome, store=final_path)
        return outcome


def _replace_with_staged_store(final_path: Path, *, durable: bool) -> None:
    """Put the complete store beside a place, which the caller has locked, into it."""
    staging_path = staging_path_for(final_path)
    with raise_as_store_error(f"{staging_path} can't take the place of {final_path}"):
        if durable:
            sync_to_disk(staging_path)
        replace_path(staging_path, final_path)
        remove_recipe_predecessors(
            final_path
        )  # where it stands now it extends and replaces nothing


def _eyepoint_stores_exist(store_path: Location, study: GridStudy | FlightStudy) -> bool:
    """Tell whether all eyepoints of a study stored at a path were cast before, or are being so."""
    return isinstance(study, FlightStudy) and all(
        eyepoints_path(store_path, eyepoints.id).exists() for eyepoints in study.eyepoint_studies()
    )


def _recipe_facts(spec: AnySpec) -> dict[str, str]:
    """Places of a study's files, for the recipe of its store."""
    return {"base": str(spec.base.absolute())} if isinstance(spec, SceneSpec) else {}


def _check_user_functions(spec: AnySpec) -> None:
    """Import and try the functions that a study names, if any; CodeError where one fails."""
    if any(user_functions(spec)):
        from sweep.tasks.studies.user_functions import check_user_functions

        check_user_functions(spec)


def _warn_of_changed_user_code(
    store_path: Location, spec: AnySpec, say: Callable[[str], None]
) -> None:
    """Say which of the user's modules a store, or the one that it extends, was not begun with."""
    if not any(user_functions(spec)):
        return
    from sweep.tasks.studies.user_functions import module_digests

    current_digests = module_digests(spec)
    recipe = read_recipe(store_path)
    source_recipe = (
        read_recipe(parse_location(recipe[EXTENDS_KEY])) if EXTENDS_KEY in recipe else {}
    )
    recorded_digests = (
        current_digests | source_recipe.get(USER_CODE_KEY, {}) | recipe.get(USER_CODE_KEY, {})
    )
    write_recipe(store_path, **recipe | {USER_CODE_KEY: recorded_digests})
    for module_name in current_digests:
        if recorded_digests[module_name] != current_digests[module_name]:
            say(
                f"the module {module_name} has changed since {store_path} was begun: what was "
                "computed before "
                "has the results of the old code. Put it back, or run the study anew"
            )


def _compute_missing(
    store_path: Location,
    study: GridStudy | FlightStudy,
    backend: ComputeBackend,
    prepare: Callable[[], None] = lambda: None,
) -> Outcome:
    backend.max_workers, backend.study = study.n_blocks, study
    refuse_too_large_blocks(study, backend.memory)
    with (
        backend.interrupts,
        ExitStack() as stack,
        backend,
    ):  # the lock goes when the workers are gone
        prepare()
        lock = StoreLock(store_path, backend.progress.say)
        stack.callback(lock.release)
        _warn_of_changed_user_code(store_path, study.spec, backend.progress.say)
        session = Session(store_path, study, backend, lock)
        if isinstance(study, GridStudy):
            return session.run()
        write_recipe(store_path, **read_recipe(store_path) | _recipe_facts(study.spec))
        if _is_complete(store_path, study):
            return session.run()
        rays_by_scanner, stop_reason = _cast_missing_eyepoints(study, backend)
        if (
            any(rays_by_scanner.values()) and not stop_reason
        ):  # progress begins anew, at none of the same shots
            backend.progress.say("all rays are cast; simulating shots")
        return session.run(prior_stop_reason=stop_reason, rays_by_scanner=rays_by_scanner)


def _is_complete(store_path: Location, study: FlightStudy) -> bool:
    """Tell whether no block is missing, nor any of those eyepoints that are there."""
    return bool(
        blocks_with_receipt(store_path, study).all() and committed_blocks(store_path, study).all()
    ) and all(
        _is_eyepoint_store_complete(eyepoint_store_path, eyepoints)
        for eyepoints in study.eyepoint_studies()
        if (eyepoint_store_path := eyepoints_path(store_path, eyepoints.id)).exists()
    )


def _cast_missing_eyepoints(
    study: FlightStudy, backend: ComputeBackend
) -> tuple[dict[str, int], str]:
    """Cast what is missing of a study's eyepoints; rays by scanner, and why any is missing."""
    rays_by_scanner: dict[str, int] = {}
    for eyepoints in study.eyepoint_studies():
        eyepoint_store_path, scanner = (
            eyepoints_path(study.store_path, eyepoints.id),
            eyepoints.scanner,
        )
        rays_by_scanner[scanner] = 0
        if _is_eyepoint_store_complete(eyepoint_store_path, eyepoints):
            continue
        _check_memory(study, backend)  # a scene's mistakes are the user's, not a block's
        with ExitStack() as stack:
            if not (lock := _acquire_eyepoint_lock(eyepoint_store_path, eyepoints, backend)):
                del rays_by_scanner[scanner]
                return rays_by_scanner, f"eyepoints of '{scanner}': interrupted"
            stack.callback(lock.release)
            if _is_eyepoint_store_complete(
                eyepoint_store_path, eyepoints
            ):  # another run has cast them meanwhile
                continue
            backend.progress.say(
                f"casting {eyepoints.n_rays:,} rays through the scanner '{scanner}'"
            )
            spec = eyepoints.spec
            write_recipe(
                eyepoint_store_path, spec=spec.to_json(), scanner=scanner, **_recipe_facts(spec)
            )
            outcome = Session(eyepoint_store_path, eyepoints, backend, lock).run()
        rays_by_scanner[scanner] = eyepoints.count_rays(outcome.points_computed)
        if not outcome.complete:
            return rays_by_scanner, f"eyepoints of '{scanner}': {outcome.why}"
    return rays_by_scanner, ""


def _is_eyepoint_store_complete(eyepoint_store_path: Location, eyepoints: EyepointStudy) -> bool:
    """Tell whether an eyepoint store is there with all of its blocks."""
    if is_free(eyepoint_store_path):
        return False
    attributes = read_attributes(eyepoint_store_path)
    if attributes["study_id"] != eyepoints.id:
        raise StoreError(
            f"{eyepoint_store_path} holds other eyepoints than its name says: remove it"
        )
    refuse_other_versions(eyepoint_store_path, attributes, reader="this machine")
    refuse_damaged_template(eyepoint_store_path)
    return bool(read_recipe(eyepoint_store_path)) and bool(
        committed_blocks(eyepoint_store_path, eyepoints).all()
    )


def _acquire_eyepoint_lock(
    eyepoint_store_path: Location, eyepoints: EyepointStudy, backend: ComputeBackend
) -> StoreLock | None:
    """Lock an eyepoint store, made if need be, once no other run casts; None if interrupted."""
    has_announced_wait = False
    while not backend.interrupts.is_stopping:
        try:
            if is_free(eyepoint_store_path):
                create_store(eyepoint_store_path, eyepoints, durable=backend.options.durable)
            return StoreLock(eyepoint_store_path, backend.progress.say)
        except BusyError as error:
            if not has_announced_wait:
                backend.progress.say(f"waiting for rays that another run casts: {error}")
                has_announced_wait = True
            time.sleep(EYEPOINT_LOCK_POLL_SECONDS)
    return None
