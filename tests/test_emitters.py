# SPDX-License-Identifier: Apache-2.0
"""Emitters and sinks: amounts, speeds, ids, and that nothing appears where something is."""

import math

import numba
import numpy as np
import pytest
from scipy.spatial import cKDTree

import sph_ros
from sph_ros.sim.jets import ENDLESS

JET = {"position": [0, 0, 0.5], "radius": 0.03, "speed": 1.0, "until": 0.5}
FREE = {"spacing": 0.01, "gravity": [0, 0, 0], "liquid": []}

#: A cup that a jet fills and overfills, with a slot below its rim and a drain beside it.
FOUNTAIN = {
    "spacing": 0.02,
    "liquid": [{"box": {"min": [-0.1, -0.1, 0], "max": [0.1, 0.1, 0.04]}}],
    "emitters": [
        {"position": [0, 0, 0.15], "direction": [1, 0, -2], "radius": 0.04, "speed": 0.8},
        {"position": [-0.05, 0, 0.1], "radius": 0.001, "rate": 20, "from": 0.1, "limit": 3},
    ],
    "max_particles": 700,
    "sinks": [{"box": {"min": [0.05, -0.1, 0], "max": [0.15, 0.1, 0.05]}, "from": 0.2}],
    "solids": [
        {"name": "tank", "container": {"box": {"min": [-0.1, -0.1, 0], "max": [0.2, 0.1, 0.3]}}}
    ],
}


def nearest_pair(points):
    return cKDTree(points).query(points, k=2)[0][:, 1].min()


def test_a_free_jet_has_the_speed_the_amount_and_the_width_asked_for():
    sim = sph_ros.Simulation({**FREE, "emitters": [JET]})
    while sim.time < 0.5:
        sim.step()
        assert sim.particle_count < 2 or nearest_pair(sim.positions) > 0.5 * 0.01
    # Speed x area x time, and so many particles as the disc has places at one spacing each.
    volume = sim.particle_count * 0.01**3
    places = sim.particle_count / (1.0 * 0.5 / 0.01)
    assert places == pytest.approx(math.pi * 3**2, rel=0.05)
    assert volume == pytest.approx(places * 0.01**2 * 1.0 * 0.5, rel=0.02)
    middle = np.abs(sim.positions[:, 2] - 0.25) < 0.1
    assert -sim.velocities[middle, 2].mean() == pytest.approx(1.0, rel=0.01)
    assert np.hypot(*sim.positions[middle, :2].T).max() < 0.03 + 0.003
    assert sim.positions[:, 2].min() == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("time_step", [0.0005, 0.02])
def test_a_rate_below_that_of_a_jet_makes_single_drops_at_that_rate(time_step):
    """50 particles a second fall from a slit in 2D, whatever the step."""
    rain = {"position": [0, 0, 2.0], "radius": 0.2, "speed": 0.5, "rate": 50}
    sim = sph_ros.Simulation(
        {
            **FREE,
            "dimension": 2,
            "gravity": [0, 0, -9.81],
            "emitters": [rain],
            "time_step": time_step,
        }
    )
    sim.advance(0.5)
    facts = sim.statistics()
    assert facts["emitted_particles"] == sim.particle_count == pytest.approx(25, abs=1)
    assert nearest_pair(sim.positions) > 0.01 and np.all(sim.positions[:, 1] == 0.0)
    assert sim.capacity == ENDLESS
    # The last one fell for less than two periods of 20 ms, the first for the whole time.
    assert sim.velocities[-1, 2] > -0.5 - 9.81 * 0.04
    assert sim.velocities[:, 2].min() == pytest.approx(-0.5 - 9.81 * 0.48, rel=0.05)


def test_times_and_limits_are_kept_to_the_particle():
    jets = [
        {**JET, "radius": 0.001, "speed": 0.5, "from": 0.1, "until": 0.3},
        {**JET, "radius": 0.001, "position": [0.2, 0, 0.5], "rate": 100, "limit": 7},
    ]
    sim = sph_ros.Simulation({**FREE, "emitters": jets})
    assert sim.capacity == 11 + 7
    sim.advance(0.1)
    assert sim.particle_count == 7 and np.all(sim.positions[:, 0] > 0.1)
    sim.advance(0.5)
    assert sim.particle_count == 10 + 7
    assert sim.velocities[:7, 2] == pytest.approx(-1.0, abs=0.05)  # 100/s in single file: 1 m/s


def test_nothing_appears_on_top_of_what_is_there():
    """A box fills through a jet in it until no more fits; then a plate covers another opening."""
    walls = {"box": {"min": [-0.05, -0.05, 0], "max": [0.05, 0.05, 0.06]}}
    jet = {**JET, "position": [0, 0, 0.05], "speed": 0.5, "until": 9}
    plate = {
        "name": "plate",
        "box": {"size": [0.2, 0.2, 0.02]},
        "pose": {"position": [0, 0, 0.045]},
        "control": "topic",
    }
    sim = sph_ros.Simulation(
        {**FREE, "emitters": [jet], "solids": [{"name": "tank", "container": walls}]}
    )
    sim.advance(1.5)
    assert sim.particle_count < 1.1 * 600 < sim.statistics()["time"] * 29 * 50
    assert sim.statistics()["max_compression"] < 0.15 and sim.statistics()["lost_particles"] == 0
    covered = sph_ros.Simulation({**FREE, "emitters": [jet], "solids": [plate]})
    covered.advance(0.1)
    assert covered.particle_count == 0
    covered.move_solid("plate", [0, 0, 0.2])
    covered.advance(0.3)
    assert covered.particle_count > 100
    assert covered.solid("plate").signed_distance(covered.positions).min() > 0.0


def test_rows_are_in_the_order_of_ids_and_no_id_comes_twice():
    sim = sph_ros.Simulation(FOUNTAIN)
    where, gone = {}, set()
    while sim.time < 1.0:
        sim.step()
        ids, positions = sim.ids.tolist(), sim.positions
        assert ids == sorted(set(ids)) and not gone & set(ids)
        for key, place in zip(ids, positions, strict=True):
            assert np.linalg.norm(place - where.get(key, place)) < 0.02
        gone |= set(where) - set(ids)
        where = dict(zip(ids, positions, strict=True))
        assert len(ids) <= 700
        if sim.time > 0.21:
            sink = (np.abs(positions[:, 0] - 0.1) < 0.05) & (positions[:, 2] < 0.05)
            assert not sink.any()
    facts = sim.statistics()
    assert facts["removed_particles"] == len(gone) > 100
    assert 200 + facts["emitted_particles"] - facts["removed_particles"] == sim.particle_count
    assert max(ids) == 200 + facts["emitted_particles"] - 1


def run(threads, tmp_path=None):
    """Positions and ids after a while, and perhaps through a snapshot on the way."""
    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        sim = sph_ros.Simulation(FOUNTAIN)
        sim.advance(0.3)
        if tmp_path:
            sim.save(tmp_path / "half.npz")
            sim = sph_ros.Simulation.load(tmp_path / "half.npz")
        sim.advance(0.2)
    finally:
        numba.set_num_threads(before)
    return sim, (sim.positions.tobytes(), sim.ids.tobytes(), sim.densities.tobytes())


def test_the_same_bits_for_any_threads_after_snapshots_and_resets(tmp_path):
    _, one = run(1)
    sim, two = run(min(2, numba.config.NUMBA_NUM_THREADS), tmp_path)
    assert one == two
    sim.reset()
    assert sim.particle_count == 200 and sim.statistics()["emitted_particles"] == 0
    sim.advance(0.3)
    sim.advance(0.2)
    assert (sim.positions.tobytes(), sim.ids.tobytes(), sim.densities.tobytes()) == one


def test_what_falls_for_ever_is_lost_and_counted():
    sim = sph_ros.Simulation(
        {
            "spacing": 0.05,
            "gravity": [0, 0, -100],
            "liquid": [{"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}}],
        }
    )
    sim.advance(0.4)
    assert sim.particle_count == 8 and sim.statistics()["lost_particles"] == 0
    sim.advance(0.1)
    assert sim.particle_count == 0 and sim.statistics()["lost_particles"] == 8
