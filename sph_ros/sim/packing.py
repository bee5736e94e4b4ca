# SPDX-License-Identifier: Apache-2.0
"""Shapes -> arrays for the compiled functions of `core.distances` and `core.walls`."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sph_ros.core import distances as core
from sph_ros.core.thin_film_tables import film_table
from sph_ros.core.wall_tables import POWERS, TABLE_STEPS, WallTables, distances
from sph_ros.core.weights import SMOOTH_POWER
from sph_ros.sim.meshes import DistanceGrid, load_distance_grid
from sph_ros.sim.quaternions import to_matrix
from sph_ros.sim.shape_types import (
    Box,
    Capsule,
    Container,
    Cylinder,
    Difference,
    Mesh,
    OpenSurface,
    Plane,
    Pose,
    Shape,
    Sphere,
    Union,
)

# Half size [m] that stands for "without end" along the y axis in 2D; no scene is larger.
_ENDLESS = 1e6
_UNBOUNDED = 1e30
# cos of the largest tilt that still counts as parallel to an axis.
_PARALLEL = 1.0 - 1e-6


@dataclass(frozen=True)
class _Frame:
    """solid_point = rotation @ point + position."""

    rotation: np.ndarray
    position: np.ndarray

    def child(self, pose: Pose) -> "_Frame":
        rotation = self.rotation @ to_matrix(pose.quat_xyzw)
        return _Frame(rotation, self.rotation @ np.array(pose.position) + self.position)

    def moved(self, offset) -> "_Frame":
        return _Frame(self.rotation, self.rotation @ np.asarray(offset, float) + self.position)


@dataclass(frozen=True)
class _Leaf:
    """A primitive or distance grid of a program.

    Attributes:
        op: SPHERE ... GRID.
        frame: of the leaf in the solid.
        size: as `PackedShapes.node_size`.
        inverted: the material is outside.
        bound: centre and radius of a sphere around the material [m]; infinite if there is none.
        file, scale: of a GRID.
    """

    op: int
    frame: _Frame
    size: tuple[float, float, float]
    inverted: bool
    bound: tuple[np.ndarray, float]
    mesh: Mesh | None = None
    depth: int = 1


@dataclass(frozen=True)
class _Join:
    """A union or intersection of two or more operands."""

    op: int
    operands: tuple
    depth: int


def _join(op: int, operands: list) -> "_Leaf | _Join":
    """Combine operands; those that need most of the stack come first (Sethi & Ullman 1970)."""
    if len(operands) == 1:
        return operands[0]
    operands = sorted(operands, key=lambda operand: -operand.depth)
    depth = max(operand.depth + (index > 0) for index, operand in enumerate(operands))
    return _Join(op, tuple(operands), depth)


def _along_axis(rotation: np.ndarray, axis: int) -> bool:
    """Whether a leaf's axis is parallel to the solid's y axis."""
    return abs(rotation[1, axis]) > _PARALLEL


class _Compiler:
    """Turns one shape into a tree of leaves and joins, inverting leaves by De Morgan's rules."""

    def __init__(self, dimension: int):
        self.dimension = dimension

    def tree(self, shape: Shape, frame: _Frame, inverted: bool = False):
        if isinstance(shape, Container):
            return self.tree(shape.shape, frame, not inverted)
        if isinstance(shape, Union | Difference):
            return self._joined(shape, frame, inverted)
        leaf = {
            Sphere: self._sphere,
            Box: self._box,
            Capsule: self._capsule,
            Cylinder: self._cylinder,
            Plane: self._plane,
            Mesh: self._mesh,
        }[type(shape)]
        return leaf(shape, frame, inverted)

    def _joined(self, shape: Union | Difference, frame: _Frame, inverted: bool):
        is_union = isinstance(shape, Union)
        operands = [
            self.tree(part.shape, frame.child(part.pose), inverted != (index > 0 and not is_union))
            for index, part in enumerate(shape.of)
        ]
        return _join(core.UNION if is_union != inverted else core.INTERSECTION, operands)

    def _leaf(self, op, frame, size, inverted, radius, mesh=None):
        bound = (frame.position, math.inf if inverted else radius)
        return _Leaf(op, frame, size, inverted, bound, mesh)

    def _sphere(self, shape: Sphere, frame, inverted):
        size = (shape.radius, 0.0, 0.0)
        return self._leaf(core.SPHERE, frame, size, inverted, shape.radius)

    def _box(self, shape: Box, frame, inverted):
        half = [0.5 * length for length in shape.size]
        frame = frame.moved([0.5 * (a + b) for a, b in zip(shape.min, shape.max, strict=True)])
        if self.dimension == 2:
            upright = [axis for axis in range(3) if _along_axis(frame.rotation, axis)]
            if not upright:
                raise ValueError("box: in 2D expected one of its axes along y, got a tilted box")
            half[upright[0]] = 0.0
            radius = math.hypot(*half)
            half[upright[0]] = _ENDLESS
        else:
            radius = math.hypot(*half)
        return self._leaf(core.BOX, frame, tuple(half), inverted, radius)

    def _capsule(self, shape: Capsule, frame, inverted):
        if shape.length == 0.0 or self._is_disc(shape, frame):
            return self._sphere(Sphere(shape.radius), frame, inverted)
        half = 0.5 * shape.length
        size = (shape.radius, half, 0.0)
        return self._leaf(core.CAPSULE, frame, size, inverted, shape.radius + half)

    def _cylinder(self, shape: Cylinder, frame, inverted):
        half = 0.5 * shape.length
        if self.dimension == 3:
            size = (shape.radius, half, 0.0)
            radius = math.hypot(shape.radius, half)
            return self._leaf(core.CYLINDER, frame, size, inverted, radius)
        if self._is_disc(shape, frame):
            return self._sphere(Sphere(shape.radius), frame, inverted)
        axis = frame.rotation[:, 2]
        y = np.array([0.0, 1.0, 0.0])
        upright = _Frame(np.stack([np.cross(y, axis), y, axis], axis=1), frame.position)
        return self._box(Box(size=(2 * shape.radius, 1.0, shape.length)), upright, inverted)

    def _is_disc(self, shape: Capsule | Cylinder, frame: _Frame) -> bool:
        """Whether the cut with the plane of a 2D scene is round; refuses oblique cuts."""
        if self.dimension == 3:
            return False
        along_y = abs(frame.rotation[1, 2])
        if along_y > _PARALLEL:
            return True
        if along_y > 1e-3:
            name = type(shape).__name__.lower()
            raise ValueError(f"{name}: in 2D expected its axis along y or in the x-z plane")
        return False

    def _plane(self, shape: Plane, frame, inverted):
        normal = frame.rotation @ np.array(shape.normal)
        offset = shape.offset + float(normal @ frame.position)
        if self.dimension == 2:
            normal[1] = 0.0
            length = float(np.linalg.norm(normal))
            if length < 1e-3:
                raise ValueError("plane: in 2D expected a normal in the x-z plane, got one along y")
            normal, offset = normal / length, offset / length
        across = np.eye(3)[int(np.argmin(np.abs(normal)))]
        x = np.cross(across, normal)
        x /= np.linalg.norm(x)
        rotation = np.stack([x, np.cross(normal, x), normal], axis=1)
        placed = _Frame(rotation, offset * normal)
        return self._leaf(core.PLANE, placed, (0.0, 0.0, 0.0), inverted, math.inf)

    def _mesh(self, shape: Mesh, frame, inverted):
        return self._leaf(core.GRID, frame, (0.0, 0.0, 0.0), inverted, math.inf, shape)


def _enclosing(a: tuple[np.ndarray, float], b: tuple[np.ndarray, float]):
    """The smallest ball around two balls, each (centre, radius)."""
    if not (math.isfinite(a[1]) and math.isfinite(b[1])):
        return a[0], math.inf
    gap = float(np.linalg.norm(b[0] - a[0]))
    if gap + b[1] <= a[1]:
        return a
    if gap + a[1] <= b[1]:
        return b
    radius = 0.5 * (gap + a[1] + b[1])
    return a[0] + (b[0] - a[0]) * ((radius - a[1]) / gap), radius


def _bound(tree, grid_bounds: dict) -> tuple[np.ndarray, float]:
    """Centre and radius [m] of a ball around the material of a tree."""
    if isinstance(tree, _Leaf):
        if tree.op == core.GRID and not tree.inverted:
            centre, radius = grid_bounds[tree.mesh]
            return tree.frame.moved(centre).position, radius
        return tree.bound
    bounds = [_bound(operand, grid_bounds) for operand in tree.operands]
    if tree.op == core.INTERSECTION:
        return min(bounds, key=lambda bound: bound[1])
    total = bounds[0]
    for bound in bounds[1:]:
        total = _enclosing(total, bound)
    return total


class _Packer:
    """Collects nodes, tables and grids of all solids."""

    def __init__(self, support_radius: float, spacing: float, dimension: int, weights: tuple):
        self.compiler = _Compiler(dimension)
        self.settings = (support_radius, spacing, dimension)
        self.tables = WallTables(support_radius, spacing, dimension, weights)
        self.nodes: list[tuple] = []
        self.grids: dict[tuple[Mesh, bool], tuple[int, DistanceGrid]] = {}

    def add(self, shape: Shape) -> tuple[np.ndarray, float]:
        """Append the program of one solid; returns the ball around it, (centre, radius)."""
        if isinstance(shape, OpenSurface):
            if self.settings[2] == 2:
                raise ValueError("surface: expected a solid shape in 2D, got an open mesh")
            return np.zeros(3), 0.0  # an empty program is infinitely far from everything
        frame = _Frame(np.eye(3), np.zeros(3))
        tree = self.compiler.tree(shape, frame)
        if tree.depth > core.STACK_DEPTH:
            raise ValueError(
                f"{type(shape).__name__.lower()}: nested too deep, needs {tree.depth} operands at "
                f"once, expected at most {core.STACK_DEPTH}; list parts side by side instead"
            )
        self._emit(tree)
        return _bound(tree, {mesh: grid.bound for (mesh, _), (_, grid) in self.grids.items()})

    def _emit(self, tree) -> None:
        if isinstance(tree, _Leaf):
            self._emit_leaf(tree)
            return
        for index, operand in enumerate(tree.operands):
            self._emit(operand)
            if index > 0:
                self.nodes.append((tree.op, 1.0, np.zeros((3, 4)), (0, 0, 0), (0, 0), -1))

    def _emit_leaf(self, leaf: _Leaf) -> None:
        inverse = leaf.frame.rotation.T
        transform = np.concatenate([inverse, -(inverse @ self._in_plane(leaf.frame))[:, None]], 1)
        if self.settings[2] == 2:
            transform[:, 1] = 0.0
        sign = -1.0 if leaf.inverted else 1.0
        grid = self._grid(leaf) if leaf.op == core.GRID else -1
        self.nodes.append((leaf.op, sign, transform, leaf.size, self._tables_of(leaf), grid))

    def _in_plane(self, frame: _Frame) -> np.ndarray:
        """Position of a leaf; 2D ignores where it is along y."""
        return frame.position * ((1.0, 0.0, 1.0) if self.settings[2] == 2 else 1.0)

    def _tables_of(self, leaf: _Leaf) -> tuple[int, int]:
        radius = leaf.size[0]
        if leaf.op == core.SPHERE:
            return self.tables.ball(radius, leaf.inverted), 0
        if leaf.op == core.CYLINDER:
            return (
                self.tables.cylinder(radius, leaf.inverted),
                self.tables.cylinder(radius, leaf.inverted, mirrored=False),
            )
        if leaf.op == core.CAPSULE:
            side = self.tables.cylinder(radius, leaf.inverted)
            return side, self.tables.ball(radius, leaf.inverted)
        return 0, 0

    def reaches(self, starts: Sequence[int]) -> list[float]:
        """How far each solid acts [m]; the nodes of solid i are from starts[i] to starts[i + 1]."""
        rows = distances(self.settings[0])
        acts = [np.flatnonzero(table.any(axis=1)).max() for table in self.tables.stacked()]
        of_table = [rows[min(last + 1, len(rows) - 1)] for last in acts]
        leaves = [
            [node for node in self.nodes[first:end] if node[0] < core.UNION]
            for first, end in itertools.pairwise(starts)
        ]
        return [max((self._reach(node, of_table) for node in own), default=0.0) for own in leaves]

    def _reach(self, node: tuple, of_table: list[float]) -> float:
        """How far a leaf acts [m], from how far each table does."""
        op, sign, _, _, tables, _ = node
        if op in (core.BOX, core.CYLINDER) and sign > 0.0:
            return self.settings[0]  # the distance to an edge says little of that to the sides
        used = {core.SPHERE: tables[:1], core.CYLINDER: tables[:1], core.CAPSULE: tables}
        return max(of_table[table] for table in (0, *used.get(op, ())))

    def _grid(self, leaf: _Leaf) -> int:
        key = (leaf.mesh, leaf.inverted)
        if key not in self.grids:
            grid = load_distance_grid(leaf.mesh, *self.settings, inverted=leaf.inverted)
            self.grids[key] = (len(self.grids), grid)
        return self.grids[key][0]


def _stacked(rows: Sequence, dtype, shape: tuple[int, ...]) -> np.ndarray:
    """Rows as one contiguous array that keeps its rank when there are none."""
    return np.ascontiguousarray(np.array(list(rows), dtype=dtype).reshape(-1, *shape))


def pack_shapes(
    shapes: Sequence[Shape],
    support_radius: float,
    spacing: float,
    dimension: int,
    weights: tuple = POWERS,
) -> core.PackedShapes:
    """Pack solids for the compiled functions; solid i is shapes[i], in its own frame.

    Args:
        shapes: any shapes; meshes are read and sampled here, or taken from the user's cache.
        support_radius: h [m].
        spacing: of the particles [m].
        dimension: 3, or 2 for a liquid in the x-z plane: extents along y then count as endless.
        weights: the two that the wall tables are made for (`core.wall_tables`).

    Raises:
        ValueError: a shape has no meaning in 2D or is nested too deep.
        MeshError: a mesh file cannot be used (a ValueError too).
    """
    if dimension not in (2, 3):
        raise ValueError(f"dimension: expected 2 or 3, got {dimension!r}")
    if not 0.0 < spacing < support_radius:
        raise ValueError(
            f"support_radius: expected more than the spacing {spacing!r}, got {support_radius!r}"
        )
    packer = _Packer(float(support_radius), float(spacing), dimension, weights)
    starts, bounds = [0], []
    for shape in shapes:
        centre, radius = packer.add(shape)
        bounds.append((*centre, min(radius, _UNBOUNDED)))
        starts.append(len(packer.nodes))
    gap, film = 0.0, np.zeros(2)
    if weights[0] == SMOOTH_POWER and len(shapes) > 1:
        gap, film = film_table(float(support_radius), float(spacing), dimension, weights)
    nodes = packer.nodes
    op, sign, transform, size, table, grid = zip(*nodes, strict=True) if nodes else [()] * 6
    return core.PackedShapes(
        support_radius=np.float32(support_radius),
        table_scale=np.float32(TABLE_STEPS / (2.0 * support_radius)),
        full_cover=_stacked(packer.tables.full_cover, np.float32, ()),
        solid_start=_stacked(starts, np.int32, ()),
        bounds=_stacked(bounds, np.float32, (4,)),
        reach=_stacked(packer.reaches(starts), np.float32, ()),
        node_op=_stacked(op, np.int32, ()),
        node_sign=_stacked(sign, np.float32, ()),
        node_transform=_stacked(transform, np.float32, (3, 4)),
        node_size=_stacked(size, np.float32, (3,)),
        node_table=_stacked(table, np.int32, (2,)),
        node_grid=_stacked(grid, np.int32, ()),
        tables=packer.tables.stacked(),
        film_gap=np.float32(gap),
        film=_stacked(film, np.float32, ()),
        **_packed_grids([grid for _, grid in packer.grids.values()], packer.tables.columns),
    )


def _packed_grids(grids: list[DistanceGrid], columns: list[int]) -> dict[str, np.ndarray]:
    """The grid fields of PackedShapes, with these columns of the ratios."""
    counts = [grid.distance.size for grid in grids]
    empty = [np.empty((0,), np.float32)]
    return {
        "grid_origin": _stacked([grid.origin for grid in grids], np.float32, (3,)),
        "grid_cell": _stacked([grid.cell for grid in grids], np.float32, ()),
        "grid_shape": _stacked([grid.distance.shape for grid in grids], np.int32, (3,)),
        "grid_start": _stacked(np.cumsum([0, *counts])[:-1], np.int64, ()),
        "grid_distance": np.concatenate([grid.distance.ravel() for grid in grids] or empty),
        # Taken columns lie in memory one after the other; kernels would be compiled again for that.
        "grid_ratio": np.ascontiguousarray(
            np.concatenate(
                [grid.ratio.reshape(-1, 2)[:, columns] for grid in grids]
                or [np.empty((0, 2), np.float32)]
            )
        ),
    }
