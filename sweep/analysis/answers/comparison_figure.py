"""Where two studies differ: the distribution of differences, against what is known of both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from sweep.analysis import canvas, labels
from sweep.model.outputs import PROMISED

LEAST = 1e-16
"""Differences below it stand at the left edge."""


def save(found: xr.Dataset, path: Path) -> Path:
    """For each probability of detection, the share of points that differ by more than some amount.

    Parameters
    ----------
    found
        As :func:`.comparison_table.compared` gives it.
    path
        Where to; its suffix names the format.
    """
    names = [name for name in PROMISED if name in found and found[name].notnull().any()]
    with canvas.style():
        if not names:
            return canvas.save(canvas.empty("Nothing that both stores have is computed yet"), path)
        sheet, axes = canvas.panels(9.0, 6.2, 2, 2, sharex=True, sharey=True)
        for panel, name in zip(axes, PROMISED, strict=True):
            panel.set_visible(name in names)
            if name in names:
                _curves(panel, found, name)
        for panel in axes[2:]:
            panel.set_xlabel("difference of pd, either way")
        for panel in axes[::2]:
            panel.set_ylabel("share of points beyond (%)")
        axes[PROMISED.index(names[0])].legend(frameon=False, fontsize=8)
        canvas.title(sheet, f"{found.attrs['other']}\nless {found.attrs['ours']}")
        number = int(found[names[0]].notnull().sum())
        canvas.caption(sheet, labels.joined([f"{number:,} points that both studies have"]))
        return canvas.save(sheet, path)


def _curves(axes: Axes, found: xr.Dataset, name: str) -> None:
    """Shares of points beyond each difference that is, and beyond each that is allowed."""
    known = np.isfinite(found[name].values)
    for i, (values, text) in enumerate(
        ((np.abs(found[name].values), "found"), (found[f"{name}_allowed"].values, "allowed"))
    ):
        ordered = np.sort(np.maximum(np.broadcast_to(values, known.shape)[known], LEAST))
        share = 100 * (1 - np.arange(1, ordered.size + 1) / ordered.size)
        axes.step(
            np.append(ordered, 1.0), np.append(share, 0.0), where="post", color=canvas.LINES[i],
            linestyle=canvas.DASHES[i], linewidth=1.4, label=text,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_xlim(LEAST, 1.0)
    axes.set_ylim(-3, 103)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_title(name, size=10, loc="left")
