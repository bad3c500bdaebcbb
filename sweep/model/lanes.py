"""Sums of products in vectors of eight lanes: fast, in an order that no machine changes.

A loop that adds one product after the other waits for each, and a compiler may not reorder it.
Here the order is fixed in lanes, whatever the machine's own vectors hold: its bits are the same
everywhere, and do not depend on what lies beyond the n elements.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES, SUMS = 8, 4
"""Elements of a vector; vectors that are added up side by side."""

COLUMNS = LANES * SUMS
"""Elements that :func:`combine` writes."""

_DOUBLE, _INT, _LONG = ir.DoubleType(), ir.IntType(32), ir.IntType(64)
_VECTOR = ir.VectorType(_DOUBLE, LANES)
_ZEROS = ir.Constant(_VECTOR, [0.0] * LANES)


@intrinsic
def dot(typingctx, a, b, n):  # type: ignore[no-untyped-def]  # a numba intrinsic
    """Sum of the products of the first n elements of two contiguous arrays."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        arrays = [
            context.make_array(kind)(context, builder, value).data
            for kind, value in zip(sig.args[:2], args[:2], strict=True)
        ]
        sums = [cgutils.alloca_once_value(builder, _ZEROS) for _ in range(SUMS)]
        for place in sums:
            builder.store(_ZEROS, place)
        done = _whole_vectors(builder, arrays, args[2], sums, SUMS, _long(0))
        done = _whole_vectors(builder, arrays, args[2], sums[:1], 1, done)
        mask = _first_lanes(builder, builder.sub(args[2], done))
        rest = [_load_some(builder, array, done, mask) for array in arrays]
        first, second, third, fourth = (builder.load(place) for place in sums)
        second = _fma(builder, *rest, second)
        total = builder.fadd(builder.fadd(first, second), builder.fadd(third, fourth))
        return _across(builder, total)

    return types.float64(a, b, types.intp), codegen


@intrinsic
def combine(typingctx, factors, rows, number, at, stride, out):  # type: ignore[no-untyped-def]
    """Sum of ``number`` rows times factors, :data:`COLUMNS` elements of each, into ``out``.

    ``rows`` is flat: the first begins at element ``at``, each next one ``stride`` further.
    """

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        factor_of, row_of, into = (
            context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 1, 5)
        )
        sums = [cgutils.alloca_once_value(builder, _ZEROS) for _ in range(SUMS)]
        for place in sums:
            builder.store(_ZEROS, place)
        with cgutils.for_range(builder, args[2]) as loop:
            factor = _in_all_lanes(builder, builder.load(builder.gep(factor_of, [loop.index])))
            start = builder.add(args[3], builder.mul(loop.index, args[4]))
            for k, place in enumerate(sums):
                vector = _load(builder, row_of, builder.add(start, _long(k * LANES)))
                builder.store(_fma(builder, factor, vector, builder.load(place)), place)
        for k, place in enumerate(sums):
            stored = builder.store(builder.load(place), _place(builder, into, _long(k * LANES)))
            stored.align = 8
        return context.get_dummy_value()

    return types.void(factors, rows, types.intp, types.intp, types.intp, out), codegen


@intrinsic
def combine_both(typingctx, factors, rows, number, at, stride, out):  # type: ignore[no-untyped-def]
    """As :func:`combine` with two factors for each row; ``factors`` and ``out`` are pairs."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        factors_of, into = (
            [
                context.make_array(kind)(context, builder, builder.extract_value(args[k], i)).data
                for i, kind in enumerate(sig.args[k])
            ]
            for k in (0, 5)
        )
        row_of = context.make_array(sig.args[1])(context, builder, args[1]).data
        sums = [[cgutils.alloca_once_value(builder, _ZEROS) for _ in range(SUMS)] for _ in into]
        for place in (*sums[0], *sums[1]):
            builder.store(_ZEROS, place)
        with cgutils.for_range(builder, args[2]) as loop:
            start = builder.add(args[3], builder.mul(loop.index, args[4]))
            row = [
                _load(builder, row_of, builder.add(start, _long(k * LANES))) for k in range(SUMS)
            ]
            for array, places in zip(factors_of, sums, strict=True):
                factor = _in_all_lanes(builder, builder.load(builder.gep(array, [loop.index])))
                for vector, place in zip(row, places, strict=True):
                    builder.store(_fma(builder, factor, vector, builder.load(place)), place)
        for array, places in zip(into, sums, strict=True):
            for k, place in enumerate(places):
                stored = builder.store(
                    builder.load(place), _place(builder, array, _long(k * LANES))
                )
                stored.align = 8
        return context.get_dummy_value()

    return types.void(factors, rows, types.intp, types.intp, types.intp, out), codegen


def _long(value):  # type: ignore[no-untyped-def]
    return ir.Constant(_LONG, value)


def _whole_vectors(builder, arrays, n, sums, step, done):  # type: ignore[no-untyped-def]
    """Adds as many vectors, `step` at a time, as there are from `done` on; where it ends."""
    width = _long(step * LANES)
    number = builder.udiv(builder.sub(n, done), width)
    with cgutils.for_range(builder, number) as loop:
        start = builder.add(done, builder.mul(loop.index, width))
        for k, place in enumerate(sums):
            at = builder.add(start, _long(k * LANES))
            vectors = [_load(builder, array, at) for array in arrays]
            builder.store(_fma(builder, *vectors, builder.load(place)), place)
    return builder.add(done, builder.mul(number, width))


def _place(builder, array, at):  # type: ignore[no-untyped-def]
    return builder.bitcast(builder.gep(array, [at]), _VECTOR.as_pointer())


def _load(builder, array, at):  # type: ignore[no-untyped-def]
    vector = builder.load(_place(builder, array, at))
    vector.align = 8
    return vector


def _in_all_lanes(builder, value):  # type: ignore[no-untyped-def]
    kind = ir.VectorType(value.type, LANES)
    nothing = ir.Constant(kind, ir.Undefined)
    one = builder.insert_element(nothing, value, ir.Constant(_INT, 0))
    zeros = ir.Constant(ir.VectorType(_INT, LANES), [0] * LANES)
    return builder.shuffle_vector(one, nothing, zeros)


def _first_lanes(builder, number):  # type: ignore[no-untyped-def]
    """Which lanes hold the last elements."""
    lanes = ir.VectorType(_INT, LANES)
    each = _in_all_lanes(builder, builder.trunc(number, _INT))
    return builder.icmp_signed("<", ir.Constant(lanes, list(range(LANES))), each)


def _load_some(builder, array, at, mask):  # type: ignore[no-untyped-def]
    place = _place(builder, array, at)
    kind = ir.FunctionType(_VECTOR, [place.type, _INT, mask.type, _VECTOR])
    load = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.load.v8f64.p0")
    return builder.call(load, [place, ir.Constant(_INT, 8), mask, _ZEROS])


def _fma(builder, a, b, c):  # type: ignore[no-untyped-def]
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
    fma = cgutils.get_or_insert_function(builder.module, kind, "llvm.fma.v8f64")
    return builder.call(fma, [a, b, c])


def _across(builder, vector):  # type: ignore[no-untyped-def]
    """Sum over the lanes: halves, quarters, eighths."""
    width = LANES
    while width > 1:
        width //= 2
        halves = [
            builder.shuffle_vector(
                vector,
                vector,
                ir.Constant(ir.VectorType(_INT, width), list(range(first, first + width))),
            )
            for first in (0, width)
        ]
        vector = builder.fadd(*halves)
    return builder.extract_element(vector, ir.Constant(_INT, 0))
