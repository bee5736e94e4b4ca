# SPDX-License-Identifier: Apache-2.0
"""Pressures that hold the density, by iteration: the solvers `relaxation` and `incompressible`.

The displacement w_i = c_i - sum_j (p_i + p_j) g_ij of each particle follows from pressures, with g
the gradients of pairs and c what moves it otherwise, and its density then grows by
sum_j g_ij . (w_i - w_j). Wanted are pressures p >= 0 with density - 1 <= compliance p, one of the
two being an equality. Both sums are the gradient of a convex function of p.
"""

import numpy as np
from numba import prange

from sph_ros.core.chunks import CHUNK, PARTS, chunk_count, fresh_turns, next_chunk, slices_of
from sph_ros.core.contact_data import wall_gradients
from sph_ros.core.jit import inlined
from sph_ros.core.pair_sums import divergence_of_pairs, push_by_pairs
from sph_ros.core.team import parallel_kernel
from sph_ros.core.vector import LANES, larger, magnitude, spread, total, where
from sph_ros.core.vector_memory import lanes_from, put, take, take_points

#: Fields of the state of an iteration, an array of float64; see `fresh_state`.
ITERATION, SHARE, INERTIA, BEFORE, BEST, ENOUGH, ERROR, DONE, FIELDS = range(9)

#: The share of the Jacobi correction shrinks by so much when iterations diverge, down to so little.
SHRINK, LEAST_SHARE = 0.7, 0.02

#: Error over the smallest so far at which an iteration counts as diverging.
DIVERGING = 3.0

#: Nesterov's sequence begins here and not at 1: a warm start is wrong at long waves, which only
#: momentum reaches. Saves a third of the iterations in a stirred tank.
FIRST_INERTIA = 8.0


def fresh_state(share):
    """State of an iteration before its first step.

    Args:
        share: of the Jacobi correction that is taken [-].

    Returns:
        (FIELDS,) float64: iterations so far; share; inertia of Nesterov's sequence; the last and
        the best error, infinite; the error that is enough, set by the first iteration; the error
        [-]; 1 once there are enough iterations, else 0.
    """
    state = np.zeros(FIELDS)
    state[SHARE], state[INERTIA] = share, FIRST_INERTIA
    state[BEFORE] = state[BEST] = np.inf
    return state


@parallel_kernel
def scale_guess(pressures, unit, scaled, guesses, first):
    """What iterations begin with: a first guess of the pressures, three times.

    Args:
        pressures: [Pa], (N,).
        unit: scaled pressure [m^2] per pressure, float32.
        scaled, guesses, first: see `iterate_pressures`, (N,); written.
    """
    for i in prange(pressures.shape[0]):
        scaled[i] = guesses[i] = first[i] = pressures[i] * unit


@parallel_kernel
def pressure_diagonal(sums, contacts, compliance, diagonal):
    """How much a particle's own scaled pressure lowers its own density [1/m^2].

    Args:
        sums: from `sum_densities`.
        contacts: of the particles with the solids.
        compliance: density per scaled pressure that the liquid itself yields [1/m^2], float32.
        diagonal: (N,); written.
    """
    gradients = contacts.gradients
    for i in prange(diagonal.shape[0]):
        own = sums.gradient_square[i] + compliance
        for axis in range(3):
            total = sums.gradient[i, axis] + gradients[i, axis]
            own += total * total
        diagonal[i] = max(own, compliance + np.float32(1e-12))


@inlined
def _displace(first, pairs, pressures, contacts, cohesive, displacements):
    """What `pressure_displacements` does, for the slice that begins at particle `first`."""
    own, x, y, z = push_by_pairs(pairs, pressures, first)
    gx, gy, gz = wall_gradients(contacts, first)
    cx, cy, cz = take_points(cohesive, first, 0)
    put((cx - x - own * gx, cy - y - own * gy, cz - z - own * gz), displacements, first)


@parallel_kernel
def pressure_displacements(pairs, pressures, contacts, cohesive, displacements):
    """Displacements by given pressures (Clavet 2005, Alg. 2, gathered).

    Each particle gathers from its neighbours. The two sides of a pair are the same numbers with
    opposite signs, so momentum is conserved to rounding.

    Args:
        pairs: from `sum_densities`.
        pressures: times dt^2 / (rho0 virial) [m^2], (N,).
        contacts: as in `pressure_diagonal`.
        cohesive: displacements to start from [m], (N, 3).
        displacements: [m], (N, 3); written.
    """
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunk_count(pressures.shape[0]))
        while chunk >= 0:
            for s in slices_of(chunk, pairs.stop.shape[0]):
                _displace(s * LANES, pairs, pressures, contacts, cohesive, displacements)
            chunk = next_chunk(turns, part, chunk_count(pressures.shape[0]))


@inlined
def _density_change(first, pairs, contacts, displacements):
    """How much denser a slice gets [-]."""
    change = divergence_of_pairs(pairs, displacements, first)
    x, y, z = take_points(displacements, first, 0)
    gx, gy, gz = wall_gradients(contacts, first)
    return change + gx * x + gy * y + gz * z


@inlined
def _correct(first, residual, yielded, compliance, diagonal, share, momentum, pressures, guesses):
    """Take one step for a slice; returns the sum of its errors."""
    pressure, zero = take(guesses, first), spread(np.float32(0.0))
    residual -= take(yielded, first) + compliance * pressure
    better = larger(pressure + share * residual / take(diagonal, first), zero)
    ahead = larger(better + momentum * (better - take(pressures, first)), zero)
    put(ahead, guesses, first)
    put(better, pressures, first)
    # Where there is no pressure a lack of density is a free surface, not an error.
    wrong = (residual > zero) | (pressure > zero)
    wrong = wrong & (lanes_from(first, first + LANES) < guesses.shape[0])
    return total(where(wrong, magnitude(residual), zero))


@parallel_kernel
def iterate_pressures(
    pairs,
    densities,
    residuals,
    contacts,
    cohesive,
    yielded,
    diagonal,
    compliance,
    goal,
    limits,
    state,
    pressures,
    guesses,
    first,
    displacements,
    errors,
):
    """Iterate until the density is held; `pressure_displacements` then displaces by what was found.

    Jacobi corrections, projected to pressures that push, with Nesterov's extrapolation (Beck &
    Teboulle 2009), which starts over where it made the error larger (O'Donoghue & Candes 2015).

    Args:
        pairs: from `sum_densities`.
        densities: at the displacements zero, relative to rest [-], (N,).
        residuals: their errors at the displacements by the first guess, free bodies and compliance
            left out [-], (N,); or (0,): to be found.
        contacts: as in `pressure_diagonal`.
        cohesive: displacements to start from [m], (N, 3).
        yielded: how much the density sinks because free bodies give way to the guesses [-], (N,).
        diagonal: from `pressure_diagonal`.
        compliance: as in `pressure_diagonal`.
        goal: mean density error to end at [-]: at least, share of the first one, at most.
        limits: iterations in all, at least and at most; iterations in this call.
        state: from `fresh_state` or an earlier call; written.
        pressures: scaled [m^2], (N,); a first guess, improved in place.
        guesses: the same, extrapolated, (N,); those that displacements are made by.
        first: the first guess, (N,).
        displacements: [m], (N, 3); written: those by the guesses of the last iteration.
        errors: (chunks,) float64; scratch.
    """
    count, chunks = pressures.shape[0], errors.shape[0]
    least, most, steps = limits
    for _ in range(steps):
        known = state[ITERATION] == 0.0 and residuals.shape[0] == count
        if not known:
            turns = fresh_turns()
            for part in prange(PARTS):
                chunk = next_chunk(turns, part, chunks)
                while chunk >= 0:
                    for s in slices_of(chunk, pairs.stop.shape[0]):
                        _displace(s * LANES, pairs, guesses, contacts, cohesive, displacements)
                    chunk = next_chunk(turns, part, chunks)
        inertia = state[INERTIA]
        grown = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * inertia * inertia))
        share, momentum = np.float32(state[SHARE]), np.float32((inertia - 1.0) / grown)
        again = fresh_turns()
        for part in prange(PARTS):
            chunk = next_chunk(again, part, chunks)
            while chunk >= 0:
                error = 0.0
                for row in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count), LANES):
                    if known:
                        residual = take(residuals, row)
                    else:
                        residual = take(densities, row) - np.float32(1.0)
                        residual += _density_change(row, pairs, contacts, displacements)
                    error += _correct(
                        row, residual, yielded, compliance, diagonal, share, momentum, pressures,
                        guesses,
                    )  # fmt: skip
                errors[chunk] = error
                chunk = next_chunk(again, part, chunks)
        sum_of_errors = 0.0
        for chunk in range(errors.shape[0]):
            sum_of_errors += errors[chunk]
        error = sum_of_errors / max(count, 1)
        if state[ITERATION] == 0.0:
            state[ENOUGH] = min(max(goal[0], goal[1] * error), goal[2])
        state[ITERATION] += 1.0
        state[ERROR] = error
        enough = state[ITERATION] >= least and error <= state[ENOUGH]
        if enough or state[ITERATION] >= most:
            state[DONE] = 1.0
            break
        before = state[BEFORE]
        state[INERTIA], state[BEFORE] = (1.0 if error > before else grown), error
        if error > DIVERGING * state[BEST]:
            state[SHARE], state[BEFORE] = max(SHRINK * state[SHARE], LEAST_SHARE), np.inf
            for i in range(count):
                pressures[i] = guesses[i] = first[i]
        state[BEST] = min(state[BEST], error)
