"""Figure, table and sentences of a store that `sweep accuracy` made."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from sweep.analysis import canvas
from sweep.analysis.accuracy import figure, text
from sweep.analysis.accuracy.settings import Setting, settings_in
from sweep.analysis.opening import ACCURACY, read_attributes
from sweep.storage.locations import Location, beside, zarr_store
from sweep.storage.opening import CHECKED


def opened(store: Location) -> tuple[xr.Dataset, list[Setting]]:
    """The store as a dataset, read whole, and its settings.

    Raises
    ------
    NotAStoreError
        Where there is no such store.
    """
    read_attributes(store, ACCURACY)
    with xr.open_zarr(zarr_store(store), **CHECKED) as dataset:
        whole = dataset.load()
    return whole, settings_in(whole)


def draw(store: Location, directory: Path | None = None, form: str = "png") -> list[Path]:
    """The figure as NAME.png (pdf, svg), the tables as NAME.txt, beside NAME.zarr or elsewhere."""
    dataset, settings = opened(store)
    stem = store.name.removesuffix(".zarr")
    place = beside(store) if directory is None else directory
    file = place / f"{stem}.txt"
    drawn = canvas.save(figure.draw(dataset, settings), place / f"{stem}.{form}")
    file.write_text(text.page(dataset, settings).text(), encoding="utf-8")
    return [drawn, file]
