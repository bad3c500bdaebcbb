"""What tests of phase errors share: spectra of lines, and the peak with and without an error."""

import numpy as np

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
