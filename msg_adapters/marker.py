# SPDX-License-Identifier: Apache-2.0
"""visualization_msgs/Marker and MarkerArray, in and out: triangles, primitives, deletion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from msg_adapters.cdr import CdrReader, CdrWriter
from msg_adapters.checks import numbers, rows
from msg_adapters.header import Header, read_header, read_stamp, write_header, write_stamp
from msg_adapters.mesh import check_triangles

MARKER = "visualization_msgs/msg/Marker"
MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"

# Values of Marker.type and Marker.action, as in the message definition.
ARROW, CUBE, SPHERE, CYLINDER = 0, 1, 2, 3
TRIANGLE_LIST = 11
ADD, DELETE, DELETE_ALL = 0, 2, 3
PRIMITIVES = {"cube": CUBE, "sphere": SPHERE, "cylinder": CYLINDER}

NO_ROTATION = (0.0, 0.0, 0.0, 1.0)
WHITE = (1.0, 1.0, 1.0, 1.0)


def _empty(columns: int, dtype: type):
    return field(default_factory=lambda: np.empty((0, columns), dtype))


@dataclass(frozen=True, eq=False)
class Texture:
    """The sensor_msgs/CompressedImage inside a marker."""

    header: Header = Header(0, "")
    format: str = ""
    data: bytes = b""


@dataclass(frozen=True, eq=False)
class Marker:
    """Every field of a visualization_msgs/Marker, in its order; lengths [m], colours 0 to 1."""

    stamp_ns: int
    frame_id: str
    namespace: str = ""
    marker_id: int = 0
    type: int = ARROW
    action: int = ADD
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    quat_xyzw: tuple[float, ...] = NO_ROTATION
    scale: tuple[float, ...] = (1.0, 1.0, 1.0)
    color: tuple[float, ...] = WHITE  # red green blue alpha
    lifetime_ns: int = 0  # 0: for ever
    frame_locked: bool = False
    points: np.ndarray = _empty(3, np.float64)  # (N, 3) float64
    colors: np.ndarray = _empty(4, np.float32)  # (N, 4) float32, or empty
    texture_resource: str = ""
    texture: Texture = Texture()
    uv_coordinates: np.ndarray = _empty(2, np.float32)  # (N, 2) float32, or empty
    text: str = ""
    mesh_resource: str = ""
    mesh_filename: str = ""
    mesh_data: bytes = b""
    mesh_use_embedded_materials: bool = False


def triangle_marker(
    vertices: np.ndarray,
    triangles: np.ndarray,
    stamp_ns: int,
    frame_id: str,
    *,
    namespace: str = "",
    marker_id: int = 0,
    color: Sequence[float] = WHITE,
    vertex_colors: np.ndarray | None = None,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    quat_xyzw: Sequence[float] = NO_ROTATION,
) -> Marker:
    """A TRIANGLE_LIST of indexed triangles, or a DELETE when there are none.

    RViz takes an empty triangle list for an error, so what has no triangles is deleted instead.

    Args:
        vertices: (V, 3) float32 or float64 [m], in the marker's own pose.
        triangles: (T, 3) int32, int64 or uint32, indices into ``vertices``.
        stamp_ns: Time [ns].
        frame_id: Frame of the marker's pose.
        namespace: With ``marker_id`` the name under which viewers replace or delete it.
        marker_id: See ``namespace``.
        color: (3,) red green blue or (4,) with alpha, 0 to 1; of the whole marker.
        vertex_colors: (V, 3) or (V, 4) float32, 0 to 1; used in place of ``color``.
        position: (3,) [m] of the marker in ``frame_id``.
        quat_xyzw: (4,) its rotation, x y z w.

    Raises:
        ValueError: Wrong shape or dtype, or an index without its vertex.
    """
    check_triangles(vertices, triangles)
    if len(triangles) == 0:
        return delete_marker(stamp_ns, frame_id, namespace=namespace, marker_id=marker_id)
    corners = triangles.reshape(-1)
    colors = np.empty((0, 4), np.float32)
    if vertex_colors is not None:
        # Looked up per vertex, not per corner: there are six times as many corners.
        colors = np.take(_with_alpha(vertex_colors, len(vertices)), corners, axis=0)
    return Marker(
        stamp_ns,
        frame_id,
        namespace,
        marker_id,
        TRIANGLE_LIST,
        position=numbers(position, "position", 3),
        quat_xyzw=numbers(quat_xyzw, "quat_xyzw", 4),
        color=_rgba(color),
        points=np.take(vertices.astype(np.float64, copy=False), corners, axis=0),
        colors=colors,
    )


def primitive_marker(
    shape: str,
    scale: Sequence[float],
    position: Sequence[float],
    quat_xyzw: Sequence[float],
    stamp_ns: int,
    frame_id: str,
    *,
    namespace: str = "",
    marker_id: int = 0,
    color: Sequence[float] = WHITE,
) -> Marker:
    """A sphere, cube or cylinder (axis z) of full extent ``scale`` about its centre.

    Args:
        shape: ``sphere``, ``cube`` or ``cylinder``.
        scale: (3,) extent along the marker's own axes [m]: diameters and lengths, not radii.
        position: (3,) centre [m] in ``frame_id``.
        quat_xyzw: (4,) rotation, x y z w.
        stamp_ns: Time [ns].
        frame_id: Frame of the pose.
        namespace: See ``triangle_marker``.
        marker_id: See ``triangle_marker``.
        color: (3,) or (4,), 0 to 1.

    Raises:
        ValueError: An unknown shape or a wrong number of values.
    """
    if shape not in PRIMITIVES:
        raise ValueError(f"shape is {shape!r}, expected one of {', '.join(PRIMITIVES)}")
    return Marker(
        stamp_ns,
        frame_id,
        namespace,
        marker_id,
        PRIMITIVES[shape],
        position=numbers(position, "position", 3),
        quat_xyzw=numbers(quat_xyzw, "quat_xyzw", 4),
        scale=numbers(scale, "scale", 3),
        color=_rgba(color),
    )


def delete_marker(
    stamp_ns: int,
    frame_id: str,
    *,
    namespace: str = "",
    marker_id: int = 0,
    everything: bool = False,
) -> Marker:
    """Takes one marker away, or all of the topic's when ``everything``."""
    action = DELETE_ALL if everything else DELETE
    return Marker(stamp_ns, frame_id, namespace, marker_id, TRIANGLE_LIST, action)


def marker_to_cdr(marker: Marker) -> bytes:
    """A ready visualization_msgs/Marker; ValueError when a field has the wrong shape or range."""
    writer = CdrWriter()
    _write_marker(writer, marker)
    return writer.finish()


def markers_to_cdr(markers: Sequence[Marker]) -> bytes:
    """A ready visualization_msgs/MarkerArray; errors as in ``marker_to_cdr``."""
    writer = CdrWriter()
    writer.pack("I", len(markers))
    for marker in markers:
        _write_marker(writer, marker)
    return writer.finish()


def cdr_to_marker(buffer: bytes) -> Marker:
    """A visualization_msgs/Marker from its bytes; arrays are read-only views of the buffer.

    Raises:
        ValueError: The bytes are not a marker.
    """
    reader = CdrReader(buffer, MARKER)
    marker = _read_marker(reader)
    reader.end()
    return marker


def cdr_to_markers(buffer: bytes) -> list[Marker]:
    """A visualization_msgs/MarkerArray from its bytes; see ``cdr_to_marker``."""
    reader = CdrReader(buffer, MARKER_ARRAY)
    markers = [_read_marker(reader) for _ in range(reader.count())]
    reader.end()
    return markers


def _write_marker(writer: CdrWriter, marker: Marker) -> None:
    points = rows(marker.points, "points", 3, np.float64)
    colors = rows(marker.colors, "colors", 4, np.float32)
    uv_coordinates = rows(marker.uv_coordinates, "uv_coordinates", 2, np.float32)
    write_header(writer, marker.stamp_ns, marker.frame_id)
    writer.string(marker.namespace)
    writer.pack("3i", marker.marker_id, marker.type, marker.action)
    writer.pack("10d", *marker.position, *marker.quat_xyzw, *marker.scale)
    writer.pack("4f", *marker.color)
    write_stamp(writer, marker.lifetime_ns)
    writer.pack("?", marker.frame_locked)
    writer.array(points, count=len(points))
    writer.array(colors, count=len(colors))
    writer.string(marker.texture_resource)
    write_header(writer, *marker.texture.header)
    writer.string(marker.texture.format)
    writer.blob(marker.texture.data)
    writer.array(uv_coordinates, count=len(uv_coordinates))
    writer.string(marker.text)
    writer.string(marker.mesh_resource)
    writer.string(marker.mesh_filename)
    writer.blob(marker.mesh_data)
    writer.pack("?", marker.mesh_use_embedded_materials)


def _read_marker(reader: CdrReader) -> Marker:
    # The order of the calls is the order of the fields, hence of the bytes.
    header = read_header(reader)
    namespace = reader.string()
    marker_id, marker_type, action = reader.unpack("3i")
    pose_and_scale = reader.unpack("10d")
    return Marker(
        stamp_ns=header.stamp_ns,
        frame_id=header.frame_id,
        namespace=namespace,
        marker_id=marker_id,
        type=marker_type,
        action=action,
        position=pose_and_scale[0:3],
        quat_xyzw=pose_and_scale[3:7],
        scale=pose_and_scale[7:10],
        color=reader.unpack("4f"),
        lifetime_ns=read_stamp(reader),
        frame_locked=reader.unpack("?")[0],
        points=reader.array(np.float64, reader.count(), columns=3),
        colors=reader.array(np.float32, reader.count(), columns=4),
        texture_resource=reader.string(),
        texture=Texture(read_header(reader), reader.string(), bytes(reader.blob())),
        uv_coordinates=reader.array(np.float32, reader.count(), columns=2),
        text=reader.string(),
        mesh_resource=reader.string(),
        mesh_filename=reader.string(),
        mesh_data=bytes(reader.blob()),
        mesh_use_embedded_materials=reader.unpack("?")[0],
    )


def _rgba(color: Sequence[float]) -> tuple[float, ...]:
    """Red green blue alpha from three or four numbers."""
    return numbers((*color, 1.0) if len(color) == 3 else color, "color", 4)


def _with_alpha(colors: np.ndarray, count: int) -> np.ndarray:
    """(count, 4) float32 from (count, 3) or (count, 4)."""
    columns = 3 if getattr(colors, "shape", ())[-1:] == (3,) else 4
    if len(rows(colors, "vertex_colors", columns, np.float32)) != count:
        raise ValueError(f"vertex_colors has {len(colors)} rows, expected {count}, one per vertex")
    if columns == 4:
        return colors
    return np.concatenate([colors, np.ones((count, 1), np.float32)], axis=1)
