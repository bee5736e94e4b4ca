# SPDX-License-Identifier: Apache-2.0
"""Water put into a camera's picture, pixel by pixel.

What stands behind the water is the picture itself: a ray is refracted at the liquid's front
(Snell), followed to where it leaves (Wyman 2005: exit point by the thickness, exit normal from the
back faces), refracted again, and meets the desk, whose height is known; the colour is that of the
picture where the camera sees this point of the desk. So the marker under the water is lifted and
bent as a real one would be. A mirrored ray sees the desk in the same way, or the room (Fresnel).
All colours are linear, blue green red as in the picture.
"""

import numpy as np

from sph_ros.core.jit import bare_kernel, device, inlined
from sph_ros.render.optics import (
    LAMP,
    WATER_INDEX,
    fresnel,
    lamp_glint,
    light_at,
    reflect,
    refract,
    sky_colour,
    smooth_step,
)
from sph_ros.render.overlay_layers import NOTHING, PAPER, image_point
from sph_ros.render.raster import shade_matt

#: Absorption per length of the scene: blue, green, red.
ABSORPTION = (0.45, 0.85, 3.2)

#: Colour of the light that the body of the water scatters back: blue, green, red.
BODY = (0.34, 0.22, 0.03)

#: Share of the desk's light that the lamp gives; the rest comes from everywhere.
LAMP_SHARE = 0.5

#: Brightness of the room over the desk, in white paper.
SKY = 1.1

#: A ray that never meets the desk is taken as far as this [scene sizes].
FAR = 6.0


@inlined
def _direction(x, y, view):
    """World direction of a ray, one metre deep along the view axis."""
    return (
        x * view[1][0] + y * view[2][0] + view[3][0],
        x * view[1][1] + y * view[2][1] + view[3][1],
        x * view[1][2] + y * view[2][2] + view[3][2],
    )


@inlined
def _desk_light(x, y, room, light):
    """Factor of the desk's brightness at (x, y) [m] under shadows and caustics."""
    lamp = light_at(x, y, light, room[2], room[3], room[4])
    return 1.0 + LAMP_SHARE * (min(lamp, 2.5) - 1.0)


@device
def _line_over(b, g, r, share, exposure):
    """A line over a colour, as bright as glass edges are."""
    if share <= 0.0:
        return b, g, r
    shine = 0.85 * exposure
    return b + share * (shine - b), g + share * (shine - g), r + share * (0.95 * shine - r)


@inlined
def _shaded(x, y, normal, colour, rays, view, exposure):
    """Linear blue green red of a solid's surface at a pixel."""
    dx, dy, dz = _direction(rays[y, x, 0], rays[y, x, 1], view)
    s = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
    nx, ny, nz = normal[y, x, 0], normal[y, x, 1], normal[y, x, 2]
    if nx * dx + ny * dy + nz * dz > 0.0:
        nx, ny, nz = -nx, -ny, -nz
    r, g, b = shade_matt(colour, nx, ny, nz, dx * s, dy * s, dz * s)
    return b * exposure, g * exposure, r * exposure


@bare_kernel
def draw_water(
    picture, region, solids, liquid, foam, covers, rays, view, lens, room, light, result
):
    """A region of the finished picture, the last argument.

    Args:
        picture: of the camera, (h, w, 3) uint8 blue green red.
        region: first and last + 1 row, the same of columns, (4,).
        solids: depth (h, w), normal (h, w, 3), index (h, w) and colours (n, 3) red green blue.
        liquid: front and back (h, w, 4) and thickness (h, w) of `draw_liquid`.
        foam: white water at the front, 0 to 1, (h, w).
        covers: of lines behind and before the liquid, (2, h, w).
        rays: of pixels, see `Lens.rays`, (h, w, 2).
        view: see `image_point`.
        lens: packed, see `Lens`.
        room: height of the desk, exposure, light map's origin x, y [m] and texels per metre, scene
            size, particle spacing [m]: 7 numbers.
        light: lamp light on the desk, 1 where nothing changes it, (nx, ny).
        result: a copy of the picture, (h, w, 3) uint8.
    """
    front, back, _ = liquid
    depth, normal, index, colours = solids
    for y in range(region[0], region[1]):
        for x in range(region[2], region[3]):
            if front[y, x, 0] < depth[y, x]:
                b, g, r = _water(
                    x, y, picture, solids, liquid, covers[0], rays, view, lens, room, light
                )
                white, shine = foam[y, x], 0.9 * room[1]
                b, g, r = b + white * (shine - b), g + white * (shine - g), r + white * (shine - r)
            else:
                inside = front[y, x, 0] == np.inf and back[y, x, 0] > 0.0  # the camera is in water
                if index[y, x] < PAPER:
                    b, g, r = _shaded(x, y, normal, colours[index[y, x]], rays, view, room[1])
                else:
                    share = 1.0
                    if index[y, x] == NOTHING:
                        share = _desk_light_at_pixel(x, y, rays, view, room, light)
                    if share == 1.0 and not inside and covers[0, y, x] + covers[1, y, x] == 0.0:
                        continue  # the camera's own pixel
                    b, g, r = _light(picture, y, x, share)
                b, g, r = _line_over(b, g, r, 0.6 * covers[0, y, x], room[1])
                if inside:
                    b, g, r = _tinted(b, g, r, min(back[y, x, 0], depth[y, x]), room)
            b, g, r = _line_over(b, g, r, 0.8 * covers[1, y, x], room[1])
            result[y, x, 0] = _display(b)
            result[y, x, 1] = _display(g)
            result[y, x, 2] = _display(r)


@inlined
def _light(picture, y, x, share):
    """Linear blue green red of a pixel, times a share."""
    b, g, r = picture[y, x, 0] / 255.0, picture[y, x, 1] / 255.0, picture[y, x, 2] / 255.0
    return b * b * share, g * g * share, r * r * share


@inlined
def _desk_light_at_pixel(x, y, rays, view, room, light):
    """Factor of a pixel's brightness if the desk is seen there."""
    dx, dy, dz = _direction(rays[y, x, 0], rays[y, x, 1], view)
    along = (room[0] - view[0][2]) / dz if dz != 0.0 else -1.0
    if along <= 0.0:
        return 1.0
    return _desk_light(view[0][0] + along * dx, view[0][1] + along * dy, room, light)


@device
def _display(light):
    """Value of a pixel; gamma 2 there and back leaves the camera's own pixels as they are."""
    return np.uint8(min(255.0 * np.sqrt(max(light, 0.0)) + 0.5, 255.0))


@device
def _tinted(b, g, r, depth, room):
    """A colour seen through water (Beer-Lambert) that scatters some light of its own."""
    thick = depth / room[5]
    body = 0.75 * room[1]
    return (
        BODY[0] * body + (b - BODY[0] * body) * np.exp(-ABSORPTION[0] * thick),
        BODY[1] * body + (g - BODY[1] * body) * np.exp(-ABSORPTION[1] * thick),
        BODY[2] * body + (r - BODY[2] * body) * np.exp(-ABSORPTION[2] * thick),
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


@inlined
def _water(x, y, picture, solids, liquid, line, rays, view, lens, room, light):
    """Linear blue green red of water at a pixel."""
    front, back, thickness = liquid
    dx, dy, dz = _direction(rays[y, x, 0], rays[y, x, 1], view)
    stretch = np.sqrt(dx * dx + dy * dy + dz * dz)
    near = front[y, x, 0]
    px, py, pz = view[0][0] + near * dx, view[0][1] + near * dy, view[0][2] + near * dz
    dx, dy, dz = dx / stretch, dy / stretch, dz / stretch
    nx, ny, nz = _towards_eye(front[y, x, 1], front[y, x, 2], front[y, x, 3], dx, dy, dz)
    depth = max(thickness[y, x] * stretch, 0.2 * room[6])
    share = fresnel(-(dx * nx + dy * ny + dz * nz), WATER_INDEX)
    mx, my, mz = reflect(dx, dy, dz, nx, ny, nz)
    mb, mg, mr = _seen(px, py, pz, mx, my, mz, picture, view, lens, room, light)
    glint = 0.0
    if mx * LAMP[0] + my * LAMP[1] + mz * LAMP[2] > 0.97:
        glint = 4.0 * lamp_glint(mx, my, mz, 250.0) * room[1]
    tx, ty, tz = refract(dx, dy, dz, nx, ny, nz, WATER_INDEX)
    depth, i, j = _way_through(px, py, pz, tx, ty, tz, depth, solids[0], back, view, lens)
    if i >= 0 and near < solids[0][i, j] < np.inf and solids[2][i, j] < PAPER:
        b, g, r = _shaded(j, i, solids[1], solids[3][solids[2][i, j]], rays, view, room[1])
    else:
        edge = 0.0
        if tz < 0.0 and pz + depth * tz < room[0] + 1.5 * room[6]:  # the desk: no air between
            depth = (room[0] - pz) / tz
        else:
            px, py, pz = px + depth * tx, py + depth * ty, pz + depth * tz
            if i >= 0:
                edge = 0.5 * line[i, j]
                if back[i, j, 0] > 0.0:
                    nx, ny, nz = _towards_eye(
                        -back[i, j, 1], -back[i, j, 2], -back[i, j, 3], tx, ty, tz
                    )
                    tx, ty, tz = refract(tx, ty, tz, nx, ny, nz, 1.0 / WATER_INDEX)
        b, g, r = _seen(px, py, pz, tx, ty, tz, picture, view, lens, room, light)
        b, g, r = _line_over(b, g, r, edge, room[1])
    b, g, r = _tinted(b, g, r, depth, room)
    return (
        b + share * (mb - b + glint),
        g + share * (mg - g + glint),
        r + share * (mr - r + glint),
    )


@inlined
def _way_through(px, py, pz, tx, ty, tz, depth, solid_depth, back, view, lens):
    """How far the ray from entry point p in direction t goes through water, and where it ends.

    Returns:
        length [m], starting from the guess `depth`; row and column of its end, row -1 if outside.
    """
    height, width = solid_depth.shape
    i, j = -1, -1
    for _ in range(2):  # depth of the back face, or the solid, that the camera sees at its end
        u, v, z = image_point(px + depth * tx, py + depth * ty, pz + depth * tz, view, lens)
        if z <= 0.0 or not (0.0 <= u < width - 0.5 and 0.0 <= v < height - 0.5):
            return depth, -1, -1
        i, j = int(v + 0.5), int(u + 0.5)
        hit = min(back[i, j, 0], solid_depth[i, j])
        if hit <= 0.0:
            break
        step = min(max((hit - z) / max(depth, 1e-9), -1.0), 1.0)
        depth = min(max(depth * (1.0 + 0.8 * step), 0.3 * depth), 2.0 * depth)
    return depth, i, j


@inlined
def _seen(ox, oy, oz, dx, dy, dz, picture, view, lens, room, light):
    """Linear blue green red of the desk or the room that a ray from o in direction d meets.

    The desk's colour is looked up in the picture; where the camera does not see that place, the
    room's is taken.
    """
    height, width, _ = picture.shape
    b, g, r, share = 0.0, 0.0, 0.0, 0.0
    if dz < 0.1:
        far = FAR * room[5]
        along = min((room[0] - oz) / dz, far) if dz < -1e-4 else far
        x, y = ox + along * dx, oy + along * dy
        u, v, z = image_point(x, y, oz + along * dz, view, lens)
        outside = max(max(-u, u - width + 1.0), max(-v, v - height + 1.0)) / width
        if z > 0.0 and outside < 0.3:
            share = 1.0
            if outside > 0.0 or dz > 0.0:
                share = (1.0 - smooth_step(0.0, 0.3, outside)) * (1.0 - smooth_step(0.0, 0.1, dz))
            b, g, r = _sample(picture, u, v)
            lit = share * _desk_light(x, y, room, light)
            b, g, r = lit * b, lit * g, lit * r
    if share < 1.0:
        sr, sg, sb = sky_colour(dx, dy, dz)
        rest = SKY * room[1] * (1.0 - share)
        b, g, r = b + rest * sb, g + rest * sg, r + rest * sr
    return b, g, r


@inlined
def _sample(picture, u, v):
    """Linear colour (3 numbers) at a place in the picture, bilinear; outside, the border's."""
    height, width, _ = picture.shape
    u, v = min(max(u, 0.0), width - 1.001), min(max(v, 0.0), height - 1.001)
    i, j = int(v), int(u)
    a, b = v - i, u - j
    return (
        _mixed(picture, i, j, 0, a, b),
        _mixed(picture, i, j, 1, a, b),
        _mixed(picture, i, j, 2, a, b),
    )


@inlined
def _mixed(picture, i, j, k, a, b):
    """Square of the bilinear mean of four pixels; a from the top, b from the left."""
    top = picture[i, j, k] * (1.0 - b) + picture[i, j + 1, k] * b
    bottom = picture[i + 1, j, k] * (1.0 - b) + picture[i + 1, j + 1, k] * b
    value = (top + a * (bottom - top)) / 255.0
    return value * value


@bare_kernel
def soften_edges(region, solids, liquid, rim, source, result):  # the last is written
    """Mix pixels at the edges of what was drawn with their neighbours.

    Args:
        region: as for `draw_water`.
        solids: as for `draw_water`.
        liquid: as for `draw_water`.
        rim: brightness of the water's own edges, where it climbs the glass, 0 to 255.
        source: (h, w, 3) uint8.
        result: a copy of it, (h, w, 3) uint8.
    """
    height, width, _ = source.shape
    for y in range(max(region[0], 1), min(region[1], height - 1)):
        for x in range(max(region[2], 1), min(region[3], width - 1)):
            bend = max(
                max(_edge(y, x, y, x + 1, solids, liquid), _edge(y, x, y + 1, x, solids, liquid)),
                max(_edge(y, x, y, x - 1, solids, liquid), _edge(y, x, y - 1, x, solids, liquid)),
            )
            if bend == 0.0:
                continue
            white = 0.25 if bend < 1.0 else 0.0
            for k in range(3):
                around = 1.0 * source[y, x - 1, k] + source[y, x + 1, k]
                around += 1.0 * source[y - 1, x, k] + source[y + 1, x, k]
                value = 0.4 * source[y, x, k] + 0.15 * around
                result[y, x, k] = np.uint8(value + white * (rim - value) + 0.5)


@inlined
def _edge(y, x, v, u, solids, liquid):
    """1 where something ends between two pixels, 0.5 where the liquid's front bends sharply."""
    depth, _, index, _ = solids
    front = liquid[0]
    wet, other = front[y, x, 0] < depth[y, x], front[v, u, 0] < depth[v, u]
    if wet != other or index[y, x] != index[v, u]:
        return 1.0
    if not wet:
        return 0.0
    cosine = (
        front[y, x, 1] * front[v, u, 1]
        + front[y, x, 2] * front[v, u, 2]
        + front[y, x, 3] * front[v, u, 3]
    )
    return 0.5 if cosine < 0.8 else 0.0
