"""How kernels are compiled: once, kept on disk, without a count of who uses the arrays.

A kernel that is handed arrays, or slices them, would else count each of them up and down, in every
call: half of the time where there are few lines. So kernels borrow: what called them from
outside compiled code holds on to all arrays meanwhile (:func:`sweep.model.segments.lent`).
"""

from functools import partial

from numba import njit

borrowing = partial(njit, cache=True, error_model="numpy", _nrt=False)
"""For kernels that neither make arrays nor hand any back."""

inlined = partial(borrowing, forceinline=True)
"""For those that one other calls for each segment, and that are handed more than they look at."""

owning = partial(njit, cache=True, error_model="numpy", _nrt=True)
"""For those that do, among kernels that borrow: else they would be compiled as these."""
