"""Floors of errors that instruments bring, and notes on errors that a flight does not state."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

import sweep
from sweep.analysis.scene_results.consistency import check_error_consistency
from sweep.cli import main
from sweep.report.study_report import write_report
from sweep.spec import GridSpec, SpecError
from sweep.spec.specs import SceneSpec
from sweep.spec.yaml_document import library_instrument_files
from sweep.tasks import driver
from sweep.tasks.studies.study_loading import make_study

SLOPE = {"kind": "plane", "size": "6 km", "slope": "11 deg", "uphill": "30 deg", "reflectance": 0.1}
CRATERED = SLOPE | {"spacing": "20 m", "craters": {"smallest": "60 m", "largest": "300 m"}}
HILLS = {"kind": "hills", "size": "2 km", "spacing": "20 m", "rms_height": "10 m",
         "correlation_length": "100 m", "seed": 1, "reflectance": 0.1}  # fmt: skip
CORNERS = {"kind": "corners", "angle": "22.5 deg", "rate": "4 Hz"}
LINE = {"kind": "line", "half_angle": "10 deg", "line_rate": "1 Hz", "rate": "2 Hz"}
STATED = {"vibration": "1 cm/s"}
FLOOR_NOTE, RELIEF_NOTE = "o floor of errors is stated", "o relief is stated"
LANDERS = (
    "the instrument lander_ndl brings a floor of errors: range_noise 2 m, vibration 2 cm/s. State "
    "error_floor in the study to change it; 'error_floor: {range_noise: 0 m, vibration: 0 m/s}' "
    "switches it off"
)


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
    ({"instrument": "lander_ndl"}, [LANDERS]),
    ({"instrument": "lander_ndl", "scanner": LINE}, [LANDERS]),
    ({"instrument": {"like": "automotive_fmcw", "laser": {"power": "1 W"}}},
     ["automotive_fmcw brings a floor of errors: vibration 2 cm/s"]),
    ({"instrument": "lander_ndl", "error_floor": STATED}, ["errors: range_noise 2 m. State"]),
    ({"instrument": "lander_ndl", "error_floor": STATED | {"range_noise": "1 m"}}, []),
    ({"instrument": "lander_ndl", "error_floor": {"range_noise": "0 m", "vibration": "0 m/s"}},
     [FLOOR_NOTE]),
])  # fmt: skip
def test_errors_of_navigation_that_are_not_stated_are_named(changes, notes):
    sentences = spec_of(**changes).unstated_error_sentences()
    assert len(sentences) == len(notes)
    assert all(words in sentence for words, sentence in zip(notes, sentences, strict=True))


@pytest.mark.parametrize(("speed", "speckle", "bins"), [
    ("90 m/s", "developed", "4.9"), ("60 m/s", "developed", "2.5"),
    ("60 m/s", "none", ""), ("45 m/s", "developed", ""),
])  # fmt: skip
def test_braking_that_drifts_speckled_lines_over_bins_is_named(speed, speckle, bins):
    """From a height of 1,100 to 1,000 m at 20, 10 and 2 m/s^2: 2 a T^2 / lambda."""
    final = {"90 m/s": "64 m/s", "60 m/s": "40 m/s", "45 m/s": "40 m/s"}[speed]
    path = {"kind": "straight", "from": ["0 m", "0 m", "1100 m"], "to": ["0 m", "0 m", "1000 m"],
            "initial_speed": speed, "final_speed": final}  # fmt: skip
    sentences = spec_of(
        instrument="lander_ndl", platform={"path": path},
        error_floor=STATED | {"range_noise": "1 m"},
        footprint={"beamlets": 19, "speckle": speckle},
    ).unstated_error_sentences()  # fmt: skip
    assert len(sentences) == bool(bins)
    assert not bins or f"drifts lines by up to {bins} bins" in sentences[0]


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
        page = write_report(store, tmp_path / f"{name}.html").read_text()
        assert (FLOOR_NOTE in page) == bool(number)
        assert ("rrors that no echo lowers: " in page) != bool(number)


def test_an_instruments_floor_is_a_flights_unless_it_states_its_own():
    def floor(**changes):
        return {name: value for name, value in spec_of(**changes).error_floor if value}

    lander = "lander_ndl"
    assert floor(instrument=lander) == {"range_noise": 2.0, "vibration": 0.02}
    assert floor(instrument="automotive_fmcw") == {"vibration": 0.02}
    stated_floor = floor(instrument=lander, error_floor={"vibration": "0 m/s", "clock_error": 1e-6})
    assert stated_floor == {"range_noise": 2.0, "clock_error": 1e-6}
    assert floor() == {}
    spec = spec_of(instrument="lander_ndl")
    assert SceneSpec.from_stored(spec.to_json()).id == spec.id
    assert SceneSpec.from_mapping(spec.to_yaml_mapping()).id == spec.id
    with pytest.raises(SpecError, match=r"error_floor\.vibration"):
        spec_of(instrument="lander_ndl", error_floor={"vibration": "1 kg"})
    with pytest.raises(SpecError, match="error_floor"):
        spec_of(instrument="lander_ndl", error_floor="none")


def test_a_floor_that_is_stated_as_zero_is_off():
    spec = spec_of(
        instrument="lander_ndl", error_floor={"range_noise": "0 m", "vibration": "0 m/s"}
    )
    assert not any(value for _, value in spec.error_floor)
    assert not any(make_study(spec, Path("nowhere.zarr")).error_floor)


@pytest.mark.parametrize("command", ["plan", "run"])
def test_plan_and_run_tell_of_the_floor_that_an_instrument_brings(command, tmp_path):
    file = tmp_path / "lander.yaml"
    file.write_text(yaml.safe_dump(descent("lander_ndl", scanner=LINE)))
    options = ["--scheduler", "none", "--store", str(tmp_path / "s.zarr")]
    ran = CliRunner().invoke(main, [command, str(file), *(options if command == "run" else [])])
    assert ran.exit_code == 0
    assert ran.stderr.count(f"note: {LANDERS}") == 1


@pytest.mark.parametrize(
    ("text", "floor"),
    [
        ("error_floor: {vibration: 3 cm/s}\ninstrument:\n{fields}", {"vibration": 0.03}),
        ("error_floor: {vibration: 3 cm/s}\n{root}", {"vibration": 0.03}),
        ("title: Mine\nsource: own\ninstrument:\n{fields}", {}),
        ("{root}", {}),
    ],
)
def test_a_file_of_an_instrument_may_have_a_floor(text, floor, tmp_path):
    fields = yaml.safe_load(library_instrument_files()["lander_ndl"].read_text())["instrument"]
    root = yaml.safe_dump(fields)
    indented = "".join(f"  {line}\n" for line in root.splitlines())
    (tmp_path / "own.yaml").write_text(text.replace("{fields}", indented).replace("{root}", root))
    spec = SceneSpec.from_mapping(descent({"file": "own.yaml"}), base=tmp_path)
    assert {name: value for name, value in spec.error_floor if value} == floor
    assert spec.instrument == spec_of(instrument="lander_ndl").instrument
    brought = [s for s in spec.unstated_error_sentences() if "brings" in s]
    assert len(brought) == len(floor) and all("own.yaml brings" in s for s in brought)


@pytest.mark.parametrize(
    ("first_lines", "message"),
    [
        ("error_floor: {vibraton: 2 cm/s}", "own.yaml:1: error_floor.vibraton: is no field"),
        ("error_floor: 3", "own.yaml:1: error_floor: must be a mapping"),
        ("error_floor: {vibration: 2}", "own.yaml:1: error_floor.vibration: "),
        ("axes: {}", "own.yaml:1: instrument.axes: is no section of an instrument's file"),
        ("eror_floor: {}", "did you mean 'error_floor'"),
    ],
)
def test_mistakes_in_the_floor_of_a_file_are_reported_where_they_stand(
    first_lines, message, tmp_path
):
    fields = yaml.safe_load(library_instrument_files()["lander_ndl"].read_text())["instrument"]
    text = f"{first_lines}\n{yaml.safe_dump({'instrument': fields})}"
    (tmp_path / "own.yaml").write_text(text)
    with pytest.raises(SpecError) as refused:
        SceneSpec.from_mapping(descent({"file": "own.yaml"}), base=tmp_path)
    assert message in str(refused.value) and len(refused.value.mistakes) == 1


@pytest.mark.parametrize("instrument", ["lander_ndl", ["lander_ndl"], 3])
def test_a_file_whose_instrument_is_no_mapping_is_refused(instrument, tmp_path):
    (tmp_path / "own.yaml").write_text(yaml.safe_dump({"instrument": instrument}))
    with pytest.raises(SpecError, match="must be a mapping of fields to values in an instrument"):
        SceneSpec.from_mapping(descent({"file": "own.yaml"}), base=tmp_path)


def test_a_grid_of_an_instrument_with_a_floor_has_none():
    target = {"range": "1 km", "grazing_angle": "60 deg", "reflectance": 0.1}
    mapping = {"title": "Grid", "instrument": "lander_ndl", "target": target}
    assert "error_floor" not in GridSpec.from_mapping(mapping).to_yaml_mapping()


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
        stated_error = four[f"{name}_interpolated_standard_error"].to_numpy()
        assert np.nanmin(stated_error) >= least
    for check in check_error_consistency(tree):
        assert check.is_consistent, check.message
    if instrument == "lander_ndl":
        solved = {check.quantity: check.error_ratio for check in check_error_consistency(tree)}
        assert solved["velocity"] == pytest.approx(1, abs=0.2)
        assert solved["altitude"] == pytest.approx(1, abs=0.2)
