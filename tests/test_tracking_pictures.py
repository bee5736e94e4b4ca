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
    WORLD,
    errors,
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
    merged_regions,
    region_around,
)
from sph_ros.tracking.images import ENCODINGS, ImageError, decode, to_bgr, to_gray
from sph_ros.tracking.pose import estimate_poses
from sph_ros.tracking.printing import CHARUCO, CUBE_EDGE, MARKER_SIZE, PAPERS
from sph_ros.tracking.se3 import Pose, difference, exp, pose_from_quaternion
from sph_ros.tracking.synthetic import Flaws, SyntheticCamera
from sph_ros.tracking.targets import Target, charuco_corners, cube_corners, single_marker
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


def hard_pictures(seconds, flaws, seed=1, drop=()):
    """Pictures of a hand, the truth, and the times; `drop` are ranges without the hand's marker."""
    times, truth, _ = truth_of_hand(seconds, seed=seed, reach=0.03, tilt=0.25)
    camera = SyntheticCamera(CAMERA, flaws=flaws)
    for k, (time, pose) in enumerate(zip(times, truth, strict=True)):
        placed = [(WORLD, CAMERA_FROM_WORLD)]
        if not any(begin <= k < end for begin, end in drop):
            after = truth[min(k + 1, len(truth) - 1)]
            placed.append((BALL, _between(pose, after, flaws.exposure * FPS)))
        yield time, pose, camera.take(placed, time)


def _between(pose, after, share):
    """The motion of a marker while the shutter is open, centred on the stamp."""
    step = difference(after, pose)

    def at(moment):
        part = (moment - 0.5) * share * step
        moved = Pose(exp(part[3:]) @ pose.rotation, pose.position + part[:3])
        return CAMERA_FROM_WORLD @ moved

    return at


def test_hard_pictures_are_tracked():
    """Noise, defocus, motion blur, changing light, occlusion, false ids, gaps of 1 to 30."""
    flaws = Flaws(noise=6, defocus=0.9, exposure=0.008, light_change=0.3, light_gradient=0.6,
                  occlusions=1, false_markers=2)  # fmt: skip
    tracker = Tracker(TrackerSettings(solids=(BALL,), world=WORLD))
    results, truth, tracking = [], [], []
    gaps = ((30, 31), (40, 43), (60, 90))
    for time, pose, picture in hard_pictures(4.0, flaws, drop=gaps):
        result = tracker.process(picture, round((5.0 + time) * 1e9), CAMERA)
        assert {d.id for d in result.detections} <= {0, 1}
        results.append(result.solids["ball"])
        truth.append(pose)
        tracking.append(result.solids["ball"].status == "tracking")
    off, tracking = errors(results, truth), np.array(tracking)
    assert tracking.mean() > 0.5
    assert rms(off[tracking, :3]) < 0.006 and np.degrees(rms(off[tracking, 3:])) < 4.0
    shown = off[~np.isnan(off[:, 0])]
    assert np.linalg.norm(shown[:, :3], axis=1).max() < 0.12  # also while it coasts
    assert results[85].pose is None and results[85].status == "lost"


def test_regions_of_interest_find_what_the_whole_picture_shows():
    full = Tracker(TrackerSettings(solids=(BALL,), world=WORLD, full_interval=0.0))
    tracker = Tracker(TrackerSettings(solids=(BALL,), world=WORLD))
    searched = 0
    for time, _, picture in hard_pictures(2.0, Flaws()):
        stamp = round((5.0 + time) * 1e9)
        a, b = (t.process(picture, stamp, CAMERA) for t in (full, tracker))
        assert {d.id for d in a.detections} == {d.id for d in b.detections}
        assert a.regions is None
        searched += b.regions is None
    assert searched <= 15  # of 60


def test_a_cube_is_followed_all_the_way_round():
    cube = Target("wand", cube_corners(0.06, 0.05, [2, 3, 4, 5, 6, 7]))
    camera = SyntheticCamera(CAMERA, flaws=Flaws())
    tracker = Tracker(TrackerSettings(solids=(cube,)))
    off = []
    for k in range(50):
        turn = exp(np.array([0.5, 0.3, 0.0])) @ exp(np.array([0.0, 0.0, 2 * np.pi * k / 50]))
        pose = Pose(turn, np.array([0.0, 0.0, 0.4]))
        result = tracker.process(camera.take([(cube, pose)]), round((k / FPS + 1) * 1e9), CAMERA)
        off.append(difference(result.solids["wand"].pose, pose))
    off = np.array(off)
    assert rms(off[:, :3]) < 0.003 and np.degrees(rms(off[:, 3:])) < 2.0


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
    assert region_around(np.array([[100.0, 100.0], [200.0, 150.0]]), (480, 640)) == (
        40, 40, 261, 211,
    )  # fmt: skip
    assert region_around(np.array([[-100.0, -100.0], [-90.0, -90.0]]), (480, 640))[2] == 0
    merged = merged_regions([(0, 0, 10, 10), (5, 5, 20, 20), (40, 40, 50, 50), (15, 0, 30, 8)])
    assert sorted(merged) == [(0, 0, 30, 20), (40, 40, 50, 50)]


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
    board = Target("board", charuco_corners(*CHARUCO))
    camera = SyntheticBoardCamera(true)
    rng = np.random.default_rng(3)
    folder = tmp_path / "pictures"
    folder.mkdir()
    for k in range(14):
        turn = exp(rng.uniform(-0.6, 0.6, 3)) @ np.diag([1.0, -1.0, -1.0])
        place = np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.3, 0.45)])
        cv2.imwrite(str(folder / f"{k:02}.png"), camera.take(board, Pose(turn, place)))
    out = tmp_path / "camera.yaml"
    assert main(["calibrate", str(folder), "--out", str(out)]) == 0
    found = load_camera(out)
    assert np.allclose(found.matrix[[0, 1], [0, 1]], (600, 603), rtol=0.005)
    assert np.allclose(found.matrix[:2, 2], (330, 235), atol=4)
    rays = np.array([[x, y, 1.0] for x in (-0.4, 0, 0.4) for y in (-0.3, 0, 0.3)])
    assert np.abs(found.project(rays) - true.project(rays)).max() < 2.0


class SyntheticBoardCamera:
    """Takes pictures of a ChArUco board, whose black squares the marker camera does not know."""

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
        from sph_ros.tracking.detection import marker_picture

        for marker_id, corners in charuco_corners(*CHARUCO).items():
            left, top = np.round(middle + corners[0, :2] * (scale, -scale)).astype(int)
            picture = marker_picture(get_dictionary("DICT_4X4_50"), marker_id, size)
            sheet[top : top + size, left : left + size] = picture
        return cv2.GaussianBlur(np.pad(sheet, 200, constant_values=255), (0, 0), 3.0)

    def take(self, board, pose):
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
