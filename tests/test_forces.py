# SPDX-License-Identifier: Apache-2.0
"""Solver `forces`: weights, a slow twin, conservation, rest, buoyancy, stability, repeatability."""

import hashlib
import math

import naive
import numba
import numpy as np
import pytest

import sph_ros
from sph_ros.core import mueller_weights as weights

TANK = {"name": "tank", "container": {"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.3]}}}


def column(height=0.15, dimension=3, **more):
    return {
        "solver": "forces",
        "dimension": dimension,
        "spacing": 0.01,
        "material": {"base": "water", "compression": 0.03},
        "liquid": [{"box": {"min": [0, 0, 0], "max": [0.1, 0.1, height]}}],
        "solids": [TANK],
        **more,
    }


def two_drops(dimension=3, **material):
    """Two drops that meet off centre, far from everything."""
    return sph_ros.Simulation(
        {
            "solver": "forces",
            "dimension": dimension,
            "spacing": 0.01,
            "gravity": [0, 0, 0],
            "material": {"base": "water", "viscosity": 0.3, **material},
            "liquid": [
                {"sphere": {"radius": 0.03}, "velocity": [1.0, 0, 0]},
                {
                    "sphere": {"radius": 0.03},
                    "pose": {"position": [0.07, 0, 0.02]},
                    "velocity": [-1.0, 0, 0.2],
                },
            ],
        }
    )


@pytest.mark.nojit
@pytest.mark.parametrize("dimension", [2, 3])
def test_weights_integrate_to_one_and_have_the_slopes_they_claim(dimension):
    h = 0.03
    r = np.linspace(1e-9, h, 400_001)
    shell = 2 * np.pi * r if dimension == 2 else 4 * np.pi * r * r
    for weight in (weights.poly6, weights.spiky, weights.viscosity):
        assert np.trapezoid(weight(r, h, dimension) * shell, r) == pytest.approx(1.0, abs=1e-6)
        assert weight(h, h, dimension) == pytest.approx(0.0, abs=1e-12)
    slopes = {weights.poly6: weights.poly6_slope, weights.spiky: weights.spiky_slope}
    for weight, slope in slopes.items():
        found, expected = np.gradient(weight(r, h, dimension), r), slope(r, h, dimension)
        np.testing.assert_allclose(found, expected, atol=1e-4 * abs(expected).max())
    r = np.linspace(0.1 * h, h, 40_001)
    grown = r ** (dimension - 1)
    laplacians = {
        weights.poly6: weights.poly6_laplacian,
        weights.viscosity: weights.viscosity_laplacian,
    }
    for weight, laplacian in laplacians.items():
        found = np.gradient(grown * np.gradient(weight(r, h, dimension), r), r) / grown
        expected = laplacian(r, h, dimension)
        np.testing.assert_allclose(found[3:-3], expected[3:-3], atol=1e-3 * abs(expected).max())


@pytest.mark.parametrize("dimension", [2, 3])
def test_steps_are_those_of_the_slow_and_obvious_twin(dimension):
    """Densities and leap-frog of two colliding drops, all forces at work, against all pairs."""
    sim = two_drops(dimension, surface_tension=0.5, quadratic_viscosity=2.0)
    sim.advance(0.03)  # into each other
    dt = sim.time_step
    axes = [0, 2] if dimension == 2 else [0, 1, 2]

    def twin(x, v):
        solver = sim._solver
        return naive.Mueller(
            x, v, sim.scene, solver.scales, float(solver._factors.damping), solver._packing
        )

    x, v = sim.positions[:, axes].astype(float), sim.velocities[:, axes].astype(float)
    a = sim._fluid.public(sim._fluid.extras["accelerations"])[:, axes].astype(float)
    moved = x.copy()
    for _ in range(3):
        v = v + 0.5 * dt * a
        x = x + dt * v
        sim.step()  # the twin takes over how far the lattice has melted
        a = twin(x, v).acceleration
        v = v + 0.5 * dt * a
        assert sim.statistics()["substeps"] == 1
    assert np.abs(x - moved).max() > 3 * 0.5 * dt
    change = np.abs(sim.velocities[:, axes] - v).max()
    assert change < 1e-3 * dt * np.abs(a).max()
    np.testing.assert_allclose(sim.positions[:, axes], x, atol=1e-6)
    density = twin(x, v).density
    np.testing.assert_allclose(sim.densities, 1000.0 * density, rtol=2e-4)


@pytest.mark.parametrize("dimension", [2, 3])
def test_momentum_is_kept_without_walls_and_gravity(dimension):
    sim = two_drops(dimension)
    start = sim.statistics()["momentum"]
    sim.advance(0.12)
    total = sim.particle_count * 1000.0 * 0.01**dimension
    assert np.abs(sim.statistics()["momentum"] - start).max() < 1e-5 * total
    assert sim.velocities[:, 0].std() < 0.9  # they did collide


@pytest.fixture(scope="module")
def resting():
    """A column after a second of rest."""
    sim = sph_ros.Simulation(column())
    sim.advance(0.8)
    return sim


def test_a_column_rests_at_its_level_with_the_weight_and_the_pressure_slope_of_water(resting):
    sim, height = resting, 0.15
    mass = sim.particle_count * 1000.0 * 0.01**3
    slopes, weight, calm = [], [], []
    for _ in range(60):
        sim.step()
        depth = height - sim._fluid.positions[:, 2]
        inner = (depth > 0.03) & (depth < 0.12)
        slopes.append(np.polyfit(depth[inner], sim._fluid.pressures[inner], 1)[0])
        weight.append(-sim.wrench("tank")[0][2])
        calm.append(sim.statistics()["kinetic_energy"])
    facts = sim.statistics()
    assert facts["lost_particles"] == 0
    assert 0.0 < facts["mean_compression"] < 0.03
    assert np.mean(slopes) == pytest.approx(1000.0 * 9.81, rel=0.1)
    assert np.mean(weight) == pytest.approx(mass * 9.81, rel=0.03)
    assert np.mean(calm) < 0.02 * mass * 9.81 * 0.01
    # The mean of a column that yields by 3 % at its bottom lies 1 % lower.
    assert sim.positions[:, 2].mean() == pytest.approx(0.5 * height * 0.99, rel=0.015)


def test_what_solids_push_the_liquid_loses(resting):
    """Action equals reaction: gravity and wrenches explain the momentum step by step."""
    sim = resting
    weight = sim.particle_count * 1000.0 * 0.01**3 * np.array([0.0, 0.0, -9.81])
    for _ in range(20):
        before = sim.statistics()["momentum"]
        sim.step()
        gained = sim.statistics()["momentum"] - before
        explained = (weight - sim.wrench("tank")[0]) * sim.time_step
        np.testing.assert_allclose(gained, explained, atol=1e-4 * sim.time_step * abs(weight[2]))


def test_a_ball_held_under_water_is_pushed_up_by_what_it_displaces():
    radius = 0.03
    ball = {
        "name": "ball",
        "sphere": {"radius": radius},
        "pose": {"position": [0.07, 0.07, 0.16]},
        "control": "topic",
    }
    tank = {"name": "tank", "container": {"box": {"min": [0, 0, 0], "max": [0.14, 0.14, 0.3]}}}
    block = {"box": {"min": [0, 0, 0], "max": [0.14, 0.14, 0.11]}}
    sim = sph_ros.Simulation(column(liquid=[block], solids=[tank, ball]))
    sim.move_solid("ball", [0.07, 0.07, 0.06], time=0.4)
    sim.advance(1.0)
    forces = []
    for _ in range(100):
        sim.step()
        forces.append(sim.wrench("ball")[0])
    force = np.mean(forces, axis=0)
    expected = 1000.0 * 9.81 * 4 / 3 * math.pi * radius**3
    assert force[2] == pytest.approx(expected, rel=0.12)
    assert np.abs(force[:2]).max() < 0.1 * expected


@pytest.mark.parametrize(
    ("dimension", "material"),
    [(2, "water"), (3, "honey"), (2, "mercury"), (3, {"viscosity": 100.0})],
)
def test_the_automatic_step_is_stable(dimension, material):
    """A shaken column only calms down."""
    sim = sph_ros.Simulation(column(0.06, dimension, material=material))
    shake = np.random.default_rng(2).normal(0.0, 0.3, (sim.particle_count, 3))
    shake[:, 1] *= dimension == 3
    sim._fluid.velocities += shake.astype(np.float32)
    start = sim.statistics()["kinetic_energy"]
    sim.advance(0.1)
    facts = sim.statistics()
    assert facts["kinetic_energy"] < 0.3 * start
    assert facts["lost_particles"] == 0 and facts["max_compression"] < 0.1


def test_no_pose_leaves_a_particle_inside_a_solid():
    paddle = {
        "name": "paddle",
        "box": {"size": [0.06, 0.006, 0.06]},
        "pose": {"position": [0.05, 0.05, 0.2]},
        "control": "topic",
    }
    sim = sph_ros.Simulation(column(0.06, solids=[TANK, paddle]))
    generator = np.random.default_rng(5)
    for _ in range(6):
        sim.move_solid("paddle", generator.uniform(0, 0.2, 3), generator.normal(size=4))
        for _ in range(12):
            sim.step()
            for solid in sim.solid_names:
                depth = -sim.solid(solid).signed_distance(sim.positions).min()
                assert depth <= 0.05 * sim.scene.spacing, f"{depth:.4f} m inside {solid}"
    assert sim.statistics()["lost_particles"] == 0


def test_surface_tension_makes_a_cubic_drop_rounder_and_does_not_drive_it():
    sim = sph_ros.Simulation(
        {
            "solver": "forces",
            "spacing": 0.002,
            "gravity": [0, 0, 0],
            "material": {"base": "water", "viscosity": 0.02},
            "liquid": [{"box": {"size": [0.016, 0.016, 0.016]}}],
        }
    )

    def corner_excess():
        x = sim.positions - sim.positions.mean(axis=0)
        r = np.linalg.norm(x, axis=1)
        return r.max() / np.cbrt(3 / (4 * math.pi) * sim.particle_count * 0.002**3)

    before = corner_excess()
    sim.advance(0.12)
    assert before > 1.2
    assert corner_excess() < 1.05
    assert sim.statistics()["max_speed"] < 0.1
    assert np.abs(sim.velocities.mean(axis=0)).max() < 1e-5


def run(threads):
    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        sim = sph_ros.Simulation(column(0.08, solids=[TANK]))
        for _ in range(30):
            sim.step()
        data = sim.positions.tobytes() + sim.velocities.tobytes() + sim.densities.tobytes()
        return hashlib.sha256(data + np.concatenate(sim.wrench("tank")).tobytes()).hexdigest()
    finally:
        numba.set_num_threads(before)


def test_same_input_same_bits_whatever_the_number_of_threads():
    assert run(1) == run(min(2, numba.config.NUMBA_NUM_THREADS))


def test_a_snapshot_goes_on_to_the_bit_and_materials_change_live(tmp_path):
    sim = sph_ros.Simulation(column(0.05))
    sim.advance(0.02)
    sim.set_material(viscosity=2.0, surface_tension=0.3)
    sim.save(tmp_path / "state.npz")
    other = sph_ros.Simulation.load(tmp_path / "state.npz")
    for _ in range(5):
        sim.step()
        other.step()
    np.testing.assert_array_equal(sim.positions, other.positions)
    np.testing.assert_array_equal(sim.velocities, other.velocities)
    np.testing.assert_array_equal(sim.wrench("tank"), other.wrench("tank"))
