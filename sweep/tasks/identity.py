"""Whether a store is the one that a study belongs in; if not, why, in so many words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sweep.storage.locations import JOURNAL, Location
from sweep.storage.objects import ObjectStoreError
from sweep.storage.sealing import read_lines
from sweep.tasks import versions
from sweep.tasks.errors import StoreError
from sweep.tasks.journal import LOGS
from sweep.tasks.store import LAYOUT, MANIFEST

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec

REQUIRED = ("kind", "study_id", "model_version", "software", "layout")


def read_spec(path: Location, text: str, base: Path | None = None) -> Spec | SceneSpec:
    """A spec that a store holds.

    Raises
    ------
    StoreError
        Where this program can't read it.
    """
    from sweep.spec import SpecError, from_stored

    try:
        return from_stored(text, base=base)
    except (SpecError, ValueError) as error:
        raise StoreError(
            f"{path} holds a spec that this version of sweep can't read:\n{error}"
        ) from error


def read_attributes(path: Location) -> dict[str, Any]:
    """Attributes of a store, by its group's metadata alone.

    Raises
    ------
    StoreError
        Where there is no store, or not one that this version of the program can read.
    """
    return recognised(path, _written(path))


def recognised(path: Location, attributes: Any) -> dict[str, Any]:
    """Attributes of a store, where this version of the program can read it.

    Raises
    ------
    StoreError
        Where it can't.
    """
    ours = _ours(path, attributes)
    if ours.get("layout") != LAYOUT:
        raise StoreError(
            f"{path} is laid out as version {ours.get('layout')}; this sweep writes {LAYOUT}"
        )
    if any(key not in ours for key in REQUIRED):
        raise StoreError(f"{path} is a Zarr store, but not one that sweep made")
    return ours


def listed_attributes(path: Location) -> dict[str, Any]:
    """Attributes of a store by the list of what it was made of; empty where that is damaged."""
    found: dict[str, Any] = next(read_lines(path / JOURNAL / MANIFEST), {}).get("attributes", {})
    return found


def refuse_foreign(path: Location) -> None:
    """Refuse what no version of this program has made; a damaged store of ours passes.

    Raises
    ------
    StoreError
        Where neither the group says that it is ours nor any line of the journal is whole.
    """
    if not any(any(read_lines(path / JOURNAL / name)) for name in (MANIFEST, *LOGS)):
        _ours(path, _written(path))


def _written(path: Location) -> Any:
    try:
        return json.loads((path / "zarr.json").read_text())["attributes"]
    except ObjectStoreError:
        raise
    except (OSError, ValueError, KeyError, TypeError):
        if not path.exists():
            raise StoreError(f"there is no store at {path}") from None
        if (path / JOURNAL / MANIFEST).exists():
            raise damaged(path) from None
        raise StoreError(f"{path} is not a Zarr store of sweep's") from None


def damaged(path: Location) -> StoreError:
    """What to say of a store whose group is not as it was made."""
    remedy = "` puts" if listed_attributes(path) else " --spec FILE`, with the study's spec, puts"
    return StoreError(
        f"{path / 'zarr.json'} is damaged: `sweep verify {path} --repair{remedy} it back"
    )


def _ours(path: Location, attributes: Any) -> dict[str, Any]:
    if not isinstance(attributes, dict) or "study_id" not in attributes:
        raise StoreError(f"{path} is a Zarr store, but not one that sweep made")
    return attributes


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
