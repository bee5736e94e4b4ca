# SPDX-License-Identifier: Apache-2.0
"""The volume of a tank of water that is stirred for a minute."""

import math

import numpy as np

from sph_ros.validation.case import block, tank
from sph_ros.validation.rows import Curve, Plot, relative_row

SIDE, DEPTH = 0.2, 0.1


def volume(case):
    """Sixty seconds of stirring leave the level where it was.

    The level of a liquid of even density is twice the height of its centre; it is looked at when
    the ball is out of the water and the tank has come to rest, at the end as at the beginning.
    """
    stirred = case.pick(60.0, 6.0)
    frames = [{"time": 1.5, "position": [0.1, 0.1, 0.22]}]
    for k in range(1, int(stirred / 0.1)):
        angle = 2 * math.pi * 0.1 * k * 0.8
        height = 0.05 + 0.015 * math.sin(0.37 * k)
        place = [0.1 + 0.055 * math.cos(angle), 0.1 + 0.055 * math.sin(angle), height]
        frames.append({"time": 1.5 + 0.1 * k, "position": place})
    frames.append({"time": 2.0 + stirred, "position": [0.1, 0.1, 0.22]})
    sim = case.simulation(
        spacing=SIDE / 12,
        material="water",
        liquid=[block([0, 0, 0], [SIDE, SIDE, DEPTH])],
        solids=[
            tank([0, 0, 0], [SIDE, SIDE, 0.3]),
            {
                "name": "ball",
                "sphere": {"radius": 0.03},
                "pose": {"position": [0.1, 0.1, 0.22]},
                "control": "path",
                "path": frames,
            },
        ],
    )
    times, levels = [], []

    def look(sim):
        times.append(sim.time)
        levels.append(2 * float(sim.positions[:, 2].mean(dtype=np.float64)))

    case.run(sim, 1.5, look, "tank comes to rest")
    calm = len(levels)
    case.run(sim, stirred + 2.5, look, "stirring")
    after = len(levels)
    case.run(sim, 1.0, look, "tank comes to rest")
    area = SIDE * SIDE * 1e3
    count = sim.particle_count * sim.scene.spacing**3 * 1e3
    before = float(np.mean(levels[calm // 2 : calm]))
    end = float(np.mean(levels[after:]))
    plot = Plot(
        "time [s]",
        "twice the height of the centre [m]",
        (
            Curve("filled", np.array([0.0, sim.time]), np.full(2, count / area), truth=True),
            Curve("measured", np.array(times[::20]), np.array(levels[::20])),
        ),
    )
    remark = f"filled with {count:.3f} l"
    name = f"volume after {stirred:.0f} s of stirring"
    row = relative_row(name, area * before, area * end, "l", 0.01, remark=remark, plot=plot)
    return [row]
