"""Rules that the parts of a scene share: lengths, angles, positions, seeds."""

from __future__ import annotations

from sweep.spec.list_rules import Several
from sweep.spec.rules import Numeric, Rule, Text

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


def signed(about: str, si_unit: str, example: str, **bounds: str) -> Numeric:
    """Rule of a quantity of either sign within bounds, wide ones by default."""
    most = _EITHER_WAY[si_unit]
    bounds = {"at_least": f"-{most}", "at_most": most} | bounds
    return Numeric(about=about, si_unit=si_unit, example=example, **bounds)  # type: ignore[arg-type]


def length(about: str, example: str = "10 m", **bounds: str) -> Numeric:
    """Rule of a length within bounds, wide ones by default."""
    return signed(about, "m", example, **bounds)


def size(about: str, example: str = "10 m", **bounds: str) -> Numeric:
    """Rule of a length above 0."""
    return length(about, example, **({"at_least": "1 um"} | bounds))


def angle(about: str, example: str = "10 deg", **bounds: str) -> Numeric:
    """Rule of an angle within bounds, wide ones by default."""
    return signed(about, "rad", example, **bounds)


def speed(about: str, example: str = "30 m/s") -> Numeric:
    """Rule of a speed."""
    return signed(about, "m/s", example, at_least="0 m/s")


def duration(about: str, example: str = "10 s", **bounds: str) -> Numeric:
    """Rule of a time within bounds, 0 to some years by default."""
    bounds = {"at_least": "0 s", "at_most": "1e8 s"} | bounds
    return Numeric(about=about, si_unit="s", example=example, **bounds)  # type: ignore[arg-type]


def frequency(about: str, example: str = "20 Hz") -> Numeric:
    """Rule of a rate above 0."""
    return Numeric(
        about=about, si_unit="Hz", example=example, at_least="1e-6 Hz", at_most="1e9 Hz"
    )  # fmt: skip


def number(about: str, example: str = "0.5", **bounds: str) -> Numeric:
    """Rule of a pure number within bounds, wide ones by default."""
    return signed(about, "", example, **bounds)


def count(about: str, example: str = "3", at_least: str = "1", at_most: str = "1e6") -> Numeric:
    """Rule of a whole number."""
    return Numeric(
        about=about, example=example, at_least=at_least, at_most=at_most, whole=True
    )  # fmt: skip


def vector(about: str, si_unit: str, example: str, dimensions: int = 3) -> Several:
    """Rule of a vector's components."""
    component = signed("Component", si_unit, example)
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
