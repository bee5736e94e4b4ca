# SPDX-License-Identifier: Apache-2.0
"""Scene files: what they become, and the one line that people get when something is wrong."""

import copy
import math

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from sph_ros.sim import liquid
from sph_ros.sim.scene import (
    SceneError,
    bag_path,
    fill_liquid,
    list_scenes,
    load_scene,
    scene_path,
)
from sph_ros.sim.shapes import Box, Container, Difference, Mesh, Plane, Sphere

POOL = {
    "spacing": 0.02,
    "liquid": [{"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}}],
    "solids": [
        {"name": "tank", "container": {"box": {"min": [0, 0, 0], "max": [0.2, 0.1, 0.2]}}},
        {"name": "ball", "sphere": {"radius": 0.03}, "pose": {"position": [0.15, 0.05, 0.1]}},
    ],
}

GOOD = """\
spacing: 0.02
liquid:
  - box: {min: [0, 0, 0], max: [0.1, 0.1, 0.1]}
solids:
  - name: tank
    container:
      box: {min: [0, 0, 0], max: [0.2, 0.1, 0.2]}
  - name: ball
    sphere: {radius: 0.03}
    pose: {position: [0.15, 0.05, 0.1]}
"""


def changed(*keys_and_value, start=POOL):
    """A copy of the pool with one value replaced or added."""
    *keys, value = keys_and_value
    scene = copy.deepcopy(start)
    inner = scene
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value
    return scene


def message(source):
    """The one line that `source` is refused with."""
    with pytest.raises(SceneError) as caught:
        load_scene(source)
    text = str(caught.value)
    assert "\n" not in text
    return text


# ---------------------------------------------------------------- what is packaged


EXPECTED_PARTICLES = {
    "ball_tank": (800, 1000),
    "ball_tank_large": (19_000, 21_000),
    "dam_break": (5120, 5120),
    "dam_break_2d": (3200, 3200),
    "dam_break_large": (19_375, 19_375),
    "dam_house_2d": (300, 300),  # 3 m^2 at 0.1 m
    "desk_tank": (1536, 1536),
    "drop_box": (2100, 2300),
    "drops_merge": (2700, 3200),
    "floating_boat": (6500, 8500),
    "ball_splash": (10_800, 10_800),
    "cream": (0, 0),
    "fountain": (0, 0),
    "honey_spoon": (300, 600),  # what stays in the spoon
    "jelly": (1900, 2200),
    "lennard_jones": (800, 800),
    "oil_water": (4500, 4500),
    "pour_glass": (0, 0),  # all of it is poured
    "rain_2d": (0, 0),  # all of it rains
    "resting_column": (2000, 2000),
    "stirred_cup": (2500, 3500),
}


def test_every_packaged_scene_has_the_particles_it_promises():
    assert list_scenes() == sorted(EXPECTED_PARTICLES)
    for name, (low, high) in EXPECTED_PARTICLES.items():
        scene = load_scene(name)
        positions, velocities = fill_liquid(scene)
        assert low <= len(positions) <= high, name
        assert positions.dtype == velocities.dtype == np.float32
        assert pdist(positions[:2000]).min(initial=np.inf) > 0.99 * scene.spacing, name
        assert scene.name == name and scene.description


# ---------------------------------------------------------------- what a scene becomes


@pytest.mark.nojit
def test_file_and_dict_with_the_same_keys_make_the_same_scene(tmp_path):
    file = tmp_path / "pool.yaml"
    file.write_text(GOOD)
    from_file, from_dict = load_scene(file), load_scene(POOL)
    assert from_file.solids == from_dict.solids and from_file.liquid == from_dict.liquid
    assert from_file.name == "pool" and from_file.source == str(file)
    assert from_dict.source == "<dict>"
    assert from_file.support_radius == pytest.approx(0.04)
    assert from_file.time_step is None and from_file.gravity == (0.0, 0.0, -9.81)
    assert isinstance(from_file.solids[0].shape, Container)


def test_everything_a_scene_can_say_arrives():
    scene = load_scene(
        {
            "name": "all",
            "frame": "lab",
            "spacing": 0.01,
            "support_radius": 0.025,
            "time_step": 0.001,
            "solver": "relaxation",
            "material": {"base": "honey", "viscosity": 4},
            "gravity": [0, 0, -1.62],
            "max_solid_speed": 1,
            "emitters": [
                {
                    "position": [0, 0, 1],
                    "direction": [0, 0, -2],
                    "radius": 0.02,
                    "speed": 1,
                    "from": 0.5,
                    "until": 2,
                    "limit": 10,
                }
            ],
            "sinks": [
                {"plane": {"offset": -1}, "from": 2},
                {"box": {"size": [1, 1, 1]}, "pose": {"position": [0, 0, 3]}, "until": 4},
            ],
            "max_particles": 500,
            "solids": [
                {
                    "name": "stirrer",
                    "capsule": {"radius": 0.01, "length": 0.1},
                    "control": "path",
                    "path": [
                        {"time": 0, "position": [0, 0, 0]},
                        {"time": 1, "position": [0.1, 0, 0], "quat_xyzw": [0, 0, 2, 0]},
                    ],
                    "color": [1, 0.5, 0],
                },
                {
                    "name": "cup",
                    "difference": [
                        {"cylinder": {"radius": 0.05, "length": 0.1}},
                        {
                            "union": [{"sphere": {"radius": 0.02}}, {"box": {"size": [1, 1, 0.1]}}],
                            "pose": {"position": [0, 0, 0.1]},
                        },
                    ],
                    "control": "topic",
                    "visible": False,
                },
            ],
        }
    )
    assert (scene.frame, scene.support_radius, scene.time_step) == ("lab", 0.025, 0.001)
    assert (scene.material.density, scene.material.viscosity) == (1420.0, 4.0)
    emitter = scene.emitters[0]
    assert (emitter.from_time, emitter.until, emitter.limit) == (0.5, 2.0, 10)
    assert emitter.direction == (0.0, 0.0, -1.0)
    assert isinstance(scene.sinks[0].shape, Plane) and scene.max_particles == 500
    assert [(sink.from_time, sink.until) for sink in scene.sinks] == [(2.0, math.inf), (0.0, 4.0)]
    stirrer, cup = scene.solids
    assert stirrer.path[1].quat_xyzw == (0.0, 0.0, 1.0, 0.0) and stirrer.color == (1.0, 0.5, 0.0)
    assert isinstance(cup.shape, Difference) and not cup.visible
    assert cup.shape.of[1].pose.position == (0.0, 0.0, 0.1)


def test_numbers_that_yaml_takes_for_text_are_numbers(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text(GOOD.replace("0.02\n", "2e-2\n", 1))
    assert load_scene(str(file)).spacing == 0.02


def test_anchors_and_merge_keys_work(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text(
        "spacing: 0.02\nliquid: [{sphere: {radius: 0.1}}]\nsolids:\n"
        "  - &left {name: left, sphere: {radius: 0.1}, pose: {position: [-1, 0, 0]}}\n"
        "  - {<<: *left, name: right, pose: {position: [1, 0, 0]}}\n"
    )
    left, right = load_scene(file).solids
    assert left.shape == right.shape and right.pose.position[0] == 1.0


def test_meshes_are_relative_to_their_scene_file(tmp_path, monkeypatch):
    import trimesh

    trimesh.creation.box((0.08, 0.08, 0.08)).export(tmp_path / "cube.stl")
    file = tmp_path / "scene.yaml"
    file.write_text(
        GOOD + "  - {name: cube, mesh: {file: cube.stl}, pose: {position: [0.15, 0.05, 0.15]}}\n"
    )
    monkeypatch.chdir("/")
    assert load_scene(file).solids[2].shape == Mesh(str(tmp_path / "cube.stl"))


# ---------------------------------------------------------------- particles


@pytest.mark.nojit
def test_a_box_is_filled_row_by_row_half_a_spacing_from_its_faces():
    positions, velocities = fill_liquid(
        load_scene(changed("liquid", 0, "velocity", [1, 2, 3], start=POOL))
    )
    assert len(positions) == 5**3
    assert positions[0] == pytest.approx([0.01, 0.01, 0.01])
    assert positions[1] == pytest.approx([0.03, 0.01, 0.01])
    assert positions[5] == pytest.approx([0.01, 0.03, 0.01])
    assert positions[-1] == pytest.approx([0.09, 0.09, 0.09])
    assert (velocities == [1, 2, 3]).all()


def test_round_liquid_has_its_volume():
    shapes = {
        "sphere": ({"radius": 0.1}, 4 / 3 * math.pi * 0.1**3),
        "cylinder": ({"radius": 0.1, "length": 0.2}, math.pi * 0.1**2 * 0.2),
        "capsule": (
            {"radius": 0.1, "length": 0.1},
            math.pi * 0.1**2 * 0.1 + 4 / 3 * math.pi * 0.1**3,
        ),
    }
    for name, (size, volume) in shapes.items():
        positions, _ = fill_liquid(load_scene({"spacing": 0.01, "liquid": [{name: size}]}))
        assert len(positions) * 0.01**3 == pytest.approx(volume, rel=0.02), name
        assert np.abs(positions.mean(axis=0)).max() < 1e-6, name


def test_a_turned_block_is_turned():
    half = math.sqrt(0.5)
    scene = changed("liquid", 0, {"box": {"size": [0.2, 0.02, 0.02]}})
    scene["liquid"][0]["pose"] = {"position": [1, 0, 0], "quat_xyzw": [0, 0, half, half]}
    positions, _ = fill_liquid(load_scene({"spacing": 0.02, "liquid": scene["liquid"]}))
    assert len(positions) == 10
    assert positions[:, 0] == pytest.approx(1.0)
    assert positions[:, 1] == pytest.approx(np.arange(-0.09, 0.1, 0.02), abs=1e-6)


def test_overlapping_blocks_share_no_particle():
    blocks = [
        {"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}},
        {"box": {"min": [0.05, 0.005, 0], "max": [0.15, 0.105, 0.1]}},
        {"sphere": {"radius": 0.05}, "pose": {"position": [0.1, 0.05, 0.11]}},
    ]
    positions, _ = fill_liquid(load_scene({"spacing": 0.01, "liquid": blocks}))
    assert pdist(positions).min() > 0.74 * 0.01
    touching = [blocks[0], {"box": {"min": [0.1, 0, 0], "max": [0.2, 0.1, 0.1]}}]
    positions, _ = fill_liquid(load_scene({"spacing": 0.01, "liquid": touching}))
    assert len(positions) == 2000


def test_no_liquid_is_fine_when_it_is_said():
    positions, velocities = fill_liquid(load_scene({"spacing": 0.01, "liquid": []}))
    assert positions.shape == velocities.shape == (0, 3)


def test_two_dimensions_fill_the_plane():
    scene = load_scene({"spacing": 0.01, "dimension": 2, "liquid": [{"sphere": {"radius": 0.1}}]})
    positions, _ = fill_liquid(scene)
    assert (positions[:, 1] == 0).all()
    assert len(positions) * 0.01**2 == pytest.approx(math.pi * 0.1**2, rel=0.02)


# ---------------------------------------------------------------- what is refused


REFUSED_FILES = {
    "unknown key": ("sphere: {radius", "sphere: {radios", ":9: solids[1].sphere.radios", "radius"),
    "unknown top key": ("spacing:", "spacng:", ":1: spacng", "did you mean 'spacing'"),
    "twice": ("liquid:", "spacing: 0.03\nliquid:", ":2: spacing", "first in line 1"),
    "unit": ("spacing: 0.02", "spacing: 2 cm", ":1: spacing", "number in m"),
    "unit in shape": ("radius: 0.03", "radius: 3 cm", ":9: solids[1].sphere.radius", "number in m"),
    "negative": ("radius: 0.03", "radius: -1", ":9: solids[1].sphere.radius", "greater than 0"),
    "nan": ("[0.15, 0.05, 0.1]", "[0.15, .nan, 0.1]", ":10: solids[1].pose.position[1]", "finite"),
    "short": ("[0.15, 0.05, 0.1]", "[0.15, 0.05]", ":10: solids[1].pose.position", "3 numbers"),
    "missing": ("spacing: 0.02\n", "", ":1", "missing key 'spacing'"),
    "missing name": ("- name: ball\n    sphere", "- sphere", ":8: solids[1]", "'name'"),
    "no shape": ("sphere: {radius: 0.03}", "visible: true", ":8: solids[1]", "expected a shape"),
    "two shapes": ("    pose:", "    box: {size: [1, 1, 1]}\n    pose:", ":10: ", "second shape"),
    "same name": ("name: ball", "name: tank", ":8: solids[1].name", "'tank'"),
    "bad name": ("name: ball", "name: my ball", ":8: solids[1].name", "'my ball'"),
    "huge": ("spacing: 0.02", "spacing: 10", ":3: liquid[0]", "metres"),
    "tiny": ("spacing: 0.02", "spacing: 1.0e-6", ":1: spacing", "GB"),
    "overlap": ("0.15, 0.05, 0.1]", "0.1, 0.05, 0.1]", ":8: solids[1]", "'ball' overlaps"),
    "syntax": ("[0.15, 0.05, 0.1]", "[0.15, 0.05", ":10:33: not valid YAML", "expected"),
    "mesh": ("sphere: {radius: 0.03}", "mesh: {file: no.stl}", ":9: solids[1].mesh.file", "no.stl"),
    "control": ("sphere:", "control: topics\n    sphere:", ":9: solids[1].control", "topic"),
    "solver": ("spacing:", "solver: force\nspacing:", ":1: solver", "relaxation"),
    "material": ("spacing:", "material: watr\nspacing:", ":1: material", "'water'"),
    "material value": (
        "spacing:",
        "material:\n  viscosity: -1\nspacing:",
        ":2: material.viscosity",
        "expected 0",
    ),
    "loop": ("liquid:", "description: &a [*a]\nliquid:", "scene.yaml:2", "circle"),
    "tag": ("0.02", "!!python/name:os.system 1", "scene.yaml:1", "not valid YAML"),
}


@pytest.mark.parametrize("case", REFUSED_FILES)
def test_refused_with_file_line_key_and_what_was_expected(case, tmp_path):
    old, new, place, expected = REFUSED_FILES[case]
    assert GOOD.count(old) >= 1
    file = tmp_path / "scene.yaml"
    file.write_text(GOOD.replace(old, new, 1))
    text = message(file)
    assert str(file) in text and place in text and expected in text


def test_refused_files_that_are_no_scene(tmp_path):
    (tmp_path / "list.yaml").write_text("- 1\n")
    (tmp_path / "empty.yaml").write_text("# nothing\n")
    (tmp_path / "binary.yaml").write_bytes(b"\x89MCAP0\r\n\x00\xff")
    (tmp_path / "two.yaml").write_text(GOOD + "---\n" + GOOD)
    assert "expected a mapping" in message(tmp_path / "list.yaml")
    assert "empty" in message(tmp_path / "empty.yaml")
    assert "not valid YAML" in message(tmp_path / "binary.yaml")
    assert "not valid YAML" in message(tmp_path / "two.yaml")
    assert "no such file" in message(tmp_path / "none.yaml")
    assert "directory" in message(f"{tmp_path}/")
    assert "did you mean 'ball_tank'" in message("ball_tnak")
    assert "int" in message(7)


def test_refused_dicts():
    assert "neither" in message({"spacing": 0.01})
    assert "expected 3 numbers" in message(changed("gravity", -9.81))
    assert "expected a number" in message(changed("spacing", True))
    assert "1.6 to 4" in message(changed("support_radius", 0.2))
    assert "expected 2 or 3" in message(changed("dimension", 4))
    assert "expected a list" in message(changed("solids", {"name": "a"}))
    assert "keyframes" in message(changed("solids", 1, "control", "path"))
    assert "neither" in message(changed("emitters", [{"position": [0, 0, 0], "radius": 0.1}]))
    jet = {"position": [0, 0, 0.05], "radius": 0.05, "speed": 1}
    assert "inside solid 'ball'" in message(
        changed("emitters", [{**jet, "position": [0.15, 0.05, 0.1], "radius": 0.01}])
    )
    assert "emitters[0].rate: 2000 particles/s" in message(
        changed("emitters", [{**jet, "rate": 2000}])
    )
    assert "x-z plane" in message(
        {**POOL, "dimension": 2, "emitters": [{**jet, "direction": [0, 1, 0]}]}
    )
    assert "more than from" in message(changed("emitters", [{**jet, "from": 2, "until": 1}]))
    assert "columns" in message(changed("emitters", [{**jet, "radius": 99}]))
    assert "expected one of box" in message(changed("sinks", [{"mesh": {"file": "a.obj"}}]))
    assert "<dict>: liquid[0]" in message(changed("liquid", 0, {"plane": {}}))
    assert "text" in message(changed("solids", 1, {"name": "m", "mesh": {"file": 3}}))


def test_more_particles_than_memory_names_both_numbers(monkeypatch):
    monkeypatch.setattr("sph_ros.sim.scene.available_memory", lambda: 100_000)
    text = message(POOL)
    assert "125 particles" in text and "0.0 GB" in text
    assert liquid.available_memory() > 1e8


def test_a_leaky_mesh_is_refused_with_file_and_line(tmp_path, shared_data):
    file = tmp_path / "scene.yaml"
    soup = shared_data / "meshes" / "trimesh" / "soup.stl"
    file.write_text(GOOD.replace("sphere: {radius: 0.03}", f"mesh: {{file: {soup}}}"))
    text = message(file)
    assert "scene.yaml:8: solids[1]" in text and "soup.stl" in text


def test_paths_of_packaged_files():
    assert scene_path("dam_break").name == "dam_break.yaml"
    with pytest.raises(SceneError, match="did you mean 'dam_break'"):
        scene_path("dam_brake")
    with pytest.raises(SceneError, match="no such bag"):
        bag_path("none")


@pytest.mark.nojit
def test_shapes_of_the_pool():
    tank, ball = load_scene(POOL).solids
    assert tank.shape == Container(Box(min=(0, 0, 0), max=(0.2, 0.1, 0.2)))
    assert ball.shape == Sphere(0.03)
