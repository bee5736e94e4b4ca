# SPDX-License-Identifier: Apache-2.0
"""Milliseconds of the surface by part, beside pysplashsurf if it is installed, and of pictures.

python benchmarks/bench_surface.py [--counts 5000 20000 100000]
"""

import argparse
import time

import numpy as np

from sph_ros.core import surface
from sph_ros.render import Camera, Frame, SolidView, render

SPACING = 0.01


def wavy_tank(count):
    """A box of about `count` particles, a bit off their lattice, with waves and drops."""
    edge = round((count / 0.9) ** (1 / 3))
    axis = (np.arange(edge) + 0.5) * SPACING
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    rng = np.random.default_rng(0)
    width = edge * SPACING
    waves = np.sin(9 * points[:, 0] / width) * np.cos(7 * points[:, 1] / width)
    points = points[points[:, 2] < width * (0.9 + 0.06 * waves)]
    drops = rng.uniform(0.0, width, (count // 100, 3)) + [0.0, 0.0, width]
    points = np.concatenate([points + rng.normal(0, 0.05 * SPACING, points.shape), drops])
    return points.astype(np.float32), width


def best_ms(call, repeats=7):
    """The least of several runs after one to compile and warm up [ms]."""
    call()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return 1e3 * min(times)


def splashsurf_ms(positions):
    """The same surface by pysplashsurf [ms], or None; its lengths are multiples of the radius."""
    try:
        import pysplashsurf
    except ImportError:
        return None
    return best_ms(
        lambda: pysplashsurf.reconstruct_surface(
            positions,
            particle_radius=SPACING / 2,
            smoothing_length=2.0,
            cube_size=2.0,
            iso_surface_threshold=0.6,
        ),
        3,
    )


def box_mesh(width, height):
    """Vertices and triangles of a box from 0."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
    return corners * [width, width, height], np.array(triangles)


def report(count):
    """Measure and print one line."""
    positions, width = wavy_tank(count)
    lengths = (SPACING, 2 * SPACING)
    grid = surface._grid_around(positions, *lengths, SPACING, 3)
    field = surface.colour_field(positions, grid, *lengths)
    mesh = surface.extract_surface(positions, SPACING)
    whole = best_ms(lambda: surface.extract_surface(positions, SPACING))
    splat = best_ms(lambda: surface.colour_field(positions, grid, *lengths))
    march = best_ms(lambda: surface.march(field, grid))
    other = splashsurf_ms(positions)
    tank = SolidView("tank", *box_mesh(width, 2.0 * width), container=True)
    frame = Frame(positions, None, mesh, [tank], SPACING)
    camera = Camera.fit(*frame.bounds())
    pictures = [
        best_ms(lambda size=size, fine=fine: render(frame, camera, size, fine), 3)
        for size, fine in (((640, 480), 1), ((1280, 720), 1), ((1280, 720), 2))
    ]
    print(
        f"{len(positions):9d} {len(mesh.triangles):9d} {whole:9.1f} {splat:9.1f} {march:9.1f} "
        + (f"{other:12.1f} " if other else f"{'-':>12} ")
        + " ".join(f"{ms:9.0f}" for ms in pictures),
        flush=True,
    )


def main():
    """Print a table of milliseconds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--counts", type=int, nargs="+", default=[5000, 20000, 100000])
    print(
        "particles triangles   surface     field  marching pysplashsurf   640x480  1280x720 "
        "1280x720x2x2   [ms]"
    )
    for count in parser.parse_args().counts:
        report(count)


if __name__ == "__main__":
    main()
