import math
import re
import subprocess
import sys
from fractions import Fraction

import mpmath
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sweep import units
from sweep.units import QuantityError, read_number, read_quantity

with mpmath.workdps(40):
    FIFTEEN_DEGREES = float(mpmath.pi / 12)


def si(text: object, si_unit: str) -> float:
    number, unit = read_quantity(text, si_unit=si_unit, example="7 of them")
    return unit.to_si(number)


@pytest.mark.parametrize(
    ("text", "si_unit", "value"),
    [
        ("2.5 cm", "m", 0.025),
        ("25mm", "m", 0.025),
        ("25 millimeter", "m", 0.025),
        ("50 µrad", "rad", 5e-5),
        ("50 μrad", "rad", 5e-5),
        ("15°", "rad", FIFTEEN_DEGREES),
        ("2^3 kHz", "Hz", 8000.0),
        ("1e3 Hz", "Hz", 1000.0),
        ("5 pW/sqrt(Hz)", "W/Hz^0.5", 5e-12),
        ("5 pW/√Hz", "W/Hz^0.5", 5e-12),
        ("5 pW/√(Hz)", "W/Hz^0.5", 5e-12),
        ("5 pW/Hz^0.5", "W/Hz^0.5", 5e-12),
        ("5 pW*Hz^-0.5", "W/Hz^0.5", 5e-12),
        ("0.5 W/m²/nm", "W/m^3", 5e8),
        ("0.5 W m^-2 nm^-1", "W/m^3", 5e8),
        ("7 kΩ", "ohm", 7000.0),
        ("-10 m/s", "m/s", -10.0),
        ("−10 m/s", "m/s", -10.0),
        ("290 K", "K", 290.0),
        ("20 °C", "K", 293.15),
        ("-150 dB / Hz", "1/Hz", 1e-15),
        ("1e-15 1/Hz", "1/Hz", 1e-15),
        ("1e-15 /Hz", "1/Hz", 1e-15),
        ("1e-15 Hz^-1", "1/Hz", 1e-15),
        ("1e-12 1/kHz", "1/Hz", 1e-15),
        ("1 au", "m", 149_597_870_700.0),
        ("50 sr", "sr", 50.0),
        ("1e-4 1/m", "1/m", 1e-4),
        ("0.1/km", "1/m", 1e-4),
        ("11/km", "1/m", 0.011),
        ("1 1/km", "1/m", 1e-3),
        ("2^3 1/km", "1/m", 8e-3),
        ("1e-14 m^(-2/3)", "m^(-2/3)", 1e-14),
        ("1e-14 m**(-2/3)", "m^(-2/3)", 1e-14),
        ("1e-14 1/m^(2/3)", "m^(-2/3)", 1e-14),
        ("5 pW/Hz^(1/2)", "W/Hz^0.5", 5e-12),
        ("10 m/s²", "m/s^2", 10.0),
        ("1 V", "V", 1.0),
    ],
)
def test_a_written_quantity_gives_exactly_its_si_value(text, si_unit, value):
    """Spellings; usual ones, prefixes, angles and decibels are cases of tests/stability."""
    assert si(text, si_unit) == value


def test_decibels_beyond_a_float_are_refused_and_far_below_it_nothing():
    with pytest.raises(QuantityError, match="a float holds"):
        si("1e300 dB", "dB")
    assert si("-1e300 dB", "dB") == 0.0


@pytest.mark.parametrize(
    ("spelling", "si_unit", "text"),
    [
        ("1 W*m^-2/nm", "W/m^3", "W/m^2/nm"),
        ("1 pW/rtHz", "W/Hz^0.5", "pW/Hz^0.5"),
        ("1 /km", "1/m", "1/km"),
        ("1 km^-1", "1/m", "1/km"),
        ("1 m^-2", "m^-2", "m^-2"),
        ("1 cm**(-2/3)", "m^(-2/3)", "cm^(-2/3)"),
        ("1 dB/Hz", "1/Hz", "dB/Hz"),
    ],
)
def test_a_unit_has_one_spelling_which_reads_back_the_same(spelling, si_unit, text):
    _, unit = read_quantity(spelling, si_unit=si_unit, example="7 of them")
    assert unit.symbol == text
    assert read_quantity(f"1 {text}", si_unit=si_unit, example="7 of them") == (1, unit)


@given(st.integers(-(10**9), 10**9))
def test_all_spellings_of_a_length_are_one_float(micrometres):
    value = float(Fraction(micrometres, 10**6))
    digits = f"{abs(micrometres):07d}"
    sign = "-" if micrometres < 0 else ""
    assert si(f"{micrometres} um", "m") == value
    assert si(f"{micrometres}e-3 mm", "m") == value
    assert si(f"{micrometres}E-4cm", "m") == value
    assert si(f"{micrometres}e-9 km", "m") == value
    assert si(f"{sign}{digits[:-6]}.{digits[-6:]} m", "m") == value


@pytest.mark.parametrize(
    ("text", "si_unit", "words"),
    [
        ("25", "m", "needs a unit; write e.g. '7 of them'"),
        (25, "m", "needs a unit"),
        (0.025, "m", "needs a unit"),
        ("25 mn", "m", "unknown unit 'mn'; did you mean 'mm'?"),
        ("600 Mhz", "Hz", "did you mean 'MHz'?"),
        ("1 ghz", "Hz", "did you mean 'GHz'?"),
        ("50 urda", "rad", "did you mean 'urad'?"),
        ("5 pW/rtHzz", "W/Hz^0.5", "did you mean 'Hz'?"),
        ("1 parsnip", "m", "write e.g. '7 of them'"),
        ("3 W", "m", "needs a unit like m, and 'W' is none"),
        ("5 pW/Hz", "W/Hz^0.5", "needs a unit like W/Hz^0.5"),
        ("5 %", "rad", "needs a unit like rad"),
        ("10 rpm", "Hz", "needs a unit like Hz"),
        ("3 dB", "m", "needs a unit like m"),
        ("3 W", "dB", "needs a unit like dB"),
        ("3 dB", "1/Hz", "needs a unit like 1/Hz"),
        ("3 dB/Hz", "dB", "needs a unit like dB"),
        ("3 dB/Hz", "1/m", "needs a unit like 1/m, and 'dB/Hz' is none"),
        ("3 dB/km", "m", "unknown unit 'dB'"),
        ("30 dBm", "Hz", "needs a unit like Hz, and 'dBm' is none"),
        ("30 dBm", "dB", "needs a unit like dB"),
        ("1e-14 m^-2/3", "m^(-2/3)", "cannot be read"),
        ("1 1/2 m", "m", "cannot be read"),
        ("5 1", "m", "must be a number with a unit"),
        ("1 m^(1/0)", "m", "cannot be read"),
        ("nan m", "m", "must be a finite number"),
        ("inf m", "m", "must be a finite number"),
        (".inf", "m", "must be a finite number"),
        (float("nan"), "m", "must be a finite number"),
        ("1e999 m", "m", "that a float holds"),
        ("1e4000 dB", "dB", "that a float holds"),
        ("1 m; import os", "m", "cannot be read"),
        ("__import__('os')", "m", "must be a number"),
        ("1 m()", "m", "cannot be read"),
        ("9^999 m", "m", "that a float holds"),
        ("1 m^99999999", "m", "cannot be read"),
        ("1 " + "m" * 200, "m", "at most 100 characters"),
        ("", "m", "must be a number"),
        (True, "m", "must be a number"),
        (None, "m", "must be a number"),
        ([1], "m", "must be a number"),
        ("1,5 m", "m", "has a comma; numbers are written like 1234.5; write '1.5 m'"),
    ],
)
def test_a_quantity_that_cannot_be_read_says_why_and_what_to_write(text, si_unit, words):
    with pytest.raises(QuantityError) as error_info:
        si(text, si_unit)
    assert words in str(error_info.value)


@pytest.mark.parametrize(
    ("text", "value"),
    [(1, 1), ("2^17", 131072), ("2**17", 131072), ("1e9", 10**9), (1e9, 10**9), ("10 %", 0.1),
     (0.1, Fraction(1, 10)), ("-0.5", -0.5)],
)  # fmt: skip
def test_pure_numbers_are_read_exactly(text, value):
    number, unit = read_number(text)
    assert unit.factor * number == (Fraction(1, 10) if value == 0.1 else value)


@pytest.mark.parametrize(
    ("text", "value"), [("2^-1", Fraction(1, 2)), ("10^-3", Fraction(1, 1000)), ("10^+2", 100)]
)
def test_powers_of_negative_exponents_are_read_exactly(text, value):
    assert read_number(text)[0] == value
    assert si(f"{text} m", "m") == float(value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("2^100000000", "has an exponent beyond 999"),
        ("2**-100000000", "has an exponent beyond 999"),
        ("2^1.5", "has an exponent that is no whole number"),
        ("0^-1", "divides by zero"),
    ],
)
def test_powers_that_are_none_say_why(text, words):
    with pytest.raises(QuantityError, match=words):
        read_number(text)
    with pytest.raises(QuantityError, match=words):
        si(f"{text} m", "m")


@given(st.text(max_size=120))
def test_any_text_is_a_quantity_or_a_quantity_error(text):
    for si_unit in ("m", "W/Hz^0.5", "dB", "K", "1/Hz", "m^(-2/3)"):
        try:
            value = si(text, si_unit)
        except QuantityError:
            continue
        assert math.isfinite(value)


def test_importing_the_package_and_its_units_leaves_pint_alone():
    code = "import sys, sweep, sweep.units; sys.exit('pint' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("name", sorted(units.BUILT_IN_UNITS))
def test_usual_units_are_exactly_pints(name):
    assert units._root_unit_conversion(name) == units.root_unit_conversion_by_pint(name)


@pytest.mark.parametrize(
    ("text", "si_unit", "value"),
    [
        ("30 dBm", "W", 1.0),
        ("0 dBm", "W", 1e-3),
        ("-90 dBm", "W", 1e-12),
        ("3 dBW", "W", 10**0.3),
        ("-155 dBc/Hz", "1/Hz", 10**-15.5),
        ("-155 dBc / Hz", "1/Hz", 10**-15.5),
        ("0.2 dB/km", "1/m", 0.2e-4 * math.log(10)),
        ("1 dB/m", "1/m", 0.1 * math.log(10)),
        ("50 percent", "", 0.5),
    ],
)
def test_units_of_decibels_mean_what_the_field_means_by_them(text, si_unit, value):
    if si_unit:
        number, unit = read_quantity(text, si_unit=si_unit, example="")
    else:
        number, unit = read_number(text)
    assert unit.to_si(number) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1.234,5 m", "write '1234.5 m'"),
        ("1,234.5 m", "write '1234.5 m'"),
        ("1,000 m", "write '1000 m' or '1.000 m'"),
        ("1 000 000 m", "write '1000000 m'"),
        ("1_000 m", "write '1000 m'"),
        ("1'000 m", "write '1000 m'"),
        ("-1,5e3 m", "write '-1.5e3 m'"),
    ],
)
def test_a_number_with_a_comma_or_groups_is_refused_with_its_spelling_here(text, words):
    with pytest.raises(QuantityError, match=re.escape(words)):
        read_quantity(text, si_unit="m", example="")


def test_shares_and_numbers_of_nothing_are_none():
    assert units.percent_text(0.256, ".1f") == "25.6 %"
    assert units.percent_text(math.nan) == units.number_text(math.nan) == "none"
    assert units.number_text(0.5) == "0.5"


@pytest.mark.parametrize(
    ("text", "slope"), [("10 deg", "0.1763"), ("10°", "0.1763"), ("200 mrad", "0.2027")]
)
def test_an_angle_where_a_slope_is_meant_is_refused_with_its_tangent(text, slope):
    with pytest.raises(QuantityError, match=f"write {slope}, the tangent of that angle"):
        read_number(text)
