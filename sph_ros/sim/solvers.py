# SPDX-License-Identifier: Apache-2.0
"""The solvers by the names that scenes call them."""

from sph_ros.sim.forces import ForcesSolver
from sph_ros.sim.incompressible import IncompressibleSolver
from sph_ros.sim.relaxation import RelaxationSolver

SOLVER_CLASSES = {
    "forces": ForcesSolver,
    "relaxation": RelaxationSolver,
    "incompressible": IncompressibleSolver,
}
