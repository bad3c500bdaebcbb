import json

import numpy as np
import pytest
import xarray as xr
from drawn_studies import POWERS, SURFACE, stored, study

import sweep
from sweep.analysis.opening import NotAStoreError, merged
from sweep.analysis.opening import open as open_store
from sweep.model.outputs import OUTPUTS


@pytest.fixture(scope="module")
def surface(tmp_path_factory):
    return stored(tmp_path_factory.mktemp("surface"), SURFACE)


def test_dimensions_and_units_are_those_of_the_spec(surface):
    dataset = sweep.open(surface)
    assert dict(dataset.sizes) == {"range": 24, "grazing_angle": 9}
    assert dataset.range.attrs["units"] == "m"
    assert dataset.grazing_angle.values[0] == 10
    for name, output in OUTPUTS.items():
        assert dataset[name].attrs["units"] == output.units
        assert dataset[name].attrs["long_name"] == output.long_name


def test_a_finished_store_says_when_and_that_it_is_whole(surface):
    attributes = open_store(surface).attrs
    assert attributes["points"] == attributes["points_committed"] == 216
    assert attributes["blocks"] == attributes["blocks_committed"]
    assert attributes["started"] <= attributes["finished"]
    assert np.datetime64(attributes["finished"].removesuffix("+00:00")) > np.datetime64("2020")
    assert attributes["study_id"] == study(SURFACE).id


def test_a_store_cut_short_counts_what_is_committed_and_is_not_finished(tmp_path):
    path = stored(tmp_path, SURFACE, storage={"block_points": 50})
    log = path / ".sweep" / "receipts.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    # the first receipt twice, and a line cut short by a crash
    log.write_text(lines[0] + lines[0] + lines[1] + lines[2][:20])
    attributes = open_store(path).attrs
    first, second = (json.loads(line)["points"] for line in lines[:2])
    assert attributes["blocks"] == len(lines)
    assert attributes["blocks_committed"] == 2
    assert attributes["points_committed"] == first + second
    assert attributes["finished"] == ""


def test_coordinates_of_a_zipped_axis_share_its_dimension(tmp_path):
    dataset = open_store(stored(tmp_path, POWERS))
    assert dataset.pd_shot.dims == ("power", "cut")
    assert dataset.range.dims == dataset.grazing_angle.dims == ("cut",)
    assert set(np.unique(dataset.grazing_angle.where(dataset.range == 5, drop=True))) == {15, 85}


def test_counts_of_draws_are_summed_over_batches_and_a_batch_not_counted_voids_the_sum():
    counts = np.array([[3, 4, 5], [6, -1, 2]])
    dataset = xr.Dataset(
        {"n_detected_shot": (("range", "batch"), counts, {"units": "1"}), "pd": ("range", [1, 2])},
        coords={"batch_draws": ("batch", [10, 10, 7])},
    )
    result = merged(dataset)
    assert result.n_detected_shot.values.tolist() == [12, -1]
    assert result.n_detected_shot.attrs["units"] == "1"
    assert set(result.dims) == {"range"}


def test_a_store_of_draws_opens_with_their_sums(tmp_path):
    path = stored(tmp_path, {"target.range": ["1 km", "3 km"]}, draws={"number": 25, "batch": 10})
    dataset = open_store(path)
    assert dataset.n_draws.values.tolist() == [25, 25]
    assert "batch" not in dataset.dims
    assert ((dataset.n_detected_shot >= 0) & (dataset.n_detected_shot <= 25)).all()


def test_what_is_no_store_is_refused_in_words_that_name_the_stores_nearby(surface, tmp_path):
    with pytest.raises(NotAStoreError, match=r"no store at .*; stores near it: .*study\.zarr"):
        open_store(surface.with_name("stduy.zarr"))
    with pytest.raises(NotAStoreError, match="is not a Zarr store"):
        open_store(tmp_path)
    (tmp_path / "zarr.json").write_text('{"attributes": {"title": "something else"}}')
    with pytest.raises(NotAStoreError, match="not one that sweep made"):
        open_store(tmp_path)
