"""A cloud seen at an angle, in parallel projection, its axes to one scale."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from mpl_toolkits.mplot3d import proj3d

from sweep.analysis.scenes import marks
from sweep.analysis.scenes.cloud import AXES, Cloud
from sweep.analysis.scenes.stage import Stage
from sweep.analysis.scenes.terrain import Ground

WIDEST, TALLEST = 7.6, 6.4
"""Sizes of the box as drawn [inches]."""

LABELS = (0.55, 0.75, 0.85, 0.1)
"""Room for ticks and labels to its left, below, to its right and above [inches]."""

_UNIT = 10.0


class Solid:
    """A picture at an angle.

    Parameters
    ----------
    cloud
        What to show.
    azimuth, elevation : float
        Of the eye, from x towards y and above the horizon [deg].
    title, note
        Over the sheet and at its foot.
    """

    def __init__(
        self, cloud: Cloud, azimuth: float, elevation: float, *, title: str, note: str
    ) -> None:
        self.cloud, self.mark = cloud, marks.LARGEST
        low, high = self._outline(azimuth, elevation)
        scale = min(WIDEST / (high[0] - low[0]), TALLEST / (high[1] - low[1]))
        self.scale = scale
        self.size = scale * (high[0] - low[0]), scale * (high[1] - low[1])
        left, below, right, above = LABELS
        self.stage = Stage(
            self.size[0] + left + right, self.size[1] + below + above, title=title, note=note
        )
        # The square that the library draws in may reach beyond the sheet: the box within does not.
        self.axes: Any = self.stage.axes(
            left - scale * low[0], below - scale * low[1], scale, scale, projection="3d",
            computed_zorder=False,
        )  # fmt: skip
        self._dress(self.axes, azimuth, elevation)
        for axis, side in zip(AXES, self._sides(), strict=True):
            drawn = 0.62 * scale * side / self._sides().max()
            own = getattr(self.axes, f"{axis}axis")
            apart = marks.UP if axis == "z" else marks.ACROSS
            marks.label(own, axis, cloud.box[axis], drawn, apart)
            own.labelpad = 2 if drawn < 0.8 else 9 + 4 * (axis == "z")
            own.set_tick_params(pad=2 + 4 * (axis == "z") * side / self._sides().max())

    def _sides(self) -> np.ndarray:
        return np.array([self.cloud.box[axis][1] - self.cloud.box[axis][0] for axis in AXES])

    def _dress(self, axes: Any, azimuth: float, elevation: float) -> None:
        """Projection, limits, walls and grid."""
        axes.patch.set_visible(False)
        axes.set_proj_type("ortho")
        axes.view_init(elev=elevation, azim=azimuth)
        axes.set_box_aspect(self._sides() / self._sides().max())
        for name in AXES:
            getattr(axes, f"set_{name}lim")(*self.cloud.box[name])
            axis = getattr(axes, f"{name}axis")
            axis.pane.set_facecolor("white")
            axis.pane.set_edgecolor("0.8")
            axis._axinfo["grid"].update(color="0.9", linewidth=0.6)

    def _outline(self, azimuth: float, elevation: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower left and upper right corner of the box, in shares of the library's square."""
        trial = Stage(_UNIT, _UNIT, title="", note="")
        axes: Any = trial.axes(0, 0, _UNIT, _UNIT, projection="3d")
        self._dress(axes, azimuth, elevation)
        corners = np.array(list(product(*(self.cloud.box[axis] for axis in AXES)))).T
        places = self._projected(axes, corners)
        return places.min(axis=1), places.max(axis=1)

    @staticmethod
    def _projected(axes: Any, places: np.ndarray) -> np.ndarray:
        """World positions (3, n) as they appear, in shares of the library's square (2, n)."""
        x, y, _ = proj3d.proj_transform(*places, axes.get_proj())
        seen = axes.viewLim
        return np.array([(x - seen.x0) / seen.width, (y - seen.y0) / seen.height])

    def ground(self, ground: Ground) -> bool:
        """Shaded relief, cut at the box and open at walls."""
        box = self.cloud.box
        part = ground.cropped(box["x"], box["y"])
        if part is None:
            return False
        low, high = box["z"]
        part = part.without_walls()
        kept = (part.height >= low) & (part.height <= high)
        x, y = np.meshgrid(part.x, part.y)
        self.axes.plot_surface(
            x, y, np.where(kept, part.height, np.nan), facecolors=marks.paper(part), rcount=200,
            ccount=200, shade=False, linewidth=0, antialiased=False, zorder=1,
        )  # fmt: skip
        return False

    def points(self, colour: np.ndarray, true: np.ndarray) -> None:
        """Points; false ones as crosses."""
        places = np.array([self.cloud.points[axis] for axis in AXES])
        drawn = self.scale * self._projected(self.axes, places)
        size = self.mark = marks.mark_size(drawn, *self.size)
        self.axes.scatter(
            *places[:, true], s=size, c=colour[true], linewidths=0, depthshade=False, zorder=3
        )
        if not true.all():
            self.axes.scatter(
                *places[:, ~true], c=colour[~true], depthshade=False, zorder=4,
                **marks.false_marks(size),
            )  # fmt: skip

    def rest(self) -> None:
        """Dropouts and path."""
        if self.cloud.dropouts:
            places = marks.within(self.cloud.dropouts, self.cloud.box)
            look = marks.dropout_marks(self.mark)
            self.axes.scatter(*places, depthshade=False, zorder=5, **look)
        if self.cloud.path:
            track = marks.within(self.cloud.path, self.cloud.box)
            self.axes.plot(*track, color=marks.PATH, linewidth=1.6, zorder=6)
            self.axes.plot(*track[:, :1], "o", color=marks.PATH, markersize=5, zorder=6)
