# SPDX-License-Identifier: Apache-2.0
"""What keeps a simulation from exploding: tamed parameters, and a stop at the first NaN.

A step that leaves anything that is no number ends the simulation with one line: which step, which
particle, where in the step it began, and the file with the state before that step.
"""

import dataclasses
import math
import os
import re
import tempfile
from pathlib import Path

import numpy as np

#: Substeps that a given time step is cut into for the sake of surface tension, at most; beyond, a
#: step would take seconds, and the tension is lowered instead.
MOST_TENSION_SUBSTEPS = 50


class UnstableError(RuntimeError):
    """A position, a velocity or a force is no longer a number.

    Attributes:
        step: number of the step that failed, the first is 1.
        particle: its id, None if a force was the first to fail.
        cause: where in the step it began, in words.
        path: file of the state before the step, for `Simulation.load`; None if none was written.
    """

    def __init__(self, message, step=None, particle=None, cause="", path=None):
        """Args: the whole line for people, and its parts."""
        super().__init__(message)
        self.step, self.particle, self.cause, self.path = step, particle, cause, path


def rescue_folder():
    """Where the state before a failed step is written: SPH_ROS_RESCUE, or the temporary folder."""
    return Path(os.environ.get("SPH_ROS_RESCUE") or tempfile.gettempdir())


# ---------------------------------------------------------------- parameters


def tamed(material, scene, step_of):
    """A material that the scene's own time step can bear, and what had to be changed for it.

    Surface tension is explicit; a given time step is cut into substeps for it. A tension that asks
    for more than MOST_TENSION_SUBSTEPS is lowered to what these can bear. With `time_step: auto`
    nothing is changed: the step follows.

    Args:
        material: asked for.
        scene: for its time step.
        step_of: material -> (longest stable step [s], what bounds it).

    Returns:
        (material, notes): notes are lines for people, none if nothing was changed.
    """
    if scene.time_step is None:
        return material, []
    step, reason = step_of(material)
    if scene.time_step <= step * (1 + 1e-6):
        return material, []
    bare, _ = step_of(_with_tension(material, 0.0))
    wanted = min(scene.time_step / MOST_TENSION_SUBSTEPS, bare)
    if step < wanted:
        return _with_bearable_tension(material, step, wanted, step_of, scene)
    count = math.ceil(scene.time_step / step - 1e-6)
    return material, [
        f"time_step: {scene.time_step:g} s is stable only in {count} substeps ({reason}); it is cut"
    ]


def _with_tension(material, tension):
    return dataclasses.replace(material, surface_tension=tension)


def _with_bearable_tension(material, step, wanted, step_of, scene):
    lowered = material
    while step < wanted:
        # The step goes like 1 / sqrt(tension); it is rounded down, so perhaps once more.
        share = min((step / wanted) ** 2, 0.9)
        lowered = _with_tension(lowered, lowered.surface_tension * share)
        step, _ = step_of(lowered)
    count = math.floor(scene.time_step / wanted)
    return lowered, [
        f"surface_tension: {material.surface_tension:g} N/m needs more than {count} substeps in a "
        f"time step of {scene.time_step:g} s, so {lowered.surface_tension:.3g} N/m is used; "
        "expected a shorter time_step, or auto"
    ]


# ---------------------------------------------------------------- a stop at the first NaN


class Guard:
    """Remembers the state before each step, and looks at what the step made of it."""

    def __init__(self):
        """Nothing is remembered yet."""
        self._arrays, self._numbers, self._solids = {}, {}, []

    def remember(self, fluid, numbers, solids):
        """Keep the state before a step.

        Args:
            fluid: `Fluid`; its arrays are copied.
            numbers: JSON-able facts of a snapshot without those of the solids.
            solids: iterable of `Solid`; turned into lists of numbers only when they are needed.
        """
        arrays = fluid.arrays()
        for name in self._arrays.keys() - arrays.keys():
            del self._arrays[name]
        for name, rows in arrays.items():
            kept = self._arrays.get(name)
            if kept is None or kept.shape != rows.shape:
                self._arrays[name] = rows.copy()
            else:
                np.copyto(kept, rows)  # the same memory each time: that of new arrays costs more
        self._numbers = numbers
        self._solids = [solid.twin() for solid in solids]

    def snapshot(self):
        """(arrays, numbers) of the remembered state, for `write_snapshot`."""
        numbers = {**self._numbers, "solids": {s.name: s.state() for s in self._solids}}
        return {**self._arrays, "densities": _ones(self._arrays)}, numbers

    def failure(self, fluid, stages, reactions):
        """Which particle is no longer a number, and where in the step that began.

        Args:
            fluid: after the step, or after the part of it that failed.
            stages: [(words, rows)], arrays of the last substep in the order they were made, rows as
                in `fluid`.
            reactions: wrench on each solid, (S, 6).

        Returns:
            (id of the particle or None, cause).
        """
        before = [("velocity", "velocities"), ("position", "positions"), ("pressure", "pressures")]
        for words, name in before:
            if not np.isfinite(self._arrays[name]).all():
                row = self._arrays["particle"][_first_bad(self._arrays[name])]
                return int(self._arrays["ids"][row]), f"its {words} was no number before the step"
        after = [
            ("its position after the pressure's push", fluid.positions),
            ("its velocity after viscosity and friction", fluid.velocities),
        ]
        for words, rows in [*stages, *after]:
            if len(rows) == len(fluid) and not np.isfinite(rows).all():
                row = fluid.particle[_first_bad(rows)]
                return int(fluid.ids[row]), f"{words} became no number first"
        if not np.isfinite(reactions).all():
            return None, "the force on a solid became no number"
        return None, "a position became no number"

    def describe(self, particle):
        """Where the particle with this id was before the step, and how fast."""
        public = np.flatnonzero(self._arrays["ids"] == particle)
        if len(public) == 0:
            return "it was emitted in this step"
        row = int(np.flatnonzero(self._arrays["particle"] == public[0])[0])
        position, velocity = self._arrays["positions"][row], self._arrays["velocities"][row]
        place = ", ".join(f"{x:.4g}" for x in position)
        speed = float(np.linalg.norm(velocity.astype(np.float64)))
        return f"before, it was at [{place}] m with {speed:.3g} m/s"


def rescue_name(scene_name, step):
    """File name for the state before a step."""
    word = re.sub(r"[^A-Za-z0-9_-]+", "_", scene_name) or "scene"
    return f"sph_ros_{word}_before_step_{step}.npz"


def _first_bad(rows):
    finite = np.isfinite(rows)
    return int(np.argmin(finite if finite.ndim == 1 else finite.all(axis=1)))


def _ones(arrays):
    """Densities nobody can know any more: those at rest."""
    return np.ones(len(arrays["particle"]), np.float32)
