# SPDX-License-Identifier: Apache-2.0
"""The tracker: milliseconds a picture, and the Kalman filter against One Euro and no filter.

python benchmarks/bench_tracking.py [--bags FOLDER] [--plot FILE] [--seconds 20]

Truth is a synthetic hand and, where FOLDER holds them, recorded trajectories: shifted, scaled to a
hand's reach, turns halved so that the marker stays in sight; not smoothed. Corners get 0.3 pixels
of noise; the second half of the table also loses 10 % of the pictures and has 2 % wild outliers.
"""

import argparse
import sys
import time
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from tracking_helpers import (  # noqa: E402
    BALL,
    CAMERA,
    CAMERA_FROM_WORLD,
    CENTRE,
    FPS,
    WORLD,
    errors,
    jitter,
    lag_in_frames,
    rms,
    seen,
    track_hand,
    truth_of_hand,
)

from msg_adapters.bags import BagError, read_poses  # noqa: E402
from sph_ros.tracking.detection import Detector  # noqa: E402
from sph_ros.tracking.se3 import Pose  # noqa: E402
from sph_ros.tracking.synthetic import Flaws, SyntheticCamera  # noqa: E402
from sph_ros.tracking.tracker import Tracker, TrackerSettings  # noqa: E402

BAGS = ("fr1_xyz_mocap_mcap", "fr1_xyz_rgbdslam_db3", "tumvi_room1_mcap")
FILTERS = ("none", "one_euro", "kalman")
PLOTTED = 15.0  # [s]
REACH = 0.05  # [m], standard deviation along the liveliest axis


def recorded_truth(path, seconds):
    """(times, [world_from_ball]) of a recorded hand, 30 a second."""
    poses = read_poses(path)
    stamps = (poses.stamps_ns - poses.stamps_ns[0]) * 1e-9
    keep = np.concatenate([[True], np.diff(stamps) > 0.0])
    stamps, places = stamps[keep], poses.positions[keep]
    turns = Rotation.from_quat(poses.quats_xyzw[keep])
    times = np.arange(int(min(seconds, stamps[-1]) * FPS)) / FPS
    places = np.column_stack([np.interp(times, stamps, axis) for axis in places.T])
    places = (places - places.mean(axis=0)) * (REACH / places.std(axis=0).max())
    turns = Slerp(stamps, turns)(times)
    relative = (turns * turns.mean().inv()).as_rotvec() * 0.5
    angles = np.linalg.norm(relative, axis=1, keepdims=True)
    relative *= np.minimum(1.0, 0.7 / np.maximum(angles, 1e-9))  # a marker seen from behind is none
    rotations = Rotation.from_rotvec(relative).as_matrix()
    return times, [
        Pose(r @ CENTRE.rotation, CENTRE.position + p)
        for r, p in zip(rotations, places, strict=True)
    ]


def row(times, truth, filter, moving=None, **disturbance):
    """One line of the table."""
    results = track_hand(times, truth, filter, **disturbance)
    off = errors(results, truth)
    far = np.linalg.norm(off[:, :3], axis=1)
    good = ~np.isnan(off[:, 0])
    places = np.array([r.pose.position for r, g in zip(results, good, strict=True) if g])
    true = np.array([p.position for p, g in zip(truth, good, strict=True) if g])
    still = "      -      -"
    if moving is not None:
        shift, turn = jitter(off, moving)
        still = f"{1e3 * shift:7.2f}{np.degrees(turn):7.2f}"
    return (
        f"{filter:10}{1e3 * rms(off[:, :3]):8.2f}{1e3 * np.nanmax(far):8.1f}"
        f"{np.degrees(rms(off[:, 3:])):8.2f}{still}{lag_in_frames(places, true):8.2f}"
    )


def find_sources(bags, seconds):
    """Name -> (times, truth, moving) of the synthetic hand and of the recordings that are there."""
    sources = {"synthetic hand": truth_of_hand(seconds)}
    for name in BAGS:
        try:
            sources[name] = (*recorded_truth(bags / name, seconds), None)
        except BagError as error:
            print(f"without {name}: {error}")
    return sources


def compare(sources):
    """Print the table."""
    head = "filter      rms mm  max mm rms deg  still mm/deg  lag frames"
    for text, disturbance in (("clean", {}), ("disturbed", {"drop": 0.1, "outliers": 0.02})):
        for name, (times, truth, moving) in sources.items():
            print(f"\n{name}, {text}, {times[-1]:.0f} s\n{head}")
            for filter in FILTERS:
                print(row(times, truth, filter, moving, **disturbance), flush=True)


def plot(path, sources):
    """Heights and errors of all filters, disturbed: the synthetic hand and the first recording."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = list(sources.items())[:2]
    figure, axes = plt.subplots(
        2, len(shown), figsize=(5 * len(shown), 5), sharex=True, squeeze=False, layout="constrained"
    )
    for (name, (times, truth, _)), (above, below) in zip(shown, axes.T, strict=True):
        part = times <= times[0] + PLOTTED
        times, truth = times[part], [p for p, keep in zip(truth, part, strict=True) if keep]
        heights = 1e3 * np.array([pose.position[2] for pose in truth])
        for filter, color in zip(FILTERS, ("0.7", "tab:orange", "tab:blue"), strict=True):
            results = track_hand(times, truth, filter, drop=0.1, outliers=0.02, seed=3)
            off = errors(results, truth)
            above.plot(times, heights + 1e3 * off[:, 2], color=color, lw=1, label=filter)
            below.semilogy(times, 1e3 * np.linalg.norm(off[:, :3], axis=1), color=color, lw=0.8)
        above.plot(times, heights, "k--", lw=0.8, label="truth")
        margin = 0.2 * np.ptp(heights) + 5.0
        above.set(title=name, ylim=(heights.min() - margin, heights.max() + margin))
        below.set_xlabel("time [s]")
    axes[0, 0].set_ylabel("height [mm]")
    axes[1, 0].set_ylabel("position error [mm]")
    axes[0, 0].legend(loc="upper right", fontsize="small")
    figure.savefig(path, dpi=90)
    print(f"plot: {path}")


def time_pictures(count=120):
    """Print milliseconds of processor time for pictures of 640 x 480 with two markers."""
    cv2.setNumThreads(1)
    times, truth, _ = truth_of_hand(count / FPS, reach=0.03)
    camera = SyntheticCamera(CAMERA, flaws=Flaws())
    pictures = [
        camera.take([(WORLD, CAMERA_FROM_WORLD), (BALL, CAMERA_FROM_WORLD @ pose)])
        for pose in truth
    ]
    rng = np.random.default_rng(0)
    corners = [
        seen(WORLD, CAMERA_FROM_WORLD, rng) + seen(BALL, CAMERA_FROM_WORLD @ pose, rng)
        for pose in truth
    ]
    print(f"processor time [ms] for 640 x 480 pixels, two markers, median of {count}")
    detector = Detector("DICT_4X4_50", [0, 1])
    print(f"  detection alone, whole picture   {_median(detector.detect, pictures):6.2f}")
    tracker = Tracker(TrackerSettings(solids=(BALL,), world=WORLD))
    moments = iter(times)
    milliseconds = _median(lambda c: tracker.track(c, CAMERA, next(moments)), corners)
    print(f"  poses and filters of both alone  {milliseconds:6.2f}")
    for text, interval in (("whole pictures", 0.0), ("regions of interest", 1.0)):
        tracker = Tracker(TrackerSettings(solids=(BALL,), world=WORLD, full_interval=interval))
        stamps = iter(np.arange(1, count + 1) * 33_333_333)
        process = lambda p: tracker.process(p, int(next(stamps)), CAMERA)  # noqa: B023, E731
        milliseconds = _median(process, pictures)
        print(
            f"  everything, {text:20} {milliseconds:6.2f}  = {3.0 * milliseconds:.0f} % of a core"
        )


def _median(function, things):
    spent = []
    for thing in things:
        begin = time.process_time()
        function(thing)
        spent.append(1e3 * (time.process_time() - begin))
    return float(np.median(spent))


def main():
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = Path(__file__).resolve().parents[2] / "shared" / "data" / "bags"
    parser.add_argument("--bags", type=Path, default=default, help="folder of recordings")
    parser.add_argument("--plot", metavar="FILE", help="also write a plot")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each trajectory (20)")
    options = parser.parse_args()
    time_pictures()
    sources = find_sources(options.bags, options.seconds)
    compare(sources)
    if options.plot:
        plot(options.plot, sources)


if __name__ == "__main__":
    main()
