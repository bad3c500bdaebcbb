"""Quadrature of the correlation of two segments' bins in developed speckle, as a kernel.

The equation is (3) of :mod:`sweep.model.speckle_correlation`.
"""

import math

import numpy as np

from sweep.kernel_cache import njit


@njit(cache=True, nogil=True, error_model="numpy")
def integrate_correlation(
    points, end, distance, spread, turn, lean, transform, oversampling, nodes, weights, correlation
):
    """Integrate equation (3) at some points, into ``correlation`` (n,) complex.

    Parameters
    ----------
    points
        Indices of these points.
    end
        (n,): half-width of the interval of y [standard deviations of the beam].
    distance, spread, turn, lean
        Of :class:`sweep.model.speckle_correlation.LineSpread`, the first two (2, n).
    transform, oversampling
        G of :func:`sweep.model.speckle_correlation.transform_table`, and its values per bin.
    nodes, weights
        Of a rule of quadrature on -1 .. 1.
    """
    power, last = np.empty(nodes.size), -1.0
    for i in points:
        if end[i] != last:  # alike of all footprints within a bin
            last = end[i]
            for j in range(nodes.size):
                power[j] = weights[j] * math.exp(-0.5 * (last * nodes[j]) ** 2)
        re, im, first_strength, second_strength = 0.0, 0.0, 0.0, 0.0
        for j in range(nodes.size):
            y = last * nodes[j]
            share = power[j] * max(1.0 + lean[i] * y, 0.0)
            first = _transform_at(distance[0, i] - spread[0, i] * y, transform, oversampling)
            second = _transform_at(distance[1, i] - spread[1, i] * y, transform, oversampling)
            both = share * first * second
            re += both * math.cos(turn[i] * y)
            im += both * math.sin(turn[i] * y)
            first_strength += share * first * first
            second_strength += share * second * second
        strength = math.sqrt(max(first_strength * second_strength, 1e-300))
        correlation[i] = complex(re / strength, im / strength)


@njit(cache=True, error_model="numpy", borrows=True)
def _transform_at(distance, transform, oversampling):
    """Interpolate G, tabulated from 0 on, at a distance [bins of fs/L]; 0 beyond the table."""
    place = abs(distance) * oversampling
    if place >= transform.size - 1:
        return transform[transform.size - 1] if place == transform.size - 1 else 0.0
    k = int(place)
    return transform[k] + (place - k) * (transform[k + 1] - transform[k])
