"""Size-frequency laws: how many craters or boulders of a size or larger lie on an area."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import exp1


class Law(Protocol):
    """Cumulative number per area and its inverse."""

    def cumulative(self, diameter: np.ndarray) -> np.ndarray:
        """Number per area of this diameter or larger [1/m^2]."""
        ...

    def diameter(self, number: np.ndarray) -> np.ndarray:
        """Diameter [m] which `number` per area [1/m^2] reach or exceed."""
        ...


@dataclass(frozen=True)
class PowerLaws:
    """The least of several power laws ``N(>D) = coefficient * D**-exponent``.

    Parameters
    ----------
    laws : tuple of (coefficient, exponent)
        Coefficient in SI (number per m^2 at 1 m) and exponent, both > 0.
    """

    laws: tuple[tuple[float, float], ...]

    def cumulative(self, diameter: np.ndarray) -> np.ndarray:
        """Number per area of this diameter or larger [1/m^2]."""
        d = np.asarray(diameter, float)
        return np.min([c * d**-b for c, b in self.laws], axis=0)

    def diameter(self, number: np.ndarray) -> np.ndarray:
        """Diameter [m] which `number` per area [1/m^2] reach or exceed."""
        n = np.asarray(number, float)
        return np.min([(c / n) ** (1 / b) for c, b in self.laws], axis=0)


TRASK = (10**-1.1, 2.0)
"""Lunar craters in equilibrium: ``N = 10**10.9 D**-2`` per 10^6 km^2, D in metres.

Trask, in Ranger VIII and IX, part II, JPL Technical Report 32-800 (1966), restated per m^2.
"""

PRODUCTION_EXPONENT = 2.8
"""Exponent of young craters of 1 to 100 m, which have not yet worn each other down.

Moore, Boyce and Hahn, The Moon and the Planets 23, 231 (1980): "near 2.8".
"""


def lunar_craters(*, equilibrium_diameter: float = math.inf) -> PowerLaws:
    """Craters in equilibrium up to a diameter, and as they were produced beyond it.

    Parameters
    ----------
    equilibrium_diameter : float
        Diameter [m] at which the two laws cross, > 0; it grows with the age of the ground.
    """
    if math.isinf(equilibrium_diameter):
        return PowerLaws((TRASK,))
    coefficient = TRASK[0] * equilibrium_diameter ** (PRODUCTION_EXPONENT - TRASK[1])
    return PowerLaws((TRASK, (coefficient, PRODUCTION_EXPONENT)))


@dataclass(frozen=True)
class MartianRocks:
    """Rocks of the Martian plains, by their cumulative fractional area.

    ``F(D) = k exp(-q D)``, ``q = 1.79 + 0.152/k`` with D in metres (Golombek and Rapp, J. Geophys.
    Res. 102, 4117, 1997); each rock covers ``pi D^2 / 4``, so that the number per area is
    ``N(>D) = (4 k q / pi) (exp(-q D)/D - q E1(q D))``.

    Parameters
    ----------
    cover : float
        k: fraction of the ground covered by rocks of any size, 0 < k < 1; 0.02 to 0.2 at the
        landing sites.
    """

    cover: float

    def __post_init__(self) -> None:
        if not 0 < self.cover < 1:
            raise ValueError(f"the rocks' cover must lie between 0 and 1, not {self.cover}")

    @property
    def decay(self) -> float:
        """Decay of the area with the diameter, q [1/m]."""
        return 1.79 + 0.152 / self.cover

    def area_fraction(self, diameter: np.ndarray) -> np.ndarray:
        """Fraction of the ground under rocks of this diameter or larger [1]."""
        return np.asarray(self.cover * np.exp(-self.decay * np.asarray(diameter, float)))

    def cumulative(self, diameter: np.ndarray) -> np.ndarray:
        """Number per area of this diameter or larger [1/m^2]."""
        d = np.asarray(diameter, float)
        q = self.decay
        return np.asarray(4 * self.cover * q / math.pi * (np.exp(-q * d) / d - q * exp1(q * d)))

    def diameter(self, number: np.ndarray) -> np.ndarray:
        """Diameter [m] which `number` per area [1/m^2] reach or exceed."""
        n = np.asarray(number, float)
        scale = 4 * self.cover * self.decay / math.pi
        wanted = np.log(n)
        # N(>D) > scale exp(-q D) / (D (q D + 2)), which puts this start below the root; and log N
        # is convex in D, so that Newton's steps approach the root from there without passing it.
        d = np.minimum(scale / (3 * math.e * n), 1 / self.decay)
        for _ in range(100):
            value = self.cumulative(d)
            step = (np.log(value) - wanted) * value * d**2 / (scale * np.exp(-self.decay * d))
            d = d + step
            if (np.abs(step) <= 1e-13 * d).all():
                break
        return np.asarray(d)


def scatter(
    generator: np.random.Generator,
    law: Law,
    *,
    bounds: tuple[float, float, float, float],
    smallest: float,
    largest: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Independent places and diameters on a rectangle, in falling order of diameter.

    The number is Poisson with the law's mean; places are uniform.

    Parameters
    ----------
    generator : numpy.random.Generator
        Source of randomness.
    law : Law
        Size-frequency law.
    bounds : (x least, y least, x largest, y largest) of float
        The rectangle [m].
    smallest, largest : float
        Diameters within which the law is drawn [m], 0 < smallest < largest.

    Returns
    -------
    x, y : (n,) ndarray
        Places [m].
    diameter : (n,) ndarray
        Diameters [m].

    Raises
    ------
    ValueError
        For an empty rectangle or range of diameters, or more than 5 million of them.
    """
    west, south, east, north = bounds
    if not (0 < smallest < largest and west < east and south < north):
        raise ValueError("a size-frequency law needs 0 < smallest < largest and an area")
    most, least = law.cumulative(np.array([smallest, largest]))
    mean = (most - least) * (east - west) * (north - south)
    if mean > 5e6:
        raise ValueError(f"{mean:.2g} objects are too many: raise the smallest diameter")
    number = generator.poisson(mean)
    x = generator.uniform(west, east, number)
    y = generator.uniform(south, north, number)
    diameter = law.diameter(generator.uniform(least, most, number))
    order = np.argsort(-diameter, kind="stable")
    return x[order], y[order], diameter[order]
