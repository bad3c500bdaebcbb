"""The study in a store, of whatever kind."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from sweep.scenes.files import SceneError
from sweep.spec import SceneSpec, Spec, SpecError, from_stored
from sweep.storage import opening
from sweep.storage.atomic_replace import real
from sweep.storage.locations import Location, located
from sweep.tasks import store
from sweep.tasks.errors import StoreError
from sweep.tasks.eyepoint_study import EyepointStudy
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.journal import EXTENDS, read_recipe
from sweep.tasks.reuse import Reuse, unlike

ACCURACY = "accuracy"
"""Kind of the stores of `sweep accuracy`, in which there is no study."""

AnyStudy = GridStudy | EyepointStudy | FlightStudy


def study_of(
    spec: Spec | SceneSpec, path: Location, extends: Location | None = None
) -> GridStudy | FlightStudy:
    """Return the study that a spec declares, to be stored at a path.

    ``extends``: the store of a smaller one, whose results are taken; by default there is none.
    """
    study = FlightStudy(spec, path) if isinstance(spec, SceneSpec) else GridStudy(spec)
    if extends:
        study.look_up = partial(_reuse, extends, study)
    return study


def _reuse(path: Location, study: GridStudy | FlightStudy) -> Reuse | None:
    """Results that the store at a path has of a study; None where it is gone, or has none."""
    try:
        attributes = opening.read_attributes(path)
        store.refuse_other_versions(path, attributes, where="this machine")
        spec = _spec(path, read_recipe(path), attributes.get("spec", "{}"))
        if type(spec) is not type(study.spec) or spec.seed != study.spec.seed:
            return None
        if isinstance(study, FlightStudy) and unlike(spec, study.spec):
            return None  # a grid's points are told apart by their parameters
        return Reuse(path, study_of(spec, path), study)
    except (StoreError, SceneError):
        return None


def read(path: Location) -> tuple[dict[str, Any], AnyStudy]:
    """Attributes of a store and the study that it holds; StoreError where it can't be read."""
    attributes = opening.read_attributes(path)
    if attributes["kind"] == ACCURACY:
        raise StoreError(f"{path} holds what accuracy costs, no study: sweep figures draws it")
    return attributes, described(path, attributes)


def described(path: Location, attributes: dict[str, Any]) -> AnyStudy:
    """Read the study of a store from its attributes; StoreError if it can't be read."""
    recipe = read_recipe(path)
    if attributes["kind"] == "eyepoints":
        if "spec" not in recipe:
            raise StoreError(
                f"{path} does not say how its eyepoints were made: run their study again"
            )
        return EyepointStudy(_spec(path, recipe, recipe["spec"]), recipe["scanner"])
    spec = _spec(path, recipe, attributes["spec"])
    extends = located(recipe[EXTENDS]) if EXTENDS in recipe else None
    return study_of(spec, path, extends if extends != real(path) else None)


def _spec(path: Location, recipe: dict[str, Any], text: str) -> Any:
    """Read the spec of a store; StoreError if this program can't read it."""
    try:
        return from_stored(text, base=Path(recipe["base"]) if "base" in recipe else None)
    except (SpecError, ValueError) as error:
        raise StoreError(
            f"{path} holds a spec that this version of sweep can't read:\n{error}"
        ) from error
