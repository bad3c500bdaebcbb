"""Chunks written by hand beside those that Zarr writes: the same bytes, and whole or absent."""

import itertools

import numpy as np
import pytest
import zarr

from sweep.storage import locations
from sweep.tasks.engine.blocks import ArrayLayout
from sweep.tasks.engine.study_store import CHUNK_CODECS, encode_chunk

TYPES = ["float64", "float32", "int64", "uint8", "uint64", "int16", "bool"]


def array_at(path, shape, chunk, dtype, fill):
    array = zarr.create_array(
        path, shape=shape, chunks=chunk, dtype=dtype, fill_value=fill, compressors=CHUNK_CODECS
    )
    return array.with_config({"write_empty_chunks": True})


def layout_of(array):
    dims = tuple(map(str, range(array.ndim)))
    return ArrayLayout(
        name="array", shape=array.shape, chunks=array.chunks, dims=dims, dtype=str(array.dtype),
        fill_value=array.fill_value,
    )  # fmt: skip


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize(
    ("shape", "chunk"), [((7,), (3,)), ((5, 4), (2, 4)), ((3, 5, 2), (3, 2, 2)), ((), ())]
)
def test_every_chunk_is_zarrs_byte_for_byte(tmp_path, dtype, shape, chunk):
    generator = np.random.default_rng(3)
    values = np.asarray(generator.normal(0, 100, shape)).astype(dtype)
    fill = np.nan if dtype.startswith("float") else 0 if dtype != "uint8" else 255
    by_zarr = array_at(tmp_path / "zarr", shape, chunk, dtype, fill)
    by_hand = array_at(tmp_path / "hand", shape, chunk, dtype, fill)
    by_zarr[...] = values
    counts = [-(-s // c) for s, c in zip(shape, chunk, strict=True)]
    for position in itertools.product(*map(range, counts)):
        at = tuple(slice(p * c, (p + 1) * c) for p, c in zip(position, chunk, strict=True))
        file = tmp_path / "hand" / "/".join(["c", *map(str, position)])
        locations.atomic_write_file(str(file), encode_chunk(layout_of(by_hand), values[at]))
        assert (
            file.read_bytes()
            == (tmp_path / "zarr" / file.relative_to(tmp_path / "hand")).read_bytes()
        )
    np.testing.assert_array_equal(by_hand[...], values)


def test_chunks_equal_to_the_fill_and_values_of_the_other_byte_order(tmp_path):
    by_zarr = array_at(tmp_path / "zarr", (4,), (4,), "float64", np.nan)
    by_zarr[...] = np.full(4, np.nan)
    layout = layout_of(by_zarr)
    content = encode_chunk(layout, np.full(4, np.nan))
    assert content == (tmp_path / "zarr/c/0").read_bytes()
    swapped = np.arange(4.0).astype(">f8")
    assert encode_chunk(layout, swapped) == encode_chunk(layout, np.arange(4.0))


def test_a_write_that_fails_leaves_what_was_there(tmp_path, monkeypatch):
    file = tmp_path / "c" / "0"
    locations.atomic_write_file(str(file), b"old")

    def full(*_):
        raise OSError(28, "no space left")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="no space"):
        locations.atomic_write_file(str(file), b"new")
    assert file.read_bytes() == b"old"
    assert [name.name for name in file.parent.iterdir()] == ["0"]
