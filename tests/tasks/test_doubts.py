"""What the command warns of before a run is a warning of Python's in a program."""

import warnings

import pytest
import yaml
from click.testing import CliRunner
from small import STUDY, small, small_file
from small_flights import SCENE, small_scene

import sweep
from sweep.cli import main

LATE = {"axes": {"target.range": ["1 km", "20 km"]}}
OFF = {"effects": {"doppler": "off"}, "axes": {"target.range": ["1 km", "2 km"]}}
NARROW = {
    "axes": {"target.range": ["1 km"]},
    "instrument": STUDY["instrument"]
    | {"telescope": {"aperture": "10 mm", "coupling": "aperture"}},
}
WAYWARD = {
    "platform": {
        "path": SCENE["platform"]["path"] | {"to": ["6 km", "0 m", "300 m"]},
        "attitude": {"kind": "nadir"},
    }
}


def warned(spec, path):
    """Texts of the warnings of a run, and the files that they are told at."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert sweep.run(spec, store=path, scheduler="none", progress=False).complete
    ours = [each for each in caught if each.category is sweep.StudyWarning]
    return [str(each.message) for each in ours], {each.filename for each in ours}


@pytest.mark.parametrize(
    ("spec", "told"),
    [
        (small(**LATE), "no echo arrives before its record ends"),
        (small(**OFF), "doppler"),
        (small(**NARROW), "is narrower than an aperture of 10 mm"),
        (small_scene(**WAYWARD), "of the shots hit something"),
    ],
)
def test_a_doubtful_study_warns_at_the_line_of_the_program(spec, told, tmp_path):
    texts, files = warned(spec, tmp_path / "s.zarr")
    assert any(told in text for text in texts), texts
    assert files == {__file__}


def test_program_and_command_warn_in_the_same_words(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "late.yaml").write_text(yaml.safe_dump(small_file(**LATE)))
    texts, _ = warned(sweep.load("late.yaml"), tmp_path / "s.zarr")
    with warnings.catch_warnings():
        warnings.simplefilter("error", sweep.StudyWarning)  # the command prints, once
        done = CliRunner().invoke(main, ["run", "late.yaml", "--scheduler", "none"])
    assert done.exit_code == 0 and len(texts) >= 2
    for text in texts:
        assert done.stderr.count(text) == 1


def test_a_warning_made_an_error_stops_a_run_before_its_store_is_made(tmp_path):
    with warnings.catch_warnings(), pytest.raises(sweep.StudyWarning):
        warnings.simplefilter("error")
        sweep.run(small(**LATE), store=tmp_path / "s.zarr", scheduler="none", progress=False)
    assert not (tmp_path / "s.zarr").exists()


def test_a_study_without_doubts_does_not_warn(tmp_path):
    spec = small(axes={"target.range": ["100 m"]}, effects={})
    texts, _ = warned(spec, tmp_path / "s.zarr")
    assert not [text for text in texts if "narrower" not in text]
