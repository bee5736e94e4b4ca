# SPDX-License-Identifier: Apache-2.0
"""Pictures, videos and plots of a simulation; no ROS in here."""
