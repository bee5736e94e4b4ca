# SPDX-License-Identifier: Apache-2.0
"""Free solids in the liquid: momentum, drafts, rest, a boat; both solvers that iterate."""

import importlib.util
import math
from pathlib import Path

import numba
import numpy as np
import pytest
from scipy.optimize import brentq

import sph_ros
from sph_ros.sim.scene import SceneError, load_scene

ROOT = Path(__file__).resolve().parents[1]
SOLVERS = ("relaxation", "incompressible")


def tank(size):
    return {"name": "tank", "container": {"box": {"min": [0, 0, 0], "max": list(size)}}}


def ball(name, position, density, radius=0.06):
    return {
        "name": name,
        "sphere": {"radius": radius},
        "pose": {"position": list(position)},
        "control": "free",
        "density": density,
    }


def around(lower, upper, holes):
    """Boxes of liquid that fill a box but for holes, which follow each other along x."""
    boxes, x = [], lower[0]
    for hole_lower, hole_upper in holes:
        boxes.append([[x, lower[1], lower[2]], [hole_lower[0], upper[1], upper[2]]])
        (ax, ay, az), (bx, by, bz) = hole_lower, hole_upper
        boxes.append([[ax, lower[1], lower[2]], [bx, upper[1], az]])
        boxes.append([[ax, lower[1], bz], [bx, upper[1], upper[2]]])
        boxes.append([[ax, lower[1], az], [bx, ay, bz]])
        boxes.append([[ax, by, az], [bx, upper[1], bz]])
        x = bx
    boxes.append([[x, lower[1], lower[2]], list(upper)])
    flat = [(np.array(a), np.array(b)) for a, b in boxes]
    return [
        {"box": {"min": a.round(9).tolist(), "max": b.round(9).tolist()}}
        for a, b in flat
        if (b - a > 1e-6).all()
    ]


@pytest.mark.parametrize("solver", SOLVERS)
def test_momentum_goes_back_and_forth_between_liquid_and_body(solver):
    sim = sph_ros.Simulation(
        {
            "spacing": 0.02,
            "solver": solver,
            "gravity": [0, 0, 0],
            "material": {"base": "water", "viscosity": 0.1},
            "liquid": [{"box": {"size": [0.2, 0.2, 0.2]}, "velocity": [0, 0.3, 0]}],
            "solids": [
                {
                    "name": "cube",
                    "box": {"size": [0.1, 0.1, 0.1]},
                    "pose": {"position": [0.17, 0.03, 0.02], "quat_xyzw": [0.1, 0.2, 0, 1]},
                    "control": "free",
                    "density": 300.0,
                    "velocity": [-1.0, 0, 0],
                }
            ],
        }
    )

    def momenta():
        facts = sim.statistics()
        x, v = sim.positions.astype(float), sim.velocities.astype(float)
        bodies = sim._solids.bodies
        angular = 0.02**3 * 1000 * np.cross(x, v).sum(axis=0)
        angular = angular + np.cross(bodies.centre, bodies.momentum).sum(axis=0)
        return facts["momentum"] + facts["solid_momentum"], angular + bodies.spin.sum(axis=0)

    linear, angular = momenta()
    cube = sim._solids.bodies
    size = np.linalg.norm(cube.momentum)
    given = 0.0
    for _ in range(100):
        sim.step()
        given = max(given, np.linalg.norm(cube.momentum[0] - size * np.array([-1, 0, 0])))
        now, _ = momenta()
        np.testing.assert_allclose(now, linear, atol=1e-5 * np.linalg.norm(linear))
    assert given > 0.5 * size
    assert sim.statistics()["squeezed_particles"] == 0
    if solver == "incompressible":
        np.testing.assert_allclose(momenta()[1], angular, atol=1e-3 * 0.2 * size)


def submerged(x):
    """Share of a ball's volume below the waterline at a draft of x diameters."""
    return x * x * (3 - 2 * x)


def test_balls_float_as_deep_as_archimedes_says_or_sink():
    spacing, radius, deep = 0.02, 0.06, 0.24
    length, width = 0.72, 0.28
    places = {500.0: 0.12, 900.0: 0.36, 2000.0: 0.6}
    holes = [([x - 0.06, 0.08, 0.12], [x + 0.06, 0.2, deep]) for x in places.values()]
    sim = sph_ros.Simulation(
        {
            "spacing": spacing,
            "solver": "incompressible",
            "material": "water",
            "liquid": around([0, 0, 0], [length, width, deep], holes),
            "solids": [
                tank([length, width, 0.5]),
                *[ball(f"ball{d:.0f}", (x, 0.14, 0.18), d, radius) for d, x in places.items()],
            ],
        }
    )
    volume = 4 / 3 * math.pi * radius**3
    displaced = volume * sum(min(density / 1000, 1.0) for density in places)
    level = (sim.particle_count * spacing**3 + displaced) / (length * width)
    sim.advance(2.0)
    for density in (500.0, 900.0):
        draft = brentq(lambda x, d=density: submerged(x) - d / 1000, 0, 1) * 2 * radius
        height = sim.solid(f"ball{density:.0f}").position[2]
        assert height == pytest.approx(level - draft + radius, abs=0.05 * 2 * radius)
    heights = []  # what still sloshes may roll the sunken ball and rock it, but not lift it
    for _ in range(20):
        sim.step()
        heights.append(sim.solid("ball2000").position[2])
    assert np.mean(heights) == pytest.approx(radius, abs=0.005 * radius)
    np.testing.assert_allclose(heights, radius, atol=0.1 * spacing)
    assert sim.statistics()["lost_particles"] == 0


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_heavy_box_under_water_stays_where_it_lies(solver):
    sim = sph_ros.Simulation(
        {
            "spacing": 0.02,
            "dimension": 2,
            "solver": solver,
            "material": "water",
            "liquid": [
                {"box": {"min": [0, -1, 0], "max": [0.2, 1, 0.2]}},
                {"box": {"min": [0.3, -1, 0], "max": [0.6, 1, 0.2]}},
                {"box": {"min": [0.2, -1, 0.1], "max": [0.3, 1, 0.2]}},
            ],
            "solids": [
                tank([0.6, 1, 0.5]),
                {
                    "name": "box",
                    "box": {"size": [0.1, 1, 0.1]},
                    "pose": {"position": [0.25, 0, 0.05]},
                    "control": "free",
                    "density": 2500.0,
                },
            ],
        }
    )
    sim.advance(0.6)
    box = sim.solid("box")
    moved = []
    for _ in range(20):
        sim.step()
        moved.append([*box.velocity, *box.angular_velocity])
    assert box.position == pytest.approx([0.25, 0, 0.05], abs=0.002)
    assert box.position[1] == 0.0 and box.quat_xyzw[[0, 2]] == pytest.approx([0, 0], abs=0)
    assert np.abs(moved).max() < 0.01


def thick_scene(density):
    """A light block dropped into honey."""
    return {
        "spacing": 0.02,
        "material": "honey",
        "liquid": [{"box": {"min": [0, 0, 0], "max": [0.24, 0.24, 0.12]}}],
        "solids": [
            tank([0.24, 0.24, 0.4]),
            {
                "name": "block",
                "box": {"size": [0.1, 0.1, 0.05]},
                "pose": {"position": [0.12, 0.12, 0.16], "quat_xyzw": [0.2, 0, 0, 1]},
                "control": "free",
                "density": density,
            },
        ],
    }


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_body_much_lighter_than_honey_settles(solver):
    """Added mass and friction outweigh it: taking turns with the liquid would explode."""
    sim = sph_ros.Simulation({**thick_scene(50.0), "solver": solver})
    fastest = 0.0
    while sim.time < 1.2:
        sim.step()
        fastest = max(fastest, np.linalg.norm(sim.solid("block").velocity))
    assert fastest < 1.0
    block = sim.solid("block")
    assert np.linalg.norm(block.velocity) < 0.05
    assert 0.1 < block.position[2] < 0.16
    turned = 2 * math.asin(min(np.linalg.norm(block.quat_xyzw[:2]), 1.0))
    assert turned < 0.12


def state(sim):
    block = sim.solid("block")
    poses = np.concatenate([block.position, block.quat_xyzw, block.velocity])
    return sim.positions.tobytes() + poses.tobytes()


@pytest.mark.parametrize("solver", SOLVERS)
def test_threads_resets_and_snapshots_change_no_bit(solver, tmp_path):
    scene = {**thick_scene(700.0), "material": "water", "solver": solver}
    sim = sph_ros.Simulation(scene)
    start = state(sim)
    for _ in range(30):
        sim.step()
    sim.save(tmp_path / "afloat.npz")
    for _ in range(15):
        sim.step()
    end, facts = state(sim), sim.statistics()
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        sim.reset()
        assert state(sim) == start
        for _ in range(45):
            sim.step()
        assert state(sim) == end
    finally:
        numba.set_num_threads(threads)
    other = sph_ros.Simulation.load(tmp_path / "afloat.npz")
    for _ in range(15):
        other.step()
    assert state(other) == end
    np.testing.assert_array_equal(other.statistics()["solid_momentum"], facts["solid_momentum"])


def make_boat():
    """The module that made the boat's mesh."""
    path = ROOT / "scenes" / "meshes" / "make_boat.py"
    spec = importlib.util.spec_from_file_location("make_boat", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def heel_and_trim(quat_xyzw):
    """Angles about the boat's long and cross axis [rad]."""
    x, y, z, w = quat_xyzw
    return math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), math.asin(2 * (w * y - z * x))


def boat_scene(filled):
    """The packaged scene without its tap and its ball, coarser."""
    scene = load_scene("floating_boat")
    liquid = [
        {"box": {"min": list(block.shape.min), "max": list(block.shape.max)}}
        for block in scene.liquid
    ]
    if filled:
        liquid.append({"box": {"min": [0.13, 0.09, 0.16], "max": [0.31, 0.21, 0.26]}})
    file = ROOT / "scenes" / "meshes" / "boat.ply"
    boat = {
        "name": "boat",
        "mesh": {"file": str(file)},
        "pose": {"position": [0.27, 0.15, 0.136], "quat_xyzw": [0.06, 0, 0, 1]},
        "control": "free",
        "density": 1450.0,
    }
    return {
        "spacing": 0.02,
        "solver": "incompressible",
        "material": "water",
        "liquid": liquid,
        "solids": [tank([0.525, 0.3, 0.5]), boat],
    }


def test_the_boat_bobs_floats_upright_as_deep_as_it_should_and_sinks_when_filled():
    boat_module = make_boat()
    hull = boat_module.hull()
    draft = brentq(lambda z: boat_module.displaced(z)[0] * 1000 - 1450 * hull.volume, 0.02, 0.09)
    sim = sph_ros.Simulation(boat_scene(filled=False))
    boat, heights = sim.solid("boat"), []
    while sim.time < 1.8:
        sim.step()
        heights.append(boat.position[2])
    level = (sim.particle_count * 0.02**3 + 1.45 * hull.volume) / (0.525 * 0.3)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(heights))))
    assert len(turns) >= 3  # up and down
    heel, trim = heel_and_trim(boat.quat_xyzw)
    assert abs(heel) < math.radians(3) and abs(trim) < math.radians(6)
    assert boat.position[2] == pytest.approx(level - draft, abs=0.01)
    assert np.linalg.norm(boat.velocity) < 0.05

    sim = sph_ros.Simulation(boat_scene(filled=True))
    while sim.time < 2.8:  # it also has to press the water from under its keel
        sim.step()
    keel = sim.solid("boat").position[2]
    assert keel < 0.02 and keel + boat_module.DEPTH < level - 0.05  # on the floor, under water
    assert sim.statistics()["lost_particles"] == 0


def test_bodies_that_make_no_sense_are_refused():
    good = ball("ball", (0.1, 0.1, 0.3), 500.0)
    base = {"spacing": 0.02, "liquid": [], "solids": [good]}

    def words(**change):
        solid = {key: value for key, value in {**good, **change}.items() if value is not None}
        with pytest.raises(SceneError) as caught:
            load_scene({**base, "solids": [solid]})
        return str(caught.value)

    assert "density: expected a density [kg/m^3] or a mass [kg]" in words(density=None)
    assert "got both" in words(mass=2.0)
    assert "restitution: expected 0 to 1" in words(restitution=2.0)
    assert "no definite volume" in words(sphere=None, plane={})
    endless = {"union": [{"sphere": {"radius": 0.1}}, {"plane": {}}]}
    assert "finite volume" in words(sphere=None, **endless)
    assert "only a free solid" in words(control="topic", velocity=[1, 0, 0])
    sim = sph_ros.Simulation(base)
    with pytest.raises(ValueError, match="free: the liquid, gravity and touches"):
        sim.move_solid("ball", [0, 0, 0])
