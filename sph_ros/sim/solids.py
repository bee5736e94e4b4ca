# SPDX-License-Identifier: Apache-2.0
"""The solids of a simulation: where they are, where they are told to go, and how they get there.

A solid never teleports. Told a pose it moves there in a straight line with a steady turn, no faster
than the scene's `max_solid_speed`, and the liquid feels every substep of the way. So a marker that
jumps, flips or is lost for a while makes a quick push but no splash.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from sph_ros.core.contacts import Motion
from sph_ros.core.distances import signed_distances
from sph_ros.core.sheets import CORNER_CONTACTS, sheet_distances
from sph_ros.core.wall_tables import POWERS
from sph_ros.sim import quaternions
from sph_ros.sim.bodies import Bodies
from sph_ros.sim.shapes import bounding_radius, display_mesh, pack_shapes
from sph_ros.sim.sheets import pack_sheets


class Waypoint(NamedTuple):
    """A pose to reach: time [s], position [m] (3,), quat_xyzw (4,), world frame."""

    time: float
    position: np.ndarray
    quat_xyzw: np.ndarray


#: Poses farther from the origin than this are a mistake [m].
FARTHEST = 1e4


def checked_pose(name, position, quat_xyzw, dimension=3):
    """Position and unit quaternion as float64 arrays of their own, read-only.

    Args:
        name: of the solid, for messages.
        position: [m], (3,).
        quat_xyzw: normalised here.
        dimension: in 2D a pose is reduced to what keeps the plane: y is 0, turns are about y.

    Raises:
        ValueError: a value is not finite or absurd, a shape is wrong, or the quaternion is zero.
    """
    place = np.array(position, dtype=np.float64)
    if place.shape != (3,) or not np.all(np.abs(place) <= FARTHEST):
        raise ValueError(
            f"{name}: position: expected three finite numbers [m] up to {FARTHEST:g}, "
            f"got {position!r}"
        )
    try:
        quat = quaternions.normalized(quat_xyzw)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    if dimension == 2:
        about_y = np.array([0.0, quat[1], 0.0, quat[3]])
        upright = np.linalg.norm(about_y) < 1e-6
        quat = quaternions.normalized([0.0, 0.0, 0.0, 1.0] if upright else about_y)
        place[1] = 0.0
    place.setflags(write=False)
    quat.setflags(write=False)
    return place, quat


class Solid:
    """One solid: its shape in its own frame, its pose in the world, its orders.

    Attributes:
        name, control, shape, color: from the scene.
        position: of its origin, world frame [m], (3,).
        quat_xyzw: world from solid, (4,).
        velocity, angular_velocity: world frame [m/s], [rad/s], (3,), over the last substep.
    """

    def __init__(self, spec, packed, sheets, index, dimension):
        """Args: the scene's SolidSpec, packed shapes and sheets, index among them, 2 or 3."""
        self.name = spec.name
        self.control = spec.control
        self.shape = spec.shape
        self.color = spec.color
        self._spec = spec
        self._packed, self._sheets = packed, sheets
        self._index = index
        self._dimension = dimension
        #: How far material reaches from the origin [m]; infinite for planes and containers.
        self.reach = bounding_radius(spec.shape)
        self.reset()

    def reset(self):
        """Back to the pose and the path of the scene."""
        self.position, self.quat_xyzw = checked_pose(
            self.name, self._spec.pose.position, self._spec.pose.quat_xyzw, self._dimension
        )
        self.velocity = np.zeros(3)
        self.angular_velocity = np.zeros(3)
        self._waypoints = deque(
            Waypoint(
                frame.time,
                *checked_pose(self.name, frame.position, frame.quat_xyzw, self._dimension),
            )
            for frame in self._spec.path
        )

    def place(self, position, quat_xyzw, velocity, angular_velocity):
        """Take a pose and velocities at once, all float64 arrays; for free solids."""
        for array in (position, quat_xyzw):
            array.setflags(write=False)
        self.position, self.quat_xyzw = position, quat_xyzw
        self.velocity, self.angular_velocity = velocity, angular_velocity

    def twin(self):
        """A solid in the same state, which orders and steps of this one do not change."""
        twin = object.__new__(Solid)
        twin.__dict__.update(self.__dict__, _waypoints=self._waypoints.copy())
        return twin

    def state(self):
        """What changes, as lists of numbers."""
        return {
            "position": self.position.tolist(),
            "quat_xyzw": self.quat_xyzw.tolist(),
            "velocity": self.velocity.tolist(),
            "angular_velocity": self.angular_velocity.tolist(),
            "waypoints": [
                [w.time, w.position.tolist(), w.quat_xyzw.tolist()] for w in self._waypoints
            ],
        }

    def set_state(self, state):
        """Inverse of `state`."""
        self.position, self.quat_xyzw = checked_pose(
            self.name, state["position"], state["quat_xyzw"]
        )
        self.velocity = np.array(state["velocity"])
        self.angular_velocity = np.array(state["angular_velocity"])
        self._waypoints = deque(
            Waypoint(time, *checked_pose(self.name, position, quat))
            for time, position, quat in state["waypoints"]
        )

    def mesh(self):
        """Triangles to draw, solid's frame: vertices (V, 3) float32 [m], triangles (T, 3) int32."""
        return display_mesh(self.shape)

    def signed_distance(self, points):
        """Distance of world points to the solid where it is now, negative inside the material.

        An open surface has no inside.

        Args:
            points: [m], (M, 3).

        Returns:
            [m], (M,) float32.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        local = quaternions.rotated_back(points - self.position, self.quat_xyzw)
        local = np.ascontiguousarray(local, dtype=np.float32)
        distance = np.empty(len(local), np.float32)
        sheet = self._sheets.sheet_of[self._index]
        if sheet >= 0:
            sheet_distances(self._sheets, sheet, local, distance)
        else:
            signed_distances(self._packed, self._index, local, distance)
        return distance

    def order(self, time, position, quat_xyzw):
        """Add a pose to reach. One that is not later than those known replaces them.

        Raises:
            ValueError: as `checked_pose`.
        """
        waypoint = Waypoint(time, *checked_pose(self.name, position, quat_xyzw, self._dimension))
        while self._waypoints and self._waypoints[-1].time >= waypoint.time:
            self._waypoints.pop()
        self._waypoints.append(waypoint)

    def distance_ahead(self, now, duration, liquid_reach):
        """How far a point of the solid would move in the next `duration` [s] without limit [m].

        Args:
            now: simulated time [s].
            duration: [s].
            liquid_reach: distance of the farthest particle from the world's origin [m]; what is
                farther of an endless solid moves nothing.
        """
        if not self._waypoints:
            return 0.0
        position, quat = self._wanted(now, now + duration)
        turn = quaternions.between(self.quat_xyzw, quat)
        return _length(position - self.position) + self._lever(liquid_reach) * _length(turn)

    def _lever(self, liquid_reach):
        """Distance from the origin up to which turning matters [m]."""
        return min(self.reach, liquid_reach + _length(self.position))

    def advance(self, now, duration, max_speed, liquid_reach):
        """Move on for `duration` [s] from `now`, no point of it faster than `max_speed` [m/s].

        Args:
            now: simulated time [s].
            duration: [s].
            max_speed: [m/s].
            liquid_reach: as in `distance_ahead`.

        Returns:
            The farthest that a point of it moved [m].
        """
        if not self._waypoints:
            self.velocity, self.angular_velocity = np.zeros(3), np.zeros(3)
            return 0.0
        position, quat = self._wanted(now, now + duration)
        shift = position - self.position
        turn = quaternions.between(self.quat_xyzw, quat)
        way = _length(shift) + self._lever(liquid_reach) * _length(turn)
        share = min(1.0, max_speed * duration / way) if way > 0.0 else 1.0
        if share == 1.0:
            self.position, self.quat_xyzw = position, quat
        else:
            self.position, self.quat_xyzw = checked_pose(
                self.name,
                self.position + share * shift,
                quaternions.turned(self.quat_xyzw, share * turn),
            )
        self.velocity = share * shift / duration
        self.angular_velocity = share * turn / duration
        end = now + duration
        while len(self._waypoints) > 1 and self._waypoints[0].time <= end:
            self._waypoints.popleft()
        if self._waypoints and self._waypoints[0].time <= end and share == 1.0:
            self._waypoints.popleft()
        return share * way

    def _wanted(self, now, time):
        """Pose at `time` on the straight way through the waypoints."""
        ahead = None
        for waypoint in self._waypoints:
            ahead = waypoint
            if waypoint.time > time:
                break
        if ahead is None:
            return self.position, self.quat_xyzw
        if ahead.time <= time:
            return ahead.position, ahead.quat_xyzw
        # On the way from here and now to the next waypoint that lies ahead.
        share = (time - now) / (ahead.time - now) if ahead.time > now else 1.0
        shift = share * (ahead.position - self.position)
        turn = share * quaternions.between(self.quat_xyzw, ahead.quat_xyzw)
        return self.position + shift, quaternions.turned(self.quat_xyzw, turn)


class Solids:
    """All solids of a scene, and their packed shapes and poses for the kernels.

    Attributes:
        packed: `PackedShapes`, for the kernels.
        sheets: `Sheets`, those solids that are open surfaces.
        slots: contacts that a particle can have at most.
        motion: `Motion`, poses at the start and the end of the present substep.
        travel: the farthest that a point of any solid moves in the present substep [m].
        bodies: the free ones among them, `Bodies`.
    """

    def __init__(self, scene, weights=POWERS):
        """Pack the shapes of `scene` and put the solids at their first poses.

        Args:
            scene: the scene.
            weights: of the solver, which walls act with (`core.wall_tables`).
        """
        specs = scene.solids
        self.packed = pack_shapes(
            [spec.shape for spec in specs],
            scene.support_radius,
            scene.spacing,
            scene.dimension,
            weights,
        )
        self.sheets = pack_sheets([spec.shape for spec in specs], scene.support_radius)
        self.slots = len(specs) + (CORNER_CONTACTS - 1) * len(self.sheets.solid)
        self._solids = {
            spec.name: Solid(spec, self.packed, self.sheets, index, scene.dimension)
            for index, spec in enumerate(specs)
        }
        self.bodies = Bodies(scene, list(self), self.packed)
        count = len(specs)
        self.motion = Motion(
            np.zeros((count, 3), np.float32),
            np.zeros((count, 3, 3), np.float32),
            np.zeros((count, 3), np.float32),
            np.zeros((count, 3, 3), np.float32),
        )
        self.reset()

    def __iter__(self):
        """Over the solids, in the scene's order."""
        return iter(self._solids.values())

    def __len__(self):
        """Number of solids."""
        return len(self._solids)

    @property
    def names(self):
        """Names in the scene's order."""
        return list(self._solids)

    def __getitem__(self, name):
        """The solid called `name`.

        Raises:
            KeyError: there is none; the message lists those there are.
        """
        try:
            return self._solids[name]
        except KeyError:
            raise KeyError(f"no solid {name!r} in this scene; it has {self.names}") from None

    def reset(self):
        """All solids back to the scene's poses."""
        for solid in self:
            solid.reset()
        self.bodies.reset()
        self.settle()

    def settle(self):
        """Take the present poses as those at the start and at the end of a substep."""
        self.travel = 0.0
        self._write_poses(self.motion.position, self.motion.rotation)
        self.motion.old_position[:] = self.motion.position
        self.motion.old_rotation[:] = self.motion.rotation

    def set_state(self, numbers):
        """Go on from a snapshot: `state` of each solid by name in `solids`, that of `bodies`."""
        for name, state in numbers["solids"].items():
            self[name].set_state(state)
        self.bodies.set_state(numbers["bodies"])
        self.settle()

    def distance_ahead(self, now, duration, max_speed, liquid_reach):
        """The farthest that a point of any solid would move in the next `duration` [s] [m].

        Solids that are driven are no faster than `max_speed` [m/s].
        """
        driven = max(
            (
                solid.distance_ahead(now, duration, liquid_reach)
                for solid in self
                if solid.control != "free"
            ),
            default=0.0,
        )
        driven = min(driven, max_speed * duration)
        return max(driven, self.bodies.farthest(duration).max()) if len(self.bodies) else driven

    def advance(self, now, duration, max_speed, liquid_reach):
        """Move all solids on for `duration` [s]; arguments as for one `Solid`."""
        self.motion.old_position[:] = self.motion.position
        self.motion.old_rotation[:] = self.motion.rotation
        ways = np.zeros(len(self))
        for index, solid in enumerate(self):
            if solid.control in ("topic", "path"):
                ways[index] = solid.advance(now, duration, max_speed, liquid_reach)
        self._driven_way = self.travel = float(ways.max(initial=0.0))
        if self._driven_way > 0.0:
            self._write_poses(self.motion.position, self.motion.rotation)
        if len(self.bodies):
            ways[self.bodies.solids] = self.bodies.farthest(duration)
            self.bodies.begin(duration, self.motion, ways)
            self._take_poses()

    def finish(self):
        """Take free bodies to where the liquid lets them.

        Returns:
            `Motion` from the poses during the substep to those at its end, and the farthest that a
            point of a solid moves on it [m].
        """
        if not len(self.bodies):
            still = self.motion
            return Motion(still.position, still.rotation, still.position, still.rotation), 0.0
        before = self.motion.position.copy(), self.motion.rotation.copy()
        way = self.bodies.finish()
        self._take_poses()
        return Motion(*before, self.motion.position, self.motion.rotation), way

    def _take_poses(self):
        """Let the substep end where the solids are now."""
        self._write_poses(self.motion.position, self.motion.rotation)
        self.travel = max(self._driven_way, float(self.bodies.ways().max(initial=0.0)))

    def _write_poses(self, position, rotation):
        for index, solid in enumerate(self):
            position[index] = solid.position
            rotation[index] = quaternions.to_matrix(solid.quat_xyzw)


def _length(vector):
    """Of one of three numbers; np.linalg.norm takes five times as long."""
    return math.sqrt(vector.dot(vector))
