# SPDX-License-Identifier: Apache-2.0
"""Open, thin meshes: broken files are mended, and nothing passes through a triangle."""

import logging
import math

import numpy as np
import pytest
import trimesh

import sph_ros
from sph_ros.core.sheets import NEVER, first_crossing, nearest_on_sheet, sheet_distances
from sph_ros.sim.scene import SceneError
from sph_ros.sim.shapes import MeshError, OpenSurface
from sph_ros.sim.sheets import load_sheet, pack_sheets

RADIUS, HEIGHT = 0.04, 0.08


def cup(sides=24, rings=8):
    """An open cup that is a single sheet: vertices and triangles."""
    turn = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.cos(turn), np.sin(turn), np.zeros(sides)], axis=1)
    rows = [circle * RADIUS * share for share in (1 / 3, 2 / 3, 1)]
    rows += [circle * RADIUS + [0, 0, HEIGHT * (k + 1) / rings] for k in range(rings)]
    vertices = np.concatenate([[[0, 0, 0]], *rows])
    around = np.arange(sides)
    beside = (around + 1) % sides
    faces = [np.stack([0 * around, 1 + around, 1 + beside], axis=1)]
    for row in range(len(rows) - 1):
        a, b = 1 + row * sides + around, 1 + row * sides + beside
        faces += [np.stack([a, b, a + sides], axis=1), np.stack([b, b + sides, a + sides], axis=1)]
    return vertices, np.concatenate(faces)


def write_broken_obj(path):
    """The cup as no program should write it; returns the number of missing triangles."""
    generator = np.random.default_rng(1)
    vertices, triangles = cup()
    missing = generator.choice(np.arange(24, len(triangles) - 48), 12, replace=False)
    lines = [f"v {x:g} {y:g} {z:g}" for x, y, z in vertices] + ["v 9 9 9", "vn 0 0 1"]
    for index, face in enumerate(triangles + 1):
        if index in missing:
            continue
        face = face[::-1] if generator.random() < 0.5 else face
        twice = 2 if generator.random() < 0.1 else 1
        lines += ["f " + " ".join(f"{corner}//{corner}" for corner in face)] * twice
    lines += ["f 5 6 9999", "f 0 1 2", "f 3//1 3//1 4//1", "f 1/x 2 3"]
    path.write_text("\n".join(lines) + "\n")
    return len(missing)


def test_a_cup_from_a_broken_obj_holds_water(tmp_path, caplog):
    path = tmp_path / "cup.obj"
    write_broken_obj(path)
    with pytest.raises(SceneError):  # nothing that has an inside could be made of it
        sph_ros.Simulation({"spacing": 0.01, "liquid": [], "solids": [
            {"name": "cup", "mesh": {"file": str(path)}}]})  # fmt: skip
    with caplog.at_level(logging.WARNING):
        sim = sph_ros.Simulation(
            {
                "spacing": 0.006,
                "liquid": [
                    {
                        "cylinder": {"radius": 0.036, "length": 0.05},
                        "pose": {"position": [0, 0, 0.03]},
                    }
                ],
                "solids": [{"name": "cup", "surface": {"file": str(path)}}],
            }
        )
    assert "closed small holes" in caplog.text
    count, force = sim.particle_count, []
    while sim.time < 2.0:
        sim.step()
        force.append(sim.wrench("cup")[0][2])
    assert sim.particle_count == count > 800
    positions = sim.positions
    assert positions[:, 2].min() > 0.0 and np.hypot(*positions[:, :2].T).max() < RADIUS
    # The liquid keeps its volume and rests on the bottom with its weight.
    volume = count * 0.006**3
    level = volume / (np.pi * RADIUS**2)
    assert np.percentile(positions[:, 2], 98) == pytest.approx(level, abs=0.006)
    weight = volume * 1000.0 * 9.81
    assert np.mean(force[-100:]) == pytest.approx(-weight, rel=0.01)
    assert sim.statistics()["kinetic_energy"] < 1e-4
    assert sim.statistics()["mean_compression"] < 0.01


def test_holes_are_closed_and_the_mouth_is_not(tmp_path):
    path = tmp_path / "cup.obj"
    missing = write_broken_obj(path)
    whole = trimesh.Trimesh(*cup(), process=False)
    vertices, triangles = load_sheet(OpenSurface(str(path)))
    mended = trimesh.Trimesh(vertices, triangles, process=False)
    assert mended.area == pytest.approx(whole.area, rel=5e-3)
    assert len(vertices) < len(whole.vertices) + missing + 1  # the stray vertex is gone
    _, torn = load_sheet(OpenSurface(str(path), close_holes=0))
    assert len(torn) == len(whole.faces) - missing
    plate = tmp_path / "plate.stl"
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]).export(
        plate
    )
    assert len(load_sheet(OpenSurface(str(plate)))[1]) == 2  # its outline is no hole
    (tmp_path / "none.obj").write_text("v 0 0 0\nf 1 2 3\n")
    with pytest.raises(MeshError, match="no triangles"):
        load_sheet(OpenSurface(str(tmp_path / "none.obj")))


@pytest.fixture(scope="module")
def crumpled(tmp_path_factory):
    """A sheet of random triangles, packed, and their corners."""
    generator = np.random.default_rng(3)
    corners = generator.uniform(-1, 1, (150, 1, 3)) + generator.normal(0, 0.15, (150, 3, 3))
    path = tmp_path_factory.mktemp("meshes") / "crumpled.stl"
    trimesh.Trimesh(corners.reshape(-1, 3), np.arange(450).reshape(-1, 3), process=False).export(
        path
    )
    sheets = pack_sheets([OpenSurface(str(path), close_holes=0)], 0.2)
    return sheets, sheets.corners.astype(np.float64)


def test_nearest_points_are_those_of_the_slow_way(crumpled):
    sheets, corners = crumpled
    points = np.random.default_rng(4).uniform(-1.3, 1.3, (300, 3)).astype(np.float32)
    slow = np.array(
        [
            np.linalg.norm(
                trimesh.triangles.closest_point(corners, np.tile(p, (150, 1))) - p, axis=1
            )
            for p in points.astype(np.float64)
        ]
    ).min(axis=1)
    found = np.empty(300, np.float32)
    sheet_distances(sheets, 0, points, found)
    np.testing.assert_allclose(found, slow, atol=1e-6)
    for point, distance in zip(points.astype(float), slow, strict=True):
        near = nearest_on_sheet(sheets, 0, *point, 0.2)
        assert near[0] == pytest.approx(min(distance, 0.2), abs=1e-6)
        if near[5] >= 0:
            assert np.linalg.norm(near[1:4]) == pytest.approx(1.0)


def slow_crossing(corners, start, way):
    """Smallest share of the way at which it goes through a triangle: solves for each of them."""
    shares = [NEVER]
    for a, b, c in corners:
        matrix = np.stack([b - a, c - a, -way], axis=1)
        if abs(np.linalg.det(matrix)) > 1e-12:
            u, v, share = np.linalg.solve(matrix, start - a)
            if u > 0 and v > 0 and u + v < 1 and 0 <= share <= 1:
                shares.append(share)
    return min(shares)


def test_paths_end_where_the_slow_way_says(crumpled):
    sheets, corners = crumpled
    generator = np.random.default_rng(5)
    hits = 0
    for _ in range(300):
        start, way = generator.uniform(-1.2, 1.2, 3), generator.normal(0, 0.4, 3)
        share, triangle = first_crossing(sheets, 0, *start, *(start + way))
        slow = slow_crossing(corners, start, way)
        if slow == NEVER:  # perhaps it touched the rim: triangles count as slightly larger
            middles = corners.mean(axis=1, keepdims=True)
            larger = slow_crossing(middles + 1.01 * (corners - middles), start, way)
            assert triangle < 0 or larger < NEVER
            continue
        hits += 1
        assert share == pytest.approx(slow, abs=1e-6) or share < slow
    assert hits > 20


PLATE = "v {x} -0.2 -0.2\nv {x} 0.4 -0.2\nv {x} 0.4 0.6\nv {x} -0.2 0.6\nf 1 2 3\nf 1 3 4\n"


def divided_tank(tmp_path, left=0.1, right=0.1):
    """A tank with a sheet across its middle, x = 0, and water on both sides of it."""
    path = tmp_path / "plate.obj"
    path.write_text(PLATE.format(x=0))
    boxes = [
        {"box": {"min": [-0.1, 0, 0], "max": [0, 0.1, left]}},
        {"box": {"min": [0, 0, 0], "max": [0.1, 0.1, right]}},
    ]
    return {
        "spacing": 0.01,
        "liquid": [box for box in boxes if box["box"]["max"][2]],
        "solids": [
            {"name": "tank", "container": {"box": {"min": [-0.1, 0, 0], "max": [0.1, 0.1, 0.4]}}},
            {"name": "plate", "surface": {"file": str(path)}, "control": "topic"},
        ],
    }


def test_liquid_on_one_side_does_not_feel_that_on_the_other(tmp_path):
    both = sph_ros.Simulation(divided_tank(tmp_path))
    alone = sph_ros.Simulation(divided_tank(tmp_path, left=0.0))
    np.testing.assert_allclose(both.densities[1000:], alone.densities, rtol=1e-5)
    # A wall on one side only bears the pressure of a column: rho g H^2 / 2 times its width.
    force = []
    while alone.time < 1.0:
        alone.step()
        force.append(alone.wrench("plate")[0][0])
    assert np.mean(force[len(force) // 2 :]) == pytest.approx(-0.5 * 9810 * 0.1**3, rel=0.1)
    assert alone.positions[:, 0].min() > 0.0


@pytest.mark.parametrize("turned", [False, True])
def test_a_sheet_that_moves_takes_its_liquid_with_it(tmp_path, turned):
    scene = divided_tank(tmp_path, left=0.05)
    sim = sph_ros.Simulation({**scene, "spacing": 0.0125})
    left = sim.positions[:, 0] < 0.0
    for step in range(80):
        x = 0.05 * math.sin(0.2 * step)
        tilt = 0.3 * math.sin(0.31 * step) if turned else 0.0
        sim.move_solid("plate", [x, 0, 0], [0, math.sin(tilt), 0, math.cos(tilt)])
        sim.step()
        plate = sim.solid("plate")
        normal = plate.quat_xyzw
        turn = 2.0 * math.atan2(normal[1], normal[3])
        height = (sim.positions - plate.position) @ [math.cos(turn), 0, -math.sin(turn)]
        assert np.array_equal(height < 0.0, left)
        assert np.abs(height).min() > 0.0
    assert sim.statistics()["lost_particles"] == 0


def dropped(tmp_path, speed, **surface):
    """Velocity of a particle after it met a plate with `speed` (x, z), and the plate's impulse."""
    path = tmp_path / "floor.obj"
    path.write_text("v -9 -9 0\nv 9 -9 0\nv 9 9 0\nv -9 9 0\nf 1 2 3\nf 1 3 4\n")
    sim = sph_ros.Simulation(
        {
            "spacing": 0.01,
            "material": {"base": "air_like", "density": 1000},
            "gravity": [0, 0, 0],
            "time_step": 0.001,
            "liquid": [{"box": {"size": [0.01] * 3}, "velocity": [speed[0], 0, speed[1]],
                        "pose": {"position": [0, 0, 0.1]}}],
            "solids": [{"name": "floor", "surface": {"file": str(path), **surface}}],
        }
    )  # fmt: skip
    impulse = np.zeros(3)
    while sim.time < 0.3:
        sim.step()
        impulse += sim.wrench("floor")[0] * sim.time_step
    return sim.velocities[0], impulse


@pytest.mark.parametrize("restitution", [0.0, 0.6, 1.0])
def test_restitution_is_the_share_of_the_speed_that_comes_back(tmp_path, restitution):
    velocity, impulse = dropped(tmp_path, (0.3, -1.0), restitution=restitution)
    assert velocity == pytest.approx([0.3, 0, restitution], abs=0.01)
    assert impulse == pytest.approx([0, 0, -(1 + restitution) * 0.001], abs=2e-5)


def test_friction_takes_its_share_of_what_the_plate_gave(tmp_path):
    velocity, impulse = dropped(tmp_path, (0.8, -1.0), restitution=0.5, friction=0.2)
    assert velocity == pytest.approx([0.8 - 0.2 * 1.5, 0, 0.5], abs=0.01)
    assert impulse == pytest.approx([0.3e-3, 0, -1.5e-3], abs=2e-5)
    velocity, _ = dropped(tmp_path, (0.1, -1.0), friction=0.2)
    assert velocity == pytest.approx([0, 0, 0], abs=0.01)


def test_what_has_no_inside_is_refused_where_one_is_needed(tmp_path):
    surface = {"surface": {"file": str(tmp_path / "plate.obj")}}
    base = {**divided_tank(tmp_path), "liquid": []}
    for solid, words in [
        ({"container": surface}, "inside"),
        ({"union": [surface, {"sphere": {"radius": 1}}]}, "inside"),
        ({**surface, "control": "topic"}, "2D"),
        ({"surface": {"file": "none.obj"}}, "no such mesh file"),
        ({"surface": {**surface["surface"], "restitution": 2}}, "restitution"),
    ]:
        with pytest.raises(SceneError, match=words):
            scene = {**base, "solids": [{"name": "s", **solid}]}
            sph_ros.load_scene({**scene, "dimension": 2} if words == "2D" else scene)
