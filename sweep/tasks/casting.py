"""The rays of a scene study, cast once: its eyepoint stores found, or made and filled."""

from __future__ import annotations

import time
from contextlib import ExitStack

from sweep.storage import opening
from sweep.storage.locations import Location
from sweep.tasks import identity
from sweep.tasks.errors import BusyError, StoreError
from sweep.tasks.eyepoint_study import EyepointStudy, eyepoints_path
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.interrupt import Interrupts
from sweep.tasks.journal import Journal, committed
from sweep.tasks.lock import Lock
from sweep.tasks.pool import Pool
from sweep.tasks.progress import Progress
from sweep.tasks.recipe import read_recipe, write_recipe
from sweep.tasks.session import Outcome, Session
from sweep.tasks.store import create
from sweep.tasks.template import refuse_damaged

#: Seconds between looks at rays that another run casts.
WAITING = 0.5


def eyepoints_are_sound(study: FlightStudy) -> bool:
    """True if no block is missing of the eyepoints that are there; all of them may be gone."""
    paths = {eyepoints_path(study.path, e.id): e for e in study.eyepoint_studies()}
    return all(_is_whole(path, e) for path, e in paths.items() if path.exists())


def cast(
    study: FlightStudy,
    *,
    pool: Pool,
    told: Progress,
    interrupts: Interrupts,
    retry_failed: bool = False,
) -> tuple[dict[str, int], str]:
    """Cast what is missing of a study's eyepoints.

    Returns
    -------
    rays : dict of int
        Rays cast by scanner; 0 where its eyepoints were there.
    why : str
        Why eyepoints are still missing; empty where none is.

    Raises
    ------
    StoreError
        Where an eyepoint store is not what its name says, or can't be written.
    SceneError
        Where a file of the scene is missing, changed or unfit.
    """
    rays: dict[str, int] = {}
    for eyepoints in study.eyepoint_studies():
        path = eyepoints_path(study.path, eyepoints.id)
        if _is_whole(path, eyepoints):
            rays[eyepoints.scanner] = 0
            continue
        _ = eyepoints.world  # what is wrong with the scene is the user's to mend, not a block's
        with ExitStack() as stack:
            if not (lock := _locked(path, eyepoints, pool, told, interrupts)):
                return rays, f"eyepoints of '{eyepoints.scanner}': interrupted"
            stack.callback(lock.release)
            if _is_whole(path, eyepoints):  # another run has cast them meanwhile
                rays[eyepoints.scanner] = 0
                continue
            told.say(f"casting {eyepoints.rays:,} rays through the scanner '{eyepoints.scanner}'")
            outcome = _fill(path, eyepoints, pool, told, interrupts, lock, retry_failed)
        rays[eyepoints.scanner] = eyepoints.rays_in(outcome.points_computed)
        if not outcome.complete:
            return rays, f"eyepoints of '{eyepoints.scanner}': {_why(outcome)}"
    return rays, ""


def _is_whole(path: Location, eyepoints: EyepointStudy) -> bool:
    """True if an eyepoint store is there with all of its blocks."""
    if not path.exists():
        return False
    attributes = opening.read_attributes(path)
    if attributes["study_id"] != eyepoints.id:
        raise StoreError(f"{path} holds other eyepoints than its name says: remove it")
    identity.refuse_other_versions(path, attributes, where="this machine")
    refuse_damaged(path)
    return bool(read_recipe(path)) and bool(committed(path, eyepoints).all())


def _locked(
    path: Location, eyepoints: EyepointStudy, pool: Pool, told: Progress, interrupts: Interrupts
) -> Lock | None:
    """The lock of an eyepoint store, made if need be, once no other run casts the same rays.

    None where the run is interrupted before.
    """
    waiting = False
    while not interrupts.stopping:
        try:
            if not path.exists():
                create(path, eyepoints, durable=pool.terms.durable)
            return Lock(path)
        except BusyError as error:
            if not waiting:
                told.say(f"waiting for rays that another run casts: {error}")
                waiting = True
            time.sleep(WAITING)
    return None


def _fill(
    path: Location,
    eyepoints: EyepointStudy,
    pool: Pool,
    told: Progress,
    interrupts: Interrupts,
    lock: Lock,
    retry_failed: bool,
) -> Outcome:
    write_recipe(
        path,
        spec=eyepoints.spec.to_json(),
        base=str(eyepoints.spec.base.absolute()),
        scanner=eyepoints.scanner,
    )
    session = Session(
        path, eyepoints, pool=pool, progress=told, interrupts=interrupts,
        journal=Journal(path, durable=pool.terms.durable), lock=lock, retry_failed=retry_failed,
    )  # fmt: skip
    return session.to_its_end()


def _why(outcome: Outcome) -> str:
    """Reason why a session ended before its blocks did."""
    if outcome.stopped:
        return outcome.stopped
    if not outcome.failures:
        return f"{outcome.left_out} blocks failed before; --retry-failed tries them again"
    return f"{len(outcome.failures)} blocks failed, the first with {outcome.failures[0].error}"
