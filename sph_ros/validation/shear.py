# SPDX-License-Identifier: Apache-2.0
"""Viscous flow between plates, in two dimensions, with walls that hold the liquid.

No scene is periodic, so the plates are long and the middle is looked at.

* Couette: both plates move, in opposite directions. Nothing flows through a section then, so
  closed ends change nothing in the middle: u = U (2 z / H - 1).
* Poiseuille: pistons at both ends move with the mean speed U and drive the liquid between plates at
  rest. In the middle u = 6 U z / H (1 - z / H).

Ends are felt over about one height; a profile settles within H^2 / (4 pi^2 nu).
"""

import numpy as np

from sph_ros.validation.case import block
from sph_ros.validation.rows import Curve, Plot, Row

HEIGHT, LENGTH = 0.02, 0.1

#: Plates and pistons move until then [s]. Looked at is the end of it, when the lattice of the start
#: has become liquid and the pistons have pushed the room that it needs no longer out of the middle.
END = 1.0

#: Left free at both ends at the start [m]: a liquid that cannot yield has to have somewhere to go.
ROOM = 0.003

#: Newton's liquid: nothing that grows with the square of the speed.
LIQUID = {
    "base": "honey",
    "density": 1000.0,
    "viscosity": 1.0,
    "surface_tension": 0.0,
    "quadratic_viscosity": 0.0,
    "wall_friction": 1.0,
}


def couette(case):
    """Two plates that move in opposite directions."""
    speed = 0.1
    way = speed * END
    plates = [
        _bar("lower", [-LENGTH, LENGTH * 2], [-HEIGHT, 0.0], -way),
        _bar("upper", [-LENGTH, LENGTH * 2], [HEIGHT, 2 * HEIGHT], way),
        _bar("left", [-HEIGHT, 0.0], [0.0, HEIGHT]),
        _bar("right", [LENGTH, LENGTH + HEIGHT], [0.0, HEIGHT]),
    ]
    heights, profile = _profile(case, plates, 0.0, "Couette flow")
    truth = speed * (2 * heights / HEIGHT - 1)
    return [_row("Couette flow between plates", heights, truth, profile, speed)]


def poiseuille(case):
    """Liquid pushed between plates at rest."""
    mean = 0.05
    way = mean * END
    plates = [
        _bar("lower", [-LENGTH, LENGTH * 2], [-HEIGHT, 0.0]),
        _bar("upper", [-LENGTH, LENGTH * 2], [HEIGHT, 2 * HEIGHT]),
        _bar("left", [-HEIGHT, 0.0], [0.0, HEIGHT], way),
        _bar("right", [LENGTH, LENGTH + HEIGHT], [0.0, HEIGHT], way),
    ]
    heights, profile = _profile(case, plates, mean, "Poiseuille flow")
    share = heights / HEIGHT
    truth = 6 * mean * share * (1 - share)
    return [_row("Poiseuille flow between plates", heights, truth, profile, 1.5 * mean)]


def _bar(name, along, up, way=0.0):
    """A solid box over x and z [m] that moves by `way` [m] along x until END."""
    bar = {"name": name, "box": {"min": [along[0], -0.1, up[0]], "max": [along[1], 0.1, up[1]]}}
    if way == 0.0:
        return bar
    return {**bar, "control": "path", "path": [{"time": END, "position": [way, 0, 0]}]}


def _profile(case, plates, drift, words):
    """Mean velocity along x in the middle, which drifts [m/s]: (heights [m], speeds [m/s])."""
    spacing = HEIGHT / case.pick(20, 12)
    sim = case.simulation(
        spacing=spacing,
        dimension=2,
        gravity=[0, 0, 0],
        material=LIQUID,
        liquid=[block([ROOM, -0.1, 0], [LENGTH - ROOM, 0.1, HEIGHT])],
        solids=plates,
    )
    bins = np.linspace(0.0, HEIGHT, case.pick(11, 7))
    total, count = np.zeros(len(bins) - 1), np.zeros(len(bins) - 1)
    places = np.zeros(len(bins) - 1)

    before = []

    def look(sim):
        # The way made in the step: velocities at its end have seen the friction of walls, but not
        # yet the pressure that makes up for it.
        x = sim.positions.astype(np.float64)
        v = (x - before.pop()) / sim.time_step if before else np.zeros_like(x)
        before.append(x)
        middle = np.abs(x[:, 0] - 0.5 * LENGTH - drift * sim.time) < HEIGHT
        total[:] += np.histogram(x[middle, 2], bins, weights=v[middle, 0])[0]
        places[:] += np.histogram(x[middle, 2], bins, weights=x[middle, 2])[0]
        count[:] += np.histogram(x[middle, 2], bins)[0]

    # In a tenth of a second the few layers of the short form are up to 8 % fast or slow by chance.
    start = case.pick(0.8, 0.6)
    case.run(sim, start, words=words)
    before.append(sim.positions.astype(np.float64))
    case.run(sim, END - start, look, words)
    filled = count > 0
    return places[filled] / count[filled], total[filled] / count[filled]


def _row(name, heights, truth, profile, fastest):
    error = float(np.abs(profile - truth).max() / fastest)
    # The number of the table: the profile fitted to the exact one, times the maximum.
    scale = float(profile @ truth / (truth @ truth))
    plot = Plot(
        "height [m]",
        "velocity along the plates [m/s]",
        (Curve("exact", heights, truth, truth=True), Curve("measured", heights, profile)),
    )
    return Row(name, fastest, scale * fastest, "m/s", error, 0.05, plot=plot)
