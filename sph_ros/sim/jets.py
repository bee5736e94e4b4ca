# SPDX-License-Identifier: Apache-2.0
"""Emitters as geometry: through which places, how fast and how often particles come out.

The opening is a disc of places one spacing apart (in 2D a row); through each a column of particles
comes out. With columns one spacing apart and one spacing between the particles of a column a jet
has rest density, whatever its speed v: each column then gives v / spacing particles per second.
"""

import math
from typing import NamedTuple

import numpy as np

from sph_ros.sim.liquid import distances_to
from sph_ros.sim.shapes import Plane, placed_extent

#: Particles at once of an emitter that has neither a limit nor an end.
ENDLESS = 20_000

#: Columns of an opening at most.
MOST_COLUMNS = 100_000

#: The rate may be so much above what the opening lets through: rounding.
SLACK = 1.01


class Jet(NamedTuple):
    """What an emitter of a scene emits.

    Attributes:
        places: of the columns in the opening, scene's frame [m], (C, 3) float64.
        direction: of the jet, (3,).
        speed: [m/s].
        period: between two particles of a column [s].
        phases: share of a period after which each column begins, (C,).
    """

    places: np.ndarray
    direction: np.ndarray
    speed: float
    period: float
    phases: np.ndarray

    @property
    def rate(self):
        """Particles per second of all columns."""
        return len(self.places) / self.period


def make_jet(emitter, scene):
    """The jet of an emitter.

    Raises:
        ValueError: "field: ..." where rate and speed do not fit together, or a 2D direction has no
            part in the plane.
    """
    columns = math.pi * (emitter.radius / scene.spacing) ** 2
    if scene.dimension == 3 and columns > MOST_COLUMNS:
        raise ValueError(
            f"radius: {emitter.radius:g} m holds {columns:,.0f} columns of particles, expected at "
            f"most {MOST_COLUMNS:,}"
        )
    direction = np.array(emitter.direction)
    if scene.dimension == 2:
        direction[1] = 0.0
        length = float(np.linalg.norm(direction))
        if length < 1e-6:
            raise ValueError(
                f"direction: expected one in the x-z plane, because dimension is 2; "
                f"got {list(emitter.direction)}"
            )
        direction /= length
    places = _places(emitter, scene, direction)
    count = len(places)
    speed = emitter.speed
    if speed is None:
        speed = emitter.rate * scene.spacing / count
    most = count * speed / scene.spacing
    rate = most if emitter.rate is None else emitter.rate
    if rate > SLACK * most:
        raise ValueError(
            f"rate: {rate:g} particles/s do not fit through this opening at {speed:g} m/s; "
            f"expected at most {most:.4g} ({count} columns, one particle per spacing), a larger "
            "radius or speed, or no speed"
        )
    dense = rate >= most / SLACK
    index = np.arange(count)
    # A jet comes out in whole discs; drops that are farther apart one after the other, spread over
    # the opening by the golden ratio.
    phases = np.full(count, 0.5) if dense else (0.5 + 0.618033988749895 * index) % 1.0
    return Jet(places, direction, speed, count / rate, phases)


def _places(emitter, scene, direction):
    """Columns of the opening: a square lattice in a disc, in 2D a row."""
    radius, spacing = emitter.radius, scene.spacing
    across = np.eye(3)[int(np.argmin(np.abs(direction)))]
    if scene.dimension == 2:
        across = np.array([0.0, 1.0, 0.0])
    first = np.cross(across, direction)
    first /= np.linalg.norm(first)
    second = np.cross(direction, first)
    if scene.dimension == 2:
        count = max(math.floor(2.0 * radius / spacing + 1e-6), 1)
        offsets = (np.arange(count) - 0.5 * (count - 1))[:, None] * first
        position = np.array([emitter.position[0], 0.0, emitter.position[2]])
        return position + spacing * offsets
    return np.array(emitter.position) + spacing * _disc(radius / spacing) @ [first, second]


def _disc(radius):
    """Points of the unit square lattice in a disc, as many as its area says, (C, 2)."""
    reach = math.ceil(radius) + 1
    lattices = []
    for shift in ((0.0, 0.0), (0.5, 0.5), (0.0, 0.5)):
        axes = [np.arange(-reach, reach + 1) + s for s in shift]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        lattices.append(points[np.hypot(*points.T) <= radius + 1e-9])
    area = math.pi * radius**2
    filled = [points for points in lattices if len(points)]
    return min(filled, key=lambda points: abs(len(points) - area))


def most_particles(emitter, jet):
    """Particles of an emitter that there can be at once."""
    if emitter.limit is not None:
        return emitter.limit
    if math.isfinite(emitter.until):
        return math.ceil(jet.rate * (emitter.until - emitter.from_time)) + len(jet.places)
    return ENDLESS


def capacity(scene, first_count):
    """Particles of a scene that there can be at once, `first_count` of them from the start."""
    emitted = sum(most_particles(emitter, make_jet(emitter, scene)) for emitter in scene.emitters)
    if scene.max_particles is not None and scene.emitters:
        return max(first_count, min(first_count + emitted, scene.max_particles))
    return first_count + emitted


def emission_height(scene):
    """Height from the lowest point of the solids to the highest emitter, 0 without either [m].

    How far emitted liquid falls, and how deep it can at most stand.
    """
    g = math.sqrt(sum(c * c for c in scene.gravity))
    if not scene.emitters or g == 0.0:
        return 0.0
    up = np.array([-c / g for c in scene.gravity])
    openings = np.array([emitter.position for emitter in scene.emitters])
    top = float((openings @ up).max())
    bottoms = [top]
    for solid in scene.solids:
        if isinstance(solid.shape, Plane):
            distance = distances_to(solid.shape, solid.pose, openings, scene)
            bottoms.append(float((openings @ up - distance).min()))
        else:
            lower, upper = placed_extent(solid.shape, solid.pose)
            lowest = float(np.minimum(lower * up, upper * up).sum())
            bottoms.append(lowest if math.isfinite(lowest) else top)
    return top - min(bottoms)
