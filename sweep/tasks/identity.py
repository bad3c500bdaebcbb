"""Identity of a store: the study in it, and the software that the bits of its results depend on."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sweep.storage import opening
from sweep.storage.atomic_replace import beside, settle
from sweep.storage.locations import JOURNAL, Location
from sweep.storage.logs import read_lines
from sweep.storage.opening import MANIFEST
from sweep.tasks.errors import StoreError
from sweep.tasks.journal import LOGS, REPLACES, read_recipe

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec

#: Distributions whose version can change a result or how it is stored.
DISTRIBUTIONS = ("numba", "numpy", "scipy", "sweep", "zarr")


@cache
def _installed() -> tuple[tuple[str, str], ...]:
    return tuple((name, version(name)) for name in DISTRIBUTIONS)


def software() -> dict[str, str]:
    """Versions of the software that a result depends on, by name."""
    return dict(_installed())


def model() -> str:
    """Version of the physics."""
    from sweep.model import VERSION

    return VERSION


@cache
def processor() -> str:
    """Machine, processor and vector instructions that numpy dispatches to.

    numpy and LLVM choose their code by these, and with it the last bits of a result.
    """
    import llvmlite.binding
    import numpy as np

    simd = np.show_config(mode="dicts").get("SIMD Extensions", {})  # type: ignore[call-overload]
    found = simd.get("found") or simd.get("baseline") or []
    name = llvmlite.binding.get_host_cpu_name()
    return f"{platform.machine()} {name} {' '.join(found)}".strip()


def _differences(recorded: dict[str, str]) -> list[str]:
    """Lines that say where the software here differs from a recorded one."""
    here = software()
    return [
        f"{name}: {recorded.get(name, 'none')} in the store, {here.get(name, 'none')} here"
        for name in sorted(here.keys() | recorded.keys())
        if here.get(name) != recorded.get(name)
    ]


def refuse_foreign(path: Location) -> None:
    """Refuse what no version of this program has made; a damaged store of ours passes."""
    if not any(any(read_lines(path / JOURNAL / name)) for name in (MANIFEST, *LOGS)):
        opening.refuse_foreign(path)


def refuse_to_replace(path: Location) -> None:
    """Refuse to replace what no version of this program has made, or what can't be renamed."""
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
    """Refuse a store that holds another study than the one asked for."""
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
    """Refuse a store begun with another model or other software: the bits could differ."""
    lines = _differences(attributes["software"])
    if attributes["model_version"] != model():
        lines.insert(0, f"model: {attributes['model_version']} in the store, {model()} here")
    if lines:
        listed = "\n".join(f"  {line}" for line in lines)
        raise StoreError(
            f"{path} was begun with other versions than {where} has:\n{listed}\n"
            "Its results could not be told apart from new ones. Install those versions to resume "
            "it, or run the study anew into another store."
        )


def refuse_altered(path: Location, attributes: dict[str, Any], held: Spec | SceneSpec) -> None:
    """Refuse a store whose spec no longer is the one that its id was made from."""
    if held.id != attributes["study_id"]:
        raise StoreError(
            f"{path} holds a spec with id {held.id} but says {attributes['study_id']}: "
            "its attributes were changed after it was made"
        )
