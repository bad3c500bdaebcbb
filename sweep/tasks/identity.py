"""Refusals of stores that a study does not belong in, in so many words."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sweep.storage import opening
from sweep.storage.atomic_replace import beside, settle
from sweep.storage.locations import JOURNAL, Location
from sweep.storage.opening import MANIFEST
from sweep.storage.sealing import read_lines
from sweep.tasks import versions
from sweep.tasks.errors import StoreError
from sweep.tasks.journal import LOGS
from sweep.tasks.recipe import REPLACES, read_recipe

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec


def refuse_foreign(path: Location) -> None:
    """Refuse what no version of this program has made; a damaged store of ours passes.

    Raises
    ------
    StoreError
        Where neither the group says that it is ours nor any line of the journal is whole.
    """
    if not any(any(read_lines(path / JOURNAL / name)) for name in (MANIFEST, *LOGS)):
        opening.refuse_foreign(path)


def refuse_to_replace(path: Location) -> None:
    """Refuse to replace what no version of this program has made, or what can't be renamed.

    Raises
    ------
    StoreError
        As of :func:`refuse_foreign`, and in an object store.
    """
    if not isinstance(path, Path):
        raise StoreError(
            f"{path} can't be replaced or extended in its place, as an object store has no "
            "renaming: name another place with --store; this one then stays"
        )
    refuse_foreign(path)


def under_way(path: Location) -> Path | None:
    """The store that is to take the place of the one at a path, where one was begun.

    Raises
    ------
    StoreError
        Where it was begun to take the place of another store than is there now.
    """
    settle(path)
    if not isinstance(path, Path) or not (new := beside(path)).exists():
        return None
    if read_recipe(new).get(REPLACES) != opening.study_id(path):
        now = "holds another study now" if path.exists() else "is gone"
        raise StoreError(
            f"{new} was begun to take the place of a store at {path}, which {now}: "
            f"`rm -r {new}`, or have --overwrite begin anew"
        )
    return new


def refuse_other_study(
    path: Location, attributes: dict[str, Any], held: Spec | SceneSpec, asked: Spec | SceneSpec
) -> None:
    """Refuse a store that holds another study than the one asked for.

    Raises
    ------
    StoreError
        With the differences, field by field.
    """
    from sweep.spec import difference

    if attributes["study_id"] == asked.id:
        return
    refuse_other_versions(path, attributes, where="this machine")  # the version is in the id too
    lines = "\n".join(f"  {line}" for line in difference(held, asked))
    raise StoreError(
        f"{path} holds another study (in the store -> in the spec):\n{lines}\n"
        "Name another --store, or --overwrite this one."
    )


def refuse_other_versions(path: str | Location, attributes: dict[str, Any], *, where: str) -> None:
    """Refuse a store begun with another model or other software: the bits could differ.

    Raises
    ------
    StoreError
        With both versions of each.
    """
    lines = versions.differences(attributes["software"])
    if attributes["model_version"] != versions.model():
        lines.insert(
            0, f"model: {attributes['model_version']} in the store, {versions.model()} here"
        )
    if lines:
        listed = "\n".join(f"  {line}" for line in lines)
        raise StoreError(
            f"{path} was begun with other versions than {where} has:\n{listed}\n"
            "Its results could not be told apart from new ones. Install those versions to resume "
            "it, or run the study anew into another store."
        )


def refuse_altered(path: Location, attributes: dict[str, Any], held: Spec | SceneSpec) -> None:
    """Refuse a store whose spec no longer is the one that its id was made from.

    Raises
    ------
    StoreError
        With both ids.
    """
    if held.id != attributes["study_id"]:
        raise StoreError(
            f"{path} holds a spec with id {held.id} but says {attributes['study_id']}: "
            "its attributes were changed after it was made"
        )
