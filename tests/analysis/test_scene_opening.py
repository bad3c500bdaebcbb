"""Stores of scenes as trees, and eyepoints as they were cast."""

import json
import shutil

import numpy as np
import pytest
import xarray as xr
from drawn_scenes import scene
from drawn_studies import stored

from sweep.analysis.opening import NotAStoreError, open_scene, stretches
from sweep.analysis.opening import open as open_store
from sweep.analysis.scenes.recording import eyepoints_of, read_eyepoints
from sweep.model.eyepoints import observe
from sweep.model.outputs import CYCLES, NAVIGATION, POINTS, SHOTS, SIMULATED, STATISTICS


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return scene(tmp_path_factory.mktemp("spec"))


def test_a_group_for_each_scanner_holds_what_the_table_of_outputs_says(scene_store):
    tree = open_scene(scene_store)
    assert set(tree.children) == {"square", "pair"}
    for name, navigates in (("square", True), ("pair", False)):
        group = tree.children[name].to_dataset(inherit=False)
        outputs = (
            SHOTS | CYCLES | STATISTICS | SIMULATED | POINTS | (NAVIGATION if navigates else {})
        )
        assert set(group.data_vars) == set(outputs)
        for output, described in outputs.items():
            along = ("power",) if output not in SHOTS | CYCLES else ()
            assert group[output].dims == along + described.dims
            assert group[output].attrs["units"] == described.units
            assert group[output].dtype == described.dtype
        assert group.power.attrs["units"] == "mW" and group.power.values.tolist() == [0.3, 1000.0]


def test_arrays_are_read_in_chunks_when_they_are_needed(scene_store):
    flags = open_scene(scene_store)["square"]["flags"]
    assert flags.chunks is not None and flags.chunks[1][0] == 64


def test_a_finished_store_counts_all_shots_of_all_scanners_draws_and_places(scene_store, spec):
    attributes = open_scene(scene_store).attrs
    shots = sum(spec.cycles(name) * spec.shots_a_cycle(name) for name in spec.scanners)
    assert attributes["points"] == attributes["points_committed"] == shots * 3 * 2
    assert attributes["blocks"] == attributes["blocks_committed"] == 2 * 2 * (5 + 5)
    assert attributes["started"] <= attributes["finished"] != ""


def test_a_store_cut_short_counts_what_is_committed(scene_store, tmp_path):
    copy = shutil.copytree(scene_store, tmp_path / "short.zarr")
    log = copy / ".sweep" / "receipts.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    log.write_text(lines[0] + lines[0] + lines[1] + lines[2][:15])
    attributes = open_scene(copy).attrs
    assert attributes["blocks_committed"] == 2 and attributes["finished"] == ""
    counted = sum(json.loads(line)["points"] for line in lines[:2])
    assert attributes["points_committed"] == counted < attributes["points"]


def test_each_kind_of_store_is_refused_where_another_is_asked_for(scene_store, tmp_path):
    grid = stored(tmp_path, {"target.range": ["1 km", "2 km"]})
    with pytest.raises(NotAStoreError, match=r"scene's point clouds: sweep\.open_scene\(\)"):
        open_store(scene_store)
    with pytest.raises(NotAStoreError, match=r"grid of points: sweep\.open\(\)"):
        open_scene(grid)
    eyepoints = next((scene_store.parent / "eyepoints").glob("*.zarr"))
    with pytest.raises(NotAStoreError, match="holds the eyepoints of a flight"):
        open_scene(eyepoints)
    with pytest.raises(NotAStoreError, match=r"no store at .*; stores near it: .*scene\.zarr"):
        open_scene(scene_store.with_name("scenes.zarr"))
    with pytest.raises(NotAStoreError, match="is not a Zarr store"):
        open_scene(tmp_path)


@pytest.mark.parametrize(("size", "most"), [(1, 7), (20, 14), (1000, 100)])
def test_stretches_are_whole_chunks_and_cover_all_once(size, most):
    array = xr.DataArray(np.zeros((2, 100)), dims=("power", "shot"))
    array.encoding["preferred_chunks"] = {"power": 1, "shot": 7}
    parts = stretches(array, "shot", size)
    covered = np.concatenate([np.arange(100)[part] for part in parts])
    assert covered.tolist() == list(range(100))
    assert all(part.start % 7 == 0 for part in parts)
    assert max(part.stop - part.start for part in parts) == most


def test_eyepoints_read_back_are_those_cast_anew_bit_for_bit(scene_store, spec):
    world, tree = spec.world(), open_scene(scene_store)
    index = np.array([3, 77, 130, 311])
    for name in spec.scanners:
        found = read_eyepoints(eyepoints_of(scene_store, tree[name].to_dataset()), index)
        cast = observe(
            index,
            flight=spec.flight(),
            scanner=spec.scan(name),
            caster=world.caster,
            beam_divergence=spec.instrument.laser.beam_divergence,
            number=spec.footprint.beamlets,
            pattern=spec.pattern,
            bodies=world.bodies,
        )
        for field, array in cast._asdict().items():
            equal_nan = array.dtype.kind == "f"
            assert np.array_equal(getattr(found, field), array, equal_nan=equal_nan), field


def test_eyepoints_that_are_gone_are_told_with_a_remedy(tmp_path):
    with pytest.raises(NotAStoreError, match="running the study again casts them anew"):
        read_eyepoints(tmp_path / "none.zarr", np.array([0]))
