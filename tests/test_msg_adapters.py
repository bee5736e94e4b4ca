# SPDX-License-Identifier: Apache-2.0
"""Message adapters against rclpy's serialisation, against rosbags', against bytes by hand."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from msg_adapters.clock import CLOCK, cdr_to_clock, clock_to_cdr
from msg_adapters.header import stamp_from_seconds, stamp_to_seconds
from msg_adapters.image import (
    cdr_to_compressed_image,
    cdr_to_image,
    compressed_image_to_cdr,
    image_to_cdr,
)
from msg_adapters.marker import (
    DELETE,
    MARKER,
    MARKER_ARRAY,
    Marker,
    Texture,
    cdr_to_marker,
    cdr_to_markers,
    delete_marker,
    marker_to_cdr,
    markers_to_cdr,
    primitive_marker,
    triangle_marker,
)
from msg_adapters.mesh import MESH, cdr_to_mesh, mesh_to_cdr
from msg_adapters.point_cloud import (
    POINT_CLOUD2,
    cdr_to_particle_cloud,
    cdr_to_point_cloud,
    particle_cloud_to_cdr,
    point_cloud_from_message,
    point_cloud_to_cdr,
)
from msg_adapters.pose import (
    POSE_STAMPED,
    cdr_to_pose,
    pose_from_message,
    pose_to_cdr,
    pose_to_message,
)
from msg_adapters.wrench import (
    WRENCH_STAMPED,
    cdr_to_wrench,
    wrench_from_message,
    wrench_to_cdr,
    wrench_to_message,
)

STAMP = 1_700_000_000_123_456_789
# Every alignment of what follows the frame's name, and characters of several bytes.
FRAMES = ["", "a", "ab", "abc", "abcd", "world", "camera", "wörld"]
STORE = get_typestore(Stores.ROS2_JAZZY)


def rclpy_class(message_type):
    pytest.importorskip("rclpy", reason="ROS is not installed: rclpy cannot be imported")
    package, _, name = message_type.split("/")
    return getattr(__import__(f"{package}.msg", fromlist=[name]), name)


def check_like_ros(data, message_type):
    """Hold our bytes against rclpy's; return its message and its bytes."""
    from rclpy.serialization import deserialize_message, serialize_message

    message_class = rclpy_class(message_type)
    message = deserialize_message(data, message_class)
    again = serialize_message(message)
    assert type(data) is bytes
    assert len(again) == len(data)
    assert deserialize_message(again, message_class) == message
    return message, again


def check_like_rosbags(data, message_type):
    """The library reads our bytes and writes the same ones, padding included."""
    message = STORE.deserialize_cdr(data, message_type)
    assert bytes(STORE.serialize_cdr(message, message_type)) == data
    return message


def particles(count, seed=0):
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(count, 3)).astype(np.float32),
        rng.normal(size=(count, 3)).astype(np.float32),
        rng.uniform(900, 1100, count).astype(np.float32),
        rng.permutation(count).astype(np.uint32) + np.uint32(2**31),
    )


def mesh(vertex_count, triangle_count, seed=0):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(vertex_count, 3)).astype(np.float32)
    triangles = rng.integers(0, max(vertex_count, 1), (triangle_count, 3)).astype(np.int32)
    return vertices, triangles


def test_pose_bytes_by_hand():
    golden = bytes.fromhex(
        "00010000"  # plain CDR, little-endian; offsets count from the next byte
        "00f15365"  # sec 1700000000
        "15cd5b07"  # nanosec 123456789
        "03000000" "6d7000"  # frame_id "mp" and its zero: three bytes
        "00"  # padding to offset 16
        "000000000000f03f" "0000000000000040" "0000000000000840"  # position 1 2 3
        "0000000000000000" "0000000000000000" "0000000000000000" "000000000000f03f"
    )  # fmt: skip
    stamp = 1_700_000_000 * 10**9 + 123456789
    assert pose_to_cdr((1, 2, 3), (0, 0, 0, 1), stamp, "mp") == golden
    assert cdr_to_pose(golden) == (stamp, "mp", (1, 2, 3), (0, 0, 0, 1))


def test_mesh_bytes_by_hand():
    golden = bytes.fromhex(
        "00010000"
        "01000000" "00000000" "01000000" "02000000"  # one triangle 0 1 2
        "03000000" "00000000"  # three vertices; padding from offset 20 to 24
        "000000000000f03f" "0000000000000000" "0000000000000000"
        "0000000000000000" "000000000000f03f" "0000000000000000"
        "0000000000000000" "0000000000000000" "000000000000f03f"
    )  # fmt: skip
    vertices, triangles = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)
    assert mesh_to_cdr(vertices, triangles) == golden
    # No elements: the two counts alone, no padding for the doubles that do not come.
    assert mesh_to_cdr(vertices[:0], triangles[:0]) == bytes.fromhex("000100000000000000000000")


def test_cloud_bytes_by_hand():
    points = np.array([(1.0, 7)], [("x", "<f4"), ("id", "<u4")])
    golden = bytes.fromhex(
        "00010000"
        "01000000" "02000000" "01000000" "00"  # stamp 1.000000002, frame_id ""
        "000000" "01000000" "01000000" "02000000"  # padding; height 1, width 1, two fields
        "02000000" "7800" "0000" "00000000" "07" "000000" "01000000"  # x, offset 0, FLOAT32, 1
        "03000000" "696400" "00" "04000000" "06" "000000" "01000000"  # id, offset 4, UINT32, 1
        "00" "000000" "08000000" "08000000"  # little-endian; point_step, row_step
        "08000000" "0000803f" "07000000"  # eight bytes of data
        "01"  # is_dense
    )  # fmt: skip
    assert point_cloud_to_cdr(points, 1_000_000_002, "") == golden


@pytest.mark.parametrize("frame", FRAMES)
def test_small_messages_are_like_ros(frame):
    position, quat, torque = (0.1, -2e30, 3.0), (0.5, -0.5, 0.5, 0.5), (4.0, 5e-9, 6.0)

    message, again = check_like_ros(pose_to_cdr(position, quat, STAMP, frame), POSE_STAMPED)
    assert message == pose_to_message(position, quat, STAMP, frame)
    assert cdr_to_pose(again) == pose_from_message(message) == (STAMP, frame, position, quat)

    message, again = check_like_ros(wrench_to_cdr(position, torque, -1, frame), WRENCH_STAMPED)
    assert message == wrench_to_message(position, torque, -1, frame)
    assert cdr_to_wrench(again) == wrench_from_message(message) == (-1, frame, position, torque)

    for data, message_type in (
        (pose_to_cdr(position, quat, STAMP, frame), POSE_STAMPED),
        (wrench_to_cdr(position, torque, STAMP, frame), WRENCH_STAMPED),
    ):
        check_like_rosbags(data, message_type)


def test_clock_is_like_ros():
    message, again = check_like_ros(clock_to_cdr(STAMP), CLOCK)
    assert (message.clock.sec, message.clock.nanosec) == divmod(STAMP, 10**9)
    assert cdr_to_clock(again) == STAMP
    check_like_rosbags(clock_to_cdr(STAMP), CLOCK)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("count", [0, 1, 7])
def test_particle_cloud_is_like_ros(frame, count):
    arrays = particles(count)
    data = particle_cloud_to_cdr(*arrays, STAMP, frame)
    message, again = check_like_ros(data, POINT_CLOUD2)
    assert [f.name for f in message.fields] == "x y z vx vy vz density id".split()
    assert (message.width, message.height, message.point_step) == (count, 1, 32)
    for buffer in (data, again):
        cloud = cdr_to_particle_cloud(buffer)
        assert cloud.header == (STAMP, frame)
        for got, expected in zip(cloud[1:], arrays, strict=True):
            assert got.dtype == expected.dtype
            np.testing.assert_array_equal(got, expected)
    header, points = point_cloud_from_message(message)
    assert header == (STAMP, frame)
    np.testing.assert_array_equal(points["id"], arrays[3])
    check_like_rosbags(data, POINT_CLOUD2)


def test_large_cloud_and_mesh_are_like_ros():
    arrays = particles(20_000)
    data = particle_cloud_to_cdr(*arrays, STAMP, "world")
    check_like_ros(data, POINT_CLOUD2)
    np.testing.assert_array_equal(cdr_to_particle_cloud(data).positions, arrays[0])

    vertices, triangles = mesh(30_000, 60_000)
    data = mesh_to_cdr(vertices, triangles)
    message, again = check_like_ros(data, MESH)
    assert tuple(message.triangles[-1].vertex_indices) == tuple(triangles[-1])
    got_vertices, got_triangles = cdr_to_mesh(again)
    assert got_triangles.dtype == np.int32
    np.testing.assert_array_equal(got_vertices, vertices)
    np.testing.assert_array_equal(got_triangles, triangles)
    check_like_rosbags(data, MESH)

    data = marker_to_cdr(triangle_marker(vertices, triangles, STAMP, "world"))
    message, again = check_like_ros(data, MARKER)
    assert len(message.points) == 180_000
    np.testing.assert_array_equal(cdr_to_marker(again).points, vertices[triangles.ravel()])
    check_like_rosbags(data, MARKER)


def assert_same_marker(got, expected):
    for name, value in vars(expected).items():
        other = getattr(got, name)
        if isinstance(value, Texture):
            assert vars(other) == vars(value)
        elif isinstance(value, np.ndarray):
            assert other.dtype == value.dtype
            np.testing.assert_array_equal(other, value)
        else:
            assert other == value, name


def several_markers(frame):
    vertices, triangles = mesh(5, 3)
    colors = np.linspace(0, 1, 20, dtype=np.float32).reshape(5, 4)
    return [
        triangle_marker(vertices, triangles, STAMP, frame, namespace="s", vertex_colors=colors),
        triangle_marker(vertices, triangles, STAMP, frame, vertex_colors=colors[:, :3].copy()),
        triangle_marker(vertices, triangles[:0], STAMP, frame, marker_id=3),
        primitive_marker("cylinder", (1, 2, 3), (4, 5, 6), (0, 0, 0, 1), 7, frame, marker_id=-8),
        delete_marker(STAMP, frame, everything=True),
        Marker(  # every field that nothing above fills
            STAMP,
            frame,
            lifetime_ns=1_500_000_000,
            frame_locked=True,
            texture_resource="embedded://t",
            texture=Texture((5, "eye"), "png", b"\x89PNG\r"),
            uv_coordinates=np.array([[0.25, 0.75]], np.float32),
            text="drop",
            mesh_resource="package://a/b.stl",
            mesh_filename="b.stl",
            mesh_data=b"solid",
            mesh_use_embedded_materials=True,
        ),
    ]


@pytest.mark.parametrize("frame", FRAMES)
def test_markers_are_like_ros(frame):
    markers = several_markers(frame)
    for marker in markers:
        data = marker_to_cdr(marker)
        _, again = check_like_ros(data, MARKER)
        assert_same_marker(cdr_to_marker(data), marker)
        assert_same_marker(cdr_to_marker(again), marker)
        check_like_rosbags(data, MARKER)
    for chosen in (markers, []):
        data = markers_to_cdr(chosen)
        message, again = check_like_ros(data, MARKER_ARRAY)
        assert len(message.markers) == len(chosen)
        for got, expected in zip(cdr_to_markers(again), chosen, strict=True):
            assert_same_marker(got, expected)
        check_like_rosbags(data, MARKER_ARRAY)


def test_triangle_marker_as_ros_understands_it():
    vertices, triangles = mesh(5, 3)
    colors = np.linspace(0, 1, 15, dtype=np.float32).reshape(5, 3)
    data = marker_to_cdr(triangle_marker(vertices, triangles, 0, "w", vertex_colors=colors))
    message, _ = check_like_ros(data, MARKER)
    assert (message.type, message.action) == (message.TRIANGLE_LIST, message.ADD)
    corner, color = triangles.ravel()[4], message.colors[4]
    assert [message.points[4].x, message.points[4].y] == list(vertices[corner, :2])
    assert [color.r, color.g, color.b, color.a] == [*colors[corner], 1.0]
    assert message.scale.x == 1.0 and message.pose.orientation.w == 1.0
    # RViz takes an empty list for an error.
    assert triangle_marker(vertices, triangles[:0], 0, "w").action == DELETE == message.DELETE


@pytest.mark.parametrize("order", ["<", ">"])
def test_foreign_clouds(order):
    """Padding between fields and at the row's end, several elements, organised, either order."""
    from rclpy.serialization import serialize_message

    point_field = rclpy_class("sensor_msgs/msg/PointField")
    dtype = np.dtype(
        {
            "names": ["ring", "x", "normal", "intensity"],
            "formats": [f"{order}u2", f"{order}f8", (f"{order}f4", (3,)), "u1"],
            "offsets": [26, 1, 9, 29],
            "itemsize": 31,
        }
    )
    expected = np.zeros((3, 4), dtype)
    for name in dtype.names:
        expected[name] = np.random.default_rng(1).integers(0, 99, expected[name].shape)
    row_step = 4 * 31 + 5
    rows = np.full((3, row_step), 255, np.uint8)
    rows[:, : 4 * 31] = expected.view(np.uint8).reshape(3, -1)
    message = rclpy_class(POINT_CLOUD2)(
        height=3, width=4, point_step=31, row_step=row_step, is_bigendian=order == ">"
    )
    for name, number, count in (("ring", 4, 0), ("x", 8, 1), ("normal", 7, 3), ("intensity", 2, 1)):
        offset = dtype.fields[name][1]
        message.fields.append(point_field(name=name, offset=offset, datatype=number, count=count))
    message.data.frombytes(rows.tobytes())
    for _, points in (
        cdr_to_point_cloud(bytes(serialize_message(message))),
        point_cloud_from_message(message),
    ):
        assert points.shape == (3, 4)
        for name in dtype.names:
            np.testing.assert_array_equal(points[name], expected[name])
    if order == "<":  # written with the same gaps, and read again
        _, points = cdr_to_point_cloud(point_cloud_to_cdr(expected, 0, "w"))
        np.testing.assert_array_equal(points["normal"], expected["normal"])
        assert points.dtype.itemsize == 31


def test_big_endian_messages_are_read():
    message = STORE.deserialize_cdr(pose_to_cdr((1, 2, 3), (0, 0, 0, 1), STAMP, "ab"), POSE_STAMPED)
    big = bytes(STORE.serialize_cdr(message, POSE_STAMPED, little_endian=False))
    assert big[:4] == b"\x00\x00\x00\x00"
    assert cdr_to_pose(big) == (STAMP, "ab", (1, 2, 3), (0, 0, 0, 1))

    vertices, triangles = mesh(9, 4)
    message = STORE.deserialize_cdr(mesh_to_cdr(vertices, triangles), MESH)
    big = bytes(STORE.serialize_cdr(message, MESH, little_endian=False))
    np.testing.assert_array_equal(cdr_to_mesh(big)[0], vertices)
    np.testing.assert_array_equal(cdr_to_mesh(big)[1], triangles)


@pytest.mark.parametrize(
    ("encoding", "shape", "dtype"),
    [
        ("rgb8", (5, 7, 3), np.uint8),
        ("mono8", (3, 5), np.uint8),
        ("16UC1", (2, 3), np.uint16),
        ("32FC1", (0, 4), np.float32),
    ],
)
def test_images_are_like_ros(encoding, shape, dtype):
    pixels = np.random.default_rng(0).integers(0, 255, shape).astype(dtype)
    data = image_to_cdr(pixels, encoding, STAMP, "eye")
    message, again = check_like_ros(data, "sensor_msgs/msg/Image")
    assert message.step == np.prod(shape[1:]) * pixels.itemsize
    image = cdr_to_image(again)
    assert image.header == (STAMP, "eye") and image.encoding == encoding
    assert image.pixels.dtype == dtype
    np.testing.assert_array_equal(image.pixels, pixels)


def test_compressed_image_is_like_ros():
    data = compressed_image_to_cdr(b"\x89PNG", "png", STAMP, "eye")
    _, again = check_like_ros(data, "sensor_msgs/msg/CompressedImage")
    image = cdr_to_compressed_image(again)
    assert (image.header, image.format, bytes(image.data)) == ((STAMP, "eye"), "png", b"\x89PNG")


def all_messages():
    vertices, triangles = mesh(4, 3)
    return {
        "pose": (cdr_to_pose, pose_to_cdr((1, 2, 3), (0, 0, 0, 1), STAMP, "world")),
        "wrench": (cdr_to_wrench, wrench_to_cdr((1, 2, 3), (0, 0, 1), STAMP, "world")),
        "clock": (cdr_to_clock, clock_to_cdr(STAMP)),
        "mesh": (cdr_to_mesh, mesh_to_cdr(vertices, triangles)),
        "cloud": (cdr_to_point_cloud, particle_cloud_to_cdr(*particles(2), STAMP, "world")),
        "marker": (
            cdr_to_marker,
            marker_to_cdr(triangle_marker(vertices, triangles, STAMP, "world")),
        ),
        "markers": (cdr_to_markers, markers_to_cdr(several_markers("world"))),
        "image": (cdr_to_image, image_to_cdr(np.zeros((2, 2), np.uint8), "mono8", 0, "eye")),
        "compressed": (cdr_to_compressed_image, compressed_image_to_cdr(b"12345", "png", 0, "eye")),
    }


@pytest.mark.parametrize("name", all_messages())
def test_every_truncation_and_wrong_encapsulation_is_refused(name):
    read, data = all_messages()[name]
    read(data)
    for length in range(len(data)):
        with pytest.raises(ValueError, match="truncated|expected|end with a zero"):
            read(data[:length])
    read(data + b"\0" * (-len(data) % 4))  # rounded up, as middleware does
    with pytest.raises(ValueError, match="expected"):
        read(data + b"\0" * 8)
    for encapsulation in (b"\x00\x07", b"\x00\x03", b"\x01\x01"):
        with pytest.raises(ValueError, match="encapsulation .* expected plain CDR"):
            read(encapsulation + data[2:])


@pytest.mark.parametrize("name", all_messages())
def test_flipped_bytes_give_a_value_error_or_a_message(name):
    """Whatever the bytes, nothing but a ValueError comes out, and no memory for a wrong count."""
    read, data = all_messages()[name]
    for index in range(len(data)):
        for value in (0x00, 0x7F, 0xFF):
            try:
                read(data[:index] + bytes([value]) + data[index + 1 :])
            except ValueError as error:
                assert str(error)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"datatype": 9}, "field 'z' has datatype 9, expected 1 .* to 8"),
        ({"offset": 30}, "field 'z' ends at byte 34, expected within point_step 32"),
        ({"name": "x"}, "expected no name twice"),
        ({"point_step": 40}, "row_step is 64, expected at least width 2 x point_step 40"),
        ({"width": 3}, "row_step is 64, expected at least width 3"),
        ({"row_step": 72}, "data has 64 bytes, expected height 1 x row_step 72"),
        ({"height": 2}, "data has 64 bytes, expected height 2 x row_step 64"),
    ],
)
def test_contradicting_clouds_are_refused(change, expected):
    message = STORE.deserialize_cdr(particle_cloud_to_cdr(*particles(2), 0, "w"), POINT_CLOUD2)
    for name, value in change.items():
        object.__setattr__(message if hasattr(message, name) else message.fields[2], name, value)
    with pytest.raises(ValueError, match=expected):
        cdr_to_point_cloud(bytes(STORE.serialize_cdr(message, POINT_CLOUD2)))


def test_wrong_input_is_named():
    positions, velocities, densities, ids = particles(4)
    vertices, triangles = mesh(4, 2)
    wrong = [
        (lambda: particle_cloud_to_cdr(positions[:, :2], velocities, densities, ids, 0, ""),
         r"positions has shape \(4, 2\) of float32, expected \(N, 3\) of float32"),
        (lambda: particle_cloud_to_cdr(positions.astype(float), velocities, densities, ids, 0, ""),
         "positions has .* of float64, expected .* float32"),
        (lambda: particle_cloud_to_cdr(positions, velocities[:3], densities, ids, 0, ""),
         "velocities has 3 rows, expected 4"),
        (lambda: particle_cloud_to_cdr(positions, velocities, densities, ids.astype(int), 0, ""),
         "ids has .* of int64, expected .* uint32"),
        (lambda: particle_cloud_to_cdr([[0, 0, 0]], velocities, densities, ids, 0, ""),
         "positions is list, expected"),
        (lambda: point_cloud_to_cdr(positions, 0, ""), "points has no named fields"),
        (lambda: point_cloud_to_cdr(np.zeros(2, [("x", ">f4")]), 0, ""), "expected a PointField"),
        (lambda: mesh_to_cdr(vertices[:1], triangles), "triangles has indices .* expected 0 to 0"),
        (lambda: mesh_to_cdr(vertices, triangles - 9), "triangles has indices -"),
        (lambda: mesh_to_cdr(vertices, triangles.astype(float)), "triangles has .* of float64"),
        (lambda: triangle_marker(vertices, triangles, 0, "", vertex_colors=vertices[:2]),
         "vertex_colors has 2 rows, expected 4"),
        (lambda: primitive_marker("cone", (1, 1, 1), (0, 0, 0), (0, 0, 0, 1), 0, ""),
         "shape is 'cone', expected one of cube, sphere, cylinder"),
        (lambda: pose_to_cdr((1, 2), (0, 0, 0, 1), 0, ""), "position has 2 numbers, expected 3"),
        (lambda: pose_to_cdr((1, 2, 3), None, 0, ""), "quat_xyzw is None, expected 4 numbers"),
        (lambda: pose_to_cdr((1, 2, 3), (0, 0, 0, 1), 2**63, ""), "stamp_ns is 92233720368547"),
        (lambda: pose_to_cdr((1, 2, 3), (0, 0, 0, 1), 0, "a\0b"), "zero character"),
        (lambda: image_to_cdr(np.zeros((2, 2, 3), np.uint8), "mono8", 0, ""),
         r"pixels has shape \(2, 2, 3\) of uint8, expected \(H, W\) of uint8 for mono8"),
        (lambda: image_to_cdr(np.zeros((2, 2), np.uint8), "yuv", 0, ""), "encoding is 'yuv'"),
        (lambda: stamp_from_seconds(float("nan")), "time is nan s, expected a finite number"),
    ]  # fmt: skip
    for call, expected in wrong:
        with pytest.raises(ValueError, match=expected):
            call()


def test_index_beyond_the_vertices_is_refused_when_reading():
    data = bytearray(mesh_to_cdr(*mesh(4, 1)))
    data[8] = 4
    with pytest.raises(ValueError, match="index 4 in a mesh of 4 vertices"):
        cdr_to_mesh(bytes(data))


def test_seconds_and_nanoseconds():
    assert stamp_from_seconds(1.5) == 1_500_000_000
    assert stamp_from_seconds(-0.25) == -250_000_000
    assert stamp_from_seconds(2.0000000004) == 2_000_000_000
    assert stamp_to_seconds(stamp_from_seconds(1_700_000_000.25)) == 1_700_000_000.25
    # Before the epoch the seconds are rounded down and the nanoseconds stay positive.
    assert cdr_to_clock(clock_to_cdr(-1)) == -1


def test_arrays_read_are_views_and_cannot_be_written():
    data = mesh_to_cdr(*mesh(4, 3))
    for array in cdr_to_mesh(data):
        assert not array.flags.writeable and not array.flags.owndata
