"""Wrong inputs as new users write them: each is told with its field, rule, value and remedy."""

import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

import sweep
from sweep.cli import main
from sweep.spec import GridSpec, SpecError, load

GOOD = """\
title: My lidar
instrument: {like: chester_2017_table_4_1}
target: {range: 2 km, grazing_angle: 30 deg, reflectance: 0.1}
axes:
  instrument.laser.power: [1 W, 2 W]
"""

SPECS = [
    # YAML
    ("  instrument", "\tinstrument", ":5: is no valid YAML: ", "indent with blanks, not with tabs"),
    ("title: My", "title:My", ":2: is no valid YAML: ", "put a blank after each colon"),
    ("My lidar", "My lidar: a test", ":1: is no valid YAML: ", "quotes around text that holds"),
    ("My lidar", "@home", ":1: is no valid YAML: ", "put quotes around the text"),
    ("My lidar", '"My lidar', "(in what begins on line 1)", "close the quotes of the text"),
    ("[1 W, 2 W]", "[1 W, 2 W", "(in what begins on line 5)", "look at the brackets"),
    ("2 km", "*far", ":3: is no valid YAML: found undefined alias 'far'", "define it above"),
    ("axes:", "---\naxes:", ":4: is no valid YAML: ", "keep one of them"),
    ("title: My lidar", "title: a\ntitle: b", ":1: title: is given twice, on lines 1 and 2",
     "keep one"),
    ("2 km", "!!python/name:os.system x", ":3: target.range: has the tag", "leave it out"),
    # units and numbers
    ("2 km", "2 kg", ":3: target.range: needs a unit like m, and 'kg' is none (you wrote '2 kg')",
     "write e.g. '2 km'"),
    ("2 km", "2 KM", ":3: target.range: has an unknown unit 'KM'", "did you mean 'km'?"),
    ("2 km", "2", ":3: target.range: needs a unit (you wrote 2)", "write e.g. '2 km'"),
    ("2 km", "'2,5 km'", "target.range: has a number that is grouped, or has a comma",
     "write '2.5 km'"),
    ("2 km", "2,5 km", ":3: target.5 km: is no field", "write numbers with a point, such as 2.5"),
    ("2 km", "1-2 km", "range: must be a number with a unit (you wrote '1-2 km')",
     "write e.g. '2 km'"),
    ("2 km", "\u22122 km", "target.range: must be at least 1 nm", "write e.g. '2 km'"),
    ("2 km", ".inf", "target.range: must be a finite number (you wrote '.inf')", "write e.g."),
    ("2 km", "", "range: must be a number with a unit (you wrote nothing)", "write e.g. '2 km'"),
    ("2 km", "[1 km, 2 km]", "target.range: takes one value",
     "put several under axes: 'target.range: [...]'"),
    ("2 km", "{linear: [1 km, 2 km], number: 5}", "target.range: takes one value",
     "under axes: 'target.range: {linear: [...], number: ...}'"),
    ("30 deg", "120 deg", "target.grazing_angle: must be at most 90 deg (you wrote '120 deg')", ""),
    ("0.1", "-0.1", "target.reflectance: must be at least 0 (you wrote -0.1)", "write e.g. '0.1'"),
    ("0.1", "-10 dB", "target.reflectance: is a pure number and takes no unit: fraction of light",
     "write 0.1 for a ratio of powers"),
    ("0.1", "0x1", "target.reflectance: is a pure number", "write e.g. '0.1'"),
    ("0.1", "yes", "target.reflectance: must be a number (you wrote True)", "write e.g. '0.1'"),
    # names and nesting
    ("target:", "targt:", ":3: targt: is no field", "did you mean 'target'?"),
    ("target:", "Target:", ":3: Target: is no field", "did you mean 'target'?"),
    ("grazing_angle", "grazing-angle", "target.grazing-angle: is no field", "'grazing_angle'?"),
    ("target: {range: 2 km, ", "range: 2 km\ntarget: {", ":3: range: is no field",
     "did you mean 'target.range'?"),
    ("target: {range: 2 km, ", "target.range: 2 km\ntarget: {", ":3: target.range: is no field",
     "write 'range: ...' in the section 'target'"),
    ("instrument: {like", "instruments: {like", ":1: instrument: is missing",
     "write e.g. 'instrument: {like: settembrini_2026}'"),
    ("chester_2017_table_4_1", "chester", "instrument.like: is no instrument of the library (you ",
     "did you mean 'chester_2017_table_4_1' or 'chester_2017_table_5_1'?"),
    ("like: chester_2017_table_4_1", "file: mine.yaml", "instrument.file: names a file that does ",
     "check the path"),
    ("like: chester_2017_table_4_1", "like: rogers_2021, file: a.yaml", "names another instrument",
     "keep one of them"),
    ("table_4_1}", "table_4_1, power: 1 W}", "instrument.power: is no field",
     "did you mean 'instrument.laser.power'?"),
    # axes
    ("[1 W, 2 W]", "[]", ":5: axes.instrument.laser.power: holds no value", "list at least one"),
    ("[1 W, 2 W]", "", "must be a list or a generator (you wrote nothing)", "write e.g. [1 W] or"),
    ("[1 W, 2 W]", "1 W, 2 W", "must be a list or a generator (you", "write e.g. [1 W, 2 W]"),
    ("[1 W, 2 W]", "[1, 2]", "axes.instrument.laser.power[0]: needs a unit (you wrote 1)", "'1 W'"),
    ("[1 W, 2 W]", "{linspace: [1 W, 2 W, 5]}", "exactly one of linear, log and step", "'linear'?"),
    ("[1 W, 2 W]", "{values: [1 W, 2 W]}", "exactly one of linear, log and step",
     "without 'values:'"),
    ("[1 W, 2 W]", "{linear: [1 W, 2 W], number: 0}", ".number: must be at least 2 (you wrote 0)",
     "write e.g. '10'"),
    ("instrument.laser.power:", "power:", "axes.power: is no parameter",
     "did you mean 'instrument.laser.power'?"),
    ("  instrument.laser.power: [1 W, 2 W]", "  instrument: {laser: {power: [1 W]}}",
     "axes.instrument: is a section", "write 'instrument.laser.power: [...]'"),
    ("  instrument.laser.power: [1 W, 2 W]\n", "", ":4: axes: must be a mapping",
     "or leave it out"),
    # other sections
    ("axes:", "effects: {leakage: none}\naxes:", "(you wrote 'none')", "write 'off'"),
    ("axes:", "effects: [leakage]\naxes:", ":4: effects: must be a mapping of fields", "write "),
    ("axes:", "draws: many\naxes:", ":4: draws: must be a mapping", "write 'draws:' with number"),
    ("axes:", "seed: abc\naxes:", ":4: seed: must be a number (you wrote 'abc')", "write e.g."),
    ("axes:", "figures: surface\naxes:", "figures: must be a list (you wrote 'surface')",
     "put it in brackets"),
    ("axes:", "figures: [surface]\naxes:", "figures[0]: must be a mapping",
     "with kind: and one of"),
    ("axes:", "figures: [{kind: slices, variable: pd, x: power}]\naxes:",
     "figures[0].variable: is no stored quantity (you wrote 'pd')", "write e.g. 'pd_shot'"),
    ("My lidar", "[a, b]", ":1: title: must be text", "write it as one text"),
    (GOOD, "", "holds nothing", "write e.g. 'title: A study'"),
    (GOOD, "- a\n- b\n", "must hold a mapping", "write e.g. 'title: A study'"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "rule", "remedy"), SPECS)
def test_a_wrong_spec_is_reported_with_line_field_rule_value_and_remedy(
    tmp_path, old, new, rule, remedy
):
    assert old in GOOD
    file = tmp_path / "a.yaml"
    file.write_text(GOOD.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(SpecError) as error_info:
        load(file)
    (mistake,) = (str(m) for m in error_info.value.mistakes if rule in str(m))
    assert remedy in mistake.partition("; ")[2]


@pytest.mark.parametrize(
    "content",
    [
        GOOD.replace("\n", "\r\n").encode(),
        GOOD.encode("utf-8-sig"),
        GOOD.replace("0.1", "'1e-1'").encode(),
        GOOD.replace("0.1", "10 %").encode(),
        GOOD.replace("2 km", "\uff12\u00a0km").encode(),
        GOOD.replace("2 km", "2e3m").encode(),
        GOOD.replace("[1 W, 2 W]", "[30 dBm, 2000 mW]").encode(),
    ],
)
def test_spellings_that_mean_the_same_are_the_same_study(tmp_path, content):
    (tmp_path / "a.yaml").write_bytes(content)
    (tmp_path / "good.yaml").write_text(GOOD)
    assert load(tmp_path / "a.yaml").id == load(tmp_path / "good.yaml").id


@pytest.fixture
def working_directory(tmp_path, monkeypatch):
    """Directory with a spec, an empty directory, a file of text and a store of another program."""
    monkeypatch.chdir(tmp_path)
    Path("good.yaml").write_text(GOOD)
    Path("empty").mkdir()
    Path("plots").mkdir()
    for name in ("a.png", "b.png"):
        Path("plots", name).touch()
    Path("file.txt").write_text("hello")
    Path("foreign.zarr").mkdir()
    group = '{"zarr_format": 3, "node_type": "group", "attributes": {}}'
    Path("foreign.zarr/zarr.json").write_text(group)
    return tmp_path


COMMANDS = [
    ("run", "Missing argument 'SPEC'"),
    ("run good.yml", "File 'good.yml' does not exist; did you mean 'good.yaml'?"),
    ("run nothing.yaml", "File 'nothing.yaml' does not exist; there is: good.yaml"),
    ("run no/where.yaml", "does not exist: there is no folder 'no'"),
    ("run foreign.zarr", "is a store, and a file is needed: sweep resume foreign.zarr goes on"),
    ("run empty", "is a directory"),
    ("run file.txt", "must hold a mapping of fields to values; write e.g. 'title: A study'"),
    ("run good.yaml --workers 0", "0 is not in the range x>=1"),
    (
        "run good.yaml --scheduler localhost",
        "is no address of a Dask scheduler: write e.g. 'tcp://",
    ),
    ("run good.yaml --cluster nofile.yaml", "does not exist; there is: good.yaml"),
    ("run good.yaml --cluster good.yaml", "lacks its kind; write kind: and one of local"),
    ("run good.yaml --store http://a/b.zarr", "is no place for a store: write a path, or s3://"),
    ("run good.yaml --store file.txt", "is a file, and no Zarr store of sweep's"),
    ("run good.yaml --allow-code mine.py", "is no name of a Python module"),
    ("run good.yaml --allow-code mine:detect", "before the colon; write 'mine'"),
    ("run good.yaml --dashboard --scheduler none", "a plain loop has no dashboard: leave out --d"),
    ("rnu good.yaml", "Did you mean 'run'?"),
    ("run good.yaml --overwrit", "Did you mean '--overwrite'?"),
    ("status good.yaml", "is a file, and no Zarr store of sweep's: `sweep run SPEC --store STORE`"),
    ("status empty", "is not a Zarr store of sweep's: `sweep run SPEC --store STORE` computes"),
    ("run good.yaml --store plots", "has files in it (a.png, b.png): name another place, as"),
    ("status plots", "is not a Zarr store of sweep's, and has files in it (a.png, b.png)"),
    ("status foreign.zarr", "is a Zarr store, but not one that sweep made"),
    ("status nothing.zarr", "there is no store at nothing.zarr; stores near it: foreign.zarr"),
    ("shot good.yaml --at range", "'range' is not NAME=VALUE, as in range=2km"),
    ("shot good.yaml --at range=5", "range: needs a unit (you wrote '5'); write e.g. '2 km'"),
    ("shot good.yaml --at rnge=5km", "rnge: is no parameter; did you mean 'target.range'?"),
    ("shot good.yaml --at power=1W --at power=2W", "'power' is given twice"),
    ("instruments chester", "did you mean 'chester_2017_table_4_1' or 'chester_2017_table_5_1'?"),
]


@pytest.mark.parametrize(("command", "words"), COMMANDS)
def test_a_wrong_command_ends_in_words_and_changes_nothing(working_directory, command, words):
    before = sorted(Path().rglob("*"))
    result = CliRunner().invoke(main, command.split(), catch_exceptions=False)
    assert result.exit_code == 2, result.output
    assert words in " ".join(result.output.split()), result.output
    assert sorted(Path().rglob("*")) == before


def good():
    return load("good.yaml")


CALLS = [
    (lambda: sweep.load(None), "loaded from the path of a YAML file, not from a NoneType"),
    (
        lambda: sweep.load({"title": "x"}),
        "not from a dict; `sweep.spec.GridSpec.from_mapping(...)`",
    ),
    (lambda: sweep.load("god.yaml"), "god.yaml: does not exist; did you mean 'good.yaml'?"),
    (lambda: sweep.run("good.yaml", store="a.zarr"), "not a str: give `sweep.load('good.yaml')`"),
    (lambda: sweep.run({}, store="a.zarr"), "a study is needed, not a dict"),
    (lambda: sweep.run(good(), store=None), "a store is named by its path, such as 'study.zarr'"),
    (lambda: sweep.run(good(), store="a.zarr", worker=3), "'worker'; did you mean 'workers'?"),
    (lambda: sweep.run(good(), store="a.zarr", workers="4"), "a whole number above 0, not '4'"),
    (lambda: sweep.run(good(), store="a.zarr", workers=0), "a whole number above 0, not 0"),
    (lambda: sweep.run(good(), store="a.zarr", scheduler="here"), "is no address of a Dask sched"),
    (lambda: sweep.run(good(), store="a.zarr", block_timeout="1 s"), "a number of seconds above 0"),
    (lambda: sweep.run(good(), store="a.zarr", allow_code="mine.py"), "write 'mine'"),
    (lambda: sweep.resume("nothing.zarr"), "there is no store at"),
    (lambda: sweep.resume("foreign.zarr", spec="good.yaml"), "give `sweep.load('good.yaml')`"),
    (lambda: sweep.extend("foreign.zarr", "good.yaml"), "give `sweep.load('good.yaml')`"),
    (lambda: sweep.open(None), "and not by a NoneType"),
    (lambda: sweep.open(good()), "and not by a GridSpec"),
    (lambda: sweep.open("good.yaml"), "`sweep.run(spec, store=store)` computes a spec into one"),
    (lambda: sweep.open("empty"), "`sweep.run(spec, store=store)` computes a spec into one"),
    (lambda: GridSpec.from_mapping("title"), "must be a mapping (you wrote 'title')"),
]


@pytest.mark.parametrize(("call", "words"), CALLS)
def test_a_wrong_call_ends_in_words_and_changes_nothing(working_directory, call, words):
    before = sorted(Path().rglob("*"))
    with pytest.raises(
        (TypeError, ValueError, SpecError, sweep.tasks.engine.progress.RunRequestError)
    ) as error_info:
        call()
    assert words in str(error_info.value)
    assert sorted(Path().rglob("*")) == before


def test_the_good_spec_is_good(working_directory):
    shutil.rmtree("foreign.zarr")
    assert good().axes[0].size == 2
