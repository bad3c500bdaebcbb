"""Heights of grids: values that stand for none, and heights that can hardly be those of ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sweep.messages import counted
from sweep.scenes.scene_files import SceneError

HEIGHT_MAX = 1e6
"""Largest magnitude of a height [unit of the file]: no ground of a planet lies as far off."""

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
"""Values that files customarily hold where there is no height."""

_CUSTOMARY_VALUE_GAP_MIN = 0.1
"""Gap between such a value and the next height, over the span of all others, that is doubtful."""

_SHARED_VALUE_GAP_MIN = 1.0
"""The same for any other value that several cells share."""

_SHARED_CELLS_MIN = 4
"""Cells that share a value exactly, from which it may stand for a missing height."""

_DOUBTFUL_VALUES_MAX = 3
"""Doubtful values that are looked for, one behind the other."""

_ROWS_PER_STRIP = 256
"""Rows that are looked at for cliffs at a time."""

CLIFF_SLOPE_MIN = 20.0
"""Tangent of the steepest slope between neighbouring cells that is not told."""

CLIFF_HEIGHT_MIN = 100.0
"""Least height of such a cliff [m]."""


def mask_missing_heights(path: Path, values: np.ndarray, no_data: float | None) -> tuple[str, ...]:
    """Set values without data to NaN, in place; return warnings of values that could be such.

    Values that are not finite, or equal to `no_data` in the type of the file, are without data.
    SceneError for heights that no planet has and that nothing declares to be without data.
    """
    is_missing = ~np.isfinite(values)
    if no_data is not None:
        is_missing |= values == no_data
        # A value of single precision is written in fewer digits than it has.
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
    """Return a number in the fewest digits that name it, in single precision if it has no more."""
    with np.errstate(over="ignore"):
        single_precision = np.float32(value)
    return str(single_precision) if float(single_precision) == value else repr(value)


def _no_data_warnings(path: Path, values: np.ndarray) -> list[str]:
    """Warnings of the extreme values of a grid that several cells share, far from all others."""
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
        # Each end is held against the span of everything but itself.
        candidates = (
            (lowest, second_lowest - lowest, highest - second_lowest),
            (highest, highest - second_highest, second_highest - lowest),
        )
        for value, gap, span in candidates:
            count = int(np.count_nonzero(values == value))
            if value in _CUSTOMARY_NO_DATA_VALUES:
                is_doubtful = gap > _CUSTOMARY_VALUE_GAP_MIN * span
            else:  # of two heights alone neither is more doubtful than the other
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
    """Warning of cliffs between neighbouring cells; none for heights (rows, columns) [m] of ground.

    Missing heights that nothing declares stand as cliffs in a grid, also where they were blended
    with heights as the grid was resampled.
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
