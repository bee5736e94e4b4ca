# SPDX-License-Identifier: Apache-2.0
"""Offline runs: recorded poses in, a folder of results out, the same bytes every time."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from msg_adapters.bags import BagError, BagWriter, open_bag, read_poses
from msg_adapters.point_cloud import cdr_to_particle_cloud
from msg_adapters.pose import POSE_STAMPED, pose_to_cdr
from msg_adapters.wrench import cdr_to_wrench
from sph_ros.sim.scene import SceneError, load_scene
from sph_ros.simulate import SimulateError, simulate
from sph_ros.tracks import read_tracks

ROOT = Path(__file__).resolve().parents[1]
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
START_NS = 1_700_000_000_000_000_000

POOL = {
    "name": "pool",
    "spacing": 0.02,
    "liquid": [{"box": {"min": [0, 0, 0], "max": [0.2, 0.2, 0.1]}}],
    "solids": [
        {"name": "tank", "container": {"box": {"min": [0, 0, 0], "max": [0.2, 0.2, 0.3]}}},
        {
            "name": "ball",
            "sphere": {"radius": 0.03},
            "pose": {"position": [0.1, 0.1, 0.2]},
            "control": "topic",
        },
    ],
}


def write_bag(path, topics, frame="world", quat_xyzw=UPRIGHT):
    """A bag of poses; `topics`: name -> [(seconds, position), ...]."""
    with BagWriter(path) as bag:
        for name, poses in topics.items():
            for seconds, position in poses:
                stamp = START_NS + round(seconds * 1e9)
                bag.write(name, POSE_STAMPED, stamp, pose_to_cdr(position, quat_xyzw, stamp, frame))
    return path


def dip(seconds=0.4, count=9):
    """The ball goes straight down into the water."""
    times = np.linspace(0.0, seconds, count)
    return [(t, (0.1, 0.1, 0.2 - 0.12 * t / seconds)) for t in times]


@pytest.fixture
def hand(tmp_path):
    return write_bag(tmp_path / "hand", {"/hand/pose": dip()})


def messages(folder, topic):
    with open_bag(folder) as bag:
        return [message.data for message in bag.messages([topic])]


# ---------------------------------------------------------------- tracks


def test_the_only_topic_moves_the_only_driven_solid(hand):
    tracks, start_ns = read_tracks(hand, load_scene(POOL))
    assert [track.solid for track in tracks] == ["ball"] and start_ns == START_NS
    assert tracks[0].times == pytest.approx([t for t, _ in dip()], abs=1e-9)
    assert tracks[0].positions == pytest.approx(np.array([p for _, p in dip()]))


def test_topics_find_their_solids_by_name_and_by_remap(tmp_path):
    two = {
        **POOL,
        "solids": [*POOL["solids"], {**POOL["solids"][1], "name": "box"}],
    }
    scene = load_scene(two)
    bag = write_bag(
        tmp_path / "two", {"/a/solids/box/pose": [(0.1, (0, 0, 1))], "/left": [(0.0, (1, 0, 0))]}
    )
    assert [track.solid for track in read_tracks(bag, scene)[0]] == ["box"]
    for target in ("ball", "/fluid/solids/ball/pose"):
        tracks, _ = read_tracks(bag, scene, {"left": target})
        assert {track.solid: track.times[0] for track in tracks} == {"ball": 0.0, "box": 0.1}
    with pytest.raises(BagError, match="one topic"):
        read_tracks(bag, scene, {"/left": "box"})
    with pytest.raises(BagError, match="did you mean 'ball'"):
        read_tracks(bag, scene, {"/left": "bal"})
    with pytest.raises(BagError, match="--remap /left:=ball"):
        read_tracks(write_bag(tmp_path / "one", {"/left": [(0, (0, 0, 0))]}), scene)


def test_poses_that_no_scene_can_follow_are_refused(tmp_path, hand):
    scene = load_scene(POOL)
    other = write_bag(tmp_path / "other", {"/hand": [(0, (0, 0, 0))]}, frame="odom")
    with pytest.raises(BagError, match="'odom', expected 'world'"):
        read_tracks(other, scene)
    assert read_tracks(other, scene, ignore_frame=True)[0][0].solid == "ball"
    bad = write_bag(tmp_path / "bad", {"/hand": [(0, (0, 0, 0)), (1, (0, float("nan"), 0))]})
    with pytest.raises(BagError, match="not finite .* message 1"):
        read_tracks(bad, scene)
    zero = write_bag(tmp_path / "zero", {"/hand": [(0, (0, 0, 0))]}, quat_xyzw=(0, 0, 0, 0))
    with pytest.raises(BagError, match="zero quaternion"):
        read_tracks(zero, scene)
    with pytest.raises(SceneError, match="control: topic"):
        read_tracks(hand, load_scene("dam_break"))


# ---------------------------------------------------------------- results


def test_a_run_leaves_everything_it_promises_and_twice_the_same_bytes(hand, tmp_path):
    first = simulate(POOL, tmp_path / "first", bag=hand, fps=20, size=(160, 120))
    assert first.complete and first.frames == 9
    out = tmp_path / "first"
    assert {file.name for file in out.iterdir()} == {
        "result.mcap",
        "metadata.yaml",
        "video.mp4",
        "last.png",
        "history.csv",
        "history.png",
    }
    clouds = [cdr_to_particle_cloud(data) for data in messages(out, "/fluid/particles")]
    assert len(clouds) == 9 and all(len(cloud.positions) == 500 for cloud in clouds)
    assert clouds[0].header.stamp_ns == START_NS and clouds[0].header.frame_id == "world"
    poses = read_poses(out, "/fluid/solids/ball/pose")
    assert poses.positions[-1] == pytest.approx([0.1, 0.1, 0.08], abs=0.01)
    wrench = cdr_to_wrench(messages(out, "/fluid/solids/ball/wrench")[-1])
    assert wrench.force[2] > 0  # the water pushes the ball up
    with open(out / "history.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 9 and float(rows[-1]["force/ball_z"]) == pytest.approx(wrench.force[2])
    video = cv2.VideoCapture(str(out / "video.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 9
    assert cv2.imread(str(out / "last.png")).shape == (120, 160, 3)

    simulate(POOL, tmp_path / "second", bag=hand, fps=20, size=(160, 120))
    for name in ("result.mcap", "history.csv", "last.png"):
        assert (out / name).read_bytes() == (tmp_path / "second" / name).read_bytes(), name


def test_nothing_is_overwritten_unless_asked(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SimulateError, match="not empty"):
        simulate(POOL, tmp_path, seconds=0.05, size=None)
    simulate(POOL, tmp_path, seconds=0.05, size=None, force=True)
    simulate(POOL, tmp_path, seconds=0.1, size=None, force=True)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert len(messages(tmp_path / "result.mcap", "/fluid/particles")) == 4
    with pytest.raises(SimulateError, match="is a file"):
        simulate(POOL, tmp_path / "notes.txt", seconds=0.05)


def test_an_error_on_the_way_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("sph_ros.recording.History.add", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        simulate(POOL, tmp_path / "out", seconds=0.05, size=None)
    assert not list(tmp_path.iterdir())


def test_ctrl_c_keeps_what_is_complete(tmp_path):
    command = [sys.executable, "-m", "sph_ros.cli", "simulate", "resting_column", "--no-video"]
    process = subprocess.Popen(
        [*command, "--seconds", "1000", "--out", str(tmp_path / "out")],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    try:
        deadline = time.monotonic() + 120
        while not any(
            file.stat().st_size for file in tmp_path.glob(".out.*/.result.*/result/*.mcap")
        ):
            assert process.poll() is None and time.monotonic() < deadline, process.communicate()
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130 and "interrupted at" in out and "Traceback" not in error
    assert [file.name for file in tmp_path.iterdir()] == ["out"]
    frames = messages(tmp_path / "out", "/fluid/particles")
    assert len(frames) >= 1 and len(cdr_to_particle_cloud(frames[-1]).positions) == 2000


def test_a_real_hand_stirs(shared_data, tmp_path):
    """Motion capture of a hand, 100 Hz, over half a metre: the tank stands where it moves."""
    bag = shared_data / "bags" / "fr1_xyz_mocap_mcap"
    lower, upper = [0.9, 0.1, 1.2], [1.6, 1.1, 1.9]
    scene = {
        "spacing": 0.05,
        "liquid": [{"box": {"min": lower, "max": [1.6, 1.1, 1.4]}}],
        "solids": [
            {"name": "tank", "container": {"box": {"min": lower, "max": upper}}},
            {
                "name": "hand",
                "capsule": {"radius": 0.05, "length": 0.15},
                "pose": {"position": [1.2, 0.6, 1.7]},
                "control": "topic",
            },
        ],
    }
    summary = simulate(scene, tmp_path / "out", bag=bag, seconds=3, fps=10, size=None)
    assert summary.complete
    recorded = read_poses(bag)
    followed = read_poses(tmp_path / "out", "/fluid/solids/hand/pose")
    assert followed.stamps_ns[0] == recorded.stamps_ns[0]
    at = np.searchsorted(recorded.stamps_ns, followed.stamps_ns[10:])  # from 1 s on it is there
    assert np.abs(recorded.positions[at] - followed.positions[10:]).max() < 0.02
    for data in messages(tmp_path / "out", "/fluid/particles"):
        positions = cdr_to_particle_cloud(data).positions
        assert (positions > np.array(lower) - 0.0025).all()
        assert (positions < np.array(upper) + 0.0025).all()
