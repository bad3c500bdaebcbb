import json
import shutil

import numpy as np
import pytest
import xarray as xr
from stored_studies import POWER_AND_CUT_AXES, SURFACE_AXES, run_into_store, spec_over_axes

import sweep
from sweep.analysis.datasets import (
    NotAStoreError,
    chunk_aligned_slices,
    open_scene,
    sum_draw_batches,
)
from sweep.analysis.datasets import open as open_store
from sweep.analysis.scene_results.recordings import read_eyepoints
from sweep.model.outputs import (
    CYCLE_VARIABLES,
    EFFECT_VARIABLES,
    GRID_OUTPUTS,
    NAVIGATION_VARIABLES,
    POINT_CLOUD_VARIABLES,
    SHOT_GEOMETRY_VARIABLES,
    SHOT_STATISTIC_VARIABLES,
)
from sweep.model.pointcloud.eyepoints import compute_eyepoints


@pytest.fixture(scope="module")
def surface(tmp_path_factory):
    return run_into_store(tmp_path_factory.mktemp("surface"), SURFACE_AXES)


def test_dimensions_and_units_are_those_of_the_spec(surface):
    dataset = sweep.open(surface)
    assert dict(dataset.sizes) == {"range": 24, "grazing_angle": 9}
    assert dataset.range.attrs["units"] == "m"
    assert dataset.grazing_angle.values[0] == 10
    for name, output in GRID_OUTPUTS.items():
        assert dataset[name].attrs["units"] == output.units
        assert dataset[name].attrs["long_name"] == output.long_name


def test_a_finished_store_says_when_and_that_it_is_whole(surface):
    attributes = open_store(surface).attrs
    assert attributes["points"] == attributes["points_committed"] == 216
    assert attributes["blocks"] == attributes["blocks_committed"]
    assert attributes["started"] <= attributes["finished"]
    assert np.datetime64(attributes["finished"].removesuffix("+00:00")) > np.datetime64("2020")
    assert attributes["study_id"] == spec_over_axes(SURFACE_AXES).id


@pytest.mark.parametrize("kind", ["grid", "flight"])
def test_a_store_cut_short_counts_what_is_committed_and_is_not_finished(
    kind, tmp_path, scene_store
):
    if kind == "grid":
        path = run_into_store(tmp_path, SURFACE_AXES, storage={"block_points": 50})
    else:
        path = shutil.copytree(scene_store, tmp_path / "short.zarr")
    log = path / ".sweep" / "receipts.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    # the first receipt twice, and a line cut short by a crash
    log.write_text(lines[0] + lines[0] + lines[1] + lines[2][:15])
    attributes = (open_store if kind == "grid" else open_scene)(path).attrs
    first, second = (json.loads(line)["points"] for line in lines[:2])
    assert attributes["blocks"] == len(lines)
    assert attributes["blocks_committed"] == 2
    assert attributes["points_committed"] == first + second < attributes["points"]
    assert attributes["finished"] == ""


def test_coordinates_of_a_zipped_axis_share_its_dimension(tmp_path):
    dataset = open_store(run_into_store(tmp_path, POWER_AND_CUT_AXES))
    assert dataset.pd_shot.dims == ("power", "cut")
    assert dataset.range.dims == dataset.grazing_angle.dims == ("cut",)
    assert set(np.unique(dataset.grazing_angle.where(dataset.range == 5, drop=True))) == {15, 85}


def test_counts_of_draws_are_summed_over_batches_and_a_batch_not_counted_voids_the_sum():
    counts = np.array([[3, 4, 5], [6, -1, 2]])
    dataset = xr.Dataset(
        {"n_detected_shot": (("range", "batch"), counts, {"units": "1"}), "pd": ("range", [1, 2])},
        coords={"batch_draws": ("batch", [10, 10, 7])},
    )
    result = sum_draw_batches(dataset)
    assert result.n_detected_shot.values.tolist() == [12, -1]
    assert result.n_detected_shot.attrs["units"] == "1"
    assert set(result.dims) == {"range"}


def test_a_store_of_draws_opens_with_their_sums(tmp_path):
    path = run_into_store(
        tmp_path, {"target.range": ["1 km", "3 km"]}, draws={"number": 25, "batch": 10}
    )
    dataset = open_store(path)
    assert dataset.n_draws.values.tolist() == [25, 25]
    assert "batch" not in dataset.dims
    assert ((dataset.n_detected_shot >= 0) & (dataset.n_detected_shot <= 25)).all()


@pytest.mark.parametrize("open_it", [open_store, open_scene])
def test_what_is_no_store_is_refused_in_words_that_name_the_stores_nearby(
    open_it, surface, tmp_path
):
    with pytest.raises(NotAStoreError, match=r"no store at .*; stores near it: .*study\.zarr"):
        open_it(surface.with_name("stduy.zarr"))
    with pytest.raises(NotAStoreError, match="is not a Zarr store"):
        open_it(tmp_path)
    (tmp_path / "zarr.json").write_text('{"attributes": {"title": "something else"}}')
    with pytest.raises(NotAStoreError, match="not one that sweep made"):
        open_it(tmp_path)


def test_each_kind_of_store_is_refused_where_another_is_asked_for(surface, scene_store):
    with pytest.raises(NotAStoreError, match=r"scene's point clouds: sweep\.open_scene\(\)"):
        open_store(scene_store)
    with pytest.raises(NotAStoreError, match=r"grid of points: sweep\.open\(\)"):
        open_scene(surface)
    eyepoints = next((scene_store.parent / "eyepoints").glob("*.zarr"))
    with pytest.raises(NotAStoreError, match="holds the eyepoints of a flight"):
        open_scene(eyepoints)


def test_a_group_for_each_scanner_holds_what_the_table_of_outputs_says(scene_store):
    tree = open_scene(scene_store)
    assert set(tree.children) == {"square", "pair", "scene_map"}
    for name, navigates in (("square", True), ("pair", False)):
        group = tree.children[name].to_dataset(inherit=False)
        outputs = (
            SHOT_GEOMETRY_VARIABLES
            | CYCLE_VARIABLES
            | SHOT_STATISTIC_VARIABLES
            | EFFECT_VARIABLES
            | POINT_CLOUD_VARIABLES
            | (NAVIGATION_VARIABLES if navigates else {})
        )
        assert set(group.data_vars) == set(outputs)
        for output, described in outputs.items():
            along = ("power",) if output not in SHOT_GEOMETRY_VARIABLES | CYCLE_VARIABLES else ()
            assert group[output].dims == along + described.dims
            assert group[output].attrs["units"] == described.units
            assert group[output].dtype == described.dtype
        assert group.power.attrs["units"] == "mW" and group.power.values.tolist() == [0.3, 1000.0]


def test_arrays_are_read_in_chunks_when_they_are_needed(scene_store):
    flags = open_scene(scene_store)["square"]["flags"]
    assert flags.chunks is not None and flags.chunks[1][0] == 128


def test_a_finished_store_counts_all_shots_of_all_scanners_draws_and_places(scene_store, spec):
    attributes = open_scene(scene_store).attrs
    shots = sum(spec.number_of_cycles(name) * spec.shots_per_cycle(name) for name in spec.scanners)
    assert attributes["points"] == attributes["points_committed"] == shots * 3 * 2
    assert attributes["blocks"] == attributes["blocks_committed"] == 2 * 2 * (3 + 3)
    assert attributes["started"] <= attributes["finished"] != ""


@pytest.mark.parametrize(("size", "size_max"), [(1, 7), (20, 14), (1000, 100)])
def test_stretches_are_whole_chunks_and_cover_all_once(size, size_max):
    array = xr.DataArray(np.zeros((2, 100)), dims=("power", "shot"))
    array.encoding["preferred_chunks"] = {"power": 1, "shot": 7}
    parts = chunk_aligned_slices(array, "shot", size)
    covered = np.concatenate([np.arange(100)[part] for part in parts])
    assert covered.tolist() == list(range(100))
    assert all(part.start % 7 == 0 for part in parts)
    assert max(part.stop - part.start for part in parts) == size_max


def test_eyepoints_read_back_equal_those_cast_again_bit_for_bit(scene_store, spec):
    world, tree = spec.build_scene(), open_scene(scene_store)
    index = np.array([3, 77, 130, 311])
    for name in spec.scanners:
        eyepoints = read_eyepoints(scene_store, tree[name].to_dataset(), index)
        cast = compute_eyepoints(
            index,
            flight=spec.build_flight(),
            scanner=spec.scan_pattern(name),
            caster=world.caster,
            beam_divergence=spec.instrument.laser.beam_divergence,
            n_beamlets=spec.footprint.beamlets,
            pattern=spec.beamlet_pattern,
            body_motions=world.body_motions,
        )
        for field, array in cast._asdict().items():
            equal_nan = array.dtype.kind == "f"
            assert np.array_equal(getattr(eyepoints, field), array, equal_nan=equal_nan), field


def test_eyepoints_that_are_gone_are_reported_with_a_remedy(tmp_path):
    with pytest.raises(NotAStoreError, match="running the study again casts them anew"):
        read_eyepoints(tmp_path, xr.Dataset(attrs={"geometry_id": "none"}), np.array([0]))
