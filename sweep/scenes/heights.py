"""Heights of grids: values that stand for none, and heights that can hardly be those of ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sweep.messages import counted
from sweep.scenes.files import SceneError

HEIGHT_MAX = 1e6
"""Largest magnitude of a height [unit of the file]: no ground of a planet lies as far off."""

_CUSTOMARY = (-32768.0, -32767.0, -9999.0, -99999.0, -999.0, 32767.0, 65535.0, 9999.0, 99999.0)
"""Values that files customarily hold where there is no height."""

_CUSTOMARY_GAP = 0.1
"""Gap between such a value and the next height, over the span of all others, that is doubtful."""

_GAP = 1.0
"""The same for any other value that several cells share."""

_SHARED_CELLS = 4
"""Cells that share a value exactly, from which it may stand for a missing height."""

_VALUES_MAX = 3
"""Doubtful values that are looked for, one behind the other."""

_ROWS = 256
"""Rows that are looked at for cliffs at a time."""

CLIFF_SLOPE = 20.0
"""Tangent of the steepest slope between neighbouring cells that is not told."""

CLIFF_HEIGHT = 100.0
"""Least height of such a cliff [m]."""


def without_data(path: Path, values: np.ndarray, no_data: float | None) -> tuple[str, ...]:
    """Set values without data to NaN, in place; return warnings of values that could be such.

    Values that are not finite, or equal to `no_data` in the type of the file, are without data.
    SceneError for heights that no planet has and that nothing declares to be without data.
    """
    missing = ~np.isfinite(values)
    if no_data is not None:
        missing |= values == no_data
        # A value of single precision is written in fewer digits than it has.
        with np.errstate(over="ignore"):
            missing |= values == np.float64(np.float32(no_data))
    values[missing] = np.nan
    far = (values > HEIGHT_MAX) | (values < -HEIGHT_MAX)
    if far.any():
        place = float(values[far][0])
        rule = (
            f"holds the height {place:g} at {counted(int(far.sum()), 'cell')}, "
            f"farther than {HEIGHT_MAX:g}"
        )
        raise SceneError(path, rule, f"if they have no data, state 'no_data: {_shortest(place)}'")
    return tuple(_doubts(path, values))


def _shortest(value: float) -> str:
    """Return a number in the fewest digits that name it, in single precision if it has no more."""
    with np.errstate(over="ignore"):
        single = np.float32(value)
    return str(single) if float(single) == value else repr(value)


def _doubts(path: Path, values: np.ndarray) -> list[str]:
    """Warnings of the extreme values of a grid that several cells share, far from all others."""
    warnings: list[str] = []
    low, high = -np.inf, np.inf
    for _ in range(_VALUES_MAX):
        inside = (values > low) & (values < high)
        if not inside.any():
            break
        least = float(np.min(values, where=inside, initial=np.inf))
        most = float(np.max(values, where=inside, initial=-np.inf))
        if least == most:
            break
        below = float(np.min(values, where=inside & (values > least), initial=np.inf))
        above = float(np.max(values, where=inside & (values < most), initial=-np.inf))
        # Each end is held against the span of everything but itself.
        candidates = (
            (least, below - least, most - below),
            (most, most - above, above - least),
        )
        for value, gap, span in candidates:
            count = int(np.count_nonzero(values == value))
            if value in _CUSTOMARY:
                is_doubtful = gap > _CUSTOMARY_GAP * span
            else:  # of two heights alone neither is more doubtful than the other
                is_doubtful = count >= _SHARED_CELLS and gap > _GAP * span > 0
            if is_doubtful:
                warnings.append(
                    f"{path}: the value {value:g} stands in {counted(count, 'cell')}, "
                    f"{gap:.4g} from the next: if it means that there is no data, "
                    f"state 'no_data: {_shortest(value)}'"
                )
                low, high = (value, high) if value == least else (low, value)
                break
        else:
            break
    return warnings


def cliff_warnings(path: Path, heights: np.ndarray, spacing: tuple[float, float]) -> list[str]:
    """Warning of cliffs between neighbouring cells; none for heights (rows, columns) [m] of ground.

    Missing heights that nothing declares stand as cliffs in a grid, also where they were blended
    with heights as the grid was resampled.
    """
    number, highest, width = 0, 0.0, 0.0
    for begin in range(0, len(heights), _ROWS):
        part = heights[begin : begin + _ROWS + 1]
        for axis, step in ((1, abs(spacing[0])), (0, abs(spacing[1]))):
            rise = np.abs(np.diff(part[:_ROWS] if axis else part, axis=axis))
            steep = rise > max(CLIFF_SLOPE * step, CLIFF_HEIGHT)
            number += int(np.count_nonzero(steep))
            most = float(np.max(rise, where=steep, initial=0.0))
            if most > highest:
                highest, width = most, step
    if not number:
        return []
    return [
        f"{path}: neighbouring cells differ by up to {highest:.4g} m over {width:.3g} m, at "
        f"{counted(number, 'place')}: if the ground has no such cliffs, a value stands for missing "
        "heights there: state it as no_data, or mend the file"
    ]
