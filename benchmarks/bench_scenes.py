# SPDX-License-Identifier: Apache-2.0
"""Real-time factor, parts of a step, surface and memory of each packaged scene, stepping alone.

    python benchmarks/bench_scenes.py [SCENE ...]

Each scene runs in a process of its own. Solids that follow topics are stirred in a circle.
"""

import math
import os
import platform
import resource
import subprocess
import sys
import time

WARM_UP, MEASURED = 0.6, 1.0  # simulated seconds
PARTS = ("sort", "solids", "neighbors", "densities", "pressure", "finish", "viscosity")


def stir(simulation):
    """Send every solid that follows a topic round a circle of 3 cm at 2 rad/s."""
    for name in simulation.solid_names:
        solid = simulation.solid(name)
        if solid.control == "topic":
            start = solid._spec.pose.position
            angle = 2.0 * simulation.time
            shift = (0.03 * math.sin(angle), 0.03 * (1.0 - math.cos(angle)), -0.1)
            if simulation.scene.gravity == (0.0, 0.0, 0.0):
                shift = (-0.03 * math.sin(angle), 0.0, 0.0)
            simulation.move_solid(name, [a + b for a, b in zip(start, shift, strict=True)])


def measure(name):
    """Print the row of one scene."""
    import numba

    import sph_ros

    simulation = sph_ros.Simulation(name)
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    while simulation.time < WARM_UP:
        stir(simulation)
        simulation.step()
    simulation.surface()
    steps = math.ceil(MEASURED / simulation.time_step)
    parts, iterations, wall = dict.fromkeys(PARTS, 0.0), 0, 0.0

    for _ in range(steps):
        stir(simulation)
        begin = time.perf_counter()
        simulation.step()
        wall += time.perf_counter() - begin
        for part in PARTS:
            parts[part] += simulation.timings.get(part, 0.0) / steps
        iterations += simulation._solver.iterations / steps
    facts = simulation.statistics()
    worst = facts["mean_compression"]
    begin = time.perf_counter()
    _, triangles = simulation.surface()
    surface = 1e3 * (time.perf_counter() - begin)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    cells = [
        f"{name:<16}",
        f"{simulation.particle_count:>7,}",
        f"{1e3 * simulation.time_step:>5.2f}",
        f"{steps * simulation.time_step / wall:>6.2f}",
        f"{1e3 * wall / steps:>7.2f}",
        *(f"{parts[part]:>6.2f}" for part in PARTS),
        f"{iterations:>5.1f}",
        f"{100 * worst:>5.2f}",
        f"{surface:>7.1f}",
        f"{len(triangles):>8,}",
        f"{memory:>6.0f}",
        f"{memory - base:>6.0f}",
    ]
    print(" ".join(cells), f" {numba.get_num_threads()} threads", flush=True)


def main():
    """Measure the scenes named, or all."""
    names = sys.argv[1:]
    if len(names) == 2 and names[0] == "--one":
        measure(names[1])
        return
    from sph_ros import list_scenes

    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} processors")
    print(
        f"{'scene':<16} {'partic.':>7} {'dt ms':>5} {'factor':>6} {'ms/step':>7} "
        + " ".join(f"{part[:6]:>6}" for part in PARTS)
        + f" {'iter.':>5} {'com %':>5} {'surf ms':>7} {'triang.':>8} {'MB':>6} {'MB own':>6}"
    )
    for name in names or list_scenes():
        subprocess.run([sys.executable, __file__, "--one", name], check=True)


if __name__ == "__main__":
    main()
