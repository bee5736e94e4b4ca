# SPDX-License-Identifier: Apache-2.0
"""Long preparations are announced, short ones are not, and warming up leaves no trace."""

import io
import threading

import numpy as np
import pytest

from sph_ros.sim.simulation import Simulation
from sph_ros.waiting import preparing, tell_while_waiting, warm_up


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_it_tells_again_and_again_until_the_block_is_left():
    heard, twice = [], threading.Event()

    def tell(seconds):
        heard.append(seconds)
        if len(heard) == 2:
            twice.set()

    with tell_while_waiting(tell, period=0.01):
        assert twice.wait(20.0)
    count = len(heard)
    assert heard[:2] == pytest.approx([0.01, 0.02])
    assert not [t for t in threading.enumerate() if t.name == "waiting"] and len(heard) == count


def test_a_terminal_sees_a_line_that_vanishes(monkeypatch):
    error, seen = Terminal(), threading.Event()
    write = error.write
    monkeypatch.setattr(error, "write", lambda text: (write(text), seen.set()))
    monkeypatch.setattr("sph_ros.waiting.PERIOD", 0.01)
    monkeypatch.setattr("sys.stderr", error)
    with preparing():
        assert seen.wait(20.0)
    assert "first run compiles" in error.getvalue() and "\n" not in error.getvalue()
    assert error.getvalue().endswith("\r") and error.getvalue().split("\r")[-2].strip() == ""


def test_a_file_and_what_is_quick_get_no_line(monkeypatch):
    for error, pause in ((io.StringIO(), 0.1), (Terminal(), 0.0)):
        monkeypatch.setattr("sph_ros.waiting.PERIOD", 0.01 if pause else 2.0)
        monkeypatch.setattr("sys.stderr", error)
        with preparing():
            threading.Event().wait(pause)
        assert error.getvalue() == ""


def test_a_warm_simulation_runs_as_a_cold_one():
    scene = {"spacing": 0.02, "liquid": [{"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}}]}
    cold, warm = Simulation(scene), Simulation(scene)
    warm_up(warm)
    assert warm.time == 0.0
    cold.advance(0.05)
    warm.advance(0.05)
    assert np.array_equal(cold.positions, warm.positions)
