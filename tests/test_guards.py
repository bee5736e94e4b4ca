# SPDX-License-Identifier: Apache-2.0
"""Parameters that would explode are tamed and said; the first NaN stops a simulation with facts."""

import itertools

import numpy as np
import pytest

import sph_ros
from sph_ros.sim.abilities import LIQUID_SOLVERS, SOLVERS
from sph_ros.sim.guards import UnstableError
from sph_ros.sim.materials import MATERIALS, RANGES

TANK = {
    "spacing": 0.02,
    "liquid": [{"box": {"min": [0, 0, 0], "max": [0.16, 0.16, 0.1]}}],
    "solids": [
        {"name": "tank", "container": {"box": {"min": [0, 0, 0], "max": [0.16, 0.16, 0.4]}}},
        {
            "name": "ball",
            "sphere": {"radius": 0.04},
            "pose": {"position": [0.08, 0.08, 0.2]},
            "control": "topic",
        },
    ],
}


#: Arrays that the next step depends on; only solvers that iterate start from the last pressures.
STATE = [
    (name, solver)
    for name in ("velocities", "positions", "pressures")
    for solver in SOLVERS
    if name != "pressures" or solver in ("relaxation", "incompressible")
]


@pytest.mark.parametrize(("name", "solver"), STATE)
def test_the_first_nan_stops_with_step_particle_cause_and_the_state_before(
    name, solver, tmp_path, monkeypatch
):
    monkeypatch.setenv("SPH_ROS_RESCUE", str(tmp_path))
    sim = sph_ros.Simulation({**TANK, "name": "a tank", "solver": solver})
    sim.move_solid("ball", [0.08, 0.08, 0.05], time=0.3)
    for _ in range(7):
        sim.step()
    rows = getattr(sim._fluid, name)
    rows[5] = np.nan
    with pytest.raises(UnstableError) as caught:
        sim.step()
    fault, particle = caught.value, sim._fluid.particle
    assert fault.step == 8 and fault.particle is not None and "before the step" in fault.cause
    assert fault.path == tmp_path / "sph_ros_a_tank_before_step_8.npz"
    text = str(fault)
    assert "\n" not in text
    for word in ("step 8", f"particle {fault.particle}", fault.cause, str(fault.path)):
        assert word in text
    assert sorted(particle) == list(range(sim.particle_count))
    before = sph_ros.Simulation.load(fault.path)
    assert before.time == pytest.approx(7 * sim.time_step)
    assert np.argwhere(~np.isfinite(getattr(before._fluid, name)))[0][0] == 5
    with pytest.raises(UnstableError, match="step 8"):  # stopped is stopped
        sim.step()
    sim.reset()
    sim.step()
    assert np.isfinite(sim.positions).all()


def test_what_overflows_within_a_step_is_named_and_the_state_before_is_sound(tmp_path, monkeypatch):
    monkeypatch.setenv("SPH_ROS_RESCUE", str(tmp_path))
    sim, twin = sph_ros.Simulation(TANK), sph_ros.Simulation(TANK)
    for _ in range(3):
        sim.step()
        twin.step()
    row = int(np.flatnonzero(sim._fluid.particle == 11)[0])
    sim._fluid.velocities[row] = 3e38
    sim._solver.fastest = 0.0
    with pytest.raises(UnstableError, match="particle 11: .* became no number first") as caught:
        sim.step()
    before = sph_ros.Simulation.load(caught.value.path)
    np.testing.assert_array_equal(before.positions, twin.positions)


def test_a_tension_that_no_step_can_bear_is_lowered_and_said():
    taut = {"surface_tension": 10.0, "density": 100.0}
    sim = sph_ros.Simulation({**TANK, "time_step": 0.1, "material": taut})
    assert len(sim.notes) == 1 and "surface_tension: 10 N/m" in sim.notes[0]
    sim.step()
    assert 1 < sim.statistics()["substeps"] <= 60
    assert sim.material.surface_tension == 10.0
    sim.set_material(surface_tension=0.07)
    assert all("surface_tension" not in note for note in sim.notes)
    assert sph_ros.Simulation(TANK).notes == []
    long = sph_ros.Simulation({**TANK, "time_step": 0.05})
    assert len(long.notes) == 1 and "time_step: 0.05 s is stable only in" in long.notes[0]


CORNERS = list(itertools.product((0, 1), repeat=3))


@pytest.mark.parametrize("solver", LIQUID_SOLVERS)
@pytest.mark.parametrize("corner", CORNERS)
def test_no_corner_of_the_materials_ranges_explodes(corner, solver):
    """A ball that jumps through liquids with extreme numbers, near and far neighbours."""
    thick, heavy, wide = corner
    material = {field: RANGES[field][thick] for field in ("viscosity", "surface_tension")}
    material |= {field: RANGES[field][heavy] for field in ("density", "wall_friction", "adhesion")}
    material["quadratic_viscosity"] = RANGES["quadratic_viscosity"][1]
    material["compression"] = RANGES["compression"][1 - heavy]
    scene = {**TANK, "material": material, "solver": solver}
    scene["support_radius"] = 0.06 if wide else 0.032
    # Explicit viscosity would cut a step of 2 ms into 50,000.
    step = min(0.002, sph_ros.Simulation(scene).time_step) if solver == "forces" else 0.002
    sim = sph_ros.Simulation({**scene, "time_step": step})
    # Twice what the ball's 3 m/s and the tension of a drop of one particle can bring about.
    speed = 6.0 + 2.0 * np.sqrt(material["surface_tension"] / (material["density"] * 0.02))
    step = substeps = 0
    while substeps < 60:
        step += 1
        sim.move_solid("ball", [0.08 + 0.04 * np.sin(step), 0.08, max(0.2 - 0.016 * step, 0.05)])
        sim.step()
        substeps += sim.statistics()["substeps"]
        assert sim.statistics()["max_speed"] < speed
    assert sim.statistics()["lost_particles"] == 0


def test_packaged_materials_say_all_they_are():
    light = MATERIALS["air_like"]
    assert light.density < 2.0 and light.viscosity == light.surface_tension == 0.0
    sim = sph_ros.Simulation({**TANK, "material": "air_like"})
    sim.advance(0.1)
    assert sim.statistics()["max_compression"] < 0.2
    weight = -sim.wrench("tank")[0][2]
    assert weight == pytest.approx(sim.particle_count * 1.2 * 0.02**3 * 9.81, rel=0.3)
