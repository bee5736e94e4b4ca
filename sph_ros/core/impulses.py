# SPDX-License-Identifier: Apache-2.0
"""Rigid bodies in touch: impulses that keep them apart, with friction (sequential impulses).

Projected Gauss-Seidel on velocities (Catto 2005, "Iterative dynamics with temporal coherence"): a
touch gives an impulse along its normal until the bodies there part at least as fast as asked, and
one across it within Coulomb's cone. A touch whose gap is still open only demands that the gap does
not close beyond zero within the step, so nothing fast passes through and nothing resting hovers.

Velocities of a body are those of its centre of mass and its rotation: (vx, vy, vz, wx, wy, wz),
world frame.
"""

import math
from typing import NamedTuple

import numpy as np

from sph_ros.core.jit import device, inlined, kernel


class Touches(NamedTuple):
    """Places where free bodies touch something or might within the step; row per touch.

    Attributes:
        first: body that the normal pushes, (K,) int32.
        second: body that is pushed the other way, or -1 where the other side is no free body, (K,).
        point: world frame [m], (K, 3) float64.
        normal: unit vector out of the second into the first, (K, 3).
        gap: between them, negative if they overlap [m], (K,).
        drift: velocity of the other side where it is no free body [m/s], (K, 3).
        friction: coefficient of Coulomb friction [-], (K,).
        restitution: of speed along the normal [-], (K,).
        speed: least speed of parting asked for [m/s], (K,); see `ask_speeds`.
        impulse: given so far [N s], world frame, (K, 3).
    """

    first: np.ndarray
    second: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    gap: np.ndarray
    drift: np.ndarray
    friction: np.ndarray
    restitution: np.ndarray
    speed: np.ndarray
    impulse: np.ndarray


class Inertias(NamedTuple):
    """How free bodies resist being moved, in this step; row per body, float64.

    Attributes:
        centre: of mass, world frame [m], (B, 3).
        inverse_mass: along x, y, z: in 2D none moves along y [1/kg], (B, 3).
        inverse_inertia: about the centre, world frame [1/(kg m^2)], (B, 3, 3).
    """

    centre: np.ndarray
    inverse_mass: np.ndarray
    inverse_inertia: np.ndarray


@inlined
def point_velocity(inertias, velocities, b, px, py, pz):
    """Velocity of the point of body b that is at a world point [m/s]."""
    rx = px - inertias.centre[b, 0]
    ry = py - inertias.centre[b, 1]
    rz = pz - inertias.centre[b, 2]
    v = velocities[b]
    return v[0] + v[4] * rz - v[5] * ry, v[1] + v[5] * rx - v[3] * rz, v[2] + v[3] * ry - v[4] * rx


@inlined
def push_body(inertias, velocities, b, px, py, pz, jx, jy, jz):
    """Change the velocities of body b by an impulse [N s] at a world point."""
    rx = px - inertias.centre[b, 0]
    ry = py - inertias.centre[b, 1]
    rz = pz - inertias.centre[b, 2]
    tx, ty, tz = ry * jz - rz * jy, rz * jx - rx * jz, rx * jy - ry * jx
    m, i = inertias.inverse_mass[b], inertias.inverse_inertia[b]
    velocities[b, 0] += m[0] * jx
    velocities[b, 1] += m[1] * jy
    velocities[b, 2] += m[2] * jz
    velocities[b, 3] += i[0, 0] * tx + i[0, 1] * ty + i[0, 2] * tz
    velocities[b, 4] += i[1, 0] * tx + i[1, 1] * ty + i[1, 2] * tz
    velocities[b, 5] += i[2, 0] * tx + i[2, 1] * ty + i[2, 2] * tz


@inlined
def compliance_along(inertias, b, px, py, pz, nx, ny, nz):
    """Speed along a unit vector per impulse along it, at a world point of body b [1/kg]."""
    rx = px - inertias.centre[b, 0]
    ry = py - inertias.centre[b, 1]
    rz = pz - inertias.centre[b, 2]
    tx, ty, tz = ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx
    m, i = inertias.inverse_mass[b], inertias.inverse_inertia[b]
    wx = i[0, 0] * tx + i[0, 1] * ty + i[0, 2] * tz
    wy = i[1, 0] * tx + i[1, 1] * ty + i[1, 2] * tz
    wz = i[2, 0] * tx + i[2, 1] * ty + i[2, 2] * tz
    return m[0] * nx * nx + m[1] * ny * ny + m[2] * nz * nz + wx * tx + wy * ty + wz * tz


@device
def touch_compliance(touches, k, inertias, nx, ny, nz):
    """`compliance_along` of both sides of touch k together [1/kg]."""
    px, py, pz = touches.point[k, 0], touches.point[k, 1], touches.point[k, 2]
    total = compliance_along(inertias, touches.first[k], px, py, pz, nx, ny, nz)
    if touches.second[k] >= 0:
        total += compliance_along(inertias, touches.second[k], px, py, pz, nx, ny, nz)
    return total


@device
def parting_velocity(touches, k, inertias, velocities):
    """Velocity of the first body against the other side at touch k [m/s]."""
    px, py, pz = touches.point[k, 0], touches.point[k, 1], touches.point[k, 2]
    vx, vy, vz = point_velocity(inertias, velocities, touches.first[k], px, py, pz)
    if touches.second[k] >= 0:
        wx, wy, wz = point_velocity(inertias, velocities, touches.second[k], px, py, pz)
    else:
        wx, wy, wz = touches.drift[k, 0], touches.drift[k, 1], touches.drift[k, 2]
    return vx - wx, vy - wy, vz - wz


@device
def push_both(touches, k, inertias, velocities, jx, jy, jz):
    """Give an impulse [N s] to the first body of touch k and the opposite one to the second."""
    px, py, pz = touches.point[k, 0], touches.point[k, 1], touches.point[k, 2]
    push_body(inertias, velocities, touches.first[k], px, py, pz, jx, jy, jz)
    if touches.second[k] >= 0:
        push_body(inertias, velocities, touches.second[k], px, py, pz, -jx, -jy, -jz)


@kernel
def ask_speeds(touches, count, inertias, velocities, inverse_step, slowest):
    """Write the speed of parting that each touch asks for.

    An open gap may close, but no further; bodies that meet faster than `slowest` bounce.

    Args:
        touches, count: rows 0:count are used; `speed` is written.
        inertias, velocities: of the bodies before they touch.
        inverse_step: 1 / substep [1/s].
        slowest: approach that makes a body bounce [m/s].
    """
    for k in range(count):
        vx, vy, vz = parting_velocity(touches, k, inertias, velocities)
        n = touches.normal[k]
        along = vx * n[0] + vy * n[1] + vz * n[2]
        speed = -max(touches.gap[k], 0.0) * inverse_step
        if along < -slowest and along < speed:
            speed = max(speed, -touches.restitution[k] * along)
        touches.speed[k] = speed


@device
def settle_touch(touches, k, inertias, velocities):
    """One pass over touch k: the impulse along its normal, then friction.

    Returns:
        The largest change of its velocity [m/s].
    """
    n, j = touches.normal[k], touches.impulse[k]
    nx, ny, nz = n[0], n[1], n[2]
    vx, vy, vz = parting_velocity(touches, k, inertias, velocities)
    compliance = touch_compliance(touches, k, inertias, nx, ny, nz)
    if compliance <= 0.0:
        return 0.0
    before = j[0] * nx + j[1] * ny + j[2] * nz
    along = vx * nx + vy * ny + vz * nz
    after = max(before + (touches.speed[k] - along) / compliance, 0.0)
    change = after - before
    push_both(touches, k, inertias, velocities, change * nx, change * ny, change * nz)
    j[0] += change * nx
    j[1] += change * ny
    j[2] += change * nz
    largest = abs(change) * compliance
    if touches.friction[k] <= 0.0 or (after == 0.0 and before == 0.0):
        return largest
    # Across: take the slip out, then shorten the impulse to the cone.
    vx, vy, vz = parting_velocity(touches, k, inertias, velocities)
    along = vx * nx + vy * ny + vz * nz
    sx, sy, sz = vx - along * nx, vy - along * ny, vz - along * nz
    slip = math.sqrt(sx * sx + sy * sy + sz * sz)
    ax, ay, az = j[0] - after * nx, j[1] - after * ny, j[2] - after * nz
    bx, by, bz = ax, ay, az
    if slip > 1e-12:
        sx, sy, sz = sx / slip, sy / slip, sz / slip
        compliance = touch_compliance(touches, k, inertias, sx, sy, sz)
        if compliance > 0.0:
            bx -= slip / compliance * sx
            by -= slip / compliance * sy
            bz -= slip / compliance * sz
    size = math.sqrt(bx * bx + by * by + bz * bz)
    most = touches.friction[k] * after
    if size > most:
        bx, by, bz = bx * most / size, by * most / size, bz * most / size
    dx, dy, dz = bx - ax, by - ay, bz - az
    push_both(touches, k, inertias, velocities, dx, dy, dz)
    j[0] += dx
    j[1] += dy
    j[2] += dz
    return max(largest, math.sqrt(dx * dx + dy * dy + dz * dz) * compliance)


@device
def settle_touches(touches, count, inertias, tolerance, passes, velocities):
    """`keep_apart` as a function of its own for other kernels."""
    for k in range(count):
        j = touches.impulse[k]
        push_both(touches, k, inertias, velocities, j[0], j[1], j[2])
    for _ in range(passes):
        change = 0.0
        for k in range(count):
            change = max(change, settle_touch(touches, k, inertias, velocities))
        if change <= tolerance:
            break


@kernel
def keep_apart(touches, count, inertias, tolerance, passes, velocities):
    """Velocities after the bodies have pushed each other, starting from the impulses known.

    Args:
        touches, count: rows 0:count are used; `impulse` is the first guess and is written.
        inertias: of the bodies.
        tolerance: ends when no touch changes its velocity by more [m/s].
        passes: over all touches at most.
        velocities: without any of the impulses, (B, 6); changed.
    """
    settle_touches(touches, count, inertias, tolerance, passes, velocities)


@kernel
def push_out(touches, count, inertias, velocities, time_step, slack, share, passes, shifts):
    """Displacements that part bodies which still overlap after the step, without giving them speed.

    Args:
        touches, count: as in `keep_apart`; not changed.
        inertias, velocities: of the bodies, after the touches were settled.
        time_step: substep [s].
        slack: overlap that stays [m].
        share: of the rest that is taken away at once [-].
        passes: over all touches.
        shifts: of the bodies [m], [rad], (B, 6); zeros; written.
    """
    wanted, given = np.zeros(count), np.zeros(count)
    any_overlap = False
    for k in range(count):
        vx, vy, vz = parting_velocity(touches, k, inertias, velocities)
        n = touches.normal[k]
        left = touches.gap[k] + time_step * (vx * n[0] + vy * n[1] + vz * n[2])
        wanted[k] = share * max(-left - slack, 0.0)
        any_overlap = any_overlap or wanted[k] > 0.0
    if not any_overlap:
        return
    for _ in range(passes):
        for k in range(count):
            nx, ny, nz = touches.normal[k, 0], touches.normal[k, 1], touches.normal[k, 2]
            compliance = touch_compliance(touches, k, inertias, nx, ny, nz)
            if wanted[k] == 0.0 or compliance <= 0.0:
                continue
            px, py, pz = touches.point[k, 0], touches.point[k, 1], touches.point[k, 2]
            sx, sy, sz = point_velocity(inertias, shifts, touches.first[k], px, py, pz)
            if touches.second[k] >= 0:
                tx, ty, tz = point_velocity(inertias, shifts, touches.second[k], px, py, pz)
                sx, sy, sz = sx - tx, sy - ty, sz - tz
            along = sx * nx + sy * ny + sz * nz
            change = max(given[k] + (wanted[k] - along) / compliance, 0.0) - given[k]
            given[k] += change
            push_both(touches, k, inertias, shifts, change * nx, change * ny, change * nz)
