"""Where two studies differ: the distribution of differences, against what is known of both."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from sweep.analysis import canvas, labels
from sweep.model.outputs import PROMISED

LEAST = 1e-16
"""Differences below it stand at the left edge."""


def save(found: Mapping[str, xr.Dataset], path: Path) -> Path:
    """For each probability of detection, the share of points that differ by more than some amount.

    Parameters
    ----------
    found
        As :func:`.comparison_table.compared` gives it: each scanner has a colour.
    path
        Where to; its suffix names the format.
    """
    parts = list(found.values())
    names = [n for n in PROMISED if any(n in part and part[n].notnull().any() for part in parts)]
    thing = "shot" if any("shot" in part.dims for part in parts) else "point"
    with canvas.style():
        if not names:
            return canvas.save(canvas.empty("Nothing that both stores have is computed yet"), path)
        sheet, axes = canvas.panels(9.0, 6.2, 2, 2, sharex=True, sharey=True)
        for panel, name in zip(axes, PROMISED, strict=True):
            panel.set_visible(name in names)
            for i, (scanner, part) in enumerate(found.items()):
                if name in names:
                    _curves(panel, part, name, scanner, canvas.LINES[i % len(canvas.LINES)])
        for panel in axes[2:]:
            panel.set_xlabel("difference of pd, either way")
        for panel in axes[::2]:
            panel.set_ylabel(f"share of {thing}s beyond (%)")
        axes[PROMISED.index(names[0])].legend(frameon=False, fontsize=8)
        canvas.title(sheet, f"{parts[0].attrs['other']}\nless {parts[0].attrs['ours']}")
        number = sum(int(part[names[0]].notnull().sum()) for part in parts)
        canvas.caption(sheet, labels.joined([f"{number:,} {thing}s that both studies have"]))
        return canvas.save(sheet, path)


def _curves(axes: Axes, found: xr.Dataset, name: str, scanner: str, colour: str) -> None:
    """Shares of points beyond each difference that is, and beyond each that is allowed."""
    known = np.isfinite(found[name].values)
    if not known.any():
        return
    for values, text, dash in (
        (np.abs(found[name].values), "found", "-"),
        (found[f"{name}_allowed"].values, "allowed", "--"),
    ):
        ordered = np.sort(np.maximum(np.broadcast_to(values, known.shape)[known], LEAST))
        share = 100 * (1 - np.arange(ordered.size + 1) / ordered.size)
        axes.step(
            [LEAST, *ordered, 1.0], [*share, 0.0], where="post", color=colour,
            linestyle=dash, linewidth=1.4, label=f"{scanner} {text}".strip(),
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_xlim(LEAST, 1.0)
    axes.set_ylim(-3, 103)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_title(name, size=10, loc="left")
