# SPDX-License-Identifier: Apache-2.0
"""`append_near` appends the indices of near points.

The search for neighbours compares some 200 candidates for 30 hits; as a scalar loop that costs more
than everything else in a step. Sixteen candidates are compared at once here, and the hits are
stored one after the other: by one compressing store where the processor has it (AVX-512), else by
walking the set bits of the comparison's mask. Both give the same list in the same order.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from sph_ros.core.vector import HAS_AVX512, INT32, INTERPRETED, LANES, WHOLE, constant, splat
from sph_ros.core.vector_memory import data_pointer, load_vector, store_vector


def _store_set_bits(builder, bits, indices, pointer, cursor):
    """Store indices[position of each set bit] one after the other; the new cursor."""
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
    builder.store(builder.load(builder.gep(indices, [lane])), builder.gep(pointer, [place]))
    builder.store(builder.add(place, ir.Constant(place.type, 1)), stored)
    builder.store(builder.and_(now, builder.sub(now, ir.Constant(int32, 1))), rest)
    builder.branch(test)
    builder.position_at_end(done)
    return builder.add(cursor, builder.load(stored))


@intrinsic
def append_near(typingctx, xs, ys, zs, indices, begin, x, y, z, square, target, cursor):
    """Append to `target` the indices of those of 16 points that are nearer than a radius.

    Args:
        xs, ys, zs: coordinates, (N,) float32; the points are begin ... begin + 15.
        indices: of the points, (N,) uint32.
        begin: the first of them.
        x, y, z: centre, float32.
        square: the radius squared, float32.
        target: indices are written from target[cursor] on; 16 elements must be free, (M,) uint32.
        cursor: where to write.

    Returns:
        The new cursor.
    """
    signature = types.intp(xs, ys, zs, indices, types.intp, x, y, z, square, target, types.intp)

    def codegen(context, builder, sig, args):
        *arrays, begin_, x_, y_, z_, square_, target_, cursor_ = args
        *pointers, indices_, target_ = (
            data_pointer(context, builder, array_type, array)
            for array_type, array in zip(
                (*sig.args[:4], sig.args[9]), (*arrays, target_), strict=True
            )
        )
        distance = None
        for pointer, centre in zip(pointers, (x_, y_, z_), strict=True):
            values = load_vector(builder, pointer, begin_)
            offset = builder.fsub(splat(builder, centre), values)
            term = builder.fmul(offset, offset, flags=("contract",))
            distance = (
                term if distance is None else builder.fadd(distance, term, flags=("contract",))
            )
        near = builder.fcmp_ordered("<", distance, splat(builder, square_))
        bits = builder.zext(builder.bitcast(near, ir.IntType(LANES)), INT32)
        target_pointer = builder.gep(target_, [cursor_])
        if HAS_AVX512:
            # In a register and then stored whole: the instruction that stores only the hits is
            # several times slower.
            compress = cgutils.get_or_insert_function(
                builder.module,
                ir.FunctionType(WHOLE, [WHOLE, WHOLE, near.type]),
                f"llvm.x86.avx512.mask.compress.v{LANES}i32",
            )
            found = load_vector(builder, indices_, begin_)
            hits = builder.call(compress, [found, constant(0, WHOLE), near])
            store_vector(builder, hits, target_pointer, ir.Constant(cursor_.type, 0))
            count = builder.ctpop(bits)
            return builder.add(cursor_, builder.zext(count, cursor_.type))
        indices_ = builder.gep(indices_, [begin_])
        return _store_set_bits(builder, bits, indices_, target_pointer, cursor_)

    return signature, codegen


def _append_near_plainly(xs, ys, zs, indices, begin, x, y, z, square, target, cursor):
    """What `append_near` does, one point after the other."""
    for k in range(begin, begin + LANES):
        dx, dy, dz = x - xs[k], y - ys[k], z - zs[k]
        if dx * dx + dy * dy + dz * dz < square:
            target[cursor] = indices[k]
            cursor += 1
    return cursor


if INTERPRETED:
    append_near = _append_near_plainly
