"""Stores that are read piece by piece, as long as they are the ones that were opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from zarr.storage import LocalStore

from sweep.storage.atomic_replace import stamp
from sweep.storage.locations import Location, zarr_store
from sweep.storage.opening import study_id


class ReplacedError(ValueError):
    """A store that was extended or replaced since it was opened."""


class Unreplaced(LocalStore):
    """A store on disk whose every read fails once another study's store is in its place.

    Parameters
    ----------
    root, held
        The store, and the id of the study that it is read for.
    """

    def __init__(self, root: Path, held: str) -> None:
        super().__init__(root, read_only=True)
        self._study_id = held
        self._seen: tuple[int, ...] | None = None

    async def get(self, *key: Any, **options: Any) -> Any:
        """The bytes of a file; which store it is is looked at after they are read."""
        found = await super().get(*key, **options)
        now = stamp(self.root)
        if now is None or now != self._seen:  # repaired, or another's
            if study_id(self.root) != self._study_id:
                raise ReplacedError(
                    f"{self.root} was extended, replaced or removed since it was opened: "
                    "open it again"
                )
            self._seen = now
        return found


def readable(location: Location, held: str) -> Any:
    """The store of a study as xarray opens it to read it lazily."""
    return Unreplaced(location, held) if isinstance(location, Path) else zarr_store(location)
