"""Run, resume and extend studies: the stages from a spec and options to a complete store."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sweep.messages import number_with_noun, option_text, suggested_call
from sweep.spec import GridSpec, SceneSpec
from sweep.storage.locations import (
    PACKED_ATTRIBUTE,
    Location,
    can_create_store,
    eyepoint_store_location,
    final_path_for,
    parse_location,
    recover_interrupted_replace,
    replace_path,
    resolve_links,
    staging_path_for,
)
from sweep.storage.store_format import read_attributes, read_study_id
from sweep.tasks.engine import user_code
from sweep.tasks.engine.journal import (
    EXTENDED_STORE_KEY,
    REPLACED_STUDY_ID_KEY,
    USER_MODULE_DIGESTS_KEY,
    StoreLock,
    committed_block_mask,
    read_store_recipe,
    receipted_block_mask,
    refuse_damaged_recipe,
    remove_predecessors_from_recipe,
    wait_for_stale_lock,
    write_store_recipe,
)
from sweep.tasks.engine.progress import (
    ClusterError,
    StoreBusyError,
    StoreError,
    make_progress,
    raise_as_store_error,
    show_activity,
)
from sweep.tasks.engine.session import ComputeBackend, RunOptions, Session, SessionOutcome
from sweep.tasks.engine.study_store import (
    create_store,
    find_pending_replacement,
    refuse_damaged_template,
    refuse_foreign_files,
    refuse_irreplaceable_store,
    refuse_other_blocks,
    refuse_other_versions,
    remove_store,
    sync_file_system,
)
from sweep.tasks.studies import study_loading
from sweep.tasks.studies.eyepoint_study import EyepointStudy, get_built_scene
from sweep.tasks.studies.flight_coverage import refuse_flight_without_hits
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.studies.memory_limits import (
    block_peak_memory_bytes,
    refuse_too_large_blocks,
    refuse_too_large_point,
    refuse_too_large_study,
)
from sweep.tasks.studies.study_loading import (
    AnySpec,
    apply_changes,
    refuse_not_larger_study,
    refuse_other_study,
    reusable_points_text,
)
from sweep.tasks.studies.user_function_names import iter_user_functions, user_module_names
from sweep.tasks.studies.workload import SpecWorkload

EYEPOINT_LOCK_POLL_SECONDS = 0.5
"""Interval [s] at which a run checks if another run still holds the lock of an eyepoint store. The
store holds the geometry of shots that both runs need."""


@dataclass(frozen=True, kw_only=True)
class Outcome(SessionOutcome):
    """Result of a run: what was computed, and why results are missing, if any are."""

    rays_by_scanner: Mapping[str, int] = field(default_factory=dict)
    """Number of rays cast in this run, by the scanner's name."""

    @classmethod
    def from_session_outcome(
        cls, outcome: SessionOutcome, rays_by_scanner: Mapping[str, int] | None = None
    ) -> Outcome:
        """Return the outcome of a run, given that of its last session and the rays it has cast."""
        return cls(**vars(outcome), rays_by_scanner=rays_by_scanner or {})


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
        Study, and path of the store to create: on disk, or `s3://bucket/key.zarr` (gs, az).
    overwrite
        Whether to replace an existing store, once the new one is complete.
    resume
        Whether to continue if the store exists and holds this study. A complete store stays as it
        is, so the same call serves a job each time that it is started.
    **options
        Where and how to compute, by the names of :class:`sweep.tasks.engine.session.RunOptions`:
        ``workers=4``, ``client=...``, ``progress=False`` and so on.

    Returns
    -------
    Outcome
        Numbers of points and blocks, and why the study is incomplete, if it is. `resume` continues
        an incomplete study.

    Warns
    -----
    StudyWarning
        If the study can be computed but is probably not meant: a beam that its aperture can't make,
        a flight that partly sees nothing, echoes after their record, disabled effects that matter.

    Raises
    ------
    StoreError
        If another store is at the path, or the path is not writable.
    ClusterError
        If no scheduler or worker is available.
    CodeError
        If the study names a function that may not run (:mod:`sweep.tasks.studies.user_functions`).

    Examples
    --------
    >>> import sweep
    >>> spec = sweep.load("study.yaml")
    >>> outcome = sweep.run(spec, store="study.zarr", progress=False)
    >>> outcome.complete
    True
    """
    final_path, run_options = resolve_links(parse_location(store)), RunOptions.from_mapping(options)
    if overwrite and resume:
        raise ValueError("overwrite begins anew, and resume goes on: give one of them")
    _check_spec_type(spec)
    _check_user_functions(spec)
    if resume and (not can_create_store(final_path) or find_pending_replacement(final_path)):
        wait_for_stale_lock(
            find_pending_replacement(final_path) or final_path,
            make_progress(run_options.progress).say,
        )
        return _resume(final_path, spec, run_options)
    backend, study = _make_backend(run_options, spec), study_loading.make_study(spec, final_path)
    if not overwrite:
        _refuse_existing_store(final_path, study)
    _check_memory(study, backend)
    from sweep.tasks.studies.study_warnings import issue_study_warnings  # the model's kernels

    issue_study_warnings(study, backend.progress.say)
    return _compute_into_path(
        final_path, spec, backend, replace_existing=overwrite, from_scratch=True
    )


def resume(store: str | Location, *, spec: AnySpec | None = None, **options: Any) -> Outcome:
    """Compute the missing blocks of a store, or of the store that is to extend or replace it.

    Parameters
    ----------
    store
        Path of a store that `run` made.
    spec
        Study that the store must hold; by default any.
    **options
        As in `run`.

    Raises
    ------
    StoreError
        If the store is not sweep's, holds another study, was begun with other versions, has damaged
        objects from before its first result, or is being written by another process. The store
        does not change.
    ClusterError
        If no scheduler or worker is available.

    Examples
    --------
    >>> import sweep
    >>> spec = sweep.load("study.yaml")
    >>> outcome = sweep.run(spec, store="night.zarr", progress=False)  # say that it is interrupted
    >>> sweep.resume("night.zarr", progress=False).complete
    True
    """
    final_path, run_options = resolve_links(parse_location(store)), RunOptions.from_mapping(options)
    if spec is not None:
        _check_spec_type(spec)
    return _resume(final_path, spec, run_options)


def _resume(final_path: Location, spec: AnySpec | None, run_options: RunOptions) -> Outcome:
    """Resume the store at a path that contains no symbolic links, as :func:`resume` does."""
    final_path = final_path_for(final_path) if isinstance(final_path, Path) else final_path
    working_path = find_pending_replacement(final_path) or final_path
    attributes, study = _read_resumable_study(working_path)
    if spec is not None:
        refuse_other_study(working_path, attributes, study.spec, spec)
    _refuse_unresumable_store(working_path, attributes, study)
    _check_user_functions(study.spec)
    if spec is None:
        refuse_damaged_recipe(working_path)
    else:
        study = study_loading.make_study(spec, working_path)  # with the folder of the spec's files
    backend = _make_backend(run_options, study.spec)
    if working_path == final_path:
        return _compute_missing_blocks(working_path, study, backend)
    source = read_store_recipe(working_path).get(EXTENDED_STORE_KEY)
    return _compute_into_path(
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
    """Turn a store into the store of a larger study, and compute only the new points.

    The larger study has more values on its axes, more axes, more draws or a tighter tolerance. The
    larger store is computed in the same folder and replaces the store when complete. The bytes of
    the result are the same as if the larger study were run at once.

    Parameters
    ----------
    store
        Path of a store that `run` made, complete or not. It is only read.
    spec
        Larger study; by default the study in the store, with the changes.
    changes
        Changed fields by dotted path: ``{"axes.target.range": ["1 km", "2 km"]}``.
    to
        Path of the larger store, if the old one shall stay. Required in an object store.
    overwrite
        Whether to restart an extension that was begun, or to replace another store at `to`.
    **options
        As in `run`.

    Returns
    -------
    Outcome
        Numbers of points and blocks, and why the study is incomplete, if it is. `extend` or
        `resume` continues an incomplete study.

    Raises
    ------
    StoreError, ClusterError
        As in `run` and `resume`, and if the study is not larger than the one in the store.

    Examples
    --------
    >>> import sweep
    >>> outcome = sweep.run(sweep.load("study.yaml"), store="near.zarr", progress=False)
    >>> changes = {"axes.target.range": ["500 m", "1 km", "2 km", "4 km"]}
    >>> sweep.extend("near.zarr", changes=changes, progress=False).complete
    True
    >>> sweep.open("near.zarr").pd_shot.sizes["range"]
    4
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
    backend = _make_backend(run_options, target_spec)
    _refuse_unresumable_store(source_path, attributes, source_study)
    if target_spec.id == attributes["study_id"]:
        backend.progress.say(f"nothing to extend: {source_path} holds this very study")
        return _compute_missing_blocks(source_path, source_study, backend)
    refuse_not_larger_study(source_path, source_study.spec, target_spec)
    final_path = source_path if to is None else resolve_links(parse_location(to))
    if not overwrite:
        find_pending_replacement(final_path)
    target_study = study_loading.make_study(target_spec, final_path)
    _check_memory(target_study, backend)
    from sweep.tasks.studies.study_warnings import issue_study_warnings  # the model's kernels

    issue_study_warnings(target_study, backend.progress.say)
    return _compute_into_path(
        final_path,
        target_spec,
        backend,
        replace_existing=overwrite or final_path == source_path,
        from_scratch=overwrite,
        source_path=source_path,
    )


def _make_backend(run_options: RunOptions, spec: AnySpec) -> ComputeBackend:
    """Return the backend (threads, workers or cluster) that computes a study.

    SpecError is raised if one point needs more memory than the backend has.
    """
    backend = ComputeBackend(run_options, SpecWorkload(spec))
    refuse_too_large_point(spec, backend.memory)
    return backend


def _check_memory(study: GridStudy | FlightStudy, backend: ComputeBackend) -> None:
    """Raise a SpecError if a study needs more memory than the backend has.

    If the backend is not connected yet, the check is made once it is.
    """
    backend.check_memory = partial(refuse_too_large_study, study)
    with show_activity("building the scene", backend.progress):
        refuse_too_large_study(study, backend.memory)


def _check_spec_type(spec: object) -> None:
    """Raise a TypeError if an argument is no spec, for example the path of a spec's file."""
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
    """Return a store's attributes and the study in it.

    StoreError is raised if it can't be resumed.
    """
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


def _refuse_unresumable_store(
    store_path: Location, attributes: dict[str, Any], study: GridStudy | FlightStudy
) -> None:
    """Raise a StoreError if a store can't be continued by this software.

    Reasons are other versions of the software, changed attributes, blocks of another shape, and
    damage to objects that were written before the first result.
    """
    refuse_other_versions(store_path, attributes, study.model_version, reader="this machine")
    if study.id != attributes["study_id"]:
        raise StoreError(
            f"{store_path} holds a spec with id {study.id} but says {attributes['study_id']}: "
            "its attributes were changed after it was made"
        )
    refuse_damaged_template(store_path)
    refuse_other_blocks(store_path, study)


def _refuse_existing_store(store_path: Location, study: GridStudy | FlightStudy) -> None:
    """Raise a StoreError if a path is occupied, or if a store is being prepared for it."""
    staging_path, remedy = (
        find_pending_replacement(store_path),
        f"{suggested_call('resume', store_path)} goes on with it",
    )
    if not can_create_store(store_path):
        attributes, stored_study = _read_resumable_study(store_path)
        refuse_other_study(store_path, attributes, stored_study.spec, study.spec)
        n_blocks_done = int(np.count_nonzero(receipted_block_mask(store_path, study)))
        problem = (
            f"{store_path} holds this study already, {n_blocks_done} of "
            f"{number_with_noun(study.n_blocks, 'block')} done"
        )
        if n_blocks_done == study.n_blocks:
            remedy = f"{suggested_call('status', store_path)} tells about it"
    elif staging_path:
        problem = f"a study is under way in {staging_path}"
    else:
        return
    raise StoreError(f"{problem}: {remedy}, {option_text('overwrite')} begins anew")


def _compute_into_path(
    final_path: Location,
    spec: AnySpec,
    backend: ComputeBackend,
    *,
    replace_existing: bool,
    from_scratch: bool,
    source_path: Location | None = None,
) -> Outcome:
    """Compute a study into a store at ``final_path``.

    If a store at that path is to be replaced, the new store is built at a temporary path, the
    staging path. The new store replaces the old one when complete.
    """
    recover_interrupted_replace(final_path)
    working_path, recipe, durable = final_path, _spec_folder_entry(spec), backend.options.durable
    with ExitStack() as stack:
        if replace_existing and not can_create_store(final_path):
            refuse_irreplaceable_store(final_path)
            if from_scratch and final_path != source_path:
                refuse_foreign_files(final_path)
            stack.callback(StoreLock(final_path, backend.progress.say).release)
        if (
            replace_existing
            and isinstance(final_path, Path)
            and (not can_create_store(final_path) or staging_path_for(final_path).exists())
        ):
            working_path = staging_path_for(final_path)
            recipe[REPLACED_STUDY_ID_KEY] = read_study_id(final_path)
        if source_path is not None:
            recipe[EXTENDED_STORE_KEY] = str(source_path)
        already_exists = not can_create_store(working_path)
        study = study_loading.make_study(spec, working_path, source_path)
        if already_exists and from_scratch:
            StoreLock(
                working_path, backend.progress.say
            ).release()  # a StoreBusyError if another process writes to it
        elif already_exists:
            stored_attributes, stored_study = _read_resumable_study(working_path)
            refuse_other_study(working_path, stored_attributes, stored_study.spec, spec)
            _refuse_unresumable_store(working_path, stored_attributes, stored_study)
            write_store_recipe(working_path, **read_store_recipe(working_path) | recipe)
        if isinstance(spec, SceneSpec) and (from_scratch or not already_exists):
            with show_activity("building the scene", backend.progress):
                scene_reports = get_built_scene(spec).mesh_reports
                if not _eyepoint_stores_exist(working_path, study):
                    refuse_flight_without_hits(spec)
            for report in scene_reports:
                backend.progress.say(report)

        def prepare() -> None:
            creates_store = from_scratch or not already_exists
            if creates_store and backend.uses_running_scheduler:
                backend.connect()  # checks the memory of its workers before the store is created
            elif already_exists and from_scratch and not backend.is_in_process:
                backend.connect()  # without workers the unfinished store is not removed
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
            outcome = _compute_missing_blocks(working_path, study, backend, prepare)
        except ClusterError:
            if not already_exists:
                remove_store(
                    working_path
                )  # nothing was computed, so the next run starts with a free path
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
    """Move a complete store from its staging path to its final path.

    The caller holds the lock of the store at the final path.
    """
    staging_path = staging_path_for(final_path)
    with raise_as_store_error(f"{staging_path} can't take the place of {final_path}"):
        if durable:
            sync_file_system(staging_path)
        replace_path(staging_path, final_path)
        remove_predecessors_from_recipe(
            final_path
        )  # the store at the final path no longer extends or replaces another


def _eyepoint_stores_exist(store_path: Location, study: GridStudy | FlightStudy) -> bool:
    """Return True if every scanner's store of shot geometry (eyepoints) exists, complete or not."""
    return isinstance(study, FlightStudy) and all(
        eyepoint_store_location(store_path, eyepoints.id).exists()
        for eyepoints in study.eyepoint_studies()
    )


def _spec_folder_entry(spec: AnySpec) -> dict[str, str]:
    """Return the entry of a store's recipe that names the folder of a flight's files.

    The entry is empty for a grid. The recipe is the part of the journal about how the store is
    made.
    """
    return {"base": str(spec.base_folder.absolute())} if isinstance(spec, SceneSpec) else {}


def _check_user_functions(spec: AnySpec) -> None:
    """Import and test the user's functions that a study names. CodeError is raised if one fails."""
    if any(iter_user_functions(spec)):
        from sweep.tasks.studies.user_functions import check_user_functions  # the model's kernels

        check_user_functions(spec)


def _warn_of_changed_user_code(
    store_path: Location, spec: AnySpec, say: Callable[[str], None]
) -> None:
    """Print a message for each user module whose file has changed since the store was begun.

    If the store extends another store, the file is compared with its state at the start of the
    other store.
    """
    modules = user_module_names(spec)
    if not modules:
        return
    current_digests = {
        name: digest for name, digest in user_code.module_digests(modules).items() if digest
    }
    recipe = read_store_recipe(store_path)
    source_recipe = (
        read_store_recipe(parse_location(recipe[EXTENDED_STORE_KEY]))
        if EXTENDED_STORE_KEY in recipe
        else {}
    )
    recorded_digests = (
        current_digests
        | source_recipe.get(USER_MODULE_DIGESTS_KEY, {})
        | recipe.get(USER_MODULE_DIGESTS_KEY, {})
    )
    write_store_recipe(store_path, **recipe | {USER_MODULE_DIGESTS_KEY: recorded_digests})
    for module_name in current_digests:
        if recorded_digests[module_name] != current_digests[module_name]:
            say(
                f"the module {module_name} has changed since {store_path} was begun: what was "
                "computed before "
                "has the results of the old code. Put it back, or run the study anew"
            )


def _compute_missing_blocks(
    store_path: Location,
    study: GridStudy | FlightStudy,
    backend: ComputeBackend,
    prepare: Callable[[], None] = lambda: None,
) -> Outcome:
    """Lock a store and compute its missing blocks.

    In a flight the missing geometry of shots (eyepoints) is computed first. `prepare` creates the
    store if needed. ``prepare`` is called before the store is locked.
    """
    backend.max_workers = study.n_blocks
    backend.check_memory = partial(refuse_too_large_study, study)
    backend.bytes_per_thread = block_peak_memory_bytes(study)
    refuse_too_large_blocks(study, backend.memory)
    with (
        backend.interrupts,
        ExitStack() as stack,
        backend,
    ):  # the lock is released after the workers have ended
        prepare()
        lock = StoreLock(store_path, backend.progress.say)
        stack.callback(lock.release)
        _warn_of_changed_user_code(store_path, study.spec, backend.progress.say)
        session = Session(store_path, study, backend, lock)
        if isinstance(study, GridStudy):
            return Outcome.from_session_outcome(session.run())
        write_store_recipe(
            store_path, **read_store_recipe(store_path) | _spec_folder_entry(study.spec)
        )
        if _is_flight_complete(store_path, study):
            return Outcome.from_session_outcome(session.run())
        rays_by_scanner, stop_reason = _cast_missing_eyepoints(study, backend)
        if (
            any(rays_by_scanner.values()) and not stop_reason
        ):  # the next stage counts the same shots from zero
            backend.progress.say("all rays are cast; simulating shots")
        return Outcome.from_session_outcome(
            session.run(prior_stop_reason=stop_reason), rays_by_scanner
        )


def _is_flight_complete(store_path: Location, study: FlightStudy) -> bool:
    """Return True if all blocks of a flight are stored, and its eyepoint stores are complete.

    An eyepoint store holds the geometry of the shots, as rays have found it. Missing eyepoint
    stores do not count.
    """
    return bool(
        receipted_block_mask(store_path, study).all()
        and committed_block_mask(store_path, study).all()
    ) and all(
        _is_eyepoint_store_complete(eyepoint_store_path, eyepoints)
        for eyepoints in study.eyepoint_studies()
        if (eyepoint_store_path := eyepoint_store_location(store_path, eyepoints.id)).exists()
    )


def _cast_missing_eyepoints(
    study: FlightStudy, backend: ComputeBackend
) -> tuple[dict[str, int], str]:
    """Cast the rays of shots whose geometry (eyepoints) is not stored yet.

    Return the number of rays by scanner, and the reason for stopping early, or ''.
    """
    rays_by_scanner: dict[str, int] = {}
    for eyepoints in study.eyepoint_studies():
        eyepoint_store_path, scanner = (
            eyepoint_store_location(study.store_path, eyepoints.id),
            eyepoints.scanner,
        )
        rays_by_scanner[scanner] = 0
        if _is_eyepoint_store_complete(eyepoint_store_path, eyepoints):
            continue
        _check_memory(study, backend)  # builds the scene: its errors are no failures of blocks
        with ExitStack() as stack:
            if not (lock := _acquire_eyepoint_lock(eyepoint_store_path, eyepoints, backend)):
                del rays_by_scanner[scanner]
                return rays_by_scanner, f"eyepoints of '{scanner}': interrupted"
            stack.callback(lock.release)
            if _is_eyepoint_store_complete(
                eyepoint_store_path, eyepoints
            ):  # cast by another run meanwhile
                continue
            backend.progress.say(
                f"casting {eyepoints.n_rays:,} rays through the scanner '{scanner}'"
            )
            spec = eyepoints.spec
            write_store_recipe(
                eyepoint_store_path,
                spec=spec.to_json(),
                scanner=scanner,
                **_spec_folder_entry(spec),
            )
            outcome = Session(eyepoint_store_path, eyepoints, backend, lock).run()
        rays_by_scanner[scanner] = eyepoints.count_rays(outcome.points_computed)
        if not outcome.complete:
            return rays_by_scanner, f"eyepoints of '{scanner}': {outcome.incomplete_reason}"
    return rays_by_scanner, ""


def _is_eyepoint_store_complete(eyepoint_store_path: Location, eyepoints: EyepointStudy) -> bool:
    """Return True if a store of shot geometry (eyepoints) exists with all of its blocks."""
    if can_create_store(eyepoint_store_path):
        return False
    attributes = read_attributes(eyepoint_store_path)
    if attributes["study_id"] != eyepoints.id:
        raise StoreError(
            f"{eyepoint_store_path} holds other eyepoints than its name says: remove it"
        )
    refuse_other_versions(
        eyepoint_store_path, attributes, eyepoints.model_version, reader="this machine"
    )
    refuse_damaged_template(eyepoint_store_path)
    refuse_other_blocks(eyepoint_store_path, eyepoints)
    return bool(read_store_recipe(eyepoint_store_path)) and bool(
        committed_block_mask(eyepoint_store_path, eyepoints).all()
    )


def _acquire_eyepoint_lock(
    eyepoint_store_path: Location, eyepoints: EyepointStudy, backend: ComputeBackend
) -> StoreLock | None:
    """Wait until no other run holds the lock of an eyepoint store, and return the store's lock.

    The store, which holds the geometry of shots, is created if needed. None is returned if the run
    is interrupted while waiting.
    """
    has_announced_wait = False
    while not backend.interrupts.is_stopping:
        try:
            if can_create_store(eyepoint_store_path):
                create_store(eyepoint_store_path, eyepoints, durable=backend.options.durable)
            return StoreLock(eyepoint_store_path, backend.progress.say)
        except StoreBusyError as error:
            if not has_announced_wait:
                backend.progress.say(f"waiting for rays that another run casts: {error}")
                has_announced_wait = True
            time.sleep(EYEPOINT_LOCK_POLL_SECONDS)
    return None
