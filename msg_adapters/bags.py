# SPDX-License-Identifier: Apache-2.0
"""rosbag2 recordings (sqlite3 and mcap) in and out, without ROS; ``rosbags`` does the file formats.

    with open_bag("recording") as bag:
        for topic, message_type, stamp_ns, data in bag.messages():
            ...

Messages stay ready CDR bytes: they can be published as they are, or read with the other modules.
"""

from __future__ import annotations

import heapq
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import yaml

from msg_adapters.cdr import byte_order
from msg_adapters.clock import CLOCK, cdr_to_clock
from msg_adapters.header import NANOSECONDS
from msg_adapters.pose import POSE_STAMPED, PoseStamped, cdr_to_pose

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader
    from rosbags.typesys.store import Typestore

STORAGES = {"mcap": ".mcap", "sqlite3": ".db3"}

# Messages of one clock overtake each other by milliseconds; a second clock is further away.
MAX_DISORDER_NS = NANOSECONDS // 10
# Stamps that run ahead of the recording by a day come from another clock, not from a pause.
MAX_AHEAD_NS = 86_400 * NANOSECONDS


class BagError(ValueError):
    """A recording cannot be used; says which file, what is wrong and what was expected."""


class Topic(NamedTuple):
    """What a bag holds on one topic."""

    name: str
    type: str
    count: int
    transient_local: bool = False  # whether the recorded publisher kept messages for late joiners


class BagMessage(NamedTuple):
    """One message as recorded; ``stamp_ns`` is when it was received, ``data`` are CDR bytes."""

    topic: str
    type: str
    stamp_ns: int
    data: bytes


class Poses(NamedTuple):
    """A recorded trajectory, see ``read_poses``."""

    stamps_ns: np.ndarray
    positions: np.ndarray
    quats_xyzw: np.ndarray
    frame_id: str


class BagReader:
    """An open recording; a context manager. Made by ``open_bag``.

    Attributes:
        path: Folder or file.
        topics: Name to ``Topic``, sorted by name, empty topics included.
        message_count: Number of messages in the files.
    """

    def __init__(self, path: Path, stack: ExitStack, readers: list[Reader]):
        self.path = path
        self._stack = stack
        self._readers = readers
        self.topics = _topics(path, [c for reader in readers for c in reader.connections])
        self.message_count = sum(topic.count for topic in self.topics.values())

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._stack.close()

    def require(self, name: str, message_type: str | None = None) -> Topic:
        """The topic called ``name``, with or without leading slash.

        Raises:
            BagError: It is not in the bag, has no messages, or is not of ``message_type``.
        """
        topic = self.topics.get(name) or self.topics.get("/" + name)
        if topic is None:
            raise BagError(f"{self.path}: no topic {name}, expected one of {self._listing()}")
        if message_type is not None and topic.type != message_type:
            raise BagError(f"{self.path}: topic {name} has {topic.type}, expected {message_type}")
        if topic.count == 0:
            raise BagError(f"{self.path}: topic {name} has no messages")
        return topic

    def only_topic(self, message_type: str) -> Topic:
        """The one topic of a type that has messages.

        Raises:
            BagError: There is none, or there are several to choose from.
        """
        found = [t for t in self.topics.values() if t.type == message_type and t.count]
        if not found:
            raise BagError(f"{self.path}: no topic of {message_type}, only {self._listing()}")
        if len(found) > 1:
            names = ", ".join(topic.name for topic in found)
            raise BagError(f"{self.path}: several topics of {message_type}, choose from {names}")
        return found[0]

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Messages in the order in which they were received.

        Args:
            topics: Names as in ``self.topics``; None for all.

        Raises:
            BagError: The file is damaged.
        """
        wanted = set(self.topics if topics is None else topics)
        streams = []
        for reader in self._readers:
            connections = [c for c in reader.connections if c.topic in wanted and c.msgcount]
            if connections:
                streams.append(reader.messages(connections))
        try:
            for connection, stamp_ns, data in heapq.merge(*streams, key=lambda entry: entry[1]):
                topic = self.topics[connection.topic]
                yield BagMessage(topic.name, topic.type, stamp_ns, bytes(data))
        except Exception as error:  # a damaged file shows itself in many ways
            raise BagError(f"{self.path}: damaged or truncated ({_reason(error)})") from error

    def _listing(self) -> str:
        return ", ".join(f"{t.name} ({t.type})" for t in self.topics.values()) or "nothing"


def open_bag(path: str | Path, allow_empty: bool = False) -> BagReader:
    """Open a rosbag2 folder with its metadata.yaml, or a single .mcap or .db3 file.

    Args:
        path: Folder or file.
        allow_empty: Accept a bag without messages.

    Raises:
        BagError: Missing, not a bag, truncated, without messages, serialized by something else than
            CDR, or with two message types on one topic.
    """
    path = Path(path)
    if not path.exists():
        raise BagError(f"{path}: does not exist, expected a rosbag2 folder, .mcap or .db3 file")
    if path.is_file() and path.suffix not in STORAGES.values():
        raise BagError(f"{path}: not a bag, expected a rosbag2 folder, .mcap or .db3 file")
    announced, files = _read_metadata(path) if path.is_dir() else (None, [path])
    with ExitStack() as stack:
        readers = [_open_file(path, file, stack) for file in files]
        bag = BagReader(path, stack, readers)
        if announced is not None and bag.message_count != announced:
            raise BagError(
                f"{path}: the files hold {bag.message_count} messages, expected {announced} "
                "as metadata.yaml says (truncated?)"
            )
        if bag.message_count == 0 and not allow_empty:
            raise BagError(f"{path}: has no messages, expected at least one")
        bag._stack = stack.pop_all()
        return bag


def read_poses(path: str | Path, topic: str | None = None) -> Poses:
    """A trajectory of geometry_msgs/PoseStamped, by header stamp; values as they were recorded.

    When no header has a stamp (all zero) the times of receipt are taken.

    Args:
        path: Folder or file.
        topic: Its name; None for the only topic of this type.

    Returns:
        ``stamps_ns`` (N,) int64 that never decrease, ``positions`` (N, 3) float64 [m],
        ``quats_xyzw`` (N, 4) float64, ``frame_id``.

    Raises:
        BagError: As in ``open_bag``; no such topic; more than one frame; stamps of two clocks.
    """
    with open_bag(path) as bag:
        chosen = bag.require(topic, POSE_STAMPED) if topic else bag.only_topic(POSE_STAMPED)
        check_clocks(bag, [name for name, other in bag.topics.items() if other.type == CLOCK])
        received, poses = _collect_poses(bag, chosen.name)
    frames = sorted({pose.frame_id for pose in poses})
    if len(frames) > 1:
        raise BagError(f"{path}: {chosen.name} has frames {', '.join(frames)}, expected one")
    stamps = np.array([pose.stamp_ns for pose in poses], np.int64)
    if not stamps.any():
        stamps = received
    _check_one_clock(path, chosen.name, received, stamps)
    order = np.argsort(stamps, kind="stable")
    return Poses(
        stamps[order],
        np.array([pose.position for pose in poses])[order],
        np.array([pose.quat_xyzw for pose in poses])[order],
        frames[0],
    )


def check_clocks(bag: BagReader, topics: Collection[str]) -> None:
    """BagError when the stamps inside the poses or clocks of one topic come from two clocks."""
    for name in topics:
        if bag.topics[name].type == POSE_STAMPED:
            received, poses = _collect_poses(bag, name)
            stamps = np.array([pose.stamp_ns for pose in poses], np.int64)
        elif bag.topics[name].type == CLOCK:
            messages = list(bag.messages([name]))
            received = np.array([message.stamp_ns for message in messages], np.int64)
            stamps = np.array([cdr_to_clock(message.data) for message in messages], np.int64)
        else:
            continue
        _check_one_clock(bag.path, name, received, stamps)


class BagWriter:
    """Writes a rosbag2 folder; a context manager.

    Everything goes to a hidden folder beside ``path`` that is renamed when the block ends well, and
    deleted when it ends with an exception: a half-written bag never shows. The same messages give
    the same bytes of the .mcap file (with one version of ``rosbags``, which names itself in it).

    Args:
        path: Folder to make; its parents are made too.
        storage: ``mcap`` or ``sqlite3``.
        overwrite: Replace a bag that is there already.

    Raises:
        BagError: The folder exists, or cannot be made.
    """

    def __init__(self, path: str | Path, storage: str = "mcap", overwrite: bool = False):
        if storage not in STORAGES:
            raise BagError(f"storage is {storage!r}, expected one of {', '.join(STORAGES)}")
        self.path = Path(path)
        self._storage = storage
        self._overwrite = overwrite
        self._check_target()
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> BagWriter:
        from rosbags.rosbag2 import StoragePlugin, Writer

        target = self.path.absolute()
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
        except OSError as error:
            raise BagError(f"{self.path}: cannot be written ({error.strerror})") from error
        plugin = StoragePlugin.MCAP if self._storage == "mcap" else StoragePlugin.SQLITE3
        # The library names the file after the folder, so the temporary one bears the final name.
        self._writer = Writer(self._folder / target.name, version=9, storage_plugin=plugin)
        self._writer.open()
        return self

    def __exit__(self, exception_type: type | None, *exception: object) -> None:
        try:
            if exception_type is not None:
                self._writer.abort()
                return
            self._writer.close()
            self._check_target()
            if self.path.exists():
                os.replace(self.path, self._folder / "replaced")
            os.replace(self._folder / self.path.absolute().name, self.path)
        except OSError as error:
            raise BagError(f"{self.path}: cannot be written ({error.strerror})") from error
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def write(self, topic: str, message_type: str, stamp_ns: int, data: bytes) -> None:
        """Append a message.

        Args:
            topic: Name with leading slash; always with the same type.
            message_type: Such as ``geometry_msgs/msg/PoseStamped``.
            stamp_ns: When it was received, or sent [ns]; not negative.
            data: CDR bytes.

        Raises:
            BagError: An unknown type, or another one than before on this topic.
            ValueError: Bytes that are not CDR, or a negative time.
        """
        byte_order(data, message_type)
        if stamp_ns < 0:
            raise ValueError(f"stamp_ns is {stamp_ns}, expected 0 or more")
        connection = self._connections.get(topic) or self._connect(topic, message_type)
        if connection.msgtype != message_type:
            raise BagError(
                f"{self.path}: {message_type} on topic {topic}, expected {connection.msgtype}"
            )
        self._writer.write(connection, int(stamp_ns), data)

    def _connect(self, topic: str, message_type: str) -> Connection:
        if not topic.startswith("/"):
            raise BagError(f"{self.path}: topic {topic!r}, expected a name with leading slash")
        typestore = _typestore()
        if message_type not in typestore.fielddefs:
            raise BagError(f"{self.path}: unknown message type {message_type}")
        connection = self._writer.add_connection(
            topic, message_type, typestore=typestore, offered_qos_profiles=_reliable_qos()
        )
        self._connections[topic] = connection
        return connection

    def _check_target(self) -> None:
        if not self.path.exists():
            return
        if not self._overwrite:
            raise BagError(f"{self.path}: exists already, expected a new name")
        if not (self.path / "metadata.yaml").is_file():
            raise BagError(f"{self.path}: exists and is not a bag, so it is not replaced")


def _read_metadata(folder: Path) -> tuple[int, list[Path]]:
    """Number of messages that metadata.yaml announces, and the paths to open.

    The storage files are opened one by one: through the folder the library drops every topic whose
    quality of service is written differently in metadata.yaml and in the file, as in old bags.
    Compressed bags can only be opened through the folder.
    """
    file = folder / "metadata.yaml"
    if not file.is_file():
        raise BagError(f"{folder}: not a bag, expected a metadata.yaml in the folder")
    try:
        information = yaml.safe_load(file.read_text())["rosbag2_bagfile_information"]
        count = int(information["message_count"])
        names = [Path(name).name for name in information["relative_file_paths"]]
        compression = str(information.get("compression_mode") or "none").lower()
        topics = [entry["topic_metadata"] for entry in information["topics_with_message_count"]]
        formats = {topic["name"]: topic["serialization_format"] for topic in topics}
    except (yaml.YAMLError, KeyError, TypeError, ValueError, OSError, AttributeError) as error:
        raise BagError(f"{file}: not the metadata of a bag ({_reason(error)})") from error
    for topic, serialization in formats.items():
        _check_serialization(folder, topic, serialization)
    missing = [name for name in names if not (folder / name).is_file()]
    if missing or not names:
        raise BagError(f"{folder}: expected the file {', '.join(missing) or 'of a storage'} in it")
    return count, [folder] if compression != "none" else [folder / name for name in names]


def _open_file(bag: Path, file: Path, stack: ExitStack) -> Reader:
    """An open reader, closed with ``stack``."""
    from rosbags.rosbag2 import Reader

    try:
        reader = Reader(file)
        reader.open()
    except Exception as error:  # whatever a damaged file makes of the library
        name = "the folder" if file.is_dir() else file.name
        raise BagError(
            f"{bag}: {name} is damaged or truncated, expected a complete bag ({_reason(error)})"
        ) from error
    stack.callback(reader.close)
    return reader


def _topics(path: Path, connections: list[Connection]) -> dict[str, Topic]:
    """Sum up the connections of all files by topic; BagError for two types or not CDR."""
    topics: dict[str, Topic] = {}
    for connection in sorted(connections, key=lambda connection: connection.topic):
        _check_serialization(path, connection.topic, connection.ext.serialization_format)
        message_type = _full_type(connection.msgtype)
        before = topics.get(connection.topic, Topic(connection.topic, message_type, 0))
        if before.type != message_type:
            raise BagError(
                f"{path}: topic {connection.topic} has {before.type} and {message_type}, "
                "expected one message type"
            )
        durabilities = [qos.durability.name for qos in connection.ext.offered_qos_profiles]
        topics[connection.topic] = before._replace(
            count=before.count + connection.msgcount,
            transient_local=before.transient_local or "TRANSIENT_LOCAL" in durabilities,
        )
    return topics


def _check_serialization(path: Path, topic: str, serialization: str) -> None:
    if serialization != "cdr":
        raise BagError(f"{path}: topic {topic} is serialized as {serialization!r}, expected 'cdr'")


def _full_type(name: str) -> str:
    """``pkg/msg/Type``; bags of 2019 left the middle out."""
    package, *middle, last = name.split("/")
    return "/".join([package, *(middle or ["msg"]), last])


def _collect_poses(bag: BagReader, topic: str) -> tuple[np.ndarray, list[PoseStamped]]:
    """Times of receipt (N,) int64 [ns] and poses of one topic."""
    received, poses = [], []
    for message in bag.messages([topic]):
        try:
            poses.append(cdr_to_pose(message.data))
        except ValueError as error:
            raise BagError(f"{bag.path}: message {len(poses)} of {topic}: {error}") from error
        received.append(message.stamp_ns)
    return np.array(received, np.int64), poses


def _check_one_clock(
    path: str | Path, topic: str, received: np.ndarray, stamps: np.ndarray
) -> None:
    """BagError where stamps jump back, or ahead by years while the recording did not.

    The clock of the stamps may differ from the recorder's by any amount, if only it is one.
    """
    if len(stamps) < 2:
        return
    latest = np.maximum.accumulate(stamps)[:-1]
    back = latest - stamps[1:] > MAX_DISORDER_NS
    ahead = np.diff(stamps) - np.diff(received) > MAX_AHEAD_NS
    if (back | ahead).any():
        index = int(np.argmax(back | ahead)) + 1
        before, after = stamps[index - 1] / NANOSECONDS, stamps[index] / NANOSECONDS
        raise BagError(
            f"{path}: message {index} of {topic} is stamped {after:.3f} s after one of "
            f"{before:.3f} s, expected stamps of one clock that runs forward"
        )


@lru_cache(maxsize=1)
def _typestore() -> Typestore:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def _reliable_qos() -> list:
    """What an ordinary reliable publisher offers, so that players need not guess."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    forever = QosTime(9223372036, 854775807)
    return [
        Qos(
            QosHistory.KEEP_LAST,
            10,
            QosReliability.RELIABLE,
            QosDurability.VOLATILE,
            forever,
            forever,
            QosLiveliness.AUTOMATIC,
            forever,
            False,
        )
    ]


def _reason(error: Exception) -> str:
    """One line about an error of a library."""
    text = " ".join(str(error).split())
    return text or type(error).__name__
