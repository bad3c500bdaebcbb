"""Correlation of the speckle that the strongest bins of two segments of a shot see.

A scatterer of delay tau and Doppler ratio beta has, in the middle t_c of the record of a segment
that starts at t_s, the beat phase

    -2 pi F tau + 2 pi F beta (t_s + t_c),    F = f + S (t_c - tau_0)                            (1)

with the carrier f and the signed chirp rate S of the segment, and the delay tau_0 on the beam's
axis. F is the optical frequency of the echo in the middle of the record. If the echo fills a part
of the record its middle is the centroid of the window there. Between two segments the phases of
scatterers at different places turn against each other by their difference. If all scatterers lay in
one bin the two amplitudes, circular complex Gaussian numbers both, would have the correlation

    mu = E[exp(i (phase_2 - phase_1))]                                                          (2)

over the beam's power. This is exp(-t^2 / 2) if the phase difference is normal with deviation t.

A bin weighs scatterers by the window's transform G about its own frequency. If the footprint spans
a good part of a bin, or more, the strongest bins of two segments weigh different parts of it. With
the places nu_i(y) of the lines, y the coordinate along which they spread most,

    mu = int p G(k_1 - nu_1) G(k_2 - nu_2) e^(i t y) dy / sqrt(S_1 S_2),
    S_i = int p G(k_i - nu_i)^2 dy                                                              (3)

Lines are taken to move evenly along y. (3) thus leaves out Doppler shifts that change as the square
of the angle across the beam (150 m/s in a beam of 5 mrad: 3 bins), which (2) has.

The probability that both bins cross a threshold is that of two correlated Rayleigh magnitudes,
:func:`sweep.model.detection.fading_together`, by |mu|.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.model.window import Window, samples

SEGMENT_PAIRS = ((0, 1), (0, 2), (1, 2))
"""Pairs (up, Doppler), (up, down), (Doppler, down); the order of all arrays by pair of segments."""

NARROW = 0.01
"""Line shift per standard deviation of the beam [bins of fs/L] below which one bin holds all
lines."""

REACH = 6.0
"""Half-width of the window transform in the integrals (3) [bins of fs/L]."""

OVERSAMPLING = 64
"""Samples of the tabulated window transform per bin of fs/L."""
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(48)
_DEVIATIONS_MAX = 5.0
"""Largest half-width of the integration interval [standard deviations of the beam]."""
_RESOLVED_PHASE_MAX = 40.0
"""Largest phase [rad] at the ends of the interval that the quadrature nodes resolve."""


class SpeckleLines(NamedTuple):
    """Gradients of line position and phase across the beams of n points, along two coordinates."""

    spread: np.ndarray
    """(n, 3, 2): line shift per standard deviation of the beam [bins of fs/N], signed as the
    beat."""
    turn: np.ndarray
    """(n, 3, 2): phase per standard deviation of the beam, relative to the up segment [rad]."""

    def of(self, part: np.ndarray) -> "SpeckleLines":
        """Select points by their indices."""
        return SpeckleLines(self.spread[part], self.turn[part])


class LineSpread(NamedTuple):
    """Gradients across the beam of the lines of two segments, arrays (n,)."""

    distance: tuple[np.ndarray, np.ndarray]
    """Distance k - nu of each segment's strongest bin from the line of the axis [bins of fs/L]."""
    spread: tuple[np.ndarray, np.ndarray]
    """Line shift of each segment per standard deviation of the beam along y [bins of fs/L],
    signed."""
    turn: np.ndarray
    """Phase difference t between the segments per standard deviation of the beam along y [rad]."""
    lean: np.ndarray
    """Relative change of the echo's power per standard deviation of the beam along y."""

    @property
    def widest(self) -> np.ndarray:
        """Larger of the two spreads [bins of fs/L]."""
        return np.maximum(np.abs(self.spread[0]), np.abs(self.spread[1]))

    def at(self, points: np.ndarray) -> "LineSpread":
        """Select points by their indices."""
        (d, e), (a, b) = self.distance, self.spread
        return LineSpread(
            (d[points], e[points]), (a[points], b[points]), self.turn[points], self.lean[points]
        )


def bin_correlation(window: Window, lines: LineSpread) -> np.ndarray:
    """Return the correlation mu, equation (3), of the strongest bins of two segments, (n,) complex.

    If the phase turns too fast for the quadrature, the result is |mu| for a Gaussian window
    transform of the same half-width, which is close to 0 there.
    """
    from sweep.model.speckle_integral import integrate_correlation  # a compiler is slow to import

    end = np.minimum(_DEVIATIONS_MAX, REACH / np.maximum(lines.widest, 1e-300))
    is_resolved = np.abs(lines.turn) * end <= _RESOLVED_PHASE_MAX
    correlation = _gaussian_correlation(window, lines).astype(complex)
    integrate_correlation(
        np.flatnonzero(is_resolved), end, np.stack(lines.distance), np.stack(lines.spread),
        lines.turn, lines.lean, transform_table(window)[1], OVERSAMPLING, _NODE, _WEIGHT,
        correlation,
    )  # fmt: skip
    return correlation


def _gaussian_correlation(window: Window, lines: LineSpread) -> np.ndarray:
    """Return |mu| for the Gaussian transform G(x) = exp(-x^2 / (4 v)), (n,).

    v is such that G falls to 1/2 at the same distance as the window's transform. All factors of the
    integrals (3) are then Gaussian.
    """
    v = _half_width(window) ** 2 / (4 * np.log(2))
    (a, b), (d, e) = lines.spread, lines.distance
    stiffness = 1 + (a * a + b * b) / (2 * v)
    pull = (d * a + e * b) / (2 * v)
    exponent = (pull**2 - lines.turn**2) / (2 * stiffness) - (d * d + e * e) / (4 * v)
    log_strengths = sum(
        -np.log1p(s * s / v) / 2 - x * x / (2 * (v + s * s)) for s, x in ((a, d), (b, e))
    )
    return np.exp(np.minimum(exponent - np.log(stiffness) / 2 - log_strengths / 2, 0.0))


def window_transform(window: Window, distance: np.ndarray) -> np.ndarray:
    """Return the normalised window transform G, G(0) = 1, about the record's middle; it is real.

    ``distance`` is in bins of fs/L. G is set to 0 beyond 2 REACH.

    >>> from sweep.model.window import window
    >>> float(np.round(window_transform(window("hann", 1024), np.array([1.0]))[0], 3))
    0.5
    """
    place, value = transform_table(window)
    return np.interp(np.abs(distance), place, value, right=0.0)


@lru_cache(maxsize=16)
def middle_moved(window: Window) -> np.ndarray:
    """Return by how many samples a centroid is later without a window's first k ones, (L + 1,)."""
    w, n = samples(window.name, window.length), np.arange(window.length)
    later = np.cumsum(w[::-1])[::-1]
    moment = np.cumsum((w * n)[::-1])[::-1]
    moved = np.zeros(window.length + 1)
    there = later > 1e-6 * w.sum()  # of hardly a sample left nothing is detected
    moved[:-1][there] = moment[there] / later[there] - moment[0] / later[0]
    return moved


def _half_width(window: Window) -> float:
    """Return the distance [bins of fs/L] at which G falls to 1/2; at most 2 REACH."""
    place, value = transform_table(window)
    fallen = value < 0.5  # nowhere if all samples but one are 0, as of hann's two
    last = int(np.argmax(fallen)) if fallen.any() else value.size - 1
    return float(np.interp(-0.5, -value[: last + 1], place[: last + 1]))


@lru_cache(maxsize=16)
def transform_table(window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Tabulate the window transform: distances 0 .. 2 REACH [bins of fs/L], and G there."""
    place = np.arange(int(2 * REACH * OVERSAMPLING) + 1) / OVERSAMPLING
    w = samples(window.name, window.length)
    time = (np.arange(window.length) - window.length / 2) / window.length
    # Sums, not products of matrices, whose order depends on the number of threads.
    value = np.array([(w * np.cos(2 * np.pi * y * time)).sum() for y in place])
    return place, value / w.sum()
