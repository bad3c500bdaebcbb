"""Rules that the parts of a scene share: lengths, angles, positions, seeds."""

from __future__ import annotations

from sweep.spec.list_rules import Several
from sweep.spec.rules import Numeric, Rule, Text


def length(about: str, example: str = "10 m", **bounds: str) -> Numeric:
    """Rule of a length within bounds, any by default."""
    return Numeric(about=about, si_unit="m", example=example, **bounds)  # type: ignore[arg-type]


def size(about: str, example: str = "10 m", **bounds: str) -> Numeric:
    """Rule of a length above 0."""
    return length(about, example, above="0 m", **bounds)


def angle(about: str, example: str = "10 deg", **bounds: str) -> Numeric:
    """Rule of an angle within bounds, any by default."""
    return Numeric(about=about, si_unit="rad", example=example, **bounds)  # type: ignore[arg-type]


def duration(about: str, example: str = "10 s", **bounds: str) -> Numeric:
    """Rule of a time within bounds."""
    return Numeric(about=about, si_unit="s", example=example, **bounds)  # type: ignore[arg-type]


def frequency(about: str, example: str = "20 Hz") -> Numeric:
    """Rule of a rate above 0."""
    return Numeric(about=about, si_unit="Hz", example=example, above="0 Hz")


def number(about: str, example: str = "0.5", **bounds: str) -> Numeric:
    """Rule of a pure number within bounds, any by default."""
    return Numeric(about=about, example=example, **bounds)  # type: ignore[arg-type]


def count(about: str, example: str = "3", at_least: str = "1", at_most: str = "1e6") -> Numeric:
    """Rule of a whole number."""
    return Numeric(
        about=about, example=example, at_least=at_least, at_most=at_most, whole=True
    )  # fmt: skip


def vector(about: str, si_unit: str, example: str, dimensions: int = 3) -> Several:
    """Rule of a vector's components."""
    component = Numeric(about="Component", si_unit=si_unit, example=example)
    return Several(about=about, of=component, least=dimensions, most=dimensions)


def position(about: str, dimensions: int = 3) -> Several:
    """Rule of a position."""
    return vector(about, "m", "10 m", dimensions)


def seed(about: str = "Seed of its random numbers") -> Numeric:
    """Rule of a seed."""
    return count(about, example="1", at_least="0", at_most="2^63")


def name(about: str) -> Rule:
    """Rule of the name of an object or a scanner."""
    return Text(
        about=about,
        pattern=r"[a-z][a-z0-9_]{0,59}",
        remedy="take small letters, digits and '_', such as 'ground'",
    )
