"""A store's template, all that it held before there were results: checked, and put back.

Metadata, coordinates and the spec are listed with their digests in the journal's directory. They
follow from the study, so that any of them can be made again, to the same bytes.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from sweep.storage import opening, sealing
from sweep.storage.locations import Location, names_below, put_whole
from sweep.storage.sealing import read_lines, read_sealed
from sweep.tasks import identity, journal, store
from sweep.tasks.errors import StoreError
from sweep.tasks.study import Study

LIST = f"{store.JOURNAL}/{store.MANIFEST}"


class Damage(NamedTuple):
    """An object of a store that is not as it was written."""

    object: str  # path inside the store; a line of a log by its number
    what: str  # what is wrong with it
    block: int = -1  # that it belongs to
    mended_by: str = "resume"  # "repair" what was there before results, "hand" what is surplus


def attributes(path: Location) -> dict[str, Any]:
    """Attributes that a store was made with, from its list, else from its group.

    Raises
    ------
    StoreError
        Where there is no store, or not one of this program's; where both are damaged.
    """
    if listed := opening.listed_attributes(path):
        return opening.recognised(path, listed)
    found = opening.read_attributes(path)
    if any(_wrong(path, o, digest) for o, digest in digests(path).items() if o == "zarr.json"):
        raise StoreError(f"{path / 'zarr.json'} is damaged{opening.remedy(path)}")
    return found


def digests(path: Location) -> dict[str, str]:
    """Digests of what a store was made of, by object, as far as its list is undamaged."""
    return {r["object"]: r["digest"] for r in read_lines(path / LIST) if "object" in r}


def damages(path: Location) -> list[Damage]:
    """Objects of a template, or lines of its list, that are not as they were made."""
    lines = [record for _, record in read_sealed(path / LIST)]
    if not lines:
        return [Damage(LIST, "is missing or empty", mended_by="repair")]
    found = [
        Damage(f"{LIST} line {n}", "is damaged", mended_by="repair")
        for n, each in enumerate(lines, 1)
        if each is None
    ]
    whole = [record for record in lines if record]
    if not found and whole[0].get("objects") != len(whole) - 1:
        found.append(Damage(LIST, "lacks lines", mended_by="repair"))
    return found + [
        Damage(name, what, mended_by="repair")
        for name, digest in digests(path).items()
        if (what := _wrong(path, name, digest))
    ]


def _wrong(path: Location, name: str, digest: str) -> str:
    try:
        return "" if sealing.digest(path, [name]) == digest else "is not as it was made"
    except (FileNotFoundError, NotADirectoryError):
        return "is missing"
    except OSError as error:
        return f"can't be read: {error.strerror}"


def refuse_damaged(path: Location) -> None:
    """Refuse a store whose template is not as it was made: what is added might not fit it.

    Raises
    ------
    StoreError
        With the objects, and what to do.
    """
    store.refuse_links(path)
    if found := damages(path):
        listed = "\n".join(f"  {damage.object} {damage.what}" for damage in found)
        raise StoreError(
            f"{path} is not as it was made:\n{listed}\n"
            f"`sweep verify {path} --repair` puts back what was there."
        )


def restore(path: Location, study: Study) -> list[str]:
    """Put a template back as it was made, each object in one step.

    Parameters
    ----------
    path
        The store, whose lock the caller holds.
    study
        What it holds, by its attributes or by a spec that is said to be its own.

    Returns
    -------
    list of str
        Objects that were put back.

    Raises
    ------
    StoreError
        Where this machine can't make the same again. Nothing is touched.
    """
    store.refuse_links(path)
    try:
        written = attributes(path)
    except StoreError:
        written = {}
    if written:
        identity.refuse_other_versions(path, written, where="this machine")
    if written.get("study_id", study.id) != study.id:
        raise StoreError(f"{path / 'zarr.json'} is damaged{opening.remedy(path)}")
    try:
        with tempfile.TemporaryDirectory() as directory:
            aside = Path(directory) / path.name
            store.build(aside, study, written or store.new_attributes(study))
            _refuse_different(path, aside)
            names = sorted(names_below(aside))
            wrong = [name for name in names if not _same(path / name, aside / name)]
            if not (written or "zarr.json" in digests(path)):
                _refuse_unproven(path, study, aside, wrong)
            for name in wrong:
                put_whole(path / name, (aside / name).read_bytes())
    except OSError as error:
        raise StoreError(f"{path} can't be mended: {error.strerror or error}") from error
    return wrong


def _refuse_different(path: Location, aside: Path) -> None:
    """Refuse to put back what an undamaged line of the list says is not what was there."""
    for name, digest in digests(path).items():
        if _wrong(aside, name, digest):
            raise StoreError(
                f"{name} of {path} can't be made again as it was on this machine, or from this "
                "spec: put it back from a copy, or run the study anew into another store"
            )


def _refuse_unproven(path: Location, study: Study, aside: Path, wrong: list[str]) -> None:
    """Refuse a spec that makes other arrays or results, where all else that could tell is lost."""
    if others := set(wrong) - {"zarr.json", LIST}:
        raise StoreError(
            f"{path} holds another study, or too little is left: {min(others)} differs"
        )
    committed = journal.digests(path, study.n_blocks)
    for block in (committed != b"").nonzero()[0][:1].tolist():
        written = store.Arrays(aside, study).write(block, study.evaluate(block))
        for name in store.block_objects(study, block):
            (aside / name).unlink()
        if written.digest.encode() != committed[block]:
            raise StoreError(f"{path} holds another study: its block {block} has other results")


def _same(one: Location, other: Path) -> bool:
    try:
        return one.read_bytes() == other.read_bytes()
    except OSError:
        return False
