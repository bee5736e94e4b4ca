# SPDX-License-Identifier: Apache-2.0
"""What the viewer shows and what it costs the simulation: processes, a client as the browser.

    python benchmarks/bench_viewer.py [--scene dam_break_large] [--speed 1] [--rounds 3]

The node runs in real time, as it does for people; with `--speed 100` it never waits, and whatever
anybody takes from it shows. Loads follow each other again and again, because other programs' load
on the machine changes more from minute to minute than the viewer costs: only factors of one round
are compared. The client is a process that reads all that a browser would be sent, and counts. A
slow one reads once a second. `others` is how many processors were busy with other programs: with
more than a few tenths, the shares say how the system divides its processors among many rather than
what the viewer costs.
"""

import argparse
import os
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from typing import NamedTuple

import msgspec
import numpy as np
import viser
import zstandard
from websockets.sync.client import connect

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))

import rclpy  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402
from shape_msgs.msg import Mesh  # noqa: E402

HELLO = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, -1.0, 0.5),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 480,
    "image_width": 640,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}

#: Particles and surface, as the viewer hears them.
TOPICS = {"particles": PointCloud2, "surface_mesh": Mesh}


def browse(port, pause):
    """A client in a browser's place: prints pictures per second of particles and surface, and MB.

    Layout of a message (viser.infra): the msgpack part's length, its compressed length (8 bytes
    each), itself compressed, and the arrays.
    """
    counts, size, begin = {"points": 0, "vertices": 0}, 0, None
    url, protocol = f"ws://127.0.0.1:{port}", f"viser-v{viser.__version__}"
    with connect(url, subprotocols=[protocol], max_size=None, compression=None) as socket:
        socket.send(msgspec.msgpack.encode(HELLO))
        while sys.stdin not in _readable():
            try:
                data = socket.recv(timeout=0.5)
            except TimeoutError:
                continue
            if begin is None:
                begin = time.monotonic()
                print("reading", flush=True)
            length = int.from_bytes(data[8:16], "little")
            window = msgspec.msgpack.decode(zstandard.decompress(data[16 : 16 + length]))
            for message in window["messages"]:
                for key in counts:
                    counts[key] += key in message.get("updates", ())
            size += len(data)
            time.sleep(pause)
        elapsed = time.monotonic() - begin
    print(counts["points"] / elapsed, counts["vertices"] / elapsed, size / elapsed / 1e6)


def _readable():
    import select

    return select.select([sys.stdin], [], [], 0.0)[0]


class Watch:
    """Watches a fluid node in this process."""

    def __init__(self):
        rclpy.init(args=[])
        self.node = rclpy.create_node("bench")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.facts, self.page = {}, {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._keep, 10)
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
                self.facts = {item.key: item.value for item in status.values}

    @contextmanager
    def listening(self):
        """Hear the topics that the viewer would hear, and do nothing with them."""
        subscriptions = [
            self.node.create_subscription(
                kind, f"/fluid/{name}", lambda _: None, QoSProfile(depth=2), raw=True
            )
            for name, kind in TOPICS.items()
        ]
        yield
        for subscription in subscriptions:
            self.node.destroy_subscription(subscription)

    def speed(self, seconds):
        """Simulated per real time, from the node's own clock of simulated time."""
        first = self._next_report()
        last = first
        while last[0] - first[0] < seconds:
            last = self._next_report()
        return (last[1] - first[1]) / (last[0] - first[0])

    def _next_report(self):
        old, deadline = self.facts, time.monotonic() + 20.0
        while self.facts is old:
            if time.monotonic() > deadline:
                raise SystemExit("the fluid node reports nothing")
            time.sleep(0.002)
        return time.monotonic(), float(self.facts["simulated_time"])


def start(module, *arguments, **more):
    return subprocess.Popen([sys.executable, "-m", module, *arguments], **more)


@contextmanager
def client(port, pause=0.0):
    """A browsing process; yields a function that ends it and returns what it counted."""
    process = subprocess.Popen(
        [sys.executable, __file__, "--browse", str(port), str(pause)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip

    def end():
        return [float(number) for number in process.communicate("\n")[0].split()]

    end.process = process

    try:
        process.stdout.readline()  # its start takes the processors, too
        yield end
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def cpu(process):
    """Processor time a process has used [s]."""
    with open(f"/proc/{process.pid}/stat") as stat:
        fields = stat.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def busy():
    """Processor time that all programs together have used [s]."""
    with open("/proc/stat") as stat:
        user, nice, system, _, _, *interrupts = map(int, stat.readline().split()[1:8])
    return (user + nice + system + sum(interrupts)) / os.sysconf("SC_CLK_TCK")


class Load(NamedTuple):
    """What was measured under one load; processors are mean numbers of busy ones."""

    speed: float
    fluid: float
    viewer: float
    others: float
    counts: list | None


def measure_load(watch, processes, seconds, end=None):
    """A Load; `end` ends the client and returns what it counted."""
    ours = (*processes, *([end.process] if end else []))
    before, all_before, begin = [cpu(p) for p in ours], busy(), time.monotonic()
    speed = watch.speed(seconds)
    elapsed = time.monotonic() - begin
    used = [(cpu(p) - b) / elapsed for p, b in zip(ours, before, strict=True)]
    others = max(0.0, (busy() - all_before) / elapsed - sum(used))
    return Load(speed, used[0], used[1], others, end() if end else None)


def measure(watch, processes, port, seconds):
    """One round: name of a load -> Load."""
    results = {"nobody looks": measure_load(watch, processes, seconds)}
    with watch.listening():
        time.sleep(1.0)
        results["a subscriber"] = measure_load(watch, processes, seconds)
    for name, pause in (("a browser", 0.0), ("a slow browser", 1.0)):
        with client(port, pause) as end:
            time.sleep(1.0)
            results[name] = measure_load(watch, processes, seconds, end)
        time.sleep(1.0)
    return results


def run(options):
    watch = Watch()
    parameters = (f"scene:={options.scene}", f"speed:={options.speed}", *options.set)
    arguments = [text for p in parameters for text in ("-p", p)]
    quiet = {"stdout": subprocess.DEVNULL}
    port = str(options.port)
    fluid = start("sph_ros.nodes.fluid_node", "--ros-args", "--log-level", "error", *arguments)
    viewer = start(
        "sph_ros.nodes.web_viewer", "--port", port, "--ros-args", "-p", "particles:=true", **quiet
    )
    try:
        deadline = time.monotonic() + 240.0
        while not watch.facts:
            if fluid.poll() is not None or time.monotonic() > deadline:
                raise SystemExit("fluid_node did not start")
            time.sleep(0.1)
        loads = watch, (fluid, viewer), port, options.seconds
        rounds = [measure(*loads) for _ in range(options.rounds)]
    finally:
        for process in (viewer, fluid):
            process.terminate()
            process.wait(10.0)
        watch.close()
    return watch.facts, rounds


def main():
    if sys.argv[1:2] == ["--browse"]:
        browse(int(sys.argv[2]), float(sys.argv[3]))
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="dam_break_large")
    parser.add_argument("--seconds", type=float, default=6.0, help="per load (6)")
    parser.add_argument("--rounds", type=int, default=3, help="of all loads (3)")
    parser.add_argument("--speed", type=float, default=1.0, help="wanted (1); 100: never waits")
    parser.add_argument("--port", type=int, default=8099)
    parser.add_argument("--set", nargs="*", default=[], help="more parameters of the node: a:=b")
    options = parser.parse_args()
    facts, rounds = run(options)
    print(
        f"{options.scene}: {facts['particles']} particles, {facts['surface_triangles']} triangles, "
        f"{os.cpu_count()} cores, {options.rounds} rounds of {options.seconds:g} s per load"
    )
    print(
        f"{'':16}{'speed':>7}{'share':>7}{'clouds Hz':>11}{'surfaces Hz':>13}{'MB/s':>7}   "
        "processors: fluid viewer others"
    )
    for name in rounds[0]:
        loads = [r[name] for r in rounds]
        speed, fluid, viewer, others = np.median([load[:4] for load in loads], axis=0)
        share = np.median([r[name].speed / r["nobody looks"].speed for r in rounds])
        counts = f"{'':31}"
        if loads[0].counts is not None:
            clouds, surfaces, size = np.median([load.counts for load in loads], axis=0)
            counts = f"{clouds:11.1f}{surfaces:13.1f}{size:7.1f}"
        print(f"{name:16}{speed:7.3f}{share:7.2f}{counts}{fluid:20.2f}{viewer:7.2f}{others:7.2f}")
    each = ", ".join(f"{r['a browser'].speed / r['nobody looks'].speed:.2f}" for r in rounds)
    print(f"share of the speed alone with a browser, round by round: {each}")


if __name__ == "__main__":
    main()
