"""Eyepoints read back from the store beside that of a scene's point clouds."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sweep.analysis.opening import read_attributes
from sweep.model.eyepoints import Eyepoints
from sweep.model.outputs import BEAMLETS, SHOTS
from sweep.scenes.eyepoint_arrays import from_arrays
from sweep.storage.atomic_replace import real
from sweep.storage.locations import Location, zarr_store
from sweep.storage.opening import CHECKED, NotAStoreError

FOLDER = "eyepoints"
"""Folder of the eyepoints of all studies whose stores lie beside it."""


def eyepoints_of(store_path: Location, scanner: xr.Dataset) -> Location:
    """Store of the eyepoints that a scanner's clouds were made of."""
    return real(store_path).parent / FOLDER / f"{scanner.attrs['geometry_id']}.zarr"


def read_eyepoints(path: Location, index: np.ndarray) -> Eyepoints:
    """Eyepoints of some shots.

    Parameters
    ----------
    path
        Store of the eyepoints.
    index : (n,) int ndarray
        Numbers of the shots.

    Raises
    ------
    NotAStoreError
        Where the store is not there.
    """
    if not path.exists():
        raise NotAStoreError(
            f"the eyepoints of the study are not at {path}: they are kept beside its store; "
            "running the study again casts them anew"
        )
    read_attributes(path, "eyepoints")
    dataset = xr.open_zarr(zarr_store(path), chunks=None, **CHECKED)
    chosen = dataset.isel(shot=np.asarray(index))
    arrays = {name: np.asarray(chosen[name].values) for name in (*SHOTS, *BEAMLETS)}
    return from_arrays(arrays, np.asarray(dataset["weight"].values))
