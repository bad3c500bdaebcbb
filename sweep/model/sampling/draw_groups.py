"""Groups of draws whose random numbers are spread evenly, so that their means vary little.

Draws of random effects come in groups of :data:`DRAWS_PER_GROUP` consecutive numbers. Each draw is
as random as one that is alone: its numbers are uniform and independent. The draws of a group,
however, depend on each other. A pair of numbers, such as those of one complex amplitude, visits
every cell of equal area among 64 once: cells of 1/64 by 1, 1/32 by 1/2, and so on to 1 by 1/64.
Such a set of points is a scrambled net [1]_. Different pairs visit their cells in independent
random orders (Latin supercube sampling [2]_). Different groups are independent.

The mean of a group is therefore unbiased. If a probability is a smooth function of one pair, the
variance of the mean is far below that of independent draws. For any function it is at most twice
that of independent draws, and comes near to twice only for functions that vary from cell to cell.
Of a pair of radius and angle, the angle is spread evenly over half the circle, and its sign is
random. The confidence interval of a mean over many groups follows from the variance of the groups'
means
(:func:`sweep.model.error_budget.grouped_mean_half_width`).

Cells and orders are addressed by point, group, cause and index, as all random numbers are
(:mod:`sweep.model.sampling.philox`). So the first draws stay the same if more are added.

References
----------
.. [1] Owen, Scrambled net variance for integrals of smooth functions, Ann. Stat. 25, 1997.
.. [2] Owen, Latin supercube sampling for very high-dimensional simulations, ACM TOMACS 8, 1998.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.sampling.philox import (
    BLOCK_INCREMENTS,
    FIRST_BLOCK_NUMBER,
    GROUP_STREAM_OFFSET,
    DrawAddress,
    fill_words,
    to_uniform,
)

_DRAW_IN_GROUP_BITS = 6
DRAWS_PER_GROUP = 1 << _DRAW_IN_GROUP_BITS
"""Number of draws in a group, over which random numbers are spread evenly. The means of larger
groups vary less, but a confidence interval follows from the variance of several groups' means. A
tolerance of 0.01 takes at least 384 draws."""

GROUPED_NUMBERS_MAX = 32
"""Largest number of random numbers of a draw, for each cause, that are spread evenly over a group
of draws. All later numbers are independent: as none of so many matters much, spreading them would
gain little."""

_WORDS_PER_PAIR = 4 + DRAWS_PER_GROUP
"""Number of random words of a group of draws for each pair of random numbers: two to scramble the
cells of the two numbers, two unused, and one for each draw of the group to shuffle the order of the
cells."""

_CELL_SHIFT, _OFFSET_SHIFT = np.uint64(64 - _DRAW_IN_GROUP_BITS), np.uint64(_DRAW_IN_GROUP_BITS)
_UINT64_ONE = np.uint64(1)


def grouped_uniforms(
    keys: np.ndarray, draw_numbers: np.ndarray, stream: int, count: int, *, are_polar: bool = False
) -> np.ndarray:
    """Return uniform numbers of m draws, (m, count), spread evenly over each group of draws.

    Parameters
    ----------
    keys
        (m, 2) uint64: random key of each row.
    draw_numbers
        (m,) int64: number of the draw of each row.
    stream
        Number of the stream: the physical cause.
    count
        Number of uniform numbers in a row. The first :data:`GROUPED_NUMBERS_MAX` are spread evenly.
    are_polar
        True if the second number of each pair is an angle in cycles. The angle's distance from 0 is
        then spread evenly, and its sign is random: most results depend on the cosine of an angle.
    """
    uniform_numbers = np.empty((draw_numbers.size, (count + 3) // 4 * 4))
    n_pairs = (min(count, GROUPED_NUMBERS_MAX) + 1) // 2
    cells = np.empty((2 * n_pairs, DRAWS_PER_GROUP), np.uint64)
    _fill_grouped_uniforms(
        np.ascontiguousarray(keys),
        np.asarray(draw_numbers, np.int64),
        stream,
        are_polar,
        cells,
        uniform_numbers,
    )
    return uniform_numbers[:, :count]


@njit(cache=True, nogil=True)
def _fill_grouped_uniforms(keys, draw_numbers, stream, are_polar, cells, uniform_numbers):
    """Fill an array with uniform numbers that are spread evenly over each group of draws.

    The upper bits of a number are its cell, and the lower bits its random place in the cell.

    Parameters
    ----------
    keys : ndarray (m, 2) uint64
        Random key of each row.
    draw_numbers : ndarray (m,) int64
        Number of the draw of each row. Consecutive rows of one key and group share their cells,
        which are then drawn once.
    stream : int
        Number of the stream: the physical cause.
    are_polar : bool
        True if the second number of each pair is an angle in cycles, as in
        :func:`grouped_uniforms`.
    cells : ndarray (numbers, DRAWS_PER_GROUP) uint64
        Scratch: cell of each number in each draw of a group. Only the first ``numbers`` of a row
        are spread evenly; the others are independent.
    uniform_numbers : ndarray (m, count)
        Result: uniform numbers in (0, 1). The count is a multiple of 4.
    """
    words = np.empty((4, uniform_numbers.shape[1] // 4), np.uint64)
    for i in range(draw_numbers.size):
        group = draw_numbers[i] >> _DRAW_IN_GROUP_BITS
        if (
            i == 0
            or group != draw_numbers[i - 1] >> _DRAW_IN_GROUP_BITS
            or keys[i, 0] != keys[i - 1, 0]
            or keys[i, 1] != keys[i - 1, 1]
        ):
            _fill_cells(DrawAddress(keys[i, 0], keys[i, 1], group), stream, cells)
        address = DrawAddress(keys[i, 0], keys[i, 1], draw_numbers[i])
        fill_words(address, stream, FIRST_BLOCK_NUMBER, BLOCK_INCREMENTS, words.shape[1], words)
        member = draw_numbers[i] & (DRAWS_PER_GROUP - 1)
        for number in range(uniform_numbers.shape[1]):
            own_word = word = words[number & 3, number >> 2]
            if number < cells.shape[0]:
                word = cells[number, member] << _CELL_SHIFT | own_word >> _OFFSET_SHIFT
                if are_polar and number & 1:  # the lowest bit is in no cell: it is the sign
                    word = word >> _UINT64_ONE
                    word = ~word if own_word & _UINT64_ONE else word
            uniform_numbers[i, number] = to_uniform(word)


@njit(cache=True)
def _fill_cells(group_address, stream, cells):
    """Draw the cell of each random number in each draw of a group.

    Parameters
    ----------
    group_address
        Key of the point, and number of the group in place of that of a draw.
    stream
        Number of the stream of the random numbers.
    cells
        (numbers, DRAWS_PER_GROUP) uint64: output array of cells, 0 to DRAWS_PER_GROUP - 1, by
        number and draw. The two numbers of pair i are in rows 2 i and 2 i + 1.

    Notes
    -----
    Before scrambling, the points of a pair are (i, i with its bits reversed): Hammersley's net. The
    order is shuffled by Fisher and Yates.
    """
    words = np.empty((4, _WORDS_PER_PAIR // 4), np.uint64)
    order = np.empty(DRAWS_PER_GROUP, np.int64)
    group_stream = stream + GROUP_STREAM_OFFSET
    for pair in range(cells.shape[0] // 2):
        first_block = np.int64(pair * words.shape[1])
        fill_words(
            group_address, group_stream, first_block, BLOCK_INCREMENTS, words.shape[1], words
        )
        for i in range(DRAWS_PER_GROUP):
            order[i] = i
        for last in range(DRAWS_PER_GROUP - 1, 0, -1):
            word = words[last & 3, 1 + (last >> 2)]
            other = np.int64(word % np.uint64(last + 1))
            order[last], order[other] = order[other], order[last]
        for member in range(DRAWS_PER_GROUP):
            index, reversed_index = order[member], 0
            for bit in range(_DRAW_IN_GROUP_BITS):
                reversed_index = reversed_index << 1 | (index >> bit & 1)
            cells[2 * pair, member] = _scramble_cell(index, words[0, 0])
            cells[2 * pair + 1, member] = _scramble_cell(reversed_index, words[1, 0])


@njit(cache=True)
def _scramble_cell(cell, word):
    """Return a cell, 0 to DRAWS_PER_GROUP - 1, with bits flipped at random (Owen's scrambling).

    A bit of the random ``word`` decides on each flip. The choice of this bit depends on the higher
    bits of the cell, so that every half of the unit interval, every half of a half, and so on is
    swapped by itself.
    """
    node, scrambled = np.uint64(1), np.uint64(0)
    for level in range(_DRAW_IN_GROUP_BITS - 1, -1, -1):
        bit = np.uint64(cell >> level & 1)
        scrambled = scrambled << _UINT64_ONE | (bit ^ (word >> node & _UINT64_ONE))
        node = node << _UINT64_ONE | bit
    return scrambled


class GroupStatistics(NamedTuple):
    """Number and variance of the means of whole groups of draws, (names, points) each."""

    n_groups: np.ndarray
    """(names, points) int64: number of groups of draws that are complete."""
    group_variance: np.ndarray
    """(names, points): unbiased estimate of the variance of the mean of a group of draws; nan with
    fewer than two complete groups."""


class GroupMeans:
    """Means of values over whole groups of draws of n points, accumulated draw by draw.

    Draws are added in the order of their numbers, from 0 on. Values exist in all draws of a point,
    or in none of them (nan).

    Parameters
    ----------
    n_points
        Number of points n.
    names
        Names of the values.
    """

    def __init__(self, n_points: int, names: Sequence[str]) -> None:
        self.names, shape = tuple(names), (len(names), n_points)
        self.mean = np.zeros(shape)
        """(names, n): mean of the values over whole groups."""
        self.squared_deviations = np.zeros(shape)
        """(names, n): sum over groups of squared deviations of their means."""
        self.open_sum = np.zeros(shape)
        """(names, n): sum of the values in the group that is not yet whole."""

    def add(
        self, point_indices: np.ndarray, draw_numbers: np.ndarray, values: Mapping[str, np.ndarray]
    ) -> None:
        """Add the values of draws to the sums and means of their points, in place.

        Parameters
        ----------
        point_indices : ndarray (m,) int64
            Index of the point of each draw.
        draw_numbers : ndarray (m,) int64
            Numbers of the draws.
        values : mapping of str to ndarray (m,)
            Values of each draw, by name.
        """
        rows = np.array([values[name] for name in self.names])
        _add_to_group_means(
            point_indices, draw_numbers, rows, self.mean, self.squared_deviations, self.open_sum
        )

    def statistics(self, point_indices: np.ndarray, n_values: np.ndarray) -> GroupStatistics:
        """Return the numbers of complete groups of draws, and the variances of their means.

        Parameters
        ----------
        point_indices : ndarray (m,) int64
            Indices of the points.
        n_values : ndarray (names, m) int64
            Numbers of values that were added to these points, without nan.

        Returns
        -------
        GroupStatistics
            Arrays (names, m).
        """
        n_groups = n_values // DRAWS_PER_GROUP
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = self.squared_deviations[:, point_indices] / (n_groups - 1.0)
        return GroupStatistics(n_groups, np.where(n_groups > 1, variance, np.nan))

    def state(self) -> np.ndarray:
        """Return all means and sums as one array (3 * names, n), for :meth:`restore_state`."""
        return np.concatenate([self.mean, self.squared_deviations, self.open_sum])

    def restore_state(self, state: np.ndarray) -> None:
        """Set all means and sums from an array that :meth:`state` returned."""
        self.mean[...], self.squared_deviations[...], self.open_sum[...] = np.split(state, 3)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_to_group_means(
    point_indices, draw_numbers, values, mean, squared_deviations, open_sum
):  # fmt: skip
    """Add values of draws to means over groups of draws, in place.

    A group is complete after its last draw, and only then counts in the means.

    Parameters
    ----------
    point_indices, draw_numbers
        (m,): index of the point, and number of the draw, of each column of `values`.
    values
        (names, m): values of draws; nan does not count.
    mean, squared_deviations
        (names, n): mean of the groups' means, and sum of squared deviations from it; updated.
    open_sum
        (names, n): sum of the values in the group that is not yet whole; updated.
    """
    for k in range(values.shape[0]):
        for j in range(point_indices.size):
            i, x = point_indices[j], values[k, j]
            if np.isnan(x):
                continue
            open_sum[k, i] += x
            n_groups = (draw_numbers[j] + 1) >> _DRAW_IN_GROUP_BITS
            if n_groups << _DRAW_IN_GROUP_BITS == draw_numbers[j] + 1:
                group_mean = open_sum[k, i] / DRAWS_PER_GROUP
                deviation = group_mean - mean[k, i]
                mean[k, i] += deviation / n_groups
                squared_deviations[k, i] += deviation * (group_mean - mean[k, i])
                open_sum[k, i] = 0.0
