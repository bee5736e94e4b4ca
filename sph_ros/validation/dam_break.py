# SPDX-License-Identifier: Apache-2.0
"""A column of water collapses; its front against what was measured.

Time T = t sqrt(2 g / a) and front Z = x / a are made dimensionless with the width a of the column,
which is twice as high. Two experiments are compared with, Martin & Moyce 1952 (Phil. Trans. R. Soc.
A 244, 312-324; n^2 = 2) and Koshizuka & Oka 1996 (Nucl. Sci. Eng. 123, 421-434; a = 146 mm). They
differ by up to a tenth: gates are not pulled in no time, and floors are not equally smooth. So at
every time the nearer one counts, and the row tells how far each of them is. Of the latter a curve
stands for the points, Z = 1 + V (sqrt(T^2 + D^2) - D): it starts with a steady acceleration V / D
and ends with a steady speed V. A file of points replaces both.
"""

import math
from pathlib import Path

import numpy as np

from sph_ros.validation.case import NotAvailableError, block, tank
from sph_ros.validation.rows import Curve, Plot, Row

WIDTH, GRAVITY = 0.146, 9.81

#: Martin & Moyce 1952, Z over T.
MARTIN_MOYCE = (
    (0.41, 0.84, 1.19, 1.43, 1.63, 1.83, 1.98, 2.20, 2.32, 2.51, 2.65, 2.83, 2.98),
    (1.11, 1.23, 1.44, 1.67, 1.89, 2.11, 2.33, 2.56, 2.78, 3.00, 3.22, 3.44, 3.67),
)

#: Of the curve through the points of Koshizuka & Oka; none is farther from it than
#: `test_validation` allows.
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


def _published(case):
    """Times and fronts to compare with: (times, ((name, fronts at them), ...))."""
    if case.data is not None:
        times, fronts = read_points(case.data)
        used = (times > 0.0) & (times <= LAST_TIME)
        return times[used], ((Path(case.data).name, fronts[used]),)
    times = np.array([0.5, 0.8, 1.2, 1.6, 2.0, 2.3, 2.7])
    return times, (
        ("Koshizuka & Oka 1996", front_curve(times)),
        ("Martin & Moyce 1952", np.interp(times, *MARTIN_MOYCE)),
    )


def front(case):
    """The front of a column in two dimensions."""
    times, published = _published(case)
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
    return [_row(times, published, np.array(measured))]


def _row(times, published, measured):
    """The worst time, each against the nearer of the experiments."""
    fronts = np.array([points for _, points in published])
    errors = np.abs(measured - fronts) / fronts
    nearer = errors.argmin(axis=0)
    worst = int(errors.min(axis=0).argmax())
    source = nearer[worst]
    remark = f"worst of {len(times)} times, T = {times[worst]:.2f}, against {published[source][0]}"
    if len(published) > 1:
        farthest = ", ".join(
            f"{name} {share.max():.1%}" for (name, _), share in zip(published, errors, strict=True)
        )
        remark += f"; worst against each: {farthest}"
    curves = [Curve(name, times, points, truth=True) for name, points in published]
    plot = Plot("T = t sqrt(2 g / a)", "Z = x / a", (*curves, Curve("measured", times, measured)))
    return Row(
        "front of a collapsing column",
        float(fronts[source, worst]),
        float(measured[worst]),
        "widths",
        float(errors[source, worst]),
        0.10,
        remark,
        plot,
    )
