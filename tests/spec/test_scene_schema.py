"""The schema that editors hold scene studies to, against what is read."""

import json
from pathlib import Path

import jsonschema
import pytest
from written_scenes import BOX, RICH, SPHERE, TREES, with_object, written
from written_specs import written as grid

from sweep.model.ground import LAWS
from sweep.spec import SceneSpec, json_schema, load
from sweep.spec.parts import all_parts, rule_of, written_name
from sweep.spec.reading import read_document

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
SCENES = [
    path for path in sorted(EXPERIMENTS.glob("*.yaml")) if "scene" in read_document(path).value
]


@pytest.fixture(scope="module")
def validator():
    schema = json.loads(json.dumps(json_schema()))
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("mapping", [written(), RICH, grid()], ids=["plane", "rich", "target"])
def test_a_study_that_is_read_agrees_with_the_schema(mapping, validator):
    validator.validate(mapping)


def test_a_study_written_out_whole_agrees_with_the_schema(validator):
    validator.validate(SceneSpec.from_mapping(RICH).to_yaml_mapping())


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_a_shipped_scene_agrees_with_the_schema(path, validator):
    validator.validate(read_document(path).value)
    text = path.read_text()
    assert text.startswith("# ") and max(map(len, text.splitlines())) <= 100


FIGURE = {"kind": "cloud", "colour": "snr", "view": {"azimuth": "1 deg", "elevation": "2 deg"}}


@pytest.mark.parametrize(
    "changes",
    [
        {"scene.origin": 3},
        {"scene.objects.ground.kind": "plan"},
        {"scene.objects.ground.size": 3},
        {"scene.objects.ground.reflectanc": 3},
        {"scene.objects.ground.reflectance": ...},
        {"scene.objects.ground.reflectance_law": "lambrt"},
        {"platform.path.from": ...},
        {"platform.path.from": ["0 m", "0 m"]},
        {"platform.path.from": [0, 0, 0]},
        {"platform.attitude": {"kind": "nadir", "heading": "trk"}},
        {"scanners.three.beams": "many"},
        {"scanners": 3},
        {"scanners": ...},
        {"axes": {"instrument.laser.beam_divergence": ["1 urad"]}},
        {"axes": {"target.range": ["1 m"]}},
        {"draws.number": 0},
        {"figures": [FIGURE | {"kind": "surface"}]},
        {"figures": [FIGURE | {"colour": "rnge"}]},
        {"figures": [FIGURE | {"x": ["1 m"]}]},
        {"figures": [FIGURE | {"view": {"azimuth": "1 deg"}}]},
        {"target": {"range": "1 m"}},
    ],
)
def test_an_editor_sees_the_mistake_by_the_schema(changes, validator):
    assert not list(validator.iter_errors(written({"figures": [FIGURE]})))
    assert list(validator.iter_errors(written(changes)))


@pytest.mark.parametrize("law", LAWS)
def test_every_law_of_the_model_is_one_that_surfaces_take(law, validator):
    mapping = with_object(SPHERE, reflectance_law=law)
    validator.validate(mapping)
    assert SceneSpec.from_mapping(mapping).surfaces()[1].law == law


def test_every_field_is_described_and_its_default_reads_back():
    schema = json_schema()
    looked_at = 0
    for model in all_parts(SceneSpec):
        properties = schema["$defs"][model.__name__]["properties"]
        for name, field in model.model_fields.items():
            rule, described = rule_of(field), properties[written_name(name, field)]
            if rule is None or name == "axes":
                continue
            assert described["description"], (model, name)
            if "default" in described:
                assert rule.read(described["default"]) == field.default, (model, name)
                looked_at += 1
            if rule.example and not rule.example.startswith("["):
                rule.read(rule.example)
    assert looked_at > 40


def test_a_target_is_not_held_to_a_scene_nor_a_scene_to_a_target(validator):
    assert list(validator.iter_errors(grid(scanners={})))
    assert list(validator.iter_errors({"title": "nothing"}))
    forest = with_object(TREES, "forest", leaf={"reflectance": 3})
    crate = with_object(BOX, "crate", size=["1 m"])
    for mapping in (forest, crate):
        assert list(validator.iter_errors(mapping))


def test_the_shipped_scenes_are_those_of_the_thesis_and_two_more():
    assert {path.stem for path in SCENES} == {
        "expanded_pattern", "forest_scan", "gale_crater_descent", "morpheus_three_beam",
        "oblique_descent", "scan_pattern_comparison", "speckled_descent",
        "square_high_descent", "square_low_descent",
    }  # fmt: skip
    for path in SCENES:
        if path.stem != "gale_crater_descent":
            assert load(path).question.endswith("?")
