# SPDX-License-Identifier: Apache-2.0
"""Liquid of one or two layers of particles between two solids: it holds nothing up, and drains."""

import numpy as np
import pytest

import sph_ros

S = 0.02


@pytest.mark.parametrize("layers", [1.0, 1.8])
def test_a_plate_near_the_floor_is_lifted_by_no_more_than_the_water_it_displaces(layers):
    """Layers of particles that fit in badly would bear a third to a whole of the pressure."""
    length, width, high, level, start = 0.24, 0.16, 0.04, 0.2, 0.06
    around = {"min": [0, 0, 0], "max": [0.52, 0.3, level]}
    sim = sph_ros.Simulation(
        {
            "spacing": S,
            "solver": "incompressible",
            "material": "water",
            "liquid": [
                {"box": {"min": [0, 0, 0], "max": [0.52, 0.3, start]}},
                {"box": {"min": [0, 0, start], "max": [0.14, 0.3, start + high]}},
                {"box": {"min": [0.38, 0, start], "max": [0.52, 0.3, start + high]}},
                {"box": {"min": [0, 0, start + high], "max": around["max"]}},
            ],
            "solids": [
                {"name": "tank", "container": {"box": {**around, "max": [0.52, 0.3, 0.5]}}},
                {
                    "name": "plate",
                    "box": {"size": [length, width, high]},
                    "pose": {"position": [0.26, 0.15, start + 0.5 * high]},
                    "control": "topic",
                },
            ],
        }
    )
    gap = layers * S
    sim.move_solid("plate", [0.26, 0.15, gap + 0.5 * high], time=1.0)
    sim.advance(1.2)
    lifts = []
    while sim.time < 1.6:
        sim.step()
        lifts.append(sim.wrench("plate")[0][2])
    beside = 1000 * 9.81 * (level - gap)
    excess = np.mean(lifts) / (length * width) - 1000 * 9.81 * high
    assert abs(excess) < 0.2 * beside


def test_what_a_film_does_to_two_bodies_keeps_their_momenta():
    sim = sph_ros.Simulation(
        {
            "spacing": S,
            "solver": "incompressible",
            "gravity": [0, 0, 0],
            "material": {"base": "water", "viscosity": 0.1},
            "liquid": [{"box": {"size": [0.12, 0.12, 0.04]}}],
            "solids": [
                {
                    "name": name,
                    "box": {"size": [0.16, 0.16, 0.04]},
                    "pose": {"position": [0.0, 0.01, side * 0.06], "quat_xyzw": [0.02, 0, 0, 1]},
                    "control": "free",
                    "density": 2000.0,
                    "velocity": [0.1, 0.0, -side * speed],
                }
                for name, side, speed in (("upper", 1, 0.2), ("lower", -1, 0.1))
            ],
        }
    )
    bodies, mass = sim._solids.bodies, 1000 * S**3

    def momenta():
        x, v = sim.positions.astype(float), sim.velocities.astype(float)
        linear = mass * v.sum(axis=0) + bodies.momentum.sum(axis=0)
        angular = mass * np.cross(x, v).sum(axis=0) + bodies.spin.sum(axis=0)
        return linear, angular + np.cross(bodies.centre, bodies.momentum).sum(axis=0)

    size = np.linalg.norm(bodies.momentum[0])
    linear, angular = momenta()
    gaps = []
    for _ in range(120):
        sim.step()
        gaps.append(np.diff(bodies.centre[::-1, 2])[0] - 0.04)
        np.testing.assert_allclose(momenta()[0], linear, atol=1e-5 * size)
    assert min(gaps) < 1.2 * S
    np.testing.assert_allclose(momenta()[1], angular, atol=1e-3 * 0.2 * size)
