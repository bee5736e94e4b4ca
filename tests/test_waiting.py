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


@pytest.mark.parametrize(("stream", "lines"), [(Terminal, 0), (io.StringIO, 1)])
def test_a_terminal_sees_a_line_that_vanishes_and_a_file_keeps_one(stream, lines, monkeypatch):
    error, seen = stream(), threading.Event()
    write = error.write
    monkeypatch.setattr(error, "write", lambda text: (write(text), seen.set()))
    monkeypatch.setattr("sph_ros.waiting.PERIOD", 0.01)
    monkeypatch.setattr("sys.stderr", error)
    with preparing():
        assert seen.wait(20.0)
    assert "first run compiles" in error.getvalue()
    assert error.getvalue().count("\n") == lines
    if not lines:
        assert error.getvalue().endswith("\r") and error.getvalue().split("\r")[-2].strip() == ""


def test_what_is_quick_says_nothing(capsys):
    with preparing():
        pass
    assert capsys.readouterr().err == ""


def test_a_warm_simulation_runs_as_a_cold_one():
    scene = {"spacing": 0.02, "liquid": [{"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}}]}
    cold, warm = Simulation(scene), Simulation(scene)
    warm_up(warm)
    assert warm.time == 0.0
    cold.advance(0.05)
    warm.advance(0.05)
    assert np.array_equal(cold.positions, warm.positions)
