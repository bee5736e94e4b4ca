# SPDX-License-Identifier: Apache-2.0
"""What the solvers that iterate on pressures share: `relaxation` and `incompressible`."""

import numpy as np

from sph_ros.core import contacts as touch
from sph_ros.core import neighbors as search
from sph_ros.core import relaxation as relax
from sph_ros.core.weights import DENSITY_POWER
from sph_ros.sim.pressure import FIRST_SHARE, solve_pressures
from sph_ros.sim.scales import packing, solver_scales, stable_time_step
from sph_ros.sim.solver import Solver
from sph_ros.sim.viscosity import Rates, apply_viscosity


class PressureSolver(Solver):
    """Base of the solvers that find pressures by iteration.

    Attributes:
        courant: share of the support radius that the fastest expected particle crosses in a step.
    """

    courant = None

    def __init__(self, scene, solids, depth):
        """Args: the scene, its `Solids`, depth of the liquid at rest [m]."""
        super().__init__(scene, solids, depth)
        self._packing = packing(scene, 0.0)
        self._share = FIRST_SHARE

    def set_material(self, material):
        """Use another material from the next substep on."""
        self._material = material
        self.scales = solver_scales(material, self._scene, self._depth)

    def stable_time_step(self):
        """A step that keeps the scene stable [s], and what bounds it."""
        return stable_time_step(self._scene, self.scales, self._depth, self.courant)

    def state(self):
        """What a later step depends on beside the fluid, for a snapshot."""
        return {**super().state(), "share": self._share, "packing": self._packing}

    def set_state(self, state):
        """Inverse of `state`."""
        super().set_state(state)
        self._share, self._packing = state["share"], state["packing"]

    def pressures(self, fluid):
        """Pressures of the last substep [Pa], (N,) float32, rows as in `fluid`.

        That of the density and those that make surface tension, p + Kc (density - 1) + Kn
        (near_density - 1): in the bulk, the virial of all pairs (see `scales`).
        """
        if self._listed is not fluid or self._work.count != len(fluid):
            twin = fluid.copy()
            self._make_lists(twin)
            self._sum_densities()
            return twin.public(self.pressures(twin))[fluid.particle]
        sums, scales = self._work.sums, self.scales
        cohesive = scales.cohesion * (sums.density - 1.0) + scales.near * (sums.near_density - 1.0)
        return fluid.pressures + cohesive.astype(np.float32)

    def stages(self):
        """What the last substep made, in order."""
        return [*super().stages(), ("its pressure", self._work.scaled)]

    def _pressure_unit(self, time_step):
        """Scaled pressure [m^2] per pressure [Pa]: dt^2 / (rho0 virial)."""
        return time_step**2 / (self.scales.rest_density * self.scales.virial * self._packing)

    def _sum_densities(self):
        work = self._work
        search.sum_densities(
            work.columns,
            self._h,
            np.float32(self.scales.density_scale * self._packing),
            np.float32(self.scales.near_scale),
            work.contacts.density,
            work.pairs,
            work.sums,
        )

    def _tension(self, unit):
        return relax.Tension(
            np.float32(self.scales.cohesion * unit),
            np.float32(self.scales.near * unit),
            np.float32(self.scales.near_virial_ratio * self._packing),
            np.float32(self._material.adhesion),
        )

    def _pull_together(self, tension):
        """Displacements by surface tension, into `cohesive`."""
        work, scales = self._work, self.scales
        if scales.cohesion > 0.0:
            ratio = 1.5 * scales.near_scale / (scales.density_scale * self._packing)
            relax.cohesive_displacements(
                work.pairs,
                work.sums,
                work.contacts.gradients,
                tension,
                np.float32(ratio),
                work.cohesive,
            )
        else:
            work.cohesive[:] = 0.0

    def _iterate(self, densities, compliance, goal, displaced=False):
        """Pressures from the guess in `scaled`, and displacements; see `solve_pressures`."""
        work = self._work
        gradients = work.contacts.gradients
        relax.pressure_diagonal(work.sums, gradients, compliance, work.diagonal)
        self.iterations, self.density_error, self._share = solve_pressures(
            work, densities, gradients, compliance, goal, self._share, displaced
        )

    def _react_to_pressures(self, tension, time_step):
        """Book what the solids gave to the liquid by pressure and surface tension."""
        work = self._work
        touch.pressure_reactions(
            work.predicted,
            work.contacts,
            self._solids.motion,
            work.sums,
            work.scaled,
            tension,
            np.float32(self.scales.mass / time_step**2),
            work.reactions,
        )

    def _apply_viscosity(self, fluid, time_step):
        """Viscosity and friction, which change velocities only."""
        scales, friction = self.scales, self._material.wall_friction
        rates = Rates(
            slope=DENSITY_POWER * scales.density_scale * self._packing / float(self._h),
            linear=scales.viscous_rate * time_step,
            quadratic=scales.quadratic * time_step,
            neighbors=scales.neighbors,
            wall=scales.wall_layers * friction * scales.viscous_rate * time_step,
            wall_quadratic=friction * time_step / self._scene.spacing,
            inertia=scales.mass / time_step,
        )
        apply_viscosity(self._work, fluid.velocities, rates, self._solids.motion)
