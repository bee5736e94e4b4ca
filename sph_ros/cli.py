# SPDX-License-Identifier: Apache-2.0
"""The program `sph_ros`: its subcommands and their options.

What a subcommand needs is imported when it runs, so that `--help` and typing errors answer at once.
"""

import argparse
import os
import sys

from sph_ros.options import count, numbers, picture_size, positive, remapping


def main(argv=None):
    """Run `sph_ros ARGS`; returns the exit status.

    Args:
        argv: arguments after the program's name; None for those of the process.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv[:1] == ["demo"]:  # has its own options, and its own --help
        from sph_ros.demo import main as demo

        return demo(argv[1:])
    if argv[:1] == ["webcam"]:
        from sph_ros.webcam import main as webcam

        return webcam(argv[1:])
    options = _parser().parse_args(argv)
    try:
        return options.run(options)
    except BrokenPipeError:  # the reader of our output went away, as in `sph_ros scenes | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (*_user_errors(), OSError) as error:  # a full disk, a folder that cannot be made
        print(f"sph_ros {options.command}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"sph_ros {options.command}: interrupted, nothing was written", file=sys.stderr)
        return 130


def _user_errors():
    """What people can cause; each carries one line that says how to mend it."""
    from msg_adapters.bags import BagError
    from sph_ros.sim.guards import UnstableError
    from sph_ros.sim.scene_yaml import SceneError
    from sph_ros.simulate import SimulateError
    from sph_ros.tracking.calibration import CalibrationError
    from sph_ros.tracking.commands import CommandError
    from sph_ros.tracking.detection import DictionaryError
    from sph_ros.tracking.targets import TargetError
    from sph_ros.validation.options import ValidateError

    tracking = CalibrationError, CommandError, DictionaryError, TargetError
    return SceneError, BagError, SimulateError, UnstableError, ValidateError, *tracking


def _parser():
    parser = argparse.ArgumentParser(
        prog="sph_ros",
        description="A real-time particle liquid, without middleware: scenes, offline runs, demo.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    scenes = commands.add_parser("scenes", help="list the packaged scenes")
    scenes.set_defaults(run=_scenes)

    check = commands.add_parser("check", help="validate a scene and say what it needs")
    check.add_argument("scene", metavar="SCENE", help="name of a packaged scene, or a YAML file")
    check.set_defaults(run=_check)

    commands.add_parser(
        "demo", help="the node, a recorded hand and a live view at once", add_help=False
    )
    commands.add_parser("webcam", help="water on your desk, in a camera's picture", add_help=False)
    _add_simulate(commands)
    _add_study(commands)
    _add_tracking(commands)
    _add_validate(commands)
    return parser


def _add_simulate(commands):
    simulate = commands.add_parser(
        "simulate",
        help="run a scene offline into a bag, a video and a plot",
        description="Run a scene as fast as the machine allows, without middleware. The same scene "
        "and bag give the same bytes. DIR is itself a rosbag2 folder with result.mcap; beside it "
        "lie video.mp4, last.png, history.csv and history.png.",
    )
    add = simulate.add_argument
    add("scene", metavar="SCENE", help="name of a packaged scene, or a YAML file")
    add("--bag", help="recorded PoseStamped messages that move solids: packaged name, or a path")
    add(
        "--remap",
        action="append",
        default=[],
        type=remapping,
        metavar="A:=B",
        help="poses on the bag's topic A move the solid B (a name, or its pose topic); may repeat",
    )
    add("--ignore-frame", action="store_true", help="take poses in any frame as the scene's frame")
    add("--seconds", type=positive, help="how long; default: the bag's, the scene's, or 5")
    add("--out", metavar="DIR", help="folder to make; default: out/SCENE")
    add("--force", action="store_true", help="replace results that DIR holds already")
    add("--fps", type=positive, default=30.0, help="recorded frames per second (default: 30)")
    add("--no-video", dest="video", action="store_false", help="no video.mp4, no last.png")
    add(
        "--size", type=picture_size, default=(960, 720), metavar="WxH", help="of the video [pixels]"
    )
    simulate.set_defaults(run=_simulate)


def _add_study(commands):
    study = commands.add_parser(
        "study",
        help="for which wall does the house of dam_house_2d stay dry",
        description="Run dam_house_2d with walls of many heights and positions, spread over the "
        "cores. Prints a table and for which walls the house stays dry; DIR gets study.csv and "
        "study.png.",
    )
    add = study.add_argument
    add("scene", metavar="SCENE", help="dam_house_2d")
    add("--heights", type=numbers, metavar="H,H,...", help="of the wall [m]; or FIRST:LAST:STEP")
    add("--positions", type=numbers, metavar="X,X,...", help="of its left face [m]; or a range")
    add("--seconds", type=positive, help="of each run (default: the scene's)")
    add("--solver", help="instead of the scene's")
    add("--workers", type=count, metavar="N", help="processes at once (default: all cores)")
    add("--out", metavar="DIR", help="folder to make; default: out/study_SCENE")
    add("--force", action="store_true", help="replace results that DIR holds already")
    study.set_defaults(run=_study)


def _add_tracking(commands):
    from sph_ros.tracking.commands import add_calibrate, add_markers

    add_markers(commands)
    add_calibrate(commands)


def _add_validate(commands):
    from sph_ros.validation.options import add_validate

    add_validate(commands)


# ---------------------------------------------------------------- subcommands


def _scenes(_options):
    from sph_ros.sim.scene import list_scenes, load_scene
    from sph_ros.waiting import preparing

    with preparing():
        scenes = [load_scene(name) for name in list_scenes()]
    for scene in scenes:
        print(f"{scene.name:16} {scene.description}")
    return 0


def _check(options):
    from sph_ros.sim.liquid import BYTES_PER_PARTICLE, available_memory
    from sph_ros.sim.scene import load_scene
    from sph_ros.sim.simulation import Simulation
    from sph_ros.waiting import preparing

    with preparing():
        scene = load_scene(options.scene)
        sim = Simulation(scene)
    count = len(sim.positions)
    needed = sim.capacity * BYTES_PER_PARTICLE
    chosen = "chosen" if scene.time_step is None else "given"
    solids = ", ".join(f"{solid.name} ({solid.control})" for solid in scene.solids) or "none"
    print(f"{scene.source}: good")
    more = f", at most {sim.capacity:,}" if scene.emitters else ""
    liquids = " and ".join(dict.fromkeys(liquid.name for liquid in scene.liquids))
    print(f"particles: {count:,}{more} of {liquids}, spacing {scene.spacing:g} m")
    print(f"solver:    {scene.solver}, {scene.dimension}D")
    print(f"time step: {sim.time_step * 1e3:.3g} ms ({chosen})")
    print(f"solids:    {solids}")
    for note in sim.notes:
        print(f"note:      {note}")
    print(f"memory:    about {needed / 1e6:,.0f} MB of {available_memory() / 1e6:,.0f} MB")
    return 0


def _simulate(options):
    from sph_ros.simulate import simulate

    summary = simulate(
        options.scene,
        options.out,
        bag=options.bag,
        remaps=dict(options.remap),
        ignore_frame=options.ignore_frame,
        seconds=options.seconds,
        fps=options.fps,
        size=options.size if options.video else None,
        force=options.force,
    )
    print(summary)
    return 0 if summary.complete else 130


def _study(options):
    from sph_ros.study import HEIGHTS, POSITIONS, report, study

    outcomes = study(
        options.scene,
        options.heights or HEIGHTS,
        options.positions or POSITIONS,
        seconds=options.seconds,
        solver=options.solver,
        workers=options.workers,
        out=options.out,
        force=options.force,
    )
    print(report(outcomes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
