# SPDX-License-Identifier: Apache-2.0
"""Plain CDR, the byte form of ROS 2 messages: aligned primitives, strings and whole arrays.

A buffer is a four-byte encapsulation header (00 01 00 00: XCDR1, little-endian) and the fields in
the order of the message definition. A primitive of n bytes stands at a multiple of n bytes *after
that header*; a string is a uint32 length that counts the closing zero, then the characters; a
sequence is a uint32 count, then its elements, with no padding when there are none (OMG Common
Object Request Broker Architecture 3.3, part 2, section 9.3; DDS-XTypes 1.3, section 7.4.1).

Arrays are copied once when written and not at all when read.
"""

from __future__ import annotations

import struct
from functools import lru_cache

import numpy as np

ENCAPSULATION_SIZE = 4
LITTLE_ENDIAN = b"\x00\x01\x00\x00"

# Middleware rounds a payload up to four bytes; more than that left over is another message type.
_MAX_TRAILING = 3


class CdrWriter:
    """Collects the fields of one message in order; ``finish`` joins them with one copy."""

    def __init__(self):
        self._parts: list[bytes | np.ndarray] = [LITTLE_ENDIAN]
        self._length = 0

    def align(self, size: int) -> None:
        """Pad with zeros to a multiple of ``size`` bytes."""
        padding = -self._length % size
        if padding:
            self._parts.append(bytes(padding))
            self._length += padding

    def pack(self, codes: str, *values: int | float) -> None:
        """Write primitives of one size, such as ``pack("3d", x, y, z)``.

        Args:
            codes: struct codes, all of the size of the last one; no byte order.
            values: What to write.

        Raises:
            ValueError: A value does not fit its code.
        """
        packer = _struct("<" + codes)
        self.align(struct.calcsize(codes[-1]))
        try:
            self._parts.append(packer.pack(*values))
        except struct.error as error:
            raise ValueError(f"cannot write {values} as '{codes}': {error}") from None
        self._length += packer.size

    def string(self, text: str) -> None:
        """Write a string; ValueError when it holds a zero character."""
        encoded = text.encode()
        if b"\x00" in encoded:
            raise ValueError(f"string {text!r} holds a zero character, expected none")
        self.pack("I", len(encoded) + 1)
        self._parts.append(encoded + b"\x00")
        self._length += len(encoded) + 1

    def array(self, values: np.ndarray, count: int | None = None) -> None:
        """Write an array's elements, after ``count`` when it is a sequence; nothing is converted.

        Args:
            values: Little-endian array of the message's own element type, any shape, C order. Its
                item size is the alignment.
            count: Length to announce for a sequence; None for the elements alone.
        """
        if count is not None:
            self.pack("I", count)
        if values.size == 0:
            return
        self.align(values.dtype.itemsize)
        values = np.ascontiguousarray(values)
        self._parts.append(values)
        self._length += values.nbytes

    def blob(self, data: bytes | np.ndarray) -> None:
        """Write a uint8 sequence."""
        size = memoryview(data).nbytes
        self.array(np.frombuffer(data, np.uint8) if size else np.empty(0, np.uint8), count=size)

    def finish(self) -> bytes:
        """The whole message, encapsulation header included."""
        return b"".join(self._parts)


class CdrReader:
    """Reads the fields of one message in order from a buffer, without copying arrays.

    Args:
        buffer: A message with its encapsulation header; little- or big-endian plain CDR.
        message_type: Name used in errors, such as ``geometry_msgs/msg/PoseStamped``.

    Raises:
        ValueError: Shorter than a header, or an encapsulation other than plain CDR.
    """

    def __init__(self, buffer: bytes | bytearray | memoryview, message_type: str):
        self._view = memoryview(buffer).cast("B")
        self.message_type = message_type
        self._order = byte_order(self._view, message_type)
        self._position = ENCAPSULATION_SIZE

    def fail(self, problem: str) -> ValueError:
        """A ValueError that names the message, to be raised by the caller."""
        return ValueError(f"{self.message_type} of {len(self._view)} bytes: {problem}")

    def align(self, size: int) -> None:
        """Skip padding up to a multiple of ``size`` bytes."""
        self._position += -(self._position - ENCAPSULATION_SIZE) % size

    def _take(self, size: int, what: str) -> int:
        """Offset of the next ``size`` bytes, which must be there; moves past them."""
        start = self._position
        if start + size > len(self._view):
            raise self.fail(f"truncated, expected {size} bytes of {what} at offset {start}")
        self._position = start + size
        return start

    def unpack(self, codes: str) -> tuple:
        """Read primitives of one size; codes as in ``CdrWriter.pack``."""
        self.align(struct.calcsize(codes[-1]))
        packer = _struct(self._order + codes)
        return packer.unpack_from(self._view, self._take(packer.size, f"'{codes}'"))

    def string(self) -> str:
        """Read a string."""
        (length,) = self.unpack("I")
        start = self._take(length, "a string")
        raw = bytes(self._view[start : start + length])
        if length and raw[-1] != 0:
            raise self.fail(f"string at offset {start} does not end with a zero byte")
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError as error:
            raise self.fail(f"string at offset {start} is not UTF-8 ({error.reason})") from None

    def count(self) -> int:
        """Read the length of a sequence."""
        return self.unpack("I")[0]

    def array(self, dtype: np.dtype | type, count: int, columns: int = 1) -> np.ndarray:
        """Read the elements of a sequence, in native byte order.

        Args:
            dtype: Native element type.
            count: Number of sequence elements.
            columns: Primitives per sequence element.

        Returns:
            (count,) array, or (count, columns); read-only, and a view of the buffer when its byte
            order is the machine's own.
        """
        shape = (count,) if columns == 1 else (count, columns)
        stored = np.dtype(dtype).newbyteorder(self._order)
        if count == 0:
            return np.empty(shape, dtype)
        self.align(stored.itemsize)
        start = self._take(count * columns * stored.itemsize, f"{count} elements")
        values = np.frombuffer(self._view, stored, count * columns, start).reshape(shape)
        values = values.astype(dtype, copy=False)
        values.flags.writeable = False
        return values

    def blob(self) -> memoryview:
        """Read a uint8 sequence, as a view of the buffer."""
        size = self.count()
        start = self._take(size, "data")
        return self._view[start : start + size]

    def end(self) -> None:
        """Check that nothing but padding is left; ValueError otherwise (another message type)."""
        left = len(self._view) - self._position
        if left > _MAX_TRAILING:
            raise self.fail(f"{left} bytes left over after the last field, expected none")


def byte_order(buffer: bytes | memoryview, message_type: str) -> str:
    """``<`` or ``>`` from the encapsulation header; ValueError when it is not plain CDR."""
    if len(buffer) < ENCAPSULATION_SIZE:
        raise ValueError(
            f"{message_type} of {len(buffer)} bytes: truncated, expected a CDR header of 4 bytes"
        )
    # Bytes 2 and 3 are options (the amount of padding at the end), which plain CDR readers ignore.
    if buffer[0] == 0 and buffer[1] in (0, 1):
        return "<" if buffer[1] else ">"
    raise ValueError(
        f"{message_type}: encapsulation {bytes(buffer[:2]).hex()}, expected plain CDR, 0001 or 0000"
    )


@lru_cache(maxsize=256)
def _struct(codes: str) -> struct.Struct:
    return struct.Struct(codes)
