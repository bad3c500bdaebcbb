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


def peak_of_reducing(big_store, path):
    """Memory [B] that a reduction takes at most; of two, as imports and caches count in one."""
    peaks = []
    for _ in range(2):
        tracemalloc.start()
        found = big_store.reduce(path)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert found["points"] == sweep.open(path).attrs["points"]
        assert found["error"] < 1e-6  # [m]: pd is straight in its normal deviate
    return min(peaks)


def test_memory_does_not_grow_with_the_store(big_store, tmp_path, monkeypatch):
    monkeypatch.setattr(opening, "PIECE", 2**13)
    sizes, peaks = [], []
    for gigabytes in (0.001, 0.006):
        path = tmp_path / f"{gigabytes}.zarr"
        sizes.append(big_store.make(path, big_store.spec_of(gigabytes, block_points=500, powers=4)))
        peaks.append(peak_of_reducing(big_store, path))
    # Dask's list of pieces alone: with one chunk a piece it takes twice as much as these stores.
    assert peaks[1] - peaks[0] < 0.3 * (sizes[1] - sizes[0]), (peaks, sizes)


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
