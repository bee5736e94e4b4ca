# SPDX-License-Identifier: Apache-2.0
"""The weights of double density relaxation and their sums over the rest lattice.

Clavet, Beaudoin & Poulin 2005 weigh a neighbour at distance r by (1 - r/h)^2 for the density and by
(1 - r/h)^3 for the near-density. Their sums have no unit. Here both are divided by their sum over
the liquid at rest, a square lattice of the particle spacing, self included: a density of 1 is the
rest density.

Mueller, Charypar & Gross 2003 have other weights. Of two of them walls need sums: poly6,
(1 - r^2/h^2)^3, is `POLY6` here, and the shape of spiky, (1 - r/h)^3, is the power 3.
"""

import itertools
import math

import numpy as np

DENSITY_POWER = 2
NEAR_POWER = 3

#: Of the density of the solver `incompressible`. Clavet's (1 - r/h)^2 ends with a kink in its
#: slope, and each neighbour that comes or goes is felt: particles at rest are then a glass that
#: bears a shear of two percent of its pressure, bodies hang in it, and walls disturb it by several
#: layers. In a close-packed lattice (h = 2 spacings) the shear modulus is 0.6 of the pressure, with
#: the third power less than 0.1.
SMOOTH_POWER = 3
POLY6 = "poly6"


def radial_weight(weight, q):
    """Shape of a weight at q = r/h in 0 ... 1, any shape; 1 at q = 0 [-].

    Args:
        weight: the power p of (1 - q)^p, or POLY6.
        q: distance over support radius [-].
    """
    if weight == POLY6:
        return (1.0 - np.square(q)) ** 3
    return (1.0 - np.asarray(q)) ** weight


def _lattice_distances(support_radius, spacing, dimension):
    """Distances [m] from a lattice point to all within the support, itself included."""
    reach = int(math.ceil(support_radius / spacing))
    for offset in itertools.product(range(-reach, reach + 1), repeat=dimension):
        distance = spacing * math.sqrt(sum(c * c for c in offset))
        if distance < support_radius:
            yield distance


def lattice_sum(weight, support_radius, spacing, dimension):
    """Sum of a weight over the rest lattice, self included [-].

    Args:
        weight: 2 for the density, 3 for the near-density, or POLY6.
        support_radius: h [m].
        spacing: of the square (2D) or cubic (3D) lattice [m].
        dimension: 2 or 3.
    """
    return math.fsum(
        float(radial_weight(weight, r / support_radius))
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
