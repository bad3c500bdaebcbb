"""Figures of scenes as specs ask for them, made from stores."""

import json

import numpy as np
import pytest
import xarray as xr
from stored_scenes import copy_without_last_cycles, run_flight_into_store

from sweep.analysis import study_figures
from sweep.analysis.datasets import NotAStoreError, open_scene_tree
from sweep.analysis.scene_results import cloud_figures
from sweep.analysis.scene_results.recordings import find_axis_position
from sweep.analysis.study_figures import SceneResults, default_scene_figures, draw_figures
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG


def test_a_study_that_asks_for_none_gets_clouds_by_range_and_velocity_and_navigation(scene_store):
    usual = default_scene_figures(open_scene_tree(scene_store))
    assert [figure.file_stem for figure in usual] == [
        "square_range_cloud", "square_radial_velocity_cloud", "pair_range_cloud",
        "pair_radial_velocity_cloud", "velocity_all_navigation", "altitude_all_navigation",
    ]  # fmt: skip


def test_a_store_cut_short_is_drawn_as_far_as_it_is_and_says_how_far(
    scene_store, tmp_path, monkeypatch
):
    short = copy_without_last_cycles(scene_store, tmp_path)
    committed = (scene_store / ".sweep" / "receipts.jsonl").read_text().splitlines(keepends=True)
    left = [line for line in committed if json.loads(line)["block"] % 3 != 2]
    (short / ".sweep" / "receipts.jsonl").write_text("".join(left))
    assert SceneResults.from_store(short).source_note.endswith("16 of 24 blocks computed")
    usual = study_figures.default_scene_figures
    monkeypatch.setattr(study_figures, "default_scene_figures", lambda tree: usual(tree)[4:5])
    assert [file.name for file in draw_figures(short)] == ["velocity_all_navigation.png"]


def test_spectra_need_the_eyepoints_next_to_the_store(tmp_path):
    directory = tmp_path / "own"
    directory.mkdir()
    store = run_flight_into_store(
        directory, figures=[{"kind": "shot_spectra", "shot": 0}], draws={"number": 1}
    )
    moved_store = store.rename(tmp_path / "moved.zarr")
    with pytest.raises(NotAStoreError, match="eyepoints of the study are not at"):
        draw_figures(moved_store)


def test_a_quantity_of_shots_is_shown_for_every_shot_and_one_of_points_for_every_point(
    scene_store, spec, tmp_path
):
    weak = find_axis_position(spec, {"power": "0.3 mW"}).open_recording(
        open_scene_tree(scene_store), "pair"
    )
    arrays = xr.open_zarr(scene_store, group="pair", chunks=None).isel(power=0, draw=0).load()
    options = {"draw": 0, "ranges": "quantised", "time_limits": None}
    shots = weak.read_thinned_rows(["time", "pd_shot", "beam"], 10**6, **options)
    assert np.array_equal(shots.to_columns()["pd_shot"], arrays.pd_shot.values)
    points = weak.read_thinned_rows(["time", "radial_velocity", "beam"], 10**6, **options)
    is_point = arrays.flags.values > 0
    assert np.array_equal(
        points.to_columns()["radial_velocity"], arrays.radial_velocity.values[is_point]
    )
    short = open_scene_tree(copy_without_last_cycles(scene_store, tmp_path, with_geometry=False))
    incomplete = find_axis_position(spec, {"power": "0.3 mW"}).open_recording(short, "pair")
    shots = incomplete.read_thinned_rows(["time", "pd_shot", "beam"], 10**6, **options)
    assert np.array_equal(shots.to_columns()["pd_shot"], arrays.pd_shot.values[:256])
    interval = 2.0, 3.0
    limited = options | {"time_limits": interval}
    rows = weak.read_thinned_rows(["time", "pd_shot", "beam"], 10**6, **limited)
    inside = (arrays.time.values >= 2) & (arrays.time.values <= 3)
    assert np.array_equal(rows.to_columns()["pd_shot"], arrays.pd_shot.values[inside])


def test_a_scatter_shows_the_values_with_units_and_counts_false_points_beyond(scene_store, spec):
    strong = find_axis_position(spec, {"power": "1 W"}).open_recording(
        open_scene_tree(scene_store), "pair"
    )
    rows = strong.read_thinned_rows(["time", "range", "snr"], 10**6, ranges="interpolated")
    sheet = cloud_figures.draw_scatter_sheet(
        rows, x="time", y="range", colour="snr", surfaces=[], title="T", remarks=["told"]
    )
    table, axes = rows.to_columns(), sheet.axes[0]
    true = (table["flags"] & TRUE_RETURN_FLAG) > 0
    expected = np.column_stack([table["time"], table["range"]])
    assert np.array_equal(axes.collections[0].get_offsets(), expected[true])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time (s)", "range (m)")
    low, high = axes.get_ylim()
    n_beyond = int((~true & ((expected[:, 1] < low) | (expected[:, 1] > high))).sum())
    assert n_beyond > 0 and f"{n_beyond} false points outside" in sheet.get_supxlabel()
    assert sheet.axes[1].get_ylabel() == "signal-to-noise ratio (dB)"
