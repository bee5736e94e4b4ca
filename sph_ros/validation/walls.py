# SPDX-License-Identifier: Apache-2.0
"""Density of a resting liquid at a plane wall, a box's edge, a box's corner and a small ball.

The solver's own density is at rest wherever it believes to be; whether walls are right shows in how
many particles there really are. So the density here is counted: the sum of a smooth weight over
the particles divided by its integral over the room that is left to the liquid,

    rho(x) = m sum_j W(x - x_j) / integral of W(x - y) over all y that no solid takes and that lie
             below the surface.

The weight reaches three spacings. Points are looked at that lie one spacing from the solid, where
half of the weight is cut off by a plane wall, three quarters by an edge, seven eighths by a corner.
"""

import itertools

import numpy as np
from scipy.spatial import cKDTree

from sph_ros.validation.case import block, tank
from sph_ros.validation.rows import Curve, Plot, Row

SPACING = 0.0125
SIZE = (0.15, 0.15)
DEPTH = 0.125

#: Reach of the weight, and distance of the points from the solids [spacings].
REACH, APART = 3.0, 1.0


def densities(case):
    """Water that sloshed and came to rest in a box, around a ball of one support radius."""
    ball = 2 * SPACING
    place = np.array([0.075, 0.075, 0.06])
    sim = case.simulation(
        spacing=SPACING,
        material="water",
        # Poured in at two sides: at rest it is no longer the lattice of the start.
        liquid=[
            block([0, 0, 0], [0.0375, 0.15, 0.35]),
            block([0.1125, 0, 0], [0.15, 0.15, 0.15]),
        ],
        solids=[
            tank([0, 0, 0], [*SIZE, 0.45]),
            {"name": "ball", "sphere": {"radius": ball}, "pose": {"position": place.tolist()}},
        ],
    )
    case.run(sim, case.pick(4.0, 2.5), words="tank comes to rest")
    volume = sim.particle_count * SPACING**3 + 4 / 3 * np.pi * ball**3
    surface = volume / (SIZE[0] * SIZE[1])
    spots = _spots(sim, place, ball, surface)
    room = {name: _room(sim, points, surface) for name, points in spots.items()}
    found = {name: [] for name in spots}

    def look(sim):
        tree = cKDTree(sim.positions)
        for name, points in spots.items():
            found[name].append(_mass(tree, points) / room[name])

    case.run(sim, case.pick(0.6, 0.2), look, "densities at walls")
    return [_row(name, np.array(found[name])) for name in spots]


def _spots(sim, place, ball, surface):
    """Points one spacing from a plane wall, an edge, a corner and the ball [m], and inside."""
    apart = APART * SPACING
    far = REACH * SPACING
    low = np.array([apart, apart, apart])
    high = np.array([SIZE[0] - apart, SIZE[1] - apart])
    along = np.linspace(far, SIZE[0] - far, 7)
    up = np.linspace(far, min(surface - far, 0.09), 5)
    plane = [[x, side, z] for x in along for z in up for side in (low[1], high[1])]
    plane += [[side, y, z] for y in along for z in up for side in (low[0], high[0])]
    edge = [[x, side, low[2]] for x in along for side in (low[1], high[1])]
    edge += [[side, y, low[2]] for y in along for side in (low[0], high[0])]
    edge += [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in up]
    corner = [[x, y, low[2]] for x in (low[0], high[0]) for y in (low[1], high[1])]
    directions = np.array([d for d in itertools.product((-1, 0, 1), repeat=3) if any(d)], float)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return {
        "a plane wall": np.array(plane),
        "the edge of a box": np.array(edge),
        "the corner of a box": np.array(corner),
        "a ball of one support radius": place + (ball + apart) * directions,
    }


def _weight(distance):
    """A smooth weight that ends at REACH spacings, unnormalised."""
    q = np.minimum(distance / (REACH * SPACING), 1.0)
    return (1 - q) ** 2 * (1 + 2 * q)


def _mass(tree, points):
    """Sum of the weight over the particles, times the volume of one [m^3], per point."""
    near = tree.query_ball_point(points, REACH * SPACING)
    sums = [
        _weight(np.linalg.norm(tree.data[js] - p, axis=1)).sum()
        for p, js in zip(points, near, strict=True)
    ]
    return np.array(sums) * SPACING**3


def _room(sim, points, surface):
    """Integral of the weight over the room of the liquid, per point [m^3]."""
    fine = SPACING / 6
    steps = np.arange(-REACH * SPACING + 0.5 * fine, REACH * SPACING, fine)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    weights = _weight(np.linalg.norm(grid, axis=1))
    grid, weights = grid[weights > 0], weights[weights > 0]
    rooms = []
    for point in points:
        there = point + grid
        free = there[:, 2] < surface
        for name in sim.solid_names:
            free &= sim.solid(name).signed_distance(there) > 0
        rooms.append(weights[free].sum() * fine**3)
    return np.array(rooms)


def _row(name, found):
    """found: density over rest, (instants, points)."""
    mean = float(found.mean())
    plot = Plot(
        "point",
        "density [kg/m^3]",
        (
            Curve("rest", np.arange(found.shape[1]), np.full(found.shape[1], 1000.0), truth=True),
            Curve("measured", np.arange(found.shape[1]), 1000 * found.mean(axis=0)),
        ),
    )
    spread = 1000 * found.mean(axis=0).std()
    return Row(
        f"density at {name}",
        1000.0,
        1000 * mean,
        "kg/m^3",
        abs(mean - 1),
        0.03,
        f"points differ by {spread:.0f}",
        plot,
    )
