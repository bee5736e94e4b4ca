# SPDX-License-Identifier: Apache-2.0
"""Shapes and their signed distances: exact primitives, programs of unions and differences, 2D."""

import numpy as np
import pytest

from sph_ros.core.distances import (
    STACK_DEPTH,
    distance_and_normal,
    outside_bounds,
    signed_distance,
    signed_distances,
)
from sph_ros.sim.quaternions import to_matrix
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
    pack_shapes,
)

SPACING = 0.01
SUPPORT = 0.02
TILT = (0.2, -0.4, 0.1, 0.9)


def packed(*shapes, dimension=3):
    return pack_shapes(shapes, SUPPORT, SPACING, dimension)


def distances_at(shape, points, dimension=3):
    points = np.ascontiguousarray(points, dtype=np.float32)
    distance = np.empty(len(points), dtype=np.float32)
    signed_distances(packed(shape, dimension=dimension), 0, points, distance)
    return distance


def naive_distance(shape, points):
    """The definition, shape by shape and recursively, in float64."""
    x, y, z = points.T
    r = np.hypot(x, y)
    if isinstance(shape, Sphere):
        return np.linalg.norm(points, axis=1) - shape.radius
    if isinstance(shape, Plane):
        return points @ np.array(shape.normal) - shape.offset
    if isinstance(shape, Box):
        middle = 0.5 * (np.array(shape.min) + shape.max)
        q = np.abs(points - middle) - 0.5 * np.array(shape.size)
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    if isinstance(shape, Capsule):
        half = shape.length / 2
        return np.hypot(r, z - np.clip(z, -half, half)) - shape.radius
    if isinstance(shape, Cylinder):
        q = np.stack([r - shape.radius, np.abs(z) - shape.length / 2], axis=1)
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    if isinstance(shape, Container):
        return -naive_distance(shape.shape, points)
    parts = [
        naive_distance(part.shape, (points - part.pose.position) @ to_matrix(part.pose.quat_xyzw))
        for part in shape.of
    ]
    if isinstance(shape, Union):
        return np.min(parts, axis=0)
    return np.max([parts[0], *(-part for part in parts[1:])], axis=0)


def random_shape(generator, depth):
    """A random shape of size about 0.1 with up to `depth` levels of unions and differences."""
    size = generator.uniform(0.02, 0.08, 3)
    kind = generator.integers(5 if depth == 0 else 8)
    if kind == 0:
        return Sphere(size[0])
    if kind == 1:
        return Box(-size, 0.5 * size)
    if kind == 2:
        return Capsule(0.5 * size[0], size[1])
    if kind == 3:
        return Cylinder(size[0], size[1])
    if kind == 4:
        return Plane(generator.normal(size=3), generator.uniform(-0.05, 0.05))
    parts = [
        Placed(
            random_shape(generator, depth - 1),
            Pose(generator.uniform(-0.05, 0.05, 3), generator.normal(size=4)),
        )
        for _ in range(generator.integers(2, 4))
    ]
    if kind == 5:
        return Container(Union(parts))
    return Union(parts) if kind == 6 else Difference(parts)


@pytest.mark.parametrize("seed", range(30))
def test_programs_equal_their_recursive_definition(seed):
    generator = np.random.default_rng(seed)
    shape = random_shape(generator, 2)
    points = generator.uniform(-0.15, 0.15, (500, 3))
    expected = naive_distance(shape, points)
    np.testing.assert_allclose(distances_at(shape, points), expected, atol=3e-7)


def surface_points(shape, generator, count=200_000):
    """Points on the surface of a primitive, from the shape's own parametrization."""
    turn = generator.uniform(0, 2 * np.pi, count)
    if isinstance(shape, Box):
        points = generator.uniform(shape.min, shape.max, (count, 3))
        axis = generator.integers(3, size=count)
        sides = np.array([shape.min, shape.max])[generator.integers(2, size=count), axis]
        points[np.arange(count), axis] = sides
        return points
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    if isinstance(shape, Sphere):
        return shape.radius * direction
    half = shape.length / 2
    along = generator.uniform(-half, half, count)
    circle = shape.radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    side = np.column_stack([circle, along])
    if isinstance(shape, Capsule):
        ends = shape.radius * direction
        ends[:, 2] += np.where(direction[:, 2] > 0, half, -half)
    else:
        disc = circle * np.sqrt(generator.uniform(0, 1, count))[:, None]
        ends = np.column_stack([disc, np.where(along > 0, half, -half)])
    return np.where(generator.uniform(size=count)[:, None] < 0.5, side, ends)


@pytest.mark.parametrize(
    "shape",
    [
        Sphere(0.04),
        Box((-0.05, -0.02, 0.0), (0.03, 0.02, 0.06)),
        Capsule(0.02, 0.06),
        Cylinder(0.03, 0.05),
    ],
    ids=lambda shape: type(shape).__name__,
)
def test_distance_of_a_primitive_is_that_to_its_nearest_surface_point(shape):
    from scipy.spatial import cKDTree

    generator = np.random.default_rng(1)
    points = generator.uniform(-0.08, 0.08, (300, 3))
    nearest, _ = cKDTree(surface_points(shape, generator)).query(points)
    distance = distances_at(shape, points)
    # No sample is nearer than the surface; gaps between random samples are below 1.5 mm.
    assert np.all(nearest - np.abs(distance) > -1e-6)
    assert np.all(nearest - np.abs(distance) < 0.0015)


SOLIDS = {
    "sphere": Sphere(0.03),
    "box": Box((-0.03, -0.01, 0.0), (0.03, 0.04, 0.05)),
    "capsule": Capsule(0.02, 0.05),
    "cylinder": Cylinder(0.03, 0.06),
    "plane": Plane((1, 2, -2), 0.01),
    "container": Container(Box(size=(0.1, 0.08, 0.06))),
    "union": Union([Sphere(0.03), Placed(Box(size=(0.02, 0.05, 0.1)), Pose((0.02, 0, 0), TILT))]),
    "cup": Difference([Cylinder(0.04, 0.08), Placed(Cylinder(0.03, 0.08), Pose((0, 0, 0.01)))]),
}


@pytest.mark.nojit
@pytest.mark.parametrize("name", SOLIDS)
def test_normals_are_unit_gradients(name):
    shapes = packed(SOLIDS[name])
    generator = np.random.default_rng(3)
    step, good = 1e-4, 0
    for point in generator.uniform(-0.07, 0.07, (40, 3)):
        distance, *normal = distance_and_normal(shapes, 0, *point)
        assert distance == signed_distance(shapes, 0, *point)
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-6)
        slopes = [
            (
                signed_distance(shapes, 0, *(point + offset))
                - signed_distance(shapes, 0, *(point - offset))
            )
            / (2 * step)
            for offset in step * np.eye(3)
        ]
        good += np.allclose(slopes, normal, atol=0.01)
    assert good >= 38  # a kink of the distance may fall between the two samples


def test_ball_around_the_material_is_a_lower_bound():
    generator = np.random.default_rng(4)
    shapes = [random_shape(generator, 2) for _ in range(40)]
    arrays = packed(*shapes)
    assert np.any(arrays.bounds[:, 3] < 1.0)  # else nothing is tested
    for solid in range(len(shapes)):
        for point in generator.uniform(-0.4, 0.4, (50, 3)).astype(np.float32):
            bound = outside_bounds(arrays, solid, *point)
            assert bound <= max(signed_distance(arrays, solid, *point), 0.0) + 1e-6


def test_container_is_its_shape_inside_out():
    points = np.random.default_rng(5).uniform(-0.1, 0.1, (200, 3))
    for name in ("box", "capsule", "cylinder", "cup", "union"):
        inside_out = distances_at(Container(SOLIDS[name]), points)
        np.testing.assert_array_equal(inside_out, -distances_at(SOLIDS[name], points))


def test_two_dimensions_ignore_y():
    generator = np.random.default_rng(6)
    points = generator.uniform(-0.1, 0.1, (300, 3))
    flat = points * (1, 0, 1)
    quarter = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # z axis onto -y
    about_y = (0.0, 0.3, 0.0, 0.95)
    r = np.hypot(points[:, 0], points[:, 2])

    def distance(shape, pose):
        return distances_at(Union([Placed(shape, pose)]), points, dimension=2)

    np.testing.assert_allclose(distance(Sphere(0.03), Pose((0, 5, 0))), r - 0.03, atol=1e-7)
    np.testing.assert_allclose(
        distance(Cylinder(0.03, 0.1), Pose((0, 5, 0), quarter)), r - 0.03, atol=1e-7
    )
    box = Box(size=(0.04, 0.02, 0.06))
    endless = Box(size=(0.04, 50.0, 0.06))
    turned = flat @ to_matrix(Pose(quat_xyzw=about_y).quat_xyzw)
    expected = naive_distance(endless, turned)
    np.testing.assert_allclose(distance(box, Pose((0, 1, 0), about_y)), expected, atol=1e-7)
    np.testing.assert_allclose(
        distance(Cylinder(0.02, 0.06), Pose((0, 0, 0), about_y)), expected, atol=1e-7
    )
    np.testing.assert_allclose(
        distance(Capsule(0.02, 0.06), Pose()), naive_distance(Capsule(0.02, 0.06), flat), atol=1e-7
    )
    slope = distances_at(Plane((3, 7, 4), 0.05), points, dimension=2)
    expected = points @ (0.6, 0.0, 0.8) - 0.05 * np.sqrt(74) / 5
    np.testing.assert_allclose(slope, expected, atol=1e-7)
    shapes = packed(Container(box), dimension=2)
    for point in points[:50]:
        _, nx, ny, nz = distance_and_normal(shapes, 0, *point)
        assert ny == 0.0 and np.hypot(nx, nz) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("shape", "text"),
    [
        (Plane((0, 1, 0)), "plane: in 2D"),
        (Union([Placed(Cylinder(1, 1), Pose(quat_xyzw=TILT))]), "cylinder: in 2D"),
        (Union([Placed(Capsule(1, 1), Pose(quat_xyzw=TILT))]), "capsule: in 2D"),
        (Union([Placed(Box(size=(1, 1, 1)), Pose(quat_xyzw=TILT))]), "box: in 2D"),
    ],
)
def test_shapes_without_meaning_in_two_dimensions_are_refused(shape, text):
    with pytest.raises(ValueError, match=text):
        packed(shape, dimension=2)


def nested(depth):
    """A full binary tree of differences: the stack holds one operand per level."""
    if depth == 0:
        return Sphere(0.01)
    return Difference([nested(depth - 1), nested(depth - 1)])


def test_nesting_beyond_the_stack_is_refused_and_long_lists_are_not():
    packed(nested(STACK_DEPTH - 1))
    with pytest.raises(ValueError, match="nested too deep"):
        packed(nested(STACK_DEPTH))
    row = Union([Placed(Sphere(0.01), Pose((0.05 * i, 0, 0))) for i in range(50)])
    assert distances_at(row, [[2.45, 0, 0.03]])[0] == pytest.approx(0.02, abs=1e-6)


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (lambda: Sphere(0), "radius: .*greater than 0"),
        (lambda: Sphere(float("nan")), "radius: .*finite"),
        (lambda: Sphere("0.1"), "radius: expected a number"),
        (lambda: Capsule(0.1, -1), "length: .*at least 0"),
        (lambda: Box((0, 0, 0), (1, 0, 1)), "min < max along y"),
        (lambda: Box((0, 0, 0)), "either min and max or size"),
        (lambda: Box(size=(1, 1)), "size: expected 3 numbers"),
        (lambda: Plane((0, 0, 0)), "normal: .*greater than 0"),
        (lambda: Pose(quat_xyzw=(0, 0, 0, 0)), "quat_xyzw"),
        (lambda: Pose(position=(0, float("inf"), 0)), r"position\[1\]"),
        (lambda: Mesh("a.obj", scale=0), "scale"),
        (lambda: Union([]), "union: expected at least 1"),
        (lambda: Difference([Sphere(1)]), "difference: expected at least 2"),
        (lambda: Container("box"), "container: expected a shape"),
    ],
)
def test_bad_shapes_name_the_field(build, text):
    with pytest.raises(ValueError, match=text):
        build()
