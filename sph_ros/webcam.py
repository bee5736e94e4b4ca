# SPDX-License-Identifier: Apache-2.0
"""`sph_ros webcam`: water on your desk, stirred with a printed marker.

marker_tracker, fluid_node, ar_overlay and web_viewer are processes of their own, as in `sph_ros
demo`. The tracker opens the camera and sends its pictures on to the overlay. With --headless the
overlay's pictures become a video instead of a page.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import cv2
from tqdm import tqdm

from sph_ros.live import (
    LiveError,
    check_target,
    remove_old,
    run_program,
    start_fluid,
    start_node,
    wait_until,
    wait_until_ready,
    watch_until_stopped,
)
from sph_ros.options import picture_size, positive
from sph_ros.processes import ChildError, Children

DEFAULT_SCENE, DEFAULT_PORT, DEFAULT_SECONDS = "desk_tank", 8080, 10.0

#: Side of the black square of the printed markers, and of the paper around it, [m].
MARKER_SIZE, PAPER_SHARE = 0.08, 1.4

#: Without a picture for so long the video is at its end, or the camera gives none [s].
SILENCE = 2.0

#: A first picture may need so long: the camera opens, nodes find each other [s].
FIRST_PICTURE = 20.0

#: From a picture to the wand's pose in the fluid node [s].
LATENCY = 0.02

FPS = 30.0
RESULTS = ("webcam.mp4", "last.png")
TRACKER_INPUT, PREPARING = "marker_tracker: input", "preparing"  # of its diagnostics
PICTURES = "/ar_overlay/image/compressed"


def main(argv=None):
    """Run it; returns the exit status: Ctrl-C gives 0 when it shows a page, else 130."""
    options = _parse(sys.argv[1:] if argv is None else list(argv))
    unfinished = options.headless or bool(options.make_video)
    return run_program("sph_ros webcam", lambda: _run(options), _user_errors(), unfinished)


def _user_errors():
    from sph_ros.sim.scene import SceneError
    from sph_ros.tracking.camera import CameraError

    return SceneError, CameraError, ChildError


def _parse(argv):
    parser = argparse.ArgumentParser(
        prog="sph_ros webcam",
        description="Water on your desk: print `sph_ros markers`, put the world marker down, hold "
        "the other one over it. Without a webcam, --make-video renders a film to try it on.",
    )
    add = parser.add_argument
    add("--source", default="0", help="number of a camera, video file, folder or bag (0)")
    add("--camera", metavar="FILE", help="calibration; default: that beside the video, camera.yaml")
    add("--scene", default=DEFAULT_SCENE, help=f"packaged name or YAML file ({DEFAULT_SCENE})")
    add("--marker-size", type=positive, default=MARKER_SIZE, metavar="M",
        help=f"printed side of the markers [m] ({MARKER_SIZE:g})")  # fmt: skip
    add("--rate", type=positive, default=1.0, help="times a video's speed, and the liquid's (1)")
    add("--port", type=int, default=DEFAULT_PORT, help=f"of the page ({DEFAULT_PORT})")
    add("--seconds", type=positive, help="how long; a page runs until Ctrl-C, a camera 10 s")
    add("--headless", action="store_true", help="no page: write a video into --out")
    add("--out", metavar="DIR", help="folder for the results of --headless (out/webcam)")
    add("--force", action="store_true", help="replace the results that are in DIR already")
    add("--make-video", metavar="FILE", help="only render a film of a desk, for --source")
    add("--size", type=picture_size, metavar="WxH", help="of that film (640x480)")
    options = parser.parse_args(argv)
    if options.out and not options.headless:
        parser.error("--out needs --headless")
    if options.size and not options.make_video:
        parser.error("--size needs --make-video; a camera's pictures have their own")
    if not 1 <= options.port <= 65535:
        parser.error(f"--port: expected 1 to 65535, got {options.port}")
    if options.rate != 1.0 and _is_device(options.source):
        parser.error("--rate: a camera has a rate of its own; it is for videos")
    return options


def _is_device(source):
    return source.isdecimal() or source.startswith("/dev/")


def _run(options):
    if options.make_video:
        return _make_video(options)
    from sph_ros.sim.scene import load_scene
    from sph_ros.tracking.camera import load_camera
    from sph_ros.waiting import preparing

    with preparing():
        scene = load_scene(options.scene)
    if not _is_device(options.source) and not Path(options.source).exists():
        raise LiveError(f"--source: {options.source} does not exist")
    calibration = _calibration(options)
    if calibration:
        load_camera(calibration)  # whatever is wrong with it is said before anything starts
    else:
        print("no calibration: distances are a guess; `sph_ros calibrate 0` makes camera.yaml")
    if options.headless:
        return _record(options, scene, calibration)
    return _show(options, scene, calibration)


def _make_video(options):
    from sph_ros.desk_video import SECONDS, SIZE, make_desk_video

    bar = "drawing {l_bar}{bar}| {n}/{total} frames, {remaining} to go"
    with tqdm(bar_format=bar, disable=None, leave=False) as line:

        def progress(done, total):
            line.total = total
            line.update(done - line.n)

        path = Path(options.make_video)
        seconds = options.seconds or SECONDS
        try:
            make_desk_video(path, seconds, options.size or SIZE, progress=progress)
        except (ValueError, RuntimeError) as error:
            raise LiveError(error) from error
    print(f"{path}: a desk for {seconds:g} s; try `sph_ros webcam --source {path}`")
    return 0


def _calibration(options):
    """Path of the calibration file, "" for none."""
    if options.camera:
        return options.camera
    source = Path(options.source)
    beside = source.with_suffix(".yaml") if source.is_file() else Path("camera.yaml")
    return str(beside) if beside.is_file() else ""


# ---------------------------------------------------------------- nodes


def _start_overlay(children, watch, options, scene, *parameters):
    """Start the overlay and wait until it has compiled."""
    parameters = [f"spacing:={float(scene.spacing)!r}", *parameters]
    if wands := _controlled(scene):
        side = PAPER_SHARE * options.marker_size
        parameters.append(f"cards:=['{wands[0]}:{side:.4f}']")
    if options.rate != 1.0:  # the liquid follows the hand a picture later
        interval = 1.0 / (options.rate * _video_rate(options.source))
        parameters.append(f"liquid_delay:={min(LATENCY + interval, 1.0)!r}")
    pictures = "/marker_tracker"
    remaps = [f"image:={pictures}/image", f"camera_info:={pictures}/camera_info"]
    start_node(children, "ar_overlay", *parameters, remaps=remaps)
    wait_until_ready(children, watch, "ar_overlay", PICTURES)


def _start_tracker(children, options, scene, calibration, loop):
    """Start the tracker, which opens the camera as soon as it is heard."""
    size = options.marker_size
    wands = _controlled(scene)
    parameters = [
        f"source:='{options.source}'",
        f"camera_info_url:='{calibration}'",
        f"marker_size:={float(size)!r}",
        f"solid_markers:=['{f'{wands[0]}:1' if wands else ''}']",
        f"world_frame:={scene.frame}",
        f"loop:={str(loop).lower()}",
    ]
    if options.rate != 1.0:
        parameters.append(f"source_rate:={options.rate * _video_rate(options.source)!r}")
    remaps = [f"/marker_tracker/{name}/pose:=/fluid/solids/{name}/pose" for name in wands[:1]]
    start_node(children, "marker_tracker", *parameters, remaps=remaps)


def _controlled(scene):
    return [solid.name for solid in scene.solids if solid.control == "topic"]


def _video_rate(source):
    rate = cv2.VideoCapture(source).get(cv2.CAP_PROP_FPS) if Path(source).is_file() else 0.0
    return rate if 0.1 < rate < 1000.0 else FPS


def _speed(options):
    return f"speed:={float(options.rate)!r}"


# ---------------------------------------------------------------- live


def _show(options, scene, calibration):
    from sph_ros.nodes.recorder import Recorder

    with Children() as children, Recorder() as watch:
        children.start("web_viewer", "sph_ros.nodes.web_viewer", "--port", str(options.port))
        start_fluid(children, watch, options.scene, _speed(options))
        _start_overlay(children, watch, options, scene)
        _start_tracker(children, options, scene, calibration, loop=True)
        print(f"open http://localhost:{options.port} in a browser; Ctrl-C ends it")
        print(f"topics: ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']} ros2 topic list", flush=True)
        watch_until_stopped(children, watch, options.seconds)
    return 0


# ---------------------------------------------------------------- into a video


def _record(options, scene, calibration):
    """Record first, encode afterwards: encoding must not take time from the liquid."""
    from sph_ros.recording import ResultFolder

    out = Path(options.out or "out/webcam")
    check_target(out, RESULTS, "video", options.force)
    seconds = options.seconds
    if seconds is None and _is_device(options.source):
        seconds = DEFAULT_SECONDS
    with ResultFolder(out) as folder, tempfile.TemporaryFile() as spool:
        pictures = Pictures(spool)
        wall = _record_pictures(options, scene, calibration, seconds, pictures)
        frames = _encode(pictures, folder.path, options.rate)
        remove_old(out, RESULTS)
    print(f"{out}: {len(pictures)} pictures in {wall:.1f} s, {frames} frames: {', '.join(RESULTS)}")
    return 0


class Pictures:
    """Compressed pictures and their times, kept in an open binary file."""

    def __init__(self, spool):
        self._spool, self._entries = spool, []
        self.last_arrival = None

    def __len__(self):
        return len(self._entries)

    def add(self, data):
        """Keep a sensor_msgs/CompressedImage in CDR bytes."""
        from msg_adapters.image import cdr_to_compressed_image

        message = cdr_to_compressed_image(data)
        self.last_arrival = time.monotonic()
        begin = self._spool.seek(0, os.SEEK_END)
        self._spool.write(message.data)
        self._entries.append((message.header.stamp_ns, begin, len(message.data)))

    @property
    def seconds(self):
        """From the first picture to the last [s]."""
        return (self._entries[-1][0] - self._entries[0][0]) * 1e-9 if self._entries else 0.0

    def at(self, number):
        """A picture (H, W, 3) uint8 BGR."""
        from sph_ros.tracking.images import decode

        _, begin, size = self._entries[number]
        self._spool.seek(begin)
        return decode(self._spool.read(size), "jpeg")

    def shown(self, rate, fps):
        """Number of the newest picture at each frame of a film.

        Args:
            rate: of the recording, times real speed.
            fps: of the film.
        """
        first, number, tick = self._entries[0][0], 0, 0
        while True:
            now = first + tick / fps / rate * 1e9
            while number + 1 < len(self) and self._entries[number + 1][0] <= now + 1e6:
                number += 1
            yield number
            if number + 1 == len(self):
                return
            tick += 1


def _record_pictures(options, scene, calibration, seconds, pictures):
    """Run everything until the video ends or time is over; returns the time it took [s]."""
    from sensor_msgs.msg import CompressedImage

    from sph_ros.nodes.recorder import Recorder

    with Children() as children, Recorder() as watch:
        start_fluid(children, watch, options.scene, _speed(options))
        _start_overlay(children, watch, options, scene, "jpeg_quality:=95")
        watch.hear(CompressedImage, PICTURES, pictures.add)
        _start_tracker(children, options, scene, calibration, loop=False)
        wait_until(children, watch, "marker_tracker", lambda: _is_prepared(watch))
        begin = time.monotonic()
        bar = "recording {n:.1f} s {postfix}"
        with tqdm(bar_format=bar, disable=None, leave=False) as line:
            while not _is_over(pictures, begin, seconds, options, watch):
                watch.spin(0.05)
                children.check()
                line.update(options.rate * pictures.seconds - line.n)
        return pictures.seconds


def _is_prepared(watch):
    """Whether the tracker has compiled, and opens the camera."""
    return watch.states.get(TRACKER_INPUT, PREPARING) != PREPARING


def _is_over(pictures, begin, seconds, options, watch):
    now = time.monotonic()
    if not len(pictures):
        if now - begin > FIRST_PICTURE:
            reason = watch.alerts.get(TRACKER_INPUT, "is the camera there, and free?")
            raise LiveError(f"no picture within {FIRST_PICTURE:g} s: {reason}")
        return False
    if seconds is not None and options.rate * pictures.seconds >= seconds:
        return True
    return now - pictures.last_arrival > SILENCE / min(options.rate, 1.0)


def _encode(pictures, folder, rate):
    """Write the film and its last picture; returns the number of frames."""
    from sph_ros.render import save_png
    from sph_ros.render.video import VideoWriter

    shown = list(pictures.shown(rate, FPS))
    picture = pictures.at(0)
    size = picture.shape[1::-1]
    last = None
    bar = "encoding {l_bar}{bar}| {n}/{total} frames, {remaining} to go"
    with VideoWriter(folder / RESULTS[0], size, FPS) as video:
        for number in tqdm(shown, bar_format=bar, disable=None, leave=False):
            if number != last:
                picture, last = pictures.at(number), number
            video.add(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
    save_png(folder / RESULTS[1], cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
    return len(shown)


if __name__ == "__main__":
    sys.exit(main())
