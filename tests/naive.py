# SPDX-License-Identifier: Apache-2.0
"""Slow and obvious versions of the kernels: all pairs, double precision, plain numpy."""

import numpy as np

from sph_ros.core import mueller_weights as weights


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


def pressure_displacements(gradients, pressures):
    """-sum over j of (P_i + P_j) grad w_ij, (N, 3); pressures scaled [m^2]."""
    both = pressures[:, None].astype(np.float64) + pressures[None]
    return -(both[..., None] * gradients).sum(axis=1)


class Mueller:
    """Mueller, Charypar & Gross 2003 over all pairs: published weights, sums over the lattice.

    Attributes:
        acceleration: by all forces [m/s^2], (N, 3).
        density: relative to rest [-], (N,).
    """

    def __init__(self, positions, velocities, scene, liquid, damping, packing):
        """Sum all forces.

        Args:
            positions: [m], (N, d).
            velocities: [m/s], (N, d).
            scene: Scene.
            liquid: its stiffness, viscosity, surface tension, rest density.
            damping: time by which pressures look ahead [s].
            packing: rest density of the lattice over that of the liquid [-].
        """
        h, s, d = scene.support_radius, scene.spacing, scene.dimension
        volume = s**d
        grid = np.stack(np.meshgrid(*[np.arange(-4, 5) * s] * d), axis=-1).reshape(-1, d)
        rest = np.linalg.norm(grid, axis=1)
        rest = rest[rest < h]
        around = rest[rest > 0.0]
        full = volume * weights.poly6(rest, h, d).sum() / packing
        push = -volume * (around * weights.spiky_slope(around, h, d)).sum() / d
        drag = volume * (around**2 * weights.viscosity_laplacian(around, h, d)).sum() / (2 * d)

        x, v = positions.astype(np.float64), velocities.astype(np.float64)
        offset = x[:, None] - x[None]
        r = np.linalg.norm(offset, axis=2)
        near = r < h
        other = near & ~np.eye(len(x), dtype=bool)
        along = np.where(other[..., None], offset / np.where(r == 0.0, 1.0, r)[..., None], 0.0)
        r = np.minimum(r, h)
        relative = v[:, None] - v[None]
        speed = (relative * along).sum(axis=2)

        self.density = volume * weights.poly6(r, h, d).sum(axis=1) / full
        rate = volume * (weights.poly6_slope(r, h, d) * speed).sum(axis=1) / full
        pressure = liquid.stiffness * np.maximum(self.density - 1.0 + damping * rate, 0.0)
        size = volume / self.density
        sizes = size[:, None] * size[None]

        # Equation 10 without its 2, which halves the pressure that is transmitted.
        both = pressure[:, None] + pressure[None]
        force = -sizes * both * weights.spiky_slope(r, h, d) / push
        # What damps collisions: a pressure in proportion to the squared speed of approach.
        approach = np.minimum(speed, 0.0)
        u = np.where(other, 1.0 - r / h, 0.0)
        rest_mass = liquid.rest_density * volume
        beta = 2.0 * scene.material.quadratic_viscosity / s
        force += sizes / volume**2 * rest_mass * beta * (u * approach) ** 2
        # Equation 14.
        rub = sizes * liquid.viscosity * weights.viscosity_laplacian(r, h, d) / drag
        total = (force[..., None] * along).sum(axis=1) - (rub[..., None] * relative).sum(axis=1)

        # Equations 17 to 19, and what makes their sum vanish.
        slope = weights.poly6_slope(r, h, d) / full
        normal = (size[None, :, None] * slope[..., None] * along).sum(axis=1)
        bend = (size[None] * np.where(near, weights.poly6_laplacian(r, h, d), 0.0)).sum(axis=1)
        length = np.linalg.norm(normal, axis=1)
        is_surface = length >= 0.7 / h
        pull = np.where(is_surface, -liquid.surface_tension * bend / full, 0.0) * size
        tension = (pull / np.where(is_surface, length, 1.0))[:, None] * normal
        total += tension - tension.mean(axis=0)
        self.acceleration = total / rest_mass
