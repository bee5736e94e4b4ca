# SPDX-License-Identifier: Apache-2.0
"""What the marker tracker publishes: poses, covariances, a debug picture, transforms."""

import time

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from sensor_msgs.msg import CameraInfo, Image

from msg_adapters.header import split_stamp
from msg_adapters.image import image_to_cdr
from msg_adapters.pose import pose_to_cdr
from sph_ros.tracking.camera_message import camera_to_cdr

try:
    import tf2_ros
except ImportError:  # it is not on PyPI
    tf2_ros = None


class MarkerPublications:
    """The publishers of a marker tracker; nothing is built that nobody listens to.

    Args:
        node: that publishes.
        solid_names: names of solids.
        world_frame: name of the world's frame.
        with_tf: whether transforms are sent where tf2_ros is installed.
        with_pictures: whether pictures and their calibration are sent on.
    """

    def __init__(self, node, solid_names, world_frame, with_tf, with_pictures=False):
        self._node = node
        self._world_frame = world_frame
        self._poses, self._covariances = {}, {}
        for name in solid_names:
            self._poses[name] = node.create_publisher(PoseStamped, f"~/{name}/pose", 10)
            self._covariances[name] = node.create_publisher(
                PoseWithCovarianceStamped, f"~/{name}/pose_with_covariance", 10
            )
        self._camera = node.create_publisher(PoseStamped, "~/camera_pose", 10)
        self._debug = node.create_publisher(Image, "~/debug_image", 2)
        self._debug_time = -1e9
        self._pictures = ()
        if with_pictures:
            self._pictures = (
                node.create_publisher(Image, "~/image", 2),
                node.create_publisher(CameraInfo, "~/camera_info", 2),
            )
        self._broadcaster = None
        if with_tf and tf2_ros is not None:
            self._broadcaster = tf2_ros.TransformBroadcaster(node)
        elif with_tf:
            node.get_logger().info("tf2_ros is not installed: poses go to topics, not to /tf")

    def listeners(self):
        """Number of subscriptions to anything."""
        publishers = [*self._poses.values(), *self._covariances.values()]
        publishers += [self._camera, self._debug, *self._pictures]
        count = sum(publisher.get_subscription_count() for publisher in publishers)
        if self._broadcaster is not None:
            count += self._node.count_subscribers("/tf")
        return count

    def publish(self, tracking, stamp_ns, camera_frame, has_world):
        """Send what is known after a picture.

        Args:
            tracking: Tracking.
            stamp_ns: of the picture [ns].
            camera_frame: frame_id of the picture.
            has_world: poses are in the world's frame, else in the camera's.
        """
        frame = self._world_frame if has_world else camera_frame
        transforms = []
        if tracking.world is not None and tracking.world.pose is not None:
            self._send_pose(self._camera, tracking.world.pose, stamp_ns, frame)
            transforms.append((camera_frame, tracking.world.pose))
        for name, tracked in tracking.solids.items():
            if tracked.pose is not None:
                self._send_pose(self._poses[name], tracked.pose, stamp_ns, frame)
                self._send_covariance(self._covariances[name], tracked, stamp_ns, frame)
                transforms.append((name, tracked.pose))
        if self._broadcaster is not None and transforms:
            self._broadcaster.sendTransform(
                [transform_message(pose, stamp_ns, frame, child) for child, pose in transforms]
            )

    def debug_due(self, rate):
        """Whether somebody wants a debug picture now."""
        now = time.monotonic()
        if self._debug.get_subscription_count() == 0 or now - self._debug_time < 1.0 / rate:
            return False
        self._debug_time = now
        return True

    def pictures_wanted(self):
        """Whether anybody wants the pictures themselves or their calibration."""
        return any(publisher.get_subscription_count() for publisher in self._pictures)

    def publish_picture(self, pixels, encoding, camera, stamp_ns, frame):
        """Send a picture on, and its CameraModel before it."""
        pictures, calibrations = self._pictures
        calibrations.publish(camera_to_cdr(camera, stamp_ns, frame))
        pictures.publish(image_to_cdr(pixels, encoding, stamp_ns, frame))

    def publish_debug(self, picture, stamp_ns, frame):
        """Send a debug picture (H, W, 3) uint8 BGR."""
        self._debug.publish(image_to_cdr(picture, "bgr8", stamp_ns, frame))

    @staticmethod
    def _send_pose(publisher, pose, stamp_ns, frame):
        if publisher.get_subscription_count():
            publisher.publish(pose_to_cdr(pose.position, pose.quat_xyzw, stamp_ns, frame))

    @staticmethod
    def _send_covariance(publisher, tracked, stamp_ns, frame):
        if not publisher.get_subscription_count():
            return
        message = PoseWithCovarianceStamped()
        _fill_header(message.header, stamp_ns, frame)
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        place.x, place.y, place.z = map(float, tracked.pose.position)
        turn.x, turn.y, turn.z, turn.w = map(float, tracked.pose.quat_xyzw)
        message.pose.covariance = tracked.covariance.ravel()
        publisher.publish(message)


def transform_message(pose, stamp_ns, frame, child):
    """A TransformStamped."""
    message = TransformStamped(child_frame_id=child)
    _fill_header(message.header, stamp_ns, frame)
    shift, turn = message.transform.translation, message.transform.rotation
    shift.x, shift.y, shift.z = map(float, pose.position)
    turn.x, turn.y, turn.z, turn.w = map(float, pose.quat_xyzw)
    return message


def _fill_header(header, stamp_ns, frame):
    header.stamp.sec, header.stamp.nanosec = split_stamp(stamp_ns)
    header.frame_id = frame
