# SPDX-License-Identifier: Apache-2.0
"""The relaxation solver: the order of a step."""

import math

import numpy as np

from sph_ros.core import neighbors as search
from sph_ros.core import relaxation as relax
from sph_ros.sim.pressure import Goal
from sph_ros.sim.pressure_solver import PressureSolver
from sph_ros.sim.scales import packing

#: Pressure iterations end when the mean density error is below this share of the allowed
#: compression. Looser, the errors keep a tank at rest in motion.
TOLERANCE = 0.02

#: The guess from the last step is late by one. What iterations leave of that error feeds sound; the
#: implicit step damps sound by half of it at the same rate. So they leave no more than this share,
SOUND_SHARE = 0.25

#: unless it is below this share of the allowed compression, times the share of the liquid's depth
#: that sound crosses in a step. With `TOLERANCE` alone a deep tank in short steps rings for ever.
SOUND_TOLERANCE = 0.025

#: Share of the support radius that the fastest expected particle crosses in a step.
COURANT = 0.4


class RelaxationSolver(PressureSolver):
    """Clavet's double density relaxation with the pressure solved implicitly."""

    courant = COURANT

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
        self._sort(fluid, self._work.starts, self._work.predicted)
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
        self._push_bodies()
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
        self._sort(fluid, fluid.positions, fluid.positions)
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

    def _relax(self, fluid, time_step):
        """Displacements by cohesion and by the pressures that they end up with."""
        work = self._work
        unit = self._pressure_unit(time_step)
        tension = self._tension(unit)
        self._pull_together(tension, time_step)
        self._pull_springs(fluid, time_step, time_step**2, work.cohesive)
        self._couple(self._solids.bodies.centre, time_step)
        self._push_bodies()
        compliance = np.float32(1.0 / (self.scales.stiffness * unit))
        self._guess_pressures(fluid, unit)
        self._iterate(work.sums.density, compliance, self._goal(time_step), time_step)
        np.divide(work.scaled, np.float32(unit), out=fluid.pressures)
        self._push_bodies()

    def _goal(self, time_step):
        """When the pressure iterations end."""
        least = most = TOLERANCE
        if self._depth > 0.0:
            sound = math.sqrt(self.scales.stiffness / self.scales.rest_density)
            least = min(most, SOUND_TOLERANCE * sound * time_step / self._depth)
        compression = self._material.compression
        return Goal(least * compression, SOUND_SHARE, most * compression)

    def _finish(self, fluid, time_step):
        """Relaxed positions outside all solids, and the velocities that follow from them."""
        work = self._work
        relax.finish_positions(
            work.predicted, work.displacements, np.float32(0.5) * self._h, work.starts
        )
        ends = work.starts
        # From the predicted position, which is beside the solids as they were until now.
        motion, travel = self._solids.finish()
        self._keep_outside(
            work.predicted, ends, fluid.positions, fluid.clearance, travel, motion, time_step
        )
        relax.velocities_from_positions(
            fluid.positions, ends, np.float32(1.0 / time_step), fluid.velocities, work.errors
        )
        self.fastest = float(np.sqrt(work.errors.max(initial=0.0)))
        fluid.positions[:] = ends
