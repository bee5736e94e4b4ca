# SPDX-License-Identifier: Apache-2.0
"""``bag_player``: a recorded bag onto topics, as fast as it was recorded, with or without a clock.

Messages go out as the bytes that were recorded; nothing is decoded. Publishers are reliable, which
serves every subscriber.
"""

from __future__ import annotations

import argparse
import importlib
import re
import struct
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from msg_adapters.bags import BagMessage, BagReader, Topic, check_clocks, open_bag
from msg_adapters.cdr import byte_order
from msg_adapters.clock import CLOCK, clock_to_cdr
from msg_adapters.header import NANOSECONDS, split_stamp
from sph_ros.options import not_negative, positive, remapping

# Enough for a subscriber that is briefly busy; a depth of one loses messages of some megabytes.
PUBLISHER_DEPTH = 100
CLOCK_TOPIC = "/clock"
DEFAULT_CLOCK_RATE = 100.0  # [Hz]
#: Between two laps of a loop, at least; a bag may hold one message only.
LEAST_LAP_GAP = 0.01  # [s]


class BagPlayer(Node):
    """Publishes a bag's messages in the rhythm of their recording.

    Args:
        bag: Open recording.
        options: See ``parse_arguments``.
        kwargs: For ``rclpy.node.Node``.

    Raises:
        ValueError: A topic is not in the bag, cannot be named so, or none has a type known here.
    """

    def __init__(self, bag: BagReader, options: argparse.Namespace, **kwargs):
        super().__init__("bag_player", **kwargs)
        self._bag = bag
        self._options = options
        self._topics = self._choose_topics()
        # By the name in the bag, not the name it is published under.
        self._message_publishers = self._create_publishers()
        self._starts_with_header = {
            name: _starts_with_header(publisher.msg_type)
            for name, publisher in self._message_publishers.items()
        }
        if options.stamp == "recorded":
            check_clocks(bag, list(self._message_publishers))
        self._clock_publisher = None
        if options.clock is not None:
            message_class = _message_class(CLOCK)
            self._clock_publisher = self.create_publisher(message_class, CLOCK_TOPIC, 10)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self)

    def play(self) -> None:
        """Wait for a subscriber, play once or for ever, and see the last messages off."""
        self._wait_for_subscriber()
        self._spin_until(time.monotonic() + self._options.delay)
        count = sum(self._topics[name].count for name in self._message_publishers)
        self.get_logger().info(
            f"playing {count} messages of {', '.join(self._message_publishers)} "
            f"at rate {self._options.rate:g}{', for ever' if self._options.loop else ''}"
        )
        length, played = self._play_once()
        while self._options.loop:
            # The next lap begins one message later, not at the very moment of the last one.
            self._spin_until(time.monotonic() + max(LEAST_LAP_GAP, length / max(played - 1, 1)))
            length, played = self._play_once()
        self._wait_for_delivery()
        self.get_logger().info("played to the end")

    def _play_once(self) -> tuple[float, int]:
        """Play all messages; returns how long that took [s] and how many there were."""
        messages: Iterable[BagMessage] = self._bag.messages(list(self._message_publishers))
        if self._clock_publisher is not None:
            period = self._options.rate / self._options.clock * NANOSECONDS
            messages = with_clock(messages, max(1, round(period)))
        began, first_ns, count = time.monotonic(), None, 0
        for message in messages:
            first_ns = message.stamp_ns if first_ns is None else first_ns
            elapsed = (message.stamp_ns - first_ns) / NANOSECONDS / self._options.rate
            self._spin_until(began + elapsed)
            self._publish(message)
            count += 1
        return time.monotonic() - began, count

    def _publish(self, message: BagMessage) -> None:
        if message.topic == CLOCK_TOPIC and self._clock_publisher is not None:
            self._clock_publisher.publish(message.data)
            return
        data = message.data
        # A publisher takes any bytes, and what is not CDR vanishes at the subscriber.
        byte_order(data, f"{self._bag.path}: {message.topic} ({message.type})")
        if self._options.stamp != "recorded" and self._starts_with_header[message.topic]:
            now = self._options.stamp == "now"
            data = restamp(data, time.time_ns() if now else message.stamp_ns)
        self._message_publishers[message.topic].publish(data)

    def _spin_until(self, deadline: float) -> None:
        """Serve parameters and discovery until a time of ``time.monotonic``."""
        while True:
            if not self.context.ok():
                raise ExternalShutdownException
            remaining = deadline - time.monotonic()
            self._executor.spin_once(timeout_sec=min(max(remaining, 0.0), 0.2))
            if remaining <= 0.0:
                return

    def _wait_for_subscriber(self) -> None:
        deadline = time.monotonic() + self._options.wait
        publishers = self._message_publishers.values()
        while not any(publisher.get_subscription_count() for publisher in publishers):
            if time.monotonic() >= deadline:
                if self._options.wait > 0.0:
                    self.get_logger().warning(
                        f"no subscriber within {self._options.wait:g} s, playing all the same"
                    )
                return
            self._spin_until(min(deadline, time.monotonic() + 0.02))

    def _wait_for_delivery(self) -> None:
        """A process that ends at once takes unsent messages with it."""
        deadline = time.monotonic() + 1.0
        for publisher in self._message_publishers.values():
            remaining = max(0.0, deadline - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=remaining))

    def _choose_topics(self) -> dict[str, Topic]:
        if self._options.topics:
            chosen = [self._bag.require(name) for name in self._options.topics]
        else:
            chosen = [topic for topic in self._bag.topics.values() if topic.count]
        if self._options.clock is not None:
            kept = [topic for topic in chosen if topic.name != CLOCK_TOPIC]
            if len(kept) < len(chosen):
                self.get_logger().warning("--clock replaces the recorded /clock")
            chosen = kept
        return {topic.name: topic for topic in chosen}

    def _create_publishers(self) -> dict:
        remap = {self._bag.require(old).name: new for old, new in self._options.remap}
        publishers, types = {}, {}
        for topic in self._topics.values():
            message_class = _message_class(topic.type)
            if message_class is None:
                self.get_logger().warning(f"skipping {topic.name}: unknown type {topic.type}")
                continue
            wanted = remap.get(topic.name, topic.name)
            # Recordings of 2019 have names without the leading slash.
            wanted = wanted if wanted[0] in "/~" else f"/{wanted}"
            name = self._resolve(wanted)
            other = types.setdefault(name, topic.type)
            if other != topic.type:
                raise ValueError(
                    f"{topic.name} and another topic both go to {name}, "
                    f"but have {topic.type} and {other}"
                )
            publishers[topic.name] = self.create_publisher(message_class, wanted, _qos(topic))
        if not publishers:
            raise ValueError(f"{self._bag.path}: nothing that can be played")
        return publishers

    def _resolve(self, name: str) -> str:
        """The full name after ROS remappings; ValueError when it cannot be a topic's."""
        try:
            return self.resolve_topic_name(name)
        except RuntimeError as error:
            raise ValueError(f"{name!r} is not a valid topic name") from error


def with_clock(messages: Iterable[BagMessage], period_ns: int) -> Iterator[BagMessage]:
    """Messages with a /clock message every ``period_ns`` of recorded time, the first before all."""
    tick_ns = None
    for message in messages:
        tick_ns = message.stamp_ns if tick_ns is None else tick_ns
        while tick_ns <= message.stamp_ns:
            yield BagMessage(CLOCK_TOPIC, CLOCK, tick_ns, clock_to_cdr(tick_ns))
            tick_ns += period_ns
        yield message


def restamp(data: bytes, stamp_ns: int) -> bytes:
    """The same message with another time; for types that begin with a std_msgs/Header."""
    order = byte_order(data, "message")
    return data[:4] + struct.pack(f"{order}iI", *split_stamp(stamp_ns)) + data[12:]


def split_arguments(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Our own arguments, and those between ``--ros-args`` and ``--``.

    Not by rclpy, which takes every A:=B for its own, wherever it stands.
    """
    own, ros, inside = [], [], False
    for argument in arguments:
        inside = (inside or argument == "--ros-args") and argument != "--"
        (ros if inside else own).append(argument)
    return [argument for argument in own if argument != "--"], ros


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Options of the command line; exits with a usage message when they are wrong."""
    parser = argparse.ArgumentParser(
        prog="bag_player",
        description="Play a rosbag2 recording (sqlite3 or mcap) onto ROS 2 topics.",
        epilog="ROS arguments may follow after --ros-args.",
    )
    parser.add_argument(
        "bag", help="folder with metadata.yaml, .mcap or .db3 file, or a packaged bag"
    )
    parser.add_argument(
        "--rate", type=positive, default=1.0, metavar="R", help="times recorded speed (1)"
    )
    parser.add_argument(
        "--loop", action="store_true", help="start over at the end; recorded stamps jump back"
    )
    parser.add_argument(
        "--remap", type=remapping, nargs="+", action="extend", default=[], metavar="A:=B",
        help="publish topic A of the bag as B",
    )  # fmt: skip
    parser.add_argument(
        "--topics", nargs="+", metavar="TOPIC", help="play only these topics of the bag"
    )
    parser.add_argument(
        "--clock", type=positive, nargs="?", const=DEFAULT_CLOCK_RATE, metavar="HZ",
        help="publish the recorded time on /clock, so often a second (100)",
    )  # fmt: skip
    parser.add_argument(
        "--delay", type=not_negative, default=0.0, metavar="S", help="wait so long first [s] (0)"
    )
    parser.add_argument(
        "--wait", type=not_negative, default=5.0, metavar="S",
        help="wait at most so long for a first subscriber [s] (5)",
    )  # fmt: skip
    parser.add_argument(
        "--stamp", choices=("recorded", "received", "now"), default="recorded",
        help="time in message headers: as recorded, when the recorder received the message, or "
        "the present time, for listeners that compare it with the time of day (recorded)",
    )  # fmt: skip
    return parser.parse_args(arguments)


def main(argv: list[str] | None = None) -> int:
    """Play a bag; returns the exit status."""
    own_arguments, ros_arguments = split_arguments(sys.argv[1:] if argv is None else argv)
    options = parse_arguments(own_arguments)
    try:
        with open_bag(_find(options.bag)) as bag:
            _play(bag, options, ros_arguments)
    except ValueError as error:  # BagError is one
        print(f"bag_player: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        pass  # asked to end: Ctrl-C or SIGTERM
    return 0


def _play(bag: BagReader, options: argparse.Namespace, ros_arguments: list[str]) -> None:
    try:
        rclpy.init(args=ros_arguments)
    except RuntimeError as error:  # what stands after --ros-args
        raise ValueError(error) from error
    try:
        BagPlayer(bag, options).play()
    except Exception:
        # SIGTERM takes the context away in the middle of whatever is going on.
        if rclpy.ok():
            raise
    finally:
        rclpy.try_shutdown()


def _qos(topic: Topic) -> QoSProfile:
    local, volatile = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE
    return QoSProfile(
        depth=PUBLISHER_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=local if topic.transient_local else volatile,
    )


def _find(bag: str) -> Path:
    """A path, or the path of a packaged bag; ValueError when it is neither."""
    if Path(bag).exists():
        return Path(bag)
    # Loads the compiled half of the package, a second that other players need not wait.
    from sph_ros.sim.scene import bag_path

    return bag_path(bag)


def _message_class(name: str) -> type | None:
    """Class of ``pkg/msg/Type``; None when it is not installed, or no message (a service event)."""
    match = re.fullmatch(r"([a-z][a-z0-9_]*)/msg/([A-Z]\w*)", name)
    if match is None:
        return None
    with suppress(ImportError):
        return getattr(importlib.import_module(f"{match[1]}.msg"), match[2], None)
    return None


def _starts_with_header(message_class: type) -> bool:
    fields = message_class.get_fields_and_field_types()
    return next(iter(fields.values()), None) == "std_msgs/Header"


if __name__ == "__main__":
    sys.exit(main())
