import json
from dataclasses import replace

import dask
import pytest
import xarray as xr
from small_studies import (
    STUDY_MAPPING,
    copy_store,
    file_contents,
    file_digests,
    run_serially,
    small_spec,
)

from sweep.tasks.driver import extend, resume, run
from sweep.tasks.engine import cluster_connection
from sweep.tasks.engine.journal import StoreLock
from sweep.tasks.engine.progress import ClusterError, StoreError
from sweep.tasks.engine.study_store import current_software_versions
from sweep.tasks.studies import parameter_grid
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.studies.store_summary import status
from sweep.tasks.studies.store_verification import verify


def altered(store, **changes):
    """Attributes of a store, changed behind its back."""
    path = store / "zarr.json"
    document = json.loads(path.read_text())
    document["attributes"].update(changes)
    path.write_text(json.dumps(document))


def test_resuming_with_a_changed_spec_is_refused_with_the_differences(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    before = file_contents(store)
    other = small_spec(seed=4, target={**STUDY_MAPPING["target"], "reflectance": 0.2})
    with pytest.raises(StoreError) as refusal:
        resume(store, spec=other, progress=False, scheduler="none")
    assert "seed: 3 -> 4" in str(refusal.value)
    assert "target.reflectance: 0.02 -> 0.2" in str(refusal.value)
    with pytest.raises(StoreError, match="seed: 3 -> 4"):
        run_serially(other, store)
    assert file_contents(store) == before


def test_a_changed_title_or_place_of_execution_is_the_same_study(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    spec = small_spec(title="Another title", execution={"workers": 7})
    assert resume(store, spec=spec, progress=False, scheduler="none").blocks_computed == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"software": {**current_software_versions(), "numpy": "1.0"}},
            "numpy: 1.0 in the store, ",
        ),
        ({"model_version": "0.0"}, "model: 0.0 in the store, "),
        ({"study_id": "0" * 32}, "attributes were changed"),
        ({"layout": 99}, "laid out as version 99"),
        ({"spec": "{"}, "can't read"),
    ],
    ids=["software", "model", "id", "layout", "spec"],
)
def test_resuming_with_other_versions_or_altered_attributes_is_refused(
    serial_store, tmp_path, changes, message
):
    store = copy_store(serial_store, tmp_path)
    altered(store, **changes)
    before = file_contents(store)
    with pytest.raises(StoreError, match=message):
        resume(store, progress=False, scheduler="none")
    assert file_contents(store) == before


def test_what_is_no_store_of_ours_is_refused_and_left_as_it_is(tmp_path):
    foreign_dataset = xr.Dataset({"a": ("x", [1.0])})
    foreign_dataset.to_zarr(tmp_path / "theirs.zarr", zarr_format=3, consolidated=False)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "text").write_text("mine")
    (tmp_path / "file").write_text("mine")
    before = file_contents(tmp_path)
    for name, message in (
        ("theirs.zarr", "not one that"),
        ("notes", "not a"),
        ("file", "no Zarr store"),
    ):
        with pytest.raises(StoreError, match=message):
            resume(tmp_path / name, progress=False)
        for overwrite in (False, True):
            with pytest.raises(StoreError, match=message):
                run(small_spec(), store=tmp_path / name, progress=False, overwrite=overwrite)
    with pytest.raises(StoreError, match="there is no store"):
        resume(tmp_path / "absent", progress=False)
    assert file_contents(tmp_path) == before


def test_a_run_into_a_whole_store_of_the_same_study_points_to_status_and_overwrite(serial_store):
    before = file_contents(serial_store)
    with pytest.raises(StoreError, match=r"12 of 12 blocks done: `sweep.status\(.*overwrite=True"):
        run_serially(small_spec(), serial_store)
    assert file_contents(serial_store) == before


def test_overwriting_puts_another_study_in_the_place_of_an_older_versions(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    altered(store, layout=1)
    outcome = run_serially(small_spec(seed=9), store, scheduler="none", overwrite=True)
    assert outcome.complete and outcome.blocks_computed == 12
    assert status(store).study_id == small_spec(seed=9).id
    assert [child.name for child in tmp_path.iterdir()] == ["copy.zarr"]


def test_a_store_that_someone_writes_to_is_neither_resumed_nor_overwritten(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    held = StoreLock(store)
    with pytest.raises(StoreError, match="is being written by process"):
        resume(store, progress=False, scheduler="none")
    with pytest.raises(StoreError, match="is being written by process"):
        run_serially(small_spec(), store, scheduler="none", overwrite=True)
    assert status(store).is_lock_holder_alive
    held.release()
    assert status(store).lock_holder is None


def test_a_worker_with_other_software_writes_nothing(serial_store, tmp_path, monkeypatch):
    store = copy_store(serial_store, tmp_path)
    (store / "pd_up" / "c" / "0" / "5" / "0").unlink()
    before = file_digests(store)
    monkeypatch.setattr("sweep.tasks.engine.study_store.refuse_other_versions", refusing_on_workers)
    with pytest.raises(StoreError, match="worker on"):
        resume(store, progress=False, workers=1, processes=False)
    assert file_digests(store) == before


def refusing_on_workers(path, attributes, model_version, *, reader):
    """As if the workers, and only they, had other software."""
    if reader.startswith("worker"):
        raise StoreError(f"other versions on the {reader}")


def test_a_scheduler_that_does_not_answer_leaves_no_store_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster_connection, "CONNECT_TIMEOUT_SECONDS", 0.5)
    with pytest.raises(ClusterError, match=r"answers at tcp://127\.0\.0\.1:9"):
        run(
            small_spec(),
            store=tmp_path / "small.zarr",
            scheduler="tcp://127.0.0.1:9",
            progress=False,
        )
    assert list(tmp_path.iterdir()) == []
    assert dask.config.get("scheduler", None) is None  # what is read later is read without it


def test_a_store_that_is_cut_into_other_blocks_is_refused(tmp_path, monkeypatch):
    """As of another version: its receipts would be taken for those of other points."""
    spec = small_spec(storage={})
    monkeypatch.setattr(parameter_grid, "DEFAULT_BLOCK_CPU_SECONDS_MIN", 1e-4)
    store = run_serially(spec, tmp_path / "s.zarr").store
    before = file_contents(store)
    monkeypatch.undo()
    for refused in (
        lambda: resume(store, progress=False, scheduler="none"),
        lambda: extend(store, small_spec(storage={}, draws={"number": 10}), scheduler="none"),
        lambda: status(store),
        lambda: verify(store),
        lambda: verify(store, repair=True),
    ):
        with pytest.raises(StoreError, match=r"has blocks of .* in \w+, and this version of sweep"):
            refused()
    assert file_contents(store) == before


def test_a_store_without_an_array_that_is_computed_now_is_refused(tmp_path, monkeypatch):
    """As begun before a variable was added to the model without another version."""
    store = run_serially(small_spec(), tmp_path / "s.zarr").store
    before, known_layouts = file_contents(store), GridStudy.output_layouts

    def with_another(study):
        layouts = known_layouts(study)
        return [*layouts, replace(layouts[0], name="another")]

    monkeypatch.setattr(GridStudy, "output_layouts", with_another)
    with pytest.raises(StoreError, match="has no array another, which this version of sweep"):
        resume(store, progress=False, scheduler="none")
    assert file_contents(store) == before
