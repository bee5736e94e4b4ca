# SPDX-License-Identifier: Apache-2.0
"""`sph_ros demo`: a recorded hand stirs a liquid through ROS 2, in a browser or into a video.

fluid_node, bag_player and web_viewer are processes of their own that talk over DDS, as they would
on a robot. This process only watches them.
"""

import argparse
import os
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from tqdm import tqdm

from sph_ros.live import (
    LiveError,
    check_target,
    remove_old,
    run_program,
    start_fluid,
    watch_until_stopped,
)
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


def main(argv=None):
    """Run the demo; returns the exit status: Ctrl-C gives 0 in the live demo, else 130."""
    options = _parse(sys.argv[1:] if argv is None else list(argv))
    errors = (*_user_errors(), ChildError)
    return run_program("sph_ros demo", lambda: _run(options), errors, options.headless)


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
            raise LiveError(f"--bag: no solid of {scene.source} has `control: topic`")
        return None
    path = bag_path(bag or HANDS.get(scene.name, DEFAULT_HAND))
    with open_bag(path) as reader:
        topic = reader.only_topic(POSE_STAMPED).name
    read_poses(path, topic)  # whatever is wrong with them is said before anything starts
    target = f"/fluid/solids/{controlled[0]}/pose"
    # Recorded stamps jump back with each lap, which the node takes for stragglers at first.
    again = ["--loop", "--stamp", "now"]
    return [str(path), *again, "--topics", topic, "--remap", f"{topic}:={target}"]


# ---------------------------------------------------------------- live


def _show(options, hand):
    from sph_ros.nodes.recorder import Recorder

    with Children() as children, Recorder() as watch:
        children.start("web_viewer", "sph_ros.nodes.web_viewer", "--port", str(options.port))
        start_fluid(children, watch, options.scene)
        if hand is not None:
            _start_hand(children, hand, options)
        print(f"open http://localhost:{options.port} in a browser; Ctrl-C ends the demo")
        print(f"topics: ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']} ros2 topic list", flush=True)
        watch_until_stopped(children, watch, options.seconds)
        return 0


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
    check_target(out, RESULTS, "demo", options.force)
    with ResultFolder(out) as folder:
        bag = folder.path / "bag"
        with BagWriter(bag) as writer:
            factor, count = _record_bag(options, scene, hand, writer, seconds)
        frames = _draw(bag, scene, folder.path)
        remove_old(out, RESULTS)
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
        start_fluid(children, watch, options.scene)
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
            raise LiveError(f"nothing on {topic} within {MOST_DISCOVERY:g} s; does DDS work here?")
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


if __name__ == "__main__":
    sys.exit(main())
