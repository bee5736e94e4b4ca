# SPDX-License-Identifier: Apache-2.0
"""Makes boat.ply, the hull of scene `floating_boat`: `python scenes/meshes/make_boat.py`.

An open boat with a round bottom, a pointed bow and a flat stern, all in metres. Its walls are 18 mm
thick: a liquid of 15 mm particles must not feel through them what is on the other side. The origin
lies amidships at the bottom; x is ahead, z is up.
"""

from pathlib import Path

import numpy as np
import trimesh

LENGTH, BEAM, DEPTH = 0.36, 0.168, 0.092
WALL, BOTTOM = 0.018, 0.020
#: Thickness of the stern, which balances the boat, and of the bow.
TRANSOM, STEM = 0.034, 0.024
#: The sides rise by so much towards the bow.
SHEER = 0.024
#: Of the superellipse of a section: 1 is a half circle, 0 a box.
ROUNDNESS = 0.55
#: Stations along the boat, points from gunwale to gunwale.
STATIONS, POINTS = 26, 22


def lines(part):
    """Half beam, keel's height and gunwale's height [m] at a part of the length, 0 astern."""
    ahead = np.maximum(part - 0.35, 0.0) / 0.65  # the last two thirds narrow towards the bow
    half_beam = 0.5 * BEAM * (1.0 - 0.9 * ahead**2.2)
    return half_beam, 0.35 * DEPTH * ahead**3, DEPTH + SHEER * ahead**2


def displaced(draft):
    """Volume of the outer form below a level waterline [m^3], and its centre along x [m]."""
    part = (np.arange(400) + 0.5) / 400
    height = draft * (np.arange(200) + 0.5)[:, None] / 200
    half_beam, keel, top = lines(part)
    down = np.clip((top - height) / (top - keel), 0.0, 1.0)
    width = 2.0 * half_beam * (1.0 - down ** (2.0 / ROUNDNESS)) ** (0.5 * ROUNDNESS)
    total = width.sum()
    x = LENGTH * ((width * part).sum() / total - 0.5)
    return total * LENGTH / 400 * draft / 200, x


def section(half_beam, bottom, top):
    """Points from the port gunwale round the bottom to the starboard one: (POINTS + 1, 2), y z.

    A superellipse: nearly a box at the sides, round at the bilge.
    """
    angle = np.linspace(0.0, np.pi, POINTS + 1)
    y = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** ROUNDNESS
    z = np.sin(angle) ** ROUNDNESS
    return np.stack([half_beam * y, top - (top - bottom) * z], axis=1)


def surface(stern, bow, inset, bottom):
    """Grid of points of one side of the hull, (STATIONS + 1, POINTS + 1, 3).

    Args:
        stern, bow: where it ends along x [m].
        inset: how far it lies inside the outer form [m].
        bottom: height of its lowest point amidships [m].
    """
    rows = []
    for part in np.linspace(0.0, 1.0, STATIONS + 1):
        x = stern + part * (bow - stern)
        half_beam, keel, top = lines(part)
        yz = section(half_beam * (1.0 - inset / (0.5 * BEAM)), bottom + keel, top)
        rows.append(np.column_stack([np.full(len(yz), x), yz]))
    return np.array(rows)


def skin(grid, first, inward):
    """Triangles of a grid and of the flat caps at its ends, and the caps' middles.

    Args:
        grid: from `surface`.
        first: index of its first vertex.
        inward: wind the other way.
    """
    stations, points = grid.shape[:2]
    index = first + np.arange(stations * points).reshape(stations, points)
    a, b = index[:-1, :-1].ravel(), index[1:, :-1].ravel()
    c, d = index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    middles = grid[[0, -1]].mean(axis=1)
    last = first + stations * points
    for end, (edge, middle) in enumerate(zip((index[0], index[-1]), (last, last + 1), strict=True)):
        around = np.concatenate([edge, edge[:1]])
        fan = np.stack([around[:-1], around[1:], np.full(points, middle)], axis=1)
        faces.append(fan if end == 0 else fan[:, ::-1])
    faces = np.concatenate(faces)
    return faces[:, ::-1] if inward else faces, middles


def outer_form():
    """The boat as a solid block, closed by a deck: what it pushes aside."""
    grid = surface(-0.5 * LENGTH, 0.5 * LENGTH, 0.0, 0.0)
    faces, middles = skin(grid, 0, inward=False)
    index = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
    port, starboard = index[:, 0], index[:, -1]
    deck = [
        np.stack([port[:-1], starboard[:-1], port[1:]], axis=1),
        np.stack([port[1:], starboard[:-1], starboard[1:]], axis=1),
    ]
    vertices = np.concatenate([grid.reshape(-1, 3), middles])
    return trimesh.Trimesh(vertices, np.concatenate([faces, *deck]), process=False)


def hull():
    """The boat: outer and inner skin joined along the gunwale."""
    outer = surface(-0.5 * LENGTH, 0.5 * LENGTH, 0.0, 0.0)
    inner = surface(-0.5 * LENGTH + TRANSOM, 0.5 * LENGTH - STEM, WALL, BOTTOM)
    count = outer.shape[0] * outer.shape[1]
    outside, outer_middles = skin(outer, 0, inward=False)
    inside, inner_middles = skin(inner, count + 2, inward=True)
    index = np.arange(count).reshape(outer.shape[:2])
    other = index + count + 2
    faces = [outside, inside]
    # Round the gunwale: along port, across the bow, along starboard, across the stern.
    rim = np.concatenate([index[:, 0], index[::-1, -1]])
    lip = np.concatenate([other[:, 0], other[::-1, -1]])
    after, beyond = np.roll(rim, -1), np.roll(lip, -1)
    faces += [np.stack([rim, lip, after], axis=1), np.stack([after, lip, beyond], axis=1)]
    vertices = np.concatenate(
        [outer.reshape(-1, 3), outer_middles, inner.reshape(-1, 3), inner_middles]
    )
    return trimesh.Trimesh(vertices, np.concatenate(faces), process=False)


def main():
    """Write the mesh beside this script."""
    boat = hull()
    boat.fix_normals()
    if not (boat.is_watertight and boat.volume > 0.0):
        raise SystemExit("the hull is not closed")
    boat.export(Path(__file__).with_name("boat.ply"))


if __name__ == "__main__":
    main()
