# SPDX-License-Identifier: Apache-2.0
"""Flywheels: vortices live longer, nothing else moves, both momenta and the energy are kept."""

import hashlib

import numba
import numpy as np
import pytest

import sph_ros
from sph_ros.core import spins as core
from sph_ros.sim.spins import SPINS, STRENGTH, lattice_numbers

BARE = {"base": "water", "surface_tension": 0.0, "wall_friction": 0.0}


def spins_of(sim):
    """Angular velocities in public order [rad/s], (N, 3) float64."""
    return sim._fluid.public(sim._fluid.extras[SPINS]).astype(float)


def angular_momentum(sim, radius):
    """Of the liquid and its flywheels, per mass of a particle [m^2/s], (3,) each."""
    x, v = sim.positions.astype(float), sim.velocities.astype(float)
    return np.cross(x, v).sum(axis=0), radius**2 * spins_of(sim).sum(axis=0)


def energy(sim, radius):
    """Kinetic, of the liquid and its flywheels, per mass of a particle [m^2/s^2]."""
    square = (sim.velocities.astype(float) ** 2).sum()
    return 0.5 * square + 0.5 * radius**2 * (spins_of(sim) ** 2).sum()


def vortex(radius, solver="incompressible"):
    """A vortex ten spacings in radius in a drum without friction, and its speed there [m/s]."""
    scene = {
        "spacing": 0.01,
        "dimension": 2,
        "gravity": [0, 0, 0],
        "solver": solver,
        "material": {**BARE, "gyration_radius": radius},
        "liquid": [{"sphere": {"radius": 0.3}}],
        "solids": [{"name": "drum", "container": {"sphere": {"radius": 0.3}}}],
    }
    sim = sph_ros.Simulation(scene)
    velocities, x = sim._fluid.velocities, sim._fluid.positions
    rate = 5.0 * np.exp(0.5 * (1.0 - (np.linalg.norm(x, axis=1) / 0.1) ** 2))
    velocities[:, 0], velocities[:, 2] = -rate * x[:, 2], rate * x[:, 0]

    def speed():
        x, v = sim.positions, sim.velocities
        r = np.linalg.norm(x, axis=1)
        ring = np.abs(r - 0.1) < 0.03
        return ((v[:, 2] * x[:, 0] - v[:, 0] * x[:, 2]) / np.maximum(r, 1e-9))[ring].mean()

    return sim, speed


@pytest.mark.parametrize("solver", ["incompressible", "relaxation"])
def test_a_vortex_keeps_more_of_its_speed_with_flywheels(solver):
    left = {}
    for radius in (0.0, 0.1):
        sim, speed = vortex(radius, solver)
        start = speed()
        sim.step()
        if radius:
            before, total = energy(sim, radius), sum(angular_momentum(sim, radius))[1]
        sim.advance(3.0)
        left[radius] = speed() / start
        assert (SPINS in sim._fluid.extras) == (radius > 0.0)
    assert left[0.1] > 1.3 * left[0.0]
    assert energy(sim, 0.1) < before
    if solver == "incompressible":  # the other one loses angular momentum without flywheels, too
        assert sum(angular_momentum(sim, 0.1))[1] == pytest.approx(total, rel=1e-5)


def colliding(**more):
    return {
        "spacing": 0.01,
        "gravity": [0, 0, 0],
        "solver": "incompressible",
        "material": {**BARE, "gyration_radius": 0.02},
        "liquid": [
            {"sphere": {"radius": 0.03}, "velocity": [0.6, 0, 0]},
            {
                "sphere": {"radius": 0.03},
                "pose": {"position": [0.05, 0, 0.03]},
                "velocity": [-0.6, 0, 0.1],
            },
        ],
        **more,
    }


def test_drops_that_collide_off_centre_keep_both_momenta():
    sim = sph_ros.Simulation(colliding())
    sim.step()
    momentum = sim.velocities.astype(float).sum(axis=0)
    orbital, spin = angular_momentum(sim, 0.02)
    assert np.abs(spin).max() < 0.05 * np.abs(orbital).max()
    sim.advance(0.3)
    count = sim.particle_count
    assert np.abs(sim.velocities.astype(float).sum(axis=0) - momentum).max() < 1e-6 * count
    now = angular_momentum(sim, 0.02)
    assert np.abs(now[1] - spin).max() > 0.02 * np.abs(orbital).max()  # the flywheels took part
    assert np.abs(sum(now) - orbital - spin).max() < 1e-5 * np.abs(orbital).max()


def test_still_water_stays_as_still_as_without():
    speeds, levels = [], []
    for radius in (0.0, 0.05):
        sim = sph_ros.Simulation(
            {
                "spacing": 0.01,
                "solver": "incompressible",
                "material": {**BARE, "gyration_radius": radius},
                "liquid": [{"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}}],
                "solids": [
                    {"name": "t", "container": {"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.3]}}}
                ],
            }
        )
        sim.advance(1.0)
        speeds.append(sim.statistics()["mean_speed"])
        levels.append(sim.positions[:, 2].mean())
    assert speeds[1] < max(speeds[0], 1e-3)
    assert levels[1] == pytest.approx(levels[0], abs=3e-4)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("ratio", [1.6, 2.0, 3.0])
def test_however_the_particles_lie_rubbing_takes_energy_and_a_rigid_rotation_does_not_rub(
    dimension, ratio
):
    size = 0.3 if dimension == 2 else 0.1
    sim = sph_ros.Simulation(
        {
            "spacing": 0.01,
            "dimension": dimension,
            "support_radius": 0.01 * ratio,
            "solver": "incompressible",
            "material": BARE,
            "liquid": [{"box": {"size": [size, size, size]}}],
        }
    )
    fluid, solver = sim._fluid, sim._solver
    random = np.random.default_rng(1)
    plane = [0, 2] if dimension == 2 else [0, 1, 2]
    fluid.positions[:, plane] = random.uniform(0, 0.8 * size, (len(fluid), dimension))
    solver.densities(fluid)  # makes the lists
    work, scale = solver._work, solver.scales.density_scale * solver._packing
    fluid.positions[:] = work.predicted
    determinant, square = lattice_numbers(solver._power, 0.01 * ratio, 0.01, dimension)

    def rub(velocities, spins, strength, radius):
        core.rub_spins(
            work.pairs,
            work.predicted,
            work.sums,
            velocities,
            np.float32(determinant * scale**3),
            np.float32(square * scale**2),
            np.float32(4.0 * strength * 1e-4),
            np.float32(radius**2),
            False,
            spins,
            work.scratch,
        )
        core.push_by_spins(work.pairs, work.scratch, velocities)
        return 0.5 * (velocities**2).sum(dtype=float) + 0.5 * radius**2 * (spins**2).sum(
            dtype=float
        )

    velocities, spins = np.zeros((2, len(fluid), 3), np.float32)
    velocities[:, plane] = random.normal(size=(len(fluid), dimension))
    energies = [0.5 * (velocities**2).sum(dtype=float)]
    for _ in range(100):
        energies.append(rub(velocities, spins, 2.0 * STRENGTH, 1.0))
    assert (np.diff(energies) < 1e-6 * energies[0]).all()
    assert energies[-1] < 0.95 * energies[0]
    turning = np.array([0.0, 1.0, 0.0] if dimension == 2 else [0.3, 1.0, -0.5])
    velocities[:] = before = np.cross(turning, fluid.positions)
    spins[:] = turning
    rub(velocities, spins, STRENGTH, 0.05)
    np.testing.assert_allclose(velocities, before, atol=1e-6)
    np.testing.assert_allclose(spins, np.broadcast_to(turning, spins.shape), atol=1e-4)


def test_same_bits_for_any_number_of_threads_and_from_a_snapshot(tmp_path):
    """While particles come and go, and so the rows of the spins."""
    scene = colliding(
        emitters=[{"position": [0, 0, 0.2], "radius": 0.02, "speed": 1.0, "direction": [0, 0, -1]}],
        sinks=[{"plane": {"offset": -0.02}}],
    )

    def digest(sim):
        return hashlib.sha256(sim.positions.tobytes() + spins_of(sim).tobytes()).hexdigest()

    found, before = [], numba.get_num_threads()
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        numba.set_num_threads(threads)
        sim = sph_ros.Simulation(scene)
        for step in range(30):
            sim.step()
            if step == 14:
                sim.save(tmp_path / "half.npz")
        found.append(digest(sim))
    numba.set_num_threads(before)
    other = sph_ros.Simulation.load(tmp_path / "half.npz")
    for _ in range(15):
        other.step()
    assert set(found) == {digest(other)}
    assert sim.statistics()["emitted_particles"] > 0 < sim.statistics()["removed_particles"]
    sim.reset()
    for _ in range(30):
        sim.step()
    assert digest(sim) == found[0]


def test_switched_off_spins_are_forgotten_and_leave_no_trace():
    sim, twin = (sph_ros.Simulation(colliding(material=BARE)) for _ in range(2))
    sim.set_material(gyration_radius=0.1)
    sim.set_material(gyration_radius=0.0)
    for each in (sim, twin):
        each.step()
    np.testing.assert_array_equal(sim.velocities, twin.velocities)
    sim.set_material(gyration_radius=0.1)
    sim.step()
    assert SPINS in sim._fluid.extras
    sim.set_material(gyration_radius=0.0)
    sim.step()
    assert SPINS not in sim._fluid.extras


def test_solvers_without_spins_say_so():
    for solver in ("forces", "none"):
        why = f"gyration_radius: .*'{solver}' knows no spins"
        with pytest.raises(sph_ros.SceneError, match=why):
            sph_ros.load_scene(colliding(solver=solver))
    sim = sph_ros.Simulation(colliding(solver="none", material=BARE))
    sim.set_material(gyration_radius=0.1)
    assert "knows no spins" in sim.notes[0]
    sim.step()
