# SPDX-License-Identifier: Apache-2.0
"""The forces solver: the order of a step."""

import math

import numpy as np

from sph_ros.core import contacts as touch
from sph_ros.core import forces, leapfrog
from sph_ros.core import neighbors as search
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
from sph_ros.sim.solver import Solver

#: A step may carry a particle that starts at rest with the strongest acceleration so far, in h:
#: dt <= sqrt(FORCE_REACH h / a) (Monaghan 1992).
FORCE_REACH = 0.0625

#: Viscous rate between liquid and a solid that fills the support, as a multiple of the viscosity
#: per squared spacing: the viscosity weight's Laplacian summed over the solid's half.
WALL_LAYERS = 6.0


class ForcesSolver(Solver):
    """Mueller, Charypar & Gross 2003: forces by weighted sums, leap-frog.

    The extra rows `accelerations` of the fluid are those at its positions; the first half of the
    next kick is theirs.
    """

    WEIGHTS = POLY6_AND_SPIKY

    def __init__(self, scene, solids, depth):
        """Args: the scene, its `Solids`, depth of the liquid at rest [m]."""
        super().__init__(scene, solids, depth)
        self._packing = force_packing(scene, 0.0)
        self._laplacians = wall_laplacians(scene)
        self._strongest = 0.0
        self._pushes = np.zeros((len(solids), 6))
        self._rows = self._state = _rows_for(0)

    def set_material(self, material):
        """Use another material from the next substep on."""
        self._material = material
        self.scales = force_scales(material, self._scene, self._depth)
        self._lattice_factors = force_factors(material, self._scene, self.scales.sound_speed)

    def stable_time_step(self):
        """A step that keeps the scene stable [s], and what bounds it."""
        return force_time_step(self._scene, [self.scales], self._depth)

    def longest_step(self):
        """The longest substep [s] that present speeds and accelerations allow."""
        bounds = longest_steps(self._scene, [self.scales], self.fastest)
        reach = FORCE_REACH * self._scene.support_radius
        if self._strongest > 0.0:
            bounds["accelerations"] = math.sqrt(reach / self._strongest)
        return min(bounds.values())

    def state(self):
        """What a later step depends on beside the fluid, for a snapshot."""
        own = {"strongest": self._strongest, "pushes": self._pushes.tolist()}
        return {**super().state(), **own, "packing": self._packing}

    def set_state(self, state):
        """Inverse of `state`."""
        super().set_state(state)
        self._strongest, self._packing = state["strongest"], state["packing"]
        self._pushes = np.array(state["pushes"]).reshape(len(self._solids), 6)

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
        self._prepare(fluid)
        self._clock("start")
        self._drift(fluid, time_step)
        self._sort(fluid)
        self._clock("sort")
        self._find_contacts(time_step, fluid.clearance)
        self._clock("solids")
        self._find_neighbors()
        self._clock("neighbors")
        self._sum_densities(fluid)
        self._clock("densities")
        self._find_accelerations(fluid)
        self._finish(fluid, time_step)
        self._clock("forces")
        self._listed = fluid
        return self._reactions()

    def densities(self, fluid):
        """Densities at the present positions relative to rest [-], (N,), rows as in `fluid`."""
        # A sink that took something since the step left rows that the lists do not know.
        if self._listed is not fluid or self._work.count != len(fluid):
            # Sort a copy: asking must not change the order of sums in later steps.
            twin = fluid.copy()
            self._prepare(twin)
            self._work.predicted[:] = twin.positions
            self._work.starts[:] = twin.positions
            self._sort(twin)
            self._find_contacts(1.0, np.zeros(len(twin), np.float32))
            self._find_neighbors()
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

    def _prepare_rows(self, fluid):
        """Scratch memory that fits, and what the forces depend on for each particle."""
        super()._prepare_rows(fluid)
        if len(self._rows.density) < fluid.capacity:
            self._rows = _rows_for(fluid.capacity)
        self._state = forces.State(*(rows[: len(fluid)] for rows in self._rows))
        if "accelerations" not in fluid.extras:
            fluid.extras["accelerations"] = np.tile(self._gravity, (len(fluid), 1))
        scales, state = self.scales, self._state
        state.lightness[:] = 1.0 / scales.rest_density
        state.viscosity[:] = scales.viscosity
        state.tension[:] = scales.surface_tension
        state.stiffness[:] = scales.stiffness
        self._factors = packed(self._lattice_factors, self._packing)

    def _drift(self, fluid, time_step):
        """Half a kick, then on; what would pass into a solid stops at it."""
        work = self._work
        leapfrog.kick_and_drift(
            fluid.positions,
            fluid.extras["accelerations"],
            np.float32(time_step),
            fluid.velocities,
            work.predicted,
        )
        if not len(self._solids):
            work.starts[:] = work.predicted
            return
        wanted, origins, solids = work.displacements, work.cohesive, self._solids
        wanted[:] = work.predicted
        origins[:] = fluid.positions
        self._keep_outside(
            fluid.positions,
            work.predicted,
            origins,
            fluid.clearance,
            solids.travel,
            solids.motion,
            time_step,
        )
        leapfrog.take_stops(
            fluid.positions,
            origins,
            wanted,
            work.predicted,
            np.float32(1.0 / time_step),
            fluid.velocities,
        )
        work.starts[:] = work.predicted

    def _sort(self, fluid):
        """Order all rows by cell of the new positions, which become those of the fluid."""
        velocities = fluid.velocities.copy()
        super()._sort(fluid)
        search.gather_rows(self._work.order, velocities, fluid.velocities)

    def _sum_densities(self, fluid):
        work, state = self._work, self._state
        forces.sum_densities(
            work.columns, fluid.velocities, self._h, self._factors, work.pairs, state
        )
        if len(self._solids):
            forces.add_walls(fluid.velocities, work.contacts, state)
        forces.pressures_from_densities(self._factors.damping, state)
        fluid.pressures[:] = state.pressure

    def _find_accelerations(self, fluid):
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
        common = self._gravity.astype(np.float64)
        if state.tension.max(initial=0.0) > 0.0:
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
            common -= work.totals.sum(axis=0) / (1.0 / state.lightness.astype(np.float64)).sum()
        accelerations += common.astype(np.float32)

    def _finish(self, fluid, time_step):
        """Half a kick, and friction along the solids."""
        work = self._work
        leapfrog.kick(
            fluid.extras["accelerations"],
            np.float32(time_step),
            fluid.velocities,
            work.errors,
            work.strongest,
        )
        self.fastest = math.sqrt(work.errors.max(initial=0.0))
        self._strongest = math.sqrt(work.strongest.max(initial=0.0))
        if not len(self._solids):
            return
        friction, spacing = self._material.wall_friction, self._scene.spacing
        kinematic = self.scales.viscosity / self.scales.rest_density
        touch.rub_on_solids(
            work.predicted,
            work.contacts,
            self._solids.motion,
            np.float32(WALL_LAYERS * friction * kinematic / spacing**2 * time_step),
            np.float32(friction * time_step / spacing),
            np.float32(self.scales.mass / time_step),
            fluid.velocities,
            work.reactions,
        )

    def _reactions(self):
        """Wrenches on the solids: of sweep and friction, and of both half kicks' pressures."""
        work, scene = self._work, self._scene
        others = work.reactions.sum(axis=0)
        work.reactions[:] = 0.0
        forces.pressure_reactions(
            work.predicted,
            work.contacts,
            self._solids.motion,
            np.float32(self._factors.push * scene.spacing**scene.dimension),
            self._state,
            work.reactions,
        )
        before, self._pushes = self._pushes, work.reactions.sum(axis=0)
        return others + 0.5 * (before + self._pushes)


def _rows_for(count):
    """Rows for what the forces on so many particles depend on."""
    rows = [np.ones(count, np.float32) for _ in forces.State._fields[:-1]]
    return forces.State(*rows, np.zeros(count, np.uint8))
