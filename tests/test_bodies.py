# SPDX-License-Identifier: Apache-2.0
"""Free solids: rigid bodies alone, among each other, and in the liquid."""

import math

import numpy as np
import pytest
import trimesh

import sph_ros
from sph_ros.sim.mass import mass_properties, moments_of_triangles
from sph_ros.sim.quaternions import to_matrix
from sph_ros.sim.shapes import Box, Capsule, Cylinder, Difference, Placed, Pose, Sphere, Union

G = 9.81
ROOM = {"name": "room", "container": {"box": {"min": [-0.5, -0.5, 0.0], "max": [0.5, 0.5, 1.0]}}}


def body(name, position=(0, 0, 0), shape=None, density=500.0, **fields):
    """A free solid, a cube of 0.1 m unless told."""
    shape = shape or {"box": {"size": [0.1, 0.1, 0.1]}}
    pose = {"position": list(position)}
    return {"name": name, **shape, "pose": pose, "control": "free", "density": density, **fields}


def dry(*solids, **fields):
    """A simulation without liquid, steps of 5 ms."""
    scene = {"spacing": 0.01, "time_step": 0.005, "liquid": [], "solids": list(solids)}
    return sph_ros.Simulation({**scene, **fields})


def steps(sim, count):
    """So many steps."""
    for _ in range(count):
        sim.step()


# ---------------------------------------------------------------- mass


@pytest.mark.parametrize(
    ("shape", "mesh"),
    [
        (Sphere(0.1), trimesh.creation.icosphere(5, 0.1)),
        (Box(min=(0, 0, 0), max=(0.1, 0.2, 0.4)), None),
        (Cylinder(0.1, 0.3), trimesh.creation.cylinder(0.1, 0.3, sections=256)),
        (Capsule(0.05, 0.2), None),
    ],
)
def test_mass_properties_are_those_of_a_fine_mesh(shape, mesh):
    if isinstance(shape, Box):
        mesh = trimesh.creation.box(bounds=(shape.min, shape.max))
    if isinstance(shape, Capsule):
        mesh = trimesh.creation.capsule(0.2, 0.05, count=(128, 128))
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    found = mass_properties(shape, 3, density=700.0)
    mesh.density = 700.0
    assert found.mass == pytest.approx(mesh.mass, rel=2e-3)
    np.testing.assert_allclose(found.centre, mesh.center_mass, atol=1e-9)
    np.testing.assert_allclose(found.inertia, mesh.moment_inertia, rtol=3e-3, atol=1e-9)
    volume, centre, second = moments_of_triangles(np.asarray(mesh.triangles))
    assert volume == pytest.approx(mesh.volume)
    np.testing.assert_allclose(
        700.0 * (np.trace(second) * np.eye(3) - second), mesh.moment_inertia, atol=1e-9
    )


def test_mass_of_put_together_shapes_and_of_cuts():
    cup = Difference((Placed(Cylinder(0.1, 0.2)), Placed(Cylinder(0.08, 0.2), Pose((0, 0, 0.02)))))
    found = mass_properties(cup, 3, mass=2.0)
    inner = 0.08**2 * 0.18
    volume = 0.1**2 * 0.2 - inner
    assert found.mass == pytest.approx(2.0)
    assert found.centre[2] == pytest.approx(-inner * 0.01 / volume, rel=0.02)
    two = Union((Placed(Sphere(0.1), Pose((-1, 0, 0))), Placed(Sphere(0.1), Pose((1, 0, 0)))))
    assert mass_properties(two, 3, mass=1.0).inertia[2, 2] == pytest.approx(1.004, rel=0.01)
    disc = mass_properties(Sphere(0.1), 2, density=1000.0)
    assert disc.mass == pytest.approx(1000 * math.pi * 0.01)
    assert disc.inertia[1, 1] == pytest.approx(disc.mass * 0.01 / 2)
    ring = Difference((Placed(Sphere(0.1)), Placed(Sphere(0.05))))
    cut = mass_properties(ring, 2, density=1.0)
    assert cut.mass == pytest.approx(math.pi * 0.0075, rel=2e-3)
    assert cut.inertia[1, 1] == pytest.approx(cut.mass * (0.01 + 0.0025) / 2, rel=5e-3)


# ---------------------------------------------------------------- alone


def test_free_fall_is_that_of_gravity():
    sim = dry(body("cube", (0, 0, 0.9), velocity=[0.3, 0, 1.0], angular_velocity=[0, 2.0, 0]))
    steps(sim, 40)
    cube = sim.solid("cube")
    assert cube.velocity == pytest.approx([0.3, 0, 1.0 - 0.2 * G], abs=1e-12)
    # Symplectic Euler is half a step ahead: g t dt / 2.
    fallen = 0.2 * 1.0 - 0.5 * G * 0.2**2 - 0.5 * G * 0.2 * 0.005
    assert cube.position == pytest.approx([0.06, 0, 0.9 + fallen], abs=1e-9)
    assert cube.angular_velocity == pytest.approx([0, 2.0, 0], abs=1e-9)
    assert 2 * math.asin(cube.quat_xyzw[1]) == pytest.approx(0.4, abs=1e-9)


def test_a_tumbling_body_keeps_energy_and_angular_momentum():
    """About the middle axis, where every error grows (Euler's equations; Dzhanibekov)."""
    box = {"box": {"size": [0.1, 0.2, 0.05]}}
    sim = dry(
        body("box", shape=box, angular_velocity=[10, 0.1, 0.1]), gravity=[0, 0, 0], time_step=0.004
    )
    bodies = sim._solids.bodies
    before, energy = bodies.spin.copy(), sim.statistics()["solid_energy"]
    ways, energies = [], []
    for _ in range(600):
        sim.step()
        rotation = to_matrix(sim.solid("box").quat_xyzw)
        ways.append(rotation[0, 0])
        energies.append(sim.statistics()["solid_energy"])
    np.testing.assert_allclose(bodies.spin, before, atol=1e-12 * np.linalg.norm(before))
    np.testing.assert_allclose(energies, energy, rtol=1e-4)
    # The body flips over, again and again; its angular momentum does not.
    assert min(ways) < -0.9 and max(ways) > 0.9


def test_a_body_bounces_slides_and_rolls_by_the_textbook():
    ball = {"sphere": {"radius": 0.05}}
    floor = {**ROOM, "friction": 0.4}
    sim = dry(
        floor,
        body("bouncing", (0.3, 0.3, 0.3), ball, restitution=0.8),
        body("sliding", (-0.4, 0, 0.05), velocity=[1, 0, 0], friction=0.4),
        body("rolling", (-0.4, -0.3, 0.05), ball, velocity=[0.7, 0, 0]),
    )
    highest, fallen = 0.0, False
    for _ in range(110):
        sim.step()
        speed = sim.solid("bouncing").velocity[2]
        fallen |= speed > 0.0
        highest = max(highest, sim.solid("bouncing").position[2] if fallen else 0.0)
    assert highest - 0.05 == pytest.approx(0.64 * 0.25, rel=0.05)
    # v^2 / (2 mu g); a ball that slid at first rolls with 5/7 of its speed.
    assert sim.solid("sliding").position[0] + 0.4 == pytest.approx(1 / (2 * 0.4 * G), rel=0.03)
    assert np.abs(sim.solid("sliding").velocity).max() < 1e-6
    assert sim.solid("rolling").velocity[0] == pytest.approx(0.5, rel=1e-3)
    assert sim.solid("rolling").angular_velocity[1] * 0.05 == pytest.approx(0.5, rel=1e-3)


def test_a_stack_rests_where_it_was_put():
    shifts = (0.0, 0.02, -0.02)
    sim = dry(ROOM, *[body(f"cube{i}", (x, 0, 0.05 + 0.1 * i)) for i, x in enumerate(shifts)])
    steps(sim, 200)
    for i, x in enumerate(shifts):
        cube = sim.solid(f"cube{i}")
        assert cube.position == pytest.approx([x, 0, 0.05 + 0.1 * i], abs=2e-5)
        assert np.abs(cube.velocity).max() < 1e-6
        assert abs(cube.quat_xyzw[3]) > 1 - 1e-9


def test_overlapping_bodies_part_without_flying_apart():
    sim = dry(ROOM, body("a", (0, 0, 0.045)), body("b", (0.03, 0, 0.135)))
    fastest = 0.0
    for _ in range(200):
        sim.step()
        fastest = max(fastest, *(np.abs(sim.solid(n).velocity).max() for n in "ab"))
    assert fastest < 0.05
    assert sim.solid("b").position[2] - sim.solid("a").position[2] > 0.0999
    assert sim.solid("a").position[2] > 0.0499


def test_a_driven_solid_pushes_a_free_one_and_two_collide_with_their_momentum_kept():
    ball = {"sphere": {"radius": 0.05}}
    sim = dry(
        {"name": "hand", **ball, "pose": {"position": [-0.3, 0, 0]}, "control": "topic"},
        body("near", (-0.1, 0, 0), ball),
        body("far", (0.1, 0.03, 0), ball, density=2000.0),
        gravity=[0, 0, 0],
    )
    sim.move_solid("hand", [-0.15, 0, 0], time=0.2)
    steps(sim, 40)
    before = sim.statistics()["solid_momentum"]
    assert before[0] > 0.05
    steps(sim, 200)
    near, far = sim.solid("near"), sim.solid("far")
    np.testing.assert_allclose(sim.statistics()["solid_momentum"], before, atol=1e-12)
    assert far.velocity[0] > 0.05 and far.velocity[1] > 0.0 and near.velocity[1] < 0.0
