"""Sums in lanes: right, and of nothing but their elements."""

import math

import numpy as np
from numba import njit

from sweep.model.lanes import COLUMNS, combine, combine_both, dot


@njit
def products(a, b, n):
    return dot(a, b, n)


@njit
def combined(factors, rows, number, at, stride, out):
    combine(factors, rows, number, at, stride, out)


@njit
def combined_both(factors, rows, number, at, stride, out):
    combine_both((factors[0], factors[1]), rows, number, at, stride, (out[0], out[1]))


def test_sums_of_products_are_right_to_rounding_for_any_length():
    rng = np.random.default_rng(71)
    for n in range(140):
        a, b = rng.normal(size=(2, n + 1)) * 10.0 ** rng.uniform(-3, 3, (2, n + 1))
        terms = a[:n] * b[:n]
        assert abs(products(a, b, n) - math.fsum(terms)) <= 8e-16 * (1 + n / 32) * abs(terms).sum()


def test_neither_what_lies_beyond_nor_where_it_lies_changes_a_bit():
    rng = np.random.default_rng(72)
    a, b = rng.normal(size=(2, 77))
    for n in (0, 1, 7, 8, 31, 33, 77):
        alone = products(a[:n].copy(), b[:n].copy(), n)
        for start in range(9):
            longer = np.full((2, 100), np.nan)
            longer[:, start : start + n] = a[:n], b[:n]
            assert products(longer[0, start:], longer[1, start:], n) == alone


def test_combinations_of_rows_are_products_with_a_matrix():
    rng = np.random.default_rng(73)
    rows, factors = rng.normal(size=3000), rng.normal(size=40)
    for number, at, stride in ((0, 0, 1), (1, 5, 32), (33, 7, 41), (40, 0, 64)):
        out = np.full(COLUMNS + 3, 7.0)
        combined(factors, rows, number, at, stride, out)
        matrix = [rows[at + m * stride :][:COLUMNS] for m in range(number)]
        expected = factors[:number] @ np.array(matrix).reshape(number, COLUMNS)
        np.testing.assert_allclose(out[:COLUMNS], expected, rtol=1e-13, atol=1e-13)
        assert (out[COLUMNS:] == 7.0).all()


def test_two_combinations_at_once_are_each_of_them_to_the_bit():
    rng = np.random.default_rng(74)
    rows, factors = rng.normal(size=3000), rng.normal(size=(2, 40))
    for number, at, stride in ((0, 0, 1), (1, 5, 32), (33, 7, 41), (40, 0, 64)):
        out, alone = np.full((2, 2, COLUMNS + 3), 7.0)
        combined_both(factors, rows, number, at, stride, out)
        for k in range(2):
            combined(factors[k], rows, number, at, stride, alone[k])
        assert (out == alone).all()
