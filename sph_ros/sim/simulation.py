# SPDX-License-Identifier: Apache-2.0
"""A scene that runs: particles and solids through time."""

import dataclasses
import math

import numpy as np

from sph_ros.core.rows import all_finite, farthest_coordinates, put_particles
from sph_ros.core.surface import extract_surface
from sph_ros.sim.abilities import alike, faults
from sph_ros.sim.emitters import Emitters
from sph_ros.sim.guards import Guard, UnstableError, rescue_folder, rescue_name, tamed
from sph_ros.sim.jets import capacity
from sph_ros.sim.kernels import ensure_compiled, needs, needs_of_material
from sph_ros.sim.liquid import families, fill_blocks
from sph_ros.sim.materials import changed
from sph_ros.sim.scales import scene_depth
from sph_ros.sim.scene import load_scene
from sph_ros.sim.scene_types import Scene
from sph_ros.sim.shapes import Container
from sph_ros.sim.sinks import Sinks
from sph_ros.sim.snapshots import read_snapshot, write_snapshot
from sph_ros.sim.solids import Solids
from sph_ros.sim.solvers import SOLVER_CLASSES
from sph_ros.sim.state import FAMILY, Fluid, family_of

#: What `Simulation.particles` tells of each.
PARTICLE = np.dtype(
    [(name, np.float32) for name in ("x", "y", "z", "vx", "vy", "vz", "density")]
    + [("id", np.uint32)]
)

#: A substep may carry a solid by so many spacings and a particle by so many support radii.
SOLID_REACH, PARTICLE_REACH = 0.75, 0.8

#: Substeps in a step for the sake of speeds, at most; rather than more, solids are slowed down.
MOST_SUBSTEPS = 8


class Simulation:
    """A liquid among solids, stepped in time.

    Arrays of particles have a row for each particle, in the order of their ids. Without emitters
    and sinks row i is the same particle for ever; emitted particles are appended with new ids,
    removed ones leave no gap and their ids are never given again.

    Attributes:
        scene: the `Scene` it was made from.
        time_step: of one `step` [s].
        time_step_reason: what bounds an automatic time step, in words.
        time: simulated time [s].
        material: the present material.
        capacity: there are never more particles at once.
        timings: milliseconds of the last step by part.
        notes: lines about parameters that had to be tamed, for people.
    """

    def __init__(self, scene):
        """Set up `scene`: a Scene, or whatever `load_scene` takes.

        Raises:
            SceneError: something in the scene is wrong.
        """
        self.scene = scene if isinstance(scene, Scene) else load_scene(scene)
        ensure_compiled(needs(self.scene))
        self.material = self.scene.material
        self._solids = Solids(
            self.scene, SOLVER_CLASSES[self.scene.solver].wall_weights(self.scene)
        )
        self._start()

    def _start(self):
        """First state: the liquid of the scene, solids at their first poses."""
        positions, velocities, blocks = fill_blocks(self.scene)
        depth = scene_depth(self.scene, positions)
        self.capacity = capacity(self.scene, len(positions))
        self._fluid = Fluid(positions, velocities, capacity=self.capacity)
        if len(self.scene.liquids) > 1:
            self._fluid.extras[FAMILY] = families(self.scene, blocks)
        self._next_id = len(positions)
        self._emitters = Emitters(self.scene)
        self._sinks = Sinks(self.scene, self._solids, positions)
        self._solver = SOLVER_CLASSES[self.scene.solver](self.scene, self._solids, depth)
        self._use_material(self.material)
        self.time_step, self.time_step_reason = self._choose_time_step()
        self._steps = 0
        self._substeps = 1
        self._reach = None  # that no particle is farther from the origin of the world [m]
        self._reactions = np.zeros((len(self._solids), 6))
        self._densities = None
        self._guard = Guard()
        self._fault = None
        self.timings = {}

    def _choose_time_step(self):
        """The scene's time step, or one that keeps it stable, and why."""
        if self.scene.time_step is not None:
            return self.scene.time_step, "given by the scene"
        return self._solver.stable_time_step()

    def _use_material(self, material):
        """Hand a material to the solver; the longest stable substep goes with it."""
        self.material = material
        used, self.notes = tamed(material, self.scene, self._stable_step_of)
        others = [other for other in self.scene.liquids if not alike(other, self.scene.material)]
        for field, fault in faults(self.scene, [material, *others]):
            used = dataclasses.replace(used, **{field: 0.0})
            self.notes.append(f"{field}: {fault}; 0 is used")
        ensure_compiled(needs_of_material(used, self.scene))
        self._stable_step, _ = self._stable_step_of(used)

    def _stable_step_of(self, material):
        """The longest stable step with a material [s], and why; the solver has it from now on."""
        self._solver.set_material(material)
        return self._solver.stable_time_step()

    # ---------------------------------------------------------------- time

    @property
    def time(self):
        """Simulated time [s]."""
        return self._steps * self.time_step

    def step(self):
        """Advance by one time step, in as many substeps as the speeds need.

        Raises:
            UnstableError: something is no longer a number; names step, particle, cause and the file
                with the state before. Nothing is stepped from then on, until `reset`.
        """
        if self._fault is not None:
            raise self._fault
        self._guard.remember(self._fluid, self._numbers(), self._solids)
        try:
            self._step()
            arrays = self._fluid.positions, self._fluid.velocities, self._reactions
            good = all(all_finite(rows) for rows in arrays)
        except UnstableError:
            good = False
        if not good:
            self._fault = self._stop()
            raise self._fault
        self._steps += 1
        self._densities = None

    def _stop(self):
        """Save the state before the step that failed; the error that says so."""
        stages = self._solver.stages()
        particle, cause = self._guard.failure(self._fluid, stages, self._reactions)
        number = self._steps + 1
        where = f"step {number} (from {self.time:.6g} s on)"
        if particle is not None:
            where += f": particle {particle}"
            cause = f"{cause}; {self._guard.describe(particle)}"
        path = rescue_folder() / rescue_name(self.scene.name, number)
        try:
            write_snapshot(path, self.scene, self.material, *self._guard.snapshot())
            kept = f"the state before this step is in {path}"
        except OSError as error:
            path, kept = None, f"the state before this step could not be written ({error})"
        return UnstableError(f"{where}: {cause}; {kept}", number, particle, cause, path)

    def _step(self):
        count = self._substep_count()
        duration = self.time_step / count
        # Solids must not be faster than the liquid can follow.
        fastest = min(self.scene.max_solid_speed, SOLID_REACH * self.scene.spacing / duration)
        self._solver.timings = {}
        self._solver.squeezed = 0
        self._reactions[:] = 0.0
        for part in range(count):
            now = self.time + part * duration
            self._solids.advance(now, duration, fastest, self._reach)
            self._next_id = self._emitters.advance(self._fluid, self._solids, now, self._next_id)
            self._reactions += self._solver.bounce(self._fluid, duration) / count
            self._reactions += self._solver.step(self._fluid, now, duration) / count
            self._reach = self._sinks.advance(self._fluid, now + duration)
        self.timings = self._solver.timings
        self._substeps = count

    def _substep_count(self):
        """Substeps that keep solids and particles within their reach, and the liquid stable."""
        dt = self.time_step
        if self._reach is None:
            self._reach = math.hypot(*farthest_coordinates(self._fluid.positions))
        ahead = self._solids.distance_ahead(self.time, dt, self.scene.max_solid_speed, self._reach)
        particle = max(self._solver.fastest, self._emitters.fastest(self.time)) * dt
        wanted = max(
            ahead / (SOLID_REACH * self.scene.spacing),
            particle / (PARTICLE_REACH * self.scene.support_radius),
        )
        for_speed = min(max(math.ceil(wanted - 1e-6), 1), MOST_SUBSTEPS)
        stable = min(self._stable_step, self._solver.longest_step())
        return max(for_speed, math.ceil(dt / stable - 1e-6))

    def advance(self, seconds):
        """Advance by whole steps until at least `seconds` [s] more are simulated."""
        if not (math.isfinite(seconds) and seconds >= 0.0):
            raise ValueError(f"seconds: expected a finite number not below 0, got {seconds!r}")
        for _ in range(math.ceil(seconds / self.time_step - 1e-6)):
            self.step()

    def reset(self):
        """Back to time zero: the scene's liquid, the scene's poses; the present material stays."""
        self._solids.reset()
        self._fluid = self._solver = self._guard = None  # their memory is needed now
        self._start()

    def save(self, path):
        """Write the whole state to one file; `Simulation.load` goes on from it to the bit."""
        numbers = {**self._numbers(), "solids": {s.name: s.state() for s in self._solids}}
        arrays = {**self._fluid.arrays(), "densities": self._relative_densities()}
        write_snapshot(path, self.scene, self.material, arrays, numbers)

    def _numbers(self):
        """What a snapshot holds beside arrays and solids."""
        return {
            "steps": self._steps,
            "time_step": [self.time_step, self.time_step_reason],
            "substeps": self._substeps,
            "reactions": self._reactions.tolist(),
            "solver": self._solver.state(),
            "next_id": self._next_id,
            "emitters": self._emitters.state(),
            "sinks": self._sinks.state(),
            "bodies": self._solids.bodies.state(),
        }

    @classmethod
    def load(cls, path):
        """A simulation that goes on from a file of `save`.

        Raises:
            SnapshotError: the file is missing, damaged or something else.
        """
        scene, material, arrays, numbers = read_snapshot(path)
        simulation = cls(scene)
        simulation._fluid = Fluid.of_arrays(arrays, simulation.capacity)
        simulation._densities = arrays["densities"]
        simulation._use_material(material)
        simulation._solver.set_state(numbers["solver"])
        simulation._next_id = numbers["next_id"]
        simulation._emitters.set_state(numbers["emitters"])
        simulation._sinks.set_state(numbers["sinks"])
        simulation._steps = numbers["steps"]
        simulation.time_step, simulation.time_step_reason = numbers["time_step"]
        simulation._substeps = numbers["substeps"]
        simulation._reach = None
        simulation._reactions[:] = np.reshape(numbers["reactions"], (-1, 6))
        simulation._solids.set_state(numbers)
        return simulation

    # ---------------------------------------------------------------- liquid

    @property
    def particle_count(self):
        """Number of particles."""
        return len(self._fluid)

    @property
    def positions(self):
        """Positions [m], world frame, (N, 3) float32; a copy."""
        return self._fluid.public(self._fluid.positions)

    @property
    def velocities(self):
        """Velocities [m/s], world frame, (N, 3) float32; a copy."""
        return self._fluid.public(self._fluid.velocities)

    @property
    def densities(self):
        """Densities at the present positions [kg/m^3], (N,) float32; a copy."""
        rest = self._solver.rest_densities(self._fluid)
        return self._fluid.public(self._relative_densities() * rest)

    @property
    def ids(self):
        """Number of each particle, given once and never again, (N,) uint32; a copy."""
        return self._fluid.ids.copy()

    @property
    def particles(self):
        """All of the above in one, (N,) structured: float32 x y z vx vy vz density, uint32 id."""
        fluid = self._fluid
        result = np.empty(len(fluid), PARTICLE)
        densities = self._relative_densities() * self._solver.rest_densities(fluid)
        put_particles(
            fluid.positions,
            fluid.velocities,
            densities,
            fluid.ids,
            fluid.particle,
            result.view(np.uint32).reshape(-1, len(PARTICLE)),
        )
        return result

    @property
    def families(self):
        """Index into `scene.liquids` of each particle's liquid, (N,) uint8; a copy."""
        return self._fluid.public(family_of(self._fluid))

    @property
    def pressures(self):
        """Pressures of the last step [Pa], surface tension's own included, (N,) float32; a copy."""
        return self._fluid.public(self._solver.pressures(self._fluid))

    def _relative_densities(self):
        if self._densities is None:
            self._densities = self._solver.densities(self._fluid)
        return self._densities

    def set_material(self, **fields):
        """Change fields of the material at once.

        Raises:
            ValueError: an unknown field, or a value out of its range; nothing is changed then.
        """
        self._use_material(changed(self.material, **fields))

    def surface(self):
        """The liquid's surface as triangles.

        Returns:
            vertices (V, 3) float32 [m], triangles (T, 3) int32, counter-clockwise seen from
            outside; both empty where there is no liquid.
        """
        vertices, triangles, _ = extract_surface(
            self.positions,
            self.scene.spacing,
            support_radius=self.scene.support_radius,
            dimension=self.scene.dimension,
        )
        return vertices, triangles

    # ---------------------------------------------------------------- solids

    @property
    def solid_names(self):
        """Names of the solids, in the scene's order."""
        return self._solids.names

    def solid(self, name):
        """The solid called `name`: its pose, velocities and signed_distance().

        Raises:
            KeyError: there is none.
        """
        return self._solids[name]

    def move_solid(self, name, position, quat_xyzw=(0.0, 0.0, 0.0, 1.0), time=None):
        """Let a solid sweep to a pose.

        It moves steadily and arrives at `time`, but no point of it is faster than the scene's
        `max_solid_speed`, so it may arrive later. Orders for later times queue up; one that is not
        later than those that wait replaces them.

        Args:
            name: of a solid whose control is `topic` or `path`.
            position: of its origin, world frame [m], (3,).
            quat_xyzw: world from solid; normalised here.
            time: simulated time of arrival [s]; None or a past one: the end of the next step.

        Raises:
            KeyError: there is no such solid.
            ValueError: the solid is fixed or free, or the pose is not finite, or the quaternion is
                zero.
        """
        solid = self._solids[name]
        if solid.control == "fixed":
            raise ValueError(f"{name}: this solid is fixed; give it `control: topic` to move it")
        if solid.control == "free":
            raise ValueError(
                f"{name}: this solid is free: the liquid, gravity and touches move it; give it "
                "`control: topic` to move it by poses"
            )
        soonest = self.time + self.time_step
        if time is None or time < soonest:
            time = soonest
        elif not math.isfinite(time):
            raise ValueError(f"{name}: time: expected a finite number, got {time!r}")
        solid.order(float(time), position, quat_xyzw)

    def wrench(self, name):
        """Force and torque of the liquid on a solid, averaged over the last step.

        Momentum that the solid gave to the liquid in the step, per second and with the opposite
        sign. Not booked are particles rescued from between solids (`squeezed_particles`) and
        displacements cut at half a support radius: both happen only where solids crush liquid.

        Returns:
            force (3,) [N] and torque (3,) about the solid's origin [N m], world frame, float64. In
            2D per metre of depth.

        Raises:
            KeyError: there is no such solid.
        """
        self._solids[name]
        row = self._reactions[self._solids.names.index(name)]
        return row[:3].copy(), row[3:].copy()

    # ---------------------------------------------------------------- facts

    def statistics(self):
        """Facts of the present state.

        Returns:
            dict with time [s], particle_count, mean_compression and max_compression (density above
            rest over rest density, -), kinetic_energy [J], momentum (3,) [kg m/s], mean_speed and
            max_speed [m/s], emitted_particles and removed_particles (by sinks) since the start,
            lost_particles (those outside a container or no longer finite, and those that were
            removed because they got far away from everything), squeezed_particles (rescued from
            between solids in the last step), substeps and iterations of the last step,
            density_error (mean, left by the last iteration, -), solid_momentum (3,) [kg m/s] and
            solid_energy (kinetic, [J]) of the free solids. In 2D energies and momenta are per metre
            of depth.
        """
        velocities = self._fluid.velocities.astype(np.float64)
        mass = self._solver.masses(self._fluid).astype(np.float64)
        excess = np.maximum(self._relative_densities() - 1.0, 0.0)
        square = np.einsum("ij,ij->i", velocities, velocities)
        solid_momentum, solid_energy = self._solids.bodies.facts()
        return {
            "time": self.time,
            "particle_count": len(self._fluid),
            "mean_compression": float(excess.mean()) if len(excess) else 0.0,
            "max_compression": float(excess.max(initial=0.0)),
            "kinetic_energy": 0.5 * float(np.einsum("i,i->", mass, square)),
            "momentum": np.einsum("i,ij->j", mass, velocities),
            "mean_speed": float(np.sqrt(square).mean()) if len(square) else 0.0,
            "max_speed": math.sqrt(float(square.max(initial=0.0))),
            "emitted_particles": self._emitters.emitted,
            "removed_particles": self._sinks.removed,
            "lost_particles": self._sinks.lost + self._lost_count(),
            "squeezed_particles": self._solver.squeezed,
            "substeps": self._substeps,
            "iterations": self._solver.iterations,
            "density_error": self._solver.density_error,
            "solid_momentum": solid_momentum,
            "solid_energy": solid_energy,
        }

    def _lost_count(self):
        """Particles that are outside some container by more than half a spacing, or not finite."""
        lost = ~np.isfinite(self._fluid.positions).all(axis=1)
        for solid in self._solids:
            if isinstance(solid.shape, Container):
                distance = solid.signed_distance(self._fluid.positions)
                lost |= distance < -0.5 * self.scene.spacing
        return int(lost.sum())
