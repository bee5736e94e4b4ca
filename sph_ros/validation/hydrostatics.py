# SPDX-License-Identifier: Apache-2.0
"""Liquid at rest: pressure against depth, the force on what is held under it."""

import math
import tempfile
from pathlib import Path

import numpy as np
import trimesh

from sph_ros.validation.case import block, tank
from sph_ros.validation.rows import Curve, Plot, Row, relative_row

GRAVITY, DENSITY = 9.81, 1000.0


def column(case):
    """A column 0.2 m deep: pressure against depth is rho g z."""
    depth, spacing = 0.2, 0.01
    sim = case.simulation(
        spacing=spacing,
        material="water",
        liquid=[block([0, 0, 0], [0.1, 0.1, depth])],
        solids=[tank([0, 0, 0], [0.1, 0.1, 0.3])],
    )
    case.run(sim, case.pick(1.5, 0.8), words="column comes to rest")
    edges = np.linspace(0.0, depth, 11)
    total, count = np.zeros(10), np.zeros(10)

    def look(sim):
        below = depth - sim.positions[:, 2]
        pressures = sim.pressures.astype(np.float64)
        total[:] += np.histogram(below, edges, weights=pressures)[0]
        count[:] += np.histogram(below, edges)[0]

    case.run(sim, case.pick(0.5, 0.2), look, "pressure of the column")
    middle = 0.5 * (edges[1:] + edges[:-1])
    mean = total / np.maximum(count, 1)
    truth = DENSITY * GRAVITY * middle
    bottom = DENSITY * GRAVITY * depth
    error = float(np.abs(mean - truth).max() / bottom)
    slope, offset = np.polyfit(middle[1:], mean[1:], 1)
    plot = Plot(
        "depth [m]",
        "pressure [Pa]",
        (Curve("rho g z", middle, truth, truth=True), Curve("measured", middle, mean)),
    )
    measured = slope * depth + offset
    return [
        Row("pressure at the bottom of a column", bottom, measured, "Pa", error, 0.05, plot=plot)
    ]


def _torus(folder):
    """A ring as a mesh file, and its volume [m^3]."""
    mesh = trimesh.creation.torus(major_radius=0.045, minor_radius=0.022)
    path = Path(folder) / "ring.stl"
    mesh.export(path)
    return path, float(mesh.volume)


def held(case):
    """A ball, a box and a mesh held under water are pushed up by rho g V."""
    with tempfile.TemporaryDirectory(prefix="sph_ros_") as folder:
        path, ring = _torus(folder)
        shapes = {
            "ball": ({"sphere": {"radius": 0.04}}, 4 / 3 * math.pi * 0.04**3),
            "box": ({"box": {"size": [0.07, 0.06, 0.05]}}, 0.07 * 0.06 * 0.05),
            "mesh": ({"mesh": {"file": str(path)}}, ring),
        }
        return [_held(case, name, *shapes[name]) for name in shapes]


def _held(case, name, shape, volume):
    sim = case.simulation(
        spacing=case.pick(0.01, 0.0125),
        material="water",
        liquid=[block([0, 0, 0], [0.2, 0.2, 0.14])],
        solids=[
            tank([0, 0, 0], [0.2, 0.2, 0.3]),
            {
                "name": "held",
                **shape,
                "pose": {"position": [0.1, 0.1, 0.22]},
                "control": "path",
                "path": [
                    {"time": 0.01, "position": [0.1, 0.1, 0.22]},
                    {"time": 0.6, "position": [0.1, 0.1, 0.08]},
                ],
            },
        ],
    )
    case.run(sim, case.pick(2.0, 1.4), words=f"{name} is dipped")
    times, forces = [], []

    def look(sim):
        times.append(sim.time)
        forces.append(sim.wrench("held")[0][2])

    case.run(sim, case.pick(1.0, 0.4), look, f"force on the {name}")
    truth = DENSITY * GRAVITY * volume
    plot = Plot(
        "time [s]",
        "force upwards [N]",
        (
            Curve("rho g V", np.array(times), np.full(len(times), truth), truth=True),
            Curve("measured", np.array(times), np.array(forces)),
        ),
    )
    title = f"force on a {name} held under water"
    return relative_row(title, truth, float(np.mean(forces)), "N", 0.05, plot=plot)
