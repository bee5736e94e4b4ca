# SPDX-License-Identifier: Apache-2.0
"""Measure `FLOWED_SHARE` of the solvers' scales: which rest density keeps the level of a column.

A column of lattice particles is shaken and comes to rest. With the lattice's own sum as rest
density it sinks, because liquid that has flowed packs better. Two runs with different shares give
the share for which the level stays.
"""

import itertools

import numpy as np

from sph_ros.sim import force_scales, scales
from sph_ros.sim.simulation import Simulation

SPACING, LAYERS, WIDTH = 0.01, 18, 10


TABLES = {**scales.FLOWED_SHARE, "forces": force_scales.FLOWED_SHARE}


def level(solver, dimension, ratio, share):
    """Level after shaking and rest, twice the height of the centre, in spacings."""
    TABLES[solver][dimension] = ((ratio, share),)
    width, height = WIDTH * SPACING, LAYERS * SPACING
    simulation = Simulation(
        {
            "solver": solver,
            "spacing": SPACING,
            "dimension": dimension,
            "support_radius": ratio * SPACING,
            "material": {"base": "water", "surface_tension": 0.0, "viscosity": 0.02},
            "liquid": [{"box": {"min": [0, 0, 0], "max": [width, width, height]}}],
            "solids": [
                {
                    "name": "tank",
                    "container": {"box": {"min": [0, 0, 0], "max": [width, width, 2 * height]}},
                }
            ],
        }
    )
    shake = np.random.default_rng(0).normal(0.0, 0.2, (simulation.particle_count, 3))
    if dimension == 2:
        shake[:, 1] = 0.0
    simulation._fluid.velocities += shake.astype(np.float32)
    simulation.advance(1.5)
    levels = []
    for _ in range(20):
        simulation.step()
        levels.append(2.0 * simulation.positions[:, 2].mean(dtype=np.float64) / SPACING)
    return float(np.mean(levels))


def main():
    """Print the table."""
    print(
        f"{'solver':>10} {'dimension':>9} {'h / spacing':>11} {'level, lattice':>14} {'share':>7}"
    )
    for solver, dimension, ratio in itertools.product(TABLES, (2, 3), (1.6, 2.0, 2.5, 3.0)):
        lattice = level(solver, dimension, ratio, 1.0)
        guess = level(solver, dimension, ratio, 0.95)
        share = 1.0 - 0.05 * (LAYERS - lattice) / (guess - lattice)
        print(
            f"{solver:>10} {dimension:>9} {ratio:>11.1f} {lattice:>14.2f} {share:>7.3f}", flush=True
        )


if __name__ == "__main__":
    main()
