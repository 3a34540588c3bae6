"""Loops written as vectors of eight, where what LLVM makes of a loop over numbers is slower.

Sums have the same order, and so the same bits, on all processors, however long their registers are.
"""

from __future__ import annotations

from llvmlite import ir

from ..base.jit import intrinsic
from .index import SPARE

#: Numbers of a vector.
LANES = SPARE

#: Moments of a neighborhood: count, sums, products, lowest and highest height.
N, SX, SY, SZ, SXX, SXY, SXZ, SYY, SYZ, SZZ, LOW, HIGH = range(12)
MOMENTS = 12

#: Rows of the moments of :func:`add_members`: all but the count.
SUMS = MOMENTS - 1


@intrinsic
def exchange(types, keys, a, b):
    """Put the smaller of the vectors at a and b, lane by lane, at a and the larger at b."""

    def codegen(context, builder, signature, args):
        vector = ir.VectorType(ir.DoubleType(), LANES).as_pointer()
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        at = [builder.bitcast(builder.gep(data, [index]), vector) for index in args[1:]]
        pair = [builder.load(place, align=8) for place in at]
        kind = pair[0].type
        for place, name in zip(at, ("minnum", "maxnum"), strict=True):
            builder.store(
                builder.call(_function(builder, name, kind), pair, fastmath=("nnan",)), place, align=8
            )
        return context.get_dummy_value()

    return types.void(keys, types.int64, types.int64), codegen


@intrinsic
def add_members(types, x, y, z, height, first, last, sums):
    """Add the offsets of the members first..last - 1 of eight queries to their moments, in this order.

    Parameters
    ----------
    x, y, z, height : (need, 8) float64 arrays
        Offsets from the queries, and heights.
    sums : (11, 8) float64 array
        Sums of x, y, z, xx, xy, xz, yy, yz, zz, lowest and highest height.
    """

    def codegen(context, builder, signature, args):
        from numba.core import cgutils

        double, many = ir.DoubleType(), ir.VectorType(ir.DoubleType(), LANES)

        def place(kind, array, row):
            data = context.make_array(kind)(context, builder, array).data
            at = builder.mul(row, ir.Constant(row.type, LANES))
            return builder.bitcast(
                builder.gep(builder.bitcast(data, double.as_pointer()), [at]), many.as_pointer()
            )

        kind, array = signature.args[6], args[6]
        rows = [ir.Constant(args[4].type, row) for row in range(SUMS)]
        totals = [cgutils.alloca_once(builder, many) for _ in rows]
        for row, total in zip(rows, totals, strict=True):
            builder.store(builder.load(place(kind, array, row), align=8), total)

        def update(number, value):
            builder.store(builder.fadd(builder.load(totals[number]), value), totals[number])

        with cgutils.for_range_slice(builder, args[4], args[5], ir.Constant(args[4].type, 1)) as (i, _):
            dx, dy, dz, h = (builder.load(place(signature.args[k], args[k], i), align=8) for k in range(4))
            for number, value in enumerate((dx, dy, dz)):
                update(number, value)
            for number, (a, b) in enumerate(((dx, dx), (dx, dy), (dx, dz), (dy, dy), (dy, dz), (dz, dz)), 3):
                update(number, builder.fmul(a, b))
            for number, sign in ((9, "<"), (10, ">")):
                before = builder.load(totals[number])
                builder.store(
                    builder.select(builder.fcmp_ordered(sign, h, before), h, before), totals[number]
                )
        for row, total in zip(rows, totals, strict=True):
            builder.store(builder.load(total), place(kind, array, row), align=8)
        return context.get_dummy_value()

    return types.void(x, y, z, height, types.int64, types.int64, sums), codegen


def _sums_within(spherical):
    """An intrinsic that adds up the moments of the candidates within a radius, eight at a time.

    Written as vectors, so that a sum is left out by a mask instead of being made 0 first, and so that its order is the same
    on all processors: candidate i goes to partial sum i % 8. Registers of half that size go through the candidates twice.
    """

    @intrinsic
    def sums(types, px, py, pz, qx, qy, qz, r2):
        def codegen(context, builder, signature, args):
            from numba.core import cgutils

            double, count = ir.DoubleType(), ir.IntType(64)
            # Not what this processor can do, but what code is made for.
            wide = "+avx512f" in str(getattr(context.codegen(), "_tm_features", ""))
            lanes = LANES if wide else LANES // 2
            many = ir.VectorType(double, lanes)
            arrays = [
                context.make_array(kind)(context, builder, array)
                for kind, array in zip(signature.args[:3], args[:3], strict=True)
            ]
            length = cgutils.unpack_tuple(builder, arrays[0].shape)[0]

            def spread(value):
                one = builder.insert_element(ir.Constant(many, ir.Undefined), value, ir.Constant(count, 0))
                zeros = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
                return builder.shuffle_vector(one, ir.Constant(many, ir.Undefined), zeros)

            center, limit = [spread(value) for value in args[3:6]], spread(args[6])
            ones = ir.Constant(many, [1.0] * lanes)
            first = {LOW: float("inf"), HIGH: float("-inf")}

            def add_up(offset):
                totals = []
                for row in range(MOMENTS):
                    total = cgutils.alloca_once(builder, many)
                    builder.store(ir.Constant(many, [first.get(row, 0.0)] * lanes), total)
                    totals.append(total)
                step = ir.Constant(length.type, LANES)
                start = ir.Constant(length.type, offset)
                with cgutils.for_range_slice(builder, start, length, step, inc=True) as (i, _):
                    x, y, z = (
                        builder.load(
                            builder.bitcast(builder.gep(array.data, [i]), many.as_pointer()), align=8
                        )
                        for array in arrays
                    )
                    dx, dy, dz = (builder.fsub(a, b) for a, b in zip((x, y, z), center, strict=True))
                    square = builder.fadd(builder.fmul(dx, dx), builder.fmul(dy, dy))
                    if spherical:
                        square = builder.fadd(square, builder.fmul(dz, dz))
                    inside = builder.fcmp_ordered("<=", square, limit)

                    def keep(row, value):
                        before = builder.load(totals[row])
                        builder.store(builder.select(inside, value(before), before), totals[row])

                    for row, value in ((N, ones), (SX, dx), (SY, dy), (SZ, dz)):
                        keep(row, lambda before, value=value: builder.fadd(before, value))
                    for row, a, b in (
                        (SXX, dx, dx), (SXY, dx, dy), (SXZ, dx, dz), (SYY, dy, dy), (SYZ, dy, dz), (SZZ, dz, dz)
                    ):  # fmt: skip
                        product = builder.fmul(a, b, flags=("contract",))
                        keep(row, lambda before, p=product: builder.fadd(before, p, flags=("contract",)))
                    for row, name in ((LOW, "minnum"), (HIGH, "maxnum")):
                        extreme = _function(builder, name, many)
                        keep(row, lambda before, f=extreme: builder.call(f, [before, z], fastmath=("nnan",)))
                return [builder.load(total) for total in totals]

            def halves(vector):
                parts = []
                size = vector.type.count // 2
                for k in (0, size):
                    mask = ir.Constant(ir.VectorType(ir.IntType(32), size), list(range(k, k + size)))
                    parts.append(builder.shuffle_vector(vector, vector, mask))
                return parts

            def join(row, one, two):
                if row in first:
                    name = "minnum" if row == LOW else "maxnum"
                    return builder.call(_function(builder, name, one.type), [one, two], fastmath=("nnan",))
                return builder.fadd(one, two)

            if wide:
                pairs = [halves(total) for total in add_up(0)]
            else:
                pairs = list(zip(add_up(0), add_up(LANES // 2), strict=True))
            found = []
            for row, (one, two) in enumerate(pairs):
                total = join(row, one, two)
                while total.type.count > 2:
                    total = join(row, *halves(total))
                ends = [builder.extract_element(total, ir.Constant(count, k)) for k in range(2)]
                if row in first:
                    less = builder.fcmp_ordered("<" if row == LOW else ">", *ends)
                    found.append(builder.select(less, *ends))
                else:
                    found.append(builder.fadd(*ends))
            return context.make_tuple(builder, signature.return_type, found)

        return types.UniTuple(types.float64, MOMENTS)(px, py, pz, qx, qy, qz, r2), codegen

    return sums


def _function(builder, name, kind):
    from numba.core import cgutils

    function = ir.FunctionType(kind, [kind, kind])
    return cgutils.get_or_insert_function(builder.module, function, f"llvm.{name}.v{kind.count}f64")


sums_in_cylinder, sums_in_sphere = _sums_within(False), _sums_within(True)
