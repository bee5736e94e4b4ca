# SPDX-License-Identifier: Apache-2.0
"""What lies where in a camera's picture: triangles and lines through a real lens into z-buffers.

Corners are projected with the lens's distortion; between them edges are straight, which is right
for triangles of a few pixels. Large ones are cut up before (`subdivided`).
"""

import numpy as np

from sph_ros.core.jit import bare_kernel, inlined
from sph_ros.render.lens import lens_point
from sph_ros.render.raster import barycentric, interpolated_normal, span, winding_of

#: Nothing nearer than this to the camera's plane is drawn [m].
NEAR = 0.01

#: Edges of solids are cut so that no piece is longer [m].
LONGEST_EDGE = 0.04


#: In `Layers.index`, where there is nothing but the picture, and where a known card of paper is.
NOTHING, PAPER = 255, 254


class Layers:
    """What is drawn where in a picture; used again for the next one.

    Attributes:
        depth: of opaque things along the view axis [m], infinite where none is, (h, w).
        normal: of them, unit, world frame, (h, w, 3).
        index: number of them, NOTHING or PAPER, (h, w) uint8.
        front: depth [m] (infinite where empty) and normal of the liquid's nearest front, (h, w, 4).
        back: the same of its farthest back, depth 0 where none, (h, w, 4).
        thickness: of the liquid along the view axis [m], (h, w).
        foam: white water, 0 to 1, (h, w).
        covers: shares of lines behind and before the liquid, (2, h, w).
    """

    def __init__(self, width, height):
        shape = height, width
        self.depth, self.thickness = np.empty(shape, np.float32), np.empty(shape, np.float32)
        self.normal, self.index = np.zeros((*shape, 3), np.float32), np.empty(shape, np.uint8)
        self.front, self.back = (np.zeros((*shape, 4), np.float32) for _ in range(2))
        self.foam, self.covers = np.empty(shape, np.float32), np.empty((2, *shape), np.float32)
        self._low, self._high = np.zeros(2), np.array([width, height], float)

    def clear(self):
        """Empty all that was drawn into."""
        top, bottom, left, right = self.region()
        rows, columns = slice(top, bottom), slice(left, right)
        self.depth[rows, columns] = np.inf
        self.index[rows, columns] = NOTHING
        self.front[rows, columns, 0] = np.inf
        for layer in (self.back[..., 0], self.thickness, self.foam, *self.covers):
            layer[rows, columns] = 0.0
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)

    def include(self, points):
        """Note that something is drawn between these image points (..., 2) [pixels]."""
        points = np.asarray(points).reshape(-1, 2)
        if len(points):
            self._low = np.minimum(self._low, points.min(axis=0))
            self._high = np.maximum(self._high, points.max(axis=0))

    def region(self):
        """First and last + 1 row and column of all that was drawn, (4,) int64; at most all."""
        height, width = self.depth.shape
        low = np.clip(self._low - 3, 0, (width, height))
        high = np.clip(self._high + 4, 0, (width, height))
        if not (low < high).all():
            return np.zeros(4, np.int64)
        return np.array([low[1], high[1], low[0], high[0]]).astype(np.int64)


def subdivided(corners, normals, longest=LONGEST_EDGE):
    """Triangles cut into four until no edge is longer than `longest` [m].

    Args:
        corners: [m], (T, 3, 3).
        normals: at the corners, (T, 3, 3).
        longest: [m]; cutting ends after seven rounds in any case.

    Returns:
        corners and normals, (T', 3, 3).
    """
    done = []
    for _ in range(7):
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        large = edges.max(axis=1, initial=0.0) > longest
        done.append((corners[~large], normals[~large]))
        corners, normals = (_quartered(values[large]) for values in (corners, normals))
        if not len(corners):
            break
    done.append((corners, normals))
    return tuple(np.concatenate(parts) for parts in zip(*done, strict=True))


def _quartered(values):
    """Four triangles (4 T, 3, 3) for each: one at each corner and the middle one."""
    a, b, c = values[:, 0], values[:, 1], values[:, 2]
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(part, axis=1) for part in parts])


def image_corners(corners, lens):
    """Corners for the rasteriser; triangles that are not wholly before the camera are left out.

    Args:
        corners: in the camera's frame [m], (T, 3, 3).
        lens: Lens.

    Returns:
        x, y [pixels] from the picture's corner and 1 / depth [1/m], (T', 3, 3) float32, and which
        triangles these are, (T,) bool.
    """
    ahead = (corners[..., 2] > NEAR).all(axis=1)
    chosen = corners[ahead]
    image = np.empty(chosen.shape, np.float32)
    # Pixels' centres are at whole numbers for the lens, at halves for the rasteriser.
    image[..., :2] = lens.project(chosen.reshape(-1, 3)).reshape(-1, 3, 2) + 0.5
    image[..., 2] = 1.0 / chosen[..., 2]
    return image, ahead


def image_triangles(vertices, triangles, lens):
    """The same for an indexed mesh: vertices in the camera's frame (V, 3), triangles (T, 3)."""
    ahead = vertices[:, 2] > NEAR
    image = np.zeros((len(vertices), 3), np.float32)
    image[ahead, :2] = lens.project(vertices[ahead]) + 0.5
    image[ahead, 2] = 1.0 / vertices[ahead, 2]
    whole = ahead[triangles].all(axis=1)
    return image[triangles[whole]], whole


def image_lines(ends, lens, pieces=8):
    """Straight lines in space as short straight lines in the picture.

    Args:
        ends: in the camera's frame [m], (L, 2, 3).
        lens: Lens.
        pieces: of each line; those not wholly before the camera are left out.

    Returns:
        x, y [pixels] from the picture's corner and 1 / depth [1/m], (L', 2, 3) float32.
    """
    share = np.linspace(0.0, 1.0, pieces + 1)[None, :, None]
    points = ends[:, :1] * (1.0 - share) + ends[:, 1:] * share
    short = np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 3)
    short = short[(short[..., 2] > NEAR).all(axis=1)]
    image = np.empty(short.shape, np.float32)
    image[..., :2] = lens.project(short.reshape(-1, 3)).reshape(-1, 2, 2) + 0.5
    image[..., 2] = 1.0 / short[..., 2]
    return image


@bare_kernel
def draw_solids_deferred(corners, normals, owner, depth, normal, index):  # last three are written
    """Opaque triangles, nearest wins; they are shaded later.

    Args:
        corners: image x, y [pixels] and 1 / depth, (T, 3, 3).
        normals: at the corners, world frame, (T, 3, 3).
        owner: number of the thing each belongs to, (T,) uint8.
        depth: along the view axis [m], infinite where empty, (h, w).
        normal: unit, world frame, (h, w, 3).
        index: of the thing, (h, w) uint8.
    """
    height, width = depth.shape
    for t in range(len(corners)):
        y0, y1 = span(corners[t, 0, 1], corners[t, 1, 1], corners[t, 2, 1], 0, height)
        x0, x1 = span(corners[t, 0, 0], corners[t, 1, 0], corners[t, 2, 0], 0, width)
        winding = winding_of(corners, t)
        for y in range(y0, y1):
            for x in range(x0, x1):
                hit, u, v, w = barycentric(corners, t, winding, x + 0.5, y + 0.5)
                if not hit:
                    continue
                total = u + v + w
                u, v, w = u * corners[t, 0, 2], v * corners[t, 1, 2], w * corners[t, 2, 2]
                z = total / (u + v + w)
                if z < depth[y, x]:
                    depth[y, x] = z
                    index[y, x] = owner[t]
                    nx, ny, nz = interpolated_normal(normals, t, u, v, w)
                    normal[y, x, 0] = nx
                    normal[y, x, 1] = ny
                    normal[y, x, 2] = nz


@bare_kernel
def draw_smooth_lines(ends, half_width, solid_depth, front, slack, covers):  # the last is written
    """Lines of constant width with soft edges, sorted into those behind and before the liquid.

    Args:
        ends: image x, y [pixels] and 1 / depth of both ends, (L, 2, 3).
        half_width: [pixels].
        solid_depth: of what hides lines [m], (h, w).
        front: of the liquid, see `draw_liquid`, (h, w, 4).
        slack: depth by which a line may lie behind something and still show [m].
        covers: share of each pixel behind and before the liquid, (2, h, w).
    """
    height, width = solid_depth.shape
    reach = half_width + 0.5
    for e in range(len(ends)):
        ax, ay, bx, by = ends[e, 0, 0], ends[e, 0, 1], ends[e, 1, 0], ends[e, 1, 1]
        y0, y1 = span(min(ay, by) - reach, max(ay, by) + reach, ay, 0, height)
        x0, x1 = span(min(ax, bx) - reach, max(ax, bx) + reach, ax, 0, width)
        length2 = max((bx - ax) ** 2 + (by - ay) ** 2, 1e-12)
        for y in range(y0, y1):
            for x in range(x0, x1):
                px, py = x + 0.5 - ax, y + 0.5 - ay
                s = min(max((px * (bx - ax) + py * (by - ay)) / length2, 0.0), 1.0)
                gx, gy = px - s * (bx - ax), py - s * (by - ay)
                cover = reach - np.sqrt(gx * gx + gy * gy)
                z = 1.0 / (ends[e, 0, 2] + s * (ends[e, 1, 2] - ends[e, 0, 2]))
                if cover <= 0.0 or z > solid_depth[y, x] + slack:
                    continue
                layer = 1 if z < front[y, x, 0] + slack and front[y, x, 0] < np.inf else 0
                covers[layer, y, x] = max(covers[layer, y, x], min(cover, 1.0))


@inlined
def image_point(x, y, z, view, lens):
    """Pixel (centres at whole numbers) and depth of a world point.

    Args:
        x: world [m].
        y: world [m].
        z: world [m].
        view: the camera's position and its right, down and forward in the world: tuples of 3.
        lens: packed, see `Lens`.
    """
    ox, oy, oz = x - view[0][0], y - view[0][1], z - view[0][2]
    depth = ox * view[3][0] + oy * view[3][1] + oz * view[3][2]
    if depth <= 1e-3:
        return 0.0, 0.0, 0.0
    a = (ox * view[1][0] + oy * view[1][1] + oz * view[1][2]) / depth
    b = (ox * view[2][0] + oy * view[2][1] + oz * view[2][2]) / depth
    u, v = lens_point(a, b, lens)
    return u, v, depth


@bare_kernel
def draw_foam(particles, spacing, focal, front, foam):  # the last is written
    """Soft white dots where fast particles are at the liquid's front.

    Args:
        particles: image x, y [pixels], depth [m] and whiteness 0 to 1, (N, 4).
        spacing: of the particles [m].
        focal: [pixels].
        front: see `draw_liquid`, (h, w, 4).
        foam: 0 to 1, (h, w).
    """
    height, width = foam.shape
    for p in range(len(particles)):
        cx, cy, cz, white = particles[p, 0], particles[p, 1], particles[p, 2], particles[p, 3]
        radius = 1.1 * spacing * focal / cz
        y0, y1 = span(cy - radius, cy + radius, cy, 0, height)
        x0, x1 = span(cx - radius, cx + radius, cx, 0, width)
        for y in range(y0, y1):
            for x in range(x0, x1):
                far = ((x + 0.5 - cx) ** 2 + (y + 0.5 - cy) ** 2) / (radius * radius)
                if far < 1.0 and abs(front[y, x, 0] - cz) < 1.5 * spacing:
                    share = 0.5 * white * (1.0 - far) * (1.0 - far)
                    foam[y, x] += share * (1.0 - foam[y, x])
