# SPDX-License-Identifier: Apache-2.0
"""The threads that parallel kernels run on: who comes helps, and nobody must come.

All threads of numba's own layers have to come to the end of each parallel loop, though others have
long done the work. Where programs compete for the processors, each of a step's thirty loops then
waits for a thread that is not running, spinning on the very processor that it wants. Here the
calling thread opens a job of some parts, and whoever is running takes one part after the other.
It waits only for parts that somebody has begun: it gets by without helpers that sleep or have been
displaced. With a program beside that runs 5 ms of each 33 ms, steps take 10 % longer and not 20 %.

Who waits soon gives way (sched_yield), so it costs those little who want the processor, and may
wait long before it sleeps: to be woken up takes as long as a small loop.

Numba hands loops to `numba_parallel_for`, a symbol of its layer, which is replaced by `_layer`, and
asks `get_thread_id` who it is.
NUMBA_THREADING_LAYER keeps numba's layer of that name; that one is used everywhere but on Linux.
"""

import atexit
import os
import sys
import threading

import llvmlite.binding as ll
import numba
from numba import types

from sph_ros.core.atomics import (
    LINE,
    WORDS,
    add,
    call_gufunc,
    give_way,
    look,
    make_semaphore,
    own_thread,
    pause,
    read_address,
    sleep,
    swap,
    wake,
    words,
    write,
    write_address,
)
from sph_ros.core.jit import callback, called, compiler, kernel

# Where the words are that threads share. TICKET: see `_ticket`. DONE: parts that are finished. JOB:
# what `call_gufunc` is to be told. ASLEEP: 1 while the caller sleeps. BELL: its semaphore.
CALLER, TICKET, DONE, JOB, ASLEEP, HELPERS, ENDING, BELL = range(0, 8 * LINE, LINE)

#: Of each helper: 1 while it sleeps, its `own_thread`, and behind these its semaphore.
FIRST_HELPER, APART = 16 * LINE, 2 * LINE

MOST_HELPERS = (WORDS - FIRST_HELPER) // APART

#: Numbers of parts are kept in so many bits.
BITS = 24
LOW = (1 << BITS) - 1

#: Who waits first only pauses, in turns of so many pauses, 0.4 us: a part or the gap to the next
#: loop is seldom longer than so many turns, and who gave way in between might be displaced for
#: milliseconds. Then it gives way, some 0.5 us each, and at last it sleeps. That of a helper is
#: later than any gap between two loops of a step.
PAUSES = 16
CALLER_PAUSES, CALLER_TURNS = 100, 160
HELPER_PAUSES, HELPER_TURNS = 150, 750


_helpers = []


@called
def _ticket(threads, parts):
    """A job before its first part is taken: how many may do it, its parts, how many are taken."""
    return (threads << 2 * BITS) | (parts << BITS)


@called
def _parts_of(ticket):
    return (ticket >> BITS) & LOW


@called
def _take_part(thread):
    """The number of a part of the present job for a thread, -1 if there is none for it."""
    while True:
        ticket = look(TICKET)
        part = ticket & LOW
        if part >= _parts_of(ticket) or thread >= ticket >> 2 * BITS:
            return -1
        if swap(TICKET, ticket, ticket + 1):
            return part


@called
def _call(function, arguments, dimensions, steps, data, count, part):
    call_gufunc(function, arguments, dimensions, steps, data, count, part)


@called
def _do_part(part):
    """Do one that was taken; returns whether all are done with it."""
    _call(
        look(JOB), look(JOB + 1), look(JOB + 2), look(JOB + 3), look(JOB + 4), look(JOB + 5), part
    )  # fmt: skip
    parts = _parts_of(look(TICKET))  # the next job cannot be opened yet
    return add(DONE, 1) + 1 == parts


@called
def _rest(shortly):
    """Wait a little, keeping the processor or offering it to others."""
    if shortly:
        for _ in range(PAUSES):
            pause()
    else:
        give_way()


@called
def _open_job(threads, parts):
    """Let helpers see a job, and wake those that are to do it."""
    write(DONE, 0)
    write(TICKET, _ticket(threads, parts))
    for k in range(min(threads, parts) - 1):
        helper = FIRST_HELPER + k * APART
        if look(helper) == 1 and swap(helper, 1, 0):
            wake(helper + LINE)


@called
def _finish_job(parts):
    """Do all that nobody has taken, and wait for what others have."""
    caller = types.int64(0)
    part = _take_part(caller)
    while part >= 0:
        _do_part(part)
        part = _take_part(caller)
    turns = 0
    while look(DONE) < parts:
        if turns < CALLER_TURNS:
            _rest(turns < CALLER_PAUSES)
            turns += 1
            continue
        write(ASLEEP, 1)
        # Who finishes the last part from now on wakes us up, perhaps before we sleep.
        if look(DONE) < parts or not swap(ASLEEP, 1, 0):
            while sleep(BELL) != 0:
                pass


@called
def _share_out(function, arguments, dimensions, steps, data, count, threads):
    """Do a loop of dimensions[0] parts together with the helpers, or alone where they are busy."""
    parts = read_address(dimensions)
    write_address(dimensions, 1)  # of this many parts each call is to be
    threads = min(threads, look(HELPERS) + 1)
    if parts < 2 or parts > LOW or threads < 2 or not swap(CALLER, 0, 1):
        for part in range(parts):
            _call(function, arguments, dimensions, steps, data, count, part)
        write_address(dimensions, parts)
        return
    write(JOB, function)
    write(JOB + 1, arguments)
    write(JOB + 2, dimensions)
    write(JOB + 3, steps)
    write(JOB + 4, data)
    write(JOB + 5, count)
    _open_job(threads, parts)
    _finish_job(parts)
    write_address(dimensions, parts)
    write(CALLER, 0)


@kernel
def _help(k):
    """What helper k does until the process ends."""
    helper, turns = FIRST_HELPER + k * APART, 0
    write(helper + 1, own_thread())
    while look(ENDING) == 0:
        part = _take_part(k + 1)
        if part >= 0:
            turns = 0
            if _do_part(part) and look(ASLEEP) == 1 and swap(ASLEEP, 1, 0):
                wake(BELL)
        elif turns < HELPER_TURNS:
            _rest(turns < HELPER_PAUSES)
            turns += 1
        else:
            turns = 0
            write(helper, 1)
            ticket = look(TICKET)
            done = (ticket & LOW) >= _parts_of(ticket) or k + 1 >= ticket >> 2 * BITS
            if (done and look(ENDING) == 0) or not swap(helper, 1, 0):
                while sleep(helper + LINE) != 0:
                    pass


@callback(types.void(*[types.int64] * 8))
def _layer(function, arguments, dimensions, steps, data, _inner_dimensions, count, threads):
    """In the place of numba's `parallel_for`; its arguments."""
    _share_out(function, arguments, dimensions, steps, data, count, threads)


@callback(types.intp())
def _thread_number():
    """In the place of numba's `get_thread_id`, by which loops tell apart their partial sums."""
    own = own_thread()
    for k in range(look(HELPERS)):
        if look(FIRST_HELPER + k * APART + 1) == own:
            return k + 1
    return 0


def _start():
    """Have helpers, one for each thread that numba may use beside the caller."""
    numba.get_num_threads()  # numba's layer must be there before its symbols can be replaced
    for function, arguments in ((_help, (types.int64,)), (_send_home, ())):
        function.compile(arguments)  # not by a helper, nor at the end, which would wait for numba
    make_semaphore(BELL)
    for k in range(min(numba.config.NUMBA_NUM_THREADS - 1, MOST_HELPERS)):
        make_semaphore(FIRST_HELPER + k * APART + LINE)
        helper = threading.Thread(target=_help, args=(k,), name=f"helper {k}", daemon=True)
        try:
            helper.start()
        except RuntimeError:  # the system allows no more threads
            break
        _helpers.append(helper)
    words[HELPERS] = len(_helpers)
    ll.add_symbol("numba_parallel_for", _layer.address)
    ll.add_symbol("get_thread_id", _thread_number.address)
    atexit.register(_end)
    os.register_at_fork(after_in_child=_forget)


@kernel
def _send_home():
    """Let all helpers end."""
    write(ENDING, 1)
    for k in range(look(HELPERS)):
        helper = FIRST_HELPER + k * APART
        if look(helper) == 1 and swap(helper, 1, 0):
            wake(helper + LINE)


def _end():
    """Helpers must not run on while the process is taken apart."""
    _send_home()
    for helper in _helpers:
        helper.join(1.0)


def _forget():
    """A forked process has no helpers; its kernels run on the calling thread."""
    words[:] = 0
    _helpers.clear()


if (
    sys.platform == "linux"
    and not numba.config.DISABLE_JIT
    and "NUMBA_THREADING_LAYER" not in os.environ
    and numba.config.NUMBA_NUM_THREADS > 1
):
    _start()

#: What numba makes parallel: loops that say so, and nothing else. It need not look for more.
LOOPS = {
    "prange": True,
    **dict.fromkeys(("comprehension", "reduction", "inplace_binop", "setitem", "numpy"), False),
    **dict.fromkeys(("stencil", "fusion"), False),
}

#: A loop over arrays spread over threads. Iteration i of `prange` may write row i only. Give arrays
#: that are fields of a tuple a local name before the loop: numba loses direct writes to them inside
#: `prange`. What takes long in every step is shared out by `core.chunks`.
parallel_kernel = compiler(nogil=True, parallel=LOOPS)
