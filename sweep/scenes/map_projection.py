"""Map projection of a scene's coordinates, for export to files of points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sweep.scenes.map_frames import metric_projection_wkt_of_crs
from sweep.scenes.rasters import open_raster as open_raster
from sweep.scenes.scene_files import require_file


def metric_projection_wkt(path: str | Path, metres_per_unit: Sequence[float] | None = None) -> str:
    """Return the map projection of a raster as WKT if scene coordinates belong to it, else ''.

    Coordinates of a scene are in metres. Map coordinates in feet, degrees or units of a stated size
    are converted to metres, after which they belong to no map projection. If only the heights are
    in feet, the result is the map projection without its vertical part.

    Parameters
    ----------
    path : str or Path
        File of the raster.
    metres_per_unit : sequence of float, optional
        Metres on the ground per unit of the raster's coordinates, east and north, if the user
        states them.

    Returns
    -------
    str
        WKT; empty if the coordinates belong to no projection.
    """
    with open_raster(require_file(path)) as raster:
        crs = raster.crs
        if crs is None or (metres_per_unit is not None and tuple(metres_per_unit) != (1.0, 1.0)):
            return ""
        return metric_projection_wkt_of_crs(str(crs.to_wkt()))
