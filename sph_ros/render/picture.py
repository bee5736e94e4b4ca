# SPDX-License-Identifier: Apache-2.0
"""Pictures of the liquid and the solids, drawn on the CPU without a display."""

import os
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from sph_ros.colors import LIQUID, SOLIDS, linear, speed_colors
from sph_ros.render.camera import Camera
from sph_ros.render.light_map import floor_light
from sph_ros.render.raster import (
    BANDS,
    NEAR,
    draw_lines,
    draw_liquid,
    draw_solids,
    draw_spheres,
    projected_corners,
    view_rays,
)
from sph_ros.render.walls import surface_at_walls
from sph_ros.render.water import compose
from sph_ros.sim.quaternions import normalized, to_matrix

#: Edges between faces that differ by more than this angle are outlines and keep flat shading [deg].
CREASE_ANGLE = 35.0


@dataclass(frozen=True)
class SolidView:
    """A solid as it is drawn.

    Attributes:
        name: of the solid.
        vertices: [m], solid's frame, (V, 3).
        triangles: indices, counter-clockwise from outside, (T, 3).
        position: of the solid's frame in the world [m], (3,).
        quat_xyzw: rotation from the solid's frame to the world.
        container: drawn as outlines only; the liquid is inside.
        color: sRGB 0 to 1, or None for one of ours.
        wireframe: drawn as outlines although it is no container.
    """

    name: str
    vertices: np.ndarray
    triangles: np.ndarray
    position: tuple = (0.0, 0.0, 0.0)
    quat_xyzw: tuple = (0.0, 0.0, 0.0, 1.0)
    container: bool = False
    color: tuple | None = None
    wireframe: bool = False

    def world_vertices(self) -> np.ndarray:
        """Vertices in the world [m], (V, 3) float64."""
        rotation = to_matrix(normalized(self.quat_xyzw))
        return np.asarray(self.vertices, np.float64) @ rotation.T + np.asarray(self.position)


@dataclass(frozen=True)
class Frame:
    """What is in a picture.

    Attributes:
        positions: particles [m], world frame, (N, 3).
        velocities: [m/s], (N, 3), or None; colours particles by speed.
        surface: (vertices (V, 3), triangles (T, 3), normals (V, 3)) of the liquid, or None to draw
            the particles as spheres. At the walls of a container it is remade from the particles.
        solids: what else there is.
        spacing: of the particles [m].
        floor_z: height of the floor [m]; None: under everything.
        top_speed: speed of the brightest colour [m/s]; None: the fastest particle.
        dimension: 3, or 2 for a liquid in the x-z plane, which is then tinted as if it were deep.
        colours: sRGB 0 to 1 of every particle (N, 3), which makes the liquid opaque; None: clear.
    """

    positions: np.ndarray
    velocities: np.ndarray | None = None
    surface: tuple | None = None
    solids: list[SolidView] = field(default_factory=list)
    spacing: float = 0.01
    floor_z: float | None = None
    top_speed: float | None = None
    dimension: int = 3
    colours: np.ndarray | None = None

    def bounds(self):
        """Lower and upper corner of containers, liquid and finite-sized solids [m], (3,) each."""
        points = [solid.world_vertices() for solid in self.solids if solid.container]
        if len(self.positions):
            inner = np.percentile(self.positions, [0.5, 99.5], axis=0)
            points.append(inner + [[-self.spacing] * 3, [self.spacing] * 3])
        if not points:
            points = [solid.world_vertices() for solid in self.solids] or [np.zeros((1, 3))]
        points = np.concatenate(points)
        return points.min(axis=0), points.max(axis=0)


def render(frame: Frame, camera: Camera, size=(1280, 720), supersample=2) -> np.ndarray:
    """Picture of a frame, (height, width, 3) uint8 RGB.

    Args:
        frame: what is there.
        camera: from where it is seen.
        size: (width, height) in pixels.
        supersample: samples along a pixel's edge; 1 is quick, 2 smooth.

    Raises:
        ValueError: size or supersample not positive.
    """
    width, height = size
    if width < 1 or height < 1 or supersample < 1:
        raise ValueError(f"picture: size {size}, supersample {supersample}, expected 1 or more")
    fine = (width * supersample, height * supersample)
    surface = surface_at_walls(frame)
    clear = frame.colours is None
    solids = _draw_opaque(frame, camera, fine, None if clear else surface)
    liquid = _draw_liquid(surface if clear else None, camera, fine, solids[0])
    lines = _draw_outlines(frame, camera, fine, solids[0], supersample)
    lower, upper = frame.bounds()
    scene_size = max(float(np.linalg.norm(upper - lower)), frame.spacing)
    lights = _lights(frame, surface, lower, upper, scene_size, 1.0 / camera.intrinsics(size)[0])
    picture = np.empty((height, width, 3), np.uint8)
    compose(
        solids,
        liquid,
        lines,
        view_rays(camera, fine),
        np.array(camera.intrinsics(fine)),
        lights,
        np.array([scene_size, frame.spacing, 0.5 * scene_size * (frame.dimension == 2)]),
        supersample,
        picture,
    )
    return picture


def save_png(path, picture) -> None:
    """Write an RGB picture (h, w, 3) uint8; the file appears whole or not at all.

    Raises:
        OSError: the folder does not exist or cannot be written.
    """
    path = Path(path)
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(picture[:, :, ::-1]))
    if not done:
        raise OSError(f"{path}: picture of shape {picture.shape} cannot be encoded as PNG")
    # Not through tempfile, whose files nobody else may read.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.png")
    try:
        temporary.write_bytes(encoded.tobytes())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _particle_colours(frame):
    """Linear RGB per particle: its own, its speed's, or water's where both are unknown, (N, 3)."""
    if frame.colours is not None:
        return linear(frame.colours).astype(np.float32)
    if frame.velocities is None:
        return np.tile(np.float32(linear(LIQUID[:3])), (len(frame.positions), 1))
    speed = np.linalg.norm(frame.velocities, axis=1)
    top = max(float(speed.max()) if frame.top_speed is None else frame.top_speed, 1e-6)
    return linear(speed_colors(speed / top)).astype(np.float32)


def _draw_opaque_liquid(frame, camera, size, surface, depth, picture):
    """Draw a surface whose triangles have the colour of the nearest particle."""
    vertices, triangles, normals = surface
    points = np.asarray(vertices, np.float64)[triangles]
    # Clipping would part triangles from their colours.
    ahead = (camera.to_camera(points.reshape(-1, 3))[:, 2] > 2.0 * NEAR).reshape(-1, 3).all(axis=1)
    points, triangles = points[ahead], triangles[ahead]
    _, nearest = cKDTree(frame.positions).query(points.mean(axis=1))
    colours = _particle_colours(frame)[nearest]
    corners, normals = projected_corners(points, normals[triangles], camera, size)
    draw_solids(corners, normals, colours, view_rays(camera, size), depth, picture)


def _draw_opaque(frame, camera, size, surface):
    """Depth (H, W) and linear RGB (H, W, 3) of what one cannot see through.

    That is the solids, the particles if there is no surface, and the `surface` of an opaque liquid.
    """
    depth = np.full(size[::-1], np.inf, np.float32)
    picture = np.zeros((*size[::-1], 3), np.float32)
    view = view_rays(camera, size)
    shown = [solid for solid in frame.solids if not (solid.container or solid.wireframe)]
    for number, solid in enumerate(shown):
        points = solid.world_vertices()[solid.triangles]
        corners, normals = projected_corners(points, corner_normals(points), camera, size)
        colour = SOLIDS[number % len(SOLIDS)] if solid.color is None else solid.color[:3]
        colours = np.tile(np.float32(linear(colour)), (len(corners), 1))
        draw_solids(corners, normals, colours, view, depth, picture)
    if frame.surface is None and len(frame.positions):
        image, z = camera.project(frame.positions, size)
        centres = np.concatenate([image, z[:, None]], axis=1).astype(np.float32)
        focal, radius = camera.intrinsics(size)[0], 0.5 * frame.spacing
        draw_spheres(centres, radius, _particle_colours(frame), view, focal, depth, picture)
    if surface is not None and len(surface[1]):
        _draw_opaque_liquid(frame, camera, size, surface, depth, picture)
    return depth, picture


def corner_normals(points):
    """Unit normals at triangles' corners: mean over the faces around, flat across creases.

    Args:
        points: corners [m], (T, 3, 3).
    """
    faces = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    flat = faces / np.maximum(np.linalg.norm(faces, axis=1), 1e-30)[:, None]
    scale = 1e6 / max(np.abs(points).max(initial=0.0), 1e-9)
    keys = np.round(points.reshape(-1, 3) * scale).astype(np.int64)
    _, vertex = np.unique(keys, axis=0, return_inverse=True)
    vertex = vertex.reshape(-1)
    total = np.zeros((vertex.max(initial=-1) + 1, 3))
    np.add.at(total, vertex, np.repeat(faces, 3, axis=0))
    total /= np.maximum(np.linalg.norm(total, axis=1), 1e-30)[:, None]
    smooth, face = total[vertex].reshape(-1, 3, 3), np.repeat(flat[:, None], 3, axis=1)
    crease = (smooth * face).sum(axis=2) < np.cos(np.radians(CREASE_ANGLE))
    return np.where(crease[..., None], face, smooth).astype(np.float32)


def _draw_liquid(surface, camera, size, solid_depth):
    """Front and back (H, W, 4) and thickness (H, W) of the liquid's surface."""
    front = np.zeros((*size[::-1], 4), np.float32)
    front[..., 0] = np.inf
    back, thickness = np.zeros_like(front), np.zeros_like(solid_depth)
    if surface is not None and len(surface[1]):
        vertices, triangles, normals = surface
        corners, normals = projected_corners(
            np.asarray(vertices, np.float64)[triangles], normals[triangles], camera, size
        )
        draw_liquid(corners, normals, solid_depth, BANDS, front, back, thickness)
    return front, back, thickness


def _draw_outlines(frame, camera, size, solid_depth, supersample):
    """Cover of outlines that the camera sees through the solid, and of those on its near side."""
    covers = np.zeros((2, *size[::-1]), np.uint8)
    for solid in frame.solids:
        if not (solid.container or solid.wireframe):
            continue
        ends, near = Edges(solid.world_vertices(), solid.triangles).seen_from(camera.eye)
        for number, cover in enumerate(covers):
            chosen = ends[near == bool(number)]
            if len(chosen):
                clipped = np.concatenate([chosen, chosen[:, 1:]], axis=1)
                corners, _ = projected_corners(clipped, np.zeros_like(clipped), camera, size)
                line = np.ascontiguousarray(corners[:, :2])
                draw_lines(line, 0.75 * supersample, solid_depth, 2.0 * frame.spacing, cover)
    return covers[0], covers[1]


class Edges:
    """Edges of a mesh; found once, and then seen from anywhere.

    Args:
        vertices: (V, 3) [m]; those in one place count as one.
        triangles: indices, (T, 3).
    """

    def __init__(self, vertices, triangles):
        points = np.asarray(vertices, np.float64)
        triangles = np.asarray(triangles, np.int64)
        _, first, same = np.unique(points.round(9), axis=0, return_index=True, return_inverse=True)
        triangles = first[same.reshape(-1)][triangles]
        corners = points[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-30)[:, None]
        edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        owner = np.repeat(np.arange(len(triangles)), 3)
        order = np.lexsort(edges.T)
        edges, owner = edges[order], owner[order]
        pair = np.flatnonzero((edges[1:] == edges[:-1]).all(axis=1))
        self._one, self._other = owner[pair], owner[pair + 1]
        cosine = np.einsum("ij,ij->i", normals[self._one], normals[self._other])
        self._crease = cosine < np.cos(np.radians(CREASE_ANGLE))
        self._ends, self._normals, self._corner = points[edges[pair]], normals, corners[:, 0]
        single = np.ones(len(edges), bool)
        single[pair] = single[pair + 1] = False
        self._open_ends, self._open_owner = points[edges[single]], owner[single]

    def seen_from(self, eye):
        """Ends of creases, silhouettes, open edges (L, 2, 3) [m]; which are on the eye's side."""
        seen = np.einsum("ij,ij->i", self._normals, eye - self._corner) > 0.0
        one, other = seen[self._one], seen[self._other]
        drawn = self._crease | (one != other)
        ends = np.concatenate([self._ends[drawn], self._open_ends])
        return ends, np.concatenate([(one | other)[drawn], seen[self._open_owner]])


def _lights(frame, surface, lower, upper, scene_size, pixel_angle):
    """Room and light map for `compose`."""
    floor_z = lower[2] if frame.floor_z is None else frame.floor_z
    opaque = [s for s in frame.solids if not (s.container or s.wireframe)]
    solids = [solid.world_vertices()[solid.triangles] for solid in opaque]
    solids = np.concatenate(solids) if solids else np.zeros((0, 3, 3))
    particles = frame.positions if frame.surface is None else frame.positions[:0]
    light, origin, scale = floor_light(
        surface,
        solids,
        np.ascontiguousarray(particles, np.float32),
        0.5 * frame.spacing,
        floor_z,
        lower,
        upper,
    )
    centre = 0.5 * (lower + upper)
    tile = scene_size / 6.0
    room = np.array(
        [floor_z, tile, 5.0 * scene_size, *origin, scale, centre[0], centre[1], pixel_angle]
    )
    return room, light
