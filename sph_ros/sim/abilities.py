# SPDX-License-Identifier: Apache-2.0
"""What each solver can do, and what a scene asks of its solver in vain."""

from dataclasses import replace

#: Names of the solvers (`sim.solvers` says what they are).
SOLVERS = ("relaxation", "incompressible", "forces", "lennard_jones", "none")

#: Those that know more than one liquid.
MIXING_SOLVERS = ("forces", "lennard_jones", "none")

#: Those that make particles one liquid, with a density to hold; they know springs, too.
LIQUID_SOLVERS = ("relaxation", "incompressible", "forces")

#: Those that find pressures by iteration.
PRESSURE_SOLVERS = ("relaxation", "incompressible")

#: Those whose particles may turn.
SPIN_SOLVERS = PRESSURE_SOLVERS


def alike(one, other):
    """Whether two materials differ in name and color at most."""
    return replace(one, name=other.name, color=other.color) == other


def faults(scene, materials):
    """What of its materials a scene cannot have: [(field, why, in words)].

    Args:
        scene: for its solver.
        materials: of all its liquids.
    """
    found = [("elasticity", _spring_fault(scene, materials))]
    found.append(("gyration_radius", _spin_fault(scene, materials)))
    return [(field, fault) for field, fault in found if fault]


def _spring_fault(scene, materials):
    elastic = next((material for material in materials if material.elasticity > 0.0), None)
    if elastic is None:
        return None
    given = f"got {elastic.elasticity:g} Pa of {elastic.name!r}"
    if scene.solver not in LIQUID_SOLVERS:
        return f"expected 0, because solver {scene.solver!r} knows no springs; {given}"
    if not all(alike(material, elastic) for material in materials):
        return f"expected 0 where several liquids meet, {given}"
    return None


def _spin_fault(scene, materials):
    turning = next((material for material in materials if material.gyration_radius > 0.0), None)
    if turning is None or scene.solver in SPIN_SOLVERS:
        return None
    return (
        f"expected 0, because solver {scene.solver!r} knows no spins; "
        f"got {turning.gyration_radius:g} m of {turning.name!r}; {SPIN_SOLVERS} know them"
    )
