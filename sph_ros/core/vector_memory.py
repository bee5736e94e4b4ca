# SPDX-License-Identifier: Apache-2.0
"""Vectors read from arrays and written to them: side by side, or from sixteen places.

Arrays of particles have any number of rows; `take` and `put` are for the sixteen from some row on,
as far as there are so many.
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import signature
from numba.extending import intrinsic

from sph_ros.core.vector import (
    BITS,
    FLOAT,
    FLOATS,
    HAS_AVX512,
    INT16,
    INT32,
    INT64,
    INTERPRETED,
    LANES,
    WHOLE,
    call_llvm,
    constant,
    floats,
    splat,
    whole,
)


def data_pointer(context, builder, array_type, array):
    """Address of the first element of a C-contiguous array."""
    return context.make_array(array_type)(context, builder, array).data


def _shape(context, builder, array_type, array, axis):
    view = context.make_array(array_type)(context, builder, array)
    return cgutils.unpack_tuple(builder, view.shape, array_type.ndim)[axis]


def _lane(builder, vector, lane):
    return builder.extract_element(vector, ir.Constant(INT32, lane))


def gather_vector(builder, pointer, indices):
    """Elements of 4 bytes, floats or integers, as a vector; indices are read as signed."""
    element = pointer.type.pointee if hasattr(pointer.type, "pointee") else FLOAT
    vector = ir.VectorType(element, LANES)
    if HAS_AVX512:
        kinds = [FLOATS, ir.IntType(8).as_pointer(), WHOLE, BITS, INT32]
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(FLOATS, kinds), "llvm.x86.avx512.mask.gather.dps.512"
        )
        place = builder.bitcast(pointer, kinds[1])
        everything = ir.Constant(BITS, [1] * LANES)
        found = builder.call(
            function,
            [ir.Constant(FLOATS, None), place, indices, everything, ir.Constant(INT32, 4)],
        )
        return builder.bitcast(found, vector)
    found = ir.Constant(vector, ir.Undefined)
    for lane in range(LANES):
        index = builder.sext(_lane(builder, indices, lane), INT64)
        found = builder.insert_element(
            found, builder.load(builder.gep(pointer, [index])), ir.Constant(INT32, lane)
        )
    return found


def load_vector(builder, pointer, index, count=LANES):
    """A vector of what begins at pointer[index]."""
    kind = ir.VectorType(pointer.type.pointee, count)
    place = builder.bitcast(builder.gep(pointer, [index]), kind.as_pointer())
    vector = builder.load(place)
    vector.align = pointer.type.pointee.width // 8 if kind.element != FLOAT else 4
    return vector


def store_vector(builder, vector, pointer, index):
    """Write a vector to where pointer[index] is."""
    place = builder.bitcast(builder.gep(pointer, [index]), vector.type.as_pointer())
    builder.store(vector, place).align = 2 if vector.type.element == INT16 else 4


@intrinsic
def _load_compiled(typingctx, array, index):
    result = whole if array.dtype in (types.int32, types.uint32) else floats

    def generate(context, builder, sig, args):
        vector = load_vector(builder, data_pointer(context, builder, sig.args[0], args[0]), args[1])
        if sig.args[0].dtype == types.int16:
            return builder.sitofp(builder.sext(vector, WHOLE), FLOATS)
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
            value = call_llvm(builder, "rint.v16f32", FLOATS, value)
            value = builder.trunc(builder.fptosi(value, WHOLE), ir.VectorType(INT16, LANES))
        store_vector(builder, value, data_pointer(context, builder, sig.args[1], args[1]), args[2])
        return context.get_dummy_value()

    return signature(types.void, vector, array, types.intp), generate


def _store_plainly(vector, array, index):
    array[index : index + LANES] = np.rint(vector) if array.dtype == np.int16 else vector


@intrinsic
def _gather_compiled(typingctx, array, indices):
    def generate(context, builder, sig, args):
        return gather_vector(builder, data_pointer(context, builder, sig.args[0], args[0]), args[1])

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
    if not HAS_AVX512:
        place = builder.bitcast(place, INT32.as_pointer())
        double = builder.shl(indices, constant(1, WHOLE))
        return [
            gather_vector(builder, place, builder.or_(double, constant(half, WHOLE)))
            for half in (0, 1)
        ]
    eight, bits = ir.VectorType(INT64, 8), ir.VectorType(ir.IntType(1), 8)
    kinds = [eight, ir.IntType(8).as_pointer(), ir.VectorType(INT32, 8), bits, INT32]
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(eight, kinds), "llvm.x86.avx512.mask.gather.dpq.512"
    )
    place, pieces = builder.bitcast(place, kinds[1]), []
    for first in (0, 8):
        lanes = ir.Constant(kinds[2], list(range(first, first + 8)))
        part = builder.shuffle_vector(indices, indices, lanes)
        arguments = [ir.Constant(eight, None), place, part, ir.Constant(bits, [1] * 8)]
        found = builder.call(function, [*arguments, ir.Constant(INT32, 8)])
        pieces.append(builder.bitcast(found, WHOLE))
    return [
        builder.shuffle_vector(*pieces, ir.Constant(WHOLE, list(range(half, 2 * LANES, 2))))
        for half in (0, 1)
    ]


def _gather_words_plainly(array, indices):
    halves = np.ascontiguousarray(array[indices]).view(np.int32).reshape(-1, 2)
    return halves[:, 0], halves[:, 1]


@intrinsic
def _lanes_compiled(typingctx, first, count):
    def generate(context, builder, sig, args):
        start, last = (builder.trunc(value, INT32) for value in args)
        last = splat(builder, builder.sub(last, ir.Constant(INT32, 1)))
        indices = builder.add(splat(builder, start), ir.Constant(WHOLE, list(range(LANES))))
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
                builder.store(load_vector(builder, place, row_), result)
            with some:
                last = builder.trunc(builder.sub(count, ir.Constant(count.type, 1)), INT32)
                first = splat(builder, builder.trunc(row_, INT32))
                indices = builder.add(first, ir.Constant(WHOLE, list(range(LANES))))
                inside = builder.icmp_signed("<", indices, splat(builder, last))
                indices = builder.select(inside, indices, splat(builder, last))
                builder.store(gather_vector(builder, place, indices), result)
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
            vector = builder.shuffle_vector(vector, column, ir.Constant(WHOLE, take))
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
                    store_vector(builder, vector, place, builder.add(begin, offset))
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
        width = builder.trunc(_shape(context, builder, sig.args[0], array_, 1), INT32)
        place = builder.gep(data_pointer(context, builder, sig.args[0], array_), [column_])
        return gather_vector(builder, place, builder.mul(indices_, splat(builder, width)))

    return signature(floats, array, whole, types.intp), generate


#: gather_column(array, indices, column): elements [indices, column] of an (N, K) float32 array.
gather_column = _gather_column_plainly if INTERPRETED else _gather_column_compiled
