# SPDX-License-Identifier: Apache-2.0
"""State of the liquid and its solids, the order of a step, scenes and materials; no ROS in here."""
