# SPDX-License-Identifier: Apache-2.0
"""What a film shows of a scene, and that markers and pictures agree on colours."""

import cv2
import numpy as np

from msg_adapters.marker import DELETE
from sph_ros import film
from sph_ros.colors import CONTAINER, liquid_color, solid_colors, speed_colors
from sph_ros.core.surface import extract_surface
from sph_ros.scene_markers import SolidMarkers, surface_color, surface_marker
from sph_ros.sim.scene import load_scene
from sph_ros.sim.simulation import Simulation

FLAT = {
    "dimension": 2,
    "spacing": 0.02,
    "frame": "pool",
    "liquid": [{"box": {"min": [0, -0.1, 0], "max": [0.2, 0.1, 0.1]}}],
    "solids": [
        {"name": "floor", "plane": {}},
        {"name": "wall", "container": {"box": {"size": [9, 9, 9]}}, "visible": False},
        {
            "name": "red",
            "sphere": {"radius": 0.03},
            "pose": {"position": [0.1, 0, 0.3]},
            "color": [1, 0, 0],
        },
        {"name": "plain", "sphere": {"radius": 0.02}, "pose": {"position": [0.1, 0, 0.4]}},
    ],
}


def test_a_film_shows_what_is_visible_and_frames_what_has_an_end(tmp_path, monkeypatch):
    frames, cameras, draw = [], [], film.render

    def watched(frame, camera, size):
        frames.append(frame)
        cameras.append(camera)
        return draw(frame, camera, size)

    monkeypatch.setattr(film, "render", watched)
    sim = Simulation(FLAT)
    poses = {n: (sim.solid(n).position, sim.solid(n).quat_xyzw) for n in sim.solid_names}
    surface = extract_surface(sim.positions, 0.02, dimension=2)
    with film.Film(sim.scene, tmp_path / "a.mp4", tmp_path / "a.png", (96, 64), 10) as shot:
        shot.add(sim.positions, sim.velocities, surface, poses)
        moved = {**poses, "red": ((0.1, 0.0, 5.0), poses["red"][1])}
        shot.add(sim.positions, sim.velocities, surface, moved)
    assert [view.name for view in frames[0].solids] == ["floor", "red", "plain"]
    assert frames[0].dimension == 2 and frames[0].spacing == 0.02
    assert cameras[0] is cameras[1]  # it does not follow what moves
    seen, _ = cameras[0].project([[0.1, 0.0, 0.4], [0.0, 0.0, 0.0], [1.0, 1.0, 0.0]], (96, 64))
    inside = ((seen >= 0) & (seen <= (96, 64))).all(axis=1)
    assert inside.tolist() == [True, True, False]  # a corner of the floor is outside
    assert cv2.imread(str(tmp_path / "a.png")).shape == (64, 96, 3)


def test_no_film_is_left_by_an_error(tmp_path):
    try:
        with film.Film(load_scene(FLAT), tmp_path / "a.mp4", tmp_path / "a.png", (96, 64), 10):
            raise KeyError
    except KeyError:
        pass
    assert not list(tmp_path.iterdir())


def test_markers_show_visible_solids_where_they_are():
    sim = Simulation(FLAT)
    solids, colors = SolidMarkers(sim), solid_colors(sim.scene)
    sim.solid("red").position = np.array((1.0, 2.0, 3.0))
    markers = {marker.namespace: marker for marker in solids.at(77)}
    assert list(markers) == ["floor", "red", "plain"]
    assert markers["red"].position == (1.0, 2.0, 3.0) and markers["red"].color == (1, 0, 0, 1)
    assert {marker.stamp_ns for marker in markers.values()} == {77}
    assert {marker.frame_id for marker in markers.values()} == {"pool"}
    assert [marker.marker_id for marker in markers.values()] == [0, 2, 3]
    assert colors["wall"] == CONTAINER and colors["floor"] != colors["plain"]
    empty = surface_marker(
        np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3)), 5, "pool"
    )
    assert empty.action == DELETE and empty.namespace == "surface"


def test_the_surface_is_shaded_smoothly_and_opaque():
    vertices = np.random.default_rng(1).normal(size=(500, 3))
    vertices /= np.linalg.norm(vertices, axis=1)[:, None]  # on a sphere; outward normals, too
    triangles = np.arange(498, dtype=np.int32).reshape(-1, 3)
    marker = surface_marker(vertices, triangles, vertices, 5, "pool")
    assert marker.colors.shape == (498, 4) and (marker.colors[:, 3] == 1.0).all()
    assert marker.colors.min() >= 0.0 and marker.colors.max() <= 1.0
    # Lit from above: the brightest are next to each other, the darkest are on the other side.
    order = np.argsort(marker.colors[:, :3].sum(axis=1))
    bright, dark = marker.points[order[-20:]], marker.points[order[:20]]
    assert bright[:, 2].min() > 0.5 > -0.5 > dark[:, 2].max()
    assert np.linalg.norm(bright.mean(axis=0)) > 0.9


def test_each_of_several_liquids_has_its_colour_on_the_surface():
    oil = {"box": {"min": [0.1, 0, 0], "max": [0.2, 0.1, 0.1]}, "material": "oil"}
    scene = load_scene(
        {
            "spacing": 0.02,
            "solver": "none",
            "liquid": [{"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}}, oil],
        }
    )
    sim = Simulation(scene)
    vertices, triangles, normals = extract_surface(sim.positions, 0.02)
    color = surface_color(scene.liquids, vertices, sim.positions, sim.families)
    marker = surface_marker(vertices, triangles, normals, 5, "pool", color)
    blueish = marker.colors[:, 2] > marker.colors[:, 0]
    left, right = marker.points[:, 0] < 0.09, marker.points[:, 0] > 0.11  # of where they meet
    assert blueish[left].mean() > 0.98 and blueish[right].mean() < 0.02
    alone = surface_color(scene.liquids[:1], vertices, sim.positions, None)
    assert alone == liquid_color(scene.material)


def test_speeds_go_from_deep_blue_to_white_and_stand_nan():
    colors = speed_colors([0.0, 0.5, 1.0, 7.0, -1.0, np.nan, np.inf])
    brightness = colors.sum(axis=1)
    assert brightness[0] < brightness[1] < brightness[2] == brightness[3] == brightness[6]
    assert (colors[4] == colors[0]).all() and (colors[5] == colors[0]).all()
    assert colors.min() >= 0.0 and colors.max() <= 1.0
