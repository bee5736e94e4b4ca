# SPDX-License-Identifier: Apache-2.0
"""``web_viewer``: the liquid in a browser, live; controlled solids are dragged with the mouse.

Messages are drawn as they come, but not more often than one can see; of those in between only the
newest counts. Only topics that somebody looks at are subscribed: while no browser looks, the fluid
node does not even build the messages. What people do in the browser is noted by threads of the
server and done by the node's timer.
"""

import argparse
import os
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from visualization_msgs.msg import MarkerArray

from msg_adapters.marker import ADD, cdr_to_markers
from msg_adapters.mesh import cdr_to_mesh
from msg_adapters.point_cloud import cdr_to_particle_cloud
from msg_adapters.pose import pose_to_cdr
from sph_ros.nodes import web_panel
from sph_ros.nodes.fluid_client import FluidClient
from sph_ros.nodes.picture_listener import PictureListener
from sph_ros.nodes.running import run_node
from sph_ros.nodes.web_panel import Panel
from sph_ros.nodes.web_pictures import PictureWindow
from sph_ros.nodes.web_recording import WebRecording
from sph_ros.nodes.web_scene import WebScene
from sph_ros.nodes.web_server import ViewerError, start_server
from sph_ros.nodes.web_texts import away_text, state_rows, viewer_status
from sph_ros.sim.scene import list_scenes

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8080

#: Pictures per second, at most [Hz].
DRAW_RATE = 33.0

#: Added to the process's niceness: on a busy machine pictures are left out, not time steps.
NICENESS = 5

#: So often [Hz] is looked for what people want, and for what else there is to show.
TURN_RATE = 15.0

TOPICS = {"particles": PointCloud2, "surface_mesh": Mesh, "solids": MarkerArray}

DOT_COLORS = {
    DiagnosticStatus.OK: web_panel.GOOD,
    DiagnosticStatus.WARN: web_panel.WARNING,
    DiagnosticStatus.ERROR: web_panel.BAD,
}


class WebViewer(Node):
    """The viewer node, named `web_viewer`. Its page is up when the constructor returns.

    Args:
        kwargs: for `rclpy.node.Node`.

    Raises:
        ViewerError: the page cannot be served.
    """

    def __init__(self, **kwargs):
        super().__init__("web_viewer", **kwargs)
        self._server = self._recording = None
        try:
            self._set_up()
        except BaseException:
            self.destroy_node()
            raise

    def _set_up(self):
        host, port, fluid, image, folder, particles = self._declare_parameters()
        self._fluid_name = "/" + fluid.strip("/")
        self._server = start_server(host, port)
        self._scene = WebScene(self._server, self._drag)
        self._scene.options.particles = particles
        self._panel = Panel(self._server, self._scene.options, list_scenes())
        self._recording = WebRecording(self, self._fluid_name, folder, self._say)
        self._fluid = FluidClient(
            self, self._fluid_name, self._complain, self._recording.heard_report
        )
        self._pictures = PictureListener(self, image)
        self._window = PictureWindow(self._server, image)
        self._newest, self._topics, self._frame = {}, {}, "world"
        self._controlled, self._last_drawn = {}, {}
        self._hands, self._drawn, self._undrawable = {}, dict.fromkeys(TOPICS, 0), 0
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0 / TURN_RATE, self._turn, clock=steady)
        self.create_timer(1.0, self._report, clock=steady)
        shown = "localhost" if host in ("127.0.0.1", "0.0.0.0") else host
        self.get_logger().info(f"open http://{shown}:{self._server.get_port()} in a browser")

    def destroy_node(self):
        """Keep a running recording, close the page, then end the node."""
        if self._recording is not None:
            self._recording.stop()
        if self._server is not None:
            self._server.stop()
            self._server = None
        super().destroy_node()

    def _declare_parameters(self):
        def declare(name, default, description, **more):
            descriptor = ParameterDescriptor(description=description, read_only=True, **more)
            return self.declare_parameter(name, default, descriptor).value

        ports = [IntegerRange(from_value=1, to_value=65535)]
        return (
            declare("host", DEFAULT_HOST, "address to serve on; 0.0.0.0 opens it to the network"),
            declare("port", DEFAULT_PORT, "TCP port to serve on", integer_range=ports),
            declare("fluid", "/fluid", "name of the fluid node, with its namespace"),
            declare(
                "image",
                "/ar_overlay/image/compressed",
                "topic of the pictures to show, Image or CompressedImage; empty for none",
            ),
            declare("record_folder", ".", "where recordings go"),
            declare("particles", False, "whether particles are drawn from the start"),
        )

    # ---------------------------------------------------------------- from ROS to the browser

    def _turn(self):
        """Some times a second: do what people want, show what is not shown yet."""
        self._obey()
        self._fluid.check()
        self._recording.sweep()
        self._listen()
        for name in list(self._newest):
            self._draw_newest(name)
        self._scene.refresh()
        self._show_picture()
        self._panel.tick()

    def _listen(self):
        """Subscribe to what somebody looks at, and to nothing else."""
        options, watched = self._scene.options, self._scene.watched
        wanted = {
            "particles": watched and options.particles,
            "surface_mesh": watched and options.surface,
            "solids": watched,
        }
        for name, wish in wanted.items():
            if wish and name not in self._topics:
                self._topics[name] = self._subscribe(TOPICS[name], name)
            elif not wish and name in self._topics:
                self.destroy_subscription(self._topics.pop(name))
                self._newest.pop(name, None)

    def _subscribe(self, message_class, name):
        def arrived(buffer):
            self._newest[name] = buffer
            self._draw_newest(name)

        return self.create_subscription(
            message_class, f"{self._fluid_name}/{name}", arrived, QoSProfile(depth=2), raw=True
        )

    def _draw_newest(self, name):
        """Draw the newest message of a topic, unless one was drawn just before."""
        now = time.monotonic()
        if now - self._last_drawn.get(name, 0.0) < 1.0 / DRAW_RATE:
            return
        self._last_drawn[name] = now
        try:
            with self._server.atomic():
                self._draw(name, self._newest.pop(name))
        except ValueError as error:  # bytes from outside
            self._undrawable += 1
            self.get_logger().warning(f"not drawn: {error}", throttle_duration_sec=5.0)

    def _draw(self, name, buffer):
        if name == "solids":
            self._draw_solids(buffer)
        elif name == "particles":
            cloud = cdr_to_particle_cloud(buffer)
            self._scene.liquid.show_particles(cloud.positions, cloud.velocities, cloud.densities)
        else:
            self._scene.liquid.show_surface(*cdr_to_mesh(buffer))
        self._drawn[name] += 1

    def _draw_solids(self, buffer):
        markers = cdr_to_markers(buffer)
        if markers:
            self._frame = markers[0].frame_id
        if any(marker.action != ADD for marker in markers):
            self._scene.forget()  # the fluid node has another scene
            markers = [marker for marker in markers if marker.action == ADD]
        names = [marker.namespace for marker in markers]
        if set(names) != set(self._controlled):
            self._find_controlled(names)
        controlled = [name for name in names if self._controlled[name]]
        self._scene.show_solids(markers, controlled, self._frame)

    def _find_controlled(self, names):
        """Which solids the fluid node moves by messages: those whose topics it listens to."""
        nodes = {
            name: self.get_subscriptions_info_by_topic(self._pose_topic(name)) for name in names
        }
        self._controlled = {
            name: any(
                f"{n.node_namespace.rstrip('/')}/{n.node_name}" == self._fluid_name for n in ns
            )
            for name, ns in nodes.items()
        }
        for name, controlled in self._controlled.items():
            if controlled and name not in self._hands:
                self._hands[name] = self.create_publisher(PoseStamped, self._pose_topic(name), 10)
        self._recording.follow(self._controlled)

    def _show_picture(self):
        try:
            picture = self._pictures.take(self._scene.watched)
        except ValueError as error:
            self._undrawable += 1
            self._complain(f"{self._pictures.topic}: {error}")
            return
        if picture is not None:
            self._window.show(picture)
        elif self._pictures.gone:
            self._window.close()

    def _report(self):
        """Once a second: the panel's numbers, and how the viewer itself is."""
        fluid, panel = self._fluid, self._panel
        self._find_controlled(list(self._controlled))
        if fluid.facts:
            color = DOT_COLORS.get(fluid.level, web_panel.AWAY)
            panel.show_state(color, fluid.message, state_rows(fluid.facts))
            panel.show_paused(fluid.paused)
        else:
            panel.show_state(web_panel.AWAY, away_text(self._fluid_name, fluid.silence), ())
        if fluid.scene is not None:
            panel.show_scene(fluid.scene)
        panel.show_parameters(fluid.numbers)
        if "density" in fluid.numbers:
            self._scene.liquid.colors.rest_density = fluid.numbers["density"].value
        panel.show_legend(self._scene.liquid.colors.legend)
        panel.show_recording(self._recording.state)
        if self._diagnostics.get_subscription_count() > 1:  # one is the fluid client's
            stamp = self.get_clock().now().to_msg()
            status = viewer_status(self._scene.browsers, self._drawn, self._undrawable)
            array = DiagnosticArray(status=[status])
            array.header.stamp = stamp
            self._diagnostics.publish(array)
        self._drawn = dict.fromkeys(TOPICS, 0)

    # ---------------------------------------------------------------- from the browser to ROS

    def _obey(self):
        """Do what people did in the panel."""
        actions, fluid = self._panel.actions, self._fluid
        while actions:
            name, argument = actions.popleft()
            if name in (web_panel.PAUSE, web_panel.RESUME):
                fluid.pause(name == web_panel.PAUSE)
            elif name in (web_panel.STEP, web_panel.RESET):
                fluid.trigger(name)
            elif name == web_panel.RECORD:
                self._recording.toggle(self._controlled)
                self._panel.show_recording(self._recording.state)
            elif name == "scene":
                self._load(argument)
            else:
                self._scene.look_at_all()
        for name, value in self._panel.edits():
            fluid.set_number(name, value)

    def _load(self, scene):
        loaded = f"{scene} is loaded"
        self._panel.say(f"loading {scene} ...", web_panel.GOOD)
        self._fluid.set_scene(scene, lambda: self._panel.say(loaded, web_panel.GOOD))

    def _pose_topic(self, solid):
        return f"{self._fluid_name}/solids/{solid}/pose"

    def _drag(self, solid, position, quat_xyzw):
        """Called in the thread of the server's event loop."""
        # Not stamped: a hand in the browser knows neither the simulated time nor a bag's.
        self._hands[solid].publish(pose_to_cdr(position, quat_xyzw, 0, self._frame))

    def _complain(self, text):
        """Something that was wanted cannot be had."""
        self.get_logger().warning(text, throttle_duration_sec=1.0)
        self._panel.say(text, web_panel.BAD)

    def _say(self, text, good):
        self.get_logger().info(text)
        self._panel.say(text, web_panel.GOOD if good else web_panel.BAD)


def ros_arguments(argv):
    """Command line with --host, --port, --fluid and --image turned into parameters."""
    parser = argparse.ArgumentParser(
        prog="web_viewer", description="The liquid of a fluid_node in a browser, live."
    )
    parser.add_argument("--host", help=f"address to serve on ({DEFAULT_HOST})")
    parser.add_argument("--port", type=int, help=f"TCP port ({DEFAULT_PORT})")
    parser.add_argument("--fluid", help="name of the fluid node (/fluid)")
    parser.add_argument("--image", help="topic of pictures to show (/ar_overlay/image/compressed)")
    begin = argv.index("--ros-args") if "--ros-args" in argv else len(argv)
    options = vars(parser.parse_args(argv[:begin]))
    parameters = [f"{name}:={value}" for name, value in options.items() if value is not None]
    extra = [word for parameter in parameters for word in ("-p", parameter)]
    return [*argv[begin:], *(["--ros-args", *extra] if extra else [])]


def main(argv=None):
    """Run the viewer until SIGINT or SIGTERM; returns the exit status."""
    argv = sys.argv[1:] if argv is None else list(argv)
    os.nice(NICENESS)
    return run_node("web_viewer", WebViewer, ros_arguments(argv), (ViewerError,))


if __name__ == "__main__":
    sys.exit(main())
