# SPDX-License-Identifier: Apache-2.0
"""Free solids: rigid bodies moved by gravity, the liquid, each other and the walls.

A step begins with gravity and with the touches of the bodies, which gives the poses that the liquid
meets; what the liquid then does to the bodies is gathered, and the step ends at the poses that
follow from all of it. Linear and angular momentum are what is kept from step to step, so a body
that nothing touches keeps both exactly. Its orientation follows the angular velocity halfway
through the step (implicit midpoint rule), which holds its energy too.

Angular momentum is about the centre of mass. In 2D bodies move in the x-z plane and turn about y.
"""

import numpy as np

from sph_ros.core import impulses
from sph_ros.core.impulses import Inertias
from sph_ros.sim import quaternions
from sph_ros.sim.mass import mass_properties
from sph_ros.sim.touches import TouchFinder, no_touches

#: Touches are settled when none changes its velocity by more than this share of gravity's in a
#: step, or after so many passes.
TOLERANCE, PASSES = 1e-5, 60

#: Bodies bounce when they meet faster than gravity makes them in so many steps [-], and than this
#: [m/s].
BOUNCE_STEPS, BOUNCE_SPEED = 4.0, 0.01

#: Overlap that stays, in spacings, and the share of the rest that each substep takes away.
SLACK, PUSH_SHARE = 0.005, 0.25

#: Rounds of the fixed point iteration for the midpoint's angular velocity.
MIDPOINT_ROUNDS = 6


class Bodies:
    """All free solids of a scene; row b of every array is body b.

    Attributes:
        solids: index of each body among the solids, (B,).
        mass: [kg], in 2D per metre of depth, (B,).
        centre: of mass, world frame [m], (B, 3).
        quat_xyzw: world from solid, (B, 4).
        momentum: [kg m/s], (B, 3).
        spin: angular momentum, world frame [kg m^2/s], (B, 3).
        velocities: of the centres of mass and angular [m/s], [rad/s], (B, 6).
        free: velocities with all that pushed the bodies in this step but touches and the liquid's
            pressure, (B, 6).
        predicted: velocities that the poses during the step belong to, (B, 6).
        inertias: `Inertias` in this step.
        touches, touch_count: `Touches` in this step.
        tolerance: of settled touches in this step [m/s].
    """

    def __init__(self, scene, solids, packed):
        """Args: the scene; its solids, in order; their packed shapes."""
        self._solids = solids
        self._spacing = scene.spacing
        self._dimension = scene.dimension
        # Directions in which a body can move, and axes that it can turn about.
        plane = scene.dimension == 2
        self._moves = np.array([1.0, 0.0, 1.0]) if plane else np.ones(3)
        self._turns = np.array([0.0, 1.0, 0.0]) if plane else np.ones(3)
        self._gravity = np.array(scene.gravity) * self._moves
        self._finder = TouchFinder(scene, packed)
        self.body_of = self._finder.body_of
        self.solids = np.flatnonzero(self.body_of >= 0)
        self._specs = [scene.solids[index] for index in self.solids]
        self._reach = np.array([solids[index].reach for index in self.solids])
        self._weigh()
        self.reset()

    def __len__(self):
        """Number of free solids."""
        return len(self.solids)

    def _weigh(self):
        count = len(self._specs)
        self.mass = np.zeros(count)
        self._local_centre = np.zeros((count, 3))
        self._local_inertia = np.zeros((count, 3, 3))
        self._local_inverse = np.zeros((count, 3, 3))
        for b, spec in enumerate(self._specs):
            found = mass_properties(spec.shape, self._dimension, spec.density, spec.mass)
            self.mass[b], self._local_centre[b] = found.mass, found.centre
            if self._dimension == 2:
                self._local_inertia[b, 1, 1] = found.inertia[1, 1]
                self._local_inverse[b, 1, 1] = 1.0 / found.inertia[1, 1]
            else:
                self._local_inertia[b] = found.inertia
                self._local_inverse[b] = np.linalg.inv(found.inertia)

    # ---------------------------------------------------------------- state

    def reset(self):
        """Back to the poses and velocities of the scene; the solids must be there already."""
        count = len(self)
        self.quat_xyzw = np.zeros((count, 4))
        self.centre = np.zeros((count, 3))
        self.momentum, self.spin = np.zeros((count, 3)), np.zeros((count, 3))
        self.velocities = np.zeros((count, 6))
        for b, (index, spec) in enumerate(zip(self.solids, self._specs, strict=True)):
            solid = self._solids[index]
            rotation = quaternions.to_matrix(solid.quat_xyzw)
            self.quat_xyzw[b] = solid.quat_xyzw
            self.centre[b] = solid.position + rotation @ self._local_centre[b]
            turning = self._turns * spec.angular_velocity
            moving = self._moves * spec.velocity
            moving = moving + np.cross(turning, rotation @ self._local_centre[b])
            self.velocities[b] = *moving, *turning
            self.momentum[b] = self.mass[b] * moving
            self.spin[b] = rotation @ self._local_inertia[b] @ rotation.T @ turning
        self._known = {}
        self._rest()
        self._show()

    def _rest(self):
        """What a step keeps, as between steps."""
        count = len(self)
        self.free = self.velocities.copy()
        self.predicted = self.velocities.copy()
        self._taken = np.zeros((count, 6))
        self._before = self.velocities
        self._start = self.centre, self.quat_xyzw
        self._finished = True
        self._turn_inertias(self.quat_xyzw)
        self.touches, self.touch_count = no_touches(), 0
        self.tolerance = 0.0

    def state(self):
        """What changes, as lists of numbers."""
        names = ("centre", "quat_xyzw", "momentum", "spin", "velocities")
        return {"touches": self._known, **{name: getattr(self, name).tolist() for name in names}}

    def set_state(self, state):
        """Inverse of `state`."""
        arrays = dict(state)
        self._known = arrays.pop("touches")
        for name, rows in arrays.items():
            setattr(self, name, np.array(rows).reshape(getattr(self, name).shape))
        self._rest()
        self._show()

    def facts(self):
        """Momentum (3,) [kg m/s] and kinetic energy [J] of all bodies together."""
        energy = 0.5 * np.sum(self.momentum**2 / self.mass[:, None])
        energy += 0.5 * np.sum(self.spin * self.velocities[:, 3:])
        return self.momentum.sum(axis=0), float(energy)

    def _show(self):
        """Write poses and velocities to the solids."""
        for b, index in enumerate(self.solids):
            arm = -quaternions.to_matrix(self.quat_xyzw[b]) @ self._local_centre[b]
            moving, turning = self.velocities[b, :3], self.velocities[b, 3:]
            self._solids[index].place(
                self.centre[b] + arm,
                self.quat_xyzw[b].copy(),
                moving + np.cross(turning, arm),
                turning.copy(),
            )

    # ---------------------------------------------------------------- a step

    def farthest(self, duration):
        """How far a point of each body may get in the next `duration` [s] by itself [m], (B,)."""
        speed = np.linalg.norm(self.velocities[:, :3], axis=1)
        speed = speed + duration * np.linalg.norm(self._gravity)
        return duration * (speed + self._reach * np.linalg.norm(self.velocities[:, 3:], axis=1))

    def begin(self, duration, motion, ways):
        """Start a substep: gravity, touches, and the poses that the liquid will meet.

        Args:
            duration: [s].
            motion: `Motion`, the other solids' poses at its start and end.
            ways: how far points of the solids move in it, (S,) [m].
        """
        if not len(self):
            return
        self._duration = duration
        self._start = self.centre.copy(), self.quat_xyzw.copy()
        self._before = self.velocities
        self.momentum += duration * self.mass[:, None] * self._gravity
        turning, halfway = self._halfway(duration)
        self._turn_inertias(halfway)
        self.free = np.concatenate([self.momentum / self.mass[:, None], turning], axis=1)
        fall = duration * float(np.linalg.norm(self._gravity))
        self.tolerance = TOLERANCE * max(fall, 1e-4)
        self.touches, self.touch_count = self._finder.find(motion, ways, duration, self._known)
        impulses.ask_speeds(
            self.touches,
            self.touch_count,
            self.inertias,
            self.free,
            1.0 / duration,
            BOUNCE_STEPS * fall + BOUNCE_SPEED,
        )
        self.velocities = self._apart()
        self.predicted = self.velocities.copy()
        self._taken[:] = 0.0
        self._finished = False
        self._place(0.0)

    def take(self, reactions, centres=None):
        """Let the liquid push the bodies with what it did since the last call.

        Args:
            reactions: force [N] and torque [N m] of the liquid on each solid about its origin,
                where it is now, summed since the step began, (S, 6).
            centres: of mass where the forces acted [m], (B, 3); where they are now unless given.
        """
        change = self._duration * (reactions[self.solids] - self._taken)
        self._taken = reactions[self.solids].copy()
        change *= np.concatenate([self._moves, self._turns])
        origins = np.array([self._solids[index].position for index in self.solids])
        centres = self.centre if centres is None else centres
        change[:, 3:] += np.cross(origins - centres, change[:, :3])
        turning = np.einsum("bij,bj->bi", self.inertias.inverse_inertia, change[:, 3:])
        moved = np.concatenate([change[:, :3] / self.mass[:, None], turning], axis=1)
        if self._finished:
            self.momentum += change[:, :3]
            self.spin += change[:, 3:]
            self.velocities = self.velocities + moved
            self._show()
        else:
            self.free += moved

    def finish(self):
        """Take the poses and velocities that all pushes of this step lead to.

        Returns:
            The farthest that a point of a body moved on from its predicted pose [m].
        """
        if not len(self):
            return 0.0
        self.velocities = self._apart()
        self._finished = True
        self._known = self._finder.impulses(self.touches)
        self.momentum = self.mass[:, None] * self.velocities[:, :3]
        self.spin = np.einsum("bij,bj->bi", self._inertia, self.velocities[:, 3:])
        shifts = np.zeros_like(self.velocities)
        impulses.push_out(
            self.touches,
            self.touch_count,
            self.inertias,
            self.velocities,
            self._duration,
            SLACK * self._spacing,
            PUSH_SHARE,
            PASSES,
            shifts,
        )
        self._place(shifts)
        change = self._duration * (self.velocities - self.predicted) + shifts
        return float(self._ways(change).max())

    def ways(self):
        """How far points of the bodies moved since the step began, at most [m], (B,)."""
        change = np.zeros((len(self), 6))
        for b, (centre, quat) in enumerate(zip(*self._start, strict=True)):
            change[b, :3] = self.centre[b] - centre
            change[b, 3:] = quaternions.between(quat, self.quat_xyzw[b])
        return self._ways(change)

    def _ways(self, changes):
        turned = self._reach * np.linalg.norm(changes[:, 3:], axis=1)
        return np.linalg.norm(changes[:, :3], axis=1) + turned

    def velocities_now(self):
        """Velocities before gravity in a step that has begun, after all of it in one that ended."""
        return self.velocities if self._finished else self._before

    def _apart(self):
        """Velocities of the bodies after they have pushed each other."""
        result = self.free.copy()
        impulses.keep_apart(
            self.touches, self.touch_count, self.inertias, self.tolerance, PASSES, result
        )
        return result

    def _place(self, shifts):
        """Poses at the end of the step: from its start with the velocities, and shifts (B, 6)."""
        change = self._duration * self.velocities + shifts
        self.centre = self._start[0] + change[:, :3]
        for b, start in enumerate(self._start[1]):
            self.quat_xyzw[b] = quaternions.turned(start, change[b, 3:])
        self._show()

    # ---------------------------------------------------------------- for the coupling

    def roots(self):
        """Matrices L with L L^T the inverse of the mass matrix, (B, 6, 6)."""
        result = np.zeros((len(self), 6, 6))
        result[:, :3, :3] = np.sqrt(self.inertias.inverse_mass)[:, :, None] * np.eye(3)
        value, axes = np.linalg.eigh(self.inertias.inverse_inertia)
        result[:, 3:, 3:] = axes * np.sqrt(np.maximum(value, 0.0))[:, None, :]
        return result

    def mass_matrices(self):
        """Mass matrices of the velocities, (B, 6, 6); in 2D with zeros where nothing moves."""
        result = np.zeros((len(self), 6, 6))
        result[:, :3, :3] = self.mass[:, None, None] * np.diag(self._moves)
        result[:, 3:, 3:] = self._inertia
        return result

    def solve(self, matrices, right):
        """Velocities (B, 6) from M V = `right`; what does not exist in 2D stays 0."""
        used = np.concatenate([self._moves, self._turns])
        square = used[:, None] * used
        matrices = square * matrices + np.diag(1.0 - used)
        return np.linalg.solve(matrices, (used * right)[:, :, None])[:, :, 0]

    # ---------------------------------------------------------------- turning

    def _halfway(self, duration):
        """Angular velocities (B, 3) of the midpoint rule, and orientations (B, 4) halfway."""
        turning = np.empty((len(self), 3))
        halfway = self.quat_xyzw.copy()
        for b, start in enumerate(self.quat_xyzw):
            for done in range(MIDPOINT_ROUNDS + 1):
                inverse = self._turned(halfway[b], self._local_inverse[b])
                turning[b] = inverse @ self.spin[b]
                if done < MIDPOINT_ROUNDS:
                    halfway[b] = quaternions.turned(start, 0.5 * duration * turning[b])
        return turning, halfway

    def _turned(self, quat_xyzw, tensor):
        """A tensor (3, 3) of the solid's frame in the world's."""
        rotation = quaternions.to_matrix(quat_xyzw)
        return rotation @ tensor @ rotation.T

    def _turn_inertias(self, quats_xyzw):
        """Set `inertias`, and the tensors that belong to them, to orientations (B, 4)."""
        inverse = np.zeros((len(self), 3, 3))
        self._inertia = np.zeros((len(self), 3, 3))
        for b, quat in enumerate(quats_xyzw):
            inverse[b] = self._turned(quat, self._local_inverse[b])
            self._inertia[b] = self._turned(quat, self._local_inertia[b])
        per_mass = np.repeat(1.0 / self.mass, 3).reshape(-1, 3) * self._moves
        self.inertias = Inertias(self.centre.copy(), per_mass, inverse)
