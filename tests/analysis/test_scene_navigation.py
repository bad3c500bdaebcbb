"""Errors of navigation over altitude against plain averages over the whole arrays."""

import csv

import numpy as np
import pytest
import xarray as xr
from stored_scenes import SCENE_MAPPING, copy_without_last_cycles, run_flight_into_store

from sweep.analysis.canvas import draw_chart
from sweep.analysis.datasets import open_scene_tree
from sweep.analysis.scene_results import navigation_errors
from sweep.analysis.scene_results.navigation_errors import (
    navigation_error_chart,
    navigation_error_curves,
    navigation_error_page,
)
from sweep.analysis.scene_results.recordings import find_axis_position


def recordings(store, spec, power):
    at, tree = find_axis_position(spec, {"power": power}), open_scene_tree(store)
    return [
        (name, at.open_recording(tree, name))
        for name in ("pair", "square")
        if name in tree.children
    ]


@pytest.mark.parametrize("power", ["0.3 mW", "1 W"])
@pytest.mark.parametrize("quantity", ["velocity", "altitude"])
def test_statistics_are_plain_averages_over_the_solutions_of_a_bin(
    scene_store, spec, quantity, power
):
    (curve,) = navigation_error_curves(
        recordings(scene_store, spec, power), quantity=quantity, n_bins=4
    )
    assert curve.scanner == "square" and curve.altitude_edges.size == 5
    index = 0 if power == "0.3 mW" else 1
    arrays = xr.open_zarr(scene_store, group="square", chunks=None).isel(power=index).load()
    altitude = arrays.true_altitude.values
    assert curve.altitude_edges[0] == altitude.min() and curve.altitude_edges[-1] >= altitude.max()
    error = arrays[quantity].values - arrays[f"true_{quantity}"].values[:, None]
    error = error.reshape(*error.shape[:2], -1)
    stated_variance = arrays[
        "velocity_covariance" if quantity == "velocity" else "altitude_variance"
    ]
    size = error.shape[-1]
    variance = stated_variance.values.reshape(*error.shape[:2], size, size).diagonal(
        axis1=2, axis2=3
    )
    n_solutions = 0
    for i, (low, high) in enumerate(
        zip(curve.altitude_edges[:-1], curve.altitude_edges[1:], strict=True)
    ):
        inside = (altitude >= low) & (altitude < high)
        errors = error[inside].reshape(-1, size)
        solved = np.isfinite(errors).all(axis=1)
        assert curve.tally.n_attempts[i] == errors.shape[0]
        assert curve.tally.availability[i] == pytest.approx(solved.mean())
        n_solutions += errors.shape[0]
        if not solved.any():
            assert np.isnan(curve.tally.bias[i]).all()
            continue
        errors = errors[solved]
        spread = errors.std(axis=0, ddof=1) / np.sqrt(len(errors))
        predicted = variance[inside].reshape(-1, size)[solved].mean(axis=0)
        assert curve.tally.bias[i] == pytest.approx(errors.mean(axis=0), rel=1e-9, abs=1e-13)
        assert curve.bias_standard_error[i] == pytest.approx(spread, rel=1e-9)
        rmse = np.sqrt((errors**2).mean(axis=0))
        assert curve.rmse[i, :size] == pytest.approx(rmse, rel=1e-9)
        assert curve.stated_deviation[i, :size] == pytest.approx(np.sqrt(predicted), rel=1e-9)
        if size == 3:
            length = np.sqrt((np.linalg.norm(errors, axis=1) ** 2).mean())
            assert curve.rmse[i, 3] == pytest.approx(length, rel=1e-9)
            assert curve.stated_deviation[i, 3] == pytest.approx(np.sqrt(predicted.sum()), rel=1e-9)
    assert n_solutions == arrays.sizes["cycle"] * 3


def test_results_are_the_same_bits_every_time_and_the_same_numbers_in_other_chunks(
    scene_store, spec, tmp_path, monkeypatch
):
    recordings_of_store = recordings(scene_store, spec, "0.3 mW")
    (first,), (second,) = (
        navigation_error_curves(recordings_of_store, quantity="velocity", n_bins=5)
        for _ in range(2)
    )
    assert np.array_equal(first.rmse, second.rmse, equal_nan=True)
    monkeypatch.setattr(navigation_errors, "SOLUTIONS_PER_READ", 1)  # a tally for each chunk
    square = {"square": SCENE_MAPPING["scanners"]["square"]}
    other = run_flight_into_store(
        tmp_path, scanners=square, storage={"block_shots": 160, "block_draws": 1}
    )
    (other_curve,) = navigation_error_curves(
        recordings(other, spec, "0.3 mW"), quantity="velocity", n_bins=5
    )
    assert np.array_equal(first.tally.n_solutions, other_curve.tally.n_solutions)
    np.testing.assert_allclose(other_curve.rmse, first.rmse, rtol=1e-12)


@pytest.mark.parametrize("geometry", [True, False])
def test_cycles_that_are_not_computed_are_no_attempts(scene_store, spec, tmp_path, geometry):
    short = copy_without_last_cycles(scene_store, tmp_path, with_geometry=geometry)
    (curve,) = navigation_error_curves(
        recordings(short, spec, "1 W"), quantity="altitude", n_bins=3
    )
    assert curve.tally.n_attempts.sum() == 64 * 3
    assert curve.tally.n_solutions.sum() == 64 * 3


def test_a_level_flight_has_one_bin_and_a_scanner_of_two_beams_no_curve(
    tmp_path, scene_store, spec
):
    ends = {"from": ["-90 m", "50 m", "300 m"], "to": ["-90 m", "90 m", "300 m"]}
    path = {"kind": "straight", "initial_speed": "20 m/s"} | ends
    store = run_flight_into_store(tmp_path, platform={"path": path, "attitude": {"kind": "nadir"}})
    (curve,) = navigation_error_curves(
        recordings(store, spec, "1 W"), quantity="altitude", n_bins=9
    )
    assert curve.tally.n_attempts.tolist() == [20 * 3]
    assert curve.bin_centres == pytest.approx(300 + 90 * 0.05, abs=1e-3)
    pair = recordings(scene_store, spec, "1 W")[:1]
    assert navigation_error_curves(pair, quantity="velocity", n_bins=3) == []


def test_the_figure_draws_the_statistics_and_the_stated_deviation_dashed(scene_store, spec):
    (curve,) = navigation_error_curves(
        recordings(scene_store, spec, "1 W"), quantity="velocity", n_bins=4
    )
    sheet = draw_chart(navigation_error_chart([curve, curve], "all"), "T", "note")
    panels = {axes.get_title(loc="left"): axes for axes in sheet.axes if axes.get_visible()}
    error, stated_line = panels["RMS error of the velocity, z"].lines[:2]
    assert np.array_equal(error.get_ydata(), curve.rmse[:, 2])
    assert np.array_equal(stated_line.get_ydata(), curve.stated_deviation[:, 2])
    assert error.get_linestyle() == "-" and stated_line.get_linestyle() == "--"
    assert panels["RMS error of the velocity, z"].get_ylabel() == "error (m/s)"
    available = panels["velocity available"].lines[0]
    assert np.array_equal(available.get_ydata(), 100 * curve.tally.availability)
    for show, number in (("availability", 1), ("bias", 3), ("rmse", 4)):
        assert len(navigation_error_chart([curve], show).panels) == number


def test_the_table_holds_the_same_numbers_in_text_and_csv(scene_store, spec, tmp_path):
    (curve,) = navigation_error_curves(
        recordings(scene_store, spec, "1 W"), quantity="altitude", n_bins=3
    )
    page = navigation_error_page([curve], show="all", title="T", remarks=["a note"])
    text, table = page.save_files(tmp_path, "navigation")
    rows = list(csv.DictReader(table.open()))
    assert [float(row["rmse"]) for row in rows] == curve.rmse[:, 0].tolist()
    assert [float(row["bias"]) for row in rows] == curve.tally.bias[:, 0].tolist()
    assert [float(row["from"]) for row in rows] == curve.altitude_edges[:-1].tolist()
    assert sum(int(row["cycles"]) for row in rows) == curve.tally.n_attempts.sum()
    table_text = text.read_text()
    assert "square: altitude" in table_text and "in m;" in table_text and "a note" in table_text
    only = navigation_error_page([curve], show="bias", title="", remarks=[])
    assert "rmse" not in only.records[0] and "bias" in only.records[0]
