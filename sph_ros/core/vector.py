# SPDX-License-Identifier: Apache-2.0
"""Vectors of sixteen numbers as values in compiled functions.

What is summed over neighbours is summed for sixteen particles at once, one in each lane. LLVM does
not find such code by itself, so it is written down: numbers of type `Floats` and `Whole` add and
multiply like any others, and `load`, `gather`, `store` move them. On processors without AVX-512
LLVM makes several narrower instructions of each. Interpreted, vectors are numpy arrays.

`append_within` appends the indices of near points. The search for neighbours compares some 200
candidates for 30 hits; as a scalar loop that costs more than everything else in a step. Sixteen
candidates are compared at once here, and the hits are stored one after the other: by one
compressing store where the processor has it (AVX-512), else by walking the set bits of the
comparison's mask. Both give the same list in the same order.
"""

import operator

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16

#: Numba is told to interpret.
INTERPRETED = bool(config.DISABLE_JIT)

HAS_COMPRESSING_STORE = bool(llvm.get_host_cpu_features().get("avx512f", False))

#: Whether sixteen values can be read from as many places by one instruction.
HAS_GATHER = HAS_COMPRESSING_STORE

#: The same freedom as all other code has: see `core.jit`.
FAST = ("reassoc", "contract", "nsz")

_INT16, _INT32, _INT64, _FLOAT = ir.IntType(16), ir.IntType(32), ir.IntType(64), ir.FloatType()
_FLOATS, _WHOLE = ir.VectorType(_FLOAT, LANES), ir.VectorType(_INT32, LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)


# ---------------------------------------------------------------- types and their arithmetic


class Floats(types.Type):
    """Sixteen float32."""

    def __init__(self):
        """There is one such type."""
        super().__init__(name="Floats")


class Whole(types.Type):
    """Sixteen int32."""

    def __init__(self):
        """There is one such type."""
        super().__init__(name="Whole")


class Truths(types.Type):
    """Sixteen answers to a comparison."""

    def __init__(self):
        """There is one such type."""
        super().__init__(name="Truths")


floats, whole, truths = Floats(), Whole(), Truths()


def _register(kind, backing):
    @register_model(kind)
    class Model(models.PrimitiveModel):
        def __init__(self, manager, numba_type):
            super().__init__(manager, numba_type, backing)


for _kind, _backing in ((Floats, _FLOATS), (Whole, _WHOLE), (Truths, _BITS)):
    _register(_kind, _backing)


def _constant(value, kind=_FLOATS):
    return ir.Constant(kind, [value] * LANES)


def _splat(builder, value):
    """A vector with a number in every lane; vectors stay what they are."""
    if isinstance(value.type, ir.VectorType):
        return value
    vector = ir.VectorType(value.type, LANES)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(first, first, _constant(0, _WHOLE))


def _define(function, kinds, result, make):
    """Let `function` of values of numba types `kinds` be what `make(builder, *vectors)` returns."""

    @lower_builtin(function, *kinds)
    def lower(context, builder, sig, args):
        values = [
            context.cast(builder, value, given, types.int32)
            if isinstance(given, types.Integer)
            else value
            for given, value in zip(sig.args, args, strict=True)
        ]
        return make(builder, *(_splat(builder, value) for value in values))

    return signature(result, *kinds)


def _register_operator(function, pairs, result, make):
    cases_ = [_define(function, kinds, result, make) for kinds in pairs]

    @infer_global(function)
    class Operator(ConcreteTemplate):
        cases = cases_


_WITH_FLOATS = [(floats, floats), (floats, types.float32), (types.float32, floats)]
_WITH_WHOLE = [(whole, whole), (whole, types.int64)]

for _function, _name in (
    (operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"),
    (operator.iadd, "fadd"), (operator.isub, "fsub"), (operator.imul, "fmul"),
):  # fmt: skip
    _register_operator(
        _function, _WITH_FLOATS, floats,
        lambda builder, a, b, name=_name: getattr(builder, name)(a, b, flags=FAST),
    )  # fmt: skip
_register_operator(operator.truediv, _WITH_FLOATS, floats, lambda builder, a, b: builder.fdiv(a, b))
for _function, _name in (
    (operator.add, "add"), (operator.sub, "sub"), (operator.mul, "mul"), (operator.and_, "and_"),
    (operator.or_, "or_"), (operator.lshift, "shl"), (operator.rshift, "ashr"),
):  # fmt: skip
    _register_operator(
        _function, _WITH_WHOLE, whole,
        lambda builder, a, b, name=_name: getattr(builder, name)(a, b),
    )  # fmt: skip
for _function, _sign in ((operator.lt, "<"), (operator.gt, ">")):
    _register_operator(
        _function, _WITH_FLOATS, truths,
        lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b),
    )  # fmt: skip
    _register_operator(
        _function, _WITH_WHOLE, truths,
        lambda builder, a, b, sign=_sign: builder.icmp_signed(sign, a, b),
    )  # fmt: skip
for _function, _name in ((operator.or_, "or_"), (operator.and_, "and_")):
    _register_operator(
        _function, [(truths, truths)], truths,
        lambda builder, a, b, name=_name: getattr(builder, name)(a, b),
    )  # fmt: skip


def _operation(kinds, result, make, plainly):
    """A function of vectors; see `_define`. Interpreted it is `plainly`."""
    if INTERPRETED:
        return plainly

    @intrinsic
    def one(typingctx, a):
        return signature(result, *kinds), generate

    @intrinsic
    def two(typingctx, a, b):
        return signature(result, *kinds), generate

    @intrinsic
    def three(typingctx, a, b, c):
        return signature(result, *kinds), generate

    def generate(context, builder, sig, args):
        return make(builder, *(_splat(builder, value) for value in args))

    return (one, two, three)[len(kinds) - 1]


def _call(builder, name, result, *args):
    """Call an intrinsic function of LLVM."""
    kinds = [value.type for value in args]
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(result, kinds), f"llvm.{name}"
    )
    return builder.call(function, args)


#: A vector with one float32 in every lane.
spread = _operation(
    (types.float32,), floats, lambda builder, a: a, lambda a: np.full(LANES, a, np.float32)
)
#: The larger one of two, lane by lane, and the smaller one. If the first is no number, that stays.
larger = _operation(
    (floats, floats),
    floats,
    lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), b, a),
    lambda a, b: np.where(a < b, b, a).astype(np.float32),
)
smaller = _operation(
    (floats, floats),
    floats,
    lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), b, a),
    lambda a, b: np.where(a > b, b, a).astype(np.float32),
)
#: Of two vectors the first one's lanes where something is true, else the second one's.
where = _operation(
    (truths, floats, floats),
    floats,
    lambda builder, which, a, b: builder.select(which, a, b),
    lambda which, a, b: np.where(which, a, b).astype(np.float32),
)
where_whole = _operation(
    (truths, whole, whole),
    whole,
    lambda builder, which, a, b: builder.select(which, a, b),
    np.where,
)
#: Square roots.
root = _operation(
    (floats,), floats, lambda builder, a: _call(builder, "sqrt.v16f32", _FLOATS, a), np.sqrt
)


def _inverse_root(builder, a):
    if not HAS_COMPRESSING_STORE:
        return builder.fdiv(_constant(1.0), _call(builder, "sqrt.v16f32", _FLOATS, a))
    # Right to 14 bits, and after a step of Newton's to all but the last one or two.
    kinds = [_FLOATS, _FLOATS, ir.IntType(16)]
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(_FLOATS, kinds), "llvm.x86.avx512.rsqrt14.ps.512"
    )
    everything = ir.Constant(kinds[2], 0xFFFF)
    near = builder.call(function, [a, ir.Constant(_FLOATS, None), everything])
    half = builder.fmul(builder.fmul(a, near, flags=FAST), _constant(0.5), flags=FAST)
    left = builder.fsub(_constant(1.5), builder.fmul(half, near, flags=FAST), flags=FAST)
    return builder.fmul(near, left, flags=FAST)


#: One over the square root, for positive numbers.
inverse_root = _operation(
    (floats,), floats, _inverse_root, lambda a: (np.float32(1.0) / np.sqrt(a)).astype(np.float32)
)
magnitude = _operation(
    (floats,), floats, lambda builder, a: _call(builder, "fabs.v16f32", _FLOATS, a), np.abs
)
#: Whole numbers as floats; floats rounded to the nearest whole number, to the even one of two.
as_floats = _operation(
    (whole,),
    floats,
    lambda builder, a: builder.sitofp(a, _FLOATS),
    lambda a: a.astype(np.float32),
)
rounded = _operation(
    (floats,),
    whole,
    lambda builder, a: builder.fptosi(_call(builder, "rint.v16f32", _FLOATS, a), _WHOLE),
    lambda a: np.rint(a).astype(np.int32),
)


def _sum(builder, vector):
    """Lanes added in a tree, always the same one."""
    count = LANES
    while count > 1:
        count //= 2
        halves = [
            builder.shuffle_vector(
                vector,
                vector,
                ir.Constant(ir.VectorType(_INT32, count), list(range(low, low + count))),
            )
            for low in (0, count)
        ]
        vector = builder.fadd(*halves, flags=FAST)
    return builder.extract_element(vector, ir.Constant(_INT32, 0))


#: Sum over the lanes.
total = _operation((floats,), types.float32, _sum, lambda a: a.sum(dtype=np.float32))


# ---------------------------------------------------------------- memory


def data_pointer(context, builder, array_type, array):
    """Address of the first element of a C-contiguous array."""
    return context.make_array(array_type)(context, builder, array).data


def _shape(context, builder, array_type, array, axis):
    view = context.make_array(array_type)(context, builder, array)
    return cgutils.unpack_tuple(builder, view.shape, array_type.ndim)[axis]


def _lane(builder, vector, lane):
    return builder.extract_element(vector, ir.Constant(_INT32, lane))


def _gather(builder, pointer, indices):
    """Elements of 4 bytes, floats or integers, as a vector; indices are read as signed."""
    element = pointer.type.pointee if hasattr(pointer.type, "pointee") else _FLOAT
    vector = ir.VectorType(element, LANES)
    if HAS_GATHER:
        kinds = [_FLOATS, ir.IntType(8).as_pointer(), _WHOLE, _BITS, _INT32]
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_FLOATS, kinds), "llvm.x86.avx512.mask.gather.dps.512"
        )
        place = builder.bitcast(pointer, kinds[1])
        everything = ir.Constant(_BITS, [1] * LANES)
        found = builder.call(
            function,
            [ir.Constant(_FLOATS, None), place, indices, everything, ir.Constant(_INT32, 4)],
        )
        return builder.bitcast(found, vector)
    found = ir.Constant(vector, ir.Undefined)
    for lane in range(LANES):
        index = builder.sext(_lane(builder, indices, lane), _INT64)
        found = builder.insert_element(
            found, builder.load(builder.gep(pointer, [index])), ir.Constant(_INT32, lane)
        )
    return found


def _load(builder, pointer, index, count=LANES):
    """A vector of what begins at pointer[index]."""
    kind = ir.VectorType(pointer.type.pointee, count)
    place = builder.bitcast(builder.gep(pointer, [index]), kind.as_pointer())
    vector = builder.load(place)
    vector.align = pointer.type.pointee.width // 8 if kind.element != _FLOAT else 4
    return vector


def _store(builder, vector, pointer, index):
    place = builder.bitcast(builder.gep(pointer, [index]), vector.type.as_pointer())
    builder.store(vector, place).align = 2 if vector.type.element == _INT16 else 4


@intrinsic
def _load_compiled(typingctx, array, index):
    result = whole if array.dtype in (types.int32, types.uint32) else floats

    def generate(context, builder, sig, args):
        vector = _load(builder, data_pointer(context, builder, sig.args[0], args[0]), args[1])
        if sig.args[0].dtype == types.int16:
            return builder.sitofp(builder.sext(vector, _WHOLE), _FLOATS)
        return vector

    return signature(result, array, types.intp), generate


def _load_plainly(array, index):
    values = array[index : index + LANES]
    return values.astype(
        np.int32 if array.dtype.kind in "iu" and array.itemsize == 4 else np.float32
    )


@intrinsic
def _store_compiled(typingctx, vector, array, index):
    def generate(context, builder, sig, args):
        value = args[0]
        if sig.args[1].dtype == types.int16:
            value = _call(builder, "rint.v16f32", _FLOATS, value)
            value = builder.trunc(builder.fptosi(value, _WHOLE), ir.VectorType(_INT16, LANES))
        _store(builder, value, data_pointer(context, builder, sig.args[1], args[1]), args[2])
        return context.get_dummy_value()

    return signature(types.void, vector, array, types.intp), generate


def _store_plainly(vector, array, index):
    array[index : index + LANES] = np.rint(vector) if array.dtype == np.int16 else vector


@intrinsic
def _gather_compiled(typingctx, array, indices):
    def generate(context, builder, sig, args):
        return _gather(builder, data_pointer(context, builder, sig.args[0], args[0]), args[1])

    return signature(whole if array.dtype != types.float32 else floats, array, whole), generate


def _gather_plainly(array, indices):
    return array[indices] if array.dtype == np.float32 else array[indices].astype(np.int32)


@intrinsic
def _gather_words_compiled(typingctx, array, indices):
    def generate(context, builder, sig, args):
        # Each word is two elements of 4 bytes.
        place = data_pointer(context, builder, sig.args[0], args[0])
        return context.make_tuple(builder, sig.return_type, _words(builder, place, args[1]))

    return signature(types.UniTuple(whole, 2), array, whole), generate


def _words(builder, place, indices):
    if not HAS_GATHER:
        place = builder.bitcast(place, _INT32.as_pointer())
        double = builder.shl(indices, _constant(1, _WHOLE))
        return [
            _gather(builder, place, builder.or_(double, _constant(half, _WHOLE))) for half in (0, 1)
        ]
    eight, bits = ir.VectorType(_INT64, 8), ir.VectorType(ir.IntType(1), 8)
    kinds = [eight, ir.IntType(8).as_pointer(), ir.VectorType(_INT32, 8), bits, _INT32]
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(eight, kinds), "llvm.x86.avx512.mask.gather.dpq.512"
    )
    place, pieces = builder.bitcast(place, kinds[1]), []
    for first in (0, 8):
        lanes = ir.Constant(kinds[2], list(range(first, first + 8)))
        part = builder.shuffle_vector(indices, indices, lanes)
        arguments = [ir.Constant(eight, None), place, part, ir.Constant(bits, [1] * 8)]
        found = builder.call(function, [*arguments, ir.Constant(_INT32, 8)])
        pieces.append(builder.bitcast(found, _WHOLE))
    return [
        builder.shuffle_vector(*pieces, ir.Constant(_WHOLE, list(range(half, 2 * LANES, 2))))
        for half in (0, 1)
    ]


def _gather_words_plainly(array, indices):
    halves = np.ascontiguousarray(array[indices]).view(np.int32).reshape(-1, 2)
    return halves[:, 0], halves[:, 1]


@intrinsic
def _lanes_compiled(typingctx, first, count):
    def generate(context, builder, sig, args):
        start, last = (builder.trunc(value, _INT32) for value in args)
        last = _splat(builder, builder.sub(last, ir.Constant(_INT32, 1)))
        indices = builder.add(_splat(builder, start), ir.Constant(_WHOLE, list(range(LANES))))
        return builder.select(builder.icmp_signed("<", indices, last), indices, last)

    return signature(whole, types.intp, types.intp), generate


def _lanes_plainly(first, count):
    return np.minimum(np.arange(first, first + LANES), count - 1).astype(np.int32)


@intrinsic
def _take_compiled(typingctx, array, row):
    def generate(context, builder, sig, args):
        array_, row_ = args
        place = data_pointer(context, builder, sig.args[0], array_)
        count = _shape(context, builder, sig.args[0], array_, 0)
        whole_ = ir.VectorType(place.type.pointee, LANES)
        result = cgutils.alloca_once(builder, whole_)
        fits = builder.icmp_signed("<=", builder.add(row_, ir.Constant(row_.type, LANES)), count)
        with builder.if_else(fits, likely=True) as (all_rows, some):
            with all_rows:
                builder.store(_load(builder, place, row_), result)
            with some:
                last = builder.trunc(builder.sub(count, ir.Constant(count.type, 1)), _INT32)
                first = _splat(builder, builder.trunc(row_, _INT32))
                indices = builder.add(first, ir.Constant(_WHOLE, list(range(LANES))))
                inside = builder.icmp_signed("<", indices, _splat(builder, last))
                indices = builder.select(inside, indices, _splat(builder, last))
                builder.store(_gather(builder, place, indices), result)
        return builder.load(result)

    result = floats if array.dtype == types.float32 else whole
    return signature(result, array, types.intp), generate


def _take_plainly(array, row):
    return _gather_plainly(array, _lanes_plainly(row, len(array)))


def _interleaved(builder, columns):
    """Vectors that hold the lanes of the given ones in turn: a0 b0 c0 a1 b1 c1 ..."""
    width = len(columns)
    for piece in range(width):
        places = [divmod(LANES * piece + lane, width) for lane in range(LANES)]
        vector = columns[0]
        # Lane by lane from the vector made so far, or from the next column.
        for number, column in enumerate(columns):
            take = [
                (LANES + row) if which == number else lane
                for lane, (row, which) in enumerate(places)
            ]
            vector = builder.shuffle_vector(vector, column, ir.Constant(_WHOLE, take))
        yield vector


@intrinsic
def _put_compiled(typingctx, vectors, array, row):
    width = len(vectors) if isinstance(vectors, types.BaseTuple) else 1

    def generate(context, builder, sig, args):
        vectors_, array_, row_ = args
        columns = cgutils.unpack_tuple(builder, vectors_) if width > 1 else [vectors_]
        place = data_pointer(context, builder, sig.args[1], array_)
        place = builder.bitcast(place, columns[0].type.element.as_pointer())
        count = _shape(context, builder, sig.args[1], array_, 0)
        begin = builder.mul(row_, ir.Constant(row_.type, width))
        fits = builder.icmp_signed("<=", builder.add(row_, ir.Constant(row_.type, LANES)), count)
        with builder.if_else(fits, likely=True) as (all_rows, some):
            with all_rows:
                for piece, vector in enumerate(_interleaved(builder, columns)):
                    offset = ir.Constant(row_.type, LANES * piece)
                    _store(builder, vector, place, builder.add(begin, offset))
            with some:
                left = builder.sub(count, row_)
                for lane in range(LANES):
                    inside = builder.icmp_signed("<", ir.Constant(row_.type, lane), left)
                    with builder.if_then(inside):
                        for which, column in enumerate(columns):
                            offset = ir.Constant(row_.type, width * lane + which)
                            target = builder.gep(place, [builder.add(begin, offset)])
                            builder.store(_lane(builder, column, lane), target)
        return context.get_dummy_value()

    return signature(types.void, vectors, array, types.intp), generate


def _put_plainly(vectors, array, row):
    count = min(LANES, len(array) - row)
    if array.dtype == np.int64:
        low, high = (vector[:count].astype(np.int64) for vector in vectors)
        array[row : row + count] = (high << 32) | (low & 0xFFFFFFFF)
    elif array.ndim == 1:
        array[row : row + count] = vectors[:count]
    else:
        array[row : row + count] = np.stack(vectors, axis=1)[:count]


#: load(array, index): the sixteen elements from an index on. Those of int16 arrays become floats.
load = _load_plainly if INTERPRETED else _load_compiled
#: store(vector, array, index): the inverse; rounds for an int16 array.
store = _store_plainly if INTERPRETED else _store_compiled
#: gather(array, indices): elements of a contiguous array, from any places; float32, int32, uint32.
gather = _gather_plainly if INTERPRETED else _gather_compiled
#: gather_words(array, indices): elements of an int64 array as two vectors, lower and upper halves.
gather_words = _gather_words_plainly if INTERPRETED else _gather_words_compiled
#: lanes_from(first, count): first, first + 1, ..., but at most count - 1.
lanes_from = _lanes_plainly if INTERPRETED else _lanes_compiled
#: take(array, row): the elements of a (N,) array from a row on; beyond the last one that again.
take = _take_plainly if INTERPRETED else _take_compiled
#: put(vectors, array, row): write a vector to the rows from `row` on of a (N,) array; of (x, y, z)
#: to an (N, 3) array; (low, high) to an (N,) int64 array. Only rows that there are.
put = _put_plainly if INTERPRETED else _put_compiled


def _gather_column_plainly(array, indices, column):
    return array[indices, column]


@intrinsic
def _gather_column_compiled(typingctx, array, indices, column):
    def generate(context, builder, sig, args):
        array_, indices_, column_ = args
        width = builder.trunc(_shape(context, builder, sig.args[0], array_, 1), _INT32)
        place = builder.gep(data_pointer(context, builder, sig.args[0], array_), [column_])
        return _gather(builder, place, builder.mul(indices_, _splat(builder, width)))

    return signature(floats, array, whole, types.intp), generate


#: gather_column(array, indices, column): elements [indices, column] of an (N, K) float32 array.
gather_column = _gather_column_plainly if INTERPRETED else _gather_column_compiled


# ---------------------------------------------------------------- near points


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
        distance = None
        for array_type, array, centre in zip(
            sig.args[:3], (xs_, ys_, zs_), (x_, y_, z_), strict=True
        ):
            values = _load(builder, data_pointer(context, builder, array_type, array), begin_)
            offset = builder.fsub(_splat(builder, centre), values)
            term = builder.fmul(offset, offset, flags=("contract",))
            distance = (
                term if distance is None else builder.fadd(distance, term, flags=("contract",))
            )
        near = builder.fcmp_ordered("<", distance, _splat(builder, square_))
        lanes = ir.Constant(_WHOLE, list(range(LANES)))
        room = builder.trunc(builder.sub(end_, begin_), _INT32)
        mask = builder.and_(near, builder.icmp_signed("<", lanes, _splat(builder, room)))
        bits = builder.zext(builder.bitcast(mask, ir.IntType(LANES)), _INT32)
        first = builder.trunc(begin_, _INT32)
        target_data = data_pointer(context, builder, sig.args[9], target_)
        target_pointer = builder.gep(target_data, [cursor_])
        if HAS_COMPRESSING_STORE:
            indices = builder.add(lanes, _splat(builder, first))
            # In a register and then stored whole: the instruction that stores only the hits is
            # several times slower.
            compress = cgutils.get_or_insert_function(
                builder.module,
                ir.FunctionType(_WHOLE, [_WHOLE, _WHOLE, near.type]),
                f"llvm.x86.avx512.mask.compress.v{LANES}i32",
            )
            hits = builder.call(compress, [indices, _constant(0, _WHOLE), mask])
            _store(builder, hits, target_pointer, ir.Constant(cursor_.type, 0))
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
