# SPDX-License-Identifier: Apache-2.0
"""Light at a boundary, and the room that light comes from: small functions of a few numbers."""

import numpy as np

from sph_ros.core.jit import device, inlined

#: Refractive index of water in visible light.
WATER_INDEX = 1.333

#: Direction to the lamp in the world, a unit vector.
LAMP = (0.42, -0.20, 0.886)

#: Share of the floor's light that comes from the lamp, and from everywhere.
LAMP_LIGHT, SKY_LIGHT = 0.80, 0.30


@device
def fresnel(cosine, index):
    """Reflected share of unpolarised light that enters a medium of relative `index` (Fresnel).

    Args:
        cosine: of the angle between ray and normal, 0 grazing to 1 straight.
        index: index behind the boundary over index before it; below 1, total reflection occurs.
    """
    sine2 = (1.0 - cosine * cosine) / (index * index)
    if sine2 >= 1.0:
        return 1.0
    inner = np.sqrt(1.0 - sine2)
    across = (cosine - index * inner) / (cosine + index * inner)
    along = (index * cosine - inner) / (index * cosine + inner)
    return 0.5 * (across * across + along * along)


@device
def reflect(dx, dy, dz, nx, ny, nz):
    """Direction d mirrored at the plane with unit normal n."""
    twice = 2.0 * (dx * nx + dy * ny + dz * nz)
    return dx - twice * nx, dy - twice * ny, dz - twice * nz


@device
def refract(dx, dy, dz, nx, ny, nz, index):
    """Unit direction d behind the boundary with unit normal n (against d), Snell; mirrored if none.

    `index` is that behind the boundary over that before it.
    """
    cosine = -(dx * nx + dy * ny + dz * nz)
    rest = 1.0 - (1.0 - cosine * cosine) / (index * index)
    if rest < 0.0:
        return reflect(dx, dy, dz, nx, ny, nz)
    a = 1.0 / index
    b = a * cosine - np.sqrt(rest)
    return a * dx + b * nx, a * dy + b * ny, a * dz + b * nz


@device
def smooth_step(low, high, x):
    """0 below low, 1 above high, smooth between."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@device
def sky_colour(dx, dy, dz):
    """Linear RGB of a bright room above the horizon, with two windows of light overhead."""
    up = np.sqrt(max(dz, 0.0))
    r = 0.80 + (0.22 - 0.80) * up
    g = 0.85 + (0.36 - 0.85) * up
    b = 0.90 + (0.56 - 0.90) * up
    if dz > 0.05:
        u, v = dx / dz, dy / dz
        for k in range(2):
            middle = 0.75 if k == 0 else -1.15
            pane = smooth_step(0.42, 0.34, abs(u - middle)) * smooth_step(1.3, 1.2, abs(v))
            r += 2.6 * pane
            g += 2.6 * pane
            b += 2.5 * pane
    return r, g, b


@inlined
def light_at(x, y, light, origin_x, origin_y, texels_per_metre):
    """Lamp light on the floor, bilinear from the light map; 1 outside it."""
    u = (x - origin_x) * texels_per_metre - 0.5
    v = (y - origin_y) * texels_per_metre - 0.5
    if not (0.0 <= u < light.shape[0] - 1 and 0.0 <= v < light.shape[1] - 1):
        return 1.0
    i, j = int(u), int(v)
    a, b = u - i, v - j
    return (1.0 - a) * ((1.0 - b) * light[i, j] + b * light[i, j + 1]) + a * (
        (1.0 - b) * light[i + 1, j] + b * light[i + 1, j + 1]
    )


@device
def _stripes(x, blur):
    """Square wave -1, 1 that changes sign at integers, averaged over about `blur`."""
    wave = 1.0 - 2.0 * abs(0.5 * (x + 0.5) - np.floor(0.5 * (x + 0.5)) - 0.5) * 2.0
    return min(max(wave / max(2.0 * blur, 1e-6), -1.0), 1.0)


@device
def floor_colour(x, y, tile, light, origin_x, origin_y, texels_per_metre, blur):
    """Linear RGB of the tiled floor in the lamp's light; `blur` is a pixel's width there [m]."""
    u, v, blur = x / tile, y / tile, blur / tile
    shade = 0.64 + 0.085 * _stripes(u, blur) * _stripes(v, blur)
    joint = min(abs(u - np.round(u)), abs(v - np.round(v)))
    width = max(blur, 0.012)
    shade *= 1.0 - 0.45 * (0.012 / width) * max(1.0 - joint / width, 0.0)
    lamp = light_at(x, y, light, origin_x, origin_y, texels_per_metre)
    lit = shade * (SKY_LIGHT + LAMP_LIGHT * lamp)
    return lit * 0.985, lit * 0.97, lit * 0.93


@device
def room_colour(ox, oy, oz, dx, dy, dz, room, light, far):
    """Linear RGB that a ray from o in direction d sees: the floor, fading into haze, or the sky.

    Args:
        ox: origin of the ray [m], x.
        oy: y.
        oz: z.
        dx: direction of the ray, x.
        dy: y.
        dz: z.
        room: floor height, tile edge, haze distance [m]; light map's origin x, y [m] and texels per
            metre, centre x, y of the scene [m], angle of a pixel [rad], (9,).
        light: lamp light on the floor, (nx, ny).
        far: length of the ray's way to o, for the width of a pixel [m].
    """
    if dz > -1e-4:
        return sky_colour(dx, dy, dz)
    along = (room[0] - oz) / dz
    if along < 0.0:
        along = 0.0
    x, y = ox + along * dx, oy + along * dy
    blur = room[8] * (far + along) / np.sqrt(-dz)
    r, g, b = floor_colour(x, y, room[1], light, room[3], room[4], room[5], blur)
    away = np.sqrt((x - room[6]) ** 2 + (y - room[7]) ** 2)
    haze = smooth_step(0.12, 1.0, away / room[2])
    hr, hg, hb = sky_colour(1.0, 0.0, 0.0)
    return r + haze * (hr - r), g + haze * (hg - g), b + haze * (hb - b)


@device
def lamp_glint(dx, dy, dz, sharpness):
    """Brightness of the lamp seen in direction d (Phong 1975)."""
    cosine = dx * LAMP[0] + dy * LAMP[1] + dz * LAMP[2]
    return max(cosine, 0.0) ** sharpness
