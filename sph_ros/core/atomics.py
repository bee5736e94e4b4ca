# SPDX-License-Identifier: Apache-2.0
"""Words that threads of compiled code share, and the calls of the C library with which they wait.

The words are one array per process, which compiled code finds under the name `SYMBOL`; an address
in the code itself could not be kept in a cache. All accesses are sequentially consistent.
"""

import ctypes
import platform

import llvmlite.binding as ll
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

#: Words per line of a cache: what one thread writes and another reads often stands in a line alone.
LINE = 8

#: How many words there are.
WORDS = 512 * LINE

SYMBOL = "sph_ros_shared_words"

_WORD = ir.IntType(64)
_INT = ir.IntType(32)
_memory = np.zeros((WORDS + LINE) * 8, np.uint8)
_ADDRESS = -(-_memory.ctypes.data // (8 * LINE)) * 8 * LINE

#: The same words for Python.
words = np.ctypeslib.as_array((ctypes.c_int64 * WORDS).from_address(_ADDRESS))

ll.add_symbol(SYMBOL, _ADDRESS)

#: What tells a processor that a loop only waits.
_PAUSES = {
    "x86_64": ("llvm.x86.sse2.pause", []),
    "aarch64": ("llvm.aarch64.hint", [ir.Constant(_INT, 1)]),
}


def make_semaphore(index):
    """Make the `LINE` words from an index on a semaphore (`sem_t`) that nobody has posted."""
    if ctypes.CDLL(None).sem_init(ctypes.c_void_p(_ADDRESS + 8 * index), 0, 0) != 0:
        raise OSError("no semaphore could be made")


def _place(builder, index):
    module, kind = builder.module, ir.ArrayType(_WORD, WORDS)
    base = module.globals.get(SYMBOL) or ir.GlobalVariable(module, kind, SYMBOL)
    return builder.gep(base, [ir.Constant(_INT, 0), index])


def _call(builder, name, result, arguments):
    kind = ir.FunctionType(result, [value.type for value in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


@intrinsic
def look(typingctx, index):
    """The word at an index."""

    def generate(context, builder, sig, args):
        return builder.load_atomic(_place(builder, args[0]), "seq_cst", 8)

    return types.int64(types.int64), generate


@intrinsic
def write(typingctx, index, value):
    """Set the word at an index."""

    def generate(context, builder, sig, args):
        builder.store_atomic(args[1], _place(builder, args[0]), "seq_cst", 8)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), generate


@intrinsic
def add(typingctx, index, value):
    """Add to the word at an index; returns what it was before."""

    def generate(context, builder, sig, args):
        return builder.atomic_rmw("add", _place(builder, args[0]), args[1], "seq_cst")

    return types.int64(types.int64, types.int64), generate


@intrinsic
def swap(typingctx, index, old, new):
    """Replace `old` at an index by `new`; returns whether it was there."""

    def generate(context, builder, sig, args):
        place = _place(builder, args[0])
        result = builder.cmpxchg(place, args[1], args[2], "seq_cst", "seq_cst")
        return builder.extract_value(result, 1)

    return types.boolean(types.int64, types.int64, types.int64), generate


@intrinsic
def pause(typingctx):
    """Wait for some nanoseconds."""

    def generate(context, builder, sig, args):
        if platform.machine() in _PAUSES:
            name, arguments = _PAUSES[platform.machine()]
            _call(builder, name, ir.VoidType(), arguments)
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def give_way(typingctx):
    """Let another thread have this processor, if one waits for it (sched_yield)."""

    def generate(context, builder, sig, args):
        _call(builder, "sched_yield", _INT, [])
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def own_thread(typingctx):
    """A number that no other thread has (pthread_self)."""

    def generate(context, builder, sig, args):
        return _call(builder, "pthread_self", _WORD, [])

    return types.int64(), generate


@intrinsic
def sleep(typingctx, index):
    """Sleep until the semaphore at an index is posted; returns not 0 when a signal came instead."""

    def generate(context, builder, sig, args):
        place = builder.ptrtoint(_place(builder, args[0]), _WORD)
        return builder.sext(_call(builder, "sem_wait", _INT, [place]), _WORD)

    return types.int64(types.int64), generate


@intrinsic
def wake(typingctx, index):
    """Post the semaphore at an index."""

    def generate(context, builder, sig, args):
        place = builder.ptrtoint(_place(builder, args[0]), _WORD)
        _call(builder, "sem_post", _INT, [place])
        return context.get_dummy_value()

    return types.void(types.int64), generate


@intrinsic
def read_address(typingctx, address):
    """The 64 bits at an address."""

    def generate(context, builder, sig, args):
        return builder.load(builder.inttoptr(args[0], _WORD.as_pointer()))

    return types.int64(types.int64), generate


@intrinsic
def write_address(typingctx, address, value):
    """Set the 64 bits at an address."""

    def generate(context, builder, sig, args):
        builder.store(args[1], builder.inttoptr(args[0], _WORD.as_pointer()))
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), generate


@intrinsic
def call_gufunc(typingctx, function, arguments, dimensions, steps, data, count, part):
    """Call a generalised ufunc's loop, void (char **, npy_intp *, npy_intp *, void *), for a part.

    To be called in a function of its own, for it takes stack until that returns.

    Args:
        function, arguments, dimensions, steps, data: addresses; arguments[k] is moved on by
            part * steps[k] bytes.
        count: of the arguments.
        part: number of the part.
    """

    def generate(context, builder, sig, args):
        function, arguments, dimensions, steps, data, count, part = args
        table = _WORD.as_pointer()
        moved = builder.alloca(_WORD, size=count)
        arguments, steps_table = (builder.inttoptr(p, table) for p in (arguments, steps))
        with cgutils.for_range(builder, count) as loop:
            base, step = (
                builder.load(builder.gep(p, [loop.index])) for p in (arguments, steps_table)
            )
            place = builder.gep(moved, [loop.index])
            builder.store(builder.add(base, builder.mul(step, part)), place)
        kind = ir.FunctionType(ir.VoidType(), [table, _WORD, _WORD, _WORD])
        builder.call(
            builder.inttoptr(function, kind.as_pointer()), [moved, dimensions, steps, data]
        )
        return context.get_dummy_value()

    return types.void(*[types.int64] * 7), generate
