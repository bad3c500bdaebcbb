"""Conversion of quantities with units, such as ``25 mm``, to floats in SI units.

Numbers are exact fractions until the last step, so that every spelling of a quantity gives the same
float: ``25 mm``, ``2.5 cm`` and ``0.025 m``. A table holds the usual units; all others are left to
pint, which takes a second to import.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal, localcontext
from difflib import get_close_matches
from fractions import Fraction
from functools import cache, lru_cache
from typing import Any, NamedTuple

QUANTITY_TEXT_LENGTH_MAX = 100
"""Maximum number of characters of a written quantity."""
DECIBEL = "dB"
"""Unit of a power ratio in decibels."""
PER_HERTZ = "1/Hz"
"""SI unit of a power ratio per bandwidth."""
LOGARITHMIC_UNITS = {
    "dB": ("dB", Fraction(1)),
    "dB/Hz": (PER_HERTZ, Fraction(1)),
    "dBc/Hz": (PER_HERTZ, Fraction(1)),
    "dBm": ("W", Fraction(1, 1000)),
    "dBW": ("W", Fraction(1)),
}
"""Logarithmic units of power, by symbol: the SI unit, and the value of 0 dB in that SI unit.

30 dBm is 1 W, and -155 dB/Hz is 10^-15.5 /Hz. For the noise of a laser dB/Hz is also written as
dBc/Hz.
"""

NO_VALUE_TEXT = "none"
"""Text that messages and tables show for nan, such as the quotient 0 / 0."""

_NUMBER_PATTERN = r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,4})?"
"""Regular expression of a number in decimal notation, such as ``-1.5e3``."""
_INTEGER_POWER_PATTERN = r"(?P<base>\d{1,6})(?:\^|\*\*)(?P<exponent>[+-]?\d+(?:\.\d*)?)"
"""Regular expression of a power of two integers, such as ``2^17``."""
_POWER_EXPONENT_MAX = 999
"""Largest magnitude of the exponent in a written power, such as 3 in ``10^-3``."""
_UNIT_PATTERN = r"(?:(?<=\s)1\s*/|[^\d\s.+\-]).*"
"""Regular expression of the text after a number that may be a unit."""
_QUANTITY_PATTERN = re.compile(
    rf"\s*(?:{_INTEGER_POWER_PATTERN}|(?P<number>{_NUMBER_PATTERN}))\s*(?P<unit>{_UNIT_PATTERN})?",
    re.ASCII,
)
"""Regular expression of a number or power, followed by an optional unit."""
_EXPONENT_PATTERN = r"(?:\^|\*\*)?(?:(?P<exponent>[+-]?\d(?:\.5)?)|\((?P<ratio>[+-]?\d/[1-9])\))"
"""Regular expression of a unit's exponent, such as ``^2``, ``^0.5`` or ``^(2/3)``."""
_GROUPED_NUMBER_PATTERN = re.compile(
    r"\s*[+-]?\d+(?:[.]\d+)*(?:,\d+|(?:[_' ]\d{3}(?!\d|\s*/))+(?:[.,]\d+)?)+", re.ASCII
)
"""Regular expression of refused numbers: with grouped digits, ``1,000``, or a decimal comma."""
_UNIT_FACTOR_PATTERN = re.compile(rf"(?P<name>[A-Za-z]+|%)(?:{_EXPONENT_PATTERN})?")
"""Regular expression of one factor of a unit: a name with an optional exponent, such as ``m^2``."""
_UNIT_OPERATOR_PATTERN = re.compile(r"(\*(?!\*)|/(?![^(]*\))|(?<=[A-Za-z0-9)]) +(?=[A-Za-z]))")
"""Regular expression of the operator between two factors of a unit: ``*``, ``/`` or a space."""
_NOT_FINITE_PATTERN = re.compile(r"\s*[+-]?\.?(nan|inf|infinity)\b", re.IGNORECASE)
"""Regular expression of a text that begins with nan or infinity."""
_SQUARE_ROOT_PATTERN = re.compile(r"(?:√\s*|rt|sqrt\s*)(?:\(\s*([A-Za-z]+)\s*\)|([A-Za-z]+))")
"""Regular expression of the square root of a unit, such as ``rtHz`` or ``√Hz``."""
_ASCII_SPELLINGS = {"μ": "u", "Ω": "ohm", "°": "deg", "−": "-", "·": "*", "⋅": "*", "×": "*"}
"""ASCII spelling of special characters in units, by character: ``ohm`` for ``Ω``."""

# Units that are suggested for a misspelt unit, by the SI unit of the field.
_USUAL_UNITS_BY_SI_UNIT = {
    "m": "nm um mm cm m km au",
    "s": "ns us ms s",
    "Hz": "Hz kHz MHz GHz THz",
    "W": "pW nW uW mW W kW dBm dBW",
    "rad": "urad mrad rad deg arcmin arcsec",
    "A": "pA nA uA mA A",
    "ohm": "ohm kohm Mohm",
    "K": "K degC",
    "m/s": "mm/s m/s km/s km/h",
    "A/W": "mA/W A/W",
    "W/Hz^0.5": "fW/rtHz pW/rtHz nW/rtHz W/rtHz",
    "W/m^3": "W/m^2/nm mW/m^2/nm W/m^2/um",
    "V": "uV mV V",
    "byte": "MB GB TB MiB GiB",
    "1/m": "1/cm 1/m 1/km dB/m dB/km",
    PER_HERTZ: "1/Hz dB/Hz dBc/Hz",
    DECIBEL: "dB",
    "": "%",
}

_PI = Fraction("3.1415926535897932384626433832795028841971693993751")
_LN_10 = Fraction("2.3025850929940456840179914546843642076011014886288")
_ATTENUATION_UNITS = {"dB/m": _LN_10 / 10, "dB/km": _LN_10 / 10_000, "dB/cm": 10 * _LN_10}
"""Value in 1/m of each unit of attenuation, by unit: of one decibel of power per metre, per
kilometre and per centimetre.
"""
_WATT_DIMENSION = {"gram": 1, "meter": 2, "second": -3}
"""Exponents of pint's root units (gram, meter, second) in a watt, by root unit."""
_BASE_UNIT_CONVERSIONS: dict[str, tuple[Fraction, dict[str, int]]] = {
    "m": (Fraction(1), {"meter": 1}),
    "s": (Fraction(1), {"second": 1}),
    "Hz": (Fraction(1), {"second": -1}),
    "W": (Fraction(1000), _WATT_DIMENSION),
    "A": (Fraction(1), {"ampere": 1}),
    "V": (Fraction(1000), _WATT_DIMENSION | {"ampere": -1}),
    "ohm": (Fraction(1000), _WATT_DIMENSION | {"ampere": -2}),
    "K": (Fraction(1), {"kelvin": 1}),
    "rad": (Fraction(1), {"radian": 1}),
    "sr": (Fraction(1), {"radian": 2}),
    "deg": (_PI / 180, {"radian": 1}),
}
"""Conversion of units without prefix to pint's root units, by symbol: the factor, and the exponent
of each root unit.
"""
_PREFIX_EXPONENTS = {"p": -12, "n": -9, "u": -6, "m": -3, "c": -2, "k": 3, "M": 6, "G": 9, "T": 12}
"""Power of ten of each metric prefix, by prefix: 3 for ``k``."""
BUILT_IN_UNITS = frozenset(_BASE_UNIT_CONVERSIONS) | {
    prefix + base for prefix in _PREFIX_EXPONENTS for base in _BASE_UNIT_CONVERSIONS
}
"""Symbols of units that this module converts without the library pint, with metric prefixes.

Their factors and root units equal those of pint.
"""


class QuantityError(ValueError):
    """Error of a written quantity that can't be read.

    Parameters
    ----------
    rule : str
        The broken rule, as the end of the sentence "this field ...".
    suggestion : str
        Similar text or remedy; may be empty.
    """

    def __init__(self, rule: str, suggestion: str = "") -> None:
        super().__init__(f"{rule}; {suggestion}" if suggestion else rule)
        self.rule = rule
        self.suggestion = suggestion


@dataclass(frozen=True)
class Unit:
    """A unit as the user wrote it, and its conversion to SI units.

    The conversion is ``si = factor * value + offset``. For logarithmic units it is
    ``si = factor * 10 ** (value / 10)``.
    """

    symbol: str
    """The unit as text; empty for a pure number."""
    factor: Fraction = Fraction(1)
    """Value of one unit in SI units; for a logarithmic unit the SI value of 0 dB."""
    offset: Fraction = Fraction(0)
    """SI value of 0 in this unit, such as 273.15 K for degC."""

    @property
    def is_logarithmic(self) -> bool:
        """True if values in this unit are decibels, logarithms of power ratios."""
        return self.symbol in LOGARITHMIC_UNITS

    def to_si(self, value: Fraction) -> float:
        """Convert `value` in this unit to a float in SI units, correctly rounded.

        Raises
        ------
        QuantityError
            If the result exceeds the range of floats.
        """
        try:
            scaled = self.factor * (
                _power_ratio_from_decibels(value) if self.is_logarithmic else value
            )
            return float(scaled + self.offset)
        except OverflowError:
            raise QuantityError("must be a number that a float holds (below 1.8e308)") from None


class ExactQuantity(NamedTuple):
    """A written quantity, before its conversion to SI units."""

    number: Fraction
    """Exact number, in the unit `unit`."""
    unit: Unit
    """Unit as the user wrote it; ``Unit("")`` for a pure number."""

    def to_si(self) -> float:
        """Return the quantity as a float in SI units, correctly rounded.

        QuantityError is raised if the value exceeds the range of floats.
        """
        return self.unit.to_si(self.number)


def read_number(
    raw_value: object,
    description: str = "",
    *,
    is_power_ratio: bool = False,
    is_valid: Callable[[Fraction], bool] = lambda number: True,
) -> ExactQuantity:
    """Read a pure number: ``0.1``, ``"1e9"``, ``"2^17"`` or ``"10 %"``.

    Parameters
    ----------
    raw_value : object
        Value as written.
    description : str
        Description of the number for errors about units.
    is_power_ratio : bool
        True if the number may be written in decibels, such as ``"-3 dB"``.
    is_valid : callable
        Function that returns True for a number that an error may suggest.

    Returns
    -------
    ExactQuantity
        The number in percent, in decibels, or without unit.

    Raises
    ------
    QuantityError
        If the value is no number or has another unit.
    """
    value, unit = _split_quantity(raw_value, "must be a number")
    if unit in ("%", "percent"):
        return ExactQuantity(value, Unit("%", Fraction(1, 100)))
    if unit == DECIBEL and is_power_ratio:
        return ExactQuantity(value, Unit(DECIBEL))
    if unit:
        description_text = f": {description}" if description else ""
        raise QuantityError(
            f"is a pure number and takes no unit{description_text}",
            _pure_number_suggestion(value, unit, is_valid),
        )
    return ExactQuantity(value, Unit(""))


def _pure_number_suggestion(
    value: Fraction, unit: str, is_valid: Callable[[Fraction], bool]
) -> str:
    """Suggest the pure number that a user probably meant by `value` with the text `unit`.

    Only numbers for which `is_valid` returns True are suggested; '' if there is none.
    """
    if unit == DECIBEL:
        ratios = {
            "powers": _power_ratio_from_decibels(value),
            "amplitudes": _power_ratio_from_decibels(value / 2),
        }
        ratio_texts = {
            kind: _format_number(ratio) for kind, ratio in ratios.items() if is_valid(ratio)
        }
        if len(set(ratio_texts.values())) == 1:
            return f"write {next(iter(ratio_texts.values()))}"
        if not ratio_texts:
            return ""
        return "write {powers} for a ratio of powers, {amplitudes} for one of amplitudes".format(
            **ratio_texts
        )
    if unit in LOGARITHMIC_UNITS:
        return ""
    if unit in _USUAL_UNITS_BY_SI_UNIT["rad"].split():
        angle = read_unit(unit, si_unit="rad", example="1 deg").to_si(value)
        slope = math.tan(angle)
        if not is_valid(Fraction(slope)):
            return ""
        return f"write {slope:.4g}, the tangent of that angle, if a slope is meant"
    if quotient := re.fullmatch(r"/\s*(\d+)", unit):
        divisor = int(quotient[1])
        is_clear = divisor and is_valid(value / divisor)
        return f"write {_format_number(value / divisor)}" if is_clear else ""
    return f"write {_format_number(value)}" if unit.isalpha() and is_valid(value) else ""


def read_quantity(raw_value: object, *, si_unit: str, example: str) -> ExactQuantity:
    """Read a quantity such as ``"25 mm"``.

    Parameters
    ----------
    raw_value : object
        Value as written.
    si_unit : str
        SI unit that fixes the dimension; ``"dB"`` for a power ratio written in decibels.
    example : str
        A valid quantity, for errors.

    Returns
    -------
    ExactQuantity
        The number in the unit as written.

    Raises
    ------
    QuantityError
        If the value is no number, or its unit is missing, unknown or of another dimension.
    """
    value, unit_text = _split_quantity(raw_value, "must be a number with a unit")
    if not unit_text:
        remedy = f"write e.g. '{example}'"
        if si_unit == DECIBEL and 1e-300 < value < 1e300:  # else no float, or not positive
            remedy += f"; a ratio of {_format_number(value)} is {10 * math.log10(value):.4g} dB"
        raise QuantityError("needs a unit", remedy)
    return ExactQuantity(value, read_unit(unit_text, si_unit=si_unit, example=example))


@lru_cache(maxsize=4096)
def read_unit(unit_text: str, *, si_unit: str, example: str) -> Unit:
    """Parse a unit of the dimension of an SI unit.

    Parameters
    ----------
    unit_text : str
        Unit as written.
    si_unit : str
        SI unit of the same dimension.
    example : str
        A valid quantity, for errors.

    Raises
    ------
    QuantityError
        If the unit is unknown or of another dimension.
    """
    compact_text = "".join(unit_text.split())
    if compact_text in LOGARITHMIC_UNITS:
        measured_si_unit, factor = LOGARITHMIC_UNITS[compact_text]
        if measured_si_unit == si_unit:
            return Unit(compact_text, factor)
        raise QuantityError(*_wrong_dimension_error(unit_text, si_unit, example))
    if compact_text in _ATTENUATION_UNITS and si_unit == "1/m":
        return Unit(compact_text, _ATTENUATION_UNITS[compact_text])
    if si_unit == DECIBEL:
        raise QuantityError(*_wrong_dimension_error(unit_text, si_unit, example))
    factors = _parse_unit_factors(unit_text)
    if factors is None:
        raise QuantityError(
            f"has the unit '{unit_text}', which cannot be read", f"write e.g. '{example}'"
        )
    for name, _ in factors:
        if _root_unit_conversion(name) is None:
            raise QuantityError(
                f"has an unknown unit '{name}'", _unit_suggestion(name, si_unit, example)
            )
    scale, offset, dimension = _unit_product_conversion(factors)
    si_scale, _, si_dimension = _unit_product_conversion(_parse_unit_factors(si_unit) or [])
    if dimension != si_dimension:
        raise QuantityError(*_wrong_dimension_error(unit_text, si_unit, example))
    return Unit(_format_unit(factors), scale / si_scale, offset / si_scale)


def _wrong_dimension_error(unit_text: str, si_unit: str, example: str) -> tuple[str, str]:
    """Return the error for a unit of the wrong dimension: the rule's text, and a suggestion."""
    dbm_example = " or '30 dBm'" if (si_unit, unit_text) == ("W", DECIBEL) else ""
    return (
        f"needs a unit like {si_unit}, and '{unit_text}' is none",
        f"write e.g. '{example}'{dbm_example}",
    )


def _split_quantity(raw_value: object, rule: str) -> tuple[Fraction, str]:
    """Split a written quantity into its exact number and the text of its unit, '' without a unit.

    Raise a `QuantityError` with the text `rule` if the number can't be read.
    """
    if isinstance(raw_value, bool) or not isinstance(raw_value, int | float | str):
        raise QuantityError(rule)
    text = _to_ascii_spelling(str(raw_value))
    if len(text) > QUANTITY_TEXT_LENGTH_MAX:
        raise QuantityError(f"must be at most {QUANTITY_TEXT_LENGTH_MAX} characters long")
    if _NOT_FINITE_PATTERN.match(text):
        raise QuantityError("must be a finite number")
    if grouped := _GROUPED_NUMBER_PATTERN.match(text):
        raise QuantityError(*_grouped_digits_error(text, grouped[0]))
    match = _QUANTITY_PATTERN.fullmatch(text)
    if match is None:
        raise QuantityError(rule)
    unit = (match["unit"] or "").strip()
    if match["base"]:
        return _parse_integer_power(int(match["base"]), match["exponent"]), unit
    return Fraction(match["number"]), unit


def _parse_integer_power(base: int, exponent: str) -> Fraction:
    """Return the exact value of a power with an integer exponent, such as ``2^17`` or ``10^-3``."""
    if "." in exponent:
        raise QuantityError("has an exponent that is no whole number")
    if abs(int(exponent)) > _POWER_EXPONENT_MAX:
        raise QuantityError(f"has an exponent beyond {_POWER_EXPONENT_MAX} to either side")
    if base == 0 and int(exponent) < 0:
        raise QuantityError("divides by zero")
    return Fraction(base) ** int(exponent)


def _grouped_digits_error(text: str, number: str) -> tuple[str, str]:
    """Return the error for grouped digits or a decimal comma: the rule's text, and a suggestion."""
    *groups, last_group = re.split(r"[,_'\s]", number)
    remedies = []
    if "," not in number or (len(last_group) == 3 and "." not in number):
        remedies.append(f"'{''.join([*groups, last_group])}{text[len(number) :]}'")
    if number.count(",") == 1:
        integer_part, _, decimals = number.partition(",")
        remedies.append(
            f"'{re.sub(r'[^-+0-9]', '', integer_part)}.{decimals}{text[len(number) :]}'"
        )
    return (
        "has a number that is grouped, or has a comma; numbers are written like 1234.5",
        f"write {' or '.join(remedies)}" if remedies else "",
    )


def _to_ascii_spelling(text: str) -> str:
    """Return a text in ASCII spelling: ``25 µm`` as ``25 um``, ``pW/√Hz`` as ``pW/Hz^0.5``."""
    text = unicodedata.normalize("NFKC", text[: 2 * QUANTITY_TEXT_LENGTH_MAX])
    for character, letters in _ASCII_SPELLINGS.items():
        text = text.replace(character, letters)
    return _SQUARE_ROOT_PATTERN.sub(lambda match: f"{match[1] or match[2]}^0.5", text)


def _format_number(value: Fraction) -> str:
    """Return the text of an exact number as a user would write it, such as ``0.25``."""
    try:
        return f"{float(value):.4g}"
    except OverflowError:
        return "1e300"


def _parse_unit_factors(unit_text: str) -> list[tuple[str, Fraction]] | None:
    """Return (name, exponent) of each factor of a written unit; None if the text is no unit."""
    factors = []
    sign = 1
    unit_text = re.sub(r"^1\s*/", "/", unit_text.replace("**", "^"))
    for index, piece in enumerate(_UNIT_OPERATOR_PATTERN.split(unit_text)):
        factor = piece.strip()
        if index % 2:
            sign = -1 if factor == "/" else 1
            continue
        if index == 0 and unit_text.lstrip().startswith("/"):
            continue  # the 1 of 1/m
        match = _UNIT_FACTOR_PATTERN.fullmatch(factor)
        if match is None:
            return None
        factors.append((match["name"], sign * Fraction(match["exponent"] or match["ratio"] or 1)))
    return factors


def _format_unit(factors: list[tuple[str, Fraction]]) -> str:
    """Return the usual spelling of a unit from its (name, exponent) factors: ``W/m^2/nm``."""
    if [exponent for _, exponent in factors] == [-1]:
        return f"1/{factors[0][0]}"
    unit_text = ""
    for name, exponent in factors:
        operator = "/" if exponent < 0 and unit_text else "*" if unit_text else ""
        abs_exponent = abs(exponent) if operator == "/" else exponent
        power = (
            f"{float(abs_exponent):g}" if 2 % abs_exponent.denominator == 0 else f"({abs_exponent})"
        )
        unit_text += operator + name + ("" if abs_exponent == 1 else f"^{power}")
    return unit_text


@cache
def _pint_registry() -> Any:
    """Return the registry of units of the library pint, with exact fractions (cached)."""
    import pint

    return pint.UnitRegistry(non_int_type=Fraction)


@cache
def _root_unit_conversion(
    name: str,
) -> tuple[Fraction, Fraction, tuple[tuple[str, Fraction], ...]] | None:
    """Return the conversion of a unit to pint's root units; None if the unit is unknown.

    The conversion is (factor, offset, exponents of root units): root value = factor * value +
    offset.
    """
    if name in BUILT_IN_UNITS:
        base = name if name in _BASE_UNIT_CONVERSIONS else name[1:]
        factor, powers = _BASE_UNIT_CONVERSIONS[base]
        factor *= Fraction(10) ** (
            0 if name in _BASE_UNIT_CONVERSIONS else _PREFIX_EXPONENTS[name[0]]
        )
        return factor, Fraction(0), tuple(sorted((k, Fraction(v)) for k, v in powers.items()))
    return root_unit_conversion_by_pint(name)


def root_unit_conversion_by_pint(
    name: str,
) -> tuple[Fraction, Fraction, tuple[tuple[str, Fraction], ...]] | None:
    """Return the conversion of a unit to pint's root units, as the library pint computes it.

    Parameters
    ----------
    name : str
        Name of the unit.

    Returns
    -------
    (Fraction, Fraction, tuple of (str, Fraction)) or None
        Factor, offset and exponents of root units; None if pint does not know the unit.
    """
    registry = _pint_registry()
    try:
        unit = registry.parse_units("percent" if name == "%" else name)
        zero, one = (registry.Quantity(Fraction(i), unit).to_root_units() for i in (0, 1))
    except (AttributeError, ValueError, TypeError, ArithmeticError):
        return None
    dimension = {str(key): Fraction(power) for key, power in one.unit_items()}
    offset = Fraction(zero.magnitude)
    return Fraction(one.magnitude) - offset, offset, tuple(sorted(dimension.items()))


def _unit_product_conversion(
    factors: list[tuple[str, Fraction]],
) -> tuple[Fraction, Fraction, dict[str, Fraction]]:
    """Return the conversion of a product of known units to pint's root units.

    `factors` are (name, exponent) of each unit. The conversion is (factor, offset, exponents by
    root unit).
    """
    scale, offset = Fraction(1), Fraction(0)
    dimension: dict[str, Fraction] = {}
    for name, exponent in factors:
        root_unit = _root_unit_conversion(name)
        assert root_unit is not None
        factor, offset, powers = root_unit
        scale *= _raise_to_power(factor, exponent)
        for key, power in powers:
            dimension[key] = dimension.get(key, Fraction(0)) + power * exponent
    # The offset of a temperature unit applies to temperatures, but not to products with it (W/K).
    return (
        scale,
        offset if len(factors) == 1 else Fraction(0),
        {k: p for k, p in dimension.items() if p},
    )


def _raise_to_power(factor: Fraction, exponent: Fraction) -> Fraction:
    """Return a positive fraction raised to a power, exact for an integer, else to 50 digits."""
    if exponent.denominator == 1:
        return factor ** int(exponent)
    with localcontext() as context:
        context.prec = 60
        root = (Decimal(factor.numerator) / factor.denominator) ** (
            Decimal(1) / exponent.denominator
        )
        context.prec = 50  # rounded once more, so that the root of a cube is exact
        root = +root
    return Fraction(root) ** exponent.numerator


def _power_ratio_from_decibels(decibels: Fraction) -> Fraction:
    """Convert decibels to a power ratio, to 50 digits; the ratio is clipped to 1e-400..1e400."""
    with localcontext() as context:
        context.prec = 50
        exponent = Decimal(decibels.numerator) / decibels.denominator / 10
        return Fraction(Decimal(10) ** max(min(exponent, Decimal(400)), Decimal(-400)))


def _unit_suggestion(name: str, si_unit: str, example: str) -> str:
    """Suggest, as text, a usual unit that resembles the unknown unit `name`, else the `example`."""
    usual_units = _to_ascii_spelling(_USUAL_UNITS_BY_SI_UNIT.get(si_unit, si_unit))
    names = sorted(set(re.findall(r"[A-Za-z%]+", usual_units)))
    case_variants = [usual_name for usual_name in names if usual_name.lower() == name.lower()]
    candidates = case_variants or get_close_matches(name, names, n=10, cutoff=0.5)
    candidates.sort(key=lambda usual_name: (len(usual_name) != len(name), usual_name[0] != name[0]))
    return f"did you mean '{candidates[0]}'?" if candidates else f"write e.g. '{example}'"


def number_text(value: float, format_spec: str = ".4g") -> str:
    """Return a number as text in the given format; ``none`` for nan.

    Examples
    --------
    >>> number_text(0.25), number_text(float("nan"))
    ('0.25', 'none')
    """
    return f"{value:{format_spec}}" if value == value else NO_VALUE_TEXT


def percent_text(share: float, format_spec: str = ".3g") -> str:
    """Return a fraction as text in percent; ``none`` for nan, such as the quotient 0 / 0.

    Examples
    --------
    >>> percent_text(0.25), percent_text(float("nan"))
    ('25 %', 'none')
    """
    return f"{100 * share:{format_spec}} %" if share == share else NO_VALUE_TEXT
