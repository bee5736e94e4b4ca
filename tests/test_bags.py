# SPDX-License-Identifier: Apache-2.0
"""Bags: real ones of the rosbag2 project and of others, our own, and every way to break one."""

import importlib.util
import shutil
import sqlite3
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from msg_adapters.bags import (
    BagError,
    BagWriter,
    check_clocks,
    open_bag,
    read_poses,
)
from msg_adapters.clock import CLOCK, clock_to_cdr
from msg_adapters.pose import POSE_STAMPED, cdr_to_pose, pose_to_cdr
from msg_adapters.wrench import WRENCH_STAMPED, wrench_to_cdr

BAGS = Path(__file__).resolve().parents[1] / "scenes" / "bags"
SECOND = 10**9
START = 1_700_000_000 * SECOND
STORE = get_typestore(Stores.ROS2_JAZZY)
OFFICIAL = "bags/rosbag2_official"


def pose(stamp_ns, x=0.0, frame="world"):
    return pose_to_cdr((x, 0, 0), (0, 0, 0, 1), stamp_ns, frame)


def write_poses(path, stamps, received=None, topic="/pose", frames=None, **options):
    with BagWriter(path, **options) as bag:
        for index, stamp in enumerate(stamps):
            at = START + index * SECOND // 50 if received is None else received[index]
            frame = frames[index % len(frames)] if frames else "world"
            bag.write(topic, POSE_STAMPED, at, pose(stamp, index, frame))
    return path


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_written_bags_are_read_back_by_us_and_by_the_library(tmp_path, storage):
    path = tmp_path / "new" / "bag"
    messages = [
        ("/a", POSE_STAMPED, START + 5, pose(1)),
        ("/b", WRENCH_STAMPED, START + 3, wrench_to_cdr((1, 2, 3), (4, 5, 6), 7, "w")),
        ("/a", POSE_STAMPED, START + 4, pose(2)),
    ]
    with BagWriter(path, storage=storage) as bag:
        for message in messages:
            bag.write(*message)
        assert not path.exists()  # nothing half-written shows
    assert [p.name for p in path.parent.iterdir()] == ["bag"]
    with open_bag(path) as bag:
        assert list(bag.messages()) == sorted(messages, key=lambda message: message[2])
        assert [m.stamp_ns for m in bag.messages(["/a"])] == [START + 4, START + 5]
        assert {t.name: (t.type, t.count) for t in bag.topics.values()} == {
            "/a": (POSE_STAMPED, 2),
            "/b": (WRENCH_STAMPED, 1),
        }
    with AnyReader([path]) as reader:  # with the definitions in the file, not ours
        decoded = {c.topic: reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()}
    assert decoded["/b"].wrench.torque.z == 6.0
    storage_file = next(p for p in path.iterdir() if p.suffix != ".yaml")
    with open_bag(storage_file) as bag:
        assert bag.message_count == 3


def test_the_same_messages_give_the_same_bytes(tmp_path):
    for name in ("one", "two"):
        write_poses(tmp_path / name / "bag", [START, START + 1])
    first, second = (sorted((tmp_path / name / "bag").iterdir()) for name in ("one", "two"))
    assert [p.name for p in first] == ["bag.mcap", "metadata.yaml"]
    for one, two in zip(first, second, strict=True):
        assert one.read_bytes() == two.read_bytes()


def test_a_failing_writer_leaves_nothing_and_replaces_nothing(tmp_path):
    path = write_poses(tmp_path / "bag", [START])
    before = (path / "bag.mcap").read_bytes()
    with pytest.raises(ZeroDivisionError), BagWriter(path, overwrite=True) as bag:
        bag.write("/a", POSE_STAMPED, START, pose(1))
        1 / 0  # noqa: B018
    assert [p.name for p in tmp_path.iterdir()] == ["bag"]
    assert (path / "bag.mcap").read_bytes() == before

    with pytest.raises(BagError, match="bag: exists already"):
        BagWriter(path)
    write_poses(path, [START, START + 1], overwrite=True)
    with open_bag(path) as bag:
        assert bag.message_count == 2
    assert [p.name for p in tmp_path.iterdir()] == ["bag"]

    (tmp_path / "precious").mkdir()
    with pytest.raises(BagError, match="precious: exists and is not a bag"):
        BagWriter(tmp_path / "precious", overwrite=True)


def test_writer_refuses_what_is_not_a_message(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/a", POSE_STAMPED, START, pose(1))
        for arguments, expected in (
            (("/a", WRENCH_STAMPED, START, pose(1)), "WrenchStamped on topic /a, expected .*Pose"),
            (("/b", "nobody/msg/Knows", START, pose(1)), "unknown message type nobody/msg/Knows"),
            (("b", POSE_STAMPED, START, pose(1)), "expected a name with leading slash"),
            (("/a", POSE_STAMPED, START, b"hello"), "expected plain CDR"),
            (("/a", POSE_STAMPED, -1, pose(1)), "stamp_ns is -1, expected 0 or more"),
        ):
            with pytest.raises(ValueError, match=expected):
                bag.write(*arguments)
    with pytest.raises(BagError, match="expected one of mcap, sqlite3"):
        BagWriter(tmp_path / "other", storage="rosbag1")
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="cannot be written"), BagWriter(tmp_path / "file" / "bag"):
        pass


REAL_BAGS = {
    "fr1_xyz_mocap_mcap": 3000,
    "fr1_xyz_rgbdslam_db3": 788,
    "tumvi_room1_mcap": 2401,
    "webcam_sksurgery_mcap": 20,
    "rosbag2_official/rosbag2_py/test/resources/mcap/wbag": 6074,  # five files
    "rosbag2_official/rosbag2_py/test/resources/sqlite3/wbag": 6074,
    # Through their folders the library finds 0 of these: quality of service is noted in two ways.
    "rosbag2_official/rosbag2_py/test/resources/mcap/talker": 20,
    "rosbag2_official/rosbag2_py/test/resources/sqlite3/talker": 20,
    "rosbag2_official/rosbag2_transport/test/resources/sqlite3/rewriter_b": 75,
    "rosbag2_official/rosbag2_tests/resources/mcap/bag_with_topics_and_service_events": 10,
    "rosbag2_official/rosbag2_tests/resources/sqlite3/bag_with_topics_and_service_events": 10,
    "rosbag2_official/rosbag2_cpp/test/rosbag2_cpp/bags/only_services.mcap": 12,
    "rosbag2_official/rosbag2_cpp/test/rosbag2_cpp/bags/topics_and_services.db3": 13,
}


@pytest.mark.parametrize("name", REAL_BAGS)
def test_real_bags_give_every_message_in_order(shared_data, name):
    with open_bag(shared_data / "bags" / name) as bag:
        messages = list(bag.messages())
        assert bag.message_count == len(messages) == REAL_BAGS[name]
        counts = {topic.name: topic.count for topic in bag.topics.values()}
    stamps = [message.stamp_ns for message in messages]
    assert stamps == sorted(stamps)
    for topic, count in counts.items():
        assert count == sum(message.topic == topic for message in messages)
    assert all(len(message.type.split("/")) == 3 for message in messages)


@pytest.mark.parametrize("name", ["fr1_xyz_mocap_mcap", "fr1_xyz_rgbdslam_db3", "tumvi_room1_mcap"])
def test_real_poses_are_what_the_library_decodes(shared_data, name):
    path = shared_data / "bags" / name
    with AnyReader([path]) as reader:
        expected = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()]
    poses = read_poses(path)
    stamps = [m.header.stamp.sec * SECOND + m.header.stamp.nanosec for m in expected]
    assert poses.stamps_ns.dtype == np.int64
    np.testing.assert_array_equal(poses.stamps_ns, stamps)
    for index in (0, len(expected) // 2, -1):
        p, q = expected[index].pose.position, expected[index].pose.orientation
        assert poses.positions[index].tolist() == [p.x, p.y, p.z]
        assert poses.quats_xyzw[index].tolist() == [q.x, q.y, q.z, q.w]
    assert poses.frame_id == expected[0].header.frame_id
    # Facts about a person's hand: unit quaternions, below 3 m/s, never further than a room.
    np.testing.assert_allclose(np.linalg.norm(poses.quats_xyzw, axis=1), 1.0, atol=2e-3)
    steps = np.linalg.norm(np.diff(poses.positions, axis=0), axis=1)
    assert (steps / np.diff(poses.stamps_ns / 1e9)).max() < 3.0
    assert np.ptp(poses.positions, axis=0).max() < 6.0


def test_compressed_bags_are_read(tmp_path):
    for mode in (CompressionMode.FILE, CompressionMode.MESSAGE):
        path = tmp_path / mode.name
        writer = Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection("/pose", POSE_STAMPED, typestore=STORE)
            for index in range(5):
                writer.write(connection, START + index, pose(START + index, index))
        assert read_poses(path).positions[:, 0].tolist() == [0, 1, 2, 3, 4]


def test_split_bags_that_overlap_come_in_order(tmp_path):
    """Two files recorded at the same time, as two writers of one bag leave them."""
    folder = tmp_path / "bag"
    folder.mkdir()
    for name, offset in (("a", 0), ("b", SECOND // 100)):
        received = [START + offset + index * SECOND // 50 for index in range(4)]
        write_poses(tmp_path / name, received, received)
        shutil.copy(tmp_path / name / f"{name}.mcap", folder)
    text = (tmp_path / "a" / "metadata.yaml").read_text()
    text = text.replace("- a.mcap", "- a.mcap\n  - b.mcap").replace("count: 4", "count: 8")
    (folder / "metadata.yaml").write_text(text)
    with open_bag(folder) as bag:
        stamps = [message.stamp_ns - START for message in bag.messages()]
    assert stamps == [index * SECOND // 100 for index in range(8)]


def break_truncated(path):
    file = path / "bag.mcap"
    file.write_bytes(file.read_bytes()[:-50])


def break_middle(path):
    file = path / "bag.mcap"
    data = bytearray(file.read_bytes())
    message = data.index(pose(START + 10 * SECOND // 50, 10))
    data[message - 31 : message] = b"\xff" * 31  # the record before the message's own bytes
    file.write_bytes(data)


def break_emptied(path):
    (path / "bag.mcap").write_bytes(b"")


def break_missing_file(path):
    (path / "bag.mcap").unlink()


def break_no_metadata(path):
    (path / "metadata.yaml").unlink()


def break_yaml(path):
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: [")


def break_other_yaml(path):
    (path / "metadata.yaml").write_text("spacing: 0.01")


def break_count(path):
    text = (path / "metadata.yaml").read_text()
    (path / "metadata.yaml").write_text(text.replace("message_count: 20", "message_count: 30"))


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (break_truncated, "bag.mcap is damaged or truncated, expected a complete bag"),
        (break_middle, "bag: damaged or truncated"),
        (break_emptied, "bag.mcap is damaged or truncated"),
        (break_missing_file, "expected the file bag.mcap in it"),
        (break_no_metadata, "not a bag, expected a metadata.yaml in the folder"),
        (break_yaml, "metadata.yaml: not the metadata of a bag"),
        (break_other_yaml, "metadata.yaml: not the metadata of a bag"),
        (break_count, "the files hold 20 messages, expected 30"),
    ],
)
def test_damaged_bags_are_one_clear_line(tmp_path, damage, expected):
    path = write_poses(tmp_path / "bag", [START + index * SECOND // 50 for index in range(20)])
    assert len(read_poses(path).stamps_ns) == 20
    damage(path)
    with pytest.raises(BagError, match=expected) as caught:
        read_poses(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_truncation_of_both_storages_is_noticed(tmp_path):
    for storage, suffix in (("mcap", ".mcap"), ("sqlite3", ".db3")):
        path = write_poses(tmp_path / storage, range(START, START + 200), storage=storage)
        file = path / f"{storage}{suffix}"
        data = file.read_bytes()
        for length in range(0, len(data) * 9 // 10, len(data) // 23):
            file.write_bytes(data[:length])
            for opened in (path, file):
                with pytest.raises(BagError, match="truncated|damaged"):
                    read_poses(opened)


def test_what_is_not_a_bag(tmp_path, shared_data):
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "fake.mcap").write_text("hello, hello, hello")
    (tmp_path / "fake.db3").write_text("hello")
    sqlite3.connect(tmp_path / "other.db3").execute("CREATE TABLE cats(name TEXT)").close()
    official = shared_data / OFFICIAL
    for path, expected in (
        (tmp_path / "nothing", "nothing: does not exist, expected a rosbag2 folder"),
        (tmp_path / "notes.txt", "not a bag, expected a rosbag2 folder, .mcap or .db3 file"),
        (tmp_path / "fake.mcap", "fake.mcap is damaged"),
        (tmp_path / "fake.db3", "fake.db3 is damaged"),
        (tmp_path / "other.db3", "other.db3 is damaged"),
        (tmp_path, "not a bag, expected a metadata.yaml"),
        (official / "ros2bag/test/resources/empty_bag", "has no messages, expected at least one"),
        (official / "rosbag2_tests/resources/mcap/wrong_rmw_test", "as 'wrong_format', expected"),
        (official / "rosbag2_tests/resources/sqlite3/wrong_rmw_test", "as 'wrong_format', exp"),
    ):
        with pytest.raises(BagError, match=expected):
            open_bag(path)
    with open_bag(official / "ros2bag/test/resources/empty_bag", allow_empty=True) as bag:
        assert not list(bag.messages())
        assert "/rosout" in bag.topics


def test_wanted_topic_absent_wrong_or_ambiguous(tmp_path, shared_data):
    with BagWriter(tmp_path / "bag") as bag:
        for topic in ("/left", "/right"):
            bag.write(topic, POSE_STAMPED, START, pose(START))
        bag.write("/clock", CLOCK, START, clock_to_cdr(START))
    path = tmp_path / "bag"
    assert read_poses(path, "left").stamps_ns.tolist() == [START]
    for topic, expected in (
        (None, "several topics of geometry_msgs/msg/PoseStamped, choose from /left, /right"),
        ("/middle", "no topic /middle, expected one of .*/left .geometry_msgs/msg/PoseStamped"),
        ("/clock", "/clock has rosgraph_msgs/msg/Clock, expected geometry_msgs/msg/PoseStamped"),
    ):
        with pytest.raises(BagError, match=expected):
            read_poses(path, topic)
    with pytest.raises(BagError, match="no topic of geometry_msgs/msg/PoseStamped, only /camera"):
        read_poses(shared_data / "bags/webcam_sksurgery_mcap")


def test_two_types_on_one_topic_are_refused(tmp_path):
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for message_type, data in ((CLOCK, clock_to_cdr(1)), (POSE_STAMPED, pose(1))):
            connection = writer.add_connection("/clock", message_type, typestore=STORE)
            writer.write(connection, START, data)
    with pytest.raises(BagError, match="/clock has .* and .*, expected one message type"):
        open_bag(tmp_path / "bag")


def test_one_clock_that_differs_from_the_recorders_is_fine(tmp_path):
    simulated = [index * SECOND // 50 for index in range(9)]
    poses = read_poses(write_poses(tmp_path / "simulated", simulated))
    assert poses.stamps_ns.tolist() == simulated
    # Messages that overtook each other by milliseconds are put in order.
    swapped = [START + step * SECOND // 1000 for step in (0, 10, 30, 20, 40)]
    poses = read_poses(write_poses(tmp_path / "swapped", swapped))
    assert poses.stamps_ns.tolist() == sorted(swapped)
    assert poses.positions[:, 0].tolist() == [0, 1, 3, 2, 4]
    # A pause is not a clock: two hours without a message, on both clocks.
    paused = [START, START + 7200 * SECOND]
    assert len(read_poses(write_poses(tmp_path / "paused", paused, paused)).stamps_ns) == 2
    # Nobody filled in the stamps: the times of receipt serve.
    poses = read_poses(write_poses(tmp_path / "unstamped", [0, 0, 0]))
    assert poses.stamps_ns.tolist() == [START + index * SECOND // 50 for index in range(3)]


def test_two_clocks_in_the_poses_are_refused(tmp_path):
    step = SECOND // 50
    wall = [START + index * step for index in range(10)]
    sim = [index * step for index in range(10)]
    interleaved = [wall[i] if i % 2 else sim[i] for i in range(10)]
    for name, stamps, index in (
        ("interleaved", interleaved, 1),
        ("switched", sim[:5] + wall[5:], 5),
        ("restarted", sim[:5] * 2, None),
        ("jumped", wall[:5] + [stamp - SECOND for stamp in wall[5:]], 5),
    ):
        stamps = [stamp + 10 * SECOND for stamp in stamps]
        if name == "restarted":
            stamps, index = [stamp * 100 for stamp in stamps], 5
        path = write_poses(tmp_path / name, stamps)
        with pytest.raises(BagError, match=f"message {index} of /pose .* expected stamps of one"):
            read_poses(path)


def test_two_clocks_on_the_clock_topic_are_refused(tmp_path):
    for name, jump in (("one", 0), ("two", 5 * SECOND)):
        with BagWriter(tmp_path / name) as bag:
            for index in range(10):
                now = START + index * SECOND // 50
                bag.write("/pose", POSE_STAMPED, now, pose(now))
                bag.write("/clock", CLOCK, now, clock_to_cdr(now + (index % 2) * jump))
    assert len(read_poses(tmp_path / "one").stamps_ns) == 10
    with pytest.raises(BagError, match="of /clock is stamped .* expected stamps of one clock"):
        read_poses(tmp_path / "two")
    with open_bag(tmp_path / "two") as bag:
        check_clocks(bag, ["/pose"])
        with pytest.raises(BagError, match="/clock"):
            check_clocks(bag, ["/pose", "/clock"])


def test_several_frames_and_undecodable_poses_are_refused(tmp_path):
    path = write_poses(tmp_path / "frames", [START, START + 1], frames=["world", "camera"])
    with pytest.raises(BagError, match="/pose has frames camera, world, expected one"):
        read_poses(path)
    with BagWriter(tmp_path / "short") as bag:
        bag.write("/pose", POSE_STAMPED, START, pose(START))
        bag.write("/pose", POSE_STAMPED, START + 1, pose(START)[:40])
    with pytest.raises(BagError, match="message 1 of /pose: .*PoseStamped of 40 bytes"):
        read_poses(tmp_path / "short")


def hand_bag_maker():
    specification = importlib.util.spec_from_file_location("maker", BAGS / "make_hand_bag.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["hand_stir", "hand_push"])
def test_packaged_hands_are_what_their_maker_makes(name, tmp_path):
    hand_bag_maker().write_hand_bag(name, tmp_path / name)
    packaged, made = BAGS / name, tmp_path / name
    library = f"rosbags-{version('rosbags')}".encode()
    if library in (packaged / f"{name}.mcap").read_bytes()[:60]:
        for file in (f"{name}.mcap", "metadata.yaml"):
            assert (made / file).read_bytes() == (packaged / file).read_bytes()
    with open_bag(made) as one, open_bag(packaged) as two:  # whatever library wrote it
        assert list(one.messages()) == list(two.messages())


def test_the_packaged_hand_stays_in_its_tank_and_moves_like_a_hand():
    poses = read_poses(BAGS / "hand_stir", "/hand/pose")
    assert poses.frame_id == "world"
    assert poses.stamps_ns[0] == START
    times = (poses.stamps_ns - START) / 1e9
    assert 19.0 < times[-1] < 21.0 and 1100 < len(times) < 1200
    assert (poses.positions >= [0.05, 0.05, 0.04]).all()
    assert (poses.positions <= [0.15, 0.15, 0.2]).all()
    np.testing.assert_allclose(poses.positions[0], [0.1, 0.1, 0.18], atol=0.002)
    gaps = np.diff(times)
    speeds = np.linalg.norm(np.diff(poses.positions, axis=0), axis=1) / gaps
    assert 0.6 < speeds.max() < 1.0
    assert (gaps > 0.1).sum() == 1 and 0.3 < gaps.max() < 0.35
    assert gaps.min() > 0.01
    np.testing.assert_allclose(np.linalg.norm(poses.quats_xyzw, axis=1), 1.0, atol=1e-5)
    tilt = 2 * np.arccos(np.clip(poses.quats_xyzw[:, 3], -1, 1))
    assert 0.05 < tilt.max() < 0.3
    # While the hand rests above the water it trembles, well below a millimetre.
    rest = poses.positions[times < 0.9]
    smooth = np.polynomial.polynomial.polyfit(times[: len(rest)], rest, 2)
    drift = np.polynomial.polynomial.polyval(times[: len(rest)], smooth).T
    trembling = rest - drift
    assert 2e-5 < trembling.std() < 5e-4
    with open_bag(BAGS / "hand_stir") as bag:
        delays = [m.stamp_ns - cdr_to_pose(m.data).stamp_ns for m in bag.messages()]
    assert 0 < min(delays) and max(delays) < 10_000_000
