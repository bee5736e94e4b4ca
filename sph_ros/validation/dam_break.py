# SPDX-License-Identifier: Apache-2.0
"""A column of water collapses; its front against what was measured.

Time T = t sqrt(2 g / a) and front Z = x / a are made dimensionless with the width a = 146 mm of the
column, which is twice as high: Koshizuka & Oka 1996 (Nucl. Sci. Eng. 123, 421-434). A file of their
points is compared with point by point; without one a curve stands for them, Z = 1 + V (sqrt(T^2 +
D^2) - D): it starts with a steady acceleration V / D and ends with a steady speed V.

The error is the root mean square over the points. Single ones say less: they are frames of a film,
0.386 apart (1/30 s), so the moment of the release is known to half of that, in which the front goes
0.3 widths. The row tells the worst point, and how far off Martin & Moyce 1952 are (Phil. Trans. R.
Soc. A 244, 312-324; n^2 = 2), whose front was a tenth ahead of the other one at T = 2.7.
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

#: Of the curve through the points of Koshizuka & Oka; none until `CURVE_END` is farther from it
#: than `test_validation` allows.
SPEED, DELAY, CURVE_END = 1.12, 1.14, 2.75

#: The front is looked at until it nears the other end of the tank, at Z = 4.
LAST_TIME = 3.1


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
    """Name of what is compared with, its times and fronts."""
    if case.data is not None:
        times, fronts = read_points(case.data)
        used = (times > 0.0) & (times <= LAST_TIME)
        return Path(case.data).name, times[used], fronts[used]
    times = np.array([0.5, 0.8, 1.2, 1.6, 2.0, 2.3, 2.7])
    return "Koshizuka & Oka 1996", times, front_curve(times)


def front(case):
    """The front of a column in two dimensions."""
    name, times, published = _published(case)
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
    return [_row(name, times, published, np.array(measured))]


def _deviations(times, measured, others):
    """How far `measured` is from other points [(T,), (Z,)] at their times, as shares."""
    at, fronts = (np.asarray(column) for column in others)
    used = (at >= times[0]) & (at <= times[-1])
    return np.abs(np.interp(at[used], times, measured) / fronts[used] - 1.0)


def _row(name, times, published, measured):
    """The root mean square over all times; as truth and measured the worst one."""
    errors = np.abs(measured / published - 1.0)
    worst = int(errors.argmax())
    other = _deviations(times, measured, MARTIN_MOYCE)
    remark = (
        f"RMS of {len(times)} points of {name}, the worst at T = {times[worst]:.2f}: "
        f"{errors[worst]:.1%}; Martin & Moyce 1952: RMS {np.sqrt(np.mean(other**2)):.1%}, worst "
        f"{other.max():.1%}"
    )
    curves = (
        Curve(name, times, published, truth=True),
        Curve("Martin & Moyce 1952", *map(np.array, MARTIN_MOYCE), truth=True),
        Curve("measured", times, measured),
    )
    return Row(
        "front of a collapsing column",
        float(published[worst]),
        float(measured[worst]),
        "widths",
        float(np.sqrt(np.mean(errors**2))),
        0.10,
        remark,
        Plot("T = t sqrt(2 g / a)", "Z = x / a", curves),
    )
