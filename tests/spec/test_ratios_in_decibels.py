"""Efficiencies of power may be written in decibels, as data sheets have them."""

import json

import jsonschema
import pytest
from base_spec import changed_spec

from sweep.spec import GridSpec, SpecError, json_schema

EFFICIENCIES = [
    "instrument.telescope.optical_efficiency",
    "instrument.receiver.mixing_efficiency",
]


@pytest.mark.parametrize("path", EFFICIENCIES)
@pytest.mark.parametrize("text", ["-3 dB", "-3.0dB", "−3 dB"])
def test_an_efficiency_is_read_from_decibels(path, text):
    spec = GridSpec.from_mapping(changed_spec({path: text}))
    assert spec.parameters()[path] == pytest.approx(10**-0.3, rel=1e-15)
    assert GridSpec.from_mapping(spec.to_yaml_mapping()).id == spec.id
    same = GridSpec.from_mapping(changed_spec({path: spec.parameters()[path]}))
    assert same.id == spec.id


@pytest.mark.parametrize("path", EFFICIENCIES)
def test_a_gain_is_no_efficiency(path):
    with pytest.raises(SpecError, match="must be at most 1"):
        GridSpec.from_mapping(changed_spec({path: "0.1 dB"}))


def test_an_axis_of_an_efficiency_is_in_decibels():
    axes = {EFFICIENCIES[0]: {"linear": ["-6 dB", "0 dB"], "number": 3}}
    (axis,) = GridSpec.from_mapping(changed_spec(axes=axes)).axes
    (member,) = axis.parameters
    assert member.units == "dB" and member.display_values.tolist() == pytest.approx([-6, -3, 0])
    assert member.values.tolist() == pytest.approx([10**-0.6, 10**-0.3, 1])


def test_the_schema_takes_decibels_for_efficiencies_alone():
    validator = jsonschema.Draft202012Validator(json.loads(json.dumps(json_schema())))
    assert validator.is_valid(changed_spec({EFFICIENCIES[0]: "-3 dB"}))
    assert not validator.is_valid(changed_spec({"instrument.processing.tnr": "20 dB"}))
