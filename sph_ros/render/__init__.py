# SPDX-License-Identifier: Apache-2.0
"""Pictures, videos and plots of a simulation; no ROS in here."""

from sph_ros.render.camera import Camera
from sph_ros.render.picture import Frame, SolidView, render, save_png

__all__ = ["Camera", "Frame", "SolidView", "render", "save_png"]
