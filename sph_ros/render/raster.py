# SPDX-License-Identifier: Apache-2.0
"""A z-buffer on the CPU: triangles, spheres and lines into arrays.

Rows are shared out among threads in bands; each thread walks over all triangles and writes its own
rows, so the picture does not depend on the number of threads.
"""

import numpy as np
from numba import prange

from sph_ros.core.jit import device, inlined
from sph_ros.core.team import parallel_kernel
from sph_ros.render.optics import LAMP, LAMP_LIGHT, SKY_LIGHT, lamp_glint, reflect

#: Bands of rows per picture; more than threads, because the liquid fills only some.
BANDS = 16

#: Nothing nearer than this to the camera's plane is drawn [m].
NEAR = 1e-3


def projected_corners(points, normals, camera, size):
    """Triangles' corners for the rasteriser, clipped at the near plane.

    Args:
        points: corners [m], world frame, (T, 3, 3).
        normals: unit normals at the corners, world frame, (T, 3, 3).
        camera: Camera.
        size: (width, height) in pixels.

    Returns:
        Image x, y [pixels] and 1 / depth [1/m] per corner, (T', 3, 3) float32, and normals.
    """
    local = camera.to_camera(points.reshape(-1, 3)).reshape(-1, 3, 3)
    ahead = (local[:, :, 2] > NEAR).sum(axis=1)
    crossing = np.flatnonzero((ahead > 0) & (ahead < 3))
    whole = ahead == 3
    local_parts, normal_parts = [local[whole]], [normals[whole]]
    for t in crossing:
        for corners, their_normals in _clipped(local[t], normals[t]):
            local_parts.append(corners[None])
            normal_parts.append(their_normals[None])
    local = np.concatenate(local_parts)
    focal, cx, cy = camera.intrinsics(size)
    corners = np.empty_like(local)
    corners[..., 2] = 1.0 / local[..., 2]
    corners[..., 0] = cx + focal * local[..., 0] * corners[..., 2]
    corners[..., 1] = cy + focal * local[..., 1] * corners[..., 2]
    return corners, np.ascontiguousarray(np.concatenate(normal_parts), np.float32)


def _clipped(corners, normals):
    """The part of one triangle beyond the near plane, as up to two (Sutherland-Hodgman 1974)."""
    kept = []
    for i in range(3):
        a, b = np.r_[corners[i], normals[i]], np.r_[corners[i - 2], normals[i - 2]]
        if a[2] > NEAR:
            kept.append(a)
        if (a[2] > NEAR) != (b[2] > NEAR):
            kept.append(a + (b - a) * ((1.001 * NEAR - a[2]) / (b[2] - a[2])))
    for i in range(1, len(kept) - 1):
        fan = np.array([kept[0], kept[i], kept[i + 1]], np.float32)
        yield fan[:, :3], fan[:, 3:]


@device
def _edge(ax, ay, bx, by, px, py):
    """Twice the signed area of a, b, p; exactly opposite for b, a, p: neighbours never overlap."""
    if ax > bx or (ax == bx and ay > by):
        return -((ax - bx) * (py - by) - (ay - by) * (px - bx))
    return (bx - ax) * (py - ay) - (by - ay) * (px - ax)


@device
def _inside(w, ax, ay, bx, by):
    """Is a pixel with edge value w on this edge's side; on the edge it belongs to one side only."""
    return w > 0.0 or (w == 0.0 and (ax < bx or (ax == bx and ay < by)))


@inlined
def barycentric(corners, t, winding, px, py):
    """Perspective-free weights of the corners at a pixel, and whether it is inside the triangle."""
    ax, ay = corners[t, 0, 0], corners[t, 0, 1]
    bx, by = corners[t, 1, 0], corners[t, 1, 1]
    cx, cy = corners[t, 2, 0], corners[t, 2, 1]
    u = winding * _edge(bx, by, cx, cy, px, py)
    v = winding * _edge(cx, cy, ax, ay, px, py)
    w = winding * _edge(ax, ay, bx, by, px, py)
    if winding > 0.0:
        hit = (
            _inside(u, bx, by, cx, cy) and _inside(v, cx, cy, ax, ay) and _inside(w, ax, ay, bx, by)
        )
    else:
        hit = (
            _inside(u, cx, cy, bx, by) and _inside(v, ax, ay, cx, cy) and _inside(w, bx, by, ax, ay)
        )
    return hit, u, v, w


@inlined
def winding_of(corners, t):
    """Sign of the area in the image, whose y points down: -1 for a triangle seen from outside."""
    area = (corners[t, 1, 0] - corners[t, 0, 0]) * (corners[t, 2, 1] - corners[t, 0, 1]) - (
        corners[t, 1, 1] - corners[t, 0, 1]
    ) * (corners[t, 2, 0] - corners[t, 0, 0])
    return 1.0 if area > 0.0 else -1.0


@device
def span(a, b, c, first, last):
    """Range of pixels that three coordinates span, within first..last - 1."""
    low = min(a, min(b, c))
    high = max(a, max(b, c))
    return int(max(low, float(first))), int(min(high, last - 1.0)) + 1


@inlined
def interpolated_normal(normals, t, u, v, w):
    """Unit normal of triangle t at weights u, v, w of its corners."""
    x = u * normals[t, 0, 0] + v * normals[t, 1, 0] + w * normals[t, 2, 0]
    y = u * normals[t, 0, 1] + v * normals[t, 1, 1] + w * normals[t, 2, 1]
    z = u * normals[t, 0, 2] + v * normals[t, 1, 2] + w * normals[t, 2, 2]
    scale = 1.0 / np.sqrt(x * x + y * y + z * z + 1e-20)
    return x * scale, y * scale, z * scale


@inlined
def shade_matt(colour, nx, ny, nz, dx, dy, dz):
    """Linear RGB of a slightly glossy solid: sky from above, lamp, glint (Lambert and Phong)."""
    lamp = max(nx * LAMP[0] + ny * LAMP[1] + nz * LAMP[2], 0.0)
    light = SKY_LIGHT * (0.75 + 0.45 * nz) + LAMP_LIGHT * lamp
    rx, ry, rz = reflect(dx, dy, dz, nx, ny, nz)
    glint = 0.35 * lamp_glint(rx, ry, rz, 60.0)
    return colour[0] * light + glint, colour[1] * light + glint, colour[2] * light + glint


@parallel_kernel
def draw_solids(corners, normals, colours, view, depth, picture):  # the last two are written
    """Opaque triangles, nearest wins.

    Args:
        corners: image x, y [pixels] and 1 / depth, (T, 3, 3).
        normals: at the corners, world frame, (T, 3, 3).
        colours: linear RGB per triangle, (T, 3).
        view: rays through pixels, see `view_rays`, (4, 3).
        depth: along the view axis [m], infinite where empty, (h, w).
        picture: linear RGB, (h, w, 3).
    """
    height, width = depth.shape
    for band in prange(BANDS):
        first, last = band * height // BANDS, (band + 1) * height // BANDS
        for t in range(len(corners)):
            y0, y1 = span(corners[t, 0, 1], corners[t, 1, 1], corners[t, 2, 1], first, last)
            if y0 >= y1:
                continue
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
                        nx, ny, nz = interpolated_normal(normals, t, u, v, w)
                        dx, dy, dz = pixel_ray(view, x + 0.5, y + 0.5)
                        s = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
                        if nx * dx + ny * dy + nz * dz > 0.0:
                            nx, ny, nz = -nx, -ny, -nz
                        r, g, b = shade_matt(colours[t], nx, ny, nz, dx * s, dy * s, dz * s)
                        picture[y, x, 0] = r
                        picture[y, x, 1] = g
                        picture[y, x, 2] = b


def view_rays(camera, size) -> np.ndarray:
    """Eye, ray through the image's corner (0, 0), its change per pixel in x and in y, (4, 3)."""
    focal, cx, cy = camera.intrinsics(size)
    right, down, forward = camera.world_from_camera.T
    corner = forward - right * cx / focal - down * cy / focal
    return np.stack([camera.eye, corner, right / focal, down / focal])


@inlined
def pixel_ray(view, x, y):
    """World direction through image point (x, y), one metre deep along the view axis."""
    return (
        view[1, 0] + x * view[2, 0] + y * view[3, 0],
        view[1, 1] + x * view[2, 1] + y * view[3, 1],
        view[1, 2] + x * view[2, 2] + y * view[3, 2],
    )


@parallel_kernel
def draw_liquid(corners, normals, solid_depth, bands, front, back, thickness):  # last 3 written
    """Nearest outside, farthest inside and total thickness of a closed mesh.

    Args:
        corners: image x, y [pixels] and 1 / depth, (T, 3, 3).
        normals: outward at the corners, world frame, (T, 3, 3).
        solid_depth: depth of what hides the liquid [m], (h, w).
        bands: of rows, that threads may share; the picture does not depend on it.
        front: depth [m] (infinite where empty) and normal of the nearest front face, (h, w, 4).
        back: the same of the farthest back face before a solid, depth 0 where none, (h, w, 4).
        thickness: of liquid along the view axis before a solid [m], (h, w).
    """
    height, width = thickness.shape
    for band in prange(bands):
        first, last = band * height // bands, (band + 1) * height // bands
        for t in range(len(corners)):
            y0, y1 = span(corners[t, 0, 1], corners[t, 1, 1], corners[t, 2, 1], first, last)
            if y0 >= y1:
                continue
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
                    thickness[y, x] += winding * min(z, solid_depth[y, x])
                    if winding < 0.0 and z < front[y, x, 0]:
                        _put_surface(front, y, x, z, normals, t, u, v, w)
                    elif winding > 0.0 and back[y, x, 0] < z < solid_depth[y, x]:
                        _put_surface(back, y, x, z, normals, t, u, v, w)


@inlined
def _put_surface(layer, y, x, z, normals, t, u, v, w):
    """Write depth and normal of triangle t into a layer (h, w, 4)."""
    nx, ny, nz = interpolated_normal(normals, t, u, v, w)
    layer[y, x, 0] = z
    layer[y, x, 1] = nx
    layer[y, x, 2] = ny
    layer[y, x, 3] = nz


@parallel_kernel
def draw_spheres(centres, radius, colours, view, focal, depth, picture):  # last two are written
    """Shaded spheres, drawn as discs with a sphere's normals and depth.

    Args:
        centres: image x, y [pixels] and depth [m], (N, 3).
        radius: of every sphere [m].
        colours: linear RGB, (N, 3).
        view: as for `draw_solids`.
        focal: focal length [pixels].
        depth: (h, w).
        picture: linear RGB, (h, w, 3).
    """
    height, width = depth.shape
    for band in prange(BANDS):
        first, last = band * height // BANDS, (band + 1) * height // BANDS
        for p in range(len(centres)):
            cx, cy, cz = centres[p, 0], centres[p, 1], centres[p, 2]
            if cz <= radius + NEAR:
                continue
            reach = focal * radius / cz
            y0, y1 = span(cy - reach, cy, cy + reach, first, last)
            x0, x1 = span(cx - reach, cx, cx + reach, 0, width)
            for y in range(y0, y1):
                for x in range(x0, x1):
                    a, b = (x + 0.5 - cx) / reach, (y + 0.5 - cy) / reach
                    rest = 1.0 - a * a - b * b
                    if rest < 0.0:
                        continue
                    c = np.sqrt(rest)
                    z = cz - radius * c
                    if z < depth[y, x]:
                        depth[y, x] = z
                        nx, ny, nz = _camera_to_world(view, focal, a, b, -c)
                        dx, dy, dz = pixel_ray(view, x + 0.5, y + 0.5)
                        s = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
                        r, g, b2 = shade_matt(colours[p], nx, ny, nz, dx * s, dy * s, dz * s)
                        picture[y, x, 0] = r
                        picture[y, x, 1] = g
                        picture[y, x, 2] = b2


@inlined
def _camera_to_world(view, focal, a, b, c):
    """Camera vector in the world frame; view's steps are right and down over focal."""
    fx = view[2, 1] * view[3, 2] - view[2, 2] * view[3, 1]
    fy = view[2, 2] * view[3, 0] - view[2, 0] * view[3, 2]
    fz = view[2, 0] * view[3, 1] - view[2, 1] * view[3, 0]
    return (
        focal * (a * view[2, 0] + b * view[3, 0] + c * focal * fx),
        focal * (a * view[2, 1] + b * view[3, 1] + c * focal * fy),
        focal * (a * view[2, 2] + b * view[3, 2] + c * focal * fz),
    )


@parallel_kernel
def draw_lines(ends, half_width, solid_depth, slack, cover):  # the last is written
    """Straight lines of constant width, hidden by solids.

    Args:
        ends: image x, y [pixels] and 1 / depth of both ends, (L, 2, 3).
        half_width: [pixels].
        solid_depth: [m], (h, w).
        slack: depth by which a line may lie behind a solid and still show [m].
        cover: 1 where a line is, (h, w) uint8.
    """
    height, width = solid_depth.shape
    for band in prange(BANDS):
        first, last = band * height // BANDS, (band + 1) * height // BANDS
        for e in range(len(ends)):
            ax, ay, bx, by = ends[e, 0, 0], ends[e, 0, 1], ends[e, 1, 0], ends[e, 1, 1]
            y0, y1 = span(min(ay, by) - half_width, max(ay, by) + half_width, ay, first, last)
            length2 = max((bx - ax) ** 2 + (by - ay) ** 2, 1e-12)
            for y in range(y0, y1):
                x0, x1 = _row_of_line(ax, ay, bx, by, y, half_width, width)
                for x in range(x0, x1):
                    px, py = x + 0.5 - ax, y + 0.5 - ay
                    s = min(max((px * (bx - ax) + py * (by - ay)) / length2, 0.0), 1.0)
                    gx, gy = px - s * (bx - ax), py - s * (by - ay)
                    if gx * gx + gy * gy <= half_width * half_width:
                        z = 1.0 / (ends[e, 0, 2] + s * (ends[e, 1, 2] - ends[e, 0, 2]))
                        if z < solid_depth[y, x] + slack:
                            cover[y, x] = 1


@inlined
def _row_of_line(ax, ay, bx, by, y, half_width, width):
    """Pixels of row y that a line may touch; `half_width` in pixels to either side."""
    low, high = min(ax, bx), max(ax, bx)
    if abs(by - ay) > 1e-6:
        slope = (bx - ax) / (by - ay)
        reach = half_width * np.sqrt(1.0 + slope * slope) + abs(slope) + 1.0
        middle = ax + slope * (y + 0.5 - ay)
        low, high = max(low, middle - reach), min(high, middle + reach)
    return int(max(low - half_width, 0.0)), int(min(high + half_width, width - 1.0)) + 1
