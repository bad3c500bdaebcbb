"""Quadrature of the correlation of two segments' bins in developed speckle, as a kernel.

The equation is (3) of :mod:`sweep.model.detection.speckle_correlation`.
"""

import math

import numpy as np

from sweep.kernel_cache import njit


@njit(cache=True, nogil=True, error_model="numpy")
def fill_peak_bin_correlation(
    point_indices,
    half_interval,
    strongest_bin_offset,
    line_shift,
    phase_difference,
    relative_power_gradient,
    transform,
    samples_per_bin,
    nodes,
    weights,
    correlation,
):
    """Fill ``correlation`` with the speckle correlation of two segments at the given points.

    The correlation is mu of equation (3) of :mod:`sweep.model.detection.speckle_correlation`.

    Parameters
    ----------
    point_indices
        Indices of the points.
    half_interval
        (n,): half-width of the interval across the beam that is integrated over [standard
        deviations of the beam].
    strongest_bin_offset, line_shift, phase_difference, relative_power_gradient
        Fields of :class:`sweep.model.detection.speckle_correlation.LinePairGradients`; the first
        two are stacked to (2, n).
    transform, samples_per_bin
        Tabulated G, the result of
        :func:`sweep.model.detection.speckle_correlation.window_transform_table`, and its number of
        samples per bin.
    nodes, weights
        Nodes and weights of a quadrature on -1 .. 1.
    correlation
        (n,) complex: output array.
    """
    node_power, previous_half_interval = np.empty(nodes.size), -1.0
    for point in point_indices:
        if half_interval[point] != previous_half_interval:  # equal for footprints within a bin
            previous_half_interval = half_interval[point]
            for node in range(nodes.size):
                node_power[node] = weights[node] * math.exp(
                    -0.5 * (previous_half_interval * nodes[node]) ** 2
                )
        re, im, power_first, power_second = 0.0, 0.0, 0.0, 0.0
        for node in range(nodes.size):
            y = previous_half_interval * nodes[node]
            line_power = node_power[node] * max(1.0 + relative_power_gradient[point] * y, 0.0)
            transform_first = _interpolate_transform(
                strongest_bin_offset[0, point] - line_shift[0, point] * y,
                transform,
                samples_per_bin,
            )
            transform_second = _interpolate_transform(
                strongest_bin_offset[1, point] - line_shift[1, point] * y,
                transform,
                samples_per_bin,
            )
            product = line_power * transform_first * transform_second
            re += product * math.cos(phase_difference[point] * y)
            im += product * math.sin(phase_difference[point] * y)
            power_first += line_power * transform_first * transform_first
            power_second += line_power * transform_second * transform_second
        root_power_product = math.sqrt(max(power_first * power_second, 1e-300))
        correlation[point] = complex(re / root_power_product, im / root_power_product)


@njit(cache=True, error_model="numpy", borrows=True)
def _interpolate_transform(distance, transform, samples_per_bin):
    """Interpolate a tabulated window transform at a distance; it is 0 beyond the table's end.

    The unit of distance is the sample rate over the number of samples in the record.
    """
    table_position = abs(distance) * samples_per_bin
    if table_position >= transform.size - 1:
        return transform[transform.size - 1] if table_position == transform.size - 1 else 0.0
    index = int(table_position)
    return transform[index] + (table_position - index) * (transform[index + 1] - transform[index])
