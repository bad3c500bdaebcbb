"""Ground that a beam meets: a flat plane, or whatever rays have found; as one line or as beamlets.

Reflectance laws: a surface of bidirectional reflectance f [1/sr] that fills a beam of power P at
incidence i sends the intensity f P cos(i) [W/sr] back along it. The beam spreads over 1/cos(i) of
its cross-section and the patch, seen from the beam, shrinks to cos(i) of itself again. So Lambert's
f = rho/pi gives rho cos(i)/pi.

Lommel and Seeliger's law is that of dark, porous ground (regolith), where light that has been
scattered once outshines all other [Hapke 1981; 2012, ch. 10]:

    f = w / (4 pi) / (cos i + cos e) * p(g) (1 + B(g))

with the single-scattering albedo w, the phase function p and the opposition surge B of shadows
that hide behind their grains. A lidar looks at the phase angle g = 0 and i = e, where f cos(i) is
w p(0) (1 + B(0)) / (8 pi) whatever the incidence. A ball of it shines as evenly as the full Moon.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sweep.model import beam, footprint
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.footprint import Moments

LAWS = ("thesis", "lambert", "lommel_seeliger")


def backscatter(law: str, cos_incidence: np.ndarray) -> np.ndarray:
    """Backscattered fraction per steradian of a surface of reflectance 1 [1/sr].

    ``thesis`` is the diffuse law of [T 4.4], 1/(2 pi) whatever the incidence, ``lambert``
    cos(incidence)/pi, ``lommel_seeliger`` 1/pi whatever the incidence. Its reflectance is the
    normal albedo w p(0) (1 + B(0)) / 8 (single-scattering albedo, phase function, opposition
    surge), which at normal incidence is what Lambert's law means by it.
    """
    if law == "thesis":
        return np.full_like(cos_incidence, 0.5 / math.pi)
    if law == "lambert":
        return cos_incidence / math.pi
    return np.full_like(cos_incidence, 1 / math.pi)


class Footprints(NamedTuple):
    """Places and echoes of beamlets, in rows that points share."""

    row: np.ndarray
    """(n,) int64: the row of each point."""
    offset: np.ndarray
    """(rows, beamlets): (R_b - R_0) / R_0."""
    doppler: np.ndarray
    """(rows, beamlets): beta_b - beta_0, beta = 2 v_r / c."""
    echo: np.ndarray
    """(rows, beamlets): power fraction x backscatter [1/sr] x (R_0/R_b)^2, for reflectance 1."""


class Slopes(NamedTuple):
    """Changes across a beam for one of its standard deviations, (n,) each."""

    beta: np.ndarray
    """Of the Doppler ratio 2 v_r / c."""
    range: np.ndarray
    """Of the range over that on the axis."""
    echo: np.ndarray
    """Of the echo power over that on the axis."""


class Plane:
    """A flat plane, for `size` points of one category, parameters as arrays.

    If beamlets see no velocities of their own (`moving`), points that differ in velocity alone
    share their rows.
    """

    beside = None

    def __init__(self, p: Mapping[str, np.ndarray], size: int, *, moving: bool = True) -> None:
        self._law = str(p["target.reflectance_law"])
        self._number = int(p["footprint.beamlets"])
        self._pattern = pattern(p)
        places, directions = beam.angles(p)
        names = "target.radial_velocity", "target.transverse_velocity"
        velocities = [p[name] if moving else 0.0 for name in names]
        further = () if beam.is_thesis(p) else (directions, *beam.dimming(p))
        columns = np.broadcast_arrays(p["target.grazing_angle"], places, *velocities, *further)
        self._columns, self._size = [np.atleast_1d(column) for column in columns], size

    def mean_phasor(self, turn: np.ndarray, delay_cycles: np.ndarray) -> np.ndarray:
        """Mean of exp(2 pi i (turn dbeta - delay_cycles dR / R)) over the beam, (n,) complex.

        Parameters
        ----------
        turn
            Cycles per unit of Doppler ratio, (n,) or scalar; dbeta is beta_b - beta_0.
        delay_cycles
            Cycles per unit of relative range, (n,) or scalar; dR / R is (R_b - R_0) / R_0.

        Notes
        -----
        To second order a beamlet x across and y along the slope, in standard deviations, has the
        phase t y + c (x^2 + y^2), and its echo goes as 1 + k y. With Gaussian x and y the mean is

            (1 + i k t / (1 - 2 i c)) exp(-t^2 / 2 / (1 - 2 i c)) / (1 - 2 i c)
        """
        _, _, radial, _, *further = self._columns
        slopes = self.slopes
        sigma = (further[0] if further else self._columns[1]) / 4
        phase = (4 * np.pi / SPEED_OF_LIGHT) * np.asarray(turn, float)  # by 1 m/s
        t = 2 * np.pi * (np.asarray(turn, float) * slopes.beta - delay_cycles * slopes.range)
        curve = phase * radial * sigma**2
        curve = curve + 2 * np.pi * np.asarray(delay_cycles, float) * (self._columns[1] / 4) ** 2
        bent = 1 / (1 + 1j * curve)
        mean = (1 + 1j * slopes.echo * t * bent) * np.exp(-0.5 * t * t * bent) * bent
        return np.asarray(mean + np.zeros(self._size))

    @property
    def slopes(self) -> "Slopes":
        """Changes for a standard deviation of the beam towards the near side, (n,) each."""
        angle, places, _, transverse, *further = self._columns
        lean = (places / 4) / np.tan(angle)
        sigma = (further[0] if further else places) / 4
        power = 3 if self._law == "lambert" else 2
        columns = 2 / SPEED_OF_LIGHT * transverse * sigma, -lean, power * lean
        return Slopes(*(np.broadcast_to(column, self._size) for column in columns))

    def axis(self, size: int) -> Footprints:
        """One line for each point: a row for each distinct grazing angle."""
        angles, row = np.unique(self._columns[0], return_inverse=True)
        echo = backscatter(self._law, np.sin(angles))[:, None]
        nothing = np.zeros_like(echo)
        return Footprints(_rows(row, size), nothing, nothing, echo)

    @cached_property
    def beamlets(self) -> Footprints:
        """The whole footprint: a row for each distinct geometry."""
        first, row = different_rows(self._columns)
        shapes = np.stack(self._columns)[:, first]
        offset, cos_incidence, weights, closing = footprint.plane_footprint(
            grazing_angle=shapes[0],
            beam_divergence=shapes[1],
            number=self._number,
            pattern=self._pattern,
            radial=shapes[2],
            transverse=shapes[3],
            directions=shapes[4] if len(shapes) > 4 else None,
        )
        loss = (1 + offset) ** 2
        if len(shapes) > 4:
            first, second = shapes[5:, :, None]
            loss = 1 + offset * (first + offset * second)
        echo = weights * backscatter(self._law, cos_incidence) / loss
        doppler = np.where(weights > 0, 2 * closing / SPEED_OF_LIGHT, 0.0)
        return Footprints(_rows(row, self._size), offset, doppler, echo)


class Cast:
    """Footprints that rays have found; `beside` (rows, beamlets): not on the axis's surface."""

    def __init__(self, footprints: Footprints, beside: np.ndarray | None = None) -> None:
        self.beamlets, self.beside = footprints, beside

    def axis(self, size: int) -> Footprints:
        """One line for each point, with the echo of all its beamlets."""
        whole = self.beamlets.echo.sum(axis=1)[:, None]
        nothing = np.zeros_like(whole)
        return Footprints(self.beamlets.row, nothing, nothing, whole)


Ground = Plane | Cast
"""Ground that the beams of n points meet."""


def powers_add(p: Mapping[str, Any]) -> bool:
    """Return true if the beamlets of points of one category add as powers."""
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


class Extent(NamedTuple):
    """A footprint and the line on its axis, by point."""

    echo: np.ndarray
    """Of the bare line, for a reflectance of 1 [1/sr]."""
    echo_ratio: np.ndarray | float
    """Echo of all beamlets over that of the bare line."""
    ranges: Moments
    """Of (R_b - R_0) / R_0."""
    own_ranges: Moments
    """Likewise, of the beamlets on the axis's surface only."""
    velocities: Moments
    """Of the beamlets' radial velocities less the axis's [m/s]."""
    gain: np.ndarray | float = 1.0
    """Most that all beamlets' amplitudes make over the bare line's: all in phase, or as powers."""
    beside: np.ndarray | float = 0.0
    """Share of the echo that comes from other surfaces than the axis's, 0..1."""
    apart: np.ndarray | float = 0.0
    """Largest |R_b - R_0| / R_0 there."""


def of_rays(cast: Cast) -> Extent:
    """Footprints that rays have found."""
    _, offset, doppler, echo = cast.beamlets
    beside = cast.beside
    whole = echo.sum(axis=1)
    share = echo / np.where(whole > 0, whole, 1.0)[:, None]
    ranges = _moments(offset, share)
    moved = _moments(doppler, share).times(np.asarray(SPEED_OF_LIGHT / 2))
    gain = np.sqrt(share).sum(axis=1)
    if beside is None or not beside.any():
        return Extent(whole, 1.0, ranges, ranges, moved, gain)
    other = np.where(beside, share, 0.0)
    own = share - other
    rest = own.sum(axis=1)
    own_ranges = _moments(offset, own / np.where(rest > 0, rest, 1.0)[:, None])
    apart = np.where(other > 0, np.abs(offset), 0.0).max(axis=1)
    return Extent(whole, 1.0, ranges, own_ranges, moved, gain, other.sum(axis=1), apart)


def _moments(values: np.ndarray, weight: np.ndarray) -> Moments:
    weighted = weight * values
    extreme = np.where(weight > 0, np.abs(values), 0.0).max(axis=1)
    return Moments(np.abs(weighted.sum(axis=1)), np.sqrt((weighted * values).sum(axis=1)), extreme)


def different_rows(columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Find the distinct rows of columns: a row of each kind (kinds,), and each row's kind (n,)."""
    order = np.lexsort(columns)
    rows = np.stack(columns)[:, order]
    is_new = np.append(True, (rows[:, 1:] != rows[:, :-1]).any(axis=0))
    kind = np.empty(order.size, np.int64)
    kind[order] = np.cumsum(is_new) - 1
    return order[is_new], kind
