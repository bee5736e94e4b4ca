# SPDX-License-Identifier: Apache-2.0
"""web_viewer beside a real fluid_node: its page, what it sends, and a real browser."""

import socket
import time
from urllib.request import urlopen

import cv2
import msgspec
import numpy as np
import pytest
import viser
import zstandard
from browser_helpers import CHROMIUM, Browser
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from ros_helpers import RosSession
from visualization_msgs.msg import MarkerArray
from websockets.sync.client import connect

from msg_adapters.marker import cdr_to_markers
from sph_ros.nodes.web_viewer import ros_arguments

SIZE = (1200, 850)

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, -1.0, 0.5),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 480,
    "image_width": 640,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def viewer():
    """(session, port) of a viewer that shows ball_tank."""
    with RosSession("browser") as ros:
        port = free_port()
        ros.start("sph_ros.nodes.fluid_node", "--ros-args", "-p", "scene:=ball_tank")
        ros.viewer = ros.start("sph_ros.nodes.web_viewer", "--port", str(port))
        ros.solids = ros.collect(MarkerArray, "/fluid/solids", raw=True)
        ros.reports = ros.collect(DiagnosticArray, "/diagnostics")
        ros.wait_for(lambda: "open http" in ros.viewer.output, 60.0, "for the page")
        ros.wait_for(lambda: ros.solids, 90.0, "for the fluid node")
        yield ros, port


def state(ros):
    """Newest state in the diagnostics."""
    statuses = [s for s in ros.reports[-1].status if s.name == "fluid: simulation"]
    return next(item.value for item in statuses[0].values if item.key == "state")


def test_the_page_is_served_on_this_machine_only(viewer):
    _, port = viewer
    with urlopen(f"http://127.0.0.1:{port}/", timeout=10) as answer:
        assert answer.status == 200 and b"<html" in answer.read(2000).lower()
    address = socket.gethostbyname(socket.gethostname())
    if not address.startswith("127."):
        with pytest.raises(OSError):
            socket.create_connection((address, port), timeout=2.0)


def test_particles_surface_and_solids_are_sent_to_whoever_looks(viewer):
    ros, port = viewer
    before = ros.node.count_subscribers("/fluid/particles")
    protocol = f"viser-v{viser.__version__}"
    with connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None) as client:
        client.send(msgspec.msgpack.encode(CAMERA))  # viser's way of saying hello
        ros.wait_for(lambda: ros.node.count_subscribers("/fluid/particles") == before + 1)
        seen, deadline = set(), time.monotonic() + 20.0
        wanted = {"/particles", "/surface", "/solids/tank", "/solids/ball", "/gizmos/ball"}
        while not wanted <= seen and time.monotonic() < deadline:
            seen |= names(client.recv(timeout=20.0))
        assert wanted <= seen and "/gizmos/tank" not in seen
    # Nobody looks any more: nothing is subscribed, and the fluid node builds nothing.
    ros.wait_for(lambda: ros.node.count_subscribers("/fluid/particles") == before)


def names(frame):
    """Names of the scene nodes that a message of viser's protocol is about.

    Layout (viser.infra): the msgpack part's length, its compressed length (8 bytes each), itself
    compressed, and the arrays.
    """
    length = int.from_bytes(frame[8:16], "little")
    window = msgspec.msgpack.decode(zstandard.decompress(frame[16 : 16 + length]))
    return {message["name"] for message in window["messages"] if "name" in message}


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_a_browser_shows_water_pauses_it_and_drags_the_ball(viewer, tmp_path):
    ros, port = viewer
    with Browser(f"http://127.0.0.1:{port}/", SIZE) as browser:
        ros.wait_for(lambda: "particles," in browser.text(), 60.0, "for the panel")
        ros.wait_for(lambda: shows_water_and_ball(browser, tmp_path), 60.0, "for the picture")
        poses = ros.collect(PoseStamped, "/fluid/solids/ball/pose")
        start = np.array(cdr_to_markers(ros.solids[-1])[1].position)
        ros.wait_for(lambda: drag_ball(browser, tmp_path) and poses, 30.0, "for a dragged pose")
        moved = lambda: np.array(cdr_to_markers(ros.solids[-1])[1].position)  # noqa: E731
        ros.wait_for(lambda: np.linalg.norm(moved() - start) > 0.005, what="for the ball")
        browser.click("pause")
        ros.wait_for(lambda: state(ros) == "paused", what="for the pause")
        browser.click("pause")
        ros.wait_for(lambda: state(ros) == "running", what="for the end of the pause")


def picture(browser, folder):
    """What the page shows, (h, w, 3) int BGR, and masks of water and of the ball."""
    browser.screenshot(folder / "page.png")
    image = cv2.imread(str(folder / "page.png")).astype(int)
    image[:, int(0.7 * image.shape[1]) :] = 255  # the panel's buttons are blue, too,
    image[:200, : int(0.3 * image.shape[1])] = 255  # and a notice has the colour of the ball
    blue, green, red = image.transpose(2, 0, 1)
    return image, (blue > red + 60) & (blue > 90), (red > blue + 80) & (red > 120)


def shows_water_and_ball(browser, folder):
    _, water, ball = picture(browser, folder)
    return water.mean() > 0.01 and ball.mean() > 0.001


def drag_ball(browser, folder):
    """Pull the arrow of the ball's gizmo that points up."""
    _, blue, ball = picture(browser, folder)
    y, x = (int(np.median(index)) for index in np.nonzero(ball))
    above = blue[y - 90 : y - 10, x - 12 : x + 12]  # the shaft, as far as it is not on the ball
    rise, aside = (int(np.median(index)) for index in np.nonzero(above))
    x, y = x - 12 + aside, y - 90 + rise
    for kind, up in [("mouseMoved", 0), ("mousePressed", 0)] + [
        ("mouseMoved", 5 * step) for step in range(1, 11)
    ]:
        browser.mouse(kind, x, y - up)
        time.sleep(0.2)  # without a graphics card the page takes its time to notice
    browser.mouse("mouseReleased", x, y - 50)
    return True


def test_a_taken_port_is_one_line_and_exit_status_1():
    with RosSession("taken") as ros, socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        program = ros.start("sph_ros.nodes.web_viewer", "--port", str(port))
        output = program.wait()
    assert program.returncode == 1
    assert f"port {port} is taken" in output and "Traceback" not in output


def test_interrupt_ends_the_viewer(viewer):
    ros, _ = viewer
    output = ros.viewer.interrupt()
    assert ros.viewer.returncode == 0 and "Traceback" not in output, output


def test_command_line_becomes_parameters():
    assert ros_arguments([]) == []
    assert ros_arguments(["--port", "9000", "--ros-args", "-r", "a:=b"]) == [
        "--ros-args", "-r", "a:=b", "--ros-args", "-p", "port:=9000",
    ]  # fmt: skip
    with pytest.raises(SystemExit):
        ros_arguments(["--prot", "9000"])
