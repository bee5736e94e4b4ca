# SPDX-License-Identifier: Apache-2.0
"""From SI materials to the factors of the forces solver, and the time step that suits a scene.

Mueller, Charypar & Gross 2003 leave k, mu and sigma to the user. Here they follow from the
material, and the weights' constants from sums over the rest lattice instead of integrals over a
continuum: a particle at rest has exactly the rest density, and pressure and viscosity are those
asked for. At a support of two spacings in 3D that changes poly6 by 1 %, spiky by 4 % and viscosity
by 1 %.

* Pressure: p = k (rho - rho0) with k = c^2, the square of the speed of sound, so that the deepest
  point of the liquid at rest yields by the material's `compression`: c^2 = g H / compression. Where
  there is no gravity a speed stands for sqrt(g H). Below the rest density p is 0: liquid that
  pulls on itself by its pressure clumps.
* The paper's mean of two pressures, (p_i + p_j) / 2, transmits only half of the pressure: with
  sum_j V_j grad W = 0 it is p_j / 2 alone that is left. Divided by the virial of the lattice,
  without the 2, the transmitted pressure is p.
* Viscosity: sum_j V_j (v_j - v_i) Laplacian(W) is the Laplacian of v, exactly so where
  sum_j V_j r^2 Laplacian(W) = 2 d. That sum is taken over the lattice.
* Densities weighed by poly6 and pushes along spiky's slope have no common potential. So the forces
  of the paper make energy out of nothing, at a rate that grows with the speed of sound: without
  viscosity a column at rest explodes within half a second. Two things take it out again. Pressures
  look ahead by `SOUND_DAMPING` h / c, which damps sound and nothing else; and no liquid is thinner
  than `LEAST_VISCOSITY` c h.
* Surface tension by the colour's curvature is no better: the lattice alone has a Laplacian that is
  not zero, so surfaces are pressed inwards, flat ones too (by about 5 sigma s / h^2; without that
  drops fall apart), and the forces do not sum to zero nor have a potential. So there is a least
  viscosity for tension too, with the speed sqrt(sigma / (rho h)) in place of c.
"""

import functools
import itertools
import math
from dataclasses import dataclass

import numpy as np

from sph_ros.core import mueller_weights as weights
from sph_ros.core.forces import Factors
from sph_ros.core.wall_tables import POLY6_AND_SPIKY, flat_wall, flat_wall_laplacian
from sph_ros.core.weights import NEAR_POWER, POLY6, gradient_sum, lattice_sum
from sph_ros.sim.scales import (
    LEAST_SPEED,
    MELTING_TIME,
    expected_speed,
    longest_elastic_step,
    readable_step,
)

#: Share of the support radius that sound and the fastest expected particle cross in a step.
COURANT = 0.4

#: Time by which pressures look ahead, in h / c.
SOUND_DAMPING = 0.6

#: Kinematic viscosity that no liquid falls short of, in c h; for tension in sqrt(sigma h / rho).
#: The smallest with which a column comes to rest and a drop becomes round.
LEAST_VISCOSITY, LEAST_TENSION_VISCOSITY = 1.5e-3, 0.3

#: Colour normals shorter than so many 1 / h belong to no surface. A flat one has 0.9 to 1.2.
LEAST_NORMAL = 0.7

#: Density of flowed liquid on the lattice's scale, as `scales.FLOWED_SHARE`, with poly6.
FLOWED_SHARE = {
    2: ((1.6, 0.993), (2.0, 0.971), (2.5, 0.981), (3.0, 0.964)),
    3: ((1.6, 1.013), (2.0, 0.968), (2.5, 0.964), (3.0, 0.937)),
}

#: Rows of the table of walls' Laplacians.
LAPLACIAN_ROWS = 257


@dataclass(frozen=True)
class ForceScales:
    """Numbers of one liquid.

    Attributes:
        mass: of a particle [kg] (2D: per metre of depth).
        rest_density: [kg/m^3].
        stiffness: pressure per relative compression, rho0 c^2 [Pa].
        sound_speed: c [m/s].
        viscosity: dynamic, with what keeps the solver stable [Pa s].
        surface_tension: [N/m].
        elasticity: shear modulus of springs [Pa].
    """

    mass: float
    rest_density: float
    stiffness: float
    sound_speed: float
    viscosity: float
    surface_tension: float
    elasticity: float


def force_scales(material, scene, depth):
    """Numbers of `material` in `scene` with liquid `depth` [m] deep."""
    g = math.sqrt(sum(c * c for c in scene.gravity))
    speed = math.sqrt(max(g * depth, LEAST_SPEED**2) / material.compression)
    h = scene.support_radius
    ripples = math.sqrt(material.surface_tension * h / material.density)
    least = max(LEAST_VISCOSITY * speed * h, LEAST_TENSION_VISCOSITY * ripples)
    return ForceScales(
        mass=material.density * scene.spacing**scene.dimension,
        rest_density=material.density,
        stiffness=material.density * speed**2,
        sound_speed=speed,
        viscosity=max(material.viscosity, least * material.density),
        surface_tension=material.surface_tension,
        elasticity=material.elasticity,
    )


@functools.cache
def viscous_drag(h, s, d):
    """Viscosity weight's Laplacian per u = 1 - r/h, times a rest volume, and its sum [1/m^2].

    Args:
        h: support radius [m].
        s: spacing [m].
        d: dimension.
    """
    distances = list(_distances(h, s, d))
    laplacians = [s**d * float(weights.viscosity_laplacian(r, h, d)) for r in distances]
    virial = sum(r * r * value for r, value in zip(distances, laplacians, strict=True)) / (2 * d)
    return s**d * weights.viscosity_scale(h, d) * h / virial, sum(laplacians) / virial


def force_factors(material, scene, sound_speed):
    """`Factors` of the kernels at the lattice's packing; see `packed`.

    Args:
        material: for adhesion and for what damps collisions.
        scene: the scene.
        sound_speed: of the stiffest liquid [m/s].
    """
    h, s, d = scene.support_radius, scene.spacing, scene.dimension
    density_scale = 1.0 / lattice_sum(POLY6, h, s, d)
    spiky_scale = NEAR_POWER / h / lattice_sum(NEAR_POWER, h, s, d)
    push = 1.0 / gradient_sum(NEAR_POWER, h, s, d)
    # The relaxation solver's impulse, q / s u v^2, for a pair at u = 1/2.
    collision = 2.0 * material.density * material.quadratic_viscosity / (s * push * spiky_scale)
    full_share = flat_wall(-h, h, s, d, mirrored=False, weights=POLY6_AND_SPIKY)[0]
    values = Factors(
        dimension=d,
        density_scale=density_scale,
        spiky_scale=spiky_scale,
        push=push,
        drag=viscous_drag(h, s, d)[0],
        collision=collision,
        damping=SOUND_DAMPING * h / sound_speed,
        colour_slope=6.0 * density_scale / h,
        colour_laplacian=-6.0 * density_scale / h**2,
        least_normal=LEAST_NORMAL / h,
        adhesion=material.adhesion,
        full_share=full_share,
    )
    return Factors(*(np.float32(value) for value in values))


def packed(factors, packing):
    """The factors for another packing [-]: rest density of the lattice over that of the liquid."""
    names = ("density_scale", "colour_slope", "colour_laplacian", "full_share")
    return factors._replace(**{n: np.float32(packing * getattr(factors, n)) for n in names})


def wall_laplacians(scene):
    """Laplacian of a wall's colour for shares from 0 to the full one [1/m^2], (T,) float32."""
    settings = (scene.support_radius, scene.spacing, scene.dimension)
    full = flat_wall(-settings[0], *settings, mirrored=False, weights=POLY6_AND_SPIKY)[0]
    share = np.linspace(0.0, full, LAPLACIAN_ROWS)
    return flat_wall_laplacian(share, *settings).astype(np.float32)


def force_packing(scene, time):
    """Rest density of the lattice over that of the liquid at a time [s] after the start [-]."""
    ratios, shares = zip(*FLOWED_SHARE[scene.dimension], strict=True)
    share = float(np.interp(scene.support_radius / scene.spacing, ratios, shares))
    return 1.0 / (1.0 - (1.0 - share) * min(time / MELTING_TIME, 1.0))


def longest_steps(scene, liquids, speed):
    """What bounds the time step: reason in words -> longest stable step [s].

    Args:
        scene: the scene.
        liquids: `ForceScales` of all liquids in it.
        speed: of the fastest particle to be expected [m/s].
    """
    h, s = scene.support_radius, scene.spacing
    sound = max(liquid.sound_speed for liquid in liquids)
    bounds = {f"sound at {sound:.2g} m/s": COURANT * h / (sound + speed)}
    # Volumes at a free surface are up to twice those at rest, and so are rates.
    crowd = viscous_drag(h, s, scene.dimension)[1]
    rate = max(liquid.viscosity / liquid.rest_density for liquid in liquids) * crowd
    bounds["viscosity"] = 0.5 / rate
    tension = max(liquid.surface_tension / liquid.rest_density for liquid in liquids)
    if tension > 0.0:
        bounds["surface tension"] = 0.5 * math.sqrt(s**3 / (2.0 * math.pi * tension))
    elastic = max(liquid.elasticity / liquid.rest_density for liquid in liquids)
    if elastic > 0.0:
        bounds["elasticity"] = longest_elastic_step(elastic, scene)
    return bounds


def force_time_step(scene, liquids, drop):
    """A step that keeps the scene stable [s], and the reason in words; see `longest_steps`.

    Args:
        scene: the scene.
        liquids: `ForceScales` of all liquids in it.
        drop: height that the liquid can fall through [m].
    """
    bounds = longest_steps(scene, liquids, expected_speed(scene, drop))
    reason = min(bounds, key=bounds.get)
    return readable_step(bounds[reason]), reason


def _distances(h, s, d):
    """Distances [m] of the lattice points within the support, without the point itself."""
    reach = math.ceil(h / s)
    for offset in itertools.product(range(-reach, reach + 1), repeat=d):
        r = s * math.sqrt(sum(c * c for c in offset))
        if 0.0 < r < h:
            yield r
