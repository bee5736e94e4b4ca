# SPDX-License-Identifier: Apache-2.0
"""Measure the two stiffnesses of the incompressible solver's surface tension.

    python benchmarks/calibrate_tension.py [dimension [ratio ...]]

A lattice's surface is not that of a liquid: its particles draw nearer and arrange in layers. So the
shares a (area) and b (cohesion) in `sim.surface_tension.SHARES` are those with which a drop that
has come to rest has the energy gamma times its surface, and the mean pressure gamma (d - 1) / R.
Each has one root here: both are found by a few steps of Newton's method with the slopes of a sum of
powers. No drop that swings is looked at; that is what `sph_ros validate` does.
"""

import math
import sys

import numpy as np
from scipy.spatial import cKDTree

from sph_ros import Simulation
from sph_ros.sim import surface_tension as tension

TENSION, RADIUS, LAYERS = 0.072, 0.01, 9
STEPS = 6


def drop(dimension, ratio):
    """A drop at rest, its energy over gamma area, its pressure over Laplace's."""
    spacing = RADIUS / LAYERS
    sim = Simulation(
        {
            "solver": "incompressible",
            "dimension": dimension,
            "gravity": [0, 0, 0],
            "spacing": spacing,
            "support_radius": ratio * spacing,
            "material": {"base": "water", "viscosity": 0.01},
            "liquid": [{"sphere": {"radius": RADIUS}}],
        }
    )
    sim.advance(0.6)
    pressures = []
    while sim.time < 0.8:
        sim.step()
        pressures.append(sim.pressures.mean())
    volume = sim.particle_count * spacing**dimension
    if dimension == 3:
        radius = (3 * volume / (4 * math.pi)) ** (1 / 3)
        area = 4 * math.pi * radius**2
    else:
        radius = math.sqrt(volume / math.pi)
        area = 2 * math.pi * radius
    laplace = TENSION * (dimension - 1) / radius
    return energies(sim) / area, float(np.mean(pressures)) / laplace


def energies(sim):
    """Energy by the gradient and by the lack of colour over the surface tension [m^(d-1)], (2,)."""
    scene = sim.scene
    scales = tension.tension_scales(scene.support_radius, scene.spacing, scene.dimension)
    law = scales.law
    x = sim.positions.astype(np.float64)
    pairs = cKDTree(x).query_pairs(float(law.reach), output_type="ndarray")
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    d = x[i] - x[j]
    q = 1.0 - (d**2).sum(axis=1) / float(law.reach) ** 2
    scale = float(law.scale)
    colour = scale * (1.0 + np.bincount(i, q**3, len(x)))
    slope = -6.0 * scale / float(law.reach) ** 2 * q**2
    gradient = np.stack([np.bincount(i, slope * d[:, k], len(x)) for k in range(3)], axis=1)
    steep = np.linalg.norm(gradient, axis=1) * scene.spacing
    by_gradient = np.hypot(steep, float(law.blur)) - float(law.blur)
    by_lack = 0.5 * np.maximum(float(law.full) - colour, 0.0) ** 2
    unit = scene.spacing ** (scene.dimension - 1)
    return unit * np.array(
        [float(law.area) * by_gradient.sum(), float(law.cohesion) * by_lack.sum()]
    )


def main(arguments):
    dimensions = [int(arguments[0])] if arguments else (3, 2)
    for dimension in dimensions:
        for ratio in [float(x) for x in arguments[1:]] or (1.6, 2.0, 2.5, 3.0):
            a, b = tension.shares(dimension, ratio)
            for _ in range(STEPS):
                tension.SHARES[dimension] = ((ratio, a, b),)
                parts, pressure = drop(dimension, ratio)
                print(
                    f"{dimension}D h/s {ratio}: a {a:.3f} b {b:.3f}: energy {parts.sum():.3f} "
                    f"({parts[0]:.3f} + {parts[1]:.3f}), pressure {pressure:.3f}",
                    flush=True,
                )
                a, b = better(a, b, parts.sum(), pressure)


def better(a, b, energy, pressure):
    """Next guess of both: gradients and lacks change little, pressure falls with a / b."""
    stretch = 1.0 / energy
    tilt = (1.0 / (pressure * stretch)) ** 0.5
    return a * stretch / tilt**0.3, b * stretch * tilt


if __name__ == "__main__":
    main(sys.argv[1:])
