# SPDX-License-Identifier: Apache-2.0
"""A camera, two markers and a hand whose motion is known, at the level of corners: no pictures."""

import functools

import cv2
import numpy as np

from sph_ros.tracking.camera import CameraModel
from sph_ros.tracking.detection import Detection, get_dictionary, marker_picture
from sph_ros.tracking.motions import hand_motion
from sph_ros.tracking.printing import CHARUCO
from sph_ros.tracking.se3 import Pose, difference, exp
from sph_ros.tracking.synthetic import Flaws, SyntheticCamera
from sph_ros.tracking.targets import charuco_corners, single_marker
from sph_ros.tracking.tracker import Tracker, TrackerSettings

FPS = 30.0
FLAT = np.diag([1.0, -1.0, -1.0])  # a marker that looks straight into the camera
CAMERA = CameraModel(
    640, 480, [[560, 0, 321], [0, 562, 238], [0, 0, 1]], [0.1, -0.2, 0.001, -0.001, 0.05]
)
WORLD = single_marker("world", 0, 0.08)
BALL = single_marker("ball", 1, 0.06)
CAMERA_FROM_WORLD = Pose(exp(np.array([0.6, 0.0, 0.0])) @ FLAT, np.array([-0.08, 0.05, 0.55]))
CENTRE = Pose(np.eye(3), np.array([0.12, 0.05, 0.06]))


def truth_of_hand(seconds, seed=1, **motion):
    """(times (N,), [world_from_ball], moving (N,) bool)."""
    times = np.arange(round(seconds * FPS)) / FPS
    return times, *hand_motion(times, CENTRE, seed=seed, **motion)


#: Pictures of `hard_hand` in which the hand's marker is out of sight.
HARD_GAPS = ((20, 21), (30, 33), (45, 75))

#: Pictures in which it is edge-on or shows its back.
HARD_TURN = (90, 105)

_HARD = Flaws(
    noise=6,
    defocus=0.9,
    exposure=0.008,
    light_change=0.3,
    light_gradient=0.6,
    occlusions=1,
    false_markers=2,
)


@functools.cache
def hard_hand():
    """(times, [world_from_ball], pictures) of a hand with all flaws; near the end it turns away."""
    times, truth, _ = truth_of_hand(4.0, reach=0.03, tilt=0.25)
    turns = np.clip((times - 3.0) / 0.5, 0.0, 1.0)
    away = exp(1.3 * np.sin(np.pi * turns)[:, None] * (1.0, 0.0, 0.0))
    truth = [Pose(a @ pose.rotation, pose.position) for a, pose in zip(away, truth, strict=True)]
    camera = SyntheticCamera(CAMERA, flaws=_HARD)
    pictures = []
    for k, pose in enumerate(truth):
        placed = [(WORLD, CAMERA_FROM_WORLD)]
        if not any(begin <= k < end for begin, end in HARD_GAPS):
            after = truth[min(k + 1, len(truth) - 1)]
            placed.append((BALL, _during_exposure(pose, after)))
        pictures.append(camera.take(placed, times[k]))
    return times, truth, pictures


def _during_exposure(pose, after):
    """camera_from_ball as a function of the share of the exposure, centred on the stamp."""
    step = difference(after, pose) * (_HARD.exposure * FPS)

    def at(moment):
        part = (moment - 0.5) * step
        return CAMERA_FROM_WORLD @ Pose(exp(part[3:]) @ pose.rotation, pose.position + part[:3])

    return at


def seen(target, camera_from_target, rng, noise=0.3, camera=CAMERA):
    """Detections of a target's markers with noisy corners."""
    found = []
    for marker_id, corners in target.corners.items():
        pixels = camera.project(camera_from_target.apply(corners))
        found.append(Detection(marker_id, pixels + noise * rng.standard_normal((4, 2))))
    return found


def track_hand(
    times, truth, filter, noise=0.3, seed=0, drop=0.0, outliers=0.0, lookahead=0.0, **settings
):
    """Tracked of the ball at each time, with a share of dropped and of wildly wrong pictures."""
    rng = np.random.default_rng(seed)
    tracker = Tracker(TrackerSettings(solids=(BALL,), world=WORLD, filter=filter, **settings))
    results = []
    for time, world_from_ball in zip(times, truth, strict=True):
        found = seen(WORLD, CAMERA_FROM_WORLD, rng, noise)
        chance = rng.random()
        (ball,) = seen(BALL, CAMERA_FROM_WORLD @ world_from_ball, rng, noise)
        if chance < outliers:
            ball = ball._replace(corners=ball.corners + rng.uniform(-150, 150, 2))
        if not outliers <= chance < outliers + drop:
            found.append(ball)
        results.append(tracker.track(found, CAMERA, time, lookahead).solids["ball"])
    return results


def errors(results, truth):
    """(N, 6) errors of poses, NaN where there is none."""
    missing = np.full(6, np.nan)
    return np.array(
        [
            missing if result.pose is None else difference(result.pose, true)
            for result, true in zip(results, truth, strict=True)
        ]
    )


def rms(values):
    """Root mean square length of rows."""
    return float(np.sqrt(np.nanmean(np.sum(np.square(values), axis=1))))


def jitter(found, moving, settled=12):
    """Standard deviation (position [m], rotation [rad]) while the hand rests, once settled."""
    still = np.flatnonzero(~moving)
    runs = np.split(still, np.flatnonzero(np.diff(still) > 1) + 1)
    rest = found[max(runs, key=len)[settled:]]
    spread = np.nanstd(rest, axis=0)
    return float(np.linalg.norm(spread[:3])), float(np.linalg.norm(spread[3:]))


def lag_in_frames(positions, true_positions):
    """Delay of a trajectory by cross-correlation, to a fortieth of a frame."""
    index = np.arange(len(positions), dtype=float)
    inside = slice(5, -5)
    best = (-np.inf, 0.0)
    for shift in np.linspace(-2.0, 2.0, 161):
        moved = np.column_stack([np.interp(index - shift, index, t) for t in true_positions.T])
        a = positions[inside] - positions[inside].mean(axis=0)
        b = moved[inside] - moved[inside].mean(axis=0)
        best = max(best, (float(np.sum(a * b) / np.linalg.norm(a) / np.linalg.norm(b)), shift))
    return best[1]


def plain_pose(pixels, size, camera=CAMERA):
    """What a plain solver gives: the IPPE solution of less reprojection error."""
    square = 0.5 * size * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)
    _, turn, shift = cv2.solvePnP(
        square, pixels, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    return Pose(cv2.Rodrigues(turn)[0], shift.ravel())


class SyntheticBoardCamera:
    """Takes pictures of the printed ChArUco board, whose black squares SyntheticCamera lacks."""

    def __init__(self, camera):
        self._camera = camera
        self._pixels_per_metre = 4000
        self._sheet = self._draw_sheet()
        y, x = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32)
        self._grid = np.stack([x, y], axis=-1).reshape(-1, 1, 2)

    def _draw_sheet(self):
        scale, side = self._pixels_per_metre, round(CHARUCO.square * self._pixels_per_metre)
        sheet = np.full((CHARUCO.rows * side, CHARUCO.columns * side), 255, np.uint8)
        for row in range(CHARUCO.rows):
            for column in range(CHARUCO.columns):
                if (row + column) % 2 == 0:
                    sheet[row * side :, column * side :][:side, :side] = 0
        middle = np.array([sheet.shape[1], sheet.shape[0]]) / 2
        size = round(CHARUCO.size * scale)
        for marker_id, corners in charuco_corners(*CHARUCO).items():
            left, top = np.round(middle + corners[0, :2] * (scale, -scale)).astype(int)
            picture = marker_picture(get_dictionary("DICT_4X4_50"), marker_id, size)
            sheet[top : top + size, left : left + size] = picture
        return cv2.GaussianBlur(np.pad(sheet, 200, constant_values=255), (0, 0), 3.0)

    def take(self, pose):
        """Each pixel's ray meets the sheet where the picture's grey value comes from."""
        camera = self._camera
        rays = cv2.undistortPoints(self._grid, camera.matrix, camera.distortion)[:, 0]
        rays = np.column_stack([rays, np.ones(len(rays))])
        normal = pose.rotation[:, 2]
        points = rays * ((normal @ pose.position) / (rays @ normal))[:, None]
        on_sheet = (points - pose.position) @ pose.rotation[:, :2] * self._pixels_per_metre
        middle = (np.array(self._sheet.shape[::-1]) - 1) / 2
        place = (on_sheet * (1, -1) + middle).astype(np.float32)
        place = place.reshape(camera.height, camera.width, 2)
        picture = cv2.remap(self._sheet, place, None, cv2.INTER_LINEAR, borderValue=150)
        return cv2.GaussianBlur(picture, (0, 0), 0.6)
