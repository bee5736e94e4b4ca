# SPDX-License-Identifier: Apache-2.0
"""Milliseconds of an augmented picture of 640 x 480 pixels by part, on one core.

python benchmarks/bench_overlay.py [--counts 1500 5000 20000] [--repeats 15]

Everything that ar_overlay does for a picture: the bytes of the camera's picture, of the particles
and of the solids in, the liquid's surface, the drawing, a raw and a JPEG picture out. Processor
time, which other programs disturb less than the time of day; the median of several pictures from a
camera that looks at a tank which fills much of the picture.
"""

import argparse
import os
import sys
import time

os.environ["NUMBA_NUM_THREADS"] = "1"  # before numba is loaded

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from msg_adapters.image import cdr_to_image, compressed_image_to_cdr, image_to_cdr  # noqa: E402
from msg_adapters.marker import markers_to_cdr, triangle_marker  # noqa: E402
from msg_adapters.point_cloud import particle_cloud_to_cdr  # noqa: E402
from sph_ros.colors import CONTAINER  # noqa: E402
from sph_ros.desk_video import DeskMotion, desk_camera  # noqa: E402
from sph_ros.nodes.overlay_liquid import LiquidStates  # noqa: E402
from sph_ros.render import overlay  # noqa: E402
from sph_ros.render.desk import Desk  # noqa: E402
from sph_ros.sim.shapes import Box, Sphere, display_mesh  # noqa: E402

EDGE, DEPTH = 0.2, 0.1

#: Functions that are timed, in their order.
PARTS = {
    "surface": (overlay, "_surface"),
    "solids": (overlay.Overlay, "_draw_solids"),
    "liquid": (overlay.Overlay, "_draw_liquid"),
    "light": (overlay.Overlay, "_room"),
    "water": (overlay, "draw_water"),
    "edges": (overlay, "soften_edges"),
}


class Parameters(dict):
    """What the node's parameters are."""

    def cards(self):
        """Side of the card on each solid [m]."""
        return {"ball": 0.112}


def wavy_water(count):
    """About `count` particles in a tank with waves (N, 3), and their spacing [m]."""
    spacing = (EDGE * EDGE * DEPTH / count) ** (1 / 3)
    axes = [np.arange(0.5 * spacing, length, spacing) for length in (EDGE, EDGE, 1.3 * DEPTH)]
    points = np.stack(np.meshgrid(*axes), -1).reshape(-1, 3)
    wave = np.sin(40.0 * points[:, 0]) * np.cos(30.0 * points[:, 1])
    points = points[points[:, 2] < DEPTH * (1.0 + 0.15 * wave)]
    points += np.random.default_rng(0).normal(0.0, 0.05 * spacing, points.shape)
    points[:, :2] -= 0.5 * EDGE
    return points.astype(np.float32), spacing


def messages(points, wand):
    """Particles and solids in CDR bytes."""
    velocities = np.zeros_like(points)
    velocities[:: max(1, len(points) // 100)] = 1.0  # some foam
    ids, densities = np.arange(len(points), dtype=np.uint32), np.ones(len(points), np.float32)
    half = 0.5 * EDGE
    tank = display_mesh(Box(min=(-half, -half, 0), max=(half, half, 2 * DEPTH)))
    markers = [
        triangle_marker(*tank, 0, "world", namespace="tank", color=CONTAINER),
        triangle_marker(
            *display_mesh(Sphere(0.03)),
            0,
            "world",
            namespace="ball",
            marker_id=1,
            color=(0.9, 0.3, 0.2, 1.0),
            position=(0.03, 0.0, DEPTH),
            quat_xyzw=wand.quat_xyzw,
        ),
    ]
    cloud = particle_cloud_to_cdr(points, velocities, densities, ids, 0, "world")
    return cloud, markers_to_cdr(markers)


def timed(function, spent, name):
    """`function`, whose processor time [ms] is appended to spent[name]."""

    def run(*arguments, **more):
        begin = time.process_time()
        result = function(*arguments, **more)
        spent.setdefault(name, []).append(1e3 * (time.process_time() - begin))
        return result

    return run


def report(count, repeats):
    """Measure and print one line."""
    camera, motion = desk_camera(), DeskMotion()
    points, spacing = wavy_water(count)
    cloud, solids = messages(points, motion.world_from_wand(3.0))
    view = motion.world_from_camera(3.0).inverse()
    picture = image_to_cdr(
        Desk(camera).take(view, motion.world_from_wand(3.0)), "bgr8", 0, "camera"
    )
    get = Parameters(boxes="wireframe", spacing=spacing, desk_height=0.0)
    states, drawing = LiquidStates(), overlay.Overlay(camera)
    originals = {name: getattr(*place) for name, place in PARTS.items()}
    spent = {}

    def whole():
        states.hear_solids(solids)
        pixels = cdr_to_image(picture).pixels
        result = drawing.draw(pixels, view, states.at(cloud, get).liquid)
        image_to_cdr(result, "bgr8", 0, "camera")
        data = cv2.imencode(".jpg", result, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
        compressed_image_to_cdr(data, "jpeg", 0, "camera")

    whole()
    for name, (owner, attribute) in PARTS.items():
        setattr(owner, attribute, timed(originals[name], spent, name))
    for _ in range(repeats):
        timed(whole, spent, "whole")()
    for name, (owner, attribute) in PARTS.items():
        setattr(owner, attribute, originals[name])
    medians = {name: float(np.median(values)) for name, values in spent.items()}
    rest = medians["whole"] - sum(medians[name] for name in PARTS)
    numbers = [*(medians[name] for name in PARTS), rest, medians["whole"]]
    line = f"{len(points):9d}" + "".join(f"{number:9.1f}" for number in numbers)
    print(f"{line}{1e3 / medians['whole']:9.0f}", flush=True)


def main():
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--counts", type=int, nargs="+", default=[1500, 5000, 20000])
    parser.add_argument("--repeats", type=int, default=15, help="pictures of each (15)")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    heads = [*PARTS, "rest", "whole", "per s"]
    print("particles" + "".join(f"{head:>9}" for head in heads) + "   [ms of one core]")
    for count in options.counts:
        report(count, options.repeats)
    return 0


if __name__ == "__main__":
    sys.exit(main())
