# SPDX-License-Identifier: Apache-2.0
"""From SI materials to the numbers of the solver, and the time step that suits a scene.

The weights are normalised by their lattice sums (see `core.weights`), so a particle's density is 1
at rest and its pressure is in pascal. With w the normalised weight, m = rho0 s^d the mass and G the
virial of w, the acceleration is a_i = -1 / (rho0 G) sum_j (p_i + p_j) grad w_ij, which for Clavet's
pair displacement dt^2 / 2 (P_i + P_j)(1 - q) means P = 4 p / (rho0 G h sum of weights): his
stiffness in SI.

* Stiffness: p = K (density - 1). The deepest point of the liquid at rest bears rho0 g H and may
yield by the
  material's `compression`, so K = rho0 g H / compression. Where there is no gravity a speed stands
  for sqrt(g H).
* Packing: liquid that has flowed packs better than the lattice it started on. At the same number of
  particles per volume its sum of weights is smaller, by the share in `FLOWED_SHARE`. If the
  lattice's sum were called rest for ever, a tank would lose that much of its volume in the first
  second. So the rest density goes over from the lattice's to that of flowed liquid during
  `MELTING_TIME`.
* Viscosity: pair forces -gamma (1 - q) along the line of centres make the shear viscosity
  mu = gamma n^2 / (2 d (d + 2)) integral of (1 - q) r^2 (Irving-Kirkwood; for d = 3 the well known
  2 pi / 15 of dissipative particle dynamics). The integral is a lattice sum here.
* Friction: a wall that holds the liquid is lattice layers whose velocity mirrors the liquid's, so
  that it is the wall's own in between. A particle half a spacing away feels the layer k spacings
  below it move at 2 k times its sliding speed; only the part along the line of centres counts:
  sum of (1 - q) cos^2 2 k, divided by the share of density that the wall has there.
* Surface tension: the potential of the cohesive pressures is
  E = s^d sum_i [Kc / (2 G) (density - 1 - b)^2 + Kc b / (2 Gn) near_density^2] with b = Kn / Kc;
  the excess of the outermost lattice layers per area is the surface tension, linear in Kc.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from sph_ros.core.weights import (
    DENSITY_POWER,
    NEAR_POWER,
    SMOOTH_POWER,
    gradient_sum,
    lattice_sum,
)
from sph_ros.sim.jets import emission_height, make_jet
from sph_ros.sim.surface_tension import noticeable

#: Near-stiffness per cohesive stiffness (b above). More, and a drop freezes into a lattice; none,
#: and its particles clump.
NEAR_SHARE = 0.3

#: Density of flowed liquid on the lattice's scale, where both have the same volume, over h /
#: spacing; by solver and dimension. Measured by benchmarks/calibrate_packing.py.
FLOWED_SHARE = {
    "relaxation": {
        2: ((1.6, 0.991), (2.0, 0.970), (2.5, 0.966), (3.0, 0.947)),
        3: ((1.6, 0.988), (2.0, 0.952), (2.5, 0.959), (3.0, 0.990)),
    },
    # Of the third power. Of the second one, where surface tension acts: `TENSE_SHARE`.
    "incompressible": {
        2: ((1.6, 1.000), (2.0, 0.996), (2.5, 0.995), (3.0, 0.988)),
        3: ((1.6, 0.992), (2.0, 0.995), (2.5, 0.989), (3.0, 0.977)),
    },
}

#: At the usual ratio 2 in three dimensions the level alone would say 0.967, but then the corners of
#: a box are 4.5 % too dense; with 0.954 they are within 3 %, and the level is 1.5 % too high.
TENSE_SHARE = {
    2: ((1.6, 0.999), (2.0, 0.995), (2.5, 0.992), (3.0, 0.982)),
    3: ((1.6, 1.000), (2.0, 0.954), (2.5, 0.982), (3.0, 0.971)),
}

#: Support in spacings below which the third power has too few neighbours: liquid that a solid hits
#: at 3 m/s then leaves it at 8.
LEAST_SMOOTH = 1.8

#: Time in which the lattice at the start becomes liquid [s].
MELTING_TIME = 0.5

#: No automatic step is longer [s].
LONGEST_STEP = 0.01

#: Stands for sqrt(g H) where gravity does not set a speed [m/s].
LEAST_SPEED = 0.3


@dataclass(frozen=True)
class Scales:
    """Numbers of the solver for one material at one spacing.

    Attributes:
        mass: of a particle [kg] (2D: per metre of depth).
        rest_density: [kg/m^3].
        virial: G, what the lattice transmits per unit of nominal pressure [-].
        stiffness: K, pressure per relative compression [Pa].
        cohesion, near: stiffness of the cohesive and the near-pressure [Pa].
        density_scale, near_scale: 1 / lattice sums [-].
        near_virial_ratio: G / Gn, so that both pressures cancel at rest [-].
        viscous_rate: linear impulse per relative speed and second [1/s].
        quadratic: quadratic impulse per squared relative speed and second [1/m].
        neighbors: (1 - r/h) summed over the lattice's neighbours, divided by the dimension [-].
        wall_layers: viscous rate of a wall that holds the liquid, per wall fraction and that of a
            pair [-].
        elasticity: shear modulus of springs [Pa].
    """

    mass: float
    rest_density: float
    virial: float
    stiffness: float
    cohesion: float
    near: float
    density_scale: float
    near_scale: float
    near_virial_ratio: float
    viscous_rate: float
    quadratic: float
    neighbors: float
    wall_layers: float
    elasticity: float


def density_power(scene):
    """Power of the density's weight in a scene.

    A drop whose density has the third power swings a third too slowly when it is six spacings in
    radius, whatever the numbers of its surface tension are. So liquids whose surface tension acts
    keep the second one, and so do those with few neighbours (`LEAST_SMOOTH`).
    """
    few = scene.support_radius < LEAST_SMOOTH * scene.spacing
    if scene.solver != "incompressible" or few or noticeable(scene.material, scene):
        return DENSITY_POWER
    return SMOOTH_POWER


def packing(scene, time):
    """Rest density of the lattice over that of the liquid at a time [s] after the start [-]."""
    tense = scene.solver == "incompressible" and density_power(scene) == DENSITY_POWER
    table = TENSE_SHARE if tense else FLOWED_SHARE[scene.solver]
    ratios, shares = zip(*table[scene.dimension], strict=True)
    share = float(np.interp(scene.support_radius / scene.spacing, ratios, shares))
    return 1.0 / (1.0 - (1.0 - share) * min(time / MELTING_TIME, 1.0))


def liquid_depth(scene, positions):
    """Extent of the liquid along gravity [m]."""
    g = math.sqrt(sum(c * c for c in scene.gravity))
    if g == 0.0 or len(positions) == 0:
        return 0.0
    along = positions @ [-c / g for c in scene.gravity]
    return float(along.max() - along.min()) + scene.spacing


def scene_depth(scene, positions):
    """Extent of the liquid along gravity [m], that of emitted liquid included.

    Args:
        scene: the scene.
        positions: of the particles at the start [m], (N, 3).
    """
    return max(liquid_depth(scene, positions), emission_height(scene))


def solver_scales(material, scene, depth):
    """The solver's numbers for `material` in `scene` with liquid `depth` [m] deep."""
    h, s, d = scene.support_radius, scene.spacing, scene.dimension
    g = math.sqrt(sum(c * c for c in scene.gravity))
    power = density_power(scene)
    virial = gradient_sum(power, h, s, d)
    near_virial = gradient_sum(NEAR_POWER, h, s, d)
    cohesion = material.surface_tension / surface_energy(h, s, d)
    return Scales(
        mass=material.density * s**d,
        rest_density=material.density,
        virial=virial,
        stiffness=material.density * max(g * depth, LEAST_SPEED**2) / material.compression,
        cohesion=cohesion,
        near=NEAR_SHARE * cohesion,
        density_scale=1.0 / lattice_sum(power, h, s, d),
        near_scale=1.0 / lattice_sum(NEAR_POWER, h, s, d),
        near_virial_ratio=virial / near_virial,
        viscous_rate=viscous_rate(material.viscosity / material.density, scene),
        quadratic=material.quadratic_viscosity / s,
        neighbors=neighbor_sum(scene),
        wall_layers=_wall_layers(power, h, s, d),
        elasticity=material.elasticity,
    )


def neighbor_sum(scene):
    """(1 - r/h) summed over the lattice's neighbours, divided by the dimension [-]."""
    h, s, d = scene.support_radius, scene.spacing, scene.dimension
    return sum(1 - r / h for r, _ in lattice_neighbors(h, s, d) if r > 0.0) / d


def viscous_rate(kinematic, scene):
    """Linear impulse per relative speed and second [1/s] for a kinematic viscosity [m^2/s]."""
    h, s, d = scene.support_radius, scene.spacing, scene.dimension
    virial = sum((1 - r / h) * r * r for r, _ in lattice_neighbors(h, s, d))
    return 2 * d * (d + 2) * kinematic / virial


def longest_elastic_step(modulus, scene):
    """Half of the longest stable step with springs [s].

    The stiffest mode moves neighbours against each other: omega^2 = 2 rate sum (1 - r/h) / d.

    Args:
        modulus: shear modulus over density [m^2/s^2].
        scene: the scene.
    """
    return 1.0 / math.sqrt(2.0 * viscous_rate(modulus, scene) * neighbor_sum(scene))


def surface_energy(support_radius, spacing, dimension):
    """Energy per area of a lattice's free surface for a cohesive stiffness of 1 Pa [J/m^2]."""
    virial = gradient_sum(DENSITY_POWER, support_radius, spacing, dimension)
    near_virial = gradient_sum(NEAR_POWER, support_radius, spacing, dimension)
    b = NEAR_SHARE
    bulk = b * b / (2 * virial) + b / (2 * near_virial)
    excess = 0.0
    for layer in range(math.ceil(support_radius / spacing)):
        density = 1.0 - _missing(DENSITY_POWER, support_radius, spacing, dimension, layer)
        near = 1.0 - _missing(NEAR_POWER, support_radius, spacing, dimension, layer)
        energy = (density - 1 - b) ** 2 / (2 * virial) + b * near * near / (2 * near_virial)
        excess += spacing * (energy - bulk)
    return excess


def _wall_layers(power, support_radius, spacing, dimension):
    """Pair rates that a wall which holds the liquid is worth, per wall fraction [-]."""
    reach = math.ceil(support_radius / spacing)
    total = 0.0
    for offset in itertools.product(range(-reach, reach + 1), repeat=dimension):
        r = math.sqrt(sum(c * c for c in offset))
        if offset[-1] > 0 and r * spacing < support_radius:
            cosine = offset[0] / r
            total += (1 - r * spacing / support_radius) * cosine**2 * 2 * offset[-1]
    return total / _missing(power, support_radius, spacing, dimension, 0)


def lattice_neighbors(support_radius, spacing, dimension):
    """(distance [m], height in layers) of the lattice points within the support."""
    reach = math.ceil(support_radius / spacing)
    for offset in itertools.product(range(-reach, reach + 1), repeat=dimension):
        r = spacing * math.sqrt(sum(c * c for c in offset))
        if r < support_radius:
            yield r, offset[-1]


def _missing(power, support_radius, spacing, dimension, layer):
    """Share of the rest density that a particle `layer` layers under a free surface lacks."""
    lacking = math.fsum(
        (1 - r / support_radius) ** power
        for r, height in lattice_neighbors(support_radius, spacing, dimension)
        if height > layer
    )
    return lacking / lattice_sum(power, support_radius, spacing, dimension)


def expected_speed(scene, drop):
    """The fastest that the liquid is expected to become by itself [m/s].

    Args:
        scene: the scene.
        drop: height that the liquid can fall through [m].
    """
    g = math.sqrt(sum(c * c for c in scene.gravity))
    # Blocks may be sent at each other.
    velocities = [(0.0, 0.0, 0.0), *(block.velocity for block in scene.liquid)]
    initial = max(math.dist(a, b) for a in velocities for b in velocities)
    # Of a random velocity next to nothing is beyond three times its RMS.
    initial += max((3.0 * block.agitation for block in scene.liquid), default=0.0)
    jets = [make_jet(emitter, scene).speed for emitter in scene.emitters]
    initial = max(initial, max(jets, default=0.0))
    return max(math.sqrt(2 * g * drop) + initial, LEAST_SPEED)


def stable_time_step(scene, scales, drop, courant, ripples=math.inf):
    """A step that keeps the scene stable [s], and the reason in words.

    Args:
        scene: the scene.
        scales: of its material.
        drop: height that the liquid can fall through [m].
        courant: share of the support radius that the fastest expected particle may cross. The
            speed also stands for the pressure, so this is the bound of the solver's stiffness.
        ripples: step that the shortest waves of surface tension bear [s].

    Returns:
        The step, rounded down to two digits, and what bounds it.
    """
    h = scene.support_radius
    speed = expected_speed(scene, drop)
    bounds = {f"particles up to {speed:.2g} m/s": courant * h / speed}
    soft = math.sqrt((scales.cohesion + scales.near) / scales.rest_density)
    if soft > 0:
        bounds["surface tension"] = 0.38 * h / soft
    elif ripples < math.inf:
        bounds["surface tension"] = ripples
    if scales.elasticity > 0:
        bounds["elasticity"] = longest_elastic_step(scales.elasticity / scales.rest_density, scene)
    reason = min(bounds, key=bounds.get)
    step = min(bounds[reason], LONGEST_STEP)
    return (readable_step(step), reason if step == bounds[reason] else "10 ms at most")


def readable_step(step):
    """The largest number of two digits not above `step`."""
    unit = 10.0 ** (math.floor(math.log10(step)) - 1)
    return round(math.floor(step / unit * (1 + 1e-9)) * unit, 12)
