"""Points in long form, cropped and thinned, against loops over the arrays of the store."""

import shutil

import numpy as np
import pytest
import xarray as xr
from stored_scenes import GROUND_SLOPE, copy_without_last_cycles

from sweep.analysis.datasets import open_scene_tree
from sweep.analysis.scene_results.recordings import (
    INFINITE_VALUE_LIMITS,
    POINT_KIND_BITS,
    QUANTITY_BY_NAME,
    ThinnedRows,
    find_axis_position,
    point_kind_indices,
    select_rows_within,
    to_displayed_values,
)
from sweep.analysis.selection import parameters_at
from sweep.model.pointcloud.pairing import FLAG_BITS, TRUE_RETURN_FLAG
from sweep.spec import SpecError
from sweep.spec.figure_sections import SCENE_FIGURE_QUANTITIES as OF_SPECS


@pytest.fixture
def weak(scene_store, spec):
    """What the square saw at the lower power."""
    return find_axis_position(spec, {"power": "0.3 mW"}).open_recording(
        open_scene_tree(scene_store), "square"
    )


@pytest.fixture(scope="module")
def arrays(scene_store):
    return xr.open_zarr(scene_store, group="square", chunks=None).isel(power=0).load()


def all_points(recording, names, **options):
    parts = [
        recording.point_columns(names, part, **options) for part in recording.iter_shot_slices()
    ]
    return {name: np.concatenate([part[name] for part in parts]) for name in names}


def test_every_quantity_of_specs_can_be_shown():
    assert set(OF_SPECS) == set(QUANTITY_BY_NAME)


@pytest.mark.parametrize("draw", [0, 2])
@pytest.mark.parametrize("ranges", ["quantised", "interpolated"])
def test_points_are_those_with_flags_in_the_order_of_shots_and_returns(weak, arrays, draw, ranges):
    names = ["x", "y", "z", "range", "radial_velocity", "snr", "flags", "shot", "beam",
             "return_number", "returns", "pd_shot"]  # fmt: skip
    points = all_points(weak, names, draw=draw, ranges=ranges)
    suffix = "_interpolated" if ranges == "interpolated" else ""
    row = 0
    for shot in range(arrays.sizes["shot"]):
        shot_arrays = arrays.isel(shot=shot)
        flags = shot_arrays.flags.values[draw]
        for k in np.flatnonzero(flags):
            along = shot_arrays.beam_direction.values * float(
                shot_arrays[f"range{suffix}"][draw, k]
            )
            expected = shot_arrays.platform_position.values + along
            assert [points[axis][row] for axis in "xyz"] == pytest.approx(expected, abs=1e-9)
            for name in ("range", "radial_velocity"):
                assert points[name][row] == shot_arrays[f"{name}{suffix}"].values[draw, k]
            assert points["snr"][row] == shot_arrays.snr.values[draw, k]
            assert (points["shot"][row], points["beam"][row]) == (shot, int(shot_arrays.beam))
            assert (points["return_number"][row], points["returns"][row]) == (k, (flags > 0).sum())
            assert points["pd_shot"][row] == float(shot_arrays.pd_shot)
            row += 1
    assert row == len(points["x"]) > 20


def test_altitude_is_the_height_over_the_slope_at_the_start_of_the_cycle(weak, arrays):
    part = slice(0, weak.n_shots)
    position = arrays.platform_position.values
    start = np.arange(weak.n_shots) // 4 * 4
    below = GROUND_SLOPE * position[:, 0]
    is_off_ridge = np.abs(position[start, 0] - 20) > 20.5  # not over the block
    altitude = weak.shot_values("altitude", part)
    assert is_off_ridge.sum() > 100
    assert altitude[is_off_ridge] == pytest.approx(
        (position[:, 2] - below)[start][is_off_ridge], abs=1e-6
    )


def test_beams_aim_at_the_slope_or_at_the_block(weak):
    x, y, z = weak.beam_axis_hit_points(slice(0, weak.n_shots)).T
    on_slope = np.abs(z - GROUND_SLOPE * x) < 0.5
    on_block = (np.abs(x - 20) < 20.01) & (np.abs(y) < 15.01) & (np.abs(z) < 20.01)
    assert (on_slope | on_block).all() and on_slope.any() and on_block.any()


def test_what_is_not_computed_has_no_points_and_no_stretch(scene_store, spec, tmp_path):
    at = find_axis_position(spec, {"power": "1 W"})
    recording = at.open_recording(open_scene_tree(scene_store), "square")
    short = at.open_recording(
        open_scene_tree(copy_without_last_cycles(scene_store, tmp_path)), "square"
    )
    points = all_points(recording, ["time", "x", "shot"])
    incomplete_points = all_points(short, ["time", "x", "shot"])
    is_computed = points["shot"] < 256
    assert not is_computed.all()
    assert np.array_equal(incomplete_points["x"], points["x"][is_computed])


def test_stretches_outside_of_an_interval_of_time_are_not_read(weak, monkeypatch):
    from sweep.analysis.scene_results import recordings as module

    every = module.chunk_aligned_slices
    monkeypatch.setattr(module, "chunk_aligned_slices", lambda array, dim: every(array, dim, 64))
    assert [part.start for part in weak.iter_shot_slices()] == [0, 128, 256]
    time = weak.read_array("time", slice(0, weak.n_shots))
    interval = float(time[130]), float(time[200])
    assert [part.start for part in weak.iter_shot_slices(interval)] == [128]


def test_rows_within_limits_are_kept_and_those_without_a_value_are_not():
    table = {"x": np.array([0.0, 1.0, np.nan, 3.0]), "y": np.arange(4.0)}
    assert select_rows_within(table, {"x": (0.5, np.inf)})["y"].tolist() == [1, 3]
    assert select_rows_within(table, {"x": INFINITE_VALUE_LIMITS, "y": (-np.inf, 2)})[
        "y"
    ].tolist() == [
        0,
        1,
    ]
    assert select_rows_within(table, {}) is table


@pytest.mark.parametrize("cuts", [[1000], [1, 2, 3, 994], [7] * 142 + [6], [500, 0, 500]])
def test_thinning_keeps_every_2nd_or_4th_row_however_the_rows_come(cuts):
    thinned, first = ThinnedRows(130), 0
    for size in cuts:
        thinned.append({"n": np.arange(first, first + size)})
        first += size
    assert thinned.n_total == 1000 and thinned.step == 8
    assert thinned.to_columns()["n"].tolist() == list(range(0, 1000, 8))


def test_few_rows_are_not_thinned_and_none_are_none():
    thinned = ThinnedRows(10)
    assert thinned.to_columns() == {}
    thinned.append({"n": np.arange(10)})
    assert thinned.step == 1 and thinned.to_columns()["n"].size == 10


def test_flags_say_one_kind_each_and_ratios_are_shown_in_decibels():
    flags = np.array(
        [
            0,
            TRUE_RETURN_FLAG,
            FLAG_BITS["sidelobe"] | FLAG_BITS["unconfirmed"],
            FLAG_BITS["false_alarm"],
        ]
    )
    names = list(POINT_KIND_BITS)
    assert [names[i] if i >= 0 else "" for i in point_kind_indices(flags)] == [
        "", "true", "sidelobe", "false_alarm",
    ]  # fmt: skip
    assert to_displayed_values("snr", np.array([1.0, 100.0, 0.0]))[:2].tolist() == [0, 20]
    assert np.isnan(to_displayed_values("snr", np.array([0.0]))).all()


def test_a_place_is_the_first_that_fits_and_says_what_it_left_open(spec):
    first, strong = (
        find_axis_position(spec, {}),
        find_axis_position(spec, {"power": ["1 W", "1000 mW"]}),
    )
    assert (first.axis_indices, first.undetermined_axes) == ({"power": 0}, ("power",))
    assert (strong.axis_indices, strong.undetermined_axes) == ({"power": 1}, ())
    assert strong.label == "power 1000 mW"
    assert parameters_at(spec, strong.axis_indices)["instrument.laser.power"] == 1.0
    assert parameters_at(spec, first.axis_indices)["instrument.laser.power"] == pytest.approx(
        0.3e-3
    )


def test_places_that_are_none_are_refused_with_what_there_is(spec):
    with pytest.raises(SpecError) as error_info:
        find_axis_position(spec, {"powr": "1 W", "power": "2 W"})
    text = str(error_info.value)
    assert "did you mean 'power'?" in text
    assert "where.power: is no value of this study (you wrote 2 W); it has 0.3 mW, 1000 mW" in text
    with pytest.raises(SpecError, match=r"where\.power"):
        find_axis_position(spec, {"power": "much"})


def test_shots_are_computed_draw_by_draw_as_their_chunks_are_there(scene_store, spec, tmp_path):
    copy = shutil.copytree(scene_store, tmp_path / "holes.zarr")
    (copy / ".sweep" / "receipts.jsonl").unlink()  # what is committed has to be there
    (copy / "square" / "flags" / "c" / "0" / "1" / "1" / "0").unlink()  # shots 128 to 255, draw 2
    all_shots, tree = slice(0, 316), open_scene_tree(copy)
    weak, strong = (
        find_axis_position(spec, {"power": power}).open_recording(tree, "square")
        for power in ("0.3 mW", "1 W")
    )
    assert np.flatnonzero(~weak.computed_shot_mask(all_shots, 2)).tolist() == list(range(128, 256))
    assert (
        weak.computed_shot_mask(all_shots, 1).all()
        and strong.computed_shot_mask(all_shots, 2).all()
    )
    assert not weak.computed_shot_mask(slice(150, 160), 2).any()
    n_rows = [weak.read_thinned_rows(["time"], 10**6, draw=draw).n_total for draw in (1, 2)]
    assert n_rows == [316, 316 - 128]
