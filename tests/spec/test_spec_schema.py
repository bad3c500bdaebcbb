import json
from pathlib import Path

import jsonschema
import pytest
import yaml
from written_specs import written

from sweep.model import window as model_window
from sweep.spec import Spec, json_schema, load
from sweep.spec.fields import parameter_rules
from sweep.spec.reading import read_document
from sweep.spec.rules import WINDOWS, Numeric

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
STUDIES = [
    path for path in sorted(EXPERIMENTS.glob("*.yaml")) if "target" in read_document(path).value
]
POINTS = {
    "quickstart": 4500,
    "single_shot_2000m": 1,
    "single_shot_45deg": 2,
    "range_angle": 900_000,
    "threshold": 360_000,
    "transmit_power": 3 * 20082,
    "aperture": 3 * 20082,
    "fft_size": 3 * 20082,
    "beam_coupling": 444,
    "beam_divergence": 6 * 30078,
    "speckled_target": 24 * 4,
    "cfar": 4 * 2 * 12,
    "estimators": 8 * 7 * 2,
}


@pytest.fixture(scope="module")
def validator():
    schema = json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_every_study_that_the_project_promises_is_there():
    assert {path.stem for path in STUDIES} == set(POINTS)


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_a_shipped_study_loads_and_agrees_with_the_schema(path, validator):
    validator.validate(yaml.safe_load(path.read_text()))
    spec = load(path)
    points = 1
    for axis in spec.axes:
        points *= axis.size
    assert points == POINTS[path.stem]
    assert spec.question.endswith("?") and path.read_text().startswith("#")
    assert Spec.from_stored(spec.to_json()) == spec
    validator.validate(spec.to_yaml_mapping())


NEW = ("beam_coupling", "speckled_target", "cfar", "estimators")
"""Studies of what the thesis has nothing of."""


@pytest.mark.parametrize(
    "path", [path for path in STUDIES if path.stem not in NEW], ids=lambda path: path.stem
)
def test_a_reproduction_makes_the_thesiss_choices(path):
    parameters = load(path).parameters()
    efficiency = parameters["instrument.telescope.optical_efficiency"]
    assert efficiency * parameters["target.reflectance"] == pytest.approx(0.1)
    assert parameters["target.reflectance_law"] == "thesis"
    assert parameters["footprint.phases"] == "coherent"
    assert parameters["footprint.beamlets"] == 109


def test_the_instrument_of_table_4_1_holds_its_printed_values():
    parameters = load(EXPERIMENTS / "range_angle.yaml").parameters()
    printed = {
        "laser.wavelength": 1.55e-6, "laser.power": 1.0, "laser.beam_divergence": 5e-5,
        "chirp.bandwidth": 1e9, "chirp.start_frequency": 5.5e9, "chirp.duration": 5e-4,
        "telescope.aperture": 0.025, "receiver.local_oscillator_power": 1e-3,
        "receiver.apd_gain": 1.0, "receiver.detector_bandwidth": 4e8,
        "receiver.responsivity": 1.1, "receiver.optical_passband": 2.5e-8,
        "receiver.noise_equivalent_power": 5e-12, "receiver.transimpedance": 7e3,
        "receiver.amplifier_bandwidth": 4e8, "receiver.amplifier_noise_current": 2.5e-8,
        "processing.sample_rate": 6e8, "processing.fft_size": 131072,
        "processing.window": "hamming", "processing.tnr": 10.0,
    }  # fmt: skip
    assert {path: parameters[f"instrument.{path}"] for path in printed} == printed


def test_table_5_1_differs_from_table_4_1_in_its_aperture_alone():
    a, b = (
        yaml.safe_load((EXPERIMENTS / "instruments" / f"{name}.yaml").read_text())
        for name in ("table_4_1", "table_5_1")
    )
    assert Spec.from_mapping(written(instrument=b)).instrument.telescope.aperture == 0.05
    b["telescope"]["aperture"] = "25 mm"
    assert (
        Spec.from_mapping(written(instrument=a)).id == Spec.from_mapping(written(instrument=b)).id
    )


def test_a_study_written_in_whole_agrees_with_the_schema(validator):
    validator.validate(
        written(
            axes={
                "target.range": ["1 m", {"step": ["5 m", "9 m", "1 m"]}],
                "instrument.processing.fft_size": ["2^16", 131072],
                "instrument.processing.window": ["hann", "kaiser(8.6)"],
                "target.reflectance": {"linear": [0.1, 1], "number": 4},
                "cut": {"zip": {"target.grazing_angle": "5 deg", "footprint.beamlets": [1, 2]}},
            },
            execution={"workers": 2},
        )
    )


@pytest.mark.parametrize(
    "changes",
    [
        {"instrument.laser.power": 1},
        {"instrument.laser.power": "1"},
        {"instrument.laser.watts": "1 W"},
        {"instrument.processing.fft_size": "two"},
        {"instrument.receiver.architecture": "homodine"},
        {"target.reflectance": 2},
        {"target.range": 5},
        {"axes": {"target.rnge": ["1 m"]}},
        {"axes": {"target.range": [5]}},
        {"axes": {"target.range": []}},
        {"axes": {"target.range": {"step": ["1 m", "2 m"]}}},
        {"axes": {"target.range": {"linear": ["1 m", "2 m"]}}},
        {"axes": {"cut": {"zip": [{"range": "1 m"}]}}},
        {"figures": [{"kind": "surfce", "variable": "pd_shot"}]},
        {"title": ...},
        {"foorprint": {}},
    ],
)
def test_an_editor_sees_the_mistake_by_the_schema(changes, validator):
    assert list(validator.iter_errors(written(changes)))


def test_every_parameter_is_described_with_an_example_and_defaults_are_as_written(validator):
    schema = json.loads(json.dumps(json_schema()))
    for path, rule in parameter_rules().items():
        described = schema["$defs"][f"{path}.value"]
        assert described["description"]
        if isinstance(rule, Numeric):
            assert described["examples"] == [rule.example]
            rule.read(rule.example)
    receiver = schema["$defs"]["Receiver"]["properties"]
    assert receiver["local_oscillator_power"]["default"] == "0.001 W"
    assert receiver["noise_figure"]["default"] == "0 dB"
    for name, described in receiver.items():
        if "default" in described:
            rule = parameter_rules()[f"instrument.receiver.{name}"]
            jsonschema.Draft202012Validator(described).validate(described["default"])
            assert rule.written(rule.read(described["default"])) == described["default"]


@pytest.mark.parametrize(
    "name", [*WINDOWS, *model_window.ALIASES, "kaiser(8.6)", "chebwin(100)", "tukey( 0.5 )"]
)
def test_every_window_that_a_spec_takes_the_model_makes(name):
    read = Spec.from_mapping(
        written({"instrument.processing.window": name})
    ).instrument.processing.window
    assert model_window.samples(read, 32).shape == (32,)
