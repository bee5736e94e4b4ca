# SPDX-License-Identifier: Apache-2.0
"""``web_viewer``: the liquid in a browser, live; controlled solids are dragged with the mouse.

Only the newest message of each topic is drawn. While no browser looks, nothing is subscribed, so
the fluid node does not even build the messages.
"""

import argparse
import sys

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from msg_adapters.marker import cdr_to_markers
from msg_adapters.mesh import cdr_to_mesh
from msg_adapters.point_cloud import cdr_to_particle_cloud
from msg_adapters.pose import pose_to_cdr
from sph_ros.nodes.running import run_node
from sph_ros.nodes.web_scene import ViewerError, WebScene, start_server

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8080

#: Pictures per second, at most [Hz].
DRAW_RATE = 30.0


class WebViewer(Node):
    """The viewer node, named `web_viewer`. Its page is up when the constructor returns.

    Args:
        kwargs: for `rclpy.node.Node`.

    Raises:
        ViewerError: the page cannot be served.
    """

    def __init__(self, **kwargs):
        super().__init__("web_viewer", **kwargs)
        self._server = None
        try:
            self._set_up()
        except BaseException:
            self.destroy_node()
            raise

    def _set_up(self):
        host, port, fluid = self._declare_parameters()
        self._fluid = fluid.rstrip("/")
        self._server = start_server(host, port)
        self._scene = WebScene(self._server, self._drag, self._push)
        self._newest, self._topics, self._frame, self._paused = {}, [], "world", False
        self._hands, self._presses = {}, []
        self._triggers = {
            name: self.create_client(Trigger, f"{self._fluid}/{name}") for name in ("step", "reset")
        }
        self._pause = self.create_client(SetBool, f"{self._fluid}/pause")
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0 / DRAW_RATE, self._draw, clock=steady)
        shown = "localhost" if host in ("127.0.0.1", "0.0.0.0") else host
        self.get_logger().info(f"open http://{shown}:{self._server.get_port()} in a browser")

    def destroy_node(self):
        """Close the page, then end the node."""
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
        )

    # ---------------------------------------------------------------- from ROS to the browser

    def _listen(self, wanted):
        """Subscribe when somebody looks, and stop when nobody does."""
        if wanted and not self._topics:
            for message_class, name in (
                (PointCloud2, "particles"),
                (Mesh, "surface_mesh"),
                (MarkerArray, "solids"),
            ):
                self._topics.append(self._subscribe(message_class, name))
        elif not wanted and self._topics:
            for subscription in self._topics:
                self.destroy_subscription(subscription)
            self._topics = []
            self._newest.clear()

    def _subscribe(self, message_class, name):
        def keep(buffer):
            self._newest[name] = buffer

        return self.create_subscription(
            message_class, f"{self._fluid}/{name}", keep, QoSProfile(depth=2), raw=True
        )

    def _draw(self):
        self._send_presses()
        self._listen(self._scene.watched)
        newest, self._newest = self._newest, {}
        try:
            if "solids" in newest:
                self._draw_solids(newest["solids"])
            if "particles" in newest:
                cloud = cdr_to_particle_cloud(newest["particles"])
                self._scene.show_particles(cloud.positions, cloud.velocities)
            if "surface_mesh" in newest:
                self._scene.show_surface(*cdr_to_mesh(newest["surface_mesh"]))
        except ValueError as error:  # bytes from outside
            self.get_logger().warning(f"not drawn: {error}", throttle_duration_sec=5.0)

    def _draw_solids(self, buffer):
        markers = cdr_to_markers(buffer)
        if markers:
            self._frame = markers[0].frame_id
        names = [marker.namespace for marker in markers]
        controlled = {name for name in names if self.count_subscribers(self._pose_topic(name))}
        self._scene.show_solids(markers, controlled)

    def _on_diagnostics(self, array):
        name = self._fluid.rpartition("/")[2]
        for status in array.status:
            if status.name == f"{name}: simulation":
                facts = {item.key: item.value for item in status.values}
                self._paused = facts.get("state") == "paused"
                self._scene.set_status(_panel_text(status, facts))

    # ---------------------------------------------------------------- from the browser to ROS

    def _pose_topic(self, solid):
        return f"{self._fluid}/solids/{solid}/pose"

    def _drag(self, solid, position, quat_xyzw):
        """Called in a thread of the server."""
        if solid not in self._hands:
            self._hands[solid] = self.create_publisher(PoseStamped, self._pose_topic(solid), 10)
        # Not stamped: a hand in the browser knows neither the simulated time nor a bag's.
        self._hands[solid].publish(pose_to_cdr(position, quat_xyzw, 0, self._frame))

    def _push(self, button):
        """Called in a thread of the server; acted upon in `_draw`."""
        self._presses.append(button)

    def _send_presses(self):
        while self._presses:
            button = self._presses.pop(0)
            client = self._pause if button == "pause" else self._triggers[button]
            if not client.service_is_ready():
                self._scene.set_status(f"**{self._fluid} does not answer**")
            elif button == "pause":
                client.call_async(SetBool.Request(data=not self._paused))
                self._paused = not self._paused
            else:
                client.call_async(Trigger.Request())


def _panel_text(status, facts):
    """Diagnostics of the fluid as Markdown."""
    age = [
        f"{key.removeprefix('pose_age_')} {_number(value)} s ago"
        for key, value in facts.items()
        if key.startswith("pose_age_") and value != "nan"
    ]
    lines = [
        f"{facts['particles']} particles, {_number(facts['real_time_factor'])} x real time",
        f"step {_number(facts['step_time_ms'])} ms, surface {_number(facts['surface_time_ms'])} ms",
        f"compression {100.0 * float(facts['mean_compression']):.2f} %",
        f"last pose: {', '.join(age)}" if age else "no pose yet",
    ]
    alert = status.level != DiagnosticStatus.OK
    head = f"**{status.message}**" if alert else status.message
    return "\n\n".join([head, *lines])


def _number(text):
    return f"{float(text):.2f}"


def ros_arguments(argv):
    """Command line with --host, --port and --fluid turned into parameters."""
    parser = argparse.ArgumentParser(
        prog="web_viewer", description="The liquid of a fluid_node in a browser, live."
    )
    parser.add_argument("--host", help=f"address to serve on ({DEFAULT_HOST})")
    parser.add_argument("--port", type=int, help=f"TCP port ({DEFAULT_PORT})")
    parser.add_argument("--fluid", help="name of the fluid node (/fluid)")
    begin = argv.index("--ros-args") if "--ros-args" in argv else len(argv)
    options = vars(parser.parse_args(argv[:begin]))
    parameters = [f"{name}:={value}" for name, value in options.items() if value is not None]
    extra = [word for parameter in parameters for word in ("-p", parameter)]
    return [*argv[begin:], *(["--ros-args", *extra] if extra else [])]


def main(argv=None):
    """Run the viewer until SIGINT or SIGTERM; returns the exit status."""
    argv = sys.argv[1:] if argv is None else list(argv)
    return run_node("web_viewer", WebViewer, ros_arguments(argv), (ViewerError,))


if __name__ == "__main__":
    sys.exit(main())
