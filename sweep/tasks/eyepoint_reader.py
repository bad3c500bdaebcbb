"""Eyepoints read back from their store."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.outputs import BEAMLETS, CYCLES, SHOTS
from sweep.storage.locations import Location
from sweep.storage.opening import open_group
from sweep.tasks.study import Results

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints


class EyepointReader:
    """Stretches of an eyepoint store.

    Parameters
    ----------
    path
        The store.
    """

    def __init__(self, path: Location) -> None:
        group: Any = open_group(path)
        self._shots, self._beamlets, self._cycles = (
            {name: group[name] for name in names} for names in (SHOTS, BEAMLETS, CYCLES)
        )
        self._weight = np.asarray(group["weight"][...])

    def shots(self, first: int, stop: int) -> tuple[Results, Eyepoints]:
        """Arrays of the shots from `first` to before `stop`, and their eyepoints."""
        from sweep.scenes.eyepoint_arrays import from_arrays

        shots = _read(self._shots, first, stop)
        return shots, from_arrays(shots | _read(self._beamlets, first, stop), self._weight)

    def cycles(self, first: int, stop: int) -> Results:
        """Truth of the cycles from `first` to before `stop`."""
        return _read(self._cycles, first, stop)


def _read(arrays: Mapping[str, Any], first: int, stop: int) -> Results:
    return {name: np.asarray(array[first:stop]) for name, array in arrays.items()}
