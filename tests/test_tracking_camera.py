# SPDX-License-Identifier: Apache-2.0
"""Calibrations and boards: real files, messages, and everything that can be wrong with them."""

import cv2
import numpy as np
import pytest

from sph_ros.tracking.camera import (
    CameraError,
    CameraModel,
    camera_from_fields,
    camera_yaml,
    guessed_camera,
    load_camera,
)
from sph_ros.tracking.camera_message import UncalibratedError, cdr_to_camera
from sph_ros.tracking.targets import (
    Target,
    TargetError,
    charuco_corners,
    check_targets,
    cube_corners,
    grid_corners,
    load_boards,
    parse_solid,
    single_marker,
)

K = [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]
P = [400.0, 0.0, 310.0, 0.0, 0.0, 401.0, 250.0, 0.0, 0.0, 0.0, 1.0, 0.0]


# ---------------------------------------------------------------- files


def test_five_peoples_camera_files(shared_data):
    files = sorted((shared_data / "calibration").glob("*/*.yaml"))
    assert len(files) == 5
    for file in files:
        camera, rectified = load_camera(file), load_camera(file, rectified=True)
        assert camera.width > camera.height > 400 and camera.matrix[0, 0] > 400
        assert len(camera.distortion) >= 5 and not len(rectified.distortion)
    usb = load_camera(shared_data / "calibration/usb_cam/camera_info.yaml", rectified=True)
    assert usb.matrix[0, 2] == 322.797939  # of the projection matrix


def test_opencv_file_and_a_malformed_one(shared_data):
    camera = load_camera(shared_data / "markers/opencv_doc/tutorial_camera_params.yml")
    assert camera.matrix[0, 0] == 628.158 and camera.distortion[0] == 0.0995485
    camera.check_size(640, 480)  # the file does not say for which size it is
    with pytest.raises(CameraError, match="camera_matrix"):
        load_camera(shared_data / "markers/sksurgery/bad_calibration.txt")


def test_yaml_round_trip(tmp_path):
    path = tmp_path / "camera.yaml"
    camera = CameraModel(640, 480, np.reshape(K, (3, 3)), [0.1, -0.2, 0.01, 0.02, 0.3])
    path.write_text(camera_yaml(camera, "mine"))
    again = load_camera(f"file://{path}")
    assert np.array_equal(again.matrix, camera.matrix) and (again.width, again.height) == (640, 480)
    assert np.array_equal(again.distortion, camera.distortion)
    assert np.array_equal(load_camera(path, rectified=True).matrix, camera.matrix)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("camera_matrix: {data: [1, 2, 3]}", "expected 9 numbers"),
        ("camera_matrix: {data: [0, 0, 0, 0, 0, 0, 0, 0, 0]}", "zeros"),
        ("camera_matrix: {data: [.nan, 0, 0, 0, 1, 0, 0, 0, 1]}", "finite"),
        ("camera_matrix: {data: [a, 0, 0, 0, 1, 0, 0, 0, 1]}", "expected numbers"),
        ("{", "not YAML"),
        ("[1, 2]", "camera_matrix"),
    ],
)
def test_wrong_files_are_refused_by_name(text, expected, tmp_path):
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(CameraError, match=expected) as caught:
        load_camera(path)
    assert str(path) in str(caught.value)


# ---------------------------------------------------------------- fields, messages


def test_binning_and_region_of_interest_see_the_same_point():
    """A point's pixel in the full picture, then cut and binned, is its pixel in the small one."""
    full = camera_from_fields(640, 480, "plumb_bob", [0.1, 0, 0, 0, 0], K, P)
    small = camera_from_fields(
        640, 480, "plumb_bob", [0.1, 0, 0, 0, 0], K, P, binning=(2, 2), roi=(100, 60, 400, 300)
    )
    assert (small.width, small.height) == (200, 150)
    point = np.array([[0.02, -0.03, 0.5]])
    expected = (full.project(point) - (100, 60) + 0.5) / 2 - 0.5
    assert np.allclose(small.project(point), expected)


def test_rectified_pictures_use_the_projection_and_no_distortion():
    camera = camera_from_fields(640, 480, "equidistant", [1.0] * 4, K, P, rectified=True)
    assert camera.matrix[0, 0] == 400.0 and len(camera.distortion) == 0


def test_rational_model_is_opencvs():
    distortion = [0.3, -0.2, 0.001, 0.002, 0.05, 0.25, -0.15, 0.02]
    camera = camera_from_fields(640, 480, "rational_polynomial", distortion, K, P)
    point = np.array([[0.1, -0.07, 0.4]])
    x, y = point[0, :2] / point[0, 2]
    r2 = x * x + y * y
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    assert np.allclose(camera.project(point), [[500 * u + 320, 501 * v + 240]])


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"model": "equidistant"}, "equidistant"),
        ({"distortion": [0.1, 0.2]}, "2 distortion coefficients"),
        ({"distortion": [np.nan] * 5}, "not finite"),
        ({"matrix": [0.0] * 9}, "focal lengths"),
        ({"matrix": [np.nan] * 9}, "finite"),
    ],
)
def test_values_that_no_camera_has(change, expected):
    fields = {"model": "plumb_bob", "distortion": [0.0] * 5, "matrix": K, **change}
    with pytest.raises(CameraError, match=expected):
        camera_from_fields(640, 480, projection=P, **fields)


def test_sizes_must_match_and_a_guess_says_so():
    with pytest.raises(CameraError, match="640 x 480.*320 x 240"):
        CameraModel(320, 240, np.reshape(K, (3, 3))).check_size(640, 480)
    guess = guessed_camera(640, 480)
    assert guess.approximate
    # Sixty degrees across.
    edge = np.array([[np.tan(np.radians(30.0)), 0.0, 1.0]])
    assert guess.project(edge)[0, 0] == pytest.approx(319.5 + 320.0)


def test_camera_info_message_is_read_as_rclpy_wrote_it():
    pytest.importorskip("rclpy", reason="ROS is not installed: rclpy cannot be imported")
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import CameraInfo, RegionOfInterest

    message = CameraInfo(width=640, height=480, distortion_model="plumb_bob", k=K, p=P)
    message.header.frame_id, message.d = "optical", [0.1, 0.2, 0.3, 0.4, 0.5]
    message.binning_x = message.binning_y = 2
    message.roi = RegionOfInterest(x_offset=10, y_offset=20, width=600, height=400)
    camera = cdr_to_camera(serialize_message(message))
    expected = camera_from_fields(
        640, 480, "plumb_bob", message.d, K, P, binning=(2, 2), roi=(10, 20, 600, 400)
    )
    assert np.array_equal(camera.matrix, expected.matrix) and camera.width == 300
    assert list(camera.distortion) == list(message.d)
    with pytest.raises(UncalibratedError):
        cdr_to_camera(serialize_message(CameraInfo(width=640, height=480)))
    with pytest.raises(ValueError, match="CameraInfo"):
        cdr_to_camera(serialize_message(message)[:200])


# ---------------------------------------------------------------- targets


def test_boards_are_opencvs_up_to_their_origin():
    if not hasattr(cv2.aruco, "ArucoDetector"):
        pytest.skip("OpenCV before 4.7 makes boards in another way")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    grid = cv2.aruco.GridBoard((4, 3), 0.04, 0.01, dictionary)
    charuco = cv2.aruco.CharucoBoard((5, 7), 0.04, 0.03, dictionary)
    ours = (grid_corners(4, 3, 0.04, 0.01), charuco_corners(5, 7, 0.04, 0.03))
    for board, corners in zip((grid, charuco), ours, strict=True):
        theirs = np.array(board.getObjPoints()) * (1, -1, 1)  # OpenCV's y goes down
        mine = np.array([corners[int(i)] for i in np.ravel(board.getIds())])
        assert np.allclose(mine - mine[0, 0], theirs - theirs[0, 0], atol=1e-7)


def test_a_cube_has_faces_that_look_outwards_and_meet_at_its_edges():
    cube = Target("wand", cube_corners(0.05, 0.05, [1, 2, 3, 4, 5, 6]))
    for marker_id in cube.ids:
        pose = cube.marker_pose(marker_id)
        assert np.allclose(pose.position, 0.025 * pose.rotation[:, 2])
        assert np.linalg.det(pose.rotation) == pytest.approx(1.0)
    corners = {tuple(np.round(c, 6)) for i in cube.ids for c in cube.corners[i]}
    assert len(corners) == 8


def test_boards_file(tmp_path):
    path = tmp_path / "boards.yaml"
    path.write_text(
        "boards:\n"
        "  wand: {markers: [{id: 3, size: 0.04, position: [0, 0, 0.02]},\n"
        "    {id: 4, size: 0.04, position: [0.02, 0, 0], quat_xyzw: [0, 1, 0, 1]}]}\n"
        "  table: {grid: {columns: 2, rows: 2, size: 0.03, gap: 0.01, first_id: 10}}\n"
    )
    boards = load_boards(path)
    assert boards["wand"].ids == (3, 4) and boards["table"].ids == (10, 11, 12, 13)
    assert np.allclose(boards["wand"].marker_pose(4).rotation[:, 2], (1, 0, 0), atol=1e-6)
    check_targets(boards.values())
    with pytest.raises(TargetError, match="id 3 belongs to wand and to ball"):
        check_targets([*boards.values(), single_marker("ball", 3, 0.1)])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("boards: {a: {grid: {columns: 0, rows: 2, size: 0.03, gap: 0.01}}}", "columns"),
        ("boards: {a: {grid: {columns: 2, rows: 2, size: 0, gap: 0.01}}}", "size"),
        ("boards: {a: {grid: {colums: 2}}}", "colums"),
        ("boards: {a: {ring: {}}}", "markers, grid, charuco, cube"),
        ("boards: {a b: {cube: {edge: 0.05, size: 0.04, ids: [1]}}}", "a b"),
        ("boards: {a: {cube: {edge: 0.05, size: 0.06, ids: [1]}}}", "at most"),
        ("boards: {a: {markers: [{id: 1, size: 0.1}, {id: 1, size: 0.1}]}}", "twice"),
        ("boards: {a: {markers: [{id: 1, size: .nan}]}}", "size"),
        ("boards: {a: {markers: [{id: 1, size: 1, quat_xyzw: [0, 0, 0, 0]}]}}", "rotation"),
        ("wrong: 1", "boards"),
    ],
)
def test_wrong_boards_are_refused_by_name(text, expected, tmp_path):
    path = tmp_path / "boards.yaml"
    path.write_text(text)
    with pytest.raises(TargetError, match=expected):
        load_boards(path)


@pytest.mark.parametrize(
    "text", ["ball", "ball:x", ":1", "ball:1:0", "ball:-1", "a/b:1", "ball:1:nan"]
)
def test_wrong_solid_markers(text):
    with pytest.raises(TargetError):
        parse_solid(text, 0.08)


def test_solid_markers():
    assert parse_solid("ball:7", 0.08).marker_size(7) == pytest.approx(0.08)
    assert parse_solid(" ball : 7 : 0.05 ", 0.08).marker_size(7) == pytest.approx(0.05)
