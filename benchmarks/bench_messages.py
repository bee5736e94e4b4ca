# SPDX-License-Identifier: Apache-2.0
"""Milliseconds to build and publish large messages: ordinary rclpy against ready CDR bytes.

    python benchmarks/bench_messages.py [REPEATS]

A subscriber of each topic exists in another process, so that publishing includes the middleware's
work. Medians of one run; both ways start from the same NumPy arrays.
"""

from __future__ import annotations

import array
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
import rclpy
from geometry_msgs.msg import Point, PoseStamped
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2, PointField
from shape_msgs.msg import Mesh, MeshTriangle
from visualization_msgs.msg import Marker

from msg_adapters.marker import cdr_to_marker, marker_to_cdr, triangle_marker
from msg_adapters.mesh import cdr_to_mesh, mesh_to_cdr
from msg_adapters.point_cloud import cdr_to_particle_cloud, particle_cloud_to_cdr
from msg_adapters.pose import cdr_to_pose, pose_to_cdr

PARTICLES, VERTICES, TRIANGLES = 20_000, 30_000, 60_000
MARKER_TRIANGLES = 20_000  # 60,000 points
QOS = QoSProfile(depth=2)

_RNG = np.random.default_rng(0)
POSITIONS, VELOCITIES = _RNG.normal(size=(2, PARTICLES, 3)).astype(np.float32)
DENSITIES = _RNG.uniform(900, 1100, PARTICLES).astype(np.float32)
IDS = np.arange(PARTICLES, dtype=np.uint32)
CORNERS = _RNG.normal(size=(VERTICES, 3)).astype(np.float32)
FACES = _RNG.integers(0, VERTICES, (TRIANGLES, 3)).astype(np.int32)


def ordinary_cloud() -> PointCloud2:
    table = np.empty((PARTICLES, 8), np.float32)
    table[:, :3], table[:, 3:6], table[:, 6] = POSITIONS, VELOCITIES, DENSITIES
    table.view(np.uint32)[:, 7] = IDS
    message = PointCloud2(height=1, width=PARTICLES, point_step=32, row_step=32 * PARTICLES)
    for index, name in enumerate(("x", "y", "z", "vx", "vy", "vz", "density", "id")):
        datatype = PointField.UINT32 if name == "id" else PointField.FLOAT32
        message.fields.append(PointField(name=name, offset=4 * index, datatype=datatype, count=1))
    # Through array.array: a NumPy array in its place is checked element by element (70 ms).
    message.data = array.array("B", table.tobytes())
    return message


def ordinary_marker() -> Marker:
    points = CORNERS[FACES[:MARKER_TRIANGLES].ravel()].tolist()
    message = Marker(type=Marker.TRIANGLE_LIST)
    message.points = [Point(x=x, y=y, z=z) for x, y, z in points]
    return message


def ordinary_mesh() -> Mesh:
    message = Mesh()
    message.vertices = [Point(x=x, y=y, z=z) for x, y, z in CORNERS.tolist()]
    message.triangles = [
        MeshTriangle(vertex_indices=np.array(face, np.uint32)) for face in FACES.tolist()
    ]
    return message


def cdr_cloud() -> bytes:
    return particle_cloud_to_cdr(POSITIONS, VELOCITIES, DENSITIES, IDS, 0, "world")


def cdr_marker() -> bytes:
    return marker_to_cdr(triangle_marker(CORNERS, FACES[:MARKER_TRIANGLES], 0, "world"))


def cdr_mesh() -> bytes:
    return mesh_to_cdr(CORNERS, FACES)


def ordinary_pose() -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = "world"
    message.pose.position.x = 1.0
    return message


def cdr_pose() -> bytes:
    return pose_to_cdr((1, 0, 0), (0, 0, 0, 1), 0, "world")


CASES = (
    (f"PointCloud2, {PARTICLES} particles", PointCloud2, ordinary_cloud, cdr_cloud,
     cdr_to_particle_cloud),
    (f"Marker, {3 * MARKER_TRIANGLES} points", Marker, ordinary_marker, cdr_marker, cdr_to_marker),
    (f"Mesh, {VERTICES} vertices, {TRIANGLES} triangles", Mesh, ordinary_mesh, cdr_mesh,
     cdr_to_mesh),
    ("PoseStamped", PoseStamped, ordinary_pose, cdr_pose, cdr_to_pose),
)  # fmt: skip


def median_ms(call: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - began))
    return statistics.median(times)


def listen() -> None:
    """The other process: takes every message as bytes and drops it."""
    rclpy.init()
    node = rclpy.create_node("bench_listener")
    for index, case in enumerate(CASES):
        node.create_subscription(case[1], f"bench_{index}", lambda _: None, QOS, raw=True)
    rclpy.spin(node)


def measure(node: rclpy.node.Node, repeats: int) -> None:
    head = ("", "build", "publish", "read", "build", "publish", "read")
    print(f"{'[ms], median of ' + str(repeats):38}|{'rclpy messages':^26}|{'CDR bytes':^26}")
    print("{:38}|{:>8}{:>9}{:>8} |{:>8}{:>9}{:>8}".format(*head))
    for index, (name, message_class, ordinary, ready, read) in enumerate(CASES):
        publisher = node.create_publisher(message_class, f"bench_{index}", QOS)
        while publisher.get_subscription_count() == 0:
            time.sleep(0.01)
        message, data = ordinary(), ready()
        values = [
            median_ms(call, repeats)
            for call in (
                ordinary,
                lambda: publisher.publish(message),  # noqa: B023
                lambda: deserialize_message(data, message_class),  # noqa: B023
                ready,
                lambda: publisher.publish(data),  # noqa: B023
                lambda: read(data),  # noqa: B023
            )
        ]
        print("{:38}|{:8.3f}{:9.3f}{:8.3f} |{:8.3f}{:9.3f}{:8.3f}".format(name, *values))


def main() -> None:
    if sys.argv[1:] == ["--listen"]:
        listen()
        return
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
    listener = subprocess.Popen([sys.executable, __file__, "--listen"])
    rclpy.init()
    try:
        measure(rclpy.create_node("bench_messages"), int((sys.argv[1:] or ["15"])[0]))
    finally:
        rclpy.try_shutdown()
        listener.kill()
        listener.wait()


if __name__ == "__main__":
    main()
