# SPDX-License-Identifier: Apache-2.0
"""Make the meshes of the packaged scenes: `python scenes/meshes/make_meshes.py`. Lengths in metres.

glass.obj   a drinking glass, a body with an inside and an outside
cup.obj     a cup that is a single sheet of triangles with a handle, for `surface`
spoon.obj   a spoon that is a single sheet
"""

from pathlib import Path

import numpy as np
import trimesh

FOLDER = Path(__file__).parent


def revolved(profile, sections):
    """The surface that a line (K, 2) of radius and height sweeps around the z axis."""
    return trimesh.creation.revolve(np.array(profile, float), sections=sections)


def arc(centre, radius, first, last, count):
    """Points on an arc in the plane of a profile; angles in degrees from the radius axis."""
    angle = np.radians(np.linspace(first, last, count))
    return np.array(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def glass(radius=0.032, height=0.11, wall=0.005, base=0.01):
    """A glass that stands on z = 0: inner radius, height, thickness of the wall and of the base."""
    outer, top = radius + wall, height - 0.5 * wall
    rim = arc((radius + 0.5 * wall, top), 0.5 * wall, 0, 180, 7)
    corner = arc((radius - 0.008, base + 0.008), 0.008, 0, -90, 6)
    profile = [[0, 0], [outer, 0], *rim, *corner, [0, base]]
    return revolved(profile, 48)


def cup(radius=0.04, height=0.07):
    """A cup on z = 0 with a round foot and a lip that opens a little, and its handle."""
    foot = arc((radius - 0.015, 0.015), 0.015, -90, 0, 6)
    side = [[radius, 0.03], [radius, 0.045], [radius + 0.001, 0.06], [radius + 0.003, height]]
    bowl = revolved([[0, 0], [0.4 * radius, 0], *foot, *side], 40)
    bend = np.radians(np.linspace(-80, 80, 12))
    middle = np.stack([radius + 0.018 * np.cos(bend), 0.02 * np.sin(bend) + 0.035], axis=1)
    across = np.array([[-0.004, 0.0], [0.004, 0.0]])
    points = np.array([[x, y, z] for x, z in middle for y, _ in across])
    rows = np.arange(len(middle) - 1)[:, None] * 2
    strip = np.concatenate([rows + [0, 1, 2], rows + [1, 3, 2]])
    return trimesh.util.concatenate([bowl, trimesh.Trimesh(points, strip, process=False)])


def spoon(length=0.03, width=0.02, depth=0.007, handle=0.05):
    """A spoon whose bowl is half an ellipsoid about the origin, open upwards, handle along x."""
    turn = np.radians(np.linspace(0, 360, 29)[:-1])
    rows = [np.array([[0.0, 0.0, -depth]])]
    for polar in np.radians(np.linspace(15, 90, 6)):
        ring = np.stack([np.cos(turn), np.sin(turn)], axis=1) * np.sin(polar)
        rows.append(np.column_stack([ring * [length, width], np.full(28, -depth * np.cos(polar))]))
    faces = [[0, 1 + (k + 1) % 28, 1 + k] for k in range(28)]
    for row in range(5):
        for k in range(28):
            a, b = 1 + 28 * row + k, 1 + 28 * row + (k + 1) % 28
            faces += [[a, b, a + 28], [b, b + 28, a + 28]]
    bowl = trimesh.Trimesh(np.concatenate(rows), faces, process=False)
    along = np.linspace(0.97 * length, length + handle, 8)
    rise = 0.02 * ((along - along[0]) / handle) ** 2
    edges = [[x, side * 0.003, z] for x, z in zip(along, rise, strict=True) for side in (-1, 1)]
    rows = np.arange(7)[:, None] * 2
    strip = np.concatenate([rows + [0, 2, 1], rows + [1, 2, 3]])
    return trimesh.util.concatenate([bowl, trimesh.Trimesh(edges, strip, process=False)])


def main():
    """Write all of them beside this file."""
    for name, make in (("glass", glass), ("cup", cup), ("spoon", spoon)):
        mesh = make()
        text = mesh.export(file_type="obj", header=None, digits=6, include_normals=False)
        (FOLDER / f"{name}.obj").write_text(text if text.endswith("\n") else text + "\n")
        print(f"{name}.obj: {len(mesh.faces)} triangles, closed: {mesh.is_watertight}")


if __name__ == "__main__":
    main()
