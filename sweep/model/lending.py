"""Tuples that compiled code hands on by where they are, not element by element.

What a segment needs to know is some two hundred numbers: every array is a pointer, shape and
strides. Handed on as values they are written and read again in every call, which takes longer than
all else where there are few lines. A tuple that is lent stays where it is; each function reads the
elements that it uses.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.imputils import impl_ret_borrowed
from numba.core.typing import signature
from numba.core.typing.templates import AbstractTemplate, infer
from numba.extending import intrinsic, lower_builtin, register_model


class Lent(types.Type):
    """A tuple of type ``of`` by its place in memory."""

    def __init__(self, of):  # type: ignore[no-untyped-def]  # a numba type
        self.of = of
        super().__init__(name=f"Lent({of})")


register_model(Lent)(models.OpaqueModel)


@intrinsic
def lend(typingctx, value):  # type: ignore[no-untyped-def]  # a numba intrinsic
    """A tuple by where it is: for the function that calls it, and all that this one calls.

    Elements at constant places may be taken of it, as of the tuple; but not past the return of
    the function, whose memory it is.
    """

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        place = cgutils.alloca_once_value(builder, args[0])
        return builder.bitcast(place, context.get_value_type(sig.return_type))

    return Lent(value)(value), codegen


@infer
class _ElementType(AbstractTemplate):
    key = "static_getitem"

    def generic(self, args, kws):  # type: ignore[no-untyped-def]
        lent, at = args
        if isinstance(lent, Lent) and isinstance(at, int):
            return signature(lent.of.types[at], *args)
        return None


@lower_builtin("static_getitem", Lent, types.IntegerLiteral)
def _element(context, builder, sig, args):  # type: ignore[no-untyped-def]
    whole = context.get_value_type(sig.args[0].of)
    place = builder.bitcast(args[0], whole.as_pointer())
    zero, at = (ir.Constant(ir.IntType(32), k) for k in (0, args[1]))
    value = builder.load(builder.gep(place, [zero, at], inbounds=True))
    return impl_ret_borrowed(context, builder, sig.return_type, value)
