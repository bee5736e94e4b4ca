# SPDX-License-Identifier: Apache-2.0
"""Plots of what a simulation did over time."""

import os
from pathlib import Path

import numpy as np

#: Quantities of a history that are drawn: key, label of the axis, factor to the axis' unit.
PANELS = (
    ("kinetic_energy", "kinetic energy [J]", 1.0),
    ("mean_compression", "compression [%]", 100.0),
    ("max_compression", "compression [%]", 100.0),
)


def plot_history(path, history, title="") -> None:
    """Draw energy, compression and the force and torque on solids over time.

    Args:
        path: of the picture; the ending (.png, .svg, .pdf) says which kind.
        history: arrays over the same instants: `time` [s] (n,), and any of `kinetic_energy` [J]
            (n,), `mean_compression` and `max_compression` [-] (n,), `force/<solid>` [N] (n, 3),
            `torque/<solid>` [N m] (n, 3); or `wrench/<solid>` (n, 6), force before torque.
        title: above the plot.

    Raises:
        ValueError: `time` is missing, or an array has another length.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = _panels(_checked(history))
    figure = Figure(figsize=(9.0, 1.0 + 2.1 * len(panels)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (label, curves) in zip(axes, panels.items(), strict=True):
        for name, values in curves:
            axis.plot(np.asarray(history["time"]), values, label=name, linewidth=1.2)
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        axis.margins(x=0.0)
        if len(curves) > 1:
            axis.legend(loc="upper right", fontsize="small", ncols=3)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(title)
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        figure.savefig(temporary, dpi=110)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _checked(history):
    if "time" not in history:
        raise ValueError("history: no 'time', expected an array of seconds")
    count = len(history["time"])
    for name, values in history.items():
        if len(values) != count:
            raise ValueError(f"history: '{name}' has {len(values)} instants, 'time' has {count}")
    return history


def _panels(history):
    """Curves per axis label: {label: [(name, values (n,)), ...]}."""
    panels = {}
    for key, label, factor in PANELS:
        if key in history:
            name = key.replace("_", " ")
            panels.setdefault(label, []).append((name, factor * np.asarray(history[key])))
    for key, values in history.items():
        kind, _, solid = key.partition("/")
        parts = {"force": ["force"], "torque": ["torque"], "wrench": ["force", "torque"]}
        for number, part in enumerate(parts.get(kind, [])):
            unit = "N" if part == "force" else "N m"
            columns = np.asarray(values)[:, 3 * number : 3 * number + 3].T
            curves = [(axis, column) for axis, column in zip("xyz", columns, strict=True)]
            panels[f"{part} on {solid} [{unit}]"] = curves
    return panels or {"": []}
