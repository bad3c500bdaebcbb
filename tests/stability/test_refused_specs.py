"""What has no physical meaning is refused by the spec: field, rule, value and remedy are named."""

import numpy as np
import pytest
from table_shots import ROOT, study

from sweep.spec import Spec, SpecError
from sweep.spec.fields import parameter_rules
from sweep.spec.rules import Numeric

MEANINGLESS = {
    "negative power": ("instrument.laser.power", "-1 W", "at least 1"),
    "no power": ("instrument.laser.power", "0 W", "at least 1"),
    "power that underflows": ("instrument.laser.power", "1e-400 W", "at least 1"),
    "power that overflows": ("instrument.laser.power", "1e400 W", "a number that a float holds"),
    "power that is no number": ("instrument.laser.power", "nan W", "a finite number"),
    "infinite range": ("target.range", "inf m", "a finite number"),
    "light without a wavelength": ("instrument.laser.wavelength", "0 nm", "at least 1"),
    "negative wavelength": ("instrument.laser.wavelength", "-1550 nm", "at least 1"),
    "beam of no width": ("instrument.laser.beam_divergence", "0 urad", "at least 1"),
    "beam wider than half the sky": ("instrument.laser.beam_divergence", "91 deg", "at most 90"),
    "negative line width": ("instrument.laser.line_width", "-1 kHz", "at least 0 Hz"),
    "negative noise": ("instrument.laser.relative_intensity_noise", "-1e-15 1/Hz", "at least 0"),
    "chirp that does not chirp": ("instrument.chirp.bandwidth", "0 Hz", "at least 1"),
    "chirp of no length": ("instrument.chirp.duration", "0 s", "at least 1"),
    "telescope without an aperture": ("instrument.telescope.aperture", "0 mm", "at least 1"),
    "optics that amplify": ("instrument.telescope.optical_efficiency", 1.01, "at most 1"),
    "optics that absorb more than all": ("instrument.telescope.optical_efficiency", -0.1,
                                         "at least 0"),
    "blind detector": ("instrument.receiver.responsivity", "0 A/W", "at least 1"),
    "detector without a band": ("instrument.receiver.detector_bandwidth", "0 Hz",
                                "at least 1"),
    "negative noise of the detector": ("instrument.receiver.noise_equivalent_power",
                                       "-5 pW/rtHz", "at least 0"),
    "negative noise of the amplifier": ("instrument.receiver.amplifier_noise_current", "-1 nA",
                                        "at least 0 A"),
    "no transimpedance": ("instrument.receiver.transimpedance", "0 ohm", "at least 1"),
    "no local oscillator": ("instrument.receiver.local_oscillator_power", "0 mW",
                            "at least 1"),
    "mixing better than perfect": ("instrument.receiver.mixing_efficiency", 1.1, "at most 1"),
    "avalanche that loses": ("instrument.receiver.apd_gain", 0.5, "at least 1"),
    "avalanche that quietens": ("instrument.receiver.excess_noise_factor", 0.9, "at least 1"),
    "amplifier that quietens": ("instrument.receiver.noise_figure", "-1 dB", "at least 0 dB"),
    "modulation deeper than all": ("instrument.receiver.modulation_index", 1.2, "at most 1"),
    "colder than nothing": ("instrument.receiver.temperature", "-274 degC", "at least 1"),
    "FFT of 0": ("instrument.processing.fft_size", 0, "at least 2"),
    "FFT of 1": ("instrument.processing.fft_size", 1, "at least 2"),
    "FFT of a half": ("instrument.processing.fft_size", 1024.5, "a whole number"),
    "threshold below nothing": ("instrument.processing.tnr", -3, "at least 1"),
    "sampling that stands still": ("instrument.processing.sample_rate", "0 Hz",
                                   "at least 1"),
    "samples before the echo was sent": ("instrument.processing.acquisition_delay", "-1 us",
                                         "at least 0 s"),
    "fewer bits than none": ("instrument.processing.bits", -1, "at least 0"),
    "negative full scale": ("instrument.processing.full_scale", "-1 V", "at least 0 V"),
    "target behind the lidar": ("target.range", "-1 m", "at least 1"),
    "target in the lidar": ("target.range", "0 m", "at least 1"),
    "reflectance over 1": ("target.reflectance", 1.1, "at most 1"),
    "negative reflectance": ("target.reflectance", -0.1, "at least 0"),
    "beam along the ground": ("target.grazing_angle", "0 deg", "at least 1"),
    "beam from below": ("target.grazing_angle", "-5 deg", "at least 1"),
    "beam past the normal": ("target.grazing_angle", "91 deg", "at most 90 deg"),
    "faster than light": ("target.radial_velocity", "400000 km/s", "at most 1000 km/s"),
    "aside faster than light": ("target.transverse_velocity", "400000 km/s", "at most 1000 km/s"),
    "negative sunlight": ("target.solar_irradiance", "-1 W/m^2/nm", "at least 0"),
    "sun below the horizon": ("target.sun_elevation", "-1 deg", "at least 0 deg"),
    "negative roughness": ("target.roughness", "-1 um", "at least 0 m"),
    "negative jitter": ("target.pointing_jitter", "-1 urad", "at least 0 rad"),
    "air that amplifies": ("atmosphere.extinction", "-1 1/km", "at least 0 1/m"),
    "air of no depth": ("atmosphere.depth", "0 m", "at least 1"),
    "negative turbulence": ("atmosphere.structure_constant", "-1 m^(-2/3)", "at least 0"),
    "footprint of no beamlet": ("footprint.beamlets", 0, "at least 1"),
    "half a beamlet": ("footprint.beamlets", 1.5, "a whole number"),
    "fewer draws than none": ("draws.number", -1, "at least 0"),
    "chance over 1": ("accuracy.tolerance", 1.1, "at most 1"),
}  # fmt: skip
"""Field, value and the rule it breaks, by what would be meant."""

TOGETHER = {
    "chirp shorter than the echo's delay": (
        {"target.range": "80 km"}, "instrument.chirp.duration",
        "the echo's delay 2R/c", "falls short by 3.37026e-05 s", "shorten the range or lengthen",
    ),
    "record that begins when the chirp has ended": (
        {"instrument.processing.acquisition_delay": "500 us"}, "instrument.chirp.duration",
        "must exceed the acquisition delay", "falls short by 1.33426e-05 s", "lengthen the chirp",
    ),
    "record of one sample": (
        {"instrument.processing.sample_rate": "3 kHz"}, "instrument.chirp.duration",
        "must leave 2 samples", "leaves 1.5", "raise the sample rate",
    ),
    "window that a record of few samples has not": (
        {"instrument.processing.fft_size": 5, "instrument.processing.window": "dpss(2.5)"},
        "instrument.processing.window", "must be one that has 5 samples",
        "dpss(2.5) has none of so few", "raise instrument.processing.fft_size",
    ),
    "more electrons than photons": (
        {"instrument.receiver.responsivity": "1.4 A/W"}, "instrument.receiver.responsivity",
        "one electron a photon", "by 0.15 A/W", "'apd_gain'",
    ),
}  # fmt: skip
"""Changes, field, rule, how far off and remedy, of what is meaningless only together."""


def mistake_of(changes):
    with pytest.raises(SpecError) as caught:
        Spec.from_mapping(study(changes), base=ROOT)
    (mistake,) = caught.value.mistakes
    return mistake


@pytest.mark.parametrize("meant", MEANINGLESS)
def test_what_is_meaningless_is_refused_with_field_rule_value_and_remedy(meant):
    path, value, rule = MEANINGLESS[meant]
    mistake = mistake_of({path: value})
    assert mistake.path == path
    assert f"must be {rule}" in mistake.rule
    assert str(value) in mistake.value
    assert mistake.suggestion.startswith("write e.g. '")
    assert all(part in str(mistake) for part in (path, mistake.rule, mistake.value))


@pytest.mark.parametrize("meant", TOGETHER)
def test_what_is_meaningless_together_is_refused_with_field_rule_value_and_remedy(meant):
    changes, path, rule, value, remedy = TOGETHER[meant]
    mistake = mistake_of(changes)
    assert mistake.path == path
    assert rule in mistake.rule and value in mistake.rule
    assert remedy in mistake.suggestion


def test_a_remedy_is_a_value_that_would_be_taken():
    for path, rule in parameter_rules().items():
        if isinstance(rule, Numeric):
            assert rule.first_outside(np.array([float(rule.read(rule.example))])) is None, path
