# SPDX-License-Identifier: Apache-2.0
"""The paper's failure, cured: a drop pushed by a tracked box stays together as with true poses."""

import math

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from tracking_helpers import BALL, CAMERA, CAMERA_FROM_WORLD, FPS, WORLD, seen

from sph_ros.sim.scene import load_scene
from sph_ros.sim.simulation import Simulation
from sph_ros.tracking.motions import smooth_noise
from sph_ros.tracking.se3 import Pose, exp
from sph_ros.tracking.tracker import Tracker, TrackerSettings

SECONDS = 3.0
DROPPED, OUTLIERS = 0.10, 0.02


def push(times):
    """A hand that brings the box to the drop and kneads it: [world_from_box]."""
    rng = np.random.default_rng(5)
    approach = np.clip(times / 0.8, 0.0, 1.0)
    approach = approach**2 * (3.0 - 2.0 * approach)
    places = smooth_noise(times, rng, (0.3, 0.8), 0.0015)
    places[:, 0] += 0.05 - 0.019 * approach
    turns = exp(smooth_noise(times, rng, (0.3, 0.8), 0.03))
    return [Pose(turn, place) for turn, place in zip(turns, places, strict=True)]


def tracked(times, truth, filter):
    """The same as a camera sees it; a picture without a pose moves nothing."""
    rng = np.random.default_rng(11)
    tracker = Tracker(TrackerSettings(solids=(BALL,), world=WORLD, filter=filter))
    poses = []
    later = rng.permutation(np.arange(6, len(times)))  # not before there is a track
    wrong, later = np.split(later, [round(OUTLIERS * len(times))])
    dropped = later[: round(DROPPED * len(times))]
    for k, (time, pose) in enumerate(zip(times, truth, strict=True)):
        found = seen(WORLD, CAMERA_FROM_WORLD, rng)
        (box,) = seen(BALL, CAMERA_FROM_WORLD @ pose, rng)
        if k in wrong:
            box = box._replace(corners=box.corners + rng.uniform(-150, 150, 2))
        if k not in dropped:
            found.append(box)
        poses.append(tracker.track(found, CAMERA, time).solids["ball"].pose)
    return poses


def pushed_drop(times, poses):
    """Run `drop_box`; ids of particles no longer connected with the drop, and its centre [m]."""
    scene = load_scene("drop_box")
    sim = Simulation(scene)
    for time, pose in zip(times, poses, strict=True):
        if pose is not None:
            sim.move_solid("box", pose.position, pose.quat_xyzw, time=float(time))
    sim.advance(SECONDS)
    tree = cKDTree(sim.positions)
    pairs = tree.sparse_distance_matrix(tree, 2.0 * scene.spacing)
    _, labels = connected_components(pairs)
    left = labels != np.bincount(labels).argmax()
    return set(sim.ids[left].tolist()), sim.positions[~left].mean(axis=0)


def test_no_particle_leaves_the_drop_that_stays_with_true_poses():
    times = np.arange(round(SECONDS * FPS)) / FPS
    truth = push(times)
    filtered = tracked(times, truth, "kalman")
    left, centre = pushed_drop(times, truth)
    left_filtered, centre_filtered = pushed_drop(times, filtered)
    left_plain, centre_plain = pushed_drop(times, tracked(times, truth, "none"))
    print(f"left: {len(left)} true, {len(left_filtered)} filtered, {len(left_plain)} unfiltered")
    assert left_filtered <= left
    # A drop is pushed as far as the box, so it ends no farther off than the box was, here 6 mm.
    # Chance is less: rounding alone, as poses off by 0.01 mm show, moves its end by 0.2 to 0.9 mm,
    # other noise in the pictures by 0.3 to 2 mm.
    pairs = zip(filtered, truth, strict=True)
    farthest = max(math.dist(box.position, true.position) for box, true in pairs if box)
    assert farthest < 0.01
    assert np.linalg.norm(centre_filtered - centre) < farthest
    # The same pictures without filter throw the drop about, by 53 mm.
    assert left_plain - left or np.linalg.norm(centre_plain - centre) > 3.0 * farthest
