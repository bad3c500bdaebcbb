"""Shipped experiments and the schema that editors hold specs to, against what is read."""

import json

import jsonschema
import pytest
import yaml
from base_scene_spec import BOX_OBJECT, SCENE_WITH_EVERYTHING, SPHERE_OBJECT, scene_with_object
from base_scene_spec import changed_scene as flight
from base_spec import changed_spec
from write_experiment_ids import EXPERIMENTS, IDS_FILE, experiment_ids

from sweep.model import window as model_window
from sweep.model.ground import REFLECTANCE_LAWS
from sweep.spec import GridSpec, SceneSpec, SpecError, json_schema, load
from sweep.spec.fields import fields_by_name, reachable_models, rule_of_field
from sweep.spec.rules import COSINE_SUM_WINDOWS, NumericRule
from sweep.spec.sections import parameter_rules
from sweep.spec.yaml_document import read_document

IDS = json.loads(IDS_FILE.read_text(encoding="utf-8"))
"""First digits of the ids of each experiment: of the study, and of the geometry of each scanner."""

POINTS = {
    "quickstart": 100 * 45 * 3,
    "range_angle_coarse": 4500,
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
NEW = ("quickstart", "beam_coupling", "speckled_target", "cfar", "estimators")
"""Studies of what the thesis has nothing of."""


@pytest.fixture(scope="module")
def validator():
    schema = json.loads(json.dumps(json_schema()))
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def loaded(name):
    """A shipped study; skipped where its terrain, which is no part of the repository, is not."""
    try:
        return load(EXPERIMENTS / f"{name}.yaml")
    except SpecError as error:
        if "gale_crater_hirise_1m.tif" not in str(error):
            raise
        pytest.skip("the terrain is no part of the repository")


def test_every_experiment_that_the_project_promises_is_there():
    assert {file.stem for file in EXPERIMENTS.glob("*.yaml")} == set(IDS)


@pytest.mark.parametrize("name", IDS)
def test_a_shipped_study_keeps_its_id_and_agrees_with_the_schema(name, validator):
    path = EXPERIMENTS / f"{name}.yaml"
    validator.validate(read_document(path).content)
    text = path.read_text()
    assert text.startswith("# ")
    study = loaded(name)
    if isinstance(study, SceneSpec):
        assert max(map(len, text.splitlines())) <= 100
    assert experiment_ids(study) == IDS[name], "after a change of fields make ids writes them anew"
    assert study.question.endswith("?")


@pytest.mark.parametrize("name", POINTS)
def test_a_shipped_grid_has_its_points_and_comes_back_from_a_store(name, validator):
    study = loaded(name)
    points = 1
    for axis in study.axes:
        points *= axis.size
    assert points == POINTS[name]
    assert GridSpec.from_stored(study.to_json()) == study
    validator.validate(study.to_yaml_mapping())


@pytest.mark.parametrize("name", sorted(set(POINTS) - set(NEW)))
def test_a_reproduction_makes_the_thesiss_choices(name):
    parameters = loaded(name).parameters()
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


def test_table_5_1_differs_from_table_4_1_in_its_aperture_and_in_two_beats():
    a, b = (
        yaml.safe_load((EXPERIMENTS / "instruments" / f"{name}.yaml").read_text())
        for name in ("table_4_1", "table_5_1")
    )
    assert GridSpec.from_mapping(changed_spec(instrument=b)).instrument.telescope.aperture == 0.05
    b["telescope"]["aperture"] = "25 mm"
    assert b["processing"].pop("two_beats") == "fast"
    assert (
        GridSpec.from_mapping(changed_spec(instrument=a)).id
        == GridSpec.from_mapping(changed_spec(instrument=b)).id
    )


VARIED = changed_spec(
    axes={
        "target.range": ["1 m", {"step": ["5 m", "9 m", "1 m"]}],
        "instrument.processing.fft_size": ["2^16", 131072],
        "instrument.processing.window": ["hann", "kaiser(8.6)"],
        "target.reflectance": {"linear": [0.1, 1], "number": 4},
        "cut": {"zip": {"target.grazing_angle": "5 deg", "footprint.beamlets": [1, 2]}},
    },
    execution={"workers": 2},
)
FIGURE = {"kind": "cloud", "colour": "snr", "view": {"azimuth": "1 deg", "elevation": "2 deg"}}
READ = {
    "target": changed_spec(),
    "axes": VARIED,
    "plane": flight({"figures": [FIGURE]}),
    "rich": SCENE_WITH_EVERYTHING,
    "whole": SceneSpec.from_mapping(SCENE_WITH_EVERYTHING).to_yaml_mapping(),
}


@pytest.mark.parametrize("name", READ)
def test_a_study_that_is_read_agrees_with_the_schema(name, validator):
    validator.validate(READ[name])


@pytest.mark.parametrize(
    "changes",
    [
        {"instrument.laser.power": 1},
        {"instrument.laser.watts": "1 W"},
        {"instrument.receiver.architecture": "homodine"},
        {"target.reflectance": 2},
        {"target.range": 5},
        {"axes": {"target.rnge": ["1 m"]}},
        {"axes": {"target.range": [5]}},
        {"axes": {"target.range": {"step": ["1 m", "2 m"]}}},
        {"axes": {"cut": {"zip": [{"range": "1 m"}]}}},
        {"figures": [{"kind": "surfce", "variable": "pd_shot"}]},
        {"foorprint": {}},
        {"scanners": {}},
    ],
)
def test_an_editor_sees_the_mistake_in_a_grid_by_the_schema(changes, validator):
    assert list(validator.iter_errors(changed_spec(changes)))


@pytest.mark.parametrize(
    "changes",
    [
        {"scene.origin": 3},
        {"scene.objects.ground.kind": "plan"},
        {"scene.objects.ground.reflectance_law": "lambrt"},
        {"platform.path.from": ["0 m", "0 m"]},
        {"platform.attitude": {"kind": "nadir", "heading": "trk"}},
        {"scanners": 3},
        {"axes": {"instrument.laser.beam_divergence": ["1 urad"]}},
        {"axes": {"target.range": ["1 m"]}},
        {"figures": [FIGURE | {"kind": "surface"}]},
        {"figures": [FIGURE | {"view": {"azimuth": "1 deg"}}]},
        {"target": {"range": "1 m"}},
        {"scene.objects.crate": BOX_OBJECT | {"size": ["1 m"]}},
    ],
)
def test_an_editor_sees_the_mistake_in_a_flight_by_the_schema(changes, validator):
    assert list(validator.iter_errors(flight(changes)))


@pytest.mark.parametrize("law", REFLECTANCE_LAWS)
def test_every_law_of_the_model_is_one_that_surfaces_take(law, validator):
    mapping = scene_with_object(SPHERE_OBJECT, reflectance_law=law)
    validator.validate(mapping)
    assert SceneSpec.from_mapping(mapping).surface_materials()[1].reflectance_law == law


def test_every_parameter_is_described_with_an_example():
    definitions = json_schema()["$defs"]
    for path, rule in parameter_rules().items():
        described = definitions[f"{path}.value"]
        assert described["description"]
        assert not isinstance(rule, NumericRule) or described["examples"] == [rule.example]
    receiver = definitions["Receiver"]["properties"]
    assert receiver["local_oscillator_power"]["default"] == "0.001 W"
    assert receiver["noise_figure"]["default"] == "0 dB"


@pytest.mark.parametrize("kind", [GridSpec, SceneSpec])
def test_every_field_is_described_and_its_default_reads_back_as_it_is_written(kind):
    definitions, looked_at = json.loads(json.dumps(json_schema()["$defs"])), 0
    for model in reachable_models(kind):
        properties = definitions[model.__name__]["properties"]
        for name, field in fields_by_name(model).items():
            rule, described = rule_of_field(field), properties[name]
            if rule is None or name == "axes":
                continue
            assert described["description"], (model, name)
            if "default" in described:
                jsonschema.Draft202012Validator(described).validate(described["default"])
                read = rule.read(described["default"])
                assert read == field.default, (model, name)
                assert json.loads(json.dumps(rule.format(read))) == described["default"]
                looked_at += 1
            if rule.example and not rule.example.startswith("["):
                rule.read(rule.example)
    assert looked_at > 40


@pytest.mark.parametrize(
    "name",
    [
        *COSINE_SUM_WINDOWS,
        *model_window.WINDOW_NAME_ALIASES,
        "kaiser(8.6)",
        "chebwin(100)",
        "tukey( 0.5 )",
    ],
)
def test_every_window_that_a_spec_takes_the_model_makes(name):
    read = GridSpec.from_mapping(
        changed_spec({"instrument.processing.window": name})
    ).instrument.processing.window
    assert model_window.window_samples(read, 32).shape == (32,)
