"""What a surface is made of, and the list that faces refer to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.model.geometry.facets import Facets, join
from sweep.model.reflectance import LAWS


@dataclass(frozen=True)
class Surface:
    """Optical properties of one kind of surface.

    Parameters
    ----------
    name : str
        What it is called in a study.
    reflectance : float
        What its law takes as such, 0..1.
    law : str
        Reflectance law, one of :data:`sweep.model.reflectance.LAWS`.
    roughness : float
        Standard deviation of the height within a beamlet's spot [m], >= 0: against the
        wavelength it decides on speckle.
    """

    name: str
    reflectance: float
    law: str = "lambert"
    roughness: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.reflectance <= 1:
            raise ValueError(f"{self.name}: the reflectance must lie within 0 and 1")
        if self.law not in LAWS:
            laws = ", ".join(LAWS)
            raise ValueError(f"{self.name}: no reflectance law {self.law!r}: choose from {laws}")
        if not self.roughness >= 0:
            raise ValueError(f"{self.name}: the roughness must be at least 0 m")


def assemble(
    objects: Sequence[tuple[Facets, Surface | Sequence[Surface]]],
) -> tuple[Facets, tuple[Surface, ...]]:
    """Objects with their surfaces as one set of facets with one list of surfaces.

    Parameters
    ----------
    objects : sequence of (Facets, Surface or sequence of Surface)
        Facets, and the surfaces that their indices count.

    Returns
    -------
    facets : Facets
        All facets, relative to the first object's origin.
    surfaces : tuple of Surface
        What their indices count now; equal surfaces share one.

    Raises
    ------
    ValueError
        Where a face has no surface, or two different surfaces share a name.
    """
    known: dict[Surface, int] = {}
    parts = []
    for facets, given in objects:
        own = (given,) if isinstance(given, Surface) else tuple(given)
        if len(facets.surface) and not 0 <= facets.surface.min() <= facets.surface.max() < len(own):
            raise ValueError(f"faces refer to surfaces beyond the {len(own)} given")
        numbers = [known.setdefault(surface, len(known)) for surface in own]
        parts.append(_renumbered(facets, numbers))
    names = [surface.name for surface in known]
    if len(set(names)) < len(names):
        raise ValueError(f"two different surfaces share a name: {sorted(names)}")
    return join(parts), tuple(known)


def _renumbered(facets: Facets, numbers: Sequence[int]) -> Facets:
    surface = np.asarray(numbers, np.int16)[facets.surface]
    return Facets(facets.vertices, facets.faces, surface, facets.origin)
