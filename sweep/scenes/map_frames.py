"""Coordinates of maps: their scale on the ground, the unit of their heights, and their consistency.

The unit of a map is a metre on the map and not on the ground: in Web Mercator at 60 degrees north
it is half a metre on the ground. The scale is measured by geodesics on the map's own ellipsoid, at
the centre, on the edges and at the corners of the part that is read.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sweep.scenes.scene_files import SceneError
from sweep.units import QuantityError, read_unit

MAP_SCALE_ERROR_MAX = 1e-3
"""Largest relative error of distances on a map that is accepted without a warning or an error.

The error is that of metres per unit of the map against distances on the ground.
"""

STATED_SCALE_ERROR_MAX = 5e-2
"""Largest relative error of a map scale (metres per unit) that a user may state.

A scale with a larger error counts as a mistake.
"""

DEGREE_CELL_SIZE_MAX = 0.1
"""Cell size of a raster below which its coordinates may be degrees [unit of the coordinates].

It is used for rasters without a reference system, if coordinates are within 360 of longitude and 90
of latitude.
"""

MapBounds = tuple[float, float, float, float]
"""West, south, east and north bound of an area, in the coordinates of a map."""

_METRES_BY_HEIGHT_UNIT = (
    dict.fromkeys(("m", "metre", "meter", "metres", "meters"), 1.0)
    | dict.fromkeys(
        ("us survey foot", "us_survey_foot", "us survey feet", "us-ft", "sft", "ftus", "foot_us"),
        1200 / 3937,
    )
    | dict.fromkeys(("ft", "foot", "feet", "international foot", "international feet"), 0.3048)
)
"""Length of a unit of height [m], by the names that raster files give to the unit."""


class MetresPerUnit(NamedTuple):
    """Length on the ground of one unit of a map's coordinates [m], eastwards and northwards."""

    east: float
    """Metres on the ground per unit of the map's coordinates eastwards."""
    north: float
    """Metres on the ground per unit of the map's coordinates northwards."""


class UserStatedUnits(NamedTuple):
    """Units of a raster's coordinates and heights that the user states; None if not stated."""

    metres_per_degree: tuple[float, float] | None = None
    """Metres on the ground per degree, east and north; None if not stated."""
    metres_per_unit: tuple[float, float] | None = None
    """Metres on the ground per unit of the coordinates, east and north; None if not stated."""
    height_unit: str | None = None
    """Name of the unit of heights; None if not stated."""


@dataclass(frozen=True)
class MapFrame:
    """Reference system and scale of a raster's map coordinates."""

    metres_per_unit: MetresPerUnit
    """Metres on the ground per unit of the raster's coordinates, eastwards and northwards."""
    wkt: str = ""
    """Coordinate reference system as WKT (well-known text); empty if the raster states none."""
    warnings: tuple[str, ...] = ()
    """Warnings about the map's scale, as sentences."""

    def is_same_map(self, other: MapFrame) -> bool:
        """Return True if this and another map have the same horizontal reference system.

        The result is also True if one of the two maps states no reference system.
        """
        if not (self.wkt and other.wkt) or self.wkt == other.wkt:
            return True
        horizontal_crs, other_horizontal_crs = (
            _horizontal_crs(_crs_from_wkt(wkt)).to_2d() for wkt in (self.wkt, other.wkt)
        )
        return bool(horizontal_crs.equals(other_horizontal_crs, ignore_axis_order=True))

    def has_same_height_reference(self, other: MapFrame) -> bool:
        """Return True if the heights of this and another map refer to the same surface.

        The result is also True if one of the two maps states no surface.
        """
        return not (self.wkt and other.wkt) or _is_same_height_reference(
            _crs_from_wkt(self.wkt), _crs_from_wkt(other.wkt)
        )

    @property
    def height_reference_name(self) -> str:
        """Name of the surface from which heights are measured; empty if the map states none."""
        return _height_reference_name(_crs_from_wkt(self.wkt)) if self.wkt else ""

    @property
    def crs_name(self) -> str:
        """Name of the coordinate reference system; 'none' if the map states none."""
        return str(_crs_from_wkt(self.wkt).name) if self.wkt else "none"


def metric_projection_wkt_of_crs(wkt: str) -> str:
    """Return the WKT of a reference system if it is a map projection in metres, else ''.

    The argument `wkt` is that of the reference system. The result lacks the vertical part if
    heights are not in metres.
    """
    crs = _crs_from_wkt(wkt)
    horizontal = _horizontal_crs(crs)
    if not horizontal.is_projected or _horizontal_axis_unit(horizontal).metres != 1.0:
        return ""
    axis = _vertical_axis(crs)
    if axis is None or float(axis.unit_conversion_factor) == 1.0:
        return wkt
    return str(horizontal.to_2d().to_wkt("WKT1_GDAL"))


def metres_per_height_unit(unit: str) -> float:
    """Return the length of a unit of height [m], given its name.

    `QuantityError` is raised for an unknown unit.
    """
    word = unit.strip().lower()
    if word in _METRES_BY_HEIGHT_UNIT:
        return _METRES_BY_HEIGHT_UNIT[word]
    return float(read_unit(unit, si_unit="m", example="ft").to_si(Fraction(1)))


def resolve_metres_per_height_unit(
    path: Path, wkt: str, band_unit: str, stated_unit: str | None, has_height_scale: bool
) -> float:
    """Return the factor that converts the heights of a raster to metres.

    The unit of heights is stated by the user, by the raster's band, or by the vertical axis of the
    reference system. If none of them states it, it is the metre. But if the map's horizontal unit
    is not the metre, the unit of heights must be stated.

    Parameters
    ----------
    path : Path
        File of the raster, for errors.
    wkt : str
        Coordinate reference system as WKT; may be empty.
    band_unit : str
        Unit that the band states; may be empty.
    stated_unit : str or None
        Unit that the user states.
    has_height_scale : bool
        True if the spec has a factor for the heights, so that their unit is known.

    Raises
    ------
    SceneError
        If the unit is unknown or has to be stated, or if statements contradict each other.
    """
    declared_unit = _declared_height_unit(path, wkt, band_unit)
    if stated_unit is not None:
        factor = metres_per_height_unit(stated_unit)
        if declared_unit is not None and not math.isclose(declared_unit[1], factor, rel_tol=1e-9):
            problem = f"states heights in {declared_unit[0]}, and the spec says {stated_unit}"
            raise SceneError(path, problem, "leave height_unit out, or correct the file")
        declared_unit = (stated_unit, factor)
    if declared_unit is None:
        unit = _horizontal_axis_unit(_horizontal_crs(_crs_from_wkt(wkt))) if wkt else _METRE
        if unit.metres != 1.0 and not has_height_scale:
            problem = f"is in units of a {unit.name}, and does not tell the unit of its heights"
            raise SceneError(
                path, problem, f"state height_unit, 'm' or '{_short_unit_name(unit.name)}'"
            )
        return 1.0
    if has_height_scale and declared_unit[1] != 1.0:
        problem = (
            f"has heights in {declared_unit[0]}, which are turned into metres, and a scale beside "
            "that"
        )
        raise SceneError(path, problem, "leave the scale out")
    return declared_unit[1]


def _declared_height_unit(path: Path, wkt: str, band_unit: str) -> tuple[str, float] | None:
    """Return the name and the length [m] of the unit of heights that a raster file states.

    The result is None if the file states no unit.
    """
    crs = _crs_from_wkt(wkt) if wkt else None
    axis = _vertical_axis(crs) if crs is not None else None
    if axis is not None and axis.direction.lower() == "down":
        problem = f"holds depths, by its vertical reference system '{_height_reference_name(crs)}'"
        raise SceneError(path, problem, "turn them into heights with gdal_calc")
    map_unit = None if axis is None else (str(axis.unit_name), float(axis.unit_conversion_factor))
    if not band_unit.strip():
        return map_unit
    try:
        band_unit_scale = band_unit, metres_per_height_unit(band_unit)
    except QuantityError:
        remedy = "convert them to metres with gdal_calc"
        raise SceneError(path, f"has heights in '{band_unit}'", remedy) from None
    # 'ft' may be the international or the US survey foot, which differ by 2e-6: 2 cm in 10 km.
    if map_unit is not None and not math.isclose(map_unit[1], band_unit_scale[1], rel_tol=1e-5):
        problem = (
            f"contradicts itself: its band has heights in '{band_unit}', and its vertical "
            f"reference system '{_height_reference_name(crs)}' in units of a {map_unit[0]}"
        )
        remedy = "correct one of them: gdal_edit -units, or -a_srs"
        raise SceneError(path, problem, remedy)
    return band_unit_scale if map_unit is None else map_unit


def _short_unit_name(unit: str) -> str:
    """Return the short name of a unit of length, such as 'ft', given a name such as 'foot'."""
    return {"us survey foot": "sft", "foot": "ft"}.get(unit.lower(), unit)


def make_map_frame(
    path: Path, wkt: str, bounds: MapBounds, cell_size: float, stated: UserStatedUnits
) -> MapFrame:
    """Return the map frame of a raster, after a check of its scale on the ground.

    Parameters
    ----------
    path : Path
        File of the raster, for errors.
    wkt : str
        Coordinate reference system as WKT; empty for none.
    bounds : MapBounds
        Bounds of the part of the raster that is read.
    cell_size : float
        Smaller side of a cell, in the raster's coordinates.
    stated : UserStatedUnits
        Units that the user states.

    Raises
    ------
    SceneError
        If the size of a unit on the ground is unknown, or is wrong within the bounds by more than
        `MAP_SCALE_ERROR_MAX`. A size that the user states may be wrong by up to
        `STATED_SCALE_ERROR_MAX`, and gives a warning.
    """
    per_degree, per_unit = stated.metres_per_degree, stated.metres_per_unit
    for name, sizes in (("degree", per_degree), ("unit", per_unit)):
        if sizes is not None and not min(sizes) > 0:
            raise SceneError(path, f"has a {name} of {sizes} m", "make both sizes positive")
    if per_degree is not None and per_unit is not None:
        problem = "has both metres_per_degree and metres_per_unit"
        raise SceneError(path, problem, "leave one of them out")
    if not wkt:
        return _map_frame_without_crs(path, bounds, cell_size, per_degree or per_unit)
    crs = _horizontal_crs(_crs_from_raster_wkt(path, wkt))
    if crs.is_geographic:
        if per_unit is not None:
            raise SceneError(path, "is in degrees", "state metres_per_degree in place of unit")
        return _checked_map_frame(path, wkt, crs, bounds, per_degree, "metres_per_degree")
    if per_degree is not None:
        raise SceneError(path, "is not in degrees", "leave metres_per_degree out")
    if crs.is_geocentric:
        problem = "has coordinates from the centre of the planet"
        raise SceneError(path, problem, "reproject it with gdalwarp")
    return _checked_map_frame(path, wkt, crs, bounds, per_unit, "metres_per_unit")


def _map_frame_without_crs(
    path: Path, bounds: MapBounds, cell_size: float, stated: tuple[float, float] | None
) -> MapFrame:
    """Return the map frame of a raster without a reference system.

    Coordinates are in metres unless the user has `stated` metres per unit. `SceneError` is raised
    if the coordinates could be degrees.
    """
    if stated is not None:
        return MapFrame(MetresPerUnit(*stated))
    west, south, east, north = bounds
    may_be_degrees = -360 <= west < east <= 360 and -90 <= south < north <= 90
    if may_be_degrees and cell_size < DEGREE_CELL_SIZE_MAX:
        problem = (
            "names no coordinate reference system, and its coordinates could be degrees: they lie "
            f"within {west:.6g} to {east:.6g} and {south:.6g} to {north:.6g}, with cells of "
            f"{cell_size:.3g}"
        )
        east_size, north_size = degree_lengths((south + north) / 2)
        remedy = (
            f"state metres_per_degree, on Earth [{east_size:.1f}, {north_size:.1f}], or of "
            "coordinates in metres metres_per_unit: [1, 1]; or add its .prj file"
        )
        raise SceneError(path, problem, remedy)
    return MapFrame(MetresPerUnit(1.0, 1.0))


def _checked_map_frame(
    path: Path,
    wkt: str,
    crs: Any,
    bounds: MapBounds,
    stated: tuple[float, float] | None,
    field_name: str,
) -> MapFrame:
    """Return the map frame of a raster with a reference system, after a check of its scale.

    The metres per unit of the map are compared with distances on the ground. `stated` are the
    metres per unit that the user states, or None; `field_name` is the field of the spec that states
    them.
    """
    unit = "degree" if crs.is_geographic else "unit of its coordinates"
    if stated is None and not crs.is_geographic:
        factor = _horizontal_axis_unit(crs).metres
        factors = MetresPerUnit(factor, factor)
    elif stated is not None:
        factors = MetresPerUnit(*stated)
    else:
        factors = None
    scales, skew = _measure_scale_and_skew(path, crs, bounds)
    if scales is None:  # a local map of a site without a position on a planet
        assert factors is not None
        return MapFrame(factors, wkt)
    middle_scale = MetresPerUnit(*scales[len(scales) // 2])
    suggestion = f"{field_name}: [{middle_scale.east:.6g}, {middle_scale.north:.6g}]"
    if factors is None:
        problem = "is in degrees, which have no fixed size in metres"
        sizes = f"[{middle_scale.east:.1f}, {middle_scale.north:.1f}]"
        remedy = f"state metres_per_degree, here {sizes}, or reproject it with gdalwarp"
        raise SceneError(path, problem, remedy)
    scale_error = _largest_scale_error(factors, scales)
    if skew > MAP_SCALE_ERROR_MAX:
        problem = f"has axes that are {math.degrees(skew):.3g} deg off a right angle on the ground"
        raise SceneError(path, problem, _reprojection_remedy(crs, bounds))
    if scale_error <= MAP_SCALE_ERROR_MAX:
        return MapFrame(factors, wkt)
    message = (
        f"takes a {unit} for {factors.east:.6g} m eastwards and {factors.north:.6g} m northwards, "
        f"and on the ground it is {middle_scale.east:.6g} m and {middle_scale.north:.6g} m in its "
        "middle: "
        f"off by up to {100 * scale_error:.3g} %"
    )
    if stated is None or scale_error > STATED_SCALE_ERROR_MAX:
        raise SceneError(
            path, message, f"state {suggestion}, or {_reprojection_remedy(crs, bounds)}"
        )
    return MapFrame(factors, wkt, (f"{path}: {message}; read a smaller window, or reproject it",))


def _largest_scale_error(factors: MetresPerUnit, scales: np.ndarray) -> float:
    """Return the largest relative error of a map's assumed metres per unit.

    `factors` are the assumed metres per unit. `scales` (n, 2) are metres on the ground per unit
    eastwards and northwards, measured at n points.
    """
    return float(np.abs(np.array(factors) / scales - 1).max())


def _measure_scale_and_skew(
    path: Path, crs: Any, bounds: MapBounds
) -> tuple[np.ndarray | None, float]:
    """Measure the scale of a map on the ground, and the angle between its axes.

    Parameters
    ----------
    path : Path
        File of the raster, for errors.
    crs : pyproj.CRS
        Horizontal reference system.
    bounds : MapBounds
        Bounds of the part that is read.

    Returns
    -------
    scales : ndarray, shape (9, 2), or None
        Metres on the ground per unit of the map eastwards and northwards, at nine points; None for
        a map without a position on a planet.
    skew : float
        Largest deviation of the axes from a right angle [rad].
    """
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    geographic = crs if crs.is_geographic else crs.geodetic_crs
    if geographic is None:
        return None, 0.0
    geod = geographic.get_geod()
    west, south, east, north = bounds
    x, y = (
        coordinates.ravel()
        for coordinates in np.meshgrid(np.linspace(west, east, 3), np.linspace(south, north, 3))
    )
    if crs.is_geographic:  # keep geodesics off the poles
        y = np.clip(y, -89.999, 89.999)
    geodesic_step = 1e-4 * max(east - west, north - south)
    try:
        to_degrees = Transformer.from_crs(crs, geographic, always_xy=True).transform
        azimuths, length_scales = [], []
        for dx, dy in ((geodesic_step, 0.0), (0.0, geodesic_step)):
            start, stop = (to_degrees(x + k * dx / 2, y + k * dy / 2) for k in (-1, 1))
            azimuth, _, length = geod.inv(*start, *stop)
            azimuths.append(np.radians(azimuth))
            length_scales.append(np.asarray(length) / geodesic_step)
    except ProjError as error:
        problem = f"has coordinates that can not be placed on the ground ({error})"
        raise SceneError(path, problem, "check its coordinate reference system") from None
    scales = np.stack(length_scales, axis=1)
    if not (np.isfinite(scales).all() and (scales > 0).all()):
        problem = "has coordinates that lie outside its coordinate reference system"
        raise SceneError(path, problem, "check that system, or read a window within it")
    axes_sine = np.abs(np.sin(azimuths[0] - azimuths[1]))
    return scales, float(np.abs(np.arccos(np.clip(axes_sine, 0.0, 1.0))).max())


def _reprojection_remedy(crs: Any, bounds: MapBounds) -> str:
    """Return the advice to reproject a map, as text with a projection that suits its centre."""
    from pyproj import Transformer

    geographic = crs if crs.is_geographic else crs.geodetic_crs
    middle = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    longitude, latitude = Transformer.from_crs(crs, geographic, always_xy=True).transform(*middle)
    remedy = "reproject it with gdalwarp"
    if abs(crs.ellipsoid.semi_major_metre - WGS84_RADIUS) > 1e4:  # another planet
        centre_text = f"+lon_0={longitude:.4f} +lat_0={latitude:.4f}"
        return (
            f"{remedy}, e.g. -t_srs '+proj=stere {centre_text} "
            f"+R={crs.ellipsoid.semi_major_metre:.0f}'"
        )
    if abs(latitude) > UTM_LATITUDE_MAX:
        return (
            f"{remedy}, e.g. -t_srs '+proj=stere +lon_0={longitude:.4f} +lat_0={latitude:.4f} "
            "+datum=WGS84'"
        )
    zone = min(max(math.floor((longitude + 180) / 6) + 1, 1), 60)
    return f"{remedy}, e.g. -t_srs EPSG:{326 if latitude >= 0 else 327}{zone:02d}"


# Reference systems


def _crs_from_wkt(wkt: str) -> Any:
    """Return the pyproj reference system that a WKT (well-known text) describes."""
    from pyproj import CRS

    return CRS.from_wkt(wkt)


def _crs_from_raster_wkt(path: Path, wkt: str) -> Any:
    """Return the pyproj reference system of a raster; raise `SceneError` if its WKT is invalid."""
    from pyproj.exceptions import CRSError

    try:
        return _crs_from_wkt(wkt)
    except CRSError as error:
        problem = f"has a coordinate reference system that can not be read ({error})"
        raise SceneError(path, problem, "state it anew with gdal_edit -a_srs") from None


def _horizontal_crs(crs: Any) -> Any:
    """Return the horizontal part of a pyproj reference system, without datum transformations."""
    while crs.is_bound or crs.is_compound:
        crs = crs.source_crs if crs.is_bound else crs.sub_crs_list[0]
    return crs


def _vertical_crs(crs: Any) -> Any:
    """Return the part of a pyproj reference system that defines heights; None if it has none.

    The part is a vertical reference system, or one with three axes.
    """
    while crs.is_bound:
        crs = crs.source_crs
    component_crs = crs.sub_crs_list if crs.is_compound else [crs]
    for component in component_crs:
        while component.is_bound:
            component = component.source_crs
        if component.is_vertical or (len(component.axis_info) == 3 and not component.is_geocentric):
            return component
    return None


def _vertical_axis(crs: Any) -> Any:
    """Return the height axis of a pyproj reference system; None if it has none."""
    vertical = _vertical_crs(crs)
    axes = vertical.axis_info if vertical is not None else []
    return axes[-1] if axes else None


def _height_reference_name(crs: Any) -> str:
    """Return the name of the surface from which a reference system measures heights.

    The name is empty if the system has no heights.
    """
    vertical = _vertical_crs(crs)
    if vertical is None:
        return ""
    return str(vertical.name) if vertical.is_vertical else f"ellipsoid {vertical.ellipsoid.name}"


def _is_same_height_reference(crs: Any, other_crs: Any) -> bool:
    """Return True if two reference systems measure heights from the same surface.

    The units of the heights may differ. The result is also True if one of the systems has no
    heights.
    """
    first, second = _vertical_crs(crs), _vertical_crs(other_crs)
    if first is None or second is None:
        return True
    if first.is_vertical and second.is_vertical:
        return bool(first.datum == second.datum)
    return _height_reference_name(crs) == _height_reference_name(other_crs)


class LengthUnit(NamedTuple):
    """Unit of length of a map."""

    name: str
    """Name of the unit."""
    metres: float
    """Length of the unit [m]."""


_METRE = LengthUnit("metre", 1.0)
"""Unit of the coordinates of a map that states no unit, or that is in degrees."""


def _horizontal_axis_unit(crs: Any) -> LengthUnit:
    """Return the name and length [m] of the unit of a map's horizontal axes.

    A map in degrees gives 'metre' and 1.
    """
    axes = crs.axis_info
    if crs.is_geographic or not axes:
        return _METRE
    return LengthUnit(str(axes[0].unit_name), float(axes[0].unit_conversion_factor))


UTM_LATITUDE_MAX = 80.0
"""Largest latitude, north or south, at which UTM zones are defined [deg]."""

WGS84_RADIUS, WGS84_FLATTENING = 6_378_137.0, 1 / 298.257223563
"""Semi-major axis [m] and flattening of the WGS84 ellipsoid."""


def degree_lengths(
    latitude: float, *, radius: float = WGS84_RADIUS, flattening: float = WGS84_FLATTENING
) -> MetresPerUnit:
    """Return the lengths of a degree of longitude and of latitude on an ellipsoid.

    Parameters
    ----------
    latitude : float
        Geodetic latitude [deg].
    radius : float
        Semi-major axis of the ellipsoid [m].
    flattening : float
        Flattening of the ellipsoid.

    Returns
    -------
    MetresPerUnit
        Metres per degree of longitude and per degree of latitude.

    Notes
    -----
    Over a grid that spans h radians of latitude, the relative error of the east-west scale is up to
    ``tan(latitude) h/2`` at the edges.
    """
    eccentricity_squared = flattening * (2 - flattening)
    latitude_rad = math.radians(latitude)
    curvature_term = 1 - eccentricity_squared * math.sin(latitude_rad) ** 2
    prime_vertical_radius = radius / math.sqrt(curvature_term)
    meridional_radius = radius * (1 - eccentricity_squared) / curvature_term**1.5
    return MetresPerUnit(
        east=math.radians(prime_vertical_radius * math.cos(latitude_rad)),
        north=math.radians(meridional_radius),
    )


def require_same_map(map_frames: Sequence[tuple[str, MapFrame]]) -> None:
    """Raise `SceneError` if rasters do not belong to one map; the error names two of them.

    Parameters
    ----------
    map_frames : sequence of (str, MapFrame)
        Names of the objects and their maps.
    """
    for k, (name, map_frame) in enumerate(map_frames):
        for other_name, other in map_frames[:k]:
            object_path = f"scene.objects.{name}"
            if not map_frame.is_same_map(other):
                problem = (
                    f"lies on the map '{map_frame.crs_name}', and {other_name} on "
                    f"'{other.crs_name}'"
                )
                raise SceneError(object_path, problem, "reproject one of them with gdalwarp")
            if not map_frame.has_same_height_reference(other):
                problem = (
                    f"has heights above '{map_frame.height_reference_name}', and {other_name} "
                    "above "
                    f"'{other.height_reference_name}'"
                )
                remedy = "bring both to one vertical reference system with gdalwarp -t_srs"
                raise SceneError(object_path, problem, remedy)
            if map_frame.metres_per_unit != other.metres_per_unit:
                sizes, other_sizes = tuple(map_frame.metres_per_unit), tuple(other.metres_per_unit)
                problem = (
                    f"takes a unit of its map for {sizes} m, and {other_name} for {other_sizes} m"
                )
                raise SceneError(object_path, problem, "state one size for both")
