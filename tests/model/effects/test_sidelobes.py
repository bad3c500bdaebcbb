"""The table of sidelobes against the transform itself."""

import numpy as np
import pytest

from sweep.model.effects.lobes import lobe
from sweep.model.effects.sidelobes import CELLS, LEVELS, STEEPEST, sidelobes
from sweep.model.window import samples, transform, window

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


def slope_of(shape, y):
    """|dW/dy| / sum, seen from the record's middle: the transform of the samples' moments."""
    w, n = samples(shape.name, shape.length), np.arange(shape.length)
    place = n / shape.length - 0.5
    turns = np.outer(y, place)
    return 2 * np.pi * abs((np.exp(-2j * np.pi * turns) * place * w).sum(axis=-1)) / shape.sum


@pytest.mark.parametrize("name", (*WINDOWS, "nuttall", "chebwin(80)", "bartlett", "cosine"))
@pytest.mark.parametrize("length", [37, 1000])
def test_sidelobes_are_no_steeper_than_the_table_and_the_envelope_say(name, length):
    table, shape, rng = sidelobes(name, length), window(name, length), np.random.default_rng(6)
    y = rng.uniform(0, table.lowest.size / CELLS, 600)
    cell = (CELLS * y).astype(int)
    value = slope_of(shape, y)
    for level in range(LEVELS + 1):
        assert (value <= table.steepest[level, cell]).all()
    assert np.median(table.steepest[0, cell] / value) < 1.2
    far = rng.uniform(1, length / 2, 600)
    most = STEEPEST * lobe(name, length, length).tail(far - 1)
    assert (slope_of(shape, far) <= most).all()
