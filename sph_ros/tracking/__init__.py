# SPDX-License-Identifier: Apache-2.0
"""Pictures to marker poses to filtered poses; plain Python on OpenCV and NumPy, no ROS.

One way through: ``images``, ``detection``, ``pose``, ``ambiguity``, ``filter``, ``limits``;
``tracker`` holds the order. A pose ``a_from_b`` turns coordinates in b into coordinates in a.
"""
