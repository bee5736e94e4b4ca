# SPDX-License-Identifier: Apache-2.0
"""The first run compiles for up to a minute: do it before anything moves, and say so meanwhile."""

import sys
import threading
from contextlib import contextmanager

from sph_ros.core.surface import extract_surface

#: Between two reports [s]; what takes less is not worth a word.
PERIOD = 2.0


def warm_up(sim):
    """Compile all that a running simulation calls; it is back at its start afterwards."""
    sim.step()
    sim.statistics()
    scene = sim.scene
    extract_surface(sim.positions, scene.spacing, scene.support_radius, dimension=scene.dimension)
    sim.reset()


@contextmanager
def tell_while_waiting(tell, period=None):
    """Call `tell(seconds)` every now and then, from a thread, until the block is left."""
    left = threading.Event()

    def run():
        seconds = 0.0
        while not left.wait(period or PERIOD):
            seconds += period or PERIOD
            tell(seconds)

    thread = threading.Thread(target=run, name="waiting", daemon=True)
    thread.start()
    try:
        yield
    finally:
        left.set()
        thread.join()


@contextmanager
def preparing():
    """Say on standard error that a program is at work before it has anything to show.

    A terminal gets one line that counts and vanishes, a log file a single line.
    """
    live, told = sys.stderr.isatty(), []

    def tell(seconds):
        text = f"preparing, the first run compiles for up to a minute ... {seconds:.0f} s"
        if live:
            print(f"\r{text}", end="", file=sys.stderr, flush=True)
        elif not told:
            print(text, file=sys.stderr, flush=True)
        told.append(text)

    try:
        with tell_while_waiting(tell):
            yield
    finally:
        if live and told:
            print(f"\r{' ' * len(told[-1])}\r", end="", file=sys.stderr, flush=True)
