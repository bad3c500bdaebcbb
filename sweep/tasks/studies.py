"""The study in a store, of whatever kind."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sweep.storage.atomic_replace import real
from sweep.storage.locations import Location, located
from sweep.storage.opening import read_attributes
from sweep.tasks.errors import StoreError
from sweep.tasks.eyepoint_study import EyepointStudy
from sweep.tasks.flight_reuse import older_flight
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.identity import read_spec
from sweep.tasks.recipe import EXTENDS, read_recipe
from sweep.tasks.reuse import older_store

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec

ACCURACY = "accuracy"
"""Kind of the stores of `sweep accuracy`, in which there is no study."""

AnyStudy = GridStudy | EyepointStudy | FlightStudy


def study_of(
    spec: Spec | SceneSpec, path: Location, extends: Location | None = None
) -> GridStudy | FlightStudy:
    """The study that a spec declares, to be stored at a path.

    Parameters
    ----------
    spec, path
        The study and its place.
    extends
        The store of a smaller one, whose results are taken; by default there is none.
    """
    from sweep.spec import SceneSpec

    if isinstance(spec, SceneSpec):
        return FlightStudy(spec, path, partial(older_flight, extends) if extends else None)
    return GridStudy(spec, partial(older_store, extends) if extends else None)


def read(path: Location) -> tuple[dict[str, Any], AnyStudy]:
    """Attributes of a store and the study that it holds.

    Raises
    ------
    StoreError
        Where there is no store, or not one of this program's, or one it can't read.
    """
    attributes = read_attributes(path)
    if attributes["kind"] == ACCURACY:
        raise StoreError(f"{path} holds what accuracy costs, no study: sweep figures draws it")
    return attributes, described(path, attributes)


def described(path: Location, attributes: dict[str, Any]) -> AnyStudy:
    """The study that a store's attributes tell of.

    Raises
    ------
    StoreError
        Where this program can't read it.
    """
    recipe = read_recipe(path)
    base = Path(recipe["base"]) if "base" in recipe else None
    if attributes["kind"] == "eyepoints":
        return _eyepoints(path, recipe, base)
    spec = read_spec(path, attributes["spec"], base)
    extends = located(recipe[EXTENDS]) if EXTENDS in recipe else None
    return study_of(spec, path, extends if extends != real(path) else None)


def _eyepoints(path: Location, recipe: dict[str, Any], base: Path | None) -> EyepointStudy:
    if "spec" not in recipe:
        raise StoreError(f"{path} does not say how its eyepoints were made: run their study again")
    return EyepointStudy(read_spec(path, recipe["spec"], base), recipe["scanner"])  # type: ignore[arg-type]
