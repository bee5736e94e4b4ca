# SPDX-License-Identifier: Apache-2.0
"""The solvers by the names that scenes call them."""

from sph_ros.sim.forces import ForcesSolver
from sph_ros.sim.incompressible import IncompressibleSolver
from sph_ros.sim.lennard_jones import LennardJonesSolver
from sph_ros.sim.relaxation import RelaxationSolver
from sph_ros.sim.uncoupled import UncoupledSolver

SOLVER_CLASSES = {
    "relaxation": RelaxationSolver,
    "incompressible": IncompressibleSolver,
    "forces": ForcesSolver,
    "lennard_jones": LennardJonesSolver,
    "none": UncoupledSolver,
}
