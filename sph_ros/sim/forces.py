# SPDX-License-Identifier: Apache-2.0
"""The forces solver: the order of a step."""

import numpy as np

from sph_ros.core import forces
from sph_ros.core.wall_tables import POLY6_AND_SPIKY
from sph_ros.sim.force_scales import (
    force_factors,
    force_packing,
    force_scales,
    force_time_step,
    longest_steps,
    packed,
    wall_laplacians,
)
from sph_ros.sim.leapfrog_solver import LeapfrogSolver
from sph_ros.sim.state import family_of


class ForcesSolver(LeapfrogSolver):
    """Mueller, Charypar & Gross 2003: forces by weighted sums, leap-frog."""

    force_reach = 0.0625

    @classmethod
    def wall_weights(cls, scene):
        """See `Solver`."""
        return POLY6_AND_SPIKY

    def __init__(self, scene, solids, depth):
        """Args: the scene, its `Solids`, depth of the liquid at rest [m]."""
        super().__init__(scene, solids, depth)
        self._packing = force_packing(scene, 0.0)
        self._laplacians = wall_laplacians(scene)
        self._rows = self._state = _rows_for(0)

    def set_material(self, material):
        """Use another material from the next substep on; other liquids keep theirs."""
        super().set_material(material)
        self._liquids = [force_scales(m, self._scene, self._depth) for m in self.materials]
        self.scales = self._liquids[0]
        sound = max(liquid.sound_speed for liquid in self._liquids)
        self._lattice_factors = force_factors(material, self._scene, sound)

    def stable_time_step(self):
        """A step that keeps the scene stable [s], and what bounds it."""
        return force_time_step(self._scene, self._liquids, self._depth)

    def longest_step(self):
        """The longest substep [s] that present speeds and accelerations allow."""
        bounds = longest_steps(self._scene, self._liquids, self.fastest)
        return min(self._longest_for_forces(), *bounds.values())

    def state(self):
        """What a later step depends on beside the fluid, for a snapshot."""
        return {**super().state(), "packing": self._packing}

    def set_state(self, state):
        """Inverse of `state`."""
        super().set_state(state)
        self._packing = state["packing"]

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
        self._packing = force_packing(self._scene, time)
        self._clock("start")
        self._prepare(fluid)
        self._drift(fluid, time_step)
        self._sort(fluid, self._work.predicted, self._work.predicted)
        self._clock("sort")
        self._find_contacts(time_step, fluid.clearance)
        self._clock("solids")
        self._find_neighbors()
        self._clock("neighbors")
        self._sum_densities(fluid)
        self._clock("densities")
        self._find_accelerations(fluid, time_step)
        self._kick(fluid, time_step)
        self._rub(fluid, self.scales.viscosity / self.scales.rest_density, time_step)
        self._clock("forces")
        self._listed = fluid
        return self._mean_reactions(self._wall_pushes())

    def densities(self, fluid):
        """Densities at the present positions relative to rest [-], (N,), rows as in `fluid`."""
        # A sink that took something since the step left rows that the lists do not know.
        if self._listed is not fluid or self._work.count != len(fluid):
            twin = self._listed_twin(fluid)
            self._sum_densities(twin)
            return twin.public(self._state.density)[fluid.particle]
        return self._state.density.copy()

    def stages(self):
        """What the last substep made, in order."""
        work, state = self._work, self._state
        return [
            ("its predicted position", work.predicted),
            ("its density", state.density),
            ("the push of solids on it", work.contacts.gradients),
            ("its pressure", state.pressure),
        ]

    def _sum_densities(self, fluid):
        """Densities and pressures; before that, what else the forces depend on."""
        work = self._work
        if len(self._rows.density) < fluid.capacity:
            self._rows = _rows_for(fluid.capacity)
        self._state = state = forces.State(*(rows[: len(fluid)] for rows in self._rows))
        state.family[:] = family_of(fluid)
        for rows, name in (
            (state.viscosity, "viscosity"),
            (state.tension, "surface_tension"),
            (state.stiffness, "stiffness"),
        ):
            values = [getattr(liquid, name) for liquid in self._liquids]
            rows[:] = np.array(values, np.float32)[state.family]
        np.divide(np.float32(1.0), self.rest_densities(fluid), out=state.lightness)
        self._factors = packed(self._lattice_factors, self._packing)
        forces.sum_densities(
            work.predicted, fluid.velocities, self._h, self._factors, work.pairs, state
        )
        if len(self._solids):
            forces.add_walls(fluid.velocities, work.contacts, state)
        forces.pressures_from_densities(self._factors.damping, state)
        fluid.pressures[:] = state.pressure

    def _find_accelerations(self, fluid, time_step):
        """Accelerations by all forces at the new positions."""
        work, state = self._work, self._state
        accelerations = fluid.extras["accelerations"]
        forces.pair_forces(
            work.pairs,
            fluid.velocities,
            self._factors,
            work.contacts.gradients,
            state,
            accelerations,
        )
        self._pull_springs(fluid, time_step, 1.0, accelerations)
        common = self._gravity.astype(np.float64)
        if any(liquid.surface_tension > 0.0 for liquid in self._liquids):
            forces.colour_forces(
                work.pairs,
                work.contacts,
                self._laplacians,
                self._factors,
                state,
                accelerations,
                work.totals,
            )
            # The paper's surface forces push a drop along by themselves; together they must not.
            total = (1.0 / state.lightness.astype(np.float64)).sum()
            common -= work.totals.sum(axis=0) / max(total, 1e-300)
        accelerations += common.astype(np.float32)

    def _wall_pushes(self):
        """Wrenches of the walls' pressure at the new positions, (S, 6)."""
        work, scene = self._work, self._scene
        reactions = np.zeros_like(work.reactions)
        forces.pressure_reactions(
            work.predicted,
            work.contacts,
            self._solids.motion,
            np.float32(self._factors.push * scene.spacing**scene.dimension),
            self._state,
            reactions,
        )
        return reactions.sum(axis=0)


def _rows_for(count):
    """Rows for what the forces on so many particles depend on."""
    rows = [np.ones(count, np.float32) for _ in forces.State._fields[:-1]]
    return forces.State(*rows, np.zeros(count, np.uint8))
