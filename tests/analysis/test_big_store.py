"""A store goes through memory piece by piece; `benchmarks/big_store.py` does it with 10 GB."""

import importlib.util
import tracemalloc
from pathlib import Path

import pytest
from zarr.storage import LocalStore

import sweep
from sweep.analysis import opening

FILE = Path(__file__).parents[2] / "benchmarks" / "big_store.py"


@pytest.fixture(scope="module")
def big_store():
    spec = importlib.util.spec_from_file_location("big_store", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_memory_does_not_grow_with_the_store(big_store, tmp_path, monkeypatch):
    monkeypatch.setattr(opening, "PIECE", 2**13)
    sizes, peaks = [], []
    # what is imported and kept on the first time is no part of it
    for number, gigabytes in enumerate((0.002, 0.006, 0.024)):
        path = tmp_path / f"{number}.zarr"
        sizes.append(big_store.make(path, big_store.spec_of(gigabytes, block_points=500, powers=4)))
        tracemalloc.start()
        found = big_store.reduce(path)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert found["points"] == sweep.open(path).attrs["points"]
        assert found["error"] < 1e-6  # [m]: pd is straight in its normal deviate
    # Dask's list of pieces alone: with one chunk a piece it takes half as much as the store.
    assert peaks[2] - peaks[1] < 0.15 * (sizes[2] - sizes[1]), peaks


def test_pieces_are_whole_chunks_and_one_point_is_read_from_one(big_store, tmp_path, monkeypatch):
    path = tmp_path / "small.zarr"
    big_store.make(path, big_store.spec_of(0.01, block_points=900))
    dataset = sweep.open(path)
    array = dataset["pd_shot"]
    assert array.data.npartitions == 1
    stored = array.encoding["chunks"]
    assert all(n >= c for n, c in zip(array.shape, stored, strict=True)) and stored != array.shape
    read = []
    get = LocalStore.get

    async def counted(self, key, *rest, **options):
        read.append(key)
        return await get(self, key, *rest, **options)

    monkeypatch.setattr(LocalStore, "get", counted)
    value = float(array.isel(power=7, range=3, grazing_angle=80))
    assert len(read) == 1
    assert value == float(array.compute().isel(power=7, range=3, grazing_angle=80))
