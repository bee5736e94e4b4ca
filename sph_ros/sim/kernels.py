# SPDX-License-Identifier: Apache-2.0
"""Compile the kernels that a scene needs once, in processes of their own.

The process that compiles a kernel runs another machine code of it than processes that load it from
numba's cache: linked functions are optimised once more for the cache, and sums may then be taken in
another order. Both are right, but their last bits differ. So no process that simulates compiles:
the first one has two children do it, and then loads what all later ones load.
"""

import fcntl
import gc
import itertools
import os
import subprocess
import sys
import tempfile
import threading
from contextlib import contextmanager
from pathlib import Path

from numba import config
from numba.core import caching, event

from sph_ros.core.jit import KERNELS
from sph_ros.sim.abilities import LIQUID_SOLVERS, PRESSURE_SOLVERS, SOLVERS, SPIN_SOLVERS
from sph_ros.sim.shape_types import Mesh, OpenSurface

#: Set for the children, which must not have children of their own.
COMPILING = "SPH_ROS_COMPILING"

LONGEST = 900.0  # [s]

#: LLVM's level. What takes time is written in vectors (`core.vector`): six pairs of runs at level 3
#: differed by 1 % at one thread, and by less than the noise at two, but start some seconds later.
OPTIMISATION = "1"

#: What scenes may have beside a solver; each has kernels of its own.
FEATURES = ("bodies", "sheets", "meshes", "springs", "spins", "thick", "tension")

#: Those that a material may have -> its solvers. `relaxation` has its tension always.
MATERIAL_FEATURES = {
    "springs": LIQUID_SOLVERS,
    "spins": SPIN_SOLVERS,
    "thick": PRESSURE_SOLVERS,
    "tension": ("incompressible",),
}

#: Functions that the first scene of all needs, about: for reports of progress.
FUNCTIONS = 200

_SCENE = {
    "spacing": 0.02,
    "material": "water",
    "liquid": [{"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}}],
    "emitters": [
        {"position": [0.05, 0.05, 0.27], "radius": 0.01, "speed": 2.0, "from": 0.0, "limit": 3}
    ],
    "sinks": [{"plane": {"offset": -1.0}}],
}

_SOLIDS = [
    {"name": "tank", "container": {"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.3]}}},
    {
        "name": "ball",
        "sphere": {"radius": 0.02},
        "pose": {"position": [0.05, 0.05, 0.2]},
        "control": "topic",
    },
]

_BODY = {
    "name": "cube",
    "box": {"size": [0.03, 0.03, 0.03]},
    "pose": {"position": [0.05, 0.05, 0.12]},
    "control": "free",
    "density": 500.0,
}

_MATERIALS = {
    "springs": "cream",
    "spins": {"base": "water", "gyration_radius": 0.1},
    "thick": {"base": "honey", "viscosity": 1000.0},
    "tension": {"base": "water", "surface_tension": 5.0},
}

#: A triangle in the middle of the liquid, and a tetrahedron above it.
_SHEET = "v 0 0 0.05\nv 0.1 0 0.05\nv 0 0.1 0.05\nf 1 2 3"
_MESH = (
    "v 0.02 0.02 0.12\nv 0.08 0.02 0.12\nv 0.02 0.08 0.12\nv 0.02 0.02 0.18\n"
    "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4"
)

#: Functions that the children have compiled so far.
_compiled = 0


def progress():
    """How far the compilation is, in words; empty where nothing is compiled."""
    return f"{_compiled} of about {max(FUNCTIONS, _compiled)} functions" if _compiled else ""


def needs(scene):
    """Names of what has to be compiled for a `Scene`."""
    shapes = [solid.shape for solid in scene.solids]
    drawn = [*shapes, *(part.shape for part in scene.liquid)]
    has = {
        "bodies": any(solid.control == "free" for solid in scene.solids),
        "sheets": any(isinstance(shape, OpenSurface) for shape in shapes),
        "meshes": any(_contains_mesh(shape) for shape in drawn),
    }
    return [
        scene.solver,
        *(f"{scene.solver}+{name}" for name, needed in has.items() if needed),
        *needs_of_material(scene.material, scene),
    ]


def needs_of_material(material, scene):
    """Names of what has to be compiled for a material in a scene beside what all need."""
    # Scenes are checked by means of compiled kernels, so what knows about them is loaded late.
    from sph_ros.sim.surface_tension import noticeable
    from sph_ros.sim.viscosity import may_be_implicit

    has = {
        "springs": material.elasticity > 0.0,
        "spins": material.gyration_radius > 0.0,
        "thick": may_be_implicit(material, scene),
        "tension": noticeable(material, scene),
    }
    return [
        f"{scene.solver}+{name}"
        for name, solvers in MATERIAL_FEATURES.items()
        if has[name] and scene.solver in solvers
    ]


def _contains_mesh(shape):
    parts = [*getattr(shape, "of", ()), *filter(None, [getattr(shape, "shape", None)])]
    return isinstance(shape, Mesh) or any(_contains_mesh(part) for part in parts)


def everything():
    """Names of all that any scene may need."""
    pairs = itertools.product(SOLVERS, FEATURES)
    return [
        *SOLVERS,
        *(f"{s}+{name}" for s, name in pairs if s in MATERIAL_FEATURES.get(name, SOLVERS)),
    ]


def ensure_compiled(names=None):
    """Have kernels compiled if they are not yet; half a minute then, a moment otherwise.

    Where that fails, say because nothing can be cached, this process compiles for itself.

    Args:
        names: from `needs`; all unless given.
    """
    global _compiled
    if config.DISABLE_JIT or COMPILING in os.environ:
        return
    names = everything() if names is None else names
    if not _missing(names):
        return
    try:
        with _alone():
            missing = _missing(names)  # another process may have been at it
            for jobs in _rounds(missing):
                _run_children(jobs)
    except (OSError, subprocess.SubprocessError):
        return
    finally:
        _compiled = 0


def _mark(name):
    """File that says that what `name` needs is compiled."""
    return Path(KERNELS, f"compiled.{name}")


def _missing(names):
    return [name for name in names if not _mark(name).exists()]


@contextmanager
def _alone():
    """Wait until no other process compiles these kernels, then keep others waiting."""
    with open(Path(KERNELS, "lock"), "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _rounds(names):
    """Lists of names for two processes at a time, in an order that leaves little to do twice.

    A scene without solids needs about half of what one with solids does, and `none` what keeps
    particles out of solids; that comes last with solids. Together they take little more than half
    the time.
    """
    solvers = [name for name in names if name in SOLVERS and name != "none"]
    features = [name for name in names if name not in SOLVERS]
    if solvers:
        yield [solvers[0]], [f"{solvers[0]}-solids", "none"]
    elif "none" in names:
        yield ["none"], []
    for rest in (solvers[1:], features):
        yield rest[::2], rest[1::2]


def _run_children(jobs):
    """Compile lists of names, each in a process, and count what they report."""
    children = [_start_child(names) for names in jobs if names]
    counters = [threading.Thread(target=_count, args=(child,), daemon=True) for child in children]
    try:
        for counter in counters:
            counter.start()
        for child in children:
            if child.wait(LONGEST):
                raise subprocess.SubprocessError(f"status {child.returncode}")
    finally:
        for child in children:
            child.kill()
            child.wait()
        for counter in counters:
            counter.join()


def _start_child(names):
    root = str(Path(__file__).parents[2])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    return subprocess.Popen(
        [sys.executable, "-m", "sph_ros.sim.kernels", *names],
        env={
            **os.environ,
            COMPILING: "1",
            "NUMBA_OPT": OPTIMISATION,
            "PYTHONPATH": os.pathsep.join(paths),
        },
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )


def _count(child):
    """Count the functions that a child reports, one line each."""
    global _compiled
    with child.stdout:
        for _ in child.stdout:
            _compiled += 1


class _Reporter(event.Listener):
    """Prints a line for each function that is compiled."""

    def on_start(self, event):
        pass

    def on_end(self, event):
        print(event.data["dispatcher"].py_func.__name__, flush=True)


def _save_in_turn():
    """Let two processes not save to numba's cache at once.

    Both may have another signature of the same function, and would take the same name for it.
    """
    save = caching.IndexDataCacheFile.save

    def save_alone(self, key, data):
        with open(Path(KERNELS, "saving"), "w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            save(self, key, data)

    caching.IndexDataCacheFile.save = save_alone


def _collect_seldom():
    """Compiling makes many objects that stay: looking through them took a seventh of the time."""
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)


def _take_every_way(scene, dimension):
    """Run a scene through all its kernels."""
    from sph_ros.sim.simulation import Simulation

    simulation = Simulation({**scene, "dimension": dimension})
    if scene["solids"]:
        simulation.surface()
        simulation.move_solid("ball", [0.05, 0.05, 0.08])
    simulation.advance(0.02)
    simulation.statistics()
    simulation.particles  # noqa: B018


def main(names):
    """Compile what each of the names needs, then leave its mark; `SOLVER-solids` has none."""
    event.register("numba:compile", _Reporter())
    _save_in_turn()
    _collect_seldom()
    for name in names:
        solver, _, feature = name.replace("-", "+-").partition("+")
        solids = {"": _SOLIDS, "-solids": [], "bodies": [*_SOLIDS, _BODY]}
        with tempfile.NamedTemporaryFile("w", suffix=".obj") as mesh:
            if feature in ("sheets", "meshes"):
                print(_SHEET if feature == "sheets" else _MESH, file=mesh, flush=True)
                sheet = {"surface": {"file": mesh.name, "restitution": 0.5}}
                shape = sheet if feature == "sheets" else {"mesh": {"file": mesh.name}}
                solids[feature] = [*_SOLIDS, {"name": "mesh", **shape}]
            for dimension in (3,) if feature == "sheets" else (3, 2):
                scene = {**_SCENE, "solver": solver, "solids": solids.get(feature, _SOLIDS)}
                if feature in _MATERIALS:
                    scene["material"] = _MATERIALS[feature]
                _take_every_way(scene, dimension)
        if not feature.startswith("-"):
            _mark(name).touch()


if __name__ == "__main__":
    main(sys.argv[1:])
