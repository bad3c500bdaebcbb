"""Checks of grids of heights: values that stand for missing heights, and implausible cliffs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sweep.messages import counted
from sweep.scenes.scene_files import SceneError

HEIGHT_MAX = 1e6
"""Largest magnitude of a plausible height [unit of the file]."""

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
"""Values that files customarily use for missing heights."""

_CUSTOMARY_VALUE_GAP_MIN = 0.1
"""Smallest suspicious gap between a customary value and the next height, relative to the span of
all other heights."""

_SHARED_VALUE_GAP_MIN = 1.0
"""Smallest suspicious gap for any other value that several cells share, relative to the same
span."""

_SHARED_CELLS_MIN = 4
"""Smallest number of cells with exactly equal extreme values that is suspicious."""

_DOUBTFUL_VALUES_MAX = 3
"""Maximum number of suspicious values that are searched for, from the extremes inwards."""

_ROWS_PER_STRIP = 256
"""Number of rows that are examined for cliffs at a time."""

CLIFF_SLOPE_MIN = 20.0
"""Slope between neighbouring cells, as a tangent, above which a cliff is reported."""

CLIFF_HEIGHT_MIN = 100.0
"""Height difference above which a cliff is reported [m]."""


def mask_missing_heights(path: Path, values: np.ndarray, no_data: float | None) -> tuple[str, ...]:
    """Set missing heights to NaN in place, and return warnings about values that may be missing.

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
        If a height exceeds `HEIGHT_MAX` and is not declared as missing.
    """
    is_missing = ~np.isfinite(values)
    if no_data is not None:
        is_missing |= values == no_data
        # A single-precision value written in decimals differs from its double-precision value.
        with np.errstate(over="ignore"):
            is_missing |= values == np.float64(np.float32(no_data))
    values[is_missing] = np.nan
    is_too_far = (values > HEIGHT_MAX) | (values < -HEIGHT_MAX)
    if is_too_far.any():
        wrong_height = float(values[is_too_far][0])
        problem = (
            f"holds the height {wrong_height:g} at {counted(int(is_too_far.sum()), 'cell')}, "
            f"farther than {HEIGHT_MAX:g}"
        )
        raise SceneError(
            path, problem, f"if they have no data, state 'no_data: {_shortest_text(wrong_height)}'"
        )
    return tuple(_no_data_warnings(path, values))


def _shortest_text(value: float) -> str:
    """Return the shortest decimal text of a number; single precision is used if it is exact."""
    with np.errstate(over="ignore"):
        single_precision = np.float32(value)
    return str(single_precision) if float(single_precision) == value else repr(value)


def _no_data_warnings(path: Path, values: np.ndarray) -> list[str]:
    """Return warnings about extreme values that are far from all others and may be missing."""
    warnings: list[str] = []
    low, high = -np.inf, np.inf
    for _ in range(_DOUBTFUL_VALUES_MAX):
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
                is_doubtful = gap > _CUSTOMARY_VALUE_GAP_MIN * span
            else:  # with only two distinct heights neither is more suspicious
                is_doubtful = count >= _SHARED_CELLS_MIN and gap > _SHARED_VALUE_GAP_MIN * span > 0
            if is_doubtful:
                warnings.append(
                    f"{path}: the value {value:g} stands in {counted(count, 'cell')}, "
                    f"{gap:.4g} from the next: if it means that there is no data, "
                    f"state 'no_data: {_shortest_text(value)}'"
                )
                low, high = (value, high) if value == lowest else (low, value)
                break
        else:
            break
    return warnings


def cliff_warnings(path: Path, heights: np.ndarray, spacing: tuple[float, float]) -> list[str]:
    """Return a warning if neighbouring cells differ by an implausible height, else nothing.

    Missing heights that are not declared appear as cliffs in a grid, even if they were blended with
    heights by resampling.

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
    for first_row in range(0, len(heights), _ROWS_PER_STRIP):
        strip = heights[first_row : first_row + _ROWS_PER_STRIP + 1]
        for axis, step in ((1, abs(spacing[0])), (0, abs(spacing[1]))):
            rise = np.abs(np.diff(strip[:_ROWS_PER_STRIP] if axis else strip, axis=axis))
            is_cliff = rise > max(CLIFF_SLOPE_MIN * step, CLIFF_HEIGHT_MIN)
            n_cliffs += int(np.count_nonzero(is_cliff))
            strip_largest_rise = float(np.max(rise, where=is_cliff, initial=0.0))
            if strip_largest_rise > largest_rise:
                largest_rise, step_at_largest = strip_largest_rise, step
    if not n_cliffs:
        return []
    return [
        f"{path}: neighbouring cells differ by up to {largest_rise:.4g} m over "
        f"{step_at_largest:.3g} m, at {counted(n_cliffs, 'place')}: "
        "if the ground has no such cliffs, a value stands for missing heights there: "
        "state it as no_data, or mend the file"
    ]
