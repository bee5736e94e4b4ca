# SPDX-License-Identifier: Apache-2.0
"""The tracker against pictures: real ones with known truths, rendered ones, printed pages."""

import shutil
import subprocess

import cv2
import numpy as np
import pytest
from tracking_helpers import (
    BALL,
    CAMERA,
    CAMERA_FROM_WORLD,
    CENTRE,
    FPS,
    HARD_GAPS,
    WORLD,
    SyntheticBoardCamera,
    errors,
    hard_hand,
    rms,
    truth_of_hand,
)

from sph_ros.cli import main
from sph_ros.tracking.calibration import CalibrationError, Calibrator
from sph_ros.tracking.camera import CameraModel, load_camera
from sph_ros.tracking.detection import (
    Detector,
    DictionaryError,
    get_dictionary,
)
from sph_ros.tracking.images import ENCODINGS, ImageError, decode, to_bgr, to_gray
from sph_ros.tracking.pose import estimate_poses
from sph_ros.tracking.printing import CHARUCO, CUBE_EDGE, MARKER_SIZE, PAPERS
from sph_ros.tracking.se3 import Pose, difference, exp, pose_from_quaternion
from sph_ros.tracking.search import merged_regions, region_around
from sph_ros.tracking.synthetic import Flaws, SyntheticCamera
from sph_ros.tracking.targets import charuco_corners, single_marker
from sph_ros.tracking.tracker import Tracker, TrackerSettings

DPI = 200


def frames(path):
    capture = cv2.VideoCapture(str(path))
    good, picture = capture.read()
    while good:
        yield picture
        good, picture = capture.read()
    capture.release()


def opencv_finds(gray, dictionary):
    """Ids that OpenCV's own detector finds, called directly."""
    chosen = get_dictionary(dictionary)
    if hasattr(cv2.aruco, "ArucoDetector"):
        _, ids, _ = cv2.aruco.ArucoDetector(chosen).detectMarkers(gray)
    else:
        _, ids, _ = cv2.aruco.detectMarkers(gray, chosen)
    return sorted([] if ids is None else np.ravel(ids).tolist())


# ---------------------------------------------------------------- real pictures


PICTURES = [
    ("opencv_doc/singlemarkersoriginal.jpg", "DICT_6X6_250", [23, 40, 62, 98, 124, 203]),
    ("opencv_doc/choriginal.jpg", "DICT_6X6_250", None),
    ("opencv_doc/chocclusion.jpg", "DICT_6X6_250", None),
    ("clover/map.png", "DICT_4X4_250", [2, 3]),
    ("bipedal/aruco-sample.png", "DICT_4X4_50", [2, 6, 8]),
    ("sksurgery/output.avi", "DICT_4X4_50", None),
    ("sksurgery/12markers.avi", "DICT_6X6_250", list(range(1, 13))),
    ("sksurgery/multipattern.avi", "DICT_ARUCO_ORIGINAL", None),
    ("pupil_apriltags/test_image_multiple_0*.png", "DICT_APRILTAG_36h11", None),
    ("pupil_apriltags/test_image_rotation_*.png", "DICT_APRILTAG_36h11", [76]),
    ("swatbotics/clipboard/*", "DICT_APRILTAG_36h11", None),
]


@pytest.mark.parametrize(("pattern", "dictionary", "expected"), PICTURES)
def test_finds_every_id_that_opencv_finds(pattern, dictionary, expected, shared_data):
    files = sorted((shared_data / "markers").glob(pattern))
    pictures = [f for path in files for f in (frames(path) if path.suffix == ".avi" else [None])]
    if pictures and pictures[0] is None:
        pictures = [cv2.imread(str(path)) for path in files]
    pictures = [picture for picture in pictures if picture is not None]
    assert pictures
    for picture in pictures[:12]:
        gray = to_gray(picture, "bgr8")
        theirs = opencv_finds(gray, dictionary)
        ours = Detector(dictionary).detect(gray)
        assert sorted(d.id for d in ours) == theirs
        assert theirs, "a picture with nothing in it tests nothing"
        if expected is not None:
            assert set(expected) <= set(theirs)
        some = sorted(set(theirs))[:2]
        assert sorted({d.id for d in Detector(dictionary, some).detect(gray)}) == some


def test_pose_of_the_recorded_webcam(shared_data):
    """Iterative solvePnP of unrefined corners is the truth, so ours must agree with it."""
    rotation = [[0.99928828, -0.02261964, 0.03018762], [-0.02280416, -0.99972323, 0.00578211],
                [0.03004847, -0.00646639, -0.99952753]]  # fmt: skip
    truth = Pose(np.array(rotation), np.array([17.610, 25.086, 210.368]) * 1e-3)
    camera = CameraModel(640, 480, [[560, 0, 320], [0, 560, 240], [0, 0, 1]], [0.1, 0, 0, 0, 0])
    gray = to_gray(list(frames(shared_data / "markers/sksurgery/output.avi"))[1], "bgr8")
    found = Detector("DICT_4X4_50", [0], refine=False).detect(gray)
    solutions = estimate_poses(single_marker("hand", 0, 0.05), found, camera, 0.3)
    off = min((difference(s.pose, truth) for s in solutions), key=np.linalg.norm)
    assert np.linalg.norm(off[:3]) < 0.1e-3 and np.degrees(np.linalg.norm(off[3:])) < 0.05


def test_poses_of_the_rendered_map(shared_data):
    folder = shared_data / "markers/clover"
    gray = cv2.imread(str(folder / "map.png"), cv2.IMREAD_GRAYSCALE)
    camera = load_camera(folder / "camera_info.yaml")
    found = {d.id: d for d in Detector("DICT_4X4_250").detect(gray)}
    truths = {
        2: (0.33, (0.36706568, 0.29048452, 2.18787602),
            (0.99399741, -0.00532003, -0.10739095, 0.02019993)),
        3: (0.1, (-0.18051697, -0.2006973, 0.58576751),
            (-0.96173807, -0.03751802, -0.01153878, 0.27114412)),
    }  # fmt: skip
    for marker_id, (size, position, quat_xyzw) in truths.items():
        truth = pose_from_quaternion(position, quat_xyzw)
        target = single_marker("marker", marker_id, size)
        solutions = estimate_poses(target, [found[marker_id]], camera, 0.3)
        off = min((difference(s.pose, truth) for s in solutions), key=np.linalg.norm)
        assert np.linalg.norm(off[:3]) < 0.01 * np.linalg.norm(position)
        # Both come from corners of half a pixel; see how far noise of that size goes.
        assert np.degrees(np.linalg.norm(off[3:])) < 4.0


def test_distance_of_the_real_apriltag(shared_data):
    camera = CameraModel(1056, 792, [[329.873, 0, 528], [0, 332.946, 396], [0, 0, 1]])
    picture = cv2.imread(str(shared_data / "markers/pupil_apriltags/test_image_rotation_0.png"), 0)
    found = Detector("DICT_APRILTAG_36h11", [76]).detect(picture)
    solutions = estimate_poses(single_marker("tag", 76, 0.065), found, camera, 0.3)
    assert np.allclose(solutions[0].pose.position, (0.0085, -0.0338, 0.2041), atol=0.003)


# ---------------------------------------------------------------- rendered pictures


def test_corners_of_rendered_markers_are_a_tenth_of_a_pixel_off():
    times, truth, _ = truth_of_hand(2.0)
    camera = SyntheticCamera(CAMERA, flaws=Flaws())
    detector = Detector("DICT_4X4_50", [0, 1])
    off = []
    for pose in truth[::6]:
        placed = [(WORLD, CAMERA_FROM_WORLD), (BALL, CAMERA_FROM_WORLD @ pose)]
        found = {d.id: d.corners for d in detector.detect(camera.take(placed))}
        for target, place in placed:
            (marker_id,) = target.ids
            if marker_id in found:
                true = CAMERA.project(place.apply(target.corners[marker_id]))
                off.append(found[marker_id] - true)
    off = np.array(off)
    assert len(off) >= 16
    assert np.sqrt(np.mean(off**2)) < 0.15 and np.abs(off.mean(axis=(0, 1))).max() < 0.03


def test_hard_pictures_are_tracked():
    """Noise, defocus, motion blur, changing light, occlusion, false ids, gaps, a turn edge-on."""
    tracker = Tracker(TrackerSettings(solids=(BALL,), world=WORLD))
    results, (times, truth, pictures) = [], hard_hand()
    for time, picture in zip(times, pictures, strict=True):
        result = tracker.process(picture, round((5.0 + time) * 1e9), CAMERA)
        assert {d.id for d in result.detections} <= {0, 1}
        results.append(result.solids["ball"])
    off = errors(results, truth)
    tracking = np.array([result.status == "tracking" for result in results])
    assert tracking.mean() > 0.4  # in 0.57 it can be seen at all
    assert rms(off[tracking, :3]) < 0.003 and np.degrees(rms(off[tracking, 3:])) < 2.0
    shown = off[~np.isnan(off[:, 0])]
    assert np.linalg.norm(shown[:, :3], axis=1).max() < 0.12  # also while it coasts
    begin, end = HARD_GAPS[-1]
    assert end - begin == 30 and results[end - 5].pose is None
    assert results[end - 5].status == "lost" and results[end + 4].status == "tracking"


def test_regions_of_interest_find_what_the_whole_picture_shows():
    full = Tracker(TrackerSettings(solids=(BALL,), world=WORLD, full_interval=0.0))
    tracker = Tracker(TrackerSettings(solids=(BALL,), world=WORLD))
    times, truth, _ = truth_of_hand(2.0, reach=0.03, tilt=0.25)
    camera = SyntheticCamera(CAMERA)
    searched = 0
    for time, pose in zip(times, truth, strict=True):
        picture = camera.take([(WORLD, CAMERA_FROM_WORLD), (BALL, CAMERA_FROM_WORLD @ pose)])
        a, b = (t.process(picture, round((5.0 + time) * 1e9), CAMERA) for t in (full, tracker))
        assert {d.id for d in a.detections} == {d.id for d in b.detections}
        assert a.regions is None
        searched += b.regions is None
    assert searched <= 15  # of 60


def test_a_marker_seen_edge_on_comes_back():
    """Turned until it is a line, and back: no wild pose on the way, the right one at the end."""
    camera = SyntheticCamera(CAMERA, flaws=Flaws())
    tracker = Tracker(TrackerSettings(solids=(BALL,), world=WORLD))
    angles = 1.5 * np.sin(np.linspace(0.0, np.pi, 60))  # the camera is 0.6 rad off on this side
    places, off, seen = [], [], 0
    for k, angle in enumerate(angles):
        pose = Pose(exp(np.array([angle, 0.0, 0.0])), CENTRE.position)
        picture = camera.take([(WORLD, CAMERA_FROM_WORLD), (BALL, CAMERA_FROM_WORLD @ pose)])
        result = tracker.process(picture, round((k / FPS + 1) * 1e9), CAMERA)
        seen += any(detection.id == 1 for detection in result.detections)
        if result.solids["ball"].pose is not None:
            places.append(result.solids["ball"].pose.position - CENTRE.position)
            off = difference(result.solids["ball"].pose, pose)
    assert 15 <= seen <= 55
    assert np.linalg.norm(places, axis=1).max() < 0.02
    assert np.linalg.norm(off[:3]) < 0.003 and np.degrees(np.linalg.norm(off[3:])) < 4.0


def test_a_lost_marker_is_followed_from_the_picture_after_the_one_that_shows_it():
    """It came back elsewhere: one picture to find it, the next to believe it."""
    camera = SyntheticCamera(CAMERA)
    tracker = Tracker(TrackerSettings(solids=(BALL,), world=WORLD))
    moved = Pose(CENTRE.rotation, CENTRE.position + (0.05, 0.08, 0.0))
    statuses, found = [], []
    for k in range(50):
        placed = [(WORLD, CAMERA_FROM_WORLD)]
        if k < 10 or k >= 35:
            placed.append((BALL, CAMERA_FROM_WORLD @ (CENTRE if k < 10 else moved)))
        result = tracker.process(camera.take(placed), round((k / FPS + 1) * 1e9), CAMERA)
        found.append(any(detection.id == 1 for detection in result.detections))
        statuses.append(result.solids["ball"].status)
    first = found.index(True, 35)
    assert statuses[34] == "lost" and first <= 38
    assert statuses[first : first + 3] == ["lost", "tracking", "tracking"]


def test_pictures_of_another_size_and_stragglers():
    tracker = Tracker(TrackerSettings(solids=(BALL,), world=WORLD))
    empty = np.zeros((480, 640), np.uint8)
    assert tracker.process(empty, 10**9, CAMERA) is not None
    assert tracker.process(empty, 10**9, CAMERA) is None
    assert tracker.process(empty, 10**9 - 10**7, CAMERA) is None
    assert tracker.process(empty, 0, CAMERA) is not None  # a recording that starts over
    again = [tracker.process(empty, 0, CAMERA) is not None for _ in range(3)]
    assert again == [False, False, True]  # a short one
    with pytest.raises(ValueError, match="320 x 240"):
        tracker.process(np.zeros((240, 320), np.uint8), 2 * 10**9, CAMERA)


# ---------------------------------------------------------------- pixels, dictionaries, regions


def test_encodings_show_the_same_picture():
    """A smooth coloured picture, encoded by hand."""
    y, x = np.mgrid[0:64, 0:96]
    bgr = np.stack([x * 2, y * 3, 255 - x - y], axis=-1).astype(np.uint8)
    gray = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    yuv = cv2.cvtColor(bgr, cv2.COLOR_BGR2YUV)
    uyvy = np.stack([np.where(x % 2 == 0, yuv[..., 1], yuv[..., 2]), yuv[..., 0]], axis=-1)
    b, g, r = (bgr[..., i] for i in range(3))
    even, odd = y % 2 == 0, x % 2 == 1
    encoded = {
        "mono8": gray,
        "mono16": np.where((x == 0) & (y == 0), 65535, gray.astype(np.uint16) * 257),
        "bgr8": bgr,
        "rgb8": bgr[..., ::-1],
        "bgra8": np.dstack([bgr, np.full_like(gray, 255)]),
        "rgba8": np.dstack([bgr[..., ::-1], np.full_like(gray, 255)]),
        "yuv422": uyvy,
        "yuv422_yuy2": uyvy[..., ::-1],
        "bayer_rggb8": np.where(even, np.where(odd, g, r), np.where(odd, b, g)),
        "bayer_bggr8": np.where(even, np.where(odd, g, b), np.where(odd, r, g)),
        "bayer_gbrg8": np.where(even, np.where(odd, b, g), np.where(odd, g, r)),
        "bayer_grbg8": np.where(even, np.where(odd, r, g), np.where(odd, g, b)),
    }
    inside = slice(4, -4)
    for encoding, pixels in encoded.items():
        shown = to_gray(np.ascontiguousarray(pixels), encoding).astype(int)
        tolerance = 20 if encoding.startswith("yuv") else 4  # video range is stretched
        assert np.abs(shown - gray)[inside, inside].max() <= tolerance, encoding
        if encoding.startswith("bayer"):
            color = to_bgr(np.ascontiguousarray(pixels), encoding).astype(int)
            assert np.abs(color - bgr)[inside, inside].max() <= 6, encoding
    assert set(encoded) <= set(ENCODINGS)
    with pytest.raises(ImageError, match="32FC1"):
        to_gray(gray, "32FC1")
    with pytest.raises(ImageError, match="empty"):
        to_gray(np.zeros((0, 0), np.uint8), "mono8")


def test_compressed_pictures():
    picture = np.full((20, 30, 3), 90, np.uint8)
    for ending in (".png", ".jpg"):
        assert np.abs(decode(cv2.imencode(ending, picture)[1].tobytes()).astype(int) - 90).max() < 4
    for data in (b"", b"no picture", cv2.imencode(".png", picture)[1].tobytes()[:20]):
        with pytest.raises(ImageError, match="cannot be decoded"):
            decode(data, "png")


def test_dictionaries_are_checked():
    with pytest.raises(DictionaryError, match="DICT_4X4_50"):
        Detector("DICT_4X4")
    with pytest.raises(DictionaryError, match="id 50"):
        Detector("DICT_4X4_50", [0, 50])


def test_regions():
    inside, outside = np.array([[100.0, 100.0], [200.0, 150.0]]), np.array([[-100.0, -100.0]])
    assert region_around(inside, (480, 640), 0.6, 24.0) == (40, 40, 261, 211)
    assert region_around(outside, (480, 640), 0.6, 24.0)[2] == 0
    apart = [(0, 0, 10, 10), (9, 9, 20, 20)]  # the one around both is twice as large as both
    assert merged_regions(apart) == apart
    # The one around the last two is worth being joined with the first, which neither of them was.
    regions = [(0, 8, 20, 20), (40, 40, 50, 50), (0, 0, 11, 10), (9, 0, 20, 10)]
    assert sorted(merged_regions(regions)) == [(0, 0, 20, 20), (40, 40, 50, 50)]


# ---------------------------------------------------------------- printing, calibration


@pytest.mark.parametrize("paper", sorted(PAPERS))
def test_printed_markers_have_their_true_size(paper, tmp_path, capsys):
    path = tmp_path / "markers.pdf"
    assert main(["markers", "--paper", paper, "--out", str(path)]) == 0
    if shutil.which("pdftoppm") is None:
        pytest.skip("no pdftoppm to look at the pages with (apt-get install poppler-utils)")
    subprocess.run(["pdftoppm", "-r", str(DPI), "-gray", path, tmp_path / "page"], check=True)
    pages = [cv2.imread(str(p), 0) for p in sorted(tmp_path.glob("page*.pgm"))]
    scale = 25.4 / DPI  # [mm per pixel]
    assert np.allclose(np.array(pages[0].shape[::-1]) * scale, PAPERS[paper], atol=0.3)
    detector = Detector("DICT_4X4_50")
    first, cube, board = ({d.id: d.corners * scale for d in detector.detect(p)} for p in pages)
    assert set(first) == {0, 1} and set(cube) == {2, 3, 4, 5, 6, 7} and len(board) == 17
    for corners in first.values():
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        assert np.allclose(sides, MARKER_SIZE, atol=0.15)
    steps = np.diff([cube[i].mean(axis=0) for i in (6, 3, 4, 5)], axis=0)
    assert np.allclose(steps, (CUBE_EDGE, 0), atol=0.15)
    places = charuco_corners(*CHARUCO)
    for marker_id, corners in board.items():
        expected = 1000.0 * (places[marker_id] - places[10])[:, :2] * (1, -1)
        assert np.allclose(corners - board[10], expected, atol=0.2)


def test_calibrate_finds_the_camera_that_took_the_pictures(tmp_path, capsys):
    """Rendered pictures of the printed board; focal length to half a percent."""
    true = CameraModel(640, 480, [[600, 0, 330], [0, 603, 235], [0, 0, 1]], [0.12, -0.25, 0, 0, 0])
    camera = SyntheticBoardCamera(true)
    rng = np.random.default_rng(3)
    folder = tmp_path / "pictures"
    folder.mkdir()
    for k in range(14):
        turn = exp(rng.uniform(-0.6, 0.6, 3)) @ np.diag([1.0, -1.0, -1.0])
        place = np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.3, 0.45)])
        cv2.imwrite(str(folder / f"{k:02}.png"), camera.take(Pose(turn, place)))
    out = tmp_path / "camera.yaml"
    assert main(["calibrate", str(folder), "--out", str(out)]) == 0
    found = load_camera(out)
    assert np.allclose(found.matrix[[0, 1], [0, 1]], (600, 603), rtol=0.005)
    assert np.allclose(found.matrix[:2, 2], (330, 235), atol=4)
    rays = np.array([[x, y, 1.0] for x in (-0.4, 0, 0.4) for y in (-0.3, 0, 0.3)])
    assert np.abs(found.project(rays) - true.project(rays)).max() < 2.0


def test_calibration_needs_pictures(tmp_path, capsys):
    with pytest.raises(CalibrationError, match="at least 6"):
        Calibrator(CHARUCO, "DICT_4X4_50").calibrate()
    assert main(["calibrate", str(tmp_path / "nothing.avi")]) == 1
    assert "nothing.avi" in capsys.readouterr().err


def test_old_and_new_opencv(tmp_path):
    """The layer over cv2.aruco works with the functions of 4.6 when only they are there."""
    assert hasattr(cv2.aruco, "ArucoDetector") or hasattr(cv2.aruco, "detectMarkers")
    placed = [(WORLD, CAMERA_FROM_WORLD), (BALL, CAMERA_FROM_WORLD @ CENTRE)]
    picture = SyntheticCamera(CAMERA).take(placed)
    assert {d.id for d in Detector("DICT_4X4_50", [0, 1]).detect(picture)} == {0, 1}
