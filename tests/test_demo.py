# SPDX-License-Identifier: Apache-2.0
"""`sph_ros demo` as a whole: real processes, real DDS, a real video, and nothing left behind."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from msg_adapters.bags import BagWriter, open_bag, read_poses
from msg_adapters.header import NANOSECONDS
from msg_adapters.point_cloud import cdr_to_particle_cloud
from msg_adapters.pose import POSE_STAMPED, pose_to_cdr
from sph_ros.processes import ChildError, Children

ROOT = Path(__file__).resolve().parents[1]

SCENE = """
spacing: 0.025
liquid:
  - box: {min: [0, 0, 0], max: [0.2, 0.2, 0.1]}
solids:
  - name: tank
    container:
      box: {min: [0, 0, 0], max: [0.2, 0.2, 0.3]}
  - name: ball
    sphere: {radius: 0.03}
    pose: {position: [0.1, 0.1, 0.18]}
    control: topic
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "coarse_tank.yaml"
    path.write_text(SCENE)
    return path


def start_demo(tmp_path, *arguments):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    environment.pop("ROS_DOMAIN_ID", None)
    with open(tmp_path / "log.txt", "wb") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "sph_ros.demo", *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=environment,
            cwd=tmp_path,
            start_new_session=True,
        )


def group_members(group):
    """Command lines of all running processes of a process group."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
            if int(fields[2]) == group and fields[0] != "Z":
                found.append(stat.with_name("cmdline").read_bytes().replace(b"\0", b" ").decode())
        except (OSError, IndexError):
            continue  # it ended while we looked
    return found


def wait_for(condition, process, tmp_path, timeout=90.0):
    deadline = time.monotonic() + timeout
    while not condition():
        log = (tmp_path / "log.txt").read_text()
        assert process.poll() is None and time.monotonic() < deadline, log
        time.sleep(0.05)


def test_headless_leaves_a_video_a_picture_and_a_bag(scene, tmp_path):
    out = tmp_path / "out"
    demo = start_demo(tmp_path, "--headless", "--scene", scene, "--seconds", "0.6", "--out", out)
    assert demo.wait(120.0) == 0, (tmp_path / "log.txt").read_text()
    assert group_members(demo.pid) == []
    assert sorted(path.name for path in out.iterdir()) == ["bag", "demo.mp4", "last.png"]
    with open_bag(out / "bag") as bag:
        clouds = [cdr_to_particle_cloud(m.data) for m in bag.messages(["/fluid/particles"])]
        assert {"/fluid/surface", "/fluid/solids", "/fluid/solids/ball/pose"} <= set(bag.topics)
        # Discovery decides which topic is heard first.
        assert abs(bag.topics["/fluid/solids/ball/wrench"].count - len(clouds)) <= 3
    span = (clouds[-1].header.stamp_ns - clouds[0].header.stamp_ns) / NANOSECONDS
    film = cv2.VideoCapture(str(out / "demo.mp4"))
    assert abs(film.get(cv2.CAP_PROP_FRAME_COUNT) - (30.0 * span + 1)) <= 1
    assert cv2.imread(str(out / "last.png")).std() > 10.0
    again = start_demo(tmp_path, "--headless", "--scene", scene, "--out", out)
    assert again.wait(30.0) == 1
    assert "holds a demo already" in (tmp_path / "log.txt").read_text()


def test_the_laps_of_a_recorded_hand_are_one_course(scene, tmp_path):
    """Stamps that jump back would have the node refuse the first poses of each lap."""
    with BagWriter(tmp_path / "short") as bag:
        for number in range(20):
            stamp = 50 * NANOSECONDS + number * NANOSECONDS // 50
            pose = pose_to_cdr((0.1, 0.1, 0.2), (0.0, 0.0, 0.0, 1.0), stamp, "world")
            bag.write("/hand", POSE_STAMPED, stamp, pose)
    out = tmp_path / "out"
    demo = start_demo(
        tmp_path, "--headless", "--scene", scene, "--bag", tmp_path / "short", "--seconds", "1.5",
        "--out", out,
    )  # fmt: skip
    assert demo.wait(120.0) == 0, (tmp_path / "log.txt").read_text()
    stamps = read_poses(out / "bag", "/fluid/solids/ball/pose").stamps_ns
    assert len(stamps) > 40 and all(np.diff(stamps) > 0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_the_live_demo_within_two_seconds(number, scene, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    demo = start_demo(tmp_path, "--scene", scene, "--port", port)
    log = lambda: (tmp_path / "log.txt").read_text()  # noqa: E731
    wait_for(lambda: f"open http://localhost:{port}" in log(), demo, tmp_path)
    names = re.findall(r"sph_ros\.nodes\.(\w+)", " ".join(group_members(demo.pid)))
    assert sorted(names) == ["bag_player", "fluid_node", "web_viewer"]
    begin = time.monotonic()
    demo.send_signal(number)
    assert demo.wait(10.0) == 0, log()
    assert time.monotonic() - begin < 2.0
    assert group_members(demo.pid) == []
    assert "Traceback" not in log()


def test_ctrl_c_while_recording_leaves_nothing(scene, tmp_path):
    out = tmp_path / "out"
    demo = start_demo(tmp_path, "--headless", "--scene", scene, "--out", out)
    wait_for(lambda: len(group_members(demo.pid)) == 3, demo, tmp_path)
    demo.send_signal(signal.SIGINT)
    assert demo.wait(10.0) == 130
    assert group_members(demo.pid) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["coarse_tank.yaml", "log.txt"]


def test_a_taken_port_is_reported_with_the_viewers_words(scene, tmp_path):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        demo = start_demo(tmp_path, "--scene", scene, "--port", port)
        assert demo.wait(60.0) == 1
    log = (tmp_path / "log.txt").read_text()
    assert f"port {port} is taken" in log and "web_viewer ended with status 1" in log
    assert "Traceback" not in log and group_members(demo.pid) == []


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        (["--scene", "nowhere"], 1, "nowhere"),
        (["--bag", "no_such_bag"], 1, "no_such_bag"),
        (["--scene", "dam_break", "--bag", "hand_stir"], 1, "control: topic"),
        (["--out", "x"], 2, "--out needs --headless"),
        (["--port", "0"], 2, "--port"),
    ],
)
def test_mistakes_are_said_in_one_line(arguments, status, text, tmp_path):
    demo = start_demo(tmp_path, *arguments)
    assert demo.wait(30.0) == status
    log = (tmp_path / "log.txt").read_text()
    assert text in log.strip().splitlines()[-1] and "Traceback" not in log


def test_a_bag_with_two_clocks_is_refused_before_anything_starts(tmp_path):
    with BagWriter(tmp_path / "two_clocks") as bag:
        for stamp in (50 * NANOSECONDS, 51 * NANOSECONDS, 1 * NANOSECONDS):
            pose = pose_to_cdr((0.1, 0.1, 0.2), (0.0, 0.0, 0.0, 1.0), stamp, "world")
            bag.write("/hand", POSE_STAMPED, 50 * NANOSECONDS, pose)
    demo = start_demo(tmp_path, "--headless", "--bag", tmp_path / "two_clocks")
    assert demo.wait(30.0) == 1
    log = (tmp_path / "log.txt").read_text()
    assert log.count("\n") == 1 and "stamps of one clock" in log and "two_clocks" in log
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.txt", "two_clocks"]


def test_children_report_their_last_words():
    with Children() as children:
        children.start("broken", "sph_ros.no_such_module")
        with pytest.raises(ChildError, match="(?s)broken ended with status 1.*no_such_module"):
            for _ in range(500):
                children.check()
                time.sleep(0.02)
