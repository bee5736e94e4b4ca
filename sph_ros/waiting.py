# SPDX-License-Identifier: Apache-2.0
"""The first run compiles for half a minute: do it before anything moves, and say so meanwhile."""

import sys
import threading
from contextlib import contextmanager

from sph_ros.core.surface import extract_surface
from sph_ros.sim import kernels

#: Between two reports [s]; what takes less is not worth a word.
PERIOD = 2.0


def warm_up(sim):
    """Compile all that a running simulation calls; it is back at its start afterwards."""
    sim.step()
    sim.statistics()
    scene = sim.scene
    extract_surface(sim.positions, scene.spacing, scene.support_radius, dimension=scene.dimension)
    sim.particles  # noqa: B018
    sim.reset()


def words(seconds):
    """What a program is at that has been preparing for so long [s], and how far it is."""
    compiled = kernels.progress()
    if not compiled:
        return f"preparing, the first run compiles for half a minute: {seconds:.0f} s"
    return f"compiling for this machine, the first time only: {compiled}, {seconds:.0f} s"


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
    """Say on a terminal that a program is at work before it has anything to show.

    The line counts seconds and vanishes. Nothing is written to a file or a pipe, as progress bars
    do it: there, standard error holds mistakes only.
    """
    if not sys.stderr.isatty():
        yield
        return
    told = []

    def tell(seconds):
        told.append(words(seconds))
        print(f"\r{told[-1]:<{len(told[0])}}", end="", file=sys.stderr, flush=True)

    try:
        with tell_while_waiting(tell):
            yield
    finally:
        if told:
            print(f"\r{' ' * max(map(len, told))}\r", end="", file=sys.stderr, flush=True)
