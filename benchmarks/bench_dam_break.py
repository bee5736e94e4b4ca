# SPDX-License-Identifier: Apache-2.0
"""Real-time factor of a dam break over the number of particles, stepping alone.

    python benchmarks/bench_dam_break.py [--solvers incompressible ...] [--seconds 1] [--plot FILE]

Box 1.0 x 0.5 x 0.5 m, block 0.4 x 0.5 x 0.4 m, h = 2 spacings. Each run has a process of its own;
the clock runs from the first step after kernels are loaded to the end, publishing and surface not
counted. Wall time is the machine's, so free it first; compare rows of one run only. Where pip has
installed pysplishsplash, SPlisHSPlasH runs the first tenths of a second of the smaller ones, too.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time

import peer_splishsplash as peer

#: Spacings [m] and the numbers of particles that they make.
SPACINGS = {0.025: 5_120, 0.016: 19_375, 0.0091: 106_000}

WARM_UP = 3  # steps

#: What the peer is given: no finer spacings [m], no more seconds.
PEER_SPACING, PEER_SECONDS = 0.015, 0.3


def scene(spacing, solver):
    """The dam break as a scene."""
    return {
        "spacing": spacing,
        "solver": solver,
        "material": "water",
        "liquid": [{"box": {"min": [0, 0, 0], "max": [0.4, 0.5, 0.4]}}],
        "solids": [
            {"name": "tank", "container": {"box": {"min": [0, 0, 0], "max": [1.0, 0.5, 0.5]}}}
        ],
    }


def measure(spacing, solver, seconds):
    """Facts of one run as a dictionary."""
    import numba

    import sph_ros

    simulation = sph_ros.Simulation(scene(spacing, solver))
    for _ in range(WARM_UP):
        simulation.step()
    start = simulation.time
    # Nothing in between: processor time of helpers is not told before they pause.
    begin, begin_cpu, steps = time.perf_counter(), time.process_time(), 0
    while simulation.time < start + seconds:
        simulation.step()
        steps += 1
    wall, cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    memory = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # The same once more, to the bit, with a look at each step.
    simulation.reset()
    for _ in range(WARM_UP):
        simulation.step()
    compression, iterations, substeps = [], 0, 0
    for _ in range(steps):
        simulation.step()
        facts = simulation.statistics()
        substeps += facts["substeps"]
        compression.append(facts["mean_compression"])
        iterations += facts["iterations"]
    count = simulation.particle_count
    return {
        "solver": solver,
        "particles": count,
        "step_ms": 1e3 * simulation.time_step,
        "factor": (simulation.time - start) / wall,
        "wall_ms_per_step": 1e3 * wall / steps,
        "cpu_ms_per_step": 1e3 * cpu / steps,
        "cpu_ns_per_particle_and_substep": 1e9 * cpu / (substeps * count),
        "substeps": substeps / steps,
        "iterations": iterations / steps,
        "mean_compression": sum(compression) / len(compression),
        "worst_mean_compression": max(compression),
        "lost": simulation.statistics()["lost_particles"],
        "bytes_per_particle_beside_200_MB": max(memory - 200e6, 0.0) / count,
        "threads": numba.get_num_threads(),
    }


def peer_rows(spacings, seconds):
    """The same by SPlisHSPlasH, shown as they come; none where it is not installed."""
    rows = []
    if not peer.installed():
        print("SPlisHSPlasH is left out: pip install pysplishsplash, to have it run beside")
        return rows
    for tuned in (False, True):
        for spacing in spacings:
            try:
                rows.append(peer.run(spacing, min(seconds, PEER_SECONDS), tuned))
            except RuntimeError as error:
                print(error)
                continue
            show(rows[-1])
    return rows


def show(row):
    """Print a row on one line."""
    print(
        "  ".join(
            f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
            for key, value in row.items()
        ),
        flush=True,
    )


def plot(rows, path):
    """Factor over particles, a line for each solver."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for solver in dict.fromkeys(row["solver"] for row in rows):
        own = [row for row in rows if row["solver"] == solver]
        axes.loglog([r["particles"] for r in own], [r["factor"] for r in own], "o-", label=solver)
    axes.axhline(1.0, color="grey", linewidth=0.8)
    axes.set(xlabel="particles", ylabel="simulated / wall seconds", title="dam break")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def main():
    """Measure all sizes with all solvers asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--solvers", nargs="+", default=["incompressible", "relaxation"])
    parser.add_argument("--spacings", nargs="+", type=float, default=list(SPACINGS))
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--plot", metavar="FILE")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(float(options.one[0]), options.one[1], options.seconds)))
        return
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} processors")
    rows = []
    for solver in options.solvers:
        for spacing in options.spacings:
            command = [sys.executable, __file__, "--one", str(spacing), solver]
            command += ["--seconds", str(options.seconds)]
            found = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            rows.append(json.loads(found.stdout))
            show(rows[-1])
    rows += peer_rows([s for s in options.spacings if s >= PEER_SPACING], options.seconds)
    if options.plot:
        plot(rows, options.plot)
        print(options.plot)


if __name__ == "__main__":
    main()
