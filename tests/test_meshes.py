# SPDX-License-Identifier: Apache-2.0
"""Mesh files: what is refused and why, sampled distances against analytic ones, cache, drawing."""

import logging
import math

import numpy as np
import pytest
import trimesh

from sph_ros.core.distances import signed_distances
from sph_ros.core.mesh_distance import build_cluster_tree, winding_numbers
from sph_ros.core.walls import wall_terms_at
from sph_ros.sim import meshes
from sph_ros.sim.meshes import MeshError, load_distance_grid, load_surface
from sph_ros.sim.shapes import (
    Box,
    Capsule,
    Container,
    Cylinder,
    Difference,
    Mesh,
    Placed,
    Plane,
    Pose,
    Sphere,
    Union,
    bounding_radius,
    display_mesh,
    pack_shapes,
    volume,
)


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    """No test reads or leaves grids in the user's real cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


def saved(tmp_path, mesh, name="mesh.stl"):
    path = tmp_path / name
    mesh.export(path)
    return str(path)


def sampled_at(shape, points, spacing, dimension=3):
    points = np.ascontiguousarray(points, dtype=np.float32)
    distance = np.empty(len(points), dtype=np.float32)
    signed_distances(pack_shapes([shape], 2 * spacing, spacing, dimension), 0, points, distance)
    return distance


def walls_at(shape, points, spacing):
    points = np.ascontiguousarray(points, dtype=np.float32)
    terms = np.empty((len(points), 12), dtype=np.float32)
    wall_terms_at(pack_shapes([shape], 2 * spacing, spacing, 3), 0, points, terms)
    return terms


def test_sphere_file_has_the_distance_of_a_sphere(shared_data):
    file = str(shared_data / "meshes/trimesh/unit_sphere.STL")
    spacing, scale = 0.01, 0.1
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (5000, 3))
    distance = sampled_at(Mesh(file, scale), points, spacing)
    r = np.linalg.norm(points, axis=1)
    inside_grid = np.abs(points).max(axis=1) < scale + 2 * spacing
    cell = spacing / 2
    sag = 0.0005  # the facets lie up to this far below the sphere
    near = inside_grid & (np.abs(r - scale) < 2 * spacing)
    assert np.abs(distance - (r - scale))[near].max() < 0.1 * cell + sag
    assert np.abs(distance - (r - scale))[inside_grid & (r > 0.02)].max() < 0.25 * cell + sag
    # Beyond the grid: a lower bound (but for the facets) that is far from trivial.
    assert np.all(distance[~inside_grid] < (r - scale)[~inside_grid] + sag + 0.1 * cell)
    assert np.all(distance[~inside_grid] > 0.6 * (r - scale)[~inside_grid])


def test_torus_file_has_the_distance_of_a_torus(shared_data):
    surface = load_surface(str(shared_data / "meshes/trimesh/torus.STL"), 0.1)
    middle = 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0))
    extent = np.ptp(surface.vertices, axis=0)
    minor = extent.min() / 2
    major = extent.max() / 2 - minor
    axis = int(np.argmin(extent))
    points = middle + np.random.default_rng(0).uniform(-0.5, 0.5, (5000, 3)) * (extent + 0.02)
    local = points - middle
    ring = np.linalg.norm(np.delete(local, axis, axis=1), axis=1)
    exact = np.hypot(ring - major, local[:, axis]) - minor
    mesh = Mesh(str(shared_data / "meshes/trimesh/torus.STL"), 0.1)
    distance = sampled_at(mesh, points, 0.01)
    error = np.abs(distance - exact)
    cell, sag = 0.005, 0.0005
    assert error[np.abs(exact) < 0.6 * minor].max() < 0.15 * cell + sag
    assert error.max() < 0.6 * cell  # at the ring and the axis the distance has a kink in the cell


@pytest.mark.parametrize("turned", [False, True], ids=["outward", "inward"])
def test_box_file_equals_the_box_in_distance_wall_and_volume(tmp_path, turned):
    """At faces, edges and corners, whichever way the file's triangles are wound."""
    solid = trimesh.creation.box(extents=(0.08, 0.06, 0.1)).subdivide()
    if turned:
        solid.invert()
    mesh, box = Mesh(saved(tmp_path, solid)), Box(size=(0.08, 0.06, 0.1))
    points = np.random.default_rng(1).uniform(-0.07, 0.07, (4000, 3))
    spacing = 0.01
    exact = sampled_at(box, points, spacing)
    distance = sampled_at(mesh, points, spacing)
    error, cell = np.abs(distance - exact), spacing / 2
    assert error[(exact > 0) & (exact < 2 * spacing)].max() < 0.2 * cell
    assert error[exact < 2 * spacing].max() < 0.5 * cell  # inside, kinks meet at the edges
    for shape, twin in ((mesh, box), (Container(mesh), Container(box))):
        terms, expected = walls_at(shape, points, spacing), walls_at(twin, points, spacing)
        # From where liquid at rest has its first layer; nearer, in the corners of a container, the
        # product of mirrored sides and the mesh's ratio to a mirrored wall differ by up to 0.17.
        liquid = (expected[:, 0] > 0.4 * spacing) & (expected[:, 0] < 1.5 * spacing)
        error = np.abs(terms - expected)[liquid][:, [4, 8]]
        assert liquid.sum() > 100 and error.mean() < 0.01 and error.max() < 0.11
    assert volume(mesh) == pytest.approx(volume(box), rel=1e-5)
    vertices, triangles = display_mesh(mesh)
    assert trimesh.Trimesh(vertices, triangles).volume == pytest.approx(volume(box), rel=1e-4)


def test_wall_gradients_of_a_mesh_match_differences(tmp_path):
    mesh = Mesh(saved(tmp_path, trimesh.creation.icosphere(3, 0.05)))
    generator = np.random.default_rng(3)
    direction = generator.normal(size=(2000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    points = (direction * generator.uniform(0.045, 0.068, (2000, 1))).astype(np.float32)
    for shape in (mesh, Container(mesh)):
        terms = walls_at(shape, points, 0.01)
        for axis in range(3):
            offset = 1e-4 * np.eye(3, dtype=np.float32)[axis]
            ahead, behind = points + offset, points - offset
            change = walls_at(shape, ahead, 0.01) - walls_at(shape, behind, 0.01)
            slope = change / (ahead - behind)[:, axis, None]
            for value, gradient in ((4, 5), (8, 9)):
                error = 0.01 * np.abs(slope[:, value] - terms[:, gradient + axis])
                assert np.quantile(error, 0.9) < 0.02  # some pairs straddle two cells


def test_cube_in_millimetres(shared_data):
    file = str(shared_data / "meshes/trimesh/20mm-xyz-cube.stl")
    extent = np.ptp(load_surface(file, 0.001).vertices, axis=0)
    np.testing.assert_allclose(extent, 0.02, atol=1e-5)
    assert volume(Mesh(file, 0.001)) == pytest.approx(0.02**3, rel=0.02)  # letters are engraved


def test_bodies_wound_against_each_other_are_both_solid(shared_data):
    file = str(shared_data / "meshes/trimesh/multibody.stl")
    vertices, triangles = display_mesh(Mesh(file))
    bodies = trimesh.Trimesh(vertices, triangles).split()
    assert len(bodies) == 2 and all(body.volume > 0 for body in bodies)
    middles = [body.vertices[body.faces[0]].mean(axis=0) for body in bodies]
    inside = [m - 0.005 * body.face_normals[0] for m, body in zip(middles, bodies, strict=True)]
    assert np.all(sampled_at(Mesh(file), inside, 0.02) < 0)


def test_hollow_body_keeps_its_cavity(tmp_path):
    outer, inner = trimesh.creation.icosphere(3, 0.05), trimesh.creation.icosphere(3, 0.03)
    inner.invert()
    file = saved(tmp_path, trimesh.util.concatenate([outer, inner]))
    distance = sampled_at(Mesh(file), [[0, 0, 0], [0.04, 0, 0], [0.06, 0, 0]], 0.005)
    np.testing.assert_allclose(distance, [0.03, -0.01, 0.01], atol=0.001)
    assert volume(Mesh(file)) == pytest.approx(4 / 3 * math.pi * (0.05**3 - 0.03**3), rel=0.02)


def test_leaky_scan_has_no_stray_signs(shared_data, caplog):
    """A scan with holes: samples change sign only where the surface is between."""
    meshes._load_surface.cache_clear()
    file = str(shared_data / "meshes/trimesh/bunny.ply")
    with caplog.at_level(logging.WARNING):
        grid = load_distance_grid(Mesh(file), 0.012, 0.006, 3)
    assert "not watertight" in caplog.text and "bunny.ply" in caplog.text
    d, cell = grid.distance, grid.cell
    for axis in range(3):
        a, b = np.moveaxis(d, axis, 0)[:-1], np.moveaxis(d, axis, 0)[1:]
        assert np.all(np.abs(a - b) < 1.05 * cell)  # 1-Lipschitz: a wrong sign would jump
    inside = np.clip(0.5 - d / cell, 0, 1).sum() * cell**3
    assert inside == pytest.approx(volume(Mesh(file)), rel=0.02)


@pytest.mark.parametrize(
    "name", ["bullet3/textured-0008192.obj", "trimesh/teapot.stl", "franka/hand.stl"]
)
def test_real_files_are_accepted(shared_data, name):
    shape = Mesh(str(shared_data / "meshes" / name))
    vertices, triangles = display_mesh(shape)
    assert vertices.dtype == np.float32 and triangles.dtype == np.int32
    assert (
        volume(shape) > 0
        and np.linalg.norm(vertices, axis=1).max() <= bounding_radius(shape) * 1.001
    )


@pytest.mark.parametrize(
    ("name", "cause"),
    [
        ("soup.stl", "does not enclose a body: 300 open edges"),
        ("empty.stl", "no triangles"),
        ("empty.obj", "no triangles"),
        ("notenoughindices.obj", "does not enclose|cannot be read|no triangles"),
        ("missing.stl", "no such mesh file"),
    ],
)
def test_bad_files_are_refused_with_name_and_cause(shared_data, name, cause):
    path = shared_data / "meshes/trimesh" / name
    with pytest.raises(MeshError, match=cause) as caught:
        load_surface(str(path))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "cause"),
    [
        ("noise.ply", bytes(range(256)) * 4, "cannot be read"),
        ("flat.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no triangles with an area"),
        ("nan.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
        ("mesh.xyz123", b"hello", "no reader"),
    ],
)
def test_damaged_files_are_refused_with_name_and_cause(tmp_path, name, content, cause):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(MeshError, match=cause) as caught:
        load_surface(str(path))
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_open_cup_is_refused(tmp_path):
    """A single sheet around a wide mouth: closed, it would hold no liquid."""
    cup = trimesh.creation.cylinder(0.04, height=0.08, sections=48)
    keep = ~(cup.triangles[:, :, 2] > 0.039).all(axis=1)
    cup.update_faces(keep)
    with pytest.raises(MeshError, match="does not enclose a body"):
        load_surface(saved(tmp_path, cup))


def test_winding_number_equals_the_sum_of_solid_angles():
    """The tree against every triangle one by one (Van Oosterom & Strackee)."""
    body = trimesh.creation.icosphere(3, 1.0)
    corners = np.asarray(body.triangles)[: len(body.faces) * 3 // 4]  # with a big hole
    points = np.random.default_rng(2).uniform(-1.5, 1.5, (300, 3))
    fast = np.empty(len(points))
    winding_numbers(build_cluster_tree(corners), points, fast)
    a, b, c = (corners[None, :, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    ab, bc, ca = (np.einsum("ijk,ijk->ij", u, v) for u, v in ((a, b), (b, c), (c, a)))
    triple = np.einsum("ijk,ijk->ij", a, np.cross(b, c))
    slow = 2 * np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb)
    np.testing.assert_allclose(fast, slow.sum(axis=1) / (4 * np.pi), atol=0.02)


def test_grid_is_kept_by_content_and_made_again_when_damaged(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    file = saved(tmp_path, trimesh.creation.box(extents=(0.05, 0.05, 0.05)))
    computed = []
    compute = meshes._compute_grid
    monkeypatch.setattr(meshes, "_compute_grid", lambda *a: computed.append(1) or compute(*a))
    first = load_distance_grid(Mesh(file), 0.02, 0.01, 3)
    again = load_distance_grid(Mesh(file), 0.02, 0.01, 3)
    np.testing.assert_array_equal(first.distance, again.distance)
    np.testing.assert_array_equal(first.ratio, again.ratio)
    assert len(computed) == 1
    (stored,) = (tmp_path / "cache/sph_ros/distance_grids").iterdir()  # and nothing half-written
    content = stored.read_bytes()
    stored.write_bytes(content[: len(content) // 2])
    repaired = load_distance_grid(Mesh(file), 0.02, 0.01, 3)
    np.testing.assert_array_equal(first.distance, repaired.distance)
    assert len(computed) == 2 and "damaged cache file" in caplog.text
    load_distance_grid(Mesh(file, scale=2.0), 0.02, 0.01, 3)
    assert len(computed) == 3


def test_no_cache_folder_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    file = saved(tmp_path, trimesh.creation.box(extents=(0.05, 0.05, 0.05)))
    assert load_distance_grid(Mesh(file), 0.02, 0.01, 3).distance.min() < -0.02


def test_huge_mesh_stays_within_memory(tmp_path):
    file = saved(tmp_path, trimesh.creation.box(extents=(3.0, 2.0, 1.0)))
    surface = load_surface(file)
    _, cell, shape = meshes.grid_layout(surface, 0.02, 0.01)
    assert math.prod(shape) <= meshes.MAX_GRID_NODES and cell > 0.005


@pytest.mark.parametrize(
    "shape",
    [
        Sphere(0.03),
        Box((0, 0, 0), (0.1, 0.2, 0.3)),
        Capsule(0.02, 0.06),
        Cylinder(0.03, 0.06),
        Difference([Cylinder(0.05, 0.1), Placed(Cylinder(0.04, 0.1), Pose((0, 0, 0.02)))]),
    ],
    ids=lambda shape: type(shape).__name__,
)
def test_drawn_surface_is_closed_outward_and_at_distance_zero(shape):
    vertices, triangles = display_mesh(shape)
    mesh = trimesh.Trimesh(vertices, triangles)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume(shape), rel=0.02)
    assert np.linalg.norm(vertices, axis=1).max() <= bounding_radius(shape) * 1.001
    np.testing.assert_allclose(sampled_at(shape, vertices, 0.01), 0.0, atol=0.001)


def test_volumes():
    cup = Difference([Cylinder(0.05, 0.1), Placed(Cylinder(0.04, 0.1), Pose((0, 0, 0.02)))])
    exact = math.pi * (0.05**2 * 0.1 - 0.04**2 * 0.08)
    assert volume(cup) == pytest.approx(exact, rel=0.01)
    pair = Union([Sphere(0.05), Placed(Box(size=(0.1, 0.1, 0.1)), Pose((0.2, 0, 0)))])
    assert volume(pair) == pytest.approx(volume(Sphere(0.05)) + 0.001, rel=0.01)
    assert volume(Plane()) == volume(Container(Sphere(1))) == math.inf
    vertices, _ = display_mesh(Plane((0, 0, 2), 0.5))
    np.testing.assert_allclose(vertices[:, 2], 0.5)
