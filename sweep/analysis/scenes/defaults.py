"""Figures of a scene's study that asks for none."""

from __future__ import annotations

import xarray as xr

from sweep.spec.scene_figures import CloudFigure, NavigationFigure, SceneFigure

COLOURS = ("range", "radial_velocity")


def default_figures(tree: xr.DataTree) -> list[SceneFigure]:
    """Each scanner's cloud by range, with the flight path, and by velocity; navigation."""
    scanners = [str(name) for name in tree.attrs["scanners"]]
    figures: list[SceneFigure] = [
        CloudFigure(kind="cloud", scanner=scanner, colour=colour, path=colour == "range")
        for scanner in scanners
        for colour in COLOURS
    ]
    if any("velocity_status" in tree[scanner] for scanner in scanners):
        figures += [
            NavigationFigure(kind="navigation", quantity=quantity)
            for quantity in ("velocity", "altitude")
        ]
    return figures
