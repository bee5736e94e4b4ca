# SPDX-License-Identifier: Apache-2.0
"""The dam break of bench_dam_break by SPlisHSPlasH (C++), where pip has installed pysplishsplash.

    python benchmarks/peer_splishsplash.py SPACING SECONDS [--tuned]

DFSPH with volume maps (Bender et al. 2019), as shipped; or tuned for interaction: no divergence
solver, CFL factor 3, 0.5 % density error. Prints one line of JSON. Its y axis is up, so the box is
turned.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

#: The wheel's own copy of this library and the system's libGLX crash each other at the import.
SYSTEM_DISPATCH = "/usr/lib/x86_64-linux-gnu/libGLdispatch.so.0"

#: Steps that are not timed.
WARM_UP = 3

BOX = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
FACES = [(1, 3, 4, 2), (5, 6, 8, 7), (1, 2, 6, 5), (3, 7, 8, 4), (1, 5, 7, 3), (2, 4, 8, 6)]


def installed():
    """Whether it can be run at all."""
    return importlib.util.find_spec("pysplishsplash") is not None


def run(spacing, seconds, tuned):
    """Facts of a run in a process of its own as a dictionary.

    Raises:
        RuntimeError: it failed; its last line.
    """
    environment = dict(os.environ)
    if Path(SYSTEM_DISPATCH).exists():
        environment["LD_PRELOAD"] = SYSTEM_DISPATCH
    command = [sys.executable, __file__, str(spacing), str(seconds), *(["--tuned"] * tuned)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    if done.returncode or not lines or not lines[-1].startswith("{"):
        last = (done.stderr.splitlines() or lines or ["no output"])[-1]
        raise RuntimeError(f"pysplishsplash: status {done.returncode}: {last}")
    return json.loads(lines[-1])


def scene(spacing, tuned, box_file):
    """Its scene file's content."""
    radius = 0.5 * spacing
    configuration = {
        "particleRadius": radius,
        "density0": 1000,
        "simulationMethod": 4,  # DFSPH
        "gravitation": [0, -9.81, 0],
        "cflMethod": 1,
        "cflFactor": 1,
        "cflMaxTimeStepSize": 0.005,
        "boundaryHandlingMethod": 2,  # volume maps
    }
    if tuned:
        configuration |= {"enableDivergenceSolver": False, "cflFactor": 3, "maxError": 0.5}
        configuration |= {"cflMaxTimeStepSize": 0.01}
    wall = {
        "geometryFile": box_file,
        "translation": [0.5, 0.25, 0.25],
        "rotationAxis": [1, 0, 0],
        "rotationAngle": 0,
        "scale": [1.0, 0.5, 0.5],
        "color": [0.1, 0.4, 0.6, 1.0],
        "isDynamic": False,
        "isWall": True,
        "mapInvert": True,
        "mapThickness": 0.0,
        "mapResolution": [40, 20, 20],
    }
    # It leaves out one layer along each axis.
    block = {
        "denseMode": 0,
        "start": [-radius] * 3,
        "end": [0.4 + radius, 0.4 + radius, 0.5 + radius],
    }
    return {
        "Configuration": configuration,
        "RigidBodies": [wall],
        "Materials": [{"id": "Fluid", "viscosityMethod": 1, "viscosity": 0.01}],
        "FluidBlocks": [block],
    }


def measure(spacing, seconds, tuned, folder):
    """Facts of a run as a dictionary; prints what the program prints."""
    import pysplishsplash

    box, path = Path(folder, "box.obj"), Path(folder, "scene.json")
    corners = [f"v {x} {y} {z}" for x, y, z in BOX]
    faces = [f"f {a} {b} {c}\nf {a} {c} {d}" for a, b, c, d in FACES]
    box.write_text("\n".join([*corners, *faces]) + "\n")
    path.write_text(json.dumps(scene(spacing, tuned, str(box))))
    base = pysplishsplash.Exec.SimulatorBase()
    base.init(useGui=False, sceneFile=str(path), outputDir=str(Path(folder, "out")))
    base.initSimulation()
    moments = []
    clock = pysplishsplash.TimeManager.getCurrent
    base.setTimeStepCB(lambda: moments.append((time.perf_counter(), clock().getTime())))
    base.setValueFloat(base.STOP_AT, seconds)
    base.runSimulation()
    (wall_start, start), (wall_end, end) = moments[WARM_UP], moments[-1]
    steps = len(moments) - 1 - WARM_UP
    fluid = pysplishsplash.Simulation.getCurrent().getFluidModel(0)
    return {
        "solver": f"SPlisHSPlasH DFSPH{', tuned' if tuned else ''}",
        "particles": fluid.numActiveParticles(),
        "step_ms": 1e3 * (end - start) / steps,
        "factor": (end - start) / (wall_end - wall_start),
        "wall_ms_per_step": 1e3 * (wall_end - wall_start) / steps,
    }


def main():
    """Measure once."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("spacing", type=float)
    parser.add_argument("seconds", type=float)
    parser.add_argument("--tuned", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        facts = measure(options.spacing, options.seconds, options.tuned, folder)
    print(json.dumps(facts), flush=True)
    # Its own destructors crash at the end of the interpreter.
    os._exit(0)


if __name__ == "__main__":
    main()
