"""What the command warns of before a run is a warning of Python's in a program."""

import io
import re
import sys
import warnings
from types import SimpleNamespace

import pytest
import yaml
from click.testing import CliRunner
from small_flights import SCENE_MAPPING, small_scene_spec
from small_studies import STUDY_MAPPING, small_mapping, small_spec

import sweep
from sweep.cli import main
from sweep.tasks.engine.progress import Progress

LATE = {"axes": {"target.range": ["1 km", "20 km"]}}
OFF = {"effects": {"doppler": "off"}, "axes": {"target.range": ["1 km", "2 km"]}}
NARROW = {
    "axes": {"target.range": ["1 km"]},
    "instrument": STUDY_MAPPING["instrument"]
    | {"telescope": {"aperture": "10 mm", "coupling": "aperture"}},
}
NOISY = {
    "axes": {"target.range": ["1 km"]},
    "instrument": STUDY_MAPPING["instrument"]
    | {"processing": STUDY_MAPPING["instrument"]["processing"] | {"tnr": 5}},
}
BY_PHASE = {
    "axes": {"target.range": ["1 km", "3.5 km"]},
    "draws": {"method": "spectra", "number": 2},
    "instrument": STUDY_MAPPING["instrument"]
    | {
        "processing": STUDY_MAPPING["instrument"]["processing"]
        | {"tnr": 10, "estimator": {"kind": "candan"}}
    },
}
PATH_OUTSIDE_THE_SCENE = {
    "platform": {
        "path": SCENE_MAPPING["platform"]["path"] | {"to": ["6 km", "0 m", "300 m"]},
        "attitude": {"kind": "nadir"},
    }
}


def show(message, category, filename, lineno, file=None, line=None):
    """Write a warning to standard error, as Python does and pytest does not."""
    sys.stderr.write(warnings.formatwarning(message, category, filename, lineno, line))


def warned(spec, path):
    """Texts of the warnings of a run, and the files that they are told at."""
    with warnings.catch_warnings(record=True) as caught_warnings:
        warnings.simplefilter("always")
        assert sweep.run(spec, store=path, scheduler="none", progress=False).complete
    study_warnings = [
        warning for warning in caught_warnings if warning.category is sweep.StudyWarning
    ]
    return [str(warning.message) for warning in study_warnings], {
        warning.filename for warning in study_warnings
    }


@pytest.mark.parametrize(
    ("spec", "pattern"),
    [
        (small_spec(**LATE), "no echo arrives before its record ends"),
        (small_spec(**OFF), "doppler"),
        (small_spec(**NARROW), "is narrower than an aperture of 10 mm"),
        (small_spec(**NOISY), r"raises a false alarm in either chirp .*: raise instrument.*tnr"),
        (small_scene_spec(instrument=NOISY["instrument"]), "raises a false alarm in either chirp"),
        (
            small_spec(**BY_PHASE),
            "estimator.kind candan takes .* at 100 % of the points, at all",
        ),
        (small_scene_spec(**PATH_OUTSIDE_THE_SCENE), "of the shots hit something"),
    ],
)
def test_a_questionable_study_warns_at_the_line_of_the_program(spec, pattern, tmp_path):
    texts, files = warned(spec, tmp_path / "s.zarr")
    assert any(re.search(pattern, text) for text in texts), texts
    assert files == {__file__}


@pytest.mark.parametrize("changes", [LATE, NOISY])
def test_program_and_command_warn_in_the_same_words(changes, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "late.yaml").write_text(yaml.safe_dump(small_mapping(**changes)))
    texts, _ = warned(sweep.load("late.yaml"), tmp_path / "s.zarr")
    with warnings.catch_warnings():
        warnings.simplefilter("error", sweep.StudyWarning)  # the command prints, once
        result = CliRunner().invoke(main, ["run", "late.yaml", "--scheduler", "none"])
    assert result.exit_code == 0 and len(texts) >= 2
    for text in texts:
        assert result.stderr.count(text) == 1


def test_an_extension_warns_in_a_program_and_in_the_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    near = small_spec(axes={"target.range": ["100 m"]})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", sweep.StudyWarning)
        sweep.run(near, store="s.zarr", scheduler="none", progress=False)
    far = {"axes.target.range": ["100 m", "20 km"]}
    with pytest.warns(sweep.StudyWarning, match="no echo arrives") as caught_warnings:
        sweep.extend("s.zarr", changes=far, to="t.zarr", scheduler="none", progress=False)
    assert {warning.filename for warning in caught_warnings} == {__file__}
    command = ["extend", "s.zarr", "--set", "axes.target.range=['100 m', '20 km']"]
    result = CliRunner().invoke(main, [*command, "--scheduler", "none"])
    assert result.exit_code == 0 and result.stderr.count("warning: no echo arrives") == 1


class WarningProgress(Progress):
    """Progress that keeps what is said."""

    def __init__(self):
        self.said = []

    def say(self, text):
        self.said.append(text)


def test_what_a_flight_leaves_unstated_is_noted_in_a_program_too(tmp_path):
    spec, progress = small_scene_spec(), WarningProgress()
    sentences = spec.unstated_error_sentences()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", sweep.StudyWarning)
        sweep.run(spec, store=tmp_path / "s.zarr", scheduler="none", progress=progress)
    assert sentences and all(f"note: {sentence}" in progress.said for sentence in sentences)


def test_a_warning_made_an_error_stops_a_run_before_its_store_is_made(tmp_path):
    with warnings.catch_warnings(), pytest.raises(sweep.StudyWarning):
        warnings.simplefilter("error")
        sweep.run(small_spec(**LATE), store=tmp_path / "s.zarr", scheduler="none", progress=False)
    assert not (tmp_path / "s.zarr").exists()


def closed():
    stream = io.StringIO()
    stream.close()
    return stream


def failing(*args, **kwargs):
    raise RuntimeError("no")


@pytest.mark.parametrize(
    "stream",
    [closed(), SimpleNamespace(write=failing), object(), None],
    ids=["closed", "fails", "no stream", "none"],
)
def test_a_warning_that_nobody_can_read_ends_no_run(stream, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.stderr", stream)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = show
        outcome = sweep.run(
            small_spec(**LATE), store=tmp_path / "s.zarr", scheduler="none", progress=False
        )
    assert outcome.complete


def test_a_sound_study_does_not_warn(tmp_path):
    laser = STUDY_MAPPING["instrument"]["laser"] | {"beam_divergence": "100 urad"}
    processing = STUDY_MAPPING["instrument"]["processing"] | {"tnr": 10}
    instrument = STUDY_MAPPING["instrument"] | {"laser": laser, "processing": processing}
    spec = small_spec(axes={"target.range": ["100 m"]}, effects={}, instrument=instrument)
    assert warned(spec, tmp_path / "s.zarr") == ([], set())
