# SPDX-License-Identifier: Apache-2.0
"""What a film of one or two layers of particles between two walls lacks of the rest density.

A film of N particles per area in a gap D holds its density at 1 as N follows D, and by virtual work
it then pushes the walls apart with d ln N / d ln D times the pressure p beside it. In a liquid N is
proportional to D. Particles between flat walls come in layers: while a layer has to leave, N falls
by more than D does, and the walls feel up to 1.5 p where there are two layers, 2 p and more where
there is one (the structural forces that thin films of molecules have, Israelachvili 2011, ch. 15).
Nothing drains such a film; a boat that weighs less than 0.5 p under water never comes down on it.

So a particle that sees two walls which face each other gets a share more or less of the density,
which depends on their gap alone: as much as makes N proportional to D. How dense a film is at a
given N and D follows from the places that its particles take: two layers, each the other one's
holes, as far apart and with meshes as long as makes it the least dense. N by this is within three
per cent of what a plate that comes down on a floor finds, from 2.7 spacings to 0.8 (h = 2
spacings, three dimensions).
"""

import functools
import math

import numpy as np

from sph_ros.core.wall_tables import WallTables
from sph_ros.core.weights import lattice_sum, radial_weight

#: Steps of the table.
FILM_STEPS = 64

#: Films thinner than this are as dense as their particles make them, and hold what lies on them
#: [spacings]. Nearly empty ones could not pass on the pressure of the liquid beside them: a float
#: pressed on the floor would be held there, and the last particles in a wedge would boil.
THINNEST = 0.7

#: Films end between these gaps [spacings]: where there are two layers that just fill it.
_WIDEST = np.linspace(2.0, 2.5, 9)

#: Length over width of the meshes of a layer, from squares to those of a hexagonal one (3D).
_MESHES = np.linspace(1.0, math.sqrt(3.0), 5)

#: Places of a layer between its wall and the middle of the gap.
_PLACES = 24


def _density(wall, power, ratio, dimension, particles, gaps):
    """Least mean density of films, (G,).

    Args:
        wall: share of the density that a wall adds, a function of distances.
        power: of the density's weight.
        ratio: support radius h.
        dimension: 2 or 3.
        particles: per area, (G,).
        gaps: between the walls, (G,).

    All lengths are in spacings.
    """

    def sums(square):
        q = np.minimum(np.sqrt(square) / ratio, 1.0)
        return radial_weight(power, q).sum(axis=-1)

    reach = math.ceil(2.0 * ratio)
    steps = np.arange(-reach, reach + 1.0)
    if dimension == 3:
        x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
        meshes = _MESHES[:, None, None]
    else:
        x, y, meshes = steps, 0.0 * steps, np.ones((1, 1, 1))
    # Axes: mesh, gap, place, particle of the lattice.
    each = np.maximum(0.5 * particles, 1e-9)[:, None]
    length = np.sqrt(meshes / each) if dimension == 3 else 1.0 / each[None]
    width = length / meshes
    shift = 0.5 if dimension == 3 else 0.0
    own = sums((x * length) ** 2 + (y * width) ** 2)
    place = np.linspace(0.0, 0.5, _PLACES) * gaps[:, None]
    other = ((x + 0.5) * length) ** 2 + ((y + shift) * width) ** 2
    apart = (gaps[:, None] - 2.0 * place)[..., None] ** 2
    near = own[:, :, None] + sums(other[:, :, None] + apart)
    walls = 1.0 - (1.0 - wall(place)) * (1.0 - wall(gaps[:, None] - place))
    density = near / lattice_sum(power, ratio, 1.0, dimension) + walls
    return density.min(axis=(0, 2))


@functools.lru_cache(maxsize=16)
def film_table(support_radius, spacing, dimension, weights):
    """Shares of the rest density that films lack, over their gap.

    Args:
        support_radius, spacing, dimension, weights: as in `WallTables`.

    Returns:
        The gap at which films end [m]; shares at gaps in equal steps from 0 to there, the last 0
        [-], (FILM_STEPS + 1,).
    """
    tables = WallTables(support_radius, spacing, dimension, weights)

    def wall(distance):
        return tables.flat(spacing * distance)[..., 0]

    settings = wall, weights[0], support_radius / spacing, dimension
    # As many particles per volume as the widest film with just two layers has.
    low, high = 0.8, 1.2
    for _ in range(12):
        share = 0.5 * (low + high)
        density = _density(*settings, share * _WIDEST, _WIDEST)
        low, high = (share, high) if density.min() < 1.0 else (low, share)
    widest = float(_WIDEST[density.argmin()])
    gaps = np.linspace(0.0, widest, FILM_STEPS + 1)
    thick = np.maximum(gaps, THINNEST)
    lacking = 1.0 - _density(*settings, share * thick, thick)
    lacking[-1] = 0.0
    return spacing * widest, lacking
