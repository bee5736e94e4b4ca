# SPDX-License-Identifier: Apache-2.0
"""The solver `lennard_jones`: particles like neutral atoms (Murta & Miller 1999).

The potential has two numbers. Its minimum is at the particle spacing. Its depth e follows from the
material's surface tension: the bonds that a lattice lacks at its surface cost that energy per area.
A liquid as coarse as ours would collapse under its weight with that alone, so the depth is at least
what lets the deepest particles come `YIELD` closer. Viscosity is friction along the line of centres
as in the relaxation solver; without it energy is conserved, and a liquid that falls becomes hot.

Two families keep `ATTRACTION` of the attraction between them, and so separate.
"""

import math
from dataclasses import dataclass

import numpy as np

from sph_ros.core import lennard_jones as forces
from sph_ros.sim.leapfrog_solver import LeapfrogSolver
from sph_ros.sim.scales import (
    LEAST_SPEED,
    expected_speed,
    lattice_neighbors,
    readable_step,
    viscous_rate,
)
from sph_ros.sim.state import family_of

#: Share of the spacing by which the weight of the liquid may press the deepest particles together.
YIELD = 0.1

#: Share of the attraction that is left between particles of two families.
ATTRACTION = 0.2

#: Energy of a particle deep in a wall, in e. The potential is this times the fourth power of the
#: wall's share of the density: nothing half a spacing away, a cliff at the wall.
WALL_DEPTH = 100.0

#: Time step in a sqrt(m / e), the time in which a pair swings.
STEP = 0.01

#: Share of the support radius that the fastest particle crosses in a step.
COURANT = 0.05


@dataclass(frozen=True)
class JonesScales:
    """Numbers of one family.

    Attributes:
        mass: of a particle [kg] (2D: per metre of depth).
        rest_density: [kg/m^3].
        depth: e [J] (2D: per metre of depth).
        rub: friction per relative speed along the line of centres and (1 - r/h) [kg/s].
    """

    mass: float
    rest_density: float
    depth: float
    rub: float


def bond(r, spacing):
    """Potential at a distance r [m] in units of e."""
    six = (spacing / r) ** 6
    return six * six - 2.0 * six


def surface_bonds(scene):
    """Bond energy that a lattice lacks at its surface, in e per particle of the outermost layer."""
    h, s, d = scene.support_radius, scene.spacing, scene.dimension
    # A bond that reaches `height` layers up is missing to as many layers; half of it is theirs.
    return -0.5 * sum(height * bond(r, s) for r, height in lattice_neighbors(h, s, d) if height > 0)


def jones_scales(material, scene, depth):
    """Numbers of `material` in `scene` with liquid `depth` [m] deep."""
    s, d = scene.spacing, scene.dimension
    mass = material.density * s**d
    tension = material.surface_tension * s ** (d - 1) / surface_bonds(scene)
    g = math.sqrt(sum(c * c for c in scene.gravity))
    six = (1.0 - YIELD) ** -6
    push = 12.0 / (1.0 - YIELD) * (six * six - six)
    weight = mass * max(g * depth, LEAST_SPEED**2) / push
    return JonesScales(
        mass=mass,
        rest_density=material.density,
        depth=max(tension, weight),
        rub=mass * viscous_rate(material.viscosity / material.density, scene),
    )


class LennardJonesSolver(LeapfrogSolver):
    """Pairs by Lennard-Jones, walls by a soft potential, velocity Verlet."""

    #: In the steep part of the potential forces are hundreds of e / a.
    force_reach = 0.01

    def set_material(self, material):
        """Use another material from the next substep on; other liquids keep theirs."""
        super().set_material(material)
        self._families = [jones_scales(m, self._scene, self._depth) for m in self.materials]
        self.scales = self._families[0]
        h, s, d = self._scene.support_radius, self._scene.spacing, self._scene.dimension
        self._crowd = sum(1.0 - r / h for r, _ in lattice_neighbors(h, s, d) if r > 0.0) / d
        depths = np.array([family.depth for family in self._families])
        self._depths = np.sqrt(np.outer(depths, depths)).astype(np.float32)
        unlike = ~np.eye(len(depths), dtype=bool)
        self._attractions = np.where(unlike, ATTRACTION, 1.0).astype(np.float32)
        rubs = np.array([family.rub for family in self._families])
        self._rubs = (0.5 * np.add.outer(rubs, rubs)).astype(np.float32)
        self._lightness = np.array([1.0 / f.mass for f in self._families], np.float32)

    def stable_time_step(self):
        """A step that keeps the scene stable [s], and what bounds it."""
        s, h = self._scene.spacing, self._scene.support_radius
        speed = expected_speed(self._scene, self._depth)
        swing = min(s * math.sqrt(f.mass / f.depth) for f in self._families)
        rub = max(f.rub / f.mass for f in self._families)
        bounds = {
            "the swing of a pair": STEP * swing,
            f"particles up to {speed:.2g} m/s": COURANT * h / speed,
        }
        if rub > 0.0:
            bounds["viscosity"] = 0.5 / (rub * self._crowd)
        reason = min(bounds, key=bounds.get)
        return readable_step(bounds[reason]), reason

    def longest_step(self):
        """The longest substep [s] that present speeds and accelerations allow."""
        reach = COURANT * self._scene.support_radius
        return min(self._longest_for_forces(), reach / max(self.fastest, 1e-9))

    def step(self, fluid, time, time_step):
        """Advance `fluid` by one substep; the solids' motion must already be set.

        Args:
            fluid: changed in place.
            time: since the start of the simulation [s].
            time_step: [s].

        Returns:
            Force [N] and torque [N m] of the particles on each solid, (S, 6) float64.

        Raises:
            UnstableError: a position is not a number.
        """
        self._clock("start")
        self._prepare(fluid)
        self._drift(fluid, time_step)
        self._sort(fluid, self._work.predicted, self._work.predicted)
        self._clock("sort")
        self._find_contacts(time_step, fluid.clearance)
        self._clock("solids")
        self._find_neighbors()
        self._clock("neighbors")
        pushes = self._find_accelerations(fluid)
        self._kick(fluid, time_step)
        self._rub(fluid, self._material.viscosity / self._material.density, time_step)
        self._clock("forces")
        return self._mean_reactions(pushes)

    def _find_accelerations(self, fluid):
        """Accelerations by pairs, gravity and walls; the walls' wrenches, (S, 6)."""
        work = self._work
        accelerations, family = fluid.extras["accelerations"], family_of(fluid)
        forces.pair_forces(
            work.columns,
            fluid.velocities,
            self._h,
            np.float32(self._scene.spacing),
            self._depths,
            self._attractions,
            self._rubs,
            family,
            work.pairs,
            self._lightness,
            accelerations,
        )
        accelerations += self._gravity
        reactions = np.zeros_like(work.reactions)
        if len(self._solids):
            forces.wall_forces(
                fluid.positions,
                work.contacts,
                self._solids.motion,
                np.float32(WALL_DEPTH * self.scales.depth),
                family,
                self._lightness,
                accelerations,
                reactions,
            )
        return reactions.sum(axis=0)

    def densities(self, fluid):
        """Densities at the present positions relative to rest [-], (N,), rows as in `fluid`."""
        return self._clavet_densities(fluid)
