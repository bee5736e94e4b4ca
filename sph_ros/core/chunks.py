# SPDX-License-Identifier: Apache-2.0
"""Particles in chunks, shared out among threads, late ones' chunks taken over by the others.

A `prange` gives each thread its share beforehand, and all wait for the last one. Where a processor
has other work too (another node, a browser), or solids make some particles dear, that is long. So
the particles are divided into `PARTS`, which `prange` shares out, and whoever has a part asks for
one chunk after the other:

    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunks)
        while chunk >= 0:
            ...
            chunk = next_chunk(turns, part, chunks)

First it gets those of this part and of the following ones, which its cache may still hold, in the
end what other threads have not begun yet. Who does a chunk is chance, so what comes out must not
depend on it.
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from sph_ros.core.jit import called, device, inlined
from sph_ros.core.vector import INTERPRETED, LANES
from sph_ros.core.vector_memory import data_pointer

#: Particles handled by one piece of parallel work, whole slices; fixed, so that no sum depends on
#: the threads.
CHUNK = 256

#: Slices of a chunk.
SLICES = CHUNK // LANES

#: More than there are threads, or some would have nothing to do.
PARTS = 32

#: Numbers between the counts of two parts, so that they are not in one line of the cache.
APART = 8


@inlined
def chunk_count(particle_count):
    """Pieces of parallel work for so many particles."""
    return (particle_count + CHUNK - 1) // CHUNK


@inlined
def slices_of(chunk, slices):
    """Numbers of the slices of a chunk, of so many in all."""
    return range(chunk * SLICES, min((chunk + 1) * SLICES, slices))


@intrinsic
def _take_turn_compiled(typingctx, turns, part):
    """turns[part, 0] += 1, by one thread at a time; returns what it was before."""

    def generate(context, builder, sig, args):
        place = data_pointer(context, builder, sig.args[0], args[0])
        place = builder.gep(place, [builder.mul(args[1], ir.Constant(args[1].type, APART))])
        return builder.atomic_rmw("add", place, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(turns, types.intp), generate


def _take_turn_plainly(turns, part):
    turns[part, 0] += 1
    return turns[part, 0] - 1


_take_turn = _take_turn_plainly if INTERPRETED else _take_turn_compiled


@device
def fresh_turns():
    """How many chunks of each part have been begun, none: (PARTS, APART) int64."""
    return np.zeros((PARTS, APART), np.int64)


@called
def next_chunk(turns, part, chunks):
    """The next chunk for who has a part; -1 if all have been begun.

    Args:
        turns: from `fresh_turns`; written.
        part: in 0 ... PARTS - 1.
        chunks: how many there are in all.
    """
    for ahead in range(PARTS):
        now = (part + ahead) % PARTS
        first, last = chunks * now // PARTS, chunks * (now + 1) // PARTS
        if turns[now, 0] < last - first:
            chunk = first + _take_turn(turns, now)
            if chunk < last:
                return chunk
    return np.int64(-1)
