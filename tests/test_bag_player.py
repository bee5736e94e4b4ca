# SPDX-License-Identifier: Apache-2.0
"""bag_player in its own process, heard by a real subscriber over DDS."""

import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed: rclpy cannot be imported")

from geometry_msgs.msg import PoseStamped  # noqa: E402
from ros_helpers import RosSession  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402

from msg_adapters.bags import BagMessage, BagWriter, open_bag, read_poses  # noqa: E402
from msg_adapters.clock import CLOCK, cdr_to_clock, clock_to_cdr  # noqa: E402
from msg_adapters.pose import POSE_STAMPED, cdr_to_pose, pose_from_message, pose_to_cdr  # noqa: E402
from msg_adapters.wrench import WRENCH_STAMPED, wrench_to_cdr  # noqa: E402
from sph_ros.nodes.bag_player import main, with_clock  # noqa: E402

PLAYER = "sph_ros.nodes.bag_player"
START = 1_700_000_000 * 10**9
STEP = 20_000_000  # 50 Hz
COUNT = 25


@pytest.fixture
def bag(tmp_path):
    """Half a second of poses, and wrenches on another topic."""
    path = tmp_path / "recording"
    with BagWriter(path) as writer:
        for index in range(COUNT):
            stamp = START + index * STEP
            # Received later than stamped, by a clock that is a second ahead.
            pose = pose_to_cdr((index, 0, 0), (0, 0, 0, 1), stamp - 10**9, "world")
            writer.write("/hand/pose", POSE_STAMPED, stamp, pose)
        writer.write("/wrench", WRENCH_STAMPED, stamp, wrench_to_cdr((1, 2, 3), (0, 0, 0), 0, "w"))
    return path


def test_plays_every_message_as_recorded_and_ends(bag):
    with RosSession() as ros:
        heard = ros.collect(PoseStamped, "/hand/pose", raw=True)
        player = ros.start(PLAYER, str(bag), "--wait", "20")
        output = player.wait(30.0)
        assert player.returncode == 0, output
        ros.wait_for(lambda: len(heard) >= COUNT, 10.0)
    with open_bag(bag) as reader:
        assert heard == [message.data for message in reader.messages(["/hand/pose"])]
    assert "Traceback" not in output


def test_rate_remap_and_topics(bag):
    with RosSession() as ros:
        times = []
        ros.node.create_subscription(
            PoseStamped, "/fluid/ball", lambda _: times.append(time.monotonic()), 100
        )
        others = ros.collect(PoseStamped, "/hand/pose")
        arguments = ["--topics", "hand/pose", "--remap", "/hand/pose:=/fluid/ball"]
        player = ros.start(PLAYER, str(bag), *arguments, "--rate", "0.25", "--wait", "20")
        output = player.wait(30.0)
        assert player.returncode == 0, output
        ros.wait_for(lambda: len(times) == COUNT, 10.0)
        assert not others
        assert ros.node.count_publishers("/wrench") == 0
        # 0.48 s at a quarter of the speed; a busy machine can only make it longer.
        assert times[-1] - times[0] > 1.5


def test_ros_arguments_remap_too(bag):
    with RosSession() as ros:
        heard = ros.collect(PoseStamped, "/elsewhere")
        player = ros.start(
            PLAYER, str(bag), "--wait", "20", "--ros-args", "-r", "/hand/pose:=/elsewhere"
        )
        output = player.wait(30.0)
        assert player.returncode == 0, output
        ros.wait_for(lambda: len(heard) == COUNT, 10.0)


def test_loop_starts_over_with_the_recorded_stamps_until_interrupted(bag):
    with RosSession() as ros:
        heard = ros.collect(PoseStamped, "/hand/pose")
        player = ros.start(PLAYER, str(bag), "--loop", "--rate", "4", "--wait", "20")
        ros.wait_for(lambda: len(heard) > 3 * COUNT, 30.0)
        began = time.monotonic()
        output = player.interrupt()
        ended = time.monotonic() - began
    assert player.returncode == 0, output
    assert "Traceback" not in output
    assert ended < 5.0  # within a second on a free machine
    stamps = np.array([pose_from_message(message).stamp_ns for message in heard])
    back = np.flatnonzero(np.diff(stamps) < 0)
    assert len(back) >= 2
    assert set(np.diff(back)) == {COUNT}
    assert stamps.min() == START - 10**9


def test_sigterm_ends_it_cleanly_while_it_waits(bag):
    with RosSession() as ros:
        player = ros.start(PLAYER, str(bag), "--wait", "1000")
        ros.wait_for(lambda: ros.node.count_publishers("/hand/pose"), 20.0)
        output = player.terminate()
        assert player.returncode == 0, output
        assert "Traceback" not in output


def test_clock_follows_the_recorded_time(bag):
    with RosSession() as ros:
        clocks = ros.collect(Clock, "/clock", raw=True)
        poses = ros.collect(PoseStamped, "/hand/pose")
        player = ros.start(PLAYER, str(bag), "--clock", "200", "--rate", "2", "--wait", "20")
        output = player.wait(30.0)
        assert player.returncode == 0, output
        ros.wait_for(lambda: len(poses) == COUNT, 10.0)
        ros.wait_for(lambda: clocks and cdr_to_clock(clocks[-1]) == START + (COUNT - 1) * STEP)
    times = np.array([cdr_to_clock(clock) for clock in clocks])
    assert (np.diff(times) > 0).all()
    # 200 a second of real time at twice the speed: 10 ms of recorded time apart.
    assert set(np.diff(times)) == {10_000_000}


def test_stamp_now_and_received(bag):
    for option in ("now", "received"):
        with RosSession() as ros:
            before = time.time_ns()
            heard = ros.collect(PoseStamped, "/hand/pose", raw=True)
            player = ros.start(PLAYER, str(bag), "--stamp", option, "--rate", "10", "--wait", "20")
            output = player.wait(30.0)
            assert player.returncode == 0, output
            ros.wait_for(lambda: len(heard) == COUNT, 10.0)  # noqa: B023
        poses = [cdr_to_pose(data) for data in heard]
        stamps = np.array([pose.stamp_ns for pose in poses])
        assert [pose.position[0] for pose in poses] == list(range(COUNT))
        if option == "now":
            assert before < stamps[0] <= stamps[-1] <= time.time_ns()
        else:
            assert stamps.tolist() == [START + index * STEP for index in range(COUNT)]


def test_service_events_and_unknown_types_are_skipped(shared_data):
    folder = shared_data / "bags/rosbag2_official/rosbag2_cpp/test/rosbag2_cpp/bags"
    with RosSession() as ros:
        player = ros.start(PLAYER, str(folder / "topics_and_services.mcap"), "--wait", "0")
        output = player.wait(60.0)
    assert player.returncode == 0, output
    assert "skipping /add_two_ints/_service_event" in output
    assert "playing 7 messages of /parameter_events" in output


def test_a_real_recording_arrives_whole(shared_data):
    path = shared_data / "bags/fr1_xyz_rgbdslam_db3"
    with RosSession() as ros:
        heard = ros.collect(PoseStamped, "/tracker/pose", raw=True)
        player = ros.start(PLAYER, str(path), "--rate", "20", "--wait", "20")
        output = player.wait(60.0)
        assert player.returncode == 0, output
        ros.wait_for(lambda: len(heard) == 788, 10.0)
    expected = read_poses(path)
    got = [cdr_to_pose(data) for data in heard]
    np.testing.assert_array_equal([pose.stamp_ns for pose in got], expected.stamps_ns)
    np.testing.assert_array_equal([pose.position for pose in got], expected.positions)


def test_clock_ticks_lie_between_the_messages():
    messages = [BagMessage("/a", "t", stamp, b"") for stamp in (100, 125, 131)]
    played = [(m.topic, m.stamp_ns) for m in with_clock(iter(messages), 10)]
    assert played == [
        ("/clock", 100), ("/a", 100), ("/clock", 110), ("/clock", 120), ("/a", 125),
        ("/clock", 130), ("/a", 131),
    ]  # fmt: skip
    assert list(with_clock(iter([]), 10)) == []


def two_clocks(path):
    with BagWriter(path) as writer:
        for index in range(20):
            clock = START + index * STEP - (index % 2) * 10**10
            writer.write("/clock", CLOCK, START + index * STEP, clock_to_cdr(clock))
    return path


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["hand_stri"], "hand_stri: no such bag"),
        (["{bag}", "--topics", "/nothing"], "no topic /nothing, expected one of /hand/pose"),
        (["{bag}", "--remap", "/x:=/y"], "no topic /x"),
        (["{bag}", "--remap", "/hand/pose:=/a b"], "'/a b' is not a valid topic name"),
        (["{bag}", "--remap", "/hand/pose:=/wrench"], "both go to /wrench"),
        (["{bag}", "--ros-args", "-r", "nonsense"], "nonsense"),
        (["{truncated}"], "truncated.mcap is damaged or truncated, expected a complete bag"),
        (["{clocks}"], "expected stamps of one clock that runs forward"),
    ],
)
def test_errors_are_one_line_and_an_exit_status(bag, tmp_path, capsys, arguments, expected):
    truncated = tmp_path / "truncated.mcap"
    truncated.write_bytes((bag / "recording.mcap").read_bytes()[:-100])
    names = {"bag": bag, "truncated": truncated, "clocks": tmp_path / "clocks"}
    if "{clocks}" in arguments:
        two_clocks(names["clocks"])
    status = main([argument.format(**names) for argument in arguments])
    lines = capsys.readouterr().err.strip().splitlines()
    assert status == 1
    assert len(lines) == 1 and lines[0].startswith("bag_player: error: ")
    assert expected in lines[0]


def test_usage_errors():
    for option, expected in (
        (["--rate", "0"], "above 0, got '0'"),
        (["--rate", "nan"], "above 0, got 'nan'"),
        (["--delay", "-1"], "at least 0, got '-1'"),
        (["--remap", "a"], "expected A:=B, got 'a'"),
    ):
        done = subprocess.run(
            [sys.executable, "-m", PLAYER, "bag", *option], capture_output=True, text=True
        )
        assert done.returncode == 2
        assert expected in done.stderr and "Traceback" not in done.stderr
