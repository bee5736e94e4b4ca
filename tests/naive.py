# SPDX-License-Identifier: Apache-2.0
"""Slow and obvious versions of the kernels: all pairs, double precision, plain numpy."""

import numpy as np


def pairs_within(positions, radius):
    """Boolean (N, N): closer than the radius; a particle is near itself."""
    x = positions.astype(np.float64)
    return np.linalg.norm(x[:, None] - x[None], axis=2) < radius


def densities(positions, support_radius, power, lattice_sum):
    """Sum of (1 - r/h)^power over all particles, self included, relative to the lattice, (N,)."""
    x = positions.astype(np.float64)
    q = np.linalg.norm(x[:, None] - x[None], axis=2) / support_radius
    return (np.maximum(1.0 - q, 0.0) ** power).sum(axis=1) / lattice_sum


def gradients(positions, support_radius, power, lattice_sum):
    """Gradient at i of the normalised weight to j, (N, N, 3) [1/m]."""
    x = positions.astype(np.float64)
    offset = x[:, None] - x[None]
    r = np.linalg.norm(offset, axis=2)
    u = np.maximum(1.0 - r / support_radius, 0.0)
    slope = -power * u ** (power - 1) / support_radius / lattice_sum
    r[r == 0.0] = 1.0
    return slope[..., None] * offset / r[..., None]


def pressure_displacements(positions, pressures, support_radius, lattice_sum):
    """-sum over j of (P_i + P_j) grad w_ij, (N, 3); pressures scaled [m^2]."""
    g = gradients(positions, support_radius, 2, lattice_sum)
    both = pressures[:, None].astype(np.float64) + pressures[None]
    return -(both[..., None] * g).sum(axis=1)
