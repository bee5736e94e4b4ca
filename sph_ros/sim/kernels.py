# SPDX-License-Identifier: Apache-2.0
"""Compile all kernels once, in a process of its own.

The process that compiles a kernel runs another machine code of it than processes that load it from
numba's cache: linked functions are optimised once more for the cache, and sums may then be taken in
another order. Both are right, but their last bits differ. So no process that simulates compiles:
the first one has a child do it, and then loads what all later ones load. Only what a scene needs is
compiled: the kernels of its solver.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from numba import config

from sph_ros.core.jit import KERNELS

#: Set for the child, which must not have children of its own.
COMPILING = "SPH_ROS_COMPILING"

LONGEST = 900.0  # [s]

_SCENE = {
    "spacing": 0.02,
    "material": "honey",
    "liquid": [{"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}}],
    "solids": [
        {"name": "tank", "container": {"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.3]}}},
        {
            "name": "ball",
            "sphere": {"radius": 0.02},
            "pose": {"position": [0.05, 0.05, 0.2]},
            "control": "topic",
        },
        {
            "name": "cube",
            "box": {"size": [0.03, 0.03, 0.03]},
            "pose": {"position": [0.05, 0.05, 0.12]},
            "control": "free",
            "density": 500.0,
        },
    ],
    "emitters": [
        {"position": [0.05, 0.05, 0.27], "radius": 0.01, "speed": 2.0, "from": 0.0, "limit": 3}
    ],
    "sinks": [{"plane": {"offset": -1.0}}],
}

#: A triangle in the middle of the liquid.
_SHEET = "v 0 0 0.05\nv 0.1 0 0.05\nv 0 0.1 0.05\nf 1 2 3"


def compile_for(scene):
    """Have the kernels compiled that `scene` needs, if they are not yet."""
    ensure_compiled(scene.solver, scene.material.elasticity > 0.0)


def ensure_compiled(solver="relaxation", springs=False):
    """Have the kernels of a solver compiled if they are not yet.

    That takes a minute or two for the first solver, which compiles what all share, some seconds for
    another one, and a moment later on. Where it fails, say because nothing can be cached, this
    process compiles for itself.

    Args:
        solver: its name in scenes.
        springs: those of elastic materials too.
    """
    if config.DISABLE_JIT or COMPILING in os.environ or _mark(solver, springs).exists():
        return
    command = [sys.executable, "-m", "sph_ros.sim.kernels", solver, *(["springs"] * springs)]
    root = str(Path(__file__).parents[2])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, COMPILING: "1", "PYTHONPATH": os.pathsep.join(paths)}
    try:
        subprocess.run(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=LONGEST,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return


def _mark(solver, springs):
    """The file that is there once the kernels are."""
    return Path(KERNELS) / f"complete_{solver}{'_springs' * springs}"


def main():
    """Take every way through the kernels of a solver once, then leave the mark."""
    from sph_ros.sim.simulation import Simulation

    solver, springs = sys.argv[1], "springs" in sys.argv[2:]
    for dimension in (3, 2):
        with tempfile.NamedTemporaryFile("w", suffix=".obj") as mesh:
            scene = {**_SCENE, "dimension": dimension, "solver": solver}
            if springs:
                scene["material"] = "cream"
            if dimension == 3:
                print(_SHEET, file=mesh, flush=True)
                surface = {"file": mesh.name, "restitution": 0.5}
                scene["solids"] = [*_SCENE["solids"], {"name": "sheet", "surface": surface}]
            simulation = Simulation(scene)
        simulation.move_solid("ball", [0.05, 0.05, 0.08])
        simulation.step()
        simulation.set_material(viscosity=0.001)
        simulation.advance(0.02)
        simulation.statistics()
        simulation.surface()
    _mark(solver, springs).touch()


if __name__ == "__main__":
    main()
