# SPDX-License-Identifier: Apache-2.0
"""Neighbour lists and densities against all pairs."""

import os
import subprocess
import sys
from pathlib import Path

import naive
import numpy as np
import pytest

from sph_ros.core import neighbors as search
from sph_ros.core import pressure, vector
from sph_ros.core import projection as project
from sph_ros.core import relaxation as relax
from sph_ros.core.pair_sums import STEPS
from sph_ros.core.rows import bounding_box
from sph_ros.core.vector import LANES
from sph_ros.core.weights import lattice_sum
from sph_ros.sim.state import Fluid, Workspace, make_grid

H = np.float32(0.02)
FULL = {power: lattice_sum(power, 0.02, 0.01, 3) for power in (2, 3)}

#: Weights of the density: that of Clavet et al. and that of `incompressible`.
both_powers = pytest.mark.parametrize("power", [2, 3])


def cloud(name, count=400, seed=0):
    generator = np.random.default_rng(seed)
    points = generator.uniform(0.0, 0.08, (count, 3))
    if name == "stray":
        points[7] = [1e4, -3e3, 500.0]
        points[8] = [-0.5, 0.0, 2.0]
    if name == "coincident":
        points[10] = points[11] = points[12]
    if name == "planar":
        points[:, 1] = 0.0
    if name == "dense":
        points *= 0.2
    if name == "vast":  # nearly all are beyond the grid, in its last cell
        points = generator.uniform(-1e4, 1e4, (4 * count, 3))
    if name == "single":
        points = points[:1]
    return points.astype(np.float32)


def searched(points, power=2):
    """Sorted positions, the work arrays with lists and sums, and the sort order."""
    work = Workspace(len(points), 0, pairs_per_particle=8)
    lower, upper = np.empty(3, np.float32), np.empty(3, np.float32)
    assert bounding_box(points, lower, upper) == -1
    grid = make_grid(lower, upper, float(H), len(points))
    search.sort_by_cell(points, grid, work.cell_of, work.order)
    Fluid(points, points).reorder(points, points, work)
    work.predicted[:] = work.scratch
    while search.find_neighbors(work.columns, grid, H, work.chunks, work.pairs):
        work.enlarge_pairs()
    search.sum_densities(
        work.predicted,
        H,
        np.float32(power),
        np.float32(1 / FULL[power]),
        np.float32(1 / FULL[3]),
        work.contacts.density,
        work.chunks,
        work.pairs,
        work.sums,
    )
    return work


def neighbors_of(pairs, i):
    """The list of particle i without what fills it up, after a look at that."""
    start, end, stop = pairs.start[i], pairs.end[i], pairs.stop[i // LANES]
    assert (end - start) % LANES == 0 and end <= stop + i % LANES
    assert np.all(pairs.neighbors[end:stop:LANES] == i)
    return pairs.neighbors[start:end:LANES]


CLOUDS = ["uniform", "stray", "coincident", "planar", "dense", "vast", "single"]


@pytest.mark.nojit
@pytest.mark.parametrize("name", CLOUDS)
def test_lists_are_those_of_all_pairs(name):
    points = cloud(name, count=60 if os.environ.get("NUMBA_DISABLE_JIT") else 400)
    work = searched(points)
    assert sorted(work.order) == list(range(len(points)))
    near = naive.pairs_within(work.predicted, float(H))
    for i in range(len(points)):
        found = neighbors_of(work.pairs, i)
        assert len(set(found)) == len(found)
        assert set(found) == set(np.nonzero(near[i])[0])


@both_powers
@pytest.mark.parametrize("name", CLOUDS)
def test_densities_are_those_of_all_pairs(name, power):
    work = searched(cloud(name), power)
    x = work.predicted
    expected = naive.densities(x, float(H), power, FULL[power])
    np.testing.assert_allclose(work.sums.density, expected, rtol=2e-5)
    np.testing.assert_allclose(
        work.sums.near_density, naive.densities(x, float(H), 3, FULL[3]), rtol=2e-5
    )
    total = naive.gradients(x, float(H), power, FULL[power]).sum(axis=1)
    scale = np.abs(total).max() + 1.0
    np.testing.assert_allclose(work.sums.gradient / scale, total / scale, atol=2e-5)


def iterated(points, power=2):
    """The work arrays after one pressure iteration that takes all of a residual; the guess."""
    work = searched(points, power)
    guess = np.random.default_rng(1).uniform(0, 1e-5, len(points)).astype(np.float32)
    pressure.pressure_displacements(
        work.pairs,
        guess,
        work.contacts,
        work.cohesive,
        work.displacements,
    )
    project.density_targets(
        work.predicted,
        work.displacements,
        H,
        np.float32(power),
        np.float32(1 / FULL[power]),
        work.pairs,
        work.sums.density,
        work.contacts,
        *[np.float32(1.0)] * 3,
        work.targets,
        work.residuals,
    )
    velocities = np.random.default_rng(2).normal(0.0, 1.0, (len(points), 3)).astype(np.float32)
    rates = np.array([0.02, 0.01, 0.1], np.float32)
    relax.viscous_impulses(work.pairs, work.predicted, velocities, H, *rates, work.starts)
    work.scratch[:] = velocities
    corrected(work, guess, work.residuals)
    return work, guess


def corrected(work, guess, residuals):
    """Take one iteration with all of the residual; displacements stay those by the guess."""
    work.diagonal[:] = 1.0
    work.guesses[:] = guess
    work.scaled[:] = guess
    moved = work.displacements.copy()
    state = pressure.fresh_state(1.0)
    state[pressure.INERTIA] = 1.0
    pressure.iterate_pressures(
        work.pairs,
        work.targets,
        residuals,
        work.contacts,
        work.cohesive,
        work.yielded,
        work.diagonal,
        np.float32(0.0),
        (0.0, 0.0, 0.0),
        (1, 1, 1),
        state,
        work.scaled,
        work.guesses,
        work.first,
        work.displacements,
        work.errors,
    )
    assert state[pressure.DONE] == 1.0 and state[pressure.ITERATION] == 1.0
    work.displacements[:] = moved


@both_powers
def test_displacements_are_those_of_all_pairs_and_keep_momentum(power):
    work, pressures = iterated(cloud("uniform"), power)
    slopes = naive.gradients(work.predicted, float(H), power, FULL[power])
    expected = naive.pressure_displacements(slopes, pressures)
    # Each gradient is rounded to a whole number of steps.
    near = naive.pairs_within(work.predicted, float(H))
    both = np.where(near, pressures[:, None] + pressures[None], 0.0).sum(axis=1)
    slope = power / (FULL[power] * float(H))
    rounding = 0.5 / STEPS * slope * both + 1e-6 * np.abs(expected).max()
    assert np.all(np.abs(work.displacements - expected) <= rounding[:, None])
    moved = np.abs(work.displacements).sum(dtype=np.float64)
    assert np.abs(work.displacements.sum(axis=0, dtype=np.float64)).max() < 1e-6 * moved


def test_impulses_are_those_of_all_pairs_and_keep_momentum():
    work, _ = iterated(cloud("uniform"))
    v, changed = work.scratch.astype(np.float64), work.starts.astype(np.float64)
    x = work.predicted.astype(np.float64)
    offset = x[:, None] - x[None]
    r = np.linalg.norm(offset, axis=2)
    np.fill_diagonal(r, np.inf)
    line = offset / r[..., None]
    u = np.maximum(1.0 - r / float(H), 0.0)
    # Clavet 2005, alg. 5; what approaches has a negative speed of separation.
    speed = -np.einsum("ijk,ijk->ij", v[:, None] - v[None], line)
    share = u * np.minimum(0.02 + 0.01 * np.maximum(speed, 0.0), 0.1)
    expected = v + np.einsum("ij,ijk->ik", share * speed, line)
    np.testing.assert_allclose(changed, expected, atol=2e-5)
    assert np.abs((changed - v).sum(axis=0)).max() < 1e-4


@both_powers
def test_an_iteration_sees_the_density_after_the_displacements(power):
    work, guess = iterated(cloud("uniform"), power)
    x, way = work.predicted.astype(np.float64), work.displacements.astype(np.float64)
    slopes = naive.gradients(x, float(H), power, FULL[power])
    linear = np.einsum("ijk,ijk->i", slopes, way[:, None] - way[None])
    near = naive.pairs_within(x, float(H))
    ends = x + way
    distance = np.linalg.norm(ends[:, None] - ends[None], axis=2)
    after = np.where(near, np.maximum(1.0 - distance / float(H), 0.0) ** power, 0.0)
    np.testing.assert_allclose(work.targets + linear, after.sum(axis=1) / FULL[power], atol=2e-4)
    residual = work.targets - 1.0 + linear
    for residuals in (work.residuals, work.residuals[:0]):  # known beforehand, or to be found
        corrected(work, guess, residuals)
        np.testing.assert_allclose(work.scaled, np.maximum(residual, 0.0), atol=2e-4)


def test_a_stray_particle_needs_no_larger_grid():
    points = cloud("stray")
    grid = make_grid(points.min(axis=0), points.max(axis=0), float(H), len(points))
    assert int(np.prod(grid.counts)) <= 1 << 16


def test_first_position_that_is_no_number_is_named():
    points = cloud("uniform")
    points[123, 1] = np.nan
    box = np.empty(3, np.float32), np.empty(3, np.float32)
    assert bounding_box(points, *box) == 123


@pytest.mark.parametrize("instructions", [(), ("HAS_AVX512",), ("HAS_AVX512", "GATHERS")])
def test_other_processors_find_the_same(tmp_path, instructions):
    """All branches of the vector code, in a fresh interpreter that is told to take them."""
    if instructions and not vector.HAS_AVX512:
        pytest.skip("this processor has no AVX-512, so it has only one of the branches")
    has = {name: name in instructions for name in ("HAS_AVX512", "GATHERS")}
    script = (
        "from sph_ros.core import near_points, vector, vector_memory\n"
        f"for m in near_points, vector, vector_memory: vars(m).update({has})\n"
        "import numpy as np, test_neighbors as t\n"
        "w, _ = t.iterated(t.cloud('uniform'), 3)\n"
        "lists = [t.neighbors_of(w.pairs, i) for i in range(400)]\n"
        "sums = w.sums.density, w.sums.gradient, w.displacements, w.starts, w.targets, w.scaled\n"
        f"np.savez(r'{tmp_path / 'other.npz'}', *lists, *sums)\n"
    )
    folder = Path(__file__).parent
    environment = dict(os.environ, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    environment["PYTHONPATH"] = os.pathsep.join([str(folder), str(folder.parent)])
    subprocess.run([sys.executable, "-c", script], env=environment, check=True, timeout=300)
    work, _ = iterated(cloud("uniform"), 3)
    exact = work.sums.density, work.sums.gradient, work.displacements, work.starts
    sums = *exact, work.targets, work.scaled
    with np.load(tmp_path / "other.npz") as other:
        for i in range(400):
            mine = neighbors_of(work.pairs, i)
            np.testing.assert_array_equal(mine, other[f"arr_{i}"])
        # Gradients may be rounded to another step.
        tolerances = [3e-6, 3e-6, 1.0 / STEPS, 3e-6, 1.0 / STEPS, 1.0 / STEPS]
        for k, (mine, tolerance) in enumerate(zip(sums, tolerances, strict=True)):
            scale = np.abs(mine).max()
            np.testing.assert_allclose(
                mine / scale, other[f"arr_{400 + k}"] / scale, atol=tolerance
            )
