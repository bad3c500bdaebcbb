"""What a surface is made of, and the list that faces refer to."""

from __future__ import annotations

from dataclasses import dataclass

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
