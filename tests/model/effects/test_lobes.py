"""What bounds know of a window, against its transform by plain sums."""

import numpy as np
import pytest

from sweep.model.effects.lobes import lobe
from sweep.model.window import transform, window

NAMES = ("rectangular", "hamming", "hann", "blackman", "flattop", "nuttall", "kaiser(8.6)")
SIZES = ((512, 512), (300, 512), (131, 1024))


@pytest.fixture(params=[(n, *s) for n in NAMES for s in SIZES], ids=str)
def case(request):
    name, length, fft_size = request.param
    shape = window(name, length)

    def magnitude(x):
        turns = np.asarray(x, float) * length / fft_size
        return abs(transform(shape, turns.ravel())).reshape(turns.shape) / shape.sum

    return lobe(name, length, fft_size), magnitude


def test_slope_and_curvature_are_bounds_and_near(case):
    known, magnitude = case
    x = np.linspace(-4, 4, 1601) * known.margin
    power = magnitude(x) ** 2
    step = x[1] - x[0]
    steepest = abs(np.diff(power)).max() / step
    most_bent = abs(np.diff(power, 2)).max() / step**2
    assert steepest <= known.slope and most_bent <= known.curvature
    assert known.slope <= 10 * steepest and known.curvature <= 30 * most_bent


def test_the_energy_near_a_line_is_at_least_what_is_said(case):
    known, magnitude = case
    reach = int(np.ceil(known.margin)) + 1
    for shift in np.random.default_rng(2).uniform(0, 1, 40):
        away = np.arange(-reach, reach + 1) - shift
        total = (magnitude(away[abs(away) <= known.margin]) ** 2).sum()
        assert known.energy <= total
        assert known.energy >= 0.4 * total


def test_the_tail_holds_all_beyond(case):
    known, magnitude = case
    x = np.linspace(0.01, 60.0, 1500)
    truth = np.maximum.accumulate(magnitude(x)[::-1])[::-1]
    assert (truth <= known.tail(x) * (1 + 1e-9)).all()
