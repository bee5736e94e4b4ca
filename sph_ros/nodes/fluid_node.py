# SPDX-License-Identifier: Apache-2.0
"""``fluid_node``: a liquid that pose messages stir, in real time, by the ROS clock or in lockstep.

Three threads: the executor's for callbacks, the driver's, which alone touches the simulation, and
one for the surface. In lockstep there is the first one only.

Time: in `realtime` and `lockstep` stamps are simulated time, beginning at zero. In `clock` they are
times of the ROS clock. When that clock jumps back, the liquid starts over as it did at first, since
whatever comes then (a bag that loops, a simulator that was reset) is another run.
"""

import sys
from functools import partial

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from sph_ros.nodes.diagnostics import (
    SLOW,
    Speedometer,
    diagnostic_array,
    fluid_status,
    pose_status,
)
from sph_ros.nodes.drivers import LockstepDriver, ThreadDriver
from sph_ros.nodes.help_texts import help_text
from sph_ros.nodes.parameters import MATERIAL_PREFIX, ParameterError, Settings, declare_all
from sph_ros.nodes.pose_inbox import PoseInbox
from sph_ros.nodes.publications import Publications
from sph_ros.nodes.runner import Runner
from sph_ros.nodes.running import run_node
from sph_ros.nodes.schedules import ClockSchedule, WallSchedule
from sph_ros.nodes.surface_worker import SurfaceWorker
from sph_ros.nodes.unheard import UnheardPoses
from sph_ros.sim.scene import SceneError, load_scene
from sph_ros.sim.simulation import Simulation
from sph_ros.waiting import tell_while_waiting, warm_up, words

#: Warnings of one kind are at least so far apart [s].
WARNING_PERIOD = 5.0


class FluidNode(Node):
    """The simulation node, named `fluid`. Compiled and running when the constructor returns.

    Args:
        kwargs: for `rclpy.node.Node`.

    Raises:
        SceneError: something in the scene is wrong.
        ParameterError: a parameter cannot be used.
    """

    def __init__(self, **kwargs):
        super().__init__("fluid", **kwargs)
        self._driver = self._prepared = None
        try:
            self._set_up()
        except BaseException:
            super().destroy_node()
            raise

    def _set_up(self):
        self._settings = Settings(self)
        scene_name, self._step_mode = self._settings.declare_first()
        with tell_while_waiting(self._tell):
            scene = load_scene(scene_name)
            self._settings.declare_live(scene.material, self._step_mode)
            self._runner = Runner(scene, self._settings.material())
            warm_up(self._runner.sim)
        self._publications = Publications(self, self._runner)
        self._surfaces = SurfaceWorker(self._publications.surface, self._warn_of_surface)
        self._inbox, self._driver = self._make_driver()
        self._apply_settings()
        self._settings.follow(self._apply_settings, self._prepare_scene)
        self._inbox.open(scene)
        self._create_services()
        self._create_diagnostics()
        self._introduce()
        if self._step_mode != "lockstep":
            self._surfaces.start()
        self._driver.start()

    def destroy_node(self):
        """End the threads first: they publish."""
        if self._driver is not None:
            self._driver.stop()
            self._surfaces.stop()
        super().destroy_node()

    # ---------------------------------------------------------------- start

    def _tell(self, seconds):
        self.get_logger().info(words(seconds))

    def _introduce(self):
        sim = self._runner.sim
        more = f" (at most {sim.capacity})" if sim.scene.emitters else ""
        self.get_logger().info(
            f"{sim.scene.name}: {sim.particle_count} particles{more}, "
            f"step {sim.time_step * 1e3:.3g} ms ({sim.time_step_reason}), {self._step_mode}"
        )
        for note in sim.notes:
            self.get_logger().warning(note)

    def _make_driver(self):
        """A PoseInbox and the driver for what comes in."""
        if self._step_mode == "lockstep":
            driver = LockstepDriver(self._runner, self._publish, self._log_fault)
            return PoseInbox(self, driver.order), driver
        catch_up = self._settings["max_catch_up"]
        if self._step_mode == "clock":
            clock = self.get_clock()
            schedule = ClockSchedule(lambda: clock.now().nanoseconds, catch_up)
        else:
            schedule = WallSchedule(self._settings["speed"], catch_up)
        self._schedule, inbox = schedule, PoseInbox(self)
        return inbox, ThreadDriver(
            self._runner, schedule, inbox.take, self._publish, self._log_fault, self._clock_jumped
        )

    def _create_services(self):
        # A group of its own: services wait for the end of a step, others must not wait with them.
        group = ReentrantCallbackGroup()
        self.create_service(Trigger, "~/reset", self._on_reset, callback_group=group)
        self.create_service(Trigger, "~/step", self._on_step, callback_group=group)
        self.create_service(SetBool, "~/pause", self._on_pause, callback_group=group)

    def _create_diagnostics(self):
        self._speedometer = Speedometer(self._runner)
        self._refused_before = {}
        self._unheard = UnheardPoses(self)
        self._skipped_before = 0.0
        self._report = None
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Once a second of real time: diagnostics must come when /clock stands still, too.
        self.create_timer(1.0, self._diagnose, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # ---------------------------------------------------------------- parameters

    def _apply_settings(self, names=None):
        """Put accepted parameters to use; None means all."""
        settings, driver = self._settings, self._driver
        driver.publish_period = 1.0 / settings["publish_rate"]
        driver.surface_period = 1.0 / settings["surface_rate"]
        driver.smoothing_time = settings["smoothing_time"]
        if self._step_mode != "lockstep":
            self._schedule.max_catch_up = settings["max_catch_up"]
        if self._step_mode == "realtime":
            self._schedule.speed = settings["speed"]
        if names is not None and "scene" in names:
            self._change_scene(names)
        elif names is not None and any(name.startswith(MATERIAL_PREFIX) for name in names):
            material = settings.material()
            driver.call(lambda: self._runner.sim.set_material(**material))

    def _prepare_scene(self, name):
        """Load a scene that is to take the place of the present one; SceneError if it cannot.

        The driver does it, whose kernels have the helpers.
        """

        def load():
            sim = Simulation(load_scene(name))
            warm_up(sim)
            return sim

        self._prepared = self._driver.call(load).result()

    def _change_scene(self, names):
        """Go on with the prepared scene from its start, and with its material.

        Callbacks wait meanwhile, so that nobody sees a node between two scenes.
        """
        sim, self._prepared = self._prepared, None

        def swap():
            self._runner.replace(sim)
            self._publications.follow_scene()
            self._publications.forget_solids()
            self._inbox.close()
            self._driver.reset()

        self._driver.call(swap).result()
        self._inbox.open(sim.scene)
        self._settings.set_material(sim.scene.material, keep=names)
        material = self._settings.material()
        self._driver.call(lambda: sim.set_material(**material))
        self._introduce()

    # ---------------------------------------------------------------- publications

    def _publish(self, stamp_ns, surface_due):
        """Called by the driver."""
        try:
            job = self._publications.state(stamp_ns, surface_due)
        except Exception as error:
            if self.context.ok():  # else it was shut down in the middle
                self._runner.fail(error)
                self._log_fault(self._runner.fault)
            return
        if job is None:
            return
        if self._step_mode == "lockstep":
            self._surfaces.work(job)
        else:
            self._surfaces.submit(job)

    def _log_fault(self, fault):
        self.get_logger().error(
            f"the simulation stopped: {fault}; call ~/reset", throttle_duration_sec=WARNING_PERIOD
        )

    def _warn_of_surface(self, text):
        if self.context.ok():
            self.get_logger().warning(text, throttle_duration_sec=WARNING_PERIOD)

    def _clock_jumped(self):
        self.get_logger().info("the clock jumped back: starting over")
        self._inbox.forget_time()

    # ---------------------------------------------------------------- services

    async def _ask(self, function):
        """Result of `function` run by the driver between two steps; callbacks go on meanwhile."""
        done = Future()

        def finished(_outcome):
            done.set_result(None)
            if self.executor is not None:  # it may be asleep
                self.executor.wake()

        outcome = self._driver.call(function)
        outcome.add_done_callback(finished)
        await done
        return outcome.result()

    async def _on_reset(self, _request, response):
        def reset():
            self._driver.reset()
            self._inbox.forget_time()

        await self._ask(reset)
        response.success, response.message = True, "back at the start"
        return response

    async def _on_step(self, _request, response):
        if not self._driver.paused:
            response.success = False
            response.message = "not paused: call ~/pause with true first"
            return response
        if self._runner.fault is not None:
            response.success, response.message = False, f"stopped: {self._runner.fault}"
            return response
        response.success = await self._ask(self._driver.step_once)
        fault = self._runner.fault
        time = self._runner.sim.time
        response.message = f"now at {time:.6g} s" if fault is None else f"stopped: {fault}"
        return response

    async def _on_pause(self, request, response):
        def pause():
            self._driver.paused = request.data

        await self._ask(pause)
        response.success, response.message = True, "paused" if request.data else "running"
        return response

    # ---------------------------------------------------------------- diagnostics

    def _diagnose(self):
        """Have the driver gather the facts between two steps, and publish them."""
        factor, step_time = self._speedometer.read()
        self._warn_if_slow(factor)
        self._unheard.look(self._runner.sim.scene.solids)
        if self._diagnostics.get_subscription_count() == 0:
            return
        if self._report is not None and not self._report.done():
            return  # one step takes longer than a second; the report comes after it
        self._report = self._driver.call(lambda: self._publish_facts(factor, step_time))

    def _publish_facts(self, factor, step_time):
        facts = self._facts(factor, step_time)
        name, scene = self.get_name(), self._runner.sim.scene
        statuses = [fluid_status(name, scene, facts)]
        for gate in self._inbox.gates:
            before = self._refused_before.get(gate.solid, 0)
            statuses.append(pose_status(name, gate, before))
            self._refused_before[gate.solid] = sum(gate.refused.values())
        statuses += self._unheard.statuses()
        array = diagnostic_array(self._driver.stamp_ns(), scene.frame, statuses)
        self._diagnostics.publish(array)

    def _facts(self, factor, step_time):
        runner, driver = self._runner, self._driver
        statistics = runner.statistics()
        state = "stopped" if runner.fault else "paused" if driver.paused else "running"
        return {
            "state": state,
            "fault": runner.fault or "",
            "step_mode": self._step_mode,
            "real_time_factor": factor,
            "wanted_factor": self._wanted_factor(),
            "skipped_time": driver.skipped,
            "simulated_time": statistics["time"],
            "time_step": runner.sim.time_step,
            "step_time_ms": step_time,
            **{f"step_time_{part}_ms": value for part, value in runner.part_times.items()},
            "surface_time_ms": self._surfaces.milliseconds,
            "surface_triangles": self._surfaces.triangles,
            "particles": statistics["particle_count"],
            "emitted_particles": statistics["emitted_particles"],
            "removed_particles": statistics["removed_particles"],
            "lost_particles": statistics["lost_particles"],
            "mean_compression": statistics["mean_compression"],
            "max_compression": statistics["max_compression"],
            "max_speed": statistics["max_speed"],
            "pose_latency_ms": 1e3 * driver.take_latency(),
            **{f"pose_age_{gate.solid}": gate.age for gate in self._inbox.gates},
        }

    def _wanted_factor(self):
        """Simulated per real time that there should be; 0 where nobody can know."""
        return self._settings["speed"] if self._step_mode == "realtime" else 0.0

    def _warn_if_slow(self, factor):
        """Say that simulated time was left out: what happens is slower than it should be."""
        skipped = self._driver.skipped - self._skipped_before
        self._skipped_before = self._driver.skipped
        if skipped > 1.0 - SLOW:
            self.get_logger().warning(
                f"too slow: {factor:.2f} times real time, {skipped:.2f} s were left out in the "
                "last second; fewer particles or a larger spacing help",
                throttle_duration_sec=WARNING_PERIOD,
            )


def main(argv=None):
    """Run the node until SIGINT or SIGTERM; returns the exit status."""
    explain = partial(help_text, "fluid_node", "Simulates the liquid of a scene.", declare_all)
    return run_node("fluid_node", FluidNode, argv, (SceneError, ParameterError), explain)


if __name__ == "__main__":
    sys.exit(main())
