# SPDX-License-Identifier: Apache-2.0
"""Free balls in a tank: how deep they float, and that heavy ones sink."""

import math

import numpy as np
from scipy.optimize import brentq

from sph_ros.sim.scene_types import CONTROLS
from sph_ros.validation.case import NotAvailableError, block, tank
from sph_ros.validation.rows import Curve, Plot, Row

SIDE, DEPTH, RADIUS = 0.2, 0.14, 0.04


def draft_of(share):
    """Draft of a ball of density `share` of the liquid's over its radius: Archimedes [-]."""
    return brentq(lambda d: d * d * (3 - d) / 4 - share, 0.0, 2.0)


def balls(case):
    """Balls of half, nine tenths and twice the density of water."""
    if "free" not in CONTROLS:
        raise NotAvailableError("control: free is not available in this version")
    return [_ball(case, share) for share in (0.5, 0.9, 2.0)]


def _ball(case, share):
    start = DEPTH + RADIUS + 0.012
    # Of the ball of 0.9 a tenth is above the water. At a coarser spacing that is too little to be
    # right, as it has to be with `incompressible` in the short form, too.
    fine = case.solver == "incompressible"
    sim = case.simulation(
        spacing=case.pick(0.008, 0.008 if fine else 0.0125),
        material="water",
        liquid=[block([0, 0, 0], [SIDE, SIDE, DEPTH])],
        solids=[
            tank([0, 0, 0], [SIDE, SIDE, 0.3]),
            {
                "name": "ball",
                "sphere": {"radius": RADIUS},
                "pose": {"position": [0.1, 0.1, start]},
                "control": "free",
                "density": 1000.0 * share,
            },
        ],
    )
    times, drafts, bottoms = [], [], []

    def look(sim):
        bottom = float(sim.solid("ball").position[2]) - RADIUS
        times.append(sim.time)
        bottoms.append(bottom)
        drafts.append(_level(sim) - bottom)

    words = f"ball of density {1000 * share:.0f}"
    seconds = case.pick(5.0, 3.0 if fine else 2.5)
    case.run(sim, seconds, look, words)
    late = np.array(times) > 0.7 * seconds
    name = f"draft of a free ball of density {share:g}"
    if share > 1.0:
        # At the bottom it touches: a share of the spacing is left between.
        height = float(np.mean(np.array(bottoms)[late]))
        truth, measured, values = 0.0, height, bottoms
        name = f"height above the floor of a free ball of density {share:g}"
    else:
        truth, measured, values = (
            draft_of(share) * RADIUS,
            float(np.mean(np.array(drafts)[late])),
            drafts,
        )
    plot = Plot(
        "time [s]",
        "draft [m]" if share < 1.0 else "height above the floor [m]",
        (
            Curve("Archimedes", np.array(times), np.full(len(times), truth), truth=True),
            Curve("measured", np.array(times), np.array(values)),
        ),
    )
    error = abs(measured - truth) / (2 * RADIUS)
    return Row(name, truth, measured, "m", error, 0.05, "of its size", plot)


def _level(sim):
    """Height of the free surface beside the ball [m]."""
    x = sim.positions
    centre = sim.solid("ball").position
    aside = np.hypot(x[:, 0] - centre[0], x[:, 1] - centre[1]) > RADIUS + 2 * sim.scene.spacing
    from_wall = np.minimum(x[:, :2], SIDE - x[:, :2]).min(axis=1)
    heights = x[aside & (from_wall > 2 * sim.scene.spacing), 2]
    if len(heights) == 0:
        return math.nan
    # The upper layer: what lies within a spacing of the top; half a spacing above its middle.
    top = heights[heights > np.percentile(heights, 99) - sim.scene.spacing]
    return float(top.mean() + 0.5 * sim.scene.spacing)
