# SPDX-License-Identifier: Apache-2.0
"""Vortices that live longer: particles are flywheels that the liquid turns, and that turn it.

A pressure that acts on particles one by one rubs layers of liquid on each other, however little
viscosity there is: a vortex of ten spacings in radius loses half of its speed in a turn or two.
With spins that follow the liquid, see `core.spins`, a vortex has the inertia of the flywheels in
addition. Where the vorticity varies like exp(i k x) their energy is that of the liquid times
(R k / 2)^2, and all that acts on the vortex takes 1 + (R k / 2)^2 times as long. The slow decay of
a round vortex whose speed is greatest at the radius a has k = 2 / a: 1 + (R / a)^2. So does its
beginning; and what does not turn, as still water and waves, notices nothing.
"""

from functools import lru_cache

import numpy as np

from sph_ros.core import spins as core
from sph_ros.sim.scales import lattice_neighbors

#: Rotational viscosity times the longest stable step over spacing^2 [-]: how fast spins follow. It
#: is stable up to 1 at least, for particles at random, too. Slower, and spins do not hold what the
#: liquid loses.
STRENGTH = 0.25

SPINS = "spins"


@lru_cache
def lattice_numbers(power, support_radius, spacing, dimension):
    """Determinant of M and sum of the squared gradients of a lattice.

    Of the gradients q (1 - r/h)^(q - 1) of a weight that is not normalised, q being its power.
    """
    virial = square = 0.0
    for r, _ in lattice_neighbors(support_radius, spacing, dimension):
        if r > 0.0:
            slope = power * (1.0 - r / support_radius) ** (power - 1) / support_radius
            virial += r * slope / dimension
            square += slope**2
    # M is twice the virial; in two dimensions once for axes within the plane.
    return (2.0 if dimension == 2 else 8.0) * virial**3, square


def turn_liquid(fluid, work, scene, power, density_scale, radius, steps):
    """Let spins and velocities rub on each other for a substep.

    Args:
        fluid: its velocities and its extra `spins` [rad/s] are changed; that is made, or taken off
            where the radius is 0.
        work: `Workspace` with the neighbours; its scratch is used.
        scene: the scene.
        power, density_scale: of the density's weight; its gradients are those of the pairs.
        radius: of gyration of the flywheels, R [m].
        steps: length of the substep over that of the longest stable one [-].
    """
    if radius == 0.0:
        fluid.extras.pop(SPINS, None)
        return
    new = SPINS not in fluid.extras
    if new:
        fluid.extras[SPINS] = np.zeros((len(fluid), 3), np.float32)
    determinant, square = lattice_numbers(
        power, scene.support_radius, scene.spacing, scene.dimension
    )
    # Two rotations meet in c |w - n|^2 / 2: the viscosity of curls is c / 4.
    exchange = 4.0 * STRENGTH * scene.spacing**2 * min(steps, 1.0)
    core.rub_spins(
        work.pairs,
        work.predicted,
        work.sums,
        fluid.velocities,
        np.float32(determinant * density_scale**3),
        np.float32(square * density_scale**2),
        np.float32(exchange),
        np.float32(radius**2),
        new,
        fluid.extras[SPINS],
        work.scratch,
    )
    core.push_by_spins(work.pairs, work.scratch, fluid.velocities)
