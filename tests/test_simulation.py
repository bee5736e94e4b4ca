# SPDX-License-Identifier: Apache-2.0
"""What users rely on in `Simulation`: arrays, solids, reset, snapshots, live materials."""

import numpy as np
import pytest

import sph_ros
from sph_ros.sim.snapshots import SnapshotError

SCENE = {
    "spacing": 0.02,
    "material": "water",
    "liquid": [{"box": {"min": [0, 0, 0], "max": [0.2, 0.2, 0.1]}}],
    "solids": [
        {"name": "tank", "container": {"box": {"min": [0, 0, 0], "max": [0.2, 0.2, 0.3]}}},
        {
            "name": "ball",
            "sphere": {"radius": 0.03},
            "pose": {"position": [0.1, 0.1, 0.2]},
            "control": "topic",
        },
        {
            "name": "arm",
            "capsule": {"radius": 0.01, "length": 0.05},
            "pose": {"position": [0.1, 0.1, 0.4]},
            "control": "path",
            "path": [
                {"time": 0.1, "position": [0.1, 0.1, 0.4]},
                {"time": 0.5, "position": [0.1, 0.1, 0.3]},
            ],
        },
    ],
}


@pytest.fixture(params=["relaxation", "incompressible"])
def sim(request):
    return sph_ros.Simulation({**SCENE, "solver": request.param})


def test_arrays_have_the_promised_shapes_and_are_copies(sim):
    count = sim.particle_count
    assert count == 10 * 10 * 5
    assert sim.positions.shape == sim.velocities.shape == (count, 3)
    assert sim.positions.dtype == sim.velocities.dtype == sim.densities.dtype == np.float32
    assert sim.densities.shape == sim.ids.shape == (count,)
    assert sim.ids.dtype == np.uint32
    assert len(set(sim.ids.tolist())) == count
    sim.positions[:] = 0.0
    assert sim.positions.max() > 0.1


def test_particles_are_all_of_these_in_one(sim):
    sim.advance(0.05)
    cloud = sim.particles
    assert cloud.dtype.names == ("x", "y", "z", "vx", "vy", "vz", "density", "id")
    columns = [cloud[name] for name in cloud.dtype.names]
    np.testing.assert_array_equal(np.stack(columns[:3], axis=1), sim.positions)
    np.testing.assert_array_equal(np.stack(columns[3:6], axis=1), sim.velocities)
    np.testing.assert_array_equal(columns[6], sim.densities)
    np.testing.assert_array_equal(columns[7], sim.ids)


def test_a_row_is_the_same_particle_for_ever(sim):
    before = sim.positions
    sim.step()
    # Sorting moves rows about inside; in a single step no particle gets a spacing away.
    assert np.linalg.norm(sim.positions - before, axis=1).max() < 0.5 * sim.scene.spacing


def test_densities_are_those_at_rest_inside_and_less_at_the_surface(sim):
    density = sim.densities
    inner = (np.abs(sim.positions - [0.1, 0.1, 0.05]) < 0.03).all(axis=1)
    np.testing.assert_allclose(density[inner], 1000.0, rtol=1e-3)
    # At the surface the upper half of the lattice is missing.
    power = {"relaxation": 2, "incompressible": 3}[sim.scene.solver]
    offsets = np.array(list(np.ndindex(5, 5, 5))) - 2
    weights = np.maximum(1.0 - np.linalg.norm(offsets, axis=1) / 2.0, 0.0) ** power
    left = 1.0 - weights[offsets[:, 2] > 0].sum() / weights.sum()
    middle = (np.abs(sim.positions[:, :2] - 0.1) < 0.05).all(axis=1)
    top = middle & (sim.positions[:, 2] > 0.089)
    np.testing.assert_allclose(density[top], 1000.0 * left, rtol=1e-3)


def test_time_is_a_whole_number_of_steps(sim):
    sim.advance(0.1)
    assert sim.time == pytest.approx(0.1, abs=sim.time_step)
    assert sim.time / sim.time_step == pytest.approx(round(sim.time / sim.time_step))
    with pytest.raises(ValueError, match="seconds"):
        sim.advance(float("nan"))


def test_a_solid_sweeps_to_its_pose_at_the_time_it_is_told(sim):
    sim.move_solid("ball", [0.1, 0.1, 0.1], [0, 0, 0, 2.0], time=0.2)
    heights = []
    while sim.time < 0.25:
        sim.step()
        heights.append(sim.solid("ball").position[2])
    assert heights[0] > 0.19
    assert np.all(np.diff(heights) <= 1e-12)
    assert sim.solid("ball").position == pytest.approx([0.1, 0.1, 0.1])
    assert sim.solid("ball").velocity == pytest.approx([0, 0, 0])


def test_a_jump_is_swept_no_faster_than_the_scene_allows(sim):
    sim.move_solid("ball", [3.1, 0.1, 0.2])
    sim.step()
    assert np.linalg.norm(sim.solid("ball").velocity) <= sim.scene.max_solid_speed * (1 + 1e-9)
    sim.advance(1.2)
    assert sim.solid("ball").position == pytest.approx([3.1, 0.1, 0.2])


def test_a_solid_turns_the_shorter_way_with_a_steady_angular_velocity(sim):
    half = np.sqrt(0.5)
    sim.move_solid("ball", [0.1, 0.1, 0.2], [0, 0, half, half], time=0.5)
    sim.advance(0.25)
    assert sim.solid("ball").angular_velocity == pytest.approx([0, 0, np.pi], rel=1e-6)
    sim.advance(0.3)
    assert np.abs(sim.solid("ball").quat_xyzw) == pytest.approx([0, 0, half, half])


def test_a_path_is_followed(sim):
    sim.advance(0.3)
    assert sim.solid("arm").position[2] == pytest.approx(0.35, abs=0.003)
    sim.advance(0.4)
    assert sim.solid("arm").position == pytest.approx([0.1, 0.1, 0.3])


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        (("nobody", [0, 0, 0]), KeyError, "nobody.*tank.*ball"),
        (("tank", [0, 0, 0]), ValueError, "fixed"),
        (("ball", [0, np.nan, 0]), ValueError, "ball: position"),
        (("ball", [0, 0]), ValueError, "three finite numbers"),
        (("ball", [1e300, 0, 0]), ValueError, "up to 10000"),
        (("ball", [0, 0, 0], [0, 0, 0, 0]), ValueError, "length zero"),
        (("ball", [0, 0, 0], [0, 0, np.inf, 0]), ValueError, "four finite"),
        (("ball", [0, 0, 0], [0, 0, 0, 1], np.inf), ValueError, "time"),
    ],
)
def test_orders_that_make_no_sense_are_refused(sim, arguments, error, words):
    before = sim.solid("ball").position.copy()
    with pytest.raises(error, match=words):
        sim.move_solid(*arguments)
    sim.step()
    np.testing.assert_array_equal(sim.solid("ball").position, before)


def state(sim):
    return sim.positions.tobytes() + sim.velocities.tobytes() + sim.densities.tobytes()


def stir(sim, steps):
    for step in range(steps):
        sim.move_solid("ball", [0.1, 0.1, 0.2 - 0.004 * (step % 30)])
        sim.step()


def test_reset_starts_over_to_the_bit(sim):
    stir(sim, 30)
    first = state(sim)
    sim.reset()
    assert sim.time == 0.0
    stir(sim, 30)
    assert state(sim) == first


def test_asking_changes_nothing(sim):
    twin = sph_ros.Simulation(sim.scene)
    for _ in range(5):
        assert sim.densities.max() > 0 and sim.statistics() and len(sim.surface())
        sim.step()
        twin.step()
    assert state(sim) == state(twin)


def test_a_snapshot_goes_on_to_the_bit(sim, tmp_path):
    stir(sim, 25)
    sim.set_material(viscosity=0.5)
    sim.move_solid("ball", [0.05, 0.1, 0.1], time=0.6)
    sim.save(tmp_path / "state.npz")
    other = sph_ros.Simulation.load(tmp_path / "state.npz")
    assert other.time == sim.time and other.material == sim.material
    assert state(other) == state(sim)
    for _ in range(20):
        sim.step()
        other.step()
    assert state(other) == state(sim)
    assert np.array_equal(other.wrench("ball")[0], sim.wrench("ball")[0])
    assert [p.name for p in tmp_path.iterdir()] == ["state.npz"]


def test_a_snapshot_keeps_the_step_and_the_last_wrench(sim, tmp_path):
    sim.set_material(surface_tension=5.0)
    sim.reset()
    stir(sim, 10)
    sim.save(tmp_path / "state.npz")
    other = sph_ros.Simulation.load(tmp_path / "state.npz")
    assert (other.time, other.time_step) == (sim.time, sim.time_step)
    np.testing.assert_array_equal(other.wrench("tank"), sim.wrench("tank"))
    mine, theirs = sim.statistics(), other.statistics()
    assert all(np.array_equal(mine[key], theirs[key]) for key in mine)


def test_arrays_of_the_caller_stay_the_callers(sim):
    place = np.array([0.1, 0.1, 0.15])
    sim.move_solid("ball", place)
    place[:] = 9.0
    sim.advance(0.2)
    place[:] = 7.0
    assert sim.solid("ball").position == pytest.approx([0.1, 0.1, 0.15])
    with pytest.raises(ValueError, match="read-only"):
        sim.solid("ball").position[0] = 1.0


def test_an_endless_plane_that_tilts_far_from_its_origin_lets_nothing_in():
    sim = sph_ros.Simulation(
        {
            "spacing": 0.02,
            "material": "water",
            "liquid": [{"box": {"min": [2.9, 0, 0.3], "max": [3.1, 0.1, 0.4]}}],
            "solids": [{"name": "ground", "plane": {}, "control": "topic"}],
        }
    )
    sim.move_solid("ground", [0, 0, 0], [0, -np.sin(0.15), 0, np.cos(0.15)], time=0.5)
    while sim.time < 0.7:
        sim.step()
        assert sim.solid("ground").signed_distance(sim.positions).min() > -0.05 * 0.02
    assert sim.statistics()["max_speed"] < 10.0


def test_two_dimensions_keep_their_plane_whatever_the_poses():
    sim = sph_ros.Simulation(
        {
            "spacing": 0.02,
            "dimension": 2,
            "gravity": [0, 3.0, -9.81],
            "material": "water",
            "liquid": [{"box": {"min": [0, -0.1, 0], "max": [0.4, 0.1, 0.2]}}],
            "solids": [
                {"name": "tank", "container": {"box": {"min": [0, -1, 0], "max": [0.4, 1, 0.6]}}},
                {
                    "name": "box",
                    "box": {"size": [0.08, 2, 0.08]},
                    "pose": {"position": [0.2, 0, 0.4]},
                    "control": "topic",
                },
            ],
        }
    )
    for step in range(60):
        turn = [0.3 * np.sin(step), 0.5, 0.2, 1.0]
        sim.move_solid("box", [0.2, 0.05, 0.4 - 0.005 * step], turn)
        sim.step()
        assert sim.solid("box").signed_distance(sim.positions).min() > -0.05 * 0.02
    assert np.all(sim.positions[:, 1] == 0.0)


def test_what_is_no_snapshot_is_refused(tmp_path):
    with pytest.raises(SnapshotError, match="no such file"):
        sph_ros.Simulation.load(tmp_path / "missing.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(SnapshotError, match="text.npz"):
        sph_ros.Simulation.load(tmp_path / "text.npz")
    sph_ros.Simulation(SCENE).save(tmp_path / "whole.npz")
    with np.load(tmp_path / "whole.npz") as whole:
        arrays = dict(whole)
    np.savez(tmp_path / "cut.npz", **{**arrays, "velocities": arrays["velocities"][:9]})
    with pytest.raises(SnapshotError, match="velocities: expected float32"):
        sph_ros.Simulation.load(tmp_path / "cut.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(SnapshotError, match="other.npz"):
        sph_ros.Simulation.load(tmp_path / "other.npz")


def test_materials_change_live_and_bad_values_change_nothing(sim):
    with pytest.raises(ValueError, match="viscosity: expected 0 to"):
        sim.set_material(viscosity=-1.0)
    with pytest.raises(ValueError, match="density: expected"):
        sim.set_material(viscosity=2.0, density=float("nan"))
    with pytest.raises(ValueError, match="colour"):
        sim.set_material(colour=3)
    assert sim.material.viscosity == 0.001
    sim.set_material(viscosity=100.0, density=1400.0)
    sim.advance(0.2)
    assert sim.densities.max() > 1300.0
    assert sim.statistics()["max_speed"] < 0.5


def energy_left(viscosity, size, profile, time):
    """Share of the energy that a free slab moving along x as profile(z) [m/s] still has."""
    sim = sph_ros.Simulation(
        {
            "spacing": 0.01,
            "gravity": [0, 0, 0],
            "material": {"base": "air_like", "density": 1000.0, "viscosity": viscosity},
            "liquid": [{"box": {"min": [0, 0, 0], "max": size}}],
        }
    )
    sim._fluid.velocities[:, 0] = profile(sim.positions[:, 2])
    start = sim.statistics()["kinetic_energy"]
    sim.advance(time)
    return sim.statistics()["kinetic_energy"] / start


def test_shear_decays_with_the_viscosity_asked_for():
    """A wave across a long slab, free of momentum and angular momentum: exp(-2 nu k^2 t)."""
    wave = 2 * np.pi / 0.1
    viscosity, time = 2.0, 0.05

    def profile(z):
        return 0.2 * np.cos(wave * z)

    left = energy_left(viscosity, [0.3, 0.1, 0.1], profile, time)
    assert left == pytest.approx(np.exp(-2 * viscosity / 1000.0 * wave**2 * time), rel=0.15)
    assert energy_left(0.0, [0.3, 0.1, 0.1], profile, time) > 0.95


def test_liquid_as_thick_as_can_be_turns_like_a_rigid_body():
    """Two layers sliding over each other: a cube with their angular momentum keeps 3/8."""
    left = energy_left(500.0, [0.1, 0.1, 0.1], lambda z: np.where(z > 0.05, 0.3, -0.3), 0.05)
    assert left == pytest.approx(0.375, rel=0.05)


def test_a_step_too_long_to_be_stable_is_cut_into_substeps():
    sim = sph_ros.Simulation({**SCENE, "time_step": 0.05})
    for _ in range(20):
        sim.step()
    assert sim.time == pytest.approx(1.0)
    facts = sim.statistics()
    assert facts["substeps"] > 1 and facts["max_speed"] < 0.5 and facts["lost_particles"] == 0
    sim.set_material(surface_tension=2.0)
    sim.step()
    assert sim.statistics()["substeps"] > facts["substeps"]


def test_surface_is_closed_and_holds_the_liquid():
    sim = sph_ros.Simulation({**SCENE, "spacing": 0.01})
    vertices, triangles = sim.surface()
    assert vertices.dtype == np.float32 and triangles.dtype == np.int32
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert np.all(counts == 2)
    a, b, c = (vertices[triangles[:, k]].astype(np.float64) for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(0.2 * 0.2 * 0.1, rel=0.1)


def test_scene_without_liquid_steps():
    sim = sph_ros.Simulation({**SCENE, "liquid": []})
    sim.advance(0.05)
    assert sim.positions.shape == (0, 3)
    assert sim.surface()[0].shape == (0, 3)
    assert sim.statistics()["kinetic_energy"] == 0.0
