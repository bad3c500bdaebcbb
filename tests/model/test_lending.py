"""Tuples that are handed on by their place: the same elements, whatever they are."""

import numpy as np
from numba import njit

from sweep.model.compiling import borrowing
from sweep.model.elementary import borrowed, flat
from sweep.model.lending import lend


@borrowing()
def looked_at(lent, k):
    (number, pair), array, table = lent[0], lent[1], lent[2]
    return number + pair[0] * pair[1] + array[k] + table[k, 1] + len(lent[0][1])


@njit
def by_place(values, array, table, k):
    kept = (values[0], (values[1], values[2])), borrowed(array), borrowed(table)
    return looked_at(lend(kept), k), looked_at(kept, k)


@njit
def in_a_row(table):
    return flat(table)[1:].sum(), flat(table).size


def test_what_is_lent_is_what_was_lent():
    array, table = np.arange(4.0), np.arange(12.0).reshape(4, 3)
    for k in range(4):
        expected = 0.5 + 3 * 7.0 + k + 3 * k + 1 + 2
        assert by_place((0.5, 3, 7.0), array, table, k) == (expected, expected)


def test_a_table_in_one_row_has_all_its_elements():
    table = np.arange(12.0).reshape(4, 3)
    assert in_a_row(table) == (66.0, 12)
    assert table.sum() == 66.0
