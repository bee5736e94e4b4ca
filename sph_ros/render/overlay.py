# SPDX-License-Identifier: Apache-2.0
"""A liquid and solids drawn into a camera's picture; on one thread, without a display.

The surface is meshed with the container's walls known, so that it lies flat on the glass, and drawn
into z-buffers through the camera's own lens; `overlay_water` then turns them into light. Pixels
where nothing is drawn keep the camera's values.
"""

from dataclasses import dataclass, field

import numpy as np

from sph_ros.colors import SOLIDS, linear
from sph_ros.core.surface import extract_surface
from sph_ros.render.camera import Camera
from sph_ros.render.lens import Lens
from sph_ros.render.light_map import floor_light
from sph_ros.render.overlay_layers import (
    PAPER,
    Layers,
    draw_foam,
    draw_smooth_lines,
    draw_solids_deferred,
    image_corners,
    image_lines,
    image_triangles,
    subdivided,
)
from sph_ros.render.overlay_water import draw_water, soften_edges
from sph_ros.render.picture import Edges, SolidView, corner_normals
from sph_ros.render.raster import draw_liquid
from sph_ros.render.walls import MOST_PLANES, convex_planes
from sph_ros.sim.quaternions import normalized, to_matrix
from sph_ros.tracking.camera import CameraModel
from sph_ros.tracking.se3 import Pose

#: Texels along the longer side of the map of shadows and caustics.
LIGHT_TEXELS = 120

#: Half the width of outlines [pixels].
LINE = 0.7

#: Brightness of white paper in light, in a well exposed picture.
WHITE = 0.75

#: Speeds at which water begins to be white and is all white [m/s].
FOAM_BEGINS, FOAM_FULL = 0.35, 1.1

_SQUARE = np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0]], [[-1, -1, 0], [1, 1, 0], [-1, 1, 0]]])


@dataclass(frozen=True)
class Liquid:
    """What is put into a picture; world frame.

    Attributes:
        positions: of particles [m], (N, 3) float32.
        velocities: [m/s], (N, 3), or None for no foam.
        spacing: of the particles [m].
        dimension: 3, or 2 for a liquid in the x-z plane.
        solids: SolidView of every solid.
        cards: (position, quat_xyzw, side [m]) of square cards of paper, in their planes z = 0, that
            hide what is behind them, as the camera sees them anyway.
        desk_z: height of the plane on which everything stands [m].
    """

    positions: np.ndarray
    velocities: np.ndarray | None = None
    spacing: float = 0.01
    dimension: int = 3
    solids: list = field(default_factory=list)
    cards: list = field(default_factory=list)
    desk_z: float = 0.0


class Overlay:
    """Draws liquids into the pictures of one camera.

    Args:
        camera: CameraModel with its size.
    """

    def __init__(self, camera):
        self._lens = Lens(camera)
        self._rays = self._lens.rays()
        self._layers = Layers(*self._lens.size)
        self._shapes = {}
        self._exposure = None

    def draw(self, picture, camera_from_world, liquid):
        """The picture with the liquid in it, (H, W, 3) uint8 BGR.

        Args:
            picture: (H, W, 3) uint8 BGR.
            camera_from_world: Pose.
            liquid: Liquid.

        Raises:
            ValueError: the picture has another size.
        """
        width, height = self._lens.size
        if picture.shape != (height, width, 3):
            raise ValueError(f"picture: {picture.shape}, expected {(height, width, 3)}")
        # Arrays that cannot be written are of another type, for which all would be compiled again.
        picture = np.require(picture, requirements=["C", "W"])
        layers = self._layers
        layers.clear()
        solids = [solid for solid in liquid.solids if not _is_plane(solid)]
        colours = self._draw_solids(solids, liquid.cards, camera_from_world)
        surface = _surface(liquid, solids)
        self._draw_liquid(surface, camera_from_world)
        self._draw_lines(solids, camera_from_world, liquid.spacing)
        self._draw_foam(liquid, camera_from_world)
        room, light = self._room(picture, liquid, surface, solids)
        layers.include(self._lit_desk(room, light, camera_from_world))
        result = picture.copy()
        region = layers.region()
        opaque = layers.depth, layers.normal, layers.index, colours
        water = layers.front, layers.back, layers.thickness
        eye = camera_from_world.inverse().position
        view = tuple(tuple(map(float, row)) for row in (eye, *camera_from_world.rotation))
        draw_water(
            picture, region, opaque, water, layers.foam, layers.covers, self._rays, view,
            self._lens.packed, room, light, result,
        )  # fmt: skip
        rim = 255.0 * min(np.sqrt(room[1]), 1.0)
        soften_edges(region, opaque, water, rim, result.copy(), result)
        return result

    # ---------------------------------------------------------------- layers

    def _draw_solids(self, solids, cards, camera_from_world):
        """Draw opaque things; returns their colours (n, 3)."""
        colours = np.zeros((len(solids) + 1, 3), np.float32)
        for number, solid in enumerate(solids[:PAPER]):
            rgb = SOLIDS[number % len(SOLIDS)] if solid.color is None else solid.color[:3]
            colours[number] = linear(rgb)
            if not (solid.container or solid.wireframe):
                corners, normals, _ = self._shape(solid)
                place = _pose(solid.position, solid.quat_xyzw)
                corners, normals = place.apply(corners), normals @ place.rotation.T
                self._draw_opaque(corners, normals, number, camera_from_world)
        for position, quat_xyzw, side in cards:
            corners = _pose(position, quat_xyzw).apply(0.5 * side * _SQUARE)
            self._draw_opaque(*subdivided(corners, 0.0 * corners), PAPER, camera_from_world)
        return colours

    def _draw_opaque(self, corners, normals, number, camera_from_world):
        layers = self._layers
        image, ahead = image_corners(camera_from_world.apply(corners), self._lens)
        normals = np.ascontiguousarray(normals[ahead], np.float32)
        owner = np.full(len(image), number, np.uint8)
        layers.include(image[..., :2])
        draw_solids_deferred(image, normals, owner, layers.depth, layers.normal, layers.index)

    def _shape(self, solid):
        """Corners, their normals, large triangles cut, and edges, in the solid's frame; made once.

        Returns:
            (corners (T, 3, 3), normals (T, 3, 3), Edges).
        """
        known = self._shapes.get(solid.name)
        if known is None or not np.array_equal(known[0], solid.vertices):
            points = np.asarray(solid.vertices, np.float64)[solid.triangles]
            edges = Edges(solid.vertices, solid.triangles)
            known = solid.vertices, (*subdivided(points, corner_normals(points)), edges)
            self._shapes[solid.name] = known
        return known[1]

    def _draw_liquid(self, surface, camera_from_world):
        if not len(surface.triangles):
            return
        layers = self._layers
        local = camera_from_world.apply(surface.vertices)
        image, whole = image_triangles(local, surface.triangles, self._lens)
        normals = surface.normals[surface.triangles[whole]]
        layers.include(image[..., :2])
        draw_liquid(image, normals, layers.depth, 1, layers.front, layers.back, layers.thickness)

    def _draw_lines(self, solids, camera_from_world, spacing):
        layers = self._layers
        for solid in solids:
            if solid.container or solid.wireframe:
                camera_from_solid = camera_from_world @ _pose(solid.position, solid.quat_xyzw)
                ends, _ = self._shape(solid)[2].seen_from(camera_from_solid.inverse().position)
                lines = image_lines(camera_from_solid.apply(ends), self._lens)
                layers.include(lines[..., :2])
                draw_smooth_lines(lines, LINE, layers.depth, layers.front, spacing, layers.covers)

    def _draw_foam(self, liquid, camera_from_world):
        if liquid.velocities is None:
            return
        speed = np.linalg.norm(liquid.velocities, axis=1)
        fast = np.flatnonzero(speed > FOAM_BEGINS)
        white = np.minimum((speed[fast] - FOAM_BEGINS) / (FOAM_FULL - FOAM_BEGINS), 1.0)
        local = camera_from_world.apply(liquid.positions[fast].astype(np.float64))
        ahead = local[:, 2] > 0.05
        dots = np.empty((int(ahead.sum()), 4), np.float32)
        dots[:, :2] = self._lens.project(local[ahead]) + 0.5
        dots[:, 2], dots[:, 3] = local[ahead, 2], white[ahead]
        layers = self._layers
        draw_foam(dots, liquid.spacing, self._lens.focal, layers.front, layers.foam)

    # ---------------------------------------------------------------- light

    def _room(self, picture, liquid, surface, solids):
        """Numbers and light map for `draw_water`."""
        points = [surface.vertices, *(solid.world_vertices() for solid in solids)]
        points = np.concatenate([part for part in points if len(part)] or [np.zeros((1, 3))])
        lower, upper = points.min(axis=0), points.max(axis=0)
        lower[2] = min(lower[2], liquid.desk_z)
        opaque = [solid for solid in solids if not (solid.container or solid.wireframe)]
        opaque = [solid.world_vertices()[solid.triangles] for solid in opaque]
        light, origin, scale = floor_light(
            surface if len(surface.triangles) else None,
            np.concatenate(opaque) if opaque else np.zeros((0, 3, 3)),
            np.zeros((0, 3), np.float32),
            0.0,
            liquid.desk_z,
            lower,
            upper,
            LIGHT_TEXELS,
        )
        size = max(float(np.linalg.norm(upper - lower)), liquid.spacing)
        exposure = self._exposed(picture)
        return (
            liquid.desk_z,
            exposure,
            *map(float, origin),
            float(scale),
            size,
            liquid.spacing,
        ), light

    def _exposed(self, picture):
        """How bright the pictures are: 1 when white paper is WHITE; follows slowly."""
        bright = np.percentile(picture[::16, ::16, 1], 95) / 255.0
        exposure = float(min(max(bright * bright / WHITE, 0.1), 1.4))
        if self._exposure is None:
            self._exposure = exposure
        self._exposure += 0.1 * (exposure - self._exposure)
        return self._exposure

    def _lit_desk(self, room, light, camera_from_world):
        """Image points around the part of the desk whose light changes, (n, 2)."""
        rows, columns = np.nonzero(np.abs(light - 1.0) > 1e-3)
        if not len(rows):
            return np.zeros((0, 2))
        x = room[2] + np.array([rows.min() - 1, rows.max() + 2]) / room[4]
        y = room[3] + np.array([columns.min() - 1, columns.max() + 2]) / room[4]
        corners = np.array([(a, b, room[0]) for a in x for b in y])
        local = camera_from_world.apply(corners)
        if local[:, 2].min() < 0.05:  # it reaches behind the camera
            return np.array([[0, 0], self._lens.size], float)
        return self._lens.project(local) + 0.5


def _pose(position, quat_xyzw):
    """world_from_solid."""
    return Pose(to_matrix(normalized(quat_xyzw)), np.asarray(position, float))


def _is_plane(solid):
    """Whether a solid is an endless plane, drawn as one square: that is the desk, or a wall."""
    return len(solid.triangles) == 2


def _surface(liquid, solids):
    """The liquid's mesh, flat along the walls of box-like containers."""
    walls = [plane for solid in solids if solid.container for plane in convex_planes(solid)]
    walls = walls if 0 < len(walls) <= MOST_PLANES else None
    return extract_surface(
        liquid.positions, liquid.spacing, dimension=liquid.dimension, walls=walls
    )


def draw_once():
    """Draw a tiny scene, so that everything is compiled."""
    camera = CameraModel(32, 24, [[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]], [0.01, 0, 0, 0, 0])
    ticks = 0.02 * np.arange(-1.5, 2.0)
    positions = np.stack(np.meshgrid(ticks, ticks, ticks), -1).reshape(-1, 3).astype(np.float32)
    velocities = np.full_like(positions, FOAM_FULL)
    # Four of a cube's corners make a tetrahedron, counter-clockwise from outside.
    corners = 0.1 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    solids = [
        SolidView("tank", corners, faces, container=True),
        SolidView("ball", 0.3 * corners, faces, position=(0.0, 0.0, 0.05)),
    ]
    liquid = Liquid(positions, velocities, 0.02, solids=solids, desk_z=-0.1)
    view = Camera.look_at((0.2, -0.2, 0.3), (0.0, 0.0, 0.0))
    turn = view.world_from_camera.T
    picture = np.zeros((24, 32, 3), np.uint8)
    Overlay(camera).draw(picture, Pose(turn, -turn @ view.eye), liquid)
