# SPDX-License-Identifier: Apache-2.0
"""Shadows and caustics on the floor.

Every lit triangle sends samples of the lamp's light along its rays to the floor. A solid takes the
light away; the liquid takes it from where it would have fallen and adds it where the refracted ray
falls (photon splatting after Jensen 1996, one boundary deep). Where waves focus it, the floor gets
brighter.
"""

import numpy as np

from sph_ros.core.jit import bare_kernel, inlined
from sph_ros.render.optics import LAMP, WATER_INDEX, refract

#: Texels along the longer side of the map.
TEXELS = 420

#: Samples along a triangle's edge at most.
MAX_SAMPLES = 1000


def floor_light(surface, solids, particles, radius, floor_z, lower, upper, texels=TEXELS):
    """Lamp light on the floor around the box lower..upper.

    Args:
        surface: (vertices, triangles, normals) of the liquid, or None.
        solids: corners of opaque triangles, world frame [m], (T, 3, 3).
        particles: centres of opaque spheres [m], (N, 3).
        radius: of the spheres [m].
        floor_z: height of the floor [m].
        lower: corner of the box that holds everything [m], (3,).
        upper: opposite corner [m], (3,).
        texels: along the longer side of the map.

    Returns:
        Map (nx, ny) float32 with 1 for full light, its origin (2,) [m] and texels per metre.
    """
    lamp = np.asarray(LAMP)
    drift = -lamp[:2] / lamp[2] * (upper[2] - floor_z)
    border = 0.15 * max(np.linalg.norm(upper - lower), 1e-3)
    low = np.minimum(lower[:2], lower[:2] + drift) - border
    high = np.maximum(upper[:2], upper[:2] + drift) + border
    scale = texels / (high - low).max()
    shape = tuple(np.ceil((high - low) * scale).astype(int) + 2)
    shadow, taken, given = (np.zeros(shape, np.float32) for _ in range(3))
    place = np.array([low[0], low[1], scale, floor_z])
    if len(solids):
        _cast_shadow(np.ascontiguousarray(solids, np.float32), place, shadow)
    if len(particles):
        _cast_discs(particles, radius, place, shadow)
    if surface is not None and len(surface[0]):
        _cast_caustics(*surface, place, taken, given)
    light = (1.0 - np.minimum(shadow, 1.0)) * np.maximum(
        1.0 - np.minimum(taken, 1.0) + 0.92 * given, 0.0
    )
    for _ in range(2):
        light = _blurred(light)
    return np.ascontiguousarray(light, np.float32), low, scale


def _blurred(image):
    """[1 2 1]/4 both ways; the edge repeats."""
    padded = np.pad(image, 1, mode="edge")
    rows = 0.25 * (padded[:-2] + padded[2:]) + 0.5 * padded[1:-1]
    return 0.25 * (rows[:, :-2] + rows[:, 2:]) + 0.5 * rows[:, 1:-1]


@inlined
def _deposit(image, place, x, y, area):
    """Add an area [m^2] of light at floor point (x, y), in units of a fully lit texel."""
    u = (x - place[0]) * place[2] - 0.5
    v = (y - place[1]) * place[2] - 0.5
    if 0.0 <= u < image.shape[0] - 1 and 0.0 <= v < image.shape[1] - 1:
        i, j = int(u), int(v)
        a, b = u - i, v - j
        amount = area * place[2] * place[2]
        image[i, j] += (1.0 - a) * (1.0 - b) * amount
        image[i, j + 1] += (1.0 - a) * b * amount
        image[i + 1, j] += a * (1.0 - b) * amount
        image[i + 1, j + 1] += a * b * amount


@inlined
def _floor_area(points, a, b, c, place):
    """Signed area [m^2] of a triangle's shadow on the floor, positive if lit from outside."""
    sx, sy = LAMP[0] / LAMP[2], LAMP[1] / LAMP[2]
    ux = points[b, 0] - points[a, 0] - sx * (points[b, 2] - points[a, 2])
    uy = points[b, 1] - points[a, 1] - sy * (points[b, 2] - points[a, 2])
    vx = points[c, 0] - points[a, 0] - sx * (points[c, 2] - points[a, 2])
    vy = points[c, 1] - points[a, 1] - sy * (points[c, 2] - points[a, 2])
    return 0.5 * (ux * vy - uy * vx)


@inlined
def _sample_count(area, place):
    """Samples along an edge so that they lie about half a texel apart."""
    return int(min(max(2.0 * np.sqrt(2.0 * area) * place[2], 2.0), MAX_SAMPLES))


@bare_kernel
def _cast_shadow(corners, place, shadow):  # the last is written
    """Shadow of opaque triangles; each is counted from its lit side only."""
    sx, sy = LAMP[0] / LAMP[2], LAMP[1] / LAMP[2]
    for t in range(len(corners)):
        points = corners[t]
        area = _floor_area(points, 0, 1, 2, place)
        if area <= 0.0:
            continue
        n = _sample_count(area, place)
        for i in range(n):
            for j in range(n):
                u, v = (i + 0.5) / n, (j + 0.5) / n
                if u + v > 1.0:  # the square's other half folds onto the triangle
                    u, v = 1.0 - u, 1.0 - v
                w = 1.0 - u - v
                x = w * points[0, 0] + u * points[1, 0] + v * points[2, 0]
                y = w * points[0, 1] + u * points[1, 1] + v * points[2, 1]
                z = w * points[0, 2] + u * points[1, 2] + v * points[2, 2] - place[3]
                _deposit(shadow, place, x - sx * z, y - sy * z, area / (n * n))


@bare_kernel
def _cast_discs(centres, radius, place, shadow):  # the last is written
    """Shadow of small spheres."""
    sx, sy = LAMP[0] / LAMP[2], LAMP[1] / LAMP[2]
    for p in range(len(centres)):
        z = centres[p, 2] - place[3]
        _deposit(
            shadow, place, centres[p, 0] - sx * z, centres[p, 1] - sy * z, 3.0 * radius * radius
        )


@bare_kernel
def _cast_caustics(vertices, triangles, normals, place, taken, given):  # last two are written
    """Light that the liquid's lit side takes from straight rays and gives along refracted ones."""
    sx, sy = LAMP[0] / LAMP[2], LAMP[1] / LAMP[2]
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        area = _floor_area(vertices, a, b, c, place)
        if area <= 0.0:
            continue
        n = _sample_count(area, place) + 1
        share = area / (n * n)
        for i in range(n):
            for j in range(n):
                u, v = (i + 0.5) / n, (j + 0.5) / n
                if u + v > 1.0:
                    u, v = 1.0 - u, 1.0 - v
                w = 1.0 - u - v
                x = w * vertices[a, 0] + u * vertices[b, 0] + v * vertices[c, 0]
                y = w * vertices[a, 1] + u * vertices[b, 1] + v * vertices[c, 1]
                z = w * vertices[a, 2] + u * vertices[b, 2] + v * vertices[c, 2] - place[3]
                nx = w * normals[a, 0] + u * normals[b, 0] + v * normals[c, 0]
                ny = w * normals[a, 1] + u * normals[b, 1] + v * normals[c, 1]
                nz = w * normals[a, 2] + u * normals[b, 2] + v * normals[c, 2]
                s = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz + 1e-20)
                nx, ny, nz = nx * s, ny * s, nz * s
                _deposit(taken, place, x - sx * z, y - sy * z, share)
                if nx * LAMP[0] + ny * LAMP[1] + nz * LAMP[2] > 0.0:
                    rx, ry, rz = refract(-LAMP[0], -LAMP[1], -LAMP[2], nx, ny, nz, WATER_INDEX)
                    if rz < -0.05:
                        _deposit(given, place, x - z * rx / rz, y - z * ry / rz, share)
