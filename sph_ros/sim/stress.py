# SPDX-License-Identifier: Apache-2.0
"""Pressure as the force through a surface: the virial of all pairs.

What solvers iterate on are multipliers that stand for the pressure of a lattice at rest. Liquid
that has flowed is packed otherwise and transmits less by the same numbers, some 12 % in three
dimensions, so the pressure that people can compare with rho g z is summed from the forces

    p_i = 1 / (2 d V) sum over j of r_ij f_ij          (Irving & Kirkwood 1950)

with f the force along a pair and V the volume of a particle. Where solids fill a part of the
support, the liquid's part is taken for the whole.
"""

import itertools
import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sph_ros.core.pair_sums import STEPS
from sph_ros.core.vector import LANES


class Weights(NamedTuple):
    """How pressures act along pairs.

    Attributes:
        support_radius: h [m].
        power: of the density's weight (1 - r/h)^power.
        slope: length of a pair's gradient divided by (1 - r/h)^(power - 1) [1/m].
        near_ratio: near gradient per gradient and (1 - r/h) [-].
        virial: nominal pressure that transmits 1 Pa [Pa]: that of the lattice.
        walls: share of the virial that lies in a wall, per share of the density [-].
        dimension: 2 or 3.
    """

    support_radius: float
    power: int
    slope: float
    near_ratio: float
    virial: float
    walls: float
    dimension: int


def virial_pressures(work, weights, pressures, near_pressures):
    """Pressure at every particle [Pa], (N,) float32, in the order of the rows.

    Args:
        work: `Workspace` with pairs, sums and contacts of the present positions.
        weights: `Weights`.
        pressures: nominal, all that act by the gradient of the density [Pa], (N,).
        near_pressures: nominal, those that act by the gradient of the near-density [Pa], (N,).
    """
    rows, js, us = pair_lists(work.pairs)
    both = pressures[rows] + pressures[js]
    both += weights.near_ratio * us * (near_pressures[rows] + near_pressures[js])
    arms = weights.slope * us ** (weights.power - 1) * weights.support_radius * (1.0 - us)
    total = np.bincount(rows, weights=arms * both, minlength=len(pressures))
    share = work.contacts.density[:, 0] / np.maximum(work.sums.density, 1e-6)
    share = np.clip(weights.walls * share, 0.0, 0.9)
    total /= 2 * weights.dimension * weights.virial * (1.0 - share)
    return total.astype(np.float32)


@lru_cache(maxsize=16)
def walls_share(power, support_radius, spacing, dimension):
    """Share of the virial in the layers behind a flat wall per share of the density there [-].

    Of the lattice, half a spacing from the wall: sums of (1 - q)^(power - 1) r against those of
    (1 - q)^power.
    """
    reach = math.ceil(support_radius / spacing)
    below, whole = np.zeros(2), np.array([0.0, 1.0])
    for offset in itertools.product(range(-reach, reach + 1), repeat=dimension):
        q = math.hypot(*offset) * spacing / support_radius
        if 0.0 < q < 1.0:
            both = np.array([(1 - q) ** (power - 1) * q, (1 - q) ** power])
            whole += both
            below += both * (offset[-1] < 0)
    shares = below / whole
    return float(shares[0] / shares[1])


def pair_lists(pairs):
    """All pairs, each from both sides: row (M,), neighbour (M,), 1 - r/h (M,)."""
    counts = (pairs.end - pairs.start) // LANES
    rows = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    places = pairs.start[rows] + LANES * number
    return rows, pairs.neighbors[places].astype(np.int64), pairs.nearness[places] / STEPS
