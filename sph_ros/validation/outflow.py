# SPDX-License-Identifier: Apache-2.0
"""Water runs out through a hole: Torricelli with a contraction coefficient.

In two dimensions the hole is a slit in a flat floor. A jet from a slit that is narrow beside the
tank contracts to pi / (pi + 2) = 0.611 of it (Kirchhoff 1869), so the level h falls by
dh/dt = -0.611 (slit / tank) sqrt(2 g h): the square root of h falls steadily.
"""

import math

import numpy as np

from sph_ros.validation.case import block
from sph_ros.validation.rows import Curve, Plot, relative_row

GRAVITY = 9.81
CONTRACTION = math.pi / (math.pi + 2)
WIDTH, SLIT, DEPTH = 0.24, 0.04, 0.24


def slit(case):
    """The level of a tank with a slit in its floor."""
    spacing = SLIT / case.pick(10, 6)
    left, right = 0.5 * (WIDTH - SLIT), 0.5 * (WIDTH + SLIT)
    thick = 1.5 * spacing
    sim = case.simulation(
        spacing=spacing,
        dimension=2,
        material="water",
        liquid=[block([0, -0.1, 0], [WIDTH, 0.1, DEPTH])],
        solids=[
            _bar("floor_left", [-0.1, left], [-thick, 0]),
            _bar("floor_right", [right, WIDTH + 0.1], [-thick, 0]),
            _bar("wall_left", [-0.1, 0.0], [-thick, 2 * DEPTH]),
            _bar("wall_right", [WIDTH, WIDTH + 0.1], [-thick, 2 * DEPTH]),
            {"name": "basin", "plane": {"offset": -0.6}},
        ],
    )
    times, levels = [], []

    def look(sim):
        above = np.count_nonzero(sim.positions[:, 2] > 0.0)
        times.append(sim.time)
        levels.append(above * spacing**2 / WIDTH)

    case.run(sim, case.pick(0.6, 0.45), look, "tank runs out")
    times, roots = np.array(times), np.sqrt(levels)
    # The jet needs a moment to form, and a shallow rest is a whirl.
    used = (times > 0.12) & (roots > math.sqrt(0.5 * DEPTH))
    slope, start = np.polyfit(times[used], roots[used], 1)
    measured = -slope * 2 * WIDTH / SLIT / math.sqrt(2 * GRAVITY)
    rate = 0.5 * CONTRACTION * SLIT / WIDTH * math.sqrt(2 * GRAVITY)
    middle = times[used].mean()
    exact = slope * middle + start - rate * (times - middle)
    plot = Plot(
        "time [s]",
        "square root of the level [m^1/2]",
        (
            Curve("pi / (pi + 2)", times, exact, truth=True),
            Curve("measured", times, roots),
        ),
    )
    name = "outflow through a slit, contraction"
    return [relative_row(name, CONTRACTION, float(measured), "", 0.10, plot=plot)]


def _bar(name, along, up):
    """A solid box over x and z [m]."""
    return {"name": name, "box": {"min": [along[0], -0.1, up[0]], "max": [along[1], 0.1, up[1]]}}
