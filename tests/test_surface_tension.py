# SPDX-License-Identifier: Apache-2.0
"""Surface tension of the incompressible solver: the energy's derivative, drops, walls."""

import itertools
import math

import numpy as np
import pytest

import sph_ros
from sph_ros.sim.materials import MATERIALS
from sph_ros.sim.surface_tension import noticeable, tension_scales
from sph_ros.validation import checks
from sph_ros.validation.case import Case

S = 0.001


def energy(x, dimension):
    """Energy of particles at x by the formula, pair by pair, for a surface tension of 1 N/m [J]."""
    law = tension_scales(2 * S, S, dimension).law
    reach, spacing = float(law.reach), float(law.spacing)
    total = 0.0
    for here in x:
        d = here - x
        q = np.maximum(1.0 - (d**2).sum(axis=1) / reach**2, 0.0)
        colour = float(law.scale) * (q**3).sum()
        slope = float(law.scale) * -6.0 / reach**2 * (q[:, None] ** 2 * d).sum(axis=0)
        steep, blur = np.linalg.norm(slope) * spacing, float(law.blur)
        total += float(law.area) * (math.hypot(steep, blur) - blur)
        total += 0.5 * float(law.cohesion) * max(float(law.full) - colour, 0.0) ** 2
    return total * spacing ** (dimension - 1)


@pytest.mark.parametrize("dimension", [2, 3])
def test_forces_are_the_derivative_of_the_energy(dimension):
    tension = 0.07
    points = np.array(list(itertools.product(range(5), repeat=dimension)), float)
    if dimension == 2:
        points = np.insert(points, 1, 0.0, axis=1)
    # Loose, so that nothing is pressed and all that moves the particles is the tension.
    x = 1.3 * S * points
    jitter = np.random.default_rng(3).uniform(-0.2, 0.2, x.shape) * S
    x += jitter * ([1, 0, 1] if dimension == 2 else 1)
    scene = {
        "solver": "incompressible",
        "dimension": dimension,
        "spacing": S,
        "time_step": 1e-6,
        "gravity": [0, 0, 0],
        "material": {"base": "air_like", "density": 1000.0, "surface_tension": tension},
        "liquid": [
            {"box": {"min": [0, 0, 0], "max": [5 * S, S if dimension == 2 else 5 * S, 5 * S]}}
        ],
    }
    sim = sph_ros.Simulation(scene)
    assert sim.particle_count == len(x)
    sim._fluid.positions[:] = x
    sim.step()
    forces = sim.velocities.astype(float) * 1000.0 * S**dimension / sim.time_step
    x = x.astype(np.float32).astype(float)
    for i in (0, 7, len(x) // 2):
        row = np.zeros_like(x)
        for axis in (0, 2):
            row[i, axis] = 1e-4 * S
            slope = (energy(x + row, dimension) - energy(x - row, dimension)) / (2e-4 * S)
            row[i, axis] = 0.0
            expected = pytest.approx(-tension * slope, abs=2e-3 * np.abs(forces).max())
            assert forces[i, axis] == expected
    size = np.abs(forces).sum()
    assert np.abs(forces.sum(axis=0)).max() < 1e-5 * size
    assert np.abs(np.cross(x, forces).sum(axis=0)).max() < 1e-5 * size * np.abs(x).max()


@pytest.mark.parametrize("name", ["drop_period", "drop_pressure", "cube"])
def test_drops_swing_press_and_become_balls(name):
    (row,) = checks.run_check(name, Case("incompressible", quick=True)).rows
    assert row.passed, row


def small_tank(adhesion):
    """How much higher water stands at the walls of a small tank than in its middle [m]."""
    size = 0.02
    sim = sph_ros.Simulation(
        {
            "solver": "incompressible",
            "spacing": 0.002,
            "material": {"base": "water", "adhesion": adhesion, "viscosity": 0.01},
            "liquid": [{"box": {"min": [0, 0, 0], "max": [size, size, 0.01]}}],
            "solids": [
                {
                    "name": "tank",
                    "container": {"box": {"min": [0, 0, 0], "max": [size, size, 0.05]}},
                }
            ],
        }
    )
    sim.advance(0.5)
    x = sim.positions
    away = np.minimum(x[:, :2].min(axis=1), size - x[:, :2].max(axis=1))
    assert np.linalg.norm(sim.velocities, axis=1).mean() < 0.03
    return x[away < 0.003, 2].max() - x[away > 0.006, 2].max()


def test_water_climbs_walls_that_hold_it_and_shuns_others():
    assert small_tank(0.9) > 0.001
    assert small_tank(0.1) < 0.0005


def test_tension_that_gravity_hides_is_left_out():
    """Left out where h is more than four capillary lengths, 10.8 mm for water."""

    def scene(spacing, g=9.81):
        box = {"box": {"min": [0, 0, 0], "max": [4 * spacing] * 3}}
        return sph_ros.Simulation(
            {
                "solver": "incompressible",
                "spacing": spacing,
                "gravity": [0, 0, -g],
                "liquid": [box],
            }
        ).scene

    water = MATERIALS["water"]
    h = 4 * math.sqrt(water.surface_tension / (water.density * 9.81))
    assert noticeable(water, scene(0.49 * h)) and not noticeable(water, scene(0.51 * h))
    assert noticeable(water, scene(0.05, g=0.0))
    assert not noticeable(MATERIALS["air_like"], scene(0.001, g=0.0))


@pytest.mark.parametrize("adhesion", [0.1, 0.9])
def test_a_wall_bears_the_torque_that_its_surface_tension_has_on_the_liquid(adhesion):
    """About the world's origin; solids' torques are about theirs at the end of the step."""
    cube = {"name": "cube", "box": {"size": [0.006] * 3}, "control": "free", "density": 500.0}
    cube["pose"] = {"position": [0.009, 0.002, 0.001], "quat_xyzw": [0.1, 0.2, 0, 1]}
    sim = sph_ros.Simulation(
        {
            "spacing": S,
            "solver": "incompressible",
            "gravity": [0, 0, 0],
            "material": {"base": "water", "adhesion": adhesion},
            "liquid": [{"box": {"size": [0.01] * 3}}],
            "solids": [cube],
        }
    )
    surface = sim._solver._surface
    displace, found = surface.displace, []

    def watched(work, grid, motion, material, mass, time_step):
        before = work.reactions.sum(axis=0)[0]
        displace(work, grid, motion, material, mass, time_step)
        wrench = work.reactions.sum(axis=0)[0] - before
        forces = work.cohesive.astype(float) * mass / time_step**2
        liquid = np.cross(work.predicted.astype(float), forces).sum(axis=0)
        solid = wrench[3:] + np.cross(motion.position[0].astype(float), wrench[:3])
        found.append((liquid, solid))

    surface.displace = watched
    for _ in range(20):
        sim.step()
    liquid, solid = np.array(found).transpose(1, 0, 2)
    assert np.abs(liquid).max() > 1e-9
    assert np.abs(liquid + solid).max() < 1e-4 * np.abs(liquid).max()
