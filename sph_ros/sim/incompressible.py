# SPDX-License-Identifier: Apache-2.0
"""The incompressible solver: the order of a step."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from sph_ros.core import pressure as core
from sph_ros.core import projection as project
from sph_ros.core.weights import DENSITY_POWER, NEAR_POWER, SMOOTH_POWER
from sph_ros.sim.liquid import initial_length
from sph_ros.sim.pressure import Goal
from sph_ros.sim.pressure_solver import PressureSolver
from sph_ros.sim.scales import (
    MELTING_TIME,
    density_power,
    expected_speed,
    packing,
    stable_time_step,
    viscous_rate,
)
from sph_ros.sim.surface_tension import SurfaceTension, noticeable, ripple_step


class Pace(NamedTuple):
    """How far a step may go; see `PACES`.

    Attributes:
        courant: share of the support radius that the fastest expected particle crosses in a step.
            In a still tank sqrt(2 p / rho) crosses as much, and now and then an eighth more.
        surge: share of the support radius that sqrt(2 p / rho) crosses in a substep, with p the
            pressure that all but `PEAKS` of the particles stay below. A pressure is stiff against
            shear like p / h^2; particles that are pushed, not dropped, have one that their speed
            says nothing about.
        corrected: share of an excess of density that a step of the longest stable length takes
            back; shorter ones take back less, in proportion, since a way that is made in less time
            is a higher speed. All of it at once would turn every error of the iteration into
            velocity.
        calming: kinematic viscosity that the lattice needs to stay calm, per spacing and expected
            speed. Nothing else damps a symplectic step. Liquids that are thicker by themselves get
            none of it.
    """

    courant: float
    surge: float
    corrected: float
    calming: float


#: By the power of the density's weight. With the third one a tank boils from a surge of 0.55 on,
#: and goes on boiling once it does; no shear strength damps it.
PACES = {
    DENSITY_POWER: Pace(courant=0.53, surge=0.7, corrected=0.4, calming=0.005),
    SMOOTH_POWER: Pace(courant=0.4, surge=0.5, corrected=0.2, calming=0.005),
}

#: Share of the particles whose pressures do not count for the length of a step, and of how many at
#: most they are looked at.
PEAKS, SAMPLE = 0.005, 8192

#: Iterations end when the mean density error is this share of what the first guess left, at least
#: `CALM` and at most 1 times the material's `compression`.
ERROR_SHARE, CALM = 0.4, 0.05

#: Largest mean density error after a step, as a share of (h / L)^2 with L the depth of the liquid
#: (where there is no gravity its length). An error e that is as long as the liquid is paid back by
#: a pressure of about rho e (L / (pi dt))^2. It is stable up to rho (h / dt)^2 / 4, so
#: the finer the liquid is resolved the less error it stands, however short the step.
STEEPEST = 1.0

#: Particles below this density, or pressed by less than a layer's weight, are at a free surface;
#: there is one if so many are [-].
SURFACE_DENSITY, SURFACE_SHARE = 0.85, 0.01


class IncompressibleSolver(PressureSolver):
    """Pressures that hold the density of the next positions; see `core.projection`."""

    def __init__(self, scene, solids, depth):
        """Args: the scene, its `Solids`, depth of the liquid at rest [m]."""
        self._pace = PACES[density_power(scene)]
        self.courant = self._pace.courant
        super().__init__(scene, solids, depth)
        self._pressed = 0.0
        length = depth or initial_length(scene)
        self._most_error = STEEPEST * (scene.support_radius / max(length, 1e-9)) ** 2

    @classmethod
    def wall_weights(cls, scene):
        """See `Solver`."""
        return density_power(scene), NEAR_POWER

    def stable_time_step(self):
        """A step that keeps the scene stable [s], and what bounds it."""
        ripples = math.inf
        if self._surface:
            ripples = ripple_step(self._material, self._scene.spacing)
        rest = self._depth, self.courant, ripples
        # Springs ask for short steps, but an excess of density has as long to go as without them.
        bare = dataclasses.replace(self.scales, elasticity=0.0)
        self._longest, _ = stable_time_step(self._scene, bare, *rest)
        return stable_time_step(self._scene, self.scales, *rest)

    def longest_step(self):
        """The longest substep [s] that the present pressures allow."""
        speed = math.sqrt(2.0 * self._pressed / self.scales.rest_density)
        return self._pace.surge * float(self._h) / speed if speed > 0.0 else math.inf

    def state(self):
        """What a later step depends on beside the fluid, for a snapshot."""
        return {**super().state(), "pressed": self._pressed}

    def set_state(self, state):
        """Inverse of `state`."""
        super().set_state(state)
        self._pressed = state["pressed"]

    def set_material(self, material):
        """Use another material from the next substep on."""
        super().set_material(material)
        scene = self._scene
        kinematic = self._pace.calming * scene.spacing * expected_speed(scene, self._depth)
        least = viscous_rate(kinematic, scene)
        self.scales = dataclasses.replace(
            self.scales, viscous_rate=max(self.scales.viscous_rate, least), cohesion=0.0, near=0.0
        )
        self._surface = None
        if noticeable(material, scene):
            self._surface = SurfaceTension(scene, density_power(scene))

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
        self._clock("start")
        motion = self._solids.motion
        if self._listed is not fluid:
            # The solids have already been moved on; the liquid is still beside their old poses.
            before = motion._replace(position=motion.old_position, rotation=motion.old_rotation)
            self._make_lists(fluid, before)
        work = self._work
        work.reactions[:] = 0.0
        project.contact_velocities(
            work.predicted, motion, np.float32(1.0 / time_step), work.contacts
        )
        self._couple(self._solids.bodies.inertias.centre, time_step)
        self._apply_viscosity(fluid, time_step)
        self._clock("viscosity")
        self._project(fluid, time_step)
        self._clock("pressure")
        self._move(fluid, time_step)
        self._clock("finish")
        loosest = packing(self._scene, MELTING_TIME)
        if self._packing < loosest and self._has_room(fluid):
            # Where it got room late, no faster than it melts: all at once it would leap.
            most = loosest - packing(self._scene, 0.0)
            grown = self._packing + most * time_step / MELTING_TIME
            self._packing = min(packing(self._scene, time + time_step), grown)
        if self._scene.emitters or self._scene.sinks:
            self._listed = None  # particles may come and go before the next step
        else:
            self._make_lists(fluid)
        return work.reactions.sum(axis=0)

    def _has_room(self, fluid):
        """Whether the liquid can take more room than the lattice it started on.

        Flowed liquid packs less well. Where it has no room for that, because it fills a closed
        container, it is pressed everywhere, and the rest density stays that of the lattice.
        """
        layer = (
            self.scales.rest_density * float(np.linalg.norm(self._gravity)) * self._scene.spacing
        )
        free = (self._work.sums.density < SURFACE_DENSITY) | (fluid.pressures < layer)
        return np.count_nonzero(free) > SURFACE_SHARE * len(fluid)

    def densities(self, fluid):
        """Densities at the present positions relative to rest [-], (N,), rows as in `fluid`."""
        if self._listed is not fluid:
            # Sort a copy: asking must not change the order of sums in later steps.
            twin = fluid.copy()
            self._clock("start")
            self._make_lists(twin)
            return twin.public(self._work.sums.density)[fluid.particle]
        return self._work.sums.density.copy()

    def _make_lists(self, fluid, motion=None):
        """Sort by cell; contacts, neighbours and densities at the present positions.

        Args:
            fluid: sorted in place.
            motion: the solids are where it ends; the present one unless given.
        """
        self._prepare_rows(fluid)
        self._sort(fluid, fluid.positions, fluid.positions)
        self._clock("sort")
        self._find_contacts(math.inf, fluid.clearance, motion)
        self._clock("solids")
        self._find_neighbors()
        self._clock("neighbors")
        self._sum_densities()
        self._clock("densities")
        self._listed = fluid

    def _apply_viscosity(self, fluid, time_step):
        """Viscosity and friction; what is thick rubs with the speeds that it is about to have.

        Velocities lack what gravity and pressure will add in this step. Where friction holds the
        liquid within a step, that is no longer little: it would flow on as a plug. So the last
        pressures and gravity act first and are taken off again (the incremental splitting of Van
        Kan 1986).
        """
        if not self._rates(time_step).implicit:
            super()._apply_viscosity(fluid, time_step)
            return
        work, unit = self._work, self._pressure_unit(time_step)
        self._guess_pressures(fluid, unit)
        work.cohesive[:] = self._gravity * np.float32(time_step**2)
        # `starts` has no other use between the lists and the next positions.
        core.pressure_displacements(
            work.pairs,
            work.scaled,
            work.contacts,
            work.cohesive,
            work.starts,
        )
        work.starts *= np.float32(1.0 / time_step)
        fluid.velocities += work.starts
        super()._apply_viscosity(fluid, time_step)
        fluid.velocities -= work.starts

    def _project(self, fluid, time_step):
        """Displacements in this step under all forces, pressures included."""
        work = self._work
        unit = self._pressure_unit(time_step)
        if self._coupling is not None:
            self._coupling.predict()
        self._pull_together(time_step)
        self._pull_springs(fluid, time_step, time_step**2, work.cohesive)
        self._push_bodies(self._solids.bodies.inertias.centre)
        dt = np.float32(time_step)
        pulled = self._surface is not None or self._material.elasticity > 0.0
        project.push(fluid.velocities, self._gravity, dt, pulled, work.cohesive)
        self._guess_pressures(fluid, unit)
        pace = min(time_step / self._longest, 1.0)
        core.pressure_displacements(
            work.pairs,
            work.scaled,
            work.contacts,
            work.cohesive,
            work.displacements,
        )
        project.density_targets(
            work.predicted,
            work.displacements,
            self._h,
            np.float32(self._power),
            np.float32(self.scales.density_scale * self._packing),
            work.pairs,
            work.sums.density,
            work.contacts,
            np.float32(self._pace.corrected * pace),
            np.float32(pace),
            dt,
            work.targets,
            work.residuals,
        )
        allowed = self._material.compression
        most = min(allowed, self._most_error)
        goal = Goal(min(CALM * allowed, ERROR_SHARE * most), ERROR_SHARE, most)
        self._iterate(work.targets, np.float32(0.0), goal, time_step, work.residuals)
        np.divide(work.scaled, np.float32(unit), out=fluid.pressures)
        if len(fluid):
            sample = fluid.pressures[:: -(-len(fluid) // SAMPLE)]
            rank = int((1.0 - PEAKS) * (len(sample) - 1))
            self._pressed = float(np.partition(sample, rank)[rank])
        self._push_bodies(self._solids.bodies.inertias.centre)

    def _pull_together(self, time_step):
        """Displacements by surface tension, into `cohesive`, and the reactions to them."""
        if self._surface and self._work.count:
            motion, mass = self._solids.motion, self.scales.mass
            self._surface.displace(
                self._work, self._grid_now, motion, self._material, mass, time_step
            )
        elif self._material.elasticity > 0.0:
            self._work.cohesive[:] = 0.0  # for the springs to add to

    def _move(self, fluid, time_step):
        """New positions, outside all solids, and velocities."""
        work = self._work
        inverse_step = np.float32(1.0 / time_step)
        ends, wanted, origins = work.predicted, work.starts, work.scratch
        project.move(
            fluid.positions,
            work.cohesive,
            work.displacements,
            self._h,
            inverse_step,
            ends,
            wanted,
            origins,
            fluid.velocities,
        )
        solids = self._solids
        solids.finish()
        self._keep_outside(
            fluid.positions,
            ends,
            origins,
            fluid.clearance,
            solids.travel,
            solids.motion,
            time_step,
        )
        self._push_bodies()
        project.take_stops(
            fluid.positions,
            origins,
            wanted,
            ends,
            inverse_step,
            work.sums.density,
            fluid.velocities,
            work.errors,
        )
        self.fastest = float(np.sqrt(work.errors.max(initial=0.0)))
