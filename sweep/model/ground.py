"""What a beam meets: a flat plane, or whatever rays have found; as one line or as beamlets."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sweep.model import footprint, reflectance
from sweep.model.constants import SPEED_OF_LIGHT


class Footprints(NamedTuple):
    """Where beamlets fall and what they send back, in rows that points share."""

    row: np.ndarray
    """(n,) int64: the row of each point."""
    offset: np.ndarray
    """(rows, beamlets): (R_b - R_0) / R_0."""
    doppler: np.ndarray
    """(rows, beamlets): beta_b - beta_0, beta = 2 v_r / c."""
    echo: np.ndarray
    """(rows, beamlets): power fraction x backscatter [1/sr] x (R_0/R_b)^2, for reflectance 1."""


class Plane:
    """A flat plane, for points of one category.

    Parameters
    ----------
    p : mapping
        Parameters as arrays, of :func:`sweep.model.preparation.categories`.
    size : int
        Points n.
    moving : bool
        Whether beamlets see velocities of their own. Where not, points that differ in velocity
        alone share their rows.
    """

    beside = None

    def __init__(self, p: Mapping[str, np.ndarray], size: int, *, moving: bool = True) -> None:
        self._law = str(p["target.reflectance_law"])
        self._number = int(p["footprint.beamlets"])
        self._pattern = pattern(p)
        columns = np.broadcast_arrays(
            p["target.grazing_angle"],
            p["instrument.laser.beam_divergence"],
            p["target.radial_velocity"] if moving else 0.0,
            p["target.transverse_velocity"] if moving else 0.0,
        )
        self._columns, self._size = [np.atleast_1d(column) for column in columns], size

    def axis(self, size: int) -> Footprints:
        """One line for each point: a row for each distinct grazing angle."""
        angles, row = np.unique(self._columns[0], return_inverse=True)
        echo = reflectance.backscatter(self._law, np.sin(angles))[:, None]
        nothing = np.zeros_like(echo)
        return Footprints(_rows(row, size), nothing, nothing, echo)

    @cached_property
    def beamlets(self) -> Footprints:
        """The whole footprint: a row for each distinct geometry."""
        shapes, row = np.unique(np.stack(self._columns), axis=1, return_inverse=True)
        offset, cos_incidence, weights = footprint.plane_footprint(
            grazing_angle=shapes[0],
            beam_divergence=shapes[1],
            number=self._number,
            pattern=self._pattern,
        )
        echo = weights * reflectance.backscatter(self._law, cos_incidence) / (1 + offset) ** 2
        closing = footprint.velocity_offsets(
            radial=shapes[2], transverse=shapes[3], beam_divergence=shapes[1],
            number=self._number, pattern=self._pattern,
        )  # fmt: skip
        doppler = np.where(weights > 0, 2 * closing / SPEED_OF_LIGHT, 0.0)
        return Footprints(_rows(row, self._size), offset, doppler, echo)


class Cast:
    """Footprints that rays have found.

    Parameters
    ----------
    footprints : Footprints
        Of the n points.
    beside : (rows, beamlets) bool ndarray, optional
        Beamlets that lie on another surface than the beam's axis.
    """

    def __init__(self, footprints: Footprints, beside: np.ndarray | None = None) -> None:
        self.beamlets, self.beside = footprints, beside

    def axis(self, size: int) -> Footprints:
        """One line for each point, with the echo of all its beamlets."""
        whole = self.beamlets.echo.sum(axis=1)[:, None]
        nothing = np.zeros_like(whole)
        return Footprints(self.beamlets.row, nothing, nothing, whole)


Ground = Plane | Cast
"""What n points' beams meet."""


def powers_add(p: Mapping[str, Any]) -> bool:
    """Whether the beamlets of points of one category add as powers."""
    incoherent = str(p["footprint.phases"]) == "incoherent"
    return incoherent and str(p["instrument.receiver.architecture"]) != "direct"


def pattern(p: Mapping[str, Any]) -> str:
    """Arrangement of the beamlets: as chosen, or hexagonal where powers add, else unsymmetric."""
    chosen = str(p["footprint.pattern"])
    if chosen != "auto":
        return chosen
    return "hexagonal" if powers_add(p) else "sunflower"


def _rows(row: np.ndarray, size: int) -> np.ndarray:
    return np.broadcast_to(row.ravel(), size).astype(np.int64)
