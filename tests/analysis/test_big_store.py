"""A store goes through memory piece by piece; `benchmarks/big_store.py` does it with 10 GB."""

import tracemalloc
from dataclasses import replace

import big_store
import pytest

import sweep
from sweep.analysis import canvas, charts, datasets
from sweep.analysis.study_figures import draw_figures
from sweep.storage.size_checks import SizeCheckedLocalStore

FIGURES = [
    {"kind": "surface", "variable": "pd_shot", "x": "range", "y": "grazing_angle"},
    {"kind": "slices", "variable": "snr_up", "x": "range", "by": "power",
     "where": {"grazing_angle": "20 deg"}},
    {"kind": "table", "variable": "pd_shot", "rows": "power"},
]  # fmt: skip


def stores(directory, gigabytes, block_points):
    """Stores with their sizes [B]."""
    paths = {}
    for size in gigabytes:
        spec = big_store.spec_of_size(size, block_points=block_points, powers=4, figures=FIGURES)
        paths[directory / f"{size}.zarr"] = big_store.make_store(directory / f"{size}.zarr", spec)
    return paths


def peak_of(work, *arguments):
    """Memory [B] that work takes at most."""
    tracemalloc.start()
    work(*arguments)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def growth(work, sizes, monkeypatch):
    """Memory that work takes more where a store is larger, as a share of what it is larger by."""
    monkeypatch.setattr(datasets, "READ_CHUNK_VALUES_MAX", 2**13)
    work(next(iter(sizes)))  # so that imports and caches are there
    peaks = [peak_of(work, path) for path in sizes]
    smallest, largest = sizes.values()
    return (peaks[1] - peaks[0]) / (largest - smallest)


def test_memory_does_not_grow_with_the_store(tmp_path, monkeypatch):
    def reduce(path):
        reduction = big_store.reduce_store(path)
        assert reduction["points"] == sweep.open(path).attrs["points"]
        assert reduction["error"] < 1e-6  # [m]: pd is straight in its normal deviate

    # Dask's list of pieces alone: with one chunk a piece it takes twice as much as these stores.
    sizes = stores(tmp_path, (0.001, 0.004), 500)
    assert growth(reduce, sizes, monkeypatch) < 0.3


@pytest.mark.slow
def test_neither_does_that_of_its_figures(tmp_path, monkeypatch):
    # as many cells of both, and what they are drawn in left out
    monkeypatch.setattr(
        charts, "SHEET_CHART_SIZE_LIMITS", replace(charts.SHEET_CHART_SIZE_LIMITS, columns_max=20)
    )
    monkeypatch.setattr(charts, "REDUCED_LINE_CELLS_MAX", 5)
    monkeypatch.setattr(canvas, "save_sheet", lambda sheet, path, source: path)
    sizes = stores(tmp_path, (0.006, 0.024), 2000)
    # what grows is what a handful of pieces takes; with all points in memory it was 0.37
    assert growth(lambda path: draw_figures(path, tmp_path), sizes, monkeypatch) < 0.15


def test_pieces_are_whole_chunks_and_one_point_is_read_from_one(tmp_path, monkeypatch):
    path = tmp_path / "small.zarr"
    big_store.make_store(path, big_store.spec_of_size(0.01, block_points=900))
    dataset = sweep.open(path)
    array = dataset["pd_shot"]
    assert array.data.npartitions == 1
    stored = array.encoding["chunks"]
    assert all(n >= c for n, c in zip(array.shape, stored, strict=True)) and stored != array.shape
    read = []
    get = SizeCheckedLocalStore.get

    async def counted(self, key, *rest, **options):
        read.append(key)
        return await get(self, key, *rest, **options)

    monkeypatch.setattr(SizeCheckedLocalStore, "get", counted)
    value = float(array.isel(power=7, range=3, grazing_angle=80))
    assert len(read) == 1
    assert value == float(array.compute().isel(power=7, range=3, grazing_angle=80))
