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

COUPLING_PATH = "instrument.telescope.coupling"
APERTURE_DIAMETER_PATH = "instrument.telescope.aperture"
WAVELENGTH_PATH = "instrument.laser.wavelength"
DIVERGENCE_PATH = "instrument.laser.beam_divergence"
WAIST_PATH = "instrument.laser.beam_waist"
QUALITY_PATH = "instrument.laser.beam_quality"
FOCUS_PATH = "instrument.laser.focus"
OSCILLATOR_WAIST_PATH = "instrument.receiver.local_oscillator_waist"
ARCHITECTURE_PATH = "instrument.receiver.architecture"
SCAN_RATE_PATH, SEPARATION_PATH, MISALIGNMENT_PATH = (
    f"instrument.telescope.{name}" for name in ("scan_rate", "separation", "misalignment")
)

BEAM_DEFAULTS: dict[str, float | str] = {
    COUPLING_PATH: SINGLE_MODE,
    DIVERGENCE_PATH: 0.0,
    WAIST_PATH: 0.0,
    QUALITY_PATH: 1.0,
    FOCUS_PATH: 0.0,
    OSCILLATOR_WAIST_PATH: 0.0,
}
"""Defaults of a beam's parameters; 0: not given, collimated, or as the sent one."""

FOOTPRINT_ANGLE_MAX = math.pi / 2
"""Full angle [rad] beyond which a footprint is taken to be no wider."""

Parameters = Mapping[str, Any]


class GaussianBeam(NamedTuple):
    """Gaussian beam at its telescope; SI, arrays that broadcast.

    >>> beam = Beam.of(waist=1.31e-3, wavelength=1310e-9)
    >>> f"{beam.rayleigh_range:.1f} m, {1e6 * beam.angle(math.inf):.0f} urad"
    '4.1 m, 637 urad'
    """

    waist: np.ndarray
    """1/e^2 radius at the telescope, w_a [m]."""
    rayleigh_range: np.ndarray
    """z_R = pi w_a^2 / (M^2 lambda) [m]."""
    focus_curvature: np.ndarray | float = 0.0
    """1 / f, of the distance at which it is focused [1/m]; 0 for a collimated beam."""

    @classmethod
    def from_waist(
        cls,
        *,
        waist: ArrayLike,
        wavelength: ArrayLike,
        quality: ArrayLike = 1.0,
        focus: ArrayLike = 0.0,
    ) -> "GaussianBeam":
        """Beam of a waist w_a [m], wavelength [m], quality M^2, and focus [m], 0 for collimated."""
        w, f = np.asarray(waist, float), np.asarray(focus, float)
        curvature = np.where(f > 0, 1 / np.where(f > 0, f, 1.0), 0.0)
        return cls(w, np.asarray(math.pi * w**2 / (np.asarray(quality) * wavelength)), curvature)

    def full_angle(self, range: ArrayLike) -> np.ndarray:
        """Full angle 2 w(R) / R [rad] at ranges above 0, infinity included.

        w(R)^2 = w_a^2 ((1 - R/f)^2 + (R/z_R)^2).
        """
        defocus = 1 / np.asarray(range, float) - self.focus_curvature
        return np.asarray(2 * self.waist * np.hypot(defocus, 1 / self.rayleigh_range))

    def radius(self, range: ArrayLike) -> np.ndarray:
        """1/e^2 radius w(R) [m] at ranges above 0."""
        return self.full_angle(range) * np.asarray(range, float) / 2


def is_single_mode(parameters: Parameters) -> bool:
    """Return true where the receiver of points of one category sees a single mode."""
    return (
        str(parameters[COUPLING_PATH]) == SINGLE_MODE
        and str(parameters[ARCHITECTURE_PATH]) != "direct"
    )


def divergence_from_waist(
    waist: ArrayLike, wavelength: ArrayLike, quality: ArrayLike = 1.0
) -> np.ndarray:
    """Full far-field angle 2 M^2 lambda / (pi w_a) [rad] of a collimated beam; or w_a from that."""
    return np.asarray(2 * np.asarray(quality) * wavelength / (math.pi * np.asarray(waist)))


def far_field_divergence(parameters: Parameters) -> np.ndarray:
    """Full angle of the sent beam far away, unless it is focused [rad]."""
    stated_divergence, waist = (
        np.asarray(parameters[DIVERGENCE_PATH], float),
        np.asarray(parameters[WAIST_PATH], float),
    )
    if not waist.any():
        return stated_divergence
    divergence_of_waist = divergence_from_waist(
        np.where(waist > 0, waist, 1.0), parameters[WAVELENGTH_PATH], parameters[QUALITY_PATH]
    )
    return np.where(waist > 0, divergence_of_waist, stated_divergence)


def sent_and_oscillator_beams(parameters: Parameters) -> tuple[GaussianBeam, GaussianBeam]:
    """Return the sent beam and, with M^2 = 1, the local oscillator's at the target.

    The local oscillator's waist at the telescope is that of the sent beam by default.
    """
    waist, oscillator_waist = (
        np.asarray(parameters[WAIST_PATH], float),
        np.asarray(parameters[OSCILLATOR_WAIST_PATH], float),
    )
    stated_divergence = np.asarray(parameters[DIVERGENCE_PATH], float)
    waist_of_divergence = divergence_from_waist(
        np.where(stated_divergence > 0, stated_divergence, 1.0),
        parameters[WAVELENGTH_PATH],
        parameters[QUALITY_PATH],
    )
    waist = np.where(waist > 0, waist, waist_of_divergence)
    common_arguments = {"wavelength": parameters[WAVELENGTH_PATH], "focus": parameters[FOCUS_PATH]}
    sent_beam = GaussianBeam.from_waist(
        waist=waist, quality=parameters[QUALITY_PATH], **common_arguments
    )
    return sent_beam, GaussianBeam.from_waist(
        waist=np.where(oscillator_waist > 0, oscillator_waist, waist), **common_arguments
    )


class FootprintAngles(NamedTuple):
    """Full 1/e^2 angles of the light that counts, as seen from the instrument [rad]."""

    positions: np.ndarray
    """Of the places where it meets the target."""
    directions: np.ndarray
    """Of the directions that it has there."""


def footprint_angles(parameters: Parameters, range: ArrayLike | None = None) -> FootprintAngles:
    """Angles of the footprint of points of one category, at `range` or ``target.range`` [m]."""
    if has_constant_divergence(parameters):
        stated_divergence = np.asarray(parameters[DIVERGENCE_PATH], float)
        return FootprintAngles(stated_divergence, stated_divergence)
    distance = np.asarray(parameters["target.range"] if range is None else range, float)
    sent_beam, oscillator_beam = sent_and_oscillator_beams(parameters)
    if is_single_mode(parameters):
        angle_pairs = (
            (sent_beam.full_angle(r), oscillator_beam.full_angle(r)) for r in (distance, math.inf)
        )
        return FootprintAngles(
            *(np.minimum(a * b / np.hypot(a, b), FOOTPRINT_ANGLE_MAX) for a, b in angle_pairs)
        )
    has_stated_divergence = (np.asarray(parameters[WAIST_PATH]) == 0) & (
        np.asarray(parameters[FOCUS_PATH]) == 0
    )
    sent_angles = (
        np.minimum(sent_beam.full_angle(r), FOOTPRINT_ANGLE_MAX) for r in (distance, math.inf)
    )
    return FootprintAngles(
        *(
            np.where(has_stated_divergence, parameters[DIVERGENCE_PATH], angle)
            for angle in sent_angles
        )
    )


def beam_shape_parameters(parameters: Parameters) -> dict[str, Any]:
    """Parameters that say how wide a beam is at each range."""
    paths = (
        WAVELENGTH_PATH,
        DIVERGENCE_PATH,
        WAIST_PATH,
        QUALITY_PATH,
        FOCUS_PATH,
        OSCILLATOR_WAIST_PATH,
    )
    return {path: parameters[path] for path in paths} | {COUPLING_PATH: is_single_mode(parameters)}


def has_constant_divergence(parameters: Parameters) -> bool:
    """Return true where every footprint is as wide as divergence times range, [T]'s law."""
    return not (
        is_single_mode(parameters)
        or np.any(parameters[WAIST_PATH])
        or np.any(parameters[FOCUS_PATH])
    )


def range_loss_coefficients(
    parameters: Parameters, range: ArrayLike | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (b, c) of 1 + b x + c x^2, by which a place at R (1 + x) has less than one at R.

    The light in the aperture falls by (1 + x)^2; of one mode, w_T^2 + w_L^2 says how far.
    """
    if not is_single_mode(parameters):
        return np.asarray(2.0), np.asarray(1.0)
    distance = np.asarray(parameters["target.range"] if range is None else range, float)
    coefficient_sums = [np.asarray(0.0)] * 3
    for beam in sent_and_oscillator_beams(parameters):
        squared_waist, focus_ratio = beam.waist**2, beam.focus_curvature * distance
        quadratic_term = focus_ratio**2 + (distance / beam.rayleigh_range) ** 2
        coefficients = (
            1 - 2 * focus_ratio + quadratic_term,
            2 * (quadratic_term - focus_ratio),
            quadratic_term,
        )
        coefficient_sums = [
            total + squared_waist * coefficient
            for total, coefficient in zip(coefficient_sums, coefficients, strict=True)
        ]
    return coefficient_sums[1] / coefficient_sums[0], coefficient_sums[2] / coefficient_sums[0]


def effective_collecting_area(parameters: Parameters) -> np.ndarray:
    """Area [m^2] that collects, at ``target.range``, as much of a diffuse echo as mixes.

    The aperture's, or lambda^2 R^2 times the integral of I_T I_L, of beams that the aperture cuts.
    """
    diameter = np.asarray(parameters[APERTURE_DIAMETER_PATH])
    if not is_single_mode(parameters):
        return math.pi * (diameter / 2) ** 2
    sent_beam, oscillator_beam = sent_and_oscillator_beams(parameters)
    distance = np.asarray(parameters["target.range"], float)
    squared_angles = sent_beam.full_angle(distance) ** 2 + oscillator_beam.full_angle(distance) ** 2
    area = 8 * np.asarray(parameters[WAVELENGTH_PATH]) ** 2 / (math.pi * squared_angles)
    rim_phase = (
        math.pi
        * (diameter / 2) ** 2
        / parameters[WAVELENGTH_PATH]
        * (1 / distance - sent_beam.focus_curvature)
    )
    efficiency = truncation_efficiency(2 * sent_beam.waist / diameter, rim_phase)
    if np.any(parameters[OSCILLATOR_WAIST_PATH]):
        efficiency = np.sqrt(
            efficiency * truncation_efficiency(2 * oscillator_beam.waist / diameter, rim_phase)
        )
    return np.asarray(area * efficiency)


def receiving_aperture_and_angle(parameters: Parameters) -> tuple[np.ndarray, np.ndarray]:
    """Diameter [m] and full angle [rad] that light from elsewhere than the target passes.

    Of one mode, that of the local oscillator's beam, whose area times solid angle is lambda^2.
    """
    if not is_single_mode(parameters):
        return np.asarray(parameters[APERTURE_DIAMETER_PATH], float), far_field_divergence(
            parameters
        )
    oscillator_waist = sent_and_oscillator_beams(parameters)[1].waist
    return 2 * oscillator_waist, divergence_from_waist(
        oscillator_waist, parameters[WAVELENGTH_PATH]
    )


def axis_offset(parameters: Parameters, range: ArrayLike) -> np.ndarray:
    """Distance [m] between the axes of sent and received beam at a range [m], in one plane.

    A scan has turned by omega 2R/c until the light is back; a bistatic pair's axes are apart at the
    instrument already; axes that are not parallel part with range, or meet, where signs differ.
    """
    distance = np.asarray(range, float)
    angle_between_axes = (
        np.asarray(parameters[SCAN_RATE_PATH]) * (2 / SPEED_OF_LIGHT) * distance
        + parameters[MISALIGNMENT_PATH]
    )
    return np.asarray(angle_between_axes * distance + parameters[SEPARATION_PATH])


def axis_offset_transmission(parameters: Parameters, range: ArrayLike) -> np.ndarray:
    """Share of a single mode's echo that is left with the axes :func:`axis_offset` apart, 0..1."""
    squared_radii = sum(beam.radius(range) ** 2 for beam in sent_and_oscillator_beams(parameters))
    return np.asarray(np.exp(-2 * axis_offset(parameters, range) ** 2 / squared_radii))


_UNTRUNCATED_FILL_MAX = 0.25
"""w_a over the aperture's radius up to which 5e-7 of the echo is cut off, or less."""
_TABLE_MIDDLE_PHASE = 4.0
"""Phase [rad] at the rim that lies in the middle of the table."""
_RIM_PHASE_MAX = 60.0
"""Largest phase of the table; nearer by, within 2 % of it, all is as there."""


def truncation_efficiency(fill_ratio: ArrayLike, defocus_phase: ArrayLike = 0.0) -> np.ndarray:
    """Echo of a beam that its aperture cuts off, sent and received, over that of the whole beam.

    The light cut off is lost, and the rest spreads. Far away, or in focus, 0.63 of the echo is
    left at w_a = 0.8 a, which makes 0.40 A / R^2, the most that any Gaussian beam has (Rye and
    Frehlich, Appl. Opt. 31, 1992, 2891). Near the telescope the beam's middle is as it was. Beams
    of unequal radii take the geometric mean of two. `fill_ratio` is w_a / a, 1/e^2 radius over the
    aperture's radius, up to 1; `defocus_phase` the phase [rad] at the rim, pi a^2 / lambda (1/R -
    1/f).

    >>> f"{0.8**2 * truncation(0.8):.2f}"
    '0.40'
    """
    fill_ratio, rim_phase = np.broadcast_arrays(
        np.asarray(fill_ratio, float), np.abs(np.asarray(defocus_phase, float))
    )
    if not (fill_ratio > _UNTRUNCATED_FILL_MAX).any():
        return np.ones(fill_ratio.shape)
    rim_phase = np.minimum(rim_phase, _RIM_PHASE_MAX)
    efficiency = _truncation_table().ev(
        np.minimum(fill_ratio, 1.0), 1 / (1 + rim_phase / _TABLE_MIDDLE_PHASE)
    )
    return np.where(fill_ratio > _UNTRUNCATED_FILL_MAX, efficiency, 1.0)


@lru_cache(maxsize=1)
def _truncation_table() -> "RectBivariateSpline":
    """:func:`truncation_efficiency` over fill and 1 / (1 + defocus / 4), to some 1e-4.

    Far away a field exp(-c r^2), c = (a/w)^2 - i defocus, of the unit circle becomes its Hankel
    transform; uncut, the integral of its fourth power over the plane is 1 / (32 |c|^2 Re c).
    """
    from scipy.interpolate import RectBivariateSpline  # slow to import, and few need it

    radii, radius_weights = np.polynomial.legendre.leggauss(96)
    radii, radius_weights = (radii + 1) / 2, radius_weights / 2
    gauss_nodes, gauss_weights = np.polynomial.legendre.leggauss(12)
    q = (np.arange(0.0, 60 + 2 * _RIM_PHASE_MAX, 4.0)[:, None] + 2 * (gauss_nodes + 1)).ravel()
    q_weights = np.tile(2 * gauss_weights, q.size // gauss_weights.size)
    kernel = j0(q[:, None] * radii) * (radius_weights * radii)
    fill_ratios = (
        _UNTRUNCATED_FILL_MAX
        + (1 - _UNTRUNCATED_FILL_MAX) * (1 - np.cos(np.linspace(0, np.pi, 13))) / 2
    )
    phase_coordinates = np.geomspace(1 / (1 + _RIM_PHASE_MAX / _TABLE_MIDDLE_PHASE), 1.0, 80)
    table = np.empty((fill_ratios.size, phase_coordinates.size))
    for row, fill_ratio in zip(table, fill_ratios.tolist(), strict=True):
        c = 1 / fill_ratio**2 - 1j * _TABLE_MIDDLE_PHASE * (1 / phase_coordinates - 1)
        field = np.exp(-c[:, None] * radii**2)
        power = np.abs(np.einsum("pr,qr->pq", field, kernel)) ** 2  # no matrix product: same bits
        untruncated = 1 / (32 * np.abs(c) ** 2 * c.real)
        row[:] = (power**2 * (q * q_weights)).sum(axis=1) / untruncated
    return RectBivariateSpline(fill_ratios, phase_coordinates, table)
