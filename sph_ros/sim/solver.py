# SPDX-License-Identifier: Apache-2.0
"""What all solvers do alike: sorting, neighbours, contacts, and stopping particles at solids."""

import math
import time

import numpy as np

from sph_ros.core import contacts as touch
from sph_ros.core import neighbors as search
from sph_ros.core import sheet_contacts as sheets
from sph_ros.core.chunks import chunk_count
from sph_ros.core.rows import bounding_box
from sph_ros.core.wall_tables import POWERS
from sph_ros.sim.abilities import alike
from sph_ros.sim.guards import UnstableError
from sph_ros.sim.scales import viscous_rate
from sph_ros.sim.springs import Springs
from sph_ros.sim.state import Workspace, family_of, make_grid

#: Distance that particles keep from solids, as a share of the spacing.
MARGIN = 0.05


class Solver:
    """Base of the solvers. One that a scene can name has `step`, `densities`, `set_material` too.

    Attributes:
        scales: the numbers of the material; all solvers' have `mass` [kg] and `rest_density`.
        iterations: of the last substep; 0 where a solver does not iterate.
        density_error: mean density error left in the last substep [-].
        fastest: speed of the fastest particle [m/s].
        squeezed: particles rescued from between solids since somebody set it to 0.
        timings: milliseconds of the last step by part.
    """

    @classmethod
    def wall_weights(cls, scene):
        """The two weights that walls act with in a scene."""
        return POWERS

    def __init__(self, scene, solids, depth):
        """Args: the scene, its `Solids`, depth of the liquid at rest [m]."""
        self._scene = scene
        self._solids = solids
        self._depth = depth
        # Pieces that differ in color alone are of the same liquid to a solver.
        self._unlike = [not alike(material, scene.material) for material in scene.liquids]
        self._mixed = any(self._unlike)
        self._gravity = np.array(scene.gravity, np.float32)
        if scene.dimension == 2:
            self._gravity[1] = 0.0
        self._h = np.float32(scene.support_radius)
        self._work = Workspace(0, len(solids), solids.slots)
        self._packing = 1.0
        self._listed = None
        self._springs = Springs(scene)
        self.iterations = 0
        self.density_error = 0.0
        self.fastest = 0.0
        self.squeezed = 0
        self.timings = {}
        self.set_material(scene.material)

    def set_material(self, material):
        """Use another material from the next substep on; the scene's other liquids keep theirs."""
        self._material = material

    def _pull_springs(self, fluid, time_step, per_pull, pulls):
        """Add what the springs of the liquid pull, if it has any.

        Args:
            fluid: its springs yield, break and form.
            time_step: [s].
            per_pull: 1 for accelerations, time_step^2 for displacements.
            pulls: [m/s^2] or [m], (N, 3); added to.
        """
        material = self._material
        if material.elasticity == 0.0:
            self._springs.forget(fluid)
            return
        rate = viscous_rate(material.elasticity / material.density, self._scene)
        self._springs.pull(fluid, self._work, material, per_pull * rate, time_step, pulls)

    @property
    def materials(self):
        """Of all liquids; the index is the family of their particles."""
        pairs = zip(self._unlike, self._scene.liquids, strict=True)
        return [liquid if unlike else self._material for unlike, liquid in pairs]

    def rest_densities(self, fluid):
        """Rest density of each particle [kg/m^3], (N,) float32, rows as in `fluid`."""
        if not self._mixed:
            return np.full(len(fluid), self._material.density, np.float32)
        table = np.array([material.density for material in self.materials], np.float32)
        return table[family_of(fluid)]

    def masses(self, fluid):
        """Mass of each particle [kg] (2D: per metre of depth), (N,) float32, rows as in `fluid`."""
        return self.rest_densities(fluid) * np.float32(self._scene.spacing**self._scene.dimension)

    def _weigh(self, fluid):
        """Keep the masses of the rows as they are now, where they differ."""
        if self._mixed:
            self._work.masses[:] = self.masses(fluid)

    def _scaled_masses(self, factor):
        """Masses of the rows times a factor, (N,) float32, for kernels."""
        work, scene = self._work, self._scene
        if self._mixed:
            return np.multiply(work.masses, np.float32(factor), out=work.scales)
        work.scales[:] = self._material.density * scene.spacing**scene.dimension * factor
        return work.scales

    def longest_step(self):
        """The longest substep [s] that the present accelerations allow."""
        return math.inf

    def pressures(self, fluid):
        """Pressures of the last substep [Pa], (N,) float32, rows as in `fluid`."""
        return fluid.pressures

    def stages(self):
        """What the last substep made, in the order it did: [(words, rows as in the fluid)].

        When something is no number, the first of them that shows it is named as the cause.
        """
        return [
            ("its predicted position", self._work.predicted),
            ("its density", self._work.sums.density),
            ("the push of solids on it", self._work.contacts.gradients),
        ]

    def state(self):
        """What a later step depends on beside the fluid, for a snapshot."""
        return {
            "fastest": self.fastest,
            "iterations": self.iterations,
            "density_error": self.density_error,
            "squeezed": self.squeezed,
        }

    def set_state(self, state):
        """Inverse of `state`."""
        self.fastest, self.iterations = state["fastest"], state["iterations"]
        self.density_error, self.squeezed = state["density_error"], state["squeezed"]

    def _prepare(self, fluid):
        """Scratch memory that fits, and its running totals at zero."""
        self._prepare_rows(fluid)
        self._work.reactions[:] = 0.0

    def _prepare_rows(self, fluid):
        """Scratch memory that fits."""
        if self._work.capacity < fluid.capacity:
            self._work = Workspace(fluid.capacity, len(self._solids), self._solids.slots)
        if self._work.count != len(fluid):
            self._work.fit(len(fluid))
        self._weigh(fluid)

    def _clock(self, part):
        now = time.perf_counter()
        if part == "start":
            self._passed = now
            return
        self.timings[part] = self.timings.get(part, 0.0) + 1e3 * (now - self._passed)
        self._passed = now

    def bounce(self, fluid, time_step):
        """Impulses of open surfaces with restitution or friction on what meets them in a substep.

        Args:
            fluid: its velocities are changed.
            time_step: of the substep [s].

        Returns:
            Force [N] and torque [N m] on each solid, (S, 6) float64.
        """
        solids = self._solids
        reactions = np.zeros((max(chunk_count(len(fluid)), 1), len(solids), 6))
        if len(solids.sheets.solid) and solids.sheets.bounce.any():
            sheets.bounce_off_sheets(
                fluid.positions,
                fluid.velocities,
                fluid.clearance,
                self._gravity,
                np.float32(time_step),
                np.float32(solids.travel),
                solids.sheets,
                solids.motion,
                np.float32(MARGIN * self._scene.spacing),
                self.masses(fluid),
                reactions,
            )
        return reactions.sum(axis=0)

    def _keep_outside(self, starts, ends, origins, clearance, travel, motion, time_step):
        """Stop particles on their way from `starts` to `ends` at the solids in `motion`."""
        solids = self._solids
        if not len(solids):
            return
        paths = starts, ends, clearance, motion, time_step
        self._keep_out_of_bodies(*paths, origins, travel)
        if len(solids.sheets.solid):
            self._stop_at_sheets(*paths)
            if len(solids.sheets.solid) < len(solids):
                # What a sheet held back may be in a body now. Sheets have the last word: a body
                # gives back what is in it, a sheet does not.
                self._keep_out_of_bodies(*paths, origins, travel)
                self._stop_at_sheets(*paths)

    def _stop_at_sheets(self, starts, ends, clearance, motion, time_step):
        sheets.stop_at_sheets(
            starts,
            ends,
            clearance,
            self._solids.sheets,
            motion,
            np.float32(MARGIN * self._scene.spacing),
            self._scaled_masses(1.0 / time_step**2),
            self._work.reactions,
        )

    def _keep_out_of_bodies(self, starts, ends, clearance, motion, time_step, origins, travel):
        work, scene = self._work, self._scene
        work.squeezed[:] = 0
        touch.keep_outside(
            starts,
            ends,
            origins,
            clearance,
            np.float32(travel),
            self._solids.packed,
            motion,
            np.float32(MARGIN * scene.spacing),
            np.float32(scene.spacing),
            scene.dimension == 2,
            self._scaled_masses(1.0 / time_step**2),
            work.reactions,
            work.squeezed,
        )
        self.squeezed += int(work.squeezed.sum())

    def _grid(self, positions):
        lower, upper = np.empty(3, np.float32), np.empty(3, np.float32)
        bad = bounding_box(positions, lower, upper)
        if bad >= 0:
            raise UnstableError(f"row {bad}: its position is {positions[bad]}")
        return make_grid(lower, upper, float(self._h), self._work.count)

    def _sort(self, fluid, starts, ends):
        """Order all rows by cell.

        Args:
            fluid: its rows are put in the new order.
            starts: what its positions are to be, in the old order [m], (N, 3).
            ends: the positions that are sorted by [m], (N, 3); those become `predicted` and
                `columns` of the workspace.
        """
        work = self._work
        self._grid_now = grid = self._grid(ends)
        search.sort_by_cell(ends, grid, work.cell_of, work.order)
        fluid.reorder(starts, ends, work)
        work.predicted, work.scratch = work.scratch, work.predicted
        self._weigh(fluid)

    def _find_contacts(self, time_step, clearance, motion=None):
        """Contacts with the solids at the end of `motion`, the present one unless given."""
        work = self._work
        if len(self._solids):
            touch.find_contacts(
                work.predicted,
                clearance,
                self._solids.packed,
                self._solids.sheets,
                motion or self._solids.motion,
                np.float32(1.0 / time_step),
                np.float32(self._packing),
                work.chunks,
                work.slots,
                work.contacts,
            )

    def _find_neighbors(self):
        work = self._work
        while search.find_neighbors(work.columns, self._grid_now, self._h, work.chunks, work.pairs):
            work.enlarge_pairs()
        if len(self._solids.sheets.solid):
            sheets.part_pairs(
                work.columns,
                self._solids.sheets,
                self._solids.motion,
                work.contacts,
                work.chunks,
                work.pairs,
            )
