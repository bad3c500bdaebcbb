"""Gaussian beams between telescope and target, and the share of an echo that one mode receives.

A coherent receiver sees one spatial mode. Light mixes with the local oscillator as far as it lies
in the oscillator's mode, propagated back through the telescope to the target. A diffuse surface
returns the radiance rho_pi P I_T. A single mode collects lambda^2 of a radiance at any distance
[1]_. With the transmitted power P_tx the received power is

    P_sig = P_tx tau_o rho_pi lambda^2  integral of I_T I_L d^2x

with the irradiance I_T of the transmitted beam and I_L of the local oscillator, each of unit power.
This module expresses the integral as the area of an aperture that would collect as much: lambda^2
R^2 times the integral replaces A in A / R^2. For Gaussian beams of 1/e^2 radii w_T and w_L, whose
axes are d apart,

    integral = 2 / (pi (w_T^2 + w_L^2)) exp(-2 d^2 / (w_T^2 + w_L^2))

The effective footprint, the product I_T I_L, has the 1/e^2 radius w_T w_L / sqrt(w_T^2 + w_L^2).
With equal beams it is narrower than the transmitted beam by sqrt(2), as light counts by the square
of its irradiance.

``instrument.telescope.coupling`` selects one of two laws. ``single_mode`` is the law above.
``aperture`` is that of [T 4.4]: all light in the aperture mixes, as is always so in direct
detection. A ray represents the light at one position on the target and of one direction. Near the
telescope and near a focus, positions and directions spread differently. Ranges follow positions,
which spread as w(R) / R. Doppler shifts follow directions, which have the far-field spread at every
range.

References
----------
.. [1] Siegman, Appl. Opt. 5, 1966, 1588.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import j0

from sweep.model.constants import SPEED_OF_LIGHT

SINGLE_MODE_COUPLING_LAW = "single_mode"
"""Name of the coupling law by which the receiver detects only light of one spatial mode, that of
the local oscillator."""
APERTURE_COUPLING_LAW = "aperture"
"""Name of the coupling law by which all light in the aperture mixes with the local oscillator."""
COUPLING_LAWS = (SINGLE_MODE_COUPLING_LAW, APERTURE_COUPLING_LAW)
"""Names of the laws that determine what fraction of the echo mixes with the local oscillator."""

COUPLING_PATH = "instrument.telescope.coupling"
"""Parameter path of the coupling law, one of `COUPLING_LAWS`."""
APERTURE_DIAMETER_PATH = "instrument.telescope.aperture"
"""Parameter path of the diameter of the telescope's aperture [m]."""
WAVELENGTH_PATH = "instrument.laser.wavelength"
"""Parameter path of the laser's wavelength [m]."""
DIVERGENCE_PATH = "instrument.laser.beam_divergence"
"""Parameter path of the full 1/e^2 angle of the transmitted beam in the far field [rad]."""
WAIST_PATH = "instrument.laser.beam_waist"
"""Parameter path of the 1/e^2 radius of the transmitted beam at the telescope [m]."""
BEAM_QUALITY_PATH = "instrument.laser.beam_quality"
"""Parameter path of the beam quality M^2 of the transmitted beam; 1 for an ideal beam."""
FOCUS_PATH = "instrument.laser.focus"
"""Parameter path of the distance at which the transmitted beam is focused [m]; 0 for a collimated
beam."""
OSCILLATOR_WAIST_PATH = "instrument.receiver.local_oscillator_waist"
"""Parameter path of the 1/e^2 radius of the local oscillator's beam at the telescope [m]."""
ARCHITECTURE_PATH = "instrument.receiver.architecture"
"""Parameter path of the receiver's architecture. Its value is one of
`sweep.model.receiver_chain.ARCHITECTURES`."""
SCAN_RATE_PATH, SEPARATION_PATH, MISALIGNMENT_PATH = (
    f"instrument.telescope.{name}" for name in ("scan_rate", "separation", "misalignment")
)

BEAM_DEFAULTS: dict[str, float | str] = {
    COUPLING_PATH: SINGLE_MODE_COUPLING_LAW,
    DIVERGENCE_PATH: 0.0,
    WAIST_PATH: 0.0,
    BEAM_QUALITY_PATH: 1.0,
    FOCUS_PATH: 0.0,
    OSCILLATOR_WAIST_PATH: 0.0,
}
"""Default values of the beam parameters, by dotted path. A divergence or waist of 0 is not stated.
A focus of 0 means a collimated beam. A local oscillator's waist of 0 means that of the transmitted
beam."""

FOOTPRINT_ANGLE_MAX = math.pi / 2
"""Upper limit of the full angle that a footprint subtends at the instrument [rad]."""

Parameters = Mapping[str, Any]
"""Type of parameters of n points: a mapping from dotted path to an (n,) array or a scalar."""


class GaussianBeam(NamedTuple):
    """Gaussian beam at its telescope, in SI units; the arrays broadcast.

    >>> beam = GaussianBeam.from_waist(waist=1.31e-3, wavelength=1310e-9)
    >>> f"{beam.rayleigh_range:.1f} m, {1e6 * beam.full_angle(math.inf):.0f} urad"
    '4.1 m, 637 urad'
    """

    radius_at_telescope: np.ndarray
    """1/e^2 radius of the beam at the telescope [m]."""
    rayleigh_range: np.ndarray
    """Rayleigh range pi w^2 / (M^2 lambda) [m], with the radius w at the telescope and the beam
    quality M^2.
    """
    wavefront_curvature: np.ndarray | float = 0.0
    """Curvature of the wavefront at the telescope [1/m], the reciprocal of the focus distance; 0
    for a collimated beam."""

    @classmethod
    def from_waist(
        cls,
        *,
        waist: ArrayLike,
        wavelength: ArrayLike,
        quality: ArrayLike = 1.0,
        focus: ArrayLike = 0.0,
    ) -> "GaussianBeam":
        """Return the beam that has a given 1/e^2 radius at the telescope.

        Parameters
        ----------
        waist : array_like
            1/e^2 radius w_a at the telescope [m], above 0.
        wavelength : array_like
            Wavelength [m].
        quality : array_like
            Beam quality M^2, 1 for a perfect beam.
        focus : array_like
            Distance f of the focus [m]; 0 for a collimated beam.

        Returns
        -------
        GaussianBeam
        """
        w, f = np.asarray(waist, float), np.asarray(focus, float)
        curvature = np.where(f > 0, 1 / np.where(f > 0, f, 1.0), 0.0)
        return cls(w, np.asarray(math.pi * w**2 / (np.asarray(quality) * wavelength)), curvature)

    def full_angle(self, range: ArrayLike) -> np.ndarray:
        """Return the full 1/e^2 angle 2 w(R) / R [rad] that the beam subtends at the telescope.

        w(R) is the 1/e^2 radius at the range R.

        Parameters
        ----------
        range : array_like
            Range R [m], above 0; infinity gives the far-field divergence.

        Returns
        -------
        ndarray
            Full 1/e^2 angle [rad].

        Notes
        -----
        w(R)^2 = w_a^2 ((1 - R/f)^2 + (R/z_R)^2), with the radius w_a at the telescope, the distance
        f of the focus and the Rayleigh range z_R.
        """
        defocus = 1 / np.asarray(range, float) - self.wavefront_curvature
        return np.asarray(2 * self.radius_at_telescope * np.hypot(defocus, 1 / self.rayleigh_range))

    def radius(self, range: ArrayLike) -> np.ndarray:
        """Return the 1/e^2 radius of the beam [m] at ``range`` [m], above 0."""
        return self.full_angle(range) * np.asarray(range, float) / 2


def is_single_mode(parameters: Parameters) -> bool:
    """Return True if the receiver's coupling law is that of a single spatial mode.

    `parameters` are those of points that share all text values.
    """
    return (
        str(parameters[COUPLING_PATH]) == SINGLE_MODE_COUPLING_LAW
        and str(parameters[ARCHITECTURE_PATH]) != "direct"
    )


def divergence_from_waist(
    waist: ArrayLike, wavelength: ArrayLike, quality: ArrayLike = 1.0
) -> np.ndarray:
    """Convert a collimated beam's waist radius to its full far-field angle, or angle to radius.

    Parameters
    ----------
    waist : array_like
        1/e^2 radius w_a [m]; or the full 1/e^2 angle in the far field [rad].
    wavelength : array_like
        Wavelength [m].
    quality : array_like
        Beam quality M^2.

    Returns
    -------
    ndarray
        Angle 2 M^2 lambda / (pi w_a) [rad]; or the radius [m], as the relation is its own inverse.
    """
    return np.asarray(2 * np.asarray(quality) * wavelength / (math.pi * np.asarray(waist)))


def far_field_divergence(parameters: Parameters) -> np.ndarray:
    """Return the full 1/e^2 angle [rad] of the unfocused transmitted beam in the far field."""
    stated_divergence, waist = (
        np.asarray(parameters[DIVERGENCE_PATH], float),
        np.asarray(parameters[WAIST_PATH], float),
    )
    if not waist.any():
        return stated_divergence
    divergence_of_waist = divergence_from_waist(
        np.where(waist > 0, waist, 1.0), parameters[WAVELENGTH_PATH], parameters[BEAM_QUALITY_PATH]
    )
    return np.where(waist > 0, divergence_of_waist, stated_divergence)


def transmitted_and_oscillator_beams(parameters: Parameters) -> tuple[GaussianBeam, GaussianBeam]:
    """Return the transmitted beam and the local oscillator's beam, each a :class:`GaussianBeam`.

    The local oscillator's beam is taken as propagated from the telescope to the target. It has the
    beam quality M^2 = 1, and by default the waist of the transmitted beam.
    """
    waist, oscillator_waist = (
        np.asarray(parameters[WAIST_PATH], float),
        np.asarray(parameters[OSCILLATOR_WAIST_PATH], float),
    )
    stated_divergence = np.asarray(parameters[DIVERGENCE_PATH], float)
    waist_of_divergence = divergence_from_waist(
        np.where(stated_divergence > 0, stated_divergence, 1.0),
        parameters[WAVELENGTH_PATH],
        parameters[BEAM_QUALITY_PATH],
    )
    waist = np.where(waist > 0, waist, waist_of_divergence)
    common_arguments = {"wavelength": parameters[WAVELENGTH_PATH], "focus": parameters[FOCUS_PATH]}
    transmitted_beam = GaussianBeam.from_waist(
        waist=waist, quality=parameters[BEAM_QUALITY_PATH], **common_arguments
    )
    return transmitted_beam, GaussianBeam.from_waist(
        waist=np.where(oscillator_waist > 0, oscillator_waist, waist), **common_arguments
    )


class FootprintAngles(NamedTuple):
    """Full 1/e^2 angles of the effective footprint [rad], by position and by light direction."""

    position_spread_angle: np.ndarray
    """Full 1/e^2 angle [rad] that the illuminated positions on the target subtend at the lidar."""
    direction_spread_angle: np.ndarray
    """Full 1/e^2 angle of the spread of light directions [rad], which determines the spread of
    Doppler shifts."""


def footprint_full_angles(
    parameters: Parameters, range: ArrayLike | None = None
) -> FootprintAngles:
    """Compute the full 1/e^2 angles that the effective footprint subtends at the instrument.

    All points must share their text parameters.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path.
    range : array_like, optional
        Range [m]; by default ``target.range``.

    Returns
    -------
    FootprintAngles
        Full 1/e^2 angles of positions and of directions [rad], at most :data:`FOOTPRINT_ANGLE_MAX`.
        With a stated divergence and no single mode, both are the divergence.

    Notes
    -----
    A single mode has the angle a b / sqrt(a^2 + b^2), with the full angles a of the transmitted
    beam and b of the local oscillator's: at `range` for positions, in the far field for directions.
    """
    if has_constant_divergence(parameters):
        stated_divergence = np.asarray(parameters[DIVERGENCE_PATH], float)
        return FootprintAngles(stated_divergence, stated_divergence)
    distance = np.asarray(parameters["target.range"] if range is None else range, float)
    transmitted_beam, oscillator_beam = transmitted_and_oscillator_beams(parameters)
    if is_single_mode(parameters):
        angle_pairs = (
            (transmitted_beam.full_angle(r), oscillator_beam.full_angle(r))
            for r in (distance, math.inf)
        )
        return FootprintAngles(
            *(np.minimum(a * b / np.hypot(a, b), FOOTPRINT_ANGLE_MAX) for a, b in angle_pairs)
        )
    has_stated_divergence = (np.asarray(parameters[WAIST_PATH]) == 0) & (
        np.asarray(parameters[FOCUS_PATH]) == 0
    )
    transmitted_angles = (
        np.minimum(transmitted_beam.full_angle(r), FOOTPRINT_ANGLE_MAX)
        for r in (distance, math.inf)
    )
    return FootprintAngles(
        *(
            np.where(has_stated_divergence, parameters[DIVERGENCE_PATH], angle)
            for angle in transmitted_angles
        )
    )


def beam_shape_parameters(parameters: Parameters) -> dict[str, Any]:
    """Return the parameters, by dotted path, that determine a beam's width at every range."""
    paths = (
        WAVELENGTH_PATH,
        DIVERGENCE_PATH,
        WAIST_PATH,
        BEAM_QUALITY_PATH,
        FOCUS_PATH,
        OSCILLATOR_WAIST_PATH,
    )
    return {path: parameters[path] for path in paths} | {COUPLING_PATH: is_single_mode(parameters)}


def has_constant_divergence(parameters: Parameters) -> bool:
    """Return True if the footprint's width is the beam divergence times the range, as in [T].

    `parameters` are those of points that share all text values.
    """
    return not (
        is_single_mode(parameters)
        or np.any(parameters[WAIST_PATH])
        or np.any(parameters[FOCUS_PATH])
    )


def range_loss_coefficients(
    parameters: Parameters, range: ArrayLike | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients b and c of the range loss 1 + b x + c x^2.

    The range loss is the echo of a surface at the range R, divided by its echo at R (1 + x).

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path; all points have the same text parameters.
    range : array_like, optional
        Range R [m]; by default ``target.range``.

    Returns
    -------
    b, c : ndarray
        Coefficients of the relative range change x, and of its square.

    Notes
    -----
    The loss of light that an aperture collects is (1 + x)^2. The loss of light of a single mode is
    proportional to w_T^2 + w_L^2, with the radii of the transmitted and of the oscillator's beam at
    R (1 + x).
    """
    if not is_single_mode(parameters):
        return np.asarray(2.0), np.asarray(1.0)
    distance = np.asarray(parameters["target.range"] if range is None else range, float)
    coefficient_sums = [np.asarray(0.0)] * 3
    for beam in transmitted_and_oscillator_beams(parameters):
        squared_radius, focus_ratio = (
            beam.radius_at_telescope**2,
            beam.wavefront_curvature * distance,
        )
        quadratic_term = focus_ratio**2 + (distance / beam.rayleigh_range) ** 2
        coefficients = (
            1 - 2 * focus_ratio + quadratic_term,
            2 * (quadratic_term - focus_ratio),
            quadratic_term,
        )
        coefficient_sums = [
            total + squared_radius * coefficient
            for total, coefficient in zip(coefficient_sums, coefficients, strict=True)
        ]
    constant, linear, quadratic = coefficient_sums
    return linear / constant, quadratic / constant


def effective_collecting_area(parameters: Parameters) -> np.ndarray:
    """Return the area A [m^2] of an aperture that collects as much light as the receiver mixes.

    An aperture of area A collects light of a diffuse echo at the range R, ``target.range``, in
    proportion to A / R^2. For the coupling law ``aperture``, A is the area of the real aperture.
    For a single mode it is lambda^2 R^2 times the overlap integral of both beams' irradiances, each
    of unit power. It is reduced by :func:`truncation_efficiency` of both beams.
    """
    diameter = np.asarray(parameters[APERTURE_DIAMETER_PATH])
    if not is_single_mode(parameters):
        return math.pi * (diameter / 2) ** 2
    transmitted_beam, oscillator_beam = transmitted_and_oscillator_beams(parameters)
    distance = np.asarray(parameters["target.range"], float)
    squared_angles = (
        transmitted_beam.full_angle(distance) ** 2 + oscillator_beam.full_angle(distance) ** 2
    )
    area = 8 * np.asarray(parameters[WAVELENGTH_PATH]) ** 2 / (math.pi * squared_angles)
    rim_phase = (
        math.pi
        * (diameter / 2) ** 2
        / parameters[WAVELENGTH_PATH]
        * (1 / distance - transmitted_beam.wavefront_curvature)
    )
    efficiency = truncation_efficiency(
        2 * transmitted_beam.radius_at_telescope / diameter, rim_phase
    )
    if np.any(parameters[OSCILLATOR_WAIST_PATH]):
        efficiency = np.sqrt(
            efficiency
            * truncation_efficiency(2 * oscillator_beam.radius_at_telescope / diameter, rim_phase)
        )
    return np.asarray(area * efficiency)


def receiver_diameter_and_view_angle(parameters: Parameters) -> tuple[np.ndarray, np.ndarray]:
    """Return the diameter of the receiver's area, and its full angle of view, for background light.

    Returns
    -------
    diameter : ndarray
        Diameter of the receiving area [m].
    angle : ndarray
        Full angle of view [rad].

    Notes
    -----
    A single mode collects with the diameter and the divergence of the local oscillator's beam. The
    product of their area and solid angle is lambda^2.
    """
    if not is_single_mode(parameters):
        return np.asarray(parameters[APERTURE_DIAMETER_PATH], float), far_field_divergence(
            parameters
        )
    _, oscillator_beam = transmitted_and_oscillator_beams(parameters)
    oscillator_waist = oscillator_beam.radius_at_telescope
    return 2 * oscillator_waist, divergence_from_waist(
        oscillator_waist, parameters[WAVELENGTH_PATH]
    )


def beam_axis_offset(parameters: Parameters, range: ArrayLike) -> np.ndarray:
    """Return the distance [m] between the axes of transmitted and received beam at the target.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path.
    range : array_like
        Range R [m].

    Notes
    -----
    The offset is the sum of three contributions in one plane. A scan of rate omega turns by omega
    2R/c before the light returns. The axes of a bistatic pair are separated at the instrument. Axes
    at an angle diverge with range, or meet if this angle has the opposite sign.
    """
    distance = np.asarray(range, float)
    angle_between_axes = (
        np.asarray(parameters[SCAN_RATE_PATH]) * (2 / SPEED_OF_LIGHT) * distance
        + parameters[MISALIGNMENT_PATH]
    )
    return np.asarray(angle_between_axes * distance + parameters[SEPARATION_PATH])


def beam_axis_offset_transmission(parameters: Parameters, range: ArrayLike) -> np.ndarray:
    """Return the echo power with offset beam axes, relative to that with coinciding axes, 0..1.

    The receiver detects a single spatial mode. The axes are those of the transmitted beam and of
    the local oscillator's beam.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path.
    range : array_like
        Range [m].

    Notes
    -----
    exp(-2 d^2 / (w_T^2 + w_L^2)), with the offset d of :func:`beam_axis_offset` and the 1/e^2 radii
    w_T of the transmitted and w_L of the local oscillator's beam at the target.
    """
    squared_radii = sum(
        beam.radius(range) ** 2 for beam in transmitted_and_oscillator_beams(parameters)
    )
    return np.asarray(np.exp(-2 * beam_axis_offset(parameters, range) ** 2 / squared_radii))


_UNTRUNCATED_FILL_RATIO_MAX = 0.25
"""Largest ratio of beam radius to aperture radius at which truncation by the aperture is neglected.
At this ratio truncation takes 5e-7 of the echo."""
_RIM_DEFOCUS_PHASE_MAX = 60.0
"""Largest defocus phase at the aperture's rim [rad] in the truncation table. For larger phases the
efficiency differs by less than 2 % from that at this phase."""
_N_FILL_RATIO_STEPS, _N_RIM_PHASE_STEPS = 16, 100
"""Numbers of steps of the truncation table over the angle of the fill ratio, and over the root of
the defocus phase."""
_SQRT_RIM_PHASE_STEP = math.sqrt(_RIM_DEFOCUS_PHASE_MAX) / _N_RIM_PHASE_STEPS
"""Step, in the square root of the defocus phase, between columns of the truncation table
[sqrt(rad)]."""


def truncation_efficiency(fill_ratio: ArrayLike, defocus_phase: ArrayLike = 0.0) -> np.ndarray:
    """Return the echo power of a beam truncated by its aperture, relative to the full beam's.

    Parameters
    ----------
    fill_ratio : array_like
        w_a / a: 1/e^2 radius of the beam divided by the radius of the aperture, up to 1.
    defocus_phase : array_like
        Defocus phase at the aperture's rim [rad], pi a^2 / lambda (1/R - 1/f), with the aperture's
        radius a, the range R and the distance f of the focus.

    Returns
    -------
    ndarray
        Efficiency of transmission and reception together, 0..1.01, to 1e-4. Beams of unequal
        radii take the geometric mean of the two efficiencies.

    Notes
    -----
    The truncated light is lost, and the rest diverges more. In the far field or in focus 0.63 of
    the echo remains at w_a = 0.8 a. The effective area is then 0.40 A, the most of any Gaussian
    beam [1]_. Near the telescope the middle of the beam is unchanged.

    References
    ----------
    .. [1] Rye and Frehlich, Appl. Opt. 31, 1992, 2891.

    Examples
    --------
    >>> f"{0.8**2 * truncation_efficiency(0.8):.2f}"
    '0.40'
    """
    fill_ratio, rim_phase = np.broadcast_arrays(
        np.asarray(fill_ratio, float), np.abs(np.asarray(defocus_phase, float))
    )
    if not (fill_ratio > _UNTRUNCATED_FILL_RATIO_MAX).any():
        return np.ones(fill_ratio.shape)
    from scipy.ndimage import map_coordinates  # slow to import, and rarely needed

    fill_fraction = np.clip(
        (fill_ratio - _UNTRUNCATED_FILL_RATIO_MAX) / (1 - _UNTRUNCATED_FILL_RATIO_MAX), 0.0, 1.0
    )
    fill_step = np.arccos(1 - 2 * fill_fraction) * (_N_FILL_RATIO_STEPS / np.pi)
    phase_step = np.sqrt(np.minimum(rim_phase, _RIM_DEFOCUS_PHASE_MAX)) / _SQRT_RIM_PHASE_STEP
    table_position = np.stack([fill_step.ravel(), phase_step.ravel()])
    efficiency = map_coordinates(
        _truncation_table(), table_position, mode="mirror", prefilter=False
    ).reshape(fill_ratio.shape)
    efficiency = np.where(np.isnan(rim_phase), np.nan, efficiency)
    return np.where(fill_ratio > _UNTRUNCATED_FILL_RATIO_MAX, efficiency, 1.0)


@lru_cache(maxsize=1)
def _truncation_table() -> np.ndarray:
    """Return spline coefficients of :func:`truncation_efficiency`, (fill ratios, defocus phases).

    The fill ratio is the beam's 1/e^2 radius over the aperture's radius. Rows have equal steps of
    an angle; its cosine falls linearly from 1 to -1 as the fill ratio rises. Columns have equal
    steps of the square root of the defocus phase. Cubic interpolation errs by 8e-5.

    Interpolation with ``mode="mirror"`` assumes a function that is even about each edge of the
    table. The efficiency is even about all edges except the largest phase, so four columns are
    added beyond that phase.

    The field at the aperture is exp(-c r^2) for radii r up to the aperture's radius 1, with c =
    (1 / fill ratio)^2 - i defocus phase. In the far field it becomes its Hankel transform. The
    integral of the fourth power of the untruncated transform is 1 / (32 |c|^2 Re c).
    """
    from scipy.ndimage import spline_filter  # slow to import, and rarely needed

    radii, radius_weights = np.polynomial.legendre.leggauss(64)
    radii, radius_weights = (radii + 1) / 2, radius_weights / 2
    gauss_nodes, gauss_weights = np.polynomial.legendre.leggauss(12)
    q = (
        np.arange(0.0, 60 + 2 * _RIM_DEFOCUS_PHASE_MAX, 4.0)[:, None] + 2 * (gauss_nodes + 1)
    ).ravel()
    q_weights = np.tile(2 * gauss_weights, q.size // gauss_weights.size)
    kernel = j0(q[:, None] * radii) * (radius_weights * radii)
    fill_ratios = (
        _UNTRUNCATED_FILL_RATIO_MAX
        + (1 - _UNTRUNCATED_FILL_RATIO_MAX)
        * (1 - np.cos(np.linspace(0, np.pi, _N_FILL_RATIO_STEPS + 1)))
        / 2
    )
    rim_phases = np.square(_SQRT_RIM_PHASE_STEP * np.arange(_N_RIM_PHASE_STEPS + 5))
    defocus_cosine, defocus_sine = (
        circular_function(rim_phases[:, None] * radii**2) for circular_function in (np.cos, np.sin)
    )
    table = np.empty((fill_ratios.size, rim_phases.size))
    for row, fill_ratio in zip(table, fill_ratios.tolist(), strict=True):
        truncated_kernel = kernel * np.exp(-((radii / fill_ratio) ** 2))
        power = sum(  # by einsum, whose bits do not depend on the number of threads
            np.einsum("pr,qr->pq", defocus, truncated_kernel) ** 2
            for defocus in (defocus_cosine, defocus_sine)
        )
        row[:] = (power**2 * (q * q_weights)).sum(axis=1)
        row *= 32 * (fill_ratio**-4 + rim_phases**2) / fill_ratio**2
    return np.asarray(spline_filter(table, mode="mirror"))
