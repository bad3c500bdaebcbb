"""Efficiencies of power may be written in decibels, as data sheets have them."""

import json

import jsonschema
import pytest
from written_specs import written

from sweep.spec import Spec, SpecError, json_schema

EFFICIENCIES = [
    "instrument.telescope.optical_efficiency",
    "instrument.receiver.mixing_efficiency",
]


@pytest.mark.parametrize("path", EFFICIENCIES)
@pytest.mark.parametrize("text", ["-3 dB", "-3.0dB", "−3 dB"])
def test_an_efficiency_is_read_from_decibels(path, text):
    spec = Spec.from_mapping(written({path: text}))
    assert spec.parameters()[path] == pytest.approx(10**-0.3, rel=1e-15)
    assert Spec.from_mapping(spec.to_yaml_mapping()).id == spec.id
    same = Spec.from_mapping(written({path: spec.parameters()[path]}))
    assert same.id == spec.id


@pytest.mark.parametrize("path", EFFICIENCIES)
def test_a_gain_is_no_efficiency(path):
    with pytest.raises(SpecError, match="must be at most 1"):
        Spec.from_mapping(written({path: "0.1 dB"}))


def test_an_axis_of_an_efficiency_is_in_decibels():
    axes = {EFFICIENCIES[0]: {"linear": ["-6 dB", "0 dB"], "number": 3}}
    (axis,) = Spec.from_mapping(written(axes=axes)).axes
    (member,) = axis.members
    assert member.units == "dB" and member.display.tolist() == pytest.approx([-6, -3, 0])
    assert member.values.tolist() == pytest.approx([10**-0.6, 10**-0.3, 1])


def test_the_schema_takes_decibels_for_efficiencies_alone():
    validator = jsonschema.Draft202012Validator(json.loads(json.dumps(json_schema())))
    assert validator.is_valid(written({EFFICIENCIES[0]: "-3 dB"}))
    assert not validator.is_valid(written({"instrument.processing.tnr": "20 dB"}))
