"""Floors of errors that instruments bring, and notes on errors that a flight does not state."""

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

import sweep
from sweep.analysis.consistency import consistency
from sweep.cli import main
from sweep.report.writing import write
from sweep.spec import Spec, SpecError
from sweep.spec.study import SceneSpec
from sweep.tasks import driver

SLOPE = {"kind": "plane", "size": "6 km", "slope": "11 deg", "uphill": "30 deg", "reflectance": 0.1}
CRATERED = SLOPE | {"spacing": "20 m", "craters": {"smallest": "60 m", "largest": "300 m"}}
HILLS = {"kind": "hills", "size": "2 km", "spacing": "20 m", "rms_height": "10 m",
         "correlation_length": "100 m", "seed": 1, "reflectance": 0.1}  # fmt: skip
CORNERS = {"kind": "corners", "angle": "22.5 deg", "rate": "4 Hz"}
LINE = {"kind": "line", "half_angle": "10 deg", "line_rate": "1 Hz", "rate": "2 Hz"}
STATED = {"vibration": "1 cm/s"}
FLOOR_NOTE, RELIEF_NOTE = "o floor of errors is stated", "o relief is stated"


def descent(instrument="chester_2017_table_5_1", ground=SLOPE, scanner=CORNERS, **sections):
    """A descent at 60 m/s that slows down, to a slope of 11 deg unless said otherwise."""
    return {
        "title": "Descent", "instrument": instrument,
        "scene": {"origin": "ground", "objects": {"ground": ground}},
        "platform": {"path": {"kind": "straight", "from": ["-200 m", "0 m", "900 m"],
                              "to": ["0 m", "0 m", "400 m"], "initial_speed": "60 m/s",
                              "final_speed": "20 m/s"}},
        "scanners": {"four": scanner}, "footprint": {"beamlets": 19},
    } | sections  # fmt: skip


def spec_of(**changes):
    return SceneSpec.from_mapping(descent(**changes))


@pytest.mark.parametrize(("changes", "notes"), [
    ({}, [FLOOR_NOTE]),
    ({"error_floor": STATED}, []),
    ({"scanner": LINE}, []),
    ({"ground": HILLS, "error_floor": STATED}, [RELIEF_NOTE]),
    ({"ground": HILLS, "error_floor": STATED, "navigation": {"relief": "10 m"}}, []),
    ({"ground": HILLS}, [FLOOR_NOTE, RELIEF_NOTE]),
    ({"ground": CRATERED, "error_floor": STATED}, [RELIEF_NOTE]),
    ({"instrument": "lander_ndl"}, []),
    ({"instrument": {"like": "automotive_fmcw", "laser": {"power": "1 W"}}}, []),
])  # fmt: skip
def test_errors_of_navigation_that_are_not_stated_are_named(changes, notes):
    sentences = spec_of(**changes).unstated_errors()
    assert len(sentences) == len(notes)
    assert all(words in sentence for words, sentence in zip(notes, sentences, strict=True))


def test_plan_run_and_report_say_that_a_flight_has_no_floor(tmp_path):
    sections = {"draws": {"number": 2}}
    for name, floor, number in (("without", {}, 1), ("with", {"error_floor": STATED}, 0)):
        file, store = tmp_path / f"{name}.yaml", tmp_path / f"{name}.zarr"
        file.write_text(yaml.safe_dump(descent(**sections, **floor)))
        for command in (
            ["plan", str(file)],
            ["run", str(file), "--scheduler", "none", "--store", str(store)],
        ):
            ran = CliRunner().invoke(main, command)
            assert ran.exit_code == 0
            assert " ".join(ran.stderr.split()).count(f"note: n{FLOOR_NOTE}") == number
        page = write(store, tmp_path / f"{name}.html").read_text()
        assert (FLOOR_NOTE in page) == bool(number)
        assert ("rrors that no echo lowers: " in page) != bool(number)


def test_an_instruments_floor_is_a_flights_unless_it_states_its_own():
    def floor(**changes):
        return {name: value for name, value in spec_of(**changes).error_floor if value}

    lander = "lander_ndl"
    assert floor(instrument=lander) == {"range_noise": 2.0, "vibration": 0.02}
    assert floor(instrument="automotive_fmcw") == {"vibration": 0.02}
    stated = floor(instrument=lander, error_floor={"vibration": "0 m/s", "clock_error": 1e-6})
    assert stated == {"range_noise": 2.0, "clock_error": 1e-6}
    assert floor() == {}
    whole = spec_of(instrument="lander_ndl")
    assert SceneSpec.from_stored(whole.to_json()).id == whole.id
    assert SceneSpec.from_mapping(whole.to_yaml_mapping()).id == whole.id
    with pytest.raises(SpecError, match=r"error_floor\.vibration"):
        spec_of(instrument="lander_ndl", error_floor={"vibration": "1 kg"})
    with pytest.raises(SpecError, match="error_floor"):
        spec_of(instrument="lander_ndl", error_floor="none")


def test_a_grid_of_an_instrument_with_a_floor_has_none():
    target = {"range": "1 km", "grazing_angle": "60 deg", "reflectance": 0.1}
    written = {"title": "Grid", "instrument": "lander_ndl", "target": target}
    assert "error_floor" not in Spec.from_mapping(written).to_yaml_mapping()


@pytest.mark.parametrize(("instrument", "velocity", "far"), [
    ("lander_ndl", 0.02, 2.0), ("chester_2017_table_5_1", 1e-6, 1e-5),
])  # fmt: skip
def test_a_descent_onto_a_slope_is_as_good_as_it_says(tmp_path, instrument, velocity, far):
    """With the published floor, or without any; of neither is anything inconsistent."""
    spec = spec_of(instrument=instrument, draws={"number": 20})
    store = tmp_path / "slope.zarr"
    assert driver.run(spec, store=store, scheduler="none", progress=False).complete
    tree = sweep.open_scene(store)
    four = tree["four"].to_dataset().load()
    for name, least in (("radial_velocity", velocity), ("range", far)):
        stated = four[f"{name}_interpolated_standard_error"].to_numpy()
        assert np.nanmin(stated) >= least
    for each in consistency(tree):
        assert each.is_consistent, each.words
    if instrument == "lander_ndl":
        solved = {each.quantity: each.ratio for each in consistency(tree)}
        assert solved["velocity"] == pytest.approx(1, abs=0.2)
        assert solved["altitude"] == pytest.approx(1, abs=0.2)
