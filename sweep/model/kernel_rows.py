"""Rows of scratch in which kernels of bundles are kept: what is where, and for whom.

Filled by :mod:`sweep.model.known_kernels` and :mod:`sweep.model.known_sources`.
"""

import math
import mmap
import threading
from collections import OrderedDict
from collections.abc import Hashable

import numpy as np

from sweep.model.compiling import borrowing, owning
from sweep.model.lanes import COLUMNS, LANES

HALVES = tuple(0.6 * 1.35**level for level in range(10))
"""Half widths h of bundles [bins]."""

MOST_MOMENTS = 64

MOST_PARTS = 64

REACHES = 32, 512
"""Bins on either side of the middle in which kernels are kept: of one bundle, of several."""

MOST_SOURCES = COLUMNS

FORM_WIDTH = -(-(MOST_SOURCES * (MOST_SOURCES + 3) // 2 + 1) // COLUMNS) * COLUMNS + LANES
"""Numbers of a form, at the most: whole vectors.

And one more, as in rows of kernels: rows as long as a power of two would share few places of the
processor's cache.
"""

KEY, HALF, SIZE, NUMBER, ASIDE, SEEN, PLACES, REACH = range(8)  # of the row's numbers
NODES = 16
BOUND = NODES + MOST_MOMENTS
SUM_RE = BOUND + MOST_MOMENTS
SUM_IM = SUM_RE + MOST_MOMENTS
KNOWN = SUM_IM + MOST_MOMENTS
TILE = KNOWN + 2 * REACHES[1] // LANES + COLUMNS
COEFFICIENTS = TILE + 3 * COLUMNS
TO_NODES = COEFFICIENTS + FORM_WIDTH
PARTS = TO_NODES + MOST_MOMENTS**2
AT_NODES = PARTS + 3 * MOST_PARTS * MOST_MOMENTS
SOURCES = AT_NODES + 2 * MOST_MOMENTS * MOST_SOURCES
FAR = SOURCES + MOST_SOURCES
TABLE = FAR + MOST_MOMENTS * FORM_WIDTH

WIDTH = TABLE + 2 * MOST_MOMENTS * (2 * REACHES[1] + 2 * COLUMNS + LANES)
"""Numbers that a row of scratch must hold."""

MOST_KEPT = 4
"""Kinds of kernels that a thread keeps; pages that nothing is known on take no memory."""

_SCRATCH = threading.local()

LADDER = len(HALVES) + 1

WAYS = 8
"""Kinds of parts of a segment's lines whose kernels are kept beside each other: more than there
are tolerances to which lines are split, as points of each take turns."""

ROWS = (1 + 3 * WAYS) * LADDER
"""Rows of scratch, for each width and for bundles side by side: of whole lines, and of lines in
parts for each segment and way."""


def kernels_of(*key: Hashable, further: int = 0) -> np.ndarray:
    """Scratch of this thread for what has been worked out of kernels, (ROWS + further, WIDTH).

    Parameters
    ----------
    *key
        All that kernels of whole lines depend on. Those of lines in parts are known by the parts'
        digest.
    further : int
        Rows besides; those of a key are always as many. All are zero at first.
    """
    kept = _SCRATCH.__dict__.setdefault("kept", OrderedDict())
    if key not in kept:
        while len(kept) >= MOST_KEPT:  # before there is one more: each is a GiB of addresses
            kept.popitem(last=False)
        try:
            kept[key] = _untouched((ROWS + further, WIDTH))
        except OSError:  # a limit on addresses: what is kept only saves time
            kept.clear()
            kept[key] = _untouched((ROWS + further, WIDTH))
    kept.move_to_end(key)
    return kept[key]


def _untouched(shape: tuple[int, ...]) -> np.ndarray:
    """Zeros that take no memory until they are touched, page by page and not by huge ones."""
    memory = mmap.mmap(-1, 8 * math.prod(shape))
    if hasattr(mmap, "MADV_NOHUGEPAGE"):
        memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory, float).reshape(shape)


def digests(*values: np.ndarray) -> np.ndarray:
    """Digests (...) of arrays (..., k), each as a whole number of 52 bits, 2 or more."""
    total = np.zeros(values[0].shape[:-1], np.uint64)
    for n, value in enumerate(values):
        bits = np.ascontiguousarray(value, float).view(np.uint64)
        factors = np.random.default_rng(n).integers(1 << 63, size=bits.shape[-1], dtype=np.uint64)
        mixed = (bits ^ (bits >> np.uint64(29))) * (2 * factors + np.uint64(1))
        total += (mixed ^ (mixed >> np.uint64(32))).sum(axis=-1, dtype=np.uint64)
    return (total >> np.uint64(12)).astype(float) + 2.0


@owning()
def to_nodes_of(slot):
    """Of moments of 1, (moments, nodes); 0 where there are no more."""
    return slot[TO_NODES:PARTS].reshape((MOST_MOMENTS, MOST_MOMENTS))


@borrowing()
def parts_of(slot):
    """Places, real and imaginary strengths, (parts, nodes) each."""
    of_all = slot[PARTS:AT_NODES].reshape((3, MOST_PARTS, MOST_MOMENTS))
    return of_all[0], of_all[1], of_all[2]
