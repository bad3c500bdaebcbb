"""Ground that beams meet: a flat plane, or footprints by ray tracing.

Either can be represented by one line on the beam's axis, or by beamlets.

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
"""Names of the reflectance laws that :func:`backscatter` evaluates."""


def backscatter(law: str, cos_incidence: np.ndarray) -> np.ndarray:
    """Return the fraction of power that a surface of reflectance 1 scatters back [1/sr].

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
    albedo w p(0) (1 + B(0)) / 8, with the single-scattering albedo w, the phase function p and the
    opposition surge B. At normal incidence the normal albedo equals Lambert's reflectance.
    """
    if law == "thesis":
        return np.full_like(cos_incidence, 0.5 / math.pi)
    if law == "lambert":
        return cos_incidence / math.pi
    return np.full_like(cos_incidence, 1 / math.pi)


class BeamletTable(NamedTuple):
    """Range offsets, Doppler offsets and echoes of the beamlets of n points.

    Points of equal geometry share a row.
    """

    row_of_point: np.ndarray
    """(n,) int64: index of each point's row in the table."""
    relative_range_offset: np.ndarray
    """(rows, beamlets): range of a beamlet minus that on the axis, divided by the range on the
    axis."""
    doppler_ratio_offset: np.ndarray
    """(rows, beamlets): Doppler ratio 2 v_r / c of a beamlet minus that on the axis, with the
    radial velocity v_r."""
    relative_echo: np.ndarray
    """(rows, beamlets): echo of a beamlet for reflectance 1 [1/sr]: its power fraction times the
    backscatter, divided by the range loss. The range loss is relative to the range on the axis."""


class BeamGradients(NamedTuple):
    """Changes of Doppler ratio, range and echo across a footprint.

    The changes are per standard deviation of the beam, (n,) each.
    """

    doppler_ratio: np.ndarray
    """(n,): change of the Doppler ratio 2 v_r / c per standard deviation of the beam, with the
    radial velocity v_r."""
    relative_range: np.ndarray
    """(n,): relative change of the range over one standard deviation of the beam."""
    relative_echo: np.ndarray
    """(n,): relative change of the echo power over one standard deviation of the beam."""


class _PlaneGeometry(NamedTuple):
    """Angles, velocities and range losses of beams on a plane, (n,) each.

    The last three fields are None if the beam has a constant divergence.
    """

    grazing_angle: np.ndarray
    """Angle between the beam and the plane [rad], pi/2 at normal incidence."""
    position_spread_angle: np.ndarray
    """Full 1/e^2 angle [rad] that the illuminated positions on the target subtend at the lidar."""
    radial_velocity: np.ndarray
    """Radial velocity on the beam's axis [m/s], positive when closing; 0 if all beamlets share one
    velocity."""
    transverse_velocity: np.ndarray
    """Velocity across the beam [m/s]; 0 if all beamlets share one velocity."""
    direction_spread_angle: np.ndarray | None = None
    """Full 1/e^2 angle of the spread of light directions [rad]; None if it is
    `position_spread_angle`."""
    range_loss_linear_coefficient: np.ndarray | None = None
    """Coefficient b of the range loss 1 + b x + c x^2 for a relative range change x. None stands
    for the loss (1 + x)^2."""
    range_loss_quadratic_coefficient: np.ndarray | None = None
    """Coefficient c of the range loss 1 + b x + c x^2 for a relative range change x. None stands
    for the loss (1 + x)^2."""

    @property
    def direction_sigma(self) -> np.ndarray:
        """Standard deviation of the light directions along each axis of the beam [rad]."""
        angle = (
            self.position_spread_angle
            if self.direction_spread_angle is None
            else self.direction_spread_angle
        )
        return angle / 4


class FlatGround:
    """Flat ground that the beams of n points with the same text parameters meet.

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

    is_on_other_surface = None
    """Mask of beamlets that hit another surface than the beam's axis does. It is None, because a
    plane is a single surface."""

    def __init__(
        self, parameters: Mapping[str, np.ndarray], n_points: int, *, has_velocities: bool = True
    ) -> None:
        self._reflectance_law = str(parameters["target.reflectance_law"])
        self._n_beamlets = int(parameters["footprint.beamlets"])
        self._beamlet_pattern = beamlet_pattern(parameters)
        position_spread_angles, direction_spread_angles = beam.footprint_full_angles(parameters)
        velocity_paths = "target.radial_velocity", "target.transverse_velocity"
        velocities = [parameters[name] if has_velocities else 0.0 for name in velocity_paths]
        single_mode_columns = (
            ()
            if beam.has_constant_divergence(parameters)
            else (direction_spread_angles, *beam.range_loss_coefficients(parameters))
        )
        columns = np.broadcast_arrays(
            parameters["target.grazing_angle"],
            position_spread_angles,
            *velocities,
            *single_mode_columns,
        )
        self._geometry = _PlaneGeometry(*(np.atleast_1d(column) for column in columns))
        self._n_points = n_points

    def mean_phasor(self, doppler_cycles: np.ndarray, delay_cycles: np.ndarray) -> np.ndarray:
        """Return the mean phasor of the echo over the beam, (n,) complex.

        The phasor at a position of the beam is exp(2 pi i (doppler_cycles db - delay_cycles dR /
        R)). db is the Doppler ratio minus that on the axis, dR the range minus the range R on the
        axis.

        Parameters
        ----------
        doppler_cycles : array_like
            Cycles per unit of the Doppler ratio, (n,) or scalar.
        delay_cycles : array_like
            Cycles per unit of the relative range dR / R, (n,) or scalar.

        Notes
        -----
        To second order a beamlet x across and y along the slope, in standard deviations, has the
        phase t y + c (x^2 + y^2), and its echo is proportional to 1 + k y. With Gaussian x and y
        the mean is

            (1 + i k t / (1 - 2 i c)) exp(-t^2 / 2 / (1 - 2 i c)) / (1 - 2 i c)
        """
        geometry, gradients = self._geometry, self.gradients
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
        curvature_phase = phase_per_speed * geometry.radial_velocity * geometry.direction_sigma**2
        curvature_phase = (
            curvature_phase
            + 2
            * np.pi
            * np.asarray(delay_cycles, float)
            * (geometry.position_spread_angle / 4) ** 2
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
        """Changes of Doppler ratio, range and echo per standard deviation of the beam.

        The changes are towards the near side of the plane.
        """
        geometry = self._geometry
        range_gradient = (geometry.position_spread_angle / 4) / np.tan(geometry.grazing_angle)
        echo_exponent = 3 if self._reflectance_law == "lambert" else 2
        columns = (
            2 / SPEED_OF_LIGHT * geometry.transverse_velocity * geometry.direction_sigma,
            -range_gradient,
            echo_exponent * range_gradient,
        )
        return BeamGradients(*(np.broadcast_to(column, self._n_points) for column in columns))

    def axis_beamlet_table(self, n_points: int) -> BeamletTable:
        """Return a table with one beamlet per footprint, on the beam's axis.

        The table has a row for each distinct grazing angle, which the `n_points` points share.
        """
        grazing_angles, angle_index = np.unique(self._geometry.grazing_angle, return_inverse=True)
        relative_echo = backscatter(self._reflectance_law, np.sin(grazing_angles))[:, None]
        zeros = np.zeros_like(relative_echo)
        return BeamletTable(
            _table_rows_of_points(angle_index, n_points), zeros, zeros, relative_echo
        )

    @cached_property
    def beamlet_table(self) -> BeamletTable:
        """Table of all beamlets of the footprints; points of equal geometry share a row."""
        columns = [column for column in self._geometry if column is not None]
        first, geometry_of_point = find_distinct_rows(columns)
        geometry = _PlaneGeometry(*np.stack(columns)[:, first])
        relative_range_offset, cos_incidence, weights, closing_offset = beamlets.plane_footprint(
            grazing_angle=geometry.grazing_angle,
            beam_divergence=geometry.position_spread_angle,
            n_beamlets=self._n_beamlets,
            pattern=self._beamlet_pattern,
            radial_velocity=geometry.radial_velocity,
            transverse_velocity=geometry.transverse_velocity,
            direction_spread_angle=geometry.direction_spread_angle,
        )
        range_loss = (1 + relative_range_offset) ** 2
        if (
            geometry.range_loss_linear_coefficient is not None
            and geometry.range_loss_quadratic_coefficient is not None
        ):
            linear = geometry.range_loss_linear_coefficient[:, None]
            quadratic = geometry.range_loss_quadratic_coefficient[:, None]
            range_loss = 1 + relative_range_offset * (linear + relative_range_offset * quadratic)
        relative_echo = weights * backscatter(self._reflectance_law, cos_incidence) / range_loss
        doppler_ratio_offset = np.where(weights > 0, 2 * closing_offset / SPEED_OF_LIGHT, 0.0)
        return BeamletTable(
            _table_rows_of_points(geometry_of_point, self._n_points),
            relative_range_offset,
            doppler_ratio_offset,
            relative_echo,
        )


class RayTracedGround:
    """Ground whose footprints are given by ray tracing.

    Parameters
    ----------
    beamlet_table : BeamletTable
        Offsets and echoes of the beamlets.
    is_on_other_surface : ndarray (rows, beamlets) bool, optional
        True for beamlets on other surfaces than the beam's axis.
    """

    def __init__(
        self, beamlet_table: BeamletTable, is_on_other_surface: np.ndarray | None = None
    ) -> None:
        self.beamlet_table, self.is_on_other_surface = beamlet_table, is_on_other_surface

    def axis_beamlet_table(self, n_points: int) -> BeamletTable:
        """Return a table with one beamlet per footprint, on the beam's axis, for `n_points` points.

        The beamlet has the summed echo of all beamlets of the footprint.
        """
        total_echo = self.beamlet_table.relative_echo.sum(axis=1)[:, None]
        zeros = np.zeros_like(total_echo)
        return BeamletTable(self.beamlet_table.row_of_point, zeros, zeros, total_echo)


Ground = FlatGround | RayTracedGround
"""Type of the ground that the beams of n points meet: a plane or ray-traced footprints."""


def beamlets_add_as_powers(parameters: Mapping[str, Any]) -> bool:
    """Return True if the powers of beamlets add, False if their amplitudes do.

    All points must share their text parameters.
    """
    incoherent = str(parameters["footprint.phases"]) == "incoherent"
    return incoherent and str(parameters["instrument.receiver.architecture"]) != "direct"


def beamlet_pattern(parameters: Mapping[str, Any]) -> str:
    """Return the name of the beamlets' pattern, one of `sweep.model.beamlets.BEAMLET_PATTERNS`.

    A pattern that is not stated is hexagonal if powers add. It is a sunflower, which has no
    symmetry, if amplitudes add.
    """
    stated = str(parameters["footprint.pattern"])
    if stated != "auto":
        return stated
    return "hexagonal" if beamlets_add_as_powers(parameters) else "sunflower"


def _table_rows_of_points(row_of_point: np.ndarray, n_points: int) -> np.ndarray:
    """Return the index of each point's table row, (n,) int64.

    ``row_of_point`` is (n,), or the one row that all points share.
    """
    return np.broadcast_to(row_of_point.ravel(), n_points).astype(np.int64)


class FootprintExtent(NamedTuple):
    """Echoes of n points' footprints, and moments of their ranges and velocities, (n,) each."""

    axis_echo: np.ndarray
    """Echo of a single line on the beam's axis for reflectance 1 [1/sr]."""
    total_to_axis_echo_ratio: np.ndarray | float
    """Echo of all beamlets, divided by that of a single line on the beam's axis."""
    range_offset_moments: OffsetMoments
    """Moments of the beamlets' relative range offsets: range minus the range on the beam's axis,
    over the range on the beam's axis."""
    axis_surface_range_offset_moments: OffsetMoments
    """Moments as in `range_offset_moments`, of only those beamlets that hit the same surface as the
    beam's axis."""
    velocity_offset_moments: OffsetMoments
    """Moments of the beamlets' radial velocities minus that on the beam's axis [m/s]."""
    amplitude_gain_max: np.ndarray | float = 1.0
    """Largest ratio of the beamlets' total amplitude to that of the single line on the axis, with
    beamlets in phase or with powers that add."""
    other_surface_echo_fraction: np.ndarray | float = 0.0
    """Fraction of the echo that comes from surfaces which the beam's axis does not hit, 0..1."""
    other_surface_range_offset_max: np.ndarray | float = 0.0
    """Largest magnitude of (range minus axis range, over axis range) of beamlets on surfaces that
    the beam's axis does not hit."""


def ray_traced_footprint_extent(ground: RayTracedGround) -> FootprintExtent:
    """Return the :class:`FootprintExtent` of ray-traced footprints."""
    _, relative_range_offset, doppler_ratio_offset, relative_echo = ground.beamlet_table
    is_on_other_surface = ground.is_on_other_surface
    total_echo = relative_echo.sum(axis=1)
    power_fraction = relative_echo / np.where(total_echo > 0, total_echo, 1.0)[:, None]
    range_offset_moments = _weighted_moments(relative_range_offset, power_fraction)
    velocity_offset_moments = _weighted_moments(doppler_ratio_offset, power_fraction).scaled_by(
        np.asarray(SPEED_OF_LIGHT / 2)
    )
    amplitude_gain = np.sqrt(power_fraction).sum(axis=1)
    if is_on_other_surface is None or not is_on_other_surface.any():
        return FootprintExtent(
            total_echo,
            1.0,
            range_offset_moments,
            range_offset_moments,
            velocity_offset_moments,
            amplitude_gain,
        )
    other_surface_echo_fraction = np.where(is_on_other_surface, power_fraction, 0.0)
    axis_surface_fraction = power_fraction - other_surface_echo_fraction
    axis_surface_total = axis_surface_fraction.sum(axis=1)
    axis_surface_range_offset_moments = _weighted_moments(
        relative_range_offset,
        axis_surface_fraction / np.where(axis_surface_total > 0, axis_surface_total, 1.0)[:, None],
    )
    off_axis_range_max = np.where(
        other_surface_echo_fraction > 0, np.abs(relative_range_offset), 0.0
    ).max(axis=1)
    return FootprintExtent(
        total_echo,
        1.0,
        range_offset_moments,
        axis_surface_range_offset_moments,
        velocity_offset_moments,
        amplitude_gain,
        other_surface_echo_fraction.sum(axis=1),
        off_axis_range_max,
    )


def _weighted_moments(values: np.ndarray, weights: np.ndarray) -> OffsetMoments:
    """Return the weighted :class:`OffsetMoments` (n,) of ``values`` (n, m).

    ``weights`` (n, m) sum to 1 in each row.
    """
    weighted = weights * values
    extreme = np.where(weights > 0, np.abs(values), 0.0).max(axis=1)
    return OffsetMoments(
        np.abs(weighted.sum(axis=1)), np.sqrt((weighted * values).sum(axis=1)), extreme
    )


def find_distinct_rows(columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Find the distinct rows of a table whose columns are separate arrays.

    Parameters
    ----------
    columns : sequence of ndarray (n,)
        Columns of the table.

    Returns
    -------
    first_rows : ndarray (distinct,)
        Indices of table rows that all differ, one for each distinct row.
    distinct_of_row : ndarray (n,)
        For each row of the table, the index in `first_rows` of the equal row.
    """
    order = np.lexsort(columns)
    rows = np.stack(columns)[:, order]
    is_new = np.append(True, (rows[:, 1:] != rows[:, :-1]).any(axis=0))
    group_of_row = np.empty(order.size, np.int64)
    group_of_row[order] = np.cumsum(is_new) - 1
    return order[is_new], group_of_row
