# SPDX-License-Identifier: Apache-2.0
"""A simulation as the node uses it: stepped, timed, its wrenches summed, its faults survived."""

import math
import time

import numpy as np

from sph_ros.sim.simulation import Simulation


class Runner:
    """One simulation and what the node needs to know about its course.

    All methods must be called from one thread at a time; reading `fault` is safe from any.

    Attributes:
        sim: the Simulation.
        fault: what went wrong in a step, in words; None while all is well.
        steps: taken since the start of the process.
        busy: time spent in them [s].
        part_times: running mean of the milliseconds of a step, by part.
    """

    def __init__(self, scene, material):
        """Set up `scene` with the fields of `material` replaced.

        Raises:
            SceneError: something in the scene is wrong.
        """
        self.steps, self.busy = 0, 0.0
        self.replace(Simulation(scene))
        self.sim.set_material(**material)

    def replace(self, sim):
        """Run another Simulation from now on."""
        self.sim = sim
        self.fault = None
        self.part_times = {}
        self._clear_wrenches()

    def step(self):
        """One time step; an exception becomes `fault`. Returns whether it went well."""
        begin = time.perf_counter()
        try:
            self.sim.step()
        except Exception as error:  # whatever it is, the node must stay reachable
            self.fail(error)
            return False
        self._count(time.perf_counter() - begin)
        for index, name in enumerate(self.sim.solid_names):
            force, torque = self.sim.wrench(name)
            self._wrenches[index, :3] += force
            self._wrenches[index, 3:] += torque
        self._wrench_steps += 1
        return True

    def fail(self, error):
        """Note what went wrong; nothing is stepped until the next reset."""
        self.fault = f"{type(error).__name__}: {error}"

    def reset(self):
        """Back to the scene's start; mends a fault."""
        self.sim.reset()
        self.fault = None
        self._clear_wrenches()

    def move(self, order, duration):
        """Let a solid reach a pose in `duration` [s] of simulated time.

        Args:
            order: an `Order`.
            duration: less than a time step means by the end of the next one.
        """
        arrival = self.sim.time + duration
        self.sim.move_solid(order.solid, order.position, order.quat_xyzw, time=arrival)

    def take_wrenches(self):
        """Mean wrenches since the last call, (solids, 6): force [N], torque [N m]; then start over.

        Summed over all publications they are the momentum that the liquid gave, nothing lost
        between. Without a step in between the last ones stand.
        """
        if self._wrench_steps > 0:
            self._mean_wrenches = self._wrenches / self._wrench_steps
            self._wrenches[:] = 0.0
            self._wrench_steps = 0
        return self._mean_wrenches

    def statistics(self):
        """`Simulation.statistics()`; numbers that cannot be had after a fault are NaN."""
        try:
            return self.sim.statistics()
        except Exception:
            if self.fault is None:
                raise
            keys = ("mean_compression", "max_compression", "kinetic_energy", "max_speed")
            return {
                "time": self.sim.time,
                "particle_count": self.sim.particle_count,
                **dict.fromkeys(("emitted_particles", "removed_particles", "lost_particles"), 0),
                **dict.fromkeys(keys, math.nan),
            }

    def _count(self, seconds):
        self.steps += 1
        self.busy += seconds
        for part, milliseconds in self.sim.timings.items():
            mean = self.part_times.get(part, milliseconds)
            self.part_times[part] = mean + 0.1 * (milliseconds - mean)

    def _clear_wrenches(self):
        count = len(self.sim.solid_names)
        self._wrenches = np.zeros((count, 6))
        self._mean_wrenches = np.zeros((count, 6))
        self._wrench_steps = 0
