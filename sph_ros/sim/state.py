# SPDX-License-Identifier: Apache-2.0
"""The arrays that change during a simulation, and the scratch memory of a step, kept apart."""

import math

import numpy as np

from sph_ros.core.chunks import CHUNK, chunk_count
from sph_ros.core.contacts import TERMS, Contacts
from sph_ros.core.neighbors import Grid, Sums
from sph_ros.core.pair_sums import Pairs
from sph_ros.core.rows import gather_state, put_rows
from sph_ros.core.vector import LANES

#: Cells of a grid; beyond, its outermost cells hold what lies farther out.
MOST_CELLS_PER_PARTICLE = 8
MOST_CELLS_AT_LEAST = 1 << 16

#: [bytes]
CACHE_LINE = 64

#: What the names of a fluid's extras begin with in a snapshot.
EXTRA = "extra_"

#: The extra that says which of several liquids a particle is of; missing where there is one.
FAMILY = "family"


class Fluid:
    """The liquid: one row per particle, sorted by cell.

    There is room for `capacity` particles from the start; the arrays are views of those that exist.
    Change them in place: assigning another array would cut the view off from the room behind it. Of
    those in `ROWS` there is a `spare` twin each, to write what is new while the old is still read;
    `swap` then lets the two change places, so keep no view across a step.

    Attributes:
        positions: [m], world frame, (N, 3) float32.
        velocities: [m/s], (N, 3) float32.
        pressures: [Pa], (N,) float32; kept as the first guess of the next step.
        clearance: distance that a particle certainly has from all solids [m], (N,) float32; zeros
            would do.
        particle: which particle each row is; the public arrays are in this order, (N,) int32.
        ids: of the particles in public order, rising, (N,) uint32.
        extras: what else a solver keeps of each particle: name -> array with N rows; those of new
            particles are 0.
        capacity: particles that there is room for.
    """

    #: Arrays whose rows are in the order of `particle`: columns (0: a plain number), type.
    ROWS = {
        "positions": (3, np.float32),
        "velocities": (3, np.float32),
        "pressures": (0, np.float32),
        "clearance": (0, np.float32),
        "particle": (0, np.int32),
    }

    #: What a snapshot need not keep.
    PASSING = ("clearance",)

    def __init__(self, positions, velocities, ids=None, extras=None, capacity=0):
        """Start with particles in public order."""
        count = len(positions)
        self.capacity = max(capacity, count)
        self._store, self._spare = (allocate(self.capacity, self.ROWS) for _ in range(2))
        self._store["ids"] = np.zeros(self.capacity, np.uint32)
        self._resize(count)
        self.positions[:] = np.reshape(positions, (count, 3))
        self.velocities[:] = np.reshape(velocities, (count, 3))
        self.particle[:] = np.arange(count)
        self.ids[:] = np.arange(count) if ids is None else ids
        self.extras = dict(extras or {})

    def _resize(self, count):
        for name, rows in self._store.items():
            setattr(self, name, rows[:count])

    def spare(self, name):
        """An array like the one called `name`, for what that becomes; what is in it is no use."""
        return self._spare[name][: len(self)]

    def swap(self, *names):
        """Let the spare arrays be those of the liquid, and these spare."""
        for name in names:
            self._store[name], self._spare[name] = self._spare[name], self._store[name]
            setattr(self, name, self._store[name][: len(getattr(self, name))])

    def __len__(self):
        """Number of particles."""
        return len(self.particle)

    def arrays(self):
        """All arrays by name that a later step depends on, for a snapshot."""
        arrays = {name: getattr(self, name) for name in self._store if name not in self.PASSING}
        return arrays | {EXTRA + name: rows for name, rows in self.extras.items()}

    @classmethod
    def of_arrays(cls, arrays, capacity=0):
        """The liquid of a snapshot."""
        extras = {n.removeprefix(EXTRA): a for n, a in arrays.items() if n.startswith(EXTRA)}
        fluid = cls(arrays["positions"], arrays["velocities"], arrays["ids"], extras, capacity)
        for name in arrays:
            if name in fluid._store:
                getattr(fluid, name)[:] = arrays[name]
        return fluid

    def copy(self):
        """A liquid of its own in the same state, with no room for more."""
        twin = self.of_arrays(self.arrays())
        twin.extras = {name: rows.copy() for name, rows in self.extras.items()}
        return twin

    def public(self, rows):
        """Copy of an array with a row per particle, in public order."""
        result = np.empty_like(rows)
        if rows.dtype == np.float32:  # numpy takes five times as long
            table = len(rows), math.prod(rows.shape[1:])
            put_rows(rows.reshape(table), self.particle, result.reshape(table))
        else:
            result[self.particle] = rows
        return result

    def reorder(self, starts, ends, work):
        """Let row k be what was row order[k].

        Args:
            starts, ends: see `gather_state`; `positions` become the sorted starts.
            work: `Workspace` with the order; its `scratch` becomes the sorted ends, its `columns`
                these once more.
        """
        old = self.velocities, self.pressures, self.clearance, self.particle
        new = (self.spare(name) for name in ("velocities", "pressures", "clearance", "particle"))
        spare = self.spare("positions")
        ends_again = work.scratch, work.columns
        gather_state(work.order, starts, ends, *old, spare, *ends_again, *new)
        self.swap(*self.ROWS)
        for rows in self.extras.values():
            rows[:] = rows.take(work.order, axis=0, mode="clip")  # the fastest of numpy's ways

    def add(self, positions, velocities, ids):
        """Append particles whose ids are higher than all others; other rows of theirs are 0."""
        start = len(self)
        end = start + len(positions)
        self._resize(end)
        for name in self.ROWS:
            getattr(self, name)[start:] = 0
        self.positions[start:], self.velocities[start:] = positions, velocities
        self.particle[start:] = np.arange(start, end)
        self.ids[start:] = ids
        for name, rows in self.extras.items():
            new = np.zeros((end - start, *rows.shape[1:]), rows.dtype)
            self.extras[name] = np.concatenate([rows, new])

    def keep(self, rows):
        """Remove all particles but those where `rows` (N,) bool, in the order of rows, is true."""
        alive = np.zeros(len(self), bool)
        alive[self.particle[rows]] = True
        place = np.cumsum(alive, dtype=np.int32) - 1
        count = int(place[-1]) + 1 if len(place) else 0
        for name in self.ROWS:
            getattr(self, name)[:count] = getattr(self, name)[rows]
        self.particle[:count] = place[self.particle[:count]]
        self.ids[:count] = self.ids[alive]
        self.extras = {name: values[rows] for name, values in self.extras.items()}
        self._resize(count)


def family_of(fluid):
    """Which of the scene's liquids each particle is of, (N,) uint8, rows as in `fluid`."""
    family = fluid.extras.get(FAMILY)
    return np.zeros(len(fluid), np.uint8) if family is None else family


class Workspace:
    """Scratch memory for one step of N particles among S solids. Holds no result.

    Allocated once for as many particles as there can be; `fit` makes the arrays views of the first
    N rows.

    Attributes:
        count: N.
        slots: most contacts of a particle.
        chunks: pieces of parallel work.
        predicted, starts, scratch, displacements, cohesive: (N, 3) float32.
        columns: coordinates for the neighbour search, (3, N + 2 LANES) float32.
        cell_of, order: (N,) int32.
        diagonal, scaled, guesses, first, targets, residuals, yielded: of the pressure iterations,
            (N,) float32.
        masses: of the particles where they differ [kg]; scales: times a factor, (N,) float32.
        errors, strongest: (chunks,) float64; squeezed: (chunks,) int64.
        totals: (chunks, 3) float64.
        reactions: wrench per chunk and solid, (chunks, S, 6) float64.
        pairs, sums, contacts: see their classes.
    """

    #: Arrays with a row per particle: columns (0: a plain number), type.
    ROWS = {
        "predicted": (3, np.float32),
        "starts": (3, np.float32),
        "scratch": (3, np.float32),
        "displacements": (3, np.float32),
        "cohesive": (3, np.float32),
        "cell_of": (0, np.int32),
        "order": (0, np.int32),
        "diagonal": (0, np.float32),
        "scaled": (0, np.float32),
        "guesses": (0, np.float32),
        "first": (0, np.float32),
        "targets": (0, np.float32),
        "residuals": (0, np.float32),
        "yielded": (0, np.float32),
        "masses": (0, np.float32),
        "scales": (0, np.float32),
    }

    #: The same of `Sums` and `Contacts`.
    SUMS = {
        "density": (0, np.float32),
        "near_density": (0, np.float32),
        "gradient": (3, np.float32),
        "gradient_square": (0, np.float32),
    }
    CONTACTS = {
        "start": (0, np.int32),
        "end": (0, np.int32),
        "density": (2, np.float32),
        "gradients": (6, np.float32),
    }

    def __init__(self, capacity, solids, slots=None, pairs_per_particle=40):
        """Allocate for `capacity` particles, all of which are there.

        Args:
            capacity: most particles.
            solids: number of solids.
            slots: most contacts of a particle; None: one with each solid.
            pairs_per_particle: neighbours that there is room for at first.
        """
        self.capacity = capacity
        self.slots = solids if slots is None else slots
        chunks = max(chunk_count(capacity), 1)
        self._store = allocate(capacity, self.ROWS)
        self._chunk_store = {
            "errors": np.zeros(chunks, np.float64),
            "strongest": np.zeros(chunks, np.float64),
            "totals": np.zeros((chunks, 3), np.float64),
            "squeezed": np.zeros(chunks, np.int64),
            "reactions": np.zeros((chunks, solids, 6), np.float64),
        }
        self._columns = np.zeros(3 * (capacity + 2 * LANES), np.float32)
        self._sums = Sums(**allocate(capacity, self.SUMS))
        self._sums.density[:] = self._sums.near_density[:] = 1.0
        room = chunks * CHUNK * self.slots
        self._contacts = Contacts(
            **allocate(capacity, self.CONTACTS),
            solid=np.empty(room, np.int32),
            terms=np.empty((room, TERMS), np.float32),
            touching=np.zeros(-(-capacity // LANES), np.uint8),
        )
        self._allocate_pairs(pairs_per_particle)
        self.fit(capacity)

    def fit(self, count):
        """Make all arrays those of `count` particles; what is in them is of no use then."""
        self.count = count
        self.chunks = max(chunk_count(count), 1)
        for name, rows in self._store.items():
            setattr(self, name, rows[:count])
        for name, rows in self._chunk_store.items():
            setattr(self, name, rows[: self.chunks])
        width = count + 2 * LANES
        self.columns = self._columns[: 3 * width].reshape(3, width)
        self.sums = Sums(*(rows[:count] for rows in self._sums))
        lists = {name: getattr(self._contacts, name)[:count] for name in self.CONTACTS}
        slices = -(-count // LANES)
        self.contacts = self._contacts._replace(**lists, touching=self._contacts.touching[:slices])
        self._fit_pairs()

    def _allocate_pairs(self, per_particle):
        room = max(chunk_count(self.capacity), 1) * CHUNK * per_particle
        self.pairs_per_particle = per_particle
        self._pairs = Pairs(
            start=np.zeros(self.capacity, np.int32),
            end=np.zeros(self.capacity, np.int32),
            stop=np.zeros(-(-self.capacity // LANES), np.int32),
            neighbors=aligned(room, np.uint32),
            **{name: aligned(room, np.int16) for name in ("x", "y", "z", "nearness")},
            unit=np.zeros(1, np.float32),
        )

    def _fit_pairs(self):
        self.pairs = self._pairs._replace(
            start=self._pairs.start[: self.count],
            end=self._pairs.end[: self.count],
            stop=self._pairs.stop[: -(-self.count // LANES)],
        )

    def enlarge_pairs(self):
        """More room for neighbours, after a search that found too little."""
        self._allocate_pairs(self.pairs_per_particle + 4 + self.pairs_per_particle // 16)
        self._fit_pairs()


def allocate(count, rows):
    """Arrays of zeros with `count` rows, one behind the other in one piece of memory.

    A piece of some megabytes consists of huge pages where the system has any, which numpy asks for;
    many small arrays would need more pages than a processor keeps at hand. Behind the last row of
    each there is room for one more: `core.vector_memory.gather_points` may read beyond it.

    Args:
        count: rows.
        rows: name -> columns (0: a plain number), type of 4 bytes.

    Returns:
        name -> array.
    """
    widths = [-(-4 * (count + 1) * max(columns, 1) // CACHE_LINE) for columns, _ in rows.values()]
    memory = aligned(CACHE_LINE * sum(widths), np.uint8)
    memory[:] = 0
    pieces = np.split(memory, CACHE_LINE * np.cumsum(widths)[:-1])
    return {
        name: piece.view(kind)[: count * max(columns, 1)].reshape(
            (count, columns) if columns else count
        )
        for piece, (name, (columns, kind)) in zip(pieces, rows.items(), strict=True)
    }


def aligned(count, kind):
    """An array that begins where a line of the cache does, as vectors are read fastest."""
    size = np.dtype(kind).itemsize
    memory = np.empty(count * size + CACHE_LINE, np.uint8)
    first = -memory.ctypes.data % CACHE_LINE
    return memory[first : first + count * size].view(kind)


def make_grid(lower, upper, cell, count):
    """Grid of cells over the box from `lower` to `upper` [m] for `count` particles.

    A stray particle must not make it huge: the outermost cells also hold what lies beyond, so the
    longest axes are cut until the number of cells is in proportion.
    """
    limit = max(MOST_CELLS_PER_PARTICLE * count, MOST_CELLS_AT_LEAST)
    # Plain numbers: numpy takes several times as long for three of them, in every step.
    extent = [max(float(b) - float(a), 0.0) for a, b in zip(lower, upper, strict=True)]
    counts = [int(min(length / cell, 1e6)) + 1 for length in extent]
    while math.prod(counts) > limit:
        axis = counts.index(max(counts))
        counts[axis] = max(counts[axis] // 2, 1)
    # Runs of candidates lie along the second longest axis, and not along the shortest, so that few
    # of them end early.
    shortest, middle, longest = sorted(range(3), key=extent.__getitem__)
    axes = middle, shortest, longest
    return Grid(
        np.array(axes, np.int32),
        np.array([lower[axis] for axis in axes], np.float32),
        np.float32(1.0 / cell),
        np.array([counts[axis] for axis in axes], np.int32),
        np.zeros(math.prod(counts) + 1, np.int32),
    )
