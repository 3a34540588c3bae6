"""The compiled kernels of the forest: many rows walk its trees at once.

A tree is walked by many rows in lock step. One step loads a node, which is two numbers side by side (its threshold; its
feature and left child packed into one), compares, and moves to the left child or the one after it. A leaf points at
itself under a threshold that is not a number, so nothing is ever greater, no branch has to be predicted and many loads are
in flight at a time; the bits that such a number is free to have say which row of the leaf table it is. Eight rows go
together, or 64 in vectors where the processor gathers from memory (AVX-512), two to five times as fast as
scikit-learn's descent, row by row. The results are equal bit for bit: the same comparisons, and probabilities added in
the same order.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from llvmlite import ir

from ..base.jit import device, intrinsic, njit
from .walkable import SPAN

#: Rows that walk a tree together, one by one or in so many vectors.
LANES = 8
WIDE, VECTOR = 64, 16
#: Where Linux says whether the processor's gathers were made slow, against a fault of some.
_GATHERS = Path("/sys/devices/system/cpu/vulnerabilities/gather_data_sampling")


@cache
def gathers() -> bool:
    """Whether this processor gathers sixteen numbers from memory as fast as it loads them one by one."""
    from numba.core.registry import cpu_target

    if "+avx512f" not in str(getattr(cpu_target.target_context.codegen(), "_tm_features", "")):
        return False
    try:
        return not _GATHERS.read_text().startswith("Mitigation")
    except OSError:
        return True


@njit
def walk(values, sizes, nodes, limits, shift, child, free, leaf_value, group, out):
    """Add every tree's leaf probabilities to `out`.

    Parameters
    ----------
    values : (n * features,) float32
        Rows of feature values, one after the other.
    sizes : (trees,) int64
    nodes : (2 * nodes,) uint32 or uint64
        Of each node the bits of its threshold (go left where value <= threshold; of a leaf: NaN | row of `leaf_value`),
        and feature << shift | left child within the tree (of a leaf: its own index).
    limits : (2 * nodes,) float32 or float64
        The same memory, for the thresholds.
    shift, child, free : of nodes' type
        See above; the bits of a child, and those of NaN that hold a row.
    leaf_value : (leaves * columns,) float64
        A column for each class, and empty ones up to a multiple of SPAN.
    group : int
        Rows that pass over a tree before the next one's turn; a multiple of LANES.
    out : (n, columns) float64
    """
    n = len(out)
    columns, features = np.uint64(out.shape[1]), np.uint64(len(values) // max(n, 1))
    sums = out.reshape(-1)
    one = np.uint64(1)
    at = np.zeros(LANES, np.uint64)
    for first in range(0, n, group):
        last = min(n, first + group)
        whole = last - (last - first) % LANES
        start = 0
        for tree in range(len(sizes)):
            stop = start + sizes[tree]
            pairs = nodes[2 * start : 2 * stop]
            bounds = limits[2 * start : 2 * stop]
            for g in range(first, whole, LANES):
                base = np.uint64(g) * features
                for j in range(LANES):
                    at[j] = 0
                moving = True
                while moving:
                    changed = np.uint64(0)
                    row = base
                    for j in range(LANES):
                        i = at[j]
                        node = pairs[i + i + one]
                        step = values[row + np.uint64(node >> shift)] > bounds[i + i]
                        to = np.uint64(node & child) + np.uint64(step)
                        changed |= to ^ i
                        at[j] = to
                        row += features
                    moving = changed != 0
                for j in range(LANES):
                    add_leaf(
                        leaf_value, np.uint64(pairs[at[j] + at[j]] & free), sums, np.uint64(g + j), columns
                    )
            for r in range(whole, last):
                base = np.uint64(r) * features
                i = np.uint64(0)
                while True:
                    node = pairs[i + i + one]
                    step = values[base + np.uint64(node >> shift)] > bounds[i + i]
                    to = np.uint64(node & child) + np.uint64(step)
                    if to == i:
                        break
                    i = to
                add_leaf(leaf_value, np.uint64(pairs[i + i] & free), sums, np.uint64(r), columns)
            start = stop


@njit
def walk_wide(values, sizes, nodes, shift, child, free, leaf_value, group, out):
    """:func:`walk` with nodes of 32 bits, where :func:`gathers`; `group` is a multiple of WIDE."""
    n = len(out)
    columns, features = np.uint64(out.shape[1]), len(values) // max(n, 1)
    sums = out.reshape(-1)
    leaf = np.empty(WIDE, np.uint32)
    for first in range(0, n, group):
        last = min(n, first + group)
        start = 0
        for tree in range(len(sizes)):
            stop = start + sizes[tree]
            pairs = nodes[2 * start : 2 * stop]
            for g in range(first, last, WIDE):
                count = min(last - g, WIDE)
                _descend(
                    values, g * features, np.int32(features), np.int32(count), pairs, shift, child, free, leaf
                )
                for j in range(count):
                    add_leaf(leaf_value, np.uint64(leaf[j]), sums, np.uint64(g + j), columns)
            start = stop


@device(forceinline=True)
def add_leaf(leaf_value, leaf, sums, row, columns):
    """Add a row of the leaf table to a row of sums."""
    for c in range(np.uint64(0), columns, np.uint64(SPAN)):
        _add_span(leaf_value, leaf * columns + c, sums, row * columns + c)


@intrinsic
def _add_span(types, source, i, target, j):
    """Add SPAN float64 to others, as one vector."""
    signature = types.void(source, types.uint64, target, types.uint64)

    def codegen(context, builder, signature, args):
        vector = ir.VectorType(ir.DoubleType(), SPAN).as_pointer()

        def place(kind, array, index):
            data = context.make_array(kind)(context, builder, array).data
            return builder.bitcast(builder.gep(data, [index]), vector)

        more = builder.load(place(signature.args[0], args[0], args[1]), align=8)
        at = place(signature.args[2], args[2], args[3])
        builder.store(builder.fadd(builder.load(at, align=8), more), at, align=8)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def _descend(types, values, base, features, count, pairs, shift, child, free, leaf):
    """Walk one tree by the rows that begin at `base`, at most WIDE, and write which row of the leaf table each finds.

    Lanes beyond `count` walk along with the last row.
    """
    word = types.uint32
    signature = types.void(values, types.int64, types.int32, types.int32, pairs, word, word, word, leaf)

    def codegen(context, builder, signature, args):
        i1, i32, i64 = ir.IntType(1), ir.IntType(32), ir.IntType(64)
        anything = ir.IntType(8).as_pointer()
        words = ir.VectorType(i32, VECTOR)
        zero = ir.Constant(words, None)

        def whole(numbers):
            return ir.Constant(ir.VectorType(i32, len(numbers)), list(numbers))

        def data(k):
            return context.make_array(signature.args[k])(context, builder, args[k]).data

        def spread(number):
            one = builder.insert_element(ir.Constant(words, ir.Undefined), number, ir.Constant(i32, 0))
            return builder.shuffle_vector(one, zero, whole([0] * VECTOR))

        def gather(name, kind, address, index):
            lanes, bits = index.type.count, 4 if kind == ir.FloatType() else 8
            found, mask = ir.VectorType(kind, lanes), ir.VectorType(i1, lanes)
            form = ir.FunctionType(found, [found, anything, index.type, mask, i32])
            name = f"llvm.x86.avx512.mask.gather.{name}.512"
            function = builder.module.globals.get(name) or ir.Function(builder.module, form, name)
            every = ir.Constant(mask, [1] * lanes)
            given = [ir.Constant(found, ir.Undefined), address, index, every, ir.Constant(i32, bits)]
            return builder.call(function, given)

        rows_at = builder.bitcast(builder.gep(data(0), [args[1]]), anything)
        nodes_at = builder.bitcast(data(4), anything)
        shifts, children, bits_of_leaf = (spread(args[k]) for k in (5, 6, 7))
        width, last = spread(args[2]), spread(builder.sub(args[3], ir.Constant(i32, 1)))
        parts = range(WIDE // VECTOR)
        rows = []
        for k in parts:
            row = whole(range(VECTOR * k, VECTOR * (k + 1)))
            row = builder.select(builder.icmp_signed("<", row, last), row, last)
            rows.append(builder.mul(row, width))
        before = builder.block
        loop, end = builder.append_basic_block("descend"), builder.append_basic_block("leaves")
        builder.branch(loop)
        builder.position_at_end(loop)
        at = [builder.phi(words) for _ in parts]
        moved, limits = zero, []
        for k in parts:
            at[k].add_incoming(zero, before)
        for k in parts:
            halves = []
            for half in (range(VECTOR // 2), range(VECTOR // 2, VECTOR)):
                index = builder.shuffle_vector(at[k], zero, whole(half))
                halves.append(builder.bitcast(gather("dpq", i64, nodes_at, index), words))
            limit, node = (
                builder.shuffle_vector(*halves, whole(range(first, 2 * VECTOR, 2))) for first in (0, 1)
            )
            index = builder.add(rows[k], builder.lshr(node, shifts))
            value = gather("dps", ir.FloatType(), rows_at, index)
            limits.append(limit)
            step = builder.fcmp_ordered(">", value, builder.bitcast(limit, value.type))
            to = builder.add(builder.and_(node, children), builder.zext(step, words))
            moved = builder.or_(moved, builder.xor(to, at[k]))
            at[k].add_incoming(to, loop)
        some = builder.bitcast(builder.icmp_unsigned("!=", moved, zero), ir.IntType(VECTOR))
        builder.cbranch(builder.icmp_unsigned("!=", some, ir.Constant(some.type, 0)), loop, end)
        builder.position_at_end(end)
        for k in parts:
            place = builder.gep(data(8), [ir.Constant(i64, VECTOR * k)])
            row = builder.and_(limits[k], bits_of_leaf)
            builder.store(row, builder.bitcast(place, words.as_pointer()), align=4)
        return context.get_dummy_value()

    return signature, codegen
