# SPDX-License-Identifier: Apache-2.0
"""Vector instructions that LLVM does not find by itself, and what is needed to use them.

`append_within` appends the indices of near points. The search for neighbours compares some 200
candidates for 30 hits; as a scalar loop that costs more than everything else in a step. Sixteen
candidates are compared at once here, and the hits are stored one after the other: by one
compressing store where the processor has it (AVX-512), else by walking the set bits of the
comparison's mask. Both give the same list in the same order.
"""

import llvmlite.binding as llvm
from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16

#: Numba is told to interpret: the vector code becomes a plain loop.
INTERPRETED = bool(config.DISABLE_JIT)

FLOATS = ir.VectorType(ir.FloatType(), LANES)
INTS = ir.VectorType(ir.IntType(32), LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)
_HALF = ir.VectorType(ir.IntType(32), LANES // 2)
_BYTES = ir.IntType(8).as_pointer()

HAS_COMPRESSING_STORE = bool(llvm.get_host_cpu_features().get("avx512f", False))

#: Whether sixteen values can be read from sixteen places by one instruction.
HAS_GATHER = HAS_COMPRESSING_STORE and not INTERPRETED

#: The same freedom as all other code has: see `core.jit`.
FAST = ("reassoc", "contract", "nsz")


def splat(builder, value, vector_type=FLOATS):
    """A vector with `value` in every lane."""
    empty = ir.Constant(vector_type, ir.Undefined)
    first = builder.insert_element(empty, value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(INTS, [0] * LANES)
    return builder.shuffle_vector(first, empty, zeros)


def constant(value, vector_type=FLOATS):
    """A vector with the number `value` in every lane."""
    return ir.Constant(vector_type, [value] * vector_type.count)


def data_pointer(context, builder, array_type, array, row=None):
    """Address of the first element of a C-contiguous array, or of a row of one with two axes."""
    view = context.make_array(array_type)(context, builder, array)
    if row is None:
        return view.data
    length = cgutils.unpack_tuple(builder, view.shape, array_type.ndim)[-1]
    return builder.gep(view.data, [builder.mul(length, ir.Constant(length.type, row))])


def load(builder, pointer, index, mask=None, vector_type=FLOATS):
    """The vector that begins at pointer[index], 0 where not `mask`; all 16 elements are read."""
    place = builder.gep(pointer, [index])
    vector = builder.load(builder.bitcast(place, vector_type.as_pointer()), typ=vector_type)
    vector.align = 4
    return vector if mask is None else builder.select(mask, vector, ir.Constant(vector_type, None))


def store(builder, vector, pointer, index):
    """Write a vector to where pointer[index] is."""
    place = builder.gep(pointer, [index])
    builder.store(vector, builder.bitcast(place, vector.type.as_pointer())).align = 4


def gather(builder, pointer, indices, mask):
    """Elements pointer[indices] of 4 bytes, as floats, 0 where not `mask`; needs `HAS_GATHER`."""
    arguments = [FLOATS, _BYTES, INTS, _BITS, ir.IntType(32)]
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(FLOATS, arguments), "llvm.x86.avx512.mask.gather.dps.512"
    )
    place = builder.bitcast(pointer, _BYTES)
    size = ir.Constant(ir.IntType(32), 4)
    return builder.call(function, [constant(0.0), place, indices, mask, size])


def gather_words(builder, pointer, indices, mask):
    """Elements pointer[indices] of 8 bytes as two vectors, lower and upper half of each."""
    words, bits = (ir.VectorType(ir.IntType(size), LANES // 2) for size in (64, 1))
    arguments = [words, _BYTES, _HALF, bits, ir.IntType(32)]
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(words, arguments), "llvm.x86.avx512.mask.gather.dpq.512"
    )
    place = builder.bitcast(pointer, _BYTES)
    size = ir.Constant(ir.IntType(32), 8)
    pieces = []
    for first in (0, LANES // 2):
        lanes = ir.Constant(_HALF, list(range(first, first + LANES // 2)))
        half = builder.shuffle_vector(indices, ir.Constant(INTS, ir.Undefined), lanes)
        allowed = builder.shuffle_vector(mask, ir.Constant(_BITS, ir.Undefined), lanes)
        found = builder.call(function, [constant(0, words), place, half, allowed, size])
        pieces.append(builder.bitcast(found, INTS))
    return [
        builder.shuffle_vector(*pieces, ir.Constant(INTS, list(range(which, 2 * LANES, 2))))
        for which in (0, 1)
    ]


def multiply_add(builder, a, b, c):
    """A b + c, fused where the processor can."""
    return builder.fadd(builder.fmul(a, b, flags=FAST), c, flags=FAST)


def square_root(builder, vector):
    """Square roots of a vector of floats."""
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(FLOATS, [FLOATS]), f"llvm.sqrt.v{LANES}f32"
    )
    return builder.call(function, [vector])


def positive(builder, vector, mask):
    """The floats of a vector, 0 instead of those that are less and of those not in `mask`."""
    zero = constant(0.0)
    kept = builder.and_(mask, builder.fcmp_ordered(">", vector, zero))
    return builder.select(kept, vector, zero)


def lane_sum(builder, vector):
    """Sum over the lanes of a vector of floats."""
    function = cgutils.get_or_insert_function(
        builder.module,
        ir.FunctionType(ir.FloatType(), [ir.FloatType(), FLOATS]),
        f"llvm.vector.reduce.fadd.v{LANES}f32",
    )
    return builder.call(function, [ir.Constant(ir.FloatType(), -0.0), vector], fastmath=FAST)


def vector_loop(builder, start, end, count, body):
    """A loop over start, start + LANES, ... < end that sums `count` vectors.

    Args:
        start, end: indices.
        count: of sums.
        body: called with the index, the lanes that are before the end, and the sums so far; returns
            the new sums.

    Returns:
        The sums, vectors of floats.
    """
    entry = builder.block
    head = builder.append_basic_block("loop")
    done = builder.append_basic_block("loop.done")
    builder.cbranch(builder.icmp_signed("<", start, end), head, done)
    builder.position_at_end(head)
    index = builder.phi(start.type)
    index.add_incoming(start, entry)
    sums = [builder.phi(FLOATS) for _ in range(count)]
    for value in sums:
        value.add_incoming(constant(0.0), entry)
    rest = builder.trunc(builder.sub(end, index), ir.IntType(32))
    mask = builder.icmp_signed(
        "<", ir.Constant(INTS, list(range(LANES))), splat(builder, rest, INTS)
    )
    new = body(index, mask, sums)
    following = builder.add(index, ir.Constant(index.type, LANES))
    last = builder.block
    index.add_incoming(following, last)
    for value, changed in zip(sums, new, strict=True):
        value.add_incoming(changed, last)
    builder.cbranch(builder.icmp_signed("<", following, end), head, done)
    builder.position_at_end(done)
    results = []
    for changed in new:
        result = builder.phi(FLOATS)
        result.add_incoming(constant(0.0), entry)
        result.add_incoming(changed, last)
        results.append(result)
    return results


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
            values = load(builder, data_pointer(context, builder, array_type, array), begin_)
            offset = builder.fsub(splat(builder, centre), values)
            term = builder.fmul(offset, offset, flags=("contract",))
            total = term if total is None else builder.fadd(total, term, flags=("contract",))
        near = builder.fcmp_ordered("<", total, splat(builder, square_))
        lanes = ir.Constant(INTS, list(range(LANES)))
        room = builder.trunc(builder.sub(end_, begin_), ir.IntType(32))
        mask = builder.and_(near, builder.icmp_signed("<", lanes, splat(builder, room, INTS)))
        bits = builder.zext(builder.bitcast(mask, ir.IntType(LANES)), ir.IntType(32))
        first = builder.trunc(begin_, ir.IntType(32))
        target_data = data_pointer(context, builder, sig.args[9], target_)
        target_pointer = builder.gep(target_data, [cursor_])
        if HAS_COMPRESSING_STORE:
            indices = builder.add(lanes, splat(builder, first, INTS))
            # In a register and then stored whole: the instruction that stores only the hits is
            # several times slower.
            compress = cgutils.get_or_insert_function(
                builder.module,
                ir.FunctionType(INTS, [INTS, INTS, _BITS]),
                f"llvm.x86.avx512.mask.compress.v{LANES}i32",
            )
            hits = builder.call(compress, [indices, constant(0, INTS), mask])
            store(builder, hits, target_pointer, ir.Constant(cursor_.type, 0))
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
