# SPDX-License-Identifier: Apache-2.0
"""How fast fluid_node is with everything on, and how long a pose takes to show: two real processes.

    python benchmarks/bench_node.py [--scenes dam_break_large ball_tank_large] [--seconds 5]

The node runs with `speed` so high that it never waits: the real-time factor is then what the
machine can do. The hand moves on a circle at 0.24 m/s of simulated time. Latency is measured at
speed 1, with every step published: a pose 2 mm away is sent, and the time is taken until a ~/solids
message arrives here in which the ball has begun to move, and one in which it has arrived. Arriving
takes `smoothing_time` (50 ms) by design when poses are as rare as here. The node itself tells the
longest time of each second, some four poses, from the pose's arrival in its process to having
published what felt it: without the ways between the processes. The bound is two steps and 5 ms, a
step as long as it takes.
"""

import argparse
import os
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))

import rclpy  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import PoseStamped, WrenchStamped  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402
from shape_msgs.msg import Mesh  # noqa: E402
from visualization_msgs.msg import Marker, MarkerArray  # noqa: E402

from msg_adapters.marker import cdr_to_markers  # noqa: E402
from msg_adapters.pose import pose_to_cdr  # noqa: E402

UPRIGHT = (0.0, 0.0, 0.0, 1.0)


class Circle(NamedTuple):
    """Where a hand goes round: centre and radius [m], speed in simulated time [m/s]."""

    center: tuple
    radius: float
    speed: float = 0.24


#: Of the scenes' hands.
CIRCLES = {
    "dam_break_large": Circle((0.5, 0.25, 0.08), 0.12),
    "ball_tank_large": Circle((0.1, 0.1, 0.08), 0.04),
    "ball_tank": Circle((0.1, 0.1, 0.08), 0.04),
}

#: Latency is measured in this small one, too.
SMALL = "ball_tank"

PARTICLES = ("particles", PointCloud2)
OTHERS = (("solids", MarkerArray), ("solids/ball/wrench", WrenchStamped))
SURFACES = (("surface", Marker), ("surface_mesh", Mesh))

#: Name of a load, what is subscribed, poses per second.
LOADS = (
    ("nobody listens", (), 0.0),
    ("particles 30 Hz", (PARTICLES,), 0.0),
    ("... and surface 15 Hz", (PARTICLES, *OTHERS, *SURFACES), 0.0),
    ("... and a hand 60 Hz", (PARTICLES, *OTHERS, *SURFACES), 60.0),
)


class Bench:
    """A client of a fluid_node process.

    Attributes:
        circle: the hand's way in the scene that runs.
    """

    def __init__(self):
        self.circle = None
        rclpy.init(args=[])
        self.node = rclpy.create_node("bench")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.facts, self.angle = [], 0.0
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._keep, 10)
        self.hand = self.node.create_publisher(PoseStamped, "/fluid/solids/ball/pose", 10)
        self._thread = threading.Thread(target=self.executor.spin)
        self._thread.start()

    def close(self):
        """End the spinning, then what was spun."""
        self.executor.shutdown()
        self._thread.join()
        self.node.destroy_node()
        rclpy.try_shutdown()

    def _keep(self, array):
        for status in array.status:
            if status.name == "fluid: simulation":
                self.facts.append({item.key: item.value for item in status.values})

    def send(self, position):
        """Tell the ball where to go, not stamped."""
        self.hand.publish(pose_to_cdr(position, UPRIGHT, 0, "world"))

    @contextmanager
    def listening(self, topics):
        """Subscribe; yields topic -> list of arrival times."""
        arrivals = {name: [] for name, _ in topics}
        subscriptions = [
            self.node.create_subscription(
                message_class,
                f"/fluid/{name}",
                lambda _, name=name: arrivals[name].append(time.monotonic()),
                QoSProfile(depth=2),
                raw=True,
            )
            for name, message_class in topics
        ]
        yield arrivals
        for subscription in subscriptions:
            self.node.destroy_subscription(subscription)

    def load(self, topics, pose_rate, seconds):
        """Means over some seconds: real-time factor, step ms, particles Hz, surfaces Hz, facts."""
        with self.listening(topics) as arrivals:
            self._drive(1.5, pose_rate)
            self.facts.clear()
            before = {name: len(times) for name, times in arrivals.items()}
            begin = time.monotonic()
            self._drive(seconds, pose_rate)
            elapsed = time.monotonic() - begin
            rates = {name: (len(t) - before[name]) / elapsed for name, t in arrivals.items()}
        facts = self.facts[1:] or self.facts
        mean = lambda key: float(np.mean([float(f[key]) for f in facts]))  # noqa: E731
        return {
            "factor": mean("real_time_factor"),
            "step": mean("step_time_ms"),
            "particles": rates.get("particles", 0.0),
            "surfaces": rates.get("surface_mesh", 0.0),
            "facts": facts[-1],
        }

    def _drive(self, seconds, pose_rate):
        last = time.monotonic()
        end = last + seconds
        while last < end:
            if pose_rate:
                # A node in slow motion would take this hand for one that is so much faster.
                pace = min(float(self.facts[-1]["real_time_factor"]), 1.0) if self.facts else 0.2
                center, radius, speed = self.circle
                self.angle += pace * speed / radius * (time.monotonic() - last)
                turned = np.array([np.cos(self.angle), np.sin(self.angle), 0.0])
                self.send(center + radius * turned)
            last = time.monotonic()
            time.sleep(1.0 / (pose_rate or 10.0))

    def latencies(self, count):
        """Seconds until the ball begins to move and until it has arrived, (count, 2)."""
        heights, ready = [], threading.Condition()

        def look(buffer):
            ball = next(m for m in cdr_to_markers(buffer) if m.namespace == "ball")
            with ready:
                heights.append((time.monotonic(), ball.position[2]))
                ready.notify()

        subscription = self.node.create_subscription(
            MarkerArray, "/fluid/solids", look, QoSProfile(depth=2), raw=True
        )
        *place, height = self.circle.center
        self.send((*place, height))
        time.sleep(1.0)
        result, old = [], height
        for number in range(count):
            new = height + (0.002 if number % 2 == 0 else 0.0)
            time.sleep(0.2 + 0.0137 * (number % 7))  # not in step with the publications
            with ready:
                heights.clear()
            sent = time.monotonic()
            self.send((*place, new))
            moments = []
            for goal in (lambda z, old=old: abs(z - old) > 1e-5, lambda z: abs(z - new) < 1e-5):  # noqa: B023
                with ready:
                    ready.wait_for(lambda goal=goal: any(goal(z) for _, z in heights), 5.0)
                    moments.append(next((t for t, z in heights if goal(z)), np.nan) - sent)
            result.append(moments)
            old = new
        self.node.destroy_subscription(subscription)
        return np.array(result)


def start_node(scene, **parameters):
    parameters = {"scene": scene, "max_catch_up": 0.1, **parameters}
    parameters = [f"{name}:={value}" for name, value in parameters.items()]
    arguments = [text for p in parameters for text in ("-p", p)]
    return subprocess.Popen(
        [sys.executable, "-m", "sph_ros.nodes.fluid_node", "--ros-args", "--log-level", "error",
         *arguments]
    )  # fmt: skip


@contextmanager
def running(bench, scene, **parameters):
    bench.circle = CIRCLES[scene]
    process = start_node(scene, **parameters)
    try:
        deadline = time.monotonic() + 180.0
        while not bench.hand.get_subscription_count():
            if process.poll() is not None or time.monotonic() > deadline:
                raise SystemExit("fluid_node did not start")
            time.sleep(0.05)
        yield
    finally:
        process.terminate()
        process.wait(10.0)


def print_latencies(bench, scene, poses):
    """Measure and print the latencies of a node that runs."""
    bench.facts.clear()
    latencies = 1e3 * bench.latencies(poses)
    lengths = [(float(f["step_time_ms"]), 1e3 * float(f["time_step"])) for f in bench.facts[1:]]
    step = max(np.median(lengths, axis=0))
    print(f"{scene}, latency at speed 1 [ms]: two steps and 5 ms are {2.0 * step + 5.0:.1f}")
    for label, column in zip(("until it moves", "until it is there"), latencies.T, strict=True):
        column = column[np.isfinite(column)]
        median, most, nearly_all = np.percentile(column, [50, 90, 99])
        print(
            f"  {label:20} median {median:6.1f}   90 % {most:6.1f}   99 % {nearly_all:6.1f}"
            f"   ({len(column)} poses)",
            flush=True,
        )
    inside = [float(f["pose_latency_ms"]) for f in bench.facts[1:]]
    # Of n poses in a second all are fast where the longest is: a share of 0.99^n.
    nearly_all = np.percentile(inside, 100.0 * 0.99 ** (poses / len(inside)))
    longest = np.percentile(inside, 99)
    print(
        f"  in the node          99 % of the poses {nearly_all:.1f}, of the longest of each second "
        f"{longest:.1f}   ({len(inside)} seconds)",
        flush=True,
    )


def measure_loads(bench, scene, seconds):
    """Measure and print how fast a scene runs under each load."""
    print(f"{scene}: real-time factor that is possible, {os.cpu_count()} cores")
    print(f"{'':24}{'factor':>8}{'step ms':>9}{'clouds Hz':>11}{'surfaces Hz':>13}")
    with running(bench, scene, speed=100.0, surface_rate=15.0):
        for name, topics, pose_rate in LOADS:
            row = bench.load(topics, pose_rate, seconds)
            print(
                f"{name:24}{row['factor']:8.2f}{row['step']:9.2f}"
                f"{row['particles']:11.1f}{row['surfaces']:13.1f}",
                flush=True,
            )
    facts = row["facts"]
    print(
        f"{facts['particles']} particles, surface of {facts['surface_triangles']} triangles in "
        f"{float(facts['surface_time_ms']):.1f} ms, "
        f"{float(facts['skipped_time']):.0f} s left out (the speed is out of reach on purpose)"
    )
    parts = {k[10:-3]: float(v) for k, v in facts.items() if k.startswith("step_time_")}
    parts.pop("", None)
    print("ms per step: " + ", ".join(f"{k} {v:.2f}" for k, v in parts.items() if k))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    scenes = [scene for scene in CIRCLES if scene != SMALL]
    parser.add_argument("--scenes", nargs="+", default=scenes, choices=CIRCLES)
    parser.add_argument("--seconds", type=float, default=5.0, help="per load (5)")
    parser.add_argument("--poses", type=int, default=200, help="poses for the latency (200)")
    options = parser.parse_args()
    bench = Bench()
    try:
        for scene in options.scenes:
            measure_loads(bench, scene, options.seconds)
        for scene in [*options.scenes, SMALL]:
            with running(bench, scene, speed=1.0, publish_rate=500.0):
                print_latencies(bench, scene, options.poses)
    finally:
        bench.close()


if __name__ == "__main__":
    main()
