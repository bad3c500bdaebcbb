"""Overlap: the echo exists from its delay on and until the chirp ends, within its segment.

A record of L samples begins at the acquisition delay t_0. The laser's chirp, sent from 0 to T,
comes back from tau = 2 R / c on, and beats with the chirp that is being sent until this ends. So
the sample at t holds an echo where

    tau(t) = tau_0 - beta t <= t <= T.

Records end by T, so that what may lack are the first samples, up to all of them: those before
t = tau_0 / (1 + beta). They hold noise alone. The window and its sum, the noise of bins and the
threshold are those of the whole record. Before tau the ground still sends back the segment before
this one. Its beat sweeps through the receiver's band in nanoseconds, and is left out.

The line shape is that of the samples that the echo has, with what the window is there:

    G(y) = sum_{n >= n_0} w_n exp(-2 pi i y n / N),    n_0 = ceil((tau_0 / (1 + beta) - t_0) f_s).

For a cosine sum this is a sum of partial Dirichlet kernels. :mod:`sweep.model.line_shape` has it
for all phase errors. The peak falls by the window's share before n_0: for a rectangular window to
1 - n_0 / L of its amplitude. The line grows wider, and its sidelobes fall as 1/y, as the echo
begins with a step. [T] takes chirps to be far longer than delays, where records that begin at 0 are
whole (``overlap: off``).

One n_0 serves all lines of a footprint's segment: that of the beam's axis. A beamlet that is d
farther away has 2 d f_s / c samples fewer. It serves all looks of a shot as well, that of the
middle one, between which the range changes. This is left out, and :func:`left` bounds it. It counts
in what a point's effects leave out (``effects_error``). Places between bins are corrected for n_0
(:func:`sweep.model.interpolation.late_echo`).

Size: c is the largest bin's magnitude over that of all lines on a bin, and b the share of sum |w|
in the samples that lack. No bin changes by more than b, and so the largest by b / c of itself at
most. The planner takes sidelobes of leakage and images to be those of the window, and those of a
rectangular one times the step at n_0. If no sample has an echo nothing is detected, while a bin
without signal crosses as noise does: there the effect is always kept.

Checks: :mod:`sweep.model.truth` gates each sample of each beamlet by its own delay.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from sweep.model import waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Scene, Size
from sweep.model.effects.phase_errors import missed
from sweep.model.effects.points import Points, largest_about
from sweep.model.preparation import Shots

_IMAGE = 0.9
"""Smallest fraction of a line's amplitude that a distant image leaves."""


def size(points: Points) -> Size | None:
    """Upper bound on the output change if missing samples are ignored; None if none are missing."""
    late = points.missing
    if late is None:
        return None
    besides = missed(points.smear, points.window) if points.smears else 0.0
    least = points.powers[0] / np.where(points.near_image, 2.0, 1.01) / (1 + points.smear.reach)
    c = _IMAGE * np.sqrt(least) - besides
    magnitude = np.where(late.lost > 0, np.where(c > 0, late.lost / c, np.inf), 0.0)
    each, gone = left(points), late.all.any(axis=0).astype(float)
    remain: dict[str, Any] = {"left": each, "left_of_all": each * points.footprint.gain}
    if not points.may_add:
        lone = points.lobe.near(points.offset) - late.lost  # powers: each line by its own share
        own = np.where(lone > 0, np.minimum(each / np.maximum(lone, 1e-300), 1.0), 1.0)
        remain["left"] = np.where(each > 0, own, 0.0)
        return Size(magnitude=magnitude, chance=gone, **remain)
    alone = np.where(points.may_cancel, 0.0, magnitude)
    whole = np.where(points.may_cancel, 2 * late.lost / points.lobe.worst, points.image)
    added = np.where(late.lost > 0, whole, 0.0)
    return Size(magnitude=alone, added=added, chance=gone, **remain)


def left(points: Points) -> np.ndarray:
    """Bound the error of one first sample, the axis's at the middle look, for all beamlets.

    Relative to the magnitude that all lines make on a bin, by segment.
    """
    late = points.missing
    assert late is not None
    ranges = points.footprint.ranges
    off = np.minimum(np.abs(ranges.mean) + ranges.rms, ranges.extreme)
    looks = points.sample_rate * 2 / SPEED_OF_LIGHT * np.abs(points.approach) * points.late
    farthest = points.sample_rate * points.delay * np.minimum(ranges.extreme, 1e3) + looks
    number = points.sample_rate * points.delay * np.minimum(off, 1e3) + looks
    # Numbers of samples are whole: those of two delays differ by up to one more.
    whole = np.where(farthest > 0, number + 1, 0.0)
    # Of none of the samples, and of all, the same lack at delays that are close.
    middle = points.sample_rate * (points.delay - points.start)
    begins = (middle + farthest > -1) & (middle - farthest < points.window.length + 1)
    # The few samples change all bins alike, and the image at negative frequency does so as well.
    each = 2 * largest_about(points.window, late.first, farthest + 1) * whole
    each = np.minimum(each, 1.0)
    return np.asarray(np.where(begins, each, 0.0))


def act(shots: Shots, scene: Scene) -> Shots:
    """Set ``first_sample``: the number of record samples before the echo, by segment."""
    first = np.zeros((len(shots.waveform), shots.size), np.int64)
    for s in np.flatnonzero(shots.segments):
        segment = shots.waveform[s]
        first[s] = waveform.samples_before_echo(
            delay=2 / SPEED_OF_LIGHT * (shots.range - segment.nearer), beta=segment.beta,
            start=shots.acquisition_delay, sample_rate=shots.sample_rate,
            length=shots.window.length,
        )  # fmt: skip
    return replace(shots, first_sample=first) if first.any() else shots


OVERLAP = Effect(
    name="overlap",
    about="echoes that arrive after the record has begun",
    stage="record",
    size=size,
    act=act,
)
