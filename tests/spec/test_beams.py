"""Beams in specs: given by one of two numbers, and such as an aperture can make."""

import pytest
from base_spec import changed_spec

from sweep.cli.terminal import print_spec_warnings
from sweep.spec import GridSpec, SpecError
from sweep.spec.grid_checks import describe_narrow_beam

MODE = {"instrument.telescope.coupling": "single_mode"}
WAIST = {"instrument.laser.beam_divergence": ...}
DIVERGENCE = "instrument.laser.beam_divergence"
WIDE = {DIVERGENCE: "100 urad"}
WRONG = [
    (WAIST, {}, DIVERGENCE, "must be given, or beam_waist in its place"),
    ({"instrument.laser.beam_waist": "5 mm"}, {}, "instrument.laser.beam_waist",
     "is given in addition to beam_divergence"),
    (MODE, {}, DIVERGENCE, "at least 78.9 urad, 4 M^2 lambda / (pi D)"),
    (MODE | WIDE | {"instrument.laser.beam_quality": 2}, {}, DIVERGENCE, "at least 158 urad"),
    (MODE, {DIVERGENCE: ["1 mrad", "78 urad"]}, f"axes.{DIVERGENCE}", "at least 78.9 urad"),
    (MODE | WIDE, {"instrument.telescope.aperture": ["10 mm", "25 mm"]}, DIVERGENCE,
     "at least 197 urad, 4 M^2 lambda / (pi D): no narrower beam leaves an aperture of 10 mm"),
    ({}, {"law": {"zip": {"instrument.telescope.coupling": ["single_mode", "aperture"],
                          DIVERGENCE: ["70 urad", "10 urad"]}}}, "axes.law", "at least 78.9 urad"),
    (MODE | WAIST | {"instrument.laser.beam_waist": "13 mm"}, {}, "instrument.laser.beam_waist",
     "at most 12.5 mm, the radius of the aperture"),
    (MODE | WIDE | {"instrument.receiver.local_oscillator_waist": "13 mm"}, {},
     "instrument.receiver.local_oscillator_waist", "at most 12.5 mm"),
    (WAIST | {"instrument.laser.beam_waist": "500 nm"}, {}, "instrument.laser.beam_waist",
     "at least 0.628 um, for the beam to spread by 90 deg at most"),
    ({"instrument.laser.focus": "0 m"}, {}, "instrument.laser.focus", "must be at least 1 mm"),
    ({"instrument.laser.focus": "-3 m"}, {}, "instrument.laser.focus", "must be at least 1 mm"),
    ({"instrument.laser.beam_quality": 0.9}, {}, "instrument.laser.beam_quality", "at least 1"),
    ({"instrument.telescope.coupling": "singlemode"}, {}, "instrument.telescope.coupling",
     "must be one of single_mode, aperture"),
    ({"instrument.telescope.scan_rate": "3 deg/s"}, {}, "instrument.telescope.scan_rate",
     "take a coherent receiver of coupling: single_mode"),
    (MODE | WIDE | {"instrument.telescope.misalignment": "3 urad",
                    "instrument.receiver.architecture": "direct"}, {},
     "instrument.telescope.misalignment", "take a coherent receiver"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "axes", "path", "words"), WRONG)
def test_a_beam_that_cannot_be_is_refused(changes, axes, path, words):
    with pytest.raises(SpecError) as error:
        GridSpec.from_mapping(changed_spec(changes, axes=axes))
    (mistake,) = error.value.mistakes
    assert mistake.path == path and words in str(mistake)


RIGHT = [
    MODE | WIDE,
    MODE | WAIST | {"instrument.laser.beam_waist": "12.5 mm", "instrument.laser.focus": "3 m"},
    MODE | {"instrument.receiver.architecture": "direct"},  # which has no mode
    WAIST | {"instrument.laser.beam_waist": "13 mm"},
]


@pytest.mark.parametrize("changes", RIGHT)
def test_a_beam_that_can_be_is_read_and_comes_back(changes):
    spec = GridSpec.from_mapping(changed_spec(changes))
    assert GridSpec.from_stored(spec.to_json()).parameters() == spec.parameters()


def test_one_mode_is_the_default():
    with pytest.raises(SpecError, match=r"4 M.2 lambda"):
        GridSpec.from_mapping(changed_spec({"instrument.telescope.coupling": ...}))


@pytest.mark.parametrize("changes", [{}, MODE | {"instrument.receiver.architecture": "direct"}])
def test_a_beam_narrower_than_its_aperture_makes_is_reported_where_all_light_mixes(changes, capsys):
    """Table 4.1: 50 urad from 25 mm, which make 79 urad."""
    print_spec_warnings(GridSpec.from_mapping(changed_spec(changes)))
    captured = capsys.readouterr()
    assert (
        not captured.out
        and "a beam of 50 urad is narrower than an aperture of 25 mm" in captured.err
    )
    assert "78.9 urad" in captured.err
    wide = GridSpec.from_mapping(changed_spec(changes | WIDE))
    assert not describe_narrow_beam(wide.parameters_off_axes(), wide.axes)
