# SPDX-License-Identifier: Apache-2.0
"""Everything that tracking compiles, loaded before the first picture; the first time compiled."""

import numpy as np

from sph_ros.tracking.camera import CameraModel
from sph_ros.tracking.se3 import Pose, exp
from sph_ros.tracking.synthetic import SyntheticCamera
from sph_ros.tracking.targets import single_marker
from sph_ros.tracking.tracker import Tracker, TrackerSettings

_CAMERA = CameraModel(320, 240, [[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]])
_TURN = exp(np.array([np.pi, 0.0, 0.0])) @ exp(np.array([0.4, 0.3, 0.0]))
_WORLD, _SOLID = single_marker("world", 0, 0.08), single_marker("solid", 1, 0.08)


def prepare():
    """Track two markers through a few pictures; returns the last Tracking."""
    tracker = Tracker(TrackerSettings(solids=(_SOLID,), world=_WORLD))
    left, right = np.array([-0.08, 0.0, 0.4]), np.array([0.08, 0.0, 0.4])
    placed = [(_WORLD, Pose(_TURN, left)), (_SOLID, Pose(_TURN, right))]
    picture = SyntheticCamera(_CAMERA).take(placed)
    for number in range(3):
        tracking = tracker.process(picture, (1 + number) * 33_333_333, _CAMERA)
    tracking.solids["solid"].pose.quat_xyzw  # noqa: B018 (compiles, too)
    return tracking
