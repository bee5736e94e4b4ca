# SPDX-License-Identifier: Apache-2.0
"""Viscosity: impulses where they are stable, conjugate gradients where the liquid is too thick."""

import numpy as np

from sph_ros.core import relaxation as relax

#: Share of its speed relative to all neighbours that a particle may lose explicitly in a step. A
#: pair takes a share c along its line, so N neighbours all around take N c / dimension; from 1 on
#: they overshoot. Above the first limit the linear part is solved implicitly; the quadratic part
#: is cut at the second.
EXPLICIT_LIMIT, MOST_TAKEN = 0.38, 0.5

TOLERANCE, MOST_ITERATIONS = 1e-4, 100


def apply_viscosity(work, velocities, slope, linear, quadratic, neighbors):
    """Let pairs of neighbours share their velocities.

    Args:
        work: `Workspace` with pairs; its scratch arrays are used.
        velocities: [m/s], (N, 3); changed.
        slope: length of a pair's gradient divided by (1 - r/h) [1/m].
        linear: impulse per relative speed in this step [-].
        quadratic: impulse per squared relative speed in this step [s/m].
        neighbors: (1 - r/h) summed over the neighbours in a lattice, by the dimension [-].
    """
    implicit = linear * neighbors > EXPLICIT_LIMIT
    if quadratic > 0.0 or (linear > 0.0 and not implicit):
        relax.viscous_impulses(
            work.pairs,
            velocities,
            np.float32(slope),
            np.float32(0.0 if implicit else linear),
            np.float32(quadratic),
            np.float32(MOST_TAKEN / neighbors),
            work.scratch,
        )
        velocities[:] = work.scratch
    if implicit:
        solve_implicitly(work, velocities, np.float32(slope), np.float32(linear))


def solve_implicitly(work, velocities, slope, linear):
    """Conjugate gradients for v - impulses(v) = present v, starting from the present v."""
    direction, image, residual = work.cohesive, work.scratch, work.displacements

    def dot(a, b):
        relax.chunk_dots(a, b, work.errors)
        return float(work.errors.sum())

    def apply(v):
        relax.viscous_operator(work.pairs, v, slope, linear, image)

    apply(velocities)
    np.subtract(velocities, image, out=residual)
    direction[:] = residual
    square = dot(residual, residual)
    goal = TOLERANCE**2 * max(dot(velocities, velocities), 1e-30)
    for _ in range(MOST_ITERATIONS):
        if square <= goal:
            break
        apply(direction)
        share = np.float32(square / dot(direction, image))
        velocities += share * direction
        residual -= share * image
        previous, square = square, dot(residual, residual)
        direction *= np.float32(square / previous)
        direction += residual
