# SPDX-License-Identifier: Apache-2.0
"""The arrays that change during a simulation, and the scratch memory of a step, kept apart."""

import numpy as np

from sph_ros.core.contacts import TERMS, Contacts
from sph_ros.core.neighbors import CHUNK, Grid, Pairs, Sums, chunk_count
from sph_ros.core.vector import LANES

#: Cells of a grid; beyond, its outermost cells hold what lies farther out.
MOST_CELLS_PER_PARTICLE = 8
MOST_CELLS_AT_LEAST = 1 << 16

#: What the names of a fluid's extras begin with in a snapshot.
EXTRA = "extra_"


class Fluid:
    """The liquid: one row per particle, sorted by cell.

    Attributes:
        positions: [m], world frame, (N, 3) float32.
        velocities: [m/s], (N, 3) float32.
        pressures: [Pa], (N,) float32; kept as the first guess of the next step.
        particle: which particle each row is; the public arrays are in this order, (N,) int32.
        ids: of the particles in public order, (N,) uint32.
        extras: what else a solver keeps of each particle: name -> array with N rows.
    """

    def __init__(self, positions, velocities, ids=None, extras=None):
        """Start with particles in public order."""
        count = len(positions)
        self.positions = np.ascontiguousarray(positions, dtype=np.float32).reshape(count, 3)
        self.velocities = np.ascontiguousarray(velocities, dtype=np.float32).reshape(count, 3)
        self.pressures = np.zeros(count, np.float32)
        self.particle = np.arange(count, dtype=np.int32)
        self.ids = np.arange(count, dtype=np.uint32) if ids is None else ids
        self.extras = dict(extras or {})

    def __len__(self):
        """Number of particles."""
        return len(self.particle)

    def arrays(self):
        """All arrays by name, for a snapshot."""
        arrays = {name: rows for name, rows in vars(self).items() if name != "extras"}
        return arrays | {EXTRA + name: rows for name, rows in self.extras.items()}

    @classmethod
    def of_arrays(cls, arrays):
        """The liquid of a snapshot."""
        extras = {n.removeprefix(EXTRA): a for n, a in arrays.items() if n.startswith(EXTRA)}
        fluid = cls(arrays["positions"], arrays["velocities"], arrays["ids"], extras)
        fluid.pressures = arrays["pressures"]
        fluid.particle = arrays["particle"]
        return fluid

    def copy(self):
        """A liquid of its own in the same state."""
        return self.of_arrays({name: rows.copy() for name, rows in self.arrays().items()})

    def reorder(self, order):
        """Let row k be what was row order[k], in all arrays but positions and velocities."""
        self.pressures = self.pressures[order]
        self.particle = self.particle[order]
        for name, rows in self.extras.items():
            self.extras[name] = rows[order]

    def public(self, rows):
        """Copy of an array with a row per particle, in public order."""
        result = np.empty_like(rows)
        result[self.particle] = rows
        return result


class Workspace:
    """Scratch memory for one step of N particles among S solids. Holds no result.

    Attributes:
        chunks: pieces of parallel work.
        predicted, starts, scratch, displacements, cohesive: (N, 3) float32.
        columns: coordinates for the neighbour search, (3, N + LANES) float32.
        cell_of, order: (N,) int32.
        diagonal, scaled, guesses: of the pressure iterations, (N,) float32.
        clearance: distance that a particle certainly has from all solids [m], (N,) float32; the
            only thing here that a later step reads, and zeros would do.
        errors: (chunks,) float64; squeezed: (chunks,) int64.
        reactions: wrench per chunk and solid, (chunks, S, 6) float64.
        pairs, sums, contacts: see their classes.
    """

    def __init__(self, count, solids, pairs_per_particle=44):
        """Allocate for `count` particles and `solids` solids."""
        self.count = count
        self.solids = solids
        self.chunks = max(chunk_count(count), 1)
        self.predicted = np.empty((count, 3), np.float32)
        self.starts = np.empty((count, 3), np.float32)
        self.scratch = np.empty((count, 3), np.float32)
        self.displacements = np.empty((count, 3), np.float32)
        self.cohesive = np.zeros((count, 3), np.float32)
        self.columns = np.zeros((3, count + LANES), np.float32)
        self.cell_of = np.empty(count, np.int32)
        self.order = np.empty(count, np.int32)
        self.diagonal = np.empty(count, np.float32)
        self.clearance = np.zeros(count, np.float32)
        self.scaled = np.empty(count, np.float32)
        self.guesses = np.empty(count, np.float32)
        self.errors = np.zeros(self.chunks, np.float64)
        self.squeezed = np.zeros(self.chunks, np.int64)
        self.reactions = np.zeros((self.chunks, solids, 6), np.float64)
        self.sums = Sums(
            np.ones(count, np.float32),
            np.ones(count, np.float32),
            np.empty((count, 3), np.float32),
            np.empty(count, np.float32),
        )
        room = self.chunks * CHUNK * solids
        self.contacts = Contacts(
            np.zeros(count, np.int64),
            np.zeros(count, np.int64),
            np.empty(room, np.int32),
            np.empty((room, TERMS), np.float32),
            np.zeros((count, 2), np.float32),
            np.zeros((count, 6), np.float32),
        )
        self._allocate_pairs(pairs_per_particle)

    def _allocate_pairs(self, per_particle):
        room = self.chunks * CHUNK * per_particle
        self.pairs_per_particle = per_particle
        self.pairs = Pairs(
            np.zeros(self.count, np.int64),
            np.zeros(self.count, np.int64),
            np.zeros(self.count, np.int32),
            np.empty(room, np.uint32),
            np.empty((4, room), np.float32),
        )

    def enlarge_pairs(self):
        """More room for neighbours, after a search that found too little."""
        self._allocate_pairs(2 * self.pairs_per_particle)


def make_grid(lower, upper, cell, count):
    """Grid of cells over the box from `lower` to `upper` [m] for `count` particles.

    A stray particle must not make it huge: the outermost cells also hold what lies beyond, so the
    longest axes are cut until the number of cells is in proportion.
    """
    limit = max(MOST_CELLS_PER_PARTICLE * count, MOST_CELLS_AT_LEAST)
    extent = np.maximum(np.asarray(upper, np.float64) - lower, 0.0)
    counts = np.floor(np.minimum(extent / cell, 1e6)).astype(np.int64) + 1
    while int(np.prod(counts)) > limit:
        axis = int(np.argmax(counts))
        counts[axis] = max(counts[axis] // 2, 1)
    return Grid(
        np.asarray(lower, np.float32).copy(),
        np.float32(1.0 / cell),
        counts.astype(np.int32),
        np.zeros(int(np.prod(counts)) + 1, np.int32),
    )
