"""Sheets of point clouds, at an angle or along one of the world's axes, and of scatters."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, ClassVar, Literal

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d import proj3d

from sweep.analysis import canvas, labels
from sweep.analysis.scenes import colours
from sweep.analysis.scenes.colours import Stage
from sweep.analysis.scenes.recording import (
    AXES,
    CATEGORIES,
    SIGNED,
    WIDE,
    Cloud,
    Table,
    Thinned,
    label,
    shown,
    within,
)
from sweep.model.pairing import TRUE
from sweep.storage.opening import MAP

SUN_AZIMUTH, SUN_ELEVATION = 315.0, 40.0
"""Direction of the light that shades the ground [deg], from north by east; and its height."""

STEEPEST = 1.5
"""Slope above which ground is left open: at the edges of crowns and walls, which hide points."""


@dataclass(frozen=True)
class Ground:
    """Heights of the ground (rows, columns) on an even grid; nan where there is none.

    World coordinates x (columns,) and y (rows,) rise; all in metres.
    """

    x: np.ndarray
    y: np.ndarray
    height: np.ndarray

    @classmethod
    def of(cls, tree: xr.DataTree) -> Ground | None:
        """Return the map of a store, or None if it has none, or nothing is on it."""
        if MAP not in tree.children:
            return None
        x, y, height = (np.asarray(tree[MAP][name].values) for name in ("x", "y", "height"))
        return cls(x, y, height) if np.isfinite(height).any() else None

    def cropped(
        self, x: tuple[float, float], y: tuple[float, float], most: int = 120
    ) -> Ground | None:
        """Return the ground within limits, interpolated; None where these miss the map."""
        cuts = [
            (max(float(own[0]), low), min(float(own[-1]), high))
            for own, (low, high) in ((self.x, x), (self.y, y))
        ]
        if any(high <= low for low, high in cuts):
            return None
        step = max(high - low for low, high in cuts) / (most - 1)
        across, up = (np.linspace(low, high, max(2, round((high - low) / step) + 1))
                      for low, high in cuts)  # fmt: skip
        height = xr.DataArray(self.height, [("y", self.y), ("x", self.x)]).interp(x=across, y=up)
        return Ground(across, up, height.values)

    def without_walls(self) -> Ground:
        """Return the ground without what is too steep to be drawn as a surface."""
        steep = np.hypot(*np.gradient(self.height, self.y, self.x)) > STEEPEST
        return Ground(self.x, self.y, np.where(steep, np.nan, self.height))

    def shade(self) -> np.ndarray:
        """Brightness of the ground under a low sun, 0..1; slopes are stretched to stand out."""
        down, across = np.gradient(self.height, self.y, self.x)
        slope = np.hypot(down, across)
        known = slope[np.isfinite(slope)]
        typical = float(np.percentile(known, 80)) if known.size else 0.0
        stretch = 0.6 / typical if typical > 0 else 1.0
        azimuth, elevation = np.radians(90.0 - SUN_AZIMUTH), np.radians(SUN_ELEVATION)
        towards = np.cos(elevation) * (np.cos(azimuth) * across + np.sin(azimuth) * down) * stretch
        lit = (np.sin(elevation) - towards) / np.sqrt(1 + (stretch * slope) ** 2)
        return np.clip(np.where(np.isfinite(lit), lit, 1.0), 0.0, 1.0)


DROPOUT, PATH, GROUND = "#C1121F", "#1A1A1A", "0.86"

SOLID_WIDEST, SOLID_TALLEST = 7.6, 6.4
"""Sizes of the box as drawn [inches]."""

SOLID_LABELS = (0.55, 0.75, 0.85, 0.1)
"""Room for ticks and labels to its left, below, to its right and above [inches]."""

_UNIT = 10.0


class Solid:
    """A picture at an angle: azimuth of the eye from x towards y, elevation above it [deg]."""

    marks: ClassVar[dict[str, Any]] = {"depthshade": False}

    def __init__(
        self, cloud: Cloud, azimuth: float, elevation: float, *, title: str, note: str
    ) -> None:
        self.cloud = cloud
        self.order = np.arange(cloud.true.size)
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
        shares = self._shares()
        for name, share in zip(AXES, shares, strict=True):
            drawn = 0.62 * scale * share
            axis = getattr(self.axes, f"{name}axis")
            apart = colours.UP if name == "z" else colours.ACROSS
            colours.lengths(axis, name, cloud.box[name], drawn, apart)
            axis.labelpad = 2 if drawn < 0.8 else 9 + 4 * (name == "z")
            axis.set_tick_params(pad=2 + 4 * (name == "z") * share)

    def _shares(self) -> np.ndarray:
        """Sides of the box in its longest."""
        sides = np.array([self.cloud.box[axis][1] - self.cloud.box[axis][0] for axis in AXES])
        return sides / sides.max()

    def _dress(self, axes: Any, azimuth: float, elevation: float) -> None:
        """Projection, limits, walls and grid."""
        axes.patch.set_visible(False)
        axes.set_proj_type("ortho")
        axes.view_init(elev=elevation, azim=azimuth)
        axes.set_box_aspect(self._shares())
        for name in AXES:
            getattr(axes, f"set_{name}lim")(*self.cloud.box[name])
            axis = getattr(axes, f"{name}axis")
            axis.pane.set_facecolor("white")
            axis.pane.set_edgecolor("0.8")

    def _outline(self, azimuth: float, elevation: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower left and upper right corner of the box, in shares of the library's square."""
        trial = Stage(_UNIT, _UNIT, title="", note="")
        axes = trial.axes(0, 0, _UNIT, _UNIT, projection="3d")
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

    def columns(self, places: np.ndarray) -> Sequence[np.ndarray]:
        """World positions (3, n) as the axes take them."""
        return list(places)

    def on_paper(self, places: np.ndarray) -> np.ndarray:
        """World positions (3, n) on the picture (2, n) [inches]."""
        return self.scale * self._projected(self.axes, places)

    def ground(self, ground: Ground) -> bool:
        """Shaded relief, cut at the box and open at walls."""
        part = ground.cropped(self.cloud.box["x"], self.cloud.box["y"])
        if part is None:
            return False
        low, high = self.cloud.box["z"]
        part = part.without_walls()
        kept = (part.height >= low) & (part.height <= high)
        x, y = np.meshgrid(part.x, part.y)
        self.axes.plot_surface(
            x, y, np.where(kept, part.height, np.nan), facecolors=_paper(part), rcount=200,
            ccount=200, shade=False, linewidth=0, antialiased=False, zorder=1,
        )  # fmt: skip
        return False


LABELS = 0.8, 0.55
"""Room for ticks and labels at the left and at the foot [inches]."""

WIDEST, TALLEST, LEAST = 7.4, 7.0, 1.5
"""Sizes of the picture [inches]."""


class Flat:
    """A picture along one of the world's axes: those across, up and along the look.

    `nearest` is 1 where the eye is at the upper end of the last, -1 at its lower one.
    """

    marks: ClassVar[dict[str, Any]] = {}

    def __init__(
        self, cloud: Cloud, along: tuple[str, str, str], nearest: int, *, title: str, note: str
    ) -> None:
        self.cloud, self.along = cloud, along
        self.order = np.argsort(nearest * cloud.points[along[2]], kind="stable")
        sides = [cloud.box[axis][1] - cloud.box[axis][0] for axis in along[:2]]
        self.scale = min(WIDEST / sides[0], TALLEST / sides[1])
        self.size = max(self.scale * sides[0], LEAST), max(self.scale * sides[1], LEAST)
        self.stage = Stage(
            self.size[0] + LABELS[0], self.size[1] + LABELS[1], title=title, note=note
        )
        self.axes = self.stage.axes(*LABELS, *self.size)
        self.axes.set_aspect("equal")
        x, y = along[:2]
        colours.lengths(self.axes.xaxis, x, cloud.box[x], self.size[0])
        colours.lengths(self.axes.yaxis, y, cloud.box[y], self.size[1], colours.UP)
        self._hold()

    def _hold(self) -> None:
        """Limits as they are meant to be, whatever is drawn."""
        self.axes.set(xlim=self.cloud.box[self.along[0]], ylim=self.cloud.box[self.along[1]])

    def columns(self, places: np.ndarray) -> Sequence[np.ndarray]:
        """World positions (3, n) as the axes take them."""
        return [places[AXES.index(axis)] for axis in self.along[:2]]

    def on_paper(self, places: np.ndarray) -> np.ndarray:
        """World positions (3, n) on the picture (2, n) [inches]."""
        return self.scale * np.array(self.columns(places))

    def ground(self, ground: Ground) -> bool:
        """Shaded relief with contours from above; the heights that there are from the side."""
        part = ground.cropped(self.cloud.box["x"], self.cloud.box["y"], most=480)
        if part is None:
            return False
        if self.along[2] == "z":
            self._relief(part.without_walls())
        else:
            self._profile(part)
        self._hold()
        return self.along[2] != "z"

    def _relief(self, part: Ground) -> None:
        x, y = ((own[1] - own[0]) / 2 for own in (part.x, part.y))
        extent = (part.x[0] - x, part.x[-1] + x, part.y[0] - y, part.y[-1] + y)
        self.axes.imshow(
            _paper(part), extent=extent, origin="lower", zorder=0, interpolation="bilinear"
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
            across, low, high, where=known.any(axis=over), color=GROUND, linewidth=0, zorder=0
        )


def _draw(picture: Flat | Solid, colour: np.ndarray) -> None:
    """Points, false ones as crosses; dropouts and path."""
    axes: Any = picture.axes
    cloud, columns = picture.cloud, picture.columns
    places = np.array([cloud.points[axis] for axis in AXES])
    size = colours.mark_size(picture.on_paper(places), *picture.size)
    is_true = cloud.true[picture.order]
    true, false = picture.order[is_true], picture.order[~is_true]
    axes.scatter(
        *columns(places[:, true]), s=size, c=colour[true], linewidths=0, zorder=3, **picture.marks
    )
    if false.size:
        axes.scatter(
            *columns(places[:, false]), c=colour[false], zorder=4, **picture.marks,
            **colours.false_marks(size),
        )  # fmt: skip
    if cloud.dropouts:
        axes.scatter(
            *columns(_within(cloud, cloud.dropouts)), s=max(1.6 * size, 10.0), facecolors="none",
            edgecolors=DROPOUT, linewidths=0.8, zorder=5, **picture.marks,
        )  # fmt: skip
    if cloud.path:
        track = columns(_within(cloud, cloud.path))
        axes.plot(*track, color=PATH, linewidth=1.5, zorder=6)
        axes.plot(*(own[:1] for own in track), "o", color=PATH, markersize=5, zorder=6)


def _within(cloud: Cloud, table: Table) -> np.ndarray:
    """Places (3, n), nan outside of the box."""
    columns = np.array([table[axis] for axis in AXES])
    return np.where(within(table, cloud.box), columns, np.nan)


def _paper(ground: Ground) -> np.ndarray:
    """Pale shades of the ground, (rows, columns, 4); see-through where there is none."""
    shade = np.array(colormaps["gray"](0.62 + 0.36 * ground.shade()))
    shade[~np.isfinite(ground.height)] = 0.0
    return shade


ALONG = {
    "above": (("x", "y", "z"), 1),
    "side": (("x", "z", "y"), -1),
    "front": (("y", "z", "x"), 1),
}
"""Views along an axis: axes across, up and along the look, and which end of the last is nearest."""

OBLIQUE = -60.0, 28.0
"""Azimuth and elevation of the usual view at an angle [deg]."""


def cloud_sheet(
    cloud: Cloud,
    *,
    quantity: str,
    surfaces: Sequence[str],
    view: str | tuple[float, float],
    ground: Ground | None,
    title: str,
    remarks: Sequence[str],
) -> Sheet:
    """Draw a cloud, coloured by a quantity."""
    values = shown(quantity, cloud.points[quantity])
    scale = colours.chosen(quantity, values, trusted=cloud.true, surfaces=surfaces)
    note = labels.joined([*cloud.remarks, *remarks])
    picture: Flat | Solid
    if isinstance(view, str) and view in ALONG:
        picture = Flat(cloud, *ALONG[view], title=title, note=note)
    else:
        angles = OBLIQUE if isinstance(view, str) else view
        picture = Solid(cloud, *angles, title=title, note=note)
    in_legend = ground is not None and picture.ground(ground)
    _draw(picture, scale.of(values))
    picture.stage.explain(scale, _handles(cloud, ground=in_legend))
    return picture.stage.sheet


def _handles(cloud: Cloud, *, ground: bool) -> list[Any]:
    """Return a legend's entries for the marks of a picture."""
    found: list[Any] = []
    if not cloud.true.all():
        found.append(colours.false_point())
    if cloud.dropouts and cloud.dropouts["x"].size:
        look = {"markerfacecolor": "none", "markeredgecolor": DROPOUT, "markersize": 5}
        found.append(colours.mark("o", "shot without\na point", **look))
    if cloud.path:
        found.append(Line2D([], [], color=PATH, linewidth=1.6, label="flight path,\ndot: start"))
    if ground:
        found.append(Patch(color=GROUND, label="heights of\nthe scene"))
    return found


SIZE = 7.6, 4.6
"""Size of a scatter [inches]."""


def scatter_sheet(
    found: Thinned,
    *,
    x: str,
    y: str,
    colour: str,
    surfaces: Sequence[str],
    title: str,
    remarks: Sequence[str],
) -> Sheet:
    """Draw one quantity over another."""
    table = found.rows()
    true = (table["flags"] & TRUE) > 0 if "flags" in table else np.ones(len(table[x]), bool)
    values = shown(colour, table[colour])
    scale = colours.chosen(colour, values, trusted=true, surfaces=surfaces)
    columns = {name: shown(name, table[name]) for name in (x, y)}
    limits = {name: _limits(name, columns[name], true) for name in (x, y)}
    inside = within(columns, limits)
    said = [found.counted("point" if "flags" in table else "shot")]
    if outside := int((~inside & ~true).sum()) * found.every:
        said.append(f"{labels.counted(outside, 'false point')} outside of the picture")
    stage = Stage(
        SIZE[0] + LABELS[0], SIZE[1] + LABELS[1], title=title, note=labels.joined([*said, *remarks])
    )
    axes = stage.axes(*LABELS, *SIZE)
    _dress(axes, limits, (x, y))
    paint = scale.of(values)
    places = np.array([columns[x], columns[y]])
    size = colours.mark_size(axes.transData.transform(places[:, inside].T).T / canvas.DPI, *SIZE)
    real, other = inside & true, inside & ~true
    across, up = places
    axes.scatter(across[real], up[real], s=size, c=paint[real], linewidths=0, zorder=3)
    false = colours.false_marks(size)
    axes.scatter(across[other], up[other], c=paint[other], zorder=2, **false)
    stage.explain(scale, [colours.false_point()] if other.any() else [])
    return stage.sheet


def _limits(name: str, values: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Return ends of an axis: those of true points, with a margin; infinite where that must be."""
    known = values[true & np.isfinite(values)]
    known = known if known.size else values[np.isfinite(values)]
    known = known[known > 0] if name in WIDE else known
    if not known.size:
        return 0.0, 1.0
    low, high = float(known.min()), float(known.max())
    if name in WIDE:
        return low / 1.3, high * 1.3
    room = 0.04 * (high - low) or 0.05 * abs(high) or 0.5
    return low - room, high + room


def _dress(axes: Axes, limits: dict[str, tuple[float, float]], names: tuple[str, str]) -> None:
    """Limits, scales, labels and grid."""
    sides: tuple[Literal["x", "y"], ...] = ("x", "y")
    for side, name in zip(sides, names, strict=True):
        axes.set(**{f"{side}scale": "log" if name in WIDE else "linear"})
        axes.set(**{f"{side}label": textwrap.fill(label(name), 52), f"{side}lim": limits[name]})
        if name in CATEGORIES:
            axes.locator_params(axis=side, integer=True)
    axes.grid(True)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8)
    if names[1] in SIGNED and limits[names[1]][0] < 0 < limits[names[1]][1]:
        axes.axhline(0.0, color="0.6", linewidth=0.8, zorder=1)
