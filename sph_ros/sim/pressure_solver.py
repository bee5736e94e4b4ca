# SPDX-License-Identifier: Apache-2.0
"""What the solvers that iterate on pressures share: `relaxation` and `incompressible`."""

import numpy as np

from sph_ros.core import contacts as touch
from sph_ros.core import neighbors as search
from sph_ros.core import pressure as core
from sph_ros.core import relaxation as relax
from sph_ros.sim.coupling import Coupling
from sph_ros.sim.pressure import UNKNOWN, jacobi_share, solve_pressures
from sph_ros.sim.scales import density_power, packing, solver_scales, stable_time_step
from sph_ros.sim.solver import Solver
from sph_ros.sim.spins import turn_liquid
from sph_ros.sim.stress import Weights, virial_pressures, walls_share
from sph_ros.sim.viscosity import Rates, apply_viscosity

#: For the part of the push on solids that is pressure alone.
NO_TENSION = relax.Tension(*[np.float32(0.0)] * 4)


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
        self._power = density_power(scene)
        self._most_share = jacobi_share(
            scene.support_radius, scene.spacing, scene.dimension, self._power
        )
        self._share = self._most_share
        self._coupling = None

    def set_material(self, material):
        """Use another material from the next substep on."""
        super().set_material(material)
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
        """Pressures of the last substep [Pa], (N,) float32, rows as in `fluid`."""
        if self._listed is not fluid or self._work.count != len(fluid):
            twin = fluid.copy()
            self._make_lists(twin)
            self._sum_densities()
            return twin.public(self.pressures(twin))[fluid.particle]
        sums, scales, scene = self._work.sums, self.scales, self._scene
        weights = Weights(
            float(self._h),
            self._power,
            self._power * scales.density_scale * self._packing / float(self._h),
            self._near_ratio(),
            scales.virial * self._packing,
            walls_share(self._power, scene.support_radius, scene.spacing, scene.dimension),
            scene.dimension,
        )
        tension = scales.cohesion * (sums.density - 1.0) - scales.near
        near = scales.near * scales.near_virial_ratio * self._packing * sums.near_density
        return virial_pressures(self._work, weights, fluid.pressures + tension, near)

    def _near_ratio(self):
        """Near gradient per gradient and (1 - r/h) of a pair [-]."""
        return 1.5 * self.scales.near_scale / (self.scales.density_scale * self._packing)

    def stages(self):
        """What the last substep made, in order."""
        return [*super().stages(), ("its pressure", self._work.scaled)]

    def _pressure_unit(self, time_step):
        """Scaled pressure [m^2] per pressure [Pa]: dt^2 / (rho0 virial)."""
        return time_step**2 / (self.scales.rest_density * self.scales.virial * self._packing)

    def _guess_pressures(self, fluid, unit):
        """Let iterations begin with the last pressures; `unit` is the present one."""
        work = self._work
        core.scale_guess(fluid.pressures, np.float32(unit), work.scaled, work.guesses, work.first)

    def _sum_densities(self):
        work = self._work
        search.sum_densities(
            work.predicted,
            self._h,
            np.float32(self._power),
            np.float32(self.scales.density_scale * self._packing),
            np.float32(self.scales.near_scale),
            work.contacts.density,
            work.chunks,
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

    def _pull_together(self, tension, time_step):
        """Displacements by surface tension, into `cohesive`, and the reactions to them."""
        work, scales = self._work, self.scales
        if scales.cohesion > 0.0:
            relax.cohesive_displacements(
                work.pairs,
                work.sums,
                work.contacts.gradients,
                tension,
                np.float32(self._near_ratio()),
                work.cohesive,
            )
            work.guesses[:] = 0.0
            self._book_push(work.guesses, tension, time_step)
        else:
            work.cohesive[:] = 0.0

    def _couple(self, centres, time_step):
        """Collect the contacts with free bodies, whose centres of mass (B, 3) are as given."""
        bodies, work = self._solids.bodies, self._work
        self._coupling = None
        if len(bodies):
            self._coupling = Coupling(
                bodies,
                work.contacts,
                work.predicted,
                centres,
                impulse_scale=self.scales.mass / time_step,
                motion_scale=time_step,
                yielded=work.yielded,
            )

    def _push_bodies(self, centres=None):
        """Let the free bodies have what was booked since the last call."""
        if len(self._solids.bodies):
            self._solids.bodies.take(self._work.reactions.sum(axis=0), centres)

    def _iterate(self, densities, compliance, goal, time_step, residuals=UNKNOWN):
        """Pressures from the guess in `scaled`, displacements and the solids' reactions.

        See `solve_pressures`. Free bodies must have had all pushes but this.
        """
        work = self._work
        core.pressure_diagonal(work.sums, work.contacts, compliance, work.diagonal)
        if self._coupling is not None:
            self._coupling.add_diagonal(work.diagonal)
        self.iterations, self.density_error, self._share = solve_pressures(
            work,
            densities,
            compliance,
            goal,
            self._share,
            self._most_share,
            self._coupling,
            residuals,
        )
        self._book_push(work.scaled, NO_TENSION, time_step)

    def _book_push(self, pressures, tension, time_step):
        """Book what the solids gave to the liquid by pressures [m^2] and surface tension."""
        work = self._work
        if not len(self._solids):
            return
        touch.pressure_reactions(
            work.predicted,
            work.contacts,
            self._solids.motion,
            work.sums,
            pressures,
            tension,
            np.float32(self.scales.mass / time_step**2),
            work.reactions,
        )

    def _rates(self, time_step):
        """How strongly the liquid rubs in a substep, `Rates`."""
        scales, friction = self.scales, self._material.wall_friction
        return Rates(
            support_radius=self._scene.support_radius,
            linear=scales.viscous_rate * time_step,
            quadratic=scales.quadratic * time_step,
            neighbors=scales.neighbors,
            wall=scales.wall_layers * friction * scales.viscous_rate * time_step,
            wall_quadratic=friction * time_step / self._scene.spacing,
            inertia=scales.mass / time_step,
        )

    def _apply_viscosity(self, fluid, time_step):
        """Viscosity and friction, which change velocities only."""
        rates = self._rates(time_step)
        if self._coupling is not None:
            # Free solids are dragged along by what they will rub on.
            self._coupling.drag_along(
                fluid.velocities, rates.wall, rates.wall_quadratic, self.scales.mass
            )
        apply_viscosity(self._work, fluid, rates, self._solids.motion)
        self._turn(fluid, time_step)

    def _turn(self, fluid, time_step):
        """Flywheels that let vortices live longer, where the liquid has them."""
        radius = self._material.gyration_radius
        longest, _ = self.stable_time_step() if radius > 0.0 else (time_step, "")
        scale = self.scales.density_scale * self._packing
        steps = time_step / longest
        turn_liquid(fluid, self._work, self._scene, self._power, scale, radius, steps)
