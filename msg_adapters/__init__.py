# SPDX-License-Identifier: Apache-2.0
"""NumPy arrays to ready CDR bytes of ROS 2 messages and back, and rosbag2 files; no ROS needed.

rclpy publishes ready bytes (``publisher.publish(data)``) and hands them over (``raw=True``), which
saves the Python loop over elements that its own messages cost. Import from the module of a family:
``point_cloud``, ``marker``, ``mesh``, ``wrench``, ``pose``, ``clock``, ``image``, ``bags``.

Times are integers in nanoseconds, quaternions are x y z w, lengths metres. Functions are pure;
input that does not fit raises a ValueError that names it and says what was expected.
"""
