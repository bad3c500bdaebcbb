"""Integers as arguments of compiled functions.

Numba compiles a function anew for each literal integer among its arguments, and for a variable that
begins as a literal. A constant from here, or a variable that begins as one, has the type of all
other integers.

>>> STEP_UP + STEP_DOWN == INTEGER_ZERO
np.True_
"""

import numpy as np

INTEGER_ZERO, INTEGER_ONE = np.int64(0), np.int64(1)
"""The integers 0 and 1."""
NO_INDEX = np.int64(-1)
"""Value of an index that means: there is none."""
THREE_BINS = np.int64(3)
"""Number of bins of a peak and its two neighbours, 3."""
STEP_UP, STEP_DOWN = np.int64(1), np.int64(-1)
"""Steps from a bin to the next one above and below."""
