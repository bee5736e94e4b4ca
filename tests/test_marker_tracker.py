# SPDX-License-Identifier: Apache-2.0
"""marker_tracker as its users meet it: a real process, real DDS, rendered and recorded pictures."""

import time

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_helpers import RosSession
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from tracking_helpers import BALL, CAMERA, CAMERA_FROM_WORLD, CENTRE, WORLD, truth_of_hand

from msg_adapters.image import cdr_to_image, compressed_image_to_cdr, image_to_cdr
from msg_adapters.pose import cdr_to_pose
from sph_ros.nodes.image_source import DeviceSource, SourceError, make_source
from sph_ros.nodes.marker_mailbox import Mailbox
from sph_ros.nodes.marker_publications import transform_message
from sph_ros.tracking.camera import camera_yaml
from sph_ros.tracking.se3 import Pose, difference, pose_from_quaternion
from sph_ros.tracking.synthetic import Flaws, SyntheticCamera

NODE = "sph_ros.nodes.marker_tracker"
SOLIDS = "solid_markers:=['ball:1:0.06']"
START_NS = 1_700_000_000 * 10**9
PERIOD_NS = 33_333_333
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def camera_info(matrix=None, **fields):
    matrix = CAMERA.matrix.ravel().tolist() if matrix is None else matrix
    message = CameraInfo(width=640, height=480, distortion_model="plumb_bob", k=matrix)
    message.d = CAMERA.distortion.tolist()
    for key, value in fields.items():
        setattr(message, key, value)
    return message


class TrackerClient:
    """A running marker_tracker, what it published, and a camera that looks at a still scene."""

    def __init__(self, ros, *parameters, image_qos=2, listen=True):
        self.ros = ros
        self.images = ros.node.create_publisher(Image, "image", image_qos)
        self.infos = ros.node.create_publisher(CameraInfo, "camera_info", 2)
        self.reports = ros.collect(DiagnosticArray, "/diagnostics")
        self.poses = []
        if listen:
            self.poses = ros.collect(PoseStamped, "/marker_tracker/ball/pose", raw=True)
        arguments = [text for p in parameters for text in ("-p", p)]
        self.program = ros.start(NODE, "--ros-args", *arguments)
        self.picture = SyntheticCamera(CAMERA, flaws=Flaws()).take(
            [(WORLD, CAMERA_FROM_WORLD), (BALL, CAMERA_FROM_WORLD @ CENTRE)]
        )
        self.stamp_ns = START_NS

    def ready(self):
        self.ros.wait_for(self.images.get_subscription_count, what="for marker_tracker")
        self.ros.wait_for(self.infos.get_subscription_count, what="for marker_tracker")
        return self

    def show(self, picture=None, encoding="mono8"):
        """Publish a picture, a thirtieth of a second after the last one; returns its stamp."""
        self.stamp_ns += PERIOD_NS
        picture = self.picture if picture is None else picture
        self.images.publish(image_to_cdr(picture, encoding, self.stamp_ns, "optical"))
        return self.stamp_ns

    def calibrate(self, message=None):
        self.infos.publish(camera_info() if message is None else message)

    def show_until(self, condition, timeout=20.0, **kwargs):
        """Show pictures, 30 a second, until something holds."""

        def check():
            self.show(**kwargs)
            time.sleep(1 / 30)
            return condition()

        return self.ros.wait_for(check, timeout)

    def pose_after(self, count):
        """Show pictures until poses come again; the newest."""
        self.show_until(lambda: len(self.poses) > count + 2)
        return cdr_to_pose(self.poses[-1])

    def report(self, name="input"):
        """Newest diagnostics of a part: (level, message, values)."""
        for array in reversed(self.reports):
            for status in array.status:
                if status.name == f"marker_tracker: {name}":
                    return status.level, status.message, {v.key: v.value for v in status.values}
        return DiagnosticStatus.OK, "", {}

    def wait_for_message(self, text, name="input", level=None):
        def said():
            present, message, _ = self.report(name)
            return text in message and level in (None, present)

        self.ros.wait_for(said, what=f"for {text!r}, last {self.report(name)}")


def is_near(message, true, metres=0.003, degrees=2.0):
    off = difference(pose_from_quaternion(message.position, message.quat_xyzw), true)
    return np.linalg.norm(off[:3]) < metres and np.degrees(np.linalg.norm(off[3:])) < degrees


@pytest.fixture(scope="module")
def running():
    with RosSession("camera") as ros:
        client = TrackerClient(ros, SOLIDS).ready()
        client.calibrate()
        client.pose_after(0)
        yield client
        assert client.program.running, client.program.output
        output = client.program.interrupt()
        assert client.program.returncode == 0 and "Traceback" not in output, output


# ---------------------------------------------------------------- poses


def test_poses_have_the_stamps_of_their_pictures_and_the_worlds_frame(running):
    covariances = running.ros.collect(
        PoseWithCovarianceStamped, "/marker_tracker/ball/pose_with_covariance"
    )
    cameras = running.ros.collect(PoseStamped, "/marker_tracker/camera_pose", raw=True)
    running.show_until(lambda: covariances and cameras)
    begin = len(running.poses)
    shown = set()
    running.show_until(lambda: shown.add(running.stamp_ns) or len(running.poses) > begin + 10)
    poses = [cdr_to_pose(data) for data in running.poses[begin + 3 :]]
    assert {pose.stamp_ns for pose in poses} <= shown
    assert all(pose.frame_id == "world" and is_near(pose, CENTRE) for pose in poses)
    camera = cdr_to_pose(cameras[-1])
    assert is_near(camera, CAMERA_FROM_WORLD.inverse(), 0.01) and camera.frame_id == "world"
    covariance = np.reshape(covariances[-1].pose.covariance, (6, 6))
    assert np.allclose(covariance, covariance.T) and np.linalg.eigvalsh(covariance).min() > 0.0
    assert 1e-5 < np.sqrt(covariance[0, 0]) < 0.01


def test_debug_picture_shows_what_was_found(running):
    pictures = running.ros.collect(Image, "/marker_tracker/debug_image", raw=True)
    running.show_until(lambda: len(pictures) > 2)
    picture = cdr_to_image(pictures[-1])
    assert picture.encoding == "bgr8" and picture.pixels.shape == (480, 640, 3)
    colored = np.ptp(picture.pixels.astype(int), axis=2) > 60  # the camera's picture is grey
    assert colored.sum() > 500


def test_bad_pictures_are_named_and_good_ones_follow(running):
    def refused(text, data):
        running.images.publish(data)
        running.wait_for_message(text, level=DiagnosticStatus.ERROR)
        assert is_near(running.pose_after(len(running.poses)), CENTRE)

    good = image_to_cdr(running.picture, "mono8", running.stamp_ns, "optical")
    refused("encoding is 'mono9'", good.replace(b"mono8", b"mono9"))
    refused("empty", image_to_cdr(np.zeros((0, 0), np.uint8), "mono8", 1, "optical"))
    depth = np.zeros((480, 640), np.float32)
    refused("32FC1", image_to_cdr(depth, "32FC1", running.stamp_ns, "optical"))
    small = image_to_cdr(running.picture[:240, :320].copy(), "mono8", running.stamp_ns, "optical")
    refused("320 x 240 pixels, but its calibration is for 640 x 480", small)
    refused("sensor_msgs/msg/Image", good[:1000])
    running.show_until(lambda: running.report()[0] == DiagnosticStatus.OK)


@pytest.mark.parametrize(
    ("message", "text", "level"),
    [
        (camera_info([float("nan")] * 9), "finite", DiagnosticStatus.ERROR),
        (camera_info(d=[float("nan")] * 5), "not finite", DiagnosticStatus.ERROR),
        (camera_info(distortion_model="fish"), "'fish'", DiagnosticStatus.ERROR),
        (camera_info([0.0] * 9), "scale is approximate", DiagnosticStatus.WARN),
    ],
)
def test_bad_calibrations_are_named_and_good_ones_follow(running, message, text, level):
    running.calibrate(message)

    def said():
        present, words, _ = running.report()
        return text in words and present == level

    running.show_until(said)
    running.calibrate()
    assert is_near(running.pose_after(len(running.poses)), CENTRE)


def test_the_same_marker_twice_and_no_world_marker(running):
    camera = SyntheticCamera(CAMERA, flaws=Flaws())
    aside = Pose(CENTRE.rotation, CENTRE.position - (0.2, 0.0, 0.0))
    ball, other = (CAMERA_FROM_WORLD @ pose for pose in (CENTRE, aside))
    twice = camera.take([(WORLD, CAMERA_FROM_WORLD), (BALL, ball), (BALL, other)])
    running.show_until(lambda: "2 times" in running.report()[1], picture=twice)
    assert is_near(cdr_to_pose(running.poses[-1]), CENTRE)
    alone = camera.take([(BALL, ball)])
    running.show_until(lambda: "was not seen" in running.report()[1], picture=alone)
    running.wait_for_message("world", name="solid ball", level=DiagnosticStatus.WARN)
    assert is_near(running.pose_after(len(running.poses)), CENTRE)


def test_nobody_listening_means_no_pictures():
    with RosSession("lazy") as ros:
        client = TrackerClient(ros, SOLIDS, listen=False)
        ros.wait_for(client.infos.get_subscription_count, what="for marker_tracker")
        client.wait_for_message("idle")
        assert client.images.get_subscription_count() == 0
        heard = []
        listener = ros.node.create_subscription(
            PoseStamped, "/marker_tracker/ball/pose", heard.append, 10
        )
        ros.wait_for(client.images.get_subscription_count)
        ros.node.destroy_subscription(listener)
        ros.wait_for(lambda: client.images.get_subscription_count() == 0)


# ---------------------------------------------------------------- other inputs


def test_compressed_pictures_guessed_calibration_best_effort():
    """What a webcam driver without calibration sends; jpeg, with sensor QoS."""
    with RosSession("webcam") as ros:
        publisher = ros.node.create_publisher(CompressedImage, "image/compressed", BEST_EFFORT)
        poses = ros.collect(PoseStamped, "/marker_tracker/ball/pose", raw=True)
        reports = ros.collect(DiagnosticArray, "/diagnostics")
        ros.start(NODE, "--ros-args", "-p", SOLIDS)
        picture = SyntheticCamera(CAMERA, flaws=Flaws()).take(
            [(WORLD, CAMERA_FROM_WORLD), (BALL, CAMERA_FROM_WORLD @ CENTRE)]
        )
        data = cv2.imencode(".jpg", picture)[1].tobytes()
        stamp = [START_NS]

        def come():
            stamp[0] += PERIOD_NS
            publisher.publish(compressed_image_to_cdr(data, "jpeg", stamp[0], "optical"))
            time.sleep(1 / 30)
            return len(poses) > 5 and any("approximate" in s.message
                                          for r in reports for s in r.status)  # fmt: skip

        ros.wait_for(come)
        assert is_near(cdr_to_pose(poses[-1]), CENTRE, 0.03, 6.0)


def test_a_wrong_marker_size_waits_to_be_mended():
    with RosSession("size") as ros:
        client = TrackerClient(ros, "solid_markers:=['ball:1']", "marker_size:=0.0").ready()
        client.calibrate()
        client.show_until(lambda: "marker_size" in client.report()[1])
        assert client.report()[0] == DiagnosticStatus.ERROR and not client.poses
        for size, fine in ((0.0, False), (0.08, True)):
            value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=size)
            request = SetParameters.Request(parameters=[Parameter(name="marker_size", value=value)])
            response = ros.call(SetParameters, "/marker_tracker/set_parameters", request)
            assert response.results[0].successful == fine
        client.show_until(lambda: len(client.poses) > 3)


def listen_to_source(*parameters, count=3, marker="hand"):
    """Poses of a marker that is tracked in something the node opens itself."""
    with RosSession("source") as ros:
        poses = ros.collect(PoseStamped, f"/marker_tracker/{marker}/pose", raw=True)
        arguments = [text for p in parameters for text in ("-p", p)]
        program = ros.start(NODE, "--ros-args", *arguments)
        ros.wait_for(lambda: len(poses) >= count, what="for poses")
        program.terminate()
        assert program.returncode == 0, program.output
        return [cdr_to_pose(data) for data in poses]


def test_a_recorded_bag_with_its_own_stamps_and_calibration(shared_data):
    bag = shared_data / "bags/webcam_sksurgery_mcap"
    poses = listen_to_source(
        f"source:={bag}", "world_marker:=-1", "solid_markers:=['hand:0:0.05']", "filter:=none"
    )
    assert abs(poses[0].position[2] - 0.21) < 0.03
    assert poses[0].frame_id not in ("", "world")


def test_a_video_and_a_folder(shared_data, tmp_path):
    calibration = tmp_path / "camera.yaml"
    calibration.write_text(camera_yaml(CAMERA))
    video = shared_data / "markers/sksurgery/output.avi"
    settings = ("world_marker:=-1", "solid_markers:=['hand:0:0.05']", "loop:=true")
    poses = listen_to_source(f"source:={video}", f"camera_info_url:={calibration}", *settings)
    assert abs(poses[0].position[2] - 0.21) < 0.04
    folder = tmp_path / "pictures"
    folder.mkdir()
    picture = SyntheticCamera(CAMERA).take([(BALL, CAMERA_FROM_WORLD)])
    cv2.imwrite(str(folder / "0.png"), picture)
    (poses, *_) = listen_to_source(
        f"source:={folder}", f"camera_info_url:=file://{calibration}", "loop:=true",
        "world_marker:=-1", "solid_markers:=['hand:1:0.06']",
    )  # fmt: skip
    assert is_near(poses, CAMERA_FROM_WORLD)


def test_no_camera_is_said_and_waited_for():
    with RosSession("nocamera") as ros:
        reports = ros.collect(DiagnosticArray, "/diagnostics")
        ros.collect(PoseStamped, "/marker_tracker/ball/pose")
        program = ros.start(NODE, "--ros-args", "-p", "source:=63")
        text = "camera 63 cannot be opened"
        ros.wait_for(lambda: any(text in s.message for r in reports for s in r.status))
        program.interrupt()
        assert program.returncode == 0


class Unpluggable:
    """What looks like a cv2.VideoCapture: gives three pictures, then none."""

    opened = 0

    def __init__(self, _device):
        Unpluggable.opened += 1
        self._left = 3
        self._there = Unpluggable.opened != 2  # the second time it is still away

    def isOpened(self):  # noqa: N802
        return self._there

    def read(self):
        self._left -= 1
        return self._left >= 0, np.zeros((4, 4, 3), np.uint8)

    def release(self):
        pass


def test_an_unplugged_camera_is_opened_again():
    pictures, problems = [], []
    source = DeviceSource(pictures.append, 0, open_capture=Unpluggable, retry_time=0.01)
    source.start()
    deadline = time.monotonic() + 10.0
    while len(pictures) < 9 and time.monotonic() < deadline:
        problems.append(source.problem)
        time.sleep(0.002)
    source.stop()
    assert len(pictures) >= 9 and Unpluggable.opened >= 4
    assert any("unplugged" in p or "cannot be opened" in p for p in problems)


def test_sources_that_are_none(tmp_path):
    (tmp_path / "file.txt").write_text("no video")
    for text in (str(tmp_path / "nothing"), str(tmp_path), str(tmp_path / "file.txt")):
        with pytest.raises(SourceError, match=str(tmp_path)):
            make_source(text, print)


@pytest.mark.parametrize(
    ("parameter", "expected"),
    [
        ("dictionary:=DICT_4X4", "DICT_4X4_50"),
        ("filter:=average", "kalman, one_euro, none"),
        ("solid_markers:=['ball']", "name:id"),
        ("solid_markers:=['ball:0']", "id 0 belongs to"),
        ("source:=/no/such/video.avi", "/no/such/video.avi"),
        ("boards:=/no/such/boards.yaml", "/no/such/boards.yaml"),
        ("corner_noise:=-1.0", "corner_noise"),
    ],
)
def test_mistakes_are_one_line_and_exit_status_1(parameter, expected):
    with RosSession("mistake") as ros:
        program = ros.start(NODE, "--ros-args", "-p", parameter, "--log-level", "warn")
        output = program.wait()
    assert program.returncode == 1
    assert expected in output and len(output.strip().splitlines()) == 1, output


# ---------------------------------------------------------------- parts


def test_a_mailbox_keeps_the_newest():
    mailbox = Mailbox()
    assert mailbox.get(0.0) is None
    for thing in (1, 2, 3):
        mailbox.put(thing)
    assert mailbox.get(0.0) == 3 and mailbox.get(0.0) is None and mailbox.dropped == 2


def test_transform_message():
    message = transform_message(CENTRE, 1_500_000_000, "world", "ball")
    assert (message.header.frame_id, message.child_frame_id) == ("world", "ball")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 500_000_000)
    assert message.transform.translation.x == CENTRE.position[0]
    assert message.transform.rotation.w == 1.0


# ---------------------------------------------------------------- all the way to the liquid

TANK = """
spacing: 0.02
time_step: 0.005
liquid:
  - box: {min: [0, -0.05, 0], max: [0.24, 0.15, 0.06]}
solids:
  - name: tank
    container:
      box: {min: [0, -0.05, 0], max: [0.24, 0.15, 0.3]}
  - name: ball
    sphere: {radius: 0.03}
    pose: {position: [0.12, 0.05, 0.15]}
    control: topic
"""


def test_a_marker_wand_stirs_the_liquid(tmp_path):
    """Rendered pictures -> marker_tracker -> DDS -> fluid_node, each in its own process."""
    scene = tmp_path / "tank.yaml"
    scene.write_text(TANK)
    times, truth, _ = truth_of_hand(3.0, reach=0.02, tilt=0.2)
    camera = SyntheticCamera(CAMERA, flaws=Flaws(noise=4, defocus=0.8, light_change=0.2))
    pictures = []
    for k, pose in enumerate(truth):
        ball = [] if 40 <= k < 46 else [(BALL, CAMERA_FROM_WORLD @ pose)]
        pictures.append(camera.take([(WORLD, CAMERA_FROM_WORLD), *ball], times[k]))
    with RosSession("stir") as ros:
        clouds = ros.collect(PointCloud2, "/fluid/particles", raw=True)
        poses = ros.collect(PoseStamped, "/fluid/solids/ball/pose", raw=True)
        reports = ros.collect(DiagnosticArray, "/diagnostics")
        images = ros.node.create_publisher(Image, "image", 2)
        infos = ros.node.create_publisher(CameraInfo, "camera_info", 2)
        remap = "/marker_tracker/ball/pose:=/fluid/solids/ball/pose"
        ros.start("sph_ros.nodes.fluid_node", "--ros-args", "-p", f"scene:={scene}")
        ros.start(NODE, "--ros-args", "-p", SOLIDS, "-r", remap)
        ros.wait_for(lambda: clouds and images.get_subscription_count(), 90.0)
        ros.wait_for(infos.get_subscription_count)
        infos.publish(camera_info())
        time.sleep(0.2)
        begin = time.monotonic()
        for k, picture in enumerate(pictures):
            time.sleep(max(0.0, begin + times[k] - time.monotonic()))
            stamp = START_NS + round(times[k] * 1e9)
            images.publish(image_to_cdr(picture, "mono8", stamp, "optical"))

        def accepted():
            values = {
                v.key: v.value for r in reports for s in r.status
                if s.name == "fluid: solid ball" for v in s.values
            }  # fmt: skip
            return int(values.get("poses_accepted", 0)) > 40

        ros.wait_for(accepted, what="for the liquid's node to use the poses")
    heard = [cdr_to_pose(data) for data in poses]
    assert len(heard) > 50
    off = []
    for pose in heard:
        frame = round((pose.stamp_ns - START_NS) * 30e-9)
        if not 40 <= frame < 52:
            off.append(np.subtract(pose.position, truth[frame].position))
    assert np.sqrt(np.mean(np.sum(np.square(off), axis=1))) < 0.004
