# SPDX-License-Identifier: Apache-2.0
"""Springs: modulus, shape after a fall, cream against water, conservation, bookkeeping."""

import hashlib
import math

import numba
import numpy as np
import pytest

import sph_ros

SOLVERS = ("relaxation", "incompressible", "forces")


def springs_of(sim):
    """Mates as ids (-1: none) and lengths, in public order, (N, S)."""
    extras = sim._fluid.extras
    mates = sim._fluid.public(extras["spring_mates"]).astype(np.int64) - 1
    return mates, sim._fluid.public(extras["spring_lengths"])


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_shear_wave_swings_as_the_modulus_says(solver):
    """A standing wave across a free slab: a quarter of the period 1 / (k sqrt(G / rho) / 2 pi)."""
    modulus, wave = 2000.0, 2 * math.pi / 0.1
    bare = {"base": "air_like", "density": 1000.0, "compression": 0.01}
    sim = sph_ros.Simulation(
        {
            "solver": solver,
            "dimension": 2,
            "spacing": 0.01,
            "gravity": [0, 0, 0],
            "material": {**bare, "elasticity": modulus, "yield_strain": 1.0},
            "liquid": [{"box": {"min": [0, 0, 0], "max": [0.3, 1, 0.1]}}],
        }
    )
    start = sim.positions
    sim._fluid.velocities[:, 0] = 0.02 * np.cos(wave * start[:, 2])
    inner = np.abs(start[:, 0] - 0.15) < 0.08
    shape = np.cos(wave * start[inner, 2])
    period = 2 * math.pi / (wave * math.sqrt(modulus / 1000.0))
    amplitude, times = [], []
    while sim.time < 0.7 * period:
        sim.step()
        times.append(sim.time)
        amplitude.append(((sim.positions - start)[inner, 0] * shape).mean())
    first = np.flatnonzero(np.array(amplitude)[1:] * np.array(amplitude)[:-1] < 0)[0]
    assert times[first + 1] == pytest.approx(period / 2, rel=0.15)
    assert max(amplitude) == pytest.approx(0.01 / (wave * math.sqrt(modulus / 1000.0)), rel=0.2)


def box_of(sim):
    low, high = np.percentile(sim.positions, [2, 98], axis=0)
    return high - low


def dropped(material, **more):
    return {
        "spacing": 0.006,
        "material": material,
        "liquid": [{"box": {"min": [-0.03, -0.03, 0.03], "max": [0.03, 0.03, 0.078]}}],
        "solids": [{"name": "ground", "plane": {}}],
        **more,
    }


def test_a_jelly_that_falls_gets_its_shape_back():
    sim = sph_ros.Simulation(dropped("jelly"))
    before = box_of(sim)
    flattest = 1.0
    while sim.time < 0.8:
        sim.step()
        flattest = min(flattest, box_of(sim)[2] / before[2])
    assert flattest < 0.93
    # It sags by its weight, rho g H / 2 over three times the modulus: 4 %.
    np.testing.assert_allclose(box_of(sim) / before, 1.0, atol=0.08)
    assert sim.statistics()["lost_particles"] == 0


def test_cream_holds_a_heap_where_water_spreads():
    heap = [{"cylinder": {"radius": 0.024, "length": 0.03}, "pose": {"position": [0, 0, 0.015]}}]
    heights = {}
    for name in ("cream", "water"):
        sim = sph_ros.Simulation(dropped(name, liquid=heap))
        before = box_of(sim)
        sim.advance(0.35)
        heights[name] = box_of(sim)[2] / before[2]
        if name == "cream":
            settled = box_of(sim)[2]
            sim.advance(0.15)
            assert box_of(sim)[2] > 0.97 * settled  # it has come to a stop
    assert heights["cream"] > 0.75
    assert heights["water"] < 0.4


@pytest.mark.parametrize("name", ["cream", "jelly"])
def test_springs_of_cream_follow_a_large_shear_and_those_of_jelly_do_not(name):
    sim = sph_ros.Simulation(
        {
            "dimension": 2,
            "spacing": 0.01,
            "gravity": [0, 0, 0],
            "material": name,
            "liquid": [{"box": {"size": [0.1, 1, 0.1]}}],
        }
    )
    sim.step()
    before, lengths = springs_of(sim)
    sim._fluid.positions[:, 0] += 0.3 * sim._fluid.positions[:, 2]
    sim._fluid.velocities[:] = 0.0
    sim.step()
    after, now = springs_of(sim)
    same = (before == after) & (before >= 0)
    assert same.sum() > 0.5 * (before >= 0).sum()
    # A shear of 0.3 lengthens by up to 16 %, and cream yields from 10 % on.
    assert (np.abs(now - lengths)[same].max() > 0.0) == (name == "cream")


def colliding():
    return {
        "spacing": 0.01,
        "gravity": [0, 0, 0],
        "material": "cream",
        "liquid": [
            {"sphere": {"radius": 0.03}, "velocity": [0.6, 0, 0]},
            {
                "sphere": {"radius": 0.03},
                "pose": {"position": [0.07, 0, 0.02]},
                "velocity": [-0.6, 0, 0.1],
            },
        ],
    }


def test_momentum_is_kept_and_both_ends_of_a_spring_agree():
    sim = sph_ros.Simulation(colliding())
    start = sim.statistics()["momentum"]
    sim.advance(0.15)
    mass = sim.particle_count * 1000.0 * 0.01**3
    assert np.abs(sim.statistics()["momentum"] - start).max() < 1e-5 * mass
    mates, lengths = springs_of(sim)
    found = {}
    for own, (row, ends) in enumerate(zip(mates, lengths, strict=True)):
        alive = row[row >= 0]
        assert len(set(alive.tolist())) == len(alive) and own not in alive
        found.update({(own, int(m)): length for m, length in zip(row, ends, strict=True) if m >= 0})
    assert found and all(found[b, a] == length for (a, b), length in found.items())
    both = np.arange(sim.particle_count) < sim.particle_count // 2
    assert any(both[a] != both[b] for a, b in found)  # cream sticks to cream
    x = sim.positions
    longest = max(np.linalg.norm(x[a] - x[b]) for a, b in found)
    assert longest < 1.6 * sim.scene.support_radius


def test_same_bits_for_any_number_of_threads_and_from_a_snapshot(tmp_path):
    def digest(sim):
        return hashlib.sha256(sim.positions.tobytes() + springs_of(sim)[1].tobytes()).hexdigest()

    found = []
    before = numba.get_num_threads()
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        numba.set_num_threads(threads)
        sim = sph_ros.Simulation(colliding())
        for step in range(40):
            sim.step()
            if step == 20:
                sim.save(tmp_path / "half.npz")
        found.append(digest(sim))
    numba.set_num_threads(before)
    other = sph_ros.Simulation.load(tmp_path / "half.npz")
    for _ in range(19):
        other.step()
    assert set(found) == {digest(other)}


def test_springs_to_what_a_sink_took_are_gone_and_switching_off_forgets_them():
    sinks = [{"box": {"min": [-1, -1, -1], "max": [0, 1, 1]}}]
    sim = sph_ros.Simulation({**colliding(), "sinks": sinks})
    sim.step()
    sim.step()
    ids = set(sim.ids.tolist())
    assert len(ids) < 210
    mates, _ = springs_of(sim)
    assert set(mates[mates >= 0].tolist()) <= ids
    sim.set_material(elasticity=0.0)
    sim.step()
    assert "spring_mates" not in sim._fluid.extras


def test_a_solver_without_springs_says_so():
    scene = {**colliding(), "material": "water", "solver": "none"}
    sim = sph_ros.Simulation(scene)
    sim.set_material(elasticity=10.0)
    assert "knows no springs" in sim.notes[0]
    sim.step()


def test_a_stiff_jelly_that_fills_the_corners_of_a_box_does_not_jump():
    """Its steps are short, so the excess of density there has to be taken back in more of them."""
    box = {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}
    tank = {"name": "tank", "container": {"box": {**box, "max": [0.1, 0.1, 0.3]}}}
    sim = sph_ros.Simulation(
        {
            "spacing": 0.02,
            "solver": "incompressible",
            "material": {"base": "water", "elasticity": 3e4},
            "liquid": [{"box": box}],
            "solids": [tank],
        }
    )
    assert "elasticity" in sim.time_step_reason
    fastest = 0.0
    for _ in range(50):
        sim.step()
        fastest = max(fastest, sim.statistics()["mean_speed"])
    assert fastest < 0.2
