"""A store goes through memory piece by piece; `benchmarks/big_store.py` does it with 10 GB."""

import importlib.util
import tracemalloc
from pathlib import Path

import pytest

import sweep

FILE = Path(__file__).parents[2] / "benchmarks" / "big_store.py"


@pytest.fixture(scope="module")
def big_store():
    spec = importlib.util.spec_from_file_location("big_store", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_store_is_reduced_in_a_fraction_of_its_size_and_rightly(big_store, tmp_path):
    # what is imported and kept on the first time is no part of it
    big_store.make(tmp_path / "small.zarr", big_store.spec_of(0.004, block_points=9000))
    big_store.reduce(tmp_path / "small.zarr")
    path = tmp_path / "big.zarr"
    size = big_store.make(path, big_store.spec_of(0.05, block_points=9000))
    tracemalloc.start()
    found = big_store.reduce(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert size > 45e6
    assert found["points"] == sweep.open(path).attrs["points"]
    assert found["error"] < 1e-6  # [m]: pd is straight in its normal deviate
    assert peak < size / 3
