"""Coordinates of maps: metres to their units on the ground, their heights' unit, their agreement.

A map's unit is a metre only by name: in Web Mercator at 60 degrees north it is half a metre on the
ground. The size of a unit is measured by geodesics on the map's own ellipsoid, in the middle, on
the edges and at the corners of what is read.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sweep.scenes.files import SceneError
from sweep.units import QuantityError, read_unit

SCALE_ERROR = 1e-3
"""Relative error of a map's scale up to which its coordinates are taken as they are."""

STATED_SCALE_ERROR = 5e-2
"""The same, of a scale that the user states, beyond which it is taken for a mistake."""

DEGREES_CELL_MAX = 0.1
"""Cell size below which coordinates that could be longitudes and latitudes are taken for these."""

Box = tuple[float, float, float, float]
"""West, south, east and north, in a map's own coordinates."""

_UNITS = dict.fromkeys(("m", "metre", "meter", "metres", "meters"), 1.0) | dict.fromkeys(
    ("us survey foot", "us_survey_foot", "us survey feet", "us-ft", "sft", "ftus", "foot_us"),
    1200 / 3937,
) | dict.fromkeys(
    ("ft", "foot", "feet", "international foot", "international feet"), 0.3048
)  # fmt: skip
"""Metres to a unit of height, by the names that rasters give to it."""


class Factors(NamedTuple):
    """Metres on the ground to a unit of a map's coordinates."""

    east: float
    north: float


class Stated(NamedTuple):
    """A user's statements on a raster's coordinates and heights; None if left out."""

    metres_per_degree: tuple[float, float] | None = None
    metres_per_unit: tuple[float, float] | None = None
    height_unit: str | None = None


@dataclass(frozen=True)
class MapFrame:
    """Map that a raster's coordinates belong to."""

    factors: Factors
    """Metres that its coordinates were multiplied by."""
    wkt: str = ""
    """Coordinate reference system; '' for none."""
    warnings: tuple[str, ...] = ()

    def same_as(self, other: MapFrame) -> bool:
        """Return true if two maps have one coordinate reference system, or one has none."""
        if not (self.wkt and other.wkt) or self.wkt == other.wkt:
            return True
        one, another = (_horizontal(_crs(wkt)).to_2d() for wkt in (self.wkt, other.wkt))
        return bool(one.equals(another, ignore_axis_order=True))

    def same_heights_as(self, other: MapFrame) -> bool:
        """Return true if heights on two maps are above one surface, or one map tells none."""
        return not (self.wkt and other.wkt) or _same_heights(_crs(self.wkt), _crs(other.wkt))

    @property
    def height_reference(self) -> str:
        """Name of the surface that its heights are above; '' for none."""
        return _height_reference(_crs(self.wkt)) if self.wkt else ""

    @property
    def name(self) -> str:
        """Name of the coordinate reference system."""
        return str(_crs(self.wkt).name) if self.wkt else "none"


def projection_of_metres(wkt: str) -> str:
    """WKT of a map projection in metres, without its vertical part if that is not; else ''."""
    crs = _crs(wkt)
    horizontal = _horizontal(crs)
    if not horizontal.is_projected or _linear_unit(horizontal)[1] != 1.0:
        return ""
    axis = _height_axis(crs)
    if axis is None or float(axis.unit_conversion_factor) == 1.0:
        return wkt
    return str(horizontal.to_2d().to_wkt("WKT1_GDAL"))


def height_metres(unit: str) -> float:
    """Metres to a unit of height; QuantityError for a word that is none."""
    word = unit.strip().lower()
    if word in _UNITS:
        return _UNITS[word]
    return float(read_unit(unit, si_unit="m", example="ft").to_si(Fraction(1)))


def height_factor(path: Path, wkt: str, band_unit: str, stated: str | None, scaled: bool) -> float:
    """Metres to a unit of a raster's heights.

    The unit is that of the band, or of the vertical axis of the reference system, or what is
    stated. If nothing tells it, it is the metre, unless the map is in another unit: then it is
    asked for. `scaled`: the spec has a factor for the heights, which tells their unit too.
    """
    declared = _declared_unit(path, wkt, band_unit)
    if stated is not None:
        factor = height_metres(stated)
        if declared is not None and not math.isclose(declared[1], factor, rel_tol=1e-9):
            rule = f"states heights in {declared[0]}, and the spec says {stated}"
            raise SceneError(path, rule, "leave height_unit out, or correct the file")
        declared = (stated, factor)
    if declared is None:
        unit = _linear_unit(_horizontal(_crs(wkt))) if wkt else ("metre", 1.0)
        if unit[1] != 1.0 and not scaled:
            rule = f"is in units of a {unit[0]}, and does not tell the unit of its heights"
            raise SceneError(path, rule, f"state height_unit, 'm' or '{_short(unit[0])}'")
        return 1.0
    if scaled and declared[1] != 1.0:
        rule = (
            f"has heights in {declared[0]}, which are turned into metres, and a scale beside that"
        )
        raise SceneError(path, rule, "leave the scale out")
    return declared[1]


def _declared_unit(path: Path, wkt: str, band_unit: str) -> tuple[str, float] | None:
    """Return the unit of heights that a raster declares itself, and metres to it."""
    crs = _crs(wkt) if wkt else None
    axis = _height_axis(crs) if crs is not None else None
    if axis is not None and axis.direction.lower() == "down":
        rule = f"holds depths, by its vertical reference system '{_height_reference(crs)}'"
        raise SceneError(path, rule, "turn them into heights with gdal_calc")
    of_map = None if axis is None else (str(axis.unit_name), float(axis.unit_conversion_factor))
    if not band_unit.strip():
        return of_map
    try:
        of_band = band_unit, height_metres(band_unit)
    except QuantityError:
        remedy = "convert them to metres with gdal_calc"
        raise SceneError(path, f"has heights in '{band_unit}'", remedy) from None
    # 'ft' is written for either foot: they differ by 2e-6, 2 cm in 10 km.
    if of_map is not None and not math.isclose(of_map[1], of_band[1], rel_tol=1e-5):
        rule = (
            f"contradicts itself: its band has heights in '{band_unit}', and its vertical "
            f"reference system '{_height_reference(crs)}' in units of a {of_map[0]}"
        )
        remedy = "correct one of them: gdal_edit -units, or -a_srs"
        raise SceneError(path, rule, remedy)
    return of_band if of_map is None else of_map


def _short(unit: str) -> str:
    """Short name of a unit of length that a reference system names."""
    return {"us survey foot": "sft", "foot": "ft"}.get(unit.lower(), unit)


def map_frame_of(path: Path, wkt: str, bounds: Box, cell: float, stated: Stated) -> MapFrame:
    """MapFrame of a raster of a reference system (WKT, '' for none), over the bounds that are read.

    `cell` is the smaller side of a cell, in the raster's coordinates. SceneError where the size of
    a unit on the ground is not known, or differs over the bounds by more than `SCALE_ERROR`.
    """
    per_degree, per_unit = stated.metres_per_degree, stated.metres_per_unit
    for name, sizes in (("degree", per_degree), ("unit", per_unit)):
        if sizes is not None and not min(sizes) > 0:
            raise SceneError(path, f"has a {name} of {sizes} m", "make both sizes positive")
    if per_degree is not None and per_unit is not None:
        rule = "has both metres_per_degree and metres_per_unit"
        raise SceneError(path, rule, "leave one of them out")
    if not wkt:
        return _map_frame_of_none(path, bounds, cell, per_degree or per_unit)
    crs = _horizontal(_crs_of_file(path, wkt))
    if crs.is_geographic:
        if per_unit is not None:
            raise SceneError(path, "is in degrees", "state metres_per_degree in place of unit")
        return _measured(path, wkt, crs, bounds, per_degree, "metres_per_degree")
    if per_degree is not None:
        raise SceneError(path, "is not in degrees", "leave metres_per_degree out")
    if crs.is_geocentric:
        rule = "has coordinates from the centre of the planet"
        raise SceneError(path, rule, "reproject it with gdalwarp")
    return _measured(path, wkt, crs, bounds, per_unit, "metres_per_unit")


def _map_frame_of_none(
    path: Path, bounds: Box, cell: float, stated: tuple[float, float] | None
) -> MapFrame:
    """MapFrame of a raster without a reference system: metres, unless that can not be."""
    if stated is not None:
        return MapFrame(Factors(*stated))
    west, south, east, north = bounds
    on_globe = -360 <= west < east <= 360 and -90 <= south < north <= 90
    if on_globe and cell < DEGREES_CELL_MAX:
        rule = (
            "names no coordinate reference system, and its coordinates could be degrees: they lie "
            f"within {west:.6g} to {east:.6g} and {south:.6g} to {north:.6g}, with cells of "
            f"{cell:.3g}"
        )
        east_size, north_size = degree_at((south + north) / 2)
        remedy = (
            f"state metres_per_degree, on Earth [{east_size:.1f}, {north_size:.1f}], or of "
            "coordinates in metres metres_per_unit: [1, 1]; or add its .prj file"
        )
        raise SceneError(path, rule, remedy)
    return MapFrame(Factors(1.0, 1.0))


def _measured(
    path: Path,
    wkt: str,
    crs: Any,
    bounds: Box,
    stated: tuple[float, float] | None,
    field: str,
) -> MapFrame:
    """MapFrame whose scale is held against that on the ground."""
    unit = "degree" if crs.is_geographic else "unit of its coordinates"
    if stated is None and not crs.is_geographic:
        factor = _linear_unit(crs)[1]
        factors = Factors(factor, factor)
    elif stated is not None:
        factors = Factors(*stated)
    else:
        factors = None
    scales, skew = _scales_on_ground(path, crs, bounds)
    if scales is None:  # a map of a site, of which no place on a planet is known
        assert factors is not None
        return MapFrame(factors, wkt)
    middle = Factors(*scales[len(scales) // 2])
    suggestion = f"{field}: [{middle.east:.6g}, {middle.north:.6g}]"
    if factors is None:
        rule = "is in degrees, which have no fixed size in metres"
        sizes = f"[{middle.east:.1f}, {middle.north:.1f}]"
        remedy = f"state metres_per_degree, here {sizes}, or reproject it with gdalwarp"
        raise SceneError(path, rule, remedy)
    error = _largest_error(factors, scales)
    if skew > SCALE_ERROR:
        rule = f"has axes that are {math.degrees(skew):.3g} deg off a right angle on the ground"
        raise SceneError(path, rule, _reprojected(crs, bounds))
    if error <= SCALE_ERROR:
        return MapFrame(factors, wkt)
    message = (
        f"takes a {unit} for {factors.east:.6g} m eastwards and {factors.north:.6g} m northwards, "
        f"and on the ground it is {middle.east:.6g} m and {middle.north:.6g} m in its middle: "
        f"off by up to {100 * error:.3g} %"
    )
    if stated is None or error > STATED_SCALE_ERROR:
        raise SceneError(path, message, f"state {suggestion}, or {_reprojected(crs, bounds)}")
    return MapFrame(factors, wkt, (f"{path}: {message}; read a smaller window, or reproject it",))


def _largest_error(used: Factors, scales: np.ndarray) -> float:
    return float(np.abs(np.array(used) / scales - 1).max())


def _scales_on_ground(path: Path, crs: Any, bounds: Box) -> tuple[np.ndarray | None, float]:
    """Metres to a unit eastwards and northwards at nine places (9, 2), and the axes' skew [rad].

    None of a map that has no place on a planet.
    """
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    geographic = crs if crs.is_geographic else crs.geodetic_crs
    if geographic is None:
        return None, 0.0
    geodesics = geographic.get_geod()
    west, south, east, north = bounds
    x, y = (
        grid.ravel()
        for grid in np.meshgrid(np.linspace(west, east, 3), np.linspace(south, north, 3))
    )
    if crs.is_geographic:  # none of a geodesic passes a pole
        y = np.clip(y, -89.999, 89.999)
    step = 1e-4 * max(east - west, north - south)
    try:
        to_degrees = Transformer.from_crs(crs, geographic, always_xy=True).transform
        ends = []
        for dx, dy in ((step, 0.0), (0.0, step)):
            start, stop = (to_degrees(x + k * dx / 2, y + k * dy / 2) for k in (-1, 1))
            azimuth, _, length = geodesics.inv(*start, *stop)
            ends.append((np.radians(azimuth), np.asarray(length) / step))
    except ProjError as error:
        rule = f"has coordinates that can not be placed on the ground ({error})"
        raise SceneError(path, rule, "check its coordinate reference system") from None
    scales = np.stack([ends[0][1], ends[1][1]], axis=1)
    if not (np.isfinite(scales).all() and (scales > 0).all()):
        rule = "has coordinates that lie outside its coordinate reference system"
        raise SceneError(path, rule, "check that system, or read a window within it")
    turn = np.abs(np.sin(ends[0][0] - ends[1][0]))
    return scales, float(np.abs(np.arccos(np.clip(turn, 0.0, 1.0))).max())


def _reprojected(crs: Any, bounds: Box) -> str:
    """Remedy for a map whose scale is not that of the ground."""
    from pyproj import Transformer

    geographic = crs if crs.is_geographic else crs.geodetic_crs
    middle = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    longitude, latitude = Transformer.from_crs(crs, geographic, always_xy=True).transform(*middle)
    command = "reproject it with gdalwarp"
    if abs(crs.ellipsoid.semi_major_metre - WGS84_RADIUS) > 1e4:  # of another planet
        place = f"+lon_0={longitude:.4f} +lat_0={latitude:.4f}"
        return (
            f"{command}, e.g. -t_srs '+proj=stere {place} +R={crs.ellipsoid.semi_major_metre:.0f}'"
        )
    if abs(latitude) > UTM_LATITUDE_MAX:
        return (
            f"{command}, e.g. -t_srs '+proj=stere +lon_0={longitude:.4f} +lat_0={latitude:.4f} "
            "+datum=WGS84'"
        )
    zone = min(max(math.floor((longitude + 180) / 6) + 1, 1), 60)
    return f"{command}, e.g. -t_srs EPSG:{326 if latitude >= 0 else 327}{zone:02d}"


# Reference systems


def _crs(wkt: str) -> Any:
    from pyproj import CRS

    return CRS.from_wkt(wkt)


def _crs_of_file(path: Path, wkt: str) -> Any:
    from pyproj.exceptions import CRSError

    try:
        return _crs(wkt)
    except CRSError as error:
        rule = f"has a coordinate reference system that can not be read ({error})"
        raise SceneError(path, rule, "state it anew with gdal_edit -a_srs") from None


def _horizontal(crs: Any) -> Any:
    """Part of a reference system that is a map, without a shift to another datum."""
    while crs.is_bound or crs.is_compound:
        crs = crs.source_crs if crs.is_bound else crs.sub_crs_list[0]
    return crs


def _vertical(crs: Any) -> Any:
    """Part of a reference system that heights refer to: a vertical one, or one of three axes.

    None if there is none.
    """
    while crs.is_bound:
        crs = crs.source_crs
    parts = crs.sub_crs_list if crs.is_compound else [crs]
    for part in parts:
        while part.is_bound:
            part = part.source_crs
        if part.is_vertical or (len(part.axis_info) == 3 and not part.is_geocentric):
            return part
    return None


def _height_axis(crs: Any) -> Any:
    """Axis of the heights of a reference system; None if there is none."""
    vertical = _vertical(crs)
    axes = vertical.axis_info if vertical is not None else []
    return axes[-1] if axes else None


def _height_reference(crs: Any) -> str:
    """Name of the surface that heights of a reference system are above; '' for none."""
    vertical = _vertical(crs)
    if vertical is None:
        return ""
    return str(vertical.name) if vertical.is_vertical else f"ellipsoid {vertical.ellipsoid.name}"


def _same_heights(one: Any, other: Any) -> bool:
    """Return true if heights of two reference systems are above one surface, or one tells none.

    Their units may differ, as all heights are turned into metres.
    """
    first, second = _vertical(one), _vertical(other)
    if first is None or second is None:
        return True
    if first.is_vertical and second.is_vertical:
        return bool(first.datum == second.datum)
    return _height_reference(one) == _height_reference(other)


def _linear_unit(crs: Any) -> tuple[str, float]:
    """Name of the unit of a map's axes, and metres to it; degrees count as metres."""
    axes = crs.axis_info
    if crs.is_geographic or not axes:
        return "metre", 1.0
    return str(axes[0].unit_name), float(axes[0].unit_conversion_factor)


UTM_LATITUDE_MAX = 80.0
"""Latitude up to which zones of UTM are defined on both hemispheres [deg]."""

WGS84_RADIUS, WGS84_FLATTENING = 6_378_137.0, 1 / 298.257223563


def degree_at(
    latitude: float, *, radius: float = WGS84_RADIUS, flattening: float = WGS84_FLATTENING
) -> tuple[float, float]:
    """Metres of a degree of longitude and of latitude at a geodetic latitude [deg].

    Over a grid of h degrees the east-west scale is off by up to ``tan(latitude) h/2`` at its
    edges.
    """
    square = flattening * (2 - flattening)
    phi = math.radians(latitude)
    shrink = 1 - square * math.sin(phi) ** 2
    across = radius / math.sqrt(shrink)
    along = radius * (1 - square) / shrink**1.5
    return math.radians(across * math.cos(phi)), math.radians(along)


def require_one_map(map_frames: Sequence[tuple[str, MapFrame]]) -> None:
    """Refuse rasters, by name, whose coordinates do not belong to one map; SceneError names two."""
    for k, (name, map_frame) in enumerate(map_frames):
        for other_name, other in map_frames[:k]:
            place = f"scene.objects.{name}"
            if not map_frame.same_as(other):
                rule = f"lies on the map '{map_frame.name}', and {other_name} on '{other.name}'"
                raise SceneError(place, rule, "reproject one of them with gdalwarp")
            if not map_frame.same_heights_as(other):
                rule = (
                    f"has heights above '{map_frame.height_reference}', and {other_name} above "
                    f"'{other.height_reference}'"
                )
                remedy = "bring both to one vertical reference system with gdalwarp -t_srs"
                raise SceneError(place, rule, remedy)
            if map_frame.factors != other.factors:
                sizes, other_sizes = tuple(map_frame.factors), tuple(other.factors)
                rule = (
                    f"takes a unit of its map for {sizes} m, and {other_name} for {other_sizes} m"
                )
                raise SceneError(place, rule, "state one size for both")
