# SPDX-License-Identifier: Apache-2.0
"""What a check runs in: solver, size, and somebody who watches the progress."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from sph_ros.sim.simulation import Simulation


class NotAvailableError(RuntimeError):
    """This version or this machine lacks what a check needs; one line that says what."""


@dataclass
class Case:
    """How the checks are to be run.

    Attributes:
        solver: name of the solver.
        quick: the short form: fewer particles, shorter times.
        data: folder or file with published measurements, or None.
        tell: called with what is being done and the share of it that is done, now and then.
    """

    solver: str
    quick: bool = False
    data: Path | None = None
    tell: Callable[[str, float], None] = field(default=lambda words, share: None)

    def pick(self, full, quick):
        """The first in the full form, the second in the short one."""
        return quick if self.quick else full

    def simulation(self, **scene):
        """A simulation of a scene given by its keys, with the solver of this case."""
        return Simulation({"solver": self.solver, **scene})

    def run(self, sim, seconds, look=None, words=""):
        """Step `sim` for some simulated seconds.

        Args:
            sim: the Simulation.
            seconds: at least; whole steps.
            look: called with `sim` after every step.
            words: what is being done, for the progress bar.
        """
        start = sim.time
        end = start + seconds - 1e-6 * sim.time_step
        while sim.time < end:
            sim.step()
            if look is not None:
                look(sim)
            self.tell(words, min((sim.time - start) / max(seconds, 1e-12), 1.0))


def tank(lower, upper):
    """A box open to nothing that holds the liquid; corners [m]."""
    return {"name": "tank", "container": {"box": {"min": list(lower), "max": list(upper)}}}


def block(lower, upper, **more):
    """A box of liquid; corners [m]."""
    return {"box": {"min": list(lower), "max": list(upper)}, **more}
