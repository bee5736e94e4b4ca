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

HAS_COMPRESSING_STORE = bool(llvm.get_host_cpu_features().get("avx512f", False))

#: Whether several values can be read from as many places by one instruction.
HAS_GATHER = (
    HAS_COMPRESSING_STORE
    and bool(llvm.get_host_cpu_features().get("avx512vl", False))
    and not INTERPRETED
)

#: The same freedom as all other code has: see `core.jit`.
FAST = ("reassoc", "contract", "nsz")

_INT32, _FLOAT = ir.IntType(32), ir.FloatType()
_BYTES = ir.IntType(8).as_pointer()


class Vectors:
    """Makes instructions on vectors of some width; gathering needs `HAS_GATHER`.

    Args:
        builder: of the function.
        lanes: 8 or 16.

    Attributes:
        floats, ints: types of the vectors.
    """

    def __init__(self, builder, lanes):
        self._builder, self.lanes = builder, lanes
        self.floats, self.ints = (ir.VectorType(kind, lanes) for kind in (_FLOAT, _INT32))

    def constant(self, value, integer=False):
        """A vector with the number `value` in every lane."""
        return ir.Constant(self.ints if integer else self.floats, [value] * self.lanes)

    def splat(self, value):
        """A vector with `value` in every lane."""
        vector_type = ir.VectorType(value.type, self.lanes)
        empty = ir.Constant(vector_type, ir.Undefined)
        first = self._builder.insert_element(empty, value, ir.Constant(_INT32, 0))
        return self._builder.shuffle_vector(first, empty, self.constant(0, integer=True))

    def load(self, pointer, index, integer=False):
        """The vector that begins at pointer[index]."""
        kind = self.ints if integer else self.floats
        place = self._builder.gep(pointer, [index])
        vector = self._builder.load(self._builder.bitcast(place, kind.as_pointer()), typ=kind)
        vector.align = 4
        return vector

    def store(self, vector, pointer, index):
        """Write a vector to where pointer[index] is."""
        place = self._builder.gep(pointer, [index])
        self._builder.store(
            vector, self._builder.bitcast(place, vector.type.as_pointer())
        ).align = 4

    def gather(self, pointer, indices):
        """Elements pointer[indices] of 4 bytes, as floats."""
        name = {8: "avx512.mask.gather3siv8.sf", 16: "avx512.mask.gather.dps.512"}[self.lanes]
        return self._gather(name, self.floats, pointer, indices, 4)

    def gather_words(self, pointer, indices):
        """Elements pointer[indices] of 8 bytes as two vectors, lower and upper half of each."""
        words, builder = ir.VectorType(ir.IntType(64), 8), self._builder
        pair = ir.VectorType(_INT32, 16)
        pieces = []
        for first in range(0, self.lanes, 8):
            lanes = ir.Constant(ir.VectorType(_INT32, 8), list(range(first, first + 8)))
            part = builder.shuffle_vector(indices, ir.Constant(self.ints, ir.Undefined), lanes)
            found = self._gather("avx512.mask.gather.dpq.512", words, pointer, part, 8)
            pieces.append(builder.bitcast(found, pair))
        pieces.append(ir.Constant(pair, ir.Undefined))
        return [
            builder.shuffle_vector(
                *pieces[:2], ir.Constant(self.ints, list(range(which, 2 * self.lanes, 2)))
            )
            for which in (0, 1)
        ]

    def _gather(self, name, kind, pointer, indices, size):
        bits = ir.VectorType(ir.IntType(1), kind.count)
        arguments = [kind, _BYTES, indices.type, bits, _INT32]
        function = cgutils.get_or_insert_function(
            self._builder.module, ir.FunctionType(kind, arguments), f"llvm.x86.{name}"
        )
        nothing, everything = ir.Constant(kind, None), ir.Constant(bits, [1] * kind.count)
        place = self._builder.bitcast(pointer, _BYTES)
        return self._builder.call(
            function, [nothing, place, indices, everything, ir.Constant(_INT32, size)]
        )

    def multiply_add(self, a, b, c):
        """A b + c, fused where the processor can."""
        return self._builder.fadd(self._builder.fmul(a, b, flags=FAST), c, flags=FAST)

    def square_root(self, vector):
        """Square roots of a vector of floats."""
        function = cgutils.get_or_insert_function(
            self._builder.module,
            ir.FunctionType(self.floats, [self.floats]),
            f"llvm.sqrt.v{self.lanes}f32",
        )
        return self._builder.call(function, [vector])

    def positive(self, vector):
        """The floats of a vector, 0 instead of those that are less."""
        zero = self.constant(0.0)
        above = self._builder.fcmp_ordered(">", vector, zero)
        return self._builder.select(above, vector, zero)

    def sum(self, vector):
        """Sum over the lanes of a vector of floats."""
        function = cgutils.get_or_insert_function(
            self._builder.module,
            ir.FunctionType(_FLOAT, [_FLOAT, self.floats]),
            f"llvm.vector.reduce.fadd.v{self.lanes}f32",
        )
        return self._builder.call(function, [ir.Constant(_FLOAT, -0.0), vector], fastmath=FAST)


def data_pointer(context, builder, array_type, array, row=None):
    """Address of the first element of a C-contiguous array, or of a row of one with two axes."""
    view = context.make_array(array_type)(context, builder, array)
    if row is None:
        return view.data
    length = cgutils.unpack_tuple(builder, view.shape, array_type.ndim)[-1]
    return builder.gep(view.data, [builder.mul(length, ir.Constant(length.type, row))])


def sums_in_vectors(builder, start, end, count, body):
    """Sums of `count` terms over start, start + 1, ... end - 1, a multiple of 8 indices.

    Sixteen are taken at a time, and eight at the end where so many are left.

    Args:
        builder: of the function.
        start, end: indices.
        count: of sums.
        body: called with Vectors, an index, and the vectors of sums so far; returns the new ones.

    Returns:
        The sums, floats.
    """
    wide, narrow = Vectors(builder, 16), Vectors(builder, 8)
    entry = builder.block
    head, between, tail, done = (
        builder.append_basic_block(f"sums.{name}") for name in ("head", "between", "tail", "done")
    )
    step = ir.Constant(start.type, 16)
    whole = builder.add(start, builder.and_(builder.sub(end, start), ir.Constant(start.type, -16)))
    builder.cbranch(builder.icmp_signed("<", start, whole), head, between)

    builder.position_at_end(head)
    index = builder.phi(start.type)
    index.add_incoming(start, entry)
    sums = [builder.phi(wide.floats) for _ in range(count)]
    for value in sums:
        value.add_incoming(wide.constant(0.0), entry)
    new = body(wide, index, sums)
    following, last = builder.add(index, step), builder.block
    index.add_incoming(following, last)
    for value, changed in zip(sums, new, strict=True):
        value.add_incoming(changed, last)
    builder.cbranch(builder.icmp_signed("<", following, whole), head, between)

    builder.position_at_end(between)
    halves = []
    for changed in new:
        so_far = builder.phi(wide.floats)
        so_far.add_incoming(wide.constant(0.0), entry)
        so_far.add_incoming(changed, last)
        halves.append(so_far)
    parts = [ir.Constant(narrow.ints, list(range(first, first + 8))) for first in (0, 8)]
    halves = [
        builder.fadd(*(builder.shuffle_vector(value, value, part) for part in parts), flags=FAST)
        for value in halves
    ]
    builder.cbranch(builder.icmp_signed("<", whole, end), tail, done)

    builder.position_at_end(tail)
    new = body(narrow, whole, halves)
    last = builder.block
    builder.branch(done)

    builder.position_at_end(done)
    results = []
    for before, after in zip(halves, new, strict=True):
        result = builder.phi(narrow.floats)
        result.add_incoming(before, between)
        result.add_incoming(after, last)
        results.append(result)
    return [narrow.sum(result) for result in results]


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
        vectors, total = Vectors(builder, LANES), None
        for array_type, array, centre in zip(
            sig.args[:3], (xs_, ys_, zs_), (x_, y_, z_), strict=True
        ):
            values = vectors.load(data_pointer(context, builder, array_type, array), begin_)
            offset = builder.fsub(vectors.splat(centre), values)
            term = builder.fmul(offset, offset, flags=("contract",))
            total = term if total is None else builder.fadd(total, term, flags=("contract",))
        near = builder.fcmp_ordered("<", total, vectors.splat(square_))
        lanes = ir.Constant(vectors.ints, list(range(LANES)))
        room = builder.trunc(builder.sub(end_, begin_), ir.IntType(32))
        mask = builder.and_(near, builder.icmp_signed("<", lanes, vectors.splat(room)))
        bits = builder.zext(builder.bitcast(mask, ir.IntType(LANES)), ir.IntType(32))
        first = builder.trunc(begin_, ir.IntType(32))
        target_data = data_pointer(context, builder, sig.args[9], target_)
        target_pointer = builder.gep(target_data, [cursor_])
        if HAS_COMPRESSING_STORE:
            indices = builder.add(lanes, vectors.splat(first))
            # In a register and then stored whole: the instruction that stores only the hits is
            # several times slower.
            compress = cgutils.get_or_insert_function(
                builder.module,
                ir.FunctionType(vectors.ints, [vectors.ints, vectors.ints, near.type]),
                f"llvm.x86.avx512.mask.compress.v{LANES}i32",
            )
            hits = builder.call(compress, [indices, vectors.constant(0, integer=True), mask])
            vectors.store(hits, target_pointer, ir.Constant(cursor_.type, 0))
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
