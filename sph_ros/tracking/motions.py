# SPDX-License-Identifier: Apache-2.0
"""Motions of a hand with a marker that are known exactly, to test trackers against."""

import numpy as np

from sph_ros.tracking.se3 import Pose, exp


def smooth_noise(times, rng, band, amplitude, count=8):
    """Sum of sines of random frequency in `band` [Hz], (N, 3), of deviation `amplitude`."""
    frequencies = rng.uniform(*band, (3, count))
    phases = rng.uniform(0.0, 2.0 * np.pi, (3, count))
    angles = 2.0 * np.pi * frequencies * np.asarray(times)[:, None, None] + phases
    return amplitude * np.sqrt(2.0 / count) * np.sin(angles).sum(axis=2)


def hand_motion(times, centre, seed=0, reach=0.06, tilt=0.3, rests=((0.0, 0.15), (0.55, 0.7))):
    """Poses of a hand that stirs, rests, and stirs again.

    Args:
        times: (N,) [s], increasing.
        centre: Pose about which it moves.
        seed: of the random motion.
        reach: standard deviation of the position along each axis [m].
        tilt: of the rotation about each axis [rad].
        rests: (begin, end) shares of the duration in which the hand is still.

    Returns:
        ([Pose], moving (N,) bool): moving is False where the hand is still.
    """
    times = np.asarray(times, float)
    rng = np.random.default_rng(seed)
    share = (times - times[0]) / max(times[-1] - times[0], 1e-9)
    rate = np.ones(len(times))
    for begin, end in rests:
        # Slows down and speeds up within 0.15 s, as hands do.
        ramp = 0.15 / max(times[-1] - times[0], 1e-9)
        rate *= 1.0 - np.clip(np.minimum(share - begin, end - share) / ramp + 1.0, 0.0, 1.0)
    steps = np.diff(times, prepend=times[0])
    own_time = np.cumsum(rate * steps)  # stands still while the hand does
    positions = smooth_noise(own_time, rng, (0.1, 1.2), reach)
    turns = smooth_noise(own_time, rng, (0.1, 0.8), tilt)
    rotations = exp(turns)
    poses = [
        Pose(rotation @ centre.rotation, centre.position + position)
        for rotation, position in zip(rotations, positions, strict=True)
    ]
    return poses, rate > 0.0
