# SPDX-License-Identifier: Apache-2.0
"""Momentum and angular momentum of drops that collide, far from walls and without gravity."""

import numpy as np

from sph_ros.validation.rows import Curve, Plot, Row

STEPS = 1000


def momenta(case):
    """Two drops meet off centre; both momenta stay over a thousand steps."""
    radius = 0.03
    sim = case.simulation(
        spacing=radius / case.pick(6, 4),
        gravity=[0, 0, 0],
        material="water",
        liquid=[
            {"sphere": {"radius": radius}, "velocity": [0.8, 0, 0]},
            {
                "sphere": {"radius": radius},
                "pose": {"position": [0.08, 0, 0.025]},
                "velocity": [-0.7, 0.0, 0.1],
            },
        ],
    )
    start, turning, size, lever = _sums(sim)
    drift, twist = [0.0], [0.0]

    def look(sim):
        now, turned, _, _ = _sums(sim)
        drift.append(float(np.linalg.norm(now - start)) / size)
        twist.append(float(np.linalg.norm(turned - turning)) / lever)

    case.run(sim, STEPS * sim.time_step, look, "drops collide")
    steps = np.arange(len(drift))
    rows = []
    for name, values in (("momentum", drift), ("angular momentum", twist)):
        worst = max(values)
        plot = Plot("step", f"change of {name} [-]", (Curve("measured", steps, np.array(values)),))
        rows.append(
            Row(f"change of {name} in {STEPS:,} steps", 0.0, worst, "", worst, 1e-4, plot=plot)
        )
    return rows


def _sums(sim):
    """Momentum, angular momentum about the origin, and what each would be if nothing cancelled."""
    x, v = sim.positions.astype(np.float64), sim.velocities.astype(np.float64)
    turning = np.cross(x, v)
    return (
        v.sum(axis=0),
        turning.sum(axis=0),
        np.linalg.norm(v, axis=1).sum(),
        np.linalg.norm(turning, axis=1).sum(),
    )
