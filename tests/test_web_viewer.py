# SPDX-License-Identifier: Apache-2.0
"""web_viewer beside a real fluid_node: its page in a real browser, and what it sends."""

import socket
import time
from urllib.request import urlopen

import cv2
import msgspec
import numpy as np
import pytest
import viser
import zstandard
from browser_helpers import Page, blue, chromium, orange
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import GetParameters
from ros_helpers import RosSession
from sensor_msgs.msg import CompressedImage, PointCloud2
from shape_msgs.msg import Mesh
from visualization_msgs.msg import MarkerArray
from websockets.sync.client import connect

from msg_adapters.bags import open_bag
from msg_adapters.image import compressed_image_to_cdr
from msg_adapters.marker import cdr_to_markers
from msg_adapters.mesh import mesh_to_cdr
from sph_ros.nodes.web_controls import share_of, value_at
from sph_ros.nodes.web_viewer import ros_arguments
from sph_ros.sim.materials import RANGES

SCENE = """
spacing: 0.02
liquid:
  - box: {min: [0, 0, 0], max: [0.2, 0.2, 0.1]}
solids:
  - name: tank
    container: {box: {min: [0, 0, 0], max: [0.2, 0.2, 0.3]}}
  - name: ball
    sphere: {radius: 0.03}
    pose: {position: [0.1, 0.1, 0.2]}
    control: topic
"""

# viser's way of saying hello.
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


class Stage:
    """A fluid node and a viewer of it, and what they say."""

    def __init__(self, ros, folder):
        self.ros, self.folder, self.port = ros, folder, free_port()
        self.scene = folder / "tank.yaml"
        self.scene.write_text(SCENE)
        self.solids = ros.collect(MarkerArray, "/fluid/solids", raw=True)
        self.reports = ros.collect(DiagnosticArray, "/diagnostics")
        self.start_fluid()
        self.start_viewer()
        ros.wait_for(lambda: self.solids, 120.0, "for the fluid node")

    @property
    def url(self):
        return f"http://127.0.0.1:{self.port}/"

    def start_fluid(self):
        # Few pictures: a browser without a graphics card takes the processors for each.
        parameters = (f"scene:={self.scene}", "publish_rate:=8.0", "surface_rate:=8.0")
        arguments = [text for p in parameters for text in ("-p", p)]
        self.fluid = self.ros.start("sph_ros.nodes.fluid_node", "--ros-args", *arguments)

    def start_viewer(self):
        self.viewer = self.ros.start(
            "sph_ros.nodes.web_viewer", "--port", str(self.port), "--image", "/camera/compressed",
            "--ros-args", "-p", f"record_folder:={self.folder}",
        )  # fmt: skip
        self.ros.wait_for(lambda: "open http" in self.viewer.output, 60.0, "for the page")

    def ball(self):
        markers = cdr_to_markers(self.solids[-1])
        return np.array(next(m.position for m in markers if m.namespace == "ball"))

    def state(self):
        """Newest state in the diagnostics."""
        for array in reversed(self.reports):
            for status in array.status:
                if status.name == "fluid: simulation":
                    return next(item.value for item in status.values if item.key == "state")
        return None

    def parameter(self, name):
        request = GetParameters.Request(names=[name])
        value = self.ros.call(GetParameters, "/fluid/get_parameters", request).values[0]
        return value.string_value or value.double_value


@pytest.fixture(scope="module")
def stage(tmp_path_factory, compiled_liquid):
    with RosSession("browser") as ros:
        yield Stage(ros, tmp_path_factory.mktemp("viewer"))


# ---------------------------------------------------------------- without a browser


def test_the_page_is_served_on_this_machine_only(stage):
    with urlopen(stage.url, timeout=10) as answer:
        assert answer.status == 200 and b"<html" in answer.read(2000).lower()
    address = socket.gethostbyname(socket.gethostname())
    if not address.startswith("127."):
        with pytest.raises(OSError):
            socket.create_connection((address, stage.port), timeout=2.0)


def browse(port, **options):
    """A client that says hello as a browser does."""
    protocol = f"viser-v{viser.__version__}"
    client = connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None, **options)
    client.send(msgspec.msgpack.encode(CAMERA))
    return client


def messages(frame):
    """What a message of viser's protocol says.

    Layout (viser.infra): the msgpack part's length, its compressed length (8 bytes each), itself
    compressed, and the arrays.
    """
    length = int.from_bytes(frame[8:16], "little")
    return msgspec.msgpack.decode(zstandard.decompress(frame[16 : 16 + length]))["messages"]


def read_until(client, found, timeout=20.0):
    """First message of viser's protocol that meets a condition."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        for message in messages(client.recv(timeout=timeout)):
            if found(message):
                return message
    raise AssertionError(f"not sent within {timeout} s")


def test_only_what_somebody_looks_at_is_subscribed(stage):
    ros, topic = stage.ros, "/fluid/surface_mesh"
    assert ros.node.count_subscribers(topic) == 0
    with browse(stage.port) as client:
        ros.wait_for(lambda: ros.node.count_subscribers(topic) == 1)
        seen, wanted = set(), {"/surface", "/solids/tank", "/solids/ball", "/gizmos/ball"}
        read_until(client, lambda m: seen.add(m.get("name")) or wanted <= seen)
        assert "/gizmos/tank" not in seen  # it follows no poses
        assert ros.node.count_subscribers("/fluid/particles") == 0  # not shown
    # Nobody looks any more: nothing is subscribed, and the fluid node builds nothing.
    ros.wait_for(lambda: ros.node.count_subscribers(topic) == 0)


def wave(phase, side=60):
    """A square of triangles as a ready message; about 300 kB on its way to a browser."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    vertices = np.stack([x, y, np.sin(x + phase)], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = (x + side * y)[:-1, :-1].reshape(-1, 1)
    triangles = np.concatenate(
        [corner + [0, 1, side], corner + [1, side + 1, side]], axis=0, dtype=np.int32
    )
    return mesh_to_cdr(vertices, triangles)


def test_a_stalled_browser_gets_the_newest_and_nonsense_is_survived():
    with RosSession("stalled") as ros:
        port = free_port()
        viewer = ros.start("sph_ros.nodes.web_viewer", "--port", str(port), "--fluid", "/other")
        ros.wait_for(lambda: "open http" in viewer.output, 60.0, "for the page")
        surface = ros.node.create_publisher(Mesh, "/other/surface_mesh", 2)
        # As little as the system allows waits on this side, too.
        slow = socket.socket()
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        slow.connect(("127.0.0.1", port))
        with browse(port) as quick, browse(port, sock=slow, max_queue=1) as stalled:
            ros.wait_for(lambda: surface.get_subscription_count() == 1)
            moved = lambda m: m.get("name") == "/surface" and "vertices" in m.get("updates", ())  # noqa: E731
            surface.publish(wave(0.0))
            read_until(quick, lambda m: m.get("name") == "/surface")
            sent = 0
            for phase in range(1, 25):  # the quick one gets each, the stalled one reads nothing
                surface.publish(wave(float(phase)))
                read_until(quick, moved)
                sent += 1
            surface.publish(mesh_to_cdr(np.empty((0, 3)), np.empty((0, 3), np.int32)))
            hidden = lambda m: m.get("name") == "/surface" and m.get("visible") is False  # noqa: E731
            read_until(quick, hidden)
            late = []
            read_until(stalled, lambda m: late.append(moved(m)) or hidden(m))
            assert sum(late) < sent / 2
            surface.publish(b"\0\1\0\0" + bytes(40))
            surface.publish(wave(0.0)[:-7])
            ros.wait_for(lambda: "not drawn" in viewer.output, what="for the warning")
            surface.publish(wave(0.5))
            read_until(quick, lambda m: m.get("name") == "/surface" and m.get("visible") is True)
        output = viewer.interrupt()
        assert viewer.returncode == 0 and "Traceback" not in output, output


def test_a_taken_port_is_one_line_with_a_proposal_and_exit_status_1():
    with RosSession("taken") as ros, socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        program = ros.start("sph_ros.nodes.web_viewer", "--port", str(port))
        output = program.wait()
    assert program.returncode == 1
    assert f"port {port} is taken" in output and "Traceback" not in output
    proposed = int(output.rpartition("--port ")[2])
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", proposed))


def test_command_line_becomes_parameters():
    assert ros_arguments([]) == []
    assert ros_arguments(["--port", "9000", "--ros-args", "-r", "a:=b"]) == [
        "--ros-args", "-r", "a:=b", "--ros-args", "-p", "port:=9000",
    ]  # fmt: skip
    with pytest.raises(SystemExit):
        ros_arguments(["--prot", "9000"])


@pytest.mark.parametrize(("low", "high"), sorted(set(RANGES.values())))
def test_a_slider_reaches_all_of_its_range(low, high):
    assert (value_at(0.0, low, high), value_at(1.0, low, high)) == (low, high)
    shares = np.linspace(0.0, 1.0, 101)
    values = [value_at(share, low, high) for share in shares]
    assert np.all(np.diff(values) > 0.0)
    # Values have three digits.
    assert np.allclose([share_of(value, low, high) for value in values[1:]], shares[1:], atol=0.003)


# ---------------------------------------------------------------- in a browser


@pytest.fixture(scope="module")
def browser():
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def page(stage, browser):
    page = Page(browser, stage.url)
    page.wait_for("real time")
    yield page
    assert page.errors == []
    page.close()


def test_the_page_shows_water_and_particles(stage, page):
    ros = stage.ros
    ros.wait_for(lambda: shows(page), 60.0, "for the water")
    with_water = page.picture()
    page.field("water").uncheck()
    ros.wait_for(lambda: shows(page, water=False), what="for the ball without water")
    page.field("particles").check()
    ros.wait_for(lambda: shows(page), what="for the particles")
    # They are where the water was, and they are grains: smaller ones cover less.
    large = blue(page.picture())
    assert (large & blue(with_water)).sum() > 0.6 * large.sum()
    page.field("particle size").fill("0.2")
    ros.wait_for(lambda: blue(page.picture()).mean() < 0.5 * large.mean(), what="for small grains")
    page.wait_for("m/s")
    page.choose("coloured by", "density")
    page.wait_for("kg/m³")
    page.field("particles").uncheck()
    page.field("water").check()
    ros.wait_for(lambda: shows(page), what="for the water again")


def shows(page, water=True, ball=0.001):
    """Whether the picture has water, or has none, and so much of it is orange."""
    image = page.picture()
    # The gizmo has a blue arrow.
    return (blue(image).mean() > 0.01) == water and orange(image).mean() > ball


def test_buttons_pause_step_and_reset(stage, page):
    ros = stage.ros
    page.button("pause").click()
    ros.wait_for(lambda: stage.state() == "paused", what="for the pause")
    page.button("resume").wait_for()
    clouds = ros.collect(PointCloud2, "/fluid/particles", raw=True)
    ros.wait_for(lambda: clouds, what="for particles")
    page.button("step").click()
    ros.wait_for(lambda: len({bytes(data[:12]) for data in clouds}) > 1, what="for another stamp")
    page.button("reset").click()
    ros.wait_for(lambda: bytes(clouds[-1][4:12]) == bytes(8), what="for time zero")
    page.button("resume").click()
    ros.wait_for(lambda: stage.state() == "running", what="for the end of the pause")
    page.button("pause").wait_for()
    page.button("step").click()
    page.wait_for("not paused")


def test_dragging_the_gizmo_moves_the_ball_in_the_simulation(stage, page):
    ros = stage.ros
    poses = ros.collect(PoseStamped, "/fluid/solids/ball/pose")
    start = stage.ball()
    last = lambda: poses[-1].pose.position  # noqa: E731
    hand = lambda: np.array([last().x, last().y, last().z])  # noqa: E731

    tried, begin = [0.0], [start]

    def pulled():
        """Whether the ball went along the arrow; a busy browser may miss a way, or the arrow."""
        moved = hand() - begin[-1] if poses else np.zeros(3)
        if moved[2] > 0.005 and np.abs(moved[:2]).max() < 1e-6:
            return True
        if time.monotonic() > tried[-1] + 3.0:
            begin.append(hand() if poses else start)
            if drag_ball(page):
                tried.append(time.monotonic())
        return False

    ros.wait_for(pulled, 60.0, "for the pull")
    ros.wait_for(lambda: np.allclose(stage.ball(), hand(), atol=1e-5), what="for the ball")


def drag_ball(page):
    """Pull the arrow of the ball's gizmo that points up."""
    image = page.picture()
    y, x = (int(np.median(index)) for index in np.nonzero(orange(image)))
    shaft = blue(image)[y - 80 : y - 10, x - 12 : x + 12]  # as far as it is not on the ball
    if not shaft.any():
        return False
    rows, columns = np.nonzero(shaft)
    tip = rows <= rows.min() + 10  # farther down are the handles of planes and turns beside it
    rise, aside = int(np.median(rows[tip])), int(np.median(columns[tip]))
    x, y = x - 12 + aside, y - 80 + rise
    page.drag([(x, y - 6 * step) for step in range(7)])
    return True


def test_sliders_and_fields_set_parameters_and_refuse_nonsense(stage, page, browser):
    ros = stage.ros
    page.tab("Liquid")
    field = page.field("viscosity")
    assert field.input_value() == "0.001"
    handle = page.slider("viscosity").bounding_box()
    x, y = handle["x"] + handle["width"] / 2, handle["y"] + handle["height"] / 2
    page.drag([(x, y), (x + 20, y), (x + 40, y)])
    ros.wait_for(lambda: stage.parameter("material.viscosity") > 0.01, what="for the slider")
    assert float(field.input_value()) == stage.parameter("material.viscosity")
    for typed, complaint in (("5000", "expected 0 to 1000 Pa s, got 5000"), ("thin", "a number")):
        before = stage.parameter("material.viscosity")
        field.fill(typed)
        page.page.get_by_role("alert").get_by_text(complaint).wait_for()
        assert stage.parameter("material.viscosity") == before
        ros.wait_for(lambda: float(field.input_value()) == before, what="for the old value")  # noqa: B023
    # Two browsers at once: what one does, the other sees.
    other = Page(browser, stage.url)
    other.tab("Liquid")
    theirs = other.field("viscosity")
    theirs.fill("2.5")
    ros.wait_for(lambda: stage.parameter("material.viscosity") == 2.5, what="for the other browser")
    ros.wait_for(lambda: field.input_value() == "2.5", what="for the first browser")
    ros.wait_for(lambda: shows(other), what="for the water in both")
    assert other.errors == []
    other.close()


def test_a_camera_picture_is_shown(stage, page):
    ros = stage.ros
    publisher = ros.node.create_publisher(CompressedImage, "/camera/compressed", 10)
    green = np.zeros((48, 64, 3), np.uint8)
    green[:, :, 1] = 255
    good = cv2.imencode(".png", green)[1].tobytes()
    send = lambda data: publisher.publish(compressed_image_to_cdr(data, "png", 0, "camera"))  # noqa: E731
    picture = page.page.locator("img[src^=blob]")
    ros.wait_for(lambda: send(good) or picture.count() == 1, what="for the picture")
    assert picture.evaluate("image => image.decode().then(() => image.naturalWidth)") == 64
    alert = page.page.get_by_role("alert").get_by_text("cannot read")
    ros.wait_for(lambda: send(b"no picture") or alert.count(), what="for the complaint")
    ros.node.destroy_publisher(publisher)


def test_a_recording_holds_what_the_node_said(stage, page):
    ros = stage.ros
    page.button("record").click()
    page.wait_for("stop recording")
    time.sleep(1.0)  # of liquid in the bag
    page.page.get_by_role("button", name="stop recording").click()
    page.wait_for("recorded")
    path = ros.wait_for(lambda: next(stage.folder.glob("fluid_*"), None))
    with open_bag(path) as bag:
        counts = {name: topic.count for name, topic in bag.topics.items()}
    assert counts["/fluid/particles"] > 5 and counts["/fluid/solids/ball/wrench"] > 5
    assert {"/fluid/surface", "/fluid/solids", "/diagnostics"} <= set(counts)


def test_another_scene_a_reload_and_restarts(stage, page):
    ros = stage.ros
    page.tab("Scene")
    page.field("file").fill("nowhere.yaml")
    page.button("load the file").click()
    page.page.get_by_role("alert").get_by_text("nowhere.yaml").wait_for()
    page.choose("scene", "ball_tank")
    page.wait_for("ball_tank is loaded")
    assert stage.parameter("scene") == "ball_tank"
    page.wait_for("864")
    page.page.reload()
    page.wait_for("864")
    ros.wait_for(lambda: shows(page), 60.0, "for tank and ball")
    stage.fluid.interrupt()
    page.wait_for("no word from /fluid")
    page.button("reset").click()
    page.wait_for("reset: no fluid node /fluid")
    stage.start_fluid()
    page.wait_for("pose of ball")
    assert "864" not in page.text()
    # The page connects by itself to a new server.
    output = stage.viewer.interrupt()
    assert stage.viewer.returncode == 0 and "Traceback" not in output, output
    stage.start_viewer()
    ros.wait_for(lambda: shows(page), 60.0, "for the new server")
