"""Spectra of one shot of a scene, with what its footprint holds."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure as Sheet

from sweep.analysis import canvas, labels, shot_drawing
from sweep.analysis.scenes.recording import Recording
from sweep.analysis.shot_spectra import Segment, Shot, simulated_shot
from sweep.model import waveform
from sweep.model.eyepoints import Eyepoints, prepare_eyepoints
from sweep.model.geometry.mesh import Surface
from sweep.model.pairing import TRUE

ROOM = 8
"""Bins shown beside the outermost detections, at least."""

REACH = 0.05
"""Distance from the strongest peak up to which detections are in the same view, of the band."""


def several_surfaces(recording: Recording, draw: int = 0) -> int | None:
    """Number of the first shot that tells surfaces apart.

    The first with true points of two surfaces in a draw; where there is none, the first with two
    groups of bins above the threshold; none where there is none of those either.
    """
    fallback = None
    for part in recording.stretches():
        seen = np.where(
            (recording.read("flags", part, draw) & TRUE) > 0,
            recording.read("surface", part, draw).astype(float), np.nan,
        )  # fmt: skip
        low = np.where(np.isnan(seen), np.inf, seen).min(axis=1)
        high = np.where(np.isnan(seen), -np.inf, seen).max(axis=1)
        apart = np.flatnonzero(high > low)
        if apart.size:
            return part.start + int(apart[0])
        if fallback is None:
            groups = np.flatnonzero(recording.read("surfaces_seen", part) >= 2)
            fallback = part.start + int(groups[0]) if groups.size else None
    return fallback


def simulated(
    eyepoints: Eyepoints,
    parameters: Mapping[str, float | int | str],
    surfaces: Sequence[Surface],
    effects: Collection[str],
    *,
    seed: int | None,
) -> Shot:
    """One shot of a scene with some effects, and with noise drawn where there is a seed.

    Raises
    ------
    ValueError
        Where it sees nothing.
    """
    prepared = prepare_eyepoints(eyepoints, parameters, surfaces, effects)
    return simulated_shot(prepared, parameters, seed=seed)


def draw(
    shot: Shot,
    eyepoints: Eyepoints,
    surfaces: Sequence[str],
    *,
    title: str,
    remarks: Sequence[str],
) -> Sheet:
    """The sheet: spectra of the segments, and where the beamlets' lines are.

    Parameters
    ----------
    shot, eyepoints
        The shot, and its geometry.
    surfaces
        Names of surfaces by number.
    title, remarks
        What stands over the sheet and what is to be said at its foot.
    """
    notes = [*remarks, "marks at the foot: where the beamlets' own lines are, by surface"]
    sheet = shot_drawing.draw(
        [shot], title=title, note=labels.joined(notes), near=around_detections
    )
    hit = eyepoints.surface[0] >= 0
    for i, segment in enumerate(shot.segments):
        lines = _lines(shot, segment, eyepoints)[hit] / 1e6
        close = sheet.axes[2 * i + 1]
        marks = [
            close.plot(
                own, np.full(own.size, 0.02), "|", transform=close.get_xaxis_transform(),
                color=canvas.LINES[k % 8], markersize=9, scalex=False, scaley=False,
                label=surfaces[number],
            )[0]
            for k, number in enumerate(np.unique(eyepoints.surface[0, hit]))
            for own in [lines[eyepoints.surface[0, hit] == number]]
        ]  # fmt: skip
        if i == 0:
            close.legend(handles=marks, fontsize=7.5, loc="upper left", framealpha=0.9)
    return sheet


def _lines(shot: Shot, segment: Segment, eyepoints: Eyepoints) -> np.ndarray:
    """Frequency at which each beamlet's line appears in a segment (b,) [Hz], 0 to half the rate."""
    rate = float(shot.prepared.sample_rate[0])
    beat = waveform.beat_frequency(
        segment.sign,
        carrier=np.asarray(segment.carrier),
        chirp_rate=np.asarray(shot.prepared.chirp_rate),
        range=eyepoints.range[0] + eyepoints.offset[0],
        radial_velocity=eyepoints.radial_velocity[0] + eyepoints.velocity_offset[0],
    )
    return np.asarray(np.abs(beat / rate - np.rint(beat / rate)) * rate)


def around_detections(segment: Segment) -> slice:
    """Bins that show all detections near to the strongest peak, and what spreads around it."""
    view = shot_drawing.around_peak(segment.signal)
    peak = int(np.argmax(segment.signal))
    near = [
        group for group in segment.groups if abs(group.peak - peak) <= REACH * segment.signal.size
    ]
    if not near:
        return view
    first, last = min(g.first for g in near), max(g.last for g in near)
    room = max(ROOM, (last - first) // 6)
    return slice(
        max(min(view.start, first - room), 0),
        min(max(view.stop, last + room + 1), segment.signal.size),
    )
