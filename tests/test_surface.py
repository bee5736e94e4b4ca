# SPDX-License-Identifier: Apache-2.0
"""The surface's mesh: closed, outward, in the right place, with the right volume."""

import tracemalloc

import numpy as np
import pytest

from sph_ros.core import surface as surface_module
from sph_ros.core.marching import marching_cubes
from sph_ros.core.surface import Surface, colour_field, extract_surface

SPACING = 0.01


def lattice(*counts):
    """Cubic lattice (N, 3) whose particles stand half a spacing from the faces of its box at 0."""
    axes = [(np.arange(n) + 0.5) * SPACING for n in counts]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)


def ball_of_particles(radius, centre=(0.0, 0.0, 0.0)):
    n = int(np.ceil(2 * radius / SPACING)) + 2
    points = lattice(n, n, n) - np.float32(n * SPACING / 2)
    inside = points[np.linalg.norm(points, axis=1) < radius]
    return (inside + np.asarray(centre)).astype(np.float32)


def enclosed_volume(mesh):
    a, b, c = (mesh.vertices[mesh.triangles[:, i]].astype(np.float64) for i in range(3))
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0


def directed_edges(triangles):
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def assert_closed_and_oriented(mesh):
    """Every directed edge occurs once, and so does its opposite."""
    forward = directed_edges(mesh.triangles).astype(np.int64)
    count = len(mesh.vertices)
    keys = forward[:, 0] * count + forward[:, 1]
    assert len(np.unique(keys)) == len(keys)
    assert np.array_equal(np.sort(keys), np.sort(forward[:, 1] * count + forward[:, 0]))


def component_count(mesh):
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    i, j = directed_edges(mesh.triangles).T
    shape = (len(mesh.vertices),) * 2
    return connected_components(coo_matrix((np.ones(len(i)), (i, j)), shape))[0]


def test_marching_cubes_closes_every_case_and_interpolates():
    """All 256 cases, each beside what random neighbours make of it; vertices against the field."""
    rng = np.random.default_rng(2)
    for case in range(256):
        field = np.zeros((6, 6, 6), np.float32)
        field[1:-1, 1:-1, 1:-1] = rng.random((4, 4, 4))
        inside = np.array([case >> corner & 1 for corner in range(8)]).reshape(2, 2, 2).T
        field[2:4, 2:4, 2:4] = 0.2 + 0.6 * inside
        nodes, triangles = marching_cubes(field, 0.5)
        assert_closed_and_oriented(Surface(nodes, triangles, nodes))
        low = np.floor(nodes).astype(int)
        high, share = np.ceil(nodes).astype(int), (nodes - low).max(axis=1)
        assert (np.abs(high - low).sum(axis=1) == 1).all()  # on an edge of the grid
        a, b = field[tuple(low.T)], field[tuple(high.T)]
        assert np.allclose(a + share * (b - a), 0.5, atol=1e-5)
    thread = np.zeros((5, 5, 5), np.float32)  # two corners across a cell, and its middle
    for middle, parts in ((0.4, 1), (0.1, 2)):
        thread[1:4, 1:4, 1:4] = middle
        thread[[1, 2], [1, 2], [1, 2]] = 1.0
        mesh = Surface(*marching_cubes(thread, 0.5), None)
        assert_closed_and_oriented(mesh)
        assert component_count(mesh) == parts and enclosed_volume(mesh) > 0.0
    with pytest.raises(ValueError, match="border"):
        marching_cubes(np.ones((3, 3, 3), np.float32), 0.5)


def test_ball_of_particles_gives_a_sphere():
    centre = np.array([0.1031, -0.0472, 0.3007])
    radius = 0.1
    particles = ball_of_particles(radius, centre)
    mesh = extract_surface(particles, SPACING)
    assert mesh.vertices.dtype == np.float32 and mesh.normals.dtype == np.float32
    assert mesh.triangles.dtype == np.int32
    assert_closed_and_oriented(mesh)
    edges = len(mesh.triangles) * 3 // 2
    assert len(mesh.vertices) - edges + len(mesh.triangles) == 2
    away = mesh.vertices - centre
    distance = np.linalg.norm(away, axis=1)
    assert abs(distance.mean() - radius) < 0.06 * SPACING
    assert np.abs(distance - radius).max() < 0.25 * SPACING  # the lattice ball itself has steps
    assert np.einsum("ij,ij->i", away / distance[:, None], mesh.normals).min() > 0.97
    assert enclosed_volume(mesh) == pytest.approx(len(particles) * SPACING**3, rel=0.03)


@pytest.mark.parametrize("shift", [0.0, 0.0037])
def test_block_is_flat_and_has_its_volume(shift):
    particles = lattice(20, 20, 20) + np.float32(shift)
    mesh = extract_surface(particles, SPACING)
    assert_closed_and_oriented(mesh)
    assert enclosed_volume(mesh) == pytest.approx(len(particles) * SPACING**3, rel=0.03)
    inner = np.abs(mesh.vertices[:, :2] - (0.1 + shift)).max(axis=1) < 0.055
    top = mesh.vertices[inner & (mesh.vertices[:, 2] > 0.1)]
    assert len(top) > 100
    # Between two nodes the field is interpolated linearly: a hundredth of a spacing for any offset.
    assert abs(top[:, 2].mean() - (0.2 + shift)) < 0.02 * SPACING
    assert np.ptp(top[:, 2]) < 0.01 * SPACING


def test_unrest_of_particles_is_smoothed():
    """Particles off their lattice by 10 % of the spacing leave 5 % on the surface."""
    rng = np.random.default_rng(2)
    particles = lattice(24, 24, 12)
    particles = (particles + rng.normal(0.0, 0.1 * SPACING, particles.shape)).astype(np.float32)
    mesh = extract_surface(particles, SPACING)
    inner = np.abs(mesh.vertices[:, :2] - 0.12).max(axis=1) < 0.09
    top = mesh.vertices[inner & (mesh.vertices[:, 2] > 0.1), 2]
    assert top.std() < 0.05 * SPACING
    assert abs(top.mean() - 0.12) < 0.03 * SPACING


def test_lattice_colour_is_one_inside_and_half_on_the_face():
    """The splines are a partition of unity, so a full liquid has colour 1 to rounding."""
    particles = lattice(12, 12, 12)
    grid = surface_module._grid_around(particles, SPACING, 2 * SPACING, SPACING, 3)
    field = colour_field(particles, grid, SPACING, 2 * SPACING)
    node = -grid.first.astype(int)
    middle = tuple(node + 6)
    assert field[middle] == pytest.approx(1.0, abs=1e-5)
    assert field[node[0], node[1] + 6, node[2] + 6] == pytest.approx(0.5, abs=2e-3)
    border = field.copy()
    border[1:-1, 1:-1, 1:-1] = 0.0
    assert not border.any()


def test_field_matches_sum_over_all_particles():
    """The kernel against the obvious sum, without blur, where no particle is lonely."""
    rng = np.random.default_rng(5)
    particles = lattice(6, 7, 8)
    particles = (particles + rng.uniform(-0.1, 0.1, particles.shape) * SPACING).astype(np.float32)
    support_radius = 3.0 * SPACING
    cell = np.full(3, 0.7 * SPACING)
    grid = surface_module.Grid(cell, np.full(3, -9.0), (30, 30, 30))
    weights = np.full(len(particles), (SPACING / (support_radius / 2)) ** 3, np.float32)
    got = np.zeros(grid.shape, np.float32)
    nowhere = np.zeros((1, 3), np.int64)
    surface_module._splat(
        particles, nowhere, cell, grid.first, support_radius / 2, False, weights, got
    )
    nodes = (np.stack(np.meshgrid(*[np.arange(30)] * 3, indexing="ij"), -1) - 9) * cell
    q = np.abs(nodes[..., None, :] - particles) / (support_radius / 2)
    spline = np.where(q < 1, 2 / 3 - q**2 + q**3 / 2, np.maximum(2 - q, 0) ** 3 / 6)
    expected = (spline.prod(axis=-1) * weights).sum(axis=-1)
    assert np.abs(got - expected).max() < 1e-5


def test_single_particles_keep_a_drop_wherever_they_are():
    rng = np.random.default_rng(1)
    volumes = []
    for place in rng.uniform(-1.0, 1.0, (20, 3)):
        mesh = extract_surface(place[None], SPACING)
        assert_closed_and_oriented(mesh)
        assert component_count(mesh) == 1
        volumes.append(enclosed_volume(mesh) / SPACING**3)
        assert np.linalg.norm(mesh.vertices.mean(axis=0) - place) < 0.3 * SPACING
    assert 1.0 < min(volumes) and max(volumes) < 2.5
    assert max(volumes) < 2.0 * min(volumes)  # a flying drop does not pulsate


@pytest.mark.nojit
def test_film_and_thread_do_not_vanish():
    film = extract_surface(lattice(15, 15, 1) + np.float32(0.0031), SPACING)
    thread = extract_surface(lattice(1, 1, 30) + np.float32(0.0031), SPACING)
    for mesh, count in ((film, 225), (thread, 30)):
        assert_closed_and_oriented(mesh)
        assert component_count(mesh) == 1
        assert 0.8 < enclosed_volume(mesh) / (count * SPACING**3) < 1.5


@pytest.mark.nojit
def test_separate_drops_are_separate_components():
    drops = [ball_of_particles(0.04, (x, 0.0, 0.0)) for x in (0.0, 0.13)]
    mesh = extract_surface(np.concatenate(drops), SPACING)
    assert component_count(mesh) == 2


def sorted_corners(mesh):
    corners = mesh.vertices[mesh.triangles].reshape(-1, 9)
    return corners[np.lexsort(corners.T)]


def test_clusters_give_the_same_mesh_as_the_dense_box(monkeypatch):
    """Two drops and some particles between: once in one box, once cluster by cluster."""
    rng = np.random.default_rng(4)
    particles = np.concatenate(
        [
            ball_of_particles(0.06, (0.0, 0.0, 0.0)),
            ball_of_particles(0.03, (0.4, 0.1, 0.2)),
            rng.uniform(-0.4, 0.8, (40, 3)).astype(np.float32),
        ]
    )
    dense = extract_surface(particles, SPACING)
    monkeypatch.setattr(surface_module, "DENSE_NODES", 0)
    monkeypatch.setattr(surface_module, "DENSE_NODES_PER_PARTICLE", 0)
    split = extract_surface(particles, SPACING)
    assert_closed_and_oriented(split)
    assert len(split.vertices) == len(dense.vertices)
    assert np.abs(sorted_corners(dense) - sorted_corners(split)).max() < 1e-3 * SPACING


def test_scattered_particles_do_not_explode_memory():
    """20,000 particles over 100 m: a dense grid would have 1e12 nodes."""
    rng = np.random.default_rng(3)
    particles = rng.uniform(-50.0, 50.0, (20000, 3)).astype(np.float32)
    tracemalloc.start()
    mesh = extract_surface(particles, SPACING)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6
    assert_closed_and_oriented(mesh)
    assert component_count(mesh) > 19900  # some particles are neighbours by chance
    gap = np.abs(mesh.vertices[:1000, None] - particles[None]).max(axis=2).min(axis=1)
    assert gap.max() < 1.5 * SPACING


def test_one_long_cluster_gets_coarser_cells_but_stays(monkeypatch):
    monkeypatch.setattr(surface_module, "MAX_NODES", 1 << 15)
    monkeypatch.setattr(surface_module, "DENSE_NODES", 1 << 10)
    diagonal = (np.arange(200)[:, None] * np.full(3, SPACING)).astype(np.float32)
    mesh = extract_surface(diagonal, SPACING)
    assert_closed_and_oriented(mesh)
    assert component_count(mesh) == 1
    assert mesh.vertices.min() < 0.03 and mesh.vertices.max() > 1.97


def test_same_particles_give_the_same_bytes():
    rng = np.random.default_rng(9)
    particles = rng.normal(0.0, 0.06, (3000, 3)).astype(np.float32)
    first, second = extract_surface(particles, SPACING), extract_surface(particles.copy(), SPACING)
    for one, other in zip(first, second, strict=True):
        assert one.tobytes() == other.tobytes()


def test_two_dimensional_liquid_is_a_closed_slab():
    particles = lattice(20, 1, 10)
    particles[:, 1] = 0.0
    mesh = extract_surface(particles, SPACING, dimension=2)
    assert_closed_and_oriented(mesh)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert low == pytest.approx([0.0, -0.005, 0.0], abs=0.001)
    assert high == pytest.approx([0.2, 0.005, 0.1], abs=0.001)
    assert enclosed_volume(mesh) == pytest.approx(200 * SPACING**3, rel=0.15)
    far = np.concatenate([particles, particles + np.float32([900.0, 0.0, 0.0])])
    assert component_count(extract_surface(far, SPACING, dimension=2)) == 2


BOX_WALLS = np.array(
    [[-1, 0, 0, 0], [1, 0, 0, 0.16], [0, -1, 0, 0], [0, 1, 0, 0.16], [0, 0, -1, 0]], float
)


def test_liquid_lies_flat_on_known_walls():
    """With the walls known the block has sharp edges, so its volume is right to a fraction."""
    rng = np.random.default_rng(0)
    particles = lattice(16, 16, 10)
    particles += rng.normal(0.0, 0.05 * SPACING, particles.shape).astype(np.float32)
    mesh = extract_surface(particles, SPACING, walls=BOX_WALLS)
    assert_closed_and_oriented(mesh)
    assert mesh.vertices[:, :2].min() >= -1e-6 and mesh.vertices[:, :2].max() <= 0.16 + 1e-6
    assert mesh.vertices[:, 2].min() >= -1e-6
    assert enclosed_volume(mesh) == pytest.approx(len(particles) * SPACING**3, rel=0.01)
    top = mesh.vertices[mesh.vertices[:, 2] > 0.08]
    corner = np.abs(top[:, :2]).max(axis=1) < 1e-6
    assert top[corner, 2].max() == pytest.approx(0.1, abs=0.002)  # the top is flat into corners


def test_known_walls_leave_distant_liquid_alone():
    drop = ball_of_particles(0.03, (0.08, 0.08, 0.1))
    free, known = (extract_surface(drop, SPACING, walls=w) for w in (None, BOX_WALLS))
    assert free.vertices.tobytes() == known.vertices.tobytes()
    near_wall = np.float32([[0.02, 0.08, 0.1]])  # its image stays behind the wall and is dropped
    assert component_count(extract_surface(near_wall, SPACING, walls=BOX_WALLS)) == 1


@pytest.mark.nojit
def test_no_particles_no_mesh():
    mesh = extract_surface(np.zeros((0, 3), np.float32), SPACING)
    assert [part.shape for part in mesh] == [(0, 3)] * 3
    assert [part.dtype for part in mesh] == [np.float32, np.int32, np.float32]


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e12])
def test_unusable_positions_are_refused(bad):
    particles = lattice(2, 2, 2)
    particles[3, 1] = bad
    with pytest.raises(ValueError, match="row 3"):
        extract_surface(particles, SPACING)


def test_unusable_lengths_and_shapes_are_refused():
    for arguments in ({"spacing": 0.0}, {"spacing": 0.01, "cell_size": -1.0}):
        with pytest.raises(ValueError, match="positive length"):
            extract_surface(lattice(2, 2, 2), **arguments)
    with pytest.raises(ValueError, match="shape"):
        extract_surface(np.zeros((4, 2), np.float32), SPACING)
    with pytest.raises(ValueError, match="dimension"):
        extract_surface(lattice(2, 2, 2), SPACING, dimension=1)
