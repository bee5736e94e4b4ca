# SPDX-License-Identifier: Apache-2.0
"""Wall weights tabulated over the distance to a solid (Harada, Koshizuka & Kawaguchi 2007).

A solid stands for liquid at rest that is not simulated: its share of a particle's density is what
lattice particles in its place would add, divided by the sum over the full lattice (`weights`).
There are two readings of a flat wall:

* covered: lattice layers parallel to it at the depths (k + 1/2) spacing, wherever the particle is;
* mirrored: the layers mirror the liquid's, so they lie 2 d + k spacing away from a particle at the
  distance d.

Half a spacing from the wall, where a liquid at rest has its first layer, both are the same. But the
slope of the second is twice as large there, and that matters: pressure times slope is what pushes
particles off. A push by the covered share is half of what a layer of liquid gives, so the first
layer is pressed onto the wall; doubling the push instead (a wall particle with the pressure of the
particle it touches) has no potential and keeps a tank boiling. So walls push by the mirrored share;
the covered one says how far a solid reaches sideways, at edges.

For balls and cylinders the flat share is multiplied by the ratio of two continuous integrals of
Clavet's weights, over the round solid and over the half space at the same distance.

Every table has the columns density and near-density (or what stands for them, see `POWERS`) and
covers the distances -h ... h in equal steps; beyond h a wall adds nothing, deeper than -h its share
is `full_cover`.
"""

import functools
import math

import numpy as np

from sph_ros.core.weights import (
    DENSITY_POWER,
    NEAR_POWER,
    POLY6,
    SMOOTH_POWER,
    lattice_sum,
    radial_weight,
)

#: The two weights that walls are tabulated for: Clavet's, and those of Mueller et al. 2003.
POWERS = (DENSITY_POWER, NEAR_POWER)
POLY6_AND_SPIKY = (POLY6, NEAR_POWER)

#: Steps of a table from -h to h; linear interpolation is then wrong by less than 1e-4.
TABLE_STEPS = 1024

#: Walls act as if they were so many spacings nearer to liquid whose density has the third power in
#: three dimensions. Flowed liquid lies closer to a wall than the lattice that the shares are made
#: for: without this its density, counted one spacing from a plane wall, was 1.1 % too large there.
NEARER = 0.03

# Both integrals of the ratio vanish towards h; from here on the last good ratio is kept.
_LAST_GOOD_RATIO = 0.95
_QUADRATURE_STEPS = 1000


def distances(support_radius):
    """The distances [m] of the rows of every table, (TABLE_STEPS + 1,)."""
    return np.linspace(-support_radius, support_radius, TABLE_STEPS + 1)


def layer_weight(weight, height, support_radius, spacing, dimension):
    """What one infinite lattice layer adds at a height above it, mean over all places [-].

    3D: (2 pi / s^2) integral of the weight times r dr from the height to h; 2D: (1/s) integral of
    the weight along the line.

    Args:
        weight: p of the weight (1 - r/h)^p, or POLY6.
        height: distance from the layer [m], any shape.
        support_radius: h [m].
        spacing: s of the lattice [m].
        dimension: 2 or 3.
    """
    q = np.minimum(np.abs(height) / support_radius, 1.0)
    if dimension == 3:
        rest = 1.0 - q
        if weight == POLY6:
            radial = (1.0 - q * q) ** 4 / 8.0
        else:
            radial = rest ** (weight + 1) / (weight + 1) - rest ** (weight + 2) / (weight + 2)
        return 2.0 * math.pi * (support_radius / spacing) ** 2 * radial
    nodes, node_weights = np.polynomial.legendre.leggauss(48)
    half_chord = np.sqrt(1.0 - q * q)[..., None]
    along = 0.5 * half_chord * (nodes + 1.0)
    r = np.sqrt(q[..., None] ** 2 + along**2)
    integral = (0.5 * half_chord * node_weights * radial_weight(weight, r)).sum(axis=-1)
    return 2.0 * support_radius / spacing * integral


def flat_wall(distance, support_radius, spacing, dimension, mirrored, weights=POWERS):
    """Share of the rest density that a flat wall adds at a signed distance [-], (..., 2).

    It never grows with the distance: where the sum of layers ripples deep inside the wall, its
    largest value farther out is kept. Both readings reach the same share deep inside.

    Args:
        distance: to the wall [m], negative inside, any shape.
        support_radius: h [m].
        spacing: s of the lattice [m].
        dimension: 2 or 3.
        mirrored: which of the two readings (see above).
        weights: of the two columns.
    """
    distance = np.asarray(distance, dtype=float)
    settings = (support_radius, spacing, dimension, mirrored)
    curves = [_flat_curve(weight, *settings) for weight in weights]
    return np.stack([np.interp(distance, *curve, right=0.0) for curve in curves], axis=-1)


@functools.lru_cache(maxsize=32)  # in 2D a quarter of a second, and a scene asks ten times
def _flat_curve(weight, support_radius, spacing, dimension, mirrored):
    """Distances [m] and the shares there that `flat_wall` takes its values from, (F,) each."""
    settings = (support_radius, spacing, dimension)
    fine = np.linspace(-support_radius, support_radius, 8 * TABLE_STEPS + 1)
    layers = np.arange(int(math.ceil(4.0 * support_radius / spacing)) + 1)
    covered = fine[:, None] + (layers + 0.5) * spacing
    height = 2.0 * fine[:, None] + layers * spacing if mirrored else covered
    full = lattice_sum(weight, *settings)
    terms = layer_weight(weight, height, *settings)
    share = np.maximum.accumulate(terms.sum(axis=1)[::-1])[::-1] / full
    deepest = layer_weight(weight, covered[0], *settings).sum() / full
    return fine, np.minimum(share, deepest)


def flat_wall_laplacian(share, support_radius, spacing, dimension):
    """Laplacian of the poly6 colour of a flat wall where its share is as given [1/m^2].

    The wall stays where it is (its layers at the mirrored places), so this is the second derivative
    of the layers' weights, by differences.

    Args:
        share: of the rest density that the wall adds [-], any shape.
        support_radius: h [m].
        spacing: s of the lattice [m].
        dimension: 2 or 3.
    """
    settings = (support_radius, spacing, dimension)
    away = np.linspace(support_radius, 0.0, 513)
    shares = flat_wall(away, *settings, mirrored=True, weights=POLY6_AND_SPIKY)[:, 0]
    heights = 2.0 * away[:, None] + np.arange(int(2.0 * support_radius / spacing) + 1) * spacing
    step = 1e-3 * support_radius
    above, here, below = (
        layer_weight(POLY6, heights + shift, *settings).sum(axis=1) for shift in (step, 0.0, -step)
    )
    laplacian = (above - 2.0 * here + below) / step**2 / lattice_sum(POLY6, *settings)
    return np.interp(share, shares, laplacian)


def _shells(support_radius):
    """Midpoints of thin shells around the particle [m]."""
    return (np.arange(_QUADRATURE_STEPS) + 0.5) * (support_radius / _QUADRATURE_STEPS)


def _shell_weights(power, r, support_radius, dimension, cylinder):
    """Weight times measure of shells of radius r; for a cylinder of a section, summed along."""
    if cylinder:
        weight = layer_weight(power, r, support_radius, 1.0, 2)
        return weight * r
    return (1.0 - r / support_radius) ** power * r ** (dimension - 1)


def _share_inside(cosine, dimension):
    """Share of a shell beyond the cone angle: of a sphere (3D) or a circle (2D)."""
    cosine = np.clip(cosine, -1.0, 1.0)
    return 0.5 * (1.0 - cosine) if dimension == 3 else np.arccos(cosine) / math.pi


def flat_integral(distance, support_radius, dimension, cylinder=False):
    """Integral of the weight over a half space at a signed distance, arbitrary unit, (..., 2)."""
    r = _shells(support_radius)
    section = 2 if cylinder else dimension
    share = _share_inside(np.asarray(distance, dtype=float)[..., None] / r, section)
    return np.stack(
        [
            (share * _shell_weights(p, r, support_radius, dimension, cylinder)).mean(axis=-1)
            for p in POWERS
        ],
        axis=-1,
    )


def round_ratio(distance, radius, support_radius, dimension, cylinder=False, inverted=False):
    """How much more or less than a flat wall a round one adds at one distance, (..., 2).

    Args:
        distance: to the surface [m], negative in the material.
        radius: of the ball or the (infinite) cylinder [m].
        support_radius: h [m].
        dimension: 2 or 3; a ball in 2D is a disc.
        cylinder: an infinite cylinder instead of a ball (3D only).
        inverted: the material is outside the ball or cylinder.
    """
    section = 2 if cylinder else dimension
    last_good = _LAST_GOOD_RATIO * support_radius
    nearest = -support_radius if inverted else -radius
    farthest = min(last_good, radius) if inverted else last_good
    d = np.clip(np.asarray(distance, dtype=float), nearest, farthest)
    r = _shells(support_radius)
    to_centre = np.maximum(radius - d if inverted else radius + d, 1e-6 * support_radius)[..., None]
    share = _share_inside((to_centre**2 + r**2 - radius**2) / (2.0 * to_centre * r), section)
    share = 1.0 - share if inverted else share
    columns = [
        (share * _shell_weights(p, r, support_radius, dimension, cylinder)).mean(axis=-1)
        for p in POWERS
    ]
    return np.stack(columns, axis=-1) / flat_integral(d, support_radius, dimension, cylinder)


@functools.lru_cache(maxsize=64)
def _round_curve(radius, support_radius, *settings):
    """`round_ratio` at the distances of a table, (TABLE_STEPS + 1, 2)."""
    return round_ratio(distances(support_radius), radius, support_radius, *settings)


class WallTables:
    """Collects the tables a set of solids needs, each once.

    Attributes:
        full_cover: share of the rest density deep inside a wall, density and near-density, (2,).
    """

    def __init__(self, support_radius, spacing, dimension, weights=POWERS):
        self.weights = weights
        self.support_radius = support_radius
        self.spacing = spacing
        self.dimension = dimension
        # Ratios of round walls are those of the weights that they are known for.
        self.columns = [
            POWERS.index(weight) if weight in POWERS else column
            for column, weight in enumerate(weights)
        ]
        smooth = weights[0] == SMOOTH_POWER and dimension == 3
        self._nearer = NEARER * spacing if smooth else 0.0
        self._index = {}
        self._tables = []
        self._distances = distances(support_radius)
        self._flat = {mirrored: self.flat(self._distances, mirrored) for mirrored in (True, False)}
        self.full_cover = self._flat[False][0].copy()
        self._add("mirrored", self._flat[True])
        self._add("covered", self._flat[False])

    def flat(self, distance, mirrored=True):
        """Share that a flat wall adds at the distances [m], (..., 2)."""
        settings = (self.support_radius, self.spacing, self.dimension)
        return flat_wall(distance - self._nearer, *settings, mirrored, self.weights)

    def ball(self, radius, inverted):
        """Index of the table of a ball (2D: a disc) of this radius [m]."""
        return self._round(radius, inverted, cylinder=False)

    def cylinder(self, radius, inverted, mirrored=True):
        """Index of the table of an infinite cylinder; in 2D of the strip between its two sides."""
        if self.dimension == 3:
            return self._round(radius, inverted, cylinder=True, mirrored=mirrored)
        near = self._flat[True]
        if inverted:
            far = self.flat(2.0 * radius - self._distances)
            share = 1.0 - (1.0 - near) * (1.0 - far)
        else:
            # The mirrored distance counts twice: half the thickness.
            share = near - self.flat(self._distances + radius)
        return self._add(("strip", radius, inverted), share)

    def _round(self, radius, inverted, cylinder, mirrored=True):
        key = ("round", radius, inverted, cylinder, mirrored)
        if key in self._index:
            return self._index[key]
        ratio = _round_curve(radius, self.support_radius, self.dimension, cylinder, inverted)
        ratio = ratio[:, self.columns]
        return self._add(key, np.minimum(self._flat[mirrored] * ratio, self.full_cover))

    def _add(self, key, table):
        if key not in self._index:
            table[-1] = 0.0
            self._index[key] = len(self._tables)
            self._tables.append(table)
        return self._index[key]

    def stacked(self):
        """All tables, (T, TABLE_STEPS + 1, 2) float32."""
        return np.ascontiguousarray(np.stack(self._tables), dtype=np.float32)
