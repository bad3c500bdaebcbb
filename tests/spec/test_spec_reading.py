import numpy as np
import pytest
import yaml
from base_spec import BASE_SPEC, changed_spec

from sweep.spec import GridSpec, SpecError, load
from sweep.spec.figure_sections import FalseAlarmTable


def write(path, mapping):
    path.write_text(yaml.safe_dump(mapping, sort_keys=False))
    return path


def refusal(path):
    with pytest.raises(SpecError) as error_info:
        load(path)
    return str(error_info.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"title: [", "bad.yaml:1: is no valid YAML"),
        (b"title: [a\nb: }", "look at the brackets"),
        (b"title: a\n\tb: c", "is no valid YAML"),
        (b"", "holds nothing"),
        (b"just words", "must hold a mapping"),
        (b"\xff\xfe\x00", "is no UTF-8 text"),
        (b"title: a\x00b", "is no valid YAML"),
        (b"a: " + b"[" * 5000, "nested too deeply"),
        (b"a: " + b"x" * 1_000_001, "is larger than"),
        (b"a: &a [*a]", "holds too many values"),
        (b"a: *nowhere", "is no valid YAML"),
        (b"a: 1\n---\nb: 2", "is no valid YAML"),
        (b"? [1, 2]\n: 3", "has a key that is no word"),
        (b"title: !!python/object/apply:os.system [echo]", "tags are not read"),
        (b"title: !mine x", "tags are not read"),
    ],
)
def test_a_file_that_is_no_spec_is_a_users_mistake_and_no_traceback(tmp_path, content, words):
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)
    assert words in refusal(path)


def test_aliases_that_explode_are_refused(tmp_path):
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 8)]
    path = tmp_path / "bombs.yaml"
    path.write_text("\n".join(lines))
    assert "holds too many values" in refusal(path)


def test_a_missing_file_suggests_its_neighbour(tmp_path):
    write(tmp_path / "threshold.yaml", BASE_SPEC)
    assert "does not exist; did you mean 'threshold.yaml'?" in refusal(tmp_path / "treshold.yaml")


def test_a_directory_is_refused(tmp_path):
    assert "is a directory" in refusal(tmp_path)


def test_a_key_given_twice_is_refused_with_both_lines(tmp_path):
    path = tmp_path / "twice.yaml"
    path.write_text(yaml.safe_dump(BASE_SPEC) + "seed: 1\n" + "seed: 2\n")
    number = path.read_text().count("\n")
    assert f"seed: is given twice, on lines {number - 1} and {number}" in refusal(path)


def test_numbers_mean_what_they_say_whatever_yaml_makes_of_them(tmp_path):
    text = yaml.safe_dump(changed_spec({"instrument.processing.tnr": 10}))
    for spelling, value in (("1e1", 10.0), ("010", 10.0), ("'1.5e+1'", 15.0), ("2^4", 16.0)):
        path = tmp_path / "numbers.yaml"
        path.write_text(text.replace("tnr: 10", f"tnr: {spelling}"))
        assert load(path).instrument.processing.tnr == value
    path.write_text(text.replace("tnr: 10", "tnr: 1:30"))
    assert "(you wrote '1:30'); write e.g. '10'" in refusal(path)


def instrument_file(tmp_path):
    folder = tmp_path / "instruments"
    folder.mkdir(exist_ok=True)
    return write(folder / "lidar.yaml", BASE_SPEC["instrument"])


def test_an_instrument_kept_in_a_file_is_the_same_study_as_one_written_out(tmp_path, monkeypatch):
    instrument_file(tmp_path)
    inline = write(tmp_path / "inline.yaml", BASE_SPEC)
    named = write(tmp_path / "named.yaml", BASE_SPEC | {"instrument": "instruments/lidar.yaml"})
    assert load(named).id == load(inline).id
    monkeypatch.setenv("HOME", str(tmp_path))
    at_home = BASE_SPEC | {"instrument": {"file": "~/instruments/lidar.yaml"}}
    assert load(write(tmp_path / "home.yaml", at_home)).id == load(inline).id
    assert load(named).to_yaml_mapping() == load(inline).to_yaml_mapping()


def test_an_instrument_is_overridden_field_by_field(tmp_path):
    instrument_file(tmp_path)
    reference = {"file": "instruments/lidar.yaml", "telescope": {"aperture": "50 mm"},
                 "processing": {"window": "hann"}}  # fmt: skip
    spec = load(write(tmp_path / "study.yaml", BASE_SPEC | {"instrument": reference}))
    expected = changed_spec(
        {"instrument.telescope.aperture": "50 mm", "instrument.processing.window": "hann"}
    )
    assert spec.id == GridSpec.from_mapping(expected).id


def test_a_mistake_in_the_instrument_file_names_that_file_and_its_line(tmp_path):
    file = instrument_file(tmp_path)
    file.write_text(file.read_text().replace("power: 1 W", "power: 1 V"))
    line = file.read_text().splitlines().index("  power: 1 V") + 1
    study = write(tmp_path / "study.yaml", BASE_SPEC | {"instrument": "instruments/lidar.yaml"})
    assert f"{file}:{line}: instrument.laser.power: needs a unit like W" in refusal(study)


def test_a_mistake_in_an_override_names_the_study(tmp_path):
    instrument_file(tmp_path)
    reference = {"file": "instruments/lidar.yaml", "laser": {"power": "1 V"}}
    study = write(tmp_path / "study.yaml", BASE_SPEC | {"instrument": reference})
    assert f"{study}:5: instrument.laser.power" in refusal(study)


@pytest.mark.parametrize(
    ("reference", "path", "words"),
    [
        ("instruments/lidr.yaml", "instrument", "did you mean 'lidar.yaml'?"),
        ({"file": "instruments"}, "instrument.file", "is a directory"),
        ({"file": 3}, "instrument.file", "must be the path of a YAML file"),
        (7, "instrument", "must be a mapping"),
    ],
)
def test_an_instrument_that_cannot_be_read_is_reported_once(tmp_path, reference, path, words):
    instrument_file(tmp_path)
    study = write(tmp_path / "study.yaml", BASE_SPEC | {"instrument": reference, "seed": -1})
    with pytest.raises(SpecError) as error_info:
        load(study)
    assert {mistake.path for mistake in error_info.value.mistakes} == {path, "seed"}
    assert words in str(error_info.value)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (f"seed: {'9' * 5000}", r"seed: must be .*you wrote '999"),
        (r'title: "\e[2Jred"', r"title: .*'\\x1b\[2Jred'.*can be printed"),
        (r'question: "a\u009bb"', r"question: .*can be printed"),
    ],
    ids=["digits", "title", "question"],
)
def test_endless_numbers_and_control_characters_are_refused_in_words(tmp_path, line, message):
    from sweep.spec import SpecError, load

    file = tmp_path / "odd.yaml"
    file.write_text(line)
    with pytest.raises(SpecError, match=message) as refusal:
        load(file)
    assert "\x1b" not in str(refusal.value) and "\x9b" not in str(refusal.value)


def test_an_endless_integer_of_pythons_is_refused_in_words():
    from sweep.spec import GridSpec, SpecError

    with pytest.raises(SpecError, match="seed: is a number of too many digits"):
        GridSpec.from_mapping({"seed": 10**5000})


TABLE = "instrument.chirp.error_table"


def test_a_table_of_the_chirps_error_is_the_same_in_a_spec_and_in_a_file_next_to_it(tmp_path):
    rows = [[f"{10 * k} us", f"{k * (50 - k)} Hz"] for k in range(51)]
    inline = GridSpec.from_mapping(changed_spec({TABLE: rows}))
    lines = [f"{10 * k},{k * (50 - k) / 1000!r}" for k in range(51)]
    (tmp_path / "error.csv").write_text("\n".join(["# measured", "time [us], error [kHz]", *lines]))
    named = load(write(tmp_path / "study.yaml", changed_spec({TABLE: "error.csv"})))
    instrument = changed_spec({TABLE: "error.csv"})["instrument"]
    write(tmp_path / "lidar.yaml", instrument)
    (tmp_path / "below").mkdir()
    sibling_spec = changed_spec() | {"instrument": "../lidar.yaml"}
    spec = load(write(tmp_path / "below" / "study.yaml", sibling_spec))
    values = [np.array([row.split() for row in s.parameters()[TABLE].split(",")], float)
              for s in (inline, named, spec)]  # fmt: skip
    np.testing.assert_allclose(values[1], values[0], rtol=1e-14, atol=1e-18)
    assert named.id == spec.id != GridSpec.from_mapping(changed_spec()).id
    restored = GridSpec.from_stored(named.to_json())
    assert restored == named and restored.id == named.id
    assert (
        GridSpec.from_mapping(changed_spec({TABLE: "none"})).id
        == GridSpec.from_mapping(changed_spec()).id
    )


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([[f"{10 * k} us", f"{(-1) ** k} Hz"] for k in range(51)], "is not smooth"),
        ([[f"{9 * k} us", f"{k} Hz"] for k in range(51)], "must cover the chirp"),
        ([["0 us", "0 Hz"], ["0 us", "1 Hz"], ["1 ms", "2 Hz"]], "do not rise"),
        ([["0 us", "0 Hz"], ["1 us"], ["1 ms", "2 Hz"]], "row 1"),
        ([["0 us", "0 Hz"], ["1 us", "1 m"], ["1 ms", "2 Hz"]], "1 m"),
        ("nowhere.csv", "does not exist"),
    ],
)
def test_a_table_that_cannot_stand_for_the_chirp_is_refused_in_words(rows, words):
    with pytest.raises(SpecError, match=words):
        GridSpec.from_mapping(changed_spec({TABLE: rows}))


def test_a_table_is_no_axis():
    with pytest.raises(SpecError, match="one table for a whole study"):
        GridSpec.from_mapping(changed_spec(axes={TABLE: ["none"]}))


def test_a_figure_without_a_name_is_saved_under_its_kind_once():
    table = FalseAlarmTable(kind="false_alarm_table", by="power")
    assert table.file_stem == "false_alarm_table"
