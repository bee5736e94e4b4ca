# SPDX-License-Identifier: Apache-2.0
"""`sph_ros demo`: a recorded hand stirs a liquid through ROS 2, in a browser or into a video.

fluid_node, bag_player and web_viewer are processes of their own that talk over DDS, as they would
on a robot. This process only watches them.
"""

import argparse
import os
import shutil
import signal
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from tqdm import tqdm

from sph_ros.options import positive
from sph_ros.processes import ChildError, Children

DEFAULT_PORT = 8080
DEFAULT_SECONDS = 10.0
#: Processes of one machine find each other within a second [s].
MOST_DISCOVERY = 15.0

#: Recorded hands that suit a packaged scene; all others get DEFAULT_HAND.
HANDS = {"drop_box": "hand_push"}
DEFAULT_HAND = "hand_stir"

VIDEO_SIZE = (960, 720)
RESULTS = ("bag", "demo.mp4", "last.png")


class DemoError(ValueError):
    """The demo cannot start; one line that says why."""


class _Stopped(BaseException):
    """SIGINT or SIGTERM came."""


def main(argv=None):
    """Run the demo; returns the exit status: Ctrl-C gives 0 in the live demo, else 130."""
    options = _parse(sys.argv[1:] if argv is None else list(argv))
    # Nobody else's topics, and nothing on the network, unless the environment says so.
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    before = {number: signal.signal(number, _stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        return _run(options)
    except _Stopped:
        print()
        if options.headless:
            print("sph_ros demo: interrupted, nothing was written", file=sys.stderr)
            return 130
        return 0
    except (*_user_errors(), DemoError, ChildError, OSError) as error:
        print(f"sph_ros demo: {error}", file=sys.stderr)
        return 1
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _stop(_number, _frame):
    # Once: a second Ctrl-C must not cut the cleaning up short.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise _Stopped


def _user_errors():
    from msg_adapters.bags import BagError
    from sph_ros.sim.scene import SceneError

    return SceneError, BagError


def _parse(argv):
    parser = argparse.ArgumentParser(
        prog="sph_ros demo",
        description="A recorded hand stirs a liquid: fluid_node, bag_player and a live view in the "
        "browser, over real DDS. With --headless a video, a last picture and a bag instead.",
    )
    add = parser.add_argument
    add("--scene", default="ball_tank", help="packaged name or YAML file (ball_tank)")
    add("--bag", default=None, help="recorded poses: packaged name or path (one that suits)")
    add("--rate", type=positive, default=1.0, help="times the recorded speed (1)")
    add("--seconds", type=positive, help="how long; the live view runs until Ctrl-C, a video 10 s")
    add("--headless", action="store_true", help="no browser: record, then draw into --out")
    add("--out", metavar="DIR", help="folder for the results of --headless (out/demo)")
    add("--force", action="store_true", help="replace the results that are in DIR already")
    add("--port", type=int, default=DEFAULT_PORT, help=f"of the live view ({DEFAULT_PORT})")
    add("--mouse", action="store_true", help="no recorded hand: only your mouse in the browser")
    options = parser.parse_args(argv)
    if options.mouse and (options.headless or options.bag):
        parser.error("--mouse goes with neither --headless nor --bag")
    if options.out and not options.headless:
        parser.error("--out needs --headless")
    if not 1 <= options.port <= 65535:
        parser.error(f"--port: expected 1 to 65535, got {options.port}")
    return options


def _run(options):
    from sph_ros.sim.scene import load_scene
    from sph_ros.waiting import preparing

    with preparing():
        scene = load_scene(options.scene)
    hand = None if options.mouse else _hand(scene, options.bag)
    if options.headless:
        return _record(options, scene, hand)
    return _show(options, hand)


def _hand(scene, bag):
    """Arguments for bag_player; None when nothing in the scene follows poses."""
    from msg_adapters.bags import open_bag, read_poses
    from msg_adapters.pose import POSE_STAMPED
    from sph_ros.sim.scene import bag_path

    controlled = [solid.name for solid in scene.solids if solid.control == "topic"]
    if not controlled:
        if bag is not None:
            raise DemoError(f"--bag: no solid of {scene.source} has `control: topic`")
        return None
    path = bag_path(bag or HANDS.get(scene.name, DEFAULT_HAND))
    with open_bag(path) as reader:
        topic = reader.only_topic(POSE_STAMPED).name
    read_poses(path, topic)  # whatever is wrong with them is said before anything starts
    target = f"/fluid/solids/{controlled[0]}/pose"
    return [str(path), "--loop", "--topics", topic, "--remap", f"{topic}:={target}"]


# ---------------------------------------------------------------- live


def _show(options, hand):
    from sph_ros.nodes.recorder import Recorder

    with Children() as children, Recorder() as watch:
        children.start("web_viewer", "sph_ros.nodes.web_viewer", "--port", str(options.port))
        _start_fluid(children, watch, options)
        if hand is not None:
            _start_hand(children, hand, options)
        print(f"open http://localhost:{options.port} in a browser; Ctrl-C ends the demo")
        print(f"topics: ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']} ros2 topic list", flush=True)
        end = time.monotonic() + (options.seconds or float("inf"))
        with tqdm(bar_format="{desc}", disable=None) as line:
            while time.monotonic() < end:
                watch.spin(0.1)
                children.check()
                line.set_description_str(_state(watch.facts))
        return 0


def _state(facts):
    if not facts:
        return "waiting for the first report"
    return (
        f"{facts['state']}: {float(facts['simulated_time']):.0f} s simulated, "
        f"{facts['particles']} particles, {float(facts['real_time_factor']):.2f} x real time, "
        f"{float(facts['step_time_ms']):.1f} ms per step"
    )


def _start_fluid(children, watch, options, *parameters):
    """Start the fluid node and wait until it has compiled."""
    arguments = [text for p in (f"scene:={options.scene}", *parameters) for text in ("-p", p)]
    children.start("fluid_node", "sph_ros.nodes.fluid_node", "--ros-args", *arguments)
    begin = time.monotonic()
    with tqdm(bar_format="{desc}", disable=None, leave=False) as line:
        while not watch.fluid_is_ready:
            watch.spin(0.1)
            children.check()
            seconds = time.monotonic() - begin
            what = "compiling, first run only" if seconds > 5.0 else "starting"
            line.set_description_str(f"fluid_node: {what} ... {seconds:.0f} s")


def _start_hand(children, hand, options):
    rate = ["--rate", f"{options.rate:g}"]
    children.start("bag_player", "sph_ros.nodes.bag_player", *hand, *rate)


# ---------------------------------------------------------------- into a video


def _record(options, scene, hand):
    """Record first, draw afterwards: drawing must not take time from the liquid."""
    from msg_adapters.bags import BagWriter
    from sph_ros.recording import ResultFolder

    seconds = options.seconds or DEFAULT_SECONDS
    out = Path(options.out or "out/demo")
    _check_target(out, options.force)
    with ResultFolder(out) as folder:
        bag = folder.path / "bag"
        with BagWriter(bag) as writer:
            factor, count = _record_bag(options, scene, hand, writer, seconds)
        frames = _draw(bag, scene, folder.path)
        _remove_old(out)
    print(
        f"{out}: {seconds:g} s recorded, {count} clouds at {factor:.2f} x real time, "
        f"{frames} frames drawn: {', '.join(RESULTS)}"
    )
    return 0


def _record_bag(options, scene, hand, writer, seconds):
    """Record for some time; returns (simulated per real time, number of clouds)."""
    from sph_ros.nodes.recorder import Recorder

    with ExitStack() as stack:
        children = stack.enter_context(Children())
        watch = stack.enter_context(Recorder())
        _start_fluid(children, watch, options)
        watch.listen(scene)
        _wait_for(children, watch, "/fluid/particles")
        if hand is not None:
            _start_hand(children, hand, options)
            _wait_for(children, watch, hand[-1].partition(":=")[2])
        watch.record(writer)
        end = time.monotonic() + seconds
        factors = []
        bar = "recording {l_bar}{bar}| {n:.0f}/{total:.0f} s {postfix}"
        with tqdm(total=seconds, bar_format=bar, disable=None, leave=False) as line:
            while time.monotonic() < end:
                watch.spin(0.05)
                children.check()
                line.update(min(seconds, seconds - end + time.monotonic()) - line.n)
                if watch.facts and (not factors or factors[-1] is not watch.facts):
                    factors.append(watch.facts)
                    line.set_postfix_str(f"{float(watch.facts['real_time_factor']):.2f} x")
        measured = [float(facts["real_time_factor"]) for facts in factors]
        mean = sum(measured) / len(measured) if measured else float("nan")
        return mean, watch.counts.get("/fluid/particles", 0)


def _wait_for(children, watch, topic):
    """Until a first message of a topic was heard."""
    deadline = time.monotonic() + MOST_DISCOVERY
    while topic not in watch.counts:
        if time.monotonic() > deadline:
            raise DemoError(f"nothing on {topic} within {MOST_DISCOVERY:g} s; does DDS work here?")
        watch.spin(0.05)
        children.check()


def _draw(bag, scene, folder):
    from sph_ros.film import film_of_bag

    bar = "drawing   {l_bar}{bar}| {n}/{total} frames, {remaining} to go"
    with tqdm(bar_format=bar, disable=None, leave=False) as line:

        def progress(done, total):
            line.total = total
            line.update(done - line.n)

        video, picture = folder / "demo.mp4", folder / "last.png"
        return film_of_bag(bag, scene, video, picture, VIDEO_SIZE, 30.0, progress)


def _check_target(out, force):
    if out.exists() and not out.is_dir():
        raise DemoError(f"{out}: is a file, expected a folder to make")
    if any((out / name).exists() for name in RESULTS) and not force:
        raise DemoError(f"{out}: holds a demo already; --force replaces it")


def _remove_old(out):
    for path in (out / name for name in RESULTS):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


if __name__ == "__main__":
    sys.exit(main())
