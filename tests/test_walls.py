# SPDX-License-Identifier: Apache-2.0
"""Wall shares against real lattices: what a wall adds is what the particles in its place would."""

import itertools

import numpy as np
import pytest

import sph_ros
from sph_ros.core.distances import signed_distances
from sph_ros.core.wall_tables import flat_wall, layer_weight, round_ratio
from sph_ros.core.walls import wall_terms_at
from sph_ros.core.weights import lattice_sum
from sph_ros.sim.shapes import (
    Box,
    Capsule,
    Container,
    Cylinder,
    Difference,
    Placed,
    Plane,
    Pose,
    Sphere,
    Union,
    pack_shapes,
)

S = 0.01
H = 0.02
D, N, F, FG, G, GG = 0, slice(1, 4), 4, slice(5, 8), 8, slice(9, 12)


def terms_at(shape, points, dimension=3, support=H):
    points = np.ascontiguousarray(np.atleast_2d(points), dtype=np.float32)
    terms = np.empty((len(points), 12), dtype=np.float32)
    wall_terms_at(pack_shapes([shape], support, S, dimension), 0, points, terms)
    return terms


def lattice(dimension, reach=4):
    axes = [np.arange(-reach, reach + 1)] * dimension
    if dimension == 2:
        axes.insert(1, np.zeros(1))
    return S * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def own_share(present, dimension, power=2):
    """Share of the rest density from the present ones of the lattice particles about the origin."""
    r = np.linalg.norm(lattice(dimension), axis=1)
    weights = np.where(r < H, (1 - np.minimum(r / H, 1)) ** power, 0)
    return weights[present].sum() / lattice_sum(power, H, S, dimension)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("column", [F, G])
def test_wall_completes_the_lattice_at_faces_edges_and_corners(dimension, column):
    """A particle half a spacing from one, two, three sides of a tank has the rest density."""
    power = 2 if column == F else 3
    size, near = 0.4, 0.2 - S / 2
    tank = Container(Box(size=(size, size, size)))
    grid = lattice(dimension)
    axes = [0, 2] if dimension == 2 else [0, 1, 2]
    for sides in range(1, len(axes) + 1):
        place = np.zeros(3)
        place[axes[:sides]] = near
        present = (grid[:, axes[:sides]] <= 1e-9).all(axis=1)
        total = own_share(present, dimension, power) + terms_at(tank, place, dimension)[0, column]
        assert total == pytest.approx(1.0, abs=0.006)


@pytest.mark.nojit
def test_layer_of_a_flat_wall_is_the_mean_over_lattice_positions():
    """The first layer behind a wall adds 0.6545; the lattice itself 0.665 (3D, h = 2 s)."""
    layer = layer_weight(2, np.array(S), H, S, 3)
    assert layer == pytest.approx(0.65450, abs=1e-5)
    generator = np.random.default_rng(0)
    shifts = generator.uniform(0, S, (4000, 2))
    cells = S * np.array(list(itertools.product(range(-3, 4), repeat=2)))
    for height, power, dimension in ((S / 2, 2, 3), (S, 3, 3), (S / 2, 2, 2), (1.2 * S, 3, 2)):
        places = cells if dimension == 3 else cells[cells[:, 1] == 0]
        use = (1, 1) if dimension == 3 else (1, 0)
        r = np.sqrt(((places + shifts[:, None] * use) ** 2).sum(axis=-1) + height**2)
        mean = np.maximum(1 - r / H, 0) ** power
        expected = mean.sum(axis=1).mean()
        assert layer_weight(power, np.array(height), H, S, dimension) == pytest.approx(
            expected, rel=0.02
        )


def test_flat_wall_falls_from_full_cover_to_zero():
    distance = np.linspace(-1.2 * H, 1.2 * H, 500)
    for dimension in (2, 3):
        for mirrored in (True, False):
            share = flat_wall(distance, H, S, dimension, mirrored)
            assert np.all(np.diff(share, axis=0) <= 1e-12)
            assert np.all(share[distance >= H] == 0.0)
        # A half space and its complement together are the whole space.
        np.testing.assert_allclose(share + share[::-1], share[:1].repeat(500, 0), atol=0.11)


@pytest.mark.parametrize("dimension", [2, 3])
def test_mirrored_wall_is_the_covered_one_with_twice_the_slope_at_the_first_layer(dimension):
    """There the liquid at rest has its first layer: a wall pushes like a layer of liquid."""
    around = S / 2 + np.array([-1e-5, 0.0, 1e-5])
    covered = flat_wall(around, H, S, dimension, mirrored=False)
    mirrored = flat_wall(around, H, S, dimension, mirrored=True)
    np.testing.assert_allclose(mirrored[1], covered[1], atol=1e-3)
    np.testing.assert_allclose(mirrored[2] - mirrored[0], 2 * (covered[2] - covered[0]), rtol=0.02)


def excluded_share(inside, radius, dimension, seed):
    """Liquid lattices around balls: distance of each particle and the share it lost."""
    generator = np.random.default_rng(seed)
    distances, lost = [], []
    grid = lattice(dimension)
    r = np.linalg.norm(grid, axis=1)
    weights = np.where(r < H, (1 - np.minimum(r / H, 1)) ** 2, 0)
    weights /= lattice_sum(2, H, S, dimension)
    reach = int(np.ceil((radius + H) / S)) + 1
    for _ in range(6 if dimension == 3 else 40):
        places = lattice(dimension, reach) + generator.uniform(0, S, 3) * (1, dimension == 3, 1)
        d = inside(places)
        near = (d > 0) & (d < H)
        around = places[near][:, None] + grid
        missing = inside(around.reshape(-1, 3)).reshape(near.sum(), -1) < 0
        distances.append(d[near])
        lost.append((missing * weights).sum(axis=1))
    return np.concatenate(distances), np.concatenate(lost)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("size", [1, 2, 4])
def test_balls_replace_the_lattice_particles_inside_them(size, inverted, dimension):
    """Mean over the particles of the first and of the second layer of randomly placed lattices.

    Particle by particle the lattice differs by its orientation, which a table cannot know.
    """
    radius, sign = size * H, -1 if inverted else 1
    axes = [0, 2] if dimension == 2 else [0, 1, 2]

    def inside(points):
        return sign * (np.linalg.norm(points[:, axes], axis=1) - radius)

    distance, lost = excluded_share(inside, radius, dimension, seed=size)
    flat = flat_wall(distance, H, S, dimension, mirrored=False)[:, 0]
    table = flat * round_ratio(distance, radius, H, dimension, inverted=inverted)[:, 0]
    first, second = distance < S, distance >= S
    assert first.sum() > 100
    assert table[first].mean() == pytest.approx(lost[first].mean(), abs=0.02)
    if second.sum() > 100:  # a container of one support radius has hardly a second layer
        assert table[second].mean() == pytest.approx(lost[second].mean(), abs=0.02)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("size", [1, 3])
def test_cylinders_replace_the_lattice_particles_inside_them(size, inverted):
    radius, sign = size * H, -1 if inverted else 1

    def inside(points):
        return sign * (np.linalg.norm(points[:, :2], axis=1) - radius)

    distance, lost = excluded_share(inside, radius, 3, seed=size)
    flat = flat_wall(distance, H, S, 3, mirrored=False)[:, 0]
    table = flat * round_ratio(distance, radius, H, 3, cylinder=True, inverted=inverted)[:, 0]
    first = distance < S
    assert table[first].mean() == pytest.approx(lost[first].mean(), abs=0.02)


def naive_box(points, half, inverted):
    """Both weights of a centred box by the product rule, from the flat wall's definition."""
    cover = flat_wall(-H, H, S, 3, mirrored=False)
    if inverted:
        sides = np.stack([half - points, half + points], axis=-1)
        return 1 - (1 - flat_wall(sides, H, S, 3, mirrored=True)).prod(axis=(1, 2))
    u = np.abs(points)
    slab = flat_wall(u - half, H, S, 3, False) - flat_wall(u + half, H, S, 3, False)
    facing = flat_wall(u - half, H, S, 3, True) - flat_wall(u, H, S, 3, True)
    axis = (u - half).argmax(axis=1)
    rows = np.arange(len(points))
    slab[rows, axis] = facing[rows, axis]
    return cover * (slab / cover).prod(axis=1)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("half", [(0.05, 0.04, 0.03), (0.05, 0.04, 0.004)])
def test_box_is_the_product_over_its_sides(half, inverted):
    box = Box(size=2 * np.array(half))
    points = np.random.default_rng(2).uniform(-0.07, 0.07, (2000, 3))
    terms = terms_at(Container(box) if inverted else box, points)
    expected = naive_box(points, np.array(half), inverted)
    # Particles are never deep inside, where the tables have a kink.
    near = (terms[:, D] < H) & (terms[:, D] > 0)
    np.testing.assert_allclose(terms[near, F], expected[near, 0], atol=2e-4)
    np.testing.assert_allclose(terms[near, G], expected[near, 1], atol=2e-4)
    assert np.all(expected[terms[:, D] >= H] < 1e-4)


def test_thin_plate_has_only_the_layers_that_fit_in_it():
    """A plate of one spacing is one lattice layer, not a half space."""
    point = [0, 0, S]  # half a spacing above the plate
    plate = terms_at(Box(size=(1, 1, S)), point)[0, F]
    assert plate == pytest.approx(0.6545 / lattice_sum(2, H, S, 3), abs=1e-3)
    deep = terms_at(Box((-1, -1, -1), (1, 1, S / 2)), point)[0, F]
    assert deep == pytest.approx(terms_at(Plane(), [0, 0, S / 2])[0, F], abs=1e-5)


SHAPES = {
    "sphere": Sphere(0.03),
    "grain": Sphere(0.006),
    "box": Box(size=(0.06, 0.05, 0.004)),
    "capsule": Capsule(0.02, 0.05),
    "short capsule": Capsule(0.02, 0.01),
    "cylinder": Cylinder(0.03, 0.06),
    "plane": Plane((1, 2, -2), 0.01),
    "tank": Container(Box(size=(0.1, 0.08, 0.06))),
    "drum": Container(Cylinder(0.04, 0.08)),
    "shell": Container(Sphere(0.05)),
    "pill": Container(Capsule(0.03, 0.05)),
    "union": Union(
        [
            Sphere(0.03),
            Placed(Box(size=(0.02, 0.05, 0.1)), Pose((0.02, 0, 0), (0.2, -0.4, 0.1, 0.9))),
        ]
    ),
    "cup": Difference([Cylinder(0.04, 0.08), Placed(Cylinder(0.03, 0.08), Pose((0, 0, 0.01)))]),
    "bath": Container(Union([Box(size=(0.1, 0.1, 0.1)), Placed(Sphere(0.04), Pose((0, 0, 0.06)))])),
}


# The union's box is tilted, which has no meaning in 2D.
@pytest.mark.parametrize(
    ("name", "dimension"),
    [(name, d) for name in SHAPES for d in (2, 3) if (name, d) != ("union", 2)],
)
def test_gradients_match_differences(name, dimension):
    generator = np.random.default_rng(7)
    points = generator.uniform(-0.06, 0.06, (3000, 3)).astype(np.float32)
    terms = terms_at(SHAPES[name], points, dimension)
    near = (terms[:, D] < 0.99 * H) & (terms[:, D] > -S / 2)
    assert near.sum() > 80
    assert np.all(terms[near][:, [F, G]] >= -1e-6) and np.all(terms[near][:, [F, G]] <= 1.0)
    assert np.allclose(np.linalg.norm(terms[near, N], axis=1), 1.0, atol=1e-5)
    step = np.float32(2e-4)
    for axis in range(3):
        offset = step * np.eye(3, dtype=np.float32)[axis]
        ahead, behind = points + offset, points - offset
        gap = (ahead - behind)[:, axis, None]
        slope = (
            terms_at(SHAPES[name], ahead, dimension) - terms_at(SHAPES[name], behind, dimension)
        ) / gap
        for value, gradient in ((F, 5), (G, 9)):
            error = S * np.abs(slope[near, value] - terms[near, gradient + axis])
            # Kinks (rims, thin plates, where the facing side changes) fall between few pairs.
            assert np.quantile(error, 0.95) < 0.02
        if dimension == 2 and axis == 1:
            assert np.all(terms[:, [2, 6, 10]] == 0.0)


def test_far_points_are_free_of_walls_and_keep_a_lower_bound():
    generator = np.random.default_rng(9)
    points = generator.uniform(-0.3, 0.3, (2000, 3))
    for shape in SHAPES.values():
        terms = terms_at(shape, points)
        far = terms[:, D] >= H
        assert np.all(terms[far, 1:] == 0.0)
        exact = np.empty(len(points), dtype=np.float32)
        arrays = pack_shapes([shape], H, S, 3)
        signed_distances(arrays, 0, points.astype(np.float32), exact)
        assert np.all(exact[far] >= terms[far, D] - 1e-6)
        np.testing.assert_array_equal(exact[~far], terms[~far, D])


def test_deep_points_are_fully_covered():
    cover = pack_shapes([], H, S, 3).full_cover
    for shape, place in ((Sphere(0.05), [0, 0, 0]), (Container(Sphere(0.05)), [0, 0, 0.1])):
        terms = terms_at(shape, place)[0]
        np.testing.assert_allclose(terms[[F, G]], cover, rtol=1e-5)


def test_other_support_radii():
    """The lattice is completed for supports other than twice the spacing, too."""
    for support in (1.6 * S, 2.5 * S, 3.0 * S):
        full = lattice_sum(2, support, S, 3)
        grid = lattice(3)
        r = np.linalg.norm(grid, axis=1)
        weights = np.where(r < support, (1 - np.minimum(r / support, 1)) ** 2, 0) / full
        wall = terms_at(Plane(), [0, 0, S / 2], support=support)[0, F]
        assert weights[grid[:, 2] > -1e-9].sum() + wall == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("solver", ["relaxation", "incompressible"])
def test_a_weightless_drop_stays_on_a_wall_that_holds_it_and_leaves_one_that_does_not(solver):
    """Adhesion 1 is a contact angle of 0 degrees, 0 one of 180: a ball that touches in a point."""

    def touching(adhesion):
        sim = sph_ros.Simulation(
            {
                "solver": solver,
                "spacing": 0.0025,
                "support_radius": 0.007,
                "gravity": [0, 0, 0],
                "material": {"base": "water", "viscosity": 0.01, "adhesion": adhesion},
                "liquid": [{"box": {"min": [-0.01, -0.01, 0], "max": [0.01, 0.01, 0.01]}}],
                "solids": [{"name": "wall", "plane": {}}],
            }
        )
        sim.advance(0.5)
        return (sim.positions[:, 2] < 0.0025).mean()

    assert touching(1.0) > 0.2 and touching(0.0) < 0.02
