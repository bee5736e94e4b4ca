# SPDX-License-Identifier: Apache-2.0
"""The pressure iterations that the solvers `relaxation` and `incompressible` share."""

from typing import NamedTuple

import numpy as np

from sph_ros.core import relaxation as relax

LEAST_ITERATIONS, MOST_ITERATIONS = 2, 60

#: Share of the Jacobi correction taken in each iteration. It has to be smaller the more neighbours
#: there are: it shrinks when iterations diverge and grows back slowly.
FIRST_SHARE, LEAST_SHARE = 0.4, 0.05
SHRINK, GROW = 0.7, 1.01

#: Nesterov's sequence begins here and not at 1: a warm start is wrong at long waves, which only
#: momentum reaches. Saves a third of the iterations in a stirred tank.
FIRST_INERTIA = 4.0


class Goal(NamedTuple):
    """When iterations end: at a share of the first error, but between two bounds.

    Attributes:
        least, most: mean density error [-].
        share: of the error that the first guess leaves [-].
    """

    least: float
    share: float = 0.0
    most: float = np.inf


def solve_pressures(
    work,
    densities,
    gradients,
    support_radius,
    compliance,
    goal,
    share,
    coupling=None,
    displaced=False,
):
    """Scaled pressures that hold the density, and the displacements they cause.

    Args:
        work: `Workspace` with pairs, diagonal, the displacements without pressure in `cohesive`
            and, in `scaled`, a first guess; `scaled` and `displacements` are written.
        densities: without displacement, relative to rest [-], (N,).
        gradients: of the contacts, (N, 6).
        support_radius: h [m], float32.
        compliance: density per scaled pressure that the liquid yields [1/m^2], float32.
        goal: `Goal`.
        share: of the Jacobi correction to take.
        coupling: `Coupling` with the free bodies, which keeps `work.yielded` up to date.
        displaced: whether `displacements` are already those of the first guess.

    Returns:
        Iterations taken, mean density error left, share to start from next time.
    """

    def displace(pressures):
        relax.pressure_displacements(
            work.pairs,
            pressures,
            gradients,
            work.cohesive,
            support_radius,
            work.displacements,
            work.packed,
        )

    first = work.scaled.copy()
    best = np.inf
    inertia, restart = FIRST_INERTIA, True
    for iteration in range(1, MOST_ITERATIONS + 1):
        if restart:
            work.guesses[:] = work.scaled
            before, restart = np.inf, False
        if iteration > 1 or not displaced:
            displace(work.guesses)
        if coupling is not None:
            coupling.respond(work.guesses)
        grown = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * inertia**2))
        relax.correct_pressures(
            work.pairs,
            densities,
            gradients,
            support_radius,
            work.displacements,
            work.packed,
            work.yielded,
            work.diagonal,
            compliance,
            np.float32(share),
            np.float32((inertia - 1.0) / grown),
            work.scaled,
            work.guesses,
            work.errors,
        )
        error = float(work.errors.sum()) / max(work.count, 1)
        if iteration == 1:
            enough = min(max(goal.least, goal.share * error), goal.most)
        if iteration >= LEAST_ITERATIONS and error <= enough:
            break
        if error > 3.0 * best:
            share = max(SHRINK * share, LEAST_SHARE)
            work.scaled[:] = first
            restart = True
        # Extrapolation that made it worse starts over (O'Donoghue & Candes 2015).
        inertia, before = (1.0 if error > before else grown), error
        best = min(best, error)
    displace(work.scaled)
    return iteration, error, min(GROW * share, FIRST_SHARE)
