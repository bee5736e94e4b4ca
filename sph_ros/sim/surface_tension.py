# SPDX-License-Identifier: Apache-2.0
"""Surface tension of the incompressible solver: its numbers and its passes; see `core.tension`."""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from sph_ros.core import tension as pull
from sph_ros.core.wall_tables import flat_wall
from sph_ros.core.weights import DENSITY_POWER, POLY6, lattice_sum, radial_weight

#: Of the energy: colour from which on nothing is lacking, and gradients times the spacing that
#: hardly count. Two layers under a lattice's surface more than the first is there.
FULL, BLUR = 0.95, 0.05

#: Area and cohesion, a and b of the energy in units of surface tension / spacing, over h / spacing;
#: by dimension. Measured by benchmarks/calibrate_tension.py: energy and pressure of a drop at rest.
#: In three dimensions 2.5 and 3.0 are not: those of 2.0 stand for them.
SHARES = {
    2: ((1.6, 2.721, 4.554), (2.0, 2.754, 3.966), (2.5, 2.992, 3.071), (3.0, 2.955, 2.841)),
    3: ((1.6, 2.422, 6.344), (2.0, 2.462, 5.904), (2.5, 2.462, 5.904), (3.0, 2.462, 5.904)),
}

#: Share of the density gradient at a lattice's surface from which on a particle marks a surface.
MARK = 0.35

#: Share of the weight's pressure below which surface tension is left out; see `noticeable`.
LEAST_PRESSURE = 0.125

#: Rows of the table of the walls' colour.
ROWS = 65


@dataclass(frozen=True)
class TensionScales:
    """Numbers for a surface tension of 1 N/m.

    Attributes:
        law: the energy.
        hold: energy of full adhesion per volume and density of the wall [Pa per N/m].
        mark: density gradient that marks a surface [1/m].
        walls: colour of a flat wall at distances from 0 to H / 2 [-], (ROWS,) float32.
    """

    law: pull.Law
    hold: float
    mark: float
    walls: np.ndarray


def tension_scales(support_radius, spacing, dimension, power=DENSITY_POWER):
    """Numbers of the surface tension at one spacing, `TensionScales`.

    Args:
        support_radius: h [m].
        spacing: [m].
        dimension: 2 or 3.
        power: of the density's weight (1 - r/h)^power.
    """
    h, s, d = support_radius, spacing, dimension
    reach = pull.CELLS * h
    area, cohesion = shares(d, h / s)
    away = np.linspace(0.0, 0.5 * reach, ROWS)
    walls = flat_wall(away, reach, s, d, mirrored=True, weights=(POLY6,))[:, 0]
    # A lattice's first layer, half a spacing from the wall, has all the energy of adhesion.
    held = float(flat_wall(0.5 * s, h, s, d, mirrored=True, weights=(power,))[0])
    numbers = (reach, 1.0 / lattice_sum(POLY6, reach, s, d), s, area, cohesion, BLUR, FULL)
    return TensionScales(
        law=pull.Law(*(np.float32(x) for x in numbers)),
        hold=1.0 / (s * held),
        mark=MARK * surface_gradient(power, h, s, d),
        walls=walls.astype(np.float32),
    )


def noticeable(material, scene):
    """Whether the scene's particles can show the surface tension of a material at all.

    The most curved surface that is resolved, of radius h, presses with 2 gamma / h. Where that is
    less than `LEAST_PRESSURE` of the weight of a layer as thick, rho g h, it is left out: an eighth
    means that h is more than four capillary lengths.
    """
    g, h = math.hypot(*scene.gravity), scene.support_radius
    return 2.0 * material.surface_tension > LEAST_PRESSURE * material.density * g * h**2


def ripple_step(material, spacing):
    """Longest step that the shortest ripples bear [s] (Brackbill, Kothe & Zemach 1992).

    They take the mean density of both sides of the surface, here it is the liquid's: a step twice
    as long still is stable, but noisy. Walls that hold the liquid do so within half a spacing.
    """
    hold = 1.0 + 2.0 * max(2.0 * material.adhesion - 1.0, 0.0)
    return math.sqrt(
        material.density * spacing**3 / (2 * math.pi * hold * material.surface_tension)
    )


def shares(dimension, ratio):
    """Area and cohesion of the energy for a ratio h / spacing [-]."""
    ratios, *columns = zip(*SHARES[dimension], strict=True)
    return tuple(float(np.interp(ratio, ratios, column)) for column in columns)


def surface_gradient(power, support_radius, spacing, dimension):
    """Gradient of the density in the outermost layer of a lattice [1/m]."""
    total = math.fsum(
        power * (1.0 - r / support_radius) ** (power - 1) * height * spacing / r / support_radius
        for w, r, height in _weights(power, support_radius, spacing, dimension)
        if height > 0
    )
    return total / lattice_sum(power, support_radius, spacing, dimension)


def _weights(weight, support_radius, spacing, dimension):
    """(weight, distance [m], height in layers) of the lattice points within the support."""
    reach = math.ceil(support_radius / spacing)
    for offset in itertools.product(range(-reach, reach + 1), repeat=dimension):
        r = spacing * math.sqrt(sum(c * c for c in offset))
        if r < support_radius:
            yield float(radial_weight(weight, r / support_radius)), r, offset[-1]


class SurfaceTension:
    """The passes, with memory for what they find."""

    def __init__(self, scene, power):
        """Args: the scene, power of the density's weight."""
        self.scales = tension_scales(scene.support_radius, scene.spacing, scene.dimension, power)
        self._fit(0)

    def _fit(self, count):
        self._marks, self._spread = np.zeros(count, np.uint8), np.zeros(count, np.uint8)
        self._before = np.zeros(count + 1, np.int64)
        self.pulls = pull.Pulls(
            np.ones(count, np.float32),
            np.zeros(count, np.float32),
            np.zeros((3, count), np.float32),
            np.zeros((count, 3, 3), np.float32),
            np.full((count, 3), -1, np.int32),
            np.zeros((count, 3), np.float32),
        )

    def displace(self, work, grid, motion, material, mass, time_step):
        """Displacements in a step into `work.cohesive`, and the reactions of solids.

        Args:
            work: `Workspace` with neighbours, sums and contacts of the present positions.
            grid: that the neighbours were found with.
            motion: of the solids.
            material: for surface tension and adhesion.
            mass: of a particle [kg].
            time_step: [s].
        """
        if len(self._marks) != work.count:
            self._fit(work.count)
        scales, law = self.scales, self.scales.law
        unit = material.surface_tension * time_step**2 / material.density
        # Walls that the liquid avoids are less of a mirror, those that it seeks hold it.
        mirror = min(2.0 * material.adhesion, 1.0)
        self._find(work, grid, len(motion.position) > 0, mirror)
        pull.tension_displacements(
            work.columns,
            grid,
            law,
            self._marks,
            self._before,
            self.pulls,
            np.float32(unit / float(law.spacing)),
            work.cohesive,
        )
        if len(motion.position):
            pull.wall_tension(
                work.predicted,
                work.contacts,
                motion,
                law,
                np.float32(mirror * unit / float(law.spacing)),
                np.float32(max(2.0 * material.adhesion - 1.0, 0.0) * scales.hold * unit),
                scales.walls,
                np.float32(unit / float(law.spacing)),
                self.pulls,
                np.float32(mass / time_step**2),
                work.cohesive,
                work.reactions,
            )

    def _find(self, work, grid, solids, mirror):
        """Which particles are near a surface, and what pulls at them."""
        marks, spread = self._marks, self._spread
        pull.mark_surface(
            work.sums,
            work.contacts.gradients,
            np.float32(mirror),
            np.float32(self.scales.mark),
            marks,
        )
        # The gradient of the colour goes two layers deeper than that of the density.
        pull.spread_marks(work.pairs, marks, spread)
        pull.spread_marks(work.pairs, spread, marks)
        np.cumsum(marks, out=self._before[1:])
        pull.find_pulls(
            work.columns,
            work.predicted,
            grid,
            self.scales.law,
            marks,
            solids,
            np.float32(mirror),
            work.pairs,
            work.contacts,
            self.scales.walls,
            self.pulls,
        )
