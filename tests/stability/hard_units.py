"""The same quantity in any unit is the same float; very large and very small ones too."""

import itertools
import struct
from collections.abc import Iterator
from decimal import Decimal
from typing import Any

import mpmath as mp
import numpy as np
from hard_cases import Family
from table_4_1_shots import ROOT

from sweep.spec import GridSpec
from sweep.spec.rules import NumericRule
from sweep.spec.sections import parameter_rules
from sweep.units import read_quantity

FAMILY = Family(
    "Units",
    "Written quantities are exact fractions until they are rounded once to a float, so every "
    "spelling of one gives the same bits.",
)
ROUNDING_CASE = {
    "measure": "steps between floats",
    "allowed": 0.0,
    "limit": 0.0,
    "because": "one rounding, to the nearest",
}
PREFIX_EXPONENTS = {
    "q": -30, "r": -27, "y": -24, "z": -21, "a": -18, "f": -15, "p": -12, "n": -9, "u": -6,
    "m": -3, "": 0, "k": 3, "M": 6, "G": 9, "T": 12, "P": 15, "E": 18, "Z": 21, "Y": 24, "R": 27,
    "Q": 30,
}  # fmt: skip
DIGIT_TEXTS = ("1", "1.55", "0.1", "7.123456789012345678901234567890", "9007199254740993")


def to_si(text: str, si_unit: str) -> float:
    """SI value of a written quantity."""
    number, unit_read = read_quantity(text, si_unit=si_unit, example="1")
    return unit_read.to_si(number)


def float_steps(a: float, b: float) -> int:
    """Number of steps between two floats of one sign."""
    return abs(
        struct.unpack("<q", struct.pack("<d", a))[0] - struct.unpack("<q", struct.pack("<d", b))[0]
    )


@FAMILY.case(
    "every prefix from quecto to quetta, of every unit that takes one",
    reference="the decimal itself, read by Python's float",
    **ROUNDING_CASE,
)
def every_prefix() -> float:
    units = ("m", "s", "Hz", "W", "A", "V", "ohm", "rad", "K")
    return max(
        float_steps(to_si(f"{digits} {prefix}{unit}", unit), float(f"{digits}e{power}"))
        for digits, (prefix, power), unit in itertools.product(
            DIGIT_TEXTS, PREFIX_EXPONENTS.items(), units
        )
    )


@FAMILY.case(
    "numbers of 1e-323 to 1e308, in the largest unit and in the smallest",
    reference="the decimal itself, read by Python's float",
    **ROUNDING_CASE | {"because": "one rounding, to the nearest, denormal or not"},
)
def extreme_numbers() -> float:
    powers = (-323, -310, -308, -300, -100, 0, 100, 250, 300, 308)
    return max(
        float_steps(
            to_si(f"{digits}e{power - PREFIX_EXPONENTS[prefix]} {prefix}W", "W"),
            float(f"{digits}e{power}"),
        )
        for digits in ("1", "1.7976931348623157", "4.9")
        for power in powers
        for prefix in ("q", "p", "", "G", "Q")
        if float(f"{digits}e{power}") < float("inf")
    )


COMPOUND_QUANTITIES = (
    ("1.55 pW/rtHz", "1.55e-12", "W/Hz^0.5"), ("1.55 nW/rtMHz", "1.55e-12", "W/Hz^0.5"),
    ("1.55 W/m^2/nm", "1.55e9", "W/m^3"), ("1.55 mW/cm^2/um", "1.55e7", "W/m^3"),
    ("1.55 1/km", "1.55e-3", "1/m"), ("1.55 1/Gm", "1.55e-9", "1/m"), ("7.2 km/h", "2", "m/s"),
    ("1.55 um/ns", "1.55e3", "m/s"), ("1.1 A/W", "1.1", "A/W"), ("1.1 nA/uW", "1.1e-3", "A/W"),
    ("1.55 Gm/s^2", "1.55e9", "m/s^2"), ("1.55 nm/us^2", "1.55e3", "m/s^2"),
    ("3 mm^(-2/3)", "300", "m^(-2/3)"), ("20 degC", "293.15", "K"),
    ("1.52 au", "227388763464", "m"), ("1.55 1/THz", "1.55e-12", "1/Hz"),
)  # fmt: skip


@FAMILY.case(
    "compound units: pW/rtHz, mW/cm^2/um, km/h, 1/Gm, degC",
    reference="the decimal in SI, read by Python's float",
    **ROUNDING_CASE,
)
def compound_units() -> float:
    return max(
        float_steps(to_si(text, unit), float(exact)) for text, exact, unit in COMPOUND_QUANTITIES
    )


@FAMILY.case(
    "degrees, minutes and seconds of arc, from 1e-9 to 90 deg",
    reference="pi / 180, 60 digits, rounded",
    **ROUNDING_CASE | {"because": "one rounding, to the nearest: pi has digits enough"},
)
def angles() -> float:
    with mp.workdps(60):
        return max(
            float_steps(
                to_si(f"{digits} {unit}", "rad"),
                float(mp.mpf(digits) * mp.pi / 180 / parts_of_degree),
            )
            for digits in ("1e-9", "0.01", "1", "15", "22.5", "45", "89.99999999999999", "90")
            for unit, parts_of_degree in (("deg", 1), ("arcmin", 60), ("arcsec", 3600))
        )


@FAMILY.case(
    "decibels from -3200 to 3000, and per hertz",
    reference="10^(dB / 10), 60 digits, rounded",
    **ROUNDING_CASE,
)
def decibels() -> float:
    texts = ("-3200", "-3000", "-155", "-2", "-0.01", "0", "0.1", "3", "29.9", "300", "3000")
    with mp.workdps(60):
        return max(
            float_steps(to_si(f"{text} {unit}", si_unit), float(mp.mpf(10) ** (mp.mpf(text) / 10)))
            for text in texts
            for unit, si_unit in (("dB", "dB"), ("dB/Hz", "1/Hz"))
        )


def with_prefix_of_power(example: str, power: int) -> tuple[str, str]:
    """Digits and unit of an example, the unit with the prefix of a power of ten."""
    number, _, unit = example.partition(" ")
    base = next(
        (
            candidate_base
            for candidate_base in ("Hz", "ohm", "rad", "m", "W", "A", "s", "V", "K")
            if unit.endswith(candidate_base)
        ),
        "",
    )
    prefix = unit.removesuffix(base)
    (new_prefix,) = (name for name, exponent in PREFIX_EXPONENTS.items() if exponent == power)
    return f"{Decimal(number).scaleb(PREFIX_EXPONENTS[prefix] - power)}", new_prefix + base


def respell_section(section: Any, power: int) -> Any:
    """A spec's section with every simple quantity in units of that power of ten."""
    if isinstance(section, dict):
        return {key: respell_section(value, power) for key, value in section.items()}
    if isinstance(section, str) and section in SIMPLE_QUANTITIES:
        number, unit = with_prefix_of_power(section, power)
        return f"{number} {unit}"
    return section


SIMPLE_QUANTITIES = (
    "1550 nm", "1 W", "50 urad", "1 GHz", "5.5 GHz", "500 us", "25 mm", "1 mW", "400 MHz", "25 nm",
    "7 kohm", "25 nA", "600 MHz", "2 km", "1.234567890123 mrad",
)  # fmt: skip
STUDY_MAPPING = {
    "title": "Units",
    "instrument": {
        "laser": {"wavelength": "1550 nm", "power": "1 W", "beam_divergence": "50 urad"},
        "chirp": {"bandwidth": "1 GHz", "start_frequency": "5.5 GHz", "duration": "500 us"},
        "telescope": {"aperture": "25 mm", "coupling": "aperture"},
        "receiver": {
            "responsivity": "1.1 A/W", "detector_bandwidth": "400 MHz",
            "optical_passband": "25 nm", "noise_equivalent_power": "5 pW/rtHz",
            "transimpedance": "7 kohm", "amplifier_bandwidth": "400 MHz",
            "amplifier_noise_current": "25 nA", "local_oscillator_power": "1 mW",
        },
        "processing": {"sample_rate": "600 MHz", "fft_size": "2^17", "tnr": 10},
    },
    "target": {"range": "2 km", "grazing_angle": "1.234567890123 mrad", "reflectance": 0.1},
}  # fmt: skip


@FAMILY.case(
    "a whole spec in pm, ps and pW, in Gm, Gs and GW, and in between",
    reference="the same spec in customary units",
    **ROUNDING_CASE | {"measure": "parameters that differ, in bits, and in the study's identity"},
)
def spec_in_other_units() -> float:
    plain_spec = GridSpec.from_mapping(STUDY_MAPPING, base=ROOT)
    expected, n_different = plain_spec.parameters_with_overrides({}), 0
    for power in (-30, -18, -12, -9, -3, 0, 3, 9, 12, 30):
        respelled_study = respell_section(STUDY_MAPPING, power)
        assert respelled_study["instrument"]["telescope"]["aperture"] != "25 mm" or power == -3
        spec = GridSpec.from_mapping(respelled_study, base=ROOT)
        parameters = spec.parameters_with_overrides({})
        n_different += sum(parameters[path] != value for path, value in expected.items())
        n_different += spec.id != plain_spec.id
    return float(n_different)


def round_trips() -> Iterator[int]:
    """Of every parameter that carries a unit, at values within its bounds."""
    for rule in parameter_rules().values():
        if isinstance(rule, NumericRule) and rule.si_unit and rule.si_unit != "dB":
            for digits in ("1e-12", "0.07071067811865476", "1.2345678901234567", "1e12"):
                value = float(digits)
                if rule.first_bound_violation(np.array([value])) is None:
                    yield float_steps(value, rule.read(rule.format(value)))


@FAMILY.case(
    "what a store writes of a parameter, read back",
    reference="the parameter",
    **ROUNDING_CASE | {"because": "17 digits say which float it is"},
)
def written_and_read() -> float:
    return max(round_trips())
