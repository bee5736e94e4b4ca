# SPDX-License-Identifier: Apache-2.0
"""std_msgs/Header and times. A time is one integer, nanoseconds, so that no rounding creeps in."""

from __future__ import annotations

import math
from typing import NamedTuple

from msg_adapters.cdr import CdrReader, CdrWriter

NANOSECONDS = 1_000_000_000


class Header(NamedTuple):
    """When and in which frame."""

    stamp_ns: int
    frame_id: str


def stamp_from_seconds(seconds: float) -> int:
    """Seconds [s] to the nearest nanosecond [ns]; ValueError when not finite."""
    if not math.isfinite(seconds):
        raise ValueError(f"time is {seconds} s, expected a finite number")
    whole = math.floor(seconds)
    return whole * NANOSECONDS + round((seconds - whole) * NANOSECONDS)


def stamp_to_seconds(stamp_ns: int) -> float:
    """Nanoseconds [ns] to seconds [s]; near 1.7e9 s a float is no finer than 0.24 microseconds."""
    return stamp_ns / NANOSECONDS


def split_stamp(stamp_ns: int, name: str = "stamp_ns") -> tuple[int, int]:
    """Nanoseconds to builtin_interfaces/Time's (sec, nanosec); ValueError outside its 32 bits."""
    seconds, nanoseconds = divmod(int(stamp_ns), NANOSECONDS)
    if not -(2**31) <= seconds < 2**31:
        raise ValueError(f"{name} is {stamp_ns} ns, expected seconds that fit 32 bits with sign")
    return seconds, nanoseconds


def join_stamp(seconds: int, nanoseconds: int) -> int:
    """(sec, nanosec) to nanoseconds."""
    return seconds * NANOSECONDS + nanoseconds


def write_stamp(writer: CdrWriter, stamp_ns: int) -> None:
    """Write a builtin_interfaces Time or Duration."""
    seconds, nanoseconds = split_stamp(stamp_ns)
    writer.pack("iI", seconds, nanoseconds)


def read_stamp(reader: CdrReader) -> int:
    """Read a builtin_interfaces Time or Duration [ns]."""
    return join_stamp(*reader.unpack("iI"))


def write_header(writer: CdrWriter, stamp_ns: int, frame_id: str) -> None:
    """Write a std_msgs/Header."""
    write_stamp(writer, stamp_ns)
    writer.string(frame_id)


def read_header(reader: CdrReader) -> Header:
    """Read a std_msgs/Header."""
    return Header(read_stamp(reader), reader.string())
