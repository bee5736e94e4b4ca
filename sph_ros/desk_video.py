# SPDX-License-Identifier: Apache-2.0
"""A video of a moving camera over a desk and of a wand that stirs, for those without a webcam.

There is a world marker on the desk and another one on the wand, but no water: `sph_ros webcam`
adds it. The truth is known at every moment, so the video is a test as well.
"""

from pathlib import Path

import cv2
import numpy as np

from sph_ros.render.camera import Camera
from sph_ros.tracking.camera import CameraModel, camera_yaml
from sph_ros.tracking.motions import smooth_noise
from sph_ros.tracking.se3 import Pose, exp

#: Where the ball of the scene `desk_tank` hangs, in the frame of the marker on the wand [m].
BALL = np.array([0.0, -0.13, 0.0])

#: The film begins and ends with the wand in the air; it may be repeated [s].
SECONDS = 12.0

FPS = 30.0

#: Pictures of this size (width, height) [pixels].
SIZE = (640, 480)

# Turns a marker that lies on the desk upright, so that it looks at the camera.
_UPRIGHT = exp(np.array([np.radians(68.0), 0.0, 0.0]))


def desk_camera(size=SIZE):
    """CameraModel of the film: a webcam with some barrel distortion."""
    width, height = size
    focal = 0.95 * width
    matrix = [[focal, 0, 0.503 * width], [0, 0.997 * focal, 0.491 * height], [0, 0, 1]]
    return CameraModel(width, height, np.array(matrix), [-0.16, 0.07, 0.0007, -0.0005, -0.015])


class DeskMotion:
    """How the camera and the wand move.

    Args:
        seconds: of the whole film.
        seed: of the trembling hands.
    """

    def __init__(self, seconds=SECONDS, seed=1):
        self._seconds = seconds
        times = np.linspace(0.0, seconds, max(2, int(200 * seconds)))
        rng = np.random.default_rng(seed)
        # Fades out at both ends, so that the film can be repeated.
        fade = np.minimum(1.0, 2.0 * np.minimum(times, seconds - times))[:, None]
        self._times = times
        self._camera = fade * smooth_noise(times, rng, (0.3, 1.5), 0.003)
        self._wand = fade * smooth_noise(times, rng, (0.5, 2.0), 0.0015)
        self._turn = fade * smooth_noise(times, rng, (0.2, 0.8), 0.05)

    def _noise(self, values, time):
        return np.array([np.interp(time, self._times, column) for column in values.T])

    def world_from_camera(self, time):
        """Pose of the camera: it swings to and fro in front of the desk."""
        swing = np.sin(2.0 * np.pi * time / self._seconds)
        azimuth, elevation = np.radians(-76.0 + 20.0 * swing), np.radians(37.0 + 4.0 * swing)
        distance = 0.56 + 0.03 * np.cos(2.0 * np.pi * time / self._seconds)
        flat = np.cos(elevation)
        way = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        target = np.array([0.0, 0.01, 0.075])
        view = Camera.look_at(target + distance * way + self._noise(self._camera, time), target)
        return Pose(view.world_from_camera, view.eye)

    def ball(self, time):
        """Centre of the ball (3,) [m]: it dips into the tank, goes round, then to and fro."""
        share = time / self._seconds
        down = _ramp(share, 0.06, 0.16) - _ramp(share, 0.86, 0.96)
        round_ = _ramp(share, 0.14, 0.22) - _ramp(share, 0.54, 0.60)
        across = _ramp(share, 0.56, 0.62) - _ramp(share, 0.80, 0.86)
        angle = 2.0 * np.pi * time / 1.3
        place = np.array([0.0, 0.0, 0.17 - 0.13 * down])
        place += 0.052 * round_ * np.array([np.cos(angle), np.sin(angle), 0.0])
        place += across * np.array([0.06 * np.sin(0.8 * angle), 0.0, 0.012 * np.cos(1.6 * angle)])
        return place + self._noise(self._wand, time)

    def world_from_wand(self, time):
        """Pose of the marker on the wand, whose ball is where `ball` says."""
        turn = exp(self._noise(self._turn, time)) @ _UPRIGHT
        return Pose(turn, self.ball(time) - turn @ BALL)


def _ramp(value, low, high):
    """0 below low, 1 above high, smooth between."""
    share = np.clip((value - low) / (high - low), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def make_desk_video(path, seconds=SECONDS, size=SIZE, fps=FPS, progress=lambda done, total: None):
    """Write the film, and its calibration beside it as .yaml.

    Args:
        path: of the film, ending in .mp4.
        seconds: its length.
        size: (width, height) [pixels].
        fps: pictures per second.
        progress: called with (pictures drawn, pictures in all).

    Raises:
        ValueError: another ending, or numbers that no film has.
        OSError: the folder does not exist.
        RuntimeError: there is no ffmpeg.
    """
    from sph_ros.render.desk import Desk
    from sph_ros.render.video import VideoWriter

    camera, motion = desk_camera(size), DeskMotion(seconds)
    count = max(1, round(seconds * fps))
    with VideoWriter(path, size, fps, quality=8) as video:
        desk = Desk(camera)
        for number in range(count):
            time = number / fps
            view = motion.world_from_camera(time).inverse()
            picture = desk.take(view, motion.world_from_wand(time))
            video.add(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
            progress(number + 1, count)
    Path(path).with_suffix(".yaml").write_text(camera_yaml(camera, "desk"), encoding="utf-8")
