# SPDX-License-Identifier: Apache-2.0
"""What programs share that start nodes as processes of their own and watch them."""

import os
import shutil
import signal
import sys
import time
from contextlib import contextmanager

from tqdm import tqdm


class LiveError(ValueError):
    """Such a program cannot go on; one line that says why."""


class Stopped(BaseException):
    """SIGINT or SIGTERM came."""


@contextmanager
def stoppable():
    """Raise Stopped in this thread at SIGINT or SIGTERM, once: cleaning up is not cut short."""
    before = {number: signal.signal(number, _stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _stop(_number, _frame):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise Stopped


def keep_to_ourselves():
    """Nobody else's topics, and nothing on the network, unless the environment says so."""
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def run_program(name, run, errors, headless):
    """Run a program to its end.

    Args:
        name: for messages.
        run: called without arguments; returns the exit status.
        errors: exception types that are the user's mistakes: one line instead of a traceback.
        headless: whether a signal leaves something unfinished.

    Returns:
        The exit status: 1 after an error; after a signal 0, or 130 if something is unfinished.
    """
    keep_to_ourselves()
    with stoppable():
        try:
            return run()
        except Stopped:
            print()
            if headless:
                print(f"{name}: interrupted, nothing was written", file=sys.stderr)
                return 130
            return 0
        except (*errors, LiveError, OSError) as error:
            print(f"{name}: {error}", file=sys.stderr)
            return 1


def start_fluid(children, watch, scene, *parameters):
    """Start the fluid node on a scene and wait until it has compiled.

    Args:
        children: Children.
        watch: Recorder.
        scene: name or path.
        parameters: further ones, `name:=value`.
    """
    start_node(children, "fluid_node", f"scene:={scene}", *parameters)
    wait_until_ready(children, watch, "fluid_node", "/fluid/particles")


def start_node(children, name, *parameters, remaps=()):
    """Start a node of this package with parameters `name:=value` and remappings `a:=b`."""
    arguments = [text for value in parameters for text in ("-p", value)]
    arguments += [text for value in remaps for text in ("-r", value)]
    children.start(name, f"sph_ros.nodes.{name}", "--ros-args", *arguments)


def wait_until_ready(children, watch, name, topic):
    """Wait until a node that may compile first publishes a topic."""
    wait_until(children, watch, name, lambda: watch.is_published(topic))


def wait_until(children, watch, name, condition):
    """Wait until something holds of a node that may compile first, and show how long it takes."""
    begin = time.monotonic()
    with tqdm(bar_format="{desc}", disable=None, leave=False) as line:
        while not condition():
            watch.spin(0.1)
            children.check()
            seconds = time.monotonic() - begin
            what = "compiling, first run only" if seconds > 5.0 else "starting"
            line.set_description_str(f"{name}: {what} ... {seconds:.0f} s")


def watch_until_stopped(children, watch, seconds):
    """Show how the simulation is until `seconds` have passed; for ever if that is None.

    What nodes complain of is printed once.
    """
    end, said = time.monotonic() + (seconds or float("inf")), set()
    with tqdm(bar_format="{desc}", disable=None) as line:
        while time.monotonic() < end:
            watch.spin(0.1)
            children.check()
            line.set_description_str(describe(watch.facts))
            for name, text in watch.alerts.items():
                kind = name, text.split(":")[0][:40]
                if kind not in said:
                    said.add(kind)
                    tqdm.write(f"{name}: {text}")


def describe(facts):
    """The fluid node's diagnostics in one line."""
    if not facts:
        return "waiting for the first report"
    return (
        f"{facts['state']}: {float(facts['simulated_time']):.0f} s simulated, "
        f"{facts['particles']} particles, {float(facts['real_time_factor']):.2f} x real time, "
        f"{float(facts['step_time_ms']):.1f} ms per step"
    )


def check_target(out, results, what, force):
    """LiveError when a folder cannot take results, or holds `what` already without `force`."""
    if out.exists() and not out.is_dir():
        raise LiveError(f"{out}: is a file, expected a folder to make")
    if any((out / name).exists() for name in results) and not force:
        raise LiveError(f"{out}: holds a {what} already; --force replaces it")


def remove_old(out, results):
    """Delete results of an earlier run."""
    for path in (out / name for name in results):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
