"""Reports of an interface against closed forms and loops over the points of the store."""

import csv

import numpy as np
import pytest
import xarray as xr
from stored_scenes import copy_without_last_cycles, run_flight_into_store

import sweep
from sweep.analysis.scene_results.interface_reports import (
    REPORT_COLUMNS,
    make_reports,
    quantise_and_clip,
)
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG, UNCONFIRMED_FLAG
from sweep.spec import SpecError
from sweep.spec.scene_sections import Interface

FALL = 2.5
"""Rate at which the closing speed of made shots grows [m/s^2]."""


def interface(**fields):
    return Interface.model_validate({k: v for k, v in fields.items() if v is not None})


def make_shots(n=2000, beams=2, every=5e-3, *, noise=0.0, seed=1):
    """Shots of beams in turn over a target of constant acceleration; the noise in both values."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) * every + 3.0
    speed = 40.0 + FALL * (time - 3.0)
    range_ = 3000.0 - 40.0 * (time - 3.0) - FALL * (time - 3.0) ** 2 / 2
    shots = {
        "time": time,
        "beam": np.arange(n) % beams,
        "flags": np.full(n, TRUE_RETURN_FLAG, np.uint8),
    }
    shots |= {"range": range_ + noise * rng.normal(size=n)}
    shots |= {"radial_velocity": speed + noise * rng.normal(size=n)}
    shots |= dict.fromkeys(
        ("range_standard_error", "radial_velocity_standard_error"), np.full(n, noise)
    )
    return shots | {"beam_range": range_, "beam_radial_velocity": speed}


def test_the_default_reports_every_shot_as_it_is():
    shots = make_shots(noise=0.3)
    reports = make_reports(shots, interface())
    for name in ("time", "beam", "range", "radial_velocity", "range_standard_error"):
        assert np.array_equal(reports[name], shots[name]), name
    assert np.array_equal(reports["true_range"], shots["beam_range"])
    assert (
        reports["valid"].all()
        and (reports["shots"] == 1).all()
        and list(reports) == list(REPORT_COLUMNS)
    )


@pytest.mark.parametrize("quantum", ["2 mm", "1.953125 mm", "0.3 m"])
def test_values_are_multiples_of_the_quantum_and_off_by_half_of_it_at_most(quantum):
    shots, q = make_shots(noise=0.3), float(quantum.split()[0]) * (1e-3 if "mm" in quantum else 1)
    reported_range = make_reports(shots, interface(range_quantum=quantum))["range"]
    steps = np.rint(reported_range / q)
    assert np.array_equal(reported_range, steps * q)
    assert np.abs(reported_range - shots["range"]).max() <= q / 2 * (1 + 1e-9)


def test_the_quantum_adds_its_deviation_in_square():
    """q / sqrt(12) of a uniform error; the variance of n squares of it has 4/5 of a normal's."""
    n, q, noise = 200_000, 0.5, 0.2
    shots = make_shots(n, noise=noise)
    reports = make_reports(shots, interface(radial_velocity_quantum=f"{q} m/s"))
    standard_error = reports["radial_velocity_standard_error"]
    assert standard_error == pytest.approx(np.hypot(noise, q / np.sqrt(12)))
    error = reports["radial_velocity"] - shots["beam_radial_velocity"]
    assert error.std() == pytest.approx(standard_error[0], rel=5 / np.sqrt(2 * n))


@pytest.mark.parametrize("quantum", [None, "0.7 m"])
def test_limits_flag_those_beyond_and_no_others(quantum):
    shots = make_shots(noise=0.3)
    limits = {"min_range": "2600 m", "max_range": "2800.1 m"}
    reports = make_reports(shots, interface(**limits, range_quantum=quantum))
    is_beyond = (shots["range"] < 2600) | (shots["range"] > 2800.1)
    assert 100 < is_beyond.sum() < is_beyond.size - 100
    assert np.array_equal(reports["range_saturated"] == 1, is_beyond)
    assert np.array_equal(reports["valid"] == 0, is_beyond)
    assert not reports["radial_velocity_saturated"].any()
    q = 0.7 if quantum else 1e-300
    assert reports["range"].min() >= 2600 - q / 2 and reports["range"].max() <= 2800.1 + q / 2
    assert np.unique(reports["range"][is_beyond]).size == 2


def test_a_limit_that_is_no_multiple_moves_to_the_next():
    values, is_beyond = quantise_and_clip(np.array([1.0, 1.1, 9.9, 12.0]), 0.5, 1.1, 9.9)
    assert values.tolist() == [1.0, 1.0, 10.0, 10.0] and is_beyond.tolist() == [1, 0, 0, 1]


@pytest.mark.parametrize(("rate", "shots_per_report"), [("20 Hz", 5), ("10 Hz", 10), ("100 Hz", 1)])
def test_the_rate_gives_its_number_of_reports(rate, shots_per_report):
    """2,000 shots of 2 beams, 10 s: as many reports of each beam as the rate has periods."""
    reports = make_reports(make_shots(), interface(rate=rate))
    number = round(float(rate.split()[0]) * 10)
    assert reports["time"].size == 2 * number and (reports["shots"] == shots_per_report).all()
    assert np.array_equal(np.bincount(reports["beam"]), [number, number])


def test_a_mean_of_n_shots_has_their_mean_time_and_an_error_less_by_the_root_of_n():
    shots = make_shots(100_000, noise=0.2)
    reports = make_reports(shots, interface(rate="10 Hz"))
    error = reports["radial_velocity"] - reports["true_radial_velocity"]
    assert reports["radial_velocity_standard_error"] == pytest.approx(0.2 / np.sqrt(10))
    assert error.std() == pytest.approx(0.2 / np.sqrt(10), rel=5 / np.sqrt(2 * error.size))
    assert abs(error.mean()) < 5 * 0.2 / np.sqrt(shots["time"].size)
    mean_times = shots["time"][shots["beam"] == 1].reshape(-1, 10).mean(axis=1)
    assert reports["time"][reports["beam"] == 1] == pytest.approx(mean_times)


def test_the_last_is_the_last_valid_shot_of_the_period():
    shots = make_shots(400, noise=0.2)
    shots["flags"][np.random.default_rng(2).random(400) < 0.5] = 0
    shots["flags"][::7] |= UNCONFIRMED_FLAG
    reports = make_reports(shots, interface(rate="20 Hz", value="last"))
    for row, (beam, period) in enumerate((b, p) for p in range(40) for b in range(2)):
        valid_shots = [
            i for i in range(400)
            if shots["beam"][i] == beam and int(i * 5e-3 / 50e-3 + 1e-9) == period
            and shots["flags"][i] == TRUE_RETURN_FLAG
        ]  # fmt: skip
        assert reports["shots"][row] == len(valid_shots) and reports["valid"][row] == bool(
            valid_shots
        )
        expected = shots["range"][valid_shots[-1]] if valid_shots else np.nan
        assert np.array_equal(reports["range"][row], expected, equal_nan=True)
        if not valid_shots:  # the middle of the period
            assert reports["time"][row] == pytest.approx(shots["time"][0] + (period + 0.5) * 50e-3)


def test_a_report_needs_its_number_of_valid_shots():
    shots = make_shots(400)
    shots["flags"][np.random.default_rng(3).random(400) < 0.5] = 0
    reports = make_reports(shots, interface(rate="20 Hz", valid_shots=3))
    assert np.array_equal(reports["valid"] == 1, reports["shots"] >= 3)
    assert np.isfinite(reports["range"][reports["shots"] > 0]).all() and not reports["valid"].all()


@pytest.mark.parametrize("value", ["mean", "last"])
def test_the_latency_moves_the_stamp_and_makes_an_error_of_acceleration_times_it(value):
    prompt = make_reports(make_shots(), interface(rate="20 Hz", value=value))
    late = make_reports(make_shots(), interface(rate="20 Hz", value=value, latency="40 ms"))
    assert late["time"] - prompt["time"] == pytest.approx(0.04)
    error = late["radial_velocity"] - late["true_radial_velocity"]
    is_valid = np.isfinite(error)  # the last shots of the flight tell no later truth
    assert 390 < is_valid.sum() < is_valid.size
    assert error[is_valid] == pytest.approx(-FALL * 0.04, abs=1e-9)
    far = (late["range"] - late["true_range"])[is_valid]
    speed = late["radial_velocity"][is_valid]
    # Linear between shots 10 ms apart, and the mean of a period, bend by a T^2 / 8 and a T^2 / 24.
    assert far == pytest.approx(speed * 0.04 + FALL * 0.04**2 / 2, abs=FALL * 0.05**2 / 8)


def test_reports_of_a_store_are_those_of_its_first_returns(scene_store, tmp_path):
    selection = {"scanner": "square", "draw": 1, "where": {"power": "1 W"}}
    reports = sweep.reports(scene_store, **selection)
    arrays = xr.open_zarr(scene_store, group="square", chunks=None).isel(power=1, draw=1).load()
    flags = arrays.flags.values[:, 0]
    valid = (flags > 0) & (flags & UNCONFIRMED_FLAG == 0)
    assert valid.any() and np.array_equal(reports.valid, valid)
    first = arrays.radial_velocity_interpolated.values[:, 0]
    assert np.array_equal(reports.radial_velocity, np.where(valid, first, np.nan), equal_nan=True)
    replaced_interface = {"rate": "5 Hz", "range_quantum": "0.25 m"}
    file = tmp_path / "reports.csv"
    slow = sweep.reports(scene_store, file, **selection, interface=replaced_interface)
    assert not (slow.range.values[slow.valid.values == 1] % 0.25).any()
    assert slow.sizes["report"] == pytest.approx(reports.sizes["report"] / 2, abs=4)
    with file.open(newline="") as text:
        header, *rows = csv.reader(text)
    assert header[:3] == ["time [s]", "beam", "range [m]"]
    for name, column in zip(REPORT_COLUMNS, np.array(rows, float).T, strict=True):
        assert np.array_equal(column, slow[name], equal_nan=True), name


def test_a_specs_interface_is_the_stores_and_no_part_of_its_id(tmp_path):
    mapping = {
        "axes": {},
        "draws": {"number": 1},
        "interface": {"rate": "2 Hz", "latency": "10 ms"},
    }
    store = run_flight_into_store(tmp_path, **mapping)
    reports = sweep.reports(store, scanner="square")
    assert reports.sizes["report"] == pytest.approx(
        4 * 2 * float(np.ptp(reports.time.values)), abs=8
    )
    assert sweep.open_scene(store).sweep.spec.interface.latency == 0.01
    short = copy_without_last_cycles(store, tmp_path)
    assert 0 < sweep.reports(short, scanner="square").sizes["report"] < reports.sizes["report"]


def test_what_can_not_be_is_refused_with_field_rule_value_and_remedy(scene_store, tmp_path):
    def refused(*parts, **selection):
        with pytest.raises(SpecError) as error_info:
            sweep.reports(scene_store, tmp_path / "reports.ply", **selection)
        for part in parts:
            assert part in str(error_info.value)

    selection = {"scanner": "square", "where": {"power": "1 W"}}
    refused("file: must end in .csv", "scanner: is no scanner", scanner="sqare",
            where={"power": "1 W"})  # fmt: skip
    with pytest.raises(SpecError) as error_info:
        sweep.reports(scene_store, **selection, interface={"rate": "1 kHz"})
    assert "interface.rate: must be at most some " in str(error_info.value)
    for fields, *parts in (
        ({"rate": 20}, "interface.rate: needs a unit", "20 Hz"),
        ({"quantum": "2 mm"}, "interface.quantum: is no field", "range_quantum"),
        ({"min_range": "9 m", "max_range": "3 m"}, "interface: has a min_range that is not below",
         "write a lower min_range"),
        ({"valid_shots": 3}, "interface: wants 3 valid_shots", "add e.g. 'rate: 20 Hz'"),
        ({"value": "median", "latency": "-1 s"}, "2 mistakes", "interface.value: must be one of",
         "interface.latency: must be at least 0 s"),
    ):  # fmt: skip
        with pytest.raises(SpecError) as error_info:
            sweep.reports(scene_store, **selection, interface=fields)
        for part in parts:
            assert part in str(error_info.value), str(error_info.value)
