# SPDX-License-Identifier: Apache-2.0
"""fluid_node as its users meet it: a real process, heard and spoken to over real DDS."""

import math
import time
from collections import Counter

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_helpers import RosSession
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from msg_adapters.clock import clock_to_cdr
from msg_adapters.marker import DELETE, DELETE_ALL, TRIANGLE_LIST, cdr_to_marker, cdr_to_markers
from msg_adapters.mesh import cdr_to_mesh
from msg_adapters.point_cloud import cdr_to_particle_cloud
from msg_adapters.pose import pose_to_cdr
from msg_adapters.wrench import cdr_to_wrench
from sph_ros.core.surface import extract_surface
from sph_ros.nodes.drivers import ThreadDriver
from sph_ros.nodes.poses import OLDER_POSES_OF_A_RESTART, PoseGate, PoseRefusedError
from sph_ros.nodes.publications import Publications, SurfaceJob
from sph_ros.nodes.runner import Runner
from sph_ros.nodes.schedules import ClockSchedule, WallSchedule
from sph_ros.sim.scene import load_scene
from sph_ros.sim.simulation import Simulation

NODE = "sph_ros.nodes.fluid_node"
RATE = 50.0
UPRIGHT = (0.0, 0.0, 0.0, 1.0)

#: Some drops, and a ball far above them.
FALLING = {
    "solver": "none",
    "spacing": 0.02,
    "time_step": 0.003,
    "liquid": [{"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}}],
}
BALL = {
    "name": "ball",
    "sphere": {"radius": 0.025},
    "pose": {"position": [0, 0, 1]},
    "control": "topic",
}

SCENE = """
spacing: 0.02
time_step: 0.005
liquid:
  - box: {min: [0, 0, 0], max: [0.12, 0.12, 0.08]}
solids:
  - name: tank
    container:
      box: {min: [0, 0, 0], max: [0.12, 0.12, 0.3]}
  - name: ball
    sphere: {radius: 0.025}
    pose: {position: [0.06, 0.06, 0.16]}
    control: topic
  - name: cork
    sphere: {radius: 0.015}
    pose: {position: [0.02, 0.02, 0.11]}
    control: free
    density: 250
"""


@pytest.fixture(scope="module")
def scene_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "small_tank.yaml"
    path.write_text(SCENE)
    return path


class FluidClient:
    """A running fluid_node, what it published, and a hand that sends poses."""

    def __init__(self, ros, *parameters):
        self.ros = ros
        arguments = [text for p in parameters for text in ("-p", p)]
        self.particles = ros.collect(PointCloud2, "/fluid/particles", raw=True)
        self.wrenches = ros.collect(WrenchStamped, "/fluid/solids/ball/wrench", raw=True)
        self.surfaces = ros.collect(Marker, "/fluid/surface", raw=True)
        self.meshes = ros.collect(Mesh, "/fluid/surface_mesh", raw=True)
        self.solids = ros.collect(MarkerArray, "/fluid/solids", raw=True)
        self.reports = ros.collect(DiagnosticArray, "/diagnostics")
        self._hand = ros.node.create_publisher(PoseStamped, "/fluid/solids/ball/pose", 100)
        self.program = ros.start(NODE, "--ros-args", *arguments)
        ros.wait_for(lambda: self._hand.get_subscription_count(), 90.0, "for fluid_node")
        publishers = lambda topic: len(ros.node.get_publishers_info_by_topic(topic))  # noqa: E731
        ros.wait_for(lambda: publishers("/diagnostics") and publishers("/fluid/surface_mesh"))

    def send(self, position, stamp=0.0, quat_xyzw=UPRIGHT, frame="world"):
        self.send_bytes(pose_to_cdr(position, quat_xyzw, round(stamp * 1e9), frame))

    def send_bytes(self, data):
        self._hand.publish(data)

    def turn(self, *args, **kwargs):
        """Lockstep: a pose, then the one publication that answers it."""
        before = len(self.particles)
        self.send(*args, **kwargs)
        self.ros.wait_for(lambda: len(self.particles) > before, what="for particles")
        return self.particles[before]

    def trigger(self, name):
        return self.ros.call(Trigger, f"/fluid/{name}", Trigger.Request())

    def pause(self, paused):
        return self.ros.call(SetBool, "/fluid/pause", SetBool.Request(data=paused))

    def set_number(self, name, value):
        number = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
        request = SetParameters.Request(parameters=[Parameter(name=name, value=number)])
        return self.ros.call(SetParameters, "/fluid/set_parameters", request).results[0]

    def set_scene(self, name):
        text = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(name))
        request = SetParameters.Request(parameters=[Parameter(name="scene", value=text)])
        return self.ros.call(SetParameters, "/fluid/set_parameters", request).results[0]

    def number(self, name):
        request = GetParameters.Request(names=[name])
        return self.ros.call(GetParameters, "/fluid/get_parameters", request).values[0].double_value

    def report(self, condition=lambda fluid, ball: True, start=None):
        """Next diagnostics that meet a condition: (level, values) of the fluid and of the ball.

        With `start`, those from that one on.
        """
        start = len(self.reports) if start is None else start

        def find():
            for array in self.reports[start:]:
                by_name = {status.name: status for status in array.status}
                pair = [by_name["fluid: simulation"], by_name["fluid: solid ball"]]
                fluid, ball = ({v.key: v.value for v in status.values} for status in pair)
                if condition(fluid, ball):
                    return pair[0].level, fluid, pair[1].level, ball
            return None

        return self.ros.wait_for(find, what="for diagnostics")


def stir(step):
    """A hand's position [m] and its stamp [s] at a step of the lockstep."""
    angle = 0.3 * step
    x, y = 0.06 + 0.02 * math.cos(angle), 0.06 + 0.02 * math.sin(angle)
    return (x, y, max(0.05, 0.16 - 0.01 * step)), 100.0 + step / RATE


# ---------------------------------------------------------------- lockstep, one process for all


@pytest.fixture(scope="module")
def lockstep(scene_path):
    with RosSession("hand") as ros:
        client = FluidClient(
            ros,
            f"scene:={scene_path}",
            "step_mode:=lockstep",
            f"publish_rate:={RATE}",
            "surface_rate:=25.0",
        )
        yield client
        assert client.program.running, client.program.output


@pytest.fixture
def fresh(lockstep):
    """The lockstep node, back at its start, its messages forgotten."""
    assert lockstep.trigger("reset").success
    for messages in (lockstep.particles, lockstep.wrenches, lockstep.surfaces, lockstep.meshes):
        messages.clear()
    lockstep.solids.clear()
    return lockstep


def test_one_pose_is_one_publication_and_equals_the_simulation(fresh, scene_path):
    sim = Simulation(str(scene_path))
    for step in range(20):
        position, stamp = stir(step)
        cloud = cdr_to_particle_cloud(fresh.turn(position, stamp))
        sim.move_solid("ball", position, UPRIGHT, time=sim.time + 1.0 / RATE)
        wrench = np.zeros(6)
        for _ in range(4):  # 1 / RATE is four time steps
            sim.step()
            wrench += np.concatenate(sim.wrench("ball")) / 4.0
        assert cloud.header == (round(sim.time * 1e9), "world")
        assert np.array_equal(cloud.ids, np.arange(len(sim.positions)))
        assert np.array_equal(cloud.positions, sim.positions)
        assert np.array_equal(cloud.velocities, sim.velocities)
        fresh.ros.wait_for(lambda n=step: len(fresh.wrenches) > n and len(fresh.solids) > n)
        heard = cdr_to_wrench(fresh.wrenches[step])
        assert heard[:2] == cloud.header
        assert np.allclose(heard.force + heard.torque, wrench, rtol=1e-12, atol=1e-12)
        _, ball, cork = cdr_to_markers(fresh.solids[step])
        assert ball.namespace == "ball" and np.allclose(ball.position, position, atol=1e-6)
        assert np.array_equal(cork.position, sim.solid("cork").position)
        assert np.array_equal(cork.quat_xyzw, sim.solid("cork").quat_xyzw)
    assert np.linalg.norm(wrench[:3]) > 1e-3  # the ball is in the water by now
    assert len(fresh.particles) == len(fresh.wrenches) == 20


def test_lockstep_repeats_to_the_byte(fresh):
    first = [fresh.turn(*stir(step)) for step in range(6)]
    assert fresh.trigger("reset").success
    assert [fresh.turn(*stir(step)) for step in range(6)] == first
    assert len(set(first)) == 6


def test_surface_is_closed_and_the_same_as_marker_and_mesh(fresh):
    for step in range(4):
        fresh.turn(*stir(step))
    fresh.ros.wait_for(lambda: len(fresh.meshes) >= 2 and len(fresh.surfaces) >= 2)
    assert len(fresh.meshes) == 2  # surface_rate is half of publish_rate
    marker = cdr_to_marker(fresh.surfaces[1])
    marker_time = (marker.stamp_ns, marker.frame_id)
    vertices, triangles = cdr_to_mesh(fresh.meshes[1])
    assert (marker.type, marker.frame_id, marker.color[3] > 0.0) == (TRIANGLE_LIST, "world", True)
    assert np.array_equal(marker.points, vertices[triangles].reshape(-1, 3))
    edges = Counter(map(tuple, triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()))
    assert all(edges[b, a] == count == 1 for (a, b), count in edges.items())
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
    assert 0.5 < volume / (0.12 * 0.12 * 0.08) < 1.5  # positive: outward
    cloud = next(c for c in map(cdr_to_particle_cloud, fresh.particles) if c.header == marker_time)
    expected = extract_surface(cloud.positions, 0.02, 0.04)
    assert np.array_equal(vertices, expected.vertices.astype(float))
    assert np.array_equal(triangles, expected.triangles)


BAD_POSES = {
    "malformed": b"\x00\x01\x00\x00garbage",
    "unknown_frame": pose_to_cdr((0.06, 0.06, 0.1), UPRIGHT, 0, "moon"),
    "not_finite": pose_to_cdr((0.06, math.nan, 0.1), UPRIGHT, 0, "world"),
    "zero_quaternion": pose_to_cdr((0.06, 0.06, 0.1), (0, 0, 0, 0), 0, "world"),
    "far_away": pose_to_cdr((0.06, 0.06, 1e30), UPRIGHT, 0, "world"),
    "stale": pose_to_cdr((0.06, 0.06, 0.1), UPRIGHT, round(99.9e9), "world"),
}


def test_bad_poses_are_refused_counted_and_survived(fresh):
    start = np.array([0.06, 0.06, 0.16])
    fresh.turn(start, 100.0)
    before = fresh.report()[3]
    for number, bad in enumerate(BAD_POSES.values(), start=2):
        fresh.send_bytes(bad)
        fresh.ros.wait_for(lambda n=number: len(fresh.particles) == n)
    counts = fresh.report()[3]
    for reason in BAD_POSES:
        assert int(counts[f"refused_{reason}"]) - int(before[f"refused_{reason}"]) == 1, reason
    assert int(counts["poses_refused"]) - int(before["poses_refused"]) == len(BAD_POSES)
    fresh.ros.wait_for(lambda: len(fresh.solids) == len(fresh.particles))
    assert np.allclose(cdr_to_markers(fresh.solids[-1])[1].position, start, atol=1e-6)
    assert "pose refused" in fresh.program.output
    # A quaternion that is a little off is normalised, an empty frame is the scene's.
    fresh.turn(start, 100.1, quat_xyzw=(0.0, 0.0, 0.7, 0.72), frame="")
    fresh.ros.wait_for(lambda: len(fresh.solids) == len(fresh.particles))
    turned = cdr_to_markers(fresh.solids[-1])[1].quat_xyzw
    assert np.allclose(turned, np.array([0, 0, 0.7, 0.72]) / math.hypot(0.7, 0.72), atol=1e-6)


def test_poses_of_a_free_solid_are_refused_in_words(fresh):
    hand = fresh.ros.node.create_publisher(PoseStamped, "/fluid/solids/cork/pose", 1)

    def refusal():
        found = [
            s for array in fresh.reports for s in array.status if s.name == "fluid: solid cork"
        ]
        return found and found[-1].message

    try:
        fresh.ros.wait_for(refusal, what="for the refusal")
        assert "poses refused: it is free" in refusal()
        assert "cork: poses refused: it is free" in fresh.program.output
        assert hand.get_subscription_count() == 0  # nobody offers it for dragging
    finally:
        fresh.ros.node.destroy_publisher(hand)


def test_parameters_are_described_ranged_and_live(fresh):
    names = ["scene", "step_mode", "publish_rate", "material.density"]
    request = DescribeParameters.Request(names=names)
    described = fresh.ros.call(DescribeParameters, "/fluid/describe_parameters", request)
    assert all(d.description for d in described.descriptors)
    assert [d.read_only for d in described.descriptors] == [False, True, False, False]
    assert all(d.floating_point_range for d in described.descriptors[2:])
    for value in (1e9, math.nan, -1.0):
        refusal = fresh.set_number("material.density", value)
        assert not refusal.successful and "density" in refusal.reason
    fresh.turn(*stir(0))
    full = cdr_to_particle_cloud(fresh.particles[-1]).densities.mean()
    assert fresh.set_number("material.density", 500.0).successful
    fresh.turn(*stir(1))
    half = cdr_to_particle_cloud(fresh.particles[-1]).densities.mean()
    assert fresh.set_number("material.density", 1000.0).successful
    assert half == pytest.approx(0.5 * full, rel=0.05)


OTHER_SCENE = """
frame: bowl
spacing: 0.02
time_step: 0.005
material: honey
liquid:
  - box: {min: [0, 0, 0], max: [0.08, 0.08, 0.04]}
solids:
  - name: bowl
    container:
      box: {min: [0, 0, 0], max: [0.08, 0.08, 0.2]}
  - name: spoon
    capsule: {radius: 0.01, length: 0.04}
    pose: {position: [0.04, 0.04, 0.1]}
    control: topic
"""


def test_another_scene_takes_over_and_a_wrong_one_changes_nothing(fresh, scene_path, tmp_path):
    other = tmp_path / "bowl.yaml"
    other.write_text(OTHER_SCENE)
    before = cdr_to_particle_cloud(fresh.turn(*stir(0)))
    for wrong, reason in (("no_such_scene", "no_such_scene"), (other.parent, "")):
        refusal = fresh.set_scene(wrong)
        assert not refusal.successful and reason in refusal.reason and refusal.reason
    assert len(cdr_to_particle_cloud(fresh.turn(*stir(1))).ids) == len(before.ids)
    try:
        assert fresh.set_scene(other).successful
        # The new solid listens, the old one does not; the material is the new scene's.
        spoon = fresh.ros.node.create_publisher(PoseStamped, "/fluid/solids/spoon/pose", 10)
        count = fresh.ros.node.count_subscribers
        fresh.ros.wait_for(lambda: spoon.get_subscription_count() == 1)
        fresh.ros.wait_for(lambda: count("/fluid/solids/ball/pose") == 0)
        assert fresh.number("material.viscosity") == 8.0
        fresh.solids.clear()
        fresh.particles.clear()
        spoon.publish(pose_to_cdr((0.05, 0.04, 0.1), UPRIGHT, 0, "bowl"))
        fresh.ros.wait_for(lambda: fresh.particles and fresh.solids)
        cloud = cdr_to_particle_cloud(fresh.particles[0])
        assert cloud.header == (round(1e9 / RATE), "bowl") and len(cloud.ids) == 4 * 4 * 2
        first, *solids = cdr_to_markers(fresh.solids[0])
        assert first.action == DELETE_ALL
        assert [marker.namespace for marker in solids] == ["bowl", "spoon"]
    finally:
        assert fresh.set_scene(scene_path).successful
    assert fresh.number("material.viscosity") == 0.001
    fresh.ros.wait_for(lambda: fresh.ros.node.count_subscribers("/fluid/solids/ball/pose") == 1)


def test_pause_and_step_in_lockstep(fresh):
    refused = fresh.trigger("step")
    assert not refused.success and "not paused" in refused.message
    fresh.turn(*stir(0))
    assert fresh.pause(True).success
    paused = cdr_to_particle_cloud(fresh.turn(*stir(1)))
    assert paused.header == cdr_to_particle_cloud(fresh.particles[0]).header
    assert fresh.trigger("step").success
    fresh.ros.wait_for(lambda: len(fresh.particles) == 3)
    stepped = cdr_to_particle_cloud(fresh.particles[2]).header
    assert stepped.stamp_ns - paused.header.stamp_ns == round(0.005e9)
    assert fresh.pause(False).success
    running = cdr_to_particle_cloud(fresh.turn(*stir(2))).header
    assert running.stamp_ns - stepped.stamp_ns == round(1e9 / RATE)


# ---------------------------------------------------------------- realtime


@pytest.fixture(scope="module")
def realtime(scene_path):
    with RosSession("watcher") as ros:
        yield FluidClient(ros, f"scene:={scene_path}", "speed:=0.5")


def newest_stamp(client):
    return cdr_to_particle_cloud(client.particles[-1]).header.stamp_ns


def stamps(client):
    return [cdr_to_particle_cloud(data).header.stamp_ns for data in list(client.particles)]


def test_realtime_runs_by_itself_follows_the_hand_and_reports(realtime):
    realtime.ros.wait_for(lambda: len(realtime.particles) >= 10 and len(realtime.meshes) >= 3)
    seen = stamps(realtime)
    assert all(later > earlier for earlier, later in zip(seen, seen[1:], strict=False))
    goal = np.array([0.07, 0.06, 0.06])
    before = len(realtime.reports)
    realtime.send(goal, 5.0)
    ball = lambda: cdr_to_markers(realtime.solids[-1])[1].position  # noqa: E731
    realtime.ros.wait_for(lambda: np.allclose(ball(), goal, atol=1e-6), what="for the ball")
    felt = realtime.report(lambda fluid, ball: float(fluid["pose_latency_ms"]) > 0.0, before)
    assert float(felt[1]["pose_latency_ms"]) < 6e4
    _, fluid, _, hand = realtime.report(lambda fluid, ball: float(fluid["step_time_ms"]) > 0.0)
    assert (fluid["state"], fluid["step_mode"]) == ("running", "realtime")
    assert 0.0 < float(fluid["real_time_factor"]) < 0.7  # speed is 0.5
    assert float(fluid["wanted_factor"]) == 0.5
    assert int(fluid["particles"]) == 144 and int(fluid["lost_particles"]) == 0
    assert 0.0 <= float(fluid["mean_compression"]) <= float(fluid["max_compression"]) < 0.2
    assert {"step_time_neighbors_ms", "surface_time_ms"} <= set(fluid)
    assert 0.0 < float(hand["pose_age"]) < 60.0 and hand["poses_accepted"] == "1"


def test_realtime_pause_step_reset(realtime):
    assert realtime.pause(True).success
    assert realtime.report(lambda fluid, ball: fluid["state"] == "paused")[0] is not None
    seen = newest_stamp(realtime)
    assert realtime.trigger("step").success
    realtime.ros.wait_for(lambda: newest_stamp(realtime) == seen + round(0.005e9))
    assert realtime.trigger("reset").success
    realtime.ros.wait_for(lambda: newest_stamp(realtime) == 0)
    assert realtime.pause(False).success
    realtime.ros.wait_for(lambda: 0 < newest_stamp(realtime) < 10e9)


def test_realtime_takes_the_good_pose_among_bad_ones_and_counts_these(realtime):
    goal, before = np.array([0.05, 0.06, 0.07]), realtime.report()[3]
    realtime.send(goal, 100.0)
    for bad in BAD_POSES.values():
        realtime.send_bytes(bad)
    more = lambda ball, key: int(ball[key]) - int(before[key])  # noqa: E731
    counts = realtime.report(lambda _, ball: more(ball, "poses_refused") == len(BAD_POSES))[3]
    assert all(more(counts, f"refused_{reason}") == 1 for reason in BAD_POSES)
    ball = lambda: cdr_to_markers(realtime.solids[-1])[1].position  # noqa: E731
    realtime.ros.wait_for(lambda: np.allclose(ball(), goal, atol=1e-6), what="for the ball")
    assert "pose refused" in realtime.program.output
    # Those that wait when it starts over are of the time before; later ones may have any stamp.
    assert realtime.pause(True).success
    realtime.send((0.07, 0.06, 0.09), 101.0)
    taken = lambda _, ball: more(ball, "poses_accepted") == 2  # noqa: E731
    realtime.report(taken)
    assert realtime.trigger("reset").success and realtime.pause(False).success
    restarted = lambda: 0 < cdr_to_markers(realtime.solids[-1])[1].stamp_ns < 10e9  # noqa: E731
    realtime.ros.wait_for(restarted, what="for a step after the start")
    assert np.allclose(ball(), [0.06, 0.06, 0.16], atol=1e-6)
    realtime.send(goal, 1.0)
    realtime.ros.wait_for(lambda: np.allclose(ball(), goal, atol=1e-6), what="for the ball")


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_best_effort_publishers_are_heard(mode, request):
    client = request.getfixturevalue(mode)
    ros, before = client.ros, int(client.report()[3]["poses_accepted"])
    qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    hand = ros.node.create_publisher(PoseStamped, "/fluid/solids/ball/pose", qos)

    def heard():
        hand.publish(pose_to_cdr((0.06, 0.06, 0.2), UPRIGHT, round(1e12), "world"))
        return int(client.report()[3]["poses_accepted"]) > before

    ros.wait_for(hand.get_subscription_count)
    ros.wait_for(heard, what="for a best effort pose")
    ros.node.destroy_publisher(hand)


def test_interrupt_ends_cleanly_and_at_once(realtime):
    begin = time.monotonic()
    output = realtime.program.interrupt()
    assert realtime.program.returncode == 0, output
    assert time.monotonic() - begin < 5.0 and "Traceback" not in output


# ---------------------------------------------------------------- clock


def test_clock_mode_follows_the_clock_and_starts_over_when_it_jumps_back(scene_path):
    with RosSession("clock") as ros:
        clock = ros.node.create_publisher(Clock, "/clock", 10)
        client = FluidClient(ros, f"scene:={scene_path}", "step_mode:=clock", "use_sim_time:=true")
        ros.wait_for(clock.get_subscription_count)

        def reach(seconds):
            """Tick; the newest stamp is then within a time step of the clock."""
            wanted = round(seconds * 1e9)

            def near():
                clock.publish(clock_to_cdr(wanted))  # again and again: rclpy hears it best effort
                return client.particles and 0 <= wanted - newest_stamp(client) < 0.005e9

            ros.wait_for(near, what=f"for the clock to be {seconds}")

        reach(50.0)
        start = cdr_to_particle_cloud(client.particles[-1]).positions
        for tick in range(1, 11):
            reach(50.0 + 0.05 * tick)
        before = cdr_to_particle_cloud(client.particles[-1])
        assert not np.array_equal(before.positions, start)
        client.send((0.06, 0.06, 0.1), 50.5)
        reach(20.0)
        again = cdr_to_particle_cloud(client.particles[-1])
        assert np.array_equal(again.positions, start)
        reach(20.1)
        client.send((0.06, 0.06, 0.1), 20.1)  # older than 50.5, and right
        client.report(lambda fluid, ball: ball["poses_accepted"] == "2")
        output = client.program.terminate()
        assert client.program.returncode == 0, output
        assert "jumped back" in output


def test_clouds_grow_and_shrink_with_emitters_and_sinks(tmp_path):
    path = tmp_path / "fountain.yaml"
    path.write_text(
        SCENE
        + "emitters:\n  - {position: [0.03, 0.03, 0.2], radius: 0.02, speed: 1, until: 0.15}\n"
        + "sinks:\n  - {box: {min: [0.08, 0, 0], max: [0.12, 0.12, 0.12]}, from: 0.05}\n"
    )
    sim, counts = Simulation(str(path)), []
    with RosSession("drinker") as ros:
        client = FluidClient(ros, f"scene:={path}", "step_mode:=lockstep", f"publish_rate:={RATE}")
        for step in range(10):
            position, stamp = stir(step)
            cloud = cdr_to_particle_cloud(client.turn(position, stamp))
            sim.move_solid("ball", position, UPRIGHT, time=sim.time + 1.0 / RATE)
            for _ in range(4):
                sim.step()
            assert np.array_equal(cloud.ids, sim.ids)
            assert np.array_equal(cloud.positions, sim.positions)
            counts.append(len(cloud.ids))
    changes = np.diff(counts)
    assert changes.max() > 0 > changes.min() and max(sim.ids) >= 144


# ---------------------------------------------------------------- no liquid, mistakes, faults


def test_no_liquid_deletes_the_surface(scene_path):
    with RosSession("dry") as ros:
        surfaces = ros.collect(Marker, "/dry/surface", raw=True)
        meshes = ros.collect(Mesh, "/dry/surface_mesh", raw=True)
        publications = Publications(ros.node, Runner(str(scene_path), {}))
        publishers = [ros.node.count_publishers(f"/dry/{n}") for n in ("surface", "surface_mesh")]
        assert publishers == [1, 1]
        nothing = SurfaceJob(np.empty((0, 3), np.float32), 5, load_scene(str(scene_path)))
        ros.wait_for(lambda: publications.surface(nothing) == 0 and surfaces and meshes)
        marker = cdr_to_marker(surfaces[0])
        assert (marker.action, len(marker.points), marker.stamp_ns) == (DELETE, 0, 5)
        assert [len(part) for part in cdr_to_mesh(meshes[0])] == [0, 0]


@pytest.mark.parametrize(
    ("parameter", "expected"),
    [
        ("scene:=no_such_scene", "no_such_scene"),
        ("scene:=SCENE", "spacng"),
        ("step_mode:=warp", "step_mode: expected one of realtime, clock, lockstep"),
        ("publish_rate:=1e9", "publish_rate"),
        ("material.density:=water", "material.density"),
    ],
)
def test_mistakes_are_one_line_and_exit_status_1(parameter, expected, tmp_path):
    path = tmp_path / "wrong.yaml"
    path.write_text(SCENE.replace("spacing", "spacng"))
    with RosSession("mistake") as ros:
        program = ros.start(
            NODE, "--ros-args", "-p", parameter.replace("SCENE", str(path)), "--log-level", "warn"
        )
        output = program.wait()
    assert program.returncode == 1
    assert expected in output and "Traceback" not in output
    assert len(output.strip().splitlines()) == 1, output


@pytest.mark.parametrize("broken", ["step", "particles"])
def test_a_fault_stops_the_liquid_but_not_the_node(broken, scene_path, monkeypatch):
    from rclpy.parameter import Parameter as NodeParameter

    from sph_ros.nodes.fluid_node import FluidNode

    with RosSession("fault") as ros:
        reports = ros.collect(DiagnosticArray, "/diagnostics")
        ros.collect(PointCloud2, "/fluid/particles", raw=True)
        overrides = [NodeParameter("scene", value=str(scene_path))]
        node = ros.add(FluidNode(context=ros.context, parameter_overrides=overrides))

        def fail(_sim):
            raise ArithmeticError("the liquid exploded")

        monkeypatch.setattr(Simulation, broken, fail if broken == "step" else property(fail))
        level = lambda: reports and reports[-1].status[0].level  # noqa: E731
        ros.wait_for(lambda: level() == DiagnosticStatus.ERROR, what="for the error")
        assert "the liquid exploded" in reports[-1].status[0].message
        monkeypatch.undo()
        assert ros.call(Trigger, "/fluid/reset", Trigger.Request()).success
        ros.wait_for(lambda: level() != DiagnosticStatus.ERROR, what="for the recovery")
        assert node.get_name() == "fluid"


# ---------------------------------------------------------------- parts


def test_a_straggler_is_refused_but_a_looping_bag_starts_over():
    gate = PoseGate("ball", "world")

    def admitted(stamp):
        try:
            gate.admit(pose_to_cdr((0, 0, 0), UPRIGHT, round(stamp * 1e9), "world"), 0.0)
        except PoseRefusedError as error:
            assert error.reason == "stale"
            return False
        return True

    assert [admitted(t) for t in (10.0, 10.1, 9.0, 10.2, 10.15, 10.3, 0.0)] == [
        True, True, False, True, False, True, True,
    ]  # fmt: skip
    looped = [admitted(t / 10) for t in range(1, 8)]
    assert looped == [n >= OLDER_POSES_OF_A_RESTART for n in range(1, 8)]
    assert gate.refused["stale"] == 2 + OLDER_POSES_OF_A_RESTART - 1


def test_poses_in_other_frames_go_through_tf():
    from geometry_msgs.msg import Transform

    from sph_ros.nodes.frames import transformed

    quarter = math.sqrt(0.5)
    transform = Transform()
    transform.translation.x, transform.translation.z = 1.0, 2.0
    transform.rotation.z, transform.rotation.w = quarter, quarter  # x becomes y
    position, quat_xyzw = transformed(transform, (0.5, 0.0, 0.0), (0.0, 0.0, quarter, quarter))
    assert np.allclose(position, (1.0, 0.5, 2.0))
    assert np.allclose(quat_xyzw, (0.0, 0.0, 1.0, 0.0))

    def lookup(frame, stamp_ns, position, quat_xyzw):
        if frame != "hand":
            raise ValueError(f"no frame {frame}")
        return transformed(transform, position, quat_xyzw)

    gate = PoseGate("ball", "world", lookup)
    assert gate.admit(pose_to_cdr((0.5, 0, 0), UPRIGHT, 0, "/hand"), 0.0).position == position
    with pytest.raises(PoseRefusedError, match="no frame moon"):
        gate.admit(pose_to_cdr((0.5, 0, 0), UPRIGHT, 0, "moon"), 0.0)


def test_a_solid_is_never_there_before_the_next_pose_comes():
    """Poses of an even motion come unevenly; who is there early stops, and pushes anew."""
    runner, orders = Runner(load_scene({**FALLING, "solids": [BALL]}), {}), []
    driver = ThreadDriver(
        runner, WallSchedule(1.0, 0.1), lambda: [orders.pop(0) for _ in orders[:]], *3 * [None]
    )
    driver.smoothing_time = 0.1
    gate, ball, step = PoseGate("ball", "world"), runner.sim.solid("ball"), runner.sim.time_step
    arrivals = np.arange(200) / 60.0 + np.random.default_rng(5).uniform(-0.004, 0.004, 200)
    speeds, behind = [], []
    for arrival in arrivals:
        while runner.sim.time < arrival:
            driver.step_once()
            speeds.append(ball.velocity[0])
            behind.append(0.3 * runner.sim.time - ball.position[0])
        orders.append(gate.admit(pose_to_cdr((0.3 * arrival, 0, 1), UPRIGHT, 0, "world"), arrival))
    settled = len(speeds) // 4
    assert min(speeds[settled:]) > 0.1
    assert np.mean(speeds[settled:]) == pytest.approx(0.3, rel=0.02)
    assert max(behind[settled:]) < 0.3 * 0.05 + 0.3 * step  # all the same it is not 50 ms late


def test_a_slow_machine_forgets_what_it_could_not_do(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    schedule = WallSchedule(2.0, 0.1)
    now[0] = 0.03
    assert schedule.due(0.0, 0.01) == pytest.approx(0.06)
    schedule.passed(0.01)
    now[0] = 1.0
    assert schedule.due(0.01, 0.01) == pytest.approx(0.1)
    assert schedule.skipped == pytest.approx(2 * 1.0 - 0.01 - 0.1)


def test_clock_schedule_waits_catches_up_and_forgets():
    now = [0]
    schedule = ClockSchedule(lambda: now[0], 1.0)
    schedule.restart(0.0)
    assert schedule.due(0.0, 0.01) == 0.0  # the clock is not known yet
    now[0] = 7_000_000_000
    assert schedule.due(0.0, 0.01) == 0.0
    now[0] += 500_000_000
    assert schedule.due(0.0, 0.01) == 0.5
    assert schedule.stamp_ns(0.5) == now[0]
    now[0] += 3_000_000_000  # 3.5 s due, 1 s allowed
    assert schedule.due(0.0, 0.01) == pytest.approx(1.0)
    assert schedule.skipped == pytest.approx(2.5) and schedule.stamp_ns(1.0) == now[0]
    now[0] -= 20_000_000  # adjusted, not jumped
    assert schedule.due(1.0, 0.01) == pytest.approx(-0.02) and not schedule.jumped_back()
    now[0] -= 1_000_000_000
    assert schedule.due(1.0, 0.01) == 0.0 and schedule.jumped_back()
