# SPDX-License-Identifier: Apache-2.0
"""All checks by name, and running them."""

import time
from dataclasses import dataclass, field

from sph_ros.sim.guards import UnstableError
from sph_ros.sim.scene_yaml import nearest
from sph_ros.validation import (
    conservation,
    convergence,
    dam_break,
    drops,
    floating,
    hydrostatics,
    outflow,
    shear,
    stirring,
    walls,
)
from sph_ros.validation.case import Case, NotAvailableError
from sph_ros.validation.options import REQUIRED, ValidateError
from sph_ros.validation.rows import Row

#: Name -> (function, what it looks at), in the order of the table.
CHECKS = {
    "column": (hydrostatics.column, "pressure against depth in a resting column"),
    "held": (hydrostatics.held, "force on a ball, a box and a mesh held under water"),
    "floating": (floating.balls, "free balls of three densities"),
    "couette": (shear.couette, "flow between plates that move"),
    "poiseuille": (shear.poiseuille, "flow pushed between plates"),
    "drop_period": (drops.period, "period of a drop's second mode"),
    "drop_pressure": (drops.laplace, "pressure inside a drop"),
    "cube": (drops.cube, "a cubic drop becomes a ball"),
    "dam_break": (dam_break.front, "front of a collapsing column"),
    "outflow": (outflow.slit, "outflow through a slit"),
    "momentum": (conservation.momenta, "momentum and angular momentum of drops that collide"),
    "time_step": (convergence.time_step, "a time step, its half and quarter"),
    "spacing": (convergence.spacing, "a spacing, its half and quarter"),
    "volume": (stirring.volume, "volume of a tank that is stirred for a minute"),
    "walls": (walls.densities, "density at a wall, an edge, a corner and a small ball"),
}


@dataclass
class Outcome:
    """What one check found with one solver.

    Attributes:
        check, solver: their names.
        rows: of the table.
        problem: why there are none, in words; "" if there are.
        missing: the problem is that this version cannot run the check at all.
        seconds: it took.
    """

    check: str
    solver: str
    rows: list[Row] = field(default_factory=list)
    problem: str = ""
    missing: bool = False
    seconds: float = 0.0

    @property
    def passed(self):
        """Whether there are rows and all of them pass."""
        return bool(self.rows) and all(row.passed for row in self.rows)


def chosen(names):
    """Checks to run, in the order of the table; all if no name is given.

    Raises:
        ValidateError: there is no such check; names the nearest.
    """
    for name in names:
        if name not in CHECKS:
            raise ValidateError(f"no check {name!r}{nearest(name, CHECKS)}")
    return [name for name in CHECKS if not names or name in names]


def run_check(name, case):
    """The Outcome of one check; a simulation that fails is an outcome, too."""
    start = time.perf_counter()
    outcome = Outcome(name, case.solver)
    try:
        outcome.rows = CHECKS[name][0](case)
    except NotAvailableError as error:
        outcome.problem, outcome.missing = f"not available: {error}", True
    except UnstableError as error:
        outcome.problem = f"unstable: {error}"
    outcome.seconds = time.perf_counter() - start
    return outcome


def run_checks(names, solvers, quick=False, data=None, tell=None):
    """Outcomes of all checks, solver by solver, one at a time.

    Args:
        names: of `chosen`.
        solvers: names of the solvers.
        quick: the short form.
        data: file with the published points of a dam break, or None.
        tell: called with (checks done, share of the present one, words).

    Yields:
        Outcome after Outcome.
    """
    done = 0
    for solver in solvers:
        for name in names:

            def tell_more(words, share, done=done, solver=solver):
                if tell is not None:
                    tell(done, share, f"{solver}: {words}")

            yield run_check(name, Case(solver, quick, data, tell_more))
            done += 1


def failures(outcomes):
    """Those that must pass and do not."""
    return [o for o in outcomes if o.solver in REQUIRED and not o.passed and not o.missing]
