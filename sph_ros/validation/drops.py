# SPDX-License-Identifier: Apache-2.0
"""Drops without gravity: surface tension by the swing and the pressure of a ball, and its shape."""

import math

import numpy as np
from scipy.optimize import curve_fit

from sph_ros.core.surface import extract_surface
from sph_ros.validation.case import block
from sph_ros.validation.rows import Curve, Plot, Row, relative_row

TENSION, DENSITY = 0.072, 1000.0
SPACE = {"gravity": [0, 0, 0], "material": "water"}


def period(case):
    """A capsule becomes a ball and overshoots: Rayleigh 1879, omega^2 = 8 sigma / (rho R^3)."""
    radius, length = 0.0095, 0.004
    size = (radius**3 + 0.75 * radius**2 * length) ** (1 / 3)
    sim = case.simulation(
        **SPACE,
        spacing=size / case.pick(9, 6),
        liquid=[{"capsule": {"radius": radius, "length": length}}],
    )
    truth = 2 * math.pi / math.sqrt(8 * TENSION / (DENSITY * size**3))
    times, stretches = [], []

    def look(sim):
        x = sim.positions.astype(np.float64)
        square = ((x - x.mean(axis=0)) ** 2).mean(axis=0)
        times.append(sim.time)
        stretches.append((square[2] - 0.5 * (square[0] + square[1])) / square.sum())

    case.run(sim, case.pick(2.5, 1.6) * truth, look, "drop swings")
    times, stretches = np.array(times), np.array(stretches)
    swing, measured, remark = _fit(times, stretches, truth)
    plot = Plot(
        "time [s]",
        "stretch along the capsule's axis [-]",
        (Curve("fit", times, swing, truth=True), Curve("measured", times, stretches)),
    )
    name = "period of a drop's second mode"
    return [relative_row(name, truth, measured, "s", 0.15, remark=remark, plot=plot)]


def _fit(times, values, guess):
    """Damped cosine through a swing: (curve, period without the damping, remark)."""

    def swing(t, height, decay, omega, phase, rest):
        return height * np.exp(-decay * t) * np.cos(omega * t + phase) + rest

    start = (values[0], 1.0 / guess, 2 * math.pi / guess, 0.0, 0.0)
    try:
        found, _ = curve_fit(swing, times, values, start, maxfev=5000)
    except RuntimeError:
        return np.full(len(times), np.nan), math.nan, "does not swing"
    own = math.hypot(found[2], found[1])
    return swing(times, *found), 2 * math.pi / own, f"decays with {found[1]:.2g} / s"


def laplace(case):
    """Pressure inside a drop at rest: 2 sigma / R.

    The particles of a small drop arrange in shells, which bear unlike pressures, so the mean over
    the whole drop is what counts; the plot shows the shells.
    """
    radius = 0.01
    sim = case.simulation(
        **SPACE, spacing=radius / case.pick(9, 8), liquid=[{"sphere": {"radius": radius}}]
    )
    case.run(sim, case.pick(1.0, 0.6), words="drop comes to rest")
    edges = np.linspace(0.0, 1.2 * radius, 13)
    total, count = np.zeros(12), np.zeros(12)

    def look(sim):
        x = sim.positions.astype(np.float64)
        distance = np.linalg.norm(x - x.mean(axis=0), axis=1)
        total[:] += np.histogram(distance, edges, weights=sim.pressures.astype(np.float64))[0]
        count[:] += np.histogram(distance, edges)[0]

    case.run(sim, case.pick(0.3, 0.1), look, "pressure of the drop")
    size = (3 / (4 * math.pi) * sim.particle_count * sim.scene.spacing**3) ** (1 / 3)
    truth = 2 * TENSION / size
    middle = 0.5 * (edges[1:] + edges[:-1])
    filled = count > 0
    plot = Plot(
        "distance from the centre [m]",
        "pressure [Pa]",
        (
            Curve("2 sigma / R", middle[filled], np.full(filled.sum(), truth), truth=True),
            Curve("measured", middle[filled], total[filled] / count[filled]),
        ),
    )
    measured = float(total.sum() / max(count.sum(), 1))
    return [relative_row("mean pressure inside a drop", truth, measured, "Pa", 0.15, plot=plot)]


def cube(case):
    """A cube of liquid becomes a ball: sphericity of the surface mesh."""
    side = 0.02
    sim = case.simulation(
        spacing=side / case.pick(16, 10),
        gravity=[0, 0, 0],
        material={"base": "water", "viscosity": 0.05},
        liquid=[block([0, 0, 0], [side, side, side])],
    )
    times, values = [0.0], [sphericity(sim)]

    def look(sim):
        if sim.time - times[-1] >= 0.02:
            times.append(sim.time)
            values.append(sphericity(sim))

    case.run(sim, case.pick(2.0, 0.8), look, "cube becomes a ball")
    final = sphericity(sim)
    plot = Plot(
        "time [s]",
        "sphericity [-]",
        (
            Curve("ball", np.array([0.0, sim.time]), np.ones(2), truth=True),
            Curve("measured", np.array(times), np.array(values)),
        ),
    )
    return [Row("sphericity of a cubic drop", 1.0, final, "", 1.0 - final, 0.02, plot=plot)]


def sphericity(sim):
    """Area of the ball of the same volume over the area of the liquid's surface mesh [-]."""
    scene = sim.scene
    mesh = extract_surface(sim.positions, scene.spacing, scene.support_radius, 0.5 * scene.spacing)
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(normals, axis=1).sum()
    volume = np.einsum("ij,ij->", corners[:, 0], normals) / 6
    return float(math.pi ** (1 / 3) * (6 * volume) ** (2 / 3) / area)
