"""Interval arithmetic: all that may come out lies within, and single numbers stay what they are."""

import operator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sweep.model.effects.span import Span, monotone

number = st.one_of(st.floats(-1e6, -1e-6), st.just(0.0), st.floats(1e-6, 1e6))
share = st.floats(0, 1)
OPERATIONS = (operator.add, operator.sub, operator.mul, operator.truediv)


def span_and_point(a, b, u):
    low, high = sorted((a, b))
    return Span(np.array([low]), np.array([high])), np.clip(low + u * (high - low), low, high)


@given(number, number, share, number, number, share)
@pytest.mark.parametrize("operation", OPERATIONS)
def test_what_points_give_lies_within_what_spans_give(operation, a, b, u, c, d, v):
    one, x = span_and_point(a, b, u)
    two, y = span_and_point(c, d, v)
    if operation is operator.truediv and y == 0:
        return
    assert operation(one, two).holds(operation(x, y)).all()
    # a number on either side is a span of one value
    assert operation(one, y).holds(operation(x, y)).all() or (operation, y) == (operator.truediv, 0)
    assert operation(x, two).holds(operation(x, y)).all()


@pytest.mark.parametrize("many", [1.0, np.array([1.0])])
def test_denormals_divide_to_infinity_without_a_warning(many):
    least = 2.0**-1040
    for divisor in (least, np.float64(least), Span(many * least, many)):
        for one in (Span.of(many), Span(-many, many)):
            assert (one / divisor).high == np.inf


@given(number, number, share)
def test_powers_roots_and_magnitudes_lie_within(a, b, u):
    span, x = span_and_point(a, b, u)
    last_bit = 1e-15  # powers of arrays and of numbers round differently
    for power in (2, 3, 4):
        assert (span**power).holds(x**power, last_bit).all()
    assert abs(span).holds(abs(x)).all() and (-span).holds(-x).all()
    size = abs(span)
    assert size.sqrt().holds(np.sqrt(abs(x))).all()
    assert (size**1.5).holds(abs(x) ** 1.5, last_bit).all()
    assert span.minimum(3.0).holds(min(x, 3.0)).all() and span.maximum(0).holds(max(x, 0)).all()
    assert Span.hull(span, 7.0).holds([x]).all() and Span.hull(span, 7.0).holds(7.0).all()
    if abs(x) > 1e-6:
        assert (span**-2).holds(x**-2.0, last_bit).all()


@given(number, number)
@pytest.mark.parametrize("operation", OPERATIONS)
def test_one_value_is_plain_arithmetic_to_the_last_bit(operation, a, b):
    if operation is operator.truediv and b == 0:
        return
    result, plain = operation(Span.of(a), Span.of(b)), operation(a, b)
    assert result.low == result.high == plain
    assert (Span.of(a) ** 3).low == a**3 and abs(Span.of(a)).high == abs(a)


def test_a_divisor_that_may_be_nothing_leaves_everything_possible():
    result = 1.0 / Span(np.array([-1.0, 2.0]), np.array([1.0, 4.0]))
    assert result.low.tolist() == [-np.inf, 0.25] and result.high.tolist() == [np.inf, 0.5]


def test_arrays_leave_arithmetic_to_spans():
    span = np.array([1.0, 2.0]) * Span.of(3.0)
    assert isinstance(span, Span) and span.high.tolist() == [3.0, 6.0]
    assert span.some(np.array([1])).low.tolist() == [6.0] and Span.of(2.0).some([0]).low == 2.0
    assert not span.is_one and Span(np.ones(3), np.ones(3)).is_one


@given(number, number, share, number, number, share)
def test_products_of_what_is_never_negative_are_products(a, b, u, c, d, v):
    (one, x), (two, y) = span_and_point(abs(a), abs(b), u), span_and_point(abs(c), abs(d), v)
    found, usual = one.times(0.5, two, y), 0.5 * one * two * y
    assert (found.low == usual.low).all() and (found.high == usual.high).all()
    assert found.holds(x * 0.5 * y * y).all()


def test_monotone_functions_are_taken_at_their_ends():
    found = monotone(lambda x, y: x / y, falling=("y",), x=Span(1.0, 2.0), y=Span(4.0, 8.0))
    assert (found.low, found.high) == (0.125, 0.5)
