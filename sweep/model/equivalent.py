"""Many close lines as few: Chebyshev anterpolation of a band-limited kernel.

As a function of a line's position, the spectrum's kernel is band-limited: pi r radians per bin,
r = L/N. Lines within +-h bins of their centre are therefore equivalent to J lines at Chebyshev
nodes, J = 8 + some 1.3 pi h, to 1e-13 of the summed amplitudes: a tight footprint of 109
beamlets costs some ten lines.

What a series of J terms leaves out of a sample of the record at t, -1..1, is some 2 J_J(pi h t):
next to nothing but at the record's ends, where most windows are small. The window weighs it, which
saves three nodes of ten and ten of fifty.
"""

import math
from functools import lru_cache

import numpy as np

from sweep.model.compiling import borrowing
from sweep.model.elementary import fma
from sweep.model.lanes import dot

AMPLITUDE_TOLERANCES = (
    1e-13, 3e-13, 1e-12, 3e-12, 1e-11, 3e-11, 1e-10, 3e-10, 1e-9, 3e-9, 1e-8, 3e-8, 1e-7, 3e-7,
    1e-6, 3e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2,
)  # fmt: skip
"""Errors of an equivalent sum of amplitudes, relative to the sum of their magnitudes."""

POWER_TOLERANCES = (
    1e-18, 1e-15, 1e-13, 1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3
)  # fmt: skip
"""The same of powers: the root of the first is what a null of |X| shows."""

MOST_NODES = 128
"""Equivalent lines at the most; wider bundles are left as they are."""

CHEBYSHEV = np.zeros((MOST_NODES + 1, MOST_NODES))
for _n in range(1, MOST_NODES + 1):
    CHEBYSHEV[_n, :_n] = np.cos(np.pi * (np.arange(_n) + 0.5) / _n)


@lru_cache(maxsize=32)
def node_limits(weights: tuple[float, ...], tolerances: tuple[float, ...]) -> np.ndarray:
    """Largest pi h that J equivalent lines serve to each tolerance, from J = 1.

    Parameters
    ----------
    weights
        Of places evenly spaced from the middle of the band to its end, both included
        (:func:`band_weights`); their sum is 1.
    tolerances
        Rising.

    Returns
    -------
    (tolerances, MOST_NODES + 1) ndarray
        With the tolerances themselves at J = 0.
    """
    limits = np.empty((len(tolerances), MOST_NODES + 1))
    limits[:, 0] = tolerances
    for nodes in range(1, MOST_NODES + 1):
        low, high = np.full(len(tolerances), -60.0), np.full(len(tolerances), math.log(2 * nodes))
        for _ in range(40):
            middle = (low + high) / 2
            serves = _left_out(middle, nodes, np.array(weights)) < tolerances
            low, high = np.where(serves, middle, low), np.where(serves, high, middle)
        limits[:, nodes] = np.exp(low)
    return limits


def _left_out(log_z: np.ndarray, order: int, weights: np.ndarray) -> np.ndarray:
    """Bound on what the first J terms of a Chebyshev series leave out, (n,) for (n,) ln z < ln 2 J.

    2 sum_{m >= J} |J_m(z t)|, the mean over t, from J_m(x) <= (x/2)^m / m! exp(-x^2 / (4 m + 4)).
    """
    z, t = np.exp(log_z), np.linspace(0, 1, weights.size)
    spread = np.exp(-np.multiply.outer(z * z, t * t) / (4 * order + 4)) * t**order
    first = math.log(2) + order * (log_z - math.log(2)) - math.lgamma(order + 1)
    return np.asarray(np.exp(first) * (spread @ weights) / (1 - z / (2 * order + 2)))


@borrowing()
def equivalent_lines(
    delta, re, im, n, power, band, tolerance, most, limits, out_delta, out_re, out_im, work
):  # fmt: skip
    """Few lines with the same spectrum as n lines: Chebyshev moments put onto Chebyshev nodes.

    Parameters
    ----------
    delta, re, im : (n,) float64
        Positions [bins from a common origin] and complex weights.
    power : bool
        Weights are real, and what ``im`` holds is not looked at.
    band : float
        Half bandwidth of the kernel in radians per bin: pi r for amplitudes, 2 pi r for powers.
    tolerance : float
        Error allowed, relative to the sum of the weights' magnitudes; the least of those of
        ``limits`` is taken where it is smaller than all.
    most : int
        Equivalent lines at the most; where more are needed the lines stay as they are.
    limits : (levels, m) float64
        :func:`node_limits`.
    out_delta, out_re, out_im : (>= max(n, MOST_NODES),) float64
        The equivalent lines.
    work : (5, >= max(n, MOST_NODES)) float64
        Scratch.

    Returns
    -------
    int
        Number of equivalent lines; n with the lines themselves where that is no more.
    """
    low, high = delta[0], delta[0]
    for b in range(n):
        low = min(low, delta[b])
        high = max(high, delta[b])
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    nodes = nodes_for(band * half, tolerance, limits)
    nodes = nodes if nodes <= most else n
    return put_on_nodes(
        delta, re, im, n, power, middle, half, nodes, out_delta, out_re, out_im, work
    )  # fmt: skip


@borrowing()
def nodes_for(turn, tolerance, limits):
    """Nodes that serve lines within +-``turn`` radians of the kernel's band, or one more than any.

    Other parameters as of :func:`equivalent_lines`.
    """
    level = limits.shape[0] - 1
    while level > 0 and limits[level, 0] > tolerance:
        level -= 1
    nodes = 1
    while nodes < limits.shape[1] and limits[level, nodes] < turn:
        nodes += 1
    return nodes


@borrowing()
def put_on_nodes(
    delta, re, im, n, power, middle, half, nodes, out_delta, out_re, out_im, work
):  # fmt: skip
    """Moves n weights within ``middle`` +- ``half`` onto Chebyshev nodes there, if they are fewer.

    ``power``: weights are real. Other parameters and the result as of :func:`equivalent_lines`.
    """
    if nodes >= n or nodes > MOST_NODES:
        for b in range(n):
            out_delta[b], out_re[b], out_im[b] = delta[b], re[b], im[b]
        return n
    x, moment_re, moment_im = work[0], work[3], work[4]
    inverse = 1.0 / half if half > 0.0 else 0.0
    for b in range(n):
        x[b] = (delta[b] - middle) * inverse
    chebyshev_moments(x, re, im, n, nodes, power, work[1], work[2], moment_re, moment_im)
    put_moments_on_nodes(
        nodes, middle, half, moment_re, moment_im, out_delta, out_re, out_im, work[0], work[1]
    )
    return nodes


@borrowing()
def put_moments_on_nodes(
    nodes, middle, half, moment_re, moment_im, out_delta, out_re, out_im, chebyshev, following_node
):  # fmt: skip
    """Weights at Chebyshev nodes within ``middle`` +- ``half`` that have these first moments.

    The last two are scratch.
    """
    for i in range(nodes):
        chebyshev[i] = 1.0
        following_node[i] = CHEBYSHEV[nodes, i]
        out_re[i] = 0.0
        out_im[i] = 0.0
        out_delta[i] = following_node[i]
    for j in range(nodes):
        share = (1.0 if j == 0 else 2.0) / nodes
        one, other = share * moment_re[j], share * moment_im[j]
        for i in range(nodes):
            out_re[i] = fma(chebyshev[i], one, out_re[i])
            out_im[i] = fma(chebyshev[i], other, out_im[i])
            after = 2.0 * out_delta[i] * following_node[i] - chebyshev[i]
            chebyshev[i] = following_node[i]
            following_node[i] = after
    for i in range(nodes):
        out_delta[i] = middle + half * out_delta[i]


@borrowing()
def chebyshev_moments(x, re, im, n, number, power, even, odd, out_re, out_im):
    """Sums over n weights of T_0(x) .. T_number-1(x); for ``power`` the imaginary ones are 0.

    ``x`` (n,) lies within -1..1; ``even``, ``odd`` are scratch; results may have one more.
    """
    for b in range(n):
        even[b] = 1.0
        odd[b] = x[b]
    for j in range(0, number, 2):
        out_re[j], out_re[j + 1] = dot(re, even, n), dot(re, odd, n)
        if not power:
            out_im[j], out_im[j + 1] = dot(im, even, n), dot(im, odd, n)
        for b in range(n):
            twice = 2.0 * x[b]
            even[b] = fma(twice, odd[b], -even[b])
            odd[b] = fma(twice, even[b], -odd[b])
    if power:
        out_im[:number] = 0.0
