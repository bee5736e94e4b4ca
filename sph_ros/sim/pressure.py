# SPDX-License-Identifier: Apache-2.0
"""The pressure iterations that the solvers `relaxation` and `incompressible` share."""

import itertools
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sph_ros.core import pressure as core

LEAST_ITERATIONS, MOST_ITERATIONS = 2, 60

#: The share of the Jacobi correction grows back so fast once it had to shrink.
GROW = 1.01

#: Stands for residuals that are not known yet.
UNKNOWN = np.zeros(0, np.float32)


class Goal(NamedTuple):
    """When iterations end: at a share of the first error, but between two bounds.

    Attributes:
        least, most: mean density error [-].
        share: of the error that the first guess leaves [-].
    """

    least: float
    share: float = 0.0
    most: float = np.inf


@lru_cache
def jacobi_share(support_radius, spacing, dimension, power):
    """Share of the Jacobi correction to take in each iteration [-].

    A wave of pressures of wave vector k on a lattice is corrected by the share times
    |sum_j g_j sin(k . r_j)|^2 / sum_j |g_j|^2, with g_j the gradients of the weight.
    Nesterov's extrapolation bears 4/3 of that; more neighbours make it several times larger. Flowed
    liquid has 3 to 15 % less than a lattice (h = 2 spacings), up to a third less at 2.8, and in two
    dimensions a tenth more; with the third power an eighth more.

    Args:
        support_radius: h [m].
        spacing: [m].
        dimension: 2 or 3.
        power: of the weight (1 - r/h)^power.
    """
    reach = int(np.ceil(support_radius / spacing))
    offsets = np.array(list(itertools.product(range(-reach, reach + 1), repeat=dimension)), float)
    ratio = np.linalg.norm(offsets, axis=1) * spacing / support_radius
    near = (ratio > 0.0) & (ratio < 1.0)
    offsets, ratio = offsets[near], ratio[near]
    gradients = (1.0 - ratio)[:, None] ** (power - 1) * offsets / ratio[:, None]
    # One corner of the first Brillouin zone stands for all.
    waves = np.array(list(itertools.product(np.linspace(0.0, np.pi, 17), repeat=dimension)))
    pushed = np.sin(waves @ offsets.T) @ gradients
    stiffest = np.einsum("ka,ka->k", pushed, pushed).max() / np.einsum(
        "ja,ja->", gradients, gradients
    )
    stiffest *= (1.1 if dimension == 2 else 1.0) * (1.0 if power == 2 else 1.13)
    return float(4.0 / (3.0 * stiffest))


def solve_pressures(
    work,
    densities,
    compliance,
    goal,
    share,
    most_share,
    coupling=None,
    residuals=UNKNOWN,
):
    """Scaled pressures that hold the density, and the displacements they cause.

    Args:
        work: `Workspace` with pairs, contacts, diagonal, the displacements without pressure in
            `cohesive` and a first guess by `scale_guess`; `scaled` and `displacements` are written.
        densities: without displacement, relative to rest [-], (N,).
        compliance: density per scaled pressure that the liquid yields [1/m^2], float32.
        goal: `Goal`.
        share, most_share: of the Jacobi correction to take now, and when all is well.
        coupling: `Coupling` with the free bodies, which keeps `work.yielded` up to date.
        residuals: density errors at the displacements by the first guess, where they are known.

    Returns:
        Iterations taken, mean density error left, share to start from next time.
    """
    state = core.fresh_state(share)
    # Free bodies have to give way to each new guess.
    steps = MOST_ITERATIONS if coupling is None else 1
    while not state[core.DONE]:
        if coupling is not None:
            coupling.respond(work.guesses)
        core.iterate_pressures(
            work.pairs,
            densities,
            residuals,
            work.contacts,
            work.cohesive,
            work.yielded,
            work.diagonal,
            compliance,
            tuple(goal),
            (LEAST_ITERATIONS, MOST_ITERATIONS, steps),
            state,
            work.scaled,
            work.guesses,
            work.first,
            work.displacements,
            work.errors,
        )
    core.pressure_displacements(
        work.pairs, work.scaled, work.contacts, work.cohesive, work.displacements
    )
    share = min(GROW * float(state[core.SHARE]), most_share)
    return int(state[core.ITERATION]), float(state[core.ERROR]), share
