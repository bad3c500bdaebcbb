"""The sheet of a point cloud."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure as Sheet

from sweep.analysis import labels
from sweep.analysis.scenes import colours, marks
from sweep.analysis.scenes.cloud import Cloud
from sweep.analysis.scenes.flat_view import Flat
from sweep.analysis.scenes.quantities import shown
from sweep.analysis.scenes.solid_view import Solid
from sweep.analysis.scenes.terrain import Ground
from sweep.model.pairing import TRUE

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
