# SPDX-License-Identifier: Apache-2.0
"""The picture's last pass: room, solids and water put together for every pixel.

Water reflects the room by Fresnel's law, refracts what is behind it through its front and its back
(Wyman 2005: exit point by the thickness, exit normal from the back faces) and absorbs with
thickness. What is behind is looked up in the drawn solids where the exit point shows one, else the
refracted ray is followed into the room itself, so the tiles bend as they should.
"""

import numpy as np
from numba import prange

from sph_ros.core.jit import device
from sph_ros.core.team import parallel_kernel
from sph_ros.render.optics import (
    WATER_INDEX,
    fresnel,
    lamp_glint,
    reflect,
    refract,
    room_colour,
)
from sph_ros.render.raster import pixel_ray

#: Absorption per scene size and colour: as in a deep pool, for water's own colour would not show in
#: a tank of some decimetres.
ABSORPTION = (3.6, 0.95, 0.40)

#: Colour of the light that the body of the water scatters back.
BODY = (0.02, 0.17, 0.28)


@parallel_kernel
def compose(solids, liquid, lines, view, focal, lights, lengths, supersample, picture):
    """Write the picture (h, w, 3) uint8 from layers drawn `supersample` times as fine.

    Args:
        solids: depth (H, W) [m] and linear RGB (H, W, 3) of opaque things.
        liquid: front and back (H, W, 4) and thickness (H, W) of `draw_liquid`.
        lines: cover of outlines behind and before the liquid, (H, W) uint8 each.
        view: of `view_rays` for the fine image, (4, 3).
        focal: focal length and principal point of the fine image [pixels], (3,).
        lights: room (9,) of `room_colour` and light map (nx, ny).
        lengths: scene size, particle spacing and least depth for the tint [m], (3,).
        supersample: fine pixels along a pixel's edge.
        picture: the last is written.
    """
    height, width, _ = picture.shape
    for y in prange(height):
        for x in range(width):
            red, green, blue = 0.0, 0.0, 0.0
            empty = _only_room(x, y, supersample, solids, liquid, lines)
            share = 1.0 if empty else 1.0 / (supersample * supersample)
            for j in range(1 if empty else supersample):
                for i in range(1 if empty else supersample):
                    r, g, b = _sample(
                        x * supersample + i,
                        y * supersample + j,
                        solids,
                        liquid,
                        lines,
                        view,
                        focal,
                        lights,
                        lengths,
                    )
                    red += _tone(r)
                    green += _tone(g)
                    blue += _tone(b)
            picture[y, x, 0] = np.uint8(255.0 * red * share + 0.5)
            picture[y, x, 1] = np.uint8(255.0 * green * share + 0.5)
            picture[y, x, 2] = np.uint8(255.0 * blue * share + 0.5)


@device
def _only_room(x, y, supersample, solids, liquid, lines):
    """Is there nothing but the room in a pixel; one sample is enough then."""
    for j in range(y * supersample, (y + 1) * supersample):
        for i in range(x * supersample, (x + 1) * supersample):
            if solids[0][j, i] < np.inf or liquid[0][j, i, 0] < np.inf:
                return False
            if lines[0][j, i] or lines[1][j, i]:
                return False
    return True


@device
def _tone(light):
    """Display value 0 to 1 of linear light: highlights roll off above 0.7, then gamma 2.

    Gamma 2 differs from sRGB's curve by 2 % at most and is a square root instead of a power.
    """
    light = max(light, 0.0)
    if light > 0.7:
        over = (light - 0.7) / 0.3
        light = 0.7 + 0.3 * over / (1.0 + over)
    return np.sqrt(light)


@device
def _sample(x, y, solids, liquid, lines, view, focal, lights, lengths):
    """Linear RGB of one fine pixel."""
    solid_depth, solid_picture = solids
    room, light = lights
    dx, dy, dz = pixel_ray(view, x + 0.5, y + 0.5)
    stretch = np.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / stretch, dy / stretch, dz / stretch
    if liquid[0][y, x, 0] < solid_depth[y, x]:
        r, g, b = _water(
            x, y, dx, dy, dz, stretch, solids, liquid, lines[0], view, focal, lights, lengths
        )
    else:
        if solid_depth[y, x] < np.inf:
            r, g, b = solid_picture[y, x, 0], solid_picture[y, x, 1], solid_picture[y, x, 2]
        else:
            r, g, b = room_colour(view[0, 0], view[0, 1], view[0, 2], dx, dy, dz, room, light, 0.0)
        r, g, b = _mix_line(r, g, b, lines[0][y, x] * 0.55)
    return _mix_line(r, g, b, lines[1][y, x] * 0.8)


@device
def _mix_line(r, g, b, share):
    """Outline colour over r, g, b."""
    return r + share * (0.10 - r), g + share * (0.12 - g), b + share * (0.15 - b)


@device
def _water(x, y, dx, dy, dz, stretch, solids, liquid, line, view, focal, lights, lengths):
    """Linear RGB of water seen in unit direction d at fine pixel (x, y)."""
    front, _, thickness = liquid
    room, light = lights
    along = front[y, x, 0] * stretch
    px, py, pz = view[0, 0] + along * dx, view[0, 1] + along * dy, view[0, 2] + along * dz
    nx, ny, nz = _towards_eye(front[y, x, 1], front[y, x, 2], front[y, x, 3], dx, dy, dz)
    depth = max(thickness[y, x] * stretch, 0.2 * lengths[1])
    share = fresnel(-(dx * nx + dy * ny + dz * nz), WATER_INDEX)
    mx, my, mz = reflect(dx, dy, dz, nx, ny, nz)
    mr, mg, mb = room_colour(px, py, pz, mx, my, mz, room, light, along)
    glint = 5.0 * lamp_glint(mx, my, mz, 350.0)
    tx, ty, tz = refract(dx, dy, dz, nx, ny, nz, WATER_INDEX)
    r, g, b = _behind(
        px, py, pz, tx, ty, tz, along, depth, solids, liquid, line, view, focal, lights, lengths
    )
    thick = max(depth, lengths[2]) / lengths[0]
    r = BODY[0] + (r - BODY[0]) * np.exp(-ABSORPTION[0] * thick)
    g = BODY[1] + (g - BODY[1]) * np.exp(-ABSORPTION[1] * thick)
    b = BODY[2] + (b - BODY[2]) * np.exp(-ABSORPTION[2] * thick)
    return (
        r + share * (mr - r) + glint,
        g + share * (mg - g) + glint,
        b + share * (mb - b) + glint,
    )


@device
def _towards_eye(nx, ny, nz, dx, dy, dz):
    """The normal, bent so that it faces the eye at least a little; at outlines it may look away."""
    cosine = nx * dx + ny * dy + nz * dz
    if cosine > -0.02:
        nx, ny, nz = nx - (cosine + 0.02) * dx, ny - (cosine + 0.02) * dy, nz - (cosine + 0.02) * dz
        s = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * s, ny * s, nz * s
    return nx, ny, nz


@device
def _behind(px, py, pz, tx, ty, tz, far, depth, solids, liquid, line, view, focal, lights, lengths):
    """Linear RGB seen through the water from entry point p in refracted direction t."""
    solid_depth, solid_picture = solids
    room, light = lights
    back = liquid[1]
    height, width = solid_depth.shape
    floor = room[0] + 1.5 * lengths[1]
    i, j = -1, -1
    for _ in range(3):  # where the refracted ray leaves: depth of the back face under its end
        qx, qy, qz = px + depth * tx, py + depth * ty, pz + depth * tz
        u, v, z = _image_point(qx, qy, qz, view, focal)
        if z <= 0.0 or not (0.0 <= u < width and 0.0 <= v < height):
            break
        i, j = int(u), int(v)
        hit = min(back[j, i, 0], solid_depth[j, i])
        if hit <= 0.0:
            break
        depth = min(max(depth * (1.0 + 0.8 * _relative(hit - z, depth)), 0.3 * depth), 2.0 * depth)
    if i >= 0 and solid_depth[j, i] < np.inf and solid_depth[j, i] > liquid[0][j, i, 0]:
        return solid_picture[j, i, 0], solid_picture[j, i, 1], solid_picture[j, i, 2]
    if tz < 0.0 and pz + depth * tz < floor:  # on the floor: no air between
        return room_colour(px, py, pz, tx, ty, tz, room, light, far)
    qx, qy, qz = px + depth * tx, py + depth * ty, pz + depth * tz
    if i < 0:
        return room_colour(qx, qy, qz, tx, ty, tz, room, light, far)
    if back[j, i, 0] > 0.0:
        nx, ny, nz = _towards_eye(-back[j, i, 1], -back[j, i, 2], -back[j, i, 3], tx, ty, tz)
        tx, ty, tz = refract(tx, ty, tz, nx, ny, nz, 1.0 / WATER_INDEX)
    r, g, b = room_colour(qx, qy, qz, tx, ty, tz, room, light, far)
    return _mix_line(r, g, b, line[j, i] * 0.5)


@device
def _relative(step, length):
    """A step over a length, at most one either way."""
    return min(max(step / max(length, 1e-9), -1.0), 1.0)


@device
def _image_point(x, y, z, view, focal):
    """Fine image coordinates and depth of a world point; view's steps are right and down over f."""
    ox, oy, oz = x - view[0, 0], y - view[0, 1], z - view[0, 2]
    f = focal[0]
    right = f * (ox * view[2, 0] + oy * view[2, 1] + oz * view[2, 2])
    down = f * (ox * view[3, 0] + oy * view[3, 1] + oz * view[3, 2])
    fx = view[2, 1] * view[3, 2] - view[2, 2] * view[3, 1]
    fy = view[2, 2] * view[3, 0] - view[2, 0] * view[3, 2]
    fz = view[2, 0] * view[3, 1] - view[2, 1] * view[3, 0]
    depth = f * f * (ox * fx + oy * fy + oz * fz)
    if depth <= 0.0:
        return 0.0, 0.0, depth
    return focal[1] + f * right / depth, focal[2] + f * down / depth, depth
