# SPDX-License-Identifier: Apache-2.0
"""Filling the liquid of a scene with particles, and what can be wrong with it."""

import os
from pathlib import Path

import numpy as np

from sph_ros.core.distances import signed_distances
from sph_ros.sim.quaternions import to_matrix
from sph_ros.sim.shapes import Box, Capsule, Cylinder, Pose, Sphere, pack_shapes

#: Memory that a particle takes in all arrays of a simulation together, rounded up [bytes].
BYTES_PER_PARTICLE = 1000

# Where blocks overlap, a later block keeps only particles at least this far from earlier ones, in
# spacings: closer pairs would fly apart in the first step.
_NEAREST = 0.75


def fill_liquid(scene):
    """Particles of all liquid blocks: a cubic lattice in each block's own frame.

    The lattice is centred in the block and starts at least half a spacing from its faces; round
    shapes take the lattice points inside. A later block leaves out what an earlier one holds. The
    order is fixed: block by block, within a block x fastest, then y, then z.

    Args:
        scene: a Scene.

    Returns:
        (positions, velocities): (N, 3) float32 [m] and [m/s], scene's frame; in 2D y is 0.
    """
    positions, velocities, _ = fill_blocks(scene)
    return positions, velocities


def fill_blocks(scene):
    """What `fill_liquid` returns, and of which block each particle is, (N,) int."""
    positions, velocities, counts = np.zeros((0, 3)), np.zeros((0, 3)), []
    for index, block in enumerate(scene.liquid):
        points = _to_scene(_lattice(block.shape, scene), block.pose)
        if scene.dimension == 2:
            points[:, 1] = 0.0
        points = points[_is_new(points, positions, scene, index)]
        positions = np.concatenate([positions, points])
        velocity = np.array(block.velocity)
        if scene.dimension == 2:
            velocity[1] = 0.0
        velocities = np.concatenate(
            [velocities, velocity + _agitation(block, points, scene, index)]
        )
        counts.append(len(points))
    blocks = np.repeat(np.arange(len(counts)), np.array(counts, int))
    return np.ascontiguousarray(positions, np.float32), velocities.astype(np.float32), blocks


def families(scene, blocks):
    """Index into `scene.liquids` of particles by the block they are of, (N,) uint8."""
    found = np.array(scene.families, np.uint8)[blocks]
    for index, block in enumerate(scene.liquid):
        if block.share < 1.0:
            mixed = np.random.default_rng(index).permutation(np.flatnonzero(blocks == index))
            found[mixed[round(block.share * len(mixed)) :]] = 0
    return found


class Families:
    """Which of a scene's liquids a particle is of, by its id; for whoever has ids alone."""

    def __init__(self, scene):
        """Fill the scene's blocks once more; emitted particles are of the first liquid."""
        self._first = np.append(families(scene, fill_blocks(scene)[2]), np.uint8(0))

    def of(self, ids):
        """Index into `scene.liquids` of each, (N,) uint8."""
        return self._first[np.minimum(ids, len(self._first) - 1)]


def distances_to(shape, pose, points, scene):
    """Signed distance of points to a placed shape [m], negative inside the material.

    Args:
        shape: the shape.
        pose: of the shape's frame in the scene's frame.
        points: scene's frame [m], (N, 3).
        scene: for spacing, support radius and dimension.

    Returns:
        (N,) float32.
    """
    packed = pack_shapes([shape], scene.support_radius, scene.spacing, scene.dimension)
    local = np.ascontiguousarray((points - pose.position) @ to_matrix(pose.quat_xyzw), np.float32)
    distance = np.empty(len(local), np.float32)
    signed_distances(packed, 0, local, distance)
    return distance


def bounds(shape):
    """(lower, upper) corner of a liquid shape in its own frame [m]."""
    if isinstance(shape, Box):
        return np.array(shape.min), np.array(shape.max)
    half = {
        Sphere: lambda s: (s.radius, s.radius, s.radius),
        Cylinder: lambda s: (s.radius, s.radius, 0.5 * s.length),
        Capsule: lambda s: (s.radius, s.radius, s.radius + 0.5 * s.length),
    }[type(shape)](shape)
    return -np.array(half), np.array(half)


def initial_length(scene):
    """Largest extent of a block of liquid at the start [m]; 0 if there is none."""
    sides = [upper - lower for lower, upper in (bounds(block.shape) for block in scene.liquid)]
    if scene.dimension == 2:
        sides = [side[[0, 2]] for side in sides]
    return max((float(side.max()) for side in sides), default=0.0)


def lattice_counts(shape, scene):
    """Lattice points along x, y, z that the bounding box of a liquid shape holds, as floats."""
    lower, upper = bounds(shape)
    counts = np.floor((upper - lower) / scene.spacing + 1e-6)
    if scene.dimension == 2:
        counts[1] = 1.0
    return counts


def estimated_particle_count(scene):
    """Particles of the start without making them, an upper bound; float, for it may be huge."""
    return sum(float(np.prod(lattice_counts(block.shape, scene))) for block in scene.liquid)


def available_memory():
    """Memory that a new program can have [bytes], of the machine or of the container it is in."""
    limits = []
    try:
        text = Path("/proc/meminfo").read_text()
        limits.append(1024 * int(text.split("MemAvailable:")[1].split()[0]))
        group = Path("/sys/fs/cgroup")
        used = int((group / "memory.current").read_text())
        limits.append(int((group / "memory.max").read_text()) - used)
    except (OSError, IndexError, ValueError):  # not Linux, or no limit on the container
        pass
    return min(limits, default=os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))


def _lattice(shape, scene):
    """Lattice points inside a liquid shape, its own frame, (N, 3) float64."""
    lower, upper = bounds(shape)
    counts = lattice_counts(shape, scene).astype(int)
    start = 0.5 * (lower + upper) - 0.5 * (counts - 1) * scene.spacing
    axes = [first + scene.spacing * np.arange(n) for first, n in zip(start, counts, strict=True)]
    if scene.dimension == 2:
        axes[1] = np.zeros(1)
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    if isinstance(shape, Box):
        return points
    return points[distances_to(shape, Pose(), points, scene) <= 0.0]


def _is_new(points, earlier, scene, index):
    """Which points lie in none of the first `index` blocks, nor next to a particle of these."""
    new = np.ones(len(points), bool)
    for block in scene.liquid[:index]:
        new &= distances_to(block.shape, block.pose, points, scene) > 0.0
    if len(earlier) and len(points):
        from scipy.spatial import cKDTree  # slow to import, and few scenes have two blocks

        distance, _ = cKDTree(earlier).query(points, distance_upper_bound=scene.spacing)
        new &= distance > _NEAREST * scene.spacing
    return new


def _agitation(block, points, scene, index):
    """Random velocities of a block's particles, their mean zero [m/s], (N, 3)."""
    if block.agitation == 0.0 or not len(points):
        return np.zeros(points.shape)
    velocities = np.random.default_rng(index).normal(0.0, block.agitation, points.shape)
    if scene.dimension == 2:
        velocities[:, 1] = 0.0
    return velocities - velocities.mean(axis=0)


def _to_scene(points, pose):
    return points @ to_matrix(pose.quat_xyzw).T + pose.position
