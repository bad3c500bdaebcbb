"""The sheet of one shot or several: spectra of their segments, whole and around the peak."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet

from sweep.analysis import canvas, labels
from sweep.analysis.shot_spectra import Segment, Shot, quantity_at

SPECTRUM, THRESHOLD, NOISE, DETECTION = canvas.LINES[0], canvas.LINES[2], canvas.LINES[1], "black"
MARGIN_BELOW, MARGIN_ABOVE = 25.0, 12.0
"""Decibels shown below the noise level, and above the strongest bin."""

NARROWEST = 12
"""Least half-width of the view around the peak, in bins."""


def draw(
    shots: Sequence[Shot],
    *,
    title: str,
    note: str,
    near: Callable[[Segment], slice] | None = None,
) -> Sheet:
    """Spectra of shots side by side: a row a segment, the whole band and around the peak.

    Parameters
    ----------
    shots
        What to draw.
    title, note
        What stands over the sheet and at its foot.
    near
        Bins that the view around the peak shows; those around the strongest peak by default.
    """
    near = near or (lambda segment: around_peak(segment.signal))
    rows, columns = len(shots[0].segments), 2 * len(shots)
    width = 5.4 if len(shots) == 1 else 4.2
    sheet, axes = canvas.panels(width * columns, 3.1 * rows + 1.2, rows, columns)
    limits = _limits(shots)
    for j, shot in enumerate(shots):
        for i, segment in enumerate(shot.segments):
            whole, close = axes[i * columns + 2 * j], axes[i * columns + 2 * j + 1]
            _whole(whole, shot, segment)
            _around_peak(close, shot, segment, near(segment))
            for panel in (whole, close):
                panel.set_ylim(*limits)
                panel.grid(True, color="0.92", linewidth=0.6)
            whole.set_title(", ".join(filter(None, [segment.name, shot.label])), size=10)
            if j == 0:
                whole.set_ylabel("amplitude (dB re 1 V)")
    axes[0].legend(fontsize=7.5, loc="upper right", framealpha=0.9, ncols=3)
    for panel in axes[(rows - 1) * columns :]:
        panel.set_xlabel("frequency (MHz)")
    canvas.title(sheet, title)
    canvas.caption(sheet, note)
    return sheet


def _limits(shots: Sequence[Shot]) -> tuple[float, float]:
    """Decibels that show all of the noise and of the peaks."""
    low = min(float(shot.dbv(shot.noise_level)) for shot in shots) - MARGIN_BELOW
    high = max(
        float(shot.dbv(max(segment.magnitude.max(), shot.threshold)))
        for shot in shots
        for segment in shot.segments
    )
    return low, high + MARGIN_ABOVE


def _lines(axes: Axes, shot: Shot, segment: Segment, chosen: slice, width: float) -> None:
    """Spectrum, threshold, noise level and detections."""
    mhz = segment.frequency[chosen] / 1e6
    level = np.maximum(shot.dbv(segment.magnitude[chosen]), -500.0)
    dense = mhz.size <= 200
    axes.plot(
        mhz, level, color=SPECTRUM, linewidth=width, marker="." if dense else "", markersize=4
    )
    axes.axhline(
        float(shot.dbv(shot.threshold)), color=THRESHOLD, linestyle="--", linewidth=1.2,
        label="threshold",
    )  # fmt: skip
    axes.axhline(
        float(shot.dbv(shot.noise_level)), color=NOISE, linestyle="-.", linewidth=1.2,
        label="noise (rms)",
    )  # fmt: skip
    peaks = np.array([group.peak for group in segment.groups], dtype=int)
    axes.plot(
        segment.frequency[peaks] / 1e6, shot.dbv(segment.magnitude[peaks]), linestyle="",
        marker="v", markersize=7, color=DETECTION, markeredgecolor="white", label="detection",
    )  # fmt: skip
    axes.set_xlim(float(mhz[0]), float(mhz[-1]))


def _whole(axes: Axes, shot: Shot, segment: Segment) -> None:
    """The whole band, with where the peak is."""
    _lines(axes, shot, segment, slice(None), 0.5)
    if not segment.groups:
        axes.text(
            0.02, 0.95, "no detection", transform=axes.transAxes, color=DETECTION, va="top", size=9
        )


def _around_peak(axes: Axes, shot: Shot, segment: Segment, bins: slice) -> None:
    """Bins around the peak, with what their frequency means on top."""
    _lines(axes, shot, segment, bins, 1.0)
    told = [f"signal-to-noise {10 * np.log10(segment.snr):.1f} dB"] if segment.snr > 0 else []
    axes.text(
        0.98, 0.95, "\n".join([*told, f"pd {segment.pd:.4g}"]), transform=axes.transAxes,
        size=8, color=DETECTION, ha="right", va="top",
    )  # fmt: skip
    first, second = (float(q) for q in quantity_at(shot, segment, np.array([0.0, 1e6])))
    velocity = segment.sign == 0

    def meaning(mhz: np.ndarray) -> np.ndarray:
        return first + (second - first) * mhz

    def frequency(value: np.ndarray) -> np.ndarray:
        return (value - first) / (second - first)

    top = axes.secondary_xaxis("top", functions=(meaning, frequency))  # type: ignore[arg-type]
    units = "m/s" if velocity else "m"
    top.set_xlabel(
        labels.with_units("radial velocity" if velocity else "range", units), size=8, labelpad=4
    )
    top.tick_params(labelsize=8)
    top.ticklabel_format(axis="x", useOffset=False)
    axes.ticklabel_format(axis="x", useOffset=False)


def around_peak(magnitude: np.ndarray) -> slice:
    """Bins that show the peak and what spreads around it, down to a tenth of its height."""
    peak = int(np.argmax(magnitude))
    strong = np.flatnonzero(magnitude >= 0.1 * magnitude[peak])
    near = strong[np.abs(strong - peak) < magnitude.size // 8]
    half = max(NARROWEST, int(1.5 * max(peak - near[0], near[-1] - peak)))
    return slice(max(peak - half, 0), min(peak + half + 1, magnitude.size))
