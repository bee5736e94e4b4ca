# SPDX-License-Identifier: Apache-2.0
"""Interactive particle liquids for ROS 2; the simulation itself needs no ROS."""

import os

# A product of large arrays in numpy leaves OpenBLAS's threads spinning for milliseconds, on the
# processors that the next step wants: it would take twice as long. Read when numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__version__ = "0.1.0"

__all__ = ["SceneError", "Simulation", "list_materials", "list_scenes", "load_scene"]

_HOMES = {
    "SceneError": "sph_ros.sim.scene",
    "Simulation": "sph_ros.sim.simulation",
    "list_materials": "sph_ros.sim.materials",
    "list_scenes": "sph_ros.sim.scene",
    "load_scene": "sph_ros.sim.scene",
}


def __getattr__(name):
    """Load the public names on first use, so that `import sph_ros` and `--help` are instant."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
