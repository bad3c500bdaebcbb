"""Ground that a beam meets, a flat plane or footprints by ray tracing, as one line or as beamlets.

Reflectance laws: a surface of bidirectional reflectance f [1/sr] that fills a beam of power P at
incidence i returns the intensity f P cos(i) [W/sr] along the beam. The illuminated patch is
1/cos(i) times the beam's cross-section and, seen from the beam, is foreshortened by cos(i). So
Lambert's f = rho/pi gives rho cos(i)/pi.

The law of Lommel and Seeliger describes dark, porous ground (regolith), where light that is
scattered once dominates [1]_ [2]_:

    f = w / (4 pi) / (cos i + cos e) * p(g) (1 + B(g))

with the single-scattering albedo w, the phase function p and the opposition surge B of shadows
hidden behind their grains. A lidar observes at the phase angle g = 0 and i = e, where f cos(i) is w
p(0) (1 + B(0)) / (8 pi) at any incidence. A sphere of such ground is uniformly bright, like the
full Moon.

References
----------
.. [1] Hapke, 1981.
.. [2] Hapke, 2012, ch. 10.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sweep.model import beam, beamlets
from sweep.model.beamlets import OffsetMoments
from sweep.model.constants import SPEED_OF_LIGHT

REFLECTANCE_LAWS = ("thesis", "lambert", "lommel_seeliger")
"""Names of the reflectance laws, as of :func:`backscatter`."""


def backscatter(law: str, cos_incidence: np.ndarray) -> np.ndarray:
    """Return the backscattered fraction per steradian of a surface of reflectance 1.

    Parameters
    ----------
    law : str
        One of :data:`REFLECTANCE_LAWS`.
    cos_incidence : ndarray
        Cosine of the incidence angle.

    Returns
    -------
    ndarray
        Backscatter [1/sr].

    Notes
    -----
    ``thesis`` is the diffuse law of [T 4.4], 1/(2 pi) at any incidence. ``lambert`` is
    cos(incidence)/pi. ``lommel_seeliger`` is 1/pi at any incidence. Its reflectance is the normal
    albedo w p(0) (1 + B(0)) / 8 (single-scattering albedo, phase function, opposition surge). At
    normal incidence this is Lambert's reflectance.
    """
    if law == "thesis":
        return np.full_like(cos_incidence, 0.5 / math.pi)
    if law == "lambert":
        return cos_incidence / math.pi
    return np.full_like(cos_incidence, 1 / math.pi)


class BeamletTable(NamedTuple):
    """Positions and echoes of beamlets, in rows that points share."""

    row_of_point: np.ndarray
    """(n,) int64: the row of each point."""
    relative_range_offset: np.ndarray
    """(rows, beamlets): (R_b - R_0) / R_0."""
    doppler_ratio_offset: np.ndarray
    """(rows, beamlets): beta_b - beta_0, beta = 2 v_r / c."""
    relative_echo: np.ndarray
    """(rows, beamlets): power fraction x backscatter [1/sr] x (R_0/R_b)^2, for reflectance 1."""


class BeamGradients(NamedTuple):
    """Changes across a beam per standard deviation of the beam, (n,) each."""

    doppler_ratio: np.ndarray
    """(n,): change of the Doppler ratio 2 v_r / c."""
    relative_range: np.ndarray
    """(n,): change of the range over that on the axis."""
    relative_echo: np.ndarray
    """(n,): change of the echo power over that on the axis."""


class FlatGround:
    """Flat plane for the points of one category.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path, as arrays.
    n_points : int
        Number of points n.
    has_velocities : bool
        True if beamlets have velocities of their own. Otherwise points that differ only in velocity
        share their rows.
    """

    off_axis_surface = None
    """Beamlets off the axis's surface: None, as a plane is a single surface."""

    def __init__(
        self, parameters: Mapping[str, np.ndarray], n_points: int, *, has_velocities: bool = True
    ) -> None:
        self._reflectance_law = str(parameters["target.reflectance_law"])
        self._n_beamlets = int(parameters["footprint.beamlets"])
        self._beamlet_pattern = beamlet_pattern(parameters)
        position_angles, direction_angles = beam.footprint_angles(parameters)
        velocity_paths = "target.radial_velocity", "target.transverse_velocity"
        velocities = [parameters[name] if has_velocities else 0.0 for name in velocity_paths]
        single_mode_columns = (
            ()
            if beam.has_constant_divergence(parameters)
            else (direction_angles, *beam.range_loss_coefficients(parameters))
        )
        columns = np.broadcast_arrays(
            parameters["target.grazing_angle"], position_angles, *velocities, *single_mode_columns
        )
        self._geometry_columns, self._n_points = (
            [np.atleast_1d(column) for column in columns],
            n_points,
        )

    def mean_phasor(self, doppler_cycles: np.ndarray, delay_cycles: np.ndarray) -> np.ndarray:
        """Return the mean of a phasor over the beam, (n,) complex.

        The phasor is exp(2 pi i (doppler_cycles dbeta - delay_cycles dR / R)).

        Parameters
        ----------
        doppler_cycles : array_like
            Cycles per unit of Doppler ratio, (n,) or scalar; dbeta is beta_b - beta_0.
        delay_cycles : array_like
            Cycles per unit of relative range, (n,) or scalar; dR / R is (R_b - R_0) / R_0.

        Notes
        -----
        To second order a beamlet x across and y along the slope, in standard deviations, has the
        phase t y + c (x^2 + y^2), and its echo is proportional to 1 + k y. With Gaussian x and y
        the mean is

            (1 + i k t / (1 - 2 i c)) exp(-t^2 / 2 / (1 - 2 i c)) / (1 - 2 i c)
        """
        _, _, radial_velocity, _, *single_mode_columns = self._geometry_columns
        gradients = self.gradients
        direction_sigma = (
            single_mode_columns[0] if single_mode_columns else self._geometry_columns[1]
        ) / 4
        phase_per_speed = (4 * np.pi / SPEED_OF_LIGHT) * np.asarray(
            doppler_cycles, float
        )  # for 1 m/s
        t = (
            2
            * np.pi
            * (
                np.asarray(doppler_cycles, float) * gradients.doppler_ratio
                - delay_cycles * gradients.relative_range
            )
        )
        curvature_phase = phase_per_speed * radial_velocity * direction_sigma**2
        curvature_phase = (
            curvature_phase
            + 2 * np.pi * np.asarray(delay_cycles, float) * (self._geometry_columns[1] / 4) ** 2
        )
        curvature_factor = 1 / (1 + 1j * curvature_phase)
        mean = (
            (1 + 1j * gradients.relative_echo * t * curvature_factor)
            * np.exp(-0.5 * t * t * curvature_factor)
            * curvature_factor
        )
        return np.asarray(mean + np.zeros(self._n_points))

    @property
    def gradients(self) -> "BeamGradients":
        """Changes per standard deviation of the beam towards the near side, (n,) each."""
        grazing_angle, position_angles, _, transverse_velocity, *single_mode_columns = (
            self._geometry_columns
        )
        range_gradient = (position_angles / 4) / np.tan(grazing_angle)
        direction_sigma = (single_mode_columns[0] if single_mode_columns else position_angles) / 4
        echo_exponent = 3 if self._reflectance_law == "lambert" else 2
        columns = (
            2 / SPEED_OF_LIGHT * transverse_velocity * direction_sigma,
            -range_gradient,
            echo_exponent * range_gradient,
        )
        return BeamGradients(*(np.broadcast_to(column, self._n_points) for column in columns))

    def axis_line(self, n_points: int) -> BeamletTable:
        """Return one line for each point: a row for each distinct grazing angle."""
        grazing_angles, angle_index = np.unique(self._geometry_columns[0], return_inverse=True)
        relative_echo = backscatter(self._reflectance_law, np.sin(grazing_angles))[:, None]
        zeros = np.zeros_like(relative_echo)
        return BeamletTable(_row_indices(angle_index, n_points), zeros, zeros, relative_echo)

    @cached_property
    def beamlets(self) -> BeamletTable:
        """All beamlets of the footprint: a row for each distinct geometry."""
        first, geometry_of_point = distinct_rows(self._geometry_columns)
        geometries = np.stack(self._geometry_columns)[:, first]
        relative_range_offset, cos_incidence, weights, closing_offset = beamlets.plane_footprint(
            grazing_angle=geometries[0],
            beam_divergence=geometries[1],
            n_beamlets=self._n_beamlets,
            pattern=self._beamlet_pattern,
            radial_velocity=geometries[2],
            transverse_velocity=geometries[3],
            direction_angle=geometries[4] if len(geometries) > 4 else None,
        )
        range_loss = (1 + relative_range_offset) ** 2
        if len(geometries) > 4:
            first, second = geometries[5:, :, None]
            range_loss = 1 + relative_range_offset * (first + relative_range_offset * second)
        relative_echo = weights * backscatter(self._reflectance_law, cos_incidence) / range_loss
        doppler_ratio_offset = np.where(weights > 0, 2 * closing_offset / SPEED_OF_LIGHT, 0.0)
        return BeamletTable(
            _row_indices(geometry_of_point, self._n_points),
            relative_range_offset,
            doppler_ratio_offset,
            relative_echo,
        )


class RayTracedGround:
    """Footprints found by ray tracing.

    Parameters
    ----------
    beamlet_table : BeamletTable
        Positions and echoes of the beamlets.
    off_axis_surface : ndarray (rows, beamlets) bool, optional
        Beamlets that are not on the surface that the axis hits.
    """

    def __init__(
        self, beamlet_table: BeamletTable, off_axis_surface: np.ndarray | None = None
    ) -> None:
        self.beamlets, self.off_axis_surface = beamlet_table, off_axis_surface

    def axis_line(self, n_points: int) -> BeamletTable:
        """Return one line for each point, with the total echo of its beamlets."""
        total_echo = self.beamlets.relative_echo.sum(axis=1)[:, None]
        zeros = np.zeros_like(total_echo)
        return BeamletTable(self.beamlets.row_of_point, zeros, zeros, total_echo)


Ground = FlatGround | RayTracedGround
"""Ground that the beams of n points meet."""


def beamlets_add_as_powers(parameters: Mapping[str, Any]) -> bool:
    """Return True if the beamlets of points of one category add as powers."""
    incoherent = str(parameters["footprint.phases"]) == "incoherent"
    return incoherent and str(parameters["instrument.receiver.architecture"]) != "direct"


def beamlet_pattern(parameters: Mapping[str, Any]) -> str:
    """Return the pattern of the beamlets.

    It is the stated one; by default hexagonal if powers add, else a sunflower, which has no
    symmetry.
    """
    stated = str(parameters["footprint.pattern"])
    if stated != "auto":
        return stated
    return "hexagonal" if beamlets_add_as_powers(parameters) else "sunflower"


def _row_indices(row_of_point: np.ndarray, n_points: int) -> np.ndarray:
    """Broadcast row numbers to n points, (n,) int64."""
    return np.broadcast_to(row_of_point.ravel(), n_points).astype(np.int64)


class FootprintExtent(NamedTuple):
    """Extent of a footprint, and the line on its axis, by point."""

    axis_echo: np.ndarray
    """Echo of the line on the axis for a reflectance of 1 [1/sr]."""
    total_echo_ratio: np.ndarray | float
    """Echo of all beamlets over that of the line on the axis."""
    range_offsets: OffsetMoments
    """Moments of (R_b - R_0) / R_0."""
    axis_surface_range_offsets: OffsetMoments
    """Moments of (R_b - R_0) / R_0 of the beamlets on the axis's surface only."""
    velocity_offsets: OffsetMoments
    """Moments of the beamlets' radial velocities minus the axis's [m/s]."""
    amplitude_gain_max: np.ndarray | float = 1.0
    """Largest ratio of the beamlets' summed amplitude to that of the line on the axis, in phase or
    as powers."""
    off_axis_fraction: np.ndarray | float = 0.0
    """Fraction of the echo from surfaces other than the axis's, 0..1."""
    off_axis_range_offset_max: np.ndarray | float = 0.0
    """Largest |R_b - R_0| / R_0 on surfaces other than the axis's."""


def extent_of_ray_traced_ground(ground: RayTracedGround) -> FootprintExtent:
    """Return the extent of footprints found by ray tracing."""
    _, relative_range_offset, doppler_ratio_offset, relative_echo = ground.beamlets
    off_axis_surface = ground.off_axis_surface
    total_echo = relative_echo.sum(axis=1)
    power_fraction = relative_echo / np.where(total_echo > 0, total_echo, 1.0)[:, None]
    range_offsets = _weighted_moments(relative_range_offset, power_fraction)
    velocity_offsets = _weighted_moments(doppler_ratio_offset, power_fraction).scaled_by(
        np.asarray(SPEED_OF_LIGHT / 2)
    )
    amplitude_gain = np.sqrt(power_fraction).sum(axis=1)
    if off_axis_surface is None or not off_axis_surface.any():
        return FootprintExtent(
            total_echo, 1.0, range_offsets, range_offsets, velocity_offsets, amplitude_gain
        )
    off_axis_fraction = np.where(off_axis_surface, power_fraction, 0.0)
    on_axis_fraction = power_fraction - off_axis_fraction
    on_axis_total = on_axis_fraction.sum(axis=1)
    on_axis_range_offsets = _weighted_moments(
        relative_range_offset,
        on_axis_fraction / np.where(on_axis_total > 0, on_axis_total, 1.0)[:, None],
    )
    off_axis_range_max = np.where(off_axis_fraction > 0, np.abs(relative_range_offset), 0.0).max(
        axis=1
    )
    return FootprintExtent(
        total_echo,
        1.0,
        range_offsets,
        on_axis_range_offsets,
        velocity_offsets,
        amplitude_gain,
        off_axis_fraction.sum(axis=1),
        off_axis_range_max,
    )


def _weighted_moments(values: np.ndarray, weights: np.ndarray) -> OffsetMoments:
    """Return the moments of values (n, m) with weights (n, m)."""
    weighted = weights * values
    extreme = np.where(weights > 0, np.abs(values), 0.0).max(axis=1)
    return OffsetMoments(
        np.abs(weighted.sum(axis=1)), np.sqrt((weighted * values).sum(axis=1)), extreme
    )


def distinct_rows(columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Find the distinct rows of a table given by its columns.

    Parameters
    ----------
    columns : sequence of ndarray (n,)
        Columns of the table.

    Returns
    -------
    first_rows : ndarray (kinds,)
        Number of one row of each kind.
    kind_of_row : ndarray (n,)
        Kind of each row.
    """
    order = np.lexsort(columns)
    rows = np.stack(columns)[:, order]
    is_new = np.append(True, (rows[:, 1:] != rows[:, :-1]).any(axis=0))
    group_of_row = np.empty(order.size, np.int64)
    group_of_row[order] = np.cumsum(is_new) - 1
    return order[is_new], group_of_row
