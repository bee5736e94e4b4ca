# SPDX-License-Identifier: Apache-2.0
"""The classic systems end as they should; coarser and shorter than packaged, to be quick."""

import math

import numpy as np
import pytest
import yaml
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

import sph_ros
from sph_ros.dam_house import Case, run_case, with_wall
from sph_ros.sim.scene import load_scene, scene_path


def described(name, **changes):
    """A packaged scene as a dict, with changes; its mesh files are found from anywhere."""
    path = scene_path(name)
    scene = yaml.safe_load(path.read_text(encoding="utf-8"))
    for solid in scene["solids"] if "solids" in scene else []:
        for kind in ("mesh", "surface"):
            if kind in solid:
                solid[kind]["file"] = str(path.parent / solid[kind]["file"])
    return {**scene, **changes}


def test_a_glass_is_filled_and_nothing_is_spilled():
    scene = described("pour_glass", spacing=0.006)
    count = 926  # as much water as 5,000 particles of the packaged scene
    scene["emitters"][0]["limit"] = count
    sim = sph_ros.Simulation(scene)
    force = []
    while sim.time < 2.6:
        sim.step()
        force.append(sim.wrench("glass")[0][2])
    facts = sim.statistics()
    assert facts["particle_count"] == facts["emitted_particles"] == count
    radius, base, volume = 0.032, 0.01, count * 0.006**3
    assert np.hypot(*sim.positions[:, :2].T).max() < radius and sim.positions[:, 2].min() > base
    level = base + volume / (math.pi * radius**2)
    assert np.percentile(sim.positions[:, 2], 97) == pytest.approx(level, abs=0.006)
    last = force[-round(0.4 / sim.time_step) :]
    assert np.mean(last) == pytest.approx(-1000 * volume * 9.81, rel=0.02)
    assert facts["mean_speed"] < 0.05  # particles rattle; the jet had 1.9 m/s


def test_two_drops_become_one_that_is_round():
    sim = sph_ros.Simulation(described("drops_merge", spacing=0.0025, support_radius=0.007))
    sim.advance(3.0)
    positions = sim.positions.astype(np.float64)
    near = cKDTree(positions).query_pairs(1.5 * 0.0025, output_type="ndarray")
    links = coo_array((np.ones(len(near)), near.T), shape=(len(positions),) * 2)
    assert connected_components(links, directed=False)[0] == 1
    centred = positions - positions.mean(axis=0)
    spread = np.linalg.eigvalsh(centred.T @ centred)
    assert math.sqrt(spread[0] / spread[2]) > 0.9  # two drops side by side: 0.45
    mass = len(positions) * 1000 * 0.0025**3
    assert np.linalg.norm(sim.statistics()["momentum"]) < 1e-4 * mass * 0.02


def test_rain_fills_its_container_and_settles():
    scene = described("rain_2d")
    scene["emitters"][0].update(position=[0.1, 0, 1.2], radius=0.09, limit=200)
    scene["solids"][0]["container"]["box"].update(min=[0, -0.05, 0], max=[0.2, 0.05, 1.3])
    sim = sph_ros.Simulation(scene)
    sim.advance(2.0)
    raining = sim.statistics()
    assert raining["emitted_particles"] == pytest.approx(100, abs=2)  # 50 a second
    sim.advance(4.0)
    settled = sim.statistics()
    assert settled["emitted_particles"] == settled["particle_count"] == 200
    assert settled["lost_particles"] == 0
    assert settled["mean_speed"] < 0.1 * raining["mean_speed"]
    depth = 200 * 0.0105**2 / 0.2
    assert sim.positions[:, 2].max() + 0.5 * 0.0105 == pytest.approx(depth, rel=0.1)


def test_where_rain_has_fallen_the_pool_is_calm():
    """What iterations leave of the pressures' errors once made sound that never ended."""
    scene = described("rain_2d", liquid=[{"box": {"min": [0, -1, 0], "max": [1, 1, 0.1]}}])
    scene["emitters"][0]["from"] = 1000
    sim = sph_ros.Simulation(scene)
    sim.advance(2.0)
    speeds, pushes = [], []
    while sim.time < 2.5:
        sim.step()
        speeds.append(sim.statistics()["mean_speed"])
        pushes.append(sim.wrench("container")[0][[0, 2]])
    assert max(speeds) < 0.003
    weight = sim.particle_count * 998.29 * 0.0105**2 * 9.81
    assert np.std(pushes, axis=0).max() < 0.02 * weight
    assert np.mean(pushes, axis=0) == pytest.approx([0.0, -weight], abs=0.01 * weight)


def test_a_column_comes_over_the_wall_and_the_basin_holds_what_fits():
    """2 m^2 stay behind the wall of 1 m, 3 m^2 come over it and reach the house."""
    basin = described("dam_house_2d")
    basin["liquid"][0]["box"]["max"][2] = 1.0
    sim = sph_ros.Simulation(basin)
    assert sim.particle_count == 200
    while sim.time < 4.0:
        sim.step()
        assert sim.positions[:, 0].max() < 2.0
    assert sph_ros.Simulation("dam_house_2d").particle_count == 300
    flood = run_case(Case(2.0, 1.0, seconds=4.0))
    # What stands above the wall, half of 2 m x 1.5 m at most, goes over it.
    assert 0.5 < flood.past < 1.05 and flood.wet_from < 3.0
    dry = run_case(Case(2.0, 2.2, seconds=4.0))
    assert dry.dry and dry.past == 0.0 and dry.reached < 2.0


def test_walls_of_the_study_are_where_they_are_asked_for():
    scene = with_wall(load_scene("dam_house_2d"), 3.0, 1.7)
    wall = next(solid for solid in scene.solids if solid.name == "wall")
    assert wall.shape.min == (3.0, -0.3, 0.0) and wall.shape.max == pytest.approx((3.1, 0.3, 1.7))
    assert [solid.name for solid in scene.solids] == ["basin", "wall", "house"]


def test_stirred_liquid_goes_round_with_the_stirrer_and_stays_in_the_cup():
    sim = sph_ros.Simulation(described("stirred_cup", spacing=0.005))
    count = sim.particle_count
    sim.advance(2.0)  # five turns
    x, y, z = sim.positions.astype(np.float64).T
    u, v, _ = sim.velocities.astype(np.float64).T
    r = np.hypot(x, y)
    spin = (x * v - y * u)[r > 0.01] / r[r > 0.01] ** 2
    stirrer = 2 * math.pi / 0.35
    assert 0.3 * stirrer < spin.mean() < stirrer
    assert sim.particle_count == count and z.min() > 0.0 and r.max() < 0.043
    # The surface is higher at the rim than in the middle.
    outside, inside = z[r > 0.03], z[r < 0.012]
    assert np.percentile(outside, 98) > np.percentile(inside, 98)


def test_a_fountain_rises_as_high_as_its_speed_says_and_drains_away():
    sim = sph_ros.Simulation("fountain")
    sim.advance(0.8)  # what rose first is down again
    before = sim.statistics()["particle_count"]
    sim.advance(0.3)
    facts = sim.statistics()
    assert sim.positions[:, 2].max() == pytest.approx(0.004 + 2.4**2 / (2 * 9.81), abs=0.006)
    assert facts["removed_particles"] == facts["emitted_particles"] - facts["particle_count"] > 1000
    assert facts["particle_count"] == pytest.approx(before, rel=0.05)
    assert (np.diff(sim.ids.astype(int)) > 0).all()


def test_oil_that_starts_beside_water_ends_on_top_of_it():
    sim = sph_ros.Simulation(described("oil_water", spacing=0.009, support_radius=0.0234))
    oil = sim.families == 1
    assert oil.sum() == 600 == (~oil).sum()
    masses = sim.densities  # of equal volumes
    assert np.median(masses[oil]) / np.median(masses[~oil]) == pytest.approx(0.75, rel=0.03)
    sim.advance(2.5)
    z = sim.positions[:, 2]
    assert (z[oil] > np.median(z)).mean() > 0.93 and (z[~oil] < np.median(z)).mean() > 0.93
    assert sim.statistics()["lost_particles"] == 0


def test_families_of_lennard_jones_particles_separate_and_the_light_one_rises():
    scene = described("lennard_jones")
    scene["liquid"][0]["box"]["max"][0] = scene["solids"][0]["container"]["box"]["max"][0] = 0.03
    sim = sph_ros.Simulation(scene)
    oil = sim.families == 1
    assert oil.sum() == 200 == (~oil).sum()

    def unlike():
        """Share of neighbours that are of two families."""
        near = cKDTree(sim.positions).query_pairs(1.4 * sim.scene.spacing, output_type="ndarray")
        return (oil[near[:, 0]] != oil[near[:, 1]]).mean()

    assert unlike() == pytest.approx(0.5, abs=0.05)
    np.testing.assert_allclose(sim.velocities.mean(axis=0), 0.0, atol=1e-6)
    np.testing.assert_allclose(sim.velocities.std(axis=0), [0.19, 0.0, 0.19], rtol=0.1)
    sim.advance(0.15)
    shares, lifts = [], []
    while sim.time < 0.25:
        sim.advance(0.01)
        shares.append(unlike())
        lifts.append(sim.positions[oil, 2].mean() - sim.positions[~oil, 2].mean())
    assert np.mean(shares) < 0.32
    assert np.mean(lifts) > 0.0015
    assert sim.statistics()["lost_particles"] == 0


def test_honey_coils():
    """Just above the plate the thread goes round and round, one way."""
    scene = described("honey_spoon", spacing=0.002)
    del scene["liquid"]  # what stays in the spoon
    sim = sph_ros.Simulation(scene)
    angles = []
    while sim.time < 1.2:
        sim.step()
        x = sim.positions
        thread = (x[:, 2] > 0.010) & (x[:, 2] < 0.016)
        if sim.time > 0.5 and thread.any():
            angles.append(math.atan2(*x[thread, 1::-1].mean(axis=0)))
    turned = np.unwrap(angles) / (2 * math.pi)
    assert abs(turned[-1] - turned[0]) > 2
    back = np.diff(turned[:: len(turned) // 20]) * np.sign(turned[-1] - turned[0])
    assert back.min() > -0.15


def test_cream_stands_as_it_was_laid():
    sim = sph_ros.Simulation(described("cream", spacing=0.003))
    sim.advance(2.3)  # the plate has come to rest

    def heap():
        x = sim.positions.astype(np.float64)
        x[:, 2] -= sim.solid("plate").position[2] + 0.004
        return np.percentile(x, 99, axis=0) - np.percentile(x, 1, axis=0)

    laid = heap()
    sim.advance(0.6)
    np.testing.assert_allclose(heap(), laid, rtol=0.03)
    facts = sim.statistics()
    assert laid[2] > 0.02 and facts["mean_speed"] < 0.01
    assert facts["particle_count"] == facts["emitted_particles"] > 600


def test_a_jelly_that_fell_stands_in_its_shape():
    sim = sph_ros.Simulation(described("jelly", spacing=0.006))
    height = np.ptp(sim.positions[:, 2])
    flattest = height
    while sim.time < 0.8:
        sim.step()
        flattest = min(flattest, np.ptp(sim.positions[:, 2]))
    assert flattest < 0.9 * height
    assert np.ptp(sim.positions[:, 2]) == pytest.approx(height, rel=0.1)
    x, _, z = sim.positions.T
    assert np.ptp(x[z < 0.02]) > 1.3 * np.ptp(x[z > 0.036])  # its two tiers


def test_a_ball_that_falls_into_water_throws_up_a_jet_and_sinks():
    sim = sph_ros.Simulation(described("ball_splash", spacing=0.015))
    level = sim.positions[:, 2].max()
    highest = 0.0
    while sim.time < 2.0:
        sim.step()
        x = sim.positions
        if 0.2 < sim.time < 0.5:
            middle = np.hypot(x[:, 0], x[:, 1]) < 0.04
            highest = max(highest, x[middle, 2].max(initial=0.0))
    assert highest > level + 0.06  # twice the jet's width above the water
    ball = sim.solid("ball")
    assert ball.position[2] == pytest.approx(0.035, abs=0.005)
    assert sim.statistics()["lost_particles"] == 0
    displaced = 4 / 3 * math.pi * 0.035**3 / 0.3**2
    z = np.percentile(x[:, 2], 98)
    assert z == pytest.approx(level + displaced, abs=0.012)
