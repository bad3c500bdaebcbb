import json
import logging
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from small_studies import file_contents, run_serially, small_spec

from sweep.storage import store_format
from sweep.tasks.engine import study_store
from sweep.tasks.engine.progress import StoreError
from sweep.tasks.studies.grid_study import GridStudy


@pytest.fixture
def spec():
    return small_spec()


@pytest.fixture
def study(spec):
    return GridStudy(spec)


@pytest.fixture
def path(tmp_path, study):
    return study_store.create_store(tmp_path / "new" / "small.zarr", study)


def is_whole(path, objects):
    return all((path / name).is_file() for name in objects)


def test_plain_xarray_opens_a_new_store_without_a_warning(path, spec):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dataset = xr.open_zarr(path)
    assert dataset.sizes == {"power": 2, "range": 12, "grazing_angle": 3}
    assert dataset.range.units == "m" and dataset.grazing_angle.units == "deg"
    np.testing.assert_allclose(dataset.grazing_angle, [20, 50, 90])
    assert dataset.pd_shot.dims == ("power", "range", "grazing_angle")
    assert dataset.pd_shot.long_name and dataset.pd_shot.units == "1"
    assert bool(np.isnan(dataset.pd_shot).all())
    assert dataset.attrs["study_id"] == spec.id
    assert f"numpy {np.__version__}" in dataset.attrs["software"]


def test_the_metadata_of_all_arrays_is_in_the_groups_own(path):
    consolidated = json.loads((path / "zarr.json").read_text())["consolidated_metadata"]
    names = {child.name for child in path.iterdir() if (child / "zarr.json").exists()}
    assert set(consolidated["metadata"]) == names
    for name in names:
        assert consolidated["metadata"][name] == json.loads((path / name / "zarr.json").read_text())


def test_members_of_a_zipped_axis_and_words_open_as_coordinates(tmp_path):
    axes = {
        "cut": {"zip": [{"target.range": ["1 km", "2 km"], "target.grazing_angle": "15 deg"}]},
        "instrument.processing.window": ["hamming", "hann"],
    }
    spec = small_spec(axes=axes)
    path = study_store.create_store(tmp_path / "cut.zarr", GridStudy(spec))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dataset = xr.open_zarr(path)
    assert set(dataset.coords) == {"range", "grazing_angle", "window"}
    assert dataset.range.dims == ("cut",)
    assert [str(name) for name in dataset.window.values] == ["hamming", "hann"]


def test_a_written_block_reads_back_bit_for_bit_and_fills_its_chunks(path, study, caplog):
    caplog.set_level(logging.DEBUG, logger="sweep.study_store")
    results = study.evaluate(3)
    arrays = study_store.BlockWriter(path, study)
    objects = study_store.chunk_names_of_block(study, 3)
    assert not is_whole(path, objects)
    receipt = arrays.write(3, results)
    assert is_whole(path, objects)
    assert receipt.digest == store_format.stored_objects_digest(path, objects)
    assert receipt.n_bytes == sum((path / name).stat().st_size for name in objects)
    (message,) = (record.getMessage() for record in caplog.records)
    counts = f"{len(objects)} chunks of {receipt.n_bytes} bytes in all"
    assert re.fullmatch(rf"{re.escape(str(path))}: wrote block 3, {counts}, in .* s", message)
    dataset = xr.open_zarr(path)
    for name, values in results.items():
        stored = dataset[name].values[study.grid.block_slices(3)]
        assert stored.tobytes() == np.ascontiguousarray(values).tobytes()
    assert int(dataset.pd_shot.notnull().sum()) == study.count_block_points(3)


def test_a_block_of_nothing_but_the_fill_value_is_written_all_the_same(path, study):
    layouts = {layout.name: layout for layout in study.array_layouts()}
    results = {
        name: np.full(
            study.grid.actual_block_shape(1), layouts[name].fill_value, dtype=layouts[name].dtype
        )
        for name in study.chunk_positions_of_block(1)
    }
    study_store.BlockWriter(path, study).write(1, results)
    assert is_whole(path, study_store.chunk_names_of_block(study, 1))


def test_part_of_a_chunk_and_wrong_names_are_refused(path, study):
    arrays = study_store.BlockWriter(path, study)
    results = study.evaluate(0)
    with pytest.raises(ValueError, match="whole chunks only"):
        arrays.write(0, {**results, "pd_shot": results["pd_shot"][:1]})
    with pytest.raises(ValueError, match="surprise"):
        arrays.write(0, {**results, "surprise": results["pd_shot"]})


def test_a_study_without_axes_and_one_with_draws_store_their_chunks(tmp_path):
    spec = small_spec(axes={}, draws={"number": 250, "batch": 100})
    study = GridStudy(spec)
    path = study_store.create_store(tmp_path / "draws.zarr", study)
    study_store.BlockWriter(path, study).write(0, study.evaluate(0))
    assert is_whole(path, study_store.chunk_names_of_block(study, 0))
    dataset = xr.open_zarr(path)
    assert dataset.pd_shot.dims == ()
    assert dataset.n_detected_up.dims == ("batch",)
    assert dataset.n_detected_up.dtype == np.int64
    assert dataset.batch_draws.values.tolist() == [100, 100, 50]
    counted, batch_draws = dataset.n_detected_up.values, dataset.batch_draws.values
    assert np.all((counted >= 0) & (counted <= batch_draws))


def test_a_store_is_never_made_in_the_place_of_something_else(path, study):
    before = file_contents(path)
    with pytest.raises(StoreError, match="is there already"):
        study_store.create_store(path, study)
    assert file_contents(path) == before
    assert [child.name for child in path.parent.iterdir()] == [path.name]


def test_a_creation_cut_short_leaves_no_store(tmp_path, study, monkeypatch):
    monkeypatch.setattr(
        study_store, "_consolidate_metadata", lambda path: (_ for _ in ()).throw(KeyboardInterrupt)
    )
    with pytest.raises(KeyboardInterrupt):
        study_store.create_store(tmp_path / "small.zarr", study)
    assert list(tmp_path.iterdir()) == []


def test_a_place_where_no_directory_can_be_made_is_reported_with_a_remedy():
    with pytest.raises(StoreError, match=r"/proc/x.zarr can't be made: .*; name another place, st"):
        run_serially(small_spec(), Path("/proc/x.zarr"))
