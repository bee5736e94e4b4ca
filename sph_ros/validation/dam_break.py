# SPDX-License-Identifier: Apache-2.0
"""A column of water collapses; its front against what was measured.

Time T = t sqrt(2 g / a) and front Z = x / a are made dimensionless with the width a of the column,
which is twice as high (Martin & Moyce 1952; Koshizuka & Oka 1996, Nucl. Sci. Eng. 123, 421-434).
Without a file of published points a curve through those of Koshizuka & Oka stands for them,
Z = 1 + V (sqrt(T^2 + D^2) - D): it starts with a steady acceleration V / D and ends with a steady
speed V.
"""

import math
from pathlib import Path

import numpy as np

from sph_ros.validation.case import NotAvailableError, block, tank
from sph_ros.validation.rows import Curve, Plot, Row

WIDTH, GRAVITY = 0.146, 9.81

#: Of the curve through the points, none of which is farther from it than `test_validation` allows.
SPEED, DELAY = 1.12, 1.14

#: The front is looked at until it nears the other end of the tank, at Z = 4.
LAST_TIME = 2.75


def front_curve(times):
    """Front over dimensionless time by the curve above [-]."""
    return 1 + SPEED * (np.hypot(times, DELAY) - DELAY)


def read_points(path):
    """Published points: lines `T,Z`; comments and headers are skipped.

    Raises:
        NotAvailableError: the file cannot be read or holds none.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        rows = [line.split(",") for line in lines if line[:1].isdigit()]
        points = np.array(rows, dtype=float)
    except (OSError, ValueError) as error:
        raise NotAvailableError(f"{path}: expected lines T,Z of a dam break ({error})") from None
    if points.ndim != 2 or points.shape[1] != 2:
        raise NotAvailableError(f"{path}: expected lines T,Z of a dam break, found none")
    return points[:, 0], points[:, 1]


def front(case):
    """The front of a column in two dimensions."""
    times = np.array([0.4, 0.8, 1.2, 1.6, 2.0, 2.3, 2.7])
    fronts = front_curve(times)
    source = "curve through Koshizuka & Oka 1996"
    if case.data is not None:
        times, fronts = read_points(case.data)
        source = Path(case.data).name
    chosen = (times > 0.0) & (times <= LAST_TIME)
    times, fronts = times[chosen], fronts[chosen]
    sim = case.simulation(
        spacing=WIDTH / case.pick(40, 24),
        dimension=2,
        material="water",
        liquid=[block([0, -0.05, 0], [WIDTH, 0.05, 2 * WIDTH])],
        solids=[tank([0, -0.05, 0], [4 * WIDTH, 0.05, 0.5])],
    )
    unit = math.sqrt(WIDTH / (2 * GRAVITY))
    measured = []
    for time in times:
        case.run(sim, max(time * unit - sim.time, 0.0), words="column collapses")
        # A few particles that splash ahead are not the front; their half spacing belongs to it.
        edge = np.percentile(sim.positions[:, 0], 99.7) + 0.5 * sim.scene.spacing
        measured.append(edge / WIDTH)
    measured = np.array(measured)
    errors = np.abs(measured - fronts) / fronts
    worst = int(np.argmax(errors))
    plot = Plot(
        "T = t sqrt(2 g / a)",
        "Z = x / a",
        (Curve(source, times, fronts, truth=True), Curve("measured", times, measured)),
    )
    return [
        Row(
            "front of a collapsing column",
            float(fronts[worst]),
            float(measured[worst]),
            "widths",
            float(errors[worst]),
            0.10,
            f"worst of {len(times)} times, T = {times[worst]:.2f}",
            plot,
        )
    ]
