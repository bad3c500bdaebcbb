"""Fields of a spec, each declared in a line: ``range: float = of.length("Distance", "2 km")``.

A function makes a pydantic field whose metadata holds its rule. Bounds are as a user would write
them; a field without a default is required.
"""

from __future__ import annotations

from typing import Any

from pydantic import Field

from sweep.spec.rules import Choice, File, Flag, Numeric, Rule, Several, Text

# Far beyond all that flies, and near enough that squares and products stay within a float.
_EITHER_WAY = {
    "m": "1e9 m",
    "rad": "1e6 deg",
    "m/s": "1000 km/s",
    "m/s^2": "1e6 m/s^2",
    "rad/s": "1e6 deg/s",
    "": "1e12",
}
"""Largest magnitude of a signed quantity, by its SI unit."""


def field(rule: Rule, default: Any = ..., *, alias: str | None = None) -> Any:
    """Field that holds what a rule says; required without a default."""
    info = Field(default, alias=alias)
    info.metadata.append(rule)
    return info


def measure(
    about: str, unit: str, example: str, at_least: str = "", at_most: str = "", **more: Any
) -> Numeric:
    """Rule of a quantity within bounds, wide ones by default."""
    bounds = {"at_least": at_least or f"-{_EITHER_WAY[unit]}"} if "above" not in more else {}
    bounds |= {"at_most": at_most or _EITHER_WAY[unit]} if "below" not in more else {}
    return Numeric(about=about, si_unit=unit, example=example, **bounds, **more)  # type: ignore[arg-type]


def quantity(
    about: str,
    unit: str,
    example: str,
    at_least: str = "",
    at_most: str = "",
    *,
    default: Any = ...,
    word: str = "",
    **more: Any,
) -> Any:
    """Declare a number with a unit; the word, if there is one, stands for the default."""
    more |= {"word": word, "means": more.get("means", default)} if word else {}
    return field(measure(about, unit, example, at_least, at_most, **more), default)


def number(about: str, example: str = "0.5", *bounds: str, **more: Any) -> Any:
    """Pure number."""
    return quantity(about, "", example, *bounds, **more)


def count(
    about: str, example: str = "3", at_least: str = "1", at_most: str = "1e6", **more: Any
) -> Any:
    """Whole number."""
    return quantity(about, "", example, at_least, at_most, whole=True, **more)


def length(about: str, example: str = "10 m", *bounds: str, **more: Any) -> Any:
    """Length of either sign."""
    return quantity(about, "m", example, *bounds, **more)


def size(about: str, example: str = "10 m", **more: Any) -> Any:
    """Length above 0."""
    return length(about, example, "1 um", **more)


def angle(about: str, example: str = "10 deg", *bounds: str, **more: Any) -> Any:
    """Angle of either sign."""
    return quantity(about, "rad", example, *bounds, **more)


def speed(about: str, **more: Any) -> Any:
    """Speed, not signed."""
    return quantity(about, "m/s", "30 m/s", "0 m/s", **more)


def duration(
    about: str, example: str = "10 s", at_least: str = "0 s", at_most: str = "1e8 s", **more: Any
) -> Any:
    """Time, 0 to some years by default."""
    return quantity(about, "s", example, at_least, at_most, **more)


def frequency(about: str, example: str = "20 Hz") -> Any:
    """Rate above 0."""
    return quantity(about, "Hz", example, "1e-6 Hz", "1e9 Hz")


def several(of: Rule, least: int, most: int, default: Any = ..., **more: Any) -> Any:
    """List of values, each held to the same rule, described by `about`."""
    alias = more.pop("alias", None)
    return field(Several(of=of, least=least, most=most, **more), default, alias=alias)


def vector(about: str, unit: str, example: str, *, of: int = 3, **more: Any) -> Any:
    """Components of a vector of so many dimensions."""
    return several(measure("Component", unit, example), of, of, about=about, **more)


def position(about: str, *, of: int = 3, **more: Any) -> Any:
    """Position in so many dimensions."""
    return vector(about, "m", "10 m", of=of, **more)


def seed(about: str = "Seed of its random numbers") -> Any:
    """Seed, 0 by default."""
    return count(about, "1", "0", "2^63", default=0)


def named(about: str, example: str = "ground") -> Text:
    """Rule of the name of an object or a scanner."""
    return Text(
        about=about,
        example=example,
        pattern=r"[a-z][a-z0-9_]{0,59}",
        remedy="take small letters, digits and '_', such as 'ground'",
    )


def name(about: str, default: Any = ...) -> Any:
    """Name of an object or a scanner."""
    return field(named(about), default)


def text(about: str, default: Any = ..., **more: str) -> Any:
    """Text for people, or of a pattern with a remedy."""
    return field(Text(about=about, **more), default)


def choice(about: str, options: tuple[str, ...], default: Any = ...) -> Any:
    """One of several words."""
    return field(Choice(about=about, options=options), default)


def flag(about: str, *, default: bool) -> Any:
    """Declare a field that is true or false."""
    return field(Flag(about=about), default)


def file(about: str, default: Any = ..., **more: Any) -> Any:
    """Path of a file."""
    return field(File(about=about, **more), default)
