# SPDX-License-Identifier: Apache-2.0
"""Vectors read from arrays and written to them: side by side, or from sixteen places.

Arrays of particles have any number of rows; `take` and `put` are for the sixteen from some row on,
as far as there are so many.

Three numbers of a row are read at once (`gather_points`) and sixteen such readings transposed in
registers, which takes a third of what three gathers take. Four numbers are read for that, so
behind the last one of an array one more must be readable: see `sim.state.allocate`.
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
    GATHERS,
    INT16,
    INT32,
    INT64,
    INTERPRETED,
    LANES,
    WHOLE,
    call_llvm,
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
    if GATHERS:
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


@intrinsic
def _turn_compiled(typingctx, rows, index, target, place):
    def generate(context, builder, sig, args):
        rows_, index_, target_, place_ = args
        pointer = data_pointer(context, builder, sig.args[0], rows_)
        width = _shape(context, builder, sig.args[0], rows_, 1)
        vectors = []
        for lane in range(LANES):
            begin = builder.mul(width, ir.Constant(width.type, lane))
            vectors.append(load_vector(builder, pointer, builder.add(begin, index_)))
        # Halves, quarters, ... of pairs of vectors change places.
        half = LANES // 2
        while half:
            low = [k + LANES - half if k & half else k for k in range(LANES)]
            high = [k + LANES if k & half else k + half for k in range(LANES)]
            for k in range(LANES):
                if not k & half:
                    a, b = vectors[k], vectors[k + half]
                    vectors[k] = builder.shuffle_vector(a, b, ir.Constant(WHOLE, low))
                    vectors[k + half] = builder.shuffle_vector(a, b, ir.Constant(WHOLE, high))
            half //= 2
        pointer = data_pointer(context, builder, sig.args[2], target_)
        for k, vector in enumerate(vectors):
            offset = ir.Constant(place_.type, LANES * k)
            store_vector(builder, vector, pointer, builder.add(place_, offset))
        return context.get_dummy_value()

    return signature(types.void, rows, types.intp, target, types.intp), generate


def _turn_plainly(rows, index, target, place):
    target[place : place + LANES**2] = rows[:LANES, index : index + LANES].T.ravel()


@intrinsic
def _prefetch_compiled(typingctx, array, index):
    def generate(context, builder, sig, args):
        place = data_pointer(context, builder, sig.args[0], args[0])
        place = builder.bitcast(builder.gep(place, [args[1]]), ir.IntType(8).as_pointer())
        kinds = [place.type, INT32, INT32, INT32]
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), kinds), "llvm.prefetch.p0i8"
        )
        read, into_second_cache, data = (ir.Constant(INT32, value) for value in (0, 2, 1))
        builder.call(function, [place, read, into_second_cache, data])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


def _prefetch_plainly(array, index):
    pass


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


def _lanes(builder, first, count):
    """first, first + 1, ..., but at most count - 1."""
    start, last = (builder.trunc(value, INT32) for value in (first, count))
    last = splat(builder, builder.sub(last, ir.Constant(INT32, 1)))
    indices = builder.add(splat(builder, start), ir.Constant(WHOLE, list(range(LANES))))
    return builder.select(builder.icmp_signed("<", indices, last), indices, last)


def _shuffled(builder, first, second, block):
    """In each quarter of two vectors the lanes `block`, 0 to 3 of the first, 4 to 7 of the second.

    These are the shuffles that processors have one instruction for.
    """
    lanes = [
        4 * quarter + (lane if lane < 4 else LANES - 4 + lane)
        for quarter in range(4)
        for lane in block
    ]
    return builder.shuffle_vector(first, second, ir.Constant(WHOLE, lanes))


def _joined(builder, vectors):
    """Vectors of the same length end to end, two, four, ... of them."""
    while len(vectors) > 1:
        count = 2 * vectors[0].type.count
        lanes = ir.Constant(ir.VectorType(INT32, count), list(range(count)))
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors = [builder.shuffle_vector(low, high, lanes) for low, high in pairs]
    return vectors[0]


def _points(builder, place, offsets):
    """Three floats from each of sixteen offsets on, as three vectors; four are read."""
    four, rows = ir.VectorType(FLOAT, 4), []
    for offset in offsets:
        row = builder.bitcast(builder.gep(place, [offset]), four.as_pointer())
        rows.append(builder.load(row))
        rows[-1].align = 4
    # Quarter q of vector k is row 4 q + k.
    a, b, c, d = (_joined(builder, rows[k::4]) for k in range(4))
    front = _shuffled(builder, a, b, (0, 4, 1, 5)), _shuffled(builder, c, d, (0, 4, 1, 5))
    back = _shuffled(builder, a, b, (2, 6, 3, 7)), _shuffled(builder, c, d, (2, 6, 3, 7))
    x, y = _shuffled(builder, *front, (0, 1, 4, 5)), _shuffled(builder, *front, (2, 3, 6, 7))
    return x, y, _shuffled(builder, *back, (0, 1, 4, 5))


@intrinsic
def _gather_points_compiled(typingctx, array, indices):
    def generate(context, builder, sig, args):
        place, three = data_pointer(context, builder, sig.args[0], args[0]), ir.Constant(INT64, 3)
        rows = (builder.sext(_lane(builder, args[1], lane), INT64) for lane in range(LANES))
        points = _points(builder, place, [builder.mul(row, three) for row in rows])
        return context.make_tuple(builder, sig.return_type, points)

    return signature(types.UniTuple(floats, 3), array, whole), generate


def _gather_points_plainly(array, indices):
    return tuple(array[indices].T)


@intrinsic
def _take_points_compiled(typingctx, array, row, column):
    def generate(context, builder, sig, args):
        array_, row_, column_ = args
        place = builder.gep(data_pointer(context, builder, sig.args[0], array_), [column_])
        count, width = (_shape(context, builder, sig.args[0], array_, axis) for axis in (0, 1))
        results = [cgutils.alloca_once(builder, FLOATS) for _ in range(3)]
        rows = [builder.add(row_, ir.Constant(row_.type, lane)) for lane in range(LANES + 1)]
        with builder.if_else(builder.icmp_signed("<", rows[-1], count), likely=True) as (
            all_,
            some,
        ):
            with all_:
                offsets = [builder.mul(row, width) for row in rows[:-1]]
                for vector, result in zip(_points(builder, place, offsets), results, strict=True):
                    builder.store(vector, result)
            with some:
                indices = builder.mul(
                    _lanes(builder, row_, count), splat(builder, builder.trunc(width, INT32))
                )
                for axis, result in enumerate(results):
                    begin = builder.gep(place, [ir.Constant(INT64, axis)])
                    builder.store(gather_vector(builder, begin, indices), result)
        points = [builder.load(result) for result in results]
        return context.make_tuple(builder, sig.return_type, points)

    return signature(types.UniTuple(floats, 3), array, types.intp, types.intp), generate


def _take_points_plainly(array, row, column):
    return tuple(array[_lanes_plainly(row, len(array)), column : column + 3].T)


@intrinsic
def _lanes_compiled(typingctx, first, count):
    def generate(context, builder, sig, args):
        return _lanes(builder, *args)

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
                indices = _lanes(builder, row_, count)
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
    if array.ndim == 1:
        array[row : row + count] = vectors[:count]
    else:
        array[row : row + count] = np.stack(vectors, axis=1)[:count]


#: load(array, index): the sixteen elements from an index on. Those of int16 arrays become floats.
load = _load_plainly if INTERPRETED else _load_compiled
#: store(vector, array, index): the inverse; rounds for an int16 array.
store = _store_plainly if INTERPRETED else _store_compiled
#: prefetch(array, index): let the processor begin to read what is there, or would be.
prefetch = _prefetch_plainly if INTERPRETED else _prefetch_compiled
#: turn(rows, index, target, place): write columns index ... index + 15 of a (16, K) array, numbers
#: of 4 bytes, one after the other to target[place:place + 256].
turn = _turn_plainly if INTERPRETED else _turn_compiled
#: gather(array, indices): elements of a contiguous array, from any places; float32, int32, uint32.
gather = _gather_plainly if INTERPRETED else _gather_compiled
#: gather_points(array, indices): rows of an (N, 3) float32 array, from any places, as x, y, z. One
#: more float must be readable behind the array.
gather_points = _gather_points_plainly if INTERPRETED else _gather_points_compiled
#: take_points(array, row, column): the same of the rows from a row on, beyond the last one that
#: again; of an (N, K) array the three elements from a column on.
take_points = _take_points_plainly if INTERPRETED else _take_points_compiled
#: lanes_from(first, count): first, first + 1, ..., but at most count - 1.
lanes_from = _lanes_plainly if INTERPRETED else _lanes_compiled
#: take(array, row): the elements of a (N,) array from a row on; beyond the last one that again.
take = _take_plainly if INTERPRETED else _take_compiled
#: put(vectors, array, row): write a vector to the rows from `row` on of a (N,) array; of (x, y, z)
#: to an (N, 3) array. Only rows that there are.
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
