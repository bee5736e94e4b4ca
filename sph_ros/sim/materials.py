# SPDX-License-Identifier: Apache-2.0
"""Liquids in SI units, and the packaged ones by name."""

import dataclasses
from dataclasses import dataclass

from sph_ros.sim.quantities import Vector, check_quantities, limits_of, quantity


@dataclass(frozen=True)
class Material:
    """A liquid.

    Attributes:
        name: what people call it.
        density: rest density [kg/m^3].
        viscosity: dynamic viscosity [Pa s].
        surface_tension: against air [N/m].
        compression: relative compression allowed at the deepest point of the liquid at rest [-];
            the stiffness follows from it.
        wall_friction: 0 lets the liquid slip along solids, 1 drags it with them [-].
        adhesion: how strongly solids hold the liquid, as a share of its own cohesion [-].
        quadratic_viscosity: Clavet's beta times the spacing: damps pairs that collide fast [-].
        elasticity: shear modulus of springs between neighbours; 0: a liquid [Pa].
        yield_strain: relative deformation that springs spring back from [-].
        plasticity: rate at which they give way beyond that [1/s].
        gyration_radius: of flywheels that the particles are (a micropolar liquid, Eringen 1966):
            a vortex of radius a lives 1 + (R / a)^2 times as long; 0: none [m].
        color: red, green, blue, 0 to 1, of a liquid that is drawn opaque; None: clear as water.
    """

    name: str = "water"
    density: float = quantity("kg/m^3", 1000.0, low=1.0, high=50_000.0)
    viscosity: float = quantity("Pa s", 0.001, low=0.0, high=1_000.0)
    surface_tension: float = quantity("N/m", 0.072, low=0.0, high=10.0)
    compression: float = quantity("1", 0.01, low=0.0005, high=0.2)
    wall_friction: float = quantity("1", 0.1, low=0.0, high=1.0)
    adhesion: float = quantity("1", 0.5, low=0.0, high=1.0)
    quadratic_viscosity: float = quantity("1", 0.3, low=0.0, high=10.0)
    elasticity: float = quantity("Pa", 0.0, low=0.0, high=1e5)
    yield_strain: float = quantity("1", 0.1, low=0.0, high=10.0)
    plasticity: float = quantity("1/s", 0.0, low=0.0, high=1e4)
    gyration_radius: float = quantity("m", 0.0, low=0.0, high=1.0)
    color: Vector | None = quantity("1", None, low=0.0, high=1.0)

    def __post_init__(self):
        """Refuse what is no number or out of range."""
        check_quantities(self)


#: Field -> (lowest, highest) accepted value; also the ranges of the ROS parameters.
RANGES = {name: limits for name, limits in limits_of(Material).items() if name != "color"}

#: The packaged liquids at 20 degrees centigrade. Adhesion is what Young & Dupre make of the contact
#: angle on ordinary plastic or glass: (1 + cos angle) / 2, so 0.5 stands for 90 degrees and 0.1 for
#: mercury's 140. Friction: thick liquids stick to what they touch, mercury does not wet it.
MATERIALS = {
    material.name: material
    for material in (
        Material("water"),
        Material(
            "oil",  # olive oil
            density=910.0,
            viscosity=0.08,
            surface_tension=0.033,
            compression=0.01,
            wall_friction=0.5,
            adhesion=0.9,
            quadratic_viscosity=0.3,
            color=(0.8, 0.68, 0.15),
        ),
        Material(
            "honey",
            density=1420.0,
            viscosity=8.0,
            surface_tension=0.05,
            compression=0.01,
            wall_friction=1.0,
            adhesion=0.8,
            quadratic_viscosity=0.3,
            color=(0.82, 0.5, 0.08),
        ),
        Material(
            "cream",
            density=1000.0,
            viscosity=2.0,
            surface_tension=0.045,
            compression=0.01,
            wall_friction=0.9,
            adhesion=0.8,
            quadratic_viscosity=0.3,
            color=(0.97, 0.94, 0.86),
            # Whipped: gives way at about 100 Pa.
            elasticity=1000.0,
            yield_strain=0.1,
            plasticity=20.0,
        ),
        Material(
            "jelly",
            density=1000.0,
            viscosity=1.0,
            surface_tension=0.05,
            compression=0.01,
            wall_friction=0.5,
            adhesion=0.5,
            quadratic_viscosity=0.3,
            elasticity=2000.0,
            color=(0.75, 0.12, 0.16),
        ),
        Material(
            "mercury",
            density=13_534.0,
            viscosity=0.00155,
            surface_tension=0.485,
            compression=0.01,
            wall_friction=0.0,
            adhesion=0.1,
            quadratic_viscosity=0.3,
            color=(0.72, 0.74, 0.77),
        ),
        # Not a gas, it keeps its volume; but light, without viscosity, tension or grip. Game
        # fluids of the 2000s that left the viscosity out behaved like this.
        Material(
            "air_like",
            density=1.2,
            viscosity=0.0,
            surface_tension=0.0,
            compression=0.05,
            wall_friction=0.0,
            adhesion=0.0,
            quadratic_viscosity=0.0,
        ),
    )
}


def list_materials():
    """Names of the packaged materials."""
    return sorted(MATERIALS)


def changed(material, **fields):
    """A copy of `material` with `fields` replaced.

    Raises:
        ValueError: an unknown field, or a value out of its range.
    """
    unknown = sorted(set(fields) - set(RANGES))
    if unknown:
        raise ValueError(f"{unknown[0]}: not a material parameter; expected one of {list(RANGES)}")
    return dataclasses.replace(material, **fields)
