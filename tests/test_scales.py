# SPDX-License-Identifier: Apache-2.0
"""Weights on the lattice, and the numbers that follow from a material."""

import dataclasses
import itertools
import math

import pytest

from sph_ros.core.weights import gradient_sum, lattice_sum
from sph_ros.sim.liquid import fill_liquid
from sph_ros.sim.materials import MATERIALS, Material
from sph_ros.sim.scales import (
    MELTING_TIME,
    liquid_depth,
    packing,
    solver_scales,
    stable_time_step,
    surface_energy,
)
from sph_ros.sim.scene import load_scene

pytestmark = pytest.mark.nojit


def test_lattice_sums_by_hand():
    """At h = 2 s: in 3D 6 neighbours at s, 12 at sqrt 2 s, 8 at sqrt 3 s; at 2 s weight is 0."""
    near, edge, corner = 0.5, 1 - math.sqrt(2) / 2, 1 - math.sqrt(3) / 2
    for power in (2, 3):
        expected = 1 + 6 * near**power + 12 * edge**power + 8 * corner**power
        assert lattice_sum(power, 0.02, 0.01, 3) == pytest.approx(expected)
        assert lattice_sum(power, 0.02, 0.01, 2) == pytest.approx(
            1 + 4 * near**power + 4 * edge**power
        )


@pytest.mark.parametrize(("power", "dimension"), list(itertools.product((2, 3), (2, 3))))
def test_virial_is_the_change_of_the_sum_when_the_lattice_is_squeezed(power, dimension):
    """D sum / d ln volume = -virial: squeeze the spacing, keep the support."""
    small, squeeze = 1e-6, 1e-6 * dimension
    change = lattice_sum(power, 2.2, 1 - small, dimension) - lattice_sum(power, 2.2, 1, dimension)
    expected = change / squeeze / lattice_sum(power, 2.2, 1, dimension)
    assert gradient_sum(power, 2.2, 1, dimension) == pytest.approx(expected, rel=1e-4)


def test_a_sum_over_many_neighbours_is_the_integral():
    """3D: 4 pi h^3 2 / (p + 1)(p + 2)(p + 3) / s^3."""
    for power in (2, 3):
        ball = 8 * math.pi / ((power + 1) * (power + 2) * (power + 3))
        assert lattice_sum(power, 12.0, 1.0, 3) == pytest.approx(ball * 12.0**3, rel=0.01)


def scales_of(**fields):
    scene = load_scene("resting_column")
    positions, _ = fill_liquid(scene)
    return solver_scales(Material(**fields), scene, liquid_depth(scene, positions)), scene


def test_stiffness_lets_the_bottom_yield_as_much_as_allowed():
    scales, _ = scales_of(compression=0.02)
    assert scales.stiffness * 0.02 == pytest.approx(1000 * 9.81 * 0.2, rel=1e-6)


def test_numbers_follow_the_units():
    one, _ = scales_of(viscosity=1.0, surface_tension=0.1)
    two, _ = scales_of(viscosity=2.0, surface_tension=0.2, density=2000.0)
    assert two.viscous_rate == pytest.approx(one.viscous_rate)  # kinematic viscosity is what acts
    assert two.cohesion == pytest.approx(2 * one.cohesion)
    assert two.mass == pytest.approx(2 * one.mass) == pytest.approx(2000 * 0.01**3)


def test_surface_energy_is_positive_and_grows_with_the_spacing():
    for dimension in (2, 3):
        energy = surface_energy(0.02, 0.01, dimension)
        assert energy > 0
        assert surface_energy(0.04, 0.02, dimension) == pytest.approx(2 * energy)


def test_packing_goes_from_the_lattice_to_flowed_liquid():
    _, scene = scales_of()
    assert packing(scene, 0.0) == 1.0
    assert packing(scene, MELTING_TIME) == packing(scene, 99.0) == pytest.approx(1 / 0.952)
    assert 1.0 < packing(scene, MELTING_TIME / 2) < packing(scene, MELTING_TIME)


def test_the_step_is_shorter_for_what_is_faster_finer_or_tauter():
    def step(material=MATERIALS["water"], **changes):
        scene = dataclasses.replace(load_scene("resting_column"), **changes)
        return stable_time_step(scene, solver_scales(material, scene, 0.2), 0.2, courant=0.4)

    base, reason = step()
    assert reason.startswith("particles up to 2")
    assert step(spacing=0.005, support_radius=0.01)[0] < base
    assert step(gravity=(0, 0, -98.1))[0] < base
    taut, why = step(Material(surface_tension=5.0))
    assert taut < base and why == "surface tension"
