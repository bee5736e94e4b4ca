# SPDX-License-Identifier: Apache-2.0
"""Viscosity: impulses where they are stable, conjugate gradients where the liquid is too thick."""

from typing import NamedTuple

import numpy as np

from sph_ros.core import contacts as touch
from sph_ros.core import relaxation as relax
from sph_ros.core.drag import add_drag, drag_reactions
from sph_ros.sim.scales import LONGEST_STEP, neighbor_sum, viscous_rate

#: Share of its speed relative to all neighbours that a particle may lose explicitly in a step. A
#: pair takes a share c along its line, so N neighbours all around take N c / dimension; from 1 on
#: they overshoot. Above the first limit the linear part is solved implicitly; the quadratic part
#: is cut at the second.
EXPLICIT_LIMIT, MOST_TAKEN = 0.38, 0.5

TOLERANCE, MOST_ITERATIONS = 1e-4, 100


class Rates(NamedTuple):
    """How strongly liquid rubs on itself and on solids in one step.

    Attributes:
        support_radius: h [m].
        linear: impulse per relative speed [-].
        quadratic: impulse per squared relative speed [s/m].
        neighbors: (1 - r/h) summed over the neighbours in a lattice, by the dimension [-].
        wall: impulse per sliding speed and wall fraction [-].
        wall_quadratic: impulse per squared sliding speed and wall fraction [s/m].
        inertia: particle mass / time step [kg/s].
    """

    support_radius: float
    linear: float
    quadratic: float
    neighbors: float
    wall: float
    wall_quadratic: float
    inertia: float

    @property
    def implicit(self):
        """Whether the linear part is too strong for explicit impulses."""
        return self.linear * self.neighbors > EXPLICIT_LIMIT


def may_be_implicit(material, scene):
    """Whether viscosity has to be implicit in the longest step that there can be."""
    rate = viscous_rate(material.viscosity / material.density, scene)
    step = max(scene.time_step or 0.0, LONGEST_STEP)
    return rate * step * neighbor_sum(scene) > EXPLICIT_LIMIT


def apply_viscosity(work, fluid, rates, motion):
    """Let pairs of neighbours share their velocities, and solids take theirs.

    Args:
        work: `Workspace` with pairs and contacts; its scratch arrays are used, its reactions added
            to.
        fluid: its velocities are changed.
        rates: `Rates`.
        motion: of the solids.
    """
    implicit = rates.implicit
    if rates.quadratic > 0.0 or (rates.linear > 0.0 and not implicit):
        relax.viscous_impulses(
            work.pairs,
            work.predicted,
            fluid.velocities,
            np.float32(rates.support_radius),
            np.float32(0.0 if implicit else rates.linear),
            np.float32(rates.quadratic),
            np.float32(MOST_TAKEN / rates.neighbors),
            fluid.spare("velocities"),
        )
        fluid.swap("velocities")
    velocities, touching = fluid.velocities, len(motion.position) > 0
    if implicit:
        _solve_implicitly(work, velocities, rates, touching)
        if touching:
            drag_reactions(
                work.predicted,
                work.contacts,
                motion,
                np.float32(rates.wall),
                np.float32(rates.inertia),
                velocities,
                work.reactions,
            )
    if touching:
        work.scales[:] = rates.inertia
        touch.rub_on_solids(
            work.predicted,
            work.contacts,
            motion,
            np.float32(0.0 if implicit else rates.wall),
            np.float32(rates.wall_quadratic),
            work.scales,
            velocities,
            work.reactions,
        )


def _solve_implicitly(work, velocities, rates, touching):
    """Conjugate gradients for v - impulses(v) = present v, starting from the present v."""
    direction, image, residual = work.cohesive, work.scratch, work.displacements
    reach, linear, wall = (np.float32(x) for x in (rates.support_radius, rates.linear, rates.wall))

    def dot(a, b):
        relax.chunk_dots(a, b, work.errors)
        return float(work.errors.sum())

    def apply(v, moving):
        relax.viscous_operator(work.pairs, work.predicted, v, reach, linear, image)
        if touching:
            add_drag(work.contacts, wall, np.float32(moving), v, image)

    # The surfaces' velocities belong to the right side; taken with the first image they end up
    # there.
    apply(velocities, 1.0)
    np.subtract(velocities, image, out=residual)
    direction[:] = residual
    square = dot(residual, residual)
    goal = TOLERANCE**2 * max(dot(velocities, velocities), square, 1e-30)
    for _ in range(MOST_ITERATIONS):
        if square <= goal:
            break
        apply(direction, 0.0)
        share = np.float32(square / dot(direction, image))
        velocities += share * direction
        residual -= share * image
        previous, square = square, dot(residual, residual)
        direction *= np.float32(square / previous)
        direction += residual
