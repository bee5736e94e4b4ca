# SPDX-License-Identifier: Apache-2.0
"""The weights of double density relaxation and their sums over the rest lattice.

Clavet, Beaudoin & Poulin 2005 weigh a neighbour at distance r by (1 - r/h)^2 for the density and by
(1 - r/h)^3 for the near-density. Their sums have no unit. Here both are divided by their sum over
the liquid at rest, a square lattice of the particle spacing, self included: a density of 1 is the
rest density.
"""

import itertools
import math

DENSITY_POWER = 2
NEAR_POWER = 3


def _lattice_distances(support_radius, spacing, dimension):
    """Distances [m] from a lattice point to all within the support, itself included."""
    reach = int(math.ceil(support_radius / spacing))
    for offset in itertools.product(range(-reach, reach + 1), repeat=dimension):
        distance = spacing * math.sqrt(sum(c * c for c in offset))
        if distance < support_radius:
            yield distance


def lattice_sum(power, support_radius, spacing, dimension):
    """Sum of (1 - r/h)^power over the rest lattice, self included [-].

    Args:
        power: 2 for the density, 3 for the near-density.
        support_radius: h [m].
        spacing: of the square (2D) or cubic (3D) lattice [m].
        dimension: 2 or 3.
    """
    return math.fsum(
        (1.0 - r / support_radius) ** power
        for r in _lattice_distances(support_radius, spacing, dimension)
    )


def gradient_sum(power, support_radius, spacing, dimension):
    """How much pressure the lattice transmits per unit of nominal pressure [-].

    The virial of the normalised weight, (1/d) sum of r |dw/dr|; 1 for an ideal quadrature. Dividing
    pressure accelerations by it makes the pressure of a liquid at rest the physical one.
    """
    virial = math.fsum(
        r * power * (1.0 - r / support_radius) ** (power - 1) / support_radius
        for r in _lattice_distances(support_radius, spacing, dimension)
    )
    return virial / dimension / lattice_sum(power, support_radius, spacing, dimension)
