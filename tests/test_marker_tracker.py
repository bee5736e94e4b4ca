# SPDX-License-Identifier: Apache-2.0
"""marker_tracker as its users meet it: real DDS, rendered pictures, mistakes, the liquid's node."""

import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from marker_client import NODE, SOLIDS, START_NS, TrackerClient, camera_info, is_near
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from ros_helpers import RosSession
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from tracking_helpers import (
    BALL,
    CAMERA,
    CAMERA_FROM_WORLD,
    CENTRE,
    HARD_GAPS,
    HARD_TURN,
    WORLD,
    hard_hand,
)

from msg_adapters.image import cdr_to_image, image_to_cdr
from msg_adapters.pose import cdr_to_pose
from sph_ros.nodes.image_source import SourceError
from sph_ros.nodes.marker_parameters import TrackerParameterError
from sph_ros.nodes.marker_tracker import MarkerTracker
from sph_ros.tracking.se3 import Pose
from sph_ros.tracking.synthetic import Flaws, SyntheticCamera
from sph_ros.tracking.targets import TargetError

pytestmark = pytest.mark.usefixtures("compiled_tracker")


@pytest.fixture(scope="module")
def running():
    with RosSession("camera") as ros:
        client = TrackerClient(ros, SOLIDS, own_process=True).ready()
        client.calibrate()
        client.next_pose()
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
    assert {pose.frame_id for pose in poses} == {"world"}
    assert not [pose for pose in poses if not is_near(pose, CENTRE)]
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
        assert is_near(running.next_pose(), CENTRE)

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
    assert is_near(running.next_pose(), CENTRE)


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
    assert is_near(running.next_pose(), CENTRE)


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


@pytest.mark.parametrize(
    ("parameter", "expected"),
    [
        ("filter:=average", "kalman, one_euro, none"),
        ("solid_markers:=['ball']", "name:id"),
        ("solid_markers:=['ball:0']", "id 0 belongs to"),
        ("source:=/no/such/video.avi", "/no/such/video.avi"),
        ("boards:=/no/such/boards.yaml", "/no/such/boards.yaml"),
        ("corner_noise:=-1.0", "corner_noise"),
    ],
)
def test_mistakes_are_named_in_one_line(parameter, expected):
    mistakes = (TrackerParameterError, TargetError, SourceError)
    with RosSession("mistake") as ros, pytest.raises(mistakes) as caught:
        MarkerTracker(context=ros.context, cli_args=["--ros-args", "-p", parameter])
    assert expected in str(caught.value) and "\n" not in str(caught.value)


def test_a_mistake_ends_the_program_with_one_line_and_exit_status_1():
    with RosSession("mistake") as ros:
        parameters = ("-p", "dictionary:=DICT_4X4", "--log-level", "warn")
        program = ros.start(NODE, "--ros-args", *parameters)
        output = program.wait()
    assert program.returncode == 1
    assert "DICT_4X4_50" in output and len(output.strip().splitlines()) == 1, output


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


def test_a_marker_wand_stirs_the_liquid(tmp_path, compiled_liquid):
    """Pictures with all flaws -> marker_tracker -> DDS -> fluid_node, each in its own process."""
    scene = tmp_path / "tank.yaml"
    scene.write_text(TANK)
    times, truth, pictures = hard_hand()
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

        def show(picture, stamp):
            infos.publish(camera_info())
            images.publish(image_to_cdr(picture, "mono8", stamp, "optical"))

        def accepted():
            values = {
                v.key: v.value for r in reports for s in r.status
                if s.name == "fluid: solid ball" for v in s.values
            }  # fmt: skip
            return int(values.get("poses_accepted", 0))

        # Now and then two processes take seconds to find each other: the hand waits for that.
        start = START_NS
        while not accepted():
            assert start < START_NS + 20e9, "the liquid's node hears no poses"
            show(pictures[0], start)
            start += round(1e9 / 30)
            time.sleep(1 / 30)
        before, begin = accepted(), time.monotonic()
        for moment, picture in zip(times, pictures, strict=True):
            time.sleep(max(0.0, begin + moment - time.monotonic()))
            show(picture, start + round(moment * 1e9))
        ros.wait_for(
            lambda: accepted() > before + 40, what="for the liquid's node to use the poses"
        )
    heard = [pose for pose in map(cdr_to_pose, poses) if pose.stamp_ns >= start]
    assert len(heard) > 50
    gaps = (*HARD_GAPS, HARD_TURN)
    off, coasting, holding = [], [], []
    for pose in heard:
        frame = round((pose.stamp_ns - start) * 30e-9)
        error = np.linalg.norm(np.subtract(pose.position, truth[frame].position))
        unseen = [begin for begin, end in gaps if begin <= frame < end]
        if unseen:
            coasting.append(error)
            seen = truth[unseen[0] - 1].position
            holding.append(np.linalg.norm(np.subtract(seen, truth[frame].position)))
        elif not any(begin <= frame < end + 6 for begin, end in gaps):  # found again
            off.append(error)
    assert np.sqrt(np.mean(np.square(off))) < 0.008
    assert np.mean(coasting) < 0.8 * np.mean(holding)  # than resting where it was last seen
