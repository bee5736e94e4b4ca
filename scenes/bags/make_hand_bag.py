# SPDX-License-Identifier: Apache-2.0
"""Make the packaged recordings: a hand that stirs with a ball, and one that pushes with a box.

    python scenes/bags/make_hand_bag.py [FOLDER]

No person was recorded. The motion is put together from what is known of hands: reaches of minimum
jerk (Flash & Hogan 1985, The coordination of arm movements), the tremor of 8 to 12 Hz that every
hand has, here below a millimetre, slow drift, and a tracker that jitters by milliseconds and once
loses the marker for 0.3 s. The same code gives the same files.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msg_adapters.bags import BagWriter
from msg_adapters.header import NANOSECONDS
from msg_adapters.pose import POSE_STAMPED, pose_to_cdr

TOPIC = "/hand/pose"
FRAME = "world"
START_NS = 1_700_000_000 * NANOSECONDS
RATE = 60.0  # [Hz]
# Angle by which a hand leans into its motion [rad per m/s].
LEAN = 0.3

Path3 = Callable[[np.ndarray], np.ndarray]  # progress (N,) from 0 to 1 -> positions (N, 3) [m]


def minimum_jerk(progress: np.ndarray) -> np.ndarray:
    """How far a reach has come, 0 to 1, after a share ``progress`` of its time."""
    return progress**3 * (10.0 + progress * (-15.0 + 6.0 * progress))


def reach(start: tuple, end: tuple) -> Path3:
    """Straight from one point to another."""
    start, end = np.array(start), np.array(end)
    return lambda progress: start + minimum_jerk(progress)[:, None] * (end - start)


def stir(start: tuple, center: tuple, turns: float, bob: float = 0.0) -> Path3:
    """Circles about a vertical axis through ``center``, up and down by ``bob`` twice a turn."""
    start, center = np.array(start), np.array(center)
    radius = np.linalg.norm(start[:2] - center)
    first = np.arctan2(*(start[:2] - center)[::-1])

    def path(progress: np.ndarray) -> np.ndarray:
        turned = 2.0 * np.pi * turns * minimum_jerk(progress)
        x = center[0] + radius * np.cos(first + turned)
        y = center[1] + radius * np.sin(first + turned)
        return np.stack([x, y, start[2] + bob * np.sin(2.0 * turned)], axis=1)

    return path


class Recording(NamedTuple):
    """What a hand does.

    Attributes:
        parts: (duration [s], path) one after the other, each starting where the last one ends.
        drop_out: moment at which the marker is lost and when it is seen again [s].
        seed: of tremor, drift and jitter.
    """

    parts: list[tuple[float, Path3]]
    drop_out: tuple[float, float]
    seed: int


def hand_stir() -> Recording:
    """Dips, stirs and swipes a ball of radius 0.03 m; water fills [0, 0.2] x [0, 0.2] x [0, 0.1] m.

    The marker is lost in the middle of stirring.
    """
    above, beside = (0.10, 0.10, 0.18), (0.135, 0.10, 0.06)
    left, right = (0.055, 0.10, 0.07), (0.145, 0.10, 0.07)
    front, back = (0.10, 0.055, 0.06), (0.10, 0.145, 0.06)
    high, deep = (0.10, 0.10, 0.19), (0.10, 0.10, 0.05)
    axis = (0.10, 0.10)
    stations = [
        (1.0, above), (0.8, (0.10, 0.10, 0.12)), (0.9, (0.10, 0.10, 0.06)),  # a slow dip
        (0.9, (0.10, 0.10, 0.16)), (0.7, (0.12, 0.09, 0.055)), (0.3, None), (0.6, beside),
        (4.0, stir(beside, axis, 3.0)), (2.2, stir(beside, axis, -2.0, bob=0.01)), (0.5, None),
        (1.0, (0.06, 0.06, 0.15)), (0.8, left),
        (0.25, right), (0.3, None), (0.22, left), (0.4, None),  # swipes
        (0.6, front), (0.3, back), (1.0, high), (0.45, deep), (0.4, None),  # and a plunge
        (1.2, above), (1.18, None),
    ]  # fmt: skip
    return Recording(joined(above, stations), (7.1, 7.4), 2009)


def hand_push() -> Recording:
    """Pushes a drop of radius 0.02 m at the origin with a box of 0.03 m that comes along x.

    First gently, then with a jerk; the marker is lost while the box draws back.
    """
    away, into, behind = (0.05, 0.0, 0.0), (-0.005, 0.0, 0.0), (-0.07, 0.004, 0.0)
    stations = [
        (0.5, away), (0.7, into), (0.6, None), (0.9, away), (0.5, None),
        (0.4, behind), (0.8, None), (1.2, (0.05, 0.01, 0.02)), (0.8, away), (0.6, None),
    ]  # fmt: skip
    return Recording(joined(away, stations), (2.1, 2.4), 2010)


RECORDINGS = {"hand_stir": hand_stir, "hand_push": hand_push}


def joined(start: tuple, stations: list) -> list[tuple[float, Path3]]:
    """Parts through stations (duration [s], point to reach, path, or None to stay)."""
    parts, here = [], start
    for duration, station in stations:
        if not callable(station):
            there = here if station is None else station
            parts.append((duration, reach(here, there)))
            here = there
        else:  # whole turns end where they began
            parts.append((duration, station))
    return parts


def intended_positions(parts: list, times: np.ndarray) -> np.ndarray:
    """Where the hand wants to be, (N, 3) [m], at ``times`` (N,) [s] from the start."""
    positions = np.empty((len(times), 3))
    begin = 0.0
    for duration, path in parts:
        inside = times >= begin  # later parts overwrite their own share
        positions[inside] = path(np.clip((times[inside] - begin) / duration, 0.0, 1.0))
        begin += duration
    return positions


def wobble(
    times: np.ndarray, rng: np.random.Generator, band: tuple[float, float], amplitude: float
) -> np.ndarray:
    """Six sines of random frequency [Hz] and phase on each axis, (N, 3), at most amplitude."""
    frequencies = rng.uniform(*band, size=(3, 6))
    phases = rng.uniform(0.0, 2.0 * np.pi, size=(3, 6))
    angles = 2.0 * np.pi * frequencies * times[:, None, None] + phases
    return amplitude / 6.0 * np.sin(angles).sum(axis=2)


def quaternions(rotation_vectors: np.ndarray) -> np.ndarray:
    """(N, 4) x y z w of rotations about (N, 3) axes by their length [rad]."""
    half = 0.5 * np.linalg.norm(rotation_vectors, axis=1, keepdims=True)
    return np.concatenate([0.5 * np.sinc(half / np.pi) * rotation_vectors, np.cos(half)], axis=1)


def hand_motion(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (N,), times of receipt (N,) [ns] from the start; positions (N, 3), quats (N, 4)."""
    rng = np.random.default_rng(recording.seed)
    duration = 0.0
    for part in recording.parts:  # sum() adds floats in another way from Python 3.12 on
        duration += part[0]
    times = np.arange(int(duration * RATE)) / RATE
    times[1:] += rng.uniform(-0.002, 0.002, len(times) - 1)
    delays = rng.uniform(0.002, 0.006, len(times))
    positions = intended_positions(recording.parts, times)
    step = 1e-4
    velocities = (intended_positions(recording.parts, times + step) - positions) / step
    positions += wobble(times, rng, (8.0, 12.0), 0.0005)  # tremor
    positions += wobble(times, rng, (0.05, 0.2), 0.002)  # drift
    leaning = LEAN * np.stack([-velocities[:, 1], velocities[:, 0], 0.0 * times], axis=1)
    rotations = quaternions(leaning + wobble(times, rng, (0.1, 0.5), 0.1))
    lost, found = recording.drop_out
    seen = (times < lost) | (times > found)
    stamps = np.round(times * 1e6).astype(np.int64) * 1000
    received = stamps + np.round(delays * 1e6).astype(np.int64) * 1000
    # Rounded to what a tracker resolves, so that another processor's last bit does not show.
    return stamps[seen], received[seen], positions.round(6)[seen], rotations.round(6)[seen]


def write_hand_bag(name: str, folder: str | Path, overwrite: bool = False) -> None:
    """Write a recording as a bag; BagError when one is there and not to be replaced."""
    with BagWriter(folder, overwrite=overwrite) as bag:
        for stamp, received, position, quat_xyzw in zip(
            *hand_motion(RECORDINGS[name]()), strict=True
        ):
            pose = pose_to_cdr(position, quat_xyzw, START_NS + int(stamp), FRAME)
            bag.write(TOPIC, POSE_STAMPED, START_NS + int(received), pose)


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for recording_name in RECORDINGS:
        write_hand_bag(recording_name, target / recording_name, overwrite=True)
