# SPDX-License-Identifier: Apache-2.0
"""Where rigid bodies touch each other and the other solids.

Samples on the surface of one solid are looked up in the signed distance of another. A sample may
have a radius: a ball is one sample, so it rolls on a ball and not on a polyhedron. Of the samples
of a pair that are near enough, a few that lie far from each other, or face different ways, are
kept: a box on a floor keeps its corners.
"""

from typing import NamedTuple

import numpy as np

from sph_ros.core.contact_data import rotate, to_solid, to_world
from sph_ros.core.distances import normal_called
from sph_ros.core.jit import device, kernel

#: Touches of one pair of solids at most, and candidates they are chosen from.
MOST_TOUCHES, MOST_CANDIDATES = 8, 4096

#: A flat sample touches only what faces it: cosine between the two outward normals. Without this
#: the top of a box, at the rim of another that lies on it, would touch that one's side.
_OPPOSED = -0.1
#: A round sample touches only where the other's normal faces its centre: the same with a probe.
_FACING = -0.94
#: Two touches of a round sample have normals that differ by more than this cosine.
_ALIKE = 0.8


class Samples(NamedTuple):
    """Points on the surfaces of the solids.

    Attributes:
        start: samples of solid s are start[s]:start[s + 1], (S + 1,) int64.
        point: in the solid's frame [m], (P, 3) float32.
        normal: out of the solid there; 0 for round samples and those of sheets, which have two
            sides, (P, 3) float32.
        radius: of the ball about the point that belongs to the solid [m], (P,) float32.
        probe: unit vectors all around, (Q, 3) float32; in 2D all around in the plane.
    """

    start: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    radius: np.ndarray
    probe: np.ndarray


class Places(NamedTuple):
    """Poses of all solids when the step began, and how far they may get in it.

    Attributes:
        position: origins, world frame [m], (S, 3) float32.
        rotation: world from solid, (S, 3, 3) float32.
        body: which free body a solid is, or -1, (S,) int32.
        reach: the farthest a point of it may move in the step [m], (S,) float64.
    """

    position: np.ndarray
    rotation: np.ndarray
    body: np.ndarray
    reach: np.ndarray


@device
def keep_candidate(found, count, sample, x, y, z, nx, ny, nz, gap):
    """Append a candidate if there is room; returns how many there are now."""
    if count < found.shape[0]:
        found[count, 0], found[count, 1], found[count, 2] = x, y, z
        found[count, 3], found[count, 4], found[count, 5] = nx, ny, nz
        found[count, 6] = gap
        found[count, 7] = sample
        return count + 1
    return count


@device
def candidates_of_ball(shapes, samples, places, other, sample, x, y, z, reach, found, count):
    """Touches of a round sample about a world point with another solid.

    The distance at the centre tells only the nearest wall; in a corner there are three. So points
    all around on the ball are looked up too: where the wall's normal faces the centre it touches.
    """
    rotation, position = places.rotation, places.position
    radius, probe = samples.radius[sample], samples.probe
    lx, ly, lz = to_solid(rotation, position, other, x, y, z)
    distance, nx, ny, nz = normal_called(shapes, other, lx, ly, lz)
    if distance - radius >= reach:
        return count
    first = count
    wx, wy, wz = rotate(rotation, other, nx, ny, nz)
    px, py, pz = x - radius * wx, y - radius * wy, z - radius * wz
    count = keep_candidate(found, count, sample, px, py, pz, wx, wy, wz, distance - radius)
    for q in range(probe.shape[0]):
        ux, uy, uz = probe[q, 0], probe[q, 1], probe[q, 2]
        d, nx, ny, nz = normal_called(
            shapes, other, lx + radius * ux, ly + radius * uy, lz + radius * uz
        )
        facing = nx * ux + ny * uy + nz * uz
        gap = d - radius * (np.float32(1.0) + facing)
        if facing > _FACING or gap >= reach:
            continue
        wx, wy, wz = rotate(rotation, other, nx, ny, nz)
        known = False
        for k in range(first, count):
            known |= found[k, 3] * wx + found[k, 4] * wy + found[k, 5] * wz > _ALIKE
        if not known:
            px, py, pz = x - radius * wx, y - radius * wy, z - radius * wz
            count = keep_candidate(found, count, sample, px, py, pz, wx, wy, wz, gap)
    return count


@device
def candidates_of_pair(shapes, samples, places, own, other, reach, found):
    """Samples of solid `own` near solid `other`, world frame; how many."""
    count = 0
    # Where the ball around the other solid's material is, seen from this one.
    bx, by, bz = shapes.bounds[other, 0], shapes.bounds[other, 1], shapes.bounds[other, 2]
    cx, cy, cz = to_world(places.rotation, places.position, other, bx, by, bz)
    ball = shapes.bounds[other, 3] + reach
    for p in range(samples.start[own], samples.start[own + 1]):
        point, radius = samples.point[p], samples.radius[p]
        x, y, z = to_world(places.rotation, places.position, own, point[0], point[1], point[2])
        far = (x - cx) * (x - cx) + (y - cy) * (y - cy) + (z - cz) * (z - cz)
        if far > (ball + radius) * (ball + radius):
            continue
        if radius > np.float32(0.0):
            count = candidates_of_ball(
                shapes, samples, places, other, p, x, y, z, reach, found, count
            )
            continue
        lx, ly, lz = to_solid(places.rotation, places.position, other, x, y, z)
        distance, nx, ny, nz = normal_called(shapes, other, lx, ly, lz)
        if distance >= reach:
            continue
        wx, wy, wz = rotate(places.rotation, other, nx, ny, nz)
        out = samples.normal[p]
        ox, oy, oz = rotate(places.rotation, own, out[0], out[1], out[2])
        two_sided = out[0] == 0.0 and out[1] == 0.0 and out[2] == 0.0
        if two_sided or ox * wx + oy * wy + oz * wz < _OPPOSED:
            count = keep_candidate(found, count, p, x, y, z, wx, wy, wz, distance)
    return count


@device
def choose(found, count, size, reach, chosen, away):
    """The deepest candidate, then again and again the one farthest from those chosen.

    Where candidates are alike but for rounding the first is taken, so that the choice of one step
    is that of the next.

    Args:
        found: candidates.
        count: how many.
        size: length over which places count as different as opposite normals [m].
        reach: gap at which a candidate hardly matters [m].
        chosen: (MOST_TOUCHES,) int64; written.
        away: scratch, (>= count,).

    Returns:
        How many were chosen.
    """
    best = 0
    for k in range(count):
        away[k] = np.inf
        if found[k, 6] < found[best, 6] - 0.01 * reach:
            best = k
    number = 0
    while number < min(count, chosen.shape[0]):
        chosen[number] = best
        number += 1
        farthest = 0.0
        last = best
        for k in range(count):
            apart = 0.0
            for axis in range(3):
                step = (found[k, axis] - found[last, axis]) / size
                turn = found[k, 3 + axis] - found[last, 3 + axis]
                apart += step * step + turn * turn
            away[k] = min(away[k], apart)
            weight = 1.0 - 0.9 * min(max(found[k, 6] / reach, 0.0), 1.0)
            if away[k] * weight > 1.02 * farthest:
                farthest, best = away[k] * weight, k
        if farthest < 1e-3:
            break
    return number


@kernel
def find_touches(shapes, samples, places, room):
    """Touches between free bodies and all solids.

    Args:
        shapes: packed shapes of the S solids.
        samples: of all solids.
        places: of all solids.
        room: for so many touches; more are left out.

    Returns:
        count, solids (room, 2) int32: first and second as solids; numbers (room, 8): point and
        normal in the world frame, gap, sample.
    """
    solids = np.empty((room, 2), np.int32)
    numbers = np.empty((room, 8))
    found = np.empty((MOST_CANDIDATES, 8))
    away = np.empty(MOST_CANDIDATES)
    chosen = np.empty(MOST_TOUCHES, np.int64)
    total = 0
    for own in range(places.body.shape[0]):
        for other in range(places.body.shape[0]):
            if own == other or (places.body[own] < 0 and places.body[other] < 0):
                continue
            reach = places.reach[own] + places.reach[other]
            count = candidates_of_pair(shapes, samples, places, own, other, reach, found)
            size = max(min(shapes.bounds[own, 3], shapes.bounds[other, 3]), 1e-9)
            number = choose(found, count, size, reach, chosen, away)
            # Normals point into the first, which has to be free.
            flip = places.body[own] < 0
            for c in range(min(number, room - total)):
                solids[total, 0] = other if flip else own
                solids[total, 1] = own if flip else other
                for column in range(8):
                    numbers[total, column] = found[chosen[c], column]
                if flip:
                    for column in range(3, 6):
                        numbers[total, column] *= -1.0
                total += 1
    return total, solids, numbers


@kernel
def drift_of_others(places, position, rotation, inverse_step, solids, numbers, drift):
    """Velocity of the second solid's surface at each touch, from its way in this step.

    Args:
        places: poses at the start of the step.
        position, rotation: of all solids at its end, as in `Places`.
        inverse_step: 1 / substep [1/s].
        solids, numbers: from `find_touches`, (K, 2) and (K, 8).
        drift: [m/s], (K, 3); written.
    """
    for k in range(solids.shape[0]):
        s = solids[k, 1]
        x, y, z = numbers[k, 0], numbers[k, 1], numbers[k, 2]
        lx, ly, lz = to_solid(places.rotation, places.position, s, x, y, z)
        wx, wy, wz = to_world(rotation, position, s, lx, ly, lz)
        drift[k, 0] = (wx - x) * inverse_step
        drift[k, 1] = (wy - y) * inverse_step
        drift[k, 2] = (wz - z) * inverse_step
