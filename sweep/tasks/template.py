"""Whether a store's template, all that it held before there were results, is as it was made.

Metadata, coordinates and the spec are listed with their digests in the journal's directory. They
follow from the study, so that any of them can be made again, to the same bytes.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from sweep.storage.locations import Location, put_whole
from sweep.storage.sealing import read_sealed
from sweep.tasks import identity, store
from sweep.tasks.errors import StoreError
from sweep.tasks.study import Content

LIST = f"{store.JOURNAL}/{store.MANIFEST}"


class Damage(NamedTuple):
    """An object of a store that is not as it was written."""

    object: str  # path inside the store; a line of a log by its number
    what: str  # what is wrong with it
    block: int = -1  # that it belongs to
    of_template: bool = False  # whether it was there before there were results


def attributes(path: Location) -> dict[str, Any]:
    """Attributes that a store was made with, from its list, else from its group.

    Raises
    ------
    StoreError
        Where there is no store, or not one of this program's.
    """
    for _, record in read_sealed(path / LIST):
        if record and "attributes" in record:
            return identity.recognised(path, record["attributes"])
    return identity.read_attributes(path)


def damages(path: Location) -> list[Damage]:
    """What of a template, or of its list, is not as it was made."""
    lines = [record for _, record in read_sealed(path / LIST)]
    if not lines:
        return [Damage(LIST, "is missing or empty", of_template=True)]
    found = [
        Damage(f"{LIST} line {n}", "is damaged", of_template=True)
        for n, each in enumerate(lines, 1)
        if each is None
    ]
    whole = [record for record in lines if record]
    if not found and whole[0].get("objects") != len(whole) - 1:
        found.append(Damage(LIST, "lacks lines", of_template=True))
    return found + [
        Damage(record["object"], what, of_template=True)
        for record in whole
        if "object" in record and (what := _wrong(path, record["object"], record["digest"]))
    ]


def _wrong(path: Location, name: str, digest: str) -> str:
    try:
        return "" if store.digest(path, [name]) == digest else "is not as it was made"
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
    if found := damages(path):
        listed = "\n".join(f"  {damage.object} {damage.what}" for damage in found)
        raise StoreError(
            f"{path} is not as it was made:\n{listed}\n"
            f"`sweep verify {path} --repair` puts back what was there."
        )


def restore(path: Location, study: Content) -> list[str]:
    """Put a template back as it was made.

    Parameters
    ----------
    path
        The store, whose lock the caller holds.
    study
        What its attributes say that it holds.

    Returns
    -------
    list of str
        Objects that were put back.

    Raises
    ------
    StoreError
        Where this machine can't make the same again. Nothing is touched.
    """
    try:
        with tempfile.TemporaryDirectory() as directory:
            aside = Path(directory) / path.name
            store.build(aside, study, attributes(path))
            _refuse_different(path, aside)
            names = [str(file.relative_to(aside)) for file in aside.rglob("*") if file.is_file()]
            wrong = [name for name in sorted(names) if not _same(path / name, aside / name)]
            for name in wrong:
                put_whole(path / name, (aside / name).read_bytes())
    except OSError as error:
        raise StoreError(f"{path} can't be mended: {error.strerror or error}") from error
    return wrong


def _refuse_different(path: Location, aside: Path) -> None:
    """Refuse to put back what an undamaged line of the list says is not what was there."""
    for _, record in read_sealed(path / LIST):
        if record and "object" in record and _wrong(aside, record["object"], record["digest"]):
            raise StoreError(
                f"{record['object']} of {path} can't be made again as it was on this machine: "
                "put it back from a copy, or run the study anew into another store"
            )


def _same(one: Location, other: Path) -> bool:
    try:
        return one.read_bytes() == other.read_bytes()
    except OSError:
        return False
