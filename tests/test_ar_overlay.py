# SPDX-License-Identifier: Apache-2.0
"""ar_overlay as its users meet it: a real process, real DDS, pictures with water in them."""

import time

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from ros_helpers import RosSession
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from test_overlay import CAMERA, PLAIN, SIZE, SPACING, VIEW, redness, still_water, view_from
from visualization_msgs.msg import MarkerArray

from msg_adapters.image import cdr_to_compressed_image, cdr_to_image, image_to_cdr
from msg_adapters.marker import markers_to_cdr, triangle_marker
from msg_adapters.point_cloud import particle_cloud_to_cdr
from msg_adapters.pose import pose_to_cdr
from sph_ros.colors import CONTAINER
from sph_ros.nodes.ar_overlay import ArOverlay
from sph_ros.sim.shapes import Sphere, display_mesh
from sph_ros.tracking.camera_message import camera_to_cdr
from sph_ros.tracking.images import decode

NODE = "sph_ros.nodes.ar_overlay"
PERIOD_NS = 33_333_333
POINTS, TANK = still_water()


class OverlayClient:
    """A running ar_overlay, a camera, a tracker and a fluid node that feed it, and what it says."""

    def __init__(self, ros, *parameters):
        self.ros, node = ros, ros.node
        self.images = node.create_publisher(Image, "image", 2)
        self.infos = node.create_publisher(CameraInfo, "camera_info", 2)
        self.poses = node.create_publisher(PoseStamped, "/marker_tracker/camera_pose", 10)
        self.particles = node.create_publisher(PointCloud2, "/fluid/particles", 2)
        self.solids = node.create_publisher(MarkerArray, "/fluid/solids", 2)
        self.reports = ros.collect(DiagnosticArray, "/diagnostics")
        arguments = [text for p in parameters for text in ("-p", p)]
        self.program = ros.start(NODE, "--ros-args", *arguments)
        self.drawn, self.stamp_ns, self.time = [], time.time_ns(), 0.0

    def listen(self):
        """From now on hear its pictures; returns when it listens to the camera."""
        self.drawn = self.ros.collect(Image, "/ar_overlay/image", 10, raw=True)
        self.ros.wait_for(self.images.get_subscription_count, 90.0, "for ar_overlay")
        self.ros.wait_for(self.particles.get_subscription_count, what="for ar_overlay")
        self.ros.wait_for(self.infos.get_subscription_count, what="for ar_overlay")
        return self

    def calibrate(self):
        self.infos.publish(camera_to_cdr(CAMERA, self.stamp_ns, "optical"))

    def show(
        self, view=VIEW, picture=PLAIN, encoding="bgr8", points=POINTS, frame="world", ball=True
    ):
        """Publish a picture with the camera's pose and a liquid, whose clock is its own."""
        self.stamp_ns, self.time = time.time_ns(), self.time + 1 / 30
        simulated = round(self.time * 1e9)
        color = (1.0, 0.1, 0.0, 1.0)
        solids = [("tank", TANK.vertices, TANK.triangles, CONTAINER)]
        solids += [("ball", *display_mesh(Sphere(0.02)), color)] if ball else []
        markers = [
            triangle_marker(
                vertices, triangles, simulated, "world", namespace=name, marker_id=i, color=color,
                position=(0.0, 0.0, 0.09) if name == "ball" else (0.0, 0.0, 0.0),
            )
            for i, (name, vertices, triangles, color) in enumerate(solids)
        ]  # fmt: skip
        none = np.zeros_like(points)
        ids, densities = np.arange(len(points), dtype=np.uint32), np.ones(len(points), np.float32)
        cloud = particle_cloud_to_cdr(points, none, densities, ids, simulated, "world")
        self.particles.publish(cloud)
        self.solids.publish(markers_to_cdr(markers))
        if view is not None:
            pose = view.inverse()
            self.poses.publish(pose_to_cdr(pose.position, pose.quat_xyzw, self.stamp_ns, frame))
        data = picture if encoding is None else image_to_cdr(
            picture, encoding, self.stamp_ns, "optical"
        )  # fmt: skip
        self.images.publish(data)
        return self.stamp_ns

    def show_until(self, condition, timeout=30.0, **kwargs):
        """Show pictures, up to 20 a second, until something holds of the newest drawn one."""
        begin, shown = len(self.drawn), set()

        def check():
            shown.add(self.show(**kwargs))
            time.sleep(0.05)
            if len(self.drawn) <= begin:
                return None
            image = cdr_to_image(self.drawn[-1])
            assert image.encoding == "bgr8"
            return image if condition(image.pixels.astype(int)) else None

        image = self.ros.wait_for(check, timeout, "for a picture")
        return image, shown

    def wait_for_message(self, text, **kwargs):
        """Show pictures until the diagnostics hold a text; the newest values."""

        def said():
            self.show(**kwargs)
            time.sleep(0.05)
            for array in self.reports[-5:]:
                for status in array.status:
                    if status.name == "ar_overlay: input" and text in status.message:
                        return {value.key: value.value for value in status.values}
            return None

        last = [s.message for a in self.reports[-3:] for s in a.status]
        return self.ros.wait_for(said, what=f"for {text!r}, last {last}")


def is_blue(picture):
    """Whether there is water: much of the picture is more blue than red."""
    return ((picture[..., 0] - picture[..., 2]) > 12).mean() > 0.05


def has_writing(picture):
    """Whether there is text at the top; it is pale with a black outline."""
    return np.ptp(picture[8:26, 6:200].sum(axis=2)) > 250


@pytest.fixture(scope="module")
def running():
    with RosSession("overlay_test") as ros:
        client = OverlayClient(ros, f"spacing:={SPACING}")
        idle = lambda: any("idle" in s.message for a in client.reports for s in a.status)  # noqa: E731
        ros.wait_for(idle, 120.0, "for ar_overlay")
        assert client.particles.get_subscription_count() == 0  # nobody listens to it
        assert client.images.get_subscription_count() == 0
        client.listen()
        client.calibrate()
        yield client
        assert client.program.running, client.program.output
        output = client.program.interrupt()
        assert client.program.returncode == 0 and "Traceback" not in output, output


def test_water_and_ball_are_drawn_and_stamps_are_the_pictures(running):
    running.calibrate()
    image, shown = running.show_until(lambda p: is_blue(p) and redness(p).max() > 80)
    assert image.header.stamp_ns in shown and image.header.frame_id == "optical"
    assert image.pixels.shape == PLAIN.shape and not has_writing(image.pixels.astype(int))
    border = np.ones(SIZE[::-1], bool)
    border[15:-15, 15:-15] = False
    assert (image.pixels == PLAIN)[border].all()  # it is drawn where the camera says
    middle = CAMERA.project(VIEW.apply(np.array([[0.0, 0.0, 0.09]])))[0]
    rows, columns = np.nonzero(redness(image.pixels) > 80)
    assert abs(columns.mean() - middle[0]) < 6 and abs(rows.mean() - middle[1]) < 6


def test_compressed_pictures_show_the_same(running):
    compressed = running.ros.collect(CompressedImage, "/ar_overlay/image/compressed", 10, raw=True)
    running.show_until(lambda p: bool(compressed))
    message = cdr_to_compressed_image(compressed[-1])
    picture = decode(message.data, message.format).astype(int)
    assert message.format == "jpeg" and picture.shape == PLAIN.shape
    running.show_until(lambda p: is_blue(p) and np.abs(picture - p).mean() < 6)


def test_a_moving_camera_is_followed(running):
    before, _ = running.show_until(is_blue)
    other = view_from((-0.25, -0.3, 0.3))
    place = CAMERA.project(other.apply(np.array([[0.0, 0.0, 0.09]])))[0]

    def moved(picture):
        rows, columns = np.nonzero(redness(picture) > 80)
        return len(rows) and np.hypot(columns.mean() - place[0], rows.mean() - place[1]) < 6

    running.show_until(moved, view=other)


def test_without_the_cameras_pose_the_picture_passes_and_says_why(running):
    image, _ = running.show_until(lambda p: has_writing(p) and not is_blue(p), view=None)
    assert (image.pixels[60:] == PLAIN[60:]).all()
    running.wait_for_message("no camera pose", view=None)
    running.show_until(lambda p: is_blue(p) and not has_writing(p))
    running.show_until(lambda p: has_writing(p) and not is_blue(p), frame="elsewhere")
    running.wait_for_message("in frame 'elsewhere', the liquid in 'world'", frame="elsewhere")


def test_zero_particles_and_a_camera_in_the_water_are_said_in_the_picture(running):
    image, _ = running.show_until(
        lambda p: has_writing(p) and redness(p).max() > 80, points=POINTS[:0]
    )
    assert not is_blue(image.pixels.astype(int))
    running.wait_for_message("no particles", points=POINTS[:0])
    inside = view_from((0.0, -0.05, 0.03), (0.0, 0.2, 0.03))
    running.show_until(lambda p: has_writing(p) and is_blue(p), view=inside, ball=False)
    running.wait_for_message("inside the liquid", view=inside, ball=False)


def test_pictures_nobody_can_read_are_answered_with_a_grey_one_that_says_so(running):
    bad = image_to_cdr(PLAIN, "bgr8", 1, "optical").replace(b"bgr8", b"bxr8")
    image, _ = running.show_until(has_writing, picture=bad, encoding=None)
    assert image.pixels.shape == PLAIN.shape
    values = running.wait_for_message("encoding is 'bxr8'", picture=bad, encoding=None)
    assert int(values["pictures_refused"]) > 0
    running.show_until(has_writing, picture=b"\0\1\0\0rubbish", encoding=None)
    small = np.ascontiguousarray(PLAIN[::2, ::2])
    running.show_until(has_writing, picture=small)  # not the calibrated size
    running.wait_for_message("calibration is for 320 x 240", picture=small)
    gray = cv2.cvtColor(PLAIN, cv2.COLOR_BGR2GRAY)
    running.show_until(is_blue, picture=gray, encoding="mono8")


def test_pictures_without_camera_info_are_drawn_on_with_a_stated_guess():
    with RosSession("overlay_guess") as ros:
        client = OverlayClient(ros, "boxes:=shaded", "cards:=['ball:0.1']").listen()
        client.show_until(lambda p: is_blue(p) and has_writing(p))
        client.wait_for_message("no calibration: a field of view of 60 degrees is assumed")


@pytest.mark.parametrize(
    ("parameter", "text"),
    [
        ("boxes:=round", "expected one of wireframe, shaded"),
        ("cards:=['ball']", "expected solid:side in metres"),
        ("jpeg_quality:=0", "expected 1 to 100"),
    ],
)
def test_wrong_parameters_are_one_line(parameter, text):
    with RosSession("overlay_wrong") as ros:
        program = ros.start(NODE, "--ros-args", "-p", parameter)
        output = program.wait(60.0)
    assert program.returncode == 1 and "Traceback" not in output
    assert text in output.strip().splitlines()[-1]


def test_it_can_be_made_and_ended_in_this_process():
    with RosSession("overlay_here") as ros:
        ros.add(ArOverlay(context=ros.context))
