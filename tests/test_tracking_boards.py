# SPDX-License-Identifier: Apache-2.0
"""Worlds and wands of many markers, in rendered and in real pictures; several solids at once."""

import cv2
import numpy as np
import pytest
from tracking_helpers import BALL, CAMERA, CAMERA_FROM_WORLD, FLAT, FPS, SyntheticBoardCamera, rms

from sph_ros.tracking.camera import load_camera
from sph_ros.tracking.detection import Detector, get_dictionary
from sph_ros.tracking.images import to_gray
from sph_ros.tracking.pose import estimate_poses
from sph_ros.tracking.printing import CHARUCO
from sph_ros.tracking.se3 import Pose, difference, exp
from sph_ros.tracking.synthetic import Flaws, SyntheticCamera
from sph_ros.tracking.targets import (
    Target,
    charuco_corners,
    cube_corners,
    grid_corners,
    single_marker,
)
from sph_ros.tracking.tracker import Tracker, TrackerSettings


def stamp(k):
    return round((k / FPS + 1.0) * 1e9)


def degrees(errors):
    return np.degrees(rms(errors[:, 3:]))


def test_a_cube_is_followed_all_the_way_round():
    """About an axis that is tilted, so that its five faces come into sight and go again."""
    cube = Target("wand", cube_corners(0.06, 0.05, [2, 3, 4, 5, 6]))
    camera = SyntheticCamera(CAMERA, flaws=Flaws())
    tracker = Tracker(TrackerSettings(solids=(cube,)))
    off, seen = [], set()
    for k in range(50):
        turn = exp(np.array([-0.9, 0.3, 0.0])) @ exp(np.array([0.0, 0.0, 2 * np.pi * k / 50]))
        pose = Pose(FLAT @ turn, np.array([0.0, 0.0, 0.4]))
        result = tracker.process(camera.take([(cube, pose)]), stamp(k), CAMERA)
        seen |= {detection.id for detection in result.detections}
        off.append(difference(result.solids["wand"].pose, pose))
    assert seen == {2, 3, 4, 5, 6}
    off = np.array(off)
    assert rms(off[:, :3]) < 0.003 and degrees(off) < 2.0


def test_a_grid_defines_the_world_for_several_solids_while_a_hand_hides_half_of_it():
    grid = Target("world", grid_corners(4, 3, 0.03, 0.012, first_id=20))
    other = single_marker("paddle", 9, 0.05)
    cube = Target("wand", cube_corners(0.045, 0.03, [2, 3, 4, 5, 6, 7]))
    places = {
        "ball": Pose(exp(np.array([0.3, 0.2, 0.0])), np.array([-0.14, 0.0, 0.05])),
        "paddle": Pose(exp(np.array([0.0, -0.4, 0.5])), np.array([0.16, 0.08, 0.04])),
        "wand": Pose(exp(np.array([0.3, 0.2, 0.6])), np.array([0.15, -0.07, 0.05])),
    }
    base = Pose(CAMERA_FROM_WORLD.rotation, np.array([0.0, 0.0, 0.6]))
    camera = SyntheticCamera(CAMERA, flaws=Flaws())
    tracker = Tracker(TrackerSettings(solids=(BALL, other, cube), world=grid))
    off, counts = {name: [] for name in places}, []
    for k in range(24):
        targets = zip((BALL, other, cube), places.values(), strict=True)
        picture = camera.take([(grid, base), *((t, base @ place) for t, place in targets)])
        if k >= 12:
            left, top = CAMERA.project(base.apply(np.array([[0.0, 0.08, 0.0]])))[0].astype(int)
            picture[top:, left : left + 90] = 90
        result = tracker.process(picture, stamp(k), CAMERA)
        counts.append(sum(detection.id >= 20 for detection in result.detections))
        for name, true in places.items():
            off[name].append(difference(result.solids[name].pose, true))
    assert counts[8] == 12 and 3 <= counts[-1] <= 9
    for errors in off.values():
        errors = np.array(errors)[4:]
        assert rms(errors[:, :3]) < 0.004 and degrees(errors) < 2.5


def test_a_charuco_board_defines_the_world():
    """The black squares that touch its markers' margins must not be in the way."""
    camera = SyntheticBoardCamera(CAMERA)
    base = Pose(exp(np.array([0.5, 0.1, 0.0])) @ FLAT, np.array([0.0, 0.0, 0.5]))
    picture = camera.take(base)
    tracker = Tracker(TrackerSettings(world=Target("world", charuco_corners(*CHARUCO))))
    for k in range(5):
        result = tracker.process(picture, stamp(k), CAMERA)
    assert len(result.detections) == 17
    off = difference(result.world.pose, base.inverse())
    assert np.linalg.norm(off[:3]) < 0.002 and np.degrees(np.linalg.norm(off[3:])) < 0.4
    assert result.world.residual < 0.3


def test_a_photographed_charuco_board_lies_where_opencv_says(shared_data):
    """OpenCV uses the corners between squares, we those of the markers."""
    if not hasattr(cv2.aruco, "CharucoDetector"):
        pytest.skip("OpenCV before 4.7 detects these boards in another way")
    folder = shared_data / "markers/opencv_doc"
    camera = load_camera(folder / "tutorial_camera_params.yml")
    gray = to_gray(cv2.imread(str(folder / "choriginal.jpg")), "bgr8")
    dictionary = get_dictionary("DICT_6X6_250")
    board = cv2.aruco.CharucoBoard((5, 7), 0.04, 0.02, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(gray)
    points = board.getChessboardCorners()[np.ravel(ids)]
    _, turn, shift = cv2.solvePnP(points, corners, camera.matrix, camera.distortion)
    # OpenCV's frame has its origin at the top left corner, y down and z into the paper.
    to_middle = Pose(FLAT, np.array([0.1, 0.14, 0.0]))
    theirs = Pose(cv2.Rodrigues(turn)[0], shift.ravel()) @ to_middle
    target = Target("board", charuco_corners(5, 7, 0.04, 0.02))
    found = Detector("DICT_6X6_250", target.ids).detect(gray)
    (ours, *_) = estimate_poses(target, found, camera, 0.3)
    off = difference(ours.pose, theirs)
    assert np.linalg.norm(off[:3]) < 0.01 * np.linalg.norm(theirs.position)
    assert np.degrees(np.linalg.norm(off[3:])) < 1.0
