"""The sheet of a point cloud."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Sheet
from mpl_toolkits.mplot3d import proj3d

from sweep.analysis import labels
from sweep.analysis.scenes import colours, marks
from sweep.analysis.scenes.cloud import AXES, Cloud
from sweep.analysis.scenes.quantities import shown
from sweep.analysis.scenes.stage import Stage
from sweep.analysis.scenes.terrain import Ground
from sweep.model.pairing import TRUE

SOLID_WIDEST, SOLID_TALLEST = 7.6, 6.4
"""Sizes of the box as drawn [inches]."""

SOLID_LABELS = (0.55, 0.75, 0.85, 0.1)
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
        scale = min(SOLID_WIDEST / (high[0] - low[0]), SOLID_TALLEST / (high[1] - low[1]))
        self.scale = scale
        self.size = scale * (high[0] - low[0]), scale * (high[1] - low[1])
        left, below, right, above = SOLID_LABELS
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


ALONG = {
    "above": (("x", "y", "z"), 1),
    "side": (("x", "z", "y"), -1),
    "front": (("y", "z", "x"), 1),
}
"""Views along an axis: axes across, up and along the look, and which end of the last is nearest."""

OBLIQUE = -60.0, 28.0
"""Azimuth and elevation of the usual view at an angle [deg]."""

View = str | tuple[float, float]
"""``oblique``, ``above``, ``side`` or ``front``; or azimuth and elevation of the eye [deg]."""


def draw(
    cloud: Cloud,
    *,
    quantity: str,
    surfaces: Sequence[str],
    view: View,
    ground: Ground | None,
    title: str,
    remarks: Sequence[str],
) -> Sheet:
    """A cloud, coloured by a quantity.

    Parameters
    ----------
    cloud
        What to show.
    quantity
        Name of the quantity that colours the points.
    surfaces
        Names of surfaces by number.
    view
        Where from.
    ground
        Map of the scene to draw under the cloud; none where it is not wanted.
    title, remarks
        What stands over the sheet, and what is to be said at its foot.
    """
    true = (cloud.points["flags"] & TRUE) > 0
    values = shown(quantity, cloud.points["colour"])
    scale = colours.chosen(quantity, values, trusted=true, surfaces=surfaces)
    note = labels.joined([*_counted(cloud), *remarks])
    picture: Flat | Solid
    if isinstance(view, str) and view in ALONG:
        picture = Flat(cloud, *ALONG[view], title=title, note=note)
    else:
        angles = OBLIQUE if isinstance(view, str) else view
        picture = Solid(cloud, *angles, title=title, note=note)
    in_legend = picture.ground(ground) if ground is not None else False
    picture.points(scale.of(values), true)
    picture.rest()
    picture.stage.explain(scale, marks.handles(cloud, false=not true.all(), ground=in_legend))
    return picture.stage.sheet


def _counted(cloud: Cloud) -> list[str]:
    """How much there is and how much of it is shown."""
    said = [labels.counted(cloud.total, "point") + _one_in(cloud.every)]
    if cloud.dropouts:
        lost = labels.counted(cloud.total_dropouts, "shot")
        said.append(f"{lost} without a point{_one_in(cloud.every_dropout)}")
    if cloud.outside:
        said.append(f"{labels.counted(cloud.outside, 'false point')} outside of the picture")
    return said


def _one_in(every: int) -> str:
    return f", one in {every} of them shown" if every > 1 else ""
