"""The ground under a point cloud, from the map in a scene's store."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.ndimage import map_coordinates

SUN_AZIMUTH, SUN_ELEVATION = 315.0, 40.0
"""Where the light comes from that shades the ground [deg], from north by east; and its height."""


STEEPEST = 1.5
"""Slope above which ground is left open: at the edges of crowns and walls, which hide points."""


@dataclass(frozen=True)
class Ground:
    """Heights of the ground on an even grid.

    Attributes
    ----------
    x, y : (columns,), (rows,) ndarray
        World coordinates [m], rising.
    height : (rows, columns) ndarray
        [m]; nan where there is none.
    """

    x: np.ndarray
    y: np.ndarray
    height: np.ndarray

    @classmethod
    def of(cls, tree: xr.DataTree) -> Ground | None:
        """The map of a store; none where it has none, or nothing is on it."""
        if "map_height" not in tree.ds:
            return None
        x, y, height = (np.asarray(tree.ds[f"map_{name}"].values) for name in ("x", "y", "height"))
        ground = cls(x, y, height)
        return ground if np.isfinite(ground.height).any() else None

    def cropped(
        self, x: tuple[float, float], y: tuple[float, float], most: int = 120
    ) -> Ground | None:
        """The ground within limits, on a grid of as many nodes at the most along each side.

        Heights between the map's nodes are interpolated; none is left where limits miss the map.
        """
        cut_x, cut_y = (self._shared(own, asked) for own, asked in ((self.x, x), (self.y, y)))
        if cut_x is None or cut_y is None:
            return None
        step = max(cut_x[1] - cut_x[0], cut_y[1] - cut_y[0]) / (most - 1)
        nodes = [
            np.linspace(*cut, max(2, round((cut[1] - cut[0]) / step) + 1)) for cut in (cut_x, cut_y)
        ]
        places = [
            np.interp(node, own, np.arange(own.size))
            for node, own in zip(nodes, (self.x, self.y), strict=True)
        ]
        rows, columns = np.meshgrid(places[1], places[0], indexing="ij")
        height = map_coordinates(self.height, [rows, columns], order=1, mode="nearest")
        return Ground(nodes[0], nodes[1], height)

    @staticmethod
    def _shared(own: np.ndarray, asked: tuple[float, float]) -> tuple[float, float] | None:
        """Part of a coordinate within limits; none where they miss it."""
        low, high = max(float(own[0]), asked[0]), min(float(own[-1]), asked[1])
        return (low, high) if high > low else None

    def at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Heights at places [m]; nan beside the map."""
        places = [
            np.interp(value, own, np.arange(own.size), left=np.nan, right=np.nan)
            for value, own in ((y, self.y), (x, self.x))
        ]
        known = np.isfinite(places[0]) & np.isfinite(places[1])
        inside = [np.where(known, place, 0.0) for place in places]
        return np.where(known, map_coordinates(self.height, inside, order=1), np.nan)

    def without_walls(self) -> Ground:
        """The ground without what is too steep to be drawn as a surface."""
        steep = np.hypot(*np.gradient(self.height, self.y, self.x)) > STEEPEST
        return Ground(self.x, self.y, np.where(steep, np.nan, self.height))

    def shade(self) -> np.ndarray:
        """Brightness of the ground under a low sun, 0..1, (rows, columns).

        Slopes are stretched until half of them stand out, so that gentle ground shows as well.
        """
        down, across = np.gradient(self.height, self.y, self.x)
        slope = np.hypot(down, across)
        known = slope[np.isfinite(slope)]
        typical = float(np.percentile(known, 80)) if known.size else 0.0
        stretch = 0.6 / typical if typical > 0 else 1.0
        azimuth, elevation = np.radians(90.0 - SUN_AZIMUTH), np.radians(SUN_ELEVATION)
        towards = np.cos(elevation) * (np.cos(azimuth) * across + np.sin(azimuth) * down) * stretch
        lit = (np.sin(elevation) - towards) / np.sqrt(1 + (stretch * slope) ** 2)
        return np.clip(np.where(np.isfinite(lit), lit, 1.0), 0.0, 1.0)
