"""A cloud seen straight along an axis: a map from above, a section from the side."""

from __future__ import annotations

import numpy as np

from sweep.analysis.scenes import marks
from sweep.analysis.scenes.cloud import AXES, Cloud
from sweep.analysis.scenes.stage import Stage
from sweep.analysis.scenes.terrain import Ground

LABELS = 0.75, 0.55
"""Room for ticks and labels at the left and at the foot [inches]."""

WIDEST, TALLEST, LEAST = 7.4, 7.0, 1.5
"""Sizes of the picture [inches]."""


class Flat:
    """A picture along one of the world's axes.

    Parameters
    ----------
    cloud
        What to show.
    along : (across, up, depth) of str
        The world's axes across, up and along the look.
    nearest : int
        1 where the eye is at the upper end of `depth`, -1 at its lower one.
    title, note
        Over the sheet and at its foot.
    """

    def __init__(
        self, cloud: Cloud, along: tuple[str, str, str], nearest: int, *, title: str, note: str
    ) -> None:
        self.cloud, self.along, self.nearest = cloud, along, nearest
        sides = [cloud.box[axis][1] - cloud.box[axis][0] for axis in along[:2]]
        self.scale, self.mark = min(WIDEST / sides[0], TALLEST / sides[1]), marks.LARGEST
        self.size = max(self.scale * sides[0], LEAST), max(self.scale * sides[1], LEAST)
        self.stage = Stage(
            self.size[0] + LABELS[0], self.size[1] + LABELS[1], title=title, note=note
        )
        self.axes = self.stage.axes(*LABELS, *self.size)
        self.axes.set_aspect("equal")
        x, y = along[:2]
        marks.label(self.axes.xaxis, x, cloud.box[x], self.size[0])
        marks.label(self.axes.yaxis, y, cloud.box[y], self.size[1], marks.UP)
        self._hold()

    def _hold(self) -> None:
        """Limits as they are meant to be, whatever is drawn."""
        self.axes.set_xlim(*self.cloud.box[self.along[0]])
        self.axes.set_ylim(*self.cloud.box[self.along[1]])

    def _flat(self, places: np.ndarray) -> np.ndarray:
        """Columns across, up and along the look, of columns x, y, z."""
        return places[[AXES.index(axis) for axis in self.along]]

    def ground(self, ground: Ground) -> bool:
        """Shaded relief with contours from above; the heights that there are from the side."""
        box = self.cloud.box
        part = ground.cropped(box["x"], box["y"], most=480)
        if part is None:
            return False
        if self.along[2] == "z":
            self._relief(part.without_walls())
        else:
            self._profile(part)
        self._hold()
        return self.along[2] != "z"

    def _relief(self, part: Ground) -> None:
        half = (part.x[1] - part.x[0]) / 2, (part.y[1] - part.y[0]) / 2
        extent = (
            part.x[0] - half[0],
            part.x[-1] + half[0],
            part.y[0] - half[1],
            part.y[-1] + half[1],
        )
        self.axes.imshow(
            marks.paper(part), extent=extent, origin="lower", zorder=0, interpolation="bilinear"
        )
        known = part.height[np.isfinite(part.height)]
        if known.size and known.max() > known.min():
            lines = self.axes.contour(
                part.x, part.y, part.height, levels=7, colors="0.42", linewidths=0.5, zorder=1
            )
            self.axes.clabel(lines, fontsize=7, fmt="%g m")

    def _profile(self, part: Ground) -> None:
        across, over = (part.x, 0) if self.along[0] == "x" else (part.y, 1)
        known = np.isfinite(part.height)
        low = np.where(known, part.height, np.inf).min(axis=over)
        high = np.where(known, part.height, -np.inf).max(axis=over)
        self.axes.fill_between(
            across, low, high, where=known.any(axis=over), color=marks.GROUND, linewidth=0, zorder=0
        )

    def points(self, colour: np.ndarray, true: np.ndarray) -> None:
        """Points, the nearest on top; false ones as crosses."""
        across, up, depth = self._flat(np.array([self.cloud.points[axis] for axis in AXES]))
        order = np.argsort(self.nearest * depth, kind="stable")
        size = self.mark = marks.mark_size(self.scale * np.array([across, up]), *self.size)
        real, other = order[true[order]], order[~true[order]]
        self.axes.scatter(across[real], up[real], s=size, c=colour[real], linewidths=0, zorder=3)
        self.axes.scatter(
            across[other], up[other], c=colour[other], zorder=4, **marks.false_marks(size)
        )

    def rest(self) -> None:
        """Dropouts and path."""
        if self.cloud.dropouts:
            across, up, _ = self._flat(marks.within(self.cloud.dropouts, self.cloud.box))
            self.axes.scatter(across, up, zorder=5, **marks.dropout_marks(self.mark))
        if self.cloud.path:
            across, up, _ = self._flat(marks.within(self.cloud.path, self.cloud.box))
            self.axes.plot(across, up, color=marks.PATH, linewidth=1.4, zorder=6)
            self.axes.plot(across[:1], up[:1], "o", color=marks.PATH, markersize=5, zorder=6)
