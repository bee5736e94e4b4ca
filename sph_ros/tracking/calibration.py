# SPDX-License-Identifier: Apache-2.0
"""A camera model from pictures of a ChArUco board, with any version of OpenCV.

The markers say which square is which; the corners between squares, where two black ones meet, are
found to a few hundredths of a pixel and make the calibration.
"""

from typing import NamedTuple

import cv2
import numpy as np

from sph_ros.tracking.camera import CameraModel
from sph_ros.tracking.detection import Detector
from sph_ros.tracking.targets import charuco_corners

#: A picture counts when it shows so many corners, and enough pictures make a calibration.
LEAST_CORNERS = 8
LEAST_VIEWS = 6

#: A picture counts when the board moved by this share of the picture since the last that did.
LEAST_MOTION = 0.04


class CalibrationError(ValueError):
    """No calibration can be made; says why."""


class View(NamedTuple):
    """Corners between squares in one picture."""

    points: np.ndarray  # (N, 3) [m] on the board
    pixels: np.ndarray  # (N, 2)


class Calibration(NamedTuple):
    """A camera model and how well it fits."""

    camera: CameraModel
    residual: float  # root mean square distance [pixels]
    views: int


class Calibrator:
    """Collects views of a board.

    Args:
        board: a CharucoBoard.
        dictionary: of its markers.
    """

    def __init__(self, board, dictionary):
        self._board = board
        self._markers = charuco_corners(*board)
        self._detector = Detector(dictionary, self._markers)
        self._crossings = _crossings(board, self._markers)
        self._size = None
        self.views = []

    def look(self, gray):
        """Use a picture (H, W) uint8 if it shows something new; returns whether it does.

        Raises:
            CalibrationError: another size than the pictures before.
        """
        size = gray.shape[::-1]
        if self._size not in (None, size):
            raise CalibrationError(f"a picture has {size} pixels, those before it {self._size}")
        self._size = size
        view = self._find(gray)
        if len(view.points) < LEAST_CORNERS or not self._is_new(view):
            return False
        self.views.append(view)
        return True

    def calibrate(self):
        """The Calibration after all views.

        Raises:
            CalibrationError: too few views.
        """
        if len(self.views) < LEAST_VIEWS:
            raise CalibrationError(
                f"{len(self.views)} useful pictures of the board, expected at least {LEAST_VIEWS} "
                "from different sides and distances"
            )
        points = [view.points.astype(np.float32) for view in self.views]
        pixels = [view.pixels.astype(np.float32) for view in self.views]
        residual, matrix, distortion, *_ = cv2.calibrateCamera(
            points, pixels, self._size, None, None
        )
        camera = CameraModel(*self._size, matrix, distortion.ravel()[:5])
        return Calibration(camera, float(residual), len(self.views))

    def _find(self, gray):
        """The corners between squares whose two markers were both seen."""
        seen = {detection.id: detection.corners for detection in self._detector.detect(gray)}
        maps = {i: _board_to_pixels(self._markers[i], corners) for i, corners in seen.items()}
        points, guesses = [], []
        for point, neighbours in self._crossings:
            if all(i in maps for i in neighbours):
                guess = np.mean([_mapped(maps[i], point) for i in neighbours], axis=0)
                points.append(point)
                guesses.append(guess)
        if not points:
            return View(np.empty((0, 3)), np.empty((0, 2)))
        sides = [np.linalg.norm(corners[1] - corners[0]) for corners in seen.values()]
        # Half of the way to the nearest marker, whose own corners must stay out of sight.
        gap = 0.5 * (self._board.square - self._board.size) / self._board.size * min(sides)
        window = int(np.clip(gap, 2, 8))
        start = np.array(guesses, np.float32).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 0.005)
        found = cv2.cornerSubPix(gray, start.copy(), (window, window), (-1, -1), criteria)[:, 0]
        good = np.linalg.norm(found - start[:, 0], axis=1) < window
        return View(np.array(points)[good], found[good].astype(float))

    def _is_new(self, view):
        if not self.views:
            return True
        last = {tuple(p): q for p, q in zip(*self.views[-1], strict=True)}
        moved = [
            np.linalg.norm(pixel - last[tuple(point)])
            for point, pixel in zip(*view, strict=True)
            if tuple(point) in last
        ]
        return not moved or float(np.mean(moved)) > LEAST_MOTION * self._size[0]


def _crossings(board, markers):
    """[(point (3,) [m], ids of the two markers beside it)] of all corners between squares."""
    centres = {i: corners.mean(axis=0) for i, corners in markers.items()}
    crossings = []
    for row in range(1, board.rows):
        for column in range(1, board.columns):
            point = board.square * np.array(
                [column - 0.5 * board.columns, 0.5 * board.rows - row, 0.0]
            )
            near = sorted(centres, key=lambda i: np.linalg.norm(centres[i] - point))[:2]  # noqa: B023
            crossings.append((point, near))
    return crossings


def _board_to_pixels(corners, pixels):
    return cv2.getPerspectiveTransform(corners[:, :2].astype(np.float32), pixels.astype(np.float32))


def _mapped(transform, point):
    x, y, w = transform @ (point[0], point[1], 1.0)
    return np.array([x / w, y / w])
