# SPDX-License-Identifier: Apache-2.0
"""``ar_overlay``: the camera's picture with the liquid in it.

Callbacks only put what comes into a matcher; a thread of its own draws the newest picture whose
pose and liquid are there. While nobody listens nothing is subscribed to. What is wrong is written
into the picture itself, where the user looks, besides the log and /diagnostics.
"""

import sys
import threading
import time
from dataclasses import replace
from functools import partial

import cv2
import numba
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from msg_adapters.header import NANOSECONDS
from msg_adapters.image import (
    COMPRESSED_IMAGE,
    IMAGE,
    compressed_image_to_cdr,
    image_to_cdr,
)
from msg_adapters.pose import cdr_to_pose
from sph_ros.nodes.frames import make_transform
from sph_ros.nodes.help_texts import help_text
from sph_ros.nodes.image_source import Encoded, decoded
from sph_ros.nodes.marker_camera import CalibrationChoice, WaitingError
from sph_ros.nodes.marker_diagnostics import Problems, input_status
from sph_ros.nodes.overlay_liquid import LiquidStates, stamp_of
from sph_ros.nodes.overlay_matching import Matcher
from sph_ros.nodes.overlay_parameters import OverlayParameterError, OverlayParameters
from sph_ros.nodes.picture_topics import PictureTopics
from sph_ros.nodes.running import run_node
from sph_ros.render.overlay import Overlay, draw_once
from sph_ros.tracking.camera import CameraError
from sph_ros.tracking.drawing import draw_notes
from sph_ros.tracking.images import to_bgr
from sph_ros.tracking.se3 import pose_from_quaternion
from sph_ros.waiting import tell_while_waiting, words

#: How often it is looked whether anybody listens [s].
ATTENTION_PERIOD = 0.2

#: What has not come for so long [s] is missed: pictures, poses of the camera, the liquid.
SILENCE, POSE_SILENCE, LIQUID_SILENCE = 2.0, 0.5, 3.0

#: A picture older than this [s] is a recording: its age does not say when it was taken.
LONGEST_LATENCY = 1.0


class ArOverlay(Node):
    """The overlay node, named `ar_overlay`. Compiled when the constructor returns.

    Args:
        kwargs: for `rclpy.node.Node`.

    Raises:
        OverlayParameterError: a parameter is wrong.
    """

    def __init__(self, **kwargs):
        super().__init__("ar_overlay", **kwargs)
        self._running = False
        try:
            self._set_up()
        except BaseException:
            super().destroy_node()
            raise

    def _set_up(self):
        cv2.setNumThreads(1)  # the cores belong to the simulation
        self._settings = OverlayParameters(self)
        with tell_while_waiting(self._tell):
            draw_once()
        self._problems = Problems()
        self._matcher, self._lock = Matcher(), threading.Condition()
        self._liquids = LiquidStates()
        self._overlay, self._overlay_camera = None, None
        self._counts = {"drawn": 0, "refused": 0}
        self._milliseconds, self._age, self._offset, self._size = 0.0, 0.0, 0.0, (640, 480)
        self._topics = PictureTopics(
            self,
            {
                "camera_info": lambda data: self._calibration.hear(data),
                "image": lambda data: self._on_picture(Encoded(IMAGE, data)),
                "compressed": lambda data: self._on_picture(Encoded(COMPRESSED_IMAGE, data)),
            },
        )
        kind = self._settings["image_kind"]
        rectified = kind == "rectified" or (
            kind == "auto" and "rect" in self._topics.names["image"]
        )
        url = self._settings["camera_info_url"]
        self._calibration = CalibrationChoice(url, rectified, expect_messages=True)
        self._transform, self._pose_frame = None, ""
        self._image = self.create_publisher(Image, "~/image", 2)
        self._compressed = self.create_publisher(CompressedImage, "~/image/compressed", 2)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._inputs, self._awake_since, self._last_picture = [], None, 0.0
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(ATTENTION_PERIOD, self._attend, clock=steady)
        self.create_timer(1.0, self._diagnose, clock=steady)
        self._running = True
        self._thread = threading.Thread(target=self._work, name="drawing", daemon=True)
        self._thread.start()
        self.get_logger().info(f"drawing into {self._topics.names['image']}")

    def destroy_node(self):
        """End the thread first: it publishes."""
        if self._running:
            self._running = False
            self._thread.join(timeout=10.0)
        super().destroy_node()

    def _tell(self, seconds):
        self.get_logger().info(words(seconds))

    # ---------------------------------------------------------------- what comes

    def _attend(self):
        """Listen while somebody listens to us."""
        heard = self._image.get_subscription_count() + self._compressed.get_subscription_count()
        if heard and self._awake_since is None:
            self._awake_since = time.monotonic()
            self._subscribe()
        elif not heard and self._awake_since is not None:
            self._awake_since = None
            for subscription in self._inputs:
                self.destroy_subscription(subscription)
            self._inputs = []
            with self._lock:
                self._matcher = Matcher()
        awake = self._awake_since is not None
        self._topics.attend(info=awake, pictures=awake)

    def _subscribe(self):
        fluid = self._settings["fluid"].rstrip("/")
        best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._inputs = [
            self.create_subscription(kind, topic, callback, qos, raw=True)
            for kind, topic, callback, qos in (
                (PoseStamped, self._settings["camera_pose"], self._on_pose, best_effort),
                (MarkerArray, f"{fluid}/solids", self._liquids.hear_solids, QoSProfile(depth=2)),
                (PointCloud2, f"{fluid}/particles", self._on_particles, QoSProfile(depth=2)),
            )
        ]

    def _on_picture(self, thing):
        try:
            stamp_ns = stamp_of(thing.data)
        except ValueError as error:
            self._complain("image", str(error))
            return
        now, ros_now = time.monotonic(), self.get_clock().now().nanoseconds
        age = (ros_now - stamp_ns) / NANOSECONDS
        with self._lock:
            self._last_picture = now
            age = age if 0.0 <= age < LONGEST_LATENCY else 0.0
            self._matcher.add_picture(thing, stamp_ns or ros_now, age, now)
            self._lock.notify()

    def _on_pose(self, data):
        try:
            message = cdr_to_pose(data)
            numbers = np.array((*message.position, *message.quat_xyzw))
            if not np.isfinite(numbers).all() or not np.linalg.norm(numbers[3:]) > 1e-6:
                raise ValueError(f"{numbers}, expected finite numbers and a rotation")
        except ValueError as error:
            self._complain("camera pose", f"camera pose refused: {error}")
            return
        with self._lock:
            self._pose_frame = message.frame_id
            pose = pose_from_quaternion(numbers[:3], numbers[3:])
            self._matcher.add_pose(pose, message.stamp_ns, time.monotonic())
            self._lock.notify()

    def _on_particles(self, data):
        try:
            stamp_ns = stamp_of(data)
        except ValueError as error:
            self._complain("liquid", str(error))
            return
        with self._lock:
            self._matcher.add_state(data, stamp_ns, time.monotonic())
            self._lock.notify()

    # ---------------------------------------------------------------- a picture

    def _work(self):
        """The drawing thread."""
        numba.set_num_threads(1)
        while self._running:
            with self._lock:
                self._matcher.delay = self._settings["liquid_delay"]
                match = self._matcher.take(time.monotonic())
                if match is None:
                    self._lock.wait(0.02)
                    continue
            begin = time.perf_counter()
            try:
                self._process(match)
            except WaitingError:
                continue
            except Exception as error:
                if not (self._running and self.context.ok()):
                    return
                self._refuse(match, error)
            spent = 1e3 * (time.perf_counter() - begin)
            self._milliseconds += 0.1 * (spent - self._milliseconds)

    def _process(self, match):
        pixels, encoding, _, frame = decoded(match.picture)
        picture = to_bgr(pixels, encoding)
        height, width = picture.shape[:2]
        self._size = width, height
        camera = self._calibration.for_picture(width, height)
        notes = [self._calibration.note(camera)]
        liquid = None
        if match.state is not None:
            liquid = self._liquids.at(match.state, self._settings)
            notes += liquid.notes
        notes += self._missing(match)
        pose, trouble = self._in_liquid(match)
        notes.append(trouble)
        if pose is not None and liquid is not None:
            picture = self._overlay_of(camera).draw(picture, pose.inverse(), liquid.liquid)
            if liquid.holds(pose.position):
                notes.append("the camera is inside the liquid")
        notes = [note for note in notes if note]
        for note in notes:
            self._complain(note.split(":")[0], note)
        self._publish(picture, notes, match.stamp_ns, frame)
        self._counts["drawn"] += 1
        self._offset += 0.1 * (match.state_offset - self._offset)

    def _overlay_of(self, camera):
        """The Overlay of a CameraModel; made anew when the camera changed."""
        numbers = (*camera.matrix.ravel(), *camera.distortion, *self._size)
        if self._overlay_camera != numbers:
            self._overlay, self._overlay_camera = Overlay(replace(camera, **self._sized())), numbers
        return self._overlay

    def _sized(self):
        """Width and height of the pictures; a calibration need not know them."""
        return {"width": self._size[0], "height": self._size[1]}

    def _in_liquid(self, match):
        """The camera's pose in the liquid's frame or None, and what is wrong with it in words."""
        pose, source, target = match.pose, self._pose_frame, self._liquids.frame
        if pose is None or not target or source == target:
            return pose, ""
        if self._transform is None or self._transform[0] != target:
            self._transform = target, make_transform(self, target)
        try:
            if self._transform[1] is None:
                raise ValueError("and tf2_ros is not installed")
            turned = self._transform[1](source, match.stamp_ns, pose.position, pose.quat_xyzw)
        except ValueError as error:
            return None, f"camera pose is in frame {source!r}, the liquid in {target!r}: {error}"
        return pose_from_quaternion(*turned), ""

    def _missing(self, match):
        """What should be there for a picture and is not, in words."""
        topic, fluid = self._settings["camera_pose"], self._settings["fluid"]
        if match.pose is None and match.pose_age == float("inf"):
            yield f"no camera pose on {topic} yet: is the world marker in sight?"
        elif match.pose is None or match.pose_age > POSE_SILENCE:
            yield f"no camera pose: the last came {match.pose_age:.1f} s ago"
        if match.state is None:
            yield f"no liquid from {fluid} yet"
        elif match.state_age > LIQUID_SILENCE:
            yield f"no liquid from {fluid}: the last came {match.state_age:.0f} s ago"

    def _refuse(self, match, error):
        """A picture that cannot be used: say so in a grey one."""
        text = " ".join(str(error).split()) or repr(error)
        self._counts["refused"] += 1
        self._complain("calibration" if isinstance(error, CameraError) else "image", text)
        try:
            picture = to_bgr(*decoded(match.picture)[:2])
        except Exception:
            picture = np.full((*self._size[::-1], 3), 70, np.uint8)
        self._publish(picture, [text], match.stamp_ns, "camera")

    def _publish(self, picture, notes, stamp_ns, frame):
        if notes:
            picture = draw_notes(
                picture.copy(), [line for note in notes for line in _wrapped(note)]
            )
        if self._image.get_subscription_count():
            self._image.publish(image_to_cdr(picture, "bgr8", stamp_ns, frame))
        if self._compressed.get_subscription_count():
            quality = [cv2.IMWRITE_JPEG_QUALITY, self._settings["jpeg_quality"]]
            data = cv2.imencode(".jpg", picture, quality)[1].tobytes()
            self._compressed.publish(compressed_image_to_cdr(data, "jpeg", stamp_ns, frame))
        self._age = max(0.0, (self.get_clock().now().nanoseconds - stamp_ns) / NANOSECONDS)

    def _complain(self, kind, text):
        if self._problems.note(kind, text):
            self.get_logger().warning(text)

    # ---------------------------------------------------------------- diagnostics

    def _diagnose(self):
        if self._diagnostics.get_subscription_count() == 0:
            return
        idle = self._awake_since is None
        problems = {} if idle else self._problems.recent()
        silent = time.monotonic() - max(self._last_picture, self._awake_since or 0.0)
        if not idle and silent > SILENCE:
            where = self._topics.names["image"]
            problems["silence"] = f"no picture from {where} for {silent:.0f} s"
        status = input_status(self.get_name(), "drawing", self._facts(), problems, idle)
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def _facts(self):
        return {
            "source": self._topics.names["image"],
            "pictures_drawn": self._counts["drawn"],
            "pictures_refused": self._counts["refused"],
            "pictures_dropped": self._matcher.dropped,
            "picture_time_ms": self._milliseconds,
            "picture_age": self._age,
            "liquid_offset": self._offset,
            "picture": "{} x {}".format(*self._size),
        }


def _wrapped(text, length=88):
    """Lines of at most so many characters, as fit into a picture of 640 pixels."""
    line = ""
    for word in text.split():
        if line and len(line) + len(word) >= length:
            yield line
            line = ""
        line = f"{line} {word}" if line else word
    yield line


def main(argv=None):
    """Run the node until SIGINT or SIGTERM; returns the exit status."""
    explain = partial(
        help_text,
        "ar_overlay",
        "Draws the liquid of a fluid_node into a camera's pictures.",
        OverlayParameters,
    )
    return run_node("ar_overlay", ArOverlay, argv, (OverlayParameterError,), explain)


if __name__ == "__main__":
    sys.exit(main())
