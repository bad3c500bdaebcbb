"""What effects bring into a spec: their parameters, their modes, and what these need."""

import json

import jsonschema
import numpy as np
import pytest
import yaml
from base_scene_spec import changed_scene as flight
from base_spec import changed_spec, required_values
from hypothesis import given, settings
from hypothesis import strategies as st

import sweep.spec.fields
from sweep.model.effects.catalogue import EFFECT_NAMES, EFFECT_PARAMETERS, EFFECTS
from sweep.model.effects.effect import Parameter
from sweep.spec import (
    GridSpec,
    SceneSpec,
    SpecError,
    describe_differences,
    from_stored,
    json_schema,
)
from sweep.spec.axes import read_axes
from sweep.spec.fields import (
    SpecSection,
    add_effect_mode_fields,
    add_effect_parameter_fields,
    rule_of_field,
)
from sweep.spec.grid_checks import GridValues
from sweep.spec.rules import NumericRule
from sweep.spec.sections import Effects, Laser, parameter_rules
from sweep.spec.yaml_document import read_document

BROUGHT = pytest.mark.parametrize("parameter", EFFECT_PARAMETERS, ids=lambda p: p.path)
RANDOM = {
    parameter.path: effect.name
    for effect in EFFECTS if effect.is_random
    for parameter in effect.parameters if parameter.enables_effect
}  # fmt: skip
"""Parameters that bring a random effect."""
FIELD_VALUES = {
    parameter.path: parameter.example or parameter.options[1]
    for parameter in EFFECT_PARAMETERS if parameter.path in RANDOM
} | {"target.roughness": "1 um", "target.pointing_jitter": "1 urad",
     "atmosphere.turbulence": "uniform"}  # fmt: skip
"""A value of each of them with which the effect is there."""
RECORD = "instrument.receiver.record"
NEEDED = {"instrument.processing.full_scale": "1 V", "atmosphere.extinction": "0.1 1/km",
          "draws.number": 1, "instrument.telescope.isolation": "50 dB",
          "instrument.telescope.coupling": "single_mode", RECORD: "complex",
          "instrument.laser.beam_divergence": "100 urad"}  # fmt: skip
"""What parameters of effects need beside them."""


def spec(changes=None, **sections):
    return GridSpec.from_mapping(changed_spec(changes, **sections))


def mistakes(kind, mapping):
    try:
        kind.from_mapping(mapping)
    except SpecError as error:
        return [str(mistake) for mistake in error.mistakes]
    return []


def values(parameter):
    """Good values of a parameter as a user writes them, more than its default."""
    if parameter.is_table:
        return [parameter.default, [["0 us", "0 Hz"], ["250 us", "1 kHz"], ["500 us", "2 kHz"]]]
    return list(parameter.options) or [parameter.example]


@pytest.fixture(scope="module")
def validator():
    return jsonschema.Draft202012Validator(json.loads(json.dumps(json_schema())))


@BROUGHT
def test_a_parameter_of_an_effect_is_a_field_by_itself(parameter, validator):
    without_speckle = {"footprint.speckle": ...}
    default = spec(without_speckle).parameters()[parameter.path]
    assert default == parameter.default and type(default) is type(parameter.default)
    for value in values(parameter):
        mapping = changed_spec(NEEDED | required_values(parameter.path) | {parameter.path: value})
        validator.validate(mapping)
        read = GridSpec.from_mapping(mapping)
        assert parameter.path in read.identity()["parameters"]
        assert GridSpec.from_stored(read.to_json()).parameters() == read.parameters()
    rule = parameter_rules()[parameter.path]
    assert rule.read(rule.format(parameter.default)) == parameter.default
    assert (
        spec(without_speckle | {parameter.path: rule.format(parameter.default)}).id
        == spec(without_speckle).id
    )


@BROUGHT
def test_a_parameter_of_an_effect_may_be_an_axis(parameter, validator):
    if parameter.is_table:  # one for a whole study (test_spec_reading)
        return
    written_values = values(parameter)
    needed = NEEDED | required_values(parameter.path)
    mapping = changed_spec(needed, axes={parameter.path: written_values})
    validator.validate(mapping)
    (axis,) = GridSpec.from_mapping(mapping).axes
    rule = parameter_rules()[parameter.path]
    assert list(axis.parameters[0].values) == [rule.read(value) for value in written_values]
    coordinate = GridSpec.from_mapping(mapping).read_coordinate_value(axis.name, written_values[-1])
    assert coordinate == axis.parameters[0].display_values[-1]


@BROUGHT
def test_a_flight_has_the_parameters_that_are_not_its_targets(parameter):
    is_targets = parameter.path.startswith("target.")
    assert (parameter.path in SceneSpec.from_mapping(flight()).parameters()) is not is_targets
    if is_targets:
        (mistake,) = mistakes(SceneSpec, flight(axes={parameter.path: values(parameter)}))
        assert "is given by the scene" in mistake


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_any_value_of_a_numeric_parameter_is_written_so_that_it_reads_back(data):
    parameter = data.draw(
        st.sampled_from([p for p in EFFECT_PARAMETERS if not (p.options or p.is_table)])
    )
    value = data.draw(st.floats(1e-300, 1e300, allow_nan=False))
    rule = parameter_rules()[parameter.path]
    assert isinstance(rule, NumericRule)
    if rule.si_unit != "dB" and rule.first_bound_violation(np.array([value])) is None:
        assert rule.read(rule.format(value)) == value


def test_a_new_parameter_or_effect_touches_no_section(monkeypatch):
    """Both decorators read the catalogue: what is added there is in the sections."""
    new = Parameter(path="instrument.laser.colours", description="Colours", default=2.0,
                    example="3", limits=("1", None))  # fmt: skip
    monkeypatch.setattr(sweep.spec.fields, "EFFECT_PARAMETERS", (new,))
    monkeypatch.setattr(sweep.spec.fields, "EFFECTS", EFFECTS[:1])

    class Bare(SpecSection):
        """A section."""

    Lamp = add_effect_parameter_fields("instrument.laser")(Bare)
    assert Lamp.model_validate({}).colours == 2 and Lamp.model_validate({"colours": 3}).colours == 3
    assert Lamp.__doc__ == "A section." and Lamp.__name__ == "Bare"
    assert Lamp.__module__ == __name__
    assert set(add_effect_mode_fields(Bare).model_fields) == {EFFECTS[0].name}
    assert not add_effect_parameter_fields("instrument")(Bare).model_fields
    with pytest.raises(TypeError, match="has colours already"):
        add_effect_parameter_fields("instrument.laser")(Lamp)


def test_a_section_keeps_its_name_and_words():
    assert (Laser.__name__, Laser.__module__) == ("Laser", "sweep.spec.sections")
    assert Laser.__doc__ == "Transmitter: wavelength, power and beam."
    assert next(iter(Laser.model_fields)) == "wavelength"


# Modes


def test_every_effect_is_simulated_where_the_scene_calls_for_it_by_default():
    for study in (spec(), SceneSpec.from_mapping(flight())):
        assert study.effect_modes() == dict.fromkeys(EFFECT_NAMES, "auto")
        assert study.identity()["effects"] == study.effect_modes()
    for effect in EFFECTS:
        about = rule_of_field(Effects.model_fields[effect.name]).description
        assert about[0].isupper() and about[1:] == effect.description[1:]


@pytest.mark.parametrize(
    ("text", "mode"),
    [("on", "on"), ("off", "off"), ("true", "on"), ("False", "off"), ("'on'", "on"),
     ("yes", "on"), ("auto", "auto")],
)  # fmt: skip
def test_a_mode_is_read_from_yaml_with_or_without_quotes(text, mode, tmp_path, validator):
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(changed_spec()) + f"effects: {{leakage: {text}}}\n")
    document = read_document(path)
    validator.validate(document.content)
    study = GridSpec.from_document(document, tmp_path)
    assert study.effect_modes()["leakage"] == mode
    assert GridSpec.from_stored(study.to_json()).effect_modes() == study.effect_modes()


@pytest.mark.parametrize("name", EFFECT_NAMES)
@pytest.mark.parametrize("kind", [GridSpec, SceneSpec])
def test_a_mode_is_part_of_the_identity(name, kind):
    base = {GridSpec: changed_spec, SceneSpec: flight}[kind]
    default_spec, switched_off = (
        kind.from_mapping(m) for m in (base(), base({f"effects.{name}": "off"}))
    )
    assert default_spec.id != switched_off.id
    assert describe_differences(default_spec, switched_off) == [f"effects.{name}: auto -> off"]
    assert kind.from_mapping(base({f"effects.{name}": False})).id == switched_off.id


@pytest.mark.parametrize("effect", [e for e in EFFECTS if e.parent], ids=lambda e: e.name)
def test_an_effect_is_on_only_within_one_that_is_not_off(effect):
    on, parent_path = f"effects.{effect.name}", f"effects.{effect.parent}"
    (mistake,) = mistakes(GridSpec, changed_spec({on: True, parent_path: False}))
    assert mistake.startswith(f"{on}: acts within {effect.parent}, which is off")
    assert f"turn {effect.parent} on" in mistake
    for changes in ({on: "auto", parent_path: "off"}, {on: "on"}, {on: "off", parent_path: "on"}):
        assert not mistakes(GridSpec, changed_spec(changes))


def test_a_mode_that_cannot_be_read_is_reported_alone():
    (mistake,) = mistakes(
        GridSpec, changed_spec({"effects.footprint": "of", "effects.doppler_spread": "on"})
    )
    assert mistake.startswith("effects.footprint: ")
    (mistake,) = mistakes(
        GridSpec, changed_spec({"effects.speckle": "of", "target.roughness": "1 um"})
    )
    assert mistake.startswith("effects.speckle: ")


def test_a_stored_study_without_effects_reads_as_one_that_leaves_all_to_the_scene():
    mapping = spec().to_yaml_mapping()
    del mapping["effects"], mapping["atmosphere"], mapping["accuracy"]["tolerance"]
    old = from_stored(json.dumps(mapping))
    assert old.id == spec().id


# What effects need


def test_the_random_effects_are_those_looked_at_here():
    assert set(RANDOM.values()) == {effect.name for effect in EFFECTS if effect.is_random}
    assert {"target.roughness", "target.pointing_jitter", "atmosphere.turbulence"} <= set(RANDOM)


@pytest.mark.parametrize("path", RANDOM)
def test_a_random_effect_needs_draws_or_is_off(path):
    axes, name = {path: FIELD_VALUES[path]}, RANDOM[path]
    (mistake,) = mistakes(GridSpec, changed_spec(axes))
    assert mistake.startswith(f"{path}: is simulated by draws")
    assert "set draws.limit to draw until accuracy.tolerance is met, draws.number" in mistake
    assert mistake.endswith(f"or effects.{name}: off")
    default = parameter_rules()[path].format(parameter_rules()[path].read(FIELD_VALUES[path]))
    (mistake,) = mistakes(GridSpec, changed_spec(axes={path: [default]}))
    assert mistake.startswith(f"axes.{path}: is simulated by draws")
    assert not mistakes(GridSpec, changed_spec(axes | {"draws.number": 1}))
    assert not mistakes(GridSpec, changed_spec(axes | {"draws.limit": 1}))
    assert not mistakes(GridSpec, changed_spec(axes | {f"effects.{name}": "off"}))


def test_what_only_says_how_a_random_effect_acts_asks_for_no_draws():
    fields = {"atmosphere.structure_constant": "1e-15 m^(-2/3)",
           "atmosphere.scintillation_law": "log_normal"}  # fmt: skip
    assert not mistakes(GridSpec, changed_spec(fields))


@pytest.mark.parametrize("name", RANDOM.values())
def test_a_flight_draws_its_air_and_refuses_other_random_effects(name):
    refusals = mistakes(SceneSpec, flight({f"effects.{name}": "on"}))
    if name == "scintillation":
        assert not refusals
        return
    (mistake,) = refusals
    assert mistake.startswith(f"effects.{name}: is not drawn in flights")
    assert ("platform.jitter" in mistake) is (name == "pointing_jitter")
    assert not mistakes(SceneSpec, flight({f"effects.{name}": "off"}))


def test_a_flight_has_turbulence_but_no_target():
    assert not mistakes(SceneSpec, flight({"atmosphere.turbulence": "hufnagel_valley"}))
    (mistake,) = mistakes(SceneSpec, flight({"target": {"roughness": "1 um"}}))
    assert mistake.startswith("target: is no field")


@pytest.mark.parametrize("on_axis", [False, True])
def test_speckle_is_refused_for_direct_detection(on_axis):
    receiver = {"instrument.receiver.architecture": "direct"}
    changes = {"target.roughness": "10 um", "draws.number": 10}
    if on_axis:
        changes["axes"] = {"instrument.receiver.architecture": ["homodyne", "direct"]}
    else:
        changes |= receiver
    with pytest.raises(SpecError, match="makes speckle, and direct detection averages"):
        spec(changes)
    assert spec(changes | {"effects.speckle": "off"}).effect_modes()["speckle"] == "off"


BITS, FULL_SCALE = "instrument.processing.bits", "instrument.processing.full_scale"
PROFILE, EXTINCTION = "atmosphere.profile", "atmosphere.extinction"


@pytest.mark.parametrize("kind", [GridSpec, SceneSpec])
def test_a_parameter_needs_the_one_without_which_it_means_nothing(kind):
    base = {GridSpec: changed_spec, SceneSpec: flight}[kind]
    (mistake,) = mistakes(kind, base({BITS: 12}))
    assert mistake.startswith(f"{BITS}: needs {FULL_SCALE}, which is 0; set {FULL_SCALE}")
    assert not mistakes(kind, base({BITS: 12, FULL_SCALE: "1 V"}))
    assert not mistakes(kind, base({BITS: 12, "effects.quantisation": "off"}))
    for profile in ("exponential", "layer"):
        (mistake,) = mistakes(kind, base({PROFILE: profile}))
        assert mistake.startswith(f"{PROFILE}: needs {EXTINCTION}, which is 0")
        assert not mistakes(kind, base({PROFILE: profile, EXTINCTION: "0.1 1/km"}))


def test_a_need_is_held_against_the_points_of_the_grid_and_no_others():
    scales = ["0 V", "1 V"]
    (mistake,) = mistakes(GridSpec, changed_spec({BITS: 12}, axes={FULL_SCALE: scales}))
    assert mistake.startswith(f"{BITS}: ")
    (mistake,) = mistakes(GridSpec, changed_spec(axes={BITS: [0, 12], FULL_SCALE: scales}))
    assert mistake.startswith(f"axes.{BITS}: ")
    together = {"zip": {BITS: [0, 12], FULL_SCALE: scales}}
    assert not mistakes(GridSpec, changed_spec(axes={"adc": together}))
    crossed = {"zip": {BITS: [12, 0], FULL_SCALE: scales}}
    (mistake,) = mistakes(GridSpec, changed_spec(axes={"adc": crossed}))
    assert mistake.startswith("axes.adc: ")


def test_a_point_asked_for_later_is_held_to_the_same_needs():
    with pytest.raises(SpecError, match=f"needs {FULL_SCALE}"):
        spec().parameters_with_overrides({"bits": 12})
    at = spec().parameters_with_overrides({"bits": 12, "full_scale": "1 V", "roughness": "1 um"})
    assert at["target.roughness"] == 1e-6


counts = st.lists(st.integers(0, 3), min_size=2, max_size=2, unique=True)


@settings(deadline=None)
@given(counts, counts, st.booleans(), st.integers(0, 3), st.integers(0, 3))
def test_a_grid_has_a_point_just_when_one_of_its_points_meets_all_conditions(a, b, zipped, x, y):
    one, two = "instrument.receiver.apd_gain", "instrument.receiver.excess_noise_factor"
    three = "instrument.processing.tnr"
    a, b = [value + 1 for value in a], [value + 1 for value in b]
    axes, _ = read_axes({"both": {"zip": {one: a, two: b}}} if zipped else {one: a, two: b})
    conditions = {one: lambda v: v > x, two: lambda v: v < y, three: lambda v: v == 1}
    points = zip(a, b, strict=True) if zipped else [(i, j) for i in a for j in b]
    expected = any(i > x and j < y for i, j in points)
    assert GridValues({three: 1.0}, axes).any_point_meets(conditions) == expected
    assert not GridValues({three: 2.0}, axes).any_point_meets(conditions)
    assert not GridValues({}, axes).any_point_meets(conditions)


# Decibels beside a plain unit


def test_an_axis_in_decibels_per_hertz_is_shown_in_them():
    path = "instrument.laser.relative_intensity_noise"
    steps = {"step": ["-160 dB/Hz", "-140 dB/Hz", "10 dB/Hz"]}
    study = spec(axes={path: steps})
    member = study.axes[0].parameters[0]
    assert member.values.tolist() == [1e-16, 1e-15, 1e-14] and member.units == "dB/Hz"
    assert study.read_coordinate_value("relative_intensity_noise", "-150 dB/Hz") == -150
    assert study.read_coordinate_value("relative_intensity_noise", "1e-15 1/Hz") == -150
    mixed = spec(axes={path: ["-160 dB/Hz", "0 1/Hz"]}).axes[0].parameters[0]
    assert mixed.display_values.tolist() == [1e-16, 0] and mixed.units == "1/Hz"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "set instrument.telescope.isolation"),
        ({"instrument.telescope.isolation": "50 dB", "instrument.looks.number": 4}, "one record"),
        ({"instrument.telescope.isolation": "50 dB", "draws.method": "noise"}, "not drawn"),
    ],
)
def test_what_does_not_go_with_leaked_light_is_refused(changes, words):
    with pytest.raises(SpecError, match=words):
        GridSpec.from_mapping(changed_spec({"instrument.telescope.leak_path": "2 m", **changes}))
