"""Facts that a store's own bytes do not hold: places of its study's files, the store it extends.

A study is the same wherever its files are, and however much of it was computed before, so that
stands in the journal's directory. It is written anew by whoever runs the study from its spec.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sweep.storage.locations import JOURNAL, Location, put_whole
from sweep.storage.sealing import damaged_lines, read_sealed, sealed
from sweep.tasks.errors import StoreError

RECIPE = "recipe.json"

#: The place of the store that points are taken from, while this one is extended from it.
EXTENDS = "extends"

#: Digests of the modules of the user's that it was begun with.
CODE = "code"

#: Id of the study whose store this one is to take the place of; empty where there is none.
REPLACES = "replaces"


def write_recipe(store_path: Location, **facts: Any) -> None:
    """Put down where a study's files are, in one step."""
    put_whole(store_path / JOURNAL / RECIPE, sealed(facts))


def read_recipe(store_path: Location) -> dict[str, Any]:
    """Facts that were put down; empty where none were, or where they are damaged."""
    records = [record for _, record in read_sealed(store_path / JOURNAL / RECIPE)]
    return records[0] or {} if len(records) == 1 else {}


def forget_older(store_path: Path) -> None:
    """Take away which store a study's extends and replaces."""
    facts = read_recipe(store_path)
    for name in (EXTENDS, REPLACES):
        facts.pop(name, None)
    if facts:
        write_recipe(store_path, **facts)
    else:
        (store_path / JOURNAL / RECIPE).unlink(missing_ok=True)


def refuse_damaged_recipe(store_path: Location) -> None:
    """Refuse a store that no longer says where the files of its study are.

    Raises
    ------
    StoreError
        With what to do.
    """
    path = store_path / JOURNAL / RECIPE
    if damaged_lines(path):
        raise StoreError(
            f"{path} is damaged, and with it where the files of the study are: "
            f"`sweep resume {store_path} --spec FILE` puts it down anew"
        )
