"""Map projection of a scene's coordinates, as files of points state it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sweep.scenes.map_frames import metric_projection_of_crs
from sweep.scenes.rasters import open_raster as open_raster
from sweep.scenes.scene_files import require_file


def metric_projection_wkt(path: str | Path, metres_per_unit: Sequence[float] | None = None) -> str:
    """WKT of a raster's map projection if a scene's coordinates are those of the map, else ''.

    A scene is in metres. Coordinates in feet or degrees, or in units of another size that is
    stated, are multiplied by that size and belong to no projection. Heights in feet are turned into
    metres too: then the projection is that of the map alone.
    """
    with open_raster(require_file(path)) as raster:
        crs = raster.crs
        if crs is None or (metres_per_unit is not None and tuple(metres_per_unit) != (1.0, 1.0)):
            return ""
        return metric_projection_of_crs(str(crs.to_wkt()))
