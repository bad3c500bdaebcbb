"""Instruments of the library: what specs make of them, and the numbers published of them."""

import json
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

import sweep
from sweep.cli import main
from sweep.spec import GridSpec, SpecError, load
from sweep.spec.yaml_document import library_instrument_files, read_document

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

import instruments_page as page  # noqa: E402

NAMES = list(library_instrument_files())
DRAWS = 100
"""Shots at each of 64 places: some 300 are detected, and a deviation is known to 6 %."""


def spec(instrument, **sections):
    target = {"range": "20 m", "grazing_angle": "60 deg", "reflectance": 0.1}
    return GridSpec.from_mapping({"title": "A study", "instrument": instrument, "target": target,
                              **sections})  # fmt: skip


def refusal(instrument):
    with pytest.raises(SpecError) as refused:
        spec(instrument)
    return str(refused.value)


@pytest.mark.parametrize("name", NAMES)
def test_an_instrument_has_its_published_numbers_and_the_page_has_those_that_are_simulated(name):
    """But for two deviations, which it draws of four times as many shots, and what rounds to 0."""
    simulated, numbers = page.simulate_numbers(name, DRAWS), page.instrument_file(name)["numbers"]
    assert set(simulated) == set(numbers)
    for key, number in numbers.items():
        assert page.is_within_allowed(number, simulated[key]), (key, number, simulated[key])
    text = (ROOT / "docs" / "instruments.md").read_text()
    part = text.split(f"\n## {name}\n")[1].split("\n## ")[0]
    for key, number in numbers.items():
        row = next(line for line in part.splitlines() if line.startswith(f"| {number['about']} |"))
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        assert cells[4] == "yes"
        if key not in ("sigma_range", "sigma_velocity", "pd_of_snr"):
            assert cells[2].split()[0] == f"{simulated[key]:.3g}"
    for assumption in page.instrument_file(name)["assumed"]:
        assert f"- {assumption}" in part


@pytest.mark.parametrize("name", NAMES)
def test_a_name_and_all_that_it_stands_for_are_one_study(name):
    """The same id, and in a store nothing that would need the library."""
    named = spec(name)
    assert named.id == spec(page.instrument_file(name)["instrument"]).id == spec({"like": name}).id
    stored = json.loads(named.to_json())["instrument"]
    assert "like" not in stored
    assert set(stored) == {
        "laser", "chirp", "telescope", "receiver", "processing", "looks",
    }  # fmt: skip
    assert GridSpec.from_stored(named.to_json()).id == named.id


def test_the_tables_of_the_thesis_are_those_of_its_experiments():
    for table in ("table_4_1", "table_5_1"):
        file = ROOT / "experiments" / "instruments" / f"{table}.yaml"
        assert spec(f"chester_2017_{table}").id == spec(str(file)).id


def test_fields_set_again_take_the_place_of_the_librarys(tmp_path):
    overrides = {"like": "settembrini_2026", "laser": {"power": "1 mW"}, "processing": {"tnr": 10}}
    one = spec(overrides)
    assert (one.instrument.laser.power, one.instrument.laser.wavelength) == (1e-3, 1310e-9)
    assert (one.instrument.processing.tnr, one.instrument.processing.threshold_to_mean) == (
        10,
        None,
    )
    file = tmp_path / "study.yaml"
    file.write_text(yaml.safe_dump(one.to_yaml_mapping()))
    assert load(file).id == one.id
    file.write_text(yaml.safe_dump({
        "title": "A study", "instrument": overrides | {"laser": {"power": "1 V"}}, "target": {},
    }))  # fmt: skip
    with pytest.raises(SpecError, match=re.escape(f"{file}:3: instrument.laser.power: needs a")):
        load(file)


def test_a_store_holds_the_instrument_in_whole(tmp_path):
    sweep.run(spec("rogers_2021"), store=tmp_path / "a.zarr", scheduler="none", progress=False)
    stored = json.loads(sweep.open(tmp_path / "a.zarr").attrs["spec"])
    assert stored["instrument"]["laser"]["power"] == "4 mW"
    assert stored["instrument"]["receiver"]["excess_noise_factor"] == 1


def test_a_file_of_the_same_name_is_named_by_its_path(tmp_path):
    library_instrument = read_document(library_instrument_files()["rogers_2021"]).content[
        "instrument"
    ]
    library_instrument["laser"]["power"] = "5 mW"
    study = {"title": "A study", "target": {"range": "20 m", "grazing_angle": "60 deg",
                                            "reflectance": 0.1}}  # fmt: skip
    for name in ("rogers_2021", "mine"):
        (tmp_path / name).write_text(yaml.safe_dump(library_instrument))
    for name_or_path, power in (("rogers_2021", 4e-3), ("./rogers_2021", 5e-3), ("mine", 5e-3)):
        spec = GridSpec.from_mapping(study | {"instrument": name_or_path}, base=tmp_path)
        assert spec.instrument.laser.power == power


def test_an_unknown_name_is_refused_with_the_known_names():
    for reference, path in (("setembrini_2026", ""), ({"like": "Settembrini_2026"}, ".like")):
        messages = refusal(reference)
        assert messages.startswith(f"instrument{path}: is no instrument of the library")
        assert "did you mean 'settembrini_2026'?" in messages
    messages = refusal("no_such_thing_at_all")
    assert "did you mean" not in messages and all(name in messages for name in NAMES)
    assert "must be the name of an instrument" in refusal({"like": 3})
    message = refusal({"like": "rogers_2021", "file": "a.yaml"})
    assert "instrument.file: names another instrument, besides instrument.like" in message
    assert "is no field" in refusal({"like": "rogers_2021", "path": "a.yaml"})


def test_the_command_lists_the_library_and_tells_of_each(tmp_path):
    listed = CliRunner().invoke(main, ["instruments"])
    assert [line.split()[0] for line in listed.output.splitlines()] == NAMES
    for name in NAMES:
        output = CliRunner().invoke(main, ["instruments", name]).output
        instrument = page.instrument_file(name)
        assert instrument["source"] in output and instrument["doi"] in output
        assert yaml.safe_load(output[output.index("\ninstrument:") :])["instrument"].keys() == (
            instrument["instrument"].keys()
        )
        file = tmp_path / "own.yaml"
        file.write_text(output)
        assert read_document(file).content["instrument"] == instrument["instrument"]
        assert spec({"file": str(file)}).id == spec(name).id
    wrong = CliRunner().invoke(main, ["instruments", "rogers"])
    assert wrong.exit_code == 2 and "did you mean 'rogers_2021'?" in wrong.output


def test_a_beat_of_n_photoelectrons_has_an_snr_of_n():
    """Photoelectrons counted at random on a balanced pair, of an echo of 30 in all.

    Noise alone stands in other bins; |X|^2 on the bin has a mean of (1 + N) and a variance of
    (1 + 2 N) of theirs. 2 N would be 60.
    """
    rng, samples, trials, signal, bin_ = np.random.default_rng(1), 128, 20_000, 30.0, 20
    oscillator, echo = 400.0, signal / samples  # photoelectrons in a sample
    beat = np.sqrt(oscillator * echo) * np.cos(2 * np.pi * bin_ * np.arange(samples) / samples)
    pair = [(oscillator + echo) / 2 + sign * beat for sign in (1, -1)]
    one, other = (rng.poisson(rate, (trials, samples)) for rate in pair)
    power = (np.abs(np.fft.rfft(one - other, axis=1)) ** 2).mean(axis=0)
    noise = np.delete(power, [0, bin_, samples // 2]).mean()
    error = math.sqrt((1 + 2 * signal) / trials) + (1 + signal) / math.sqrt(60 * trials)
    assert abs(power[bin_] / noise - 1 - signal) < 5 * error
    # The simulator's SNR of as many, in the middle of bin 40, noise folded in by less than 1e-4
    slow = {"amplifier_noise_current": "0 A", "detector_bandwidth": "8 MHz",
            "amplifier_bandwidth": "8 MHz"}  # fmt: skip
    place = 40 * page.SPEED_OF_LIGHT / (2 * 6e9)
    study = page.spec_before_target(
        {"like": "settembrini_2026", "receiver": slow},
        {"range": f"{place!r} m", "reflectance": 0.05},
    )
    square = 3.768e-3**2 * (
        (1 - place / 12.626) ** 2 + (place * 1310e-9 / np.pi / 3.768e-3**2) ** 2
    )
    light = 178e-6 * 0.23 * 0.05 / np.pi * 1310e-9**2 / (np.pi * square)
    electrons = 0.95 * light * 32e-6 / 1.602176634e-19
    assert float(page.run_study(study).snr_up) == pytest.approx(electrons, rel=1e-3)


def test_draws_of_noise_follow_settembrinis_law():
    number = 4000
    axes = {"instrument.laser.power": {"log": ["100 uW", "10 mW"], "number": 5}}
    draws = {"method": "noise", "number": number}
    outputs = page.run_study(
        page.spec_before_target("settembrini_2026", page.WALL_TARGET, axes=axes, draws=draws)
    )
    law = np.exp(-4 * np.pi / (1 + outputs.snr_up))
    error = np.sqrt(law * (1 - law) / number)
    assert (abs(outputs.n_detected_up / number - law) < 5 * error).all()
    assert 0.03 < float(law[0]) < 0.1 and float(law[-1]) > 0.9
