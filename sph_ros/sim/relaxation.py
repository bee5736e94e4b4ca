# SPDX-License-Identifier: Apache-2.0
"""The relaxation solver: the order of a step."""

import numpy as np

from sph_ros.core import contacts as touch
from sph_ros.core import neighbors as search
from sph_ros.core import relaxation as relax
from sph_ros.core.weights import DENSITY_POWER
from sph_ros.sim.pressure import FIRST_SHARE, solve_pressures
from sph_ros.sim.scales import packing, solver_scales, stable_time_step
from sph_ros.sim.solver import Solver
from sph_ros.sim.viscosity import apply_viscosity

#: Pressure iterations end when the mean density error is below this share of the allowed
#: compression. Looser, the errors keep a tank at rest in motion.
TOLERANCE = 0.02

#: Viscosity between liquid and a solid that fills the support, as a multiple of that of one
#: neighbour: (1 - r/h) summed over the layers of the lattice in its place, a third of it along the
#: wall.
WALL_LAYERS = 10.0


class RelaxationSolver(Solver):
    """Clavet's double density relaxation with the pressure solved implicitly."""

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
        return stable_time_step(self._scene, self.scales, self._depth)

    def state(self):
        """What a later step depends on beside the fluid, for a snapshot."""
        return {**super().state(), "share": self._share, "packing": self._packing}

    def set_state(self, state):
        """Inverse of `state`."""
        super().set_state(state)
        self._share, self._packing = state["share"], state["packing"]

    def step(self, fluid, time, time_step):
        """Advance `fluid` by one substep; the solids' motion must already be set.

        Args:
            fluid: changed in place.
            time: since the start of the simulation [s].
            time_step: [s].

        Returns:
            Force [N] and torque [N m] of the liquid on each solid, (S, 6) float64.

        Raises:
            UnstableError: a position is not a number.
        """
        self._prepare(fluid)
        self._packing = packing(self._scene, time)
        self._clock("start")
        self._predict(fluid, time_step)
        self._sort(fluid)
        self._clock("sort")
        self._find_contacts(time_step, fluid.clearance)
        self._clock("solids")
        self._find_neighbors()
        self._clock("neighbors")
        self._sum_densities()
        self._clock("densities")
        self._relax(fluid, time_step)
        self._clock("pressure")
        self._finish(fluid, time_step)
        self._clock("finish")
        self._apply_viscosity(fluid, time_step)
        self._clock("viscosity")
        self._listed = fluid
        return self._work.reactions.sum(axis=0)

    def densities(self, fluid):
        """Densities at the present positions relative to rest [-], (N,), rows as in `fluid`.

        Right after a step its lists and walls serve; they are off by the last displacement only.
        """
        # A sink that took something since the step left rows that the lists do not know.
        if self._listed is not fluid or self._work.count != len(fluid):
            # Sort a copy: asking must not change the order of sums in later steps.
            twin = fluid.copy()
            self._make_lists(twin)
            return twin.public(self.densities(twin))[fluid.particle]
        work = self._work
        density = np.empty(len(fluid), np.float32)
        search.densities_of_pairs(
            fluid.positions,
            work.predicted,
            self._h,
            np.float32(self.scales.density_scale * self._packing),
            work.contacts.density,
            work.contacts.gradients,
            work.pairs,
            density,
        )
        return density

    def _make_lists(self, fluid):
        """Sort a liquid that no step has sorted yet, and find its neighbours and contacts."""
        self._prepare(fluid)
        work = self._work
        work.predicted[:] = fluid.positions
        work.starts[:] = fluid.positions
        self._sort(fluid)
        self._find_contacts(1.0, np.zeros(len(fluid), np.float32))
        self._find_neighbors()
        self._listed = fluid

    def _predict(self, fluid, time_step):
        """Move on with gravity; what would pass into a solid stops at it."""
        work = self._work
        relax.predict_positions(
            fluid.positions,
            fluid.velocities,
            self._gravity,
            np.float32(time_step),
            work.predicted,
        )
        work.starts[:] = fluid.positions
        travel = self._solids.travel
        self._keep_outside(
            fluid.positions,
            work.predicted,
            work.starts,
            fluid.clearance,
            travel,
            self._solids.motion,
            time_step,
        )

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

    def _relax(self, fluid, time_step):
        """Displacements by cohesion and by the pressures that they end up with."""
        work, scales = self._work, self.scales
        gradients = work.contacts.gradients
        unit = time_step**2 / (scales.rest_density * scales.virial * self._packing)
        tension = self._tension(unit)
        if scales.cohesion > 0.0:
            ratio = 1.5 * scales.near_scale / (scales.density_scale * self._packing)
            relax.cohesive_displacements(
                work.pairs, work.sums, gradients, tension, np.float32(ratio), work.cohesive
            )
        else:
            work.cohesive[:] = 0.0
        compliance = np.float32(1.0 / (scales.stiffness * unit))
        relax.pressure_diagonal(work.sums, gradients, compliance, work.diagonal)
        np.multiply(fluid.pressures, np.float32(unit), out=work.scaled)
        goal = TOLERANCE * self._material.compression
        self.iterations, self.density_error, self._share = solve_pressures(
            work, gradients, compliance, goal, self._share
        )
        np.divide(work.scaled, np.float32(unit), out=fluid.pressures)
        touch.pressure_reactions(
            work.predicted,
            work.contacts,
            self._solids.motion,
            work.sums,
            work.scaled,
            tension,
            np.float32(scales.mass / time_step**2),
            work.reactions,
        )

    def _finish(self, fluid, time_step):
        """Relaxed positions outside all solids, and the velocities that follow from them."""
        work = self._work
        relax.finish_positions(
            work.predicted, work.displacements, np.float32(0.5) * self._h, work.starts
        )
        ends = work.starts
        still = self._solids.motion._replace(
            old_position=self._solids.motion.position, old_rotation=self._solids.motion.rotation
        )
        # From the predicted position, which is beside the solids as they are now.
        self._keep_outside(
            work.predicted, ends, fluid.positions, fluid.clearance, 0.0, still, time_step
        )
        relax.velocities_from_positions(
            fluid.positions, ends, np.float32(1.0 / time_step), fluid.velocities, work.errors
        )
        self.fastest = float(np.sqrt(work.errors.max(initial=0.0)))
        fluid.positions[:] = ends

    def _apply_viscosity(self, fluid, time_step):
        """Viscosity and friction, which change velocities only."""
        work, scales = self._work, self.scales
        slope = DENSITY_POWER * scales.density_scale * self._packing / float(self._h)
        apply_viscosity(
            work,
            fluid.velocities,
            slope,
            scales.viscous_rate * time_step,
            scales.quadratic * time_step,
        )
        if len(self._solids):
            touch.rub_on_solids(
                work.predicted,
                work.contacts,
                self._solids.motion,
                np.float32(
                    WALL_LAYERS * self._material.wall_friction * scales.viscous_rate * time_step
                ),
                np.float32(self._material.wall_friction * time_step / self._scene.spacing),
                np.float32(scales.mass / time_step),
                fluid.velocities,
                work.reactions,
            )
