# SPDX-License-Identifier: Apache-2.0
"""rosgraph_msgs/Clock, in and out."""

from __future__ import annotations

from msg_adapters.cdr import CdrReader, CdrWriter
from msg_adapters.header import read_stamp, write_stamp

CLOCK = "rosgraph_msgs/msg/Clock"


def clock_to_cdr(stamp_ns: int) -> bytes:
    """A time [ns] as a ready rosgraph_msgs/Clock; ValueError when it does not fit."""
    writer = CdrWriter()
    write_stamp(writer, stamp_ns)
    return writer.finish()


def cdr_to_clock(buffer: bytes) -> int:
    """The time [ns] of a rosgraph_msgs/Clock; ValueError when the bytes are not one."""
    reader = CdrReader(buffer, CLOCK)
    stamp_ns = read_stamp(reader)
    reader.end()
    return stamp_ns
