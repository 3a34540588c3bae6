"""Arrays that functions of a kernel hand on without counting who holds them. Importing this imports numba."""

from __future__ import annotations

from .jit import intrinsic


@intrinsic
def lent(types, arrays):
    """An array, or a tuple of some, without a share in what keeps it.

    Functions that are handed arrays count who holds them, at a cost that a loop over points feels. Whoever lends one has to
    keep it: as an argument that Python passed to the kernel, or as a variable of the function that called this one.
    """

    def codegen(context, builder, signature, args):
        from numba.core import cgutils

        def bare(kind, value):
            if isinstance(kind, types.Array):
                array = context.make_array(kind)(context, builder, value)
                array.meminfo = cgutils.get_null_value(array.meminfo.type)
                array.parent = cgutils.get_null_value(array.parent.type)
                return array._getvalue()
            return value

        kind = signature.return_type
        if isinstance(kind, types.Array):
            return bare(kind, args[0])
        parts = cgutils.unpack_tuple(builder, args[0], len(kind))
        return context.make_tuple(builder, kind, [bare(*one) for one in zip(kind, parts, strict=True)])

    return arrays(arrays), codegen
