# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/PointCloud2, in and out: any structured array, and the particles of a fluid."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from msg_adapters.cdr import CdrReader, CdrWriter
from msg_adapters.checks import column, rows
from msg_adapters.header import Header, join_stamp, read_header, write_header

if TYPE_CHECKING:
    from sensor_msgs.msg import PointCloud2 as PointCloud2Message

POINT_CLOUD2 = "sensor_msgs/msg/PointCloud2"

# sensor_msgs/PointField numbers them INT8 1, UINT8 2, INT16 3, ... FLOAT32 7, FLOAT64 8.
_DATATYPES = {
    number: np.dtype(code)
    for number, code in enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), start=1)
}
_NUMBERS = {dtype: number for number, dtype in _DATATYPES.items()}

# One particle, 32 bytes: [m], [m/s], [kg/m^3], and the number it keeps for ever.
_PARTICLE_FLOATS = ("x", "y", "z", "vx", "vy", "vz", "density")
PARTICLE = np.dtype([(name, "<f4") for name in _PARTICLE_FLOATS] + [("id", "<u4")])


class ParticleCloud(NamedTuple):
    """The particles of a fluid at a time."""

    header: Header
    positions: np.ndarray  # (N, 3) float32 [m]
    velocities: np.ndarray  # (N, 3) float32 [m/s]
    densities: np.ndarray  # (N,) float32 [kg/m^3]
    ids: np.ndarray  # (N,) uint32


def particle_cloud_to_cdr(
    positions: np.ndarray,
    velocities: np.ndarray,
    densities: np.ndarray,
    ids: np.ndarray,
    stamp_ns: int,
    frame_id: str,
) -> bytes:
    """Particles as a ready sensor_msgs/PointCloud2 with fields x y z vx vy vz density id.

    Args:
        positions: (N, 3) float32 [m], finite.
        velocities: (N, 3) float32 [m/s].
        densities: (N,) float32 [kg/m^3].
        ids: (N,) uint32; row i of every array is the same particle.
        stamp_ns: Time [ns].
        frame_id: Frame of positions and velocities.

    Raises:
        ValueError: Wrong shape, length or dtype.
    """
    count = len(rows(positions, "positions", 3, np.float32))
    if len(rows(velocities, "velocities", 3, np.float32)) != count:
        raise ValueError(f"velocities has {len(velocities)} rows, expected {count}")
    # Eight equal columns are filled faster than eight named fields.
    table = np.empty((count, 8), "<f4")
    table[:, 0:3] = positions
    table[:, 3:6] = velocities
    table[:, 6] = column(densities, "densities", count, np.float32)
    table.view("<u4")[:, 7] = column(ids, "ids", count, np.uint32)
    return point_cloud_to_cdr(table.reshape(-1).view(PARTICLE), stamp_ns, frame_id)


def cdr_to_particle_cloud(buffer: bytes) -> ParticleCloud:
    """Particles from a PointCloud2 that has at least the fields of ``particle_cloud_to_cdr``.

    Raises:
        ValueError: The bytes are not a cloud, or a field is missing.
    """
    header, points = cdr_to_point_cloud(buffer)
    points = points.reshape(-1)
    missing = [name for name in PARTICLE.names if name not in points.dtype.names]
    if missing:
        raise ValueError(
            f"{POINT_CLOUD2} has fields {' '.join(points.dtype.names)}, "
            f"expected also {' '.join(missing)}"
        )
    return ParticleCloud(
        header,
        np.stack([points[name] for name in "xyz"], axis=1).astype(np.float32, copy=False),
        np.stack([points[name] for name in ("vx", "vy", "vz")], axis=1).astype(np.float32),
        points["density"].astype(np.float32),
        points["id"].astype(np.uint32),
    )


def point_cloud_to_cdr(
    points: np.ndarray, stamp_ns: int, frame_id: str, is_dense: bool = True
) -> bytes:
    """A structured array as a ready sensor_msgs/PointCloud2; padding and offsets are kept.

    Args:
        points: (N,) cloud or (H, W) organised cloud; little-endian fields of a PointField type,
            sub-arrays of one dimension included.
        stamp_ns: Time [ns].
        frame_id: Frame of the points.
        is_dense: Whether all points are finite; not looked at.

    Raises:
        ValueError: Not such an array.
    """
    fields = _describe(points)
    height, width = (1, *points.shape) if points.ndim == 1 else points.shape
    writer = CdrWriter()
    write_header(writer, stamp_ns, frame_id)
    writer.pack("3I", height, width, len(fields))
    for name, offset, number, count in fields:
        writer.string(name)
        writer.pack("I", offset)
        writer.pack("B", number)
        writer.pack("I", count)
    point_step = points.dtype.itemsize
    writer.pack("?", False)  # is_bigendian
    writer.pack("2I", point_step, point_step * width)
    writer.blob(np.ascontiguousarray(points).reshape(-1).view(np.uint8))
    writer.pack("?", is_dense)
    return writer.finish()


def cdr_to_point_cloud(buffer: bytes) -> tuple[Header, np.ndarray]:
    """Any sensor_msgs/PointCloud2 from its bytes.

    Args:
        buffer: The message.

    Returns:
        The header and a structured array with the message's field names, offsets and byte order:
        (N,), or (H, W) for an organised cloud (height above 1). A read-only view of the buffer.

    Raises:
        ValueError: Truncated, an unknown datatype, fields outside ``point_step``, or sizes that
            contradict each other.
    """
    reader = CdrReader(buffer, POINT_CLOUD2)
    header = read_header(reader)
    height, width, field_count = reader.unpack("3I")
    fields = []
    for _ in range(field_count):
        name, (offset,), (number,), (count,) = (
            reader.string(),
            reader.unpack("I"),
            reader.unpack("B"),
            reader.unpack("I"),
        )
        fields.append((name, offset, number, count))
    (is_bigendian,) = reader.unpack("?")
    point_step, row_step = reader.unpack("2I")
    data = reader.blob()
    reader.unpack("?")  # is_dense
    reader.end()
    points = _points(data, fields, height, width, point_step, row_step, is_bigendian)
    return header, points


def point_cloud_from_message(message: PointCloud2Message) -> tuple[Header, np.ndarray]:
    """The same from an rclpy message; the array is a view of ``message.data``."""
    stamp = message.header.stamp
    fields = [(f.name, f.offset, f.datatype, f.count) for f in message.fields]
    points = _points(
        memoryview(message.data).cast("B"),
        fields,
        message.height,
        message.width,
        message.point_step,
        message.row_step,
        message.is_bigendian,
    )
    return Header(join_stamp(stamp.sec, stamp.nanosec), message.header.frame_id), points


def _describe(points: np.ndarray) -> list[tuple[str, int, int, int]]:
    """(name, offset, datatype number, count) of every field of a structured array."""
    if not isinstance(points, np.ndarray) or points.dtype.names is None:
        raise ValueError("points has no named fields, expected a structured array")
    if points.ndim not in (1, 2):
        raise ValueError(f"points has shape {points.shape}, expected (N,) or (H, W)")
    fields = []
    for name in points.dtype.names:
        dtype, offset = points.dtype.fields[name][:2]
        number = _NUMBERS.get(dtype.base)
        if number is None or len(dtype.shape) > 1:
            raise ValueError(f"points['{name}'] is {dtype}, expected a PointField type")
        fields.append((name, offset, number, dtype.shape[0] if dtype.shape else 1))
    return fields


def _points(
    data: memoryview,
    fields: list[tuple[str, int, int, int]],
    height: int,
    width: int,
    point_step: int,
    row_step: int,
    is_bigendian: bool,
) -> np.ndarray:
    """The structured view of a cloud's data, see ``cdr_to_point_cloud``."""
    dtype = _structured_dtype(fields, point_step, ">" if is_bigendian else "<")
    shape = (height, width) if height > 1 else (width * height,)
    if 0 in shape:
        return np.empty(shape, dtype)
    if row_step < width * point_step:
        raise ValueError(
            f"{POINT_CLOUD2}: row_step is {row_step}, expected at least "
            f"width {width} x point_step {point_step} = {width * point_step}"
        )
    if len(data) != height * row_step:
        raise ValueError(
            f"{POINT_CLOUD2}: data has {len(data)} bytes, expected "
            f"height {height} x row_step {row_step} = {height * row_step}"
        )
    strides = (row_step, point_step)[-len(shape) :]
    return np.ndarray(shape, dtype, buffer=data, strides=strides)


def _structured_dtype(
    fields: list[tuple[str, int, int, int]], point_step: int, order: str
) -> np.dtype:
    """The NumPy type of one point; fields may leave gaps, overlap and come in any order."""
    names, formats, offsets = [], [], []
    for name, offset, number, count in fields:
        if number not in _DATATYPES:
            raise ValueError(
                f"{POINT_CLOUD2}: field '{name}' has datatype {number}, expected 1 (INT8) to "
                "8 (FLOAT64)"
            )
        dtype = _DATATYPES[number].newbyteorder(order)
        count = count or 1  # some drivers leave the count at zero
        if offset + count * dtype.itemsize > point_step:
            raise ValueError(
                f"{POINT_CLOUD2}: field '{name}' ends at byte {offset + count * dtype.itemsize}, "
                f"expected within point_step {point_step}"
            )
        names.append(name or f"unnamed_{offset}")
        formats.append(dtype if count == 1 else (dtype, (count,)))
        offsets.append(offset)
    if len(set(names)) != len(names):
        raise ValueError(f"{POINT_CLOUD2}: field names {names}, expected no name twice")
    return np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": point_step}
    )
