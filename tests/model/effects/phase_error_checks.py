"""What tests of phase errors share: spectra of lines, and the peak with and without an error."""

import numpy as np
from effect_points import ROUNDING, magnitudes, point_block, small, tile_block
from effect_points import scene as scene_of

from sweep.model.effects.catalogue import CORE, EFFECTS
from sweep.model.window import samples, transform

WINDOWS = (
    "rectangular", "hann", "hamming", "blackman", "nuttall", "blackmanharris", "flattop",
    "kaiser(8.6)", "chebwin(100)", "tukey(0.3)", "bartlett",
)  # fmt: skip


def lines_spectrum(position, weight, shape, bins):
    """|X| of the real record sum Re(weight exp(2 pi i position n / L)) at bins of fs/L."""
    values = []
    for sign in (-1, 1):
        y = (bins[:, None] + sign * position).ravel()
        near = (y + shape.length / 2) % shape.length - shape.length / 2
        # W is periodic, so that folded lines need no care.
        kernel = transform(shape, near).reshape(bins.size, position.size)
        values.append(kernel @ (weight if sign < 0 else weight.conj()) / 2)
    return np.abs(values[0] + values[1])


def peak_ratio(phase, name, length, bins):
    """Largest |X| of a line at ``bins`` with the phase error over that without, (n,)."""
    n = np.arange(length)
    w = samples(name, length)
    tone = w * np.exp(2j * np.pi * bins[:, None] * n / length)
    error = np.exp(2j * np.pi * phase(2 * n / length - 1))
    with_it, without = (np.abs(np.fft.fft(v, axis=1)).max(axis=1) for v in (tone * error, tone))
    return with_it / without


def check_bound(change, ratio):
    """The ratios lie within the bound; returns log-interval over log of the true change."""
    low, high = change.signal
    assert (low <= ratio * (1 + 1e-12)).all()
    assert (ratio <= high * (1 + 1e-12)).all()
    true = np.abs(np.log(ratio))
    return np.log(high[true > 0] / low[true > 0]) / true[true > 0]


def check_blocks(name, table, further, *, others=(), seeds=6, number=40, **fixed):
    """A bound holds at points and over tiles; returns interval over change of points, in logs.

    ``further`` makes the effect's parameters from a random generator and a number of points.
    """
    (effect,) = (effect for effect in EFFECTS if effect.name == name)
    base, idle = (*CORE, *others), []
    for seed in range(seeds):
        rng = np.random.default_rng((73, seed))
        slow = rng.choice([-1, 1], number) * 10 ** rng.uniform(-2, 2.5, number)
        values = {"fft_size": small(seed), "beamlets": 7, "radial_velocity": slow} | fixed
        parameters = scene_of(table, number, seed, **values) | further(rng, number)
        for block, points in ((point_block(parameters), parameters), tile_block(parameters, seed)):
            change = effect.bound(block)
            shape = (3, number)
            low, high = (np.broadcast_to(end, shape) for end in change.signal)
            together = block.echo_ratio.high if block.architecture == "direct" else 1.0
            in_phase = np.sqrt(2 * block.echo_ratio.high) * block.gain.high * together
            added = change.added * block.amplitude.high * block.deviation.high * in_phase
            without, found = (magnitudes(points, names) for names in (base, (*base, name)))
            assert (low * without * (1 - ROUNDING) - added <= found * (1 + ROUNDING)).all()
            assert (found * (1 - ROUNDING) <= high * without * (1 + ROUNDING) + added).all()
            if points is parameters:
                moved = abs(np.log(found / without))
                told = (moved > 1e-7) & (low > 0) & (np.broadcast_to(change.added, shape) == 0)
                idle.append(np.log(high[told] / low[told]) / moved[told])
    return np.concatenate(idle)
