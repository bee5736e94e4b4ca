# SPDX-License-Identifier: Apache-2.0
"""Plots of what a simulation did over time."""

import os
from pathlib import Path

import numpy as np

#: Quantities of a history that are drawn: key, label of the axis, factor to the axis' unit.
PANELS = (
    ("kinetic_energy", "kinetic energy [J]", 1.0),
    ("mean_speed", "speed [m/s]", 1.0),
    ("max_speed", "speed [m/s]", 1.0),
    ("mean_compression", "compression [%]", 100.0),
    ("max_compression", "compression [%]", 100.0),
)


def plot_history(path, history, title="") -> None:
    """Draw energy, speed, compression, momentum and the force and torque on solids over time.

    Args:
        path: of the picture; the ending (.png, .svg, .pdf) says which kind.
        history: arrays over the same instants: `time` [s] (n,), and any of `kinetic_energy` [J]
            (n,), `mean_speed` and `max_speed` [m/s] (n,), `mean_compression` and `max_compression`
            [-] (n,), `momentum` [kg m/s] (n, 3), `force/<solid>` [N] (n, 3), `torque/<solid>` [N m]
            (n, 3); or `wrench/<solid>` (n, 6), force before torque.
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
    _save(figure, path)


def plot_study(path, outcomes, title="") -> None:
    """Draw what walls of several heights at several positions let past, and which keep dry.

    Args:
        path: of the picture.
        outcomes: with position, height [m], past [m^2] and dry, one for each pair of a position and
            a height.
        title: above the plot.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    positions = sorted({outcome.position for outcome in outcomes})
    heights = sorted({outcome.height for outcome in outcomes})
    past = np.full((len(heights), len(positions)), np.nan)
    figure = Figure(
        figsize=(3.0 + 0.75 * len(positions), 1.8 + 0.45 * len(heights)), layout="constrained"
    )
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    for outcome in outcomes:
        row, column = heights.index(outcome.height), positions.index(outcome.position)
        past[row, column] = outcome.past
        word = "dry" if outcome.dry else f"wet\n{outcome.past:.2f}"
        axis.text(column, row, word, ha="center", va="center", fontsize="small")
    image = axis.imshow(past, origin="lower", cmap="Blues", aspect="auto", vmin=0.0, alpha=0.75)
    figure.colorbar(image, label="water past the wall at the end [m$^2$]")
    axis.set_xticks(range(len(positions)), [f"{x:g}" for x in positions])
    axis.set_yticks(range(len(heights)), [f"{height:g}" for height in heights])
    axis.set_xlabel("position of the wall [m]")
    axis.set_ylabel("height of the wall [m]")
    axis.set_title(title, fontsize="medium")
    _save(figure, path)


def _save(figure, path):
    """Write a figure that appears whole or not at all."""
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
    if "momentum" in history:
        columns = np.asarray(history["momentum"]).T
        panels["momentum [kg m/s]"] = list(zip("xyz", columns, strict=True))
    for key, values in history.items():
        kind, _, solid = key.partition("/")
        parts = {"force": ["force"], "torque": ["torque"], "wrench": ["force", "torque"]}
        for number, part in enumerate(parts.get(kind, [])):
            unit = "N" if part == "force" else "N m"
            columns = np.asarray(values)[:, 3 * number : 3 * number + 3].T
            curves = [(axis, column) for axis, column in zip("xyz", columns, strict=True)]
            panels[f"{part} on {solid} [{unit}]"] = curves
    return panels or {"": []}
