# SPDX-License-Identifier: Apache-2.0
"""The one vector instruction that LLVM does not find by itself: append the indices of near points.

The search for neighbours compares some 200 candidates for 30 hits. As a scalar loop that costs more
than everything else in a step. Sixteen candidates are compared at once here, and the hits are
stored one after the other: by one compressing store where the processor has it (AVX-512), else by
walking the set bits of the comparison's mask. Both give the same list in the same order.
"""

import llvmlite.binding as llvm
from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16

#: Numba is told to interpret: the vector code becomes a plain loop.
INTERPRETED = bool(config.DISABLE_JIT)

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)

HAS_COMPRESSING_STORE = bool(llvm.get_host_cpu_features().get("avx512f", False))


def _splat(builder, value, vector_type):
    """A vector with `value` in every lane."""
    empty = ir.Constant(vector_type, ir.Undefined)
    first = builder.insert_element(empty, value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(_INTS, [0] * LANES)
    return builder.shuffle_vector(first, empty, zeros)


def _pointer(context, builder, array_type, array, index):
    """Address of array[index] of a contiguous one-dimensional array, no wrap-around."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


def _load(context, builder, array_type, array, index):
    """Sixteen floats from array[index] on."""
    pointer = _pointer(context, builder, array_type, array, index)
    load = builder.load(builder.bitcast(pointer, _FLOATS.as_pointer()))
    load.align = 4
    return load


def _store_set_bits(builder, bits, first, pointer, cursor):
    """Store first + (position of each set bit) one after the other; the new cursor."""
    int32 = bits.type
    rest = cgutils.alloca_once_value(builder, bits)
    stored = cgutils.alloca_once_value(builder, ir.Constant(cursor.type, 0))
    test = builder.append_basic_block("bits.test")
    body = builder.append_basic_block("bits.body")
    done = builder.append_basic_block("bits.done")
    builder.branch(test)
    builder.position_at_end(test)
    now = builder.load(rest)
    builder.cbranch(builder.icmp_unsigned("!=", now, ir.Constant(int32, 0)), body, done)
    builder.position_at_end(body)
    lane = builder.cttz(now, ir.Constant(ir.IntType(1), 0))
    place = builder.load(stored)
    builder.store(builder.add(first, lane), builder.gep(pointer, [place]))
    builder.store(builder.add(place, ir.Constant(place.type, 1)), stored)
    builder.store(builder.and_(now, builder.sub(now, ir.Constant(int32, 1))), rest)
    builder.branch(test)
    builder.position_at_end(done)
    return builder.add(cursor, builder.load(stored))


@intrinsic
def append_within(typingctx, xs, ys, zs, begin, end, x, y, z, square, target, cursor):
    """Append to `target` the indices of those of 16 points that are nearer than a radius.

    Args:
        xs, ys, zs: coordinates, each with 16 readable elements from `begin` on, (N,) float32.
        begin, end: points begin .. min(begin + 16, end) - 1 are compared.
        x, y, z: centre, float32.
        square: the radius squared, float32.
        target: indices are written from target[cursor] on; 16 elements must be free, (M,) int32.
        cursor: where to write.

    Returns:
        The new cursor.
    """
    signature = types.intp(xs, ys, zs, types.intp, types.intp, x, y, z, square, target, types.intp)

    def codegen(context, builder, sig, args):
        xs_, ys_, zs_, begin_, end_, x_, y_, z_, square_, target_, cursor_ = args
        total = None
        for array_type, array, centre in zip(
            sig.args[:3], (xs_, ys_, zs_), (x_, y_, z_), strict=True
        ):
            values = _load(context, builder, array_type, array, begin_)
            offset = builder.fsub(_splat(builder, centre, _FLOATS), values)
            term = builder.fmul(offset, offset, flags=("contract",))
            total = term if total is None else builder.fadd(total, term, flags=("contract",))
        near = builder.fcmp_ordered("<", total, _splat(builder, square_, _FLOATS))
        lanes = ir.Constant(_INTS, list(range(LANES)))
        room = builder.trunc(builder.sub(end_, begin_), ir.IntType(32))
        mask = builder.and_(near, builder.icmp_signed("<", lanes, _splat(builder, room, _INTS)))
        bits = builder.zext(builder.bitcast(mask, ir.IntType(LANES)), ir.IntType(32))
        first = builder.trunc(begin_, ir.IntType(32))
        target_pointer = _pointer(context, builder, sig.args[9], target_, cursor_)
        if HAS_COMPRESSING_STORE:
            indices = builder.add(lanes, _splat(builder, first, _INTS))
            store = cgutils.get_or_insert_function(
                builder.module,
                ir.FunctionType(ir.VoidType(), [_INTS, ir.IntType(32).as_pointer(), _BITS]),
                f"llvm.masked.compressstore.v{LANES}i32",
            )
            builder.call(store, [indices, target_pointer, mask])
            count = builder.ctpop(bits)
            return builder.add(cursor_, builder.zext(count, cursor_.type))
        return _store_set_bits(builder, bits, first, target_pointer, cursor_)

    return signature, codegen


def _append_within_plainly(xs, ys, zs, begin, end, x, y, z, square, target, cursor):
    """What `append_within` does, one point after the other."""
    for k in range(begin, min(begin + LANES, end)):
        dx, dy, dz = x - xs[k], y - ys[k], z - zs[k]
        if dx * dx + dy * dy + dz * dz < square:
            target[cursor] = k
            cursor += 1
    return cursor


if INTERPRETED:
    append_within = _append_within_plainly
