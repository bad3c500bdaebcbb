"""Memory that a point of a study takes, known before any array is made."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sweep.spec.rules import Mistake, SpecError

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec

FFT_SIZE = "instrument.processing.fft_size"

BYTES_PER_BIN = 250
BYTES_PER_DRAWN_BIN = 300
"""Memory of a point at its peak over the points of its FFT, measured at 2^20 and 2^22: of the
closed form, and of spectra that are drawn whole."""


def largest_fft(spec: Spec | SceneSpec) -> int:
    """Return the largest number of points of the FFT in a study."""
    sizes = [m.values for axis in spec.axes for m in axis.members if m.path == FFT_SIZE]
    return int(np.max(sizes[0])) if sizes else int(spec.parameters()[FFT_SIZE])


def point_bytes(spec: Spec | SceneSpec) -> int:
    """Return the bytes that a point or a shot takes at its peak."""
    drawn = getattr(spec.draws, "whole_spectra", False)
    return largest_fft(spec) * (BYTES_PER_DRAWN_BIN if drawn else BYTES_PER_BIN)


def refuse_too_large(spec: Spec | SceneSpec) -> None:
    """Refuse a study of which one point takes more memory than this machine has."""
    # Here, as a spec with mistakes is told without the second that this import takes.
    from distributed.system import MEMORY_LIMIT

    needed = point_bytes(spec)
    if needed > MEMORY_LIMIT:
        rule = (
            f"makes a point take about {needed / 1e9:,.1f} GB of memory, and this machine has "
            f"{MEMORY_LIMIT / 1e9:,.1f} GB"
        )
        size = f"{largest_fft(spec):,} points"
        raise SpecError([Mistake(FFT_SIZE, rule, size, "take fewer points of the FFT")])
