"""Spectra of lines by plain sums."""

import numpy as np

from sweep.model.window import transform

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
