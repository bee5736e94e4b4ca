# SPDX-License-Identifier: Apache-2.0
"""The same answer with a shorter time step and with finer particles.

What is looked at is how far the centre of a collapsing column has got (in two dimensions, before
the front reaches the wall): a sum over all particles, so splashes do not matter. Of three answers
the order of convergence is log2 |q1 - q2| / |q2 - q3| (Richardson).
"""

import math

import numpy as np

from sph_ros.validation.case import block, tank
from sph_ros.validation.rows import Curve, Plot, Row

WIDTH, TIME = 0.146, 0.25


def time_step(case):
    """The step that the solver chooses, half of it and a quarter."""
    spacing = WIDTH / case.pick(32, 20)
    longest = _simulation(case, spacing, None).time_step
    steps = [longest, longest / 2, longest / 4]
    answers = [_answer(case, spacing, step) for step in steps]
    return [_row("time step, its half and quarter", "time step [s]", steps, answers)]


def spacing(case):
    """A spacing, half of it and a quarter."""
    spacings = [WIDTH / n for n in case.pick((16, 32, 64), (10, 20, 40))]
    answers = [_answer(case, s, None) for s in spacings]
    return [_row("spacing, its half and quarter", "spacing [m]", spacings, answers)]


def _simulation(case, spacing, step):
    return case.simulation(
        spacing=spacing,
        dimension=2,
        time_step="auto" if step is None else step,
        material="water",
        liquid=[block([0, -0.05, 0], [WIDTH, 0.05, 2 * WIDTH])],
        solids=[tank([0, -0.05, 0], [4 * WIDTH, 0.05, 0.5])],
    )


def _answer(case, spacing, step):
    """Place of the centre along the floor at TIME [m]."""
    sim = _simulation(case, spacing, step)
    places = [(0.0, 0.5 * WIDTH)]

    def look(sim):
        places.append((sim.time, float(sim.positions[:, 0].mean(dtype=np.float64))))

    case.run(sim, TIME, look, "column collapses")
    times, centres = np.array(places).T
    return float(np.interp(TIME, times, centres))


def _row(name, label, sizes, answers):
    """Pass: the last halving changes little, and less than the one before or next to nothing."""
    first, second = abs(answers[0] - answers[1]), abs(answers[1] - answers[2])
    order = math.log2(first / second) if first > 0 and second > 0 else math.nan
    plot = Plot(
        label, "place of the centre [m]", (Curve("measured", np.array(sizes), np.array(answers)),)
    )
    way = answers[2] - 0.5 * WIDTH
    error = second / way
    remark = f"order {order:.1f}; {first / way:.1%} then {second / way:.1%} of the way"
    return Row(name, answers[2], answers[1], "m", error, 0.02, remark, plot)
