# SPDX-License-Identifier: Apache-2.0
"""Everything that marker_tracker takes pictures and calibrations from; where its poses go."""

import threading
import time

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from marker_client import (
    BEST_EFFORT,
    LATCHED,
    PERIOD_NS,
    SOLIDS,
    START_NS,
    TrackerClient,
    camera_info,
    is_near,
    still_picture,
)
from rclpy.serialization import serialize_message
from ros_helpers import RosSession
from sensor_msgs.msg import CompressedImage, Image
from tf2_standin import TransformBroadcaster
from tracking_helpers import BALL, CAMERA, CAMERA_FROM_WORLD, CENTRE

import sph_ros.nodes.image_source as image_source
import sph_ros.nodes.marker_publications as marker_publications
from msg_adapters.image import compressed_image_to_cdr, image_to_cdr
from msg_adapters.pose import cdr_to_pose
from sph_ros.nodes.image_source import SourceError, make_source
from sph_ros.nodes.marker_camera import CalibrationChoice, WaitingError
from sph_ros.nodes.marker_mailbox import Mailbox
from sph_ros.nodes.marker_tracker import MarkerTracker
from sph_ros.tracking.camera import CameraError, CameraModel, camera_yaml
from sph_ros.tracking.synthetic import SyntheticCamera

pytestmark = pytest.mark.usefixtures("compiled_tracker")

IN_CAMERA = ("world_marker:=-1", "solid_markers:=['ball:1:0.06']")

# ---------------------------------------------------------------- topics


def encoded(gray):
    """Encoding -> the same picture; a grey one has no colour in any of them."""
    bgr = np.repeat(gray[..., None], 3, axis=2)
    bgra = np.dstack([bgr, np.full_like(gray, 255)])
    # Grey value to luma in video range; both chroma samples at their middle.
    luma = np.round(16 + gray.astype(float) * 219 / 255).astype(np.uint8)
    middle = np.full_like(gray, 128)
    return {
        "mono8": gray,
        "mono16": gray.astype(np.uint16) * 257,
        **dict.fromkeys(("bgr8", "rgb8"), bgr),
        **dict.fromkeys(("bgra8", "rgba8"), bgra),
        "yuv422": np.dstack([middle, luma]),
        "yuv422_yuy2": np.dstack([luma, middle]),
        **dict.fromkeys(("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"), gray),
    }


def test_poses_come_from_pictures_of_every_encoding():
    with RosSession("encodings") as ros:
        client = TrackerClient(ros, SOLIDS).ready()
        client.calibrate()
        for encoding, picture in encoded(client.picture).items():
            pose = client.next_pose(picture=picture, encoding=encoding)
            assert is_near(pose, CENTRE), encoding


def padded(pixels, encoding, stamp_ns, frame):
    """As a driver sends it whose rows end at multiples of 64 bytes."""
    rows = np.zeros((480, 704), np.uint8)
    rows[:, :640] = pixels
    message = Image(height=480, width=640, encoding=encoding, step=704, data=rows.tobytes())
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    return serialize_message(message)


def test_rectified_pictures_with_padded_rows_use_the_projection_of_camera_info():
    """By the topic's name; K and D are those of another lens."""
    straight = CameraModel(640, 480, CAMERA.matrix)
    with RosSession("rectified") as ros:
        image = (Image, "image_rect", 2)
        client = TrackerClient(ros, SOLIDS, remap=("image:=image_rect",), image=image).ready()
        projection = np.column_stack([CAMERA.matrix, np.zeros(3)]).ravel().tolist()
        wrong = [300.0, 0.0, 300.0, 0.0, 300.0, 200.0, 0.0, 0.0, 1.0]
        client.calibrate(camera_info(wrong, p=projection))
        pose = client.next_pose(picture=still_picture(straight), to_cdr=padded)
        assert is_near(pose, CENTRE)


@pytest.mark.parametrize("image_format", ["jpeg", "png"])
def test_compressed_pictures_best_effort_and_a_calibration_published_once(image_format):
    """The calibration was there before the tracker, and is kept for those who come later."""
    ending = {"jpeg": ".jpg", "png": ".png"}[image_format]

    def to_cdr(pixels, _encoding, stamp_ns, frame):
        data = cv2.imencode(ending, pixels)[1].tobytes()
        return compressed_image_to_cdr(data, image_format, stamp_ns, frame)

    with RosSession("webcam") as ros:
        infos = ros.node.create_publisher(type(camera_info()), "camera_info", LATCHED)
        infos.publish(camera_info())
        image = (CompressedImage, "image/compressed", BEST_EFFORT)
        client = TrackerClient(ros, SOLIDS, image=image, info_qos=LATCHED)
        ros.node.destroy_publisher(client.infos)
        assert is_near(client.next_pose(to_cdr=to_cdr), CENTRE)
        assert is_near(client.next_pose(to_cdr=to_cdr), CENTRE)


def test_without_a_calibration_one_is_guessed_and_said():
    with RosSession("guess") as ros:
        client = TrackerClient(ros, SOLIDS).ready()
        pose = client.next_pose()
        assert is_near(pose, CENTRE, 0.03, 6.0)
        client.show_until(lambda: "approximate" in client.report()[1])
        assert client.report()[0] == DiagnosticStatus.WARN
        client.calibrate()
        client.show_until(lambda: client.report()[0] == DiagnosticStatus.OK)
        assert is_near(client.next_pose(), CENTRE)


def test_poses_are_predicted_by_the_age_of_their_pictures():
    """A ball that glides is where it is when its pose comes, not where it was in the picture."""
    speed, latency = 0.2, 0.15
    with RosSession("prediction") as ros:
        client = TrackerClient(ros, *IN_CAMERA, "prediction:=-1.0").ready()
        client.calibrate()
        camera = SyntheticCamera(CAMERA)
        begin = time.time()
        ahead = []

        def glide():
            taken = time.time()
            place = CAMERA_FROM_WORLD._replace(
                position=np.array([speed * (taken - begin) - 0.15, 0.0, 0.5])
            )
            picture = camera.take([(BALL, place)])
            client.infos.publish(client.info)
            client.images.publish(
                image_to_cdr(picture, "mono8", round((taken - latency) * 1e9), "optical")
            )
            time.sleep(0.02)
            for data in client.poses[len(ahead) :]:
                pose = cdr_to_pose(data)
                seen = speed * (pose.stamp_ns * 1e-9 + latency - begin) - 0.15
                ahead.append(pose.position[0] - seen)
            return taken - begin > 1.5 and len(ahead) > 15

        ros.wait_for(glide, what="for poses")
    lead = np.median(ahead[8:])
    # At least by the latency that was made up here; by more, as long as tracking took.
    assert 0.7 * speed * latency < lead < 3.0 * speed * latency


# ---------------------------------------------------------------- calibrations


def info_cdr(**fields):
    return serialize_message(camera_info(**fields))


def test_a_calibration_that_changes_is_followed_and_other_sizes_are_refused():
    choice = CalibrationChoice("", rectified=False, expect_messages=True)
    with pytest.raises(WaitingError):
        choice.for_picture(640, 480)
    choice.hear(info_cdr())
    assert choice.for_picture(640, 480).matrix[0, 0] == CAMERA.matrix[0, 0]
    choice.hear(info_cdr(matrix=[700.0, 0.0, 320.0, 0.0, 700.0, 240.0, 0.0, 0.0, 1.0]))
    assert choice.for_picture(640, 480).matrix[0, 0] == 700.0
    with pytest.raises(CameraError, match="320 x 240"):
        choice.for_picture(320, 240)
    choice.hear(info_cdr(distortion_model="fish"))
    with pytest.raises(CameraError, match="fish"):
        choice.for_picture(640, 480)
    choice.hear(info_cdr())
    assert choice.note(choice.for_picture(640, 480)) == ""


def test_a_calibration_file_that_comes_later_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr("sph_ros.nodes.marker_camera.RETRY_TIME", 0.0)
    path = tmp_path / "camera.yaml"
    choice = CalibrationChoice(str(path), rectified=False, expect_messages=True)
    with pytest.raises(CameraError, match=r"camera.yaml: cannot be read \(No such file"):
        choice.for_picture(640, 480)
    path.write_text(camera_yaml(CAMERA))
    assert choice.for_picture(640, 480).width == 640


# ---------------------------------------------------------------- sources


def poses_of(ros, name, *parameters):
    """Poses of a marker in something the node opens itself."""
    poses = ros.collect(PoseStamped, f"/marker_tracker/{name}/pose", raw=True)
    arguments = [word for text in parameters for word in ("-p", text)]
    ros.add(MarkerTracker(context=ros.context, cli_args=["--ros-args", *arguments]))
    ros.wait_for(lambda: len(poses) >= 3, what="for poses")
    return [cdr_to_pose(data) for data in poses]


def test_a_recorded_bag_with_its_own_stamps_and_calibration(shared_data):
    bag = shared_data / "bags/webcam_sksurgery_mcap"
    hand = ("world_marker:=-1", "solid_markers:=['hand:0:0.05']", "filter:=none")
    with RosSession("bag") as ros:
        poses = poses_of(ros, "hand", f"source:={bag}", *hand)
    assert abs(poses[0].position[2] - 0.21) < 0.03
    assert poses[0].frame_id not in ("", "world") and poses[0].stamp_ns < time.time_ns() - 10**12


def test_a_video_with_opencvs_calibration_file(shared_data):
    video = shared_data / "markers/sksurgery/output.avi"
    calibration = shared_data / "markers/opencv_doc/tutorial_camera_params.yml"
    hand = ("world_marker:=-1", "solid_markers:=['hand:0:0.05']", "loop:=true")
    with RosSession("video") as ros:
        source = (f"source:={video}", f"camera_info_url:={calibration}")
        poses = poses_of(ros, "hand", *source, *hand)
    # The manifest's 0.21 m are with a focal length of 560 pixels.
    assert abs(poses[0].position[2] - 0.21 * 628.158 / 560) < 0.02


def test_a_folder_of_pictures(tmp_path):
    (tmp_path / "pictures").mkdir()
    picture = SyntheticCamera(CAMERA).take([(BALL, CAMERA_FROM_WORLD)])
    cv2.imwrite(str(tmp_path / "pictures/0.png"), picture)
    calibration = tmp_path / "camera.yaml"
    calibration.write_text(camera_yaml(CAMERA))
    with RosSession("folder") as ros:
        source = (f"source:={tmp_path / 'pictures'}", f"camera_info_url:=file://{calibration}")
        (pose, *_) = poses_of(ros, "ball", *source, "loop:=true", *IN_CAMERA)
    assert is_near(pose, CAMERA_FROM_WORLD) and pose.frame_id == "camera"


class Camera:
    """What looks like a cv2.VideoCapture of a camera that can be unplugged."""

    there = threading.Event()
    picture = None

    def __init__(self, device):
        self.opened = device == 0 and Camera.there.is_set()

    def isOpened(self):  # noqa: N802
        return self.opened

    def read(self):
        time.sleep(1 / 60)
        return Camera.there.is_set(), Camera.picture

    def release(self):
        self.opened = False


def test_a_camera_that_is_missing_comes_goes_and_comes_again(monkeypatch):
    monkeypatch.setattr(image_source.cv2, "VideoCapture", Camera)
    monkeypatch.setattr(image_source, "RETRY_TIME", 0.05)
    Camera.picture = np.repeat(still_picture()[..., None], 3, axis=2)
    with RosSession("camera") as ros:
        client = TrackerClient(ros, "source:=0", SOLIDS, image=None)
        client.wait_for_message("camera 0 cannot be opened", level=DiagnosticStatus.ERROR)
        for _ in range(2):
            Camera.there.set()
            count = len(client.poses)
            ros.wait_for(lambda count=count: len(client.poses) > count + 5)
            ros.wait_for(lambda: client.report()[0] != DiagnosticStatus.ERROR)
            Camera.there.clear()
            client.wait_for_message("camera 0", level=DiagnosticStatus.ERROR)


def test_sources_that_are_none(tmp_path):
    (tmp_path / "file.txt").write_text("no video")
    for text in (str(tmp_path / "nothing"), str(tmp_path), str(tmp_path / "file.txt")):
        with pytest.raises(SourceError, match=str(tmp_path)):
            make_source(text, print)


def test_a_mailbox_keeps_the_newest():
    mailbox = Mailbox()
    assert mailbox.get(0.0) is None
    for thing in (1, 2, 3):
        mailbox.put(thing)
    assert mailbox.get(0.0) == 3 and mailbox.get(0.0) is None and mailbox.dropped == 2


def test_pictures_that_come_faster_than_they_are_fetched_are_dropped_and_counted():
    with RosSession("flood") as ros:
        client = TrackerClient(ros, SOLIDS).ready()
        client.calibrate()
        client.next_pose()
        for _ in range(60):
            client.show()
        client.next_pose()  # the newest is not behind any of them
        names = ("pictures_processed", "pictures_refused", "pictures_dropped")

        def counts():
            """Once all that were shown are reported; one or two came before the subscription."""
            found = [int(client.report()[2].get(name, 0)) for name in names]
            return sum(found) >= (client.stamp_ns - START_NS) // PERIOD_NS - 5 and found

        processed, refused, dropped = ros.wait_for(counts)
        assert dropped > 40 and refused == 0 and processed < 30


# ---------------------------------------------------------------- transforms


def test_poses_go_to_tf_where_it_is_installed(monkeypatch):
    monkeypatch.setattr(marker_publications, "tf2_ros", TransformBroadcaster.module())
    sent = TransformBroadcaster.sent
    with RosSession("tf") as ros:
        client = TrackerClient(ros, SOLIDS).ready()
        client.calibrate()
        pose = client.next_pose()
        ros.wait_for(lambda: any(t.header.stamp.nanosec == pose.stamp_ns % 10**9 for t in sent))
        transforms = {t.child_frame_id: t for t in sent}
        assert set(transforms) == {"ball", "optical"}
        ball, camera = transforms["ball"], transforms["optical"]
        assert ball.header.frame_id == camera.header.frame_id == "world"
        shift = ball.transform.translation
        assert np.allclose((shift.x, shift.y, shift.z), CENTRE.position, atol=0.003)
        shift = camera.transform.translation
        expected = CAMERA_FROM_WORLD.inverse().position
        assert np.allclose((shift.x, shift.y, shift.z), expected, atol=0.01)


def test_without_tf2_ros_poses_go_to_their_topics_and_it_is_said(capfd):
    if marker_publications.tf2_ros is not None:
        pytest.skip("tf2_ros is installed")
    with RosSession("no_tf") as ros:
        node = ros.add(MarkerTracker(context=ros.context, cli_args=["--ros-args"]))
        topics = [name for name, _ in node.get_topic_names_and_types()]
        assert "/tf" not in topics
    assert "tf2_ros is not installed" in capfd.readouterr().err
