"""Gaussian beams between telescope and target, and what a receiver of one mode collects of an echo.

A coherent receiver sees one spatial mode: light mixes as far as it lies in the mode of the local
oscillator, carried back through the telescope to the target. A diffuse surface sends the radiance
rho_pi P I_T back, and a mode collects lambda^2 of a radiance wherever it is seen (Siegman, Appl.
Opt. 5, 1966, 1588), so that of the power P_tx

    P_sig = P_tx tau_o rho_pi lambda^2  integral of I_T I_L d^2x

with the irradiances I_T of the sent beam and I_L of the local oscillator, each of unit power. This
module gives the integral as the area of an aperture that would collect as much: lambda^2 R^2 times
it takes the place of A in A / R^2. Gaussian beams of 1/e^2 radii w_T and w_L, with their axes d
apart, have

    integral = 2 / (pi (w_T^2 + w_L^2)) exp(-2 d^2 / (w_T^2 + w_L^2))

and the light that counts lies within w_T w_L / sqrt(w_T^2 + w_L^2): what lies at the rim of one of
two equal beams counts by its square, and the footprint is narrower by sqrt(2).

Two laws (``instrument.telescope.coupling``): ``single_mode`` is this one; ``aperture`` is that of
[T 4.4], where all light in the aperture mixes, as it always does in direct detection. A ray stands
for the light of a place, and for a direction. Near the telescope and near a focus the two spread
unlike. Ranges follow places, w(R) / R. Doppler shifts follow directions, which spread at every
range as they do far away.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import j0

from sweep.model.constants import SPEED_OF_LIGHT

if TYPE_CHECKING:
    from scipy.interpolate import RectBivariateSpline

SINGLE_MODE, APERTURE = COUPLINGS = "single_mode", "aperture"

COUPLING = "instrument.telescope.coupling"
DIAMETER = "instrument.telescope.aperture"
WAVELENGTH = "instrument.laser.wavelength"
DIVERGENCE = "instrument.laser.beam_divergence"
WAIST = "instrument.laser.beam_waist"
QUALITY = "instrument.laser.beam_quality"
FOCUS = "instrument.laser.focus"
RECEIVED_WAIST = "instrument.receiver.local_oscillator_waist"
ARCHITECTURE = "instrument.receiver.architecture"
SCAN_RATE, SEPARATION, MISALIGNMENT = (
    f"instrument.telescope.{name}" for name in ("scan_rate", "separation", "misalignment")
)

DEFAULTS: dict[str, float | str] = {
    COUPLING: SINGLE_MODE, DIVERGENCE: 0.0, WAIST: 0.0, QUALITY: 1.0, FOCUS: 0.0,
    RECEIVED_WAIST: 0.0,
}  # fmt: skip
"""Defaults of a beam's parameters; 0: not given, collimated, or as the sent one."""

WIDEST = math.pi / 2
"""Full angle [rad] beyond which a footprint is taken to be no wider."""

Parameters = Mapping[str, Any]


class Beam(NamedTuple):
    """Gaussian beam at its telescope; SI, arrays that broadcast.

    >>> beam = Beam.of(waist=1.31e-3, wavelength=1310e-9)
    >>> f"{beam.rayleigh_range:.1f} m, {1e6 * beam.angle(math.inf):.0f} urad"
    '4.1 m, 637 urad'
    """

    waist: np.ndarray
    """1/e^2 radius at the telescope, w_a [m]."""
    rayleigh_range: np.ndarray
    """z_R = pi w_a^2 / (M^2 lambda) [m]."""
    curvature: np.ndarray | float = 0.0
    """1 / f, of the distance at which it is focused [1/m]; 0 for a collimated beam."""

    @classmethod
    def of(
        cls,
        *,
        waist: ArrayLike,
        wavelength: ArrayLike,
        quality: ArrayLike = 1.0,
        focus: ArrayLike = 0.0,
    ) -> "Beam":
        """Beam of a waist w_a [m], wavelength [m], quality M^2, and focus [m], 0 for collimated."""
        w, f = np.asarray(waist, float), np.asarray(focus, float)
        curvature = np.where(f > 0, 1 / np.where(f > 0, f, 1.0), 0.0)
        return cls(w, np.asarray(math.pi * w**2 / (np.asarray(quality) * wavelength)), curvature)

    def angle(self, range: ArrayLike) -> np.ndarray:
        """Full angle 2 w(R) / R [rad] at ranges above 0, infinity included.

        w(R)^2 = w_a^2 ((1 - R/f)^2 + (R/z_R)^2).
        """
        away = 1 / np.asarray(range, float) - self.curvature
        return np.asarray(2 * self.waist * np.hypot(away, 1 / self.rayleigh_range))

    def radius(self, range: ArrayLike) -> np.ndarray:
        """1/e^2 radius w(R) [m] at ranges above 0."""
        return self.angle(range) * np.asarray(range, float) / 2


def is_single_mode(p: Parameters) -> bool:
    """Return true where the receiver of points of one category sees a single mode."""
    return str(p[COUPLING]) == SINGLE_MODE and str(p[ARCHITECTURE]) != "direct"


def divergence_of(waist: ArrayLike, wavelength: ArrayLike, quality: ArrayLike = 1.0) -> np.ndarray:
    """Full far-field angle 2 M^2 lambda / (pi w_a) [rad] of a collimated beam; or w_a from that."""
    return np.asarray(2 * np.asarray(quality) * wavelength / (math.pi * np.asarray(waist)))


def divergence(p: Parameters) -> np.ndarray:
    """Full angle of the sent beam far away, unless it is focused [rad]."""
    given, waist = np.asarray(p[DIVERGENCE], float), np.asarray(p[WAIST], float)
    if not waist.any():
        return given
    own = divergence_of(np.where(waist > 0, waist, 1.0), p[WAVELENGTH], p[QUALITY])
    return np.where(waist > 0, own, given)


def beams(p: Parameters) -> tuple[Beam, Beam]:
    """Return the sent beam and, with M^2 = 1, the local oscillator's at the target.

    The local oscillator's waist at the telescope is that of the sent beam by default.
    """
    waist, received = np.asarray(p[WAIST], float), np.asarray(p[RECEIVED_WAIST], float)
    angle = np.asarray(p[DIVERGENCE], float)
    own = divergence_of(np.where(angle > 0, angle, 1.0), p[WAVELENGTH], p[QUALITY])
    waist = np.where(waist > 0, waist, own)
    light = {"wavelength": p[WAVELENGTH], "focus": p[FOCUS]}
    sent = Beam.of(waist=waist, quality=p[QUALITY], **light)
    return sent, Beam.of(waist=np.where(received > 0, received, waist), **light)


class Angles(NamedTuple):
    """Full 1/e^2 angles of the light that counts, as seen from the instrument [rad]."""

    places: np.ndarray
    """Of the places where it meets the target."""
    directions: np.ndarray
    """Of the directions that it has there."""


def angles(p: Parameters, range: ArrayLike | None = None) -> Angles:
    """Angles of the footprint of points of one category, at `range` or ``target.range`` [m]."""
    if is_thesis(p):
        given = np.asarray(p[DIVERGENCE], float)
        return Angles(given, given)
    far = np.asarray(p["target.range"] if range is None else range, float)
    sent, received = beams(p)
    if is_single_mode(p):
        pairs = ((sent.angle(r), received.angle(r)) for r in (far, math.inf))
        return Angles(*(np.minimum(a * b / np.hypot(a, b), WIDEST) for a, b in pairs))
    plain = (np.asarray(p[WAIST]) == 0) & (np.asarray(p[FOCUS]) == 0)
    own = (np.minimum(sent.angle(r), WIDEST) for r in (far, math.inf))
    return Angles(*(np.where(plain, p[DIVERGENCE], angle) for angle in own))


def shape(p: Parameters) -> dict[str, Any]:
    """Parameters that say how wide a beam is at each range."""
    paths = (WAVELENGTH, DIVERGENCE, WAIST, QUALITY, FOCUS, RECEIVED_WAIST)
    return {path: p[path] for path in paths} | {COUPLING: is_single_mode(p)}


def is_thesis(p: Parameters) -> bool:
    """Return true where every footprint is as wide as divergence times range, [T]'s law."""
    return not (is_single_mode(p) or np.any(p[WAIST]) or np.any(p[FOCUS]))


def dimming(p: Parameters, range: ArrayLike | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (b, c) of 1 + b x + c x^2, by which a place at R (1 + x) has less than one at R.

    The light in the aperture falls by (1 + x)^2; of one mode, w_T^2 + w_L^2 says how far.
    """
    if not is_single_mode(p):
        return np.asarray(2.0), np.asarray(1.0)
    far = np.asarray(p["target.range"] if range is None else range, float)
    both = [np.asarray(0.0)] * 3
    for beam in beams(p):
        square, bent = beam.waist**2, beam.curvature * far
        steep = bent**2 + (far / beam.rayleigh_range) ** 2
        parts = 1 - 2 * bent + steep, 2 * (steep - bent), steep
        both = [total + square * part for total, part in zip(both, parts, strict=True)]
    return both[1] / both[0], both[2] / both[0]


def collecting_area(p: Parameters) -> np.ndarray:
    """Area [m^2] that collects, at ``target.range``, as much of a diffuse echo as mixes.

    The aperture's, or lambda^2 R^2 times the integral of I_T I_L, of beams that the aperture cuts.
    """
    diameter = np.asarray(p[DIAMETER])
    if not is_single_mode(p):
        return math.pi * (diameter / 2) ** 2
    sent, received = beams(p)
    far = np.asarray(p["target.range"], float)
    both = sent.angle(far) ** 2 + received.angle(far) ** 2
    area = 8 * np.asarray(p[WAVELENGTH]) ** 2 / (math.pi * both)
    defocus = math.pi * (diameter / 2) ** 2 / p[WAVELENGTH] * (1 / far - sent.curvature)
    left = truncation(2 * sent.waist / diameter, defocus)
    if np.any(p[RECEIVED_WAIST]):
        left = np.sqrt(left * truncation(2 * received.waist / diameter, defocus))
    return np.asarray(area * left)


def receiving_field(p: Parameters) -> tuple[np.ndarray, np.ndarray]:
    """Diameter [m] and full angle [rad] that light from elsewhere than the target passes.

    Of one mode, that of the local oscillator's beam, whose area times solid angle is lambda^2.
    """
    if not is_single_mode(p):
        return np.asarray(p[DIAMETER], float), divergence(p)
    received = beams(p)[1].waist
    return 2 * received, divergence_of(received, p[WAVELENGTH])


def offset(p: Parameters, range: ArrayLike) -> np.ndarray:
    """Distance [m] between the axes of sent and received beam at a range [m], in one plane.

    A scan has turned by omega 2R/c until the light is back; a bistatic pair's axes are apart at the
    instrument already; axes that are not parallel part with range, or meet, where signs differ.
    """
    far = np.asarray(range, float)
    turned = np.asarray(p[SCAN_RATE]) * (2 / SPEED_OF_LIGHT) * far + p[MISALIGNMENT]
    return np.asarray(turned * far + p[SEPARATION])


def offset_loss(p: Parameters, range: ArrayLike) -> np.ndarray:
    """Share of a single mode's echo that is left with the axes :func:`offset` apart, 0..1."""
    both = sum(beam.radius(range) ** 2 for beam in beams(p))
    return np.asarray(np.exp(-2 * offset(p, range) ** 2 / both))


_LEAST_CUT = 0.25
"""w_a over the aperture's radius up to which 5e-7 of the echo is cut off, or less."""
_DEFOCUS = 4.0
"""Phase [rad] at the rim that lies in the middle of the table."""
_NEAREST = 60.0
"""Largest phase of the table; nearer by, within 2 % of it, all is as there."""


def truncation(fill: ArrayLike, defocus: ArrayLike = 0.0) -> np.ndarray:
    """Echo of a beam that its aperture cuts off, sent and received, over that of the whole beam.

    The light cut off is lost, and the rest spreads. Far away, or in focus, 0.63 of the echo is
    left at w_a = 0.8 a, which makes 0.40 A / R^2, the most that any Gaussian beam has (Rye and
    Frehlich, Appl. Opt. 31, 1992, 2891). Near the telescope the beam's middle is as it was. Beams
    of unequal radii take the geometric mean of two. `fill` is w_a / a, 1/e^2 radius over the
    aperture's radius, up to 1; `defocus` the phase [rad] at the rim, pi a^2 / lambda (1/R - 1/f).

    >>> f"{0.8**2 * truncation(0.8):.2f}"
    '0.40'
    """
    fill, rim = np.broadcast_arrays(np.asarray(fill, float), np.abs(np.asarray(defocus, float)))
    if not (fill > _LEAST_CUT).any():
        return np.ones(fill.shape)
    rim = np.minimum(rim, _NEAREST)
    left = _truncations().ev(np.minimum(fill, 1.0), 1 / (1 + rim / _DEFOCUS))
    return np.where(fill > _LEAST_CUT, left, 1.0)


@lru_cache(maxsize=1)
def _truncations() -> "RectBivariateSpline":
    """:func:`truncation` over fill and 1 / (1 + defocus / 4), to some 1e-4.

    Far away a field exp(-c r^2), c = (a/w)^2 - i defocus, of the unit circle becomes its Hankel
    transform; uncut, the integral of its fourth power over the plane is 1 / (32 |c|^2 Re c).
    """
    from scipy.interpolate import RectBivariateSpline  # slow to import, and few need it

    r, weight = np.polynomial.legendre.leggauss(96)
    r, weight = (r + 1) / 2, weight / 2
    node, share = np.polynomial.legendre.leggauss(12)
    q = (np.arange(0.0, 60 + 2 * _NEAREST, 4.0)[:, None] + 2 * (node + 1)).ravel()
    step = np.tile(2 * share, q.size // share.size)
    kernel = j0(q[:, None] * r) * (weight * r)
    fills = _LEAST_CUT + (1 - _LEAST_CUT) * (1 - np.cos(np.linspace(0, np.pi, 13))) / 2
    places = np.geomspace(1 / (1 + _NEAREST / _DEFOCUS), 1.0, 80)
    table = np.empty((fills.size, places.size))
    for row, fill in zip(table, fills.tolist(), strict=True):
        c = 1 / fill**2 - 1j * _DEFOCUS * (1 / places - 1)
        field = np.exp(-c[:, None] * r**2)
        power = np.abs(np.einsum("pr,qr->pq", field, kernel)) ** 2  # no matrix product: same bits
        whole = 1 / (32 * np.abs(c) ** 2 * c.real)
        row[:] = (power**2 * (q * step)).sum(axis=1) / whole
    return RectBivariateSpline(fills, places, table)
