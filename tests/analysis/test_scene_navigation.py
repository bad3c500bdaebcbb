"""Errors of navigation over altitude against plain averages over the whole arrays."""

import csv

import numpy as np
import pytest
import xarray as xr
from drawn_scenes import MAPPING, cut_short, flown

from sweep.analysis.canvas import sheet_of
from sweep.analysis.opening import opened
from sweep.analysis.scenes import navigation
from sweep.analysis.scenes.navigation import curves, navigation_chart, navigation_page
from sweep.analysis.scenes.recording import place


def recordings(store, spec, power):
    at, tree = place(spec, {"power": power}), opened(store)
    return [
        (name, at.recording(tree, name)) for name in ("pair", "square") if name in tree.children
    ]


@pytest.mark.parametrize("power", ["0.3 mW", "1 W"])
@pytest.mark.parametrize("quantity", ["velocity", "altitude"])
def test_statistics_are_plain_averages_over_the_solutions_of_a_bin(
    scene_store, spec, quantity, power
):
    (curve,) = curves(recordings(scene_store, spec, power), quantity=quantity, bins=4)
    assert curve.scanner == "square" and curve.edges.size == 5
    index = 0 if power == "0.3 mW" else 1
    arrays = xr.open_zarr(scene_store, group="square", chunks=None).isel(power=index).load()
    altitude = arrays.true_altitude.values
    assert curve.edges[0] == altitude.min() and curve.edges[-1] >= altitude.max()
    error = arrays[quantity].values - arrays[f"true_{quantity}"].values[:, None]
    error = error.reshape(*error.shape[:2], -1)
    stated = arrays["velocity_covariance" if quantity == "velocity" else "altitude_variance"]
    size = error.shape[-1]
    variance = stated.values.reshape(*error.shape[:2], size, size).diagonal(axis1=2, axis2=3)
    seen = 0
    for i, (low, high) in enumerate(zip(curve.edges[:-1], curve.edges[1:], strict=True)):
        inside = (altitude >= low) & (altitude < high)
        own = error[inside].reshape(-1, size)
        solved = np.isfinite(own).all(axis=1)
        assert curve.tally.attempts[i] == own.shape[0]
        assert curve.tally.availability[i] == pytest.approx(solved.mean())
        seen += own.shape[0]
        if not solved.any():
            assert np.isnan(curve.tally.bias[i]).all()
            continue
        own = own[solved]
        spread = own.std(axis=0, ddof=1) / np.sqrt(len(own))
        predicted = variance[inside].reshape(-1, size)[solved].mean(axis=0)
        assert curve.tally.bias[i] == pytest.approx(own.mean(axis=0), rel=1e-9, abs=1e-13)
        assert curve.bias_error[i] == pytest.approx(spread, rel=1e-9)
        rmse = np.sqrt((own**2).mean(axis=0))
        assert curve.rmse[i, :size] == pytest.approx(rmse, rel=1e-9)
        assert curve.predicted[i, :size] == pytest.approx(np.sqrt(predicted), rel=1e-9)
        if size == 3:
            length = np.sqrt((np.linalg.norm(own, axis=1) ** 2).mean())
            assert curve.rmse[i, 3] == pytest.approx(length, rel=1e-9)
            assert curve.predicted[i, 3] == pytest.approx(np.sqrt(predicted.sum()), rel=1e-9)
    assert seen == arrays.sizes["cycle"] * 3


def test_results_are_the_same_bits_every_time_and_the_same_numbers_in_other_chunks(
    scene_store, spec, tmp_path, monkeypatch
):
    own = recordings(scene_store, spec, "0.3 mW")
    (first,), (again,) = (curves(own, quantity="velocity", bins=5) for _ in range(2))
    assert np.array_equal(first.rmse, again.rmse, equal_nan=True)
    monkeypatch.setattr(navigation, "STRETCH", 1)  # a tally for each chunk
    square = {"square": MAPPING["scanners"]["square"]}
    other = flown(tmp_path, scanners=square, storage={"block_shots": 160, "block_draws": 1})
    (apart,) = curves(recordings(other, spec, "0.3 mW"), quantity="velocity", bins=5)
    assert np.array_equal(first.tally.count, apart.tally.count)
    np.testing.assert_allclose(apart.rmse, first.rmse, rtol=1e-12)


@pytest.mark.parametrize("geometry", [True, False])
def test_cycles_that_are_not_computed_are_no_attempts(scene_store, spec, tmp_path, geometry):
    short = cut_short(scene_store, tmp_path, geometry=geometry)
    (curve,) = curves(recordings(short, spec, "1 W"), quantity="altitude", bins=3)
    assert curve.tally.attempts.sum() == 64 * 3
    assert curve.tally.count.sum() == 64 * 3


def test_a_level_flight_has_one_bin_and_a_scanner_of_two_beams_no_curve(
    tmp_path, scene_store, spec
):
    ends = {"from": ["-90 m", "50 m", "300 m"], "to": ["-90 m", "90 m", "300 m"]}
    path = {"kind": "straight", "initial_speed": "20 m/s"} | ends
    store = flown(tmp_path, platform={"path": path, "attitude": {"kind": "nadir"}})
    (curve,) = curves(recordings(store, spec, "1 W"), quantity="altitude", bins=9)
    assert curve.tally.attempts.tolist() == [20 * 3]
    assert curve.middle == pytest.approx(300 + 90 * 0.05, abs=1e-3)
    pair = recordings(scene_store, spec, "1 W")[:1]
    assert curves(pair, quantity="velocity", bins=3) == []


def test_the_figure_draws_the_statistics_and_the_stated_deviation_dashed(scene_store, spec):
    (curve,) = curves(recordings(scene_store, spec, "1 W"), quantity="velocity", bins=4)
    sheet = sheet_of(navigation_chart([curve, curve], "all"), "T", "note")
    panels = {axes.get_title(loc="left"): axes for axes in sheet.axes if axes.get_visible()}
    error, stated = panels["RMS error of the velocity, z"].lines[:2]
    assert np.array_equal(error.get_ydata(), curve.rmse[:, 2])
    assert np.array_equal(stated.get_ydata(), curve.predicted[:, 2])
    assert error.get_linestyle() == "-" and stated.get_linestyle() == "--"
    assert panels["RMS error of the velocity, z"].get_ylabel() == "error (m/s)"
    available = panels["velocity available"].lines[0]
    assert np.array_equal(available.get_ydata(), 100 * curve.tally.availability)
    for show, number in (("availability", 1), ("bias", 3), ("rmse", 4)):
        assert len(navigation_chart([curve], show).panels) == number


def test_the_table_holds_the_same_numbers_in_text_and_csv(scene_store, spec, tmp_path):
    (curve,) = curves(recordings(scene_store, spec, "1 W"), quantity="altitude", bins=3)
    page = navigation_page([curve], show="all", title="T", remarks=["a note"])
    text, table = page.save(tmp_path, "navigation")
    rows = list(csv.DictReader(table.open()))
    assert [float(row["rmse"]) for row in rows] == curve.rmse[:, 0].tolist()
    assert [float(row["bias"]) for row in rows] == curve.tally.bias[:, 0].tolist()
    assert [float(row["from"]) for row in rows] == curve.edges[:-1].tolist()
    assert sum(int(row["cycles"]) for row in rows) == curve.tally.attempts.sum()
    said = text.read_text()
    assert "square: altitude" in said and "in m;" in said and "a note" in said
    only = navigation_page([curve], show="bias", title="", remarks=[])
    assert "rmse" not in only.records[0] and "bias" in only.records[0]
