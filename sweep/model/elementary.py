"""Compiled elementary functions that the kernels share: exact products and phases in cycles.

Phases are counted in cycles and reduced before any sine is taken: an optical phase of 1e10
cycles keeps its fraction only where the product that makes it is carried in two doubles.
"""

import math

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array

_TAU = 2.0 * math.pi
# Taylor coefficients of sin(2 pi r) / r and cos(2 pi r) in r^2; |r| <= 1/8 leaves 5e-17.
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7 = (
    (-1) ** i * _TAU ** (2 * i + 1) / math.factorial(2 * i + 1) for i in range(8)
)
_C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8 = (
    (-1) ** i * _TAU ** (2 * i) / math.factorial(2 * i) for i in range(1, 9)
)


@intrinsic
def fma(typingctx, a, b, c):  # type: ignore[no-untyped-def]  # a numba intrinsic
    """Fused a * b + c with a single rounding: what makes a product exact in two doubles."""
    signature = types.float64(types.float64, types.float64, types.float64)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        double = ir.DoubleType()
        function = builder.module.declare_intrinsic(
            "llvm.fma", [double], ir.FunctionType(double, [double] * 3)
        )
        return builder.call(function, args)

    return signature, codegen


@intrinsic
def borrowed(typingctx, array):  # type: ignore[no-untyped-def]  # a numba intrinsic
    """The same array without a count of who uses it: its rows and slices cost nothing.

    Each of them would else take two locked instructions, which is most of the time where arrays
    are short. Only for what a caller outside compiled code holds on to meanwhile.
    """

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        view = context.make_array(sig.args[0])(context, builder, args[0])
        view.meminfo = cgutils.get_null_value(view.meminfo.type)
        view.parent = cgutils.get_null_value(view.parent.type)
        return view._getvalue()

    return array(array), codegen


@intrinsic
def flat(typingctx, array):  # type: ignore[no-untyped-def]  # a numba intrinsic
    """All elements of a contiguous array in one row, their use uncounted as of `borrowed`."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        whole = context.make_array(sig.args[0])(context, builder, args[0])
        row = context.make_array(sig.return_type)(context, builder)
        populate_array(
            row, whole.data, [whole.nitems], [whole.itemsize], whole.itemsize, meminfo=None
        )
        return row._getvalue()

    return types.Array(array.dtype, 1, "C")(array), codegen


@njit(inline="always")
def fraction_of_cycle(x):
    """Signed fraction of a number of cycles, in [-1/2, 1/2]."""
    return x - math.floor(x + 0.5)


@njit(inline="always")
def product_fraction(high, low, x):
    """Fraction of (high + low) * x cycles, right to about 1e-16 up to 1e15 cycles.

    The rounding error of high * x is recovered by a fused multiply-add, so what remains is
    low * x rounded once: beyond, 1e-32 of all cycles.
    """
    product = high * x
    rest = fma(high, x, -product) + low * x
    return fraction_of_cycle(fraction_of_cycle(product) + rest)


@njit(inline="always")
def quotient(numerator, denominator):
    """Numerator / denominator in two doubles (high, low)."""
    high = numerator / denominator
    return high, -fma(high, denominator, -numerator) / denominator


@njit(inline="always")
def sincos_cycles(x):
    """(sin, cos) of 2 pi x for |x| up to 1e8 or so, branch-free so that loops vectorise.

    Absolute error below 3e-16 plus that of x itself.
    """
    r = x - math.floor(x + 0.5)
    quadrant = math.floor(4.0 * r + 0.5)
    r -= 0.25 * quadrant
    z = r * r
    s = r * (_S0 + z * (_S1 + z * (_S2 + z * (_S3 + z * (_S4 + z * (_S5 + z * (_S6 + z * _S7)))))))
    c = 1.0 + z * (
        _C1 + z * (_C2 + z * (_C3 + z * (_C4 + z * (_C5 + z * (_C6 + z * (_C7 + z * _C8))))))
    )
    odd = (quadrant == 1.0) or (quadrant == -1.0)
    sine = c if odd else s
    cosine = s if odd else c
    sine = -sine if (quadrant == -1.0 or quadrant == 2.0 or quadrant == -2.0) else sine
    cosine = -cosine if (quadrant == 1.0 or quadrant == 2.0 or quadrant == -2.0) else cosine
    return sine, cosine
