# SPDX-License-Identifier: Apache-2.0
"""The solver `none`: particles that fly and slide, and do not feel each other."""

from dataclasses import dataclass

import numpy as np

from sph_ros.sim.leapfrog_solver import LeapfrogSolver
from sph_ros.sim.scales import expected_speed, readable_step

#: Share of the support radius that the fastest expected particle crosses in a step.
COURANT = 0.4


@dataclass(frozen=True)
class Masses:
    """Of one particle [kg] (2D: per metre of depth), and its rest density [kg/m^3]."""

    mass: float
    rest_density: float


class UncoupledSolver(LeapfrogSolver):
    """Gravity, solids and friction along them, nothing else: a fountain needs no more."""

    def set_material(self, material):
        """Use another material from the next substep on."""
        super().set_material(material)
        volume = self._scene.spacing**self._scene.dimension
        self.scales = Masses(material.density * volume, material.density)

    def stable_time_step(self):
        """A step in which the fastest expected particle does not cross its support [s], and why."""
        speed = expected_speed(self._scene, self._depth)
        step = min(COURANT * self._scene.support_radius / speed, 0.01)
        return readable_step(step), f"particles up to {speed:.2g} m/s"

    def step(self, fluid, time, time_step):
        """Advance `fluid` by one substep; the solids' motion must already be set.

        Args:
            fluid: changed in place.
            time: since the start of the simulation [s].
            time_step: [s].

        Returns:
            Force [N] and torque [N m] of the particles on each solid, (S, 6) float64.
        """
        self._clock("start")
        self._prepare(fluid)
        self._drift(fluid, time_step)
        fluid.positions[:] = self._work.predicted
        self._clock("sweep")
        self._find_contacts(time_step, fluid.clearance)
        fluid.extras["accelerations"][:] = self._gravity
        self._kick(fluid, time_step)
        self._rub(fluid, self._material.viscosity / self._material.density, time_step)
        self._clock("solids")
        return self._mean_reactions(np.zeros_like(self._pushes))

    def densities(self, fluid):
        """Densities at the present positions relative to rest [-], (N,), rows as in `fluid`."""
        return self._clavet_densities(fluid)
