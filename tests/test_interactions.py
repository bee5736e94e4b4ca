# SPDX-License-Identifier: Apache-2.0
"""Solvers `none` and `lennard_jones`, and several liquids in one scene."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

import sph_ros
from sph_ros.sim.scene import SceneError

BARE = {"base": "water", "viscosity": 0.0, "wall_friction": 0.0}


def tank(x, z):
    return {"name": "tank", "container": {"box": {"min": [0, 0, 0], "max": [x, x, z]}}}


# ---------------------------------------------------------------- none


def test_uncoupled_particles_fly_parabolas_through_each_other_and_stay_on_the_ground():
    sim = sph_ros.Simulation(
        {
            "solver": "none",
            "spacing": 0.01,
            "material": BARE,
            "liquid": [
                {"box": {"min": [0, 0, 0.2], "max": [0.05, 0.05, 0.25]}, "velocity": [1, 0, 1]},
                {"box": {"min": [0.1, 0, 0.2], "max": [0.15, 0.05, 0.25]}, "velocity": [-1, 0, 1]},
            ],
            "solids": [{"name": "ground", "plane": {}}],
        }
    )
    x, v = sim.positions.astype(float), sim.velocities.astype(float)
    while sim.time < 0.15:  # through each other, and not down yet
        sim.step()
    t = sim.time
    expected = x + t * v - 0.5 * 9.81 * t * t * np.array([0, 0, 1.0])
    np.testing.assert_allclose(sim.positions, expected, atol=1e-6)
    assert (sim.positions[:125, 0] > sim.positions[125:, 0]).all()
    sim.advance(0.5)
    assert sim.positions[:, 2].max() < 0.001
    assert sim.solid("ground").signed_distance(sim.positions).min() > 0.0
    weight = sim.particle_count * 1000.0 * 0.01**3 * 9.81
    assert -sim.wrench("ground")[0][2] == pytest.approx(weight, rel=1e-3)


# ---------------------------------------------------------------- Lennard-Jones


def potential(x, sim, depth):
    """Energy of all pairs of one family, summed over the pairs."""
    a, h = sim.scene.spacing, sim.scene.support_radius
    r = np.linalg.norm(np.diff(x[cKDTree(x).query_pairs(h, output_type="ndarray")], axis=1), axis=2)

    def energy(r):
        return (a / r) ** 12 - 2 * (a / r) ** 6

    slope = -12 / h * ((a / h) ** 12 - (a / h) ** 6)
    return depth * (energy(r) - energy(h) - (r - h) * slope).sum()


def gas(warmth, **more):
    """A 2D box of Lennard-Jones particles without gravity, stirred to a temperature in e."""
    sim = sph_ros.Simulation(
        {
            "solver": "lennard_jones",
            "dimension": 2,
            "spacing": 0.01,
            "gravity": [0, 0, 0],
            "material": BARE,
            "liquid": [{"box": {"min": [0, 0, 0], "max": [0.18, 1, 0.14]}}],
            "solids": [tank(0.18, 0.18)],
            **more,
        }
    )
    scales = sim._solver.scales
    speed = math.sqrt(warmth * scales.depth / scales.mass)
    v = np.random.default_rng(1).normal(0.0, speed, (sim.particle_count, 3))
    sim._fluid.velocities[:] = v * [1, 0, 1]
    return sim


def test_two_particles_swing_as_their_potential_says():
    """About the minimum of e ((a/r)^12 - 2 (a/r)^6): omega^2 = 72 e / a^2 / (m / 2)."""
    sim = sph_ros.Simulation(
        {
            "solver": "lennard_jones",
            "spacing": 0.01,
            "gravity": [0, 0, 0],
            "material": BARE,
            "liquid": [{"box": {"size": [0.02, 0.01, 0.01]}}],
        }
    )
    scales = sim._solver.scales
    period = 2 * math.pi / math.sqrt(144 * scales.depth / scales.mass / 0.01**2)
    sim._fluid.velocities[:, 0] = [0.001, -0.001]
    speeds, times = [], []
    while sim.time < 3 * period:
        sim.step()
        speeds.append(sim.velocities[0, 0])
        times.append(sim.time)
    s = np.array(speeds)
    turns = np.array(times)[1:][s[1:] * s[:-1] < 0]
    assert np.diff(turns).mean() == pytest.approx(period / 2, rel=0.05)


def test_lennard_jones_conserves_energy_in_a_closed_box():
    sim = gas(0.8)
    scales = sim._solver.scales

    def energy():
        share = sim._solver._work.contacts.density[:, 0].astype(float)
        wall = 100.0 * scales.depth * (share**4).sum()
        kinetic = sim.statistics()["kinetic_energy"]
        return kinetic, kinetic + wall + potential(sim.positions.astype(float), sim, scales.depth)

    for _ in range(5):
        sim.step()
    start, total = energy()
    for _ in range(400):
        sim.step()
    moving, now = energy()
    assert start > 0.2 * scales.depth * sim.particle_count
    assert abs(moving - start) > 0.02 * start  # energy did go to and fro
    assert abs(now - total) < 0.005 * start
    assert sim.statistics()["lost_particles"] == 0


def test_two_families_separate_and_one_does_not():
    """Share of like neighbours among neighbours, from a random mixture on."""

    def likeness(attraction):
        oil = {"base": "oil", "viscosity": 0.0, "density": 1000.0}
        blocks = [
            {"box": {"min": [0, 0, 0], "max": [0.18, 1, 0.07]}},
            {"box": {"min": [0, 0, 0.07], "max": [0.18, 1, 0.14]}, "material": oil},
        ]
        sim = gas(0.8, liquid=blocks)
        np.random.default_rng(0).shuffle(sim._fluid.extras["family"])
        if attraction is not None:
            sim._solver._attractions[:] = attraction
        shares = []
        for step in range(1400):
            sim.step()
            if step % 50 == 0:
                pairs = cKDTree(sim.positions).query_pairs(0.014, output_type="ndarray")
                family = sim.families[pairs]
                shares.append((family[:, 0] == family[:, 1]).mean())
        return shares[0], np.mean(shares[-4:])

    start, end = likeness(None)
    assert abs(start - 0.5) < 0.06
    assert end > 0.6
    _, mixed = likeness(1.0)
    assert mixed < 0.54


# ---------------------------------------------------------------- several liquids


def two_liquids(solver="forces", **more):
    oil = {"box": {"min": [0, 0, 0], "max": [0.06, 0.06, 0.1]}, "material": "oil"}
    water = {"box": {"min": [0.06, 0, 0], "max": [0.12, 0.06, 0.1]}}
    return {
        "solver": solver,
        "spacing": 0.01,
        "material": {"base": "water", "compression": 0.03},
        "liquid": [{**oil, "color": [0.9, 0.7, 0.2]}, water],
        "solids": [
            {"name": "tank", "container": {"box": {"min": [0] * 3, "max": [0.12, 0.06, 1]}}}
        ],
        **more,
    }


def test_oil_beside_water_ends_up_on_top_and_all_is_weighed_right(tmp_path):
    sim = sph_ros.Simulation(two_liquids())
    family = sim.families
    assert [liquid.name for liquid in sim.scene.liquids] == ["water", "oil"]
    assert (family[:360] == 1).all() and (family[360:] == 0).all()
    assert sim.densities[family == 1].max() == pytest.approx(910.0, rel=0.02)
    volume = 0.01**3
    masses = np.where(family == 1, 910.0, 1000.0) * volume
    sim.advance(0.9)
    np.testing.assert_array_equal(sim.families, family)
    z = sim.positions[:, 2]
    assert z[family == 1].mean() > z[family == 0].mean() + 0.01
    for _ in range(10):
        before = sim.statistics()["momentum"]
        sim.step()
        momentum = masses @ sim.velocities.astype(float)
        np.testing.assert_allclose(sim.statistics()["momentum"], momentum, atol=1e-7)
        gained = sim.statistics()["momentum"] - before
        weight = masses.sum() * np.array([0.0, 0.0, -9.81])
        explained = (weight - sim.wrench("tank")[0]) * sim.time_step
        np.testing.assert_allclose(gained, explained, atol=2e-4 * sim.time_step * abs(weight[2]))
    sim.save(tmp_path / "state.npz")
    other = sph_ros.Simulation.load(tmp_path / "state.npz")
    sim.step()
    other.step()
    np.testing.assert_array_equal(sim.positions, other.positions)
    np.testing.assert_array_equal(sim.families, other.families)


def test_what_several_liquids_cannot_do_is_refused():
    with pytest.raises(SceneError, match=r"liquid\[0\].material: .*'oil' beside 'water'.*forces"):
        sph_ros.load_scene(two_liquids("relaxation"))
    with pytest.raises(SceneError, match="material.elasticity: .*'lennard_jones' knows no springs"):
        sph_ros.load_scene(two_liquids("lennard_jones", material="jelly"))
    with pytest.raises(SceneError, match="elasticity: .*several liquids meet"):
        sph_ros.load_scene(two_liquids(material="jelly"))


def test_pieces_that_differ_in_color_alone_are_one_liquid_to_the_solver():
    scene = two_liquids("relaxation")
    del scene["liquid"][0]["material"]
    sim = sph_ros.Simulation(scene)
    plain = dict(scene, liquid=[{"box": block["box"]} for block in scene["liquid"]])
    twin = sph_ros.Simulation(plain)
    for _ in range(3):
        sim.step()
        twin.step()
    np.testing.assert_array_equal(sim.positions, twin.positions)
    assert sorted(set(sim.families)) == [0, 1]
    assert set(twin.families) == {0}
