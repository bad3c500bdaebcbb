"""The table of sidelobes against the transform itself."""

import numpy as np
import pytest

from sweep.model.effects.sidelobes import CELLS, LEVELS, sidelobes
from sweep.model.window import transform, window

WINDOWS = ("hamming", "hann", "rectangular", "blackman", "flattop", "kaiser(8.6)", "tukey(0.4)")


@pytest.mark.parametrize("name", WINDOWS)
@pytest.mark.parametrize("length", [37, 1000])
def test_the_table_holds_the_transform_at_any_distance(name, length):
    table, shape, rng = sidelobes(name, length), window(name, length), np.random.default_rng(5)
    y = rng.uniform(0, table.lowest.size / CELLS, 1000)
    cell = (CELLS * y).astype(int)
    value = abs(transform(shape, y)) / shape.sum
    for level in range(LEVELS):
        before = np.maximum(cell - rng.integers(0, 2 ** (level + 1), y.size), 0)
        assert (value <= table.highest[level, before]).all()
    for before in (cell, cell // 2, 0):
        assert (value <= table.highest[LEVELS, before]).all()
    assert (value >= table.lowest[cell]).all()
    assert np.median(table.highest[0, cell] / value) < 1.2
    assert 0.97 < table.lowest[0] <= 1 and (np.diff(table.lowest) <= 0).all()
