# SPDX-License-Identifier: Apache-2.0
"""A marker_tracker, what it says, and a camera that looks at a still scene."""

import time

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image
from tracking_helpers import BALL, CAMERA, CAMERA_FROM_WORLD, CENTRE, WORLD

from msg_adapters.image import image_to_cdr
from msg_adapters.pose import cdr_to_pose
from sph_ros.nodes.marker_tracker import MarkerTracker
from sph_ros.tracking.se3 import difference, pose_from_quaternion
from sph_ros.tracking.synthetic import Flaws, SyntheticCamera

NODE = "sph_ros.nodes.marker_tracker"
SOLIDS = "solid_markers:=['ball:1:0.06']"
START_NS = 1_700_000_000 * 10**9
PERIOD_NS = 33_333_333
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def still_picture(camera=CAMERA):
    """World and ball at CENTRE, (480, 640) uint8."""
    placed = [(WORLD, CAMERA_FROM_WORLD), (BALL, CAMERA_FROM_WORLD @ CENTRE)]
    return SyntheticCamera(camera, flaws=Flaws()).take(placed)


def camera_info(matrix=None, **fields):
    matrix = CAMERA.matrix.ravel().tolist() if matrix is None else matrix
    message = CameraInfo(width=640, height=480, distortion_model="plumb_bob", k=matrix)
    message.d = CAMERA.distortion.tolist()
    for key, value in fields.items():
        setattr(message, key, value)
    return message


class TrackerClient:
    """A marker_tracker and everything around it.

    Args:
        ros: RosSession.
        parameters: such as SOLIDS.
        remap: such as `image:=other`.
        own_process: else it runs in the session's own executor, which saves its start.
        listen: whether its poses are listened to.
        image: (type, topic, qos) of the pictures; None when it opens them itself.
        info_qos: of camera_info.
    """

    def __init__(
        self,
        ros,
        *parameters,
        remap=(),
        own_process=False,
        listen=True,
        image=(Image, "image", 2),
        info_qos=2,
    ):
        self.ros = ros
        if image is not None:
            self.images = ros.node.create_publisher(*image)
            self.infos = ros.node.create_publisher(CameraInfo, "camera_info", info_qos)
        self.reports = ros.collect(DiagnosticArray, "/diagnostics")
        self.poses = []
        if listen:
            self.poses = ros.collect(PoseStamped, "/marker_tracker/ball/pose", raw=True)
        arguments = ["--ros-args"]
        arguments += [word for text in parameters for word in ("-p", text)]
        arguments += [word for text in remap for word in ("-r", text)]
        if own_process:
            self.program = ros.start(NODE, *arguments)
        else:
            self.node = ros.add(MarkerTracker(context=ros.context, cli_args=arguments))
        self.picture, self.info = still_picture(), None
        self.stamp_ns = START_NS

    def ready(self):
        self.ros.wait_for(self.images.get_subscription_count, what="for marker_tracker")
        self.ros.wait_for(self.infos.get_subscription_count, what="for marker_tracker")
        return self

    def show(self, picture=None, encoding="mono8", to_cdr=image_to_cdr):
        """Publish a picture, a thirtieth of a second after the last one; returns its stamp."""
        self.stamp_ns += PERIOD_NS
        picture = self.picture if picture is None else picture
        if self.info is not None:
            self.infos.publish(self.info)
        self.images.publish(to_cdr(picture, encoding, self.stamp_ns, "optical"))
        return self.stamp_ns

    def calibrate(self, message=None):
        """From now on send a camera_info with each picture, as drivers do.

        One that is sent alone just when two processes find each other may take three seconds.
        """
        self.info = camera_info() if message is None else message
        self.infos.publish(self.info)

    def show_until(self, condition, timeout=20.0, **kwargs):
        """Show pictures, 30 a second, until something holds."""

        def check():
            self.show(**kwargs)
            time.sleep(1 / 30)
            return condition()

        return self.ros.wait_for(check, timeout)

    def next_pose(self, **kwargs):
        """Show pictures until poses of these very pictures come; the newest."""
        first = self.show(**kwargs)

        def come():
            return self.poses and cdr_to_pose(self.poses[-1]).stamp_ns > first

        self.show_until(come, **kwargs)
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
