"""Checks of grids of heights: values that stand for missing heights, and implausible cliffs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sweep.messages import number_with_noun
from sweep.scenes.scene_files import SceneError

PLAUSIBLE_HEIGHT_MAX = 1e6
"""Largest magnitude that a height in a file may have [unit of the file].

A larger value must be declared as one that marks missing heights.
"""

_CUSTOMARY_NO_DATA_VALUES = (
    -32768.0,
    -32767.0,
    -9999.0,
    -99999.0,
    -999.0,
    32767.0,
    65535.0,
    9999.0,
    99999.0,
)
"""Values with which files customarily mark missing heights."""

_CUSTOMARY_NO_DATA_RELATIVE_GAP_MIN = 0.1
"""Smallest gap between a customary no-data value and the nearest height that causes a warning.

The gap is relative to the difference between the largest and the smallest of all other heights.
"""

_REPEATED_EXTREME_RELATIVE_GAP_MIN = 1.0
"""Smallest gap between a repeated extreme height and the nearest height that causes a warning.

A repeated extreme is the smallest or largest height of a file, if several cells have it. The gap is
relative to the difference between the largest and the smallest of all other heights.
"""

_REPEATED_EXTREME_CELLS_MIN = 4
"""Smallest number of cells with the same extreme height that causes a warning."""

_NO_DATA_WARNINGS_PER_FILE_MAX = 3
"""Largest number of warnings about suspicious heights of one file."""

_CLIFF_SEARCH_STRIP_ROWS = 256
"""Number of grid rows that the search for cliffs examines at a time."""

CLIFF_SLOPE_MIN = 20.0
"""Slope (height difference over distance) of neighbouring cells above which a step is a cliff.

The height difference must exceed `CLIFF_HEIGHT_MIN` as well.
"""

CLIFF_HEIGHT_MIN = 100.0
"""Height difference of neighbouring cells above which a step is a cliff [m].

The slope must exceed `CLIFF_SLOPE_MIN` as well.
"""


def set_missing_heights_to_nan(
    path: Path, values: np.ndarray, no_data: float | None
) -> tuple[str, ...]:
    """Set missing heights to NaN in place, and return warnings about suspicious heights.

    Parameters
    ----------
    path : Path
        File of the heights, for messages.
    values : ndarray, shape (rows, columns)
        Heights [unit of the file]; changed in place. Values that are not finite are missing.
    no_data : float or None
        Value that stands for a missing height, compared in double and in single precision.

    Returns
    -------
    tuple of str
        Warnings.

    Raises
    ------
    SceneError
        If a height exceeds `PLAUSIBLE_HEIGHT_MAX` and is not declared as missing.
    """
    is_missing = ~np.isfinite(values)
    if no_data is not None:
        is_missing |= values == no_data
        # A single-precision value written in decimals differs from its double-precision value.
        with np.errstate(over="ignore"):
            is_missing |= values == np.float64(np.float32(no_data))
    values[is_missing] = np.nan
    is_too_far = (values > PLAUSIBLE_HEIGHT_MAX) | (values < -PLAUSIBLE_HEIGHT_MAX)
    if is_too_far.any():
        wrong_height = float(values[is_too_far][0])
        problem = (
            f"holds the height {wrong_height:g} at "
            f"{number_with_noun(int(is_too_far.sum()), 'cell')}, "
            f"farther than {PLAUSIBLE_HEIGHT_MAX:g}"
        )
        raise SceneError(
            path,
            problem,
            f"if they have no data, state 'no_data: {_shortest_decimal_text(wrong_height)}'",
        )
    return tuple(_undeclared_no_data_warnings(path, values))


def _shortest_decimal_text(value: float) -> str:
    """Return the shortest decimal text that reads back as the number.

    A number that is exact in single precision gets the shorter text of the single-precision number.
    """
    with np.errstate(over="ignore"):
        single_precision = np.float32(value)
    return str(single_precision) if float(single_precision) == value else repr(value)


def _undeclared_no_data_warnings(path: Path, values: np.ndarray) -> list[str]:
    """Return warnings about the smallest or largest heights of a file that may mark missing data.

    The relative gap of a height is its distance to the nearest other height, over the span of all
    other heights. A height is suspicious in two cases: it is a customary no-data value with a
    relative gap above `_CUSTOMARY_NO_DATA_RELATIVE_GAP_MIN`, or several cells have it, with a
    relative gap above `_REPEATED_EXTREME_RELATIVE_GAP_MIN`.
    """
    warnings: list[str] = []
    low, high = -np.inf, np.inf
    for _ in range(_NO_DATA_WARNINGS_PER_FILE_MAX):
        is_inside = (values > low) & (values < high)
        if not is_inside.any():
            break
        lowest = float(np.min(values, where=is_inside, initial=np.inf))
        highest = float(np.max(values, where=is_inside, initial=-np.inf))
        if lowest == highest:
            break
        second_lowest = float(np.min(values, where=is_inside & (values > lowest), initial=np.inf))
        second_highest = float(
            np.max(values, where=is_inside & (values < highest), initial=-np.inf)
        )
        # Compare the gap at each end with the span of all values except that end.
        candidates = (
            (lowest, second_lowest - lowest, highest - second_lowest),
            (highest, highest - second_highest, second_highest - lowest),
        )
        for value, gap, span in candidates:
            count = int(np.count_nonzero(values == value))
            if value in _CUSTOMARY_NO_DATA_VALUES:
                is_doubtful = gap > _CUSTOMARY_NO_DATA_RELATIVE_GAP_MIN * span
            else:  # with only two distinct heights neither is more suspicious
                is_doubtful = (
                    count >= _REPEATED_EXTREME_CELLS_MIN
                    and gap > _REPEATED_EXTREME_RELATIVE_GAP_MIN * span > 0
                )
            if is_doubtful:
                warnings.append(
                    f"{path}: the value {value:g} stands in {number_with_noun(count, 'cell')}, "
                    f"{gap:.4g} from the next: if it means that there is no data, "
                    f"state 'no_data: {_shortest_decimal_text(value)}'"
                )
                low, high = (value, high) if value == lowest else (low, value)
                break
        else:
            break
    return warnings


def cliff_warnings(path: Path, heights: np.ndarray, spacing: tuple[float, float]) -> list[str]:
    """Return a list with one warning if heights have implausible cliffs, or an empty list.

    A no-data value that is not declared makes cliffs in the grid, even after resampling has blended
    it with heights.

    Parameters
    ----------
    path : Path
        File of the heights, for the message.
    heights : ndarray, shape (rows, columns)
        Heights [m]; NaN for missing heights.
    spacing : (float, float)
        Grid steps along x and y [m].
    """
    n_cliffs, largest_rise, step_at_largest = 0, 0.0, 0.0
    for first_row in range(0, len(heights), _CLIFF_SEARCH_STRIP_ROWS):
        strip = heights[first_row : first_row + _CLIFF_SEARCH_STRIP_ROWS + 1]
        for axis, step in ((1, abs(spacing[0])), (0, abs(spacing[1]))):
            rise = np.abs(np.diff(strip[:_CLIFF_SEARCH_STRIP_ROWS] if axis else strip, axis=axis))
            is_cliff = rise > max(CLIFF_SLOPE_MIN * step, CLIFF_HEIGHT_MIN)
            n_cliffs += int(np.count_nonzero(is_cliff))
            strip_largest_rise = float(np.max(rise, where=is_cliff, initial=0.0))
            if strip_largest_rise > largest_rise:
                largest_rise, step_at_largest = strip_largest_rise, step
    if not n_cliffs:
        return []
    return [
        f"{path}: neighbouring cells differ by up to {largest_rise:.4g} m over "
        f"{step_at_largest:.3g} m, at {number_with_noun(n_cliffs, 'place')}: "
        "if the ground has no such cliffs, a value stands for missing heights there: "
        "state it as no_data, or mend the file"
    ]
