import shutil
import warnings

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from small_flights import small_scene_spec
from small_studies import file_contents, run_serially, small_spec
from zarr.storage import LocalStore, WrapperStore

import sweep
from sweep.analysis.scene_results.recordings import find_axis_position
from sweep.cli import main
from sweep.storage.locations import file_sizes_below
from sweep.tasks.driver import resume
from sweep.tasks.engine.blocks import ArrayLayout
from sweep.tasks.engine.progress import StoreError
from sweep.tasks.studies.store_summary import flight_summary, status
from sweep.tasks.studies.store_verification import pack_store, shard_shape_of_array, verify


@pytest.fixture(scope="module")
def packed(serial_store, tmp_path_factory):
    return pack_store(
        serial_store, tmp_path_factory.mktemp("packed") / "final.zarr", progress=False
    )


def test_a_packed_copy_has_the_same_values_bit_for_bit_in_a_file_an_array(serial_store, packed):
    before = file_contents(serial_store)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        expected, packed_dataset = xr.open_zarr(serial_store), xr.open_zarr(packed)
    assert list(packed_dataset.variables) == list(expected.variables)
    for name, values in expected.variables.items():
        assert packed_dataset[name].values.tobytes() == values.values.tobytes(), name
        assert (
            packed_dataset[name].attrs == values.attrs and packed_dataset[name].dims == values.dims
        )
        chunks = [f for f in file_sizes_below(packed / name) if f.startswith("c/")]
        assert len(chunks) == 1
    assert file_contents(serial_store) == before
    assert sweep.open(packed).attrs["finished"] == sweep.open(serial_store).attrs["finished"] != ""


def test_a_copy_does_not_name_the_machine_that_made_it(serial_store, packed):
    import socket

    host = socket.gethostname().encode()
    assert any(host in content for content in file_contents(serial_store).values())
    assert not any(host in content for content in file_contents(packed).values())
    assert status(packed).points_done == status(serial_store).points_done == 72


def test_what_reads_stores_reads_the_copy_and_what_writes_them_refuses_it(packed):
    run_status = status(packed)
    assert run_status.complete and run_status.bytes_stored == sum(file_sizes_below(packed).values())
    with pytest.raises(StoreError, match="nothing to resume"):
        resume(packed, progress=False)
    with pytest.raises(StoreError, match="nothing to resume"):
        run_serially(small_spec(), packed)
    with pytest.raises(StoreError, match="is packed already"):
        pack_store(packed, packed.with_name("twice.zarr"))


def test_a_flipped_bit_in_a_copy_is_found(packed, tmp_path):
    import shutil

    copy = shutil.copytree(packed, tmp_path / "copy.zarr")
    assert all(report.is_undamaged for report in verify(copy, progress=False))
    (chunk,) = (copy / "pd_shot" / "c").rglob("0/0/0")
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    (report,) = verify(copy, progress=False)
    assert [damage.object_name for damage in report.damages] == ["pd_shot/c/0/0/0"]


def test_what_is_not_complete_or_in_the_way_is_refused(serial_store, packed, tmp_path):
    from small_studies import copy_store

    store = copy_store(serial_store, tmp_path)
    (store / "pd_up" / "c" / "0" / "5" / "0").unlink()
    with pytest.raises(StoreError, match="lacks 1 block"):
        pack_store(store, tmp_path / "final.zarr")
    assert not (tmp_path / "final.zarr").exists()
    with pytest.raises(StoreError, match="is there already"):
        pack_store(serial_store, packed)


class LosingStore(WrapperStore):
    """A disk that loses what is written to it, and says nothing."""

    async def set(self, key, value, *_):
        pass


def test_a_copy_that_does_not_read_back_is_not_kept(serial_store, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "sweep.tasks.studies.store_verification.to_zarr_store",
        lambda place: LosingStore(LocalStore(place)),
    )
    with pytest.raises(StoreError, match="does not read back as it was written"):
        pack_store(serial_store, tmp_path / "final.zarr")
    assert list(tmp_path.iterdir()) == []


def test_the_copy_goes_to_an_object_store_too(serial_store, tmp_path):
    copied_path = pack_store(serial_store, f"memory://bucket{tmp_path}/final.zarr", progress=False)
    np.testing.assert_array_equal(
        sweep.open(copied_path).pd_shot.values, sweep.open(serial_store).pd_shot.values
    )
    assert all(report.is_undamaged for report in verify(copied_path, progress=False))


def test_a_scene_is_packed_with_all_of_its_metadata(flight, tmp_path):
    store_copy = shutil.copytree(flight.parent, tmp_path, dirs_exist_ok=True) / flight.name
    result = CliRunner().invoke(main, ["finalize", str(store_copy)])
    assert result.exit_code == 0, result.output
    copy = tmp_path / "scene_final.zarr"
    assert len(file_sizes_below(copy)) < len(file_sizes_below(store_copy)) / 2
    assert flight_summary(copy)[0].n_drawn_shots > 0
    for one, other in zip(flight_summary(store_copy), flight_summary(copy), strict=True):
        assert (one.n_drawn_shots, one.n_shots_with_true_return, one.n_false_points) == (
            other.n_drawn_shots,
            other.n_shots_with_true_return,
            other.n_false_points,
        )
    tree = sweep.open_scene(copy)
    recording = find_axis_position(small_scene_spec(), {}).open_recording(tree, "three")
    assert recording.computed_shot_mask(slice(0, 12)).all()


@pytest.mark.parametrize(
    ("shape", "chunks", "expected"),
    [
        ((100, 100), (10, 10), (100, 100)),
        ((10**5, 10**3), (10**3, 10**3), (8 * 10**3, 10**3)),
        ((10**4, 10**4), (10**3, 10**3), (10**3, 8 * 10**3)),
        ((10**3 + 1,), (10,), (1010,)),
        ((), (), None),
    ],
)
def test_a_file_is_whole_chunks_and_no_larger_than_it_may_be(shape, chunks, expected):
    dims = ("x", "y")[: len(shape)]
    layout = ArrayLayout(name="a", shape=shape, chunks=chunks, dims=dims, dtype="float64")
    assert shard_shape_of_array(layout) == expected
