"""Anchors of YAML: merge keys, and sections `x-...` to hold them."""

import json

import jsonschema
import pytest
import yaml
from base_spec import BASE_SPEC, changed_spec

from sweep.spec import GridSpec, SpecError, json_schema, load, load_cluster_config

MERGED = """\
title: A study
x-receiver: &receiver
  responsivity: 1.1 A/W
  detector_bandwidth: 400 MHz
  optical_passband: 25 nm
  noise_equivalent_power: 5 pW/rtHz
x-amplifier: &amplifier {transimpedance: 7 kohm, amplifier_bandwidth: 400 MHz,
  amplifier_noise_current: 25 nA, detector_bandwidth: 1 GHz}
instrument:
  laser: {wavelength: 1550 nm, power: 1 W, beam_divergence: 50 urad}
  chirp: {bandwidth: 1 GHz, start_frequency: 5.5 GHz, duration: 500 us}
  telescope: {aperture: 25 mm, coupling: aperture}
  receiver:
    <<: [*receiver, *amplifier]
    optical_passband: 30 nm
  processing: {sample_rate: 600 MHz, fft_size: 2^17, tnr: 10}
target: &target {range: 2 km, grazing_angle: 90 deg, reflectance: 0.1}
footprint: {speckle: none}
"""


def loaded(tmp_path, text):
    file = tmp_path / "a.yaml"
    file.write_text(text)
    return load(file)


def mistakes_of(tmp_path, text):
    with pytest.raises(SpecError) as error_info:
        loaded(tmp_path, text)
    return error_info.value.mistakes


def test_merged_fields_count_as_if_they_were_written_and_written_ones_come_first(tmp_path):
    spec = loaded(tmp_path, MERGED)
    assert (
        spec.id
        == GridSpec.from_mapping(changed_spec({"instrument.receiver.optical_passband": "30 nm"})).id
    )
    assert spec.instrument.receiver.detector_bandwidth == 400e6  # the first of the list
    assert yaml.safe_load(MERGED)["instrument"]["receiver"]["detector_bandwidth"] == "400 MHz"
    assert not any(name.startswith(("x-", "<<")) for name in spec.to_yaml_mapping())


def test_merged_axes_keep_the_order_that_yaml_gives_them(tmp_path):
    text = MERGED.replace("reflectance: 0.1}", "reflectance: 0.1, radial_velocity: 3 m/s}")
    text += "x-axes: &axes {target.range: [1 km, 2 km]}\n"
    text += "axes: {target.reflectance: [0.1, 0.2], <<: *axes}\n"
    assert list(yaml.safe_load(text)["axes"]) == ["target.range", "target.reflectance"]
    assert [axis.name for axis in loaded(tmp_path, text).axes] == ["range", "reflectance"]


def test_a_mistake_in_a_merged_field_is_reported_on_its_own_line_once(tmp_path):
    (mistake,) = mistakes_of(tmp_path, MERGED.replace("1.1 A/W", "1.1 mW"))
    assert (mistake.path, mistake.line) == ("instrument.receiver.responsivity", 3)
    (mistake,) = mistakes_of(tmp_path, MERGED.replace("30 nm", "30 nW"))
    assert (mistake.path, mistake.line) == ("instrument.receiver.optical_passband", 15)


@pytest.mark.parametrize(
    ("old", "new", "path", "words"),
    [
        ("  optical_passband: 25 nm", "  optical_passband: 25 nm\n  optical_passband: 26 nm",
         "x-receiver.optical_passband", "is given twice, on lines 5 and 6"),
        ("    optical_passband: 30 nm", "    optical_passband: 30 nm\n    optical_passband: 30 nm",
         "instrument.receiver.optical_passband", "is given twice, on lines 15 and 16"),
        ("    <<: [*receiver, *amplifier]", "    <<: *receiver\n    <<: *amplifier",
         "instrument.receiver.<<", "is given twice, on lines 14 and 15; write '<<: [*first, *sec"),
        ("<<: [*receiver, *amplifier]", "<<: [*receiver, *amplifier, 3]",
         "instrument.receiver.<<", "must name a mapping by its anchor"),
        ("target: &target {", "target: &target {<<: *target, ",
         "target.<<", "merges a mapping into itself; leave it out"),
    ],
)  # fmt: skip
def test_what_merge_keys_cannot_mean_is_refused(tmp_path, old, new, path, words):
    messages_by_path = {m.path: str(m) for m in mistakes_of(tmp_path, MERGED.replace(old, new))}
    assert words in messages_by_path[path]
    assert all(": is missing" in text for other, text in messages_by_path.items() if other != path)


def test_a_section_x_stands_at_the_top_alone(tmp_path):
    (mistake,) = mistakes_of(tmp_path, MERGED.replace("footprint: {", "footprint: {x-a: 1, "))
    assert mistake.path == "footprint.x-a" and "is no field" in str(mistake)


def test_a_long_chain_of_merges_ends_in_words(tmp_path):
    chain = "x-0: &a0 {b: 1}\n"
    chain += "".join(f"x-{i}: &a{i} {{<<: *a{i - 1}}}\n" for i in range(1, 3000))
    (mistake,) = mistakes_of(tmp_path, chain)
    assert "holds too many values" in str(mistake)


def test_merges_that_double_end_in_words(tmp_path):
    doubling = "x-0: &a0 {b: 1}\n"
    for i in range(1, 25):
        doubling += f"x-{i}: &a{i} {{p{i}: *a{i - 1}, q{i}: *a{i - 1}, <<: *a{i - 1}}}\n"
    (mistake,) = mistakes_of(tmp_path, doubling)
    assert "holds too many values" in str(mistake)


def test_files_of_instruments_and_clusters_and_plain_data_take_them_too(tmp_path):
    instrument = {"x-note": 1, **BASE_SPEC["instrument"]}
    (tmp_path / "instrument.yaml").write_text(json.dumps(instrument))
    spec = changed_spec(
        {"instrument": {"file": "instrument.yaml"}}, **{"x-note": {"any": ["thing"]}}
    )
    assert GridSpec.from_mapping(spec, base=tmp_path).id == GridSpec.from_mapping(BASE_SPEC).id
    (tmp_path / "local.yaml").write_text(
        "x-w: &w {threads: 2}\nkind: local\nworkers: 1\nworker: {<<: *w, memory: 1 GB}\n"
    )
    assert load_cluster_config(tmp_path / "local.yaml").worker.threads == 2


def test_an_editor_takes_sections_x():
    schema = json_schema()
    jsonschema.validate(changed_spec(**{"x-note": [1]}), schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(changed_spec(note=[1]), schema)
