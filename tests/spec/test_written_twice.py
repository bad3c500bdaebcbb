"""Fields that a file gives in a section and on an axis: fine where both agree, else refused."""

import pytest

import sweep
from sweep.spec import SpecError

TEXT = """\
title: Twice
instrument:
  like: chester_2017_table_4_1
  {instrument}
target:
  {target}
  reflectance: 0.1
  radial_velocity: 150 m/s
axes:
  {axes}
"""
ANGLE = "grazing_angle: 20 deg"


@pytest.mark.parametrize(
    ("target", "instrument", "axes", "mistaken_path"),
    [
        ("{range: 2 km}", "", "target.range: [1 km, 3 km]", "target.range"),
        ("{range: 1.5 km}", "", "target.range: {step: [1 km, 3 km, 1 km]}", "target.range"),
        ("", "laser: {power: 2 W}", "instrument.laser.power: [1 W, 3 W]", "instrument.laser.power"),
        ("", "processing: {window: hann}",
         "instrument.processing.window: [hamming, rectangular]", "instrument.processing.window"),
        ("{range: 2 km}", "",
         "cut: {zip: {target.range: [1 km, 3 km], instrument.laser.power: [1 W, 3 W]}}",
         "target.range"),
        ("{range: 3000 m}", "", "target.range: [1 km, 3 km]", ""),
        ("", "laser: {power: 1000 mW}", "instrument.laser.power: [1 W, 3 W]", ""),
        # of the library: it has a power of 1 W
        ("", "", "instrument.laser.power: [2 W, 3 W]", ""),
    ],
)  # fmt: skip
def test_a_value_that_its_axis_lacks_is_refused(tmp_path, target, instrument, axes, mistaken_path):
    fixed = target.strip("{}") or "range: 2 km"
    if "target.range" in axes and not target:
        fixed = ANGLE
    text = TEXT.format(
        instrument=instrument or "telescope: {aperture: 25 mm}",
        target=f"{fixed}\n  {ANGLE}" if fixed != ANGLE else ANGLE,
        axes=axes,
    )
    path = tmp_path / "twice.yaml"
    path.write_text(text)
    if not mistaken_path:
        assert sweep.load(path).axes
        return
    with pytest.raises(SpecError) as error:
        sweep.load(path)
    (mistake,) = error.value.mistakes
    assert mistake.path == mistaken_path and "on the axis" in mistake.problem and mistake.line
    line = text.splitlines()[mistake.line - 1]
    assert mistaken_path.rsplit(".", 1)[-1] in line


def test_a_spec_written_out_whole_is_the_same_study(tmp_path):
    import yaml

    path = tmp_path / "one.yaml"
    path.write_text(
        TEXT.format(
            instrument="telescope: {aperture: 25 mm}", target=ANGLE,
            axes="target.range: [1 km, 3 km]",
        )
    )  # fmt: skip
    spec = sweep.load(path)
    full_path = tmp_path / "whole.yaml"
    full_path.write_text(yaml.safe_dump(spec.to_yaml_mapping()))
    assert sweep.load(full_path).id == spec.id
