"""Values without physical meaning are refused: field, rule, value and remedy are named."""

import numpy as np
import pytest
from table_4_1_shots import ROOT, study_mapping

from sweep.spec import GridSpec, SpecError
from sweep.spec.rules import NumericRule
from sweep.spec.sections import parameter_rules

MEANINGLESS = {
    "0": ("at least 1", (
        "instrument.laser.power", "instrument.laser.wavelength", "instrument.laser.beam_divergence",
        "instrument.chirp.bandwidth", "instrument.chirp.duration", "instrument.telescope.aperture",
        "instrument.receiver.responsivity", "instrument.receiver.detector_bandwidth",
        "instrument.receiver.transimpedance", "instrument.receiver.local_oscillator_power",
        "instrument.processing.sample_rate", "target.range", "target.grazing_angle",
        "atmosphere.depth", "footprint.beamlets",
    )),
    "1e-13": ("at least 1e-12", ("instrument.telescope.optical_efficiency",)),
    "-1": ("at least 0", (
        "instrument.laser.line_width", "instrument.laser.relative_intensity_noise",
        "instrument.receiver.noise_equivalent_power",
        "instrument.receiver.amplifier_noise_current", "instrument.receiver.noise_figure",
        "instrument.processing.acquisition_delay", "instrument.processing.bits",
        "instrument.processing.full_scale", "target.reflectance", "target.solar_irradiance",
        "target.sun_elevation", "target.roughness", "target.pointing_jitter",
        "atmosphere.extinction", "atmosphere.structure_constant", "draws.number",
    )),
    "1.1": ("at most 1", (
        "instrument.telescope.optical_efficiency", "instrument.receiver.mixing_efficiency",
        "instrument.receiver.modulation_index", "target.reflectance", "accuracy.tolerance",
    )),
    "0.9": ("at least 1", (
        "instrument.receiver.apd_gain", "instrument.receiver.excess_noise_factor",
    )),
    "4e8": ("at most 1000 km/s", ("target.radial_velocity", "target.transverse_velocity")),
    "nan": ("a finite number", ("instrument.laser.power",)),
    "inf": ("a finite number", ("target.range",)),
    "1e400": ("a number that a float holds", ("instrument.laser.power",)),
    "1e-400": ("at least 1", ("instrument.laser.power",)),
    "1.6": ("at most 90", ("instrument.laser.beam_divergence", "target.grazing_angle")),
    "1": ("at least 2", ("instrument.processing.fft_size",)),
    "1024.5": ("a whole number", ("instrument.processing.fft_size", "footprint.beamlets")),
}  # fmt: skip
"""By a value in SI the rule that it breaks, and the fields that it has no meaning in."""
CASES = [(path, number, rule) for number, (rule, paths) in MEANINGLESS.items() for path in paths]
CASES += [
    ("instrument.receiver.temperature", "-274 degC", "at least 1"),
    ("instrument.processing.tnr", "-3", "at least 1"),
    ("target.range", "-1 m", "at least 1"),
    ("target.grazing_angle", "-5 deg", "at least 1"),
]

TOGETHER = {
    "record that begins when the chirp has ended": (
        {"instrument.processing.acquisition_delay": "500 us"}, "instrument.chirp.duration",
        "must leave 2 samples after the acquisition delay", "leaves 0", "lengthen the chirp",
    ),
    "window that a record of few samples has not": (
        {"instrument.processing.fft_size": 5, "instrument.processing.window": "dpss(2.5)",
         "effects.overlap": "off"},
        "instrument.processing.window", "must be one that has 5 samples",
        "dpss(2.5) has none of so few", "raise instrument.processing.fft_size",
    ),
}  # fmt: skip
"""Changes, field, rule, how far off and remedy, of what is meaningless only together."""


RULES = parameter_rules()


def mistake_of(changes):
    with pytest.raises(SpecError) as error_info:
        GridSpec.from_mapping(study_mapping(changes), base=ROOT)
    (mistake,) = error_info.value.mistakes
    return mistake


@pytest.mark.parametrize(("path", "number", "rule"), CASES)
def test_what_is_meaningless_is_refused_with_field_rule_value_and_remedy(path, number, rule):
    unit = getattr(RULES.get(path), "si_unit", "")
    value = number if " " in number or not unit else f"{number} {unit}"
    mistake = mistake_of({path: value if unit else float(number)})
    assert mistake.path == path
    assert f"must be {rule}" in mistake.problem
    assert number in mistake.value
    assert mistake.suggestion.startswith("write e.g. '")
    assert all(part in str(mistake) for part in (path, mistake.problem, mistake.value))


@pytest.mark.parametrize("meant", TOGETHER)
def test_what_is_meaningless_together_is_refused_with_field_rule_value_and_remedy(meant):
    changes, path, rule, value, remedy = TOGETHER[meant]
    mistake = mistake_of(changes)
    assert mistake.path == path
    assert rule in mistake.problem and value in mistake.problem
    assert remedy in mistake.suggestion


def test_a_remedy_is_a_value_that_would_be_taken():
    for path, rule in RULES.items():
        if isinstance(rule, NumericRule):
            assert rule.first_bound_violation(np.array([float(rule.read(rule.example))])) is None, (
                path
            )
