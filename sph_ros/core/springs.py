# SPDX-License-Identifier: Apache-2.0
"""Springs between particles that were neighbours: elastic, and plastic beyond a yield strain.

Clavet, Beaudoin & Poulin 2005, section 5, gathered: each particle keeps the springs to all its
mates and both ends of a spring do the same sums, so they stay the same spring. A mate is known by
its id plus one (0: no spring), because rows and public numbers change; springs fill a row from the
front.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from sph_ros.core.chunks import CHUNK
from sph_ros.core.jit import device
from sph_ros.core.team import parallel_kernel
from sph_ros.core.vector import LANES

_TABLE = 256


class Springs(NamedTuple):
    """Springs of all particles.

    Attributes:
        mates: ids plus one, (N, S) uint32.
        lengths: at rest [m], (N, S) float32.
        count: springs of a particle, (N,) int32.
        wanted: neighbours that it has no spring to, (N,) int32.
    """

    mates: np.ndarray
    lengths: np.ndarray
    count: np.ndarray
    wanted: np.ndarray


class Yielding(NamedTuple):
    """How springs give way; all float32.

    Attributes:
        strain: relative deformation that is elastic [-].
        share: of a deformation beyond that which the length at rest follows in this step [-].
        longest: springs break when they are longer [m].
        support_radius: those whose length at rest reaches it vanish [m].
    """

    strain: np.float32
    share: np.float32
    longest: np.float32
    support_radius: np.float32


@parallel_kernel
def find_rows(id_of_row, row_of_id):
    """row_of_id[id_of_row[k]] = k; other entries stay. No two rows have the same id."""
    for k in prange(id_of_row.shape[0]):
        row_of_id[id_of_row[k]] = k


@parallel_kernel
def pull_springs(positions, row_of_id, springs, yielding, scale, pulls):
    """Let springs yield and break, and add their pulls (Clavet 2005, Alg. 3 and 4).

    The pull along the line of centres is scale (1 - L/h) (r - L).

    Args:
        positions: [m], (N, 3).
        row_of_id: row of a particle by its id, -1 if it is gone, (ids,) int32.
        springs: all but `wanted` is changed.
        yielding: `Yielding`.
        scale: acceleration [1/s^2] or displacement [-] per deformation, float32.
        pulls: [m/s^2] or [m], (N, 3); added to.
    """
    one = np.float32(1.0)
    mates, lengths, count = springs.mates, springs.lengths, springs.count
    slots = mates.shape[1]
    h = yielding.support_radius
    for i in prange(positions.shape[0]):
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        px, py, pz = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        kept = 0
        for slot in range(slots):
            mate = mates[i, slot]
            if mate == 0:
                break
            mates[i, slot] = 0
            j = row_of_id[mate - 1]
            if j < 0:
                continue
            dx, dy, dz = positions[j, 0] - x, positions[j, 1] - y, positions[j, 2] - z
            r = np.sqrt(dx * dx + dy * dy + dz * dz)
            length = lengths[i, slot]
            slack = yielding.strain * length
            if r > length + slack:
                length += yielding.share * (r - length - slack)
            elif r < length - slack:
                length -= yielding.share * (length - slack - r)
            if length >= h or r > yielding.longest:
                continue
            mates[i, kept] = mate
            lengths[i, kept] = length
            kept += 1
            pull = scale * (one - length / h) * (r - length) / max(r, np.float32(1e-20))
            px += pull * dx
            py += pull * dy
            pz += pull * dz
        count[i] = kept
        pulls[i, 0] += px
        pulls[i, 1] += py
        pulls[i, 2] += pz


@device
def is_mate(j, place, rows, count):
    """Whether row j is among the first `count` of `rows`; `place` says where it would be."""
    at = place[j % _TABLE]
    if at == 0:
        return False
    if rows[at - 1] == j:
        return True
    for slot in range(count):
        if rows[slot] == j:
            return True
    return False


@device
def note_mates(i, springs, row_of_id, rows, place):
    """Write the rows of i's mates to `rows`, and to `place` one more than where each one is."""
    for k in range(_TABLE):
        place[k] = 0
    for slot in range(springs.count[i]):
        j = row_of_id[springs.mates[i, slot] - 1]
        rows[slot] = j
        place[j % _TABLE] = slot + 1


@parallel_kernel
def count_unbound(pairs, row_of_id, chunks, springs):
    """How many neighbours a particle has no spring to.

    Args:
        pairs: from `find_neighbors`.
        row_of_id: as in `pull_springs`.
        chunks: `chunk_count(N)`.
        springs: `wanted` is written.
    """
    wanted = springs.wanted
    slots = springs.mates.shape[1]
    for chunk in prange(chunks):
        rows, place = np.empty(slots, np.int32), np.empty(_TABLE, np.int32)
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, wanted.shape[0])):
            note_mates(i, springs, row_of_id, rows, place)
            count = 0
            for k in range(pairs.start[i], pairs.end[i], LANES):
                j = np.int64(pairs.neighbors[k])
                if j != i and not is_mate(j, place, rows, springs.count[i]):
                    count += 1
            wanted[i] = count


@parallel_kernel
def bind_neighbors(positions, id_of_row, pairs, row_of_id, chunks, springs):
    """Springs at rest to all neighbours without one, where both have room for all of theirs.

    Args:
        positions: [m], (N, 3).
        id_of_row: id of each row, (N,) uint32.
        pairs, row_of_id, chunks: as in `count_unbound`, which must have been called.
        springs: mates and lengths are changed; `count` stays as it was.
    """
    mates, lengths, count, wanted = springs
    slots = mates.shape[1]
    for chunk in prange(chunks):
        rows, place = np.empty(slots, np.int32), np.empty(_TABLE, np.int32)
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, wanted.shape[0])):
            if wanted[i] == 0 or count[i] + wanted[i] > slots:
                continue
            note_mates(i, springs, row_of_id, rows, place)
            cursor = count[i]
            for k in range(pairs.start[i], pairs.end[i], LANES):
                j = np.int64(pairs.neighbors[k])
                if j == i or count[j] + wanted[j] > slots:
                    continue
                if is_mate(j, place, rows, count[i]):
                    continue
                dx = positions[j, 0] - positions[i, 0]
                dy = positions[j, 1] - positions[i, 1]
                dz = positions[j, 2] - positions[i, 2]
                mates[i, cursor] = id_of_row[j] + 1
                lengths[i, cursor] = np.sqrt(dx * dx + dy * dy + dz * dz)
                cursor += 1
