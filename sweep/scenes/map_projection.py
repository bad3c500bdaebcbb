"""Map projection of a scene's coordinates, as files of points state it."""

from __future__ import annotations

from pathlib import Path

from sweep.scenes.files import existing
from sweep.scenes.rasters import _opened as opened_raster

_WEB_MERCATOR = 3857
"""EPSG code of a projection whose metres are none but at the equator."""


def projection_in_metres(path: str | Path) -> str:
    """WKT of a raster's map projection if its coordinates are metres on the ground, else ''.

    A scene is in metres: of a raster in feet or degrees its coordinates are those of no projection.
    """
    with opened_raster(existing(path)) as data:
        crs = data.crs
        if crs is None or not crs.is_projected or crs.to_epsg() == _WEB_MERCATOR:
            return ""
        return str(crs.to_wkt()) if float(crs.linear_units_factor[1]) == 1.0 else ""
