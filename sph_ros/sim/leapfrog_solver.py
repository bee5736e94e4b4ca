# SPDX-License-Identifier: Apache-2.0
"""What the solvers share that step by leap-frog: `forces`, `lennard_jones` and `none`."""

import math

import numpy as np

from sph_ros.core import contacts as touch
from sph_ros.core import leapfrog
from sph_ros.core import neighbors as search
from sph_ros.core.wall_tables import POWERS
from sph_ros.core.weights import DENSITY_POWER, lattice_sum
from sph_ros.sim.solver import Solver

#: Viscous rate between liquid and a solid that fills the support, as a multiple of the kinematic
#: viscosity per squared spacing: the viscosity weight's Laplacian summed over the solid's half.
WALL_LAYERS = 6.0


class LeapfrogSolver(Solver):
    """Base of the solvers that step by leap-frog.

    The extra rows `accelerations` of the fluid are those at its positions; the first half of the
    next kick is theirs.
    """

    #: A step may carry a particle that starts at rest with the strongest acceleration so far, in h.
    force_reach = None

    def __init__(self, scene, solids, depth):
        """Args: the scene, its `Solids`, depth of the liquid at rest [m]."""
        super().__init__(scene, solids, depth)
        self._strongest = 0.0
        self._pushes = np.zeros((len(solids), 6))

    def state(self):
        """What a later step depends on beside the fluid, for a snapshot."""
        own = {"strongest": self._strongest, "pushes": self._pushes.tolist()}
        return {**super().state(), **own}

    def set_state(self, state):
        """Inverse of `state`."""
        super().set_state(state)
        self._strongest = state["strongest"]
        self._pushes = np.array(state["pushes"]).reshape(len(self._solids), 6)

    def _longest_for_forces(self):
        """The longest substep [s] for the strongest acceleration (Monaghan 1992)."""
        if self._strongest == 0.0:
            return math.inf
        return math.sqrt(self.force_reach * self._scene.support_radius / self._strongest)

    def _prepare_rows(self, fluid):
        """Scratch memory that fits, and accelerations of gravity alone where there are none yet."""
        super()._prepare_rows(fluid)
        if "accelerations" not in fluid.extras:
            fluid.extras["accelerations"] = np.tile(self._gravity, (len(fluid), 1))

    def _drift(self, fluid, time_step):
        """Half a kick, then on; what would pass into a solid stops at it.

        New positions are in the workspace, as `predicted` and `starts`.
        """
        work, solids = self._work, self._solids
        if len(solids.bodies):
            self._push_bodies()
            solids.finish()
        leapfrog.kick_and_drift(
            fluid.positions,
            fluid.extras["accelerations"],
            np.float32(time_step),
            fluid.velocities,
            work.predicted,
        )
        if len(solids):
            wanted, origins = work.displacements, work.cohesive
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
            self._push_bodies()

    def _kick(self, fluid, time_step):
        """The second half of the kick."""
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

    def _rub(self, fluid, kinematic, time_step):
        """Friction along the solids by a kinematic viscosity [m^2/s] and by roughness."""
        if not len(self._solids):
            return
        work, friction = self._work, self._material.wall_friction
        touch.rub_on_solids(
            work.predicted,
            work.contacts,
            self._solids.motion,
            np.float32(WALL_LAYERS * friction * kinematic / self._scene.spacing**2 * time_step),
            np.float32(friction * time_step / self._scene.spacing),
            self._scaled_masses(1.0 / time_step),
            fluid.velocities,
            work.reactions,
        )
        self._push_bodies()

    def _push_bodies(self):
        """Let free bodies have what the liquid did to them since the last call.

        Forces of the step's start act on them for the whole step; the liquid feels the mean of both
        ends. The difference does not add up.
        """
        if len(self._solids.bodies):
            self._solids.bodies.take(self._pushes + self._work.reactions.sum(axis=0))

    def _mean_reactions(self, pushes):
        """Wrenches of a substep, (S, 6): of sweep and friction, and of both half kicks' pushes.

        Args:
            pushes: wrenches of the forces of walls at the new positions, (S, 6).
        """
        before, self._pushes = self._pushes, pushes
        return self._work.reactions.sum(axis=0) + 0.5 * (before + pushes)

    def _listed_twin(self, fluid):
        """A copy of the fluid, sorted, its neighbours and contacts in the workspace.

        Asking for something must not change the order of sums in later steps.
        """
        twin = fluid.copy()
        self._prepare_rows(twin)
        self._sort(twin, twin.positions, twin.positions)
        self._find_contacts(1.0, np.zeros(len(twin), np.float32))
        self._find_neighbors()
        self._listed = None
        return twin

    def _clavet_densities(self, fluid):
        """Densities for solvers that need none themselves, rows as in `fluid`."""
        twin, work = self._listed_twin(fluid), self._work
        h, s, d = self._scene.support_radius, self._scene.spacing, self._scene.dimension
        scales = [np.float32(1.0 / lattice_sum(power, h, s, d)) for power in POWERS]
        search.sum_densities(
            work.predicted,
            self._h,
            np.float32(DENSITY_POWER),
            *scales,
            work.contacts.density,
            work.chunks,
            work.pairs,
            work.sums,
        )
        return twin.public(work.sums.density)[fluid.particle]
