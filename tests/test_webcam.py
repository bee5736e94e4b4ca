# SPDX-License-Identifier: Apache-2.0
"""`sph_ros webcam` from end to end: a film of a desk in, a film with water on the desk out."""

import cv2
import numpy as np
import pytest
from ros_helpers import RosSession

from sph_ros.cli import main
from sph_ros.desk_video import BALL, desk_camera, make_desk_video
from sph_ros.tracking.detection import Detector
from sph_ros.webcam import Pictures

SCENE = """
spacing: 0.02
liquid:
  - box: {min: [-0.1, -0.1, 0], max: [0.1, 0.1, 0.06]}
solids:
  - name: tank
    container: {box: {min: [-0.1, -0.1, 0], max: [0.1, 0.1, 0.125]}}
  - name: ball
    union: [{sphere: {radius: 0.03}, pose: {position: [0, -0.13, 0]}}]
    pose: {position: [0, 0.05, 0.29], quat_xyzw: [0.559193, 0, 0, 0.829038]}
    control: topic
    color: [1.0, 0.1, 0.05]
"""
SIZE = (320, 240)
CAMERA = desk_camera(SIZE)


def frames(path):
    capture = cv2.VideoCapture(str(path))
    while True:
        good, picture = capture.read()
        if not good:
            return
        yield picture


def expected_ball(picture, detector):
    """Pixel where the wand's marker, as seen in the picture, says that the ball is; or None."""
    found = detector.detect(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
    if not found:
        return None
    half = 0.04 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    _, turn, place = cv2.solvePnP(
        half, found[0].corners, CAMERA.matrix, CAMERA.distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    return CAMERA.project(BALL @ cv2.Rodrigues(turn)[0].T + place.T)[0]


def drawn_ball(picture):
    """Centre of the largest red patch, or None."""
    blue, green, red = (picture[..., k].astype(int) for k in range(3))
    mask = ((red > 90) & (red > 2.2 * np.maximum(blue, green))).astype(np.uint8)
    _, _, statistics, centres = cv2.connectedComponentsWithStats(mask)
    if len(statistics) < 2:
        return None
    largest = 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))
    return centres[largest] if statistics[largest, cv2.CC_STAT_AREA] > 100 else None


def test_a_film_of_a_desk_comes_out_with_water_and_the_wands_ball(tmp_path):
    film = tmp_path / "desk.mp4"
    make_desk_video(film, seconds=2.4, size=SIZE, fps=15.0)
    (tmp_path / "tank.yaml").write_text(SCENE)
    out = tmp_path / "out"
    arguments = f"webcam --source {film} --scene {tmp_path / 'tank.yaml'} --headless --rate 0.25"
    with RosSession("webcam_test") as ros:
        program = ros.start("sph_ros.cli", *arguments.split(), "--out", str(out))
        output = program.wait(240.0)
    assert program.returncode == 0, output
    assert sorted(path.name for path in out.iterdir()) == ["last.png", "webcam.mp4"]
    detector, pairs, water = Detector("DICT_4X4_50", [1]), [], []
    for picture in frames(out / "webcam.mp4"):
        assert picture.shape == (*SIZE[::-1], 3)
        blue, green, red = (picture[..., k].astype(int) for k in range(3))
        # White paper under water is pale blue; nothing else on the desk is bright and blue.
        water.append(((green > 120) & (blue > red + 25)).sum())
        pairs.append((expected_ball(picture, detector), drawn_ball(picture)))
    assert len(water) > 40 and np.median(water) > 1000
    pairs = np.array([pair for pair in pairs if pair[0] is not None and pair[1] is not None])
    assert len(pairs) > 15
    expected, drawn = pairs[:, 0], pairs[:, 1]
    assert np.ptp(expected, axis=0).max() > 40  # it moved, and the drawn one with it
    apart = np.linalg.norm(drawn - expected, axis=1)
    assert np.median(apart) < 8 and (apart < 16).mean() > 0.7


def test_frames_follow_the_times_of_the_pictures(tmp_path):
    from msg_adapters.image import compressed_image_to_cdr

    with open(tmp_path / "spool", "w+b") as spool:
        pictures = Pictures(spool)
        for number, stamp in enumerate((100, 140, 500, 560)):  # at half speed [ms]
            grey = np.full((8, 8, 3), 50 * number, np.uint8)
            data = cv2.imencode(".png", grey)[1].tobytes()
            pictures.add(compressed_image_to_cdr(data, "png", stamp * 10**6, "camera"))
        assert list(pictures.shown(0.5, 100.0))[:8] == [0, 0, 1, 1, 1, 1, 1, 1]
        assert len(list(pictures.shown(0.5, 100.0))) == 24  # 230 ms, and the frame at their end
        assert [pictures.at(number).max() for number in range(4)] == [0, 50, 100, 150]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--source", "nothing.mp4"], "nothing.mp4 does not exist"),
        (["--scene", "nowhere"], "nowhere"),
        (["--camera", "missing.yaml"], "missing.yaml: cannot be read"),
        (["--make-video", "film.avi"], "film.avi: expected a name ending in .mp4"),
    ],
)
def test_mistakes_are_one_line(arguments, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["webcam", *arguments]) == 1
    error = capsys.readouterr().err.strip()
    assert text in error and "\n" not in error and error.startswith("sph_ros webcam: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--rate", "0.5"], "a camera has a rate of its own"),
        (["--out", "x"], "--out needs --headless"),
        (["--size", "64x48"], "--size needs --make-video"),
        (["--port", "0"], "expected 1 to 65535"),
    ],
)
def test_options_that_do_not_go_together_are_refused(arguments, text, capsys):
    with pytest.raises(SystemExit):
        main(["webcam", *arguments])
    assert text in capsys.readouterr().err
