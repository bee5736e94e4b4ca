# SPDX-License-Identifier: Apache-2.0
"""The study of `dam_house_2d`: which wall keeps the house dry?"""

import dataclasses
from dataclasses import dataclass

from sph_ros.sim.scene import load_scene
from sph_ros.sim.shapes import Box
from sph_ros.sim.simulation import Simulation

#: Where the wall may stand: right of the water, left of the house [m].
BEGIN = (2.0, 5.0)

#: One published answer: with such a wall at 2 m the house stays dry [m].
PUBLISHED = 2.2

#: Water nearer to the house than this makes it wet [spacings].
TOUCH = 1.0


@dataclass(frozen=True)
class Case:
    """A wall to try.

    Attributes:
        position: of its left face [m].
        height: [m].
        seconds: simulated [s]; None: the scene's duration.
        solver: None: the scene's.
    """

    position: float
    height: float
    seconds: float | None = None
    solver: str | None = None


@dataclass(frozen=True)
class Outcome:
    """What a wall did.

    Attributes:
        position, height: of the wall [m].
        past: water right of the wall at the end [m^2].
        reached: largest height of the water above the ground left of the wall [m].
        wet_from: when water first touched the house [s]; None: never.
    """

    position: float
    height: float
    past: float
    reached: float
    wet_from: float | None

    @property
    def dry(self):
        """Whether no water touched the house."""
        return self.wet_from is None


def with_wall(scene, position, height):
    """The scene with its wall, as thick as it was, elsewhere [m]."""
    solids = []
    for solid in scene.solids:
        if solid.name == "wall":
            lower, upper = solid.shape.min, solid.shape.max
            end = position + upper[0] - lower[0]
            shape = Box(min=(position, *lower[1:]), max=(end, upper[1], height))
            solid = dataclasses.replace(solid, shape=shape)
        solids.append(solid)
    return dataclasses.replace(scene, solids=tuple(solids))


def scene_of(case: Case):
    """The scene with the wall and the solver of a case."""
    scene = with_wall(load_scene("dam_house_2d"), case.position, case.height)
    return scene if case.solver is None else dataclasses.replace(scene, solver=case.solver)


def run_case(case: Case) -> Outcome:
    """Run a case to its end."""
    scene = scene_of(case)
    sim = Simulation(scene)
    near, reached, wet_from = TOUCH * scene.spacing, 0.0, None
    while sim.time < (case.seconds or scene.duration) - 0.5 * sim.time_step:
        sim.step()
        positions = sim.positions
        left = positions[positions[:, 0] < case.position, 2]
        reached = max(reached, float(left.max(initial=0.0)) + 0.5 * scene.spacing)
        if wet_from is None and sim.solid("house").signed_distance(positions).min() < near:
            wet_from = round(sim.time, 6)
    past = int((positions[:, 0] > case.position).sum()) * scene.spacing**2
    return Outcome(case.position, case.height, round(past, 6), round(reached, 6), wet_from)


def table(outcomes: list[Outcome]) -> str:
    """Walls' heights over positions; `dry`, or `wet` and how much water passed [m^2]."""
    positions = sorted({outcome.position for outcome in outcomes})
    heights = sorted({outcome.height for outcome in outcomes})
    by_wall = {(outcome.position, outcome.height): outcome for outcome in outcomes}
    lines = ["wall [m]  " + "".join(f"at {x:<8.2f}" for x in positions)]
    for height in heights:
        cells = []
        for x in positions:
            outcome = by_wall[x, height]
            cells.append(f"{'dry' if outcome.dry else 'wet'} {outcome.past:<7.2f}")
        lines.append(f"{height:<10.2f}" + "".join(cells))
    lines.append("dry or wet: the house; numbers: water past the wall at the end [m^2]")
    return "\n".join(line.rstrip() for line in lines)


def answer(outcomes: list[Outcome]) -> str:
    """For which heights the house stays dry, by position."""
    lines = []
    for x in sorted({outcome.position for outcome in outcomes}):
        walls = sorted(
            (outcome for outcome in outcomes if outcome.position == x), key=lambda o: o.height
        )
        wet = [wall.height for wall in walls if not wall.dry]
        enough = [wall.height for wall in walls if not wet or wall.height > max(wet)]
        text = f"stays dry behind {enough[0]:g} m and more" if enough else "gets wet behind all"
        lines.append(f"wall at {x:g} m: the house {text}")
    known = [o for o in outcomes if o.position == BEGIN[0] and abs(o.height - PUBLISHED) < 1e-9]
    if known:
        verdict = "dry here too" if known[0].dry else "wet here"
        lines.append(f"published: dry behind a wall of {PUBLISHED:g} m at 2 m; {verdict}")
    return "\n".join(lines)
